"""Multi-class Hilbert maps: without occupancy, calibrated, and the classes of a simulated room."""

import copy

import numpy as np
import pytest
import torch
from sklearn.datasets import load_iris, make_blobs
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import StratifiedKFold
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from small_maps import same_map

from lardhm_torch import LardHilbertMap, sample_rays, simulate_room, split_rays
from lardhm_torch.simulation import CLASS_NAMES, true_classes


def blobs():
    """Six overlapping classes in 2-D."""
    points, classes, *_ = make_blobs(900, centers=6, cluster_std=1.5, random_state=0)
    return points, classes


def accuracy(probability, model, classes):
    found = torch.tensor(model.classes)[probability.argmax(dim=1)]
    return float((found == torch.as_tensor(classes)).double().mean())


@pytest.mark.parametrize(
    ("make", "num_clusters"),
    [(blobs, 6), (lambda: load_iris(return_X_y=True), None)],
    ids=["2-D", "4-D"],
)
def test_classes_without_occupancy_are_told_apart_as_by_logistic_regression_on_rbf(
    make, num_clusters
):
    points, classes = make()
    ours, theirs = [], []
    for train, test in StratifiedKFold(5, shuffle=True, random_state=0).split(points, classes):
        model = LardHilbertMap(points.shape[1])
        model.fit_classes(points[train], classes[train], num_clusters)
        probability = model.class_probability(points[test])
        ours.append(accuracy(probability, model, classes[test]))
        rbf = Nystroem(gamma=1 / points.shape[1], n_components=100, random_state=0)
        theirs.append(
            make_pipeline(StandardScaler(), rbf, LogisticRegression(max_iter=2000))
            .fit(points[train], classes[train])
            .score(points[test], classes[test])
        )
        assert (model(points[test]) == 0.5).all()  # nothing is known of occupancy
    assert np.mean(ours) >= np.mean(theirs) - 1e-9


def test_training_lowers_the_loss_and_keeps_the_parameter_and_the_occupancy():
    scans = simulate_room(6000, seed=2)
    samples = sample_rays(scans)
    model = LardHilbertMap(3).fit(samples.points, samples.labels, channels=samples.channels)
    hits = scans.select(scans.is_return)
    before = model(hits.ends)
    targets = torch.tensor([model.classes.index(n) for n in hits.channels["class"].tolist()])
    losses = []
    for _ in range(2):
        losses.append(torch.nn.functional.cross_entropy(model.class_log_odds(hits.ends), targets))
        model.fit_classes(hits.ends, hits.channels["class"])
        weights = model.class_weights
    assert losses[1] < losses[0]
    assert torch.equal(model(hits.ends), before)
    optimizer = torch.optim.Adam([model.class_weights], lr=0.05)
    loss = torch.nn.functional.cross_entropy(model.class_log_odds(hits.ends), targets)
    loss.backward()
    optimizer.step()
    assert model.class_weights is weights
    after = torch.nn.functional.cross_entropy(model.class_log_odds(hits.ends), targets)
    assert after < loss


def test_wrong_labels_make_the_map_answer_for_the_true_class():
    rng = torch.Generator().manual_seed(0)
    points = torch.rand(2000, 2, generator=rng, dtype=torch.float64) * 4
    true = (points[:, 0] > 2).long()
    is_wrong = torch.rand(2000, generator=rng) < 0.2
    labels = torch.where(is_wrong, 1 - true, true)
    inner = (points[:, 0] - 2).abs() > 0.3
    plain = LardHilbertMap(2).fit_classes(points, labels)
    aware = LardHilbertMap(2).fit_classes(points, labels, wrong_labels=0.2)
    own = true[inner, None]
    confidence = [m.class_probability(points[inner]).gather(1, own).mean() for m in (plain, aware)]
    assert confidence[0] < 0.85 < confidence[1]
    aware.calibrate_classes(points, labels, wrong_labels=0.2)
    assert aware.class_scale > 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"classes": torch.full((6,), -1)}, "all 6 are missing"),
        ({"classes": torch.zeros(5, dtype=torch.long)}, "must have 6 rows"),
        ({"wrong_labels": 0.7}, "below 1/2; got 0.7"),
        ({"num_clusters": 0}, "num_clusters must be"),
        ({"points": torch.full((6, 2), float("nan"))}, "points must be finite"),
    ],
)
def test_wrong_arguments_change_nothing(change, message):
    model = LardHilbertMap(2).fit_classes(torch.rand(60, 2), torch.arange(60) % 3)
    before = copy.deepcopy(model)
    given = {"points": torch.rand(6, 2), "classes": torch.zeros(6, dtype=torch.long), **change}
    with pytest.raises(ValueError, match=message):
        model.fit_classes(given.pop("points"), given.pop("classes"), **given)
    assert same_map(model, before)


def test_only_a_map_with_classes_is_calibrated():
    with pytest.raises(ValueError, match="the map must have classes"):
        LardHilbertMap(2).calibrate_classes(torch.rand(3, 2), torch.zeros(3, dtype=torch.long))


def expected_calibration_error(probability, classes, bins=15):
    confidence, found = probability.max(dim=1)
    place = (confidence * bins).long().clamp(max=bins - 1)
    gap = confidence - (found == classes).to(confidence)
    return float(torch.zeros(bins).index_add_(0, place, gap).abs().sum()) / len(classes)


def test_the_classes_of_a_room_survive_wrong_labels_at_once_and_scan_by_scan():
    """A reduced version of benchmarks/channels.py."""
    scans = simulate_room(20_000, seed=0, wrong_labels=0.05)
    train, test = split_rays(scans, 0.8, seed=0)
    train, held = split_rays(train, 0.9, seed=1)
    test, held = test.select(test.is_return), held.select(held.is_return)
    true = true_classes(test.ends, test.ray_origins)
    is_wrong = test.channels["class"] != true
    assert 0.03 < is_wrong.double().mean() < 0.07
    samples = sample_rays(train)
    batch = LardHilbertMap(3).fit(samples.points, samples.labels, channels=samples.channels)
    stream = LardHilbertMap(3)
    for number in range(3):
        samples = sample_rays(train.select(train.scan_id == number), seed=number)
        stream.update(samples.points, samples.labels, seed=number, channels=samples.channels)
    found = {}
    for name, model in (("batch", batch), ("stream", stream)):
        assert sorted(model.classes) == list(range(len(CLASS_NAMES)))
        model.calibrate_classes(held.ends, held.channels["class"], wrong_labels=0.05)
        order = torch.tensor(model.classes).argsort()
        probability = model.class_probability(test.ends)[:, order]
        found[name] = float((probability.argmax(dim=1) == true).double().mean())
        assert found[name] > 0.95  # .97 with the 50,000 rays of the benchmark
        assert expected_calibration_error(probability, true) < 0.03
    assert found["stream"] > found["batch"] - 0.01


def test_packed_maps_do_not_learn_classes(tmp_path):
    points, classes = blobs()
    LardHilbertMap(2).fit_classes(points, classes).pack(tmp_path / "map.lhm")
    model = LardHilbertMap.load(tmp_path / "map.lhm")
    for change in (model.fit_classes, model.calibrate_classes):
        with pytest.raises(ValueError, match="a packed map supports queries, but no training"):
            change(points, classes)
