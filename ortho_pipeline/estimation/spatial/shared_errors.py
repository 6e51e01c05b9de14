r"""Errors that neighbouring points share, and their effect on the parameters of a fit.

Matched points share errors of the DEM and the reference with their neighbours. For whitened errors :math:`u` of points
with a group, along each of two axes, :math:`\mathrm{cov}(u_i, u_j) = \sigma_n^2 \delta_{ij} + \sigma_s^2
k(d_{ij} / c)`. With whitened design :math:`A` and cofactors :math:`Q`, the covariance of the parameters of a weighted
fit is :math:`L^T \Sigma L` with the influences :math:`L = A Q` (sandwich), not :math:`\sigma_0^2 Q`.

The model absorbs part of these errors, so residuals do not show it. Restricted likelihood therefore uses only what no
value of the parameters can explain, in means over cells of a twelfth of the extent. Errors with long ranges matter for
the parameters; the many pairs of close neighbours (overlapping chips, a DEM between its samples) would outvote them.

The smoothness of the errors is unknown. So several correlations :math:`k` are tried: exponential, Matern of order 3/2,
Gaussian; each with ranges from the distance of neighbours to the extent of the points, and with :math:`\sigma_s^2` from
:math:`\sigma_n^2 / n` (no more than noise in a mean) to :math:`10^4 \sigma_n^2`. A priori, families have equal weight,
and ranges and ratios are uniform in their logarithm. Residuals show a part of the variance
:math:`\sigma_n^2 + \sigma_s^2`, and each part from none to all is equally likely; otherwise smooth functions of huge
variance would dominate. :math:`\Sigma` is the mean over all functions, weighted by likelihood. So the variance is right
on average over scenes of all these kinds, but not for each kind alone (docs/engineering/accuracy.md).

Residuals cannot show a constant part at all. The constant error of matching itself is known (`MATCHED_ALIKE`), and the
covariance includes it.

Source: Patterson and Thompson 1971 (restricted likelihood); Liang and Zeger 1986 (sandwich); Cressie 1993, section 2.6;
Stein 1999, section 2.10 (Matern); Handcock and Stein 1993 (mean over what is likely).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.estimation.problem import Solution
from ortho_pipeline.estimation.spatial.common_error import ImageCommonError
from ortho_pipeline.estimation.statistics import basis_of
from ortho_pipeline.files.json.records import Count, Pair, Record
from ortho_pipeline.models.base import Array

#: With fewer points with groups, or fewer degrees of freedom, no function is estimated: each group counts as one point.
FEWEST_POINTS = 30
#: More points cost time without benefit: a sample of this size is used.
MOST_POINTS = 400
#: The shortest range, as a part of the extent.
_HEAP = 0.005
#: (1 + x) e^-x is 1/e there.
_MATERN = 2.1461932206
#: Correlations by distance over range, 1/e at 1: exponential, Matern of order 3/2, Gaussian.
FAMILIES: tuple[Callable[[Array], Array], ...] = (
    lambda x: np.exp(-x),
    lambda x: (1.0 + _MATERN * x) * np.exp(-_MATERN * x),
    lambda x: np.exp(-(x**2)),
)
#: Numbers of ranges and of variance ratios (shared over noise), and the largest ratio (sigma of noise 1 % of shared).
_RANGES, _RATIOS, _LARGEST = 16, 20, 1e4
#: Combinations of parameters with an effect below this part of the largest are ignored.
_NO_EFFECT = 1e-9
#: Number of cells whose means are used.
_CELLS = 144
#: Constant error of all matches of an image (px per axis), whatever their number. Pixels of scene and reference have
#: the same phase all over an image, and interpolation is not exact: 0.001 to 0.003 px with real images.
MATCHED_ALIKE = 0.002


#: Values for shared errors if there are too few points.
NOT_KNOWN: dict[str, Any] = {"noise": None, "shared": None, "range_px": None}


class SharedErrors(Record):
    """Errors that neighbouring points share, in units of stated sigmas; see docs/engineering/accuracy.md."""

    # `noise`, `shared` and `range_px` are of two axes, the first with the larger shared part: weighted means over the
    # functions, None with too few points. The range is the distance at which 1/e of the covariance is left.
    # `effective_points` independent points would determine a shift as well as all points of the fit.
    points: Count
    groups: Count
    effective_points: float
    noise: Pair | None
    shared: Pair | None
    range_px: Pair | None


def shared_errors(
    solution: Solution, image: Array, common: ImageCommonError | None = None, sigma_alike: Array | None = None
) -> tuple[SharedErrors, Array] | None:
    """Return the shared errors and the covariance ``(P, P)`` of the parameters; None if no point has a group.

    Parameters
    ----------
    solution : Solution
        With redundancy.
    image : (n, 2)
        Image positions of its points, px.
    common : ImageCommonError, optional
        Error common to the points; the returned covariance is without its own part.
    sigma_alike : (n,), optional
        Constant error of the matches, px per axis, if it is known to be larger than `MATCHED_ALIKE`.
    """
    rows = np.flatnonzero(solution.groups >= 0)
    if not len(rows) or solution.sigma0 is None or not len(solution.cofactors):
        return None
    variance = float(solution.sigma0) ** 2
    design = solution.errors.whitened(solution.jacobian)[rows]
    residuals = solution.errors.whitened(solution.residuals)[rows]
    shift = solution.errors.whitened(np.broadcast_to(np.eye(2), (len(solution.groups), 2, 2)))
    own, usual = design @ solution.cofactors, variance * solution.cofactors
    if common is not None:
        own, usual = common.influence(solution)[rows], variance * common.cofactors(solution)
    sigma = np.full(len(rows), MATCHED_ALIKE) if sigma_alike is None else np.maximum(sigma_alike[rows], MATCHED_ALIKE)
    alike = np.einsum("n,nip,nik->pk", sigma, own, shift[rows])
    parts = np.concatenate([design, own], axis=2)
    shared, excess = shared_by(image[rows], residuals, parts, solution.groups[rows], shift, shift[rows], variance)
    if excess is None:
        covariance = usual * max(shared.points / shared.groups, 1.0)
    else:
        count = design.shape[2]
        covariance = usual + positive_part(excess[count:, count:], _root(usual))
    return shared, covariance + alike @ alike.T


def shared_by(
    image: Array,
    residuals: Array,
    design: Array,
    groups: np.ndarray,
    shift: Array,
    own_shift: Array,
    variance: float,
) -> tuple[SharedErrors, Array | None]:
    """Return the errors that points with groups share, and the excess of A' Sigma A over independent errors.

    The excess is None with too few points; then each group counts as one point.

    Parameters
    ----------
    image, residuals, groups : (n, 2), (n, 2), (n,)
        Positions in px, whitened residuals and group numbers of these points.
    design : (n, 2, K)
        The complete whitened design A, which explains residuals.
    shift, own_shift : (N, 2, 2), (n, 2, 2)
        A shift of the image in whitened observations, of all points and of these points.
    variance : float
        Variance of independent errors.
    """
    count, number = len(image), len(np.unique(groups))
    scene = Neighbours.of(image, residuals, np.concatenate([design, own_shift], axis=2))
    if scene is None:
        effective = float(len(shift) - count + number)
        return SharedErrors(points=count, groups=number, effective_points=effective, **NOT_KNOWN), None
    middle, likely = scene.middle(variance)
    # Of a shift alone the covariance is N^-1 (N + excess) N^-1.
    left = shift.reshape(-1, 2)
    inverse, more = np.linalg.inv(left.T @ left), positive_part(middle[-2:, -2:], left)
    usual = variance * float(np.trace(inverse))
    effective = len(shift) * usual / (usual + float(np.trace(inverse @ more @ inverse)))
    return SharedErrors(points=count, groups=number, effective_points=effective, **likely), middle[:-2, :-2]


def positive_part(excess: Array, design: Array) -> Array:
    """Return the positive part of a symmetric matrix in units of F' F, in the span of a design F ``(n, m)``."""
    _, singular, turn = np.linalg.svd(design, full_matrices=False)
    real = singular > _NO_EFFECT * singular[0]
    back, forth = turn[real].T / singular[real], singular[real][:, None] * turn[real]
    values, vectors = np.linalg.eigh(back.T @ excess @ back)
    half = forth.T @ vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(half @ half.T)


def _root(matrix: Array) -> Array:
    """Return a root R of a matrix R' R."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))).T)


@dataclass(frozen=True, eq=False)
class Neighbours:
    """Points that share errors, prepared for the restricted likelihood."""

    distance: Array  # (n, n) px
    ranges: Array  # px
    span: Array  # (n, p): an orthonormal basis of the design
    means: Array  # (m, n): means over cells, times the root of their number of points, so that noise is unchanged
    explained: Array  # (m, q): an orthonormal basis of the design in these means
    left: Array  # (m, 2): means of residuals along two axes, without the part that the design explains
    design: Array  # (p, 2, K): the complete design along the axes, in the basis
    weight: float  # number of points over sample size

    @classmethod
    def of(cls, image: Array, residuals: Array, design: Array) -> Neighbours | None:
        """Prepare points ``(n, 2)`` with whitened residuals and design ``(n, 2, K)``; None with too few points."""
        total = len(image)
        order = np.lexsort(image.T)
        if total > MOST_POINTS:
            order = np.sort(np.random.default_rng(0).permutation(total)[:MOST_POINTS])
            order = np.lexsort(image.T)[order]
        image, residuals, design = image[order], residuals[order], design[order]
        extent = float(np.ptp(image, axis=0).max())
        columns = np.concatenate([design[:, 0], design[:, 1]], axis=1)
        span = basis_of(columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300))
        n, p = span.shape
        if n < FEWEST_POINTS or n - p < FEWEST_POINTS / 2 or not extent > 0:
            return None
        distance = np.hypot(image[:, None, 0] - image[:, 0], image[:, None, 1] - image[:, 1])
        # Clustered or coincident points do not determine ranges within a cluster.
        least = np.clip(np.median(np.partition(distance, 1, axis=1)[:, 1]), _HEAP * extent, extent / 2)
        ranges = np.geomspace(least, extent, _RANGES)
        means = _cell_means(image)
        explained = basis_of(means @ span)
        if len(means) - explained.shape[1] < FEWEST_POINTS / 2:
            means, explained = np.eye(n), span
        left = means @ residuals
        left = left - explained @ (explained.T @ left)
        # The axes with the largest difference of errors shared over the middle range.
        near = means @ FAMILIES[1](distance / ranges[_RANGES // 2]) @ means.T
        axes = np.linalg.eigh(left.T @ near @ left)[1].T[::-1]
        inside = np.einsum("np,nik->pik", span, np.einsum("ij,njk->nik", axes, design))
        return cls(distance, ranges, span, means, explained, left @ axes.T, inside, total / n)

    def middle(self, variance: float) -> tuple[Array, Any]:
        """Return the excess of A^T Sigma A ``(K, K)`` over independent errors of `variance`, and mean parameters."""
        freedom = self.explained.shape[0] - self.explained.shape[1]
        ratios = np.geomspace(1.0 / len(self.span), _LARGEST, _RATIOS)
        logs, scales, inner = [], [], []
        for family in FAMILIES:
            for distance in self.ranges:
                kernel = family(self.distance / distance)
                inner.append(self.span.T @ kernel @ self.span)
                seen = self.means @ kernel @ self.means.T
                half = seen @ self.explained
                # The design is removed on both sides: its directions have eigenvalue zero and no effect below.
                cross = (half - self.explained @ (self.explained.T @ half / 2)) @ self.explained.T
                values, vectors = np.linalg.eigh(seen - cross - cross.T)
                each = 1.0 + ratios[:, None] * np.maximum(values, 0.0)
                squares = ((vectors.T @ self.left) ** 2).T @ (1.0 / each).T  # (axes, ratios)
                logs.append(-0.5 * (np.log(each).sum(axis=1) + freedom * np.log(squares)))
                scales.append(squares / (freedom - 2))
        log, scale = np.array(logs), np.array(scales)  # (kernels, axes, ratios)
        # A uniform prior of the part that residuals show, expressed for its logarithm.
        log = log - np.log(np.maximum(scale * (1.0 + ratios) / variance, 1.0))
        chance = np.exp(log - log.max(axis=(0, 2), keepdims=True))
        chance /= chance.sum(axis=(0, 2), keepdims=True)
        noise = (chance * scale).sum(axis=(0, 2))
        shared = (chance * scale * ratios).sum(axis=2)  # (kernels, axes)
        size = self.design.shape[2]
        excess = np.zeros((size, size))
        for axis in range(2):
            rows = self.design[:, axis]
            between = np.einsum("k,kij->ij", shared[:, axis], np.array(inner) - np.eye(len(rows)))
            own = noise[axis] + shared[:, axis].sum() - variance
            excess += self.weight * own * rows.T @ rows + self.weight**2 * rows.T @ between @ rows
        share = shared / np.maximum(shared.sum(axis=0), 1e-300)
        mean = np.exp(share.T @ np.log(np.tile(self.ranges, len(FAMILIES))))
        return excess, {"noise": np.sqrt(noise), "shared": np.sqrt(shared.sum(axis=0)), "range_px": mean}


def _cell_means(image: Array) -> Array:
    """Return the matrix ``(m, n)`` with orthonormal rows that averages points ``(n, 2)`` over square cells."""
    extent = np.ptp(image, axis=0)
    side = max(float(np.sqrt(extent.prod() / _CELLS)), float(extent.max()) / _CELLS)
    counts = np.maximum(1, np.round(extent / side))
    place = np.minimum(np.floor((image - image.min(axis=0)) / np.maximum(extent, 1e-300) * counts), counts - 1)
    _, cell = np.unique(place, axis=0, return_inverse=True)
    means = np.zeros((int(cell.max()) + 1, len(image)))
    means[cell.ravel(), np.arange(len(image))] = 1.0
    return np.asarray(means / np.sqrt(means.sum(axis=1, keepdims=True)))
