"""Stack of single bands of one acquisition, each from its own camera."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.imaging.registration import Registration, register, resample
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.raster.verified_writing import raster_output, written

#: Types of bands that are written.
_TYPES = {np.dtype(np.uint8), np.dtype(np.uint16)}


def stack_bands(
    bands: Mapping[str, str | PathLike[str]],
    output: str | PathLike[str],
    *,
    reference: str = "red",
    transform: str = "projective",
) -> tuple[Registration, ...]:
    """Register single-band images onto one of them and write a GeoTIFF with all bands.

    The stack has the geometry of the reference. Pixels that a band does not cover, or has no value for,
    are 0, the nodata value.

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
    images: dict[str, np.ndarray[Any, Any]] = {}
    valid: dict[str, NDArray[np.bool_]] = {}
    for name, path in bands.items():
        images[name], valid[name] = _read(path)
    types = {image.dtype for image in images.values()}
    if len(types) != 1 or not types < _TYPES:
        raise InputError(
            f"the bands must be unsigned integers of 8 or 16 bits, and of one type, not {_listed(types)}",
            field="bands",
            remedy="convert them to 16 bits, for example",
        )
    names = list(images)
    stack, registrations = register(list(images.values()), names, reference=names.index(reference), transform=transform)
    for one in registrations:
        valid[one.band] = resample(valid[one.band].astype(float), one.transform, order=1) >= 0.5
    dtype = next(iter(types))
    # Splines overshoot; a valid dark pixel must not become nodata.
    low, high = 1, np.iinfo(dtype).max
    shown = np.isfinite(stack) & np.stack([valid[name] for name in names])
    filled = np.where(shown, np.clip(np.rint(stack), low, high), 0).astype(dtype)
    write_bands(filled, names, output)
    return registrations


def _read(path: str | PathLike[str]) -> tuple[np.ndarray[Any, Any], NDArray[np.bool_]]:
    """Return the pixels of an image, and which are valid; the others have the value of the nearest valid one."""
    from scipy.ndimage import distance_transform_edt

    source = RasterSource(path)
    if source.count != 1:
        raise InputError(f"this image has {counted(source.count, 'band')} instead of one", file=path)
    pixels = source.read(0, 0, source.width, source.height)
    valid = source.read_valid(0, 0, pixels)
    if valid is None:
        return pixels[0], np.ones(pixels.shape[1:], dtype=bool)
    if valid.any():
        nearest = distance_transform_edt(~valid[0], return_distances=False, return_indices=True)
        pixels[0] = pixels[0][tuple(nearest)]
    return pixels[0], valid[0]


def _listed(types: Iterable[np.dtype[Any]]) -> str:
    return " and ".join(sorted(map(str, types)))


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
