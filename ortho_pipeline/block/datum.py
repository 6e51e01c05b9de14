r"""Datum of a block: control points, what is known of the models, or the orientation held near its start values.

Ties show how the images lie to each other across their epipolar lines. Along these, where heights are, and in position,
rays of satellites are so nearly parallel that a shift of ten pixels changes how they meet by some thousandths of one.
Slow errors of the models (attitude, RPC fit, matching) do as much, so what ties say of such a shift is theirs. A slow
error :math:`\epsilon` is shared by all ties of an image and does not average out. So the ties of an image weigh no
more than one measurement with that sigma, against start values that are as wrong as rays miss each other there:

.. math:: k = 1 + (\epsilon\,\sigma / m)^2 \sum 1 / \sigma_i^2

is how many times the weight of its start value's sigma :math:`\sigma` a parameter is held with. Rays miss each other by
:math:`m`. A correction of which ties show far less than the part :math:`\epsilon / m` stays at its start, with the
sigma of that; one of which they show far more is theirs.

:math:`\sigma` of an image is the accuracy that its metadata state, else 10 px. Where rays miss each other by far more,
it is that.

Source: Kish 1965 (design effect of shared errors); Theil 1963 (mixed estimation).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.elimination import step_of
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Pseudo, Selection, State
from ortho_pipeline.block.local_frame import enu_partials
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.models.base import Array, SensorModel

#: Without any control, each parameter is held at its start value by its effect in the image, with this sigma (px): the
#: size of what vendors' orientations are off by.
HOLD = 10.0
#: Slow errors (px) of an image that its model does not have: 0.01 to 0.04 px over 1000 px of five real pairs.
SLOW = 0.1
#: Start values count as no less wrong than this (px), however well the rays meet.
_LEAST_WRONG = 1.0
#: Rays that miss each other by so many stated sigmas contradict these.
_CONTRADICTED = 3.0


def with_datum(
    problem: BlockProblem,
    state: State,
    selection: Selection,
    hold: float | None,
    accuracies: Mapping[str, float] | None = None,
) -> tuple[BlockProblem, str]:
    """Return the problem with a datum, and what defines it.

    Parameters
    ----------
    accuracies : mapping of image name to float, optional
        Standard deviations (m, per axis in plan) that the metadata of images state.
    """
    control = int((problem.active(selection) & selection.ground).sum())
    if hold is not None and not hold > 0:
        raise InputError("a standard deviation must be positive", field="hold")
    if not problem.size:
        return problem, "nothing is adjusted but the points: the models stay as they are"
    if hold is None and control:
        return problem, by_control(problem, selection)
    linear = Linear.at(problem, state, selection)
    # Fictitious constraints hold the shape of an orbit together, not where it is.
    known = bool(problem.pseudo) or any((~model.constraints().fictitious).any() for model in state.models)
    if hold is None and known and step_of(linear).condition <= CONDITION_LIMIT:
        dem = "" if problem.heights is None else ", the height also from the DEM"
        return problem, f"no control points: position and height come from the models as delivered{dem}"
    missed = 0.0 if control else _missed(linear)
    per_metre = _pixels_per_metre(linear)
    named = {} if hold is not None else accuracies or {}
    stated_m = np.array([named.get(image, np.nan) for image in problem.points.images])
    stated = stated_m * per_metre
    trusted = np.asarray(stated >= missed / _CONTRADICTED)
    sigmas: Array = np.where(trusted, stated, max(HOLD, missed) if hold is None else hold)
    # Heights of a DEM tell what ties leave to their slow errors.
    by_ties = not control and problem.heights is None
    typical = float(np.sqrt(np.mean(sigmas**2)))
    slow = SLOW * typical / max(missed, _LEAST_WRONG) if by_ties else 0.0
    held = _held(linear, sigmas, slow)
    assumed = hold is None and not trusted.any()
    ground = sigmas[np.isfinite(per_metre)] / per_metre[np.isfinite(per_metre)]
    on_ground = f" ({_span(ground)} m on the ground)" if len(ground) else ""
    of = f"{'Assumed accuracy' if assumed else 'Accuracy'} of the delivered models: sigma {_span(sigmas)} px in the "
    of += f"image{on_ground}, for {len(held)} of {problem.size} parameters"
    of += "; the absolute accuracy depends on it" if assumed else ""
    if trusted.any():
        who = "the metadata state" if trusted.all() else f"the metadata of {counted(int(trusted.sum()), 'image')} state"
        of += f"; {who} {_span(stated_m[trusted])} m"
    elif np.isfinite(stated).any():
        of += f"; not the accuracy of the metadata, because rays miss each other by {significant(missed, 3)} px"
    return problem.with_pseudo(held), _why(control, by_ties, of)


def stated_accuracies(models: Mapping[str, SensorModel]) -> dict[str, float]:
    """Return the standard deviations (m, per axis) that RPCs state, by image."""
    found = {image: model.stated_accuracy for image, model in models.items()}
    return {image: sigma for image, sigma in found.items() if sigma is not None}


def _span(values: Array) -> str:
    """Return a range of numbers, or the number if all are equal."""
    low, high = significant(values.min()), significant(values.max())
    return low if low == high else f"{low} to {high}"


def _pixels_per_metre(linear: Linear) -> Array:
    """Return how many px ``(images,)`` a metre in plan is; NaN without points."""
    problem, found = linear.problem, np.full(len(linear.state.models), np.nan)
    for image, used in enumerate(linear.ordering.rays_of_image):
        if len(used):
            ground = problem.frame.geodetic(linear.state.local[problem.points.point[used]])
            square = (enu_partials(linear.state.models[image], ground)[:, :, :2] ** 2).sum(axis=(1, 2)) / 2
            found[image] = np.sqrt(np.nanmean(square))
    return found


def _why(control: int, by_ties: bool, of: str) -> str:
    """Return the datum of a block whose orientation is held with a sigma."""
    if control:
        return f"{counted(control, 'control point')}, and the orientation is held at its start values. {of}"
    if by_ties:
        return (
            "no control points: positions and heights are only as accurate as the delivered models. Ties correct the "
            f"images relative to each other; all else keeps its start value. {of}"
        )
    return (
        "no control points. Positions come from the delivered models and from the terrain in the DEM; heights come "
        f"from the DEM. {of}"
    )


def by_control(problem: BlockProblem, selection: Selection) -> str:
    """Say that the control points of a selection define the datum."""
    number = int((problem.active(selection) & selection.ground).sum())
    return f"position and height come from {counted(number, 'control point')}"


def with_start_errors(linear: Linear, covariance: Cofactors) -> Cofactors:
    r"""Return the covariance of the parameters with the errors of start values that are held firmly.

    It has them with the weight :math:`W` that they have in the solution. Their errors are larger by the firmness
    :math:`k`, and the solution takes :math:`C W` of them over: :math:`C W (k W^{-1} - W^{-1}) W C` is added.
    """
    excess = linear.problem.firmness - 1.0
    if not excess.any():
        return covariance
    rows = linear.pseudo_design[: len(excess)] * np.sqrt(excess)[:, None]
    return covariance.mixed(1.0, covariance.times(rows.T), np.eye(len(rows)))


def _held(linear: Linear, sigmas: Array, slow: float) -> list[Pseudo]:
    """Return a pseudo-observation for each parameter without a prior, as strong as its effect (px) in its image.

    Parameters
    ----------
    sigmas : ndarray (images,)
        px.
    """
    problem, params = linear.problem, linear.state.params
    known = {one.column for one in problem.pseudo}
    found = []
    for image, used in enumerate(linear.ordering.rays_of_image):
        partials = problem.points.in_pixels(linear.by_params[used], used)
        effect = np.sqrt((partials**2).sum(axis=1).mean(axis=0)) if len(used) else []
        for column, size in zip(problem.columns.of_image(image), effect, strict=False):
            if int(column) not in known and size > 0:
                sigma = float(sigmas[image] / size)
                found.append(Pseudo(int(column), float(params[column]), sigma, held=True, slow=slow))
    return found


def _missed(linear: Linear) -> float:
    """Return by how much (px) rays miss each other at the start: the median over points, so blunders do not count."""
    points, rays = linear.problem.points, linear.ordering.rays
    squares = (points.in_pixels(linear.misfits.rays[rays], rays) ** 2).sum(axis=1)
    of, size = points.point[rays], len(points)
    excess = 2 * np.bincount(of, minlength=size) - 3
    seen = excess > 0
    missed = np.bincount(of, squares, minlength=size)[seen] / excess[seen]
    return float(np.sqrt(np.nanmedian(missed))) if np.isfinite(missed).any() else 0.0
