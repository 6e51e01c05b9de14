"""Cofactors of a block's parameters: all of them for a small block, of a large one what is asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol

import numpy as np

from ortho_pipeline.block.equations.image_pairs import Levels
from ortho_pipeline.block.equations.level_factor import LevelFactor
from ortho_pipeline.block.equations.unknowns import Columns
from ortho_pipeline.block.points import Index
from ortho_pipeline.models.base import Array


class Cofactors(Protocol):
    """The inverse ``(P, P)`` of a block's normal matrix, or a covariance that is made of one."""

    @property
    def matrix(self) -> Array:
        """All of it ``(P, P)``."""

    @property
    def variances(self) -> Array:
        """Its diagonal ``(P,)``."""

    def times(self, right: Array) -> Array:
        """Return its product with ``(P, r)``."""

    def of_images(self, images: Sequence[int] | Index) -> Array:
        """Return that of the parameters of some images that points tie."""

    def blocks_of(self, levels: Levels) -> Array:
        """Return those of pairs of images ``(S, p, p)``."""

    def mixed(self, factor: float, root: Array, inner: Array) -> Cofactors:
        """Return `factor` times this, and R X R' of a `root` ``(P, m)`` and an `inner` matrix ``(m, m)``."""


@dataclass(frozen=True, eq=False)
class DenseCofactors:
    """Cofactors that are there as a whole."""

    matrix: Array
    columns: Columns

    @property
    def variances(self) -> Array:
        """Its diagonal ``(P,)``."""
        return np.diag(self.matrix)

    def times(self, right: Array) -> Array:
        """Return its product with ``(P, r)``."""
        return np.asarray(self.matrix @ right)

    def of_images(self, images: Sequence[int] | Index) -> Array:
        """Return that of the parameters of some images."""
        columns = self.columns.padded[images].ravel()
        columns = columns[columns >= 0]
        return self.matrix[columns[:, None], columns]

    def blocks_of(self, levels: Levels) -> Array:
        """Return those of pairs of images ``(S, p, p)``."""
        whole, padded = np.pad(self.matrix, ((0, 1), (0, 1))), self.columns.padded
        return whole[padded[levels.pairs.first][:, :, None], padded[levels.pairs.second][:, None, :]]

    def mixed(self, factor: float, root: Array, inner: Array) -> DenseCofactors:
        """Return `factor` times this, and R X R'."""
        return DenseCofactors(factor * self.matrix + root @ inner @ root.T, self.columns)


@dataclass(frozen=True, eq=False)
class LevelCofactors:
    """The inverse of normal equations in levels, times a factor, and R X R' of few columns."""

    levels: Levels
    inverse: LevelFactor
    factor: float = 1.0
    root: Array = field(default_factory=lambda: np.zeros((0, 0)))
    inner: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @cached_property
    def _blocks(self) -> Array:
        pairs, padded = self.levels.pairs, self.levels.columns.padded
        found = self.factor * self.inverse.blocks
        if self.root.size:
            right = np.vstack([self.root, np.zeros((1, self.root.shape[1]))])[padded]
            found += (right @ self.inner)[pairs.first] @ right[pairs.second].swapaxes(1, 2)
        return np.asarray(found)

    @cached_property
    def matrix(self) -> Array:
        """All of it ``(P, P)``."""
        return self.times(np.eye(self.levels.columns.size))

    @property
    def variances(self) -> Array:
        """Its diagonal ``(P,)``."""
        padded = self.levels.columns.padded
        images = np.arange(len(padded))
        diagonal = np.diagonal(self._blocks[self.levels.pairs.slot[images, images]], axis1=1, axis2=2)
        return np.asarray(diagonal[padded >= 0])

    def times(self, right: Array) -> Array:
        """Return its product with ``(P, r)``."""
        found = self.factor * self.inverse.solve(right)
        return found + self.root @ (self.inner @ (self.root.T @ right)) if self.root.size else found

    def of_images(self, images: Sequence[int] | Index) -> Array:
        """Return that of the parameters of some images that points tie."""
        images = np.asarray(images)
        slots, wide = self.levels.pairs.slot[images[:, None], images], self.levels.columns.widest
        parts = self._blocks[slots]
        # A pair is there once, with the earlier image first.
        parts = np.where((images[:, None] > images)[:, :, None, None], parts.swapaxes(2, 3), parts)
        whole = parts.transpose(0, 2, 1, 3).reshape(len(images) * wide, len(images) * wide)
        real = self.levels.columns.padded[images].ravel() >= 0
        return np.asarray(whole[real][:, real])

    def blocks_of(self, levels: Levels) -> Array:
        """Return those of pairs of images ``(S, p, p)``."""
        return self._blocks

    def mixed(self, factor: float, root: Array, inner: Array) -> LevelCofactors:
        """Return `factor` times this, and R X R'."""
        if self.root.size:
            own, of = self.inner.shape[0], len(inner)
            root = np.hstack([self.root, root])
            inner = np.block([[factor * self.inner, np.zeros((own, of))], [np.zeros((of, own)), inner]])
        return LevelCofactors(self.levels, self.inverse, factor * self.factor, root, inner)
