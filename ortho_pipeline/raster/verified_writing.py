"""Writing rasters: every file of pixels is closed, opened again and looked through before it gets its name.

GDAL tells of a full disk late, some of it only when a dataset is closed, where Python would swallow it, and a GeoTIFF
whose end is missing opens like any other. So a dataset is closed by `close`, which raises, and `check_written` asks for
the place of every block in the file and reads some of them.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import retire, whole_or_nothing
from ortho_pipeline.files.locations import VsiPath
from ortho_pipeline.raster.source import first_line, open_dataset

#: Files of statistics, overviews and masks, after the whole name of a raster: GDAL attaches them to it.
ATTACHED = (".aux.xml", ".ovr", ".msk")
#: Blocks of a file that are read again before it gets its name.
_SAMPLES = 12


# -- any raster ------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def raster_output(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path for a raster that GDAL writes; the raster appears at `path` when it is complete.

    Close it with `close` or `written` within the block. Masks are written into the file itself. Statistics, overviews
    and masks of a raster that was there before go with it.

    Raises
    ------
    InputError
        If it cannot be written, or cannot be read again.
    """
    with whole_or_nothing(path) as temporary:
        retire_attached(path)
        with gdal_errors(path):
            yield temporary
        if temporary.suffix.lower() != ".vrt":
            check_written(temporary, path)


def retire_attached(path: str | os.PathLike[str]) -> None:
    """Let statistics, overviews and masks go when the raster that is being written gets its name: they are old."""
    retire(f"{os.fspath(path)}{ending}" for ending in ATTACHED)


@contextlib.contextmanager
def gdal_errors(path: str | os.PathLike[str]) -> Iterator[None]:
    """Turn GDAL's complaints about writing `path` into an `InputError`; masks go into the file itself."""
    previous = gdal.GetThreadLocalConfigOption("GDAL_TIFF_INTERNAL_MASK")
    gdal.SetThreadLocalConfigOption("GDAL_TIFF_INTERNAL_MASK", "YES")
    try:
        yield
    except RuntimeError as error:
        raise InputError(
            f"the output cannot be written ({first_line(error)})",
            file=path,
            remedy="check the free disk space and the creation options",
        ) from error
    finally:
        gdal.SetThreadLocalConfigOption("GDAL_TIFF_INTERNAL_MASK", previous)


def close(dataset: gdal.Dataset | None) -> None:
    """Close a dataset that was written; it cannot be used afterwards.

    Raises
    ------
    RuntimeError
        If GDAL could not write the rest (Python would ignore this if the dataset were only deleted), or could not
        create the dataset (some drivers then return None).
    """
    if dataset is None:
        raise RuntimeError(gdal.GetLastErrorMsg() or "GDAL could not create the file")
    try:
        dataset.FlushCache()
    except RuntimeError:
        abandon(dataset)
        raise
    _destroy(dataset)


@contextlib.contextmanager
def written(dataset: gdal.Dataset | None) -> Iterator[gdal.Dataset]:
    """Yield a new dataset to be filled; close it when the block ends well, and throw it away when it does not.

    A dataset that an exception leaves behind would be closed by Python, which prints what GDAL cannot write then.

    Raises
    ------
    RuntimeError
        As `close`.
    """
    if dataset is None:
        close(None)
    try:
        yield dataset
    except BaseException:
        abandon(dataset)
        raise
    close(dataset)


def abandon(dataset: gdal.Dataset | None) -> None:
    """Close a dataset whose file is thrown away: what GDAL cannot write any more is nothing to tell."""
    if dataset is not None:
        with contextlib.suppress(RuntimeError):
            _destroy(dataset)


def _destroy(dataset: gdal.Dataset) -> None:
    if hasattr(dataset, "Close"):  # GDAL 3.8
        dataset.Close()
    else:
        gdal.Dataset.__swig_destroy__(dataset)


def png_bytes(pixels: NDArray[np.uint8]) -> bytes:
    """Encode pixels ``(bands, rows, columns)`` as PNG: one band is grey, three are RGB; one more is alpha."""
    count, rows, columns = pixels.shape
    memory = gdal.GetDriverByName("MEM").Create("", columns, rows, count, gdal.GDT_Byte)
    memory.WriteArray(pixels)
    path = f"/vsimem/ortho_png_{secrets.token_hex(8)}.png"
    try:
        # More effort takes twice (4) to six times (6) as long, and makes such a picture 6 % smaller.
        close(gdal.GetDriverByName("PNG").CreateCopy(path, memory, options=["ZLEVEL=2"]))
        return VsiPath(path).read_bytes()
    finally:
        gdal.Unlink(path)


def check_written(
    written: Path, path: str | os.PathLike[str], *, size: tuple[int, int] | None = None, sparse: bool = False
) -> None:
    """Check that a GeoTIFF has all of its blocks: their offsets in the file, and some blocks by reading.

    Parameters
    ----------
    written, path : path
        Its present path, and the path for errors.
    size : (int, int), optional
        Required columns and rows.
    sparse : bool
        Whether blocks without a value may be absent.

    Raises
    ------
    InputError
        If it is incomplete.
    """
    context: dict[str, Any] = {"file": path, "remedy": "check the free disk space"}
    try:
        dataset = gdal.OpenEx(os.fspath(written), gdal.OF_RASTER, allowed_drivers=["GTiff"], sibling_files=[])
        if size is not None and (dataset.RasterXSize, dataset.RasterYSize) != size:
            raise InputError("the output is incomplete", **context)
        end = written.stat().st_size
        for band in _images(dataset):
            blocks = _blocks(band)
            if any(offset + count > end or not (count or sparse) for offset, count, _, _ in blocks):
                raise InputError("the output is incomplete", **context)
            # The last in the file, and some from everywhere.
            sample = {max(blocks), *blocks[:: max(1, len(blocks) // _SAMPLES)]}
            width, height = band.GetBlockSize()
            for _, count, column, row in sample:
                if count:
                    left, top = column * width, row * height
                    band.ReadRaster(left, top, min(width, band.XSize - left), min(height, band.YSize - top))
    except RuntimeError as error:
        raise InputError(f"the output cannot be read back ({first_line(error)})", **context) from error


# -- whole files ------------------------------------------------------------------------------------------------------


def require_whole(path: str | os.PathLike[str], **access: Any) -> None:
    """Refuse a truncated raster on disk; a file that is not a raster is accepted.

    For a GeoTIFF the offset of every block is checked, and no pixel is read. For other formats the last block is read.

    Parameters
    ----------
    access : dict
        Arguments of `raster.source.open_dataset`.

    Raises
    ------
    InputError
        If the file is truncated.
    """
    try:
        dataset = open_dataset(path, **access)
    except InputError:
        return
    context: dict[str, Any] = {"file": path, "remedy": "copy or download it again"}
    if dataset.GetDriver().ShortName == "GTiff":
        end = os.path.getsize(path)
        for band in _images(dataset):
            if any(offset + count > end for offset, count, _, _ in _blocks(band)):
                raise InputError("the file is truncated: some pixels are missing", **context)
        return
    band = dataset.GetRasterBand(dataset.RasterCount)
    width, height = band.GetBlockSize()
    left, top = (band.XSize - 1) // width * width, (band.YSize - 1) // height * height
    try:
        band.ReadRaster(left, top, band.XSize - left, band.YSize - top)
    except RuntimeError as error:
        raise InputError(
            f"the file is damaged: its last pixels cannot be read ({first_line(error)})", **context
        ) from error


def _images(dataset: gdal.Dataset) -> Iterator[gdal.Band]:
    """Yield a band of every image in a file: bands that are stored apart, overviews, mask."""
    apart = dataset.GetMetadataItem("INTERLEAVE", "IMAGE_STRUCTURE") == "BAND"
    for index in range(dataset.RasterCount if apart else 1):
        band = dataset.GetRasterBand(index + 1)
        yield band
        yield from (band.GetOverview(k) for k in range(band.GetOverviewCount()))
    if dataset.GetRasterBand(1).GetMaskFlags() == gdal.GMF_PER_DATASET:
        mask = dataset.GetRasterBand(1).GetMaskBand()
        yield mask
        yield from (mask.GetOverview(k) for k in range(mask.GetOverviewCount()))


def _blocks(band: gdal.Band) -> list[tuple[int, int, int, int]]:
    """Return offset and count of bytes, column and row of each block; an absent one has 0 bytes at 0."""
    width, height = band.GetBlockSize()
    blocks = []
    for row in range(math.ceil(band.YSize / height)):
        for column in range(math.ceil(band.XSize / width)):
            place = f"{column}_{row}"
            offset, count = (band.GetMetadataItem(f"BLOCK_{what}_{place}", "TIFF") for what in ("OFFSET", "SIZE"))
            blocks.append((int(offset or 0), int(count or 0), column, row))
    return blocks


# -- creation options --------------------------------------------------------------------------------------------------

#: Creation options for the layout of a file. Others name files and addresses, or change the grid or CRS of the ortho.
_LAYOUT = frozenset(
    re.findall(
        r"\S+",
        """
        COMPRESS OVERVIEW_COMPRESS PREDICTOR OVERVIEW_PREDICTOR LEVEL QUALITY OVERVIEW_QUALITY ZLEVEL ZSTD_LEVEL
        LZMA_PRESET DISCARD_LSB JPEG_QUALITY JPEGTABLESMODE WEBP_LEVEL WEBP_LOSSLESS MAX_Z_ERROR MAX_Z_ERROR_OVERVIEW
        JXL_LOSSLESS JXL_LOSSLESS_COPY JXL_EFFORT JXL_DISTANCE JXL_ALPHA_DISTANCE NBITS INTERLEAVE PIXELTYPE ENDIANNESS
        TILED BLOCKXSIZE BLOCKYSIZE BLOCKSIZE BIGTIFF SPARSE_OK NUM_THREADS PHOTOMETRIC ALPHA PROFILE TFW
        GEOTIFF_KEYS_FLAVOR GEOTIFF_VERSION RESAMPLING OVERVIEW_RESAMPLING OVERVIEWS OVERVIEW_COUNT STATISTICS
        """,
    )
)
#: Values of options with others of which GDAL writes a part of the metadata to a second file, or not at all.
_COMPLETE = {"PROFILE": ("GDALGEOTIFF",), "TFW": ("NO", "FALSE", "OFF", "0")}
_PLAIN_VALUE = re.compile(r"[\w.,+-]{1,80}")


def checked_options(driver: str, chosen: dict[str, str], threads: int, side: int = 512) -> dict[str, str]:
    """Return lossless defaults, a `side` of blocks, under what the user gave; what no driver knows is an error."""
    chosen = {key.upper(): value for key, value in chosen.items()}
    known = _known_options(driver)
    for key, value in chosen.items():
        if key not in known:
            meant = difflib.get_close_matches(key, known, 1)
            raise InputError(
                f"the {driver} driver has no creation option {key}",
                field="creation option",
                remedy=f"did you mean {meant[0]}?" if meant else f"see the {driver} driver in GDAL's documentation",
            )
        if key not in _LAYOUT:
            raise InputError(
                f"the creation option {key} is not allowed: it changes more than the layout of the file",
                field="creation option",
                remedy=Text(
                    "set the grid and CRS of an ortho with ",
                    Setting("output.crs"),
                    " and ",
                    Setting("output.resolution"),
                ),
            )
        if not _PLAIN_VALUE.fullmatch(value) or not _fits(known[key], value):
            values = ", ".join(choice.text or "" for choice in known[key].findall("Value")) or known[key].get("type")
            raise InputError(
                f"{value[:60]!r} is not a value of the creation option {key}",
                field="creation option",
                remedy=f"{key} takes: {values}",
            )
        if key in _COMPLETE and value.upper() not in _COMPLETE[key]:
            raise InputError(
                f"the creation option {key}={value} is not allowed: the ortho has all metadata in its own file",
                field="creation option",
                remedy=f"leave out {key}",
            )
    defaults = {"BIGTIFF": "IF_SAFER"}
    if driver == "GTiff":
        defaults |= {"TILED": "YES", "BLOCKXSIZE": str(side), "BLOCKYSIZE": str(side)}
        if chosen.get("TILED", "YES").upper() == "NO":
            defaults = {"BIGTIFF": "IF_SAFER"}
    else:
        defaults |= {"COMPRESS": "DEFLATE", "PREDICTOR": "YES", "LEVEL": "6", "NUM_THREADS": str(max(1, threads))}
        if chosen.get("COMPRESS", "DEFLATE").upper() not in ("DEFLATE", "ZSTD", "LZW"):
            defaults.pop("PREDICTOR")
            defaults.pop("LEVEL")
    return defaults | chosen


def require_writable(driver: str, options: Mapping[str, str], count: int, code: int) -> None:
    """Refuse creation options with which so many bands of a pixel type cannot be written: write a pixel, in memory.

    GDAL's threads lose the text of an error, and it would come after all the work.

    Raises
    ------
    InputError
        With GDAL's reason.
    """
    place = VsiPath(f"/vsimem/ortho_options_{secrets.token_hex(8)}.tif")
    # A pixel has no overviews.
    left_out = ("NUM_THREADS", "OVERVIEWS", "OVERVIEW_COUNT")
    alone = [f"{key}={value}" for key, value in options.items() if key not in left_out]
    try:
        if driver == "GTiff":
            pixel = gdal.GetDriverByName(driver).Create(str(place), 1, 1, count, code, alone)
            for number in range(1, count + 1):
                pixel.GetRasterBand(number).Fill(1)
        else:
            memory = gdal.GetDriverByName("MEM").Create("", 1, 1, count, code)
            pixel = gdal.GetDriverByName(driver).CreateCopy(str(place), memory, options=alone)
        close(pixel)
    except RuntimeError as error:
        raise InputError(
            f"GDAL cannot write {counted(count, 'band')} of {gdal.GetDataTypeName(code)} with these creation options "
            f"({first_line(error).replace(f'{place}: ', '').replace(f'{place.name}: ', '')})",
            field="creation option",
            remedy="correct the creation options, or leave them out",
        ) from error
    finally:
        with contextlib.suppress(RuntimeError):  # there may be no file
            gdal.Unlink(str(place))


def _known_options(driver: str) -> dict[str, Any]:
    """Return the creation options that a driver of this GDAL tells of, as XML elements, by their names."""
    from defusedxml import ElementTree

    listed = gdal.GetDriverByName(driver).GetMetadataItem("DMD_CREATIONOPTIONLIST") or "<CreationOptionList/>"
    return {option.get("name", "").upper(): option for option in ElementTree.fromstring(listed).iter("Option")}


def _fits(option: Any, value: str) -> bool:
    """Return whether a creation option accepts a value; GDAL itself only warns, and uses its default."""
    kind = (option.get("type") or "string").lower()
    if kind == "string-select":
        names = {name for one in option.findall("Value") for name in (one.text, one.get("alias")) if name}
        return not names or value.upper() in {name.upper() for name in names}
    if kind == "boolean":
        return value.upper() in ("YES", "NO", "TRUE", "FALSE", "ON", "OFF", "1", "0")
    if kind in ("int", "integer", "unsigned int", "float"):
        try:
            number = float(value) if kind == "float" else int(value)
        except ValueError:
            return False
        return float(option.get("min", "-inf")) <= number <= float(option.get("max", "inf"))
    return True
