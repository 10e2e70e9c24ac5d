"""The page of tables and figures, made from the stored results of the experiments."""

from __future__ import annotations

import json
import statistics
from pathlib import Path
from typing import Any

from contenders import BASELINES, OURS

STAGES = {  # Table I of the paper: mean [ms] of 10 runs on 8 cores of 2.5 GHz
    "clustering": 471.0,
    "length-scales": 23.0,
    "training features": 116.0,
    "SGD, one pass": 4.0,
    "SGD, as `fit`": None,
    "grid features": 873.0,
    "grid query": 17.0,
    "grid features and query, fused": 890.0,
}
METHODS = {  # Table II of the paper: train, query [ms]
    "Original HM": (3440.0, 25473.0),
    "Local GP": (7241.0, 72121.0),
    "LARD-HM": (216.0, 849.0),
    "OctoMap": (130.0, 11.0),
}
CORRECT = {  # Table III of the paper: [%] of correct classification, RIEGL and LSD-SLAM
    "OctoMap": (74.76, 68.23),
    "Original HM": (81.48, 73.47),
    "LARD-HM": (89.25, 83.89),
}
SETS = {"riegl_vz400i_rtls": "RIEGL", "sevenscenes_semidense": "LSD-SLAM"}


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def write_page(folder: Path, results: dict[str, Any]) -> None:
    """README.md in the folder: every section whose results are there."""
    sections = {
        "conditions": _conditions, "table_one": _table_one, "table_two": _table_two,
        "table_three": _table_three, "figure_one": _figure_one, "figure_two": _figure_two,
        "figure_three": _figure_three, "figure_four": _figure_four, "figure_five": _figure_five,
        "figure_six": _figure_six, "log_losses": _log_losses,
        "variance_and_distance": _variance, "references": _references,
    }  # fmt: skip
    parts = [write(results[name]) for name, write in sections.items() if name in results]
    text = "\n\n".join([_HEAD, *parts]) + "\n"
    (folder / "README.md").write_text(text)


def load_results(folder: Path) -> dict[str, Any]:
    """What earlier runs have stored."""
    path = folder / "results.json"
    return json.loads(path.read_text()) if path.exists() else {}


def save_results(folder: Path, results: dict[str, Any]) -> None:
    """Store all results."""
    (folder / "results.json").write_text(json.dumps(results, indent=1) + "\n")


_HEAD = """# The paper's experiments

This page reproduces every table and figure of Guizilini & Ramos, *Large-Scale 3D Scene Reconstruction with Hilbert Maps*
(IROS 2016), with this library. The paper's values ("theirs") stand beside the values measured here ("ours"); experiments
that the paper does not contain follow. One command writes this page:

```sh
python scripts/reproduce_paper.py --data DATA    # DATA: one folder per set, with its scans.npz
```

The simulated room is the paper's own data. Its RIEGL and LSD-SLAM scans are not public. A forest scan from a RIEGL scanner
(`riegl_vz400i_rtls`) and the semi-dense pixels of RGB-D frames (`sevenscenes_semidense`) replace them, so compare only
orders of magnitude for these sets. All methods are trained on the same labeled samples of the same rays (OctoMap: on the
rays). **Settings of the baselines are chosen on a validation set, a fifth of the training rays; LARD-HM has its default
settings everywhere.** These defaults were chosen on this and seven other sets, on some of the same splits. Original HM is
trained with the same optimizer as LARD-HM (balanced, preconditioned SGD) instead of the paper's plain SGD, which makes it a
stronger baseline than in the paper."""


def _conditions(result: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in result["versions"].items())
    seconds = sum(result["seconds"].values())
    return (
        f"Measured on {result['processor']}, {result['threads']} thread(s), load "
        f"{result['load']:.1f} at the start; {versions}; all experiments took {seconds / 60:.0f} "
        f"minutes. {result['note']} On a loaded machine, compare ratios only."
    )


def _ms(value: dict[str, float]) -> str:
    return f"{value['mean']:.1f} ± {value['std']:.1f}"


def _table_one(result: dict[str, Any]) -> str:
    rows = []
    for stage, theirs in STAGES.items():
        ours = result[stage]
        ratio = "" if theirs is None else f"{ours['mean'] / theirs:.3f}"
        rows.append([stage, "" if theirs is None else f"{theirs:.0f}", _ms(ours), ratio])
    text = table(["stage", "theirs [ms]", "ours [ms], 10 runs", "ours / theirs"], rows)
    return (
        "## Table I: stages of LARD-HM (82,842 points, m = 500, k = 5, 638,683 queries)\n\n"
        + text
        + "\n\n"
        "Both use the same points, m (number of clusters) and k (nearest clusters per point); the paper used 8 cores. `fit` "
        "makes four preconditioned passes, as the extra row shows, and the paper makes one plain pass. `model(points)` "
        "computes features and query in one fused step, which is the last row."
    )


def _table_two(result: dict[str, Any]) -> str:
    ours = result["LARD-HM"]
    rows = []
    for name, (train, query) in METHODS.items():
        cells = [name]
        for stage, theirs in (("train", train), ("query", query)):
            time = result[name][stage]
            times = time["median"] / ours[stage]["median"]
            lead = theirs / METHODS["LARD-HM"][0 if stage == "train" else 1]
            cells += [
                f"{theirs:.0f}",
                _ms(time),
                f"{time['mean'] / theirs:.3f}",
                f"{times:.1f} ({lead:.2f})",
            ]
        rows.append([*cells, str(result[name]["train"]["runs"])])
    head = ["method"]
    for stage in ("training", "query"):
        head += [f"{stage}: theirs [ms]", "ours [ms]", "ours / theirs", "x LARD-HM, ours (theirs)"]
    faster = (
        "is faster"
        if result["OctoMap"]["train"]["median"] < ours["train"]["median"]
        else "is slower"
    )
    return (
        "## Table II: four methods (82,842 training points, 638,683 query points)\n\n"
        + table([*head, "runs"], rows)
        + "\n\n"
        "Means with standard deviations. The ratios to LARD-HM are ratios of medians, from one run in which the methods are "
        "timed alternately. OctoMap is queried with `getLabels` of its Python package; the paper times the C++ look-up (11 ms), "
        f"which does not interpolate. In this run, inserting rays into OctoMap {faster} than training LARD-HM."
    )


def _percent(cell: dict[str, float]) -> str:
    return f"{100 * cell['mean']:.2f} ± {100 * cell['std']:.2f}"


def _table_three(result: dict[str, Any]) -> str:
    rows, notes = [], []
    for name in (*BASELINES, *OURS):
        cells = [name]
        for column, set_name in enumerate(SETS):
            cell = result[set_name]["accuracy"][name]
            theirs = CORRECT.get(name.split(",")[0], (None, None))[column]
            ratio = "" if theirs is None else f"{100 * cell['paper']['mean'] / theirs:.3f}"
            cells += [
                "" if theirs is None else f"{theirs:.2f}",
                _percent(cell["paper"]),
                ratio,
                _percent(cell["unif"]),
            ]
        rows.append(cells)
    head = ["method"]
    for set_name, label in SETS.items():
        head += [
            f"{label}, theirs [%]",
            f"{set_name}, ours [%]",
            "ours / theirs",
            "ours, `unif` [%]",
        ]
        chosen = "; ".join(f"{n}: {s}" for n, s in result[set_name]["settings"].items())
        notes.append(f"- {set_name}: {chosen}; " + _winner(result[set_name]["accuracy"], "paper"))
    return (
        "## Table III: correct classification on real scans, half of the rays for training\n\n" + table(head, rows)
        + "\n\nSettings chosen by validation, and differences in accuracy:\n\n" + "\n".join(notes)
    )  # fmt: skip


def _winner(scores: dict[str, Any], kind: str) -> str:
    """Who is ahead and by how much, in a sentence, over the splits that both have seen."""
    means = {name: scores[name][kind]["mean"] for name in scores}
    rival = max(BASELINES, key=means.__getitem__)
    sentences = []
    for name in OURS:
        gaps = [
            100 * (a - b)
            for a, b in zip(
                scores[name][kind]["values"], scores[rival][kind]["values"], strict=False
            )
        ]
        gap = statistics.fmean(gaps)
        error = statistics.stdev(gaps) / len(gaps) ** 0.5 if len(gaps) > 1 else 0.0
        verdict = "ahead by" if gap > 0 else "**behind** by"
        sentences.append(f"{name} {verdict} {abs(gap):.2f} ± {error:.2f}")
    return f"against the best baseline, {rival}: " + ", ".join(sentences) + " points."


def _figure_one(result: dict[str, Any]) -> str:
    scores = ", ".join(f"{name} {100 * v:.1f} %" for name, v in result["training accuracy"].items())
    return (
        f"## Fig. 1: the rings ({result['points']} points, {result['clusters']} clusters)\n\n"
        "![points, clusters with ellipses, k = 1, k = 5, no LARD](figure_1.png)\n\n"
        f"Correctly classified training points: {scores}. As in the paper, boundaries are jagged with k = 1 and smooth with "
        "k = 5. Round kernels of equal size (no LARD) also cover the gaps inside the rings, where there are no data."
    )


def _figure_two(result: dict[str, Any]) -> str:
    return """## Fig. 2: four methods on the simulated room

| OctoMap (0.1 m) | Original HM | Local GP | LARD-HM |
| --- | --- | --- | --- |
| ![OctoMap](figure_2_octomap.png) | ![Original HM](figure_2_original_hm.png) | ![Local GP](figure_2_local_gp.png) | ![LARD-HM](figure_2_lard_hm.png) |
| | | colored by its variance: ![variance of Local GP](figure_2_local_gp_variance.png) | colored by its variance: ![variance of LARD-HM](figure_2_lard_hm_variance.png) |

The surface at level 1/2 on the grid of Table II; for LARD-HM by `extract_mesh`, which drops faces that no data support (the second row keeps them). The second row is
the paper's Fig. 2f (dark: certain, yellow: uncertain), and the same for LARD-HM, which the paper did not explore."""


def _figure_three(result: dict[str, Any]) -> str:
    parts = ["## Fig. 3: accuracy against the fraction of training rays (simulated room)"]
    parts.append("![accuracy against fraction of training rays](figure_3.png)")
    for kind, title in (
        ("paper", "The paper's own test [%]"),
        ("unif", "Free points at least 0.2 m before the hit [%]"),
    ):
        rows = []
        for share, scores in result["accuracy"].items():
            cells = [_percent(scores[name][kind]) for name in (*OURS, *BASELINES)]
            rows.append(
                [f"{100 * float(share):.0f} %", *cells, str(len(scores[OURS[0]][kind]["values"]))]
            )
        parts += [f"{title}:", table(["training rays", *OURS, *BASELINES, "seeds"], rows)]
        parts.append(
            "\n".join(
                f"- {100 * float(s):.0f} %: {_winner(v, kind)}"
                for s, v in result["accuracy"].items()
            )
        )
    chosen = [
        f"- at {100 * float(a):.0f} %: " + "; ".join(f"{n}: {s}" for n, s in found.items())
        for a, found in result["settings"].items()
    ]
    parts += ["Settings chosen by validation:", "\n".join(chosen)]
    parts.append(
        "The paper's values at 99 % and 5 % are: LARD-HM 100 and 78, Original HM 97 and 62, OctoMap 89 and 55, Local GP 82 and "
        "66. Ours differ for three reasons. (1) The hits scatter by 5 cm about the walls, and 5 to 6 % of the free test points lie "
        "inside that band. So 97.5 to 98 % is an upper bound for every method in this test, and 100 % cannot be reproduced. "
        "(2) At 5 %, the paper uses m = 500 for 2,071 hits, which leaves few points per cluster; here m depends on the number of "
        "points. (3) The baselines have tuned settings, free samples near the surface and, for Original HM, our optimizer. "
        "Therefore the paper's large advantage over Original HM and Local GP in *accuracy* is not reproduced: near the upper bound "
        "the three differ by a few tenths of a point."
    )
    return "\n\n".join(parts)


def _figure_four(result: dict[str, Any]) -> str:
    few, many = result["m1500"], result["default"]
    return (
        f"## Fig. 4: a whole terrestrial scan ({result['points']:,} samples)\n\n"
        f"| m = 1500, as the paper ({few['clusters']} clusters, fit {few['fit_s']:.1f} s, mesh {few['mesh_s']:.1f} s) "
        f"| default m ({many['clusters']} clusters, fit {many['fit_s']:.1f} s, mesh {many['mesh_s']:.1f} s) |\n| --- | --- |\n"
        "| ![m = 1500](figure_4_m1500.png) | ![default](figure_4_default.png) |"
    )


def _figure_five(result: dict[str, Any]) -> str:
    sizes = result["clusters"]
    return (
        f"## Fig. 5: built keyframe by keyframe ({result['keyframes']} keyframes, {result['rays']:,} rays)\n\n"
        "![incremental map](figure_5.png)\n\n"
        f"Each keyframe may add 100 clusters. In this library, new points join existing clusters if they are near enough, and only "
        f"the others form new clusters; Algorithm 2 clusters all new points and then merges. The map has {sizes[0]} clusters after "
        f"the first keyframe and {sizes[-1]} after the last one, of at most {100 * result['keyframes']}. An update takes "
        f"{result['update_s']:.2f} s (median)."
    )


def _figure_six(result: dict[str, Any]) -> str:
    from shares import FIG6_CLUSTERS, FIG6_SHARES

    rows = [[SETS[name], *(f"{100 * v:.1f}" for v in result["shares"][name])] for name in SETS]
    shares = table(
        ["accuracy [%] by training rays", *(f"{100 * s:.0f} %" for s in FIG6_SHARES)], rows
    )
    rows = [[SETS[name], *(f"{100 * v:.1f}" for v in result["clusters"][name])] for name in SETS]
    rows += [[f"{SETS[name]}, actual clusters", *map(str, result["made"][name])] for name in SETS]
    clusters = table(["accuracy [%] by m", *map(str, FIG6_CLUSTERS)], rows)
    return (
        "## Fig. 6: sparsity and number of clusters (LARD-HM)\n\n"
        "![accuracy against fraction of training rays and clusters](figure_6.png)\n\n"
        f"{shares}\n\n{clusters}\n\n"
        "The paper's curves level off at about 91 %, from 70 % of the data and from 1000 clusters on (RIEGL). Ours have the same "
        "shape at a higher level. Clusters of fewer than five points are merged, so the actual number can be below m."
    )


def _log_losses(result: dict[str, Any]) -> str:
    rows = []
    for name, shares in result.items():
        for share, kinds in shares.items():
            cells = []
            for kind in ("unif", "near", "paper"):
                plain, bayes = kinds[kind]["plain"], kinds[kind]["bayes"]
                cells.append(f"{plain:.4f} → {bayes:.4f} ({100 * (bayes / plain - 1):+.1f} %)")
            rows.append([name, f"{100 * float(share):.0f} %", *cells])
    changes = {
        kind: [k[kind]["bayes"] / k[kind]["plain"] - 1 for s in result.values() for k in s.values()]
        for kind in ("unif", "near", "paper")
    }
    summary = "; ".join(
        f"`{kind}`: better on {sum(c < 0 for c in values)} of {len(values)}, at worst {100 * max(values):+.1f} %"
        for kind, values in changes.items()
    )
    return (
        "## Beyond the paper: uncertainty\n\n"
        "`fit_uncertainty` computes the variance of every weight (variational logistic regression, cost linear in N k). `variance` "
        "and `bayesian_probability` use it; `model(points)` is not changed. Log-loss on held-out rays, without → with uncertainty:\n\n"
        + table(["set", "training rays", "`unif`", "`near`", "paper's test"], rows) + f"\n\nIn short, {summary}. "
        "Most of the gain is due to the posterior mean: `fit` stops early and regularizes, so its probabilities are underconfident, "
        "and the factors learned from left-out training points correct that. The variance alone changes little. Just in front of "
        "surfaces of sparse lidar scans the map is wrong rather than underconfident, and larger factors would increase the loss; "
        "there the factors stay near 1. The constants of the method (the same for all sets) were chosen on the same sets with other "
        "splits, seeds 0 and 5, in about two hundred trials. The split of this table was not used for that."
    )  # fmt: skip


def _variance(result: dict[str, Any]) -> str:
    rows = [
        [name, f"{100 * kind['undecided']:.0f} %", f"{kind['variance']:.3f}"] for name, kind in result["kinds"].items()
    ]  # fmt: skip
    return (
        "![variance against distance, and a contradictory corner](uncertainty.png)\n\n"
        f"Rank correlation of variance with distance to the nearest observation (simulated room): {result['correlation_near']:.2f} "
        f"within 0.5 m, and {result['correlation']:.2f} over all random points up to 1 m outside the map, most of which have the "
        "variance of the prior, 0.3. To compare contradictory data with missing data, the labels of one corner are replaced by "
        "random ones:\n\n"
        + table(["points", "probability between 0.2 and 0.8", "median variance"], rows)
    )  # fmt: skip


def _references(result: dict[str, Any]) -> str:
    rows = []
    for name, seconds in result["seconds"].items():
        cells = [
            f"{100 * a:.1f} % in {s:.2f} s"
            for a, s in zip(result["accuracy"][name], seconds, strict=True)
        ]
        rows.append([name, *cells])
    for name, seconds in result["solving"].items():
        rows.append([f"{name}, solution alone", *(f"{s:.3f} s" for s in seconds)])
    growth = ", ".join(f"{name} N^{power:.1f}" for name, power in result["growth"].items())
    return (
        "## Few points: exact Gaussian processes of the introduction (GPOM, GPIS) and global features (Fourier, Nystroem)\n\n![exact processes](exact_gps.png)\n\n"
        "Accuracy (the paper's test) and training time on the same random points of the simulated room:\n\n"
        + table(["method", *(f"{n} points" for n in result["sizes"])], rows)
        + f"\n\nBelow 4000 points, learning the hyperparameters (always on 300 points) takes most of the time. The time of the exact "
        f"solution alone grows, over the last three sizes, as {growth}; in theory it is cubic, which is too slow for whole scans. With few "
        "points, several of these methods are more accurate than LARD-HM, because a cluster needs about fifteen hits."
    )
