"""Rasters that are read: what may be opened, grids, and windows of pixels.

The `gate` opens files by a list of drivers and checks linked files. `RasterSource` opens one dataset per thread.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import re
import stat
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.folders import listing
from ortho_pipeline.files.locations import AnyPath, Location, VsiPath, check_path, located, members
from ortho_pipeline.files.reading import why_no_file
from ortho_pipeline.files.shell import converted
from ortho_pipeline.raster.caching.block_cache import keep_blocks
from ortho_pipeline.raster.opening.drivers import DRIVERS, refuse_dataset_within
from ortho_pipeline.raster.opening.gate import DecodedUnit, open_seen
from ortho_pipeline.raster.pixel_types import check_types, mask_flags, nodata_of, numpy_type, read_type, valid_of
from ortho_pipeline.runtime.process_limits import require_memory
from ortho_pipeline.stores.objects import stated_at

gdal.UseExceptions()
log = logging.getLogger(__name__)

#: A raster side beyond this is taken for a damaged header.
MAX_SIDE = 4_000_000
#: GDAL reads whole blocks: one larger than this is refused before it is allocated (bytes).
MAX_BLOCK = 1 << 30
#: Default memory of reading and warping, in bytes.
MEMORY = 512_000_000
#: Endings of sidecars that GDAL's readers of metadata search.
_SIDE_CARS = re.compile(r"(?is).+\.(xml|txt|imd|rpb|pvl|met|att|eph|tfw|wld|prj|hdr|ovr|msk|rpc|dim)$")
_WHOLE = "give a complete raster in an allowed format ('ortho doctor' lists them), or copy it again"


def open_dataset(
    path: str | os.PathLike[str],
    *,
    allow_network: bool = False,
    roots: Sequence[str | os.PathLike[str]] = (),
    siblings: bool = True,
) -> gdal.Dataset:
    """Open a raster for reading.

    >>> open_dataset("sample_data/scene.tif").RasterXSize
    1000

    Parameters
    ----------
    path : path
        A file, also in an archive; URLs and GDAL's network file systems only with `allow_network`.
    roots : sequence of path
        Further folders in which files that this one refers to may be.
    siblings : bool
        Whether GDAL may read sidecar files. Without them RPC metadata are those of the file itself.

    Raises
    ------
    InputError
        If the file is missing, of no allowed format, damaged, or leads outside of its own folder and `roots`.
    OrthoError
        If there is too little memory for any work.
    """
    return _opened(path, allow_network, roots, siblings)[0]


def open_pixels(
    path: str | os.PathLike[str],
    *,
    allow_network: bool = False,
    roots: Sequence[str | os.PathLike[str]] = (),
    memory: int = MEMORY,
) -> tuple[gdal.Dataset, int]:
    """Open a raster whose pixels are going to be read; return it, and the bytes of its largest block.

    GDAL decodes whole blocks (a strip, a tile), and again and again what its cache cannot hold: a megabyte that unpacks
    to a strip of a gigabyte would keep it busy for minutes. So a block has to fit into `memory` (bytes), and the cache
    is made to hold it.

    Raises
    ------
    InputError
        As for `open_dataset`; and if a block of it, of its mask or of a file that it leads to does not fit.
    """
    dataset, block = _opened(path, allow_network, roots, True)
    if block.size > memory:
        raise InputError(
            f"one block of this raster needs {block.size / 1e6:,.0f} MB, more than the allowed "
            f"{memory / 1e6:,.0f} MB of memory",
            file=block.path,
            field="block size",
            remedy=Text(
                f"tile it: `gdal_translate -co TILED=YES {converted(block.path, 'tiled')}`; or for an image increase ",
                Setting("output.memory", "MB"),
            ),
        )
    keep_blocks(block.size)
    return dataset, block.size


@reads(_WHOLE)
def _opened(
    path: str | os.PathLike[str], allow_network: bool, roots: Sequence[str | os.PathLike[str]], siblings: bool
) -> tuple[gdal.Dataset, DecodedUnit]:
    require_memory()
    place = located(path, allow_network=allow_network)
    name, drivers = os.fspath(place), list(DRIVERS)
    if isinstance(place, VsiPath):
        drivers.remove("VRT")
        if Location(name).in_archive and not place.exists():
            raise InputError("there is no such file in the archive", file=name, remedy=_in_archive(name))
    elif not os.path.isfile(name) and not os.path.isdir(name):
        refuse_dataset_within(name)
        raise InputError(why_no_file(name), file=name, remedy=check_path(name))
    elif Path(name).suffix.lower() in (".zip", ".tar", ".tgz"):
        raise InputError("this is an archive, not an image", file=name, remedy=_in_archive(name))
    elif Path(name).suffix.lower() != ".vrt":
        drivers.remove("VRT")
    if siblings and not isinstance(place, VsiPath):
        _refuse_pipes(Path(name))
    try:
        dataset, block = open_seen(place, roots, drivers, siblings)
    except (RuntimeError, UnicodeDecodeError) as error:
        if Location(name).url.is_address:
            stated_at(Location(name).url, allow_network=allow_network)  # its error says more than GDAL's
        # What GDAL quotes of a damaged file need not be UTF-8.
        text, remedy = first_line(error), "give a raster in an allowed format ('ortho doctor' lists them)"
        if text.startswith("Range downloading not supported"):
            remedy = "download the file and give its path: this server sends no parts of files"
        raise InputError(f"GDAL cannot open this as a raster ({text})", file=name, remedy=remedy) from error
    _check_size(dataset, name)
    log.info("%s: opened by %s", name, dataset.GetDriver().ShortName)
    return dataset, block


def _refuse_pipes(path: Path) -> None:
    """Raise an `InputError` if metadata or a sidecar of an image is a pipe or a device: GDAL would wait for ever."""
    folder = path if path.is_dir() else path.parent
    with contextlib.suppress(OSError):
        files = listing(folder)
        related = {name for name in files.special if path.stem in name}
        related |= files.special.intersection(files.matching(_SIDE_CARS))
        for name in related - {path.name}:
            kind = 0
            with contextlib.suppress(OSError):  # a link that leads nowhere: there is nothing to read
                kind = stat.S_IFMT(os.stat(folder / name).st_mode)
            if kind in (stat.S_IFIFO, stat.S_IFCHR, stat.S_IFBLK):
                raise InputError(
                    "a pipe or a device is in the place of this image's metadata",
                    file=path,
                    field=name,
                    remedy="remove it",
                )


def _check_size(dataset: gdal.Dataset, name: str) -> None:
    width, height = dataset.RasterXSize, dataset.RasterYSize
    if dataset.RasterCount == 0:
        raise InputError("this file has no raster band", file=name)
    band = dataset.GetRasterBand(1)
    block = math.prod(band.GetBlockSize()) * gdal.GetDataTypeSize(band.DataType) // 8
    if max(width, height) > MAX_SIDE or block > MAX_BLOCK:
        raise InputError(
            f"the header states {width} x {height} pixels in blocks of {block} bytes",
            file=name,
            remedy=f"copy the file again, or tile it: `gdal_translate -co TILED=YES {converted(name, 'tiled')}`",
        )


def _in_archive(name: str) -> str:
    archive = Location(name).archive if name.startswith("/vsi") else Path(name)
    names = members(archive) if archive is not None else []
    return f"name the image in it: {', '.join(names)}" if names else "name the image in it: /vsizip/FILE.zip/IMAGE"


def first_line(error: BaseException, of: object = "") -> str:
    """Return the first line of an error's text, without the name of the file `of` it and without a full stop."""
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0].removeprefix(str(of)).removeprefix(Path(str(of)).name).lstrip(",: ").rstrip(". ") or lines[0]


@dataclass(frozen=True, eq=False)
class Grid:
    """North-up pixel grid of an output raster.

    Parameters
    ----------
    left, top : float
        Map coordinates of the outer corner of the first pixel, in units of `crs`.
    dx, dy : float
        Size of a pixel (positive), in units of `crs`.
    width, height : int
        Number of columns and rows.

    Examples
    --------
    >>> grid = Grid(parse_crs("EPSG:32636"), 500_000.0, 4_100_000.0, 2.0, 2.0, 100, 50)
    >>> grid.extent
    (500000.0, 4099900.0, 500200.0, 4100000.0)
    """

    crs: pyproj.CRS
    left: float
    top: float
    dx: float
    dy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if not (self.dx > 0 and self.dy > 0 and math.isfinite(self.left) and math.isfinite(self.top)):
            raise InputError("the pixel size must be positive", field="resolution")
        if not (0 < self.width <= MAX_SIDE and 0 < self.height <= MAX_SIDE):
            raise InputError(
                f"the output would have {self.width} x {self.height} pixels",
                field="extent",
                remedy="check the extent and the resolution, which are in units of the output CRS",
            )

    @classmethod
    def of_extent(
        cls, crs: pyproj.CRS, extent: Sequence[float], resolution: tuple[float, float], *, align: bool = False
    ) -> Grid:
        """Return the grid of an extent (xmin, ymin, xmax, ymax), widened to multiples of the resolution if `align`."""
        xmin, ymin, xmax, ymax = (float(value) for value in extent)
        dx, dy = resolution
        if not (0 < dx < 1e12 and 0 < dy < 1e12):
            raise InputError(
                f"{dx:g} x {dy:g} is not a pixel size", field="resolution", remedy="give a positive resolution"
            )
        # Beyond that many pixels from the origin a number does not tell one pixel from the next.
        if not (xmin < xmax and ymin < ymax and max(map(abs, (xmin, ymin, xmax, ymax))) / min(dx, dy) < 2**52):
            raise InputError(
                f"{xmin:.12g} {ymin:.12g} {xmax:.12g} {ymax:.12g} is not an extent",
                field="extent",
                remedy="give xmin ymin xmax ymax",
            )
        if align:
            # A hair of tolerance keeps an extent that is already aligned from growing by a pixel of rounding.
            xmin, ymin = math.floor(xmin / dx + 1e-6) * dx, math.floor(ymin / dy + 1e-6) * dy
            xmax, ymax = math.ceil(xmax / dx - 1e-6) * dx, math.ceil(ymax / dy - 1e-6) * dy
        # As GDAL rounds; Python's round() takes halves to even numbers.
        width, height = max(1, int((xmax - xmin) / dx + 0.5)), max(1, int((ymax - ymin) / dy + 0.5))
        return cls(crs, xmin, ymax, dx, dy, width, height)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Map coordinates of the outer edges: xmin, ymin, xmax, ymax."""
        return self.left, self.top - self.height * self.dy, self.left + self.width * self.dx, self.top

    @property
    def geotransform(self) -> tuple[float, float, float, float, float, float]:
        """The six numbers of GDAL's geotransform."""
        return self.left, self.dx, 0.0, self.top, 0.0, -self.dy

    def xy(self, columns: NDArray[Any], rows: NDArray[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return map coordinates of pixel positions. The centre of the first pixel is (0.5, 0.5)."""
        return self.left + np.asarray(columns) * self.dx, self.top - np.asarray(rows) * self.dy


class _RasterFile:
    """Some or all bands of one file of a `RasterSource`, with a GDAL handle for each thread."""

    def __init__(
        self, path: str | os.PathLike[str], access: Mapping[str, Any], numbers: Sequence[int] | None = None
    ) -> None:
        self.path = os.fspath(path)
        # A place that is no file of this machine was allowed when it was located; its name alone is not.
        self.place = path if isinstance(path, VsiPath) else self.path
        self._access = access
        self._local = threading.local()
        dataset = self.dataset
        self.width, self.height = dataset.RasterXSize, dataset.RasterYSize
        self.numbers = tuple(numbers or range(1, dataset.RasterCount + 1))
        self.count = len(self.numbers)
        bands = self.bands
        check_types(bands, self.path)
        self.dtype = np.result_type(*(numpy_type(band.DataType) for band in bands))
        self.nodata = tuple(nodata_of(band, self.dtype) for band in bands)
        self.palette = any(band.GetColorTable() is not None for band in bands)
        every = [self._io(mask_flags, band) for band in bands]
        # The mask of alpha is that of the other bands: an alpha band has none itself.
        lead = next((k for k, flags in enumerate(every) if flags & gdal.GMF_PER_DATASET), 0)
        flags, own = every[lead], 0 in every  # 0: a mask of this band alone
        self._mask_numbers = self.numbers if own else self.numbers[lead : lead + 1]
        # GDAL's own order: a mask of the dataset counts in addition to nodata.
        masked = flags & gdal.GMF_PER_DATASET and not flags & (gdal.GMF_NODATA | gdal.GMF_ALPHA)
        self._masked = own or bool(masked)
        if any(value is not None for value in self.nodata):
            self.validity = "nodata"
        elif flags & gdal.GMF_ALPHA:
            # To GDAL alpha is the last of two or four bands; an ortho of other bands needs a mask.
            kept = len(bands) in (2, 4) and bands[-1].GetColorInterpretation() == gdal.GCI_AlphaBand
            self.validity = "alpha" if kept else "mask"
        else:
            self.validity = "mask" if own or flags & gdal.GMF_PER_DATASET else "all"

    @property
    def dataset(self) -> gdal.Dataset:
        """The GDAL dataset of the calling thread."""
        if not hasattr(self._local, "dataset"):
            self._local.dataset, self.block = open_pixels(self.place, **self._access)
        return self._local.dataset

    @property
    def bands(self) -> list[gdal.Band]:
        """The GDAL bands of the calling thread."""
        return [self.dataset.GetRasterBand(number) for number in self.numbers]

    def read(self, left: int, top: int, out: NDArray[Any]) -> None:
        """Fill `out` ``(count, height, width)`` with a window inside the raster."""
        arguments = {"buf_obj": out, "band_list": list(self.numbers)}
        self._io(self.dataset.ReadAsArray, left, top, out.shape[2], out.shape[1], **arguments)

    def read_valid(self, left: int, top: int, pixels: NDArray[Any]) -> NDArray[np.bool_] | None:
        """Return which of the `pixels` of a window ``(count, h, w)`` are valid; None where all are."""
        _, height, width = pixels.shape
        valid = None
        if self.validity == "nodata":
            valid = np.ones(pixels.shape, dtype=bool)
            for band, value in enumerate(self.nodata):
                if value is not None and not math.isnan(value):
                    np.not_equal(pixels[band], pixels.dtype.type(value), out=valid[band])
        if self._masked or self.validity in ("mask", "alpha"):
            masked = [self.dataset.GetRasterBand(number) for number in self._mask_numbers]
            mask = np.stack([self._io(valid_of, band, left, top, width, height) for band in masked])
            valid = np.broadcast_to(mask, pixels.shape).copy() if valid is None else valid & mask
        if pixels.dtype.kind == "f":
            numbers = ~np.isnan(pixels)
            if not numbers.all():
                valid = numbers if valid is None else valid & numbers
        return None if valid is None or valid.all() else valid

    def _io(self, read: Any, *window: int, **options: Any) -> Any:
        try:
            return read(*window, **options)
        except RuntimeError as error:
            raise InputError(
                f"the pixels cannot be read ({first_line(error, self.path)})",
                file=self.path,
                remedy="the file is cut off or damaged: copy it again",
            ) from error


class RasterSource:
    """A raster in one or several files. Several threads may read windows of it at the same time.

    Vendors often deliver a file for each band. Files of the same size are one source: the geometry of their bands
    is computed once.

    Parameters
    ----------
    path, *others : path
        The files, in the order of their bands.
    bands : sequence of int, optional
        Bands to read, in this order, counted from 1 over all files. Default: all.
    dtype : str, optional
        Pixel type of the ortho, by GDAL's name. Pixels of another type are read as floating point that holds both, so
        interpolated values are rounded and clamped only once, when they are written.
    memory : int
        Largest allowed size of a block in bytes; see `open_pixels`.

    Attributes
    ----------
    width, height, count : int
    dtype : numpy.dtype
        Common type of all bands when they are read.
    nodata : tuple of float or None, per band
    validity : {'all', 'nodata', 'mask', 'alpha'}
        How the raster marks its valid pixels. NaN is never valid.
    block : int
        Bytes that GDAL decodes at once to read one pixel of all bands.

    Raises
    ------
    InputError
        If a file cannot be used, differs in size from the first, or has no such band.

    Examples
    --------
    >>> RasterSource("sample_data/scene.tif").read(0, 0, 4, 2).shape
    (1, 2, 4)
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *others: str | os.PathLike[str],
        allow_network: bool = False,
        roots: Sequence[str | os.PathLike[str]] = (),
        bands: Sequence[int] | None = None,
        dtype: str | None = None,
        memory: int = MEMORY,
    ) -> None:
        access = {"allow_network": allow_network, "roots": roots, "memory": memory}
        self._files = [_RasterFile(name, access) for name in (path, *others)]
        first = self._files[0]
        self.paths = tuple(file.path for file in self._files)
        self.path, self.width, self.height = first.path, first.width, first.height
        for file in self._files:
            if (file.width, file.height) != (self.width, self.height):
                raise InputError(
                    f"{file.width} x {file.height} pixels, but {self.path} has {self.width} x {self.height}",
                    file=file.path,
                    remedy="rectify images of different sizes one by one",
                )
        if bands is not None:
            self._files = [_RasterFile(name, access, numbers) for name, numbers in self._chosen(bands)]
        self.count = sum(file.count for file in self._files)
        self.dtype = read_type(np.result_type(*(file.dtype for file in self._files)), dtype)
        self.nodata = tuple(value for file in self._files for value in file.nodata)
        self.palette = any(file.palette for file in self._files)
        self.block = sum(file.block for file in self._files)
        kinds = {file.validity for file in self._files}
        self.validity = kinds.pop() if len(kinds) == 1 and (len(self._files) == 1 or kinds != {"alpha"}) else "mask"

    def _chosen(self, bands: Sequence[int]) -> list[tuple[AnyPath, list[int]]]:
        """Return the files, in the order wanted, with the numbers of their bands; a file may come twice."""
        places = [(file.place, number) for file in self._files for number in file.numbers]
        chosen: list[tuple[AnyPath, list[int]]] = []
        for band in bands:
            if not 1 <= band <= len(places):
                raise InputError(
                    f"there is no band {band}: the image has {len(places)}",
                    file=self.path,
                    field="output.bands",
                    remedy=f"give one from 1 to {len(places)}",
                )
            path, number = places[band - 1]
            if chosen and chosen[-1][0] == path:
                chosen[-1][1].append(number)
            else:
                chosen.append((path, [number]))
        return chosen

    @property
    def dataset(self) -> gdal.Dataset:
        """The GDAL dataset of the first file for the calling thread."""
        return self._files[0].dataset

    @property
    def bands(self) -> list[gdal.Band]:
        """The GDAL bands of the calling thread."""
        return [band for file in self._files for band in file.bands]

    @property
    def band_numbers(self) -> tuple[int, ...]:
        """Numbers of the bands in the first file."""
        return self._files[0].numbers

    @property
    def descriptions(self) -> tuple[str, ...]:
        """Names of the bands. With several files, a band without a name has the name of its file."""
        several = len(self.paths) > 1
        return tuple(
            band.GetDescription() or (Path(file.path).stem if several else "")
            for file in self._files
            for band in file.bands
        )

    def read(self, left: int, top: int, width: int, height: int) -> NDArray[Any]:
        """Return the pixels ``(count, height, width)`` of a window inside the raster."""
        pixels, start = np.empty((self.count, height, width), self.dtype), 0
        for file in self._files:
            file.read(left, top, pixels[start : start + file.count])
            start += file.count
        return pixels

    def read_valid(self, left: int, top: int, pixels: NDArray[Any]) -> NDArray[np.bool_] | None:
        """Return which of the `pixels` of a window ``(count, h, w)`` are valid; None where all are."""
        if len(self._files) == 1:
            return self._files[0].read_valid(left, top, pixels)
        valid, start = None, 0
        for file in self._files:
            stop = start + file.count
            part = file.read_valid(left, top, pixels[start:stop])
            if part is not None:
                valid = np.ones(pixels.shape, dtype=bool) if valid is None else valid
                valid[start:stop] = part
            start = stop
        return valid
