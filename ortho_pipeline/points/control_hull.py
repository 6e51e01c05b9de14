"""The part of an image that control points cover, and the names of the empty sides."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
import pydantic
from numpy.typing import NDArray

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.files.json.records import Count, Pair, Record
from ortho_pipeline.points.table import Array

#: Control that covers less than this share (with the margin) leaves part of the image untested: models that fit the
#: points equally well differ there (docs/accuracy.md).
COVERED = 0.7
#: An empty part is named if it has at least this share of the empty area.
_PART = 0.2
#: Least distance of the middle of an empty side from the middle of the image, in parts of its size.
_ASIDE = 0.15


class ControlHull(Record):
    """Convex hull of the used control points, and its share of the image; no outline if the points are on one line."""

    share: Annotated[float, pydantic.Field(ge=0)]
    n: Count
    outline: tuple[Pair, ...]


def control_hull(image: Array, size: tuple[int, int]) -> ControlHull | None:
    """Return the convex hull of points ``(N, 2)`` px; None for fewer than three points."""
    if len(image) < 3:
        return None
    import shapely

    hull = shapely.MultiPoint(image).convex_hull
    inside = hull.intersection(shapely.box(0, 0, *size))
    outline = tuple(hull.exterior.coords[:-1]) if hull.geom_type == "Polygon" else ()
    return ControlHull(share=inside.area / (size[0] * size[1]), n=len(image), outline=outline)


def outside_of_hull(control: Array, image: Array) -> NDArray[np.bool_]:
    """Return which points ``(m, 2)`` px are outside the hull of control ``(n, 2)`` by more than half its spacing."""
    if not len(control) or not len(image):
        return np.zeros(len(image), dtype=bool)
    import shapely

    hull = shapely.MultiPoint(control).convex_hull
    hull = hull.buffer(0.5 * math.sqrt(hull.area / len(control)))
    return np.array([not hull.covers(shapely.Point(place)) for place in image], dtype=bool)


def empty_parts(image: Array, size: tuple[int, int]) -> tuple[float, tuple[str, ...]]:
    """Return the share (0 to 1) of the image that points ``(N, 2)`` px cover, and the names of the empty sides.

    The covered area is their convex hull, extended by half the spacing of N evenly spread points: even ideal control
    leaves such a margin.
    """
    if not len(image):
        return 0.0, ("everywhere",)
    import shapely

    frame = shapely.box(0, 0, 1, 1)
    hull = shapely.MultiPoint(np.asarray(image) / size).convex_hull.buffer(0.5 / math.sqrt(len(image)))
    covered, rest = hull.intersection(frame), frame.difference(hull)
    names: list[str] = []
    for part in getattr(rest, "geoms", [rest]):
        if part.area >= _PART * rest.area and part.area > 0:
            names.append(_place(part))
    return float(covered.area), tuple(dict.fromkeys(names))


def uncovered(image: Array, size: tuple[int, int] | None) -> tuple[Notice, ...]:
    """Return a notice, with its remedy, if control points ``(N, 2)`` px leave part of the image empty; none if not."""
    if size is None or not len(image):
        return ()
    share, where = empty_parts(image, size)
    if share >= COVERED:
        return ()
    text = (
        f"control covers {100 * share:.0f} % of the image; empty: {' and '.join(where)}. Accuracy there is untested, "
        "and models can differ: add points there, or do not use the result there"
    )
    return (Notice("control-covers-part", text, share=share, empty=list(where)),)


def _place(part: Any) -> str:
    """Return in words where a part of the unit square is: top is the first row, left the first column."""
    if part.interiors:
        return "all around"
    across, down = part.centroid.x - 0.5, part.centroid.y - 0.5
    vertical = "" if abs(down) < _ASIDE else ("top" if down < 0 else "bottom")
    horizontal = "" if abs(across) < _ASIDE else ("left" if across < 0 else "right")
    return " ".join(word for word in (vertical, horizontal) if word) or "all around"
