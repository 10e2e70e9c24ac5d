"""Nav2 map files, read back as the documentation of map_server describes them."""

import math

import numpy as np
import pytest
import torch
from small_maps import GaussianMap, wall, wall_map

from lardhm_torch import LardHilbertMap, cli, save_nav2

OCCUPIED, FREE, UNKNOWN = 100, 0, -1


def read_pgm(path):
    """(rows, columns) shades of a binary PGM file, 0 to 1: magic, width, height, largest shade."""
    magic, size, largest, pixels = path.read_bytes().split(b"\n", 3)
    columns, rows = map(int, size.split())
    assert magic == b"P5"
    assert len(pixels) == rows * columns
    return np.frombuffer(pixels, np.uint8).reshape(rows, columns) / int(largest), None


def read_png(path):
    """(rows, columns) mean of the color channels, 0 to 1, and whether a pixel is not opaque."""
    from matplotlib.image import imread

    pixels = imread(path)
    return pixels[..., :3].mean(axis=2), pixels[..., 3] < 1


def read_map(path):
    """Values (ny, nx) with the smallest y first, x and y of the lower left corner, resolution.

    As in the documentation of map_server: with negate 0, darker is more occupied; p above
    occupied_thresh is 100, below free_thresh 0; the rest is -1 in trinary mode, and scaled linearly in
    between in scale mode, where pixels that are not opaque are -1. The image's lower left pixel is at
    the origin.
    """
    entries = dict(line.split(": ", 1) for line in path.read_text().splitlines())
    assert entries["negate"] == "0"
    image = path.parent / entries["image"]
    shades, hidden = (read_pgm if image.suffix == ".pgm" else read_png)(image)
    p = 1 - shades
    occupied, free = float(entries["occupied_thresh"]), float(entries["free_thresh"])
    if entries["mode"] == "trinary":
        values = np.where(p > occupied, OCCUPIED, np.where(p < free, FREE, UNKNOWN))
    else:
        scaled = np.round((p - free) / (occupied - free) * 99).clip(0, 100)
        values = np.where(p > occupied, OCCUPIED, np.where(p < free, FREE, scaled))
        values[hidden] = UNKNOWN
    x, y, yaw = map(float, entries["origin"].strip("[]").split(","))
    assert yaw == 0
    return values[::-1].astype(int), (x, y), float(entries["resolution"])


def value_at(found, x, y):
    values, (left, bottom), edge = found
    return values[math.floor((y - bottom) / edge), math.floor((x - left) / edge)]


def corner_map(dim=2):
    """Occupied at (3, 1), free around (1, 1) and up to (3, 1); in 3-D at height 1."""
    centers = torch.tensor([[3.0, 1.0, 1.0], [1.0, 1.0, 1.0], [2.0, 1.0, 1.0]])[:, :dim]
    stds = torch.tensor([0.05, 0.4, 0.3])
    factors = stds[:, None, None] * torch.eye(dim)
    return GaussianMap(centers, factors, [9.0, -6.0, -6.0])


@pytest.mark.parametrize("mode", ["trinary", "scale"])
@pytest.mark.parametrize("dim", [2, 3])
def test_cells_are_read_where_they_are_and_as_what_they_are(dim, mode, tmp_path):
    model = corner_map(dim)
    heights = (0.5, 1.5) if dim == 3 else None
    size = save_nav2(model, tmp_path / "m.yaml", 0.1, heights=heights, mode=mode)
    found = read_map(tmp_path / "m.yaml")
    assert found[0].shape == size[::-1]
    assert found[2] == 0.1
    assert value_at(found, 3.01, 1.01) == OCCUPIED
    assert value_at(found, 1.0, 1.0) == FREE
    assert found[1] == pytest.approx(tuple(round(c / 0.1) * 0.1 for c in found[1]))
    # every cell is what the map says at its four parts, over all heights
    values, _, edge = found
    rows, columns = np.indices(values.shape)
    parts = np.array([[0.25, 0.25], [0.25, 0.75], [0.75, 0.25], [0.75, 0.75]])
    xy = edge * (np.stack([columns, rows], axis=-1)[..., None, :] + parts) + found[1]
    points = torch.as_tensor(xy)[..., None, :]
    if dim == 3:
        levels = 0.5 + 0.05 * torch.arange(21, dtype=torch.float64)
        points = torch.cat(
            [
                points.expand(*points.shape[:3], 21, 2),
                levels.expand(*points.shape[:3], 21)[..., None],
            ],
            dim=-1,
        )
    log_odds = model.log_odds(points).flatten(2).numpy()
    is_occupied = log_odds.max(axis=2) >= 1
    is_free = ~is_occupied & (log_odds.min(axis=2) <= -1)
    assert np.array_equal(values == UNKNOWN, ~is_occupied & ~is_free)
    assert np.array_equal(values == OCCUPIED, is_occupied)
    assert (values[is_free] < (1 if mode == "trinary" else 30)).all()


def test_the_first_row_of_the_image_has_the_largest_y(tmp_path):
    factors = torch.stack([0.05 * torch.eye(2), torch.diag(torch.tensor([0.4, 1.2]))])
    model = GaussianMap([[0.0, 2.0], [0.0, 0.0]], factors, [9.0, -3.0])
    save_nav2(model, tmp_path / "m.yaml", 0.1)
    shades, _ = read_pgm(tmp_path / "m.pgm")
    top, bottom = np.array_split(shades, 2)
    assert (top == 0).any()
    assert not (bottom == 0).any()
    assert {round(255 * s) for s in np.unique(shades)} == {0, 205, 254}


def test_what_lies_outside_of_the_height_band_does_not_count(tmp_path):
    model = corner_map(3)
    save_nav2(model, tmp_path / "m.yaml", 0.1, heights=(1.3, 1.8))
    found = read_map(tmp_path / "m.yaml")
    assert not (found[0] == OCCUPIED).any()
    assert value_at(found, 1.0, 1.0) == FREE


def test_bounds_give_the_size_of_the_image(tmp_path):
    bounds = ([-1.0, 0.5], [4.0, 2.0])
    assert save_nav2(corner_map(), tmp_path / "m.yml", 0.25, bounds=bounds) == (20, 6)
    values, corner, _ = read_map(tmp_path / "m.yml")
    assert corner == (-1.0, 0.5)
    assert (values[:, 0] == UNKNOWN).all()


def test_a_fitted_map_far_from_zero_goes_through_the_command(tmp_path, capsys):
    points, labels = wall(dim=3)
    shift = torch.tensor([5e5, 4.5e6, 0.0]).double()
    LardHilbertMap(3).fit(points + shift, labels, 40).save(tmp_path / "map.pt")
    command = ["grid", str(tmp_path / "map.pt"), "--nav2", str(tmp_path / "m.yaml")]
    assert cli.main([*command, "--resolution", "0.1", "--heights", "0.5", "1.5"]) == 0
    assert "m.yaml" in capsys.readouterr().out
    found = read_map(tmp_path / "m.yaml")
    assert value_at(found, 5e5 + 1.0, 4.5e6 + 1.0) == OCCUPIED
    assert value_at(found, 5e5 + 0.4, 4.5e6 + 1.0) == FREE


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"path": "m.pgm"}, r"must end in .yaml or .yml for Nav2; got 'm.pgm'"),
        ({"mode": "raw"}, "mode must be one of trinary, scale; got 'raw'"),
        ({"heights": None}, "heights must be the lowest and highest z in 3-D.*got None"),
        ({"heights": (2.0, 1.0)}, "lower <= upper"),
        ({"heights": (50.0, 60.0)}, "must have known cells for Nav2"),
        ({"resolution": 0.0}, "resolution must be > 0 m"),
        ({"model": LardHilbertMap(3)}, "it is empty"),
        ({"model": corner_map(2)}, r"None in 2-D; got \(0.5, 1.5\)"),
    ],
)
def test_bad_arguments_are_refused(changed, message, tmp_path):
    given = {"model": wall_map(), "path": "m.yaml", "resolution": 0.2, "heights": (0.5, 1.5)}
    given |= changed
    with pytest.raises(ValueError, match=message):
        save_nav2(path=tmp_path / given.pop("path"), **given)
    assert not list(tmp_path.iterdir())


def test_the_command_needs_one_output(tmp_path, capsys):
    wall_map().save(tmp_path / "map.pt")
    assert cli.main(["grid", str(tmp_path / "map.pt")]) == 1
    assert "give --output or --nav2" in capsys.readouterr().err
