"""Frames per second of the viewer in Chromium with software rendering.

Usage: python benchmarks/viewing.py [--data DATA] [--set balm_realworld] [--picture PICTURE]

The map of a whole set and its points are shown, within the budgets of the page. The view is turned
with the mouse for some
seconds, and the frames of the page are counted; all drawing is done by the processor (SwiftShader).
"""

import argparse
import contextlib
import os
import sys
import time
from pathlib import Path

from conditions import conditions, describe
from playwright.sync_api import Page

from lardhm_torch import LardHilbertMap, load_scans, sample_rays
from lardhm_torch.viewing.viewer import MapViewer, ViewConfig

sys.path.insert(0, str(Path(__file__).parents[1] / "scripts"))
from chromium import chromium

SECONDS = 12
COUNT = """() => { window.frames_drawn = 0;
    const next = () => { window.frames_drawn++; requestAnimationFrame(next); };
    requestAnimationFrame(next); }"""


def processor_seconds() -> float:
    """Processor time that the browser has used so far (Linux)."""
    ticks, parents, names = {}, {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            name, rest = stat.read_text().rsplit(")", 1)
            words, number = rest.split(), int(name.split()[0])
            parents[number], names[number] = int(words[1]), name
            ticks[number] = int(words[11]) + int(words[12])
    ours = {os.getpid()}
    while more := {n for n, parent in parents.items() if parent in ours and n not in ours}:
        ours |= more
    return sum(ticks[n] for n in ours if "chrom" in names[n]) / os.sysconf("SC_CLK_TCK")


def turned(page: Page) -> tuple[float, float, float]:
    """Frames a second, the longest wait for a move of the mouse [s], and processor time a frame [s],
    while the view turns."""
    page.evaluate("window.frames_drawn = 0")
    start, longest, step, taken = time.perf_counter(), 0.0, 0, processor_seconds()
    page.mouse.move(300, 450)
    page.mouse.down()
    while time.perf_counter() - start < SECONDS:
        before = time.perf_counter()
        page.mouse.move(300 + 8 * (step % 40), 450)
        page.evaluate("() => new Promise(requestAnimationFrame)")
        longest, step = max(longest, time.perf_counter() - before), step + 1
    page.mouse.up()
    frames = page.evaluate("window.frames_drawn")
    taken = (processor_seconds() - taken) / max(frames, 1)
    return frames / (time.perf_counter() - start), longest, taken


def main() -> None:
    """Open the viewer and rotate it with everything, only the points, and only the surface."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--set", default="balm_realworld")
    parser.add_argument("--most-points", type=int, default=ViewConfig().max_points)
    parser.add_argument(
        "--picture", type=Path, help="file to write; screenshots are written beside it"
    )
    arguments = parser.parse_args()
    print(describe(conditions()))
    scans = load_scans(arguments.data / arguments.set / "scans.npz")
    samples = sample_rays(scans)
    model = LardHilbertMap().fit(samples.points, samples.labels)
    viewer = MapViewer(model, scans, ViewConfig(port=8123, max_points=arguments.most_points))
    viewer.wait()
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 760})
        page.set_default_timeout(300_000)
        page.goto(viewer.url)
        page.get_by_text("surface of").wait_for()
        print(page.get_by_text("surface of").text_content())
        page.wait_for_timeout(8000)
        page.evaluate(COUNT)
        for name, label in (("all", None), ("surface", "show points"), ("nothing", "show surface")):
            if label is not None:
                page.get_by_label(label).click()
                page.wait_for_timeout(1500)
            if arguments.picture is not None:
                page.screenshot(
                    path=arguments.picture.with_stem(f"{arguments.picture.stem}-{name}")
                )
            rate, longest, taken = turned(page)
            print(
                f"{name:<18}{rate:>7.1f} frames a second, longest wait {longest:.2f} s, "
                f"{taken:.2f} s of the processors a frame",
                flush=True,
            )
    viewer.close()


if __name__ == "__main__":
    main()
