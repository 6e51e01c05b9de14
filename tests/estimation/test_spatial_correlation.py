"""Covariance analysis: fields of known covariance, chance that is not called systematic, and what few points say."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import jsonschema
import numpy as np
import pytest
from ortho_studies.simulation.scanner import LineScanner, simulate_points
from ortho_studies.simulation.terrain import Terrain
from scipy.stats import binom

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.estimation.ground_residuals import viewing
from ortho_pipeline.estimation.spatial.correlation import Covariance, Covariances, analyse, analyse_fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.points import Points
from ortho_pipeline.report import document as report
from ortho_pipeline.report.records import SceneReport

Array = np.ndarray
SIDE = 10_000.0


def scattered(count: int, random: np.random.Generator) -> Array:
    return random.uniform(0.0, SIDE, (count, 2))


def field(xy: Array, random: np.random.Generator, systematic: float, length: float, noise: float) -> Array:
    """Draw two Gaussian random fields of the covariance ``systematic^2 exp(-d / length)``, and noise upon them."""
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    root = np.linalg.cholesky(systematic**2 * np.exp(-distance / length) + 1e-9 * np.eye(len(xy)))
    return root @ random.normal(size=(len(xy), 2)) + noise * random.normal(size=(len(xy), 2))


# -- fields of known covariance --------------------------------------------------------------------------------------


def test_range_and_sill_of_a_random_field_are_recovered():
    """Medians over 30 fields of 250 points; a single field of ten ranges' side leaves the range to a factor of two."""
    found = []
    for seed in range(30):
        random = np.random.default_rng(seed)
        xy = scattered(250, random)
        analysis = analyse(xy, field(xy, random, 1.0, 1000.0, 0.5), draws=19)
        found += [[one.noise, one.systematic, one.range_m] for one in analysis.functions if one is not None]
    assert len(found) == 60
    noise, systematic, length = np.median(found, axis=0)
    assert noise == pytest.approx(0.5, rel=0.15)
    assert systematic == pytest.approx(1.0, rel=0.1)
    assert length == pytest.approx(1000.0, rel=0.2)


def test_a_random_field_is_called_systematic_and_neighbours_are_more_accurate():
    random = np.random.default_rng(3)
    xy = scattered(150, random)
    found = analyse(xy, field(xy, random, 1.0, 2500.0, 0.3))
    assert found.verdict == "systematic"
    assert found.p_joint == pytest.approx(0.001)
    assert "Systematic errors remain" in found.statement
    x, y = (function.systematic for function in found.functions if function is not None)
    assert (
        f"The systematic errors have a standard deviation of about {x:.2f} m in x and {y:.2f} m in y."
        in found.statement
    )
    assert found.relative is not None
    assert max(found.relative) < 0.8 * min(found.absolute)
    first, last = found.classes[0], found.classes[-1]
    assert np.mean(first.correlation) > 0.5
    assert max(first.relative) < min(last.relative)
    # The function goes through the classes.
    for k, function in enumerate(found.functions):
        assert function is not None
        assert function.relative(first.distance_m) == pytest.approx(first.relative[k], rel=0.25)
        assert function.covariance(0.0) == pytest.approx(function.systematic**2)


@pytest.mark.parametrize(
    ("count", "affine"),
    [
        (10, False),
        pytest.param(34, False, marks=pytest.mark.slow),
        (12, True),
        pytest.param(34, True, marks=pytest.mark.slow),
    ],
)
def test_chance_is_called_systematic_in_5_per_cent(count, affine):
    """500 repeats of white noise; the number of false alarms lies within what 5 % make of 500 (99.9 %)."""
    alarms = 0
    for seed in range(500):
        random = np.random.default_rng(10_000 + seed)
        xy, residuals = scattered(count, random), random.normal(size=(count, 2))
        design = None
        if affine:
            design = np.zeros((count, 2, 6))
            design[:, 0, :3] = design[:, 1, 3:] = np.column_stack([np.ones(count), xy / SIDE])
            rows = design.reshape(-1, 6)
            residuals -= (rows @ np.linalg.lstsq(rows, residuals.ravel(), rcond=None)[0]).reshape(count, 2)
        tested = analyse(xy, residuals, design=design, draws=99, near=1e-3, classes=(0.0, 1.0))
        assert tested.p_joint is not None
        # With 99 draws, p has the steps 0.01, so that p < 0.05 means four in a hundred, and p <= 0.05 five.
        alarms += tested.p_joint <= 0.05
    low, high = binom.ppf([0.0005, 0.9995], 500, 0.05)
    assert low <= alarms <= high


def test_residuals_of_an_adjustment_need_its_design():
    """Affine residuals of 12 points are correlated against each other: without the design the test is blind."""
    random = np.random.default_rng(1)
    xy = scattered(12, random)
    design = np.zeros((12, 2, 6))
    design[:, 0, :3] = design[:, 1, 3:] = np.column_stack([np.ones(12), xy / SIDE])
    noise = random.normal(size=(12, 2))
    rows = design.reshape(-1, 6)
    left = noise - (rows @ np.linalg.lstsq(rows, noise.ravel(), rcond=None)[0]).reshape(12, 2)
    with_design, without = analyse(xy, left, design=design), analyse(xy, left)
    assert with_design.critical is not None
    assert without.critical is not None
    assert with_design.critical < without.critical - 0.05


# -- numbers ---------------------------------------------------------------------------------------------------------


def test_numbers_of_three_points_by_hand():
    found = analyse([[0, 0], [300, 0], [0, 4000]], [[1.0, 0.0], [3.0, 0.0], [-1.0, 3.0]], near=600.0)
    assert (found.n, found.pairs_near) == (3, 1)
    assert found.mean == pytest.approx((1.0, 1.0))
    assert found.absolute == pytest.approx((math.sqrt(11 / 3), math.sqrt(3)))
    assert found.relative == pytest.approx((math.sqrt(4 / 2), 0.0))
    # About the mean: (0 * 2) / (8/3) and (-1 * -1) / 2.
    assert found.correlation == pytest.approx((0.0, 0.5))
    assert [one.pairs for one in found.classes] == [1, 2]
    assert found.classes[0].distance_m == pytest.approx(300.0)
    assert (found.verdict, found.p_joint, found.functions) == ("too few points", None, (None, None))


def test_relative_accuracy_squared_is_variance_less_covariance():
    """Over all pairs: mean of half squared differences = variance times n / (n - 1)."""
    random = np.random.default_rng(0)
    xy, values = scattered(40, random), random.normal(size=(40, 2))
    everything = analyse(xy, values, classes=(0.0, 2 * SIDE)).classes[0]
    assert everything.pairs == 40 * 39 // 2
    assert everything.relative == pytest.approx(values.std(axis=0, ddof=1), rel=1e-12)
    assert everything.correlation == pytest.approx((-1 / 39, -1 / 39), rel=1e-9)


def test_analysis_does_not_depend_on_place_order_or_direction():
    random = np.random.default_rng(4)
    xy = scattered(60, random)
    values = field(xy, random, 1.0, 2000.0, 0.5)
    reference = analyse(xy, values)
    order = random.permutation(60)
    moved = analyse(xy[order] @ np.array([[0.6, -0.8], [0.8, 0.6]]) + 5e5, values[order])
    assert moved.near_m == reference.near_m
    assert moved.moran == pytest.approx(reference.moran)
    for one, other in zip(reference.classes, moved.classes, strict=True):
        assert one.relative == pytest.approx(other.relative)
    scaled = analyse(xy, 100 * values, unit="px")
    assert scaled.moran == pytest.approx(reference.moran)
    assert scaled.absolute == pytest.approx(100 * np.array(reference.absolute))


def test_default_distance_has_as_many_pairs_as_points_and_classes_are_filled():
    random = np.random.default_rng(5)
    found = analyse(scattered(50, random), random.normal(size=(50, 2)))
    assert 50 <= found.pairs_near <= 65
    assert found.classes[0].to_m == found.near_m
    assert all(one.pairs >= 30 for one in found.classes)
    assert sum(one.pairs for one in found.classes) == 50 * 49 // 2
    assert f"{found.near_m:g} m" in found.statement


def test_no_neighbour_is_said_to_be_one():
    random = np.random.default_rng(6)
    found = analyse(scattered(9, random), random.normal(size=(9, 2)), near=1.0)
    assert (found.relative, found.correlation, found.pairs_near) == (None, None, 0)
    assert "closer than" not in found.statement


@pytest.mark.parametrize("count", [0, 1, 2, 3, 7])
def test_few_points_are_called_few(count):
    random = np.random.default_rng(7)
    found = analyse(scattered(count, random), random.normal(size=(count, 2)))
    assert found.verdict == "too few points"
    assert f"{count} point" in found.statement
    assert json.loads(json.dumps(found.to_json(), allow_nan=False))["p_joint"] is None


def test_without_redundancy_nothing_is_tested():
    random = np.random.default_rng(8)
    assert analyse(scattered(9, random), np.zeros((9, 2)), design=random.normal(size=(9, 2, 12))).p_joint is None


def test_perfect_residuals_are_not_systematic():
    random = np.random.default_rng(9)
    found = analyse(scattered(20, random), np.zeros((20, 2)))
    assert found.verdict == "none found"
    assert found.p_joint == 1.0


def test_rows_with_nan_points_of_one_place_and_very_many():
    random = np.random.default_rng(10)
    xy, values = scattered(30, random), random.normal(size=(30, 2))
    xy[:12] = xy[0]
    values[3, 1] = np.nan
    xy[4] = np.nan
    assert analyse(xy, values).n == 28
    many = analyse(scattered(2500, random), random.normal(size=(2500, 2)), draws=19)
    assert many.n == 1000


def test_a_mean_of_check_points_is_said():
    random = np.random.default_rng(11)
    found = analyse(scattered(20, random), np.array([2.0, 0.0]) + random.normal(size=(20, 2)))
    assert found.mean_p is not None
    assert found.mean_p[0] < 0.001
    assert "The mean residual is +" in found.statement
    assert found.verdict == "none found"


@pytest.mark.parametrize(
    ("xy", "residuals", "more"),
    [
        ([[0, 0]], [[0, 0], [1, 1]], {}),
        ([[0, 0, 0]], [[0, 0, 0]], {}),
        ([[0, 0]], [[0, 0]], {"near": 0.0}),
        ([[0, 0]], [[0, 0]], {"near": math.nan}),
        ([[0, 0]], [[0, 0]], {"classes": (0.0,)}),
        ([[0, 0]], [[0, 0]], {"classes": (0.0, 5.0, 5.0)}),
        ([[0, 0]], [[0, 0]], {"design": np.zeros((2, 2, 1))}),
    ],
)
def test_what_does_not_fit_together_is_refused(xy, residuals, more):
    with pytest.raises(InputError):
        analyse(xy, residuals, **more)


# -- of a fit, and in the report -------------------------------------------------------------------------------------

CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)


def adjusted(*, wave: float, control: int = 34, check: int = 12) -> Fit:
    """Return a fit to points whose columns carry a wave (px) over the rows, as an unmodelled attitude makes it."""
    made = simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5).measured
    image = made.image.copy()
    image[:, 0] += wave * np.sin(image[:, 1] / 120)
    model = ImageCorrection(CAMERA, "affine", (500.0, 500.0), np.zeros(6))
    return fit(model, dataclasses.replace(made, image=image), name="camera+affine")


def section(result: Fit) -> dict[str, Covariance | None]:
    return analyse_fit(result)


def test_a_wave_that_no_affine_takes_out_is_found():
    found = section(adjusted(wave=0.6)).control
    assert found is not None
    assert found.verdict == "systematic"
    assert found.p is not None
    # The columns of a southward pass are east: x has it, y has not.
    assert found.p[0] < 0.01 < found.p[1]
    clean = section(adjusted(wave=0.0)).control
    assert clean is not None
    assert clean.verdict == "none found"


def test_control_and_check_are_apart_and_in_metres():
    result = adjusted(wave=0.0)
    found = section(result)
    assert found.control is not None
    assert found.check is not None
    assert (found.control.n, found.check.n) == (int(result.used.sum()), 12)
    rmse = result.rmse("check")
    assert rmse is not None
    assert found.check.unit == "m"
    assert np.hypot(*found.check.absolute) == pytest.approx(2.5 * rmse.total, rel=0.1)
    # A check point of unknown position is left out, and no other.
    ground = result.points.ground.copy()
    ground[np.flatnonzero(result.points.check)[0], 0] = np.nan
    known = section(dataclasses.replace(result, points=result.points.with_ground(ground)))
    assert (known.control, known.check.n) == (found.control, 11)
    # Distances are those of the ground: the scene is 2.5 km wide.
    last = found.control.classes[-1]
    assert 2000 < last.to_m < 3600
    none: Points = result.points.select(np.zeros(len(result.points), dtype=bool))
    empty = fit(ImageCorrection(CAMERA, "none", (500.0, 500.0), np.zeros(6)), none)
    assert section(empty) == Covariances()


def test_report_holds_the_analysis_and_draws_it(tmp_path):
    result = adjusted(wave=0.6)
    scene = Scene("simulated", "scene.tif", 1000, 1000, {"camera": result.model}, "from a seed")
    provenance = {"command": None, "inputs": [], "software": {}}
    made = report.build_report(scene=scene, fit=result, provenance=provenance)
    schema = json.loads((Path(__file__).parent.parent.parent / "docs" / "report.schema.json").read_text())
    jsonschema.validate(made.to_json(), schema, cls=jsonschema.Draft202012Validator)
    # The check points were tested: their analysis is drawn, and a notice names them.
    assert {"neighbours", "relative"} <= set(report.plots(made))
    report.write_report_html(made, tmp_path / "r.html")
    page = (tmp_path / "r.html").read_text()
    assert "Neighbouring points" in page
    assert "Systematic errors remain" in page
    assert 'data-plot="relative"' in page
    (notice,) = [one for one in made.notices if one["code"] == "systematic-errors"]
    assert notice["roles"] == ["control"]
    text = "systematic errors remain: neighbouring control points have similar residuals"
    assert notice["text"] == text
    assert text[1:] in page
    noise = report.build_report(scene=scene, fit=adjusted(wave=0.0), provenance=provenance)
    assert "systematic-errors" not in [one["code"] for one in noise.notices]
    files = report.write_plots(made, tmp_path, "r", "png")
    assert files["neighbours"].stat().st_size > 3000


def test_report_of_few_points_says_so_and_draws_nothing():
    result = adjusted(wave=0.0, control=5, check=3)
    scene = Scene("simulated", "scene.tif", 1000, 1000, {"camera": result.model}, "from a seed")
    made = report.build_report(scene=scene, fit=result)
    control = made.covariance.control
    assert control is not None
    assert control.verdict == "too few points"
    assert not {"neighbours", "relative"} & set(report.plots(made))
    # Reports that were written before this section was there are still shown.
    earlier = made.to_json()
    del earlier["covariance"], earlier["scene"]["view"], earlier["notices"]
    assert "residuals" in report.plots(SceneReport.read(earlier))


# -- the size of a pixel by direction of view ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Pinhole(SensorModel):
    """A camera over a flat Earth: `aim` is the angle off the vertical, `azimuth` whereto it looks (degrees).

    Ground is in UTM on its central meridian, where 0.9996 m on the map are a metre.
    """

    kind = "pinhole"
    aim: float = 0.0
    azimuth: float = 0.0
    turn: float = 0.0
    altitude: float = 500_000.0
    focal: float = 500_000.0

    @property
    def crs(self) -> str:
        return "EPSG:32636"

    @property
    def domain(self) -> tuple[Array, Array]:
        return np.array([500_000.0, 4_000_000.0, 0.0]), np.array([5000.0, 5000.0, 100.0])

    def ground_to_image(self, ground: Array) -> Array:
        tilt, azimuth, turn = np.radians([self.aim, self.azimuth, self.turn])
        level = np.array([np.sin(azimuth), np.cos(azimuth), 0.0])
        forward = np.sin(tilt) * level - np.cos(tilt) * np.array([0.0, 0.0, 1.0])
        right = np.array([level[1], -level[0], 0.0])
        down = np.cross(forward, right)
        way = (np.asarray(ground) - self.domain[0]) / [0.9996, 0.9996, 1.0] + forward * self.altitude / np.cos(tilt)
        x, y = (self.focal * (way @ axis) / (way @ forward) for axis in (right, down))
        column = np.cos(turn) * x - np.sin(turn) * y
        return np.column_stack([column + 500, np.sin(turn) * x + np.cos(turn) * y + 500])


@pytest.mark.parametrize(("aim", "azimuth", "turn"), [(0.0, 0.0, 0.0), (20.0, 90.0, 0.0), (35.0, 215.0, 30.0)])
def test_pixel_of_a_camera_follows_formula_1(aim, azimuth, turn):
    seen = viewing(Pinhole(aim, azimuth, turn), 1000, 1000)["view"]
    cosine = math.cos(math.radians(aim))
    assert seen["incidence_deg"] == pytest.approx(aim, abs=1e-3)
    assert seen["pixel_m"]["along_view"] == pytest.approx(1.0 / cosine**2, rel=1e-4)
    assert seen["pixel_m"]["across_view"] == pytest.approx(1.0 / cosine, rel=1e-4)
    if aim:
        assert seen["sensor_azimuth_deg"] == pytest.approx((azimuth + 180) % 360, abs=0.01)
    else:
        assert seen["sensor_azimuth_deg"] is None


@pytest.mark.parametrize("off_nadir", [5.0, -20.0, 35.0])
def test_direction_of_view_is_that_of_the_scanner(off_nadir):
    """Against its own rays in ECEF; heading 192 degrees, so that a positive roll looks to the north-west."""
    camera = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=off_nadir, gsd=2.5)
    seen = viewing(camera, camera.width, camera.height)["view"]
    origin, direction = camera.rays([[camera.width / 2, camera.height / 2]])
    lon, lat = np.radians([33.35, 37.25])
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    back = -direction[0]
    assert seen["incidence_deg"] == pytest.approx(np.degrees(np.arccos(back @ up)), abs=0.02)
    azimuth = np.degrees(np.arctan2(back @ east, back @ np.cross(up, east))) % 360
    assert seen["sensor_azimuth_deg"] == pytest.approx(azimuth, abs=0.1)
    # Its lines follow each other at the distance of its pixels, whatever the angle: no cosines here.
    assert seen["pixel_m"]["along_view"] == pytest.approx(2.5, rel=0.01)
    assert seen["pixel_m"]["across_view"] == pytest.approx(2.5, rel=0.01)
    assert np.isfinite(origin).all()
