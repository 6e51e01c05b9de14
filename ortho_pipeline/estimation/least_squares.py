r"""Linear algebra of the adjustment: least squares by orthogonal triangulation, and Gauss-Newton on top of it.

The design matrix :math:`A` is scaled to columns of length one and factored, :math:`A S = Q R`. Normal equations, which
square the condition number, are never formed. The solution is refined with residuals in extended precision (Bjoerck's
augmented system), so nearly all digits are correct whenever the points determine the parameters.

Source: Golub 1965 (Householder triangulation); Bjoerck 1967 (refinement); Bates and Watts 1988 (relative offset).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.errors import NotConverged
from ortho_pipeline.geodesy.ellipsoid import Array

_REFINEMENTS = 3
_STEPS = 30
#: Gauss-Newton stops when a step would change the residuals by less than this part of their length.
_RELATIVE_OFFSET = 1e-10


@dataclass(frozen=True, eq=False)
class LinearSolution:
    """Least-squares solution of ``design @ values = observed``.

    `cofactors` ``(P, P)`` is the inverse of the normal matrix. `condition` is the ratio of the extreme singular values
    of the design with columns of length one; if the rank is deficient, it is inf, and values and cofactors are NaN.
    """

    values: Array
    residuals: Array
    cofactors: Array
    condition: float

    @property
    def sigma0(self) -> float:
        """Standard deviation of an observation of unit weight; NaN without redundancy."""
        freedom = len(self.residuals) - len(self.values)
        return math.sqrt(float(self.residuals @ self.residuals) / freedom) if freedom > 0 else math.nan

    @property
    def sigmas(self) -> Array:
        """Standard deviations of the values ``(P,)``."""
        return self.sigma0 * np.sqrt(np.diag(self.cofactors))


def solve_linear(design: Array, observed: Array, *, refine: bool = True) -> LinearSolution:
    """Solve an overdetermined linear system ``(n, P)`` for ``(P,)`` values by least squares.

    For weights other than one, the caller scales both rows and right side.
    """
    design, observed = np.asarray(design, dtype=float), np.asarray(observed, dtype=float)
    rows, count = design.shape
    if not count:
        return LinearSolution(np.zeros(0), observed.copy(), np.zeros((0, 0)), 1.0)
    length = np.linalg.norm(design, axis=0)
    length[length == 0] = 1.0
    nothing = LinearSolution(np.full(count, np.nan), np.full(rows, np.nan), np.full((count, count), np.nan), math.inf)
    if rows < count or not np.isfinite(design).all():
        return nothing
    # Scaling by powers of two has no rounding, so the refinement solves exactly the given system.
    scale = np.exp2(np.round(np.log2(length)))
    scaled = design / scale
    q, r = np.linalg.qr(scaled)
    singular = np.linalg.svd(r * (scale / length), compute_uv=False)
    if not singular[-1] > 1e-15 * singular[0]:
        return nothing
    inverse = np.linalg.inv(r)
    values = inverse @ (q.T @ observed)
    residuals = observed - scaled @ values
    if refine:
        values, residuals = _refined(scaled, observed, q, inverse, values, residuals)
    root = inverse / scale[:, None]
    return LinearSolution(values / scale, residuals, root @ root.T, float(singular[0] / singular[-1]))


def _refined(
    scaled: Array, observed: Array, q: Array, inverse: Array, values: Array, residuals: Array
) -> tuple[Array, Array]:
    """Correct solution and residuals together: A x + r = b and A' r = 0, with misclosures in extended precision."""
    wide, x, r = scaled.astype(np.longdouble), values.astype(np.longdouble), residuals.astype(np.longdouble)
    for _ in range(_REFINEMENTS):
        miss = (observed - wide @ x - r).astype(float)
        slant = (-(wide.T @ r)).astype(float)
        along = inverse.T @ slant
        r_step = miss - q @ (q.T @ miss) + q @ along
        x += inverse @ (q.T @ miss - along)
        r += r_step
    return x.astype(float), r.astype(float)


def condition_of(design: Array) -> float:
    """Return the condition of a design matrix ``(n, P)`` with columns of length one; inf if its rank is deficient."""
    if design.shape[0] < design.shape[1] or not np.isfinite(design).all():
        return math.inf
    scale = np.linalg.norm(design, axis=0)
    if (scale == 0).any():
        return math.inf
    singular = np.linalg.svd(np.linalg.qr(design / scale, mode="r"), compute_uv=False)
    return float(singular[0] / singular[-1]) if singular[-1] > 0 else math.inf


def minimise(
    residuals: Callable[[Array], Array], slopes: Callable[[Array], Array], start: Array, *, singular: float = 1e12
) -> Array:
    """Return the parameters ``(P,)`` that minimise the sum of squares of `residuals`.

    Parameters
    ----------
    residuals : callable(params) -> (n,)
        Observed minus predicted, over their sigma.
    slopes : callable(params) -> (n, P)
        Derivatives of the *predicted* values, over the same sigma.
    start : (P,)
    singular : float
        If the iteration stays in a flat valley with this condition number or worse, the parameters there are returned;
        the caller reports that they are not determined.

    Raises
    ------
    NotConverged
        If the iteration does not converge.
    """
    params = np.asarray(start, dtype=float)
    solution = _gauss_newton(residuals, slopes, params)
    if solution is not None:
        return solution
    # Far from the solution, the damped steps of Levenberg and Marquardt work better than halved ones.
    params, arrived = _levenberg_marquardt(residuals, slopes, params)
    solution = _gauss_newton(residuals, slopes, params)
    if solution is not None:
        return solution
    # In a flat valley, the caller reports undetermined parameters from the condition number of the design.
    if arrived or condition_of(slopes(params)) > singular:
        return params
    raise NotConverged("the adjustment did not converge", remedy="give better start values, or adjust fewer parameters")


def _gauss_newton(residuals: Callable[[Array], Array], slopes: Callable[[Array], Array], params: Array) -> Array | None:
    left = residuals(params)
    if not np.isfinite(left).all():
        return None
    for _ in range(_STEPS):
        square = float(left @ left)
        design = slopes(params)
        solution = solve_linear(design, left, refine=False)
        if not np.isfinite(solution.values).all():
            return None
        promised = float(np.linalg.norm(design @ solution.values))
        small = promised <= _RELATIVE_OFFSET * math.sqrt(square) + 1e-13 * math.sqrt(len(left))
        factor = 1.0
        while factor > 1e-4:
            ahead = params + factor * solution.values
            after = residuals(ahead)
            if np.isfinite(after).all() and float(after @ after) <= square * (1 + 1e-12):
                break
            factor /= 2
        else:
            return params if small or promised <= 1e-7 * math.sqrt(square) else None
        stalled = float(np.abs(factor * solution.values).max()) <= 1e-16 * float(np.abs(params).max(initial=0.0))
        params, left = ahead, after
        if small or stalled:
            return params
    return None


def _levenberg_marquardt(
    residuals: Callable[[Array], Array], slopes: Callable[[Array], Array], params: Array
) -> tuple[Array, bool]:
    """Return parameters, and whether the iteration converged."""
    from scipy.optimize import least_squares

    try:
        result = least_squares(
            residuals, params, lambda x: -slopes(x), method="lm", x_scale="jac", ftol=1e-15, xtol=1e-15, max_nfev=2000
        )
    except ValueError as error:
        raise NotConverged(f"the adjustment left the domain of the model ({error})") from error
    return np.asarray(result.x), bool(result.status > 0 and np.isfinite(result.x).all())
