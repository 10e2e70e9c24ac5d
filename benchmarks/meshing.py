"""Time, memory and size of meshes at several resolutions, and compared with another checkout.

    python benchmarks/meshing.py --sets balm_realworld room
    python benchmarks/meshing.py --compare PATH               # each with a map of its own, alternately
    python benchmarks/meshing.py --compare PATH --same-map    # both with our map; are surfaces equal?

Half of at most 120,000 rays of a set train a default map (`room`: the simulated room). Every mesh is
extracted in a process of its own, after a coarse one has loaded the libraries. Memory is the peak of
the process, of which the libraries take about 350 MB. With ``--same-map``, surfaces are compared by
300,000 random points on each: the fraction within 0.01 m of the other surface, of those that have it
within a cell. Set OMP_NUM_THREADS=1 on a busy machine: waiting threads count as CPU time.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from conditions import ROOT, conditions, describe

from lardhm_torch import load_scans, save_scans, simulate_room, split_rays
from lardhm_torch.evaluation.held_out import protocol_rays

# Run in the process of a checkout.
FIT = """
import sys
from lardhm_torch import LardHilbertMap, load_scans, sample_rays
path, to = sys.argv[1:]
samples = sample_rays(load_scans(path), seed=0)
LardHilbertMap().fit(samples.points, samples.labels, seed=0).save(to)
"""
MESH = """
import json, resource, sys, time
import numpy as np
from lardhm_torch import LardHilbertMap, extract_mesh
path, resolution, to = sys.argv[1:]
model = LardHilbertMap.load(path).requires_grad_(False)
extract_mesh(model, 0.5)
start, cpu = time.perf_counter(), time.process_time()
mesh = extract_mesh(model, float(resolution))
seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
if to != "-":
    np.savez(to, vertices=mesh.vertices, faces=mesh.faces)
row = {"seconds": seconds, "cpu": cpu, "faces": len(mesh.faces), "area": float(mesh.area)}
print(json.dumps({**row, "MB": peak / 1024}))
"""


def run(checkout: Path, script: str, *arguments: str) -> str:
    """Output of a script with the code of a checkout, in a process of its own."""
    command = [sys.executable, "-c", script, *arguments]
    done = subprocess.run(command, cwd=checkout, check=False, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
    return done.stdout


def measure(
    checkouts: list[Path], maps: list[Path], resolution: float, repeats: int, folder: Path
) -> list[dict[str, float]]:
    """Medians of each checkout's runs, which alternate; the last meshes are left in the folder."""
    runs: list[list[dict[str, float]]] = [[] for _ in checkouts]
    for _ in range(repeats):
        for number, (checkout, path) in enumerate(zip(checkouts, maps, strict=True)):
            to = str(folder / f"mesh{number}.npz")
            runs[number].append(json.loads(run(checkout, MESH, str(path), str(resolution), to)))
    return [{key: statistics.median(r[key] for r in some) for key in some[0]} for some in runs]


def agreement(folder: Path, resolution: float) -> list[float]:
    """Of points on either mesh that have the other within a cell: the fraction within 0.01 m of it."""
    import trimesh
    from scipy.spatial import cKDTree

    points = []
    for number in range(2):
        with np.load(folder / f"mesh{number}.npz") as arrays:
            mesh = trimesh.Trimesh(arrays["vertices"], arrays["faces"], process=False)
        points.append((mesh, trimesh.sample.sample_surface(mesh, 300_000, seed=0)[0]))
    fractions = []
    for (_, own), (other, _) in (points, points[::-1]):
        dense = trimesh.sample.sample_surface(other, 20_000_000, seed=1)[0]
        distance = cKDTree(dense).query(own)[0]
        fractions.append(float((distance[distance < resolution] < 0.01).mean()))
    return fractions


def print_row(name: str, resolution: float, rows: list[dict[str, float]], extra: str) -> None:
    ours = rows[0]
    line = f"{name:<18}{resolution:>8g}{ours['faces']:>12,.0f}{ours['seconds']:>9.2f}{ours['cpu']:>9.2f}"
    line += f"{1e6 * ours['cpu'] / max(ours['faces'], 1):>9.2f}{ours['MB']:>8.0f}"
    for other in rows[1:]:
        line += f"{other['faces']:>12,.0f}{other['seconds'] / ours['seconds']:>9.1f}"
        line += f"{other['cpu'] / ours['cpu']:>9.1f}{other['MB'] / max(ours['MB'], 1e-9):>9.1f}"
    print(line + extra, flush=True)


def main() -> None:
    """Print one line for each set and resolution."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--sets", nargs="+", default=["room", "balm_realworld"])
    parser.add_argument("--resolutions", nargs="+", type=float, default=[0.2, 0.1, 0.05, 0.025])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--compare", type=Path, help="another checkout, run alternately")
    parser.add_argument("--same-map", action="store_true", help="the other one reads our map")
    arguments = parser.parse_args()
    checkouts = [ROOT] + ([arguments.compare.resolve()] if arguments.compare else [])
    print(describe(conditions()))
    head = (
        f"{'set':<18}{'cell [m]':>8}{'faces':>12}{'wall s':>9}{'CPU s':>9}{'us/face':>9}{'MB':>8}"
    )
    print(
        head + f"{'faces':>12}{'x wall':>9}{'x CPU':>9}{'x MB':>9}  (other)" * (len(checkouts) - 1)
    )
    for name in arguments.sets:
        is_room = name == "room"
        scans = (
            simulate_room(seed=0) if is_room else load_scans(arguments.data / name / "scans.npz")
        )
        train, _ = split_rays(protocol_rays(scans, 120_000), 0.5, 0)
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            save_scans(train, folder / "rays.npz")
            maps = [folder / f"{number}.pt" for number in range(len(checkouts))]
            for checkout, path in zip(checkouts, maps, strict=True):
                if not (arguments.same_map and checkout is not ROOT):
                    run(checkout, FIT, str(folder / "rays.npz"), str(path))
            if arguments.same_map:
                maps = [maps[0]] * len(checkouts)
            for resolution in arguments.resolutions:
                rows: list[Any] = measure(checkouts, maps, resolution, arguments.repeats, folder)
                extra = ""
                if arguments.same_map:
                    extra = "  equal: " + " ".join(
                        f"{f:.3f}" for f in agreement(folder, resolution)
                    )
                print_row(name, resolution, rows, extra)


if __name__ == "__main__":
    main()
