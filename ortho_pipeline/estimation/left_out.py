r"""Observations left out, without adjusting again: what they would be off by, and how far they are from all others.

With the redundancy matrix :math:`I - H` of observations of unit weight, and its block :math:`R` of some of them with
the misfits :math:`v`, these would be :math:`R^{-1} v` off had they taken no part, and :math:`w^2 = v^T R^{-1} v` is
their distance from all others in standard deviations, both exact for models that are linear in their parameters.
Directions in which the others tell nothing have no redundancy: nothing is known there, and nothing can be tested.

It is the same for the points of one image, for rays and known ground of a block, and for points of one group together.

Source: Baarda 1968; Cook and Weisberg 1982 (section 2.2, several rows at once).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.geodesy.ellipsoid import Array


class LeftOut(NamedTuple):
    """Parts of k observations each, left out one by one.

    `misfits` ``(n, k)`` are zero along directions in which nothing is known, and NaN where that is so in all; `known`
    ``(n, k)`` are the others, along the axes of the redundancy. `squares` ``(n,)`` are w squared, of `rank` ``(n,)``
    degrees of freedom.
    """

    misfits: Array
    known: NDArray[np.bool_]
    squares: Array
    rank: NDArray[np.int64]

    @property
    def whole(self) -> Array:
        """The misfits, NaN where they are not known in all directions."""
        return np.where(self.known.all(axis=1, keepdims=True), self.misfits, np.nan)


def left_out(redundancy: Array, misfits: Array, *, known: float, testable: float | None = None) -> LeftOut:
    """Return parts with blocks ``(n, k, k)`` of the redundancy matrix, and misfits ``(n, k)``, as if left out.

    Parameters
    ----------
    known, testable : float
        Least redundancy of a direction in which something is known, and in which it is tested; the same by default.
    """
    shares, axes = np.linalg.eigh(redundancy)
    turned = np.einsum("nij,ni->nj", axes, misfits)
    there, tested = shares > known, shares > (known if testable is None else testable)
    alone = turned / np.where(there, shares, np.inf)
    left = np.einsum("nij,nj->ni", axes, alone)
    left[~there.any(axis=1)] = np.nan
    return LeftOut(left, there, np.where(tested, turned * alone, 0.0).sum(axis=1), tested.sum(axis=1))
