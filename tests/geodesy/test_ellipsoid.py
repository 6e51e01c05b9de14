"""Conversions, local axes, and rays at a height: against PROJ, and against circles on the equator."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest

from ortho_pipeline.geodesy.ellipsoid import (
    enu_from_ecef,
    enu_from_geodetic,
    geocentric,
    geodetic,
    meet_height,
    metres_per_degree,
    orbital_from_ecef,
)

RADIUS = 6378137.0
PLACES = np.array(
    [[32.8, 39.9, 900.0], [-70.2, -33.4, 5400.0], [151.0, -12.0, -400.0], [-12.0, 78.0, 686e3], [-179.9, 0.3, 35.8e6]]
)


def in_space(ground: np.ndarray) -> np.ndarray:
    """Return ECEF by PROJ."""
    there = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    return np.column_stack(there.transform(*ground.T))


def test_geocentric_and_back_are_those_of_proj():
    np.testing.assert_allclose(geocentric(PLACES), in_space(PLACES), rtol=0, atol=2e-8)
    np.testing.assert_allclose(geodetic(in_space(PLACES)), PLACES, rtol=0, atol=2e-8)


def test_the_axis_of_the_earth_has_its_two_ends():
    polar = RADIUS * (1 - 1 / 298.257223563)
    found = geodetic(np.array([[0.0, 0.0, polar + 10.0], [0.0, 0.0, -polar - 20.0]]))
    np.testing.assert_allclose(found[:, 1:], [[90.0, 10.0], [-90.0, 20.0]], rtol=0, atol=2e-4)


def test_local_axes_are_those_of_proj():
    for lon, lat, h in PLACES:
        local = pyproj.Transformer.from_pipeline(f"+proj=topocentric +ellps=WGS84 +lon_0={lon} +lat_0={lat} +h_0={h}")
        origin = in_space(np.array([[lon, lat, h]]))
        axes = np.column_stack(local.transform(*(origin + 1e3 * np.eye(3)).T)) / 1e3
        np.testing.assert_allclose(enu_from_ecef(np.array([[lon, lat]]))[0].T, axes, rtol=0, atol=1e-9)
        near = np.array([[lon, lat, h], [lon + 0.3, lat - 0.2, h + 70.0]])
        expected = np.column_stack(local.transform(*in_space(near).T))
        found = enu_from_geodetic(near, np.array([lon, lat, h]))[0]
        np.testing.assert_allclose(found, expected, rtol=0, atol=5e-8)


def test_derivatives_of_local_coordinates_are_differences_of_those_of_proj():
    origin, point = np.array([10.0, 47.0, 300.0]), np.array([[10.4, 46.8, 2500.0]])
    local = pyproj.Transformer.from_pipeline("+proj=topocentric +ellps=WGS84 +lon_0=10 +lat_0=47 +h_0=300")
    steps = np.diag([1e-4, 1e-4, 10.0])
    ahead, behind = (np.column_stack(local.transform(*in_space(point + sign * steps).T)) for sign in (1, -1))
    slopes = (ahead - behind).T / (2 * steps.diagonal())
    np.testing.assert_allclose(enu_from_geodetic(point, origin)[1][0], slopes, rtol=0, atol=1e-3)


@pytest.mark.parametrize("height", [-400.0, 0.0, 686e3])
def test_a_degree_is_as_long_as_on_the_ellipsoid_and_grows_with_height(height):
    half = 5e-4
    for lat in (0.0, -33.4, 60.0):
        for axis, nudge in enumerate(([half, 0.0, 0.0], [0.0, half, 0.0])):
            ends = in_space(np.array([[20.0, lat, height]]) + np.array([nudge, np.negative(nudge)]))
            length = np.linalg.norm(ends[0] - ends[1]) / (2 * half)
            assert metres_per_degree(np.array([[20.0, lat, height]]))[0, axis] == pytest.approx(length, rel=1e-8)


# -- rays ------------------------------------------------------------------------------------------------------------


def test_rays_meet_a_height_on_their_way_and_nowhere_else():
    """The point is on the ray by PROJ, at the height, and the nearer of two."""
    random, target = (
        np.random.default_rng(4),
        np.array([[32.8, 39.9, 1200.0], [-70.0, -20.0, 0.0], [15.0, 70.0, 8000.0]]),
    )
    up = enu_from_ecef(target)
    for _ in range(5):
        leaning = np.column_stack([random.uniform(-1.5, 1.5, (3, 2)), np.ones(3)])
        back = np.einsum("ni,nij->nj", leaning / np.linalg.norm(leaning, axis=1)[:, None], up)
        origin = in_space(target) + random.uniform(3e3, 2e6, 3)[:, None] * back
        found = meet_height(origin, -back, target[:, 2])
        np.testing.assert_allclose(in_space(found), in_space(target), rtol=0, atol=1e-5)
        np.testing.assert_allclose(found[:, 2], target[:, 2], rtol=0, atol=1e-8)


@pytest.mark.parametrize("height", [400.0, 9000.0, 686e3])
def test_a_ray_from_below_a_height_meets_it_where_it_leaves(height):
    """On the equator, which is a circle: a level ray reaches the height after the square root of (a + h)^2 - a^2."""
    origin, level, up = np.array([[RADIUS, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]]), np.array([[1.0, 0.0, 0.0]])
    distance = math.sqrt((RADIUS + height) ** 2 - RADIUS**2)
    found = meet_height(origin, level, np.array([height]))[0]
    np.testing.assert_allclose(found, [math.degrees(math.atan2(distance, RADIUS)), 0.0, height], atol=1e-7)
    np.testing.assert_allclose(meet_height(origin, up, np.array([height]))[0], [0.0, 0.0, height], atol=1e-8)
    # Straight down: on the other side of the Earth.
    np.testing.assert_allclose(np.abs(meet_height(origin, -up, np.array([height]))[0]), [180.0, 0.0, height], atol=1e-7)


def test_rays_that_pass_above_a_height_or_start_beyond_it_meet_nothing():
    origin = np.array([[RADIUS + 686e3, 0.0, 0.0]])
    # The horizon of a height of 1000 m is at an angle from straight down with the sine (a + 1000) / (a + 686,000).
    horizon = math.asin((RADIUS + 1000.0) / (RADIUS + 686e3))
    for angle, met in ((horizon - 1e-6, True), (horizon + 1e-6, False), (math.pi, False), (math.pi / 2, False)):
        direction = np.array([[-math.cos(angle), math.sin(angle), 0.0]])
        assert np.isfinite(meet_height(origin, direction, np.array([1000.0]))).all() == met
    # One ray that misses spoils no other.
    both = meet_height(np.repeat(origin, 2, axis=0), np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.full(2, 50.0))
    assert np.isnan(both[0]).all()
    np.testing.assert_allclose(both[1], [0.0, 0.0, 50.0], atol=1e-8)


# -- orbits ----------------------------------------------------------------------------------------------------------


def test_the_inertial_velocity_of_an_orbit_has_the_rotation_of_the_earth():
    """The Earth turns once in a sidereal day of 86,164.1 s; a satellite at rest above it moves east."""
    position = np.array([0.0, 42164e3, 0.0])
    along, right, down = orbital_from_ecef(position, np.zeros(3))
    np.testing.assert_allclose([along, right, down], [[-1, 0, 0], [0, 0, -1], [0, -1, 0]], atol=1e-12)
    east = 2 * math.pi / 86164.1 * 7e6
    along, right, down = orbital_from_ecef(np.array([7e6, 0.0, 0.0]), np.array([30.0, 0.0, 7500.0]))
    size = math.hypot(east, 7500.0)
    np.testing.assert_allclose(along, [0.0, east / size, 7500.0 / size], atol=1e-7)
    np.testing.assert_allclose(right, [0.0, 7500.0 / size, -east / size], atol=1e-7)
    np.testing.assert_allclose(down, [-1.0, 0.0, 0.0], atol=1e-12)
