"""Resection: three points by hand, and which points are enough."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import DegeneratePoints, NotConverged, TooFewPoints
from ortho_pipeline.geodesy.ellipsoid import rotation_of_angles
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.frame.resection import _grunert, _solutions, _triangles, _triples, resect
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

INTERIOR = Interior(1000, 1500, 0.120, 1e-4, 1e-4)
TRUTH = FrameCamera.from_map(
    INTERIOR, "EPSG:32636", [480e3, 4.42e6, 6000.0, 0.1, -0.2, 2.5], frame="map", heights=(700.0, 1900.0)
)
IMAGE = np.array([[60.0, 80.0], [930.0, 140.0], [880.0, 1400.0], [120.0, 1330.0], [520.0, 700.0], [300.0, 400.0]])


def points(count: int = 6, heights: float = 300.0) -> Points:
    image = IMAGE[:count]
    ground = TRUTH.image_to_ground(image, 1000.0 + heights * np.sin(np.arange(count)))
    return Points(
        ids=tuple(f"p{i}" for i in range(count)), image=image.copy(), ground=ground, roles=np.full(count, "control"),
        sigma_image=np.full(count, 0.5), sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS("EPSG:32636"), source="t",
    )  # fmt: skip


# -- three points ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_the_true_distances_are_among_those_of_three_points(seed):
    """Of a scalene triangle anywhere in front of the camera, also where the directions are far apart."""
    random = np.random.default_rng(seed)
    truth = random.uniform(3.0, 9.0, 3)
    rays = np.column_stack([random.uniform(-0.6, 0.6, (3, 2)), np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    found = list(_grunert(truth[:, None] * rays, rays))
    assert 1 <= len(found) <= 4
    assert min(np.abs(distances - truth).max() for distances in found) < 1e-6


def test_rotation_and_position_follow_from_three_points():
    turn, position = rotation_of_angles(0.3, -0.2, 1.1), np.array([10.0, -20.0, 500.0])
    place = np.array([[0.0, 0.0, 3.0], [90.0, 10.0, -4.0], [20.0, 80.0, 20.0], [-70.0, 30.0, 0.0]])
    seen = (place - position) @ turn.T
    bearings = seen / np.linalg.norm(seen, axis=1)[:, None]
    found = list(_solutions(place, bearings))
    # Four triples, each with the truth among its solutions.
    right = [np.abs(rotation - turn).max() < 1e-6 and np.abs(at - position).max() < 1e-4 for rotation, at in found]
    assert sum(right) == 4


def test_area_and_shape_of_triangles_by_hand():
    # 3, 4, 5: area 6, height over the longest side 2.4, of which a part of 5; equilateral; on one line; one point.
    corners = np.array(
        [
            [[0, 0, 1], [3, 0, 1], [0, 4, 1]],
            [[0, 0, 0], [2, 0, 0], [1, math.sqrt(3), 0]],
            [[0, 0, 0], [1, 1, 1], [3, 3, 3]],
            [[5, 5, 5], [5, 5, 5], [5, 5, 5]],
        ],
        dtype=float,
    )
    area, shape = _triangles(corners)
    np.testing.assert_allclose(area, [6.0, math.sqrt(3), 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(shape, [2.4 / 5, math.sqrt(3) / 2, 0.0, 0.0], atol=1e-12)


def test_triples_are_the_largest_first_and_none_is_flat():
    flat = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.51], [0.1, 0.1], [np.nan, 0.3]])
    bearings = np.column_stack([flat, np.ones(6)])
    place = np.column_stack([100 * np.nan_to_num(flat), np.zeros(6)])
    found = [frozenset(triple.tolist()) for triple in _triples(place, bearings)]
    areas = [np.linalg.norm(np.cross(*(bearings[sorted(t)][1:] - bearings[sorted(t)][0]))) for t in found]
    assert found[0] == {0, 1, 2}
    assert areas == sorted(areas, reverse=True)
    # The height of point 3 over the longest side from 1 to 2 is 0.01 / 2**0.5, half a hundredth of it.
    assert {1, 2, 3} not in found
    assert all(5 not in triple for triple in found)
    # 10 triples of 5 usable points, without 1, 2, 3 and without 0, 3, 4, which are nearly on one line.
    assert len(found) == len(set(found)) == 8


# -- all points ------------------------------------------------------------------------------------------------------


def test_as_many_points_as_are_needed_are_enough():
    assert np.abs(resect(points(4), INTERIOR, map_crs="EPSG:32636").exterior - TRUTH.exterior).max() < 1e-3
    with pytest.raises(TooFewPoints):
        resect(points(3), INTERIOR, map_crs="EPSG:32636")
    known = TRUTH.exterior[:3]
    found = resect(points(3), INTERIOR, map_crs="EPSG:32636", position=known)
    assert np.abs(found.exterior - TRUTH.exterior).max() < 1e-3
    near = resect(points(3), INTERIOR, map_crs="EPSG:32636", position=known + np.array([30, -20, 40]))
    assert np.abs(near.ground_to_image(points(3).ground) - points(3).image).max() < 1e-3
    with pytest.raises(TooFewPoints):
        resect(points(2), INTERIOR, map_crs="EPSG:32636", position=known)


def test_points_without_heights_and_check_points_do_not_count():
    some = points(5)
    some.ground[0, 2] = np.nan
    assert np.abs(resect(some, INTERIOR, map_crs="EPSG:32636").exterior - TRUTH.exterior).max() < 1e-3
    roles = some.roles.copy()
    roles[1] = "check"
    with pytest.raises(TooFewPoints):
        resect(replace(some, roles=roles), INTERIOR, map_crs="EPSG:32636")


def test_a_camera_that_misses_most_of_its_points_is_none():
    """Half of the points within a twentieth of the diagonal of the image, 90 px here, is the least."""
    for moved, fits in ((60.0, True), (400.0, False)):
        some = points(6)
        some.image[:] += moved * np.array([[1, 1], [-1, 1], [1, -1], [-1, -1], [1, 0], [0, 1]])
        if fits:
            resect(some, INTERIOR, map_crs="EPSG:32636")
        else:
            with pytest.raises((NotConverged, DegeneratePoints)):
                resect(some, INTERIOR, map_crs="EPSG:32636")


def test_given_heights_are_those_of_the_camera():
    assert resect(points(), INTERIOR, map_crs="EPSG:32636", heights=(5.0, 4000.0)).heights == (5.0, 4000.0)
