r"""Rational functions: image coordinates as ratios of polynomials of the ground.

`Rational` is any classical model of the table in `ortho_pipeline.models.families`.

The RPC model of vendors (RPC00B) is the cubic case with given coefficients. With ground coordinates normalised to
:math:`L, P, H` (longitude, latitude, ellipsoidal height; minus offset, over scale),

.. math:: c_n = \frac{a \cdot t(L, P, H)}{b \cdot t(L, P, H)}, \qquad
          column = c_n \cdot col\_scale + col\_off

and likewise for the row, with the 20 terms :math:`t` in the order of `RPC_TERMS`.

Source: NIMA STDI-0002, appendix E (RPC00B); Grodecki and Dial 2001; formula 6 of Bueyueksalih et al. (OrbView-3).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import enu_from_geodetic
from ortho_pipeline.models import rpc_kernel
from ortho_pipeline.models.base import (
    INVERSE_TOLERANCE,
    INVERSE_VERIFIED,
    Array,
    SensorModel,
    as_ground,
    as_heights,
    as_image,
    as_params,
)
from ortho_pipeline.models.families import exponents, family_of, points_needed
from ortho_pipeline.models.polynomials import term_partials, term_table, terms_of
from ortho_pipeline.models.rpc_box import check_numbers, sound_heights
from ortho_pipeline.runtime.compiled import is_loaded

#: Compiled kernels are used from this number of points: for fewer, NumPy is faster than loading a compiler.
COMPILED_FROM = 20_000
#: The same if the compiler is already loaded.
LOADED_FROM = 500
_NUMBERS = tuple(f"{name}_{part}" for part in ("off", "scale") for name in ("col", "row", "lon", "lat", "h"))
#: Pixels from coefficients as large as this may be too large for numbers.
_OVERFLOWING = 1e100
#: Points that NumPy processes at once: their arrays stay in the second-level cache.
_PART = 1024
#: Beyond this many scales from its centre an RPC is meaningless extrapolation, and has false roots.
DOMAIN_LIMIT = 1.5


def _is_for_numpy(count: int) -> bool:
    return count < (LOADED_FROM if is_loaded() else COMPILED_FROM)


@dataclass(frozen=True, eq=False)
class RPC(SensorModel):
    """Rational polynomial coefficients of a vendor, for WGS84 longitude, latitude and ellipsoidal height.

    `col_off` and `row_off` follow this package's image convention: SAMP_OFF + 0.5 and LINE_OFF + 0.5. Coefficients are
    ``(20,)`` in the order of RPC00B. Longitudes are unwrapped about `lon_off`, so scenes across the antimeridian work.
    A ground point is NaN beyond 1.5 scales from the centre, beyond a pole, and outside the heights at which the RPC has
    no pole and no fold (`rpc_box.sound_heights`).

    Raises
    ------
    InputError
        For numbers that no RPC of a scene on Earth has: not finite, a scale of zero, a pole near the centre.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> rpc = op.read_rpc("sample_data/scene_RPC.TXT")
    >>> round(rpc.lon_off, 2), round(rpc.lat_off, 2), rpc.h_off
    (33.35, 37.25, 1000.0)
    """

    kind: ClassVar[str] = "rpc"

    col_off: float
    row_off: float
    lon_off: float
    lat_off: float
    h_off: float
    col_scale: float
    row_scale: float
    lon_scale: float
    lat_scale: float
    h_scale: float
    col_num: Array = field(repr=False)
    col_den: Array = field(repr=False)
    row_num: Array = field(repr=False)
    row_den: Array = field(repr=False)
    err_bias: float | None = None
    err_rand: float | None = None

    def __post_init__(self) -> None:
        numbers = {name: float(getattr(self, name)) for name in _NUMBERS}
        check_numbers(numbers)
        for name, value in numbers.items():
            object.__setattr__(self, name, value)
        for name in ("col_num", "col_den", "row_num", "row_den"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != (20,):
                raise InputError(f"an RPC needs 20 coefficients, not {values.size}", field=name)
            if not (np.abs(values) < _OVERFLOWING).all():
                raise InputError("an RPC needs finite coefficients, of less than 1e100", field=name)
            if not values.any():
                raise InputError("all coefficients are zero", field=name)
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        _ = self._reach  # refuses an unsound RPC

    @cached_property
    def _reach(self) -> tuple[float, float]:
        """Normalised heights up to which the model projects."""
        numbers = {name: getattr(self, name) for name in _NUMBERS}
        low, high = sound_heights(numbers, self._polynomials)
        # If it is sound up to the end of the box, then beyond it as far as horizontally.
        return low if low > -1.0 else -DOMAIN_LIMIT, high if high < 1.0 else DOMAIN_LIMIT

    @property
    def stated_accuracy(self) -> float | None:
        """ERR_BIAS and ERR_RAND together."""
        # What is not positive stands for unknown: -1 in the standard, 0 of some programs.
        given = [value for value in (self.err_bias, self.err_rand) if value is not None and value > 0]
        return math.hypot(*given) if given else None

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[Array, Array]:
        low, high = np.clip(self._reach, -1.0, 1.0)
        middle, half = (low + high) / 2, (high - low) / 2
        return (
            np.array([self.lon_off, self.lat_off, self.h_off + middle * self.h_scale]),
            np.abs([self.lon_scale, self.lat_scale, half * self.h_scale]),
        )

    @property
    def height_limits(self) -> tuple[float, float]:
        low, high = sorted(self.h_off + self.h_scale * reach for reach in self._reach)
        return low, high

    def ground_to_image(self, ground: ArrayLike) -> Array:
        ground = as_ground(ground)
        image = np.empty((len(ground), 2))
        if _is_for_numpy(len(ground)):
            self._project(ground, image)
        else:
            rpc_kernel.project(ground, *self.tables, image)
        return image

    def ground_partials(self, ground: ArrayLike) -> Array:
        return self.projected(ground)[1]

    def projected(self, ground: ArrayLike) -> tuple[Array, Array]:
        ground = as_ground(ground)
        image, partials = np.empty((len(ground), 2)), np.empty((len(ground), 2, 3))
        if _is_for_numpy(len(ground)):
            self._project(ground, image, partials)
        else:
            rpc_kernel.projected(ground, *self.tables, image, partials)
        return image, partials

    def _project(self, ground: Array, image: Array, partials: Array | None = None) -> None:
        """Project in NumPy as `rpc_kernel.project` and `projected` do, with the same result in every bit."""
        offsets, scales, coefficients, limits = self.tables
        terms = tuple(coefficients.T[:, :, None])
        with np.errstate(all="ignore"):
            for first in range(0, len(ground), _PART):
                part = slice(first, first + _PART)
                place = rpc_kernel.normalised(*ground[part].T, offsets, scales)
                values = rpc_kernel.polynomial(terms, *place)
                ratios, denominators = values[::2] / values[1::2], values[1::2]
                good = rpc_kernel.is_within(*place, limits) & rpc_kernel.is_point(*ratios, *denominators)
                ratios[:, ~good] = np.nan
                image[part] = (ratios * scales[3:, None] + offsets[3:, None]).T
                if partials is not None:
                    changes = np.array(rpc_kernel.slopes(terms, *place))
                    by_place = (changes[:, ::2] - ratios * changes[:, 1::2]) * (1.0 / denominators)
                    partials[part] = (by_place * scales[3:, None] / scales[:3, None, None]).T

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        image = as_image(image)
        if len(image) < COMPILED_FROM:
            return super().image_to_ground(image, height)
        ground = np.empty((len(image), 3))
        heights = np.ascontiguousarray(as_heights(height, len(image)))
        rpc_kernel.image_to_ground(image, heights, *self.tables, INVERSE_TOLERANCE, INVERSE_VERIFIED, 25, ground)
        return ground

    @cached_property
    def tables(self) -> tuple[Array, Array, Array, Array]:
        """Offsets and scales, coefficients and limits as in `rpc_kernel`."""
        offsets = np.array([self.lon_off, self.lat_off, self.h_off, self.col_off, self.row_off])
        scales = np.array([self.lon_scale, self.lat_scale, self.h_scale, self.col_scale, self.row_scale])
        # Denominators are made positive at the centre; where one is negative, there is a pole in between.
        coefficients = self._polynomials * np.repeat(np.sign(self._polynomials[1::2, :1]), 2, axis=0)
        return offsets, scales, coefficients, np.array([DOMAIN_LIMIT, *self._reach])

    @property
    def _polynomials(self) -> Array:
        """Coefficients ``(4, 20)``: column numerator and denominator, row numerator and denominator."""
        return np.stack([self.col_num, self.col_den, self.row_num, self.row_den])

    def shifted(self, columns: float, rows: float) -> RPC:
        """Return the model of a crop whose first pixel is (columns, rows) of this image."""
        return self._replace(col_off=self.col_off - columns, row_off=self.row_off - rows)

    def scaled(self, factor: float) -> RPC:
        """Return the model of this image, resampled to pixels `factor` times as large."""
        return self._replace(
            col_off=self.col_off / factor,
            row_off=self.row_off / factor,
            col_scale=self.col_scale / factor,
            row_scale=self.row_scale / factor,
        )


# -- classical models ------------------------------------------------------------------------------------------------

#: The `ground_crs` of a model in geocentric coordinates.
GEOCENTRIC = "geocentric"
#: A denominator below this part of its constant is at or behind the pole of the model.
_POLE = 1e-3


@dataclass(frozen=True, eq=False)
class Rational(SensorModel):
    """A classical model: ratios of polynomials of normalised ground coordinates.

    Parameters
    ----------
    family : str
        A name of `ortho_pipeline.models.families`, which defines the terms.
    ground_crs : str
        CRS of the ground. ``geocentric``: lon, lat, h (EPSG:4979) are converted to Cartesian coordinates in the local
        ENU frame of the middle of `box`, which are affine to geocentric ones.
    coefficients : (P,)
        In the order of the family's `param_names`, for normalised coordinates.
    ground_offset, ground_scale : (3,)
    image_offset, image_scale : (2,)
        Normalised coordinates are (value - offset) / scale.
    box : (2, 3)
        Minimum and maximum ground coordinates; NaN beyond 1.5 half-sizes horizontally from its middle.
    wraps : bool
        Whether the first ground coordinate is a longitude in degrees.
    removed : tuple of str
        Coefficients that are zero and no parameters.

    Examples
    --------
    >>> model = fit_family("affine3d", op.read_points("sample_data/gcps.geojson")).model
    >>> model.family, len(model.params)
    ('affine3d', 8)
    """

    kind: ClassVar[str] = "rational"

    family: str
    ground_crs: str
    coefficients: Array = field(repr=False)
    ground_offset: Array = field(repr=False)
    ground_scale: Array = field(repr=False)
    image_offset: Array = field(repr=False)
    image_scale: Array = field(repr=False)
    box: Array = field(repr=False)
    wraps: bool = False
    removed: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        terms = term_table(self.family)
        shapes = {
            "coefficients": (terms.family.parameters,),
            "ground_offset": (3,),
            "ground_scale": (3,),
            "image_offset": (2,),
            "image_scale": (2,),
            "box": (2, 3),
        }
        for name, shape in shapes.items():
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise InputError(f"a model of this family needs {shape} finite numbers", field=name)
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if not ((self.ground_scale > 0).all() and (self.image_scale > 0).all()):
            raise InputError("scales must be positive", field="ground_scale, image_scale")
        if not (self.box[0] < self.box[1]).all():
            raise InputError("each minimum must be below its maximum", field="box")
        object.__setattr__(self, "removed", tuple(self.removed))
        unknown = set(self.removed) - set(terms.family.param_names)
        gone = [terms.family.param_names.index(name) for name in self.removed if name not in unknown]
        if unknown or self.coefficients[gone].any():
            raise InputError("only coefficients of the family that are zero can be removed", field="removed")
        object.__setattr__(self, "_table", terms.table(self.coefficients))

    @property
    def crs(self) -> str:
        return "EPSG:4979" if self.ground_crs == GEOCENTRIC else self.ground_crs

    @property
    def domain(self) -> tuple[Array, Array]:
        return self.box.mean(axis=0), (self.box[1] - self.box[0]) / 2

    @property
    def uses_height(self) -> bool:
        return family_of(self.family).dimensions == 3

    # -- parameters --------------------------------------------------------------------------------------------------

    @property
    def param_names(self) -> tuple[str, ...]:
        names = term_table(self.family).family.param_names
        return tuple(name for name in names if name not in self.removed) if self.removed else names

    @property
    def _free(self) -> list[int]:
        return [k for k, name in enumerate(family_of(self.family).param_names) if name not in self.removed]

    @property
    def params(self) -> Array:
        return self.coefficients[self._free]

    def with_params(self, params: ArrayLike) -> Self:
        coefficients = np.zeros(len(self.coefficients))
        coefficients[self._free] = as_params(params, self.param_names)
        return self._replace(coefficients=coefficients)

    @property
    def minimum_points(self) -> int:
        return points_needed(self.param_names)

    @property
    def removable(self) -> tuple[str, ...]:
        parts: dict[str, list[tuple[str, NDArray[np.int64]]]] = {}
        for name in self.param_names:
            part, _, term = name.rpartition("_")
            parts.setdefault(part, []).append((name, exponents(term)))
        return tuple(
            name
            for terms in parts.values()
            for name, powers in terms
            if powers.any() and not any((other >= powers).all() for also, other in terms if also != name)
        )

    def without(self, names: Iterable[str]) -> Self:
        names = tuple(names)
        coefficients = self.coefficients.copy()
        coefficients[[family_of(self.family).param_names.index(name) for name in names]] = 0.0
        return self._replace(coefficients=coefficients, removed=(*self.removed, *names))

    @property
    def penalised(self) -> tuple[str, ...]:
        """Names of the parameters that a regularisation pulls to zero: all but the affine part of the numerators."""
        return tuple(
            name for name in self.param_names if "den_" in name or int(exponents(name.rpartition("_")[2]).sum()) > 1
        )

    # -- evaluation --------------------------------------------------------------------------------------------------

    def normalise(self, ground: ArrayLike) -> tuple[Array, Array | None]:
        """Return normalised coordinates ``(N, 3)``, NaN outside the domain, and slopes if they are not 1 / scale.

        The slopes ``(N, 3, 3)`` are the derivatives of Cartesian by geodetic coordinates, before scaling.
        """
        ground = as_ground(ground).copy()
        centre, half = self.domain
        with np.errstate(invalid="ignore"):
            if self.wraps:
                ground[:, 0] -= 360.0 * np.round((ground[:, 0] - centre[0]) / 360.0)
            outside = (np.abs(ground[:, :2] - centre[:2]) > DOMAIN_LIMIT * half[:2]).any(axis=1)
        ground[outside | ~np.isfinite(ground).all(axis=1)] = np.nan
        slopes = None
        if self.ground_crs == GEOCENTRIC:
            ground, slopes = enu_from_geodetic(ground, centre)
        return (ground - self.ground_offset) / self.ground_scale, slopes

    def _sums(self, terms: Array) -> Array:
        """Return the four polynomials ``(4, N)``; NaN beyond a pole of a denominator."""
        sums = self._table @ terms  # type: ignore[attr-defined]
        with np.errstate(invalid="ignore"):
            sums[:, ~(sums[2:] > _POLE).all(axis=0)] = np.nan
        return np.asarray(sums)

    def ground_to_image(self, ground: ArrayLike) -> Array:
        normalised, _ = self.normalise(ground)
        sums = self._sums(terms_of(term_table(self.family).powers, normalised))
        image = (sums[:2] / sums[2:]).T * self.image_scale + self.image_offset
        image[~np.isfinite(normalised).all(axis=1)] = np.nan
        return np.ascontiguousarray(image)

    def ground_partials(self, ground: ArrayLike) -> Array:
        normalised, slopes = self.normalise(ground)
        sums = self._sums(terms_of(term_table(self.family).powers, normalised))
        ratios = sums[:2] / sums[2:]
        by_axis = self._table @ term_partials(term_table(self.family).powers, normalised)  # type: ignore[attr-defined]
        partials = np.moveaxis((by_axis[:, :2] - ratios * by_axis[:, 2:]) / sums[2:], (0, 1, 2), (2, 1, 0))
        partials = partials * self.image_scale[:, None] / self.ground_scale
        partials[~np.isfinite(normalised).all(axis=1)] = np.nan
        return np.asarray(partials if slopes is None else partials @ slopes)

    def param_partials(self, ground: ArrayLike) -> Array:
        normalised, _ = self.normalise(ground)
        terms = terms_of(term_table(self.family).powers, normalised)
        sums = self._sums(terms)
        factors = np.concatenate([1.0 / sums[2:], -sums[:2] / sums[2:] ** 2]) * np.tile(self.image_scale, 2)[:, None]
        free = self._free
        partials = np.zeros((terms.shape[1], 2, len(free)))
        places = term_table(self.family).places
        for k, index in enumerate(free):
            rows, term = places[index]
            for row in rows:
                partials[:, row % 2, k] = factors[row] * terms[term]
        partials[~np.isfinite(normalised).all(axis=1)] = np.nan
        return partials

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        if not isinstance(data.get("family"), str):
            raise InputError("a rational model needs the name of its family", field="family")
        return super().from_dict(data)
