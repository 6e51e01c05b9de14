"""Windows, ranges and excerpts of a DEM by brute force, with samples from memory."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from samples import CRS, Memory
from scipy.ndimage import map_coordinates

from ortho_pipeline.errors import CoverageError, InputError
from ortho_pipeline.surface import dem as dem_module
from ortho_pipeline.surface.dem import DemSurface, dem_of, open_dem
from ortho_pipeline.surface.dem_file import Affine, SampleGrid
from ortho_pipeline.surface.voids import nearest_heights

HEIGHTS = np.random.default_rng(3).uniform(100.0, 900.0, (40, 50))


def surface(heights: np.ndarray = HEIGHTS, fill: Any = "error") -> DemSurface:
    return dem_of(Memory(heights, (3e5, 6.28e6)), "ellipsoid", False, fill, 10**8)  # type: ignore[arg-type]


def at(*places: tuple[float, float]) -> np.ndarray:
    """Return ground at sample coordinates."""
    return np.array([(3e5 + 10.0 * u, 6.28e6 - 10.0 * v, 0.0) for u, v in places])


@pytest.mark.parametrize(
    ("places", "columns", "rows"),
    [
        ([(10.2, 5.7), (14.8, 9.1)], (10, 15), (5, 10)),
        ([(10.0, 5.0)], (10, 10), (5, 5)),
        ([(0.0, 0.0), (3.4, 2.2)], (0, 4), (0, 3)),
        ([(-4.0, -3.0), (1.5, 1.5)], (0, 2), (0, 2)),
        ([(45.5, 36.5), (49.0, 39.0)], (45, 49), (36, 39)),
        ([(45.5, 36.5), (70.0, 50.0)], (45, 49), (36, 39)),
    ],
)
def test_the_range_under_points_is_of_the_samples_around_them(places, columns, rows) -> None:
    part = HEIGHTS[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1]
    assert surface().range_under(at(*places), CRS) == (part.min(), part.max())


@pytest.mark.parametrize("margin", [0.0, 0.5, 1.0])
def test_a_margin_is_a_part_of_the_extent_and_one_sample(margin: float) -> None:
    wider = (margin * 8.0 + 1, margin * 4.0 + 1) if margin else (0.0, 0.0)
    low, high = np.array([20.0, 15.0]) - wider, np.array([28.0, 19.0]) + wider
    u0, v0 = np.floor(low).astype(int)
    u1, v1 = np.ceil(high).astype(int)
    part = HEIGHTS[v0 : v1 + 1, u0 : u1 + 1]
    assert surface().range_under(at((20, 15), (28, 19)), CRS, margin) == (part.min(), part.max())


def test_voids_have_no_part_in_a_range_and_a_fill_height_has() -> None:
    heights = HEIGHTS.copy()
    heights[10:12, 10:12] = np.nan
    heights[10, 10] = 50.0
    assert surface(heights).range_within(10, 10, 2, 2) == (50.0, 50.0)
    assert surface(heights, 70.0).range_within(10, 10, 2, 2) == (50.0, 70.0)
    for fill in ("error", "nearest"):
        with pytest.raises(CoverageError, match="no valid height"):
            surface(heights, fill).range_within(11, 10, 1, 2)
    with pytest.raises(CoverageError, match="no valid height"):
        surface(heights).range_under(np.full((2, 3), np.nan), CRS)
    known = np.concatenate([at((3.0, 4.0)), [[np.nan, 6.28e6, 0.0]]])
    assert surface(heights).range_under(known, CRS) == (HEIGHTS[4, 3],) * 2


def test_a_range_is_looked_for_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dem_module, "_LOOK", 7)
    assert surface().height_range == (HEIGHTS.min(), HEIGHTS.max())
    for window in ((3, 5, 20, 15), (-5, -6, 12, 13), (44, 36, 20, 20)):
        u0, v0, nu, nv = window
        part = HEIGHTS[max(v0, 0) : v0 + nv, max(u0, 0) : u0 + nu]
        assert surface().range_within(*window) == (part.min(), part.max())


@pytest.mark.parametrize(
    ("box", "inside", "filled"),
    [
        ((10.5, 8.2, 14.9, 9.7), (8, 6, 19, 14), (8, 6, 19, 14)),
        ((-3.5, -2.5, 1.0, 2.0), (-2, -2, 6, 7), (-6, -5, 6, 7)),
        ((46.0, 37.0, 55.0, 45.0), (44, 35, 52, 42), (44, 35, 60, 50)),
        ((-20.0, 3.0, -9.0, 4.0), None, (-22, 1, -4, 9)),
        ((3.0, 60.0, 4.0, 65.0), None, (1, 58, 9, 70)),
    ],
)
def test_a_window_is_wider_than_its_box_and_ends_two_samples_beyond_the_dem(box, inside, filled) -> None:
    """Two samples before and five behind the first of the last ones, for cubics; with a fill height there is no end."""
    assert surface().window_around(*box) == inside
    assert surface(fill="mask").window_around(*box) == inside
    assert surface(fill="nearest").window_around(*box) == filled
    assert surface(fill=0.0).window_around(*box) == filled


@pytest.mark.parametrize("fill", ["error", "mask", 5.0, "nearest"])
def test_a_window_beyond_the_dem_is_what_the_fill_says(fill: Any) -> None:
    heights = HEIGHTS.copy()
    heights[20, 20] = np.nan
    made = surface(heights, fill)
    wide = np.pad(heights, 6, constant_values=np.nan)
    if fill == "nearest":
        wide = np.pad(heights, 6, mode="edge")
    for u0, v0, nu, nv in ((3, 4, 5, 6), (-6, -6, 9, 8), (47, 38, 9, 8), (-6, 10, 6, 3), (5, 40, 4, 6), (18, 18, 4, 4)):
        expected = wide[v0 + 6 : v0 + nv + 6, u0 + 6 : u0 + nu + 6].copy()
        if isinstance(fill, float):
            expected[np.isnan(expected)] = fill
        found = made.window(u0, v0, nu, nv)
        known = ~np.isnan(expected)
        np.testing.assert_array_equal(found[known], expected[known])
        assert np.isnan(found[~known]).all() or fill == "nearest"
        assert fill != "nearest" or np.isfinite(found).all()


def test_heights_between_samples_are_bilinear_up_to_the_last_sample() -> None:
    random = np.random.default_rng(5)
    places = np.column_stack([random.uniform(0, 49, 60), random.uniform(0, 39, 60)])
    places[:4] = [(0, 0), (49, 39), (49, 0.5), (0.5, 39)]
    u, v = places.T
    i, j = np.minimum(u.astype(int), 48), np.minimum(v.astype(int), 38)
    x, y = u - i, v - j
    expected = (
        HEIGHTS[j, i] * (1 - x) * (1 - y) + HEIGHTS[j, i + 1] * x * (1 - y)
        + HEIGHTS[j + 1, i] * (1 - x) * y + HEIGHTS[j + 1, i + 1] * x * y
    )  # fmt: skip
    np.testing.assert_allclose(surface().heights(at(*places.tolist())[:, :2], CRS), expected, rtol=1e-9)
    beyond = at((-1e-6, 3), (49 + 1e-6, 3), (3, -1e-6), (3, 39 + 1e-6))
    assert np.isnan(surface().heights(beyond[:, :2], CRS)).all()


def test_an_excerpt_is_the_samples_where_they_are() -> None:
    found = surface().excerpt(at((10.2, 5.7), (14.8, 9.1)), CRS)
    assert found is not None
    rows, columns = found.heights.shape
    np.testing.assert_array_equal(found.heights, HEIGHTS[2 : 2 + rows, 7 : 7 + columns])
    assert (rows, columns) == (10 + 4 - 2, 15 + 4 - 7)
    # GDAL's corner of the first sample (7, 2) is half a sample before it.
    np.testing.assert_allclose(found.geotransform, (3e5 + 65.0, 10.0, 0.0, 6.28e6 - 15.0, 0.0, -10.0))


def test_positions_may_have_heights_and_may_be_none() -> None:
    places = at((3.0, 4.0), (20.5, 7.25))
    places[:, 2] = np.nan, 900.0
    for crs in (None, CRS):
        np.testing.assert_array_equal(surface().heights(places, crs), surface().heights(places[:, :2], crs))
        assert surface().coverage(places, crs) == 1.0
        assert surface().coverage(places[:0], crs) == 1.0


def test_the_edge_continues_as_far_as_the_reach_on_all_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    """Within a circle about the nearest place of the DEM, with the height of that place."""
    monkeypatch.setattr(dem_module, "NEAREST_REACH", 6)
    random = np.random.default_rng(8)
    u, v = random.uniform(-9, 58, 400), random.uniform(-9, 48, 400)
    near_u, near_v = np.clip(u, 0, 49), np.clip(v, 0, 39)
    heights = map_coordinates(HEIGHTS, [near_v, near_u], order=1)
    expected = np.where(np.hypot(u - near_u, v - near_v) <= 6, heights, np.nan)
    assert 40 < np.isnan(expected).sum() < 200
    np.testing.assert_allclose(surface(fill="nearest").heights_at(u, v), expected, rtol=1e-9)


class Elsewhere(Memory):
    """Samples on another grid."""

    def __init__(self, crs: str, place: Affine) -> None:
        super().__init__(HEIGHTS, place[::3])  # type: ignore[arg-type]
        self.grid = SampleGrid(pyproj.CRS(crs), HEIGHTS.shape, place)

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        return self.grid.crs, self.grid


@pytest.mark.parametrize(
    ("crs", "place"),
    [
        ("EPSG:32735", (3e5, 9.0, 4.0, 6.28e6, 3.0, -8.0)), ("EPSG:32735", (3e5, -2.0, 9.0, 6.28e6, 11.0, 1.0)),
        ("EPSG:4326", (24.0, 2e-3, 0.0, -33.0, 0.0, -1e-3)),
    ],
)  # fmt: skip
def test_an_excerpt_has_the_heights_of_the_surface_and_three_samples_more(crs: str, place: Affine) -> None:
    """As GDAL reads it: heights belong to the middles of its pixels. A point that is not finite has no part."""
    made = dem_of(Elsewhere(crs, place), "ellipsoid", False, "mask", 10**8)  # type: ignore[arg-type]
    u, v = np.random.default_rng(2).uniform([[10.1], [8.1]], [[29.9], [24.9]], (2, 30))
    x, a, b, y, c, d = place
    ground = np.column_stack([x + a * u + b * v, y + c * u + d * v, np.zeros(30)])
    found = made.excerpt(np.concatenate([ground, np.full((1, 3), np.nan)]), crs)
    assert found is not None
    west, a, b, north, c, d = found.geotransform
    columns, rows = np.linalg.solve([[a, b], [c, d]], (ground[:, :2] - (west, north)).T) - 0.5
    np.testing.assert_allclose(
        map_coordinates(found.heights, [rows, columns], order=1), map_coordinates(HEIGHTS, [v, u], order=1), rtol=1e-6
    )
    for places, count in ((rows, found.heights.shape[0]), (columns, found.heights.shape[1])):
        assert places.min() >= 3
        assert places.max() <= count - 1 - 3


def test_there_is_no_excerpt_across_the_antimeridian() -> None:
    made = dem_of(Elsewhere("EPSG:4326", (178.0, 0.1, 0.0, 10.0, 0.0, -0.1)), "ellipsoid", False, "mask", 10**8)  # type: ignore[arg-type]
    assert made.excerpt(np.array([[179.5, 8.0, 0.0], [-179.5, 8.0, 0.0]]), "EPSG:4326") is None
    assert made.excerpt(np.array([[179.5, 8.0, 0.0], [179.9, 8.0, 0.0]]), "EPSG:4326") is not None


def test_a_dem_on_a_server_needs_the_network_to_be_allowed(tmp_path: Path) -> None:
    for name in ("https://example.org/dem.tif", "/vsicurl/https://example.org/dem.tif"):
        with pytest.raises(InputError, match="etwork"):
            open_dem(name, "ellipsoid")


def brute(heights: np.ndarray, u: int, v: int, reach: float) -> float:
    """Return the height of the nearest sample, from the edge on beyond it, if it is within reach."""
    rows, columns = heights.shape
    iu, iv = min(max(u, 0), columns - 1), min(max(v, 0), rows - 1)
    if math.hypot(u - iu, v - iv) > reach:
        return math.nan
    known = np.argwhere(np.isfinite(heights))
    far = np.hypot(known[:, 0] - iv, known[:, 1] - iu)
    return float(far.min()) if far.min() <= reach else math.nan


def test_voids_have_the_nearest_height_within_reach() -> None:
    heights = HEIGHTS[:20, :24].copy()
    heights[4:16, 5:19] = np.nan
    heights[9, 11] = 1.0

    def read(left: int, top: int, width: int, height: int) -> np.ndarray:
        assert left >= 0
        assert top >= 0
        assert left + width <= 24
        assert top + height <= 20
        return heights[top : top + height, left : left + width]

    for window in ((0, 0, 24, 20), (-5, -4, 12, 11), (18, 13, 12, 12), (6, 5, 3, 3), (-9, 3, 5, 4)):
        for reach in (2, 3, 6):
            found = nearest_heights(read, heights.shape, window, reach)
            u0, v0, nu, nv = window
            for v in range(nv):
                for u in range(nu):
                    far = brute(heights, u0 + u, v0 + v, reach)
                    assert np.isnan(found[v, u]) == math.isnan(far)
                    if not math.isnan(far):
                        iu, iv = min(max(u0 + u, 0), 23), min(max(v0 + v, 0), 19)
                        row, column = np.argwhere(heights == found[v, u])[0]
                        assert math.hypot(row - iv, column - iu) == pytest.approx(far)
