"""Compiled loops of the layer of accuracy: fields between nodes, heights from the DEM, the error ellipse."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.files.compiled import compiled, inlined
from ortho_pipeline.warp.block_kernel import DemWindow, dem_height_at

#: Fields of a node: model (ee, nn, en), displacement (e, n), interpolation (ee, nn, en), image (column, row).
_FIELDS = 10


class Nodes(NamedTuple):
    """Nodes of a layer, for compiled code.

    Parameters
    ----------
    fields : (rows, columns, 3, 10)
        Quadratics in the normalised height, which is -1 at middle - half and 1 at middle + half (m).
    samples : (rows, columns, 2, k)
        Sample coordinates of the heights and of their standard deviations.
    spacing : int
        Pixels from node to node.
    """

    fields: Any
    samples: Any
    spacing: int
    middle: float
    half: float


class Heights(NamedTuple):
    """Heights and how good they are: `constant` is their standard deviation unless negative, `datum` a variance."""

    dem: DemWindow
    sigma: DemWindow
    constant: float
    datum: float


@compiled
def fill(lattice: Nodes, heights: Heights, even: float, size: Any, radii: Any, bands: Any, totals: Any) -> None:
    """Fill bands ``(4, h, w)``, which stay as they are where nothing is seen or known.

    `even` is a variance, `size` that of the image. `totals` ``(8,)`` grows by the variances of the parts, of east and
    of north, and by the numbers of pixels that are known and that show the image.
    """
    nodes, samples, spacing = lattice.fields, lattice.samples, lattice.spacing
    _, height, width = bands.shape
    begin, grow = np.empty((3, _FIELDS)), np.empty((3, _FIELDS))
    place, way = np.empty(samples.shape[2:]), np.empty(samples.shape[2:])
    values, ticks, scaled = np.empty((_FIELDS, spacing)), np.arange(spacing) / spacing, np.empty(spacing)
    for row in range(height):
        j, fy = row // spacing, (row % spacing) / spacing
        for i in range((width - 1) // spacing + 1):
            first = i * spacing
            count = min(spacing, width - first)
            _along(nodes[j, i], nodes[j, i + 1], nodes[j + 1, i], nodes[j + 1, i + 1], fy, begin, grow)
            _along(samples[j, i], samples[j, i + 1], samples[j + 1, i], samples[j + 1, i + 1], fy, place, way)
            # Simple loops over pixels, one after the other, are faster than all at once.
            _scaled_heights(lattice, heights.dem, place, way, ticks, scaled, count)
            for f in range(_FIELDS):
                _quadratic(begin, grow, f, ticks, scaled, values[f], count)
            for c in range(count):
                if 0.0 <= values[8, c] <= size[0] and 0.0 <= values[9, c] <= size[1]:
                    variance = _height_variance(heights, place, way, ticks[c])
                    _count(values, c, variance, even, radii, bands, row, first + c, totals)


@inlined
def _along(northwest, northeast, southwest, southeast, fy, begin, grow):
    """Fill the values at the west of a cell and how much they grow to its east; a node without weight may be NaN."""
    for k in range(begin.shape[0]):
        for f in range(begin.shape[1]):
            west, east = northwest[k, f], northeast[k, f]
            if fy > 0.0:
                west += (southwest[k, f] - west) * fy
                east += (southeast[k, f] - east) * fy
            begin[k, f], grow[k, f] = west, east - west


@inlined
def _scaled_heights(lattice, dem, place, way, ticks, scaled, count):
    """Fill the normalised heights of a row of a cell."""
    for c in range(count):
        u, v = place[0, 0] + way[0, 0] * ticks[c], place[1, 0] + way[1, 0] * ticks[c]
        scaled[c] = (dem_height_at(dem.heights, u, v, dem.left, dem.top, False) - lattice.middle) / lattice.half


@inlined
def _quadratic(begin, grow, f, ticks, scaled, out, count):
    """Fill a field along a row of a cell."""
    b0, b1, b2, g0, g1, g2 = begin[0, f], begin[1, f], begin[2, f], grow[0, f], grow[1, f], grow[2, f]
    for c in range(count):
        fx, t = ticks[c], scaled[c]
        out[c] = ((b2 + g2 * fx) * t + (b1 + g1 * fx)) * t + (b0 + g0 * fx)


@inlined
def _height_variance(heights, place, way, fx):
    """Return the variance of a height, its datum included; NaN where it is not known."""
    sigma, deviation = heights.sigma, heights.constant
    if deviation < 0.0:
        u, v = place[0, 1] + way[0, 1] * fx, place[1, 1] + way[1, 1] * fx
        deviation = dem_height_at(sigma.heights, u, v, sigma.left, sigma.top, False)
    return deviation * deviation + heights.datum


@inlined
def _count(values, c, variance, even, radii, bands, row, column, totals):
    """Put the accuracy of a pixel into the bands and into what they come to together."""
    totals[7] += 1.0
    east, north = values[3, c], values[4, c]
    ee = values[0, c] + east * east * variance + even + values[5, c]
    nn = values[1, c] + north * north * variance + even + values[6, c]
    en = values[2, c] + east * north * variance + values[7, c]
    if ee + nn + en < np.inf:
        _put(ee, nn, en, radii, radii.size - 1, bands, row, column)
        totals[0] += values[0, c] + values[1, c]
        totals[1] += (east * east + north * north) * variance
        totals[2] += 2.0 * even
        totals[3] += values[5, c] + values[6, c]
        totals[4] += ee
        totals[5] += nn
        totals[6] += 1.0


@inlined
def _put(ee, nn, en, radii, last, bands, row, column):
    middle = 0.5 * (ee + nn)
    half = np.sqrt(0.25 * (ee - nn) * (ee - nn) + en * en)
    larger, smaller = np.sqrt(middle + half), np.sqrt(max(middle - half, 0.0))
    place = last * (smaller / larger if larger > 0.0 else 1.0)
    k = min(int(place), last - 1)
    bands[0, row, column], bands[1, row, column] = np.sqrt(ee), np.sqrt(nn)
    bands[2, row, column] = en / np.sqrt(ee * nn) if ee * nn > 0.0 else 0.0
    bands[3, row, column] = larger * (radii[k] + (radii[k + 1] - radii[k]) * (place - k))


@compiled
def gather(values: Any, rows: Any, columns: Any, sums: Any) -> None:
    """Add values ``(h, w)`` and their number to the cells ``(..., 2)`` that their rows and columns belong to."""
    for j in range(values.shape[0]):
        for i in range(values.shape[1]):
            if values[j, i] == values[j, i]:
                sums[rows[j], columns[i], 0] += values[j, i]
                sums[rows[j], columns[i], 1] += 1.0
