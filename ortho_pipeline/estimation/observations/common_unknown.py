r"""An error that many observations have in common, as an unknown of an adjustment: of one image, and of a block.

It is one vector :math:`c \sim N(0, I)`, of known ground in plan, in units of its standard deviation. What the
adjustment tells of it is information :math:`T` (``told``), and the slope :math:`g` of half the sum of squares: a step
of it is

.. math:: (I + T)\, dc = g - c

Where nothing tells of it, :math:`T = 0`, it stays 0 with its whole standard deviation.

Source: Koch 1999, section 3.2 (elimination of unknowns) and 3.6 (mixed model).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self, TypeVar

import numpy as np

from ortho_pipeline.models.base import Array

_S = TypeVar("_S")
#: Its estimate is renewed so many times at most.
_ROUNDS = 5
#: Other points that put the reference farther off than so many of its sigmas contradict it: they do not correct it.
_BELIEVED = 4.0


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonUnknown:
    """What observations have in common, and what the others tell of it.

    Parameters
    ----------
    sigma : float
        Its standard deviation per axis, m: the largest, where points state several.
    points : int
        Control points that share it.
    value : (k,)
        Its estimate, in standard deviations: of ground how far true east and north of the truth that of these points
        lies; 0 where nothing tells of it.
    told : (k, k)
        Information of other points and of priors on it; that of its own standard deviation is I.
    """

    sigma: float
    points: int
    value: Array
    told: Array

    @property
    def left(self) -> Array:
        """Covariance ``(k, k)`` of its estimate, in standard deviations."""
        return np.asarray(np.linalg.inv(np.eye(len(self.value)) + self.told))

    def started(self, each: Array) -> Self:
        """Return it as others see it one by one ``(n, 2)``, by their median: a start that gross errors do not spoil.

        If they put it beyond what its sigma allows, it stays 0.
        """
        each = each[np.isfinite(each).all(axis=1)]
        value = np.median(each, axis=0) if len(each) else np.zeros(2)
        return replace(self, value=value) if (np.abs(value) < _BELIEVED).all() else self

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
        """Return a solution with it as an unknown, and it.

        Parameters
        ----------
        seen : callable (self, solution) -> (self, (2,))
            It with what a solution tells of it, and the slope.
        again : callable (self, solution) -> solution
            With its new value.
        stands : float
            The estimate stands when it moves by less than this (standard deviations); models are nearly linear in it.
        """
        found = self
        for _ in range(_ROUNDS):
            found, slope = seen(found, solution)
            step = found.step(slope)
            if np.abs(step).max() < stands:
                break
            found = replace(found, value=found.value + step)
            solution = again(found, solution)
        return solution, found
