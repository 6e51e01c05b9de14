"""An IKONOS Geo product over Tehran of known truth: orbit, scan, projection to a plane, terrain, points.

The satellite flies a circular orbit at 681 km and turns while it scans: its line of sight moves over the ground along
a straight line, forward (with the flight) or in reverse. What it sees is projected along the line of sight to the plane
at the Reference Height, in UTM: a pixel of the Geo product is a place of the map, and a point above the plane is
displaced. The vendor projects with an attitude that is a little wrong, so that everything is off by 10 to 25 m.

So the true image of a ground point needs no camera constants at all: at the instant at which the scan plane passes the
point, the line of sight goes from the satellite through the point; where it meets the plane is the pixel. This is
written from first principles and shares no code with the models that are fitted to it; only the vendor's RPC is made of
`VendorModel` by the package's own `fit_rpc`. Light time, aberration and
refraction are left out. How the direction of the lines of sight changes over the scene (1.6e-3 per km across the scan;
3.5e-3 along a scan in reverse, nothing along a forward one) is as in RPCs of real products.

Source: Amini and Hashemi, section 3; Grodecki and Dial 2001 (the satellite).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import ClassVar, Self

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.points import Points
from ortho_studies.simulation.earth import EARTH_A, EARTH_GM, EARTH_RATE, geocentric, geodetic
from ortho_studies.simulation.waves import LocalPlane, Waves

Array = NDArray[np.float64]

ALTITUDE, INCLINATION_DEG = 681e3, 98.1
LON, LAT = 51.42, 35.74
PLANE = LocalPlane(LON, LAT)
LOW, HIGH, REFERENCE_HEIGHT = 1050.0, 1800.0, 1300.0
MAP_CRS = "EPSG:32639"
#: Side of the scene (m): one swath of the camera at nadir.
EXTENT = 11_000.0
#: Lines each second, the size of a pixel at nadir (m), and the speed (m/s) of the line of sight over the ground.
LINE_RATE, NADIR_GSD, SCAN_SPEED = 6500.0, 0.82, 6500.0
OFF_NADIR_DEG = 20.0
#: Least and largest error (m) of the vendor's line of sight at the ground.
BIAS = (10.0, 25.0)
POINTS = 20
#: Share of each band's blocks that the panchromatic image does not have.
OWN = {"pan": 0.0, "blu": 0.1, "grn": 0.15, "red": 0.3, "nir": 0.7}
#: Accuracy of the map of 1:500, per axis, as the paper says.
SIGMA_GROUND = 0.5
#: Grey value of brightness 0, and how many more brightness 1 has; shortest wavelength in an image, in pixels.
DARK, BRIGHT, FINEST = 60.0, 1400.0, 4.5
#: Free settings of the experiment: see `ortho_studies.ikonos.experiment`.
POINTING, STEEPNESS, BEND, ROUGHNESS, REVERSE = 0.5, 2.7, 0.3, 0.26, True


# -- terrain and what lies on it -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Slope:
    """The city's slope from the plain in the south to the mountains in the north, and hills on it.

    Attributes
    ----------
    bend : float
        How much steeper the north is than the south; how steep all is, is `STEEPNESS`.
    roughness : float
        How much the hills rise.
    seed : int
        Gives other hills.
    """

    bend: float = BEND
    roughness: float = ROUGHNESS
    seed: int = 0

    def __call__(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the ellipsoidal heights ``(N,)`` at geographic coordinates in degrees."""
        east, north = PLANE.metres(lon, lat)
        hills = self._waves(east, north)
        rise = STEEPNESS * north / EXTENT - self.bend + self.roughness * hills
        # Squashed between the bounds without ever reaching them.
        return LOW + (HIGH - LOW) / (1 + np.exp(-rise))

    @cached_property
    def _waves(self) -> Waves:
        return Waves.drawn(self.seed, 25e3, 400.0, 24)


# -- the satellite ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class IkonosPass:
    """A satellite that flies and scans: where it is, and which plane it sees, at each time (s); ECEF metres.

    Attributes
    ----------
    radial, along : (3,)
        Unit vectors of the position and of the inertial velocity at time 0.
    aim : (3,)
        The point seen in the middle of the line at time 0.
    direction : (3,)
        Unit vector along which the aim moves over the ground.
    speed : float
        How fast, m/s.
    """

    radial: Array
    along: Array
    aim: Array
    direction: Array
    speed: float = SCAN_SPEED

    @classmethod
    def over_tehran(
        cls, *, off_nadir_deg: float = OFF_NADIR_DEG, azimuth_deg: float = 127.0, reverse: bool = REVERSE
    ) -> Self:
        """Aim at the middle of the scene on a descending pass.

        Parameters
        ----------
        off_nadir_deg : float
            Angle at the satellite between the line of sight and the Earth's centre.
        azimuth_deg : float
            Of the satellite, seen from the ground.
        reverse : bool
            Scan against the flight.

        Raises
        ------
        InputError
            If the line of sight would miss the ground by far or graze it.
        """
        if not 0 <= off_nadir_deg <= 45:
            raise InputError(
                f"an off-nadir angle of {off_nadir_deg:g} degrees is not possible",
                field="off_nadir_deg",
                remedy="use 0 to 45 degrees",
            )
        aim = geocentric(np.array([[LON, LAT, REFERENCE_HEIGHT]]))[0]
        up = aim / np.linalg.norm(aim)
        east = np.cross([0.0, 0.0, 1.0], up)
        east /= np.linalg.norm(east)
        north = np.cross(up, east)
        radius, angle = EARTH_A + ALTITUDE, np.radians(off_nadir_deg)
        earth_angle = np.arcsin(radius * np.sin(angle) / np.linalg.norm(aim)) - angle
        azimuth = np.radians(azimuth_deg)
        radial = np.cos(earth_angle) * up + np.sin(earth_angle) * (np.sin(azimuth) * east + np.cos(azimuth) * north)
        # cos(inclination) = cos(latitude) sin(heading); descending.
        heading = np.pi - np.arcsin(np.cos(np.radians(INCLINATION_DEG)) / np.linalg.norm(up[:2]))
        track = np.sin(heading) * east + np.cos(heading) * north
        along = track - (track @ radial) * radial
        return cls(radial, along / np.linalg.norm(along), aim, -track if reverse else track)

    @property
    def is_reverse(self) -> bool:
        """True if the scan runs against the flight."""
        return bool(self.direction @ self.along < 0)

    def satellite(self, time: Array) -> Array:
        """Return the positions ``(N, 3)`` at times ``(N,)``."""
        radius = EARTH_A + ALTITUDE
        angle = np.sqrt(EARTH_GM / radius**3) * time[:, None]
        inertial = radius * (np.cos(angle) * self.radial + np.sin(angle) * self.along)
        turn = EARTH_RATE * time
        cos, sin = np.cos(turn), np.sin(turn)
        x, y, z = inertial.T
        return np.stack([cos * x + sin * y, cos * y - sin * x, z], axis=1)

    def passes(self, points: Array, attitude: Array) -> tuple[Array, Array]:
        """Return when the scan plane passes ECEF points ``(N, 3)``, and where the satellite is then.

        Parameters
        ----------
        attitude : (3, 3)
            Rotation of all lines of sight: the identity for the truth.

        Returns
        -------
        (N,), (N, 3)
            Times, to 1e-12 s, and positions.
        """
        time = (points - self.aim) @ self.direction / self.speed
        for _ in range(12):
            origin = self.satellite(time)
            look = self.aim + self.speed * time[:, None] * self.direction - origin
            look /= np.linalg.norm(look, axis=1)[:, None]
            # The line of the sensor is at right angles to the line of sight and to the scan.
            normal = self.direction - (look @ self.direction)[:, None] * look
            sweep = self.speed * (normal @ self.direction)
            step = ((normal @ attitude.T) * (points - origin)).sum(axis=1) / sweep
            time = time + step
            if not (np.abs(step) > 1e-12).any():
                break
        return time, self.satellite(time)


# -- the product -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GeoScene:
    """A Geo product: what the satellite sees, on the grid of a map, by the vendor's knowledge of the attitude.

    Attributes
    ----------
    attitude_error : (3,)
        Small rotation (rad, ECEF) that takes true lines of sight to the vendor's.
    west, north : float
        Map coordinates of the outer corner of the first pixel.
    pixel, columns, rows : float, int, int
        Size of a pixel (m), and size of the image.
    """

    scan: IkonosPass
    terrain: Slope
    attitude_error: Array
    west: float
    north: float
    pixel: float
    columns: int
    rows: int
    image: Array = field(default_factory=lambda: np.zeros((0, 2)))
    ground: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def make(
        cls,
        seed: int = 0,
        *,
        off_nadir_deg: float = OFF_NADIR_DEG,
        azimuth_deg: float | None = None,
        reverse: bool = REVERSE,
        pixel: float = 1.0,
        columns: int | None = None,
        rows: int | None = None,
        bend: float = BEND,
        roughness: float = ROUGHNESS,
        points: int = POINTS,
    ) -> Self:
        """Make a scene in the middle of the city; the seed draws what the paper does not tell.

        These are the hills, the vendor's error, the azimuth if it is not given, and the places of the points: `points`
        for control, then as many for check, each of them spread over the image.
        """
        random = np.random.default_rng([seed, 6])
        azimuth = random.uniform(0.0, 360.0) if azimuth_deg is None else azimuth_deg
        scan = IkonosPass.over_tehran(off_nadir_deg=off_nadir_deg, azimuth_deg=azimuth, reverse=reverse)
        columns, rows = (round(EXTENT / pixel) if size is None else size for size in (columns, rows))
        x, y = to_map().transform(LON, LAT)
        west, north = round(x - columns * pixel / 2), round(y + rows * pixel / 2)
        scene = cls(
            scan,
            Slope(bend, roughness, seed),
            _attitude_error(scan, random),
            float(west),
            float(north),
            pixel,
            columns,
            rows,
        )
        image = np.concatenate([_spread(points, columns, rows, random) for _ in ("control", "check")])
        return replace(scene, image=image, ground=scene.meet(image))

    @cached_property
    def vendor_attitude(self) -> Array:
        """Rotation matrix ``(3, 3)`` from true lines of sight to the vendor's."""
        angle = float(np.linalg.norm(self.attitude_error))
        x, y, z = self.attitude_error / angle if angle else np.zeros(3)
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        rotation: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        return rotation

    def project(self, ground: ArrayLike) -> Array:
        """Return the pixels ``(N, 2)`` at which lon, lat (degrees), height ``(N, 3)`` are seen in the product."""
        points = geocentric(np.asarray(ground, dtype=np.float64))
        _, origin = self.scan.passes(points, np.eye(3))
        return self._on_plane(origin, (points - origin) @ self.vendor_attitude.T)

    def predict(self, ground: ArrayLike) -> Array:
        """Return the pixels ``(N, 2)`` at which the vendor believes ground points to be."""
        points = geocentric(np.asarray(ground, dtype=np.float64))
        _, origin = self.scan.passes(points, self.vendor_attitude)
        return self._on_plane(origin, points - origin)

    def _on_plane(self, origin: Array, rays: Array) -> Array:
        """Return the pixels at which rays from `origin` meet the Reference Height."""
        seen = _meet(origin, rays, _level(REFERENCE_HEIGHT), 1e-7)
        x, y = to_map().transform(seen[:, 0], seen[:, 1])
        return np.stack([(x - self.west) / self.pixel, (self.north - y) / self.pixel], axis=1)

    def on_map(self, image: ArrayLike) -> Array:
        """Return lon, lat, Reference Height ``(N, 3)`` of pixels: where the product's georeference puts them."""
        image = np.asarray(image, dtype=np.float64)
        lon, lat = to_map().transform(
            self.west + self.pixel * image[:, 0], self.north - self.pixel * image[:, 1], direction="INVERSE"
        )
        return np.stack([lon, lat, np.full(len(image), REFERENCE_HEIGHT)], axis=1)

    def meet(self, image: ArrayLike, tolerance: float = 1e-6) -> Array:
        """Return what is seen in pixels ``(N, 2)``: lon, lat, height ``(N, 3)``, on the terrain to `tolerance` (m)."""
        points = geocentric(self.on_map(image))
        _, origin = self.scan.passes(points, self.vendor_attitude)
        return _meet(origin, (points - origin) @ self.vendor_attitude, self.terrain, tolerance)

    @cached_property
    def view(self) -> tuple[float, float]:
        """Azimuth (degrees from true north) and elevation of the satellite, seen from the middle of the scene."""
        ground = self.on_map([[self.columns / 2, self.rows / 2]])
        point = geocentric(ground)
        _, origin = self.scan.passes(point, self.vendor_attitude)
        east, north, up = _enu_axes(*ground[0, :2])
        ray = (origin - point)[0]
        azimuth = np.degrees(np.arctan2(ray @ east, ray @ north)) % 360
        return float(azimuth), float(np.degrees(np.arctan2(ray @ up, np.hypot(ray @ east, ray @ north))))

    @property
    def sampling(self) -> tuple[float, float]:
        """Distance (m) of the sensor's samples on the ground, across and along the scan."""
        distance = float(np.linalg.norm(self.scan.aim - self.scan.satellite(np.zeros(1))[0]))
        return NADIR_GSD * distance / ALTITUDE, self.scan.speed / LINE_RATE

    @property
    def scan_azimuth_deg(self) -> float:
        """Direction of the scan over the ground, degrees from true north."""
        east, north, _ = _enu_axes(LON, LAT)
        return float(np.degrees(np.arctan2(self.scan.direction @ east, self.scan.direction @ north)) % 360)

    @property
    def point_ids(self) -> tuple[str, ...]:
        """Names of the points: G for control, C for check."""
        half = len(self.image) // 2
        return tuple(f"{'GC'[k >= half]}{k % half + 1:02d}" for k in range(len(self.image)))

    def measure(self, seed: int, *, pointing: float = POINTING, sigma_ground: float = SIGMA_GROUND) -> Points:
        """Return the points as somebody measured them, in map coordinates: noise of pointing and of the map (m).

        Pointing is that in the real image, whose pixels are a metre, even where ours are larger to save space.
        """
        sigma_image = pointing / self.pixel
        random = np.random.default_rng([seed, 7])
        count = len(self.image)
        x, y = to_map().transform(self.ground[:, 0], self.ground[:, 1])
        return Points(
            ids=self.point_ids,
            image=self.image + random.normal(0, sigma_image, (count, 2)),
            ground=np.stack([x, y, self.ground[:, 2]], axis=1) + random.normal(0, sigma_ground, (count, 3)),
            roles=np.repeat(["control", "check"], count // 2),
            sigma_image=np.full(count, max(sigma_image, 1e-3)),
            sigma_ground=np.full((count, 3), sigma_ground),
            crs=pyproj.CRS(MAP_CRS),
            source=f"simulated IKONOS scene, seed {seed}",
        )


@dataclass(frozen=True, eq=False)
class VendorModel(SensorModel):
    """A scene as its vendor knows it, for fitting the RPC that is delivered."""

    kind: ClassVar[str] = "ikonos-vendor"

    scene: GeoScene
    box: Array

    @classmethod
    def of(cls, scene: GeoScene, heights: tuple[float, float]) -> Self:
        """Make the model of a scene for a range of ellipsoidal heights."""
        u, v = np.meshgrid((0.0, 0.5, 1.0), (0.0, 0.5, 1.0))
        ring = np.stack([u.ravel() * scene.columns, v.ravel() * scene.rows], axis=1)
        points = geocentric(scene.on_map(ring))
        _, origin = scene.scan.passes(points, scene.vendor_attitude)
        seen = np.concatenate([_meet(origin, points - origin, _level(height), 1e-3) for height in heights])
        return cls(scene, np.stack([seen.min(axis=0), seen.max(axis=0)]))

    @property
    def crs(self) -> str:
        """CRS of the ground."""
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[Array, Array]:
        """Centre and half-size of the box of ground that the image covers."""
        return self.box.mean(axis=0), np.ptp(self.box, axis=0) / 2

    def ground_to_image(self, ground: ArrayLike) -> Array:
        """Return the pixels ``(N, 2)`` at which the vendor believes ground points to be."""
        return self.scene.predict(ground)


@lru_cache
def to_map() -> pyproj.Transformer:
    """Return the map projection of longitude and latitude in degrees."""
    return pyproj.Transformer.from_crs("EPSG:4326", MAP_CRS, always_xy=True)


def _enu_axes(lon: float, lat: float) -> tuple[Array, Array, Array]:
    """Return the unit vectors (3,) to the east, the north and upwards at a place in degrees."""
    lon, lat = np.radians(lon), np.radians(lat)
    east = np.array([-np.sin(lon), np.cos(lon), 0.0])
    north = np.array([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)])
    return east, north, np.cross(east, north)


def _attitude_error(scan: IkonosPass, random: np.random.Generator) -> Array:
    """Return a small rotation (rad) that moves the line of sight by a length within `BIAS` at the ground."""
    look = scan.aim - scan.satellite(np.zeros(1))[0]
    distance = float(np.linalg.norm(look))
    axis = np.cross(look, random.normal(size=3))
    return axis / np.linalg.norm(axis) * random.uniform(*BIAS) / distance


def _spread(count: int, columns: int, rows: int, random: np.random.Generator) -> Array:
    """Return one pixel ``(N, 2)`` in each of `count` cells of the image."""
    bands = max(1, round(np.sqrt(count * rows / columns)))
    cells = [
        ((c + u) / n * columns, (r + v) / bands * rows)
        for r, n in enumerate(len(part) for part in np.array_split(np.arange(count), bands))
        for c, (u, v) in enumerate(random.uniform(0.1, 0.9, (n, 2)))
    ]
    return np.array(cells)


def _level(height: float) -> Callable[[Array, Array], Array]:
    return lambda lon, lat: np.full(len(lon), height)


def _meet(
    origin: Array, rays: Array, surface: Callable[[Array, Array], Array], tolerance: float, steps: int = 40
) -> Array:
    """Return lon, lat, height ``(N, 3)`` where rays from ECEF `origin` meet a surface of ellipsoidal heights.

    Newton's method with level ground in place of the slope: it is gentler than the rays.
    """
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    half = (rays * origin).sum(axis=1)
    radius = float(np.linalg.norm(geocentric(np.array([[LON, LAT, REFERENCE_HEIGHT]]))))
    distance = -half - np.sqrt(half**2 - (origin**2).sum(axis=1) + radius**2)
    for _ in range(steps):
        ground = geodetic(origin + distance[:, None] * rays)
        above = ground[:, 2] - surface(ground[:, 0], ground[:, 1])
        if not (np.abs(above) > tolerance).any():
            return ground
        lon, lat = np.radians(ground[:, :2].T)
        up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
        distance = distance - above / (up * rays).sum(axis=1)
    raise InputError(
        "the slopes are too steep for this off-nadir angle", field="off_nadir_deg", remedy="use a smaller angle"
    )
