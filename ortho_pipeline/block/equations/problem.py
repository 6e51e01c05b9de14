"""Everything that is observed of a block, and how far it is from what models and points at some state predict."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ortho_pipeline.block.equations.image_pairs import ImagePairs, Levels
from ortho_pipeline.block.equations.unknowns import Columns, Mask, Ordering
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.points import BlockPoints, Index
from ortho_pipeline.block.projection.buffers import Buffers
from ortho_pipeline.estimation.observations.on_points import OnPoints, Planes
from ortho_pipeline.models.base import Array, SensorModel

#: Ground is never weighted with less than this sigma (m): far below any pixel, far above rounding.
PERFECT_GROUND = 1e-5


@dataclass(frozen=True)
class Pseudo:
    """An observation of one parameter (column) by itself; `held`: it defines the datum, and is not knowledge.

    `slow` (px) is an error that all measurements of the image share: see `BlockProblem.firmness`.
    """

    column: int
    mean: float
    sigma: float
    held: bool = False
    slow: float = 0.0


@dataclass(frozen=True, eq=False)
class State:
    """Models and ground points ``(N, 3)`` in the frame, as they are in one iteration."""

    models: tuple[SensorModel, ...]
    local: Array

    @property
    def params(self) -> Array:
        """Parameters of all models ``(P,)``."""
        return np.concatenate([np.zeros(0), *(model.params for model in self.models)])

    def moved(self, step: Array, shift: Array) -> State:
        """Return the state after a step of the parameters ``(P,)`` and of the points ``(N, 3)``."""
        models, begin = [], 0
        for model in self.models:
            count = len(model.params)
            models.append(model.with_params(model.params + step[begin : begin + count]) if count else model)
            begin += count
        return State(tuple(models), self.local + shift)


@dataclass(frozen=True, eq=False)
class Selection:
    """Rays ``(M,)`` and ground coordinates ``(N,)`` that take part, with their weights (robust estimation)."""

    rays: Mask
    ground: Mask
    ray_weights: Array
    ground_weights: Array

    @classmethod
    def of(cls, rays: Mask, ground: Mask) -> Selection:
        """Return a selection of equal weights."""
        return cls(rays, ground, np.ones(len(rays)), np.ones(len(ground)))

    def without(self, gone: Mask, point: Index) -> Selection:
        """Return this selection without points ``(N,)``; `point` ``(M,)`` are the points of the rays."""
        return replace(self, rays=self.rays & ~gone[point], ground=self.ground & ~gone)


@dataclass(frozen=True, eq=False)
class Misfits:
    """Observed minus predicted over sigma: rays ``(M, 2)``, ground ``(N, 3)``, pseudo-observations ``(k,)``.

    Zero for what takes no part; weights enter by their root.
    """

    rays: Array
    ground: Array
    pseudo: Array

    @property
    def square(self) -> float:
        """Sum of their squares."""
        return float(sum((part**2).sum() for part in (self.rays, self.ground, self.pseudo)))

    @property
    def vector(self) -> Array:
        """All of them, one after the other."""
        return np.concatenate([self.rays.ravel(), self.ground.ravel(), self.pseudo])

    def minus(self, other: Misfits) -> Misfits:
        """Return what is left when others are taken away."""
        return Misfits(self.rays - other.rays, self.ground - other.ground, self.pseudo - other.pseudo)


@dataclass(frozen=True, eq=False)
class PseudoEquations:
    """Equations of priors, datum and the models' constraints: misfits ``(k,)``, rows ``(k, p)`` of one `image` each.

    `true` ``(k,)`` are observations; the others hold a datum or are fictitious.
    """

    misfit: Array
    image: Index
    rows: Array
    true: Mask


@dataclass(frozen=True, eq=False)
class BlockProblem:
    """Everything that is observed; `known` ``(N, 3)`` is the ground of control as lon, lat, h (NaN: not observed).

    `assumed` are the sigmas (m) in plan and height of known ground that states none, `heights` the heights of a surface
    under points without a known height. `target` ``(N, 3)`` is known ground in the frame, `enu` ``(N, 3, 3)`` turns
    from the frame to east, north, up there.
    """

    points: BlockPoints
    models: tuple[SensorModel, ...]
    frame: GroundFrame
    known: Array
    pseudo: tuple[Pseudo, ...] = ()
    assumed: tuple[float, float] = (PERFECT_GROUND, PERFECT_GROUND)
    heights: Planes | None = None
    buffers: Buffers = field(default_factory=Buffers, repr=False)
    columns: Columns = field(init=False)
    target: Array = field(init=False)
    enu: Array = field(init=False)

    def __post_init__(self) -> None:
        # East and north of a point are the same from any height above a place, so an unknown height may be zero.
        place = np.where(np.isfinite(self.known), self.known, (np.nan, np.nan, 0.0))
        object.__setattr__(self, "target", self.frame.of_geodetic(place))
        object.__setattr__(self, "enu", self.frame.enu_at(place))
        object.__setattr__(self, "columns", Columns.of([len(model.params) for model in self.models]))

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return self.columns.size

    @cached_property
    def levels(self) -> Levels:
        """The parameters in an order in which the normal equations of many images are solved."""
        return Levels(ImagePairs.of(self.points), self.columns)

    def with_sigmas(self, image: Array, assumed: tuple[float, float]) -> BlockProblem:
        """Return this problem with other sigmas of measurements ``(M,)``, and of known ground that states none."""
        found = copy.copy(self)
        for name in ("ground_sigmas", "firmness", "_observed"):
            found.__dict__.pop(name, None)
        object.__setattr__(found, "points", self.points.with_image_sigmas(image))
        object.__setattr__(found, "assumed", assumed)
        return found

    def with_heights(self, heights: Planes | None) -> BlockProblem:
        """Return this problem with other heights of a surface."""
        found = copy.copy(self)
        found.__dict__.pop("_observed", None)
        object.__setattr__(found, "heights", heights)
        return found

    def with_pseudo(self, more: Sequence[Pseudo]) -> BlockProblem:
        """Return this problem with further pseudo-observations."""
        return replace(self, pseudo=(*self.pseudo, *more))

    # -- what takes part ---------------------------------------------------------------------------------------------

    def active(self, selection: Selection) -> Mask:
        """Return the points ``(N,)`` that are determined by two rays, or by one with known ground."""
        counts = np.bincount(self.points.point[selection.rays], minlength=len(self.points))
        return np.asarray((counts >= 2) | ((counts >= 1) & selection.ground & self.placed))

    @cached_property
    def placed(self) -> Mask:
        """Points ``(N,)`` whose place in plan is known."""
        return np.asarray(np.isfinite(self.known[:, :2]).all(axis=1))

    def ordering(self, selection: Selection) -> Ordering:
        """Return the order in which the unknowns of the active points and of the models are eliminated."""
        rays = selection.rays & self.active(selection)[self.points.point]
        return Ordering.of(self.points, rays, self._grounded(selection))

    def _grounded(self, selection: Selection) -> Mask:
        """Return the points ``(N,)`` whose place is observed by itself: known ground, and heights of a surface."""
        grounded: Mask = selection.ground & self.placed
        return grounded if self.heights is None else grounded | self.heights.on

    # -- sigmas ------------------------------------------------------------------------------------------------------

    @cached_property
    def ground_sigmas(self) -> Array:
        """Sigmas ``(N, 3)`` of known ground in metres; infinite for a height that is not known."""
        stated, (plan, height) = self.points.sigma_ground, self.assumed
        sigmas = np.maximum(np.where(stated > 0, stated, (plan, plan, height)), PERFECT_GROUND)
        return np.where(np.isfinite(self.known), sigmas, np.inf)

    def factor_of(self, points: BlockPoints) -> float:
        """Return the factor between the sigmas of measurements of these points and those that they stated."""
        return float(self.points.sigma_image[0] / points.sigma_image[0]) if self.points.rays else 1.0

    @property
    def unstated(self) -> Mask:
        """Known ground ``(N, 3)`` that states no sigma."""
        return np.asarray(np.isfinite(self.known) & (self.points.sigma_ground == 0))

    @cached_property
    def firmness(self) -> Array:
        """By how much each pseudo-observation ``(k,)`` outweighs its sigma.

        An error that measurements share does not average out. With it the variance of their mean is this many times as
        large. A parameter against which the measurements weigh that much less is one that is held that much more.
        """
        images, _ = self.columns.image_and_place([one.column for one in self.pseudo])
        weights = np.bincount(self.points.image, self.points.sigma_image**-2.0, minlength=len(self.models))
        slow = np.array([one.slow for one in self.pseudo])
        return np.asarray(1.0 + slow**2 * weights[images])

    # -- misfits -----------------------------------------------------------------------------------------------------

    def misfits(self, state: State, ordering: Ordering, weights: Selection) -> Misfits:
        """Return the misfits of everything that takes part."""
        places = self.frame.places(state.local)
        predicted = self.points.measured.copy()
        for model, used in zip(state.models, ordering.rays_of_image, strict=True):
            predicted[used] = places.project(model, self.points.point[used])
        ground = self.ground_equations(state.local, ordering, weights)[0]
        return Misfits(self.ray_misfits(predicted, weights), ground, self.pseudo_equations(state).misfit)

    def ray_misfits(self, predicted: Array, weights: Selection) -> Array:
        """Return the misfits ``(M, 2)`` of image points `predicted`; of what takes no part, those measured."""
        points = self.points
        scale = np.sqrt(weights.ray_weights) / points.sigma_image
        return points.whitened((points.measured - predicted) * scale[:, None], slice(None))

    def ground_equations(self, local: Array, ordering: Ordering, weights: Selection) -> tuple[Array, Array]:
        """Return misfits ``(N, 3)`` and partials ``(N, 3, 3)`` of known ground with points at `local` ``(N, 3)``."""
        count, rows = len(self.points), ordering.grounded
        misfits, partials, observed = np.zeros((count, 3)), np.zeros((count, 3, 3)), self.on_points(local, rows)
        misfits[rows], partials[rows] = (
            part(weights.ground_weights[rows]) for part in (observed.misfits, observed.partials)
        )
        return misfits, partials

    def on_points(self, local: Array, rows: Index) -> OnPoints:
        """Return what is observed of the places of points `rows` ``(n,)`` by themselves, with points at `local`."""
        observed, placed = self._observed, self.placed[rows]
        apart, known = np.zeros((len(rows), 3)), rows[placed]
        off = (self.enu[known] @ (self.target[known] - local[known])[:, :, None])[:, :, 0]
        apart[placed] = np.where(np.isfinite(self.known[known]), off, 0.0)
        found = OnPoints(apart, observed.axes[rows], observed.sigmas[rows])
        if self.heights is not None:
            on = self.heights.on[rows]
            apart[on, 2] = self.heights.above(local, rows[on])
        return found

    @cached_property
    def _observed(self) -> OnPoints:
        """Axes and sigmas of what is observed of the places of all points ``(N,)``, but not how far they are apart."""
        if self.heights is None:
            return OnPoints(np.zeros((0, 3)), self.enu, self.ground_sigmas)
        on, axes, sigmas = self.heights.on, self.enu.copy(), self.ground_sigmas.copy()
        axes[on], sigmas[on, 2] = self.heights.axes[on], self.heights.sigmas[on]
        return OnPoints(np.zeros((0, 3)), axes, sigmas)

    def pseudo_equations(self, state: State) -> PseudoEquations:
        """Return the equations of priors, datum and the models' constraints at a state."""
        params = state.params
        images, places = self.columns.image_and_place([one.column for one in self.pseudo])
        rows = np.zeros((len(self.pseudo), self.columns.widest))
        roots = np.sqrt(self.firmness) / np.array([one.sigma for one in self.pseudo])
        rows[np.arange(len(rows)), places] = roots
        parts, true = [rows], [np.array([not one.held for one in self.pseudo], dtype=bool)]
        values = [roots * np.array([one.mean - params[one.column] for one in self.pseudo])]
        of = [images]
        for image, model in enumerate(state.models):
            known = model.constraints()
            if not len(known):
                continue
            wide = np.zeros((len(known), self.columns.widest))
            wide[:, : known.jacobian.shape[1]] = known.jacobian / known.sigma[:, None]
            parts.append(wide)
            of.append(np.full(len(known), image))
            values.append(known.residuals / known.sigma)
            true.append(~known.fictitious)
        return PseudoEquations(np.concatenate(values), np.concatenate(of), np.vstack(parts), np.concatenate(true))

    def square(self, state: State, selection: Selection) -> float:
        """Return the sum of the squared misfits at a state; infinite where something cannot be computed."""
        found = self.misfits(state, self.ordering(selection), selection).square
        return found if math.isfinite(found) else math.inf
