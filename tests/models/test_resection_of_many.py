"""Resection from many points: gross errors do not count, the largest triangles do, and heights have a margin."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.frame.resection import _best, _triples, resect
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

INTERIOR = Interior(1000, 1500, 0.120, 1e-4, 1e-4, 2e-3, -1e-3)
CRS = "EPSG:32636"


def camera(altitude: float) -> FrameCamera:
    return FrameCamera.from_map(
        INTERIOR, CRS, [480e3, 4.42e6, altitude, 0.1, -0.2, 2.5], frame="map", heights=(0.0, altitude - 1e-3)
    )


def points_of(true: FrameCamera, heights: Array, seed: int = 5) -> Points:
    random = np.random.default_rng(seed)
    image = random.uniform([30, 30], [970, 1470], (len(heights), 2))
    return Points.of(image, true.image_to_ground(image, heights), CRS)


@pytest.mark.parametrize(
    ("altitude", "low", "high", "margin"),
    [
        # Half of the range and 100 m more, at most a fifth of the clearance above the highest point, 1 m at least.
        (6000.0, 700.0, 1300.0, 400.0),
        (6000.0, 700.0, 4100.0, 380.0),
        (120.0, 10.0, 30.0, 18.0),
        (33.0, 10.0, 30.0, 1.0),
    ],
)
def test_heights_of_a_camera_are_those_of_its_points_with_a_margin(
    altitude: float, low: float, high: float, margin: float
) -> None:
    heights = np.array([low, high, *np.linspace(low + 0.1 * (high - low), high - 0.3 * (high - low), 7)])
    found = resect(points_of(camera(altitude), heights), INTERIOR, map_crs=CRS)
    np.testing.assert_allclose(found.exterior, camera(altitude).exterior, atol=1e-3)
    assert found.heights == pytest.approx((low - margin, high + margin), abs=0.01)


@pytest.mark.parametrize("known", [False, True])
def test_a_third_of_the_points_may_be_anywhere(known: bool) -> None:
    """Coordinates that are r px off count by 2 (sqrt(1 + (r / 3)^2) - 1), which is least for this camera."""
    true = camera(6000.0)
    random = np.random.default_rng(3)
    points = points_of(true, random.uniform(700.0, 1900.0, 24))
    image = points.image.copy()
    wrong = random.permutation(24)[:8]
    image[wrong] = random.uniform([0, 0], [1000, 1500], (8, 2))
    position = true.exterior[:3] + np.array([3.0, -2.0, 4.0])
    found = resect(Points.of(image, points.ground, CRS), INTERIOR, map_crs=CRS, position=position if known else None)
    good = np.setdiff1d(np.arange(24), wrong)
    assert np.abs(found.ground_to_image(points.ground[good]) - points.image[good]).max() < 5.0
    off = (found.ground_to_image(points.ground) - image).ravel()
    slopes = found.param_partials(points.ground).reshape(48, 6)
    pull = slopes.T @ (off / np.sqrt(1 + (off / 3.0) ** 2))
    np.testing.assert_allclose(pull / np.linalg.norm(slopes, axis=0), 0.0, atol=1e-3)


def test_of_many_points_the_sixty_largest_triangles_are_solved() -> None:
    """Of 240 that are drawn; none is of three points in a row, and they are in the order of their size."""
    random = np.random.default_rng(2)
    flat = random.uniform(-0.4, 0.4, (26, 2))
    bearings = np.column_stack([flat, np.ones(26)])
    place = np.column_stack([flat * 800.0, random.uniform(-50, 50, 26)])
    found = _triples(place, bearings)
    assert len(found) == 60

    def area(triple: Array) -> float:
        return float(np.linalg.norm(np.cross(*(bearings[triple[1:]] - bearings[triple[0]]))) / 2)

    sizes = [area(triple) for triple in found]
    assert sizes == sorted(sizes, reverse=True)
    every = [area(np.array([i, j, k])) for i in range(26) for j in range(i) for k in range(j)]
    assert sizes[-1] > np.quantile(every, 0.6)
    assert all(len(set(triple.tolist())) == 3 for triple in found)


def test_the_eight_solutions_with_the_smallest_median_angle_are_refined() -> None:
    """Half of the points may be seen in another direction, or in none."""
    random = np.random.default_rng(9)
    place = np.column_stack([random.uniform(-300, 300, (11, 2)), random.uniform(-20, 20, 11)])
    centre = np.array([10.0, -20.0, 900.0])
    lines = place - centre
    bearings = lines / np.linalg.norm(lines, axis=1)[:, None]
    bearings[:4] = bearings[[1, 2, 3, 0]]
    bearings[4] = np.nan
    offs = np.array([30.0, 1.0, 12.0, 4.0, 25.0, 2.0, 9.0, 18.0, 6.0, 40.0])
    solutions = [(np.eye(3), centre + np.array([off, 0.0, 0.0])) for off in offs]
    found = _best(solutions, place, bearings)
    assert [start[0] - 10.0 for start in found] == pytest.approx(sorted(offs)[:8])
    for start in found:
        np.testing.assert_allclose(start[1:], [-20.0, 900.0, 0.0, 0.0, 0.0], atol=1e-12)
    assert _best([], place, bearings) == []
