"""Length-scales, centers and weights learned together, by backpropagation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from lardhm_torch.backpropagation import LabelledPoints, State, TuneConfig, TuningRun
from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.sampling import Samples, check_samples

JUDGED_POINTS = 1 << 16  # whose loss is told after each epoch


def fine_tune(
    model: LardHilbertMap,
    points: Tensor,
    labels: Tensor,
    *,
    ray_id: Tensor | None = None,
    resample: Callable[[int], Samples] | None = None,
    config: TuneConfig | None = None,
    seed: int = 0,
    state: State | None = None,
    after_epoch: Callable[[State], None] | None = None,
    progress: bool = False,
) -> list[float]:
    """Move centers, length-scales and weights of a fitted map downhill on the balanced log-loss.

    Adam with a short warm-up and rates falling to 0. Centers move in units of their cluster's mean
    length-scale and factors by the logarithm of their diagonal, so the rates need no scene and
    every factor stays valid. The neighbors of every point are found anew in every step, and points
    are streamed, so memory does not grow with their number. With ``hold_out`` a share of the rays
    does not train, and the epoch that predicts it best is kept; the given map is no candidate,
    because `fit` has seen those rays. If anything fails the map is as it was.

    Args:
        model: a fitted map, changed in place.
        points: (N, D) world positions [m].
        labels: (N,) 1 occupied, 0 free.
        ray_id: (N,) which ray a point lies on, so that whole rays are held out (`Samples.ray_id`);
            None: points are held out one by one.
        resample: number of the epoch, from 1, -> fresh samples of the same rays for it. New free
            points every epoch cannot be learned by heart:
            ``lambda epoch: sample_rays(scans, seed=seed + epoch)``.
        config: rates, epochs and what is tuned.
        seed: of the hold-out and the batches.
        state: what ``after_epoch`` was given; tuning goes on from there, and ends as if it had
            never been interrupted. All other arguments must be the same again.
        after_epoch: called with the state after every epoch, to be saved.
        progress: show a bar with the loss on a terminal.

    Returns:
        Mean balanced log-loss of held-out points (of training points if none are held out), before
        the first epoch and after each.

    Raises:
        ValueError: the map is empty, nothing is to be tuned, the samples are bad (see `fit`), or
            the state is of another map or config.
    """
    config = config or TuneConfig()
    if len(model) == 0:
        raise ValueError("model must be fitted before it is tuned; it is empty. Call fit first")
    if not (config.tune_weights or config.tune_centers or config.tune_scales):
        raise ValueError("config must leave weights, centers or scales to tune; it freezes all")
    samples = _check(model, points, labels, ray_id)
    if resample and config.hold_out and ray_id is None:
        raise ValueError(
            "ray_id must be given where held-out rays are to be sampled anew; got none"
        )
    rng = torch.Generator(device=model.origin.device).manual_seed(seed)
    held_rays = _hold_out(samples, config.hold_out, rng)
    train, judged = _divide(samples, held_rays)
    run = TuningRun(model, config, rng)
    run.load(state) if state else run.losses.append(run.judge(judged))
    with tqdm(total=config.epochs, initial=run.epoch, disable=None if progress else True) as bar:
        while run.epoch < config.epochs and not run.stalled():
            if resample and run.epoch:
                fresh = resample(run.epoch)
                fresh_samples = _check(model, fresh.points, fresh.labels, fresh.ray_id)
                train = _divide(fresh_samples, held_rays)[0]
            run.train(train)
            run.keep_best(run.judge(judged))
            bar.set_postfix(loss=f"{run.losses[-1]:.4f}")
            bar.update()
            if after_epoch:
                after_epoch(run.state())
    with torch.no_grad():
        for parameter, value in zip(run.parameters_of_map(), run.best, strict=True):
            parameter.copy_(value)
    return run.losses


def _check(
    model: LardHilbertMap, points: Tensor, labels: Tensor, ray_id: Tensor | None
) -> LabelledPoints:
    points, labels = check_samples(
        points, labels, model.dim, model.origin.device, keep_unknown=True
    )
    if ray_id is not None:
        ray_id = torch.as_tensor(ray_id, device=points.device)
        if ray_id.shape != labels.shape:
            raise ValueError(
                f"ray_id must be ({len(labels)},), one per point; got {tuple(ray_id.shape)}"
            )
    return LabelledPoints(points, labels, ray_id)


def _hold_out(samples: LabelledPoints, share: float, rng: torch.Generator) -> Tensor | None:
    """A random share of the rays, by their id (of the points, by their row); None for none."""
    if not share:
        return None
    rays = samples.ray_id
    ids = torch.arange(len(samples.labels), device=rng.device) if rays is None else rays.unique()
    held = ids[torch.rand(len(ids), generator=rng, device=rng.device) < share]
    return held if 0 < len(held) < len(ids) else None


def _divide(
    samples: LabelledPoints, held_rays: Tensor | None
) -> tuple[LabelledPoints, LabelledPoints]:
    """What trains, and what is judged: the held-out points, or a part of the training points."""
    if held_rays is None:
        train = judged = samples
    else:
        positions, labels, rays = samples
        rays = torch.arange(len(labels), device=labels.device) if rays is None else rays
        held = torch.isin(rays, held_rays)
        train = LabelledPoints(positions[~held], labels[~held], None)
        judged = LabelledPoints(positions[held], labels[held], None)
    every = -(-len(judged.labels) // JUDGED_POINTS)
    return train, LabelledPoints(judged.positions[::every], judged.labels[::every], None)
