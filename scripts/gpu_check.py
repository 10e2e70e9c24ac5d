"""Check the library on a GPU: same values and gradients as on the CPU, times, and peak memory.

A simulated room is fitted on the CPU and copied to the GPU. There the plain torch path must give the
CPU's values and gradients. `fit`, `fine_tune` and `update` draw other random numbers on a GPU, so that
maps learned there are compared by their scores on held-out rays. Every operation is watched: one that
creates a tensor on another device is reported with the line of the library that called it.

    python scripts/gpu_check.py
    python scripts/gpu_check.py --device cpu --rays 2000    # tries the script without a GPU

Without a GPU the script says so and ends with exit code 0; a failed check ends it with 1.
"""

from __future__ import annotations

import argparse
import copy
import json
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from lardhm_torch import (
    LardHilbertMap,
    Samples,
    Scans,
    fine_tune,
    native,
    sample_rays,
    simulate_room,
    split_rays,
)
from lardhm_torch.evaluation.held_out import evaluate, held_out_points
from lardhm_torch.learning.fine_tuning import TuneConfig

TOLERANCES = {torch.float64: 1e-9, torch.float32: 2e-4}  # relative to the largest value
SCORE_TOLERANCE = 0.01  # accuracy of maps that were learned with other random numbers
SMALL = 16  # tensors with fewer elements are settings, not data
REPEATS = 7
LIBRARY = str(Path(native.__file__).parents[1])
Row = dict[str, Any]


class DeviceWatch(TorchDispatchMode):
    """Counts, by line of the library, the results that lie on another device than the expected one."""

    def __init__(self, device: torch.device) -> None:
        super().__init__()
        self.device, self.found = device, Counter[str]()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run the operation and look at its results."""
        result = func(*args, **(kwargs or {}))
        for value in result if isinstance(result, (tuple, list)) else [result]:
            elsewhere = isinstance(value, Tensor) and value.device.type != self.device.type
            if elsewhere and value.numel() >= SMALL:
                self.found[f"{func} {tuple(value.shape)} at {library_line()}"] += 1
        return result


def library_line() -> str:
    """The innermost line of the library on the stack, as file:line."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_code.co_filename.startswith(LIBRARY):
            return f"{frame.f_code.co_filename.removeprefix(LIBRARY)[1:]}:{frame.f_lineno}"
        frame = frame.f_back  # type: ignore[assignment]
    return "outside of the library"


def answers(model: LardHilbertMap, points: Tensor) -> dict[str, Tensor]:
    """Log-odds at the points, and the gradients of their mean square, on the CPU."""
    model = copy.deepcopy(model).requires_grad_()
    points = points.detach().clone().requires_grad_()
    log_odds = model.log_odds(points)
    log_odds.square().mean().backward()
    parameters = (model.weights, model.centers, model.raw_scale_tril)
    names = ("points", "weights", "centers", "raw_scale_tril")
    grads = {f"gradient of {name}": tensor.grad for name, tensor in
             zip(names, (points, *parameters), strict=True)}  # fmt: skip
    found = {"log-odds": log_odds, "probability": model(points), **grads}
    return {name: tensor.detach().cpu() for name, tensor in found.items() if tensor is not None}


def value_rows(model: LardHilbertMap, points: Tensor, device: torch.device) -> list[Row]:
    """Largest difference between the devices, relative to the largest value, for each dtype."""
    rows = []
    for dtype, tolerance in TOLERANCES.items():
        ours = answers(model.to(dtype), points)
        theirs = answers(copy.deepcopy(model).to(device, dtype), points.to(device))
        for name, expected in ours.items():
            scale = float(expected.abs().max())
            difference = float((theirs[name] - expected).abs().max()) / max(scale, 1e-30)
            rows.append({"check": f"{name}, {str(dtype)[6:]}", "difference": difference,
                         "passed": difference <= tolerance})  # fmt: skip
    return rows


def measure(run: Callable[[], Any], device: torch.device, repeats: int = REPEATS) -> Row:
    """Median time [ms] after one warm-up, and the peak memory of the device [MiB]."""
    on_gpu = device.type == "cuda"
    seconds = []
    for _ in range(repeats + 1):
        if on_gpu:
            torch.cuda.synchronize(device)
            torch.cuda.reset_peak_memory_stats(device)
        start = time.perf_counter()
        run()
        if on_gpu:
            torch.cuda.synchronize(device)
        seconds.append(time.perf_counter() - start)
    memory = torch.cuda.max_memory_allocated(device) / 2**20 if on_gpu else None
    return {"ms": 1e3 * statistics.median(seconds[1:]), "peak MiB": memory}


def tasks(samples: Samples, points: Tensor, device: torch.device) -> dict[str, Callable[[], Any]]:
    """What is timed and watched: learning from the samples, and queries of that map."""
    samples, points = samples.to(device), points.to(device)
    fitted = LardHilbertMap(device=device).fit(samples.points, samples.labels)
    with_gradient = points.detach().clone().requires_grad_()

    def query() -> None:
        with torch.no_grad():
            fitted(points)

    def gradient() -> None:
        fitted.log_odds(with_gradient).sum().backward()

    def fit() -> LardHilbertMap:
        return LardHilbertMap(device=device).fit(samples.points, samples.labels)

    def tune() -> LardHilbertMap:
        model = copy.deepcopy(fitted)
        fine_tune(model, samples.points, samples.labels, config=TuneConfig(epochs=1))
        return model

    def update() -> LardHilbertMap:
        return copy.deepcopy(fitted).update(samples.points, samples.labels, seed=1)

    return {"query": query, "gradient": gradient, "fit": fit, "fine_tune": tune, "update": update}


def task_rows(
    train: Scans, test: Scans, device: torch.device, repeats: int
) -> tuple[list[Row], list[Row]]:
    """Times on both devices, and checks: where tensors are, and scores of maps learned there."""
    samples, points = sample_rays(train), torch.cat(held_out_points(test)[:3])
    cpu = torch.device("cpu")
    ours, theirs = tasks(samples, points, cpu), tasks(samples, points, device)
    times, checks = [], []
    for name, run in theirs.items():
        with DeviceWatch(device) as watch:
            run()
        lines = [f"{count} x {line}" for line, count in watch.found.most_common(5)]
        checks.append({"check": f"{name}: tensors stay on the device", "difference": lines,
                       "passed": not lines})  # fmt: skip
        slow = 1 if name in ("fit", "fine_tune", "update") else repeats
        row = {"task": name, **measure(run, device, slow)}
        row["CPU ms"] = measure(ours[name], cpu, slow)["ms"]
        times.append(row)
        if name in ("fit", "fine_tune", "update"):
            scores = [accuracy(learn[name](), test) for learn in (ours, theirs)]
            checks.append({"check": f"{name}: accuracy on held-out rays", "difference":
                           f"CPU {scores[0]:.4f}, here {scores[1]:.4f}",
                           "passed": abs(scores[0] - scores[1]) <= SCORE_TOLERANCE})  # fmt: skip
    return times, [*checks, floor_row(len(points), times[0], device)]


def accuracy(model: LardHilbertMap, test: Scans) -> float:
    """Mean balanced accuracy of both kinds of free points."""
    scores = evaluate(copy.deepcopy(model).cpu(), test)
    return (scores["unif"]["balanced_accuracy"] + scores["near"]["balanced_accuracy"]) / 2


def floor_row(count: int, query: Row, device: torch.device) -> Row:
    """Time of a query beside that of moving its points once: what a fused kernel could gain at most."""
    values = torch.zeros(count, 4, device=device)
    floor = measure(lambda: values.add(1.0), device)["ms"]
    return {"check": "query / time to move its points once (upper bound of a fused kernel's gain)",
            "difference": query["ms"] / floor, "passed": True}  # fmt: skip


def check(device: torch.device, rays: int, repeats: int = REPEATS) -> Row:
    """All checks and times on a device, beside the CPU."""
    scans = simulate_room(seed=0)
    scans = scans.select(torch.arange(0, len(scans), max(1, len(scans) // rays)))
    train, test = split_rays(scans, 0.5, seed=0)
    samples = sample_rays(train)
    model = LardHilbertMap(dtype=torch.float64).fit(samples.points, samples.labels)
    points = torch.cat(held_out_points(test)[:3])
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
    compared = value_rows(model, points[:20_000], device)
    times, checks = task_rows(train, test, device, repeats)
    return {"device": device_name(device), "torch": torch.__version__, "points": len(points),
            "clusters": len(model), "times": times, "checks": [*compared, *checks]}  # fmt: skip


def device_name(device: torch.device) -> str:
    """Name of a device for the report."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def main() -> int:
    """Run the checks; 0 if all passed or there is no GPU."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--rays", type=int, default=60_000, help="rays of the room, at most")
    parser.add_argument("--json", type=Path, help="also write the report to this file")
    arguments = parser.parse_args()
    device = torch.device(arguments.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("skipped: no GPU, torch.cuda.is_available() is False")
        return 0
    report = check(device, arguments.rays)
    for table in ("times", "checks"):
        for row in report[table]:
            print(row)
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")
    failed = [row["check"] for row in report["checks"] if not row["passed"]]
    print(f"{report['device']}: {len(report['checks'])} checks, failed: {failed or 'none'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
