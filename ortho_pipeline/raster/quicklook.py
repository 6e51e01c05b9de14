"""Rasters as small pictures (PNG)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.raster.pixel_types import valid_of
from ortho_pipeline.raster.source import Grid, open_pixels
from ortho_pipeline.raster.verified_writing import png_bytes

#: GDAL's number for averaging in a raster read.
_AVERAGE = 5


def preview_png(
    path: str | PathLike[str],
    *,
    side: int = 800,
    allow_network: bool = False,
    roots: Sequence[str | PathLike[str]] = (),
) -> bytes:
    """Return a reduced, contrast-stretched copy of a raster as PNG, transparent where it has no value.

    Three bands or more give colours (the first three in their order), fewer give grey.
    """
    dataset = open_pixels(path, allow_network=allow_network, roots=roots)[0]
    size = _reduced(dataset.RasterXSize, dataset.RasterYSize, side)
    reading = {"buf_xsize": size[0], "buf_ysize": size[1]}
    bands = [dataset.GetRasterBand(k + 1) for k in range(3 if dataset.RasterCount >= 3 else 1)]
    mask = valid_of(bands[0], **reading)
    # Without overviews an average has to look at every pixel, which takes as long as making them did.
    way = {"resample_alg": _AVERAGE} if bands[0].GetOverviewCount() else {}
    pixels = np.stack([band.ReadAsArray(**way, **reading) for band in bands])
    return shaded_png(np.abs(pixels) if np.iscomplexobj(pixels) else pixels, mask)


def shaded_png(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> bytes:
    """Return pixels ``(1 or 3, h, w)`` as PNG, each band stretched, transparent where not `valid` ``(h, w)``."""
    planes = [_stretched(band, valid) for band in pixels]
    # A fully opaque picture needs no alpha plane, which is a fifth of the bytes of a busy picture.
    return png_bytes(np.stack(planes if valid.all() else [*planes, np.where(valid, 255, 0).astype(np.uint8)]))


def reduced_grid(grid: Grid, side: int) -> Grid:
    """Return the grid of the picture that `preview_png` makes of a raster on `grid`."""
    width, height = _reduced(grid.width, grid.height, side)
    return replace(grid, dx=grid.dx * grid.width / width, dy=grid.dy * grid.height / height, width=width, height=height)


def _reduced(width: int, height: int, side: int) -> tuple[int, int]:
    shrink = min(1.0, side / max(width, height))
    return max(1, round(width * shrink)), max(1, round(height * shrink))


def _stretched(values: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    values = values.astype(np.float64)
    seen = values[mask & np.isfinite(values)]
    if not len(seen):
        return np.zeros(values.shape, dtype=np.uint8)
    low, high = percentile(seen, 1.0), percentile(seen, 99.0)
    scaled = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.nan_to_num(scaled * 255.0).astype(np.uint8)


def percentile(values: NDArray[np.float64], percent: float) -> float:
    """Return a percentile of some finite values, as `np.percentile` has it, which loads masked arrays first."""
    place = (len(values) - 1) * (percent / 100)
    below = int(place)
    above, part = min(below + 1, len(values) - 1), place - below
    low, high = np.partition(values, (below, above))[[below, above]]
    # As there, from the nearer end, so that a value between equal values is exact.
    return float(high - (high - low) * (1 - part) if part >= 0.5 else low + (high - low) * part)
