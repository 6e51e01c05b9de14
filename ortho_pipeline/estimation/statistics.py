r"""Statistics of an adjustment of one image or a block: of observations, and of estimated parameters.

Observations are left out without a new adjustment. Let :math:`I - H` be the redundancy matrix of observations of unit
weight, :math:`R` its block for some of them, and :math:`v` their misfits. Without these observations, their misfits
would be :math:`R^{-1} v`, and :math:`w^2 = v^T R^{-1} v` is their squared distance from all others in standard
deviations. Both are exact for models that are linear in their parameters. In a direction without redundancy, nothing is
known and nothing can be tested.

For estimated parameters, from their values and covariance:

- total correlation of parameter k: :math:`\sqrt{1 - 1 / (C_{kk} (C^{-1})_{kk})}`, its multiple correlation with all
  others; 1 means that the others together can replace the parameter;
- Student test of the hypothesis that the parameter is zero: :math:`t_k = x_k / \sigma_k`, two-sided.

Source: Baarda 1968 and Cook and Weisberg 1982, section 2.2 (leaving out); section 3.3 of Bueyueksalih et al.
(OrbView-3), after Jacobsen (RAPORIO).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.geodesy.ellipsoid import Array


class PartsLeftOut(NamedTuple):
    """Parts of k observations each, left out one at a time.

    `misfits` ``(n, k)`` are zero in unknown directions, and NaN if all directions are unknown. `known` ``(n, k)`` marks
    known directions, along the axes of the redundancy. `squares` ``(n,)`` are w squared, with `rank` ``(n,)`` degrees
    of freedom.
    """

    misfits: Array
    known: NDArray[np.bool_]
    squares: Array
    rank: NDArray[np.int64]

    @property
    def whole(self) -> Array:
        """The misfits, NaN unless they are known in all directions."""
        return np.where(self.known.all(axis=1, keepdims=True), self.misfits, np.nan)


def left_out(redundancy: Array, misfits: Array, *, known: float, testable: float | None = None) -> PartsLeftOut:
    """Leave out parts with the blocks ``(n, k, k)`` of the redundancy matrix and the misfits ``(n, k)``.

    Parameters
    ----------
    known, testable : float
        Smallest redundancy of a known direction, and of a tested one; equal by default.
    """
    shares, axes = np.linalg.eigh(redundancy)
    turned = np.einsum("nij,ni->nj", axes, misfits)
    there, tested = shares > known, shares > (known if testable is None else testable)
    alone = turned / np.where(there, shares, np.inf)
    left = np.einsum("nij,nj->ni", axes, alone)
    left[~there.any(axis=1)] = np.nan
    return PartsLeftOut(left, there, np.where(tested, turned * alone, 0.0).sum(axis=1), tested.sum(axis=1))


def squared_distances(residuals: Array, covariance: Array) -> Array:
    r"""Return :math:`r^T C^{-1} r` ``(n,)`` of residuals ``(n, k)`` and their covariances ``(n, k, k)``.

    For normally distributed residuals they follow chi-squared with k degrees of freedom.
    """
    return np.asarray(np.einsum("ni,ni->n", residuals, np.linalg.solve(covariance, residuals[:, :, None])[:, :, 0]))


def chance_of(squares: ArrayLike, size: ArrayLike, freedom: ArrayLike) -> Array:
    """Return the chance of larger squared distances of `size` degrees of freedom, in units of a variance.

    The variance was estimated with `freedom` degrees (Fisher's distribution).
    """
    from scipy.special import fdtrc  # importing scipy.stats would take most of a command's start-up

    return np.asarray(fdtrc(size, freedom, np.asarray(squares) / size))


def rms(sizes: Array) -> float:
    """Return the root mean square of the finite values of sizes ``(n,)``; 0 if there are none."""
    known = sizes[np.isfinite(sizes)]
    return float(np.sqrt((known**2).mean())) if len(known) else 0.0


def effective_parameters(count: int, fictitious: Iterable[tuple[Array, Array]]) -> float:
    """Return how many of `count` parameters true observations determine: the trace of their hat matrix.

    `fictitious` are rows ``(k, p)`` of other observations over their sigmas (regularisation, soft constraints, datum),
    with the cofactors ``(p, p)`` of their parameters.
    """
    return count - sum(float(((rows @ cofactors) * rows).sum()) for rows, cofactors in fictitious)


def unit_weight(square: float, freedom: float, least: float) -> float | None:
    """Return the standard error of unit weight of a sum of squares; None unless `freedom` is above `least`.

    `freedom` need not be an integer if some observations are fictitious.
    """
    return math.sqrt(square / freedom) if freedom > least else None


def basis_of(columns: Array) -> Array:
    """Return an orthonormal basis of columns ``(n, K)``."""
    span, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(span[:, singular > 1e-9 * singular[0]])


def correlation_of(covariance: Array) -> Array:
    """Return the correlation matrix ``(P, P)`` of a covariance matrix; NaN for parameters without variance."""
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = covariance / sigma / sigma[:, None]
    np.fill_diagonal(correlation, 1.0)
    return np.clip(correlation, -1.0, 1.0)


def total_correlation_of(covariance: Array) -> Array:
    """Return the multiple correlation ``(P,)`` of each parameter with all others; NaN without variance."""
    correlation = correlation_of(covariance)
    if not len(correlation):
        return np.zeros(0)
    if not np.isfinite(correlation).all():
        return np.full(len(correlation), np.nan)
    # Correlation matrices of poor solutions are numerically singular: their total correlations are 1.
    values, vectors = np.linalg.eigh(correlation)
    inverse = (vectors**2 / np.maximum(values, 1e-15)) @ np.ones(len(values))
    return np.sqrt(np.clip(1.0 - 1.0 / np.maximum(inverse, 1.0), 0.0, 1.0))


def student_of(values: Array, covariance: Array, degrees_of_freedom: float) -> tuple[Array, Array]:
    """Return t and two-sided p ``(P,)`` of the hypotheses that parameters are zero.

    Without redundancy (0 degrees of freedom) the covariance is a priori, and the normal distribution is used.
    """
    if not len(values):
        return np.zeros(0), np.zeros(0)
    from scipy.special import ndtr, stdtr  # importing scipy.stats would take most of a command's start-up

    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = values / np.sqrt(np.diag(covariance))
    tail = stdtr(degrees_of_freedom, -np.abs(ratio)) if degrees_of_freedom > 0 else ndtr(-np.abs(ratio))
    return ratio, np.asarray(2 * tail)


def chance_of_mean(values: Array) -> float:
    """Return the probability of a mean as far above zero as that of values ``(n,)`` by chance; NaN if all are zero.

    One-sided t test.
    """
    from scipy.special import stdtr  # importing scipy.stats would take most of a command's start-up

    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = values.mean() / (values.std(ddof=1) / np.sqrt(len(values)))
    return float(stdtr(len(values) - 1, -ratio))
