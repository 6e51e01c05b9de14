"""Line scanners from tables: how short tables may be, how far they are followed, and what they observe."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import Pushbroom
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.rotations import rotations
from ortho_pipeline.models.pushbroom.splines import SplineForm
from ortho_pipeline.models.pushbroom.tables import pushbroom_of_tables

RADIUS, RATE = 7.0e6, 1.05e-3
#: Columns: along the line to the left, forward, to the ground.
CAMERA = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def orbit(times: Array) -> Array:
    """Return positions ``(N, 3)`` on a circle over the poles."""
    angle = RATE * times
    return RADIUS * np.stack([np.cos(angle), np.zeros_like(angle), np.sin(angle)], axis=1)


def level(times: Array) -> Array:
    """Return the axes forward, left, up ``(N, 3, 3)`` of the circle as columns."""
    angle = RATE * times
    up = orbit(times) / RADIUS
    forward = np.stack([-np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    return np.stack([forward, np.cross(up, forward), up], axis=2)


def made(
    orbit_times: Array, turn_times: Array, *, rows: int = 2000, period: float = 1e-3, angles: Array | None = None,
    first: float = 50.0, **options: Any,
) -> Pushbroom:  # fmt: skip
    """Return the scanner of tables whose times count from the first row."""
    turns = level(turn_times)
    if angles is not None:
        turns = turns @ rotations(angles)
    if "mounting" not in options:
        turns = turns @ CAMERA
    return pushbroom_of_tables(
        LineCamera(1000, rows, 500.0, 0.0, 1e5), line_period=period, first_time=first,
        orbit=(orbit_times + first, orbit(orbit_times)), attitude=(turn_times + first, turns), **options,
    )  # fmt: skip


LONG = np.linspace(-4.0, 6.0, 41)


@pytest.mark.parametrize(("table", "slack"), [("orbit", 0.02), ("attitude", 0.002)])
@pytest.mark.parametrize("period", [1e-3, -1e-3])
def test_a_table_may_be_short_by_a_part_of_the_image(table: str, slack: float, period: float) -> None:
    """A hundredth of two seconds for orbits, a thousandth for attitudes, at both ends; rows may count backwards."""
    low, high = sorted((0.0, 2000 * period))
    for part, enough in ((0.95, True), (1.05, False)):
        for ends in ((low + part * slack, high + 1.0), (low - 1.0, high - part * slack)):
            short, wide = np.linspace(*ends, 24), np.linspace(low - 2.0, high + 2.0, 33)
            tables = (short, wide) if table == "orbit" else (wide, short)
            if enough:
                made(*tables, period=period)
                continue
            with pytest.raises(InputError, match="s after the first row, but the image needs") as refused:
                made(*tables, period=period)
            assert refused.value.field == table


@pytest.mark.parametrize("period", [1e-3, -1e-3])
def test_a_table_may_always_be_short_by_a_row(period: float) -> None:
    for part, enough in ((0.95, True), (1.05, False)):
        short = np.sort(np.linspace(part, 1000.0, 24) * period)
        if enough:
            made(LONG, short, rows=200, period=period)
        else:
            with pytest.raises(InputError):
                made(LONG, short, rows=200, period=period)


def test_path_and_attitude_are_followed_half_an_image_beyond_both_ends() -> None:
    """Within both tables. An orbit has a polynomial each 2.5 s, two at least."""
    for rows, period, ends, pieces in (
        (2000, 1e-3, (-1.0, 3.0), 2),
        (2000, -1e-3, (-3.0, 1.0), 2),
        (3750, 1e-3, (-1.875, 5.625), 3),
        (3800, 1e-3, (-1.9, 5.7), 4),
    ):
        breaks = made(LONG, LONG + 0.013, rows=rows, period=period).path.breaks
        np.testing.assert_allclose(breaks, np.linspace(*ends, pieces + 1), atol=1e-12)
    short = np.linspace(-0.4, 2.7, 40)
    # The attitude has the rows around this span, where there are some.
    for orbits, turns, ends in ((LONG, short, (-0.4, 2.7)), (short, LONG, (-0.5, 2.75))):
        model = made(orbits, turns)
        np.testing.assert_allclose(model.path.breaks[[0, -1]], [-0.4, 2.7], atol=1e-12)
        np.testing.assert_allclose(model.attitude.breaks[[0, -1]], ends, atol=1e-12)
    forms = made(LONG, LONG, splines=SplineForm(3, path=5, attitude=4))
    np.testing.assert_allclose(forms.path.breaks, np.linspace(-1.0, 3.0, 6), atol=1e-12)
    # The attitude has the rows of the table around this span: each quarter of a second.
    np.testing.assert_allclose(forms.attitude.breaks, np.linspace(-1.0, 3.0, 5), atol=1e-12)
    assert (forms.path.beyond, forms.attitude.beyond) == (2, 1)
    assert made(LONG, LONG, splines=SplineForm(1)).path.beyond == 1


@pytest.mark.parametrize("period", [1e-3, -1e-3])
def test_the_origin_is_in_the_middle_of_the_image_and_axes_follow_the_flight(period: float) -> None:
    model, middle = made(LONG, LONG + 0.013, period=period), 1000 * period
    np.testing.assert_allclose(model.origin, orbit(np.array([middle]))[0], atol=1e-4)
    np.testing.assert_allclose(model.orbital, level(np.array([middle]))[0], atol=1e-9)
    times = np.linspace(-0.9, 0.9, 7)
    places = model.origin + model.path(times) @ model.orbital.T
    np.testing.assert_allclose(places, orbit(times), atol=1e-3)


def test_without_a_mounting_the_camera_is_as_in_the_row_next_to_the_middle() -> None:
    """There roll, pitch and yaw are zero; pitch grows as the Earth falls away."""
    times = np.array([-1.5, -0.9, -0.2, 0.3, 0.94, 1.1, 1.7, 2.4, 3.1])
    model = made(LONG, times)
    np.testing.assert_allclose(model.attitude(times[[4]]), 0.0, atol=1e-9)
    np.testing.assert_allclose(model.attitude(times[1:8]), np.outer(RATE * (times[1:8] - 0.94), [0, 1, 0]), atol=1e-8)
    np.testing.assert_allclose(model.orbital @ model.mounting, level(times[[4]])[0] @ CAMERA, atol=1e-9)


def test_tables_with_a_sigma_are_observations_of_path_and_attitude() -> None:
    angles = np.array([0.02, -0.03, 3.1]) + np.outer(LONG, [0.001, 0.002, 0.02])
    model = made(
        LONG, LONG, angles=angles, mounting=CAMERA, lever=(0.3, -0.2, 1.1), position_sigma=0.7, angle_sigma=2e-5,
        heights=(-20.0, 300.0),
    )  # fmt: skip
    (place,), (turn,) = model.path_observations, model.attitude_observations
    np.testing.assert_allclose(place.times, model.path.sites)
    np.testing.assert_allclose(place.values @ model.orbital.T + model.origin, orbit(place.times), atol=1e-4)
    assert set(place.sigma.ravel()) == {0.7}
    assert set(turn.sigma.ravel()) == {2e-5}
    assert not place.fictitious
    assert (place.derivative, turn.derivative) == (0, 0)
    # Those of the rows from knot to knot; yaw passes through half a turn.
    near = np.abs(LONG - 1.0) <= 2.0
    np.testing.assert_allclose(model.attitude.breaks[[0, -1]], [-1.0, 3.0])
    np.testing.assert_allclose(turn.times, LONG[near])
    assert (turn.times[0], turn.times[-1]) == (-1.0, 3.0)
    np.testing.assert_allclose(rotations(turn.values), model.orbital.T @ level(turn.times) @ rotations(angles[near]))
    assert np.ptp(turn.values[:, 2]) == pytest.approx(0.08, abs=0.01)
    np.testing.assert_allclose(model.mounting, CAMERA)
    assert (model.lever.tolist(), model.heights) == ([0.3, -0.2, 1.1], (-20.0, 300.0))
    assert model.free == (*model.groups["attitude_offset"], *model.groups["attitude_drift"])
    plain = made(LONG, LONG, free=("path_offset",))
    assert (plain.path_observations, plain.attitude_observations) == ((), ())
    assert plain.free == plain.groups["path_offset"]


@pytest.mark.parametrize(("speed", "sound"), [(21_990.0, True), (22_010.0, False)])
def test_no_satellite_is_faster_than_twice_its_escape(speed: float, sound: bool) -> None:
    """Between rows of a quarter of a second, where ten metres are rounding."""
    places = orbit(LONG)
    step = math.hypot(*(places[1] - places[0]))
    out = places[1] / RADIUS
    # The first row is so much lower that the step to the second is this long.
    along = 2 * RADIUS * math.sin(RATE * 0.125)
    wanted = speed * 0.25 + 10.0
    assert step == pytest.approx(along)
    places[0] -= out * (math.sqrt(wanted**2 - along**2) + (places[0] - places[1]) @ out)
    assert np.linalg.norm(places[1] - places[0]) == pytest.approx(wanted, abs=1.0)
    options: Any = {"line_period": 1e-3, "first_time": 0.0, "attitude": (LONG, level(LONG) @ CAMERA)}
    camera = LineCamera(1000, 2000, 500.0, 0.0, 1e5)
    if sound:
        pushbroom_of_tables(camera, orbit=(LONG, places), **options)
    else:
        with pytest.raises(InputError, match="no satellite is that fast"):
            pushbroom_of_tables(camera, orbit=(LONG, places), **options)


def test_a_table_needs_one_row_more_than_the_degree() -> None:
    for degree in (2, 3):
        four = np.linspace(-0.1, 2.1, degree + 1)
        made(four, four, splines=SplineForm(degree))
        for tables in ((four[[0, *range(2, degree + 1)]], four), (four, four[[0, *range(2, degree + 1)]])):
            with pytest.raises(InputError, match=f"more than {degree} times"):
                made(*tables, splines=SplineForm(degree))


def test_one_mirrored_row_of_an_attitude_is_refused() -> None:
    turns = level(LONG) @ CAMERA
    turns[7] *= (-1.0, 1.0, 1.0)
    with pytest.raises(InputError, match="not a rotation") as refused:
        pushbroom_of_tables(
            LineCamera(1000, 2000, 500.0, 0.0, 1e5), line_period=1e-3, first_time=0.0, orbit=(LONG, orbit(LONG)),
            attitude=(LONG, turns),
        )  # fmt: skip
    assert refused.value.field == "attitude"
