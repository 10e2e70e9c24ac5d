"""LARD Hilbert Maps in PyTorch: continuous, probabilistic occupancy maps from range scans."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # for editors and type checkers; tests hold it equal to the table below
    from lardhm_torch.evaluation.held_out import evaluate as evaluate
    from lardhm_torch.hilbert_map import LardHilbertMap as LardHilbertMap
    from lardhm_torch.io.grid_files import save_grid as save_grid
    from lardhm_torch.io.mesh_files import save_mesh as save_mesh
    from lardhm_torch.io.nav2_files import save_nav2 as save_nav2
    from lardhm_torch.io.notes import ScanReport as ScanReport
    from lardhm_torch.io.onnx_files import save_onnx as save_onnx
    from lardhm_torch.io.scan_files import iter_scans as iter_scans
    from lardhm_torch.io.scan_files import load_points as load_points
    from lardhm_torch.io.scan_files import load_scans as load_scans
    from lardhm_torch.io.scan_files import save_scans as save_scans
    from lardhm_torch.learning.disagreement import scan_disagreement as scan_disagreement
    from lardhm_torch.learning.fine_tuning import TuneConfig as TuneConfig
    from lardhm_torch.learning.fine_tuning import fine_tune as fine_tune
    from lardhm_torch.learning.fitting import FitConfig as FitConfig
    from lardhm_torch.learning.map_merging import merge_maps as merge_maps
    from lardhm_torch.learning.parameters import resize_optimizer as resize_optimizer
    from lardhm_torch.learning.update import UpdateConfig as UpdateConfig
    from lardhm_torch.queries.bodies import Body as Body
    from lardhm_torch.queries.bodies import body_collision_probability as body_collision_probability
    from lardhm_torch.queries.bodies import body_distance as body_distance
    from lardhm_torch.queries.bodies import capsule_distance as capsule_distance
    from lardhm_torch.queries.bodies import collision_probability as collision_probability
    from lardhm_torch.queries.channels import channel as channel
    from lardhm_torch.queries.clearance import clearance as clearance
    from lardhm_torch.queries.collision import Mover as Mover
    from lardhm_torch.queries.collision import expected_range as expected_range
    from lardhm_torch.queries.collision import free_probability as free_probability
    from lardhm_torch.queries.collision import segment_hazard as segment_hazard
    from lardhm_torch.queries.distance import signed_distance as signed_distance
    from lardhm_torch.queries.distance import surface_distance as surface_distance
    from lardhm_torch.queries.exploration import information_gain as information_gain
    from lardhm_torch.queries.frontiers import frontiers as frontiers
    from lardhm_torch.queries.grids import grid as grid
    from lardhm_torch.queries.grids import query_grid as query_grid
    from lardhm_torch.queries.grids import query_slice as query_slice
    from lardhm_torch.queries.raycasting import raycast as raycast
    from lardhm_torch.sampling import Samples as Samples
    from lardhm_torch.sampling import SamplingConfig as SamplingConfig
    from lardhm_torch.sampling import sample_rays as sample_rays
    from lardhm_torch.scans import Scans as Scans
    from lardhm_torch.scans import split_rays as split_rays
    from lardhm_torch.simulation import simulate_room as simulate_room
    from lardhm_torch.streaming import PacketReceiver as PacketReceiver
    from lardhm_torch.streaming import PacketSender as PacketSender
    from lardhm_torch.streaming import PacketWriter as PacketWriter
    from lardhm_torch.streaming import StreamConfig as StreamConfig
    from lardhm_torch.streaming import real_time as real_time
    from lardhm_torch.streaming import resume_stream as resume_stream
    from lardhm_torch.streaming import stream_scans as stream_scans
    from lardhm_torch.surfaces.meshing import extract_mesh as extract_mesh
    from lardhm_torch.surfaces.simplification import simplify_mesh as simplify_mesh
    from lardhm_torch.tiles.tiled_map import TiledMap as TiledMap
    from lardhm_torch.viewing.viewer import MapViewer as MapViewer

_NAMES = {
    "evaluation.held_out": ["evaluate"],
    "hilbert_map": ["LardHilbertMap"],
    "io.grid_files": ["save_grid"],
    "io.mesh_files": ["save_mesh"],
    "io.nav2_files": ["save_nav2"],
    "io.notes": ["ScanReport"],
    "io.onnx_files": ["save_onnx"],
    "io.scan_files": ["iter_scans", "load_points", "load_scans", "save_scans"],
    "learning.disagreement": ["scan_disagreement"],
    "learning.fine_tuning": ["TuneConfig", "fine_tune"],
    "learning.fitting": ["FitConfig"],
    "learning.map_merging": ["merge_maps"],
    "learning.parameters": ["resize_optimizer"],
    "learning.update": ["UpdateConfig"],
    "queries.bodies": [
        "Body",
        "body_collision_probability",
        "body_distance",
        "capsule_distance",
        "collision_probability",
    ],
    "queries.channels": ["channel"],
    "queries.clearance": ["clearance"],
    "queries.collision": ["Mover", "expected_range", "free_probability", "segment_hazard"],
    "queries.distance": ["signed_distance", "surface_distance"],
    "queries.exploration": ["information_gain"],
    "queries.frontiers": ["frontiers"],
    "queries.grids": ["grid", "query_grid", "query_slice"],
    "queries.raycasting": ["raycast"],
    "sampling": ["Samples", "SamplingConfig", "sample_rays"],
    "scans": ["Scans", "split_rays"],
    "simulation": ["simulate_room"],
    "streaming": [
        "PacketReceiver",
        "PacketSender",
        "PacketWriter",
        "StreamConfig",
        "real_time",
        "resume_stream",
        "stream_scans",
    ],
    "surfaces.meshing": ["extract_mesh"],
    "surfaces.simplification": ["simplify_mesh"],
    "tiles.tiled_map": ["TiledMap"],
    "viewing.viewer": ["MapViewer"],
}
_MODULE_OF = {name: module for module, names in _NAMES.items() for name in names}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    """Import a public name on first use, which keeps `import lardhm_torch` fast."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for tab completion."""
    return __all__


# --- operators ---
# `torch.export.load` looks operators up by name, before any function of this package is called, and
# the package itself does not import torch, so that `import lardhm_torch` and `lardhm --help` are fast.

_OPERATORS = "lardhm_torch.native.operators"


class _AfterTorch:
    """A finder that defines the operators at the end of `import torch`."""

    def __init__(self) -> None:
        self._is_searching = False

    def find_spec(self, name: str, *_: Any) -> ModuleSpec | None:
        if name != "torch" or self._is_searching:
            return None
        self._is_searching = True
        try:
            spec = importlib.util.find_spec("torch")  # by the other finders
        finally:
            self._is_searching = False
        if spec is not None and spec.loader is not None:
            run = spec.loader.exec_module

            def run_and_define(module: ModuleType) -> None:
                run(module)
                sys.meta_path.remove(self)
                importlib.import_module(_OPERATORS)

            spec.loader.exec_module = run_and_define  # type: ignore[method-assign]
        return spec


def _define_operators() -> None:
    """Define the operators now if torch is imported, and otherwise as soon as it is."""
    if "torch" in sys.modules:
        importlib.import_module(_OPERATORS)
    else:
        sys.meta_path.insert(0, _AfterTorch())


_define_operators()
