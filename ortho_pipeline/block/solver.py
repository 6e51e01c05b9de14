r"""The least-squares problem of a block: rays, control and pseudo-observations, with the points eliminated.

With rays :math:`l = f_i(p_i, X_j)`, all rows divided by their sigma, a step solves :math:`A\,dp + B\,dX = r`. Each
point appears in few rows, so its :math:`B_j = Q_j R_j` is small, and what is left after projecting onto the complement
of :math:`Q_j` holds the parameters alone (the Schur complement, taken orthogonally, so that nothing is squared):

.. math:: F_j = (I - Q_j Q_j^T) A_j, \qquad F\,dp = (I - Q Q^T)\, r, \qquad R_j\,dX_j = Q_j^T (r_j - A_j\,dp)

Points with equally many rays are eliminated together, as one stack of small matrices. The reduced system is solved by
orthogonal triangulation; only where it is large, by its normal equations :math:`A^T A - (Q^T A)^T (Q^T A)`. Cofactors
of a point are :math:`R_j^{-1} (I + Q_j^T A_j\, C\, A_j^T Q_j) R_j^{-T}`, and the hat matrix of its rows is
:math:`Q_j Q_j^T + F_j C F_j^T`.

Source: Brown 1976 (elimination of points); Demmel et al. 2021 (orthogonally); Grodecki and Dial 2003 (blocks of RPCs).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.points import BlockPoints, Index
from ortho_pipeline.block.steps import Steps
from ortho_pipeline.block.system import NormalSystem, OrthogonalSystem, solve_triangular
from ortho_pipeline.errors import InputError, NotConverged
from ortho_pipeline.estimation.least_squares import LinearSolution
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models.base import Array, SensorModel

Mask = np.ndarray
#: Ground is never weighted with less than this sigma (m): far below any pixel, far above rounding.
PERFECT_GROUND = 1e-5
#: Points that are eliminated at once.
_CHUNK = 20_000
#: Beyond so many multiplications the reduced system is solved by its normal equations.
_ORTHOGONAL_LIMIT = 1e9
_STEPS = 50


@dataclass(frozen=True)
class Pseudo:
    """An observation of one parameter (column) by itself; `held`: it defines the datum, and is not knowledge."""

    column: int
    mean: float
    sigma: float
    held: bool = False


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
    """Which rays ``(M,)`` and which ground coordinates ``(N,)`` take part, with their weights (robust estimation)."""

    rays: Mask
    ground: Mask
    ray_weights: Array
    ground_weights: Array

    @classmethod
    def of(cls, rays: Mask, ground: Mask) -> Selection:
        """Return a selection of equal weights."""
        return cls(rays, ground, np.ones(len(rays)), np.ones(len(ground)))


@dataclass(frozen=True, eq=False)
class Chunk:
    """Points ``(n,)`` with the same number of rays ``(n, k)`` in images ``(n, k)``, and whether known ground weighs in.

    Points of one set of images stand together: `groups` are their slices.
    """

    points: Index
    rays: Index
    images: Index
    ground: bool
    groups: tuple[slice, ...]


@dataclass(frozen=True, eq=False)
class Layout:
    """What takes part: the points in chunks, the rays of each image, the points whose known ground weighs in."""

    chunks: tuple[Chunk, ...]
    rays_of_image: tuple[Index, ...]
    grounded: Index

    @property
    def observations(self) -> int:
        """Number of image coordinates."""
        return 2 * sum(len(rays) for rays in self.rays_of_image)


@dataclass(frozen=True, eq=False)
class Linear:
    """Misfits over their sigma, and their partials, at a state; zero for what takes no part.

    `by_params` has as many columns as the image with the most parameters; those that an image does not have are zero.
    """

    state: State
    layout: Layout
    weights: Selection
    ray_misfit: Array  # (M, 2)
    ground_misfit: Array  # (N, 3)
    by_params: Array  # (M, 2, p)
    by_point: Array  # (M, 2, 3)
    ground_by_point: Array  # (N, 3, 3)
    pseudo_misfit: Array  # (k,)
    pseudo_rows: Array  # (k, P)
    pseudo_true: Mask  # (k,) observations; the others hold a datum or are fictitious


@dataclass(frozen=True, eq=False)
class Eliminated:
    """The rows of the points of a chunk, factored: B = Q R with `q` ``(n, m, 3)``, `r` ``(n, 3, 3)``.

    `turned` ``(n, 3, k p)`` and `met` ``(n, 3)`` are Q' A and Q' r: what the points take of parameters and misfits.
    """

    chunk: Chunk
    linear: Linear
    q: Array
    r: Array
    turned: Array
    met: Array
    misfit: Array

    def design(self, rows: slice) -> Array:
        """Return the partials by the parameters of their images ``(n, m, k p)`` of some of the points."""
        rays = self.chunk.rays[rows]
        count, k = rays.shape
        by_params = self.linear.by_params[rays]
        wide = by_params.shape[3]
        design = np.zeros((count, self.q.shape[1], k * wide))
        for c in range(k):
            design[:, 2 * c : 2 * c + 2, c * wide : (c + 1) * wide] = by_params[:, c]
        return design

    def free(self, rows: slice) -> tuple[Array, Array]:
        """Return rows ``(n, m, k p)`` and misfits ``(n, m)`` of some of the points without what the points can take."""
        free = self.design(rows) - self.q[rows] @ self.turned[rows]
        left = self.misfit[rows] - (self.q[rows] @ self.met[rows][:, :, None])[:, :, 0]
        return free, left


@dataclass(frozen=True, eq=False)
class Solved:
    """The observation equations at a minimum (or after one step), factored, with the cofactors of the parameters.

    Not `converged`: at the place where the iteration ended without one.
    """

    linear: Linear
    eliminated: tuple[Eliminated, ...]
    cofactors: Array
    condition: float
    iterations: int = 0
    converged: bool = True

    @property
    def state(self) -> State:
        return self.linear.state


@dataclass(frozen=True, eq=False)
class BlockProblem:
    """Everything that is observed; `known` ``(N, 3)`` is the ground of control as lon, lat, h (NaN: not observed).

    `assumed` are the sigmas (m) in plan and height of known ground that states none.
    """

    points: BlockPoints
    models: tuple[SensorModel, ...]
    frame: GroundFrame
    known: Array
    pseudo: tuple[Pseudo, ...] = ()
    assumed: tuple[float, float] = (PERFECT_GROUND, PERFECT_GROUND)
    offsets: Index = field(init=False)
    columns: Index = field(init=False)  # (images, p): the columns of their parameters, -1 for none
    target: Array = field(init=False)
    horizons: Array = field(init=False)

    def __post_init__(self) -> None:
        # East and north of a point are the same from any height above a place, so an unknown height may be zero.
        place = np.where(np.isfinite(self.known), self.known, (np.nan, np.nan, 0.0))
        object.__setattr__(self, "target", self.frame.of_geodetic(place))
        object.__setattr__(self, "horizons", self.frame.horizons(place))
        counts = [len(model.params) for model in self.models]
        object.__setattr__(self, "offsets", np.concatenate([[0], np.cumsum(counts)]).astype(np.int64))
        columns = np.full((len(counts), max(counts, default=0)), -1, dtype=np.int64)
        for image, count in enumerate(counts):
            columns[image, :count] = self.offsets[image] + np.arange(count)
        object.__setattr__(self, "columns", columns)

    @property
    def size(self) -> int:
        """Number of parameters P."""
        return int(self.offsets[-1])

    def columns_of(self, image: int) -> Index:
        """Return the columns of the parameters of an image."""
        return np.arange(self.offsets[image], self.offsets[image + 1])

    def with_pseudo(self, more: Sequence[Pseudo]) -> BlockProblem:
        """Return this problem with further pseudo-observations."""
        return replace(self, pseudo=(*self.pseudo, *more))

    # -- what takes part ---------------------------------------------------------------------------------------------

    def active(self, selection: Selection) -> Mask:
        """Return the points ``(N,)`` that are determined by two rays, or by one with known ground."""
        counts = np.bincount(self.points.point[selection.rays], minlength=len(self.points))
        return np.asarray((counts >= 2) | ((counts >= 1) & self._grounded(selection)))

    def _grounded(self, selection: Selection) -> Mask:
        return np.asarray(selection.ground & np.isfinite(self.known[:, :2]).all(axis=1))

    def layout(self, selection: Selection) -> Layout:
        """Sort the active points by the number of their rays and by the images that show them."""
        points, grounded = self.points, self._grounded(selection)
        active = self.active(selection)
        rays = np.flatnonzero(selection.rays & active[points.point])
        rays = rays[np.lexsort((points.image[rays], points.point[rays]))]
        counts = np.bincount(points.point[rays], minlength=len(points))
        starts = np.concatenate([[0], np.cumsum(counts)])
        chunks = []
        for count in np.unique(counts[counts > 0]):
            for ground in (False, True):
                rows = np.flatnonzero((counts == count) & (grounded == ground))
                table = rays[starts[rows][:, None] + np.arange(count)]
                order = np.lexsort(points.image[table].T[::-1])
                for begin in range(0, len(order), _CHUNK):
                    part = order[begin : begin + _CHUNK]
                    images = points.image[table[part]]
                    ends = np.flatnonzero((images[1:] != images[:-1]).any(axis=1)) + 1
                    edges = [0, *ends.tolist(), len(part)]
                    groups = tuple(slice(a, b) for a, b in itertools.pairwise(edges))
                    chunks.append(Chunk(rows[part], table[part], images, ground, groups))
        of_image = tuple(rays[points.image[rays] == image] for image in range(len(self.models)))
        return Layout(tuple(chunks), of_image, np.flatnonzero(active & grounded))

    # -- observation equations ---------------------------------------------------------------------------------------

    def misfits(self, state: State, layout: Layout, weights: Selection) -> tuple[Array, Array, Array]:
        """Return observed minus predicted over sigma: rays ``(M, 2)``, ground ``(N, 3)``, pseudo-observations; 0: out.

        Weights enter by their root.
        """
        points = self.points
        places = self.frame.places(state.local)
        rays = np.zeros((points.rays, 2))
        for model, used in zip(state.models, layout.rays_of_image, strict=True):
            predicted = places.project(model, points.point[used])
            rays[used] = (points.measured[used] - predicted) / points.sigma_image[used][:, None]
        rays *= np.sqrt(weights.ray_weights)[:, None]
        ground, rows = np.zeros((len(points), 3)), layout.grounded
        apart = (self.horizons[rows] @ (self.target[rows] - state.local[rows])[:, :, None])[:, :, 0]
        ground[rows] = apart / self.ground_sigmas[rows] * np.sqrt(weights.ground_weights[rows])[:, None]
        return rays, ground, self._pseudo(state)[0]

    @property
    def ground_sigmas(self) -> Array:
        """Sigmas ``(N, 3)`` of known ground in metres; infinite for a height that is not known."""
        return np.where(np.isfinite(self.known), self.sigmas_of_survey, np.inf)

    @property
    def sigmas_of_survey(self) -> Array:
        """Sigmas ``(N, 3)`` of the ground of points of any role in metres, where it is known."""
        stated, (plan, height) = self.points.sigma_ground, self.assumed
        sigmas: Array = np.where(stated > 0, stated, (plan, plan, height))
        return np.maximum(sigmas, PERFECT_GROUND)

    def factor_of(self, points: BlockPoints) -> float:
        """Return the factor between the sigmas of measurements of these points and those that they stated."""
        return float(self.points.sigma_image[0] / points.sigma_image[0]) if self.points.rays else 1.0

    @property
    def unstated(self) -> Mask:
        """Known ground ``(N, 3)`` that states no sigma."""
        return np.asarray(np.isfinite(self.known) & (self.points.sigma_ground == 0))

    def linearise(self, state: State, layout: Layout, weights: Selection) -> Linear:
        """Return the observation equations at a state."""
        points = self.points
        rays, ground, _ = self.misfits(state, layout, weights)
        places = self.frame.places(state.local)
        root = np.sqrt(weights.ray_weights) / points.sigma_image
        by_point = np.zeros((points.rays, 2, 3))
        by_params = np.zeros((points.rays, 2, self.columns.shape[1]))
        for model, used in zip(state.models, layout.rays_of_image, strict=True):
            rows, scale = points.point[used], root[used][:, None, None]
            by_point[used] = places.ground_partials(model, rows) * scale
            if count := len(model.params):
                by_params[used, :, :count] = model.param_partials(places.in_crs(model.crs)[rows]) * scale
        ground_by_point, rows = np.zeros((len(points), 3, 3)), layout.grounded
        scale = np.sqrt(weights.ground_weights[rows])[:, None] / self.ground_sigmas[rows]
        ground_by_point[rows] = self.horizons[rows] * scale[:, :, None]
        return Linear(
            state, layout, weights, rays, ground, by_params, by_point, ground_by_point, *self._pseudo(state)
        )  # fmt: skip

    def _pseudo(self, state: State) -> tuple[Array, Array, Mask]:
        """Return misfits ``(k,)``, rows ``(k, P)`` and truth ``(k,)`` of priors, datum and the models' constraints."""
        params = state.params
        rows = np.zeros((len(self.pseudo), self.size))
        for k, one in enumerate(self.pseudo):
            rows[k, one.column] = 1.0 / one.sigma
        parts, true = [rows], [np.array([not one.held for one in self.pseudo], dtype=bool)]
        values = [np.array([(one.mean - params[one.column]) / one.sigma for one in self.pseudo], dtype=float)]
        for image, model in enumerate(state.models):
            known = model.constraints()
            if not len(known):
                continue
            wide = np.zeros((len(known), self.size))
            wide[:, self.columns_of(image)] = known.jacobian / known.sigma[:, None]
            parts.append(wide)
            values.append(known.residuals / known.sigma)
            true.append(~known.fictitious)
        return np.concatenate(values), np.vstack(parts), np.concatenate(true)

    # -- elimination -------------------------------------------------------------------------------------------------

    def eliminate(self, linear: Linear) -> tuple[Eliminated, ...]:
        """Return the rows of all points with the points factored out."""
        found = []
        for chunk in linear.layout.chunks:
            count, k = chunk.rays.shape
            points = linear.by_point[chunk.rays].reshape(count, 2 * k, 3)
            misfit = linear.ray_misfit[chunk.rays].reshape(count, 2 * k)
            if chunk.ground:
                points = np.concatenate([points, linear.ground_by_point[chunk.points]], axis=1)
                misfit = np.concatenate([misfit, linear.ground_misfit[chunk.points]], axis=1)
            q, r = np.linalg.qr(points)
            of_rays = q[:, : 2 * k].reshape(count, k, 2, 3).swapaxes(2, 3)
            turned = (of_rays @ linear.by_params[chunk.rays]).transpose(0, 2, 1, 3)
            turned = turned.reshape(count, 3, k * self.columns.shape[1])
            met = (q.swapaxes(1, 2) @ misfit[:, :, None])[:, :, 0]
            found.append(Eliminated(chunk, linear, q, r, turned, met, misfit))
        return tuple(found)

    def group_columns(self, chunk: Chunk, group: slice) -> tuple[Index, Mask]:
        """Return the parameters of the images of a group, and which of the padded columns they are."""
        padded = self.columns[chunk.images[group.start]].ravel()
        return padded[padded >= 0], padded >= 0

    def step(self, linear: Linear, damping: float = 0.0) -> tuple[LinearSolution, Array, tuple[Eliminated, ...]]:
        """Return the step of the parameters and its cofactors, that of the points ``(N, 3)``, and the factored rows."""
        eliminated = self.eliminate(linear)
        reduced = self._reduced(linear, eliminated)
        solution = reduced.solve(damping)
        shift = np.zeros((len(self.points), 3))
        padded = np.append(solution.values, 0.0)
        for rows in eliminated:
            taken = padded[self.columns[rows.chunk.images]].reshape(len(rows.chunk.points), rows.turned.shape[2], 1)
            right = rows.met - (rows.turned @ taken)[:, :, 0]
            shift[rows.chunk.points] = solve_triangular(rows.r, right)
        return solution, shift, eliminated

    def _reduced(
        self, linear: Linear, eliminated: Sequence[Eliminated], *, orthogonal: bool = True
    ) -> OrthogonalSystem | NormalSystem:
        """Return the system of the parameters alone."""
        total = linear.layout.observations + 3 * len(linear.layout.grounded) + len(linear.pseudo_misfit)
        if orthogonal and float(total) * self.size**2 <= _ORTHOGONAL_LIMIT:
            system = OrthogonalSystem(total, self.size)
            for rows in eliminated:
                for group in rows.chunk.groups:
                    columns, real = self.group_columns(rows.chunk, group)
                    free, left = rows.free(group)
                    system.add(columns, free[:, :, real].reshape(left.size, len(columns)), left.ravel())
            system.add(np.arange(self.size), linear.pseudo_rows, linear.pseudo_misfit)
            return system
        normal = NormalSystem(self.size)
        for image, used in enumerate(linear.layout.rays_of_image):
            columns = self.columns_of(image)
            design = linear.by_params[used][:, :, : len(columns)].reshape(2 * len(used), len(columns))
            normal.add(columns, design, linear.ray_misfit[used].ravel())
        for rows in eliminated:
            for group in rows.chunk.groups:
                columns, real = self.group_columns(rows.chunk, group)
                met = rows.met[group].ravel()
                turned = rows.turned[group][:, :, real].reshape(len(met), len(columns))
                normal.add(columns, turned, met, sign=-1.0)
        normal.add(np.arange(self.size), linear.pseudo_rows, linear.pseudo_misfit)
        return normal

    def changes(self, linear: Linear, step: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Return what a step changes to first order: rays ``(M, 2)``, ground ``(N, 3)``, pseudo-observations."""
        padded = np.append(step, 0.0)[self.columns[self.points.image]]
        rays = (linear.by_params @ padded[:, :, None])[:, :, 0]
        rays += (linear.by_point @ shift[self.points.point][:, :, None])[:, :, 0]
        ground = (linear.ground_by_point @ shift[:, :, None])[:, :, 0]
        return rays, ground, linear.pseudo_rows @ step

    def weakest(self, linear: Linear) -> Array:
        """Return the combination of parameters ``(P,)`` that is determined least, each in units of its own effect."""
        system = self._reduced(linear, self.eliminate(linear), orthogonal=False)
        vectors: Array = np.linalg.eigh(system.scaled)[1]
        return vectors[:, 0]

    def taken(self, rows: Eliminated, cofactors: Array) -> tuple[Array, Array]:
        """Return C A' Q ``(n, k p, 3)`` and Q' A C A' Q ``(n, 3, 3)`` for the points of a chunk."""
        product = np.zeros(rows.turned.swapaxes(1, 2).shape)
        for group in rows.chunk.groups:
            columns, real = self.group_columns(rows.chunk, group)
            part = cofactors[columns[:, None], columns] @ rows.turned[group][:, :, real].swapaxes(1, 2)
            product[group.start : group.stop, real] = part
        return product, rows.turned @ product

    def ground_covariance(self, solved: Solved, covariance: Array, factor: float) -> Array:
        """Return that of the points ``(N, 3, 3)`` in their own horizons, NaN for those that take no part.

        Parameters
        ----------
        covariance : ndarray (P, P)
            Of the parameters.
        factor : float
            Square of the factor of the sigmas of measurements.
        """
        found = np.full((len(self.points), 3, 3), np.nan)
        for rows in solved.eliminated:
            root = np.linalg.inv(rows.r)
            inner = factor * np.eye(3) + self.taken(rows, covariance)[1]
            found[rows.chunk.points] = root @ inner @ root.swapaxes(1, 2)
        axes = self.frame.horizons(self.frame.geodetic(solved.state.local))
        return axes @ found @ axes.swapaxes(1, 2)

    def unit_weight(self, solved: Solved) -> tuple[float | None, float]:
        """Return the standard error of unit weight (None without redundancy), and the degrees of freedom.

        What holds the datum, or is fictitious, is not an observation; the parameters that it decides are none, either.
        """
        linear, layout = solved.linear, solved.linear.layout
        true = linear.pseudo_true
        rows = linear.pseudo_rows[~true]
        effective = self.size - float(((rows @ solved.cofactors) * rows).sum())
        known = int(np.isfinite(self.known[layout.grounded]).sum())
        unknown = effective + 3 * sum(len(chunk.points) for chunk in layout.chunks)
        freedom = layout.observations + known + int(true.sum()) - unknown
        square = sum(float((part**2).sum()) for part in (linear.ray_misfit, linear.ground_misfit))
        square += float((linear.pseudo_misfit[true] ** 2).sum())
        # The effective number of parameters is a fraction; below half an observation there is none to spare.
        return (math.sqrt(square / freedom) if freedom > 0.5 else None), freedom

    # -- iteration ---------------------------------------------------------------------------------------------------

    def solve(self, start: State, selection: Selection) -> Solved:
        """Minimise the squared misfits.

        Raises
        ------
        NotConverged
            If no minimum is found.
        """
        found = self.attempt(start, selection)
        if not found.converged:
            raise NotConverged("the adjustment did not converge", remedy="give more control points or a simpler model")
        return found

    def attempt(self, start: State, selection: Selection) -> Solved:
        """Minimise the squared misfits by Gauss-Newton, damped where that does not descend; see `Solved.converged`.

        Raises
        ------
        NotConverged
            If nothing can be computed at the start.
        """
        layout = self.layout(selection)
        state, damping, steps = start, 0.0, Steps()
        square = self._square(state, layout, selection)
        if not math.isfinite(square):
            raise NotConverged("the start values put points outside of the models", remedy="give better start values")
        for iteration in range(1, _STEPS + 1):
            linear = self.linearise(state, layout, selection)
            solution, shift, eliminated = self.step(linear, damping)
            finite = np.isfinite(solution.values).all() and np.isfinite(shift).all()
            if not finite or (iteration == 1 and solution.condition > CONDITION_LIMIT):
                # In a valley without a bottom the iteration would only wander: the caller says what is undetermined.
                return Solved(linear, eliminated, solution.cofactors, max(solution.condition, CONDITION_LIMIT * 1.01))
            change = self._change(linear, solution.values, shift)
            promised, before = float(np.linalg.norm(change)), steps.length
            length = math.sqrt(square) + math.sqrt(layout.observations)
            # Close to the minimum steps are rounding: they do not get shorter any more, or do not descend.
            small = promised <= 1e-8 * length or (promised <= 1e-6 * length and promised > before / 4)
            if small and not damping:
                return Solved(linear, eliminated, solution.cofactors, solution.condition, iteration)
            whole = np.concatenate([solution.values, shift.ravel()])
            further = None if damping else steps.extrapolated(change, whole)
            ahead, after, move = self._descent(state, whole, further, square, layout, selection)
            if ahead is not None:
                if damping:
                    steps = Steps()
                else:
                    steps.made(change, whole, move)
                state, square = ahead, after
                damping = damping / 10 if damping > 1e-6 else 0.0
                continue
            steps = Steps()
            if damping:
                solution, shift, eliminated = self.step(linear)
                promised = float(np.linalg.norm(self._change(linear, solution.values, shift)))
            if promised <= 1e-4 * length:
                # Rounding of the ground hides what so small a step would gain.
                return Solved(linear, eliminated, solution.cofactors, solution.condition, iteration)
            damping = max(10 * damping, 1e-3)
            if damping > 1e8:
                break
        solution, _, eliminated = self.step(linear)
        return Solved(linear, eliminated, solution.cofactors, solution.condition, iteration, converged=False)

    def _change(self, linear: Linear, step: Array, shift: Array) -> Array:
        """Return what a step changes to first order, in sigmas, as one vector."""
        return np.concatenate([part.ravel() for part in self.changes(linear, step, shift)])

    def once(self, state: State, selection: Selection) -> tuple[Solved, State]:
        """Return one step's solution, with the misfits that it leaves to first order, and the state after it."""
        linear = self.linearise(state, self.layout(selection), selection)
        solution, shift, eliminated = self.step(linear)
        rays, ground, pseudo = self.changes(linear, solution.values, shift)
        left = replace(
            linear, ray_misfit=linear.ray_misfit - rays, ground_misfit=linear.ground_misfit - ground,
            pseudo_misfit=linear.pseudo_misfit - pseudo,
        )  # fmt: skip
        return Solved(left, eliminated, solution.cofactors, solution.condition), state.moved(solution.values, shift)

    def _descent(
        self, state: State, whole: Array, further: Array | None, square: float, layout: Layout, selection: Selection
    ) -> tuple[State | None, float, Array]:
        """Return the state after a move that descends: further than the step, the step, or a part of it."""
        moves = [] if further is None else [further]
        for move in (*moves, *(whole / 2.0**k for k in range(10))):
            try:
                ahead = state.moved(move[: self.size], move[self.size :].reshape(-1, 3))
                after = self._square(ahead, layout, selection)
            except InputError:  # a correction that cannot be inverted
                after = math.nan
            # Coordinates are rounded to a billionth of a metre: what is added to a square by that is not an ascent.
            if math.isfinite(after) and after <= square * (1 + 1e-8):
                return ahead, after, move
        return None, square, whole

    def square(self, state: State, selection: Selection) -> float:
        """Return the sum of the squared misfits at a state; infinite where something cannot be computed."""
        found = self._square(state, self.layout(selection), selection)
        return found if math.isfinite(found) else math.inf

    def _square(self, state: State, layout: Layout, selection: Selection) -> float:
        return float(sum((part**2).sum() for part in self.misfits(state, layout, selection)))
