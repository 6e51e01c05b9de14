"""Errors of image measurements: the covariance of a point, and the errors that points share.

A covariance that is the same in all directions equals the square of a standard deviation.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.points.rows import CSV_ERRORS, PointRow, number, short, sigma_of

Array = NDArray[np.float64]
Index = NDArray[np.int64]

#: Groups are smaller: a file has them as numbers, which are exact up to here.
LAST_GROUP = 2**53
#: Below this 1 - correlation^2, column and row depend on each other so much that the covariance is singular.
_SINGULAR = 1e-12
#: Off-diagonal elements that differ by less than this part of the trace are equal.
_ROUNDING = 1e-12
#: Relative difference up to which a standard deviation agrees with a covariance, because files round.
_SAME_SIGMA = 0.01


def reconciled(sigma: Array, covariance: ArrayLike | None) -> tuple[Array, Array]:
    """Return standard deviations ``(N,)`` px and covariances ``(N, 2, 2)`` px^2 that agree.

    If a covariance differs with the direction, the standard deviation is the root mean square of both axes. Otherwise
    the covariance is the square of `sigma`.

    Raises
    ------
    InputError
        If a covariance is not finite, symmetric and positive definite, or contradicts its standard deviation.
    """
    square = np.zeros((len(sigma), 2, 2))
    with np.errstate(over="ignore"):
        square[:, 0, 0] = square[:, 1, 1] = sigma**2
    if covariance is None:
        return sigma, square
    full = _of_shape(covariance, len(sigma))
    alike = ((full == square) | np.isnan(full) & np.isnan(square)).all(axis=(1, 2))
    _refuse_impossible(full[~alike], np.flatnonzero(~alike))
    more = says_more(full)
    derived = sigma_of_covariance(full)
    # Scaling points with the same error in all directions changes sigma alone.
    wrong = more & ~(np.abs(sigma - derived) <= _SAME_SIGMA * derived)
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        raise InputError(
            f"sigma_image of point {k + 1} is {sigma[k]:g}, but its covariance_image gives {derived[k]:g}",
            field="sigma_image",
            remedy="change both, or use with_covariance_image",
        )
    return np.where(more, derived, sigma), np.where(more[:, None, None], full, square)


def checked_covariance(covariance: ArrayLike, count: int) -> Array:
    """Return covariances ``(N, 2, 2)``, each finite, symmetric and positive definite.

    Raises
    ------
    InputError
        If they are not.
    """
    checked = _of_shape(covariance, count)
    _refuse_impossible(checked, np.arange(count))
    return checked


def _of_shape(covariance: ArrayLike, count: int) -> Array:
    """Return covariances ``(N, 2, 2)``, made symmetric where only rounding differs."""
    full = np.array(covariance, dtype=float)
    if full.shape != (count, 2, 2):
        raise InputError(f"covariance_image has the shape {full.shape}, not {(count, 2, 2)}", field="covariance_image")
    both = full[:, 0, 1] / 2 + full[:, 1, 0] / 2
    with np.errstate(invalid="ignore"):
        rounded = np.abs(full[:, 0, 1] - full[:, 1, 0]) <= _ROUNDING * (full[:, 0, 0] + full[:, 1, 1])
    full[rounded, 0, 1] = full[rounded, 1, 0] = both[rounded]
    return full


def sigma_of_covariance(covariance: Array) -> Array:
    """Return the root mean square per axis ``(N,)`` px of covariances ``(N, 2, 2)`` px^2."""
    return np.sqrt(covariance[:, 0, 0] / 2 + covariance[:, 1, 1] / 2)


def says_more(covariance: Array) -> NDArray[np.bool_]:
    """Return which covariances ``(N, 2, 2)`` differ with the direction."""
    same = (covariance[:, 0, 0] == covariance[:, 1, 1]) | np.isnan(covariance[:, 0, 0])
    return ~(same & (covariance[:, 0, 1] == 0) & (covariance[:, 1, 0] == 0))


def checked_groups(groups: ArrayLike | None, count: int) -> Index:
    """Return groups ``(N,)``: the same number for points that share errors, -1 for a point that shares none.

    Raises
    ------
    InputError
        If they are not N integers from -1.
    """
    if groups is None:
        return np.full(count, -1, dtype=np.int64)
    numbers = np.asarray(groups)
    if numbers.shape != (count,):
        raise InputError(f"groups has the shape {numbers.shape}, not {(count,)}", field="groups")
    if count and (numbers.dtype.kind not in "iu" or (numbers < -1).any()):
        raise InputError("groups must be integers, -1 for a point that shares no errors", field="groups")
    return numbers.astype(np.int64)


def checked_common(sigma: ArrayLike | None, count: int, name: str = "sigma_common") -> Array:
    """Return standard deviations ``(N,)`` of common errors, 0 for points that have none.

    Raises
    ------
    InputError
        If they are not N finite numbers from 0.
    """
    sigmas = np.zeros(count) if sigma is None else np.asarray(sigma, dtype=float)
    if sigmas.shape != (count,) or not ((sigmas >= 0) & np.isfinite(sigmas)).all():
        raise InputError(f"{name} must have {counted(count, 'number')}, none negative", field=name)
    return sigmas


def _refuse_impossible(covariance: Array, rows: Index) -> None:
    if not np.isfinite(covariance).all():
        k = int(np.flatnonzero(~np.isfinite(covariance).all(axis=(1, 2)))[0])
        raise InputError(f"covariance_image of point {rows[k] + 1} is not finite", field="covariance_image")
    skew = covariance[:, 0, 1] != covariance[:, 1, 0]
    wrong = skew | ~_is_positive_definite(covariance)
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        what = "symmetric" if skew[k] else "positive definite"
        raise InputError(f"covariance_image of point {rows[k] + 1} is not {what}", field="covariance_image")


def _is_positive_definite(covariance: Array) -> NDArray[np.bool_]:
    column, row = covariance[:, 0, 0], covariance[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        correlation = covariance[:, 0, 1] / np.sqrt(column) / np.sqrt(row)
        return np.asarray((column > 0) & (row > 0) & (1 - correlation**2 > _SINGULAR))


# -- files -----------------------------------------------------------------------------------------------------------


def read_image_errors(
    values: Sequence[Any], path: str | os.PathLike[str], where: Sequence[str], sigma: float | None
) -> tuple[tuple[float, float, float] | None, int | None, float | None, float | None]:
    """Return variances and covariance of a measurement, group, sigma_common and sigma_alike; None if not given.

    Parameters
    ----------
    values : sequence of six
        Values of `CSV_ERRORS` in a file; None or empty text if not given.
    where : sequence of six str
        Place of each in the file.
    sigma : float or None
        The standard deviation of the measurement, which must agree.

    Raises
    ------
    InputError
        If a covariance is incomplete, impossible, or contradicts the standard deviation.
    """
    filled = [value is not None and value != "" for value in values]
    group = _group(values[3], path, where[3]) if filled[3] else None
    common, alike = (sigma_of(values[k], path, where[k], zero=True) if filled[k] else None for k in (4, 5))
    if not any(filled[:3]):
        return None, group, common, alike
    if not all(filled[:3]):
        missing = CSV_ERRORS[filled[:3].index(False)]
        raise InputError(
            f"the covariance has no {missing}",
            file=path,
            field=where[filled.index(True)],
            remedy=f"give {', '.join(CSV_ERRORS[:3])}, or sigma_image alone",
        )
    column, row = (sigma_of(values[k], path, where[k], zero=False, what="variance") for k in range(2))
    both = number(values[2], path, where[2])
    matrix = np.array([[[column, both], [both, row]]])
    if not _is_positive_definite(matrix)[0]:
        raise InputError(
            f"{short(values[2])} is too large: the covariance is not positive definite",
            file=path,
            field=where[2],
            remedy="the square of cov_col_row must be less than var_col times var_row",
        )
    derived = float(sigma_of_covariance(matrix)[0])
    if sigma is not None and not abs(sigma - derived) <= _SAME_SIGMA * derived:
        raise InputError(
            f"sigma_image is {sigma:g}, but the covariance gives {derived:g}",
            file=path,
            field=where[0],
            remedy="leave sigma_image empty",
        )
    return (column, row, both), group, common, alike


def _group(value: Any, path: str | os.PathLike[str], where: str) -> int:
    group = number(value, path, where)
    if group != math.floor(group) or not 0 <= group < LAST_GROUP:
        raise InputError(
            f"{short(value)} is not a group",
            file=path,
            field=where,
            remedy="number the groups from 0; leave it empty for a point that shares no errors",
        )
    return int(group)


def covariance_of(rows: Sequence[PointRow], sigma: Array) -> Array:
    """Return covariances ``(N, 2, 2)`` px^2 of the rows of a file; from `sigma` if a row has none."""
    covariance = reconciled(sigma, None)[1]
    for k, row in enumerate(rows):
        if row.covariance is not None:
            column, other, both = row.covariance
            covariance[k] = np.array([[column, both], [both, other]]) * row.piece[2] ** 2
    return covariance


def groups_of(rows: Sequence[PointRow]) -> Index:
    """Return the groups ``(N,)`` of the rows of a file."""
    return np.array([-1 if row.group is None else row.group for row in rows], dtype=np.int64)


def common_of(rows: Sequence[PointRow]) -> dict[str, Array]:
    """Return the standard deviations ``(N,)`` of common errors, by name, of the rows of a file."""
    return {
        name: np.array([getattr(row, name) or 0.0 for row in rows], dtype=np.float64)
        for name in ("sigma_common", "sigma_alike")
    }


def sigmas_of(rows: Sequence[PointRow], default: float) -> Array:
    """Return standard deviations ``(N,)`` px of the rows of a file; `default` for rows that have none."""
    sigmas = np.empty(len(rows))
    for k, row in enumerate(rows):
        if row.covariance is not None:
            sigma = math.sqrt(row.covariance[0] / 2 + row.covariance[1] / 2)
        else:
            sigma = default if row.sigma_image is None else row.sigma_image
        sigmas[k] = sigma * row.piece[2]
    return sigmas
