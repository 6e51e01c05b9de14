"""The covariances of matches, from theory and from their residuals.

Least-squares matching gives the shape of a match's covariance, and a size that is several times too small. An error of
the DEM moves a point along the line of sight, by ``d(image)/d(height)``. The rest is the same in both directions:
errors of the reference, changes of the ground. Variance components, estimated from the residuals of a robust fit, scale
the three parts, so the mean covariance is right whatever was assumed. The fit absorbs a part of the errors, and more
than one match per parameter if chips overlap, because they share the noise of their common pixels (`unexplained`).

Source: Koch 1999, section 3.6 (variance components); Lawson and Hanson 1974 (non-negative least squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, spatial

from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.models.base import Array

_ROUNDS = 30
#: Least standard deviation (px) of a match: if all residuals have one direction, nothing is left for the other.
_LEAST = 0.01
#: Height (m) that moves a match by less than that where both lines of sight are parallel, as in images of one bundle.
_HIGH = 1000.0
#: Squared residuals above this many times their expectation are gross errors, and do not count for the weights.
_BLUNDER = 9.0
#: One over the standard deviations of two squares and a product of independent standard normal errors.
_WEIGHT = np.array([1.0 / np.sqrt(2), 1.0 / np.sqrt(2), 1.0])


@dataclass(frozen=True)
class Components:
    """Factors of the three parts of a match's covariance.

    Parameters
    ----------
    matching : float
        Factor of the covariance of least-squares matching.
    height : float
        Standard deviation (m) of the heights.
    other : float
        Standard deviation (px) per axis of all other errors.
    """

    matching: float
    height: float
    other: float

    def covariance(self, matched: Array, along: Array) -> Array:
        """Return covariances ``(n, 2, 2)`` in px² of matches.

        Parameters
        ----------
        matched : (n, 2, 2)
            Covariance of least-squares matching, px².
        along : (n, 2)
            d(image)/d(height), px per metre.
        """
        sight = along[:, :, None] * along[:, None, :]
        return self.matching * matched + self.height**2 * sight + self.other**2 * np.eye(2)


def components(residuals: Array, matched: Array, along: Array) -> Components:
    """Estimate the factors from residuals ``(n, 2)`` of a fit to many matches.

    Non-negative least squares fits the parts to squares and products of the residuals, weighted by their covariance
    under the last estimate. Gross errors are excluded. Heights have no part where hardly any height would be seen.
    """
    along = along if float(np.median(np.linalg.norm(along, axis=1))) * _HIGH > _LEAST else np.zeros_like(along)
    sight = along[:, :, None] * along[:, None, :]
    parts = np.stack([matched, sight, np.broadcast_to(np.eye(2), matched.shape)], axis=-1)
    squares = residuals[:, :, None] * residuals[:, None, :]
    factors, before = _start(residuals, along), np.zeros(3)
    least = factors[2]
    for _ in range(_ROUNDS):
        expected = parts @ factors + 1e-9 * np.eye(2)
        distance = squared_distances(residuals, expected)
        good = distance <= _BLUNDER
        if good.sum() < 8:
            break
        # In whitened units squares and products are independent, with variances 2 and 1. In the image heights spread
        # matches far along one direction, and errors across it would be a difference of large, dependent numbers.
        white = np.linalg.inv(np.linalg.cholesky(expected[good]))
        rows = _three(np.einsum("nij,njkp,nlk->nilp", white, parts[good], white))
        right = _three(white @ squares[good] @ white.transpose(0, 2, 1))
        design, observed = (rows * _WEIGHT[:, None]).reshape(-1, 3), (right * _WEIGHT).ravel()
        # Share of a chi-squared distribution with two degrees of freedom that the limit keeps.
        cut = 1.0 - np.exp(-_BLUNDER / 2) * (1.0 + _BLUNDER / 2)
        length = np.linalg.norm(design, axis=0)
        length[length == 0] = 1.0
        factors = optimize.nnls(design / length, observed / cut)[0] / length
        if not factors.any():
            factors[2] = least
        if np.allclose(factors, before, rtol=1e-3, atol=1e-9):
            break
        before = factors
    return Components(float(factors[0]), float(np.sqrt(factors[1])), max(float(np.sqrt(factors[2])), _LEAST))


def unexplained(design: Array, centres: Array, side: float) -> float:
    """Return the part (0 to 1) of the variance of errors that remains in the residuals of a least-squares fit.

    It is ``1 - tr(H R) / n`` with the hat matrix H and the correlations R of the errors, which are the common parts of
    the areas of two chips.

    Parameters
    ----------
    design : (n, k)
        Design matrix of each axis.
    centres : (n, 2)
        Centres of chips of `side` x `side`.
    """
    basis = np.linalg.qr(design)[0]
    first, second = spatial.cKDTree(centres).query_pairs(side, p=np.inf, output_type="ndarray").T
    shared = (1.0 - np.abs(centres[first] - centres[second]) / side).prod(axis=1)
    taken = basis.shape[1] + 2.0 * float(((basis[first] * basis[second]).sum(axis=1) * shared).sum())
    return max(1.0 - taken / len(design), 1.0 / len(design))


def _start(residuals: Array, along: Array) -> Array:
    """Return start values (squares) of height and rest, from medians along and across the line of sight."""
    length = np.linalg.norm(along, axis=1)
    unit = np.divide(along, length[:, None], out=np.tile([1.0, 0.0], (len(along), 1)), where=length[:, None] > 0)
    across = np.stack([-unit[:, 1], unit[:, 0]], axis=1)
    far, near = (1.4826 * float(np.median(np.abs((residuals * axis).sum(axis=1)))) for axis in (unit, across))
    rest = max(near**2, 1e-6)
    middle = float(np.median(length))
    return np.array([0.0, max(far**2 - rest, 0.0) / middle**2 if middle else 0.0, rest])


def _three(matrix: Array) -> Array:
    """Return the entries ``(n, 3, ...)`` of symmetric matrices ``(n, 2, 2, ...)``."""
    return np.stack([matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 0, 1]], axis=1)
