r"""Refraction correction: the height above a point at which a straight line has the same image as the bent ray.

With refractivity :math:`\nu(h) = \nu_0 e^{-h/s}`, camera height H, point height h, and zenith angle z of the ray at the
point, it is :math:`B / \cos^2 z` with

.. math:: B = \int_h^H \nu\, dh - \nu(H) (H - h).

It moves the image point outwards by the angle between chord and tangent of the bent ray. From 6 km above sea level this
is 59 µrad per tan z, as in Saastamoinen; from space it is 2.5 m of height.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ortho_pipeline.models.base import Array

#: Refractivity of air at the ellipsoid, and the height (m) over which it decreases by a factor e.
REFRACTIVITY, SCALE_HEIGHT = 2.77e-4, 9200.0
#: Flatter rays (cosine of the zenith angle) see no useful part of the scene.
FLATTEST = 0.17


class RefractionCorrection(NamedTuple):
    """The correction (m, upwards) ``(N,)`` and its derivatives.

    By the point's height ``(N,)``, by the point through the zenith angle ``(N, 3)``, by the camera ``(N, 3)``.
    """

    height: Array
    by_height: Array
    by_point: Array
    by_centre: Array


def refraction_correction(
    heights: Array, place: Array, up: Array, *, centre: Array, top: float, curvature: float
) -> RefractionCorrection:
    """Return the correction of points that a camera sees.

    Parameters
    ----------
    heights : (N,)
        Ellipsoidal heights of the points (m).
    place, up : (N, 3)
        The points and the upward directions there, in a Cartesian frame (m).
    centre, top : (3,), float
        The camera in that frame, and its ellipsoidal height.
    curvature : float
        How fast the upward direction turns with the position (1/m).
    """
    line = centre - place
    distance = np.linalg.norm(line, axis=1)[:, None]
    towards = line / distance
    cosine = np.maximum((towards * up).sum(axis=1), FLATTEST)
    below, above = (REFRACTIVITY * np.exp(-h / SCALE_HEIGHT) for h in (heights, top))
    bend = SCALE_HEIGHT * (below - above) - above * (top - heights)
    by_cosine = (-2 * bend / cosine**3)[:, None]
    by_towards = (up - cosine[:, None] * towards) / distance
    # The vertical turns as the point moves, by the curvature of the Earth.
    by_point = by_cosine * (curvature * (towards - cosine[:, None] * up) - by_towards)
    by_centre = by_cosine * by_towards + (above / SCALE_HEIGHT * (top - heights) / cosine**2)[:, None] * up
    return RefractionCorrection(bend / cosine**2, (above - below) / cosine**2, by_point, by_centre)
