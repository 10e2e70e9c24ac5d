"""Draw the floor between the rings of a lidar, without and with bridged gaps (docs/accuracy.md).

Usage: python scripts/draw_gaps.py DATA [-o docs/pictures]
DATA is a folder with one folder per set, which contains `scans.npz`.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.image import imread, imsave

from lardhm_torch import FitConfig, LardHilbertMap, extract_mesh, load_scans, sample_rays
from lardhm_torch.evaluation.held_out import protocol_rays
from lardhm_torch.scans import every_scan
from lardhm_torch.viewing.rendering import render_mesh
from lardhm_torch.viewing.scene import core_box

VIEWS = {"balm_realworld": 6.0, "kitti00_mulls": None}  # cut above this height [m]
RAYS = 120_000
RESOLUTION = 0.05  # [m]


def main() -> None:
    """Draw one picture per set: every second scan, without bridged gaps on the left."""
    parser = argparse.ArgumentParser(description="Draw maps without and with bridged gaps.")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures"))
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for name, height in VIEWS.items():
        rays = protocol_rays(load_scans(arguments.data / name / "scans.npz"), RAYS)
        samples = sample_rays(every_scan(rays, 2))
        halves = []
        for bridge_gaps in (False, True):
            config = FitConfig(bridge_gaps=bridge_gaps)
            model = LardHilbertMap().fit(samples.points, samples.labels, config=config)
            mesh = extract_mesh(model, RESOLUTION, bounds=core_box(model))
            with tempfile.TemporaryDirectory() as folder:
                half = Path(folder) / "half.png"
                render_mesh(mesh, half, size=(700, 560), elevation=60, cut_above=height)
                halves.append(imread(half))
            print(f"{name}, bridge_gaps={bridge_gaps}: {mesh.area:.0f} m2")
        imsave(arguments.output / f"gaps_{name}.png", np.concatenate(halves, axis=1))


if __name__ == "__main__":
    main()
