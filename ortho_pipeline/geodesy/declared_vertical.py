"""Height systems that rasters declare, in their CRS or in the words of their metadata."""

from __future__ import annotations

import re
from dataclasses import dataclass

import pyproj

from ortho_pipeline.errors import DatumError
from ortho_pipeline.geodesy.crs import Vertical


@dataclass(frozen=True)
class DeclaredVertical:
    """The heights that a CRS declares.

    Parameters
    ----------
    name : str
        As written there.
    vertical : Vertical or None
        The datum; None if the name is unknown.
    certain : bool
        True if an authority code or a grid identifies it, False if only its name does.
    metres_per_unit : float
        Length of the unit of the vertical axis.
    """

    name: str
    vertical: Vertical | None
    certain: bool
    metres_per_unit: float


def declared_vertical(crs: pyproj.CRS) -> DeclaredVertical | None:
    """Return what a system declares about heights; None if it is two-dimensional.

    A 3D geographic, projected or geocentric system declares the ellipsoid; a compound system its vertical part, known
    by its authority code, by the geoid grid bound to it, or (not certain) by a name such as ``EGM96 height``.

    Raises
    ------
    DatumError
        If the vertical axis points down.

    Examples
    --------
    >>> declared_vertical(pyproj.CRS("EPSG:32636+5773")).vertical.label
    'EGM96 height (EPSG:5773)'
    """
    if not crs.is_compound and len(crs.axis_info) < 3:
        return None
    part = crs.sub_crs_list[1] if crs.is_compound else crs
    plain = part.source_crs if part.is_bound and part.source_crs is not None else part
    axis = plain.axis_info[-1]
    if axis.direction.lower() == "down":
        raise DatumError(f"{plain.name!r} gives depths, not heights", field="vertical CRS")
    if not crs.is_compound:
        return DeclaredVertical(crs.name, Vertical("ellipsoid"), True, axis.unit_conversion_factor)
    authority = plain.to_authority(min_confidence=90)
    if authority is not None and authority[0] == "EPSG":
        # PROJ also finds a code by comparing names; only a code that is written there is certain.
        certain = "id" in plain.to_json_dict()
        return DeclaredVertical(plain.name, Vertical(":".join(authority)), certain, axis.unit_conversion_factor)
    bound = list(part.coordinate_operation.grids) if part.is_bound and part.coordinate_operation is not None else []
    if bound:
        grid = Vertical(bound[0].short_name)
        return DeclaredVertical(plain.name, grid, True, axis.unit_conversion_factor)
    return DeclaredVertical(plain.name, _vertical_of_name(plain.name), False, axis.unit_conversion_factor)


def _vertical_of_name(name: str) -> Vertical | None:
    plain = re.sub(r"[^a-z0-9]", "", name.lower())
    for pattern, vertical in (
        (r"(wgs84)?egm(19)?96.*", "EPSG:5773"),
        (r"(wgs84)?egm(20)?08.*", "EPSG:3855"),
        (r".*ellipsoid.*", "ellipsoid"),
    ):
        if re.fullmatch(pattern, plain):
            return Vertical(vertical)
    return None
