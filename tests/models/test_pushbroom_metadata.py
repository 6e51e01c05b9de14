"""A line scanner from metadata: its orbit as Kepler has it, its focal length, its best attitude and its soft sigmas."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyproj
import pytest
from scipy.optimize import least_squares

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import Pushbroom
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.pushbroom.metadata import SoftSigmas, pushbroom_of_metadata
from ortho_pipeline.models.pushbroom.splines import SplineForm

WIDTH, HEIGHT, ALTITUDE = 9000, 11_000, 640e3
#: To the south-south-west, with a skew, at four heights.
CORNERS = np.array([[12.0, 42.0, 310.0], [12.28, 41.95, 620.0], [12.2, 41.68, 150.0], [11.91, 41.74, 480.0]])
GM = 3.986004418e14


def scanner(corners: Array = CORNERS, **options: Any) -> Pushbroom:
    given = {"altitude": ALTITUDE, "along_deg": 21.0, "across_deg": 4.0, "heights": (100.0, 700.0), **options}
    return pushbroom_of_metadata(corners, WIDTH, HEIGHT, **given)


def ecef(ground: Array) -> Array:
    return np.stack(pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*ground.T), axis=1)


def radius() -> float:
    """Return the altitude above the ellipsoid below the mean of the corners, from the Earth's centre."""
    return float(np.linalg.norm(ecef(np.array([[*CORNERS[:, :2].mean(axis=0), 0.0]])))) + ALTITUDE


@pytest.mark.parametrize(
    ("form", "pieces"), [(SplineForm(3, path=2, attitude=3), (2, 3)), (SplineForm(4, path=3), (3, 1))]
)
def test_the_path_is_a_circle_at_the_speed_of_its_height(form: SplineForm, pieces: tuple[int, int]) -> None:
    """About the Earth's centre, also a little before and after; the platform turns with it, in pitch alone."""
    model = scanner(splines=form)
    duration = model.line_period * HEIGHT
    times = np.linspace(-0.1, 1.1, 13) * duration
    places = model.origin + model.path(times) @ model.orbital.T
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), radius(), atol=0.05)
    rate = math.sqrt(GM / radius() ** 3)
    for first, last in ((0, 12), (1, 11), (1, 6), (6, 11)):
        cosine = places[first] @ places[last] / radius() ** 2
        assert math.acos(cosine) == pytest.approx(rate * (times[last] - times[first]), rel=1e-5)
    # In the middle of the scene the path is at its origin and goes forward.
    np.testing.assert_allclose(model.path(times[6:7])[0], 0.0, atol=1e-3)
    np.testing.assert_allclose(model.path(times[6:7], 1)[0], [rate * radius(), 0.0, 0.0], rtol=1e-5, atol=1e-3)
    angles = model.attitude(times)
    np.testing.assert_allclose(np.diff(angles[:, 1]), rate * np.diff(times), rtol=1e-6)
    np.testing.assert_allclose(angles[:, [0, 2]], angles[[0]][:, [0, 2]].repeat(13, axis=0), atol=1e-12)
    for spline, count in zip((model.path, model.attitude), pieces, strict=True):
        assert spline.degree == form.degree
        np.testing.assert_allclose(spline.breaks, np.linspace(0.0, duration, count + 1))
    assert (model.path.beyond, model.attitude.beyond) == (2, 1)


@pytest.mark.parametrize("pieces", [(1, 12), (12, 1)])
def test_a_path_and_an_attitude_of_lines_may_have_numbers_of_pieces_that_differ(pieces: tuple[int, int]) -> None:
    model = scanner(splines=SplineForm(1, *pieces))
    assert (model.path.size, model.attitude.size) == (pieces[0] + 1, pieces[1] + 1)
    assert (model.path.beyond, model.attitude.beyond) == (1, 1)


@pytest.mark.parametrize("options", [{}, {"focal_length": 1.7, "pixel_size": 6.5e-6}])
def test_the_attitude_fits_the_corners_best(options: Any) -> None:
    """A search by SciPy from another roll, pitch and yaw ends at those of the model."""
    model = scanner(**options).freed("attitude_offset")
    image = np.array([[0.0, 0.0], [WIDTH, 0.0], [WIDTH, HEIGHT], [0.0, HEIGHT]])

    def miss(params: Array) -> Array:
        return np.asarray(image - model.with_params((params - 1.0) * 1e-4).ground_to_image(CORNERS)).ravel()

    best = least_squares(miss, [1.4, 0.7, 1.2], jac="3-point", diff_step=1e-3, xtol=1e-12, ftol=1e-15, gtol=1e-12).x
    np.testing.assert_allclose((best - 1.0) * 1e-4, 0.0, atol=1e-8)
    assert (model.camera.principal_column, model.camera.principal_line) == (WIDTH / 2, 0.0)


def test_the_focal_length_is_the_distance_of_a_row_over_its_width_across_the_line_of_sight() -> None:
    model = scanner()
    starts, _ = model.rays([[WIDTH / 2, 0.0], [WIDTH / 2, HEIGHT]])
    corners, found = ecef(CORNERS), []
    for start, left, right in ((starts[0], 0, 1), (starts[1], 3, 2)):
        line = (corners[left] + corners[right]) / 2 - start
        across = np.linalg.norm(np.cross(corners[right] - corners[left], line)) / np.linalg.norm(line)
        found.append(np.linalg.norm(line) / across * WIDTH)
    # Columns grow to the left of the flight, so it is positive; in a mirrored image they grow to the right.
    assert model.camera.focal_length == pytest.approx(np.mean(found), rel=1e-6)
    assert scanner(CORNERS[[1, 0, 3, 2]]).camera.focal_length == pytest.approx(-np.mean(found), rel=1e-6)
    known = scanner(focal_length=1.7, pixel_size=6.5e-6)
    assert known.camera.focal_length == pytest.approx(1.7 / 6.5e-6, rel=1e-12)


def test_a_flight_that_exists_is_recovered_from_its_corners() -> None:
    """Yaw, roll and duration, from the corners that a first camera sees at the middle of its heights."""
    true = scanner(focal_length=1.7, pixel_size=6.5e-6)
    image = np.array([[0.0, 0.0], [WIDTH, 0.0], [WIDTH, HEIGHT], [0.0, HEIGHT]])
    ground = true.image_to_ground(image, 400.0)
    found = scanner(ground, focal_length=1.7, pixel_size=6.5e-6)
    assert np.abs(found.ground_to_image(ground) - image).max() < 2.0
    assert found.line_period == pytest.approx(true.line_period, rel=1e-3)
    turns = found.attitude(np.array([0.0, 1.0])) - true.attitude(np.array([0.0, 1.0]))
    assert np.abs(turns).max() < 2e-3
    assert scanner(ground[:, :2], heights=(300.0, 500.0)).to_dict() == scanner(ground, heights=(300.0, 500.0)).to_dict()


def test_soft_sigmas_are_those_of_orbit_attitude_and_rate() -> None:
    model = scanner()
    shape = model.shape
    assert (shape.plane, shape.circular, shape.radius_sigma, shape.samples) == (10.0, 1e-3, 10_000.0, 2)
    assert shape.radius == pytest.approx(radius(), abs=1e-3)
    duration = model.line_period * HEIGHT
    level, rate = model.attitude_observations
    np.testing.assert_allclose(level.times, [duration / 2])
    np.testing.assert_allclose(rate.times, [0.0, duration])
    assert (level.derivative, rate.derivative) == (0, 1)
    assert level.sigma.tolist() == [[math.radians(0.5)] * 3]
    assert rate.sigma.tolist() == [[1e-4] * 3] * 2
    np.testing.assert_allclose(level.values, model.attitude(level.times))
    np.testing.assert_allclose(rate.values, [[0.0, math.sqrt(GM / radius() ** 3), 0.0]] * 2, rtol=1e-6, atol=1e-15)
    assert model.constraints().fictitious.all()
    assert set(model.free) == {*model.groups["path"], *model.groups["attitude"]}
    few = scanner(sigmas=SoftSigmas(plane=None, circular=2e-3, radius=None, attitude=None, rate=3e-4))
    assert (few.shape.plane, few.shape.circular) == (None, 2e-3)
    assert (few.shape.radius, few.shape.radius_sigma) == (None, None)
    (only,) = few.attitude_observations
    assert (only.derivative, only.sigma[0, 0]) == (1, 3e-4)


@pytest.mark.parametrize("sigma", [0.0, -1.0, math.inf, math.nan])
def test_a_sigma_that_is_none_is_refused(sigma: float) -> None:
    with pytest.raises(InputError, match="not a sigma"):
        SoftSigmas(rate=sigma)


def test_metadata_that_contradict_each_other_are_refused() -> None:
    for latitude in (90.5, -90.5):
        with pytest.raises(InputError, match="latitude"):
            scanner(np.vstack([CORNERS[:3], [12.0, latitude, 0.0]]))
    with pytest.raises(InputError, match="both"):
        scanner(focal_length=1.7)
    with pytest.raises(InputError, match="not a focal length"):
        scanner(focal_length=-1.7, pixel_size=6.5e-6)
