"""Polynomials of ground coordinates: their terms, and the derivatives of the terms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import Array
from ortho_pipeline.models.families import Family, exponents, family_of


@dataclass(frozen=True, eq=False)
class TermTable:
    """Terms of a family, and the indices of its coefficients in a table: numerators of col, row, then denominators."""

    family: Family
    powers: NDArray[np.int64]  # (T, 3), of all terms
    places: tuple[tuple[NDArray[np.int64], int], ...]  # for each parameter: its rows of the table, its term

    def table(self, coefficients: Array) -> Array:
        """Return the coefficients as ``(4, T)``, with the constants of the denominators."""
        table = np.zeros((4, len(self.powers)))
        table[2:, 0] = 1.0
        for value, (rows, term) in zip(coefficients, self.places, strict=True):
            table[rows, term] = value
        return table


@lru_cache(maxsize=64)
def term_table(name: str) -> TermTable:
    """Return the terms of a family and the indices of its coefficients."""
    family = family_of(name)
    terms = list(dict.fromkeys(("1", *family.col, *family.row, *family.den)))
    rows = {"col": [0], "row": [1], "den": [2, 3], "col_den": [2], "row_den": [3]}
    places = []
    for parameter in family.param_names:
        part, _, term = parameter.rpartition("_")
        places.append((np.array(rows[part]), terms.index(term)))
    return TermTable(family, np.array([exponents(term) for term in terms]), tuple(places))


def _powers_of(exponents: NDArray[np.int64], normalised: Array) -> list[list[Array]]:
    """Return 1, x, x^2 … of each coordinate, up to its largest exponent."""
    by_axis = []
    for axis in range(3):
        powers = [np.ones(len(normalised))]
        for _ in range(int(exponents[:, axis].max())):
            powers.append(powers[-1] * normalised[:, axis])
        by_axis.append(powers)
    return by_axis


def terms_of(exponents: NDArray[np.int64], normalised: Array) -> Array:
    """Return the terms ``(T, N)`` with exponents ``(T, 3)`` of normalised coordinates ``(N, 3)``."""
    powers = _powers_of(exponents, normalised)
    return np.array([powers[0][i] * powers[1][j] * powers[2][k] for i, j, k in exponents])


def term_partials(exponents: NDArray[np.int64], normalised: Array) -> Array:
    """Return the derivatives of the terms by the normalised coordinates ``(3, T, N)``."""
    powers = _powers_of(exponents, normalised)
    partials = np.zeros((3, len(exponents), len(normalised)))
    for axis in range(3):
        for term, exponent in enumerate(exponents):
            if exponent[axis]:
                i, j, k = exponent - (np.arange(3) == axis)
                partials[axis, term] = float(exponent[axis]) * powers[0][i] * powers[1][j] * powers[2][k]
    return partials
