"""Cofactors of a block's parameters: what is asked for of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.image_pairs import Levels
from ortho_pipeline.block.equations.level_factor import LevelFactor
from ortho_pipeline.block.points import Index
from ortho_pipeline.models.base import Array
from ortho_pipeline.runtime.process_limits import one_blas_thread

#: Numbers of a matrix that is made for some of the pairs at once.
_AT_ONCE = 1 << 19


@dataclass(frozen=True, eq=False)
class Cofactors:
    """The inverse ``(P, P)`` of normal equations in levels, times a factor, and R X R' of few columns.

    `root` R is ``(P, m)``, `inner` X ``(m, m)``: a covariance that is made of the inverse is of the same kind.
    """

    levels: Levels
    inverse: LevelFactor
    factor: float = 1.0
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))
    inner: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def blocks(self) -> Array:
        """Those of pairs of images ``(S, p, p)``."""
        pairs, padded = self.levels.pairs, self.levels.columns.padded
        found = self.factor * self.inverse.blocks
        if self.root.size:
            right = np.vstack([self.root, np.zeros((1, self.root.shape[1]))])[padded]
            left, step = right @ self.inner, max(_AT_ONCE // max(right[0].size, 1), 1)
            for begin in range(0, len(found), step):
                part = slice(begin, begin + step)
                found[part] += left[pairs.first[part]] @ right[pairs.second[part]].swapaxes(1, 2)
        return np.asarray(found)

    @cached_property
    def matrix(self) -> Array:
        """All of it ``(P, P)``."""
        with one_blas_thread():
            found = self.times(np.eye(self.levels.columns.size))
        return (found + found.T) / 2

    @property
    def variances(self) -> Array:
        """Its diagonal ``(P,)``."""
        padded = self.levels.columns.padded
        images = np.arange(len(padded))
        diagonal = np.diagonal(self.blocks[self.levels.pairs.slot[images, images]], axis1=1, axis2=2)
        return np.asarray(diagonal[padded >= 0])

    def times(self, right: Array) -> Array:
        """Return its product with ``(P, r)``."""
        found = self.factor * self.inverse.solve(right)
        return found + self.root @ (self.inner @ (self.root.T @ right)) if self.root.size else found

    def of_image(self, image: int) -> Array:
        """Return that of the parameters of an image."""
        count = int((self.levels.columns.padded[image] >= 0).sum())
        return self.blocks[self.levels.pairs.slot[image, image], :count, :count]

    def between(self, first: Index, second: Index) -> Array:
        """Return those ``(n, p, p)`` of pairs of images ``(n,)`` that points tie, by all parameters of the widest."""
        found = self.blocks[self.levels.pairs.slot[first, second]]
        # A pair is there once, with the earlier image first.
        return np.where((first > second)[:, None, None], found.swapaxes(1, 2), found)

    def mixed(self, factor: float, root: Array, inner: Array) -> Cofactors:
        """Return `factor` times this, and R X R'."""
        if self.root.size:
            own, of = self.inner.shape[0], len(inner)
            root = np.hstack([self.root, root])
            inner = np.block([[factor * self.inner, np.zeros((own, of))], [np.zeros((of, own)), inner]])
        return Cofactors(self.levels, self.inverse, factor * self.factor, root, inner)
