"""Compare models on the same points: one row for each, and a recommendation.

A model that cannot be fitted has a row with the reason. Gross errors are found once and left out for all models:
otherwise a model that rejects the points that it cannot fit would win.

`choice.recommendation` chooses the model.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Text
from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.choice.recommendation import recommend
from ortho_pipeline.estimation.family_fit import OWN, fit_family, fit_own
from ortho_pipeline.estimation.fit import SIGNIFICANCE, Fit, Prior, fit
from ortho_pipeline.estimation.observations.arguments import refuse_other_points
from ortho_pipeline.estimation.records import LeftOut, NoticeDocument
from ortho_pipeline.files.json.records import Count, Record, Words
from ortho_pipeline.models import ImageCorrection, SensorModel, families, family_of
from ortho_pipeline.models.correction import FREE
from ortho_pipeline.points import Points
from ortho_pipeline.points.control_hull import uncovered
from ortho_pipeline.runtime.process_limits import one_blas_thread

#: Corrections of a scene's own model.
CORRECTIONS = tuple(FREE)
#: Only models whose median error is within this factor of the smallest vote on gross errors.
_CLEAR_SIGHTED = 2.0


class PointCounts(Record):
    """Numbers of points."""

    control: Count
    check: Count


class Recommendation(Record):
    """The recommended model and the reason; the model is null if none can be recommended."""

    model: str | None
    criterion: Literal["check", "leave-one-out", "none"]
    reason: str


class ComparisonRecord(Record):
    """Models fitted to the same points by ortho compare, and its recommendation."""

    schema_version: Count
    image: str
    sensor: str
    model_crs: str | None
    points: PointCounts
    rows: tuple[ComparedModel, ...]
    left_out: tuple[LeftOut, ...]
    recommendation: Recommendation
    warnings: tuple[Words, ...]
    notices: tuple[NoticeDocument, ...] = ()
    files: dict[str, str]

    @property
    def recommended(self) -> str | None:
        """The recommended model."""
        return self.recommendation.model

    @property
    def best(self) -> ComparedModel | None:
        """The recommended row."""
        return next((row for row in self.rows if row.model == self.recommended), None)

    def noted(self, notices: Sequence[Notice]) -> Self:
        """Return the record with further notices."""
        more = to_document(notices)
        return self.replaced(warnings=(*self.warnings, *more["warnings"]), notices=(*self.notices, *more["notices"]))


def available_models(own: SensorModel | None = None) -> dict[str, tuple[int, int, int]]:
    """Return the models that can be compared: name -> (parameters, least number of points, dimensions).

    Parameters
    ----------
    own : SensorModel, optional
        The scene's own model. It comes first: as delivered, with each correction, and with its own parameters.
    """
    models: dict[str, tuple[int, int, int]] = {}
    if own is not None:
        for correction in CORRECTIONS:
            count = len(ImageCorrection.identity(own, correction, (0.0, 0.0)).param_names)
            models[own_name(own, correction)] = count, max(1, math.ceil(count / 2)), 3
        if own.param_names:
            models[own_name(own, OWN)] = len(own.param_names), own.minimum_points, 3
    for family in families():
        models[family.name] = family.parameters, family.minimum_points, family.dimensions
    return models


def own_name(own: SensorModel, correction: str) -> str:
    """Return the name of a scene's own model with a correction."""
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
            f"unknown model {', '.join(unknown)}" if unknown else "no model given",
            field="models",
            remedy=f"use all, or some of {', '.join(known)}",
        )
    return names


@one_blas_thread()
def compare(
    points: Points,
    models: Iterable[str],
    *,
    own: SensorModel | None = None,
    priors: Mapping[str, Prior] | None = None,
    size: tuple[int, int] | None = None,
    crs: str | None = None,
    heights: tuple[float, float] | None = None,
    unsuited: Mapping[str, str] | None = None,
    ridge: float | str | None = "auto",
    significance: float = SIGNIFICANCE,
    robust: bool = True,
) -> ComparisonRecord:
    """Fit several models to the same control points and test them at the same check points.

    `image` and `sensor` of the record stay empty.

    Parameters
    ----------
    models : iterable of str
        Names such as ``affine3d``, or ``all``; `available_models` lists them.
    own : SensorModel, optional
        The scene's own model, for names such as ``rpc+shift``.
    priors : mapping of parameter name to Prior, optional
        Accuracy of its own parameters as delivered.
    size : (int, int), optional
        Columns and rows of the image.
    crs : str, optional
        Ground CRS of the classical models: geocentric, geographic, utm or EPSG:n; default: that of the points.
    heights : (lo, hi), optional
        Height range (m) of the models.
    unsuited : mapping of str to str, optional
        Unsuitable families, each with its warning.
    ridge : float, 'gcv', 'lcurve', 'auto' or None
        Regularisation of rational functions, as for `fit_family`.
    significance : float
        Of the tests of parameters.
    robust : bool
        Find gross errors and leave them out.

    Raises
    ------
    InputError
        If a name is unknown or there is none.

    Examples
    --------
    >>> points = op.read_points("sample_data/gcps.geojson")
    >>> op.compare(points, ["affine3d", "dlt"], size=(1000, 1000)).recommended
    'affine3d'
    """
    refuse_other_points(points)
    known = available_models(own)
    models = choose_models(models if isinstance(models, str) else ",".join(map(str, models)), own)
    job = _Job(own, dict(priors or {}), size, crs, heights, ridge)
    first = {name: job.attempt(name, points, robust) for name in models}
    blunders = _blunders([outcome for outcome in first.values() if isinstance(outcome, Fit)])
    kept = points.select(~np.isin(np.array(points.ids), list(blunders))) if blunders else points
    rows = []
    for name in models:
        outcome = first[name]
        if blunders or not isinstance(outcome, Fit) or outcome.rejected:
            outcome = job.attempt(name, kept, False)
        if isinstance(outcome, Fit):
            outcome = replace(outcome, significance=significance)
        if isinstance(outcome, Fit) and unsuited and name in unsuited:
            warning = Notice("unsuited-model", unsuited[name], model=name)
            outcome = replace(outcome, warnings=(*outcome.warnings, warning))
        rows.append(ComparedModel.of(name, known[name], outcome))
    corrections = () if own is None else [own_name(own, name) for name in (*CORRECTIONS, OWN)]
    recommended, reason, criterion = recommend(rows, preferred=corrections, unsuited=tuple(unsuited or ()), size=size)
    return ComparisonRecord(
        schema_version=1,
        image="",
        sensor="",
        model_crs=crs,
        points=PointCounts(control=kept.control.sum(), check=kept.check.sum()),
        rows=tuple(rows),
        left_out=tuple(LeftOut(id=name, reason=reason) for name, reason in blunders.items()),
        recommendation=Recommendation.model_validate({"model": recommended, "criterion": criterion, "reason": reason}),
        **to_document(uncovered(kept.image[kept.control], size)),
        files={},
    )


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
            return Text(error.message, " (", error.remedy, ")") if error.remedy else error.message

    def _correct(self, own: SensorModel, correction: str, points: Points, robust: bool) -> Fit:
        width, height = self.size or (0, 0)
        start = ImageCorrection.identity(own, correction, (width / 2, height / 2))
        return fit(start, points, robust=robust and correction != "none", name=own_name(own, correction))


def _blunders(fits: Sequence[Fit]) -> dict[str, str]:
    """Return the points that more than half of the models reject, each with the first reason.

    Poor models cannot see gross errors, so only models with about the smallest errors vote.
    """
    able = [result for result in fits if result.redundancy >= 4 and result.model.params.size]
    sizes = [_median_error(result) for result in able]
    limit = _CLEAR_SIGHTED * min(sizes, default=0.0)
    voting = [result for result, size in zip(able, sizes, strict=True) if size <= limit]
    votes = Counter(name for result in voting for name, _ in result.rejected)
    reasons: dict[str, str] = {}
    for result in voting:
        for name, reason in result.rejected:
            if votes[name] > len(voting) / 2:
                reasons.setdefault(name, reason)
    return reasons


def _median_error(result: Fit) -> float:
    """Return the median prediction error (px) of all control points, including rejected ones."""
    errors = np.where(result.used[:, None], result.loo_residuals, result.residuals)[result.points.control]
    sizes = np.hypot(*np.where(np.isfinite(errors), errors, np.inf).T)
    return float(np.median(sizes))
