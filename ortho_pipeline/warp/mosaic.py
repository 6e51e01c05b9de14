"""One raster of many orthos that share a grid, and how well they agree where they overlap.

Nothing is resampled: pixels are taken over as they are, so orthos that are not on one grid are refused. Brightness is
left alone too. A seam is measured by phase correlation of patches: by how many pixels the content of one ortho lies
elsewhere in the other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError, counted
from ortho_pipeline.geodesy.crs import crs_text
from ortho_pipeline.imaging.registration import details, measure
from ortho_pipeline.raster.block_cache import limit_cache
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.output import raster_output, written
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.raster.valid_area import grid_of, valid_outline

#: Part of a pixel by which grids may differ: rounding of coordinates, no more.
_SAME = 1e-3
#: Side of the windows in which a mosaic is written, and of those in which seams are measured.
_WINDOW, _SEAM_WINDOW = 2048, 384
#: Windows per seam, at most, and patches in one that are enough.
_SEAM_WINDOWS, _ENOUGH = 9, 4
#: Sides of the patches that are correlated, the largest that the overlap allows; a quarter of it is the reach.
_PATCHES = (128, 64, 32)
#: Pixels around a patch that have to be valid too: the edge of the values, blurred, is the same in both orthos.
_MARGIN = 18


@dataclass(frozen=True)
class Ortho:
    """An orthoimage of a mosaic; `relief_displacement` is that of a metre of height (m), None where it is not known.

    `accuracy` is the raster that `layers.accuracy` wrote of it.
    """

    name: str
    path: Path
    relief_displacement: float | None = None
    accuracy: Path | None = None


@dataclass(frozen=True)
class Layer:
    """An orthoimage and where it lies in the mosaic."""

    ortho: Ortho
    grid: Grid
    left: int
    top: int


@dataclass(frozen=True)
class Mosaic:
    """Orthos placed on one grid: layers, the topmost first, or the most accurate first at each pixel."""

    grid: Grid
    layers: tuple[Layer, ...]
    by_pixel: bool = False


def lay_out(orthos: Sequence[Ortho], order: str = "best-view") -> Mosaic:
    """Return where orthos lie on their common grid.

    Parameters
    ----------
    order : {'best-view', 'first-on-top', 'most-accurate'}
        What lies on top: the steepest view, in which errors of the DEM move pixels least, or the first; or at each
        pixel the ortho with the smallest ce90 there (the steepest view of equal ones).

    Raises
    ------
    InputError
        If they do not share a grid, or differ in bands, type or nodata; if one has no accuracy that would decide.
    """
    if not orthos:
        raise InputError("a mosaic needs an ortho", field="mosaic")
    without = [ortho for ortho in orthos if ortho.accuracy is None]
    if order == "most-accurate" and without:
        raise InputError(
            f"nobody says how accurate {without[0].name} is at each place", file=without[0].path, field="mosaic.order",
            remedy="give all scenes `output.accuracy_raster`, or order them by best-view",
        )  # fmt: skip
    if order != "first-on-top":
        orthos = sorted(
            orthos, key=lambda ortho: math.inf if ortho.relief_displacement is None else ortho.relief_displacement
        )
    grids = [grid_of(ortho.path) for ortho in orthos]
    first = grids[0]
    for ortho, grid in zip(orthos, grids, strict=True):
        _check_grid(orthos[0], first, ortho, grid)
    _check_bands(orthos)
    left, top = min(grid.left for grid in grids), max(grid.top for grid in grids)
    right = max(grid.left + grid.width * grid.dx for grid in grids)
    bottom = min(grid.top - grid.height * grid.dy for grid in grids)
    width, height = round((right - left) / first.dx), round((top - bottom) / first.dy)
    whole = Grid(first.crs, left, top, first.dx, first.dy, width, height)
    layers = [
        Layer(ortho, grid, round((grid.left - left) / first.dx), round((top - grid.top) / first.dy))
        for ortho, grid in zip(orthos, grids, strict=True)
    ]
    return Mosaic(whole, tuple(layers), order == "most-accurate")


def _check_grid(one: Ortho, first: Grid, other: Ortho, grid: Grid) -> None:
    columns, rows = (grid.left - first.left) / first.dx, (first.top - grid.top) / first.dy
    same_pixels = math.isclose(grid.dx, first.dx, rel_tol=1e-9) and math.isclose(grid.dy, first.dy, rel_tol=1e-9)
    off = max(abs(columns - round(columns)), abs(rows - round(rows)))
    if grid.crs != first.crs or not same_pixels or off > _SAME:
        raise InputError(
            f"{other.name} is not on the grid of {one.name}: {grid.crs.name}, {grid.dx:g} x {grid.dy:g}, off by "
            f"{off:.3f} px beside {first.crs.name}, {first.dx:g} x {first.dy:g}",
            file=other.path, field="output",
            remedy="give all scenes one crs and resolution, and an extent on multiples of it or none",
        )  # fmt: skip


def _check_bands(orthos: Sequence[Ortho]) -> None:
    first = None
    for ortho in orthos:
        source = RasterSource(ortho.path)
        nodata = tuple(None if value is None else str(value) for value in source.nodata)
        kind = f"{counted(source.count, 'band')} of {source.dtype}", source.validity, nodata
        first = first or kind
        if kind != first:
            raise InputError(
                f"{ortho.name} has {kind[0]} (valid by {kind[1]}), {orthos[0].name} {first[0]} (by {first[1]})",
                file=ortho.path, remedy="make mosaics of scenes of one kind",
            )  # fmt: skip


# -- writing ---------------------------------------------------------------------------------------------------------


def write_vrt(placed: Mosaic, path: Path) -> None:
    """Write the mosaic as a VRT that refers to the orthos by relative paths; they have to lie below its folder.

    Raises
    ------
    InputError
        If GDAL leaves an ortho out.
    """
    if placed.by_pixel:
        raise InputError("a VRT does not choose pixel by pixel", file=path, field="mosaic.format", remedy="make a COG")
    names = [str(layer.ortho.path) for layer in reversed(placed.layers)]
    with raster_output(path) as temporary:
        made = gdal.BuildVRT(
            str(temporary), names, outputBounds=placed.grid.extent, xRes=placed.grid.dx, yRes=placed.grid.dy,
            resolution="user",
        )  # fmt: skip
        with written(made) as dataset:
            size = dataset.RasterXSize, dataset.RasterYSize
            listed = {Path(name).resolve() for name in dataset.GetFileList()}
        missing = [layer.ortho.name for layer in placed.layers if layer.ortho.path.resolve() not in listed]
        if missing or size != (placed.grid.width, placed.grid.height):
            raise InputError(f"GDAL leaves out {', '.join(missing) or 'pixels'}", file=path, remedy="make a COG of it")


def write_cog(placed: Mosaic, path: Path, *, memory: int = 512_000_000, threads: int = 1) -> None:
    """Write the mosaic as a COG, window by window."""
    sources = [RasterSource(layer.ortho.path, memory=memory) for layer in placed.layers]
    profile, grid = Profile.of(sources[0]), placed.grid
    limit_cache(memory, 1, max(source.block for source in sources))
    fill = profile.dtype.type(0 if profile.nodata is None else profile.nodata)
    with RasterWriter(path, grid, profile, threads=threads) as writer:
        for top in range(0, grid.height, _WINDOW):
            for left in range(0, grid.width, _WINDOW):
                size = min(_WINDOW, grid.width - left), min(_WINDOW, grid.height - top)
                pixels = np.full((profile.count, size[1], size[0]), fill, dtype=profile.dtype)
                valid = np.zeros(pixels.shape, dtype=bool)
                best = np.full(size[::-1], np.inf, dtype=np.float32) if placed.by_pixel else None
                for layer, source in zip(placed.layers, sources, strict=True):
                    _put(layer, source, left, top, pixels, valid, best)
                writer.write(left, top, pixels, np.all(valid, axis=0))


def _put(
    layer: Layer,
    source: RasterSource,
    left: int,
    top: int,
    pixels: NDArray[Any],
    valid: NDArray[np.bool_],
    best: NDArray[np.float32] | None,
) -> None:
    """Fill what has no value yet from an ortho, or where `best` is given what is more accurate in it."""
    box = _intersection((left, top, left + pixels.shape[2], top + pixels.shape[1]), _box(layer))
    if box is None:
        return
    place = (slice(None), slice(box[1] - top, box[3] - top), slice(box[0] - left, box[2] - left))
    if best is None and valid[place].all():
        return
    there = box[0] - layer.left, box[1] - layer.top
    values = source.read(*there, box[2] - box[0], box[3] - box[1])
    good = source.read_valid(*there, values)
    good = np.ones(values.shape, dtype=bool) if good is None else np.broadcast_to(good, values.shape)
    if best is None:
        new = ~valid[place] & good
    else:
        own = _ce90(layer, *there, box[2] - box[0], box[3] - box[1])
        better = good.all(axis=0) & (own < best[place[1:]])
        best[place[1:]] = np.where(better, own, best[place[1:]])
        new = np.broadcast_to(better, values.shape)
    pixels[place] = np.where(new, values, pixels[place])
    valid[place] |= new


def _ce90(layer: Layer, left: int, top: int, width: int, height: int) -> NDArray[np.float32]:
    """Return the circular error (m) in a window of an ortho, of the nearest pixel of its raster of accuracy.

    Where nothing is known it is larger than any that is.
    """
    assert layer.ortho.accuracy is not None
    source = RasterSource(layer.ortho.accuracy)
    own = grid_of(layer.ortho.accuracy)
    steps = [round(size / pixel) for size, pixel in zip((own.dx, own.dy), (layer.grid.dx, layer.grid.dy), strict=True)]
    columns, rows = (np.arange(left, left + width) // steps[0], np.arange(top, top + height) // steps[1])
    part = source.read(int(columns[0]), int(rows[0]), int(columns[-1] - columns[0] + 1), int(rows[-1] - rows[0] + 1))
    found = part[-1][np.ix_(rows - rows[0], columns - columns[0])]
    return np.where(np.isfinite(found), found, np.finfo(np.float32).max).astype(np.float32)


def _box(layer: Layer) -> tuple[int, int, int, int]:
    return layer.left, layer.top, layer.left + layer.grid.width, layer.top + layer.grid.height


def _intersection(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> tuple[int, int, int, int] | None:
    """Return the common part of two boxes (left, top, right, bottom); None where there is none."""
    left, top, right, bottom = (
        max(one[0], other[0]),
        max(one[1], other[1]),
        min(one[2], other[2]),
        min(one[3], other[3]),
    )
    return (left, top, right, bottom) if left < right and top < bottom else None


# -- seams -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Overlap:
    """Two layers whose valid pixels overlap, in `pixels` of the mosaic."""

    first: Layer
    second: Layer
    pixels: float


def overlaps(placed: Mosaic) -> list[Overlap]:
    """Return all pairs of layers that overlap, in the order of the layers."""
    outlines = [valid_outline(layer.ortho.path) for layer in placed.layers]
    tree = shapely.STRtree(outlines)
    found = []
    for i, j in sorted({(int(a), int(b)) for a, b in tree.query(outlines, predicate="intersects").T if a < b}):
        area = shapely.intersection(outlines[i], outlines[j]).area / (placed.grid.dx * placed.grid.dy)
        if area >= 1:
            found.append(Overlap(placed.layers[i], placed.layers[j], area))
    return found


def measure_seam(overlap: Overlap) -> dict[str, Any]:
    """Measure how far the content of the second ortho of an overlap lies from that of the first, in pixels.

    Returns
    -------
    dict
        `first`, `second`, `overlap_px`, `patches` (how many agreed upon by correlation), and over these `median_px`
        [column, row], `rmse_px` and `largest_px` of the lengths; None where there is no patch.
    """
    first, second = overlap.first, overlap.second
    box = _intersection(_box(first), _box(second))
    shifts = np.zeros((0, 2)) if box is None else _shifts(first, second, box)
    lengths = np.hypot(*shifts.T)
    some = len(shifts) > 0
    return {
        "first": first.ortho.name,
        "second": second.ortho.name,
        "overlap_px": round(overlap.pixels),
        "patches": len(shifts),
        "median_px": np.median(shifts, axis=0).tolist() if some else None,
        "rmse_px": float(np.sqrt(np.mean(lengths**2))) if some else None,
        "largest_px": float(lengths.max()) if some else None,
    }


def _shifts(first: Layer, second: Layer, box: tuple[int, int, int, int]) -> NDArray[np.float64]:
    sources = [RasterSource(layer.ortho.path) for layer in (first, second)]
    found = [np.zeros((0, 2))]
    for left, top, width, height in _windows(box):
        bands, valid = [], np.ones((height, width), dtype=bool)
        for layer, source in zip((first, second), sources, strict=True):
            there = left - layer.left, top - layer.top
            values = source.read(*there, width, height)
            good = source.read_valid(*there, values)
            if good is not None:
                valid &= good[0]
            bands.append(values[0].astype(np.float64))
        if not valid.any():
            continue
        one, other = (details(np.where(valid, band, band[valid].mean())) for band in bands)
        for patch in _PATCHES:
            ties = _ties(one, other, valid, patch)
            if len(ties) >= _ENOUGH:
                break
        found.append(ties)
    return np.concatenate(found)


def _ties(
    one: NDArray[np.float64], other: NDArray[np.float64], valid: NDArray[np.bool_], patch: int
) -> NDArray[np.float64]:
    """Return the shifts ``(N, 2)`` px of the patches of a window.

    What is cut out at the same place in both is pulled towards no shift at all, so it is measured a second time around
    what was found.
    """
    ties = np.zeros((0, 2))
    if patch + 2 > min(one.shape):
        return ties
    for _ in range(2):
        known = np.rint(np.median(ties, axis=0)) if len(ties) else np.zeros(2)
        reference, moving = measure(
            one, other, lambda image, known=known: image + known, patch=patch, spacing=patch // 2
        )
        inside = [_all_valid(valid, centre, patch // 2 + _MARGIN) for centre in reference]
        ties = (moving - reference)[inside]
    return ties


def _all_valid(valid: NDArray[np.bool_], centre: NDArray[np.float64], reach: int) -> bool:
    column, row = (int(value) for value in centre)
    rows, columns = slice(max(0, row - reach), row + reach), slice(max(0, column - reach), column + reach)
    return bool(valid[rows, columns].all())


def _windows(box: tuple[int, int, int, int]) -> Iterator[tuple[int, int, int, int]]:
    """Yield windows (left, top, width, height) spread over a box."""
    width, height = min(box[2] - box[0], _SEAM_WINDOW), min(box[3] - box[1], _SEAM_WINDOW)
    across, down = (math.ceil((box[k + 2] - box[k]) / _SEAM_WINDOW) for k in (0, 1))
    shrink = max(1.0, math.sqrt(across * down / _SEAM_WINDOWS))
    across, down = max(1, round(across / shrink)), max(1, round(down / shrink))
    for top in np.linspace(box[1], box[3] - height, down).astype(int).tolist():
        for left in np.linspace(box[0], box[2] - width, across).astype(int).tolist():
            yield left, top, width, height


def summary(placed: Mosaic, seams: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what there is to say of a mosaic as JSON values."""
    measured = [seam for seam in seams if seam["patches"]]
    lengths = [math.hypot(*seam["median_px"]) for seam in measured]
    worst = max(zip(lengths, measured, strict=True), key=lambda pair: pair[0], default=None)
    return {
        "crs": crs_text(placed.grid.crs),
        "extent": [float(value) for value in placed.grid.extent],
        "resolution": [placed.grid.dx, placed.grid.dy],
        "size": [placed.grid.width, placed.grid.height],
        "on_top_first": [layer.ortho.name for layer in placed.layers],
        "seams": [dict(seam) for seam in seams],
        "seams_measured": len(measured),
        "median_seam_px": float(np.median(lengths)) if lengths else None,
        "worst_seam": worst and {"first": worst[1]["first"], "second": worst[1]["second"], "px": worst[0]},
    }
