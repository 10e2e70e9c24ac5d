"""Scans written as PLY and PCD: read back the same, here and by the formats' own libraries."""

import dataclasses

import numpy as np
import pytest
import torch

from lardhm_torch import Scans, load_scans, save_scans, simulate_room
from lardhm_torch.cli import main

COUNT = 60


def some_scans(dim=3, is_bytes=True, has_missing=False):
    """Rays of two scans at UTM coordinates, some without return, with channels."""
    rng = torch.Generator().manual_seed(0)
    ends = 4.5e6 + 10 * torch.rand(COUNT, dim, generator=rng, dtype=torch.float64)
    colors = torch.randint(0, 256, (COUNT, 3), generator=rng) / 255
    colors = colors if is_bytes else colors * 0.37
    classes = torch.randint(0, 30, (COUNT,), generator=rng)
    intensity = torch.rand(COUNT, generator=rng)
    if has_missing:
        colors[3], classes[4], intensity[5] = torch.nan, -1, torch.nan
    channels = {"color": colors, "intensity": intensity, "class": classes}
    channels["ring"] = torch.arange(COUNT) % 16
    origins = 4.5e6 + torch.rand(2, dim, generator=rng, dtype=torch.float64)
    rows = torch.arange(COUNT)
    return Scans(origins, ends, rows % 2, rows % 5 > 0, 1 + rows % 3, channels)


@pytest.mark.parametrize("suffix", ["npz", "ply", "pcd"])
@pytest.mark.parametrize("is_bytes", [True, False])
@pytest.mark.parametrize("has_missing", [True, False])
@pytest.mark.parametrize("dim", [2, 3])
def test_scans_and_channels_come_back(tmp_path, suffix, is_bytes, has_missing, dim):
    scans = some_scans(dim, is_bytes, has_missing)
    save_scans(scans, tmp_path / f"a.{suffix}")
    found = load_scans(tmp_path / f"a.{suffix}")
    for field in dataclasses.fields(Scans):
        ours, theirs = getattr(scans, field.name), getattr(found, field.name)
        if field.name not in ("channels", "times"):
            assert torch.equal(ours, theirs), field.name
    assert found.channels.keys() == scans.channels.keys()
    for name, values in scans.channels.items():
        torch.testing.assert_close(found.channels[name], values, rtol=0, atol=1e-6, equal_nan=True)


def test_plyfile_reads_colors_as_bytes(tmp_path):
    plyfile = pytest.importorskip("plyfile", reason="plyfile is not installed (extra dev)")
    scans = some_scans()
    save_scans(scans, tmp_path / "a.ply")
    vertex = plyfile.PlyData.read(tmp_path / "a.ply")["vertex"]
    assert np.array_equal(np.stack([vertex[c] for c in "xyz"], 1), scans.ends.numpy())
    colors = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1)
    assert colors.dtype == np.uint8
    assert np.array_equal(colors, (255 * scans.channels["color"]).round().numpy())
    assert np.array_equal(vertex["label"], scans.channels["class"])
    assert np.array_equal(vertex["intensity"], scans.channels["intensity"])


def test_pypcd4_reads_colors_as_packed_bytes(tmp_path):
    pypcd4 = pytest.importorskip("pypcd4", reason="pypcd4 is not installed (extra dev)")
    scans = some_scans()
    save_scans(scans, tmp_path / "a.pcd")
    cloud = pypcd4.PointCloud.from_path(tmp_path / "a.pcd")
    assert np.array_equal(cloud.pc_data["x"], scans.ends[:, 0])
    words = cloud.pc_data["rgb"].astype(np.int64)
    colors = np.stack([(words >> shift) & 255 for shift in (16, 8, 0)], axis=1)
    assert np.array_equal(colors, (255 * scans.channels["color"]).round().numpy())
    assert np.array_equal(cloud.pc_data["label"], scans.channels["class"])


@pytest.mark.parametrize("suffix", ["ply", "pcd"])
def test_channels_without_a_column_are_refused(tmp_path, suffix):
    scans = some_scans()
    for name, values in (("infrared", torch.zeros(COUNT)), ("class", torch.full((COUNT, 4), 0.25))):
        other = dataclasses.replace(scans, channels={name: values})
        with pytest.raises(ValueError, match=rf"channel '{name}' .* has no column .* Use \.npz"):
            save_scans(other, tmp_path / f"a.{suffix}")
    deep = Scans(torch.zeros(1, 4), torch.ones(2, 4))
    with pytest.raises(ValueError, match="must be 2-D or 3-D; got 4 coordinates"):
        save_scans(deep, tmp_path / f"a.{suffix}")
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_simulated_room_as_colored_points(tmp_path):
    assert main(["simulate", "-o", str(tmp_path / "room.ply"), "--rays", "300"]) == 0
    expected, found = simulate_room(300, seed=0), load_scans(tmp_path / "room.ply")
    assert torch.equal(found.ends, expected.ends)
    assert torch.equal(found.channels["class"], expected.channels["class"])
    colors = found.channels["color"], expected.channels["color"]
    torch.testing.assert_close(*colors, equal_nan=True)  # no color where a ray met nothing
