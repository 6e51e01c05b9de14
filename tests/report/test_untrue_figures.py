"""An error that makes the accuracy untrue replaces it in every output: the control points lie 100 m above the DEM."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import open_dem, open_scene, read_points
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.rectification import no_rpc
from ortho_pipeline.errors import InputError
from ortho_pipeline.report.document import build_report
from ortho_pipeline.report.wording import NO_SCALE
from ortho_pipeline.surface.flat import FlatSurface

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
PIPELINE = """
output: out
defaults:
  points: {gcps: gcps.csv, crs: "EPSG:4979", vertical: ellipsoid, check: "every:3"}
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {stac: true, acquired: "2005-08-03T08:12:31Z"}
scenes: [{image: tiny.tif}]
"""


@pytest.fixture
def outputs(tiny, monkeypatch):
    """Return a function that runs the pipeline for points at a height, and returns what was printed and the folder."""

    def of(height: float):
        lon_lat = np.array([row[3:5] for row in tiny.points(18)], dtype=float)
        ground = np.column_stack([lon_lat, np.full(18, height)])
        image = tiny.model.ground_to_image(ground) + tiny.bias + np.random.default_rng(1).normal(0, 0.1, (18, 2))
        tiny.write(tiny.gcps, [(f"p{i}", *map(float, (*image[i], *ground[i]))) for i in range(18)])
        (tiny.folder / "run.yaml").write_text(PIPELINE)
        monkeypatch.chdir(tiny.folder)
        done = CliRunner().invoke(cli, ["run", "run.yaml", "--executor", "sequential"])
        assert done.exit_code == 0, done.output
        return done.output, tiny.folder / "out"

    return of


def test_no_output_shows_a_figure_that_an_error_makes_untrue(outputs, tiny):
    printed, out = outputs(600.0)
    document = json.loads((out / "tiny" / "tiny_report.json").read_text())
    rmse = f"{document['adjustment']['rmse']['check']['total']:.2f} px"
    why = "the heights of points and DEM differ by"
    (notice,) = [one for one in document["notices"] if one["code"] == "heights-disagree"]
    assert notice["median_m"] == pytest.approx(100.0, abs=25.0)
    head = document["headline"]
    assert (head["figure"], head["metres"], document["map_scale"]) == ("Accuracy unknown", None, None)
    assert head["what"].startswith(why)
    assert f"which moves the ortho by {notice['moved_m']:.2f} m" in head["what"]
    assert head["notes"][0].startswith(f"Do not rely on this figure: {rmse}")
    page = (out / "tiny" / "tiny_report.html").read_text()
    first = page[page.index('<p class="figure') : page.index('<dl class="facts">')]
    assert first.index("Accuracy unknown") < first.index(why[4:]) < first.index(NO_SCALE) < first.index(rmse)
    assert "Map scales" not in page
    # The run: its terminal, its record and its page.
    row = next(line for line in printed.splitlines() if line.startswith("tiny "))
    assert row.split()[2:6] == ["-", "-", "accuracy", "unknown:"]
    assert f"Error: tiny: accuracy unknown: {why}" in printed
    assert json.loads((out / "run.json").read_text())["scenes"][0]["facts"]["headline"] == head
    assert "accuracy unknown: see the error" in (out / "index.html").read_text()
    item = json.loads((out / "tiny" / "tiny_stac.json").read_text())
    assert not [name for name in item["properties"] if name.startswith("accuracy:")]
    # `ortho rectify` in the terminal.
    given = ["rectify", "tiny.tif", "--gcps", "gcps.csv", "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid",
             "--check", "every:3", "--dem", "dem.tif", "--dem-vertical", "ellipsoid", "-o", "one"]  # fmt: skip
    said = CliRunner().invoke(cli, given).output
    assert f"accuracy  unknown: {why}" in said
    assert f"map scale {NO_SCALE}" in said


@pytest.mark.parametrize(("height", "unknown"), [(900, True), (None, False)])
def test_flat_ground_that_is_not_the_ground_has_no_accuracy(tmp_path, height, unknown):
    """The points' own heights adjust the model, so residuals of 0.2 px said nothing of an ortho that was 55 m off."""
    surface = ("--dem", SAMPLE / "dem.tif") if height is None else ("--height", height)
    words = ("rectify", SAMPLE / "scene.tif", "--gcps", SAMPLE / "gcps.geojson", *surface, "-o", tmp_path)
    done = CliRunner().invoke(cli, [*map(str, words)])
    assert done.exit_code == 0, done.output
    document = json.loads((tmp_path / "scene_report.json").read_text())
    codes = {one["code"]: one for one in document["notices"]}
    assert ("surface-not-ground" in codes) == unknown
    assert (document["headline"]["figure"] == "Accuracy unknown") == unknown
    if unknown:
        # Phase correlation with the right ortho found an RMS of 56 m.
        assert 20.0 < codes["surface-not-ground"]["moved_m"] < 120.0


@pytest.mark.parametrize("upside_down", [False, True])
def test_a_dem_that_is_upside_down_gives_no_accuracy(tmp_path, upside_down):
    """It has a height everywhere, and is as often above the points as below them: the median showed nothing."""
    scene, points = open_scene(SAMPLE / "scene.tif"), read_points(SAMPLE / "gcps.geojson")
    copy = gdal.Translate(str(tmp_path / "dem.tif"), str(SAMPLE / "dem.tif"))
    if upside_down:
        copy.GetRasterBand(1).WriteArray(copy.ReadAsArray()[::-1])
    copy = None
    report = build_report(scene=scene, fit=scene.fit(points, "shift"), surface=open_dem(tmp_path / "dem.tif"))
    moved = [one["moved_m"] for one in report.notices if one["code"] == "surface-not-ground"]
    assert bool(moved) == (report.map_scale is None) == upside_down
    assert min(moved, default=50.0) > 40.0


@pytest.mark.parametrize(("sigma", "told"), [(None, True), (5.0, True), (100.0, False), (FlatSurface(100.0), False)])
def test_a_surface_may_be_as_wrong_as_it_states(sigma, told):
    scene, points = open_scene(SAMPLE / "scene.tif"), read_points(SAMPLE / "gcps.geojson")
    # The points' own heights are typically 150 m about this one.
    surface = FlatSurface(float(np.median(points.ground[:, 2]))).with_sigma(sigma)
    report = build_report(scene=scene, fit=scene.fit(points, "shift"), surface=surface)
    assert ("surface-not-ground" in [one["code"] for one in report.notices]) == told


@pytest.mark.parametrize("off", [0.0, 30.0])
def test_heights_from_the_dem_do_not_hide_another_datum(tmp_path, off):
    """Most points have the heights of the DEM, so the median of all was zero; `ortho fit` compared nothing."""
    given = json.loads((SAMPLE / "gcps.geojson").read_text())
    for number, feature in enumerate(given["features"]):
        place = feature["geometry"]["coordinates"]
        if number % 3:
            del place[2]
        else:
            place[2] += off
    (tmp_path / "gcps.geojson").write_text(json.dumps(given))
    words = (SAMPLE / "scene.tif", "--gcps", tmp_path / "gcps.geojson", "--dem", SAMPLE / "dem.tif")
    for command, more in (("fit", ()), ("rectify", ("-o", tmp_path / "out"))):
        done = CliRunner().invoke(cli, [command, *map(str, (*words, *more)), "--json"])
        assert done.exit_code == 0, done.output
        document = json.loads(done.stdout)
        notices = document.get("report", document)["notices"]
        found = [one["median_m"] for one in notices if one["code"] == "heights-disagree"]
        assert found == ([pytest.approx(off, abs=5.0)] if off else [])


@pytest.mark.parametrize("sigma", [0.0, 30.0])
def test_points_with_poor_heights_do_not_disprove_a_dem(tmp_path, sigma):
    """Their heights are wrong by 30 m, as they state."""
    scene, points = open_scene(SAMPLE / "scene.tif"), read_points(SAMPLE / "gcps.geojson")
    ground, stated = points.ground.copy(), points.sigma_ground.copy()
    ground[:, 2] += np.random.default_rng(1).normal(0.0, 30.0, len(ground))
    stated[:, 2] = sigma
    points = replace(points, ground=ground, sigma_ground=stated)
    for surface in (open_dem(SAMPLE / "dem.tif"), FlatSurface(float(np.median(ground[:, 2])))):
        report = build_report(scene=scene, fit=scene.fit(points, "shift"), surface=surface)
        found = "surface-not-ground" in [one["code"] for one in report.notices]
        assert found == (sigma == 0.0 or isinstance(surface, FlatSurface))


def test_with_the_right_heights_all_of_them_show_it(outputs):
    printed, out = outputs(500.0)
    document = json.loads((out / "tiny" / "tiny_report.json").read_text())
    assert document["headline"]["figure"].endswith(" px")
    assert document["map_scale"] is not None
    assert "unknown" not in printed
    item = json.loads((out / "tiny" / "tiny_stac.json").read_text())
    assert item["properties"]["accuracy:geometric_rmse"] > 0


def test_matches_are_not_compared_with_the_dem_that_gave_their_heights():
    scene, points = open_scene(SAMPLE / "scene.tif"), read_points(SAMPLE / "gcps.geojson")
    dem, count = open_dem(SAMPLE / "dem.tif"), len(points)
    surveyed = build_report(scene=scene, fit=scene.fit(points, "shift"), surface=dem)
    assert surveyed.heights is not None
    assert surveyed.heights.n == count
    matched = points.with_covariance_image(np.broadcast_to(0.01 * np.eye(2), (count, 2, 2)), np.arange(count))
    assert build_report(scene=scene, fit=scene.fit(matched, "shift"), surface=dem).heights is None


def test_the_point_whose_height_differs_most_from_the_dem_is_named():
    scene, points = open_scene(SAMPLE / "scene.tif"), read_points(SAMPLE / "gcps.geojson")
    ground = points.ground.copy()
    ground[points.ids.index("C02"), 2] -= 100.0
    fit = scene.fit(points.with_ground(ground), "shift")
    report = build_report(scene=scene, fit=fit, surface=open_dem(SAMPLE / "dem.tif"))
    assert report.heights is not None
    assert report.heights.largest_at == "C02"
    assert report.heights.largest_m == pytest.approx(-100.0, abs=1.0)  # the points and the DEM agree to 0.3 m
    assert abs(report.heights.median_m) < 0.5
    assert (report.heights.n, report.heights.without) == (len(points), 0)
    ground[:2, :2] += 1.0
    fit = replace(fit, points=fit.points.with_ground(ground))
    report = build_report(scene=scene, fit=fit, surface=open_dem(SAMPLE / "dem.tif"))
    assert report.heights is not None
    assert (report.heights.n, report.heights.without) == (len(points) - 2, 2)


def test_an_rpc_that_is_not_written_is_called_that_of_the_model():
    said = str(no_rpc(InputError("this RPC maps several places on the ground to one pixel")))
    assert said == "no RPC written: the RPC of this model maps several places on the ground to one pixel"
