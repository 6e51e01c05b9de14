"""The grid of the samples of a DEM, and the samples of its file, by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import CrsError
from ortho_pipeline.surface.dem_file import Affine, DemFile, SampleGrid

DEGREES, UTM = pyproj.CRS("EPSG:4326"), pyproj.CRS("EPSG:32635")
FEET = pyproj.CRS("+proj=tmerc +lon_0=27 +datum=WGS84 +units=us-ft")


def grid(place: Affine, shape: tuple[int, int] = (20, 36), crs: pyproj.CRS = DEGREES) -> SampleGrid:
    return SampleGrid(crs, shape, place)


def test_a_sheared_grid_and_its_inverse() -> None:
    sheared = grid((500_000.0, 30.0, -4.0, 4_000_000.0, 7.0, -25.0), crs=UTM)
    u, v = np.random.default_rng(0).uniform(-5, 40, (2, 50))
    x, y = 500_000.0 + 30.0 * u - 4.0 * v, 4_000_000.0 + 7.0 * u - 25.0 * v
    np.testing.assert_allclose(sheared.samples_at(np.column_stack([x, y])), np.column_stack([u, v]), atol=1e-8)
    lon, lat = sheared.lonlat(u, v)
    expected = pyproj.Transformer.from_crs(UTM, DEGREES, always_xy=True).transform(x, y)
    np.testing.assert_allclose((lon, lat), expected, atol=1e-10)


@pytest.mark.parametrize("step", [10.0, -10.0])
@pytest.mark.parametrize(("lon", "shift"), [(0.0, 0), (4.9, 0), (5.1, 1), (-14.9, -1), (-15.1, -2), (179.0, 18)])
def test_the_seam_of_a_global_grid_is_opposite_to_a_longitude(step: float, lon: float, shift: int) -> None:
    """36 columns around longitude 3; the columns of the file go on behind its last one."""
    whole = grid((3.0 - 17.5 * step, step, 0.0, 85.0, 0.0, -9.0))
    shift *= int(np.sign(step))
    turned = whole.around(3.0 + lon)
    assert (turned is whole) is (shift == 0)
    assert turned.first_column == shift % 36
    assert turned.crs_from_pixel == pytest.approx((3.0 + (shift - 17.5) * step, step, 0, 85, 0, -9))
    assert turned.around(3.0).first_column == 0
    assert replace(whole, first_column=30).around(3.0 + lon).first_column == (30 + shift) % 36


@pytest.mark.parametrize(
    ("place", "shape", "crs"),
    [
        ((-175.0, 10.0, 0.0, 85.0, 0.0, -9.0), (20, 35), DEGREES),
        ((-175.0, 10.0, 1e-3, 85.0, 0.0, -9.0), None, DEGREES),
        ((-175.0, 10.0, 0.0, 85.0, 1e-3, -9.0), None, DEGREES), ((-175.0, 10.0, 0.0, 85.0, 0.0, -9.0), None, UTM),
        ((-175.0, 10.000001, 0.0, 85.0, 0.0, -9.0), None, DEGREES),
    ],
)  # fmt: skip
def test_any_other_grid_has_no_seam(place: Affine, shape: tuple[int, int] | None, crs: pyproj.CRS) -> None:
    part = grid(place, shape or (20, 36), crs)
    assert part.around(170.0) is part


def test_longitudes_are_within_half_a_turn_of_the_middle() -> None:
    """The middle of 20 columns from 170.5 is 180 degrees, and with a shear of half a degree a row 181."""
    straight, sheared = (grid((170.5, 1.0, shear, 40.0, 0.0, -1.0), (5, 20)) for shear in (0.0, 0.5))
    lon = np.array([-175.0, -0.5, 0.5, 360.5, 359.5, -359.5, 540.0, 180.0])
    found = straight.samples_at(np.column_stack([lon, np.full(8, 38.0)]))
    np.testing.assert_allclose(found[:, 0] + 170.5, [185, 359.5, 0.5, 0.5, 359.5, 0.5, 180, 180])
    np.testing.assert_allclose(found[:, 1], 2.0)
    found = sheared.samples_at(np.array([[0.8, 38.0], [1.2, 38.0]]))
    np.testing.assert_allclose(found[:, 0] + 171.5, [360.8, 1.2])


@pytest.mark.parametrize(
    ("place", "crs", "size"),
    [
        ((1e9, 6.0, -4.0, 1e9, 8.0, 3.0), UTM, 10.0), ((1e9, 3.0, -8.0, 1e9, 4.0, 6.0), UTM, 10.0),
        ((1e9, 6.0, -4.0, 1e9, 8.0, 3.0), FEET, 10.0 * 1200 / 3937),
    ],
)  # fmt: skip
def test_samples_beyond_the_area_of_a_map_have_their_size_on_it(place: Affine, crs: pyproj.CRS, size: float) -> None:
    assert grid(place, crs=crs).sample_size == pytest.approx(size, rel=1e-12)


def test_samples_in_degrees_have_the_size_of_those_in_the_middle() -> None:
    """Rows from 20 to 80 degrees north; a column is wider than a row is high."""
    tall = grid((10.0, 0.2, 0.0, 79.7, 0.0, -0.1), (600, 50))
    middle = (50.0 - 0.3, 10.0 + 0.2 * 25)
    _, _, metres = pyproj.Geod(ellps="WGS84").inv(middle[1] - 0.1, middle[0], middle[1] + 0.1, middle[0])
    assert tall.sample_size == pytest.approx(metres, rel=1e-3)
    assert metres > 14_000


def write(path: Path, values: Any, kind: int, nodata: float | None = None, **band: float) -> DemFile:
    values = np.atleast_2d(values)
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *values.shape[::-1], 1, kind)
    dataset.SetProjection(UTM.to_wkt())
    dataset.SetGeoTransform((500_000.0, 30.0, 0.0, 4_000_000.0, 0.0, -20.0))
    if nodata is not None:
        dataset.GetRasterBand(1).SetNoDataValue(nodata)
    for name, value in band.items():
        getattr(dataset.GetRasterBand(1), f"Set{name}")(value)
    dataset.WriteArray(values)
    dataset = None
    return DemFile(str(path), {})


def test_heights_are_from_500_m_below_to_9000_m(tmp_path: Path) -> None:
    values = [-500.5, -500.0, -499.0, 8999.0, 9000.0, 9000.5, np.inf, -np.inf, np.nan]
    file = write(tmp_path / "a.tif", values, gdal.GDT_Float64)
    expected = [np.nan, -500, -499, 8999, 9000, *[np.nan] * 4]
    np.testing.assert_array_equal(file.read(0, 0, 9, 1, 1.0)[0], expected)
    # In metres, whatever the unit.
    np.testing.assert_array_equal(file.read(1, 0, 5, 1, 0.5)[0], [-250, -249.5, 4499.5, 4500, 4500.25])
    np.testing.assert_array_equal(file.read(1, 0, 3, 1, 2.0)[0], [np.nan] * 3)


def test_a_window_is_columns_and_rows_of_the_file(tmp_path: Path) -> None:
    values = np.arange(35.0).reshape(5, 7) + 100
    file = write(tmp_path / "a.tif", values, gdal.GDT_Float32)
    np.testing.assert_array_equal(file.read(2, 1, 4, 3, 1.0), values[1:4, 2:6])
    assert file.place()[1].crs_from_pixel == (500_015.0, 30.0, 0.0, 3_999_990.0, 0.0, -20.0)
    assert file.place()[1].shape == (5, 7)


def test_nodata_is_a_value_of_the_file_and_not_of_heights(tmp_path: Path) -> None:
    """Before scale and offset; a value that the type holds only nearly is the nearest one."""
    scaled = write(tmp_path / "a.tif", [30, 60, 120], gdal.GDT_Int16, 60.0, Scale=0.5, Offset=45.0)
    np.testing.assert_array_equal(scaled.read(0, 0, 3, 1, 1.0)[0], [60, np.nan, 105])
    np.testing.assert_array_equal(scaled.read(0, 0, 3, 1, 0.3048)[0], np.array([60, np.nan, 105]) * 0.3048)
    moved = write(tmp_path / "b.tif", [30, 60], gdal.GDT_Int16, Offset=45.0)
    np.testing.assert_array_equal(moved.read(0, 0, 2, 1, 1.0)[0], [75, 105])
    single = write(tmp_path / "c.tif", [0.1, 0.2], gdal.GDT_Float32, 0.1)
    np.testing.assert_allclose(single.read(0, 0, 2, 1, 1.0)[0], [np.nan, 0.2], rtol=1e-6)
    beyond = write(tmp_path / "d.tif", [0, 1, 65535], gdal.GDT_UInt16, -1.0, Scale=0.1)
    np.testing.assert_allclose(beyond.read(0, 0, 3, 1, 1.0)[0], [0, 0.1, 6553.5])


def test_a_mask_hides_heights_in_addition_to_nodata(tmp_path: Path) -> None:
    file = write(tmp_path / "a.tif", [[7.0, 8.0, 9.0], [10.0, 11.0, 12.0]], gdal.GDT_Float32)
    file.close()
    dataset = gdal.Open(file.path, gdal.GA_Update)
    dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
    dataset.GetRasterBand(1).GetMaskBand().WriteArray(np.array([[255, 0, 1], [255, 255, 0]], dtype=np.uint8))
    dataset = None
    np.testing.assert_array_equal(file.read(0, 0, 3, 2, 1.0), [[7, np.nan, 9], [10, 11, np.nan]])
    np.testing.assert_array_equal(file.read(1, 0, 2, 2, 1.0), [[np.nan, 9], [11, np.nan]])


@pytest.mark.parametrize(
    ("transform", "said"),
    [
        ((0.0, 1.0, 2.0, 0.0, 2.0, 4.0), "degenerate"), ((0.0, 1.0, 0.0, 0.0, 3.0, 0.0), "degenerate"),
        ((0.0, 0.0, 2.0, 0.0, 3.0, 0.0), None),
        ((500_000.0, 8e-4, 0.0, 4e6, 0.0, -9e-4), "samples of this DEM would be 0.0009 m apart"),
        ((500_000.0, 8e-4, 0.0, 4e6, 0.0, -1.1e-3), None),
    ],
)  # fmt: skip
def test_samples_are_on_a_grid_of_at_least_a_millimetre(
    tmp_path: Path, transform: tuple[float, ...], said: str | None
) -> None:
    file = write(tmp_path / "a.tif", [[7.0, 8.0, 9.0]], gdal.GDT_Float32)
    file.close()
    dataset = gdal.Open(file.path, gdal.GA_Update)
    dataset.SetGeoTransform(transform)
    dataset = None
    if said is None:
        assert file.place()[1].shape == (1, 3)
    else:
        with pytest.raises(CrsError, match=said):
            file.place()
