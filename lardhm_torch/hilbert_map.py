"""LARD Hilbert map as a torch module: queries, training and map files."""

from __future__ import annotations

import copy
import os
from functools import partial

import torch
from torch import Tensor

from lardhm_torch.channels import Channels, check_channels
from lardhm_torch.io import map_files
from lardhm_torch.learning import aging, channel_sums, map_merging, packing, parameters, posterior
from lardhm_torch.learning.changes import changes_map
from lardhm_torch.learning.clearing import ray_lines
from lardhm_torch.learning.clustering import check_num_clusters
from lardhm_torch.learning.fitting import FitConfig, FitTask
from lardhm_torch.learning.passing import check_rays, lines_of
from lardhm_torch.learning.points import training_points
from lardhm_torch.learning.scene_clusters import fit_scene
from lardhm_torch.learning.sized_maps import SMALL, fit_size
from lardhm_torch.learning.state_dicts import file_state
from lardhm_torch.learning.update import Task, UpdateConfig, updated
from lardhm_torch.map_classes import MapClasses
from lardhm_torch.maps import TensorLike
from lardhm_torch.scans import Scans, seeded_generator


class LardHilbertMap(MapClasses):
    """Continuous occupancy map whose log-odds are a weighted sum of local kernel features.

    The log-odds are the logit of the probability of occupancy. The probability is exactly 1/2 in an
    empty map and far from all clusters. Points are given in the world frame; ``origin`` is subtracted
    in float64 before they are cast to the map's dtype, so coordinates may be far from zero. Maps of
    half precision compute in float32 and return results in their own dtype; they cannot be trained. A
    point with a NaN or infinite coordinate has probability NaN. Tensors, NumPy arrays and lists are
    accepted as points.

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
            that any value is valid. `scale_tril` has the factors of the kernels [m].
        is_occupied, counts, means, scatters: (M, ...) buffers, class and moments of the clusters;
            clusters of unknown points have count 0.
        evidence: (M, 64, D) buffer [m], kept points: a bounded random sample of the points of each
            cluster, padded with infinity.
        losses, doubts, fresh, times: (M,) buffers, used by `update` (see docs).
        max_age: `update` removes clusters that were not seen for longer [s]; None: never. Saved.
        posterior_means, posterior_variances: (M,) buffers, written by `fit_uncertainty`; a variance
            of 0 means that the posterior has not been computed.
        posterior_scales: (2,) buffer, factors on negative and positive posterior log-odds.
        origin: (D,) float64 buffer [m], world = map + origin; stays float64 under any cast.
        channel_sums: (M, R, 1 + D) float64 buffer of a map with channels, else None; see `channels`.
        class_weights: (M, K) parameter of a map whose classes were trained (`fit_classes`), else None.

    Source: Guizilini & Ramos 2016, eq. (1), (8), (9).
    """

    @changes_map
    def fit(
        self,
        points: TensorLike,
        labels: TensorLike,
        num_clusters: int | None = None,
        *,
        seed: int = 0,
        max_bytes: int | None = None,
        channels: Channels | None = None,
        rays: Scans | None = None,
        progress: bool = False,
        config: FitConfig | None = None,
    ) -> LardHilbertMap:
        """Fit the map to labeled points. Existing clusters are discarded.

        Occupied, free and unknown points are clustered separately. The moments of its points give a
        cluster its center and length scales. Then the weights are trained. ``max_bytes`` and small maps
        (`scene_clusters`) train the shapes of fewer clusters, too. If anything fails, nothing changes.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free, 1/2 unknown; a single class is allowed.
            num_clusters: total, divided 1 : 2 : 1 between occupied, free and unknown points, or 1 : 1
                without unknown points; other classes get what a class has too few points for. None:
                chosen (`clustering.choose_num_clusters`, or `scene_clusters.needed_clusters`).
            seed: random seed of clustering and training.
            max_bytes: instead of ``num_clusters``, the maximum size of the file that `pack` writes.
            channels: additional values of the points by name, such as `Samples.channels`; the clusters
                accumulate those of the occupied points. They do not affect the occupancy.
            rays: scans of the points. Clusters that stop their rays early are reshaped (`clearing`).
            progress: show a progress bar on a terminal.
            config: training settings.

        Returns:
            This map.

        Raises:
            ValueError: invalid or no points, invalid labels or num_clusters, or exclusive arguments.

        Source: Guizilini & Ramos 2016, Sections II and III.
        """
        self.check_learns()
        channels = check_channels(channels, len(points), self.centers.device)
        samples = training_points(points, labels, self.centers)
        check_num_clusters(num_clusters)
        if max_bytes is not None and not (num_clusters is None and rays is None):
            raise ValueError("max_bytes and num_clusters or rays exclude each other; got both")
        rng = seeded_generator(seed, "fit", self.centers.device)
        config = config or (FitConfig() if max_bytes is None else SMALL)
        task = FitTask(self.kernel, config, rng, progress)
        finish = partial(channel_sums.fitted, channels=channels, points=points, labels=labels)
        if max_bytes is None:
            state = fit_scene(*samples[:2], num_clusters, task, ray_lines(rays, samples[2], task))
        else:
            state = fit_size(samples, max_bytes, task, finish, copy.deepcopy(self))
        state, layout = finish(state, origin=samples.origin)
        with self.lock.writing():
            parameters.write_state(self, state, samples.origin, layout)
            self.class_scale = 1.0
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
            labels: (N,) 1 occupied, 0 free; unknown points (1/2) are left out.

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
        with self.lock.writing():
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
        channels: Channels | None = None,
        time: float | None = None,
        rays: Scans | None = None,
        config: UpdateConfig | None = None,
    ) -> LardHilbertMap:
        """Update the map with one more scan. On an empty map this is `fit`.

        Each cluster keeps a bounded random sample of its points. New points are added to it, clusters
        near them are regrouped, and their weights are trained on the kept points. Obstacles that scans
        contradict disappear. Parameters remain the same objects (`parameters.resize_optimizer`). The
        last rows take the places of removed clusters. If anything fails, nothing changes.

        Args:
            points: (N, D) world positions [m]; an empty set leaves the map unchanged.
            labels: (N,) 1 occupied, 0 free, 1/2 unknown.
            num_clusters: maximum number near the points, over all classes; None: chosen from them.
            seed: random seed of clustering and training.
            channels: see `fit`; channels and classes that are new to the map are added to it.
            time: time stamp of the scan [s]; required if the map has a ``max_age``.
            rays: the scan of the points; obstacles that its rays pass through disappear sooner. An
                empty map has no obstacles, and Algorithm 2 of the paper does not use rays.
            config: settings; `UpdateConfig(as_in_paper=True)` selects Algorithm 2 of the paper.

        Returns:
            This map.

        Raises:
            ValueError: invalid points, labels, num_clusters, channels or rays, or a missing time.

        Source: Guizilini & Ramos 2016, Section III and Algorithm 2.
        """
        self.check_learns()
        aging.check_time(time, self.max_age)
        check_rays(rays, self.dim)
        if len(points) == 0 and len(labels) == 0:
            return self
        if len(self) == 0:
            self.fit(points, labels, num_clusters, seed=seed, channels=channels)
            return aging.stamped(self, time)
        channels = check_channels(channels, len(points), self.centers.device)
        samples = training_points(points, labels, self.centers, self.origin, keep_unknown=True)
        check_num_clusters(num_clusters)
        rng = seeded_generator(seed, "update", self.centers.device)
        task = Task(self.kernel, config or UpdateConfig(), rng)
        hits = channel_sums.hits_with_channels(*samples[:2], channels)
        state = parameters.read_state(self)
        state, layout = channel_sums.with_layout_of(hits, state, self.channel_layout)
        changes = updated(state, *samples[:2], num_clusters, task, lines_of(rays, self.origin))
        part = channel_sums.with_hits(changes.part, layout, hits)
        part = aging.timed(part, *samples[:2], self.kernel, time)
        parameters.write_rows(self, changes.where, part, changes.removed, layout)
        aging.forget_old(self, time)
        return self

    @changes_map
    def transform(self, rotation: Tensor, translation: Tensor) -> LardHilbertMap:
        """Apply the rigid transform x -> rotation x + translation to the map.

        The transform is exact, for example after a loop closure. The posterior is kept.

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

        Clusters of surfaces and of unknown space that limit the remaining free space are kept, so that
        space beyond the radius does not become free. The posterior of the other weights is kept.

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
            evidence: also write the kept points. Without them the file is about a quarter as large,
                and a later `update` draws points from the Gaussians of the clusters.
        """
        with self.lock.reading():
            map_files.save_state(file_state(self.state_dict(), evidence), path)

    def pack(self, path: str | os.PathLike[str], *, precision: int = packing.PRECISION) -> None:
        """Write a compact file, about 12 bytes per cluster in 3-D, for queries only.

        A packed map cannot be trained or updated. Colors take about 10 more bytes per occupied cluster.

        Args:
            path: file, usually ``.lhm``.
            precision: fractional bits of the rounded parameters, 1 to 16 (docs/map_format.md).
        """
        with self.lock.reading():
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
