r"""Gauss-Newton steps of a block, extrapolated where they converge slowly or swing about the minimum.

Products of parameters and points bend the model of a block. Where the misfits are not small against that, each mode of
the error shrinks by a ratio of its own from step to step, or overshoots and turns back, so that steps alone creep or
never settle. The last few steps tell these ratios: with changes :math:`c_k` of the misfits, the combination of them
that is smallest is where the steps would meet.

Source: Anderson 1965; Walker and Ni 2011 (as least squares of differences).
"""

from __future__ import annotations

import numpy as np

from ortho_pipeline.models.base import Array

#: Steps that are remembered; a ratio of lengths above which they converge slowly.
_DEPTH, _SLOW = 5, 0.1
#: Changes that are combinations of others but for this part of their length say nothing new.
_NEW = 1e-6


class Steps:
    """The last steps of an iteration, with the change of misfits (sigmas) that each promised, and the moves made."""

    def __init__(self) -> None:
        self.changes: list[Array] = []
        self.steps: list[Array] = []
        self.moves: list[Array] = []

    @property
    def length(self) -> float:
        """Length of the change that the last step promised."""
        return float(np.linalg.norm(self.changes[-1])) if self.changes else np.inf

    def extrapolated(self, change: Array, step: Array) -> Array | None:
        """Return where this step ``(n,)`` and those before it would lead; None if they converge well by themselves."""
        if not self.changes or np.linalg.norm(change) < _SLOW * self.length:
            return None
        changes, steps = np.array([*self.changes, change]), np.array([*self.steps, step])
        bends = np.diff(changes, axis=0).T
        combination = np.linalg.lstsq(bends, change, rcond=_NEW)[0]
        found: Array = step - (np.array(self.moves) + np.diff(steps, axis=0)).T @ combination
        return found

    def made(self, change: Array, step: Array, move: Array) -> None:
        """Remember a step and the move that was made of it."""
        for kept, new in ((self.changes, change), (self.steps, step), (self.moves, move)):
            kept.append(new)
            del kept[:-_DEPTH]
