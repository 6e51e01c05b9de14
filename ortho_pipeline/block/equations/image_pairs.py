"""Which images of a block share points: where its normal equations are not zero, and an order in which to solve them.

Images stand in levels: those that share points with an image of one level stand in it or next to it (the levels of a
search in breadth from an image at the rim). So the normal equations are block tridiagonal, and a strip of a thousand
images takes ten times as long as one of a hundred.

Source: George and Liu 1979 (start at the rim); Cuthill and McKee 1969 (levels).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.unknowns import Columns
from ortho_pipeline.block.points import BlockPoints, Index
from ortho_pipeline.models.base import Array


@dataclass(frozen=True, eq=False)
class ImagePairs:
    """Pairs ``(S,)`` of images that points tie, each with itself, `first` <= `second`.

    `slot` ``(images, images)`` is the number of a pair in either order, -1 for others.
    """

    first: Index
    second: Index
    slot: Index

    @classmethod
    def of(cls, points: BlockPoints) -> ImagePairs:
        """Return the pairs of all points, whether they take part or not."""
        order = points.by_point
        image, point = points.image[order], points.point[order]
        tied = np.eye(len(points.images), dtype=bool)
        for apart in range(1, len(order)):
            same = point[apart:] == point[:-apart]
            if not same.any():
                break
            tied[image[:-apart][same], image[apart:][same]] = True
        first, second = np.nonzero(tied)
        slot = np.full(tied.shape, -1, dtype=np.int64)
        slot[first, second] = slot[second, first] = np.arange(len(first))
        return cls(first, second, slot)

    @cached_property
    def levels(self) -> tuple[Index, ...]:
        """Images in levels."""
        tied = self.slot >= 0
        left = np.ones(len(tied), dtype=bool)
        found: list[Index] = []
        while left.any():
            part = _levels(tied, int(np.flatnonzero(left)[0]))
            while True:
                last = part[-1]
                further = _levels(tied, int(last[np.argmin(tied[last].sum(axis=1))]))
                if len(further) <= len(part):
                    break
                part = further
            left[np.concatenate(part)] = False
            found += part
        return tuple(found)


def _levels(tied: np.ndarray, start: int) -> list[Index]:
    """Return the images that can be reached from one, by the number of steps that this takes."""
    found, new = [np.array([start])], np.zeros(len(tied), dtype=bool)
    seen = np.zeros(len(tied), dtype=bool)
    seen[start] = True
    while True:
        new = tied[found[-1]].any(axis=0) & ~seen
        if not new.any():
            return found
        seen |= new
        found.append(np.flatnonzero(new))


@dataclass(frozen=True, eq=False)
class _Places:
    """Where blocks ``(s,)`` stand in a dense matrix: rows and columns ``(s, p)``; -1 for those that do not exist."""

    slots: Index
    rows: Index
    columns: Index


@dataclass(frozen=True, eq=False)
class Levels:
    """Columns of parameters in levels: matrices that have blocks of pairs of images as dense parts, and back."""

    pairs: ImagePairs
    columns: Columns

    @cached_property
    def of_level(self) -> tuple[Index, ...]:
        """Columns of the levels that have any."""
        padded = (self.columns.padded[images].ravel() for images in self.pairs.levels)
        return tuple(found for part in padded if len(found := part[part >= 0]))

    @cached_property
    def _level_and_place(self) -> tuple[Index, Index]:
        """Level of each image, and the places ``(images, p)`` of its parameters therein."""
        level, place = np.zeros(len(self.columns.padded), dtype=np.int64), np.full(self.columns.size + 1, -1)
        of_column = np.zeros(self.columns.size + 1, dtype=np.int64)
        for number, columns in enumerate(self.of_level):
            place[columns], of_column[columns] = np.arange(len(columns)), number
        if self.columns.widest:
            level = of_column[self.columns.padded[:, 0]]
        return level, place[self.columns.padded]

    @cached_property
    def _inside(self) -> tuple[_Places, ...]:
        return tuple(self._places(number, number) for number in range(len(self.of_level)))

    @cached_property
    def _across(self) -> tuple[tuple[_Places, _Places], ...]:
        """Places between a level (columns) and the next (rows): of pairs, and of those that have to be transposed."""
        return tuple((self._places(b, a), self._places(a, b)) for a, b in itertools.pairwise(range(len(self.of_level))))

    def _places(self, first: int, second: int) -> _Places:
        """Return the places of the pairs with their images in two levels."""
        level, place = self._level_and_place
        adjusted = self.columns.padded[:, 0] >= 0
        pairs = (level[self.pairs.first] == first) & (level[self.pairs.second] == second)
        slots = np.flatnonzero(pairs & adjusted[self.pairs.first] & adjusted[self.pairs.second])
        return _Places(slots, place[self.pairs.first[slots]], place[self.pairs.second[slots]])

    def split(self, blocks: Array) -> tuple[list[Array], list[Array]]:
        """Return the matrices of the levels, and those ``(next, level)`` between a level and the next."""
        sizes = [len(columns) for columns in self.of_level]
        own = []
        for size, at in zip(sizes, self._inside, strict=True):
            dense = np.zeros((size + 1, size + 1))
            dense[at.columns[:, :, None], at.rows[:, None, :]] = blocks[at.slots].swapaxes(1, 2)
            dense[at.rows[:, :, None], at.columns[:, None, :]] = blocks[at.slots]
            own.append(dense[:size, :size])
        between = []
        for (size, further), (straight, turned) in zip(itertools.pairwise(sizes), self._across, strict=True):
            dense = np.zeros((further + 1, size + 1))
            dense[straight.rows[:, :, None], straight.columns[:, None, :]] = blocks[straight.slots]
            dense[turned.columns[:, :, None], turned.rows[:, None, :]] = blocks[turned.slots].swapaxes(1, 2)
            between.append(dense[:further, :size])
        return own, between

    def blocks(self, own: Iterable[Array], between: Iterable[Array]) -> Array:
        """Return the blocks ``(S, p, p)`` that matrices of levels have, and those ``(next, level)`` between levels."""
        wide = self.columns.widest
        found = np.zeros((len(self.pairs.first), wide, wide))
        for matrix, at in zip(own, self._inside, strict=True):
            dense = np.pad(matrix, ((0, 1), (0, 1)))
            found[at.slots] = dense[at.rows[:, :, None], at.columns[:, None, :]]
        for matrix, (straight, turned) in zip(between, self._across, strict=True):
            dense = np.pad(matrix, ((0, 1), (0, 1)))
            found[straight.slots] = dense[straight.rows[:, :, None], straight.columns[:, None, :]]
            found[turned.slots] = dense[turned.columns[:, :, None], turned.rows[:, None, :]].swapaxes(1, 2)
        return found
