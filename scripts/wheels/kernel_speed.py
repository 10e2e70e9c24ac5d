"""CPU time of the kernel on one thread: queries, gradients and training, as one line of JSON.

Usage: python kernel_speed.py
"""

import json
import time
from collections.abc import Callable

import torch

from lardhm_torch import LardHilbertMap, native, sample_rays, simulate_room

REPEATS = 7


def main() -> None:
    """Print the shortest time of each task [s]."""
    torch.set_num_threads(1)
    if not native.available():
        raise SystemExit("the kernel is not available")
    samples = sample_rays(simulate_room(num_rays=6000, seed=0), seed=0)
    model = LardHilbertMap()

    def fit() -> None:
        model.fit(samples.points, samples.labels, num_clusters=500, seed=0)

    times = {"fit": shortest(fit)}
    for dtype in (torch.float32, torch.float64):
        points = samples.points.repeat(4, 1)
        model.to(dtype).requires_grad_()

        def query() -> None:
            with torch.no_grad():
                model(points)  # noqa: B023

        def gradient() -> None:
            torch.autograd.grad(model.log_odds(points).sum(), list(model.parameters()))  # noqa: B023

        name = str(dtype).removeprefix("torch.")
        times |= {f"query, {name}": shortest(query), f"gradient, {name}": shortest(gradient)}
    print(json.dumps(times))


def shortest(task: Callable[[], None]) -> float:
    """The shortest of some runs, after one that does not count."""
    times = []
    for _ in range(REPEATS + 1):
        start = time.process_time()
        task()
        times.append(time.process_time() - start)
    return min(times[1:])


if __name__ == "__main__":
    main()
