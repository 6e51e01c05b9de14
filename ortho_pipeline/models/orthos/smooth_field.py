r"""A smooth field of displacements in the image, over any model: what no affine transformation can follow.

The image point :math:`p` of the model below appears at :math:`p'`, where

.. math::
    p' - f(p') = p

with cubic B-splines :math:`f` on a grid of coefficients over the image. So :math:`f` at an image point is what a match
there measures. The field must not fold the image: its bending, the largest change of :math:`f` per pixel, is limited.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array, as_image
from ortho_pipeline.models.correction import OverAnother

#: No field bends by more than this (px per px), or its inverse would not be certain.
STEEPEST = 0.25
_STEPS, _CLOSED = 60, 1e-9


@dataclass(frozen=True, eq=False)
class SmoothField(OverAnother):
    """A sensor model whose image points are moved by a smooth field.

    Parameters
    ----------
    model : SensorModel
        What is moved.
    size : (int, int)
        Columns and rows of the image; the field is constant across its rim.
    coefficients : (rows, columns, 2)
        Of the B-splines, px of column and row. Their knots divide the image evenly, the first and last at its rim.
    """

    kind: ClassVar[str] = "smooth_field"

    size: tuple[int, int]
    coefficients: Array

    def __post_init__(self) -> None:
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if coefficients.ndim != 3 or coefficients.shape[2] != 2 or min(coefficients.shape[:2]) < 2:
            raise InputError("a field has coefficients (rows, columns, 2)", field="coefficients")
        if not np.isfinite(coefficients).all():
            raise InputError("the coefficients of a field are finite numbers", field="coefficients")
        coefficients.setflags(write=False)
        object.__setattr__(self, "coefficients", coefficients)
        object.__setattr__(self, "size", tuple(int(value) for value in self.size))
        if len(self.size) != 2 or min(self.size) < 1:
            raise InputError("an image has a positive size", field="size")
        if self.bending > STEEPEST:
            raise InputError(
                f"this field changes by {significant(self.bending)} px per pixel, more than {STEEPEST} px",
                field="coefficients",
                remedy="give a smoother field",
            )

    @property
    def spacing(self) -> Array:
        """Distance (px) of knots along columns and rows."""
        rows, columns = self.coefficients.shape[:2]
        return np.array(self.size) / (columns - 1, rows - 1)

    @property
    def bending(self) -> float:
        """A bound on the change of the field per pixel, in any direction: from differences of coefficients."""
        return bending_of(self.coefficients, self.spacing)

    @property
    def detail(self) -> float:
        return min(float(self.spacing.min()), self.model.detail)

    def displacement(self, image: ArrayLike) -> Array:
        """Return the field ``(N, 2)`` px at image points ``(N, 2)``; NaN where they are."""
        from scipy.ndimage import map_coordinates  # takes a part of the start-up time of a command

        image = as_image(image)
        rows, columns = (np.clip(np.nan_to_num(image), 0.0, self.size) / self.spacing).T[::-1]
        found = np.empty((len(image), 2))
        for axis in (0, 1):
            # Without the prefilter the values are coefficients of B-splines; beyond the rim they are those of the rim.
            of_axis = self.coefficients[..., axis]
            found[:, axis] = map_coordinates(of_axis, (rows, columns), order=3, mode="nearest", prefilter=False)
        found[~np.isfinite(image).all(axis=1)] = np.nan
        return found

    def splines(self, axis: int, places: Array) -> Array:
        """Return the splines ``(n, knots)`` along columns (axis 0) or rows (1) at places ``(n,)`` px."""
        count = self.coefficients.shape[1 - axis]
        place = np.clip(places, 0.0, self.size[axis]) / self.spacing[axis]
        cell = np.floor(place).astype(int)
        found = np.zeros((len(places), count))
        for i, weight in enumerate(_weights(place - cell)):
            np.add.at(found, (np.arange(len(places)), np.clip(cell + i - 1, 0, count - 1)), weight)
        return found

    def ground_to_image(self, ground: ArrayLike) -> Array:
        start = self.model.ground_to_image(ground)
        image = start.copy()
        for _ in range(_STEPS):
            again = start + self.displacement(image)
            with np.errstate(invalid="ignore"):
                moved = np.abs(again - image).max(initial=0.0, where=np.isfinite(again))
            image = again
            if moved < _CLOSED:
                break
        return image

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        image = as_image(image)
        return self.model.image_to_ground(image - self.displacement(image), height)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        return super().from_dict({**data, "size": tuple(data.get("size", ()))})


def bending_of(coefficients: Array, spacing: Array) -> float:
    """Return a bound on the change per pixel of a field, from its coefficients and the distance (px) of its knots."""
    parts = np.diff(coefficients, axis=1) / spacing[0], np.diff(coefficients, axis=0) / spacing[1]
    across, down = (float(np.hypot(part[..., 0], part[..., 1]).max(initial=0.0)) for part in parts)
    return math.hypot(across, down)


def _weights(t: Array) -> tuple[Array, Array, Array, Array]:
    """Return the weights of the four cubic B-splines about a place between two knots, 0 to 1."""
    return (
        (1 - t) ** 3 / 6,
        (3 * t**3 - 6 * t**2 + 4) / 6,
        (-3 * t**3 + 3 * t**2 + 3 * t + 1) / 6,
        t**3 / 6,
    )
