r"""Prove that an RPC is sound all over its box: no pole, no fold, pixels of a realistic size.

Control values (coefficients in Bernstein's basis) bound a polynomial over a box: they enclose it, those at the corners
are values of it, and halving the box brings them closer quadratically. So a denominator is bounded instead of sampled,
and a pole between samples is also found.

Source: Garloff 1986, Convergent bounds for the range of multivariate polynomials.
"""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError
from ortho_pipeline.models.rpc_kernel import polynomial, slopes

Array = NDArray[np.float64]

#: Exponents of (L, P, H) in the order of RPC00B: 1, L, P, H, LP, LH, PH, LL, PP, HH, PLH, LLL, LPP, LHH, LLP, PPP,
#: PHH, LLH, PPH, HHH.
RPC_TERMS = np.array(
    [
        (0, 0, 0),
        (1, 0, 0),
        (0, 1, 0),
        (0, 0, 1),
        (1, 1, 0),
        (1, 0, 1),
        (0, 1, 1),
        (2, 0, 0),
        (0, 2, 0),
        (0, 0, 2),
        (1, 1, 1),
        (3, 0, 0),
        (1, 2, 0),
        (1, 0, 2),
        (2, 1, 0),
        (0, 3, 0),
        (0, 1, 2),
        (2, 0, 1),
        (0, 2, 1),
        (0, 0, 3),
    ]
)
#: A denominator below this part of its value at the centre is at a pole.
POLE = 1e-3
#: Largest number of boxes of one size; if more are undecided, they count as a pole.
_MOST_BOXES = 4096
#: Largest offsets and half-sizes that a scene on Earth can have: degrees, metres of height, pixels.
_LARGEST = {
    "lon_off": 540.0,
    "lat_off": 90.0,
    "h_off": 1e5,
    "col_off": 1e9,
    "row_off": 1e9,
    "lon_scale": 180.0,
    "lat_scale": 90.0,
    "h_scale": 1e5,
    "col_scale": 1e9,
    "row_scale": 1e9,
}
#: Least and greatest side of a pixel on the ground (m).
_PIXEL = (1e-3, 1e5)
_METRES_PER_DEGREE = 111_320.0
_DAMAGED = "the RPC is damaged or belongs to another image: get its file again"
_HALF = np.array([[1, 0, 0, 0], [0.5, 0.5, 0, 0], [0.25, 0.5, 0.25, 0], [0.125, 0.375, 0.375, 0.125]])
_SIDES = (_HALF, _HALF[::-1, ::-1])
#: Normalised heights at which folds are searched, and the height up to which an RPC must be sound.
_LEVELS = np.linspace(-1.0, 1.0, 17)
_LEAST = 0.25
#: Points on each of these levels: normalised longitudes and latitudes of 5 x 5.
_ACROSS, _ALONG = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 2))


@functools.cache
def _powers(low: float, high: float) -> Array:
    """Return the control values ``(4, 4)`` of 1, x, x^2, x^3 (columns) over x from `low` to `high`."""
    powers = np.zeros((4, 4))
    for power, j in itertools.product(range(4), range(4)):
        # x = low + (high - low) u, and u^j has the control values C(i, j) / C(3, j).
        share = math.comb(power, j) * (high - low) ** j * low ** (power - j) if j <= power else 0.0
        powers[:, power] += [share * math.comb(i, j) / math.comb(3, j) for i in range(4)]
    return powers


@functools.cache
def _controls(low: float, high: float) -> Array:
    """Return the control values ``(64, 20)`` of the terms over the box -1 to 1, in height from `low` to `high`."""
    axes = _powers(-1.0, 1.0), _powers(-1.0, 1.0), _powers(low, high)
    terms = [np.einsum("i,j,k->ijk", *(axis[:, n] for axis, n in zip(axes, term, strict=True))) for term in RPC_TERMS]
    return np.stack([term.ravel() for term in terms], axis=1)


def has_pole(denominator: Array, low: float = -1.0, high: float = 1.0) -> bool:
    """Return whether a denominator ``(20,)`` is near zero, or changes its sign, in the box -1 to 1 of its terms.

    `low` and `high` are the normalised heights of the box.
    """
    centre = denominator[0]
    if centre == 0.0:
        return True
    boxes = (_controls(low, high) @ (denominator / centre)).reshape(1, 4, 4, 4) - POLE
    while len(boxes) <= _MOST_BOXES:
        if not np.isfinite(boxes).all():
            return True
        boxes = boxes[boxes.min(axis=(1, 2, 3)) <= 0.0]
        if not len(boxes):
            return False
        if not boxes[:, ::3, ::3, ::3].min() > 0.0:
            return True
        for axis in "ijk":
            halves = [np.einsum(f"x{axis},nijk->n{'ijk'.replace(axis, 'x')}", side, boxes) for side in _SIDES]
            boxes = np.concatenate(halves)
    return True


def check_numbers(values: dict[str, float]) -> None:
    """Refuse offsets and scales that no scene on Earth has.

    Raises
    ------
    InputError
        With the name of the field.
    """
    for name, value in values.items():
        if not np.isfinite(value):
            raise InputError("an RPC needs finite numbers", field=name, remedy=_DAMAGED)
        if name.endswith("_scale") and value == 0.0:
            raise InputError("an RPC scale cannot be zero", field=name, remedy=_DAMAGED)
        if abs(value) > _LARGEST[name]:
            raise InputError(f"{value:g} is too large for a scene on Earth", field=name, remedy=_DAMAGED)


def sound_heights(values: dict[str, float], coefficients: Array) -> tuple[float, float]:
    """Return the lowest and highest normalised height within the box, -1 to 1, up to which an RPC is sound.

    It is unsound where a denominator is zero, or where it maps two ground points to one pixel (the Jacobian changes its
    sign). Some vendors' RPCs are unsound at heights without terrain: these heights are excluded. An RPC that is unsound
    near the middle of its box, or has pixels of an impossible size, is refused.

    Parameters
    ----------
    values : dict
        Offsets and scales by name.
    coefficients : (4, 20)
        Column numerator and denominator, row numerator and denominator.

    Raises
    ------
    InputError
    """
    denominators = {"col_den": coefficients[1], "row_den": coefficients[3]}
    for name, denominator in denominators.items():
        if denominator[0] == 0.0:
            raise InputError("the denominator of an RPC is zero at its centre", field=name, remedy=_DAMAGED)
    with np.errstate(all="ignore"):
        jacobian = _jacobians(coefficients)  # (column and row, L and P, levels, places)
        turns = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
        middle = len(_LEVELS) // 2, turns.shape[1] // 2
        _check_pixel(values, jacobian[(..., *middle)])
        straight = (np.isfinite(turns) & (turns * turns[middle] > 0)).all(axis=1)
    ends = []
    for side, levels in ((-1.0, _LEVELS[: middle[0] + 1]), (1.0, _LEVELS[: middle[0] - 1 : -1])):
        for level in levels:
            folded = not straight[(side * _LEVELS >= 0) & (side * _LEVELS <= side * level)].all()
            low, high = min(level, 0.0), max(level, 0.0)
            poles = [name for name, one in denominators.items() if has_pole(one, low, high)]
            if not (folded or poles):
                ends.append(float(level))
                break
            if abs(level) <= _LEAST:
                what = "the denominator of this RPC is zero within its box"
                if not poles:
                    what = "this RPC maps several places on the ground to one pixel"
                raise InputError(what, field=", ".join(poles) or "col_num, row_num", remedy=_DAMAGED)
    return ends[0], ends[1]


def _jacobians(coefficients: Array) -> Array:
    """Return d(normalised column, row)/d(L, P) as ``(2, 2, levels, places)``."""
    terms = coefficients.T[:, :, None, None]
    values, changes = (by(terms, _ACROSS, _ALONG, _LEVELS[:, None]) for by in (polynomial, slopes))
    ratios = values[::2] / values[1::2]
    return np.stack([(change[::2] - ratios * change[1::2]) / values[1::2] for change in changes[:2]], axis=1)


def _check_pixel(values: dict[str, float], jacobian: Array) -> None:
    east = _METRES_PER_DEGREE * max(math.cos(math.radians(values["lat_off"])), 1e-3)
    metres = np.array([values["lon_scale"] * east, values["lat_scale"] * _METRES_PER_DEGREE])
    pixels = jacobian * np.array([[values["col_scale"]], [values["row_scale"]]]) / metres
    long, short = np.linalg.svd(pixels, compute_uv=False) if np.isfinite(pixels).all() else (np.nan, np.nan)
    if not (_PIXEL[0] <= 1.0 / long and 1.0 / short <= _PIXEL[1]):
        raise InputError(
            f"a pixel of this RPC would be {significant(1.0 / long)} x {significant(1.0 / short)} m on the ground",
            field="col_scale, row_scale, lon_scale, lat_scale",
            remedy=_DAMAGED,
        )
