"""Fine-tune the length scales of a saved map on new scans; centers and weights are kept.

Usage: python scripts/finetune.py map.pt SCANS -o tuned.pt [--epochs 4]
"""

import argparse

from lardhm_torch import LardHilbertMap, TuneConfig, fine_tune, load_scans, sample_rays


def main(arguments: argparse.Namespace) -> None:
    """Load, tune, save."""
    model = LardHilbertMap.load(arguments.map)
    scans = load_scans(arguments.scans)
    samples = sample_rays(scans, seed=arguments.seed)
    losses = fine_tune(
        model,
        samples.points,
        samples.labels,
        resample=lambda epoch: sample_rays(scans, seed=arguments.seed + epoch),
        config=TuneConfig(epochs=arguments.epochs, tune_weights=False, tune_centers=False),
        seed=arguments.seed,
        progress=True,
    )
    model.save(arguments.output)
    print(f"log-loss {losses[0]:.4f} -> {losses[-1]:.4f} -> {arguments.output}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("map")
    parser.add_argument("scans")
    parser.add_argument("-o", "--output", default="tuned.pt")
    parser.add_argument("--epochs", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    main(parser.parse_args())
