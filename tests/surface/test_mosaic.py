"""A DEM in many files is the DEM that GDAL's mosaic of them is, and what does not belong together is refused."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from orthos import rectify as warp
from osgeo import gdal, osr

from ortho_pipeline.commands import rectify
from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.options import SurfaceOptions
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.dem import open_dem

gdal.UseExceptions()
#: Samples from one degree to the next in this test's cells.
ROWS = 20


def terrain(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """Heights that are linear in longitude between any samples, so that interpolation has one right answer."""
    return 500 + 3 * lon + 40 * np.sin(5 * np.deg2rad(lat))


def write_cell(
    folder: Path, lon: int, lat: int, columns: int = ROWS, crs: str = "EPSG:4326", unit: str = "",
    heights: np.ndarray | None = None, shift: float = 0.0,
) -> Path:  # fmt: skip
    """Write a cell as Copernicus does: the first sample on the north-west corner, without the east and south border."""
    longitudes, latitudes = lon + np.arange(columns) / columns, lat + 1 - np.arange(ROWS) / ROWS
    if heights is None:
        heights = terrain(*np.meshgrid(longitudes, latitudes))
    path = folder / f"cell_{'N' if lat >= 0 else 'S'}{abs(lat):02}_{'E' if lon >= 0 else 'W'}{abs(lon):03}.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), columns, ROWS, 1, gdal.GDT_Float32)
    reference = osr.SpatialReference()
    reference.SetFromUserInput(crs)
    reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    dataset.SetSpatialRef(reference)
    west, north = lon - 0.5 / columns + shift, lat + 1 + 0.5 / ROWS
    dataset.SetGeoTransform((west, 1 / columns, 0, north, 0, -1 / ROWS))
    band = dataset.GetRasterBand(1)
    band.SetNoDataValue(-9999.0)
    if unit:
        band.SetUnitType(unit)
    band.WriteArray(heights.astype(np.float32))
    dataset = band = None
    return path


def test_many_files_are_the_dem_that_gdals_mosaic_of_them_is(tmp_path: Path) -> None:
    holes = np.random.default_rng(1).uniform(0, 900, (ROWS, ROWS))
    holes[3:6, 7:12] = -9999.0
    paths = [write_cell(tmp_path, 30, 41), write_cell(tmp_path, 31, 41, heights=holes), write_cell(tmp_path, 31, 40)]
    gdal.BuildVRT(str(tmp_path / "all.vrt"), [str(path) for path in sorted(paths)]).FlushCache()
    one, many = (open_dem(tmp_path / name, "ellipsoid", fill="mask") for name in ("all.vrt", "*.tif"))
    # GDAL computes the spacing of a mosaic from the first file's, which costs the last bit.
    np.testing.assert_allclose(many.grid.crs_from_pixel, one.grid.crs_from_pixel, rtol=1e-15)
    assert many.provenance["path"] == str(tmp_path / "*.tif")
    windows = [(0, 0, *one.shape[::-1]), (-3, 15, 30, 12), (17, 1, 9, 38)]
    for window in windows:
        np.testing.assert_array_equal(many.window(*window), one.window(*window))
    places = np.random.default_rng(2).uniform((29.9, 39.9), (32.1, 42.1), (500, 2))
    np.testing.assert_allclose(many.heights(places), one.heights(places), rtol=1e-9)
    again = pickle.loads(pickle.dumps(many))
    np.testing.assert_array_equal(again.heights(places), many.heights(places))
    assert set(many.file.files) == set(map(str, paths))


def test_where_files_overlap_the_later_one_counts_if_it_has_a_height(tmp_path: Path) -> None:
    """As in GDAL's mosaic of the same files."""
    random = np.random.default_rng(3)
    first, second = random.uniform(0, 900, (2, ROWS, ROWS))
    first[2:9, 12:18], second[5:14, 0:4] = -9999.0, -9999.0
    paths = [write_cell(tmp_path, 30, 41, heights=first), write_cell(tmp_path, 31, 41, heights=second, shift=-0.4)]
    gdal.BuildVRT(str(tmp_path / "all.vrt"), [str(path) for path in paths]).FlushCache()
    one, many = (open_dem(tmp_path / name, "ellipsoid", fill="mask") for name in ("all.vrt", "*.tif"))
    assert many.shape == (ROWS, 2 * ROWS - 8)
    whole = many.window(0, 0, *many.shape[::-1])
    np.testing.assert_array_equal(whole, one.window(0, 0, *one.shape[::-1]))
    assert np.isnan(whole).any()


@pytest.mark.parametrize("change", [(0, 1, 0, 0, 0, 0.5), (0, 1, 0, 0, 0, -1), (0, -1, 0, 0, 0, 1)])
def test_rows_of_another_direction_or_spacing_are_refused(tmp_path: Path, change: tuple[float, ...]) -> None:
    write_cell(tmp_path, 30, 41)
    odd = write_cell(tmp_path, 31, 41)
    dataset = gdal.Open(str(odd), gdal.GA_Update)
    west, dx, _, north, _, dy = dataset.GetGeoTransform()
    dataset.SetGeoTransform((west, dx * change[1], 0, north, 0, dy * change[5]))
    dataset = None
    with pytest.raises(CrsError, match="the rows of this file differ in direction or spacing") as caught:
        open_dem(tmp_path / "*.tif", "ellipsoid")
    assert caught.value.file == str(odd)


def own_bilinear(cells: dict[tuple[int, int], np.ndarray], places: np.ndarray) -> np.ndarray:
    """Return heights at (lon, lat), bilinear between the samples of a cell, which go on with those of its neighbours.

    Between the last row of a cell and the first of the one below, each row is linear between its own samples.
    """

    def on_row(lon: float, row: int) -> float:
        lat, at = -(row // ROWS) - 1, row % ROWS
        columns = cells[30, lat].shape[1]
        samples = np.concatenate([cells[30, lat][at], cells[31, lat][at]])
        place = (lon - 30) * columns
        return float(np.interp(place, np.arange(2 * columns), samples, right=np.nan))

    found = []
    for lon, lat in places:
        down = -lat * ROWS  # row 0 is on the parallel of 0 degrees, counted from north to south
        row = int(np.floor(down))
        found.append(on_row(lon, row) * (1 - down + row) + on_row(lon, row + 1) * (down - row))
    return np.array(found)


@pytest.mark.parametrize("columns", [(30, 20), (30, 15), (30, 20, 15), (36, 24, 18), (12, 7, 4)])
def test_cells_of_several_widths_are_each_sampled_in_their_own_grid(tmp_path: Path, columns: tuple[int, ...]) -> None:
    """Rough ground, at any place and over the border of two widths; the same for every window."""
    noise, cells = np.random.default_rng(0), {}
    for lat, count in enumerate(columns):
        for lon in (30, 31):
            cells[lon, -1 - lat] = noise.uniform(0, 900, (ROWS, count)).astype(np.float32)
            write_cell(tmp_path, lon, -1 - lat, count, heights=cells[lon, -1 - lat])
    dem = open_dem(tmp_path / "*.tif", "ellipsoid", fill="mask")
    last = -len(columns) + 1.01 / ROWS
    places = noise.uniform((30.0, last), (31.7, 0.0), (400, 2))
    border = np.column_stack([places[:100, 0], noise.uniform(-1.0, -1.0 + 1 / ROWS, 100)])
    places = np.concatenate([places, border, border * (1, 0) - (0, 1), border * (1, 0) - (0, 1 - 1 / ROWS)])
    wanted = own_bilinear(cells, places)
    assert np.isfinite(wanted).all()
    np.testing.assert_allclose(dem.heights(places), wanted, atol=1e-6)
    # The samples of every cell are samples of the whole.
    for (lon, lat), heights in cells.items():
        own = np.column_stack([part.ravel() for part in np.meshgrid(
            lon + np.arange(heights.shape[1]) / heights.shape[1], lat + 1 - np.arange(ROWS) / ROWS)])  # fmt: skip
        np.testing.assert_allclose(dem.heights(own), heights.ravel(), atol=1e-6)
    whole = dem.window(0, 0, *dem.shape[::-1])
    for left, top, width, height in ((13, 15, 20, 10), (29, 18, 2, 4), (0, 5, 7, 31)):
        part = whole[top : top + height, left : left + width]
        np.testing.assert_array_equal(dem.window(left, top, width, height), part)


def test_columns_without_a_common_multiple_are_refused(tmp_path: Path) -> None:
    odd = write_cell(tmp_path, 30, 41, 31)
    write_cell(tmp_path, 30, 42, 30)
    with pytest.raises(CrsError, match=r"the columns of this file do not match.*N42") as caught:
        open_dem(tmp_path / "*.tif", "ellipsoid")
    assert caught.value.file == str(odd)
    assert caught.value.remedy


def test_cells_on_both_sides_of_the_antimeridian_are_neighbours(tmp_path: Path) -> None:
    east = write_cell(tmp_path, 179, 10, heights=np.full((ROWS, ROWS), 100.0))
    west = write_cell(tmp_path, -180, 10, heights=np.full((ROWS, ROWS), 200.0))
    assert east.name > west.name[:5]
    dem = open_dem(tmp_path / "*.tif", "ellipsoid", fill="mask").around(180.0)
    places = np.array([[179.5, 10.5], [180.5, 10.5], [-179.5, 10.5], [179.975, 10.5]])
    np.testing.assert_allclose(dem.heights(places), [100.0, 200.0, 200.0, 150.0])


@pytest.mark.parametrize(
    ("other", "error", "said"),
    [
        ({"crs": "EPSG:4326+5773"}, DatumError, "EGM96"),
        ({"unit": "ft"}, DatumError, "'ft'|\\(ft\\)"),
        ({"crs": "EPSG:4258"}, CrsError, "ETRS89"),
        ({"shift": 0.02}, CrsError, "not on the grid of the other"),
    ],
)
def test_what_is_not_one_dem_is_refused_by_the_name_of_the_file(
    tmp_path: Path, other: dict[str, object], error: type[Exception], said: str
) -> None:
    write_cell(tmp_path, 30, 41)
    odd = write_cell(tmp_path, 31, 41, **other)
    with pytest.raises(error, match=said) as caught:
        open_dem(tmp_path / "*.tif", "ellipsoid")
    assert caught.value.file == str(odd)
    assert caught.value.remedy


def test_a_pattern_without_files_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="0 files"):
        open_dem(tmp_path / "*.tif", "ellipsoid")


def test_few_files_are_open_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for lon in range(10):
        write_cell(tmp_path, lon, 0)
    monkeypatch.setattr("ortho_pipeline.surface.dem_mosaic._OPEN_FILES", 3)
    dem = open_dem(tmp_path / "*.tif", "ellipsoid", fill="mask")
    whole = dem.window(0, 0, *dem.shape[::-1])
    assert not np.isnan(whole).any()
    opened = sum(hasattr(part.samples._local, "dataset") for part in dem.file.layers[0].parts)
    assert opened <= 3


def test_an_ortho_on_many_files_is_that_on_one_and_names_them_all(tiny: Any, tmp_path: Path) -> None:
    folder = tmp_path / "cells"
    folder.mkdir()
    dem = gdal.Open(str(tiny.dem))
    half = dem.RasterXSize // 2
    for name, first, count in (("west", 0, half), ("east", half, dem.RasterXSize - half)):
        gdal.Translate(str(folder / f"{name}.tif"), dem, srcWin=[first, 0, count, dem.RasterYSize])
    orthos = []
    for name, given in (("one", tiny.dem), ("many", folder / "*.tif")):
        surface = SurfaceOptions(dem=str(given), vertical="ellipsoid")
        made = rectify(tiny.image, tmp_path / name, surface=surface)
        orthos.append(gdal.Open(str(made.files["ortho"])).ReadAsArray())
        inputs = made.document["report"]["provenance"]["inputs"]
    np.testing.assert_array_equal(*orthos)
    assert {Path(one["path"]).name for one in inputs if one["role"] == "DEM"} == {"west.tif", "east.tif"}


def write_band(path: Path, heights: np.ndarray, north: float, step: float) -> None:
    """Write samples from 19.985 degrees east, the first row at latitude `north`, rows of a second of arc."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *heights.shape[::-1], 1, gdal.GDT_Float64)
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(4326)
    reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    dataset.SetSpatialRef(reference)
    dataset.SetGeoTransform((19.985 - step / 2, step, 0, north + 0.5 / 3600, 0, -1 / 3600))
    dataset.WriteArray(heights)
    dataset = None


def test_an_ortho_over_the_border_of_two_widths(tiny: Any, tmp_path: Path) -> None:
    """On rough ground, as on a DEM whose columns hold the samples of both; the same bytes for any tiles and threads."""
    folder, noise = tmp_path / "cells", np.random.default_rng(0)
    folder.mkdir()
    narrow, wide = noise.uniform(400, 600, (36, 109)), noise.uniform(400, 600, (36, 73))
    write_band(folder / "north.tif", narrow, -29.99, 1 / 3600)
    write_band(folder / "south.tif", wide, -30.0, 1 / 2400)
    every = np.arange(217)
    both = [
        np.interp(every, np.arange(len(row)) * step, row) for part, step in ((narrow, 2), (wide, 3)) for row in part
    ]
    write_band(tmp_path / "whole.tif", np.array(both), -29.99, 1 / 7200)
    grid = Grid.of_extent(pyproj.CRS(4326), (19.991, -30.005, 20.009, -29.995), (5e-5, 5e-5))
    orthos = []
    for k, (dem, resources) in enumerate([
        (tmp_path / "whole.tif", Resources()), (folder / "*.tif", Resources()),
        (folder / "*.tif", Resources(threads=1, memory=30_000_000)), (folder / "*.tif", Resources(threads=3)),
    ]):  # fmt: skip
        made = tmp_path / f"{k}.tif"
        on = open_dem(dem, "ellipsoid")
        warp(tiny.model, RasterSource(tiny.image), on, grid, made, driver="GTiff", resources=resources)
        orthos.append(gdal.Open(str(made)).ReadAsArray())
    assert (orthos[0] > 0).mean() > 0.9
    for ortho in orthos[2:]:
        np.testing.assert_array_equal(ortho, orthos[1])
    # Heights on the columns differ by rounding.
    assert np.abs(orthos[1].astype(float) - orthos[0]).max() <= 1
    assert (orthos[1] == orthos[0]).mean() > 0.999
