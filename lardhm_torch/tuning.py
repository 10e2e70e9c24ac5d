"""Length-scales, centers and weights learned together, by backpropagation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, kw_only=True)
class TuneConfig:
    """How a map is fine-tuned. Rates are in units of each cluster, so they fit every scene."""

    epochs: int = 8
    batch_size: int | None = None  # points a step; None: N / 64, at least 1024
    weight_rate: float = 0.1
    center_rate: float = 0.03  # of a cluster's mean length-scale, a step
    scale_rate: float = 0.03  # of the logarithm of the length-scales, a step
    l2: float = 0.03  # on the weights, against the sum of the losses of all points
    hold_out: float = 0.1  # share of the rays that choose the best epoch; 0: keep the last
    tune_weights: bool = True
    tune_centers: bool = True
    tune_scales: bool = True

    def __post_init__(self) -> None:
        if self.epochs < 1:
            raise ValueError(f"epochs must be 1 or more; got {self.epochs}")
        if self.batch_size is not None and self.batch_size < 1:
            raise ValueError(f"batch_size must be 1 or more; got {self.batch_size}")
        if min(self.weight_rate, self.center_rate, self.scale_rate) <= 0 or self.l2 < 0:
            raise ValueError("rates must be > 0 and l2 must be 0 or more")
        if not 0 <= self.hold_out < 1:
            raise ValueError(f"hold_out must be in [0, 1); got {self.hold_out}")
