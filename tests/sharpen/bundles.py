"""Simulated bundles of known truth: a ground in several bands, seen sharp in all of them, and as a sensor sees it.

Nothing here knows of the product. The ground is a sum of texture that all bands share and of texture of each band. A
panchromatic pixel is a weighted sum of the bands; a multispectral pixel is the mean of `ratio` x `ratio` fine pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal, osr

Array = NDArray[np.float64]
CORNER = (512_000.0, 4_123_000.0)
TYPES = {"uint8": gdal.GDT_Byte, "uint16": gdal.GDT_UInt16, "int16": gdal.GDT_Int16, "float32": gdal.GDT_Float32}


@dataclass(frozen=True)
class Bundle:
    """A bundle.

    Parameters
    ----------
    shift : (float, float)
        Panchromatic pixels, columns and rows, by which the multispectral ortho shows things displaced.
    own : float
        Part of the texture that is of each band alone.
    level : float
        Mean value; values are within a tenth and twice of it.
    """

    seed: int = 0
    side: int = 768
    ratio: int = 4
    count: int = 4
    dtype: str = "uint16"
    level: float = 600.0
    own: float = 0.25
    noise: float = 0.004
    shift: tuple[float, float] = (0.0, 0.0)

    @property
    def weights(self) -> Array:
        drawn = np.random.default_rng([self.seed, 1]).uniform(0.5, 1.5, self.count)
        return drawn / drawn.sum()

    def truth(self) -> Array:
        """Return the bands as the panchromatic detector would see each of them ``(count, side, side)``."""
        return self._seen((0.0, 0.0))

    def _seen(self, shift: tuple[float, float]) -> Array:
        random = np.random.default_rng([self.seed, 2])
        common = _texture(random, self.side, shift)
        bands = []
        for _ in range(self.count):
            share = random.uniform(0.6, 1.2)
            bands.append(1.0 + 0.2 * (share * common + self.own * _texture(random, self.side, shift)))
        return self.level * np.clip(bands, 0.1, 2.0)

    def pixels(self) -> tuple[Array, Array]:
        """Return panchromatic and multispectral pixels, with noise, not rounded."""
        random = np.random.default_rng([self.seed, 3])
        pan = np.einsum("b,bij->ij", self.weights, self.truth())
        coarse = self.side // self.ratio
        moved = self._seen(self.shift).reshape(self.count, coarse, self.ratio, coarse, self.ratio).mean(axis=(2, 4))
        noise = self.noise * self.level
        return pan + random.normal(0, noise, pan.shape), moved + random.normal(0, noise, moved.shape)

    def write(self, folder: Path) -> tuple[Path, Path]:
        """Write both orthos."""
        pan, colours = self.pixels()
        return (
            write(folder / "pan.tif", pan[None], 0.5, self.dtype),
            write(folder / "ms.tif", colours, 0.5 * self.ratio, self.dtype),
        )


def _texture(random: np.random.Generator, side: int, shift: tuple[float, float]) -> Array:
    """Return periodic texture of mean 0 and deviation 1 from broad fields to detail of two pixels, moved exactly."""
    row, column = np.meshgrid(np.fft.fftfreq(side), np.fft.fftfreq(side), indexing="ij")
    frequency = np.hypot(row, column)
    spectrum = np.fft.fft2(random.standard_normal((side, side)))
    spectrum *= np.exp(-((frequency / 0.2) ** 2)) / np.maximum(frequency, 4 / side) ** 1.3
    spectrum[0, 0] = 0.0
    spectrum *= np.exp(-2j * np.pi * (column * shift[0] + row * shift[1]))
    texture = np.fft.ifft2(spectrum).real
    return texture / texture.std()


def write(
    path: Path,
    pixels: Array,
    size: float,
    dtype: str = "uint16",
    *,
    nodata: float | None = None,
    mask: NDArray[np.bool_] | None = None,
    corner: tuple[float, float] = CORNER,
    epsg: int = 32636,
) -> Path:
    """Write an ortho with pixels ``(bands, h, w)``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    count, rows, columns = pixels.shape
    gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", "YES")
    made = gdal.GetDriverByName("GTiff").Create(str(path), columns, rows, count, TYPES[dtype], ["TILED=YES"])
    made.SetGeoTransform((corner[0], size, 0.0, corner[1], 0.0, -size))
    place = osr.SpatialReference()
    place.ImportFromEPSG(epsg)
    made.SetProjection(place.ExportToWkt())
    if np.dtype(dtype).kind in "iu":
        limits = np.iinfo(dtype)
        pixels = np.clip(np.rint(pixels), limits.min, limits.max)
    made.WriteArray(pixels.astype(dtype))
    for number in range(1, count + 1):
        if nodata is not None:
            made.GetRasterBand(number).SetNoDataValue(nodata)
    if mask is not None:
        made.CreateMaskBand(gdal.GMF_PER_DATASET)
        made.GetRasterBand(1).GetMaskBand().WriteArray(mask.astype(np.uint8) * 255)
    made = None
    gdal.SetConfigOption("GDAL_TIFF_INTERNAL_MASK", None)
    return path


def errors(truth: Array, image: Array, ratio: float) -> tuple[float, float]:
    """Return ERGAS and the mean spectral angle (degrees) by their definitions, away from the rim."""
    truth, image = (values[:, 16:-16, 16:-16].astype(float) for values in (truth, image))
    rmse = [np.sqrt(np.mean((one - other) ** 2)) / np.mean(one) for one, other in zip(truth, image, strict=True)]
    ergas = 100 / ratio * np.sqrt(np.mean(np.square(rmse)))
    dot = (truth * image).sum(axis=0)
    angle = np.arccos(np.clip(dot / np.sqrt((truth**2).sum(axis=0) * (image**2).sum(axis=0)), -1, 1))
    return float(ergas), float(np.degrees(angle).mean())
