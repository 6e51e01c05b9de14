r"""Tikhonov regularisation, and the choice of its weight.

With normalised image coordinates and normalised coefficients c beyond the affine part, the adjustment minimises
:math:`\sum v_n^2 + \lambda \sum (g c)^2`: each such coefficient is observed as zero, with a sigma of
:math:`\sigma_{image} / (g S \sqrt{\lambda})` for an image of half-size S. The grade g is 1 for the lowest penalised
terms and ten times larger for each further order, because the effects of real sensors decrease like this. The weight
:math:`\lambda` is given, or found by generalised cross-validation or at the corner of the L-curve, on the problem
linearised at its solution.

Source: Golub, Heath and Wahba 1979 (GCV); Kim and Gu 2004 (factor 1.4 against undersmoothing); Hansen 1992 (L-curve).
"""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.problem import Problem
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.families import exponents
from ortho_pipeline.models.rational import Rational

METHODS = ("gcv", "lcurve")
#: Lower limit of the weight, relative to the largest singular value of the penalised part of the design.
_WEAKEST = 1e-5
#: Weight of each parameter in GCV: with 1, small samples are sometimes overfitted.
_CAUTION = 1.4
_ROUNDS = 5
_GRADE = 10.0


def regularised(
    problem: Problem, keep: np.ndarray, ridge: float | str, *, linear: bool = False
) -> tuple[Problem, float]:
    """Return the problem with pseudo-observations of the coefficients, and their weight lambda.

    Parameters
    ----------
    keep : (n,) bool
        The points that determine the choice.
    ridge : float or 'gcv' or 'lcurve'
    linear : bool
        Choose on the problem linearised at the start values, for points that may have gross errors.

    Raises
    ------
    InputError
        If the model has no coefficients to regularise, or the weight is not positive.
    """
    model = problem.model
    if not isinstance(model, Rational) or not model.penalised:
        raise InputError("only models with higher-order terms can be regularised", field="ridge")
    if isinstance(ridge, str):
        if ridge not in METHODS:
            raise InputError(
                f"unknown regularisation {ridge!r}", field="ridge", remedy=f"use {', '.join(METHODS)} or a number"
            )
        return _chosen(problem, keep, ridge, model, 1 if linear else _ROUNDS)
    if not (math.isfinite(ridge) and ridge > 0):
        raise InputError("the weight of the regularisation must be a positive number", field="ridge")
    return problem.with_ridge(_sigmas(problem, model, ridge)), float(ridge)


def _weight(problem: Problem, model: Rational) -> float:
    """Return the displacement of the image edge by a coefficient of one, in sigmas of the image."""
    return float(model.image_scale.mean() / np.median(problem.errors.sigma))


def _sigmas(problem: Problem, model: Rational, strength: float) -> dict[str, float]:
    unit = 1.0 / (_weight(problem, model) * math.sqrt(strength))
    return {name: unit / _grade(name) for name in model.penalised}


def _grade(name: str) -> float:
    """Return the penalty of a coefficient relative to the lowest penalised order of its part."""
    order = int(exponents(name.rpartition("_")[2]).sum())
    return _GRADE ** (order - (1 if "den_" in name else 2))


def _chosen(problem: Problem, keep: np.ndarray, method: str, model: Rational, rounds: int) -> tuple[Problem, float]:
    """Alternate between the choice on the linearised problem and its solution, until the choice is stable."""
    strength, current = 0.0, model
    for number in range(rounds):
        before, strength = strength, _choice(problem, keep, method, current)
        problem = problem.with_ridge(_sigmas(problem, model, strength))
        if number + 1 == rounds or (before and abs(math.log(strength / before)) < 0.1):
            break
        solved = problem.started(current).solve(keep).model
        assert isinstance(solved, Rational)
        current = solved
    return problem.started(current), strength


def _choice(problem: Problem, keep: np.ndarray, method: str, model: Rational) -> float:
    ground, errors = problem.ground[keep], problem.errors[keep]
    count = len(model.params)
    design = errors.whitened(model.param_partials(ground)).reshape(-1, count)
    observed = errors.whitened(problem.image[keep] - model.ground_to_image(ground)).ravel() + design @ model.params
    drawn = np.isin(np.array(model.param_names), model.penalised)
    q, _ = np.linalg.qr(design[:, ~drawn])
    grades = np.array([_grade(name) for name in model.penalised]) * _weight(problem, model)
    inner = (design[:, drawn] - q @ (q.T @ design[:, drawn])) / grades
    u, s, _ = np.linalg.svd(inner, full_matrices=False)
    observed = observed - q @ (q.T @ observed)
    along = u.T @ observed
    rest = max(float(observed @ observed - along @ along), 0.0)
    grid = s[0] ** 2 * np.logspace(2 * math.log10(_WEAKEST), 0, 81)
    filters = s**2 / (s**2 + grid[:, None])
    squares = (((1 - filters) * along) ** 2).sum(axis=1) + rest
    if method == "gcv":
        freedom = len(observed) - _CAUTION * (q.shape[1] + filters.sum(axis=1))
        merit = np.where(freedom > 0, squares / np.maximum(freedom, 1e-9) ** 2, np.inf)
        return float(grid[int(np.argmin(merit))])
    with np.errstate(divide="ignore", invalid="ignore"):
        sizes = ((np.where(s > 0, filters / s, 0.0) * along) ** 2).sum(axis=1)
    return float(grid[_corner(np.log(squares + 1e-300), np.log(sizes + 1e-300))])


def _corner(x: Array, y: Array) -> int:
    """Return the index at which a curve turns most sharply towards the origin."""
    dx, dy = np.gradient(x), np.gradient(y)
    ddx, ddy = np.gradient(dx), np.gradient(dy)
    with np.errstate(divide="ignore", invalid="ignore"):
        bend = (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5
    return int(np.nanargmax(np.where(np.isfinite(bend), bend, -np.inf)))
