"""Readers beside one writer: every answer is that of the map before or after a change."""

import copy
import pickle
import threading
from contextlib import contextmanager

import pytest
import torch

from lardhm_torch import LardHilbertMap, extract_mesh, raycast, signed_distance
from lardhm_torch.learning.map_lock import MapLock

POINTS = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 4


def fitted_map(num_clusters, seed=0):
    points = torch.rand(2000, 3, generator=torch.Generator().manual_seed(seed)) * 4
    return LardHilbertMap().fit(points, (points[:, 2] < 1).float(), num_clusters, seed=seed)


@pytest.fixture(scope="module")
def states():
    """State dicts of two maps of different sizes, far apart in their answers."""
    maps = [fitted_map(num_clusters=n, seed=n) for n in (40, 90)]
    with torch.no_grad():
        maps[1].weights.neg_()
    return [copy.deepcopy(model.state_dict()) for model in maps]


@contextmanager
def writer(model, states):
    """A thread that gives the map one state after the other."""
    stop = threading.Event()

    def write():
        turn = 0
        while not stop.is_set():
            model.load_state_dict(states[turn % 2])
            turn += 1

    thread = threading.Thread(target=write)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def rays(model):
    origins = torch.full((20, 3), 2.0, dtype=torch.float64)
    return raycast(model, origins, POINTS[:20] - 2.0, max_range=5.0)


QUESTIONS = {
    "probability": lambda model: model(POINTS),
    "features": lambda model: model.features(POINTS).to_dense().sum(dim=1),
    "lattice": lambda model: model.query_lattice([torch.linspace(0, 4, 5)] * 3),
    "rays": rays,
    "distance": lambda model: signed_distance(model, POINTS[:50], max_distance=1.0),
    "mesh": lambda model: torch.tensor(extract_mesh(model, resolution=0.5).vertices),
    "two questions": lambda model: torch.cat(two_answers(model)),
}


def two_answers(model):
    with model.reading():
        return model(POINTS), model.log_odds(POINTS)


def is_equal(answer, other):
    return answer.shape == other.shape and torch.allclose(answer, other, equal_nan=True)


@pytest.mark.parametrize("name", QUESTIONS)
def test_answers_beside_a_writer_are_those_of_one_of_the_two_maps(states, name):
    ask = QUESTIONS[name]
    expected = [ask(LardHilbertMap.from_state(copy.deepcopy(state))) for state in states]
    model = LardHilbertMap.from_state(copy.deepcopy(states[0]))
    errors = []

    def read():
        for _ in range(4):
            answer = ask(model)
            if not any(is_equal(answer, other) for other in expected):
                errors.append(answer)

    readers = [threading.Thread(target=read) for _ in range(3)]
    with torch.no_grad(), writer(model, states):
        for thread in readers:
            thread.start()
        for thread in readers:
            thread.join()
    assert not errors


def test_files_written_beside_a_writer_hold_one_of_the_two_maps(states, tmp_path):
    expected = [LardHilbertMap.from_state(copy.deepcopy(state))(POINTS) for state in states]
    model = LardHilbertMap.from_state(copy.deepcopy(states[0]))
    with torch.no_grad(), writer(model, states):
        for turn in range(8):
            model.save(tmp_path / f"{turn}.pt")
    for turn in range(8):
        answer = LardHilbertMap.load(tmp_path / f"{turn}.pt")(POINTS)
        assert any(torch.equal(answer, e) for e in expected)


def test_updates_of_two_threads_take_turns():
    model = fitted_map(num_clusters=40)
    labels = (POINTS[:, 0] > 2).float()
    one_by_one = copy.deepcopy(model)
    for _ in range(4):
        one_by_one.update(POINTS, labels)
    threads = [threading.Thread(target=model.update, args=(POINTS, labels)) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert torch.equal(model(POINTS), one_by_one(POINTS))


def test_a_thread_that_reads_the_map_must_not_change_it():
    model = fitted_map(num_clusters=40)
    with model.reading(), pytest.raises(RuntimeError, match=r"inside `with map.reading\(\)`"):
        model.update(POINTS, torch.ones(len(POINTS)))
    model.update(POINTS, torch.ones(len(POINTS)))


def test_copies_of_a_map_that_is_read_can_be_changed():
    model = fitted_map(num_clusters=40)
    with model.reading():
        for other in (copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
            other.update(POINTS, torch.ones(len(POINTS)))


def test_a_waiting_writer_comes_before_new_readers():
    lock, order = MapLock(), []

    def write():
        with lock.writing():
            order.append("writer")

    def read():
        with lock.reading():
            order.append("reader")

    threads = [threading.Thread(target=write), threading.Thread(target=read)]
    with lock.reading():
        threads[0].start()
        while not lock._waiting:
            pass
        threads[1].start()
        with lock.reading():  # nested reading does not wait for the writer
            assert order == []
    for thread in threads:
        thread.join()
    assert order == ["writer", "reader"]


def test_a_busy_writer_does_not_keep_readers_waiting():
    lock, stop, turns = MapLock(), threading.Event(), []

    def write():
        while not stop.is_set():
            with lock.writing():
                turns.append(1)

    thread = threading.Thread(target=write)
    thread.start()
    try:
        while not turns:
            pass
        for _ in range(20):
            with lock.reading():
                before = len(turns)
                assert len(turns) == before
    finally:
        stop.set()
        thread.join()
