"""What a raster on a map is that no sensor opens: a DEM or an orthoimage, and which option takes it."""

from __future__ import annotations

import os
from typing import Any, Literal

import numpy as np
import pyproj

from ortho_pipeline.commands.results import SCHEMA_VERSION
from ortho_pipeline.display.notices import to_document
from ortho_pipeline.errors import InputError, completed
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.geodesy.naming import crs_text

#: GDAL's numbers of the types that heights have: whole numbers with a sign, and floating point.
_HEIGHTS = (3, 5, 6, 7)


def kind_of(dataset: Any) -> Literal["dem", "map image"] | None:
    """Return what a raster seems to be; None if it has no place on a map."""
    if dataset.GetGeoTransform(can_return_null=True) is None or not dataset.GetProjection():
        return None
    return "dem" if dataset.RasterCount == 1 and dataset.GetRasterBand(1).DataType in _HEIGHTS else "map image"


def is_upright(dataset: Any) -> bool:
    """Return whether rows and columns of a map raster are parallel to its axes, as in DEMs and orthos."""
    _, _, turned, _, skewed, _ = dataset.GetGeoTransform()
    return turned == skewed == 0.0


def described(image: str | os.PathLike[str], dataset: Any) -> dict[str, Any]:
    """Return the document of `ortho info` for a DEM or an ortho: a `dataset` with a kind (`kind_of`)."""
    kind, band, size = kind_of(dataset), dataset.GetRasterBand(1), (dataset.RasterXSize, dataset.RasterYSize)
    crs = parse_crs(dataset.GetProjection())
    left, along_x, over_x, top, along_y, over_y = dataset.GetGeoTransform()
    pixels = np.array([[0, 0], [size[0], 0], size, [0, size[1]]], dtype=float)
    corners = pixels @ [[along_x, along_y], [over_x, over_y]] + (left, top)
    with completed(image):
        to_geographic = ground_transform(horizontal(crs), "EPSG:4979")
    lon_lat = to_geographic(np.column_stack([corners, np.zeros(4)]))[:, :2]
    declared = declared_vertical(crs)
    heights = _range_of(band, str(image)) if kind == "dem" else None
    return {
        "schema_version": SCHEMA_VERSION,
        "image": str(image),
        "kind": kind,
        "sensor": None,
        "size": list(size),
        "bands": dataset.RasterCount,
        "type": _type_of(band),
        "nodata": json_value(band.GetNoDataValue()),
        "crs": crs_text(horizontal(crs)),
        "vertical": None if declared is None else declared.name,
        "pixel": [float(np.hypot(along_x, along_y)), float(np.hypot(over_x, over_y))],
        "unit": pyproj.CRS(horizontal(crs)).axis_info[0].unit_name,
        "extent": [*corners.min(axis=0).tolist(), *corners.max(axis=0).tolist()],
        "corners_lon_lat": json_value(lon_lat),
        "heights": json_value(heights),
        "option": "surface.dem" if kind == "dem" else "match.reference",
        **to_document([]),
    }


def _range_of(band: Any, path: str) -> list[float] | None:
    """Return the lowest and the highest height about, in the unit of the band; None if no valid sample was found."""
    from ortho_pipeline.raster.source import first_line

    try:
        ends = np.array(band.ComputeRasterMinMax(True))
    except RuntimeError as error:
        if "no valid pixels" in str(error):
            return None
        raise InputError(
            f"the heights cannot be read ({first_line(error, path)})",
            file=path,
            remedy="the file is damaged: copy it again",
        ) from error
    scale = 1.0 if band.GetScale() is None else band.GetScale()
    return sorted((ends * scale + (band.GetOffset() or 0.0)).tolist())


def _type_of(band: Any) -> str:
    from ortho_pipeline.raster.source import gdal

    return str(gdal.GetDataTypeName(band.DataType))
