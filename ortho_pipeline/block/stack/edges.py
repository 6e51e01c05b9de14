"""The edges of a stack: displacements between pairs of dates, sampled at the same places."""

from __future__ import annotations

import functools
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ortho_pipeline.models.base import Array

#: Cells along the longer side.
CELLS = 12
#: Matches of a cell that are so many times the median from its median take no part.
_APART = 4.0


class Cells(NamedTuple):
    """Square cells over the area of a stack; a place is (column, row) in pixels of its grid.

    Parameters
    ----------
    low : (2,)
    side : float
        Of a cell, px.
    shape : (int, int)
        Columns and rows of cells.
    """

    low: Array
    side: float
    shape: tuple[int, int]

    @classmethod
    def over(cls, low: Array, high: Array) -> Cells:
        """Return cells that cover an area."""
        extent = np.maximum(np.asarray(high, dtype=float) - low, 1.0)
        side = float(extent.max()) / CELLS
        columns, rows = np.maximum(np.ceil(extent / side - 1e-9), 1).astype(int).tolist()
        return cls(np.asarray(low, dtype=float), side, (columns, rows))

    @property
    def middles(self) -> Array:
        """Middles ``(K, 2)`` px, row by row."""
        columns, rows = np.meshgrid(*(np.arange(count) + 0.5 for count in self.shape))
        return self.low + self.side * np.column_stack([columns.ravel(), rows.ravel()])

    @property
    def place(self) -> Array:
        """Middles ``(K, 2)`` about the middle of all, in halves of the longer side: -1 to 1."""
        return (self.middles - self.middle) / self.half

    @property
    def middle(self) -> Array:
        """Middle ``(2,)`` px of the area."""
        return self.low + self.side * np.array(self.shape) / 2

    @property
    def half(self) -> float:
        """Half of the longer side, px."""
        return self.side * max(self.shape) / 2

    def sampled(self, place: Array, value: Array, sigma: Array) -> tuple[Array, Array]:
        """Return the mean displacement of each cell ``(K, 2)`` and its variance ``(K,)`` if noise is independent.

        Both are NaN without a match. Matches ``(n, 2)`` that are far from the median of their cell take no part.
        """
        count = self.shape[0] * self.shape[1]
        found, variance = np.full((count, 2), np.nan), np.full(count, np.nan)
        column, row = np.floor((place - self.low) / self.side).astype(int).T
        inside = (column >= 0) & (row >= 0) & (column < self.shape[0]) & (row < self.shape[1])
        cell = np.where(inside, row * self.shape[0] + column, -1)
        for number in np.unique(cell[inside]).tolist():
            here = np.flatnonzero(cell == number)
            length = np.hypot(*(value[here] - np.median(value[here], axis=0)).T)
            here = here[length <= max(_APART * float(np.median(length)), 3.0 * float(np.median(sigma[here])))]
            if len(here):
                found[number], variance[number] = value[here].mean(axis=0), (sigma[here] ** 2).mean() / len(here)
        return found, variance


@dataclass(frozen=True, eq=False)
class Edges:
    """Displacements of one date relative to another, in px of the stack's grid.

    Parameters
    ----------
    first, second : (E,) of int
        Numbers of the dates; a displacement is that of the first minus that of the second.
    value : (E, K, 2)
        At the places of the stack; NaN where nothing is measured.
    variance : (E, K)
        Of each value, if it had only noise of its own.
    alike : (E,)
        Standard deviation of an error that all values of an edge share.
    """

    first: NDArray[np.int_]
    second: NDArray[np.int_]
    value: Array
    variance: Array
    alike: Array

    def __len__(self) -> int:
        return len(self.first)

    @functools.cached_property
    def measured(self) -> NDArray[np.bool_]:
        """Which values ``(E, K)`` are measured."""
        return np.asarray(np.isfinite(self.value).all(axis=2))

    @functools.cached_property
    def relative(self) -> Array:
        """Variances ``(E, K)`` in units of their median, 1 where nothing is measured."""
        middle = float(np.median(self.variance[self.measured])) if self.measured.any() else 1.0
        return np.clip(np.where(self.measured, self.variance, middle) / max(middle, 1e-12), 0.1, 10.0)

    def incidence(self, count: int) -> sparse.csr_matrix:
        """Return which dates each edge compares ``(E, count)``: 1 the first, -1 the second."""
        rows = np.arange(len(self))
        signs = np.concatenate([np.ones(len(self)), -np.ones(len(self))])
        places = np.concatenate([rows, rows]), np.concatenate([self.first, self.second])
        return sparse.csr_matrix((signs, places), shape=(len(self), count))

    def select(self, index: NDArray[np.int_] | NDArray[np.bool_]) -> Edges:
        """Return some edges."""
        return replace(self, **{field.name: getattr(self, field.name)[index] for field in fields(self)})
