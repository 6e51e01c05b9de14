r"""Exact circular errors of a normal distribution in the plane: the radius that contains a share of it.

With principal standard deviations :math:`a \ge b`, the share beyond the radius :math:`r` is

.. math:: \frac{2}{\pi} \int_0^{\pi/2} \exp\left(-\frac{r^2}{2 (a^2 \cos^2 t + b^2 \sin^2 t)}\right) dt,

so :math:`r / a` depends on :math:`b / a` alone: at 90 % it is 1.6449 for an error along one line, 2.1460 for a circle.
It is tabulated, and interpolated to 1e-6.

Source: Craig 1991 (the form of the integral); Chew and Boyce 1962 (circular error of an ellipse).
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.optimize import brentq

from ortho_pipeline.models.base import Array

#: Ratios of the axes, from 0 to 1, at which the radius is tabulated.
_RATIOS = 513
#: Nodes of the integral; few suffice for a smooth periodic function.
_NODES = 96
#: Iterations of Newton's method.
_STEPS = 9


def principal(covariance: Array) -> tuple[Array, Array]:
    """Return the larger and the smaller principal standard deviation ``(n,)`` of ``(n, 3)``: xx, yy and xy."""
    xx, yy, xy = covariance.T
    middle, half = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.sqrt(middle + half), np.sqrt(np.maximum(middle - half, 0.0))


def share_beyond(radius: Array, larger: Array, smaller: Array) -> Array:
    """Return the share ``(...)`` of errors beyond a radius, of principal standard deviations; all broadcast."""
    angle = (np.arange(_NODES) + 0.5) / _NODES * np.pi / 2
    square = larger[..., None] ** 2 * np.cos(angle) ** 2 + smaller[..., None] ** 2 * np.sin(angle) ** 2
    with np.errstate(divide="ignore"):
        return np.asarray(np.exp(-(radius[..., None] ** 2) / (2 * square)).mean(axis=-1))


@functools.cache
def radii(share: float = 0.9) -> Array:
    """Return the radius that contains a share of the errors, in larger axes, at `_RATIOS` even ratios of the axes.

    Computed by Newton's method from the left: beyond one standard deviation the integral is convex in the radius.
    """
    ratios = np.linspace(0.0, 1.0, _RATIOS)[:, None]
    angle = (np.arange(_NODES) + 0.5) / _NODES * np.pi / 2
    square = np.cos(angle) ** 2 + ratios**2 * np.sin(angle) ** 2
    radius = np.ones((_RATIOS, 1))
    for _ in range(_STEPS):
        density = np.exp(-(radius**2) / (2 * square))
        slope = -radius * (density / square).mean(axis=1, keepdims=True)
        radius = radius - (density.mean(axis=1, keepdims=True) - (1.0 - share)) / slope
    return np.asarray(radius[:, 0])


def circular_error(covariance: Array, share: float = 0.9) -> Array:
    """Return the radius ``(n,)`` of the circle with a share of the errors of covariances ``(n, 3)``: xx, yy, xy."""
    larger, smaller = principal(covariance)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(larger > 0, smaller / larger, 1.0)
    return np.asarray(larger * np.interp(ratio, np.linspace(0.0, 1.0, _RATIOS), radii(share)))


def circular_error_of_all(covariance: Array, share: float = 0.9) -> float:
    """Return the radius that contains a share of the errors of all positions together, of covariances ``(n, 3)``."""
    larger, smaller = principal(covariance)
    low, high = float(circular_error(covariance, share).min()), float(circular_error(covariance, share).max())

    def beyond(radius: float) -> float:
        return float(share_beyond(np.array(radius), larger, smaller).mean()) - (1.0 - share)

    # If all positions have the same covariance, rounding decides on which side the root is.
    return float(brentq(beyond, low, high, rtol=1e-6)) if low < high and beyond(low) > 0.0 > beyond(high) else high
