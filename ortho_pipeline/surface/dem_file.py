"""The file of a DEM: the grid of its samples, and their heights in metres."""

from __future__ import annotations

import functools
import math
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike
from osgeo import gdal
from pyproj.exceptions import CRSError

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.files.shell import converted, typed
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.geodesy.distortion import metres_of_steps
from ortho_pipeline.geodesy.ellipsoid import longitudes_near
from ortho_pipeline.raster.source import first_line, open_pixels
from ortho_pipeline.surface.base import Array

#: Heights (m) outside of this are voids, declared or not.
SANE_HEIGHTS = (-500.0, 9000.0)
#: The void of DEMs of 16 bits with sign, declared or not; a scale can make it look like a height.
_VOID_16_BITS = -32768
#: No DEM has samples that are nearer to each other (m); work along a ray is counted in samples.
_FINEST = 1e-3
#: Option of gdal_edit.py for a geotransform.
_CORNERS = "-a_ullr WEST NORTH EAST SOUTH"

Affine = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class SampleGrid:
    """The grid of the samples of a DEM.

    Parameters
    ----------
    crs : pyproj.CRS
        Horizontal CRS, x first.
    shape : tuple
        (rows, columns).
    crs_from_pixel : tuple of 6 floats
        ``x = a + b u + c v``, ``y = d + e u + f v``; (0, 0) is the centre of the first sample.
    first_column : int
        Column of the file that is the first of a global grid.
    """

    crs: pyproj.CRS
    shape: tuple[int, int]
    crs_from_pixel: Affine
    first_column: int = 0

    @functools.cached_property
    def pixel_from_crs(self) -> Affine:
        """``u = a + b x + c y``, ``v = d + e x + f y``."""
        x, a, b, y, c, d = self.crs_from_pixel
        inverse = np.linalg.inv([[a, b], [c, d]])
        shift = -inverse @ [x, y]
        return (
            float(shift[0]),
            float(inverse[0, 0]),
            float(inverse[0, 1]),
            float(shift[1]),
            float(inverse[1, 0]),
            float(inverse[1, 1]),
        )

    @functools.cached_property
    def sample_size(self) -> float:
        """Larger side of a sample, in metres on the ground in the middle of the grid."""
        x, a, b, y, c, d = self.crs_from_pixel
        v, u = (count / 2 for count in self.shape)
        middle = np.array([[x + a * u + b * v, y + c * u + d * v, 0.0]])
        sides = np.array([(a, c), (b, d)])
        size = float(np.max([metres_of_steps(self.crs, middle, side) for side in sides]))
        if math.isfinite(size):
            return size
        # The middle is outside the domain of the CRS: metres on the map.
        unit = 111320.0 if self.crs.is_geographic else self.crs.axis_info[0].unit_conversion_factor
        return unit * float(np.linalg.norm(sides, axis=1).max())

    def around(self, lon: float) -> SampleGrid:
        """Return a global grid with the seam opposite to `lon` (degrees); any other grid unchanged."""
        x, a, b, y, c, d = self.crs_from_pixel
        columns = self.shape[1]
        if not self.crs.is_geographic or b or c or abs(abs(a) * columns - 360) > 1e-6 * abs(a):
            return self
        shift = round((lon - (x + a * (columns - 1) / 2)) / a)
        if not shift:
            return self
        first = (self.first_column + shift) % columns
        return replace(self, first_column=first, crs_from_pixel=(x + shift * a, a, b, y, c, d))

    def samples_at(self, xy: ArrayLike) -> Array:
        """Return sample coordinates (u, v) ``(N, 2)`` of positions (x, y) ``(N, 2)`` in `crs`.

        Longitudes are taken modulo 360 into the range of the DEM, so that it may run from -180 or from 0 degrees.
        """
        xy = np.asarray(xy, dtype=float)
        x, y = xy[:, 0], xy[:, 1]
        if self.crs.is_geographic:
            rows, columns = self.shape
            x0, a, b, *_ = self.crs_from_pixel
            middle = x0 + a * (columns - 1) / 2 + b * (rows - 1) / 2
            far = np.abs(x - middle) > 180
            if far.any():
                x = np.where(far, longitudes_near(x, middle), x)
        p = self.pixel_from_crs
        return np.stack([p[0] + p[1] * x + p[2] * y, p[3] + p[4] * x + p[5] * y], axis=1)

    def lonlat(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return longitudes and latitudes (degrees) ``(N,)`` of sample coordinates."""
        p = self.crs_from_pixel
        ground = np.stack([p[0] + p[1] * u + p[2] * v, p[3] + p[4] * u + p[5] * v, np.zeros(len(u))], axis=1)
        lonlat = ground_transform(self.crs, "EPSG:4979")(ground)
        return lonlat[:, 0], lonlat[:, 1]


@functools.lru_cache(maxsize=32)
def _crs_of(wkt: str) -> tuple[pyproj.CRS, pyproj.CRS]:
    """Return a CRS and its horizontal part, the same for the many files of one DEM."""
    crs = parse_crs(wkt)
    plane = horizontal(crs)
    ground_transform(plane, "EPSG:4979")
    return crs, plane


@dataclass(frozen=True, eq=False)
class DemFile:
    """The samples of a file; every thread has its own GDAL handle.

    Parameters
    ----------
    path : str
    access : mapping
        What `raster.open_pixels` may do for it.
    """

    path: str
    access: Mapping[str, Any]
    _local: threading.local = field(default_factory=threading.local, init=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        # Workers elsewhere have another working folder.
        return DemFile, (os.path.abspath(self.path) if os.path.isfile(self.path) else self.path, self.access)

    @property
    def dataset(self) -> gdal.Dataset:
        """The handle of this thread."""
        if not hasattr(self._local, "dataset"):
            self._local.dataset, self._local.block = open_pixels(self.path, **self.access)
        return self._local.dataset

    @property
    def block(self) -> int:
        """Bytes that GDAL decodes at once to read a sample."""
        return self._local.block if self.dataset else 0

    @property
    def unit(self) -> str:
        """The unit of the heights, as the file calls it."""
        return self.dataset.GetRasterBand(1).GetUnitType()

    @property
    def files(self) -> tuple[str, ...]:
        """The file."""
        return (self.path,)

    def close(self) -> None:
        """Let go of the handle of this thread; it is opened again when it is needed."""
        vars(self._local).clear()

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        """Return the full CRS of the file and the grid of its samples.

        Raises
        ------
        CrsError
            If there is no usable georeference.
        InputError
            If the samples are no heights.
        """
        dataset = self.dataset
        reference, transform = dataset.GetSpatialRef(), dataset.GetGeoTransform(can_return_null=True)
        if reference is None or transform is None:
            missing = "CRS" if reference is None else "geotransform"
            raise CrsError(
                f"this DEM has no {missing}",
                file=self.path,
                field=missing,
                remedy=self._set("-a_srs EPSG:CODE" if reference is None else _CORNERS),
            )
        crs, plane = self._crs(reference.ExportToWkt(["FORMAT=WKT2_2018"]))
        x, a, b, y, c, d = transform
        if not np.isfinite(transform).all() or abs(a * d - b * c) <= 1e-14 * (abs(a) + abs(b)) * (abs(c) + abs(d)):
            raise CrsError(
                f"the geotransform {transform} of this DEM is degenerate",
                file=self.path,
                field="geotransform",
                remedy=self._set(_CORNERS),
            )
        if gdal.DataTypeIsComplex(dataset.GetRasterBand(1).DataType):
            raise InputError(
                "the pixels of this DEM are complex numbers, not heights",
                file=self.path,
                field="band 1",
                remedy=f"extract the real part: `gdal_translate -ot Float32 {converted(self.path, 'real')}`",
            )
        if dataset.GetRasterBand(1).GetColorInterpretation() == gdal.GCI_RedBand:
            raise InputError(
                "the pixels of this DEM are colours, not heights",
                file=self.path,
                field="band 1",
                remedy="give the raster of heights from which this picture was made",
            )
        # GDAL counts from the corner of the first pixel; heights belong to the centres.
        centre = (x + 0.5 * (a + b), a, b, y + 0.5 * (c + d), c, d)
        grid = SampleGrid(plane, (dataset.RasterYSize, dataset.RasterXSize), centre)
        if grid.sample_size < _FINEST:
            raise CrsError(
                f"the samples of this DEM would be {grid.sample_size:.1g} m apart",
                file=self.path,
                field="geotransform",
                remedy=self._set(_CORNERS),
            )
        return crs, grid

    def _crs(self, wkt: str) -> tuple[pyproj.CRS, pyproj.CRS]:
        """Return the CRS and its horizontal part."""
        try:
            return _crs_of(wkt)
        except (CrsError, CRSError) as error:
            raise CrsError(
                f"the CRS of this DEM cannot be used ({getattr(error, 'message', error)})",
                file=self.path,
                field="CRS",
                remedy=self._set("-a_srs EPSG:CODE"),
            ) from error

    def _set(self, option: str) -> str:
        """Return the remedy for a georeference that is missing or wrong."""
        return f"set the right one: `gdal_edit.py {option} {typed(self.path)}`"

    def read(self, left: int, top: int, width: int, height: int, metres_per_unit: float) -> Array:
        """Return the heights ``(height, width)`` of a window inside the file in metres; NaN for voids."""
        band = self.dataset.GetRasterBand(1)
        try:
            raw = band.ReadAsArray(left, top, width, height)
            mask = None
            flags = band.GetMaskFlags()
            if flags & gdal.GMF_PER_DATASET or not flags:  # 0: a mask of this band alone
                mask = band.GetMaskBand().ReadAsArray(left, top, width, height)
        except RuntimeError as error:
            raise InputError(
                f"the heights cannot be read ({first_line(error, self.path)})",
                file=self.path,
                remedy="the file is damaged: copy it again",
            ) from error
        scale, offset = (1.0 if band.GetScale() is None else band.GetScale()), band.GetOffset() or 0.0
        heights = raw.astype(float)
        if (scale * metres_per_unit, offset) != (1.0, 0.0):
            heights = heights * (scale * metres_per_unit) + offset * metres_per_unit
        with np.errstate(invalid="ignore"):
            void = ~((heights >= SANE_HEIGHTS[0]) & (heights <= SANE_HEIGHTS[1]))
        if raw.dtype == np.int16:
            void |= raw == _VOID_16_BITS
        nodata = band.GetNoDataValue()
        if nodata is not None and math.isfinite(nodata):
            with np.errstate(over="ignore"):
                void |= raw == (raw.dtype.type(nodata) if raw.dtype.kind == "f" else nodata)
        if mask is not None:
            void |= mask == 0
        heights[void] = np.nan
        return heights
