"""How certain matches are: the covariance of each, from what can be computed and what their residuals tell.

Least-squares matching gives the shape of a match's covariance and a size that is several times too small. An error of
the DEM moves a point along the line of sight, by ``d(image)/d(height)``. What remains is alike in both directions: the
reference's own errors, ground that has changed. The three factors are estimated from the residuals of a robust fit
(variance components), so the covariances are true in the mean whatever was assumed. The fit takes up a part of the
errors, and more than one match per parameter where chips overlap: those share the noise of the pixels that they share
(`unexplained`).

Source: Koch 1999, section 3.6 (variance components); Lawson and Hanson 1974 (non-negative least squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, spatial

from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.models.base import Array

_ROUNDS = 30
#: No match is more certain than this (px): residuals that are all of one direction leave nothing for the other.
_LEAST = 0.01
#: Squared residuals beyond this many times their expectation tell of blunders, not of weights.
_BLUNDER = 9.0
#: Of two squares and a product of independent standard normal errors: one over the root of their variances.
_WEIGHT = np.array([1.0 / np.sqrt(2), 1.0 / np.sqrt(2), 1.0])


@dataclass(frozen=True)
class Components:
    """Factors of the three parts of a match's covariance.

    Parameters
    ----------
    matching : float
        Multiplies the covariance of least-squares matching.
    height : float
        Standard deviation (m) of the heights.
    other : float
        Standard deviation (px) per axis of what is neither.
    """

    matching: float
    height: float
    other: float

    def covariance(self, matched: Array, along: Array) -> Array:
        """Return covariances ``(n, 2, 2)`` in px² of matches.

        Parameters
        ----------
        matched : (n, 2, 2)
            Of least-squares matching, px².
        along : (n, 2)
            d(image)/d(height), px per metre.
        """
        sight = along[:, :, None] * along[:, None, :]
        return self.matching * matched + self.height**2 * sight + self.other**2 * np.eye(2)


def components(residuals: Array, matched: Array, along: Array) -> Components:
    """Estimate the factors from residuals ``(n, 2)`` of a fit to many matches.

    Squares and products of the residuals are fitted by non-negative least squares to what the parts predict, weighted
    by their covariance under the last estimate; what is far beyond it takes no part.
    """
    sight = along[:, :, None] * along[:, None, :]
    parts = np.stack([matched, sight, np.broadcast_to(np.eye(2), matched.shape)], axis=-1)
    squares = residuals[:, :, None] * residuals[:, None, :]
    found, before = _start(residuals, along), np.zeros(3)
    least = found[2]
    for _ in range(_ROUNDS):
        expected = parts @ found + 1e-9 * np.eye(2)
        distance = squared_distances(residuals, expected)
        good = distance <= _BLUNDER
        if good.sum() < 8:
            break
        # In units of what is expected, where squares and products are independent, with the variances 2 and 1:
        # in the image, where heights spread matches far along one direction, what lies across it would be the
        # difference of large numbers that are not.
        white = np.linalg.inv(np.linalg.cholesky(expected[good]))
        rows = _three(np.einsum("nij,njkp,nlk->nilp", white, parts[good], white))
        right = _three(white @ squares[good] @ white.transpose(0, 2, 1))
        design, observed = (rows * _WEIGHT[:, None]).reshape(-1, 3), (right * _WEIGHT).ravel()
        # What is cut off beyond the limit of a chi-squared of two degrees of freedom, relative to all of it.
        cut = 1.0 - np.exp(-_BLUNDER / 2) * (1.0 + _BLUNDER / 2)
        length = np.linalg.norm(design, axis=0)
        length[length == 0] = 1.0
        found = optimize.nnls(design / length, observed / cut)[0] / length
        if not found.any():
            found[2] = least
        if np.allclose(found, before, rtol=1e-3, atol=1e-9):
            break
        before = found
    return Components(float(found[0]), float(np.sqrt(found[1])), max(float(np.sqrt(found[2])), _LEAST))


def unexplained(design: Array, centres: Array, side: float) -> float:
    """Return the part (0 to 1) of the variance of errors that a least-squares fit leaves in its residuals.

    It is ``1 - tr(H R) / n`` with the hat matrix H and the correlations R of the errors: the part of its area that a
    chip shares with another one.

    Parameters
    ----------
    design : (n, k)
        Of each axis.
    centres : (n, 2)
        Of chips of `side` x `side`.
    """
    basis = np.linalg.qr(design)[0]
    one, other = spatial.cKDTree(centres).query_pairs(side, p=np.inf, output_type="ndarray").T
    shared = (1.0 - np.abs(centres[one] - centres[other]) / side).prod(axis=1)
    taken = basis.shape[1] + 2.0 * float(((basis[one] * basis[other]).sum(axis=1) * shared).sum())
    return max(1.0 - taken / len(design), 1.0 / len(design))


def _start(residuals: Array, along: Array) -> Array:
    """Return squares of a first height and of the rest, by medians along and across the line of sight."""
    length = np.linalg.norm(along, axis=1)
    unit = np.divide(along, length[:, None], out=np.tile([1.0, 0.0], (len(along), 1)), where=length[:, None] > 0)
    across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    far, near = (1.4826 * float(np.median(np.abs((residuals * axis).sum(axis=1)))) for axis in (unit, across))
    rest = max(near**2, 1e-6)
    return np.array([0.0, max(far**2 - rest, 0.0) / max(float(np.median(length)) ** 2, 1e-12), rest])


def _three(matrix: Array) -> Array:
    """Return the entries ``(n, 3, ...)`` of symmetric matrices ``(n, 2, 2, ...)``."""
    return np.stack([matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 0, 1]], axis=1)
