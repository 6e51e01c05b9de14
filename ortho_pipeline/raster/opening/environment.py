"""Options of GDAL by which it reads other pixels, heights or places from the same files."""

from __future__ import annotations

import logging
import os

#: Without them GDAL reads what the files state, and reports what it cannot read. With GDAL's default, if there is one.
CHANGING = {
    "CONVERT_YCBCR_TO_RGB": True,  # colours
    "DTED_APPLY_PIXEL_IS_POINT": False,  # half a pixel
    "GDAL_DISABLE_READDIR_ON_OPEN": False,  # masks, RPCs, nodata values next to an image
    "GDAL_GEOREF_SOURCES": None,  # CRS and place
    "GDAL_IGNORE_AXIS_ORIENTATION": False,  # columns and rows of GML in JPEG 2000
    "GDAL_JP2K_ALT_OFFSETVECTOR_ORDER": False,
    "GDAL_JPEG_TO_RGB": True,
    "GDAL_PAM_ENABLED": True,  # nodata values and CRS in .aux.xml
    "GTIFF_HONOUR_NEGATIVE_SCALEY": False,
    "GTIFF_IGNORE_READ_ERRORS": False,  # damaged blocks
    "GTIFF_POINT_GEO_IGNORE": False,  # half a pixel
    "GTIFF_REPORT_COMPD_CS": None,  # the height datum
}
log = logging.getLogger(__name__)


def changes_reading(name: str, value: str | None) -> bool:
    """Return whether this value of an option of `CHANGING` is another one than GDAL's default.

    Examples
    --------
    >>> changes_reading("GDAL_PAM_ENABLED", "YES"), changes_reading("GDAL_PAM_ENABLED", "NO")
    (False, True)
    """
    # What GDAL takes as "no" (CPLTestBool).
    return value is not None and (value.upper() not in ("NO", "FALSE", "OFF", "0")) is not CHANGING[name]


def ignore_reading_options() -> None:
    """Keep GDAL in this process and its children from options of the environment that change what a file is.

    For a process of the command line, before it loads GDAL: a library leaves the environment of its host alone.
    """
    for name in CHANGING:
        value = os.environ.get(name)
        if changes_reading(name, value):
            del os.environ[name]
            log.warning("the environment variable %s=%s is ignored: it changes what GDAL reads", name, value)
