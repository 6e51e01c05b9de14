"""Pixels of an ortho on the grid of another one.

It may have another grid or another CRS. On the same grid its pixels are copied. Otherwise GDAL's warper resamples them
with its exact transformer, in blocks at fixed places and with kernels of fixed size, so that the result does not depend
on tiles, memory or threads.
"""

from __future__ import annotations

import math
import os
import threading
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.shell import converted, typed
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.naming import crs_text
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.source import MEMORY, Grid, RasterSource, first_line, open_dataset

#: Part of a pixel by which grids may differ: rounding of coordinates, no more.
_SAME = 1e-3
#: GDAL gives alpha 0 to 255 as the share of a pixel's footprint that has values: of a pixel at least half.
_ENOUGH = 128


@reads("make this ortho again")
def grid_of(path: str | PathLike[str], **access: Any) -> Grid:
    """Return the grid of an orthoimage; `access` as of `raster.source.open_dataset`.

    Raises
    ------
    InputError
        If it is none: a raster without a CRS, or one that is not north up.
    """
    dataset = open_dataset(path, **access)
    if not dataset.GetProjection():
        raise InputError(
            "this raster has no coordinate system",
            field="CRS",
            remedy=f"rectify the image, or state its CRS: `gdal_edit.py -a_srs CRS {typed(path)}`",
        )
    left, dx, skew, top, other, dy = dataset.GetGeoTransform()
    if skew or other or dx <= 0 or dy >= 0:
        raise InputError(
            "this raster is not north-up",
            field="geotransform",
            remedy=f"resample it: `gdalwarp {converted(path, 'north_up')}`",
        )
    crs = parse_crs(dataset.GetProjection())
    return Grid(crs, left, top, dx, -dy, dataset.RasterXSize, dataset.RasterYSize)


class Regridded:
    """An ortho on the grid of another one; thread-safe.

    Parameters
    ----------
    grid : Grid
        Grid of its pixels.
    resampling : str
        GDAL's name of the resampling from another grid.

    Raises
    ------
    InputError
        If it is not an ortho, or does not overlap the grid.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        grid: Grid,
        *,
        resampling: str = "bilinear",
        memory: int = MEMORY,
        **access: Any,
    ) -> None:
        self.path, self._grid, self._resampling = path, grid, resampling
        self._memory, self._local = memory, threading.local()
        self._source = RasterSource(path, memory=memory, **access)
        self._own = grid_of(path, **access)
        self._check_overlap()
        self._offset = _offset(grid, self._own)

    @property
    def block(self) -> int:
        """Bytes of the blocks that are held to read a pixel."""
        return self._source.block

    def require(self, profile: Profile) -> None:
        """Raise an `InputError` unless its pixels are as those of an ortho of this profile: bands, type and meaning."""
        own = f"{counted(self._source.count, 'band')} of {self._source.dtype}"
        needed = f"{counted(profile.count, 'band')} of {profile.dtype}"
        if own != needed:
            raise InputError(
                f"this ortho has {own}, but {needed} is needed to fill gaps",
                file=self.path,
                remedy=Text(
                    "make it with the same bands and type (",
                    Setting("output.bands"),
                    ", ",
                    Setting("output.dtype"),
                    ")",
                ),
            )

        what = profile.unlike(Profile.of(self._source), "the image", Path(self.path).name)
        if what:
            raise InputError(what, file=self.path, remedy="give an ortho of the same kind of product")

    def read(self, left: int, top: int, width: int, height: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels and which are valid ``(bands, height, width)`` of a window of the grid."""
        source, grid = self._source, self._grid
        pixels = np.zeros((source.count, height, width), dtype=source.dtype)
        valid = np.zeros(pixels.shape, dtype=bool)
        if self._offset is None:
            west, north, inside, read = left, top, (grid.width, grid.height), self._resampled
        else:
            west, north = left - self._offset[0], top - self._offset[1]
            inside, read = (source.width, source.height), self._copied
        # Neither GDAL nor a source reads a window that reaches outside.
        first, last = max(west, 0), min(west + width, inside[0])
        upper, lower = max(north, 0), min(north + height, inside[1])
        if first < last and upper < lower:
            part = (slice(None), slice(upper - north, lower - north), slice(first - west, last - west))
            pixels[part], valid[part] = read(first, upper, last - first, lower - upper)
        return pixels, valid

    def _copied(self, left: int, top: int, width: int, height: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels and validity of a window of the ortho itself."""
        pixels = self._source.read(left, top, width, height)
        valid = self._source.read_valid(left, top, pixels)
        return pixels, np.ones(pixels.shape, dtype=bool) if valid is None else valid

    def _resampled(self, left: int, top: int, width: int, height: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels and validity of a window within the grid."""
        try:
            stack = self._warped.ReadAsArray(left, top, width, height)
        except RuntimeError as error:
            raise InputError(
                f"GDAL cannot resample this ortho ({first_line(error)})", file=self.path, remedy="make it again"
            ) from error
        # GDAL resamples an alpha band of the ortho into its own.
        pixels = stack[: self._source.count]
        valid = np.repeat(stack[-1:] >= _ENOUGH, len(pixels), axis=0)
        # Alpha is that of all bands together; a band of its own lacks what is empty in it.
        for band, value in enumerate(self._empty):
            valid[band] &= pixels[band] != pixels.dtype.type(value)
        return pixels, valid & ~np.isnan(pixels) if pixels.dtype.kind == "f" else valid

    @property
    def _empty(self) -> tuple[float, ...]:
        """The nodata value of each band; NaN if floating point has no other mark, none if all bands share a mask."""
        source = self._source
        values = tuple(value for value in source.nodata if value is not None)
        if not values and source.validity == "all" and source.dtype.kind == "f":
            return (math.nan,) * source.count
        return values if len(values) == source.count else ()

    @property
    def _warped(self) -> gdal.Dataset:
        """The ortho on the grid, with alpha as its last band; of the calling thread."""
        if not hasattr(self._local, "warped"):
            # The kernels of each block as wide as at the middle: GDAL would take what it finds in the block.
            scales, nodata = self._scales(), " ".join(map(repr, self._empty)) or None
            self._local.warped = gdal.Warp(
                "",
                self._source.dataset,
                format="VRT",
                dstSRS=self._grid.crs.to_wkt(),
                srcSRS=self._own.crs.to_wkt(),
                outputBounds=self._grid.extent,
                width=self._grid.width,
                height=self._grid.height,
                resampleAlg=self._resampling,
                errorThreshold=0.0,
                srcNodata=nodata,
                dstNodata=nodata,
                dstAlpha=True,
                warpMemoryLimit=self._memory // 8,
                warpOptions=[f"XSCALE={scales[0]!r}", f"YSCALE={scales[1]!r}", "UNIFIED_SRC_NODATA=PARTIAL"],
            )
        return self._local.warped

    def _scales(self) -> tuple[float, float]:
        """Return how many pixels of the grid make one of this ortho, at most 1, per axis."""
        grid = self._grid
        columns = grid.width / 2 + np.array([-0.5, 0.5, 0.0, 0.0])
        rows = grid.height / 2 + np.array([0.0, 0.0, -0.5, 0.5])
        to_own = pyproj.Transformer.from_crs(grid.crs, self._own.crs, always_xy=True)
        x, y = (np.asarray(part) for part in to_own.transform(*grid.xy(columns, rows)))
        across = (np.abs(x[1] - x[0]) + np.abs(x[3] - x[2])) / self._own.dx
        down = (np.abs(y[1] - y[0]) + np.abs(y[3] - y[2])) / self._own.dy
        return min(1.0, 1.0 / float(across)), min(1.0, 1.0 / float(down))

    def _check_overlap(self) -> None:
        own, grid = self._own, self._grid
        box = warped_bounds(grid, own.crs)
        xmin, ymin, xmax, ymax = own.extent
        if not (box[0] < xmax and box[2] > xmin and box[1] < ymax and box[3] > ymin):
            raise InputError(
                f"this ortho ({crs_text(own.crs)}) does not overlap the scene",
                file=self.path,
                remedy="give an ortho of this place, or leave it out",
            )


def part_of(grid: Grid, left: float, top: float, width: int, height: int) -> Grid:
    """Return a window of a grid, which may reach outside."""
    return Grid(grid.crs, grid.left + left * grid.dx, grid.top - top * grid.dy, grid.dx, grid.dy, width, height)


def coarser(grid: Grid, factor: int, width: int, height: int) -> Grid:
    """Return a grid with the corner of another one, each pixel of which is `factor` x `factor` of its pixels."""
    return Grid(grid.crs, grid.left, grid.top, grid.dx * factor, grid.dy * factor, width, height)


def warped_bounds(grid: Grid, crs: pyproj.CRS) -> tuple[float, float, float, float]:
    """Return xmin, ymin, xmax and ymax of a grid in another CRS; infinite if it is nowhere there.

    Across longitude 180, xmax is above 180.
    """
    if grid.crs == crs:
        return grid.extent
    try:
        to_crs = pyproj.Transformer.from_crs(grid.crs, crs, always_xy=True)
        xmin, ymin, xmax, ymax = to_crs.transform_bounds(*grid.extent, densify_pts=21)
    except pyproj.exceptions.ProjError:
        return (math.inf,) * 4
    return xmin, ymin, xmax + 360.0 if crs.is_geographic and xmax < xmin else xmax, ymax


def _offset(grid: Grid, own: Grid) -> tuple[int, int] | None:
    """Return column and row in one grid at which another begins; None where their pixels are not the same."""
    if grid.crs != own.crs or not all(
        math.isclose(one, other, rel_tol=1e-9) for one, other in ((grid.dx, own.dx), (grid.dy, own.dy))
    ):
        return None
    columns, rows = (own.left - grid.left) / grid.dx, (grid.top - own.top) / grid.dy
    if max(abs(columns - round(columns)), abs(rows - round(rows))) > _SAME:
        return None
    return round(columns), round(rows)
