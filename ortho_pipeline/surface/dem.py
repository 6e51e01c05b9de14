"""A DEM as ellipsoidal heights.

What a DEM's numbers are measured above is decided once, when it is opened, and undone where samples are read: scale,
unit, voids, geoid. Everything after sees ellipsoidal metres, or NaN.
"""

from __future__ import annotations

import functools
import math
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import CoverageError, DatumError, completed
from ortho_pipeline.files.folders import listed_paths
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.geodesy.datum import dem_unit, dem_vertical, dem_vertical_remedy
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.surface.base import Array, Excerpt, Surface, Window, parse_fill, positions
from ortho_pipeline.surface.dem_file import Affine, DemFile, SampleGrid
from ortho_pipeline.surface.dem_mosaic import Samples, matching_files, open_mosaic
from ortho_pipeline.surface.voids import nearest_heights

#: ``fill='nearest'`` looks so far for a valid height: samples, and metres after which real terrain is another one.
NEAREST_REACH, NEAREST_METRES = 512, 20_000.0
#: The undulation is computed exactly on a lattice about this wide (m) and interpolated between: within 2 mm.
UNDULATION_SPACING = 500.0
#: Side (samples) of a tile that is read and cached for single positions. More than a thousand rays are followed
#: together, each on its own tile; small tiles all stay in the cache until their rays have left them.
TILE = 64
#: The part of a job's memory that tiles may take.
_TILES_SHARE = 8
#: Samples around those of a cubic kernel's window that are read with it, before and after.
_BEFORE, _AFTER = 2, 5
#: Steps to the samples around a position.
_NEXT = np.array([0, 1])
#: Samples per side that are looked through at once.
_LOOK = 1024


def open_dem(
    path: str | os.PathLike[str],
    vertical: Vertical | str | None = None,
    override: bool = False,
    fill: str | float = "error",
    allow_network: bool = False,
    roots: Sequence[str | os.PathLike[str]] = (),
    memory: int = 512_000_000,
) -> DemSurface:
    """Open a DEM.

    Parameters
    ----------
    path : path
        A file, or a pattern such as ``folder/*.tif`` of the files that make one DEM (see `surface.dem_mosaic`).
    vertical : Vertical or str, optional
        Height datum. Required if the DEM does not state it.
    override : bool
        Use `vertical` even if the DEM states another datum by an authority code.
    fill : 'error', 'mask', 'nearest' or float
        Value in a void (see `Surface`). A number is an ellipsoidal height in metres.
    memory : int
        Memory of the whole job in bytes. An eighth of it may cache heights.

    Raises
    ------
    InputError, DatumError, CrsError
        If it cannot be opened, its height datum is unknown or contradicts `vertical`, a geoid grid is missing, or
        it has no usable georeference.

    Examples
    --------
    >>> dem = op.open_dem("sample_data/dem.tif", fill="nearest")
    >>> [round(height, 1) for height in dem.height_range]
    [700.0, 1191.9]
    """
    access = {"allow_network": allow_network, "roots": listed_paths(roots)}
    files = matching_files(path)
    name = os.fspath(path)
    file: Samples = DemFile(name, access) if files is None else open_mosaic(name, files, access)
    return dem_of(file, vertical, override, parse_fill(fill), memory)


def dem_of(
    file: Samples, vertical: Vertical | str | None, override: bool, fill: str | float, memory: int
) -> DemSurface:
    """Return samples, of a file or of many, as a surface: see `open_dem`."""
    path = file.path
    crs, grid = file.place()
    declared = declared_vertical(crs)
    option = None if vertical is None else Vertical.parse(vertical)
    with completed(path):
        used, warnings = dem_vertical(declared, option, override)
        unit = dem_unit(file.unit, declared, option)
        _check_geoid(grid, used)
    record = {
        "path": path,
        "crs": grid.crs.name,
        "declared_vertical": declared.name if declared else None,
        "declared_by": None if declared is None else ("code" if declared.certain else "name"),
        "option": option.name if option else None,
        "override": override,
        "vertical": used.name,
        "vertical_label": used.label,
        "metres_per_unit": unit,
        "fill": fill,
        "warnings": warnings,
    }
    return DemSurface(file, grid, used, unit, fill, record, memory // _TILES_SHARE)


def _check_geoid(grid: SampleGrid, vertical: Vertical) -> None:
    """Fail now if the geoid grid is missing or does not reach any part of the DEM."""
    rows, columns = grid.shape
    try:
        # The geoid of a country can be a small part of a DEM of the world.
        for count in (5, 200):
            v, u = (
                axis.ravel() for axis in np.meshgrid(*(np.linspace(0, side - 1, count) for side in (rows, columns)))
            )
            if np.isfinite(vertical.undulation(*grid.lonlat(u, v))).any():
                return
    except DatumError as error:
        raise DatumError(
            error.message, field="surface.vertical", remedy=dem_vertical_remedy(error.remedy or "")
        ) from error
    raise DatumError(
        f"{vertical.label} does not cover this DEM", field="surface.vertical", remedy=dem_vertical_remedy()
    )


def moved(surface: DemSurface, metres: tuple[float, float, float], place: Array) -> DemSurface:
    """Return a DEM moved to the east and north, and raised, by metres.

    Parameters
    ----------
    place : ndarray (2,)
        Longitude and latitude at which the metres apply.
    """
    east, north, up = metres
    there = ground_transform("EPSG:4979", surface.crs)(np.array([[*place, 0.0]]))
    dx, dy, _ = map_from_enu(surface.crs, there)[0] @ (east, north, 0.0)
    x, a, b, y, c, d = surface.grid.crs_from_pixel
    grid = replace(surface.grid, crs_from_pixel=(x + float(dx), a, b, y + float(dy), c, d))
    before, raised = surface.record.get("moved_m", (0.0, 0.0)), surface.raised + up
    record = {**surface.record, "moved_m": [before[0] + east, before[1] + north], "raised_m": raised}
    return replace(surface, grid=grid, raised=raised, record=record)


class TileCache:
    """Arrays by key, as many of the last used as some bytes hold; shared by threads."""

    def __init__(self, size: int) -> None:
        self._size, self._held = size, 0
        self._lock = threading.Lock()
        self._kept: OrderedDict[Hashable, Array] = OrderedDict()

    def get(self, key: Hashable, make: Callable[[], Array]) -> Array:
        """Return the array of a key, made if it is not kept."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        array = make()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = array
                self._held += array.nbytes
            while self._held > self._size and len(self._kept) > 1:
                self._held -= self._kept.popitem(last=False)[1].nbytes
        return array


@dataclass(frozen=True, eq=False)
class DemSurface(Surface):
    """The heights of a DEM, as `open_dem` makes it.

    Parameters
    ----------
    file : Samples
    grid : SampleGrid
        Grid of the samples; for a global DEM, with its seam.
    vertical : Vertical
        Height datum.
    metres_per_unit : float
    fill : 'error', 'mask', 'nearest' or float
        Value in a void (see `Surface`).
    record : mapping
        The provenance, without `fill`.
    cache_bytes : int
        Bytes of cached heights.
    sigma : float, Surface or None
    raised, least : float
        Metres added to the heights. Heights below `least` are voids.
    """

    file: Samples
    grid: SampleGrid
    vertical: Vertical
    metres_per_unit: float
    fill: str | float
    record: Mapping[str, Any]
    cache_bytes: int
    sigma: float | Surface | None = None
    raised: float = 0.0
    least: float = -math.inf
    _tiles: TileCache = field(init=False, repr=False)  # follows from all of the above, so no two surfaces share it

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tiles", TileCache(self.cache_bytes))

    def __reduce__(self) -> tuple[Any, ...]:
        return DemSurface, tuple(getattr(self, item.name) for item in fields(self) if item.init)

    # -- what it is --------------------------------------------------------------------------------------------------

    @property
    def crs(self) -> pyproj.CRS:
        """Horizontal system of the samples, x first."""
        return self.grid.crs

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of samples."""
        return self.grid.shape

    @property
    def pixel_from_crs(self) -> Affine:
        """``u = a + b x + c y``, ``v = d + e x + f y``; (0, 0) is the centre of the first sample."""
        return self.grid.pixel_from_crs

    @property
    def sample_size(self) -> float:
        """Larger side of a sample, in metres (on the equator where the DEM is in degrees)."""
        return self.grid.sample_size

    @property
    def block(self) -> int:
        """Bytes that GDAL decodes at once to read a sample."""
        return self.file.block

    @property
    def files(self) -> tuple[str, ...]:
        """The files that heights are read from."""
        return self.file.files

    @property
    def provenance(self) -> dict[str, Any]:
        """Path, declared and used height datum, fill rule, warnings; JSON values."""
        return {**self.record, "fill": self.fill}

    def describe(self) -> str:
        """Return where a point on the surface is, in words."""
        return "on the DEM"

    def with_fill(self, fill: str | float) -> DemSurface:
        """Return this DEM with another rule for voids."""
        return replace(self, fill=parse_fill(fill))

    def around(self, lon: float) -> DemSurface:
        """Return a global DEM with its seam opposite to `lon` (degrees); any other DEM unchanged."""
        sigma = self.sigma.around(lon) if isinstance(self.sigma, Surface) else self.sigma
        grid = self.grid.around(lon)
        return self if grid is self.grid and sigma is self.sigma else replace(self, grid=grid, sigma=sigma)

    @property
    def nearest_reach(self) -> int:
        """How far (samples) ``fill='nearest'`` looks for a height."""
        return int(np.clip(NEAREST_METRES / self.sample_size, 1, NEAREST_REACH))

    # -- at positions ------------------------------------------------------------------------------------------------

    def samples_at(self, xy: ArrayLike) -> Array:
        """Return sample coordinates (u, v) ``(N, 2)`` of positions (x, y) ``(N, 2)`` in `crs`."""
        return self.grid.samples_at(xy)

    def sampler(self, crs: str | pyproj.CRS) -> Callable[[Array], Array]:
        """Return the function from ground ``(N, 3)`` in `crs` to sample coordinates (u, v) ``(N, 2)``."""
        transform = ground_transform(parse_crs(crs), self.crs)
        return lambda ground: self.grid.samples_at(transform(ground)[:, :2])

    def heights(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> Array:
        """Return heights ``(N,)`` at positions ``(N, 2)``: see `Surface.heights`."""
        return self.heights_at(*self._places(xy, crs))

    def heights_at(self, u: Array, v: Array) -> Array:
        """Return heights ``(N,)`` at sample coordinates, by the same rules."""
        out = self._interpolated(u, v, filled=False)
        if self.fill in ("error", "mask"):
            return out
        empty = np.isnan(out) & np.isfinite(u) & np.isfinite(v)
        if self.fill == "nearest":
            # Outside, the edge continues.
            rows, columns = self.shape
            inner_u, inner_v = np.clip(u, 0, columns - 1), np.clip(v, 0, rows - 1)
            with np.errstate(invalid="ignore"):
                empty &= np.hypot(inner_u - u, inner_v - v) <= self.nearest_reach
            u, v = inner_u, inner_v
        if empty.any():  # only where a void has a say are its surroundings searched for what fills it
            out[empty] = self._interpolated(u[empty], v[empty], filled=True)
        if isinstance(self.fill, float):
            out[empty & np.isnan(out)] = self.fill
        return out

    def coverage(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> float:
        """Return the share (0 to 1) of positions ``(N, 2)`` that have a height of their own, not a filled one."""
        heights = self._interpolated(*self._places(xy, crs), filled=False)
        return float(np.isfinite(heights).mean()) if len(heights) else 1.0

    def above(self, ground: Array, crs: str | pyproj.CRS) -> Array:
        """Return how far (m) points ``(N, 3)`` are above the DEM; NaN where it has no height."""
        return ground[:, 2] - self.heights(ground[:, :2], crs)

    def _places(self, xy: ArrayLike, crs: str | pyproj.CRS | None) -> tuple[Array, Array]:
        plan = positions(xy)
        samples = self.samples_at(plan) if crs is None else self.sampler(crs)(_on_ellipsoid(plan))
        return samples[:, 0], samples[:, 1]

    def _interpolated(self, u: Array, v: Array, filled: bool) -> Array:
        """Return heights ``(N,)`` at sample coordinates; NaN outside."""
        out = np.full(len(u), np.nan)
        rows, columns = self.shape
        with np.errstate(invalid="ignore"):
            index = np.flatnonzero((u >= 0) & (v >= 0) & (u <= columns - 1) & (v <= rows - 1))
        for row, column, these in _by_tile(u, v, index, columns // TILE + 1):
            # One sample more than the step, for the neighbours of the last ones.
            window = column * TILE, row * TILE, TILE + 1, TILE + 1
            tile = self._tiles.get((row, column, filled), functools.partial(self._window, *window, filled))
            out[these] = _bilinear(tile, u[these] - column * TILE, v[these] - row * TILE)
        if len(seam := np.flatnonzero((u < 0) | (u > columns - 1))):
            out[seam] = _across_seam(self, u[seam], v[seam], filled)
        return out

    # -- windows -----------------------------------------------------------------------------------------------------

    def window_around(self, left: float, top: float, right: float, bottom: float) -> Window | None:
        """Return the samples around a box of sample coordinates: see `Surface.window_around`."""
        rows, columns = self.shape
        u0, v0 = math.floor(left) - _BEFORE, math.floor(top) - _BEFORE
        u1, v1 = math.floor(right) + _AFTER, math.floor(bottom) + _AFTER
        if self.fill in ("error", "mask"):  # with any other rule there are heights beyond the DEM
            u0, v0, u1, v1 = max(u0, -2), max(v0, -2), min(u1, columns + 2), min(v1, rows + 2)
        return None if u1 - u0 < 2 or v1 - v0 < 2 else (u0, v0, u1, v1)

    def window(self, u0: int, v0: int, nu: int, nv: int) -> Array:
        """Return the heights ``(nv, nu)`` of samples, from column `u0` and row `v0`: see `Surface.window`."""
        return self._window(int(u0), int(v0), int(nu), int(nv), filled=True)

    def _window(self, u0: int, v0: int, nu: int, nv: int, filled: bool) -> Array:
        if filled and self.fill == "nearest":
            return nearest_heights(self._read, self.shape, (u0, v0, nu, nv), self.nearest_reach)
        rows, columns = self.shape
        left, top = max(u0, 0), max(v0, 0)
        right, bottom = min(u0 + nu, columns), min(v0 + nv, rows)
        some = self._read(left, top, right - left, bottom - top) if right > left and bottom > top else None
        out = some if some is not None and some.shape == (nv, nu) else np.full((nv, nu), np.nan)
        if some is not None and out is not some:
            out[top - v0 : bottom - v0, left - u0 : right - u0] = some
        if filled and isinstance(self.fill, float):
            out[np.isnan(out)] = self.fill
        return out

    def excerpt(self, ground: Array, crs: str | pyproj.CRS) -> Excerpt | None:
        """Return the DEM under points ``(N, 3)`` as a raster; None across the antimeridian: see `Surface.excerpt`."""
        plan = ground_transform(parse_crs(crs), self.crs)(ground)
        if self.crs.is_geographic and np.ptp(plan[:, 0]) > 180:
            return None
        samples = self.samples_at(plan[:, :2])
        low = np.floor(np.nanmin(samples, axis=0)).astype(int) - 3
        size = np.ceil(np.nanmax(samples, axis=0)).astype(int) + 4 - low
        u, a, b, v, c, d = self.pixel_from_crs
        inverse = np.linalg.inv([[a, b], [c, d]])
        # GDAL's geotransform starts at the corner of the first sample.
        corner = inverse @ (low - 0.5 - np.array([u, v]))
        heights = self.window(int(low[0]), int(low[1]), int(size[0]), int(size[1]))
        transform = corner[0], inverse[0, 0], inverse[0, 1], corner[1], inverse[1, 0], inverse[1, 1]
        return Excerpt(heights, transform, self.crs)

    def _read(self, left: int, top: int, width: int, height: int) -> Array:
        """Return ellipsoidal heights of a window inside the DEM; NaN for voids."""
        first = (left + self.grid.first_column) % self.shape[1]
        split = min(width, self.shape[1] - first)
        heights = self.file.read(first, top, split, height, self.metres_per_unit)
        if split < width:
            heights = np.hstack([heights, self.file.read(0, top, width - split, height, self.metres_per_unit)])
        if not self.vertical.is_ellipsoid:
            heights += _undulations(self.vertical, self.grid, (left, top, width, height))
        heights[heights < self.least] = np.nan
        return heights + self.raised if self.raised else heights

    # -- ranges ------------------------------------------------------------------------------------------------------

    @functools.cached_property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest height (m) of the whole surface, with a fill height. Reads every sample once."""
        rows, columns = self.shape
        return self.range_within(0, 0, columns, rows)

    def range_under(self, ground: Array, crs: str | pyproj.CRS, margin: float = 0.0) -> tuple[float, float]:
        """Return the lowest and the highest height (m) under points ``(N, 3)``: see `Surface.range_under`."""
        samples = self.sampler(crs)(ground)
        samples = samples[np.isfinite(samples).all(axis=1)]
        if not len(samples):
            raise _no_height(self.file.path)
        low, high = samples.min(axis=0), samples.max(axis=0)
        wider = margin * (high - low) + 1 if margin else 0.0
        size = self.shape[::-1]
        u0, v0 = np.clip(np.floor(low - wider), 0, size).astype(int).tolist()
        u1, v1 = np.clip(np.ceil(high + wider) + 1, 0, size).astype(int).tolist()
        return self.range_within(u0, v0, u1 - u0, v1 - v0)

    def range_within(self, u0: int, v0: int, nu: int, nv: int) -> tuple[float, float]:
        """Return the lowest and the highest height (m) of a window: see `Surface.range_within`."""
        rows, columns = self.shape
        right, bottom = min(u0 + nu, columns), min(v0 + nv, rows)
        low, high = (self.fill, self.fill) if isinstance(self.fill, float) else (math.inf, -math.inf)
        for top in range(max(v0, 0), bottom, _LOOK):
            for left in range(max(u0, 0), right, _LOOK):
                heights = self._window(left, top, min(_LOOK, right - left), min(_LOOK, bottom - top), filled=False)
                if not np.isnan(heights).all():
                    low, high = min(low, float(np.nanmin(heights))), max(high, float(np.nanmax(heights)))
        if low > high:
            raise _no_height(self.file.path)
        return low, high


def _no_height(path: str) -> CoverageError:
    return CoverageError(
        "this DEM has no valid height here", file=path, remedy="check its nodata value, unit and extent"
    )


def _on_ellipsoid(plan: Array) -> Array:
    return np.column_stack([plan, np.zeros(len(plan))])


def _undulations(vertical: Vertical, grid: SampleGrid, window: tuple[int, int, int, int]) -> Array:
    """Return the undulation ``(height, width)`` of samples of a window (left, top, width, height).

    The lattice is on multiples of its spacing in the DEM, so the value of a sample does not depend on the window.
    """

    def at(u: NDArray[Any], v: NDArray[Any]) -> Array:
        grid_u, grid_v = np.meshgrid(u.astype(float), v.astype(float))
        return vertical.undulation(*grid.lonlat(grid_u.ravel(), grid_v.ravel())).reshape(grid_u.shape)

    left, top, width, height = window
    step = int(np.clip(round(UNDULATION_SPACING / grid.sample_size), 1, 64))
    first_u, first_v = left // step, top // step
    node_u = np.arange(first_u, (left + width - 1) // step + 2) * step
    node_v = np.arange(first_v, (top + height - 1) // step + 2) * step
    u, v = np.arange(left, left + width), np.arange(top, top + height)
    nodes = at(node_u, node_v) if step > 1 else None
    if nodes is None or not np.isfinite(nodes).all():
        # At the rim of a geoid grid (and of a projection) nodes are missing that no sample needs.
        return at(u, v)
    i, j = u // step - first_u, v // step - first_v
    across, down = (u % step) / step, ((v % step) / step)[:, None]
    along = nodes[:, i] * (1 - across) + nodes[:, i + 1] * across
    return along[j] * (1 - down) + along[j + 1] * down


def _across_seam(dem: DemSurface, u: Array, v: Array, filled: bool) -> Array:
    """Return heights ``(N,)`` between the last and the first column of a global DEM; NaN for another DEM."""
    x, a, *_ = dem.grid.crs_from_pixel
    turned = dem.grid.around(x - a / 2)
    if turned is dem.grid:
        return np.full(len(u), np.nan)
    shift = turned.first_column - dem.grid.first_column
    return replace(dem, grid=turned)._interpolated((u - shift) % dem.shape[1], v, filled)


def _by_tile(u: Array, v: Array, index: NDArray[np.intp], across: int) -> Iterator[tuple[int, int, NDArray[np.intp]]]:
    """Yield row and column of each tile with positions, and these positions; a row has `across` tiles."""
    tiles = (v[index] // TILE).astype(int) * across + (u[index] // TILE).astype(int)
    order = np.argsort(tiles, kind="stable")
    unique, first = np.unique(tiles[order], return_index=True)
    for number, these in zip(unique.tolist(), np.split(index[order], first[1:]), strict=False):
        yield *divmod(number, across), these


def _bilinear(heights: Array, u: Array, v: Array) -> Array:
    """Interpolate; a void counts only where its weight is not zero."""
    i, j = np.floor(u), np.floor(v)
    right, below = u - i, v - j
    corners = heights[j.astype(int) + _NEXT[:, None, None], i.astype(int) + _NEXT[:, None]]
    weights = np.stack([1 - below, below])[:, None] * np.stack([1 - right, right])
    above, under = np.where(weights > 0, corners * weights, 0.0)
    return np.asarray(above[0] + above[1] + under[0] + under[1])
