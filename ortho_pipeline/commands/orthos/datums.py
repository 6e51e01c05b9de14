"""Find a geodetic datum whose difference from the datum of an ortho explains its shift."""

from __future__ import annotations

import contextlib

import numpy as np
import pyproj
from pyproj import aoi, transformer
from pyproj.database import query_crs_info
from pyproj.enums import PJType

from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array

#: A shorter shift (m) is no datum's.
_SHORTEST = 10.0
#: A transformation is known to a few metres, at least to its stated accuracy (m); a coarser one explains nothing, nor
#: does one that is not known to this part of the shift: any shift would be near one of the many datums.
_METRES, _COARSEST, _PART = 1.0, 30.0, 0.25


def datum_of(crs: pyproj.CRS, place: Array, shift: Array, interval: float) -> str | None:
    """Return the name of the datum that explains a shift (m to east and north) at a place of a map; None if none does.

    Parameters
    ----------
    place : (3,)
        x, y in `crs`.
    interval : float
        How certain the shift is, metres.
    """
    length = float(np.hypot(*shift))
    own = crs.geodetic_crs
    if length < _SHORTEST or own is None:
        return None
    own = own.to_2d()
    to_own = pyproj.Transformer.from_crs(crs, own, always_xy=True)
    lon, lat = to_own.transform(place[0], place[1])
    if not (np.isfinite(lon) and np.isfinite(lat)):
        return None
    scale = metres_per_degree(np.array([[lon, lat, 0.0]]))[0]
    nearest, best = 1.0, None
    box = lon - 0.1, lat - 0.1, lon + 0.1, lat + 0.1
    near = transformer.AreaOfInterest(*box)
    for other in _candidates(box):
        with contextlib.suppress(pyproj.exceptions.ProjError, pyproj.exceptions.CRSError):
            way = pyproj.Transformer.from_crs(own, other, always_xy=True, area_of_interest=near, allow_ballpark=False)
            there = np.array(way.transform(lon, lat, errcheck=True))
            # Where a datum has several transformations, their accuracy is known once one is used.
            accuracy = way.get_last_used_operation().accuracy
            tolerance = max(accuracy, _METRES) + interval
            if not 0 <= accuracy <= _COARSEST or tolerance > _PART * length:
                continue
            moved = (there - (lon, lat)) * scale
            apart = min(float(np.hypot(*(moved - shift))), float(np.hypot(*(moved + shift))))
            if apart < nearest * tolerance:
                nearest, best = apart / tolerance, other.name
    return best


def _candidates(box: tuple[float, float, float, float]) -> list[pyproj.CRS]:
    """Return the geographic systems of an area, without those whose datum another one stands for.

    An ensemble stands for its members, and WGS 84 for frames of the ITRF and IGS: they differ by less than a metre.
    PROJ takes 0.15 s for each of these, 5 s for all of an area.
    """
    found = [
        pyproj.CRS.from_epsg(info.code)
        for info in query_crs_info(
            "EPSG", pj_types=[PJType.GEOGRAPHIC_2D_CRS], area_of_interest=aoi.AreaOfInterest(*box), contains=True
        )
    ]
    datums = [crs.datum.to_json_dict() if crs.datum else {} for crs in found]
    members = {member["name"] for datum in datums for member in datum.get("members", ())}
    return [
        crs
        for crs, datum in zip(found, datums, strict=True)
        if datum.get("name") not in members
        and not (datum.get("type") == "DynamicGeodeticReferenceFrame" and datum["ellipsoid"]["name"] == "GRS 1980")
    ]
