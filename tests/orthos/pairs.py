"""Pairs of orthos of known truth: one ground, seen by two sensors, one of them displaced by a known field.

Nothing here knows of the matcher or of the warp: `tests/matching/landscape.py` is the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from landscape import SIZE, field_of, land, sample
from numpy.typing import NDArray
from osgeo import gdal, osr
from scipy.ndimage import gaussian_filter, map_coordinates

from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import east_north_from_map

Array = NDArray[np.float64]
UTM, CORNER = 32735, (512_000.0, 7_123_000.0)
KINDS = ("country", "woods", "town", "real")


@dataclass(frozen=True)
class Look:
    """What an ortho is like.

    Parameters
    ----------
    gsd : float
        Metres of a pixel.
    season : int
        See `Land.seen`.
    noise, haze, clouds : float
        Sigma of white noise (the ground's own deviation is about 0.2); greatest share of the signal that haze takes;
        share of the image under clouds.
    """

    gsd: float = 1.0
    season: int = 0
    band: str = "a"
    noise: float = 0.01
    haze: float = 0.0
    clouds: float = 0.0


@dataclass(frozen=True)
class Pair:
    """An ortho and its reference.

    Parameters
    ----------
    side : int
        Pixels of the coarser of both, along the ortho.
    shift : (float, float)
        Metres to the east and north by which the ortho shows things displaced.
    slopes : 2 x 2
        Change of the displacement per metre east and north.
    bend, length : float
        Sigma (m) of a smooth displacement, and its length in parts of the ortho.
    patch : (float, float)
        Metres to east and north by which a patch of 1/16 of the ortho is displaced besides.
    elsewhere : bool
        The reference shows another ground of the same kind; real images have only one.
    """

    ground: str = "country"
    seed: int = 0
    side: int = 500
    ortho: Look = Look()
    reference: Look = Look()
    shift: tuple[float, float] = (0.0, 0.0)
    slopes: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    bend: float = 0.0
    length: float = 0.5
    patch: tuple[float, float] = (0.0, 0.0)
    elsewhere: bool = False

    @property
    def extent(self) -> float:
        """Metres of the ortho along each side."""
        return self.side * max(self.ortho.gsd, self.reference.gsd)

    @property
    def pixels(self) -> int:
        """Pixels of the ortho along each side."""
        return round(self.extent / self.ortho.gsd)

    def displacement(self) -> Callable[[Array], Array]:
        """Return the function from places in the ortho ``(n, 2)`` px to metres to east and north ``(n, 2)``."""
        random = np.random.default_rng([self.seed, 5])
        size = 64
        fields = [field_of(random, 2 * size, self.length * size)[:size, :size] for _ in range(2)]

        def at(image: Array) -> Array:
            part = image / self.pixels
            east = (part[:, 0] - 0.5) * self.extent
            north = (0.5 - part[:, 1]) * self.extent
            found = np.column_stack([east, north]) @ np.array(self.slopes).T + self.shift
            where = [part[:, 1] * (size - 1), part[:, 0] * (size - 1)]
            smooth = [map_coordinates(one, where, order=3, mode="nearest") for one in fields]
            found = found + self.bend * np.column_stack(smooth)
            inside = ((part > 0.5) & (part < 0.75)).all(axis=1)
            return found + inside[:, None] * np.array(self.patch)

        return at

    def on_the_ground(self, image: Array) -> Array:
        """Return the displacement ``(n, 2)`` at places in the ortho, metres to true east and north.

        North of the map is not true north, and its metre not one of the ground: 40 px off by 0.04 px matter here.
        """
        middle = np.array([[CORNER[0] + self.extent / 2, CORNER[1] - self.extent / 2, 0.0]])
        turned = east_north_from_map(parse_crs(f"EPSG:{UTM}"), middle)[0]
        return self.displacement()(image) @ turned.T

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write ortho and reference."""
        folder.mkdir(parents=True, exist_ok=True)
        texel = min(self.ortho.gsd, self.reference.gsd) / 2
        # The ground repeats itself: all that both show has to fit into it.
        texel = max(texel, 1.1 * self.extent / SIZE)
        steps = np.arange(self.pixels) + 0.5
        columns, rows = np.meshgrid(steps, steps)
        image = np.column_stack([columns.ravel(), rows.ravel()])
        east, north = image[:, 0] * self.ortho.gsd, -image[:, 1] * self.ortho.gsd
        true = np.column_stack([east, north]) - self.displacement()(image)
        pixels = self._seen(self.ortho, true, texel, 0).reshape(self.pixels, self.pixels)
        margin = 0.04 * self.extent + np.abs(self.shift).max()
        gsd = self.reference.gsd
        count = int((self.extent + 2 * margin) / gsd)
        steps = np.arange(count) + 0.5
        columns, rows = np.meshgrid(steps * gsd - margin, margin - steps * gsd)
        places = np.column_stack([columns.ravel(), rows.ravel()])
        other = self._seen(self.reference, places, texel, 1).reshape(count, count)
        return (
            _write(folder / "ortho.tif", pixels, self.ortho.gsd, (0.0, 0.0)),
            _write(folder / "reference.tif", other, gsd, (-margin, margin)),
        )

    def _seen(self, look: Look, places: Array, texel: float, number: int) -> NDArray[np.float32]:
        random = np.random.default_rng([self.seed, 6 + number])
        box = max(1.0, look.gsd / texel)
        # The ground repeats itself and is hardly larger than a pair: another part of it would overlap.
        which = self.seed % 3 + (3 if self.elsewhere and number else 0)
        seen = land(self.ground, which).seen(look.band, look.season, box, 0.35 * box)
        start = np.random.default_rng([self.seed, 8]).uniform(0, SIZE, 2)
        u, v = places[:, 0] / texel + start[0], -places[:, 1] / texel + start[1]
        found = sample(seen, u, v).astype(np.float32)
        side = round(np.sqrt(len(found)))
        if look.haze or look.clouds:
            low = gaussian_filter(random.normal(size=(side, side)), side / 12, mode="wrap").ravel()
            rank = low.argsort().argsort() / len(low)
            share = look.haze * rank
            found = found * (1 - share) + 0.9 * share
            cloud = np.clip((rank - (1 - look.clouds)) * 20, 0, 1) if look.clouds else 0.0
            fine = gaussian_filter(random.normal(size=(side, side)), 3, mode="wrap").ravel() * 0.5
            found = found * (1 - cloud) + (1.0 + fine) * cloud
        return (found + random.normal(0, look.noise, len(found))).astype(np.float32)


def _write(path: Path, values: NDArray[np.float32], gsd: float, offset: tuple[float, float]) -> Path:
    rows, columns = values.shape
    options = ["TILED=YES", "BLOCKXSIZE=256", "BLOCKYSIZE=256"]
    made = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, 1, gdal.GDT_UInt16, options)
    made.SetGeoTransform((CORNER[0] + offset[0], gsd, 0.0, CORNER[1] + offset[1], 0.0, -gsd))
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(UTM)
    made.SetProjection(reference.ExportToWkt())
    made.GetRasterBand(1).WriteArray(np.clip(300 + 2500 * values, 1, 60_000).astype(np.uint16))
    return path


def drawn(seed: int, *, elsewhere: bool = False) -> Pair:
    """Return a pair that is drawn: sensors, seasons, haze, clouds, ratios of resolution, shifts and smooth fields."""
    random = np.random.default_rng([seed, 2])
    ratio = float(np.exp(random.uniform(-np.log(10), np.log(10))))
    coarse = max(1.0, ratio), max(1.0, 1 / ratio)
    ortho = Look(
        gsd=coarse[0], season=int(random.choice([0, 0, 1])), band=str(random.choice(["a", "b"])),
        noise=float(random.choice([0.01, 0.03])), haze=float(random.choice([0.0, 0.0, 0.5])),
        clouds=float(random.choice([0.0, 0.0, 0.0, random.uniform(0.1, 0.6)])),
    )  # fmt: skip
    reference = Look(gsd=coarse[1], noise=float(random.choice([0.01, 0.03])))
    pixel = max(coarse)
    side = int(random.choice([300, 450, 600]) if 1 / 3 < ratio < 3 else 300)
    angle, length = random.uniform(0, 2 * np.pi), random.choice([random.uniform(0, 3), random.uniform(3, 100)])
    shift = length * pixel * np.cos(angle), length * pixel * np.sin(angle)
    slopes = random.choice([0.0, 0.002]) * random.normal(0, 1, (2, 2))
    bend = float(random.choice([0.0, 0.0, random.uniform(0.1, 3.0)])) * pixel
    return Pair(
        ground=KINDS[seed % 3] if elsewhere else KINDS[int(random.integers(0, 3))], seed=seed, side=side, ortho=ortho,
        reference=reference, shift=(float(shift[0]), float(shift[1])), bend=bend,
        slopes=((float(slopes[0, 0]), float(slopes[0, 1])), (float(slopes[1, 0]), float(slopes[1, 1]))),
        length=float(random.uniform(0.3, 0.9)), elsewhere=elsewhere,
    )  # fmt: skip


#: Shifted by 3.2 m and -5.4 m, turned by 0.06 degrees, and bent by about 1 m.
BENT = Pair(side=400, shift=(3.2, -5.4), slopes=((0.0, 0.001), (-0.001, 0.0)), bend=0.8, length=0.5)
#: Shifted alone.
SHIFTED = Pair(side=320, seed=4, shift=(-2.6, 1.3))
