"""The pictures of the README: fit a map to real scans, mesh it, draw it.

Usage: python scripts/draw_maps.py SCANS [SCANS ...] -o docs/pictures [--resolution 0.05]
Each SCANS is one file or folder; the picture takes the name of its folder.
"""

import argparse
import time
from pathlib import Path

from lardhm_torch import LardHilbertMap, extract_mesh, load_scans, sample_rays
from lardhm_torch.rendering import render_mesh


def main() -> None:
    """One picture for each of the scans named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", nargs="+", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/pictures"))
    parser.add_argument("--resolution", type=float, default=0.05)
    parser.add_argument("--elevation", type=float, default=35.0)
    parser.add_argument("--azimuth", type=float, default=-60.0)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for path in arguments.scans:
        started = time.perf_counter()
        samples = sample_rays(load_scans(path))
        model = LardHilbertMap().fit(samples.points, samples.labels)
        mesh = extract_mesh(model, arguments.resolution)
        picture = arguments.output / f"{(path if path.is_dir() else path.parent).name}.png"
        render_mesh(mesh, picture, azimuth=arguments.azimuth, elevation=arguments.elevation)
        print(f"{picture}: {len(mesh.faces)} faces, {time.perf_counter() - started:.1f} s")


if __name__ == "__main__":
    main()
