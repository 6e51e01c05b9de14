"""The rigorous line scanner, against a camera of known truth that shares no code with it."""

from __future__ import annotations

import json
import math
import os
import pickle
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from measured import points_of
from ortho_studies.simulation.scanner import LineScanner
from scipy.interpolate import KroghInterpolator
from scipy.spatial.transform import Rotation

from ortho_pipeline.errors import DegeneratePoints, InputError
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.models import Pushbroom, model_from_dict
from ortho_pipeline.models.base import Array, Constraints, SensorModel
from ortho_pipeline.models.pushbroom.constraints import Observations, OrbitShape
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.metadata import mounting_of_angles, pushbroom_of_metadata
from ortho_pipeline.models.pushbroom.rotations import angles_of, exact_rotation, orbital_axes, rotations
from ortho_pipeline.models.pushbroom.splines import Spline, SplineForm
from ortho_pipeline.models.pushbroom.tables import (
    lagrange,
    pushbroom_of_tables,
    rotations_of_angles,
    rotations_of_quaternions,
)
from ortho_pipeline.testing import check_sensor_model

FOCAL, PIXEL = 1.945, 7e-6
HEIGHTS = (0.0, 1260.0)


def scanner(seed: int = 1, size: int = 12000, pitch_deg: float = -26.0, lon: float | None = None) -> LineScanner:
    """Return a camera as CARTOSAT-1's, somewhere; a negative pitch looks forward."""
    random = np.random.default_rng(seed)
    place = random.uniform(-175, 175) if lon is None else lon
    camera = LineScanner.over(
        place,
        random.uniform(-65, 65),
        300.0,
        image_width=size,
        image_height=size,
        gsd=2.5,
        off_nadir_deg=random.uniform(-3, 3),
        heading_deg=random.choice([192.0, -12.0]) + random.normal(0, 2),
        altitude=618e3,
        heights=HEIGHTS,
    )
    return replace(camera, pitch=math.radians(pitch_deg) + random.normal(0, 1e-3), yaw=random.normal(0, 2e-3))


def tables_of(camera: LineScanner, rows: Array) -> tuple[Array, Array, Array]:
    """Return times, positions and camera axes in ECEF, as a vendor would deliver them, from the camera's rays."""
    middle, left = (np.column_stack([np.full(len(rows), column), rows]) for column in (camera.width / 2, 0.0))
    positions, z = camera.rays(middle)
    across = camera.rays(left)[1]
    across = across / (across * z).sum(axis=1)[:, None] - z
    x = -across / np.linalg.norm(across, axis=1)[:, None]
    return rows * camera.line_period, positions, np.stack([x, np.cross(z, x), z], axis=2)


def exact(camera: LineScanner, **options: object) -> Pushbroom:
    """Return the pushbroom of the vendor's tables of a camera."""
    rows = np.linspace(-0.6, 1.6, 45) * camera.height
    times, positions, turns = tables_of(camera, rows)
    return pushbroom_of_tables(
        LineCamera(camera.width, camera.height, camera.width / 2, 0.0, 1 / camera.pixel_tan),
        line_period=camera.line_period,
        first_time=0.0,
        orbit=(times, positions),
        attitude=(times, turns),
        heights=camera.heights,
        **options,  # type: ignore[arg-type]
    )


def metadata_start(camera: LineScanner, seed: int = 0, **options: object) -> Pushbroom:
    """Return the start from what a metadata file says: rounded angles, height off by kilometres, corners by 80 m."""
    random = np.random.default_rng(seed)
    image = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * (camera.width, camera.height)
    corners = camera.image_to_ground(image.astype(float), 200.0)[:, :2] + random.normal(0, 80, 2) / 111e3
    return pushbroom_of_metadata(
        corners,
        camera.width,
        camera.height,
        altitude=618e3 + random.normal(0, 5e3),
        along_deg=-round(math.degrees(camera.pitch)),
        across_deg=round(math.degrees(camera.roll), 1),
        focal_length=1 / camera.pixel_tan * PIXEL,
        pixel_size=PIXEL,
        heights=HEIGHTS,
        **options,  # type: ignore[arg-type]
    )


def sample(camera: SensorModel, count: int, seed: int = 0, noise: float = 0.0) -> tuple[Array, Array]:
    """Return image points with noise, and their true ground at heights all over the range."""
    random = np.random.default_rng(seed)
    size = (camera.width, camera.height) if isinstance(camera, LineScanner) else (12000, 12000)
    image = random.uniform(0, 1, (count, 2)) * size
    ground = camera.image_to_ground(image, random.uniform(*HEIGHTS, count))
    return image + random.normal(0, noise, image.shape), ground


# -- the map ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_tables_of_an_independent_camera_give_its_projections(seed: int) -> None:
    camera = scanner(seed, pitch_deg=(-26.0, 5.0)[seed % 2])
    model = exact(camera)
    image, ground = sample(camera, 300, seed)
    assert np.abs(model.ground_to_image(ground) - image).max() < 1e-6
    assert np.abs(geocentric(model.image_to_ground(image, ground[:, 2])) - geocentric(ground)).max() < 1e-5
    origin, direction = model.rays(image)
    true_origin, true_direction = camera.rays(image)
    assert np.abs(origin - true_origin).max() < 1e-4
    assert np.abs(direction - true_direction).max() < 1e-11


def everything(model: Pushbroom) -> Pushbroom:
    """Return a model that uses all that there is: lever arm, corrections, offsets and drifts; all of it free."""
    camera = replace(model.camera, dx=[1.5, -2.0, 3.0, 0.7], dy=[0.3, 2.0, -1.0], principal_line=-400.0)
    odd = replace(
        model,
        camera=camera,
        lever=np.array([1.0, 2.0, -3.0]),
        path_line=np.array([[30.0, -20.0, 10.0], [0.5, -0.3, 0.1]]),
        attitude_line=np.array([[1e-4, -2e-4, 3e-4], [1e-5, 2e-5, -1e-5]]),
    )
    return odd.freed(*odd.groups)


@pytest.mark.parametrize("lon", [None, 179.99, -180.0])
def test_it_keeps_the_contract(lon: float | None) -> None:
    camera = scanner(3, lon=lon)
    ground = sample(camera, 40, 1)[1]
    check_sensor_model(exact(camera), ground)
    check_sensor_model(metadata_start(camera), ground)
    check_sensor_model(everything(metadata_start(camera, splines=SplineForm(3, 2, 2))), ground)


def test_closed_partials_against_differences_of_a_third_of_a_pixel() -> None:
    """To 1e-6, which a sign or a neglected term would miss by far."""
    model = everything(metadata_start(scanner(3), splines=SplineForm(3, 2, 2)))
    ground = sample(scanner(3), 30, 1)[1]
    partials = model.param_partials(ground)
    for k, name in enumerate(model.param_names):
        step = np.zeros(len(model.params))
        step[k] = 0.3 / np.abs(partials[:, :, k]).max()
        ahead, behind = model.with_params(model.params + step), model.with_params(model.params - step)
        moved = (ahead.ground_to_image(ground) - behind.ground_to_image(ground)) / 2
        assert np.abs(moved - partials[:, :, k] * step[k]).max() < 3e-7, name


def test_a_mirrored_line() -> None:
    model = exact(scanner())
    mirrored = replace(model, camera=replace(model.camera, focal_length=-model.camera.focal_length))
    image, ground = sample(scanner(), 30)
    flipped = mirrored.ground_to_image(ground)
    assert np.abs(flipped[:, 0] - (12000 - image[:, 0])).max() < 1e-6
    assert np.abs(flipped[:, 1] - image[:, 1]).max() < 1e-6
    check_sensor_model(mirrored, ground)


def test_what_is_not_seen_is_nan() -> None:
    model = exact(scanner())
    ground = sample(scanner(), 1)[1]
    antipode = ground * (1, -1, 1) + (180.0, 0.0, 0.0)
    elsewhere = ground + np.array([0.0, 8.0, 0.0])
    holed = np.where(np.eye(3, dtype=bool), np.nan, ground)
    assert np.isnan(model.ground_to_image(np.concatenate([antipode, elsewhere, holed]))).all()
    for point in ([[-12_001.0, 5.0]], [[5.0, 24_001.0]], [[np.nan, 5.0]]):
        assert np.isnan(model.image_to_ground(point, 0.0)).all()
    assert np.isnan(model.image_to_ground([[5.0, 5.0]], 700e3)).all()
    # Outside of the image is legal.
    outside = model.image_to_ground([[-3000.0, 16_000.0]], 100.0)
    assert np.abs(model.ground_to_image(outside) - (-3000.0, 16_000.0)).max() < 1e-6


def test_points_are_projected_by_one_compiled_loop(calls) -> None:
    """As many calls for 200,000 points as for ten; `benchmarks/adjust.py` holds a million points in a second."""
    model = exact(scanner())
    ground = np.tile(sample(scanner(), 2000)[1], (100, 1))
    model.ground_to_image(ground[:10])
    with calls:
        model.ground_to_image(ground[:10])
    few = calls.count
    with calls:
        model.ground_to_image(ground)
    assert calls.count - few == few
    assert few < 100


def test_rounded_rotations_are_made_rotations() -> None:
    """Six printed digits: the inverse of what is printed would be another than its transpose, by 0.05 px."""
    model = exact(scanner())
    rounded = replace(model, mounting=np.round(model.mounting, 6), orbital=np.round(model.orbital, 6))
    image = sample(scanner(), 100)[0]
    assert np.abs(rounded.ground_to_image(rounded.image_to_ground(image, 300.0)) - image).max() < 1e-7
    assert not rounded.mounting.flags.writeable
    again = model_from_dict(json.loads(json.dumps(rounded.to_dict())))
    assert again.to_dict() == rounded.to_dict()


@pytest.mark.parametrize("scale", [1.0 - 1e-6, 1.0 + 1e-6])
def test_matrices_that_are_a_little_too_short_or_long_are_made_rotations(scale: float) -> None:
    made = exact_rotation(scale * exact(scanner()).mounting, "mounting")
    assert np.abs(made.T @ made - np.eye(3)).max() < 1e-14


def test_copies_in_other_processes_project_alike() -> None:
    model = exact(scanner())
    ground = sample(scanner(), 100)[1]
    image = model.ground_to_image(ground)
    assert (pickle.loads(pickle.dumps(model)).ground_to_image(ground) == image).all()


def test_nobody_changes_a_model_through_its_domain() -> None:
    model = exact(scanner(size=200))
    centre, half = model.domain
    for values in (centre, half):
        with pytest.raises(ValueError, match="read-only"):
            values[:] *= 1.5
    np.testing.assert_array_equal(model.domain, exact(scanner(size=200)).domain)


def test_few_parameters_of_many_cost_little() -> None:
    """Partials by the six free parameters of a table with hundreds, which once cost as much as by all of them.

    Arrays are counted, which take what time there is.
    """
    model = exact(scanner())
    ground = np.tile(sample(scanner(), 1000)[1], (5, 1))

    def peak(one: Pushbroom) -> int:
        tracemalloc.start()
        one.param_partials(ground)
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return most

    whole = model.freed(*model.groups)
    few = model.param_partials(ground)
    at = [whole.param_names.index(name) for name in model.param_names]
    assert np.allclose(few, whole.param_partials(ground)[:, :, at], rtol=1e-12, atol=0)
    assert peak(model) < 0.4 * peak(whole)


# -- conventions -----------------------------------------------------------------------------------------------------


def test_signs_of_the_angles() -> None:
    down = np.array([0.0, 0.0, -1.0])
    angle = 0.1
    roll, pitch, yaw = (rotations(angle * axis[None])[0] for axis in np.eye(3))
    assert np.allclose(roll @ down, [0, math.sin(angle), -math.cos(angle)])  # to the left
    assert np.allclose(pitch @ down, [-math.sin(angle), 0, -math.cos(angle)])  # backwards
    assert np.allclose(yaw @ [1, 0, 0], [math.cos(angle), math.sin(angle), 0])  # forward turns to the left
    angles = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    assert np.allclose(angles_of(rotations(angles)), angles)


def test_mounting_is_a_rotation_that_looks_forward_and_to_the_right() -> None:
    mounting = mounting_of_angles(math.radians(26), math.radians(3))
    assert np.allclose(mounting.T @ mounting, np.eye(3))
    assert np.linalg.det(mounting) == pytest.approx(1)
    forward, left, up = mounting[:, 2]
    assert forward / -up == pytest.approx(math.tan(math.radians(26)))
    assert left / up == pytest.approx(math.tan(math.radians(3)))
    # The line runs to the left, and rows grow forward.
    assert mounting[1, 0] > 0.99
    assert mounting[0, 1] > 0.8


def test_quaternions_scalar_first_or_last() -> None:
    turn = rotations_of_quaternions([[2 * math.cos(0.3), 0, 0, 2 * math.sin(0.3)]])[0]
    assert np.allclose(turn @ [1, 0, 0], [math.cos(0.6), math.sin(0.6), 0])
    last = rotations_of_quaternions([[0, 0, math.sin(0.3), math.cos(0.3)]], scalar="last")[0]
    assert np.allclose(last, turn)
    with pytest.raises(InputError):
        rotations_of_quaternions([[0.0, 0, 0, 0]])
    with pytest.raises(InputError):
        rotations_of_quaternions([[1.0, 0, 0, 0]], scalar="middle")


def test_level_flight_of_angles_looks_to_the_centre_of_the_earth() -> None:
    position, velocity = np.array([[7e6, 0.0, 0.0]]), np.array([[0.0, 0.0, 7500.0]])
    turn = rotations_of_angles([[0.0, 0.0, 0.0]], position, velocity)[0]
    assert np.allclose(turn[:, 2], [1, 0, 0])
    assert turn[2, 0] > 0.99
    assert np.linalg.det(turn) == pytest.approx(1)
    rolled = rotations_of_angles([[0.1, 0.0, 0.0]], position, velocity)[0]
    assert (rolled @ [0, 0, -1]) @ turn[:, 1] > 0


def test_a_camera_of_polynomials() -> None:
    across, along = np.array([-0.3, 2e-5, 3e-12, -2e-16]), np.array([1e-3, -4e-9, 1e-13])
    camera = LineCamera.of_polynomials(30_000, 500, across, along)
    column = np.array([0.0, 0.5, 12_345.6, 30_000.0])
    powers = column[:, None] ** np.arange(4)
    assert np.abs(camera.directions(column) - np.stack([powers @ across, powers[:, :3] @ along], axis=1)).max() < 1e-15
    assert len(LineCamera.of_polynomials(10, 10, [0.0, 1e-5], []).dx) == 0
    for across in ([0.1], [0.1, 0.0], [0.1, 0.0, 1e-9]):
        with pytest.raises(InputError, match="does not change with the column"):
            LineCamera.of_polynomials(10, 10, across, [0.0])
    with pytest.raises(InputError, match="a focal length that is not zero"):
        LineCamera(10, 10, 5.0, 0.0, 0.0)
    assert LineCamera(1, 1, 0.5, 0.0, 1.0).directions(np.array([1.0])).tolist() == [[0.5, 0.0]]


# -- splines ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("degree", "beyond"), [(2, 1), (3, 2), (3, 1), (1, 0)])
def test_splines_and_their_continuation(degree: int, beyond: int) -> None:
    random = np.random.default_rng(degree)
    spline = Spline(degree, np.array([0.0, 0.5, 2.0, 3.0]), random.normal(size=(3 + degree, 3)), beyond)
    times = np.array([-2.0, -0.1, 0.0, 0.3, 0.5, 1.9, 2.999, 3.0, 4.5, np.nan])
    origins = np.array([-1.0, *spline.breaks])
    pieces = spline.pieces(origins)
    found = np.searchsorted(spline.breaks, times, side="right")
    d = times - origins[np.minimum(found, 4)]
    expected = np.einsum("njk,nj->nk", pieces[np.minimum(found, 4)], d[:, None] ** np.arange(degree + 1))
    assert np.allclose(spline(times)[:-1], expected[:-1], atol=1e-12)
    assert np.isnan(spline(times)[-1]).all()
    slope = (spline(times[:-1] + 1e-6) - spline(times[:-1] - 1e-6)) / 2e-6
    smooth = [0, 1, 3, 5, 6, 8]
    assert np.allclose(spline(times[:-1], 1)[smooth], slope[smooth], atol=1e-5)
    line = spline.plus_line(np.array([1.0, 2, 3]), np.array([0.1, 0.2, 0.3]), 1.5)
    inside = np.array([0.1, 1.5, 2.9])
    assert np.allclose(line(inside) - spline(inside), [1, 2, 3] + (inside - 1.5)[:, None] * [0.1, 0.2, 0.3])


def test_a_spline_needs_data_everywhere() -> None:
    with pytest.raises(InputError, match="do not determine"):
        Spline.fitted(np.linspace(0, 1, 20), np.zeros((20, 3)), 3, np.linspace(0, 4, 5))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("degree", 0),
        ("breaks", [0.0]),
        ("breaks", [0.0, 2.0, 1.0]),
        ("coefficients", np.zeros((3, 3))),
        ("coefficients", np.full((4, 3), np.nan)),
        ("beyond", 4),
        ("degree", 3.0),
        ("beyond", 1.5),
    ],
)
def test_what_is_no_spline(name: str, value: object) -> None:
    good = {"degree": 3, "breaks": [0.0, 1.0], "coefficients": np.zeros((4, 3)), "beyond": 1}
    with pytest.raises(InputError):
        Spline(**{**good, name: value})  # type: ignore[arg-type]


# -- pseudo-observations ---------------------------------------------------------------------------------------------


def test_partials_of_the_constraints() -> None:
    model = everything(metadata_start(scanner(2), splines=SplineForm(3, 2, 2)))
    table = Observations(np.array([0.1, 1.0]), np.zeros((2, 3)), np.ones((2, 3)))
    model = replace(model, path_observations=(table,))
    found = model.constraints()
    assert len(found) == 2 + 2 + 1 + 3 + 6 + 6
    assert found.jacobian.shape == (len(found), len(model.params))
    for k, name in enumerate(model.param_names):
        step = np.zeros(len(model.params))
        step[k] = 1e-3 if name.startswith(("along", "across", "radial")) else 1e-6
        ahead, behind = model.with_params(model.params + step), model.with_params(model.params - step)
        change = (behind.constraints().residuals - ahead.constraints().residuals) / 2
        allowed = 1e-5 * np.abs(found.jacobian[:, k] * step[k]).max() + 1e-7
        assert np.abs(change - found.jacobian[:, k] * step[k]).max() < allowed, name


def test_a_circle_about_the_earth_meets_its_constraints() -> None:
    model = metadata_start(scanner(4))
    misfit = model.constraints().residuals / model.constraints().sigma
    assert np.abs(misfit).max() < 0.05
    # A path that climbs, and one that bends out of its plane, do not.
    climbing = model.freed("radial_drift").with_params([200.0]).constraints()
    assert np.abs(climbing.residuals / climbing.sigma).max() > 5
    middle = model.path.size // 2
    bent = model.freed(f"across_{middle}").with_params([500.0]).constraints()
    assert np.abs(bent.residuals / bent.sigma).max() > 5


def test_what_is_known_without_points_leaves_them_redundancy() -> None:
    camera = scanner(5)
    points = points_of(*sample(camera, 12, 5, noise=0.5))
    soft = fit(metadata_start(camera), points, robust=False)
    # Twelve of the eighteen parameters are well seen in an image, six hardly: soft constraints decide those.
    assert 24 - 18 < soft.degrees_of_freedom < 24 - 10
    assert soft.redundancy == math.floor(soft.degrees_of_freedom)
    held = fit(metadata_start(camera), points, robust=False, priors={"radial_0": Prior(0.0, 1e4)})
    assert soft.degrees_of_freedom < held.degrees_of_freedom < soft.degrees_of_freedom + 1
    tables = exact(camera, position_sigma=0.5, angle_sigma=1e-5, splines=SplineForm(3, 2, 4)).freed("path", "attitude")
    hard = fit(tables, points, robust=False)
    own = hard.model.constraints()
    assert not own.fictitious.any()
    rows = own.jacobian / own.sigma[:, None]
    seen = 24 - len(tables.params) + np.trace(rows @ hard.covariance @ rows.T)
    assert hard.degrees_of_freedom == pytest.approx(seen, abs=0.01)


def test_tables_hold_the_coefficients_that_they_observe() -> None:
    camera = scanner(6)
    model = exact(camera, position_sigma=0.5, angle_sigma=1e-5).freed("path", "attitude", "attitude_offset")
    image, ground = sample(camera, 9, 6)
    turned = model.with_params(model.params + np.where(np.char.endswith(model.param_names, "_offset"), 3e-4, 0.0))
    found = fit(turned, points_of(image, ground), robust=False)
    check, place = sample(camera, 200, 60)
    # The systematic part is found, the random one stays as the tables have it.
    assert np.abs(found.values[-3:]).max() < 1e-7
    assert np.abs(found.model.ground_to_image(place) - check).max() < 0.01


# -- adjustment ------------------------------------------------------------------------------------------------------


def test_all_scenes_converge_from_metadata_alone() -> None:
    """Nine points of 0.5 px; forward, backward and nadir views by turns.

    9 scenes, and as many as ORTHO_SCENES says: `ORTHO_SCENES=100 pytest tests/models/test_pushbroom.py -k all_scenes`.
    """
    starts, errors = [], []
    for seed in range(int(os.environ.get("ORTHO_SCENES", "9"))):
        camera = scanner(seed, pitch_deg=(-26.0, 5.0, 0.0)[seed % 3])
        start = metadata_start(camera, seed)
        check, place = sample(camera, 100, 1000 + seed)
        starts.append(np.abs(start.ground_to_image(place) - check).max())
        found = fit(start, points_of(*sample(camera, 9, seed, noise=0.5)), robust=False)
        errors.append(np.sqrt(((found.model.ground_to_image(place) - check) ** 2).mean()))
    assert max(starts) < 500
    # Points at random places leave corners to extrapolation: typically below a pixel, never far off.
    assert np.median(errors) < 0.7
    assert max(errors) < 5


def test_perturbed_and_readjusted() -> None:
    """Position bias and attitude drift are taken back by nine points, exactly without noise."""
    for seed in range(3):
        camera = scanner(seed)
        good = exact(camera)
        wrong = replace(
            good,
            path_line=np.array([[30.0, -20.0, 15.0], [0.0, 0.0, 0.0]]),
            attitude_line=np.array([[2e-4, -1e-4, 3e-4], [2e-5, -1e-5, 3e-5]]),
        )
        check, place = sample(camera, 200, 100 + seed)
        assert np.abs(wrong.ground_to_image(place) - check).max() > 20
        found = fit(wrong, points_of(*sample(camera, 9, seed, noise=0.2), sigma=0.2), robust=False)
        assert np.sqrt(((found.model.ground_to_image(place) - check) ** 2).mean()) < 0.4
        turned = replace(wrong, path_line=np.zeros((2, 3)))
        clean = fit(turned, points_of(*sample(camera, 9, seed)), robust=False)
        assert np.abs(clean.residuals).max() < 1e-6
        assert np.abs(clean.model.ground_to_image(place) - check).max() < 1e-6


@pytest.mark.parametrize("scenes", [15, pytest.param(40, marks=pytest.mark.slow)])
def test_honest_covariance(scenes: int) -> None:
    """Estimates scatter about the truth of an independent camera as their covariance says."""
    camera = scanner(8)
    model = exact(camera)
    parameters, predicted, weights = [], [], []
    for seed in range(scenes):
        found = fit(model, points_of(*sample(camera, 12, seed, noise=0.5)), robust=False)
        parameters.append(found.values / found.sigmas)
        predicted.append((found.predicted - sample(camera, 12, seed)[0]) / found.image_sigma(found.points.ground))
        weights.append(found.sigma0)
    # The truth of every offset and drift is zero. Of 40 scenes 240 values with t-tails: 1.05 +- 0.06.
    assert 0.9 < np.sqrt(np.mean(np.square(parameters))) < 1.2
    assert 0.9 < np.sqrt(np.mean(np.square(predicted))) < 1.2
    assert 0.9 < np.sqrt(np.mean(np.square(weights))) < 1.1


@pytest.mark.parametrize("scenes", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_honest_covariance_with_soft_constraints(scenes: int) -> None:
    """Predictions from metadata and 15 points are as uncertain as they say, although constraints were only guessed."""
    scaled, weights = [], []
    for seed in range(scenes):
        camera = scanner(seed, pitch_deg=(-26.0, 5.0, 0.0)[seed % 3])
        found = fit(metadata_start(camera, seed), points_of(*sample(camera, 15, seed, noise=0.5)), robust=False)
        check, place = sample(camera, 20, 1000 + seed)
        scaled.append((found.model.ground_to_image(place) - check) / found.image_sigma(place))
        weights.append(found.sigma0)
    assert 0.8 < np.sqrt(np.mean(np.square(scaled))) < 1.3
    assert 0.9 < np.sqrt(np.mean(np.square(weights))) < 1.1


def test_less_than_one_observation_to_spare_tells_nothing_of_weights() -> None:
    """Five points and the soft constraints: what is to spare is a fraction, and no sigma is scaled by it."""
    for seed, enough in ((18, False), (19, True)):
        points = points_of(*sample(scanner(seed), 5, seed, noise=0.5))
        found = fit(metadata_start(scanner(seed), seed), points, robust=False)
        assert 0.5 < found.degrees_of_freedom < 1.5
        assert found.redundancy == int(enough)
        assert (found.sigma0 is not None) == enough


def test_points_that_do_not_determine_it_are_refused() -> None:
    camera = scanner(9)
    # In the middle row the derivatives by a drift are nothing but rounding.
    for row in (6000.0, 2000.0):
        image = np.column_stack([np.linspace(100, 11_900, 9), np.full(9, row)])
        ground = camera.image_to_ground(image, 100.0)
        with pytest.raises(DegeneratePoints):
            fit(exact(camera), points_of(image, ground), robust=False)


def test_an_rpc_beside_the_antimeridian_has_an_offset_that_others_read() -> None:
    """The satellite on the other side: longitudes are given about its own, beyond 180 degrees."""
    camera = LineScanner.over(
        179.7, -20.0, 300.0, image_width=1000, image_height=1000, gsd=30.0, off_nadir_deg=25.0, heading_deg=192.0,
        altitude=618e3, heights=HEIGHTS,
    )  # fmt: skip
    model = exact(camera)
    (west, south, _), (east, north, _) = (model.domain[0] + sign * model.domain[1] for sign in (-1, 1))
    assert west < -180
    rpc = fit_rpc(model, (west, south, east, north), HEIGHTS).rpc
    assert rpc.lon_off == pytest.approx(179.7, abs=0.1)
    ground = model.domain[0] + np.random.default_rng(0).uniform(-0.9, 0.9, (50, 3)) * model.domain[1]
    assert np.abs(rpc.ground_to_image(ground) - model.ground_to_image(ground)).max() < 0.01


def test_an_rpc_of_a_pushbroom() -> None:
    model = metadata_start(scanner(10))
    centre, half = model.domain
    low, high = centre - half, centre + half
    found = fit_rpc(model, (low[0], low[1], high[0], high[1]), HEIGHTS)
    assert found.max_error_px < 0.01
    image = np.random.default_rng(0).uniform(0, 12_000, (500, 2))
    ground = model.image_to_ground(image, np.random.default_rng(1).uniform(*HEIGHTS, 500))
    assert np.abs(found.rpc.ground_to_image(ground) - image).max() < 0.01


# -- metadata and files ----------------------------------------------------------------------------------------------


def test_focal_length_from_the_rows() -> None:
    camera = scanner(11)
    image = np.array([[0.0, 0.0], [12_000, 0], [12_000, 12_000], [0, 12_000]])
    corners = camera.image_to_ground(image, 0.0)
    model = pushbroom_of_metadata(corners, 12_000, 12_000, altitude=618e3, along_deg=26.0, heights=HEIGHTS)
    assert model.camera.focal_length == pytest.approx(1 / camera.pixel_tan, rel=0.03)
    assert np.abs(model.ground_to_image(corners) - image).max() < 100


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"corners": [[0, 0], [1, 0], [1, 1]]}, "corners"),
        ({"corners": [[0, 100], [0.2, 100], [0.2, 99], [0, 99]]}, "corners"),
        ({"corners": [[0, 0.2], [0.2, 0.2], [0, 0], [0.2, 0]]}, "corners"),
        ({"corners": [[0, np.nan], [0.2, 0.2], [0.2, 0], [0, 0]]}, "corners"),
        ({"altitude": 618.0}, "altitude"),
        ({"altitude": -5e3}, "altitude"),
        ({"along_deg": 89.0}, "along_deg"),
        ({"pixel_size": 7e-6}, "pixel_size"),
        ({"focal_length": math.inf, "pixel_size": 7e-6}, "focal_length"),
        ({"heights": (100.0, 0.0)}, "heights"),
    ],
)
def test_impossible_metadata(change: dict[str, object], field: str) -> None:
    good = {
        "corners": [[0, 0.2], [0.2, 0.25], [0.25, 0.05], [0.05, 0]],
        "width": 12_000,
        "height": 12_000,
        "altitude": 618e3,
        "along_deg": 26.0,
    }
    with pytest.raises(InputError) as caught:
        pushbroom_of_metadata(**{**good, **change})  # type: ignore[arg-type]
    assert field in str(caught.value.field)


@pytest.mark.parametrize("what", ["short", "unordered", "late", "holed", "few"])
@pytest.mark.parametrize("table", ["orbit", "attitude"])
def test_impossible_tables(table: str, what: str) -> None:
    camera = scanner(12)
    times, positions, turns = tables_of(camera, np.linspace(-0.6, 1.6, 20) * camera.height)
    tables = {"orbit": (times, positions), "attitude": (times, turns)}
    column, values = tables[table]
    tables[table] = {
        "short": (column[:10], values[:10]),
        "unordered": (column[::-1], values),
        "late": (column + 100.0, values),
        "holed": (column, np.where(np.arange(20).reshape(-1, *[1] * (values.ndim - 1)) == 3, np.nan, values)),
        "few": (column[[0, -1]], values[[0, -1]]),
    }[what]
    with pytest.raises(InputError) as caught:
        pushbroom_of_tables(
            LineCamera(12_000, 12_000, 6000.0, 0.0, 277_857.0),
            line_period=camera.line_period,
            first_time=0.0,
            orbit=tables["orbit"],
            attitude=tables["attitude"],
        )
    assert caught.value.field == table


@pytest.mark.parametrize("late", [0.009, 0.02])
def test_an_orbit_may_begin_a_little_late(late: float) -> None:
    """As Pleiades Neo's do: a hundredth of the image is followed backwards, more is not known."""
    camera = scanner(12)
    (times, positions, _), (turned_at, _, turns) = (
        tables_of(camera, np.linspace(first, 1.6, 200) * camera.height) for first in (late, -0.6)
    )

    def made() -> Pushbroom:
        return pushbroom_of_tables(
            LineCamera(12_000, 12_000, 6000.0, 0.0, 277_857.0), line_period=camera.line_period, first_time=0.0,
            orbit=(times, positions), attitude=(turned_at, turns),
        )  # fmt: skip

    if late > 0.01:
        with pytest.raises(InputError, match="after the first row, but the image needs 0 to"):
            made()
        return
    place, whole = made().rays([[5.0, 0.5]])[0], camera.rays(np.array([[5.0, 0.5]]))[0]
    assert np.linalg.norm(place - whole) < 1e-3


@pytest.mark.parametrize("spoil", [2.0, np.array([-1.0, 1.0, 1.0])])
@pytest.mark.parametrize("mounting", [None, np.eye(3)])
def test_tables_of_what_is_no_rotation(spoil: object, mounting: Array | None) -> None:
    """Scaled or mirrored axes: their angles alone would look like an attitude."""
    camera = scanner(12)
    times, positions, turns = tables_of(camera, np.linspace(-0.6, 1.6, 20) * camera.height)
    with pytest.raises(InputError) as caught:
        pushbroom_of_tables(
            LineCamera(12_000, 12_000, 6000.0, 0.0, 277_857.0),
            line_period=camera.line_period,
            first_time=0.0,
            orbit=(times, positions),
            attitude=(times, turns * spoil),
            mounting=mounting,
        )
    assert caught.value.field == "attitude"


@pytest.mark.parametrize("degree", [1, 2, 4, 5])
def test_tables_by_splines_of_other_degrees(degree: int) -> None:
    image, ground = sample(scanner(13), 50)
    model = exact(scanner(13), splines=SplineForm(degree))
    assert np.abs(model.ground_to_image(ground) - image).max() < (2.0 if degree == 1 else 1e-3)


def test_sparse_tables_and_other_clocks() -> None:
    """A table every ten seconds, in seconds of the day, is as good as a dense one."""
    camera = scanner(13)
    rows = np.arange(-4, 6) * 10.0 / camera.line_period
    times, positions, turns = tables_of(camera, rows)
    model = pushbroom_of_tables(
        LineCamera(camera.width, camera.height, camera.width / 2, 0.0, 1 / camera.pixel_tan),
        line_period=camera.line_period,
        first_time=40_000.0,
        orbit=(times + 40_000.0, positions),
        attitude=(times + 40_000.0, turns),
    )
    image, ground = sample(camera, 50)
    assert np.abs(model.ground_to_image(ground) - image).max() < 1e-3


@pytest.mark.parametrize(
    "change",
    [
        {"line_period": 0.0},
        {"mounting": 2 * np.eye(3)},
        {"orbital": np.diag([1.0, 1.0, -1.0])},
        {"origin": [0.0, 0.0]},
        {"lever": [np.nan, 0.0, 0.0]},
        {"free": ("roll_0", "roll_0")},
        {"free": ("no_such",)},
        {"camera": {"width": 0, "height": 5, "principal_column": 0.0, "principal_line": 0.0, "focal_length": 1.0}},
        {"path": None},
        {"shape": {"plane": -1.0}},
        {"shape": {"radius": 7e6}},
        {"path_observations": [{"times": [0.0], "values": [[0.0, 0.0]], "sigma": [[1.0, 1.0]]}]},
        {"attitude_observations": [{"times": [0.0], "values": [[0.0] * 3], "sigma": [[0.0] * 3]}]},
        {"attitude_observations": [{"times": [0.0], "values": [[0.0] * 3], "sigma": [[1.0] * 3], "fictitious": "no"}]},
        {"path_observations": {}},
        {"shape": {"plane": 1.0, "samples": 10**9}},
        {"shape": {"plane": 1.0, "samples": math.nan}},
        {"camera": {"width": 2.5, "height": 5, "principal_column": 0.0, "principal_line": 0.0, "focal_length": 1.0}},
        {"camera": {"width": 1e300, "height": 5, "principal_column": 0.0, "principal_line": 0.0, "focal_length": 1.0}},
        {"kind": []},
    ],
)
def test_files_that_are_no_pushbroom(change: dict[str, object]) -> None:
    data = metadata_start(scanner()).to_dict()
    with pytest.raises(InputError):
        model_from_dict({**data, **change})


def test_a_shape_without_constraints_is_empty() -> None:
    assert len(replace(metadata_start(scanner()), shape=OrbitShape(), attitude_observations=()).constraints()) == 0


# -- small parts against closed forms --------------------------------------------------------------------------------


def test_rotations_and_orbital_axes_are_those_of_scipy_and_of_vectors() -> None:
    angles = np.random.default_rng(2).uniform(-1, 1, (10, 3))
    assert np.allclose(rotations(angles), Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix(), atol=1e-15)
    # Above longitude 0 on the equator, flying north and a little away from the Earth: left is west.
    assert np.allclose(
        orbital_axes(np.array([7e6, 0, 0]), np.array([100.0, 0, 7500])), [[0, 0, 1], [0, -1, 0], [1, 0, 0]]
    )
    # The platform follows the inertial velocity, to which the rotation of the Earth adds 7.292115e-5 x 7e6 m/s east.
    turn = rotations_of_angles([[0.0, 0.0, 0.0]], [[7e6, 0.0, 0.0]], [[0.0, 0.0, 7500.0]])[0]
    forward = np.array([0.0, 7.292115e-5 * 7e6, 7500.0]) / math.hypot(7.292115e-5 * 7e6, 7500.0)
    assert np.allclose(turn[:, 0], forward, atol=1e-9)
    assert np.allclose(turn[:, 1], np.cross([1.0, 0.0, 0.0], forward), atol=1e-9)


def test_a_camera_of_a_table_of_look_angles() -> None:
    x = np.linspace(0.0, 1000.0, 21)
    xi = x / 500 - 1
    u, v = (x - 480.0 + 3.0 * xi**3) / 2000.0, 1e-3 - 2.0 * xi**2 / 2000.0
    camera = LineCamera.of_table(1000, 500, x, u, v)
    assert np.abs(camera.directions(x) - np.stack([u, v], axis=1)).max() < 1e-12
    assert (len(camera.dx), len(camera.dy)) == (4, 3)  # a cubic and a parabola
    straight = LineCamera.of_table(1000, 500, x, (x - 480.0) / -2000.0, np.full(21, 1e-3))
    assert straight.focal_length == pytest.approx(-2000.0)
    assert (straight.principal_column, straight.principal_line) == pytest.approx((480.0, 2.0))
    assert len(straight.dx) == len(straight.dy) == 0
    near = np.array([3.0, 3.5, 4.0])
    close = LineCamera.of_table(1000, 500, near, (near - 480.0) / 2000.0, np.zeros(3))
    assert close.focal_length == pytest.approx(2000.0)
    # A zigzag of 0.02 px is rounding if the table is rounded to that, else no line of detectors.
    zigzag = u + 0.02 / 2000 * (-1.0) ** np.arange(21)
    assert len(LineCamera.of_table(1000, 500, x, zigzag, v, rounding=0.03).dx) == 4
    with pytest.raises(InputError, match="not those of a smooth line"):
        LineCamera.of_table(1000, 500, x, zigzag, v)
    # Up to 0.005 px count as smooth.
    fine = u + 0.001 / 2000 * (-1.0) ** np.arange(21)
    assert np.abs(LineCamera.of_table(1000, 500, x, fine, v).directions(x)[:, 0] - fine).max() < 0.005 / 2000
    two = LineCamera.of_table(1000, 500, x[[0, -1]], u[[0, -1]], v[[0, -1]])
    assert np.abs(two.directions(x[[0, -1]])[:, 0] - u[[0, -1]]).max() < 1e-12
    wrong = (x[::-1], u), (np.maximum(x, 60.0), u), (x[:1], u[:1]), (x, np.full(21, 0.1)), (x, u + np.inf)
    for columns, across in wrong:
        with pytest.raises(InputError):
            LineCamera.of_table(1000, 500, columns, across, v[: len(across)])


def test_misfits_of_an_orbit_are_those_of_its_shape() -> None:
    radius, speed, climb, bend = 7e6, 7500.0, 40.0, 3.0

    def path(times: Array, derivative: int) -> tuple[Array, Array]:
        """Straight ahead in y while it climbs in x, and along a parabola in z that is zero at 0 and 4 seconds."""
        one = np.ones_like(times)
        places = np.stack([radius + climb * times, speed * times, bend * times * (4 - times)], axis=1)
        rates = np.stack([climb * one, speed * one, bend * (4 - 2 * times)], axis=1)
        return (places, rates)[derivative], np.zeros((len(times), 3, 1))

    plane = OrbitShape(plane=10.0, samples=1).of(path, (0.0, 4.0))
    assert plane.residuals == pytest.approx([-bend * 2 * 2])  # 12 m above the plane of both ends
    assert plane.sigma.tolist() == [10.0]
    circular = OrbitShape(circular=1e-3, samples=1).of(path, (0.0, 4.0))
    place, rate = np.array([radius + 80, 15e3, 12.0]), np.array([climb, speed, 0.0])
    assert circular.residuals == pytest.approx([-place @ rate / np.linalg.norm(place) / np.linalg.norm(rate)])
    height = OrbitShape(radius=7.001e6, radius_sigma=5.0).of(path, (0.0, 4.0))
    assert height.residuals == pytest.approx([7.001e6 - np.linalg.norm(place)], abs=1e-6)
    both = OrbitShape(plane=10.0, circular=1e-3, samples=3).of(path, (0.0, 4.0))
    assert both.sigma.tolist() == [10.0] * 3 + [1e-3] * 3
    assert both.fictitious.all()


def test_a_scene_lasts_as_long_as_kepler_says() -> None:
    # Two degrees to the south at a distance of 7000 km: 5828.5 s for a whole orbit.
    corners = np.array([[0.0, 1.0], [0.5, 1.0], [0.5, -1.0], [0.0, -1.0]])
    altitude = 7000e3 - 6378137.0
    model = pushbroom_of_metadata(corners, 6000, 24_000, altitude=altitude, along_deg=0.0, heights=(-1.0, 1.0))
    # Degrees of latitude are 0.7 % shorter at the equator.
    assert model.line_period * 24_000 == pytest.approx(5828.5 * 2 * 0.99331 / 360, rel=1e-3)


def test_lagrange_follows_polynomials_of_degree_seven_and_short_tables() -> None:
    times = np.array([0.0, 1.0, 1.5, 3.0, 4.0, 6.0, 6.5, 8.0])
    wanted = np.array([-0.5, 0.0, 2.2, 7.9])
    for degree, table in ((7, times), (2, times[:3]), (7, np.concatenate([times - 20, times]))):
        values, rates = lagrange(table, np.stack([table**degree, table, 1 + 0 * table], axis=1), wanted)
        assert np.allclose(values, np.stack([wanted**degree, wanted, 1 + 0 * wanted], axis=1), rtol=1e-9, atol=1e-6)
        slopes = degree * wanted ** (degree - 1)
        assert np.allclose(rates, np.stack([slopes, 1 + 0 * wanted, 0 * wanted], axis=1), rtol=1e-7, atol=1e-5)


def test_lagrange_takes_the_four_neighbours_on_each_side() -> None:
    """Of values that no polynomial follows, against SciPy; near the ends of a table the first or the last eight."""
    random = np.random.default_rng(3)
    times, values = np.cumsum(random.uniform(0.5, 1.5, 20)), random.normal(size=(20, 3))
    for after, first in ((10, 6), (13, 9), (4, 0), (1, 0), (17, 12), (19, 12)):
        wanted = np.array([0.7 * times[after - 1] + 0.3 * times[after]])
        near = slice(first, first + 8)
        polynomial = KroghInterpolator(times[near], values[near])
        found, rates = lagrange(times, values, wanted)
        np.testing.assert_allclose(found, polynomial(wanted), rtol=1e-8)
        np.testing.assert_allclose(rates, polynomial.derivative(wanted), rtol=1e-8)


@pytest.mark.parametrize(
    ("away", "said"),
    [(1e10, "where no satellite can be"), (-1e10, "where no satellite can be"), (1e6, "no satellite is that fast")],
)
def test_positions_of_no_satellite_are_refused(away: float, said: str) -> None:
    camera = scanner(12)
    times, positions, turns = tables_of(camera, np.linspace(-0.6, 1.6, 20) * camera.height)
    positions[7] += away
    with pytest.raises(InputError, match=said):
        pushbroom_of_tables(
            LineCamera(12_000, 12_000, 6000.0, 0.0, 277_857.0), line_period=camera.line_period, first_time=0.0,
            orbit=(times, positions), attitude=(times, turns),
        )  # fmt: skip


@pytest.mark.parametrize(("what", "at"), [("times", 3), ("values", 3)])
def test_a_spline_needs_times_and_values_that_are_numbers(what: str, at: int) -> None:
    table = {"times": np.linspace(0.0, 1.0, 9), "values": np.ones((9, 3))}
    assert np.allclose(Spline.fitted(**table, degree=2, breaks=[0.0, 1.0])(np.array([0.5])), 1.0)
    table[what][at] = np.nan
    with pytest.raises(InputError, match="no spline can follow"):
        Spline.fitted(**table, degree=2, breaks=[0.0, 1.0])


def test_a_derivative_of_a_spline_beyond_its_degree_is_zero() -> None:
    line = Spline(1, np.array([0.0, 1.0]), np.array([[0.0, 1.0, 2.0], [3.0, 5.0, 7.0]]))
    assert np.allclose(line(np.array([-1.0, 0.5, 2.0]), 1), [3.0, 4.0, 5.0])
    assert not line(np.array([-1.0, 0.5, 2.0]), 2).any()


@pytest.mark.parametrize("change", [{"samples": 0}, {"samples": 1.5}, {"plane": 0.0}, {"circular": math.inf}])
def test_impossible_shapes_of_orbits_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(InputError):
        OrbitShape(**change)  # type: ignore[arg-type]


def test_partials_of_the_shape_of_an_orbit_that_is_no_circle() -> None:
    """A steep path: on a circle the terms with the cosine vanish."""

    def shape(values: Array) -> Constraints:
        climb, bend, tilt = values

        def path(times: Array, derivative: int) -> tuple[Array, Array]:
            one, zero, arc = np.ones_like(times), np.zeros_like(times), times * (4 - times)
            places = [7e6 + climb * times, 7500 * times, bend * arc + tilt * times]
            slopes = [[times, zero, zero], [zero, zero, zero], [zero, arc, times]]
            if derivative:
                places = [climb * one, 7500 * one, bend * (4 - 2 * times) + tilt * one]
                slopes = [[one, zero, zero], [zero, zero, zero], [zero, 4 - 2 * times, one]]
            return np.stack(places, axis=1), np.moveaxis(np.array(slopes), 2, 0)

        return OrbitShape(plane=10.0, circular=1e-3, radius=7e6, radius_sigma=9.0, samples=3).of(path, (0.0, 4.0))

    start = np.array([3000.0, 50.0, 700.0])
    found = shape(start)
    assert abs(found.residuals[3:6]).min() > 0.3
    for k, step in enumerate(np.eye(3)):
        change = (shape(start - step).residuals - shape(start + step).residuals) / 2
        # Relative to the largest of each kind.
        for rows in (slice(0, 3), slice(3, 6), slice(6, 7)):
            largest = np.abs(found.jacobian[rows]).max()
            assert np.abs(change - found.jacobian[:, k])[rows].max() < 1e-5 * largest
