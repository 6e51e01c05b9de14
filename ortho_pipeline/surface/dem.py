"""Heights of a surface above the ellipsoid, and where a ray meets it.

What a DEM's numbers are measured above is decided once, in `Surface.open`, and undone where samples are read: scale,
unit, voids, geoid. Everything after sees ellipsoidal metres, or NaN.
"""

from __future__ import annotations

import copy
import math
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray
from osgeo import gdal, osr
from pyproj.exceptions import CRSError

from ortho_pipeline.errors import CoverageError, CrsError, DatumError, InputError
from ortho_pipeline.geodesy.crs import Vertical, declared_vertical, ground_transform, horizontal, parse_crs
from ortho_pipeline.geodesy.datum import dem_unit, dem_vertical, dem_vertical_remedy
from ortho_pipeline.raster.output import raster_output, written
from ortho_pipeline.raster.source import first_line, open_pixels
from ortho_pipeline.surface.voids import nearest_heights

Array = NDArray[np.float64]

#: Heights (m) outside of this are voids, declared or not.
SANE_HEIGHTS = (-500.0, 9000.0)
#: ``fill='nearest'`` looks so far for a valid height: samples, and metres after which real terrain is another one.
NEAREST_REACH, NEAREST_METRES = 512, 20_000.0
#: The undulation is computed exactly on a lattice no wider than this (m) and interpolated between: within 2 mm.
UNDULATION_SPACING = 500.0
#: No DEM has samples that are nearer to each other (m); work along a ray is counted in samples.
_FINEST = 1e-3
_TILE = 256
_CACHED_TILES = 64


class Surface:
    """A DEM, or a plane of constant height, as ellipsoidal heights.

    Make it with `open` or `constant`. Safe to use from several threads: each has a GDAL handle of its own.

    Attributes
    ----------
    crs : pyproj.CRS
        Horizontal system of the samples, x first.
    shape : tuple
        (rows, columns) of samples.
    pixel_from_crs : tuple of 6 floats
        ``u = a + b x + c y``, ``v = d + e x + f y``; (0, 0) is the centre of the first sample.
    constant_height : float or None
        The height of a plane, None for a DEM.
    fill : 'error', 'mask', 'nearest' or float
        What stands for a void: NaN for the first two; a height with the others. `with_fill` changes it in a copy.
    block : int
        Bytes that GDAL decodes at once to read a sample.
    provenance : dict
        Path, declared and used height datum, warnings; JSON values.
    """

    def __init__(self, *, constant_height: float | None = None) -> None:
        self.constant_height = constant_height
        self.crs = pyproj.CRS.from_epsg(4326)
        self.shape = (0, 0)
        self.pixel_from_crs = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        self._fill: str | float = "error"
        self.provenance: dict[str, Any] = {"constant_height": constant_height}
        self.vertical = Vertical("ellipsoid")
        self._path, self.block = "", 0
        self._access: dict[str, Any] = {}
        self._metres_per_unit, self._scale, self._offset = 1.0, 1.0, 0.0
        self._crs_from_pixel = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
        self._roll = 0
        self._spacing = 1
        self._range: tuple[float, float] | None = None
        self._forget()

    def _forget(self) -> None:
        self._local = threading.local()
        self._lock = threading.Lock()
        self._tiles: OrderedDict[tuple[int, int, bool], Array] = OrderedDict()

    def __copy__(self) -> Surface:
        # What is cached follows from fill rule and seam: no two surfaces share it, nor the record of what they are.
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.provenance = dict(self.provenance)
        other._forget()
        return other

    @property
    def fill(self) -> str | float:
        """What stands for a void."""
        return self._fill

    def with_fill(self, fill: str | float) -> Surface:
        """Return this surface with another rule for voids; this one stays as it is.

        Raises
        ------
        InputError
            If there is no such rule.
        """
        other = copy.copy(self)
        other._fill, other._range = _parse_fill(fill), None
        if self.constant_height is None:
            other.provenance["fill"] = other._fill
        return other

    @classmethod
    def constant(cls, height: float) -> Surface:
        """Return a plane at an ellipsoidal height (m)."""
        if not math.isfinite(height):
            raise InputError(f"{height} is not a height", field="height", remedy="give ellipsoidal metres")
        return cls(constant_height=float(height))

    @classmethod
    def open(
        cls,
        path: str | os.PathLike[str],
        vertical: Vertical | str | None = None,
        override: bool = False,
        fill: str | float = "error",
        allow_network: bool = False,
        roots: Sequence[str | os.PathLike[str]] = (),
    ) -> Surface:
        """Open a DEM.

        Parameters
        ----------
        vertical : Vertical or str, optional
            What the heights are measured above; needed where the DEM does not say it.
        override : bool
            Let `vertical` stand against a datum that the DEM declares by an authority code.
        fill : 'error', 'mask', 'nearest' or float
            See the class; a number is an ellipsoidal height in metres.

        Raises
        ------
        DatumError
            If the height datum is unknown, contradicted, or its geoid grid is not installed or does not reach here.
        CrsError
            If the DEM has no usable georeference.
        InputError
            If it cannot be opened.
        """
        surface = cls()
        surface._path, surface._access = os.fspath(path), {"allow_network": allow_network, "roots": roots}
        surface._fill = _parse_fill(fill)
        dataset = surface._dataset()
        crs = surface._place(dataset)
        declared = declared_vertical(crs)
        option = None if vertical is None else Vertical.parse(vertical)
        surface.vertical, warnings = dem_vertical(surface._path, declared, option, override)
        surface._metres_per_unit = dem_unit(surface._path, dataset.GetRasterBand(1).GetUnitType(), declared)
        surface.provenance = {
            "path": surface._path,
            "crs": surface.crs.name,
            "declared_vertical": declared.name if declared else None,
            "declared_by": None if declared is None else ("code" if declared.certain else "name"),
            "option": option.name if option else None,
            "override": override,
            "vertical": surface.vertical.name,
            "vertical_label": surface.vertical.label,
            "metres_per_unit": surface._metres_per_unit,
            "fill": surface.fill,
            "warnings": warnings,
        }
        surface._check_geoid()
        return surface

    # -- opening -----------------------------------------------------------------------------------------------------

    def _dataset(self) -> gdal.Dataset:
        if not hasattr(self._local, "dataset"):
            self._local.dataset, self.block = open_pixels(self._path, **self._access)
        return self._local.dataset

    def _place(self, dataset: gdal.Dataset) -> pyproj.CRS:
        """Take size, CRS and geotransform over from the dataset; return the full CRS."""
        reference, transform = dataset.GetSpatialRef(), dataset.GetGeoTransform(can_return_null=True)
        if reference is None or transform is None:
            missing = "CRS" if reference is None else "geotransform"
            raise CrsError(
                f"this DEM has no {missing}",
                file=self._path,
                field=missing,
                remedy="set it with gdal_edit.py -a_srs / -a_ullr",
            )
        try:
            crs = pyproj.CRS.from_wkt(reference.ExportToWkt(["FORMAT=WKT2_2018"]))
            self.crs = horizontal(crs)
            ground_transform(self.crs, "EPSG:4979")
        except (CrsError, CRSError) as error:
            raise CrsError(
                f"the CRS of this DEM cannot be used ({getattr(error, 'message', error)})",
                file=self._path,
                field="CRS",
                remedy="set a CRS of known datum with gdal_edit.py -a_srs",
            ) from error
        x, a, b, y, c, d = transform
        if not np.isfinite(transform).all() or abs(a * d - b * c) <= 1e-14 * (abs(a) + abs(b)) * (abs(c) + abs(d)):
            raise CrsError(
                f"the geotransform {transform} of this DEM is degenerate", file=self._path, field="geotransform",
                remedy="set it with gdal_edit.py -a_ullr",
            )  # fmt: skip
        self.shape = dataset.RasterYSize, dataset.RasterXSize
        band = dataset.GetRasterBand(1)
        if gdal.DataTypeIsComplex(band.DataType):
            raise InputError("complex numbers are not heights", file=self._path, field="band 1",
                             remedy="choose one part of them with gdal_calc.py")  # fmt: skip
        # GDAL counts from the corner of the first pixel; heights belong to the centres.
        self._set_affine((x + 0.5 * (a + b), a, b, y + 0.5 * (c + d), c, d))
        scale, offset = band.GetScale(), band.GetOffset()
        self._scale, self._offset = (1.0 if scale is None else scale), (0.0 if offset is None else offset)
        if self.sample_size < _FINEST:
            raise CrsError(
                f"the samples of this DEM would be {self.sample_size:.1g} m apart", file=self._path,
                field="geotransform", remedy="set the true one with gdal_edit.py -a_ullr",
            )  # fmt: skip
        self._spacing = int(np.clip(UNDULATION_SPACING / self.sample_size, 1, 64))
        return crs

    def _set_affine(self, crs_from_pixel: tuple[float, float, float, float, float, float]) -> None:
        x, a, b, y, c, d = self._crs_from_pixel = crs_from_pixel
        inverse = np.linalg.inv([[a, b], [c, d]])
        shift = -inverse @ [x, y]
        self.pixel_from_crs = (
            float(shift[0]), float(inverse[0, 0]), float(inverse[0, 1]),
            float(shift[1]), float(inverse[1, 0]), float(inverse[1, 1]),
        )  # fmt: skip

    @property
    def sample_size(self) -> float:
        """Larger side of a sample, in metres (on the equator where the DEM is in degrees)."""
        _, a, b, _, c, d = self._crs_from_pixel
        unit = 111320.0 if self.crs.is_geographic else self.crs.axis_info[0].unit_conversion_factor
        return unit * max(math.hypot(a, c), math.hypot(b, d))

    def _check_geoid(self) -> None:
        """Fail now, with the DEM's name, if the geoid grid is missing or does not reach any part of the DEM."""
        rows, columns = self.shape
        v, u = (axis.ravel() for axis in np.meshgrid(np.linspace(0, rows - 1, 5), np.linspace(0, columns - 1, 5)))
        try:
            undulation = self.vertical.undulation(*self._lonlat(u, v))
        except DatumError as error:
            raise DatumError(
                error.message, file=self._path, field="surface.vertical", remedy=dem_vertical_remedy(error.remedy or "")
            ) from error
        if not np.isfinite(undulation).any():
            raise DatumError(
                f"the geoid grid of {self.vertical.label} does not reach this DEM",
                file=self._path,
                field="surface.vertical",
                remedy=dem_vertical_remedy(),
            )

    def around(self, lon: float) -> Surface:
        """Return this surface with the seam of a global DEM opposite to `lon` (degrees); any other DEM unchanged.

        Sample coordinates are then continuous about `lon`, also over the antimeridian.
        """
        x, a, b, y, c, d = self._crs_from_pixel
        columns = self.shape[1]
        if not self.crs.is_geographic or b or c or abs(abs(a) * columns - 360) > 1e-6 * abs(a):
            return self
        shift = round((lon - (x + a * (columns - 1) / 2)) / a)
        other = copy.copy(self)
        other._roll = (self._roll + shift) % columns
        other._set_affine((x + shift * a, a, b, y, c, d))
        return other

    # -- places ------------------------------------------------------------------------------------------------------

    def samples_at(self, xy: ArrayLike) -> Array:
        """Return sample coordinates (u, v) ``(N, 2)`` of positions (x, y) ``(N, 2)`` in `crs`.

        Longitudes are taken modulo 360 into the range of the DEM, so that it may run from -180 or from 0 degrees.
        """
        xy = np.asarray(xy, dtype=float)
        x, y = xy[:, 0], xy[:, 1]
        if self.crs.is_geographic:
            rows, columns = self.shape
            x0, a, b, *_ = self._crs_from_pixel
            middle = x0 + a * (columns - 1) / 2 + b * (rows - 1) / 2
            far = np.abs(x - middle) > 180
            if far.any():
                x = np.where(far, middle + np.remainder(x - middle + 180, 360) - 180, x)
        p = self.pixel_from_crs
        return np.stack([p[0] + p[1] * x + p[2] * y, p[3] + p[4] * x + p[5] * y], axis=1)

    def _lonlat(self, u: Array, v: Array) -> tuple[Array, Array]:
        p = self._crs_from_pixel
        ground = np.stack([p[0] + p[1] * u + p[2] * v, p[3] + p[4] * u + p[5] * v, np.zeros(len(u))], axis=1)
        lonlat = ground_transform(self.crs, "EPSG:4979")(ground)
        return lonlat[:, 0], lonlat[:, 1]

    # -- heights -----------------------------------------------------------------------------------------------------

    def heights(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> Array:
        """Return heights ``(N,)`` at positions ``(N, 2)`` (x, y) of `crs` (that of the surface by default).

        Bilinear between sample centres; NaN outside and beside a void, unless `fill` gives them a height.
        """
        return self._heights(xy, crs, filled=True)

    def coverage(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> float:
        """Return the share (0 to 1) of positions ``(N, 2)`` that have a height of their own, not a filled one."""
        heights = self._heights(xy, crs, filled=False)
        return float(np.isfinite(heights).mean()) if len(heights) else 1.0

    def _heights(self, xy: ArrayLike, crs: str | pyproj.CRS | None, filled: bool) -> Array:
        xy = np.asarray(xy, dtype=float)
        if xy.ndim != 2 or xy.shape[1] < 2:
            raise InputError(f"positions have the shape (N, 2), not {xy.shape}")
        if self.constant_height is not None:
            return np.where(np.isfinite(xy[:, :2]).all(axis=1), self.constant_height, np.nan)
        if crs is not None:
            transform = ground_transform(parse_crs(crs), self.crs)
            xy = transform(np.column_stack([xy[:, :2], np.zeros(len(xy))]))
        u, v = self.samples_at(xy[:, :2]).T
        out = np.full(len(u), np.nan)
        rows, columns = self.shape
        finite = np.isfinite(u) & np.isfinite(v)
        if filled and self.fill == "nearest":
            across, down, u, v = u, v, np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
            with np.errstate(invalid="ignore"):
                finite &= np.hypot(u - across, v - down) <= self.nearest_reach
        with np.errstate(invalid="ignore"):
            inside = finite & (u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1)
        index = np.flatnonzero(inside)
        tiles = np.stack([v[index] // _TILE, u[index] // _TILE], axis=1).astype(int)
        unique, member = np.unique(tiles, axis=0, return_inverse=True)
        order = np.argsort(member.ravel(), kind="stable")
        ends = np.cumsum(np.bincount(member.ravel(), minlength=len(unique)))
        for (row, column), these in zip(unique.tolist(), np.split(index[order], ends[:-1]), strict=False):
            tile = self._tile(row, column, filled)
            out[these] = _bilinear(tile, u[these] - column * _TILE, v[these] - row * _TILE)
        if filled and isinstance(self.fill, float):
            out[finite & np.isnan(out)] = self.fill
        return out

    def _tile(self, row: int, column: int, filled: bool) -> Array:
        key = row, column, filled
        with self._lock:
            if key in self._tiles:
                self._tiles.move_to_end(key)
                return self._tiles[key]
        # One sample more than the step, for the neighbours of the last ones.
        tile = self._window(column * _TILE, row * _TILE, _TILE + 1, _TILE + 1, filled)
        with self._lock:
            self._tiles[key] = tile
            while len(self._tiles) > _CACHED_TILES:
                self._tiles.popitem(last=False)
        return tile

    def window(self, u0: int, v0: int, nu: int, nv: int) -> Array:
        """Return the heights ``(nv, nu)`` of samples, from column `u0` and row `v0`; it may reach outside.

        NaN for a void and outside of the DEM, unless `fill` gives them a height. Does not depend on how a
        larger window is cut into smaller ones.
        """
        return self._window(int(u0), int(v0), int(nu), int(nv), filled=True)

    def _window(self, u0: int, v0: int, nu: int, nv: int, filled: bool) -> Array:
        if self.constant_height is not None:
            return np.full((nv, nu), self.constant_height)
        if filled and self.fill == "nearest":
            return nearest_heights(self._read, self.shape, (u0, v0, nu, nv), self.nearest_reach)
        rows, columns = self.shape
        left, top = max(u0, 0), max(v0, 0)
        right, bottom = min(u0 + nu, columns), min(v0 + nv, rows)
        out = np.full((nv, nu), np.nan)
        if right > left and bottom > top:
            out[top - v0 : bottom - v0, left - u0 : right - u0] = self._read(left, top, right - left, bottom - top)
        if filled and isinstance(self.fill, float):
            out[np.isnan(out)] = self.fill
        return out

    @property
    def nearest_reach(self) -> int:
        """How far (samples) ``fill='nearest'`` looks for a height."""
        return int(np.clip(NEAREST_METRES / self.sample_size, 1, NEAREST_REACH))

    def _read(self, left: int, top: int, width: int, height: int) -> Array:
        """Return ellipsoidal heights of a window inside the DEM; NaN for voids."""
        columns = self.shape[1]
        if self._roll:
            first = (left + self._roll) % columns
            split = min(width, columns - first)
            parts = [self._read_metres(first, top, split, height)]
            if split < width:
                parts.append(self._read_metres(0, top, width - split, height))
            heights = np.concatenate(parts, axis=1)
        else:
            heights = self._read_metres(left, top, width, height)
        if not self.vertical.is_ellipsoid:
            heights += self._undulation(left, top, width, height)
        return heights

    def _read_metres(self, left: int, top: int, width: int, height: int) -> Array:
        dataset = self._dataset()
        band = dataset.GetRasterBand(1)
        try:
            raw = band.ReadAsArray(left, top, width, height)
            mask = None
            if band.GetMaskFlags() & gdal.GMF_PER_DATASET:
                mask = band.GetMaskBand().ReadAsArray(left, top, width, height)
        except RuntimeError as error:
            raise InputError(
                f"the heights cannot be read ({first_line(error)})",
                file=self._path,
                remedy="copy the DEM again: it is damaged",
            ) from error
        heights = raw.astype(float) * (self._scale * self._metres_per_unit) + self._offset * self._metres_per_unit
        with np.errstate(invalid="ignore"):
            void = ~((heights >= SANE_HEIGHTS[0]) & (heights <= SANE_HEIGHTS[1]))
        nodata = band.GetNoDataValue()
        if nodata is not None and math.isfinite(nodata):
            with np.errstate(over="ignore"):
                void |= raw == (raw.dtype.type(nodata) if raw.dtype.kind == "f" else nodata)
        if mask is not None:
            void |= mask == 0
        heights[void] = np.nan
        return heights

    def _undulation(self, left: int, top: int, width: int, height: int) -> Array:
        """Return the undulation ``(height, width)`` of samples.

        The lattice lies on multiples of its spacing in the DEM, so a sample's value does not depend on the window.
        """
        step = self._spacing
        first_u, first_v = left // step, top // step
        node_u = np.arange(first_u, (left + width - 1) // step + 2) * step
        node_v = np.arange(first_v, (top + height - 1) // step + 2) * step
        u, v = np.arange(left, left + width), np.arange(top, top + height)
        nodes = self._undulation_at(node_u, node_v) if step > 1 else None
        if nodes is None or not np.isfinite(nodes).all():
            # At the rim of a geoid grid (and of a projection) nodes are missing that no sample needs.
            return self._undulation_at(u, v)
        i, j = u // step - first_u, v // step - first_v
        across, down = (u % step) / step, ((v % step) / step)[:, None]
        along = nodes[:, i] * (1 - across) + nodes[:, i + 1] * across
        return along[j] * (1 - down) + along[j + 1] * down

    def _undulation_at(self, u: NDArray[Any], v: NDArray[Any]) -> Array:
        grid_u, grid_v = np.meshgrid(u.astype(float), v.astype(float))
        return self.vertical.undulation(*self._lonlat(grid_u.ravel(), grid_v.ravel())).reshape(grid_u.shape)

    @property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest height (m) of the whole surface, with a fill height; every sample is read, once."""
        if self._range is None:
            rows, columns = self.shape
            self._range = self.range_within(0, 0, columns, rows)
        return self._range

    def range_within(self, u0: int, v0: int, nu: int, nv: int) -> tuple[float, float]:
        """Return the lowest and the highest height (m) of a window of samples, with a fill height.

        Raises
        ------
        CoverageError
            If there is no valid height in it.
        """
        if self.constant_height is not None:
            return self.constant_height, self.constant_height
        rows, columns = self.shape
        right, bottom = min(u0 + nu, columns), min(v0 + nv, rows)
        low, high = (self.fill, self.fill) if isinstance(self.fill, float) else (math.inf, -math.inf)
        for top in range(max(v0, 0), bottom, 1024):
            for left in range(max(u0, 0), right, 1024):
                heights = self._window(left, top, min(1024, right - left), min(1024, bottom - top), filled=False)
                if not np.isnan(heights).all():
                    low, high = min(low, float(np.nanmin(heights))), max(high, float(np.nanmax(heights)))
        if low > high:
            raise CoverageError(
                "this DEM holds no valid height here", file=self._path, remedy="check its nodata value, unit and extent"
            )
        return low, high


def _bilinear(heights: Array, u: Array, v: Array) -> Array:
    """Interpolate; a void counts only where its weight is not zero."""
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    fu, fv = u - i, v - j
    out = np.zeros(len(u))
    for down, across, weight in (
        (0, 0, (1 - fu) * (1 - fv)),
        (0, 1, fu * (1 - fv)),
        (1, 0, (1 - fu) * fv),
        (1, 1, fu * fv),
    ):
        out += np.where(weight > 0, heights[j + down, i + across] * weight, 0.0)
    return out


def _parse_fill(fill: str | float) -> str | float:
    if isinstance(fill, str) and fill in ("error", "mask", "nearest"):
        return fill
    try:
        height = float(fill)
    except ValueError:
        height = math.nan
    if not math.isfinite(height):
        raise InputError(
            f"{fill!r} does not say how to fill voids",
            field="surface.fill",
            remedy="give error, mask, nearest or an ellipsoidal height in metres",
        )
    return height


# -- writing ---------------------------------------------------------------------------------------------------------


def write_dem(path: str | os.PathLike[str], heights: Array, corner: tuple[float, float], step: float, crs: str) -> None:
    """Write a DEM as GeoTIFF, north up; whole or not at all.

    Parameters
    ----------
    heights : (rows, columns)
        Metres above the vertical datum of `crs`, from the northwest; rounded, they pack much better.
    corner : (float, float)
        Outer corner of the first sample.
    crs : str
        Compound CRS such as EPSG:32636+5773, so that nobody has to say the datum.
    """
    system = osr.SpatialReference()
    system.SetFromUserInput(crs)
    rows, columns = heights.shape
    options = ["COMPRESS=DEFLATE", "PREDICTOR=2", "ZLEVEL=9", "TILED=YES"]
    with raster_output(path) as temporary:
        made = gdal.GetDriverByName("GTiff").Create(str(temporary), columns, rows, 1, gdal.GDT_Float32, options)
        with written(made) as dataset:
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
    """Write the DEM of a terrain that is known everywhere: its heights at posts, without error but for rounding.

    Parameters
    ----------
    terrain : callable (lon, lat) -> heights
        Degrees to ellipsoidal metres, all ``(N,)``.
    box : (2, 2)
        Least and greatest x, y in `crs`, which the DEM covers; its posts lie on multiples of `step`.
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
