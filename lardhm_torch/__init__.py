"""LARD Hilbert Maps in PyTorch: continuous, probabilistic maps of occupancy from range scans."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lardhm_torch.hilbert_map import LardHilbertMap
    from lardhm_torch.io.scan_files import iter_scans, load_scans, save_scans
    from lardhm_torch.learning.fine_tuning import TuneConfig, fine_tune
    from lardhm_torch.learning.fitting import FitConfig
    from lardhm_torch.learning.map_merging import merge_maps
    from lardhm_torch.learning.parameters import resize_optimizer
    from lardhm_torch.learning.update import UpdateConfig
    from lardhm_torch.queries.grids import grid
    from lardhm_torch.queries.raycasting import raycast
    from lardhm_torch.sampling import Samples, SamplingConfig, sample_rays
    from lardhm_torch.scans import Scans, split_rays
    from lardhm_torch.simulation import simulate_room
    from lardhm_torch.streaming import StreamConfig, resume_stream, stream_scans
    from lardhm_torch.surfaces.meshing import extract_mesh
    from lardhm_torch.tiles.tiled_map import TiledMap

_ROOM_OF = {
    "FitConfig": "learning.fitting",
    "LardHilbertMap": "hilbert_map",
    "Samples": "sampling",
    "SamplingConfig": "sampling",
    "Scans": "scans",
    "StreamConfig": "streaming",
    "TiledMap": "tiles.tiled_map",
    "TuneConfig": "learning.fine_tuning",
    "UpdateConfig": "learning.update",
    "extract_mesh": "surfaces.meshing",
    "fine_tune": "learning.fine_tuning",
    "grid": "queries.grids",
    "iter_scans": "io.scan_files",
    "load_scans": "io.scan_files",
    "merge_maps": "learning.map_merging",
    "raycast": "queries.raycasting",
    "resize_optimizer": "learning.parameters",
    "resume_stream": "streaming",
    "sample_rays": "sampling",
    "save_scans": "io.scan_files",
    "simulate_room": "simulation",
    "split_rays": "scans",
    "stream_scans": "streaming",
}

__all__ = [
    "FitConfig",
    "LardHilbertMap",
    "Samples",
    "SamplingConfig",
    "Scans",
    "StreamConfig",
    "TiledMap",
    "TuneConfig",
    "UpdateConfig",
    "extract_mesh",
    "fine_tune",
    "grid",
    "iter_scans",
    "load_scans",
    "merge_maps",
    "raycast",
    "resize_optimizer",
    "resume_stream",
    "sample_rays",
    "save_scans",
    "simulate_room",
    "split_rays",
    "stream_scans",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import lardhm_torch` is instant."""
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    """Public names, for tab completion."""
    return __all__
