"""Draw the pictures of docs/report.md from the sample scene and the stereo pair: ``make images`` (Chromium)."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from playwright.sync_api import sync_playwright

from ortho_pipeline import commands
from ortho_pipeline.commands import block as blocks
from ortho_pipeline.options import BlockOptions, PointOptions, SurfaceOptions

ROOT = Path(__file__).resolve().parent.parent
SAMPLE, IMAGES = ROOT / "sample_data", ROOT / "docs" / "images"


def main() -> None:
    """Take pictures of the report of the sample scene (first screen, chips) and of that of the stereo pair."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as started:
        points, surface = PointOptions(gcps=SAMPLE / "gcps.geojson"), SurfaceOptions(dem=SAMPLE / "dem.tif")
        made = commands.rectify(SAMPLE / "scene.tif", folder, points=points, surface=surface)
        browser = started.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 760})
        page.goto(made.files["html"].resolve().as_uri())
        page.screenshot(path=IMAGES / "report.jpg", type="jpeg", quality=80)
        page.locator(".measured").screenshot(path=IMAGES / "report-chips.jpg", type="jpeg", quality=80)
        pair = [SAMPLE / "cartosat" / name for name in ("BANDF.tif", "BANDA.tif")]
        options = BlockOptions(points=SAMPLE / "cartosat" / "points.csv", correction="shift")
        page = browser.new_page(viewport={"width": 1280, "height": 760})
        page.goto(blocks.adjust(pair, Path(folder) / "block", options).files["html"].resolve().as_uri())
        page.screenshot(path=IMAGES / "report-block.jpg", type="jpeg", quality=80)
        browser.close()


if __name__ == "__main__":
    main()
