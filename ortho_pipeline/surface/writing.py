"""DEMs written as files: heights at posts, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Callable

import numpy as np
import pyproj
from numpy.typing import ArrayLike
from osgeo import gdal, osr

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.raster.verified_writing import raster_output, written
from ortho_pipeline.surface.base import Array, Surface

#: Least step (degrees) of a coarse DEM, an arc second, and most posts along a side.
_COARSE, _MOST_POSTS = 1 / 3600, 4000


def write_dem(path: str | os.PathLike[str], heights: Array, corner: tuple[float, float], step: float, crs: str) -> None:
    """Write a DEM as GeoTIFF, north up; whole or not at all.

    Parameters
    ----------
    heights : (rows, columns)
        Metres above the vertical datum of `crs`, from the northwest; rounded heights compress much better.
    corner : (float, float)
        Outer corner of the first sample.
    crs : str
        Compound CRS with the height datum, such as EPSG:32636+5773.
    """
    system = osr.SpatialReference()
    system.SetFromUserInput(crs)
    rows, columns = heights.shape
    options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "ZLEVEL=9", "TILED=YES"]
    with raster_output(path) as temporary:
        created = gdal.GetDriverByName("GTiff").Create(str(temporary), columns, rows, 1, gdal.GDT_Float32, options)
        with written(created) as dataset:
            dataset.SetGeoTransform((corner[0], step, 0.0, corner[1], 0.0, -step))
            dataset.SetProjection(system.ExportToWkt())
            dataset.GetRasterBand(1).SetNoDataValue(-32768.0)
            dataset.GetRasterBand(1).WriteArray(heights.astype(np.float32))


def write_terrain(
    path: str | os.PathLike[str],
    terrain: Callable[[Array, Array], Array],
    box: ArrayLike,
    step: float,
    crs: str,
    vertical: str,
) -> None:
    """Write the DEM of a terrain that is known everywhere: its exact heights at posts, rounded.

    Parameters
    ----------
    terrain : callable (lon, lat) -> heights
        Degrees to ellipsoidal metres, all ``(N,)``.
    box : (2, 2)
        Least and greatest x, y in `crs` that the DEM covers; its posts are on multiples of `step`.
    crs, vertical : str
        EPSG codes of the map and of the height datum.
    """
    low, high = np.asarray(box, dtype=np.float64)
    west, south = np.floor(low / step) * step
    columns, rows = np.ceil((high - (west, south)) / step).astype(int).tolist()
    north = south + rows * step
    x, y = np.meshgrid(west + step * (np.arange(columns) + 0.5), north - step * (np.arange(rows) + 0.5))
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    lon, lat = to_map.transform(x.ravel(), y.ravel(), direction="INVERSE")
    heights = terrain(lon, lat) - Vertical.parse(vertical).undulation(lon, lat)
    # A decimetre is finer than any DEM of such a scene, and packs well.
    heights = np.round(heights, 1).reshape(rows, columns)
    write_dem(path, heights, (west, north), step, f"{crs}+{vertical.split(':')[1]}")


def write_ellipsoidal(path: str | os.PathLike[str], surface: Surface, box: ArrayLike) -> None:
    """Write heights above the WGS 84 ellipsoid as a coarse DEM in EPSG:4326, for programs without height datums.

    Voids get the median height, because such programs take them for heights.

    Parameters
    ----------
    box : (2, 2)
        Least and greatest longitude and latitude.

    Raises
    ------
    CoverageError
        If the surface has no height there.
    """
    low, high = np.asarray(box, dtype=np.float64)
    step = max(_COARSE, float((high - low).max()) / _MOST_POSTS)
    columns, rows = np.ceil((high - low) / step).astype(int).tolist()
    lon, lat = low[0] + step * (np.arange(columns) + 0.5), high[1] - step * (np.arange(rows) + 0.5)
    heights = np.stack([surface.heights(np.stack([lon, np.full(columns, y)], axis=1), "EPSG:4326") for y in lat])
    known = np.isfinite(heights)
    if not known.any():
        raise CoverageError(
            "the DEM has no heights under the images",
            field="surface.dem",
            remedy="give a DEM of the ground that the images show",
        )
    heights[~known] = np.median(heights[known])
    write_dem(path, heights, (float(low[0]), float(high[1])), step, "EPSG:4326")
