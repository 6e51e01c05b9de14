"""The preview of the orthoimage as PNG."""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.raster.output import png_bytes
from ortho_pipeline.raster.source import open_pixels

#: GDAL's number for averaging in a raster read.
_AVERAGE = 5


def preview_png(path: str | PathLike[str], *, side: int = 800) -> bytes:
    """Return a reduced, contrast-stretched copy of a raster as PNG, transparent where it has no value.

    Three bands or more give colours (the first three in their order), fewer give grey.
    """
    dataset = open_pixels(path)[0]
    shrink = min(1.0, side / max(dataset.RasterXSize, dataset.RasterYSize))
    size = max(1, round(dataset.RasterXSize * shrink)), max(1, round(dataset.RasterYSize * shrink))
    reading = {"buf_xsize": size[0], "buf_ysize": size[1]}
    bands = [dataset.GetRasterBand(k + 1) for k in range(3 if dataset.RasterCount >= 3 else 1)]
    mask = bands[0].GetMaskBand().ReadAsArray(**reading) > 0
    # Without overviews an average has to look at every pixel, which takes as long as making them did.
    way = {"resample_alg": _AVERAGE} if bands[0].GetOverviewCount() else {}
    planes = [_stretched(np.abs(band.ReadAsArray(**way, **reading)), mask) for band in bands]
    return png_bytes(np.stack([*planes, np.where(mask, 255, 0).astype(np.uint8)]))


def _stretched(values: NDArray[Any], mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    values = values.astype(np.float64)
    seen = values[mask & np.isfinite(values)]
    if not len(seen):
        return np.zeros(values.shape, dtype=np.uint8)
    low, high = np.percentile(seen, [1.0, 99.0])
    scaled = np.clip((values - low) / max(high - low, 1e-12), 0.0, 1.0)
    return np.nan_to_num(scaled * 255.0).astype(np.uint8)
