"""The report of a real run: its schema, and its page in a browser on a desk, a phone and in the dark."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import results
from ortho_pipeline.options import PointOptions, SurfaceOptions

ROOT = Path(__file__).resolve().parent.parent.parent
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

#: Where the browser itself calls, whatever page it shows (and does not get through to, in these tests).
BROWSERS_OWN = {"accounts.google.com", "clients2.google.com", "update.googleapis.com", "www.google.com"}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, results.Result | results.CompareResult]:
    """Return the results of rectify and compare on the sample scene."""
    folder, sample = tmp_path_factory.mktemp("report"), ROOT / "sample_data"
    image, surface = sample / "scene.tif", SurfaceOptions(dem=sample / "dem.tif")
    points = PointOptions(gcps=sample / "gcps.geojson")
    rectified = commands.rectify(
        image, folder / "rectify", points=PointOptions(gcps=sample / "gcps.geojson", correction="affine"),
        surface=surface, command="ortho rectify",
    )  # fmt: skip
    compared = commands.compare(image, points, folder=folder / "compare", surface=surface)
    bare = commands.rectify(image, folder / "bare", surface=surface)
    return {"rectify": rectified, "compare": compared, "bare": bare}


@pytest.mark.parametrize("which", ["rectify", "compare", "bare"])
def test_report_has_its_published_schema(made, which):
    schema = json.loads((ROOT / "docs" / "report.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    document = json.loads(made[which].files["report"].read_text())
    jsonschema.validate(document, schema, cls=jsonschema.Draft202012Validator)
    document["surplus"] = 1
    with pytest.raises(jsonschema.ValidationError, match="surplus"):
        jsonschema.validate(document, schema, cls=jsonschema.Draft202012Validator)


def test_plots_of_a_report_from_the_command_line(made, tmp_path):
    report = str(made["compare"].files["report"])
    done = CliRunner().invoke(cli, ["report", report, "--plots", str(tmp_path / "plots"), "--json"])
    assert done.exit_code == 0, done.stderr
    files = json.loads(done.stdout)["files"]
    drawn = {"residuals", "directions", "heights", "correlation", "neighbours", "relative", "comparison"}
    assert set(files) == drawn
    assert all(Path(path).read_text().startswith("<svg") for path in files.values())


def browse(page: Path, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a headless browser with a new profile; its log goes to stderr."""
    profile = folder / "profile"
    shutil.rmtree(profile, ignore_errors=True)
    command = [
        str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
        "--host-resolver-rules=MAP * ~NOTFOUND",
        f"--user-data-dir={profile}", "--enable-logging=stderr", "--v=0", *arguments, page.resolve().as_uri(),
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt install chromium)")
@pytest.mark.parametrize("which", ["rectify", "compare"])
def test_page_opens_in_a_browser_without_errors_or_requests(made, tmp_path, which):
    log = tmp_path / "net.json"
    done = browse(made[which].files["html"], tmp_path, "--dump-dom", f"--log-net-log={log}")
    assert "CONSOLE" not in done.stderr
    plots = set(re.findall(r'<svg[^>]*data-plot="(\w+)"', done.stdout))
    assert {"residuals", "directions", "heights", "correlation", "neighbours", "relative"} <= plots
    assert ("comparison" in plots) is (which == "compare")
    asked = set(re.findall(r'"url":"((?:http|ws|ftp)s?://[^/"]*)', log.read_text()))
    assert {url.split("://")[1] for url in asked} <= BROWSERS_OWN


LOOKS: dict[str, Any] = {
    "desktop": ((1100, 1400), (), (255, 255, 255)),
    "phone": ((500, 1000), (), (255, 255, 255)),
    "dark": ((1100, 1400), ("--force-dark-mode", "--blink-settings=preferredColorScheme=0"), (0x15, 0x18, 0x1B)),
}


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (apt install chromium)")
@pytest.mark.parametrize("look", LOOKS)
def test_page_is_drawn_in_its_colours_and_does_not_overflow(made, tmp_path, look):
    (width, height), arguments, paper = LOOKS[look]
    shot = tmp_path / "shot.png"
    browse(
        made["rectify"].files["html"], tmp_path, f"--window-size={width},{height}", f"--screenshot={shot}", *arguments
    )
    pixels = gdal.Open(str(shot)).ReadAsArray()[:3]
    assert tuple(pixels[:, 2, 2].tolist()) == paper
    # Nothing but paper along the right border: no table or figure is wider than the page.
    border = pixels[:, :, -3]
    assert (border == border[:, :1]).all()
    assert pixels.std() > 10
