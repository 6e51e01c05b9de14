"""The system of a block's parameters alone, once its points are eliminated: by triangulation, or by normal equations.

Source: Golub 1965 (Householder triangulation).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors, DenseCofactors, LevelCofactors
from ortho_pipeline.block.equations.image_pairs import Levels
from ortho_pipeline.block.equations.level_factor import LevelFactor, LevelMatrix, lengths_of
from ortho_pipeline.block.equations.unknowns import Columns
from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.least_squares import LinearSolution, solve_linear
from ortho_pipeline.models.base import Array


@dataclass(frozen=True, eq=False)
class DenseSolution:
    """Values ``(P,)`` of a system that was triangulated."""

    found: LinearSolution
    columns: Columns

    @property
    def values(self) -> Array:
        return self.found.values

    @property
    def cofactors(self) -> Cofactors:
        return DenseCofactors(self.found.cofactors, self.columns)

    @property
    def condition(self) -> float:
        return self.found.condition


class OrthogonalSystem:
    """The rows of the parameters alone, to be triangulated."""

    def __init__(self, rows: int, columns: Columns) -> None:
        self.columns = columns
        self.filled, self.design, self.right = 0, np.zeros((rows, columns.size)), np.zeros(rows)

    def add(self, columns: Index, design: Array, right: Array) -> None:
        """Add rows ``(n, p)`` of some columns."""
        rows = slice(self.filled, self.filled + len(design))
        self.design[rows, columns] = design
        self.right[rows] = right
        self.filled += len(design)

    def scaled(self) -> Array:
        """Return normal equations ``(P, P)`` with a diagonal of ones."""
        design = self.design / lengths_of(np.linalg.norm(self.design, axis=0))
        return np.asarray(design.T @ design)

    def solve(self, damping: float) -> DenseSolution:
        """Return the solution; with `damping`, steps are shortened relative to the length of the columns."""
        design, right = self.design, self.right
        if damping:
            design = np.vstack([design, math.sqrt(damping) * np.diag(np.linalg.norm(design, axis=0))])
            right = np.concatenate([right, np.zeros(design.shape[1])])
        return DenseSolution(solve_linear(design, right, refine=False), self.columns)


@dataclass(frozen=True, eq=False)
class LevelSolution:
    """Values ``(P,)`` of normal equations; NaN where these are not positive definite (no `factor`)."""

    values: Array
    levels: Levels
    factor: LevelFactor | None

    @property
    def cofactors(self) -> Cofactors:
        if self.factor is None:
            size = self.levels.columns.size
            return DenseCofactors(np.full((size, size), np.nan), self.levels.columns)
        return LevelCofactors(self.levels, self.factor)

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

    def solve(self, damping: float) -> LevelSolution:
        """Return the solution; with `damping`, steps are shortened relative to the diagonal."""
        from scipy.linalg import LinAlgError

        right = self.right[self.levels.columns.padded >= 0]
        try:
            factor = LevelFactor(self.levels, self.blocks, damping)
        except (LinAlgError, ValueError):  # a ValueError says that something is not finite
            return LevelSolution(np.full_like(right, np.nan), self.levels, None)
        return LevelSolution(factor.solve(right), self.levels, factor)


def solve_triangular(r: Array, right: Array) -> Array:
    """Solve stacks of upper triangular systems ``(n, 3, 3)`` for ``(n, 3)``."""
    z = right[:, 2] / r[:, 2, 2]
    y = (right[:, 1] - r[:, 1, 2] * z) / r[:, 1, 1]
    x = (right[:, 0] - r[:, 0, 1] * y - r[:, 0, 2] * z) / r[:, 0, 0]
    return np.stack([x, y, z], axis=1)
