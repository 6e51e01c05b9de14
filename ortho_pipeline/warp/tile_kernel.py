"""The compiled loop of the warp over one block of output pixels, in a single pass.

`warp_block` takes image coordinates out of the block's lattice, terrain heights out of the DEM, and pixel values out of
the source by one of `resampling_kernel`. Nothing is stored per pixel but the values.

The lattice gives, at nodes every `spacing` output pixels, DEM coordinates (u, v) and image coordinates as a polynomial
in the normalised height t = (h - middle) / half. Between nodes everything is bilinear.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined
from ortho_pipeline.warp.resampling_kernel import (
    Resampling,
    Scratch,
    SourceWindow,
    cubic_weights,
    row_inside,
    row_with_edges,
)

#: From this many output pixels per DEM sample on, pixels are taken together that lie between the same samples.
_RUN = 6.0


class Lattice(NamedTuple):
    """The lattice of a block, for compiled code.

    Parameters
    ----------
    spacing : int
        Output pixels from node to node.
    image : (ny, nx, levels, 2)
        Coefficients of the image coordinates in the normalised height.
    dem : (ny, nx, 2)
        DEM sample coordinates.
    middle, half : float
        Metres: the normalised height is -1 at middle - half, 1 at middle + half.
    """

    spacing: int
    image: Any
    dem: Any
    middle: float
    half: float


class DemWindow(NamedTuple):
    """A window of the DEM: heights ``(rows, columns)``, the place of the first, and whether they go through cubics."""

    heights: Any
    left: int
    top: int
    cubic: bool


class OutputWindow(NamedTuple):
    """Where pixels go: rows first … last - 1 and columns of a block, and the tile ``(bands, h, w)`` that it is part of.

    `row` and `column` are the place of the first row and column in `pixels` and `valid` (whether they have a value).
    """

    first_row: int
    last_row: int
    first_column: int
    last_column: int
    row: int
    column: int
    pixels: Any
    valid: Any


#: Fewer pixels in a row are not worth being made together.
_PART = 8


@inlined
def _between(first, second, share):
    # A node without weight may be NaN (outside of the model) and must not count.
    return first if share == 0.0 else first + (second - first) * share


@compiled
def block_coordinates(
    row: int, left: int, right: int, lattice: Lattice, dem: DemWindow, ticks: Any, columns: Any, rows: Any
) -> None:
    """Fill `columns` and `rows` with the image coordinates of output pixels left…right of one row of a block.

    `row`, `left`, `right` count from the block's first pixel; `ticks` are the places of the block's columns between
    lattice nodes, 0 to 1. NaN where there is no height or no projection.
    """
    spacing, nodes, dem_nodes = lattice.spacing, lattice.image, lattice.dem
    middle, half = lattice.middle, lattice.half
    levels = nodes.shape[2]
    cell_row = row // spacing
    ty = (row - cell_row * spacing) / spacing
    start, slope, scaled = np.empty(2 * levels), np.empty(2 * levels), np.empty(spacing)
    for cell in range(left // spacing, (right - 1) // spacing + 1):
        for k in range(levels):
            for axis in range(2):
                begin = _between(nodes[cell_row, cell, k, axis], nodes[cell_row + 1, cell, k, axis], ty)
                end = _between(nodes[cell_row, cell + 1, k, axis], nodes[cell_row + 1, cell + 1, k, axis], ty)
                start[2 * k + axis], slope[2 * k + axis] = begin, end - begin if spacing > 1 else 0.0
        u0 = _between(dem_nodes[cell_row, cell, 0], dem_nodes[cell_row + 1, cell, 0], ty)
        v0 = _between(dem_nodes[cell_row, cell, 1], dem_nodes[cell_row + 1, cell, 1], ty)
        du = _between(dem_nodes[cell_row, cell + 1, 0], dem_nodes[cell_row + 1, cell + 1, 0], ty) - u0
        dv = _between(dem_nodes[cell_row, cell + 1, 1], dem_nodes[cell_row + 1, cell + 1, 1], ty) - v0
        if spacing == 1:
            du, dv = 0.0, 0.0  # the only pixel of the cell is its first node
        first, last = max(left, cell * spacing), min(right, (cell + 1) * spacing)
        tx, cols, lines = ticks[first:last], columns[first - left : last - left], rows[first - left : last - left]
        # First the heights, kept in `cols`; then both coordinates: two simple loops are faster than one long one.
        _row_heights(dem, u0, du, v0, dv, spacing, tx, cols)
        if levels == 3:
            _quadratic(start, slope, middle, 1.0 / half, tx, cols, lines)
            continue
        _polynomial(start, slope, middle, 1.0 / half, tx, cols, lines, scaled)


@inlined
def _quadratic(start, slope, middle, scale, tx, cols, lines):
    """Turn heights in `cols` into image coordinates by the quadratics of one row of a cell."""
    c0, c1, c2, r0, r1, r2 = start[0], start[2], start[4], start[1], start[3], start[5]
    dc0, dc1, dc2, dr0, dr1, dr2 = slope[0], slope[2], slope[4], slope[1], slope[3], slope[5]
    for k in range(tx.size):
        t = (cols[k] - middle) * scale
        cols[k] = ((c2 + dc2 * tx[k]) * t + (c1 + dc1 * tx[k])) * t + (c0 + dc0 * tx[k])
        lines[k] = ((r2 + dr2 * tx[k]) * t + (r1 + dr1 * tx[k])) * t + (r0 + dr0 * tx[k])


@inlined
def _polynomial(start, slope, middle, scale, tx, cols, lines, scaled):
    """As `_quadratic`, of any degree, one power after the other so that each is a simple loop; `scaled` is scratch."""
    top = start.size - 2
    for k in range(tx.size):
        scaled[k] = (cols[k] - middle) * scale
        cols[k], lines[k] = start[top] + slope[top] * tx[k], start[top + 1] + slope[top + 1] * tx[k]
    for power in range(top - 2, -1, -2):
        c, dc, r, dr = start[power], slope[power], start[power + 1], slope[power + 1]
        for k in range(tx.size):
            cols[k] = cols[k] * scaled[k] + (c + dc * tx[k])
            lines[k] = lines[k] * scaled[k] + (r + dr * tx[k])


@inlined
def _row_heights(dem, u0, du, v0, dv, spacing, tx, out):
    """Fill `out` with the heights at (u0 + du tx, v0 + dv tx), DEM coordinates that are linear along a row of a cell.

    Fractions are taken of the coordinates in the whole DEM, not in its window: the last bit must not depend on how
    large a window the memory allows.
    """
    heights, dem_left, dem_top, cubic_dem = dem.heights, dem.left, dem.top, dem.cubic
    dem_rows, dem_columns = heights.shape
    count = tx.size
    if cubic_dem or max(abs(du), abs(dv)) * _RUN > spacing:
        for k in range(count):
            out[k] = dem_height_at(heights, u0 + du * tx[k], v0 + dv * tx[k], dem_left, dem_top, cubic_dem)
        return
    # A coarse DEM: many pixels lie between the same four samples, and need only one look at them.
    k = 0
    while k < count:
        west, north = np.floor(u0 + du * tx[k]), np.floor(v0 + dv * tx[k])
        # Coordinates do not turn back along a row, nor does their rounding.
        end, beyond = k + 1, count
        while end < beyond:
            middle = (end + beyond) >> 1
            if np.floor(u0 + du * tx[middle]) == west and np.floor(v0 + dv * tx[middle]) == north:
                end = middle + 1
            else:
                beyond = middle
        i, j = int(west) - dem_left, int(north) - dem_top
        smooth = 0 <= i < dem_columns - 1 and 0 <= j < dem_rows - 1
        if smooth:
            h00, h10, h01 = heights[j, i], heights[j, i + 1] - heights[j, i], heights[j + 1, i] - heights[j, i]
            h11 = heights[j + 1, i + 1] - heights[j + 1, i] - h10
            smooth = h11 + h01 == h11 + h01  # no void among them
        # Of unsigned places the compiler knows that they are not Python's negative ones, and takes several at once.
        if smooth:
            for m in range(np.uint64(k), np.uint64(end)):
                fu, fv = u0 + du * tx[m] - west, v0 + dv * tx[m] - north
                out[m] = (h00 + h10 * fu) + (h01 + h11 * fu) * fv
        else:
            for m in range(k, end):
                out[m] = dem_height_at(heights, u0 + du * tx[m], v0 + dv * tx[m], dem_left, dem_top, cubic_dem)
        k = end


@compiled
def heights_at(uv: Any, dem: DemWindow, out: Any) -> None:
    """Fill `out` ``(n, m)`` with the heights at DEM coordinates `uv` ``(n, m, 2)``; NaN outside of the window."""
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[j, i] = dem_height_at(dem.heights, uv[j, i, 0], uv[j, i, 1], dem.left, dem.top, dem.cubic)


@compiled
def dem_height_at(heights, u, v, dem_left, dem_top, cubic_dem):
    """Interpolate the DEM at sample coordinates (u, v); NaN outside of its window."""
    rows, columns = heights.shape
    if not (dem_left <= u <= dem_left + columns - 1 and dem_top <= v <= dem_top + rows - 1):
        return np.nan
    i, j = int(np.floor(u)), int(np.floor(v))
    return _dem_height(heights, i - dem_left, j - dem_top, u - i, v - j, cubic_dem)


@inlined
def _dem_height(heights, i, j, fu, fv, cubic_dem):
    """Interpolate the DEM at (i + fu, j + fv); NaN where a sample with weight is void."""
    # A sample of weight zero must not spoil the result: 0 * NaN is NaN. After the last sample there is none.
    upper = heights[j, i] if fu == 0.0 else heights[j, i] + (heights[j, i + 1] - heights[j, i]) * fu
    if fv == 0.0:
        bilinear = upper
    else:
        lower = heights[j + 1, i] if fu == 0.0 else heights[j + 1, i] + (heights[j + 1, i + 1] - heights[j + 1, i]) * fu
        bilinear = upper + (lower - upper) * fv
    if not cubic_dem:
        return bilinear
    if not (i >= 1 and j >= 1 and i + 2 < heights.shape[1] and j + 2 < heights.shape[0]):
        return bilinear
    a0, a1, a2, a3 = cubic_weights(fu, np.float64)
    b0, b1, b2, b3 = cubic_weights(fv, np.float64)
    total = 0.0
    for k in range(4):
        b = b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3
        line = j - 1 + k
        total += b * (
            a0 * heights[line, i - 1] + a1 * heights[line, i] + a2 * heights[line, i + 1] + a3 * heights[line, i + 2]
        )
    return total if total == total else bilinear


@compiled
def warp_block(
    source: SourceWindow, lattice: Lattice, dem: DemWindow, resampling: Resampling, target: OutputWindow
) -> int:
    """Make output pixels of one block.

    Returns
    -------
    int
        Number of pixels whose neighbours lie in the source but not in the window; the caller reads a larger one.
    """
    first, last, reach, kernel = target.first_column, target.last_column, resampling.reach, resampling.kernel
    columns, rows = np.empty(last - first), np.empty(last - first)
    ticks = np.empty(last)
    for k in range(first, last):
        ticks[k] = (k % lattice.spacing) / lattice.spacing
    pixels, left, top, out, out_valid = source.pixels, source.left, source.top, target.pixels, target.valid
    scratch = _scratch(last - first, pixels, resampling.real)
    bands, window_height, window_width = pixels.shape
    # Points within these bounds have all neighbours both in the source and in the window.
    low_col, low_row = left + reach, top + reach
    high_col, high_row = left + window_width - reach - 1, top + window_height - reach - 1
    short = 0
    for row in range(target.first_row, target.last_row):
        block_coordinates(row, first, last, lattice, dem, ticks, columns, rows)
        line, start, count = row - target.first_row + target.row, target.column, last - first
        done = np.int64(0)  # what takes a plain constant is compiled for it apart
        while done < count:
            # Parts of the row in which no neighbour is missing are made fast, the others with care.
            if source.masked:
                begin, end = _next_whole(source, columns, rows, low_col, high_col, low_row, high_row, done)
            else:
                begin, end = _span(columns, rows, low_col, high_col, low_row, high_row, done)
            if begin > done:
                short += row_with_edges(
                    kernel,
                    resampling,
                    source,
                    columns[done:begin],
                    rows[done:begin],
                    out[:, line, start + done : start + begin],
                    out_valid[:, line, start + done : start + begin],
                )
            for band in range(bands if end > begin else 0):
                row_inside(
                    kernel,
                    resampling,
                    pixels[band],
                    columns[begin:end],
                    rows[begin:end],
                    left,
                    top,
                    scratch,
                    out[band, line, start + begin : start + end],
                )
                out_valid[band, line, start + begin : start + end] = True
            done = end
    return short


@inlined
def _scratch(count, pixels, real):
    return Scratch(
        np.empty(count, dtype=np.uint64),
        np.empty(count, dtype=real.dtype),
        np.empty(count, dtype=real.dtype),
        np.empty((4, count), dtype=pixels.dtype),
        np.empty((8, count), dtype=real.dtype),
        np.empty(count, dtype=real.dtype),
    )


@compiled
def _span(columns, rows, low_col, high_col, low_row, high_row, done):
    """Return where the next part of a row begins and ends in which no neighbour is missing: one part at most."""
    count = columns.size
    begin, end = (0, count) if done == 0 else (count, count)
    while begin < end and not (low_col <= columns[begin] < high_col and low_row <= rows[begin] < high_row):
        begin += 1
    while end > begin and not (low_col <= columns[end - 1] < high_col and low_row <= rows[end - 1] < high_row):
        end -= 1
    inside = begin < end
    for k in range(np.uint64(begin), np.uint64(end)):
        inside &= (columns[k] >= low_col) & (columns[k] < high_col) & (rows[k] >= low_row) & (rows[k] < high_row)
    return (begin, end) if inside else (count, count)


@compiled
def _next_whole(source, columns, rows, low_col, high_col, low_row, high_row, done):
    """Return where the next part of a row begins and ends in which no neighbour is missing or invalid."""
    whole, left, top = source.whole, source.left, source.top
    begin, end, count = done, done, columns.size
    while end < count:
        col, row = columns[end], rows[end]
        good = low_col <= col < high_col and low_row <= row < high_row
        if good and whole[int(row) - top, int(col) - left]:
            end += 1
        elif end - begin >= _PART:
            break
        else:
            end += 1
            begin = end
    return (begin, end) if end - begin >= _PART else (count, count)
