"""Where a raster has values: the outline of its valid pixels, on the map and as GeoJSON.

GeoJSON knows no longitude beyond 180 degrees: what crosses the antimeridian is cut there, what holds a pole reaches it
(RFC 7946, sections 3.1.9 and 5.2).
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import Any

import numpy as np
import pyproj
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.files.shell import converted
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.raster.pixel_types import numpy_type, valid_of
from ortho_pipeline.raster.regridded import grid_of
from ortho_pipeline.raster.source import open_pixels

#: Pixels per side at which the mask is looked at.
_SIDE = 512
#: Points per side of the outline, so that straight lines of the map stay where they are in degrees.
_STEPS = 32
#: Decimals of a degree: a centimetre.
_DECIMALS = 7
#: GDAL's number of the colour interpretation alpha (GCI_AlphaBand).
_ALPHA = 6
#: Windows along each side of an alpha band in which its values are counted, and their side (px).
_WINDOWS, _WINDOW = 4, 32
#: Different values from which on an alpha band that is mostly neither 0 nor opaque has data.
_SEVERAL = 16


def valid_outline(path: str | PathLike[str], *, side: int = _SIDE) -> BaseGeometry:
    """Return the outline of the valid pixels of an orthoimage in its CRS: a polygon, or several; empty without any.

    The mask is looked at in at most `side` pixels per side, and the outline is true to one of these.
    """
    dataset, grid = open_pixels(path)[0], grid_of(path)
    columns, rows = min(side, grid.width), min(side, grid.height)
    mask = sampled_mask([dataset.GetRasterBand(k + 1) for k in range(dataset.RasterCount)], columns, rows)
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    # In reading order beginnings and ends of the runs of a row belong together.
    (row, begin), (_, end) = np.nonzero(edges == 1), np.nonzero(edges == -1)
    x_scale, y_scale = grid.width / columns, grid.height / rows
    left, top = grid.xy(begin * x_scale, row * y_scale)
    right, bottom = grid.xy(end * x_scale, (row + 1) * y_scale)
    outline = shapely.union_all(shapely.box(left, bottom, right, top))
    coarse = max(x_scale * grid.dx, y_scale * grid.dy)
    return shapely.make_valid(outline.simplify(coarse)) if columns * rows > 1 else outline


def sampled_mask(bands: Sequence[Any], columns: int, rows: int) -> NDArray[np.bool_]:
    """Return where some band, except alpha, has a value, in a sample ``(rows, columns)`` of a raster."""
    sample, valid = {"buf_xsize": columns, "buf_ysize": rows}, np.zeros((rows, columns), dtype=bool)
    for band in bands:
        if band.GetColorInterpretation() != _ALPHA and not valid.all():
            own = valid_of(band, **sample)
            if numpy_type(band.DataType).kind == "f":
                # No mask has NaN if there is no nodata value.
                own &= ~np.isnan(band.ReadAsArray(**sample))
            valid |= own
    return valid


def doubtful_alpha(dataset: Any) -> list[Notice]:
    """Return a warning if the alpha band of a raster seems to have data: GDAL takes the fourth of four bands for alpha.

    An alpha band is 0 or opaque nearly everywhere; only its edges have values between.
    """
    for number in range(1, dataset.RasterCount + 1):
        band = dataset.GetRasterBand(number)
        if band.GetColorInterpretation() != _ALPHA or (kind := numpy_type(band.DataType)).kind == "f":
            continue
        values = _sampled_values(band)
        between = values[(values != 0) & (values != np.iinfo(kind).max)]
        if len(np.unique(between)) < _SEVERAL or 2 * len(between) < np.count_nonzero(values):
            continue
        name = dataset.GetDescription()
        text = (
            f"band {number} of {name} is marked as alpha, but seems to have data, such as near infrared. "
            f"Pixels where it is 0 count as empty. If it has data, remove the mark: `gdal_translate "
            f"-colorinterp_{number} undefined {converted(name, 'bands')}`, and use the new file"
        )
        return [Notice("doubtful-alpha", text, band=number)]
    return []


def _sampled_values(band: Any) -> NDArray[Any]:
    """Return values of a band in windows spread over it."""
    starts = []
    for length in (band.XSize, band.YSize):
        starts.append(np.linspace(0, max(length - _WINDOW, 0), _WINDOWS + 2).astype(int)[1:-1])
    size = min(_WINDOW, band.XSize), min(_WINDOW, band.YSize)
    windows = [band.ReadAsArray(left, top, *size) for top in starts[1].tolist() for left in starts[0].tolist()]
    return np.concatenate([window.ravel() for window in windows])


def to_geojson(outline: BaseGeometry, crs: pyproj.CRS) -> tuple[dict[str, Any], list[float]]:
    """Return the outline as a GeoJSON geometry in lon, lat (WGS 84), and its box west, south, east, north.

    Exterior rings run counterclockwise. A box that crosses the antimeridian has a west beyond its east.
    """
    to_degrees = ground_transform(crs, "EPSG:4979")
    parts = []
    for polygon in _polygons(outline):
        step = max(polygon.bounds[2] - polygon.bounds[0], polygon.bounds[3] - polygon.bounds[1]) / _STEPS
        # What is within counts as valid: holes of a mask are not a part of a footprint.
        ring = shapely.get_coordinates(shapely.segmentize(polygon.exterior, step))
        degrees = to_degrees(np.column_stack([ring, np.zeros(len(ring))]))[:, :2]
        parts += _polygons(shapely.make_valid(shapely.Polygon(_unwrapped(degrees))))
    # Parts on both sides of the antimeridian are neighbours: count all longitudes from the widest gap between parts.
    wests, _, easts, _ = np.array([polygon.bounds for polygon in parts]).T
    turns = np.floor((wests - _beyond_widest_gap(wests, easts)) / 360)
    moved = [shapely.transform(p, lambda xy, t=t: xy - [360 * t, 0]) for p, t in zip(parts, turns, strict=True)]
    area = shapely.union_all(moved)
    west, south, east, north = area.bounds
    cut = _cut(area, west, east)
    box = [-180.0, south, 180.0, north] if east - west >= 360 else [_in_range(west), south, _in_range(east), north]
    return _listed(shapely.geometry.mapping(cut)), [round(float(value), _DECIMALS) for value in box]


def _beyond_widest_gap(wests: NDArray[np.float64], easts: NDArray[np.float64]) -> float:
    """Return the first longitude (0 to 360) to the east of the widest gap between ranges of longitudes."""
    first = np.mod(wests, 360)
    order = np.argsort(first)
    first, reached = first[order], np.maximum.accumulate((first + easts - wests)[order])
    before = np.maximum(np.append(-np.inf, reached[:-1]), reached[-1] - 360)
    # Less a rounding error.
    return float(first[np.argmax(first - before)]) - 1e-9


def _polygons(geometry: BaseGeometry) -> list[Any]:
    parts = shapely.get_parts(geometry)
    return [part for one in parts for part in shapely.get_parts(one) if part.geom_type == "Polygon" and part.area > 0]


def _unwrapped(ring: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a closed ring of lon, lat with longitudes that do not jump; one around a pole goes by way of it."""
    lon = np.degrees(np.unwrap(np.radians(ring[:, 0])))
    ring = np.column_stack([lon, ring[:, 1]])
    if abs(lon[-1] - lon[0]) < 180:
        return ring
    pole = np.copysign(90.0, ring[:, 1].mean())
    return np.vstack([ring, [[lon[-1], pole], [lon[0], pole]], ring[:1]])


def _cut(area: BaseGeometry, west: float, east: float) -> BaseGeometry:
    """Return parts with longitudes of -180 to 180 degrees."""
    parts = []
    for turn in range(int(np.floor((west + 180) / 360)), int(np.floor((east + 180) / 360)) + 1):
        strip = shapely.box(360.0 * turn - 180, -90, 360.0 * turn + 180, 90)
        inside = shapely.intersection(area, strip)
        parts += [shapely.transform(p, lambda xy, turn=turn: xy - [360.0 * turn, 0]) for p in _polygons(inside)]
    rounded = _polygons(shapely.set_precision(shapely.MultiPolygon(parts), 10.0**-_DECIMALS))
    oriented = [shapely.geometry.polygon.orient(part) for part in rounded]
    return oriented[0] if len(oriented) == 1 else shapely.MultiPolygon(oriented)


def _in_range(lon: float) -> float:
    return float((lon + 180) % 360 - 180)


def _listed(geometry: Any) -> dict[str, Any]:
    def lists(value: Any) -> Any:
        return [lists(item) for item in value] if isinstance(value, tuple | list) else round(float(value), _DECIMALS)

    return {"type": geometry["type"], "coordinates": lists(geometry["coordinates"])}
