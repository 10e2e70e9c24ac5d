"""Packed maps: what a receiver can still do, what is exact, and which files are refused."""

import functools
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from small_maps import wall, wall_map

from lardhm_torch import (
    LardHilbertMap,
    extract_mesh,
    fine_tune,
    load_scans,
    merge_maps,
    raycast,
    sample_rays,
    signed_distance,
)
from lardhm_torch.io import packed_files
from lardhm_torch.learning.packing import load_state, rounded

DOCS = Path(__file__).parents[1] / "docs" / "map_format.md"


@pytest.fixture
def path(tmp_path):
    return tmp_path / "map.lhm"


def packed(model, path, **settings):
    model.pack(path, **settings)
    return LardHilbertMap.load(path)


def resealed(content):
    """A packet with the checksum that its other bytes need."""
    return (
        content[:12]
        + struct.pack("<I", zlib.crc32(content[16:], zlib.crc32(content[:12])))
        + (content[16:])
    )


@pytest.mark.parametrize("dim", [1, 2, 3, 4, 6])
def test_a_packed_map_answers_as_the_map_in_every_dimension(path, dim):
    model = wall_map(dim, torch.float32, num_neighbors=8)
    points = wall(dim=dim, seed=1)[0]
    errors = []
    for precision in (3, 6, 10):
        copy = packed(model, path, precision=precision)
        assert copy.settings == model.settings
        assert len(copy) == len(model)
        errors.append(float((copy(points) - model(points)).abs().max().detach()))
    assert errors[1] < 0.02
    assert errors[2] < 0.1 * errors[0]


def test_a_packed_map_meshes_casts_rays_and_measures_distances(path):
    model = wall_map(dtype=torch.float32)
    copy = packed(model, path)
    origins = torch.tensor([[0.1, 1.0, 1.0], [0.2, 0.5, 1.5]], dtype=torch.float64)
    ahead = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(2, 3)
    torch.testing.assert_close(
        raycast(copy, origins, ahead, 5.0), raycast(model, origins, ahead, 5.0), atol=5e-3, rtol=0
    )
    torch.testing.assert_close(
        signed_distance(copy, origins), signed_distance(model, origins), atol=0.01, rtol=0
    )
    areas = [extract_mesh(m, resolution=0.1).area for m in (copy, model)]
    assert areas[0] == pytest.approx(areas[1], rel=0.02)
    assert bool((copy.unknown(origins) - model.unknown(origins)).abs().max() < 0.02)


def test_far_from_zero_the_origin_is_exact_and_the_answers_are_those_near_zero(path):
    shift = torch.tensor([5e5 + 1 / 3, 4.5e6, 0.1], dtype=torch.float64)
    points = (wall()[0] * 1024).round() / 1024
    model = wall_map(dtype=torch.float32)
    near = packed(model, path)
    model.origin = model.origin + shift
    far = packed(model, path)
    assert torch.equal(far.origin, model.origin)
    shift = torch.tensor([5e5, 4.5e6, 0.0], dtype=torch.float64)
    model.origin = near.origin + shift
    far = packed(model, path)
    assert torch.equal(far(points + shift), near(points))


def test_packing_again_changes_nothing(path):
    copy = packed(wall_map(dtype=torch.float32), path)
    before = path.read_bytes()
    copy.pack(path)
    assert path.read_bytes() == before


def test_an_empty_map_can_be_packed(path):
    assert float(packed(LardHilbertMap(), path)(torch.zeros(1, 3)).detach()) == 0.5


def test_a_packed_map_does_not_learn_and_says_why(path, tmp_path):
    model = packed(wall_map(dtype=torch.float32), path)
    before = {name: tensor.clone() for name, tensor in model.state_tensors()}
    again = LardHilbertMap()
    model.save(tmp_path / "map.pt")
    again = LardHilbertMap.load(tmp_path / "map.pt")
    for one in (model, again):
        for learn in (
            lambda one=one: one.fit(*wall()),
            lambda one=one: one.update(*wall()),
            lambda one=one: one.fit_uncertainty(*wall()),
            lambda one=one: fine_tune(one, *wall()),
            lambda one=one: merge_maps(one, wall_map()),
            lambda one=one: merge_maps(wall_map(), one),
        ):
            with pytest.raises(ValueError, match="a packed map supports queries, but no training"):
                learn()
    assert all(torch.equal(before[name], tensor) for name, tensor in model.state_tensors())


def test_a_packed_map_can_be_moved(path):
    model = packed(wall_map(dtype=torch.float32), path)
    points = wall(seed=2)[0]
    expected = model(points)
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    model.transform(quarter, torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    moved = points @ quarter.T + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(model(moved), expected, atol=2e-4, rtol=0)


def test_a_map_of_real_scans_takes_at_most_22_bytes_a_cluster_and_1_kib(data, path):
    samples = sample_rays(load_scans(data / "la3dm_sim_structured/scans.npz"), seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels, 400)
    points = samples.points[::20]
    change = (packed(model, path)(points) - model(points)).abs()
    assert path.stat().st_size < 22 * len(model)
    assert float(change.mean().detach()) < 2e-3
    assert float(change.max().detach()) < 0.04


def test_a_map_of_10000_scattered_clusters_takes_at_most_22_bytes_each(path):
    model = LardHilbertMap()
    rng = torch.Generator().manual_seed(0)
    count = 10_000
    state = model.state_dict()
    for name, value in state.items():
        if isinstance(value, torch.Tensor) and len(value) == 0:
            state[name] = value.new_zeros(count, *value.shape[1:])
    state["centers"] = 500 * torch.randn(count, 3, generator=rng)  # 3 km
    state["raw_scale_tril"] = torch.randn(count, 3, 3, generator=rng).tril() - 2
    state["weights"] = 5 * torch.randn(count, generator=rng)
    model.load_state_dict(state)
    model.pack(path)
    assert path.stat().st_size <= 22 * count + 1024


def test_a_flipped_bit_is_refused_wherever_it_is(path):
    content = bytearray(whole_packet(path))
    for position in [*range(90), *range(90, len(content), 5)]:
        content[position] ^= 1 << position % 8
        path.write_bytes(content)
        with pytest.raises(ValueError, match=r"map\.lhm must"):
            LardHilbertMap.load(path)
        content[position] ^= 1 << position % 8


def test_a_file_cut_short_anywhere_is_refused(path):
    content = whole_packet(path)
    for cut in (1, 8, 30, 59, 60, 84, len(content) // 2, len(content) - 1):
        path.write_bytes(content[:cut])
        with pytest.raises(ValueError, match=r"map\.lhm must be"):
            LardHilbertMap.load(path)


def test_bytes_after_the_last_packet_are_refused(path):
    path.write_bytes(whole_packet(path) + b"more")
    with pytest.raises(ValueError, match="every packet must begin with LARDPACK; one does not"):
        LardHilbertMap.load(path)


@functools.cache
def packet_of_a_wall():
    model = wall_map(dtype=torch.float32)
    return packed_files.encode(rounded(model))


def whole_packet(path):
    path.write_bytes(packet_of_a_wall())
    return packet_of_a_wall()


@pytest.mark.parametrize(
    ("place", "code", "value", "message"),
    [
        (8, "B", 2, "version of the packet must be 1; got 2"),
        (9, "B", 0, "damaged|dim 1 to 64"),
        (10, "B", 40, "precision 1 to 16"),
        (11, "B", 7, "flag 0 or 1"),
        (11, "B", 0, "the first packet must hold a whole map"),
        (24, "I", 0, "settings > 0"),
        (28, "I", 2**31, "rows of the packet must be in order|too short"),
        (32, "I", 2**31, "too short"),
        (40, "I", 1, "the checksum of the map differs"),
        (44, "d", float("nan"), "finite"),
        (52, "d", -1.0, "settings > 0"),
        (60, "d", float("inf"), "finite"),
    ],
)
def test_a_crafted_header_is_refused(path, place, code, value, message):
    content = whole_packet(path)
    size = struct.calcsize("<" + code)
    path.write_bytes(
        resealed(content[:place] + struct.pack("<" + code, value) + content[place + size :])
    )
    with pytest.raises(ValueError, match=message):
        LardHilbertMap.load(path)


def with_table(table, path):
    plain = packed_files.load_packed(path)[1]
    settings = (plain.num_neighbors, plain.covariance_scale, plain.min_lengthscale)
    return packed_files.encode(packed_files.Packed(table, plain.origin, plain.precision, *settings))


@pytest.mark.parametrize(
    ("column", "value", "message"), [(0, 3, "kinds"), (2, 2**29, "length scales")]
)
def test_crafted_clusters_are_refused(path, column, value, message):
    whole_packet(path)
    table = packed_files.load_packed(path)[1].table.copy()
    table[0, column] = value
    path.write_bytes(with_table(table, path))
    with pytest.raises(ValueError, match=message):
        LardHilbertMap.load(path)


def test_rows_that_inflate_to_something_else_are_refused(path):
    content = whole_packet(path)
    for body in (b"", b"no zlib", zlib.compress(bytes(10**6)), zlib.compress(b"") + b"more"):
        head = content[:16] + struct.pack("<I", len(body)) + content[20:84]
        path.write_bytes(resealed(head + body))
        with pytest.raises(ValueError, match=r"map\.lhm must be a complete packed map; "):
            LardHilbertMap.load(path)


def test_maps_that_cannot_be_rounded_are_refused(path):
    model = wall_map(dtype=torch.float32)
    for precision in (0, 17, 2.5):
        with pytest.raises(ValueError, match="precision must be a whole number from 1 to 16"):
            model.pack(path, precision=precision)
    with torch.no_grad():
        model.centers[0, 0] = 1e9
    with pytest.raises(ValueError, match="precision must be smaller for this map; 6 needs over 30"):
        model.pack(path)
    with torch.no_grad():
        model.centers[0, 0] = torch.nan
    with pytest.raises(ValueError, match="parameters of the map must be finite"):
        model.pack(path)
    assert not path.exists()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_reader_of_the_documentation_answers_as_the_map(path, dim):
    """Pure NumPy: it reads the file without this package."""
    text = DOCS.read_text().split("```python\n")
    (code,) = [block.split("```")[0] for block in text if "LARDPACK" in block.split("```")[0]]
    assert "import torch" not in code
    assert "lardhm_torch" not in code
    names: dict = {}
    exec(compile(code, "reader", "exec"), names)
    model = wall_map(dim, torch.float32, num_neighbors=8)
    copy = packed(model, path)
    points = wall(dim=dim, seed=3)[0]
    answers = names["probability"](names["read"](path), points.numpy())
    np.testing.assert_allclose(answers, copy(points).detach().numpy(), atol=1e-4)


def test_the_state_of_a_packed_file_holds_all_tensors_of_a_map(path):
    wall_map(dtype=torch.float32).pack(path)
    state = load_state(path)
    model = LardHilbertMap.load(path)
    assert torch.equal(model.scatters, state["scatters"])
    assert model.is_packed
    assert bool((model.counts > 0).all())
