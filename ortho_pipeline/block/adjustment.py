"""Bundle adjustment: many images, of whatever models, and their points in one least-squares estimate.

`ortho_pipeline.block.solver` has the mathematics, `ortho_pipeline.block.blunders` the search for gross errors,
`ortho_pipeline.block.intersection` the start values of the points.

Control points weigh in with their ground; the ground of check points is never seen, they tie images together and are
compared with their known ground afterwards; tie points have none.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline.block.blunders import Rejected, find_blunders
from ortho_pipeline.block.checks import Outlying, outlying
from ortho_pipeline.block.intersection import frame_of, meet, models_of, predict, sigmas_of
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.solver import BlockProblem, Pseudo, Selection, Solved, State
from ortho_pipeline.block.variance_components import Posterior, Variances, estimate, posterior, reweighed
from ortho_pipeline.display.notebook import block_html
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, TooFewPoints, counted
from ortho_pipeline.estimation.fit import EXTRAPOLATION_LIMIT, EXTRAPOLATION_WARNING, root_mean_square
from ortho_pipeline.estimation.problem import CONDITION_LIMIT, Prior
from ortho_pipeline.files.documents import json_value
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import marks_warning
from ortho_pipeline.points.rows import ROLES

__all__ = ["BlockFit", "BlockPoints", "Rejected", "adjust"]

#: Without any control, each parameter is held at its start value by its effect in the image, with this sigma (px): the
#: size of what vendors' orientations are off by.
HOLD = 10.0
#: Parameters that move by more than this part of their sigma with the sigmas that were found are solved for again.
_MOVED, _WEIGHINGS = 0.02, 3


@dataclass(frozen=True, eq=False)
class BlockFit:
    """Result of a bundle adjustment of N points, M rays and P parameters.

    Residuals are measured minus predicted in pixels ``(M, 2)``: `residuals` at the adjusted ground, `back_projected`
    at the known ground (NaN for ties), `raw_residuals` the same with the models as they were. `object_residuals`
    ``(N, 3)`` are known minus adjusted ground in metres east, north, up. `ground` is lon, lat, h (EPSG:4979), NaN where
    the rays do not determine it; `ground_covariance` ``(N, 3, 3)`` m², east, north, up. `parameters` are (image, name)
    in the order of `covariance` ``(P, P)``. `sigma0` is the factor of the stated sigmas of measurements (None without
    redundancy), `variances` has it beside the sigmas of ground that states none. Covariances contain that these are
    uncertain, so that 1.96 sigmas are right 95 times of 100 with few points too. `outlying` are known points that the
    block contradicts and that were left as they are.
    """

    models: dict[str, SensorModel]
    start: dict[str, SensorModel]
    points: BlockPoints
    ground: Array
    ground_covariance: Array
    residuals: Array
    back_projected: Array
    raw_residuals: Array
    object_residuals: Array
    used_rays: np.ndarray
    used_ground: np.ndarray
    parameters: tuple[tuple[str, str], ...]
    covariance: Array
    redundancy: int
    degrees_of_freedom: float
    sigma0: float | None
    gauge: str
    variances: Variances
    rejected: tuple[Rejected, ...] = ()
    outlying: tuple[Outlying, ...] = ()
    warnings: tuple[Notice, ...] = ()
    condition: float = 1.0
    iterations: int = 0

    def __repr__(self) -> str:
        found = self.object_rms()
        checks = (
            f"; RMSE {found['plan']:.2f} m, height {found['h']:.2f} m at {counted(found['n'], 'check point')}"
            if found
            else ""
        )
        sigma0 = "unknown" if self.sigma0 is None else f"{self.sigma0:.3g}"
        size = f"{counted(len(self.models), 'image')}, {counted(len(self.points), 'point')}"
        return f"<block of {size}: sigma0 {sigma0}{checks}>"

    def _repr_html_(self) -> str:
        return block_html(self.to_json())

    @property
    def values(self) -> Array:
        """Adjusted parameters ``(P,)``."""
        return np.concatenate([np.zeros(0), *(model.params for model in self.models.values())])

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the parameters ``(P,)``."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def ground_sigmas(self) -> Array:
        """Standard deviations of the adjusted ground ``(N, 3)``: metres east, north, up."""
        return sigmas_of(self.ground_covariance)

    def ground_in(self, crs: str | pyproj.CRS) -> Array:
        """Return the adjusted ground ``(N, 3)`` in another CRS (EPSG:4978 is geocentric)."""
        return ground_transform(GEODETIC, crs)(self.ground)

    def known_in(self, crs: str | pyproj.CRS) -> Array:
        """Return the known ground ``(N, 3)`` in another CRS; NaN for ties."""
        return self.points.known_in(crs)

    def image_rms(self, image: str, role: str, which: str = "back_projected") -> dict[str, float | int] | None:
        """Return root mean squares (px) of an image over points of a role; None where there is none.

        Parameters
        ----------
        which : {'back_projected', 'residuals', 'raw_residuals'}
        """
        if which not in ("back_projected", "residuals", "raw_residuals"):
            raise InputError(f"there are no residuals {which!r}", field="which")
        rays = self.points.image == self.points.images.index(image)
        rays &= self.points.roles[self.points.point] == role
        if role == "control" or which == "residuals":
            rays &= self.used_rays
        if role == "control" and which != "residuals":
            rays &= self.used_ground[self.points.point]
        values = getattr(self, which)[rays]
        return root_mean_square(values[np.isfinite(values).all(axis=1)])

    def object_rms(self, role: str = "check") -> dict[str, Any] | None:
        """Return root mean squares, least and greatest of the object-space residuals (m) of a role; None for none."""
        values = self.object_residuals[self.points.roles == role]
        values = values[np.isfinite(values).all(axis=1)]
        if not len(values):
            return None
        east, north, up = np.sqrt((values**2).mean(axis=0)).tolist()
        return {
            "x": east, "y": north, "h": up, "plan": math.hypot(east, north), "n": len(values),
            "min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist(),
        }  # fmt: skip

    def to_json(self) -> dict[str, Any]:
        """Return the section ``adjustment`` of the block's document (docs/formats/block-points.md)."""
        points = self.points
        values = dict(zip(self.parameters, zip(self.values, self.sigmas, strict=True), strict=True))
        return {
            "gauge": self.gauge,
            "sigma0": self.sigma0,
            "redundancy": self.redundancy,
            "degrees_of_freedom": self.degrees_of_freedom,
            "condition": json_value(self.condition),
            "iterations": self.iterations,
            "variances": self.variances.to_json(),
            "images": {
                image: {
                    "parameters": {
                        name: {"value": float(value), "sigma": float(sigma)}
                        for (of, name), (value, sigma) in values.items()
                        if of == image
                    },
                    "rays": int((self.used_rays & (points.image == k)).sum()),
                    "rms": {
                        which: {role: self.image_rms(image, role, which) for role in ROLES}
                        for which in ("residuals", "back_projected", "raw_residuals")
                    },
                }
                for k, image in enumerate(points.images)
            },
            "object_rms": {role: self.object_rms(role) for role in ("control", "check")},
            "points": [self._point(k) for k in range(len(points))],
            "rays": [self._ray(k) for k in range(points.rays)],
            "rejected": [asdict(one) for one in self.rejected],
            "outlying": [asdict(one) for one in self.outlying],
            **to_document(self.warnings),
        }

    def _point(self, k: int) -> dict[str, Any]:
        points = self.points
        return {
            "id": points.ids[k],
            "role": str(points.roles[k]),
            "used_ground": bool(self.used_ground[k]),
            "ground": json_value(self.ground[k]),
            "sigma": json_value(np.sqrt(np.diag(self.ground_covariance[k]))),
            "residual": json_value(self.object_residuals[k]),
        }

    def _ray(self, k: int) -> dict[str, Any]:
        points = self.points
        return {
            "id": points.ids[points.point[k]],
            "image": points.images[points.image[k]],
            "used": bool(self.used_rays[k]),
            "measured": json_value(points.measured[k]),
            "residual": json_value(self.residuals[k]),
            "back_projected": json_value(self.back_projected[k]),
        }


def adjust(
    models: Mapping[str, SensorModel],
    points: BlockPoints,
    *,
    priors: Mapping[str, Mapping[str, Prior]] | None = None,
    robust: bool = True,
    hold: float | None = None,
    exclude: Collection[str] = (),
) -> BlockFit:
    """Adjust the models of all images and the ground of all points together.

    Parameters
    ----------
    models : mapping of image name to SensorModel
        Start values; of any kinds and CRSs. Models without parameters stay as they are.
    points : BlockPoints
    priors : mapping of image name to mapping of parameter name to Prior, optional
        What is known of parameters; the constraints that models bring are always used.
    robust : bool
        Look for gross errors and leave them out.
    hold : float, optional
        Sigma in pixels of effect with which parameters without a prior are held at their start values. By default only
        where no control point and no prior defines the datum, and then 10 px; `BlockFit.gauge` says what did.
    exclude : collection of str
        Ids of points that take no part.

    Raises
    ------
    TooFewPoints, DegeneratePoints
        If parameters are not determined; the message names image and parameters.
    NotConverged
    """
    chosen = models_of(models, points)
    unknown = sorted(set(exclude) - set(points.ids))
    if unknown:
        raise InputError(f"there is no point {unknown[0]!r} to leave out", field="exclude")
    problem, state, selection, notes = _prepared(chosen, points, priors or {}, exclude)
    problem, gauge = _with_datum(problem, state, selection, hold)
    _enough(problem, selection)
    if problem.unstated.any():
        problem = _started(problem, state, selection)
    solved = _solved(problem, state, selection)
    if problem.unstated.any():
        problem, solved = reweighed(problem, solved, selection, estimate(problem, solved))
    rejected: tuple[Rejected, ...] = ()
    if robust and problem.size and problem.unit_weight(solved)[1] >= 4:
        blunders = find_blunders(problem, solved, selection)
        rejected = blunders.rejected
        if blunders.undecided:
            notes.append(_undecided(blunders.undecided))
        if rejected:
            gauge = gauge.replace(_by_control(problem, selection), _by_control(problem, blunders.kept))
            selection = blunders.kept
            solved = _solved(problem, solved.state, selection)
    problem, solved, found = _weighed(problem, solved, selection)
    notes += found.variances.notes()
    notes += marks_warning(points.select(problem.active(selection) & selection.ground))
    notes += _uncertain(problem, solved, points)
    return _result(problem, solved, found, selection, points, chosen, gauge, rejected, notes)


def _undecided(points: Sequence[str]) -> Notice:
    text = f"points contradict each other, and without them the block is not determined: {', '.join(points[:10])}"
    return Notice("undecided-contradiction", text, points=list(points))


# -- before ----------------------------------------------------------------------------------------------------------


def _prepared(
    models: tuple[SensorModel, ...],
    points: BlockPoints,
    priors: Mapping[str, Mapping[str, Prior]],
    exclude: Collection[str],
) -> tuple[BlockProblem, State, Selection, list[Notice]]:
    """Return the problem, its start, what takes part, and what people ought to know of that."""
    frame = frame_of(models, points)
    known = np.full((len(points), 3), np.nan)
    plan = points.ground.copy()
    flat = ~np.isfinite(plan[:, 2])
    plan[flat, 2] = 0.0
    known[points.control] = ground_transform(points.crs, GEODETIC)(plan[points.control])
    known[flat, 2] = np.nan
    takes_part = ~np.isin(np.array(points.ids, dtype=object), list(exclude))
    rays = takes_part[points.point]
    local = meet(frame, models, points, rays)
    problem = BlockProblem(points, models, frame, known, _priors(models, points, priors))
    local = _at_known(problem, local, rays)
    rays &= np.isfinite(points.measured - predict(frame, models, points, local)).all(axis=1)
    selection = Selection.of(rays, points.control & takes_part)
    notes = []
    lost = takes_part & ~problem.active(selection)
    for role in ("control", "check", "tie"):
        names = [points.ids[i] for i in np.flatnonzero(lost & (points.roles == role))]
        if names:
            some = ", ".join(names[:10]) + (" ..." if len(names) > 10 else "")
            text = (
                f"{counted(len(names), f'{role} point takes', f'{role} points take')} no part (fewer rays than "
                "needed, rays that do not meet or are "
                f"parallel, or outside of the models): {some}"
                + ("; whether their known ground is right is not tested" if role == "check" else "")
            )
            notes.append(Notice("takes-no-part", text, role=role, count=len(names), points=names[:10]))
    return problem, State(models, local), selection, notes


def _at_known(problem: BlockProblem, local: Array, rays: np.ndarray) -> Array:
    """Return the start ``(N, 3)`` of the points: control where it is known to be, at the height that its rays say."""
    points, known = problem.points, problem.known
    local = local.copy()
    exact = np.isfinite(known).all(axis=1)
    local[exact] = problem.target[exact]
    heights = problem.frame.geodetic(local)[:, 2]
    for number in np.flatnonzero(points.control & ~exact):
        place = known[number].copy()
        mine = np.flatnonzero(rays & (points.point == number))
        if not np.isfinite(heights[number]) and len(mine):
            heights[number] = problem.models[points.image[mine[0]]].reference_height
        place[2] = heights[number]
        local[number] = problem.frame.of_geodetic(place[None])[0]
    return local


def _priors(
    models: Sequence[SensorModel], points: BlockPoints, priors: Mapping[str, Mapping[str, Prior]]
) -> tuple[Pseudo, ...]:
    found, begin = [], 0
    strangers = sorted(set(priors) - set(points.images))
    if strangers:
        raise InputError(f"a prior names the image {strangers[0]!r}, which there is not", field="priors")
    for image, model in zip(points.images, models, strict=True):
        names = list(model.param_names)
        for name, prior in priors.get(image, {}).items():
            if name not in names:
                raise InputError(
                    f"a prior names the parameter {name!r}, which the model of {image!r} does not have", field="priors",
                    remedy=f"its parameters are {', '.join(names) or 'none'}",
                )  # fmt: skip
            found.append(Pseudo(begin + names.index(name), prior.mean, prior.sigma))
        begin += len(names)
    return tuple(found)


def _with_datum(
    problem: BlockProblem, state: State, selection: Selection, hold: float | None
) -> tuple[BlockProblem, str]:
    """Return the problem with a datum, and what defines it."""
    control = int((problem.active(selection) & selection.ground).sum())
    if hold is not None and not hold > 0:
        raise InputError("a standard deviation is positive", field="hold")
    if not problem.size:
        return problem, "nothing is adjusted but the points: the models stay as they are"
    if hold is None and control:
        return problem, _by_control(problem, selection)
    # Fictitious constraints hold the shape of an orbit together, not where it is.
    known = bool(problem.pseudo) or any((~model.constraints().fictitious).any() for model in state.models)
    if hold is None and known:
        linear = problem.linearise(state, problem.layout(selection), selection)
        if problem.step(linear)[0].condition <= CONDITION_LIMIT:
            return problem, "no control points: the datum is that of the priors and constraints of the models"
    sigma = HOLD if hold is None else hold
    held = _held(problem, state, selection, sigma)
    why = f"{counted(control, 'control point')} and" if control else "no control points:"
    right = "" if control else "; positions on the ground are as right as these values are"
    return problem.with_pseudo(held), (
        f"{why} the orientation is held at its start values with a sigma of {sigma:g} px of effect in the image for "
        f"each parameter ({len(held)} of {problem.size}){right}"
    )


def _by_control(problem: BlockProblem, selection: Selection) -> str:
    number = int((problem.active(selection) & selection.ground).sum())
    return f"the datum is that of {counted(number, 'control point')}"


def _held(problem: BlockProblem, state: State, selection: Selection, sigma: float) -> list[Pseudo]:
    """Return a pseudo-observation for each parameter without a prior, as strong as its effect (px) in its image."""
    linear = problem.linearise(state, problem.layout(selection), selection)
    known = {one.column for one in problem.pseudo}
    found = []
    params = state.params
    for image, used in enumerate(linear.layout.rays_of_image):
        partials = linear.by_params[used] * problem.points.sigma_image[used][:, None, None]
        effect = np.sqrt((partials**2).sum(axis=1).mean(axis=0)) if len(used) else []
        for column, size in zip(problem.columns_of(image), effect, strict=False):
            if int(column) not in known and size > 0:
                found.append(Pseudo(int(column), float(params[column]), sigma / float(size), held=True))
    return found


def _enough(problem: BlockProblem, selection: Selection) -> None:
    """Refuse images with fewer equations than parameters, by name."""
    points = problem.points
    rays = selection.rays & problem.active(selection)[points.point]
    if not rays.any():
        raise TooFewPoints(
            "no point was measured in two images, or in one with known ground", file=points.source or None,
            remedy="points of one id are one point: check the ids and the names of the images",
        )  # fmt: skip
    for image, model in enumerate(problem.models):
        columns = problem.columns_of(image)
        measured = int((rays & (points.image == image)).sum())
        known = len(model.constraints()) + sum(int(one.column) in columns for one in problem.pseudo)
        least = math.ceil((len(columns) - known) / 2)
        if 2 * measured + known < len(columns):
            raise TooFewPoints(
                f"{counted(measured, 'point')} in the image {points.images[image]!r} cannot determine its "
                f"{counted(len(columns), 'parameter')}",
                file=points.source or None,
                remedy=f"measure at least {counted(least, 'point')} in it, or take a simpler model",
            )


def _started(problem: BlockProblem, state: State, selection: Selection) -> BlockProblem:
    """Return the problem with a first guess of sigmas that are not stated: a pixel on the ground."""
    linear = problem.linearise(state, problem.layout(selection), selection)
    lengths = np.linalg.norm(linear.by_point, axis=2)
    seen = lengths.any(axis=1)
    sigma = np.median(1.0 / (lengths[seen].max(axis=1) * problem.points.sigma_image[seen])) if seen.any() else 1.0
    return replace(problem, assumed=(float(sigma), float(sigma)))


def _weighed(problem: BlockProblem, solved: Solved, selection: Selection) -> tuple[BlockProblem, Solved, Posterior]:
    """Return problem and solution with the sigmas that the observations have, and what is known of these."""
    found = posterior(problem, solved)
    for _ in range(_WEIGHINGS):
        if found.moved <= _MOVED:
            break
        before = problem
        problem, solved = reweighed(problem, solved, selection, found.variances)
        if problem is before:
            break
        found = posterior(problem, solved)
    return problem, solved, found


def _solved(problem: BlockProblem, state: State, selection: Selection) -> Solved:
    """Return the solution; refuse a block whose points leave parameters open, also where that is why none is found."""
    solved = problem.attempt(state, selection)
    _determined(problem, solved)
    if not solved.converged:
        _uncertain(problem, solved, problem.points)
        raise NotConverged(
            "the adjustment did not converge", file=problem.points.source or None,
            remedy="give more control points, spread in plan and height, or a simpler model or correction",
        )  # fmt: skip
    return solved


# -- after -----------------------------------------------------------------------------------------------------------


def _determined(problem: BlockProblem, solved: Solved) -> None:
    """Refuse a block whose points leave parameters open, and name these."""
    if solved.condition <= CONDITION_LIMIT or not problem.size:
        return
    names = _weakest(problem, solved)
    raise DegeneratePoints(
        f"the points do not determine {names} (condition {solved.condition:.1e})", file=problem.points.source or None,
        remedy="give control points that are spread over the images, take a simpler model or correction, or hold the "
        "orientation near its start values",
    )  # fmt: skip


def _weakest(problem: BlockProblem, solved: Solved) -> str:
    """Return the names of the parameters that the least determined combination consists of, by image."""
    vector = np.abs(problem.weakest(solved.linear))
    strong = np.flatnonzero(vector >= 0.3 * vector.max())
    parts = []
    for image, name in enumerate(problem.points.images):
        columns = problem.columns_of(image)
        mine = [problem.models[image].param_names[k - columns[0]] for k in strong if k in columns]
        if mine:
            parts.append(f"{', '.join(mine)} of the image {name!r}")
    shown = "; ".join(parts[:4])
    return f"{shown}; and those of {counted(len(parts) - 4, 'more image')}" if len(parts) > 4 else shown


def _uncertain(problem: BlockProblem, solved: Solved, stated: BlockPoints) -> list[Notice]:
    """Refuse images that are far less certain where their own points are than these, and warn of uncertain corners.

    Points count as measured as they were `stated` even where they turned out better: constraints of the models are
    stated too, and bound what is known of the images.
    """
    found, held = [], any(one.held for one in problem.pseudo)
    for image, model in enumerate(solved.state.models):
        columns = problem.columns_of(image)
        used = solved.linear.layout.rays_of_image[image]
        partials = solved.linear.by_params[used][:, :, : len(columns)]
        if not len(columns) or not len(used):
            continue
        cofactors = solved.cofactors[np.ix_(columns, columns)]
        of_image = problem.points.image == image
        measured = float(np.median(problem.points.sigma_image[of_image]))
        sigma = max(measured, float(np.median(stated.sigma_image[of_image])))
        inside = float(np.sqrt(np.median(((partials @ cofactors) * partials).sum(axis=2)))) * measured / sigma
        name = problem.points.images[image]
        if inside > EXTRAPOLATION_LIMIT and not held:
            raise DegeneratePoints(
                f"the points do not determine the image {name!r}: at its own points it is {inside:.0f} times less "
                "certain than these were measured", file=problem.points.source or None,
                remedy="give more control points in it, spread in plan and height, or take a simpler model",
            )  # fmt: skip
        at_corners = model.param_partials(model.corners)
        at_corners = at_corners[np.isfinite(at_corners).all(axis=(1, 2))]
        spread = np.sqrt(((at_corners @ cofactors) * at_corners).sum(axis=2))
        factor = float(spread.max(initial=0.0)) / sigma
        if factor > EXTRAPOLATION_WARNING and not held:
            text = f"at a corner {factor:.0f} times less certain than a measured point"
            found.append(Notice("uncertain-at-edge", text, factor=factor).in_image(name))
    return found


def _result(
    problem: BlockProblem,
    solved: Solved,
    found: Posterior,
    selection: Selection,
    points: BlockPoints,
    start: tuple[SensorModel, ...],
    gauge: str,
    rejected: tuple[Rejected, ...],
    notes: list[Notice],
) -> BlockFit:
    state = solved.state
    sigma0, freedom = problem.unit_weight(solved)
    active = problem.active(selection)
    used = selection.rays & active[points.point]
    variances = replace(found.variances, image=found.variances.image * problem.factor_of(points))
    ground_covariance = problem.ground_covariance(solved, found.covariance, found.image_square)
    ground_covariance[found.rows] = found.ground
    # Points that take no part still have a place where their rays meet, if they do.
    local = np.where(active[:, None], state.local, np.nan)
    ground = problem.frame.geodetic(local)
    # What is a tie is not compared with anything, whatever the file says of its ground.
    known = np.where(points.tie[:, None], np.nan, points.known_in(GEODETIC))
    apart = problem.frame.of_geodetic(known) - local
    object_residuals = (problem.frame.horizons(known) @ apart[:, :, None])[:, :, 0]
    used_ground = selection.ground & active
    doubts = outlying(problem, solved, variances, object_residuals, ground_covariance, used_ground)
    return BlockFit(
        models=dict(zip(points.images, state.models, strict=True)),
        start=dict(zip(points.images, start, strict=True)),
        points=points,
        ground=ground,
        ground_covariance=ground_covariance,
        residuals=points.measured - predict(problem.frame, state.models, points, local),
        back_projected=_at(problem, state.models, known),
        raw_residuals=_at(problem, start, known),
        object_residuals=object_residuals,
        used_rays=used,
        used_ground=used_ground,
        parameters=tuple(
            (image, name)
            for image, model in zip(points.images, state.models, strict=True)
            for name in model.param_names
        ),
        covariance=found.covariance,
        redundancy=math.floor(freedom + 1e-6),
        degrees_of_freedom=freedom,
        sigma0=None if sigma0 is None else variances.image,
        variances=variances,
        gauge=gauge,
        rejected=rejected,
        outlying=doubts,
        warnings=(*(one.notice() for one in doubts), *notes),
        condition=solved.condition,
        iterations=solved.iterations,
    )


def _at(problem: BlockProblem, models: Sequence[SensorModel], ground: Array) -> Array:
    """Return measured minus the projection of known ground ``(N, 3)`` lon, lat, h."""
    local = problem.frame.of_geodetic(ground)
    return problem.points.measured - predict(problem.frame, models, problem.points, local)
