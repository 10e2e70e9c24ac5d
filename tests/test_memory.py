"""Results that would not fit in memory are refused before the work."""

import math

import pytest
import torch
from small_maps import ball, wall_map

from lardhm_torch import extract_mesh, query_grid
from lardhm_torch.io.grid_files import save_grid
from lardhm_torch.queries import memory
from lardhm_torch.surfaces.estimate import estimate_mesh


@pytest.fixture
def free(monkeypatch, tmp_path):
    """Sets what the system says is available [bytes]."""

    def say(count, limit="max", used=0):
        (tmp_path / "meminfo").write_text(f"MemTotal: 1 kB\nMemAvailable: {count // 1024} kB\n")
        (tmp_path / "memory.max").write_text(f"{limit}\n")
        (tmp_path / "memory.current").write_text(f"{used}\n")
        monkeypatch.setattr(memory, "MEMINFO", tmp_path / "meminfo")
        monkeypatch.setattr(memory, "CONTROL_GROUP", tmp_path)

    return say


def test_the_least_of_the_machine_and_of_the_container_is_available(free, monkeypatch, tmp_path):
    free(1 << 30)
    assert memory.available_memory() == 1 << 30
    free(1 << 30, limit=1 << 20, used=1 << 19)
    assert memory.available_memory() == 1 << 19
    monkeypatch.setattr(memory, "MEMINFO", tmp_path / "none")
    monkeypatch.setattr(memory, "CONTROL_GROUP", tmp_path / "none")
    assert memory.available_memory() is None


def test_a_mesh_that_does_not_fit_is_refused_and_the_resolution_named_fits(free):
    model = wall_map()
    size = estimate_mesh(model, 0.01)
    free(size.memory // 4)
    with pytest.raises(ValueError, match=r"resolution must be at least 0\.02 m for the .* GB of free "
                       r"memory; got 0\.01 m: the mesh would have about .* million faces"):  # fmt: skip
        extract_mesh(model, 0.01)
    assert len(extract_mesh(model, 0.05).faces) > 100


def test_a_grid_that_does_not_fit_is_refused(free):
    free(1 << 20)
    with pytest.raises(
        ValueError, match=r"at least .* m .*: the grid would have 1\.03 million points"
    ):
        query_grid(ball(), [0, 0, 0], [1, 1, 1], 0.01)
    with pytest.raises(ValueError, match=r"an axis would have 3e\+09 points"):
        query_grid(ball(), [0, 0, 0], [1, 1, 1], 1e-9)
    assert query_grid(ball(), [0, 0, 0], [1, 1, 1], 0.1).numel() == 1331


def test_a_tree_that_does_not_fit_is_refused_before_it_is_begun(free, tmp_path):
    free(1 << 20)
    with pytest.raises(ValueError, match=r"the tree would have up to .* million cells"):
        save_grid(wall_map(), tmp_path / "map.bt", 0.005)
    assert not (tmp_path / "map.bt").exists()


def test_the_estimate_of_a_wall_is_right_within_a_factor_of_two():
    model = wall_map()
    for resolution in (0.1, 0.05):
        mesh, size = extract_mesh(model, resolution), estimate_mesh(model, resolution)
        assert 0.5 < size.area / mesh.area < 2
        assert 0.5 < size.faces / len(mesh.faces) < 2
    half = estimate_mesh(model, 0.05, (torch.zeros(3), torch.tensor([2.0, 1.0, 2.0])))
    assert half.faces == pytest.approx(size.faces / 2, rel=0.3)
    assert math.isclose(size.faces, 4 * estimate_mesh(model, 0.1).faces, rel_tol=0.01)
    assert "faces, " in str(size)
