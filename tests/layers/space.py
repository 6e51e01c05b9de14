"""A satellite over hills on the ellipsoid, and what is seen of them: rays in space, by NumPy and pyproj alone.

Nothing here is a map, but for the places that a test asks about. Local axes are those of the ellipsoid's normal.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace

import numpy as np
import pyproj
from osgeo import gdal, osr

from ortho_pipeline.models.base import SensorModel, as_ground

#: Mean height of the hills.
FLOOR = 300.0


@functools.cache
def between(source: str, target: str) -> pyproj.Transformer:
    """Return the way between two systems, x first, heights above the ellipsoid."""
    ends = (pyproj.CRS.from_user_input(text) for text in (source, target))
    return pyproj.Transformer.from_crs(*(crs if crs.is_geocentric else crs.to_3d() for crs in ends), always_xy=True)


def to_space(lonlat: np.ndarray) -> np.ndarray:
    """Return geocentric metres ``(N, 3)`` of lon, lat (degrees), ellipsoidal height."""
    return np.column_stack(between("EPSG:4979", "EPSG:4978").transform(*np.asarray(lonlat, dtype=float).T))


def from_space(places: np.ndarray) -> np.ndarray:
    """Return lon, lat (degrees), ellipsoidal height ``(N, 3)`` of geocentric metres."""
    return np.column_stack(between("EPSG:4978", "EPSG:4979").transform(*places.T))


def axes(lonlat: np.ndarray) -> np.ndarray:
    """Return unit vectors east, north, up ``(N, 3, 3)``, as rows, at lon, lat (degrees)."""
    lon, lat = np.radians(lonlat[:, 0]), np.radians(lonlat[:, 1])
    up = np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.column_stack([-np.sin(lon), np.cos(lon), np.zeros(len(lon))])
    return np.stack([east, np.cross(up, east), up], axis=1)


def angles(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return zenith angle and azimuth from north (degrees) of vectors east, north, up ``(N, 3)``."""
    east, north, up = vectors.T
    return np.degrees(np.arctan2(np.hypot(east, north), up)), np.degrees(np.arctan2(east, north)) % 360


def towards(zenith_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the unit vector east, north, up ``(3,)`` in a direction."""
    zenith, azimuth = np.radians([zenith_deg, azimuth_deg])
    return np.array([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), np.cos(zenith)])


@dataclass(frozen=True, eq=False)
class Satellite(SensorModel):
    """A pinhole 500 km away that looks at a place (lon, lat) from a direction; ground is taken in any CRS."""

    kind = "satellite"

    place: tuple[float, float]
    zenith_deg: float = 26.0
    azimuth_deg: float = 98.0
    ground_crs: str = "EPSG:4979"
    pixel: float = 5.0
    side: int = 600
    shift: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        aim = np.array([[*self.place, FLOOR]])
        frame, target = axes(aim)[0], to_space(aim)[0]
        line = towards(self.zenith_deg, self.azimuth_deg) @ frame
        # The image is turned by some angle, so that no axis is one of the ground's.
        right = np.cross(towards(self.zenith_deg, self.azimuth_deg), [0.6, 0.8, 0.0]) @ frame
        right /= np.linalg.norm(right)
        set_ = object.__setattr__
        set_(self, "centre", target + 500e3 * line)
        set_(self, "rows", np.stack([right, np.cross(line, right), -line]))
        set_(self, "_back", between(self.ground_crs, "EPSG:4978"))
        set_(self, "_to", between("EPSG:4979", self.ground_crs))

    @property
    def crs(self) -> str:
        return self.ground_crs

    @property
    def domain(self):
        reach = 2 * self.side * self.pixel / 111.2e3
        lon, lat = self.place
        wide = reach / np.cos(np.radians(lat))
        corners = np.array([(lon + i * wide, lat + j * reach, FLOOR) for i in (-1, 1) for j in (-1, 1)])
        x, y, _ = self._to.transform(*corners.T)
        half = np.array([np.ptp(x) / 2, np.ptp(y) / 2, 600.0])
        return np.array([x.mean(), y.mean(), FLOOR]), half

    @property
    def param_names(self):
        return ("column", "row")

    @property
    def params(self):
        return self.shift

    def with_params(self, params):
        return replace(self, shift=np.asarray(params, dtype=float))

    def ground_to_image(self, ground):
        ground = as_ground(ground)
        look = (np.column_stack(self._back.transform(*ground.T)) - self.centre) @ self.rows.T
        with np.errstate(invalid="ignore"):
            image = look[:, :2] / look[:, 2:] * (500e3 / self.pixel) + self.side / 2 + self.shift
        image[~np.isfinite(image).all(axis=1)] = np.nan
        return image

    # -- truth -------------------------------------------------------------------------------------------------------

    def seen_at(self, image: np.ndarray, height: np.ndarray) -> np.ndarray:
        """Return geocentric places ``(N, 3)`` where the rays of image points meet ellipsoidal heights."""
        plane = (image - self.side / 2 - self.shift) * (self.pixel / 500e3)
        rays = np.column_stack([plane, np.ones(len(plane))]) @ self.rows
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        distance = np.full(len(rays), 499e3)
        for _ in range(8):
            at = from_space(self.centre + distance[:, None] * rays)
            distance -= (height - at[:, 2]) / -np.einsum("nj,nj->n", axes(at)[:, 2], rays)
        return self.centre + distance[:, None] * rays

    def ellipse(
        self, lonlat: np.ndarray, covariance: np.ndarray, sigma_h: float, slopes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return covariances ``(N, 2, 2)`` east, north (m) of what is shown at places, by moving rays and heights.

        Rays meet planes of slopes ``(N, 2)``, rise per metre east and north. Also return by how much a ray rises
        against the ground in front of it, per metre of its own: it is 0 where a ray grazes the ground.
        """
        image = self.ground_to_image(np.column_stack(self._to.transform(*lonlat.T)))
        frame, half = axes(lonlat), 0.5
        moved = [self.seen_at(image + half * sign * step, lonlat[:, 2]) for step in np.eye(2) for sign in (1, -1)]
        higher = [self.seen_at(image, lonlat[:, 2] + half * sign) for sign in (1, -1)]
        by = [np.einsum("nij,nj->ni", frame, a - b)[:, :2] for a, b in zip(moved[::2], moved[1::2], strict=True)]
        pixels, way = np.stack(by, axis=2), np.einsum("nij,nj->ni", frame, higher[0] - higher[1])[:, :2]
        rising = 1 - np.einsum("ni,ni->n", slopes, way)
        # From the height of the place, a ray goes up along its way until it meets the plane.
        up = np.einsum("ni,nij->nj", slopes, pixels) / rising[:, None]
        pixels, height = pixels + way[:, :, None] * up[:, None, :], way / rising[:, None]
        spread = sigma_h**2 * height[:, :, None] * height[:, None, :]
        return pixels @ covariance @ pixels.transpose(0, 2, 1) + spread, rising


def radius_of(covariance: np.ndarray, share: float = 0.9) -> np.ndarray:
    """Return the radius ``(N,)`` that holds a share of normal errors of covariances ``(N, 2, 2)``, by bisection."""
    angle = (np.arange(720) + 0.5) / 720 * np.pi
    large, small = np.linalg.eigvalsh(covariance)[:, ::-1].T
    reach = large[:, None] * np.cos(angle) ** 2 + small[:, None] * np.sin(angle) ** 2
    low, high = np.zeros(len(large)), 4 * np.sqrt(large)
    for _ in range(60):
        middle = (low + high) / 2
        inside = (1 - np.exp(-(middle[:, None] ** 2) / (2 * reach))).mean(axis=1) < share
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return (low + high) / 2


class Hills:
    """Terrain about a place as a grid in degrees, square on the ground, bilinear between samples."""

    def __init__(self, place: tuple[float, float], step: float = 12.0, reach: float = 5000.0) -> None:
        lon, lat = place
        count = int(2 * reach / step)
        self.dlat = step / 111.2e3
        self.dlon = self.dlat / np.cos(np.radians(lat))
        self.west, self.north = lon - count / 2 * self.dlon, lat + count / 2 * self.dlat
        x, y = np.meshgrid(*[(np.arange(count) - count / 2) * step / 1000] * 2)
        self.heights = (
            FLOOR + 110 * np.sin(6.1 * x + 1.3 * y) * np.cos(1.9 * x - 4.7 * y) + 60 * np.sin(9.3 * x - 8.1 * y)
            + 90 * np.sin(2.2 * y + 1.0) * np.cos(2.7 * x)
        )  # fmt: skip

    def write(self, path) -> None:
        """Write the samples as a GeoTIFF in EPSG:4326; they are the centres of its pixels."""
        rows, columns = self.heights.shape
        made = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1, gdal.GDT_Float64)
        plane = osr.SpatialReference()
        plane.ImportFromEPSG(4326)
        made.SetProjection(plane.ExportToWkt())
        made.SetGeoTransform((self.west - self.dlon / 2, self.dlon, 0.0, self.north + self.dlat / 2, 0.0, -self.dlat))
        made.WriteArray(self.heights)

    def at(self, lonlat: np.ndarray) -> np.ndarray:
        """Return heights ``(N,)`` at lon, lat (degrees)."""
        u, v = (lonlat[:, 0] - self.west) / self.dlon, (self.north - lonlat[:, 1]) / self.dlat
        i, j = np.floor(u).astype(int), np.floor(v).astype(int)
        fx, fy, h = u - i, v - j, self.heights
        upper = h[j, i] * (1 - fx) + h[j, i + 1] * fx
        return upper * (1 - fy) + (h[j + 1, i] * (1 - fx) + h[j + 1, i + 1] * fx) * fy

    def shaded(self, lonlat: np.ndarray, sun: np.ndarray, step: float = 1.0) -> np.ndarray:
        """Tell which places on the ground lie in shadow: the line to the sun (east, north, up) is walked in space."""
        start, way = to_space(lonlat), np.einsum("j,njk->nk", sun, axes(lonlat))
        dark, left = np.zeros(len(lonlat), dtype=bool), np.arange(len(lonlat))
        highest, distance = self.heights.max(), 0.0
        while len(left):
            distance += step
            at = from_space(start[left] + distance * way[left])
            under = self.at(at) > at[:, 2]
            dark[left[under]] = True
            left = left[~under & (at[:, 2] < highest)]
        return dark
