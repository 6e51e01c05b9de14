"""Options of GDAL by which it reads other pixels, heights or places from the same files."""

from __future__ import annotations

import logging
import os

#: Without them GDAL reads what the files state, and reports what it cannot read.
CHANGING = (
    "CONVERT_YCBCR_TO_RGB",  # colours
    "DTED_APPLY_PIXEL_IS_POINT",  # half a pixel
    "GDAL_DISABLE_READDIR_ON_OPEN",  # masks, RPCs, nodata values next to an image
    "GDAL_GEOREF_SOURCES",  # CRS and place
    "GDAL_IGNORE_AXIS_ORIENTATION",  # columns and rows of GML in JPEG 2000
    "GDAL_JP2K_ALT_OFFSETVECTOR_ORDER",
    "GDAL_JPEG_TO_RGB",
    "GDAL_PAM_ENABLED",  # nodata values and CRS in .aux.xml
    "GTIFF_HONOUR_NEGATIVE_SCALEY",
    "GTIFF_IGNORE_READ_ERRORS",  # damaged blocks
    "GTIFF_POINT_GEO_IGNORE",  # half a pixel
    "GTIFF_REPORT_COMPD_CS",  # the height datum
)
log = logging.getLogger(__name__)


def ignore_reading_options() -> None:
    """Keep GDAL in this process and its children from options of the environment that change what a file is.

    For a process of the command line, before it loads GDAL: a library leaves the environment of its host alone.
    """
    for name in CHANGING:
        if name in os.environ:
            value = os.environ.pop(name)
            log.warning("the environment variable %s=%s is ignored: it changes what GDAL reads", name, value)
