"""Output of a reproduction: tables as text for the terminal, and a page with figures, curves and reasons."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.display.drawing import Axes, Drawing, round_down, style_sheet
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.models.base import Array
from ortho_studies.simulation.tables import VERDICTS, is_covered, is_missed

_SIDE, _MARGIN = 520.0, 18.0
_UNITS = {"px": ("pixel", "pixels"), "m": ("metre", "metres")}
_SOURCES = {
    "paper": "this paper",
    "published": "published elsewhere, or customary",
    "chosen": "chosen",
    "fitted": "fitted to",
}


@dataclass(frozen=True)
class Figure:
    """A drawing and its caption."""

    drawing: Drawing
    caption: str


@dataclass(frozen=True)
class Reason:
    """Why rows differ from the paper: all rows without a reason whose ``label quantity`` starts with `start`."""

    start: str
    why: str


UNEXPLAINED = Reason("", "Outside the factor; the cause is unknown.")


def text(document: Mapping[str, Any]) -> str:
    """Return the tables for a terminal; `!` marks rows that do not agree, `f` rows that settings were fitted to."""
    rows = [row for table in document["tables"] for row in table["rows"]]
    wide, narrow = (max([least, *(len(row[key]) for row in rows)]) for least, key in ((24, "label"), (8, "quantity")))
    lines = [document["paper"], document["settings_text"], ""]
    for table in document["tables"]:
        lines.append(f"Table {table['table']}: {table['title']}")
        heads = "".join(f" {head:>7}" for head in ("paper", "ours", "5 %", "95 %", "naive"))
        lines.append(f"   {'':<{wide}} {'':<{narrow}} {'':<2}{heads}")
        for row in table["rows"]:
            marks = f"{'!' if is_missed(row) else ' '}{'f' if row['role'] == 'fitted' else ' '}"
            ours = "".join(f" {_number(row[key]):>7}" for key in ("paper", "median", "p5", "p95", "naive"))
            lines.append(f"{marks} {row['label']:<{wide}} {row['quantity']:<{narrow}} {row['units']:<2}{ours}")
        lines.append("")
    for statement in document["statements"]:
        why = f" {statement['why']}" if statement["why"] else ""
        lines.append(
            f"{'!' if statement['verdict'] == VERDICTS[2] else ' '} {statement['text']} "
            f"{_capital(statement['verdict'])}: "
            f"{statement['detail']}.{why}"
        )
    return "\n".join([*lines, *([""] if document["statements"] else []), *verdict(document)])


def verdict(document: Mapping[str, Any]) -> list[str]:
    """Return the result in sentences: predictions compared with naive guesses, then the rest."""
    summary = document["summary"]
    wide, tight = (f"{factor:g}" for factor in summary["factors"])
    predicted, fitted, draws = (summary[role] for role in ("predicted", "fitted", "draw"))
    single = summary.get("single_realisation")
    sentences = []
    if predicted["rows"]:
        sentences += [
            f"{counted(predicted['rows'], 'number')} of the paper are predicted (no setting was fitted to them): "
            f"{_share(predicted, 'within', wide)} agree within a factor of {wide}, "
            f"{_share(predicted, 'within', tight)} within {tight}.",
            f"A naive guess without simulation agrees for {_share(predicted, 'naive', wide)} and "
            f"{_share(predicted, 'naive', tight)}. The guess: {document['naive_text']}",
            f"{_of(predicted['covered'], predicted['rows'])} are between our 5th and 95th percentile. "
            f"At best, {100 * single['median']:.0f} % ({100 * single['p5']:.0f} to {100 * single['p95']:.0f} %) can be "
            f"within {wide} of our medians: so many are if one of our own realisations takes the place of the paper.",
        ]
    if fitted["rows"]:
        sentences.append(
            f"Not counted: {counted(fitted['rows'], 'number')} that settings were fitted to "
            f"({_share(fitted, 'within', wide)} "
            f"within {wide}, {_share(fitted, 'within', tight)} within {tight})."
        )
    if draws["rows"]:
        sentences.append(
            f"Also not counted: {counted(draws['rows'], 'number')} that are single draws of an error with a known "
            f"spread ({draws['covered']} are between our 5th and 95th percentile)."
        )
    if document["statements"]:
        numbers = [sum(statement["verdict"] == which for statement in document["statements"]) for which in VERDICTS]
        sentences.append(
            f"Of {sum(numbers)} statements of the paper, {numbers[0]} are reproduced, {numbers[1]} are true because of "
            f"the settings, and {numbers[2]} are not reproduced."
        )
    return sentences


def _share(counted: Mapping[str, Any], what: str, factor: str) -> str:
    return _of(counted[what][factor], counted["rows"])


def _of(part: int, rows: int) -> str:
    return f"{part} ({100 * part / rows:.0f} %)"


def _capital(words: str) -> str:
    return words[:1].upper() + words[1:]


def knob_text(knob: Mapping[str, Any]) -> str:
    """Return value and units of a setting for people."""
    return f"{_shown(knob['value'])} {knob['units']}".strip()


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return "; ".join(f"{key}: {_shown(part)}" for key, part in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_shown(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)


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
        What the scenes are; the document's settings follow it.
    reasons : sequence of Reason
        Tried in order; the rest is said to be unexplained.
    """
    curves = [Figure(draw_curve(curve), curve["title"]) for curve in document["curves"]]
    return render(
        "simulation/reproduction.html.j2",
        package="ortho_studies",
        document=document,
        heading=heading,
        verdict=verdict(document),
        introduction=introduction,
        figures=[{"svg": figure.drawing.svg(), "caption": figure.caption} for figure in figures],
        curves=[{"svg": figure.drawing.svg(), "caption": figure.caption} for figure in curves],
        plot_style=style_sheet(),
        reasons=list(_reasons(document, [*reasons, UNEXPLAINED])),
        is_missed=is_missed,
        knob_text=knob_text,
        sources=_SOURCES,
        capital=_capital,
        number=_number,
    )


def _reasons(document: Mapping[str, Any], reasons: Sequence[Reason]) -> Iterator[dict[str, Any]]:
    """Yield the rows that do not agree, by their reason."""
    missed = [row for table in document["tables"] for row in table["rows"] if is_missed(row)]
    for reason in reasons:
        rows = [row for row in missed if f"{row['label']} {row['quantity']}".startswith(reason.start)]
        missed = [row for row in missed if row not in rows]
        if rows:
            chance = sum(is_covered(row) for row in rows)
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
    drawing.text(_MARGIN + bar * unit + 8, y + 4, f"{bar:g} {_UNITS[units][bar != 1]}")
    return drawing


def draw_curve(curve: Mapping[str, Any]) -> Drawing:
    """Draw the series of a `Curve` (as JSON) as lines, each with its name at its end."""
    drawing = Drawing(640, 380, curve["title"], "curve")
    xs = [value for series in curve["series"] for value in series["x"]]
    ys = [value for series in curve["series"] for value in series["y"] if value is not None]
    low, high = min(ys, default=0.0), max(ys, default=1.0)
    reach = (high - low) or 1.0
    floor = 0.0 if low >= 0 else low - 0.05 * reach
    axes = Axes(drawing, (58.0, 14.0, 430.0, 306.0), (min(xs), max(xs)), (floor, high + 0.05 * reach))
    axes.draw(curve["x_label"], curve["y_label"])
    ends: list[tuple[float, int, str]] = []
    for k, series in enumerate(curve["series"]):
        known = [(x, y) for x, y in zip(series["x"], series["y"], strict=True) if y is not None]
        if known:
            drawing.path(f"series-{k % 9}", [axes.at(x, y) for x, y in known])
            ends.append((axes.at(*known[-1])[1], k, series["name"]))
    level = -np.inf
    for y, k, name in sorted(ends):
        level = max(y, level + 15)
        drawing.line(f"series-{k % 9}", 494, level, 516, level)
        drawing.text(520, level + 4, name)
    return drawing


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
