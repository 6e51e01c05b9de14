"""Map scales against the figures of the standards themselves."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain

from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.report.document import build_report
from ortho_pipeline.report.map_scale import judge, map_scale, nmas_limit
from ortho_pipeline.report.records import SceneReport

CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)


def points(control: int, check: int) -> Points:
    return simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5).measured


def adjusted(measured: Points, correction: str = "shift") -> Fit:
    return fit(ImageCorrection(CAMERA, correction, (500.0, 500.0), np.zeros(6)), measured)


def made_on(grid: Grid | None) -> SceneReport:
    """Return the report of a scene whose ortho has a grid."""
    done = adjusted(points(12, 6))
    scene = Scene("simulated", "scene.tif", 1000, 1000, {"camera": done.model}, "from a seed", {})
    return build_report(scene=scene, fit=done, grid=grid)


def errors(count: int, rmse: float, seed: int = 0) -> np.ndarray:
    """Return errors (m) whose RMSE of both axes together is exactly this."""
    drawn = np.random.default_rng(seed).normal(0, 1, (count, 2))
    return drawn * rmse / np.sqrt((drawn**2).sum(axis=1).mean())


def test_the_papers_example():
    # OrbView-3: pixels of 1 m are good for 1 : 10,000, where 2.5 m are sufficient.
    found = judge(errors(34, 2.5), "check", 1.0)
    assert (found.paper_scale, found.limited_by) == (10_000, "accuracy")
    assert (judge(errors(34, 0.5), "check", 1.0).paper_scale, judge(errors(34, 0.5), "check", 1.0).limited_by) == (
        10_000, "pixel",
    )  # fmt: skip
    assert judge(errors(34, 2.51), "check", 1.0).paper_scale == 20_000
    assert judge(errors(34, 0.5), "check", 0.2).paper_scale == 2000


@pytest.mark.parametrize(
    ("scale", "metres"),
    # Fact Sheet 171-99 of the US Geological Survey, in feet.
    [(12_000, 33.3 * 0.3048), (24_000, 40 * 0.3048), (100_000, 166.7 * 0.3048)],
)
def test_limits_of_nmas_are_those_that_the_survey_publishes(scale, metres):
    assert nmas_limit(scale) == pytest.approx(metres, rel=2e-3)


def test_nmas_counts_points():
    # Of 20 points two may be off by more than 8.47 m at 1 : 10,000, not three.
    off = np.zeros((20, 2))
    off[:2] = (30.0, 0.0)
    assert judge(off, "check", None).nmas_scale == 100
    off[2] = (0.0, 8.4)
    assert judge(off, "check", None).nmas_scale == 10_000
    # The step of the rule: 9 m are too much for 1 : 10,000 and pass 1 : 20,000 (10.2 m), 12 m wait for 1 : 25,000.
    for metres, scale in ((9.0, 20_000), (12.0, 25_000), (15.0, 50_000)):
        off[2] = (0.0, metres)
        assert judge(off, "check", None).nmas_scale == scale
    assert judge(np.full((9, 2), 1e6), "check", None).nmas_scale is None


def test_asprs_class_has_the_survey_in_it_and_is_claimed_from_thirty_on():
    assert judge(errors(30, 0.30), "check", 0.5).class_cm == 30
    found = judge(errors(30, 0.30), "check", 0.5, survey=0.40)
    assert (found.class_cm, found.claim) == (50, True)
    few = judge(errors(29, 0.30), "check", 0.5)
    assert not few.claim
    assert few.statement == (
        "1:5,000 (limited by the pixel size). Indicative: 29 check points; ASPRS 2023 asks for 30."
    )
    assert "ASPRS 2023 class 50 cm at 30 check points." in found.statement
    assert not judge(errors(200, 0.30), "loo", 0.5).claim


def test_the_evidence_is_named():
    check = map_scale(adjusted(points(12, 6)), 2.5)
    assert check is not None
    assert (check.evidence, check.n) == ("check", 6)
    # Their ground is stated to 0.1 m per axis.
    assert check.survey == pytest.approx(0.1 * np.sqrt(2))
    control = map_scale(adjusted(points(12, 0)), 2.5)
    assert control is not None
    assert (control.evidence, control.n, control.claim) == ("loo", 12, False)
    assert "12 control points left out in turn; ASPRS 2023 asks for 30 check points." in control.statement
    raw = map_scale(adjusted(points(40, 0), "none"), 2.5)
    assert raw is not None
    assert (raw.evidence, raw.n, raw.claim) == ("delivered", 40, True)
    assert map_scale(adjusted(points(1, 0)), 2.5) is None
    assert map_scale(adjusted(points(1, 0).select([False]), "none"), 2.5) is None


def test_a_pixel_counts_in_two_digits():
    """2.503 m on the ground is a pixel of 2.5 m: it is no reason for the next smaller scale."""
    assert (judge(errors(6, 0.48), "check", 2.503).paper_scale, judge(errors(6, 0.48), "check", 2.56).paper_scale) == (
        25_000, 50_000,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("crs", "step", "pixel"),
    # At 37.25° N, EPSG:3857 has 42 m for 33.4 m on the ground, and 0.0001° of latitude are 11.1 m.
    [("EPSG:32636", 10.0, 10.0), ("EPSG:32636", 0.5, None), ("EPSG:3857", 42.0, 33.0), ("EPSG:4326", 1e-4, 11.0)],
)
def test_the_larger_of_ground_sample_and_output_pixel_counts(crs, step, pixel):
    plain = made_on(None)
    assert plain.map_scale is not None
    there = pyproj.Transformer.from_crs(4979, crs, always_xy=True).transform(
        *np.mean([point.lon_lat for point in plain.adjustment.points if point.lon_lat], axis=0)
    )
    grid = Grid(pyproj.CRS(crs), there[0], there[1], step, step, 100, 100)
    found = made_on(grid).map_scale
    assert found is not None
    assert found.pixel == (plain.map_scale.pixel if pixel is None else pixel)
