"""OctoMap through octomap-python: an octree of voxels, log-odds added up ray by ray."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.scans import Scans

UNKNOWN = -1  # what getLabels answers where no ray came


class OctoMapBaseline:
    """Voxel occupancy with OctoMap's default sensor model (hit 0.7, miss 0.4, clamped at both ends).

    It runs on the CPU in three dimensions. As in the map, an origin is subtracted first: the tree
    spans only 2^16 voxels along each axis.

    Args:
        resolution: edge of a voxel [m].

    Source: Hornung et al. 2013, "OctoMap", doi:10.1007/s10514-012-9321-0.
    """

    def __init__(self, resolution: float = 0.1) -> None:
        if not 0 < resolution < float("inf"):
            raise ValueError(f"resolution must be > 0 m and finite; got {resolution}")
        self.resolution = float(resolution)
        self.origin = torch.zeros(3, dtype=torch.float64)  # [m], world = tree + origin
        self.tree: Any = None

    def fit(self, scans: Scans) -> OctoMapBaseline:
        """Insert all rays, one scan after the other, into a new tree.

        Only first returns are inserted: a beam without return, or a later return of a pulse, does
        not fit OctoMap's rule that a ray is free up to an occupied end.

        Raises:
            ImportError: octomap-python is not installed.
            ValueError: scans are not 3-D, or hold no first return with finite coordinates.
        """
        if scans.dim != 3:
            raise ValueError(f"scans must be 3-D for OctoMap; got {scans.dim}-D")
        finite = scans.ends.isfinite().all(dim=1) & scans.ray_origins.isfinite().all(dim=1)
        rays = scans.select(finite & scans.is_return & (scans.target_index == 1))
        if len(rays) == 0:
            raise ValueError(f"scans must hold at least one first return; got none of {len(scans)}")
        tree = new_tree(self.resolution)
        self.origin = rays.ends.mean(dim=0).round().cpu()
        for scan in rays.scan_id.unique().tolist():
            ends = to_array(rays.ends[rays.scan_id == scan].cpu() - self.origin)
            tree.insertPointCloud(ends, to_array(rays.origins[scan].cpu() - self.origin))
        self.tree = tree
        return self

    def probability(self, points: Tensor) -> Tensor:
        """(N, 3) world positions [m] -> (N,) probability of the voxel; exactly 1/2 where unknown.

        Raises:
            RuntimeError: nothing was inserted yet.
            ValueError: points are not (N, 3).
        """
        if self.tree is None:
            raise RuntimeError("probability needs a tree; call fit(scans) first")
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points must be (N, 3); got {tuple(points.shape)}")
        # float32 is the library's own precision, but its single search takes float64 for the key:
        # beside a voxel's border the two would answer for different voxels.
        local = to_array((points.detach().cpu().double() - self.origin).float())
        probability = np.full(len(local), 0.5)
        for row in np.flatnonzero(self.tree.getLabels(local) != UNKNOWN):
            # one by one: the library answers in batches with classes only
            probability[row] = self.tree.search(local[row]).getOccupancy()
        return torch.from_numpy(probability).to(points.device)

    __call__ = probability


def new_tree(resolution: float) -> Any:
    """An empty octree of octomap-python, or an ImportError that says what to install."""
    try:
        import octomap
    except ImportError as error:
        raise ImportError(
            "OctoMap trees need octomap-python, which is not installed; "
            'install the extra: pip install "lardhm_torch[octomap]"'
        ) from error
    return octomap.OcTree(resolution)


def to_array(tensor: Tensor) -> np.ndarray:
    """Contiguous float64 array, which the library reads without conversion."""
    return np.ascontiguousarray(tensor, dtype=np.float64)
