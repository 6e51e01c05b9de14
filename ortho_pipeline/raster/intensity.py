"""A raster as one image of intensities, as a matcher wants it: windows that may reach outside, reduced by averaging.

The bands are averaged, because a reference and a scene seldom have the same ones. What is not valid is NaN. Bands
without content (nodata, one value, flags of quality) have no part in it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.pixel_types import valid_of
from ortho_pipeline.raster.source import RasterSource, first_line

#: Largest number of bands to average, and the least content of one, as part of that of the best band.
_BANDS, _WORTH = 4, 0.5
#: Numbers of windows with values in which bands are compared, their side (px), and the most windows to try.
_WINDOWS, _WINDOW, _TRIED = 9, 64, 150
#: A band with values in less than this part of the pixels of the fullest band would cost the other ones theirs.
_FULL = 0.9
#: Steps between the percentiles 1 and 99 of a band that distinguish values.
_STEPS = 256
#: From the first frequency on (cycles per pixel) a raster that was enlarged by two shows at most this part of what it
#: shows between the other two; noise and edges of a raster that was not show more. Of some 20 real and simulated
#: images, enlarged by bilinear, cubic, spline and Lanczos kernels, none shows more than 0.0014; as delivered, all but
#: one (0.0011) show 0.0018 and more.
_TOP, _MIDDLE, _EMPTY = 0.375, (0.0625, 0.25), 0.0016
#: Up to this factor pixels are averaged here; beyond, GDAL does it, from overviews where there are some. Overviews may
#: have been made by any rule, so they serve to find a place and never to measure it.
EXACT = 8


class Intensity:
    """Intensities of a raster.

    Parameters
    ----------
    source : RasterSource
    bands : sequence of int
        Numbers from 1 of the bands that are averaged; those with the most content (`contents`) without.
    """

    def __init__(self, source: RasterSource, bands: Sequence[int] = ()) -> None:
        self.source = source
        self.width, self.height = source.width, source.height
        self.bands = tuple(bands)
        # The largest integer means "at least this value".
        kind = source.dtype
        self.saturated = float(np.iinfo(kind).max) if kind.kind in "iu" else np.inf
        #: What a matcher found in the pixels, by what it looked for: it matches an ortho several times.
        self.found: dict[tuple[Any, ...], Any] = {}

    @cached_property
    def averaged(self) -> tuple[int, ...]:
        """Numbers of the bands to average; chosen when pixels are first needed."""
        return self.bands or self.best()

    def best(self, most: int = _BANDS) -> tuple[int, ...]:
        """Return the numbers of at most `most` bands, those with the most content; without alpha."""
        colours = [band.GetColorInterpretation() for band in self.source.bands]
        known = np.flatnonzero([colour != gdal.GCI_AlphaBand for colour in colours])
        if len(known) < 2:
            return (int(known[0]) + 1 if len(known) else 1,)
        samples = list(itertools.islice(self._samples(), _WINDOWS))
        content = contents(np.stack(samples, axis=1)[known]) if samples else np.zeros(len(known))
        if not content.any():
            # A raster of one value, or none where it was looked at: bands from its whole spectrum.
            spread = np.linspace(0, len(known) - 1, min(most, len(known)))
            return tuple((known[np.round(spread).astype(int)] + 1).tolist())
        best = np.argsort(-content, kind="stable")[:most]
        return tuple(sorted((known[best[content[best] >= _WORTH * content.max()]] + 1).tolist()))

    @cached_property
    def enlarged(self) -> bool:
        """Whether it was enlarged by two or more: several of its pixels make one that is resolved."""
        bands = np.array(self.averaged) - 1
        windows = [sample[bands].mean(axis=0) for sample in itertools.islice(self._samples(), _WINDOWS)]
        windows = [window for window in windows if np.isfinite(window).all()]
        return bool(windows) and enlarged(np.stack(windows))

    def _samples(self) -> Iterator[NDArray[np.float32]]:
        """Yield windows ``(bands, h, w)`` spread over the raster in which some band has values; NaN is not valid."""
        height, width = min(_WINDOW, self.height), min(_WINDOW, self.width)
        for number in range(1, _TRIED + 1):
            across, down = (_part(number, base) for base in (2, 3))
            left, top = int(across * (self.width - width + 1)), int(down * (self.height - height + 1))
            pixels = self.source.read(left, top, width, height)
            valid = self.source.read_valid(left, top, pixels)
            values = pixels.astype(np.float32)
            if valid is not None:
                values[~valid] = np.nan
            if np.isfinite(values).mean(axis=(1, 2)).max() > 0.5:
                yield values

    def read(self, left: int, top: int, width: int, height: int, factor: int = 1) -> NDArray[np.float32]:
        """Return intensities ``(height, width)`` of means of `factor` x `factor` pixels; NaN where not valid.

        Parameters
        ----------
        left, top : int
            First pixel; the window may be partly or fully outside.
        width, height : int
            Size of the result; the window is `factor` times as large.
        """
        out = np.full((height, width), np.nan, dtype=np.float32)
        # Only full groups of pixels inside the raster.
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
        bands = np.array(self.averaged) - 1
        mean = pixels[bands].astype(np.float32).mean(axis=0)
        if valid is not None:
            mean[~valid[bands].all(axis=0)] = np.nan
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
            Without overviews, use single pixels instead of means.
        """
        size = {"buf_xsize": columns, "buf_ysize": rows}
        found = np.zeros((rows, columns), dtype=np.float32)
        valid = np.ones((rows, columns), dtype=bool)
        bands = [self.source.bands[number - 1] for number in self.averaged]
        try:
            for band in bands:
                way = gdal.GRIORA_NearestNeighbour if single and not band.GetOverviewCount() else gdal.GRIORA_Average
                found += band.ReadAsArray(*window, **size, buf_type=gdal.GDT_Float32, resample_alg=way)
                valid &= valid_of(band, *window, **size)
        except RuntimeError as error:
            raise InputError(
                f"the pixels cannot be read ({first_line(error, self.source.path)})",
                file=self.source.path,
                remedy="the file is cut off or damaged: copy it again",
            ) from error
        found /= len(bands)
        found[~valid] = np.nan
        return found


def contents(bands: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return how much structure bands ``(n, windows, h, w)`` show, 0 for one without; NaN is not valid.

    Bits that a pixel tells beyond its neighbour: the entropy of differences between neighbours, in steps of the band's
    range. Classes and what was enlarged have few. Noise has many, and is not correlated with its neighbour; so the bits
    are multiplied by that correlation.
    """
    content = np.zeros(len(bands))
    full = np.isfinite(bands).mean(axis=(1, 2, 3))
    for number in np.flatnonzero((full > 0) & (full >= _FULL * full.max())).tolist():
        band = bands[number]
        low, high = np.nanpercentile(band, (1.0, 99.0))
        if not high > low:
            continue
        values = np.clip((band - low) * ((_STEPS - 1) / (high - low)), 0, _STEPS - 1)
        steps = [np.diff(values, axis=axis).ravel() for axis in (1, 2)]
        steps = [step[np.isfinite(step)] for step in steps]
        variance = float(np.nanvar(values))
        for step in steps:
            counts = np.unique(np.rint(step), return_counts=True)[1] / max(len(step), 1)
            alike = 1.0 - float((step**2).mean()) / (2 * variance) if len(step) and variance > 0 else 0.0
            content[number] += max(alike, 0.0) * float(-(counts * np.log2(counts)).sum()) / len(steps)
    return content


def enlarged(windows: NDArray[np.float32]) -> bool:
    """Return whether a raster was enlarged by two or more: windows ``(n, h, w)`` have no detail as fine as a pixel."""
    height, width = windows.shape[1:]
    down, across = (np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2 for count in (height, width))
    level = windows - windows.mean(axis=(1, 2), keepdims=True)
    power = (np.abs(np.fft.fft2(level * down[:, None] * across)) ** 2).sum(axis=0)
    for axis, count in ((1, height), (0, width)):
        frequency, along = np.abs(np.fft.fftfreq(count)), power.sum(axis=axis)
        middle = along[(frequency >= _MIDDLE[0]) & (frequency < _MIDDLE[1])].sum()
        if not along[frequency >= _TOP].sum() < _EMPTY * middle:
            return False
    return True


def _part(number: int, base: int) -> float:
    """Return a number between 0 and 1; those of 1, 2, 3 ... are spread evenly (van der Corput's sequence)."""
    part, unit = 0.0, 1.0
    while number:
        unit /= base
        number, digit = divmod(number, base)
        part += digit * unit
    return part
