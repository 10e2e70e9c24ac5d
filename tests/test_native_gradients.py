"""Gradients of the native kernel, and what torch asks of its operators."""

import pytest
import torch
from native_maps import (
    CENTER_COUNTS,
    dims,
    kernel,
    make_map,
    make_points,
    true_neighbors,
    true_terms,
)


def reference_gradients(points, parameters, indices, grad, probability):
    inputs = [t.detach().clone().requires_grad_() for t in (points, *parameters)]
    answer = true_terms(inputs[0], tuple(inputs[1:]), indices, torch.float64).sum(dim=1)
    answer = torch.sigmoid(answer) if probability else answer
    return torch.autograd.grad(answer, inputs, grad)


@dims
@pytest.mark.parametrize("probability", [False, True])
def test_gradients_equal_those_of_the_formula(ops, dim, probability):
    for count in CENTER_COUNTS:
        parameters = make_map(count, dim, torch.float64)
        points = make_points(3000, dim, torch.float64)
        index = ops.build_index(parameters[0], 5)
        grad = torch.randn(3000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        indices = true_neighbors(points, parameters[0], 5)
        expected = reference_gradients(points, parameters, indices, grad, probability)
        for wanted in (15, 1, 8, 6):
            found = ops.occupancy_backward(
                grad, points, *parameters, *kernel(5), index, probability, wanted
            )
            for bit, (mine, true) in enumerate(zip(found, expected, strict=True)):
                if wanted >> bit & 1:
                    torch.testing.assert_close(mine, true, rtol=1e-9, atol=1e-10)
                else:
                    assert mine.numel() == 0


@dims
@pytest.mark.parametrize("probability", [False, True])
def test_gradcheck_passes_twice(ops, dim, probability):
    parameters = make_map(6, dim, torch.float64)
    points = make_points(5, dim, torch.float64) / 4
    inputs = [t.clone().requires_grad_() for t in (points, *parameters)]

    def answer(points, centers, raw, weights):
        index = ops.build_index(centers.detach(), 4)
        return ops.occupancy(points, centers, raw, weights, *kernel(4), index, probability)

    assert torch.autograd.gradcheck(answer, inputs)
    assert torch.autograd.gradgradcheck(answer, inputs)


def test_gradients_are_the_same_at_every_call(ops):
    parameters = make_map(700, 3, torch.float32)
    points = make_points(20_000, 3, torch.float32)
    grad = torch.ones(20_000)
    index = ops.build_index(parameters[0], 5)
    first, second = (
        ops.occupancy_backward(grad, points, *parameters, *kernel(5), index, True, 15)
        for _ in range(2)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def test_opcheck_accepts_the_operators(ops):
    parameters = make_map(12, 3, torch.float64)
    points = make_points(40, 3, torch.float64)
    index = ops.build_index(parameters[0], 5)
    tracked = [t.clone().requires_grad_() for t in (points, *parameters)]
    torch.library.opcheck(ops.occupancy.default, (*tracked, *kernel(5), index, True))
    torch.library.opcheck(ops.nearest.default, (points, parameters[0], 5, index))
    grad = torch.ones(40, dtype=torch.float64)
    arguments = (grad, points, *parameters, *kernel(5), index, False, 15)
    torch.library.opcheck(ops.occupancy_backward.default, arguments)
    torch.library.opcheck(ops.assign.default, (points, parameters[0], index, True))
    torch.library.opcheck(ops.build_index.default, (parameters[0], 5))
    given = (points, *parameters[:2], index)
    torch.library.opcheck(ops.nearest_features.default, (*given, *kernel(5)))
    lattice = (points.flatten()[:9], [2, 3, 4], *parameters, *kernel(5), index, True)
    torch.library.opcheck(ops.lattice_occupancy.default, lattice)
    rows = torch.arange(40).reshape(2, 20)
    torch.library.opcheck(ops.kmeans.default, (points, parameters[0], rows, 20, 5))
    torch.library.opcheck(ops.z_order.default, (points,))
    indices, values = ops.nearest_features(*given, *kernel(5))
    state = (grad, grad, parameters[2], *torch.zeros(2, 12, dtype=torch.float64))
    rates = (40, 10, 0, 4, 0.5, True, True, 0.0, 0.1)
    torch.library.opcheck(ops.descent.default, (indices, values, *state, *rates))


def test_compiled_functions_give_the_same(ops):
    parameters = make_map(40, 3, torch.float32)
    points = make_points(64, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)

    def loss(points, *parameters):
        return ops.occupancy(2 * points, *parameters, *kernel(5), index, True).sum()

    def gradients(function):
        inputs = [t.clone().requires_grad_() for t in (points, *parameters)]
        return torch.autograd.grad(function(*inputs), inputs)

    compiled = torch.compile(loss, backend="aot_eager", fullgraph=True)
    for mine, true in zip(gradients(compiled), gradients(loss), strict=True):
        torch.testing.assert_close(mine, true)
