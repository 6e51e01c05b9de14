"""Pairs of orthos that overlap, and how well their content agrees there: phase correlation of patches."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from ortho_pipeline.imaging.registration import details, measure
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.raster.valid_area import valid_outline
from ortho_pipeline.warp.mosaic.layout import Box, Mosaic, PlacedOrtho, box_of, intersection

#: Side of the windows in which seams are measured.
_SEAM_WINDOW = 384
#: Windows per seam, at most, and patches in one that are enough.
_SEAM_WINDOWS, _ENOUGH = 9, 4
#: Sides of the patches that are correlated, the largest that the overlap allows; a quarter of it is the reach.
_PATCHES = (128, 64, 32)
#: Pixels around a patch that have to be valid too: the edge of the values, blurred, is the same in both orthos.
_MARGIN = 18


@dataclass(frozen=True)
class Overlap:
    """Two layers whose valid pixels overlap, in `pixels` of the mosaic."""

    first: PlacedOrtho
    second: PlacedOrtho
    pixels: float


def overlaps(placed: Mosaic) -> list[Overlap]:
    """Return all pairs of layers that overlap, in the order of the layers."""
    outlines = [valid_outline(layer.ortho.path) for layer in placed.layers]
    tree = shapely.STRtree(outlines)
    pairs = []
    for i, j in sorted({(int(a), int(b)) for a, b in tree.query(outlines, predicate="intersects").T if a < b}):
        area = shapely.intersection(outlines[i], outlines[j]).area / (placed.grid.dx * placed.grid.dy)
        if area >= 1:
            pairs.append(Overlap(placed.layers[i], placed.layers[j], area))
    return pairs


def measure_seam(overlap: Overlap) -> dict[str, Any]:
    """Measure the shift of the second ortho of an overlap from the first, in pixels.

    Returns
    -------
    dict
        `first`, `second`, `overlap_px`, `patches` (how many agreed upon by correlation), and over these `median_px`
        [column, row], `rmse_px` and `largest_px` of the lengths; None where there is no patch.
    """
    first, second = overlap.first, overlap.second
    box = intersection(box_of(first), box_of(second))
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


def _shifts(first: PlacedOrtho, second: PlacedOrtho, box: Box) -> NDArray[np.float64]:
    sources = [RasterSource(layer.ortho.path) for layer in (first, second)]
    shifts = [np.zeros((0, 2))]
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
        shifts.append(ties)
    return np.concatenate(shifts)


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
    # The short side of a long and thin box cannot be shrunk.
    if across > down:
        across = min(across, _SEAM_WINDOWS // down)
    else:
        down = min(down, _SEAM_WINDOWS // across)
    for top in np.linspace(box[1], box[3] - height, down).astype(int).tolist():
        for left in np.linspace(box[0], box[2] - width, across).astype(int).tolist():
            yield left, top, width, height
