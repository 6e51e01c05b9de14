"""Compiled least-squares matching of chips; see least_squares.py."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.files.compiled import compiled


@compiled
def shifts(scene, target, start, offset, rim, limits, shift, covariance, correlation):
    """Fill `shift` ``(n, 2)``, `covariance` ``(n, 2, 2)`` and `correlation` ``(n,)``; NaN where none was found.

    `scene` ``(n, c, s, s)`` and `target` ``(n, c, s + 2r, s + 2r)`` are layers of chips, NaN where not valid. With
    `offset` there is a gain of either sign and an offset between them, else a positive gain. `limits` are the number of
    steps, the length of the last one, and how far a shift may lie from the start.
    """
    count, layers, size, _ = scene.shape
    inner = size - 2 * rim
    reach = (target.shape[2] - size) // 2
    chip, moved = np.empty((layers, inner, inner)), np.empty((layers, inner, inner))
    slopes = np.empty((2, layers, inner, inner))
    seen, whole = np.empty((inner, inner), dtype=np.bool_), np.empty((inner, inner), dtype=np.bool_)
    weights, derived, found = np.empty((2, 4)), np.empty((2, 4)), np.empty(6)
    for k in range(count):
        shift[k, :] = np.nan
        covariance[k, :, :] = np.nan
        correlation[k] = 0.0
        _inner(scene[k], rim, chip, whole)
        x, y = start[k, 0], start[k, 1]
        for _ in range(int(limits[0])):
            if not (abs(x) < reach - 2 and abs(y) < reach - 2):
                break
            if abs(x - start[k, 0]) > limits[2] or abs(y - start[k, 1]) > limits[2]:
                break
            left, top = int(np.floor(x)), int(np.floor(y))
            _weights(x - left, weights[0], derived[0])
            _weights(y - top, weights[1], derived[1])
            first = reach + rim
            used = _moved(target[k], first + left, first + top, weights, derived, whole, moved, slopes, seen)
            if 2 * used < inner * inner or not _step(chip, moved, slopes, seen, offset, found):
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
def _step(chip, moved, slopes, seen, offset, found):
    """Fill one step of the shift, its covariance (xx, yy, xy) and the correlation; False where there is none."""
    number, a_mean, b_mean = 0, 0.0, 0.0
    for m in range(chip.shape[0]):
        for i in range(chip.shape[1]):
            for j in range(chip.shape[2]):
                if seen[i, j]:
                    number += 1
                    a_mean += chip[m, i, j]
                    b_mean += moved[m, i, j]
    a_mean, b_mean = (a_mean / number, b_mean / number) if offset else (0.0, 0.0)
    aa, bb, ab, xa, ya, xb, yb, xx, yy, xy, sx, sy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(chip.shape[0]):
        for i in range(chip.shape[1]):
            for j in range(chip.shape[2]):
                if seen[i, j]:
                    a, b = chip[m, i, j] - a_mean, moved[m, i, j] - b_mean
                    gx, gy = slopes[0, m, i, j], slopes[1, m, i, j]
                    aa, bb, ab = aa + a * a, bb + b * b, ab + a * b
                    xa, ya, xb, yb = xa + gx * a, ya + gy * a, xb + gx * b, yb + gy * b
                    xx, yy, xy, sx, sy = xx + gx * gx, yy + gy * gy, xy + gx * gy, sx + gx, sy + gy
    if not (aa > 1e-9 and bb > 1e-9) or ab == 0.0 or (ab < 0.0 and not offset):
        return False
    gain = ab / bb
    if offset:
        # The offset is an unknown as well: what the gradients have in common is its.
        xx, yy, xy = xx - sx * sx / number, yy - sy * sy / number, xy - sx * sy / number
    xx, yy, xy = gain * gain * xx, gain * gain * yy, gain * gain * xy
    xr, yr = gain * (xa - gain * xb), gain * (ya - gain * yb)
    determinant = xx * yy - xy * xy
    if not determinant > 1e-9 * (xx + yy) ** 2:
        return False
    variance = (aa - gain * ab) / max(number - 4, 1)
    found[0], found[1] = (yy * xr - xy * yr) / determinant, (xx * yr - xy * xr) / determinant
    found[2], found[3] = variance * yy / determinant, variance * xx / determinant
    found[4], found[5] = -variance * xy / determinant, ab / np.sqrt(aa * bb)
    return True


@compiled
def _inner(scene, rim, chip, whole):
    """Fill the inner part of a chip, and where all of its layers are valid."""
    layers, inner = chip.shape[0], chip.shape[1]
    for i in range(inner):
        for j in range(inner):
            whole[i, j] = True
            for m in range(layers):
                chip[m, i, j] = scene[m, i + rim, j + rim]
                if np.isnan(chip[m, i, j]):
                    whole[i, j] = False


@compiled
def _moved(target, left, top, weights, derived, whole, moved, slopes, seen):
    """Fill values and derivatives (columns, rows) of a target at a shift, and where they are valid; return how many."""
    layers, inner = moved.shape[0], moved.shape[1]
    used = 0
    for i in range(inner):
        for j in range(inner):
            seen[i, j] = whole[i, j]
            if not seen[i, j]:
                continue
            for m in range(layers):
                value, across, down = 0.0, 0.0, 0.0
                for n in range(4):
                    line, slope = 0.0, 0.0
                    for k in range(4):
                        pixel = target[m, top + i - 1 + n, left + j - 1 + k]
                        line += weights[0, k] * pixel
                        slope += derived[0, k] * pixel
                    value += weights[1, n] * line
                    across += weights[1, n] * slope
                    down += derived[1, n] * line
                moved[m, i, j], slopes[0, m, i, j], slopes[1, m, i, j] = value, across, down
                if np.isnan(value):
                    seen[i, j] = False
            if seen[i, j]:
                used += 1
    return used


@compiled
def _weights(f, weights, derived):
    """Fill the weights of cubic convolution (Keys 1981, a = -1/2) and of its derivative at the fraction `f`."""
    weights[0] = ((-0.5 * f + 1.0) * f - 0.5) * f
    weights[1] = (1.5 * f - 2.5) * f * f + 1.0
    weights[2] = ((-1.5 * f + 2.0) * f + 0.5) * f
    weights[3] = (0.5 * f - 0.5) * f * f
    derived[0] = (-1.5 * f + 2.0) * f - 0.5
    derived[1] = (4.5 * f - 5.0) * f
    derived[2] = (-4.5 * f + 4.0) * f + 0.5
    derived[3] = (1.5 * f - 1.0) * f
