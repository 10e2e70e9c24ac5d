"""Writers whose file grows beyond what fits: the error names the file, and the old one stays."""

import resource
import signal
from contextlib import contextmanager

import numpy as np
import pytest
import trimesh
from small_maps import wall_map

from lardhm_torch import save_grid, save_mesh, save_nav2, save_scans, simulate_room
from lardhm_torch.cli import main

LIMIT = 2_000  # [bytes] of the largest file

WRITERS = {
    "map.pt": lambda model, path: model.save(path),
    "map.safetensors": lambda model, path: model.save(path),
    "scans.npz": lambda model, path: save_scans(simulate_room(1500), path),
    "grid.npz": lambda model, path: save_grid(model, path, 0.2),
    "sparse.npz": lambda model, path: save_grid(model, path, 0.1, sparse=True),
    "mesh.ply": lambda model, path: save_mesh(trimesh.creation.icosphere(4), path),
    "grid.ot": lambda model, path: save_grid(model, path, 0.05),
    "grid.bt": lambda model, path: save_grid(model, path, 0.02),
    "mesh.glb": lambda model, path: save_mesh(trimesh.creation.icosphere(4), path),
    "nav2.pgm": lambda model, path: save_nav2(
        model, path.with_suffix(".yaml"), 0.03, heights=(0.9, 1.0)
    ),
}


@pytest.fixture(scope="module")
def model():
    return wall_map()


@contextmanager
def limited():
    """A block in which no file grows beyond the limit; pytest itself writes after it."""
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # in trimesh
@pytest.mark.parametrize("name", WRITERS)
def test_a_file_that_does_not_fit_is_named_and_the_old_one_stays(model, tmp_path, name):
    if name.endswith((".ot", ".bt")):
        pytest.importorskip("octomap", reason="octomap-python is not installed")
    path = tmp_path / name
    path.write_bytes(b"old")
    with limited(), pytest.raises(OSError, match=str(path)):
        WRITERS[name](model, path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_command_reports_it_in_one_line(model, tmp_path, capsys, monkeypatch):
    model.save(tmp_path / "map.pt", evidence=False)
    np.save(tmp_path / "points.npy", np.zeros((8_000, 3), np.float32))
    monkeypatch.chdir(tmp_path)
    with limited():
        assert main(["query", "map.pt", "points.npy", "-o", "out.npy"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("lardhm query: ")
    assert "out.npy" in line
    assert {path.name for path in tmp_path.iterdir()} == {"map.pt", "points.npy"}
