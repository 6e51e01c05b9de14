"""GDAL's own warper as a second engine: slower, and a cross-check by a program that nobody here wrote."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from osgeo import gdal, gdal_array

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster import Grid, RasterSource
from ortho_pipeline.raster_output import gdal_errors
from ortho_pipeline.raster_writer import Profile, RasterWriter


def warp_with_gdal(
    source: RasterSource,
    rpc: Mapping[str, str],
    heights: tuple[NDArray[np.float64], Sequence[float], pyproj.CRS] | float,
    grid: Grid,
    path: str | os.PathLike[str],
    *,
    resampling: str = "bilinear",
    driver: str = "COG",
    creation_options: Mapping[str, str] | None = None,
    memory: int = 512_000_000,
    threads: int = 1,
    profile: Profile | None = None,
    progress: Any = None,
) -> int:
    """Write the orthoimage of `source` by GDAL's own warper, exactly; return how many pixels are valid.

    Parameters
    ----------
    rpc : mapping
        GDAL's ``RPC`` metadata domain; it takes the place of the source's own, and of its GCPs.
    heights : (array (rows, columns), geotransform, crs) or float
        Ellipsoidal heights of the surface with NaN for voids, or one height.
    """
    if len(source.paths) > 1:
        raise InputError(
            "GDAL's warper takes one file", file=source.paths[1], field="engine", remedy="use our own engine"
        )
    view = gdal.Translate("", source.dataset, format="VRT", bandList=list(source.band_numbers))
    view.SetGCPs([], "")
    view.SetMetadata(dict(rpc), "RPC")
    profile = profile or Profile.of(source)
    dem = f"/vsimem/ortho_dem_{os.getpid()}_{threading.get_ident()}.tif"
    options = ["METHOD=RPC"]  # GDAL would otherwise prefer GCPs
    writer = RasterWriter(path, grid, profile, driver=driver, creation_options=creation_options, threads=threads)
    with writer, gdal_errors(path):
        target = writer.scratch("gdal")
        try:
            if isinstance(heights, tuple):
                _write_dem(dem, *heights)
                options += [f"RPC_DEM={dem}", "RPC_DEMINTERPOLATION=bilinear", "RPC_DEM_APPLY_VDATUM_SHIFT=NO"]
            else:
                options += [f"RPC_HEIGHT={heights!r}"]
            _warp_exactly(view, target, source, profile, grid, options, resampling, memory, threads, progress)
            return writer.copy(target)
        finally:
            target.unlink(missing_ok=True)
            if isinstance(heights, tuple):
                gdal.Unlink(dem)


def _write_dem(path: str, heights: NDArray[np.float64], geotransform: Sequence[float], crs: pyproj.CRS) -> None:
    rows, columns = heights.shape
    dataset = gdal.GetDriverByName("GTiff").Create(path, columns, rows, 1, gdal.GDT_Float64)
    dataset.SetProjection(crs.to_wkt())
    dataset.SetGeoTransform(tuple(geotransform))
    dataset.GetRasterBand(1).SetNoDataValue(-1e6)
    dataset.GetRasterBand(1).WriteArray(np.where(np.isnan(heights), -1e6, heights))


def _warp_exactly(
    view: gdal.Dataset,
    target: Path,
    source: RasterSource,
    profile: Profile,
    grid: Grid,
    transformer_options: list[str],
    resampling: str,
    memory: int,
    threads: int,
    progress: Any,
) -> None:
    callback = None if progress is None else (lambda share, *_: progress(share) or 1)
    gdal.Warp(
        str(target),
        view,
        format="GTiff",
        outputBounds=grid.extent,
        width=grid.width,
        height=grid.height,
        dstSRS=grid.crs.to_wkt(),
        transformerOptions=transformer_options,
        errorThreshold=0,
        resampleAlg=resampling,
        # By itself the warper clamps the source to the type of the output before it interpolates.
        workingType=gdal_array.NumericTypeCodeToGDALTypeCode(source.dtype.type),
        outputType=gdal_array.NumericTypeCodeToGDALTypeCode(profile.dtype.type),
        dstAlpha=profile.validity == "mask",
        dstNodata=profile.nodata,
        multithread=threads > 1,
        warpMemoryLimit=memory // 2,
        # Without these two the values depend on how the warper cuts the image into chunks.
        warpOptions=["XSCALE=1", "YSCALE=1", f"NUM_THREADS={threads}", "INIT_DEST=0" if profile.nodata is None else
                     "INIT_DEST=NO_DATA"],
        creationOptions=["TILED=YES", "BIGTIFF=IF_SAFER"],
        callback=callback,
    )  # fmt: skip
