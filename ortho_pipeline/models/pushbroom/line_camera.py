r"""Camera of a line scanner: the direction of each column.

With c_F = (x0, y0, F), the position of the projection centre relative to the line, and corrections
:math:`\delta x(x), \delta y(x)`, the column x looks along (u, v, 1) in camera axes:

.. math:: u = (x + \delta x - x_0) / F, \qquad v = (\delta y - y_0) / F .

Both corrections are polynomials in :math:`\xi = 2 x / N - 1` (N columns), in pixels. So look directions given as
polynomials of the column (Pleiades: degree 1 and 0) convert without loss.

Source: Willneff et al., equation 3, left side. There the third component of :math:`p_F - c_F` is -F, with a scale
:math:`\lambda` of any sign. Here camera z points to the ground, and columns increase along +x, the left of the flight,
as in an image that is not mirrored and has its first line on top. A negative F is a mirrored line.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Self

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array

#: Names of c_F as parameters; the corrections are ``dx_0``, ``dx_1`` ... and ``dy_0`` ...
PRINCIPAL = ("principal_column", "principal_line", "focal_length")
#: Highest degree of polynomials that follow a table of look angles, and their largest error (px).
TABLE_DEGREE, TABLE_MISS = 9, 0.005
#: Largest number of columns or rows: more than any line scanner records in one pass.
MOST_PIXELS = 10_000_000


@dataclass(frozen=True, eq=False)
class LineCamera:
    """Interior orientation of a line scanner, in pixels.

    Parameters
    ----------
    width, height : int
        Columns and rows of the image.
    principal_column, principal_line, focal_length : float
        c_F; a negative focal length mirrors the line.
    dx, dy : (k,)
        Coefficients of the corrections, lowest power first; may be empty.
    """

    width: int
    height: int
    principal_column: float
    principal_line: float
    focal_length: float
    dx: Array = field(default_factory=lambda: np.zeros(0))
    dy: Array = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        if not all(1 <= size <= MOST_PIXELS and size == int(size) for size in (self.width, self.height)):
            raise InputError(f"{self.width} x {self.height} is not an image size", field="width, height")
        for name in ("dx", "dy"):
            value = np.array(getattr(self, name), dtype=np.float64).ravel()
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        numbers = [self.principal_column, self.principal_line, self.focal_length, *self.dx, *self.dy]
        if not np.isfinite(numbers).all() or self.focal_length == 0:
            raise InputError("a camera needs finite numbers, and a focal length that is not zero", field="focal_length")

    @classmethod
    def of_polynomials(cls, width: int, height: int, across: ArrayLike, along: ArrayLike) -> Self:
        """Make the camera whose column x looks along (u, v, 1), with polynomials u(x), v(x).

        Parameters
        ----------
        across, along : (k,)
            Coefficients of u and v, lowest power first. x counts from the outer corner of the first pixel. The linear
            term of u gives the focal length.

        Raises
        ------
        InputError
            If u does not change with the column.

        Examples
        --------
        >>> camera = LineCamera.of_polynomials(1000, 2000, across=[-0.01, 2e-5], along=[0.0])
        >>> round(camera.focal_length, 3)
        50000.0
        """
        u, v = (np.asarray(value, dtype=np.float64).ravel() for value in (across, along))
        if len(u) < 2 or u[1] == 0:
            raise InputError("the look angle does not change with the column", field="across")
        focal, half = 1.0 / float(u[1]), width / 2
        # x = half (1 + xi): convert the terms beyond the linear one to polynomials in xi.
        shifted = np.polynomial.Polynomial([half, half])

        def in_xi(terms: Array) -> Array:
            return focal * np.asarray(np.polynomial.Polynomial(terms)(shifted).coef, dtype=np.float64)

        rest = in_xi(np.array([0.0, 0.0, *u[2:]])) if len(u) > 2 else np.zeros(0)
        along_rest = in_xi(np.array([0.0, *v[1:]])) if len(v) > 1 else np.zeros(0)
        line = -float(v[0]) * focal if len(v) else 0.0
        return cls(width, height, -float(u[0]) * focal, line, focal, rest, along_rest)

    @classmethod
    def of_table(
        cls, width: int, height: int, columns: ArrayLike, across: ArrayLike, along: ArrayLike, rounding: float = 0.0
    ) -> Self:
        """Make the camera from look directions (u, v, 1) at some or all columns.

        Parameters
        ----------
        columns, across, along : (n,)
            Columns from the outer corner of the first pixel, and u and v there.
        rounding : float
            Rounding error of the table (px), which polynomials should not follow.

        Raises
        ------
        InputError
            If no polynomial up to `TABLE_DEGREE` follows them within `TABLE_MISS` pixels.
        """
        x, u, v = (np.asarray(value, dtype=np.float64).ravel() for value in (columns, across, along))
        xi = 2 * x / width - 1
        if len(x) < 2 or not np.isfinite([x, u, v]).all() or not (np.diff(x) > 0).all():
            raise InputError("look angles must be finite numbers at two or more increasing columns", field="columns")
        start, slope = np.polynomial.polynomial.polyfit(xi, u, 1)
        if not abs(slope) > 1e-12:
            raise InputError("the look angle does not change with the column", field="across")
        half = width / 2
        focal = half / float(slope)
        x0, y0 = half - focal * float(start), -focal * float(v.mean())
        dx = _followed(xi, focal * u - half * (1 + xi) - (focal * start - half), rounding)
        dy = _followed(xi, focal * v + y0, rounding)
        return cls(width, height, x0, y0, focal, dx, dy)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the image."""
        return self.width, self.height

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all parameters."""
        return (*PRINCIPAL, *(f"dx_{k}" for k in range(len(self.dx))), *(f"dy_{k}" for k in range(len(self.dy))))

    @property
    def values(self) -> Array:
        """Values of all parameters, in the order of `names`."""
        return np.array([*(getattr(self, name) for name in PRINCIPAL), *self.dx, *self.dy])

    def with_values(self, values: Array) -> Self:
        """Return the camera with other values of its parameters."""
        x0, y0, focal = values[:3].tolist()
        split = 3 + len(self.dx)
        return type(self)(self.width, self.height, x0, y0, focal, values[3:split], values[split:])

    def directions(self, column: Array) -> Array:
        """Return u, v as ``(N, 2)`` of columns ``(N,)``."""
        xi = self._xi(column)
        u = (column + polyval(xi, self._full(self.dx)) - self.principal_column) / self.focal_length
        v = (polyval(xi, self._full(self.dy)) - self.principal_line) / self.focal_length
        return np.stack([u, v], axis=1)

    def slopes(self, column: Array) -> Array:
        """Return d(u, v)/d(column) as ``(N, 2)``."""
        xi = self._xi(column)
        by_x, by_y = (
            polyval(xi, polyder(self._full(terms))) * 2 / self.width / self.focal_length for terms in (self.dx, self.dy)
        )
        return np.stack([1 / self.focal_length + by_x, by_y], axis=1)

    def partials(self, column: Array) -> Array:
        """Return d(u, v)/d(parameters) as ``(N, 2, len(names))``."""
        out = np.zeros((len(column), 2, len(self.names)))
        out[:, 0, 0] = out[:, 1, 1] = -1 / self.focal_length
        out[:, :, 2] = -self.directions(column) / self.focal_length
        xi, split = self._xi(column)[:, None], 3 + len(self.dx)
        out[:, 0, 3:split] = xi ** np.arange(len(self.dx)) / self.focal_length
        out[:, 1, split:] = xi ** np.arange(len(self.dy)) / self.focal_length
        return out

    def to_dict(self) -> dict[str, Any]:
        """Return the camera as plain data."""
        data = {item.name: getattr(self, item.name) for item in fields(self)}
        return {**data, "dx": self.dx.tolist(), "dy": self.dy.tolist()}

    def _xi(self, column: Array) -> Array:
        return 2 * column / self.width - 1

    @staticmethod
    def _full(terms: Array) -> Array:
        return terms if len(terms) else np.zeros(1)


def _followed(xi: Array, wanted: Array, rounding: float) -> Array:
    """Return the shortest polynomial in xi that follows values (px); empty if none is needed."""
    enough = max(rounding, TABLE_MISS / 100)
    if np.abs(wanted).max() <= enough:
        return np.zeros(0)
    for degree in range(min(TABLE_DEGREE, len(xi) - 1) + 1):
        terms = np.asarray(np.polynomial.polynomial.polyfit(xi, wanted, degree), dtype=np.float64)
        # Prefer one degree more to a visible pattern: terms cost nothing.
        if (miss := np.abs(polyval(xi, terms) - wanted).max()) <= enough:
            return terms
    if not miss <= max(rounding, TABLE_MISS):
        raise InputError(
            f"the look angles are not those of a smooth line of detectors; they differ by up to {miss:.3g} px",
            field="across, along",
        )
    return terms
