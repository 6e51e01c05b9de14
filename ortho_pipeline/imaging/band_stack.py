"""Stack of single bands of one acquisition, each from its own camera."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.imaging.registration import Registration, register
from ortho_pipeline.raster.source import open_pixels
from ortho_pipeline.raster.verified_writing import raster_output, written


def stack_bands(
    bands: Mapping[str, str | PathLike[str]],
    output: str | PathLike[str],
    *,
    reference: str = "red",
    transform: str = "projective",
) -> tuple[Registration, ...]:
    """Register single-band images onto one of them and write a GeoTIFF with all bands.

    The stack has the geometry of the reference. Pixels that a band does not cover are 0, the nodata value.

    Parameters
    ----------
    bands : mapping of band name to path
        In the order of the stack.

    Raises
    ------
    InputError
        If an image cannot be read or has several bands, the sizes or types differ, or nothing matches.
    """
    if reference not in bands or len(bands) < 2:
        raise InputError(
            f"there is no band {reference!r} to register onto",
            field="reference",
            remedy=f"use one of {', '.join(bands)}",
        )
    images = {name: _read(path) for name, path in bands.items()}
    types = {image.dtype for image in images.values()}
    if len(types) != 1 or next(iter(types)).kind != "u":
        raise InputError("the bands must be unsigned integers of one type", field="bands")
    names = list(images)
    stack, registrations = register(list(images.values()), names, reference=names.index(reference), transform=transform)
    dtype = next(iter(types))
    # Splines overshoot; a valid dark pixel must not become nodata.
    low, high = 1, np.iinfo(dtype).max
    filled = np.where(np.isfinite(stack), np.clip(np.rint(stack), low, high), 0).astype(dtype)
    write_bands(filled, names, output)
    return registrations


def _read(path: str | PathLike[str]) -> np.ndarray[Any, Any]:
    dataset = open_pixels(path)[0]
    if dataset.RasterCount != 1:
        raise InputError(f"this image has {counted(dataset.RasterCount, 'band')} instead of one", file=path)
    return np.asarray(dataset.ReadAsArray())


def write_bands(
    stack: np.ndarray[Any, Any], names: list[str], output: str | PathLike[str], *, nodata: int | None = 0
) -> None:
    """Write pixels ``(bands, rows, columns)``, 8 or 16 bit, as a GeoTIFF with named bands."""
    count, rows, columns = stack.shape
    kind = gdal.GDT_Byte if stack.dtype == np.uint8 else gdal.GDT_UInt16
    with raster_output(output) as temporary:
        options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "TILED=YES", "BIGTIFF=IF_SAFER"]
        created = gdal.GetDriverByName("GTiff").Create(str(temporary), columns, rows, count, kind, options)
        with written(created) as dataset:
            for index, name in enumerate(names, start=1):
                band = dataset.GetRasterBand(index)
                band.SetDescription(name)
                if nodata is not None:
                    band.SetNoDataValue(nodata)
                band.WriteArray(stack[index - 1])
            del band
