"""Compiled rendering of chips: positions of the pixels of one image in another one, and the intensities there."""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.runtime.compiled import compiled

#: Number of pixels in a row for an interpolation, and how many of them are before the pixel at or before the position.
TAPS = 8
BEFORE = TAPS // 2 - 1
#: One over the product of the distances of each of these pixels from the others.
_SCALES = np.array([1.0 / math.prod(k - j for j in range(TAPS) if j != k) for k in range(TAPS)])


@compiled
def positions(curves, met, out):
    """Fill `out` ``(rows, columns, 2)`` with the target coordinates of a chip's pixels; NaN where there is no ground.

    `curves` ``(20, rows columns)`` are polynomials in normalised height of the DEM's sample coordinates (u, v) and of
    the target's (column, row), `met` ``(rows columns,)`` the heights at which the rays of the pixels meet the terrain.
    """
    columns = out.shape[1]
    for k in range(len(met)):
        z = met[k]
        for axis in range(2):
            a = 10 + 5 * axis
            out[k // columns, k % columns, axis] = curves[a, k] + z * (
                curves[a + 1, k] + z * (curves[a + 2, k] + z * (curves[a + 3, k] + z * curves[a + 4, k]))
            )


@compiled
def extent(places, out):
    """Fill the least and greatest column and row of places ``(rows, columns, 2)``, and the mean steps down and across.

    NaN where fewer than four neighbours are finite.
    """
    rows, columns = places.shape[:2]
    out[:2], out[2:4], out[4:] = np.inf, -np.inf, 0.0
    count, down, across = 0, 0, 0
    for row in range(rows):
        for column in range(columns):
            x, y = places[row, column]
            if np.isnan(x):
                continue
            count += 1
            out[0], out[1], out[2], out[3] = min(out[0], x), min(out[1], y), max(out[2], x), max(out[3], y)
            if row and not np.isnan(places[row - 1, column, 0]):
                down += 1
                out[4] += np.hypot(x - places[row - 1, column, 0], y - places[row - 1, column, 1])
            if column and not np.isnan(places[row, column - 1, 0]):
                across += 1
                out[5] += np.hypot(x - places[row, column - 1, 0], y - places[row, column - 1, 1])
    if count < 4 or not down or not across:
        out[:] = np.nan
        return
    out[4] /= down
    out[5] /= across


@compiled
def sample(pixels, left, top, factor, places, out):
    """Fill `out` ``(rows, columns)`` with intensities at `places` ``(rows, columns, 2)``, interpolated by `weights_at`.

    `pixels` are means of `factor` x `factor` pixels of the target from the pixel (`left`, `top`). NaN next to invalid
    pixels: an interpolation from fewer pixels would move an edge.
    """
    height, width = pixels.shape
    wx, wy, slopes = np.empty(TAPS), np.empty(TAPS), np.empty(TAPS)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = np.nan
            x = (places[row, column, 0] - left) / factor - 0.5
            y = (places[row, column, 1] - top) / factor - 0.5
            if not (BEFORE <= x < width - TAPS + BEFORE + 1 and BEFORE <= y < height - TAPS + BEFORE + 1):
                continue
            i, j = int(x), int(y)
            weights_at(x - i, wx, slopes)
            weights_at(y - j, wy, slopes)
            total = 0.0
            for n in range(TAPS):
                line = 0.0
                for m in range(TAPS):
                    line += wx[m] * pixels[j - BEFORE + n, i - BEFORE + m]
                total += wy[n] * line
            out[row, column] = total


@compiled
def weights_at(f, weights, slopes):
    """Fill the weights, and their derivatives, of the polynomial through `TAPS` pixels, at the fraction `f` of a pixel.

    Cubic convolution moves waves of 4 px by up to 0.045 px towards the nearest whole pixel, so shifts measured with it
    have an error of 0.02 px. This polynomial moves such waves by 0.004 px.
    """
    product, change = 1.0, 0.0
    for k in range(TAPS):
        weights[k], slopes[k] = product * _SCALES[k], change * _SCALES[k]
        change = change * (f - (k - BEFORE)) + product
        product *= f - (k - BEFORE)
    product, change = 1.0, 0.0
    for k in range(TAPS - 1, -1, -1):
        weights[k], slopes[k] = weights[k] * product, slopes[k] * product + weights[k] * change
        change = change * (f - (k - BEFORE)) + product
        product *= f - (k - BEFORE)
