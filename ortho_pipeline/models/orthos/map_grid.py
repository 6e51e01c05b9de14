r"""A finished ortho: its pixels are a map, so its model is its geotransform.

.. math::
    x &= g_0 + g_1 c + g_2 r \\
    y &= g_3 + g_4 c + g_5 r

Heights do not matter: an ortho has put all ground where it belongs. A map in degrees may count longitudes from 0 to
360 or across the antimeridian; longitudes are taken within half a turn of the middle of the image.

Source: GDAL's raster data model (affine geotransform).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import horizontal, parse_crs
from ortho_pipeline.models.base import (
    Array,
    SensorModel,
    as_ground,
    as_heights,
    as_image,
    box_around,
    ground_of_corners,
)

#: Heights (m, ellipsoidal) of all ground.
_HEIGHTS = -500.0, 9000.0


@dataclass(frozen=True, eq=False)
class MapGrid(SensorModel):
    """An image that is a map, of any horizontal CRS (metres, feet, degrees) and any affine grid.

    Parameters
    ----------
    map_crs : str
        Horizontal CRS of the image and of the ground points.
    geotransform : tuple of float
        GDAL's six numbers; the grid may be rotated, sheared or south-up.
    size : (int, int)
        Columns and rows.
    """

    kind: ClassVar[str] = "map_grid"

    map_crs: str
    geotransform: tuple[float, ...]
    size: tuple[int, int]

    def __post_init__(self) -> None:
        numbers = tuple(float(value) for value in self.geotransform)
        if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
            raise InputError("a geotransform has six finite numbers", field="geotransform")
        object.__setattr__(self, "geotransform", numbers)
        object.__setattr__(self, "size", tuple(int(value) for value in self.size))
        if len(self.size) != 2 or min(self.size) < 1:
            raise InputError("an image has a positive size", field="size")
        with np.errstate(all="ignore"):
            forward = self._matrix
            sound = abs(np.linalg.det(forward)) > 0 and bool(np.isfinite(np.linalg.inv(forward)).all())
            # Beyond that many pixels from the origin a number does not tell one pixel from the next.
            sound = sound and float(np.abs(np.linalg.solve(forward, self._origin)).max()) < 2**52
        if not sound:
            raise InputError("this geotransform cannot be inverted", field="geotransform")
        horizontal(self.map_crs)

    @property
    def _matrix(self) -> Array:
        _, a, b, _, c, d = self.geotransform
        return np.array([[a, b], [c, d]])

    @property
    def _origin(self) -> Array:
        return np.array([self.geotransform[0], self.geotransform[3]])

    @property
    def pixel(self) -> tuple[float, float]:
        """Sizes of a pixel along columns and rows, in units of the map."""
        _, a, b, _, c, d = self.geotransform
        return float(np.hypot(a, c)), float(np.hypot(b, d))

    @property
    def _middle_longitude(self) -> float | None:
        """The longitude of the middle of a map in degrees; None of any other map."""
        if not parse_crs(self.map_crs).is_geographic:
            return None
        return float((self._origin + self._matrix @ np.array(self.size) / 2)[0])

    @property
    def crs(self) -> str:
        return self.map_crs

    @property
    def domain(self) -> tuple[Array, Array]:
        return box_around(self.corners, _HEIGHTS)

    @property
    def corners(self) -> Array:
        return ground_of_corners(self, self.size, _HEIGHTS)

    @property
    def reference_height(self) -> float:
        return 0.0

    @property
    def uses_height(self) -> bool:
        return False

    def ground_to_image(self, ground: ArrayLike) -> Array:
        ground = as_ground(ground)
        plan = ground[:, :2] - self._origin
        middle = self._middle_longitude
        if middle is not None:
            plan[:, 0] += 360.0 * np.round((middle - ground[:, 0]) / 360.0)
        image = np.linalg.solve(self._matrix, plan.T).T
        image[~np.isfinite(ground).all(axis=1)] = np.nan
        return np.ascontiguousarray(image)

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        image = as_image(image)
        ground = np.empty((len(image), 3))
        ground[:, 2] = as_heights(height, len(image))
        ground[:, :2] = image @ self._matrix.T + self._origin
        ground[~(np.isfinite(image).all(axis=1) & np.isfinite(ground[:, 2]))] = np.nan
        return ground

    def ground_partials(self, ground: ArrayLike) -> Array:
        one = np.zeros((2, 3))
        one[:, :2] = np.linalg.inv(self._matrix)
        return np.tile(one, (len(as_ground(ground)), 1, 1))

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        pairs = ("geotransform", "size")
        return super().from_dict({**data, **{name: tuple(data[name]) for name in pairs if name in data}})
