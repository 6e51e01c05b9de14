"""Compiled kernels of the warp.

One call of `warp_block` makes one block of output pixels in a single pass: image coordinates out of the block's
lattice, terrain heights out of the DEM, pixel values out of the source. Nothing is stored per pixel but the values.

The lattice gives, at nodes every `spacing` output pixels, DEM coordinates (u, v) and image coordinates as a polynomial
in the normalised height t = (h - h_mid) / h_half. Between nodes everything is bilinear.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined

NEAREST, BILINEAR, CUBIC, LANCZOS, AVERAGE = range(5)
# Unsigned indices spare the compiled code a test for Python's negative ones in every access; they are made by way of
# int32, which processors convert from and to floating point in one instruction.
_ONE, _TWO = np.uint32(1), np.uint32(2)
#: From this many output pixels per DEM sample on, pixels are taken together that lie between the same samples.
_RUN = 6.0


@inlined
def _between(first, second, share):
    # A node without weight may be NaN (outside of the model) and must not count.
    return first if share == 0.0 else first + (second - first) * share


@compiled
def block_coordinates(
    row: int,
    left: int,
    right: int,
    spacing: int,
    nodes: Any,
    dem_nodes: Any,
    heights: Any,
    dem_left: int,
    dem_top: int,
    cubic_dem: bool,
    middle: float,
    half: float,
    ticks: Any,
    columns: Any,
    rows: Any,
) -> None:
    """Fill `columns` and `rows` with the image coordinates of output pixels left…right of one row of a block.

    `row`, `left`, `right` count from the block's first pixel; `ticks` are the places of the block's columns between
    lattice nodes, 0 to 1. NaN where there is no height or no projection.
    """
    levels = nodes.shape[2]
    cell_row = row // spacing
    ty = (row - cell_row * spacing) / spacing
    start, slope = np.empty(2 * levels), np.empty(2 * levels)
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
        _row_heights(heights, u0, du, v0, dv, dem_left, dem_top, cubic_dem, spacing, tx, cols)
        if levels == 3:
            _quadratic(start, slope, middle, 1.0 / half, tx, cols, lines)
            continue
        for k in range(tx.size):
            t = (cols[k] - middle) / half
            col = line = 0.0
            for power in range(levels - 1, -1, -1):
                col = col * t + (start[2 * power] + slope[2 * power] * tx[k])
                line = line * t + (start[2 * power + 1] + slope[2 * power + 1] * tx[k])
            cols[k], lines[k] = col, line


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
def _row_heights(heights, u0, du, v0, dv, dem_left, dem_top, cubic_dem, spacing, tx, out):
    """Fill `out` with the heights at (u0 + du tx, v0 + dv tx), DEM coordinates that are linear along a row of a cell.

    Fractions are taken of the coordinates in the whole DEM, not in its window: the last bit must not depend on how
    large a window the memory allows.
    """
    dem_rows, dem_columns = heights.shape
    count = tx.size
    if cubic_dem or max(abs(du), abs(dv)) * _RUN > spacing:
        for k in range(count):
            out[k] = _dem_height_at(heights, u0 + du * tx[k], v0 + dv * tx[k], dem_left, dem_top, cubic_dem)
        return
    # A coarse DEM: many pixels lie between the same four samples, and need only one look at them.
    k = 0
    while k < count:
        west, north = np.floor(u0 + du * tx[k]), np.floor(v0 + dv * tx[k])
        end = k + 1
        while end < count and np.floor(u0 + du * tx[end]) == west and np.floor(v0 + dv * tx[end]) == north:
            end += 1
        i, j = int(west) - dem_left, int(north) - dem_top
        smooth = 0 <= i < dem_columns - 1 and 0 <= j < dem_rows - 1
        if smooth:
            h00, h10, h01 = heights[j, i], heights[j, i + 1] - heights[j, i], heights[j + 1, i] - heights[j, i]
            h11 = heights[j + 1, i + 1] - heights[j + 1, i] - h10
            smooth = h11 + h01 == h11 + h01  # no void among them
        if smooth:
            for m in range(k, end):
                fu, fv = u0 + du * tx[m] - west, v0 + dv * tx[m] - north
                out[m] = (h00 + h10 * fu) + (h01 + h11 * fu) * fv
        else:
            for m in range(k, end):
                out[m] = _dem_height_at(heights, u0 + du * tx[m], v0 + dv * tx[m], dem_left, dem_top, False)
        k = end


@compiled
def heights_at(uv: Any, heights: Any, dem_left: int, dem_top: int, cubic_dem: bool, out: Any) -> None:
    """Fill `out` ``(n, m)`` with the heights at DEM coordinates `uv` ``(n, m, 2)``; NaN outside of the window."""
    for j in range(out.shape[0]):
        for i in range(out.shape[1]):
            out[j, i] = _dem_height_at(heights, uv[j, i, 0], uv[j, i, 1], dem_left, dem_top, cubic_dem)


@compiled
def _dem_height_at(heights, u, v, dem_left, dem_top, cubic_dem):
    """Interpolate the DEM at sample coordinates (u, v); NaN outside of its window."""
    rows, columns = heights.shape
    if not (dem_left <= u <= dem_left + columns - 1 and dem_top <= v <= dem_top + rows - 1):
        return np.nan
    # The last sample itself is still covered.
    i, j = min(int(np.floor(u)), dem_left + columns - 2), min(int(np.floor(v)), dem_top + rows - 2)
    return _dem_height(heights, i - dem_left, j - dem_top, u - i, v - j, cubic_dem)


@inlined
def _dem_height(heights, i, j, fu, fv, cubic_dem):
    """Interpolate the DEM at (i + fu, j + fv); NaN where a sample with weight is void."""
    # A sample of weight zero must not spoil the result: 0 * NaN is NaN.
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
    a0, a1, a2, a3 = cubic_weights(fu)
    b0, b1, b2, b3 = cubic_weights(fv)
    total = 0.0
    for k in range(4):
        b = b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3
        line = j - 1 + k
        total += b * (
            a0 * heights[line, i - 1] + a1 * heights[line, i] + a2 * heights[line, i + 1] + a3 * heights[line, i + 2]
        )
    return total if total == total else bilinear


@inlined
def cubic_weights(f):
    """Weights of Keys' cubic convolution (a = -0.5) of samples -1, 0, 1, 2 for a point at f between 0 and 1."""
    f2 = f * f
    f3 = f2 * f
    return (
        0.5 * (-f3 + 2.0 * f2 - f),
        0.5 * (3.0 * f3 - 5.0 * f2 + 2.0),
        0.5 * (-3.0 * f3 + 4.0 * f2 + f),
        0.5 * (f3 - f2),
    )


@inlined
def _bilinear(source, x, y, left, top, full_width, full_height):
    """Value at (x, y), which count from the centre of the source's first pixel; beyond the edge, the edge."""
    i, j = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - i, y - j
    i0, i1 = max(i, 0), min(i + 1, full_width - 1)
    j0, j1 = max(j, 0), min(j + 1, full_height - 1)
    i0, i1, j0, j1 = i0 - left, i1 - left, j0 - top, j1 - top
    upper = source[j0, i0] * (1.0 - fx) + source[j0, i1] * fx
    lower = source[j1, i0] * (1.0 - fx) + source[j1, i1] * fx
    return upper * (1.0 - fy) + lower * fy


@inlined
def _bilinear_valid(source, valid, x, y, left, top, full_width, full_height):
    """As `_bilinear`, of the valid pixels only, with weights that sum to one; NaN if none is."""
    i, j = int(np.floor(x)), int(np.floor(y))
    if i >= 0 and j >= 0 and i + 1 < full_width and j + 1 < full_height and _all_valid(valid, i - left, j - top, 2):
        # To the last bit what the window would give without any invalid pixel in it.
        return _bilinear(source, x, y, left, top, full_width, full_height)
    fx, fy = x - i, y - j
    total, weights = 0.0, 0.0
    for b in range(2):
        for a in range(2):
            ia, jb = i + a, j + b
            if 0 <= ia < full_width and 0 <= jb < full_height and valid[jb - top, ia - left]:
                weight = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy)
                total += weight * source[jb - top, ia - left]
                weights += weight
    return total / weights if weights > 1e-5 else np.nan


@inlined
def _cubic(source, x, y, left, top):
    """Value at (x, y) by cubic convolution; the 4 x 4 neighbours have to be there."""
    i, j = int(np.floor(x)), int(np.floor(y))
    a0, a1, a2, a3 = cubic_weights(x - i)
    b0, b1, b2, b3 = cubic_weights(y - j)
    i, j = i - left, j - top
    line0 = a0 * source[j - 1, i - 1] + a1 * source[j - 1, i] + a2 * source[j - 1, i + 1] + a3 * source[j - 1, i + 2]
    line1 = a0 * source[j, i - 1] + a1 * source[j, i] + a2 * source[j, i + 1] + a3 * source[j, i + 2]
    line2 = a0 * source[j + 1, i - 1] + a1 * source[j + 1, i] + a2 * source[j + 1, i + 1] + a3 * source[j + 1, i + 2]
    line3 = a0 * source[j + 2, i - 1] + a1 * source[j + 2, i] + a2 * source[j + 2, i + 1] + a3 * source[j + 2, i + 2]
    return b0 * line0 + b1 * line1 + b2 * line2 + b3 * line3


@inlined
def _all_valid(valid, i, j, size):
    for b in range(size):
        for a in range(size):
            if not valid[j + b, i + a]:
                return False
    return True


@compiled
def warp_block(
    kernel: int,
    source: Any,
    valid: Any,
    masked: bool,
    left: int,
    top: int,
    full_width: int,
    full_height: int,
    spacing: int,
    nodes: Any,
    dem_nodes: Any,
    heights: Any,
    dem_left: int,
    dem_top: int,
    cubic_dem: bool,
    middle: float,
    half: float,
    low: float,
    high: float,
    integer: bool,
    fill: Any,
    block: Any,
    out: Any,
    out_valid: Any,
    reach: int,
    box: Any,
) -> int:
    """Make output pixels of one block.

    Parameters
    ----------
    source : (bands, h, w)
        Window of the source whose first pixel is (left, top); `valid` of the same shape counts if `masked`.
    nodes : (ny, nx, levels, 2), dem_nodes : (ny, nx, 2), heights : (rows, columns)
        The lattice and the window of the DEM whose first sample is (dem_left, dem_top).
    low, high, integer, fill
        Range of the output type, whether it is an integer type, and the value of invalid pixels.
    block : (4,) first row, last row + 1, first column, last column + 1 within the block
    out : (bands, rows, columns), out_valid : the same
        Where the pixels go, and whether they are valid.
    reach : int
        How many pixels around a point the kernel reads.
    box : (2,)
        Columns and rows of the source that one output pixel covers, for `AVERAGE`.

    Returns
    -------
    int
        Number of pixels whose neighbours lie in the source but not in the window; the caller reads a larger one.
    """
    first_row, last_row, first, last = block[0], block[1], block[2], block[3]
    columns, rows = np.empty(last - first), np.empty(last - first)
    ticks = np.empty(last)
    for k in range(first, last):
        ticks[k] = (k % spacing) / spacing
    bands, window_height, window_width = source.shape
    # Points within these bounds have all neighbours both in the source and in the window.
    low_col = left + reach if left > 0 else reach
    low_row = top + reach if top > 0 else reach
    high_col, high_row = left + window_width - reach - 1, top + window_height - reach - 1
    short = 0
    for row in range(first_row, last_row):
        block_coordinates(
            row,
            first,
            last,
            spacing,
            nodes,
            dem_nodes,
            heights,
            dem_left,
            dem_top,
            cubic_dem,
            middle,
            half,
            ticks,
            columns,
            rows,
        )
        line, count = row - first_row, last - first
        begin, end = (0, 0) if masked else _span(columns, rows, low_col, high_col, low_row, high_row)
        for band in range(bands if end > begin else 0):
            _row_inside(
                kernel, source[band], columns[begin:end], rows[begin:end], left, top, low, high, integer, box,
                out[band, line, begin:end]
            )  # fmt: skip
        out_valid[:, line, begin:end] = True
        for start, stop in ((0, begin), (end, count)):
            if stop > start:
                short += _row_with_edges(
                    kernel, source, valid, masked, columns[start:stop], rows[start:stop], left, top, full_width,
                    full_height, low, high, integer, fill, out[:, line, start:stop], out_valid[:, line, start:stop],
                    reach, box
                )  # fmt: skip
    return short


@compiled
def _span(columns, rows, low_col, high_col, low_row, high_row):
    """Return where the part of a row begins and ends in which no neighbour is missing; the rest is done with care."""
    begin, end = 0, columns.size
    while begin < end and not (low_col <= columns[begin] < high_col and low_row <= rows[begin] < high_row):
        begin += 1
    while end > begin and not (low_col <= columns[end - 1] < high_col and low_row <= rows[end - 1] < high_row):
        end -= 1
    inside = True
    for k in range(begin, end):
        inside &= (columns[k] >= low_col) & (columns[k] < high_col) & (rows[k] >= low_row) & (rows[k] < high_row)
    return (begin, end) if inside else (0, 0)


@inlined
def _row_inside(kernel, source, columns, rows, left, top, low, high, integer, box, out):
    if kernel == NEAREST:
        _row_nearest(source, columns, rows, left, top, out)
    elif kernel == BILINEAR:
        _row_bilinear(source, columns, rows, left, top, integer, out)
    elif kernel == CUBIC:
        _row_cubic(source, columns, rows, left, top, low, high, integer, out)
    elif kernel == LANCZOS:
        _row_lanczos(source, columns, rows, left, top, low, high, integer, out)
    else:
        _row_average(source, columns, rows, left, top, box, integer, out)


@inlined
def _row_nearest(source, columns, rows, left, top, out):
    for k in range(columns.size):
        out[k] = source[np.uint32(np.int32(rows[k] - top)), np.uint32(np.int32(columns[k] - left))]


@inlined
def _row_bilinear(source, columns, rows, left, top, integer, out):
    x0, y0 = left + 0.5, top + 0.5
    rounding = 0.5 if integer else 0.0
    for k in range(columns.size):
        x, y = columns[k] - x0, rows[k] - y0
        across, down = np.int32(x), np.int32(y)
        fx, fy = x - across, y - down
        i, j = np.uint32(across), np.uint32(down)
        upper = source[j, i] * (1.0 - fx) + source[j, i + _ONE] * fx
        lower = source[j + _ONE, i] * (1.0 - fx) + source[j + _ONE, i + _ONE] * fx
        value = upper * (1.0 - fy) + lower * fy + rounding
        out[k] = np.floor(value) if integer else value


@inlined
def _row_cubic(source, columns, rows, left, top, low, high, integer, out):
    x0, y0 = left + 0.5, top + 0.5
    for k in range(columns.size):
        x, y = columns[k] - x0, rows[k] - y0
        across, down = np.int32(x), np.int32(y)
        a0, a1, a2, a3 = cubic_weights(x - across)
        b0, b1, b2, b3 = cubic_weights(y - down)
        i, j = np.uint32(across), np.uint32(down)
        value = (
            b0 * _cubic_line(source[j - _ONE], i, a0, a1, a2, a3)
            + b1 * _cubic_line(source[j], i, a0, a1, a2, a3)
            + b2 * _cubic_line(source[j + _ONE], i, a0, a1, a2, a3)
            + b3 * _cubic_line(source[j + _TWO], i, a0, a1, a2, a3)
        )
        out[k] = min(max(np.floor(value + 0.5), low), high) if integer else value


@inlined
def _cubic_line(line, i, a0, a1, a2, a3):
    return a0 * line[i - _ONE] + a1 * line[i] + a2 * line[i + _ONE] + a3 * line[i + _TWO]


@inlined
def _row_lanczos(source, columns, rows, left, top, low, high, integer, out):
    for k in range(columns.size):
        value = _lanczos(source, columns[k] - left - 0.5, rows[k] - top - 0.5)
        out[k] = min(max(np.floor(value + 0.5), low), high) if integer else value


@inlined
def _lanczos_weights(f):
    """Weights of the Lanczos kernel (a = 3) of samples -2 … 3 for a point at f between 0 and 1; their sum is one."""
    if f < 1e-9:
        return 0.0, 0.0, 1.0, 0.0, 0.0, 0.0
    if f > 1.0 - 1e-9:
        return 0.0, 0.0, 0.0, 1.0, 0.0, 0.0
    # sin(pi (f + k)) = ± sin(pi f) cancels but for its sign; sin(pi (f + k) / 3) follows from sin and cos(pi f / 3).
    sine, cosine = np.sin(np.pi * f / 3.0), np.cos(np.pi * f / 3.0)
    half, root = 0.5, 0.8660254037844386
    plus1, plus2 = sine * half + cosine * root, -sine * half + cosine * root
    less1, less2, less3 = sine * half - cosine * root, -sine * half - cosine * root, -sine
    w0 = plus2 / ((f + 2.0) * (f + 2.0))
    w1 = -plus1 / ((f + 1.0) * (f + 1.0))
    w2 = sine / (f * f)
    w3 = -less1 / ((f - 1.0) * (f - 1.0))
    w4 = less2 / ((f - 2.0) * (f - 2.0))
    w5 = -less3 / ((f - 3.0) * (f - 3.0))
    scale = 1.0 / (w0 + w1 + w2 + w3 + w4 + w5)
    return w0 * scale, w1 * scale, w2 * scale, w3 * scale, w4 * scale, w5 * scale


@inlined
def _lanczos(source, x, y):
    """Value at (x, y), counted from the centre of the window's first pixel; the 6 x 6 neighbours have to be there."""
    across, down = np.int32(x), np.int32(y)
    a0, a1, a2, a3, a4, a5 = _lanczos_weights(x - across)
    weights = _lanczos_weights(y - down)
    i, j = np.uint32(across), np.uint32(down)
    total = 0.0
    for b in range(6):
        line = source[j - _TWO + np.uint32(b)]
        total += weights[b] * (
            a0 * line[i - _TWO]
            + a1 * line[i - _ONE]
            + a2 * line[i]
            + a3 * line[i + _ONE]
            + a4 * line[i + _TWO]
            + a5 * line[i + _TWO + _ONE]
        )
    return total


@inlined
def _lanczos_valid(source, valid, masked, x, y, left, top, full_width, full_height):
    """As `_lanczos`, of the valid pixels of the source only, with weights that sum to one; NaN if they cancel."""
    across, down = int(np.floor(x)), int(np.floor(y))
    by_column, by_row = _lanczos_weights(x - across), _lanczos_weights(y - down)
    total, weights = 0.0, 0.0
    for b in range(6):
        j = down - 2 + b
        for a in range(6):
            i = across - 2 + a
            if 0 <= i < full_width and 0 <= j < full_height and (not masked or valid[j - top, i - left]):
                weight = by_column[a] * by_row[b]
                total += weight * source[j - top, i - left]
                weights += weight
    return total / weights if weights > 1e-6 else np.nan


@inlined
def _row_average(source, columns, rows, left, top, box, integer, out):
    everywhere = np.ones((1, 1), dtype=np.bool_)
    for k in range(columns.size):
        value = _average_valid(source, everywhere, False, columns[k] - left, rows[k] - top, box)
        out[k] = np.floor(value + 0.5) if integer else value


@inlined
def _average_valid(source, valid, masked, col, row, box):
    """Mean of the valid pixels in a box about (col, row), each weighted by the area that lies in the box."""
    height, width = source.shape
    first, last = max(col - 0.5 * box[0], 0.0), min(col + 0.5 * box[0], float(width))
    above, below = max(row - 0.5 * box[1], 0.0), min(row + 0.5 * box[1], float(height))
    total, area = 0.0, 0.0
    for j in range(int(above), min(int(np.ceil(below)), height)):
        tall = min(j + 1.0, below) - max(float(j), above)
        for i in range(int(first), min(int(np.ceil(last)), width)):
            if not masked or valid[j, i]:
                weight = tall * (min(i + 1.0, last) - max(float(i), first))
                total += weight * source[j, i]
                area += weight
    return total / area if area > 0.0 else np.nan


@inlined
def _edge_value(kernel, source, valid, masked, col, row, left, top, full_width, full_height, box):
    """Value at image point (col, row) where neighbours may be missing; its own pixel is valid.

    As GDAL does: Lanczos takes the valid neighbours alone, with weights that sum to one; cubic falls back to bilinear.
    """
    x, y = col - 0.5, row - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    span = 1 if kernel == CUBIC else 2
    inner = i >= span and j >= span and i + span + 1 < full_width and j + span + 1 < full_height
    if inner and masked and kernel != BILINEAR:
        inner = _all_valid(valid, i - span - left, j - span - top, 2 * span + 2)
    if kernel == AVERAGE:
        return _average_valid(source, valid, masked, col - left, row - top, box)
    if kernel == CUBIC and inner:
        return _cubic(source, x, y, left, top)
    if kernel == LANCZOS:
        if inner:
            return _lanczos(source, x - left, y - top)
        value = _lanczos_valid(source, valid, masked, x, y, left, top, full_width, full_height)
        if abs(value) < np.inf:
            return value
    if masked:
        return _bilinear_valid(source, valid, x, y, left, top, full_width, full_height)
    return _bilinear(source, x, y, left, top, full_width, full_height)


@compiled
def _row_with_edges(
    kernel: int,
    source: Any,
    valid: Any,
    masked: bool,
    columns: Any,
    rows: Any,
    left: int,
    top: int,
    full_width: int,
    full_height: int,
    low: float,
    high: float,
    integer: bool,
    fill: Any,
    out: Any,
    out_valid: Any,
    reach: int,
    box: Any,
) -> int:
    """Make one row ``(bands, columns)`` that touches the edge of the source, or invalid pixels; see `warp_block`."""
    bands, window_height, window_width = source.shape
    short = 0
    for k in range(columns.size):
        col, line = columns[k], rows[k]
        if not (0.0 <= col <= full_width and 0.0 <= line <= full_height):
            for band in range(bands):
                out[band, k], out_valid[band, k] = fill, False
            continue
        here_col, here_row = min(int(col), full_width - 1), min(int(line), full_height - 1)
        if (
            max(here_col - reach, 0) < left
            or max(here_row - reach, 0) < top
            or min(here_col + reach, full_width - 1) >= left + window_width
            or min(here_row + reach, full_height - 1) >= top + window_height
        ):
            short += 1
            continue
        for band in range(bands):
            if masked and not valid[band, here_row - top, here_col - left]:
                out[band, k], out_valid[band, k] = fill, False
                continue
            out_valid[band, k] = True
            if kernel == NEAREST:
                out[band, k] = source[band, here_row - top, here_col - left]
                continue
            value = _edge_value(
                kernel, source[band], valid[band if masked else 0], masked, col, line, left, top, full_width,
                full_height, box
            )  # fmt: skip
            out[band, k] = min(max(np.floor(value + 0.5), low), high) if integer else value
    return short
