"""Take a screenshot of the viewer: fit a map and open the viewer in Chromium.

Usage: python scripts/screenshot_viewer.py SCANS [PICTURE]    (default: docs/pictures/viewer.png)
"""

import sys
from pathlib import Path

from chromium import chromium

from lardhm_torch import LardHilbertMap, load_scans, sample_rays
from lardhm_torch.viewing.viewer import MapViewer


def main(scans_path: str, picture: Path) -> None:
    """Show the surface and the sensors; points would hide a room behind its ceiling."""
    scans = load_scans(scans_path)
    samples = sample_rays(scans)
    viewer = MapViewer(LardHilbertMap().fit(samples.points, samples.labels), scans)
    with chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 760})
        page.set_default_timeout(600_000)
        page.goto(viewer.url)
        page.get_by_text("surface of").wait_for()
        if page.locator(".mantine-Notification-closeButton").count():
            page.locator(".mantine-Notification-closeButton").first.click()
        page.get_by_label("show points").click()
        page.wait_for_timeout(15_000)
        page.screenshot(path=picture)
    viewer.close()


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2] if len(sys.argv) > 2 else "docs/pictures/viewer.png"))
