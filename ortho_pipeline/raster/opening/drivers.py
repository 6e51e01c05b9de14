"""GDAL's drivers: which may read a raster, and which one a file needs."""

from __future__ import annotations

import functools
import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from osgeo import gdal, osr

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import network_is_closed
from ortho_pipeline.files.shell import typed
from ortho_pipeline.raster.opening.environment import CHANGING, changes_reading

gdal.UseExceptions()

#: Raster drivers that only read pixels from their file (and its sidecars).
PLAIN = (
    "GTiff",
    "COG",
    "NITF",
    "JP2OpenJPEG",
    "JP2KAK",
    "JPEG",
    "PNG",
    "HFA",
    "ENVI",
    "PCRaster",
    "DTED",
    "SRTMHGT",
    "AAIGrid",
    "GTX",
    "NTv2",
    "EHdr",
    "BMP",
    "USGSDEM",
    "SGI",
    "BYN",
    "MEM",
)
#: Drivers whose headers name other files: each is used for a file whose names have been seen.
REFERRING = ("VRT", "DIMAP", "ERS", "ISIS3", "PCIDSK", "TIL")
DRIVERS = PLAIN + REFERRING
#: Raster drivers that send requests; a process of the command line does without them.
_FETCHING = (
    "WMS",
    "WMTS",
    "WCS",
    "HTTP",
    "OGCAPI",
    "PLMOSAIC",
    "PLSCENES",
    "STACTA",
    "STACIT",
    "EEDAI",
    "DAAS",
    "NGW",
    "MRF",
    "PostGISRaster",
    "GeoRaster",
    "Rasterlite",
    "RASDAMAN",
    "TileDB",
    "GTI",
    "Zarr",
    "netCDF",
    "JPIPKAK",
    "DODS",
)
#: Formats that a GDAL may have been built without, by the beginning of a file: wheels have fewer drivers.
_BEGINNINGS = {
    b"NITF": "NITF",
    b"EHFA_HEADER_TAG": "HFA",
    b"\x00\x00\x00\x0cjP": "JP2OpenJPEG",
    b"UHL1": "DTED",
    b"ncols": "AAIGrid",
}
_ENDINGS = {".til": "TIL", ".hgt": "SRTMHGT", ".ers": "ERS", ".pix": "PCIDSK"}
_BEGINNING = 4096
#: What outputs, reports and work in memory are written with.
_WRITING = ("GTiff", "COG", "VRT", "PNG", "MEM")
log = logging.getLogger(__name__)


@functools.cache
def remove_network_drivers() -> None:
    """Remove the drivers that send requests where the network is closed to this process."""
    if network_is_closed():
        for name in _FETCHING:
            driver = gdal.GetDriverByName(name)
            if driver is not None:
                driver.Deregister()


def see_to_reading_options() -> None:
    """Unset options that change what GDAL reads, such as those of a gdalrc file; other processes get a warning only."""
    for name in CHANGING:
        value = gdal.GetConfigOption(name)
        if not changes_reading(name, value):
            continue
        ours = network_is_closed()
        if ours:
            gdal.SetConfigOption(name, None)
        _warn_of_option(name, value, ours)


@functools.cache
def _warn_of_option(name: str, value: str, ours: bool) -> None:
    if ours:
        log.warning("GDAL's option %s=%s is ignored: it changes what GDAL reads", name, value)
    else:
        log.warning("GDAL's option %s=%s is set in this process: it changes what GDAL reads", name, value)


@functools.cache
def require_usable_gdal() -> None:
    """Refuse rasters if GDAL lacks a driver that every command may need, or cannot use the size of its cache.

    Raises
    ------
    InputError
    """
    missing = [name for name in _WRITING if gdal.GetDriverByName(name) is None]
    if missing:
        skipped = gdal.GetConfigOption("GDAL_SKIP")
        raise InputError(
            f"GDAL has no driver {', '.join(missing)}",
            field="GDAL_SKIP" if skipped else None,
            remedy=f"remove {', '.join(missing)} from GDAL's option GDAL_SKIP (now {skipped!r})"
            if skipped
            else f"use a GDAL that was built with it; this is {gdal.__version__}",
        )
    size = gdal.GetConfigOption("GDAL_CACHEMAX", "5%")
    try:
        gdal.GetCacheMax()
        usable = size.lstrip()[:1].isdigit()  # GDAL 3.6 takes other texts as 0
    except RuntimeError:
        usable = False
    if not usable:
        raise InputError(
            f"GDAL cannot use this size of its cache: {size}",
            field="GDAL_CACHEMAX",
            remedy="unset it, or give megabytes (512) or a share of the memory (5%)",
        )


@functools.cache
def require_proj_database() -> None:
    """Refuse rasters if GDAL does not find PROJ's database: it would lose height datums and misread systems.

    Raises
    ------
    InputError
    """
    gdal.PushErrorHandler("CPLQuietErrorHandler")
    try:
        known = osr.SpatialReference().ImportFromEPSG(4326) == 0
    except RuntimeError:
        known = False
    finally:
        gdal.PopErrorHandler()
    if not known:
        named = [name for name in ("PROJ_DATA", "PROJ_LIB") if os.environ.get(name)]
        raise InputError(
            "GDAL cannot use the database of PROJ (proj.db): it is missing, or of another version",
            file=os.environ[named[0]] if named else None,
            field=" and ".join(named) or "PROJ_DATA",
            remedy=f"remove the environment variable {' and '.join(named)}"
            if named
            else "set the environment variable PROJ_DATA to the folder of PROJ's proj.db, for example /usr/share/proj",
        )


def driver_for(path: Path) -> str | None:
    """Return the driver that a file needs by its name or beginning, None where these tell nothing."""
    try:
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING)
    except OSError:
        return None
    if b"<Dimap_Document" in beginning:
        return "DIMAP"
    known = (driver for start, driver in _BEGINNINGS.items() if beginning.startswith(start))
    return next(known, _ENDINGS.get(path.suffix.lower()))


def require_driver(name: str, file: Any) -> None:
    """Raise an `InputError` if this GDAL was built without a driver."""
    if gdal.GetDriverByName(name) is None:
        raise InputError(
            f"this file needs GDAL's driver {name}, but this GDAL ({gdal.__version__}) was built without it",
            file=file,
            remedy="use a GDAL that has it, such as the one of Debian or Ubuntu; or give a GeoTIFF "
            "(an image of the product, or one converted with gdal_translate)",
        )


def refuse_dataset_within(name: str) -> None:
    """Raise an `InputError` if GDAL so names a dataset within a file: ``GTIFF_DIR:2:scan.tif``, ``NETCDF:dem.nc:z``."""
    if re.match(r"[A-Z][A-Z0-9_]+:", name):
        raise InputError(
            "this is GDAL's name of a dataset within a file; only whole files are opened",
            file=name,
            remedy=f"extract the dataset: `gdal_translate {typed(name)} dataset.tif`",
        )


def identified(name: str, drivers: Sequence[str] | None) -> str | None:
    """Return the driver that takes a file first, among some or among all; GDAL reads its beginning only."""
    allowed = {} if drivers is None else {"allowed_drivers": list(drivers)}
    try:
        driver = gdal.IdentifyDriverEx(name, gdal.OF_RASTER, **allowed)
    except (RuntimeError, UnicodeDecodeError):
        return None
    return None if driver is None else str(driver.ShortName)
