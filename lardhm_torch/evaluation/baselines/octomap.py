"""OctoMap by octomap-python: an octree of voxels whose log-odds are summed over rays."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from lardhm_torch.io.octrees import new_tree, to_array
from lardhm_torch.scans import Scans

UNKNOWN = -1  # label of unobserved voxels in getLabels


class OctoMapBaseline:
    """Voxel occupancy with OctoMap's default sensor model (hit 0.7, miss 0.4, clamped log-odds).

    It runs on the CPU and in 3-D only. An origin is subtracted from all coordinates, because a tree
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
        """Insert all rays into a new tree, scan by scan.

        Only first returns are inserted. OctoMap assumes that a ray is free up to an occupied end,
        which does not hold for no-returns and for later returns of a pulse.

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
            RuntimeError: `fit` has not been called.
            ValueError: points are not (N, 3).
        """
        if self.tree is None:
            raise RuntimeError("probability needs a tree; call fit(scans) first")
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"points must be (N, 3); got {tuple(points.shape)}")
        # getLabels works in float32 and search in float64; rounding first makes both use the same
        # voxel near a voxel border
        local = to_array((points.detach().cpu().double() - self.origin).float())
        probability = np.full(len(local), 0.5)
        for row in np.flatnonzero(self.tree.getLabels(local) != UNKNOWN):
            # one by one: the batch query of the library returns labels only
            probability[row] = self.tree.search(local[row]).getOccupancy()
        return torch.from_numpy(probability).to(points.device)

    __call__ = probability
