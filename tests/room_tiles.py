"""A room in pieces and folders of its tiles: what the tests of tiles share."""

import hashlib
from pathlib import Path

import torch

from lardhm_torch import Scans, simulate_room
from lardhm_torch.tiles.routing import TilingConfig, tile_scans

EDGE = 2.5  # [m] about twenty tiles
CONFIG = TilingConfig(edge=EDGE, halo=0.5)


def room_pieces(num_rays: int = 1500, pieces: int = 3, seed: int = 0) -> list[Scans]:
    """The scans of the simulated room, dealt out."""
    scans = simulate_room(num_rays=num_rays, seed=seed)
    return [scans.select(torch.arange(start, len(scans), pieces)) for start in range(pieces)]


def room_folder(folder: Path, pieces: list[Scans] | None = None) -> Path:
    """Routed, not fitted."""
    tile_scans(room_pieces() if pieces is None else pieces, folder, CONFIG)
    return folder


def contents(folder: Path, under: str = ".") -> dict[str, str]:
    """Digest of every file by name."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted((folder / under).rglob("*"))
        if path.is_file()
    }
