"""Frame camera: contract, truth, honest covariance, self-calibration, start from nothing, refraction, RPC export."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, TooFewPoints
from ortho_pipeline.estimation.family_fit import prune
from ortho_pipeline.estimation.fit import Prior, fit
from ortho_pipeline.estimation.problem import Problem
from ortho_pipeline.geodesy.ellipsoid import angles_of_rotation, geocentric, geodetic, meet_height, rotation_of_angles
from ortho_pipeline.models import ImageCorrection, model_from_dict
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.frame.camera import EXTERIOR, MAP, PARAMETERS, FrameCamera
from ortho_pipeline.models.frame.orientation import camera_from_platform, heights_below
from ortho_pipeline.models.frame.resection import resect
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points
from ortho_pipeline.testing import check_sensor_model

BILSAT = Interior(2048, 2048, 0.180, 27.6 * 0.180 / 686e3, 27.6 * 0.180 / 686e3)
AERIAL = Interior(1000, 1500, 0.120, 1e-4, 1e-4)
DISTORTED = Interior(2048, 2048, 0.18, 7.3e-6, 7.2e-6, 3e-5, -2e-5, -0.2, 0.05, 0.01, 1e-3, -5e-4)
PLACE = (32.8, 39.9)


def satellite(tilt: float, heading: float, interior: Interior = BILSAT, **others) -> FrameCamera:
    """A camera 686 km over Ankara; angles in degrees."""
    angles = np.radians([2.0, tilt, heading])
    return FrameCamera.from_roll_pitch_yaw(interior, (*PLACE, 686e3), *angles, heights=(700.0, 1900.0), **others)


def aerial(**others) -> FrameCamera:
    angles = np.radians([3.0, -5.0, 140.0])
    return FrameCamera.from_roll_pitch_yaw(AERIAL, (*PLACE, 6000.0), *angles, heights=(700.0, 1900.0), **others)


def measured(
    camera: FrameCamera, count: int, noise: float = 0.0, seed: int = 0, heights: tuple[float, float] | None = None
) -> Points:
    random = np.random.default_rng(seed)
    image = random.uniform(0.03, 0.97, (count, 2)) * (camera.interior.width, camera.interior.height)
    ground = camera.image_to_ground(image, random.uniform(*(heights or camera.heights), count))
    assert np.isfinite(ground).all()
    return points_of(ground, camera.ground_to_image(ground) + noise * random.normal(size=(count, 2)), noise)


def points_of(ground: np.ndarray, image: np.ndarray, noise: float, crs: str = "EPSG:4326") -> Points:
    count = len(ground)
    return Points(
        ids=tuple(f"p{i}" for i in range(count)), image=image, ground=ground, roles=np.full(count, "control"),
        sigma_image=np.full(count, noise or 0.5), sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS(crs), source="test",
    )  # fmt: skip


def apart(first: FrameCamera, second: FrameCamera) -> tuple[float, float]:
    """Return how far two topocentric cameras are apart (m) and how much one is turned to the other (rad)."""
    shift = geocentric(first.perspective_centre[None]) - geocentric(second.perspective_centre[None])
    turn = first.rotation @ first.working_frame.axes @ (second.rotation @ second.working_frame.axes).T
    return float(np.linalg.norm(shift)), float(np.linalg.norm(turn - np.eye(3)) / np.sqrt(2))


# -- the map ---------------------------------------------------------------------------------------------------------


def box_of(camera: FrameCamera, reach: float = 0.6) -> np.ndarray:
    centre, half = camera.domain
    ground = centre + half * np.random.default_rng(1).uniform(-reach, reach, (40, 3))
    return ground[np.isfinite(camera.ground_to_image(ground)).all(axis=1)]


@pytest.mark.parametrize("refraction", [False, True])
@pytest.mark.parametrize(("tilt", "heading"), [(0, 0), (8, 192), (30, 77), (60, 180), (60, 300)])
def test_contract(tilt, heading, refraction):
    camera = satellite(tilt, heading, DISTORTED, refraction=refraction, free=PARAMETERS)
    ground = box_of(camera)
    assert len(ground) > 20
    check_sensor_model(camera, ground)


def test_nobody_changes_a_camera_through_its_domain():
    camera = satellite(8, 192, DISTORTED)
    for values in camera.domain:
        with pytest.raises(ValueError, match="read-only"):
            values[:] *= 1.5


@pytest.mark.parametrize("refraction", [False, True])
def test_contract_in_a_map_projection(refraction):
    camera = FrameCamera.from_map(
        DISTORTED, "EPSG:32636", [480e3, 4.42e6, 686e3, 0.1, 0.05, 2.5],
        frame=MAP, heights=(700, 1900), refraction=refraction, free=PARAMETERS,
    )  # fmt: skip
    check_sensor_model(camera, box_of(camera))


def test_collinearity_as_a_textbook_writes_it():
    # Written out for one point, in the map frame, with nothing of the package.
    x_l, y_l, z_l, omega, phi, kappa = 480000.0, 4420000.0, 5000.0, 0.10, -0.07, 2.0
    rx = np.array([[1, 0, 0], [0, np.cos(omega), np.sin(omega)], [0, -np.sin(omega), np.cos(omega)]])
    ry = np.array([[np.cos(phi), 0, -np.sin(phi)], [0, 1, 0], [np.sin(phi), 0, np.cos(phi)]])
    rz = np.array([[np.cos(kappa), np.sin(kappa), 0], [-np.sin(kappa), np.cos(kappa), 0], [0, 0, 1]])
    w = rz @ ry @ rx @ [480300.0 - x_l, 4420700.0 - y_l, 900.0 - z_l]
    x, y = -0.12 * w[0] / w[2] + 0.0002, -0.12 * w[1] / w[2] - 0.0003
    interior = Interior(1000, 1500, 0.12, 1e-4, 1e-4, x0=0.0002, y0=-0.0003)
    camera = FrameCamera.from_map(interior, "EPSG:32636", [x_l, y_l, z_l, omega, phi, kappa], frame=MAP)
    image = camera.ground_to_image([[480300.0, 4420700.0, 900.0]])
    np.testing.assert_allclose(image, [[500 + x / 1e-4, 750 - y / 1e-4]], atol=1e-9)


def test_north_up_image_has_rows_down_and_columns_right():
    camera = FrameCamera.from_geocentric(AERIAL, geocentric(np.array([[*PLACE, 6000.0]]))[0], heights=(0, 1000))
    lon, lat = PLACE
    here, east, north = camera.ground_to_image([[lon, lat, 0], [lon + 0.01, lat, 0], [lon, lat + 0.01, 0]])
    np.testing.assert_allclose(here, [500, 750], atol=1e-6)
    assert east[0] > here[0] + 100
    assert north[1] < here[1] - 100


def test_points_behind_the_camera_or_the_earth_have_no_image():
    camera = satellite(0, 0)
    ground = [[*PLACE, 700e3], [PLACE[0] + 180, -PLACE[1], 0.0], [np.nan, 39.9, 0.0], [*PLACE, 900.0]]
    image = camera.ground_to_image(ground)
    assert np.isnan(image[:3]).all()
    assert np.isfinite(image[3]).all()


def test_a_lens_that_folds_over_gives_no_second_image():
    interior = Interior(1000, 1000, 900e-6, 1e-6, 1e-6, k1=-0.3)
    fold = 1 / np.sqrt(3 * 0.3)
    assert np.isnan(interior.image_of(np.array([[fold * 1.01, 0.0]]))).all()
    inside = np.array([[fold * 0.99, 0.0], [0.3, -0.4]])
    np.testing.assert_allclose(interior.directions_of(interior.image_of(inside)), inside, atol=1e-8)
    # A pixel beyond the largest image radius is seen by no ray.
    assert np.isnan(interior.directions_of(np.array([[5000.0, 500.0]]))).all()


def test_ellipsoid_in_closed_form_agrees_with_proj():
    random = np.random.default_rng(2)
    ground = np.column_stack(
        [random.uniform(-180, 180, 500), random.uniform(-90, 90, 500), random.uniform(-1e3, 9e5, 500)]
    )
    ground[:2, 1] = (90.0, -90.0)
    ecef = np.column_stack(pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*ground.T))
    np.testing.assert_allclose(geocentric(ground), ecef, atol=2e-9)
    back = geodetic(ecef)
    np.testing.assert_allclose(back[2:, 0], ground[2:, 0], atol=1e-10)
    np.testing.assert_allclose(back[:, 1:], ground[:, 1:], atol=3e-9)


def test_rays_that_miss_the_earth_end_nowhere():
    origin = geocentric(np.array([[*PLACE, 686e3]] * 2))
    down = -origin / np.linalg.norm(origin, axis=1)[:, None]
    met = meet_height(origin, np.stack([down[0], -down[1]]), np.array([1000.0, 1000.0]))
    assert met[0, 2] == pytest.approx(1000.0, abs=1e-8)
    assert np.isnan(met[1]).all()


def test_angles_and_rotation_are_inverse():
    for angles in np.random.default_rng(0).uniform(-1.2, 1.2, (50, 3)) * (2.5, 1, 2.5):
        np.testing.assert_allclose(angles_of_rotation(rotation_of_angles(*angles)), angles, atol=1e-12)


def test_refraction_is_that_of_the_tables():
    # Saastamoinen 1972 for a ground at sea level: 13 H (1 - 0.04 H) µrad per tan z, H in km.
    for height in (1500.0, 3000.0, 6000.0, 9000.0):
        bent = FrameCamera.from_geocentric(
            AERIAL, geocentric(np.array([[*PLACE, height]]))[0], heights=(-1, 1), refraction=True
        )
        ground = bent.image_to_ground([[900.0, 750.0]], 0.0)
        straight = bent._replace(refraction=False).ground_to_image(ground)
        tangent = 400 * 1e-4 / 0.12
        moved = (bent.ground_to_image(ground) - straight)[0, 0] * 1e-4 / 0.12 / (1 + tangent**2)
        km = height / 1000
        assert moved == pytest.approx(13e-6 * km * (1 - 0.04 * km) * tangent, rel=0.12)


def test_serialisation_and_wrong_fields():
    camera = satellite(8, 20, DISTORTED, free=("omega", "k1"))
    data = camera.to_dict()
    assert data["interior"]["k1"] == -0.2
    assert model_from_dict(data).free == ("omega", "k1")
    wrong = (
        {"frame": "tangent"}, {"free": ["omega", "speed"]}, {"heights": [5.0, 5.0]}, {"exterior": {"X_L": 1}},
        {"interior": {**data["interior"], "focal_length": 0.0}}, {"ground_crs": "EPSG:32636"},
        {"interior": {**data["interior"], "k1": float("nan")}}, {"interior": {"width": 5}},
    )  # fmt: skip
    for change in wrong:
        with pytest.raises(InputError):
            model_from_dict({**data, **change})


# -- adjustment ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kappa", [0, 12, 90, 170])
@pytest.mark.parametrize("tilt", [0, 8, 30, 60])
def test_noise_free_from_the_start_of_equation_5(tilt, kappa):
    truth = satellite(tilt, kappa)
    ephemeris = geocentric(truth.perspective_centre[None])[0] + (800.0, -500.0, 300.0)
    start = FrameCamera.from_geocentric(BILSAT, ephemeris, heights=truth.heights)
    assert not start.exterior[3:].any()
    adjusted = fit(start, measured(truth, 44), robust=False).model
    metres, radians = apart(adjusted, truth)
    assert metres < 1e-6
    assert radians < 1e-10


@pytest.mark.parametrize("make", ["satellite", "aerial", "flat"])
def test_noise_free_from_nothing(make):
    random = np.random.default_rng(5)
    for tilt, heading in zip((0, 8, 35, 60, 60, 60), random.uniform(0, 360, 6), strict=True):
        truth = aerial() if make == "aerial" else satellite(tilt, heading)
        points = measured(truth, 20, heights=(900.0, 900.5) if make == "flat" else None, seed=int(heading))
        adjusted = fit(resect(points, truth.interior), points, robust=False).model
        metres, radians = apart(adjusted, truth)
        assert metres < 1e-6
        assert radians < 1e-10


def test_from_nothing_with_noise_and_gross_errors():
    random = np.random.default_rng(6)
    for seed in range(8):
        truth = satellite(random.uniform(0, 60), random.uniform(0, 360))
        points = measured(truth, 30, 0.5, seed)
        points.image[:5] += random.choice([-1, 1], (5, 2)) * random.uniform(60, 400, (5, 2))
        adjusted = fit(resect(points, BILSAT), points)
        assert {name for name, _ in adjusted.rejected} == {f"p{i}" for i in range(5)}
        assert adjusted.sigma0 < 1.7


def test_four_points_are_enough_and_fewer_are_an_error():
    truth = aerial()
    points = measured(truth, 4)
    assert apart(fit(resect(points, AERIAL), points, robust=False).model, truth)[0] < 1e-5
    with pytest.raises(TooFewPoints):
        resect(points.select([0, 1, 2]), AERIAL)
    line = points.ground[0] + np.linspace(0, 1, 8)[:, None] * (points.ground[1] - points.ground[0])
    with pytest.raises(DegeneratePoints):
        resect(points_of(line, truth.ground_to_image(line), 0.0), AERIAL)
    scrambled = measured(truth, 20)
    with pytest.raises(NotConverged):
        resect(points_of(scrambled.ground, scrambled.image[::-1].copy(), 0.0), AERIAL)


def test_a_known_position_and_a_map_frame_start_as_well():
    truth = satellite(60, 180)
    points = measured(truth, 12, 0.3)
    start = resect(points, BILSAT, position=truth.perspective_centre + np.array([0.01, -0.01, 900.0]))
    assert fit(start, points, robust=False).sigma0 < 2
    in_map = FrameCamera.from_map(AERIAL, "EPSG:32636", [480e3, 4.42e6, 6000, 0.1, 0.4, 2.5], frame=MAP)
    points = measured(in_map, 20)
    points = points_of(points.ground, points.image, 0.0, "EPSG:32636")
    found = fit(resect(points, AERIAL, map_crs="EPSG:32636"), points, robust=False).model
    np.testing.assert_allclose(found.exterior[:3], in_map.exterior[:3], atol=1e-6)
    np.testing.assert_allclose(found.exterior[3:], in_map.exterior[3:], atol=1e-10)


@pytest.mark.parametrize("repeats", [100, pytest.param(1000, marks=pytest.mark.slow)])
def test_covariance_is_honest(repeats):
    truth = satellite(8, 12)
    exact = measured(truth, 44)
    points = points_of(exact.ground, exact.image, 0.7)
    everything = np.ones(44, dtype=bool)
    problem = Problem.of(truth, points, everything, {})
    random = np.random.default_rng(11)
    pulls = []
    for number in range(repeats):
        noisy = exact.image + random.normal(0, 0.7, exact.image.shape)
        # What `fit` does, without its leave-one-out residuals and warnings, which are most of its time.
        solution = replace(problem, points=replace(problem.points, image=noisy)).solve(everything)
        sigmas = solution.sigma0 * np.sqrt(np.diag(solution.cofactors))
        pulls.append((solution.model.params - truth.params) / sigmas)
        if number == 0:
            result = fit(truth, replace(points, image=noisy), robust=False)
            np.testing.assert_allclose(result.sigmas, sigmas, rtol=1e-9)
    # Samples of a t distribution with 82 degrees of freedom: spread 1.012 within 5 sigma.
    np.testing.assert_allclose(np.std(pulls, axis=0), 1.012, atol=5 / np.sqrt(2 * repeats))
    np.testing.assert_allclose(np.mean(pulls, axis=0), 0.0, atol=5 / np.sqrt(repeats))


@pytest.mark.parametrize("heading_deg", [1.0, 115.0])
def test_self_calibration_with_priors(heading_deg):
    lens = Interior(1000, 1500, 0.1203, 1e-4, 1e-4, x0=2e-4, y0=-1e-4, k1=-0.05, k2=0.02, p1=5e-4)
    angles = 0.05, -0.1, np.radians(heading_deg)
    truth = FrameCamera.from_roll_pitch_yaw(lens, (*PLACE, 6000.0), *angles, heights=(700.0, 1900.0))
    free = (*EXTERIOR, "focal_length", "x0", "y0", "k1", "k2", "p1", "p2")
    points = measured(truth, 120, 0.2, seed=4)
    start = resect(points, AERIAL)._replace(free=free)
    priors = {"focal_length": Prior(0.12, 5e-4), "x0": Prior(0.0, 5e-4), "y0": Prior(0.0, 5e-4), "p2": Prior(0, 1e-6)}
    result = fit(start, points, priors=priors, robust=False)
    wanted = np.array([getattr(lens, name) for name in free[6:]])
    assert (np.abs(result.values[6:] - wanted) < 4 * result.sigmas[6:]).all()
    assert result.sigma0 == pytest.approx(1, abs=0.2)
    # The prior holds what the points cannot: a fixed pitch and a free one together with the focal length.
    with pytest.raises(DegeneratePoints):
        fit(start._replace(free=(*free, "pitch_x", "pitch_y")), points, robust=False)


def test_a_step_to_a_negative_focal_length_is_shortened():
    truth = aerial(free=(*EXTERIOR, "focal_length"))
    points = measured(truth, 20, 0.5, heights=(900.0, 950.0))
    # Over almost flat ground, a step would reverse the lens.
    high = truth.exterior + np.array([0.0, 0.0, 9000.0, 0.0, 0.0, 0.0])
    start = truth._replace(exterior=high, interior=replace(AERIAL, focal_length=0.03))
    assert fit(start, points, robust=False).sigma0 == pytest.approx(1, abs=0.3)


def test_corners_are_those_of_the_image_and_not_of_the_box():
    camera = satellite(8, 115)
    corners = camera.corners
    np.testing.assert_allclose(
        camera.ground_to_image(corners), [[0, 0], [2048, 0], [2048, 2048], [0, 2048]] * 2, atol=1e-6
    )
    np.testing.assert_allclose(corners[:, 2], np.repeat(camera.heights, 4))
    # The corners of the box see nothing of the image.
    box = SensorModel.corners.fget(camera)
    assert box.shape == (8, 3)
    assert (np.abs(camera.ground_to_image(box) - 1024).max(axis=1) > 1300).all()
    corrected = ImageCorrection.identity(camera, "shift", (1024.0, 1024.0))
    np.testing.assert_array_equal(corrected.corners, corners)


def test_map_frame_is_worse_over_a_large_scene():
    # The curvature of the Earth bends a scene of 55 km by 60 m at its edge; the projection alone cannot follow it.
    truth = satellite(8, 12)
    points = measured(truth, 44)
    in_map = fit(resect(points, BILSAT, map_crs="EPSG:32636"), points, robust=False)
    assert 0.01 < in_map.rmse("control").total < 2.0
    assert fit(resect(points, BILSAT), points, robust=False).rmse("control").total < 1e-6


def test_a_camera_that_looks_past_the_ground_has_a_box_below_it():
    # A frame of 0.06 m x 0.08 m at 0.1 m sees 26.6 degrees from its axis to a corner: tangent 0.05 / 0.1.
    interior = Interior(600, 800, 0.1, 1e-4, 1e-4)
    up = FrameCamera.from_map(
        interior, "EPSG:32636", [480e3, 4.42e6, 1500.0, np.pi, 0.0, 0.0], frame=MAP, heights=(0.0, 600.0)
    )
    assert not up.sees_ground
    # 1200 m above the middle of the heights.
    np.testing.assert_allclose(up.domain, [[480e3, 4.42e6, 300.0], [600.0, 600.0, 300.0]], rtol=1e-9)
    into_the_sky = FrameCamera.from_roll_pitch_yaw(interior, (33.0, 0.0, 1500.0), np.pi, 0.0, 0.0, heights=(0.0, 600.0))
    centre, half = into_the_sky.domain
    np.testing.assert_allclose(centre, [33.0, 0.0, 300.0], atol=1e-9)
    # At the equator the radii of curvature are a and a (1 - e^2) of WGS 84.
    radii = 6378137.0 * np.array([1.0, 1 - 0.00669437999014])
    np.testing.assert_allclose(np.radians(half[:2]) * radii, [600.0, 600.0], rtol=1e-3)


def test_rays_flatter_than_ten_degrees_do_not_widen_the_box():
    # Corners of the image look to the horizon, the upper edge 2 degrees below it: 1000 m / tan 2 = 29 km away.
    interior = Interior(1000, 1000, 0.1, 1e-4, 1e-4)
    tilt = np.radians(90 - 2) - np.arctan(0.5)
    camera = FrameCamera.from_map(
        interior, "EPSG:32636", [480e3, 4.42e6, 1000.0, tilt, 0.0, 0.0], frame=MAP, heights=(0.0, 1.0)
    )
    centre, half = camera.domain
    assert camera.sees_ground
    assert centre[1] + half[1] - 4.42e6 < 1000.0 / np.tan(np.arcsin(0.17)) + 1


def test_a_field_of_a_frame_camera_that_is_wrong_is_named():
    for field, value in (
        ("exterior", [0.0, 0.0, np.nan, 0.0, 0.0, 0.0]), ("exterior", [0.0] * 5),
        ("origin", (33.0, 37.0)), ("origin", (33.0, 37.0, np.inf)), ("heights", (0.0, np.inf)),
    ):  # fmt: skip
        with pytest.raises(InputError) as error:
            FrameCamera(AERIAL, **{"exterior": np.zeros(6), field: value})
        assert error.value.field == field
    with pytest.raises(InputError, match="not a map projection in metres"):
        FrameCamera.from_map(AERIAL, "EPSG:4326", [33.0, 37.0, 2000.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="not a map projection in metres"):  # US feet
        FrameCamera.from_map(AERIAL, "EPSG:2263", [980e3, 200e3, 2000.0, 0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="not finite"):
        aerial().with_params([np.nan, 0.0, 6000.0, 0.0, 0.0, 0.0])


def test_a_frame_camera_keeps_its_own_copy_of_the_orientation():
    exterior = np.zeros(6)
    camera = FrameCamera(AERIAL, exterior)
    exterior[2] = 1.0
    assert camera.exterior[2] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        camera.exterior[2] = 1.0


def test_angles_in_a_map_count_from_the_north_of_the_grid():
    # 2.7 degrees of convergence. Near the nadir, the topocentric camera sees what the same camera in the map sees.
    exterior = [674e3, 6.65e6, 2000.0, 0.02, -0.03, 0.5]
    in_map, camera = (
        FrameCamera.from_map(AERIAL, "EPSG:32632", exterior, frame=frame, heights=(0.0, 1.0))
        for frame in ("map", "topocentric")
    )
    offsets = np.array([[0.0, 0.0, 0.0], [200.0, 0.0, 0.0], [0.0, 200.0, 0.0], [-150.0, -150.0, 500.0]])
    place = offsets + np.array([674e3, 6.65e6, 0.0])
    ground = np.column_stack(pyproj.Transformer.from_crs(32632, 4326, always_xy=True).transform(*place.T))
    np.testing.assert_allclose(camera.ground_to_image(ground), in_map.ground_to_image(place), atol=0.06)
    lon, lat, _ = camera.perspective_centre
    east, north, _ = pyproj.Transformer.from_crs(4326, 32632, always_xy=True).transform(lon, lat, 0.0)
    np.testing.assert_allclose([east, north, camera.perspective_centre[2]], exterior[:3], atol=1e-6)


def test_platform_angles_are_those_of_scipy():
    for roll, pitch, yaw in np.random.default_rng(3).uniform(-1.5, 1.5, (5, 3)):
        # To north, east, down from forward, right, down; the camera has right, forward, up.
        platform = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        expected = np.stack([platform[:, 1], platform[:, 0], -platform[:, 2]])
        np.testing.assert_allclose(camera_from_platform(roll, pitch, yaw), expected, atol=1e-15)


def test_the_ground_is_below_the_camera():
    position = geocentric(np.array([[*PLACE, 2500.0]]))[0]
    # At most nine tenths of the way from the lowest ground up to the camera.
    assert heights_below(position, (500.0, 3000.0)) == pytest.approx((500.0, 2300.0), abs=1e-6)
    assert heights_below(position, (500.0, 1000.0)) == (500.0, 1000.0)
    with pytest.raises(InputError, match="sees no ground"):
        heights_below(position, (2500.1, 3000.0))
    assert np.isnan(satellite(0, 0).image_to_ground([[1024.0, 1024.0]], 700e3)).all()
    assert np.isnan(aerial().image_to_ground([[500.0, 750.0]], np.nan)).all()


@pytest.mark.parametrize(
    ("k1", "k2", "k3", "square"),
    [
        # d(r (1 + k1 r^2 + k2 r^4 + k3 r^6)) / dr = 0: 1 + 3 k1 s + 5 k2 s^2 + 7 k3 s^3 with s = r^2.
        (0.0, -0.2, 0.0, 1.0),
        (0.0, 0.0, -1 / 7, 1.0),
        (1 / 3, -0.4, 0.0, 1.0),
        # 1 - 1.5 s + 0.5 s^2 = (1 - s) (1 - s / 2): the nearer of two roots.
        (-0.5, 0.1, 0.0, 1.0),
        (1.0, 0.5, 0.25, np.inf),
    ],
)
def test_a_lens_is_used_up_to_the_radius_at_which_it_folds(k1, k2, k3, square):
    interior = Interior(1000, 1000, 900e-6, 1e-6, 1e-6, k1=k1, k2=k2, k3=k3)
    away = np.sqrt(min(square, 1e4)) * np.array([0.6, -0.8])
    inside, outside = interior.image_of(np.stack([0.9999 * away, 1.0001 * away]))
    assert np.isfinite(inside).all()
    assert np.isnan(outside).all() == np.isfinite(square)


def test_a_resected_camera_is_for_heights_a_little_beyond_those_of_its_points():
    for altitude, spread, margin in ((6000.0, 200.0, 200.0), (1150.0, 200.0, 10.0), (1102.0, 200.0, 1.0)):
        truth = FrameCamera.from_roll_pitch_yaw(AERIAL, (*PLACE, altitude), 0.1, -0.1, 1.0, heights=(800.0, 1101.0))
        image = np.array([[50, 50], [900, 100], [950, 1400], [100, 1300], [480, 700.0]])
        ground = truth.image_to_ground(image, 1100.0 - spread * np.array([0.0, 1.0, 0.3, 0.7, 0.5]))
        found = resect(points_of(ground, image, 0.0), AERIAL)
        # Half their range and 100 m, but at most a fifth of the way to the camera, and at least a metre.
        assert found.heights == pytest.approx((900.0 - margin, 1100.0 + margin), abs=0.1)


def test_points_on_both_sides_of_the_antimeridian_have_a_frame_among_them():
    truth = FrameCamera.from_roll_pitch_yaw(BILSAT, (179.99, 39.9, 686e3), 0.02, 0.05, 0.3, heights=(0.0, 900.0))
    points = measured(truth, 20)
    points.ground[:, 0] = (points.ground[:, 0] + 180) % 360 - 180
    assert np.ptp(points.ground[:, 0]) > 359
    found = resect(points, BILSAT)
    assert abs((found.origin[0] - 179.99 + 180) % 360 - 180) < 1
    assert apart(found, truth)[0] < 1


def test_pruning_a_camera_is_refused():
    """Without a part of its pose there is no camera."""
    camera = aerial()
    with pytest.raises(InputError, match="'frame' cannot be removed") as caught:
        prune(fit(camera, measured(camera, 12, noise=0.5)))
    assert caught.value.field == "points.prune"
