"""The page of a verified ortho (accuracy, displacements, profiles, bands, causes), and the table of a folder."""

from __future__ import annotations

import base64
import contextlib
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.display.drawing import Axes, Drawing, style_sheet
from ortho_pipeline.display.numbers import size_m
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.files import write_text
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.page.advice import WORDS, signals

#: Longer side of the map, CSS px, and the space around it; the longest arrow, and cells that are drawn per side.
_SIDE, _PAD, _LONGEST = 460.0, 22.0, 30.0
#: A profile: width and height of its frame, and the space to its left and below.
_PROFILE, _LEFT, _BELOW = (430.0, 150.0), 62.0, 46.0


def interval_text(estimate: Mapping[str, float], unit: str = "m") -> str:
    """Return an estimate with its interval: ``0.48 m (0.41 to 0.55)``."""
    value, low, high = (estimate[name] for name in ("value", "low", "high"))
    digits = 2 if max(abs(value), abs(high)) >= 0.1 else 3
    text = f"{value:.{digits}f} {unit}".strip()
    return f"{text} ({low:.{digits}f} to {high:.{digits}f})".replace("-", "−")


def write_page(
    document: Mapping[str, Any], path: str | os.PathLike[str], image: str | os.PathLike[str], access: Mapping[str, Any]
) -> None:
    """Write the page of one ortho."""
    picture = ""
    with contextlib.suppress(OrthoError):
        picture = base64.b64encode(preview_png(image, **access)).decode()
    drawn, scale = displacement_map(document)
    profiles = [
        profile_plot(document[f"{name}s"], name).svg() for name in ("column", "row") if document.get(f"{name}s")
    ]
    page = render(
        "report/ortho_check.html.j2",
        document=document,
        name=Path(document["ortho"]).name,
        headline=headline(document),
        parts=_parts(document),
        css=style_sheet(),
        map=None if drawn is None else drawn.svg(),
        arrow=scale,
        profiles=profiles,
        picture=picture,
        before=document.get("before"),
        signals=signals(document["warnings"], document["notices"]),
        levels=WORDS,
        interval=interval_text,
    )
    write_text(path, page)


def write_table(table: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write the page of a folder: one row for each ortho."""
    write_text(path, render("report/ortho_table.html.j2", table=table, name=os.path.basename, interval=interval_text))


def headline(document: Mapping[str, Any]) -> str:
    """Return what the page says first."""
    for part, where in (("points", "at the points"), ("absolute", "on the ground"), ("relative", "of the reference")):
        found = document[part]
        if found is not None:
            value = found["ce90_m"]["value"]
            within = f"90 % of the ortho is within {size_m(value)} {where}"
            return f"{within}." if part != "points" else f"90 % of errors are below {size_m(value)} {where}."
    return "Accuracy unknown: there are no matches and no points."


def _parts(document: Mapping[str, Any]) -> list[dict[str, Any]]:
    titles = {"points": "At points", "absolute": "On the ground", "relative": "Relative to the reference"}
    names = {
        "ce90": "CE90",
        "rmse": "RMSE",
        "bias": "Bias",
        "bias_east": "Bias to the east",
        "bias_north": "Bias to the north",
    }
    return [
        {
            "title": title,
            "rows": [
                (called, interval_text(document[part][f"{name}_m"]), interval_text(document[part][f"{name}_px"], "px"))
                for name, called in names.items()
            ],
        }
        for part, title in titles.items()
        if document[part] is not None
    ]


def displacement_map(document: Mapping[str, Any]) -> tuple[Drawing | None, str]:
    """Return the map of displacements over the frame of the image, and how long its longest arrow is."""
    cells = document["field"]["cells"] if "field" in document else []
    longest = max((math.hypot(one["east_m"], one["north_m"]) for one in cells), default=0.0)
    if not longest > 0:
        return None, ""
    width, height = document["size"]
    scale = _SIDE / max(width, height)
    drawing = Drawing(
        width * scale + 2 * _PAD, height * scale + 2 * _PAD, "Map of displacements over the ortho", "displacements"
    )
    drawing.rect("frame", _PAD, _PAD, width * scale, height * scale)
    length = _LONGEST / longest
    for one in cells:
        x, y = (_PAD + place * scale for place in one["image"])
        with drawing.titled(f"east {one['east_m']:+.2f} m, north {one['north_m']:+.2f} m"):
            drawing.arrow("control", x, y, one["east_m"] * length, -one["north_m"] * length)
    for one in document["steps"]:
        at = _PAD + one["at"] * scale
        ends = (
            (at, _PAD, at, _PAD + height * scale) if one["axis"] == "column" else (_PAD, at, _PAD + width * scale, at)
        )
        drawing.line("check-dash", *ends)
    return drawing, size_m(longest)


def profile_plot(strips: list[Mapping[str, Any]], name: str) -> Drawing:
    """Return the mean displacement in strips of columns or rows, with its 95 % interval."""
    wide, tall = _PROFILE
    drawing = Drawing(_LEFT + wide + 14, tall + _BELOW + 14, f"Displacement by {name}", f"by-{name}")
    values = [one[axis][bound] for one in strips for axis in ("east_m", "north_m") for bound in ("low", "high")]
    low, high = min([0.0, *values]), max([0.0, *values])
    margin = max(0.06 * (high - low), 1e-3)
    axes = Axes(drawing, (_LEFT, 8.0, wide, tall), (strips[0]["from"], strips[-1]["to"]), (low - margin, high + margin))
    axes.draw(name, "m")
    for axis, kind in (("east_m", "control"), ("north_m", "check")):
        for one in strips:
            middle = (one["from"] + one["to"]) / 2
            drawing.line(
                "control" if kind == "control" else "check-line",
                *axes.at(middle, one[axis]["low"]),
                *axes.at(middle, one[axis]["high"]),
            )
            drawing.mark(kind, *axes.at(middle, one[axis]["value"]))
    return drawing
