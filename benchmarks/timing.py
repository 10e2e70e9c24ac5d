"""Time several systems alternately, and format the results as a table."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

PAUSE = 0.02  # [s] before each run: threads of the run before may still be spinning


class Contender(NamedTuple):
    """A system to be timed: its name, and a call that runs it once."""

    name: str
    run: Callable[[], Any]


def compare(
    title: str, contenders: Sequence[Contender], repeats: int, items: int, item: str = "point"
) -> dict[str, Any]:
    """Warm up all systems, then time them alternately (A B A B); ratios are relative to the first.

    Args:
        title: head of the table.
        contenders: ours first.
        repeats: timed runs of each.
        items: how many points (or the like) one run answers for.
        item: what they are.
    """
    for contender in contenders:
        contender.run()
    seconds: dict[str, list[float]] = {contender.name: [] for contender in contenders}
    for _ in range(repeats):
        for contender in contenders:
            time.sleep(PAUSE)
            start = time.perf_counter()
            contender.run()
            seconds[contender.name].append(time.perf_counter() - start)
    ours = statistics.median(seconds[contenders[0].name])
    rows = [{"name": name, **summary(runs, ours, items)} for name, runs in seconds.items()]
    return {"title": title, "items": items, "item": item, "repeats": repeats, "rows": rows}


def summary(runs: list[float], ours: float, items: int) -> dict[str, float]:
    """Ratio of medians, median, fastest and slowest run [ms], and median per item [ns]."""
    median = statistics.median(runs)
    return {
        "ratio": median / ours,
        "median_ms": 1e3 * median,
        "low_ms": 1e3 * min(runs),
        "high_ms": 1e3 * max(runs),
        "item_ns": 1e9 * median / items,
    }


def format_comparison(result: dict[str, Any]) -> str:
    """Text table of one comparison, ratios first."""
    head = f"{result['title']} ({result['items']:,} {result['item']}s, {result['repeats']} repeats)"
    lines = [head, f"{'x ours':>8}{'median ms':>12}{'min - max ms':>20}{'ns each':>12}"]
    for row in result["rows"]:
        spread = f"{row['low_ms']:.1f} - {row['high_ms']:.1f}"
        lines.append(
            f"{row['ratio']:8.2f}{row['median_ms']:12.2f}{spread:>20}{row['item_ns']:12.1f}"
            f"  {row['name']}"
        )
    return "\n".join([*lines, *result.get("notes", [])])


def format_rows(result: dict[str, Any]) -> str:
    """Text table of figures that are not a comparison, one dictionary per row."""
    columns = list(result["rows"][0])
    cells = [columns, *([_format(row[name]) for name in columns] for row in result["rows"])]
    widths = [max(len(line[place]) for line in cells) + 2 for place in range(len(columns))]
    lines = [
        "".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True))
        for line in cells
    ]
    return "\n".join([result["title"], *lines, *result.get("notes", [])])


def _format(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:,.4g}" if abs(value) < 1000 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) else str(value)
