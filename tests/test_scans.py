"""Scans: shapes are checked at the door, rays keep their scan, splitting loses nothing."""

import pytest
import torch

from lardhm_torch.scans import Scans, concatenate_scans, split_rays


def two_scans() -> Scans:
    return Scans(
        origins=torch.tensor([[0.0, 0, 0], [10, 0, 0]]),
        ends=torch.tensor([[3.0, 4, 0], [10, 0, 2], [0, 0, 5]]),
        scan_id=torch.tensor([0, 1, 0]),
        is_return=torch.tensor([True, True, False]),
    )


def random_scans(rays: int, seed: int = 0) -> Scans:
    rng = torch.Generator().manual_seed(seed)
    return Scans(
        torch.randn(4, 3, generator=rng),
        torch.randn(rays, 3, generator=rng),
        torch.randint(4, (rays,), generator=rng),
        torch.rand(rays, generator=rng) < 0.8,
        torch.randint(1, 4, (rays,), generator=rng),
    )


def test_ranges_are_lengths_from_the_origin_of_the_rays_own_scan():
    scans = two_scans()
    assert scans.ranges.tolist() == [5, 2, 5]
    assert scans.ray_origins.tolist() == [[0, 0, 0], [10, 0, 0], [0, 0, 0]]


def test_hits_are_the_ends_that_returned():
    assert two_scans().hits.tolist() == [[3, 4, 0], [10, 0, 2]]


def test_what_is_left_out_means_one_scan_of_first_returns():
    scans = Scans(torch.zeros(1, 2), torch.ones(3, 2))
    assert scans.scan_id.tolist() == [0, 0, 0]
    assert scans.is_return.tolist() == [True, True, True]
    assert scans.target_index.tolist() == [1, 1, 1]
    assert (len(scans), scans.dim, scans.num_scans) == (3, 2, 1)


def test_coordinates_are_float64_whatever_comes_in():
    scans = Scans(torch.zeros(1, 3, dtype=torch.float32), torch.ones(2, 3, dtype=torch.int32))
    assert scans.ends.dtype == scans.origins.dtype == torch.float64


def test_no_rays_are_still_scans():
    scans = Scans(torch.zeros(1, 3), torch.zeros(0, 3))
    assert (len(scans), scans.ranges.shape) == (0, (0,))


@pytest.mark.parametrize(
    ("origins", "ends"), [((1, 2), (5, 3)), ((3,), (5, 3)), ((1, 3), (3,)), ((1, 3), (1, 5, 3))]
)
def test_origins_and_ends_must_share_their_dimension(origins, ends):
    with pytest.raises(ValueError, match=r"ends must be \(R, D\) and origins \(S, D\)"):
        Scans(torch.zeros(origins), torch.zeros(ends))


@pytest.mark.parametrize("name", ["scan_id", "is_return", "target_index"])
def test_columns_need_one_entry_per_ray(name):
    with pytest.raises(ValueError, match=rf"{name} must be \(5,\).*got \(4,\)"):
        Scans(torch.zeros(1, 3), torch.zeros(5, 3), **{name: torch.zeros(4, dtype=torch.long)})


@pytest.mark.parametrize("bad", [-1, 2])
def test_every_scan_id_needs_an_origin(bad):
    with pytest.raises(ValueError, match=rf"scan_id must be 0 to 1.*{bad}"):
        Scans(torch.zeros(2, 3), torch.zeros(2, 3), torch.tensor([0, bad]))


def test_rays_without_a_scan_id_need_an_origin_too():
    with pytest.raises(
        ValueError, match="scan_id must be 0 to -1, one origin per scan; got 0 to 0"
    ):
        Scans(torch.zeros(0, 3), torch.zeros(2, 3))


def test_selected_rays_keep_their_origin_and_columns():
    scans = random_scans(50)
    rays = torch.tensor([7, 3, 3, 49])
    chosen = scans.select(rays)
    for name in ("ends", "ray_origins", "is_return", "target_index"):
        assert torch.equal(getattr(chosen, name), getattr(scans, name)[rays]), name


def test_selecting_by_mask_equals_selecting_by_index():
    scans = random_scans(50)
    by_mask, by_index = scans.select(scans.is_return), scans.select(scans.is_return.nonzero()[:, 0])
    assert torch.equal(by_mask.ends, by_index.ends)
    assert torch.equal(by_mask.ends, scans.hits)


def test_a_constant_last_column_can_be_dropped():
    scans = Scans(torch.tensor([[1.0, 2, 7]]), torch.tensor([[3.0, 4, 7], [5, 6, 7]]))
    flat = scans.drop_constant_column()
    assert flat.ends.tolist() == [[3, 4], [5, 6]]
    assert flat.origins.tolist() == [[1, 2]]


def test_a_column_that_varies_is_not_dropped():
    with pytest.raises(ValueError, match=r"last coordinate must be constant.*spans 2 m"):
        Scans(torch.zeros(1, 3), torch.tensor([[0.0, 0, 0], [0, 0, 2]])).drop_constant_column()


def test_joined_scans_keep_every_ray_with_its_origin():
    first, second = random_scans(20, 1), random_scans(30, 2)
    both = concatenate_scans([first, second])
    assert both.num_scans == 8
    for name in ("ends", "ray_origins", "is_return", "target_index"):
        parts = torch.cat([getattr(first, name), getattr(second, name)])
        assert torch.equal(getattr(both, name), parts), name


def test_joining_needs_scans_of_one_dimension():
    flat = Scans(torch.zeros(1, 2), torch.zeros(1, 2))
    with pytest.raises(ValueError, match=r"same dimension; got \[2, 3\]"):
        concatenate_scans([random_scans(3), flat])
    with pytest.raises(ValueError, match="at least one Scans"):
        concatenate_scans([])


@pytest.mark.parametrize(("ratio", "kept"), [(0.5, 50), (0.25, 25), (0.99, 99)])
def test_a_split_gives_every_ray_to_one_side(ratio, kept):
    scans = random_scans(100)
    train, test = split_rays(scans, ratio, seed=3)
    assert (len(train), len(test)) == (kept, 100 - kept)
    both = torch.cat([train.ends, test.ends])
    assert torch.equal(both[both[:, 0].argsort()], scans.ends[scans.ends[:, 0].argsort()])


def test_the_seed_decides_the_split():
    scans = random_scans(100)
    once, again, other = (split_rays(scans, seed=seed)[0] for seed in (1, 1, 2))
    assert torch.equal(once.ends, again.ends)
    assert not torch.equal(once.ends, other.ends)


@pytest.mark.parametrize("ratio", [0, 1, -0.5, 1.5, float("nan")])
def test_a_split_leaves_something_on_both_sides(ratio):
    with pytest.raises(ValueError, match="ratio must be between 0 and 1"):
        split_rays(random_scans(4), ratio)


@pytest.mark.parametrize("origin_height", [0.0, float("nan")])
def test_a_column_in_which_only_the_origin_differs_is_not_dropped(origin_height):
    scans = Scans(torch.tensor([[0.0, 0.0, origin_height]]), torch.tensor([[1.0, 2.0, 1.0]]))
    with pytest.raises(ValueError, match="last coordinate must be constant"):
        scans.drop_constant_column()


def test_scans_compare_by_identity_without_an_error():
    scans = Scans(torch.zeros(1, 3), torch.rand(5, 3))
    assert scans == scans
    assert scans != Scans(scans.origins, scans.ends)
