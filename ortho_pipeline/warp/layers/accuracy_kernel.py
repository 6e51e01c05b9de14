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
    fields : (rows, columns, levels, 10)
        Polynomials in the normalised height, which is -1 at middle - half and 1 at middle + half (m).
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
def fill(
    lattice: Nodes, heights: Heights, even: float, size: Any, radii: Any, covariance: Any, bands: Any, totals: Any
) -> None:
    """Fill covariances ``(h, w, 3)`` and bands ``(4, h, w)``; NaN where nothing is seen or known.

    `even` is a variance, `size` that of the image. `totals` ``(8,)`` grows by the variances of the parts, of east and
    of north, and by the numbers of pixels that are known and that show the image.
    """
    nodes, samples, spacing, middle, half = lattice
    dem, sigma, constant, datum = heights
    height, width = covariance.shape[:2]
    value = np.empty(_FIELDS)
    begin, grow = np.empty((nodes.shape[2], _FIELDS)), np.empty((nodes.shape[2], _FIELDS))
    place, way = np.empty(samples.shape[2:]), np.empty(samples.shape[2:])
    for row in range(height):
        j, fy = row // spacing, (row % spacing) / spacing
        for column in range(width):
            i, fx = column // spacing, (column % spacing) / spacing
            if column % spacing == 0:
                _along(nodes[j, i], nodes[j, i + 1], nodes[j + 1, i], nodes[j + 1, i + 1], fy, begin, grow)
                _along(samples[j, i], samples[j, i + 1], samples[j + 1, i], samples[j + 1, i + 1], fy, place, way)
            bands[:, row, column] = np.nan
            h = dem_height_at(
                dem.heights, place[0, 0] + way[0, 0] * fx, place[1, 0] + way[1, 0] * fx, dem.left, dem.top, False
            )
            t = (h - middle) / half
            for f in range(_FIELDS):
                value[f] = 0.0
                for k in range(nodes.shape[2] - 1, -1, -1):
                    value[f] = value[f] * t + (begin[k, f] + grow[k, f] * fx)
            if not (0.0 <= value[8] <= size[0] and 0.0 <= value[9] <= size[1]):
                continue
            deviation = constant
            if constant < 0.0:
                u, v = place[0, 1] + way[0, 1] * fx, place[1, 1] + way[1, 1] * fx
                deviation = dem_height_at(sigma.heights, u, v, sigma.left, sigma.top, False)
            _count(
                value, deviation * deviation + datum, even, radii, covariance[row, column], bands, row, column, totals
            )


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
def _count(value, variance, even, radii, covariance, bands, row, column, totals):
    """Put the accuracy of a pixel into the bands and into what they come to together."""
    totals[7] += 1.0
    ee = value[0] + value[3] * value[3] * variance + even + value[5]
    nn = value[1] + value[4] * value[4] * variance + even + value[6]
    en = value[2] + value[3] * value[4] * variance + value[7]
    if ee + nn + en < np.inf:
        covariance[0], covariance[1], covariance[2] = ee, nn, en
        _put(ee, nn, en, radii, radii.size - 1, bands, row, column)
        totals[0] += value[0] + value[1]
        totals[1] += (value[3] * value[3] + value[4] * value[4]) * variance
        totals[2] += 2.0 * even
        totals[3] += value[5] + value[6]
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
