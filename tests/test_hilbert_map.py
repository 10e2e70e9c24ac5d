import copy
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_maps import same_map, wall, wall_map
from torch import nn

import lardhm_torch
from lardhm_torch import FitConfig, LardHilbertMap, load_scans, sample_rays, split_rays

F64 = torch.float64


@pytest.mark.parametrize("dim", [1, 2, 3, 5])
def test_a_wall_is_occupied_and_the_space_before_it_free(dim):
    model = wall_map(dim)
    points, labels = wall(dim=dim, seed=1)
    assert ((model(points) > 0.5) == (labels > 0.5)).double().mean() > 0.97


def test_an_empty_map_and_places_far_from_every_cluster_say_exactly_one_half():
    anywhere = torch.randn(10, 3) * 1e4
    assert torch.equal(LardHilbertMap()(anywhere), torch.full((10,), 0.5))
    assert torch.equal(wall_map()(anywhere + 1e5), torch.full((10,), 0.5, dtype=F64))


@settings(deadline=None, max_examples=10)
@given(shape=st.lists(st.integers(0, 4), max_size=3))
def test_any_leading_shape_is_answered_in_that_shape(shape):
    model = LardHilbertMap(2).fit(*wall(50, 2), num_clusters=8)
    points = torch.rand(*shape, 2, dtype=F64)
    answer = model(points)
    assert answer.shape == torch.Size(shape)
    assert answer.dtype == torch.float32
    torch.testing.assert_close(answer.reshape(-1), model(points.reshape(-1, 2)))


def test_log_odds_are_the_weighted_features():
    model, points = wall_map(), wall(50)[0]
    product = torch.sparse.mm(model.features(points), model.weights[:, None]).squeeze(1)
    torch.testing.assert_close(model.log_odds(points), product)
    torch.testing.assert_close(model(points), torch.sigmoid(product))


def test_gradients_reach_points_and_every_parameter():
    model = wall_map(num_neighbors=3)
    points = wall(5)[0].requires_grad_()
    model.requires_grad_(True)
    names = ("weights", "centers", "raw_scale_tril")

    def probability(points, *state):
        return torch.func.functional_call(model, dict(zip(names, state, strict=True)), (points,))

    state = [getattr(model, name).detach().clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(probability, (points, *state), atol=1e-4)


def test_a_shift_of_the_world_changes_no_probability(data):
    shift = torch.tensor([5e5, 4.5e6, 100.0], dtype=F64)
    scans = load_scans(data / "paper_virtual/scans.npz")
    scans = scans.select(torch.arange(0, len(scans), 4))
    moved = lardhm_torch.Scans(scans.origins + shift, scans.ends + shift, scans.scan_id)
    here, there = (sample_rays(s) for s in (scans, moved))
    first = LardHilbertMap().fit(here.points, here.labels)
    second = LardHilbertMap().fit(there.points, there.labels)
    with torch.no_grad():
        difference = first(here.points) - second(here.points + shift)
    assert difference.abs().max() <= 1e-5


def test_single_and_double_precision_agree():
    points, labels = wall()
    double = LardHilbertMap().double().fit(points, labels, num_clusters=40)
    single = copy.deepcopy(double).float()
    # float32 carries 7 digits; weights of about 10 amplify the kernel's rounding to about 1e-5.
    torch.testing.assert_close(single(points).double(), double(points), atol=1e-4, rtol=0)


def test_the_origin_stays_float64_through_every_cast():
    model = LardHilbertMap().fit(wall()[0] + torch.tensor([5e5, 4.5e6, 100.0]), wall()[1])
    origin = model.origin.clone()
    for cast in (model.float, model.half, model.double, lambda: model.to(torch.bfloat16)):
        cast()
        assert model.origin.dtype == F64
        assert torch.equal(model.origin, origin)
        assert model.counts.dtype == torch.long


def test_nan_and_infinite_points_have_probability_nan():
    points = torch.tensor([[float("nan"), 0, 0], [0, float("inf"), 0], [1.0, 1, 1]])
    for model in (wall_map(), LardHilbertMap()):
        assert model(points).isnan().tolist() == [True, True, False]


def test_a_fit_is_repeatable_and_starts_over():
    points, labels = wall()
    model = LardHilbertMap().fit(points + 3, labels, num_clusters=20)
    model.fit(points, labels, num_clusters=40, seed=4)
    assert same_map(model, LardHilbertMap().fit(points, labels, num_clusters=40, seed=4))
    assert not same_map(model, LardHilbertMap().fit(points, labels, num_clusters=40, seed=5))


def test_a_fit_keeps_the_parameters_the_optimizer_knows():
    model = LardHilbertMap()
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    known = model.weights
    model.fit(*wall(), num_clusters=40)
    assert model.weights is known
    before = model.weights.detach().clone()
    model.log_odds(wall()[0]).sum().backward()
    optimizer.step()
    assert not torch.equal(model.weights, before)


def test_a_map_changes_size_while_an_answer_with_a_graph_is_around():
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    labels = (points[:, 0] > 0).float()
    model = LardHilbertMap(num_neighbors=4).fit(points, labels, num_clusters=8)
    before = model(points)
    model.fit(points, labels, num_clusters=20)
    after = model(points)
    after.sum().backward()
    assert model.weights.grad.shape == (len(model),)
    # The native kernel's graph says the first, that of plain torch the second.
    with pytest.raises(RuntimeError, match=r"modified by an inplace operation|must match the size"):
        before.sum().backward()


def test_save_and_load_give_the_same_map(tmp_path):
    model = wall_map(num_neighbors=7, covariance_scale=3.0)
    model.save(tmp_path / "map.pt")
    assert same_map(LardHilbertMap.load(tmp_path / "map.pt"), model)
    torch.save(model.state_dict(), tmp_path / "plain.pt")
    assert same_map(LardHilbertMap.load(tmp_path / "plain.pt"), model)
    half = copy.deepcopy(model).half()
    half.save(tmp_path / "half.pt")
    assert same_map(LardHilbertMap.load(tmp_path / "half.pt"), half)


def test_a_state_dict_loads_into_a_map_of_any_other_size():
    model, other = wall_map(dtype=torch.float32), LardHilbertMap().fit(*wall(50), num_clusters=6)
    known = other.weights
    other.load_state_dict(model.state_dict())
    assert same_map(model, other)
    assert other.weights is known
    empty = LardHilbertMap()
    other.load_state_dict(empty.state_dict())
    assert len(other) == 0


def test_a_state_dict_loads_nested_in_another_module():
    def robot(fitted):
        return nn.ModuleDict({"map": fitted, "head": nn.Linear(2, 2)})

    model = robot(wall_map(dtype=torch.float32))
    other = robot(LardHilbertMap())
    other.load_state_dict(model.state_dict())
    assert same_map(model["map"], other["map"])


def test_copies_and_pickles_are_the_same_map():
    model = wall_map()
    assert same_map(copy.deepcopy(model), model)
    assert same_map(pickle.loads(pickle.dumps(model)), model)


def test_settings_that_differ_are_named_and_nothing_is_loaded():
    model, other = wall_map(), LardHilbertMap(num_neighbors=6).double()
    with pytest.raises(ValueError, match=r"num_neighbors = 6; got 16.*num_neighbors=16"):
        other.load_state_dict(model.state_dict())
    assert len(other) == 0


def test_a_checkpoint_with_swapped_shapes_leaves_the_map_as_it_was():
    model = wall_map()
    state = model.state_dict()
    state["centers"], state["raw_scale_tril"] = state["raw_scale_tril"], state["centers"]
    before = copy.deepcopy(model)
    with pytest.raises(ValueError, match=r"centers must be \(\d+, 3\).*got \(\d+, 3, 3\)"):
        model.load_state_dict(state)
    assert same_map(model, before)


def test_a_missing_tensor_and_a_newer_format_are_named():
    state = wall_map().state_dict()
    del state["counts"]
    with pytest.raises(ValueError, match=r"missing: \['counts'\]"):
        LardHilbertMap().load_state_dict(state)
    state = wall_map().state_dict()
    state["_extra_state"]["format_version"] = 99
    with pytest.raises(ValueError, match="format_version must be 2; got 99"):
        LardHilbertMap().load_state_dict(state)
    with pytest.raises(ValueError, match="_extra_state must hold"):
        LardHilbertMap().load_state_dict({})


GOOD, LABELS = wall(20)
BAD_SAMPLES = {
    "no points": (GOOD[:0], LABELS[:0], "at least one point; got 0"),
    "wrong dimension": (GOOD[:, :2], LABELS, r"points must be \(N, 3\); got \(40, 2\)"),
    "flat points": (GOOD[0], LABELS[:3], r"points must be \(N, 3\); got \(3,\)"),
    "too few labels": (GOOD, LABELS[:-1], r"labels must be \(40,\).*got \(39,\)"),
    "labels of -1": (GOOD, 2 * LABELS - 1, r"0 or 1; got -1.*labels = \(labels \+ 1\) / 2"),
    "labels of 0.25": (GOOD, LABELS * 0.25, "labels must be 0 or 1; got 0.25"),
    "NaN labels": (GOOD, LABELS * float("nan"), "labels must be 0 or 1; got nan"),
    "NaN": (GOOD * float("nan"), LABELS, r"finite; got 40 rows.*row 0.*isfinite\(\)"),
    "infinity": (GOOD / 0, LABELS, "finite; got 40 rows"),
}


@pytest.mark.parametrize("case", BAD_SAMPLES)
def test_bad_samples_are_refused_and_the_map_is_as_it_was(case):
    points, labels, message = BAD_SAMPLES[case]
    model = wall_map()
    before = copy.deepcopy(model)
    with pytest.raises(ValueError, match=message):
        model.fit(points, labels)
    assert same_map(model, before)


def test_a_fit_that_fails_half_way_leaves_the_map_as_it_was(monkeypatch):
    model = wall_map()
    before = copy.deepcopy(model)
    monkeypatch.setattr("lardhm_torch.learning.fitting.fit_weights", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        model.fit(*wall(), num_clusters=7)
    assert same_map(model, before)


@pytest.mark.filterwarnings("ignore:none of 100 points is occupied")
@pytest.mark.parametrize(
    ("points", "labels", "clusters"),
    [
        (torch.ones(1, 3), torch.ones(1), 1),
        (torch.ones(50, 3), torch.ones(50), 1),
        (torch.rand(100, 3), torch.zeros(100), 28),
        (torch.eye(7, 3) + torch.arange(7.0)[:, None], torch.eye(7)[0], 7),
    ],
    ids=["one point", "all points equal", "only one class", "a lone hit"],
)
def test_little_data_still_makes_a_map(points, labels, clusters):
    model = LardHilbertMap().fit(points, labels, num_clusters=500)
    assert 1 <= len(model) <= clusters
    assert model.scale_tril.isfinite().all()
    assert ((model(points) > 0.5) == (labels > 0.5)).double().mean() >= 0.75


def test_more_neighbors_than_clusters_means_all_of_them():
    model = LardHilbertMap(num_neighbors=50).fit(*wall(30), num_clusters=6)
    assert model.features(wall(30)[0])._nnz() == 60 * len(model)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"dim": 0}, "dim must be a whole number, 1 or more; got 0"),
        ({"num_neighbors": 0}, "num_neighbors must be a whole number, 1 or more; got 0"),
        ({"covariance_scale": 0.0}, "must be > 0; got 0.0"),
        ({"min_lengthscale": -1.0}, "must be > 0; got 4.0 and -1.0"),
    ],
)
def test_settings_are_checked_when_made(settings, message):
    with pytest.raises(ValueError, match=message):
        LardHilbertMap(**settings)


def test_queries_of_the_wrong_shape_and_cluster_numbers_below_one_are_refused():
    model = wall_map()
    with pytest.raises(ValueError, match=r"points must be \(..., 3\).*got \(4, 2\)"):
        model(torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"points must be \(N, 3\); got \(3,\)"):
        model.features(torch.zeros(3))
    with pytest.raises(ValueError, match=r"num_clusters must be a whole number.*; got 0"):
        model.fit(*wall(), num_clusters=0)


def test_a_float_factor_that_an_optimizer_ruined_is_still_valid():
    model = wall_map()
    with torch.no_grad():
        model.raw_scale_tril.copy_(torch.randn_like(model.raw_scale_tril) * 50)
    diagonal = model.scale_tril.diagonal(dim1=-2, dim2=-1)
    assert (diagonal >= model.covariance_scale**0.5 * model.min_lengthscale).all()


def test_all_public_names_exist():
    for name in lardhm_torch.__all__:
        assert getattr(lardhm_torch, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'lard'"):
        _ = lardhm_torch.lard


@pytest.mark.parametrize(
    ("name", "unif", "near"),
    [("paper_virtual", 0.99, 0.975), ("sevenscenes_semidense", 0.99, 0.985)],
)
def test_held_out_rays_of_real_scans_are_predicted(data, name, unif, near):
    from lardhm_torch.evaluation.held_out import evaluate

    scans = load_scans(data / name / "scans.npz")
    scans = scans.select(torch.randperm(len(scans), generator=torch.Generator().manual_seed(0)))
    train, test = split_rays(scans.select(torch.arange(min(len(scans), 60000))), 0.5)
    samples = sample_rays(train)
    with torch.no_grad():
        table = evaluate(LardHilbertMap().fit(samples.points, samples.labels), test)
    assert table["unif"]["balanced_accuracy"] >= unif
    assert table["near"]["balanced_accuracy"] >= near


def test_the_papers_own_sgd_is_available():
    paper = FitConfig(passes=1, learning_rate=0.1, decay=False, preconditioner=False, batch_size=8)
    points, labels = wall()
    model = LardHilbertMap().fit(points, labels, num_clusters=40, config=paper)
    assert ((model(points) > 0.5) == (labels > 0.5)).double().mean() > 0.9


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_a_lattice_gives_what_its_points_give(dim):
    points = torch.randn(300, dim, generator=torch.Generator().manual_seed(0)) + 100
    model = LardHilbertMap(dim=dim).fit(points, (points[:, 0] > 100).float(), num_clusters=12)
    axes = [torch.linspace(97, 103, n, dtype=torch.float64) for n in (7, 11, 5)[:dim]]
    lattice = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    torch.testing.assert_close(model.query_lattice(axes), model(lattice).detach())
    log_odds = model.query_lattice(axes, probability=False)
    torch.testing.assert_close(log_odds, model.log_odds(lattice).detach())
    with pytest.raises(ValueError, match=f"axes must be {dim} lists"):
        model.query_lattice([*axes, axes[0]])
    with pytest.raises(ValueError, match="axes must be finite"):
        model.query_lattice([axes[0] * torch.inf, *axes[1:]])


def test_an_empty_map_is_true_and_takes_device_and_dtype_from_its_arguments():
    model = LardHilbertMap(2, device="cpu", dtype=torch.float64)
    assert model
    assert len(model) == 0
    assert {t.dtype for t in (model.weights, model.centers, model.means)} == {torch.float64}
    with pytest.raises(ValueError, match=r"dtype must be a floating point type; got torch\.int32"):
        LardHilbertMap(2, dtype=torch.int32)


def test_arrays_and_lists_work_where_tensors_do():
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    labels = (points[:, 0] > 0.5).long()
    model = LardHilbertMap().fit(points, labels, 10)
    assert torch.equal(LardHilbertMap().fit(points, labels.bool(), 10).weights, model.weights)
    for convert in (lambda t: t.numpy(), lambda t: t.tolist()):
        other = LardHilbertMap().fit(convert(points), convert(labels), 10)
        assert torch.equal(other.weights, model.weights)
        assert torch.equal(other(convert(points + 1e6)), model(points + 1e6))
        other.update(convert(points), convert(labels))


def test_a_number_of_clusters_that_is_not_whole_is_refused():
    for wrong in (100.0, True, "4"):
        with pytest.raises(ValueError, match=r"num_clusters must be a whole number.*got"):
            LardHilbertMap().fit(torch.rand(40, 3), torch.ones(40), wrong)


def test_a_saved_state_dict_holds_no_reserve_of_a_growing_map(tmp_path):
    rng = torch.Generator().manual_seed(0)
    model = LardHilbertMap()
    for place in range(4):
        points = torch.rand(2000, 3, generator=rng) + 5 * place
        model.update(points, (points[:, 0] % 1 > 0.5).float())
    torch.save(model.state_dict(), tmp_path / "map.pt")
    tensors = [t for t in model.state_dict().values() if isinstance(t, torch.Tensor)]
    content = sum(t.nbytes for t in tensors)
    assert (tmp_path / "map.pt").stat().st_size < 1.05 * content + 8192
