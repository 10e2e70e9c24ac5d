"""Queries of channels: interpolation, posteriors of classes, gradients, export and compilation."""

import copy
import math

import pytest
import torch
from colored_maps import CLASSES, colored_map, colored_wall, ramp, surface_points
from small_maps import F64, wall

from lardhm_torch import LardHilbertMap, channel, features, native


def test_linear_values_are_interpolated_linearly_and_unknown_is_nan():
    model, points = colored_map(), surface_points()
    torch.testing.assert_close(model.channel(points, "color"), ramp(points), rtol=0, atol=0.01)
    values = model.channel(points.reshape(5, 10, 3), "intensity")
    torch.testing.assert_close(values.reshape(-1), 100 * points[:, 1], rtol=0, atol=2)
    far = points + 50
    assert model.channel(far, "color").isnan().all()
    assert model.channel(torch.full((1, 3), math.nan), "intensity").isnan().all()
    assert model.channel(points[:0], "color").shape == (0, 3)


def test_the_native_mixture_equals_the_definition():
    if not native.available():
        pytest.skip("the native kernel is off or there is no compiler")
    rng = torch.Generator().manual_seed(0)
    model = colored_map()
    points = surface_points(300) - model.origin + 0.05 * torch.randn(300, 3, generator=rng).double()
    points[7] = math.nan
    for width, columns in ((4, 3), (1, 20)):
        table = torch.randn(len(model), columns, width, generator=rng, dtype=F64)
        given = (points, model.centers.detach(), model.raw_scale_tril.detach(), table)
        for sharp in (True, False):
            ours = native.mixture(*given, model.kernel, model._fresh_index(), sharp=sharp)
            indices = features.nearest_centers(points, model.centers, model.num_neighbors)
            plain = features.mixture(
                points, model.centers, model.scale_tril, table, indices, sharp=sharp
            ).detach()
            torch.testing.assert_close(ours, plain, equal_nan=True)


def test_channels_and_classes_are_differentiable():
    points, labels, channels = colored_wall(100)
    model = LardHilbertMap(3, 5).double().fit(points, labels, 12, channels=channels)
    model.class_weights = torch.nn.Parameter(0.1 * torch.ones(len(model), 2, dtype=F64))
    points = surface_points(4).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda x: model.channel(x, "intensity"), points)
    tensors = (points, model.centers.detach(), model.raw_scale_tril.detach(), model.class_weights)

    def log_odds(points, centers, raw, weights):
        parameters = {"centers": centers, "raw_scale_tril": raw, "class_weights": weights}
        return torch.func.functional_call(_Classes(model), _prefixed(parameters), (points,))

    inputs = tuple(tensor.detach().clone().requires_grad_(True) for tensor in tensors)
    assert torch.autograd.gradcheck(log_odds, inputs)


class _Classes(torch.nn.Module):
    def __init__(self, model):
        super().__init__()
        self.model = model

    def forward(self, points):
        return self.model.class_log_odds(points)


class _Both(_Classes):
    def forward(self, points):
        return torch.cat(
            [self.model.class_log_odds(points), self.model.channel(points, "color")], 1
        )


def _prefixed(parameters):
    return {f"model.{name}": value for name, value in parameters.items()}


def test_class_posteriors_are_distributions():
    model, points = colored_map(), surface_points()
    everywhere = torch.cat([points, points + 50, points - 0.3])
    for probability in (model.class_probability(everywhere), model.class_posterior(everywhere)):
        torch.testing.assert_close(probability.sum(dim=-1), torch.ones(150, dtype=F64))
        assert (probability >= 0).all()
    assert torch.equal(model.class_probability(points + 50), torch.full((50, 2), 0.5, dtype=F64))
    clear = (points[:, 1] - 1).abs() > 0.1
    found = torch.tensor(model.classes)[model.class_probability(points).argmax(dim=1)]
    assert (found[clear] == torch.where(points[clear, 1] < 1, *CLASSES)).all()
    free = model.class_posterior(points - torch.tensor([0.7, 0, 0]))[:, 0]
    assert (free > 0.9).all()


def test_maps_with_channels_are_exported():
    model, points = colored_map(), surface_points()
    exported = torch.export.export(model, (points,)).module()
    torch.testing.assert_close(exported(points), model(points))
    number = torch.export.Dim("N", min=2, max=10_000)
    module = _Both(model)
    program = torch.export.export(module, (points,), dynamic_shapes=({0: number},)).module()
    torch.testing.assert_close(program(points[:7]), module(points[:7]))


def test_compiled_channels_have_gradients_and_follow_updates():
    model, points = colored_map(num_neighbors=5), surface_points(8)
    compiled = torch.compile(_Both(model), fullgraph=True, backend="aot_eager")
    slopes = []
    for module in (_Both(model), compiled):
        given = points.clone().requires_grad_(True)
        module(given).square().sum().backward()
        slopes.append(given.grad)
    torch.testing.assert_close(slopes[1], slopes[0])
    model.channel_sums[:, 4:7] *= 0.5
    torch.testing.assert_close(compiled(points), _Both(model)(points))


@pytest.mark.parametrize("name", ["color", "class"])
def test_a_changed_map_does_not_answer_with_old_sums(name):
    """Regressions are kept between queries; every way to change the sums must be noticed."""
    points, other = surface_points(), colored_map()
    other.channel_sums[:, 4:7] *= 0.5  # of the colors
    other.channel_sums[:, 10] *= 0.1  # of the first class
    expected = other.channel(points, name)
    assert not torch.equal(colored_map().channel(points, name), expected)
    in_place, replaced, loaded = colored_map(), colored_map(), colored_map()
    for model in (in_place, replaced, loaded):
        model.channel(points, name)
    in_place.channel_sums.copy_(other.channel_sums)
    replaced.channel_sums = other.channel_sums
    loaded.load_state_dict(other.state_dict())
    for model in (in_place, replaced, loaded, copy.deepcopy(other)):
        assert torch.equal(model.channel(points, name), expected)
    with torch.inference_mode():
        assert torch.equal(copy.deepcopy(other).channel(points, name), expected)


def test_the_function_answers_as_the_map_does():
    model, points = colored_map(), surface_points()
    assert torch.equal(channel(model, points, "color"), model.channel(points, "color"))
    assert torch.equal(channel(model, points, "class"), model.class_probability(points))
    with pytest.raises(ValueError, match="color, intensity, class; got 'infrared'"):
        channel(model, points, "infrared")


def test_a_map_without_a_channel_names_those_it_has():
    with pytest.raises(ValueError, match="'infrared'; it has color, intensity, class"):
        colored_map().channel(surface_points(), "infrared")
    bare = LardHilbertMap(3).double().fit(*wall(), 40)
    with pytest.raises(ValueError, match="it has none"):
        bare.class_log_odds(surface_points())
    assert bare.classes == []
