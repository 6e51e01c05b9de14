"""Recommend one of the compared models.

The recommended model has the smallest expected error over the whole scene (`expected_error`). This is computed from
errors at check points, and at control points left out one at a time.

1. A model that is unstable, unsuitable or contradicted by the points is never recommended.
2. If the scene has its own model, one of its corrections is recommended, unless another model is significantly better
   (5 % level, paired differences of squared errors at the same points).
3. Among models within 2 % of the smallest expected error, the one with the fewest parameters is recommended.

The smallest error at the points would often belong to a model that is best by chance: there are some twenty candidates,
and those with many parameters vary most. docs/engineering/accuracy.md states the cost of this choice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.choice.expected_error import Expectation, expectation, supported
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.statistics import student_of
from ortho_pipeline.models.base import Array

#: Chance that the scene's own model is rejected although the other one is only equally good (one-sided).
_SIGNIFICANTLY_WORSE = 0.05
#: A smaller improvement of the RMSE (a factor) does not justify one more parameter or another model.
_WORTH = 1.02

_Squares = dict[str, Array]


def recommend(
    rows: Sequence[ComparedModel],
    *,
    preferred: Sequence[str] = (),
    unsuited: Sequence[str] = (),
    size: tuple[int, int] | None = None,
) -> tuple[str | None, str, str]:
    """Return the recommended model, the reason in words, and the criterion.

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
        The criterion is ``check`` (check points, and control points left out one at a time), ``leave-one-out`` or
        ``none``.
    """
    by_name = {row.model: row for row in rows if row.fit is not None}
    squares, tests, checks = _tests(list(by_name.values()))
    if not squares:
        return None, "no model has redundancy on these points, so none can be tested", "none"
    count = int(tests.sum())
    if count < 3:
        return None, "fewer than three points test all models, too few for a recommendation", "none"
    doubts = {name: _doubts(by_name[name], unsuited) for name in squares}
    sound = {name: values for name, values in squares.items() if not doubts[name]}
    smallest = min(squares, key=lambda name: (squares[name].mean(), by_name[name].parameters))
    if not sound:
        return None, f"no model that can be tested is reliable; {smallest} is {doubts[smallest]}", "none"
    expected = {name: expectation(by_name[name].fit, tests, size) for name in sound}  # type: ignore[arg-type]
    errors = expected_errors(sound, expected)
    chosen = _choose(sound, errors, by_name, [name for name in preferred if name in errors])
    reason = f"{chosen}: expected error {significant(errors[chosen], 3)} px over the scene; "
    reason += f"RMSE {_shown(squares[chosen])} at "
    reason += f"{_what(checks, count - checks)}; {counted(by_name[chosen].parameters, 'parameter')}"
    reason += _but(chosen, smallest, squares, errors, doubts, by_name)
    return chosen, reason, "check" if checks else "leave-one-out"


def expected_errors(squares: Mapping[str, Array], expected: Mapping[str, Expectation]) -> dict[str, float]:
    """Return the expected error (root mean square, px) over the scene of each model that the points support."""
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
    """Return in words why the model with the smallest error at the points is not recommended, and reservations."""
    text = ""
    if smallest != chosen:
        text = f". {smallest} has RMSE {_shown(squares[smallest])} with "
        text += f"{counted(rows[smallest].parameters, 'parameter')}, "
        if doubts[smallest]:
            text += f"but is {doubts[smallest]}"
        elif smallest not in errors:
            text += "but these points do not support it"
        else:
            better, simpler = errors[chosen] / errors[smallest], rows[chosen].parameters < rows[smallest].parameters
            error = f"expected error over the scene ({significant(errors[smallest], 3)} px)"
            if better < 1:
                text += f"but its {error} is larger"
            elif better > _WORTH:
                text += f"but its {error} is not significantly smaller"
            else:
                text += f"but its {error} is less than 2 % smaller, so "
                text += "the model with fewer parameters" if simpler else "the scene's own model"
                text += " is recommended"
    fit = rows[chosen].fit
    weak = ", ".join(fit.reservations) if fit else ""
    return text + (f". {chosen} is {weak}: measure points there" if weak else "")


def _shown(squares: Array) -> str:
    return f"{significant(math.sqrt(squares.mean()), 3)} px"


def _tests(rows: Sequence[ComparedModel]) -> tuple[_Squares, np.ndarray, int]:
    """Return squared errors (px²) of each model at the points that test all models, their mask, and the check count.

    A model without redundancy has no leave-one-out errors; only check points can test it. Check points that contradict
    the model with the smallest median are not used.
    """
    fits = {row.model: row.fit for row in rows if row.fit is not None}
    errors = {name: _squares(fit) for name, fit in fits.items() if fit.redundancy > 0}
    if not errors:
        errors = {name: np.where(fit.points.check, _squares(fit), np.nan) for name, fit in fits.items()}
    errors = {name: values for name, values in errors.items() if np.isfinite(values).any()}
    if not errors:
        return {}, np.zeros(0, dtype=bool), 0
    clearest = fits[min(errors, key=lambda name: float(np.nanmedian(errors[name])))]
    wrong = [point.id for point in clearest.outlying if point.role == "check"]
    common = np.all([np.isfinite(values) for values in errors.values()], axis=0)
    common &= ~np.isin(np.array(clearest.points.ids), wrong)
    return (
        {name: values[common] for name, values in errors.items()},
        common,
        int((common & clearest.points.check).sum()),
    )


def _squares(fit: Fit) -> Array:
    """Return squared errors (px²) per point ``(N,)``: check points, control points left out; NaN for others."""
    # A model without parameters is tested by every control point.
    control = fit.loo_residuals if fit.model.params.size else np.where(fit.used[:, None], fit.residuals, np.nan)
    values = np.where(fit.points.check[:, None], fit.residuals, control)
    squares: Array = (values**2).sum(axis=1)
    return squares


def _doubts(row: ComparedModel, unsuited: Sequence[str]) -> str:
    """Return why a model is not recommended, whatever its errors; empty if there is no reason.

    Uncertainty at a corner is no reason, because it is part of the expected error.
    """
    reasons = [reservation for reservation in row.fit.reservations if reservation == "unstable"] if row.fit else []
    return " and ".join([*reasons, *(["unsuited to the scene"] if row.model in unsuited else [])])


def _choose(
    squares: _Squares, errors: Mapping[str, float], rows: Mapping[str, ComparedModel], preferred: Sequence[str]
) -> str:
    """Return the name of the recommended model."""
    candidates: Sequence[str] = list(errors)
    if preferred:
        own, best = (min(names, key=errors.__getitem__) for names in (preferred, candidates))
        if not _significantly_worse(squares[own], squares[best]):
            candidates = preferred
    limit = _WORTH * min(errors[name] for name in candidates)
    close = [name for name in candidates if errors[name] <= limit]
    return min(close, key=lambda name: (rows[name].parameters, errors[name]))


def _significantly_worse(squares: Array, best: Array) -> bool:
    """Return whether errors are larger than those of the best model, by more than `_WORTH` and more than by chance."""
    if squares.mean() <= _WORTH**2 * best.mean():
        return False
    difference = squares - best
    variance = difference.var(ddof=1) / len(difference)
    _, p = student_of(difference.mean()[None], np.array([[variance]]), len(difference) - 1)
    return bool(p[0] / 2 < _SIGNIFICANTLY_WORSE)


def _what(checks: int, control: int) -> str:
    """Return in words which points tested the models."""
    left_out = f"{counted(control, 'control point')} (leave-one-out)"
    if not checks:
        return left_out
    return counted(checks, "check point") + (f" and {left_out}" if control else "")
