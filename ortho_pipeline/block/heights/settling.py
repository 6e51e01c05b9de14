"""Heights of a DEM in a block until they stand: planes where the points are, what heights share, and wrong ones.

A height that contradicts its tie is left out and the tie stays: on a roof or a tree both are right. It returns where it
agrees again. Heights take no part in voids, beside them, and where the DEM breaks off within what is not known of the
point's place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem, Selection
from ortho_pipeline.block.equations.solver import EXACT, Solved, attempt
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights.common_heights import CommonHeights, alike
from ortho_pipeline.block.heights.source import USUAL, DemHeights, planes_at
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models.base import Array
from ortho_pipeline.options.texts import Setting, Text, counted

#: Planes are laid anew so many times at most; they stand when few heights are farther off than this part of a sigma.
_ROUNDS, _STANDS, _FEW = 10, 0.02, 0.02
#: An estimate of what heights share that moves by less than this (standard deviations) stands.
_SHARED_STANDS = 0.02
#: A height farther off than so many of its sigmas is left out.
_WRONG = 4.0
#: A plane of which the DEM is farther off than so many sigmas, within what is not known of the place, is none.
_BREAKS = 4.0
#: A sigma is estimated from so many heights or more, of which the rays tell this part or more.
_ENOUGH, _TOLD = 50, 0.2
#: The sigma of a normal distribution over its median absolute value.
_NORMAL = 1.4826


@dataclass(frozen=True, eq=False)
class Heights:
    """The heights of a DEM in a block.

    Parameters
    ----------
    source : DemHeights
    of : ndarray (N,) of bool
        Points whose height the DEM says, if it has one there.
    stated : ndarray (N,) or None
        Sigmas of the heights where somebody says them, m upwards.
    sigma : float
        Of those of which nobody says it.
    own : ndarray (N,)
        Variances of what heights do not share, over their squared sigmas.
    common : CommonHeights
        What they share.
    wrong, broken : ndarray (N,) of bool
        Left out: heights that contradict their ties, and where the DEM breaks off.
    estimated : bool
        Whether `sigma` was.
    """

    source: DemHeights
    of: Mask
    stated: Array | None
    sigma: float
    own: Array
    common: CommonHeights
    wrong: Mask
    broken: Mask
    estimated: bool = False

    @classmethod
    def under(cls, source: DemHeights, problem: BlockProblem, local: Array) -> Heights:
        """Return the heights under points at `local` ``(N, 3)``, before anything tells of them.

        Of ties, and of known ground without a height of its own.
        """
        count, of = len(local), problem.points.tie | (problem.placed & ~np.isfinite(problem.known[:, 2]))
        ground = problem.frame.geodetic(local)
        rows = np.flatnonzero(of & np.isfinite(ground).all(axis=1))
        stated = source.sigmas(ground[rows])
        sigmas = None if stated is None else np.full(count, np.nan)
        if stated is not None and sigmas is not None:
            sigmas[rows] = stated
        each = np.full(len(rows), USUAL) if stated is None else stated
        typical = float(np.sqrt(np.nanmean(each**2))) if np.isfinite(each).any() else USUAL
        bias = typical if source.bias is None else source.bias
        own = np.ones(count)
        own[rows] = source.cells(ground[rows])
        loads = np.zeros((count, 3))
        loads[:, 0] = bias
        if source.correlation is not None and len(rows):
            shared, left = alike(local[rows], np.ones(len(rows)), source.correlation)
            more = np.zeros((count, shared.shape[1]))
            more[rows], own[rows] = shared * np.nan_to_num(each)[:, None], left
            loads = np.hstack([loads, more])
        none = np.zeros(count, dtype=bool)
        common = CommonHeights.of(loads, bias, len(rows), problem.size)
        return cls(source, of, sigmas, USUAL, own, common, none, none)

    @property
    def shift(self) -> float:
        """Standard deviation (m) of where the DEM lies, east and north."""
        stated = self.source.shift
        return self.source.surface.sample_size / 2.0 if stated is None else stated

    @property
    def sigmas(self) -> Array:
        """Sigmas ``(N,)`` of the heights, m upwards."""
        return np.full(len(self.of), self.sigma) if self.stated is None else self.stated

    def applied(self, problem: BlockProblem, local: Array) -> BlockProblem:
        """Return the problem with planes under points at `local` ``(N, 3)``."""
        return problem.with_heights(self._planes(problem, local, self.of & ~self.wrong & ~self.broken)[0])

    def _planes(self, problem: BlockProblem, local: Array, of: Mask) -> tuple[Planes, Array]:
        """Return the planes under points of a mask ``(N,)``, and their slopes ``(N, 2)``."""
        return planes_at(self.source, problem, local, of, self.sigmas * np.sqrt(self.own), self.common.offset)

    def settled(self, solved: Solved, selection: Selection, tolerance: float = EXACT) -> tuple[Solved, Heights]:
        """Return the solution in which they stand, from one near it, and them."""
        found = self
        for number in range(_ROUNDS):
            judged = found._judged(solved, number)
            problem = judged.applied(solved.problem, solved.state.local)
            planes, before = problem.heights, solved.problem.heights
            assert planes is not None
            assert before is not None
            off = np.abs(planes.above(solved.state.local) - before.above(solved.state.local)) / planes.sigmas
            same = bool((planes.on == before.on).all()) and judged.sigma == found.sigma
            same &= np.array_equal(judged.common.value, found.common.value)
            if same and (off > _STANDS)[planes.on].sum() <= _FEW * planes.on.sum():
                return solved, judged
            again = attempt(problem, solved.state, selection, tolerance)
            if not again.converged or again.undetermined or again.condition > CONDITION_LIMIT:
                return solved, found
            solved, found = again, judged
        return solved, found

    def _judged(self, solved: Solved, number: int) -> Heights:
        """Return them with what a solution says of their sigma, of what they share, and which are wrong."""
        _, slopes = self._planes(solved.problem, solved.state.local, self.of)
        common, slope = self.common.with_slopes(slopes, self.shift).moved_by(solved)
        step = common.step(slope)
        if np.abs(step).max() > _SHARED_STANDS:
            common = replace(common, value=common.value + step)
        found = replace(self, common=common)
        apart, spread, used = found._apart(solved)
        if self.stated is None:
            found = found._estimated(apart, spread, used)
        if number > _ROUNDS // 2:
            # Heights at the limit would come and go for ever.
            return found
        sigma = np.sqrt(np.maximum(spread, (0.2 * found.sigmas) ** 2))
        with np.errstate(invalid="ignore"):
            wrong = np.abs(apart) > _WRONG * sigma
        return replace(found, wrong=np.asarray(found.of & wrong), broken=found._breaking(solved))

    def _apart(self, solved: Solved) -> tuple[Array, Array, Mask]:
        """Return how far heights are above their points ``(N,)`` m, the variances of that, and which take part.

        Of one that takes part the residual varies less than the height, of one that does not more.
        """
        problem, local = solved.problem, solved.state.local
        planes, _ = self._planes(problem, local, self.of)
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
        spread = np.where(taking, whole - told, whole + told)
        apart = planes.above(local)
        with np.errstate(invalid="ignore"):
            return np.where(used, apart / upright, 0.0), np.where(used, spread / upright**2, np.inf), taking

    def _estimated(self, apart: Array, spread: Array, used: Mask) -> Heights:
        """Return them with the sigma that residuals have, robustly; as they are where the rays tell too little."""
        told = spread / self.sigma**2
        of = used & (told > _TOLD)
        if of.sum() < _ENOUGH:
            return self
        sigma = _NORMAL * float(np.median(np.abs(apart[of]) / np.sqrt(told[of])))
        same = abs(sigma / self.sigma - 1.0) < 2 * _STANDS
        return self if same else replace(self, sigma=max(sigma, 0.01), estimated=True)

    def _breaking(self, solved: Solved) -> Mask:
        """Return where the DEM is no plane ``(N,)`` within what is not known of the points' places."""
        problem, local = solved.problem, solved.state.local
        _, slopes = self._planes(problem, local, self.of)
        covariance = solved.ground_covariance(solved.cofactors, 1.0)
        plan = np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))
        rows = np.flatnonzero(self.of & np.isfinite(plan))
        ground, found = problem.frame.geodetic(local), self.broken.copy()
        # What is not known is larger while the images are far from right.
        far = self.source.breaks(ground[rows], slopes[rows], np.minimum(plan[rows], self.source.surface.sample_size))
        with np.errstate(invalid="ignore"):
            found[rows] = far > _BREAKS * self.sigmas[rows]
        return found

    # -- what is said of them ----------------------------------------------------------------------------------------

    def result(self, solved: Solved) -> HeightsUsed:
        """Return what people and documents are told of them."""
        rows = solved.linear.ordering.grounded
        planes = solved.problem.heights
        assert planes is not None
        used = rows[planes.on[rows]]
        apart = planes.above(solved.state.local)[used]
        sigmas = self.sigmas[used]
        known = sigmas[np.isfinite(sigmas)]
        bias, bias_sigma = self.common.bias
        active = np.zeros(len(self.of), dtype=bool)
        active[solved.linear.ordering.numbers] = True
        wrong, broken = active & self.wrong, active & self.broken & ~self.wrong
        return HeightsUsed(
            used=len(used), left_out=int(wrong.sum()), breaks=int(broken.sum()),
            none=int((active & self.of).sum()) - len(used) - int(wrong.sum()) - int(broken.sum()),
            sigma=float(np.sqrt(np.mean(known**2))) if len(known) else self.sigma,
            source="stated" if self.stated is not None else "estimated" if self.estimated else "assumed",
            rms=float(np.sqrt(np.mean(apart**2))) if len(used) else None, bias=bias, bias_sigma=bias_sigma,
            shift=tuple(self.common.shift(self.shift)[0].tolist()),
            shift_sigma=tuple(np.sqrt(np.diag(self.common.shift(self.shift)[1])).tolist()), shift_prior=self.shift,
            bias_prior=self.common.sigma, correlation=self.source.correlation,
            points=tuple(solved.problem.points.ids[k] for k in np.flatnonzero(wrong)),
        )  # fmt: skip


@dataclass(frozen=True)
class HeightsUsed:
    """What a block took from a DEM: numbers of heights, their sigma, and what they have in common, metres.

    `left_out` contradict their ties, at `breaks` the DEM is no plane, `none` lie in voids or outside.
    """

    used: int
    left_out: int
    breaks: int
    none: int
    sigma: float
    source: str
    rms: float | None
    bias: float
    bias_sigma: float
    bias_prior: float
    shift: tuple[float, ...]
    shift_sigma: tuple[float, ...]
    shift_prior: float
    correlation: float | None
    points: tuple[str, ...]

    def notices(self) -> list[Notice]:
        """Return what people ought to know of them."""
        found = []
        if self.source == "assumed":
            text = Text(
                f"accuracy of the heights not given; assuming {metres(self.sigma)}. Set it with ",
                Setting("surface.sigma"),
            )
            found.append(Notice("dem-sigma-by-default", text, dem_sigma_m=self.sigma))
        elif self.source == "estimated":
            text = Text(
                f"accuracy of the heights not given; estimated as {metres(self.sigma)} from {self.used} of them. "
                "Set it with ",
                Setting("surface.sigma"),
            )
            found.append(Notice("dem-sigma-estimated", text, dem_sigma_m=self.sigma, count=self.used))
        if self.left_out:
            said = (
                f"the DEM contradicts {counted(self.left_out, 'tie')}, such as on a roof or a tree: these heights were "
                f"not used, the ties were ({', '.join(self.points[:10])})"
            )
            found.append(Notice("heights-left-out", said, count=self.left_out, points=list(self.points[:10])))
        return found

    def to_json(self) -> dict[str, Any]:
        """Return the section ``heights`` of documents."""
        return {
            "used": self.used, "left_out": self.left_out, "at_breaks": self.breaks, "without": self.none,
            "sigma_m": self.sigma, "sigma_is": self.source, "rms_m": self.rms, "bias_m": self.bias,
            "bias_sigma_m": self.bias_sigma, "bias_prior_m": self.bias_prior, "shift_m": list(self.shift),
            "shift_sigma_m": list(self.shift_sigma), "shift_prior_m": self.shift_prior,
            "correlation_m": self.correlation,
        }  # fmt: skip
