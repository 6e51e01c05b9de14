"""Compiled loops of the layer of accuracy: fields between nodes, heights from the DEM, the error ellipse."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.runtime.compiled import compiled, inlined
from ortho_pipeline.warp.tile_kernel import DemWindow, dem_height_at

#: Fields of a node: model (ee, nn, en), displacement (e, n), interpolation (ee, nn, en), image (column, row).
_FIELDS = 10
#: Limits of 1 + s . d. Below, a ray grazes the ground. Above are walls and noise of a surface model, too short
#: for their slope to hold over an error.
LEAST, MOST = 0.2, 2.0


class Nodes(NamedTuple):
    """Nodes of a layer, for compiled code.

    Parameters
    ----------
    fields : (rows, columns, 3, 10)
        Quadratics in the normalised height, which is -1 at middle - half and 1 at middle + half (m).
    samples : (rows, columns, 2, k)
        Sample coordinates of the heights and of their standard deviations.
    pixels : (rows, columns, 2, 2)
        Pixels of column and row per metre true east and north.
    spacing : int
        Pixels from node to node.
    """

    fields: Any
    samples: Any
    pixels: Any
    spacing: int
    middle: float
    half: float


class PixelHeights(NamedTuple):
    """Heights and how good they are: `constant` is their standard deviation unless negative, `datum` a variance."""

    dem: DemWindow
    sigma: DemWindow
    constant: float
    datum: float


@compiled
def fill(lattice: Nodes, heights: PixelHeights, even: float, size: Any, radii: Any, bands: Any, totals: Any) -> None:
    """Fill bands ``(4, h, w)``, which stay as they are where nothing is seen or known.

    `even` is a variance, `size` that of the image. `totals` ``(8,)`` grows by the variances of the parts, of east and
    of north, and by the numbers of pixels that are known and that show the image.
    """
    nodes, samples, spacing = lattice.fields, lattice.samples, lattice.spacing
    _, height, width = bands.shape
    begin, grow = np.empty((3, _FIELDS)), np.empty((3, _FIELDS))
    place, way = np.empty(samples.shape[2:]), np.empty(samples.shape[2:])
    values, ticks, scaled = np.empty((_FIELDS, spacing)), np.arange(spacing) / spacing, np.empty(spacing)
    variances, slopes, ellipses = np.zeros(spacing), np.empty((2, spacing)), np.empty((5, spacing))
    for row in range(height):
        j, fy = row // spacing, (row % spacing) / spacing
        for i in range((width - 1) // spacing + 1):
            first = i * spacing
            count = min(spacing, width - first)
            _along(nodes[j, i], nodes[j, i + 1], nodes[j + 1, i], nodes[j + 1, i + 1], fy, spacing, begin, grow)
            west, east = (samples[j, i], samples[j + 1, i]), (samples[j, i + 1], samples[j + 1, i + 1])
            _along(west[0], east[0], west[1], east[1], fy, spacing, place, way)
            # Simple loops over pixels, one after the other, are faster than all at once.
            _scaled_heights(lattice, heights.dem, place, way, ticks, scaled, count)
            for f in range(_FIELDS):
                _quadratic(begin, grow, f, ticks, scaled, values[f], count)
            _height_variances(heights, place, way, ticks, variances, count)
            _slopes(lattice, heights.dem, j, i, place, way, ticks, slopes, count)
            _ellipses(values, variances, slopes, even, ellipses, count)
            for c in range(count):
                if 0.0 <= values[8, c] <= size[0] and 0.0 <= values[9, c] <= size[1]:
                    totals[7] += 1.0
                    if ellipses[0, c] + ellipses[1, c] + ellipses[2, c] < np.inf:
                        _put(ellipses, c, radii, bands, row, first + c)
                        _count(values, c, variances[c], slopes, even, ellipses, totals)


@inlined
def _along(northwest, northeast, southwest, southeast, fy, spacing, begin, grow):
    """Fill the values at the west of a cell and how much they grow to its east; a node without weight may be NaN."""
    for k in range(begin.shape[0]):
        for f in range(begin.shape[1]):
            west, east = northwest[k, f], northeast[k, f]
            if fy > 0.0:
                west += (southwest[k, f] - west) * fy
                east += (southeast[k, f] - east) * fy
            # With one pixel, its first node, a cell does not need what lies east: it may be NaN.
            begin[k, f], grow[k, f] = west, east - west if spacing > 1 else 0.0


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
def _height_variances(heights, place, way, ticks, out, count):
    """Fill the variances of the heights of a row of a cell, their datum included; NaN where one is not known."""
    sigma, deviation = heights.sigma, heights.constant
    for c in range(count):
        if heights.constant < 0.0:
            u, v = place[0, 1] + way[0, 1] * ticks[c], place[1, 1] + way[1, 1] * ticks[c]
            deviation = dem_height_at(sigma.heights, u, v, sigma.left, sigma.top, False)
        out[c] = deviation * deviation + heights.datum


@inlined
def _slopes(lattice, dem, j, i, place, way, ticks, out, count):
    """Fill the rise per metre east and north over each pixel of a row of a cell; 0 where a height is missing."""
    samples, pixels = lattice.samples, lattice.pixels[j, i]
    here, east, south, parts = samples[j, i], samples[j, i + 1], samples[j + 1, i], 2 * lattice.spacing
    across_u, across_v = (east[0, 0] - here[0, 0]) / parts, (east[1, 0] - here[1, 0]) / parts
    down_u, down_v = (south[0, 0] - here[0, 0]) / parts, (south[1, 0] - here[1, 0]) / parts
    for c in range(count):
        u, v = place[0, 0] + way[0, 0] * ticks[c], place[1, 0] + way[1, 0] * ticks[c]
        across = dem_height_at(dem.heights, u + across_u, v + across_v, dem.left, dem.top, False)
        across -= dem_height_at(dem.heights, u - across_u, v - across_v, dem.left, dem.top, False)
        down = dem_height_at(dem.heights, u + down_u, v + down_v, dem.left, dem.top, False)
        down -= dem_height_at(dem.heights, u - down_u, v - down_v, dem.left, dem.top, False)
        to_east, to_north = across * pixels[0, 0] + down * pixels[1, 0], across * pixels[0, 1] + down * pixels[1, 1]
        known = to_east + to_north < np.inf
        out[0, c], out[1, c] = to_east if known else 0.0, to_north if known else 0.0


@inlined
def _turned(values, slopes, c):
    """Return how an error on level ground is one on a slope: a matrix, row by row."""
    east, north, to_east, to_north = values[3, c], values[4, c], slopes[0, c], slopes[1, c]
    along = to_east * east + to_north * north
    limited = min(max(along, LEAST - 1.0), MOST - 1.0)
    factor = (limited / along if limited != along else 1.0) / (1.0 + limited)
    return (
        1.0 - east * to_east * factor, -east * to_north * factor,
        -north * to_east * factor, 1.0 - north * to_north * factor,
    )  # fmt: skip


@inlined
def _ellipses(values, variances, slopes, even, out, count):
    """Fill ee, nn, en, the larger half axis and the smaller in parts of it, of a row of a cell."""
    for c in range(count):
        east, north, variance = values[3, c], values[4, c], variances[c]
        level_ee = values[0, c] + east * east * variance + even + values[5, c]
        level_nn = values[1, c] + north * north * variance + even + values[6, c]
        level_en = values[2, c] + east * north * variance + values[7, c]
        a, b, g, h = _turned(values, slopes, c)
        ee = a * a * level_ee + 2.0 * a * b * level_en + b * b * level_nn
        nn = g * g * level_ee + 2.0 * g * h * level_en + h * h * level_nn
        en = a * g * level_ee + (a * h + b * g) * level_en + b * h * level_nn
        middle, half = 0.5 * (ee + nn), np.sqrt(0.25 * (ee - nn) * (ee - nn) + en * en)
        large = middle + half
        out[0, c], out[1, c], out[2, c] = ee, nn, en
        out[3, c], out[4, c] = np.sqrt(large), np.sqrt(max(middle - half, 0.0) / max(large, 1e-300))


@inlined
def _put(ellipses, c, radii, bands, row, column):
    """Put the accuracy of a pixel into the bands."""
    east, north, covariance = np.sqrt(ellipses[0, c]), np.sqrt(ellipses[1, c]), ellipses[2, c]
    last = radii.size - 1
    place = last * (ellipses[4, c] if ellipses[3, c] > 0.0 else 1.0)
    k = min(int(place), last - 1)
    bands[0, row, column], bands[1, row, column] = east, north
    bands[2, row, column] = covariance / (east * north) if east * north > 0.0 else 0.0
    bands[3, row, column] = ellipses[3, c] * (radii[k] + (radii[k + 1] - radii[k]) * (place - k))


@inlined
def _count(values, c, variance, slopes, even, ellipses, totals):
    """Count the variances of a pixel into what all come to together."""
    a, b, g, h = _turned(values, slopes, c)
    of_ee, of_nn, of_en = a * a + g * g, b * b + h * h, 2.0 * (a * b + g * h)
    east, north = values[3, c], values[4, c]
    totals[0] += of_ee * values[0, c] + of_nn * values[1, c] + of_en * values[2, c]
    totals[1] += (of_ee * east * east + of_nn * north * north + of_en * east * north) * variance
    totals[2] += (of_ee + of_nn) * even
    totals[3] += of_ee * values[5, c] + of_nn * values[6, c] + of_en * values[7, c]
    totals[4] += ellipses[0, c]
    totals[5] += ellipses[1, c]
    totals[6] += 1.0


@compiled
def gather(values: Any, rows: Any, columns: Any, sums: Any) -> None:
    """Add values ``(h, w)`` and their number to the cells ``(..., 2)`` that their rows and columns belong to."""
    for j in range(values.shape[0]):
        for i in range(values.shape[1]):
            if values[j, i] == values[j, i]:
                sums[rows[j], columns[i], 0] += values[j, i]
                sums[rows[j], columns[i], 1] += 1.0
