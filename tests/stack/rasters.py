"""A stack of rasters of known truth: one ground at many dates, with errors, seasons, sun, clouds and moving ground.

Nothing here knows of the matcher, of the adjustment or of the warp: `tests/matching/landscape.py` is the ground.
"""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from landscape import CELL, SIZE, Land, land, sample
from numpy.typing import NDArray
from osgeo import gdal, osr
from scipy.ndimage import fourier_gaussian, gaussian_filter

Array = NDArray[np.float64]
UTM, CORNER, BEGIN = 32735, (512_000.0, 7_123_000.0), date(2020, 1, 10)


@dataclass(frozen=True)
class Rasters:
    """A stack of rasters with pixels of one metre.

    Parameters
    ----------
    side, dates : int
        Columns and rows; number of rasters.
    interval : float
        Mean days between dates.
    error : float
        Largest shift along each axis, px.
    seasons : int
        Looks of the ground through a year; each has half of the contrast of its own.
    sun : float
        Brightness that slopes gain or lose with the direction and the height of the sun, which change with the season.
    clouds : float
        Largest share of a raster under clouds.
    moving, rate : float
        Share of the ground that moves, and px a year.
    wrong : tuple of int
        Dates that show another place.
    step : float
        px by which all rasters of the second half are displaced.
    """

    seed: int = 0
    side: int = 300
    dates: int = 6
    interval: float = 30.0
    error: float = 5.0
    seasons: int = 1
    sun: float = 0.0
    clouds: float = 0.0
    noise: float = 0.01
    moving: float = 0.0
    rate: float = 1.0
    wrong: tuple[int, ...] = ()
    step: float = 0.0
    ground: str = "country"

    def days(self) -> list[date]:
        """Return the dates."""
        random = np.random.default_rng([self.seed, 1])
        steps = np.cumsum(random.uniform(0.6, 1.4, self.dates)) * self.interval
        return [BEGIN + timedelta(days=round(day)) for day in steps]

    def years(self) -> Array:
        """Return the times in years."""
        return np.array([(day - BEGIN).days / 365.25 for day in self.days()])

    def shifts(self) -> Array:
        """Return by how much (px, columns and rows) each raster shows the ground displaced ``(T, 2)``."""
        random = np.random.default_rng([self.seed, 2])
        found = random.uniform(-self.error, self.error, (self.dates, 2))
        found[self.dates // 2 :, 0] += self.step
        return found

    def moves(self, place: Array) -> NDArray[np.bool_]:
        """Tell which places ``(n, 2)`` px move."""
        if not self.moving:
            return np.zeros(len(place), dtype=bool)
        middle = np.random.default_rng([self.seed, 3]).uniform(0.35, 0.65, 2) * self.side
        return np.asarray(np.hypot(*(place - middle).T) < self.side * np.sqrt(self.moving / np.pi))

    @property
    def velocity(self) -> Array:
        """px a year along columns and rows of what moves."""
        turn = np.random.default_rng([self.seed, 4]).uniform(0, 2 * np.pi)
        return self.rate * np.array([np.cos(turn), np.sin(turn)])

    def write(self, folder: Path, workers: int = 1) -> list[Path]:
        """Write the rasters, with their dates as metadata."""
        folder.mkdir(parents=True, exist_ok=True)
        if workers == 1:
            return [self._write(folder, number) for number in range(self.dates)]
        with ProcessPoolExecutor(workers) as pool:
            return list(pool.map(self._write, [folder] * self.dates, range(self.dates)))

    def _write(self, folder: Path, number: int) -> Path:
        random = np.random.default_rng([self.seed, 5, number])
        steps = np.arange(self.side) + 0.5
        columns, rows = np.meshgrid(steps, steps)
        true = np.column_stack([columns.ravel(), rows.ravel()]) - self.shifts()[number]
        elapsed = self.years()[number] - self.years().mean()
        true = true - self.moves(true)[:, None] * self.velocity * elapsed
        texel = max(0.5, 1.1 * self.side / SIZE)
        box = max(1.0, 1.0 / texel)
        ground = land(self.ground, self.seed % 3)
        start = np.random.default_rng([self.seed, 6]).uniform(0, SIZE, 2) + (number in self.wrong) * 0.4 * SIZE
        u, v = true[:, 0] / texel + start[0], true[:, 1] / texel + start[1]
        season = int(self.years()[number] % 1.0 * self.seasons) if self.seasons > 1 else 0
        values = sample(ground.seen("a", 0, box, 0.35 * box), u, v)
        if season:
            values = 0.5 * (values + sample(ground.seen("a", season, box, 0.35 * box), u, v))
        if self.sun:
            values = values * self._lit(ground, u, v, self.years()[number])
        values = self._clouded(values.reshape(self.side, self.side), random)
        values = values + random.normal(0, self.noise, values.shape)
        return self._saved(folder / f"scene_{self.days()[number]:%Y%m%d}.tif", values, number)

    def _lit(self, ground: Land, u: Array, v: Array, year: float) -> Array:
        """Return the brightness of slopes in the morning sun, which is 25° high in January and 65° in July."""
        winter = np.cos(2 * np.pi * year)
        height, azimuth = np.radians(45 - 20 * winter), np.radians(140 + 15 * winter)
        east, south = np.sin(azimuth) * CELL / 2, -np.cos(azimuth) * CELL / 2
        rise = ground.heights(u + east, v + south) - ground.heights(u - east, v - south)
        return np.clip(1.0 - self.sun * rise / np.tan(height), 0.3, 1.7)

    def _clouded(self, values: Array, random: np.random.Generator) -> Array:
        share = random.uniform(0, self.clouds)
        # As a wide filter in space, in a tenth of the time.
        waves = fourier_gaussian(np.fft.rfft2(random.normal(size=values.shape)), self.side / 12, n=values.shape[1])
        low = np.fft.irfft2(waves, values.shape)
        if share < 0.01:
            return values
        rank = low.ravel().argsort().argsort().reshape(low.shape) / low.size
        cloud = np.clip((rank - (1 - share)) * 20, 0, 1)
        fine = gaussian_filter(random.normal(size=values.shape), 3, mode="wrap") * 0.5
        return np.asarray(values * (1 - cloud) + (1.0 + fine) * cloud)

    def _saved(self, path: Path, values: Array, number: int) -> Path:
        made = gdal.GetDriverByName("GTiff").Create(str(path), self.side, self.side, 1, gdal.GDT_UInt16)
        made.SetGeoTransform((CORNER[0], 1.0, 0.0, CORNER[1], 0.0, -1.0))
        reference = osr.SpatialReference()
        reference.ImportFromEPSG(UTM)
        made.SetProjection(reference.ExportToWkt())
        made.SetMetadataItem("ACQUISITIONDATETIME", f"{self.days()[number].isoformat()}T10:00:00Z")
        made.GetRasterBand(1).WriteArray(np.clip(300 + 2500 * values, 1, 60_000).astype(np.uint16))
        return path
