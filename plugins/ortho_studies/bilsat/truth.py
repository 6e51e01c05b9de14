"""A BILSAT-1 acquisition over Ankara of known truth: orbit, frames, terrain, points, and what a survey would say.

The satellite flies a circular orbit at 686 km and takes a frame of 2048 x 2048 pixels of 27.6 m (at nadir) at one
instant, tilted across the track. The relief is 700 to 1900 m over 55 km, as in the paper. The four XS cameras look from
the same place, each with its own small misalignment, focal length and lens.

The camera is written from first principles and shares no code with `ortho_pipeline.models`, so that a mistake in one
cannot hide in the other.

Source: Ok and Turker, sections 1 and 2, tables 1 and 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points
from ortho_studies.simulation.earth import EARTH_A, EARTH_GM, EARTH_RATE, geocentric, geodetic
from ortho_studies.simulation.waves import LocalPlane, Waves, texture

Array = NDArray[np.float64]

ALTITUDE, INCLINATION_DEG = 686e3, 98.0
FOCAL_LENGTH, SIZE, PIXEL = 0.180, 2048, 27.6
PITCH = PIXEL * FOCAL_LENGTH / ALTITUDE
LON, LAT = 32.85, 39.92
PLANE = LocalPlane(LON, LAT)
LOW, HIGH = 700.0, 1900.0
POINTS = 44
MAP_CRS = "EPSG:32636"
#: Free settings of the experiment: see `ortho_studies.bilsat.experiment`.
OFF_NADIR_DEG, SIGMA_IMAGE, SIGMA_GROUND = 7.3, 0.7, 0.7
#: How much the plains roll, and among how many places of a cell the lowest is measured: see there as well.
ROUGHNESS, PLACES = 0.65, 3
#: Error of the ephemeris, per axis (m).
SIGMA_POSITION = 300.0
#: The four XS cameras: misalignment to the right, downwards and about the axis (rad), relative focal length, k1.
XS_CAMERAS = {
    "red": (0.0, 0.0, 0.0, 1.0, 0.0),
    "green": (4.1e-4, -2.6e-4, 1.1e-3, 1.0007, 0.002),
    "blue": (-3.3e-4, 5.2e-4, -0.8e-3, 0.9992, -0.003),
    "nir": (6.0e-4, 3.7e-4, 1.9e-3, 1.0014, 0.004),
}
#: Share of each band's brightness (standard deviation) that the red band does not have.
OWN = {"red": 0.0, "green": 0.15, "blue": 0.25, "nir": 0.4}


# -- terrain and what lies on it -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class BilsatTerrain:
    """Hills from `low` to `high` metres: plains in the west, mountains in the east, as a function of the place."""

    low: float = LOW
    high: float = HIGH
    seed: int = 3

    def __call__(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the ellipsoidal heights ``(N,)`` at geographic coordinates in degrees."""
        east, north = PLANE.metres(lon, lat)
        waves = self._waves(east, north)
        mountains = np.exp(-((east - 18e3) ** 2 + (north + 12e3) ** 2) / (2 * 6e3**2))
        # Squashed between the bounds without ever reaching them.
        return self.low + (self.high - self.low) / (1 + np.exp(-(ROUGHNESS * waves - 1.4 + 3.0 * mountains)))

    @cached_property
    def _waves(self) -> Waves:
        return Waves.drawn(self.seed, 40e3, 1.5e3, 24)


def brightness(lon: ArrayLike, lat: ArrayLike, band: str = "red", *, finest: float = 120.0) -> Array:
    """Return the brightness ``(N,)`` in 0…1 of the ground in a band; bands are alike, but not the same.

    `finest` is the shortest wavelength (m) there is: some pixels, so that an image is not aliased.
    """
    east, north = PLANE.metres(lon, lat)
    value = _texture(east, north, 11, finest)
    if OWN[band]:
        own = _texture(east, north, 12 + list(OWN).index(band), finest)
        value = np.sqrt(1 - OWN[band] ** 2) * value + OWN[band] * own
    return np.clip(0.45 + 0.12 * value, 0.0, 1.0)


def _texture(east: Array, north: Array, seed: int, finest: float) -> Array:
    lengths = np.geomspace(finest, 50 * finest, 60)
    angles, phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, (2, len(lengths)))
    return texture(east, north, lengths, angles, phases) / np.sqrt(len(lengths) / 2)


# -- the camera ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A frame camera in its place: truth, in ECEF.

    Attributes
    ----------
    position, velocity : (3,)
        ECEF metres; metres per second relative to the turning Earth.
    axes : (3, 3)
        Unit vectors of the image's columns, rows (downwards) and of the line of sight, as rows.
    pixel_tan : float
        Tangent of the angle of one pixel.
    k1 : float
        Radial distortion of the tangents.
    """

    width: int
    height: int
    position: Array
    velocity: Array
    axes: Array
    pixel_tan: float
    k1: float = 0.0

    @classmethod
    def over_ankara(cls, off_nadir_deg: float, *, size: int) -> Self:
        """Aim the camera at the scene from a circular orbit, by a roll; a positive one looks to the right.

        A smaller `size` has larger pixels, so that the frame covers the same ground.
        """
        ground = geocentric(np.array([[LON, LAT, (LOW + HIGH) / 2]]))[0]
        up = ground / np.linalg.norm(ground)
        east = np.cross([0.0, 0.0, 1.0], up)
        east /= np.linalg.norm(east)
        # cos(inclination) = cos(latitude) sin(azimuth) gives the azimuth of the track, which descends.
        azimuth = np.pi - np.arcsin(np.cos(np.radians(INCLINATION_DEG)) / np.linalg.norm(up[:2]))
        along = np.cos(azimuth) * np.cross(up, east) + np.sin(azimuth) * east
        radius, roll = EARTH_A + ALTITUDE, np.radians(off_nadir_deg)
        earth_angle = np.arcsin(radius * np.sin(roll) / np.linalg.norm(ground)) - roll
        radial = np.cos(earth_angle) * up + np.sin(earth_angle) * np.cross(up, along)
        position = radius * radial
        look = (ground - position) / np.linalg.norm(ground - position)
        right = np.cross(-radial, along)
        right -= (right @ look) * look
        right /= np.linalg.norm(right)
        velocity = np.sqrt(EARTH_GM / radius) * along - EARTH_RATE * np.array([-position[1], position[0], 0.0])
        # With the top of the image forward, rows run backwards.
        axes = np.stack([right, np.cross(look, right), look])
        return cls(size, size, position, velocity, axes, PITCH / FOCAL_LENGTH * SIZE / size)

    def misaligned(self, right: float, down: float, turn: float, focal: float, k1: float) -> Self:
        """Return a neighbouring camera: its axis moved by two small angles and turned, with a lens of its own."""
        look = self.axes[2] + right * self.axes[0] + down * self.axes[1]
        look /= np.linalg.norm(look)
        column = np.cos(turn) * self.axes[0] + np.sin(turn) * self.axes[1]
        column -= (column @ look) * look
        column /= np.linalg.norm(column)
        axes = np.stack([column, np.cross(look, column), look])
        return replace(self, axes=axes, pixel_tan=self.pixel_tan / focal, k1=k1)

    def rays(self, image: ArrayLike) -> Array:
        """Return the unit vectors ``(N, 3)`` in ECEF of the rays of image points ``(N, 2)``."""
        seen = (np.asarray(image, dtype=np.float64) - (self.width / 2, self.height / 2)) * self.pixel_tan
        tangents = seen
        for _ in range(6 if self.k1 else 0):
            tangents = seen / (1 + self.k1 * (tangents**2).sum(axis=1))[:, None]
        rays = np.column_stack([tangents, np.ones(len(tangents))]) @ self.axes
        return rays / np.linalg.norm(rays, axis=1)[:, None]

    def project(self, ground: ArrayLike) -> Array:
        """Return the image points ``(N, 2)`` of lon, lat (degrees), height ``(N, 3)``."""
        there = (geocentric(np.asarray(ground, dtype=np.float64)) - self.position) @ self.axes.T
        tangents = there[:, :2] / there[:, 2:]
        moved = tangents * (1 + self.k1 * (tangents**2).sum(axis=1))[:, None]
        return moved / self.pixel_tan + (self.width / 2, self.height / 2)

    def meet(self, image: ArrayLike, hills: BilsatTerrain, tolerance: float = 1e-6) -> Array:
        """Return where the rays of image points meet the hills: lon, lat, height ``(N, 3)``, to `tolerance` metres.

        Newton's method with the level ground in place of the slope: the hills are gentler than the rays.
        """
        rays = self.rays(image)
        distance = _to_sphere(self.position, rays, float(np.linalg.norm(geocentric(np.array([[LON, LAT, LOW]])))))
        for _ in range(40):
            ground = geodetic(self.position + distance[:, None] * rays)
            above = ground[:, 2] - hills(ground[:, 0], ground[:, 1])
            if not (np.abs(above) > tolerance).any():
                return ground
            lon, lat = np.radians(ground[:, :2].T)
            up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
            distance = distance - above / (up * rays).sum(axis=1)
        raise InputError("the hills are too steep for this tilt", field="off_nadir_deg", remedy="tilt less")


def _to_sphere(origin: Array, rays: Array, radius: float) -> Array:
    half = rays @ origin
    return -half - np.sqrt(half**2 - origin @ origin + radius**2)


def render(
    camera: Snapshot, hills: BilsatTerrain, band: str = "red", *, noise_dn: float = 1.0, seed: int = 0
) -> NDArray[np.uint8]:
    """Make the 8-bit image that a camera takes in a band: every pixel's own ray is followed to the hills."""
    values = np.empty((camera.height, camera.width))
    finest = 4.5 * PIXEL * SIZE / camera.width
    columns = np.arange(camera.width) + 0.5
    block = max(1, 100_000 // camera.width)
    for first in range(0, camera.height, block):
        rows = np.arange(first, min(first + block, camera.height)) + 0.5
        image = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        ground = camera.meet(image, hills, tolerance=0.1)
        values[first : first + block] = brightness(ground[:, 0], ground[:, 1], band, finest=finest).reshape(
            len(rows), -1
        )
    noise = np.random.default_rng(seed).normal(0.0, noise_dn, values.shape)
    return np.clip(np.rint(20.0 + 215.0 * values + noise), 0, 255).astype(np.uint8)


# -- the scene -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SurveyTruth:
    """The imaging survey of a snapshot, errors included; ECEF metres and metres per second."""

    position: tuple[float, float, float]
    velocity: tuple[float, float, float]
    position_sigma: float


@dataclass(frozen=True, eq=False)
class BilsatScene:
    """One acquisition: the camera, the hills, and the true points.

    Attributes
    ----------
    image, ground : (44, 2), (44, 3)
        True image points, and lon, lat (degrees), ellipsoidal height.
    """

    camera: Snapshot
    hills: BilsatTerrain = field(default_factory=BilsatTerrain)
    image: Array = field(default_factory=lambda: np.zeros((0, 2)))
    ground: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @classmethod
    def make(
        cls, off_nadir_deg: float = OFF_NADIR_DEG, *, size: int = SIZE, points: int = POINTS, seed: int = 1
    ) -> Self:
        """Make the scene: the tilt is free, the points are spread over the frame by `seed`.

        People measure road crossings, which lie in plains and valleys: of some places in each cell, the lowest.
        """
        if points < 4:
            raise InputError("a scene needs at least 4 points", field="points")
        camera, hills = Snapshot.over_ankara(off_nadir_deg, size=size), BilsatTerrain()
        random = np.random.default_rng(seed)
        image = np.stack([_spread(points, size, random) for _ in range(PLACES)])
        ground = camera.meet(image.reshape(-1, 2), hills).reshape(PLACES, points, 3)
        lowest = ground[:, :, 2].argmin(axis=0), np.arange(points)
        return cls(camera, hills, image[lowest], ground[lowest])

    def measure(self, seed: int, *, sigma_image: float = SIGMA_IMAGE, sigma_ground: float = SIGMA_GROUND) -> Points:
        """Return the points as somebody measured them: noise in the image (px) and on the ground (m) from `seed`."""
        random = np.random.default_rng(seed)
        count = len(self.image)
        metres = random.normal(0, sigma_ground, (count, 3))
        ground = PLANE.moved(self.ground, metres)
        return Points(
            ids=tuple(f"P{k + 1:02d}" for k in range(count)),
            image=self.image + random.normal(0, sigma_image, (count, 2)),
            ground=ground,
            roles=np.full(count, "control", dtype="<U7"),
            sigma_image=np.full(count, max(sigma_image, 1e-3)),
            sigma_ground=np.full((count, 3), sigma_ground),
            crs=pyproj.CRS("EPSG:4326"),
            source=f"simulated BILSAT-1 scene, seed {seed}",
        )

    def survey(self, seed: int, *, sigma_position: float = SIGMA_POSITION, sigma_velocity: float = 0.3) -> SurveyTruth:
        """Return the ephemeris with the errors (m, m/s per axis) of a small satellite's orbit determination."""
        random = np.random.default_rng([seed, 1])
        position = self.camera.position + random.normal(0, sigma_position, 3)
        velocity = self.camera.velocity + random.normal(0, sigma_velocity, 3)
        return SurveyTruth(_triple(position), _triple(velocity), sigma_position)


def _spread(count: int, size: int, random: np.random.Generator) -> Array:
    rows = max(1, round(np.sqrt(count)))
    cells = [
        ((c + u) / n * size, (r + v) / rows * size)
        for r, n in enumerate(len(part) for part in np.array_split(np.arange(count), rows))
        for c, (u, v) in enumerate(random.uniform(0.15, 0.85, (n, 2)))
    ]
    return np.array(cells)


def _triple(vector: Array) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])
