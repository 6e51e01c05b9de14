r"""Errors that heights of a DEM share, as unknowns of a block: its bias, its shift, and errors correlated by distance.

Heights err by :math:`L c + e`, with :math:`c \sim N(0, I)`, loads :math:`L` in metres and an own error :math:`e` of
each. One column of :math:`L` is the bias, two are the slopes, by which a shift of the DEM is seen. The others are the
leading modes of the covariance :math:`\sigma^2 e^{-d / \lambda}`; the rest is in the own errors. So a thousand ties
do not average out the bias. The unknowns are solved for next to the block as in `block.common_error`. Only heights
depend on them, so they need no further elimination.

Source: Nuth and Kääb 2011 (shifts of DEMs by slope and aspect); Koch 1999, section 3.2 (elimination of unknowns);
Williams and Seeger 2001 (leading modes of many points).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import State
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.observations.common_unknown import CommonGroundError
from ortho_pipeline.models.base import Array

#: Modes are of the covariance of so many points at most, and are so many at most, of a block of `_MANY` points fewer.
_ANCHORS, _MODES, _MANY = 800, 120, 5_000
#: Less information on a shift, over that of its own standard deviation, is none.
_TOLD = 1e-6
#: The share of the variance in all modes that are kept.
_HELD = 0.99


@dataclass(frozen=True, eq=False, kw_only=True)
class CommonHeights(CommonGroundError):
    """Errors that heights share, and what a block tells of them.

    Parameters
    ----------
    loads : ndarray (N, k)
        What one standard deviation of each unknown is at each height, m; first of the bias, then of the DEM's shift to
        the east and to the north.
    by_params, by_points : ndarray (P, k), (N, 3, k)
        How one standard deviation moves parameters, and points in their east, north, up.
    undone : ndarray (k,)
        The part of the estimate by which the DEM is already read elsewhere, in standard deviations.
    """

    loads: Array
    by_params: Array
    by_points: Array
    undone: Array

    @classmethod
    def of(cls, loads: Array, bias: float, points: int, parameters: int) -> CommonHeights:
        """Return them before the adjustment."""
        count, modes = loads.shape
        return cls(
            sigma=bias,
            points=points,
            value=np.zeros(modes),
            told=np.zeros((modes, modes)),
            loads=loads,
            by_params=np.zeros((parameters, modes)),
            by_points=np.zeros((count, 3, modes)),
            undone=np.zeros(modes),
        )

    @property
    def offset(self) -> Array:
        """The estimate ``(N,)`` of how much too high the heights are as they were read, m."""
        return np.asarray(self.loads @ (self.value - self.undone))

    @property
    def bias(self) -> tuple[float, float]:
        """The estimate of the bias and its sigma, m."""
        return float(self.value[0] * self.sigma), float(np.sqrt(self.left[0, 0]) * self.sigma)

    def with_slopes(self, slopes: Array, shift: float) -> CommonHeights:
        """Return them with other slopes ``(N, 2)``; `shift` is the standard deviation of the DEM's position, m."""
        loads = self.loads.copy()
        # A DEM shifted to the east is too low where it rises to the east.
        loads[:, 1:3] = -shift * slopes
        return replace(self, loads=loads)

    def shift(self, shift: float) -> tuple[Array, Array]:
        """Return the estimate ``(2,)`` of the DEM's shift to the east and north, m, and its covariance, m²."""
        return self.value[1:3] * shift, self.left[1:3, 1:3] * shift**2

    @property
    def chance(self) -> float | None:
        """Probability of a shift as large as this without a shift; None if the block has no information on it."""
        from scipy.special import chdtrc

        # The information of the block alone, without the prior.
        precision = np.linalg.inv(self.left[1:3, 1:3])
        told = precision - np.eye(2)
        if np.linalg.eigvalsh(told)[0] < _TOLD:
            return None
        alone = np.linalg.solve(told, precision @ self.value[1:3])
        return float(chdtrc(2, alone @ told @ alone))

    @property
    def chance_of_correlated(self) -> float:
        """Probability of correlated errors as large as the estimates, if their stated sigma is right.

        The estimates have the covariance K = I - `left` then; their sum of squares has the mean tr K and the variance
        2 |K|². The chi-squared distribution with these is that of Satterthwaite 1946.
        """
        from scipy.special import chdtrc

        gain = (np.eye(len(self.value)) - self.left)[3:, 3:]
        mean, square = float(np.trace(gain)), float((gain**2).sum())
        if mean < _TOLD:
            return 1.0
        return float(chdtrc(mean**2 / square, (self.value[3:] ** 2).sum() * mean / square))

    @property
    def of_points(self) -> Array:
        """Its part ``(N, 3, 3)`` of the covariance of the ground, m²."""
        return np.asarray(self.by_points @ self.left @ self.by_points.swapaxes(1, 2))

    def units(self, linear: Linear) -> tuple[Index, Array]:
        """Return the points ``(n,)`` with a height, and what one standard deviation takes off its misfit ``(n, k)``."""
        heights, grounded = linear.problem.heights, linear.ordering.grounded
        assert heights is not None
        rows = grounded[heights.on[grounded]]
        weights = np.sqrt(linear.weights.ground_weights[rows]) / self._sigmas(linear, rows)
        return rows, self.loads[rows] * weights[:, None]

    def moved_by(self, solved: Solved) -> tuple[CommonHeights, Array]:
        """Return them with what a solution tells of them, and the slope of half the sum of squares ``(k,)``."""
        linear, problem, ordering = solved.linear, solved.problem, solved.linear.ordering
        rows, of_heights = self.units(linear)
        place = np.full(len(problem.points), -1)
        place[ordering.numbers] = np.arange(ordering.points)
        units, by_height = np.zeros((ordering.points, len(self.value))), np.zeros((ordering.points, 3))
        units[place[rows]] = of_heights
        by_height[place[rows]] = linear.ground_by_point[rows, 2]
        inverse = np.linalg.inv(_normals(linear))
        met = (inverse @ by_height[:, :, None])[:, :, 0]
        of, right = place[problem.points.point], np.zeros((problem.size, len(self.value)))
        for image, rays in enumerate(ordering.rays_of_image):
            columns = problem.columns.of_image(image)
            along = np.einsum("kic,kc->ki", linear.by_point[rays], met[of[rays]])
            seen = np.einsum("kip,ki->kp", linear.by_params[rays][:, :, : len(columns)], along)
            right[columns] -= seen.T @ units[of[rays]]
        step = solved.cofactors.times(right)
        taken = by_height[:, :, None] * units[:, None, :]
        for image, rays in enumerate(ordering.rays_of_image):
            columns = problem.columns.of_image(image)
            by_point = linear.by_point[rays].swapaxes(1, 2) @ linear.by_params[rays][:, :, : len(columns)]
            # An image has at most one ray of a point.
            taken[of[rays]] -= by_point @ step[columns]
        shift = inverse @ taken
        left = units - np.einsum("nc,nck->nk", by_height, shift)
        by_points = np.zeros_like(self.by_points)
        enu = problem.frame.enu_at(problem.frame.geodetic(linear.state.local[ordering.numbers]))
        by_points[ordering.numbers] = -(enu @ shift)
        told = units.T @ left
        found = replace(self, points=len(rows), told=(told + told.T) / 2, by_params=-step, by_points=by_points)
        return found, units[place[rows]].T @ linear.misfits.ground[rows, 2]

    def followed(self, before: CommonHeights, solved: Solved) -> State:
        """Return the state of a solution after these errors changed from `before`: moved parameters and points."""
        step, frame = self.value - before.value, solved.problem.frame
        enu = frame.enu_at(frame.geodetic(solved.state.local))
        points = np.einsum("nji,nj->ni", enu, self.by_points @ step)
        return solved.state.moved(self.by_params @ step, np.nan_to_num(points))

    def _sigmas(self, linear: Linear, rows: Index) -> Array:
        """Return the sigmas ``(n,)`` of heights upwards, not along the normals of their planes."""
        found = linear.problem.on_points(linear.state.local, rows)
        up = linear.problem.frame.enu_at(linear.problem.frame.geodetic(linear.state.local[rows]))[:, 2]
        return np.asarray(found.sigmas[:, 2] / (found.axes[:, 2] * up).sum(axis=1))


def _normals(linear: Linear) -> Array:
    """Return the normal matrices ``(n, 3, 3)`` of the points that take part, the parameters being given."""
    ordering = linear.ordering
    rows = linear.by_point[ordering.rays]
    found = np.add.reduceat(rows.swapaxes(1, 2) @ rows, ordering.starts[:-1], axis=0)
    ground = linear.ground_by_point[ordering.numbers]
    return np.asarray(found + ground.swapaxes(1, 2) @ ground)


def correlated(places: Array, length: float) -> tuple[Array, Array]:
    """Return the loads ``(n, k)`` of errors of sigma 1 correlated over a length (m), and the variances ``(n,)`` left.

    Parameters
    ----------
    places : ndarray (n, 3)
        In metres.
    """
    count = len(places)
    chosen = np.random.default_rng(0).permutation(count)[:_ANCHORS]
    most = min(_MODES, len(chosen), max(_MODES * _MANY // max(count, 1), 1))
    values, vectors = np.linalg.eigh(_correlation(places[chosen], places[chosen], length))
    values, vectors = values[::-1], vectors[:, ::-1]
    held = np.cumsum(values) / values.sum()
    most = min(most, int(np.searchsorted(held, _HELD)) + 1)
    modes = vectors[:, :most] / np.sqrt(values[:most])
    loads, density = np.zeros((count, most)), count / len(chosen)
    for part in np.array_split(np.arange(count), max(1, count // 2_000)):
        loads[part] = _correlation(places[part], places[chosen], length) @ modes
    own = np.maximum(1.0 - (loads**2).sum(axis=1), 1.0 - _HELD)
    if held[most - 1] < _HELD:
        # The rest is still correlated between neighbours, which together have the information of few.
        left = _correlation(places[chosen], places[chosen], length) - loads[chosen] @ loads[chosen].T
        own *= max(1.0, density * float(np.maximum(left, 0.0).sum() / np.trace(left)))
    return loads, own


def _correlation(one: Array, other: Array, length: float) -> Array:
    from scipy.spatial.distance import cdist

    return np.asarray(np.exp(-cdist(one, other) / length))
