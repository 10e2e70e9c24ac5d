"""Scans to training points per tile."""

import fcntl
import itertools

import pytest
import torch
from room_tiles import CONFIG, EDGE, contents, room_folder, room_pieces

from lardhm_torch import SamplingConfig, Scans, sample_rays
from lardhm_torch.tiles import routing
from lardhm_torch.tiles.indexing import grid_origin, samples_path, tile_indices
from lardhm_torch.tiles.ledger import Counts, read_ledger
from lardhm_torch.tiles.manifest import read_manifest
from lardhm_torch.tiles.records import Grid, read_records, route, unpack
from lardhm_torch.tiles.routing import TilingConfig, add_scans, tile_scans

CPU = torch.device("cpu")
KNOWN = SamplingConfig(behind_samples=0)  # tiles have no unknown points


def points_of(folder, index, limit=1 << 20):
    """World positions, labels and whether in the core of one tile."""
    manifest, ledger = read_manifest(folder), read_ledger(folder)
    records = read_records(folder, index, sum(ledger.tiles[index]), manifest.dim, limit)
    tile = unpack(records, CPU, torch.float64)
    corner = torch.tensor(manifest.origin, dtype=torch.float64) + EDGE * torch.tensor(index)
    return tile._replace(points=tile.points + corner)


def assert_same_points(points, labels, wanted, wanted_labels):
    """The same labelled points in any order, to a micrometer."""
    assert len(points) == len(wanted)
    if len(points):
        gaps, partner = torch.cdist(points, wanted).min(dim=1)
        assert gaps.max() < 1e-6
        assert len(partner.unique()) == len(wanted)
        assert torch.equal(labels, wanted_labels[partner].double())


def test_every_sample_is_in_the_core_of_the_tile_it_lies_in(tmp_path):
    (piece,) = room_pieces(pieces=1)
    folder = room_folder(tmp_path / "room", [piece])
    samples, ledger = sample_rays(piece, KNOWN), read_ledger(folder)
    owner = tile_indices(samples.points, read_manifest(folder).origin, EDGE)
    assert len(ledger.cores) == len(owner.unique(dim=0))
    for index in ledger.cores:
        tile = points_of(folder, index)
        mine = (owner == torch.tensor(index)).all(dim=1)
        assert_same_points(
            tile.points[tile.in_core], tile.labels[tile.in_core],
            samples.points[mine], samples.labels[mine],
        )  # fmt: skip
        assert ledger.tiles[index].hits == int(samples.labels[mine].sum())


def test_the_halo_of_a_tile_holds_the_points_just_outside(tmp_path):
    (piece,) = room_pieces(pieces=1)
    folder = room_folder(tmp_path / "room", [piece])
    samples, manifest = sample_rays(piece, KNOWN), read_manifest(folder)
    for index in read_ledger(folder).tiles:
        corner = torch.tensor(manifest.origin, dtype=torch.float64) + EDGE * torch.tensor(index)
        offsets = samples.points - corner
        near = (offsets >= -manifest.halo) & (offsets < EDGE + manifest.halo)
        inside = (offsets >= 0) & (offsets < EDGE)
        halo = near.all(dim=1) & ~inside.all(dim=1)
        tile = points_of(folder, index)
        assert_same_points(
            tile.points[~tile.in_core], tile.labels[~tile.in_core],
            samples.points[halo], samples.labels[halo],
        )  # fmt: skip


def test_a_ray_through_several_tiles_leaves_free_samples_in_each(tmp_path):
    scans = Scans(torch.tensor([[0.1, 0.1, 0.1]]), torch.tensor([[39.0, 0.1, 0.1]]))
    config = TilingConfig(edge=10.0, sampling=SamplingConfig(free_samples=100))
    ledger = tile_scans([scans], tmp_path / "ray", config)
    cores = {index: ledger.tiles[index] for index in ledger.cores}
    assert sorted(cores) == [(i, 0, 0) for i in range(5)]
    assert all(counts.free > 0 for counts in cores.values())
    assert [counts.hits for counts in cores.values()] == [0, 0, 0, 0, 1]


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_points_of_any_dimension_are_routed(dim):
    points = 30 * torch.randn(500, dim, dtype=torch.float64)
    labels = (torch.arange(500) % 2).double()
    parts = list(route(points, labels, Grid((0.0,) * dim, 10.0, 0.0)))
    assert [index for index, _ in parts] == sorted({index for index, _ in parts})
    assert sum(len(records) for _, records in parts) == 500
    for index, records in parts:
        back = torch.tensor(records["position"].copy()).double() + 10 * torch.tensor(index)
        assert torch.cdist(back, points).amin(dim=1).max() < 1e-5


def test_tiles_too_scattered_for_a_table_are_told_apart(monkeypatch):
    points = torch.tensor([[0.5, 0.5], [1e6, -1e6], [0.6, 0.5], [3e7, 3e7]], dtype=torch.float64)
    parts = list(route(points, torch.zeros(4), Grid((0.0, 0.0), 1.0, 0.0)))
    assert {index: len(records) for index, records in parts} == {
        (0, 0): 2, (1_000_000, -1_000_000): 1, (30_000_000, 30_000_000): 1,
    }  # fmt: skip


def test_far_from_the_origin_positions_keep_their_micrometers(tmp_path):
    utm = torch.tensor([500_000.123456, 4_500_000.654321, 100.0], dtype=torch.float64)
    (piece,) = room_pieces(300, 1)
    moved = Scans(piece.origins + utm, piece.ends + utm, piece.scan_id, piece.is_return)
    folder = room_folder(tmp_path / "far", [moved])
    points = torch.cat([points_of(folder, i).points for i in read_ledger(folder).cores])
    gaps = torch.cdist(points - utm, sample_rays(moved).points - utm).amin(dim=1)
    assert gaps.max() < 1e-6


def test_any_two_grids_of_one_edge_have_their_borders_in_the_same_places():
    for a, b in itertools.product([0.0, 3.3, -17.0, 1234.5], repeat=2):
        ours, theirs = (grid_origin(torch.tensor([x, 0.0]), 20.0) for x in (a, b))
        assert (ours[0] - theirs[0]) % 20 == 0
        assert abs(ours[1]) == 10  # the ground at height 0 is not cut


def test_a_killed_run_goes_on_and_ends_with_the_same_files(tmp_path, monkeypatch):
    pieces = room_pieces(pieces=6)
    whole = room_folder(tmp_path / "whole", pieces)
    monkeypatch.setattr(routing, "BUFFER_BYTES", 20_000)  # written after every second piece or so

    def interrupted():
        yield from pieces[:4]
        raise KeyboardInterrupt

    folder = tmp_path / "killed"
    with pytest.raises(KeyboardInterrupt):
        tile_scans(interrupted(), folder, CONFIG)
    begun = read_ledger(folder)
    assert 0 < begun.chunks <= 4
    assert not begun.complete
    left = samples_path(folder, begun.cores[0])
    left.write_bytes(left.read_bytes() + b"half of a record")
    (folder / "samples" / "9_9_9").write_bytes(b"of no tile that counts")
    calls = []
    monkeypatch.setattr(
        routing, "sample_rays", lambda *a, **k: calls.append(a) or sample_rays(*a, **k)
    )
    tile_scans(pieces, folder, CONFIG)
    assert len(calls) == 6 - begun.chunks
    assert contents(folder, "samples") == contents(whole, "samples")
    assert read_ledger(folder) == read_ledger(whole)


def test_a_run_goes_on_only_with_the_scans_it_was_begun_with(tmp_path, monkeypatch):
    monkeypatch.setattr(routing, "BUFFER_BYTES", 1)
    pieces = room_pieces()
    with pytest.raises(ValueError, match=r"must have 3 coordinates as the first; got 2"):
        tile_scans([*pieces[:2], Scans([[0.0, 0.0]], [[1.0, 1.0]])], tmp_path / "room", CONFIG)
    with pytest.raises(ValueError, match=r"begun with, 1000 rays in the first 2 pieces; got 999"):
        tile_scans([pieces[0], pieces[1].select(torch.arange(499))], tmp_path / "room", CONFIG)
    with pytest.raises(ValueError, match=r"in the first 2 pieces; got 500 in 1"):
        tile_scans(pieces[:1], tmp_path / "room", CONFIG)
    with pytest.raises(ValueError, match="begun with the same scans and settings"):
        tile_scans(pieces, tmp_path / "room", TilingConfig(edge=5.0))
    with pytest.raises(ValueError, match=r"must be complete before scans are added"):
        add_scans(pieces, tmp_path / "room")


def test_added_scans_are_as_if_they_had_been_there_from_the_start(tmp_path):
    pieces = room_pieces()
    whole = room_folder(tmp_path / "whole", pieces)
    folder = room_folder(tmp_path / "grown", pieces[:2])
    before = read_ledger(folder)
    after, touched = add_scans(pieces[2:], folder)
    assert after == read_ledger(folder) == read_ledger(whole)
    assert contents(folder, "samples") == contents(whole, "samples")
    grown = [i for i in after.cores if after.tiles[i].core != before.tiles.get(i, Counts()).core]
    assert touched == grown


def test_a_failed_addition_leaves_the_folder_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setattr(routing, "BUFFER_BYTES", 1)
    folder = room_folder(tmp_path / "room")
    before = contents(folder)
    with pytest.raises(ValueError, match="coordinates as the first"):
        add_scans([*room_pieces(seed=1), Scans([[0.0, 0.0]], [[1.0, 1.0]])], folder)
    assert contents(folder) == before


def test_pieces_without_a_usable_ray_are_passed_over(tmp_path):
    nothing = Scans(torch.zeros(1, 3), torch.full((4, 3), torch.nan))
    pieces = room_pieces(pieces=1)
    folder = room_folder(tmp_path / "room", [nothing, *pieces])
    assert read_ledger(folder).chunks == 2
    with pytest.raises(ValueError, match="at least one usable ray; got none"):
        tile_scans([nothing], tmp_path / "nothing", CONFIG)
    tile_scans(pieces, tmp_path / "nothing", CONFIG)  # nothing was in it yet
    with pytest.raises(ValueError, match="at least one Scans; got none"):
        tile_scans([], tmp_path / "none", CONFIG)


def test_a_folder_that_holds_something_is_not_touched(tmp_path):
    (tmp_path / "thesis.tex").write_text("three years")
    with pytest.raises(ValueError, match=r"new or empty; .* holds thesis\.tex"):
        tile_scans(room_pieces(), tmp_path, CONFIG)
    folder = room_folder(tmp_path / "room")
    with pytest.raises(ValueError, match="`lardhm update` adds scans to it"):
        tile_scans(room_pieces(), folder, CONFIG)


def test_a_folder_has_one_writer_at_a_time(tmp_path):
    folder = room_folder(tmp_path / "room")
    with open(folder / "samples.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(ValueError, match="one writer at a time"):
            add_scans(room_pieces(), folder)


def test_more_points_than_the_limit_are_taken_at_even_steps(tmp_path):
    folder = room_folder(tmp_path / "room")
    index = max(read_ledger(folder).cores, key=lambda i: read_ledger(folder).tiles[i].core)
    every, some = points_of(folder, index), points_of(folder, index, limit=10)
    total = len(every.points)
    assert torch.equal(some.points, every.points[torch.arange(10) * total // 10])


def test_cut_and_damaged_files_are_named(tmp_path):
    folder = room_folder(tmp_path / "room")
    index = read_ledger(folder).cores[0]
    path = samples_path(folder, index)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(
        ValueError, match=rf"samples/{path.name} must hold \d+ bytes.*tile the scans"
    ):
        add_scans(room_pieces(), folder)
    with pytest.raises(ValueError, match=rf"samples/{path.name} must hold \d+ points"):
        points_of(folder, index)
    (folder / "samples.json").write_text('{"format_version": 1, "tiles": {"x": [1]}}')
    with pytest.raises(
        ValueError, match=r"samples\.json must be the complete ledger of a tiled map"
    ):
        read_ledger(folder)
    (folder / "samples.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"has no samples\.json. `lardhm tile` writes it"):
        read_ledger(folder)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"edge": 0.0}, "edge must be > 0 m and finite; got 0.0"),
        ({"edge": float("inf")}, "edge must be > 0 m and finite; got inf"),
        ({"edge": 4.0, "halo": 2.5}, "halo must be 0 to half an edge, 2.0; got 2.5"),
        ({"halo": -1.0}, "halo must be 0 to half an edge, 10.0; got -1.0"),
    ],
)
def test_settings_out_of_range_are_named(setting, message):
    with pytest.raises(ValueError, match=message):
        TilingConfig(**setting)
