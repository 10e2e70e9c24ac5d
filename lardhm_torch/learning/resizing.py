"""Changes of the number of clusters and of the channels of a map, in place."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lardhm_torch.channels import CLASS
from lardhm_torch.learning.changes import normal_tensors
from lardhm_torch.learning.channel_sums import Layout, conformed, no_sums
from lardhm_torch.learning.map_state import PER_MAP
from lardhm_torch.learning.map_tensors import MapTensors

SPARE_FRACTION = 0.25  # spare capacity of a growing map, as a fraction of its clusters


def resize(model: MapTensors, num_clusters: int, *, keep: bool = False) -> None:
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


def _with_rows(model: MapTensors, name: str, rows: int) -> Tensor:
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


def set_channels(model: MapTensors, layout: Layout, has_class_weights: bool) -> None:
    """Give a map the channels of a layout, with sums of 0."""
    model.channel_layout = layout
    model.channel_sums = no_sums(model.centers.detach(), layout) if layout else None
    classes = len(layout.get(CLASS, ())) if has_class_weights else 0
    set_class_weights(model, model.weights.detach().new_zeros(len(model), classes))


def extend_channels(model: MapTensors, layout: Layout) -> None:
    """Give a map more channels and classes; those that it has already keep their values.

    Args:
        model: a map.
        layout: a layout that continues that of the map (`channel_sums.joint_layout`).
    """
    before = model.channel_layout
    if layout == before:
        return
    sums = model.channel_sums
    if sums is None:
        sums = no_sums(model.centers.detach(), {})
    model.channel_layout = layout
    model.channel_sums = conformed(sums, before, layout)
    if model.class_weights is not None:
        missing = len(layout[CLASS]) - model.class_weights.shape[1]
        padded = nn.functional.pad(model.class_weights.detach(), (0, missing))
        set_class_weights(model, padded)


def set_class_weights(model: MapTensors, weights: Tensor) -> None:
    """Replace the class weights (M, K) of a map; K = 0: it has none. The parameter stays the same."""
    if weights.shape[1] == 0:
        model.class_weights = None
    elif model.class_weights is None:
        model.class_weights = nn.Parameter(weights.clone())
    elif model.class_weights.shape != weights.shape:
        _set_shape(model.class_weights, weights.clone())
    else:
        model.class_weights.data.copy_(weights)
