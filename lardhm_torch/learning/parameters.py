"""The tensors of a map as a torch module, with in-place changes of the number of clusters."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import fields
from functools import partial
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from lardhm_torch.features import Kernel, kernel_factors
from lardhm_torch.io import map_files
from lardhm_torch.learning.changes import normal_tensors
from lardhm_torch.learning.map_state import EVIDENCE, MapState, no_evidence
from lardhm_torch.learning.state_checks import check_settings, check_values

PER_MAP = ("origin", "posterior_scales")  # tensors without one row per cluster
HISTORY = ("evidence", "losses", "doubts", "fresh")  # used by updates only
AnyMap = TypeVar("AnyMap", bound="MapParameters")
SPARE_FRACTION = 0.25  # spare capacity of a growing map, as a fraction of its clusters

# OpenMP hangs in the child of a fork whose parent used it; DataLoader workers have one thread, too.
os.register_at_fork(after_in_child=partial(torch.set_num_threads, 1))


class MapParameters(nn.Module):
    """Tensors and settings of a map: everything in its state dict.

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
    posterior_means: Tensor
    posterior_variances: Tensor
    posterior_scales: Tensor
    origin: Tensor

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
        self.is_packed = False  # the map answers but does not learn: it was rounded to be sent
        with normal_tensors():
            self._register_empty(dim, device, dtype)
        self._index = torch.empty(0, dtype=torch.uint8)
        self._spare_storages: dict[str, tuple[int, int]] = {}  # of storages with spare capacity
        self.register_load_state_dict_pre_hook(make_room)
        self.register_state_dict_post_hook(drop_spare_rows)

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
            "posterior_means": weights.new_zeros(0),
            "posterior_variances": weights.new_zeros(0),
            "posterior_scales": weights.new_ones(2),
            "origin": weights.new_zeros(dim, dtype=torch.float64),
        }
        for name, tensor in buffers.items():
            self.register_buffer(name, tensor)

    @classmethod
    def from_state(cls: type[AnyMap], state: dict[str, Any]) -> AnyMap:
        """A map with the settings and tensors of a state dict."""
        model = cls(**map_files.map_settings(state), dtype=state["centers"].dtype)
        model.load_state_dict(state)
        return model

    def __len__(self) -> int:
        """Number of clusters M."""
        return len(self.weights)

    def __bool__(self) -> bool:
        """True, even if the map is empty."""
        return True

    @property
    def scale_tril(self) -> Tensor:
        """(M, D, D) lower Cholesky factors of the kernels [m], settings of the kernel applied."""
        return kernel_factors(at_least_float32(self.raw_scale_tril), self.kernel)

    @property
    def kernel(self) -> Kernel:
        """Number of neighbors, covariance scale and minimum length-scale of the kernels."""
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

    def parameter_groups(self, weight_decay: float = 0.0) -> list[dict[str, Any]]:
        """Parameter groups for an optimizer, with weight decay on the weights only.

        Weight decay would pull centers to the map's origin and length-scales to 1 m.
        """
        return [
            {"params": [self.weights], "weight_decay": weight_decay},
            {"params": [self.centers, self.raw_scale_tril], "weight_decay": 0.0},
        ]

    def extra_repr(self) -> str:
        """Number of clusters and settings, for `print(model)`."""
        settings = ", ".join(f"{name}={value}" for name, value in self.settings.items())
        return f"num_clusters={len(self)}, {settings}"

    def get_extra_state(self) -> dict[str, Any]:
        """Format version and settings, stored in the state dict with the tensors."""
        packed = {"is_packed": True} if self.is_packed else {}
        return {"format_version": map_files.FORMAT_VERSION, **self.settings, **packed}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Whether the map is packed; `make_room` has already checked that the settings agree."""
        self.is_packed = bool(state.get("is_packed", False))

    def check_learns(self) -> None:
        """Raise a ValueError if the map is packed: it has lost what learning continues from."""
        if self.is_packed:
            raise ValueError(
                "model must hold what it learned from; a packed map answers but does not learn. "
                "Load the file written by save, or make a new map"
            )

    def _apply(self, fn: Any, recurse: bool = True) -> MapParameters:
        """Cast all tensors except the origin, which remains float64 (`.to()`, `.float()`, ...)."""
        origin = self.origin
        with normal_tensors():
            super()._apply(fn, recurse)
        if self.origin.dtype != torch.float64:
            self.origin = origin.to(self.origin.device)
        return self


def at_least_float32(tensor: Tensor) -> Tensor:
    """The tensor itself, or a float32 copy of one of half precision: maps never compute in that."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def resize(model: MapParameters, num_clusters: int, *, keep: bool = False) -> None:
    """Change the number of clusters. Parameters remain the same objects, so optimizers stay valid.

    Args:
        model: a map.
        num_clusters: new number of clusters.
        keep: True: keep the values of the clusters, and allocate spare capacity, so that repeated
            small growth does not copy the map each time. False: set all values to 0.
    """
    if len(model) == num_clusters:
        return
    with normal_tensors():
        for name, tensor in list(model.state_tensors()):
            if name in PER_MAP:
                continue
            room = _with_rows(model, name, num_clusters) if keep else _zeros(tensor, num_clusters)
            if isinstance(tensor, nn.Parameter):
                _set_shape(tensor, room)
            else:
                setattr(model, name, room)


def _zeros(tensor: Tensor, rows: int) -> Tensor:
    return tensor.detach().new_zeros(rows, *tensor.shape[1:])


def _with_rows(model: MapParameters, name: str, rows: int) -> Tensor:
    """The tensor with a different number of rows. Added rows are 0.

    The storage is reused if it is large enough and was allocated by this function. Any other storage
    may be shared with other tensors.
    """
    tensor = getattr(model, name).detach()
    storage, before = tensor.untyped_storage(), len(tensor)
    made_here = model._spare_storages.get(name) == (storage.data_ptr(), storage.nbytes())
    bytes_per_row = tensor.element_size() * tensor[:1].numel() if before else 0
    if not made_here or not 0 < rows * bytes_per_row <= storage.nbytes():
        reserve = _zeros(tensor, rows + int(SPARE_FRACTION * rows))
        reserve[: min(rows, before)] = tensor[:rows]
        storage = reserve.untyped_storage()
        model._spare_storages[name] = (storage.data_ptr(), storage.nbytes())
        return reserve[:rows]
    resized = tensor.as_strided((rows, *tensor.shape[1:]), tensor.stride(), 0)
    resized[before:] = 0
    return resized


def _set_shape(parameter: nn.Parameter, room: Tensor) -> None:
    """Change the shape of a parameter in place, even if it is part of an autograd graph.

    The temporary change of dtype makes autograd discard the old shape. New graphs then compute
    gradients of the new shape, and backpropagation through an old graph raises an error.
    (`torch.utils.swap_tensors` fails as long as a graph exists.)
    """
    parameter.grad = None
    parameter.data = room.new_empty(
        0, dtype=torch.float32 if room.dtype == torch.float64 else torch.float64
    )
    parameter.data = room


def make_room(model: MapParameters, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Pre-hook of `load_state_dict`: validate the state dict and adopt its number of clusters."""
    extra = map_files.check_settings(state.get(prefix + "_extra_state"))
    differing = {k: (v, extra[k]) for k, v in model.settings.items() if extra[k] != v}
    if differing:
        name, (ours, theirs) = next(iter(differing.items()))
        raise ValueError(
            f"state_dict must be of a map with {name} = {ours}; got {theirs}. "
            f"Make the map with LardHilbertMap({name}={theirs}), or read the file with "
            "LardHilbertMap.load"
        )
    _fill_evidence(state, prefix)
    own = dict(model.state_tensors())
    missing = [name for name in own if not isinstance(state.get(prefix + name), Tensor)]
    if missing:
        raise ValueError(f"state_dict must hold the tensors of a map; missing: {missing}")
    num_clusters = len(torch.atleast_1d(state[prefix + "weights"]))
    for name, tensor in own.items():
        shape = tensor.shape if name in PER_MAP else (num_clusters, *tensor.shape[1:])
        if state[prefix + name].shape != torch.Size(shape):
            raise ValueError(
                f"{prefix + name} must be {tuple(shape)} in a map of {num_clusters} clusters; "
                f"got {tuple(state[prefix + name].shape)}"
            )
    check_values({name: state[prefix + name] for name in own})
    resize(model, num_clusters)


def _fill_evidence(state: dict[str, Any], prefix: str) -> None:
    """Add empty evidence to the state dict of a map that was saved without it."""
    centers = state.get(prefix + "centers")
    if not isinstance(centers, Tensor) or centers.ndim != 2:
        return
    for name in HISTORY:
        if len(state.get(prefix + name, ())) == 0:
            rows = centers.new_zeros(len(centers))
            state[prefix + name] = no_evidence(centers) if name == "evidence" else rows


def drop_spare_rows(model: MapParameters, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Post-hook of `state_dict`: copy tensors with spare capacity, which would be saved otherwise."""
    for name, _tensor in model.state_tensors():
        state[prefix + name] = map_files.without_spare_memory(state[prefix + name])


def read_state(model: MapParameters) -> MapState:
    """The tensors of the map, detached but not copied."""
    return MapState(*(getattr(model, field.name).detach() for field in fields(MapState)))


def write_state(model: MapParameters, state: MapState, origin: Tensor) -> None:
    """Replace the clusters and the origin of a map. If anything fails, the map is unchanged.

    Parameters remain the same objects, so existing optimizers stay valid. If an optimizer holds state
    of the old size, its next step raises an error; see `resize_optimizer`.

    Args:
        model: map, changed in place.
        state: M clusters.
        origin: (D,) float64, world = map + origin [m].
    """
    before = MapState(*(tensor.clone() for tensor in read_state(model)))
    try:
        assign_state(model, state)
    except BaseException:
        assign_state(model, before)
        raise
    model.origin = origin


def write_rows(model: MapParameters, where: Tensor, part: MapState, removed: Tensor) -> None:
    """Overwrite rows of a map, append new ones, and remove others. If it fails, nothing changes.

    The cost depends on the number of changed rows, not on the size of the map. The last rows of the
    map take the places of removed ones.

    Args:
        model: a map of M clusters.
        where: (Q,) rows to overwrite.
        part: Q rows to write there, followed by the clusters to append.
        removed: (R,) rows to remove; clusters are only appended if R = 0.
    """
    size = len(model)
    left = size + len(part) - len(where) - len(removed)
    tail = torch.arange(left, max(left, size), device=removed.device)
    holes = removed[removed < left]
    touched = torch.cat([where, holes, tail])
    before = read_state(model).rows(touched)
    try:
        resize(model, size + len(part) - len(where), keep=True)
        assign_rows(model, where, part)
        if len(removed):
            assign_rows(model, holes, read_state(model).rows(tail[~torch.isin(tail, removed)]))
            resize(model, left, keep=True)
    except BaseException:
        resize(model, size, keep=True)
        assign_rows(model, touched, before)
        raise
    model.posterior_variances.zero_()


def assign_rows(model: MapParameters, where: Tensor, part: MapState) -> None:
    """Copy the first ``len(where)`` rows into rows ``where`` of a map, and the others to its end."""
    count, added = len(where), len(part) - len(where)
    for tensor, rows in zip(read_state(model), part, strict=True):
        tensor.index_copy_(0, where, rows[:count])
        tensor[len(tensor) - added :] = rows[count:]


def assign_state(model: MapParameters, state: MapState) -> None:
    """Copy the tensors of a state into a map, and reset the posterior of the weights."""
    resize(model, len(state.weights))
    model.posterior_variances.zero_()
    model.posterior_scales.fill_(1.0)
    with torch.no_grad():
        for field, value in zip(fields(state), state, strict=True):
            getattr(model, field.name).copy_(value)


def resize_optimizer(optimizer: torch.optim.Optimizer, model: MapParameters) -> None:
    """Extend the state of an optimizer to the clusters that `update` appended.

    Adam or SGD with momentum would otherwise fail with a shape mismatch; plain SGD has no state.
    Existing rows keep their state, and new rows start at 0.

    Args:
        optimizer: an optimizer of the map's parameters.
        model: the map, after `update`.

    Raises:
        ValueError: the map has fewer clusters than the state, because `crop` or `fit` removed
            rows. In this case, create a new optimizer.
    """
    for parameter in model.parameters():
        for name, value in optimizer.state.get(parameter, {}).items():
            if not isinstance(value, Tensor) or value.shape[1:] != parameter.shape[1:]:
                continue
            if value.ndim != parameter.ndim or len(value) == len(parameter):
                continue
            if len(value) > len(parameter):
                raise ValueError(
                    f"optimizer must hold at most {len(parameter)} clusters; its {name} holds "
                    f"{len(value)}. Make a new optimizer after crop or fit"
                )
            room = value.new_zeros(len(parameter) - len(value), *value.shape[1:])
            optimizer.state[parameter][name] = torch.cat([value, room])
