"""Compiled least-squares matching of chips; see matching/least_squares.py."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.imaging.matching.kernels.chip_kernel import BEFORE, TAPS, weights_at
from ortho_pipeline.runtime.compiled import compiled


@compiled
def shifts(scene, target, start, offset, rim, limits, shift, covariance, correlation):
    """Fill `shift` ``(n, 2)``, `covariance` ``(n, 2, 2)`` and `correlation` ``(n,)``; NaN without a result.

    `scene` ``(n, c, s, s)`` and `target` ``(n, c, s + 2r, s + 2r)`` are layers of chips, NaN where not valid. With
    `offset` they differ by an offset and a gain of either sign, else by a positive gain. `limits` are the number of
    steps, the length of the last one, and the largest distance of a shift from the start.
    """
    count, layers, size, _ = scene.shape
    inner = size - 2 * rim
    reach = (target.shape[2] - size) // 2
    chip, moved = np.empty((layers, inner, inner)), np.empty((layers, inner, inner))
    own, slopes = np.empty((2, layers, inner, inner)), np.empty((2, layers, inner, inner))
    seen, whole = np.empty((inner, inner), dtype=np.bool_), np.empty((inner, inner), dtype=np.bool_)
    weights, derived, found = np.empty((2, TAPS)), np.empty((2, TAPS)), np.empty(6)
    lines = np.empty((2, inner + TAPS - 1, inner))
    for k in range(count):
        shift[k, :] = np.nan
        covariance[k, :, :] = np.nan
        correlation[k] = 0.0
        _inner(scene[k], rim, chip, own, whole)
        x, y = start[k, 0], start[k, 1]
        for _ in range(int(limits[0])):
            if not (abs(x) < reach - 2 and abs(y) < reach - 2):
                break
            if abs(x - start[k, 0]) > limits[2] or abs(y - start[k, 1]) > limits[2]:
                break
            left, top = int(np.floor(x)), int(np.floor(y))
            weights_at(x - left, weights[0], derived[0])
            weights_at(y - top, weights[1], derived[1])
            first = reach + rim
            used = _moved(target[k], first + left, first + top, weights, derived, whole, lines, moved, slopes, seen)
            if 2 * used < inner * inner or not _step(chip, own, moved, slopes, seen, offset, found):
                break
            x += found[0]
            y += found[1]
            if abs(found[0]) < limits[1] and abs(found[1]) < limits[1]:
                shift[k, 0], shift[k, 1] = x, y
                covariance[k, 0, 0], covariance[k, 1, 1] = found[2], found[3]
                covariance[k, 0, 1] = covariance[k, 1, 0] = found[4]
                correlation[k] = found[5]
                break


@compiled
def _step(chip, own, moved, slopes, seen, offset, found):
    """Fill one step of the shift, its covariance (xx, yy, xy) and the correlation; return False without a result.

    `own` and `slopes` are the derivatives of the scene's chip and of the target's. The normal equations use the first;
    the second give the change of their right-hand side with the shift.
    """
    number, a_mean, b_mean, x_mean, y_mean = 0, 0.0, 0.0, 0.0, 0.0
    for m in range(chip.shape[0]):
        for i in range(chip.shape[1]):
            for j in range(chip.shape[2]):
                if seen[i, j]:
                    number += 1
                    a_mean += chip[m, i, j]
                    b_mean += moved[m, i, j]
                    x_mean += own[0, m, i, j]
                    y_mean += own[1, m, i, j]
    # The offset is also an unknown, so subtract the means.
    share = 1.0 / number if offset else 0.0
    a_mean, b_mean, x_mean, y_mean = a_mean * share, b_mean * share, x_mean * share, y_mean * share
    aa, bb, ab, xa, ya, xb, yb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    xx, yy, xy, xu, xv, yu, yv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(chip.shape[0]):
        for i in range(chip.shape[1]):
            for j in range(chip.shape[2]):
                if seen[i, j]:
                    a, b = chip[m, i, j] - a_mean, moved[m, i, j] - b_mean
                    x, y = own[0, m, i, j] - x_mean, own[1, m, i, j] - y_mean
                    u, v = slopes[0, m, i, j], slopes[1, m, i, j]
                    aa, bb, ab = aa + a * a, bb + b * b, ab + a * b
                    xa, ya, xb, yb = xa + x * a, ya + y * a, xb + x * b, yb + y * b
                    xx, yy, xy = xx + x * x, yy + y * y, xy + x * y
                    xu, xv, yu, yv = xu + x * u, xv + x * v, yu + y * u, yv + y * v
    if not (aa > 1e-9 and bb > 1e-9) or ab == 0.0 or (ab < 0.0 and not offset):
        return False
    gain = ab / bb
    xu, xv, yu, yv = gain * xu, gain * xv, gain * yu, gain * yv
    determinant = xu * yv - xv * yu
    # Both are positive at the maximum of the correlation.
    if not (xu + yv > 0.0 and determinant > 1e-9 * (xu + yv) ** 2):
        return False
    xr, yr = xa - gain * xb, ya - gain * yb
    found[0], found[1] = (yv * xr - xv * yr) / determinant, (xu * yr - yu * xr) / determinant
    variance = (aa - gain * ab) / max(number - 4, 1) / determinant**2
    found[2] = variance * (yv * yv * xx - 2 * yv * xv * xy + xv * xv * yy)
    found[3] = variance * (yu * yu * xx - 2 * yu * xu * xy + xu * xu * yy)
    found[4] = variance * (-yv * yu * xx + (xu * yv + xv * yu) * xy - xv * xu * yy)
    found[5] = ab / np.sqrt(aa * bb)
    return True


@compiled
def _inner(scene, rim, chip, own, whole):
    """Fill the inner part of a chip, its derivatives (columns, rows), and where all of its layers have both values."""
    layers, inner = chip.shape[0], chip.shape[1]
    for i in range(inner):
        for j in range(inner):
            whole[i, j] = True
            for m in range(layers):
                row, column = i + rim, j + rim
                chip[m, i, j] = scene[m, row, column]
                own[0, m, i, j] = 0.5 * (scene[m, row, column + 1] - scene[m, row, column - 1])
                own[1, m, i, j] = 0.5 * (scene[m, row + 1, column] - scene[m, row - 1, column])
                if np.isnan(chip[m, i, j] + own[0, m, i, j] + own[1, m, i, j]):
                    whole[i, j] = False


@compiled
def _moved(target, left, top, weights, derived, whole, lines, moved, slopes, seen):
    """Fill values and derivatives (columns, rows) of a target at a shift, and where they are valid; return how many.

    `lines` ``(2, inner + TAPS - 1, inner)`` is workspace for the interpolation along rows.
    """
    layers, inner = moved.shape[0], moved.shape[1]
    seen[:, :] = whole
    for m in range(layers):
        for i in range(inner + TAPS - 1):
            for j in range(inner):
                value, slope = 0.0, 0.0
                for k in range(TAPS):
                    pixel = target[m, top + i - BEFORE, left + j - BEFORE + k]
                    value += weights[0, k] * pixel
                    slope += derived[0, k] * pixel
                lines[0, i, j], lines[1, i, j] = value, slope
        for i in range(inner):
            for j in range(inner):
                value, across, down = 0.0, 0.0, 0.0
                for n in range(TAPS):
                    value += weights[1, n] * lines[0, i + n, j]
                    across += weights[1, n] * lines[1, i + n, j]
                    down += derived[1, n] * lines[0, i + n, j]
                moved[m, i, j], slopes[0, m, i, j], slopes[1, m, i, j] = value, across, down
                if np.isnan(value):
                    seen[i, j] = False
    return seen.sum()
