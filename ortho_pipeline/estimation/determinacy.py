"""What the points do not determine: uncertain corners, and parameters that cannot be separated."""

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

#: Error if the uncertainty at a corner of the image (or of the domain) is this many times that of a measured point ...
EXTRAPOLATION_LIMIT = 100.0
#: ... and warning from this factor on.
EXTRAPOLATION_WARNING = 10.0
#: A model is called unstable above this condition number (without regularisation).
UNSTABLE = 1e4
#: Parameters with a larger correlation (printed as 1.000) cannot be separated.
_INSEPARABLE = 0.9995


def corner_ratio_of(solution: Solution, source: str, strength: float | None) -> float:
    """Return the uncertainty of a model at the worst corner of its image, relative to a measured point.

    Raises an error if it is far too large; never for a regularised model, because the user chose the regularisation.
    """
    if not len(solution.model.params) or not len(solution.residuals):
        return 0.0
    partials = solution.model.param_partials(solution.model.corners)
    spread = np.sqrt(((partials @ solution.cofactors) * partials).sum(axis=2))
    factor = float(np.nanmax(spread, initial=0.0) / np.median(solution.errors.sigma))
    if np.isnan(spread).all() and strength is None:
        raise DegeneratePoints(
            "the uncertainty of the model is unknown: it projects no corner of its domain into the image",
            file=source,
            field="domain",
            remedy="check the metadata of the scene. In a plugin: domain must be (centre, half-size) in units of crs",
        )
    if np.isnan(spread).all():
        factor = math.inf
    if factor > EXTRAPOLATION_LIMIT and strength is None:
        raise DegeneratePoints(
            "the control points do not determine the model over the whole scene: a corner is "
            f"{factor:.0f} times as uncertain as a measured point",
            file=source,
            remedy="spread the points over the image (for 3D models also over height), or use a simpler model",
        )
    return factor


def uncertain_edge(factor: float) -> list[Notice]:
    """Return a notice if a model is uncertain at a corner."""
    if factor <= EXTRAPOLATION_WARNING:
        return []
    text = f"uncertain at the edge: a corner is {factor:.0f} times as uncertain as a measured point"
    return [Notice("uncertain-at-edge", text, factor=factor)]


def unstable(solution: Solution, strength: float | None) -> list[Notice]:
    """Return a notice if the points hardly determine the parameters, or cannot separate some."""
    names = solution.model.param_names
    if strength is not None:
        if solution.condition <= UNSTABLE:
            return []
        text = (
            f"unstable: the points determine only {solution.effective:.1f} of {counted(len(names), 'parameter')} "
            f"(condition number {solution.condition:.0e}). Regularisation (strength {strength:.1g}) holds the others. "
            "Only check points show the accuracy"
        )
        return [Notice("unstable", text, condition=solution.condition)]
    if solution.condition <= UNSTABLE or len(names) < 2:
        pairs = np.abs(np.triu(correlation_of(solution.cofactors), 1))
        if not (pairs > _INSEPARABLE).any():
            return []
        first, second = np.unravel_index(int(np.argmax(pairs)), pairs.shape)
        text = (
            f"{counted(int((pairs > _INSEPARABLE).sum()), 'pair of parameters', 'pairs of parameters')} cannot be "
            f"separated: correlation above {_INSEPARABLE} (highest: {names[first]} and {names[second]})"
        )
        return [Notice("inseparable-parameters", text, parameters=[names[first], names[second]])]
    text = f"unstable: the condition number of the adjustment is {solution.condition:.0e}. A simpler model is safer"
    return [Notice("unstable", text, condition=solution.condition)]


def nothing_adjusted(model: SensorModel, points: Points) -> list[Notice]:
    """Return a notice if a model without parameters was to be adjusted without a correction."""
    if model.param_names or isinstance(model, ImageCorrection) or not points.control.any():
        return []
    text = (
        f"nothing was adjusted: the model {model.kind!r} has no parameters of its own. "
        'Adjust a correction: scene.fit(points, "shift")'
    )
    return [Notice("nothing-adjusted", text)]
