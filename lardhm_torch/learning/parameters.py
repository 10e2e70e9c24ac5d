"""The tensors of a map: rows, and how their number changes in place."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import torch
from torch import Tensor, nn

from lardhm_torch.io import map_files
from lardhm_torch.learning.clustering import Clusters, Columns

OF_THE_WHOLE = ("origin", "posterior_scales")  # tensors that are not a row a cluster
RESERVE = 0.25  # of a map's clusters: room that a growing map keeps for more


def resize(model: Any, num_clusters: int, *, keep: bool = False) -> None:
    """Room for another number of clusters; parameters stay the same objects, so optimizers see it.

    Args:
        model: a map.
        num_clusters: how many clusters it is to have.
        keep: whether clusters keep their values, and the map a reserve for more to come, so that
            growing a little, again and again, does not copy the map each time; otherwise all is 0.
    """
    if len(model) == num_clusters:
        return
    for name, tensor in {**model._parameters, **model._buffers}.items():
        if tensor is None or name in OF_THE_WHOLE:
            continue
        room = _longer(model, name, num_clusters) if keep else _zeros(tensor, num_clusters)
        if isinstance(tensor, nn.Parameter):
            _give_room(tensor, room)
        else:
            setattr(model, name, room)


def _zeros(tensor: Tensor, rows: int) -> Tensor:
    return tensor.detach().new_zeros(rows, *tensor.shape[1:])


def _longer(model: Any, name: str, rows: int) -> Tensor:
    """The tensor with more or fewer rows, the added ones 0: in its own storage where that is enough.

    Only a reserve that was made here is used: behind another view lies somebody else's memory.
    """
    tensor = getattr(model, name).detach()
    storage, before = tensor.untyped_storage(), len(tensor)
    made_here = model._reserves.get(name) == (storage.data_ptr(), storage.nbytes())
    bytes_a_row = tensor.element_size() * tensor[:1].numel() if before else 0
    if not made_here or not 0 < rows * bytes_a_row <= storage.nbytes():
        reserve = _zeros(tensor, rows + int(RESERVE * rows))
        reserve[: min(rows, before)] = tensor[:rows]
        storage = reserve.untyped_storage()
        model._reserves[name] = (storage.data_ptr(), storage.nbytes())
        return reserve[:rows]
    longer = tensor.as_strided((rows, *tensor.shape[1:]), tensor.stride(), 0)
    longer[before:] = 0
    return longer


def _give_room(parameter: nn.Parameter, room: Tensor) -> None:
    """Another shape for the same parameter, also while answers with a graph are around.

    On the way through another dtype autograd forgets the old shape: new graphs get gradients of the
    new one, and an old graph fails loudly. (`torch.utils.swap_tensors` refuses while a graph lives.)
    """
    parameter.grad = None
    parameter.data = room.new_empty(
        0, dtype=torch.float32 if room.dtype == torch.float64 else torch.float64
    )
    parameter.data = room


def make_room(model: Any, state: dict[str, Any], prefix: str, *_: Any) -> None:
    """Before a state dict is loaded: check it whole, then take on its number of clusters."""
    extra = map_files.check_settings(state.get(prefix + "_extra_state"))
    differing = {k: (v, extra[k]) for k, v in model.settings.items() if extra[k] != v}
    if differing:
        name, (ours, theirs) = next(iter(differing.items()))
        raise ValueError(
            f"state_dict must be of a map with {name} = {ours}; got {theirs}. "
            f"Make the map with LardHilbertMap({name}={theirs}), or read the file with "
            "LardHilbertMap.load"
        )
    own = {**model._parameters, **model._buffers}
    missing = [name for name in own if not isinstance(state.get(prefix + name), Tensor)]
    if missing:
        raise ValueError(f"state_dict must hold the tensors of a map; missing: {missing}")
    num_clusters = len(torch.atleast_1d(state[prefix + "weights"]))
    for name, tensor in own.items():
        shape = tensor.shape if name in OF_THE_WHOLE else (num_clusters, *tensor.shape[1:])
        if state[prefix + name].shape != torch.Size(shape):
            raise ValueError(
                f"{prefix + name} must be {tuple(shape)} in a map of {num_clusters} clusters; "
                f"got {tuple(state[prefix + name].shape)}"
            )
    resize(model, num_clusters)


@dataclass(frozen=True)
class MapState(Columns):
    """Everything a map knows but its origin: M rows each (see `LardHilbertMap`)."""

    weights: Tensor
    centers: Tensor
    raw_scale_tril: Tensor
    is_occupied: Tensor
    counts: Tensor
    means: Tensor
    scatters: Tensor

    def rows(self, which: Tensor) -> MapState:
        """The clusters of a mask or of indices, in that order, as copies."""
        which = which.nonzero().squeeze(1) if which.dtype == torch.bool else which
        return MapState(*(tensor.index_select(0, which) for tensor in self))

    def put(self, where: Tensor, part: MapState) -> MapState:
        """A copy with the first rows of ``part`` in the places ``where`` and its others at the end."""
        count = len(where)
        return MapState(
            *(
                torch.cat([ours, theirs[count:]]).index_copy_(0, where, theirs[:count])
                for ours, theirs in zip(self, part, strict=True)
            )
        )

    def __len__(self) -> int:
        """Number of clusters M."""
        return self.weights.shape[0]

    @property
    def clusters(self) -> Clusters:
        """The moments."""
        return Clusters(self.counts, self.means, self.scatters)


def read_state(model: Any) -> MapState:
    """The map's own tensors, detached, not copied."""
    return MapState(*(getattr(model, field.name).detach() for field in fields(MapState)))


def write_state(model: Any, state: MapState) -> None:
    """Give a map other clusters: all or, if anything fails, none.

    Parameters stay the same objects, so an optimizer made before goes on (or, if it keeps a state
    of the old size, fails loudly: see `resize_optimizer`).
    """
    before = MapState(*(tensor.clone() for tensor in read_state(model)))
    try:
        assign_state(model, state)
    except BaseException:
        assign_state(model, before)
        raise


def write_rows(model: Any, where: Tensor, part: MapState) -> None:
    """Give clusters of a map other values and append new ones: all or, if anything fails, none.

    What it costs depends on the rows that change, not on the size of the map.

    Args:
        model: a map of M clusters.
        where: (Q,) rows.
        part: what to write there, and after the first Q rows the clusters to append.
    """
    size, before = len(model), read_state(model).rows(where)
    try:
        resize(model, size + len(part) - len(where), keep=True)
        assign_rows(model, where, part)
    except BaseException:
        resize(model, size, keep=True)
        assign_rows(model, where, before)
        raise
    model.posterior_variances.zero_()


def assign_rows(model: Any, where: Tensor, part: MapState) -> None:
    """Copy rows into a map, tensor by tensor; those after the first ``len(where)`` to its end."""
    count, added = len(where), len(part) - len(where)
    for tensor, rows in zip(read_state(model), part, strict=True):
        tensor.index_copy_(0, where, rows[:count])
        tensor[len(tensor) - added :] = rows[count:]


def assign_state(model: Any, state: MapState) -> None:
    """Copy the tensors of a state into a map, one by one; a posterior of the old weights goes."""
    resize(model, len(state.weights))
    model.posterior_variances.zero_()
    with torch.no_grad():
        for field, value in zip(fields(state), state, strict=True):
            getattr(model, field.name).copy_(value)


def resize_optimizer(optimizer: torch.optim.Optimizer, model: Any) -> None:
    """Make room in an optimizer's state for the clusters that `update` appended.

    An optimizer without a state per parameter (plain SGD) needs nothing after growth; Adam or
    momentum would fail with a shape mismatch. Old rows keep their state, new ones start at 0.

    Args:
        optimizer: an optimizer of the map's parameters.
        model: the map, after `update`.

    Raises:
        ValueError: the map has fewer clusters than the state: rows are gone (`crop`, `fit`) and
            which is not known. Make a new optimizer.
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
