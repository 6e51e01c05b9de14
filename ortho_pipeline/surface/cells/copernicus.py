"""The cells of the Copernicus DEM GLO-30: their names, their samples, and which cells are under a scene.

A cell is a degree wide and high. Its first sample is on its north-west corner. The row on its south side and the column
on its east side belong to its neighbours, so cells fit side by side. Heights are metres above EGM2008. Source: the
description of the public bucket (``readme.html`` in it), and the product handbook of the Copernicus DEM.
"""

from __future__ import annotations

import functools
import math
import re
from typing import NamedTuple

import numpy as np
import pyproj

from ortho_pipeline.geodesy.crs import horizontal, parse_crs
from ortho_pipeline.surface.base import Array
from ortho_pipeline.surface.dem_file import SampleGrid

#: Default address of the cells.
PUBLIC = "https://copernicus-dem-30m.s3.amazonaws.com"
#: The worldwide DEM of 90 m, which has a cell wherever there is land: GLO-30 has not, by decision of its owners.
PUBLIC_LAND = "https://copernicus-dem-90m.s3.amazonaws.com"
#: File next to the cells that lists all of them, one name in each line.
LIST = "tileList.txt"
_CRS = "EPSG:4326+3855"
#: Samples from one degree of latitude to the next.
ROWS = 3600
#: Columns per degree of longitude, from these degrees of latitude to the next.
_COLUMNS = ((85, 360), (80, 720), (70, 1200), (60, 1800), (50, 2400), (0, 3600))
#: Samples around a scene that interpolation may want.
_MARGIN = 12
#: Largest shift (m) of a scene by control points.
_DRIFT = 2_000.0
_METRES_PER_DEGREE = 111_000.0
#: No cell is larger (bytes); the largest are about 50 MB.
LARGEST = 400_000_000
_NAME = re.compile(r"Copernicus_DSM_(?:COG_)?(?P<spacing>10|30)_([NS])(\d\d)_00_([EW])(\d\d\d)_00_DEM")


class Cell(NamedTuple):
    """A cell, by the degrees of its south-west corner."""

    lon: int
    lat: int

    @property
    def name(self) -> str:
        """The name of its file in the bucket, without ``.tif``; also the name of its folder."""
        return (
            f"Copernicus_DSM_COG_10_{'S' if self.lat < 0 else 'N'}{abs(self.lat):02}_00_"
            f"{'W' if self.lon < 0 else 'E'}{abs(self.lon):03}_00_DEM"
        )

    @property
    def columns(self) -> int:
        """How many it has."""
        return columns_at(self.lat)

    @property
    def grid(self) -> SampleGrid:
        """The grid of its samples."""
        columns = self.columns
        place = (float(self.lon), 1.0 / columns, 0.0, self.lat + 1.0, 0.0, -1.0 / ROWS)
        return SampleGrid(crs_of_cells()[1], (ROWS, columns), place)

    @property
    def withheld(self) -> bool:
        """Whether it may be land of Armenia or Azerbaijan, which the public DEM of 30 m silently omits."""
        return 43 <= self.lon <= 50 and 38 <= self.lat <= 41


@functools.cache
def crs_of_cells() -> tuple[pyproj.CRS, pyproj.CRS]:
    """Return the system of the cells, longitude and latitude with heights above EGM2008, and its horizontal part."""
    crs = parse_crs(_CRS)
    return crs, horizontal(crs)


def columns_at(lat: int) -> int:
    """Return the number of columns of a cell, from the latitude of its south side; fewer towards the poles."""
    towards_equator = lat if lat >= 0 else -lat - 1
    return next(columns for start, columns in _COLUMNS if towards_equator >= start)


def cells_of_list(text: str) -> frozenset[Cell]:
    """Return the cells that a list names, one a line, by their names in the DEM of 30 m or of 90 m."""
    cells = []
    for match in _NAME.finditer(text):
        lat, lon = int(match[3]), int(match[5])
        cells.append(Cell(-lon if match[4] == "W" else lon, -lat if match[2] == "S" else lat))
    return frozenset(cells)


class Extent(NamedTuple):
    """A range of longitudes, which may run over 180 degrees, and of latitudes."""

    west: float
    south: float
    east: float
    north: float

    def cells(self) -> list[Cell]:
        """Return the cells that it reaches into, from west to east; round the world no one twice."""
        # A sample on a parallel is the first row of the cell below it, one on a meridian the first column of that in
        # the east.
        rows = range(max(math.ceil(self.south) - 1, -90), min(math.ceil(self.north) - 1, 89) + 1)
        first, last = math.floor(self.west), math.floor(self.east)
        columns = range(first, min(last, first + 359) + 1)
        return [Cell((lon + 180) % 360 - 180, lat) for lon in columns for lat in rows]

    def widened(self, metres: float = _DRIFT) -> Extent:
        """Return the extent with the samples around it that interpolation wants, and ground that control may reach."""
        up = _MARGIN / ROWS + metres / _METRES_PER_DEGREE
        far = min(90.0, max(self.north, -self.south) + up)
        columns = columns_at(min(89, math.floor(far)))
        if far > 89.9:
            return Extent(-180.0, max(-90.0, self.south - up), 180.0, min(90.0, self.north + up))
        aside = _MARGIN / columns + metres / (_METRES_PER_DEGREE * math.cos(math.radians(far)))
        west, east = self.west - aside, self.east + aside
        if east - west >= 360.0:
            west, east = -180.0, 180.0
        return Extent(west, max(-90.0, self.south - up), east, min(90.0, self.north + up))


def extent_of(lonlat: Array) -> Extent | None:
    """Return the extent of closed rings ``(N, 2)`` of longitudes and latitudes, one after the other; None of nothing.

    A ring around a pole holds all longitudes and the pole.
    """
    lonlat = lonlat[np.isfinite(lonlat).all(axis=1)]
    if not len(lonlat):
        return None
    lon = np.unwrap(lonlat[:, 0], period=360.0)
    south, north = float(lonlat[:, 1].min()), float(lonlat[:, 1].max())
    if np.ptp(lon) >= 359.0:
        return Extent(-180.0, -90.0 if south < 0 else south, 180.0, 90.0 if north > 0 else north)
    return Extent(float(lon.min()), south, float(lon.max()), north)
