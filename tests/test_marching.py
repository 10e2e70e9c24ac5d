"""Marching cubes on blocks: closed surfaces, the native pass, and how blocks fit together."""

import numpy as np
import pytest
import torch
import trimesh

from lardhm_torch.native import available
from lardhm_torch.surfaces.lattice import BLOCK_CELLS, POINTS, SLOTS, Edges, Lattice
from lardhm_torch.surfaces.marching import case_table, march_blocks, plain_march

needs_native = pytest.mark.skipif(not available(), reason="no compiler: the kernel is not built")


def closed_noise(seed, n=9):
    """Random numbers with -1 all around: any surface inside is closed, with every case of a cell."""
    values = -np.ones((n, n, n), dtype=np.float32)
    values[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).normal(size=(n - 2,) * 3)
    return values


def as_mesh(cut, n):
    points, axes = np.divmod(cut.edges, 3)
    places = np.stack(np.unravel_index(points, (n,) * 3), axis=1).astype(float)
    places[np.arange(len(places)), axes] += cut.shares
    return trimesh.Trimesh(places, cut.faces, process=False)


def test_surfaces_through_random_numbers_are_closed_and_look_outside():
    for seed in range(30):
        cut = plain_march(closed_noise(seed)[None], 0.1, np.full((1, 3), 8))
        mesh = as_mesh(cut, 9)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        assert mesh.volume > 0


def test_a_plane_is_cut_where_it_is():
    i = np.arange(5)
    values = (2.25 - i[:, None, None] + np.zeros((5, 5, 5))).astype(np.float32)
    mesh = as_mesh(plain_march(values[None], 0.0, np.full((1, 3), 4)), 5)
    np.testing.assert_allclose(mesh.vertices[:, 0], 2.25)
    np.testing.assert_allclose(mesh.face_normals, np.tile([1.0, 0, 0], (len(mesh.faces), 1)))
    assert mesh.area == pytest.approx(16)


def test_every_case_has_faces_on_exactly_its_crossed_edges():
    table = case_table()
    for case in range(1, 255):
        corners = {e for e in range(12) if e in table[case]}
        crossed = {e for e in range(12) if (case >> ends(e)[0] & 1) != (case >> ends(e)[1] & 1)}
        assert corners == crossed


def ends(edge):
    """Both corners of an edge of a cell, from its number alone."""
    axis, nth = divmod(edge, 4)
    bases = [corner for corner in range(8) if not corner & (4 >> axis)]
    return bases[nth], bases[nth] + (4 >> axis)


@needs_native
def test_the_native_pass_equals_the_definition():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(100, 9, 9, 9)).astype(np.float32)
    values[7] = 1.0  # nothing to cut
    cells = rng.integers(0, 9, (100, 3))
    for found, expected in zip(
        march_blocks(values, 0.1, cells), plain_march(values, 0.1, cells), strict=True
    ):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


@needs_native
def test_the_native_pass_refuses_what_it_cannot_read():
    values, cells, table = torch.zeros(2, 3, 3, 3), torch.full((2, 3), 2), torch.zeros(256, 1, 3)
    table = table.to(torch.int8)
    march = torch.ops.lardhm.march_blocks
    with pytest.raises(RuntimeError, match="cells must be less than n"):
        march(values, 0.0, cells + 1, table)
    with pytest.raises(RuntimeError, match="float32"):
        march(values.double(), 0.0, cells, table)
    with pytest.raises(RuntimeError, match="edges from 0 to 11"):
        march(values, 0.0, cells, table + 12)


def test_an_edge_has_one_owner_and_touches_all_blocks_that_contain_it():
    lattice = Lattice(np.array([0, 0, 0]), np.array([20, 16, 9]), 0.5)
    assert lattice.shape.tolist() == [3, 2, 2]
    blocks = np.arange(12)
    cut_edges = np.arange(12 * SLOTS)  # all of them, as if each were crossed
    point = np.stack(np.unravel_index(cut_edges % SLOTS // 3, (POINTS,) * 3), axis=1)
    point[np.arange(len(point)), cut_edges % 3] += 1
    marched = (point <= lattice.marched_cells(blocks)[cut_edges // SLOTS]).all(axis=1)
    edges = Edges.of(lattice, blocks, cut_edges[marched], np.zeros(marched.sum()))
    names = [(*place, axis) for place, axis in zip(edges.points.tolist(), edges.axes, strict=True)]
    owned = [name for name, own in zip(names, edges.is_owned, strict=True) if own]
    assert len(owned) == len(set(owned))
    assert set(owned) == set(names)
    keys = lattice.edge_keys(edges.points, edges.axes)
    assert len(set(keys.tolist())) == len(owned)
    own = cut_edges[marched][edges.is_owned]
    np.testing.assert_array_equal(keys[edges.is_owned], own)  # block number first, as marched
    for row in range(0, len(names), 97):
        found = edges.select(np.array([row])).touching_blocks(lattice)
        containing = [
            block
            for block, place in enumerate(lattice.place(blocks))
            if all(
                place[d] <= edges.points[row, d]
                and edges.points[row, d] + (d == edges.axes[row]) <= place[d] + BLOCK_CELLS
                for d in range(3)
            )
        ]
        assert found.tolist() == containing
