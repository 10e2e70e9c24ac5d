"""Distances: errors against true surfaces and dense hits, bounds, calibration, and time.

Usage: python benchmarks/distance.py [--data DATA] [--only error bound calibration speed rays update]
           [--reliability PNG]

error: the simulated room (default fit) against its mesh, and half of at most 120,000 rays of each set
against the nearest of all hits of the set, at `unif` points of held-out rays. bound: `clearance`
against the nearest of many samples of what is clearly occupied, in three rooms. calibration:
`collision_probability` in rooms with seeds that chose nothing. speed: one thread, processor time, in
turns. rays: a depth image in a street. update: the time that the faces near a scan take.
"""

import argparse
import resource
import time
from pathlib import Path

import torch
from conditions import conditions, describe
from scipy.spatial import cKDTree
from torch import Tensor

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    clearance,
    collision_probability,
    expected_range,
    information_gain,
    load_scans,
    sample_rays,
    signed_distance,
    simulate_room,
    split_rays,
)
from lardhm_torch.evaluation.calibration import (
    calibration_error,
    draw_reliability,
    reliability,
)
from lardhm_torch.evaluation.held_out import held_out_points, protocol_rays
from lardhm_torch.queries.faces import surface_faces
from lardhm_torch.simulation import room_mesh

SETS = ("paper_virtual", "sevenscenes_rgbd", "balm_realworld")
STREET = "kitti00_mulls"
ROOMS = (11, 12, 13)  # seeds that chose nothing
POINTS = 20_000
REPEATS = 9


def fit(rays: Scans) -> LardHilbertMap:
    samples = sample_rays(rays)
    return LardHilbertMap().fit(samples.points, samples.labels).requires_grad_(False)


def some(points: Tensor, count: int = POINTS) -> Tensor:
    order = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))
    return points[order[:count]]


def to_mesh(points: Tensor) -> Tensor:
    """(N,) distance to the true surface of the room [m]."""
    import trimesh

    mesh = room_mesh()
    dense = trimesh.sample.sample_surface(mesh, 4_000_000, seed=0)[0]
    distance = torch.from_numpy(cKDTree(dense).query(points)[0])
    near = distance < 0.1  # where the spacing of the samples matters
    exact = trimesh.proximity.closest_point_naive(mesh, points[near].numpy())[1]
    return distance.index_copy(0, near.nonzero().squeeze(1), torch.as_tensor(exact).double())


def room_case(seed: int) -> tuple[LardHilbertMap, Tensor, Tensor]:
    points = some(held_out_points(simulate_room(20_000, seed=seed + 100)).unif, 5000)
    return fit(simulate_room(seed=seed)), points, to_mesh(points)


def set_case(data: Path, name: str) -> tuple[LardHilbertMap, Tensor, Tensor, Tensor]:
    scans = load_scans(data / name / "scans.npz")
    train, test = split_rays(protocol_rays(scans, 120_000), 0.5, 0)
    points = some(held_out_points(test).unif)
    nearest = cKDTree(protocol_rays(scans).ends).query(points)[0]
    return fit(train), points, torch.from_numpy(nearest), train.ends


def errors(data: Path) -> None:
    print(
        f"{'error':<20}{'rmse':>8}{'bias':>8}{'to mean':>9}{'k-d tree':>10}{'sign':>8}{'|grad|':>8}"
    )
    for seed in ROOMS:
        model, points, true = room_case(seed)
        rays = simulate_room(seed=seed)
        tree = cKDTree(rays.ends[rays.is_return])
        print_errors(f"room, seed {seed}", model, points, true, tree)
    for name in SETS:
        model, points, true, hits = set_case(data, name)
        print_errors(name, model, points, true, cKDTree(hits))


def print_errors(name: str, model: LardHilbertMap, points: Tensor, true: Tensor, tree) -> None:
    inputs = points.clone().requires_grad_()
    found = signed_distance(model, inputs)
    (slope,) = torch.autograd.grad(found.sum(), inputs)
    unit = ((slope.norm(dim=1) - 1).abs() < 0.05).double().mean()
    found = found.detach()
    off = found.abs() - true
    mean = signed_distance(model, points, to_mean=True).abs() - true
    hits = torch.from_numpy(tree.query(points)[0]) - true
    sign = (found[true > 0.03] > 0).double().mean()
    rms = [float(e.square().mean().sqrt()) for e in (off, mean, hits)]
    print(
        f"{name:<20}{rms[0]:>8.4f}{off.mean():>8.4f}{rms[1]:>9.4f}{rms[2]:>10.4f}"
        f"{sign:>8.4f}{unit:>8.4f}",
        flush=True,
    )


def bounds() -> None:
    print(f"{'bound':<20}{'above':>8}{'median':>8}{'<= 0':>8}   of 10^5 points")
    for seed in ROOMS:
        model = fit(simulate_room(seed=seed))
        points = held_out_points(simulate_room(110_000, seed=seed + 100)).unif[:100_000]
        rng = torch.Generator().manual_seed(0)
        pick = torch.randint(len(model), (4_000_000,), generator=rng)
        spread = torch.randn(len(pick), 3, 1, generator=rng)
        around = (model.centers[pick] + (model.scale_tril[pick] @ spread).squeeze(2)).double()
        occupied = around[model.log_odds(around + model.origin) > 1] + model.origin
        true = torch.from_numpy(cKDTree(occupied).query(points)[0])
        found = clearance(model, points)
        above, below = int((found > true).sum()), (found <= 0).double().mean()
        print(
            f"room, seed {seed:<9}{above:>8}{(found / true).median():>8.3f}{below:>8.3f}",
            flush=True,
        )


def calibration(picture: Path | None) -> None:
    diagrams = {}
    for seed in ROOMS:
        model, points, true = room_case(seed)
        rng = torch.Generator().manual_seed(1)
        off = 0.1 * torch.randn(len(true), generator=rng, dtype=torch.float64)
        radii = (true + off).clamp(min=0.01)
        answers = (
            collision_probability(model, points, radii),
            (true < radii).double(),
            torch.full_like(true, 1 / len(true)),
        )
        diagrams[f"room, seed {seed}"] = reliability(*answers)
        print(f"calibration, room, seed {seed}: ECE {calibration_error(*answers):.4f}", flush=True)
    if picture is not None:
        draw_reliability(diagrams, picture)


def speed(data: Path) -> None:
    """Processor time a point [ns], the least of some turns."""
    heads = ("map", "distance", "gradient", "clearance", "k-d tree")
    print(f"{'ns a point':<20}" + "".join(f"{head:>10}" for head in heads))
    for name in (*SETS[:2], STREET):
        scans = load_scans(data / name / "scans.npz")
        train, test = split_rays(protocol_rays(scans, 120_000), 0.5, 0)
        points = held_out_points(test).unif.repeat(10, 1)
        points = some(points + 1e-3 * torch.randn(points.shape), 200_000)
        times = "".join(f"{1e9 * t / len(points):>10.0f}" for t in turns(fit(train), points, train))
        print(f"{name:<20}{times}", flush=True)


def turns(model: LardHilbertMap, points: Tensor, train: Scans) -> list[float]:
    """Least time of each contender [s]; pykdtree only where it is installed."""
    inputs = points.clone().requires_grad_()
    calls = [
        lambda: model(points),
        lambda: signed_distance(model, points),
        lambda: signed_distance(model, inputs).sum().backward(),
        lambda: clearance(model, points),
    ]
    try:
        from pykdtree.kdtree import KDTree

        tree = KDTree(train.ends.numpy())
        calls.append(lambda: tree.query(points.numpy()))
    except ImportError:
        pass
    times = [float("inf")] * len(calls)
    for _ in range(REPEATS):
        for number, call in enumerate(calls):
            start = time.process_time()
            call()
            times[number] = min(times[number], time.process_time() - start)
    return times


def rays(data: Path) -> None:
    scans = load_scans(data / STREET / "scans.npz")
    model = fit(split_rays(protocol_rays(scans, 120_000), 0.5, 0)[0])
    up, left = torch.linspace(0.43, -0.43, 480), torch.linspace(0.57, -0.57, 640)
    up, left = torch.meshgrid(up, left, indexing="ij")
    ways = torch.stack([torch.ones_like(up), left, up], dim=2).reshape(-1, 3).double()
    view = (model, scans.ray_origins[0], ways, 30.0)
    show_rays("expected_range", lambda: float(expected_range(*view).mean()))
    for step in (0.2, 0.1, 0.05):
        show_rays(f"gain, {step} m", lambda step=step: information_gain(*view, step))


def show_rays(name: str, call) -> None:
    begin, wall = time.process_time(), time.perf_counter()
    result = call()
    used, wall = time.process_time() - begin, time.perf_counter() - wall
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"307,200 rays, {name}: {result:.5g}, {used:.1f} s ({wall:.1f} s elapsed), {memory:.0f} MiB"
    )


def update(data: Path) -> None:
    """Milliseconds of one more scan of a stream, and of the faces afterwards."""
    scans = load_scans(data / "stream_balm" / "scans.npz")
    model, times = LardHilbertMap(), []
    for scan in range(40):
        rays = scans.select(scans.scan_id == scan)
        samples = sample_rays(rays)
        start = time.process_time()
        model.update(samples.points, samples.labels, rays=rays)
        middle = time.process_time()
        surface_faces(model)
        times.append((middle - start, time.process_time() - middle))
    for name, column in zip(("update", "faces"), zip(*times[20:], strict=True), strict=True):
        print(f"{name}: {1e3 * sorted(column)[10]:.0f} ms (median), {len(model)} clusters")


def main() -> None:
    parts = ("error", "bound", "calibration", "speed", "rays", "update")
    parser = argparse.ArgumentParser(description="Distances: errors, bounds, calibration, time.")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    parser.add_argument("--reliability", type=Path, help="picture of the calibration (.png)")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(describe(conditions()))
    calls = {
        "error": lambda: errors(arguments.data),
        "bound": bounds,
        "calibration": lambda: calibration(arguments.reliability),
        "speed": lambda: speed(arguments.data),
        "rays": lambda: rays(arguments.data),
        "update": lambda: update(arguments.data),
    }
    for name in arguments.only:
        calls[name]()


if __name__ == "__main__":
    main()
