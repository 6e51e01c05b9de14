"""Make ortho_pipeline/report/page/land.json of land-110m.json, which the npm package `world-atlas` (2.0.2) ships.

That is the land of Natural Earth at 1 : 110,000,000, in the public domain, as TopoJSON.

    npm pack world-atlas@2.0.2 && tar xzf world-atlas-2.0.2.tgz && python tools/make_land.py package/land-110m.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from shapely import intersection
from shapely.affinity import translate
from shapely.geometry import Polygon, box

#: Islands smaller than this (square degrees) and details smaller than that (degrees) are less than a pixel.
SMALLEST, DETAIL = 3.0, 0.6
#: The southern edge of the map.
SOUTH = -60.0
TARGET = Path(__file__).resolve().parent.parent / "ortho_pipeline" / "report" / "page" / "land.json"


def parts(ring: list[tuple[float, float]]) -> Iterator[Polygon]:
    """Yield what a map from 180° W to 180° E shows of a ring that may cross the antimeridian.

    TopoJSON joins the halves of such land: drawn as it is, its outline would run once around the world.
    """
    lon, lat = np.array(ring).T
    lon = np.unwrap(lon, period=360.0)
    # Antarctica runs around the pole and does not close; the map ends north of it.
    if lat.max() <= SOUTH or abs(lon[-1] - lon[0]) > 180.0:
        return
    whole = Polygon(np.column_stack([lon, lat])).buffer(0)
    for turn in (-360.0, 0.0, 360.0):
        shown = intersection(translate(whole, turn), box(-180.0, SOUTH, 180.0, 90.0))
        yield from (part for part in getattr(shown, "geoms", [shown]) if isinstance(part, Polygon))


def main(source: str) -> None:
    """Write the outer rings of land as tenths of a degree."""
    topology = json.loads(Path(source).read_text(encoding="utf-8"))
    (sx, sy), (tx, ty) = topology["transform"]["scale"], topology["transform"]["translate"]
    arcs = []
    for deltas in topology["arcs"]:
        x, y, arc = 0, 0, []
        for dx, dy in deltas:
            x, y = x + dx, y + dy
            arc.append((x * sx + tx, y * sy + ty))
        arcs.append(arc)
    rings = []
    for geometry in topology["objects"]["land"]["geometries"]:
        for outer, *_ in geometry["arcs"] if geometry["type"] == "MultiPolygon" else [geometry["arcs"]]:
            ring = [place for k in outer for place in (arcs[k] if k >= 0 else arcs[~k][::-1])]
            for polygon in parts(ring):
                if polygon.area >= SMALLEST:
                    shape = polygon.simplify(DETAIL)
                    rings.append([[round(10 * lon), round(10 * lat)] for lon, lat in shape.exterior.coords])
    TARGET.write_text(json.dumps(rings, separators=(",", ":")) + "\n", encoding="ascii")


if __name__ == "__main__":
    main(sys.argv[1])
