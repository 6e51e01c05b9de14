r"""The table of classical models: ratios of polynomials that differ in the terms of numerator and denominator.

With ground X, Y, Z and image x (column), y (row), all normalised,

.. math:: x = \frac{\sum a_t\, t(X, Y, Z)}{1 + \sum c_t\, t(X, Y, Z)}, \qquad
          y = \frac{\sum b_t\, t(X, Y, Z)}{1 + \sum d_t\, t(X, Y, Z)}

Names of parameters are image axis, part, term: ``col_XZ`` is the coefficient of XZ in the numerator of the column,
``row_den_X`` is in the denominator of the row, ``den_X`` in a denominator that column and row share.

Source: Ok and Turker (BILSAT-1), eqs. 8-11; Amini and Hashemi (IKONOS), eqs. 2-9; Bueyueksalih et al. (OrbView-3),
formulas 2-5.
Symbols: their a_ijk are col_, b_ijk row_, c_1.. and L9.. den_; each paper has its own order.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError


@dataclass(frozen=True)
class Family:
    """One classical model.

    Parameters
    ----------
    name, description, suits, formula : str
        For people: what it is, what it suits, and its equation in the papers.
    col, row : tuple of str
        Terms of the numerators, such as ``1``, ``X``, ``XZ``, ``X2``.
    den : tuple of str
        Terms of the denominators without the constant, which is 1.
    common : bool
        One denominator for column and row, or one for each.
    simpler : tuple of str
        Simpler families to use if the points do not determine this one, the next simpler first.
    variants : tuple of str
        Families of which the better one is used under this name.
    """

    name: str
    description: str
    suits: str
    formula: str
    col: tuple[str, ...] = field(repr=False)
    row: tuple[str, ...] = field(repr=False)
    den: tuple[str, ...] = field(default=(), repr=False)
    common: bool = True
    simpler: tuple[str, ...] = ()
    variants: tuple[str, ...] = ()

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of all coefficients, in the order in which models hold them."""
        names = [f"col_{term}" for term in self.col] + [f"row_{term}" for term in self.row]
        parts = ("den",) if self.common else ("col_den", "row_den")
        return tuple(names + [f"{part}_{term}" for part in parts for term in self.den])

    @property
    def parameters(self) -> int:
        """Number of coefficients."""
        return len(self.param_names)

    @property
    def minimum_points(self) -> int:
        """Least number of points that can determine the coefficients."""
        return points_needed(self.param_names)

    @property
    def dimensions(self) -> int:
        """2 if heights are not used, else 3."""
        return 3 if any("Z" in term for term in (*self.col, *self.row, *self.den)) else 2

    @property
    def regularised(self) -> bool:
        """True for families that need regularisation: with separate denominators, or ones beyond the first order."""
        return bool(self.den) and (not self.common or len(self.den) > 3)

    def to_json(self) -> dict[str, Any]:
        """Return the row of ``ortho models --json``."""
        keys = ("name", "description", "suits", "formula", "dimensions", "parameters", "minimum_points")
        return {key: getattr(self, key) for key in keys}


def points_needed(names: tuple[str, ...]) -> int:
    """Return the number of points that determine these parameters; each gives one equation for each image axis."""
    col = sum(name.startswith("col_") for name in names)
    row = sum(name.startswith("row_") for name in names)
    return max(col, row, -(-len(names) // 2))


def exponents(term: str) -> NDArray[np.int64]:
    """Return the exponents ``(3,)`` of X, Y, Z in a term such as ``1``, ``XZ`` or ``X2Y``."""
    powers = np.zeros(3, dtype=np.int64)
    axis = -1
    for letter in "" if term == "1" else term:
        if letter in "XYZ":
            axis = "XYZ".index(letter)
            powers[axis] += 1
        else:
            powers[axis] += int(letter) - 1
    return powers


def complete(order: int, axes: str = "XYZ") -> tuple[str, ...]:
    """Return all terms up to a total order, ordered by it: ``1, X, Y, X2, XY, Y2`` for order 2 in X and Y."""
    terms = [powers for powers in product(range(order + 1), repeat=len(axes)) if sum(powers) <= order]
    terms.sort(key=lambda powers: (sum(powers), [-power for power in powers]))
    return tuple(
        "".join(f"{axis}{power if power > 1 else ''}" for axis, power in zip(axes, powers, strict=True) if power) or "1"
        for powers in terms
    )


_PLANE, _SPACE = complete(1, "XY"), complete(1)
_RAY = (*_SPACE, "XZ", "YZ")  # formula 3: a view direction that changes


def _polynomial(order: int) -> Family:
    name = ("first", "second", "third", "fourth", "fifth")[order - 1]
    return Family(
        f"poly{order}",
        f"2D polynomial of the {name} order",
        "flat terrain" + (", small distortions" if order < 3 else "; many well spread points; oscillates between them"),
        "BILSAT-1 eq. 8" + (f", IKONOS eq. {order + 1}" if order <= 3 else ""),
        complete(order, "XY"),
        complete(order, "XY"),
        simpler=(f"poly{order - 1}",) if order > 1 else (),
    )


def _solid(order: int) -> Family:
    return Family(
        f"poly3d{order}",
        f"3D polynomial of order {order}",
        "any terrain" if order < 3 else "any terrain; many points, well spread over image and height",
        "IKONOS eq. 5",
        complete(order),
        complete(order),
        simpler=(f"poly3d{order - 1}",) if order > 1 else ("affine2d",),
    )


def _rational(order: int, common: bool) -> Family:
    suffix = "-common" if common else ""
    return Family(
        f"rfm{order}{suffix}",
        f"rational functions of order {order}, {'one denominator' if common else 'a denominator for each axis'}",
        "any sensor, with many points, a regularisation and check points",
        "BILSAT-1 eq. 9",
        complete(order),
        complete(order),
        complete(order)[1:],
        common=common,
        simpler=("dlt",) if order == 1 or (common and order == 2) else (f"rfm{order - 1}{suffix}",),
    )


_AFFINE14 = "affine12 with X2 for the column and XY for the row, or the reverse, by leave-one-out"
_FAMILIES = (
    Family("affine2d", "2D affine", "flat terrain, images projected to a plane", "IKONOS eqs. 2 and 9", _PLANE, _PLANE),
    *(_polynomial(order) for order in (1, 2, 3, 4, 5)),
    Family(
        "projective",
        "2D projective, plane to plane",
        "flat terrain, frame images",
        "BILSAT-1 eq. 10, IKONOS eq. 6",
        _PLANE,
        _PLANE,
        _PLANE[1:],
        simpler=("affine2d",),
    ),
    Family(
        "affine3d",
        "3D affine, parallel projection",
        "narrow field of view, images projected to a constant height",
        "OrbView-3 formula 2, IKONOS eq. 8",
        _SPACE,
        _SPACE,
        simpler=("affine2d",),
    ),
    Family(
        "affine12",
        "3D affine for a changing view direction",
        "line scanners that turn a little while they scan (not OrbView-3)",
        "OrbView-3 formula 3",
        _RAY,
        _RAY,
        simpler=("affine3d", "affine2d"),
    ),
    Family(
        "affine14",
        "3D affine for a changing view direction and scale",
        f"unrectified line scenes; {_AFFINE14}",
        "OrbView-3 formula 4",
        (*_RAY, "X2"),
        (*_RAY, "XY"),
        simpler=("affine12", "affine3d", "affine2d"),
        variants=("affine14-col", "affine14-row"),
    ),
    *(_solid(order) for order in (1, 2, 3)),
    Family(
        "dlt",
        "direct linear transformation, perspective",
        "frame images; rectified line scenes",
        "BILSAT-1 eq. 11, IKONOS eq. 7, OrbView-3 formula 5",
        _SPACE,
        _SPACE,
        _SPACE[1:],
        simpler=("affine3d", "projective", "affine2d"),
    ),
    *(_rational(order, False) for order in (1, 2, 3)),
    *(_rational(order, True) for order in (2, 3)),
)
_ASSIGNED = (
    Family(
        "affine14-col",
        "affine14, the paper's x is the column",
        "",
        "OrbView-3 formula 4",
        (*_RAY, "X2"),
        (*_RAY, "XY"),
        simpler=("affine12", "affine3d", "affine2d"),
    ),
    Family(
        "affine14-row",
        "affine14, the paper's x is the row",
        "",
        "OrbView-3 formula 4",
        (*_RAY, "XY"),
        (*_RAY, "X2"),
        simpler=("affine12", "affine3d", "affine2d"),
    ),
)
_BY_NAME = {family.name: family for family in (*_FAMILIES, *_ASSIGNED)}


def families() -> tuple[Family, ...]:
    """Return the classical models, from simple to complex."""
    return _FAMILIES


def family_of(name: str) -> Family:
    """Return a family by its name, including ``affine14-col`` and ``affine14-row``.

    Raises
    ------
    InputError
        For an unknown name.
    """
    if name not in _BY_NAME:
        raise InputError(
            f"unknown model family {name!r}",
            field="points.model",
            remedy=f"use one of {', '.join(family.name for family in _FAMILIES)}",
        )
    return _BY_NAME[name]
