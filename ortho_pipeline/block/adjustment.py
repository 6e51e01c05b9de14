"""Bundle adjustment: many images, of whatever models, and their points in one least-squares estimate.

Control points weigh in with their ground; the ground of check points is never seen, they tie images together and are
compared with their known ground afterwards; tie points have none. `equations` has the mathematics, `variances` the
sigmas of the observations, `reliability` the search for gross errors, `intersection` the start values of the points.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Mapping, Sequence, Set
from dataclasses import replace

import numpy as np

from ortho_pipeline.block.datum import HOLD, by_control, stated_accuracies, with_datum, with_start_errors
from ortho_pipeline.block.determination import (
    missing_most,
    naming_wrong_points,
    refuse_many_outside,
    refuse_too_few,
    refuse_undetermined,
    uncertain_images,
)
from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Pseudo, Selection, State
from ortho_pipeline.block.equations.solver import EXACT, NEAR, Solved, attempt
from ortho_pipeline.block.equations.unknowns import Mask, Ordering
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.record import record_of
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.heights.source import DemHeights, starts
from ortho_pipeline.block.intersection import frame_of, meet, models_of, predict
from ortho_pipeline.block.local_frame import GEODETIC, GroundFrame
from ortho_pipeline.block.points import BlockPoints, Index
from ortho_pipeline.block.reliability.blunders import find_blunders
from ortho_pipeline.block.reliability.datums import doubtful_datums
from ortho_pipeline.block.reliability.known_points import notices, outlying
from ortho_pipeline.block.reliability.poses import contradicted_poses
from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.block.shared.common_error import BlockCommonError
from ortho_pipeline.block.shared.priors import OWN, SharedPriors
from ortho_pipeline.block.shared.unknowns import SharedUnknowns
from ortho_pipeline.block.variances.components import Posterior
from ortho_pipeline.block.variances.grid import estimate, posterior, reweighed
from ortho_pipeline.block.variances.shared_errors import SharedByImage
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.estimation.spatial.shared_errors import SharedErrors
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import marks_warning
from ortho_pipeline.runtime.process_limits import one_blas_thread
from ortho_pipeline.surface.base import Surface

#: Parameters that move by more than this part of their sigma with the sigmas that were found are solved for again.
_MOVED, _WEIGHINGS = 0.02, 3
#: Part of the points that gross errors of their own may lead out of the models; where it is more, the block is tilted.
_ASTRAY = 0.05


@one_blas_thread()
def adjust(
    models: Mapping[str, SensorModel],
    points: BlockPoints,
    *,
    priors: Mapping[str, Mapping[str, Prior]] | None = None,
    robust: bool = True,
    hold: float | None = None,
    exclude: Collection[str] = (),
    heights: DemHeights | Surface | None = None,
    accuracies: Mapping[str, float] | None = None,
) -> BlockFit:
    """Adjust the models of all images and the ground of all points together.

    The result does not depend on the number of processors, to the last bit.

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
        where no control point and no prior defines the datum, and then as accurate as the metadata state, else 10 px;
        `BlockFit.gauge` says what did.
    exclude : collection of str
        Ids of points that take no part.
    heights : DemHeights or Surface, optional
        A DEM. Its height at each tie, and at each control point without a height, is an observation.
    accuracies : mapping of image name to float, optional
        Standard deviations (m, each axis in plan) that metadata state of models; by default those that RPCs state.

    Raises
    ------
    TooFewPoints, DegeneratePoints
        If parameters are not determined; the message names image and parameters.
    NotConverged

    Examples
    --------
    >>> points = op.read_block_points("sample_data/cartosat/points.csv")
    >>> models = {name: op.open_scene(f"sample_data/cartosat/{name}").model for name in points.images}
    >>> shifts = {name: op.ImageCorrection.identity(model, "shift", (0, 0)) for name, model in models.items()}
    >>> op.adjust(shifts, points).gauge
    'position and height come from 9 control points'
    """
    chosen = models_of(models, points)
    if unknown := sorted(set(exclude) - set(points.ids)):
        raise InputError(f"cannot exclude {unknown[0]!r}: no point has this id", field="exclude")
    # Rays of a point next to each other, and points next to those of the same images: memory is read as it lies.
    order = Ordering.of(points, np.ones(points.rays, dtype=bool), points.control).rays
    stated = points.of_rays(order)
    dem = None if heights is None else DemHeights.of(heights)
    problem, state, whole = _prepared(chosen, stated, priors or {}, exclude, dem)
    dem_heights = None if dem is None else Heights.under(dem, problem, state.local)
    if dem_heights is not None:
        problem = dem_heights.applied(problem)
    # What starts nowhere says nothing yet; where the images come right, it takes part.
    nowhere = np.asarray(~np.isfinite(state.local).all(axis=1))
    selection, notes = whole.without(nowhere, stated.point), list[Notice]()
    stated_by = stated_accuracies(models) if accuracies is None else _checked_accuracies(accuracies, points)
    problem, gauge = with_datum(problem, state, selection, hold, stated_by)
    _refuse_too_few(problem, nowhere, selection, whole)
    if problem.unstated.any():
        problem = _started(problem, state, selection)
    error = BlockCommonError.of(problem, state, selection)
    shared = SharedUnknowns(error, dem_heights, SharedPriors.of(problem, priors or {}))
    problem = shared.applied(problem)
    solved, inside, shared = _first(problem, state, selection, whole, shared, robust)
    rejected, near, searched = tuple[GrossError, ...](), solved.state, inside
    if robust and problem.size and solved.unit_weight()[1] >= 4:
        blunders = find_blunders(solved, inside)
        rejected, near = blunders.rejected, blunders.state
        if blunders.undecided:
            notes.append(_undecided(blunders.undecided))
        inside = blunders.kept
    if robust:
        problem = shared.applied(replace(solved.problem, pseudo=problem.pseudo))
        again = attempt(problem, near, inside)
        if shared.heights is not None and not again.converged:
            # Heights that were renewed once may have no minimum in reach. Stable ones have. The search has taken the
            # partials of the solution along.
            again, dem_heights = shared.heights.settled(attempt(solved.problem, solved.state, searched), inside)
            shared = replace(shared, heights=dem_heights)
        solved, inside = _checked(again, inside)
    gauge = gauge.replace(by_control(problem, selection), by_control(problem, inside))
    judged = _among(points, {one.point for one in rejected})
    solved, found, shared = _weighed(solved, inside, shared)
    inside = solved.without_astray(inside)
    notes += _without(points, ~_among(points, set(exclude)) & ~problem.active(inside) & ~judged)
    notes += [*found.variances.notes(), *marks_warning(points, problem.active(inside) & inside.ground)]
    notes += uncertain_images(solved, stated, shared.added(solved.cofactors)[0])
    fit = _result(solved, found, shared, inside, points, order, chosen, gauge, rejected, notes)
    adjusted = shared.adjusted_dem(fit.heights)
    warnings = (*fit.warnings, *doubtful_datums(fit, known := solved.problem.pseudo), *contradicted_poses(fit, known))
    return replace(fit, warnings=warnings, planes=solved.problem.heights, adjusted_dem=adjusted, accuracies=stated_by)


def _first(
    problem: BlockProblem,
    state: State,
    selection: Selection,
    whole: Selection,
    shared: SharedUnknowns,
    robust: bool,
) -> tuple[Solved, Selection, SharedUnknowns]:
    """Return the solution of everything, what takes part in it, and what is shared.

    If there is none, the points that rays miss most at the start come in when the others have come to rest.
    """
    with naming_wrong_points(problem, state, selection):
        try:
            return _first_of_all(problem, state, selection, whole, shared, robust)
        except (DegeneratePoints, NotConverged):
            _, wrong = missing_most(problem, state, selection)
            if robust and wrong.any():
                later = replace(state, local=np.where(wrong[:, None], np.nan, state.local))
                with contextlib.suppress(DegeneratePoints, NotConverged):
                    return _first_of_all(problem, later, selection, whole, shared, robust)
            raise


def _first_of_all(
    problem: BlockProblem,
    state: State,
    selection: Selection,
    whole: Selection,
    shared: SharedUnknowns,
    robust: bool,
) -> tuple[Solved, Selection, SharedUnknowns]:
    # The search for gross errors begins near the minimum as well as at it, but sigmas are found at it.
    tolerance = NEAR if robust and not problem.unstated.any() else EXACT
    solved = attempt(problem, state, whole, tolerance)
    held = _held(solved, state, selection, whole) if robust else None
    near = solved if held is None else held
    if near.astray is not None:
        refuse_many_outside(problem, near.astray, near.without_astray(whole), whole)
    solved, inside = _checked(solved, whole) if held is None else (held, held.without_astray(whole))
    solved, shared = shared.near(solved, inside)
    if problem.unstated.any():
        solved = reweighed(solved, inside, estimate(solved), tolerance)
    return solved, inside, shared


def _held(solved: Solved, start: State, selection: Selection, whole: Selection) -> Solved | None:
    """Return a solution to look for gross errors from, where many points are led out of the models; None elsewhere.

    Few control points leave a block so free that a gross error in one of them tilts it by hundreds of pixels. Held as
    near to its start values as vendors' orientations are, it says where the errors are.
    """
    problem = solved.problem
    if solved.astray is None or any(one.held for one in problem.pseudo):
        return None
    if solved.astray.sum() <= _ASTRAY * problem.active(whole).sum():
        return None
    held = attempt(with_datum(problem, start, selection, HOLD)[0], start, whole, NEAR)
    lost = 0 if held.astray is None else int(held.astray.sum())
    return held if held.converged and lost < solved.astray.sum() else None


def _refuse_too_few(problem: BlockProblem, nowhere: Mask, selection: Selection, whole: Selection) -> None:
    """Refuse images with too few points, and if these are few because the others have no place, say so."""
    try:
        refuse_too_few(problem, selection)
    except TooFewPoints:
        refuse_many_outside(problem, nowhere, selection, whole)
        raise


def _checked_accuracies(accuracies: Mapping[str, float], points: BlockPoints) -> Mapping[str, float]:
    for image, sigma in accuracies.items():
        if image not in points.images:
            raise InputError(f"there are no points of the image {image!r}", field="accuracies")
        if not 0 <= sigma < math.inf:
            raise InputError(f"the accuracy of {image!r} is {sigma}, not a number of metres", field="accuracies")
    return accuracies


def _among(points: BlockPoints, ids: Set[str]) -> Mask:
    """Return which points ``(N,)`` have one of these ids."""
    return np.fromiter((one in ids for one in points.ids), dtype=bool, count=len(points))


def _undecided(points: Sequence[str]) -> Notice:
    text = f"points contradict each other, but the block is not determined without them: {', '.join(points[:10])}"
    return Notice("undecided-contradiction", text, points=list(points))


def _prepared(
    models: tuple[SensorModel, ...],
    points: BlockPoints,
    priors: Mapping[str, Mapping[str, Prior]],
    exclude: Collection[str],
    dem: DemHeights | None = None,
) -> tuple[BlockProblem, State, Selection]:
    """Return the problem, its start, and what may take part; points whose rays do not meet yet are NaN."""
    frame = frame_of(models, points)
    known = np.full((len(points), 3), np.nan)
    plan = points.ground.copy()
    flat = ~np.isfinite(plan[:, 2])
    plan[flat, 2] = 0.0
    known[points.control] = ground_transform(points.crs, GEODETIC)(plan[points.control])
    known[flat, 2] = np.nan
    takes_part = ~_among(points, set(exclude))
    rays = takes_part[points.point]
    problem = BlockProblem(points, models, frame, known, pseudo_of(models, points, priors))
    on_dem = np.full((len(points), 3), np.nan) if dem is None else starts(dem, problem, rays)
    elsewhere = np.isnan(on_dem)
    local = np.where(elsewhere, meet(frame, models, points, rays & elsewhere[points.point, 0]), on_dem)
    local = _at_known(problem, local, rays)
    seen = rays & np.isfinite(predict(frame, models, points, local)).all(axis=1)
    ground = points.control & takes_part
    nowhere = ~problem.active(Selection.of(seen, ground))
    local[nowhere] = np.nan
    return problem, State(models, local), Selection.of(seen | (rays & nowhere[points.point]), ground)


def _without(points: BlockPoints, lost: Mask) -> list[Notice]:
    """Return notices of points that take no part, by their roles; matches that check do so in one image."""
    notes = []
    matched = np.zeros(len(points), dtype=bool)
    matched[points.point[points.grouped >= 0]] = True
    lost = lost & ~(points.check & matched)
    for role in ("control", "check", "tie"):
        names = [points.ids[i] for i in np.flatnonzero(lost & (points.roles == role))]
        if names:
            some = ", ".join(names[:10]) + (" ..." if len(names) > 10 else "")
            who = counted(len(names), f"{role} point takes", f"{role} points take")
            text = (
                f"{who} no part (fewer rays than needed, rays that do not meet or are parallel, or outside of the "
                f"models): {some}" + ("; their known ground is not tested" if role == "check" else "")
            )
            notes.append(Notice("takes-no-part", text, role=role, count=len(names), points=names[:10]))
    return notes


def _at_known(problem: BlockProblem, local: Array, rays: Mask) -> Array:
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


def pseudo_of(
    models: Sequence[SensorModel], points: BlockPoints, priors: Mapping[str, Mapping[str, Prior]]
) -> tuple[Pseudo, ...]:
    """Return what is known of the parameters of images ``(P,)`` by themselves."""
    found, begin = [], 0
    strangers = sorted(set(priors) - set(points.images))
    if strangers:
        raise InputError(f"a prior is for the image {strangers[0]!r}, which is not in the block", field="priors")
    for image, model in zip(points.images, models, strict=True):
        names = list(model.param_names)
        for name, prior in priors.get(image, {}).items():
            if name not in names:
                raise InputError(
                    f"a prior is for the parameter {name!r}, which the model of {image!r} does not have",
                    field="priors",
                    remedy=f"its parameters are {', '.join(names) or 'none'}",
                )
            # What images share is one unknown (`SharedPriors`).
            sigma = OWN * prior.sigma if prior.shared else prior.sigma
            found.append(Pseudo(begin + names.index(name), prior.mean, sigma))
        begin += len(names)
    return tuple(found)


def _started(problem: BlockProblem, state: State, selection: Selection) -> BlockProblem:
    """Return the problem with a first guess of sigmas that are not stated: a pixel on the ground."""
    linear = Linear.at(problem, state, selection)
    lengths = np.linalg.norm(linear.by_point, axis=2)
    seen = lengths.any(axis=1)
    sigma = np.median(1.0 / (lengths[seen].max(axis=1) * problem.points.sigma_image[seen])) if seen.any() else 1.0
    return replace(problem, assumed=(float(sigma), float(sigma)))


def _weighed(solved: Solved, selection: Selection, shared: SharedUnknowns) -> tuple[Solved, Posterior, SharedUnknowns]:
    """Return the solution with the sigmas that the observations have, what is known of these, and what is shared."""
    solved, shared = shared.settled(solved, selection)
    settled, found = solved, posterior(solved)
    for _ in range(_WEIGHINGS):
        if found.moved <= _MOVED:
            break
        before = solved
        solved = reweighed(solved, selection, found.variances)
        if solved is before:
            break
        found = posterior(solved)
    if solved is not settled or shared.error is not None:
        before = solved
        solved, shared = shared.settled(solved, selection)
        found = found if solved is before else posterior(solved)
    return solved, found, shared


def _checked(solved: Solved, selection: Selection) -> tuple[Solved, Selection]:
    """Return a solution and what takes part in it: not points whose rays lead out of the models.

    Raises
    ------
    DegeneratePoints
        If the points leave parameters open, also where that is why no solution is found.
    NotConverged
    """
    refuse_undetermined(solved)
    if not solved.converged:
        uncertain_images(solved, solved.problem.points)
        raise NotConverged(
            "the adjustment did not converge",
            file=solved.problem.points.source or None,
            remedy="give more control points, spread in plan and height, or a simpler model or correction",
        )
    return solved, solved.without_astray(selection)


def _result(
    solved: Solved,
    found: Posterior,
    unknowns: SharedUnknowns,
    selection: Selection,
    points: BlockPoints,
    order: Index,
    start: tuple[SensorModel, ...],
    gauge: str,
    rejected: tuple[GrossError, ...],
    notes: list[Notice],
) -> BlockFit:
    """Return what is told of `points`, whose rays the solution has in an `order`."""
    problem, state = solved.problem, solved.state
    sigma0, freedom = solved.unit_weight()
    active = problem.active(selection)
    used = np.zeros(points.rays, dtype=bool)
    used[order] = selection.rays & active[points.point[order]]
    variances = replace(found.variances, image=found.variances.image * problem.factor_of(points.of_rays(order)))
    common, heights = unknowns.error, unknowns.heights
    covariance, ground_covariance, shared = _covariances(solved, found, common)
    # Points that take no part still have a place where their rays meet, if they do.
    local = np.where(active[:, None], state.local, np.nan)
    # What is a tie is not compared with anything, whatever the file says of its ground.
    stated = np.where(points.tie[:, None], np.nan, points.known_in(GEODETIC))
    known = stated if common is None else common.corrected(stated)
    object_residuals = problem.frame.apart(known, local)
    used_ground = selection.ground & active
    covariance, of_points, of_others = unknowns.added(covariance)
    taken = None if heights is None else record_of(heights, solved)
    # Points that share an error lie to each other as if there were none.
    apart = (points.sigma_common == 0)[:, None, None]
    ground_covariance = ground_covariance + of_others
    doubts = outlying(solved, variances, object_residuals, ground_covariance + apart * of_points, used_ground)
    return BlockFit(
        models=dict(zip(points.images, state.models, strict=True)),
        start=dict(zip(points.images, start, strict=True)),
        points=points,
        ground=problem.frame.geodetic(local),
        ground_covariance=ground_covariance + of_points,
        residuals=points.measured - predict(problem.frame, state.models, points, local),
        back_projected=_reprojected(problem.frame, points, state.models, known),
        raw_residuals=_reprojected(problem.frame, points, start, stated),
        object_residuals=object_residuals,
        used_rays=used,
        used_ground=used_ground,
        parameters=_parameters(points, state.models),
        cofactors=covariance,
        redundancy=math.floor(freedom + 1e-6),
        degrees_of_freedom=freedom,
        sigma0=None if sigma0 is None else variances.image,
        variances=variances,
        gauge=gauge,
        common_error=common,
        heights=taken,
        shared_errors=shared,
        shared_priors=unknowns.priors,
        rejected=rejected,
        outlying=doubts,
        warnings=(*notices(doubts, points, object_residuals), *notes, *([] if taken is None else taken.notices())),
        condition=solved.condition,
        iterations=solved.iterations,
    )


def _parameters(points: BlockPoints, models: Sequence[SensorModel]) -> tuple[tuple[str, str], ...]:
    """Return image and name of each parameter."""
    named = zip(points.images, models, strict=True)
    return tuple((image, name) for image, model in named for name in model.param_names)


def _covariances(
    solved: Solved, found: Posterior, common: BlockCommonError | None
) -> tuple[Cofactors, Array, Mapping[str, SharedErrors]]:
    """Return covariances of parameters and ground without what all known points share, and what neighbours share."""
    shared = SharedByImage.of(solved, common)
    covariance = with_start_errors(solved.linear, found.covariance)
    if shared is not None:
        covariance = shared.added(covariance)
    plain = solved.ground_covariance(found.covariance, found.image_square)
    ground = plain.copy()
    ground[found.rows] = found.ground
    if covariance is not found.covariance:
        ground += solved.ground_covariance(covariance, found.image_square) - plain
    return covariance, ground, {} if shared is None else shared.images


def _reprojected(frame: GroundFrame, points: BlockPoints, models: Sequence[SensorModel], ground: Array) -> Array:
    """Return the reprojection residuals ``(M, 2)`` of known ground ``(N, 3)`` lon, lat, h."""
    return points.measured - predict(frame, models, points, frame.of_geodetic(ground))
