"""Many models on the same points, one row each, and which of them to take.

A model that cannot be fitted is a row with its reason. Gross errors are found once and left out for all, because a
model that may throw out what it cannot follow would win.

The recommendation compares the root mean squares at all points that took no part: check points, and control points each
left out in turn.

1. A model that is unstable, uncertain at a corner of the scene or unsuited is never recommended.
2. Where the scene has a model of its own, one of its corrections is taken, unless another model is better by more than
   5 %, and significantly so: at 5 % in paired differences of the squared errors at the same points.
3. Of the models within 5 % of the smallest error, the one with the fewest parameters.

The model with the smallest error there is the best guess at that elsewhere, so what a simpler one may cost is bounded.
The one-standard-error rule (Breiman et al. 1984, Classification and Regression Trees, section 3.4.3) bounds it by how
little is known, with twelve points by a quarter of the error and more; docs/accuracy.md has both on simulated scenes.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ortho_pipeline.display.charts import rmse_axes
from ortho_pipeline.display.notebook import comparison_html
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import InputError, OrthoError, counted
from ortho_pipeline.estimation.family_fit import OWN, fit_family, fit_own
from ortho_pipeline.estimation.fit import SIGNIFICANCE, Fit, Prior, fit
from ortho_pipeline.estimation.ground_residuals import rmse_metres
from ortho_pipeline.estimation.statistics import student_of
from ortho_pipeline.files.documents import json_value
from ortho_pipeline.models import ImageCorrection, SensorModel, families, family_of
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.correction import FREE
from ortho_pipeline.points import Points
from ortho_pipeline.points.control_hull import uncovered

#: What is adjusted over a scene's own model.
CORRECTIONS = tuple(FREE)
#: Chance of calling the corrections of the scene's own model worse than another one that is as good, one-sided.
_SIGNIFICANTLY_WORSE = 0.05
#: Smaller differences of the RMSE, as a factor, are not worth a parameter, nor another model than the scene's own.
_WORTH = 1.05
#: Models whose median error is within this factor of the smallest one have a vote on gross errors.
_CLEAR_SIGHTED = 2.0


@dataclass(frozen=True)
class Row:
    """One model of a comparison: its fit, or the reason why there is none."""

    model: str
    parameters: int
    minimum_points: int
    dimensions: int
    fit: Fit | None = None
    error: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the row of ``ortho compare --json`` (docs/formats.md)."""
        row: dict[str, Any] = {
            "model": self.model,
            "parameters": self.parameters,
            "minimum_points": self.minimum_points,
            "dimensions": self.dimensions,
            "error": self.error,
        }
        which = ("control", "check", "loo")
        if self.fit is None:
            unknown = ("condition", "redundancy", "sigma0", "fitted_as", "ridge", "effective_parameters")
            nothing = dict.fromkeys(which)
            return {**row, "rmse": nothing, "rmse_m": dict(nothing), **dict.fromkeys(unknown), **to_document(())}
        return {
            **row,
            "rmse": self.fit.rmses,
            "rmse_m": rmse_metres(self.fit),
            "condition": json_value(float(self.fit.condition)),
            "redundancy": self.fit.redundancy,
            "sigma0": self.fit.sigma0,
            "fitted_as": self.fit.model_name,
            "ridge": self.fit.ridge,
            "effective_parameters": json_value(float(self.fit.effective_parameters)),
            **to_document(self.fit.warnings),
        }


@dataclass(frozen=True)
class Comparison:
    """All rows, what was left out of all of them, and the recommendation (None where nothing can be said)."""

    rows: tuple[Row, ...]
    left_out: tuple[tuple[str, str], ...]
    recommended: str | None
    reason: str
    criterion: str
    control: int = 0
    check: int = 0
    model_crs: str | None = None
    notes: tuple[Notice, ...] = field(default=())

    @property
    def best(self) -> Row | None:
        """The recommended row."""
        return next((row for row in self.rows if row.model == self.recommended), None)

    def _repr_html_(self) -> str:
        return comparison_html(self.to_json())

    def plot(self, axes: Any = None) -> Any:
        """Draw the RMSE of every model that could be fitted with matplotlib, on `axes` if given; return the axes."""
        rmses = {
            row.model: {kind: float(found["total"]) for kind, found in row.fit.rmses.items() if found}
            for row in self.rows
            if row.fit is not None
        }
        return rmse_axes(rmses, self.recommended, axes)

    def to_json(self) -> dict[str, Any]:
        """Return the part of ``ortho compare --json`` that is about models."""
        return {
            "model_crs": self.model_crs,
            "points": {"control": self.control, "check": self.check},
            "rows": [row.to_json() for row in self.rows],
            "left_out": [{"id": name, "reason": reason} for name, reason in self.left_out],
            "recommendation": {"model": self.recommended, "criterion": self.criterion, "reason": self.reason},
            **to_document(self.notes),
        }


def available_models(own: SensorModel | None = None) -> dict[str, tuple[int, int, int]]:
    """Return the models that can be compared: name -> (parameters, least number of points, dimensions).

    Parameters
    ----------
    own : SensorModel, optional
        The scene's own model: it comes first, as delivered, with each correction, and with parameters of its own.
    """
    found: dict[str, tuple[int, int, int]] = {}
    if own is not None:
        for correction in CORRECTIONS:
            count = len(ImageCorrection.identity(own, correction, (0.0, 0.0)).param_names)
            found[own_name(own, correction)] = count, max(1, math.ceil(count / 2)), 3
        if own.param_names:
            found[own_name(own, OWN)] = len(own.param_names), own.minimum_points, 3
    for family in families():
        found[family.name] = family.parameters, family.minimum_points, family.dimensions
    return found


def own_name(own: SensorModel, correction: str) -> str:
    """Return what a scene's own model is called, with what is adjusted on it."""
    return own.kind if correction == "none" else f"{own.kind}+{correction}"


def choose_models(text: str, own: SensorModel | None = None) -> tuple[str, ...]:
    """Return the names in ``all`` or ``a,b,c``, each once.

    Raises
    ------
    InputError
        If a name is unknown or there is none.
    """
    known = available_models(own)
    if text.strip() == "all":
        return tuple(known)
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise InputError(
            f"no model is called {', '.join(unknown)}" if unknown else "no model is named",
            field="models",
            remedy=f"all, or some of {', '.join(known)}",
        )
    return names


def compare(
    points: Points,
    models: Sequence[str],
    *,
    own: SensorModel | None = None,
    priors: Mapping[str, Prior] | None = None,
    size: tuple[int, int] | None = None,
    crs: str | None = None,
    heights: tuple[float, float] | None = None,
    unsuited: Mapping[str, str] | None = None,
    ridge: float | str | None = "auto",
    significance: float = SIGNIFICANCE,
) -> Comparison:
    """Fit every model to the same control points and hold them against the same check points.

    Parameters
    ----------
    models : sequence of str
        From `choose_models`.
    own : SensorModel, optional
        The scene's own model, for names such as ``rpc+shift``.
    priors : mapping of parameter name to Prior, optional
        How well its own parameters are known.
    size : (int, int), optional
        Columns and rows of the image.
    crs : str, optional
        Ground CRS of the classical models: geocentric, geographic, utm or EPSG:n; that of the points by default.
    heights : (lo, hi), optional
        Heights (m) for which the models are meant.
    unsuited : mapping of str to str, optional
        Families that do not suit the scene, with a warning for each.
    ridge : float, 'gcv', 'lcurve', 'auto' or None
        Regularisation of rational functions, as for `ortho_pipeline.estimation.family_fit.fit_family`.
    significance : float
        Of the tests of parameters.
    """
    known = available_models(own)
    job = _Job(own, dict(priors or {}), size, crs, heights, ridge)
    first = {name: job.attempt(name, points, robust=True) for name in models}
    blunders = _blunders([found for found in first.values() if isinstance(found, Fit)])
    kept = points.select(~np.isin(np.array(points.ids), list(blunders))) if blunders else points
    rows = []
    for name in models:
        found = first[name]
        if blunders or not isinstance(found, Fit) or found.rejected:
            found = job.attempt(name, kept, robust=False)
        if isinstance(found, Fit):
            found = replace(found, significance=significance)
        if isinstance(found, Fit) and unsuited and name in unsuited:
            warning = Notice("unsuited-model", unsuited[name], model=name)
            found = replace(found, warnings=(*found.warnings, warning))
        parameters, minimum, dimensions = known[name]
        rows.append(
            Row(name, parameters, minimum, dimensions, fit=found) if isinstance(found, Fit)
            else Row(name, parameters, minimum, dimensions, error=found)
        )  # fmt: skip
    corrections = () if own is None else [own_name(own, name) for name in (*CORRECTIONS, OWN)]
    recommended, reason, criterion = recommend(rows, preferred=corrections, unsuited=tuple(unsuited or ()))
    return Comparison(
        tuple(rows), tuple(blunders.items()), recommended, reason, criterion,
        control=int(kept.control.sum()), check=int(kept.check.sum()), model_crs=crs,
        notes=uncovered(kept.image[kept.control], size),
    )  # fmt: skip


@dataclass(frozen=True)
class _Job:
    own: SensorModel | None
    priors: Mapping[str, Prior]
    size: tuple[int, int] | None
    crs: str | None
    heights: tuple[float, float] | None
    ridge: float | str | None

    def attempt(self, name: str, points: Points, robust: bool) -> Fit | str:
        """Return the fit, or why there is none."""
        try:
            if self.own is not None:
                if name == own_name(self.own, OWN):
                    return fit_own(self.own, points, self.priors, robust=robust)
                for correction in CORRECTIONS:
                    if name == own_name(self.own, correction):
                        return self._correct(self.own, correction, points, robust)
            ridge = self.ridge if family_of(name).regularised else "auto"
            return fit_family(
                name, points, crs=self.crs, size=self.size, heights=self.heights, ridge=ridge, robust=robust
            )
        except OrthoError as error:
            return f"{error.message}{f' ({error.remedy})' if error.remedy else ''}"

    def _correct(self, own: SensorModel, correction: str, points: Points, robust: bool) -> Fit:
        width, height = self.size or (0, 0)
        start = ImageCorrection.identity(own, correction, (width / 2, height / 2))
        return fit(start, points, robust=robust and correction != "none", name=own_name(own, correction))


def _blunders(fits: Sequence[Fit]) -> dict[str, str]:
    """Return the points that more than half of the models reject, each with the first reason given.

    Models that do not follow the scene at all see no gross error: only those with about the smallest errors vote.
    """
    able = [found for found in fits if found.redundancy >= 4 and found.model.params.size]
    sizes = [_median_error(found) for found in able]
    limit = _CLEAR_SIGHTED * min(sizes, default=0.0)
    voting = [found for found, size in zip(able, sizes, strict=True) if size <= limit]
    votes = Counter(name for found in voting for name, _ in found.rejected)
    reasons: dict[str, str] = {}
    for found in voting:
        for name, reason in found.rejected:
            if votes[name] > len(voting) / 2:
                reasons.setdefault(name, reason)
    return reasons


def _median_error(found: Fit) -> float:
    """Return the median over all control points, rejected ones too, of how far they are from their prediction (px)."""
    errors = np.where(found.used[:, None], found.loo_residuals, found.residuals)[found.points.control]
    sizes = np.hypot(*np.where(np.isfinite(errors), errors, np.inf).T)
    return float(np.median(sizes))


# -- choosing --------------------------------------------------------------------------------------------------------

_Squares = dict[str, Array]


def recommend(
    rows: Sequence[Row], *, preferred: Sequence[str] = (), unsuited: Sequence[str] = ()
) -> tuple[str | None, str, str]:
    """Return the recommended model, the reason in words, and what decided.

    Parameters
    ----------
    preferred : sequence of str
        The scene's own model with its corrections.
    unsuited : sequence of str
        Models that do not suit the scene.

    Returns
    -------
    tuple
        The third is ``check`` (check points, and control points left out in turn), ``leave-one-out`` or ``none``.
    """
    by_name = {row.model: row for row in rows if row.fit is not None}
    squares, checks = _tests(list(by_name.values()))
    if not squares:
        return None, "no model leaves redundancy: nothing can be tested on these points", "none"
    count = len(next(iter(squares.values())))
    if count < 3:
        return None, "fewer than three points test every model: too few to choose by", "none"
    doubts = {name: _doubts(by_name[name], unsuited) for name in squares}
    sound = {name: values for name, values in squares.items() if not doubts[name]}
    smallest = _best(squares, by_name)
    if not sound:
        return None, f"every model that can be tested is doubtful; {smallest} is {doubts[smallest]}", "none"
    chosen, best = _choose(sound, by_name, [name for name in preferred if name in sound])
    shown = {name: f"{math.sqrt(values.mean()):.3g} px" for name, values in squares.items()}
    reason = f"{chosen}: {shown[chosen]} at {_what(checks, count - checks)}, with "
    reason += f"{counted(by_name[chosen].parameters, 'parameter')}"
    if chosen == best:
        reason += "; the smallest error" + ("" if smallest == best else " of the models that can be relied on")
    elif best not in preferred and chosen in preferred:
        reason += f"; {best} has {shown[best]}, not significantly less than a correction of the scene's own model"
    else:
        reason += (
            f"; {best} has {shown[best]} with {counted(by_name[best].parameters, 'parameter')}, less by 5 % at "
            "most, so the model "
            "with fewer parameters is preferred"
        )
    if doubts[smallest]:
        reason += f" ({smallest} has {shown[smallest]} and is {doubts[smallest]})"
    return chosen, reason, "check" if checks else "leave-one-out"


def _tests(rows: Sequence[Row]) -> tuple[_Squares, int]:
    """Return the squared errors (px²) of each model at the points that test all of them, and how many of them check.

    Without redundancy no control point can be left out; such models are tested where check points alone test all.
    Check points that contradict the model with the smallest median test none.
    """
    fits = {row.model: row.fit for row in rows if row.fit is not None}
    errors = {name: _squares(found) for name, found in fits.items() if found.redundancy > 0}
    if not errors:
        errors = {name: np.where(found.points.check, _squares(found), np.nan) for name, found in fits.items()}
    errors = {name: values for name, values in errors.items() if np.isfinite(values).any()}
    if not errors:
        return {}, 0
    clearest = fits[min(errors, key=lambda name: float(np.nanmedian(errors[name])))]
    wrong = [one.id for one in clearest.outlying if one.role == "check"]
    common = np.all([np.isfinite(values) for values in errors.values()], axis=0)
    common &= ~np.isin(np.array(clearest.points.ids), wrong)
    return {name: values[common] for name, values in errors.items()}, int((common & clearest.points.check).sum())


def _squares(found: Fit) -> Array:
    """Return squared errors (px²) per point ``(N,)`` of check points and of control points left out; NaN for others."""
    # A model without parameters is tested by every control point.
    control = found.loo_residuals if found.model.params.size else np.where(found.used[:, None], found.residuals, np.nan)
    values = np.where(found.points.check[:, None], found.residuals, control)
    squares: Array = (values**2).sum(axis=1)
    return squares


def _doubts(row: Row, unsuited: Sequence[str]) -> str:
    """Return why a model is not recommended whatever its errors; empty if there is no reason."""
    found = list(row.fit.reservations) if row.fit else []
    return " and ".join([*found, *(["unsuited to the scene"] if row.model in unsuited else [])])


def _best(squares: _Squares, rows: Mapping[str, Row]) -> str:
    return min(squares, key=lambda name: (squares[name].mean(), rows[name].parameters))


def _choose(squares: _Squares, rows: Mapping[str, Row], preferred: Sequence[str]) -> tuple[str, str]:
    """Return the model to take, and the one with the smallest error of all."""
    best = _best(squares, rows)
    candidates = squares
    if preferred:
        own = {name: squares[name] for name in preferred}
        if not _significantly_worse(own[_best(own, rows)], squares[best]):
            candidates = own
    limit = _WORTH**2 * squares[_best(candidates, rows)].mean()
    close = [name for name, values in candidates.items() if values.mean() <= limit]
    return min(close, key=lambda name: (rows[name].parameters, squares[name].mean())), best


def _significantly_worse(squares: Array, best: Array) -> bool:
    """Say whether errors are larger by more than is worth it, and by more than chance at the same points explains."""
    if squares.mean() <= _WORTH**2 * best.mean():
        return False
    difference = squares - best
    variance = difference.var(ddof=1) / len(difference)
    _, p = student_of(difference.mean()[None], np.array([[variance]]), len(difference) - 1)
    return bool(p[0] / 2 < _SIGNIFICANTLY_WORSE)


def _what(checks: int, control: int) -> str:
    """Return in words what points tested the models."""
    left_out = f"{counted(control, 'control point')}, each left out in turn"
    if not checks:
        return left_out
    return counted(checks, "check point") + (f" and {left_out}" if control else "")
