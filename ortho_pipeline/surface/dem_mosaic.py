"""A DEM in many files: one grid of samples for all of them, with one horizontal CRS and one height datum.

Files with the same spacing must be on one grid, as the cells of a DEM are. Rows are the same everywhere. If cells
become wider towards the poles (Copernicus, DTED), the grid has columns for the samples of all cells: 3600 and 2400
columns per degree make 7200. A row is linear between the samples of its cell, also across the border of two equal
cells, so bilinear heights are those of the cell's own grid. Between the last row of one width and the first row of
another, heights are linear from one row to the other.
"""

from __future__ import annotations

import functools
import glob
import math
import os
import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.errors import CrsError, DatumError, InputError, completed
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files.locations import Location
from ortho_pipeline.files.shell import typed_pattern
from ortho_pipeline.geodesy.datum import named_unit
from ortho_pipeline.geodesy.declared_vertical import DeclaredVertical, declared_vertical
from ortho_pipeline.surface.base import Array
from ortho_pipeline.surface.dem_file import DemFile, SampleGrid

#: Handles of GDAL that a thread keeps open.
_OPEN_FILES = 32
#: Files that one DEM may have.
_MOST_FILES = 30_000
#: Largest offset of a file from the grid, in parts of a sample, and largest relative difference of spacings.
_OFF_GRID, _SAME_STEP = 0.01, 1e-6
#: Largest number of grid columns between two columns of the finest file. Copernicus needs 3 (2400, 1800, 1200 columns).
_MOST_BETWEEN = 12
#: Degrees of the full circle.
_CIRCLE = 360.0


class Samples(Protocol):
    """What holds samples: a `DemFile`, a `DemMosaic`, or ground that is known without a file."""

    @property
    def path(self) -> str:
        """What the user knows it by."""

    @property
    def block(self) -> int:
        """Bytes that are decoded at once to read a sample."""

    @property
    def unit(self) -> str:
        """The unit of the heights as the file states it; empty if it states none."""

    @property
    def files(self) -> tuple[str, ...]:
        """The files that are read."""

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        """Return the full CRS and the grid of the samples."""

    def read(self, left: int, top: int, width: int, height: int, metres_per_unit: float) -> Array:
        """Return the heights ``(height, width)`` of a window inside in metres; NaN for voids."""

    def close(self) -> None:
        """Let go of what this thread holds open."""


def matching_files(pattern: str | os.PathLike[str]) -> list[str] | None:
    """Return the files that match a pattern such as ``folder/*.tif``, by name; None if it is not a pattern.

    Raises
    ------
    InputError
        If there are none, or too many.
    """
    text = Location(pattern)
    if text.asset:
        return None  # a pattern of assets in a STAC document
    if not glob.has_magic(text) or os.path.exists(text) or "://" in text or text.startswith("/vsi"):
        return None
    paths = sorted(path for path in glob.iglob(text) if os.path.isfile(path))
    if not 0 < len(paths) <= _MOST_FILES:
        raise InputError(
            f"{counted(len(paths), 'file')} of this pattern",
            file=text,
            field="surface.dem",
            remedy="give a DEM, or a pattern of the files that make one",
        )
    return paths


@dataclass(frozen=True)
class Part:
    """Samples of a file in a mosaic, and their position in its layer.

    `column` and `row` are those of the first sample, `shape` is (rows, columns).
    """

    samples: Samples
    column: int
    row: int
    shape: tuple[int, int]


@dataclass(frozen=True)
class ResolutionLayer:
    """Parts with the same spacing.

    Parameters
    ----------
    parts : tuple of Part
        Where two overlap, the later one is used if it has a height.
    first : int
        Column of the mosaic that is its column 0.
    step : int
        Columns of the mosaic from one of its columns to the next.
    columns : int
        Number of its columns; if `closed`, they go around the Earth.
    """

    parts: tuple[Part, ...]
    first: int
    step: int
    columns: int
    closed: bool = False

    @functools.cached_property
    def _boxes(self) -> NDArray[np.int64]:
        """Left, top, right, bottom ``(4, N)`` of the parts."""
        rows = [(part.column, part.row, part.column + part.shape[1], part.row + part.shape[0]) for part in self.parts]
        return np.array(rows, dtype=np.int64).T

    def within(self, left: int, top: int, width: int, height: int) -> Iterator[tuple[Part, int]]:
        """Yield the parts that overlap a window, in their order, with their column there."""
        west, north, east, south = self._boxes
        for turn in (-self.columns, 0, self.columns) if self.closed else (0,):
            meets = (west + turn < left + width) & (east + turn > left) & (north < top + height) & (south > top)
            for index in np.flatnonzero(meets):
                yield self.parts[index], self.parts[index].column + turn


@dataclass(frozen=True, eq=False)
class DemMosaic:
    """The samples of many files, with the interface of `DemFile`."""

    path: str
    crs: pyproj.CRS
    grid: SampleGrid
    unit: str
    layers: tuple[ResolutionLayer, ...]
    _local: threading.local = field(default_factory=threading.local, init=False, repr=False)

    def __reduce__(self) -> tuple[Any, ...]:
        return DemMosaic, (self.path, self.crs, self.grid, self.unit, self.layers)

    @property
    def files(self) -> tuple[str, ...]:
        """The files that are read."""
        return tuple(name for layer in self.layers for part in layer.parts for name in part.samples.files)

    @property
    def block(self) -> int:
        """Bytes that GDAL decodes at once to read a sample: of the first file."""
        return max((self._opened(layer.parts[0].samples).block for layer in self.layers), default=0)

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        """Return the full CRS of the files and the grid of all samples."""
        return self.crs, self.grid

    def close(self) -> None:
        """Let go of the files that this thread holds open."""
        for samples in self._held().values():
            samples.close()
        self._held().clear()

    def read(self, left: int, top: int, width: int, height: int, metres_per_unit: float) -> Array:
        """Return the heights ``(height, width)`` of a window in metres; NaN where no file has one."""
        out = np.full((height, width), np.nan)
        for layer in self.layers:
            if layer.step == 1:
                self._lay(layer, out, left - layer.first, top, metres_per_unit)
                continue
            at, rest = np.divmod(np.arange(left, left + width) - layer.first, layer.step)
            first, last = int(at[0]), int(at[-1]) + 1
            own = np.full((height, last - first + 1), np.nan)
            self._lay(layer, own, first, top, metres_per_unit)
            found = _between(own, at - first, rest / layer.step)
            out = np.where(np.isnan(found), out, found)
        return out

    def _lay(self, layer: ResolutionLayer, out: Array, left: int, top: int, metres_per_unit: float) -> None:
        """Write the heights of a layer over `out`, whose first sample is the column `left` and the row `top` of it."""
        height, width = out.shape
        for part, column in layer.within(left, top, width, height):
            west, east = max(left, column), min(left + width, column + part.shape[1])
            north, south = max(top, part.row), min(top + height, part.row + part.shape[0])
            window = west - column, north - part.row, east - west, south - north
            found = self._opened(part.samples).read(*window, metres_per_unit)
            place = out[north - top : south - top, west - left : east - left]
            np.copyto(place, found, where=~np.isnan(found))

    def _held(self) -> OrderedDict[int, Samples]:
        if not hasattr(self._local, "held"):
            self._local.held = OrderedDict()
        return self._local.held

    def _opened(self, samples: Samples) -> Samples:
        """Return samples, and let go of the file that this thread has not read for the longest time."""
        held = self._held()
        held[id(samples)] = samples
        held.move_to_end(id(samples))
        if len(held) > _OPEN_FILES:
            held.popitem(last=False)[1].close()
        return samples


def _between(own: Array, at: NDArray[np.int64], part: Array) -> Array:
    """Interpolate rows linearly, a part behind the columns `at`; a void counts only where its weight is not zero."""
    return np.where(part > 0, own[:, at] * (1 - part) + own[:, at + 1] * part, own[:, at])


# -- laying out ------------------------------------------------------------------------------------------------------


def open_mosaic(name: str, paths: Sequence[str], access: Mapping[str, Any]) -> DemMosaic:
    """Return many files as one DEM; where two have a height, the later one is used.

    Parameters
    ----------
    name : str
        Name of the DEM in messages.
    access : mapping
        What `raster.open_pixels` may do for it.

    Raises
    ------
    CrsError
        If they have different horizontal CRSs, or no grid fits all of them.
    DatumError
        If they have different height datums or units.
    InputError
        If one cannot be read.
    """
    samples = [DemFile(path, access) for path in paths]
    placed: list[tuple[Samples, pyproj.CRS, SampleGrid, str]] = []
    for file in samples:
        placed.append((file, *file.place(), file.unit))
        file.close()
    # Gaps between the files are voids, not heights of 0.
    warp = f"`gdalwarp -r bilinear -dstnodata -9999 {typed_pattern(name)} dem.tif`"
    with completed(remedy=f"resample them to one grid: {warp}; or leave out the files that do not belong"):
        return laid_out(name, placed)


def laid_out(name: str, placed: Sequence[tuple[Samples, pyproj.CRS, SampleGrid, str]]) -> DemMosaic:
    """Return samples, each with its full CRS, grid and unit, as one DEM: see `open_mosaic`."""
    first, crs, grid, unit = placed[0]
    for other, its_crs, its_grid, its_unit in placed[1:]:
        _refuse_other_system(first, crs, grid, other, its_crs, its_grid)
        same_unit = (named_unit(its_unit) or its_unit) == (named_unit(unit) or unit)
        if (its_crs is not crs and _datum(its_crs) != _datum(crs)) or not same_unit:
            raise DatumError(
                f"this file has {_said(its_crs, its_unit)}, but {first.path} has {_said(crs, unit)}: they are not one "
                "DEM",
                file=other.path,
                field="height datum",
                remedy="leave out one of the two: a DEM has one height datum and one unit",
            )
    layers: dict[float, list[tuple[Samples, SampleGrid]]] = {}
    for samples, _, own, _ in placed:
        steps = [step for step in layers if abs(own.crs_from_pixel[1] / step - 1) < _SAME_STEP]
        layers.setdefault(steps[0] if steps else own.crs_from_pixel[1], []).append((samples, own))
    # The finest last: it counts where it has heights.
    members = [layers[step] for step in sorted(layers, key=abs, reverse=True)]
    grid_of_all = _whole_grid(name, [grid for _, _, grid, _ in placed], _between_columns(members))
    return DemMosaic(name, crs, grid_of_all, unit, tuple(_layer(grid_of_all, theirs) for theirs in members))


def _refuse_other_system(
    first: Samples, crs: pyproj.CRS, grid: SampleGrid, other: Samples, its_crs: pyproj.CRS, its_grid: SampleGrid
) -> None:
    if its_grid.crs is not grid.crs and not its_grid.crs.equals(grid.crs):
        raise CrsError(
            f"this file is in {its_crs.name!r}, but {first.path} is in {crs.name!r}",
            file=other.path,
            field="CRS",
        )
    (_, a, b, _, c, d), (_, own_a, own_b, _, own_c, own_d) = grid.crs_from_pixel, its_grid.crs_from_pixel
    if b or c or own_b or own_c or abs(own_d / d - 1) > 1e-6 or own_a * a < 0:
        raise CrsError(
            f"the rows of this file differ in direction or spacing from those of {first.path}",
            file=other.path,
            field="geotransform",
        )


def _datum(crs: pyproj.CRS) -> tuple[object, object] | None:
    declared = declared_vertical(crs)
    return None if declared is None else (declared.vertical or declared.name, declared.metres_per_unit)


def _said(crs: pyproj.CRS, unit: str) -> str:
    declared: DeclaredVertical | None = declared_vertical(crs)
    return f"heights in {declared.name if declared else 'no stated datum'!r} ({unit or 'no unit'})"


def _west(members: Sequence[tuple[Samples, SampleGrid]]) -> float:
    """Return x of the first column of files of one spacing."""
    sign = np.sign(members[0][1].crs_from_pixel[1])
    return min((grid.crs_from_pixel[0] for _, grid in members), key=lambda value: value * sign)


def _between_columns(members: Sequence[Sequence[tuple[Samples, SampleGrid]]]) -> int:
    """Return into how many columns the finest spacing is divided, so that the columns of all spacings are among them.

    `members` are files of one spacing each, the finest last.
    """
    fine = members[-1][0][1].crs_from_pixel[1]
    x = min((_west(theirs) for theirs in members), key=lambda value: value * np.sign(fine))
    steps = np.array([theirs[0][1].crs_from_pixel[1] / fine for theirs in members])
    # A layer may be off by a part of its own samples, as its files may.
    offsets, slack = np.array([(_west(theirs) - x) / fine for theirs in members]), _OFF_GRID * steps
    for count in range(1, _MOST_BETWEEN + 1):
        even = np.abs(steps * count - np.rint(steps * count)) < _SAME_STEP * steps * count
        on = np.abs(offsets * count - np.rint(offsets * count)) <= slack * count
        if (even & on).all():
            return count
    finest, other = members[-1][0][0], members[0][0][0]
    raise CrsError(
        f"the columns of this file do not match those of {other.path}",
        file=finest.path,
        field="geotransform",
    )


def _whole_grid(name: str, grids: Sequence[SampleGrid], between: int) -> SampleGrid:
    """Return the grid over all grids, from the first sample in x and y to the last ones.

    Its columns are the finest ones, each divided by `between`.
    """
    dx = min((grid.crs_from_pixel[1] for grid in grids), key=abs) / between
    dy = grids[0].crs_from_pixel[5]
    x = min((grid.crs_from_pixel[0] for grid in grids), key=lambda value: value * np.sign(dx))
    y = min((grid.crs_from_pixel[3] for grid in grids), key=lambda value: value * np.sign(dy))
    ends = ((g.crs_from_pixel[0] - x) / dx + (g.shape[1] - 1) * g.crs_from_pixel[1] / dx for g in grids)
    right = max(math.floor(end + _OFF_GRID) for end in ends)
    bottom = max(round((g.crs_from_pixel[3] - y) / dy) + g.shape[0] for g in grids)
    columns = right + 1
    if grids[0].crs.is_geographic and columns * abs(dx) > _CIRCLE - 1.5 * max(abs(g.crs_from_pixel[1]) for g in grids):
        # The last samples of coarse cells are before the end of the circle that these cells close.
        columns = round(_CIRCLE / abs(dx))
    size = bottom * columns
    if not 0 < size <= 1e13:
        raise CrsError(f"these files span {bottom} x {columns} samples", file=name, field="extent")
    return replace(grids[0], shape=(bottom, columns), crs_from_pixel=(x, dx, 0.0, y, 0.0, dy))


def _layer(whole: SampleGrid, members: Sequence[tuple[Samples, SampleGrid]]) -> ResolutionLayer:
    """Return parts of one spacing as a layer of the whole."""
    x, dx, _, y, _, dy = whole.crs_from_pixel
    step = members[0][1].crs_from_pixel[1]
    # Columns of the whole grid are counted in it, despite rounding of the spacing.
    first, width = (x, dx) if round(step / dx) == 1 else (_west(members), step)
    parts = []
    for samples, grid in members:
        column, row = (grid.crs_from_pixel[0] - first) / width, (grid.crs_from_pixel[3] - y) / dy
        if max(abs(column - round(column)), abs(row - round(row))) > _OFF_GRID:
            raise CrsError(
                "the samples of this file are not on the grid of the other files",
                file=samples.path,
                field="geotransform",
            )
        parts.append(Part(samples, round(column), round(row), grid.shape))
    circle = round(_CIRCLE / abs(step)) if whole.crs.is_geographic else 0
    closed = whole.crs.is_geographic and abs(whole.shape[1] * dx) > _CIRCLE - 1e-9
    return ResolutionLayer(tuple(parts), round((first - x) / dx), round(step / dx), circle, closed)
