"""A line scanner whose numbers are made by hand: its rays as the formula has them, its limits, and its files."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.spatial.transform import Rotation

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import Pushbroom, model_from_dict
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.light import LightPath
from ortho_pipeline.models.pushbroom.constraints import Observations, OrbitShape
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.splines import Spline

WIDTH, HEIGHT, PERIOD, SPEED, ALTITUDE = 1000, 600, 0.002, 7500.0, 600e3
FOCAL = 40_000.0  # of 15 m pixels
#: Columns: along the line to the left, forward, to the ground.
MOUNTING = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
LIGHT = 299_792_458.0


def north(lon: float = 20.0, **changes: Any) -> Pushbroom:
    """Return a camera above the equator that flies north on a straight line, level, and looks down.

    Path and attitude have knots at 0, 0.5 and 1.2 s, the upper and the lower edge of the image at its ends.
    """
    east, up = np.array([[-math.sin(lon / 57.29577951308232), math.cos(lon / 57.29577951308232), 0.0],
                         [math.cos(lon / 57.29577951308232), math.sin(lon / 57.29577951308232), 0.0]])  # fmt: skip
    knots = np.array([0.0, 0.5, 1.2])
    made = Pushbroom(
        camera=LineCamera(WIDTH, HEIGHT, 500.0, 0.0, FOCAL),
        line_period=PERIOD,
        origin=(6378137.0 + ALTITUDE) * up,
        orbital=np.column_stack([[0.0, 0.0, 1.0], -east, up]),
        mounting=MOUNTING,
        path=Spline(1, knots, np.array([[SPEED * time, 0.0, 0.0] for time in knots])),
        attitude=Spline(1, knots, np.zeros((3, 3))),
        lever=np.zeros(3),
        path_line=np.zeros((2, 3)),
        attitude_line=np.zeros((2, 3)),
        heights=(0.0, 1000.0),
        free=(),
        shape=OrbitShape(),
    )
    return replace(made, **changes)


def odd(**changes: Any) -> Pushbroom:
    """Return the camera with a lever arm, distortion, offsets and drifts."""
    values = {
        "camera": LineCamera(WIDTH, HEIGHT, 480.0, -300.0, FOCAL, [1.5, -2.0, 3.0, 0.7], [0.3, 2.0, -1.0]),
        "lever": np.array([100.0, 200.0, -300.0]),
        "path_line": np.array([[30.0, -20.0, 10.0], [50.0, -30.0, 10.0]]),
        "attitude_line": np.array([[0.1, -0.2, 0.3], [0.01, 0.02, -0.03]]),
    }
    return north(**{**values, **changes})


def test_rays_are_those_of_the_formula() -> None:
    """Of the docstring: lambda (u, v, 1) = R_M^T {R_P^T R_O^T [P - S] - C_M}."""
    model = odd()
    image = np.array([[0.0, 0.0], [1000.0, 600.0], [123.4, 567.8], [-300.0, 900.0], [500.0, 300.0]])
    origin, direction = model.rays(image)
    for k, (column, row) in enumerate(image):
        time, xi = row * 0.002, 2 * column / 1000 - 1
        # Offset and drift are about the middle of the scene, at 0.6 s.
        s = np.array([7500 * time, 0, 0]) + [30, -20, 10] + (time - 0.6) * np.array([50.0, -30, 10])
        roll, pitch, yaw = np.array([0.1, -0.2, 0.3]) + (time - 0.6) * np.array([0.01, 0.02, -0.03])
        turn = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
        u = (column + 1.5 - 2 * xi + 3 * xi**2 + 0.7 * xi**3 - 480) / 40_000
        v = (0.3 + 2 * xi - xi**2 + 300) / 40_000
        look = model.orbital @ turn @ MOUNTING @ [u, v, 1]
        camera = model.origin + model.orbital @ (s + turn @ [100.0, 200.0, -300.0])
        np.testing.assert_allclose(direction[k], look / np.linalg.norm(look), atol=1e-12)
        np.testing.assert_allclose(origin[k], camera, atol=1e-5)


def test_the_scan_of_a_level_flight_is_seen_on_the_ground() -> None:
    """Straight down: the middle column is below the flight, column 0 to the right of it, in the east."""
    model = north()
    ground = model.image_to_ground([[500.0, 0.0], [500.0, 600.0], [0.0, 0.0]], [0.0, 0.0, 500.0])
    # A straight line on the equatorial radius: at its start the point below, and 9 km further the same up direction.
    np.testing.assert_allclose(ground[0], [20.0, 0.0, 0.0], atol=1e-9)
    geod = pyproj.Geod(ellps="WGS84")
    azimuth, _, far = geod.inv(*ground[0, :2], *ground[1, :2])
    assert azimuth == pytest.approx(0.0, abs=1e-6)
    assert far == pytest.approx(1.2 * SPEED, rel=1e-5)
    azimuth, _, far = geod.inv(*ground[0, :2], *ground[2, :2])
    assert azimuth == pytest.approx(90.0, abs=1e-6)
    angle = math.atan(500 / FOCAL)
    # The sine rule in the triangle of the Earth's centre, the camera and the point, on the equator.
    beyond = math.asin((6378137 + ALTITUDE) / (6378137 + 500.0) * math.sin(angle))
    assert far == pytest.approx(6378137 * (beyond - angle), rel=1e-6)
    assert ground[2, 2] == 500.0


def test_points_are_computed_up_to_three_half_sizes_from_the_middle() -> None:
    for model in (north(), reverse()):
        inside = np.array([[-999.9, 300.0], [1999.9, 300.0], [500.0, -599.9], [500.0, 1199.9]])
        outside = inside + np.array([[-0.2, 0], [0.2, 0], [0, -0.2], [0, 0.2]])
        ground = model.image_to_ground(inside, 200.0)
        assert np.isfinite(ground).all()
        np.testing.assert_allclose(model.ground_to_image(ground), inside, atol=1e-6)
        assert np.isnan(model.rays(outside)[0]).all()
        assert np.isnan(model.rays(outside)[1]).all()
        assert np.isnan(model.image_to_ground(outside, 200.0)).all()
        # Just outside, the linear continuation of the four points.
        beyond = ground + np.diff([model.image_to_ground(2 * inside - outside, 200.0), ground], axis=0)[0]
        assert np.isnan(model.ground_to_image(beyond)).all()
        at_limit = [[-1000.0, 300.0], [2000.0, 300.0], [500.0, -600.0], [500.0, 1200.0]]
        assert np.isfinite(model.image_to_ground(at_limit, 200.0)).all()


def reverse() -> Pushbroom:
    """Return the camera with the last row exposed first: it flies north, and rows go south."""
    model = north(line_period=-PERIOD)
    knots = np.array([-1.2, -0.5, 0.0])
    return replace(model, path=Spline(1, knots, np.array([[SPEED * time, 0.0, 0.0] for time in knots])),
                   attitude=Spline(1, knots, np.zeros((3, 3))))  # fmt: skip


def test_the_last_row_may_be_exposed_first() -> None:
    ground = reverse().image_to_ground([[500.0, 0.0], [500.0, 600.0]], 0.0)
    np.testing.assert_allclose(ground[0], [20.0, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(ground[1], north().image_to_ground([[500.0, 600.0]], 0.0)[0] * (1, -1, 1), atol=1e-9)
    assert reverse().detail == pytest.approx(250.0)
    # Drifts are about the middle, here at -0.6 s.
    drifting = replace(reverse(), path_line=np.array([[0.0, 0.0, 0.0], [1000.0, 0.0, 0.0]]))
    places = (drifting.rays([[500.0, 0.0], [500.0, 300.0]])[0] - drifting.origin) @ drifting.orbital
    np.testing.assert_allclose(places, [[600.0, 0, 0], [-0.6 * SPEED, 0, 0]], atol=1e-6)


def test_what_a_camera_states_of_itself() -> None:
    model = north()
    # The knots of 0, 0.5 and 1.2 s are 250 and 350 rows apart.
    assert model.detail == pytest.approx(250.0)
    finer = replace(model, attitude=Spline(1, [0.0, 0.9, 1.0, 1.2], np.zeros((4, 3))))
    assert finer.detail == pytest.approx(50.0)
    assert replace(model, path=finer.attitude).detail == pytest.approx(50.0)
    assert model.height_range == (0.0, 1000.0)
    assert model.with_heights(-50.0, 300.0).height_range == (-50.0, 300.0)
    corners = np.array([[0.0, 0.0], [1000.0, 0.0], [0.0, 600.0], [1000.0, 600.0]])
    expected = [model.image_to_ground(corners, height) for height in (0.0, 1000.0)]
    np.testing.assert_allclose(model.corners, np.concatenate(expected), atol=1e-12)
    centre, half = model.domain
    # Of the eight corners the lowest see farthest; the camera is symmetrical about its meridian.
    np.testing.assert_allclose(centre[[0, 2]], [20.0, 500.0], atol=1e-9)
    np.testing.assert_allclose(half, [*(np.ptp(expected[0], axis=0)[:2] / 2), 500.0], rtol=1e-4)
    with pytest.raises(InputError, match="does not see the Earth"):
        _ = replace(model, mounting=MOUNTING * [1.0, -1.0, -1.0]).domain


def test_a_camera_that_looks_up_sees_no_ground() -> None:
    """The straight lines of its rays meet the ground behind it."""
    ground = north().image_to_ground([[500.0, 300.0], [100.0, 500.0]], 0.0)
    assert np.isfinite(ground).all()
    assert np.isnan(north(mounting=MOUNTING * [1.0, -1.0, -1.0]).ground_to_image(ground)).all()


def test_a_camera_that_also_sees_the_sky_has_the_box_of_its_ground() -> None:
    """The horizon is 66 degrees from straight down, and the ends of this line 68: they see no ground."""
    model = north()
    wide = replace(model, camera=replace(model.camera, focal_length=200.0))
    ends = wide.corners
    assert np.isnan(ends).all()
    centre, half = wide.domain
    inner = wide.image_to_ground([[250.0, 600.0], [750.0, 600.0]], 0.0)
    np.testing.assert_allclose([centre[0] + half[0], centre[0] - half[0]], inner[:, 0], atol=1e-9)


def test_numbers_of_a_file_are_plain_numbers() -> None:
    model = north(line_period=np.float32(0.5), heights=[np.int64(1), 2])
    assert (type(model.line_period), model.line_period) == (float, 0.5)
    assert model.heights == (1.0, 2.0)
    assert isinstance(model.heights[0], float)


@pytest.mark.parametrize(
    ("free", "observed", "least"),
    [
        ((), 0, 0),
        (("roll_offset",), 0, 1),
        (("roll_offset", "pitch_offset"), 0, 1),
        (("roll_offset", "pitch_offset", "yaw_offset"), 0, 2),
        # Nine coefficients of the path, of which none, six or all are observed; one point is needed for the datum.
        (("path",), 0, 5),
        (("path",), 2, 2),
        (("path",), 3, 1),
        (("path",), 4, 1),
    ],
)
def test_each_point_gives_two_equations_and_each_observation_one(
    free: tuple[str, ...], observed: int, least: int
) -> None:
    times = np.linspace(0.1, 1.0, observed)
    table = Observations(times, np.zeros((observed, 3)), np.ones((observed, 3)))
    assert north(path_observations=(table,)).freed(*free).minimum_points == least


def test_names_of_groups_free_their_parameters_once() -> None:
    model = north().freed("attitude_drift", "roll_drift", "principal_line", "path_offset")
    assert model.param_names == ("roll_drift", "pitch_drift", "yaw_drift", "principal_line", "along_offset",
                                 "across_offset", "radial_offset")  # fmt: skip
    moved = model.with_params([1e-3, 2e-3, 3e-3, 4.0, 5.0, 6.0, 7.0])
    assert moved.attitude_line.tolist() == [[0.0] * 3, [1e-3, 2e-3, 3e-3]]
    assert moved.path_line.tolist() == [[5.0, 6.0, 7.0], [0.0] * 3]
    assert (moved.camera.principal_line, moved.camera.focal_length) == (4.0, FOCAL)
    with pytest.raises(ValueError, match="not finite"):
        model.with_params([math.nan] * 7)


def test_near_the_antimeridian_longitudes_stay_near_the_satellite() -> None:
    """Also at the ends of a line that sees five degrees to both sides."""
    camera, image = LineCamera(WIDTH, HEIGHT, 500.0, 0.0, 600.0), [[0.0, 300.0], [1000.0, 300.0]]
    plain = north(lon=20.0, camera=camera).image_to_ground(image, 0.0)
    assert (np.abs(plain[:, 0] - 20.0) > 4.0).all()
    for lon in (180.0, -179.0, 179.0, -180.0):
        shifted = north(lon=lon, camera=camera).image_to_ground(image, 0.0)
        foot = 180.0 if lon == -180.0 and shifted[0, 0] > 0 else lon
        np.testing.assert_allclose(shifted - [foot, 0, 0], plain - [20.0, 0, 0], atol=1e-9)


def differences(project: Callable[[float], Array]) -> Array:
    """Return the derivative of a projection at 0, by central differences of two widths (Richardson)."""
    near, far = ((project(width) - project(-width)) / (2 * width) for width in (1.0, 2.0))
    return (4 * near - far) / 3


@pytest.mark.parametrize("light", [LightPath(), LightPath(aberration=True), LightPath(refraction=True)])
def test_partials_by_ground_and_parameters(light: LightPath) -> None:
    """To seven digits; with light to five or six: its path is taken to change only with the line to the camera."""
    smooth = Spline(3, [0.0, 1.2], [[0.4 * SPEED * k, 3.0 * k * (3 - k), -5.0 * k * k] for k in range(4)])
    turning = Spline(3, [0.0, 1.2], np.array([[0.0, 1, 3], [1, -2, 0], [0, 2, 1], [1, 0, 0]]) * 1e-4)
    slow = np.array([[0.1, -0.2, 0.3], [1e-3, 2e-3, -3e-3]])
    model = odd(light=light, path=smooth, attitude=turning, attitude_line=slow)
    model = model.freed(*model.groups)
    allowed = 1e-5 if light.aberration else 1e-6 if light.refraction else 1e-7
    ground = model.image_to_ground([[0.0, 40.0], [1000.0, 500.0], [130.0, 450.0]], [0.0, 500.0, 900.0])
    assert np.isfinite(ground).all()
    found = model.ground_partials(ground)
    for axis in range(3):
        largest = np.abs(found[:, :, axis]).max()
        nudge = np.eye(3)[axis] / largest
        by = differences(lambda width, nudge=nudge: model.ground_to_image(ground + width * nudge)) * largest
        assert np.abs(by - found[:, :, axis]).max() < allowed * largest, axis
    found = model.param_partials(ground)
    for k, name in enumerate(model.param_names):
        # Parameters of the path change the velocity, and so the aberration: by some thousandths.
        if light.aberration and name.startswith(("along", "across", "radial")) and not name.endswith("offset"):
            continue
        largest = np.abs(found[:, :, k]).max()
        nudge = np.eye(len(model.params))[k] / largest
        by = differences(lambda width, nudge=nudge: model.with_params(model.params + width * nudge)
                         .ground_to_image(ground)) * largest  # fmt: skip
        assert np.abs(by - found[:, :, k]).max() < allowed * largest, name


def test_apparent_points_are_lifted_by_the_air_and_moved_by_aberration() -> None:
    """Below the camera, aberration moves the image of a point by v/c times the focal length, in rows."""
    model = north()
    image = np.array([[500.0, 100.0]])
    ground = model.image_to_ground(image, 300.0)
    aberrated = replace(model, light=LightPath(aberration=True)).ground_to_image(ground) - image
    distance = np.linalg.norm(np.array(pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*ground[0]))
                              - model.rays(image)[0][0])  # fmt: skip
    # The point seems to be farther ahead, so it is seen later.
    np.testing.assert_allclose(aberrated, [[0.0, distance / LIGHT / PERIOD]], atol=1e-4)
    # The column at 45 degrees of a wide camera; 2.55 m of refraction at the ellipsoid by the cosine squared.
    wide = replace(model, camera=replace(model.camera, focal_length=1000.0))
    ground = wide.image_to_ground([[0.0, 300.0]], 0.0)
    refracted = replace(wide, light=LightPath(refraction=True))
    zenith = math.asin((6378137 + ALTITUDE) / 6378137 * math.sin(math.atan(0.5)))
    lift = 9200 * 2.77e-4 / math.cos(zenith) ** 2
    np.testing.assert_allclose(
        refracted.ground_to_image(ground), wide.ground_to_image(ground + np.array([0.0, 0.0, lift])), atol=1e-6
    )


# -- files -----------------------------------------------------------------------------------------------------------


def test_a_file_gives_the_same_camera() -> None:
    table = Observations([0.1, 1.0], np.zeros((2, 3)), np.ones((2, 3)), 1, True)
    model = odd(light=LightPath(refraction=True), path_observations=(table,), shape=OrbitShape(plane=3.0)).freed("path")
    again = model_from_dict(json.loads(json.dumps(model.to_dict())))
    assert isinstance(again, Pushbroom)
    assert again.to_dict() == model.to_dict()
    image = [[10.0, 20.0], [900.0, 500.0]]
    assert (again.image_to_ground(image, 100.0) == model.image_to_ground(image, 100.0)).all()
    assert len(again.constraints()) == len(model.constraints()) == 6 + 2
    assert again.constraints().fictitious.all()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("line_period", math.nan),
        ("line_period", 0.0),
        ("heights", [10.0, 10.0]),
        ("heights", [20.0, 10.0]),
        ("heights", [-math.inf, 10.0]),
        ("heights", [0.0, math.inf]),
        ("origin", [1.0, 2.0]),
        ("origin", [1.0, 2.0, math.nan]),
        ("lever", [[0.0, 0.0, 0.0]]),
        ("path_line", [[0.0, 0.0, 0.0]]),
        ("attitude_line", [[0.0, 0.0, 0.0]]),
        ("attitude_line", [[0.0, 0.0, 0.0], [0.0, math.inf, 0.0]]),
        ("orbital", np.eye(2).tolist()),
        ("mounting", np.diag([1.0, 1.0, -1.0]).tolist()),
        ("mounting", (1.001 * np.eye(3)).tolist()),
        ("camera", [1, 2]),
        ("attitude", None),
        ("shape", 1.0),
        ("path_observations", None),
        ("attitude_observations", {}),
        ("light", True),
    ],
)
def test_a_wrong_part_of_a_file_is_named(field: str, value: object) -> None:
    data = north(light=LightPath(aberration=True)).to_dict()
    with pytest.raises(InputError) as refused:
        model_from_dict({**data, field: value})
    assert refused.value.field == field


# -- observations ----------------------------------------------------------------------------------------------------


def test_an_observation_of_what_is_not_free_is_left_out() -> None:
    ahead = Observations([0.25, 1.2], [[1000.0, 5.0, 0.0], [SPEED * 1.2, 0.0, 7.0]], [[1.0, 2.0, 3.0]] * 2)
    rates = Observations([0.6], [[1e-3, 2e-3, 3e-3]], [[1e-6] * 3], 1, True)
    model = north(path_observations=(ahead,), attitude_observations=(rates,))
    assert len(model.constraints()) == 0
    found = model.freed("path").constraints()
    np.testing.assert_allclose(found.residuals, [1000 - SPEED * 0.25, 5.0, 0.0, 0.0, 0.0, 7.0], atol=1e-9)
    assert found.sigma.tolist() == [1.0, 2.0, 3.0] * 2
    assert not found.fictitious.any()
    # At 0.25 s, half-way between the first two knots, and at the last one.
    expected = np.zeros((6, 9))
    expected[[0, 1, 2], [0, 1, 2]] = expected[[0, 1, 2], [3, 4, 5]] = 0.5
    expected[[3, 4, 5], [6, 7, 8]] = 1.0
    np.testing.assert_allclose(found.jacobian, expected, atol=1e-12)
    # Only the along component of the last knot.
    one = model.freed("along_2").constraints()
    assert (len(one), one.residuals.tolist(), one.jacobian.tolist()) == (1, pytest.approx([0.0], abs=1e-9), [[1.0]])
    turned = model.freed("attitude").constraints()
    np.testing.assert_allclose(turned.residuals, [1e-3, 2e-3, 3e-3])
    assert turned.fictitious.all()
    # Observations are without offset and drift: these do not change them.
    assert len(model.freed("attitude_drift", "path_offset").constraints()) == 0


def test_the_shape_of_an_orbit_is_that_between_first_and_last_row() -> None:
    """A straight line at 7500 m/s from its lowest point: it is longer by the time, and climbs by its cosine."""
    level = 6378137.0 + ALTITUDE
    model = north(shape=OrbitShape(circular=1e-3, radius=level, radius_sigma=5.0, samples=2)).freed("path_offset")
    found = model.constraints()
    # Two samples, in the middles of both halves of 1.2 s.
    rising = [SPEED * time / math.hypot(level, SPEED * time) for time in (0.3, 0.9)]
    far = math.hypot(level, SPEED * 0.6)
    np.testing.assert_allclose(found.residuals, [*(-np.array(rising)), level - far], atol=1e-8)
    assert found.sigma.tolist() == [1e-3, 1e-3, 5.0]
    # Farther up by a metre; ahead by one.
    np.testing.assert_allclose(found.jacobian[2], [SPEED * 0.6 / far, 0.0, level / far], atol=1e-9)


def test_a_model_never_changes() -> None:
    for array in (north().origin, north().path_line, north().camera.dx, north().path.coefficients):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1.0


# -- splines of two kinds --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("path", "attitude"), [(3, 1), (1, 3), (2, 1), (1, 5)])
def test_path_and_attitude_may_be_splines_of_different_degrees(path: int, attitude: int) -> None:
    """Ground on the rays of the image has the place in the image that it came from, also before and after all knots."""
    random = np.random.default_rng(4)
    knots, other = np.array([0.0, 0.5, 1.2]), np.array([-0.1, 0.3, 0.9, 1.4])
    times = Spline(path, knots, np.zeros((2 + path, 3))).sites
    along = np.column_stack([SPEED * times, *random.normal(0, 30.0, (2, len(times)))])
    turns = random.normal(0, 3e-4, (3 + attitude, 3))
    model = odd(
        path=Spline(path, knots, along), attitude=Spline(attitude, other, turns),
        attitude_line=np.array([[0.01, -0.02, 0.03], [1e-3, 2e-3, -3e-3]]),
    )  # fmt: skip
    image = np.array([[0.0, 0.0], [1000.0, 600.0], [123.4, 567.8], [500.0, 300.0], [700.0, 250.0], [20.0, 110.0],
                      [400.0, -150.0], [800.0, 780.0]])  # fmt: skip
    ground = model.image_to_ground(image, np.array([0.0, 900.0, 500.0, 300.0, 100.0, 800.0, 200.0, 700.0]))
    assert np.isfinite(ground).all()
    np.testing.assert_allclose(model.ground_to_image(ground), image, atol=1e-4)
