"""The original Hilbert Maps: features independent of the data, logistic regression by SGD."""

from __future__ import annotations

import itertools
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.learning.fitting import FitConfig, fit_weights, stratified_batches
from lardhm_torch.learning.points import check_samples, in_morton_order

SUPPORT_RADIUS = 2.5  # [cells] kernels are truncated here, at exp(-2.5^2 / 2) = 4 % of the peak
# for a lengthscale of one cell
MAX_CELLS = 1 << 28
CHUNK_POINTS = 1 << 15
METHODS = ("fourier", "nystroem")


class OriginalHilbertMap:
    """Hilbert map with a center at every node of a regular lattice over all training points.

    The weights are trained as those of `LardHilbertMap`, with the same loss, class weights and SGD.
    Only the positions and the width of the features differ.

    Args:
        spacing: distance between neighboring centers [m].
        lengthscale: of the squared exponential, in spacings.
        config: settings of the training.
        seed: random seed for the order of the points in training.
        dtype: of the computation.

    Source: Ramos & Ott 2015, "Hilbert maps"; Guizilini & Ramos 2016, Section II-B and Table II.
    """

    def __init__(
        self,
        spacing: float = 0.2,
        lengthscale: float = 1.0,
        *,
        config: FitConfig | None = None,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        if not spacing > 0 or not lengthscale > 0:
            raise ValueError(
                f"spacing and lengthscale must be > 0; got {spacing} and {lengthscale}"
            )
        self.spacing, self.lengthscale = float(spacing), float(lengthscale)
        self.config, self.seed, self.dtype = config or FitConfig(), seed, dtype
        self.weights: Tensor | None = None

    def fit(self, points: Tensor, labels: Tensor) -> OriginalHilbertMap:
        """Build the lattice over the points and train its weights.

        Args:
            points: (N, D) world positions [m].
            labels: (N,) 1 occupied, 0 free.

        Raises:
            ValueError: the lattice would have more than 2^28 nodes, or the samples are invalid (see
                `LardHilbertMap.fit`).
        """
        points, labels = check_samples(points.double(), labels, points.shape[-1], points.device)
        margin = int(SUPPORT_RADIUS * max(1.0, self.lengthscale)) + 1
        lower = (points.amin(dim=0) / self.spacing).floor() - margin
        shape = (points.amax(dim=0) / self.spacing).ceil() + margin + 1 - lower
        if not float(shape.prod()) <= MAX_CELLS:
            raise ValueError(
                f"spacing must give at most {MAX_CELLS} lattice nodes; got {float(shape.prod()):.3g} "
                f"for {self.spacing} m. Raise the spacing"
            )
        self.origin, self.shape = lower * self.spacing, shape.long()
        self.offsets = self._neighbor_offsets(points.shape[1]).to(points.device)
        rng = torch.Generator(device=points.device).manual_seed(self.seed)

        samples = in_morton_order(points, labels.to(self.dtype))
        points, labels = stratified_batches(samples, self.config.rows_per_batch(len(points)), rng)

        def features_of(rows: slice) -> tuple[Tensor, Tensor]:
            return self.features(points[rows])

        start = points.new_zeros(int(self.shape.prod()), dtype=self.dtype)
        self.weights = fit_weights(features_of, labels, start, self.config)
        return self

    def _neighbor_offsets(self, dim: int) -> Tensor:
        """(K, D) offsets in cells of the nodes within the support radius of the nearest node."""
        radius = SUPPORT_RADIUS * max(1.0, self.lengthscale)
        steps = range(-int(radius), int(radius) + 1)
        cube = torch.tensor(list(itertools.product(steps, repeat=dim)))
        return cube[cube.square().sum(dim=1) <= radius**2]

    def features(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(N, D) world positions [m] -> (N, K) node indices and (N, K) kernel values, 0 outside."""
        scaled = (points.to(torch.float64) - self.origin) / self.spacing
        base = scaled.round()
        remainder = (scaled - base).to(self.dtype)
        nodes = base.long()[:, None] + self.offsets
        squared = (remainder[:, None] - self.offsets).square().sum(dim=2)
        values = torch.exp(-0.5 / self.lengthscale**2 * squared)
        values = values * ((nodes >= 0) & (nodes < self.shape)).all(dim=2)
        index = torch.zeros_like(nodes[..., 0])
        for axis, size in enumerate(self.shape.tolist()):
            index = index * size + nodes[..., axis].clamp(0, size - 1)
        return index.int(), values

    @torch.no_grad()
    def probability(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> (N,) probability of occupancy; 1/2 outside the lattice.

        Raises:
            RuntimeError: `fit` has not been called.
            ValueError: points are not (N, D).
        """
        if self.weights is None:
            raise RuntimeError("probability needs weights; call fit(points, labels) first")
        if points.ndim != 2 or points.shape[1] != len(self.shape):
            raise ValueError(f"points must be (N, {len(self.shape)}); got {tuple(points.shape)}")
        parts = []
        for chunk in points.split(CHUNK_POINTS):
            index, values = self.features(chunk)
            parts.append(torch.sigmoid((values * self.weights[index]).sum(dim=1)))
        return torch.cat(parts)

    __call__ = probability


class KernelApproximationMap:
    """Hilbert map with global features: random Fourier, or Nystroem on random training points.

    Features and weights are computed by scikit-learn (`RBFSampler` or `Nystroem`, then
    `SGDClassifier` with logistic loss and elastic net), as in the first Hilbert Maps paper.

    Args:
        method: "fourier" or "nystroem".
        num_features: number of features.
        lengthscale: of the squared exponential [m].
        seed: random seed of features and training.

    Source: Ramos & Ott 2015, "Hilbert maps", Section IV.
    """

    def __init__(
        self,
        method: str = "nystroem",
        num_features: int = 1000,
        lengthscale: float = 0.3,
        *,
        seed: int = 0,
    ) -> None:
        if method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)}; got {method!r}")
        if num_features < 1 or not lengthscale > 0:
            raise ValueError(
                "num_features must be 1 or more and lengthscale > 0; "
                f"got {num_features} and {lengthscale}"
            )
        self.method, self.num_features = method, num_features
        self.lengthscale, self.seed = float(lengthscale), seed
        self.pipeline: Any = None

    def fit(self, points: Tensor, labels: Tensor) -> KernelApproximationMap:
        """Draw the features and train the weights; arguments and errors as in `OriginalHilbertMap`."""
        from sklearn.kernel_approximation import Nystroem, RBFSampler
        from sklearn.linear_model import SGDClassifier
        from sklearn.pipeline import make_pipeline

        points, labels = check_samples(points.double(), labels, points.shape[-1], points.device)
        if len(labels.unique()) < 2:
            raise ValueError("labels must hold both classes for scikit-learn; got only one")
        self.origin = points.mean(dim=0).round()
        gamma, count = 0.5 / self.lengthscale**2, min(self.num_features, len(points))
        if self.method == "fourier":
            features = RBFSampler(gamma=gamma, n_components=count, random_state=self.seed)
        else:
            features = Nystroem(gamma=gamma, n_components=count, random_state=self.seed)
        classifier = SGDClassifier(
            loss="log_loss", penalty="elasticnet", alpha=1e-6, class_weight="balanced",
            average=True, max_iter=10, tol=None, random_state=self.seed,
        )  # fmt: skip
        local = (points - self.origin).cpu().numpy()
        self.pipeline = make_pipeline(features, classifier).fit(local, labels.cpu().numpy() > 0.5)
        return self

    def probability(self, points: Tensor) -> Tensor:
        """(N, D) world positions [m] -> (N,) probability of occupancy.

        Raises:
            RuntimeError: `fit` has not been called.
            ValueError: points are not (N, D).
        """
        if self.pipeline is None:
            raise RuntimeError("probability needs weights; call fit(points, labels) first")
        if points.ndim != 2 or points.shape[1] != len(self.origin):
            raise ValueError(f"points must be (N, {len(self.origin)}); got {tuple(points.shape)}")
        local = (points.to(torch.float64) - self.origin).cpu()
        parts = [
            torch.from_numpy(self.pipeline.predict_proba(part.numpy())[:, 1])
            for part in local.split(CHUNK_POINTS)
        ]
        return torch.cat(parts).to(points.device)

    __call__ = probability
