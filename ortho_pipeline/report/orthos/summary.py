"""What the page and the terminal say first of a verified or aligned ortho: what it is, its accuracy, its cause."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.display.numbers import area_km2, metres, significant
from ortho_pipeline.report.summary import RoleErrors, acquired, error_lines, place_text, processed

#: Whose accuracy comes first, and what it is compared with.
PARTS = {"points": "at the points", "absolute": "on the ground", "relative": "relative to the reference"}
_CORRECTIONS = {"shift": "a shift", "affine": "an affine transformation", "field": "a smooth field"}


def interval_text(estimate: Mapping[str, float], unit: str = "m") -> str:
    """Return an estimate with its interval: ``0.48 m (0.41 to 0.55)``."""
    value, low, high = (estimate[name] for name in ("value", "low", "high"))
    digits = 2 if max(abs(value), abs(high)) >= 0.1 else 3
    text = f"{value:.{digits}f} {unit}".strip()
    return f"{text} ({low:.{digits}f} to {high:.{digits}f})".replace("-", "−")


def about(document: Mapping[str, Any]) -> dict[str, str]:
    """Return what an ortho is, as `report.summary.about` does of a scene."""
    lon_lat = document["lon_lat"]
    texts = {
        "Acquired": acquired([document["acquired"]]) or "unknown",
        "Processed": processed(),
        "Area": area_km2(document["area_m2"]),
        "Place": place_text(lon_lat) if None not in lon_lat else None,
    }
    return {key: text for key, text in texts.items() if text}


def best_part(document: Mapping[str, Any]) -> str | None:
    """Return whose accuracy the document states first, a key of `PARTS`; None if it states none."""
    return next((name for name in PARTS if document[name] is not None), None)


def headline(document: Mapping[str, Any]) -> str:
    """Return the accuracy in a sentence."""
    part = best_part(document)
    if part is None:
        return "Accuracy unknown: there are no matches and no points."
    value = metres(document[part]["ce90_m"]["value"])
    if part == "points":
        return f"90 % of errors at the points are below {value}."
    where = "its true position" if part == "absolute" else "the reference"
    return f"90 % of the tested area is within {value} of {where}."


def errors_of(document: Mapping[str, Any]) -> list[RoleErrors]:
    """Return the errors at points and the likeliest displacements of the tested cells, by axis."""
    kinds = []
    if document["points"] is not None:
        kinds.append(("check", "check points", document["points"]["residuals"]))
    if document["relative"] is not None:
        kinds.append(("matched", "cells of the ortho", document["field"]["cells"]))
    return [
        RoleErrors.of(role, title, np.array([[one["east_m"], one["north_m"]] for one in places]))
        for role, title, places in kinds
    ]


def explained(cause: Mapping[str, Any]) -> str:
    """Return which part of the displacement a cause explains: `` (explains 95 %)``; nothing of bands."""
    share = cause.get("share")
    if share is None:
        return ""
    return f" (explains {'less than 1' if share < 0.01 else f'{100 * share:.0f}'} %)"


def summary_text(document: Mapping[str, Any]) -> str:
    """Return what people read of a verified or aligned ortho."""
    known = about(document)
    taken = "" if known["Acquired"] == "unknown" else f", acquired {known['Acquired']}"
    rows = [
        ("ortho", f"{Path(document['ortho']).name}{taken}"),
        ("area", ", ".join(known[key] for key in ("Area", "Place") if key in known)),
    ]
    if "correction" in document:
        chosen = document["correction"]
        rows.append(("corrected", f"by {_CORRECTIONS[chosen['kind']]}: {chosen['reason']}"))
        before, after = (f"CE90 {metres(part['ce90_m']['value'])}, bias {metres(part['bias_m']['value'])}"
                         for part in (document["before"], document["relative"]))  # fmt: skip
        rows += [("before", f"{before}, relative to the reference"), ("after", after)]
    rows += _accuracy_rows(document)
    if "matches" in document:
        matches = document["matches"]
        tested = f"they test {matches['tested_share']:.0%} of the ortho"
        rows.append(("matches", f"{matches['kept']} of {matches['tried']} places; {tested}"))
    rows += [("cause", f"{one['text']}{explained(one)}") for one in document["causes"]]
    for one in document["requirements"]:
        word = "met" if one["met"] else "NOT met"
        rows.append(("required", f"{one['requirement']}: {word} (upper limit {significant(one['upper'], 3)})"))
    lines = [f"{key:<10}{value}" for key, value in rows]
    return "\n".join([*lines, *error_lines(errors_of(document))])


def _accuracy_rows(document: Mapping[str, Any]) -> list[tuple[str, str]]:
    part = best_part(document)
    if part is None:
        return [("accuracy", "unknown")]
    rows: list[tuple[str, str]] = []
    for name in [name for name in PARTS if document[name] is not None]:
        for key, called in (("ce90", "CE90"), ("rmse", "RMSE"), ("bias", "bias")):
            text = interval_text(document[name][f"{key}_m"])
            pixels = interval_text(document[name][f"{key}_px"], "px")
            where = f", {PARTS[name]}" if key == "ce90" else ""
            rows.append(("" if rows else "accuracy", f"{called} {text}, {pixels}{where}"))
    return [*rows, ("", document["asprs"])]


def table_text(table: Mapping[str, Any]) -> str:
    """Return the table of a folder as text."""
    lines = [f"{'ortho':<32} {'CE90 m':>22} {'RMSE m':>22}  cause"]
    for row in table["orthos"]:
        name = Path(row["ortho"]).name
        if "error" in row:
            lines.append(f"{name:<32} {row['error']}")
            continue
        best = row[best_part(row)]
        numbers = (interval_text(best[f"{one}_m"], "") for one in ("ce90", "rmse"))
        causes = ", ".join(one["code"] for one in row["causes"]) or "none found"
        lines.append(f"{name:<32} {next(numbers):>22} {next(numbers):>22}  {causes}")
    return "\n".join(lines)
