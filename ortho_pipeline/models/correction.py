r"""Bias correction in image space over any sensor model.

The image point of the model, :math:`(c, r)`, becomes

.. math::
    c' &= c + a_0 + a_1 (c - c_0) + a_2 (r - r_0) \\
    r' &= r + b_0 + b_1 (c - c_0) + b_2 (r - r_0)

``shift`` has :math:`a_0, b_0`; ``shift-drift`` adds :math:`a_2, b_2` (for a line scanner the row is time); ``affine``
has all six. The parameters are increments to the identity: zero means no correction, so significance tests apply.
The shift is the correction at the origin, the middle of the image.

Source: formula 2 of Willneff et al. (CARTOSAT-1), formula 7 of Bueyueksalih et al. (OrbView-3); Fraser and Hanley 2003.
Symbols (formula 7): a1, a4 = shifts + origin terms; a2 - 1, a3 = col_per_col, col_per_row; a5, a6 - 1 = row_per_col,
row_per_row.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array, SensorModel, as_image, as_params, model_from_dict

COEFFICIENTS = ("col_shift", "col_per_col", "col_per_row", "row_shift", "row_per_col", "row_per_row")
FREE = {
    "none": (),
    "shift": ("col_shift", "row_shift"),
    "shift-drift": ("col_shift", "col_per_row", "row_shift", "row_per_row"),
    "affine": COEFFICIENTS,
}


@dataclass(frozen=True, eq=False)
class OverAnother(SensorModel):
    """A model that changes the image points of another model, with the same ground and detail.

    Parameters
    ----------
    model : SensorModel
        The other model.
    """

    model: SensorModel

    @property
    def crs(self) -> str:
        return self.model.crs

    @property
    def domain(self) -> tuple[Array, Array]:
        return self.model.domain

    @property
    def height_range(self) -> tuple[float, float]:
        return self.model.height_range

    @property
    def height_limits(self) -> tuple[float, float]:
        return self.model.height_limits

    def with_heights(self, low: float, high: float) -> Self:
        return self._replace(model=self.model.with_heights(low, high))

    @property
    def stated_accuracy(self) -> float | None:
        return self.model.stated_accuracy

    @property
    def corners(self) -> Array:
        return self.model.corners

    @property
    def detail(self) -> float:
        return self.model.detail

    @property
    def uses_height(self) -> bool:
        return self.model.uses_height

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        inner = data.get("model")
        if not isinstance(inner, dict):
            raise InputError(f"a model of kind {cls.kind!r} needs the model that it corrects", field="model")
        return super().from_dict({**data, "model": model_from_dict(inner)})


@dataclass(frozen=True, eq=False)
class ImageCorrection(OverAnother):
    """A sensor model with a bias correction in the image: a shift, shift and drift, or affine transformation.

    Parameters
    ----------
    model : SensorModel
        The model to correct.
    correction : {'none', 'shift', 'shift-drift', 'affine'}
        Which coefficients are parameters; the others are zero.
    origin : (float, float)
        Column and row (px) at which the linear terms are zero.
    coefficients : (6,)
        In the order of `COEFFICIENTS`; shifts in px, the others in px per px.
    removed : tuple of str
        Coefficients of this correction that are zero and no parameters, because they were not significant.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> rpc = op.read_rpc("sample_data/scene_RPC.TXT")
    >>> ImageCorrection.identity(rpc, "shift", (500.0, 500.0)).param_names
    ('col_shift', 'row_shift')
    """

    kind: ClassVar[str] = "image_correction"

    correction: str
    origin: tuple[float, float]
    coefficients: Array
    removed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.correction not in FREE:
            raise InputError(f"unknown correction {self.correction!r}", remedy=f"use one of {', '.join(FREE)}")
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if coefficients.shape != (6,) or not np.isfinite(coefficients).all():
            raise InputError("a correction needs 6 finite coefficients", field="coefficients")
        (a, b), (c, d) = _matrix(coefficients).tolist()
        if abs(a * d - b * c) < 1e-6:
            raise InputError("this correction cannot be inverted", field="coefficients")
        object.__setattr__(self, "removed", tuple(self.removed))
        if not set(self.removed) <= set(FREE[self.correction]):
            raise InputError("only coefficients of the correction can be removed", field="removed")
        coefficients.setflags(write=False)
        object.__setattr__(self, "coefficients", coefficients)
        object.__setattr__(self, "origin", (float(self.origin[0]), float(self.origin[1])))

    @classmethod
    def identity(cls, model: SensorModel, correction: str, origin: tuple[float, float]) -> Self:
        """Return the correction that changes nothing: the start of an adjustment."""
        return cls(model, correction, origin, np.zeros(6))

    @property
    def param_names(self) -> tuple[str, ...]:
        names = FREE[self.correction]
        return tuple(name for name in names if name not in self.removed) if self.removed else names

    @property
    def removable(self) -> tuple[str, ...]:
        left = self.param_names
        # A slope without a shift would depend on the origin, which is only a convention.
        slopes = tuple(name for name in left if not name.endswith("_shift"))
        return slopes + tuple(
            f"{axis}_shift"
            for axis in ("col", "row")
            if f"{axis}_shift" in left and not any(name.startswith(axis) for name in slopes)
        )

    def without(self, names: Iterable[str]) -> Self:
        names = tuple(names)
        coefficients = self.coefficients.copy()
        coefficients[[COEFFICIENTS.index(name) for name in names]] = 0.0
        return self._replace(coefficients=coefficients, removed=(*self.removed, *names))

    @property
    def params(self) -> Array:
        return self.coefficients[self._free]

    def with_params(self, params: ArrayLike) -> Self:
        coefficients = np.zeros(6)
        coefficients[self._free] = as_params(params, self.param_names)
        return self._replace(coefficients=coefficients)

    @property
    def _free(self) -> list[int]:
        return _places(self.param_names)

    @property
    def matrix(self) -> Array:
        """The 2 x 2 matrix of the affine transformation (identity plus the linear coefficients)."""
        return _matrix(self.coefficients)

    @property
    def offset(self) -> Array:
        """The constant ``(2,)`` for which corrected = `matrix` @ image + `offset`."""
        return self.coefficients[[0, 3]] - (self.matrix - np.eye(2)) @ self.origin

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self._corrected(self.model.ground_to_image(ground))

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        moved = as_image(image) - self.origin - self.coefficients[[0, 3]]
        return self.model.image_to_ground(np.linalg.solve(self.matrix, moved.T).T + self.origin, height)

    def linearised(self, ground: ArrayLike) -> tuple[Array, Array, Array]:
        image, partials = self.model.projected(ground)
        return self._corrected(image), self._turned(partials), self._slopes(image)

    def _corrected(self, image: Array) -> Array:
        return image + (image - self.origin) @ (self.matrix - np.eye(2)).T + self.coefficients[[0, 3]]

    def ground_partials(self, ground: ArrayLike) -> Array:
        return self._turned(self.model.ground_partials(ground))

    def _turned(self, partials: Array) -> Array:
        # Written out: a product of stacks of such small matrices takes ten times as long.
        return partials[:, :1] * self.matrix[:, :1] + partials[:, 1:] * self.matrix[:, 1:]

    def param_partials(self, ground: ArrayLike) -> Array:
        return self._slopes(self.model.ground_to_image(ground))

    def _slopes(self, image: Array) -> Array:
        """Return d(image)/d(params) at image points of the model."""
        centred = image - self.origin
        partials = np.zeros((len(image), 2, 6))
        partials[:, 0, 0] = partials[:, 1, 3] = 1.0
        partials[:, 0, 1:3] = partials[:, 1, 4:6] = centred
        lost = ~(np.isfinite(centred[:, 0]) & np.isfinite(centred[:, 1]))
        if lost.any():
            partials[lost] = np.nan
        free = self._free
        return partials if len(free) == len(COEFFICIENTS) else partials[:, :, free]

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        # Older files do not have this field.
        return super().from_dict({"removed": (), **data})


@functools.cache
def _places(names: tuple[str, ...]) -> list[int]:
    """Return the indices of some coefficients."""
    return [COEFFICIENTS.index(name) for name in names]


def _matrix(coefficients: Array) -> Array:
    _, a, b, _, c, d = coefficients.tolist()
    return np.array([[1.0 + a, b], [c, 1.0 + d]])
