r"""Least-squares matching: the sub-pixel shift between two chips, with its covariance.

The chip of the scene is the target's but for a shift, a gain and an offset, :math:`T(p) = a R(p + d) + b + e`; the gain
may be negative. Where intensities do not follow such a rule (other seasons, other bands) the orientation of gradients
takes their place, whose gain is positive and whose offset is none. The normal equations are those of the scene's
gradients: :math:`\sum \nabla T (T - a R(d)) = 0` is where the covariance of both chips is largest. With the target's
gradients it would also be where the energy of the target's chip is least, and interpolation makes that less the farther
from whole pixels it is: shifts would be pushed away from them, the more the noisier the images are, by all of their
length and more. With a mean of both gradients, as is often done, chips that differ by more than noise are drawn away
from the shift of the best likeness. What is finer than a pixel can show is blurred away before, because interpolation
moves it.

With the normal matrix :math:`N = a \sum \nabla T \nabla R^T` the covariance is
:math:`\sigma^2 N^{-1} (\sum \nabla T \nabla T^T) N^{-T}`. Neighbouring residuals are alike, so it is too small by a
factor that only the scatter of many matches tells (`weights`).

Source: Gruen 1985, Adaptive least squares correlation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ortho_pipeline.imaging.matching.correlation import orientation
from ortho_pipeline.imaging.matching.kernels import shift_kernel
from ortho_pipeline.models.base import Array

_STEPS = 8
#: A step below this (chip px) is the last.
_SMALL = 0.003
#: Chips that differ by more than a shift of so many px from where the search put them do not belong together.
_FARTHEST = 1.5
#: A sigma (chip px) above which a shift is none: no farther is the likeness of chips a parabola.
_VAGUE = 0.5
#: Residual correlation of intensities above which they follow gain and offset.
_ALIKE = 0.4
#: Standard deviation (chip px) of the blur that is taken away: shadows, haze and seasons differ in what is broad.
_BROAD = 2.5
#: The same of the blur that takes away noise and what is too fine for interpolation.
_FINE = 0.7
#: Rim (chip px) that is left out: interpolation and gradients reach over it.
RIM = 3


@dataclass(frozen=True, eq=False)
class Measured:
    """Shifts of chips.

    Parameters
    ----------
    shift : (n, 2)
        Column and row, chip px; NaN where it did not converge, or is not known to half a pixel.
    covariance : (n, 2, 2)
        chip px², up to a common factor.
    correlation : (n,)
        Of the chips at that shift, -1 to 1.
    by_orientation : (n,)
        Whether it was measured in orientations instead of intensities.
    """

    shift: Array
    covariance: Array
    correlation: Array
    by_orientation: NDArray[np.bool_]


def measure(scene: NDArray[np.float32], target: NDArray[np.float32], start: Array) -> Measured:
    """Measure the shifts of chips ``(n, s, s)`` in targets ``(n, s + 2r, s + 2r)``, from a start ``(n, 2)`` on."""
    detail = [_detail(chips) for chips in (scene, target)]
    found = _shifts(detail[0][:, None], detail[1][:, None], start, offset=True)
    alike = np.abs(found.correlation) >= _ALIKE
    other = np.flatnonzero(~alike)
    if not len(other):
        return found
    again = _shifts(_layers(scene[other]), _layers(target[other]), start[other], offset=False)
    found.shift[other], found.covariance[other] = again.shift, again.covariance
    found.correlation[other] = again.correlation
    return Measured(found.shift, found.covariance, found.correlation, ~alike)


def _detail(chips: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return chips without what is broad, as shadows and seasons make it, nor too fine; NaN where they are."""
    valid = np.isfinite(chips)
    weight, filled = valid.astype(np.float32), np.where(valid, chips, 0.0).astype(np.float32)

    def blurred(sigma: float, truncate: float) -> NDArray[np.float32]:
        over = ndimage.gaussian_filter(weight, (0, sigma, sigma), truncate=truncate)
        values = ndimage.gaussian_filter(filled, (0, sigma, sigma), truncate=truncate)
        return np.asarray(values / np.maximum(over, 1e-3), dtype=np.float32)

    return np.where(valid, blurred(_FINE, 3.0) - blurred(_BROAD, 2.0), np.float32(np.nan))


def _layers(chips: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return orientations of chips ``(n, h, w)`` as two layers ``(n, 2, h, w)``; NaN where they are not known."""
    field = orientation(chips)
    layers = np.stack([field.real, field.imag], axis=1)
    layers[np.broadcast_to((field == 0)[:, None], layers.shape)] = np.nan
    return layers


def _shifts(scene: NDArray[np.float32], target: NDArray[np.float32], start: Array, *, offset: bool) -> Measured:
    count = len(scene)
    shift, covariance, correlation = np.empty((count, 2)), np.empty((count, 2, 2)), np.empty(count)
    shift_kernel.shifts(
        np.ascontiguousarray(scene),
        np.ascontiguousarray(target),
        np.ascontiguousarray(start, dtype=float),
        offset,
        RIM,
        np.array([_STEPS, _SMALL, _FARTHEST]),
        shift,
        covariance,
        correlation,
    )
    shift[np.linalg.eigvalsh(np.nan_to_num(covariance))[:, 1] > _VAGUE**2] = np.nan
    return Measured(shift, covariance, correlation, np.full(count, not offset))
