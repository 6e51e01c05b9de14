"""Flat ground: one height everywhere."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.surface.base import Array, Excerpt, Surface, Window, parse_fill, positions


@dataclass(frozen=True)
class FlatSurface(Surface):
    """Ground of one ellipsoidal height, as `FlatSurface` makes it.

    Parameters
    ----------
    height : float
        Ellipsoidal metres.

    Raises
    ------
    InputError
        If that is not a number.
    """

    height: float
    fill: str | float = "error"
    sigma: float | Surface | None = None

    def __post_init__(self) -> None:
        if not math.isfinite(self.height):
            raise InputError(f"{self.height} is not a height", field="height", remedy="give ellipsoidal metres")
        object.__setattr__(self, "height", float(self.height))

    @property
    def block(self) -> int:
        """Nothing is read."""
        return 0

    @property
    def provenance(self) -> dict[str, Any]:
        """The height."""
        return {"constant_height": self.height}

    def describe(self) -> str:
        """Return where a point on the surface is, in words."""
        return f"at {self.height:.0f} m above the ellipsoid"

    def with_fill(self, fill: str | float) -> FlatSurface:
        """Return this surface; it has no voids."""
        return replace(self, fill=parse_fill(fill))

    def around(self, lon: float) -> FlatSurface:
        """Return this surface: it has no seam."""
        return self

    # -- heights -----------------------------------------------------------------------------------------------------

    def heights(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> Array:
        """Return the height ``(N,)`` at positions ``(N, 2)``; NaN where they are."""
        return np.where(np.isfinite(positions(xy)).all(axis=1), self.height, np.nan)

    def coverage(self, xy: ArrayLike, crs: str | pyproj.CRS | None = None) -> float:
        """Return the share of positions that have a height."""
        heights = self.heights(xy, crs)
        return float(np.isfinite(heights).mean()) if len(heights) else 1.0

    def above(self, ground: Array, crs: str | pyproj.CRS) -> Array:
        """Return NaN ``(N,)``: the height is an assumption, so points cannot be compared with it."""
        return np.full(len(ground), np.nan)

    def range_under(self, ground: Array, crs: str | pyproj.CRS, margin: float = 0.0) -> tuple[float, float]:
        """Return the height twice."""
        return self.height, self.height

    @property
    def height_range(self) -> tuple[float, float]:
        """The height twice."""
        return self.height, self.height

    # -- samples -----------------------------------------------------------------------------------------------------

    def sampler(self, crs: str | pyproj.CRS) -> Callable[[Array], Array]:
        """Return the function that puts all ground in the middle of the same four samples."""
        return lambda ground: np.full((len(ground), 2), 0.5)

    def window_around(self, left: float, top: float, right: float, bottom: float) -> Window | None:
        """Return four samples; all others are equal to them."""
        return 0, 0, 2, 2

    def window(self, u0: int, v0: int, nu: int, nv: int) -> Array:
        """Return the height ``(nv, nu)`` times."""
        return np.full((nv, nu), self.height)

    def range_within(self, u0: int, v0: int, nu: int, nv: int) -> tuple[float, float]:
        """Return the height twice."""
        return self.height, self.height

    def excerpt(self, ground: Array, crs: str | pyproj.CRS) -> Excerpt:
        """Return a single sample of the whole world."""
        return Excerpt(
            np.full((1, 1), self.height), (-180.0, 360.0, 0.0, 90.0, 0.0, -180.0), pyproj.CRS.from_epsg(4326)
        )
