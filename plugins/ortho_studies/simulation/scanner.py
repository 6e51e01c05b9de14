"""Simulated scenes with known truth, for tests, the sample data and experiments.

A `LineScanner` flies on a circular orbit and looks at a `Terrain` with the brightness of a `Landscape`. All three are
closed functions of their fields: they read no files, and a seed gives the same scene on every machine.
`render` makes the image, `simulate_points` the ground control.

The camera is written from first principles and shares no code with the models that are fitted to it. So a mistake in
one cannot hide in the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel, as_ground, as_image
from ortho_pipeline.points import Points
from ortho_studies.simulation.earth import EARTH_A, EARTH_GM, EARTH_RATE, Array, geocentric, geodetic, spin
from ortho_studies.simulation.terrain import Terrain

# -- the camera ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class LineScanner(SensorModel):
    """Push-broom camera on a circular orbit with constant attitude and uniform line period.

    In the orbital frame x points forward, y to the right, z down. A row is exposed at ``t = (row - height/2) *
    line_period`` seconds; columns run from right to left of the flight, so that a southward pass gives north-up images.
    Light time, aberration and refraction are ignored.

    Attributes
    ----------
    radial, along : tuple of 3 floats
        Unit vectors of the satellite's position and of its inertial velocity in ECEF at ``t = 0``.
    radius : float
        Orbital radius in metres.
    roll, pitch, yaw : float
        Attitude in radians; a positive roll looks to the right.
    pixel_tan : float
        Tangent of the angle of one pixel.
    heights : tuple of 2 floats
        Range of ellipsoidal heights of the camera, metres.
    """

    kind: ClassVar[str] = "line-scanner"

    width: int
    height: int
    radial: tuple[float, float, float]
    along: tuple[float, float, float]
    radius: float
    roll: float
    pitch: float
    yaw: float
    pixel_tan: float
    line_period: float
    earth_rate: float
    heights: tuple[float, float]

    @classmethod
    def over(
        cls,
        lon: float,
        lat: float,
        height: float,
        *,
        image_width: int = 1000,
        image_height: int = 1000,
        gsd: float = 2.5,
        off_nadir_deg: float = 18.0,
        heading_deg: float = 192.0,
        altitude: float = 650e3,
        earth_rate: float = EARTH_RATE,
        heights: tuple[float, float] | None = None,
    ) -> Self:
        """Aim a camera so that the middle of its image shows a ground point.

        Parameters
        ----------
        lon, lat, height : float
            Ground point in EPSG:4979.
        gsd : float
            Size of a pixel on the level ground there, in metres, along and across the track.
        off_nadir_deg : float
            Roll; positive looks to the right of the track.
        heading_deg : float
            Azimuth of the track in the inertial frame.
        heights : tuple of 2 floats, optional
            Range of heights; 500 m to both sides of `height` without it.
        """
        ground = geocentric(np.array([[lon, lat, height]]))[0]
        up = ground / np.linalg.norm(ground)
        east = np.cross([0.0, 0.0, 1.0], up)
        east /= np.linalg.norm(east)
        heading = np.radians(heading_deg)
        along = np.cos(heading) * np.cross(up, east) + np.sin(heading) * east
        radius = EARTH_A + altitude
        roll = np.radians(off_nadir_deg)
        incidence = np.arcsin(radius * np.sin(roll) / np.linalg.norm(ground))
        # The satellite, the ground point and the Earth's centre span a plane normal to the track.
        earth_angle = incidence - roll
        radial = np.cos(earth_angle) * up + np.sin(earth_angle) * np.cross(up, along)
        slant = np.linalg.norm(radius * radial - ground)
        camera = cls(
            width=image_width,
            height=image_height,
            radial=_triple(radial),
            along=_triple(along),
            radius=radius,
            roll=float(roll),
            pitch=0.0,
            yaw=0.0,
            pixel_tan=float(gsd * np.cos(incidence) / slant),
            line_period=1.0,
            earth_rate=earth_rate,
            heights=heights or (height - 500.0, height + 500.0),
        )
        _, rate = camera._in_camera(ground[None], np.zeros(1))
        return camera._replace(line_period=float(gsd / abs(rate[0, 0])))

    def __post_init__(self) -> None:
        # Lists come from JSON.
        for name in ("radial", "along", "heights"):
            object.__setattr__(self, name, tuple(float(value) for value in getattr(self, name)))
        if min(self.width, self.height, self.pixel_tan, self.line_period, self.radius) <= 0:
            raise InputError("a line scanner has a positive image size, pixel size, line period and radius")

    @property
    def crs(self) -> str:
        """CRS of the ground."""
        return "EPSG:4979"

    @cached_property
    def domain(self) -> tuple[Array, Array]:
        """Centre and half-size of the box (degrees, degrees, metres) of the image between `heights`."""
        corners = np.array([[c, r] for c in (0.0, self.width) for r in (0.0, self.height)])
        seen = np.concatenate([self.image_to_ground(corners, h) for h in self.heights])
        low, high = seen.min(axis=0), seen.max(axis=0)
        return (low + high) / 2, (high - low) / 2

    @property
    def param_names(self) -> tuple[str, ...]:
        """Attitude angles in radians."""
        return ("roll", "pitch", "yaw")

    @property
    def params(self) -> Array:
        """Attitude angles in radians."""
        return np.array([self.roll, self.pitch, self.yaw])

    def with_params(self, params: ArrayLike) -> Self:
        """Return the camera with another attitude."""
        roll, pitch, yaw = np.asarray(params, dtype=np.float64).tolist()
        return self._replace(roll=roll, pitch=pitch, yaw=yaw)

    def ground_to_image(self, ground: ArrayLike) -> Array:
        """Find the time at which the scan plane passes a ground point, by Newton's method, and its column then."""
        points = geocentric(as_ground(ground))
        time = np.zeros(len(points))
        for _ in range(8):
            look, rate = self._in_camera(points, time)
            step = look[:, 0] / rate[:, 0]
            time = time - step
            if not (np.abs(step) > 1e-14).any():
                break
        look, _ = self._in_camera(points, time)
        image = np.empty((len(points), 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            image[:, 0] = self.width / 2 - look[:, 1] / look[:, 2] / self.pixel_tan
        image[:, 1] = self.height / 2 + time / self.line_period
        # The far side of the Earth is in front of the camera too; a visible point has the camera over its horizon.
        down = (look @ self._mount)[:, 2]
        visible = self.radius * (self.radius - down) > (points**2).sum(axis=1)
        image[~visible | ~(look[:, 2] > 0) | ~np.isfinite(image).all(axis=1)] = np.nan
        return image

    def param_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(params) as ``(N, 2, 3)``, px per radian, by central differences over 1e-5 rad."""
        partials = np.empty((len(as_ground(ground)), 2, 3))
        for k, nudge in enumerate(1e-5 * np.eye(3)):
            ahead, behind = self.with_params(self.params + nudge), self.with_params(self.params - nudge)
            partials[:, :, k] = (ahead.ground_to_image(ground) - behind.ground_to_image(ground)) / 2e-5
        return partials

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Intersect the ray of a pixel with an ellipsoidal height; NaN if it misses the Earth."""
        origin, direction = self.rays(image)
        wanted = np.broadcast_to(np.asarray(height, dtype=np.float64), (len(origin),))
        distance = _meet_sphere(origin, direction, EARTH_A + wanted)
        ground = geodetic(origin + distance[:, None] * direction)
        for _ in range(6):
            miss = ground[:, 2] - wanted
            if not (np.abs(miss) > 1e-9).any():
                break
            distance = distance - miss / _climb(ground, direction)
            ground = geodetic(origin + distance[:, None] * direction)
        ground[:, 2] = np.where(np.isfinite(ground[:, 2]), wanted, np.nan)
        return ground

    def rays(self, image: ArrayLike) -> tuple[Array, Array]:
        """Return origin and unit direction of the rays of image points in ECEF, both ``(N, 3)``."""
        image = as_image(image)
        time = (image[:, 1] - self.height / 2) * self.line_period
        across = (self.width / 2 - image[:, 0]) * self.pixel_tan
        look = np.stack([np.zeros_like(across), across, np.ones_like(across)], axis=1)
        look /= np.linalg.norm(look, axis=1)[:, None]
        frame, _ = self._orbit(time)
        inertial = np.einsum("nij,nj->ni", frame, look @ self._mount)
        origin = -self.radius * frame[:, :, 2]
        return spin(origin, -self.earth_rate * time), spin(inertial, -self.earth_rate * time)

    @cached_property
    def _mount(self) -> Array:
        """Rotation from the orbital to the camera frame."""
        cr, sr, cp, sp = np.cos(self.roll), np.sin(self.roll), np.cos(self.pitch), np.sin(self.pitch)
        cy, sy = np.cos(self.yaw), np.sin(self.yaw)
        roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return yaw @ pitch @ roll

    def _orbit(self, time: Array) -> tuple[Array, Array]:
        """Return the axes of the orbital frame in the inertial one as columns ``(N, 3, 3)``, and their rates."""
        motion = np.sqrt(EARTH_GM / self.radius**3)
        radial, along = np.array(self.radial), np.array(self.along)
        cos, sin = np.cos(motion * time)[:, None], np.sin(motion * time)[:, None]
        out, forward = cos * radial + sin * along, cos * along - sin * radial
        right = np.broadcast_to(np.cross(along, radial), out.shape)
        frame = np.stack([forward, right, -out], axis=2)
        rate = motion * np.stack([-out, np.zeros_like(out), -forward], axis=2)
        return frame, rate

    def _in_camera(self, points: Array, time: Array) -> tuple[Array, Array]:
        """Return the vectors from camera to ECEF points in the camera frame at `time`, and their rates per second."""
        frame, frame_rate = self._orbit(time)
        inertial = spin(points, self.earth_rate * time)
        velocity = self.earth_rate * np.stack([-inertial[:, 1], inertial[:, 0], np.zeros_like(time)], axis=1)
        look = np.einsum("nij,ni->nj", frame, inertial)
        look[:, 2] += self.radius
        rate = np.einsum("nij,ni->nj", frame_rate, inertial) + np.einsum("nij,ni->nj", frame, velocity)
        return look @ self._mount.T, rate @ self._mount.T


def _triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _meet_sphere(origin: Array, direction: Array, radius: Array) -> Array:
    """Return the distance along rays to the first intersection with spheres about the Earth's centre; NaN if none."""
    half = (origin * direction).sum(axis=1)
    with np.errstate(invalid="ignore"):
        return -half - np.sqrt(half**2 - (origin**2).sum(axis=1) + radius**2)


def _climb(ground: Array, direction: Array) -> Array:
    """Return the rate of the ellipsoidal height along rays at lon, lat, h."""
    lon, lat = np.radians(ground[:, 0]), np.radians(ground[:, 1])
    return np.cos(lat) * (np.cos(lon) * direction[:, 0] + np.sin(lon) * direction[:, 1]) + np.sin(lat) * direction[:, 2]


# -- images and points -----------------------------------------------------------------------------------------------


def meet_terrain(camera: LineScanner, terrain: Terrain, image: ArrayLike) -> Array:
    """Intersect the rays of image points with the terrain, by the secant method along the ray.

    Slopes are assumed to be less steep than the rays, so nothing is hidden.

    Returns
    -------
    ndarray (N, 3)
        Ground points in EPSG:4979, on the terrain within 1e-6 m; NaN if the iteration does not converge.
    """
    origin, direction = camera.rays(image)
    ground = camera.image_to_ground(image, sum(camera.heights) / 2)
    distance = ((geocentric(ground) - origin) * direction).sum(axis=1)
    above = ground[:, 2] - terrain(ground[:, 0], ground[:, 1])
    rate = _climb(ground, direction)
    for _ in range(30):
        step = -above / rate
        distance = distance + step
        ground = geodetic(origin + distance[:, None] * direction)
        before, above = above, ground[:, 2] - terrain(ground[:, 0], ground[:, 1])
        if not (np.abs(above) > 1e-7).any():
            break
        level = _climb(ground, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            rate = (above - before) / step
            # Near the end, and across a slope break, the secant is noise; the ray over level ground always leads on.
            rate = np.where((rate < 0.4 * level) & (rate > 2.5 * level), rate, level)
    ground[~(np.abs(above) <= 1e-6)] = np.nan
    return ground


def render(
    camera: LineScanner,
    terrain: Terrain,
    pattern: Any,
    *,
    window: tuple[int, int, int, int] | None = None,
    noise_dn: float = 4.0,
    seed: int = 0,
) -> NDArray[np.uint16]:
    """Make the image of the camera: the ray of every pixel is intersected with the terrain.

    Parameters
    ----------
    pattern : callable
        Brightness ``(N,)`` in 0…1 of map coordinates ``(N, 2)``, such as a `Landscape`.
    window : tuple, optional
        First column, first row, width, height; default: the whole image.
    noise_dn : float
        Standard deviation of the sensor's noise.

    Returns
    -------
    ndarray (height, width) uint16
        11-bit values: ``60 + 1900 * brightness`` plus noise.
    """
    col0, row0, width, height = window or (0, 0, camera.width, camera.height)
    cols = col0 + 0.5 + np.arange(width)
    values = np.empty((height, width))
    block = max(1, 60000 // width)
    for first in range(0, height, block):
        rows = row0 + 0.5 + np.arange(first, min(first + block, height))
        image = np.stack(np.meshgrid(cols, rows), axis=-1).reshape(-1, 2)
        ground = meet_terrain(camera, terrain, image)
        values[first : first + block] = pattern(terrain.xy(ground[:, 0], ground[:, 1])).reshape(-1, width)
    noise = np.random.default_rng(seed).normal(0.0, 1.0, values.shape) * noise_dn
    return np.clip(np.rint(60.0 + 1900.0 * values + noise), 1, 2047).astype(np.uint16)


@dataclass(frozen=True, eq=False)
class SimulatedPoints:
    """Points as a surveyor would deliver them, and their truth: image ``(N, 2)`` and EPSG:4979 ground ``(N, 3)``."""

    measured: Points
    true_image: Array
    true_ground: Array


def simulate_points(
    camera: LineScanner,
    terrain: Terrain,
    *,
    control: int = 12,
    check: int = 6,
    sigma_image: float = 0.15,
    sigma_ground: float = 0.10,
    seed: int = 0,
) -> SimulatedPoints:
    """Measure points on the terrain, spread over the image, with seeded noise in the image and on the ground.

    The image is divided into one cell per point; each point is at a random position in the middle of its cell. Check
    points are spread among control points.

    Raises
    ------
    InputError
        If no points are asked for.
    """
    count = control + check
    if count < 1 or min(control, check) < 0:
        raise InputError("at least one point has to be simulated", field="control, check")
    rng = np.random.default_rng(seed)
    true_image = _spread(count, camera, rng)
    true_ground = meet_terrain(camera, terrain, true_image)
    image = true_image + rng.normal(0, sigma_image, true_image.shape)
    metres = rng.normal(0, sigma_ground, true_ground.shape)
    metre = 180 / np.pi / EARTH_A
    ground = true_ground + metres * np.array([metre, metre, 1.0])
    ground[:, 0] += metres[:, 0] * metre * (1 / np.cos(np.radians(true_ground[:, 1])) - 1)
    roles = np.full(count, "control", dtype="<U7")
    roles[np.floor((np.arange(check) + 0.5) * count / max(check, 1)).astype(int)] = "check"
    serial = {"control": 0, "check": 0}
    ids = []
    for role in roles.tolist():
        serial[role] += 1
        ids.append(f"{'G' if role == 'control' else 'C'}{serial[role]:02d}")
    measured = Points(
        ids=tuple(ids),
        image=image,
        ground=ground,
        roles=roles,
        sigma_image=np.full(count, sigma_image),
        sigma_ground=np.full((count, 3), sigma_ground),
        crs=pyproj.CRS("EPSG:4326"),
        source=f"simulated, seed {seed}",
    )
    return SimulatedPoints(measured, true_image, true_ground)


def _spread(count: int, camera: LineScanner, rng: np.random.Generator) -> Array:
    """Return one image point ``(N, 2)`` in the middle half of each of `count` equal cells of the image."""
    rows = max(1, round(np.sqrt(count * camera.height / camera.width)))
    in_row = [len(part) for part in np.array_split(np.arange(count), rows)]
    cells = [
        ((c + u) / n * camera.width, (r + v) / rows * camera.height)
        for r, n in enumerate(in_row)
        for c, (u, v) in enumerate(rng.uniform(0.2, 0.8, (n, 2)))
    ]
    return np.array(cells)
