"""Make ortho_pipeline/report/page/land.json of land-110m.json, which the npm package `world-atlas` (2.0.2) ships.

That is the land of Natural Earth at 1 : 110,000,000, in the public domain, as TopoJSON.

    npm pack world-atlas@2.0.2 && tar xzf world-atlas-2.0.2.tgz && python tools/make_land.py package/land-110m.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from shapely.geometry import Polygon

#: Islands smaller than this (square degrees) and details smaller than that (degrees) are less than a pixel.
SMALLEST, DETAIL = 3.0, 0.6
TARGET = Path(__file__).resolve().parent.parent / "ortho_pipeline" / "report" / "page" / "land.json"


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
            polygon = Polygon(ring)
            if polygon.area >= SMALLEST:
                shape = polygon.simplify(DETAIL)
                rings.append([[round(10 * lon), round(10 * lat)] for lon, lat in shape.exterior.coords])
    TARGET.write_text(json.dumps(rings, separators=(",", ":")) + "\n", encoding="ascii")


if __name__ == "__main__":
    main(sys.argv[1])
