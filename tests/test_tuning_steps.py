"""Steps of fine-tuning: the native pass equals plain torch, and plain torch equals torch.optim.Adam."""

import pytest
import torch

from lardhm_torch import native
from lardhm_torch.features import Kernel, nearest_centers
from lardhm_torch.learning.fitting import logistic_loss
from lardhm_torch.learning.tuning_steps import (
    Batches,
    Moving,
    Plan,
    Table,
    from_rows,
    plain_steps,
    to_rows,
    tuned_features,
    tuning_steps,
)

F64 = torch.float64
PLAN = Plan(num_points=600, batch_size=170, total_steps=40)


def problem(dim, num_neighbors, dtype=F64, clusters=30, seed=0):
    """Samples, neighbors and a table of random clusters; one is thinner than the floor."""
    rng = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=rng, dtype=F64).to(dtype)

    raw = 0.6 * (draw(clusters, dim, dim) - 0.5).tril() - 1.5 * torch.eye(dim, dtype=dtype)
    raw[0, 0, 0] = -9
    start = to_rows(6 * draw(clusters) - 3, draw(clusters, dim), raw)
    columns = start.shape[1]
    rates, penalties = 0.05 * draw(columns).double(), draw(columns).double()
    kernel = Kernel(num_neighbors, 4.0, 0.05)
    table = Table(start, 0.5 + draw(*start.shape), rates, penalties, kernel)
    points = draw(PLAN.num_points, dim)
    batches = Batches(points, (torch.arange(len(points)) % 2).to(dtype), draw(len(points)))
    near = nearest_centers(points, from_rows(start)[1], num_neighbors).int()
    moving = Moving(*(0.1 * draw(*start.shape) for _ in range(3)))
    return batches, near, table, moving


@pytest.mark.parametrize("num_neighbors", [1, 5, 16, 21, 30])
@pytest.mark.parametrize("dim", [2, 3])
def test_the_native_steps_are_those_of_plain_torch(ops, dim, num_neighbors):
    task = problem(dim, num_neighbors)
    torch.testing.assert_close(
        tuning_steps(*task, 7, PLAN), plain_steps(*task, 7, PLAN), rtol=1e-10, atol=1e-12
    )


@pytest.mark.parametrize(("dim", "num_neighbors"), [(2, 1), (3, 5), (2, 16), (3, 21), (3, 30)])
def test_features_after_tuning_are_those_of_plain_torch(ops, monkeypatch, dim, num_neighbors):
    batches, near, table, moving = problem(dim, num_neighbors)
    given = (batches.points, near, table, moving.offsets)
    fast = tuned_features(*given)
    monkeypatch.setattr(native, "supports", lambda *_: False)
    torch.testing.assert_close(fast, tuned_features(*given), rtol=1e-10, atol=1e-12)
    assert float(fast.max()) > 0.5


def test_features_before_tuning_are_those_of_the_map(ops):
    batches, _, table, moving = problem(3, 16)
    _, centers, raw = (part.contiguous() for part in from_rows(table.start))
    index = native.build_index(centers, 16)
    near, values = native.nearest_features(batches.points, centers, raw, table.kernel, index)
    found = tuned_features(batches.points, near, table, 0 * moving.offsets)
    torch.testing.assert_close(found, values)


def test_native_steps_in_float32_are_close(ops):
    task = problem(3, 16, torch.float32)
    close = {"rtol": 1e-3, "atol": 1e-5}
    torch.testing.assert_close(tuning_steps(*task, 7, PLAN), plain_steps(*task, 7, PLAN), **close)


def test_neighbors_at_equal_distances_share_the_gradient(ops):
    batches, _, table, moving = problem(2, 2, clusters=4)
    corners = torch.tensor([[0.0, 0], [1, 0], [0, 1], [1, 1]], dtype=F64)
    start = table.start.clone()
    start[:, 1:3] = corners
    table = table._replace(start=start, kernel=table.kernel._replace(num_neighbors=3))
    still = moving._replace(offsets=torch.zeros_like(start))
    middle = batches._replace(points=torch.full_like(batches.points, 0.5))
    near = torch.tensor([[0, 1, 3]]).int().repeat(PLAN.num_points, 1)
    task = (middle, near, table, still)
    torch.testing.assert_close(tuning_steps(*task, 0, PLAN), plain_steps(*task, 0, PLAN))


def test_plain_steps_are_those_of_the_optimizer_of_torch():
    batches, near, table, moving = problem(4, 5)
    moving = Moving(*map(torch.zeros_like, moving))
    ours = plain_steps(batches, near, table, moving, 0, PLAN).offsets
    offsets = torch.zeros_like(table.start).requires_grad_()
    optimizer = torch.optim.Adam([offsets], lr=1.0, betas=(0.9, 0.99))
    columns = (*batches, near.long())
    parts = zip(*(column.split(PLAN.batch_size) for column in columns), strict=True)
    for step, (points, labels, factors, indices) in enumerate(parts):
        before = offsets.detach().clone()
        weights, centers, raw = table.parameters(offsets)
        diagonal = raw.diagonal(dim1=1, dim2=2).exp().clamp(min=table.kernel.min_lengthscale)
        factor = 2.0 * (raw.tril(-1) + torch.diag_embed(diagonal))  # the root of the scale, 4
        away = points[:, None] - centers[indices]
        z = torch.linalg.solve_triangular(factor[indices], away[..., None], upper=False)[..., 0]
        far = away.square().sum(dim=2)
        u = (2 * (1 - far / far.amax(dim=1, keepdim=True))).clamp(max=1)
        value = torch.exp(-0.5 * z.square().sum(dim=2)) * (3 * u**2 - 2 * u**3)
        loss = logistic_loss((value * weights[indices]).sum(dim=1), labels, factors) / len(labels)
        moved = torch.cat([weights[:, None], offsets[:, 1:]], dim=1)
        loss = loss + (table.penalties * moved.square()).sum() / PLAN.num_points
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        with torch.no_grad():  # learning rates by column, with the schedule
            rates = table.rates * PLAN.rate_fraction(step)
            offsets.copy_(before + rates * (offsets - before))
    torch.testing.assert_close(ours, offsets.detach())


def test_rows_hold_all_parameters():
    raw = torch.randn(5, 4, 4, dtype=F64).tril()
    parameters = (torch.randn(5, dtype=F64), torch.randn(5, 4, dtype=F64), raw)
    for ours, back in zip(parameters, from_rows(to_rows(*parameters)), strict=True):
        assert torch.equal(ours, back)


def test_the_learning_rate_warms_up_and_falls_to_zero():
    rates = [PLAN.rate_fraction(step) for step in range(41)]
    assert rates[0] == pytest.approx(1 / 20)
    assert rates[19] == max(rates) == pytest.approx(1 - 19 / 40)
    assert rates[40] == 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda b, n, t, m: (b, n + 30, t, m), "index out of range"),
        (lambda b, n, t, m: (b, n - 1, t, m), "index out of range"),
        (lambda b, n, t, m: (b, n[:9], t, m), "indices must be"),
        (lambda b, n, t, m: (b._replace(labels=b.labels[:9]), n, t, m), "labels and factors must"),
        (lambda b, n, t, m: (b, n, t._replace(rates=t.rates[:3]), m), "rates and penalties must"),
        (lambda b, n, t, m: (b, n, t, m._replace(mean=m.mean[:4])), "must be like start"),
        (lambda b, n, t, m: (b._replace(points=b.points[:, :2]), n, t, m), "start must be"),
    ],
)
def test_the_native_steps_refuse_tensors_that_do_not_fit(ops, change, message):
    with pytest.raises(RuntimeError, match=message):
        tuning_steps(*change(*problem(3, 5)), 0, PLAN)


def test_steps_without_the_native_library_serve_any_dimension():
    task = problem(5, 6)
    assert not native.supports(task[0].points)
    after = tuning_steps(*task, 0, PLAN)
    assert after.offsets.isfinite().all()
    assert not torch.equal(after.offsets, task[3].offsets)
