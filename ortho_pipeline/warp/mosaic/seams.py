"""Differences of orthos along the seams of a mosaic: in brightness, and in position (pixels).

Samples are spread along each seam. Brightness is compared in a few pixels around a sample, position by chips of the
matcher: orientation correlation, then least squares.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.imaging.matching import least_squares
from ortho_pipeline.imaging.matching.correlation import orientation, peaks, surfaces
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.source import MEMORY
from ortho_pipeline.warp.mosaic.balance import Balance
from ortho_pipeline.warp.mosaic.layout import Mosaic
from ortho_pipeline.warp.mosaic.reading import Opened, open_layers
from ortho_pipeline.warp.mosaic.seamlines import Labels

#: Largest number of samples per seam; side of a chip, radius of its search, and radius of compared pixels (px).
_PLACES, _CHIP, _REACH, _BESIDE = 48, 32, 8, 2
_WIDE = _CHIP + 2 * _REACH
#: Limits for a match: correlation in the search and after it, and that of the second best position.
_LEAST_SCORE, _LEAST_CORRELATION, _UNIQUE = 0.25, 0.4, 0.8
#: Least valid part of a chip.
_SEEN = 0.95


def along_seams(
    placed: Mosaic, labels: Labels, cell: int, balance: Balance | None, *, memory: int = MEMORY
) -> dict[tuple[str, str], dict[str, Any]]:
    """Return measurements along the seams between cells of different layers, by the names of both.

    Parameters
    ----------
    labels : (rows, columns)
        The layer of each cell, -1 for none.
    balance : Balance, optional
        Applied before brightness is compared.

    Returns
    -------
    dict
        `length_px`, `places`; `difference` and `rms` of each band (first minus second; None without a place), and
        `largest_rms`, that of the worst place;
        `matched`, and of these `median_px` [column, row] of the second against the first, `rmse_px` and `largest_px`.
    """
    opened = open_layers(placed, memory)
    names = [layer.ortho.name for layer in placed.layers]
    return {
        (names[first], names[second]): _measured(opened, (first, second), places, cell, balance)
        for (first, second), places in sorted(_places(labels).items())
    }


def _places(labels: Labels) -> dict[tuple[int, int], Array]:
    """Return the corners ``(n, 2)`` (column, row of cells) in the middle of the edges of each seam."""
    corners: dict[tuple[int, int], list[Array]] = {}
    for one, other, shift in (
        (labels[:, :-1], labels[:, 1:], (1.0, 0.5)),
        (labels[:-1], labels[1:], (0.5, 1.0)),
    ):
        rows, columns = np.nonzero((one != other) & (one >= 0) & (other >= 0))
        ends = np.sort(np.stack([one[rows, columns], other[rows, columns]], axis=1), axis=1)
        places = np.stack([columns + shift[0], rows + shift[1]], axis=1)
        for first, second in np.unique(ends, axis=0):
            which = (ends == (first, second)).all(axis=1)
            corners.setdefault((int(first), int(second)), []).append(places[which])
    return {pair: np.concatenate(some) for pair, some in corners.items()}


def _measured(
    opened: list[Opened], pair: tuple[int, int], places: Array, cell: int, balance: Balance | None
) -> dict[str, Any]:
    chosen = places[np.unique(np.linspace(0, len(places) - 1, _PLACES).astype(int))] * cell
    bands = opened[pair[0]].source.count
    chips, sums, seen, largest = [], np.zeros((2, bands)), 0, np.zeros(bands)
    for column, row in np.rint(chosen).astype(int).tolist():
        box = column - _WIDE, row - _WIDE, column + _WIDE, row + _WIDE
        (one, valid), (other, also) = (opened[number].read_around(box) for number in pair)
        if balance is not None:
            one, other = (balance.apply(number, part) for number, part in zip(pair, (one, other), strict=True))
        near = (slice(_WIDE - _BESIDE, _WIDE + _BESIDE),) * 2
        both = (valid & also)[near]
        difference = (one - other)[(slice(None), *near)][:, both]
        sums += np.stack([difference.sum(axis=1), (difference**2).sum(axis=1)])
        seen += int(both.sum())
        if both.any():
            largest = np.maximum(largest, np.sqrt((difference**2).mean(axis=1)))
        part = _best_part(valid & also)
        chips.append([np.where(valid & also, values.mean(axis=0), np.nan)[part] for values in (one, other)])
    shifts = _shifts(np.array(chips, dtype=np.float32))
    lengths, some = np.hypot(*shifts.T), len(shifts) > 0
    return {
        "length_px": len(places) * cell,
        "places": len(chosen),
        "difference": (sums[0] / seen).tolist() if seen else None,
        "rms": np.sqrt(sums[1] / seen).tolist() if seen else None,
        "largest_rms": largest.tolist() if seen else None,
        "matched": len(shifts),
        "median_px": np.median(shifts, axis=0).tolist() if some else None,
        "rmse_px": float(np.sqrt(np.mean(lengths**2))) if some else None,
        "largest_px": float(lengths.max()) if some else None,
    }


def _best_part(valid: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the chip-sized part of a window (of nine around its middle) with the most valid pixels in both.

    If a seam follows the edge of an ortho, the middle itself is not valid.
    """
    sums = np.pad(np.cumsum(np.cumsum(valid, axis=0), axis=1), ((1, 0), (1, 0)))
    starts = [_WIDE // 2 + step for step in (0, -(_WIDE // 2), _WIDE // 2)]
    places = [(row, column) for row in starts for column in starts]
    counts = [
        sums[row + _WIDE, column + _WIDE] - sums[row, column + _WIDE] - sums[row + _WIDE, column] + sums[row, column]
        for row, column in places
    ]
    row, column = places[int(np.argmax(counts))]
    return slice(row, row + _WIDE), slice(column, column + _WIDE)


def _shifts(chips: NDArray[np.float32]) -> Array:
    """Return the shift ``(n, 2)`` px of the second of two chips ``(n, 2, s, s)`` relative to the first."""
    inner = (slice(None), slice(_REACH, -_REACH), slice(_REACH, -_REACH))
    known = [np.isfinite(part).mean(axis=(1, 2)) >= _SEEN for part in (chips[:, 0][inner], chips[:, 1])]
    chips = chips[known[0] & known[1]]
    if not len(chips):
        return np.zeros((0, 2))
    scene, target = np.ascontiguousarray(chips[:, 0][inner]), np.ascontiguousarray(chips[:, 1])
    shifts = peaks(surfaces(orientation(scene), orientation(target)))
    measured = least_squares.measure(scene, target, shifts.shift)
    good = shifts.inside & (shifts.score >= _LEAST_SCORE) & (shifts.ratio <= _UNIQUE)
    with np.errstate(invalid="ignore"):
        good &= np.abs(measured.correlation) >= _LEAST_CORRELATION
    return np.asarray(measured.shift[good & np.isfinite(measured.shift).all(axis=1)])
