"""Samples of two orthos on one coarse grid, and the weights of the multispectral bands in the panchromatic one.

The panchromatic pixels are averaged to the multispectral pixel size. On clouds and roofs they may be saturated, where
the bands are brighter than they show: most of the brightest have one value then, and take no part. GDAL divides by the
weighted sum of the bands, so the regression has no constant; a constant would change the brightness. Weights are not
negative, as sensitivities are.

Source: Lawson and Hanson 1974 (non-negative least squares).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.regridded import Regridded
from ortho_pipeline.raster.source import Grid

#: Side (coarse px) of a window, and the most values of all windows together (float32: 12 MB). GDAL warps blocks of
#: 512 x 128 pixels: a window across a side of one would cost another one.
_SIDE, _VALUES = 128, 3_000_000
#: Fewest pixels of the reduced images along a window, for the quality; three at each rim are not compared.
_REDUCED = 8
#: Fewest pixels with a value in both orthos, for each weight.
_FEWEST = 10
#: Part of all pixels that are saturated, at least.
_SATURATED = 1e-3


class Sample(NamedTuple):
    """A window of both orthos: panchromatic ``(h, w)`` and multispectral ``(bands, h, w)``, NaN without a value."""

    pan: NDArray[np.float32]
    colours: NDArray[np.float32]


@dataclass(frozen=True)
class Weights:
    """The weights of the bands.

    Parameters
    ----------
    values : tuple of float
    explained : float
        Share of the variance of the panchromatic pixels that the weighted sum explains; below 0 it explains nothing.
    residual : float
        RMS of the residuals, in panchromatic values.
    pixels : int
        Number of pixels of the regression.
    """

    values: tuple[float, ...]
    explained: float
    residual: float
    pixels: int


def read_samples(pan: Regridded, colours: Regridded, bands: Sequence[int], grid: Grid, multiple: int) -> list[Sample]:
    """Read windows that are spread evenly over a grid; their sides are multiples of a number if possible.

    Parameters
    ----------
    pan, colours : Regridded
        On this grid.
    bands : sequence of int
        Numbers of the multispectral bands.
    """
    columns, rows = _windows(grid.width, multiple), _windows(grid.height, multiple)
    places = [(left, top, width, height) for top, height in rows for left, width in columns]
    most = max(1, _VALUES // (columns[0][1] * rows[0][1] * (len(bands) + 1)))
    chosen = np.unique(np.linspace(0, len(places) - 1, min(most, len(places))).round().astype(int))
    index, samples = np.array(bands) - 1, []
    for place in (places[number] for number in chosen.tolist()):
        (sharp, there), (pixels, valid) = (image.read(*place) for image in (pan, colours))
        values = np.where(valid[index], pixels[index].astype(np.float32), np.float32(np.nan))
        samples.append(Sample(np.where(there[0], sharp[0].astype(np.float32), np.float32(np.nan)), values))
    return samples


def _windows(length: int, multiple: int) -> list[tuple[int, int]]:
    """Return starts and sides of windows along a side of a grid; the last one is what is left, if that is enough."""
    side = min(max(_SIDE, _REDUCED * multiple), length)
    side = max(side // multiple * multiple, min(multiple, length))
    starts = range(0, length, max(side, _SIDE))
    found = [(start, min(side, (length - start) // multiple * multiple)) for start in starts]
    return [window for window in found if window[1] >= _REDUCED * multiple] or [(0, side)]


def regress(samples: Sequence[Sample], count: int) -> Weights:
    """Return the non-negative weights of so many bands that explain the panchromatic pixels best.

    Raises
    ------
    InputError
        If the orthos have too few pixels, or too few with a value in both, or no band is positively related to the
        panchromatic one.
    """
    valid = [np.isfinite(sample.pan) & np.isfinite(sample.colours).all(axis=0) for sample in samples]
    limit = _saturation(np.concatenate([sample.pan[good] for sample, good in zip(samples, valid, strict=True)]))
    below = [good & (sample.pan < limit) for sample, good in zip(samples, valid, strict=True)]
    used = below if sum(map(np.count_nonzero, below)) >= _FEWEST * count else valid
    normal, right = np.zeros((count, count)), np.zeros(count)
    pixels, total, squares = 0, 0.0, 0.0
    for sample, good in zip(samples, used, strict=True):
        design, observed = sample.colours[:, good].T.astype(np.float64), sample.pan[good].astype(np.float64)
        normal += design.T @ design
        right += design.T @ observed
        pixels += len(observed)
        total += float(observed.sum())
        squares += float((observed**2).sum())
    every = sum(sample.pan.size for sample in samples)
    if every < _FEWEST * count:
        raise InputError(
            f"the orthos have {counted(every, 'multispectral pixel')} in common; the weights of "
            f"{counted(count, 'band')} need {_FEWEST * count}",
            field="ratio",
            remedy=Text("give larger orthos, or a smaller ", Setting("ratio")),
        )
    if pixels < _FEWEST * count:
        raise InputError(
            "the panchromatic and the multispectral ortho have (almost) no valid pixels in common",
            field="nodata",
            remedy="check the nodata values and masks of both",
        )
    values = _non_negative(normal, right)
    if not values.any():
        raise InputError(
            "no multispectral band is related to the panchromatic ortho",
            field="weights",
            remedy="give both orthos of one acquisition",
        )
    left = max(squares - 2 * float(values @ right) + float(values @ normal @ values), 0.0)
    variance = squares - total**2 / pixels
    explained = 1.0 - left / variance if variance > 0 else 0.0
    return Weights(tuple(values.tolist()), explained, float(np.sqrt(left / pixels)), pixels)


def _non_negative(normal: Array, right: Array) -> Array:
    """Return the non-negative solution of normal equations."""
    scale = np.sqrt(np.diag(normal))
    scale[scale == 0] = 1.0
    values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
    # A dependent band has no eigenvalue of its own; it may have any weight, so it gets the smallest.
    root = np.sqrt(np.maximum(values, 0.0))
    kept = root > 1e-7 * root.max()
    design = (vectors * root).T[kept]
    observed = (vectors.T @ (right / scale))[kept] / root[kept]
    return np.asarray(optimize.nnls(design, observed)[0] / scale)


def _saturation(pan: NDArray[np.float32]) -> float:
    """Return the value above the median that most pixels as bright or brighter have; infinity without one.

    Interpolation makes a few pixels beside a saturated area brighter than it.
    """
    values, counts = np.unique(pan, return_counts=True)
    brighter = counts[::-1].cumsum()[::-1]
    found = (2 * counts >= brighter) & (brighter >= _SATURATED * len(pan)) & (brighter < len(pan) / 2)
    return float(values[found][0]) if found.any() else np.inf
