"""OctoMap trees of octomap-python, an optional library."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor


def new_tree(resolution: float) -> Any:
    """An empty octree of octomap-python; an ImportError without it names the extra to install."""
    try:
        import octomap
    except ImportError as error:
        raise ImportError(
            "OctoMap trees need octomap-python, which is not installed; "
            'install the extra: pip install "lardhm_torch[octomap]"'
        ) from error
    return octomap.OcTree(resolution)


def to_array(tensor: Tensor) -> np.ndarray:
    """Contiguous float64 array, as octomap-python needs it."""
    return np.ascontiguousarray(tensor, dtype=np.float64)
