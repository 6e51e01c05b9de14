"""Orthos on their common grid, and their order."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.shell import converted, typed
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.regridded import grid_of, warped_bounds
from ortho_pipeline.raster.source import Grid, RasterSource

#: Part of a pixel by which grids may differ: rounding of coordinates, no more.
_SAME = 1e-3
Box = tuple[int, int, int, int]


@dataclass(frozen=True)
class Ortho:
    """An orthoimage of a mosaic; `relief_displacement` per metre of height (m), None if unknown.

    `accuracy` is the raster that `layers.accuracy` wrote of it. `resampling` is how its pixels were made, None if
    unknown.
    """

    name: str
    path: Path
    relief_displacement: float | None = None
    accuracy: Path | None = None
    resampling: str | None = None


@dataclass(frozen=True)
class PlacedOrtho:
    """An orthoimage and its position in the mosaic."""

    ortho: Ortho
    grid: Grid
    left: int
    top: int


@dataclass(frozen=True)
class Mosaic:
    """Orthos placed on one grid: layers, the topmost first, or the most accurate first at each pixel."""

    grid: Grid
    layers: tuple[PlacedOrtho, ...]
    by_pixel: bool = False


def lay_out(orthos: Sequence[Ortho], order: str = "best-view") -> Mosaic:
    """Return the positions of orthos on their common grid.

    Parameters
    ----------
    order : {'best-view', 'first-on-top', 'most-accurate'}
        What lies on top: the steepest view, in which errors of the DEM move pixels least, or the first; or at each
        pixel the ortho with the smallest ce90 there (the steepest view of equal ones).

    Raises
    ------
    InputError
        If they do not share a grid, or differ in bands, type, nodata, scale, offset or colour table; if one has no
        accuracy that would decide.
    """
    if not orthos:
        raise InputError("a mosaic needs at least one ortho", field="mosaic")
    without = [ortho for ortho in orthos if ortho.accuracy is None]
    if order == "most-accurate" and without:
        raise InputError(
            f"{without[0].name} has no accuracy raster",
            file=without[0].path,
            field="mosaic.order",
            remedy=Text("rectify all scenes with ", Setting("output.accuracy_raster"), ", or order them by best-view"),
        )
    if order != "first-on-top":
        orthos = sorted(
            orthos, key=lambda ortho: math.inf if ortho.relief_displacement is None else ortho.relief_displacement
        )
    grids = _beside([grid_of(ortho.path) for ortho in orthos])
    first = grids[0]
    for ortho, grid in zip(orthos, grids, strict=True):
        _check_grid(orthos[0], first, ortho, grid)
    _check_bands(orthos)
    left, top = min(grid.left for grid in grids), max(grid.top for grid in grids)
    right = max(grid.left + grid.width * grid.dx for grid in grids)
    bottom = min(grid.top - grid.height * grid.dy for grid in grids)
    width, height = round((right - left) / first.dx), round((top - bottom) / first.dy)
    mosaic = Grid(first.crs, left, top, first.dx, first.dy, width, height)
    layers = [
        PlacedOrtho(ortho, grid, round((grid.left - left) / first.dx), round((top - grid.top) / first.dy))
        for ortho, grid in zip(orthos, grids, strict=True)
    ]
    return Mosaic(mosaic, tuple(layers), order == "most-accurate")


def _beside(grids: list[Grid]) -> list[Grid]:
    """Return the grids next to each other if they lie on both sides of longitude 180."""
    if not all(grid.crs.is_geographic for grid in grids):
        return grids
    moved = [replace(grid, left=grid.left + (360.0 if grid.left < 0 else 0.0)) for grid in grids]
    spans = [
        max(grid.left + grid.width * grid.dx for grid in some) - min(grid.left for grid in some)
        for some in (grids, moved)
    ]
    return moved if spans[1] < spans[0] - 1e-6 else grids


def _check_grid(one: Ortho, first: Grid, other: Ortho, grid: Grid) -> None:
    columns, rows = (grid.left - first.left) / first.dx, (first.top - grid.top) / first.dy
    same_pixels = math.isclose(grid.dx, first.dx, rel_tol=1e-9) and math.isclose(grid.dy, first.dy, rel_tol=1e-9)
    off = max(abs(columns - round(columns)), abs(rows - round(rows)))
    if grid.crs != first.crs or not same_pixels:
        remedy = _regridded(one, first, other, grid)
        if len(grid.crs.axis_info) > 2:
            remedy = f"if this is a DEM (its CRS has heights), leave it out; if not, {remedy}"
        raise InputError(
            f"this raster has pixels of {grid.dx:g} x {grid.dy:g} in {grid.crs.name}, "
            f"but {one.path.name!r} has {first.dx:g} x {first.dy:g} in {first.crs.name}",
            file=other.path,
            field="orthos",
            remedy=remedy,
        )
    if off > _SAME:
        raise InputError(
            f"the ortho {other.path.name!r} is off the grid of {one.path.name!r} by {off:.3f} px",
            file=other.path,
            field="orthos",
            remedy=_regridded(one, first, other, grid),
        )


def _regridded(one: Ortho, first: Grid, other: Ortho, grid: Grid) -> str:
    """Return how to bring an ortho to the grid of the first one."""
    again = f"rectify its scene again with the CRS, pixel size and grid of {one.path.name!r}"
    bounds, authority = warped_bounds(grid, first.crs), first.crs.to_authority()
    if authority is None or not np.isfinite(bounds).all():
        return again
    step, corner = np.array([first.dx, first.dy] * 2), np.array([first.left, first.top] * 2)
    pixels = (np.array(bounds) - corner) / step
    extent = corner + np.concatenate([np.floor(pixels[:2]), np.ceil(pixels[2:])]) * step
    box = " ".join(f"{value:.12g}" for value in extent)
    kept = _nodata_of(one)
    empty = "" if kept is None else f" -dstnodata {kept}"
    kernel = "nearest" if RasterSource(other.path).palette else "cubic"
    return (
        f"{again}, or resample it: `ortho rectify {typed(other.path)} --ortho --height 0 -t_srs {':'.join(authority)} "
        f"-tr {first.dx:.12g} {first.dy:.12g} -te {box} -r {kernel}{empty} -o regridded`"
    )


def _nodata_of(*orthos: Ortho) -> str | None:
    """Return the first nodata value of some orthos."""
    values = (value for ortho in orthos for value in RasterSource(ortho.path).nodata)
    return next((f"{value:.12g}" for value in values if value is not None), None)


def _mark_of(ortho: Ortho) -> str:
    value, validity = _nodata_of(ortho), RasterSource(ortho.path).validity
    return f"the nodata value {value}" if value is not None else {"all": "nothing"}.get(validity, f"its {validity}")


def _check_bands(orthos: Sequence[Ortho]) -> None:
    first, profiles = None, list[Profile]()
    for ortho in orthos:
        source = RasterSource(ortho.path)
        nodata = tuple(None if value is None else str(value) for value in source.nodata)
        kind = f"{counted(source.count, 'band')} of {source.dtype}", source.validity, nodata
        first = first or kind
        if kind != first:
            remedy = "combine only scenes of one kind"
            what = f"{ortho.path.name} has {kind[0]}, but {orthos[0].path.name} has {first[0]}"
            if kind[0] == first[0]:
                what = (
                    f"{ortho.path.name} marks empty pixels by {_mark_of(ortho)}, but {orthos[0].path.name} by "
                    f"{_mark_of(orthos[0])}"
                )
                changed, kept = (orthos[0], ortho) if kind[1] == "nodata" != first[1] else (ortho, orthos[0])
                empty = _nodata_of(kept, changed) or "0"
                remedy = (
                    f"give both the same nodata value: `gdalwarp -dstnodata {empty} "
                    f"{converted(changed.path, 'nodata')}`. If {empty} is valid in one of them, give both "
                    "another one. The copy has no report, so the order best-view puts it last"
                )
            raise InputError(what, file=ortho.path, remedy=remedy)
        profiles.append(Profile.of(source))
    _check_meaning(orthos, profiles)


def _check_meaning(orthos: Sequence[Ortho], profiles: Sequence[Profile]) -> None:
    """Raise an `InputError` if equal pixels of two orthos mean different values or colours."""
    for ortho, profile in zip(orthos, profiles, strict=True):
        what = profiles[0].unlike(profile, orthos[0].path.name, ortho.path.name)
        if what:
            raise InputError(what, file=ortho.path, field="orthos", remedy="combine only orthos of one kind")


# -- windows ---------------------------------------------------------------------------------------------------------


def box_of(layer: PlacedOrtho) -> Box:
    """Return left, top, right and bottom of a layer in pixels of the mosaic."""
    return layer.left, layer.top, layer.left + layer.grid.width, layer.top + layer.grid.height


def intersection(one: Box, other: Box) -> Box | None:
    """Return the common part of two boxes (left, top, right, bottom); None where there is none."""
    left, top, right, bottom = (
        max(one[0], other[0]),
        max(one[1], other[1]),
        min(one[2], other[2]),
        min(one[3], other[3]),
    )
    return (left, top, right, bottom) if left < right and top < bottom else None


def windows(grid: Grid, side: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield left, top, width and height of the windows of a grid, row by row."""
    for top in range(0, grid.height, side):
        for left in range(0, grid.width, side):
            yield left, top, min(side, grid.width - left), min(side, grid.height - top)


def circular_errors(layer: PlacedOrtho, left: int, top: int, width: int, height: int) -> NDArray[np.float32]:
    """Return the circular error (m) in a window of an ortho, of the nearest pixel of its raster of accuracy.

    Where nothing is known it is larger than any that is.
    """
    assert layer.ortho.accuracy is not None
    source = RasterSource(layer.ortho.accuracy)
    own = grid_of(layer.ortho.accuracy)
    steps = [round(size / pixel) for size, pixel in zip((own.dx, own.dy), (layer.grid.dx, layer.grid.dy), strict=True)]
    columns, rows = (np.arange(left, left + width) // steps[0], np.arange(top, top + height) // steps[1])
    part = source.read(int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1))
    errors = part[-1][np.ix_(rows - rows[0], columns - columns[0])]
    return np.where(np.isfinite(errors), errors, np.finfo(np.float32).max).astype(np.float32)
