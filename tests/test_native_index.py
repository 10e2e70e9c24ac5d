"""The index of the search is never stale; threads and processes get their own answers."""

import copy
import multiprocessing
import threading

import pytest
import torch
from native_maps import (
    assert_neighbors_exact,
    kernel,
    make_map,
    make_points,
)
from torch import Tensor

from lardhm_torch import LardHilbertMap, features


def test_a_stale_or_foreign_index_cannot_change_an_answer(ops):
    parameters = make_map(60, 3, torch.float32)
    points = make_points(200, 3, torch.float32)
    good = ops.build_index(parameters[0], 5)
    expected = ops.occupancy(points, *parameters, *kernel(5), good, False)
    nothing = torch.empty(0, dtype=torch.uint8)
    damaged = good.clone()
    damaged[45] += 1  # in the corner of the centers' box
    others = [
        nothing, good[:-1], good[:100], good[1:], damaged, torch.zeros_like(good),
        torch.randint(256, (5000,), dtype=torch.uint8),
        ops.build_index(parameters[0].double(), 5), ops.build_index(parameters[0][:, :2], 5),
        ops.build_index(parameters[0] + 1e-3, 5), ops.build_index(parameters[0][:-1], 5),
    ]  # fmt: skip
    for other in others:
        assert not ops.index_matches(other, parameters[0], 5)
        assert torch.equal(ops.occupancy(points, *parameters, *kernel(5), other, False), expected)
    assert ops.index_matches(good, parameters[0], 5)


def test_changing_the_centers_in_place_makes_the_index_stale(ops):
    parameters = make_map(60, 3, torch.float32)
    points = make_points(200, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    parameters[0].data[17, 2] += 1e-4
    assert not ops.index_matches(index, parameters[0], 5)
    parameters[0].data[:30] += 3
    fresh = ops.build_index(parameters[0], 5)
    stale = ops.occupancy(points, *parameters, *kernel(5), index, False)
    assert torch.equal(stale, ops.occupancy(points, *parameters, *kernel(5), fresh, False))


def test_one_index_serves_every_number_of_neighbors(ops):
    parameters = make_map(60, 3, torch.float32)
    points = make_points(200, 3, torch.float32)
    index = ops.build_index(parameters[0], 1)
    assert ops.index_matches(index, parameters[0], 30)
    assert_neighbors_exact(points, parameters[0], 30, ops.nearest(points, parameters[0], 30, index))


def test_several_threads_at_once_get_their_own_answers(ops):
    maps = [make_map(300, 3, torch.float32, seed) for seed in range(4)]
    points = make_points(20_000, 3, torch.float32)
    nothing = torch.empty(0, dtype=torch.uint8)
    expected = [ops.occupancy(points, *one, *kernel(5), nothing, True) for one in maps]
    found: dict[int, list[Tensor]] = {}

    def ask(which: int) -> None:
        found[which] = [
            ops.occupancy(points, *maps[which], *kernel(5), nothing, True) for _ in range(5)
        ]

    threads = [threading.Thread(target=ask, args=(which,)) for which in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert all(
        torch.equal(answer, expected[which]) for which in range(4) for answer in found[which]
    )


def test_the_number_of_torch_threads_does_not_change_a_bit(ops):
    parameters = make_map(300, 3, torch.float32)
    points = make_points(100_000, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    before = torch.get_num_threads()
    answers = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            answers.append(ops.occupancy(points, *parameters, *kernel(5), index, True))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(answer, answers[0]) for answer in answers)


def _answer_in_child(queue, points, parameters, index):
    answer = torch.ops.lardhm.occupancy(points, *parameters, *kernel(5), index, True)
    queue.put(answer[::1000].tolist())  # torch's own operators on many numbers would hang here


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_does_not_hang(ops):
    parameters = make_map(300, 3, torch.float32)
    points = make_points(50_000, 3, torch.float32)
    index = ops.build_index(parameters[0], 5)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        expected = ops.occupancy(points, *parameters, *kernel(5), index, True)[::1000].tolist()
        context = multiprocessing.get_context("fork")
        queue = context.SimpleQueue()
        child = context.Process(
            target=_answer_in_child, args=(queue, points, parameters, index), daemon=True
        )
        child.start()
        child.join(30)
        assert child.exitcode == 0, "the child hangs or died"
        assert queue.get() == expected
    finally:
        torch.set_num_threads(before)


# --- a map whose centers change under it ---


def small_map(seed: int = 0) -> LardHilbertMap:
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(seed))
    return LardHilbertMap(num_neighbors=4).fit(points, (points[:, 0] > 0).float(), 30, seed=seed)


def plain_answer(model: LardHilbertMap, points: Tensor) -> Tensor:
    """By the definition, without index and kernel."""
    local = points - model.origin.to(points)
    state = (model.centers, model.scale_tril, model.weights, model.num_neighbors)
    return torch.sigmoid(features.log_odds(local, *state)).detach()


def step_of_an_optimizer(model: LardHilbertMap, points: Tensor) -> None:
    model.centers.requires_grad_()
    optimizer = torch.optim.SGD([model.centers], lr=5.0)
    model.log_odds(points).sum().backward()
    optimizer.step()


def copy_in_place(model: LardHilbertMap, points: Tensor) -> None:
    with torch.no_grad():
        model.centers.copy_(model.centers.flip(0) + 0.2)


def edit_of_data(model: LardHilbertMap, points: Tensor) -> None:
    model.centers.data[3:9] += 0.5


def edit_in_inference_mode(model: LardHilbertMap, points: Tensor) -> None:
    with torch.inference_mode():
        model.centers.data.mul_(1.3)


def other_state(model: LardHilbertMap, points: Tensor) -> None:
    state = small_map(seed=1).state_dict()
    model.load_state_dict(state)


CHANGES = [step_of_an_optimizer, copy_in_place, edit_of_data, edit_in_inference_mode, other_state]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("inference", [False, True])
def test_a_map_answers_from_its_centers_as_they_are_now(ops, change, inference):
    model, points = small_map(), make_points(300, 3, torch.float32)
    with torch.inference_mode(inference):
        before = model(points).clone()
    change(model, points)
    with torch.inference_mode(inference):
        after = model(points).clone()
    assert not torch.equal(before, after)
    torch.testing.assert_close(after, plain_answer(model, points), rtol=1e-5, atol=1e-6)


def test_a_map_made_in_the_place_of_a_freed_one_answers_for_itself(ops):
    points = make_points(300, 3, torch.float32)
    for seed in range(6):
        model = small_map(seed)  # likely at the address of the one before
        answer = model(points).detach()
        torch.testing.assert_close(answer, plain_answer(model, points), rtol=1e-5, atol=1e-6)
        del model


def test_one_map_asked_by_two_threads_while_it_changes_answers_old_or_new(ops):
    model, points = small_map(), make_points(2000, 3, torch.float32)
    old = model(points).detach()
    fresh = copy.deepcopy(model)
    fresh.centers.data += 0.25
    new = fresh(points).detach()
    answers: list[Tensor] = []

    def ask() -> None:
        for _ in range(40):
            answers.append(model(points).detach())

    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    model.centers = torch.nn.Parameter(fresh.centers.detach().clone(), requires_grad=False)
    for thread in threads:
        thread.join(60)
    assert len(answers) == 80
    assert all(torch.equal(answer, old) or torch.equal(answer, new) for answer in answers)
    assert torch.equal(model(points).detach(), new)
