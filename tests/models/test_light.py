"""Aberration and refraction of a line scanner, against light that is followed through space and air."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from products import flight

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric
from ortho_pipeline.models import Pushbroom, model_from_dict
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.light import LightPath
from ortho_pipeline.models.light.path import LIGHT
from ortho_pipeline.models.light.refraction import REFRACTIVITY, SCALE_HEIGHT
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.tables import pushbroom_of_tables
from ortho_pipeline.testing import check_sensor_model

TURN = np.array([0.0, 0.0, 7.292115e-5])
SIZE = (30000, 20000)


def camera(pitch_deg: float = 20.0, roll_deg: float = -12.0) -> Pushbroom:
    """Return a camera of 0.5 m pixels from 830 km, that looks backwards and aside."""
    times = np.linspace(-2.0, 3.0, 101)
    places, rates = flight(times)
    z = -places / np.linalg.norm(places, axis=1)[:, None]
    y = rates / np.linalg.norm(rates, axis=1)[:, None]
    x = np.cross(y, z) / np.linalg.norm(np.cross(y, z), axis=1)[:, None]
    axes = np.stack([x, np.cross(z, x), z], axis=2)
    p, r = np.radians([pitch_deg, roll_deg])
    by_pitch = np.array([[1, 0, 0], [0, math.cos(p), -math.sin(p)], [0, math.sin(p), math.cos(p)]])
    by_roll = np.array([[math.cos(r), 0, math.sin(r)], [0, 1, 0], [-math.sin(r), 0, math.cos(r)]])
    line = LineCamera(*SIZE, SIZE[0] / 2, 0.0, 830e3 / 0.5)
    return pushbroom_of_tables(line, line_period=5e-5, first_time=0.0, orbit=(times, places),
                               attitude=(times, axes @ by_roll @ by_pitch))  # fmt: skip


def lit(model: Pushbroom, **light: bool) -> Pushbroom:
    return replace(model, light=LightPath(**light))


def points(model: Pushbroom, seed: int = 0) -> tuple[Array, Array]:
    """Return image points and their ground, from sea level to the highest summits."""
    image = np.random.default_rng(seed).uniform(0.0, 1.0, (30, 2)) * SIZE
    return image, model.image_to_ground(image, np.tile([0.0, 1500.0, 8800.0], 10))


def test_aberration_is_that_of_light_that_was_under_way() -> None:
    """In axes that do not turn: the ground where it was, and the velocity of the camera added to the light's."""
    model = lit(camera(), aberration=True)
    image, ground = points(model)
    times = image[:, 1] * model.line_period
    place, over = model.flight.positions(times, 0), model.flight.positions(times, 1)
    point = geocentric(ground)
    delay = np.zeros(len(point))
    for _ in range(5):
        # The ground as it was then, in the axes of the moment of exposure.
        then = point - delay[:, None] * np.cross(TURN, point)
        delay = np.linalg.norm(then - place, axis=1) / LIGHT
    came = (then - place) / np.linalg.norm(then - place, axis=1)[:, None]
    seen = came + (over + np.cross(TURN, place)) / LIGHT
    seen /= np.linalg.norm(seen, axis=1)[:, None]
    ours = lit(model).rays(image)[1]
    apart = np.linalg.norm(np.cross(ours, seen), axis=1) * np.linalg.norm(then - place, axis=1)
    assert np.linalg.norm(np.cross(ours, came), axis=1).min() * 830e3 > 15.0
    # The turn of the Earth while the light is under way, which is left out.
    assert 0.1 < apart.max() < 0.23
    assert np.ptp(apart) < 0.01


@pytest.mark.parametrize("zenith_deg", [0.0, 15.0, 30.0, 45.0])
@pytest.mark.parametrize("height", [0.0, 3000.0])
def test_refraction_is_that_of_light_through_shells_of_air(zenith_deg: float, height: float) -> None:
    """Snell's law in a round atmosphere, n r sin z = constant; the formula's is flat."""
    earth, step = 6371e3, 10.0
    radius = earth + height
    shells = np.arange(height, height + 120e3, step) + step / 2
    invariant = (1 + REFRACTIVITY * math.exp(-height / SCALE_HEIGHT)) * radius * math.sin(math.radians(zenith_deg))
    sine = invariant / ((1 + REFRACTIVITY * np.exp(-shells / SCALE_HEIGHT)) * (earth + shells))
    turned = float((step * np.tan(np.arcsin(sine)) / (earth + shells)).sum())
    # Beyond the air the light goes on straight; back along that line, how high is it above the point?
    top = earth + height + 120e3
    zenith = math.asin(invariant / top)
    place = top * np.array([math.sin(turned), math.cos(turned)])
    way = np.array([math.sin(turned + zenith), math.cos(turned + zenith)])
    lift = place[1] - place[0] / way[0] * way[1] - radius if zenith_deg else 0.0
    model = LightPath(refraction=True)
    cosine = math.cos(math.radians(zenith_deg))
    if zenith_deg:
        assert float(model.lift(np.array(height), np.array(cosine))) == pytest.approx(lift, rel=0.02)


@pytest.mark.parametrize(
    "light", [{"aberration": True}, {"refraction": True}, {"aberration": True, "refraction": True}]
)
def test_it_keeps_the_contract_and_closes(light: dict[str, bool]) -> None:
    model = lit(camera(), **light)
    image, ground = points(model)
    assert np.abs(model.ground_to_image(ground) - image).max() < 1e-5
    check_sensor_model(model, ground)
    check_sensor_model(model.freed("path_offset", "path_drift"), ground)  # aberration also changes with a drift
    plain = lit(model).image_to_ground(image, ground[:, 2])
    moved = np.einsum("nij,nj->ni", enu_from_ecef(ground), geocentric(ground) - geocentric(plain))[:, :2]
    low, high = (15.0, 30.0) if model.light.aberration else (0.3, 2.0)
    assert low < np.linalg.norm(moved, axis=1).min() < np.linalg.norm(moved, axis=1).max() < high


def test_files_say_what_the_light_does_and_older_ones_say_nothing() -> None:
    model = lit(camera(), aberration=True, refraction=True)
    again = model_from_dict(json.loads(json.dumps(model.to_dict())))
    assert isinstance(again, Pushbroom)
    assert again.light == model.light
    assert "light" not in lit(model).to_dict()
    assert model_from_dict(lit(model).to_dict()).light == LightPath()


@pytest.mark.parametrize("wrong", [{"aberration": 1}, {"refraction": "true"}, {"aberration": None, "refraction": True}])
def test_light_is_bent_or_not(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="true or false"):
        LightPath(**wrong)


def test_the_numbers_of_light_are_those_of_its_functions() -> None:
    """Bend at the ellipsoid is the lift straight down there, and slowness the inverse of the velocity of light."""
    both = LightPath(aberration=True, refraction=True)
    bend, slowness = both.numbers
    assert bend == pytest.approx(float(both.lift(np.zeros(1), np.ones(1))[0]))
    assert slowness == pytest.approx(1 / 299_792_458.0)
    assert LightPath().numbers == (0.0, 0.0)
    height, cosine, step = np.array([0.0, 3000.0]), np.array([0.9, 0.5]), 1e-2
    slope = (both.lift(height + step, cosine) - both.lift(height - step, cosine)) / (2 * step)
    np.testing.assert_allclose(both.rise(height, cosine), 1.0 + slope, rtol=1e-9)


def test_what_light_turns_is_turned_back() -> None:
    """Seen along `apparent`, light arrived along the line itself; and `turned` is the slope of `apparent`."""
    light, random = LightPath(aberration=True), np.random.default_rng(4)
    line, velocity = random.normal(0.0, 5e5, (5, 3)), random.normal(0.0, 4e6, (5, 3))
    up, height = np.tile([0.0, 0.0, 1.0], (5, 1)), np.zeros(5)
    apparent = light.apparent(line, velocity, up, height)
    unit = apparent / np.linalg.norm(apparent, axis=1)[:, None]
    np.testing.assert_allclose(light.straight(unit, velocity), line / np.linalg.norm(line, axis=1)[:, None], atol=1e-12)
    matrix = random.normal(size=(5, 3, 3))
    for axis in range(3):
        nudge = 10.0 * np.eye(3)[axis]
        ends = [light.apparent(line + sign * nudge, velocity, up, height) for sign in (1, -1)]
        slope = np.einsum("nij,nj->ni", matrix, (ends[0] - ends[1]) / 20.0)
        np.testing.assert_allclose(light.turned(matrix, line, velocity)[:, :, axis], slope, rtol=1e-6, atol=1e-8)
    assert LightPath().turned(matrix, line, velocity) is matrix
