"""How thick the surfaces of a map are: the step at which rays are sampled where none is given.

A map is anything with ``scale_tril`` and ``weights`` as those of `LardHilbertMap`, or with
``thickness_counts()``: a map in tiles knows these without reading a tile.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

BINS_AN_OCTAVE = 16  # by which thicknesses are counted: 4 % from one to the next


def thickness_counts(model: Any) -> dict[int, int]:
    """How many of the clusters that speak for occupied have which thickness, in bins.

    A cluster's thickness t is its smallest standard deviation; it is in bin
    floor(`BINS_AN_OCTAVE` log2(t / 1 m)). Counts of parts of a map add up to those of the whole.
    """
    factors = model.scale_tril[model.weights > 0].detach().double()
    thickness = torch.linalg.svdvals(factors)[:, -1].clamp(min=1e-30)
    bins, counts = (BINS_AN_OCTAVE * thickness.log2()).floor().long().unique(return_counts=True)
    return dict(zip(bins.tolist(), counts.tolist(), strict=True))


def surface_step(model: Any) -> float:
    """Median thickness of the clusters that speak for occupied [m], to 2 %: the middle of its bin.

    In bins, so that a map in tiles has the very step that it would have in one piece.

    Raises:
        ValueError: the map has no such cluster and so no surface.
    """
    known = hasattr(model, "thickness_counts")
    counts: Mapping[int, int] = model.thickness_counts() if known else thickness_counts(model)
    if not counts:
        raise ValueError("the map must hold a cluster of positive weight; got none: give a step")
    left = (sum(counts.values()) - 1) // 2
    for number in sorted(counts):
        left -= counts[number]
        if left < 0:
            break
    return float(2 ** ((number + 0.5) / BINS_AN_OCTAVE))
