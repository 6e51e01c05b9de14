"""Ground coordinates of the points of a file: its CRS and height datum, checked against the options of the user."""

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
        CRS and height datum, if the file does not state them.

    Raises
    ------
    InputError, CrsError, DatumError
        If one is unknown or contradicts the file, or a point is not on Earth.
    """
    ground = np.array([row.ground for row in table.rows], dtype=float).reshape(-1, 3)
    wheres = [row.where for row in table.rows]
    heights = bool(np.isfinite(ground[:, 2]).any())
    full = _crs_of(path, table, crs, vertical, heights)
    if full.is_geocentric:
        return _from_geocentric(path, table, full, vertical, ground, wheres)
    plane = horizontal(full)
    _check_kind(path, table, plane)
    _check_places(path, plane, wheres, ground)
    datum, unit = _vertical_of(path, table, full, vertical, heights)
    ground[:, 2] *= unit
    return _ellipsoidal(path, wheres, ground, plane, datum), plane


def _crs_of(
    path: str | os.PathLike[str],
    table: Table,
    option: str | pyproj.CRS | None,
    vertical: str | Vertical | None,
    heights: bool,
) -> pyproj.CRS:
    try:
        stated = None if table.crs is None else parse_crs(table.crs)
    except CrsError as error:
        raise CrsError(error.message, file=path, field="CRS", remedy=error.remedy) from error
    wanted = None if option is None else parse_crs(option)
    if stated is None and wanted is None:
        # The CRS may declare the height datum too.
        unknown = heights and vertical is None and table.vertical is None and table.assumed_vertical is None
        datum = (", and ", Setting("points.vertical", "DATUM"), f" ({VERTICAL_FORMS})") if unknown else ()
        raise CrsError(
            f"the CRS of these points is unknown{', and so is their height datum' if unknown else ''}",
            file=path,
            field="points.crs",
            remedy=Text("give ", Setting("points.crs", "EPSG:n"), *datum),
        )
    if stated is None or wanted is None:
        return wanted if stated is None else stated  # type: ignore[return-value]
    if not same_crs(_plan(stated), _plan(wanted)):
        raise CrsError(
            Text(f"the file states {stated.name!r}, but ", Setting("points.crs"), f" states {wanted.name!r}"),
            file=path,
            field="points.crs",
            remedy="leave the option out",
        )
    # Prefer the CRS that also has a height datum.
    return stated if declared_vertical(wanted) is None else wanted


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
    wanted = None if option is None else Vertical.parse(option)
    stated = None if table.vertical is None else Vertical.stated(table.vertical)
    for datum in (wanted, stated):
        if datum is not None and not datum.is_ellipsoid:
            raise DatumError(
                f"{crs.name!r} is geocentric (X, Y, Z from the centre of the Earth), so it has no height datum",
                file=path,
                field="points.vertical",
                remedy="leave the height datum out",
            )
    geographic = ground_transform(crs, "EPSG:4979")(ground)
    # No deeper than the sea, no higher than an aircraft: kilometres instead of metres, and other CRSs, fail here.
    bad = ~(np.abs(geographic[:, 2]) < _ON_EARTH) & np.isfinite(ground).any(axis=1)
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        x, y, z = ground[first]
        raise InputError(
            f"X {x:.12g}, Y {y:.12g}, Z {z:.12g} is not on Earth",
            file=path,
            field=wheres[first],
            remedy=Text(
                "give x, y and h (Z) in metres from the centre of the Earth, or another ", Setting("points.crs")
            ),
        )
    return geographic, pyproj.CRS.from_epsg(4326)


def _vertical_of(
    path: str | os.PathLike[str], table: Table, crs: pyproj.CRS, option: str | Vertical | None, needed: bool
) -> tuple[Vertical, float]:
    """Return the height datum of the points, and metres per unit of their heights."""
    declared = declared_vertical(crs)
    if table.assumed_vertical is not None and option is not None:
        # The format prescribes this CRS. It is not stated for these heights.
        declared = None
    wanted = None if option is None else Vertical.parse(option)
    stated = None if table.vertical is None else Vertical.stated(table.vertical)
    of_crs = _certain(declared)
    if stated is not None and of_crs is not None and stated != of_crs:
        raise DatumError(
            f"the file states heights in {stated.label}, but its CRS {crs.name!r} has heights in {of_crs.label}",
            file=path,
            field="vertical",
            remedy="correct one of the two",
        )
    certain = stated or of_crs
    if wanted is not None and certain is not None and wanted != certain:
        raise DatumError(
            Text(
                f"the file states heights in {certain.label}, but ",
                Setting("points.vertical"),
                f" states {wanted.label}",
            ),
            file=path,
            field="points.vertical",
            remedy="leave the option out",
        )
    datum = wanted or stated or (declared.vertical if declared else None)
    unit = declared.metres_per_unit if declared else datum.metres_per_unit if datum else 1.0
    if datum is None and table.assumed_vertical is not None:
        datum = Vertical.parse(table.assumed_vertical)
    if datum is None and not needed:
        return Vertical("ellipsoid"), unit
    if datum is None:
        raise DatumError(
            "the height datum of these points is unknown",
            file=path,
            field="points.vertical",
            remedy=Text("give it with ", Setting("points.vertical"), f" ({VERTICAL_FORMS})"),
        )
    return datum, unit


def _certain(declared: DeclaredVertical | None) -> Vertical | None:
    return declared.vertical if declared is not None and declared.certain else None


def _ellipsoidal(
    path: str | os.PathLike[str], wheres: Sequence[str], ground: Array, crs: pyproj.CRS, vertical: Vertical
) -> Array:
    known = np.isfinite(ground[:, 2])
    if vertical.is_ellipsoid or not known.any():
        return ground
    plan = np.column_stack([ground[:, :2], np.zeros(len(ground))])
    lonlat = ground_transform(crs, "EPSG:4979")(plan)
    try:
        undulation = vertical.undulation(lonlat[:, 0], lonlat[:, 1])
    except DatumError as error:
        raise DatumError(error.message, file=path, field="points.vertical", remedy=error.remedy) from error
    outside = known & ~np.isfinite(undulation)
    if outside.any():
        raise DatumError(
            f"{vertical.label} does not cover this point",
            file=path,
            field=wheres[int(np.flatnonzero(outside)[0])],
            remedy=Text("check its coordinates and ", Setting("points.crs")),
        )
    ellipsoidal = ground.copy()
    ellipsoidal[known, 2] += undulation[known]
    return ellipsoidal


def _check_kind(path: str | os.PathLike[str], table: Table, crs: pyproj.CRS) -> None:
    """Refuse degrees in columns named Easting and Northing, and metres in columns named Lat and Lon."""
    kind = "geographic" if crs.is_geographic else "geocentric" if crs.is_geocentric else "projected"
    if table.of_ground in (None, kind):
        return
    named = "longitude and latitude" if table.of_ground == "geographic" else "easting and northing"
    raise CrsError(
        f"the columns are named {named}, but {crs.name!r} is {kind}",
        file=path,
        field="points.crs",
        remedy="give the CRS of these columns, or rename them x and y",
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
                        "give longitude as x and latitude as y; for projected coordinates give another ",
                        Setting("points.crs"),
                    ),
                )


def ground_sigmas(sigmas: Array, count: int) -> Array:
    """Return standard deviations ``(count, 3)``, made from one value, one for each point, or three for all points.

    Three are those true east, north and up.

    Raises
    ------
    InputError
        If the shape is none of these, or three values are as many as there are points.
    """
    each = sigmas.shape == (count,)
    if each and count == 3 and np.ptp(sigmas) != 0:
        raise InputError(
            "three values for three points may be one for each point, or east, north and up",
            field="sigma_ground",
            remedy="give the shape (3, 1) for one for each point, or (1, 3) for east, north and up",
        )
    try:
        return np.broadcast_to(sigmas[:, None] if each else sigmas, (count, 3))
    except ValueError as error:
        raise InputError(
            f"sigma_ground has the shape {sigmas.shape}",
            field="sigma_ground",
            remedy=f"give one value, or the shape ({count},) or ({count}, 3)",
        ) from error
