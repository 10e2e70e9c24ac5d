"""Threads that query one map, beside one that updates a copy of it; `make sanitize` watches them."""

import copy
import threading

import pytest
import torch

from lardhm_torch import LardHilbertMap, raycast, sample_rays, simulate_room

READERS, ROUNDS = 3, 4


@pytest.fixture
def one_thread():
    """Torch's own threads are off: their library is not instrumented."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def answers(model: LardHilbertMap, points: torch.Tensor) -> list[torch.Tensor]:
    asked = points.clone().requires_grad_()
    (slope,) = torch.autograd.grad(model.log_odds(asked).sum(), asked)
    ahead = torch.nn.functional.normalize(points[:50] + 1, dim=1)
    return [model(points).detach(), slope, raycast(model, points[:50], ahead, 5.0)]


def test_readers_beside_a_writer_of_a_copy_get_what_they_get_alone(ops, one_thread):
    samples = sample_rays(simulate_room(num_rays=600, seed=0), seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels, num_clusters=60)
    points = samples.points[:1500]
    alone = answers(model, points)
    failures: list[BaseException] = []
    written: list[LardHilbertMap] = []

    def read() -> None:
        for _ in range(ROUNDS):
            for found, expected in zip(answers(model, points), alone, strict=True):
                torch.testing.assert_close(found, expected, rtol=0, atol=0, equal_nan=True)

    def write() -> None:
        copied = copy.deepcopy(model)
        for _ in range(ROUNDS):
            copied.update(points + 0.1, samples.labels[:1500])
        written.append(copied)

    def run(work) -> None:
        try:
            work()
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=run, args=(work,)) for work in [read] * READERS + [write]]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert failures == []
    assert not torch.equal(written[0](points), alone[0])
