"""The map: a torch module that owns the clusters and their weights."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lardhm_torch import checkpoint, joining, map_state, native, uncertainty, unseen
from lardhm_torch.clustering import (
    Clusters,
    along_curve,
    cluster_classes,
    factor_covariances,
    points_where,
)
from lardhm_torch.features import (
    Kernel,
    feature_matrix,
    kernel_factors,
    lard_kernel,
    neighbor_fade,
    raw_factors,
)
from lardhm_torch.fitting import FitConfig, deal_samples, fit_weights
from lardhm_torch.incremental import Task, UpdateConfig, updated
from lardhm_torch.sampling import check_samples

FRAME_CHUNK = 1 << 14  # points moved to the map's frame at a time: they stay in the cache


class LardHilbertMap(nn.Module):
    """Continuous occupancy: a weighted sum of local kernel features gives the log-odds.

    An empty map, and any place far from every cluster, says nothing: probability exactly 1/2.
    Points are given in the world frame; ``origin`` is subtracted in float64 before they are cast to
    the map's dtype, so that coordinates may be far from zero. A point with a NaN or infinite
    coordinate has probability NaN.

    Args:
        dim: number of coordinates D.
        num_neighbors: k nearest clusters that answer for a point.
        covariance_scale: factor on the clusters' covariances.
        min_lengthscale: no kernel axis is thinner [m], before ``covariance_scale``.

    Attributes:
        weights: (M,) parameter, learned.
        centers: (M, D) parameter [m], map frame.
        raw_scale_tril: (M, D, D) parameter, lower Cholesky factors with the logarithm of their
            diagonals: any value is a valid factor. `scale_tril` is the kernel's.
        is_occupied, counts, means, scatters: (M, ...) buffers, class and moments of the clusters;
            those of unknown points count 0, for nothing was seen there.
        posterior_means, posterior_variances: (M,) buffers, the weights as `fit_uncertainty` knows
            them; variance 0 for clusters that it has not seen.
        posterior_scales: (2,) buffer, factors on negative and on positive posterior log-odds.
        origin: (D,) float64 buffer [m], world = map + origin; stays float64 under any cast.

    Source: Guizilini & Ramos 2016, eq. (1), (8), (9).
    """

    weights: nn.Parameter
    centers: nn.Parameter
    raw_scale_tril: nn.Parameter
    is_occupied: Tensor
    counts: Tensor
    means: Tensor
    scatters: Tensor
    posterior_means: Tensor
    posterior_variances: Tensor
    posterior_scales: Tensor
    origin: Tensor

    def __init__(
        self,
        dim: int = 3,
        num_neighbors: int = 16,
        *,
        covariance_scale: float = 4.0,
        min_lengthscale: float = 0.01,
    ) -> None:
        super().__init__()
        for name, value in {"dim": dim, "num_neighbors": num_neighbors}.items():
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a whole number, 1 or more; got {value!r}")
        if not covariance_scale > 0 or not min_lengthscale > 0:
            raise ValueError(
                "covariance_scale and min_lengthscale must be > 0; "
                f"got {covariance_scale} and {min_lengthscale}"
            )
        self.dim = dim
        self.num_neighbors = num_neighbors
        self.covariance_scale = float(covariance_scale)
        self.min_lengthscale = float(min_lengthscale)
        self.weights = nn.Parameter(torch.zeros(0))
        self.centers = nn.Parameter(torch.zeros(0, dim), requires_grad=False)
        self.raw_scale_tril = nn.Parameter(torch.zeros(0, dim, dim), requires_grad=False)
        self.register_buffer("is_occupied", torch.zeros(0, dtype=torch.bool))
        self.register_buffer("counts", torch.zeros(0, dtype=torch.long))
        self.register_buffer("means", torch.zeros(0, dim))
        self.register_buffer("scatters", torch.zeros(0, dim, dim))
        self.register_buffer("posterior_means", torch.zeros(0))
        self.register_buffer("posterior_variances", torch.zeros(0))
        self.register_buffer("posterior_scales", torch.ones(2))
        self.register_load_state_dict_pre_hook(uncertainty.fill_missing)
        self.register_buffer("origin", torch.zeros(dim, dtype=torch.float64))
        self._index = torch.empty(0, dtype=torch.uint8)
        self._reserves: dict[str, tuple[int, int]] = {}  # of `map_state.resize`
        self.register_load_state_dict_pre_hook(map_state.make_room)

    # --- what the map knows ---

    def __len__(self) -> int:
        """Number of clusters M."""
        return len(self.weights)

    @property
    def scale_tril(self) -> Tensor:
        """(M, D, D) lower Cholesky factors of the kernels [m]: covariance scale and floor included."""
        return kernel_factors(self.raw_scale_tril, self.kernel)

    @property
    def kernel(self) -> Kernel:
        """Number of neighbors, covariance scale and floor of the kernels."""
        return Kernel(self.num_neighbors, self.covariance_scale, self.min_lengthscale)

    def extra_repr(self) -> str:
        """What `print(model)` shows."""
        return (
            f"dim={self.dim}, num_clusters={len(self)}, num_neighbors={self.num_neighbors}, "
            f"covariance_scale={self.covariance_scale}, min_lengthscale={self.min_lengthscale}"
        )

    # --- what the map answers ---

    def forward(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy, eq. (1)."""
        return self._query(points, probability=True)

    def log_odds(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) log-odds of occupancy, w^T Phi(x)."""
        return self._query(points, probability=False)

    def features(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> sparse COO (N, M), K kernel values a row, eq. (9)."""
        local = self._to_map_frame(points)
        if local.ndim != 2:
            raise ValueError(f"points must be (N, {self.dim}); got {tuple(points.shape)}")
        indices = native.nearest_centers(
            local, self.centers, self.num_neighbors, self._fresh_index()
        )
        values = lard_kernel(local, self.centers, self.scale_tril, indices)
        values = values * neighbor_fade(local, self.centers, indices)
        return feature_matrix(indices, values, len(self))

    def variance(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) variance of the log-odds; the prior's where unseen.

        Raises:
            RuntimeError: `fit_uncertainty` was not called since the clusters changed.
        """
        return self._posterior(points)[1]

    def bayesian_probability(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) probability of occupancy, unsure where weights are.

        Raises:
            RuntimeError: `fit_uncertainty` was not called since the clusters changed.
        """
        mean, variance = self._posterior(points)
        return uncertainty.moderate(mean, uncertainty.OWN_SHARE * variance)

    @torch.no_grad()
    def unknown(self, points: Tensor) -> Tensor:
        """(..., D) world positions [m] -> (...) how little the map has seen there, 0 to 1.

        1 less the largest feature of a cluster that holds occupied or free points. A probability
        near 1/2 means contradiction where this is near 0, and that nothing was seen where it is
        near 1. Nothing but `fit` is needed.
        """
        local = self._to_map_frame(points)
        parts = [local.new_ones(0)]
        for chunk in local.reshape(-1, self.dim).split(uncertainty.QUERY_CHUNK):
            if len(self) == 0:
                parts.append(torch.ones_like(chunk[:, 0]))
                continue
            indices, values = self._nearest_features(chunk)
            seen = torch.where(self.counts[indices] > 0, values, 0 * values)
            parts.append(1 - seen.amax(dim=1))
        return torch.cat(parts).reshape(local.shape[:-1])

    def _posterior(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the log-odds at (..., D) points."""
        if not bool((self.posterior_variances > 0).all()) or len(self) == 0:
            raise RuntimeError(
                "variance needs the posterior of every weight; "
                "call fit_uncertainty(points, labels) first, and again after update"
            )
        local = self._to_map_frame(points)
        parts = []
        for chunk in local.reshape(-1, self.dim).split(uncertainty.QUERY_CHUNK):
            indices, values = self._nearest_features(chunk)
            mean = (values * self.posterior_means[indices]).sum(dim=1)
            mean = uncertainty.posterior_log_odds(mean, self.posterior_scales)
            variance = uncertainty.latent_variance(indices, values, self.posterior_variances)
            parts.append(torch.stack([mean, variance]))
        mean, variance = torch.cat(parts, dim=1).reshape(2, *local.shape[:-1])
        return mean, variance

    def _nearest_features(self, local: Tensor) -> tuple[Tensor, Tensor]:
        centers, raw_scale_tril = self.centers.detach(), self.raw_scale_tril.detach()
        return native.nearest_features(
            local, centers, raw_scale_tril, self.kernel, self._fresh_index()
        )

    def _query(self, points: Tensor, probability: bool) -> Tensor:
        local = self._to_map_frame(points)
        state = (self.centers, self.raw_scale_tril, self.weights, self.kernel)
        flat = local.reshape(-1, self.dim)
        answer = native.occupancy(flat, *state, probability=probability, index=self._fresh_index())
        return answer.reshape(local.shape[:-1])

    @torch.no_grad()
    def query_lattice(self, axes: Sequence[Tensor], probability: bool = True) -> Tensor:
        """Probability, or log-odds, at all points of a lattice: faster than the points one by one.

        Args:
            axes: D lists of world coordinates [m]; all their combinations are the points.
            probability: False: log-odds.

        Returns:
            (len(axes[0]), len(axes[1]), ...) without gradient.
        """
        check_axes(axes, self.dim)
        local = [
            to_frame(axis, shift, self.centers.dtype)
            for axis, shift in zip(axes, self.origin, strict=True)
        ]
        state = (self.centers, self.raw_scale_tril, self.weights, self.kernel)
        return native.lattice_occupancy(
            local, *state, probability=probability, index=self._fresh_index()
        )

    @torch.no_grad()
    def query_rays(self, origins: Tensor, directions: Tensor, march: tuple[Any, ...]) -> Any:
        """`rays.raycast` by the native kernel; None where that does not answer for this map.

        Args:
            origins: (R, D) world positions, float64 [m].
            directions: (R, D) of length 1, float64.
            march: as for `native.raycast`.
        """
        if len(self) == 0 or not native.supports(self.centers):
            return None
        parameters = (self.centers, self.raw_scale_tril, self.weights)
        return native.raycast(
            (origins - self.origin, directions), march, parameters, self.kernel, self._fresh_index()
        )

    def _fresh_index(self) -> Tensor:
        """The neighbor search's index, made anew whenever the centers are not those it was made of."""
        if torch.compiler.is_compiling():  # no branch on values; the operators check it themselves
            return self._index
        if not native.index_matches(self._index, self.centers, self.num_neighbors):
            with torch.inference_mode(False):  # an inference tensor could never serve training
                self._index = native.build_index(self.centers, self.num_neighbors)
        return self._index

    def _to_map_frame(self, points: Tensor) -> Tensor:
        points = torch.as_tensor(points, device=self.origin.device)
        check_points(points, self.dim)
        return to_frame(points, self.origin, self.centers.dtype)

    # --- how the map learns ---

    def fit(
        self,
        points: Tensor,
        labels: Tensor,
        num_clusters: int | None = None,
        *,
        seed: int = 0,
        config: FitConfig | None = None,
        progress: bool = False,
    ) -> LardHilbertMap:
        """Learn the map from labelled points; what it knew before is forgotten.

        Each class is clustered on its own, the clusters' moments give centers and length-scales,
        then the weights are trained. If anything fails, the map is as it was.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free, 1/2 unknown; one class alone is allowed.
            num_clusters: total over both classes, half each; a class too small for its half
                leaves the rest to the other, and no cluster is starved of points. None: chosen
                from the data (`clustering.choose_num_clusters`).
            seed: of clustering and training.
            config: how the weights are trained.
            progress: show a bar on a terminal.

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, NaN or infinite points, labels not 0 or 1, no points.

        Source: Guizilini & Ramos 2016, Sections II and III.
        """
        device = self.origin.device
        points, labels = check_samples(points, labels, self.dim, device, keep_unknown=True)
        _check_num_clusters(num_clusters)
        dtype = self.centers.dtype
        rng = torch.Generator(device=points.device).manual_seed(seed)
        origin = points.mean(dim=0, dtype=torch.float64).round()
        local, labels = along_curve(to_frame(points, origin, dtype), labels.to(dtype))
        clusters, is_occupied = cluster_classes(local, labels, num_clusters, rng)
        learned = LardHilbertMap(**self.settings).to(self.centers)
        learned._grow(clusters, is_occupied, origin)
        local, labels = learned._settle_unknown(local, labels, rng)
        learned._train_weights(local, labels, config or FitConfig(), rng, progress)
        self.load_state_dict(learned.state_dict())
        return self

    @torch.no_grad()
    def fit_uncertainty(self, points: Tensor, labels: Tensor) -> LardHilbertMap:
        """Learn how sure the weights are; `variance` and `bayesian_probability` then answer.

        The map's own probability and log-odds stay as they are, and as fast. Call it after the
        last `fit`, `fine_tune` or `update`, with the points the map was made from: the posterior
        belongs to the weights it was made for.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free.

        Returns:
            This map.

        Raises:
            ValueError: the map is empty, or the samples are bad (see `fit`).
        """
        if len(self) == 0:
            raise ValueError("the map must be fitted before its uncertainty; it is empty: call fit")
        points, labels = check_samples(points, labels, self.dim, self.origin.device)
        indices, values = self._nearest_features(self._to_map_frame(points))
        log_odds = (values * self.weights[indices]).sum(dim=1)
        variances = uncertainty.weight_variances(indices, values, log_odds, len(self))
        samples = (indices, values, log_odds, labels.to(values.dtype))
        self.posterior_scales = uncertainty.posterior_scales(*samples, variances)
        self.posterior_means, self.posterior_variances = self.weights.detach().clone(), variances
        return self

    def update(
        self,
        points: Tensor,
        labels: Tensor,
        num_clusters: int | None = None,
        *,
        seed: int = 0,
        config: UpdateConfig | None = None,
    ) -> LardHilbertMap:
        """Learn from one more scan and keep what is known; on an empty map the same as `fit`.

        New points join the clusters that explain them, the others make new ones; then the weights
        near the scan are trained on the new points and on what the map recalls. Parameters stay
        the same objects (see `map_state.resize_optimizer` for an optimizer with a state). If
        anything fails, the map is as it was.

        Args:
            points: (N, D) world positions [m]; none leave the map as it is.
            labels: (N,) 1 occupied, 0 free.
            num_clusters: total over both classes if the map knew nothing yet; points that are
                explained already make none. None: chosen from the data.
            seed: of clustering and training.
            config: `UpdateConfig(as_in_paper=True, replay=0)` is the paper's own rule.

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, NaN or infinite points, labels not 0 or 1.

        Source: Guizilini & Ramos 2016, Section III and Algorithm 2.
        """
        if len(points) == 0 and len(labels) == 0:
            return self
        if len(self) == 0:
            return self.fit(points, labels, num_clusters, seed=seed)
        points, labels = check_samples(points, labels, self.dim, self.origin.device)
        _check_num_clusters(num_clusters)
        rng = torch.Generator(device=points.device).manual_seed(seed)
        task = Task(self.kernel, config or UpdateConfig(), rng)
        local = self._to_map_frame(points)
        state = map_state.read_state(self)
        changes = updated(state, local, labels.to(local.dtype), num_clusters, task)
        map_state.write_rows(self, *changes)
        return self

    def transform(self, rotation: Tensor, translation: Tensor) -> LardHilbertMap:
        """Move the map: what was said of x is now said of rotation x + translation.

        Exact, without training: a loop closure moves a submap to where it belongs.

        Args:
            rotation: (D, D) orthonormal, determinant 1.
            translation: (D,) [m].

        Returns:
            This map.

        Raises:
            ValueError: wrong shapes, or rotation is not a rotation.
        """
        state, origin = joining.moved(
            map_state.read_state(self), self.origin, rotation, translation
        )
        map_state.write_state(self, state)
        self.origin = origin
        return self

    def crop(self, center: Tensor, radius: float) -> LardHilbertMap:
        """Forget all clusters farther than ``radius`` [m] from a world position (D,).

        Returns:
            This map.

        Raises:
            ValueError: center is not (D,) and finite, or radius is not > 0.
        """
        center = torch.as_tensor(center, dtype=torch.float64, device=self.origin.device)
        if center.shape != self.origin.shape or not bool(center.isfinite().all()):
            raise ValueError(f"center must be ({self.dim},) and finite; got {center.tolist()}")
        if not radius > 0:
            raise ValueError(f"radius must be > 0 m; got {radius}")
        state = map_state.read_state(self)
        local = self._to_map_frame(center)
        map_state.write_state(self, joining.within(state, local, radius))
        return self

    def parameter_groups(self, weight_decay: float = 0.0) -> list[dict[str, Any]]:
        """Groups for an optimizer, with weight decay on the weights alone.

        Decay would pull centers to the map's origin and length-scales to 1 m.
        """
        return [
            {"params": [self.weights], "weight_decay": weight_decay},
            {"params": [self.centers, self.raw_scale_tril], "weight_decay": 0.0},
        ]

    def _settle_unknown(
        self, local: Tensor, labels: Tensor, rng: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Where there are unknown points: less those inside surfaces, and more in the tails."""
        is_unknown = labels == unseen.UNKNOWN
        if not bool(is_unknown.any()):
            return local, labels
        known = Clusters(self.counts, self.means, self.scatters)
        surfaces = Clusters(*(moments[self.is_occupied] for moments in known))
        rows = is_unknown.nonzero().squeeze(1)
        kept = ~is_unknown
        kept[rows] = unseen.off_surfaces(local[rows], surfaces, self.min_lengthscale)
        tails = unseen.draw_tails(known, self.is_occupied, self.min_lengthscale, rng)
        held = self._nearest_features(tails)[1].amax(dim=1) > unseen.TAIL_FEATURE
        tails = tails[~held]
        local = torch.cat([points_where(local, kept), tails])
        labels = torch.cat([labels[kept], labels.new_full((len(tails),), unseen.UNKNOWN)])
        return along_curve(local, labels)

    def _train_weights(
        self, local: Tensor, labels: Tensor, config: FitConfig, rng: torch.Generator, progress: bool
    ) -> None:
        local, labels = deal_samples((local, labels), config.rows_a_batch(len(local)), rng)

        def features_of(rows: slice) -> tuple[Tensor, Tensor]:
            return self._nearest_features(local[rows])

        weights = fit_weights(features_of, labels, self.weights.detach(), config, progress)
        with torch.no_grad():
            self.weights.copy_(weights)

    def _grow(self, clusters: Clusters, is_occupied: Tensor, origin: Tensor) -> None:
        """Take over clusters as centers and length-scales, with weights of 0."""
        factors = factor_covariances(clusters.covariances, self.min_lengthscale)
        map_state.resize(self, len(clusters))
        with torch.no_grad():
            self.weights.zero_()
            self.centers.copy_(clusters.means)
            self.raw_scale_tril.copy_(raw_factors(factors))
        self.is_occupied, self.counts = is_occupied, clusters.counts
        self.means, self.scatters, self.origin = clusters.means, clusters.scatters, origin

    # --- what the map is on disk ---

    @property
    def settings(self) -> dict[str, Any]:
        """The arguments that make an empty map like this one."""
        return {
            "dim": self.dim,
            "num_neighbors": self.num_neighbors,
            "covariance_scale": self.covariance_scale,
            "min_lengthscale": self.min_lengthscale,
        }

    def get_extra_state(self) -> dict[str, Any]:
        """Format version and settings, kept in the state dict beside the tensors."""
        return {"format_version": checkpoint.FORMAT_VERSION, **self.settings}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Nothing to set: `map_state.make_room` has checked that the settings agree."""

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the map to a file, atomically: `torch.save(model.state_dict(), path)`, but safe."""
        checkpoint.save_state(self.state_dict(), path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> LardHilbertMap:
        """Read a map file, whether `save` or `torch.save(model.state_dict(), ...)` wrote it.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not a map, is damaged, unsafe, or of a newer format.
        """
        state = checkpoint.load_state(path)
        state.pop(checkpoint.STREAM_KEY, None)  # a checkpoint of a stream is a map, too
        try:
            settings = checkpoint.check_settings(state.get("_extra_state"))
            if state["centers"].shape[1:] != (settings["dim"],):
                raise ValueError(
                    f"centers must be (M, {settings['dim']}); got {tuple(state['centers'].shape)}"
                )
            model = cls(**settings).to(state["centers"].dtype)
            model.load_state_dict(state)
        except (KeyError, AttributeError, TypeError, RuntimeError, ValueError) as error:
            raise ValueError(f"{os.fspath(path)} must hold a LardHilbertMap; {error}") from error
        return model

    def _apply(self, fn: Any, recurse: bool = True) -> LardHilbertMap:
        """`.to()`, `.float()`, `.half()`: everything follows but the float64 of the origin."""
        origin = self.origin
        super()._apply(fn, recurse)
        if self.origin.dtype != torch.float64:
            self.origin = origin.to(self.origin.device)
        return self


def check_points(points: Tensor, dim: int) -> None:
    """A ValueError where points are not (..., D)."""
    if points.ndim == 0 or points.shape[-1] != dim:
        raise ValueError(
            f"points must be (..., {dim}), one row of coordinates per point; "
            f"got {tuple(points.shape)}"
        )


def check_axes(axes: Sequence[Tensor], dim: int) -> None:
    """A ValueError where axes are not D lists of finite coordinates."""
    if len(axes) != dim:
        raise ValueError(f"axes must be {dim} lists of coordinates; got {len(axes)}")
    if not all(bool(axis.isfinite().all()) for axis in axes):
        raise ValueError("axes must be finite; got NaN or infinity")


def to_frame(points: Tensor, origin: Tensor, dtype: torch.dtype) -> Tensor:
    """(..., D) world positions -> positions relative to an origin of whole meters, of that dtype.

    Whole meters are exact in float32 too, so float32 points lose nothing.
    """
    working = torch.promote_types(torch.promote_types(points.dtype, dtype), torch.float32)
    shift = origin.to(working)
    plain = working == dtype or points.ndim != 2 or points.requires_grad
    if plain or torch.compiler.is_compiling():
        return (points.to(working) - shift).to(dtype)
    local = points.new_empty(points.shape, dtype=dtype)  # in small steps: nothing large in between
    shift = shift.expand(min(FRAME_CHUNK, len(points)), -1).contiguous()
    for to, part in zip(local.split(FRAME_CHUNK), points.split(FRAME_CHUNK), strict=True):
        to.copy_(part - shift[: len(part)])
    return local


def _check_num_clusters(num_clusters: int | None) -> None:
    if num_clusters is not None and num_clusters < 1:
        raise ValueError(f"num_clusters must be 1 or more, or None; got {num_clusters}")
