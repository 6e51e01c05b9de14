"""The local frame of a block, against the topocentric systems of PROJ."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from ortho_pipeline.block.intersection import ray_angles
from ortho_pipeline.block.local_frame import GroundFrame, enu_partials
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior

GROUND = np.array([[12.3, 41.7, 250.0], [12.9, 42.2, -30.0], [12.5, 42.1, 3000.0]])


def topocentric(origin: np.ndarray, ground: np.ndarray) -> np.ndarray:
    """Return east, north, up (m) of lon, lat, h about an origin, by PROJ."""
    lon, lat, h = origin.tolist()
    way = pyproj.Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={lon!r} +lat_0={lat!r} +h_0={h!r}"
    )
    return np.column_stack(way.transform(*ground.T))


@pytest.fixture(scope="module")
def frame() -> GroundFrame:
    return GroundFrame.about(np.vstack([GROUND, [[np.nan, 50.0, 0.0]]]))


def test_the_frame_is_in_the_middle_of_the_points_at_height_zero(frame: GroundFrame) -> None:
    assert frame.origin[2] == 0.0
    east, north, _ = topocentric(frame.origin, GROUND).T
    for along in (east, north):
        # The middle of the box of geocentric coordinates, which is about that of the box here.
        assert abs(along.min() + along.max()) < 0.1 * np.ptp(along)


def test_places_of_the_frame_are_those_of_proj(frame: GroundFrame) -> None:
    local = frame.of_geodetic(GROUND)
    np.testing.assert_allclose(local, topocentric(frame.origin, GROUND), atol=1e-6)
    back = frame.geodetic(local)
    np.testing.assert_allclose(back[:, :2], GROUND[:, :2], rtol=0, atol=1e-11)
    np.testing.assert_allclose(back[:, 2], GROUND[:, 2], atol=1e-6)


def test_differences_are_east_north_up_at_the_point_itself(frame: GroundFrame) -> None:
    """Forty kilometres from the origin, up differs by a third of a degree."""
    moved = GROUND + np.array([2e-5, -3e-5, 4.0])
    apart = frame.apart(GROUND, frame.of_geodetic(moved))
    for ground, there, found in zip(GROUND, moved, apart, strict=True):
        np.testing.assert_allclose(found, -topocentric(ground, there[None])[0], atol=1e-6)
    for turn in frame.enu_at(GROUND):
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("crs", ["EPSG:4979", "EPSG:32633", "EPSG:4978"])
def test_partials_of_places_are_differences_of_proj(frame: GroundFrame, crs: str) -> None:
    local = frame.of_geodetic(GROUND)
    places = frame.places(local)
    way = pyproj.Transformer.from_crs("EPSG:4979", crs, always_xy=True)
    np.testing.assert_allclose(places.in_crs(crs), np.column_stack(way.transform(*GROUND.T)), rtol=1e-12, atol=1e-8)
    for axis in range(3):
        step = 5.0 * np.eye(3)[axis]
        ahead, behind = (np.column_stack(way.transform(*frame.geodetic(local + s * step).T)) for s in (1, -1))
        wanted = (ahead - behind) / 10.0
        np.testing.assert_allclose(places.partials(crs)[:, :, axis], wanted, atol=1e-6 * np.abs(wanted).max())


def test_partials_are_pixels_per_metre_east_north_and_up() -> None:
    interior = Interior(width=4000, height=3000, focal_length=0.03, pitch_x=5e-6, pitch_y=5e-6)
    camera = FrameCamera.from_roll_pitch_yaw(interior, (12.5, 42.0, 3000.0), 2.0, -3.0, 20.0, heights=(0.0, 300.0))
    ground = np.array([[12.5, 42.0, 100.0], [12.503, 41.998, 20.0]])
    found = enu_partials(camera, ground)
    geod = pyproj.Geod(ellps="WGS84")
    for axis, azimuth in enumerate((90.0, 0.0)):
        ends = []
        for sign in (1.0, -1.0):
            lon, lat, _ = geod.fwd(*ground[:, :2].T, [azimuth] * 2, [sign] * 2)
            ends.append(camera.ground_to_image(np.column_stack([lon, lat, ground[:, 2]])))
        np.testing.assert_allclose(found[:, :, axis], (ends[0] - ends[1]) / 2, rtol=2e-3, atol=1e-3)
    higher, lower = (camera.ground_to_image(ground + np.array([0.0, 0.0, step])) for step in (1.0, -1.0))
    np.testing.assert_allclose(found[:, :, 2], (higher - lower) / 2, rtol=2e-3, atol=1e-3)


def test_angles_are_those_between_lines_of_one_point() -> None:
    """Lines have no sense and no length: -120 degrees are 60, and opposite directions are one line."""
    directions = np.array([[2, 0, 0], [0, 0, 1], [-0.5, 3**0.5 / 2, 0], [np.nan, 0, 0], [0, 0, -7.0], [0, 5, 0]])
    point = np.array([4, 9, 4, 4, 9, 4])
    one, other, angles = ray_angles(point, directions)
    found = {(int(a), int(b)): angle for a, b, angle in zip(one, other, angles, strict=True)}
    assert found.keys() == {(0, 2), (0, 5), (2, 5), (1, 4)}
    wanted = {(0, 2): 60.0, (0, 5): 90.0, (2, 5): 30.0, (1, 4): 0.0}
    assert found == {pair: pytest.approx(angle, abs=1e-5) for pair, angle in wanted.items()}
