"""GDAL's pan-sharpening of two orthos, in windows, with their nodata values and masks.

GDAL's weighted Brovey method multiplies the upsampled bands of each pixel by the panchromatic value over their weighted
sum. GDAL knows one nodata value and no mask, computes in the type of the panchromatic band, and before 3.7 stretches
the bands to its extent. So both rasters are cut to one extent first. Where a mask or another nodata value hides pixels,
or the bands may be negative, GDAL upsamples them in floating point, with a nodata value that no pixel has, and `brovey`
computes as GDAL does.
Other grids are resampled once, by GDAL's warper.

Source: Gillespie et al. 1987 (Brovey); GDAL, VRTPansharpenedDataset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile, as_written, keep_off_nodata, value_range
from ortho_pipeline.raster.pixel_types import gdal_type
from ortho_pipeline.raster.regridded import coarser, part_of, warped_bounds
from ortho_pipeline.raster.source import Grid, RasterSource, first_line

#: Part of a panchromatic pixel by which edges of pixels of both grids may differ: rounding of coordinates, no more.
_SAME = 1e-3
#: Marks pixels without a value where GDAL computes in floating point; a power of two has the same value in any type.
_EMPTY = -(2.0**100)
#: Reach of the cubic kernel, in multispectral pixels.
_REACH = 3


@dataclass(frozen=True)
class CommonExtent:
    """The common area of two orthos on the grid of the panchromatic one.

    Parameters
    ----------
    grid : Grid
        Whole panchromatic pixels that both cover.
    whole : Grid
        The same area widened by the kernel of the upsampling to whole multispectral pixels, if the pixels of both
        nest; else `grid`.
    ratio : int
        Panchromatic pixels along a multispectral one if they nest, else 0.
    """

    grid: Grid
    whole: Grid
    ratio: int

    @classmethod
    def of(cls, pan: Grid, colours: Grid) -> CommonExtent:
        """Return the common area.

        Raises
        ------
        InputError
            If there is none.
        """
        xmin, ymin, xmax, ymax = warped_bounds(colours, pan.crs)
        left, right = (xmin - pan.left) / pan.dx, (xmax - pan.left) / pan.dx
        top, bottom = (pan.top - ymax) / pan.dy, (pan.top - ymin) / pan.dy
        apart = InputError("the panchromatic and the multispectral ortho do not overlap")
        # What has no place in this CRS has infinite bounds.
        if not all(map(math.isfinite, (left, right, top, bottom))):
            raise apart
        first, last = max(0, math.ceil(left - _SAME)), min(pan.width, math.floor(right + _SAME))
        upper, lower = max(0, math.ceil(top - _SAME)), min(pan.height, math.floor(bottom + _SAME))
        if not (first < last and upper < lower):
            raise apart
        grid = part_of(pan, first, upper, last - first, lower - upper)
        ratio = _nesting(pan, colours, left, top)
        if not ratio:
            return cls(grid, grid, 0)
        across = _widened(first, last, round(left), round(right), ratio)
        down = _widened(upper, lower, round(top), round(bottom), ratio)
        return cls(grid, part_of(pan, across[0], down[0], across[1] - across[0], down[1] - down[0]), ratio)


def _widened(first: int, last: int, begin: int, end: int, ratio: int) -> tuple[int, int]:
    """Return a range widened to whole multispectral pixels and the kernel about it, within those from begin to end."""
    low = begin + ((first - begin) // ratio - _REACH) * ratio
    high = begin + (-(-(last - begin) // ratio) + _REACH) * ratio
    return max(low, begin), min(high, end)


def _nesting(pan: Grid, colours: Grid, left: float, top: float) -> int:
    """Return how many panchromatic pixels make a multispectral one along each side; 0 if they do not nest."""
    ratio = round(colours.dx / pan.dx)
    if pan.crs != colours.crs or max(abs(left - round(left)), abs(top - round(top))) > _SAME:
        return 0
    # The edges must still agree at the far end of the raster.
    far = max(abs(colours.dx / pan.dx - ratio) * colours.width, abs(colours.dy / pan.dy - ratio) * colours.height)
    return ratio if far <= _SAME else 0


class Pansharpened:
    """The pan-sharpened bands of two orthos.

    Parameters
    ----------
    pan, colours : RasterSource
        One panchromatic band, and the multispectral bands without alpha.
    grids : (Grid, Grid)
        Their grids.
    weights : sequence of float
        Of the multispectral bands in the panchromatic one.
    profile : Profile
        Of the result: its pixel type, nodata value or mask.
    threads : int
        Of GDAL for the upsampling.
    memory : int
        Bytes for GDAL's warper, where it is needed.
    """

    def __init__(
        self,
        pan: RasterSource,
        colours: RasterSource,
        grids: tuple[Grid, Grid],
        weights: Sequence[float],
        profile: Profile,
        *,
        threads: int = 1,
        memory: int = 64_000_000,
    ) -> None:
        self.overlap = CommonExtent.of(*grids)
        self._pan, self._colours, self._grids = pan, colours, grids
        self._weights, self._profile, self._threads, self._memory = weights, profile, threads, memory
        self._nodata, self._held = _common_nodata(pan, colours), list[gdal.Dataset]()
        # GDAL would clamp the colours to the type of the panchromatic band, and divide by sums that negative colours
        # make small.
        alike = bool(self.overlap.ratio) and pan.dtype == colours.dtype == profile.dtype
        self._native = alike and colours.dtype.kind == "u"
        #: Side (px) of the windows to read: those in floating point take several times the memory.
        self.window = 1024 if self._native else 512
        bits = colours.bands[0].GetMetadataItem("NBITS", "IMAGE_STRUCTURE")
        self._largest = math.inf if bits is None else 2.0 ** int(bits) - 1
        whole, grid = self.overlap.whole, self.overlap.grid
        self._left, self._top = round((grid.left - whole.left) / grid.dx), round((whole.top - grid.top) / grid.dy)

    def read(self, left: int, top: int, width: int, height: int) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels ``(bands, height, width)`` in the type of the result, and which are valid ``(height, width)``.

        The window is one of `overlap.grid`.
        """
        window = left + self._left, top + self._top, width, height
        if self._native and self._nodata is not None:
            pixels = self._read(self._native_bands, window)
            valid = pixels[0] != self._nodata
            return self._filled(pixels, valid), valid
        if self._native and self._all_valid(left, top, width, height):
            pixels, valid = self._read(self._native_bands, window), np.ones((height, width), dtype=bool)
        else:
            pixels, valid = self._computed(window)
            pixels = np.minimum(pixels, self._largest)
        return self._filled(pixels, valid), valid

    def _computed(self, window: tuple[int, int, int, int]) -> tuple[NDArray[Any], NDArray[np.bool_]]:
        """Return pixels of a window in floating point, and which are valid."""
        sharp, wide = self._floating_bands
        left, top, width, height = window
        factor = max(self.overlap.ratio, 1)
        pan = self._read(sharp, window)[0]
        # GDAL's bindings read whole pixels.
        first, upper = left // factor, top // factor
        columns, rows = -(-(left + width) // factor) - first, -(-(top + height) // factor) - upper
        colours = self._smooth(wide, (first, upper, columns, rows), factor)
        inset = slice(top - upper * factor, None), slice(left - first * factor, None)
        colours = colours[: self._colours.count, *inset][:, :height, :width]
        valid = (pan != _EMPTY) & (colours != _EMPTY).all(axis=0)
        colours = within(colours, self._colours.dtype)
        if self._native:
            # As GDAL does in windows without empty pixels, so that there are no seams between both.
            colours = np.floor(colours + 0.5)
        return brovey(pan, colours, self._weights), valid

    def _filled(self, pixels: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[Any]:
        low, _, _, fill = value_range(self._profile.dtype, self._profile)
        out = as_written(pixels, np.broadcast_to(valid, pixels.shape), self._profile.dtype, fill)
        if not valid.all():
            out[:, ~valid] = fill
        if self._profile.nodata is not None:
            keep_off_nodata(out, np.broadcast_to(valid, out.shape), fill, low)
        return out

    def _smooth(self, dataset: gdal.Dataset, window: tuple[int, int, int, int], factor: int) -> NDArray[Any]:
        """Return a window of a warped dataset, upsampled by a factor.

        GDAL 3.13 warps such a dataset again for another size, with the nearest pixels. So they are read first.
        """
        left, top, width, height = window
        first, upper = max(left - _REACH, 0), max(top - _REACH, 0)
        last, lower = min(left + width + _REACH, dataset.RasterXSize), min(top + height + _REACH, dataset.RasterYSize)
        pixels = _in_memory(self._read(dataset, (first, upper, last - first, lower - upper)))
        return np.asarray(
            pixels.ReadAsArray(
                left - first, top - upper, width, height,
                buf_xsize=width * factor, buf_ysize=height * factor, resample_alg=gdal.GRIORA_Cubic,
            )
        ).reshape(-1, height * factor, width * factor)  # fmt: skip

    def _read(self, dataset: gdal.Dataset, window: tuple[int, int, int, int]) -> NDArray[Any]:
        try:
            pixels = dataset.ReadAsArray(*window)
        except RuntimeError as error:
            raise InputError(
                f"GDAL cannot sharpen this ortho ({first_line(error)})", file=self._pan.path, remedy="make it again"
            ) from error
        return np.asarray(pixels).reshape(-1, window[3], window[2])

    def _all_valid(self, left: int, top: int, width: int, height: int) -> bool:
        """Return whether all pixels of a window and those that the upsampling needs about it are valid."""
        grid, ratio = self.overlap.grid, self.overlap.ratio
        x, y = grid.left + left * grid.dx, grid.top - top * grid.dy
        for source, own, about in zip((self._pan, self._colours), self._grids, (0, _REACH), strict=True):
            factor = 1 if about == 0 else ratio
            column, row = round((x - own.left) / grid.dx), round((own.top - y) / grid.dy)
            first, last = max(column // factor - about, 0), -(-(column + width) // factor) + about
            upper, lower = max(row // factor - about, 0), -(-(row + height) // factor) + about
            if not _whole(source, first, upper, min(last, source.width) - first, min(lower, source.height) - upper):
                return False
        return True

    @cached_property
    def _native_bands(self) -> gdal.Dataset:
        """GDAL's pan-sharpened dataset of the rasters as they are."""
        own = [_cut(source, grid, self.overlap.whole) for source, grid in zip(self._sources, self._grids, strict=True)]
        nodata = "NONE" if self._nodata is None else repr(self._nodata)
        # GDAL holds no reference to the datasets.
        self._held += own
        bands = [own[1].GetRasterBand(number) for number in self._colours.band_numbers]
        return _virtual(own[0].GetRasterBand(1), bands, self._weights, nodata, self._threads)

    @cached_property
    def _floating_bands(self) -> tuple[gdal.Dataset, gdal.Dataset]:
        """Both rasters in floating point, empty pixels marked."""
        whole, coarse = self.overlap.whole, self.overlap.whole
        if self.overlap.ratio:
            factor = self.overlap.ratio
            coarse = coarser(whole, factor, whole.width // factor, whole.height // factor)
        pan = self._floating(self._pan, self._grids[0], whole, "near")
        return pan, self._floating(self._colours, self._grids[1], coarse, "near" if self.overlap.ratio else "cubic")

    @property
    def _sources(self) -> tuple[RasterSource, RasterSource]:
        return self._pan, self._colours

    def _floating(self, source: RasterSource, own: Grid, grid: Grid, resampling: str) -> gdal.Dataset:
        wide = source.dtype.kind == "i" or (source.dtype.itemsize > 2 and source.dtype != np.float32)
        more = {} if own.crs == grid.crs else {"srcSRS": own.crs.to_wkt(), "dstSRS": grid.crs.to_wkt()}
        if source.dtype.kind == "f" and source.validity != "nodata":
            more["srcNodata"] = "nan"
        return gdal.Warp(
            "",
            source.dataset,
            format="VRT",
            outputBounds=grid.extent,
            width=grid.width,
            height=grid.height,
            resampleAlg=resampling,
            outputType=gdal.GDT_Float64 if wide else gdal.GDT_Float32,
            dstNodata=_EMPTY,
            errorThreshold=0.0,
            warpMemoryLimit=self._memory,
            # A pixel that one band lacks is empty; GDAL would require that of all bands where it is told of NaN.
            warpOptions=["UNIFIED_SRC_NODATA=PARTIAL"],
            **more,
        )


# -- arrays ----------------------------------------------------------------------------------------------------------


def brovey(pan: NDArray[Any], colours: NDArray[Any], weights: Sequence[float]) -> NDArray[Any]:
    """Return upsampled bands ``(n, h, w)`` sharpened by pixels ``(h, w)``; 0 where the weighted sum is 0."""
    below = np.tensordot(np.asarray(weights, dtype=colours.dtype), colours, axes=1)
    factor = np.divide(pan, below, out=np.zeros_like(below), where=below != 0)
    return np.asarray(colours * factor)


def within(colours: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Return upsampled bands from 0 to the largest value of their pixel type, as GDAL upsamples unsigned ones.

    Cubic convolution overshoots at edges, and corrections of the atmosphere make dark water negative. Negative values
    would make the weighted sum small and the quotient huge.
    """
    return np.clip(colours, 0, (np.iinfo(dtype) if dtype.kind in "iu" else np.finfo(dtype)).max)


def upsampled(colours: NDArray[np.float32], rows: int, columns: int) -> NDArray[np.float64]:
    """Return bands ``(n, rows, columns)`` upsampled as GDAL's pan-sharpening does it.

    NaN without a value; holes of one pixel get values from their neighbours.
    """
    dataset = _in_memory(colours)
    return _marked(dataset.ReadAsArray(buf_xsize=columns, buf_ysize=rows, resample_alg=gdal.GRIORA_Cubic))


def _in_memory(pixels: NDArray[Any]) -> gdal.Dataset:
    count, rows, columns = pixels.shape
    dataset = gdal.GetDriverByName("MEM").Create("", columns, rows, count, gdal_type(pixels.dtype))
    dataset.WriteArray(np.where(np.isfinite(pixels), pixels, pixels.dtype.type(_EMPTY)))
    for number in range(count):
        dataset.GetRasterBand(number + 1).SetNoDataValue(_EMPTY)
    return dataset


def _marked(pixels: NDArray[Any]) -> NDArray[np.float64]:
    return np.where(pixels == _EMPTY, np.nan, pixels.astype(np.float64))


# -- parts -----------------------------------------------------------------------------------------------------------


def colour_bands(source: RasterSource) -> tuple[int, ...]:
    """Return the numbers of the bands of a raster, without alpha."""
    return tuple(
        number
        for number, band in zip(source.band_numbers, source.bands, strict=True)
        if band.GetColorInterpretation() != gdal.GCI_AlphaBand
    )


def _virtual(
    pan: gdal.Band, bands: Sequence[gdal.Band], weights: Sequence[float], nodata: str, threads: int
) -> gdal.Dataset:
    """Return GDAL's pan-sharpened dataset of bands, which must stay open."""
    spectral = "".join(f'<SpectralBand dstBand="{number}"/>' for number in range(1, len(bands) + 1))
    text = (
        '<VRTDataset subClass="VRTPansharpenedDataset"><PansharpeningOptions>'
        f"<AlgorithmOptions><Weights>{','.join(repr(float(weight)) for weight in weights)}</Weights></AlgorithmOptions>"
        f"<Resampling>Cubic</Resampling><NumThreads>{threads}</NumThreads><NoData>{nodata}</NoData>"
        "<SpatialExtentAdjustment>NoneWithoutWarning</SpatialExtentAdjustment>"
        f"{spectral}</PansharpeningOptions></VRTDataset>"
    )
    return gdal.CreatePansharpenedVRT(text, pan, list(bands))


def _common_nodata(pan: RasterSource, colours: RasterSource) -> float | None:
    """Return the nodata value 0 of all bands, if nothing else hides pixels of unsigned values; else None.

    With any other value, GDAL would also empty valid pixels whose weighted sum is 0.
    """
    values = {*pan.nodata, *colours.nodata}
    flags = {source.bands[0].GetMaskFlags() for source in (pan, colours)}
    if values != {0.0} or flags != {gdal.GMF_NODATA}:
        return None
    return values.pop()


def _whole(source: RasterSource, left: int, top: int, width: int, height: int) -> bool:
    """Return whether all pixels of a window of unsigned values are valid."""
    if source.validity == "all":
        return True
    return source.read_valid(left, top, source.read(left, top, width, height)) is None


def _cut(source: RasterSource, own: Grid, whole: Grid) -> gdal.Dataset:
    """Return a raster on the extent of a grid with which its pixels agree; without a copy."""
    xmin, ymin, xmax, ymax = whole.extent
    left, top = round((xmin - own.left) / own.dx), round((own.top - ymax) / own.dy)
    size = round((xmax - xmin) / own.dx), round((ymax - ymin) / own.dy)
    if (left, top, *size) == (0, 0, own.width, own.height):
        return source.dataset
    return gdal.Translate("", source.dataset, format="VRT", srcWin=[left, top, *size])
