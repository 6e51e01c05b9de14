"""Working frames of frame cameras, on the equator (a circle), and against PROJ."""

from __future__ import annotations

import math

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.frame.working_frame import ProjectionFrame, Topocentric, require_frame

RADIUS = 6378137.0


def hidden(lon: float, height: float, camera: float) -> bool:
    """Return whether a place on the equator is behind the Earth for a camera over 0 E 0 N."""
    frame, ground = Topocentric((0.0, 0.0, 0.0)), np.array([[lon, 0.0, height]])
    place = frame.from_ground(ground)
    return bool(frame.behind_the_earth(ground, place, place - [0.0, 0.0, camera])[0])


@pytest.mark.parametrize(("camera", "height"), [(686e3, 0.0), (686e3, 5000.0), (3000.0, 800.0), (36e6, -300.0)])
def test_the_horizon_is_where_a_tangent_touches_sea_level(camera, height):
    """The angle at the Earth's centre: arccos a / (a + camera), and as much more as the place is higher."""
    # Places below sea level are not hidden by the sea over them: theirs is the horizon of sea level.
    horizon = math.acos(RADIUS / (RADIUS + camera))
    horizon += math.acos(RADIUS / (RADIUS + height)) if height > 0 else 0.0
    for side in (1, -1):
        assert not hidden(side * math.degrees(horizon - 1e-4), height, camera)
        assert hidden(side * math.degrees(horizon + 1e-4), height, camera)
    assert hidden(180.0, height, camera)
    assert not hidden(0.0, height, camera)


def test_a_mountain_above_the_camera_is_not_behind_the_earth():
    """Its line of sight is nearest to the Earth's centre behind the camera."""
    assert not hidden(0.05, 3000.0, 1.0)
    assert not hidden(-0.05, 3000.0, 1.0)
    assert hidden(3.0, 3000.0, 1.0)


@pytest.mark.parametrize("lon", [179.9, -179.9, 32.8, 200.0])
def test_rays_come_down_on_the_side_of_the_origin(lon):
    frame, position = Topocentric((lon, 10.0, 0.0)), np.array([0.0, 0.0, 500e3])
    place = np.array([[lon + 0.5, 10.3, 900.0], [lon - 0.5, 9.8, -50.0]])
    line = frame.from_ground(place) - position
    met = frame.meet(position, line / np.linalg.norm(line, axis=1)[:, None], place[:, 2])
    np.testing.assert_allclose(met, place, rtol=0, atol=1e-8)
    back = frame.to_ground(frame.from_ground(place)[0])
    np.testing.assert_allclose(back, [(place[0, 0] + 180) % 360 - 180, 10.3, 900.0], rtol=0, atol=1e-8)


def test_a_topocentric_frame_is_that_of_proj():
    frame, ground = Topocentric((32.8, 39.9, 700.0)), np.array([[33.1, 39.7, 1500.0], [32.0, 41.0, -20.0]])
    space = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(*ground.T)
    local = pyproj.Transformer.from_pipeline("+proj=topocentric +ellps=WGS84 +lon_0=32.8 +lat_0=39.9 +h_0=700")
    expected = np.column_stack(local.transform(*space))
    np.testing.assert_allclose(frame.from_ground(ground), expected, rtol=0, atol=1e-6)
    # Upwards is where a point goes as its height grows.
    higher = frame.from_ground(ground + np.array([0.0, 0.0, 1e3]))
    np.testing.assert_allclose(frame.verticals(ground), (higher - expected) / 1e3, rtol=0, atol=1e-9)
    np.testing.assert_allclose(frame.partials(ground)[:, :, 2], frame.verticals(ground), rtol=0, atol=1e-12)
    # A degree from 39.4 to 40.4, and across, by PROJ's geodesics.
    geod = pyproj.Geod(ellps="WGS84")
    lengths = [geod.inv(32.795, 39.9, 32.805, 39.9)[2] * 100, geod.inv(32.8, 39.895, 32.8, 39.905)[2] * 100]
    np.testing.assert_allclose(frame.metres_per_unit(np.array([32.8, 39.9, 0.0])), lengths, rtol=1e-6)
    assert 1 / frame.curvature == RADIUS


def test_rays_in_a_map_are_straight():
    frame, position = ProjectionFrame(), np.array([500.0, 700.0, 1000.0])
    direction = np.array([[0.6, 0.0, -0.8], [0.0, 0.0, -1.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]])
    met = frame.meet(position, direction, np.array([200.0, 999.5, 200.0, 1800.0, 1200.0]))
    np.testing.assert_allclose(met[[0, 1, 3]], [[1100, 700, 200], [500, 700, 999.5], [500, 1300, 1800]])
    # Upwards to what is below, and downwards to what is above.
    assert np.isnan(met[[2, 4]]).all()
    ground = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    assert not frame.behind_the_earth(ground, ground, ground).any()
    np.testing.assert_array_equal(frame.verticals(ground), [[0, 0, 1], [0, 0, 1]])
    np.testing.assert_array_equal(frame.partials(ground), [np.eye(3), np.eye(3)])
    np.testing.assert_array_equal(frame.metres_per_unit(position), [1, 1])
    assert frame.curvature == 0.0


@pytest.mark.parametrize(
    ("frame", "crs"), [("topocentric", "EPSG:32636"), ("map", "EPSG:4979"), ("tangent", "EPSG:4979")]
)
def test_a_frame_needs_the_ground_that_it_is_made_for(frame, crs):
    with pytest.raises(InputError):
        require_frame(frame, crs)
    require_frame("map", "EPSG:32636")
    require_frame("topocentric", "EPSG:4979")
