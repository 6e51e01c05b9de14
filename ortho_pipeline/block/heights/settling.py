"""Heights of a DEM in a block, repeated until they are stable: planes under the points, shared errors, wrong heights.

A height that contradicts its tie is left out and the tie stays: on a roof or a tree both are right. It takes part again
if it agrees again. No height is used in a void, next to one, on water, or at a cliff within the uncertainty of the
point's place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem, Selection
from ortho_pipeline.block.equations.solver import EXACT, NEAR, Solved, attempt
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights.common_heights import CommonHeights, correlated
from ortho_pipeline.block.heights.source import DEFAULT_SIGMA, FREE_BIAS, DemHeights
from ortho_pipeline.block.heights.spots import NORMAL, SpotDifferences
from ortho_pipeline.block.heights.terrain import LocalTerrain
from ortho_pipeline.block.points import Index
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array

#: Planes are renewed so often at most. They are stable if few heights (a share) changed by more than a part of a sigma,
#: and hardly any (a share) were left out anew or take part again.
_ROUNDS, _STABLE, _FEW, _HARDLY_ANY = 20, 0.02, 0.02, 1e-3
#: Rounds after which the heights that are left out stay the same.
_SEARCHED = 5
#: The estimate of shared errors is stable if it changes by less than this, in standard deviations.
_SHARED_STABLE = 0.02
#: A height farther off than so many of its sigmas is left out; it takes part again if it is nearer than so many.
_WRONG, _RIGHT = 4.0, 3.0
#: A height is at a break if the DEM is more sigmas off its plane within the uncertainty of the place.
_BREAKS = 4.0
#: Breaks are looked for again if the DEM is read by more than this part of a sample farther off.
_MOVED = 0.25
#: A sigma is estimated from so many heights or more, each of at least this redundancy.
_ENOUGH, _REDUNDANT = 50, 0.2
#: Stated sigmas count as too small if residuals are larger by so many standard deviations of their mean square.
_SIGNIFICANT = 2.5
_REMEDY = Text("give control points or a better DEM, or ", Setting("points.dem_heights", "off"))


@dataclass(frozen=True, eq=False)
class Heights:
    """The heights of a DEM in a block.

    Parameters
    ----------
    source : DemHeights
    of : ndarray (N,) of bool
        Points that take the height of the DEM, if it has one there.
    images : ndarray (N,)
        The first image that shows each point.
    terrain : LocalTerrain
        The DEM under the points.
    stated : ndarray (N,) or None
        Stated sigmas of the heights, m upwards.
    sigma : float
        Sigma of all heights if none is stated.
    own : ndarray (N,)
        Variances of the errors that heights do not share, over their squared sigmas.
    common : CommonHeights
        The errors that they share.
    wrong, broken : ndarray (N,) of bool
        Left out: heights that contradict their ties, and heights at breaks of the DEM.
    estimated : bool
        Whether `sigma` was.
    scale : float
        How many times larger than stated their errors are, at least 1.
    spots : SpotDifferences, optional
        Known heights, observations of the shared errors.
    """

    source: DemHeights
    of: Mask
    images: Index
    terrain: LocalTerrain
    stated: Array | None
    sigma: float
    own: Array
    common: CommonHeights
    wrong: Mask
    broken: Mask
    estimated: bool = False
    scale: float = 1.0
    spots: SpotDifferences | None = None

    @classmethod
    def under(cls, source: DemHeights, problem: BlockProblem, local: Array) -> Heights:
        """Return the heights under points at `local` ``(N, 3)`` before the adjustment.

        Of ties, and of known ground without a height of its own.
        """
        count, of = len(local), problem.points.tie | (problem.placed & ~np.isfinite(problem.known[:, 2]))
        ground = problem.frame.geodetic(local)
        rows = np.flatnonzero(of & np.isfinite(ground).all(axis=1))
        stated = source.sigmas(ground[rows])
        sigmas = None if stated is None else np.full(count, np.nan)
        if stated is not None and sigmas is not None:
            sigmas[rows] = stated
        each = np.full(len(rows), DEFAULT_SIGMA) if stated is None else stated
        typical = float(np.sqrt(np.nanmean(each**2))) if np.isfinite(each).any() else DEFAULT_SIGMA
        spots = SpotDifferences.of(source, DEFAULT_SIGMA)
        bias = (typical if spots is None else FREE_BIAS) if source.bias is None else source.bias
        own = np.ones(count)
        own[rows] = source.sharing(ground[rows])
        loads = np.zeros((count, 3))
        loads[:, 0] = bias
        known = np.zeros((0, 3)) if spots is None else problem.frame.of_geodetic(spots.spots.ground)
        shared, left = np.zeros((len(rows) + len(known), 0)), None
        if source.correlation is not None and len(rows):
            shared, left = correlated(np.vstack([local[rows], known]), source.correlation)
            more = np.zeros((count, shared.shape[1]))
            more[rows], own[rows] = shared[: len(rows)] * np.nan_to_num(each)[:, None], left[: len(rows)]
            loads = np.hstack([loads, more])
        none = np.zeros(count, dtype=bool)
        common = CommonHeights.of(loads, bias, len(rows), problem.size)
        images = np.full(count, len(problem.models))
        np.minimum.at(images, problem.points.point, problem.points.image)
        each = np.full(count, DEFAULT_SIGMA) if sigmas is None else sigmas
        terrain = LocalTerrain.under(source, _places(problem, local), of, each, images)
        heights = cls(source, of, images, terrain, sigmas, DEFAULT_SIGMA, own, common, none, none)
        if spots is None:
            return heights
        left_there = None if left is None else left[len(rows) :]
        return replace(heights, spots=spots.with_loads(bias, source.shift_sigma, shared[len(rows) :], left_there))

    @property
    def sigmas(self) -> Array:
        """Sigmas ``(N,)`` of the heights, m upwards."""
        return np.full(len(self.of), self.sigma) if self.stated is None else self.scale * self.stated

    def applied(self, problem: BlockProblem) -> BlockProblem:
        """Return the problem with planes under its points."""
        return problem.with_heights(self._planes(problem, self.of & ~self.wrong & ~self.broken))

    def _planes(self, problem: BlockProblem, of: Mask) -> Planes:
        """Return the planes under points of a mask ``(N,)``."""
        return self.terrain.planes(problem, of, self.sigmas * np.sqrt(self.own), self.common.offset)

    def _under(self, problem: BlockProblem, local: Array) -> Heights:
        """Return them with the DEM under points at `local` ``(N, 3)``."""
        ground = _places(problem, local)
        return replace(
            self, terrain=LocalTerrain.under(self.source, ground, self.of, self.sigmas, self.images, self.terrain)
        )

    def settled(self, solved: Solved, selection: Selection, rounds: int = _ROUNDS) -> tuple[Solved, Heights]:
        """Return the solution with stable heights, from one near it, and these heights.

        After fewer `rounds` than they need, it is near that. With all rounds, no solution is `NotConverged`.
        """
        heights, tolerance = self, EXACT if rounds == _ROUNDS else NEAR
        for number in range(rounds):
            judged, state = heights._with_shared_errors(solved, number), solved.state
            if judged.common.value is heights.common.value:
                judged = judged._under(solved.problem, state.local)
            else:
                # Points and images follow the shared errors, so that the DEM is read where they will be.
                state = judged.common.followed(heights.common, solved)
                judged = judged._following(solved, state.local)
            judged = judged._judged(solved, state.local, number)
            problem = judged.applied(solved.problem)
            if _same_errors(judged, heights) and _stable(solved, problem):
                return solved, replace(judged, wrong=heights.wrong, broken=heights.broken)
            again = attempt(problem, state, selection, tolerance)
            if not again.converged or again.undetermined or again.condition > CONDITION_LIMIT:
                if rounds == _ROUNDS:
                    # The solution before does not contain what the heights share: its sigmas would be too small.
                    raise NotConverged("the adjustment did not converge with the heights of the DEM", remedy=_REMEDY)
                break
            solved, heights = again, judged
        return solved, heights

    def seen(self, solved: Solved) -> tuple[CommonHeights, Array]:
        """Return the errors that they share, with what a solution tells of them, and the slope ``(k,)``."""
        slopes = np.nan_to_num(self.terrain.slopes)
        common, slope = self.common.with_slopes(slopes, self.source.shift_sigma).moved_by(solved)
        return (common, slope) if self.spots is None else self.spots.told(common, self.sigma, slope)

    def _with_shared_errors(self, solved: Solved, number: int) -> Heights:
        """Return them with the errors that they share by a solution."""
        common, slope = self.seen(solved)
        step = common.step(slope)
        if np.abs(step).max() > _SHARED_STABLE:
            # The DEM is rougher than its planes, so whole steps of its shift would swing about the best without end.
            common = replace(common, value=common.value + (0.5 * step if number else step))
        return replace(self, common=common)

    def _judged(self, solved: Solved, local: Array, number: int) -> Heights:
        """Return them with sigma and wrong heights by a solution whose points follow the shared errors to `local`."""
        # Otherwise heights at the limit may be left out and return without end.
        settled = number > _SEARCHED
        spots = self.spots if self.spots is None or settled else self.spots.judged(self.common, self.sigma)
        judged = replace(self, spots=spots)
        residuals, variances, used = judged._residuals(solved, local)
        if self.stated is None:
            judged = judged._estimated(residuals, variances, used)
        elif number:
            judged = judged._scaled(residuals, variances, used)
        if settled:
            return judged
        sigmas = np.sqrt(np.maximum(variances, (0.2 * judged.sigmas) ** 2))
        with np.errstate(invalid="ignore"):
            wrong = np.abs(residuals) > np.where(self.wrong, _RIGHT, _WRONG) * sigmas
        broken = judged.broken if number else _breaking(judged, solved)
        return replace(judged, wrong=np.asarray(judged.of & wrong), broken=broken)

    def _following(self, solved: Solved, local: Array) -> Heights:
        """Return them with the DEM under points at `local` ``(N, 3)``, read where the estimate of its shift puts it."""
        undone = self.common.undone.copy()
        undone[1:3] = self.common.value[1:3]
        east, north = (undone[1:3] * self.source.shift_sigma).tolist()
        source = replace(self.source, read_at=(east, north))
        spots = None if self.spots is None else self.spots.read_again(source, self.sigma)
        # Slopes stay that were read at about the same place of the DEM.
        moved = np.subtract(self.source.read_at, source.read_at)
        read = self.terrain.read + moved / metres_per_degree(np.nan_to_num(self.terrain.ground))
        common, terrain = replace(self.common, undone=undone), replace(self.terrain, read=read)
        heights = replace(self, source=source, common=common, terrain=terrain, spots=spots)
        heights = heights._under(solved.problem, local)
        far = np.abs(moved).max() > _MOVED * self.source.surface.sample_size
        return replace(heights, broken=_breaking(heights, solved)) if far else heights

    def _residuals(self, solved: Solved, local: Array) -> tuple[Array, Array, Mask]:
        """Return how far heights are above points at `local` ``(N,)`` m, the variances of that, and which take part.

        The residual of a height that takes part varies less than the height, that of another one more.
        """
        problem = solved.problem
        planes = self._planes(problem, self.of)
        rows = np.zeros(len(local), dtype=bool)
        rows[solved.linear.ordering.numbers] = True
        used = rows & self.of & planes.on
        assert problem.heights is not None
        taking = used & problem.heights.on
        # All along the normal; `upright` is its share of the vertical.
        normal = planes.axes[:, 2]
        of_points = np.einsum("nc,ncd,nd->n", normal, solved.points.ground(solved.cofactors, 1.0), normal)
        upright = np.where(planes.on, planes.sigmas / (self.sigmas * np.sqrt(self.own)), 1.0)
        weighed, single = planes.sigmas**2, (upright * self.sigmas) ** 2
        # A height that shares samples with others weighs less than by its own variance.
        shared = np.maximum(weighed - single, 0.0)
        weighed = np.maximum(weighed, single)
        with np.errstate(invalid="ignore"):
            left = weighed - of_points - shared * (1.0 - of_points / weighed) ** 2
            variances = np.where(taking, left, weighed - shared + of_points) / upright**2
            residuals = planes.above(local) / upright
        return np.where(used, residuals, 0.0), np.where(used, variances, np.inf), taking

    def _estimated(self, residuals: Array, variances: Array, used: Mask) -> Heights:
        """Return them with a robust sigma of the residuals; unchanged if too few have enough redundancy."""
        # Correlated errors are in the shared ones, so the residuals do not show them.
        if self.source.correlation is not None:
            return self
        scaled = _told(residuals[used], variances[used] / self.sigma**2)
        if self.spots is not None:
            scaled = np.concatenate([scaled, self.sigma * self.spots.standardised(self.common, self.sigma)])
        if len(scaled) < _ENOUGH:
            return self
        sigma = NORMAL * float(np.median(scaled))
        if self.estimated:
            # Points and images follow the sigma rounds later: all of the way would swing about it without end.
            sigma = math.sqrt(sigma * self.sigma)
        same = abs(sigma / self.sigma - 1.0) < 2 * _STABLE
        return self if same else replace(self, sigma=max(sigma, 0.01), estimated=True)

    def _scaled(self, residuals: Array, variances: Array, used: Mask) -> Heights:
        """Return them with larger sigmas where the residuals are significantly larger than stated ones allow.

        Roofs and trees that are too low to be left out one by one do this.
        """
        used = used & (variances > _REDUNDANT**2 * self.sigmas**2)
        if used.sum() < _ENOUGH:
            return self
        square, chance = float(np.mean(residuals[used] ** 2 / variances[used])), math.sqrt(2.0 / used.sum())
        if self.scale == 1.0 and square < 1.0 + _SIGNIFICANT * chance:
            return self
        # Residuals of little redundancy show little of the errors.
        shown = float(np.mean(np.minimum(variances[used] / self.sigmas[used] ** 2, 1.0)))
        scale = max(self.scale * math.sqrt(min(max(1.0 + (square - 1.0) / shown, 0.25), 4.0)), 1.0)
        if abs(scale / self.scale - 1.0) < 2 * _STABLE:
            return self
        return replace(self, scale=scale, spots=None if self.spots is None else replace(self.spots, scale=scale))

    @property
    def sigma_is(self) -> Literal["stated", "enlarged", "estimated", "assumed"]:
        """The source of the sigmas."""
        if self.stated is not None:
            return "enlarged" if self.scale > 1.0 else "stated"
        return "estimated" if self.estimated else "assumed"


def _told(residuals: Array, redundancy: Array) -> Array:
    """Return residuals ``(n,)`` of enough redundancy, over its root; none if most ties are less exact than the DEM.

    The few best ties would make its sigma ever smaller.
    """
    testable = redundancy > _REDUNDANT
    if 2 * np.count_nonzero(testable) < len(testable):
        return np.zeros(0)
    return np.asarray(np.abs(residuals[testable]) / np.sqrt(redundancy[testable]))


def _breaking(heights: Heights, solved: Solved) -> Mask:
    """Return where the DEM is no plane ``(N,)`` within the uncertainty of the points' places."""
    covariance = solved.ground_covariance(solved.cofactors, 1.0)
    plan = np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))
    rows = np.flatnonzero(heights.of & np.isfinite(plan))
    ground, slopes, found = heights.terrain.ground, np.nan_to_num(heights.terrain.slopes), heights.broken.copy()
    # The uncertainty is larger while the images are still displaced.
    far = heights.source.breaks(ground[rows], slopes[rows], np.minimum(plan[rows], heights.source.surface.sample_size))
    with np.errstate(invalid="ignore"):
        found[rows] = far > _BREAKS * heights.sigmas[rows]
    return found


def _same_errors(one: Heights, other: Heights) -> bool:
    """Tell whether the sigmas and shared errors of heights are those of others."""
    same = (one.sigma, one.scale) == (other.sigma, other.scale)
    return same and np.array_equal(one.common.value, other.common.value)


def _stable(solved: Solved, problem: BlockProblem) -> bool:
    """Tell whether a problem has the heights of a solution."""
    planes, old, local = problem.heights, solved.problem.heights, solved.state.local
    assert planes is not None
    assert old is not None
    off, count = np.abs(planes.above(local) - old.above(local)) / planes.sigmas, planes.on.sum()
    return bool((planes.on != old.on).sum() <= _HARDLY_ANY * count and (off > _STABLE)[planes.on].sum() <= _FEW * count)


def _places(problem: BlockProblem, local: Array) -> Array:
    """Return lon, lat, h ``(N, 3)`` where heights of points at `local` ``(N, 3)`` are read."""
    return np.where(problem.placed[:, None], problem.known, problem.frame.geodetic(local))
