"""The base of all sensor models. A new model implements `ground_to_image` and inherits the rest."""

from __future__ import annotations

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError

#: The type of all arrays of coordinates and parameters.
Array = NDArray[np.float64]
#: Corners of an image from the upper left, clockwise, in parts of its size.
RING = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])

#: Newton's method stops at this distance (px) from the image point.
INVERSE_TOLERANCE = 1e-9
#: A point is NaN if its projection differs from the image point by more than this (px).
INVERSE_VERIFIED = 1e-5
_INVERSE_STEPS = 25
#: A step of a parameter moves the image by this much (px), which is more than rounding errors and less than a curve.
_MOVED = 0.01, 10.0
_STEP_TRIES = 8


@dataclass(frozen=True, eq=False)
class Constraints:
    """Pseudo-observations of a model: knowledge of its parameters beyond image measurements.

    An adjustment weights measured ones by their sigma, like any other observation. The sigma of fictitious ones (soft
    constraints) is chosen, and their residuals test no measurements.

    Parameters
    ----------
    residuals : (k,)
        Observed minus computed at the model's `params`.
    jacobian : (k, P)
        d(computed)/d(params).
    sigma : (k,)
        Standard deviations, positive, in the unit of the residuals.
    fictitious : (k,) of bool, optional
        Default: all are measured.
    """

    residuals: Array
    jacobian: Array
    sigma: Array
    fictitious: NDArray[np.bool_] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        if self.fictitious is None:
            object.__setattr__(self, "fictitious", np.zeros(len(self.residuals), dtype=bool))

    def __len__(self) -> int:
        return len(self.residuals)


@dataclass(frozen=True, eq=False)
class SensorModel(ABC):
    """Map from ground to image, with a named parameter vector.

    Subclasses are frozen dataclasses and implement `ground_to_image`. A closed form may override any other method;
    `ortho_pipeline.testing.check_sensor_model` then compares it with the numeric default.

    Ground points are ``(N, 3)``: x, y, ellipsoidal height in `crs`. Image points are ``(N, 2)``: column, row in pixels,
    with the outer corner of the first pixel at (0, 0). A point that cannot be mapped is a row of NaN.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> model = op.open_scene("sample_data/scene.tif").model
    >>> model.image_to_ground([[500.0, 500.0]], height=800.0).round(4)
    array([[ 33.35  ,  37.2501, 800.    ]])
    """

    kind: ClassVar[str]

    @property
    @abstractmethod
    def crs(self) -> str:
        """CRS of the ground coordinates, as text that `crs.parse_crs` reads."""

    @abstractmethod
    def ground_to_image(self, ground: ArrayLike) -> Array:
        """Project ground points ``(N, 3)`` into the image ``(N, 2)``; NaN where there is no projection."""

    @property
    @abstractmethod
    def domain(self) -> tuple[Array, Array]:
        """Centre and half-size ``(3,)`` of the box of ground in which the model is meant to be used."""

    @property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest ellipsoidal height (m) for which the model is meant."""
        centre, half = self.domain
        return float(centre[2] - half[2]), float(centre[2] + half[2])

    @property
    def height_limits(self) -> tuple[float, float]:
        """Lowest and highest ellipsoidal height (m) that the model projects; others would be extrapolation."""
        return -math.inf, math.inf

    @property
    def reference_height(self) -> float:
        """Ellipsoidal height (m) in the middle of `height_range`."""
        return float(self.domain[0][2])

    def with_heights(self, low: float, high: float) -> Self:
        """Return this model for ground between two ellipsoidal heights (m).

        A model whose numbers contain the range, such as an RPC, returns itself.
        """
        return self

    @property
    def stated_accuracy(self) -> float | None:
        """Standard deviation (m, each axis in plan) that the vendor states for the model; None if not stated."""
        return None

    @property
    def corners(self) -> Array:
        """Ground points ``(N, 3)`` at the corners of the model's area, at its lowest and highest height.

        By default the corners of `domain`. A model that knows its image returns the corners of the image.
        """
        centre, half = self.domain
        return np.asarray(centre + half * np.array(list(itertools.product((-1.0, 1.0), repeat=3))))

    @property
    def detail(self) -> float:
        """Length (px) of the finest detail of the map: half its shortest wave, or the distance between knots.

        Infinite (the default) for a model that is smooth all over its image. The warp never interpolates over more.
        """
        return math.inf

    # -- parameters --------------------------------------------------------------------------------------------------

    @property
    def param_names(self) -> tuple[str, ...]:
        """Names of the adjustable parameters, in the order of `params`."""
        return ()

    @property
    def params(self) -> Array:
        """Adjustable parameters ``(P,)``."""
        return np.zeros(0)

    def with_params(self, params: ArrayLike) -> Self:
        """Return this model with other parameters ``(P,)``."""
        if np.size(params):
            raise InputError(f"the model {self.kind!r} has no adjustable parameters")
        return self

    @property
    def minimum_points(self) -> int:
        """Least number of control points that determine all parameters; each gives two equations."""
        return -(-len(self.param_names) // 2)

    @property
    def uses_height(self) -> bool:
        """False for a model of the plane, which maps all heights to the same point."""
        return True

    @property
    def removable(self) -> tuple[str, ...]:
        """Names of the parameters that `without` may remove next: those that no higher term needs."""
        return ()

    def without(self, names: Iterable[str]) -> Self:
        """Return this model without these parameters: they are zero, and no longer adjustable."""
        raise InputError(f"parameters of a model {self.kind!r} cannot be removed", field=", ".join(names))

    def constraints(self) -> Constraints:
        """Return the pseudo-observations of the parameters, linearised at `params`; most models have none."""
        return Constraints(np.zeros(0), np.zeros((0, len(self.param_names))), np.zeros(0))

    # -- derived maps ------------------------------------------------------------------------------------------------

    def ground_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(ground) as ``(N, 2, 3)``, by central differences over a 1e-4 part of the domain."""
        ground = as_ground(ground)
        _, half = self.domain
        partials = np.empty((len(ground), 2, 3))
        for axis, step in enumerate(1e-4 * half):
            nudge = np.zeros(3)
            nudge[axis] = step
            partials[:, :, axis] = (self.ground_to_image(ground + nudge) - self.ground_to_image(ground - nudge)) / (
                2 * step
            )
        return partials

    def param_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(params) as ``(N, 2, P)``, by central differences over 0.01 to 10 px if possible."""
        ground = as_ground(ground)
        params = np.asarray(self.params, dtype=np.float64)  # a plugin may start from whole numbers
        partials = np.empty((len(ground), 2, len(params)))
        for k, value in enumerate(params):
            step = 1e-6 * max(abs(value), 1e-3)
            for _ in range(_STEP_TRIES):
                ahead, behind = params.copy(), params.copy()
                ahead[k] += step
                behind[k] -= step
                after, before = (self.with_params(values).ground_to_image(ground) for values in (ahead, behind))
                moved = after - before
                reach = np.nanmax(np.abs(moved), initial=0.0)
                # A step of 1e-9 suits an angle in radians. A position in metres has rounding errors of that size.
                if reach < _MOVED[0] and step < 0.01 * max(abs(value), 1.0):
                    step *= 100
                elif reach > _MOVED[1] and step > 1e-8 * max(abs(value), 1.0):  # not without end at a seam of the image
                    step /= 100
                else:
                    break
            partials[:, :, k] = moved / (ahead[k] - behind[k])
        return partials

    def projected(self, ground: ArrayLike) -> tuple[Array, Array]:
        """Project ground points; return `ground_to_image` and `ground_partials` of them, which may share work."""
        return self.ground_to_image(ground), self.ground_partials(ground)

    def linearised(self, ground: ArrayLike) -> tuple[Array, Array, Array]:
        """Project ground points; return `ground_to_image`, `ground_partials` and `param_partials` of them."""
        return *self.projected(ground), self.param_partials(ground)

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Intersect the rays of image points ``(N, 2)`` with ellipsoidal heights ``(N,)`` or one height.

        Newton's method with `ground_partials` starts in the middle of the domain. A point is NaN if its projection
        differs by more than 1e-5 px, or if it is beyond 1.5 half-sizes of the domain, where a ratio of polynomials has
        false roots.

        Returns
        -------
        ndarray (N, 3)
            Ground points in `crs`.
        """
        image = as_image(image)
        centre, half = self.domain
        reach = 1.5 * (1 - 1e-12) * half[:2]
        ground = np.empty((len(image), 3))
        ground[:, :2] = centre[:2]
        ground[:, 2] = as_heights(height, len(image))
        left = np.flatnonzero(np.isfinite(image).all(axis=1) & np.isfinite(ground[:, 2]))
        for _ in range(_INVERSE_STEPS):
            if not len(left):
                break
            projected, partials = self.projected(ground[left])
            miss = image[left] - projected
            step = solve_2x2(partials[:, :, :2], miss)
            # A step beyond the domain comes from a bad linearisation far from the solution: shorten it.
            longest = np.abs(step / half[:2]).max(axis=1, initial=0.0)
            step /= np.maximum(longest, 1.0)[:, None]
            ground[left, :2] += step
            # Outside the domain there may be no projection, and so no way back.
            ground[left, :2] = np.clip(ground[left, :2], centre[:2] - reach, centre[:2] + reach)
            with np.errstate(invalid="ignore"):
                left = left[(np.abs(miss).max(axis=1) > INVERSE_TOLERANCE) & (longest > 1e-15)]
        with np.errstate(invalid="ignore"):
            closed = np.abs(self.ground_to_image(ground) - image).max(axis=1, initial=0.0) <= INVERSE_VERIFIED
            inside = (np.abs(ground[:, :2] - centre[:2]) <= 1.5 * half[:2]).all(axis=1)
        ground[~(closed & inside)] = np.nan
        return ground

    # -- files -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain data for JSON, without loss; `models.model_from_dict` reads it."""
        data: dict[str, Any] = {"kind": self.kind}
        for field in fields(self):
            value = getattr(self, field.name)
            data[field.name] = _plain(value)
        return data

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make the model from the result of `to_dict`."""
        names = {field.name for field in fields(cls)}
        values = {key: value for key, value in data.items() if key != "kind"}
        if set(values) != names:
            wrong = sorted(set(values) ^ names)
            raise InputError(
                f"a model of kind {cls.kind!r} must have the fields {sorted(names)}", field=", ".join(wrong)
            )
        return cls(**values)

    def _replace(self, **changes: Any) -> Self:
        return replace(self, **changes)


def _plain(value: Any) -> Any:
    if isinstance(value, SensorModel):
        return value.to_dict()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


#: Model classes by their `kind` in files: those of `models`, and those that the hook `ortho_models` adds.
KINDS: dict[str, type[SensorModel]] = {}


def model_from_dict(data: dict[str, Any]) -> SensorModel:
    """Make a model from the result of its `to_dict`.

    Raises
    ------
    InputError
        If its kind is unknown (its plugin is not installed), or its fields are wrong.
    """
    kind = data.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(
            f"unknown kind of sensor model {kind!r}",
            field="kind",
            remedy=f"use one of {', '.join(sorted(KINDS))}, or install the plugin that has this kind in ortho_models",
        )
    try:
        return KINDS[kind].from_dict(data)
    except (TypeError, ValueError, AttributeError, ArithmeticError, LookupError, RecursionError) as error:
        # Constructors check the values of numbers; a value that is no number or list at all fails when it is used.
        raise InputError(
            f"this is not a model of kind {kind!r} ({str(error)[:200]})",
            field=kind,
            remedy="write the model again, and do not edit the file",
        ) from error


def as_ground(ground: ArrayLike) -> Array:
    """Return ground points as ``(N, 3)`` float64."""
    return _as_points(ground, 3, "ground")


def as_image(image: ArrayLike) -> Array:
    """Return image points as ``(N, 2)`` float64."""
    return _as_points(image, 2, "image")


def _as_points(points: ArrayLike, columns: int, what: str) -> Array:
    array = as_numbers(points, what)
    if array.ndim != 2 or array.shape[1] != columns:
        raise InputError(f"{what} points must have the shape (N, {columns}), not {array.shape}")
    return array


def as_heights(heights: ArrayLike, count: int) -> Array:
    """Return heights as ``(N,)`` float64: one for each point, or one for all."""
    array = as_numbers(heights, "height")
    if array.shape not in ((), (1,), (count,)):
        raise InputError(f"height must be one number or have the shape ({count},), not {array.shape}")
    return np.broadcast_to(array, (count,))


def as_numbers(values: ArrayLike, what: str) -> Array:
    """Return values as contiguous float64; NaN where a masked array has none."""
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(np.float64), np.nan)
        return np.asarray(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InputError(f"{what} is no array of numbers ({error})", field=what) from error


def as_params(params: ArrayLike, names: Sequence[str]) -> Array:
    """Return parameters ``(P,)`` as float64, one for each name."""
    array = np.asarray(params, dtype=np.float64)
    if array.shape != (len(names),):
        raise InputError(f"parameters must have the shape ({len(names)},), not {array.shape}: {', '.join(names)}")
    return array


def checked_names(free: Iterable[str], known: Iterable[str], where: str) -> tuple[str, ...]:
    """Return the names of free parameters, which must be known and different."""
    names = tuple(free)
    unknown = sorted(set(names) - set(known))
    if unknown or len(set(names)) != len(names):
        raise InputError(f"free parameters must be different names {where}", field=", ".join(unknown) or "free")
    return names


def ground_of_grid(model: SensorModel, size: tuple[int, int], count: int, heights: tuple[float, float]) -> Array:
    """Return ground points ``(2 count^2, 3)`` of `count` x `count` image points, edges included, at two heights (m).

    Examples
    --------
    >>> ground_of_grid(op.read_rpc("sample_data/scene_RPC.TXT"), (1000, 1000), 3, (700.0, 1200.0)).shape
    (18, 3)
    """
    fractions = np.stack(np.meshgrid(*[np.linspace(0, 1, count)] * 2), axis=-1).reshape(-1, 2)
    image = fractions * size
    return np.concatenate([model.image_to_ground(image, height) for height in heights])


def box_around(ground: Array, heights: tuple[float, float]) -> tuple[Array, Array]:
    """Return centre and half-size ``(3,)`` of the box around ground points, between two heights.

    They are read-only, because models keep them.
    """
    low, high = np.nanmin(ground, axis=0), np.nanmax(ground, axis=0)
    low[2], high[2] = heights
    centre, half = (low + high) / 2, (high - low) / 2
    for values in (centre, half):
        values.setflags(write=False)
    return centre, half


def ground_of_corners(model: SensorModel, size: tuple[int, int], heights: tuple[float, float]) -> Array:
    """Return the ground ``(8, 3)`` of the corners of an image of `size` (columns, rows), clockwise, at two heights."""
    image = RING * size
    return np.concatenate([model.image_to_ground(image, height) for height in heights])


def solve_2x2(matrices: Array, right: Array) -> Array:
    """Solve ``(N, 2, 2)`` systems for ``(N, 2)`` right sides; NaN where singular."""
    a, b, c, d = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1.0 / (a * d - b * c)
        solved = np.stack(
            [(d * right[:, 0] - b * right[:, 1]) * scale, (a * right[:, 1] - c * right[:, 0]) * scale], axis=1
        )
    solved[~np.isfinite(solved).all(axis=1)] = np.nan
    return solved
