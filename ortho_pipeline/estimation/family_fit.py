"""Fit a classical model by its name, and remove parameters that are not significant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from ortho_pipeline.errors import DegeneratePoints, InputError, NotConverged, OrthoError
from ortho_pipeline.errors.texts import Setting, Text
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
    """Adjust the own parameters of a scene's model, such as the exterior orientation of a frame.

    Parameters
    ----------
    priors : mapping of parameter name to Prior, optional
        Accuracy of the parameters as delivered.

    Raises
    ------
    InputError
        If the model has no such parameters.
    """
    if not model.param_names:
        raise InputError(
            f"the model {model.kind!r} has no parameters of its own to adjust",
            field="points.correction",
            remedy="use shift, shift-drift or affine",
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
        A name of `ortho_pipeline.models.families`. For ``affine14``, both assignments of the image axes are tried, and
        the result names the one with the smaller leave-one-out residuals.
    crs, size, heights : optional
        As for `ortho_pipeline.models.start_model`.
    ridge : float, 'gcv', 'lcurve', 'auto' or None
        Regularisation; ``auto`` means generalised cross-validation for rational functions and none for others.
    params : sequence of str, optional
        Adjust only these parameters; the others are zero.

    Raises
    ------
    TooFewPoints, DegeneratePoints
        If the points do not determine the model. The remedy names a simpler one that they determine.

    Examples
    --------
    >>> fit = fit_family("affine3d", op.read_points("sample_data/gcps.geojson"))
    >>> fit.model_name, round(fit.rmse("check").total, 2)
    ('affine3d', 0.17)
    """
    chosen = family_of(family)
    if chosen.variants:
        fits, refusals = list[Fit](), list[OrthoError]()
        for name in chosen.variants:
            try:
                fits.append(
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
                )
            except (DegeneratePoints, NotConverged) as error:
                refusals.append(error)
        if not fits:
            raise refusals[0]
        return min(fits, key=_leave_one_out)
    if ridge == "auto":
        ridge = "gcv" if chosen.regularised else None
    start = restricted(start_model(family, points, crs=crs, size=size, heights=heights), params)
    try:
        wrong = gross_errors(start, points, priors=priors, ridge=ridge) if robust else {}
        if wrong:
            # Domain and normalisation of the model come from the points, so use only the good ones.
            good = points.select(~np.isin(np.array(points.ids), list(wrong)))
            start = restricted(start_model(family, good, crs=crs, size=size, heights=heights), params)
        result = fit(start, points, priors=priors, robust=False, exclude=wrong, ridge=ridge, name=family)
        # The start is not a vendor's model, so its residuals mean nothing.
        return replace(result, raw_residuals=np.full_like(result.raw_residuals, np.nan))
    except (DegeneratePoints, NotConverged) as error:
        simpler = _simpler(family, points, crs, size, heights)
        if simpler is None:
            raise
        raise DegeneratePoints(
            Text(f"{family}: ", error.message),
            file=error.file,
            field=error.field,
            remedy=Text(error.remedy or "", f"; these points are enough for {simpler}"),
        ) from error


def restricted(model: SensorModelT, params: Sequence[str] | None) -> SensorModelT:
    """Return a model with only these adjustable parameters; the others are zero.

    Raises
    ------
    InputError
        If a name is unknown, or the parameters of this model cannot be removed.
    """
    if params is None:
        return model
    unknown = [name for name in params if name not in model.param_names]
    if unknown or not params:
        raise InputError(
            f"unknown parameter {', '.join(unknown)}" if unknown else "no parameter given",
            field="points.params",
            remedy=f"use some of {', '.join(model.param_names)}"
            if model.param_names
            else "this model has no parameters",
        )
    rest = [name for name in model.param_names if name not in params]
    return model.without(rest) if rest else model


def ridge_of(text: str) -> float | str | None:
    """Return the value of ``--ridge``: auto, gcv and lcurve unchanged, ``none`` as None, or a weight.

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
            f"unknown regularisation {text!r}",
            field="points.ridge",
            remedy=f"use auto, none, {', '.join(METHODS)}, or a positive weight such as 1e-5",
        )
    return weight


def _leave_one_out(result: Fit) -> float:
    """Return the leave-one-out RMSE; 0 without redundancy."""
    loo = result.rmse("loo")
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


# -- insignificant parameters ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Removed:
    """A removed parameter, and its Student test at that time."""

    name: str
    t: float
    p: float


@dataclass(frozen=True, eq=False)
class Pruned:
    """The fit without insignificant parameters, and these in the order of their removal."""

    fit: Fit
    removed: tuple[Removed, ...]


def prune(found: Fit, *, significance: float | None = None) -> Pruned:
    """Remove insignificant parameters one by one, the least significant first.

    A parameter is removed if the hypothesis that it is zero is not rejected; then the others are estimated again. A
    lower term (X) stays as long as a higher one (XZ) does, because its value depends on the origin.

    Parameters
    ----------
    found : Fit
        Of an image correction or a classical model. Rejected points stay rejected.
    significance : float, optional
        Chance of keeping a parameter that is zero; default: that of the fit.

    Raises
    ------
    InputError
        If there is no redundancy, or the model has no removable parameters.
    """
    significance = found.significance if significance is None else significance
    if not 0 < significance < 1:
        raise InputError("the significance must be between 0 and 1", field="significance")
    if found.sigma0 is None:
        raise InputError(
            "there is no redundancy, so parameters cannot be tested", field="points.prune", remedy="add control points"
        )
    if found.param_names and not found.model.removable:
        raise InputError(
            f"the parameters of the model {found.model.kind!r} cannot be removed",
            field="points.prune",
            remedy=Text("leave this option out, or use ", Setting("points.correction", "shift")),
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


def _again(result: Fit, without: str) -> Fit:
    """Fit again to the same points, without a parameter."""
    again = fit(
        result.model.without([without]),
        result.points,
        priors={name: prior for name, prior in result.priors.items() if name != without},
        robust=False,
        name=result.model_name,
        ridge=result.ridge,
        exclude=dict(result.rejected),
    )
    return replace(again, raw_residuals=result.raw_residuals, significance=result.significance)


# -- cross-validation ------------------------------------------------------------------------------------------------
