"""The report of a real run: its schema, and its page in a browser on a desk, a phone and in the dark."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from click.testing import CliRunner

from ortho_pipeline import commands
from ortho_pipeline.batch import runner
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import block as blocks
from ortho_pipeline.commands import results
from ortho_pipeline.options import BlockOptions, PointOptions, SurfaceOptions

ROOT = Path(__file__).resolve().parent.parent.parent
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


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


@pytest.fixture(scope="module")
def block(tmp_path_factory) -> Path:
    """Return the page of the sample's stereo pair."""
    pair = [ROOT / "sample_data" / "cartosat" / name for name in ("BANDF.tif", "BANDA.tif")]
    options = BlockOptions(points=ROOT / "sample_data" / "cartosat" / "points.csv", correction="shift")
    return blocks.adjust(pair, tmp_path_factory.mktemp("block"), options).files["html"]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """Return the page of a run with a scene that failed."""
    folder = tmp_path_factory.mktemp("run")
    for name in ("scene.tif", "scene_RPC.TXT"):
        shutil.copy(ROOT / "sample_data" / name, folder)
    shutil.copy(folder / "scene.tif", folder / "a_scene_without_a_model_and_with_quite_a_long_name.tif")
    text = "defaults: {surface: {height: 800}, output: {resolution: 20}}\nscenes: [{images: '*.tif'}]\n"
    (folder / "pipeline.yaml").write_text(text)
    runner.run(folder / "pipeline.yaml", executor="sequential")
    return folder / "out" / "index.html"


def test_the_page_of_a_comparison_tells_the_next_command(made):
    page = made["compare"].files["html"].read_text(encoding="utf-8")
    # The reason names the model that is nearest, so no other sentence says it again.
    assert "rpc+shift-drift has RMSE" in page
    assert "The next best model is" not in page
    assert (
        "run <code>ortho rectify</code> with the same image, points and heights, and <code>--correction shift</code>"
        in page
    )


def test_a_correction_with_parameters_that_the_points_do_not_justify_is_noted(made):
    document = json.loads(made["rectify"].files["report"].read_text())
    (notice,) = [one for one in document["notices"] if one["code"] == "parameters-not-justified"]
    assert notice["parameters"] == document["adjustment"]["statistics"]["not_justified"]
    assert {"row_per_row", "col_per_col"} <= set(notice["parameters"])
    page = made["rectify"].files["html"].read_text(encoding="utf-8")
    assert "Remove them with <code>--prune</code>." in page
    shift = json.loads(made["compare"].files["report"].read_text())
    assert "parameters-not-justified" not in {one["code"] for one in shift["notices"]}


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


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine (apt install chromium)")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--host-resolver-rules=MAP * ~NOTFOUND"]
        )
        yield browser
        browser.close()


def opened(browser: Any, page: Path, width: int = 1440, **context: Any) -> tuple[Any, list[str]]:
    """Open a page; the list gets whatever it complains of or asks of a network."""
    context = browser.new_context(viewport={"width": width, "height": 900}, **context)
    shown, complaints = context.new_page(), []
    shown.on("console", lambda message: complaints.append(message.text))
    shown.on("pageerror", lambda error: complaints.append(str(error)))
    asked = lambda request: request.url.startswith(("file:", "data:")) or complaints.append(request.url)  # noqa: E731
    shown.on("request", asked)
    shown.goto(page.resolve().as_uri())
    return shown, complaints


@pytest.mark.parametrize("which", ["rectify", "compare", "bare"])
def test_page_fits_every_screen_and_asks_for_nothing(made, browser, which):
    for width in (1440, 1024, 390) if which == "rectify" else (390,):
        page, complaints = opened(browser, made[which].files["html"], width)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert complaints == []
        plots = set(page.eval_on_selector_all("[data-plot]", "all => all.map(one => one.dataset.plot)"))
        page.context.close()
    assert ("ortho" in plots) is (which != "compare")
    assert ("comparison" in plots) is (which == "compare")
    if which != "bare":
        assert {"residuals", "directions", "heights", "correlation", "neighbours", "relative", "locator"} <= plots


@pytest.mark.parametrize("which", ["block", "run"])
@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_pages_of_blocks_and_runs_fit_every_screen(request, browser, tmp_path, which, scheme):
    # A line ends anywhere in a path that has neither spaces nor hyphens.
    text = request.getfixturevalue(which).read_text().replace(str(ROOT), "/" + 60 * "x")
    (tmp_path / "page.html").write_text(text)
    for width in (1440, 1024, 390):
        page, complaints = opened(browser, tmp_path / "page.html", width, color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert complaints == []
        page.context.close()


@pytest.mark.slow
def test_pages_of_matches_and_mosaics_fit_every_screen(browser, tmp_path):
    sample, runner = ROOT / "sample_data", CliRunner()
    given = f"--reference {sample}/reference.tif --dem {sample}/dem.tif"
    lines = [f"match {sample}/scene.tif {given} -o m.geojson --report m.html"]
    for name, box in (("west", "530000 4121500 532000 4123500"), ("east", "531000 4121500 533000 4123500")):
        lines.append(f"rectify {sample}/scene.tif --height 800 -t_srs EPSG:32636 -tr 10 10 -te {box} -o {name}")
    lines.append("mosaic west/scene_ortho.tif east/scene_ortho.tif -o mosaic.tif --seamlines")
    with contextlib.chdir(tmp_path):
        for line in lines:
            done = runner.invoke(cli, line.split())
            assert done.exit_code == 0, done.output
    for name in ("m.html", "mosaic.html"):
        for width in (1440, 1024, 390):
            for scheme in ("light", "dark"):
                page, complaints = opened(browser, tmp_path / name, width, color_scheme=scheme)
                assert page.evaluate("document.documentElement.scrollWidth") <= width
                assert complaints == []
                page.context.close()


def test_first_screens_of_blocks_runs_and_comparisons_answer_a_fresh_reader(made, block, run, browser):
    """How good, by what evidence, what is wrong, what next: seen before scrolling."""
    seen = {
        block: (".figure", ".what", ".verdict", ".signals li .to-do", "svg[data-plot=network]", "table.errors"),
        run: ("h1", "tr.failed .remedy", "tbody img"),
        made["compare"].files["html"]: (".figure", ".what", ".verdict strong", ".signals li .to-do"),
    }
    for path, places in seen.items():
        page, _ = opened(browser, path)
        for where in places:
            box = page.locator(where).first.bounding_box()
            assert box is not None, where
            assert box["y"] + box["height"] <= 900, where
        page.context.close()


@pytest.mark.slow
@pytest.mark.parametrize("paper", ["A4", "Letter"])
def test_pages_print(made, block, run, browser, paper):
    """Nothing is cut off at the right."""
    for path in (made["rectify"].files["html"], block, run):
        page, complaints = opened(browser, path)
        assert page.pdf(format=paper).startswith(b"%PDF")
        wide = {"A4": 688, "Letter": 710}[paper]  # CSS px between the margins
        page.set_viewport_size({"width": wide, "height": 1000})
        page.emulate_media(media="print")
        assert page.evaluate("document.documentElement.scrollWidth") <= wide
        # In heads that are repeated on every sheet Chromium paints text, and no inline blocks.
        boxes = "all => all.map(one => getComputedStyle(one).display)"
        assert set(page.eval_on_selector_all("th button", boxes)) == {"contents"}
        assert complaints == []
        page.context.close()


def test_first_screen_says_how_good_by_what_evidence_what_is_wrong_and_what_next(made, browser):
    """A fresh reader answers these from what is seen before scrolling."""
    page, _ = opened(browser, made["rectify"].files["html"])
    for where in (".figure", ".what", ".verdict", ".signals li .to-do", ".map .check-head", ".map .rule"):
        box = page.locator(where).last.bounding_box()
        assert box is not None
        assert box["y"] + box["height"] <= 900, where
    page.context.close()


def test_vector_chip_and_row_of_a_point_are_shown_together(made, browser):
    page, complaints = opened(browser, made["rectify"].files["html"])
    key = page.locator(".map g[data-point]").first.get_attribute("data-point")
    page.locator(".map g[data-point] circle.control").first.hover()
    lit = page.eval_on_selector_all(".lit", "all => all.map(one => [one.tagName, one.dataset.point])")
    assert {"g", "LI", "TR"} <= {tag for tag, _ in lit}
    assert {point for _, point in lit} == {key}
    table = page.locator("table.sorts").last
    lengths = "all => all.map(one => parseFloat(one.cells[8].textContent))"
    table.get_by_role("button", name="length").focus()
    for order in (1, -1):
        page.keyboard.press("Enter")
        found = table.locator("tbody tr").evaluate_all(lengths)
        assert found == sorted(found, reverse=order < 0)
    page.get_by_role("searchbox").last.fill("check")
    assert table.locator("tbody tr:visible").count() == 6
    assert complaints == []
    page.context.close()


def test_without_a_script_nothing_essential_is_missing(made, browser):
    page, _ = opened(browser, made["rectify"].files["html"], java_script_enabled=False)
    assert page.locator("table.sorts").last.locator("tbody tr").count() == 18
    assert page.locator(".measured li").count() == 18
    assert page.locator("button, input").count() == 0
    page.context.close()


@pytest.mark.slow
@pytest.mark.parametrize("which", ["rectify", "block", "run"])
def test_page_can_be_used_by_everybody(request, browser, which):
    axe = (ROOT / "tests" / "measure" / "axe" / "axe.min.js").read_text(encoding="utf-8")
    path = (
        request.getfixturevalue("made")[which].files["html"] if which == "rectify" else request.getfixturevalue(which)
    )
    for scheme, rules in (("light", "{}"), ("dark", "{runOnly: ['color-contrast']}")):
        page, _ = opened(browser, path, bypass_csp=True, color_scheme=scheme)
        page.evaluate(axe)
        found = page.evaluate(f"axe.run({rules})")["violations"]
        assert [(one["id"], [node["html"][:120] for node in one["nodes"][:3]]) for one in found] == []
        page.context.close()
