"""Spot heights: known heights of places, from laser altimetry, maps or lake levels. They do not act in plan."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError, OrthoError, of_option, reads
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.points.formats import read_block_table
from ortho_pipeline.points.ground import ground_of
from ortho_pipeline.points.heights.parquet import is_parquet, read_parquet
from ortho_pipeline.points.rows import OF_HEIGHTS, Table

Array = NDArray[np.float64]

#: No sigma (m) of a height is less: altimeters and levels are not better.
_LEAST = 1e-3
#: The options of other points, and those of spot heights in their place.
_OPTIONS = {"points.crs": "points.spot_crs", "points.vertical": "points.spot_vertical"}


@dataclass(frozen=True, eq=False)
class SpotHeights:
    """Known heights at places.

    Parameters
    ----------
    ground : ndarray (N, 3)
        Longitude, latitude (WGS84), height above the ellipsoid, m.
    sigmas : ndarray (N,)
        Standard deviations of the heights, m.
    plan : ndarray (N,)
        Standard deviations of the places, m, per axis; 0 if not stated.
    ids : tuple of str
    source : str
        The file, for people.

    Raises
    ------
    InputError
        If a standard deviation of a height is not positive and finite, or one of a place is negative or not finite.
    """

    ground: Array
    sigmas: Array
    plan: Array
    ids: tuple[str, ...]
    source: str = ""

    def __post_init__(self) -> None:
        for sigmas, least in ((self.sigmas, np.nextafter(0.0, 1.0)), (self.plan, 0.0)):
            wrong = np.flatnonzero(~((sigmas >= least) & (sigmas < np.inf)))
            if len(wrong):
                raise InputError(
                    f"the spot height {self.ids[wrong[0]]} has the standard deviation {sigmas[wrong[0]]}",
                    file=self.source or None,
                    field="points.spot_heights",
                    remedy="give positive metres for heights; for places 0 if it is not known",
                )

    def __len__(self) -> int:
        return len(self.ground)


def read_height_table(path: str | os.PathLike[str]) -> Table:
    """Read points with heights: CSV, GeoJSON or GeoParquet.

    Raises
    ------
    InputError
        As `read_block_table` and `read_parquet`.
    """
    return read_parquet(path) if is_parquet(path) else read_block_table(path, OF_HEIGHTS)


@contextlib.contextmanager
def _of_spots() -> Iterator[None]:
    """Make errors name the options of spot heights."""
    try:
        yield
    except OrthoError as error:
        error.field = _OPTIONS.get(error.field or "", error.field)
        error.message, error.remedy = _renamed(error.message), _renamed(error.remedy)
        raise


def _renamed(text: Any) -> Any:
    """Return a text with the options of spot heights."""
    if not isinstance(text, Text):
        return text
    named = (
        replace(part, name=_OPTIONS.get(part.name, part.name)) if isinstance(part, Setting) else part
        for part in text.parts
    )
    return Text(*named)


@reads("give x, y, h, sigma as CSV, GeoJSON or GeoParquet")
def read_spot_heights(path: str | os.PathLike[str], crs: str | None = None, vertical: str | None = None) -> SpotHeights:
    """Read spot heights.

    Parameters
    ----------
    path : path
        CSV, GeoJSON or GeoParquet with x, y, h and sigma; tables of SlideRule and ICESat-2 (ATL06, ATL08) work, too.
    crs, vertical : str, optional
        CRS and height datum, if the file does not state them.

    Raises
    ------
    InputError, CrsError, DatumError
        For a file that cannot be read, an unknown CRS or height datum, and heights without a sigma.

    Examples
    --------
    >>> path = out / "spots.csv"
    >>> _ = path.write_text("#CRS: EPSG:4326\\n#vertical: ellipsoid\\nx,y,h,sigma\\n36.1,39.2,812.5,0.3\\n")
    >>> op.read_spot_heights(path).sigmas
    array([0.3])
    """
    table = read_height_table(path)
    with of_option("points.spot_crs"):
        plane = None if crs is None else parse_crs(crs)
    with of_option("points.spot_vertical"):
        datum = None if vertical is None else Vertical.parse(vertical)
    with _of_spots():
        ground, system = ground_of(path, table, plane, datum)
    for row in table.rows:
        if not row.sigma_h:
            raise InputError("this height has no sigma", file=path, field=row.where, remedy="add a column sigma (m)")
    return SpotHeights(
        ground=ground_transform(system, "EPSG:4979")(ground),
        sigmas=np.maximum([row.sigma_h or 0.0 for row in table.rows], _LEAST),
        plan=np.array([row.sigma_xy or 0.0 for row in table.rows]),
        ids=tuple(row.id or row.where for row in table.rows),
        source=os.fspath(path),
    )
