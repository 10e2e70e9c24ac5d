import sys

import pytest
import torch

from lardhm_torch.evaluation.baselines.octomap import OctoMapBaseline
from lardhm_torch.evaluation.held_out import evaluate
from lardhm_torch.scans import Scans, split_rays

UTM = torch.tensor([5e5, 4.5e6, 100.0], dtype=torch.float64)


@pytest.fixture
def octomap():
    return pytest.importorskip("octomap", reason="octomap-python is not installed (extra octomap)")


def wall_scan(shift: torch.Tensor | None = None) -> Scans:
    """A wall at x = 3.04 m, seen from the origin through rays 5 cm apart."""
    side = torch.arange(-1, 1.01, 0.05, dtype=torch.float64) + 0.02
    ends = torch.cartesian_prod(torch.tensor([3.04], dtype=torch.float64), side, side)
    origin = torch.full((1, 3), 0.02, dtype=torch.float64)
    move = torch.zeros(3) if shift is None else shift
    return Scans(origin + move, ends + move)


PLACES = torch.tensor([[3.04, 0.02, 0.02], [1.5, 0.02, 0.02], [5.0, 0.02, 0.02]]).double()


def test_one_scan_of_a_wall_gives_one_hit_one_miss_and_unknown_behind(octomap):
    model = OctoMapBaseline(0.1).fit(wall_scan())
    hit, free, behind = model.probability(PLACES).tolist()
    assert hit == pytest.approx(0.7)  # each voxel is updated once a scan
    assert free == pytest.approx(0.4)
    assert behind == 0.5


def test_scans_are_inserted_one_by_one_each_from_its_own_place(octomap):
    one = wall_scan()
    two = Scans(one.origins.repeat(2, 1), one.ends.repeat(2, 1), torch.arange(2).repeat(len(one)))
    hit, free, _ = OctoMapBaseline(0.1).fit(two).probability(PLACES).tolist()
    assert hit == pytest.approx(0.49 / (0.49 + 0.09))  # two hits of odds 7 : 3
    assert free == pytest.approx(0.16 / (0.16 + 0.36))


def test_far_from_zero_the_answers_are_the_same(octomap):
    here = OctoMapBaseline(0.1).fit(wall_scan()).probability(PLACES)
    there = OctoMapBaseline(0.1).fit(wall_scan(UTM)).probability(PLACES + UTM)
    assert torch.equal(here, there)


def test_later_returns_and_beams_without_return_are_not_inserted(octomap):
    scan = wall_scan()
    is_return = torch.ones(len(scan), dtype=torch.bool)
    is_return[::2] = False
    target_index = torch.ones(len(scan), dtype=torch.long)
    target_index[::3] = 2
    marked = Scans(scan.origins, scan.ends, scan.scan_id, is_return, target_index)
    kept = scan.select(is_return & (target_index == 1))
    everywhere = torch.cat([scan.ends, 0.5 * scan.ends])
    assert torch.equal(
        OctoMapBaseline(0.1).fit(marked).probability(everywhere),
        OctoMapBaseline(0.1).fit(kept).probability(everywhere),
    )


def test_points_that_differ_by_less_than_float32_have_the_same_voxel(octomap):
    ahead = wall_scan()
    both = Scans(ahead.origins, torch.cat([ahead.ends, ahead.ends * torch.tensor([-1, 1, 1])]))
    model = OctoMapBaseline(0.1).fit(both)
    assert torch.equal(model.origin, torch.zeros(3, dtype=torch.float64))
    # 3.0 m is a border between free and occupied voxels
    beside = torch.tensor([[3 - 1e-8, 0.02, 0.02], [3 + 1e-8, 0.02, 0.02]], dtype=torch.float64)
    assert model.probability(beside).tolist() == pytest.approx([0.7, 0.7])


def test_it_is_evaluated_like_a_map(octomap):
    train, test = split_rays(wall_scan(), 0.5)
    scores = evaluate(OctoMapBaseline(0.1).fit(train), test)["unif"]
    assert scores["free_rate"] > 0.9
    assert scores["hit_rate"] > 0.5


def test_fitting_again_forgets_what_was_inserted_before(octomap):
    model = OctoMapBaseline(0.1).fit(wall_scan()).fit(wall_scan())
    assert float(model.probability(PLACES)[0]) == pytest.approx(0.7)


def test_what_octomap_cannot_do_is_refused(octomap):
    with pytest.raises(ValueError, match=r"resolution must be > 0 m.*got -1"):
        OctoMapBaseline(-1)
    with pytest.raises(ValueError, match=r"scans must be 3-D.*got 2-D"):
        OctoMapBaseline().fit(Scans(torch.zeros(1, 2), torch.ones(4, 2)))
    with pytest.raises(ValueError, match="at least one first return; got none of 2"):
        OctoMapBaseline().fit(Scans(torch.zeros(1, 3), torch.full((2, 3), torch.nan)))
    with pytest.raises(RuntimeError, match=r"call fit\(scans\) first"):
        OctoMapBaseline().probability(PLACES)
    with pytest.raises(ValueError, match=r"points must be \(N, 3\); got \(3,\)"):
        OctoMapBaseline().fit(wall_scan()).probability(PLACES[0])


def test_without_the_library_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "octomap", None)
    with pytest.raises(ImportError, match=r"lardhm_torch\[octomap\]"):
        OctoMapBaseline().fit(wall_scan())
