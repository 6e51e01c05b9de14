"""Heights of a DEM in a block, repeated until they are stable: planes under the points, shared errors, wrong heights.

A height that contradicts its tie is left out and the tie stays: on a roof or a tree both are right. It takes part again
if it agrees again. No height is used in a void, beside one, or at a cliff within the uncertainty of the point's place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem, Selection
from ortho_pipeline.block.equations.solver import EXACT, Solved, attempt
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights.common_heights import CommonHeights, correlated
from ortho_pipeline.block.heights.source import DEFAULT_SIGMA, DemHeights
from ortho_pipeline.block.heights.spots import SpotDifferences
from ortho_pipeline.block.heights.terrain import Terrain
from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array

#: Planes are renewed so often at most. They are stable if few heights (a share) changed by more than a part of a sigma.
_ROUNDS, _STABLE, _FEW = 10, 0.02, 0.02
#: The estimate of shared errors is stable if it changes by less than this, in standard deviations.
_SHARED_STABLE = 0.02
#: A height farther off than so many of its sigmas is left out.
_WRONG = 4.0
#: A height is at a break if the DEM is more sigmas off its plane within the uncertainty of the place.
_BREAKS = 4.0
#: A sigma is estimated from so many heights or more, each of at least this redundancy.
_ENOUGH, _REDUNDANT = 50, 0.2
#: Standard deviation (m) of a bias that spot heights tell.
_FREE = 100.0
#: The sigma of a normal distribution over its median absolute value.
_NORMAL = 1.4826


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
    terrain : Terrain
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
    spots : SpotDifferences, optional
        Known heights, which tell of the shared errors.
    """

    source: DemHeights
    of: Mask
    images: Index
    terrain: Terrain
    stated: Array | None
    sigma: float
    own: Array
    common: CommonHeights
    wrong: Mask
    broken: Mask
    estimated: bool = False
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
        bias = (typical if spots is None else _FREE) if source.bias is None else source.bias
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
        terrain = Terrain.under(source, _places(problem, local), of, each, images)
        found = cls(source, of, images, terrain, sigmas, DEFAULT_SIGMA, own, common, none, none)
        if spots is None:
            return found
        left_there = None if left is None else left[len(rows) :]
        return replace(found, spots=spots.with_loads(bias, found.shift, shared[len(rows) :], left_there))

    @property
    def shift(self) -> float:
        """Standard deviation (m) of the position of the DEM, east and north."""
        stated = self.source.shift
        return self.source.surface.sample_size / 2.0 if stated is None else stated

    @property
    def sigmas(self) -> Array:
        """Sigmas ``(N,)`` of the heights, m upwards."""
        return np.full(len(self.of), self.sigma) if self.stated is None else self.stated

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
            self, terrain=Terrain.under(self.source, ground, self.of, self.sigmas, self.images, self.terrain)
        )

    def settled(self, solved: Solved, selection: Selection, tolerance: float = EXACT) -> tuple[Solved, Heights]:
        """Return the solution with stable heights, from one near it, and these heights."""
        found = self
        for number in range(_ROUNDS):
            judged, state = found._under(solved.problem, solved.state.local)._judged(solved, number), solved.state
            if judged.common.value is not found.common.value:
                # Points and images follow the shared errors, so that the DEM is read where they will be.
                state = judged.common.followed(found.common, solved)
                judged = judged._following()._under(solved.problem, state.local)
            problem = judged.applied(solved.problem)
            planes, before = problem.heights, solved.problem.heights
            assert planes is not None
            assert before is not None
            off = np.abs(planes.above(solved.state.local) - before.above(solved.state.local)) / planes.sigmas
            same = bool((planes.on == before.on).all()) and judged.sigma == found.sigma
            same &= np.array_equal(judged.common.value, found.common.value)
            if same and (off > _STABLE)[planes.on].sum() <= _FEW * planes.on.sum():
                return solved, judged
            again = attempt(problem, state, selection, tolerance)
            if not again.converged or again.undetermined or again.condition > CONDITION_LIMIT:
                return solved, found
            solved, found = again, judged
        return solved, found

    def _judged(self, solved: Solved, number: int) -> Heights:
        """Return them with sigma, shared errors and wrong heights by a solution."""
        slopes = np.nan_to_num(self.terrain.slopes)
        common, slope = self.common.with_slopes(slopes, self.shift).moved_by(solved)
        if self.spots is not None:
            common, slope = self.spots.told(common, self.sigma, slope)
        step = common.step(slope)
        if np.abs(step).max() > _SHARED_STABLE:
            common = replace(common, value=common.value + step)
        spots = self.spots
        if spots is not None and number <= _ROUNDS // 2:
            spots = spots.judged(common, self.sigma)
        found = replace(self, common=common, spots=spots)
        apart, spread, used = found._apart(solved)
        if self.stated is None:
            found = found._estimated(apart, spread, used)
        if number > _ROUNDS // 2:
            # Otherwise heights at the limit may be left out and return without end.
            return found
        sigma = np.sqrt(np.maximum(spread, (0.2 * found.sigmas) ** 2))
        with np.errstate(invalid="ignore"):
            wrong = np.abs(apart) > _WRONG * sigma
        return replace(found, wrong=np.asarray(found.of & wrong), broken=found._breaking(solved))

    def _following(self) -> Heights:
        """Return them with the DEM read where the estimate of its shift puts it."""
        undone = self.common.undone.copy()
        undone[1:3] = self.common.value[1:3]
        east, north = (undone[1:3] * self.shift).tolist()
        source = replace(self.source, read_at=(east, north))
        spots = None if self.spots is None else self.spots.read_again(source, self.sigma, self.shift)
        # Slopes stay that were read at about the same place of the DEM.
        moved = np.subtract(self.source.read_at, source.read_at) / metres_per_degree(np.nan_to_num(self.terrain.ground))
        terrain = replace(self.terrain, read=self.terrain.read + moved)
        return replace(self, source=source, common=replace(self.common, undone=undone), terrain=terrain, spots=spots)

    def _apart(self, solved: Solved) -> tuple[Array, Array, Mask]:
        """Return how far heights are above their points ``(N,)`` m, the variances of that, and which take part.

        Of one that takes part the residual varies less than the height, of one that does not more.
        """
        problem, local = solved.problem, solved.state.local
        planes = self._planes(problem, self.of)
        rows = np.zeros(len(local), dtype=bool)
        rows[solved.linear.ordering.numbers] = True
        used = rows & self.of & planes.on
        assert problem.heights is not None
        taking = used & problem.heights.on
        # Along the normal; over its share of the vertical both are upwards.
        covariance = solved.points.ground(solved.cofactors, 1.0)
        normal = planes.axes[:, 2]
        told = np.einsum("nc,ncd,nd->n", normal, covariance, normal)
        upright = np.where(planes.on, planes.sigmas / (self.sigmas * np.sqrt(self.own)), 1.0)
        whole = np.maximum(planes.sigmas**2, (upright * self.sigmas) ** 2)
        # What neighbours share makes them weigh less, and none of them err more.
        shared = (upright * self.sigmas) ** 2 * np.maximum(self.own - 1.0, 0.0)
        spread = np.where(taking, whole - told, whole + told) - shared
        apart = planes.above(local)
        with np.errstate(invalid="ignore"):
            return np.where(used, apart / upright, 0.0), np.where(used, spread / upright**2, np.inf), taking

    def _estimated(self, apart: Array, spread: Array, used: Mask) -> Heights:
        """Return them with a robust sigma of the residuals; unchanged if too few have enough redundancy."""
        redundancy = spread / self.sigma**2
        testable = used & (redundancy > _REDUNDANT)
        alike = np.abs(apart[testable]) / np.sqrt(redundancy[testable])
        if self.spots is not None:
            known = self.spots.used
            left = np.abs(self.spots.residuals(self.common)) / np.sqrt(self.spots.variances(self.sigma, shared=False))
            alike = np.concatenate([alike, left[known] * self.sigma])
        if len(alike) < _ENOUGH:
            return self
        sigma = _NORMAL * float(np.median(alike))
        same = abs(sigma / self.sigma - 1.0) < 2 * _STABLE
        return self if same else replace(self, sigma=max(sigma, 0.01), estimated=True)

    def _breaking(self, solved: Solved) -> Mask:
        """Return where the DEM is no plane ``(N,)`` within the uncertainty of the points' places."""
        covariance = solved.ground_covariance(solved.cofactors, 1.0)
        plan = np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))
        rows = np.flatnonzero(self.of & np.isfinite(plan))
        ground, slopes, found = self.terrain.ground, np.nan_to_num(self.terrain.slopes), self.broken.copy()
        # The uncertainty is larger while the images are still displaced.
        far = self.source.breaks(ground[rows], slopes[rows], np.minimum(plan[rows], self.source.surface.sample_size))
        with np.errstate(invalid="ignore"):
            found[rows] = far > _BREAKS * self.sigmas[rows]
        return found


def _places(problem: BlockProblem, local: Array) -> Array:
    """Return lon, lat, h ``(N, 3)`` where heights of points at `local` ``(N, 3)`` are read."""
    return np.where(problem.placed[:, None], problem.known, problem.frame.geodetic(local))
