"""Rays that pass through clusters: obstacles that were removed disappear, and others stay."""

import math

import pytest
import torch
from command_runs import run
from torch import Tensor

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    StreamConfig,
    UpdateConfig,
    clearance,
    native,
    real_time,
    sample_rays,
    save_scans,
    stream_scans,
)
from lardhm_torch.learning import passing
from lardhm_torch.learning.evidence import kept_counts, kept_points
from lardhm_torch.learning.parameters import read_state
from lardhm_torch.native import crossings
from lardhm_torch.native.crossings import passages_through
from lardhm_torch.scans import concatenate_scans

F64 = torch.float64


def directions(columns: int, rows: int, width: float, height: float, shift: float = 0.0) -> Tensor:
    """Unit vectors about +x: ``columns`` by ``rows``, angles within +-width and +-height."""
    turn = torch.linspace(-width, width, columns, dtype=F64) + shift
    tilt = (
        torch.linspace(-height, height, rows, dtype=F64) if rows > 1 else torch.zeros(1, dtype=F64)
    )
    turn, tilt = torch.cartesian_prod(turn, tilt).T
    return torch.stack([tilt.cos() * turn.cos(), tilt.cos() * turn.sin(), tilt.sin()], dim=1)


def scan_of(ahead: Tensor, ranges: Tensor, seed: int, start: float = 0.0, dim: int = 3) -> Scans:
    """A scan from (start, 0, 0) with noise of 5 mm; rays of more than 15 m have no return."""
    rng = torch.Generator().manual_seed(seed)
    is_return = ranges < 15
    ranges = ranges + 0.005 * torch.randn(len(ranges), generator=rng, dtype=F64) * is_return
    origin = torch.tensor([[start, 0.0, 0.0]], dtype=F64)
    ends = origin + ahead * ranges.clamp(max=15)[:, None]
    return Scans(origin[:, :dim], ends[:, :dim], is_return=is_return)


def box_scan(there: bool, seed: int, start: float = 0.0, wall: float = 8.0) -> tuple[Scans, Tensor]:
    """A box of .8 m at x = 4 in front of a wall, and which rays hit it."""
    ahead = directions(40, 20, 0.3, 0.15)
    front = (4 - start) / ahead[:, 0]
    on_box = ((ahead[:, 1:] * front[:, None]).abs() < 0.4).all(dim=1) & there
    return scan_of(
        ahead, torch.where(on_box, front, (wall - start) / ahead[:, 0]), seed, start
    ), on_box


def person_scan(there: bool, seed: int, start: float = 0.0) -> tuple[Scans, Tensor]:
    """A person 3 m in front of a 2-D laser of 90 rays in a corridor with a wall at x = 8."""
    ahead = directions(90, 1, 1.5, 0.0)
    along = 3 * ahead[:, 0]
    apart = along.square() - 9 + 0.25**2
    on_it = (apart > 0) & there
    walls = (8 / ahead[:, 0]).minimum(2 / ahead[:, 1].abs())
    return scan_of(ahead, torch.where(on_it, along - apart.abs().sqrt(), walls), seed, dim=2), on_it


def pole_scan(radius: float, seed: int, there: bool = True) -> tuple[Scans, Tensor]:
    """A pole 3 m away. If it is thin, three of four scans miss it: rays are 2 cm apart there."""
    ahead = directions(81, 8, 0.28, 0.15, shift=0.0035 * (seed % 4 > 0))
    flat = ahead[:, :2] / ahead[:, :2].norm(dim=1, keepdim=True)
    apart = flat[:, 1] * 3
    on_it = (apart.abs() < radius) & (flat[:, 0] > 0) & there
    depth = 3 * flat[:, 0] - (radius**2 - apart.square()).clamp(min=0).sqrt()
    ranges = torch.where(on_it, depth, 7 / flat[:, 0]) / ahead[:, :2].norm(dim=1)
    return scan_of(ahead, ranges, seed), on_it


def learn_rays(model: LardHilbertMap, scan: Scans, number: int) -> None:
    samples = sample_rays(scan)
    model.update(samples.points, samples.labels, rays=scan)


def learn_seeded_rays(model: LardHilbertMap, scan: Scans, number: int) -> None:
    samples = sample_rays(scan, seed=number)
    model.update(samples.points, samples.labels, seed=number, rays=scan)


def learn_stream(model: LardHilbertMap, scan: Scans, number: int) -> None:
    stream_scans(model, [scan])


def learn_in_real_time(model: LardHilbertMap, scan: Scans, number: int) -> None:
    stream_scans(model, [scan], real_time(StreamConfig(seed=number)))


def left_of(scan, learn, stood: int, later: int, moves: bool = False) -> float:
    """Fraction of the hits on an obstacle that are occupied some scans after it was removed."""
    hits, model = [], None
    for number in range(stood + later):
        start = {"start": 0.1 * (number % 8)} if moves else {}
        one, on_it = scan(number < stood, number, **start)
        model = LardHilbertMap(dim=one.dim) if model is None else model
        learn(model, one, number)
        hits.append(one.ends[on_it])
        if number == stood - 1:
            assert (model(torch.cat(hits)) > 0.5).double().mean() > 0.8
    return float((model(torch.cat(hits)) > 0.5).double().mean())


LEARN = [learn_rays, learn_seeded_rays, learn_stream, learn_in_real_time]


@pytest.mark.parametrize("learn", LEARN)
@pytest.mark.parametrize("scan", [box_scan, person_scan])
def test_a_removed_obstacle_is_gone_after_ten_scans_whatever_the_seeds(scan, learn):
    assert left_of(scan, learn, stood=6, later=10) < 0.02


@pytest.mark.parametrize("learn", [learn_rays, learn_stream])
def test_a_removed_obstacle_is_gone_if_the_sensor_moves(learn):
    assert left_of(box_scan, learn, stood=6, later=10, moves=True) < 0.02


def test_a_removed_obstacle_before_open_sky_is_gone():
    def sky(there: bool, seed: int) -> tuple[Scans, Tensor]:
        return box_scan(there, seed, wall=100.0)

    assert left_of(sky, learn_stream, stood=6, later=10) < 0.02


def test_a_pole_that_was_moved_is_gone():
    def moved(there: bool, seed: int) -> tuple[Scans, Tensor]:
        return pole_scan(0.03, seed, there)

    assert left_of(moved, learn_stream, stood=6, later=10) < 0.02


@pytest.mark.parametrize("radius", [0.005, 0.01])
def test_thin_poles_stay_although_rays_pass_close_to_them(radius):
    model, hits = LardHilbertMap(), []
    for number in range(40):
        scan, on_it = pole_scan(radius, number)
        learn_stream(model, scan, number)
        hits.append(scan.ends[on_it])
        if number in (10, 11, 30, 31, 38, 39):
            assert (model(torch.cat(hits)) > 0.5).double().mean() > 0.95


def test_a_floor_stays_although_rays_graze_it():
    """A robot drives away from floor that it saw from above; later rays pass a few cm above it."""
    model, hits = LardHilbertMap(), None
    for number in range(30):
        down = torch.tensor([-0.3, -0.06, -0.03, -0.02], dtype=F64)[:, None]
        turn = torch.linspace(-0.3, 0.3, 150, dtype=F64)[None] + 1e-3 * number
        ahead = torch.stack(
            [-turn.cos() * down.cos(), turn.sin() * down.cos(), down.sin() + 0 * turn], 2
        )
        ahead = ahead.flatten(0, 1)
        scan = scan_of(ahead, 0.3 / -ahead[:, 2], number, start=0.3 * number)
        learn_stream(model, scan, number)
        hits = scan.ends[scan.is_return] if hits is None else hits
    assert (model(hits) > 0.5).double().mean() > 0.97


def test_clearance_follows_with_the_scan_in_which_a_box_disappears():
    model = LardHilbertMap()
    for number in range(6):
        learn_stream(model, box_scan(True, number)[0], number)
    along = torch.linspace(-0.4, 0.4, 41, dtype=F64)
    front = torch.cartesian_prod(torch.linspace(3.96, 4.04, 5, dtype=F64), along, along)
    place = torch.tensor([[3.6, 0.0, 0.0]], dtype=F64)
    assert float(clearance(model, place)) < 0.41
    for number in range(6, 16):
        learn_stream(model, box_scan(False, number)[0], number)
        occupied = float((model(front) > 0.5).double().mean())
        near = float(clearance(model, place))
        if occupied == 0:
            break
    assert occupied == 0
    assert near > 0.8


def test_unknown_points_that_later_rays_cross_are_removed():
    model = LardHilbertMap()
    for number in range(3):
        learn_stream(model, box_scan(True, number)[0], number)
    state = read_state(model)
    rays = passing.lines_of(box_scan(False, 3)[0], model.origin)
    after = passing.still_unknown(state, rays, model.kernel.min_lengthscale)
    unknown = state.kinds == 2
    fewer = kept_counts(after.evidence) < kept_counts(state.evidence)
    assert fewer.any()
    assert not fewer[~unknown].any()
    points = kept_points(after.evidence, unknown.nonzero().squeeze(1))[0] + model.origin
    behind_box = (points[:, 0] > 4.2) & (points[:, 0] < 7) & (points[:, 1:].abs() < 0.5).all(dim=1)
    assert not behind_box.any()
    assert torch.equal(after.fresh[~fewer], state.fresh[~fewer])


@pytest.mark.parametrize("dim", [2, 3])
def test_rays_pass_through_the_cores_of_clusters_as_in_plain_torch(dim, monkeypatch):
    rng = torch.Generator().manual_seed(dim)
    means = 4 * torch.rand(37, dim, generator=rng, dtype=F64)
    factors = 0.2 * torch.randn(37, dim, dim, generator=rng, dtype=F64)
    ahead = torch.randn(400, dim, generator=rng, dtype=F64)
    ahead /= ahead.norm(dim=1, keepdim=True)
    reach = 6 * torch.rand(400, generator=rng, dtype=F64)
    lines = crossings.Lines(torch.full((1, dim), 2.0, dtype=F64), ahead, reach)
    given = (means, factors @ factors.mT, lines, reach - 0.15, 0.15)
    clusters, found = passages_through(*given)
    assert len(clusters) > 20
    pairs = torch.stack([clusters, found.rays])
    assert len(pairs.unique(dim=1).T) == len(clusters)
    places = 2 + found.depths[:, None] * ahead[found.rays]
    offsets = (places - means[clusters])[:, :, None]
    squared = (offsets.mT @ torch.linalg.solve(given[1][clusters], offsets)).flatten()
    assert (squared.sqrt() < 1.1 * crossings.CORE).all()
    monkeypatch.setattr(native, "supports", lambda *_: False)
    clusters, plain = passages_through(*given)
    assert torch.equal(torch.stack([clusters, plain.rays]).unique(dim=1), pairs.unique(dim=1))


def test_rays_through_a_flat_cluster_count_if_they_are_steep():
    wall = torch.diag(torch.tensor([0.01, 0.2, 0.2], dtype=F64).square())[None]
    means = torch.tensor([[2.0, 0.0, 0.0]], dtype=F64)
    angles = torch.tensor([0.0, 45.0, 85.0, 89.0], dtype=F64) * math.pi / 180
    ahead = torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1)
    starts = means - 3 * ahead  # through the center
    lines = crossings.Lines(starts, ahead, torch.full((4,), 30.0, dtype=F64))
    _, found = passages_through(means, wall, lines, lines.reach, 0.15)
    assert found.rays.tolist() == [0, 1, 2]
    nothing = passages_through(means[:0], wall[:0], lines, lines.reach, 0.15)
    assert len(nothing[0]) == 0


PAPER = UpdateConfig(as_in_paper=True)


@pytest.mark.parametrize("config", [None, PAPER])
@pytest.mark.parametrize("is_empty", [False, True])
def test_rays_of_another_dimension_or_type_are_refused(is_empty, config):
    samples = sample_rays(box_scan(True, 0)[0])
    model, rays = LardHilbertMap(), person_scan(True, 0)[0]
    if not is_empty:
        model.fit(samples.points, samples.labels)
    before = len(model)
    for points, labels in ((samples.points, samples.labels), ([], [])):
        with pytest.raises(ValueError, match="rays must have the 3 dimensions of the map; got 2"):
            model.update(points, labels, rays=rays, config=config)
    with pytest.raises(ValueError, match="rays must be the Scans of the points; got Tensor"):
        model.update(samples.points, samples.labels, rays=samples.points, config=config)
    assert len(model) == before


def test_the_first_scan_and_algorithm_2_do_not_depend_on_rays():
    samples = [sample_rays(box_scan(True, seed)[0]) for seed in range(2)]
    away = box_scan(False, 2)[0]  # passes through the box
    fitted = LardHilbertMap().fit(samples[0].points, samples[0].labels)
    started = LardHilbertMap().update(samples[0].points, samples[0].labels, rays=away)
    assert torch.equal(started(samples[1].points), fitted(samples[1].points))
    given = (samples[1].points, samples[1].labels)
    fitted.update(*given, config=PAPER)
    started.update(*given, config=PAPER, rays=away)
    assert torch.equal(started(samples[1].points), fitted(samples[1].points))


@pytest.mark.parametrize("verb", ["fit --incremental", "fit, update"])
def test_a_person_that_left_is_gone_after_three_scans_on_the_command_line(verb, tmp_path):
    scans, on_it = zip(*(person_scan(n < 6, n) for n in range(9)), strict=True)
    for name, part in (("before", scans[:6]), ("after", scans[6:])):
        save_scans(concatenate_scans(list(part)), tmp_path / f"{name}.npz")
    hits = torch.cat([scan.ends[rows] for scan, rows in zip(scans, on_it, strict=True)])
    before, after, path = (tmp_path / name for name in ("before.npz", "after.npz", "map.pt"))
    if verb == "fit --incremental":
        run("fit", before, after, "-o", path, "--incremental")
    else:
        run("fit", before, "-o", path)
        assert (LardHilbertMap.load(path)(hits) > 0.5).double().mean() > 0.8
        run("update", path, after, "-o", path)
    assert (LardHilbertMap.load(path)(hits) > 0.5).double().mean() < 0.02
