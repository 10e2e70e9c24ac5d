"""Recordings for Rerun, read back with its library."""

import numpy as np
import pytest
from drive_files import save_drive
from small_maps import wall_map

from lardhm_torch import LardHilbertMap, Scans, cli, extract_mesh, iter_scans
from lardhm_torch.io.nav2_files import ground_grid
from lardhm_torch.io.rerun_files import CLOUD, GRID, ORIGIN, SURFACE, TIMELINE, rerun_log

rerun_chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed (extra rerun)")


def read(path):
    """Contents by entity: lists of (number of the scan, values by component)."""
    found = {entity: [] for entity in (CLOUD, SURFACE, GRID, ORIGIN)}
    for chunk in rerun_chunk.RrdReader(path).stream():
        entity = chunk.entity_path.lstrip("/")
        if entity not in found:  # Rerun's own properties of the recording
            continue
        batch = chunk.to_record_batch()
        for row in batch.select(
            [n for n in batch.schema.names if ":" in n or n == TIMELINE]
        ).to_pylist():
            values = {name.split(":")[-1]: value for name, value in row.items()}
            found[entity].append((row[TIMELINE], values))
    return {entity: sorted(rows, key=lambda row: row[0]) for entity, rows in found.items()}


def test_the_command_line_writes_clouds_surfaces_and_grids(tmp_path):
    drive = save_drive(tmp_path / "drive")
    words = [
        "fit", drive, "-o", tmp_path / "map.pt", "--incremental", "--rerun", tmp_path / "out.rrd",
        "--log-every", 2, "--log-resolution", 0.2, "--heights", 0.3, 1.5,
    ]  # fmt: skip
    assert cli.main(list(map(str, words))) == 0
    found = read(tmp_path / "out.rrd")
    scans, model = list(iter_scans(drive)), LardHilbertMap.load(tmp_path / "map.pt")
    assert [number for number, _ in found[CLOUD]] == [1, 2, 3]
    for scan, (_, values) in zip(scans, found[CLOUD], strict=True):
        expected = (scan.hits - model.origin).numpy()
        np.testing.assert_allclose(values["positions"], expected, atol=1e-5)
    for entity in (SURFACE, GRID):  # after the second scan and the last
        assert [number for number, _ in found[entity]] == [2, 3]
    check_surface(found[SURFACE][-1][1], extract_mesh(model, 0.2), model.origin.numpy())
    check_grid(found[GRID][-1][1], ground_grid(model, 0.2, heights=(0.3, 1.5)), model.origin)
    ((_, origin),) = found[ORIGIN]
    assert list(map(float, origin["text"][0].split(":")[1].split())) == model.origin.tolist()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive", "map.pt", "out.rrd"]


def check_surface(values, mesh, origin):
    np.testing.assert_allclose(values["vertex_positions"], mesh.vertices - origin, atol=1e-4)
    np.testing.assert_array_equal(values["triangle_indices"], mesh.faces)
    red = np.array(values["vertex_colors"]) >> 24  # 0xRRGGBBAA
    np.testing.assert_array_equal(red, mesh.visual.vertex_colors[:, 0])
    assert len(mesh.faces) > 100


def check_grid(values, expected, origin):
    size = np.array(expected.log_odds.shape) * expected.resolution
    low = np.array([*expected.corner, 0.3]) - origin.numpy()
    corners = np.array(values["vertex_positions"])
    np.testing.assert_allclose(corners[0], low, atol=1e-4)
    np.testing.assert_allclose(corners[2] - corners[0], [*size, 0], atol=1e-4)
    image = np.array(values["albedo_texture_buffer"][0], np.uint8)
    np.testing.assert_array_equal(image, expected.shades().ravel())
    (shape,) = values["albedo_texture_format"]
    assert (shape["width"], shape["height"]) == expected.log_odds.shape


def test_an_interrupted_stream_keeps_what_was_written(tmp_path):
    scan = Scans(np.zeros((1, 3)), np.ones((1, 3)))

    def interrupted():
        with rerun_log(tmp_path / "out.rrd") as log:
            for _ in log.watch([scan]):
                log.send(wall_map())
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [len(rows) for rows in read(tmp_path / "out.rrd").values()] == [1, 0, 0, 1]


def test_wrong_options_are_one_line(tmp_path, capsys):
    drive = save_drive(tmp_path / "drive")
    words = ["fit", str(drive), "-o", str(tmp_path / "map.pt")]
    assert cli.main([*words, "--rerun", str(tmp_path / "out.rrd")]) == 1
    assert "--rerun needs --incremental" in capsys.readouterr().err
    assert cli.main([*words, "--incremental", "--rerun", str(tmp_path / "out.mcap")]) == 1
    assert "--rerun must end in .rrd" in capsys.readouterr().err
