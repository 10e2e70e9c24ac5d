"""LARD Hilbert Maps in PyTorch: continuous, probabilistic maps of occupancy from range scans."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lardhm_torch.fitting import FitConfig
    from lardhm_torch.hilbert_map import LardHilbertMap
    from lardhm_torch.io import load_scans, save_scans
    from lardhm_torch.meshing import extract_mesh
    from lardhm_torch.querying import grid
    from lardhm_torch.rays import raycast
    from lardhm_torch.sampling import Samples, SamplingConfig, sample_rays
    from lardhm_torch.scans import Scans, split_rays
    from lardhm_torch.simulation import simulate_room
    from lardhm_torch.tuning import TuneConfig, fine_tune

_ROOM_OF = {
    "FitConfig": "fitting",
    "LardHilbertMap": "hilbert_map",
    "Samples": "sampling",
    "SamplingConfig": "sampling",
    "Scans": "scans",
    "TuneConfig": "tuning",
    "extract_mesh": "meshing",
    "fine_tune": "tuning",
    "grid": "querying",
    "load_scans": "io",
    "raycast": "rays",
    "sample_rays": "sampling",
    "save_scans": "io",
    "simulate_room": "simulation",
    "split_rays": "scans",
}

__all__ = [
    "FitConfig",
    "LardHilbertMap",
    "Samples",
    "SamplingConfig",
    "Scans",
    "TuneConfig",
    "extract_mesh",
    "fine_tune",
    "grid",
    "load_scans",
    "raycast",
    "sample_rays",
    "save_scans",
    "simulate_room",
    "split_rays",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import lardhm_torch` is instant."""
    if name not in _ROOM_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_ROOM_OF[name]}"), name)


def __dir__() -> list[str]:
    """Public names, for tab completion."""
    return __all__
