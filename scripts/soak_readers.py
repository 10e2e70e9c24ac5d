"""Four readers beside one writer: every answer and every saved file is that of one state of the map.

    python scripts/soak_readers.py --seconds 60

One thread updates a map with scans of the simulated room. The others ask for probabilities, ray ranges,
distances and saved files. The states are known from a run without readers, so each answer must be that
of one of them, and never older than the one before. Exit code 0 if all are.
"""

from __future__ import annotations

import argparse
import copy
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch import LardHilbertMap, raycast, sample_rays, signed_distance, simulate_room

NUM_SCANS = 12
Question = Callable[[LardHilbertMap], Tensor]


def questions(folder: Path) -> dict[str, Question]:
    """What the readers ask; each question has one answer per state of the map."""
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=rng, dtype=torch.float64) * torch.tensor([8.0, 5.0, 2.6])
    origins, directions = points[:50], torch.randn(50, 3, generator=rng, dtype=torch.float64)

    def saved(model: LardHilbertMap) -> Tensor:
        path = folder / f"{threading.get_ident()}.pt"
        model.save(path)
        return LardHilbertMap.load(path)(points)

    return {
        "probability": lambda model: model(points),
        "ray ranges": lambda model: raycast(model, origins, directions, max_range=10.0),
        "distance": lambda model: signed_distance(model, points, max_distance=1.0),
        "saved file": saved,
    }


def scan(number: int) -> tuple[Tensor, Tensor]:
    """Points and labels of a scan."""
    samples = sample_rays(simulate_room(3000, seed=number), seed=number)
    return samples.points, samples.labels


class Reader(threading.Thread):
    """Asks one question until it is stopped, and compares the answers with those that are possible."""

    def __init__(self, model: LardHilbertMap, ask: Question, expected: list[Tensor]) -> None:
        super().__init__()
        self.model, self.ask, self.expected = model, ask, expected
        self.stop = threading.Event()
        self.answers, self.failures = 0, list[str]()

    def run(self) -> None:
        """Ask until `stop` is set."""
        with torch.no_grad():
            last = 0
            while not self.stop.is_set():
                try:
                    answer = self.ask(self.model)
                except Exception as error:  # any error is a failure
                    self.failures.append(repr(error))
                    continue
                self.answers += 1
                same = [n for n, other in enumerate(self.expected) if torch.equal(answer, other)]
                if not same:
                    self.failures.append("the answer is that of no state")
                elif same[-1] < last:
                    self.failures.append(f"state {same[-1]} after state {last}")
                last = max([last, *same[:1]])


def main() -> int:
    """Run for some time; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    seconds = parser.parse_args().seconds
    torch.set_num_threads(1)
    scans = [scan(number) for number in range(NUM_SCANS)]
    first = LardHilbertMap().fit(*scans[0])
    end, failures = time.monotonic() + seconds, 0
    with tempfile.TemporaryDirectory() as folder:
        asked = questions(Path(folder))
        model = copy.deepcopy(first)
        expected: dict[str, list[Tensor]] = {name: [] for name in asked}
        for number in range(NUM_SCANS):
            if number:
                model.update(*scans[number], seed=number)
            with torch.no_grad():
                for name, ask in asked.items():
                    expected[name].append(ask(model))
        counts = dict.fromkeys(asked, 0)
        while time.monotonic() < end:
            model = copy.deepcopy(first)
            readers = {name: Reader(model, ask, expected[name]) for name, ask in asked.items()}
            for reader in readers.values():
                reader.start()
            for number in range(1, NUM_SCANS):
                model.update(*scans[number], seed=number)
            for name, reader in readers.items():
                reader.stop.set()
                reader.join()
                counts[name] += reader.answers
                failures += len(reader.failures)
                for failure in sorted(set(reader.failures)):
                    print(f"{name}: {failure}")
    print(f"answers: {counts}; failures: {failures}")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
