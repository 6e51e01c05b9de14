"""Compiled least-squares matching of chips; see least_squares.py."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.files.compiled import compiled


@compiled
def shifts(scene, target, start, offset, rim, steps, small, farthest, shift, covariance, correlation):
    """Fill `shift` ``(n, 2)``, `covariance` ``(n, 2, 2)`` and `correlation` ``(n,)``; NaN where none was found.

    `scene` ``(n, c, s, s)`` and `target` ``(n, c, s + 2r, s + 2r)`` are layers of chips, NaN where not valid. With
    `offset` there is a gain of either sign and an offset between them, else a positive gain.
    """
    count, layers, size, _ = scene.shape
    inner = size - 2 * rim
    reach = (target.shape[2] - size) // 2
    chip, moved = np.empty((layers, inner, inner)), np.empty((layers, inner, inner))
    slopes = np.empty((2, layers, inner, inner))
    seen, whole = np.empty((inner, inner), dtype=np.bool_), np.empty((inner, inner), dtype=np.bool_)
    weights, derived = np.empty((2, 4)), np.empty((2, 4))
    for k in range(count):
        shift[k, :] = np.nan
        covariance[k, :, :] = np.nan
        correlation[k] = 0.0
        _inner(scene[k], rim, chip, whole)
        d = start[k].copy()
        for _ in range(steps):
            if not (abs(d[0]) < reach - 2 and abs(d[1]) < reach - 2):
                break
            if abs(d[0] - start[k, 0]) > farthest or abs(d[1] - start[k, 1]) > farthest:
                break
            left, top = int(np.floor(d[0])), int(np.floor(d[1]))
            _weights(d[0] - left, weights[0], derived[0])
            _weights(d[1] - top, weights[1], derived[1])
            first = reach + rim
            used = _moved(target[k], first + left, first + top, weights, derived, whole, moved, slopes, seen)
            if 2 * used < inner * inner:
                break
            a_mean, b_mean = 0.0, 0.0
            if offset:
                for m in range(layers):
                    for i in range(inner):
                        for j in range(inner):
                            if seen[i, j]:
                                a_mean += chip[m, i, j]
                                b_mean += moved[m, i, j]
                a_mean /= used * layers
                b_mean /= used * layers
            aa, bb, ab = 0.0, 0.0, 0.0
            for m in range(layers):
                for i in range(inner):
                    for j in range(inner):
                        if seen[i, j]:
                            a, b = chip[m, i, j] - a_mean, moved[m, i, j] - b_mean
                            aa += a * a
                            bb += b * b
                            ab += a * b
            if not (aa > 1e-9 and bb > 1e-9) or ab == 0.0 or (ab < 0.0 and not offset):
                break
            gain = ab / bb
            xx, yy, xy, xr, yr, rr, sx, sy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for m in range(layers):
                for i in range(inner):
                    for j in range(inner):
                        if seen[i, j]:
                            gx, gy = gain * slopes[0, m, i, j], gain * slopes[1, m, i, j]
                            r = chip[m, i, j] - a_mean - gain * (moved[m, i, j] - b_mean)
                            xx += gx * gx
                            yy += gy * gy
                            xy += gx * gy
                            xr += gx * r
                            yr += gy * r
                            rr += r * r
                            sx += gx
                            sy += gy
            if offset:
                # The offset is an unknown as well: what the gradients have in common is its.
                total = used * layers
                xx -= sx * sx / total
                yy -= sy * sy / total
                xy -= sx * sy / total
            det = xx * yy - xy * xy
            if not det > 1e-9 * (xx + yy) ** 2:
                break
            step_x, step_y = (yy * xr - xy * yr) / det, (xx * yr - xy * xr) / det
            d[0] += step_x
            d[1] += step_y
            if abs(step_x) < small and abs(step_y) < small:
                variance = rr / max(used * layers - 4, 1)
                shift[k, 0], shift[k, 1] = d[0], d[1]
                covariance[k, 0, 0], covariance[k, 1, 1] = variance * yy / det, variance * xx / det
                covariance[k, 0, 1] = covariance[k, 1, 0] = -variance * xy / det
                correlation[k] = ab / np.sqrt(aa * bb)
                break


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
