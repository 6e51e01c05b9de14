"""Types of pixels: GDAL's names and numbers of them, and what they can hold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.shell import typed
from ortho_pipeline.options import PIXEL_TYPES


def numpy_type(gdal_type: int) -> np.dtype[Any]:
    """Return the numpy type of GDAL's number of a pixel type."""
    from osgeo import gdal_array

    return np.dtype(gdal_array.GDALTypeCodeToNumericTypeCode(gdal_type))


def gdal_type(dtype: np.dtype[Any]) -> int:
    """Return GDAL's number of a pixel type."""
    from osgeo import gdal_array

    return int(gdal_array.NumericTypeCodeToGDALTypeCode(dtype.type))


def check_types(bands: Sequence[gdal.Band], path: str) -> None:
    """Raise an `InputError` if the pixels of a band cannot be read as numbers that can be resampled."""
    if any(gdal.DataTypeIsComplex(band.DataType) for band in bands):
        raise InputError("complex pixels cannot be resampled", file=path, remedy="split them into real bands first")
    if any(band.GetMetadataItem("PIXELTYPE", "IMAGE_STRUCTURE") == "SIGNEDBYTE" for band in bands):
        # GDAL before 3.7 gives bytes with a sign as bytes without one.
        raise InputError(
            "this GDAL reads signed bytes wrongly, as 0 to 255",
            file=path,
            remedy=f"convert them to 16 bits: `gdal_calc.py -A {typed(path)} --type=Int16 "
            "--calc='A.astype(int8).astype(int16)' --outfile=int16.tif`",
        )


def nodata_of(band: gdal.Band, dtype: np.dtype[Any]) -> float | None:
    """Return the nodata value of a band, None if it has none that the band and the pixel type can hold."""
    value, own = band.GetNoDataValue(), numpy_type(band.DataType)
    if value is None or not (holds(own, value) and holds(dtype, value)):
        return None
    # As its pixels have it: a header may state more digits, such as -9999.9 of Float32.
    return float(own.type(value)) if own.kind == "f" else value


def holds(dtype: np.dtype[Any], value: float) -> bool:
    """Return whether a pixel of this type can have a value (approximately, for floating point)."""
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return not math.isfinite(value) or math.isfinite(dtype.type(value))
    limits = np.iinfo(dtype)
    return float(value).is_integer() and bool(limits.min <= value <= limits.max)


def pixel_type(name: str) -> np.dtype[Any]:
    """Return the type of pixels that GDAL calls `name`."""
    code = gdal.GetDataTypeByName(name)
    if name.lower() not in {known.lower() for known in PIXEL_TYPES}:
        raise InputError(f"{name!r} is not a pixel type", field="output.dtype", remedy=", ".join(PIXEL_TYPES))
    return numpy_type(code)


def read_type(own: np.dtype[Any], wanted: str | None) -> np.dtype[Any]:
    """Return the type in which pixels are read that are written as `wanted`."""
    if wanted is None or pixel_type(wanted) == own:
        return own
    return np.promote_types(np.promote_types(own, pixel_type(wanted)), np.float32)


def alpha_of(band: Any) -> int:
    """Return the number of the alpha band that is the mask of a band, where GDAL makes none of it; else 0.

    GDAL does so in rasters of two and four bands alone.
    """
    dataset = band.GetDataset()
    last = int(dataset.RasterCount)
    is_alpha = dataset.GetRasterBand(last).GetColorInterpretation() == gdal.GCI_AlphaBand
    return last if is_alpha and band.GetMaskFlags() == gdal.GMF_ALL_VALID else 0


def mask_flags(band: Any) -> int:
    """Return GDAL's flags of the mask of a band."""
    return gdal.GMF_PER_DATASET | gdal.GMF_ALPHA if alpha_of(band) else int(band.GetMaskFlags())


def valid_of(band: Any, *window: int, **size: int) -> NDArray[np.bool_]:
    """Return which pixels of a band have a value; arguments as of `ReadAsArray`."""
    # Bands of a dataset that is released cannot be read.
    dataset, alpha = band.GetDataset(), alpha_of(band)
    mask = dataset.GetRasterBand(alpha) if alpha else band.GetMaskBand()
    return np.asarray(mask.ReadAsArray(*window, **size) != 0)
