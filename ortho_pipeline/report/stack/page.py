"""The page of a stack: timeline of corrections, graph of pairs, closures, map of moving ground, and chips."""

from __future__ import annotations

import math
import os
from datetime import datetime

from ortho_pipeline.display.drawing import Axes, Drawing, style_sheet
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files import write_text
from ortho_pipeline.report.page.advice import WORDS, signals
from ortho_pipeline.report.stack.chips import ChipSheet
from ortho_pipeline.report.stack.records import StackRecord

#: Frame of the timeline, space to its left and below; longer side of the map, and its longest arrow, CSS px.
_FRAME, _LEFT, _BELOW = (640.0, 220.0), 62.0, 46.0
_MAP, _PAD, _ARROW = 420.0, 16.0, 26.0
#: Half of a 95 % interval in sigmas.
_INTERVAL = 1.96
_ROWS = 400
_USE = Text("You can use the stack within this accuracy.")
_FIT = Text(
    "The dates fit each other within this accuracy. If the absolute position matters, choose a date that was made with "
    "control points as the datum (",
    Setting("stack.datum"),
    "), or give a reference (",
    Setting("match.reference"),
    " and ",
    Setting("stack.datum", "reference"),
    ").",
)


def write_page(record: StackRecord, path: str | os.PathLike[str], chips: ChipSheet | None = None) -> None:
    """Write the page of a stack."""
    drawn, arrow = moving_map(record)
    pairs = [one for one in record.pairs if one.status != "accepted"]
    document = record.to_json()
    page = render(
        "report/stack.html.j2",
        stack=record,
        headline=headline(record),
        datum=_datum(record),
        next=_USE if record.datum == "reference" else _FIT,
        css=style_sheet(),
        timeline=timeline(record).svg(),
        graph=graph(record).svg(),
        map=None if drawn is None else drawn.svg(),
        arrow=arrow,
        chips=chips,
        pairs=pairs[:_ROWS],
        sloped=any(one.correction == "affine" for one in record.dates),
        # Each date has its file in its row of the record.
        provenance={**document["provenance"], "inputs": []},
        signals=signals(document["warnings"], document["notices"]),
        levels=WORDS,
        day=lambda text: text[:10],
    )
    write_text(path, page)


def headline(record: StackRecord) -> str:
    """Return what the page says first."""
    known = [one for one in record.dates if one.sigma_px is not None]
    if not known:
        return "No date could be corrected."
    worst = max(_INTERVAL * max(one.sigma_px or (0.0, 0.0)) for one in known)
    where = ""
    if any(one.correction == "affine" for one in known):
        corner = _INTERVAL * max(one.corner_sigma_px or 0.0 for one in known)
        where = f" at the middle and {significant(corner)} px at the corners"
    text = f"{counted(len(known), 'date')} agree with {_datum(record)} within {significant(worst)} px{where}"
    text = f"{text} (95 % interval, per axis)."
    return text if record.datum == "reference" else f"{text} Nothing here tests the absolute position."


def _datum(record: StackRecord) -> str:
    return {"mean": "the mean of all dates", "reference": "the reference"}.get(record.datum, record.datum)


def _years(record: StackRecord) -> list[float]:
    found = []
    for one in record.dates:
        time = datetime.fromisoformat(one.time)
        begin = datetime(time.year, 1, 1, tzinfo=time.tzinfo)
        found.append(time.year + (time - begin).total_seconds() / 86400.0 / 365.25)
    return found


def _bounds(values: list[float], least: float) -> tuple[float, float]:
    low, high = min(values), max(values)
    margin = max(0.05 * (high - low), least)
    return low - margin, high + margin


def timeline(record: StackRecord) -> Drawing:
    """Return the corrections of all dates over time, with their 95 % intervals; dashed lines show steps."""
    wide, tall = _FRAME
    drawing = Drawing(_LEFT + wide + 14, tall + _BELOW + 14, "Timeline of corrections", "timeline")
    years = _years(record)
    known = [(year, one) for year, one in zip(years, record.dates, strict=True) if one.shift_px and one.sigma_px]
    ends = [
        value + sign * _INTERVAL * sigma
        for _, one in known
        for value, sigma in zip(one.shift_px or (), one.sigma_px or (), strict=True)
        for sign in (-1, 1)
    ]
    axes = Axes(drawing, (_LEFT, 8.0, wide, tall), _bounds(years, 0.02), _bounds(ends or [0.0], 0.05))
    axes.draw("year", "px")
    for year, one in known:
        with drawing.titled(f"{one.name}: {_shift(one.shift_px)} px"):
            for axis, kind in ((0, "control"), (1, "check")):
                value, half = (one.shift_px or (0.0, 0.0))[axis], _INTERVAL * (one.sigma_px or (0.0, 0.0))[axis]
                line = "control" if kind == "control" else "check-line"
                drawing.line(line, *axes.at(year, value - half), *axes.at(year, value + half))
                drawing.mark(kind, *axes.at(year, value))
    at = {one.name: year for year, one in zip(years, record.dates, strict=True)}
    for step in record.steps:
        x = axes.at(at[step.date], 0.0)[0]
        drawing.line("check-dash", x, 8.0, x, 8.0 + tall)
    return drawing


def _shift(shift: tuple[float, float] | None) -> str:
    return "" if shift is None else f"{shift[0]:+.2f}, {shift[1]:+.2f}".replace("-", "−")


def graph(record: StackRecord) -> Drawing:
    """Return the pairs as arcs over time; rejected pairs stand out."""
    wide, tall = _FRAME[0], 150.0
    drawing = Drawing(_LEFT + wide + 14, tall + 30, "Graph of pairs", "pairs")
    years = _years(record)
    low, high = _bounds(years, 0.02)
    at = {one.name: _LEFT + wide * (year - low) / (high - low) for year, one in zip(years, record.dates, strict=True)}
    base = tall + 8
    ordered = sorted(record.pairs, key=lambda one: one.status == "rejected")
    for one in ordered:
        if one.status == "not matched" or one.second not in at:
            continue
        left, right = sorted((at[one.first], at[one.second]))
        height = min(tall, 10 + 0.5 * (right - left))
        points = [
            (left + (right - left) * (1 - math.cos(k * math.pi / 12)) / 2, base - height * math.sin(k * math.pi / 12))
            for k in range(13)
        ]
        with drawing.titled(f"{one.first} and {one.second}: {one.status}"):
            drawing.path("weak" if one.status == "rejected" else "link", points)
    for name, x in at.items():
        with drawing.titled(name):
            drawing.circle("control", x, base, 2.6)
    return drawing


def moving_map(record: StackRecord) -> tuple[Drawing | None, str]:
    """Return the map of moving ground, and how long its longest arrow is."""
    cells = record.cells
    fastest = max((math.hypot(*one.rate_px_per_year) for one in cells if one.moving), default=0.0)
    if not fastest > 0:
        return None, ""
    places = [one.place for one in cells]
    columns, rows = sorted({x for x, _ in places}), sorted({y for _, y in places})
    side = columns[1] - columns[0] if len(columns) > 1 else rows[1] - rows[0]
    extent = max(len(columns), len(rows)) * side
    scale = _MAP / extent
    left, top = columns[0] - side / 2, rows[0] - side / 2
    wide, tall = len(columns) * side * scale, len(rows) * side * scale
    drawing = Drawing(wide + 2 * _PAD, tall + 2 * _PAD, "Map of moving ground", "moving")
    drawing.rect("frame", _PAD, _PAD, wide, tall)
    for one in cells:
        x, y = _PAD + (one.place[0] - left) * scale, _PAD + (one.place[1] - top) * scale
        half = side * scale / 2
        if not one.tested:
            drawing.rect("chance", x - half, y - half, 2 * half, 2 * half)
        if one.moving:
            drawing.rect("chosen", x - half, y - half, 2 * half, 2 * half)
            length = _ARROW / fastest
            drawing.arrow("control", x, y, one.rate_px_per_year[0] * length, one.rate_px_per_year[1] * length)
    return drawing, f"{significant(fastest)} px a year"
