r"""Scenes that the vendor projected onto a plane of one height, in a map projection, such as IKONOS Geo.

A line of sight that meets the plane at height :math:`h_0` passes through all ground points :math:`(X, Y, h)` whose

.. math::
    X_0 &= X + r_x (h - h_0) + s_x \\
    Y_0 &= Y + r_y (h - h_0) + s_y

are the map coordinates of the pixel: relief displacement has one direction, and is proportional to the height. With
azimuth :math:`\alpha` (from true north) and elevation :math:`\epsilon` of the satellite,
:math:`(r_x, r_y) = -(\sin\alpha', \cos\alpha') / \tan\epsilon` in the map: away from the satellite, where
:math:`\alpha'` counts from the north of the grid. All four parameters are linear.

Source: Grodecki and Dial 2003 (the product); Fraser and Yamakawa 2004 (parallel projection of narrow scenes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import pyproj
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.models.base import (
    Array,
    SensorModel,
    as_ground,
    as_heights,
    as_image,
    as_params,
    box_around,
    ground_of_corners,
)

PARAMETERS = ("shift_x", "shift_y", "relief_x", "relief_y")
#: Length (m) over which a direction on the ellipsoid is converted to the map.
_STEP = 1000.0
_EARTH_RADIUS = 6371000.0
#: A lower line of sight above the horizon is a wrong angle.
LOWEST_ELEVATION = math.radians(5.0)


@dataclass(frozen=True, eq=False)
class MapPlane(SensorModel):
    """An image whose pixels are where lines of sight meet a plane of constant height, in a map projection.

    Parameters
    ----------
    map_crs : str
        Projected CRS in metres, of the image and of the ground points.
    corner : (float, float)
        Map coordinates of the outer corner of the first pixel.
    pixel : (float, float)
        Size of a pixel in metres, both positive; columns go east, rows south.
    size : (int, int)
        Columns and rows.
    plane : float
        Ellipsoidal height (m) of the plane.
    relief : (float, float)
        Displacement in x and y of the map for one metre of height above the plane.
    heights : (float, float)
        Lowest and highest ellipsoidal height (m) of the ground.
    shift : (float, float)
        Displacement (m) of all points in the map.

    Examples
    --------
    >>> model = MapPlane("EPSG:32633", (500_000.0, 4_640_000.0), (1.0, 1.0), (900, 800), 100.0, (0.2, 0.0), (0.0, 500))
    >>> model.ground_to_image([[500_010.0, 4_639_990.0, 150.0]]).round(3).tolist()
    [[20.0, 10.0]]
    """

    kind: ClassVar[str] = "geo"

    map_crs: str
    corner: tuple[float, float]
    pixel: tuple[float, float]
    size: tuple[int, int]
    plane: float
    relief: tuple[float, float]
    heights: tuple[float, float]
    shift: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("corner", "pixel", "relief", "heights", "shift"):
            pair = tuple(float(value) for value in getattr(self, name))
            if len(pair) != 2 or not all(map(math.isfinite, pair)):
                raise InputError("two finite numbers are needed", field=name)
            object.__setattr__(self, name, pair)
        object.__setattr__(self, "size", tuple(int(value) for value in self.size))
        object.__setattr__(self, "plane", float(self.plane))
        if not (self.pixel[0] > 0 and self.pixel[1] > 0 and len(self.size) == 2 and min(self.size) > 0):
            raise InputError("sizes of pixels and images must be positive", field="pixel, size")
        if not self.heights[0] < self.heights[1]:
            raise InputError("the lower height must come first", field="heights", remedy="give low,high in metres")
        if not self.heights[0] <= self.plane <= self.heights[1]:
            raise InputError(f"the plane at {self.plane} m is outside the heights", field="heights")
        _check_map(self.map_crs)

    @classmethod
    def from_view(
        cls,
        map_crs: str,
        corner: tuple[float, float],
        pixel: tuple[float, float],
        size: tuple[int, int],
        plane: float,
        azimuth: float,
        elevation: float,
        heights: tuple[float, float],
    ) -> Self:
        """Return the model of a scene from the direction to the satellite.

        Parameters
        ----------
        azimuth, elevation : float
            Direction (rad) of the satellite from the middle of the scene: clockwise from true north, and above the
            tangent plane of the ellipsoid.

        Raises
        ------
        InputError
            If the elevation is not 5 to 90 degrees.
        """
        if not (math.isfinite(azimuth) and LOWEST_ELEVATION < elevation <= math.pi / 2):
            raise InputError(
                f"an elevation of {math.degrees(elevation):.3g} degrees is not possible for such an image",
                field="elevation",
                remedy="give an angle from 5 to 90 degrees",
            )
        middle = np.array([[corner[0] + pixel[0] * size[0] / 2, corner[1] - pixel[1] * size[1] / 2, plane]])
        away = _along(map_crs, middle, azimuth) / -math.tan(elevation)
        return cls(map_crs, corner, pixel, size, plane, (float(away[0]), float(away[1])), heights)

    @property
    def view(self) -> tuple[float, float]:
        """Azimuth (from true north) and elevation of the satellite, radians, from the middle of the scene."""
        middle = np.array([[*self._map_of(np.array(self.size) / 2), self.plane]])
        basis = np.column_stack([_along(self.map_crs, middle, angle) for angle in (0.0, math.pi / 2)])
        north, east = -np.linalg.solve(basis, self.relief)
        return math.atan2(east, north) % (2 * math.pi), math.atan2(1.0, math.hypot(north, east))

    @property
    def crs(self) -> str:
        return self.map_crs

    @property
    def domain(self) -> tuple[Array, Array]:
        return box_around(self.corners, self.heights)

    @property
    def corners(self) -> Array:
        return ground_of_corners(self, self.size, self.heights)

    @property
    def height_range(self) -> tuple[float, float]:
        return self.heights

    def with_heights(self, low: float, high: float) -> Self:
        return self._replace(heights=(min(low, self.plane), max(high, self.plane)))

    @property
    def reference_height(self) -> float:
        return self.plane

    @property
    def param_names(self) -> tuple[str, ...]:
        return PARAMETERS

    @property
    def params(self) -> Array:
        return np.array([*self.shift, *self.relief])

    def with_params(self, params: ArrayLike) -> Self:
        values = as_params(params, self.param_names)
        return self._replace(shift=(values[0], values[1]), relief=(values[2], values[3]))

    def ground_to_image(self, ground: ArrayLike) -> Array:
        ground = as_ground(ground)
        at = ground[:, :2] + np.outer(ground[:, 2] - self.plane, self.relief) + self.shift
        # Where the relief is zero, a height of NaN would not make that axis NaN.
        at[~np.isfinite(ground).all(axis=1)] = np.nan
        return (at - self.corner) / self._steps

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        image = as_image(image)
        ground = np.empty((len(image), 3))
        ground[:, 2] = as_heights(height, len(image))
        ground[:, :2] = self._map_of(image) - np.outer(ground[:, 2] - self.plane, self.relief) - self.shift
        ground[~(np.isfinite(image).all(axis=1) & np.isfinite(ground[:, 2]))] = np.nan
        return ground

    def ground_partials(self, ground: ArrayLike) -> Array:
        across, down = self._steps
        slopes = np.array([[1.0 / across, 0.0, self.relief[0] / across], [0.0, 1.0 / down, self.relief[1] / down]])
        return np.tile(slopes, (len(as_ground(ground)), 1, 1))

    def param_partials(self, ground: ArrayLike) -> Array:
        above = as_ground(ground)[:, 2] - self.plane
        partials = np.zeros((len(above), 2, 4))
        for axis, step in enumerate(self._steps):
            partials[:, axis, axis] = 1.0 / step
            partials[:, axis, 2 + axis] = above / step
        return partials

    @property
    def _steps(self) -> Array:
        """Metres of the map from pixel to pixel; rows count to the south."""
        return np.array([self.pixel[0], -self.pixel[1]])

    def _map_of(self, image: Array) -> Array:
        return np.asarray(self.corner + image * self._steps, dtype=np.float64)

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        pairs = ("corner", "pixel", "size", "relief", "heights", "shift")
        return super().from_dict({**data, **{name: tuple(data[name]) for name in pairs if name in data}})


def _along(map_crs: str, place: Array, azimuth: float) -> Array:
    """Return the map's step ``(2,)`` for one metre at the height of a place, in a direction from true north."""
    to_geographic = ground_transform(map_crs, "EPSG:4979")
    lon, lat, height = to_geographic(place)[0]
    if not math.isfinite(lon):
        raise InputError("the scene is outside the area of its map projection", field="corner")
    lon2, lat2, _ = pyproj.Geod(ellps="WGS84").fwd(lon, lat, math.degrees(azimuth), _STEP)
    there = ground_transform("EPSG:4979", map_crs)(np.array([[lon2, lat2, height]]))[0]
    # A metre at this height is shorter on the ellipsoid, and maps show the ellipsoid.
    step = _STEP * (1.0 + height / _EARTH_RADIUS)
    return np.asarray((there - place[0])[:2] / step, dtype=np.float64)


def _check_map(text: str) -> None:
    crs = parse_crs(text)
    if not crs.is_projected or any(abs(axis.unit_conversion_factor - 1.0) > 1e-12 for axis in crs.axis_info[:2]):
        raise InputError(
            f"{crs.name!r} is not a map projection in metres", field="map_crs", remedy="use for example a UTM zone"
        )
