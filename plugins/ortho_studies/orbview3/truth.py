"""OrbView-3 over Zonguldak, of known truth: two scenes of one area by continuous rotation, terrain, points, a vendor.

The camera reads at most 5000 lines a second, of 1 m each on the ground, but the satellite goes on at 7.1 km/s: while a
scene is taken the satellite turns all the time, so that its line of sight follows a parallel eastwards or westwards at
5 km/s, across the orbit. The vendor believes the attitude that was commanded; the true one differs from it by a bias, a
drift, and something that no affine correction removes.

The camera is written from first principles and shares no code with `ortho_pipeline.models`, so that a mistake in one
cannot hide in the other. Only the vendor's RPC is fitted to it by the package's own `fit_rpc`.

Source: Bueyueksalih, Akcin and Jacobsen, sections 2 and 3. What in the paper asks for the values of the free settings
is in `ortho_studies.orbview3.experiment`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.points import Points
from ortho_studies.simulation.earth import EARTH_A, EARTH_GM, EARTH_RATE, geocentric, geodetic, spin
from ortho_studies.simulation.waves import LocalPlane, Waves

Array = NDArray[np.float64]
Surface = Callable[[Array, Array], Array]

ALTITUDE, INCLINATION_DEG = 470e3, 97.25
COLUMNS, LINES, LINES_PER_SECOND, PIXEL = 8016, 20_000, 5000.0, 1.0
#: Middle of both scenes, and the height (m) at which the line of sight follows the parallel.
LON, LAT, LEVEL = 31.80, 41.44, 180.0
PLANE = LocalPlane(LON, LAT)
MAP_CRS = "EPSG:32636"
#: Seconds between the satellite abeam and the middle of the scene, and the scan: west (-1) or east.
SCENES = {"471890": (-19.1, -1), "443940": (25.0, 1)}
#: How far (m) to the right of the track the area lies.
SIDE = 60e3
#: Whether the scan keeps its speed over the ground (0) or its angular speed (1), for the range changes; and how fast
#: (rad/s) the line turns, to one side going west and to the other going east.
TURNING, YAW_RATE = 0.3, 3.5e-3
#: East-west and north-south extent (m) of the test field.
FIELD = (18e3, 7.6e3)
POINTS = 34
#: Standard deviations of the attitude error on the ground (m): bias, drift to an end of the scene, each higher degree.
SIGMA_BIAS, SIGMA_DRIFT, SIGMA_WOBBLE, DEGREES = 14.3, 1.7, 2.4, 5
#: Standard deviation of the line's yaw (m at its ends).
SIGMA_YAW = 1.2
#: Noise of a measured point: image (px) and ground (m).
SIGMA_IMAGE, SIGMA_GROUND = 1.15, 0.2
#: Heights (m) for which the vendor fits his RPCs.
RPC_HEIGHTS = (-100.0, 900.0)
#: QuickBird over the same area, and the height (m) of the plane of its OR Standard image.
QUICKBIRD = {"altitude": 450e3, "side": 60e3, "plane": 200.0, "pixel": 0.6}
#: Its noise of pointing (px), and its attitude error as a part of OrbView-3's.
QUICKBIRD_NOISE, QUICKBIRD_ATTITUDE = 0.6, 0.2
HIGH = 900.0
#: A distance (m) along the line of sight from 470 km at 20 degrees, by which metres become angles.
_RANGE = 505e3


# -- terrain and what lies on it -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Coast:
    """The Black Sea in the north-west and hills that rise from its coast inland, as a function of the place."""

    high: float = HIGH
    seed: int = 5

    def __call__(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the ellipsoidal heights ``(N,)`` at geographic coordinates in degrees."""
        east, north = PLANE.metres(lon, lat)
        waves = self._waves(east, north)
        inland = self.inland(east, north)
        rise = -np.expm1(-np.logaddexp(0.0, inland / 150.0) * 150.0 / 6000.0)
        # The geoid lies about 36 m above the ellipsoid here, and so does the sea.
        return 36.0 + (self.high - 36.0) * rise / (1 + np.exp(-0.45 * waves))

    @staticmethod
    def inland(east: Array, north: Array) -> Array:
        """Return the distance (m) from the coast, positive on land."""
        bearing = np.radians(72.0)
        across = np.sin(bearing) * north - np.cos(bearing) * east
        return 3300.0 - across + 500.0 * np.sin(east / 1900.0) + 180.0 * np.sin(east / 610.0 + 1.0)

    @cached_property
    def _waves(self) -> Waves:
        return Waves.drawn(self.seed, 9e3, 700.0, 20)


# -- the camera ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TurningScanner:
    """A line scanner that turns on a circular orbit over a turning Earth, so that its sight follows a straight path.

    The line of pixels lies in the plane of the line of sight and of `line`, apart from a yaw. Light time, aberration
    and refraction are left out.

    Attributes
    ----------
    radial, along : (3,)
        Unit vectors of the satellite's position and inertial velocity at time 0, when ECEF and inertial frame agree.
    radius : float
        Of the orbit, metres.
    middle : float
        Time of the middle of the image, seconds.
    heading : (2,)
        Unit vector, east and north, of the scan.
    speed, gain : float
        Of the point looked at over the ground (m/s), and its growth (m/s²).
    flight_line : bool
        The line of pixels lies along the flight (scan across it), or across the flight.
    yaw_rate : float
        Radians per second, zero in the middle.
    error : (3, K)
        Attitude error (rad) along the scan, along the line, and of the yaw: Legendre polynomials of the time, -1…1.
    """

    width: int
    height: int
    radial: Array
    along: Array
    radius: float
    middle: float
    heading: tuple[float, float]
    speed: float
    period: float
    pixel_tan: float
    gain: float = 0.0
    yaw_rate: float = 0.0
    flight_line: bool = True
    error: Array = field(default_factory=lambda: np.zeros((3, 1)))

    def rays(self, image: ArrayLike) -> tuple[Array, Array]:
        """Return origins and unit directions in ECEF, both ``(N, 3)``, of the rays of image points ``(N, 2)``."""
        image = np.asarray(image, dtype=np.float64)
        origin, _, line, sight = self._axes((image[:, 1] - self.height / 2) * self.period)
        direction = sight + ((image[:, 0] - self.width / 2) * self.pixel_tan)[:, None] * line
        return origin, _unit(direction)

    def project(self, ground: ArrayLike) -> Array:
        """Return the image points ``(N, 2)`` of lon, lat (degrees), height ``(N, 3)``: when does the line pass them?

        The rate in the middle of the image stands for that everywhere, so each step gains about two digits.
        """
        points = geocentric(np.asarray(ground, dtype=np.float64))
        since = np.zeros(len(points))
        for _ in range(15):
            look = self._look(points, since)
            step = look[:, 0] / look[:, 2] / self._rate
            since = since + step
            if not (np.abs(step) > 1e-13).any():
                break
        look = self._look(points, since)
        columns = self.width / 2 + look[:, 1] / look[:, 2] / self.pixel_tan
        return np.stack([columns, self.height / 2 + since / self.period], axis=1)

    def meet(self, image: ArrayLike, surface: Surface, tolerance: float = 1e-6) -> Array:
        """Return where rays meet a surface: lon, lat, height ``(N, 3)``, to `tolerance` metres.

        Newton's method with the level ground in place of the slope: the hills are gentler than the rays.
        """
        origin, direction = self.rays(image)
        half = (origin * direction).sum(axis=1)
        start = float(np.linalg.norm(geocentric(np.array([[LON, LAT, LEVEL]]))))
        distance = -half - np.sqrt(half**2 - (origin**2).sum(axis=1) + start**2)
        for _ in range(60):
            ground = geodetic(origin + distance[:, None] * direction)
            above = ground[:, 2] - surface(ground[:, 0], ground[:, 1])
            if not (np.abs(above) > tolerance).any():
                return ground
            distance = distance - above / (_up(ground) * direction).sum(axis=1)
        raise InputError("the hills are too steep for these rays")

    def outline(self, height: float) -> Array:
        """Return ground points ``(N, 3)`` at a height (m) along the rim of the image."""
        steps = [0.0, 0.25, 0.5, 0.75, 1.0]
        rim = np.array([(c, r) for c in steps for r in steps if c in (0.0, 1.0) or r in (0.0, 1.0)])
        return self.meet(rim * (self.width, self.height), level(height))

    @cached_property
    def _rate(self) -> float:
        """How fast (1/s) the line passes a ground point in the middle of the image."""
        points = geocentric(np.array([[LON, LAT, LEVEL]]))
        ahead, behind = (self._look(points, np.array([time]))[0] for time in (0.5, -0.5))
        return float(behind[0] / behind[2] - ahead[0] / ahead[2])

    def _look(self, points: Array, since: Array) -> Array:
        """Return the vectors ``(N, 3)`` from camera to ECEF points along scan, line and sight."""
        origin, *axes = self._axes(since)
        away = points - origin
        return np.stack([(away * axis).sum(axis=1) for axis in axes], axis=1)

    def _axes(self, since: Array) -> tuple[Array, Array, Array, Array]:
        """Return in ECEF the satellite, and unit vectors of scan, line and sight, each ``(N, 3)``."""
        origin, wanted = self.flight(since)
        sight = _unit(self.target(since) - origin)
        line = _across(self._sign * wanted, sight)
        scan = np.cross(sight, line)
        time = since / (self.height / 2 * self.period)
        ahead, aside, turn = (np.polynomial.legendre.legval(time, row)[:, None] for row in self.error)
        turn = turn + self.yaw_rate * since[:, None]
        line, scan = np.cos(turn) * line + np.sin(turn) * scan, np.cos(turn) * scan - np.sin(turn) * line
        sight = _unit(sight + ahead * scan + aside * line)
        line = _across(line, sight)
        return origin, np.cross(sight, line), line, sight

    @cached_property
    def _sign(self) -> float:
        """Which way the columns go: seen from above, rows down and columns to the right are not a mirror image."""
        now = np.zeros(1)
        origin, wanted = self.flight(now)
        scan = np.cross(_unit(self.target(now) - origin), wanted)
        return float(np.sign((scan * (self.target(now + 0.5) - self.target(now - 0.5))).sum()))

    def flight(self, since: Array) -> tuple[Array, Array]:
        """Return in ECEF the satellite and the direction that the line of pixels is meant to have ``(N, 3)``."""
        time = self.middle + since
        angle = (np.sqrt(EARTH_GM / self.radius**3) * time)[:, None]
        origin = self.radius * (np.cos(angle) * self.radial + np.sin(angle) * self.along)
        forward = np.cos(angle) * self.along - np.sin(angle) * self.radial
        wanted = forward if self.flight_line else np.broadcast_to(np.cross(self.along, self.radial), forward.shape)
        return spin(origin, -EARTH_RATE * time), spin(wanted, -EARTH_RATE * time)

    def target(self, since: Array) -> Array:
        """Return in ECEF the point that the camera is commanded to look at ``(N, 3)``."""
        gone = self.speed * since + self.gain / 2 * since**2
        here = geocentric(np.array([[LON, LAT, LEVEL]]))[0]
        lon = LON + np.degrees(gone * self.heading[0] / np.hypot(here[0], here[1]))
        lat = LAT + np.degrees(gone * self.heading[1] / np.linalg.norm(here))
        return geocentric(np.stack([lon, lat, np.full_like(lon, LEVEL)], axis=1))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1)[:, None])


def _across(vectors: Array, axis: Array) -> Array:
    """Return the unit vectors of what of `vectors` is normal to the unit vectors `axis`."""
    return _unit(vectors - (vectors * axis).sum(axis=1)[:, None] * axis)


def _up(ground: Array) -> Array:
    lon, lat = np.radians(ground[:, :2].T)
    return np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)


def level(height: float) -> Surface:
    """Return the surface of one ellipsoidal height (m)."""
    return lambda lon, lat: np.full(len(lon), height)


def orbit(altitude: float, side: float) -> tuple[Array, Array, float]:
    """Return radial and along-track unit vectors and the radius (m) of a southward pass with the scene abeam at 0 s.

    Parameters
    ----------
    side : float
        How far (m) to the right of the track the scene lies.
    """
    ground = geocentric(np.array([[LON, LAT, 0.0]]))[0]
    up = ground / np.linalg.norm(ground)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    # cos(inclination) = cos(latitude) sin(azimuth) gives the azimuth of the track.
    azimuth = np.pi - np.arcsin(np.cos(np.radians(INCLINATION_DEG)) / np.linalg.norm(up[:2]))
    along = np.cos(azimuth) * np.cross(up, east) + np.sin(azimuth) * east
    angle = side / np.linalg.norm(ground)
    radial = np.cos(angle) * up + np.sin(angle) * np.cross(up, along)
    return radial, along, float(np.linalg.norm(ground)) + altitude


def scanner(name: str, *, shrink: int = 1) -> TurningScanner:
    """Return the camera of one of `SCENES` without attitude error.

    Parameters
    ----------
    shrink : int
        So many times larger and fewer pixels, for small images of the same ground.
    """
    middle, east = SCENES[name]
    camera = TurningScanner(
        COLUMNS // shrink,
        LINES // shrink,
        *orbit(ALTITUDE, SIDE),
        middle,
        (float(east), 0.0),
        LINES_PER_SECOND * PIXEL,
        shrink / LINES_PER_SECOND,
        shrink * PIXEL / ALTITUDE,
        yaw_rate=east * YAW_RATE,
    )
    before, after = (np.linalg.norm(camera.target(time) - camera.flight(time)[0]) for time in np.array([[-0.5], [0.5]]))
    return replace(camera, gain=float(TURNING * camera.speed * np.log(after / before)))


def quickbird() -> TurningScanner:
    """Return QuickBird's camera over the same area, which scans against the flight with its 6900 lines a second."""
    return TurningScanner(
        27_000,
        27_000,
        *orbit(QUICKBIRD["altitude"], QUICKBIRD["side"]),
        0.0,
        (0.0, 1.0),
        6900.0 * 0.61,
        1 / 6900.0,
        0.61 / QUICKBIRD["altitude"],
        flight_line=False,
    )


@dataclass(frozen=True, eq=False)
class Rectified:
    """An image projected to a plane of constant height, without the relief: QuickBird's OR Standard.

    Its pixels are squares of `pixel` metres in `MAP_CRS` from the corner `west`, `north`.
    """

    camera: TurningScanner
    plane: float
    pixel: float
    west: float
    north: float

    @classmethod
    def of(cls, camera: TurningScanner, plane: float, pixel: float) -> Rectified:
        """Project the image of a camera to the plane of an ellipsoidal height (m)."""
        x, y = to_map().transform(*camera.outline(plane)[:, :2].T)
        return cls(camera, plane, pixel, float(x.min()), float(y.max()))

    def project(self, ground: ArrayLike) -> Array:
        """Return the image points ``(N, 2)`` of lon, lat (degrees), height ``(N, 3)``."""
        seen = self.camera.meet(self.camera.project(ground), level(self.plane))
        x, y = to_map().transform(seen[:, 0], seen[:, 1])
        return np.stack([(x - self.west) / self.pixel, (self.north - y) / self.pixel], axis=1)

    def outline(self, height: float) -> Array:
        """Return ground points ``(N, 3)`` at a height along the rim of what the camera saw."""
        return self.camera.outline(height)


@lru_cache(maxsize=1)
def to_map() -> pyproj.Transformer:
    """Return the transformation of longitude and latitude to `MAP_CRS`."""
    return pyproj.Transformer.from_crs("EPSG:4326", MAP_CRS, always_xy=True)


@dataclass(frozen=True, eq=False)
class VendorCamera(SensorModel):
    """A camera as its vendor believes it, as a model of the host, so that an RPC can be fitted to it."""

    kind: ClassVar[str] = "simulated-scanner"

    camera: TurningScanner | Rectified

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @cached_property
    def domain(self) -> tuple[Array, Array]:
        seen = np.concatenate([self.camera.outline(height) for height in RPC_HEIGHTS])
        low, high = seen.min(axis=0), seen.max(axis=0)
        return (low + high) / 2, (high - low) / 2

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self.camera.project(ground)


def vendor_rpc(camera: TurningScanner | Rectified) -> RPC:
    """Return the RPC that a vendor fits to the camera as he believes it to be."""
    believed = VendorCamera(camera)
    centre, half = believed.domain
    (west, south, _), (east, north, _) = (centre - half).tolist(), (centre + half).tolist()
    return fit_rpc(believed, (west, south, east, north), RPC_HEIGHTS).rpc


def with_attitude_error(camera: TurningScanner, seed: int, *, scale: float = 1.0) -> TurningScanner:
    """Return the camera as it really was: bias, drift and wobble of the attitude drawn from `seed`."""
    random = np.random.default_rng([seed, 1, *(int(part) + 1 for part in camera.heading)])
    sizes = np.array([SIGMA_BIAS, SIGMA_DRIFT, *[SIGMA_WOBBLE] * (DEGREES - 1)])
    error = np.zeros((3, DEGREES + 1))
    error[:2] = random.normal(0.0, sizes, (2, DEGREES + 1)) / _RANGE
    error[2, 0] = random.normal(0.0, SIGMA_YAW) / (COLUMNS * PIXEL / 2)
    return replace(camera, error=scale * error)


# -- points ----------------------------------------------------------------------------------------------------------

#: Middle (m east, north) and radius of the town, where every third point lies; and candidates for each other point.
TOWN, TOWN_RADIUS, TOWN_SHARE, CANDIDATES = (-500.0, 1200.0), 2000.0, 2, 4


def places(count: int, coast: Coast, seed: int, area: tuple[float, float] = FIELD) -> Array:
    """Return the true points ``(count, 3)``, lon, lat (degrees), height: on land, some close together in the town.

    Of some candidates for each other point the one that is farthest from all points is taken.
    """
    if count < 4:
        raise InputError("a scene needs at least 4 points", field="points")
    random = np.random.default_rng([seed, 2])
    positions = np.zeros((0, 2))
    while len(positions) < count:
        if len(positions) % TOWN_SHARE == 0:
            angle, radius = random.uniform(0, 2 * np.pi, 1), TOWN_RADIUS * np.sqrt(random.uniform(size=1))
            drawn = TOWN + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        else:
            drawn = random.uniform(-0.5, 0.5, (CANDIDATES, 2)) * area
        drawn = drawn[coast.inland(*drawn.T) > 100.0]
        if len(drawn):
            gaps = np.linalg.norm(drawn[:, None] - positions[None], axis=2).min(axis=1, initial=np.inf)
            positions = np.concatenate([positions, drawn[[gaps.argmax()]]])
    metre = 180 / np.pi / EARTH_A
    lon, lat = LON + positions[:, 0] * metre / np.cos(np.radians(LAT)), LAT + positions[:, 1] * metre
    return np.stack([lon, lat, coast(lon, lat)], axis=1)


def measure(
    camera: TurningScanner | Rectified,
    ground: Array,
    seed: int,
    *,
    image_number: int = 0,
    sigma_image: float = SIGMA_IMAGE,
    sigma_ground: float = SIGMA_GROUND,
) -> Points:
    """Return true points ``(N, 3)`` as somebody measured them in an image: noise (px, m) from `seed`.

    On the ground each point was measured once, whatever the `image_number`.
    """
    count = len(ground)
    metres = np.random.default_rng([seed, 3]).normal(0, sigma_ground, (count, 3))
    noise = np.random.default_rng([seed, 4, image_number]).normal(0, sigma_image, (count, 2))
    return Points(
        ids=tuple(f"P{k + 1:02d}" for k in range(count)),
        image=camera.project(ground) + noise,
        ground=PLANE.moved(ground, metres),
        roles=np.full(count, "control", dtype="<U7"),
        sigma_image=np.full(count, sigma_image),
        sigma_ground=np.full((count, 3), sigma_ground),
        crs=pyproj.CRS("EPSG:4326"),
        source=f"simulated test field of Zonguldak, seed {seed}",
    )


# -- images ----------------------------------------------------------------------------------------------------------
