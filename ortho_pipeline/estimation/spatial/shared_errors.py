r"""What neighbouring points err together, and what it does to the parameters of a fit.

Matched points share the errors of the DEM and of the reference with their neighbours: of whitened errors :math:`u` of
points with a group, along each of two axes, :math:`\mathrm{cov}(u_i, u_j) = \sigma_n^2 \delta_{ij} + \sigma_s^2
e^{-d_{ij} / c}`. With whitened design :math:`A` and cofactors :math:`Q`, the covariance of the parameters of a weighted
fit is then :math:`Q A^T \Sigma A Q` (sandwich), not :math:`\sigma_0^2 Q`.

Residuals hide the part that the model absorbs. So the function is estimated by restricted likelihood, which looks only
at what no value of the parameters can explain: a few dozen smooth contrasts (cosines made orthogonal to the design),
whose level tells how errors add up over the scene, against the rest, which tells their size. A range of half a scene is
hardly told from a longer one. So no single function is taken: :math:`\Sigma` is the mean over all shares and ranges, up
to the extent of the points, weighted by their likelihood. That is right on average over scenes, too careful where
ranges are short, and a little too bold at half a scene (docs/accuracy.md). A constant part, and a shared part of less
than 15 % of the variance over the whole scene, cannot be told from the shift: they are not seen at all.

Source: Patterson and Thompson 1971 (restricted likelihood); Liang and Zeger 1986 (sandwich); Cressie 1993, section 2.6.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ortho_pipeline.estimation.problem import Solution
from ortho_pipeline.models.base import Array

#: Fewer points with groups, or degrees of freedom, say nothing of a function: each group then counts as one point.
FEWEST_POINTS = 30
#: More points add time and no insight: so many are drawn from them.
MOST_POINTS = 1000
#: Ranges that are tried, in parts of the extent of the points, and shares of the variance that neighbours share.
_RANGES = np.geomspace(0.015, 1.0, 10)
_SHARES = np.concatenate([[0.0], np.linspace(0.15, 0.95, 17)])
#: Chance beforehand that nothing is shared.
_NOTHING = 0.1
#: Smooth contrasts, and the largest part of the points that they may be.
_CONTRASTS, _PART = 200, 0.5


@dataclass(frozen=True)
class SharedErrors:
    """Errors that neighbours share, along two axes of whitened errors (the first has the larger shared part).

    `noise` and `shared` are standard deviations in units of the stated ones, `range_px` the distance at which 1/e of
    the covariance is left, all as means over what is likely; None where `points`, those with a group, are too few.
    `effective_points` is the number of independent points that would determine a shift as well as all of the fit.
    """

    points: int
    groups: int
    effective_points: float
    noise: tuple[float, float] | None = None
    shared: tuple[float, float] | None = None
    range_px: tuple[float, float] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the section ``shared_errors`` of the statistics of a fit."""
        return asdict(self)


def shared_errors(solution: Solution, image: Array) -> tuple[SharedErrors, Array] | None:
    """Return what neighbours share and the covariance ``(P, P)`` of the parameters; None where no point has a group.

    Parameters
    ----------
    solution : Solution
        With redundancy.
    image : (n, 2)
        Its points, px.
    """
    rows = np.flatnonzero(solution.groups >= 0)
    if not len(rows) or solution.sigma0 is None or not len(solution.cofactors):
        return None
    variance = float(solution.sigma0) ** 2
    design = solution.errors.whitened(solution.jacobian)[rows]
    residuals = solution.errors.whitened(solution.residuals)[rows]
    shift = solution.errors.whitened(np.broadcast_to(np.eye(2), (len(solution.groups), 2, 2)))
    groups = len(np.unique(solution.groups[rows]))
    usual = variance * solution.cofactors
    scene = _Scene.of(image[rows], residuals, np.concatenate([design, shift[rows]], axis=2), design.shape[2])
    if scene is None:
        # All that is known is who shares: a group is one point.
        effective = float(len(solution.groups) - len(rows) + groups)
        return SharedErrors(len(rows), groups, effective), usual * max(len(rows) / groups, 1.0)
    middle, likely = scene.middle(variance)
    count = design.shape[2]
    sandwich = solution.cofactors @ middle[:count, :count] @ solution.cofactors
    covariance = usual + _positive(sandwich, usual)
    # The same for a shift alone, of all points: those on their own count as they are.
    normal = np.einsum("nij,nik->jk", shift, shift)
    inverse = np.linalg.inv(normal)
    total = variance * inverse
    grown = total + _positive(inverse @ middle[count:, count:] @ inverse, total)
    effective = len(solution.groups) * float(np.trace(total) / np.trace(grown))
    return SharedErrors(len(rows), groups, effective, *likely), covariance


def _positive(matrix: Array, unit: Array) -> Array:
    """Return the positive part of a symmetric matrix, in units of a positive one."""
    values, vectors = np.linalg.eigh(unit)
    root = vectors * np.sqrt(np.maximum(values, 1e-300))
    back = vectors / np.sqrt(np.maximum(values, 1e-300))
    inner = back.T @ matrix @ back
    values, vectors = np.linalg.eigh((inner + inner.T) / 2)
    half = root @ vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(half @ half.T)


@dataclass(frozen=True, eq=False)
class _Scene:
    """Points that share errors, as the restricted likelihood takes them."""

    distance: Array  # (n, n) px
    extent: float
    basis: Array  # (n, p + m): an orthonormal basis of the design, then contrasts
    absorbed: int  # p
    axes: Array  # (2, 2): rows are the axes
    smooth: Array  # (m, 2) contrasts of residuals along the axes
    rest: Array  # (2,) sum of squares of what else is left
    design: Array  # (p, 2, K): the whole design along the axes, in the basis
    weight: float  # points over those that were drawn

    @classmethod
    def of(cls, image: Array, residuals: Array, design: Array, count: int) -> _Scene | None:
        """Return the scene of points ``(n, 2)``, their whitened residuals, and design ``(n, 2, K)``."""
        given = len(image)
        order = np.lexsort(image.T)
        if given > MOST_POINTS:
            order = np.sort(np.random.default_rng(0).permutation(given)[:MOST_POINTS])
            order = np.lexsort(image.T)[order]
        image, residuals, design = image[order], residuals[order], design[order]
        n = len(image)
        low, size = image.min(axis=0), np.ptp(image, axis=0)
        extent = float(size.max())
        columns = np.concatenate([design[:, 0], design[:, 1]], axis=1)
        scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        left, singular, _ = np.linalg.svd(columns / scale, full_matrices=False)
        span = left[:, singular > 1e-9 * singular[0]]
        p = span.shape[1]
        contrasts = min(_CONTRASTS, int(_PART * (n - p)))
        if n < FEWEST_POINTS or contrasts < 6 or not extent > 0:
            return None
        place = (image - low) / np.where(size > 0, size, 1.0)
        waves = _waves(size, contrasts + p)
        cosines = np.cos(np.pi * place[:, :1] * waves[:, 0]) * np.cos(np.pi * place[:, 1:] * waves[:, 1])
        cosines -= span @ (span.T @ cosines)
        basis, triangle = np.linalg.qr(cosines - span @ (span.T @ cosines))
        # Waves that the model takes up are gone.
        basis = basis[:, np.abs(np.diag(triangle)) > 1e-3 * math.sqrt(n)][:, :contrasts]
        smooth = basis.T @ residuals
        whole = residuals - span @ (span.T @ residuals)
        rest = whole - basis @ smooth
        m, freedom = basis.shape[1], n - p - basis.shape[1]
        excess = smooth.T @ smooth / m - rest.T @ rest / freedom
        axes = np.linalg.eigh(excess)[1].T[::-1]
        turned = np.einsum("ij,njk->nik", axes, design)
        distance = np.hypot(image[:, None, 0] - image[:, 0], image[:, None, 1] - image[:, 1])
        return cls(
            distance, extent, np.hstack([span, basis]), p, axes, smooth @ axes.T, ((rest @ axes.T) ** 2).sum(axis=0),
            np.einsum("np,nik->pik", span, turned), given / n,
        )  # fmt: skip

    def middle(self, variance: float) -> tuple[Array, Any]:
        """Return the excess of A^T Sigma A ``(K, K)`` over independent errors of `variance`, and what is likely."""
        n, p, m = len(self.basis), self.absorbed, len(self.smooth)
        freedom = n - p - m
        logs, scales, inner = [], [], []
        for part in _RANGES:
            kernel = np.exp(-self.distance / (part * self.extent))
            product = self.basis.T @ (kernel @ self.basis)
            values, vectors = np.linalg.eigh(product[p:, p:])
            inner.append(product[:p, :p])
            level = (n - np.trace(product)) / freedom
            turned = (vectors.T @ self.smooth) ** 2
            each = 1 - _SHARES[:, None] + _SHARES[:, None] * values
            other = 1 - _SHARES + _SHARES * level
            squares = (turned.T[:, None, :] / each).sum(axis=2) + self.rest[:, None] / other
            logs.append(-0.5 * (np.log(each).sum(axis=1) + freedom * np.log(other) + (n - p) * np.log(squares)))
            scales.append(squares / (n - p - 2))
        log, scale = np.array(logs), np.array(scales)  # (ranges, axes, shares)
        prior = np.full(len(_SHARES), (1 - _NOTHING) / (len(_SHARES) - 1))
        prior[0] = _NOTHING
        chance = np.exp(log - log.max(axis=(0, 2), keepdims=True)) * prior
        chance /= chance.sum(axis=(0, 2), keepdims=True)
        noise = (chance * scale * (1 - _SHARES)).sum(axis=(0, 2))
        shared = (chance * scale * _SHARES).sum(axis=2)  # (ranges, axes)
        size = self.design.shape[2]
        excess = np.zeros((size, size))
        for axis in range(2):
            rows = self.design[:, axis]
            cross = sum(part * (matrix - np.eye(p)) for part, matrix in zip(shared[:, axis], inner, strict=True))
            own = noise[axis] + shared[:, axis].sum() - variance
            excess += self.weight * own * rows.T @ rows + self.weight**2 * rows.T @ cross @ rows
        share = shared / np.maximum(shared.sum(axis=0), 1e-300)
        ranges = self.extent * np.exp((share * np.log(_RANGES)[:, None]).sum(axis=0))
        return excess, tuple(
            (float(pair[0]), float(pair[1])) for pair in (np.sqrt(noise), np.sqrt(shared.sum(axis=0)), ranges)
        )


def _waves(size: Array, count: int) -> Array:
    """Return so many pairs of half waves over the two sides of an area, the longest first, without the constant."""
    side = np.where(size > 0, size / size.max(), 1e-9)
    many = np.stack(np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij"), axis=-1).reshape(-1, 2)
    many = many[many.prod(axis=1) <= 2 * count]
    frequency = np.hypot(*(many / side).T)
    return many[np.argsort(frequency, kind="stable")][1 : count + 1]
