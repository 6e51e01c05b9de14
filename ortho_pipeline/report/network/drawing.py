"""The network drawn: outlines of the images north up, the points in them, and between images a line of their ties."""

from __future__ import annotations

import math

import numpy as np

from ortho_pipeline.display.drawing import Drawing, round_down
from ortho_pipeline.display.notices import doubted
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.geodesy.ellipsoid import longitudes_near, metres_per_degree
from ortho_pipeline.models.base import Array
from ortho_pipeline.report.block_records import BlockReport

#: Longer side of the drawing and its margin, CSS px; points, pairs and names beyond which none are drawn.
_SIDE, _MARGIN, _POINTS, _PAIRS, _NAMES = 560.0, 26.0, 800, 400, 24
#: Between images that lie on each other a line (px) would be a speck.
_SHORT = 16.0


def plot_network(report: BlockReport) -> Drawing | None:
    """Draw where the images lie and what ties them; nothing if no image has a place."""
    outlines = {label: np.array(image.outline) for label, image in report.images.items() if image.outline}
    if not outlines:
        return None
    first = next(iter(outlines.values()))[0, 0]
    for corners in outlines.values():
        # Over the antimeridian longitudes go on.
        corners[:, 0] = longitudes_near(corners[:, 0], first)
    paper = _Paper(np.concatenate(list(outlines.values())))
    said = f"{counted(len(outlines), 'image')} and {counted(len(report.adjustment.points), 'point')} of the block"
    drawing = Drawing(paper.width, paper.height + 22.0, f"Map of {said}, north up", "network")
    for k, (label, corners) in enumerate(outlines.items()):
        image = report.images[label]
        seen = "" if image.incidence_deg is None else f"\nseen {image.incidence_deg:.1f}° off the vertical"
        with drawing.titled(f"{label}: {image.model}{seen}"):
            drawing.path(f"outline-{k % 6}", [tuple(at) for at in paper.at(corners).tolist()], closed=True)
    middles = {label: paper.at(corners).mean(axis=0) for label, corners in outlines.items()}
    _draw_pairs(drawing, report, middles)
    _draw_points(drawing, report, paper, float(first))
    _draw_names(drawing, {label: paper.at(corners) for label, corners in list(outlines.items())[:_NAMES]})
    length = round_down(paper.width / paper.scale / 4)
    left, base = _MARGIN, drawing.height - 8.0
    drawing.path(
        "rule",
        [(left, base - 4), (left, base), (left + length * paper.scale, base), (left + length * paper.scale, base - 4)],
    )
    drawing.text(left + length * paper.scale + 8, base, f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m")
    return drawing


class _Paper:
    """Pixels of the drawing (north up, true to scale in the middle) of longitudes and latitudes."""

    def __init__(self, lon_lat: Array) -> None:
        middle = (lon_lat.min(axis=0) + lon_lat.max(axis=0)) / 2
        self.metres = metres_per_degree(np.array([[*middle, 0.0]]))[0] * (1.0, -1.0)
        low = (lon_lat * self.metres).min(axis=0)
        size = (lon_lat * self.metres).max(axis=0) - low
        self.scale = (_SIDE - 2 * _MARGIN) / max(float(size.max()), 1e-6)
        self.low = low
        self.width, self.height = (float(value) * self.scale + 2 * _MARGIN for value in size)

    def at(self, lon_lat: Array) -> Array:
        found: Array = (np.asarray(lon_lat) * self.metres - self.low) * self.scale + _MARGIN
        return found


def _draw_names(drawing: Drawing, outlines: dict[str, Array]) -> None:
    """Write the name of each image inside the corner that lies farthest out and where no other name stands yet."""
    taken: list[Array] = []
    out = np.concatenate([*outlines.values()]).mean(axis=0) if outlines else np.zeros(2)
    for label, corners in outlines.items():
        middle = corners.mean(axis=0)
        places = corners + 0.07 * (middle - corners)
        order = sorted(range(4), key=lambda k: -float(np.hypot(*(places[k] - out))))
        free = [k for k in order if all(np.hypot(*((places[k] - other) / (2.5, 1.0))) > 18 for other in taken)]
        at = places[(free or order)[0]]
        taken.append(at)
        drawing.text(float(at[0]), float(at[1]) + 4, label, anchor="start" if at[0] < middle[0] else "end")


def _draw_pairs(drawing: Drawing, report: BlockReport, middles: dict[str, Array]) -> None:
    """Draw a line between images with points in common, the wider the more."""
    pairs = [one for one in report.network.pairs if {one.first, one.second} <= middles.keys()]
    most = max((one.points for one in pairs), default=1)
    for one in sorted(pairs, key=lambda one: -one.points)[:_PAIRS]:
        (x1, y1), (x2, y2) = (middles[name].tolist() for name in (one.first, one.second))
        if math.hypot(x2 - x1, y2 - y1) < _SHORT:
            if not one.weak:
                continue
            # A warning names this pair: a line across both middles.
            middle = (x1 + x2) / 2
            x1, x2 = middle - _SHORT, middle + _SHORT
        text = f"{one.first} – {one.second}: {counted(one.points, 'point')} in common, rays {one.angle_deg:.1f}° apart"
        if one.sigma_px is not None:
            text += f"\nrelative position: sigma {significant(one.sigma_px)} px"
        look = "weak" if one.weak else "link-wide" if one.points > most / 2 else "link"
        with drawing.titled(text):
            drawing.line(look, x1, y1, x2, y2)
            if math.hypot(x2 - x1, y2 - y1) > 60 and len(pairs) <= _NAMES:
                drawing.text((x1 + x2) / 2 + 5, (y1 + y2) / 2 - 5, str(one.points), quiet=True)


def _draw_points(drawing: Drawing, report: BlockReport, paper: _Paper, first: float) -> None:
    """Draw the points by their role: control and check above ties, of which some stand for many."""
    rays: dict[str, int] = {}
    for ray in report.adjustment.rays:
        if ray.used:
            rays[ray.id] = rays.get(ray.id, 0) + 1
    placed = [
        (one, angle)
        for one, angle in zip(report.adjustment.points, report.network.largest_deg, strict=True)
        if None not in one.ground
    ]
    ties = [one for one in placed if one[0].role == "tie"]
    known = [one for one in placed if one[0].role != "tie"]
    wrong = doubted(report.notices)
    for point, angle in (*ties[:: max(1, len(ties) // _POINTS)], *known[:_POINTS]):
        lon, lat = point.ground[0] or 0.0, point.ground[1] or 0.0
        at = paper.at(np.column_stack([longitudes_near(np.array([lon]), first), [lat]]))[0]
        meet = "" if angle is None else f", which meet at {angle:.1f}°"
        with drawing.titled(f"{point.id} ({point.role}): {counted(rays.get(point.id, 0), 'ray')}{meet}"):
            if point.role == "tie":
                drawing.circle("tie-mark", float(at[0]), float(at[1]), 1.6)
            else:
                out = point.role == "control" and not point.used_ground
                drawing.mark("out" if out else point.role, float(at[0]), float(at[1]))
            if point.id in wrong:
                drawing.circle("doubted", float(at[0]), float(at[1]), 8.0)
                drawing.text(float(at[0]) + 11, float(at[1]) + 4, point.id)
