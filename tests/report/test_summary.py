"""The first screen: what a scene is, and the errors of its points by axis, against NumPy and the points themselves."""

from __future__ import annotations

import functools

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain

from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.report.document import build_report, summary_text
from ortho_pipeline.report.map_scale import ce90_of
from ortho_pipeline.report.records import UNKNOWN, SceneReport
from ortho_pipeline.report.summary import (
    RoleErrors,
    about,
    acquired,
    circular_error,
    error_lines,
    errors_of_points,
    place_text,
    processed,
    sensors_text,
)
from ortho_pipeline.report.wording import few_check_points

CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)


@functools.cache
def measured(control: int = 12, check: int = 6) -> Points:
    return simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5).measured


def made(points: Points, crs: str = "EPSG:32636") -> SceneReport:
    """Return the report of a scene that is shifted to points, with an ortho about these."""
    result = fit(ImageCorrection(CAMERA, "shift", (500.0, 500.0), np.zeros(6)), points)
    scene = Scene("simulated", "scene.tif", 1000, 1000, {"camera": result.model}, "from a seed", {})
    x, y = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True).transform(*points.ground[:, :2].T)
    extent = (min(x), min(y), max(x) + (max(x) == min(x)), max(y) + (max(y) == min(y)))
    cell = (extent[2] - extent[0]) / 1000
    grid = Grid.of_extent(pyproj.CRS(crs), extent, (cell, cell))
    warnings = [few_check_points(int(points.check.sum())), *result.warnings]
    return build_report(scene=scene, fit=result, grid=grid, warnings=warnings)


def test_errors_by_axis_are_those_of_the_points():
    report = made(measured())
    check, control = errors_of_points(report)
    assert [(one.role, one.n) for one in (check, control)] == [("check", 6), ("control", 12)]
    truth = np.array([one.residual_m for one in report.adjustment.points if one.role == "check"])
    assert [one.mean for one in check.axes] == pytest.approx(truth.mean(axis=0))
    assert [one.std for one in check.axes] == pytest.approx(truth.std(axis=0, ddof=1))
    rmse = report.rmse_m.check
    assert rmse is not None
    assert [one.rmse for one in check.axes] == pytest.approx([rmse.x, rmse.y])
    assert check.ce90 == pytest.approx(np.hypot(*truth.T).max())  # of fewer than ten, the largest
    assert circular_error(report) == check.ce90
    assert report.map_scale is not None
    assert check.ce90 == report.map_scale.ce90
    text = summary_text(report)
    assert text.index("accuracy  ") < text.index("errors, m") < text.index("Warning: ") < text.index("\nmodel  ")
    assert control.title == "control points (the fit)"


def test_ce90_leaves_out_one_error_in_ten():
    errors = np.column_stack([np.arange(1.0, 11.0), np.zeros(10)])
    assert [ce90_of(errors), ce90_of(errors[:9]), ce90_of(errors[:, :1])] == [9.0, 9.0, 9.0]


def test_control_is_never_the_accuracy():
    """Without check points the CE90 is from left-out points; without redundancy there is none."""
    report = made(measured(check=0))
    (control,) = errors_of_points(report)
    assert report.map_scale is not None
    assert circular_error(report) == report.map_scale.ce90 > control.ce90
    assert "each left out in turn" in summary_text(report)
    alone = made(measured().select(np.arange(18) < 1))
    assert (alone.headline.figure, circular_error(alone)) == (UNKNOWN, None)
    assert "accuracy  unknown: no point is left to test the fit" in summary_text(alone)
    assert "CE90" not in summary_text(alone)


def test_one_point_has_no_standard_deviation_and_small_errors_have_millimetres():
    one = RoleErrors.of("check", "check points", np.array([[0.0021, -0.004]]))
    lines = error_lines([one])
    assert lines[1].split()[2:] == ["1", "x", "(east)", "+0.002", "–", "0.002"]
    assert lines[2].split()[-3:] == ["−0.004", "–", "0.004"]
    assert error_lines([]) == []
    block = RoleErrors.of("check", "check points", np.array([[3.0, 4.0, -2.0], [0.0, 0.0, 1.0]]))
    assert (block.ce90, block.le90, block.axes[2].axis) == (5.0, 2.0, "z (height)")


def test_area_is_that_on_the_ellipsoid():
    geod = pyproj.Geod(ellps="WGS84")
    for crs in ("EPSG:32636", "EPSG:3857", "EPSG:4326"):
        report = made(measured(), crs)
        assert report.ortho is not None
        left, bottom, right, top = report.ortho.extent
        to = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        lon, lat = to.transform([left, right, right, left], [bottom, bottom, top, top])
        truth = abs(geod.polygon_area_perimeter(lon, lat)[0]) / 1e6
        assert float(about(report)["Area"].split()[0]) == pytest.approx(truth, rel=0.05)


def test_dates_places_and_sensors_as_people_read_them(monkeypatch):
    assert acquired(["2005-08-03T23:30:00-05:00", None, "None"]) == "2005-08-04"
    assert acquired(["2005-08-03T08:12:31.250Z", "2005-08-05"]) == "2005-08-03 to 2005-08-05"
    assert acquired(["20-JUN-05"]) == "20-JUN-05"
    assert acquired([None]) is None
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "86400")
    assert processed() == "1970-01-02"
    assert place_text((33.35, -37.25)) == "37°15′ S, 33°21′ E"
    assert sensors_text(["rpc", "rpc"], [{"satellite": "X1"}, {"satellite": "None"}]) == "X1 (rpc)"
    report = made(measured())
    scene = report.scene.replaced(facts={"acquired": "2005-08-03T08:12:31Z"})
    known = about(report.replaced(scene=scene))
    assert (known["Acquired"], known["Processed"]) == ("2005-08-03", "1970-01-02")
    assert about(report)["Acquired"] == "unknown"
