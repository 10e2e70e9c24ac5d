import sys

import numpy as np
import pytest
import torch

from lardhm_torch import LardHilbertMap, grid, load_scans, sample_rays, simulate_room
from lardhm_torch.io.grid_files import save_grid
from lardhm_torch.queries.grids import LOG_ODDS_MARGIN, map_bounds


@pytest.fixture(scope="module")
def room():
    samples = sample_rays(simulate_room(num_rays=1500), seed=0)
    return LardHilbertMap().fit(samples.points, samples.labels, 150)


@pytest.fixture
def octomap():
    return pytest.importorskip("octomap", reason="octomap-python is not installed (extra octomap)")


def cell_log_odds(model, centers, resolution):
    """(n,) the highest log-odds at the centers of each cell's eight parts."""
    parts = resolution * torch.cartesian_prod(*[torch.tensor([-0.25, 0.25]).double()] * 3)
    with torch.no_grad():
        return model.log_odds(torch.as_tensor(centers)[:, None] + parts).amax(dim=1).numpy()


def read_tree(octomap, path):
    """The leaf cells of a .bt or .ot file: centers (n, 3), edges (n,), occupied (n,), log-odds."""
    tree = octomap.OcTree(0.1)
    if path.suffix == ".bt":
        tree.readBinary(str(path).encode())
    else:
        tree = octomap.OcTree.read(str(path).encode())
    leaves = [
        (leaf.getCoordinate(), leaf.getSize(), tree.isNodeOccupied(leaf), leaf.getValue())
        for leaf in tree.begin_leafs()
    ]
    centers, edges, occupied, log_odds = zip(*leaves, strict=True)
    return tree, np.array(centers), np.array(edges), np.array(occupied), np.array(log_odds)


def test_cells_of_an_npz_hold_the_probability_at_their_centers(room, tmp_path):
    count = save_grid(room, tmp_path / "grid.npz", 0.2)
    with np.load(tmp_path / "grid.npz") as cells:
        probability, lower, edge = cells["probability"], cells["lower"], float(cells["resolution"])
    assert probability.dtype == np.float32
    assert count == probability.size
    assert np.allclose(lower / edge, np.rint(lower / edge))  # at whole multiples
    index = np.stack(np.unravel_index(np.arange(0, probability.size, 997), probability.shape), 1)
    with torch.no_grad():
        expected = room(torch.as_tensor(lower + edge * (index + 0.5)))
    assert np.allclose(probability[tuple(index.T)], expected, atol=1e-5)


def test_bounds_cut_out_the_cells_they_touch(room, tmp_path):
    save_grid(room, tmp_path / "grid.npz", 0.25, bounds=((0.3, -0.3, 1), (1.0, 0.3, 1)))
    with np.load(tmp_path / "grid.npz") as cells:
        assert cells["lower"].tolist() == [0.25, -0.5, 1]
        assert cells["probability"].shape == (3, 4, 1)


def test_a_sparse_grid_holds_the_cells_of_the_dense_one_and_the_rest_is_unknown(room, tmp_path):
    save_grid(room, tmp_path / "dense.npz", 0.15)
    count = save_grid(room, tmp_path / "sparse.npz", 0.15, sparse=True)
    with np.load(tmp_path / "dense.npz") as cells:
        dense, lower = cells["probability"], cells["lower"]
    with np.load(tmp_path / "sparse.npz") as cells:
        blocks, values = cells["blocks"], cells["probability"]
        assert np.allclose(cells["lower"], lower)
        assert cells["cells"].tolist() == list(dense.shape)
        assert float(cells["resolution"]) == 0.15
    assert values.shape == (len(blocks), 8, 8, 8)
    assert values.dtype == np.float32
    assert count == values.size
    whole = np.full([-(-n // 8) * 8 for n in dense.shape], 0.5, dtype=np.float32)
    for (i, j, k), block in zip(blocks, values, strict=True):
        whole[i : i + 8, j : j + 8, k : k + 8] = block
    whole = whole[tuple(slice(n) for n in dense.shape)]
    stored = whole != 0.5
    assert np.allclose(whole[stored], dense[stored], atol=1e-5)
    assert np.abs(dense[~stored] - 0.5).max(initial=0) < 0.05
    with pytest.raises(ValueError, match=r"sparse needs a path that ends in \.npz and a 3-D map"):
        save_grid(room, tmp_path / "map.bt", sparse=True)


def test_a_sparse_grid_of_few_places_far_apart_is_small(tmp_path):
    points = torch.rand(200, 3, dtype=torch.float64)
    points[100:, :2] += 1000  # [m]
    model = LardHilbertMap().fit(points, torch.ones(200), 20)
    count = save_grid(model, tmp_path / "grid.npz", 0.1, sparse=True)
    assert count < 500_000  # the whole box has 1.6e9 cells
    with np.load(tmp_path / "grid.npz") as cells:
        assert (cells["probability"] > 0.9).sum() > 1000


def test_a_flat_map_gives_a_flat_grid_and_no_octomap(tmp_path):
    points = torch.rand(200, 2)
    model = LardHilbertMap(2).fit(points, (points[:, 0] > 0.5).long(), 20)
    save_grid(model, tmp_path / "grid.npz")
    with np.load(tmp_path / "grid.npz") as cells:
        assert cells["probability"].ndim == 2
    with pytest.raises(ValueError, match=r"OctoMap needs a 3-D map; got 2-D\. Use \.npz"):
        save_grid(model, tmp_path / "grid.bt")


def test_octomap_gets_the_classes_of_known_cells_and_no_others(room, octomap, tmp_path):
    count = save_grid(room, tmp_path / "map.bt", 0.4)
    tree, centers, edges, occupied, _ = read_tree(octomap, tmp_path / "map.bt")
    assert tree.getResolution() == 0.4
    assert np.rint((edges / 0.4) ** 3).sum() == count  # pruned leaves hold several cells
    log_odds = cell_log_odds(room, centers[edges < 0.5], 0.4)
    assert (np.abs(log_odds) > LOG_ODDS_MARGIN - 1e-3).all()
    assert np.array_equal(log_odds > 0, occupied[edges < 0.5])
    lower, upper = map_bounds(room)
    everywhere = (grid(lower, upper, 0.4).reshape(-1, 3) / 0.4).floor() * 0.4 + 0.2
    known = np.abs(cell_log_odds(room, everywhere, 0.4)) >= LOG_ODDS_MARGIN
    assert known.sum() == pytest.approx(count, rel=0.002)  # tails reach out of three deviations


def test_octomap_full_trees_hold_the_clamped_log_odds(room, octomap, tmp_path):
    save_grid(room, tmp_path / "map.ot", 0.4)
    _, centers, edges, _, values = read_tree(octomap, tmp_path / "map.ot")
    single = edges < 0.5
    log_odds = cell_log_odds(room, centers[single], 0.4)
    assert np.allclose(values[single], log_odds.clip(-2, 3.511), atol=1e-3)


def cells_of_leaves(centers, edges, resolution):
    """Centers (n, 3) of the cells that leaves cover, and the leaf (n,) of each."""
    cells, owner = [], []
    for leaf, (center, edge) in enumerate(zip(centers, edges, strict=True)):
        side = (np.arange(np.rint(edge / resolution)) + 0.5) * resolution - edge / 2
        cells.append(center + np.stack(np.meshgrid(side, side, side), -1).reshape(-1, 3))
        owner += [leaf] * len(cells[-1])
    return np.concatenate(cells), np.array(owner)


def prune_all(tree, node) -> int:
    """Prune a tree of pyoctomap below a node, children first; the number of nodes pruned."""
    if not node.hasChildren():
        return 0
    children = [tree.getNodeChild(node, i) for i in range(8) if node.childExists(i)]
    return sum(prune_all(tree, child) for child in children) + tree.pruneNode(node)


def test_full_trees_are_pruned_as_pyoctomap_prunes_them(room, octomap, tmp_path):
    pyoctomap = pytest.importorskip("pyoctomap", reason="pyoctomap is not installed")
    count = save_grid(room, tmp_path / "map.ot", 0.4)
    tree = pyoctomap.OcTree(0.4).read(str(tmp_path / "map.ot"))
    leaves = [(*leaf.getCoordinate(), leaf.getSize()) for leaf in tree.begin_leafs()]
    values = np.array([leaf.current_node.getValue() for leaf in tree.begin_leafs()])
    _, centers, edges, _, expected = read_tree(octomap, tmp_path / "map.ot")
    assert np.array_equal(leaves, np.column_stack([centers, edges]))
    assert np.array_equal(values, expected)
    # every cell of a pruned leaf has the value of the leaf
    assert edges.max() > 0.5
    cells, owner = cells_of_leaves(centers, edges, 0.4)
    assert len(cells) == count
    log_odds = cell_log_odds(room, cells, 0.4).clip(-2, 3.511)
    assert np.allclose(log_odds, values[owner], atol=1e-3)
    # lazy updates prune nothing: the same cells, then pruned by the library, are the same file
    whole = pyoctomap.OcTree(0.4)
    for cell, value in zip(cells, values[owner].tolist(), strict=True):
        whole.updateNode(cell, value, True)
    whole.updateInnerOccupancy()
    assert whole.getNumLeafNodes() == count
    assert prune_all(whole, whole.getRoot()) > 0
    whole.write(str(tmp_path / "whole.ot"))
    assert (tmp_path / "whole.ot").read_bytes() == (tmp_path / "map.ot").read_bytes()


def test_a_map_of_real_scans_goes_to_octomap_and_back(data, octomap, tmp_path):
    scans = load_scans(data / "la3dm_sim_structured/scans.npz")
    samples = sample_rays(scans.select(torch.arange(0, len(scans), 5)), seed=0)
    model = LardHilbertMap().fit(samples.points, samples.labels, 300)
    save_grid(model, tmp_path / "map.bt", 0.2)
    tree = octomap.OcTree(0.2)
    tree.readBinary(str(tmp_path / "map.bt").encode())
    places = torch.cat([scans.hits[::20], (scans.ends[::50] + scans.ray_origins[::50]) / 2])
    log_odds = cell_log_odds(model, (places / 0.2).floor() * 0.2 + 0.1, 0.2)
    expected = np.where(np.abs(log_odds) < LOG_ODDS_MARGIN, -1, log_odds > 0)
    assert np.array_equal(tree.getLabels(places.numpy()), expected)
    assert {-1, 0, 1} == set(expected.tolist())


def test_what_cannot_be_written_is_said_and_leaves_the_old_file(room, octomap, tmp_path):
    (tmp_path / "map.bt").write_bytes(b"old")
    with pytest.raises(
        ValueError, match=r"end in one of \.bt, \.npz, \.ot for a grid; got 'map.x'"
    ):
        save_grid(room, tmp_path / "map.x")
    with pytest.raises(ValueError, match="resolution must be > 0"):
        save_grid(room, tmp_path / "map.bt", 0)
    with pytest.raises(ValueError, match="it is empty"):
        save_grid(LardHilbertMap(), tmp_path / "map.bt")
    far = LardHilbertMap().fit(torch.rand(50, 3) + torch.tensor([5e5, 0, 0]), torch.ones(50))
    with pytest.raises(ValueError, match=r"0\.1 m cells spans 3277 m .*reaches 50000\d m"):
        save_grid(far, tmp_path / "map.bt", 0.1)
    assert (tmp_path / "map.bt").read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["map.bt"]


def test_without_octomap_the_error_names_the_extra(room, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "octomap", None)
    with pytest.raises(ImportError, match=r"lardhm_torch\[octomap\]"):
        save_grid(room, tmp_path / "map.bt")
