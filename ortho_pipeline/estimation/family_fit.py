"""Choosing among classical models: fit one by name, take out what is not justified, predict what was left out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, OrthoError
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.estimation.fit import Fit, Prior, fit, gross_errors
from ortho_pipeline.estimation.regularisation import METHODS
from ortho_pipeline.models import family_of, start_model
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.options import number_of
from ortho_pipeline.points import Points

SensorModelT = TypeVar("SensorModelT", bound=SensorModel)

#: What is adjusted when it is the parameters that a scene's model has of its own.
OWN = "model"


def fit_own(
    model: SensorModel, points: Points, priors: Mapping[str, Prior] | None = None, *, robust: bool = True
) -> Fit:
    """Adjust the parameters that a scene's model has of its own, such as the exterior orientation of a frame.

    Parameters
    ----------
    priors : mapping of parameter name to Prior, optional
        How well the vendor knows them.

    Raises
    ------
    InputError
        If the model has no such parameters.
    """
    if not model.param_names:
        raise InputError(
            f"a model {model.kind!r} has no parameters of its own to adjust",
            field="points.correction",
            remedy="take shift, shift-drift or affine",
        )
    return fit(model, points, priors=priors, robust=robust, name=f"{model.kind}+{OWN}")


def fit_family(
    family: str,
    points: Points,
    *,
    crs: str | None = None,
    size: tuple[int, int] | None = None,
    heights: tuple[float, float] | None = None,
    ridge: float | str | None = "auto",
    priors: Mapping[str, Prior] | None = None,
    params: Sequence[str] | None = None,
    robust: bool = True,
) -> Fit:
    """Fit a classical model to control points.

    Parameters
    ----------
    family : str
        A name of `ortho_pipeline.models.families`. Of ``affine14`` both assignments of the image axes are tried; the
        one with the smaller leave-one-out residuals is taken, and named in the result.
    crs, size, heights : optional
        As for `ortho_pipeline.models.start_model`.
    ridge : float, 'gcv', 'lcurve', 'auto' or None
        Regularisation; ``auto`` is generalised cross-validation for rational functions and none for the others.
    params : sequence of str, optional
        The only parameters that are adjusted, as of `restricted`.

    Raises
    ------
    TooFewPoints, DegeneratePoints
        If the points do not determine the model; the remedy names a simpler one that they do.
    """
    chosen = family_of(family)
    if chosen.variants:
        fits = [
            fit_family(
                name,
                points,
                crs=crs,
                size=size,
                heights=heights,
                ridge=ridge,
                priors=priors,
                params=params,
                robust=robust,
            )
            for name in chosen.variants
        ]
        return min(fits, key=_leave_one_out)
    if ridge == "auto":
        ridge = "gcv" if chosen.regularised else None
    start = restricted(start_model(family, points, crs=crs, size=size, heights=heights), params)
    try:
        wrong = gross_errors(start, points, priors=priors, ridge=ridge) if robust else {}
        if wrong:
            # Where the model is meant for, and its normalisation, come from the points: from the good ones.
            good = points.select(~np.isin(np.array(points.ids), list(wrong)))
            start = restricted(start_model(family, good, crs=crs, size=size, heights=heights), params)
        found = fit(start, points, priors=priors, robust=False, exclude=wrong, ridge=ridge, name=family)
        # The start is of no vendor's making: that it is off says nothing.
        return replace(found, raw_residuals=np.full_like(found.raw_residuals, np.nan))
    except (DegeneratePoints, NotConverged) as error:
        simpler = _simpler(family, points, crs, size, heights)
        if simpler is None:
            raise
        raise DegeneratePoints(
            Text(f"{family}: ", error.message),
            file=error.file,
            field=error.field,
            remedy=Text(error.remedy or "", f"; these points do determine {simpler}"),
        ) from error


def restricted(model: SensorModelT, params: Sequence[str] | None) -> SensorModelT:
    """Return a model of which only these parameters are adjusted; the others are zero.

    Raises
    ------
    InputError
        If a name is not that of a parameter, or the model's parameters cannot be taken out.
    """
    if params is None:
        return model
    unknown = [name for name in params if name not in model.param_names]
    if unknown or not params:
        raise InputError(
            f"no parameter is called {', '.join(unknown)}" if unknown else "no parameter is named",
            field="points.params",
            remedy=f"some of {', '.join(model.param_names) or 'none: this model has no parameters'}",
        )
    rest = [name for name in model.param_names if name not in params]
    return model.without(rest) if rest else model


def ridge_of(text: str) -> float | str | None:
    """Return what ``--ridge`` means: auto, gcv and lcurve as they are, ``none`` as None, or a weight.

    Raises
    ------
    InputError
        If it is none of these.
    """
    if text in ("auto", *METHODS):
        return text
    if text == "none":
        return None
    weight = number_of(text)
    if not weight > 0:
        raise InputError(
            f"{text!r} is not a regularisation",
            field="points.ridge",
            remedy=f"auto, none, {', '.join(METHODS)}, or a positive weight such as 1e-5",
        )
    return weight


def _leave_one_out(found: Fit) -> float:
    """Return the leave-one-out RMSE; without redundancy the RMSE of the control points is zero and decides nothing."""
    loo = found.rmse("loo")
    return loo.total if loo is not None else 0.0


def _simpler(
    family: str,
    points: Points,
    crs: str | None,
    size: tuple[int, int] | None,
    heights: tuple[float, float] | None,
) -> str | None:
    """Return the next simpler family that the points determine; None if there is none."""
    waiting = list(family_of(family).simpler)
    tried = []
    while waiting:
        name = waiting.pop(0)
        if name in tried:
            continue
        tried.append(name)
        try:
            fit(start_model(name, points, crs=crs, size=size, heights=heights), points, robust=False)
        except OrthoError:
            waiting += [other for other in family_of(name).simpler if other not in waiting]
            continue
        return name
    return None


# -- unjustified parameters ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Removed:
    """A parameter that was taken out, and its Student test at that time."""

    name: str
    t: float
    p: float


@dataclass(frozen=True, eq=False)
class Pruned:
    """The fit without the unjustified parameters, and those in the order in which they went."""

    fit: Fit
    removed: tuple[Removed, ...]


def prune(found: Fit, *, significance: float | None = None) -> Pruned:
    """Take out the parameters that the points do not justify, one by one, the least significant first.

    A parameter goes if the hypothesis that it is zero is not rejected; then all others are estimated again. A term on
    which a higher one builds (X below XZ) stays while that one does, because whether it is zero depends on the origin.

    Parameters
    ----------
    found : Fit
        Of an image correction or a classical model. Points that were rejected stay so.
    significance : float, optional
        Chance of keeping a parameter that is zero; that of the fit by default.

    Raises
    ------
    InputError
        If there is no redundancy to test with, or the model has no removable parameters.
    """
    significance = found.significance if significance is None else significance
    if not 0 < significance < 1:
        raise InputError("a significance lies between 0 and 1", field="significance")
    if found.sigma0 is None:
        raise InputError(
            "without redundancy no parameter can be tested", field="points.prune", remedy="give more control points"
        )
    removed: list[Removed] = []
    while True:
        t, p = found.student
        index = {name: k for k, name in enumerate(found.param_names)}
        candidates = [name for name in found.model.removable if not p[index[name]] <= significance]
        if not candidates or len(index) == 1:
            return Pruned(found, tuple(removed))
        worst = max(candidates, key=lambda name: float(np.nan_to_num(p[index[name]], nan=1.0)))
        removed.append(Removed(worst, float(t[index[worst]]), float(p[index[worst]])))
        found = _again(found, worst)


def _again(found: Fit, without: str) -> Fit:
    """Fit once more to the same points, without a parameter."""
    again = fit(
        found.model.without([without]),
        found.points,
        priors={name: prior for name, prior in found.priors.items() if name != without},
        robust=False,
        name=found.model_name,
        ridge=found.ridge,
        exclude=dict(found.rejected),
    )
    return replace(again, raw_residuals=found.raw_residuals, significance=found.significance)


# -- cross-validation ------------------------------------------------------------------------------------------------
