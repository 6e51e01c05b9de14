"""Where matches were kept and rejected, and how their residuals scatter, drawn from the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from ortho_pipeline.display.drawing import Axes, Drawing, round_down
from ortho_pipeline.display.numbers import signed
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.records import Pair, is_known
from ortho_pipeline.report.gallery.matches import MatchPoint, in_words, shown
from ortho_pipeline.report.records import SceneReport

#: Drawing area of the map, the space around it, and the narrowest drawing, CSS px.
_SIDE, _PAD, _LEAST = 440.0, 24.0, 420.0
#: The longest vector as a share of the map's longer side, and the opacity of the field with the most matches.
_LONGEST, _DARKEST = 0.05, 0.3
#: Marks of rejected matches: polylines about their place, CSS px, by reason.
_MARKS: dict[str, tuple[list[Pair], ...]] = {
    "hidden": ([(-3, -3), (3, -3), (3, 3), (-3, 3), (-3, -3)],),
    "weak": ([(-3.5, 0), (3.5, 0)],),
    "ambiguous": ([(-3.5, -1.7), (3.5, -1.7)], [(-3.5, 1.7), (3.5, 1.7)]),
    "backward": ([(3.5, -3), (-3.5, 0), (3.5, 3)],),
    "not measured": ([(-3.5, 3), (0, -3.5), (3.5, 3), (-3.5, 3)],),
    "contradicts": ([(-3, -3), (3, 3)], [(3, -3), (-3, 3)]),
}
#: Of a reason that a later version of the file may have.
_OTHER: tuple[list[Pair], ...] = ([(0, -3.5), (0, 3.5)], [(-3.5, 0), (3.5, 0)])
_LINES = {"control": "control", "check": "check-line"}


# -- map -------------------------------------------------------------------------------------------------------------


def plot_matches(report: SceneReport) -> Drawing | None:
    """Draw kept matches with their residual vectors, rejected ones by reason, over fields shaded by matches kept."""
    found = shown(report)
    if report.matching is None or not found:
        return None
    width, height = report.scene.size
    scale = _SIDE / max(width, height)
    wide, tall = width * scale, height * scale
    left, top = max((_LEAST - wide) / 2, _PAD), _PAD + 6
    rows = _legend_rows(found, max(wide + 2 * left, _LEAST) - 2 * _PAD)
    base = top + tall + 28
    drawing = Drawing(
        wide + 2 * left,
        base + 20 * len(rows) + 4,
        f"Map of {counted(len(found), 'match', 'matches')}, kept and rejected, over the frame of the image",
        "matches",
    )
    _fields(drawing, report.matching.coverage.kept, (left, top, wide, tall))
    drawing.rect("frame", left, top, wide, tall)
    drawing.text(left, top - 5, "0, 0", quiet=True)
    drawing.text(left + wide, top + tall + 14, f"{width}, {height}", quiet=True, anchor="end")

    def at(one: MatchPoint) -> Pair:
        return left + one.candidate.image[0] * scale, top + one.candidate.image[1] * scale

    for kind, some in _by_kind(found).items():
        if kind not in _LINES:
            _crosses(drawing, kind, [at(one) for one in some])
    longest = max((one.length for one in found if one.kind in _LINES), default=-1.0)
    arrow = _LONGEST * _SIDE / longest if longest > 0 else 0.0
    for kind, line in _LINES.items():
        _vectors(drawing, kind, line, [(at(one), one.residual) for one in found if one.kind == kind], arrow)
    for k, row in enumerate(rows):
        _legend(drawing, row, base + 20 * k)
    if arrow > 0:
        size = round_down(longest)
        drawing.line("bar", left, top + tall + 10, left + size * arrow, top + tall + 10)
        drawing.text(left + size * arrow + 6, top + tall + 14, f"residual of {size:g} px", quiet=True)
    return drawing


def _by_kind(found: Sequence[MatchPoint]) -> dict[str, list[MatchPoint]]:
    """Return matches by what they are drawn as: control, check, left out, then the reasons."""
    order = ["control", "check", "out", *_MARKS]
    kinds = sorted({one.kind for one in found}, key=lambda kind: (order.index(kind) if kind in order else 99, kind))
    return {kind: [one for one in found if one.kind == kind] for kind in kinds}


def _fields(drawing: Drawing, kept: Sequence[Sequence[int]], frame: tuple[float, float, float, float]) -> None:
    most = max((count for row in kept for count in row), default=0)
    left, top, wide, tall = frame
    for j, row in enumerate(kept):
        for i, count in enumerate(row):
            with drawing.titled(f"{counted(count, 'match', 'matches')} kept"):
                drawing.rect(
                    "plus",
                    left + i * wide / len(row),
                    top + j * tall / len(kept),
                    wide / len(row),
                    tall / len(kept),
                    _DARKEST * count / most if most else 0.0,
                )


def _crosses(drawing: Drawing, kind: str, places: Sequence[Pair]) -> None:
    mark = _MARKS["contradicts"] if kind == "out" else _MARKS.get(kind, _OTHER)
    lines = [[(x + dx, y + dy) for dx, dy in line] for x, y in places for line in mark]
    drawing.path("control" if kind == "out" else "out", *lines)


def _vectors(drawing: Drawing, kind: str, line: str, found: Sequence[tuple[Pair, Pair | None]], arrow: float) -> None:
    """Draw all vectors as one thing, and where each begins: hundreds of arrows of their own would fill the page."""
    lines = [[(x, y), (x + vector[0] * arrow, y + vector[1] * arrow)] for (x, y), vector in found if vector]
    if lines:
        drawing.path(line, *lines)
    for (x, y), _ in found:
        if kind == "check":
            drawing.rect("check-head", x - 2.4, y - 2.4, 4.8, 4.8)
        else:
            drawing.circle("control-head", x, y, 2.2)


def _legend_rows(found: Sequence[MatchPoint], room: float) -> list[list[tuple[str, str, float]]]:
    """Return the legend as rows of kind, text and how far to the right, px."""
    names = {"control": "control", "check": "check (held out)", "out": "rejected by the adjustment"}
    rows: list[list[tuple[str, str, float]]] = []
    x = math.inf
    for kind, some in _by_kind(found).items():
        text = f"{len(some)} {names.get(kind) or in_words(kind)}"
        size = 34 + 6.4 * len(text)
        if x + size - 16 > room:
            rows.append([])
            x = 4.0
        rows[-1].append((kind, text, x))
        x += size
    return rows


def _legend(drawing: Drawing, row: Sequence[tuple[str, str, float]], y: float) -> None:
    for kind, text, x in row:
        if kind in _LINES:
            _vectors(drawing, kind, _LINES[kind], [((_PAD + x, y), None)], 0.0)
        else:
            _crosses(drawing, kind, [(_PAD + x, y)])
        drawing.text(_PAD + x + 10, y + 4, text)


# -- histograms --------------------------------------------------------------------------------------------------------


def plot_match_histograms(report: SceneReport) -> Drawing | None:
    """Draw how residuals scatter along and across the line of sight; in columns and rows for a view straight down."""
    names, found = residuals_by_axis(report)
    if len(found) < 2:
        return None
    control = np.array([vector for kind, vector in found if kind == "control"]).reshape(-1, 2)
    check = np.array([vector for kind, vector in found if kind == "check"]).reshape(-1, 2)
    reach = max(float(np.abs(part).max(initial=0.0)) for part in (control, check)) or 1.0
    step = round_down(2 * reach / math.sqrt(len(found)))
    edges = step * np.arange(-math.ceil(reach / step + 1e-9), math.ceil(reach / step + 1e-9) + 1)
    drawing = Drawing(
        420,
        470,
        f"Residuals of {counted(len(found), 'match', 'matches')}, {names[0]} and {names[1]}",
        "match_histograms",
    )
    tops = [np.histogram(part[:, axis], edges)[0] for part in (control, check) for axis in (0, 1)]
    high = 1.08 * max(1, *(int((one + other).max()) for one, other in zip(tops[:2], tops[2:], strict=True)))
    for axis in (0, 1):
        frame = (52.0, 20.0 + 212 * axis, 354.0, 148.0)
        axes = Axes(drawing, frame, (float(edges[0]), float(edges[-1])), (0.0, high))
        axes.draw(f"{names[axis]}, px", "matches")
        _bars(axes, edges, tops[axis], tops[2 + axis])
        both = np.concatenate([control[:, axis], check[:, axis]])
        said = f"mean {signed(float(both.mean()))}, σ {both.std(ddof=1):.2f} px"
        drawing.text(frame[0] + frame[2], frame[1] - 6, said, anchor="end", quiet=True)
    x = 56.0
    for kind, name, count in (("plus", "control", len(control)), ("minus", "check (held out)", len(check))):
        if count:
            drawing.rect(kind, x - 6, 447, 12, 12)
            drawing.text(x + 11, 457, f"{count} {name}")
            x += 60 + 6.6 * len(name)
    return drawing


def residuals_by_axis(report: SceneReport) -> tuple[tuple[str, str], list[tuple[str, Pair]]]:
    """Return the names of the two axes that residuals are shown along, and kind and residual of each match.

    Along and across the line of sight; columns and rows where a match is seen from straight above.
    """
    points = [(one.kind, one.point) for one in shown(report) if one.kind in _LINES and one.residual is not None]
    views = [(kind, point.view_residual) for kind, point in points if point is not None]
    seen = [(kind, vector) for kind, vector in views if is_known(vector)]
    if seen and len(seen) == len(views):
        return ("along the line of sight", "across the line of sight"), seen
    plain = [(kind, point.residual) for kind, point in points if point is not None]
    return ("column", "row"), [(kind, vector) for kind, vector in plain if is_known(vector)]


def _bars(axes: Axes, edges: np.ndarray, control: np.ndarray, check: np.ndarray) -> None:
    """Draw bars of check matches on those of control."""
    for (low, high), lower, upper in zip(pairwise(edges.tolist()), control.tolist(), check.tolist(), strict=True):
        for kind, foot, head in _stacked(lower, upper):
            (left, top), (right, base) = axes.at(low, head), axes.at(high, foot)
            with axes.drawing.titled(f"{low:.3g} to {high:.3g} px: {lower} control, {upper} check"):
                axes.drawing.rect(kind, left + 0.5, top, right - left - 1, base - top)


def _stacked(lower: int, upper: int) -> Iterator[tuple[str, int, int]]:
    if lower:
        yield "plus", 0, lower
    if upper:
        yield "minus", lower, lower + upper
