"""Half precision, inference mode, autocast, the meta device and forked processes."""

import copy
import os
import signal
import time

import pytest
import torch
from small_maps import same_map, wall, wall_map

from lardhm_torch import LardHilbertMap, TuneConfig, fine_tune, merge_maps, raycast, signed_distance
from lardhm_torch.learning.changes import changes_map

HALVES = [torch.float16, torch.bfloat16]
POINTS, LABELS = wall()


@pytest.fixture(scope="module")
def fitted():
    return wall_map(dtype=torch.float32).fit_uncertainty(POINTS, LABELS)


@pytest.fixture
def model(fitted):
    return copy.deepcopy(fitted)


# --- half precision ---


@pytest.mark.parametrize("dtype", HALVES)
@pytest.mark.parametrize(
    "query", ["__call__", "log_odds", "variance", "bayesian_probability", "unknown", "features"]
)
def test_a_half_map_answers_as_float32_does_up_to_rounding(model, dtype, query):
    half = model.to(dtype)
    answer = getattr(half, query)(POINTS)
    expected = getattr(copy.deepcopy(half).float(), query)(POINTS)
    assert answer.dtype == dtype
    assert torch.equal(*(t.to_dense() for t in (answer, expected.to(dtype))))


@pytest.mark.parametrize("dtype", HALVES)
def test_queries_of_a_half_map_are_close_to_those_of_float32(model, dtype):
    half = model.to(dtype)
    whole = copy.deepcopy(half).float()
    axes = [torch.linspace(0, 2, 5)] * 3
    assert torch.equal(half.query_lattice(axes), whole.query_lattice(axes).to(dtype))
    distances = [signed_distance(each, POINTS) for each in (half, whole)]
    torch.testing.assert_close(*distances, atol=0.01, rtol=0.01)
    starts, ways = torch.tensor([[0.0, 1.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    ranges = [raycast(each, starts, ways, max_range=3.0) for each in (half, whole)]
    torch.testing.assert_close(*ranges, atol=0.02, rtol=0.0)


@pytest.mark.parametrize("dtype", HALVES)
def test_half_points_are_computed_in_float32(model, dtype):
    assert torch.equal(model(POINTS.to(dtype)), model(POINTS.to(dtype).double()))


@pytest.mark.parametrize("dtype", HALVES)
def test_gradients_of_a_half_map_are_those_of_float32(model, dtype):
    half, slopes = model.to(dtype), []
    for each in (half, copy.deepcopy(half).float()):
        inputs = POINTS.clone().requires_grad_()
        slopes.append(torch.autograd.grad(each.log_odds(inputs).sum(), inputs)[0])
    torch.testing.assert_close(*slopes)


CHANGES = {
    "fit": lambda model: model.fit(POINTS, LABELS, 20),
    "update": lambda model: model.update(POINTS, LABELS),
    "fit_uncertainty": lambda model: model.fit_uncertainty(POINTS, LABELS),
    "transform": lambda model: model.transform(torch.eye(3), torch.ones(3)),
    "crop": lambda model: model.crop(torch.ones(3), 1.5),
    "fine_tune": lambda model: fine_tune(model, POINTS, LABELS, config=TuneConfig(epochs=1)),
    "merge_maps": lambda model: merge_maps(model, model),
}


@pytest.mark.parametrize("name", CHANGES)
def test_changes_of_a_half_or_meta_map_are_refused_by_name(model, name):
    with pytest.raises(ValueError, match=f"float32 or float64 for {name}; got torch.float16"):
        CHANGES[name](copy.deepcopy(model).half())
    with pytest.raises(ValueError, match=f"must have values for {name}"):
        CHANGES[name](model.to("meta"))


# --- inference mode ---


def train(model):
    """One step of every kind of training."""
    model.requires_grad_(True)
    optimizer = torch.optim.Adam(model.parameters())
    model.log_odds(POINTS).square().mean().backward()
    optimizer.step()
    model.update(POINTS, LABELS)
    model.fit_uncertainty(POINTS, LABELS)
    fine_tune(model, POINTS, LABELS, config=TuneConfig(epochs=1))


@pytest.mark.parametrize("name", CHANGES)
def test_a_map_changed_in_inference_mode_can_train(model, name):
    with torch.inference_mode():
        changed = CHANGES[name](model)
        copied = CHANGES[name](copy.deepcopy(model))
    for each in (changed, copied):
        train(each if isinstance(each, LardHilbertMap) else model)


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_map_made_or_loaded_in_inference_mode_can_train(model, tmp_path, suffix):
    model.save(tmp_path / f"map{suffix}")
    with torch.inference_mode():
        loaded = LardHilbertMap.load(tmp_path / f"map{suffix}")
        made = LardHilbertMap()
    train(loaded)
    train(made.fit(POINTS, LABELS, 20))


# --- autocast ---


@pytest.mark.parametrize("name", ["fit", "update", "transform", "crop", "fit_uncertainty"])
def test_autocast_changes_no_result(model, name):
    expected = CHANGES[name](copy.deepcopy(model))
    with torch.autocast("cpu", torch.bfloat16):
        found = CHANGES[name](model)
        assert torch.equal(found(POINTS), expected(POINTS))
        assert found.log_odds(POINTS).dtype == torch.float32
    assert same_map(found, expected)


def test_a_change_inside_runs_without_autocast_and_inference_mode(model):
    @changes_map
    def look(model):
        return torch.is_autocast_enabled("cpu"), torch.is_inference_mode_enabled()

    with torch.autocast("cpu", torch.bfloat16), torch.inference_mode():
        assert look(model) == (False, False)


# --- meta device ---


def test_a_meta_map_answers_shapes_and_takes_values_later(model):
    state = copy.deepcopy(model.state_dict())
    meta = copy.deepcopy(model).to("meta")
    answer = meta(torch.zeros(4, 7, 3, device="meta"))
    assert (answer.is_meta, answer.shape, answer.dtype) == (True, (4, 7), torch.float32)
    for empty in (
        meta.to_empty(device="cpu"),
        LardHilbertMap(device="meta").to_empty(device="cpu"),
    ):
        empty.load_state_dict(state)
        assert torch.equal(empty(POINTS), model(POINTS))
    late = LardHilbertMap(device="meta")
    late.load_state_dict(state, assign=True)
    assert torch.equal(late(POINTS), model(POINTS))
    assert late.origin.dtype == torch.float64


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_a_meta_map_is_not_saved(model, tmp_path, suffix):
    with pytest.raises(ValueError, match="weights must have values to be saved"):
        model.to("meta").save(tmp_path / f"map{suffix}")
    assert not list(tmp_path.iterdir())


# --- fork ---


def exit_code_of_child(work, patience=60.0):
    """Exit code of a forked child; None if it hangs."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except BaseException:
            os._exit(1)
    end = time.monotonic() + patience
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_the_child_of_a_fork_after_use_does_not_hang(model):
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        torch.ones(1 << 20).sum()  # starts OpenMP, which would hang in the child
        many = POINTS.repeat(50, 1)
        expected = model(many)

        def work():
            assert torch.get_num_threads() == 1
            assert torch.equal(model(many), expected)
            model.update(POINTS, LABELS)
            assert torch.ones(1 << 20).sum() == 1 << 20

        assert exit_code_of_child(work) == 0
    finally:
        torch.set_num_threads(threads)
