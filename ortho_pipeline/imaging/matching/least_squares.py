r"""Least-squares matching: the sub-pixel shift between two chips, with its covariance.

The chips of scene and target differ by a shift, a gain and an offset, :math:`T(p) = a R(p + d) + b + e`; the gain may
be negative. If intensities do not follow this rule (other seasons, other bands), the orientation of gradients replaces
them, with a positive gain and no offset.

The normal equations use the gradients of the scene: :math:`\sum \nabla T (T - a R(d)) = 0` is the maximum of the
covariance of both chips. The target's gradients would also minimise the energy of the target's chip. Interpolation
reduces this energy between whole pixels, so noise would push shifts away from whole pixels, by their full length and
more. The mean of both gradients, which is common, biases chips that differ by more than noise. Detail finer than a
pixel is blurred first, because interpolation would move it.

With the normal matrix :math:`N = a \sum \nabla T \nabla R^T` the covariance is
:math:`\sigma^2 N^{-1} (\sum \nabla T \nabla T^T) N^{-T}`. Neighbouring residuals are correlated, so it is too small by
a factor that `weights` estimates from the scatter of many matches.

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
#: Largest difference (chip px) from the result of the search.
_FARTHEST = 1.5
#: Largest sigma (chip px) of a shift; farther away the correlation of chips is no parabola.
_VAGUE = 0.5
#: Correlation of intensities above which they follow gain and offset.
_ALIKE = 0.4
#: Standard deviation (chip px) of the blur to subtract, because shadows, haze and seasons change broad structure.
_BROAD = 2.5
#: Standard deviation (chip px) of the blur that removes noise and detail too fine for interpolation.
_FINE = 0.7
#: Border (chip px) to skip, because interpolation and gradients need neighbours.
RIM = 3


@dataclass(frozen=True, eq=False)
class Measured:
    """Shifts of chips.

    Parameters
    ----------
    shift : (n, 2)
        Column and row (chip px); NaN if it did not converge, or is uncertain by more than half a pixel.
    covariance : (n, 2, 2)
        chip px², up to a common factor.
    correlation : (n,)
        Correlation of the chips at that shift, -1 to 1.
    by_orientation : (n,)
        Whether orientations were used instead of intensities.
    """

    shift: Array
    covariance: Array
    correlation: Array
    by_orientation: NDArray[np.bool_]


def measure(scene: NDArray[np.float32], target: NDArray[np.float32], start: Array) -> Measured:
    """Measure the shifts of chips ``(n, s, s)`` in targets ``(n, s + 2r, s + 2r)``, from start values ``(n, 2)``."""
    detail = [_detail(chips) for chips in (scene, target)]
    measured = _shifts(detail[0][:, None], detail[1][:, None], start, offset=True)
    alike = np.abs(measured.correlation) >= _ALIKE
    other = np.flatnonzero(~alike)
    if not len(other):
        return measured
    again = _shifts(_layers(scene[other]), _layers(target[other]), start[other], offset=False)
    measured.shift[other], measured.covariance[other] = again.shift, again.covariance
    measured.correlation[other] = again.correlation
    return Measured(measured.shift, measured.covariance, measured.correlation, ~alike)


def _detail(chips: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return chips without broad structure (shadows, seasons) and without too fine detail; NaN stays NaN."""
    valid = np.isfinite(chips)
    weight, filled = valid.astype(np.float32), np.where(valid, chips, 0.0).astype(np.float32)

    def blurred(sigma: float, truncate: float) -> NDArray[np.float32]:
        over = ndimage.gaussian_filter(weight, (0, sigma, sigma), truncate=truncate)
        values = ndimage.gaussian_filter(filled, (0, sigma, sigma), truncate=truncate)
        return np.asarray(values / np.maximum(over, 1e-3), dtype=np.float32)

    return np.where(valid, blurred(_FINE, 3.0) - blurred(_BROAD, 2.0), np.float32(np.nan))


def _layers(chips: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return orientations of chips ``(n, h, w)`` as two layers ``(n, 2, h, w)``; NaN where unknown."""
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
