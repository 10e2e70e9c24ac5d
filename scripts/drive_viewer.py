"""Drive `lardhm view` in Chromium: time from the slider to the new surface, Ctrl-C, and a 2-D page.

Usage: python scripts/drive_viewer.py DATA [-o out/viewer]
DATA is a folder with one folder per set, which contains `scans.npz`.

A default map of `balm_realworld` (half of 120,000 rays) is shown. A surface counts as shown with the
first frame that draws its vertices after they were uploaded to WebGL; times are those of the page's
own clock since the key that moves the slider. Screenshots are written to look at.
"""

import argparse
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from chromium import chromium
from playwright.sync_api import Page

from lardhm_torch import LardHilbertMap, load_scans, sample_rays, save_scans, split_rays
from lardhm_torch.evaluation.held_out import protocol_rays

PATIENCE = 120_000  # [ms]
MOVES = 6
INTERRUPTS = (0.05, 0.2, 0.4, 0.8)  # [s] after a change
WATCH = """
window.shown = [];  // times at which a frame ended that drew newly uploaded vertices
const upload = WebGL2RenderingContext.prototype.bufferData;
let isNew = false;
WebGL2RenderingContext.prototype.bufferData = function (target, data, ...rest) {
    if ((data?.byteLength ?? 0) > 50000 && !isNew) {
        isNew = true;
        requestAnimationFrame(() => { window.shown.push(performance.now()); isNew = false; });
    }
    return upload.call(this, target, data, ...rest);
};
window.addEventListener("keydown", () => { window.moved = performance.now(); }, true);
"""


def fit_map(data: Path, name: str, folder: Path, rays: int) -> tuple[Path, Path]:
    """Files of a default map of half of the rays of a set, and of these rays."""
    path = data / name / "scans.npz"
    scans = load_scans(path)
    if bool((scans.ends[:, 2] == scans.ends[0, 2]).all()):
        scans = scans.drop_constant_column()
    train, _ = split_rays(protocol_rays(scans, rays), 0.5, 0)
    samples = sample_rays(train, seed=0)
    LardHilbertMap(train.dim).fit(samples.points, samples.labels, seed=0).save(
        folder / f"{name}.pt"
    )
    save_scans(train, folder / f"{name}.npz")
    return folder / f"{name}.pt", folder / f"{name}.npz"


@contextmanager
def view(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`lardhm view` in a process of its own, and the address that it prints."""
    words = [sys.executable, "-m", "lardhm_torch.cli", "view", *map(str, arguments)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process, next(line.split()[0] for line in process.stdout if "Ctrl-C" in line)
    finally:
        process.kill()
        process.wait()


def open_page(page: Page, url: str) -> None:
    """Open the page, and wait for the first final surface or the picture of a flat map."""
    page.set_default_timeout(PATIENCE)
    page.add_init_script(WATCH)
    page.goto(url)
    page.get_by_text("Middle of the map").wait_for()
    page.wait_for_timeout(5000)


def time_moves(page: Page) -> tuple[list[float], list[float]]:
    """Seconds from each move of the slider to the first and to the final surface."""
    first, final = [], []
    page.get_by_role("slider").nth(0).focus()
    for number in range(MOVES):
        page.evaluate("window.shown = []")
        page.keyboard.press("ArrowRight" if number < MOVES - 1 else "Home")
        page.wait_for_function("window.shown.length >= 2")
        page.wait_for_timeout(1500)
        moved, shown = page.evaluate("[window.moved, window.shown]")
        first.append((shown[0] - moved) / 1000)
        final.append((shown[-1] - moved) / 1000)
    return first, final


def interrupt(process: subprocess.Popen[str]) -> float:
    """Seconds from Ctrl-C to the end of the process."""
    start = time.perf_counter()
    process.send_signal(signal.SIGINT)
    if process.wait(60) != 0:
        raise RuntimeError(f"lardhm view ended with exit code {process.returncode}")
    return time.perf_counter() - start


def main() -> None:
    """Print the times and write the screenshots."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/viewer"))
    arguments = parser.parse_args()
    folder: Path = arguments.output
    folder.mkdir(parents=True, exist_ok=True)
    hall, _ = fit_map(arguments.data, "balm_realworld", folder, 120_000)
    flat, hits = fit_map(arguments.data, "hilbert2015_intel", folder, 160_000)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 760})
        with view(hall) as (process, url):
            open_page(page, url)
            page.screenshot(path=folder / "hall.png")
            first, final = time_moves(page)
            page.screenshot(path=folder / "moved.png")
            print("slider to first surface [s]:", *(f"{s:.2f}" for s in first))
            print("slider to final surface [s]:", *(f"{s:.2f}" for s in final))
            print(f"medians: {statistics.median(first):.2f} s, {statistics.median(final):.2f} s")
            print(f"Ctrl-C at rest: {interrupt(process):.2f} s")
        for wait in INTERRUPTS:
            page = browser.new_page(viewport={"width": 1200, "height": 760})
            with view(hall) as (process, url):
                open_page(page, url)
                page.get_by_role("slider").nth(0).focus()
                page.keyboard.press("ArrowRight")
                time.sleep(wait)
                print(f"Ctrl-C {wait} s after a move: {interrupt(process):.2f} s")
            page.close()
        for wait in INTERRUPTS:
            with view(hall) as (process, _):
                time.sleep(wait)
                print(f"Ctrl-C {wait} s after the start: {interrupt(process):.2f} s")
        page = browser.new_page(viewport={"width": 1200, "height": 760})
        with view(flat, hits) as (process, url):
            open_page(page, url)
            page.screenshot(path=folder / "flat.png")
            for label in ("show probability", "show points"):
                page.get_by_label(label).click()
                page.wait_for_timeout(2000)
                page.screenshot(path=folder / f"flat without {label.split()[1]}.png")


if __name__ == "__main__":
    main()
