r"""Normal equations of a block, factored level by level, and those parts of their inverse that are needed.

With the images in levels the matrix is block tridiagonal, :math:`D_l` on the diagonal and :math:`E_l` from a level to
the next. The factor is :math:`L_l L_l^T = D_l - W_{l-1}^T W_{l-1}` with :math:`W_l = L_l^{-1} E_l^T`, and of the
inverse

.. math:: G_l = L_l^{-T} W_l, \qquad C_{l,l+1} = -G_l\,C_{l+1,l+1}, \qquad
          C_{ll} = (L_l L_l^T)^{-1} + G_l\,C_{l+1,l+1}\,G_l^T

from the last level back: no other part of it is ever made.

Source: Takahashi et al. 1973 (parts of an inverse); Golub and Van Loan 2013, section 4.5 (block tridiagonal).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.image_pairs import Levels
from ortho_pipeline.models.base import Array

#: Up to so many parameters all eigenvalues are computed, beyond that the extreme ones are iterated for.
_FEW = 200
#: Where that iteration ends, as part of the eigenvalue's length: its error is about the square of this.
_NEARLY = 1e-6


class LevelMatrix:
    """Normal equations with blocks ``(S, p, p)`` of pairs of images, their diagonal scaled to ones."""

    def __init__(self, levels: Levels, blocks: Array, damping: float = 0.0) -> None:
        self.levels = levels
        padded = levels.columns.padded
        images = np.arange(len(padded))
        diagonal = np.diagonal(blocks[levels.pairs.slot[images, images]], axis1=1, axis2=2)
        self.lengths = lengths_of(np.sqrt(np.maximum(diagonal, 0.0)))
        # Of the levels, and between a level and the next.
        own, between = levels.split(self._scaled(blocks))
        self._parts = [part + damping * np.eye(len(part)) if damping else part for part in own], between

    def _scaled(self, blocks: Array) -> Array:
        pairs = self.levels.pairs
        lengths = self.lengths[pairs.first][:, :, None] * self.lengths[pairs.second][:, None, :]
        return np.asarray(blocks / lengths)

    @property
    def _lengths(self) -> Array:
        """Square roots ``(P,)`` of the diagonal as it was."""
        return self.lengths[self.levels.columns.padded >= 0]

    def _product(self, right: Array) -> Array:
        """Return the scaled matrix times ``(P,)``."""
        columns, (own, between) = self.levels.of_level, self._parts
        parts, found = [right[part] for part in columns], np.empty_like(right)
        for number, matrix in enumerate(own):
            found[columns[number]] = matrix @ parts[number]
        for number, matrix in enumerate(between):
            found[columns[number + 1]] += matrix @ parts[number]
            found[columns[number]] += matrix.T @ parts[number + 1]
        return found

    def dense(self) -> Array:
        """Return the scaled matrix ``(P, P)``."""
        columns, size = self.levels.of_level, self.levels.columns.size
        found, (own, between) = np.zeros((size, size)), self._parts
        for number, part in enumerate(own):
            found[np.ix_(columns[number], columns[number])] = part
        for number, part in enumerate(between):
            found[np.ix_(columns[number + 1], columns[number])] = part
            found[np.ix_(columns[number], columns[number + 1])] = part.T
        return found


class LevelFactor(LevelMatrix):
    """The factor of normal equations; `damping` is added to their scaled diagonal.

    Raises
    ------
    LinAlgError
        If they are not positive definite.
    """

    def __init__(self, levels: Levels, blocks: Array, damping: float = 0.0) -> None:
        super().__init__(levels, blocks, damping)
        self._lower: list[Array] = []
        self._along: list[Array] = []
        own, between = self._parts
        for number, part in enumerate(own):
            left = part
            if number:
                along = _back(self._lower[-1], between[number - 1].T)
                self._along.append(along)
                left = part - along.T @ along
            self._lower.append(_root(left))

    def solve(self, right: Array) -> Array:
        """Return the inverse times ``(P,)`` or ``(P, r)``."""
        lengths = self._lengths if right.ndim == 1 else self._lengths[:, None]
        return np.asarray(self._solve(right / lengths) / lengths)

    def _solve(self, right: Array) -> Array:
        """Return the solution of the scaled equations."""
        columns, parts = self.levels.of_level, list[Array]()
        for number, lower in enumerate(self._lower):
            part = right[columns[number]]
            if number:
                part = part - self._along[number - 1].T @ parts[-1]
            parts.append(_back(lower, part))
        found = np.empty_like(right)
        for number in reversed(range(len(parts))):
            part = parts[number]
            if number + 1 < len(parts):
                part = part - self._along[number] @ found[columns[number + 1]]
            found[columns[number]] = _back(self._lower[number], part, turned=True)
        return found

    @cached_property
    def blocks(self) -> Array:
        """Blocks ``(S, p, p)`` of the inverse."""
        own: list[Array] = []
        between: list[Array] = []
        for number in reversed(range(len(self._lower))):
            lower = self._lower[number]
            part = inverse(lower)
            if own:
                back = _back(lower, self._along[number], turned=True)
                across = back @ own[-1]
                part = part + across @ back.T
                between.append(-across.T)
            own.append((part + part.T) / 2)
        return self._scaled(self.levels.blocks(reversed(own), reversed(between)))

    def condition(self) -> float:
        """Return the square root of the ratio of the extreme eigenvalues of the scaled matrix."""
        size = self.levels.columns.size
        if not size:
            return 1.0
        if size <= _FEW:
            low, high = np.linalg.eigvalsh(self.dense())[[0, -1]]
        else:
            from scipy.sparse.linalg import ArpackError, LinearOperator, eigsh

            start = np.random.default_rng(0).normal(size=size)

            def largest(product: Callable[[Array], Array]) -> float:
                operator = LinearOperator((size, size), product, dtype=np.float64)
                return float(eigsh(operator, 1, which="LA", v0=start, return_eigenvectors=False, tol=_NEARLY)[0])

            try:
                high, low = largest(self._product), 1.0 / largest(self._solve)
            except ArpackError:
                return math.inf
        return math.sqrt(high / low) if low > 0 else math.inf


def _root(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a matrix."""
    from scipy.linalg.lapack import dpotrf

    # Without the checks of scipy.linalg, which take ten times as long as the equations of a pair.
    found, failed = dpotrf(matrix, lower=1)
    if failed or not np.isfinite(found).all():
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(found)


def inverse(lower: Array) -> Array:
    """Return the inverse of the matrix that has a lower Cholesky factor."""
    from scipy.linalg.lapack import dpotri

    found, failed = dpotri(lower, lower=1)
    if failed:
        raise np.linalg.LinAlgError("singular")
    return np.asarray(np.tril(found) + np.tril(found, -1).T)


def _back(lower: Array, right: Array, *, turned: bool = False) -> Array:
    """Solve a lower triangular system ``(k, k)``, or its transpose, for ``(k,)`` or ``(k, r)``."""
    from scipy.linalg.lapack import dtrtrs

    found, failed = dtrtrs(lower, right, lower=1, trans=int(turned))
    if failed:
        raise np.linalg.LinAlgError("singular")
    return np.asarray(found)


def lengths_of(lengths: Array) -> Array:
    """Return lengths to divide by: 1 where there is none."""
    return np.where(lengths > 0, lengths, 1.0)
