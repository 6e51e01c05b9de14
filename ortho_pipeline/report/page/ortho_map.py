"""The residuals over the quicklook of the ortho, with graticule, scale bar and north arrow.

The drawing has the size of the quicklook and lies upon it; it is made of longitudes and latitudes alone, so that it is
right in every map projection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.display.drawing import Drawing, round_down
from ortho_pipeline.display.notices import doubted
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.records import Pair, Point, is_known
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.report.records import OrthoRecord, SceneReport

Array = NDArray[np.float64]

#: Longer side of the drawing, CSS px.
_SIDE = 720.0
#: The longest vector as a share of the longer side, and in px.
_LONGEST = 0.1
LONGEST_ARROW = _LONGEST * _SIDE
#: With more points than this their ids would hide the picture; beyond the second number only the largest are drawn.
_MAX_LABELS, _MAX_POINTS = 40, 600
#: Distances between the lines of the graticule, degrees: such as have round minutes or seconds.
_STEPS = [k / 3600 for k in (1, 2, 5, 10, 15, 20, 30)] + [k / 60 for k in (1, 2, 5, 10, 15, 20, 30)] + [1, 2, 5, 10, 20]
#: The north arrow has this much room around it, px.
_ROOM = 45.0
#: Points on a line of the graticule.
_SAMPLES = 33


class _Arrow(NamedTuple):
    number: int
    point: Point
    at: Pair
    shift: Pair


class Paper:
    """The drawing's pixels on the map of an ortho, and longitudes and latitudes on both."""

    def __init__(self, ortho: OrthoRecord) -> None:
        left, bottom, right, top = ortho.extent
        self.scale = _SIDE / max(right - left, top - bottom)
        self.left, self.top = left, top
        self.width, self.height = (right - left) * self.scale, (top - bottom) * self.scale
        self._onto, self._back = ground_transform("EPSG:4979", ortho.crs), ground_transform(ortho.crs, "EPSG:4979")

    def at(self, lon_lat: Array) -> Array:
        """Return pixels of the drawing ``(N, 2)`` of longitudes and latitudes; NaN where the map has no such place."""
        xy = self._onto(np.column_stack([lon_lat, np.zeros(len(lon_lat))]))[:, :2]
        return np.column_stack([(xy[:, 0] - self.left) * self.scale, (self.top - xy[:, 1]) * self.scale])

    def lon_lat(self, pixels: Array) -> Array:
        """Return longitudes and latitudes ``(N, 2)`` of pixels of the drawing."""
        x, y = self.left + pixels[:, 0] / self.scale, self.top - pixels[:, 1] / self.scale
        return self._back(np.column_stack([x, y, np.zeros(len(x))]))[:, :2]

    def middle(self) -> tuple[Array, Array]:
        """Return the place in the middle (lon, lat), and the drawing's pixels per metre east and north ``(2, 2)``."""
        centre = self.lon_lat(np.array([[self.width / 2, self.height / 2]]))
        step = 10.0 / metres_per_degree(np.column_stack([centre, [0.0]]))[0]
        ends = self.at(centre + np.array([[0.0, 0.0], [step[0], 0.0], [0.0, step[1]]]))
        return centre[0], (ends[1:] - ends[0]) / 10.0


def plot_ortho(report: SceneReport) -> Drawing | None:
    """Draw residual vectors, graticule, scale bar and north arrow, to be laid over the quicklook of the ortho.

    A vector leads from where a point belongs to where the ortho shows it, exaggerated by what the legend says.
    """
    if report.ortho is None:
        return None
    paper = Paper(report.ortho)
    found = _arrows(report, paper)
    label = f"Residual vectors of {counted(len(found), 'point')} over the ortho, with graticule, scale bar and north"
    drawing = Drawing(paper.width, paper.height, label, "ortho")
    _graticule(drawing, paper)
    longest = max((math.hypot(*one.shift) for one in found if one.point.kind != "out"), default=0.0)
    stretch = _LONGEST * _SIDE / longest if longest > 0 else 0.0
    wrong = doubted(report.adjustment.notices)
    for one in found:
        if one.point.id in wrong:
            drawing.circle("doubted", *one.at, 10.0)
        _draw(drawing, one, stretch, label=len(found) <= _MAX_LABELS or one.point.id in wrong)
    _scale(drawing, paper, stretch, longest)
    _north(drawing, paper, found, stretch)
    return drawing


def _arrows(report: SceneReport, paper: Paper) -> list[_Arrow]:
    """Return the points that can be drawn, px: where they belong, and how far from there the ortho shows them."""
    known = [
        (k, point, point.lon_lat, point.shown_lon_lat)
        for k, point in enumerate(report.adjustment.points)
        if point.role != "tie" and is_known(point.lon_lat) and is_known(point.shown_lon_lat)
    ]
    if not known:
        return []
    at = paper.at(np.array([here for _, _, here, _ in known], dtype=np.float64))
    to = paper.at(np.array([there for *_, there in known], dtype=np.float64))
    arrows = [
        _Arrow(k, point, (float(x), float(y)), (float(u - x), float(v - y)))
        for (k, point, *_), (x, y), (u, v) in zip(known, at, to, strict=True)
        if np.isfinite([x, y, u, v]).all()
    ]
    largest = sorted(arrows, key=lambda one: -math.hypot(*one.shift))[:_MAX_POINTS]
    return sorted(largest, key=lambda one: one.number)


def _draw(drawing: Drawing, one: _Arrow, stretch: float, *, label: bool) -> None:
    (x, y), kind = one.at, one.point.kind
    dx, dy = one.shift[0] * stretch, one.shift[1] * stretch
    with drawing.titled(_said(one.point), key=one.number):
        if kind != "out" and math.hypot(dx, dy) >= 1.0:
            drawing.line("casing", x, y, x + dx, y + dy)
            drawing.arrow(kind, x, y, dx, dy)
        drawing.circle("halo", x, y, 6.5)
        drawing.mark(kind, x, y)
        # A point off the map has no mark that a name could stand next to.
        if label and 0 <= x <= drawing.width and 0 <= y <= drawing.height:
            # Of a point at the upper or lower edge the name stays on the map.
            line = min(max(y + (4 if abs(dx) > abs(dy) else -5), 14.0), drawing.height - 6.0)
            drawing.caption(x, line, one.point.id, 10, left=dx > 0)


def _said(point: Point) -> str:
    lines = [f"{point.id} ({point.role}{', left out' if point.kind == 'out' else ''})"]
    if is_known(point.residual):
        lines.append("residual {:+.3f}, {:+.3f} px".format(*point.residual))
    if is_known(point.residual_m):
        lines.append(f"on the ground {math.hypot(*point.residual_m):.2f} m")
    return "\n".join(lines)


# -- graticule -------------------------------------------------------------------------------------------------------


def _graticule(drawing: Drawing, paper: Paper) -> None:
    across, down = np.linspace(0, paper.width, 9), np.linspace(0, paper.height, 9)
    inside = paper.lon_lat(np.array([(x, y) for x in across for y in down]))
    if not np.isfinite(inside).all():
        return
    low, high = inside.min(axis=0), inside.max(axis=0)
    # About four lines across the shorter side; over the antimeridian or a pole a graticule is no help.
    if (high - low).max() > 90:
        return
    for axis, span in ((0, high[0] - low[0]), (1, high[1] - low[1])):
        step = next((step for step in _STEPS if span / step <= 5), _STEPS[-1])
        along = np.linspace(low[1 - axis], high[1 - axis], _SAMPLES)
        for k in range(math.ceil(low[axis] / step), math.floor(high[axis] / step) + 1):
            places = np.empty((_SAMPLES, 2))
            places[:, axis], places[:, 1 - axis] = k * step, along
            line = paper.at(places)
            drawing.path("graticule", [(float(x), float(y)) for x, y in line])
            _line_label(drawing, line, axis, degrees(k * step, "EW" if axis == 0 else "NS"))


def _line_label(drawing: Drawing, line: Array, axis: int, text: str) -> None:
    """Write what a meridian is at the lower edge, and what a parallel is at the left one, where it crosses them."""
    edge = drawing.height - 6 if axis == 0 else 5.0
    along, across = (line[:, 1], line[:, 0]) if axis == 0 else (line[:, 0], line[:, 1])
    order = np.argsort(along)
    if not along[order[0]] <= edge <= along[order[-1]]:
        return
    at = float(np.interp(edge, along[order], across[order]))
    if axis == 0 and 90 < at < drawing.width - 260:
        drawing.text(at + 3, edge, text, quiet=True)
    elif axis == 1 and 24 < at < drawing.height - 60:
        drawing.text(edge, at - 3, text, quiet=True)


def degrees(value: float, sides: str) -> str:
    """Return an angle in degrees, minutes and seconds, as far as they are not zero."""
    seconds = round(abs(value) * 3600)
    whole, minutes, rest = seconds // 3600, seconds // 60 % 60, seconds % 60
    text = f"{whole}°"
    if minutes or rest:
        text += f"{minutes:02d}′"
    if rest:
        text += f"{rest:02d}″"
    return f"{text} {sides[0] if value >= 0 else sides[1]}"


# -- scale and north -------------------------------------------------------------------------------------------------


def _scale(drawing: Drawing, paper: Paper, stretch: float, longest: float) -> None:
    _, per_metre = paper.middle()
    if not np.isfinite(per_metre).all():
        return
    east = float(np.hypot(*per_metre[0]))
    length = round_down(paper.width / 4 / east)
    right, base = drawing.width - 12.0, drawing.height - 12.0
    bars: Sequence[tuple[float, str]] = [(length * east, _distance(length))]
    if longest > 0:
        shown = round_down(longest / east)
        bars = [(shown * east * stretch, f"error of {_distance(shown)}"), *bars]
    for k, (size, text) in enumerate(reversed(bars)):
        y = base - 28.0 * k
        for kind in ("casing", "rule"):
            drawing.path(kind, [(right - size, y - 4), (right - size, y), (right, y), (right, y - 4)])
        drawing.text(right, y - 7, text, anchor="end")


def _north(drawing: Drawing, paper: Paper, found: Sequence[_Arrow], stretch: float) -> None:
    """Draw the north arrow in the first of some places near the edge that is free, else where most room is."""
    _, per_metre = paper.middle()
    if not np.isfinite(per_metre).all():
        return
    ux, uy = per_metre[1] / np.hypot(*per_metre[1])
    taken = [one.at for one in found]
    taken += [(one.at[0] + one.shift[0] * stretch, one.at[1] + one.shift[1] * stretch) for one in found]
    right, half = drawing.width - 26.0, drawing.height / 2
    places = [(right, 40.0), (60.0, 40.0), (drawing.width / 2, 40.0), (right, half), (60.0, half)]
    room = [min((math.dist(place, other) for other in taken), default=math.inf) for place in places]
    x, y = places[next((k for k, free in enumerate(room) if free > _ROOM), int(np.argmax(room)))]
    drawing.line("casing", x - 16 * ux, y - 16 * uy, x + 16 * ux, y + 16 * uy)
    drawing.arrow("bar", x - 16 * ux, y - 16 * uy, 32 * ux, 32 * uy)
    drawing.text(x + 26 * ux, y + 26 * uy + 4, "N", anchor="middle")


def _distance(metres: float) -> str:
    return f"{metres / 1000:g} km" if metres >= 1000 else (f"{metres:g} m" if metres >= 1 else f"{metres * 100:g} cm")
