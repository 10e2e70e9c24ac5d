"""Transforms of torch.func, forward mode and exported programs, against finite differences."""

import subprocess
import sys

import pytest
import torch
from small_maps import wall
from torch.autograd import forward_ad
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vmap

from lardhm_torch import LardHilbertMap, native

pytestmark = pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated")  # in jvp itself
STEP = 1e-6  # [m] of the finite differences


@pytest.fixture(scope="module", params=[2, 3, 4])  # 4-D maps never use the native kernel
def model(request):
    points, labels = wall(dim=request.param)
    return LardHilbertMap(request.param, dtype=torch.float64).fit(points, labels, num_clusters=40)


@pytest.fixture
def points(model):
    return wall(count=6, dim=model.dim, seed=5)[0]


def slopes_of(model, points):
    """(N, D) finite differences of the log-odds."""
    steps = STEP * torch.eye(model.dim, dtype=torch.float64)
    with torch.no_grad():
        rise = [model.log_odds(points + step) - model.log_odds(points - step) for step in steps]
    return torch.stack(rise, dim=1) / (2 * STEP)


def curvatures_of(model, point):
    """(D, D) finite differences of the gradient at a point (D,)."""
    rows = []
    for step in STEP * torch.eye(model.dim, dtype=torch.float64):
        ends = (point + step).requires_grad_(), (point - step).requires_grad_()
        rise = [torch.autograd.grad(model.log_odds(end), end)[0] for end in ends]
        rows.append((rise[0] - rise[1]) / (2 * STEP))
    return torch.stack(rows)


def close(found, expected):
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


TRANSFORMS = {
    "grad": lambda f, x: grad(lambda x: f(x).sum())(x),
    "vmap of grad": lambda f, x: vmap(grad(f))(x),
    "jacrev": lambda f, x: torch.stack([jacrev(f)(row) for row in x]),
    "jacfwd": lambda f, x: torch.stack([jacfwd(f)(row) for row in x]),
    "vmap of jacfwd": lambda f, x: vmap(jacfwd(f))(x),
    "jvp": lambda f, x: torch.stack([jvp(f, (x,), (s.expand_as(x),))[1] for s in unit(x)], dim=1),
    "dual": lambda f, x: torch.stack([dual(f, x, s.expand_as(x)) for s in unit(x)], dim=1),
}


def unit(points):
    return torch.eye(points.shape[1], dtype=points.dtype)


def dual(function, points, tangents):
    with forward_ad.dual_level():
        return forward_ad.unpack_dual(function(forward_ad.make_dual(points, tangents))).tangent


@pytest.mark.parametrize("trained", [False, True])
@pytest.mark.parametrize("name", TRANSFORMS)
def test_first_derivatives_by_points_are_those_of_finite_differences(model, points, name, trained):
    model.requires_grad_(trained)
    close(TRANSFORMS[name](model.log_odds, points), slopes_of(model, points))


def test_hessians_are_those_of_finite_differences(model, points):
    expected = torch.stack([curvatures_of(model, point) for point in points[::3]])
    close(vmap(hessian(model.log_odds))(points[::3]), expected)


def test_derivatives_by_parameters_are_those_of_autograd(model, points):
    model.requires_grad_(True)
    parameters = {name: value.detach() for name, value in model.named_parameters()}

    def answer(parameters, points):
        return functional_call(model, parameters, (points,))

    expected = torch.autograd.grad(model(points).sum(), list(model.parameters()))
    found = grad(lambda parameters: answer(parameters, points).sum())(parameters)
    close(tuple(found.values()), expected)
    of_points = vmap(grad(answer), in_dims=(None, 0))(parameters, points)
    close(tuple(value.sum(dim=0) for value in of_points.values()), expected)
    ones = {name: torch.ones_like(value) for name, value in parameters.items()}
    pushed = jvp(lambda parameters: answer(parameters, points), (parameters,), (ones,))[1]
    close(pushed.sum(), sum(value.sum() for value in expected))


def test_an_ensemble_of_maps_is_answered_as_each_of_them(model, points):
    own = {name: value.detach() for name, value in model.named_parameters()}
    parameters = {name: torch.stack([value, 1.1 * value]) for name, value in own.items()}
    found = vmap(lambda one: functional_call(model, one, (points,)))(parameters)
    for row, answer in enumerate(found):
        one = {name: value[row] for name, value in parameters.items()}
        close(answer, functional_call(model, one, (points,)))
    each = vmap(lambda one, x: functional_call(model, one, (x,)), in_dims=(0, 1), out_dims=1)
    close(each(parameters, points[:, None].expand(-1, 2, -1)), found.T)


def test_transforms_leave_the_index_of_the_map_in_place(model, points):
    model(points)
    before = model._index
    vmap(grad(model.log_odds))(points)
    model(points)
    assert model._index is before


@pytest.mark.parametrize("model", [3], indirect=True)
def test_transforms_of_compiled_and_exported_maps_are_right(model, points):
    model.requires_grad_(False)
    expected = slopes_of(model, points).sum(dim=1)
    ones = torch.ones_like(points)
    compiled = torch.compile(
        lambda x: jvp(model.log_odds, (x,), (ones,))[1], backend="aot_eager", fullgraph=True
    )
    close(compiled(points), expected)
    exported = torch.export.export(model, (points,)).module()
    probability = model(points)
    close(jvp(exported, (points,), (ones,))[1], expected * probability * (1 - probability))
    close(
        grad(lambda x: exported(x).sum())(points).sum(dim=1),
        expected * probability * (1 - probability),
    )


LOAD = """
{imports}
for dim in (3, 4):
    points, expected = torch.load(f"answers{{dim}}.pt")
    program = torch.export.load(f"map{{dim}}.pt2").module()
    torch.testing.assert_close(program(points), expected)
    inputs = points.clone().requires_grad_()
    assert torch.autograd.grad(program(inputs).sum(), inputs)[0].abs().sum() > 0
"""
TORCH_LAST = "import lardhm_torch, importlib.util\nimportlib.util.find_spec('torch')\nimport torch"
TORCH_FIRST = "import torch, lardhm_torch"


def test_an_exported_map_loads_in_a_new_process(tmp_path, monkeypatch):
    for dim in (3, 4):
        points, labels = wall(dim=dim)
        model = LardHilbertMap(dim).fit(points, labels, num_clusters=40)
        torch.export.save(torch.export.export(model, (points,)), tmp_path / f"map{dim}.pt2")
        torch.save((points, model(points).detach()), tmp_path / f"answers{dim}.pt")
    for kernel, imports in (("1", TORCH_LAST), ("0", TORCH_FIRST)):
        monkeypatch.setenv("LARDHM_NATIVE", kernel)
        command = [sys.executable, "-c", LOAD.format(imports=imports)]
        subprocess.run(command, check=True, cwd=tmp_path)


def test_the_kernel_is_what_these_tests_are_about(ops):
    assert native.supports(torch.zeros(1, 3))
    assert grad(lambda x: x.sum() * native.supports(x))(torch.zeros(1, 3)).eq(0).all()
