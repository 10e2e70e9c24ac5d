"""Maps as ONNX models, for runtimes other than PyTorch."""

from __future__ import annotations

import importlib.util
import os
import warnings

import torch
from torch import Tensor, nn

from lardhm_torch import features
from lardhm_torch.io.atomic_files import replaced_file
from lardhm_torch.maps import OccupancyMap, num_neighbors, reads_map

OPSET = 18
LIBRARIES = ("onnx", "onnxscript")


class PlainMap(nn.Module):
    """The definition of a map in operations that ONNX has: an exhaustive search for the neighbors."""

    origin: Tensor
    centers: Tensor
    scale_tril: Tensor
    weights: Tensor

    def __init__(self, model: OccupancyMap) -> None:
        super().__init__()
        dtype = torch.promote_types(model.centers.dtype, torch.float32)
        centers = model.centers.detach().to(dtype)
        self.register_buffer("origin", model.origin.double())
        self.register_buffer("centers", centers)
        self.register_buffer("scale_tril", model.scale_tril.detach().to(dtype))
        self.register_buffer("weights", model.weights.detach().to(dtype))
        self.num_neighbors = min(num_neighbors(model), len(centers))

    def forward(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m], float64 -> (N,) probability; NaN where points are not finite."""
        local = (points - self.origin).to(self.centers.dtype)
        squared = features.squared_distances(local[:, None], self.centers[None])
        indices = squared.topk(self.num_neighbors, dim=1, largest=False).indices
        values = features.lard_kernel(local, self.centers, self.scale_tril, indices)
        values = values * features.neighbor_fade(local, self.centers, indices)
        return torch.sigmoid((values * self.weights[indices]).sum(dim=1) + 0 * local.sum(dim=1))


@reads_map
def save_onnx(model: OccupancyMap, path: str | os.PathLike[str]) -> None:
    """Export `model(points)` as an ONNX model of opset 18.

    The input ``points`` (N, D) are world positions [m] in float64, with N >= 1. The output
    ``probability`` (N,) has the dtype of the map, at least float32. The model has no search index and
    computes the distance from every point to every cluster, so time and memory grow with N times
    the number of clusters. Channels, classes and the posterior of the weights are not exported.

    Args:
        model: a map with at least one cluster.
        path: the file to write; an existing file is replaced.

    Raises:
        ImportError: the libraries onnx and onnxscript are not installed.
        ValueError: the map is empty.
    """
    if missing := [name for name in LIBRARIES if importlib.util.find_spec(name) is None]:
        raise ImportError(
            f"ONNX models need {' and '.join(missing)}, which is not installed; "
            'install the extra: pip install "lardhm_torch[onnx]"'
        )
    if len(model.weights) == 0:
        raise ValueError("model must have at least one cluster to be exported; this map is empty")
    example = model.origin.detach().cpu().double().repeat(3, 1)
    plain = PlainMap(model).eval().cpu()
    with warnings.catch_warnings(), replaced_file(path) as partial:
        warnings.simplefilter("ignore")  # of the exporter's own dependencies
        program = torch.onnx.export(
            plain,
            (example,),
            input_names=["points"],
            output_names=["probability"],
            dynamic_shapes=({0: torch.export.Dim("count", min=1)},),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
        assert program is not None
        program.save(partial)
