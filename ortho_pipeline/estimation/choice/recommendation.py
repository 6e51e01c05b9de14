"""Which of the models that were compared to take.

The recommendation is the model with the smallest error that is expected over the whole scene (`expected_error`), from
the errors at all points that took no part: check points, and control points each left out in turn.

1. A model that is unstable or unsuited, or that the points contradict, is never recommended.
2. Where the scene has a model of its own, one of its corrections is taken, unless another model is significantly better
   at the points that took no part: at 5 % in paired differences of the squared errors at the same points.
3. Of the models within 2 % of the smallest expected error, the one with the fewest parameters.

The smallest error at the points would be that of a model that is best by chance: there are some twenty candidates, and
those with nearly as many parameters as observations vary most. docs/engineering/accuracy.md has what the choice costs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.choice.expected_error import Expectation, expectation, supported
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.statistics import student_of
from ortho_pipeline.models.base import Array

#: Chance of calling the corrections of the scene's own model worse than another one that is as good, one-sided.
_SIGNIFICANTLY_WORSE = 0.05
#: Smaller differences of the RMSE, as a factor, are not worth a parameter, nor another model than the scene's own.
_WORTH = 1.02

_Squares = dict[str, Array]


def recommend(
    rows: Sequence[ComparedModel],
    *,
    preferred: Sequence[str] = (),
    unsuited: Sequence[str] = (),
    size: tuple[int, int] | None = None,
) -> tuple[str | None, str, str]:
    """Return the recommended model, the reason in words, and what decided.

    Parameters
    ----------
    preferred : sequence of str
        The scene's own model with its corrections.
    unsuited : sequence of str
        Models that do not suit the scene.
    size : (int, int), optional
        Columns and rows of the image.

    Returns
    -------
    tuple
        The third is ``check`` (check points, and control points left out in turn), ``leave-one-out`` or ``none``.
    """
    by_name = {row.model: row for row in rows if row.fit is not None}
    squares, tests, checks = _tests(list(by_name.values()))
    if not squares:
        return None, "no model leaves redundancy: nothing can be tested on these points", "none"
    count = int(tests.sum())
    if count < 3:
        return None, "fewer than three points test every model: too few to choose by", "none"
    doubts = {name: _doubts(by_name[name], unsuited) for name in squares}
    sound = {name: values for name, values in squares.items() if not doubts[name]}
    smallest = min(squares, key=lambda name: (squares[name].mean(), by_name[name].parameters))
    if not sound:
        return None, f"every model that can be tested is doubtful; {smallest} is {doubts[smallest]}", "none"
    expected = {name: expectation(by_name[name].fit, tests, size) for name in sound}  # type: ignore[arg-type]
    errors = expected_errors(sound, expected)
    chosen = _choose(sound, errors, by_name, [name for name in preferred if name in errors])
    reason = f"{chosen}: {errors[chosen]:.3g} px expected over the scene, {_shown(squares[chosen])} at "
    reason += f"{_what(checks, count - checks)}, with {counted(by_name[chosen].parameters, 'parameter')}"
    reason += _but(chosen, smallest, squares, errors, doubts, by_name)
    return chosen, reason, "check" if checks else "leave-one-out"


def expected_errors(squares: Mapping[str, Array], expected: Mapping[str, Expectation]) -> dict[str, float]:
    """Return the root mean square (px) that is expected over the scene of each model that the points support."""
    names, noise = supported(expected, _WORTH)
    return {name: math.sqrt(expected[name].square(float(squares[name].mean()), noise)) for name in names}


def _but(
    chosen: str,
    smallest: str,
    squares: _Squares,
    errors: Mapping[str, float],
    doubts: Mapping[str, str],
    rows: Mapping[str, ComparedModel],
) -> str:
    """Return in words why the model with the smallest error at the points is not taken, and what to mind."""
    text = ""
    if smallest != chosen:
        text = f"; {smallest} has {_shown(squares[smallest])} with {counted(rows[smallest].parameters, 'parameter')}, "
        if doubts[smallest]:
            text += f"and is {doubts[smallest]}"
        elif smallest not in errors:
            text += "and these points do not support it"
        else:
            text += f"and {errors[smallest]:.3g} px are expected over the scene"
    found = rows[chosen].fit
    weak = ", ".join(found.reservations) if found else ""
    return text + (f"; it is {weak}: measure points there" if weak else "")


def _shown(squares: Array) -> str:
    return f"{math.sqrt(squares.mean()):.3g} px"


def _tests(rows: Sequence[ComparedModel]) -> tuple[_Squares, np.ndarray, int]:
    """Return squared errors (px²) of each model at the points that test all of them, their mask, how many are checks.

    Without redundancy no control point can be left out; such models are tested where check points alone test all.
    Check points that contradict the model with the smallest median test none.
    """
    fits = {row.model: row.fit for row in rows if row.fit is not None}
    errors = {name: _squares(found) for name, found in fits.items() if found.redundancy > 0}
    if not errors:
        errors = {name: np.where(found.points.check, _squares(found), np.nan) for name, found in fits.items()}
    errors = {name: values for name, values in errors.items() if np.isfinite(values).any()}
    if not errors:
        return {}, np.zeros(0, dtype=bool), 0
    clearest = fits[min(errors, key=lambda name: float(np.nanmedian(errors[name])))]
    wrong = [one.id for one in clearest.outlying if one.role == "check"]
    common = np.all([np.isfinite(values) for values in errors.values()], axis=0)
    common &= ~np.isin(np.array(clearest.points.ids), wrong)
    return (
        {name: values[common] for name, values in errors.items()},
        common,
        int((common & clearest.points.check).sum()),
    )


def _squares(found: Fit) -> Array:
    """Return squared errors (px²) per point ``(N,)`` of check points and of control points left out; NaN for others."""
    # A model without parameters is tested by every control point.
    control = found.loo_residuals if found.model.params.size else np.where(found.used[:, None], found.residuals, np.nan)
    values = np.where(found.points.check[:, None], found.residuals, control)
    squares: Array = (values**2).sum(axis=1)
    return squares


def _doubts(row: ComparedModel, unsuited: Sequence[str]) -> str:
    """Return why a model is not recommended whatever its errors; empty if there is no reason.

    That it is uncertain at a corner is part of the error that is expected of it.
    """
    found = [one for one in row.fit.reservations if one == "unstable"] if row.fit else []
    return " and ".join([*found, *(["unsuited to the scene"] if row.model in unsuited else [])])


def _choose(
    squares: _Squares, errors: Mapping[str, float], rows: Mapping[str, ComparedModel], preferred: Sequence[str]
) -> str:
    """Return the model to take."""
    candidates: Sequence[str] = list(errors)
    if preferred:
        own, best = (min(names, key=errors.__getitem__) for names in (preferred, candidates))
        if not _significantly_worse(squares[own], squares[best]):
            candidates = preferred
    limit = _WORTH * min(errors[name] for name in candidates)
    close = [name for name in candidates if errors[name] <= limit]
    return min(close, key=lambda name: (rows[name].parameters, errors[name]))


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
