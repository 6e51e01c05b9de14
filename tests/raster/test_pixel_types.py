"""Types of pixels, against what NumPy can hold."""

from __future__ import annotations

import math

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.pixel_types import check_types, holds, nodata_of, pixel_type, read_type


@pytest.mark.parametrize("name", ["u1", "i2", "u2", "i4", "u4"])
def test_an_integer_type_holds_the_whole_numbers_between_its_limits(name: str) -> None:
    limits = np.iinfo(name)
    for value in (limits.min, limits.max, 1.0):
        assert holds(np.dtype(name), value)
    for value in (limits.min - 1.0, limits.max + 1.0, 0.5, math.nan, math.inf):
        assert not holds(np.dtype(name), value)


@pytest.mark.filterwarnings("error")
def test_a_floating_type_holds_what_is_not_too_large() -> None:
    # The last one is the smallest number of 32 bits as programs round it.
    for value in (math.nan, math.inf, -math.inf, 0.1, 3.4e38, -3.4e38, -3.40282347e38):
        assert holds(np.dtype("f4"), value)
    assert not holds(np.dtype("f4"), 3.5e38)
    assert not holds(np.dtype("f4"), -3.5e38)
    assert holds(np.dtype("f8"), 3.5e38)


def test_a_nodata_value_that_no_pixel_can_have_is_none() -> None:
    dataset = gdal.GetDriverByName("MEM").Create("", 1, 1, 1, gdal.GDT_Float64)
    band = dataset.GetRasterBand(1)
    assert nodata_of(band, np.dtype("u1")) is None
    band.SetNoDataValue(-9999.0)
    assert nodata_of(band, np.dtype("u1")) is None
    assert nodata_of(band, np.dtype("i2")) == -9999.0
    dataset = gdal.GetDriverByName("MEM").Create("", 1, 1, 1, gdal.GDT_Float32)
    band = dataset.GetRasterBand(1)
    band.SetNoDataValue(1e300)
    assert nodata_of(band, np.dtype("f8")) is None


def test_types_have_the_names_of_gdal_whatever_their_case() -> None:
    wanted = {"Byte": "u1", "UInt16": "u2", "Int16": "i2", "Float32": "f4"}
    assert {name: pixel_type(name) for name in wanted} == {name: np.dtype(kind) for name, kind in wanted.items()}
    assert pixel_type("uint16") == np.dtype("u2")
    for name in ("CFloat32", "half a byte"):
        with pytest.raises(InputError, match="not a pixel type"):
            pixel_type(name)


@pytest.mark.parametrize(
    ("own", "wanted", "read"),
    [
        ("u2", None, "u2"), ("u2", "UInt16", "u2"), ("u2", "Byte", "f4"), ("u1", "Float32", "f4"),
        ("u4", "Byte", "f8"), ("f8", "Float32", "f8"),
    ],
)  # fmt: skip
def test_a_conversion_reads_in_a_floating_type_that_loses_nothing(own: str, wanted: str | None, read: str) -> None:
    assert read_type(np.dtype(own), wanted) == np.dtype(read)


def test_a_complex_band_among_others_is_refused() -> None:
    dataset = gdal.GetDriverByName("MEM").Create("", 1, 1, 1, gdal.GDT_Byte)
    dataset.AddBand(gdal.GDT_CFloat32)
    bands = [dataset.GetRasterBand(number) for number in (1, 2)]
    check_types(bands[:1], "a.tif")
    with pytest.raises(InputError, match="complex pixels cannot be resampled"):
        check_types(bands, "a.tif")
