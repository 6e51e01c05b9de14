"""Bundle adjustment and intersection, against simulated truth that the estimator never sees."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pyproj
import pytest
from ortho_studies.cartosat.truth import StereoPair
from ortho_studies.simulation.scanner import LineScanner
from scipy.stats import chi2

from ortho_pipeline.block.adjustment import _prepared, adjust
from ortho_pipeline.block.equations import solver as block_solver
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.equations.solver import once, solve, solve_inside
from ortho_pipeline.block.equations.steps import Steps
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.intersection import frame_of, intersect
from ortho_pipeline.block.local_frame import GEODETIC, GroundFrame
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.reliability.standardised_residuals import standardise
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, TooFewPoints
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.exchange.rpc import export_rpc
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.models import RPC, FrameCamera, ImageCorrection, SensorModel, start_model
from ortho_pipeline.models.base import Constraints
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.pushbroom.metadata import pushbroom_of_metadata
from ortho_pipeline.points.selection import select_control
from ortho_pipeline.report.notebook.tables import html

LON, LAT = 33.35, 37.25
SIZE = 4000
#: An image of 10 km: its half in degrees, a bit less than that.
REACH = 0.045


def camera(off_nadir_deg: float, heading_deg: float = 192.0) -> LineScanner:
    return LineScanner.over(
        LON, LAT, 850.0, off_nadir_deg=off_nadir_deg, heading_deg=heading_deg, image_width=SIZE, image_height=SIZE,
        heights=(0.0, 1700.0),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rpcs() -> dict[str, RPC]:
    """RPCs of three line scanners over one place, good to 1e-3 px: the truth of most tests is their corrected form."""
    return {
        name: export_rpc(camera(angle, heading)).rpc
        for name, angle, heading in (("left", 18.0, 192.0), ("right", -14.0, 191.0), ("down", 2.0, 200.0))
    }


def places(count: int, seed: int = 0) -> np.ndarray:
    """Return ground points lon, lat, h in the images."""
    random = np.random.default_rng(seed)
    plan = np.column_stack([LON + REACH * random.uniform(-1, 1, count), LAT + REACH * random.uniform(-0.8, 0.8, count)])
    return np.column_stack([plan, random.uniform(200, 1500, count)])


def measured(
    truth: dict[str, SensorModel],
    ground: np.ndarray,
    roles: str | list[str],
    *,
    noise: float = 0.0,
    sigma_ground: float = 0.0,
    seed: int = 2,
    sigma_image: float = 0.5,
) -> BlockPoints:
    """Return points as a careful operator measures them: with noise in the image and errors of the ground."""
    random = np.random.default_rng(seed)
    count = len(ground)
    image = {
        name: model.ground_to_image(ground_transform("EPSG:4979", model.crs)(ground)) for name, model in truth.items()
    }
    seen = np.concatenate(list(image.values()))
    frame = GroundFrame.about(ground)
    known = frame.geodetic(frame.of_geodetic(ground) + random.normal(0, 1, ground.shape) * sigma_ground)
    good = np.isfinite(seen).all(axis=1)
    assert good.all(), "the test's own points lie outside of its images"
    return BlockPoints(
        ids=tuple(f"p{k}" for k in range(count)), ground=known,
        roles=np.array([roles] * count if isinstance(roles, str) else roles, dtype="<U7"),
        sigma_ground=np.full((count, 3), sigma_ground), crs=pyproj.CRS("EPSG:4326"), images=tuple(truth),
        point=np.tile(np.arange(count), len(truth)), image=np.repeat(np.arange(len(truth)), count),
        measured=seen + random.normal(0, 1, seen.shape) * noise, sigma_image=np.full(len(seen), sigma_image),
    )  # fmt: skip


def identity(model: SensorModel, correction: str) -> ImageCorrection:
    return ImageCorrection.identity(model, correction, (SIZE / 2, SIZE / 2))


def roles_of(control: int, check: int, tie: int = 0) -> list[str]:
    return ["control"] * control + ["check"] * check + ["tie"] * tie


def biased(
    rpcs: dict[str, RPC], correction: str = "shift", size: float = 10.0, seed: int = 5
) -> dict[str, ImageCorrection]:
    """Return corrected RPCs as truth: shifts of some pixels, slopes that amount to as much at the edges."""
    random = np.random.default_rng(seed)
    found = {}
    for name, rpc in rpcs.items():
        start = identity(rpc, correction)
        scale = np.array([size if key.endswith("_shift") else size / SIZE for key in start.param_names])
        found[name] = start.with_params(random.normal(0, 1, len(scale)) * scale)
    return found


def starts(truth: dict[str, ImageCorrection]) -> dict[str, SensorModel]:
    return {name: identity(model.model, model.correction) for name, model in truth.items()}


# -- closure ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correction", ["shift", "shift-drift", "affine"])
def test_noise_free_stereo_closes(rpcs: dict[str, RPC], correction: str) -> None:
    truth = biased({name: rpcs[name] for name in ("left", "right")}, correction)
    points = measured(truth, places(40), roles_of(9, 21, 10))
    found = adjust(starts(truth), points)
    assert np.abs(found.residuals).max() < 1e-6
    assert np.nanmax(np.abs(found.back_projected)) < 1e-6
    assert np.nanmax(np.abs(found.object_residuals)) < 1e-5
    wanted = np.concatenate([model.params for model in truth.values()])
    np.testing.assert_allclose(found.values, wanted, rtol=0, atol=1e-6)
    assert not found.rejected
    assert found.redundancy == 2 * 80 + 3 * 9 - len(wanted) - 3 * 40


def test_a_block_of_any_models_in_any_crs_closes(rpcs: dict[str, RPC]) -> None:
    """RPC with a shift, affine families in geocentric, geographic and UTM ground, and a frame camera, all in one."""
    ground = places(60, seed=3)
    truth: dict[str, SensorModel] = {"rpc": biased({"left": rpcs["left"]})["left"]}
    # An affine camera is its own truth: fitted once to the second RPC, then its projections are the measurements.
    single = measured({"right": rpcs["right"]}, ground, "control").in_image("right")
    for crs in ("geocentric", "geographic", "utm"):
        start = start_model("affine3d", single, crs=crs, size=(SIZE, SIZE), heights=(0.0, 1700.0))
        truth[crs] = fit(start, single, robust=False).model
    interior = Interior(SIZE, SIZE, 0.04, 5e-6, 5e-6)
    truth["frame"] = FrameCamera.from_geocentric(
        interior, geocentric(np.array([[LON, LAT, 20e3]]))[0], heights=(0.0, 1700.0)
    )
    points = measured(truth, ground, roles_of(15, 25, 20))
    moved = {name: model.with_params(model.params + 0.01 * np.abs(model.params)) for name, model in truth.items()}
    nudge = np.array([200.0, -150.0, 90.0, 2e-3, -1e-3, 4e-3])
    moved["frame"] = truth["frame"].with_params(truth["frame"].params + nudge)
    found = adjust(moved, points)
    assert np.abs(found.residuals).max() < 1e-6
    assert np.nanmax(np.abs(found.object_residuals)) < 1e-4
    for name, model in truth.items():
        predicted = found.models[name].ground_to_image(ground_transform("EPSG:4979", model.crs)(ground))
        wanted = model.ground_to_image(ground_transform("EPSG:4979", model.crs)(ground))
        np.testing.assert_allclose(predicted, wanted, rtol=0, atol=1e-6)


def test_a_pushbroom_and_an_rpc_in_one_block(rpcs: dict[str, RPC]) -> None:
    """The pushbroom starts from what metadata tell, tens of pixels off; the truth is another camera, with noise."""
    scanner = camera(18.0)
    corners = scanner.image_to_ground([(0, 0), (SIZE, 0), (SIZE, SIZE), (0, SIZE)], 850.0)
    start = pushbroom_of_metadata(
        corners + np.array([8e-4, -6e-4, 0.0]),
        SIZE,
        SIZE,
        altitude=652e3,
        along_deg=0.0,
        across_deg=17.9,
        heights=(0.0, 1700.0),
    )
    truth: dict[str, SensorModel] = {"left": scanner, **biased({"right": rpcs["right"]})}
    points = measured(truth, places(60), roles_of(12, 28, 20), noise=0.3, sigma_ground=0.3, sigma_image=0.3)
    found = adjust({"left": start, "right": identity(rpcs["right"], "shift")}, points)
    assert np.nanmedian(np.abs(found.raw_residuals[points.image == 0])) > 20
    assert not found.rejected
    assert found.sigma0 == pytest.approx(1.0, abs=0.2)
    rms = found.object_rms("check")
    assert rms is not None
    # Noise of 0.3 px (0.75 m) in each image, rays that meet at 32 degrees.
    assert rms.plan < 1.5
    assert rms.h < 2.5
    # Soft constraints on the shape of the orbit decide parameters, and are no observations.
    rays_and_ground = 2 * points.rays + 3 * 12
    assert found.degrees_of_freedom > rays_and_ground - len(found.parameters) - 3 * 60


def test_one_image_with_perfect_ground_is_the_fit_of_one_image(rpcs: dict[str, RPC]) -> None:
    truth = biased({"left": rpcs["left"]}, "affine")
    points = measured(truth, places(20), "control", noise=0.4)
    found = adjust(starts(truth), points)
    alone = fit(starts(truth)["left"], points.in_image("left"))
    np.testing.assert_allclose(found.values, alone.values, rtol=1e-6, atol=1e-8)
    # With the uncertainty of sigma0 itself: the variance of Student's distribution, on a grid.
    student = np.sqrt(found.redundancy / (found.redundancy - 2))
    np.testing.assert_allclose(found.sigmas, student * alone.sigmas, rtol=3e-3)
    assert not found.variances.separable
    assert found.sigma0 == pytest.approx(alone.sigma0, rel=1e-6)
    assert found.redundancy == alone.redundancy
    np.testing.assert_allclose(found.residuals, alone.residuals, atol=1e-5)


def test_errors_of_the_ground_weigh_as_in_the_fit_of_one_image(rpcs: dict[str, RPC]) -> None:
    truth = biased({"left": rpcs["left"]}, "shift-drift")
    points = measured(truth, places(25), "control", noise=0.4, sigma_ground=1.0)
    found = adjust(starts(truth), points, robust=False)
    alone = fit(starts(truth)["left"], points.in_image("left"), robust=False)
    # The fit turns errors of the ground into those of column and row without their correlation.
    np.testing.assert_allclose(found.sigmas, alone.sigmas, rtol=0.2)
    assert (np.abs(found.values - alone.values) < alone.sigmas).all()


# -- covariances of measurements -------------------------------------------------------------------------------------


def test_covariances_that_are_the_same_in_all_directions_change_no_bit(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(30), roles_of(8, 12, 10), noise=0.3, sigma_ground=0.3, sigma_image=0.3)
    plain = adjust(starts(truth), points)
    found = adjust(starts(truth), replace(points, shape_image=np.tile(np.eye(2), (points.rays, 1, 1))))
    np.testing.assert_array_equal(found.ground, plain.ground)
    np.testing.assert_array_equal(found.covariance, plain.covariance)


def leaning(points: BlockPoints, seed: int) -> BlockPoints:
    """Return points whose measurements err by 2 px in one direction, another for each, and by 0.1 px across it."""
    random = np.random.default_rng(seed)
    angle = random.uniform(0, np.pi, points.rays)
    axis = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    across = np.stack([-axis[:, 1], axis[:, 0]], axis=1)
    error = axis * random.normal(0, 2.0, (points.rays, 1)) + across * random.normal(0, 0.1, (points.rays, 1))
    covariance = 2.0**2 * axis[:, :, None] * axis[:, None] + 0.1**2 * across[:, :, None] * across[:, None]
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    return replace(
        points, measured=points.measured + error, sigma_image=sigma, shape_image=covariance / sigma[:, None, None] ** 2
    )


def test_measurements_weigh_by_their_covariances(rpcs: dict[str, RPC]) -> None:
    """Three images see each point, in directions of their own: the good one of each counts, and sigmas say how much."""
    truth = biased(rpcs)
    ground = places(60)
    apart, plain, spread = [], [], []
    for seed in range(4):
        exact = measured(truth, ground, roles_of(15, 0, 45), sigma_ground=0.05, seed=seed)
        points = leaning(exact, seed)
        found = adjust(starts(truth), points)
        assert not found.rejected
        assert found.sigma0 == pytest.approx(1.0, abs=0.15)
        frame = GroundFrame.about(ground)
        apart.append(frame.apart(ground, frame.of_geodetic(found.ground))[15:])
        spread.append(apart[-1] / found.ground_sigmas[15:])
        other = adjust(starts(truth), replace(points, shape_image=None), robust=False)
        plain.append(frame.apart(ground, frame.of_geodetic(other.ground))[15:])
    better, worse = (np.sqrt(np.nanmean(np.square(kept))) for kept in (apart, plain))
    assert better < 0.6 * worse
    # A point whose rays do not meet to begin with, by 2 px at a bad place, is not determined, and named.
    assert np.isnan(spread).mean() < 0.01
    assert np.nanstd(spread) == pytest.approx(1.0, abs=0.12)


def test_an_intersection_weighs_by_covariances(rpcs: dict[str, RPC]) -> None:
    ground = places(400)
    points = leaning(measured(rpcs, ground, "tie"), 3)
    found = intersect(rpcs, points)
    frame = GroundFrame.about(ground)
    errors = frame.apart(ground, frame.of_geodetic(found.ground))
    assert np.nanstd(errors / found.sigmas) == pytest.approx(1.0, abs=0.1)
    plain = intersect(rpcs, replace(points, shape_image=None))
    assert np.nanstd(errors) < 0.6 * np.nanstd(frame.apart(ground, frame.of_geodetic(plain.ground)))


def test_a_gross_error_is_found_across_its_measurement_and_said_in_pixels(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = leaning(measured(truth, places(60), roles_of(15, 0, 45), sigma_ground=0.05), 1)
    assert points.shape_image is not None
    ray = int(np.flatnonzero((points.point == 40) & (points.image == 1))[0])
    across = np.linalg.eigh(points.shape_image[ray])[1][:, 0]
    moved = points.measured.copy()
    moved[ray] += 12.0 * across
    found = adjust(starts(truth), replace(points, measured=moved))
    assert [one.point for one in found.rejected] == ["p40"]


# -- honest covariance -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blocks", [30, pytest.param(60, marks=pytest.mark.slow)])
def test_sigmas_are_honest(rpcs: dict[str, RPC], blocks: int) -> None:
    """(estimate - truth) / sigma has the spread 1, for orientation and for ground points, over simulated blocks."""
    truth = biased(rpcs, "shift-drift")
    ground = places(24, seed=8)
    orientation, ground_ratio, sigma0 = [], [], []
    for seed in range(blocks):
        points = measured(truth, ground, roles_of(6, 9, 9), noise=0.5, sigma_ground=0.8, seed=seed)
        found = adjust(starts(truth), points, robust=False)
        wanted = np.concatenate([model.params for model in truth.values()])
        orientation.append((found.values - wanted) / found.sigmas)
        frame = GroundFrame.about(ground)
        apart = (frame.enu_at(ground) @ (frame.of_geodetic(found.ground) - frame.of_geodetic(ground))[:, :, None])[
            :, :, 0
        ]
        ground_ratio.append(apart / found.ground_sigmas)
        sigma0.append(found.sigma0)
    # Some hundred (correlated) ratios: their spread is known to about a tenth.
    assert np.std(orientation) == pytest.approx(1.0, abs=0.12)
    for axis in range(3):
        assert np.std(np.array(ground_ratio)[:, :, axis]) == pytest.approx(1.0, abs=0.12)
    assert np.mean(sigma0) == pytest.approx(1.0, abs=0.03)


def test_a_stereo_block_recovers_biases_within_their_sigmas(rpcs: dict[str, RPC]) -> None:
    truth = biased({name: rpcs[name] for name in ("left", "right")}, "shift", size=30.0)
    points = measured(truth, places(69), roles_of(9, 60), noise=0.5, sigma_ground=0.3)
    found = adjust(starts(truth), points)
    wanted = np.concatenate([model.params for model in truth.values()])
    assert (np.abs(found.values - wanted) < 4 * found.sigmas).all()
    rms = found.object_rms("check")
    assert rms is not None
    assert rms.n == 60
    # The bias is of 30 px (75 m); what is left is noise of half a pixel and the geometry of 32 degrees.
    assert rms.plan < 2.5
    assert rms.h < 4.0
    before = found.image_rms("left", "check", "raw_residuals")
    after = found.image_rms("left", "check")
    assert before is not None
    assert after is not None
    assert after.total < 1.0 < before.total


# -- check points and ties -------------------------------------------------------------------------------------------


def test_check_points_have_no_influence_through_their_ground(rpcs: dict[str, RPC]) -> None:
    truth = biased({name: rpcs[name] for name in ("left", "right")})
    points = measured(truth, places(40), roles_of(6, 34), noise=0.5, sigma_ground=0.3)
    found = adjust(starts(truth), points)
    wrong = points.ground.copy()
    wrong[points.check] += (0.01, -0.02, 400.0)
    other = adjust(starts(truth), replace(points, ground=wrong))
    assert (other.values == found.values).all()
    np.testing.assert_array_equal(other.ground, found.ground)
    assert np.abs(other.object_residuals[points.check]).min(axis=0)[2] > 300
    # They are tie points as good as any.
    ties = adjust(starts(truth), points.with_roles(np.where(points.check, "tie", points.roles)))
    np.testing.assert_allclose(ties.values, found.values, rtol=0, atol=1e-8)
    assert np.isnan(ties.object_residuals[points.check]).all()


def test_ties_alone_bring_images_together_and_say_what_the_datum_is(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs, "shift", size=5.0)
    points = measured(truth, places(50), "tie", noise=0.2)
    apart = intersect(rpcs, points)
    found = adjust(starts(truth), points)
    assert np.median(np.hypot(*apart.residuals.T)) > 1.0
    assert found.sigma0 == pytest.approx(0.4, abs=0.1)  # noise of 0.2 px, stated as 0.5
    assert "no control points" in found.gauge
    assert "10 px" in found.gauge
    # Corrections stay as small as the ties let them: their mean over the images is about zero, not the truth's.
    assert np.abs(found.values.reshape(3, 2).mean(axis=0)).max() < 1.0
    # Positions are no more certain than the orientation that they hang on: some 10 px of 2.5 m.
    assert 5.0 < np.median(found.ground_sigmas[:, 0]) < 100.0
    loose = adjust(starts(truth), points, hold=1000.0)
    assert np.median(np.hypot(*loose.residuals.T)) == pytest.approx(np.median(np.hypot(*found.residuals.T)), abs=0.02)


def test_how_well_ties_agree_says_nothing_about_the_datum(rpcs: dict[str, RPC]) -> None:
    """Measurements five times better than stated do not make vendors' orientations five times better."""
    two = {name: rpcs[name] for name in ("left", "right")}
    ground = places(30, seed=8)
    frame = GroundFrame.about(ground)
    orientation, misses = [], []
    for seed in range(40):
        truth = biased(two, size=10.0, seed=seed)
        found = adjust(starts(truth), measured(truth, ground, "tie", noise=0.1, seed=seed))
        assert found.sigma0 == pytest.approx(0.2, abs=0.1)
        orientation.append((found.values - np.concatenate([model.params for model in truth.values()])) / found.sigmas)
        apart = frame.of_geodetic(found.ground) - frame.of_geodetic(ground)
        misses.append((frame.enu_at(ground) @ apart[:, :, None])[:, :, 0] / found.ground_sigmas)
    # Forty draws of four shifts: their spread is known to about a tenth.
    assert np.std(orientation) == pytest.approx(1.0, abs=0.25)
    assert np.std(misses) == pytest.approx(1.0, abs=0.25)


def test_priors_define_the_datum_of_a_block_of_ties(rpcs: dict[str, RPC]) -> None:
    truth = biased({name: rpcs[name] for name in ("left", "right")})
    points = measured(truth, places(30), "tie", noise=0.2)
    priors = {
        name: {key: Prior(float(value), 0.5) for key, value in zip(model.param_names, model.params, strict=True)}
        for name, model in truth.items()
    }
    found = adjust(starts(truth), points, priors=priors)
    assert "as delivered" in found.gauge
    wanted = np.concatenate([model.params for model in truth.values()])
    assert np.abs(found.values - wanted).max() < 0.5


def test_constraints_of_a_model_take_part(rpcs: dict[str, RPC]) -> None:
    class Constrained(ImageCorrection):
        """A shift whose column shift was observed by other means."""

        def constraints(self) -> Constraints:
            return Constraints(np.array([observed - self.params[0]]), np.array([[1.0, 0.0]]), np.array([1e-3]))

    truth = biased({"left": rpcs["left"], "right": rpcs["right"]})
    observed = float(truth["left"].params[0])
    points = measured(truth, places(30), roles_of(8, 22), noise=0.5)
    start = starts(truth)
    plain = adjust(start, points)
    start["left"] = Constrained(
        **{key: getattr(start["left"], key) for key in ("model", "correction", "origin", "coefficients")}
    )
    found = adjust(start, points)
    assert found.values[0] == pytest.approx(observed, abs=0.005)
    assert found.redundancy == plain.redundancy + 1
    assert found.sigmas[0] < plain.sigmas[0]


# -- gross errors ----------------------------------------------------------------------------------------------------


def test_gross_errors_in_five_percent_of_the_rays_are_found_and_named(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs, "affine")
    points = measured(truth, places(200), roles_of(9, 0, 191), noise=0.3, sigma_ground=0.3, sigma_image=0.3)
    random = np.random.default_rng(4)
    bad = random.choice(np.flatnonzero(points.point >= 9), 28, replace=False)
    bad = bad[np.unique(points.point[bad], return_index=True)[1]]  # one ray of a point: two of three cannot be told
    spoiled = points.measured.copy()
    angle = random.uniform(0, 2 * np.pi, len(bad))
    spoiled[bad] += np.column_stack([np.cos(angle), np.sin(angle)]) * random.uniform(15, 200, (len(bad), 1))
    found = adjust(starts(truth), replace(points, measured=spoiled))
    listed = {one.point for one in found.rejected}
    wanted = {points.ids[k] for k in points.point[bad]}
    # With three nearly coplanar rays an error along the epipolar lines can hide; nothing good goes.
    assert len(listed & wanted) >= 0.9 * len(wanted)
    assert len(listed - wanted) <= 1
    named = {(one.point, one.image) for one in found.rejected if one.what == "ray"}
    assert len(named & {(points.ids[points.point[k]], points.images[points.image[k]]) for k in bad}) >= 0.7 * len(bad)
    assert found.sigma0 == pytest.approx(1.0, abs=0.15)
    clean = adjust(starts(truth), points)
    assert (np.abs(found.values - clean.values) < 2 * clean.sigmas).all()


@pytest.mark.parametrize("sigma_ground", [0.0, 0.3])
def test_wrong_ground_of_a_control_point_is_named(rpcs: dict[str, RPC], sigma_ground: float) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(40), roles_of(8, 32), noise=0.4, sigma_ground=sigma_ground)
    ground = points.ground.copy()
    ground[3, :2] += 30 / 111_000
    found = adjust(starts(truth), replace(points, ground=ground))
    assert [(one.point, one.what) for one in found.rejected] == [("p3", "ground")]
    assert "m from where its rays meet" in found.rejected[0].reason
    assert not found.used_ground[3]
    assert "7 control points" in found.gauge
    assert found.used_rays[points.point == 3].all()
    clean = adjust(starts(truth), points)
    assert (np.abs(found.values - clean.values) < 2 * clean.sigmas).all()


def test_a_wrong_measurement_of_a_control_point_is_named(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(40), roles_of(8, 32), noise=0.4, sigma_ground=0.3)
    spoiled = points.measured.copy()
    ray = int(np.flatnonzero((points.point == 2) & (points.image == 1))[0])
    spoiled[ray] += (-25.0, 18.0)
    found = adjust(starts(truth), replace(points, measured=spoiled))
    assert [(one.point, one.what, one.image) for one in found.rejected] == [("p2", "ray", "right")]
    assert found.used_ground[2]
    assert not found.used_rays[ray]


def test_too_many_contradictions_are_an_error(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(30), roles_of(6, 24), noise=0.3, sigma_ground=0.1)
    ground = points.ground.copy()
    ground[:3, 0] += (0.002, -0.003, 0.004)
    with pytest.raises(DegeneratePoints, match=r"of 6 control points contradict the others"):
        adjust(starts(truth), replace(points, ground=ground))


def test_noise_is_not_rejected(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs, "affine")
    lost = 0
    for seed in range(10):
        points = measured(truth, places(60, seed), roles_of(9, 51), noise=0.5, sigma_ground=0.3, seed=seed)
        lost += len(adjust(starts(truth), points).rejected)
    assert lost <= 1


@pytest.mark.parametrize(("control", "ties", "seed"), [(1, 8, 90), (2, 5, 111)])
def test_few_points_are_not_refused_by_chance(rpcs: dict[str, RPC], control: int, ties: int, seed: int) -> None:
    """Of some hundred draws of blocks with few points, these had robust weights that left no control at all."""
    truth = biased({name: rpcs[name] for name in ("left", "right")}, seed=seed + 100)
    points = measured(
        truth, places(control + ties, seed=8), roles_of(control, ties), noise=0.5, sigma_ground=0.3, seed=seed
    )
    assert adjust(starts(truth), points).rejected == ()


@pytest.mark.parametrize(("blocks", "most"), [(12, 0), pytest.param(30, 1, marks=pytest.mark.slow)])
def test_good_ground_is_kept_where_measurements_are_better_than_stated(
    rpcs: dict[str, RPC], blocks: int, most: int
) -> None:
    """0.5 px is what is stated by default, 0.1 px what careful people reach; the ground is as good as it is said."""
    lost = 0
    for seed in range(blocks):
        truth = biased(rpcs, "affine", seed=seed + 100)
        points = measured(truth, places(44, seed=8), roles_of(9, 25, 10), noise=0.1, sigma_ground=0.3, seed=seed)
        lost += len(adjust(starts(truth), points).rejected)
    assert lost <= most


# -- ground that states no sigma -------------------------------------------------------------------------------------


def surveyed(
    rpcs: dict[str, RPC],
    control: int,
    sigma: tuple[float, float],
    seed: int,
    *,
    noise: float = 0.1,
    stated: bool = False,
) -> tuple[dict[str, ImageCorrection], BlockPoints, np.ndarray]:
    """Return true models, points (control with errors (m) in plan and height, 10 check, 20 tie), and true ground.

    Pixels are of 2.5 m: 0.1 px are 0.25 m, below what the survey is wrong by, as in images of half a metre.
    """
    truth = biased(rpcs, seed=seed)
    ground = places(control + 30, seed=seed + 50)
    points = measured(truth, ground, roles_of(control, 10, 20), noise=noise, seed=seed)
    random = np.random.default_rng(seed + 900)
    frame = GroundFrame.about(ground)
    wrong = random.normal(0, 1, (control, 3)) * (sigma[0], sigma[0], sigma[1])
    east = frame.enu_at(ground[:control]).swapaxes(1, 2)
    known = points.ground.copy()
    known[:control] = frame.geodetic(frame.of_geodetic(ground[:control]) + (east @ wrong[:, :, None])[:, :, 0])
    points = replace(points, ground=known)
    return truth, points.with_ground_sigma(*sigma) if stated else points, ground


def ratios(found: BlockFit, truth: dict[str, ImageCorrection], ground: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (found - true) / sigma of parameters, and of the ground of all points but control."""
    wanted = np.concatenate([model.params for model in truth.values()])
    frame = GroundFrame.about(ground)
    apart = frame.enu_at(ground) @ (frame.of_geodetic(found.ground) - frame.of_geodetic(ground))[:, :, None]
    return (found.values - wanted) / found.sigmas, (apart[:, :, 0] / found.ground_sigmas)[~found.points.control]


def coverage(
    rpcs: dict[str, RPC], control: int, error: float, runs: int, *, stated: bool = False
) -> tuple[float, float, int, int]:
    """Return how often 1.96 sigmas hold for parameters and for ground, and how many runs refused or lost points."""
    orientation, places_, refused, dropped = [], [], 0, 0
    for seed in range(runs):
        truth, points, ground = surveyed(rpcs, control, (error, error), seed, stated=stated)
        try:
            found = adjust(starts(truth), points)
        except DegeneratePoints:
            refused += 1
            continue
        dropped += bool(found.rejected)
        one, other = ratios(found, truth, ground)
        orientation.append(np.abs(one) < 1.96)
        places_.append(np.abs(other) < 1.96)
    return float(np.mean(orientation)), float(np.mean(places_)), refused, dropped


@pytest.mark.parametrize(("control", "error"), [(4, 0.5), pytest.param(9, 1.0, marks=pytest.mark.slow)])
def test_control_without_sigmas_is_not_refused_and_intervals_hold(
    rpcs: dict[str, RPC], control: int, error: float
) -> None:
    """The reduced form of the test below: the shares of 12 blocks are known to some hundredths."""
    orientation, ground, refused, dropped = coverage(rpcs, control, error, 12)
    assert refused == 0
    assert dropped <= 1  # one of these sets has a point of 3.2 sigma among eight that are better than they should be
    assert 0.86 <= orientation <= 1.0
    assert 0.88 <= ground <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("control", [4, 6, 9, 20])
@pytest.mark.parametrize("error", [0.2, 0.5, 1.0])
def test_intervals_hold_whatever_the_survey_is_worth(rpcs: dict[str, RPC], control: int, error: float) -> None:
    orientation, ground, refused, dropped = coverage(rpcs, control, error, 60)
    assert refused <= 1
    assert dropped <= 3
    # Blocks share the errors of their control: a share of 60 blocks is known to 0.02.
    assert 0.90 <= orientation <= 0.99
    assert 0.92 <= ground <= 0.98


def test_stated_sigmas_of_control_are_not_scaled(rpcs: dict[str, RPC]) -> None:
    """Measurements five times better than stated do not make the survey any better, or any worse."""
    orientation, ground, refused, dropped = coverage(rpcs, 9, 0.5, 12, stated=True)
    assert (refused, dropped) == (0, 0)
    assert 0.88 <= orientation <= 1.0
    assert 0.90 <= ground <= 1.0
    truth, points, _ = surveyed(rpcs, 9, (0.5, 1.0), 3, stated=True)
    found = adjust(starts(truth), points)
    assert found.sigma0 == pytest.approx(0.2, rel=0.3)
    # Nine points of 0.5 m hold the datum to 0.17 m, and their sigma is not scaled by 0.2.
    assert 0.15 < np.median(found.ground_sigmas[points.tie, 0]) < 0.45
    assert found.variances.sigma_xy is None


def test_sigmas_of_the_survey_are_found_and_said(rpcs: dict[str, RPC]) -> None:
    truth, points, _ = surveyed(rpcs, 40, (0.5, 1.5), 5)
    found = adjust(starts(truth), points)
    # 74 and 37 spare observations: known to 8 and 12 percent.
    assert found.variances.sigma_xy == pytest.approx(0.5, rel=0.25)
    assert found.variances.sigma_h == pytest.approx(1.5, rel=0.35)
    assert found.sigma0 == pytest.approx(0.2, rel=0.2)
    assert any("without a stated sigma" in text and "`points.ground_sigma=XY,H`" in text for text in found.warnings)
    document = found.to_json()["variances"]
    assert document["unstated_ground"]["h"]["sigma"] == found.variances.sigma_h
    assert document["unstated_ground"]["xy"]["points"] == 40
    # What is stated by hand is the same as what the points state.
    given = adjust(starts(truth), points.with_ground_sigma(0.5, 1.5))
    assert given.variances.unstated == (0, 0)
    assert (np.abs(given.values - found.values) < found.sigmas).all()
    with pytest.raises(InputError, match="positive"):
        points.with_ground_sigma(0.0)


@pytest.mark.parametrize("control", [6, 9, 20])
def test_a_blunder_among_control_without_sigmas_is_found(rpcs: dict[str, RPC], control: int) -> None:
    """Ten times the true error of the survey, in any direction; of five others, few degrees of freedom have to tell."""
    caught, others = 0, 0
    for seed in range(4):
        truth, points, ground = surveyed(rpcs, control, (0.5, 0.5), seed)
        random = np.random.default_rng(seed)
        apart = random.normal(0, 1, 3)
        frame = GroundFrame.about(ground)
        known = points.ground.copy()
        moved = frame.of_geodetic(ground[:1]) + 5.0 * apart / np.linalg.norm(apart)
        known[0] = frame.geodetic(moved)[0]
        names = {one.point for one in adjust(starts(truth), replace(points, ground=known)).rejected}
        caught += "p0" in names
        others += len(names - {"p0"})
    assert caught >= (2 if control == 6 else 3)
    # One of these sets has a point of 3.2 sigma of its own.
    assert others <= 1


# -- known points that are off ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("axis", "size", "what"), [(2, 9.0, "height"), (0, 9.0, "plan")])
def test_a_wrong_check_point_is_named_and_kept(rpcs: dict[str, RPC], axis: int, size: float, what: str) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(40), roles_of(9, 31), noise=0.3, sigma_ground=0.3)
    good = adjust(starts(truth), points)
    assert good.outlying == ()
    frame = GroundFrame.about(points.ground)
    local, turn = frame.of_geodetic(points.ground), frame.enu_at(points.ground)[20]
    local[20] += turn[axis] * size * np.hypot(0.3, good.ground_sigmas[20, axis])
    found = adjust(starts(truth), replace(points, ground=frame.geodetic(local)))
    assert [(one.point, one.role, one.what) for one in found.outlying] == [("p20", "check", what)]
    assert any("check point p20" in text and "sigma" in text for text in found.warnings)
    assert found.object_rms().n == 31  # type: ignore[union-attr]
    assert found.rejected == ()
    assert found.to_json()["outlying"][0]["point"] == "p20"


def test_control_of_little_weight_that_is_off_is_named(rpcs: dict[str, RPC]) -> None:
    """A sketch map's point, stated as 20 m, is 120 m off: it moves nothing, and no residual of another point tells."""
    truth = biased(rpcs)
    points = measured(truth, places(40), roles_of(9, 31), noise=0.3, sigma_ground=0.3)
    sigma = points.sigma_ground.copy()
    sigma[3] = 20.0
    frame = GroundFrame.about(points.ground)
    local, turn = frame.of_geodetic(points.ground), frame.enu_at(points.ground)[3]
    local[3] += turn[0] * 120.0
    weak = replace(points, sigma_ground=sigma, ground=frame.geodetic(local))
    kept = adjust(starts(truth), weak, robust=False)
    assert [(one.point, one.role, one.what) for one in kept.outlying] == [("p3", "control", "ground")]
    assert kept.outlying[0].metres == pytest.approx(120.0, abs=3.0)
    assert any("control point p3" in text for text in kept.warnings)
    good = adjust(starts(truth), points, robust=False)
    assert (np.abs(kept.values - good.values) < good.sigmas).all()
    # The search for gross errors finds it as well, and then it is no longer there to be named.
    found = adjust(starts(truth), weak)
    assert [one.point for one in found.rejected] == ["p3"]
    assert found.outlying == ()


def test_a_check_point_in_one_image_is_said_to_be_untested(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(20), roles_of(8, 12), noise=0.3, sigma_ground=0.3)
    alone = (points.point != 15) | (points.image == 0)
    points = replace(
        points, point=points.point[alone], image=points.image[alone], measured=points.measured[alone],
        sigma_image=points.sigma_image[alone],
    )  # fmt: skip
    ground = points.ground.copy()
    ground[15, 2] += 500.0
    found = adjust(starts(truth), replace(points, ground=ground))
    assert [text for text in found.warnings if "p15" in text and "not tested" in text]
    assert found.outlying == ()


def test_a_mark_that_was_measured_twice_is_told(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    ground = places(20)
    ground[5] = ground[4] + (0.0, 0.002 / 111_000, 0.0)
    points = measured(truth, ground, roles_of(8, 12), noise=0.3, sigma_ground=0.0)
    points = points.with_ground_sigma(0.1)
    told = [text for text in adjust(starts(truth), points).warnings if "measured twice" in text]
    assert len(told) == 1
    assert "p4 and p5" in told[0]
    # A point that takes no part, or that only checks, adds no redundancy.
    assert not any("measured twice" in text for text in adjust(starts(truth), points, exclude=["p5"]).warnings)


def test_one_step_of_a_robust_round_tests_what_it_leaves(rpcs: dict[str, RPC]) -> None:
    """A step leads from anywhere to the minimum, nearly: rays and known ground are tested by what is left there."""
    truth = biased(rpcs)
    points = measured(truth, places(20), roles_of(9, 11), noise=0.3, sigma_ground=0.3, sigma_image=0.3)
    models = tuple(starts(truth).values())
    frame = frame_of(models, points)
    known = np.where(points.control[:, None], points.known_in(GEODETIC), np.nan)
    problem = BlockProblem(points, models, frame, known)
    everything = Selection.of(np.ones(points.rays, dtype=bool), points.control)
    start = State(models, frame.of_geodetic(points.known_in(GEODETIC)))
    there = solve(problem, start, everything)
    wanted = standardise(there)
    # 3 m and 2 px away: the misfits before the step are some ten sigmas.
    away = there.state.moved(np.full(problem.size, 2.0), np.full((len(points), 3), 3.0))
    found = standardise(once(Linear.at(problem, away, everything))[0])
    np.testing.assert_allclose(found.rays, wanted.rays, atol=1e-2)
    np.testing.assert_allclose(found.ground, wanted.ground, atol=1e-2)
    assert wanted.ground[points.control].max() > 0.1


# -- rank defects ----------------------------------------------------------------------------------------------------


def test_undetermined_parameters_are_named(rpcs: dict[str, RPC]) -> None:
    truth = biased({name: rpcs[name] for name in ("left", "right")}, "affine")
    points = measured(truth, places(30), roles_of(1, 0, 29), noise=0.3)
    with pytest.raises(DegeneratePoints, match=r"left|right"):
        adjust(starts(truth), points)


def test_an_image_with_too_few_points_is_named(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs, "affine")
    points = measured(truth, places(20), roles_of(9, 11))
    few = (points.image == 2) & (points.point >= 2)
    less = replace(
        points, point=points.point[~few], image=points.image[~few], measured=points.measured[~few],
        sigma_image=points.sigma_image[~few],
    )  # fmt: skip
    with pytest.raises(TooFewPoints, match="2 points in the image 'down'"):
        adjust(starts(truth), less)


def test_images_without_points_and_points_without_images_are_errors(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(20), "tie")
    two = {name: model for name, model in starts(truth).items() if name != "down"}
    with pytest.raises(InputError, match="no model of the image 'down'"):
        adjust(two, points)
    with pytest.raises(InputError, match="no points of the image 'more'"):
        adjust({**starts(truth), "more": rpcs["left"]}, points)


def test_points_with_one_ray_or_parallel_rays_are_left_out_and_named(rpcs: dict[str, RPC]) -> None:
    truth: dict[str, SensorModel] = {
        **biased({"left": rpcs["left"]}),
        "twin": biased({"left": rpcs["left"]}, seed=9)["left"],
    }
    points = measured(truth, places(20), roles_of(10, 5, 5), noise=0.3)
    found = adjust({"left": identity(rpcs["left"], "shift"), "twin": identity(rpcs["left"], "shift")}, points)
    assert np.isnan(found.ground[points.check]).all()
    assert any("check points take no part" in text and "p10" in text for text in found.warnings)
    crossed = intersect({"left": rpcs["left"], "twin": rpcs["left"]}, points)
    assert np.isnan(crossed.ground).all()


# -- convergence -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("crs", ["utm", "geocentric"])
def test_an_affine_pair_with_misfits_as_large_as_its_relief_converges(crs: str) -> None:
    """Pixels of 150 m over a relief of few of them: products of parameters and heights bend the model most."""
    tables = StereoPair.make(size=200, seed=3).measure(3)
    roles = select_control(tables["fore"], "even:9").roles
    tables = {name: table.with_roles(roles) for name, table in tables.items()}
    start = {name: start_model("affine3d", tables[name], crs=crs, size=(200, 200)) for name in tables}
    found = adjust(start, BlockPoints.of(tables))
    assert found.rejected == ()
    assert found.sigma0 == pytest.approx(1.0, abs=0.35)
    # Plain steps take 18, each half as long as the one before.
    assert found.iterations <= 10


def test_a_point_that_an_error_leads_out_of_the_models_does_not_keep_the_others(rpcs: dict[str, RPC]) -> None:
    # Two looks that differ by 1.5 degrees: an error of a pixel moves a point by 100 m along them. What starts inside of
    # the RPCs' heights leaves them when the images come right, and has no place there.
    near = export_rpc(camera(16.5)).rpc
    truth = biased({"left": rpcs["left"], "near": near, "right": rpcs["right"]}, "affine", size=4.0)
    points = measured(truth, places(140), roles_of(9, 6, 125), noise=0.3)
    weak = np.arange(100, 140)
    wrong = np.random.default_rng(3).uniform(-14, 14, (len(weak), 2))
    rays = ~((points.image == 2) & np.isin(points.point, weak))
    seen = points.measured.copy()
    seen[np.isin(points.point, weak) & (points.image == 1)] += wrong
    points = replace(points, point=points.point[rays], image=points.image[rays], measured=seen[rays],
                     sigma_image=points.sigma_image[rays])  # fmt: skip
    found = adjust(starts(truth), points, robust=False)
    gone = [one.fields["count"] for one in found.warnings if one.code == "takes-no-part"]
    lost = [name for name, place in zip(points.ids, found.ground, strict=True) if np.isnan(place[0])]
    assert 1 <= sum(gone) == len(lost) < len(weak)
    left = adjust(starts(truth), points, robust=False, exclude=lost)
    for name in truth:
        assert found.models[name].params == pytest.approx(left.models[name].params, rel=1e-6, abs=1e-9)
    # In the search for gross errors, too, where it is what is left of a point that was judged.
    problem, state, selection = _prepared(tuple(starts(truth).values()), points, {}, ())
    with pytest.raises(NotConverged):
        solve(problem, state, selection)
    solved, inside = solve_inside(problem, state, selection)
    assert solved.astray is None
    outside = {points.ids[k] for k in points.point[selection.rays & ~inside.rays]}
    assert outside
    assert outside <= set(lost)


@pytest.mark.parametrize("control", [6, 0])
def test_ties_that_start_outside_of_the_models_take_part_once_images_come_right(
    rpcs: dict[str, RPC], control: int
) -> None:
    """Images that lie a kilometre of height apart: rays meet beyond the RPCs' heights until control says where."""
    moved = {"left": (250.0, 5.0), "right": (-250.0, 5.0)}
    truth = {name: identity(rpcs[name], "shift").with_params(shift) for name, shift in moved.items()}
    points = measured(truth, places(60), roles_of(control, 0, 60 - control), noise=0.3, sigma_ground=0.3)
    if not control:
        with pytest.raises(DegeneratePoints, match="meet outside of their models") as caught:
            adjust(starts(truth), points)
        assert "give control points" in str(caught.value.remedy)
        return
    found = adjust(starts(truth), points)
    assert found.used_rays.all()
    assert not found.rejected
    for name, model in truth.items():
        assert found.models[name].params == pytest.approx(model.params, abs=1.0)
    # They are as good as ties that start where they belong.
    near = adjust(truth, points)
    np.testing.assert_allclose(found.ground, near.ground, rtol=0, atol=1e-8 * 90)


@pytest.mark.parametrize("control", [3, 4])
def test_a_gross_error_that_tilts_a_block_out_of_its_models_is_found(
    rpcs: dict[str, RPC], monkeypatch: pytest.MonkeyPatch, control: int
) -> None:
    """Control points in one corner leave the far side so free that one wrong ray lifts it out of the RPCs' heights."""
    truth, ground = biased(rpcs, "affine"), places(120)
    ground[:control, :2] = np.array([LON, LAT]) + 0.6 * REACH + 0.1 * (ground[:control, :2] - (LON, LAT))
    points = measured(truth, ground, roles_of(control, 0, 120 - control), noise=0.3, sigma_ground=0.2)
    points.measured[1] += (60.0, -40.0)
    evaluated, at = [0], Linear.at.__func__

    def counted(cls: type[Linear], *given: Any) -> Linear:
        evaluated[0] += 1
        return at(cls, *given)

    monkeypatch.setattr(Linear, "at", classmethod(counted))
    if control == 3:
        with pytest.raises(DegeneratePoints, match=r"1 of 3 control points contradict the others \(p1\)"):
            adjust(starts(truth), points)
    else:
        found = adjust(starts(truth), points)
        assert [(one.point, one.what, one.image) for one in found.rejected] == [("p1", "ray", "left")]
    # Points were left out one at a time before, over thousands of evaluations.
    assert evaluated[0] < 200


def test_what_does_not_converge_because_it_is_not_determined_says_so(
    rpcs: dict[str, RPC], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A valley with hardly any slope: the iteration ends before its bottom, and the reason is the points."""
    truth = biased({name: rpcs[name] for name in ("left", "right")}, "affine")
    ground = places(30)
    # Three control points within 3 m say nothing of the slopes of a correction.
    ground[:3] = ground[0] + np.array([(0, 0, 0), (3e-5, 0, 0), (0, 3e-5, 0)])
    points = measured(truth, ground, roles_of(3, 0, 27), noise=0.3, sigma_ground=0.3)
    with pytest.raises(DegeneratePoints, match="do not determine"):
        adjust(starts(truth), points)
    monkeypatch.setattr(block_solver, "_STEPS", 1)
    with pytest.raises(DegeneratePoints, match="do not determine the image") as caught:
        adjust(starts(truth), points)
    assert "control points" in str(caught.value.remedy)
    enough = measured(truth, places(30), roles_of(9, 0, 21), noise=0.3, sigma_ground=0.3)
    with pytest.raises(NotConverged, match="did not converge"):
        adjust(starts(truth), enough)


def test_steps_that_creep_or_overshoot_are_extrapolated() -> None:
    """Errors of a fixed-point iteration that shrink by 0.9 and turn back by -1.6 and -0.5: plain steps diverge."""
    slope = np.diag(1.0 - np.array([0.9, -1.6, -0.5, 0.0]))
    place, steps = np.array([3.0, -2.0, 5.0, 1.0]), Steps()
    for _ in range(12):
        change = -slope @ place
        further = steps.extrapolated(change, change)
        move = change if further is None else further
        steps.made(change, change, move)
        place = place + move
    assert np.abs(place).max() < 1e-9


# -- intersection ----------------------------------------------------------------------------------------------------


def test_intersection_closes_and_its_sigmas_are_honest(rpcs: dict[str, RPC]) -> None:
    ground = places(300)
    exact = intersect(rpcs, measured(rpcs, ground, "tie"))
    assert np.abs(exact.residuals).max() < 1e-6
    np.testing.assert_allclose(exact.ground, ground, rtol=0, atol=1e-6)
    assert (exact.rays == 3).all()
    assert (exact.angles_deg > 25).all()
    noisy = intersect(rpcs, measured(rpcs, ground, "tie", noise=0.3))
    assert noisy.sigma0 == pytest.approx(0.6, abs=0.05)
    frame = GroundFrame.about(ground)
    apart = (frame.enu_at(ground) @ (frame.of_geodetic(noisy.ground) - frame.of_geodetic(ground))[:, :, None])[:, :, 0]
    np.testing.assert_allclose((apart / noisy.sigmas).std(axis=0), 1.0, atol=0.12)


def test_towers_close_to_the_cameras_are_intersected() -> None:
    """Cameras at 500 m, meant for heights of 0 to 400 m: a whole step from 200 m to 400 m ends behind the cameras."""
    utm = "EPSG:32636"
    plan = ground_transform("EPSG:4979", utm)(np.array([[LON, LAT, 0.0]]))[0]
    truth: dict[str, SensorModel] = {
        str(k): FrameCamera(
            Interior(4000, 4000, 0.02, 1e-5, 1e-5), np.array([plan[0] + 30.0 * k, plan[1], 500.0, 0.0, 0.0, 0.1 * k]),
            frame="map", ground_crs=utm, heights=(0.0, 400.0), free=(),
        )
        for k in range(3)
    }  # fmt: skip
    heights = np.linspace(0.0, 400.0, 21)
    seen = np.column_stack([plan[0] + 30.0 + np.linspace(-40, 40, 21), plan[1] + np.linspace(-30, 30, 21), heights])
    found = intersect(truth, measured(truth, ground_transform(utm, "EPSG:4979")(seen), "tie"))
    np.testing.assert_allclose(ground_transform("EPSG:4979", utm)(found.ground), seen, atol=1e-5)


def test_models_without_parameters_are_only_intersected(rpcs: dict[str, RPC]) -> None:
    """Direct georeferencing: the biased RPCs as they are, all points check (Table 3 of Willneff et al.)."""
    truth = biased({name: rpcs[name] for name in ("left", "right")}, size=30.0)
    points = measured(truth, places(40), "check", noise=0.3)
    delivered = {name: rpcs[name] for name in ("left", "right")}
    found = adjust(delivered, points)
    crossed = intersect(delivered, points)
    np.testing.assert_allclose(found.ground, crossed.ground, rtol=0, atol=1e-9)
    assert found.sigma0 == pytest.approx(crossed.sigma0)
    assert found.object_rms("check").plan > 10  # type: ignore[union-attr]
    assert found.parameters == ()
    assert found.covariance.shape == (0, 0)


def test_heights_that_are_not_known_are_left_open(rpcs: dict[str, RPC]) -> None:
    truth = biased({name: rpcs[name] for name in ("left", "right")})
    points = measured(truth, places(30), roles_of(12, 18), noise=0.0)
    ground = points.ground.copy()
    ground[:6, 2] = np.nan
    found = adjust(starts(truth), replace(points, ground=ground))
    assert np.abs(found.residuals).max() < 1e-6
    wanted = np.concatenate([model.params for model in truth.values()])
    np.testing.assert_allclose(found.values, wanted, atol=1e-5)
    assert found.used_ground[:12].all()


def test_document_is_json_and_holds_everything(rpcs: dict[str, RPC]) -> None:
    import json

    truth = biased(rpcs)
    points = measured(truth, places(12), roles_of(6, 3, 3), noise=0.3)
    found: BlockFit = adjust(starts(truth), points, exclude=["p11"])
    document = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert len(document["points"]) == 12
    assert len(document["rays"]) == 36
    assert document["points"][11]["ground"] == [None, None, None]
    assert set(document["images"]) == set(rpcs)
    assert document["images"]["left"]["rms"]["residuals"]["control"]["n"] == 6
    # Without p11, and without a ray that is wrong by 300 px.
    wrong = (points.point == 10) & (points.image == points.images.index("left"))
    spoiled = replace(points, measured=points.measured + 300.0 * wrong[:, None])
    images = adjust(starts(truth), spoiled, exclude=["p11"]).to_json()["images"]
    assert {name: image["rays"] for name, image in images.items()} == {"left": 10, "right": 11, "down": 11}


def test_results_are_short_in_a_console_and_tables_in_a_notebook(rpcs: dict[str, RPC]) -> None:
    truth = biased(rpcs)
    points = measured(truth, places(30), roles_of(6, 20, 4), noise=0.3, sigma_ground=0.1)
    points = replace(points, measured=points.measured + np.where(np.arange(90) == 40, 50.0, 0.0)[:, None])
    found = adjust(starts(truth), points)
    assert repr(points) == "<30 points: 6 control, 20 check, 4 tie; 90 rays in 3 images; >"
    assert repr(found).startswith("<block of 3 images, 30 points: sigma0 0.")
    assert "at 20 check points" in repr(found)
    assert repr(intersect(found.models, points)).startswith("<30 of 30 points intersected from 90 rays: sigma0 ")
    shown = html(found)
    assert "check points" in shown
    assert "left, control points" in shown
    assert "left out: point p10" in shown
    ties = adjust(starts(truth), measured(truth, places(20), "tie", noise=0.3))
    assert "left, tie points" in html(ties)


@pytest.mark.parametrize("axes", [(0, 1), (2,), (0, 1, 2)])
def test_the_chance_of_ground_is_that_of_its_distance_at_each_possible_sigma(axes: tuple[int, ...]) -> None:
    """By the covariance of each node by itself and scipy's distribution, however it is computed."""
    random = np.random.default_rng(4)
    nodes, chances = random.uniform(0.1, 3.0, (40, 3)), random.dirichlet(np.ones(40))
    root, apart = random.normal(size=(len(axes), len(axes))), random.normal(0, 2, len(axes))
    found = Variances(1.0, 1.0, 1.0, (1.0, 1.0, 1.0), (1, 1), nodes=nodes, chances=chances)
    expected = 0.0
    for (image, plan, height), chance in zip(nodes, chances, strict=True):
        spread = image * root @ root.T + np.diag([(plan, plan, height)[axis] for axis in axes])
        expected += chance * chi2.sf(apart @ np.linalg.solve(spread, apart), len(axes))
    assert found.chance_of(apart, root @ root.T, axes) == pytest.approx(expected, rel=1e-9)
