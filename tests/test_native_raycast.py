import math

import pytest
import torch
from native_maps import dims, dtypes
from small_maps import F64, wall, wall_map

from lardhm_torch import LardHilbertMap, native
from lardhm_torch.features import Kernel
from lardhm_torch.queries import raycasting
from lardhm_torch.queries.raycasting import raycast

pytestmark = pytest.mark.skipif(not native.available(), reason="no compiler for the kernel")


class PlainMap(LardHilbertMap):
    """The same map without the native march: `raycast` then follows its definition."""

    query_rays = None

    @classmethod
    def of(cls, model):
        plain = cls(**model.settings).to(model.centers.dtype)
        plain.load_state_dict(model.state_dict())
        return plain.requires_grad_(False)


def random_map(dim, dtype=F64, seed=0, clusters=60, neighbors=7, spread=2.0):
    """Clusters of both signs and many shapes, some so thin that the floor holds them."""
    rng = torch.Generator().manual_seed(seed)
    points = spread * torch.randn(20 * clusters, dim, generator=rng, dtype=F64)
    model = LardHilbertMap(dim, num_neighbors=neighbors).to(dtype)
    labels = (points[:, 0].sin() > 0).to(dtype)
    model.fit(points.to(dtype), labels, num_clusters=clusters)
    model.weights.data = 5 * torch.randn(len(model), generator=rng, dtype=dtype)
    model.raw_scale_tril.data += (
        0.5 * torch.randn(model.raw_scale_tril.shape, generator=rng, dtype=dtype).tril()
    )
    return model.requires_grad_(False)


def random_rays(count, dim, seed=1):
    """From inside the map and from far away, in all directions and along the axes."""
    rng = torch.Generator().manual_seed(seed)
    origins = 3 * torch.randn(count, dim, generator=rng, dtype=F64)
    directions = torch.randn(count, dim, generator=rng, dtype=F64)
    origins[::7] *= 20
    directions[::7] = -origins[::7]
    directions[1, 1:] = 0
    directions[2, :-1] = 0
    return origins, directions


def assert_same_ranges(native_ranges, plain_ranges, atol):
    """Equal, but for the few rays that graze an obstacle, where the last bit decides."""
    assert torch.equal(native_ranges.isfinite(), plain_ranges.isfinite())
    met = plain_ranges.isfinite()
    assert met.any()
    assert not met.all()
    off = (native_ranges - plain_ranges)[met].abs()
    assert float((off > atol).double().mean()) <= 0.005


@dims
@dtypes
@pytest.mark.parametrize("surface", raycasting.SURFACES)
@pytest.mark.parametrize("threshold", [0.3, 0.5, 0.8])
def test_the_native_march_ends_where_the_definition_does(dim, dtype, surface, threshold):
    for seed, neighbors in ((0, 1), (1, 7), (2, 1000)):
        model = random_map(dim, dtype, seed, neighbors=neighbors)
        origins, directions = random_rays(500, dim)
        asked = (origins, directions, 40.0, threshold, 0.07)
        plain = raycast(PlainMap.of(model), *asked, surface=surface)
        ours = raycast(model, *asked, surface=surface)
        assert_same_ranges(ours, plain, 1e-6 if dtype == F64 else 2e-3)


@pytest.mark.parametrize("surface", raycasting.SURFACES)
def test_a_threshold_that_unknown_space_exceeds_stops_every_ray_at_once(surface):
    model = random_map(2)
    origins, directions = random_rays(200, 2)
    plain = raycast(PlainMap.of(model), origins, directions, 20.0, 0.2, 0.1, surface=surface)
    ours = raycast(model, origins, directions, 20.0, 0.2, 0.1, surface=surface)
    # 16 bisections of a few steps of 0.1 m leave cells of some 10^-6 m; a rounding error picks one.
    torch.testing.assert_close(ours, plain, rtol=0, atol=2e-5)
    assert ours.isfinite().any()


@dims
def test_rays_do_not_care_how_they_are_ordered_or_how_many_march_together(dim):
    model = random_map(dim)
    origins, directions = random_rays(300, dim)
    together = raycast(model, origins, directions, 40.0, step=0.05)
    order = torch.randperm(300, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(
        raycast(model, origins[order], directions[order], 40.0, step=0.05), together[order]
    )
    alone = [raycast(model, o, d[None], 40.0, step=0.05) for o, d in zip(origins, directions)]  # noqa: B905
    torch.testing.assert_close(torch.cat(alone), together)


def test_a_range_that_is_no_multiple_of_the_step_is_looked_at_to_its_end():
    model = wall_map()
    ahead = torch.tensor([[1.0, 0.0, 0.0]], dtype=F64)
    start = torch.tensor([0.0, 1.0, 1.0], dtype=F64)
    full = float(raycast(PlainMap.of(model), start, ahead, 5.0, step=0.02))
    for most in torch.linspace(full - 0.2, full + 0.6, 23).tolist():
        for surface in raycasting.SURFACES:
            asked = (start, ahead, most, 0.5, 0.3)
            plain = raycast(PlainMap.of(model), *asked, surface=surface)
            torch.testing.assert_close(raycast(model, *asked, surface=surface), plain)


def test_maps_far_from_zero_keep_their_precision():
    points, labels = wall()
    shift = torch.tensor([4.5e6, 5e5, 100.0], dtype=F64)
    near = LardHilbertMap().fit(points, labels, 40)
    far = LardHilbertMap().fit(points + shift, labels, 40)
    origins = torch.tensor([0.1, 1.0, 1.0], dtype=F64)
    directions = torch.tensor([[1.0, 0.1, 0.1], [1.0, -0.2, 0.0]], dtype=F64)
    torch.testing.assert_close(
        raycast(far, origins + shift, directions, 5.0), raycast(near, origins, directions, 5.0),
        rtol=0, atol=1e-3,
    )  # fmt: skip


def test_rays_from_nowhere_meet_nothing():
    model = random_map(3)
    origins = torch.full((3, 3), math.nan, dtype=F64)
    ranges = raycast(model, origins, torch.eye(3, dtype=F64), 10.0, step=0.1)
    assert ranges.tolist() == [math.inf] * 3


def test_a_map_of_a_type_that_the_kernel_does_not_know_is_asked_by_the_definition():
    model = random_map(3).half()
    assert model.query_rays(torch.zeros(1, 3).double(), torch.eye(3)[:1].double(), ()) is None


def test_the_operator_is_a_good_citizen_of_torch():
    model = random_map(2)
    origins, directions = random_rays(20, 2)
    directions = directions / directions.norm(dim=1, keepdim=True)
    settings = (0.1, 20.0, 0.0, 1.0, True)
    index = native.build_index(model.centers, 7)
    kernel = Kernel(*model.kernel)
    tensors = (model.centers, model.raw_scale_tril, model.weights)
    torch.library.opcheck(
        torch.ops.lardhm.raycast, (origins, directions, *settings, *tensors, *kernel, index)
    )


def test_bad_arguments_of_the_operator_are_refused():
    model = random_map(2)
    origins = torch.zeros(3, 2, dtype=F64)
    tensors = (model.centers, model.raw_scale_tril, model.weights)
    index = native.build_index(model.centers, 7)
    with pytest.raises(RuntimeError, match="must be \\(R, D\\) float64"):
        native.raycast(
            (origins, origins[:2]), (0.1, 5.0, 0.0, 1.0, True), tensors, model.kernel, index
        )
    with pytest.raises(RuntimeError, match="step and max_range must be > 0"):
        native.raycast((origins, origins), (0.0, 5.0, 0.0, 1.0, True), tensors, model.kernel, index)
