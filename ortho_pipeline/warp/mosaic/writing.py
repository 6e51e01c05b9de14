"""The mosaic as a file: a VRT that refers to its orthos, or a COG, written window by window."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile, RasterWriter, as_written, keep_off_nodata, value_range
from ortho_pipeline.raster.source import MEMORY, RasterSource
from ortho_pipeline.raster.verified_writing import raster_output, written
from ortho_pipeline.warp.mosaic.balance import Balance
from ortho_pipeline.warp.mosaic.layout import Mosaic, box_of, circular_errors, intersection, windows
from ortho_pipeline.warp.mosaic.reading import Opened, open_layers
from ortho_pipeline.warp.mosaic.seamlines import Owners

#: Side of the windows in which a mosaic is written.
_WINDOW = 2048


def write_vrt(placed: Mosaic, path: Path) -> None:
    """Write the mosaic as a VRT that refers to the orthos by relative paths; they must be below its folder.

    Raises
    ------
    InputError
        If GDAL leaves an ortho out.
    """
    if placed.by_pixel:
        raise InputError(
            "a VRT cannot choose between orthos pixel by pixel", file=path, field="mosaic.format", remedy="write a COG"
        )
    names = [str(layer.ortho.path) for layer in reversed(placed.layers)]
    source = RasterSource(placed.layers[0].ortho.path)
    # GDAL takes NaN for a value unless it is the nodata value.
    empty = {"srcNodata": "nan"} if source.validity == "all" and source.dtype.kind == "f" else {}
    with raster_output(path) as temporary:
        vrt = gdal.BuildVRT(
            str(temporary),
            names,
            outputBounds=placed.grid.extent,
            xRes=placed.grid.dx,
            yRes=placed.grid.dy,
            resolution="user",
            **empty,
        )
        with written(vrt) as dataset:
            for number, band in enumerate(source.bands, 1):
                dataset.GetRasterBand(number).SetDescription(band.GetDescription())
                dataset.GetRasterBand(number).SetUnitType(band.GetUnitType())
            size = dataset.RasterXSize, dataset.RasterYSize
            listed = {Path(name).resolve() for name in dataset.GetFileList()}
        missing = [layer.ortho.name for layer in placed.layers if layer.ortho.path.resolve() not in listed]
        if missing or size != (placed.grid.width, placed.grid.height):
            raise InputError(
                f"a VRT of GDAL would lose {', '.join(missing) or 'pixels'}", file=path, remedy="write a COG"
            )


def write_cog(
    placed: Mosaic,
    path: Path,
    *,
    owners: Owners | None = None,
    balance: Balance | None = None,
    memory: int = MEMORY,
    threads: int = 1,
) -> float:
    """Write the mosaic as a COG, window by window; return the share of its pixels that had to be clamped.

    Parameters
    ----------
    owners : Owners, optional
        Which ortho a pixel is taken from, if that has a value there; else and without, as the order has it.
    balance : Balance, optional
        What becomes of the pixels of each ortho; they are taken over as they are without.
    """
    opened = open_layers(placed, memory)
    profile, grid = Profile.of(opened[0].source), placed.grid
    fill = value_range(profile.dtype, profile)[3]
    clamped = shown = 0
    # Where the pixels of the orthos are not mixed, such as classes, overviews do not mix them either.
    apart = all(layer.ortho.resampling == "nearest" for layer in placed.layers)
    layout = {"OVERVIEW_RESAMPLING": "NEAREST"} if apart else {}
    with RasterWriter(path, grid, profile, creation_options=layout, threads=threads) as writer:
        for left, top, width, height in windows(grid, _WINDOW):
            window = _Window(
                left,
                top,
                np.full((profile.count, height, width), fill, dtype=profile.dtype),
                np.zeros((profile.count, height, width), dtype=bool),
                None if owners is None else owners.window(left, top, width, height),
                np.full((profile.count, height, width), np.inf, dtype=np.float32)
                if owners is not None or placed.by_pixel
                else None,
            )
            for number, raster in enumerate(opened):
                clamped += window.put(number, raster, balance, profile, by_pixel=placed.by_pixel)
            shown += int(np.count_nonzero(window.valid))
            writer.write(left, top, window.pixels, profile.mask_of(window.valid))
    return clamped / max(shown, 1)


@dataclass(frozen=True, eq=False)
class _Window:
    """A window of the mosaic in the making: its pixels, and which of them are valid.

    Where an ortho is chosen for each pixel, it also has the wanted ortho of each pixel, and the rank ``(bands, h, w)``
    of the ortho that each pixel is from.
    """

    left: int
    top: int
    pixels: NDArray[Any]
    valid: NDArray[np.bool_]
    owners: NDArray[np.int16] | None
    best: NDArray[np.float32] | None

    def put(self, number: int, raster: Opened, balance: Balance | None, profile: Profile, *, by_pixel: bool) -> int:
        """Take from an ortho what has no value yet, or a worse rank; return how many values were clamped."""
        _, height, width = self.pixels.shape
        box = intersection((self.left, self.top, self.left + width, self.top + height), box_of(raster.layer))
        if box is None:
            return 0
        part = (slice(box[1] - self.top, box[3] - self.top), slice(box[0] - self.left, box[2] - self.left))
        place = (slice(None), *part)
        if self.best is None and self.valid[place].all():
            return 0
        values, good = raster.read(box)
        if self.best is None:
            new = ~self.valid[place] & good
        else:
            rank = np.full(values.shape[1:], number, dtype=np.float32)
            if by_pixel:
                there = box[0] - raster.layer.left, box[1] - raster.layer.top
                rank = circular_errors(raster.layer, *there, box[2] - box[0], box[3] - box[1])
            if self.owners is not None:
                rank[self.owners[part] == number] = -1.0
            # Band by band: what one band of the better ortho lacks, another ortho may have.
            new = good & (rank < self.best[place])
            np.copyto(self.best[place], rank, where=new)
        clamped = 0
        if balance is not None:
            values, clamped = _balanced(balance, number, values, good, new, profile)
        self.pixels[place] = np.where(new, values, self.pixels[place])
        self.valid[place] |= new
        return clamped


def _balanced(
    balance: Balance,
    number: int,
    values: NDArray[Any],
    good: NDArray[np.bool_],
    new: NDArray[np.bool_],
    profile: Profile,
) -> tuple[NDArray[Any], int]:
    """Return pixels of an ortho as they are in the mosaic, and how many that are new were clamped."""
    exact = balance.apply(number, np.where(good, values, 0).astype(np.float64))
    low, high, _, fill = value_range(profile.dtype, profile)
    beyond = int(np.count_nonzero(((exact < low - 0.5) | (exact > high + 0.5)) & new))
    written = as_written(exact, good, profile.dtype, fill)
    if profile.validity == "nodata":
        keep_off_nodata(written, good, fill, low)
    return written, beyond
