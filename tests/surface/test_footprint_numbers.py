"""Points of an image, sizes of pixels and heights under a scene, by hand."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.footprint import (
    Footprint,
    border,
    choose_grid,
    ground_sample_distance,
    image_grid,
    lay,
    scene_pixels,
    two_digits,
)
from ortho_pipeline.surface.writing import write_dem

CRS, X, Y = "EPSG:32651", 300_000.0, 2_700_000.0


@dataclass(frozen=True, eq=False)
class Straight(SensorModel):
    """Vertical rays; `steps` are metres to the east and north for a column and for a row, at a height of 0."""

    kind: ClassVar[str] = "straight"
    steps: tuple[tuple[float, float], tuple[float, float]] = ((2.0, 0.0), (0.0, -2.0))
    #: Relative growth of the steps per metre of height.
    growth: float = 0.0
    heights: tuple[float, float] = (0.0, 400.0)

    @property
    def crs(self) -> str:
        return CRS

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.heights
        return np.array([X, Y, (low + high) / 2]), np.array([5000.0, 5000.0, (high - low) / 2])

    def with_heights(self, low: float, high: float) -> Straight:
        return replace(self, heights=(low, high))

    def ground_to_image(self, ground: Any) -> np.ndarray:
        ground = np.asarray(ground, dtype=float)
        plan = (ground[:, :2] - (X, Y)) / (1 + self.growth * ground[:, 2:])
        return plan @ np.linalg.inv(self.steps)

    def image_to_ground(self, image: Any, height: Any) -> np.ndarray:
        image = np.asarray(image, dtype=float)
        height = np.broadcast_to(np.asarray(height, dtype=float), (len(image),))
        plan = image @ np.array(self.steps) * (1 + self.growth * height[:, None])
        return np.column_stack([plan + np.array([X, Y]), height])


def test_points_of_an_image_include_its_border() -> None:
    assert image_grid(6, 4, 3).tolist() == [[0, 0], [3, 0], [6, 0], [0, 2], [3, 2], [6, 2], [0, 4], [3, 4], [6, 4]]
    ring = [[0, 0], [3, 0], [6, 0], [6, 2], [6, 4], [3, 4], [0, 4], [0, 2], [0, 0]]
    assert border(6, 4, 2).tolist() == ring


@pytest.mark.parametrize("steps", [((3.0, 0.5), (1.0, -2.0)), ((0.5, -3.0), (2.0, 1.0)), ((-3.0, 0.5), (1.0, 2.0))])
def test_the_side_of_a_pixel_is_that_of_a_square_with_its_area(steps: Any) -> None:
    """6.5 m2 at a height of 0; the sides grow by a thousandth per metre."""
    model = Straight(steps, 1e-3)
    found = ground_sample_distance(model, parse_crs(CRS), 101, 70, 150.0)
    assert found == pytest.approx(6.5**0.5 * 1.15, rel=1e-9)
    # Without a height, at that in the middle of the model's range.
    assert ground_sample_distance(model, parse_crs(CRS), 101, 70) == pytest.approx(6.5**0.5 * 1.2, rel=1e-9)


def test_a_pixel_without_an_area_is_refused() -> None:
    with pytest.raises(InputError, match="no size on the ground"):
        ground_sample_distance(Straight(((4.0, -2.0), (2.0, -1.0))), parse_crs(CRS), 100, 80)


@pytest.mark.parametrize(
    ("value", "rounded"),
    [(0.4849, 0.48), (0.4851, 0.49), (12.6, 13.0), (0.09949, 0.099), (0.0996, 0.1), (149.0, 150.0)],
)
def test_sizes_have_two_digits(value: float, rounded: float) -> None:
    assert two_digits(value) == rounded


@pytest.mark.parametrize(
    ("heights", "expected"),
    [
        ((100.0, 500.0), (60.0, 540.0)), ((-50.0, 49.0), (-60.0, 59.0)), ((0.0, 101.0), (-10.1, 111.1)),
        ((7.0, 7.0), (-3.0, 17.0)),
    ],
)  # fmt: skip
def test_a_model_is_meant_for_a_tenth_of_the_range_more_and_at_least_ten_metres(
    heights: tuple[float, float], expected: tuple[float, float]
) -> None:
    model, nothing = Straight(), np.zeros((0, 3))
    found = Footprint(FlatSurface(0.0), nothing, nothing, heights, 0.0).fitted(model)
    assert found.height_range == pytest.approx(expected)


def test_a_model_is_not_changed_for_its_own_heights() -> None:
    model, nothing = Straight(), np.zeros((0, 3))
    assert Footprint(FlatSurface(0.0), nothing, nothing, (0.0, 400.0), 0.0).fitted(model) is model


def test_the_default_grid_has_pixels_of_the_ground_in_the_middle_of_the_image() -> None:
    """A scene of 100 x 80 pixels on ground at 100 m: 2.2 m, and 220 x 176 m from a place beside the pixels."""
    model, surface = Straight(((2.0, 0.0), (0.0, -2.0)), 1e-3), FlatSurface(100.0)
    found = lay(model, surface, 100, 80)
    assert (found.heights, found.middle, found.coverage, found.complete) == ((100.0, 100.0), 100.0, 1.0, True)
    grid = choose_grid(model, found, (100, 80), crs=parse_crs(CRS))
    assert (grid.dx, grid.dy) == (2.2, 2.2)
    west, north = np.floor(X / 2.2) * 2.2, np.ceil(Y / 2.2) * 2.2
    assert (grid.left, grid.top) == pytest.approx((west, north))
    assert grid.left + 2.2 * grid.width == pytest.approx(np.ceil((X + 220) / 2.2) * 2.2)
    assert grid.top - 2.2 * grid.height == pytest.approx(np.floor((Y - 176) / 2.2) * 2.2)
    given = (X + 1.0, Y - 50.0, X + 37.0, Y - 10.0)
    assert choose_grid(model, found, (100, 80), crs=parse_crs(CRS), extent=given, resolution=(3, 4)).extent == given
    wide = choose_grid(model, found, (100, 80), crs=parse_crs(CRS), extent=given, resolution=(7.0, 9.0), align=True)
    assert wide.extent == pytest.approx((X // 7 * 7, (Y - 50) // 9 * 9, X // 7 * 7 + 42, -(-(Y - 10) // 9) * 9))


def test_places_that_a_map_does_not_show_have_no_part_in_its_grid() -> None:
    """UTM has no places a million kilometres from its origin."""
    model, surface, crs, size = Straight(), FlatSurface(100.0), parse_crs("EPSG:4326"), (100, 80)
    found, nowhere = lay(model, surface, *size), np.full((1, 3), 1e9)
    more = replace(found, reach=np.concatenate([found.reach, nowhere]))
    grids = [choose_grid(model, one, size, crs=crs, resolution=1e-5) for one in (found, more)]
    assert grids[0].extent == grids[1].extent
    assert scene_pixels(model, more, grids[0]) == scene_pixels(model, found, grids[0]) > 20_000
    with pytest.raises(InputError, match="outside the area of 'WGS 84'"):
        choose_grid(model, replace(found, reach=nowhere), size, crs=crs, resolution=1e-5)


@pytest.mark.parametrize(("void", "middle"), [(False, 70.0), (True, 80.0)])
def test_the_middle_is_the_height_there_or_the_median(tmp_path: Path, void: bool, middle: float) -> None:
    """Ground at 80 m, at 70 m around the middle, and at 20 m in the west; the mean is 63 m."""
    heights = np.full((100, 120), 80.0)
    heights[:, :40], heights[44:56, 54:66] = 20.0, 70.0
    if void:
        heights[46:54, 56:64] = -9999.0
    write_dem(tmp_path / "dem.tif", heights, (X - 21.0, Y + 21.0), 2.0, CRS)
    found = lay(Straight(), open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), 100, 80)
    assert found.middle == middle
    assert found.heights == (20.0, 80.0)
    assert found.complete is not void
    assert found.voids == (64 if void else 0)
    assert found.coverage == pytest.approx(1 - 64 / 8000 if void else 1.0, abs=2e-4)


@pytest.mark.parametrize(("north", "share"), [(21.0, 1.0), (-19.0, 0.875), (-99.0, 0.375)])
def test_coverage_is_the_share_of_the_area_within_the_samples(tmp_path: Path, north: float, share: float) -> None:
    """A scene of 200 x 160 m; the first samples are so far north of its upper edge, less a metre."""
    write_dem(tmp_path / "dem.tif", np.full((110, 130), 33.0), (X - 21.0, Y + north), 2.0, CRS)
    found = lay(Straight(), open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), 100, 80)
    assert found.coverage == pytest.approx(share, abs=1e-9)
    assert found.complete is (share == 1.0)
    assert found.heights == (33.0, 33.0)
    # The part without heights is at that of the middle, or of the median.
    assert sorted(set(found.reach[:, 2].tolist())) == [33.0]
    low, high = found.reach.min(axis=0), found.reach.max(axis=0)
    np.testing.assert_allclose((low[:2], high[:2]), ((X, Y - 160), (X + 200, Y)), atol=1e-6)


def test_few_samples_are_covered_where_rays_meet_them(tmp_path: Path) -> None:
    """Samples of 50 m under 200 x 160 m, a void 101 m east and south of the corner: it is part of four cells.

    Of 33 x 33 rays, 6.25 m and 5 m apart, 16 x 20 are in these cells.
    """
    heights = np.full((12, 13), 33.0)
    heights[4, 4] = -9999.0
    write_dem(tmp_path / "dem.tif", heights, (X - 124.0, Y + 124.0), 50.0, CRS)
    found = lay(Straight(), open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), 100, 80)
    assert found.coverage == pytest.approx(1 - 320 / 1089, abs=1e-12)
    assert (found.complete, found.voids, found.unmet) == (False, 1, True)
    filled = lay(Straight(), open_dem(tmp_path / "dem.tif", "ellipsoid", fill=12.0), 100, 80)
    assert filled.coverage == found.coverage
    assert (filled.complete, filled.voids, filled.unmet) == (False, 1, False)


def test_the_edge_of_few_samples_is_that_of_the_area(tmp_path: Path) -> None:
    """The last samples are 101 m east of the corner: 17 of 33 columns of rays meet them, but 101 of 200 m."""
    write_dem(tmp_path / "dem.tif", np.full((12, 5), 33.0), (X - 124.0, Y + 124.0), 50.0, CRS)
    found = lay(Straight(), open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), 100, 80)
    assert found.coverage == pytest.approx(101 / 200, abs=1e-9)
