"""What results look like in a notebook, and the scripts of examples/."""

from __future__ import annotations

import base64
import importlib
import re
import runpy
from dataclasses import replace
from pathlib import Path

import pytest

import ortho_pipeline as op

ROOT = Path(__file__).resolve().parent.parent.parent
SAMPLE = ROOT / "sample_data"


def test_a_fit_shows_itself():
    scene = op.open_scene(SAMPLE / "scene.tif")
    points = op.read_points(SAMPLE / "gcps.geojson")
    assert repr(points).startswith("<18 points: 12 control, 6 check; WGS 84; ")
    fit = op.fit(op.ImageCorrection.identity(scene.model, "shift", (500.0, 500.0)), points)
    assert re.fullmatch(r"<fit of .* to 12 control points: RMSE control 0\.221 px, check .* px, loo .* px>", repr(fit))
    html = op.html(fit)
    assert html.count("<table>") == 2
    assert "col_shift" in html
    assert "0.221" in html


def test_points_and_a_comparison_show_themselves():
    scene, points = op.open_scene(SAMPLE / "scene.tif"), op.read_points(SAMPLE / "gcps.geojson")
    html = op.html(points)
    assert html.count("<tr>") == 19
    assert "12 control, 6 check" in html
    assert ">136.44<" in html
    many = op.Points.of([[k, k] for k in range(23)], [[30 + k, 40, float("nan")] for k in range(23)], "EPSG:4326")
    assert "and 3 more points" in op.html(many)
    found = op.compare(points, ["rpc+shift", "affine3d"], own=scene.model, size=(scene.width, scene.height))
    html = op.html(found)
    assert html.count("<tr>") == 3
    assert "recommended: rpc+shift" in html


def test_ipython_shows_what_is_displayed():
    shown = {}

    class Formatter:
        def for_type_by_name(self, module, name, function):
            shown[module, name] = function

    class Display:
        formatters = {"text/html": Formatter()}  # noqa: RUF012

    class Shell:
        display_formatter = Display()

    op.load_ipython_extension(Shell())
    points = op.read_points(SAMPLE / "gcps.geojson")
    assert "12 control, 6 check" in shown[type(points).__module__, "Points"](points)
    for module, name in shown:
        assert getattr(importlib.import_module(module), name).__module__ == module


def test_names_from_files_are_text_and_not_html():
    from ortho_pipeline.report.notebook.tables import text_html

    found = op.open_scene(SAMPLE / "scene.tif").fit(op.read_points(SAMPLE / "gcps.geojson"), "shift")
    html = op.html(replace(found, model_name="<b>", rejected=(("<script>", "&"),)))
    assert "<script>" not in html
    assert "&lt;b&gt;" in html
    assert text_html("a < b") == "<pre>a &lt; b</pre>"


def test_a_result_shows_its_report(tmp_path):
    result = op.rectify(
        SAMPLE / "scene.tif", tmp_path, points=op.PointOptions(gcps=SAMPLE / "gcps.geojson"),
        surface=op.SurfaceOptions(dem=SAMPLE / "dem.tif"), output=op.OutputOptions(resolution=20.0),
    )  # fmt: skip
    shown = result._repr_html_()
    page = base64.b64decode(re.search(r"base64,([^\"]+)", shown)[1]).decode()
    assert page == result.files["html"].read_text(encoding="utf-8")


@pytest.mark.parametrize("script", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_scripts_run(script, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(script), run_name="__main__")
    assert list(tmp_path.glob("out/*/*_report.html"))
