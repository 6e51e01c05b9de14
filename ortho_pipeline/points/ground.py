"""Where the points of a file are: its CRS and height datum against what the user says, and ellipsoidal heights."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs import VERTICAL_FORMS, Vertical, ground_transform, horizontal, parse_crs, same_crs
from ortho_pipeline.geodesy.declared_vertical import DeclaredVertical, declared_vertical
from ortho_pipeline.points.rows import Table

Array = NDArray[np.float64]

#: Points farther than this (m) from the ellipsoid are not on Earth.
_ON_EARTH = 20_000.0


def ground_of(
    path: str | os.PathLike[str], table: Table, crs: str | pyproj.CRS | None, vertical: str | Vertical | None
) -> tuple[Array, pyproj.CRS]:
    """Return the ground ``(N, 3)`` of the rows of a table with ellipsoidal heights, and its horizontal CRS.

    Parameters
    ----------
    crs, vertical : optional
        What the coordinates and the heights are in, where the file does not say it.

    Raises
    ------
    InputError, CrsError, DatumError
        If that is not known or contradicts the file, or a place is not on Earth.
    """
    ground = np.array([row.ground for row in table.rows], dtype=float).reshape(-1, 3)
    wheres = [row.where for row in table.rows]
    full = _crs_of(path, table, crs)
    if full.is_geocentric:
        return _from_geocentric(path, table, full, vertical, ground, wheres)
    plane = horizontal(full)
    _check_kind(path, table, plane)
    _check_places(path, plane, wheres, ground)
    datum, unit = _vertical_of(path, table, full, vertical, bool(np.isfinite(ground[:, 2]).any()))
    ground[:, 2] *= unit
    return _ellipsoidal(path, wheres, ground, plane, datum), plane


def _crs_of(path: str | os.PathLike[str], table: Table, option: str | pyproj.CRS | None) -> pyproj.CRS:
    try:
        stated = None if table.crs is None else parse_crs(table.crs)
    except CrsError as error:
        raise CrsError(error.message, file=path, field="CRS", remedy=error.remedy) from error
    given = None if option is None else parse_crs(option)
    if stated is None and given is None:
        raise CrsError(
            "the CRS of these points is not known",
            file=path,
            field="points.crs",
            remedy=Text("give ", Setting("points.crs", "EPSG:n")),
        )
    if stated is None or given is None:
        return given if stated is None else stated  # type: ignore[return-value]
    if not same_crs(_plan(stated), _plan(given)):
        raise CrsError(
            Text(f"the file says {stated.name!r}, ", Setting("points.crs"), f" says {given.name!r}"),
            file=path,
            field="points.crs",
            remedy="leave the option out",
        )
    # The one that also says what heights are in tells more.
    return stated if declared_vertical(given) is None else given


def _plan(crs: pyproj.CRS) -> pyproj.CRS:
    return crs if crs.is_geocentric else horizontal(crs)


def _from_geocentric(
    path: str | os.PathLike[str],
    table: Table,
    crs: pyproj.CRS,
    option: str | Vertical | None,
    ground: Array,
    wheres: Sequence[str],
) -> tuple[Array, pyproj.CRS]:
    """Return longitude, latitude and ellipsoidal height of points in Earth-centred X, Y, Z (metres)."""
    _check_kind(path, table, crs)
    given = None if option is None else Vertical.parse(option)
    stated = None if table.vertical is None else Vertical.stated(table.vertical)
    for said in (given, stated):
        if said is not None and not said.is_ellipsoid:
            raise DatumError(
                f"{crs.name!r} has X, Y, Z from the centre of the Earth and no heights above {said.label}",
                file=path,
                field="points.vertical",
                remedy="leave the height datum out",
            )
    placed = ground_transform(crs, "EPSG:4979")(ground)
    # No deeper than the sea, no higher than an aircraft: kilometres for metres and other systems come out elsewhere.
    bad = ~(np.abs(placed[:, 2]) < _ON_EARTH) & np.isfinite(ground).any(axis=1)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        x, y, z = ground[first]
        raise InputError(
            f"X {x:.12g}, Y {y:.12g}, Z {z:.12g} is not on Earth",
            file=path,
            field=wheres[first],
            remedy=Text(
                "geocentric points need x, y and h (Z) in metres; other coordinates another ", Setting("points.crs")
            ),
        )
    return placed, pyproj.CRS.from_epsg(4326)


def _vertical_of(
    path: str | os.PathLike[str], table: Table, crs: pyproj.CRS, option: str | Vertical | None, needed: bool
) -> tuple[Vertical, float]:
    """Return the height datum of the points, and metres per unit of their heights."""
    declared = declared_vertical(crs)
    if table.assumed_vertical is not None and option is not None:
        # The CRS is what the format prescribes, not what anybody said of these heights.
        declared = None
    given = None if option is None else Vertical.parse(option)
    stated = None if table.vertical is None else Vertical.stated(table.vertical)
    unit = declared.metres_per_unit if declared else 1.0
    said = _certain(declared)
    if stated is not None and said is not None and stated != said:
        raise DatumError(
            f"the file states its heights in {stated.label}, and its CRS {crs.name!r} in {said.label}",
            file=path,
            field="vertical",
            remedy="state the height datum once",
        )
    certain = stated or said
    if given is not None and certain is not None and given != certain:
        raise DatumError(
            Text(
                f"the heights of these points are in {certain.label}, ",
                Setting("points.vertical"),
                f" says {given.label}",
            ),
            file=path,
            field="points.vertical",
            remedy="leave the option out",
        )
    found = given or stated or (declared.vertical if declared else None)
    if found is None and table.assumed_vertical is not None:
        found = Vertical.parse(table.assumed_vertical)
    if found is None and not needed:
        return Vertical("ellipsoid"), unit
    if found is None:
        raise DatumError(
            "it is not known what the heights of these points are measured above",
            file=path,
            field="points.vertical",
            remedy=Text("say it with ", Setting("points.vertical"), f" ({VERTICAL_FORMS})"),
        )
    return found, unit


def _certain(declared: DeclaredVertical | None) -> Vertical | None:
    return declared.vertical if declared is not None and declared.certain else None


def _ellipsoidal(
    path: str | os.PathLike[str], wheres: Sequence[str], ground: Array, crs: pyproj.CRS, vertical: Vertical
) -> Array:
    given = np.isfinite(ground[:, 2])
    if vertical.is_ellipsoid or not given.any():
        return ground
    plan = np.column_stack([ground[:, :2], np.zeros(len(ground))])
    lonlat = ground_transform(crs, "EPSG:4979")(plan)
    try:
        undulation = vertical.undulation(lonlat[:, 0], lonlat[:, 1])
    except DatumError as error:
        raise DatumError(error.message, file=path, field="points.vertical", remedy=error.remedy) from error
    outside = given & ~np.isfinite(undulation)
    if outside.any():
        raise DatumError(
            f"the geoid of {vertical.label} does not reach this point",
            file=path,
            field=wheres[int(np.flatnonzero(outside)[0])],
            remedy=Text("check its coordinates and ", Setting("points.crs")),
        )
    out = ground.copy()
    out[given, 2] += undulation[given]
    return out


def _check_kind(path: str | os.PathLike[str], table: Table, crs: pyproj.CRS) -> None:
    """Refuse degrees in columns that are called Easting and Northing, and metres in those called Lat and Lon."""
    kind = "geographic" if crs.is_geographic else "geocentric" if crs.is_geocentric else "projected"
    if table.of_ground in (None, kind):
        return
    named = "longitude" if table.of_ground == "geographic" else "easting"
    raise CrsError(
        f"the columns are called {named} and so on, but {crs.name!r} is {kind}",
        file=path,
        field="points.crs",
        remedy="give the CRS that these columns are in, or rename them x and y",
    )


def _check_places(path: str | os.PathLike[str], crs: pyproj.CRS, wheres: Sequence[str], ground: Array) -> None:
    if crs.is_geographic:
        unit = math.degrees(crs.axis_info[0].unit_conversion_factor)
        for where, (x, y, _) in zip(wheres, ground, strict=True):
            if abs(y * unit) > 90 or abs(x * unit) > 360:
                raise InputError(
                    f"longitude {x}, latitude {y} is not on Earth",
                    file=path,
                    field=where,
                    remedy=Text(
                        "x is longitude and y latitude; projected coordinates need another ", Setting("points.crs")
                    ),
                )
