"""The page of a verified or aligned ortho, and the table of a folder."""

from __future__ import annotations

import base64
import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.display.drawing import Axes, Drawing, style_sheet
from ortho_pipeline.display.numbers import size_m
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.files import write_text
from ortho_pipeline.raster.quicklook import preview_png
from ortho_pipeline.report.orthos.summary import about, best_part, errors_of, explained, headline, interval_text
from ortho_pipeline.report.page.advice import WORDS, signals
from ortho_pipeline.report.summary import error_table, processed

#: Longer side of the map and its longest arrow, CSS px.
_SIDE, _LONGEST = 460.0, 30.0
#: A profile: width and height of its frame, and the space to its left and below.
_PROFILE, _LEFT, _BELOW = (430.0, 150.0), 62.0, 46.0


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
        kind="Report of an aligned ortho" if "before" in document else "Accuracy of an ortho",
        about=about(document),
        headline=headline(document),
        best=document[part] if (part := best_part(document)) else None,
        errors=error_table(errors_of(document)),
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
        explained=explained,
    )
    write_text(path, page)


def write_table(table: Mapping[str, Any], path: str | os.PathLike[str]) -> None:
    """Write the page of a folder: one row for each ortho."""
    known = {"Processed": processed()}
    page = render(
        "report/ortho_table.html.j2", table=table, name=os.path.basename, interval=interval_text, about=known,
        best_part=best_part,
    )  # fmt: skip
    write_text(path, page)


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
    """Return the displacements in the frame of the image, and how long the longest arrow is."""
    cells = document["field"]["cells"] if "field" in document else []
    shifts = np.array([[one["east_m"], one["north_m"]] for one in cells]).reshape(-1, 2)
    longest = float(np.hypot(*shifts.T).max(initial=0.0))
    if not longest > 0:
        return None, ""
    width, height = document["size"]
    scale = _SIDE / max(width, height)
    drawing = Drawing(width * scale, height * scale, "Map of displacements over the ortho", "displacements")
    drawing.rect("frame", 0.0, 0.0, width * scale, height * scale)
    # East and north as columns and rows of this image, which may be rotated or upside down.
    along = np.linalg.solve(np.array(document["pixel_axes_m"]), shifts.T).T * document["pixel_m"]
    for one, (dx, dy) in zip(cells, (along * _LONGEST / longest).tolist(), strict=True):
        x, y = (place * scale for place in one["image"])
        with drawing.titled(f"east {one['east_m']:+.2f} m, north {one['north_m']:+.2f} m"):
            drawing.arrow("control", x, y, dx, dy)
    for one in document["steps"]:
        at = one["at"] * scale
        ends = (at, 0.0, at, height * scale) if one["axis"] == "column" else (0.0, at, width * scale, at)
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
