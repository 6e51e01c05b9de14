r"""The expected error of a model over a whole scene, and whether the control points contradict the model.

Leave-one-out residuals measure the error near control points. Elsewhere in the scene the parameters are less certain,
and control points at one height cannot show the error of a 2D model at other heights. Let :math:`m` be the mean square
(px²) of residuals of points that did not take part, :math:`q` the stated noise of a point, and :math:`v_t` and
:math:`v_s` the variances from the parameters at these points and over the scene (both for the stated noise). Then the
expected mean square over the scene, including measurement noise, is

.. math:: e = u (q + v_s) + h, \qquad u = \max(m / (q + v_t), u_0)

:math:`u_0` is the noise itself, because a smaller error is chance. It is 1 (the stated noise), or less if the best
supported model has less. :math:`h` is the parallax of heights without control points, zero for 3D models.

Akaike's criterion, corrected for few observations, decides whether the points support a model. With the whitened sum of
squares :math:`S`, :math:`N` observations, :math:`K` parameters (one of them the noise), and the stated noise as
:math:`\nu` further observations, it is

.. math:: (N + \nu) \ln\frac{S + \nu}{N + \nu} + 2 K + \frac{2 K (K + 1)}{N + \nu - K - 1}

A model whose criterion is larger by more than 10 has essentially no support (Burnham and Anderson 2002, section 2.6).

Source: Hurvich and Tsai 1989 (the correction); Allen 1974 (prediction by leaving out).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import metre_partials
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.models.base import Array

#: Criteria that are larger than the smallest one by this contradict the model.
_CONTRADICTED = 10.0
#: The stated noise counts as this many observations: a stated sigma is rarely accurate to better than 50 %.
_STATED = 8
#: Grid positions in the scene, in each direction and in height.
_PLACES, _LEVELS = 9, 3
#: Mean square tangent of an unknown incidence angle: 17.5 degrees.
_VIEW = 0.1


@dataclass(frozen=True)
class Expectation:
    """Statistics of one model from the points.

    Parameters
    ----------
    criterion : float
        Akaike's, corrected; infinite without redundancy.
    noise : float
        Mean square of whitened residuals by redundancy; infinite without.
    stated, tested, scene : float
        Mean variances (px²): of measuring a point as stated, and of the parameters at the points that test the model
        and over the scene.
    unseen : float
        Mean square parallax (px²) of heights without control points.
    """

    criterion: float
    noise: float
    stated: float
    tested: float
    scene: float
    unseen: float

    def square(self, mean_square: float, least: float) -> float:
        """Return the expected mean square (px²) over the scene from that at the test points; `least` is the noise."""
        return max(mean_square / (self.stated + self.tested), least) * (self.stated + self.scene) + self.unseen


def criterion(squares: float, observations: float, parameters: float) -> float:
    """Return Akaike's criterion, corrected for few observations; infinite if there are too few for the parameters.

    Parameters
    ----------
    squares : float
        Sum of squares of the whitened residuals.
    observations : float
        Their number (one for each coordinate), without the stated noise, which is added here.
    parameters : float
        Estimated parameters, without the noise.

    Examples
    --------
    >>> criterion(5.0, 15, 3) < criterion(1.0, 15, 7) < criterion(0.05, 15, 11)
    True
    """
    observations, parameters = observations + _STATED, parameters + 1
    left = observations - parameters - 1
    if left <= 0:
        return math.inf
    penalty = 2 * parameters * (1 + (parameters + 1) / left)
    return observations * math.log((squares + _STATED) / observations) + penalty


def expectation(fit: Fit, tests: NDArray[np.bool_], size: tuple[int, int] | None) -> Expectation:
    """Return the statistics of a fit that the points of the mask `tests` ``(N,)`` test, in an image of this size."""
    points, model = fit.points, fit.model
    measured = points.select(fit.used | tests)
    stated = float(np.trace(ImageErrors.of(model, measured).covariance, axis1=1, axis2=2).mean())
    places = _places(fit, size)
    return Expectation(
        _criterion(fit),
        _noise(fit),
        stated,
        _variance(fit, points.ground[tests]),
        _variance(fit, places),
        _unseen(fit, places),
    )


def supported(expected: Mapping[str, Expectation], worth: float) -> tuple[list[str], float]:
    """Return the models that the points support, and the noise as a multiple of the stated one (squared).

    A model whose noise is within the factor `worth` of the best supported one also counts: many points prove
    differences that do not matter.
    """
    best = min(expected, key=lambda name: expected[name].criterion)
    lowest = expected[best].criterion
    if not math.isfinite(lowest):
        return list(expected), 1.0
    names = [
        name
        for name, statistics in expected.items()
        if statistics.criterion <= lowest + _CONTRADICTED or statistics.noise <= worth**2 * expected[best].noise
    ]
    return names, min(1.0, expected[best].noise)


def _criterion(fit: Fit) -> float:
    freedom, count = fit.degrees_of_freedom, int(fit.used.sum())
    if fit.sigma0 is None or not count:
        return math.inf
    # Points that share errors are fewer observations than their number.
    squares = fit.sigma0**2 * freedom * fit.effective_points / count
    return criterion(squares, 2 * fit.effective_points, fit.effective_parameters)


def _noise(fit: Fit) -> float:
    return math.inf if fit.sigma0 is None else fit.sigma0**2


def _variance(fit: Fit, ground: Array) -> float:
    """Return the mean variance (px²) from the parameters at places, for the stated noise; 0 without parameters."""
    if not len(fit.model.params):
        return 0.0
    if not len(ground):
        return math.inf
    partials = fit.model.param_partials(ground)
    factors = fit.relative_covariance / (1.0 if fit.sigma0 is None else fit.sigma0**2)
    return float(np.einsum("nij,jk,nik->n", partials, factors, partials).mean())


def _places(fit: Fit, size: tuple[int, int] | None) -> Array:
    """Return positions ``(n, 3)`` spread evenly over the domain of a model, within its image."""
    centre, half = fit.model.domain
    side = (np.arange(_PLACES) + 0.5) / _PLACES * 2 - 1
    level = (np.arange(_LEVELS) + 0.5) / _LEVELS * 2 - 1
    places = centre + half * np.array(list(itertools.product(side, side, level)))
    image = fit.model.ground_to_image(places)
    seen = np.isfinite(image).all(axis=1)
    if size is not None:
        seen &= ((image >= 0) & (image <= size)).all(axis=1)
    return np.asarray(places[seen])


def _unseen(fit: Fit, places: Array) -> float:
    """Return the mean square displacement (px²) by heights without control points, for a model that ignores heights."""
    heights = fit.points.ground[fit.used, 2]
    if fit.model.uses_height or not len(places):
        return 0.0
    missing = places[:, 2].var() - heights.var()
    scale, _ = metre_partials(fit.model, places)
    return max(0.0, _VIEW * float(missing)) * float(np.abs(np.linalg.det(scale)).mean())
