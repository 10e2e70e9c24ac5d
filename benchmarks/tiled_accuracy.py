"""Accuracy that tiles lose: a single map and a tiled map of the same rays, on held-out rays.

The protocol is that of `accuracy.py`, with half of the rays training; the folders of tiles are made
and fitted as `lardhm tile` and `lardhm fit-tiles` do it. Exit code 1 if tiles lose more than
`MOST_LOST` anywhere.

    python benchmarks/tiled_accuracy.py --data ../shared/data            # the table of docs/scale.md
    python benchmarks/tiled_accuracy.py --data ../shared/data --rows 0   # its first row
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from accuracy import Scores, find_sets, lard_hilbert_map
from conditions import ROOT, conditions, describe, write_json

from lardhm_torch import Scans, TiledMap, load_scans, split_rays
from lardhm_torch.evaluation.held_out import evaluate, protocol_rays
from lardhm_torch.tiles.fitting import fit_tiles
from lardhm_torch.tiles.routing import TilingConfig, tile_scans

MOST_LOST = 0.002  # of the balanced accuracy
RATIO = 0.5  # of the rays trains


class Row(NamedTuple):
    """A row of the table: a set, its tiling, and which of its rays."""

    name: str
    edge: float  # [m] of a tile
    seed: int = 0
    rays: int | None = 120_000  # at most; None: all
    halo: float | None = None  # [m] None: the default


ROWS = (
    *(Row("kitti00_mulls", 20, seed) for seed in range(5)),
    *(Row("balm_realworld", 10, seed) for seed in range(5)),
    Row("kitti00_mulls", 20, rays=None, halo=1.0),
    Row("balm_realworld", 20, rays=None, halo=1.0),
)


def tiled_map(train: Scans, row: Row, folder: Path) -> TiledMap:
    """Tile the rays and fit the tiles."""
    tile_scans([train], folder, TilingConfig(edge=row.edge, halo=row.halo, seed=row.seed))
    fit_tiles(folder)
    return TiledMap.open(folder)


def run_row(row: Row, scans: Scans) -> dict[str, Scores | int]:
    """Scores of both maps, and their numbers of clusters and tiles."""
    train, test = split_rays(protocol_rays(scans, row.rays, row.seed), RATIO, row.seed)
    single = lard_hilbert_map(train, row.seed)
    with tempfile.TemporaryDirectory() as folder:
        tiled = tiled_map(train, row, Path(folder))
        return {
            "one map": evaluate(single, test, row.seed),
            "tiles": evaluate(tiled, test, row.seed),
            "clusters of one map": len(single),
            "clusters of tiles": len(tiled),
            "number of tiles": len(tiled.manifest.tiles),
        }


def accuracies(scores: Scores) -> list[float]:
    """Balanced accuracy at the two kinds of free point."""
    return [scores[kind]["balanced_accuracy"] for kind in ("unif", "near")]


def changes(result: dict[str, Scores | int]) -> list[float]:
    """Accuracy that tiles gain (or lose, if negative)."""
    pairs = zip(accuracies(result["one map"]), accuracies(result["tiles"]), strict=True)
    return [tiles - single for single, tiles in pairs]


def format_pair(values: list[float], style: str = ".4f") -> str:
    """Format two figures below 1 without leading zeros."""
    return " / ".join(format(value, style).replace("0.", ".") for value in values)


def format_row(row: Row, result: dict[str, Scores | int]) -> str:
    """A row of the table, in Markdown."""
    rays = "all" if row.rays is None else f"{row.rays:,}"
    halo = f", halo {row.halo:g} m" if row.halo else ""
    cells = [
        f"`{row.name}`, {rays} rays, seed {row.seed}{halo}",
        f"{row.edge:g} m, {result['number of tiles']}",
        format_pair(accuracies(result["one map"])),
        format_pair(accuracies(result["tiles"])),
        format_pair(changes(result), "+.4f"),
        f"{result['clusters of one map']:,} / {result['clusters of tiles']:,}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--rows", type=int, nargs="+", default=range(len(ROWS)))
    parser.add_argument("--json", type=Path, default=ROOT / "out" / "tiled_accuracy.json")
    arguments = parser.parse_args()
    rows = [ROWS[number] for number in arguments.rows]
    paths = find_sets(arguments.data, sorted({row.name for row in rows}))
    scans = {name: load_scans(path) for name, path in paths.items()}
    record = {"conditions": conditions(), "rows": []}
    print(describe(record["conditions"]), end="\n\n")
    print("| rays | edge, tiles | one map | tiles | change | clusters |\n|---|---|---|---|---|---|")
    lost = 0.0
    for row in rows:
        result = run_row(row, scans[row.name])
        print(format_row(row, result), flush=True)
        record["rows"].append({**row._asdict(), **result})
        lost = max(lost, *(-change for change in changes(result)))
    print(f"\ntiles lose at most {lost:.4f}")
    write_json(arguments.json, record)
    sys.exit(lost > MOST_LOST)


if __name__ == "__main__":
    main()
