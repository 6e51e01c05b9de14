"""The CRS of a GeoTIFF: its keys cannot hold every system, and GDAL writes some of them wrongly, without a word."""

from __future__ import annotations

import contextlib
import functools
import secrets

import numpy as np
import pyproj
from osgeo import gdal
from pyproj.enums import WktVersion
from pyproj.exceptions import CRSError, ProjError

from ortho_pipeline.errors import CrsError
from ortho_pipeline.geodesy.crs import horizontal, same_crs
from ortho_pipeline.raster.source import Grid

#: GDAL reads some projections in older forms only.
_FORMS = WktVersion.WKT2_2019, WktVersion.WKT1_GDAL, WktVersion.WKT1_ESRI
#: A place may change by this part of a pixel.
_SAME = 0.01


@functools.lru_cache(maxsize=64)
def stored_wkt(grid: Grid) -> str:
    """Return a text of the grid's CRS that a GeoTIFF gives back, by a file of one pixel.

    Raises
    ------
    CrsError
        If a GeoTIFF gives back another system in any form, or none.

    Examples
    --------
    >>> stored_wkt(Grid(parse_crs("EPSG:32636"), 500_000.0, 4_100_000.0, 2.0, 2.0, 100, 50))[:31]
    'PROJCRS["WGS 84 / UTM zone 36N"'
    """
    wanted = horizontal(grid.crs)
    # Corners, and the middle.
    columns, rows = grid.width * np.array([0, 1, 0, 1, 0.5]), grid.height * np.array([0, 0, 1, 1, 0.5])
    place = np.array(grid.xy(columns, rows))
    for form in _FORMS:
        with contextlib.suppress(RuntimeError, CRSError, ProjError, CrsError):
            text = grid.crs.to_wkt(form)
            found = horizontal(_given_back(text))
            if same_crs(found, wanted):
                return text
            back = np.array(pyproj.Transformer.from_crs(found, wanted, always_xy=True).transform(*place))
            if np.abs(back - place).max() < _SAME * min(grid.dx, grid.dy):
                return text
    raise CrsError(
        f"a GeoTIFF cannot store the CRS {grid.crs.to_string()!r}",
        field="output.crs",
        remedy="give another projected CRS, such as a UTM zone",
    )


def _given_back(text: str) -> pyproj.CRS:
    path, driver = f"/vsimem/ortho_crs_{secrets.token_hex(8)}.tif", gdal.GetDriverByName("GTiff")
    dataset = driver.Create(path, 1, 1)
    try:
        dataset.SetProjection(text)
        dataset.SetGeoTransform((0.0, 1.0, 0.0, 0.0, 0.0, -1.0))
        dataset = None
        # Side-cars would be lost with the temporary name of an output.
        dataset = gdal.OpenEx(path, gdal.OF_RASTER, allowed_drivers=["GTiff"], sibling_files=[path[8:]])
        return pyproj.CRS.from_wkt(dataset.GetProjection())
    finally:
        dataset = None
        driver.Delete(path)
