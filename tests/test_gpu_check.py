"""The GPU check, tried on the CPU."""

import sys
from pathlib import Path

import pytest
import torch

from lardhm_torch import LardHilbertMap

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
gpu_check = pytest.importorskip("gpu_check")


def small_map():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(400, 3, generator=rng, dtype=torch.float64)
    labels = (points[:, 0] > 0.5).double()
    return LardHilbertMap(dtype=torch.float64).fit(points, labels, 20), points


def test_without_a_gpu_it_says_why_it_is_skipped(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_check.py"])
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert gpu_check.main() == 0
    assert "skipped: no GPU" in capsys.readouterr().out


def test_equal_answers_pass_and_others_fail(monkeypatch):
    model, points = small_map()
    cpu = torch.device("cpu")
    rows = gpu_check.value_rows(model, points, cpu)
    assert all(row["passed"] for row in rows)
    assert {"log-odds, float64", "gradient of centers, float32"} <= {row["check"] for row in rows}
    original, calls = gpu_check.answers, []

    def wrong_the_second_time(*given):
        calls.append(given)
        found = original(*given)
        return {name: value * (1 + 0.01 * (len(calls) % 2 == 0)) for name, value in found.items()}

    monkeypatch.setattr(gpu_check, "answers", wrong_the_second_time)
    assert not any(row["passed"] for row in gpu_check.value_rows(model, points, cpu))


def test_tensors_on_another_device_are_found_with_the_line_that_made_them():
    model, points = small_map()
    with gpu_check.DeviceWatch(torch.device("cpu")) as here:
        model(points)
    assert not here.found
    with gpu_check.DeviceWatch(torch.device("meta")) as elsewhere:
        model.features(points)
    assert any("map_queries.py:" in line for line in elsewhere.found)
    with gpu_check.DeviceWatch(torch.device("meta")) as settings:
        torch.ones(gpu_check.SMALL - 1)
    assert not settings.found
