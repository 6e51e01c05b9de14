"""Compiled resampling kernels: values of the source at image points of one row of output pixels.

A new kernel is a number here, a function of a row, a case in `row_inside`, its case and `span` in `_edge_value`;
then its name and reach in `job`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined

#: Bilinear is None: numba leaves out of a function what `kernel is None` excludes, so that a plain job, as most first
#: runs are, compiles no more than it needs. The others share what is compiled for a number.
BILINEAR, NEAREST, CUBIC, LANCZOS, AVERAGE = None, 0, 1, 2, 3
# Unsigned indices spare the compiled code a test for Python's negative ones in every access; they are made by way of
# int32, which processors convert from and to floating point in one instruction.
_ONE, _TWO = np.uint32(1), np.uint32(2)
_NEXT, _SECOND, _THIRD = np.uint64(1), np.uint64(2), np.uint64(3)


class SourceWindow(NamedTuple):
    """A window of the source.

    Parameters
    ----------
    pixels : (bands, h, w)
        Its values; the first pixel is (left, top) of the source, whose size is width x height.
    valid : (bands, h, w) bool
        Which pixels have a value; counts if `masked`, and may else have any size.
    whole : (h, w) bool
        Whether all bands of all pixels within the reach of the kernel have one; as `valid`.
    """

    pixels: Any
    valid: Any
    whole: Any
    masked: bool
    left: int
    top: int
    width: int
    height: int


class Resampling(NamedTuple):
    """How values are made of those of the source.

    Parameters
    ----------
    kernel : int or None
        One of the kernels above.
    reach : int
        How many pixels around a point the kernel reads.
    box : (2,)
        Columns and rows of the source that one output pixel covers, for `AVERAGE`.
    low, high, integer, fill
        Range of the output type, whether it is an integer type, and the value of invalid pixels.
    real : array
        Of the type in which bilinear and cubic values are mixed (`mixing`).
    """

    kernel: int | None
    reach: int
    box: tuple[float, float]
    low: float
    high: float
    integer: bool
    fill: Any
    real: Any


class Scratch(NamedTuple):
    """Room for a row in the making, so that each step is a loop that processors do for many pixels at once.

    Only the picking of the neighbours is done pixel by pixel.

    Parameters
    ----------
    places : (n,) uint64
        Where in the window (as one line) the neighbour to the upper left is.
    fx, fy : (n,)
        Fractions of the way to the next column and row.
    near : (4, n)
        Neighbours, of the type of the source.
    weights : (8, n)
        Of four columns and four rows.
    mixed : (n,)
        Values.
    """

    places: Any
    fx: Any
    fy: Any
    near: Any
    weights: Any
    mixed: Any


def mixing(dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
    """Return `Resampling.real` for a type of pixels: float32, of which processors take twice as many, up to 16 bits.

    It rounds a value by less than a fiftieth of a digital number there.
    """
    return np.empty(0, dtype=np.float32 if dtype.kind in "iu" and dtype.itemsize <= 2 else np.float64)


@inlined
def cubic_weights(f, real):
    """Weights of Keys' cubic convolution (a = -0.5) of samples -1, 0, 1, 2 for a point at f between 0 and 1.

    `real` is the type of f and of the weights.
    """
    f2 = f * f
    f3 = f2 * f
    half = real(0.5)
    return (
        half * (-f3 + real(2.0) * f2 - f),
        half * (real(3.0) * f3 - real(5.0) * f2 + real(2.0)),
        half * (real(-3.0) * f3 + real(4.0) * f2 + f),
        half * (f3 - f2),
    )


@inlined
def _mixed(a, b, c, d, fx, fy, real):
    """Value between two neighbours a, b and those below them; everything in the type `real`."""
    one = real(1.0)
    upper = real(a) * (one - fx) + real(b) * fx
    lower = real(c) * (one - fx) + real(d) * fx
    return upper * (one - fy) + lower * fy


@inlined
def _line(a, b, c, d, wa, wb, wc, wd, real):
    """Sum of four neighbours with weights; everything in the type `real`."""
    return wa * real(a) + wb * real(b) + wc * real(c) + wd * real(d)


@inlined
def _bilinear(source, x, y, left, top, full_width, full_height, real, integer):
    """Value at (x, y), which count from the centre of the source's first pixel; beyond the edge, the edge.

    To the last bit what `_row_bilinear` gives where both can: which of them makes a pixel depends on the window.
    """
    i, j = int(np.floor(x)), int(np.floor(y))
    i0, i1 = max(i, 0), min(i + 1, full_width - 1)
    j0, j1 = max(j, 0), min(j + 1, full_height - 1)
    i0, i1, j0, j1 = i0 - left, i1 - left, j0 - top, j1 - top
    value = _mixed(source[j0, i0], source[j0, i1], source[j1, i0], source[j1, i1], real(x - i), real(y - j), real)
    return np.floor(value + real(0.5)) if integer else value


@inlined
def _bilinear_valid(source, valid, x, y, left, top, full_width, full_height, real, integer):
    """As `_bilinear`, of the valid pixels only, with weights that sum to one; NaN if none is."""
    i, j = int(np.floor(x)), int(np.floor(y))
    if i >= 0 and j >= 0 and i + 1 < full_width and j + 1 < full_height and _all_valid(valid, i - left, j - top, 2):
        # To the last bit what the window would give without any invalid pixel in it.
        return _bilinear(source, x, y, left, top, full_width, full_height, real, integer)
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
def _cubic(source, x, y, left, top, real, integer):
    """Value at (x, y) by cubic convolution, as `_row_cubic` gives it; the 4 x 4 neighbours have to be there."""
    i, j = int(np.floor(x)), int(np.floor(y))
    a0, a1, a2, a3 = cubic_weights(real(x - i), real)
    b0, b1, b2, b3 = cubic_weights(real(y - j), real)
    i, j, total = i - left, j - top, real(0.0)
    for k in range(4):
        b = b0 if k == 0 else b1 if k == 1 else b2 if k == 2 else b3
        near = source[j - 1 + k]
        total += b * _line(near[i - 1], near[i], near[i + 1], near[i + 2], a0, a1, a2, a3, real)
    return np.floor(total + real(0.5)) if integer else total


@inlined
def _all_valid(valid, i, j, size):
    for b in range(size):
        for a in range(size):
            if not valid[j + b, i + a]:
                return False
    return True


@compiled
def find_whole(valid: Any, reach: int, out: Any) -> None:
    """Fill `SourceWindow.whole`; what lies outside of the window counts as valid."""
    bands, height, width = valid.shape
    row = np.empty(width, dtype=np.uint8)
    out[:] = 1
    for j in range(height):
        # Loops: an assignment of arrays has numba compile the texts of its errors, which takes seconds.
        for i in range(width):
            row[i] = valid[0, j, i]
        for band in range(1, bands):
            for i in range(width):
                row[i] &= valid[band, j, i]
        last = -reach - 1
        for i in range(width):
            if not row[i]:
                # Those farther left than the last invalid one's reach are still to be marked.
                for k in range(max(i - reach, last + reach + 1, 0), min(i + reach + 1, width)):
                    for line in range(max(j - reach, 0), min(j + reach + 1, height)):
                        out[line, k] = 0
                last = i


@inlined
def row_inside(kernel, resampling, source, columns, rows, left, top, scratch, out):
    """Make a row of one band whose points have all neighbours within the window `source`."""
    low, high, integer = resampling.low, resampling.high, resampling.integer
    if kernel is None:
        _row_bilinear(source, columns, rows, left, top, integer, scratch, out)
    elif kernel == NEAREST:
        _row_nearest(source, columns, rows, left, top, out)
    elif kernel == CUBIC:
        _row_cubic(source, columns, rows, left, top, low, high, integer, scratch, out)
    elif kernel == LANCZOS:
        _row_lanczos(source, columns, rows, left, top, low, high, integer, out)
    else:
        _row_average(source, columns, rows, left, top, resampling.box, integer, out)


@inlined
def _row_nearest(source, columns, rows, left, top, out):
    for k in range(columns.size):
        out[k] = source[np.uint32(np.int32(rows[k] - top)), np.uint32(np.int32(columns[k] - left))]


@inlined
def _find_places(columns, rows, left, top, width, scratch):
    """Fill places and fractions of a row."""
    x0, y0 = left + 0.5, top + 0.5
    places, fx, fy = scratch.places, scratch.fx, scratch.fy
    for k in range(columns.size):
        # Exact, so the fractions do not depend on the window.
        x, y = columns[k] - x0, rows[k] - y0
        across, down = np.int32(x), np.int32(y)
        fx[k], fy[k] = x - across, y - down
        places[k] = np.uint64(np.uint32(down)) * width + np.uint64(np.uint32(across))


@inlined
def _row_bilinear(source, columns, rows, left, top, integer, scratch, out):
    count, width, flat = columns.size, np.uint64(source.shape[1]), source.reshape(source.size)
    _find_places(columns, rows, left, top, width, scratch)
    places, fx, fy = scratch.places, scratch.fx, scratch.fy
    n0, n1, n2, n3 = scratch.near[0], scratch.near[1], scratch.near[2], scratch.near[3]
    for k in range(count):
        place = places[k]
        n0[k], n1[k] = flat[place], flat[place + _NEXT]
        n2[k], n3[k] = flat[place + width], flat[place + width + _NEXT]
    real = fx.dtype.type
    if integer:
        for k in range(count):
            out[k] = np.floor(_mixed(n0[k], n1[k], n2[k], n3[k], fx[k], fy[k], real) + real(0.5))
    else:
        for k in range(count):
            out[k] = _mixed(n0[k], n1[k], n2[k], n3[k], fx[k], fy[k], real)


@inlined
def _row_cubic(source, columns, rows, left, top, low, high, integer, scratch, out):
    count, width, flat = columns.size, np.uint64(source.shape[1]), source.reshape(source.size)
    _find_places(columns, rows, left, top, width, scratch)
    places, fx, fy, weights, mixed = scratch.places, scratch.fx, scratch.fy, scratch.weights, scratch.mixed
    n0, n1, n2, n3 = scratch.near[0], scratch.near[1], scratch.near[2], scratch.near[3]
    a0, a1, a2, a3 = weights[0], weights[1], weights[2], weights[3]
    b0, b1, b2, b3 = weights[4], weights[5], weights[6], weights[7]
    real = fx.dtype.type
    for k in range(count):
        a0[k], a1[k], a2[k], a3[k] = cubic_weights(fx[k], real)
        mixed[k] = real(0.0)
    for k in range(count):
        b0[k], b1[k], b2[k], b3[k] = cubic_weights(fy[k], real)
    for line in range(4):
        first, b = np.uint64(line) * width - width - _NEXT, weights[4 + line]
        for k in range(count):
            place = places[k] + first
            n0[k], n1[k], n2[k], n3[k] = flat[place], flat[place + _NEXT], flat[place + _SECOND], flat[place + _THIRD]
        for k in range(count):
            mixed[k] += b[k] * _line(n0[k], n1[k], n2[k], n3[k], a0[k], a1[k], a2[k], a3[k], real)
    if integer:
        least, most = real(low), real(high)
        for k in range(count):
            out[k] = min(max(np.floor(mixed[k] + real(0.5)), least), most)
    else:
        for k in range(count):
            out[k] = mixed[k]


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
    """Mean of the valid pixels in a box about (col, row), weighted by their areas in the box; NaN without any."""
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
    # A strip of a millionth of a pixel is an error of rounding, no area.
    return total / area if area > 1e-6 * (box[0] + box[1]) else np.nan


@inlined
def _edge_value(kernel, resampling, source, valid, masked, col, row, left, top, full_width, full_height):
    """Value of another kernel than bilinear at image point (col, row) where neighbours may lack; its pixel is valid.

    As GDAL does: Lanczos takes the valid neighbours alone, with weights that sum to one; cubic falls back to bilinear.
    An average is that of the valid area, even if its own pixel is invalid.
    What is made as within the image is already rounded if the output is an integer.
    """
    if kernel == AVERAGE:
        return _average_valid(source, valid, masked, col - left, row - top, resampling.box)
    integer, real = resampling.integer, resampling.real.dtype.type
    x, y = col - 0.5, row - 0.5
    i, j = int(np.floor(x)), int(np.floor(y))
    span = 1 if kernel == CUBIC else 2
    inner = i >= span and j >= span and i + span + 1 < full_width and j + span + 1 < full_height
    if inner and masked:
        inner = _all_valid(valid, i - span - left, j - span - top, 2 * span + 2)
    if kernel == CUBIC and inner:
        return _cubic(source, x, y, left, top, real, integer)
    if kernel == LANCZOS:
        if inner:
            return _lanczos(source, x - left, y - top)
        value = _lanczos_valid(source, valid, masked, x, y, left, top, full_width, full_height)
        if abs(value) < np.inf:
            return value
    return _edge_bilinear(resampling, source, valid, masked, col, row, left, top, full_width, full_height)


@inlined
def _edge_bilinear(resampling, source, valid, masked, col, row, left, top, full_width, full_height):
    """Bilinear value at image point (col, row) where neighbours may be missing; its own pixel is valid."""
    integer, real = resampling.integer, resampling.real.dtype.type
    x, y = col - 0.5, row - 0.5
    if masked:
        return _bilinear_valid(source, valid, x, y, left, top, full_width, full_height, real, integer)
    return _bilinear(source, x, y, left, top, full_width, full_height, real, integer)


@compiled
def row_with_edges(
    kernel: int | None, resampling: Resampling, source: SourceWindow, columns: Any, rows: Any, out: Any, out_valid: Any
) -> int:
    """Make one row ``(bands, columns)`` that touches the edge of the source, or invalid pixels.

    Returns
    -------
    int
        Number of pixels whose neighbours lie in the source but not in the window.
    """
    pixels, valid, _, masked, left, top, full_width, full_height = source
    _, reach, _, low, high, integer, fill, _ = resampling
    bands, window_height, window_width = pixels.shape
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
        by_area = False if kernel is None else kernel == AVERAGE
        for band in range(bands):
            if masked and not by_area and not valid[band, here_row - top, here_col - left]:
                out[band, k], out_valid[band, k] = fill, False
                continue
            out_valid[band, k] = True
            here = valid[band if masked else 0]
            if kernel is None:
                value = _edge_bilinear(
                    resampling, pixels[band], here, masked, col, line, left, top, full_width, full_height
                )
            elif kernel == NEAREST:
                out[band, k] = pixels[band, here_row - top, here_col - left]
                continue
            else:
                value = _edge_value(
                    kernel, resampling, pixels[band], here, masked, col, line, left, top, full_width, full_height
                )
            if by_area and np.isnan(value):
                out[band, k], out_valid[band, k] = fill, False
                continue
            out[band, k] = min(max(np.floor(value + 0.5), low), high) if integer else value
    return short
