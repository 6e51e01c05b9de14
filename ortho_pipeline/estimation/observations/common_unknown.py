r"""An error common to many observations, as an unknown of an adjustment of one image or a block.

It is one vector :math:`c \sim N(0, I)` in units of its standard deviation: an error of known ground in plan, of the
heights of a DEM, or a parameter that images share. The adjustment
gives the information :math:`T` (``told``) and the slope :math:`g` of half the sum of squares. A step is

.. math:: (I + T)\, dc = g - c

Without information, :math:`T = 0`, it stays 0 with its full standard deviation.

Source: Koch 1999, section 3.2 (elimination of unknowns) and 3.6 (mixed model).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from ortho_pipeline.models.base import Array

_S = TypeVar("_S")
#: Largest number of iterations.
_ROUNDS = 5
#: If other points show an error of more than this many sigmas, they contradict the reference and do not correct it.
_BELIEVED = 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonUnknown:
    """An error common to some observations, and the information on it from the others.

    Parameters
    ----------
    value : (k,)
        Estimate in standard deviations, 0 without information. Of known ground: stated minus true, east and north.
    told : (k, k)
        Information from other points and from priors; that of its own standard deviation is I.
    """

    value: Array
    told: Array

    @property
    def left(self) -> Array:
        """Covariance ``(k, k)`` of the estimate, in standard deviations."""
        return np.asarray(np.linalg.inv(np.eye(len(self.value)) + self.told))

    def step(self, slope: Array) -> Array:
        """Return how far ``(k,)`` its estimate is from its best, by the slope there."""
        return np.asarray(np.linalg.solve(np.eye(len(self.value)) + self.told, slope - self.value))

    def settled_with(
        self,
        solution: _S,
        seen: Callable[[Self, _S], tuple[Self, Array]],
        again: Callable[[Self, _S], _S],
        stands: float,
    ) -> tuple[_S, Self]:
        """Return a solution with the error as an unknown, and the error.

        Parameters
        ----------
        seen : callable (self, solution) -> (self, (2,))
            The error with the information of a solution, and the slope.
        again : callable (self, solution) -> solution
            The solution with its new value.
        stands : float
            The iteration stops when the value changes by less than this (standard deviations).
        """
        error = self
        for _ in range(_ROUNDS):
            error, slope = seen(error, solution)
            step = error.step(slope)
            if np.abs(step).max() < stands:
                break
            error = replace(error, value=error.value + step)
            solution = again(error, solution)
        return solution, error


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonGroundError(CommonUnknown):
    """An error that the known ground of many points shares.

    Parameters
    ----------
    sigma : float
        Standard deviation per axis, m; the largest if points state several.
    points : int
        Number of points that share the error.
    """

    sigma: float
    points: int

    def started(self, each: Array) -> Self:
        """Return the error started from single estimates ``(n, 2)``, by their median, which resists gross errors.

        If the median is too large for the sigma, the value stays 0.
        """
        each = each[np.isfinite(each).all(axis=1)]
        value = np.median(each, axis=0) if len(each) else np.zeros(2)
        return replace(self, value=value) if (np.abs(value) < _BELIEVED).all() else self
