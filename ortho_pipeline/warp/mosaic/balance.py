r"""Brightness of the orthos of a mosaic, made alike: a gain and an offset of each ortho and band.

Where orthos i and j overlap, means over small cells, :math:`v_i` and :math:`v_j`, give an equation

.. math:: a_i v_i + b_i = a_j v_j + b_j,

all of them together one least-squares problem for each band. What changed in between (clouds, shadows, water) is no
part of it: it begins with lines of repeated medians, which half of the cells cannot disturb, and goes on with Tukey's
weights. No absolute brightness follows from differences, so the datum is that gains have a mean of 1 and offsets of 0
over all orthos that hang together. What overlaps do not tell (a gain where all is equally bright) is held by a weak
prior.

Source: Chandelier and Martinoty 2009, A radiometric aerial triangulation (the global adjustment); Siegel 1982 (repeated
medians).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats
from scipy.sparse import csgraph
from scipy.sparse.linalg import spsolve

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.source import MEMORY
from ortho_pipeline.warp.mosaic.layout import Box, Mosaic, box_of, intersection
from ortho_pipeline.warp.mosaic.overlaps import Overlap
from ortho_pipeline.warp.mosaic.reading import open_layers

#: Side of a cell, of the windows that are read (px), and windows per side of an overlap, at most.
_CELL, _WINDOW, _PER_SIDE = 16, 128, 8
#: Standard deviations of gains and of offsets (in spreads of the brightness) where nothing else tells of them.
_GAIN, _OFFSET = 0.5, 1.0
#: Limit of Tukey's weights in robust standard deviations; steps, and cells that a line is taken through.
_TUKEY, _STEPS, _OF_A_LINE = 4.685, 20, 400
#: Scatter about a line (in spreads of the brightness) below which it is no better for less.
_LEAST_SCATTER = 0.01
#: A gain beyond this, or below its inverse, says that two orthos do not show the same thing.
_LARGEST_GAIN = 5.0


@dataclass(frozen=True, eq=False)
class Balance:
    """Gains and offsets of the layers of a mosaic.

    Parameters
    ----------
    gains, offsets : (layers, bands)
        A pixel v becomes gain v + offset.
    before, after : (bands,)
        Root mean square of the differences of cells that agree, in units of the pixels.
    cells : int
        Cells that were compared.
    outlying : float
        Share of the cells that do not agree with the others, mean of the bands.
    """

    gains: Array
    offsets: Array
    before: Array
    after: Array
    cells: int
    outlying: float

    def apply(self, layer: int, pixels: NDArray[np.floating]) -> Array:
        """Return the pixels ``(bands, ...)`` of a layer as they are in the mosaic."""
        shape = (-1,) + (1,) * (pixels.ndim - 1)
        return np.asarray(pixels * self.gains[layer].reshape(shape) + self.offsets[layer].reshape(shape))


def balanced(placed: Mosaic, pairs: Sequence[Overlap], *, memory: int = MEMORY) -> Balance:
    """Return the gains and offsets that make the orthos of a mosaic alike where they overlap.

    Raises
    ------
    InputError
        If two orthos do not show the same thing; if they have a palette.
    """
    opened = open_layers(placed, memory)
    for raster in opened:
        if raster.source.palette:
            raise InputError(
                "palette indices have no brightness",
                file=raster.layer.ortho.path,
                field="mosaic.balance",
                remedy="leave it out",
            )
    number = {id(layer): k for k, layer in enumerate(placed.layers)}
    # An alpha band has no brightness.
    bands = Profile.of(opened[0].source).colours
    ends, means = [], []
    for pair in pairs:
        first, second = number[id(pair.first)], number[id(pair.second)]
        box = intersection(box_of(pair.first), box_of(pair.second))
        for window in () if box is None else _windows(box):
            (values, valid), (others, also) = (opened[k].read_around(window) for k in (first, second))
            cell_means = _cell_means(values[bands], others[bands], valid & also)
            means.append(cell_means)
            ends.append(np.broadcast_to([first, second], (len(cell_means), 2)))
    count, all_bands = len(placed.layers), opened[0].source.count
    cells = np.concatenate(means) if means else np.zeros((0, 2, len(bands)))
    which = np.concatenate(ends) if ends else np.zeros((0, 2), dtype=int)
    gains, offsets = np.ones((count, all_bands)), np.zeros((count, all_bands))
    before, after, outlying = np.zeros(all_bands), np.zeros(all_bands), []
    for band, of_band in zip(bands, np.moveaxis(cells, 2, 0), strict=True):
        known = np.isfinite(of_band[:, 0])
        if not known.any():
            continue
        layers, seen = which[known], of_band[known]
        gains[:, band], offsets[:, band], good = _solved(layers, seen, count)
        balanced_means = seen * gains[layers, band] + offsets[layers, band]
        before[band], after[band] = (_rms(np.diff(values[good], axis=1)) for values in (seen, balanced_means))
        outlying.append(1.0 - float(good.mean()))
    wrong = np.argwhere(~((gains > 1 / _LARGEST_GAIN) & (gains < _LARGEST_GAIN)))
    if len(wrong):
        layer, band = wrong[0]
        raise InputError(
            f"band {band + 1} of {placed.layers[layer].ortho.name} needs a gain of {gains[layer, band]:.3g}: it "
            "does not match the orthos that overlap it",
            file=placed.layers[layer].ortho.path,
            field="mosaic.balance",
            remedy="leave the option out, or combine only scenes of one kind",
        )
    return Balance(gains, offsets, before, after, len(cells), sum(outlying) / max(len(outlying), 1))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _windows(box: Box) -> list[Box]:
    """Return windows spread evenly over a box."""
    starts = []
    for low, high in ((box[0], box[2]), (box[1], box[3])):
        side = min(_WINDOW, high - low)
        count = min(_PER_SIDE, math.ceil((high - low) / _WINDOW))
        starts.append([(int(start), int(start) + side) for start in np.linspace(low, high - side, count)])
    return [(left, top, right, bottom) for top, bottom in starts[1] for left, right in starts[0]]


def _cell_means(values: Array, other: Array, valid: NDArray[np.bool_]) -> Array:
    """Return the means of both ``(n, 2, bands)`` over the cells of a window that are valid in both.

    A cell all of whose pixels are equal is saturated, or filled: it tells nothing. It is NaN in such a band, and left
    out if all bands are so.
    """
    rows, columns = valid.shape[0] // _CELL, valid.shape[1] // _CELL
    cells = (..., slice(0, rows * _CELL), slice(0, columns * _CELL))
    full = valid[cells].reshape(rows, _CELL, columns, _CELL).all(axis=(1, 3))
    parts = [part[cells].reshape(len(part), rows, _CELL, columns, _CELL) for part in (values, other)]
    varied = np.all([part.max(axis=(2, 4)) > part.min(axis=(2, 4)) for part in parts], axis=0)
    full &= varied.any(axis=0)
    return np.stack([np.where(varied, part.mean(axis=(2, 4)), np.nan)[:, full].T for part in parts], axis=1)


def _solved(ends: NDArray[np.int_], cells: Array, count: int) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return gains and offsets ``(count,)`` of one band, and which cells ``(n,)`` agree with them.

    Parameters
    ----------
    ends : (n, 2)
        The layers of each cell.
    cells : (n, 2)
        Its means in them.
    """
    middle, spread = float(np.median(cells)), max(float(cells.std()), 1e-12)
    values = (cells - middle) / spread
    unknowns = _start(ends, values, count)
    scale = 0.0
    for _ in range(_STEPS):
        pairs = unknowns.reshape(-1, 2)
        corrected = values * pairs[ends, 0] + pairs[ends, 1]
        residual = corrected[:, 0] - corrected[:, 1]
        scale = max(1.4826 * float(np.median(np.abs(residual))), 1e-9)
        weight = np.maximum(0.0, 1.0 - (residual / (_TUKEY * scale)) ** 2) ** 2
        unknowns = _step(ends, values, weight / scale**2, count)
    gains, shifts = unknowns.reshape(-1, 2).T
    # gain (v - middle) + shift spread + middle
    return gains, middle * (1.0 - gains) + shifts * spread, weight > 0


def _start(ends: NDArray[np.int_], values: Array, count: int) -> Array:
    """Return gains and offsets (gain, offset, gain, …) by lines that half of the cells of an overlap cannot disturb.

    The line of each overlap is that of repeated medians. Its slope is a ratio of gains, from which all follow; the
    better cells lie on it, the more it counts.
    """
    pairs, which = np.unique(ends, axis=0, return_inverse=True)
    cells = [values[which.ravel() == k].T for k in range(len(pairs))]
    lines = np.array([_line(first, second) for first, second in cells])
    weight = np.array([first.size for first, _ in cells]) / lines[:, 1] ** 2
    # gain of the second = slope times the gain of the first
    gains = np.exp(_differences(pairs, np.log(lines[:, 0]), weight, count))
    apart = [
        np.median(gains[i] * first - gains[j] * second) for (i, j), (first, second) in zip(pairs, cells, strict=True)
    ]
    offsets = _differences(pairs, np.array(apart), weight, count)
    return np.stack([gains, offsets], axis=1).ravel()


def _line(first: Array, second: Array) -> tuple[float, float]:
    """Return the slope of the first against the second ``(n,)``, and the robust scatter about that line."""
    chosen = np.linspace(0, len(first) - 1, min(len(first), _OF_A_LINE)).astype(int)
    x, y = first[chosen], second[chosen]
    if not np.ptp(y) > 0:
        return 1.0, 1.0
    line = stats.siegelslopes(x, y)
    slope = float(line.slope) if math.isfinite(line.slope) else 1.0
    scatter = 1.4826 * float(np.median(np.abs(x - line.slope * y - line.intercept)))
    return float(np.clip(slope, 1 / _LARGEST_GAIN, _LARGEST_GAIN)), max(scatter, _LEAST_SCATTER)


def _differences(pairs: NDArray[np.int_], wanted: Array, weight: Array, count: int) -> Array:
    """Return values ``(count,)`` about 0 whose differences (second minus first) are as wanted, about."""
    rows = np.repeat(np.arange(len(pairs)), 2)
    design = sparse.csr_matrix((np.tile([-1.0, 1.0], len(pairs)), (rows, pairs.ravel())), shape=(len(pairs), count))
    weighted = design.T @ sparse.diags(weight / weight.max())
    return np.asarray(spsolve((weighted @ design + 1e-9 * sparse.identity(count)).tocsc(), weighted @ wanted))


def _step(ends: NDArray[np.int_], values: Array, weight: Array, count: int) -> Array:
    """Return the unknowns (gain, offset, gain, …) of weighted equations under the datum of each connected part."""
    equations = np.arange(len(values))
    rows = np.repeat(equations, 4)
    columns = np.stack([2 * ends[:, 0], 2 * ends[:, 0] + 1, 2 * ends[:, 1], 2 * ends[:, 1] + 1], axis=1).ravel()
    ones = np.ones(len(values))
    entries = np.stack([values[:, 0], ones, -values[:, 1], -ones], axis=1).ravel()
    design = sparse.csr_matrix((entries, (rows, columns)), shape=(len(values), 2 * count))
    held = np.tile([1 / _GAIN**2, 1 / _OFFSET**2], count)
    normal = design.T @ sparse.diags(weight) @ design + sparse.diags(held)
    graph = sparse.csr_matrix((ones, (ends[:, 0], ends[:, 1])), shape=(count, count))
    parts, label = csgraph.connected_components(graph, directed=False)
    # Of each part the sum of its gains, and that of its offsets.
    which = np.stack([2 * label, 2 * label + 1], axis=1).ravel()
    datum = sparse.csr_matrix((np.ones(2 * count), (which, np.arange(2 * count))), shape=(2 * parts, 2 * count))
    wanted = np.stack([np.bincount(label, minlength=parts), np.zeros(parts)], axis=1).ravel()
    system = sparse.bmat([[normal, datum.T], [datum, None]], format="csc")
    right = np.concatenate([held * np.tile([1.0, 0.0], count), wanted])
    return np.asarray(spsolve(system, right)[: 2 * count])
