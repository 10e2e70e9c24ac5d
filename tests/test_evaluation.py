import math

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.metrics import brier_score_loss, log_loss, roc_auc_score

from lardhm_torch.evaluation.calibration import calibration_error, draw_reliability, reliability
from lardhm_torch.evaluation.held_out import (
    answer_held_out,
    evaluate,
    held_out_points,
    protocol_rays,
    reliability_held_out,
)
from lardhm_torch.evaluation.mesh_distances import mesh_metrics
from lardhm_torch.evaluation.scores import format_metrics, occupancy_metrics
from lardhm_torch.scans import Scans

UTM = torch.tensor([5e5, 4.5e6, 100.0], dtype=torch.float64)


def sphere_scan(num_rays: int = 500, seed: int = 0, shift: torch.Tensor | None = None) -> Scans:
    """Rays of 0.5 m to 20 m in all directions from two places."""
    rng = torch.Generator().manual_seed(seed)
    directions = torch.randn(num_rays, 3, generator=rng, dtype=torch.float64)
    directions /= torch.linalg.vector_norm(directions, dim=1, keepdim=True)
    origins = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 0.5]], dtype=torch.float64)
    if shift is not None:
        origins = origins + shift
    scan_id = torch.arange(num_rays) % 2
    ranges = 0.5 + 19.5 * torch.rand(num_rays, 1, generator=rng, dtype=torch.float64)
    return Scans(origins, origins[scan_id] + ranges * directions, scan_id)


def along_x(*ranges: float, **columns: torch.Tensor) -> Scans:
    ends = torch.tensor([[r, 0.0, 0.0] for r in ranges], dtype=torch.float64)
    return Scans(torch.zeros(1, 3), ends, **columns)


def random_probabilities(seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    on_hits = torch.rand(300, generator=rng, dtype=torch.float64) ** 0.5
    on_free = torch.rand(200, generator=rng, dtype=torch.float64) ** 2
    return on_hits, on_free


def test_only_first_returns_between_30_cm_and_60_m_are_test_rays():
    scans = along_x(
        0.2,
        1.0,
        2.0,
        3.0,
        61.0,
        math.nan,
        is_return=torch.tensor([1, 1, 0, 1, 1, 1]).bool(),
        target_index=torch.tensor([1, 1, 1, 2, 1, 1]),
    )
    assert protocol_rays(scans).ends[:, 0].tolist() == [1.0]


def test_a_subset_of_the_rays_is_seeded_and_keeps_their_order():
    scans = along_x(*range(1, 51))
    some = protocol_rays(scans, max_rays=20, seed=3)
    assert len(some) == 20
    assert some.ends[:, 0].diff().min() > 0
    assert torch.equal(some.ends, protocol_rays(scans, max_rays=20, seed=3).ends)
    assert not torch.equal(some.ends, protocol_rays(scans, max_rays=20, seed=4).ends)
    assert len(protocol_rays(scans, max_rays=60)) == 50


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1), far=st.booleans())
def test_free_test_points_lie_on_their_ray_in_their_stretch_of_it(seed, far):
    scans = sphere_scan(seed=seed, shift=UTM if far else None)
    points = held_out_points(scans, seed)
    assert torch.equal(points.hits, scans.ends)
    limits = {
        "unif": (torch.zeros_like(scans.ranges), scans.ranges - 0.2),
        "near": ((scans.ranges - 0.6).clamp(min=0), scans.ranges - 0.2),
        "paper": (torch.zeros_like(scans.ranges), 0.95 * scans.ranges),
    }
    directions = (scans.ends - scans.ray_origins) / scans.ranges[:, None]
    for kind, (start, end) in limits.items():
        offsets = getattr(points, kind) - scans.ray_origins
        depth = (offsets * directions).sum(dim=1)
        torch.testing.assert_close(offsets, depth[:, None] * directions, atol=1e-8, rtol=0)
        assert (depth >= start - 1e-8).all()
        assert (depth <= end + 1e-8).all()


def test_free_test_points_fill_their_stretch_evenly():
    scans = along_x(*[10.0] * 20_000)
    points = held_out_points(scans)
    for kind, start, end in (("unif", 0, 9.8), ("near", 9.4, 9.8), ("paper", 0, 9.5)):
        share = (getattr(points, kind)[:, 0] - start) / (end - start)
        quartiles = share.quantile(torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64))
        # 20,000 uniform numbers: their quartiles have a standard deviation of 0.0035 at most
        expected = torch.tensor([0.25, 0.5, 0.75], dtype=torch.float64)
        torch.testing.assert_close(quartiles, expected, atol=0.02, rtol=0)


def test_test_points_follow_the_seed():
    scans = sphere_scan()
    assert torch.equal(held_out_points(scans, 1).near, held_out_points(scans, 1).near)
    assert not torch.equal(held_out_points(scans, 1).near, held_out_points(scans, 2).near)


def test_scores_of_four_points_worked_out_by_hand():
    scores = occupancy_metrics(torch.tensor([0.9, 0.5, 0.2]), torch.tensor([0.1]))
    assert scores["hit_rate"] == pytest.approx(1 / 3)
    assert scores["free_rate"] == 1
    assert scores["balanced_accuracy"] == pytest.approx(2 / 3)
    assert scores["accuracy"] == pytest.approx(2 / 4)
    assert scores["auc"] == 1
    assert scores["unknown"] == 0.25
    on_hits = -(math.log(0.9) + math.log(0.5) + math.log(0.2)) / 3
    assert scores["log_loss"] == pytest.approx(0.5 * (on_hits - math.log(0.9)))
    assert scores["brier"] == pytest.approx(0.5 * ((0.01 + 0.25 + 0.64) / 3 + 0.01))


def test_a_perfect_answer_scores_perfectly():
    scores = occupancy_metrics(torch.ones(7), torch.zeros(5))
    ones = ("balanced_accuracy", "accuracy", "hit_rate", "free_rate", "auc")
    assert [scores[name] for name in ones] == [1] * 5
    assert scores["log_loss"] == pytest.approx(1e-6, rel=1e-3)  # the clip
    assert scores["brier"] == scores["unknown"] == 0
    assert scores["ece"] == pytest.approx(0, abs=1e-12)


def test_a_wrong_answer_with_certainty_costs_the_clipped_log_loss():
    scores = occupancy_metrics(torch.zeros(3), torch.ones(3))
    assert scores["log_loss"] == pytest.approx(-math.log(1e-6))
    assert scores["auc"] == scores["balanced_accuracy"] == 0
    assert scores["brier"] == pytest.approx(1)
    assert scores["ece"] == pytest.approx(1)


def test_never_knowing_is_wrong_for_accuracy_and_a_coin_for_the_rest():
    scores = occupancy_metrics(torch.full((40,), 0.5), torch.full((10,), 0.5))
    assert scores["balanced_accuracy"] == scores["accuracy"] == 0
    assert scores["unknown"] == 1
    assert scores["auc"] == 0.5
    assert scores["log_loss"] == pytest.approx(math.log(2))
    assert scores["brier"] == pytest.approx(0.25)
    assert scores["ece"] == pytest.approx(0, abs=1e-12)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1))
def test_scores_agree_with_scikit_learn(seed):
    on_hits, on_free = random_probabilities(seed)
    scores = occupancy_metrics(on_hits, on_free)
    p, labels = torch.cat([on_hits, on_free]), [1] * 300 + [0] * 200
    shares = [1 / 600] * 300 + [1 / 400] * 200
    assert scores["auc"] == pytest.approx(roc_auc_score(labels, p))
    assert scores["brier"] == pytest.approx(brier_score_loss(labels, p, sample_weight=shares))
    clipped = p.clamp(1e-6, 1 - 1e-6)
    assert scores["log_loss"] == pytest.approx(log_loss(labels, clipped, sample_weight=shares))


def test_a_calibrated_answer_has_no_calibration_error_and_a_bold_one_has():
    rng = torch.Generator().manual_seed(0)
    p = torch.rand(200_000, generator=rng, dtype=torch.float64)
    labels = (torch.rand(200_000, generator=rng, dtype=torch.float64) < p).double()
    mass = torch.full_like(p, 1 / len(p))
    # 15 bins of 13,000 points: the share of one is known to 0.004
    assert calibration_error(p, labels, mass) < 0.006
    bold = (p > 0.5).double()
    # 0.25 in each bin but the one in the middle, where half is 0 and half is 1
    assert float(calibration_error(bold, labels, mass)) == pytest.approx(0.25 * 14 / 15, abs=0.01)


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 2**31 - 1))
def test_calibration_error_does_not_depend_on_the_order_of_equal_probabilities(seed):
    rng = torch.Generator().manual_seed(seed)
    p = torch.randint(0, 5, (400,), generator=rng) / 4.0
    labels = torch.randint(0, 2, (400,), generator=rng).double()
    mass = torch.where(labels > 0, 0.5 / labels.sum(), 0.5 / (1 - labels).sum())
    order = torch.randperm(400, generator=rng)
    here = calibration_error(p.double(), labels, mass)
    there = calibration_error(p[order].double(), labels[order], mass[order])
    assert float(there) == pytest.approx(float(here), abs=1e-9)
    torch.testing.assert_close(
        reliability(p.double(), labels, mass)[:, 0],
        torch.full((15,), 1 / 15, dtype=torch.float64),
        atol=0.004,
        rtol=0,
    )


def test_a_reliability_diagram_worked_out_by_hand():
    p = torch.tensor([0.8, 0.2, 0.6, 0.4]).double()
    labels = torch.tensor([1.0, 0.0, 0.0, 1.0]).double()
    diagram = reliability(p, labels, torch.full((4,), 0.25).double(), bins=2)
    expected = torch.tensor([[0.5, 0.3, 0.5], [0.5, 0.7, 0.5]]).double()
    torch.testing.assert_close(diagram, expected)


def test_the_reliability_of_held_out_answers_has_the_calibration_error_of_the_scores(tmp_path):
    answers = answer_held_out(lambda points: (points[:, 0] * 7).sin().square(), sphere_scan())
    scores = occupancy_metrics(answers.hits, answers.near)
    diagrams = reliability_held_out(answers)
    mass, said, was = diagrams["near"].T
    assert float((mass * (said - was).abs()).sum()) == pytest.approx(scores["ece"])
    draw_reliability(diagrams, tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=r"path must end in \.png"):
        draw_reliability(diagrams, tmp_path / "reliability.jpg")
    with pytest.raises(ValueError, match="diagrams must hold at least one"):
        draw_reliability({}, tmp_path / "reliability.png")


def test_evaluate_asks_the_model_at_the_held_out_points_in_world_coordinates():
    scans = sphere_scan(shift=UTM)
    hits = held_out_points(scans).hits

    def knows_the_hits(points: torch.Tensor) -> torch.Tensor:
        assert points.dtype == torch.float64
        if torch.equal(points, hits):
            return torch.ones(len(points))
        return torch.zeros(len(points))

    table = evaluate(knows_the_hits, scans)
    assert list(table) == ["unif", "near", "paper"]
    assert all(scores["balanced_accuracy"] == 1 for scores in table.values())


def test_evaluate_in_chunks_equals_evaluate_at_once(monkeypatch):
    scans = sphere_scan()

    def model(points: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(torch.linalg.vector_norm(points, dim=1) - 8)

    whole = evaluate(model, scans)
    monkeypatch.setattr("lardhm_torch.evaluation.held_out.QUERY_POINTS", 7)
    assert evaluate(model, scans) == whole


def test_arrays_are_taken_like_tensors():
    scans = sphere_scan()

    def model(points: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(torch.linalg.vector_norm(points, dim=1) - 8)

    assert evaluate(lambda points: model(points).numpy(), scans) == evaluate(model, scans)
    on_hits, on_free = random_probabilities(0)
    expected = occupancy_metrics(on_hits, on_free)
    assert occupancy_metrics(on_hits.tolist(), on_free.numpy()) == expected
    with pytest.raises(
        ValueError, match="on_free must be a tensor, an array or equally long lists"
    ):
        occupancy_metrics(on_hits, "often")
    distances = [
        mesh_metrics(box(), box(), h, num_points=100)
        for h in (square_hits(), square_hits().numpy())
    ]
    assert distances[0] == distances[1]


def test_the_table_has_a_row_for_each_kind_of_point():
    table = evaluate(lambda points: torch.full((len(points),), 0.5), sphere_scan())
    lines = format_metrics(table).splitlines()
    assert [line.split()[0] for line in lines] == ["test", "unif", "near", "paper"]
    assert lines[0].split()[1:] == list(table["unif"])
    assert lines[1].split()[1:] == [f"{score:.4f}" for score in table["unif"].values()]


def test_bad_scans_and_probabilities_are_refused():
    fine = torch.rand(4)
    for scans in (sphere_scan(0), along_x(0.1, 70.0)):
        with pytest.raises(ValueError, match=r"at least one ray that hit.*got none of"):
            held_out_points(scans)
    with pytest.raises(ValueError, match=r"on_hits must be probabilities.*got 1 of 2 NaN"):
        occupancy_metrics(torch.tensor([0.5, math.nan]), fine)
    with pytest.raises(ValueError, match=r"on_free must be probabilities.*sigmoid"):
        occupancy_metrics(fine, torch.tensor([0.5, 3.0]))
    with pytest.raises(ValueError, match=r"on_free must be \(N,\).*got \(0,\)"):
        occupancy_metrics(fine, torch.zeros(0))
    with pytest.raises(ValueError, match=r"on_hits must be \(N,\).*got \(2, 2\)"):
        occupancy_metrics(fine.reshape(2, 2), fine)
    with pytest.raises(ValueError, match=r"model must return \(500,\).*got \[\(3,\)\]"):
        evaluate(lambda points: torch.zeros(3), sphere_scan())
    with pytest.raises(ValueError, match="at least one row"):
        format_metrics({})


def box(height: float = 0.0) -> trimesh.Trimesh:
    """Square of 2 m at a height: two triangles."""
    vertices = [[0, 0, height], [2, 0, height], [2, 2, height], [0, 2, height]]
    return trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)


def square_hits(reach: float = 2.0) -> torch.Tensor:
    side = torch.arange(0, reach + 0.01, 0.05, dtype=torch.float64)
    return torch.cartesian_prod(side, side, torch.zeros(1, dtype=torch.float64))


def test_a_mesh_that_is_the_truth_has_distance_zero():
    scores = mesh_metrics(box(), box(), square_hits(), num_points=20_000)
    assert scores["chamfer"] < 0.01  # the spacing of the samples
    assert scores["f_score_0.05"] == scores["f_score_0.1"] == 1


def test_a_mesh_beside_the_truth_has_its_offset_as_distance():
    scores = mesh_metrics(box(0.07), box(), square_hits(), num_points=20_000)
    for name in ("accuracy", "completeness", "chamfer"):
        assert scores[name] == pytest.approx(0.07, abs=0.002)
    assert scores["f_score_0.05"] == 0
    assert scores["f_score_0.1"] == pytest.approx(1)


def test_unseen_truth_does_not_count_as_missing():
    half = trimesh.Trimesh([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    lower = square_hits()
    lower = lower[lower[:, 1] <= 0.9]
    seen = mesh_metrics(half, box(), lower, num_points=20_000)
    whole = mesh_metrics(half, box(), square_hits(), num_points=20_000)
    assert seen["completeness"] < 0.01
    # the missing half is 1 m wide: 0.5 m away on average, for half of the points
    assert whole["completeness"] == pytest.approx(0.25, abs=0.02)
    assert whole["f_score_0.05"] == pytest.approx(2 * 0.525 / 1.525, abs=0.02)


def test_bad_meshes_are_refused():
    empty = trimesh.Trimesh()
    with pytest.raises(ValueError, match="mesh must have faces"):
        mesh_metrics(empty, box(), square_hits())
    with pytest.raises(ValueError, match="truth must have faces"):
        mesh_metrics(box(), empty, square_hits())
    with pytest.raises(ValueError, match=r"hits must be \(H, 3\).*got \(2, 2\)"):
        mesh_metrics(box(), box(), torch.zeros(2, 2))
    with pytest.raises(ValueError, match=r"hits must lie within 0\.1 m of the truth"):
        mesh_metrics(box(), box(), square_hits() + 5, num_points=100)
