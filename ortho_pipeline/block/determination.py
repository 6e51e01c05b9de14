"""Determination of the parameters: blocks whose points leave images open are refused, with names and a remedy."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.elimination import weakest
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.intersection import predict
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import DegeneratePoints, NotConverged, TooFewPoints
from ortho_pipeline.errors.texts import Text, counted
from ortho_pipeline.estimation.determinacy import EXTRAPOLATION_LIMIT, EXTRAPOLATION_WARNING
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models.base import Array

#: At the start, rays that miss their point by so many times the median, and their own sigma, may be wrong.
_FAR, _SURE = 2.0, 20.0
#: Part of the points beyond which it is not they that are wrong, but where the images lie.
_MOST = 0.5
#: Points that an error names.
_NAMED = 10


@contextlib.contextmanager
def naming_wrong_points(problem: BlockProblem, start: State, selection: Selection) -> Iterator[None]:
    """Add the points whose rays miss each other most at the start to an error of the first solution.

    A few rays that are wrong by hundreds of pixels lead the first solution astray, before gross errors can be found.
    """
    try:
        yield
    except (DegeneratePoints, NotConverged) as error:
        points = problem.points
        worst, wrong = missing_most(problem, start, selection)
        named = np.argsort(-worst)[: min(_NAMED, int(wrong.sum()))].tolist()
        if not named:
            raise
        each = ", ".join(f"{points.ids[k]} ({worst[k]:.0f} px)" for k in named)
        raise type(error)(
            Text(error.message, f". Wrong points can be the cause: before the adjustment, rays miss most at {each}"),
            file=error.file,
            field=error.field,
            remedy=Text(
                "check these points first, and delete wrong ones", *(("; or ", error.remedy) if error.remedy else ())
            ),
        ) from error


def missing_most(problem: BlockProblem, start: State, selection: Selection) -> tuple[Array, Mask]:
    """Return by how much (px) a ray misses each point ``(N,)`` at the start, and which ones are missed by far most."""
    points = problem.points
    misses = points.measured - predict(problem.frame, start.models, points, start.local)
    misses[~(selection.rays & np.isfinite(misses).all(axis=1))] = 0.0
    known = selection.ground[points.point] & misses.any(axis=1)
    for image in np.unique(points.image[known]):
        # What all known ground of an image has in common is an error of its start.
        of = known & (points.image == image)
        misses[of] -= np.median(misses[of], axis=0)
    missed = np.hypot(*misses.T)
    worst = np.zeros(len(points))
    np.maximum.at(worst, points.point, np.where(missed > _SURE * points.sigma_image, missed, 0.0))
    return worst, np.asarray(worst > _FAR * np.median(worst[np.unique(points.point)]))


def refuse_too_few(problem: BlockProblem, selection: Selection) -> None:
    """Refuse images with fewer equations than parameters, by name."""
    points = problem.points
    rays = selection.rays & problem.active(selection)[points.point]
    if not rays.any():
        raise TooFewPoints(
            "no point is in two images, and no point with known ground is in one",
            file=points.source or None,
            remedy="check the ids of the points and the names of the images: points with the same id are one point",
        )
    of_priors, _ = problem.columns.image_and_place([one.column for one in problem.pseudo])
    priors = np.bincount(of_priors, minlength=len(problem.models))
    for image, model in enumerate(problem.models):
        columns = problem.columns.of_image(image)
        measured = int(rays[points.rays_of_images[image]].sum())
        known = len(model.constraints()) + int(priors[image])
        least = math.ceil((len(columns) - known) / 2)
        if 2 * measured + known < len(columns):
            raise TooFewPoints(
                f"{counted(measured, 'point')} in the image {points.images[image]!r} cannot determine its "
                f"{counted(len(columns), 'parameter')}",
                file=points.source or None,
                remedy=f"measure at least {counted(least, 'point')} in it, or take a simpler model",
            )


def refuse_many_outside(problem: BlockProblem, outside: Mask, inside: Selection, whole: Selection) -> None:
    """Refuse a block without control whose rays mostly meet outside of the models: then their heights say nothing."""
    of = problem.active(whole)
    if (problem.active(inside) & whole.ground).any():
        return
    number = int((outside & of).sum())
    if number > _MOST * of.sum():
        low, high = (side(model.height_limits[k] for model in problem.models) for k, side in ((0, max), (1, min)))
        heights = f" (heights {low:.0f} to {high:.0f} m)" if math.isfinite(high - low) else ""
        text = (
            f"the rays of {number} of {counted(int(of.sum()), 'point')} are parallel or meet outside of their "
            f"models{heights}"
        )
        remedy = "give control points that two images show"
        if problem.heights is None:
            text += (
                ". Without control points, heights depend on the models of the images, which are not accurate enough "
                "here"
            )
            remedy += ", or a DEM: they fix the heights of the block"
        raise DegeneratePoints(text, file=problem.points.source or None, remedy=remedy)


def refuse_undetermined(solved: Solved) -> None:
    """Refuse a block whose points leave parameters open, and name these."""
    problem = solved.problem
    if solved.condition <= CONDITION_LIMIT or not problem.size:
        return
    names = _weakest(solved)
    raise DegeneratePoints(
        f"the points do not determine {names} (condition {solved.condition:.1e})",
        file=problem.points.source or None,
        remedy="give control points that are spread over the images, take a simpler model or correction, or hold the "
        "orientation near its start values",
    )


def _weakest(solved: Solved) -> str:
    """Return the names of the parameters that the least determined combination consists of, by image."""
    problem, vector = solved.problem, np.abs(weakest(solved.linear))
    strong = np.flatnonzero(vector >= 0.3 * vector.max())
    parts = []
    for image, name in enumerate(problem.points.images):
        columns = problem.columns.of_image(image)
        mine = [problem.models[image].param_names[k - columns[0]] for k in strong if k in columns]
        if mine:
            parts.append(f"{', '.join(mine)} of the image {name!r}")
    shown = "; ".join(parts[:4])
    return f"{shown}; and those of {counted(len(parts) - 4, 'more image')}" if len(parts) > 4 else shown


def uncertain_images(solved: Solved, stated: BlockPoints, whole: Cofactors | None = None) -> list[Notice]:
    """Refuse images that are far less certain where their own points are than these, and warn of uncertain corners.

    Points count as measured as they were `stated` even where they turned out better: constraints of the models are
    stated too, and bound what is known of the images. The warning has sigmas of the `whole` covariance, which contains
    errors that all points share.

    Without control, priors of all parameters say where images are, such as positions by GNSS. They may be worse than
    any measurement, so corners of such images are compared with their own points.
    """
    problem = solved.problem
    found, held = [], any(one.held for one in problem.pseudo)
    control, priors = problem.placed[solved.linear.ordering.grounded].any(), [one.column for one in problem.pseudo]
    for image, model in enumerate(solved.state.models):
        used = solved.linear.ordering.rays_of_image[image]
        if not len(model.params) or not len(used):
            continue
        partials = solved.linear.by_params[used][:, :, : len(model.params)]
        cofactors = solved.cofactors.of_image(image)
        of_image = problem.points.rays_of_images[image]
        measured = float(np.median(problem.points.sigma_image[of_image]))
        sigma = max(measured, float(np.median(stated.sigma_image[of_image])))
        inside = float(np.sqrt(np.median(_variances(partials, cofactors)))) * measured / sigma
        name = problem.points.images[image]
        if not control and np.isin(problem.columns.of_image(image), priors).all():
            sigma, inside = sigma * max(inside, 1.0), min(inside, 1.0)
        if inside > EXTRAPOLATION_LIMIT and not held:
            raise DegeneratePoints(
                f"the points do not determine the image {name!r}: at them, its position is {inside:.0f} times less "
                "accurate than the measurements",
                file=problem.points.source or None,
                remedy="give more control points in it, spread in plan and height, or take a simpler model",
            )
        at_corners = model.param_partials(model.corners)
        at_corners = at_corners[np.isfinite(at_corners).all(axis=(1, 2))]
        spread = np.sqrt(_variances(at_corners, cofactors))
        factor = float(spread.max(initial=0.0)) / sigma
        if factor > EXTRAPOLATION_WARNING and not held:
            own, absolute = (
                _sigmas(at_corners, partials * measured, each.of_image(image))
                for each in (solved.cofactors, whole or solved.cofactors)
            )
            text = f"its position has a sigma of {significant(own[0])} px, {factor:.0f} times that of a measurement"
            if own[0] > 2.0 * own[1]:
                corner, points = map(significant, absolute)
                text = f"its absolute position has a sigma of {corner} px at a corner, but of {points} px at its points"
            found.append(Notice("uncertain-at-edge", text, factor=factor).in_image(name))
    return found


def _sigmas(at_corners: Array, at_points: Array, covariance: Array) -> tuple[float, float]:
    """Return the sigma (px) of the position at the worst corner, and the median one at points, of the worse axis."""
    corners, points = _variances(at_corners, covariance), _variances(at_points, covariance)
    return float(np.sqrt(corners.max())), float(np.sqrt(np.median(points, axis=0).max()))


def _variances(partials: Array, covariance: Array) -> Array:
    """Return the variances ``(N, 2)`` of columns and rows with partials ``(N, 2, P)``."""
    return np.asarray(((partials @ covariance) * partials).sum(axis=2))
