"""The grid of a DEM in many files: layers, columns between, windows, by hand with samples that are a formula."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import CrsError, DatumError
from ortho_pipeline.surface.dem_file import SampleGrid
from ortho_pipeline.surface.dem_mosaic import DemMosaic, laid_out, matching_files

CRS = pyproj.CRS("EPSG:4326")


def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.asarray(100.0 * np.sin(x * 3.0) + 10.0 * y)


class Formula:
    """Samples of a formula on a grid, in units of the file; some of them are void."""

    files = ("a.tif",)

    def __init__(self, x: float, y: float, columns: int, rows: int, dx: float, dy: float = -0.1, **more: Any) -> None:
        self.grid = SampleGrid(more.get("crs", CRS), (rows, columns), (x, dx, 0.0, y, 0.0, dy))
        self.path, self.unit, self.full = more.get("path", "a.tif"), more.get("unit", ""), more.get("full", CRS)
        self.add, self.void, self.closed = more.get("add", 0.0), more.get("void", ()), 0
        self.reads: list[tuple[int, int, int, int]] = []
        self.block = more.get("block", 64)

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
    return laid_out("all", [(one, *one.place(), one.unit) for one in samples])


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
    for shift in ((off, 0.0), (0.0, off), (-off, 0.0), (0.0, -off)):
        parts = Formula(10.0, 50.0, 5, 4, 0.1), Formula(10.5 + shift[0], 49.9 + shift[1], 5, 3, 0.1, path="b.tif")
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
        (Formula(10.5, 50.0, 5, 4, 0.1, dy=-0.05), CrsError, "direction or spacing"),
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


@pytest.mark.parametrize(("unit", "other", "same"), [
    ("m", "metre", True), ("ft", "foot", True), ("ft", "US survey foot", False), ("m", "", False), ("", "km", False),
    ("km", "dm", False),
])  # fmt: skip
def test_a_unit_has_several_names(unit: str, other: str, same: bool) -> None:
    parts = Formula(10.0, 50.0, 5, 4, 0.1, unit=unit), Formula(10.5, 50.0, 5, 4, 0.1, unit=other)
    if same:
        assert mosaic(*parts).unit == unit
    else:
        with pytest.raises(DatumError, match="not one DEM"):
            mosaic(*parts)


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


@pytest.mark.parametrize("coarse", [0.15, 0.2, 0.3])
def test_wider_cells_may_begin_anywhere_to_the_east(coarse: float) -> None:
    """Their first column is the ninth fine one; below them is a row that only the fine cell has."""
    fine, wide = Formula(10.0, 50.0, 9, 3, 0.1, add=300.0), Formula(10.9, 50.0, 5, 2, coarse)
    made = mosaic(fine, wide)
    dx = 0.05 if coarse == 0.15 else 0.1
    x = 10.0 + dx * np.arange(made.grid.shape[1])
    assert x[-1] == pytest.approx(10.9 + 4 * coarse)
    nodes = 10.9 + coarse * np.arange(5)
    own = 10.0 + 0.1 * np.arange(9)
    found = made.read(0, 0, len(x), 3, 1.0)
    for row in range(3):
        y = np.array(50.0 - 0.1 * row)
        expected = np.interp(x, own, height(own, y) + 300.0, right=np.nan)
        if row < 2:
            there = x > 10.9 - 1e-9
            expected[there] = np.interp(x[there], nodes, height(nodes, y))
        np.testing.assert_allclose(found[row], expected, atol=1e-9)
    np.testing.assert_allclose(made.read(len(x) - 6, 1, 5, 2, 1.0), found[1:, -6:-1], atol=1e-9)


@pytest.mark.parametrize("relative", [9e-7, -9e-7])
def test_spacings_that_differ_by_rounding_are_one_layer_whose_last_file_counts(relative: float) -> None:
    made = mosaic(Formula(10.0, 50.0, 5, 4, 0.1), Formula(10.0, 50.0, 5, 4, 0.1 * (1 + relative), add=7.0))
    assert len(made.layers) == 1
    expected = height(10.0 + 0.1 * np.arange(5), 50.0 - 0.1 * np.arange(4)[:, None]) + 7.0
    np.testing.assert_allclose(made.read(0, 0, 5, 4, 1.0), expected, atol=1e-3)


@pytest.mark.parametrize("relative", [1.5e-6, -1.5e-6])
def test_spacings_that_differ_by_more_than_a_millionth_are_no_grid(relative: float) -> None:
    first, step = Formula(10.0, 50.0, 5, 4, 0.1), 0.1 * (1 + relative)
    with pytest.raises(CrsError, match="do not match"):
        mosaic(first, Formula(10.5, 50.0, 5, 4, step))
    with pytest.raises(CrsError, match="direction or spacing"):
        mosaic(first, Formula(10.5, 50.0, 5, 4, 0.1, dy=-step))
    near = 0.1 * (1 + relative / 2)
    assert mosaic(first, Formula(10.5, 50.0, 5, 4, 0.1, dy=-near)).grid.shape == (4, 10)


def test_a_projected_dem_is_never_closed() -> None:
    """60 columns of 10 m are more metres than the circle has degrees."""
    utm = pyproj.CRS("EPSG:32635")
    west = Formula(500_000.0, 4_000_000.0, 30, 2, 10.0, -10.0, crs=utm)
    east = Formula(500_300.0, 4_000_000.0, 30, 2, 10.0, -10.0, crs=pyproj.CRS("EPSG:32635"), full=pyproj.CRS(4326))
    made = mosaic(west, east)
    assert (made.grid.shape, made.layers[0].closed) == ((2, 60), False)
    assert np.isnan(made.read(-1, 0, 1, 2, 1.0)).all()
    assert np.isnan(made.read(60, 0, 1, 2, 1.0)).all()


def test_wide_cells_close_the_circle_before_their_next_column() -> None:
    """Nine columns of 40 degrees from 160 West; between the last one and the first, rows are linear."""
    made = mosaic(Formula(-160.0, 50.0, 9, 1, 40.0), Formula(-160.0, 49.9, 5, 1, 10.0))
    assert made.grid.shape == (2, 36)
    assert [layer.closed for layer in made.layers] == [True, True]
    last, first = height(np.array([160.0, -160.0]), np.array(50.0))
    expected = np.interp([160, 170, 180, 190, 200], [160, 200], [last, first])
    np.testing.assert_allclose(made.read(32, 0, 5, 1, 1.0)[0], expected, atol=1e-9)
    np.testing.assert_allclose(made.read(-4, 0, 5, 1, 1.0)[0], expected, atol=1e-9)


def test_columns_to_the_west_close_the_circle_too() -> None:
    made = mosaic(Formula(175.0, 50.0, 18, 2, -10.0), Formula(-5.0, 50.0, 17, 2, -10.0, add=1.0))
    assert (made.grid.shape, made.layers[0].closed) == ((2, 36), True)
    whole = made.read(0, 0, 36, 2, 1.0)
    np.testing.assert_allclose(whole[0, :18], height(175.0 - 10.0 * np.arange(18), np.array(50.0)), atol=1e-9)
    np.testing.assert_array_equal(made.read(33, 0, 5, 2, 1.0), whole[:, [33, 34, 35, 0, 1]])
    np.testing.assert_array_equal(made.read(-2, 0, 4, 2, 1.0), whole[:, [34, 35, 0, 1]])


def test_only_the_files_read_last_stay_open(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ortho_pipeline.surface.dem_mosaic._OPEN_FILES", 2)
    files = [Formula(10.0 + k, 50.0, 4, 4, 0.25) for k in range(4)]
    made = mosaic(*files)
    for place in (0, 1, 0, 2):
        made.read(4 * place, 0, 4, 4, 1.0)
    assert [file.closed for file in files] == [0, 1, 0, 0]
    made.close()
    made.close()
    assert [file.closed for file in files] == [1, 1, 1, 0]


def test_a_block_is_the_largest_of_all_spacings() -> None:
    for blocks in ((64, 4096), (4096, 64)):
        wide, fine = Formula(10.0, 50.0, 5, 4, 0.2, block=blocks[0]), Formula(10.0, 49.6, 9, 4, 0.1, block=blocks[1])
        assert mosaic(wide, fine).block == 4096


def test_the_same_datum_may_be_declared_by_a_code_or_by_its_name() -> None:
    coded = pyproj.CRS("EPSG:4326+5773")
    named = pyproj.CRS.from_wkt(
        f'COMPD_CS["any",{pyproj.CRS(4326).to_wkt("WKT1_GDAL")},'
        'VERT_CS["EGM96 of a vendor",VERT_DATUM["unknown",2005],UNIT["metre",1],AXIS["Up",UP]]]'
    )
    parts = [Formula(10.0 + 0.5 * k, 50.0, 5, 4, 0.1, full=full) for k, full in enumerate((coded, named))]
    assert mosaic(*parts).grid.shape == (4, 10)


def test_a_pattern_names_its_files_in_the_order_of_the_alphabet(tmp_path: Path) -> None:
    names = [f"{letter}{number}.tif" for number in range(5) for letter in "xbqa"]
    for name in (*names, "other.txt"):
        (tmp_path / name).touch()
    (tmp_path / "folder.tif").mkdir()
    assert matching_files(tmp_path / "*.tif") == [str(tmp_path / name) for name in sorted(names)]
    assert matching_files(tmp_path / "x[3-9].tif") == [str(tmp_path / name) for name in ("x3.tif", "x4.tif")]
    assert matching_files(tmp_path / "?4.tif") is not None
    assert matching_files(tmp_path / "q0*.tif") == [str(tmp_path / "q0.tif")], "one file is enough"
    (tmp_path / "[a]0.tif").touch()
    assert matching_files(tmp_path / "[a]0.tif") is None, "a file of this very name"
    for other in (tmp_path / "a0.tif", "/vsicurl/https://example.org/*.tif", "https://example.org/*.tif"):
        assert matching_files(other) is None
