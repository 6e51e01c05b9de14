"""The grid of a DEM in many files: layers, columns between, windows, by hand with samples that are a formula."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import CrsError, DatumError
from ortho_pipeline.surface.dem_file import SampleGrid
from ortho_pipeline.surface.dem_mosaic import DemMosaic, laid_out

CRS = pyproj.CRS("EPSG:4326")


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(100.0 * np.sin(x * 3.0) + 10.0 * y)


class Formula:
    """Samples of a formula on a grid, in units of the file; some of them are void."""

    block, files = 64, ("a.tif",)

    def __init__(self, x: float, y: float, columns: int, rows: int, dx: float, dy: float = -0.1, **more: Any) -> None:
        self.grid = SampleGrid(more.get("crs", CRS), (rows, columns), (x, dx, 0.0, y, 0.0, dy))
        self.path, self.unit, self.full = more.get("path", "a.tif"), more.get("unit", ""), more.get("full", CRS)
        self.add, self.void, self.closed, self.reads = more.get("add", 0.0), more.get("void", ()), 0, []

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        return self.full, self.grid

    def read(self, left: int, top: int, width: int, height_: int, metres_per_unit: float) -> np.ndarray:
        rows, columns = self.grid.shape
        assert 0 <= left < left + width <= columns
        assert 0 <= top < top + height_ <= rows
        self.reads.append((left, top, width, height_))
        x, dx, _, y, _, dy = self.grid.crs_from_pixel
        found = height(*np.meshgrid(x + dx * np.arange(columns), y + dy * np.arange(rows))) + self.add
        for row, column in self.void:
            found[row, column] = np.nan
        return found[top : top + height_, left : left + width] * metres_per_unit

    def close(self) -> None:
        self.closed += 1


def mosaic(*samples: Formula) -> DemMosaic:
    return laid_out("all", [(one, *one.place(), one.unit) for one in samples])  # type: ignore[misc]


def test_files_of_one_spacing_are_one_grid_from_the_first_to_the_last_sample() -> None:
    west, east = Formula(10.0, 50.0, 5, 4, 0.1), Formula(10.4, 50.2, 4, 3, 0.1, add=1000.0)
    made = mosaic(west, east)
    assert made.grid.shape == (6, 8)
    np.testing.assert_allclose(made.grid.crs_from_pixel, (10.0, 0.1, 0, 50.2, 0, -0.1))
    found = made.read(0, 0, 8, 6, 1.0)
    x, y = np.meshgrid(10.0 + 0.1 * np.arange(8), 50.2 - 0.1 * np.arange(6))
    expected = np.full((6, 8), np.nan)
    expected[2:, :5] = height(x, y)[2:, :5]
    expected[:3, 4:] = height(x, y)[:3, 4:] + 1000.0
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(made.read(3, 1, 4, 2, 2.0), 2.0 * expected[1:3, 3:7], atol=1e-9)
    assert np.isnan(made.read(-3, -2, 3, 2, 1.0)).all()
    np.testing.assert_allclose(made.read(6, 4, 4, 4, 1.0)[:2, :2], expected[4:, 6:])
    west.reads.clear()
    made.read(5, 0, 3, 6, 1.0)
    made.read(0, 0, 5, 2, 1.0)
    assert west.reads == [], "only files that a window meets are read"


def test_a_void_of_the_later_file_has_the_height_of_the_earlier() -> None:
    made = mosaic(Formula(10.0, 50.0, 5, 4, 0.1), Formula(10.0, 50.0, 5, 4, 0.1, add=7.0, void=[(1, 2)]))
    earlier = height(10.0 + 0.1 * np.arange(5), 50.0 - 0.1 * np.arange(4)[:, None])
    expected = earlier + 7.0
    expected[1, 2] -= 7.0
    np.testing.assert_allclose(made.read(0, 0, 5, 4, 1.0), expected, atol=1e-9)


@pytest.mark.parametrize("coarse", [0.15, 0.2, 0.3])
def test_wider_cells_are_linear_between_their_own_columns(coarse: float) -> None:
    """Two rows of fine cells, and two of wider ones below: every column of either is one of the whole."""
    fine = Formula(10.0, 50.0, 7, 2, 0.1)
    wide = Formula(10.0, 49.8, round(0.6 / coarse) + 1, 2, coarse, void=[(1, 1)])
    made = mosaic(wide, fine)
    dx = 0.05 if coarse == 0.15 else 0.1
    assert made.grid.crs_from_pixel[1] == pytest.approx(dx)
    assert made.grid.shape == (4, round(0.6 / dx) + 1)
    found = made.read(0, 0, made.grid.shape[1], 4, 1.0)
    x = 10.0 + dx * np.arange(made.grid.shape[1])
    for row, step, columns in ((0, 0.1, 7), (1, 0.1, 7), (2, coarse, wide.grid.shape[1])):
        nodes = 10.0 + step * np.arange(columns)
        expected = np.interp(x, nodes, height(nodes, np.array(50.0 - 0.1 * row)))
        np.testing.assert_allclose(found[row], expected, atol=1e-9)
    # A void counts where it has weight, and on neither side of the neighbouring columns.
    void = np.abs(x - (10.0 + coarse)) < coarse - 1e-9
    np.testing.assert_array_equal(np.isnan(found[3]), void)
    np.testing.assert_allclose(made.read(2, 1, 3, 2, 1.0), found[1:3, 2:5], atol=1e-9)


def test_the_finest_cell_counts_where_it_has_heights() -> None:
    made = mosaic(Formula(10.0, 50.0, 7, 3, 0.1, void=[(1, 3)]), Formula(10.0, 50.0, 4, 3, 0.2, add=500.0))
    found = made.read(0, 0, 7, 3, 1.0)
    fine = height(10.0 + 0.1 * np.arange(7), 50.0 - 0.1 * np.arange(3)[:, None])
    between = (height(np.array(10.2), np.array(49.9)) + height(np.array(10.4), np.array(49.9))) / 2 + 500.0
    fine[1, 3] = between
    np.testing.assert_allclose(found, fine, atol=1e-9)


def test_cells_around_the_earth_are_closed() -> None:
    """36 cells of 10 degrees from 175 on: the column after the last is the first."""
    made = mosaic(Formula(175.0, 50.0, 18, 2, 10.0), Formula(355.0, 50.0, 18, 2, 10.0, add=1.0))
    assert made.grid.shape == (2, 36)
    assert [layer.closed for layer in made.layers] == [True]
    whole = made.read(0, 0, 36, 2, 1.0)
    np.testing.assert_allclose(made.read(34, 0, 4, 2, 1.0), whole[:, [34, 35, 0, 1]])
    np.testing.assert_allclose(made.read(-2, 0, 4, 2, 1.0), whole[:, [34, 35, 0, 1]])
    open_ = mosaic(Formula(175.0, 50.0, 17, 2, 10.0), Formula(345.0, 50.0, 17, 2, 10.0))
    assert (open_.grid.shape, open_.layers[0].closed) == ((2, 34), False)
    assert np.isnan(open_.read(-1, 0, 1, 2, 1.0)).all()


@pytest.mark.parametrize(("off", "refused"), [(0.0009, False), (0.0011, True)])
def test_a_file_may_be_a_hundredth_of_a_sample_off(off: float, refused: bool) -> None:
    for shift in ((off, 0.0), (0.0, off), (-off, 0.0)):
        parts = Formula(10.0, 50.0, 5, 4, 0.1), Formula(10.5 + shift[0], 50.0 + shift[1], 5, 4, 0.1, path="b.tif")
        if refused:
            with pytest.raises(CrsError, match="not on the grid"):
                mosaic(*parts)
        else:
            assert mosaic(*parts).grid.shape == (4, 10)


@pytest.mark.parametrize(
    ("other", "error", "message"),
    [
        (Formula(10.5, 50.0, 5, 4, 0.1, crs=pyproj.CRS("EPSG:4258")), CrsError, "but a.tif is in"),
        (Formula(10.5, 50.0, 5, 4, 0.1, dy=-0.2), CrsError, "direction or spacing"),
        (Formula(10.5, 50.0, 5, 4, 0.1, dy=0.1), CrsError, "direction or spacing"),
        (Formula(10.5, 50.0, 5, 4, -0.1), CrsError, "direction or spacing"),
        (Formula(10.5, 50.0, 5, 4, 0.1, unit="ft"), DatumError, "not one DEM"),
        (Formula(10.5, 50.0, 5, 4, 0.1, full=pyproj.CRS("EPSG:4326+5773")), DatumError, "not one DEM"),
        (Formula(10.0, 49.6, 5, 4, 0.1 * math.sqrt(2)), CrsError, "do not match"),
    ],
)  # fmt: skip
def test_what_is_not_one_dem_is_refused(other: Formula, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        mosaic(Formula(10.0, 50.0, 5, 4, 0.1), other)


def test_files_that_are_sheared_are_no_mosaic() -> None:
    for place in (2, 4):
        other = Formula(10.5, 50.0, 5, 4, 0.1)
        numbers = list(other.grid.crs_from_pixel)
        numbers[place] = 0.01
        other.grid = SampleGrid(CRS, (4, 5), tuple(numbers))  # type: ignore[arg-type]
        for pair in ((Formula(10.0, 50.0, 5, 4, 0.1), other), (other, Formula(10.0, 50.0, 5, 4, 0.1))):
            with pytest.raises(CrsError, match="direction or spacing"):
                mosaic(*pair)


def test_columns_to_the_west_and_rows_to_the_north_are_one_grid_as_well() -> None:
    made = mosaic(Formula(10.0, 50.0, 5, 4, -0.1, 0.1), Formula(9.5, 50.0, 5, 4, -0.1, 0.1))
    np.testing.assert_allclose(made.grid.crs_from_pixel, (10.0, -0.1, 0, 50.0, 0, 0.1))
    x, y = np.meshgrid(10.0 - 0.1 * np.arange(10), 50.0 + 0.1 * np.arange(4))
    np.testing.assert_allclose(made.read(0, 0, 10, 4, 1.0), height(x, y), atol=1e-9)
