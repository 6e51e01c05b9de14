"""The plots of the report, each drawn from the report itself."""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from ortho_pipeline.display.drawing import Axes, Drawing, number, round_down
from ortho_pipeline.display.notices import doubted
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.choice.comparison import ComparedModel
from ortho_pipeline.estimation.records import Pair, Point, is_known
from ortho_pipeline.estimation.spatial.correlation import Covariance
from ortho_pipeline.report.gallery.plots import plot_match_histograms, plot_matches
from ortho_pipeline.report.layers.accuracy import plot_accuracy
from ortho_pipeline.report.records import SceneReport

#: Drawing area of the plot of vectors in CSS pixels, and the space around it.
_PLOT_WIDTH, _PLOT_HEIGHT, _PAD = 452.0, 460.0, 19.0
#: Least space between the head of an arrow and the edge of the drawing, CSS pixels.
_EDGE = 5.0
#: The longest arrow, as a share of the drawing area.
_LONGEST = 0.13
#: With more points than this, their ids would hide the arrows.
_MAX_LABELS = 60
#: With more parameters than this, a matrix of correlations cannot be read.
_MAX_PARAMETERS = 80


def plots(report: SceneReport) -> dict[str, Drawing]:
    """Return every plot for which the report has data, by name."""
    makers: dict[str, Callable[[SceneReport], Drawing | None]] = {
        "residuals": plot_residuals,
        "directions": plot_directions,
        "heights": plot_heights,
        "correlation": plot_correlation,
        "neighbours": plot_neighbours,
        "relative": plot_relative,
        "comparison": plot_comparison,
        "matches": plot_matches,
        "accuracy": lambda report: plot_accuracy(report.accuracy),
        "match_histograms": plot_match_histograms,
    }
    made = {name: make(report) for name, make in makers.items()}
    return {name: drawing for name, drawing in made.items() if drawing is not None}


class Drawn(NamedTuple):
    """A point that is drawn: its place in the image and its residual, px; its number in the report; and its mark."""

    point: Point
    image: Pair
    residual: Pair
    number: int
    kind: str


def _drawn(report: SceneReport) -> list[Drawn]:
    return [
        Drawn(point, point.image, point.residual, k, point.kind)
        for k, point in enumerate(report.adjustment.points)
        if is_known(point.image) and is_known(point.residual) and point.role != "tie"
    ]


# -- vectors ---------------------------------------------------------------------------------------------------------


def plot_residuals(report: SceneReport) -> Drawing | None:
    """Draw the residual vectors over the frame of the image, with the hull of the control points.

    Used control points are dots, check points squares, points that were left out crosses without an arrow. Points
    outside of the image are drawn where they are, tie points not at all, matches on a map of their own.
    """
    # The map of matches has their residuals.
    points = [point for point in _drawn(report) if point.image not in report.matched_places]
    if not points:
        return None
    width, height = report.scene.size
    image = np.array([point.image for point in points])
    low, high = np.minimum(image.min(axis=0), 0.0), np.maximum(image.max(axis=0), (width, height))
    scale = min(_PLOT_WIDTH / (high[0] - low[0]), _PLOT_HEIGHT / (high[1] - low[1]))
    wide, tall = (high - low) * scale + 2 * _PAD
    wide = max(float(wide), 340.0)
    shift = np.array([(wide - (high[0] - low[0]) * scale) / 2, _PAD]) - low * scale
    lengths = [math.hypot(*point.residual) for point in points if point.kind != "out"]
    longest = max(lengths, default=0.0)
    arrow = _LONGEST * min(_PLOT_WIDTH, max(tall - 2 * _PAD, wide / 2)) / longest if longest > 0 else 0.0
    # Room for arrows that leave the frame.
    ends = image * scale + shift + arrow * np.array([p.residual if p.kind != "out" else (0.0, 0.0) for p in points])
    before = np.maximum(_EDGE - ends.min(axis=0), 0.0)
    after = np.maximum(ends.max(axis=0) + _EDGE - (wide, tall), 0.0)
    wide, tall = (before + after + (wide, tall)).tolist()
    shift += before
    label = f"Residual vectors of {counted(len(points), 'point')} over the frame of the image"
    drawing = Drawing(wide, tall + 36, label, "residuals")
    x0, y0 = shift
    if report.control_hull and report.control_hull.outline:
        corners = [tuple(np.array(corner) * scale + shift) for corner in report.control_hull.outline]
        drawing.path("hull", corners, closed=True)
    drawing.rect("frame", x0, y0, width * scale, height * scale)
    drawing.text(x0, y0 - 8, "0, 0", quiet=True)
    drawing.text(x0 + width * scale, y0 + height * scale + 15, f"{width}, {height}", quiet=True, anchor="end")
    wrong = doubted(report.adjustment.notices)
    for point in points:
        at = np.array(point.image) * scale + shift
        if point.point.id in wrong:
            drawing.circle("doubted", float(at[0]), float(at[1]), 9.0)
        _draw_point(drawing, point, at, arrow, len(points) <= _MAX_LABELS)
    _legend(drawing, points, tall + 20)
    if longest > 0:
        size = round_down(longest)
        bar = size * arrow
        drawing.arrow("bar", wide - _PAD - bar, tall + 20, bar, 0.0)
        drawing.text(wide - _PAD - 8 - bar, tall + 24, f"{size:g} px", anchor="end")
    return drawing


def _draw_point(drawing: Drawing, point: Drawn, at: Any, arrow: float, label: bool) -> None:
    x, y = (float(value) for value in at)
    dx, dy = (value * arrow for value in point.residual)
    kind = point.kind
    with drawing.titled(_title(point), key=point.number):
        if kind != "out":
            drawing.arrow(kind, x, y, dx, dy)
        drawing.mark(kind, x, y)
        if label:
            # Next to the point, on the side that the arrow does not go to.
            down = 4 if abs(dx) > abs(dy) else (-5 if dy > 0 else 12)
            drawing.caption(x, y + down, point.point.id, 9, left=dx > 0, quiet=kind == "out")


def _title(shown: Drawn) -> str:
    point, (column, row) = shown.point, shown.residual
    lines = [f"{point.id} ({point.role}{', left out' if point.kind == 'out' else ''})"]
    lines.append(f"residual {column:+.3f}, {row:+.3f} px")
    if is_known(point.residual_m):
        lines.append("on the ground {:+.2f}, {:+.2f} m".format(*point.residual_m))
    if is_known(point.loo_residual):
        lines.append("left out {:+.3f}, {:+.3f} px".format(*point.loo_residual))
    return "\n".join(lines)


def _legend(drawing: Drawing, points: Sequence[Drawn], y: float) -> None:
    names = {"control": "control", "check": "check", "out": "left out"}
    present = {point.kind for point in points}
    x = _PAD + 4.0
    for kind, name in names.items():
        if kind in present:
            drawing.mark(kind, x, y)
            drawing.text(x + 11, y + 4, name)
            x += 32 + 6.6 * len(name)


# -- scatter ---------------------------------------------------------------------------------------------------------


def plot_directions(report: SceneReport) -> Drawing | None:
    """Draw residuals along the direction of view against those across it, on equal axes."""
    points = [(one, one.point.view_residual) for one in _drawn(report)]
    seen = [(one, vector) for one, vector in points if is_known(vector)]
    kept = [max(abs(along), abs(across)) for one, (along, across) in seen if one.kind != "out"]
    if not kept:
        return None
    reach = 1.12 * max(kept) or 1.0
    inside = [(one, vector) for one, vector in seen if max(abs(vector[0]), abs(vector[1])) <= reach]
    drawing = Drawing(420, 420, "Residuals along and across the direction of view", "directions")
    axes = Axes(drawing, (52.0, 14.0, 354.0, 316.0), (-reach, reach), (-reach, reach))
    axes.draw("along the direction of view, px", "across, px")
    for one, vector in inside:
        with drawing.titled(_title(one), key=one.number):
            drawing.mark(one.kind, *axes.at(*vector))
    _legend(drawing, [one for one, _ in inside], 406)
    return drawing


def plot_heights(report: SceneReport) -> Drawing | None:
    """Draw residuals along the direction of view (in rows, for a view straight down) against height."""
    points = [one for one in _drawn(report) if one.point.height_m is not None]
    viewed = all(is_known(one.point.view_residual) for one in points if one.kind != "out")
    found = [(one, one.point.height_m or 0.0, _upward(one, viewed)) for one in points]
    kept = [(height, value) for one, height, value in found if one.kind != "out" and value is not None]
    heights = [height for height, _ in kept]
    if len(kept) < 3 or max(heights) - min(heights) < 1.0:
        return None
    reach = 1.12 * max(abs(value) for _, value in kept) or 1.0
    margin = 0.06 * (max(heights) - min(heights))
    low, high = min(heights) - margin, max(heights) + margin
    # Points that were left out only where they do not squeeze the others.
    inside = [
        (one, height, value)
        for one, height, value in found
        if value is not None and (one.kind != "out" or (abs(value) <= reach and low <= height <= high))
    ]
    drawing = Drawing(420, 420, "Residuals against the height of the points", "heights")
    axes = Axes(drawing, (52.0, 14.0, 354.0, 316.0), (low, high), (-reach, reach))
    axes.draw("height above the ellipsoid, m", "along the view, px" if viewed else "row, px")
    for one, height, value in inside:
        with drawing.titled(f"{_title(one)}\nheight {height:.1f} m", key=one.number):
            drawing.mark(one.kind, *axes.at(height, value))
    _legend(drawing, [one for one, _, _ in inside], 406)
    return drawing


def _upward(one: Drawn, viewed: bool) -> float | None:
    """Return the residual in which an error of height shows: along the direction of view, or in rows without one."""
    if not viewed:
        return one.residual[1]
    return one.point.view_residual[0] if one.point.view_residual else None


# -- correlations ----------------------------------------------------------------------------------------------------


def plot_correlation(report: SceneReport) -> Drawing | None:
    """Draw the correlations of the parameters as a matrix of cells, the stronger the darker."""
    adjustment = report.adjustment
    names = list(adjustment.parameters)
    matrix = adjustment.statistics.correlation if adjustment.statistics else ()
    if not 2 <= len(names) <= _MAX_PARAMETERS or len(matrix) != len(names):
        return None
    room = 10 + 6.6 * max(map(len, names))
    cell = min(34.0, 380.0 / len(names))
    written = cell >= 11
    size = cell * len(names)
    room = room if written else 14.0
    drawing = Drawing(max(room + size + 12, 340.0), size + room + 34, "Correlations of the parameters", "correlation")
    for i, row in enumerate(matrix):
        y = 8 + i * cell
        if written:
            drawing.text(room - 6, y + cell / 2 + 4, names[i], anchor="end")
            drawing.text(room + (i + 0.5) * cell + 4, 8 + size + 6, names[i], anchor="end", turn=True)
        for j, value in enumerate(row):
            if value is None:
                continue
            with drawing.titled(f"{names[i]}, {names[j]}: {value:+.3f}"):
                kind = "plus" if value >= 0 else "minus"
                # A floor, so that the pointer finds also the cells of no correlation.
                strength = max(abs(value), 0.02)
                drawing.rect(kind, room + j * cell + 0.5, y + 0.5, cell - 1, cell - 1, strength)
    drawing.rect("frame", room, 8, size, size)
    base = size + room + 26
    for k, value in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0)):
        x = room + k * 44
        drawing.rect("plus" if value >= 0 else "minus", x, base - 10, 12, 12, max(abs(value), 0.02))
        drawing.text(x + 15, base, number(value), quiet=True)
    return drawing


# -- distances -------------------------------------------------------------------------------------------------------


def plot_neighbours(report: SceneReport) -> Drawing | None:
    """Draw the correlation of residuals against the distance of points, with what chance does to each class."""
    if report.covariance.drawn is None:
        return None
    role, found = report.covariance.drawn
    classes = found.classes
    reach = max(abs(value) for one in classes for value in (*one.correlation, 2 / math.sqrt(one.pairs)))
    reach = max(1.08 * reach, 0.3)
    drawing, axes = _distance_axes(found, (-reach, reach), "correlation of residuals", "neighbours")
    # Products of independent residuals are uncorrelated among pairs: two standard deviations of their mean.
    for one in classes:
        chance = min(2 / math.sqrt(one.pairs), reach)
        (left, top), (right, low) = axes.at(one.from_m, chance), axes.at(one.to_m, -chance)
        drawing.rect("chance", left, top, right - left, low - top)
    _series(axes, found, "correlation", role)
    drawing.rect("chance", 236, 396, 14, 12)
    drawing.text(256, 406, "chance (95 %)")
    return drawing


def plot_relative(report: SceneReport) -> Drawing | None:
    """Draw the relative standard deviation against the distance of points, and the fitted covariance function."""
    if report.covariance.drawn is None:
        return None
    role, found = report.covariance.drawn
    high = 1.12 * max(max(one.relative) for one in found.classes) or 1.0
    drawing, axes = _distance_axes(found, (0.0, high), f"relative standard deviation, {found.unit}", "relative")
    fitted = found.verdict == "systematic"
    if fitted:
        at = np.linspace(0.0, axes.x[1], 60)
        for function, p in zip(found.functions, found.p or (1.0, 1.0), strict=True):
            if function is None or p >= 0.05:
                continue
            shared = function.systematic**2 * -np.expm1(-at / function.range_m)
            curve = [axes.at(x, y) for x, y in zip(at, np.sqrt(function.noise**2 + shared), strict=True)]
            for start, end in itertools.pairwise(curve):
                drawing.line("axis", *start, *end)
    _series(axes, found, "relative", role)
    if fitted:
        drawing.line("axis", 236, 402, 256, 402)
        drawing.text(262, 406, "covariance function")
    return drawing


def _distance_axes(found: Covariance, y: tuple[float, float], y_name: str, name: str) -> tuple[Drawing, Axes]:
    """Return a drawing with axes for values of classes of distance."""
    drawing = Drawing(420, 420, f"{y_name} against the distance of points", name)
    axes = Axes(drawing, (52.0, 14.0, 354.0, 316.0), (0.0, found.classes[-1].to_m), y)
    axes.draw("distance of points, m", y_name)
    return drawing, axes


def _series(axes: Axes, found: Covariance, key: Literal["correlation", "relative"], role: str) -> None:
    """Draw the values of all classes, one line per axis of the ground: x filled and solid, y hollow and dashed."""
    looks = {
        "control": (("control", "control"), ("control-dash", "loo")),
        "check": (("check-line", "check-head"), ("check-dash", "check")),
    }
    drawing, values = axes.drawing, operator.attrgetter(key)
    for k, (line, mark) in enumerate(looks[role]):
        at = [axes.at(one.distance_m, values(one)[k]) for one in found.classes]
        for start, end in itertools.pairwise(at):
            drawing.line(line, *start, *end)
        for (x, y), one in zip(at, found.classes, strict=True):
            title = (
                f"{'xy'[k]}: {values(one)[k]:.2f}, {one.from_m:.0f} to {one.to_m:.0f} m, {counted(one.pairs, 'pair')}"
            )
            with drawing.titled(title):
                drawing.circle(mark, x, y, 3.4)
        left = 58 + 84 * k
        drawing.line(line, left - 12, 402, left + 12, 402)
        drawing.circle(mark, left, 402, 3.4)
        drawing.text(left + 18, 406, ("x (east)", "y (north)")[k])


# -- comparison ------------------------------------------------------------------------------------------------------


def plot_comparison(report: SceneReport) -> Drawing | None:
    """Draw the RMSE of every compared model on a logarithmic axis: the fit, left out in turn, check points."""
    compared = report.comparison
    if compared is None:
        return None
    rows = [(row, _totals(row)) for row in compared.rows if not row.error]
    values = [value for _, totals in rows for value in totals.values() if value > 1e-6]
    if not rows or not values:
        return None
    low, high = min(values) / 1.25, max(values) * 1.25
    room = 14 + 6.6 * max(len(row.model) for row, _ in rows)
    wide, step = 700.0, 24.0
    tall = step * len(rows)
    drawing = Drawing(wide, tall + 70, "RMSE of the compared models", "comparison")
    span = math.log(high / low)

    def across(value: float) -> float:
        return room + (wide - room - 20) * math.log(max(value, low) / low) / span

    for value in _log_ticks(low, high):
        drawing.line("grid", across(value), 6, across(value), tall + 6)
        drawing.text(across(value), tall + 22, f"{value:g}", anchor="middle", quiet=True)
    chosen = compared.recommendation.model
    for k, (row, totals) in enumerate(rows):
        y = 6 + step * (k + 0.5)
        if row.model == chosen:
            drawing.rect("chosen", 0, y - step / 2, wide, step)
        drawing.text(room - 10, y + 4, row.model, anchor="end")
        said = [f"{kind} {value:.3g} px" for kind, value in totals.items()]
        with drawing.titled(f"{row.model}, {counted(row.parameters, 'parameter')}\n" + "\n".join(said)):
            found = {kind: across(value) for kind, value in totals.items()}
            drawing.line("axis", min(found.values()), y, max(found.values()), y)
            for kind, x in found.items():
                drawing.mark(kind, x, y)
    x = room
    for kind, name in (("control", "control (the fit)"), ("loo", "each left out in turn"), ("check", "check")):
        drawing.mark(kind, x, tall + 48)
        drawing.text(x + 11, tall + 52, name)
        x += 34 + 6.4 * len(name)
    drawing.text(wide - 20, tall + 52, "RMSE, px", anchor="end", quiet=True)
    return drawing


def _totals(row: ComparedModel) -> dict[str, float]:
    """Return the RMSE (px) of a model by what it is drawn as."""
    kinds = (("control", row.rmse.control), ("loo", row.rmse.loo), ("check", row.rmse.check))
    return {kind: rmse.total for kind, rmse in kinds if rmse is not None}


def _log_ticks(low: float, high: float) -> list[float]:
    steps = (1, 2, 5) if math.log10(high / low) < 3 else (1,)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    return [
        float(f"{step * 10.0**power:.3g}") for power in powers for step in steps if low <= step * 10.0**power <= high
    ]
