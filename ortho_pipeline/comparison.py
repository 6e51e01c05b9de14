"""Many models on the same points, one row each, and which of them to take.

A model that cannot be fitted is a row with its reason. Gross errors are found once and left out for all, because a
model that may throw out what it cannot follow would win.

The recommendation follows the one-standard-error rule: of all models whose mean squared error at the deciding points
(check points if there are enough of them, control points left out in turn otherwise) is not larger than the best one's
by more than the standard error of that difference, take the one with the fewest parameters.

Source: Breiman et al. 1984, Classification and Regression Trees, section 3.4.3 (here with paired differences).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.estimation import Fit, Prior, fit
from ortho_pipeline.ground_error import rmse_metres
from ortho_pipeline.model_choice import OWN, fit_family, fit_own
from ortho_pipeline.models import ImageCorrection, SensorModel, families
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import Points

#: What is adjusted over a scene's own model.
CORRECTIONS = ("none", "shift", "shift-drift", "affine")
#: From this many check points on they decide; below, leave-one-out does.
ENOUGH_TO_DECIDE = 8


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
            return {**row, "rmse": nothing, "rmse_m": dict(nothing), **dict.fromkeys(unknown), "warnings": []}
        return {
            **row,
            "rmse": {name: self.fit.rmse(name) for name in which},
            "rmse_m": rmse_metres(self.fit),
            "condition": _finite(self.fit.condition),
            "redundancy": self.fit.redundancy,
            "sigma0": self.fit.sigma0,
            "fitted_as": self.fit.model_name,
            "ridge": self.fit.ridge,
            "effective_parameters": _finite(self.fit.effective_parameters),
            "warnings": list(self.fit.warnings),
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
    notes: tuple[str, ...] = field(default=())

    @property
    def best(self) -> Row | None:
        """The recommended row."""
        return next((row for row in self.rows if row.model == self.recommended), None)

    def to_json(self) -> dict[str, Any]:
        """Return the part of ``ortho compare --json`` that is about models."""
        return {
            "model_crs": self.model_crs,
            "points": {"control": self.control, "check": self.check},
            "rows": [row.to_json() for row in self.rows],
            "left_out": [{"id": name, "reason": reason} for name, reason in self.left_out],
            "recommendation": {"model": self.recommended, "criterion": self.criterion, "reason": self.reason},
            "warnings": list(self.notes),
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
            field="--models",
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
    """
    known = available_models(own)
    job = _Job(own, dict(priors or {}), size, crs, heights)
    first = {name: job.attempt(name, points, robust=True) for name in models}
    blunders = _blunders([found for found in first.values() if isinstance(found, Fit)])
    kept = points.select(~np.isin(np.array(points.ids), list(blunders))) if blunders else points
    rows = []
    for name in models:
        found = first[name]
        if blunders or not isinstance(found, Fit) or found.rejected:
            found = job.attempt(name, kept, robust=False)
        if isinstance(found, Fit) and unsuited and name in unsuited:
            found = replace(found, warnings=(*found.warnings, unsuited[name]))
        parameters, minimum, dimensions = known[name]
        rows.append(
            Row(name, parameters, minimum, dimensions, fit=found) if isinstance(found, Fit)
            else Row(name, parameters, minimum, dimensions, error=found)
        )  # fmt: skip
    recommended, reason, criterion = recommend(rows)
    return Comparison(
        tuple(rows), tuple(blunders.items()), recommended, reason, criterion,
        control=int(kept.control.sum()), check=int(kept.check.sum()), model_crs=crs,
    )  # fmt: skip


@dataclass(frozen=True)
class _Job:
    own: SensorModel | None
    priors: Mapping[str, Prior]
    size: tuple[int, int] | None
    crs: str | None
    heights: tuple[float, float] | None

    def attempt(self, name: str, points: Points, robust: bool) -> Fit | str:
        """Return the fit, or why there is none."""
        try:
            if self.own is not None:
                if name == own_name(self.own, OWN):
                    return fit_own(self.own, points, self.priors, robust=robust)
                for correction in CORRECTIONS:
                    if name == own_name(self.own, correction):
                        return self._correct(self.own, correction, points, robust)
            return fit_family(name, points, crs=self.crs, size=self.size, heights=self.heights, robust=robust)
        except OrthoError as error:
            return f"{error.message}{f' ({error.remedy})' if error.remedy else ''}"

    def _correct(self, own: SensorModel, correction: str, points: Points, robust: bool) -> Fit:
        width, height = self.size or (0, 0)
        start = ImageCorrection.identity(own, correction, (width / 2, height / 2))
        return fit(start, points, robust=robust and correction != "none", name=own_name(own, correction))


def _blunders(fits: Sequence[Fit]) -> dict[str, str]:
    """Return the points that more than half of the models reject, each with the first reason given."""
    voting = [found for found in fits if found.redundancy >= 4 and found.model.params.size]
    votes = Counter(name for found in voting for name, _ in found.rejected)
    reasons: dict[str, str] = {}
    for found in voting:
        for name, reason in found.rejected:
            if votes[name] > len(voting) / 2:
                reasons.setdefault(name, reason)
    return reasons


# -- choosing --------------------------------------------------------------------------------------------------------


def recommend(rows: Sequence[Row]) -> tuple[str | None, str, str]:
    """Return the recommended model, the reason in words, and what decided: ``check``, ``leave-one-out`` or ``none``."""
    fitted = [row for row in rows if row.fit is not None]
    checks = max((int(row.fit.points.check.sum()) for row in fitted if row.fit), default=0)
    by_check = checks >= ENOUGH_TO_DECIDE
    criterion = "check" if by_check else "leave-one-out"
    errors = {row.model: found for row in fitted if row.fit and (found := _squares(row.fit, by_check)) is not None}
    if not errors:
        return None, "no model leaves redundancy: nothing can be tested on these points", "none"
    common = np.all([np.isfinite(values) for values in errors.values()], axis=0)
    if common.sum() < 3:
        return None, "fewer than three points test every model: too few to choose by", "none"
    count = int(common.sum())
    squares = {name: values[common] for name, values in errors.items()}
    by_name: Mapping[str, Row] = {row.model: row for row in rows}
    best = min(squares, key=lambda name: (squares[name].mean(), by_name[name].parameters))
    close = [name for name in squares if _as_good(squares[name], squares[best])]
    chosen = min(close, key=lambda name: (by_name[name].parameters, squares[name].mean()))
    shown = {name: f"{math.sqrt(values.mean()):.3g} px" for name, values in squares.items()}
    what = f"{count} check points" if by_check else f"{count} control points, each left out in turn"
    reason = f"{chosen}: {shown[chosen]} at {what}, with {by_name[chosen].parameters} parameters"
    if chosen == best:
        rival = len(close) > 1
        reason += "; the smallest error" + (" and no simpler model is as good" if rival else "")
    else:
        reason += (
            f"; {best} has {shown[best]} with {by_name[best].parameters} parameters, a difference within its standard "
            "error, so the model with fewer parameters is preferred"
        )
    return chosen, reason, criterion


def _squares(found: Fit, by_check: bool) -> Array | None:
    """Return squared errors (px²) per point ``(N,)``, NaN for points that do not count; None for an untested model."""
    if by_check:
        values = np.where(found.points.check[:, None], found.residuals, np.nan)
    else:
        # A model without parameters is tested by every control point.
        values = found.loo_residuals if found.model.params.size else np.where(
            found.used[:, None], found.residuals, np.nan
        )  # fmt: skip
        if found.redundancy <= 0:
            return None
    squares: Array = (values**2).sum(axis=1)
    return squares if np.isfinite(squares).any() else None


def _as_good(squares: Array, best: Array) -> bool:
    difference = squares - best
    spread = float(difference.std(ddof=1)) / math.sqrt(len(difference))
    return bool(difference.mean() <= spread)


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
