"""Rays as polynomials in height on a lattice over the image, and how wrong they are between its nodes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.surface import ray_kernel, rays

ORIGIN, SPACING, MIDDLE, HALF = np.array([40.0, -7.0]), 16, 300.0, 250.0
#: Columns and rows of nodes.
SIZE = np.array([5, 4])


def ray_of(bend: tuple[float, float] = (0.0, 0.0)) -> Any:
    """Return rays whose DEM coordinates are bilinear in the image, but for a bend, and of degree four in height."""

    def samples(image: np.ndarray, height: np.ndarray) -> np.ndarray:
        (x, y), t = np.asarray(image).T, (np.asarray(height) - MIDDLE) / HALF
        u = 3 + 0.5 * x - 0.1 * y + 0.01 * x * y + (0.7 + 0.02 * x) * t - 0.3 * t**2 + 0.2 * t**3 + 0.05 * t**4
        v = 9 + 0.2 * x + 0.4 * y - (1.1 - 0.03 * y) * t + 0.6 * t**2 - 0.1 * t**3 - 0.4 * t**4
        return np.stack([u + bend[0] * x**2, v + bend[1] * y**2], axis=1)

    return SimpleNamespace(samples=samples)


def test_nodes_are_polynomials_in_the_normalised_height() -> None:
    ray = ray_of()
    nodes = rays._ray_lattice(ray, ORIGIN, SIZE, SPACING, MIDDLE, HALF)
    assert nodes.shape == (4, 5, 5, 2)
    for row, column in np.ndindex(4, 5):
        for t in (-1.0, -0.3, 0.45, 1.0):
            image = ORIGIN + SPACING * np.array([column, row])
            found = t ** np.arange(5) @ nodes[row, column]
            np.testing.assert_allclose(found, ray.samples(image[None], [MIDDLE + HALF * t])[0], atol=1e-9)
    flat = rays.curve_nodes(nodes)
    assert flat.shape == (4, 5, 10)
    np.testing.assert_array_equal(flat[2, 3], [*nodes[2, 3, :, 0], *nodes[2, 3, :, 1]])


def error(bend: tuple[float, float]) -> float:
    ray, extent = ray_of(bend), (SIZE - 1.2) * SPACING
    nodes = rays._ray_lattice(ray, ORIGIN, SIZE, SPACING, MIDDLE, HALF)
    return rays._lattice_error(ray, nodes, ORIGIN, extent, SPACING, MIDDLE, HALF)


@pytest.mark.parametrize("bend", [(4e-4, 0.0), (-4e-4, 0.0), (0.0, 7e-4), (2e-4, -7e-4)])
def test_the_error_is_the_largest_between_the_nodes(bend: tuple[float, float]) -> None:
    """Between two nodes a parabola is farthest from its chord in the middle: by the square of half the spacing."""
    assert error((0.0, 0.0)) < 1e-9
    largest = max(map(abs, bend)) * 8**2
    assert 0.99 * largest < error(bend) <= largest * (1 + 1e-9)


def test_rays_that_are_nowhere_make_the_error_infinite() -> None:
    good = ray_of()

    def samples(image: np.ndarray, height: np.ndarray) -> np.ndarray:
        found = good.samples(image, height)
        return np.where(np.asarray(image)[:, :1] > 100.5, np.nan, found)

    ray: Any = SimpleNamespace(samples=samples)
    nodes = rays._ray_lattice(good, ORIGIN, SIZE, SPACING, MIDDLE, HALF)
    extent = (SIZE - 1) * SPACING - 1e-6
    assert rays._lattice_error(ray, nodes, ORIGIN, extent, SPACING, MIDDLE, HALF) == np.inf


@pytest.mark.parametrize(
    ("slope", "lean", "steep"),
    [
        # A ray of 1 / 25 samples per metre, and terrain that climbs a metre less or more than it: 24 and 26 m a sample.
        ((24.0, 0.0), ((10.0, 0.0), (0.0, 0.0)), False), ((26.0, 0.0), ((10.0, 0.0), (0.0, 0.0)), True),
        ((-26.0, 0.0), ((10.0, 0.0), (0.0, 0.0)), False), ((-26.0, 0.0), ((-10.0, 0.0), (0.0, 0.0)), True),
        ((0.0, 24.0), ((0.0, 0.0), (10.0, 0.0)), False), ((0.0, 26.0), ((0.0, 0.0), (10.0, 0.0)), True),
        # Along both axes together.
        ((12.0, 14.0), ((10.0, 0.0), (10.0, 0.0)), True), ((12.0, -14.0), ((10.0, 0.0), (10.0, 0.0)), False),
        # With a bend of 2.5, of which the slope grows by twice as much at the ends: 1 / 50 to 3 / 50 samples per metre.
        ((16.0, 0.0), ((10.0, 2.5), (0.0, 0.0)), False), ((17.0, 0.0), ((10.0, 2.5), (0.0, 0.0)), True),
    ],
)  # fmt: skip
def test_terrain_is_steep_if_it_climbs_faster_than_a_ray(slope: Any, lean: Any, steep: bool) -> None:
    """Between half a range of 250 m below the middle and as much above it."""
    rows, columns = np.mgrid[0:20, 0:30]
    heights = 100.0 + slope[0] * columns + slope[1] * rows
    nodes = np.zeros((1, 2, 10))
    nodes[0, :, (0, 5)] = 10.0
    nodes[0, :, 1], nodes[0, :, 2] = lean[0]
    nodes[0, :, 6], nodes[0, :, 7] = lean[1]
    found = ray_kernel.terrain_of(heights, 2, 3, MIDDLE, HALF, nodes)
    assert (found.left, found.top, found.middle, found.half) == (2, 3, MIDDLE, HALF)
    assert found.steepest == max(map(abs, slope))
    assert bool((found.steep > -np.inf).any()) is steep
    assert found.tops[-1] == heights.max()


def test_rays_without_a_place_have_no_part_in_what_is_steep() -> None:
    rows, columns = np.mgrid[0:20, 0:30]
    nodes = np.full((1, 3, 10), 0.0)
    nodes[0, 0, 1], nodes[0, 1, 1], nodes[0, 2] = 10.0, np.nan, np.nan
    for slope, steep in ((24.0, False), (26.0, True)):
        found = ray_kernel.terrain_of(slope * columns + 0.0 * rows, 0, 0, MIDDLE, HALF, nodes)
        assert bool((found.steep > -np.inf).any()) is steep
    assert not (ray_kernel.terrain_of(90.0 * columns, 0, 0, MIDDLE, HALF, nodes[:, 1:]).steep > -np.inf).any()


# -- samples under rays ----------------------------------------------------------------------------------------------

CRS = "EPSG:32651"


def window(image: Any, heights: tuple[float, float], fill: Any = "error") -> tuple[int, int, int, int] | None:
    """Return the window of a DEM of 60 columns and 50 rows under rays that go 5 m to the east for 100 m upwards.

    A pixel is 2 m, a sample 10 m wide; the first pixel is at the first sample.
    """

    def image_to_ground(image: np.ndarray, height: np.ndarray) -> np.ndarray:
        return np.column_stack([100 + 2 * image[:, 0] + 0.05 * height, 200 - 2 * image[:, 1], height])

    def samples_at(xy: np.ndarray) -> np.ndarray:
        return np.column_stack([(xy[:, 0] - 100) / 10, (200 - xy[:, 1]) / 10])

    model: Any = SimpleNamespace(crs=CRS, image_to_ground=image_to_ground)
    surface: Any = SimpleNamespace(
        crs=parse_crs(CRS), samples_at=samples_at, shape=(50, 60), fill=fill, nearest_reach=7
    )
    return rays._Ray(model, np.array(image, dtype=float), surface)._window(*heights)


@pytest.mark.parametrize(
    ("image", "heights", "fill", "expected"),
    [
        # Columns 21.1 to 27 at a height of 0, 23.1 to 29 at 400 m; rows 22.2 to 36. Two before and three after.
        ([(105.5, 111), (135, 180)], (0, 400), "error", (19, 20, 13, 19)),
        ([(135, 111), (105.5, 180)], (-400, 0), "mask", (17, 20, 13, 19)),
        ([(105.5, 111), (135, 180)], (0, 400), 5.0, (19, 20, 13, 19)),
        ([(105.5, 111), (135, 180)], (0, 400), "nearest", (12, 13, 27, 33)),
        # A point that is not finite has no part.
        ([(105.5, 111), (np.nan, np.nan), (135, 180)], (0, 400), "error", (19, 20, 13, 19)),
        ([(np.nan, 111), (np.nan, 180)], (0, 400), "error", None),
        # Up to the edges of the DEM.
        ([(-20, -10), (5, 5)], (0, 0), "error", (0, 0, 4, 4)),
        ([(280, 230), (400, 300)], (0, 0), "error", (54, 44, 6, 6)),
        ([(-40, 5), (-6, 9)], (0, 0), "error", (0, 0, 2, 5)), ([(-40, 5), (-11, 9)], (0, 0), "error", None),
        ([(304, 5), (320, 9)], (0, 0), "error", (58, 0, 2, 5)), ([(306, 5), (320, 9)], (0, 0), "error", None),
        # With a fill, a part of two samples at the edge.
        ([(-90, 5), (-80, 9)], (0, 0), 5.0, (0, 0, 2, 5)), ([(500, 5), (600, 9)], (0, 0), 5.0, (58, 0, 2, 5)),
        ([(5, 400), (9, 450)], (0, 0), 5.0, (0, 48, 5, 2)), ([(-90, 5), (-80, 9)], (0, 0), "nearest", (0, 0, 2, 12)),
    ],
)  # fmt: skip
def test_the_samples_under_rays_are_those_between_two_heights_and_a_margin(
    image: Any, heights: Any, fill: Any, expected: Any
) -> None:
    assert window(image, heights, fill) == expected
