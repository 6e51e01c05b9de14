"""A raster as one image of intensities, as a matcher wants it: windows that may reach outside, reduced by averaging.

The bands are averaged, because a reference and a scene seldom have the same ones. What is not valid is NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.source import RasterSource, first_line

#: More bands than this are hyperspectral: so many of them, spread over the spectrum, stand for all.
_BANDS = 4
#: Up to this factor pixels are averaged here; beyond, GDAL does it, from overviews where there are some. Overviews may
#: have been made by any rule, so they serve to find a place and never to measure it.
EXACT = 8


class Intensity:
    """Intensities of a raster.

    Parameters
    ----------
    source : RasterSource
        All of its bands but alpha count; of more than four, four.
    """

    def __init__(self, source: RasterSource) -> None:
        self.source = source
        self.width, self.height = source.width, source.height
        kept = [
            number for number, band in enumerate(source.bands) if band.GetColorInterpretation() != gdal.GCI_AlphaBand
        ] or [0]  # fmt: skip
        if len(kept) > _BANDS:
            kept = [kept[round(place)] for place in np.linspace(0, len(kept) - 1, _BANDS)]
        self._bands = kept
        # The brightest value of whole numbers says "at least this".
        kind = source.dtype
        self.saturated = float(np.iinfo(kind).max) if kind.kind in "iu" else np.inf

    def read(self, left: int, top: int, width: int, height: int, factor: int = 1) -> NDArray[np.float32]:
        """Return intensities ``(height, width)`` of means of `factor` x `factor` pixels; NaN where not valid.

        Parameters
        ----------
        left, top : int
            First pixel; the window may lie outside in part or whole.
        width, height : int
            Of the result: the window is `factor` times as large.
        """
        out = np.full((height, width), np.nan, dtype=np.float32)
        # Only whole groups of pixels that lie inside.
        first_column, first_row = max(0, -(left // factor)), max(0, -(top // factor))
        last_column = min(width, (self.width - left) // factor)
        last_row = min(height, (self.height - top) // factor)
        if first_column >= last_column or first_row >= last_row:
            return out
        window = left + first_column * factor, top + first_row * factor
        shape = last_row - first_row, last_column - first_column
        part = self._means(*window, *shape, factor) if factor <= EXACT else self._reduced(*window, *shape, factor)
        out[first_row:last_row, first_column:last_column] = part
        return out

    def _means(self, left: int, top: int, rows: int, columns: int, factor: int) -> NDArray[np.float32]:
        pixels = self.source.read(left, top, columns * factor, rows * factor)
        valid = self.source.read_valid(left, top, pixels)
        mean = pixels[self._bands].astype(np.float32).mean(axis=0)
        if valid is not None:
            mean[~valid[self._bands].all(axis=0)] = np.nan
        if factor == 1:
            return mean
        return mean.reshape(rows, factor, columns, factor).mean(axis=(1, 3), dtype=np.float32)

    def _reduced(self, left: int, top: int, rows: int, columns: int, factor: int) -> NDArray[np.float32]:
        return self._resampled((left, top, columns * factor, rows * factor), rows, columns)

    def _resampled(
        self, window: tuple[int, int, int, int], rows: int, columns: int, *, single: bool = False
    ) -> NDArray[np.float32]:
        """Return a window (left, top, width, height) as GDAL reduces it to ``(rows, columns)``.

        Parameters
        ----------
        single : bool
            Where there are no overviews, take single pixels for all that they stand for.
        """
        size = {"buf_xsize": columns, "buf_ysize": rows}
        found = np.zeros((rows, columns), dtype=np.float32)
        valid = np.ones((rows, columns), dtype=bool)
        try:
            for number in self._bands:
                band = self.source.bands[number]
                way = gdal.GRIORA_NearestNeighbour if single and not band.GetOverviewCount() else gdal.GRIORA_Average
                found += band.ReadAsArray(*window, **size, buf_type=gdal.GDT_Float32, resample_alg=way)
                valid &= band.GetMaskBand().ReadAsArray(*window, **size) != 0
        except RuntimeError as error:
            raise InputError(
                f"the pixels cannot be read ({first_line(error, self.source.path)})", file=self.source.path,
                remedy="the file is cut off or damaged: copy it again",
            ) from error  # fmt: skip
        found /= len(self._bands)
        found[~valid] = np.nan
        return found
