"""Candidates for matching: the cells of a scene, and in each the chip with the most structure in two directions.

Source: Foerstner and Guelch 1987 (interest operator: the smaller eigenvalue of the structure tensor).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ortho_pipeline.files.locations import Location
from ortho_pipeline.imaging.matching.targets import SceneView
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.intensity import Intensity

#: Largest window (chip px) to search in a cell, so the cost does not depend on the size of the scene.
_WINDOW = 128
#: A chip with a larger share of saturated pixels is a cloud or a sunlit roof.
_SATURATED = 0.2
#: Of an image on another machine: the part of its blocks to read, the side (chip px) of the window at a spot, which is
#: what the search for the position reads there, and the chips per side of that window.
_READ, _SPOT, _AT_SPOT = 0.1, 168, 3
#: Width of the border of the scene to keep free (chip px).
RIM = 2


def cells_of(width: float, height: float, count: int) -> tuple[int, int]:
    """Return columns and rows of a grid of about `count` nearly square cells."""
    columns = max(1, round(math.sqrt(count * width / height)))
    return columns, max(1, round(count / columns))


def candidates(
    view: SceneView,
    region: tuple[int, int, int, int],
    cells: tuple[int, int],
    size: int,
    factor: int,
    inside: NDArray[np.bool_],
    apart: bool = False,
) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return first pixels ``(n, 2)`` of the chip with the most structure in each cell, and the cells ``(n,)``.

    Parameters
    ----------
    region : (left, top, right, bottom)
        The part of the scene (px) to search.
    cells : (int, int)
        Columns and rows of the grid over it.
    size, factor : int
        A chip has `size` x `size` means of `factor` x `factor` pixels.
    inside : (rows, columns) of bool
        Cells to search.
    apart : bool
        Whether whole chips stay in their cells, if these are large enough, so that neighbours share no pixels.
        Otherwise only their centres do.
    """
    width, height = region[2] - region[0], region[3] - region[1]
    fits = min(width / cells[0], height / cells[1]) >= (size + 2 * RIM) * factor
    within = size / 2 * factor if apart and fits else 0.0
    parts = []
    for number in np.flatnonzero(inside.ravel()).tolist():
        row, column = divmod(number, cells[0])
        left, right = (region[0] + width * place / cells[0] for place in (column, column + 1))
        top, bottom = (region[1] + height * place / cells[1] for place in (row, row + 1))
        parts.append(((left + within, top + within, right - within, bottom - within), number))
    return _best_of(view, parts, size, factor)


def spots_of(view: SceneView, images: Sequence[Intensity]) -> int | None:
    """Return how many spots per side to look at, so that few blocks are read; None if all images are on this machine.

    The matcher reads a window of `_SPOT` pixels at each spot, from each image.
    """
    if not any(Location(image.source.path).is_far for image in images):
        return None
    width, height = view.size
    columns, rows = view.intensity.source.bands[0].GetBlockSize()
    read = (1 + _SPOT / columns) * (1 + _SPOT / rows)
    return int(np.clip(math.sqrt(_READ * (width / columns) * (height / rows) / read), 3, view.spots))


def at_spots(
    view: SceneView, region: tuple[int, int, int, int], size: int, factor: int, inside: NDArray[np.bool_]
) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    """Return chips as `candidates` does, several at each spot: the middles of the cells ``(rows, columns)``.

    Each has a number of its own, from `_AT_SPOT`² times that of its cell on.
    """
    half = (_SPOT - size) / 2 * factor
    edges = np.linspace(-half, half, _AT_SPOT + 1).tolist()
    parts = []
    for number in np.flatnonzero(inside.ravel()).tolist():
        row, column = divmod(number, inside.shape[1])
        x = region[0] + (region[2] - region[0]) * (column + 0.5) / inside.shape[1]
        y = region[1] + (region[3] - region[1]) * (row + 0.5) / inside.shape[0]
        pieces = itertools.product(itertools.pairwise(edges), repeat=2)
        for piece, ((top, bottom), (left, right)) in enumerate(pieces, number * _AT_SPOT**2):
            parts.append(((x + left, y + top, x + right, y + bottom), piece))
    return _best_of(view, parts, size, factor)


def _best_of(
    view: SceneView, parts: Sequence[tuple[tuple[float, float, float, float], int]], size: int, factor: int
) -> tuple[NDArray[np.int_], NDArray[np.int_]]:
    chosen = []
    found = view.intensity.found
    for cell, number in parts:
        asked = cell, size, factor
        if asked not in found:
            found[asked] = _best(view, cell, size, factor)
        place = found[asked]
        if place is not None:
            chosen.append((*place, number))
    table = np.array(chosen, dtype=int).reshape(-1, 3)
    # Neighbouring cells may choose the same place on their common side.
    table = table[np.sort(np.unique(table[:, :2], axis=0, return_index=True)[1])]
    return table[:, :2], table[:, 2]


def _best(view: SceneView, cell: tuple[float, float, float, float], size: int, factor: int) -> tuple[int, int] | None:
    """Return the first pixel of the chip with the most structure whose centre is in a cell."""
    width, height = view.size
    middle = (cell[0] + cell[2]) / 2, (cell[1] + cell[3]) / 2
    # Centres of chips: within the cell, and so far from the border that the chip fits.
    reach = [
        min((last - first) / 2, (_WINDOW - size) / 2 * factor)
        for first, last in ((cell[0], cell[2]), (cell[1], cell[3]))
    ]
    half = (size / 2 + RIM) * factor
    low = [max(centre - part, half) for centre, part in zip(middle, reach, strict=True)]
    high = [min(centre + part, extent - half) for centre, part, extent in zip(middle, reach, view.size, strict=True)]
    if low[0] > high[0] + 1 or low[1] > high[1] + 1:
        return None
    left, top = (int(value - size / 2 * factor) for value in low)
    columns, rows = (int((last - first) // factor) + size for first, last in zip(low, high, strict=True))
    columns, rows = min(columns, (width - left) // factor), min(rows, (height - top) // factor)
    if columns < size or rows < size:
        return None
    pixels = view.intensity.read(left, top, columns, rows, factor)
    value = _structure(pixels, size, view.intensity.saturated)
    if not np.isfinite(value).any():
        return None
    j, i = np.unravel_index(int(np.nanargmax(value)), value.shape)
    return left + int(i) * factor, top + int(j) * factor


def _structure(pixels: NDArray[np.float32], size: int, saturated: float) -> Array:
    """Return the smaller eigenvalue of the mean structure tensor of each chip; NaN if one of its pixels is invalid."""
    valid = np.isfinite(pixels)
    filled = np.where(valid, pixels, 0.0).astype(float)
    down, across = np.gradient(ndimage.gaussian_filter(filled, 1.0))
    first = size // 2

    def mean(values: Array) -> Array:
        rows = ndimage.uniform_filter1d(values, size, axis=0, mode="constant")
        rows = rows[first : first + len(values) - size + 1]
        found = ndimage.uniform_filter1d(rows, size, axis=1, mode="constant")
        return np.asarray(found[:, first : first + values.shape[1] - size + 1])

    xx, yy, xy = mean(across**2), mean(down**2), mean(across * down)
    value = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    usable = value > 0
    if not valid.all():
        usable &= mean(valid.astype(float)) > 1 - 0.5 / size**2
    if filled.max() >= saturated:
        usable &= mean((filled >= saturated).astype(float)) <= _SATURATED
    return np.where(usable, value, np.nan)
