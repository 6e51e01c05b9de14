"""How a reproduction is shown: tables as text for a terminal, and a page with figures, curves and reasons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.drawing import Axes, Drawing, round_down, style_sheet
from ortho_pipeline.experiments.tables import is_within
from ortho_pipeline.models.base import Array

_SIDE, _MARGIN = 520.0, 18.0
_UNITS = {
    "px": ("pixels", "pixel", "pixels"), "m": ("metres", "metre", "metres"), "px, m": ("pixels and metres", "", ""),
}  # fmt: skip


@dataclass(frozen=True)
class Figure:
    """A drawing and what stands below it."""

    drawing: Drawing
    caption: str


@dataclass(frozen=True)
class Reason:
    """Why rows differ from the paper: those (not yet explained) whose ``label quantity`` starts with `start`."""

    start: str
    why: str


UNEXPLAINED = Reason("", "Beyond the factor without a cause that we know of.")


def text(document: Mapping[str, Any]) -> str:
    """Return the tables for a terminal; `!` marks what is not within the factor, or does not hold."""
    wide = max([24, *(len(row["label"]) for table in document["tables"] for row in table["rows"])])
    narrow = max([8, *(len(row["quantity"]) for table in document["tables"] for row in table["rows"])])
    lines = [document["paper"], document["settings_text"], ""]
    for table in document["tables"]:
        lines.append(f"Table {table['table']}: {table['title']} ({_UNITS[document['units']][0]})")
        lines.append(f"  {'':<{wide}} {'':<{narrow}} {'paper':>7} {'ours':>7} {'5 %':>7} {'95 %':>7}")
        for row in table["rows"]:
            ours = "".join(f" {_number(row[key]):>7}" for key in ("paper", "median", "p5", "p95"))
            lines.append(f"{' ' if is_within(row) else '!'} {row['label']:<{wide}} {row['quantity']:<{narrow}}{ours}")
        lines.append("")
    for statement in document["statements"]:
        lines.append(f"{' ' if statement['holds'] else '!'} {statement['text']} ({statement['detail']})")
    return "\n".join([*lines, *([""] if document["statements"] else []), verdict(document)])


def verdict(document: Mapping[str, Any]) -> str:
    """Return how many numbers and statements of the paper ours agree with."""
    found = document["summary"]
    single, statements = found["single_realisation"], document["statements"]
    said = (
        f"{found['within']} of {found['rows']} rows ({100 * found['within'] / found['rows']:.1f} %) are within a "
        f"factor {found['factor']:g} of the paper. Were the paper one of our realisations, "
        f"{100 * single['median']:.0f} % ({100 * single['p5']:.0f} to {100 * single['p95']:.0f} %) would be."
    )
    if statements:
        said += f" {sum(one['holds'] for one in statements)} of {len(statements)} statements of the paper hold."
    return said


def page(
    document: Mapping[str, Any],
    *,
    heading: str,
    introduction: str,
    figures: Sequence[Figure] = (),
    reasons: Sequence[Reason] = (),
) -> str:
    """Return the page as HTML: verdict, introduction, figures, tables, statements, curves, and why some rows differ.

    Parameters
    ----------
    heading : str
        Title of the page.
    introduction : str
        What the scenes are and how the free settings were chosen; the document's settings follow it.
    reasons : sequence of Reason
        Tried in order; the rest is said to be unexplained.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ortho_pipeline"), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["number"] = _number
    curves = [Figure(draw_curve(curve), curve["title"]) for curve in document["curves"]]
    return environment.get_template("reproduction.html.j2").render(
        document=document,
        heading=heading,
        verdict=verdict(document),
        introduction=introduction,
        figures=[{"svg": figure.drawing.svg(), "caption": figure.caption} for figure in figures],
        curves=[{"svg": figure.drawing.svg(), "caption": figure.caption} for figure in curves],
        plot_style=style_sheet(),
        reasons=list(_reasons(document, [*reasons, UNEXPLAINED])),
        is_within=is_within,
    )


def _reasons(document: Mapping[str, Any], reasons: Sequence[Reason]) -> Iterator[dict[str, Any]]:
    """Yield the rows that are not within the factor, by their reason."""
    missed = [row for table in document["tables"] for row in table["rows"] if not is_within(row)]
    for reason in reasons:
        rows = [row for row in missed if f"{row['label']} {row['quantity']}".startswith(reason.start)]
        missed = [row for row in missed if row not in rows]
        if rows:
            chance = sum(row["median"] is not None and row["p5"] <= row["paper"] <= row["p95"] for row in rows)
            yield {"why": reason.why, "rows": rows, "chance": chance}


# -- drawings --------------------------------------------------------------------------------------------------------


def draw_vectors(
    label: str,
    image: Array,
    residuals: Array,
    size: tuple[float, float],
    *,
    units: str = "px",
    kind: str = "control",
    bar: float | None = None,
    side: float = _SIDE,
) -> Drawing:
    """Draw residuals ``(N, 2)``, enlarged, at their image points ``(N, 2)`` in a frame of `size` (columns, rows).

    Parameters
    ----------
    bar : float, optional
        Length of the scale bar, in units of the residuals; the scale of the arrows goes with it. Without it the
        longest arrow is an eighth of the frame, and the bar a round length.
    """
    shrink = (side - 2 * _MARGIN) / max(size)
    wide, tall = size[0] * shrink, size[1] * shrink
    lengths = np.hypot(*np.asarray(residuals, dtype=np.float64).T)
    longest = float(np.nanmax(lengths, initial=0.0)) or 1.0
    unit = side / 8 / longest if bar is None else side / 8 / bar
    bar = round_down(longest) if bar is None else bar
    drawing = Drawing(wide + 2 * _MARGIN, tall + 2 * _MARGIN + 26, label, "vectors")
    drawing.rect("frame", _MARGIN, _MARGIN, wide, tall)
    for place, miss in zip(np.asarray(image).tolist(), np.asarray(residuals).tolist(), strict=True):
        x, y = (_MARGIN + shrink * value for value in place)
        title = f"column {place[0]:.0f}, row {place[1]:.0f}: {miss[0]:+.2f}, {miss[1]:+.2f} {units}"
        with drawing.titled(title):
            drawing.mark(kind, x, y)
            drawing.arrow(kind, x, y, *(value * unit for value in miss))
    y = tall + 2 * _MARGIN + 12
    drawing.line("bar", _MARGIN, y, _MARGIN + bar * unit, y)
    drawing.text(_MARGIN + bar * unit + 8, y + 4, f"{bar:g} {_UNITS[units][1 if bar == 1 else 2]}")
    return drawing


def draw_curve(curve: Mapping[str, Any]) -> Drawing:
    """Draw the series of a `Curve` (as JSON) as lines, each with its name at its end."""
    drawing = Drawing(640, 380, curve["title"], "curve")
    xs = [value for one in curve["series"] for value in one["x"]]
    ys = [value for one in curve["series"] for value in one["y"] if value is not None]
    low, high = min(ys, default=0.0), max(ys, default=1.0)
    reach = (high - low) or 1.0
    floor = 0.0 if low >= 0 else low - 0.05 * reach
    axes = Axes(drawing, (58.0, 14.0, 430.0, 306.0), (min(xs), max(xs)), (floor, high + 0.05 * reach))
    axes.draw(curve["x_label"], curve["y_label"])
    ends: list[tuple[float, int, str]] = []
    for k, one in enumerate(curve["series"]):
        known = [(x, y) for x, y in zip(one["x"], one["y"], strict=True) if y is not None]
        if known:
            drawing.path(f"series-{k % 9}", [axes.at(x, y) for x, y in known])
            ends.append((axes.at(*known[-1])[1], k, one["name"]))
    level = -np.inf
    for y, k, name in sorted(ends):
        level = max(y, level + 15)
        drawing.line(f"series-{k % 9}", 494, level, 516, level)
        drawing.text(520, level + 4, name)
    return drawing


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
