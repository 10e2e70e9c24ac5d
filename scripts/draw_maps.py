"""Draw the pictures of docs/accuracy.md: fit maps to real scans and draw their meshes.

Usage: python scripts/draw_maps.py DATA [-o docs/pictures]
DATA is a folder with one folder per set, which contains `scans.npz`.
"""

import argparse
import time
from pathlib import Path
from typing import Any

from lardhm_torch import LardHilbertMap, extract_mesh, load_scans, sample_rays
from lardhm_torch.viewing.rendering import render_mesh
from lardhm_torch.viewing.scene import core_box

VIEWS: dict[str, dict[str, Any]] = {  # 7-Scenes is in the frame of its first camera: -y is up
    "sevenscenes_rgbd": {"up": (0, -1, 0), "azimuth": -105, "elevation": 25},
    "riegl_vz400i_rtls": {"elevation": 25},
    "balm_realworld": {"elevation": 50, "cut_above": 6.0},
}
RESOLUTION = {"sevenscenes_rgbd": 0.03, "riegl_vz400i_rtls": 0.06, "balm_realworld": 0.15}  # [m]


def main() -> None:
    """Draw one picture per set."""
    parser = argparse.ArgumentParser(description="Draw the maps of real scans.")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name, view in VIEWS.items():
        started = time.perf_counter()
        samples = sample_rays(load_scans(arguments.data / name / "scans.npz"))
        model = LardHilbertMap().fit(samples.points, samples.labels)
        mesh = extract_mesh(model, RESOLUTION[name], bounds=core_box(model))
        picture = arguments.output / f"{name}.png"
        render_mesh(mesh, picture, size=(900, 600), **view)
        print(f"{picture}: {len(mesh.faces)} faces, {time.perf_counter() - started:.1f} s")


if __name__ == "__main__":
    main()
