"""Models side by side on the same points: a row each, one recommendation, on scenes with and without a model."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline import pipeline
from ortho_pipeline.cli import cli
from ortho_pipeline.comparison import Row, available_models, compare, recommend
from ortho_pipeline.errors import InputError
from ortho_pipeline.landscape import Terrain
from ortho_pipeline.models import families
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.simulate import LineScanner, simulate_points

CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)
FOURTEEN = (
    "affine2d", "poly2", "poly3", "projective", "affine3d", "affine12", "affine14", "poly3d1", "poly3d2", "dlt",
    "rfm1", "rfm2", "poly4", "poly3d3",
)  # fmt: skip


def simulated(control: int = 30, check: int = 20, **more: Any) -> Points:
    return simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5, **more).measured


def points_of(tiny: Any, **more: Any) -> PointOptions:
    return PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid", **more)


def plain(tiny: Any) -> Any:
    """Return a copy of the tiny image that has no model of any kind."""
    path = tiny.folder / "plain.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), tiny.width, tiny.height, 1, gdal.GDT_UInt16)
    dataset.WriteArray(gdal.Open(str(tiny.image)).ReadAsArray())
    return path


# -- rows ------------------------------------------------------------------------------------------------------------


def test_every_model_is_a_row_and_one_that_cannot_be_fitted_says_why():
    done = compare(simulated(12, 6), tuple(available_models()), size=(1000, 1000))
    assert [row.model for row in done.rows] == [family.name for family in families()]
    rows = {row.model: row for row in done.rows}
    assert "39" in str(rows["rfm3"].error)
    assert rows["rfm3"].to_json()["rmse"] == {"control": None, "check": None, "loo": None}
    assert rows["affine3d"].error is None
    json.dumps(done.to_json(), allow_nan=False)


def test_flat_models_lose_on_hills_and_the_recommended_is_simple_enough():
    done = compare(simulated(), ("affine2d", "poly3", "affine3d", "dlt", "poly3d3"), size=(1000, 1000))
    rows = {row.model: row.to_json() for row in done.rows}
    assert rows["affine2d"]["rmse"]["check"]["total"] > 10 * rows["affine3d"]["rmse"]["check"]["total"]
    assert done.recommended in ("affine3d", "dlt")
    assert done.criterion == "check"
    assert "20 check points" in done.reason


def test_metres_are_the_pixels_of_the_scene():
    row = compare(simulated(), ("dlt",), size=(1000, 1000)).rows[0].to_json()
    for which in ("control", "check", "loo"):
        assert row["rmse_m"][which]["total"] == pytest.approx(2.5 * row["rmse"][which]["total"], rel=0.1)


def test_a_blunder_is_left_out_of_every_model():
    points = simulated()
    index = int(np.flatnonzero(points.control)[3])
    image = points.image.copy()
    image[index] += (80.0, -60.0)
    moved = Points(**{**vars(points), "image": image})
    done = compare(moved, ("affine3d", "dlt", "rfm1"), size=(1000, 1000))
    assert [name for name, _ in done.left_out] == [points.ids[index]]
    assert {row.fit.used.sum() for row in done.rows if row.fit} == {29}


def test_nothing_is_recommended_without_redundancy():
    done = compare(simulated(4, 0), ("affine3d",), size=(1000, 1000))
    assert done.recommended is None
    assert "redundancy" in done.reason


def test_the_simpler_of_two_equal_models_is_recommended():
    done = compare(simulated(40, 0), ("affine3d", "poly3d1", "affine12"), size=(1000, 1000))
    rows = {row.model: row for row in done.rows}
    assert rows["affine3d"].parameters == min(row.parameters for row in done.rows)
    assert done.criterion == "leave-one-out"
    assert recommend([rows["affine12"], Row("none", 1, 1, 3, error="no")])[0] == "affine12"


def test_fourteen_models_are_all_fitted_to_sixty_points():
    done = compare(simulated(60, 0), FOURTEEN, size=(1000, 1000))
    assert len(done.rows) == 14
    assert not [row.error for row in done.rows if row.error]


# -- whole jobs ------------------------------------------------------------------------------------------------------


def test_the_scenes_own_model_takes_part(tiny):
    document = pipeline.compare(tiny.image, points_of(tiny), models="rpc,rpc+shift,rpc+affine,affine3d").to_json()
    rows = {row["model"]: row for row in document["rows"]}
    assert rows["rpc"]["rmse"]["control"]["total"] > 3
    assert rows["rpc+shift"]["rmse"]["loo"]["total"] < 0.3
    assert document["recommendation"]["model"] == "rpc+shift"
    assert document["points"] == {"control": 12, "check": 0}


@pytest.mark.parametrize("crs", [None, "geocentric", "geographic", "utm", "EPSG:32734"])
def test_a_plain_image_is_rectified_from_points_alone(tiny, tmp_path, crs):
    image = plain(tiny)
    with pytest.raises(InputError):
        pipeline.fit(image, points_of(tiny))
    options = points_of(tiny, fit_model="affine3d", model_crs=crs)
    fitted = pipeline.fit(image, options)
    assert fitted.scene.sensor == "points only"
    assert fitted.fit.rmse("loo")["total"] < 0.5
    if crs not in (None, "utm"):
        return
    surface = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid")
    output = OutputOptions(resolution=4.8, crs="EPSG:32734")
    own = pipeline.rectify(tiny.image, tmp_path / "own", points=points_of(tiny), surface=surface, output=output)
    ours = pipeline.rectify(image, tmp_path / "ours", points=options, surface=surface, output=output)
    first, second = (gdal.Open(str(result.files["ortho"])) for result in (own, ours))
    assert first.GetGeoTransform()[1] == second.GetGeoTransform()[1]
    shift = [round((b - a) / 4.8) for a, b in zip(*(d.GetGeoTransform()[0:4:3] for d in (first, second)), strict=True)]
    one, other = first.ReadAsArray().astype(float), second.ReadAsArray().astype(float)
    one = one[max(-shift[1], 0) :, max(shift[0], 0) :]
    other = other[max(shift[1], 0) :, max(-shift[0], 0) :]
    rows, columns = min(len(one), len(other)), min(one.shape[1], other.shape[1])
    one, other = one[:rows, :columns], other[:rows, :columns]
    both = (one > 0) & (other > 0)
    assert both.mean() > 0.5
    # The wavelength is 44 pixels, the amplitude 300: a shift of a tenth of a pixel makes 4.
    assert np.median(np.abs(one - other)[both]) < 10
    saved = pipeline.rectify(
        image, tmp_path / "again", scene=SceneOptions(model=ours.files["model"]), surface=surface, output=output
    )
    np.testing.assert_array_equal(gdal.Open(str(saved.files["ortho"])).ReadAsArray(), second.ReadAsArray())


def test_compare_writes_the_report_of_the_recommended_model(tiny, tmp_path):
    result = pipeline.compare(plain(tiny), points_of(tiny), models="affine2d,affine3d,rfm3", folder=tmp_path / "out")
    assert set(result.files) == {"residuals", "style", "report", "html"}
    report = json.loads(result.files["report"].read_text())
    assert report["comparison"]["recommendation"]["model"] == report["adjustment"]["model"] == "affine3d"
    page = result.files["html"].read_text()
    assert 'data-plot="comparison"' in page
    assert "not fitted" in page


@pytest.mark.parametrize("spec", ["even:6", "cluster:6", "random:6:3", "ids:p0,p1,p2,p3,p4,p5"])
def test_selected_points_control_and_the_others_check(tiny, spec):
    document = pipeline.compare(tiny.image, points_of(tiny, select=spec), models="rpc+shift").to_json()
    assert document["points"] == {"control": 6, "check": 6}
    with pytest.raises(InputError, match="--select"):
        pipeline.fit(tiny.image, points_of(tiny, select=spec, check="every:3"))


def test_prune_takes_out_what_the_points_do_not_justify(tiny):
    result = pipeline.fit(tiny.image, points_of(tiny, correction="affine", prune=True))
    assert {"col_shift", "row_shift"} <= set(result.fit.param_names)
    assert len(result.removed) >= 2
    assert any("do not justify" in text for text in result.warnings)
    assert [one["name"] for one in result.to_json()["removed"]] == [one["name"] for one in result.removed]


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"fit_model": "affine99"}, "--fit-model"),
        ({"fit_model": "dlt", "correction": "shift"}, "--fit-model"),
        ({"model_crs": "utm"}, "--model-crs"),
    ],
)
def test_contradicting_options_are_refused(tiny, options, field):
    with pytest.raises(InputError) as caught:
        pipeline.fit(tiny.image, points_of(tiny, **options))
    assert caught.value.field == field


def test_an_unknown_model_is_refused(tiny):
    with pytest.raises(InputError, match="nonsense"):
        pipeline.compare(tiny.image, points_of(tiny), models="dlt,nonsense")


def test_points_without_heights_serve_flat_models_only(tiny):
    path = tiny.write(tiny.folder / "flat.csv", [row[:5] for row in tiny.points(8)], "id,col,row,x,y")
    options = PointOptions(gcps=path, crs="EPSG:4326", fit_model="affine2d")
    assert pipeline.fit(plain(tiny), options).fit.rmse("control")["n"] == 8
    with pytest.raises(InputError, match="no height"):
        pipeline.fit(plain(tiny), PointOptions(gcps=path, crs="EPSG:4326", fit_model="affine3d"))


# -- command line ----------------------------------------------------------------------------------------------------


def run(*arguments: Any) -> Any:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def test_models_are_listed():
    listed = json.loads(run("models", "--json").stdout)
    names = [model["name"] for model in listed]
    assert {"affine2d", "poly3", "projective", "affine3d", "affine12", "affine14", "dlt", "rfm1", "rfm2", "rfm3"} <= {
        *names
    }
    for model in listed:
        assert {"name", "parameters", "minimum_points", "dimensions", "suits"} <= set(model)
    assert all(f"\n{name} " in run("models").stdout for name in names)


@pytest.mark.parametrize("units", ["px", "m"])
def test_the_table_has_a_line_per_model_and_a_recommendation(tiny, units):
    given = ["--gcps", tiny.gcps, "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]
    done = run("compare", tiny.image, *given, "--models", "all", "--units", units)
    assert done.exit_code == 0, done.stderr
    for family in families():
        assert f"\n{family.name} " in done.stdout
    assert "* Recommended: rpc+shift" in done.stdout
    assert f"RMSE in {units}" in done.stdout
    document = json.loads(run("compare", tiny.image, *given, "--models", "affine3d,dlt", "--json").stdout)
    assert [row["model"] for row in document["rows"]] == ["affine3d", "dlt"]
