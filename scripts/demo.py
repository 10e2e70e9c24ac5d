"""Demo: simulate a room, fit a map, evaluate it, extract its mesh and draw it.

Usage: python scripts/demo.py [FOLDER]    (default: out)
"""

import sys
from pathlib import Path

import torch

from lardhm_torch import (
    LardHilbertMap,
    evaluate,
    extract_mesh,
    sample_rays,
    save_mesh,
    save_scans,
    simulate_room,
    split_rays,
)
from lardhm_torch.evaluation.mesh_distances import mesh_metrics
from lardhm_torch.evaluation.scores import format_metrics
from lardhm_torch.simulation import CLASS_NAMES, room_mesh
from lardhm_torch.surfaces.channel_colors import channel_colors, class_colors
from lardhm_torch.viewing.rendering import render_mesh, render_slice


def main(folder: Path) -> None:
    """Write scans, map, mesh and pictures to a folder and print the scores."""
    folder.mkdir(parents=True, exist_ok=True)

    scans = simulate_room(seed=0, exposure_noise=0.1, wrong_labels=0.05)
    save_scans(scans, folder / "scans.npz")
    train, test = split_rays(scans, ratio=0.8, seed=0)
    print(f"simulated {len(scans)} rays of {scans.num_scans} scanners; {len(train)} train the map")

    samples = sample_rays(train, seed=0)
    model = LardHilbertMap(dim=3)
    given = samples.points, samples.labels
    model.fit(*given, seed=0, channels=samples.channels, progress=True)
    model.save(folder / "map.pt")
    print(f"{len(samples)} labelled points -> {len(model)} clusters")

    with torch.no_grad():
        print(format_metrics(evaluate(model, test)))
        classes = model.class_probability(test.hits).argmax(dim=-1)
    labels = test.channels["class"][test.is_return]
    print(
        f"classes: {(classes == labels).float().mean():.3f} of the labels, of which 5 % are wrong"
    )
    mesh = extract_mesh(model, resolution=0.05, color="color", progress=True)
    save_mesh(mesh, folder / "mesh.ply")
    scores = mesh_metrics(mesh, room_mesh(), train.hits)
    print("mesh " + ", ".join(f"{name} {value:.4f}" for name, value in scores.items()))

    render_mesh(mesh, folder / "mesh.png", cut_above=2.28)  # without the ceiling
    mesh.visual.vertex_colors = channel_colors(model, mesh.vertices, "class")
    legend = {CLASS_NAMES[number]: rgb for number, rgb in class_colors(model.classes).items()}
    render_mesh(mesh, folder / "classes.png", cut_above=2.28, legend=legend)
    room = ([-0.5, -0.5], [8.5, 5.5])  # without what was seen through the doorway and the window
    render_slice(model, folder / "slice.png", height=1.0, bounds=room)
    print("wrote " + ", ".join(str(path) for path in sorted(folder.iterdir())))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out"))
