"""Distances between an extracted mesh and the true surface."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lardhm_torch.maps import TensorLike, to_tensor

if TYPE_CHECKING:
    import trimesh

F_SCORE_LIMITS = (0.05, 0.1)  # [m]


def mesh_metrics(
    mesh: trimesh.Trimesh,
    truth: trimesh.Trimesh,
    hits: TensorLike,
    *,
    num_points: int = 200_000,
    seen_within: float = 0.1,
    seed: int = 0,
) -> dict[str, float]:
    """Distances between a mesh and the part of the true surface that rays hit.

    Args:
        mesh: extracted surface [m].
        truth: true surface [m].
        hits: (H, 3) ends of the training rays [m].
        num_points: number of points sampled on each surface.
        seen_within: points of the true surface farther than this from every hit are ignored [m].
        seed: random seed of the sampling.

    Returns:
        accuracy (mean distance mesh to truth), completeness (truth to mesh), chamfer (mean of
        both) [m]; f_score_0.05 and f_score_0.1 at those distances [m].

    Raises:
        ValueError: a mesh has no faces, hits are not (H, 3), or none is near the true surface.
    """
    from scipy.spatial import cKDTree

    for name, surface in {"mesh": mesh, "truth": truth}.items():
        if len(surface.faces) == 0:
            raise ValueError(f"{name} must have faces; got none")
    hits = to_tensor(hits, "hits")
    if hits.ndim != 2 or hits.shape[1] != 3 or len(hits) == 0:
        raise ValueError(f"hits must be (H, 3), at least one; got {tuple(hits.shape)}")
    sampled, true = (_sample_surface(surface, num_points, seed) for surface in (mesh, truth))
    near_hit, _ = cKDTree(hits.detach().cpu()).query(true, distance_upper_bound=seen_within)
    true = true[near_hit < float("inf")]
    if len(true) == 0:
        raise ValueError(f"hits must lie within {seen_within} m of the truth somewhere; none does")
    to_truth, to_mesh = cKDTree(true).query(sampled)[0], cKDTree(sampled).query(true)[0]
    scores = {"accuracy": to_truth.mean(), "completeness": to_mesh.mean()}
    scores["chamfer"] = 0.5 * (scores["accuracy"] + scores["completeness"])
    for limit in F_SCORE_LIMITS:
        scores[f"f_score_{limit}"] = _f_score((to_truth < limit).mean(), (to_mesh < limit).mean())
    return {name: float(value) for name, value in scores.items()}


def _f_score(precision: float, recall: float) -> float:
    return 2 * precision * recall / max(precision + recall, 1e-12)


def _sample_surface(surface: trimesh.Trimesh, num_points: int, seed: int) -> np.ndarray:
    from trimesh.sample import sample_surface

    return np.asarray(sample_surface(surface, num_points, seed=seed)[0])
