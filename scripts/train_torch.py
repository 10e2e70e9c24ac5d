"""Train a map with your own PyTorch loop instead of `fine_tune`.

The loop uses a DataLoader, AdamW, BCEWithLogitsLoss on `model.log_odds`, a learning rate schedule,
gradient clipping, averaged parameters, and a checkpoint per epoch from which the run resumes.

Usage: python scripts/train_torch.py SCANS -o map.pt [--epochs 8] [--checkpoint run.pt]
"""

import argparse
from pathlib import Path

import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torch.utils.data import DataLoader, TensorDataset

from lardhm_torch import FitConfig, LardHilbertMap, load_scans, sample_rays


def main(arguments: argparse.Namespace) -> None:
    """Fit a start, train it epoch by epoch, save the averaged map."""
    torch.manual_seed(arguments.seed)
    samples = sample_rays(load_scans(arguments.scans), seed=arguments.seed)
    # Clusters and initial weights; everything after this line is plain PyTorch.
    model = LardHilbertMap(dim=samples.points.shape[1]).fit(
        samples.points, samples.labels, seed=arguments.seed, config=FitConfig(passes=1)
    )
    model.requires_grad_(True)  # also centers and length scales
    average = AveragedModel(model, multi_avg_fn=get_ema_multi_avg_fn(0.98))

    weights, shape = model.parameter_groups(weight_decay=1e-4)
    # Units: weights are log-odds, centers meters, length scales logarithms of meters.
    groups = [weights | {"lr": 0.05}, shape | {"lr": 0.002}]
    optimizer = torch.optim.AdamW(groups)
    loader = DataLoader(
        TensorDataset(samples.points, samples.labels), batch_size=arguments.batch, shuffle=True
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, [0.05, 0.002], epochs=arguments.epochs, steps_per_epoch=len(loader)
    )
    free_per_hit = (samples.labels == 0).sum() / (samples.labels == 1).sum()
    loss_of = nn.BCEWithLogitsLoss(pos_weight=free_per_hit)  # hits are few

    kept = {"model": model, "average": average, "optimizer": optimizer, "schedule": schedule}
    first = 0
    if arguments.checkpoint and Path(arguments.checkpoint).exists():
        state = torch.load(arguments.checkpoint)
        for name, part in kept.items():
            part.load_state_dict(state[name])
        first = state["epoch"]

    for epoch in range(first, arguments.epochs):
        total = 0.0
        for points, labels in loader:
            loss = loss_of(model.log_odds(points), labels)
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(model.parameters(), max_norm=1.0)
            optimizer.step()
            schedule.step()
            average.update_parameters(model)
            total += loss.item()
        print(f"epoch {epoch + 1}: loss {total / len(loader):.4f}")
        if arguments.checkpoint:
            state = {name: part.state_dict() for name, part in kept.items()}
            torch.save(state | {"epoch": epoch + 1}, arguments.checkpoint)

    average.module.requires_grad_(False)
    average.module.save(arguments.output)
    print(f"{len(samples)} points -> {len(model)} clusters -> {arguments.output}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scans")
    parser.add_argument("-o", "--output", default="map.pt")
    parser.add_argument("--epochs", type=int, default=8)
    parser.add_argument("--batch", type=int, default=4096)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--checkpoint", help="written every epoch; the run resumes from it if it exists"
    )
    main(parser.parse_args())
