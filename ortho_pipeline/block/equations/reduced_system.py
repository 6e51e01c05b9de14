"""The system of a block's parameters alone, once its points are eliminated: normal equations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.image_pairs import Levels
from ortho_pipeline.block.equations.level_factor import LevelFactor, LevelMatrix
from ortho_pipeline.block.points import Index
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.models.base import Array


@dataclass(frozen=True, eq=False)
class NormalSolution:
    """Values ``(P,)`` of normal equations; NaN where these are not positive definite (no `factor`)."""

    values: Array
    levels: Levels
    factor: LevelFactor | None

    @property
    def cofactors(self) -> Cofactors:
        """Those of the parameters.

        Raises
        ------
        NotConverged
            If the equations leave parameters open.
        """
        if self.factor is None:
            raise NotConverged("the equations of the parameters have no inverse")
        return Cofactors(self.levels, self.factor)

    @cached_property
    def condition(self) -> float:
        return math.inf if self.factor is None else self.factor.condition()


class NormalSystem:
    """The normal equations of the parameters alone: blocks ``(S, p, p)`` of pairs of images, right ``(images, p)``."""

    def __init__(self, levels: Levels) -> None:
        images, wide = levels.columns.padded.shape
        self.levels = levels
        self.blocks, self.right = np.zeros((len(levels.pairs.first), wide, wide)), np.zeros((images, wide))

    def add(self, image: Index, design: Array, right: Array) -> None:
        """Add rows ``(k, p)`` of the parameters of one image ``(k,)`` each."""
        np.add.at(self.blocks, self.levels.pairs.slot[image, image], design[:, :, None] * design[:, None, :])
        np.add.at(self.right, image, design * right[:, None])

    def scaled(self) -> Array:
        """Return normal equations ``(P, P)`` with a diagonal of ones."""
        return LevelMatrix(self.levels, self.blocks).dense()

    def solve(self, damping: float) -> NormalSolution:
        """Return the solution; with `damping`, steps are shortened relative to the diagonal."""
        right = self.right[self.levels.columns.padded >= 0]
        try:
            factor = LevelFactor(self.levels, self.blocks, damping)
        except np.linalg.LinAlgError:
            return NormalSolution(np.full_like(right, np.nan), self.levels, None)
        return NormalSolution(factor.solve(right), self.levels, factor)
