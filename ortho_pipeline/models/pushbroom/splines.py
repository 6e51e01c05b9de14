"""Vector-valued B-splines of time: path and attitude of a line scanner."""

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
        Knots, each once: the times at which the m polynomials meet, and both ends.
    coefficients : (m + degree, 3)
        Coefficients of the B-splines. Outer knots are repeated, so first and last coefficient are the end values.
    beyond : int
        Degree of the Taylor polynomial that continues the spline before its first and after its last knot.
    """

    degree: int
    breaks: Array
    coefficients: Array
    beyond: int = 1

    def __post_init__(self) -> None:
        breaks, coefficients = (np.array(value, dtype=np.float64) for value in (self.breaks, self.coefficients))
        if not (isinstance(self.degree, int) and isinstance(self.beyond, int)):
            raise InputError(f"degrees {self.degree} and {self.beyond} are not integers", field="degree, beyond")
        if not 1 <= self.degree <= 5 or not 0 <= self.beyond <= self.degree:
            raise InputError(
                f"a spline cannot have degree {self.degree} and {self.beyond} beyond its ends", field="degree"
            )
        if breaks.ndim != 1 or len(breaks) < 2 or not np.isfinite(breaks).all() or not (np.diff(breaks) > 0).all():
            raise InputError("the knots of a spline must be at least two increasing times", field="breaks")
        if coefficients.shape != (len(breaks) - 1 + self.degree, 3) or not np.isfinite(coefficients).all():
            raise InputError(
                f"a spline of degree {self.degree} with {len(breaks)} knots needs {len(breaks) - 1 + self.degree} x 3 "
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
        # Relative to the mean, so positions in space keep all digits.
        middle = values.mean(axis=0)
        basis = empty.basis(times)
        if not (np.isfinite(basis).all() and np.isfinite(values).all()):
            raise InputError(
                "no spline can follow this table: its times or values are too far apart",
                field="breaks",
                remedy="the file is damaged: copy it again",
            )
        solution, _, rank, _ = np.linalg.lstsq(basis, values - middle, rcond=1e-10)
        if rank < count:
            raise InputError(
                f"{counted(len(values), 'time does', 'times do')} not determine {counted(count, 'spline coefficient')}",
                field="breaks",
                remedy="use fewer knots, or a table that covers all of them",
            )
        return cls(degree, breaks, solution + middle, beyond)

    @property
    def size(self) -> int:
        """Number of coefficients per component."""
        return len(self.coefficients)

    @property
    def sites(self) -> Array:
        """Greville times ``(size,)`` of the coefficients; coefficients that are linear there give a line."""
        return self._unit.sites

    def __call__(self, times: ArrayLike, derivative: int = 0) -> Array:
        """Return values ``(N, 3)`` at times ``(N,)``, or their derivative by time."""
        return self.basis(times, derivative) @ self.coefficients

    def basis(self, times: ArrayLike, derivative: int = 0) -> Array:
        """Return the B-splines (or their derivative) at times ``(N,)`` as ``(N, size)``; NaN stays NaN."""
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
        """Return Taylor coefficients ``(k, degree + 1, 3)`` of the polynomials that begin at times ``(k,)``."""
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
    """Degree of the splines of path and attitude, and their numbers of polynomials; None: the table decides.

    Examples
    --------
    >>> SplineForm(degree=3, path=2)
    SplineForm(degree=3, path=2, attitude=None)
    """

    degree: int
    path: int | None = None
    attitude: int | None = None


class _Unit:
    """The B-splines, shared by splines with the same knots."""

    def __init__(self, degree: int, breaks: tuple[float, ...], beyond: int) -> None:
        knots = np.array([breaks[0]] * degree + list(breaks) + [breaks[-1]] * degree)
        from scipy.interpolate import BSpline  # takes half of the start-up time of a command

        basis = BSpline(knots, np.eye(len(breaks) - 1 + degree), degree)
        self.inside = [basis, *(basis.derivative(order) for order in range(1, degree + 1))]
        self.sites = np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(len(breaks) - 1 + degree)])
        #: Values and derivatives at both ends, for the continuation.
        self.ends = {
            end: [self.inside[order](np.array([end]))[0] for order in range(beyond + 1)]
            for end in (breaks[0], breaks[-1])
        }


@functools.lru_cache(maxsize=256)
def _unit_of(degree: int, breaks: tuple[float, ...], beyond: int) -> _Unit:
    return _Unit(degree, breaks, beyond)
