"""How certain matches are: the covariance of each, from what can be computed and what their residuals tell.

Least-squares matching gives the shape of a match's covariance and a size that is several times too small. An error of
the DEM moves a point along the line of sight, by ``d(image)/d(height)``. What remains is alike in both directions: the
reference's own errors, ground that has changed. The three factors are estimated from the residuals of a robust fit
(variance components), so the covariances are true in the mean whatever was assumed.

Source: Koch 1999, section 3.6 (variance components); Lawson and Hanson 1974 (non-negative least squares).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize

from ortho_pipeline.estimation.statistics import squared_distances
from ortho_pipeline.models.base import Array

_ROUNDS = 4
#: No match is more certain than this (px): residuals that are all of one direction leave nothing for the other.
_LEAST = 0.01
#: Squared residuals beyond this many times their expectation tell of blunders, not of weights.
_BLUNDER = 9.0


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

    Squares and products of the residuals are fitted by non-negative least squares to what the parts predict, each
    weighted by its own variance under the last estimate; what is far beyond it takes no part.
    """
    sight = along[:, :, None] * along[:, None, :]
    parts = np.stack([matched, sight, np.broadcast_to(np.eye(2), matched.shape)], axis=-1)
    squares = residuals[:, :, None] * residuals[:, None, :]
    scale = 1.4826**2 * np.median((residuals - np.median(residuals, axis=0)) ** 2)
    found = np.array([0.0, 0.0, max(float(scale), 1e-6)])
    for _ in range(_ROUNDS):
        expected = parts @ found + 1e-9 * np.eye(2)
        distance = squared_distances(residuals, expected)
        good = distance <= _BLUNDER
        if good.sum() < 8:
            break
        variance = np.stack([expected[:, 0, 0], expected[:, 1, 1], expected[:, 0, 1]], axis=1)[good]
        weight = 1.0 / np.stack(
            [np.sqrt(2) * variance[:, 0], np.sqrt(2) * variance[:, 1],
             np.sqrt(variance[:, 0] * variance[:, 1] + variance[:, 2] ** 2)], axis=1,
        )  # fmt: skip
        rows = np.stack([parts[good][:, 0, 0], parts[good][:, 1, 1], parts[good][:, 0, 1]], axis=1)
        right = np.stack([squares[good][:, 0, 0], squares[good][:, 1, 1], squares[good][:, 0, 1]], axis=1)
        design, observed = (rows * weight[:, :, None]).reshape(-1, 3), (right * weight).ravel()
        # What is cut off beyond the limit of a chi-squared of two degrees of freedom, relative to all of it.
        cut = 1.0 - np.exp(-_BLUNDER / 2) * (1.0 + _BLUNDER / 2)
        length = np.linalg.norm(design, axis=0)
        length[length == 0] = 1.0
        found = optimize.nnls(design / length, observed / cut)[0] / length
        if not found.any():
            found[2] = max(float(scale), 1e-6)
    return Components(float(found[0]), float(np.sqrt(found[1])), max(float(np.sqrt(found[2])), _LEAST))
