"""Orthos as files: what one takes over from its source, and the writer that leaves a whole file or none."""

from __future__ import annotations

import contextlib
import math
import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import whole_or_nothing
from ortho_pipeline.raster.pixel_types import gdal_type, holds, pixel_type
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.raster.stored_crs import stored_wkt
from ortho_pipeline.raster.verified_writing import (
    abandon,
    check_written,
    checked_options,
    close,
    gdal_errors,
    require_writable,
    retire_attached,
)
from ortho_pipeline.runtime.process_limits import Progress, claim_gdal_threads
from ortho_pipeline.runtime.signals import called_by_gdal

#: Bytes up to which a raster that is going to be copied is kept in memory instead of in a file.
_SMALL = 16_000_000
#: Bytes of all bands beyond which blocks and tiles are smaller.
_SQUARE = 1 << 23


@dataclass(frozen=True)
class Profile:
    """Properties that an output raster takes over from its source."""

    count: int
    dtype: np.dtype[Any]
    validity: str
    nodata: float | None = None
    descriptions: tuple[str, ...] = ()
    interpretations: tuple[int, ...] = ()
    color_table: Any = None
    scales: tuple[tuple[float, float, str], ...] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, source: RasterSource, dtype: str | None = None, nodata: float | str | None = None) -> Profile:
        """Return the profile of an ortho of `source`.

        Nodata stays nodata (one value for all bands, as in GeoTIFF), and alpha stays alpha. All other sources get a
        mask, because no pixel value may get a new meaning. Under a mask, floating-point bands without a value are NaN.
        Integers have no NaN, so there a pixel is valid only if all of its bands are.

        Parameters
        ----------
        dtype : str, optional
            GDAL's name of the pixel type. Default: that of the source.
        nodata : float or 'nan', optional
            Value of pixels without an image, whatever the source has.

        Raises
        ------
        InputError
            If the type cannot hold the nodata value, or an alpha band of the source already marks valid pixels.
        """
        kind = source.dtype if dtype is None else pixel_type(dtype)
        # NaN is not equal to itself, and would make a set of several.
        bands = source.bands
        values = {"nan" if value is not None and math.isnan(value) else value for value in source.nodata}
        validity: str
        empty: float | None
        if nodata is not None:
            validity, empty = "nodata", _given_nodata(float(nodata), kind, source)
        elif source.validity == "nodata" and len(values) == 1:
            validity, empty = "nodata", _kept_nodata(source.nodata[0], kind, source)
        else:
            # The range of alpha is that of its type, and GDAL knows none of floating point.
            alpha = source.validity == "alpha" and kind == source.dtype and kind.kind != "f"
            validity, empty = ("alpha" if alpha else "mask"), None
        return cls(
            count=source.count,
            dtype=kind,
            validity=validity,
            nodata=empty,
            descriptions=source.descriptions,
            interpretations=tuple(band.GetColorInterpretation() for band in bands),
            color_table=_palette(bands[0]) if kind in (np.uint8, np.uint16) else None,
            scales=tuple((band.GetScale() or 1.0, band.GetOffset() or 0.0, band.GetUnitType()) for band in bands),
        )

    @property
    def colours(self) -> list[int]:
        """The bands, counted from 0, without alpha bands."""
        kinds = self.interpretations or [gdal.GCI_Undefined] * self.count
        return [band for band, kind in enumerate(kinds) if kind != gdal.GCI_AlphaBand]

    def unlike(self, other: Profile, name: str, others: str) -> str:
        """Return how equal pixels of this ortho and another one differ in value or colour; empty if they do not."""
        what = ""
        for band, (one, two) in enumerate(zip(self.scales, other.scales, strict=True), 1):
            if one[:2] != two[:2]:
                what = (
                    f"band {band} of {others} has scale {two[0]:g} and offset {two[1]:g}, but that of {name} has "
                    f"{one[0]:g} and {one[1]:g}"
                )
        if not _same_colours(self.color_table, other.color_table):
            what = f"{others} and {name} have different colour tables"
        return what

    def mask_of(self, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which pixels ``(h, w)`` are valid, of what is valid in each band ``(bands, h, w)``."""
        # NaN says for itself which band has no value; an integer cannot, so there a pixel needs all of its bands.
        any_band = self.validity == "nodata" or self.dtype.kind == "f"
        return valid[0] if len(valid) == 1 else np.asarray((np.any if any_band else np.all)(valid, axis=0))


def _same_colours(one: Any, other: Any) -> bool:
    """Return whether two of GDAL's colour tables (None without) agree in the colours that both have."""
    if one is None or other is None:
        return one is other
    return all(one.GetColorEntry(k) == other.GetColorEntry(k) for k in range(min(one.GetCount(), other.GetCount())))


def _palette(band: gdal.Band) -> gdal.ColorTable | None:
    # A copy: what GDAL returns ends with the dataset.
    table = band.GetColorTable()
    return None if table is None else table.Clone()


def _given_nodata(value: float, dtype: np.dtype[Any], source: RasterSource) -> float:
    if source.validity == "alpha":
        raise InputError(
            "the alpha band of this image already marks the valid pixels",
            file=source.path,
            field="output.nodata",
            remedy=Text(
                "leave out ", Setting("output.nodata"), ", or choose the other bands with ", Setting("output.bands")
            ),
        )
    if not holds(dtype, value):
        raise InputError(
            f"pixels of type {dtype} cannot have the value {value:g}",
            field="output.nodata",
            remedy=Text("give another value, or another type with ", Setting("output.dtype")),
        )
    return value


def _kept_nodata(value: float | None, dtype: np.dtype[Any], source: RasterSource) -> float | None:
    if value is not None and not holds(dtype, value):
        raise InputError(
            f"the nodata value {value:g} of the image does not fit into {dtype}",
            file=source.path,
            field="output.dtype",
            remedy=Text("choose another nodata value with ", Setting("output.nodata")),
        )
    return value


def classes_profile(name: str, classes: Mapping[int, tuple[str, str]], metadata: Mapping[str, str]) -> Profile:
    """Return the profile of a raster of classes (Byte, 0 for nothing): its value -> its name and colour (#rrggbb).

    The colours are in the file, so that a GIS shows classes as such; the names are metadata items.
    """
    table = gdal.ColorTable()
    for value, (_, colour) in classes.items():
        table.SetColorEntry(value, (*bytes.fromhex(colour.removeprefix("#")), 255))
    return Profile(
        count=1,
        dtype=np.dtype(np.uint8),
        validity="nodata",
        nodata=0.0,
        descriptions=(name,),
        interpretations=(gdal.GCI_PaletteIndex,),
        color_table=table,
        metadata={**{f"CLASS_{value}": text for value, (text, _) in classes.items()}, **metadata},
    )


def as_written(pixels: NDArray[Any], valid: NDArray[np.bool_], dtype: np.dtype[Any], fill: float) -> NDArray[Any]:
    """Return pixels ``(count, h, w)`` in the type of the output: rounded and clamped, `fill` where not valid."""
    if pixels.dtype == dtype:
        return pixels
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        pixels = np.clip(np.floor(np.where(valid, pixels, 0) + 0.5), limits.min, limits.max)
    with np.errstate(over="ignore"):
        written = pixels.astype(dtype)
    written[~valid] = fill
    return written


def value_range(dtype: np.dtype[Any], profile: Profile) -> tuple[float, float, bool, Any]:
    """Return lowest and highest value of the output type, whether it is an integer type, and the fill value."""
    empty = 0 if dtype.kind in "iu" else math.nan
    fill = dtype.type(empty if profile.nodata is None else profile.nodata)
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        return float(limits.min), float(limits.max), True, fill
    return -math.inf, math.inf, False, fill


def keep_off_nodata(out: NDArray[Any], valid: NDArray[np.bool_], fill: Any, low: float) -> None:
    """Change valid pixels that happen to have the nodata value to a neighbouring value, for every kernel.

    The value is the same as GDAL's: for integers one less (one more for the minimum), for floating point the next one.
    GDAL before 3.11 does this only for integers that it interpolates.
    """
    if np.isnan(fill):
        return
    for band, good in zip(out, valid, strict=True):
        clash = (band == fill) & good
        if clash.any():
            if band.dtype.kind in "iu":
                band[clash] = fill - 1 if fill > low else fill + 1
            else:
                greatest = np.finfo(band.dtype).max
                band[clash] = np.nextafter(fill, greatest if fill < greatest else 0, dtype=band.dtype)


def refuse_empty(valid_pixels: int, path: str | os.PathLike[str]) -> None:
    """Refuse an ortho without any pixel value.

    Raises
    ------
    InputError
        Raise it inside a `RasterWriter`, so that no file remains.
    """
    if not valid_pixels:
        raise InputError(
            "no pixel of this ortho has a value",
            file=path,
            remedy=Text(
                "check the extent, the heights (",
                Setting("surface.height"),
                ", or the DEM's place, datum and unit), and the nodata value and mask of the image",
            ),
        )


def square_side(profile: Profile, side: int) -> int:
    """Return the side (px) of a tile or block: the given one, halved until 8 MB hold all of its bands; at least 256."""
    while side > 256 and side * side * profile.count * profile.dtype.itemsize > _SQUARE:
        side //= 2
    return side


class RasterWriter:
    """A GeoTIFF or COG that is written in windows and appears at its path when it is complete.

    Use as a context manager: an exception inside leaves nothing behind, and a file that was there before untouched.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        grid: Grid,
        profile: Profile,
        *,
        driver: str = "COG",
        creation_options: Mapping[str, str] | None = None,
        threads: int = 1,
        progress: Progress | None = None,
    ) -> None:
        if driver not in ("COG", "GTiff"):
            raise InputError(f"orthos cannot be written as {driver!r}", field="format", remedy="COG or GTiff")
        self.path, self.grid, self.profile, self.driver = Path(path), grid, profile, driver
        # The bands of a block are adjacent in the file, and GDAL keeps several such blocks.
        self._side = square_side(profile, 512)
        self.options = checked_options(driver, dict(creation_options or {}), threads, self._side)
        if creation_options:
            require_writable(driver, self.options, profile.count, gdal_type(profile.dtype))
        if threads > 1 or self.options.get("NUM_THREADS", "1") != "1":
            claim_gdal_threads()
        self._lock = threading.Lock()
        self._written, self._progress = 0, progress
        self._open = contextlib.ExitStack()

    def __enter__(self) -> RasterWriter:
        with contextlib.ExitStack() as stack:
            self._temporary = stack.enter_context(whole_or_nothing(self.path))
            retire_attached(self.path)
            if self.driver == "COG":
                # The COG driver copies a finished raster: overviews come before the pixels in the file.
                size = self.grid.width * self.grid.height * self.profile.count * self.profile.dtype.itemsize
                self._work = None if size <= _SMALL and self.profile.validity == "nodata" else self.scratch("work")
                side = str(self._side)
                options = {"TILED": "YES", "BIGTIFF": "IF_SAFER", "BLOCKXSIZE": side, "BLOCKYSIZE": side}
            else:
                self._work, options = self._temporary, self.options
            self._dataset = self._create(self._work, options)
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        # What is written last is left first: the pixels are complete before the file gets its name.
        with self._open:
            if error is not None:
                abandon(self._dataset)
                raise error
            self._finish()

    def write(self, left: int, top: int, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> None:
        """Write a window ``(count, h, w)``; `valid` ``(h, w)`` goes to the mask, if the profile has one."""
        with self._lock, gdal_errors(self.path):
            self._written += pixels.shape[1] * pixels.shape[2]
            self._dataset.WriteArray(pixels, left, top)
            if self.profile.validity == "mask" and valid is not None:
                mask = valid.view(np.uint8) * np.uint8(255)
                self._dataset.GetRasterBand(1).GetMaskBand().WriteArray(mask, left, top)
            if self.driver == "GTiff" and self._completes_blocks(left, top, pixels.shape[2], pixels.shape[1]):
                # GDAL writes blocks when it needs room, which depends on what other threads read: their order in the
                # file would be another in every run.
                for band in range(self.profile.count):
                    self._dataset.GetRasterBand(band + 1).FlushCache()
                if self.profile.validity == "mask":
                    self._dataset.GetRasterBand(1).GetMaskBand().FlushCache()

    def _completes_blocks(self, left: int, top: int, width: int, height: int) -> bool:
        """Return whether all started blocks are complete after a window, if windows come row by row."""
        across, down = self._dataset.GetRasterBand(1).GetBlockSize()
        right, bottom = left + width, top + height
        beside = right == self.grid.width or left % across == right % across == 0
        return beside and (bottom == self.grid.height or bottom % down == 0)

    def _create(self, path: Path | None, options: Mapping[str, str]) -> gdal.Dataset:
        profile, grid = self.profile, self.grid
        code = gdal_type(profile.dtype)
        with gdal_errors(self.path), contextlib.ExitStack() as failed:
            driver, where = ("MEM", "") if path is None else ("GTiff", str(path))
            creation = [] if path is None else [f"{k}={v}" for k, v in options.items()]
            dataset = gdal.GetDriverByName(driver).Create(where, grid.width, grid.height, profile.count, code, creation)
            failed.callback(abandon, dataset)
            dataset.SetProjection(stored_wkt(grid))
            dataset.SetGeoTransform(grid.geotransform)
            dataset.SetMetadataItem("AREA_OR_POINT", "Area")
            for key, value in profile.metadata.items():
                dataset.SetMetadataItem(key, value)
            for i in range(profile.count):
                _describe(dataset.GetRasterBand(i + 1), profile, i)
            if profile.validity == "mask":
                # On a full disk it fails here, and the dataset can be closed. GDAL 3.13 ends the process when it closes
                # a dataset with a started mask and no space for the directory before it.
                dataset.FlushCache()
                dataset.CreateMaskBand(gdal.GMF_PER_DATASET)
            failed.pop_all()
        return dataset

    def _finish(self) -> None:
        with gdal_errors(self.path):
            source = self._dataset
            if self._work is not None:
                close(self._dataset)
                self._dataset = source = None
            if self.driver == "COG":
                source = source or gdal.OpenEx(str(self._work), gdal.OF_RASTER, allowed_drivers=["GTiff"])
                options = [f"{k}={v}" for k, v in self.options.items()]
                driver, place = gdal.GetDriverByName("COG"), str(self._temporary)
                with called_by_gdal(self._advance) as advance:
                    close(driver.CreateCopy(place, source, options=options, callback=advance))
            self._dataset = None
        # GDAL omits empty blocks of a file larger than 4 GB.
        partly = self._written < self.grid.width * self.grid.height
        sparse = partly or self.options.get("SPARSE_OK", "NO").upper() in ("YES", "TRUE", "ON")
        check_written(self._temporary, self.path, size=(self.grid.width, self.grid.height), sparse=sparse)

    def _advance(self, share: float) -> None:
        if self._progress is not None:
            self._progress("Writing the COG", share)

    def scratch(self, name: str) -> Path:
        """Return the path of a temporary raster next to the output; it is removed together with that of the output."""
        return self._temporary.with_name(f"{self._temporary.name}.{name}.tif")

    def copy(self, path: Path) -> int:
        """Fill the raster from another of its size, whose last band is the mask; return the count of valid pixels."""
        dataset, count, step = gdal.OpenEx(str(path), gdal.OF_RASTER, allowed_drivers=["GTiff"]), 0, 2048
        for top in range(0, self.grid.height, step):
            for left in range(0, self.grid.width, step):
                size = min(step, self.grid.width - left), min(step, self.grid.height - top)
                pixels = dataset.ReadAsArray(left, top, *size).reshape(-1, size[1], size[0])
                if self.profile.validity == "nodata":
                    nodata = self.profile.nodata
                    empty = np.isnan(pixels) if nodata is not None and math.isnan(nodata) else pixels == nodata
                    valid = ~empty.all(axis=0)
                else:
                    valid = pixels[-1] > 0
                self.write(left, top, pixels[: self.profile.count].astype(self.profile.dtype, copy=False), valid)
                count += int(np.count_nonzero(valid))
        return count


def _describe(band: gdal.Band, profile: Profile, index: int) -> None:
    if profile.nodata is not None:
        band.SetNoDataValue(profile.nodata)
    if profile.descriptions:
        band.SetDescription(profile.descriptions[index])
    if profile.interpretations:
        band.SetColorInterpretation(profile.interpretations[index])
    if profile.color_table is not None and index == 0:
        band.SetColorTable(profile.color_table)
    if profile.scales and profile.scales[index] != (1.0, 0.0, ""):
        scale, offset, unit = profile.scales[index]
        band.SetScale(scale)
        band.SetOffset(offset)
        band.SetUnitType(unit)
