"""What points leave open: corners that they say little of, and parameters that they do not tell apart."""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import DegeneratePoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.problem import Solution
from ortho_pipeline.estimation.statistics import correlation_of
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.points import Points

#: Refuse where some corner of the image (of the model's domain without one) would be predicted so many times worse than
#: a point is measured ...
EXTRAPOLATION_LIMIT = 100.0
#: ... and say so from here on.
EXTRAPOLATION_WARNING = 10.0
#: Beyond this condition without its regularisation a model is called unstable.
UNSTABLE = 1e4
#: Two parameters correlated beyond this are listed as 1.000: they cannot be told apart.
_INSEPARABLE = 0.9995


def corner_ratio_of(solution: Solution, source: str, strength: float | None) -> float:
    """Return how many times less certain a model is at a corner of its image than a measured point.

    One that is much less certain is refused, but never a regularised one: what the points leave open, the user has
    decided.
    """
    if not len(solution.model.params) or not len(solution.residuals):
        return 0.0
    partials = solution.model.param_partials(solution.model.corners)
    spread = np.sqrt(((partials @ solution.cofactors) * partials).sum(axis=2))
    factor = float(np.nanmax(spread, initial=0.0) / np.median(solution.errors.sigma))
    if np.isnan(spread).all() and strength is None:
        raise DegeneratePoints(
            "how certain the model is cannot be said: no corner of the ground that it is meant for has an image",
            file=source,
            field="domain",
            remedy="check the metadata of the scene; of a plugin, that domain is (centre, half-size) in units of crs",
        )
    if np.isnan(spread).all():
        factor = math.inf
    if factor > EXTRAPOLATION_LIMIT and strength is None:
        raise DegeneratePoints(
            f"the control points do not determine the whole scene: at a corner the model is {factor:.0f} times less "
            "certain than a measured point",
            file=source,
            remedy="spread the points over the image (and over height, for 3D models), or take a simpler model",
        )
    return factor


def uncertain_edge(factor: float) -> list[Notice]:
    if factor <= EXTRAPOLATION_WARNING:
        return []
    text = f"uncertain at the edge: at a corner of the scene {factor:.0f} times less certain than a measured point"
    return [Notice("uncertain-at-edge", text, factor=factor)]


def unstable(solution: Solution, strength: float | None) -> list[Notice]:
    names = solution.model.param_names
    if strength is not None:
        if solution.condition <= UNSTABLE:
            return []
        text = (
            f"unstable: the points determine {solution.effective:.1f} of {counted(len(names), 'parameter')} (condition "
            f"{solution.condition:.0e}); regularisation ({strength:.1e}) decides the others: trust check points only"
        )
        return [Notice("unstable", text, condition=solution.condition)]
    if solution.condition <= UNSTABLE or len(names) < 2:
        pairs = np.abs(np.triu(correlation_of(solution.cofactors), 1))
        if not (pairs > _INSEPARABLE).any():
            return []
        first, second = np.unravel_index(int(np.argmax(pairs)), pairs.shape)
        text = (
            f"{counted(int((pairs > _INSEPARABLE).sum()), 'pair of parameters is', 'pairs of parameters are')} "
            f"correlated beyond {_INSEPARABLE} "
            f"({names[first]} and {names[second]} the most): they cannot be told apart"
        )
        return [Notice("inseparable-parameters", text, parameters=[names[first], names[second]])]
    text = f"unstable: the condition of the adjustment is {solution.condition:.0e}: a simpler model is safer"
    return [Notice("unstable", text, condition=solution.condition)]


def nothing_adjusted(model: SensorModel, points: Points) -> list[Notice]:
    """Return a notice if a model without parameters was given to be adjusted, without a correction over it."""
    if model.param_names or isinstance(model, ImageCorrection) or not points.control.any():
        return []
    text = (
        f"nothing was adjusted: a model {model.kind!r} has no parameters of its own; "
        'scene.fit(points, "shift") adjusts a correction over it'
    )
    return [Notice("nothing-adjusted", text)]
