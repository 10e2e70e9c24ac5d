"""MCAP files for Foxglove, read back with the mcap library."""

import base64
import json

import numpy as np
import pytest
import torch
from drive_files import save_drive
from small_maps import wall_map

from lardhm_torch import (
    LardHilbertMap,
    Scans,
    cli,
    extract_mesh,
    iter_scans,
    stream_scans,
)
from lardhm_torch.io.foxglove_files import TOPICS, foxglove_log
from lardhm_torch.io.foxglove_messages import ground_grid_message
from lardhm_torch.io.nav2_files import GroundGrid, ground_grid

mcap_reader = pytest.importorskip("mcap.reader", reason="mcap is not installed (extra foxglove)")

TENTH = 10**8  # 0.1 s in nanoseconds
NUMBERS = {1: "u1", 2: "i1", 3: "<u2", 4: "<i2", 5: "<u4", 6: "<i4", 7: "<f4", 8: "<f8"}
KINDS = {
    "object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
    "number": (int, float),
}  # fmt: skip


def check(value, schema, place="message"):
    """Assert that a value has the types and exactly the properties of a JSON schema."""
    assert isinstance(value, KINDS[schema["type"]]), place
    if schema["type"] == "object" and "properties" in schema:
        assert set(value) == set(schema["required"]) == set(schema["properties"]), place
        for name, part in value.items():
            check(part, schema["properties"][name], f"{place}.{name}")
    for part in value if schema["type"] == "array" else []:
        check(part, schema["items"], f"{place}[]")


def read(path):
    """Messages by topic: lists of (time in ns, content), after a check against their schemas."""
    found = {topic: [] for topic in TOPICS}
    with open(path, "rb") as file:
        reader = mcap_reader.make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert schema.name == TOPICS[channel.topic]
            content = json.loads(message.data)
            check(content, json.loads(schema.data))
            stamp = content["entities"][0] if channel.topic == "/surface" else content
            stamp = stamp["timestamp"]
            assert stamp["sec"] * 10**9 + stamp["nsec"] == message.log_time
            found[channel.topic].append((message.log_time, content))
    return found


def unpacked(message, stride):
    """The fields of a cloud or grid by name."""
    content = base64.b64decode(message["data"])
    kind = np.dtype(
        {
            "names": [field["name"] for field in message["fields"]],
            "formats": [NUMBERS[field["type"]] for field in message["fields"]],
            "offsets": [field["offset"] for field in message["fields"]],
            "itemsize": message[stride],
        }
    )
    return np.frombuffer(content, kind)


def position(pose):
    assert pose["orientation"] == {"x": 0, "y": 0, "z": 0, "w": 1}
    return np.array([pose["position"][name] for name in "xyz"])


def cloud_of(message):
    values = unpacked(message, "point_stride")
    return np.stack([values[name] for name in "xyz"], axis=1) + position(message["pose"])


@pytest.fixture
def drive(tmp_path):
    return save_drive(tmp_path / "drive")


def test_the_command_line_writes_clouds_surfaces_and_grids(drive, tmp_path):
    words = [
        "fit", drive, "-o", tmp_path / "map.pt", "--incremental", "--mcap", tmp_path / "out.mcap",
        "--log-every", 2, "--log-resolution", 0.2, "--heights", 0.3, 1.5,
    ]  # fmt: skip
    assert cli.main(list(map(str, words))) == 0
    found = read(tmp_path / "out.mcap")
    scans, model = list(iter_scans(drive)), LardHilbertMap.load(tmp_path / "map.pt")
    assert len(scans) == 3
    assert [time for time, _ in found["/cloud"]] == [TENTH, 2 * TENTH, 3 * TENTH]
    for scan, (_, message) in zip(scans, found["/cloud"], strict=True):
        np.testing.assert_allclose(cloud_of(message), scan.hits.numpy(), atol=1e-5)
    for topic in ("/surface", "/grid"):  # after the second scan and the last
        assert [time for time, _ in found[topic]] == [2 * TENTH, 3 * TENTH]
    check_surface(found["/surface"][-1][1], extract_mesh(model, 0.2))
    check_grid(found["/grid"][-1][1], ground_grid(model, 0.2, heights=(0.3, 1.5)), 0.3)


def check_surface(message, mesh):
    (entity,) = message["entities"]
    (triangles,) = entity["triangles"]
    corners = np.array([[p[name] for name in "xyz"] for p in triangles["points"]])
    np.testing.assert_allclose(corners + position(triangles["pose"]), mesh.vertices, atol=1e-4)
    np.testing.assert_array_equal(np.reshape(triangles["indices"], (-1, 3)), mesh.faces)
    colors = np.array([[c[name] for name in "rgba"] for c in triangles["colors"]])
    np.testing.assert_allclose(colors * 255, mesh.visual.vertex_colors, atol=0.2)
    assert len(mesh.faces) > 100
    assert (entity["frame_id"], entity["lifetime"]) == ("map", {"sec": 0, "nsec": 0})


def check_grid(message, expected, height):
    values = unpacked(message, "cell_stride").reshape(-1, message["column_count"])
    assert message["row_stride"] == message["column_count"] * message["cell_stride"]
    np.testing.assert_allclose(position(message["pose"]), [*expected.corner, height])
    assert message["cell_size"] == {"x": expected.resolution, "y": expected.resolution}
    log_odds = torch.from_numpy(expected.log_odds.T)
    np.testing.assert_allclose(values["probability"], log_odds.sigmoid(), rtol=1e-5)
    np.testing.assert_array_equal(values["alpha"] == 0, log_odds.isnan())
    assert set(values["alpha"].reshape(-1).tolist()) == {0, 255}


def test_cells_are_row_by_row_from_the_lowest_y():
    log_odds = np.array([[np.nan, 3.0], [-3.0, np.nan], [0.0, 50.0]], dtype=np.float32)  # 3 x, 2 y
    message = ground_grid_message(GroundGrid(log_odds, np.array([-4, 8]), 0.25), 0.5, TENTH)
    values = unpacked(message, "cell_stride")
    np.testing.assert_allclose(
        values["probability"], [np.nan, 0.047426, 0.5, 0.952574, np.nan, 1], rtol=1e-4
    )
    for name in ("red", "green", "blue"):
        assert values[name].tolist() == [0, 243, 128, 12, 0, 0]
    assert values["alpha"].tolist() == [0, 255, 255, 255, 0, 255]
    assert position(message["pose"]).tolist() == [-1, 2, 0.5]


def test_a_2d_map_has_clouds_and_grids(tmp_path):
    model = wall_map(dim=2)
    scan = Scans(torch.zeros(1, 2), torch.tensor([[1.0, 0.5], [1.0, 1.5]]))
    with foxglove_log(tmp_path / "out.mcap", every=1) as log:
        for _ in log.watch([scan, scan]):
            log.send(model)
    found = read(tmp_path / "out.mcap")
    assert {topic: len(messages) for topic, messages in found.items()} == {
        "/surface": 0, "/cloud": 2, "/grid": 2,
    }  # fmt: skip
    np.testing.assert_allclose(cloud_of(found["/cloud"][0][1])[:, :2], scan.ends, atol=1e-6)
    check_grid(found["/grid"][0][1], ground_grid(model, 0.1), 0.0)


def test_without_heights_a_3d_map_has_no_grid(tmp_path):
    scan = Scans(torch.zeros(1, 3), torch.tensor([[1.0, 1.0, 1.0]]))
    with foxglove_log(tmp_path / "out.mcap") as log:
        for _ in log.watch([scan]):
            log.send(wall_map())
    found = read(tmp_path / "out.mcap")
    assert [len(found[topic]) for topic in ("/surface", "/cloud", "/grid")] == [1, 1, 0]


def test_an_interrupted_stream_keeps_what_was_written(drive, tmp_path):
    path, model = tmp_path / "out.mcap", LardHilbertMap()
    path.write_bytes(b"old")

    def interrupted_after(count):
        with foxglove_log(path, every=10) as log:
            for number, scan in enumerate(log.watch(iter_scans(drive))):
                if number == count:
                    raise KeyboardInterrupt
                stream_scans(model, [scan], after_scan=log.send)

    with pytest.raises(KeyboardInterrupt):
        interrupted_after(0)
    assert path.read_bytes() == b"old"
    with pytest.raises(KeyboardInterrupt):
        interrupted_after(2)
    assert [len(messages) for messages in read(path).values()] == [0, 2, 0]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["drive", "out.mcap"]


def test_wrong_options_are_one_line(drive, tmp_path, capsys):
    def error_of(*words):
        assert cli.main(["fit", str(drive), "-o", str(tmp_path / "map.pt"), *map(str, words)]) == 1
        return capsys.readouterr().err

    out = tmp_path / "out.mcap"
    assert "--mcap must end in .mcap" in error_of("--incremental", "--mcap", tmp_path / "out.bag")
    assert "--mcap needs --incremental" in error_of("--mcap", out)
    assert "--heights needs --mcap or --rerun" in error_of("--incremental", "--heights", 0, 1)
    wrong = ("--incremental", "--mcap", out, "--log-every", 0)
    assert "every must be > 0; got 0" in error_of(*wrong)
    with foxglove_log(out) as log, pytest.raises(ValueError, match="scans must come through watch"):
        log.send(wall_map())
