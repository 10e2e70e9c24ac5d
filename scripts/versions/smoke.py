"""Smoke test of an installed package: a small room through every part; a failure is an error.

Usage: python smoke.py [--no-kernel]
"""

import json
import platform
import sys
import tempfile
import warnings
from importlib.metadata import version
from pathlib import Path

import torch

import lardhm_torch as lh
from lardhm_torch import features, native

PACKAGES = ["torch", "numpy", "scipy", "scikit-learn", "scikit-image", "trimesh"]


def check(holds: bool, what: str) -> None:
    """Stop with an error unless a statement holds."""
    if not holds:
        raise SystemExit(f"smoke test failed: {what}")


def main(with_kernel: bool) -> None:
    """Run every part and print the versions as one line of JSON."""
    warnings.filterwarnings("error", module="lardhm_torch")  # other packages' are theirs
    check(native.available() == with_kernel, f"the kernel is {'' if with_kernel else 'not '}loaded")
    scans = lh.simulate_room(num_rays=2000, seed=0)
    train, test = lh.split_rays(scans, ratio=0.8, seed=0)
    samples = lh.sample_rays(train, seed=0)
    model = lh.LardHilbertMap().fit(samples.points, samples.labels, num_clusters=150, seed=0)
    lh.fine_tune(model, samples.points, samples.labels, config=lh.TuneConfig(epochs=1))
    model.update(samples.points[::5], samples.labels[::5], seed=0, rays=train)
    accuracy = lh.evaluate(model, test)["unif"]["balanced_accuracy"]
    check(accuracy > 0.9, f"balanced accuracy is {accuracy:.3f}, above 0.9")
    points = samples.points[:500]
    check_kernel(model, points)
    check_files(model, points)
    check_torch(model, points)
    versions = {name: version(name) for name in PACKAGES}
    print(json.dumps({"python": platform.python_version(), **versions}))


def check_kernel(model: lh.LardHilbertMap, points: torch.Tensor) -> None:
    """Values and gradients of the kernel are those of the definition."""
    local = (points - model.origin).to(model.centers.dtype).requires_grad_()
    parameters = (model.centers, model.raw_scale_tril, model.weights)
    fast = native.occupancy(local, *parameters, model.kernel, probability=True)
    factors = features.kernel_factors(model.raw_scale_tril, model.kernel)
    arguments = (local, model.centers, factors, model.weights, model.num_neighbors)
    plain = torch.sigmoid(features.log_odds(*arguments))
    torch.testing.assert_close(fast, plain, atol=1e-5, rtol=1e-4)
    slopes = [torch.autograd.grad(answer.sum(), local)[0] for answer in (fast, plain)]
    torch.testing.assert_close(*slopes, atol=1e-4, rtol=1e-3)


def check_files(model: lh.LardHilbertMap, points: torch.Tensor) -> None:
    """A map is loaded as it was saved; its mesh has faces and is written."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("map.pt", "map.safetensors"):
            model.save(Path(folder) / name)
            loaded = lh.LardHilbertMap.load(Path(folder) / name)
            check(torch.equal(loaded(points), model(points)), f"{name} gives the same answers")
        mesh = lh.extract_mesh(model, resolution=0.2)
        check(len(mesh.faces) > 1000, f"the mesh has {len(mesh.faces)} faces, more than 1000")
        lh.save_mesh(mesh, Path(folder) / "mesh.ply")


def check_torch(model: lh.LardHilbertMap, points: torch.Tensor) -> None:
    """Exported and compiled maps give the same answers."""
    count = torch.export.Dim("count", min=1)
    program = torch.export.export(model, (points,), dynamic_shapes=({0: count},))
    torch.testing.assert_close(program.module()(points[:77]), model(points[:77]))
    compiled = torch.compile(model, backend="aot_eager", fullgraph=True)
    torch.testing.assert_close(compiled(points), model(points))


if __name__ == "__main__":
    main("--no-kernel" not in sys.argv[1:])
