"""Standard deviations of a block's observations, as they are stated or as they are found."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.problem import PERFECT_GROUND, BlockProblem
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.points import Index
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.models.base import Array


class ImageVariance(Record):
    """The factor of the stated sigmas of measurements, and their part of the redundancy."""

    factor: float
    redundancy: float


class GroundVariance(Record):
    """The sigma of ground that states none, of how many points, and its part of the redundancy."""

    sigma: float | None
    points: Count
    redundancy: float


class UnstatedGround(Record):
    """In plan (each axis) and in height."""

    xy: GroundVariance
    h: GroundVariance


class VariancesRecord(Record):
    """Standard deviations of the observations, as stated or found; separable is whether they can be told apart."""

    image: ImageVariance
    unstated_ground: UnstatedGround
    separable: bool


@dataclass(frozen=True, eq=False)
class Variances:
    """Standard deviations of the observations, as stated or found.

    Parameters
    ----------
    image : float
        Factor of the stated sigmas of measurements; 1 where it cannot be estimated.
    sigma_xy, sigma_h : float or None
        Of ground that states none, metres, in plan (each axis) and height; None where all is stated, or it cannot be
        told from errors of measurement (`separable` is then False, and `image` contains it).
    redundancy : (float, float, float)
        Parts of the redundancy of measurements, and of such ground in plan and in height.
    unstated : (int, int)
        Number of points whose ground in plan and in height states no sigma.
    freedom : float
        Degrees of freedom of what the misfits of such ground are compared with: these sigmas and those of its rays.
    nodes, chances : ndarray (b, 3), (b,)
        Squares of the three standard deviations that are possible, those of measurements over `image`, and how probable
        each is.
    """

    image: float
    sigma_xy: float | None
    sigma_h: float | None
    redundancy: tuple[float, float, float]
    unstated: tuple[int, int]
    separable: bool = True
    freedom: float = math.inf
    nodes: Array = field(default_factory=lambda: np.ones((1, 3)), repr=False)
    chances: Array = field(default_factory=lambda: np.ones(1), repr=False)

    @property
    def estimated(self) -> bool:
        """Whether a sigma of the ground was estimated."""
        return self.sigma_xy is not None or self.sigma_h is not None

    def of_ground(self, problem: BlockProblem) -> Mask:
        """Return the points ``(N,)`` whose ground has a sigma that is estimated."""
        return np.asarray(problem.unstated.any(axis=1) & self.estimated)

    def chance_of(self, apart: Array, spread: Array, axes: tuple[int, ...]) -> float:
        """Return the chance that ground of an estimated sigma is as far as this from where the others put it.

        Parameters
        ----------
        apart : ndarray (k,)
            In metres along k of the axes east, north, up.
        spread : ndarray (k, k)
            Covariance of where the others put it.
        """
        from scipy.special import chdtrc

        own = self.nodes[:, [1, 1, 2]][:, axes]
        if len({(1, 1, 2)[axis] for axis in axes}) == 1:
            # One sigma for all axes: they may be turned to where the spread is diagonal, at all nodes alike.
            values, turn = np.linalg.eigh(spread)
            squares = (turn.T @ apart) ** 2 / (self.nodes[:, :1] * values + own)
        else:
            whole = self.nodes[:, 0, None, None] * spread + diagonal(own)
            squares = apart * np.linalg.solve(whole, np.broadcast_to(apart[:, None], (*own.shape, 1)))[:, :, 0]
        square = squares.sum(axis=1)
        # The same for two degrees of freedom, and many times as fast.
        beyond = np.exp(-0.5 * square) if len(apart) == 2 else chdtrc(len(apart), square)
        return float(self.chances @ beyond)

    def applied(self, problem: BlockProblem) -> BlockProblem:
        """Return the problem with these standard deviations."""
        perfect = (PERFECT_GROUND, PERFECT_GROUND)
        assumed = perfect if not self.separable else (self.sigma_xy or PERFECT_GROUND, self.sigma_h or PERFECT_GROUND)
        sigma_image = problem.points.sigma_image * self.image
        return problem.with_sigmas(sigma_image, assumed)

    def notes(self) -> list[Notice]:
        """Return what people ought to know of them."""
        number = max(self.unstated)
        if not number:
            return []
        remedy = Text(
            "state sigmas (sigma_xy, sigma_h, or ", Setting("points.ground_sigma", "XY,H"), ") if they are known"
        )
        who = f"{counted(number, 'control point')} without a stated sigma"
        if not self.separable:
            text = f"{who}: their errors are inseparable from errors of measurement here, and count as such; "
            return [Notice("unstated-sigma", Text(text, remedy), count=number)]
        found = []
        sigmas = self.sigma_xy, self.sigma_h
        for what, sigma, part in zip(("in plan", "in height"), sigmas, self.redundancy[1:], strict=True):
            if sigma is not None:
                weak = ", hardly determined" if part < 2.0 else ""
                found.append(f"{significant(sigma)} m {what} (redundancy {part:.1f}{weak})")
        text = Text(f"{who}: estimated as {' and '.join(found)}; ", remedy)
        return [Notice("unstated-sigma", text, count=number, sigma_xy=self.sigma_xy, sigma_h=self.sigma_h)]

    @property
    def record(self) -> VariancesRecord:
        """What is published of them."""
        of_image, of_plan, of_height = self.redundancy
        plan, height = self.unstated
        return VariancesRecord(
            image=ImageVariance(factor=self.image, redundancy=of_image),
            unstated_ground=UnstatedGround(
                xy=GroundVariance(sigma=self.sigma_xy, points=plan, redundancy=of_plan),
                h=GroundVariance(sigma=self.sigma_h, points=height, redundancy=of_height),
            ),
            separable=self.separable,
        )


@dataclass(frozen=True, eq=False)
class Posterior:
    """Variance components, the covariance of the parameters with their uncertainty, and that of the grounded points.

    `image_square` is the mean square of the factor of measurements; `ground` ``(n, 3, 3)`` of the points `rows`, m²
    east, north, up; `moved` is how far (sigmas) the parameters are from those of the solution.
    """

    variances: Variances
    covariance: Cofactors
    image_square: float
    rows: Index
    ground: Array
    moved: float


def diagonal(values: Array) -> Array:
    """Return the diagonal matrices ``(..., k, k)`` of values ``(..., k)``."""
    return values[..., None] * np.eye(values.shape[-1])
