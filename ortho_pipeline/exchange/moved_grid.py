"""An ortho whose map grid is moved: a VRT around it, or a copy, whose pixels are those of the original."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import name_sources_relatively
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.verified_writing import raster_output, written


def moved_geotransform(geotransform: tuple[float, ...], displaced: Array) -> tuple[float, ...]:
    """Return the geotransform of a grid that shows things displaced by so many pixels ``(2,)``, without that."""
    x, across_x, down_x, y, across_y, down_y = geotransform
    column, row = (float(value) for value in displaced)
    return (
        x - across_x * column - down_x * row,
        across_x,
        down_x,
        y - across_y * column - down_y * row,
        across_y,
        down_y,
    )


def write_moved(dataset: Any, geotransform: tuple[float, ...], path: str | os.PathLike[str]) -> None:
    """Write an ortho with another geotransform and the same pixels.

    Parameters
    ----------
    path : path
        A ``.vrt``, which names the ortho relative to itself; or a ``.tif``, a copy of a GeoTIFF byte for byte. What
        GDAL reads from side-cars, such as a mask, is in the file of the copy; its pixels are then compressed anew.

    Raises
    ------
    InputError
        If it cannot be written, or a copy is asked for of another format.
    """
    if Path(path).suffix.lower() == ".vrt":
        with raster_output(path) as temporary:
            with written(gdal.GetDriverByName("VRT").CreateCopy(os.fspath(temporary), dataset)) as copy:
                copy.SetGeoTransform(geotransform)
            name_sources_relatively(temporary, Path(path))
        return
    source = Path(dataset.GetDescription())
    if dataset.GetDriver().ShortName != "GTiff" or not source.is_file():
        raise InputError(
            "only a GeoTIFF on this machine is copied without touching its pixels",
            file=source,
            field="format",
            remedy="write a VRT",
        )
    with raster_output(path) as temporary:
        if all(name.endswith(".ovr") for name in dataset.GetFileList()[1:]):
            shutil.copyfile(source, temporary)
            made = gdal.OpenEx(
                os.fspath(temporary), gdal.OF_RASTER | gdal.OF_UPDATE,
                allowed_drivers=["GTiff"], open_options=["IGNORE_COG_LAYOUT_BREAK=YES"],
            )  # fmt: skip
        else:
            options = ["TILED=YES", "COMPRESS=DEFLATE", "BIGTIFF=IF_SAFER"]
            made = gdal.GetDriverByName("GTiff").CreateCopy(os.fspath(temporary), dataset, options=options)
        with written(made) as copy:
            copy.SetGeoTransform(geotransform)
