"""Queries of a map: probability, log-odds, features, uncertainty, channels and classes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import native
from lardhm_torch.channels import CLASS
from lardhm_torch.features import feature_matrix, lard_kernel, neighbor_fade
from lardhm_torch.learning import channel_queries, parameters, posterior
from lardhm_torch.learning.channel_queries import ChannelSums
from lardhm_torch.learning.map_tensors import at_least_float32
from lardhm_torch.learning.points import check_axes, to_map_frame
from lardhm_torch.maps import TensorLike, reads_map
from lardhm_torch.native.surfaces import NativeMap


class MapQueries(parameters.MapParameters):
    """The queries of `LardHilbertMap`; see there."""

    @reads_map
    def forward(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy, eq. (1)."""
        return self._query(points, probability=True)

    @reads_map
    def log_odds(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy (logit), w^T Phi(x)."""
        return self._query(points, probability=False)

    @reads_map
    def features(self, points: TensorLike) -> Tensor:
        """(N, D) world positions [m] -> sparse COO (N, M) with K values per row, eq. (9)."""
        local = self._to_map_frame(points)
        if local.ndim != 2:
            raise ValueError(f"points must be (N, {self.dim}); got {tuple(local.shape)}")
        centers = at_least_float32(self.centers)
        indices = native.nearest_centers(local, centers, self.num_neighbors, self._fresh_index())
        values = lard_kernel(local, centers, self.scale_tril, indices)
        values = values * neighbor_fade(local, centers, indices)
        return feature_matrix(indices, self._as_answer(values), len(self))

    @reads_map
    def variance(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) variance of the log-odds.

        Far from all clusters it equals the variance of the prior.

        Raises:
            RuntimeError: `fit_uncertainty` was not called after the last change of the clusters.
        """
        return self._as_answer(self._posterior(points)[1])

    @reads_map
    def bayesian_probability(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) probability, averaged over the posterior of the weights.

        Raises:
            RuntimeError: `fit_uncertainty` was not called after the last change of the clusters.
        """
        mean, variance = self._posterior(points)
        return self._as_answer(posterior.moderate(mean, posterior.VARIANCE_FACTOR * variance))

    @property
    def channels(self) -> dict[str, ChannelSums]:
        """Sums of the channels over the hits of each cluster, by name; views of ``channel_sums``."""
        return channel_queries.channel_sums_of(self)

    @reads_map
    def channel(self, points: TensorLike, name: str) -> Tensor:
        """(..., D) world positions [m] -> (...) or (..., C) mean of a channel around them.

        This is a weighted mean over the nearest occupied clusters, each with the linear trend of its
        values. The weight is the number of hits times the fourth power of the feature, which is a
        Gaussian with the covariance of the points of the cluster. The result is NaN if no occupied
        cluster with a value is near. For ``"class"`` it is `class_probability`.

        Raises:
            ValueError: the map has no such channel.
        """
        return channel_queries.interpolate(self, points, name)

    @reads_map
    def class_log_odds(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (..., K) logarithms of the class odds, up to a constant.

        K is the number of classes, in the order of ``classes``. The value is the logarithm of the
        class posterior from the counts around a point, times ``class_scale``, plus the trained class
        weights times the features (`fit_classes`). It is differentiable with respect to the points,
        ``class_weights``, ``centers`` and ``raw_scale_tril``.

        Raises:
            ValueError: the map has no classes.
        """
        return channel_queries.class_log_odds(self, points)

    @reads_map
    def class_probability(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (..., K) probability of each class, given a surface there.

        It is 1/K far from all occupied clusters.

        Raises:
            ValueError: the map has no classes.
        """
        return channel_queries.class_probability(self, points)

    @reads_map
    def class_posterior(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (..., K + 1) distribution: free, or occupied by each class.

        Raises:
            ValueError: the map has no classes.
        """
        occupied = self._query(points, probability=True)
        return channel_queries.joint_posterior(occupied, self.class_probability(points))

    @property
    def classes(self) -> list[int]:
        """Class numbers, in the order of the columns of `class_log_odds`; empty without classes."""
        return list(self.channel_layout.get(CLASS, ()))

    @torch.no_grad()
    @reads_map
    def unknown(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) degree to which space is unobserved, 0 to 1.

        The value is 1 minus the largest feature among clusters of occupied or free points. Where the
        probability is near 1/2, values near 0 indicate contradictory data, values near 1 no data.
        """
        local = self._to_map_frame(points)
        flat = local.reshape(-1, self.dim)
        if len(self) == 0:
            return torch.ones_like(flat[:, 0]).reshape(local.shape[:-1])
        parts = [flat.new_ones(0)]
        for chunk in flat.split(posterior.QUERY_CHUNK):
            indices, values = self._nearest_features(chunk)
            seen = torch.where(self.counts[indices] > 0, values, 0 * values)  # NaN stays NaN
            parts.append(1 - seen.amax(dim=1))
        return self._as_answer(torch.cat(parts)).reshape(local.shape[:-1])

    @torch.no_grad()
    @reads_map
    def query_lattice(self, axes: Sequence[Tensor], probability: bool = True) -> Tensor:
        """Probability or log-odds at all points of a lattice, faster than for a list of the points.

        Args:
            axes: D lists of world coordinates [m]; the lattice is their Cartesian product.
            probability: True: return the probability; False: return the log-odds.

        Returns:
            (len(axes[0]), len(axes[1]), ...) values without gradient.
        """
        check_axes(axes, self.dim)
        tensors, index = self._tensors(), self._fresh_index()
        pairs, dtype = zip(axes, self.origin, strict=True), tensors[0].dtype
        local = [to_map_frame(axis, shift, dtype) for axis, shift in pairs]
        answer = native.lattice_occupancy(local, *tensors, probability=probability, index=index)
        return self._as_answer(answer)

    def native_map(self) -> NativeMap | None:
        """The tensors of the map for the native library; None if it does not support this map."""
        if len(self) == 0 or not native.supports(self.centers):
            return None
        tensors = (self.centers.detach(), self.raw_scale_tril.detach(), self.weights.detach())
        return NativeMap(*tensors, self.kernel, self._fresh_index(), self.origin)

    @torch.no_grad()
    @reads_map
    def query_rays(self, origins: Tensor, directions: Tensor, march: tuple[Any, ...]) -> Any:
        """`raycasting.raycast` in the native library; None if it does not support this map.

        Args:
            origins: (R, D) world positions, float64 [m].
            directions: (R, D) unit vectors, float64.
            march: parameters of `native.raycast`.
        """
        found = self.native_map()
        if found is None:
            return None
        rays = (origins - self.origin, directions)
        return native.raycast(rays, march, found[:3], found.kernel, found.center_index)

    def _query(self, points: TensorLike, probability: bool) -> Tensor:
        local = self._to_map_frame(points)
        flat, index = local.reshape(-1, self.dim), self._fresh_index()
        answer = native.occupancy(flat, *self._tensors(), probability=probability, index=index)
        return self._as_answer(answer).reshape(local.shape[:-1])

    def _as_answer(self, values: Tensor) -> Tensor:
        return values.to(self.centers.dtype)

    def _posterior(self, points: TensorLike) -> tuple[Tensor, Tensor]:
        """Mean and variance of the log-odds at (..., D) points."""
        if not bool((self.posterior_variances > 0).all()) or len(self) == 0:
            raise RuntimeError(
                "variance needs the posterior of every weight; "
                "call fit_uncertainty(points, labels) first, and again after update"
            )
        local = self._to_map_frame(points)
        own = (self.posterior_means, self.posterior_variances, self.posterior_scales)
        flat = local.reshape(-1, self.dim)
        answer = posterior.predict(self._nearest_features, flat, posterior.Posterior(*own))
        mean, variance = (values.reshape(local.shape[:-1]) for values in answer)
        return mean, variance

    def _nearest_features(self, local: Tensor) -> tuple[Tensor, Tensor]:
        centers, raw, *_ = self._tensors()
        index = self._fresh_index()
        return native.nearest_features(local, centers.detach(), raw.detach(), self.kernel, index)
