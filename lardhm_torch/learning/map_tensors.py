"""The tensors and settings of a map as a torch module."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from lardhm_torch import native
from lardhm_torch.features import Kernel, kernel_factors
from lardhm_torch.learning.changes import DTYPES, normal_tensors
from lardhm_torch.learning.channel_sums import Layout
from lardhm_torch.learning.map_lock import MapLock
from lardhm_torch.learning.map_state import EVIDENCE
from lardhm_torch.learning.points import as_tensor, check_points, to_map_frame
from lardhm_torch.learning.state_checks import check_settings
from lardhm_torch.maps import TensorLike

AnyTensors = TypeVar("AnyTensors", bound="MapTensors")


class MapTensors(nn.Module):
    """Tensors and settings of a map, and what every query of them needs.

    Args and attributes: see `LardHilbertMap`.
    """

    weights: nn.Parameter
    centers: nn.Parameter
    raw_scale_tril: nn.Parameter
    is_occupied: Tensor
    counts: Tensor
    means: Tensor
    scatters: Tensor
    evidence: Tensor
    losses: Tensor
    doubts: Tensor
    fresh: Tensor
    times: Tensor
    posterior_means: Tensor
    posterior_variances: Tensor
    posterior_scales: Tensor
    origin: Tensor
    channel_sums: Tensor | None
    class_weights: nn.Parameter | None

    def __init__(
        self,
        dim: int = 3,
        num_neighbors: int = 16,
        *,
        covariance_scale: float = 4.0,
        min_lengthscale: float = 0.01,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_settings(dim, num_neighbors, covariance_scale, min_lengthscale)
        self.dim = dim
        self.num_neighbors = num_neighbors
        self.covariance_scale = float(covariance_scale)
        self.min_lengthscale = float(min_lengthscale)
        self.max_age: float | None = None  # [s], see `LardHilbertMap`
        self.is_packed = False  # a packed map is rounded, for queries only
        with normal_tensors():
            self._register_empty(dim, device, dtype)
        self.channel_layout: Layout = {}  # of channel_sums; see `channel_sums`
        self.class_scale = 1.0  # of the class log-odds; see `LardHilbertMap.calibrate_classes`
        self.lock = MapLock()
        self._index = torch.empty(0, dtype=torch.uint8)
        self._regressions: dict[str, Any] = {}  # of the channels; see `channel_queries`
        self._spare_storages: dict[str, tuple[int, int]] = {}  # of storages with spare capacity
        self._register_hooks()

    def _register_hooks(self) -> None:
        """Register hooks of the state dict; none here."""

    def _register_empty(
        self, dim: int, device: torch.device | str | None, dtype: torch.dtype | None
    ) -> None:
        """Register parameters and buffers without clusters."""
        weights = torch.zeros(0, device=device, dtype=dtype)
        if not weights.is_floating_point():
            raise ValueError(f"dtype must be a floating point type; got {dtype}")
        columns = {
            "weights": nn.Parameter(weights),
            "centers": nn.Parameter(weights.new_zeros(0, dim), requires_grad=False),
            "raw_scale_tril": nn.Parameter(weights.new_zeros(0, dim, dim), requires_grad=False),
        }
        for name, parameter in columns.items():
            self.register_parameter(name, parameter)
        buffers = {
            "is_occupied": weights.new_zeros(0, dtype=torch.bool),
            "counts": weights.new_zeros(0, dtype=torch.long),
            "means": weights.new_zeros(0, dim),
            "scatters": weights.new_zeros(0, dim, dim),
            "evidence": weights.new_zeros(0, EVIDENCE, dim),
            "losses": weights.new_zeros(0),
            "doubts": weights.new_zeros(0),
            "fresh": weights.new_zeros(0),
            "times": weights.new_zeros(0, dtype=torch.float64),
            "posterior_means": weights.new_zeros(0),
            "posterior_variances": weights.new_zeros(0),
            "posterior_scales": weights.new_ones(2),
            "origin": weights.new_zeros(dim, dtype=torch.float64),
            "channel_sums": None,
        }
        for name, tensor in buffers.items():
            self.register_buffer(name, tensor)
        self.register_parameter("class_weights", None)

    def __len__(self) -> int:
        """Number of clusters M."""
        return len(self.weights)

    def __bool__(self) -> bool:
        """True, even if the map is empty."""
        return True

    @property
    def scale_tril(self) -> Tensor:
        """(M, D, D) lower Cholesky factors of the kernels [m], scaled and bounded by the settings."""
        return kernel_factors(at_least_float32(self.raw_scale_tril), self.kernel)

    @property
    def kernel(self) -> Kernel:
        """Number of neighbors, covariance scale and minimum length scale of the kernels."""
        return Kernel(self.num_neighbors, self.covariance_scale, self.min_lengthscale)

    @property
    def settings(self) -> dict[str, Any]:
        """Constructor arguments of an empty map with the same settings."""
        return {
            "dim": self.dim,
            "num_neighbors": self.num_neighbors,
            "covariance_scale": self.covariance_scale,
            "min_lengthscale": self.min_lengthscale,
        }

    def state_tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Names and tensors of all parameters and buffers."""
        yield from self.named_parameters(recurse=False)
        yield from self.named_buffers(recurse=False)

    def _apply(self: AnyTensors, fn: Any, recurse: bool = True) -> AnyTensors:
        """Cast all tensors except origin, times and channel sums: they remain float64 (`.to()`, ...)."""
        names = ("origin", "times", "channel_sums")
        exact = {name: getattr(self, name) for name in names}
        with self.lock.writing(), normal_tensors():
            super()._apply(fn, recurse)
            for name, tensor in exact.items():
                if tensor is not None and getattr(self, name).dtype != torch.float64:
                    setattr(self, name, tensor.to(getattr(self, name).device))
        return self

    def _tensors(self) -> tuple[Tensor, Tensor, Tensor, Kernel]:
        centers, raw = at_least_float32(self.centers), at_least_float32(self.raw_scale_tril)
        return centers, raw, at_least_float32(self.weights), self.kernel

    def _fresh_index(self) -> Tensor:
        """Index of the neighbor search. It is rebuilt if the centers have changed."""
        # The operators check the index themselves; the transforms of torch.func do not use it.
        if torch.compiler.is_compiling() or native.transformed():
            return self._index
        centers = at_least_float32(self.centers)
        known = native.index_matches(self._index, centers, self.num_neighbors)
        if not known or self._index.is_inference():
            with normal_tensors():
                self._index = native.build_index(centers, self.num_neighbors)
        return self._index

    def _to_map_frame(self, points: TensorLike) -> Tensor:
        points = as_tensor(points, "points", self.origin.device)
        check_points(points, self.dim)
        dtype = torch.promote_types(self.centers.dtype, torch.float32)
        return to_map_frame(points, self.origin, dtype)


def at_least_float32(tensor: Tensor) -> Tensor:
    """The tensor itself, or a float32 copy of one of half precision: maps never compute in that."""
    if tensor.dtype in DTYPES:  # quick: every query asks
        return tensor
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))
