"""Positions of STAC items: boxes in degrees, which may cross the antimeridian."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

#: West, south, east and north in degrees; east of a box over the antimeridian is beyond 180.
Box = tuple[float, float, float, float]
_TURNS = (-360.0, 0.0, 360.0)
#: Rings of a geometry that are looked at; of one with more its box counts.
_MOST_RINGS = 1000


def boxes_of(document: Mapping[str, Any]) -> tuple[Box, ...]:
    """Return boxes around an item: those of the polygons of its geometry, else its own; none if it states none.

    Polygons come first: items are cut at the antimeridian (RFC 7946), and their own box may then go round the world.
    """
    geometry = document.get("geometry")
    boxes = tuple(_of_rings(geometry)) if isinstance(geometry, Mapping) else ()
    own = _box(document.get("bbox"))
    return boxes or (() if own is None else (own,))


def extent_boxes(document: Mapping[str, Any]) -> tuple[Box, ...]:
    """Return the boxes of the extent of a collection; none if it states none."""
    place: Any = document.get("extent")
    for key in ("spatial", "bbox"):
        place = place.get(key) if isinstance(place, Mapping) else None
    boxes = [_box(values) for values in place] if isinstance(place, list) else []
    return tuple(box for box in boxes if box is not None) if None not in boxes else ()


def meet(first: Box, other: Box) -> bool:
    """Return whether two boxes have a common point, also if longitudes differ by full turns."""
    if first[1] > other[3] or other[1] > first[3]:
        return False
    return any(first[0] + turn <= other[2] and other[0] <= first[2] + turn for turn in _TURNS)


def any_meet(some: Iterable[Box], others: Sequence[Box]) -> bool:
    """Return whether any box of `some` has a common point with any of `others`."""
    return any(meet(box, other) for box in some for other in others)


def questions(boxes: Iterable[Box]) -> list[Box]:
    """Return the boxes for requests to an API: one for overlapping boxes, two for a box across the antimeridian."""
    joined: list[Box] = []
    for box in boxes:
        whole = box
        while (other := next((one for one in joined if _overlap(one, whole)), None)) is not None:
            joined.remove(other)
            low, high = map(min, whole[:2], other[:2]), map(max, whole[2:], other[2:])
            whole = (*low, *high)  # type: ignore[assignment]
        joined.append(whole)
    return [half for box in joined for half in _halves(box)]


def _overlap(first: Box, other: Box) -> bool:
    return first[0] <= other[2] and other[0] <= first[2] and first[1] <= other[3] and other[1] <= first[3]


def _halves(box: Box) -> Iterator[Box]:
    west, south, east, north = box
    if east - west >= 360.0:
        yield -180.0, south, 180.0, north
        return
    turn = 360.0 * ((west + 180.0) // 360.0)
    west, east = west - turn, east - turn
    if east <= 180.0:
        yield west, south, east, north
        return
    yield west, south, 180.0, north
    yield -180.0, south, east - 360.0, north


def _box(values: Any) -> Box | None:
    """Return the box of four or six numbers, as GeoJSON has them; None of anything else."""
    if not isinstance(values, list) or len(values) not in (4, 6) or not all(map(_is_number, values)):
        return None
    half = len(values) // 2
    west, south, east, north = values[0], values[1], values[half], values[half + 1]
    # East before west is a box over the antimeridian.
    return (float(west), float(south), float(east + 360.0 if east < west else east), float(north))


def _of_rings(geometry: Mapping[str, Any]) -> Iterator[Box]:
    shapes = {"Polygon": [geometry.get("coordinates")], "MultiPolygon": geometry.get("coordinates")}
    polygons = shapes.get(str(geometry.get("type")))
    if not isinstance(polygons, list) or len(polygons) > _MOST_RINGS:
        return
    boxes = []
    for polygon in polygons:
        ring = polygon[0] if isinstance(polygon, list) and polygon else None
        places = [place[:2] for place in ring if isinstance(place, list)] if isinstance(ring, list) else []
        if not places or len(places) != len(ring or ()) or not all(map(_is_place, places)):
            return
        lon, lat = [place[0] for place in places], [place[1] for place in places]
        boxes.append((float(min(lon)), float(min(lat)), float(max(lon)), float(max(lat))))
    yield from boxes


def _is_place(place: list[Any]) -> bool:
    return len(place) == 2 and all(map(_is_number, place))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
