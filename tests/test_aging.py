"""Forgetting by age: time stamps of scans, and clusters that were not seen for long."""

import numpy as np
import pytest
import torch

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    load_scans,
    merge_maps,
    sample_rays,
    save_scans,
    stream_scans,
)
from lardhm_torch.cli import main
from lardhm_torch.learning.map_state import NEVER
from lardhm_torch.scans import concatenate_scans, every_scan

F64 = torch.float64


def wall_scan(side: int, seed: int = 0, rays: int = 1500) -> Scans:
    """A sensor at zero that sees a wall at x = 3 (side 1) or x = -3 (side -1)."""
    rng = torch.Generator().manual_seed(seed)
    across = 2 * torch.rand(rays, 2, generator=rng, dtype=F64) - 1
    ends = torch.cat([torch.full((rays, 1), 3.0 * side, dtype=F64), across], dim=1)
    return Scans(torch.zeros(1, 3, dtype=F64), ends, times=[10.0 * seed])


def seen(model: LardHilbertMap, scan: Scans, time: float | None, seed: int = 0) -> LardHilbertMap:
    samples = sample_rays(scan, seed=seed)
    return model.update(samples.points, samples.labels, seed=seed, time=time)


def on_wall(side: int) -> torch.Tensor:
    across = torch.linspace(-0.7, 0.7, 8, dtype=F64)
    grid = torch.cartesian_prod(torch.tensor([3.0 * side], dtype=F64), across, across)
    return grid


def test_what_was_not_seen_for_max_age_is_forgotten():
    model = LardHilbertMap()
    model.max_age = 60.0
    seen(model, wall_scan(-1), time=0.0)
    seen(model, wall_scan(1), time=10.0)
    assert model(on_wall(-1)).min() > 0.7
    size = len(model)
    for step in range(1, 8):
        seen(model, wall_scan(1, seed=step), time=10.0 + 10 * step, seed=step)
    assert model(on_wall(1)).min() > 0.7
    gone = model(on_wall(-1))
    assert (gone - 0.5).abs().max() < 0.2
    assert len(model) < size
    assert model.times.min() >= 80 - 60


def test_without_max_age_nothing_is_forgotten():
    model = LardHilbertMap()
    seen(model, wall_scan(-1), time=0.0)
    seen(model, wall_scan(1), time=1e9)
    assert model(on_wall(-1)).min() > 0.7
    assert model.times.min() == 0


def test_clusters_learned_without_a_time_stay_until_they_are_seen_with_one():
    model = seen(LardHilbertMap(), wall_scan(-1), time=None)
    assert (model.times == NEVER).all()
    model.max_age = 5.0
    seen(model, wall_scan(1), time=100.0)
    assert model(on_wall(-1)).min() > 0.7
    seen(model, wall_scan(-1, seed=3), time=101.0, seed=3)
    seen(model, wall_scan(1, seed=4), time=150.0, seed=4)
    assert (model(on_wall(-1)) - 0.5).abs().max() < 0.2


def test_older_scans_may_come_later():
    model = seen(LardHilbertMap(), wall_scan(1), time=100.0)
    seen(model, wall_scan(1, seed=1), time=50.0, seed=1)
    assert (model.times == 100).float().mean() > 0.8


@pytest.mark.parametrize(
    ("max_age", "time", "message"),
    [
        (60.0, None, "time must be given: the map forgets what it has not seen for 60 s"),
        (None, float("nan"), r"time must be finite \[s\]; got nan"),
        (0.0, 1.0, "max_age must be > 0 s and finite, or None; got 0"),
    ],
)
def test_bad_times_are_refused_and_the_map_stays(max_age, time, message):
    model = seen(LardHilbertMap(), wall_scan(1), time=0.0)
    before, model.max_age = model(on_wall(1)), max_age
    with pytest.raises(ValueError, match=message):
        seen(model, wall_scan(-1), time=time)
    assert torch.equal(model(on_wall(1)), before)


@pytest.mark.parametrize("suffix", [".pt", ".safetensors"])
def test_ages_are_saved_with_the_map_and_stay_float64(tmp_path, suffix):
    model = seen(LardHilbertMap(), wall_scan(1), time=1.7e9 + 0.25)
    model.max_age = 60.0
    model.save(tmp_path / f"m{suffix}")
    again = LardHilbertMap.load(tmp_path / f"m{suffix}")
    assert again.max_age == 60
    assert torch.equal(again.times, model.times)
    assert torch.equal(model.half().times, again.times)
    model = LardHilbertMap.load(tmp_path / f"m{suffix}")
    model.save(tmp_path / f"n{suffix}", evidence=False)
    assert (LardHilbertMap.load(tmp_path / f"n{suffix}").times == NEVER).all()


def test_merged_maps_have_the_later_times():
    first = seen(LardHilbertMap(), wall_scan(1), time=1.0)
    second = seen(LardHilbertMap(), wall_scan(1), time=2.0)
    merged = merge_maps(first, second)
    assert (merged.times[merged.is_occupied] == 2).all()


def test_a_stream_of_scans_with_times_forgets():
    model = LardHilbertMap()
    model.max_age = 25.0
    scans = [wall_scan(-1, 0), *(wall_scan(1, seed) for seed in range(1, 5))]
    stream_scans(model, scans)
    assert model.times.max() == 40
    assert (model(on_wall(-1)) - 0.5).abs().max() < 0.2


def test_times_of_scans_are_written_read_and_follow_their_scans(tmp_path):
    scans = concatenate_scans([wall_scan(1, seed) for seed in range(4)])
    assert scans.times.tolist() == [0, 10, 20, 30]
    save_scans(scans, tmp_path / "a.npz")
    again = load_scans(tmp_path / "a.npz")
    assert again.times.tolist() == [0, 10, 20, 30]
    assert every_scan(again, 2).times.tolist() == [0, 20]
    bare = Scans(scans.origins, scans.ends, scans.scan_id)
    assert concatenate_scans([bare, scans]).times.isnan().tolist() == 4 * [True] + 4 * [False]
    with pytest.raises(ValueError, match=r"times must be \(4,\), one per scan; got \(3,\)"):
        Scans(scans.origins, scans.ends, scans.scan_id, times=np.zeros(3))


def test_the_command_line_forgets_by_age(tmp_path, capsys):
    scans = concatenate_scans([wall_scan(-1, 0), *(wall_scan(1, seed) for seed in range(1, 5))])
    save_scans(scans, tmp_path / "a.npz")
    base = ["fit", str(tmp_path / "a.npz"), "-o", str(tmp_path / "m.pt"), "--max-age", "25"]
    assert main([*base, "--incremental"]) == 0
    model = LardHilbertMap.load(tmp_path / "m.pt")
    assert model.max_age == 25
    assert (model(on_wall(-1)) - 0.5).abs().max() < 0.2
    capsys.readouterr()
    assert main(base) == 1
    assert "--max-age needs --incremental" in capsys.readouterr().err
    save_scans(Scans(scans.origins, scans.ends, scans.scan_id), tmp_path / "b.npz")
    assert main([base[0], str(tmp_path / "b.npz"), *base[2:], "--incremental"]) == 1
    assert "time must be given" in capsys.readouterr().err
