"""Training of the classes of a map: multi-class Hilbert maps, and calibration."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TypeVar

import torch

from lardhm_torch.channels import CLASS
from lardhm_torch.learning import class_training, map_merging, parameters
from lardhm_torch.learning.changes import changes_map
from lardhm_torch.learning.clustering import check_num_clusters
from lardhm_torch.learning.fitting import FitConfig
from lardhm_torch.map_queries import MapQueries
from lardhm_torch.maps import TensorLike
from lardhm_torch.scans import seeded_generator

AnyMap = TypeVar("AnyMap", bound="MapClasses")


class MapClasses(MapQueries):
    """The training of the classes of `LardHilbertMap`; see there."""

    @changes_map
    @torch.no_grad()
    def fit_classes(
        self: AnyMap,
        points: TensorLike,
        classes: TensorLike,
        num_clusters: int | None = None,
        *,
        seed: int = 0,
        wrong_labels: float = 0.0,
        config: FitConfig | None = None,
    ) -> AnyMap:
        """Train ``class_weights`` on labeled points with the multinomial log-loss.

        An empty map becomes a multi-class Hilbert map without occupancy: the points of each class are
        clustered separately, in any dimension and unit, and the probability of occupancy stays 1/2. A
        fitted map without classes first gets the class counts of the points. Occupancy and clusters
        of a fitted map do not change. If anything fails, the map is unchanged.

        Args:
            points: (N, D) world positions.
            classes: (N,) class numbers, -1 where missing, or (N, K) probabilities, NaN where missing.
            num_clusters: number of clusters of an empty map; None: one per 30 points of a class.
            seed: random seed of clustering and training.
            wrong_labels: fraction of the labels that are those of a random other class. The map then
                predicts the true class instead of the label.
            config: training settings.

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, NaN or infinite points, no point has a class, a class number,
                probability or wrong_labels is out of range, or the map is packed.
        """
        self.check_learns()
        check_num_clusters(num_clusters)
        class_training.check_wrong_labels(wrong_labels)
        rng = seeded_generator(seed, "fit_classes", self.centers.device)
        labelled = class_training.check_class_points(points, classes, self.centers)
        if len(self) == 0:
            found = class_training.clustered(labelled, num_clusters, self.kernel, self.centers, rng)
        else:
            state, origin = parameters.read_state(self), self.origin
            found = class_training.with_classes(state, origin, self.channel_layout, labelled)
        state, origin, layout = found
        draft = copy.deepcopy(self)
        parameters.write_state(draft, class_training.untrained(state), origin, layout)
        local = draft._to_map_frame(labelled.points)
        base = draft.class_log_odds(labelled.points)
        targets = class_training.class_targets(labelled.classes, layout[CLASS], base.dtype)
        samples = class_training.ClassSamples(*draft._nearest_features(local), base, targets)
        weights = class_training.initial_weights(state, len(layout[CLASS]))
        weights = class_training.train_class_weights(
            samples, weights, config or FitConfig(), rng, wrong_labels
        )
        state = replace(state, class_weights=weights)
        if len(self) == 0:
            parameters.write_state(self, state, origin, layout)
        else:
            map_merging.replace_clusters(self, state, origin, slice(None), layout)
        return self

    @changes_map
    @torch.no_grad()
    def calibrate_classes(
        self: AnyMap, points: TensorLike, classes: TensorLike, *, wrong_labels: float = 0.0
    ) -> AnyMap:
        """Fit ``class_scale``, the factor on the class log-odds, to labels by maximum likelihood.

        The class counts of a cluster give the distribution of its labels, which is underconfident about
        the true class if a few labels are wrong. The factor does not change which class is most likely.
        Use points on which the map was not trained, such as those of the next scan before it is added.

        Args:
            points: (N, D) world positions on surfaces [m].
            classes: (N,) class numbers, -1 where missing, or (N, K) probabilities, NaN where missing.
            wrong_labels: fraction of the labels that are those of a random other class.

        Returns:
            This map.

        Raises:
            ValueError: the map has no classes or is packed, or see `fit_classes`.
        """
        self.check_learns()
        class_training.check_wrong_labels(wrong_labels)
        labelled = class_training.check_class_points(points, classes, self.centers)
        labelled = class_training.of_known_classes(labelled, self.classes)
        targets = class_training.class_targets(labelled.classes, self.classes, self.weights.dtype)
        log_odds = self.class_log_odds(labelled.points) / self.class_scale
        self.class_scale = class_training.best_scale(log_odds, targets, wrong_labels)
        return self
