"""A simulated part of the Earth: hills, and the landscape on them.

`Terrain` gives heights and `Landscape` brightness, both as closed functions of map coordinates and a seed. They can be
evaluated at any point and density, and give the same values on every machine. Edges in the landscape are as soft as one
pixel, so images are not aliased and orthos can be compared with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_studies.simulation.waves import Waves

Array = NDArray[np.float64]

# -- the terrain -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Terrain:
    """Smooth hills along a meandering valley with a lake, as a function of map coordinates.

    The hills are a sum of random waves whose amplitude falls with their wavelength; the lake is where the sum would
    fall below `lake_level` (a soft floor, so that the surface stays differentiable).

    Attributes
    ----------
    crs : str
        Projected CRS of the map coordinates, in metres.
    x0, y0 : float
        Map coordinates of the middle of the scene.
    lake_level, relief : float
        Ellipsoidal height of the lake and the rise of the hills over it, metres.
    """

    crs: str
    x0: float
    y0: float
    lake_level: float = 700.0
    relief: float = 420.0
    seed: int = 1

    _AXIS_DEG: ClassVar[float] = 28.0
    _SHORE: ClassVar[float] = 2.0

    def heights(self, xy: ArrayLike) -> Array:
        """Return the ellipsoidal heights ``(N,)`` at map coordinates ``(N, 2)``."""
        xy = np.asarray(xy, dtype=np.float64)
        depth = (self.bare_heights(xy) - self.lake_level) / self._SHORE
        return self.lake_level + self._SHORE * np.logaddexp(0.0, depth)

    def __call__(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the ellipsoidal heights ``(N,)`` at geographic coordinates in degrees."""
        return self.heights(self.xy(lon, lat))

    def xy(self, lon: ArrayLike, lat: ArrayLike) -> Array:
        """Return the map coordinates ``(N, 2)`` of geographic ones in degrees."""
        return np.stack(_map_of(self.crs).transform(np.asarray(lon, float), np.asarray(lat, float)), axis=1)

    def bare_heights(self, xy: Array) -> Array:
        """Return the heights ``(N,)`` without the lake."""
        along, across = self.valley(xy)
        rise = 1 - np.exp(-((across / 620.0) ** 2))
        hills = self._waves(xy[:, 0] - self.x0, xy[:, 1] - self.y0)
        basin = 48.0 * np.exp(-(((along + 820.0) / 420.0) ** 2) - ((across + 70.0) / 300.0) ** 2)
        floor = self.lake_level + 14.0 + 0.012 * along
        return floor - basin + self.relief * rise * (0.62 + 0.16 * hills) + 2.0 * hills

    def valley(self, xy: Array) -> tuple[Array, Array]:
        """Return the coordinates along the valley and across it from its floor line, metres ``(N,)`` each."""
        angle = np.radians(self._AXIS_DEG)
        east, north = xy[:, 0] - self.x0, xy[:, 1] - self.y0
        along = np.cos(angle) * east + np.sin(angle) * north
        across = np.cos(angle) * north - np.sin(angle) * east
        return along, across + 260.0 - 150.0 * np.sin(along / 390.0) - 45.0 * np.sin(along / 131.0 + 1.0)

    def gradient(self, xy: Array) -> Array:
        """Return d(height)/d(x, y) as ``(N, 2)``, by central differences over 2 m."""
        step_x, step_y = np.array([1.0, 0.0]), np.array([0.0, 1.0])
        return np.stack(
            [(self.heights(xy + step) - self.heights(xy - step)) / 2 for step in (step_x, step_y)],
            axis=1,
        )

    @cached_property
    def _waves(self) -> Waves:
        return Waves.drawn(self.seed, 2600.0, 150.0, 36, power=1.25)


_TRANSFORMERS: dict[str, pyproj.Transformer] = {}


def _map_of(crs: str) -> pyproj.Transformer:
    if crs not in _TRANSFORMERS:
        _TRANSFORMERS[crs] = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    return _TRANSFORMERS[crs]


# -- the landscape ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Landscape:
    """Brightness of fields, woods, a river and lake, roads and a town on a `Terrain`, shaded by the sun.

    Attributes
    ----------
    terrain : Terrain
    softness : float
        Width of every edge in metres; about the size of a pixel.
    sun_azimuth_deg, sun_elevation_deg : float
        Where the light comes from.
    seed : int
        Gives other fields, woods and houses.
    """

    terrain: Terrain
    softness: float = 2.5
    sun_azimuth_deg: float = 142.0
    sun_elevation_deg: float = 46.0
    seed: int = 7

    #: Middle of the town, metres along and across the valley, and its radius.
    TOWN: ClassVar[tuple[float, float, float]] = (470.0, 330.0, 330.0)

    def __call__(self, xy: ArrayLike) -> Array:
        """Return the brightness ``(N,)``, within 0…1, at map coordinates ``(N, 2)``."""
        xy = np.asarray(xy, dtype=np.float64)
        local = xy - (self.terrain.x0, self.terrain.y0)
        gradient = self.terrain.gradient(xy)
        along, across = self.terrain.valley(xy)
        water, shore = self._water(xy, along, across)

        value, lane = self._fields(local)
        value = _blend(value, 0.46 + 0.05 * _noise(local, 9.0, 31), lane * 0.8)
        value = _blend(value, self._scrub(local), _step(np.hypot(*gradient.T), 0.30, 0.42) * 0.85)
        value = _blend(value, self._woods(local), self._wooded(local, gradient))
        value = _blend(value, 0.44 + 0.10 * _noise(local, 14.0, 41), shore)
        town, town_value = self._town(local, along, across)
        value = _blend(value, town_value, town * (1 - shore))
        value *= self._shade(gradient)
        value = _blend(value, 0.075 + 0.02 * _noise(local, 160.0, 51), water)
        value = _blend(value, np.full(len(xy), 0.60), self._highway(along, across))
        return np.clip(value, 0.0, 1.0)

    def _edge(self, distance: Array) -> Array:
        """Return 1 well inside (negative distance in metres), 0 well outside, soft between."""
        return 1.0 - _step(distance, -self.softness / 2, self.softness / 2)

    def _shade(self, gradient: Array) -> Array:
        azimuth, elevation = np.radians([self.sun_azimuth_deg, self.sun_elevation_deg])
        towards = gradient[:, 0] * np.sin(azimuth) + gradient[:, 1] * np.cos(azimuth)
        cosine = (np.sin(elevation) - np.cos(elevation) * towards) / np.sqrt(1 + (gradient**2).sum(axis=1))
        return np.clip(0.30 + 0.70 * cosine / np.sin(elevation), 0.2, 1.6)

    def _water(self, xy: Array, along: Array, across: Array) -> tuple[Array, Array]:
        """Return how much of a point is water, and how much is its bank."""
        level = self.terrain.bare_heights(xy) - self.terrain.lake_level
        wobble = 5.0 * (_noise(xy - (self.terrain.x0, self.terrain.y0), 55.0, 61) - 0.5)
        river = np.abs(across + wobble) - 11.0 - 0.004 * np.clip(600.0 - along, 0, 2000)
        # Half a metre under the level of the lake is about where its soft floor turns to land.
        distance = np.minimum(river, (level - 0.5) * 6.0)
        return self._edge(distance), self._edge(distance - 7.0 - 2.0 * wobble)

    def _fields(self, local: Array) -> tuple[Array, Array]:
        """Return the tone of the parcels, and how much of a point is a country lane."""
        border, district = _cells(local, 430.0, 71 + self.seed)
        angle = np.pi * _hash(district, 0, 72)
        u = np.cos(angle) * local[:, 0] + np.sin(angle) * local[:, 1]
        v = np.cos(angle) * local[:, 1] - np.sin(angle) * local[:, 0]
        length, breadth = 130.0 + 90.0 * _hash(district, 1, 72), 38.0 + 42.0 * _hash(district, 2, 72)
        j = np.floor(v / length)
        offset = u / breadth + 7.3 * _hash(district, j, 73)
        i = np.floor(offset)
        edge_u = np.minimum(offset - i, 1 - offset + i) * breadth
        edge_v = np.minimum(v / length - j, 1 + j - v / length) * length
        crop, plough = _hash(district + 977 * i, j, 74), _hash(district + 977 * i, j, 75)
        tone = np.where(
            crop < 0.4, 0.20 + 0.22 * plough, np.where(crop < 0.75, 0.34 + 0.2 * plough, 0.50 + 0.16 * plough)
        )
        tone = tone + 0.030 * np.where(crop > 0.3, np.sin(2 * np.pi * u / (9.0 + 4.0 * plough)), 0.0)
        tone = tone * (0.86 + 0.28 * _fractal(local, 48.0, 76))
        # Where two parcels meet the hedge covers the jump between them, so that the tone is continuous.
        hedge = self._edge(np.minimum(edge_u, edge_v) - 0.8 - 1.2 * _hash(district, i + j, 77))
        tone = _blend(tone, 0.20 + 0.06 * _noise(local, 12.0, 78), hedge)
        verge = self._edge(border - 6.0)
        return _blend(tone, np.full(len(local), 0.25), verge), self._edge(border - 3.2)

    def _scrub(self, local: Array) -> Array:
        return 0.30 + 0.16 * (_fractal(local, 90.0, 81) - 0.5) + 0.10 * (_noise(local, 6.0, 82) - 0.5)

    def _woods(self, local: Array) -> Array:
        border, tree = _cells(local, 7.0, 91)
        crown = _step(border, -0.5, 2.6)
        stand = 0.75 + 0.5 * _fractal(local, 150.0, 93)
        return (0.13 + 0.07 * crown) * (0.72 + 0.56 * _hash(tree, 5, 92)) * stand

    def _wooded(self, local: Array, gradient: Array) -> Array:
        slope = np.hypot(*gradient.T)
        wood = _fractal(local, 420.0, 95 + self.seed) + 0.42 * _step(slope, 0.12, 0.5) - 0.79
        return _step(wood + 0.06 * (_noise(local, 11.0, 96) - 0.5), -0.008, 0.008)

    def _town(self, local: Array, along: Array, across: Array) -> tuple[Array, Array]:
        """Return how much of a point is town, and the brightness of the town there."""
        east, north, radius = self.TOWN
        u, v = along - east, across - north
        ragged = radius * (0.62 + 0.75 * _fractal(local, 260.0, 101))
        inside = np.hypot(u, 1.15 * v) - ragged
        angle = np.radians(9.0)
        u, v = np.cos(angle) * u - np.sin(angle) * v, np.sin(angle) * u + np.cos(angle) * v
        block_u, block_v = 92.0, 61.0
        bend = 10.0 * np.sin(v / 170.0)
        i, j = np.floor((u + bend) / block_u), np.floor(v / block_v)
        in_u, in_v = u + bend - i * block_u, v - j * block_v
        street = np.minimum(np.minimum(in_u, block_u - in_u), np.minimum(in_v, block_v - in_v))
        # Whole blocks are built or left open, except that the rim is cut by the ragged outline.
        garden = 0.21 + 0.14 * _fractal(local, 13.0, 102)
        park = _hash(i, j, 103) < 0.08
        house, roof = self._houses(in_u, in_v, i, j)
        shadow, _ = self._houses(in_u + 2.6, in_v + 3.4, i, j)
        value = _blend(garden, np.full(len(local), 0.10), shadow * 0.8)
        value = _blend(value, roof, house)
        value = np.where(park, self._woods(local) + 0.07, value)
        value = _blend(value, 0.47 + 0.06 * _noise(local, 8.0, 104), self._edge(street - 4.2))
        return self._edge(inside * 0.5), value

    def _houses(self, in_u: Array, in_v: Array, i: Array, j: Array) -> tuple[Array, Array]:
        """Return how much of a point of a block is roof, and the roof's brightness."""
        lot_u, lot_v = (92.0 - 12.0) / 4, (61.0 - 12.0) / 2
        p, q = np.floor((in_u - 6.0) / lot_u), np.floor((in_v - 6.0) / lot_v)
        key = 4096 * i + 64 * j + 8 * p + q
        half_u = lot_u / 2 - 2.6 - 3.2 * _hash(key, 0, 111)
        half_v = lot_v / 2 - 3.4 - 5.0 * _hash(key, 1, 111)
        off_u = np.abs(in_u - 6.0 - (p + 0.5) * lot_u) - half_u
        off_v = np.abs(in_v - 6.0 - (q + 0.5) * lot_v) - half_v
        there = (p >= 0) & (p < 4) & (q >= 0) & (q < 2) & (_hash(key, 2, 111) > 0.12)
        ridge = 0.07 * np.sign(in_v - 6.0 - (q + 0.5) * lot_v)
        return self._edge(np.maximum(off_u, off_v)) * there, 0.42 + 0.45 * _hash(key, 3, 111) ** 1.6 + ridge

    def _highway(self, along: Array, across: Array) -> Array:
        """Return how much of a point is one of the two main roads; the second crosses the river by a bridge."""
        beside = np.abs(across - 262.0 - 70.0 * np.sin(along / 420.0 + 2.2)) / np.hypot(1.0, 0.167)
        bend = 90.0 * np.sin(across / 480.0)
        over = np.abs(along - 250.0 - bend) / np.hypot(1.0, 0.19)
        return self._edge(np.minimum(beside, over) - 5.0)


# -- noise that is a function of the place ---------------------------------------------------------------------------


def _hash(i: ArrayLike, j: ArrayLike, salt: int) -> Array:
    """Return a fixed pseudo-random number in [0, 1) for each pair of whole numbers."""
    with np.errstate(over="ignore"):
        a = np.asarray(i).astype(np.int64).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        b = np.asarray(j).astype(np.int64).astype(np.uint64) * np.uint64(0xC2B2AE3D27D4EB4F)
        mixed = a ^ (b + np.uint64(salt * 0x165667B1))
        mixed = (mixed ^ (mixed >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        mixed = (mixed ^ (mixed >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        mixed ^= mixed >> np.uint64(31)
    return (mixed >> np.uint64(11)).astype(np.float64) / 2.0**53


def _step(value: Array, low: float, high: float) -> Array:
    """Rise smoothly from 0 at `low` to 1 at `high`."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def _blend(below: Array, above: Array, share: Array) -> Array:
    return below + (above - below) * share


def _noise(xy: Array, wavelength: float, salt: int) -> Array:
    """Return smooth noise in 0…1 with features of about `wavelength` metres."""
    scaled = xy / wavelength
    cell = np.floor(scaled)
    t = scaled - cell
    t = t**3 * (t * (6 * t - 15) + 10)
    i, j = cell.T
    south = _blend(_hash(i, j, salt), _hash(i + 1, j, salt), t[:, 0])
    north = _blend(_hash(i, j + 1, salt), _hash(i + 1, j + 1, salt), t[:, 0])
    return _blend(south, north, t[:, 1])


def _fractal(xy: Array, wavelength: float, salt: int) -> Array:
    """Return noise in 0…1 of four octaves from `wavelength` downwards."""
    total = np.zeros(len(xy))
    turn = np.array([[0.8, 0.6], [-0.6, 0.8]])
    for octave in range(4):
        total += 0.5 ** (octave + 1) * _noise(xy, wavelength / 2.0**octave, salt + 1000 * octave)
        xy = xy @ turn
    return total / (1 - 0.5**4)


def _cells(xy: Array, size: float, salt: int) -> tuple[Array, Array]:
    """Return the distance (m) to the border of a point's Voronoi cell, and the cell's number."""
    i, j = np.floor(xy / size).T
    best = np.full(len(xy), np.inf)
    second = np.full(len(xy), np.inf)
    best_site, second_site = np.zeros_like(xy), np.zeros_like(xy)
    number = np.zeros(len(xy))
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            offset = np.stack([_hash(i + di, j + dj, salt), _hash(i + di, j + dj, salt + 1)], axis=1)
            site = (np.stack([i + di, j + dj], axis=1) + 0.15 + 0.7 * offset) * size
            square = ((xy - site) ** 2).sum(axis=1)
            nearer = square < best
            runner = ~nearer & (square < second)
            second = np.where(nearer, best, np.where(runner, square, second))
            second_site = np.where(nearer[:, None], best_site, np.where(runner[:, None], site, second_site))
            best = np.where(nearer, square, best)
            best_site = np.where(nearer[:, None], site, best_site)
            number = np.where(nearer, 8191.0 * (i + di) + (j + dj), number)
    apart = np.linalg.norm(best_site - second_site, axis=1)
    return (second - best) / (2 * apart), number
