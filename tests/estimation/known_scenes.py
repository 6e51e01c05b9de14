"""Scenes of known truth on which a choice of models is judged: cameras, relief, layouts of control, and a dense truth.

The cameras are plain NumPy and share no code with the models that are fitted to them, nor with those of the plugins.
`DEVELOPMENT` are the sensors that the rule was designed with, `HELD_OUT` those that it was only judged by; their
layouts of control differ as well.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray
from ortho_studies.simulation.earth import geocentric
from ortho_studies.simulation.waves import Waves

from ortho_pipeline.models.base import SensorModel, as_ground
from ortho_pipeline.points import Points

Array = NDArray[np.float64]

_EARTH = 6371e3


# -- sensors ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sensor:
    """What the scenes of one sensor have in common; pairs are ranges from which each scene draws.

    Parameters
    ----------
    name : str
        For people.
    kind : {'scanner', 'frame', 'geo'}
        Geometry; of `geo`, the product of a scanner that was projected to a plane at one height.
    distance : (float, float)
        From the ground to the camera (m).
    gsd : float
        Size of a pixel (m).
    size : (int, int)
        Columns and rows.
    tilt : (float, float)
        Off nadir (degrees).
    relief : tuple of float
        From the lowest to the highest terrain (m): one of these.
    delivered : bool
        Whether there is a model of the vendor, right but for the pointing.
    shift, drift, wave : float
        Size (px) of the errors of that pointing: constant, over the length of the scene, periodic in the row. Without a
        delivered model the last two are errors of the attitude that no classical model follows.
    lens : float
        Radial distortion (px) at the edge of a frame.
    """

    name: str
    kind: str
    distance: tuple[float, float]
    gsd: float
    size: tuple[int, int]
    tilt: tuple[float, float]
    relief: tuple[float, ...]
    delivered: bool = False
    shift: float = 0.0
    drift: float = 0.0
    wave: float = 0.0
    lens: float = 0.0


DEVELOPMENT = (
    Sensor("scanner-rpc", "scanner", (650e3, 720e3), 2.5, (12000, 12000), (0, 25), (30, 400, 1500), True, 8, 1.5, 0.4),
    Sensor("scanner", "scanner", (600e3, 830e3), 5.0, (6000, 9000), (5, 25), (100, 800, 2000), drift=1, wave=0.2),
    Sensor("frame-space", "frame", (550e3, 700e3), 20.0, (2500, 2500), (0, 15), (50, 700, 2500), lens=2.0),
    Sensor("geo", "geo", (680e3, 720e3), 1.0, (10000, 10000), (8, 28), (20, 300, 1200), drift=0.5, wave=0.2),
)
HELD_OUT = (
    Sensor("agile-rpc", "scanner", (75e4, 11e5), 0.5, (26000, 20000), (12, 38), (10, 250, 900, 2800), True, 15, 2, 0.8),
    Sensor("wide-rpc", "scanner", (500e3, 560e3), 9.0, (9000, 11000), (0, 8), (10, 600, 3000), True, 4, 0.7, 0.3),
    Sensor("scanner-low", "scanner", (420e3, 520e3), 1.2, (7000, 16000), (3, 30), (10, 250, 2500), drift=1.0, wave=0.3),
    Sensor("geo-fine", "geo", (450e3, 500e3), 0.8, (13000, 9000), (4, 32), (5, 150, 1800), drift=0.7, wave=0.3),
    Sensor("aerial", "frame", (2500, 6000), 0.3, (9000, 7000), (0, 4), (10, 120, 700), lens=3.0),
    Sensor("oblique", "frame", (1200, 3000), 0.15, (6000, 4000), (20, 40), (5, 60, 250), lens=1.0),
    Sensor("frame-rpc", "frame", (400e3, 520e3), 1.5, (4000, 4000), (5, 35), (20, 500, 2500), True, 10, 0.6, lens=0.3),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Camera:
    """Truth: `ideal` is what the vendor knows (or would), `project` what is measured but for noise.

    Parameters
    ----------
    position : (3,)
        In metres east, north and up of the middle of the scene.
    axes : (3, 3)
        Unit vectors of the columns, of the rows and of the line of sight, as rows.
    advance, turn : (3,), float
        Metres and radians (pitch) that a scanner moves and turns in one row.
    warp : callable
        What the pointing adds (px) to ideal image points ``(N, 2)``.
    """

    sensor: Sensor
    lon: float
    lat: float
    position: Array
    axes: Array
    advance: Array
    turn: float
    warp: Callable[[Array], Array]

    def local(self, ground: Array) -> Array:
        """Return metres east, north, up of lon, lat (degrees), height ``(N, 3)``."""
        lon, lat = np.radians([self.lon, self.lat])
        east = [-math.sin(lon), math.cos(lon), 0.0]
        north = [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)]
        up = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
        middle = geocentric(np.array([[self.lon, self.lat, 0.0]]))
        return np.asarray((geocentric(ground) - middle) @ np.array([east, north, up]).T)

    def project(self, ground: ArrayLike) -> Array:
        ideal = self.ideal(as_ground(ground))
        return ideal + self.warp(ideal)

    def ideal(self, ground: Array) -> Array:
        return {"scanner": self._scanned, "frame": self._framed, "geo": self._projected}[self.sensor.kind](ground)

    @property
    def _tangent(self) -> float:
        return self.sensor.gsd / float(np.linalg.norm(self.position))

    @property
    def _middle(self) -> Array:
        return np.array(self.sensor.size) / 2

    def _framed(self, ground: Array) -> Array:
        seen = (self.local(ground) - self.position) @ self.axes.T
        return np.asarray(seen[:, :2] / seen[:, 2:] / self._tangent + self._middle)

    def _scanned(self, ground: Array) -> Array:
        """Find the row at which the plane of the line meets a point, by Newton's method."""
        place = self.local(ground)

        def seen(row: Array) -> Array:
            along = row[:, None] * self.advance
            along[:, 2] -= (along**2).sum(axis=1) / (2 * (_EARTH + self.position[2]))
            there = (place - self.position - along) @ self.axes.T
            pitch = self.turn * row
            cos, sin = np.cos(pitch), np.sin(pitch)
            forward, down = there[:, 1], there[:, 2]
            return np.stack([there[:, 0], cos * forward - sin * down, cos * down + sin * forward], axis=1)

        row = np.zeros(len(place))
        for _ in range(6):
            now = seen(row)[:, 1]
            row = row - now / (seen(row + 1)[:, 1] - now)
        there = seen(row)
        return np.stack([there[:, 0] / there[:, 2] / self._tangent, row], axis=1) + self._middle

    def _projected(self, ground: Array) -> Array:
        """Place points on the map, at the height 0 of the scene, where their rays meet it; the view turns slowly."""
        east, north = _map(self.lon, self.lat).transform(ground[:, 0], ground[:, 1])
        place = np.stack([np.asarray(east), -np.asarray(north)], axis=1) / self.sensor.gsd
        view = self.position[:2] / self.position[2] * (1.0, -1.0)
        turned = view + self.turn * place[:, 1:] * self.sensor.gsd / self.position[2]
        return np.asarray(place - turned * ground[:, 2:] / self.sensor.gsd + self._middle)


def _map(lon: float, lat: float) -> pyproj.Transformer:
    """Return the transformation to a map about a place: its UTM zone, moved there."""
    there = pyproj.Transformer.from_crs("EPSG:4979", _utm(lon, lat), always_xy=True)
    x, y = there.transform(lon, lat)
    moved = f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=utm +zone={_zone(lon)}"
    moved += f"{' +south' if lat < 0 else ''} +ellps=WGS84 +step +proj=affine +xoff={-x} +yoff={-y}"
    return pyproj.Transformer.from_pipeline(moved)


def _zone(lon: float) -> int:
    return int((lon + 180) // 6) + 1


def _utm(lon: float, lat: float) -> str:
    return f"EPSG:{(32700 if lat < 0 else 32600) + _zone(lon)}"


@dataclass(frozen=True, eq=False)
class Delivered(SensorModel):
    """The model that a vendor delivers: the ideal geometry, without what the pointing is off."""

    kind: ClassVar[str] = "rpc"
    camera: Camera
    box: tuple[Array, Array]

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[Array, Array]:
        return self.box

    def ground_to_image(self, ground: ArrayLike) -> Array:
        return self.camera.ideal(as_ground(ground))


# -- scenes ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class KnownScene:
    """One scene: measured control, and true places that nobody measured, spread evenly over the whole image.

    Attributes
    ----------
    control : (N, 3)
        Lon, lat, height of the control points.
    ground, image : (M, 3), (M, 2)
        The dense truth: lon, lat (degrees), height, and image without noise.
    """

    camera: Camera
    points: Points
    control: Array
    own: SensorModel | None
    ground: Array
    image: Array
    noise: float

    @property
    def size(self) -> tuple[int, int]:
        return self.camera.sensor.size

    @property
    def heights(self) -> tuple[float, float]:
        """What a DEM would say."""
        return float(self.ground[:, 2].min()), float(self.ground[:, 2].max())


def known_scene(sensor: Sensor, layout: str, count: int, seed: int) -> KnownScene:
    """Return a scene of a sensor with so many control points in one of the layouts of `LAYOUTS`.

    The stated sigma of the measurements is true in two scenes of three, and 0.5 px in the others.
    """
    random = np.random.default_rng([seed, count, sum(sensor.name.encode()), sum(layout.encode())])
    camera, terrain = _camera(sensor, random)
    side = np.linspace(0.01, 0.99, 25)
    image = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) * sensor.size
    ground = _met(camera, terrain, image)
    places = LAYOUTS[layout](random, count)
    if places is None:
        pool = _met(camera, terrain, random.uniform(0.03, 0.97, (60 * count, 2)) * sensor.size)
        height = np.quantile(pool[:, 2], random.uniform(0.15, 0.85))
        control = pool[np.argsort(np.abs(pool[:, 2] - height))[:count]]
    else:
        control = _met(camera, terrain, places * sensor.size)
    noise = float(np.exp(random.uniform(math.log(0.2), 0.0)))
    measured = camera.project(control) + random.normal(0.0, noise, (count, 2))
    stated = noise if random.uniform() < 2 / 3 else 0.5
    points = Points(
        ids=tuple(f"p{k}" for k in range(count)), image=measured, ground=control, roles=np.full(count, "control"),
        sigma_image=np.full(count, stated), sigma_ground=np.zeros((count, 3)), crs=pyproj.CRS("EPSG:4979"), source="",
    )  # fmt: skip
    low, high = ground.min(axis=0), ground.max(axis=0)
    own = Delivered(camera, ((low + high) / 2, (high - low) / 2)) if sensor.delivered else None
    moved = points.to_crs(_utm(camera.lon, camera.lat))
    return KnownScene(camera, moved, control, own, ground, camera.project(ground), noise)


def _camera(sensor: Sensor, random: np.random.Generator) -> tuple[Camera, Callable[[Array, Array], Array]]:
    lon, lat = random.uniform(-170, 170), random.uniform(-60, 65)
    distance, tilt = random.uniform(*sensor.distance), math.radians(random.uniform(*sensor.tilt))
    azimuth, heading = random.uniform(0, 2 * math.pi, 2)
    if sensor.kind == "scanner":
        # Tilted mostly across the track.
        azimuth = heading + random.choice([-1, 1]) * random.uniform(0.3, 0.5) * math.pi
    look = np.array([math.sin(tilt) * math.sin(azimuth), math.sin(tilt) * math.cos(azimuth), math.cos(tilt)])
    forward = np.array([math.sin(heading), math.cos(heading), 0.0])
    rows = forward - (forward @ look) * look
    rows /= np.linalg.norm(rows)
    axes = np.stack([np.cross(rows, -look), rows, -look])
    side = np.cross(forward, (0.0, 0.0, 1.0))
    advance = sensor.gsd * (forward + random.uniform(-0.07, 0.07) * side)
    turn = random.uniform(-0.4, 0.4) * sensor.gsd / distance
    if sensor.kind == "geo":
        turn = random.uniform(-0.5, 0.5)
    relief = float(random.choice(sensor.relief))
    across = sensor.gsd * max(sensor.size)
    waves = Waves.drawn(int(random.integers(1 << 30)), 1.2 * across, across / 25, 20)

    def terrain(east: Array, north: Array) -> Array:
        return np.asarray(relief * (1 / (1 + np.exp(-1.3 * waves(east, north))) - 0.5))

    return Camera(sensor, lon, lat, distance * look, axes, advance, turn, _warp(sensor, random)), terrain


def _warp(sensor: Sensor, random: np.random.Generator) -> Callable[[Array], Array]:
    size = np.array(sensor.size)
    shift = sensor.shift * random.normal(size=2)
    # Some sensors drift, some hold still.
    linear = sensor.drift * random.normal(size=(2, 2)) * (0.3, 1.0) * (random.uniform() < 0.6)
    amplitude = sensor.wave * random.uniform(0, 1, 2)
    cycles, phase = random.uniform(0.5, 3.0, 2), random.uniform(0, 2 * math.pi, 2)
    lens = sensor.lens * random.uniform(-1, 1)

    def warp(image: Array) -> Array:
        place = image / size - 0.5
        waves = amplitude * np.sin(2 * math.pi * cycles * place[:, 1:] + phase)
        radial = 2 * place * (place**2).sum(axis=1, keepdims=True)
        return np.asarray(shift + place @ linear.T + waves + lens * radial)

    return warp


def _met(camera: Camera, terrain: Callable[[Array, Array], Array], image: Array) -> Array:
    """Return lon, lat, height ``(N, 3)`` of the terrain that image points show, by Newton's method at its height."""
    metre = 180 / math.pi / _EARTH
    scale = np.array([metre / math.cos(math.radians(camera.lat)), metre])
    place = np.zeros((len(image), 2))

    def ground(metres: Array, height: Array) -> Array:
        return np.column_stack([metres * scale + (camera.lon, camera.lat), height])

    step = camera.sensor.gsd
    for turn in range(60):
        height = terrain(*place.T)
        miss = image - camera.project(ground(place, height))
        if turn and np.abs(miss).max() < 1e-3:
            break
        east = (camera.project(ground(place + np.array([step, 0.0]), height)) - image + miss) / step
        north = (camera.project(ground(place + np.array([0.0, step]), height)) - image + miss) / step
        place = place + 0.8 * np.linalg.solve(np.stack([east, north], axis=2), miss[:, :, None])[:, :, 0]
    # Not exactly at the image point asked for; but exactly on the terrain, and where its image is, `project` says.
    return ground(place, terrain(*place.T))


# -- layouts of control ----------------------------------------------------------------------------------------------


def even(random: np.random.Generator, count: int) -> Array:
    """Spread points as evenly as people do: the best of some draws by the least distance, rim included."""
    chosen = [random.uniform(0.04, 0.96, 2)]
    while len(chosen) < count:
        tried = random.uniform(0.04, 0.96, (12, 2))
        distance = np.linalg.norm(tried[:, None] - np.array(chosen), axis=2).min(axis=1)
        chosen.append(tried[int(np.argmax(distance))])
    return np.array(chosen)


def clusters(random: np.random.Generator, count: int) -> Array:
    """Put points about three or four places."""
    centres = random.uniform(0.1, 0.9, (int(random.integers(3, 5)), 2))
    return np.clip(centres[np.arange(count) % len(centres)] + random.normal(0, 0.06, (count, 2)), 0.02, 0.98)


def strip(random: np.random.Generator, count: int) -> Array:
    """Put points into a straight band through the image."""
    angle = random.uniform(0, math.pi)
    along = np.array([math.cos(angle), math.sin(angle)])
    places = 0.5 + random.uniform(-0.5, 0.5, (40 * count, 1)) * along
    places = places + random.normal(0, 0.05, places.shape) + random.uniform(-0.15, 0.15, 2)
    return places[((places > 0.02) & (places < 0.98)).all(axis=1)][:count]


def corner(random: np.random.Generator, count: int) -> Array:
    """Leave one quarter of the image empty."""
    places = even(random, 2 * count)
    full = ~((places > 0.45) == random.choice([True, False], 2)).all(axis=1)
    return places[full][:count]


def road(random: np.random.Generator, count: int) -> Array:
    """Put points along a bent road from one side to the other."""
    along = random.uniform(0.03, 0.97, count)
    bend = random.uniform(0.25, 0.75) + random.uniform(-0.25, 0.25) * np.sin(
        random.uniform(2, 7) * along + random.uniform(0, 6)
    )
    places = np.stack([along, np.clip(bend + random.normal(0, 0.02, count), 0.02, 0.98)], axis=1)
    return places if random.uniform() < 0.5 else places[:, ::-1]


def one_side(random: np.random.Generator, count: int) -> Array:
    """Put all points into one half of the image."""
    places = even(random, count) * (random.uniform(0.4, 0.55), 1.0)
    places = places if random.uniform() < 0.5 else 1 - places
    return places if random.uniform() < 0.5 else places[:, ::-1]


def towns(random: np.random.Generator, count: int) -> Array:
    """Put most points into two towns, and one in six somewhere else."""
    centres = random.uniform(0.15, 0.85, (2, 2))
    places = centres[random.integers(2, size=count)] + random.normal(0, 0.08, (count, 2))
    lonely = np.arange(count) % 6 == 5
    places[lonely] = random.uniform(0.03, 0.97, (int(lonely.sum()), 2))
    return np.clip(places, 0.02, 0.98)


#: Places of control points as shares of the image; None are those at about one height.
LAYOUTS: dict[str, Callable[[np.random.Generator, int], Array | None]] = {
    "even": even, "clusters": clusters, "strip": strip, "corner": corner,
    "road": road, "one side": one_side, "towns": towns, "one height": lambda random, count: None,
}  # fmt: skip
