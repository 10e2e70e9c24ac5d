"""Flip single bits of map files, tiles and manifests: each is refused, or answers do not change.

    python scripts/soak_bits.py --flips 1000 --seed 0

Exit code 0 if no flipped bit changed an answer and every error named the damaged file or tile.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from lardhm_torch import LardHilbertMap, TiledMap

Answer = Callable[[], Tensor]
KINDS = ("map.pt", "plain.pt", "map.safetensors", "tile", "manifest")
NUM_POINTS = 200


def healthy_map(kind: str, folder: Path) -> tuple[Path, Answer]:
    """A healthy file of a kind, and the answers of the map that is read from it."""
    rng = torch.Generator().manual_seed(0)
    points = 4 * torch.rand(NUM_POINTS, 3, generator=rng)
    model = LardHilbertMap().fit(points, points[:, 0] > 2, num_clusters=20)
    if kind in ("tile", "manifest"):
        tiles = TiledMap.split(model, folder / "tiles", edge=2.0)
        manifest = tiles.folder / "manifest.json"
        path = manifest if kind == "manifest" else next((tiles.folder / "tiles").iterdir())
        return path, lambda: TiledMap.open(tiles.folder)(points).detach()
    path = folder / kind
    if kind == "plain.pt":
        torch.save(model.state_dict(), path)
    else:
        model.save(path)
    return path, lambda: LardHilbertMap.load(path)(points).detach()


def flip_bits(path: Path, answer: Answer, flips: int, seed: int) -> tuple[int, list[str]]:
    """Flip one random bit of a file, ``flips`` times; the file is restored.

    Returns:
        How often the file was refused, and a description of every failure: other answers, an
        exception of another type than ValueError, or a message that does not name the file.
    """
    expected, content = answer(), path.read_bytes()
    rng, refused, failures = random.Random(seed), 0, []
    for _ in range(flips):
        bit = rng.randrange(8 * len(content))
        changed = bytearray(content)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        try:
            if not torch.equal(answer(), expected):
                failures.append(f"bit {bit} of {path.name}: other answers")
        except ValueError as error:
            refused += 1
            if path.name not in str(error):
                failures.append(f"bit {bit} of {path.name} is not named: {error}")
        except Exception as error:
            failures.append(f"bit {bit} of {path.name}: {type(error).__name__}: {error}")
    path.write_bytes(content)
    return refused, failures


def main() -> None:
    """Flip bits of a file of each kind."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--flips", type=int, default=1000, help="for each kind of file")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    failed = False
    for kind in KINDS:
        with tempfile.TemporaryDirectory() as name:
            path, answer = healthy_map(kind, Path(name))
            refused, failures = flip_bits(path, answer, arguments.flips, arguments.seed)
        print(f"{kind}: {refused} of {arguments.flips} refused, {len(failures)} failures")
        print("\n".join(failures), end="\n" if failures else "")
        failed |= bool(failures)
    sys.exit(failed)


if __name__ == "__main__":
    main()
