"""Take the pictures of docs/measure.md: python docs/make_measure_images.py (needs Chromium; about a minute).

Six points of the sample scene are measured by keyboard against an ortho of its own landscape, and four of a pair.
"""

from __future__ import annotations

import re
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import expect, sync_playwright

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests" / "measure"))
SAMPLE, PICTURES = ROOT / "sample_data", ROOT / "docs" / "images"
_FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]


def said(page: Any, text: str) -> None:
    expect(page.locator("#said")).to_have_text(re.compile(text), timeout=60_000)


def opened(browser: Any, address: str, **context: Any) -> Any:
    page = browser.new_page(**context)
    page.goto(address)
    expect(page.locator("#what")).not_to_have_text("loading", timeout=60_000)
    page.focus("#scene")
    return page


def taken(page: Any, name: str) -> None:
    page.wait_for_timeout(4000)
    page.screenshot(path=str(PICTURES / name), type="jpeg", quality=72)


def measured(page: Any, points: int) -> None:
    """Measure points at the places that tell most; every third checks."""
    if "second" not in page.title():
        page.select_option("#correction", "shift-drift")
    page.focus("#scene")
    count = 0
    while count <= points:
        page.focus("#scene")
        page.keyboard.press("n")
        page.keyboard.press("m")
        said(page, "Matched|No match")
        if "No match" in page.inner_text("#said"):
            continue
        count += 1
        if count > points:
            # One more is under way; from farther off the others are seen too.
            page.focus("#scene")
            page.keyboard.press("-")
            return
        page.select_option("#role", "check" if count % 3 == 0 else "control")
        page.focus("#scene")
        page.keyboard.press("Enter")
        said(page, "accepted")


def main(reference: Path, folder: Path, *images: Path) -> None:
    """Take the pictures of one image, or that of several."""
    done = "from ortho_pipeline.cli.program import main; main()"
    server = subprocess.Popen(
        [sys.executable, "-c", done, "measure", str(SAMPLE / "scene.tif"), *map(str, images), "--reference",
         str(reference), "--dem", str(SAMPLE / "dem.tif"), "-o", str(folder / "points.geojson"), "--no-browser"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert server.stdout is not None
    address = server.stdout.readline().split()[-1]
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=chromium, args=_FLAGS)
        page = opened(browser, address, viewport={"width": 1400, "height": 860})
        measured(page, 4 if images else 6)
        taken(page, "measure-block.jpg" if images else "measure.jpg")
        page.close()
        browser.close()
    server.send_signal(signal.SIGINT)
    server.wait(30)


if __name__ == "__main__":
    import conftest

    with tempfile.TemporaryDirectory() as place:
        made = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(place) / "reference.tif"
        if not made.exists():
            conftest.write_reference(conftest.truth_of_sample(), made)
        main(made, Path(place))
        pair = conftest.write_second(conftest.truth_of_sample(), Path(place) / "second.tif")
        (Path(place) / "points.geojson").unlink()
        (Path(place) / "points.geojson.journal").unlink()
        main(made, Path(place), pair.path)
