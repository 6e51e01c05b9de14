"""The interface of the ground, be it a DEM or flat: heights, and the windows of samples that a warp reads."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import as_numbers
from ortho_pipeline.options import number_of

Array = NDArray[np.float64]
#: Samples left, top, right, bottom; the last two are the first beyond.
Window = tuple[int, int, int, int]


class Excerpt(NamedTuple):
    """A piece of a surface as a raster: heights ``(rows, columns)``, geotransform as GDAL's, horizontal CRS.

    Flat ground is a single sample.
    """

    heights: Array
    geotransform: tuple[float, ...]
    crs: pyproj.CRS


class Surface(abc.ABC):
    """The ground as ellipsoidal heights. `open_dem` opens a DEM; `FlatSurface` is one height.

    A surface never changes: `with_fill` and `around` return another one. Threads may share it. Copies and pickles
    do not contain heights that were read.

    For a warp every surface is a raster of samples that is read by windows. The samples of flat ground are equal.
    There is no third kind: another source of heights is a `Samples`, of which `dem_of` makes a DEM.

    Attributes
    ----------
    fill : 'error', 'mask', 'nearest' or float
        Value in a void: NaN for the first two, a height for the others.
    sigma : float, Surface or None
        Standard deviation (m) of the heights, or a surface that has one at each place. None if unknown.

    Examples
    --------
    >>> dem = op.open_dem("sample_data/dem.tif")
    >>> points = op.read_points("sample_data/gcps.csv")
    >>> dem.heights(points.ground[:2, :2], points.crs).round(1).tolist()
    [1027.8, 945.3]
    """

    fill: str | float
    sigma: float | Surface | None

    # -- what it is --------------------------------------------------------------------------------------------------

    @property
    @abc.abstractmethod
    def block(self) -> int:
        """Bytes that GDAL decodes at once to read a sample; 0 where nothing is read."""

    @property
    def files(self) -> tuple[str, ...]:
        """The files that heights are read from."""
        return ()

    @property
    @abc.abstractmethod
    def provenance(self) -> dict[str, Any]:
        """Path, declared and used height datum, fill rule, warnings, or the one height; JSON values."""

    @abc.abstractmethod
    def describe(self) -> str:
        """Return where a point on the surface is, in words: on the DEM, or at a height in metres."""

    @abc.abstractmethod
    def with_fill(self, fill: str | float) -> Surface:
        """Return this surface with another rule for voids.

        Raises
        ------
        InputError
            If there is no such rule.
        """

    def with_sigma(self, sigma: float | Surface | None) -> Self:
        """Return this surface with another standard deviation of its heights.

        Raises
        ------
        InputError
            If that is a number that is not positive and finite.
        """
        if sigma is not None and not isinstance(sigma, Surface):
            number = number_of(sigma)
            if not number > 0:
                raise InputError(
                    f"{sigma} is not a standard deviation of heights",
                    field="surface.sigma",
                    remedy="give a positive number of metres, a surface, or None",
                )
            sigma = number
        return dataclasses.replace(self, sigma=sigma)  # type: ignore[type-var]

    @abc.abstractmethod
    def around(self, lon: float) -> Surface:
        """Return this surface with the seam of a global DEM opposite to `lon` (degrees); any other one unchanged.

        Sample coordinates are then continuous about `lon`, also over the antimeridian.
        """

    # -- heights -----------------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def heights(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> Array:
        """Return heights ``(N,)`` at positions ``(N, 2)`` (x, y) of `crs` (that of the surface by default).

        Bilinear between sample centres; NaN outside and next to a void, unless `fill` gives them a height.
        """

    @abc.abstractmethod
    def coverage(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> float:
        """Return the share (0 to 1) of positions ``(N, 2)`` that have a height of their own, not a filled one."""

    @abc.abstractmethod
    def above(self, ground: Array, crs: str | pyproj.CRS) -> Array:
        """Return how far (m) points ``(N, 3)`` are above measured heights. NaN where there are none."""

    @abc.abstractmethod
    def range_under(self, ground: Array, crs: str | pyproj.CRS, margin: float = 0.0) -> tuple[float, float]:
        """Return the lowest and the highest height (m) in the box of samples under points ``(N, 3)``.

        Parameters
        ----------
        margin : float
            Part of the box's sides by which it is widened on each side, and one sample more.

        Raises
        ------
        CoverageError
            If there is no valid height in it.
        """

    @property
    @abc.abstractmethod
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest height (m) of the whole surface, with a fill height. Reads every sample once."""

    # -- samples -----------------------------------------------------------------------------------------------------

    @abc.abstractmethod
    def sampler(self, crs: str | pyproj.CRS) -> Callable[[Array], Array]:
        """Return the function from ground ``(N, 3)`` in `crs` to sample coordinates (u, v) ``(N, 2)``."""

    def window_under(self, samples: Array) -> Window | None:
        """Return the samples that cubic interpolation at sample coordinates ``(N, 2)`` needs; None without heights."""
        samples = samples[np.isfinite(samples).all(axis=1)]
        if not len(samples):
            return None
        return self.window_around(*samples.min(axis=0).tolist(), *samples.max(axis=0).tolist())

    @abc.abstractmethod
    def window_around(self, left: float, top: float, right: float, bottom: float) -> Window | None:
        """Return the samples that cubic interpolation in a box of sample coordinates needs; None without heights."""

    @abc.abstractmethod
    def window(self, u0: int, v0: int, nu: int, nv: int) -> Array:
        """Return the heights ``(nv, nu)`` of samples, from column `u0` and row `v0`; it may reach outside.

        NaN for a void and outside of the DEM, unless `fill` gives them a height. Does not depend on how a
        larger window is cut into smaller ones.
        """

    @abc.abstractmethod
    def range_within(self, u0: int, v0: int, nu: int, nv: int) -> tuple[float, float]:
        """Return the lowest and the highest height (m) of a window of samples, with a fill height.

        Raises
        ------
        CoverageError
            If there is no valid height in it.
        """

    @abc.abstractmethod
    def excerpt(self, ground: Array, crs: str | pyproj.CRS) -> Excerpt | None:
        """Return the surface under points ``(N, 3)`` as a raster; None where that has no continuous coordinates.

        That is so at the antimeridian, with a DEM in longitude and latitude.
        """


def parse_fill(fill: str | float) -> str | float:
    """Return the rule for voids that a user gives: a known name, or a height as number.

    Raises
    ------
    InputError
        If there is no such rule.
    """
    if isinstance(fill, str) and fill in ("error", "mask", "nearest"):
        return fill
    height = number_of(fill)
    if math.isnan(height):
        raise InputError(
            f"{fill!r} is not a way to fill voids",
            field="surface.fill",
            remedy="give error, mask, nearest or an ellipsoidal height in metres",
        )
    return height


def positions(xy: ArrayLike) -> Array:
    """Return positions ``(N, 2)`` as an array, of what may have more columns.

    Raises
    ------
    InputError
        If they have another shape.
    """
    points = as_numbers(xy, "positions")
    if points.ndim != 2 or points.shape[1] < 2:
        raise InputError(f"expected positions of shape (N, 2), not {points.shape}")
    return points[:, :2]
