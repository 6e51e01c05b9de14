"""Where in the world a scene lies: a small map of land, which is shipped.

`land.json` is the land of Natural Earth at 1 : 110,000,000 (public domain), simplified by tools/make_land.py to
polygons of longitudes and latitudes in tenths of a degree.
"""

from __future__ import annotations

import functools
import json
from importlib import resources

import numpy as np

from ortho_pipeline.display.drawing import Drawing
from ortho_pipeline.estimation.records import Pair, is_known
from ortho_pipeline.report.page.ortho_map import Paper, degrees
from ortho_pipeline.report.records import SceneReport

#: Width of the drawing, CSS px, and the latitudes that it shows.
_WIDTH, _SOUTH, _NORTH = 300.0, -60.0, 84.0


def place_of(report: SceneReport) -> Pair | None:
    """Return longitude and latitude of the middle of the ortho, or else of the image; None where neither is known.

    For a model that does not reach the middle of the image, and for reports of version 0.7, it is that of the points.
    """
    if report.ortho is not None:
        lon, lat = Paper(report.ortho).middle()[0]
        return (float(lon), float(lat)) if np.isfinite([lon, lat]).all() else None
    if report.scene.middle_lon_lat is not None:
        return report.scene.middle_lon_lat
    known = [point.lon_lat for point in report.adjustment.points if is_known(point.lon_lat)]
    if not known:
        return None
    lon, lat = np.mean(np.array(known, dtype=np.float64), axis=0)
    return float(lon), float(lat)


def plot_locator(place: Pair | None) -> Drawing | None:
    """Draw the land of the world, and where a scene or a block is: longitude and latitude."""
    if place is None:
        return None
    scale = _WIDTH / 360.0

    def at(lon: float, lat: float) -> Pair:
        return (lon + 180.0) * scale, (_NORTH - lat) * scale

    lon, lat = place
    said = f"{degrees(lat, 'NS')}, {degrees(lon, 'EW')}"
    drawing = Drawing(_WIDTH, (_NORTH - _SOUTH) * scale, f"Map of the world, with a mark at {said}", "locator")
    drawing.path("land", *[[at(x / 10, y / 10) for x, y in ring] for ring in _land()], closed=True)
    x, y = at(lon, min(max(lat, _SOUTH), _NORTH))
    drawing.path("guide", [(x, 0.0), (x, drawing.height)], [(0.0, y), (drawing.width, y)])
    with drawing.titled(said):
        drawing.circle("check", x, y, 4.0)
    return drawing


@functools.cache
def _land() -> list[list[list[int]]]:
    land: list[list[list[int]]] = json.loads((resources.files(__package__) / "land.json").read_text(encoding="ascii"))
    return land
