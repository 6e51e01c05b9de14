"""A CARTOSAT-1 stereo pair over Hobart of known truth: orbit, two line scanners, terrain, points, the vendor's RPCs.

One satellite on a circular orbit carries two cameras, 26 degrees forward and 5 degrees back, that see the scene 50
seconds apart; in between the Earth turns on, so each image is aimed by a roll and a yaw of its own, as the real ones
are. The vendor knows the attitude with an error, and fits his RPCs to what he believes.

The cameras are written from first principles and share no code with `ortho_pipeline.models`, so that a mistake in one
cannot hide in the other. The vendor's RPCs do: they are the project's class `RPC`, fitted by `fit_rpc` to what the
vendor believes, so the RPCs of this scene prove nothing about either.

Source: Willneff, Weser, Rottensteiner and Fraser, sections 2 and 4, tables 1 and 3. The free settings and the rows of
the tables that ask for them are explained in `ortho_studies.cartosat.experiment`.
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
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.rational import RPC
from ortho_pipeline.points import Points
from ortho_studies.simulation.earth import EARTH_GM, EARTH_RATE, geocentric, geodetic, spin
from ortho_studies.simulation.waves import LocalPlane, Waves

Array = NDArray[np.float64]

ALTITUDE, INCLINATION_DEG = 618e3, 97.87
FOCAL_LENGTH, PITCH, SIZE, GSD_ALONG = 1.945, 7e-6, 12000, 2.54
TILTS_DEG = {"fore": 26.0, "aft": -5.0}
#: Middle of the scene; Hobart lies in its upper left quarter.
LON, LAT = 147.425, -42.955
PLANE = LocalPlane(LON, LAT)
LOW, HIGH = 0.0, 1260.0
#: Heights for which the vendor fits his RPCs.
RPC_HEIGHTS = (-50.0, 1400.0)
MAP_CRS = "EPSG:32755"
POINTS = 69
#: Noise of a measurement (px): columns of both images, rows of each; and on the ground (m) to east, north, up.
SIGMA_COLUMN, SIGMA_ROW = 0.18, {"fore": 0.35, "aft": 0.17}
SIGMA_GROUND = (0.40, 0.85, 0.30)
#: Middle and half-lengths of the field with the points, as parts of the image: the upper left quarter of fore ("they
#: covered the top left quarter of the scene"), but for its left edge, which aft with its narrower swath does not see.
FIELD_MIDDLE, FIELD_HALF = (0.28, 0.25), (0.22, 0.24)
#: Flying height that the metadata of the paper's images gave; the satellite flies at `ALTITUDE`.
SAID_ALTITUDE = 638e3
#: How many cells the field has for each point, of which the lowest are taken: roundabouts lie where people live.
CELLS = 1.2


@dataclass(frozen=True)
class RpcBias:
    """Error of the vendor's RPC over the points, predicted minus true, in pixels; slopes are pixels per pixel."""

    col: float
    row: float
    row_per_col: float
    row_per_row: float = 0.0
    col_per_row: float = 0.0


#: Shifts of table 3, and slopes.
BIASES = {
    "fore": RpcBias(-0.9, -33.27, 2.7e-4, 2.4e-4),
    "aft": RpcBias(-15.92, -26.8, 1.3e-4),
}


# -- terrain and what lies on it -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class HobartTerrain:
    """Hobart, roughly: a flat city on an estuary under one high mountain, as a function of the place."""

    low: float = LOW
    high: float = HIGH
    roughness: float = 1.0
    seed: int = 5

    def __call__(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the ellipsoidal heights ``(N,)`` at geographic coordinates in degrees."""
        east, north = PLANE.metres(lon, lat)
        waves = self._waves(east, north)
        # Mount Wellington stands 15 km west and 7 km north of the middle.
        mountain = np.exp(-((east + 14.6e3) ** 2 + (north - 6.5e3) ** 2) / (2 * 3.2e3**2))
        # Squashed between the bounds without ever reaching them.
        return self.low + (self.high - self.low) / (1 + np.exp(3.4 - self.roughness * waves - 8.5 * mountain))

    @cached_property
    def _waves(self) -> Waves:
        return Waves.drawn(self.seed, 20e3, 1.5e3, 24)


# -- the cameras -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Attitude:
    """Roll, pitch and yaw (rad) of the platform from the orbital frame, and how they change within an image.

    Attributes
    ----------
    angles, rates : (3,)
        At the middle row, and per second.
    jitter : tuple of (amplitude, frequency, phase)
        Sines of the pitch: rad, Hz, rad.
    """

    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rates: tuple[float, float, float] = (0.0, 0.0, 0.0)
    jitter: tuple[tuple[float, float, float], ...] = ()

    def at(self, time: Array) -> Array:
        """Return roll, pitch and yaw ``(N, 3)`` at seconds from the middle row."""
        angles = np.array(self.angles) + time[:, None] * np.array(self.rates)
        for amplitude, frequency, phase in self.jitter:
            angles[:, 1] += amplitude * np.sin(2 * np.pi * frequency * time + phase)
        return angles

    def moved(self, angles: ArrayLike, rates: ArrayLike) -> Self:
        """Return the attitude with these ``(3,)`` errors added."""
        return replace(
            self, angles=_triple(self.angles + np.asarray(angles)), rates=_triple(self.rates + np.asarray(rates))
        )


@dataclass(frozen=True, eq=False)
class CartosatPass:
    """One camera on one pass: a line scanner on a circular orbit over a turning Earth.

    In the orbital frame x points forward, y to the right, z down to the Earth's centre; the camera is turned about y by
    its tilt. Columns run from right to left of the flight, so that a southward pass gives north-up images. Light time,
    aberration and refraction are left out.

    Attributes
    ----------
    radial, along : (3,)
        Unit vectors of the satellite's position and inertial velocity at time 0, when ECEF and inertial frame agree.
    radius : float
        Of the orbit, metres.
    middle, period : float
        Time of the middle of the image, and of a row, seconds.
    """

    size: int
    radial: Array
    along: Array
    radius: float
    tilt: float
    middle: float
    period: float
    pixel_tan: float
    attitude: Attitude = Attitude()

    def rays(self, image: ArrayLike) -> tuple[Array, Array]:
        """Return origins and unit directions in ECEF, both ``(N, 3)``, of the rays of image points ``(N, 2)``."""
        image = np.asarray(image, dtype=np.float64)
        since = (image[:, 1] - self.size / 2) * self.period
        across = (self.size / 2 - image[:, 0]) * self.pixel_tan
        look = np.stack([np.zeros_like(across), across, np.ones_like(across)], axis=1)
        look /= np.linalg.norm(look, axis=1)[:, None]
        frame = self._frame(self.middle + since)
        directions = np.einsum("nij,nkj,nk->ni", frame, self._camera_from_orbital(since), look)
        turned = -EARTH_RATE * (self.middle + since)
        return spin(-self.radius * frame[:, :, 2], turned), spin(directions, turned)

    def project(self, ground: ArrayLike) -> Array:
        """Return the image points ``(N, 2)`` of lon, lat (degrees), height ``(N, 3)``: when does the line pass them?

        The rate in the middle of the image stands for that everywhere, so each step gains two digits.
        """
        points = geocentric(np.asarray(ground, dtype=np.float64))
        since = np.zeros(len(points))
        for _ in range(14):
            look = self._look(points, since)
            step = -look[:, 0] / look[:, 2] / self._rate
            since = since + step
            if not (np.abs(step) > 1e-14).any():
                break
        look = self._look(points, since)
        columns = self.size / 2 - look[:, 1] / look[:, 2] / self.pixel_tan
        return np.stack([columns, self.size / 2 + since / self.period], axis=1)

    def meet(self, image: ArrayLike, hills: Callable[[Array, Array], Array], tolerance: float = 1e-6) -> Array:
        """Return where rays meet the hills: lon, lat, height ``(N, 3)``, to `tolerance` metres.

        Newton's method with the level ground in place of the slope: the hills are gentler than the rays.
        """
        origin, direction = self.rays(image)
        half = (origin * direction).sum(axis=1)
        start = float(np.linalg.norm(geocentric(np.array([[LON, LAT, 0.0]]))))
        distance = -half - np.sqrt(half**2 - (origin**2).sum(axis=1) + start**2)
        for _ in range(60):
            ground = geodetic(origin + distance[:, None] * direction)
            above = ground[:, 2] - hills(ground[:, 0], ground[:, 1])
            if not (np.abs(above) > tolerance).any():
                return ground
            lon, lat = np.radians(ground[:, :2].T)
            up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
            distance = distance - above / (up * direction).sum(axis=1)
        raise InputError("the hills are too steep for these rays")

    @cached_property
    def _rate(self) -> float:
        """How fast (1/s) a ground point moves through the line in the middle of the image."""
        points = geocentric(np.array([[LON, LAT, 0.0]]))
        ahead, behind = (self._look(points, np.array([time]))[0] for time in (0.5, -0.5))
        return float(ahead[0] / ahead[2] - behind[0] / behind[2])

    def _look(self, points: Array, since: Array) -> Array:
        """Return the vectors ``(N, 3)`` from camera to ECEF points in its own axes, at seconds from the middle row."""
        time = self.middle + since
        look = np.einsum("nij,ni->nj", self._frame(time), spin(points, EARTH_RATE * time))
        look[:, 2] += self.radius
        return np.einsum("nij,nj->ni", self._camera_from_orbital(since), look)

    def _frame(self, time: Array) -> Array:
        """Return the axes of the orbital frame in the inertial one as columns ``(N, 3, 3)``."""
        angle = np.sqrt(EARTH_GM / self.radius**3) * time
        cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
        out, forward = cos * self.radial + sin * self.along, cos * self.along - sin * self.radial
        right = np.broadcast_to(np.cross(self.along, self.radial), out.shape)
        return np.stack([forward, right, -out], axis=2)

    def _camera_from_orbital(self, since: Array) -> Array:
        """Return rotations ``(N, 3, 3)``: roll, then pitch (its tilt included), then yaw about the line of sight."""
        roll, pitch, yaw = (self.attitude.at(since) + np.array([0.0, self.tilt, 0.0])).T
        zero, one = np.zeros_like(roll), np.ones_like(roll)
        by_roll = [one, zero, zero, zero, np.cos(roll), -np.sin(roll), zero, np.sin(roll), np.cos(roll)]
        by_pitch = [np.cos(pitch), zero, -np.sin(pitch), zero, one, zero, np.sin(pitch), zero, np.cos(pitch)]
        by_yaw = [np.cos(yaw), -np.sin(yaw), zero, np.sin(yaw), np.cos(yaw), zero, zero, zero, one]
        r, p, y = (np.stack(rows, axis=1).reshape(-1, 3, 3) for rows in (by_roll, by_pitch, by_yaw))
        return y @ p @ r


@dataclass(frozen=True, eq=False)
class ScannerModel(SensorModel):
    """A scanner as a model of the host, so that an RPC can be fitted to it; never seen by an estimator."""

    kind: ClassVar[str] = "simulated-scanner"

    scanner: CartosatPass

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @cached_property
    def domain(self) -> tuple[Array, Array]:
        corners = np.array([(c, r) for c in (0.0, 1.0) for r in (0.0, 1.0)]) * self.scanner.size
        seen = np.concatenate([self.scanner.meet(corners, _level(height)) for height in RPC_HEIGHTS])
        low, high = seen.min(axis=0), seen.max(axis=0)
        return (low + high) / 2, (high - low) / 2

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self.scanner.project(ground)


@lru_cache(maxsize=16)
def aim(view: str, *, size: int = SIZE) -> CartosatPass:
    """Return the camera of a view ('fore' or 'aft'), aimed at the middle of the scene; its columns do not drift there.

    A smaller `size` has larger pixels, so that the image covers the same ground.
    """
    target = np.array([[LON, LAT, 100.0]])
    ground = geocentric(target)
    # The Earth turns the scene through the plane of the orbit: half-way between the two images it lies in it.
    crossing = spin(ground, np.array([EARTH_RATE * -18.0]))[0]
    up = crossing / np.linalg.norm(crossing)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    # cos(inclination) = cos(latitude) sin(azimuth) gives the azimuth of the track; it goes south.
    azimuth = np.pi - np.arcsin(np.cos(np.radians(INCLINATION_DEG)) / np.linalg.norm(up[:2]))
    along = np.cos(azimuth) * np.cross(up, east) + np.sin(azimuth) * east
    radius = float(np.linalg.norm(ground)) + ALTITUDE
    tilt = np.radians(TILTS_DEG[view])
    camera = CartosatPass(size, up, along, radius, tilt, 0.0, 1.0, PITCH / FOCAL_LENGTH * SIZE / size)
    for _ in range(12):
        look = camera._look(ground, np.zeros(1))[0]
        ahead, behind = (camera._look(ground, np.array([time]))[0] for time in (0.5, -0.5))
        speed = ahead[:2] / ahead[2] - behind[:2] / behind[2]
        roll, _, yaw = camera.attitude.angles
        roll += float(np.arctan(look[1] / look[2]))
        yaw -= float(np.arctan(speed[1] / speed[0]))
        middle = camera.middle - float(look[0] / look[2] / speed[0])
        camera = replace(camera, middle=middle, attitude=Attitude((roll, 0.0, yaw)))
    # How many metres pass the line in a second, from where it looks a second apart.
    seen = geocentric(camera.meet(np.array([(size / 2, size / 2 - 0.5), (size / 2, size / 2 + 0.5)]), _level(100.0)))
    return replace(camera, period=GSD_ALONG * SIZE / size / float(np.linalg.norm(seen[1] - seen[0])))


def _level(height: float) -> Callable[[Array, Array], Array]:
    return lambda lon, lat: np.full(len(lon), height)


@lru_cache(maxsize=16)
def biased(camera: CartosatPass, bias: RpcBias) -> CartosatPass:
    """Return the camera as the vendor believes it to be: attitude and its rates off, so that `bias` comes out.

    The five numbers of a bias are matched by five errors of the attitude over the field of the points, at low heights.
    Of pitch jitter nobody knows.
    """
    spots = np.array([(u, v) for u in (-1.0, 0.0, 1.0) for v in (-1.0, 0.0, 1.0)])
    image = (np.array(FIELD_MIDDLE) + spots * FIELD_HALF) * camera.size
    camera = replace(camera, attitude=replace(camera.attitude, jitter=()))
    ground = camera.meet(image, _level(60.0))
    scale = np.array([1e-5, 1e-5, 1e-5, 1e-6, 1e-6])
    centred = (image - image.mean(axis=0)) * SIZE / camera.size

    def off(errors: Array) -> Array:
        roll, pitch, yaw, roll_rate, pitch_rate = errors * scale
        believed = replace(camera, attitude=camera.attitude.moved((roll, pitch, yaw), (roll_rate, pitch_rate, 0.0)))
        miss = (believed.project(ground) - image) * SIZE / camera.size
        slopes = np.linalg.lstsq(np.column_stack([np.ones(len(image)), centred]), miss)[0]
        return np.array([slopes[0, 0], slopes[0, 1], *slopes[1:, 1] * 1e3, slopes[2, 0] * 1e3])

    wanted = np.array([bias.col, bias.row, bias.row_per_col * 1e3, bias.row_per_row * 1e3, bias.col_per_row * 1e3])
    errors = np.zeros(5)
    for _ in range(6):
        jacobian = np.stack([off(errors + step) - off(errors - step) for step in np.eye(5) / 2], axis=1)
        errors = errors + np.linalg.solve(jacobian, wanted - off(errors))
    roll, pitch, yaw, roll_rate, pitch_rate = errors * scale
    return replace(camera, attitude=camera.attitude.moved((roll, pitch, yaw), (roll_rate, pitch_rate, 0.0)))


# -- the pair --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StereoPair:
    """The two images, the hills, and the true points.

    Attributes
    ----------
    cameras : dict of str to Scanner
        'fore' and 'aft'.
    ground : (69, 3)
        True lon, lat (degrees), ellipsoidal height of the points.
    """

    cameras: dict[str, CartosatPass]
    ground: Array
    hills: HobartTerrain = field(default_factory=HobartTerrain)

    @classmethod
    def make(
        cls,
        *,
        size: int = SIZE,
        points: int = POINTS,
        seed: int = 1,
        jitter: float = 0.0,
        hills: HobartTerrain | None = None,
    ) -> Self:
        """Make a pair; the places of the points and the phases of the pitch jitter come from `seed`.

        Parameters
        ----------
        jitter : float
            Amplitude (px of the full image) of a swinging of the pitch with periods of about a tenth of the scene.

        Raises
        ------
        InputError
            If there are fewer than 4 points.
        """
        if points < 4:
            raise InputError("a stereo pair has at least 4 points", field="points")
        hills = hills or HobartTerrain()
        random = np.random.default_rng(seed)
        cameras = {}
        for view in TILTS_DEG:
            camera = aim(view, size=size)
            swings = tuple(
                (jitter * PITCH / FOCAL_LENGTH / np.sqrt(2.0), float(frequency), float(phase))
                for frequency, phase in zip((1.7, 2.9), random.uniform(0, 2 * np.pi, 2), strict=True)
            )
            # Without pitch jitter it is the same camera every time, and what the vendor believes has been found before.
            cameras[view] = replace(camera, attitude=replace(camera.attitude, jitter=swings)) if jitter else camera
        ground = cameras["fore"].meet(_spread(round(CELLS * points), random) * size, hills)
        lowest = np.sort(np.argsort(ground[:, 2])[:points])
        return cls(cameras, ground[lowest], hills)

    @property
    def size(self) -> int:
        """Columns and rows of the images."""
        return self.cameras["fore"].size

    def image(self, view: str) -> Array:
        """Return the true image points ``(N, 2)`` of a view."""
        return self.cameras[view].project(self.ground)

    def rpc(self, view: str, bias: RpcBias | None = None) -> RPC:
        """Return the vendor's RPC of a view, in this package's convention."""
        believed = ScannerModel(biased(self.cameras[view], BIASES[view] if bias is None else bias))
        centre, half = believed.domain
        west, south, east, north = *(centre - 1.02 * half)[:2], *(centre + 1.02 * half)[:2]
        return fit_rpc(believed, (west, south, east, north), RPC_HEIGHTS).rpc

    def corners(self, view: str) -> Array:
        """Return what the vendor says of the corners: lon, lat (degrees) of UL, UR, LR, LL at sea level, ``(4, 2)``."""
        ends = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) * self.size
        return np.round(biased(self.cameras[view], BIASES[view]).meet(ends, _level(0.0))[:, :2], 6)

    def measure(
        self,
        seed: int,
        *,
        sigma_column: float = SIGMA_COLUMN,
        sigma_row: dict[str, float] | None = None,
        sigma_ground: tuple[float, float, float] = SIGMA_GROUND,
    ) -> dict[str, Points]:
        """Return the points as somebody measured them: one table per view, the same ground in both.

        Returns
        -------
        dict of str to Points
            All are control points; their sigmas are those that went into them.
        """
        rows = SIGMA_ROW if sigma_row is None else sigma_row
        random = np.random.default_rng([seed, 2])
        count = len(self.ground)
        metres = random.normal(0, 1, (count, 3)) * sigma_ground
        ground = PLANE.moved(self.ground, metres)
        tables = {}
        for view in self.cameras:
            noise = random.normal(0, 1, (count, 2)) * (sigma_column, rows[view])
            tables[view] = Points(
                ids=tuple(f"P{k + 1:02d}" for k in range(count)),
                image=self.image(view) + noise,
                ground=ground,
                roles=np.full(count, "control", dtype="<U7"),
                sigma_image=np.full(count, max(sigma_column, rows[view], 1e-3)),
                sigma_ground=np.tile(sigma_ground, (count, 1)),
                crs=pyproj.CRS("EPSG:4326"),
                source=f"simulated CARTOSAT-1 pair ({view}), seed {seed}",
            )
        return tables


def _spread(count: int, random: np.random.Generator) -> Array:
    """Return places ``(count, 2)`` in the field, as parts of the image: one in the middle of each of equal cells."""
    rows = max(1, round(np.sqrt(count * FIELD_HALF[1] / FIELD_HALF[0])))
    cells = np.array(
        [
            ((c + u) / n, (r + v) / rows)
            for r, n in enumerate(len(part) for part in np.array_split(np.arange(count), rows))
            for c, (u, v) in enumerate(random.uniform(0.1, 0.9, (n, 2)))
        ]
    )
    return np.array(FIELD_MIDDLE) + (2 * cells - 1) * FIELD_HALF


def _triple(vector: ArrayLike) -> tuple[float, float, float]:
    x, y, z = np.asarray(vector, dtype=np.float64).tolist()
    return x, y, z
