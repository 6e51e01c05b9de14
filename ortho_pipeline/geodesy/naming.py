"""Coordinate systems as text, for people and for programs."""

from __future__ import annotations

import pyproj

#: What PROJ and GDAL call a CRS that was given without a name.
_NAMELESS = ("unknown", "unnamed", "undefined", "")


def crs_text(crs: pyproj.CRS) -> str:
    """Return a CRS as people read it: ``EPSG:n`` where it has such a code, its name otherwise.

    The text is for display only: a name is not enough to read the CRS again. `crs_definition` is.
    """
    authority = crs.to_authority()
    return ":".join(authority) if authority else crs_name(crs)


def crs_name(crs: pyproj.CRS) -> str:
    """Return the name of a CRS; of one without a name its kind, such as ``custom Transverse Mercator``."""
    if crs.name not in _NAMELESS:
        return crs.name
    plain = crs.source_crs if crs.is_bound and crs.source_crs is not None else crs
    operation = plain.coordinate_operation
    return f"custom {'geographic CRS' if operation is None else operation.method_name}"


def crs_definition(crs: pyproj.CRS, min_confidence: int = 100) -> str:
    """Return a CRS as programs read it again: its code (``EPSG:n``) or, without one, WKT in one line.

    Parameters
    ----------
    min_confidence : int
        100: the code of a CRS that agrees in every name; 70: of one that is equivalent, whatever it is called.
    """
    authority = crs.to_authority(min_confidence=min_confidence)
    return ":".join(authority) if authority else crs.to_wkt().replace("\n", " ")
