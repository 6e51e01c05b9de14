"""Where the blocks of a GeoTIFF lie in its file, and whether the file holds them all."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from typing import Any

from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import first_line, open_dataset


def require_whole(path: str | os.PathLike[str], **access: Any) -> None:
    """Refuse a raster on disk whose file ends before its pixels do; what is no raster is accepted.

    A GeoTIFF is asked for the place of every block and no pixel is read. Of other formats the last block is read.

    Parameters
    ----------
    access : dict
        As of `raster.source.open_dataset`.

    Raises
    ------
    InputError
        If the file is truncated.
    """
    try:
        dataset = open_dataset(path, **access)
    except InputError:
        return
    told: dict[str, Any] = {"file": path, "remedy": "copy or download it again"}
    if dataset.GetDriver().ShortName == "GTiff":
        end = os.path.getsize(path)
        for band in stored_images(dataset):
            if any(offset + count > end for offset, count, _, _ in stored_blocks(band)):
                raise InputError("the file is truncated: it ends before its pixels do", **told)
        return
    band = dataset.GetRasterBand(dataset.RasterCount)
    width, height = band.GetBlockSize()
    left, top = (band.XSize - 1) // width * width, (band.YSize - 1) // height * height
    try:
        band.ReadRaster(left, top, band.XSize - left, band.YSize - top)
    except RuntimeError as error:
        raise InputError(
            f"the file is damaged: its last pixels cannot be read ({first_line(error)})", **told
        ) from error


def stored_images(dataset: gdal.Dataset) -> Iterator[gdal.Band]:
    """Yield a band of every image in a file: bands that are stored apart, overviews, mask."""
    apart = dataset.GetMetadataItem("INTERLEAVE", "IMAGE_STRUCTURE") == "BAND"
    for index in range(dataset.RasterCount if apart else 1):
        band = dataset.GetRasterBand(index + 1)
        yield band
        yield from (band.GetOverview(k) for k in range(band.GetOverviewCount()))
    if dataset.GetRasterBand(1).GetMaskFlags() == gdal.GMF_PER_DATASET:
        mask = dataset.GetRasterBand(1).GetMaskBand()
        yield mask
        yield from (mask.GetOverview(k) for k in range(mask.GetOverviewCount()))


def stored_blocks(band: gdal.Band) -> list[tuple[int, int, int, int]]:
    """Return offset and count of bytes, column and row of each block; an absent one has 0 bytes at 0."""
    width, height = band.GetBlockSize()
    found = []
    for row in range(math.ceil(band.YSize / height)):
        for column in range(math.ceil(band.XSize / width)):
            place = f"{column}_{row}"
            offset, count = (band.GetMetadataItem(f"BLOCK_{what}_{place}", "TIFF") for what in ("OFFSET", "SIZE"))
            found.append((int(offset or 0), int(count or 0), column, row))
    return found
