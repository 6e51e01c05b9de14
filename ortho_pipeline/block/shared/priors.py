r"""Parameters that images of a block share, such as the interior orientation of one camera.

Each image has the parameter, with a tight prior. The mean of these priors is one unknown of the block,
:math:`c \sim N(0, I)` in standard deviations of the shared prior. With misfits :math:`r` at a minimum, :math:`U` what
one standard deviation adds to them, :math:`V = (I - H) U` what is left of that after a step of all other unknowns, and
:math:`h` the errors that heights of a DEM share (information :math:`T_{hh}`, cross :math:`T_{hc}`):

.. math::
    T &= V^T V - T_{hc}^T (I + T_{hh})^{-1} T_{hc} \\
    (I + T)\, dc &= -V^T r - c - T_{hc}^T (I + T_{hh})^{-1} b_h

The last term, with the slope :math:`b_h` of the heights' errors, is not zero while these are not settled yet.

A wrong focal length over flat ground looks like a wrong height. So the heights' errors are unknowns here, too.

Source: Koch 1999, sections 3.2 and 3.6; Kraus 2007, section 5.3 (self-calibration).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.elimination import Elimination
from ortho_pipeline.block.equations.problem import BlockProblem, Misfits, Selection
from ortho_pipeline.block.equations.solver import EXACT, Solved, attempt
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.estimation.observations.common_unknown import CommonUnknown
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.estimation.records import Parameter
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.models.base import Array

#: Standard deviation of what images have of their own of a shared parameter, over that of the prior.
OWN = 1e-3
#: A change of a parameter is significant if one as large by chance is less probable than this.
SIGNIFICANT = 0.001
#: Less information than this part is none.
_TOLD = 0.05
#: The estimate is stable if it changes by less than this (standard deviations).
_STABLE, _ROUNDS = 0.01, 8


@dataclass(frozen=True)
class SharedParameter:
    """A parameter of several images, with the columns ``(n,)`` that it has in the block."""

    name: str
    images: tuple[str, ...]
    prior: Prior
    columns: tuple[int, ...]


class SharedParameterRecord(Record):
    """A shared parameter as it is published: prior and estimate in its unit, in so many `images`.

    `determined` is the part of its information that comes from the block. `chance` is the probability of so large a
    change if the prior were exact; None if the block does not determine it.
    """

    name: str
    images: Count
    prior: Parameter
    value: float
    sigma: float
    determined: float
    chance: float | None

    @property
    def significant(self) -> bool:
        """Whether the block contradicts the value before the adjustment."""
        return self.chance is not None and self.chance < SIGNIFICANT


@dataclass(frozen=True, eq=False, kw_only=True)
class SharedPriors(CommonUnknown):
    """The shared parameters of a block, and what it tells of them.

    Parameters
    ----------
    parameters : tuple of SharedParameter
        k of them.
    by_params, by_points : ndarray (P, k), (N, 3, k)
        How one standard deviation moves parameters, and points in their east, north, up.
    by_heights : ndarray (h, k)
        How one standard deviation moves the errors that heights share; without heights (0, k).
    """

    parameters: tuple[SharedParameter, ...]
    by_params: Array
    by_points: Array
    by_heights: Array

    @classmethod
    def of(cls, problem: BlockProblem, priors: Mapping[str, Mapping[str, Prior]]) -> SharedPriors | None:
        """Return those of the priors that are shared; equal priors of the same parameter are one. None without any."""
        columns: dict[tuple[str, Prior], dict[str, int]] = {}
        offsets = problem.columns.offsets
        for number, image in enumerate(problem.points.images):
            names = list(problem.models[number].param_names)
            for name, prior in priors.get(image, {}).items():
                if prior.shared:
                    columns.setdefault((name, prior), {})[image] = int(offsets[number]) + names.index(name)
        if not columns:
            return None
        found = tuple(
            SharedParameter(name, tuple(of), prior, tuple(of.values())) for (name, prior), of in columns.items()
        )
        k = len(found)
        by_params, by_points = np.zeros((problem.size, k)), np.zeros((len(problem.points), 3, k))
        return cls(
            value=np.zeros(k),
            told=np.zeros((k, k)),
            parameters=found,
            by_params=by_params,
            by_points=by_points,
            by_heights=np.zeros((0, k)),
        )

    @property
    def sigmas(self) -> Array:
        """Standard deviations ``(k,)`` of the shared priors."""
        return np.array([one.prior.sigma for one in self.parameters])

    @property
    def means(self) -> Array:
        """The estimates ``(k,)`` of the parameters."""
        return np.array([one.prior.mean for one in self.parameters]) + self.sigmas * self.value

    @property
    def of_points(self) -> Array:
        """Their part ``(N, 3, 3)`` of the covariance of the ground, m²."""
        return np.asarray(self.by_points @ self.left @ self.by_points.swapaxes(1, 2))

    @property
    def records(self) -> tuple[SharedParameterRecord, ...]:
        """What is published of them."""
        from scipy.special import chdtrc

        left = self.left
        # The covariance of the estimate if the priors are exact.
        alone = np.diag(left - left @ left)
        found = []
        for one, mean, value, own, variance in zip(
            self.parameters, self.means, self.value, np.diag(left), alone, strict=True
        ):
            told = float(1.0 - own)
            found.append(
                SharedParameterRecord(
                    name=one.name,
                    images=len(one.images),
                    prior=Parameter(value=one.prior.mean, sigma=one.prior.sigma),
                    value=float(mean),
                    sigma=float(np.sqrt(own)) * one.prior.sigma,
                    determined=told,
                    chance=float(chdtrc(1, value**2 / variance)) if told > _TOLD else None,
                )
            )
        return tuple(found)

    def applied(self, problem: BlockProblem) -> BlockProblem:
        """Return the problem with the estimates as means of the images' priors."""
        means = {column: mean for one, mean in zip(self.parameters, self.means, strict=True) for column in one.columns}
        pseudo = tuple(replace(one, mean=float(means.get(one.column, one.mean))) for one in problem.pseudo)
        return replace(problem, pseudo=pseudo)

    def settled(
        self, solved: Solved, selection: Selection, heights: Heights | None, tolerance: float = EXACT
    ) -> tuple[Solved, SharedPriors, Heights | None]:
        """Return the solution with the parameters as unknowns, from one with their present values, and the heights."""
        found = self
        for _ in range(_ROUNDS):
            found, slope = found._seen(solved, heights)
            step = found.step(slope)
            if np.abs(step).max() < _STABLE:
                break
            found = replace(found, value=found.value + step)
            state = solved.state.moved(found.by_params @ step, np.zeros_like(solved.state.local))
            again = attempt(found.applied(solved.problem), state, selection, tolerance)
            if not again.converged:
                raise NotConverged(
                    "the adjustment did not converge with the parameters of the camera",
                    remedy="do not calibrate: give the sensor option calibrate=no",
                )
            solved = again
            if heights is not None:
                solved, heights = heights.settled(solved, selection)
        return solved, found, heights

    def _seen(self, solved: Solved, heights: Heights | None) -> tuple[SharedPriors, Array]:
        """Return them with what a solution tells of them, and the slope ``(k,)``."""
        linear, problem, ordering = solved.linear, solved.problem, solved.linear.ordering
        units, right = self._units(problem), np.zeros((problem.size, len(self.value)))
        columns = np.array([one.column for one in problem.pseudo])
        np.add.at(right, columns, _roots(problem)[:, None] * units)
        step = solved.cofactors.times(right)
        rays, ground = np.zeros_like(linear.misfits.rays), np.zeros_like(linear.misfits.ground)
        pseudo = np.zeros_like(linear.misfits.pseudo)
        points = Elimination(replace(linear, misfits=Misfits(rays, ground, pseudo)))
        enu = problem.frame.enu_at(problem.frame.geodetic(linear.state.local[ordering.numbers]))
        by_points, left = np.zeros_like(self.by_points), []
        for k in range(len(self.value)):
            shift, change = points.shifts(step[:, k])
            by_points[ordering.numbers, :, k] = (enu @ shift[ordering.numbers, :, None])[:, :, 0]
            pseudo = -change.pseudo
            pseudo[: len(units)] += units[:, k]
            left.append(Misfits(-change.rays, -change.ground, pseudo))
        whole = np.stack([one.vector for one in left], axis=1)
        told, by_params, slope = whole.T @ whole, step, -whole.T @ linear.misfits.vector
        follow = np.zeros((0, len(self.value)))
        if heights is not None:
            common, of_heights = heights.seen(solved)
            rows, loads = common.units(linear)
            cross = -loads.T @ np.stack([one.ground[rows, 2] for one in left], axis=1)
            follow = -common.left @ cross
            told = told + cross.T @ follow
            slope = slope + follow.T @ (of_heights - common.value)
            by_params = by_params + common.by_params @ follow
            by_points += common.by_points @ follow
        told = (told + told.T) / 2
        return replace(self, told=told, by_params=by_params, by_points=by_points, by_heights=follow), slope

    def _units(self, problem: BlockProblem) -> Array:
        """Return what one standard deviation adds to the misfits of the priors ``(n, k)`` of images."""
        found, of = np.zeros((len(problem.pseudo), len(self.value))), dict[int, int]()
        for k, one in enumerate(self.parameters):
            of |= dict.fromkeys(one.columns, k)
        for row, pseudo in enumerate(problem.pseudo):
            if pseudo.column in of and not pseudo.held:
                found[row, of[pseudo.column]] = self.sigmas[of[pseudo.column]]
        return found * _roots(problem)[:, None]


def _roots(problem: BlockProblem) -> Array:
    """Return the roots ``(n,)`` of the weights of the pseudo-observations."""
    return np.sqrt(problem.firmness) / np.array([one.sigma for one in problem.pseudo])
