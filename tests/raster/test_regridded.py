"""An ortho on another grid: the same pixels where they are the same, else values that PROJ says."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.raster.regridded import Regridded, coarser, grid_of, part_of, warped_bounds
from ortho_pipeline.raster.source import Grid


def middles(grid: Grid) -> np.ndarray:
    """Return x and y of the middles of the pixels of a grid ``(2, h, w)``."""
    rows, columns = np.indices((grid.height, grid.width)) + 0.5
    return np.stack(grid.xy(columns, rows))


GRID = Grid(parse_crs("EPSG:32633"), 500_000.0, 4_000_000.0, 10.0, 20.0, 60, 40)
#: A place within it, in coordinates of zone 32.
AT = np.round(pyproj.Transformer.from_crs("EPSG:32633", "EPSG:32632").transform(500_150, 3_999_800)).tolist()


@pytest.fixture(scope="module")
def ortho(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two bands: easting and northing of the middle of each pixel; one pixel of the first has no value."""
    path = tmp_path_factory.mktemp("ortho") / "a.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 60, 40, 2, gdal.GDT_Float64)
    dataset.SetProjection(GRID.crs.to_wkt())
    dataset.SetGeoTransform((500_000.0, 10.0, 0.0, 4_000_000.0, 0.0, -20.0))
    dataset.WriteArray(middles(GRID))
    dataset.GetRasterBand(1).SetNoDataValue(-1.0)
    dataset.GetRasterBand(1).WriteArray(np.array([[-1.0]]), 7, 5)
    return path


def test_the_grid_is_that_of_the_file(ortho: Path) -> None:
    found = grid_of(ortho)
    assert (found.extent, found.dx, found.dy) == ((500_000.0, 3_999_200.0, 500_600.0, 4_000_000.0), 10.0, 20.0)


@pytest.mark.parametrize("turned", [(0.0, 10.0, 0.1, 0.0, 0.0, -20.0), (0.0, 10.0, 0.0, 0.0, 0.1, -20.0), None])
def test_a_raster_that_is_turned_or_has_no_crs_is_no_ortho(tmp_path: Path, turned: tuple[float, ...] | None) -> None:
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 6, 4, 1)
    if turned:
        dataset.SetProjection(GRID.crs.to_wkt())
    dataset.SetGeoTransform(turned or (0.0, 10.0, 0.0, 0.0, 0.0, -20.0))
    del dataset
    with pytest.raises(InputError):
        grid_of(tmp_path / "a.tif")


def test_pixels_of_the_same_grid_are_copied(ortho: Path) -> None:
    """The ortho begins at column 3, row -2 of the grid; outside of it nothing is valid."""
    grid = Grid(GRID.crs, 499_970.0, 3_999_960.0, 10.0, 20.0, 50, 50)
    pixels, valid = Regridded(ortho, grid).read(1, 1, 20, 45)
    x, y = middles(grid)[:, 1:46, 1:21]
    inside = (x > 500_000) & (y > 3_999_200)
    np.testing.assert_array_equal(valid[1], inside)
    np.testing.assert_array_equal(pixels[:, valid[0]], np.stack([x, y])[:, valid[0]])
    # Its pixel (7, 5) is at (10, 3) of the grid.
    wanted = inside.copy()
    wanted[3 - 1, 10 - 1] = False
    np.testing.assert_array_equal(valid[0], wanted)


@pytest.mark.parametrize(
    "grid",
    [
        # Three tenths of a pixel to either side along one axis, and other pixels along one axis.
        Grid(GRID.crs, 500_103.0, 3_999_900.0, 10.0, 20.0, 20, 20),
        Grid(GRID.crs, 500_107.0, 3_999_900.0, 10.0, 20.0, 20, 20),
        Grid(GRID.crs, 500_100.0, 3_999_906.0, 10.0, 20.0, 20, 20),
        Grid(GRID.crs, 500_100.0, 3_999_914.0, 10.0, 20.0, 20, 20),
        Grid(GRID.crs, 500_100.0, 3_999_900.0, 10.0, 10.0, 20, 20),
        Grid(parse_crs("EPSG:32632"), *AT,
             7.0, 11.0, 30, 30),
    ],
)  # fmt: skip
def test_pixels_of_another_grid_have_the_coordinates_of_their_middle(ortho: Path, grid: Grid) -> None:
    """Bilinear interpolation of coordinates is exact."""
    pixels, valid = Regridded(ortho, grid).read(0, 0, grid.width, grid.height)
    assert valid.all()
    there = pyproj.Transformer.from_crs(grid.crs, GRID.crs, always_xy=True).transform(*middles(grid))
    np.testing.assert_allclose(pixels, np.stack(there), rtol=0, atol=0.02)


@pytest.mark.parametrize("resampling", ["near", "bilinear", "average"])
@pytest.mark.parametrize("nodata", [0.0, -9999.0, math.nan, None])
def test_a_band_without_a_value_has_none_on_another_grid(tmp_path: Path, nodata: float | None, resampling: str) -> None:
    """The first band lacks a square that the second has; without nodata, NaN is no value either."""
    pixels = np.stack([np.full((40, 60), 100.0), np.full((40, 60), 200.0)])
    pixels[0, 10:20, 10:30] = math.nan if nodata is None else nodata
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 60, 40, 2, gdal.GDT_Float32)
    made.SetProjection(GRID.crs.to_wkt())
    made.SetGeoTransform(GRID.geotransform)
    if nodata is not None:
        made.GetRasterBand(1).SetNoDataValue(nodata)
    made.WriteArray(pixels.astype(np.float32))
    del made
    off = Grid(GRID.crs, 500_003.0, 3_999_992.0, 10.0, 20.0, 50, 35)
    values, valid = Regridded(tmp_path / "a.tif", off, resampling=resampling).read(0, 0, 50, 35)
    assert valid[1].all()
    assert not valid[0, 10:19, 10:29].any()
    assert valid[0].sum() >= 50 * 35 - 11 * 21
    assert set(values[0][valid[0]]) == {100.0}
    assert set(values[1][valid[1]]) == {200.0}


def test_alpha_of_another_grid_stays_the_last_band(tmp_path: Path) -> None:
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 60, 40, 4, gdal.GDT_Byte, ["ALPHA=YES"])
    made.SetProjection(GRID.crs.to_wkt())
    made.SetGeoTransform(GRID.geotransform)
    pixels = np.repeat(np.array([10, 20, 30, 255], dtype=np.uint8), 2400).reshape(4, 40, 60)
    pixels[3, :, 30:] = 0
    made.WriteArray(pixels)
    del made
    off = Grid(GRID.crs, 500_003.0, 3_999_992.0, 10.0, 20.0, 50, 35)
    values, valid = Regridded(tmp_path / "a.tif", off).read(0, 0, 50, 35)
    np.testing.assert_array_equal(values[:, 5, 5], [10, 20, 30, 255])
    np.testing.assert_array_equal(valid, np.broadcast_to(np.arange(50) < 30, valid.shape))


def test_coarser_pixels_are_means_of_what_they_cover(ortho: Path) -> None:
    grid = Grid(GRID.crs, 500_200.0, 3_999_800.0, 40.0, 80.0, 5, 5)
    pixels, valid = Regridded(ortho, grid, resampling="average").read(0, 0, 5, 5)
    assert valid.all()
    np.testing.assert_allclose(pixels[0, 0], 500_220.0 + 40.0 * np.arange(5))
    np.testing.assert_allclose(pixels[1, :, 0], 3_999_760.0 - 80.0 * np.arange(5))


def test_the_kernel_is_as_wide_as_the_coarser_pixels(tmp_path: Path) -> None:
    """A line of one column, in pixels four times as wide: a triangle that ends four columns from its middle."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 60, 40, 1, gdal.GDT_Float64)
    dataset.SetProjection(GRID.crs.to_wkt())
    dataset.SetGeoTransform((500_000.0, 10.0, 0.0, 4_000_000.0, 0.0, -20.0))
    dataset.WriteArray(np.tile(np.arange(60) == 30, (40, 1)) * 1.0)
    del dataset
    pixels, _ = Regridded(tmp_path / "a.tif", Grid(GRID.crs, 500_000.0, 4e6, 40.0, 20.0, 15, 40)).read(0, 0, 15, 40)
    apart = np.abs(30.5 - 4 * (np.arange(15) + 0.5)) / 4
    np.testing.assert_allclose(pixels[0, 20], np.maximum(1 - apart, 0) / 4, atol=1e-6)


def test_the_kernel_is_as_high_as_the_coarser_pixels(tmp_path: Path) -> None:
    """A line of one row, in pixels three times as high; the columns are finer, and a kernel is never narrower."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 60, 60, 1, gdal.GDT_Float64)
    dataset.SetProjection(GRID.crs.to_wkt())
    dataset.SetGeoTransform((500_000.0, 10.0, 0.0, 4_000_000.0, 0.0, -20.0))
    dataset.WriteArray(np.tile((np.arange(60) == 31)[:, None], (1, 60)) * 1.0)
    del dataset
    pixels, _ = Regridded(tmp_path / "a.tif", Grid(GRID.crs, 500_000.0, 4e6, 5.0, 60.0, 120, 20)).read(0, 0, 120, 20)
    apart = np.abs(31.5 - 3 * (np.arange(20) + 0.5)) / 3
    np.testing.assert_allclose(pixels[0, :, 50], np.maximum(1 - apart, 0) / 3, atol=1e-6)
    np.testing.assert_allclose(pixels[0, :, 51], pixels[0, :, 50], atol=1e-9)


@pytest.mark.parametrize("across", [True, False])
@pytest.mark.parametrize(("off", "copied"), [(0.9e-3, True), (-0.9e-3, True), (1.1e-3, False), (-1.1e-3, False)])
def test_pixels_within_a_thousandth_are_the_same(ortho: Path, across: bool, off: float, copied: bool) -> None:
    """Coordinates that are resampled are those of the new middles."""
    left, top = 500_100.0 + 10.0 * off * across, 3_999_900.0 + 20.0 * off * (not across)
    pixels, valid = Regridded(ortho, Grid(GRID.crs, left, top, 10.0, 20.0, 20, 20)).read(3, 2, 10, 8)
    assert valid.all()
    moved = pixels[:, 0, 0] - (500_135.0, 3_999_850.0)
    expected = (0.0, 0.0) if copied else (10.0 * off * across, 20.0 * off * (not across))
    np.testing.assert_allclose(moved, expected, atol=1e-4)


@pytest.mark.parametrize(("relative", "copied"), [(0.9e-9, True), (1.2e-9, False)])
@pytest.mark.parametrize("across", [True, False])
def test_pixels_of_another_size_are_not_the_same(ortho: Path, across: bool, relative: float, copied: bool) -> None:
    dx, dy = 10.0 * (1 + relative * across), 20.0 * (1 + relative * (not across))
    assert (Regridded(ortho, Grid(GRID.crs, 500_000.0, 4e6, dx, dy, 20, 20))._offset == (0, 0)) is copied


def test_an_ortho_of_another_place_is_refused(ortho: Path) -> None:
    for left, top in ((500_600.0, 4e6), (499_400.0, 4e6), (500_000.0, 3_999_200.0), (500_000.0, 4_000_800.0)):
        with pytest.raises(InputError, match="does not overlap"):
            Regridded(ortho, Grid(GRID.crs, left, top, 10.0, 20.0, 60, 40))


def test_windows_and_coarser_grids_are_where_they_belong() -> None:
    part = part_of(GRID, -2, 3, 10, 5)
    assert part.extent == (499_980.0, 3_999_840.0, 500_080.0, 3_999_940.0)
    half = coarser(GRID, 2, 30, 20)
    assert (half.extent, half.dx, half.dy) == (GRID.extent, 20.0, 40.0)


def test_bounds_in_another_crs_hold_the_whole_grid() -> None:
    assert warped_bounds(GRID, GRID.crs) == GRID.extent
    way = pyproj.Transformer.from_crs("EPSG:32633", "EPSG:4326", always_xy=True)
    lon, lat = way.transform(*GRID.xy(*np.meshgrid(np.linspace(0, 60, 21), np.linspace(0, 40, 21))))
    wanted = (lon.min(), lat.min(), lon.max(), lat.max())
    assert warped_bounds(GRID, parse_crs("EPSG:4326")) == pytest.approx(wanted, abs=1e-7)


def test_bounds_in_a_crs_of_no_place_are_infinite() -> None:
    local = pyproj.CRS('LOCAL_CS["a building site",UNIT["metre",1]]')
    assert warped_bounds(GRID, local) == (math.inf,) * 4


def test_a_file_that_refers_to_another_folder_is_read_where_that_is_allowed(ortho: Path, tmp_path: Path) -> None:
    gdal.BuildVRT(str(tmp_path / "a.vrt"), [str(ortho)])
    with pytest.raises(InputError, match="outside"):
        Regridded(tmp_path / "a.vrt", GRID)
    pixels, valid = Regridded(tmp_path / "a.vrt", GRID, roots=(ortho.parent,)).read(0, 0, 60, 40)
    np.testing.assert_array_equal(np.where(valid, pixels, 0.0), np.where(valid, middles(GRID), 0.0))
    assert valid.sum() == 2 * 60 * 40 - 1


@pytest.mark.parametrize("off", [0.0, 3.0])
@pytest.mark.parametrize(
    ("left", "top"), [(-7, 5), (-9, 5), (60, 5), (63, 5), (5, -6), (5, -9), (5, 40), (5, 44), (-9, -9), (63, 44)]
)
def test_a_window_beside_the_ortho_has_no_values(ortho: Path, off: float, left: int, top: int) -> None:
    """7 x 6 pixels that touch it or are apart, on one axis or on both. They would be copied, or resampled."""
    grid = Grid(GRID.crs, 500_000.0 + off, 4_000_000.0, 10.0, 20.0, 60, 40)
    pixels, valid = Regridded(ortho, grid).read(left, top, 7, 6)
    assert pixels.shape == valid.shape == (2, 6, 7)
    assert not valid.any()


def test_bounds_across_longitude_180_go_on_beyond_it() -> None:
    to_map = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32660", always_xy=True)
    x, y = to_map.transform(180.0, 10.0)
    grid = Grid(parse_crs("EPSG:32660"), x - 4000.0, y + 3000.0, 100.0, 100.0, 100, 60)
    corners = grid.xy(*np.meshgrid(np.linspace(0, 100, 23), np.linspace(0, 60, 23)))
    lon, lat = to_map.transform(*corners, direction="INVERSE")
    lon = np.mod(lon, 360.0)
    wanted = (lon.min(), lat.min(), lon.max(), lat.max())
    assert wanted[0] < 179.97
    assert wanted[2] > 180.05
    assert warped_bounds(grid, parse_crs("EPSG:4326")) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("turn", [35.0, 125.0, -125.0])
def test_the_kernel_holds_the_box_of_a_pixel_that_is_turned(tmp_path: Path, turn: float) -> None:
    """Maps whose norths differ by so many degrees, and more than a right angle."""
    plane = pyproj.CRS(f"+proj=stere +lat_0=90 +lat_ts=70 +lon_0={15 - turn} +datum=WGS84 +type=crs")
    x, y = pyproj.Transformer.from_crs("EPSG:4326", plane, always_xy=True).transform(15.0, 75.0)
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 80, 80, 1)
    made.SetProjection(plane.to_wkt())
    made.SetGeoTransform((x - 400.0, 10.0, 0.0, y + 400.0, 0.0, -10.0))
    del made
    left, top = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform(15.0, 75.0)
    grid = Grid(parse_crs("EPSG:32633"), left - 60.0, top + 50.0, 40.0, 25.0, 3, 4)
    corners = grid.xy(1.5 + np.array([-0.5, 0.5, 0.5, -0.5]), 2.0 + np.array([-0.5, -0.5, 0.5, 0.5]))
    place = pyproj.Transformer.from_crs(grid.crs, plane, always_xy=True).transform(*corners)
    wide, high = (np.ptp(part) / 10.0 for part in place)
    assert min(wide, high) > 2
    np.testing.assert_allclose(Regridded(tmp_path / "a.tif", grid)._scales(), (1 / wide, 1 / high), rtol=1e-4)
