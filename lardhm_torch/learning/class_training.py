"""Multi-class Hilbert maps: clusters of labeled points of any kind, and weights of the classes.

The log-odds of class k are those of the class counts around a point plus sum_m phi_m(x) V_mk. The class
weights V (M, K) minimize the multinomial log-loss, as the weights of the occupancy minimize the binary
one; the paper mentions this extension in its footnote 1. They are 0 before training, when the class
counts alone determine the result.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from lardhm_torch.channels import CLASS, check_channels, missing
from lardhm_torch.features import Kernel
from lardhm_torch.learning.channel_sums import (
    Hits,
    Layout,
    column_of_class,
    joint_layout,
    layout_of,
    with_hits,
    with_layout,
)
from lardhm_torch.learning.clustering import (
    MAX_CHOSEN,
    cluster_points,
    concatenate_clusters,
    points_where,
)
from lardhm_torch.learning.evidence import keep_points
from lardhm_torch.learning.fitting import FitConfig, descend, stratified_batches
from lardhm_torch.learning.map_state import MapState, new_rows
from lardhm_torch.learning.points import as_tensor, check_samples, in_morton_order, to_map_frame
from lardhm_torch.maps import TensorLike
from lardhm_torch.native import nearest_centers

CLASS_POINTS = 30  # per cluster of a class: classes overlap more than surfaces and free space


class ClassSamples(NamedTuple):
    """What the class weights are trained on.

    Args:
        indices: (N, k) clusters nearest to each point.
        values: (N, k) features.
        base: (N, K) log-odds of the classes without class weights.
        targets: (N, K) probabilities of the classes of each point; one-hot for class numbers.
    """

    indices: Tensor
    values: Tensor
    base: Tensor
    targets: Tensor


class ClassPoints(NamedTuple):
    """(N, D) world positions in Morton order; (N,) class numbers or (N, L) probabilities."""

    points: Tensor
    classes: Tensor


def check_class_points(points: TensorLike, classes: TensorLike, like: Tensor) -> ClassPoints:
    """The points that have a class.

    Args:
        points: (N, D) world positions.
        classes: (N,) class numbers, -1 where missing, or (N, L) probabilities, NaN where missing.
        like: (M, D) tensor of the map.

    Raises:
        ValueError: wrong shapes, points that are not finite, or no point with a valid class.
    """
    points = as_tensor(points, "points", like.device)
    given = torch.as_tensor(classes, device=like.device)
    values = check_channels({CLASS: given}, len(points))[CLASS]
    rows = (~missing(values)).nonzero().squeeze(1)
    if len(points) and len(rows) == 0:
        raise ValueError(
            f"classes must have a value for at least one point; all {len(points)} are missing"
        )
    points, _ = check_samples(points, torch.ones(len(points)), like.shape[1], like.device)
    return ClassPoints(*in_morton_order(points[rows], values[rows]))


def clustered(
    labelled: ClassPoints,
    num_clusters: int | None,
    kernel: Kernel,
    like: Tensor,
    rng: torch.Generator,
) -> tuple[MapState, Tensor, Layout]:
    """Clusters of the points of each class, as those of occupied and free points; origin and layout.

    Args:
        labelled: N points; one with probabilities belongs to its most likely class.
        num_clusters: total, divided in proportion to the points; None: one per 30 points of a class.
        kernel: minimum length scale.
        like: (M, D) tensor of the map.
        rng: random generator.

    Returns:
        Occupied clusters with weights of 0: such a map knows classes and no free space.
    """
    origin = labelled.points.mean(dim=0, dtype=torch.float64).round()
    points, classes = to_map_frame(labelled.points, origin, like.dtype), labelled.classes
    owners = classes.argmax(dim=1) if classes.is_floating_point() else classes
    parts = []
    for number in owners.unique().tolist():
        (members,) = in_morton_order(points_where(points, owners == number))
        wanted = len(members) // CLASS_POINTS
        if num_clusters is not None:
            wanted = round(num_clusters * len(members) / len(points))
        parts.append(cluster_points(members, max(1, min(wanted, MAX_CHOSEN)), rng))
    clusters = concatenate_clusters(parts)
    is_occupied = torch.ones_like(clusters.counts, dtype=torch.bool)
    nearest = nearest_centers(points, clusters.means, 1).squeeze(1)
    evidence = keep_points(points, nearest, len(clusters))
    rows = new_rows(clusters, is_occupied, kernel.min_lengthscale, evidence)
    return with_classes(rows, origin, {}, labelled)


def with_classes(
    state: MapState, origin: Tensor, layout: Layout, labelled: ClassPoints
) -> tuple[MapState, Tensor, Layout]:
    """Clusters of a map that have class counts, if they had none before; origin and layout."""
    channels = {CLASS: labelled.classes}
    joint = joint_layout(layout, layout_of(channels))
    state = with_layout(state, layout, joint)
    if CLASS not in layout:
        local = to_map_frame(labelled.points, origin, state.means.dtype)
        state = with_hits(state, joint, Hits(local, channels))
    return state, origin, joint


def check_wrong_labels(wrong_labels: float) -> None:
    """Raise a ValueError if a fraction of wrong labels is not from 0 to 1/2."""
    if not 0 <= wrong_labels < 0.5:
        raise ValueError(f"wrong_labels must be at least 0 and below 1/2; got {wrong_labels}")


def of_known_classes(labelled: ClassPoints, columns: list[int]) -> ClassPoints:
    """The points of classes that a map has.

    Raises:
        ValueError: the map has no classes, or there is no such point.
    """
    if not columns:
        raise ValueError("the map must have classes; it has none. Give channels to fit or update")
    classes = labelled.classes
    if classes.is_floating_point():
        if classes.shape[1] > max(columns) + 1 or set(range(classes.shape[1])) - set(columns):
            raise ValueError(
                f"class probabilities must be those of the map's classes {columns}; "
                f"got {classes.shape[1]} columns"
            )
        return labelled
    rows = torch.isin(classes, torch.tensor(columns, device=classes.device)).nonzero().squeeze(1)
    if len(rows) == 0:
        raise ValueError(f"classes must be some of the map's classes {columns}; no point has one")
    return ClassPoints(labelled.points[rows], classes[rows])


def untrained(state: MapState) -> MapState:
    """The clusters without class weights."""
    return replace(state, class_weights=state.class_weights[:, :0])


def initial_weights(state: MapState, num_classes: int) -> Tensor:
    """(M, K) class weights to begin with: those of the state, or 0."""
    found = state.class_weights
    return found if found.shape[1] else found.new_zeros(len(state), num_classes)


def class_targets(classes: Tensor, columns: list[int], dtype: torch.dtype) -> Tensor:
    """(N, K) probabilities of the classes of a map, one-hot for class numbers.

    Args:
        classes: (N,) class numbers, or (N, L) probabilities of the classes 0 to L - 1.
        columns: numbers of the K classes of the map.
        dtype: of the result.
    """
    place = column_of_class(columns, classes.device)
    if not classes.is_floating_point():
        return torch.nn.functional.one_hot(place[classes], len(columns)).to(dtype)
    result = torch.zeros(len(classes), len(columns), dtype=dtype, device=classes.device)
    return result.index_copy_(1, place[: classes.shape[1]], classes.to(dtype))


def best_scale(log_odds: Tensor, targets: Tensor, wrong_labels: float) -> float:
    """Factor on class log-odds for which the labels of N points are most likely.

    Args:
        log_odds: (N, K) log-odds.
        targets: (N, K) probabilities of the labels, one-hot for class numbers.
        wrong_labels: fraction of the labels that are those of a random other class.
    """
    scales = torch.logspace(-1, 1, 41, base=10.0, dtype=torch.float64).tolist()
    others = wrong_labels / max(1, targets.shape[1] - 1)
    losses = []
    for scale in scales:
        probability = others + (1 - wrong_labels - others) * torch.softmax(scale * log_odds, dim=1)
        tiny = torch.finfo(probability.dtype).tiny
        losses.append(-float((targets * probability.clamp(min=tiny).log()).sum()))
    return scales[losses.index(min(losses))]


def train_class_weights(
    samples: ClassSamples,
    weights: Tensor,
    config: FitConfig,
    rng: torch.Generator,
    wrong_labels: float = 0.0,
) -> Tensor:
    """Minimize the multinomial log-loss by the descent of eq. (4), with its regularizer.

    Weights of clusters that are no neighbor of a point stay as they are.

    Args:
        samples: N points, in the order of `morton_order`.
        weights: (M, K) initial class weights; not modified.
        config: passes, rates and regularizer.
        rng: random generator of the batches.
        wrong_labels: fraction of the labels that are those of a random other class.

    Returns:
        (M, K) class weights.

    Source: Guizilini & Ramos 2016, eq. (2) to (4), with the softmax in place of the sigmoid.
    """
    count = len(samples.targets)
    batch_size = config.rows_per_batch(count)
    columns = ClassSamples(*stratified_batches(tuple(samples), batch_size, rng))
    passes = config.passes_over(count)
    total = passes * -(-count // batch_size)
    state, step = (weights.clone(), torch.zeros_like(weights), torch.zeros_like(weights)), 0
    for _ in range(passes):
        for batch in zip(*(column.split(batch_size) for column in columns), strict=True):
            slope = _slope(ClassSamples(*batch), state[0], wrong_labels)
            rate = config.learning_rate * (1 - step / total if config.decay else 1.0)
            step += 1
            state = descend(state, slope, step, rate, count, config)
    touched = torch.zeros(len(weights), dtype=torch.bool, device=weights.device)
    touched[samples.indices.reshape(-1).long()] = True
    return torch.where(touched[:, None], state[0], weights)


def _slope(batch: ClassSamples, weights: Tensor, wrong_labels: float) -> Tensor:
    """(M, K) gradient of the mean loss of a batch: Phi^T (p - q) / B.

    q is the posterior of the true class given the label: the target itself if no label is wrong.
    """
    mixed = torch.nn.functional.embedding_bag(
        batch.indices, weights, per_sample_weights=batch.values, mode="sum"
    )
    probability = torch.softmax(batch.base + mixed, dim=1)
    wanted = batch.targets
    if wrong_labels:
        classes = weights.shape[1]
        others = wrong_labels / max(1, classes - 1)
        right = 1 - wrong_labels - others  # P(label | class) = others + right [label = class]
        ratio = wanted / (others + right * probability)
        wanted = probability * (others * ratio.sum(dim=1, keepdim=True) + right * ratio)
    terms = batch.values[:, :, None] * (probability - wanted)[:, None] / len(wanted)
    rows = batch.indices.reshape(-1)
    return torch.zeros_like(weights).index_add_(0, rows, terms.flatten(0, 1))
