"""LARD Hilbert map as a torch module: queries, training and map files."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from lardhm_torch import native, packing
from lardhm_torch.features import Kernel, feature_matrix, lard_kernel, neighbor_fade
from lardhm_torch.io import map_files
from lardhm_torch.learning import map_merging, parameters, posterior
from lardhm_torch.learning.changes import changes_map, normal_tensors
from lardhm_torch.learning.clustering import check_num_clusters
from lardhm_torch.learning.fitting import FitConfig, FitTask, fit_clusters
from lardhm_torch.learning.parameters import at_least_float32
from lardhm_torch.learning.update import Task, UpdateConfig, updated
from lardhm_torch.maps import TensorLike
from lardhm_torch.native.surfaces import NativeMap
from lardhm_torch.points import as_tensor, check_axes, check_points, to_map_frame, training_points
from lardhm_torch.sampling import seeded_generator


class LardHilbertMap(parameters.MapParameters):
    """Continuous occupancy map whose log-odds are a weighted sum of local kernel features.

    The probability is exactly 1/2 in an empty map and far from all clusters. Points are
    given in the world frame; ``origin`` is subtracted in float64 before they are cast to the map's
    dtype, so coordinates may be far from zero. Maps of half precision answer in their dtype and compute
    in float32; they cannot be trained. A point with a NaN or infinite coordinate has
    probability NaN. Tensors, NumPy arrays and lists are accepted as points.

    Args:
        dim: number of coordinates D.
        num_neighbors: k, the number of nearest clusters used per query point.
        covariance_scale: factor on the covariances of the clusters.
        min_lengthscale: smallest standard deviation of a kernel along any axis [m], before
            ``covariance_scale``.
        device: device of the tensors; None: torch's default.
        dtype: floating point type of the tensors; None: torch's default.

    Attributes:
        weights: (M,) parameter, weights of the features.
        centers: (M, D) parameter [m], map frame.
        raw_scale_tril: (M, D, D) parameter, lower Cholesky factors with log-transformed diagonals, so
            that any value is valid. `scale_tril` holds the factors of the kernels [m].
        is_occupied, counts, means, scatters: (M, ...) buffers, class and moments of the clusters;
            clusters of unknown points have count 0.
        evidence: (M, 32, D) buffer [m], points kept by the clusters, padded with infinity.
        losses, doubts, fresh: (M,) buffers, used by `update` (see docs).
        posterior_means, posterior_variances: (M,) buffers, written by `fit_uncertainty`; a variance
            of 0 means that the posterior has not been computed.
        posterior_scales: (2,) buffer, factors on negative and positive posterior log-odds.
        origin: (D,) float64 buffer [m], world = map + origin; stays float64 under any cast.

    Source: Guizilini & Ramos 2016, eq. (1), (8), (9).
    """

    # --- queries ---

    def forward(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy, eq. (1)."""
        return self._query(points, probability=True)

    def log_odds(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy, w^T Phi(x)."""
        return self._query(points, probability=False)

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

    def variance(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) variance of the log-odds.

        Far from all clusters it equals the variance of the prior.

        Raises:
            RuntimeError: `fit_uncertainty` was not called since the clusters changed.
        """
        return self._as_answer(self._posterior(points)[1])

    def bayesian_probability(self, points: TensorLike) -> Tensor:
        """(..., D) world positions [m] -> (...) probability, averaged over the posterior of the weights.

        Raises:
            RuntimeError: `fit_uncertainty` was not called since the clusters changed.
        """
        mean, variance = self._posterior(points)
        return self._as_answer(posterior.moderate(mean, posterior.VARIANCE_FACTOR * variance))

    @torch.no_grad()
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
    def query_lattice(self, axes: Sequence[Tensor], probability: bool = True) -> Tensor:
        """Probability or log-odds at all points of a lattice, faster than one by one.

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

    def _tensors(self) -> tuple[Tensor, Tensor, Tensor, Kernel]:
        centers, raw = at_least_float32(self.centers), at_least_float32(self.raw_scale_tril)
        return centers, raw, at_least_float32(self.weights), self.kernel

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

    def _fresh_index(self) -> Tensor:
        """Index of the neighbor search. It is rebuilt if the centers have changed."""
        # The operators check the index themselves; the transforms of torch.func do not use it.
        if torch.compiler.is_compiling() or native.transformed():
            return self._index
        centers = at_least_float32(self.centers)
        known = native.index_matches(self._index, centers, self.num_neighbors)
        if not known or self._index.is_inference():
            with normal_tensors():
                self._index = native.build_index(centers, self.num_neighbors)
        return self._index

    def _to_map_frame(self, points: TensorLike) -> Tensor:
        points = as_tensor(points, "points", self.origin.device)
        check_points(points, self.dim)
        dtype = torch.promote_types(self.centers.dtype, torch.float32)
        return to_map_frame(points, self.origin, dtype)

    # --- learning ---

    @changes_map
    def fit(
        self,
        points: TensorLike,
        labels: TensorLike,
        num_clusters: int | None = None,
        *,
        seed: int = 0,
        progress: bool = False,
        config: FitConfig | None = None,
    ) -> LardHilbertMap:
        """Fit the map to labelled points. Existing clusters are discarded.

        Each class is clustered separately. The moments of the clusters determine centers and
        length-scales, and then the weights are trained. If anything fails, the map is unchanged.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free, 1/2 unknown; a single class is allowed.
            num_clusters: total over both classes, half each; a class too small for its half
                leaves the remainder to the other. None: chosen from the data
                (`clustering.choose_num_clusters`).
            seed: random seed of clustering and training.
            progress: show a progress bar on a terminal.
            config: training settings of the weights.

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, NaN or infinite points, labels not 0 or 1, no points, or
                num_clusters is not a positive integer.

        Source: Guizilini & Ramos 2016, Sections II and III.
        """
        self.check_learns()
        samples = training_points(points, labels, self.centers)
        check_num_clusters(num_clusters)
        rng = seeded_generator(seed, "fit", self.centers.device)
        task = FitTask(self.kernel, config or FitConfig(), rng, progress)
        state = fit_clusters(samples.points, samples.labels, num_clusters, task)
        parameters.write_state(self, state, samples.origin)
        return self

    @changes_map
    @torch.no_grad()
    def fit_uncertainty(self, points: TensorLike, labels: TensorLike) -> LardHilbertMap:
        """Estimate the variance of the weights, for `variance` and `bayesian_probability`.

        Probability and log-odds do not change. Call this method after the last `fit`, `fine_tune` or
        `update`, with the points the map was trained on, because the posterior is valid only for
        the current weights.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free.

        Returns:
            This map.

        Raises:
            ValueError: the map is empty, or the samples are invalid (see `fit`).
        """
        self.check_learns()
        if len(self) == 0:
            raise ValueError("the map must be fitted before its uncertainty; it is empty: call fit")
        local, labels, _ = training_points(points, labels, self.centers, self.origin)
        found = posterior.fit_posterior(*self._nearest_features(local), self.weights, labels)
        self.posterior_means, self.posterior_variances, self.posterior_scales = found
        return self

    @changes_map
    def update(
        self,
        points: TensorLike,
        labels: TensorLike,
        num_clusters: int | None = None,
        *,
        seed: int = 0,
        config: UpdateConfig | None = None,
    ) -> LardHilbertMap:
        """Update the map with one more scan, without forgetting. On an empty map this is `fit`.

        Each cluster keeps a bounded random sample of its points. New points are added to it, clusters
        near them are regrouped, and the weights there are trained on the kept points. Parameters
        remain the same objects (see `parameters.resize_optimizer` for stateful optimizers). Clusters
        without points are removed, and the last rows take their places. If anything fails, the map
        is unchanged.

        Args:
            points: (N, D) world positions [m]; an empty set leaves the map unchanged.
            labels: (N,) 1 occupied, 0 free, 1/2 unknown.
            num_clusters: maximum number of clusters near the points, over all classes. None: chosen
                from the number of hits there.
            seed: random seed of clustering and training.
            config: update settings; `UpdateConfig(as_in_paper=True)` follows the paper.

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, NaN or infinite points, labels not 0 or 1, or num_clusters is
                not a positive integer.

        Source: Guizilini & Ramos 2016, Section III and Algorithm 2.
        """
        self.check_learns()
        if len(points) == 0 and len(labels) == 0:
            return self
        if len(self) == 0:
            return self.fit(points, labels, num_clusters, seed=seed)
        samples = training_points(points, labels, self.centers, self.origin, keep_unknown=True)
        check_num_clusters(num_clusters)
        rng = seeded_generator(seed, "update", self.centers.device)
        task = Task(self.kernel, config or UpdateConfig(), rng)
        changes = updated(parameters.read_state(self), *samples[:2], num_clusters, task)
        parameters.write_rows(self, *changes)
        return self

    @changes_map
    def transform(self, rotation: Tensor, translation: Tensor) -> LardHilbertMap:
        """Apply the rigid transform x -> rotation x + translation to the map.

        The transform is exact and needs no training, so that a submap can be moved to its new pose
        after a loop closure. The posterior of the weights is kept.

        Args:
            rotation: (D, D) orthonormal, determinant 1.
            translation: (D,) [m].

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, or rotation is not a rotation.
        """
        state = parameters.read_state(self)
        state, origin = map_merging.moved(state, self.origin, rotation, translation)
        map_merging.replace_clusters(self, state, origin, slice(None))
        return self

    @changes_map
    def crop(self, center: Tensor, radius: float) -> LardHilbertMap:
        """Remove all clusters farther than ``radius`` [m] from a world position (D,).

        Clusters of surfaces and of unknown space that limit the remaining free space stay, so that
        places beyond the radius do not become free. The posterior of the other weights is kept.

        Returns:
            This map.

        Raises:
            ValueError: center is not (D,) and finite, or radius is not > 0.
        """
        center = map_merging.check_sphere(center, radius, self.origin)
        state = parameters.read_state(self)
        rows = map_merging.within(state, center - self.origin, radius, self.kernel)
        map_merging.replace_clusters(self, state.rows(rows), self.origin, rows)
        return self

    # --- files ---

    def save(self, path: str | os.PathLike[str], *, evidence: bool = True) -> None:
        """Write the state dict of the map to a file, atomically.

        Args:
            path: file; the extension ``.safetensors`` selects that format.
            evidence: write the points kept by the clusters, too. Without them the file is about a
                quarter as large, and a later `update` draws points from the clusters' moments.
        """
        left_out = () if evidence else parameters.HISTORY
        state = {name: value for name, value in self.state_dict().items() if name not in left_out}
        map_files.save_state(state, path)

    def pack(self, path: str | os.PathLike[str], *, precision: int = packing.PRECISION) -> None:
        """Write a small file, about 12 bytes per cluster in 3-D, of a map that answers but cannot learn.

        Args:
            path: file, usually ``.lhm``.
            precision: fractional bits of the rounded parameters, 1 to 16 (docs/map_format.md).
        """
        packing.save_packed(self, path, precision)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> LardHilbertMap:
        """Read a map file written by `save`, `pack` or `torch.save(model.state_dict(), ...)`.

        Raises:
            FileNotFoundError: the file does not exist.
            ValueError: the file is not a map, is damaged or unsafe, or has a newer format.
        """
        state = packing.load_state(path)
        try:
            return cls.from_state(state)
        except (KeyError, AttributeError, TypeError, RuntimeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)} must hold a LardHilbertMap; {error}") from error
