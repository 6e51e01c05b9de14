"""Choose the ortho of each pixel of a mosaic: by the order, or with seam lines where orthos differ least.

The mosaic is divided into cells, of one pixel if there are not too many. By the order (steepest view, first, most
accurate), each cell belongs to the topmost ortho that fills it. A seam can move by up to `_REACH` pixels where two
orthos fill a cell. Cells farther away keep their ortho; from these markers, the rest is flooded in the order of the
differences, the largest first. So regions meet where orthos differ least, and no seam crosses a car, a cloud or a roof
that is not in both orthos, if there is a way around. This is a watershed with markers. Unlike a shortest path or a
minimum cut, it handles any number of orthos and any form of overlaps at once, in n log n, with a unique result.

Small holes of an ortho (hidden pixels) are filled exactly: seams around them do not move.

Source: Soille 2006, Morphological image compositing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.source import MEMORY
from ortho_pipeline.warp.mosaic.balance import Balance
from ortho_pipeline.warp.mosaic.layout import Box, Mosaic, box_of, circular_errors, intersection, windows
from ortho_pipeline.warp.mosaic.reading import Opened, open_layers

#: Largest number of cells (100 bytes each, plus 8 for each band), and approximate side (px) of the windows.
_CELLS, _WINDOW = 1 << 21, 1024
#: Largest move of a seam (px), and least number of cells for it.
_REACH, _REACH_CELLS = 256, 8
#: Number of levels of differences, in factors of two; differences up to a quarter of the usual one are level 0.
_LEVELS_PER_OCTAVE, _ALIKE = 2, 0.25
#: Distance (cells) of a seam from a difference, if possible, because edges are blurred and differ in position.
_BESIDE = 2

Labels = NDArray[np.int16]


@dataclass(frozen=True, eq=False)
class Owners:
    """The layer of each cell of a mosaic; -1 without one.

    Parameters
    ----------
    cell : int
        Pixels per side of a cell.
    ordered : (rows, columns)
        By the order of the mosaic.
    owners : (rows, columns)
        With the final seams.
    """

    cell: int
    ordered: Labels
    owners: Labels

    def window(self, left: int, top: int, width: int, height: int) -> Labels:
        """Return the layers of the pixels of a window ``(height, width)``."""
        rows, columns = (top + np.arange(height)) // self.cell, (left + np.arange(width)) // self.cell
        return self.owners[np.ix_(rows, columns)]


def owners_of(placed: Mosaic, balance: Balance | None, *, seamlines: bool, memory: int = MEMORY) -> Owners:
    """Return the ortho of each cell of a mosaic.

    Parameters
    ----------
    balance : Balance, optional
        Applied before brightness is compared.
    seamlines : bool
        Whether seams can move to where orthos differ least.

    Raises
    ------
    InputError
        If pixels are palette indices, which cannot be compared.
    """
    opened = open_layers(placed, memory)
    for layer in opened:
        if seamlines and layer.source.palette:
            raise InputError(
                "seam lines cannot follow palette indices",
                file=layer.layer.ortho.path,
                field="mosaic.seamlines",
                remedy="leave it out",
            )
    cells = _Cells(placed, opened[0].source.count)
    for number, layer in enumerate(opened):
        cells.add(number, layer, balance)
    return Owners(cells.cell, cells.top, cells.moved() if seamlines else cells.top)


class _Cells:
    """Statistics of the cells of a mosaic, collected layer by layer."""

    def __init__(self, placed: Mosaic, bands: int) -> None:
        self.placed, grid = placed, placed.grid
        self.cell = max(1, math.ceil(math.sqrt(grid.width * grid.height / _CELLS)))
        shape = -(-grid.height // self.cell), -(-grid.width // self.cell)
        self.top = np.full(shape, -1, dtype=np.int16)
        self.best = np.full(shape, np.inf, dtype=np.float32)
        self.count = np.zeros(shape, dtype=np.int16)
        self.low = np.full((bands, *shape), np.inf, dtype=np.float32)
        self.high = np.full((bands, *shape), -np.inf, dtype=np.float32)
        #: Position of the cells of each layer, and which of them it fills.
        self.filled: list[tuple[tuple[slice, slice], NDArray[np.bool_]]] = []

    def add(self, number: int, layer: Opened, balance: Balance | None) -> None:
        """Add a layer."""
        step, box = self.cell, box_of(layer.layer)
        place = (slice(box[1] // step, -(-box[3] // step)), slice(box[0] // step, -(-box[2] // step)))
        filled = np.zeros(self.top.shape, dtype=bool)
        for left, top, width, height in windows(self.placed.grid, max(1, _WINDOW // step) * step):
            window = left, top, left + width, top + height
            if intersection(window, box) is None:
                continue
            means, full = self._means(layer, window)
            part = (slice(top // step, -(-window[3] // step)), slice(left // step, -(-window[2] // step)))
            if balance is not None:
                means = balance.apply(number, means)
            filled[part] = full
            for band in range(len(means)):
                low, high = self.low[band][part], self.high[band][part]
                np.minimum(low, means[band], out=low, where=full)
                np.maximum(high, means[band], out=high, where=full)
            rank = self._rank(number, layer, window)
            better = full & (rank < self.best[part])
            self.best[part] = np.where(better, rank, self.best[part])
            self.top[part] = np.where(better, number, self.top[part])
            self.count[part] += full
        self.filled.append((place, filled[place].copy()))

    def _means(self, layer: Opened, window: Box) -> tuple[Array, NDArray[np.bool_]]:
        """Return the means ``(bands, rows, columns)`` of the cells of a window, and which cells are full."""
        values, valid = layer.read_around(window)
        counts = self._sums(valid.astype(np.int64))
        full = counts == self._sums(np.ones(valid.shape, dtype=np.int64))
        return self._sums(values) / np.maximum(counts, 1), full

    def _sums(self, values: NDArray[np.generic]) -> Array:
        rows, columns = (np.arange(0, side, self.cell) for side in values.shape[-2:])
        return np.asarray(np.add.reduceat(np.add.reduceat(values, rows, axis=-2), columns, axis=-1))

    def _rank(self, number: int, layer: Opened, window: Box) -> NDArray[np.float32]:
        """Return the ranks of a layer in the cells of a window; the topmost has the smallest."""
        shape = tuple(-(-(window[k + 2] - window[k]) // self.cell) for k in (1, 0))
        if not self.placed.by_pixel:
            return np.full(shape, number, dtype=np.float32)
        errors = np.zeros((window[3] - window[1], window[2] - window[0]))
        inner = intersection(window, box_of(layer.layer))
        assert inner is not None
        part = (slice(inner[1] - window[1], inner[3] - window[1]), slice(inner[0] - window[0], inner[2] - window[0]))
        size = inner[2] - inner[0], inner[3] - inner[1]
        errors[part] = circular_errors(layer.layer, inner[0] - layer.layer.left, inner[1] - layer.layer.top, *size)
        return np.asarray(self._sums(errors) / self._sums(np.ones(errors.shape)), dtype=np.float32)

    # -- flooding ----------------------------------------------------------------------------------------------------

    def moved(self) -> Labels:
        """Return the layers of the cells with seams moved to where orthos differ least."""
        from skimage.segmentation import watershed

        free = (self.count > 1) & self._near_seams()
        markers = np.where(free, 0, self.top.astype(np.int32) + 1)
        level = np.where(free, self._levels(), 0)
        # Markers are lowest, so that all of them start before others flood everything.
        relief = np.where(free, -level, -level.max() - 1)
        labels = watershed(relief, markers, mask=self.count > 0)
        _mend_cut_things(labels, markers, level)
        labels = labels.astype(np.int16) - 1
        allowed = np.zeros(labels.shape, dtype=bool)
        for number, (place, filled) in enumerate(self.filled):
            allowed[place] |= filled & (labels[place] == number)
        # Flooding ignores the limits of orthos.
        return np.where(allowed, labels, self.top).astype(np.int16)

    def _near_seams(self) -> NDArray[np.bool_]:
        """Return the cells near a seam of the order, without seams around small holes."""
        reach, near = max(_REACH_CELLS, _REACH // self.cell), np.zeros(self.top.shape, dtype=bool)
        for number, (place, _) in enumerate(self.filled):
            part = tuple(slice(max(0, one.start - reach), one.stop + reach) for one in place)
            top = self.top[part]
            others = (top >= 0) & ~_without_holes(top == number, (2 * reach) ** 2)
            if others.any():
                near[part] |= (top == number) & (ndimage.distance_transform_edt(~others) <= reach)
        return near

    def _levels(self) -> NDArray[np.int16]:
        """Return the differences of orthos in levels, 0 for usual ones."""
        overlap = self.count > 1
        most = np.zeros(self.top.shape, dtype=np.float32)
        for low, high in zip(self.low, self.high, strict=True):
            difference = np.zeros(self.top.shape, dtype=np.float32)
            np.subtract(high, low, out=difference, where=overlap)
            some = difference[difference > 0]
            if len(some):
                most = np.maximum(most, difference / np.median(some))
        wide = ndimage.maximum_filter(most, 2 * _BESIDE + 1)
        level = np.rint(_LEVELS_PER_OCTAVE * np.log2(np.maximum(wide, _ALIKE) / _ALIKE))
        return np.asarray(level, dtype=np.int16)


def _mend_cut_things(labels: NDArray[np.int32], markers: NDArray[np.int32], level: NDArray[np.int16]) -> None:
    """Assign objects completely to one ortho where possible, in the order of increasing difference.

    An object is a connected part that differs by a level or more. If its surroundings do not differ, flooding enters it
    from all sides and may cut it. Only an object that touches two markers must be cut.
    """
    neighbours = np.stack(
        [np.roll(np.pad(markers, 1), shift, axis)[1:-1, 1:-1] for shift in (-1, 1) for axis in (0, 1)]
    )
    highest = neighbours.max(axis=0)
    lowest = np.where(neighbours > 0, neighbours, np.iinfo(np.int32).max).min(axis=0)
    for threshold in np.unique(level[level > 0]):
        things, count = ndimage.label(level >= threshold)
        index = np.arange(1, count + 1)
        cut = ndimage.minimum(labels, things, index) < ndimage.maximum(labels, things, index)
        joins = ndimage.minimum(lowest, things, index) < ndimage.maximum(highest, things, index)
        mended = np.concatenate([[False], cut & ~joins])
        cells = np.nonzero(mended[things])
        if not len(cells[0]):
            continue
        pairs, sizes = np.unique(np.stack([things[cells], labels[cells]]), axis=1, return_counts=True)
        # The last value of an object is the ortho with its largest part.
        order = np.lexsort((-pairs[1], sizes, pairs[0]))
        owner = np.zeros(count + 1, dtype=labels.dtype)
        owner[pairs[0][order]] = pairs[1][order]
        labels[cells] = owner[things[cells]]


def _without_holes(mask: NDArray[np.bool_], area: int) -> NDArray[np.bool_]:
    """Return a mask with holes smaller than an area (cells) filled."""
    labels, count = ndimage.label(~mask)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    small = sizes < area
    rim: Sequence[NDArray[np.int_]] = (labels[0], labels[-1], labels[:, 0], labels[:, -1])
    small[np.unique(np.concatenate(rim))] = False
    return np.asarray(mask | small[labels])
