"""Vector-valued B-splines of time: satellite path and attitude of a line scanner."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.models.base import Array


@dataclass(frozen=True, eq=False)
class Spline:
    """A spline with three components.

    Parameters
    ----------
    degree : int
        1 to 5.
    breaks : (m + 1,)
        Times at which the m polynomials meet, ends included: the knots, each counted once.
    coefficients : (m + degree, 3)
        Of the B-splines on these knots, the outer ones repeated so that first and last coefficient are the end values.
    beyond : int
        Degree of the Taylor polynomial with which the spline goes on before its first and after its last knot.
    """

    degree: int
    breaks: Array
    coefficients: Array
    beyond: int = 1

    def __post_init__(self) -> None:
        breaks, coefficients = (np.array(value, dtype=np.float64) for value in (self.breaks, self.coefficients))
        if not (isinstance(self.degree, int) and isinstance(self.beyond, int)):
            raise InputError(f"degrees {self.degree} and {self.beyond} are not whole numbers", field="degree, beyond")
        if not 1 <= self.degree <= 5 or not 0 <= self.beyond <= self.degree:
            raise InputError(f"degree {self.degree}, continued with {self.beyond}, is not a spline", field="degree")
        if breaks.ndim != 1 or len(breaks) < 2 or not np.isfinite(breaks).all() or not (np.diff(breaks) > 0).all():
            raise InputError("the knots of a spline are at least two increasing times", field="breaks")
        if coefficients.shape != (len(breaks) - 1 + self.degree, 3) or not np.isfinite(coefficients).all():
            raise InputError(
                f"a spline of degree {self.degree} with {len(breaks)} knots has {len(breaks) - 1 + self.degree} x 3 "
                f"finite coefficients, not {coefficients.shape}",
                field="coefficients",
            )
        for name, value in (("breaks", breaks), ("coefficients", coefficients)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @classmethod
    def fitted(cls, times: ArrayLike, values: ArrayLike, degree: int, breaks: ArrayLike, beyond: int = 1) -> Self:
        """Return the spline that fits values ``(N, 3)`` at times ``(N,)`` by least squares.

        Raises
        ------
        InputError
            If the times do not determine every coefficient.
        """
        breaks = np.asarray(breaks, dtype=np.float64)
        values = np.asarray(values, dtype=np.float64)
        count = len(breaks) - 1 + degree
        empty = cls(degree, breaks, np.zeros((count, 3)), beyond)
        # About the mean, so that positions in space keep all their digits.
        middle = values.mean(axis=0)
        basis = empty.basis(times)
        if not (np.isfinite(basis).all() and np.isfinite(values).all()):
            raise InputError(
                "times or values of a table are so far apart that no spline follows them",
                field="breaks",
                remedy="the file is damaged: copy it again",
            )
        found, _, rank, _ = np.linalg.lstsq(basis, values - middle, rcond=1e-10)
        if rank < count:
            raise InputError(
                f"{counted(len(values), 'time does', 'times do')} not determine {counted(count, 'spline coefficient')}",
                field="breaks",
                remedy="use fewer knots, or a table that covers all of them",
            )
        return cls(degree, breaks, found + middle, beyond)

    @property
    def size(self) -> int:
        """Number of coefficients per component."""
        return len(self.coefficients)

    @property
    def sites(self) -> Array:
        """Times ``(size,)`` that the coefficients belong to (Greville); coefficients linear there make a line."""
        return self._unit.sites

    def __call__(self, times: ArrayLike, derivative: int = 0) -> Array:
        """Return values ``(N, 3)`` at times ``(N,)``, or a derivative by time."""
        return self.basis(times, derivative) @ self.coefficients

    def basis(self, times: ArrayLike, derivative: int = 0) -> Array:
        """Return the B-splines (or a derivative of theirs) at times ``(N,)``, as ``(N, size)``; NaN stays NaN."""
        times = np.asarray(times, dtype=np.float64)
        unit = self._unit
        out = np.full((len(times), self.size), np.nan)
        with np.errstate(invalid="ignore"):
            before, after = times < self.breaks[0], times >= self.breaks[-1]
            inside = ~(before | after) & np.isfinite(times)
        out[inside] = unit.inside[derivative](times[inside]) if derivative <= self.degree else 0.0
        for (end, terms), rows in zip(unit.ends.items(), (before, after), strict=True):
            if not rows.any():
                continue
            out[rows] = 0.0
            for order in range(derivative, self.beyond + 1):
                power = (times[rows] - end) ** (order - derivative) / math.factorial(order - derivative)
                out[rows] += power[:, None] * terms[order]
        return out

    def pieces(self, origins: Array) -> Array:
        """Return Taylor coefficients ``(k, degree + 1, 3)`` at times ``(k,)``: of the polynomials that begin there."""
        terms = [self(origins, order) / math.factorial(order) for order in range(self.degree + 1)]
        return np.stack(terms, axis=1)

    def with_coefficients(self, coefficients: ArrayLike) -> Self:
        """Return this spline with other coefficients ``(size, 3)``."""
        return type(self)(self.degree, self.breaks, np.asarray(coefficients, dtype=np.float64), self.beyond)

    def plus_line(self, offset: Array, drift: Array, centre: float) -> Self:
        """Return the spline plus ``offset + drift * (t - centre)``, each ``(3,)``."""
        return self.with_coefficients(self.coefficients + offset + np.outer(self.sites - centre, drift))

    def to_dict(self) -> dict[str, Any]:
        """Return the spline as plain data."""
        return {
            "degree": self.degree,
            "breaks": self.breaks.tolist(),
            "coefficients": self.coefficients.tolist(),
            "beyond": self.beyond,
        }

    @property
    def _unit(self) -> _Unit:
        return _unit_of(self.degree, tuple(self.breaks.tolist()), self.beyond)


@dataclass(frozen=True)
class SplineForm:
    """Degree of the splines of path and attitude, and how many polynomials each has; None leaves that to the table."""

    degree: int
    path: int | None = None
    attitude: int | None = None


class _Unit:
    """The B-splines themselves, which splines on the same knots share."""

    def __init__(self, degree: int, breaks: tuple[float, ...], beyond: int) -> None:
        knots = np.array([breaks[0]] * degree + list(breaks) + [breaks[-1]] * degree)
        from scipy.interpolate import BSpline  # takes half of the start-up of a command

        whole = BSpline(knots, np.eye(len(breaks) - 1 + degree), degree)
        self.inside = [whole, *(whole.derivative(order) for order in range(1, degree + 1))]
        self.sites = np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(len(breaks) - 1 + degree)])
        #: Values and derivatives at both ends, as far as they go on.
        self.ends = {
            end: [self.inside[order](np.array([end]))[0] for order in range(beyond + 1)]
            for end in (breaks[0], breaks[-1])
        }


@functools.lru_cache(maxsize=256)
def _unit_of(degree: int, breaks: tuple[float, ...], beyond: int) -> _Unit:
    return _Unit(degree, breaks, beyond)
