"""The system of a block's parameters alone, once its points are eliminated: by triangulation, or by normal equations.

Source: Golub 1965 (Householder triangulation).
"""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.least_squares import LinearSolution, solve_linear
from ortho_pipeline.models.base import Array


class OrthogonalSystem:
    """The rows of the parameters alone, to be triangulated."""

    def __init__(self, rows: int, columns: int) -> None:
        self.filled, self.design, self.right = 0, np.zeros((rows, columns)), np.zeros(rows)

    def add(self, columns: Index, design: Array, right: Array) -> None:
        """Add rows ``(n, p)`` of some columns."""
        rows = slice(self.filled, self.filled + len(design))
        self.design[rows, columns] = design
        self.right[rows] = right
        self.filled += len(design)

    @property
    def scaled(self) -> Array:
        """Normal equations with a diagonal of ones."""
        design = self.design / _lengths(np.linalg.norm(self.design, axis=0))
        return np.asarray(design.T @ design)

    def solve(self, damping: float) -> LinearSolution:
        """Return the solution; with `damping`, steps are shortened relative to the length of the columns."""
        design, right = self.design, self.right
        if damping:
            design = np.vstack([design, math.sqrt(damping) * np.diag(np.linalg.norm(design, axis=0))])
            right = np.concatenate([right, np.zeros(design.shape[1])])
        return solve_linear(design, right, refine=False)


class NormalSystem:
    """The normal equations of the parameters alone, for many rows."""

    def __init__(self, columns: int) -> None:
        self.matrix, self.right = np.zeros((columns, columns)), np.zeros(columns)

    def add(self, columns: Index, design: Array, right: Array, *, sign: float = 1.0) -> None:
        """Add (or subtract) the products of rows ``(n, p)`` of some columns."""
        self.matrix[columns[:, None], columns] += sign * (design.T @ design)
        self.right[columns] += sign * (design.T @ right)

    @property
    def scaled(self) -> Array:
        """Normal equations with a diagonal of ones."""
        lengths = _lengths(np.sqrt(np.maximum(np.diag(self.matrix), 0.0)))
        return np.asarray(self.matrix / np.outer(lengths, lengths))

    def solve(self, damping: float) -> LinearSolution:
        """Return the solution; with `damping`, steps are shortened relative to the diagonal."""
        from scipy.linalg import LinAlgError, cho_factor, cho_solve

        count = len(self.right)
        lengths = _lengths(np.sqrt(np.maximum(np.diag(self.matrix), 0.0)))
        scaled = self.scaled + damping * np.eye(count)
        try:
            factor = cho_factor(scaled)
        except LinAlgError:
            left_open = np.full(count, np.nan)
            return LinearSolution(left_open, left_open, np.full_like(scaled, np.nan), math.inf)
        inverse = cho_solve(factor, np.eye(count))
        spectrum = np.linalg.eigvalsh(scaled)
        condition = math.sqrt(spectrum[-1] / spectrum[0]) if spectrum[0] > 0 else math.inf
        values = inverse @ (self.right / lengths) / lengths
        return LinearSolution(values, np.zeros(0), inverse / np.outer(lengths, lengths), condition)


def _lengths(lengths: Array) -> Array:
    return np.where(lengths > 0, lengths, 1.0)


def solve_triangular(r: Array, right: Array) -> Array:
    """Solve stacks of upper triangular systems ``(n, 3, 3)`` for ``(n, 3)``."""
    z = right[:, 2] / r[:, 2, 2]
    y = (right[:, 1] - r[:, 1, 2] * z) / r[:, 1, 1]
    x = (right[:, 0] - r[:, 0, 1] * y - r[:, 0, 2] * z) / r[:, 0, 0]
    return np.stack([x, y, z], axis=1)
