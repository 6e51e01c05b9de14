"""Results in a notebook: plain HTML that takes the notebook's own colours."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

from ortho_pipeline.display.pages import render
from ortho_pipeline.options.texts import counted

#: In a notebook, pages of reports are this high (CSS pixels).
_PAGE_HEIGHT = 640
#: Images and gross errors of a block, and points of a table, that are listed.
_LISTED = 20


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[str, Any]:
    return {"title": title, "head": head, "rows": rows}


def fit_html(document: Mapping[str, Any]) -> str:
    """Return the document of a fit (`Fit.to_json`) as HTML: RMSE, parameters, warnings, and what was left out."""
    names = {"control": "control points", "check": "check points", "loo": "control points, each left out in turn"}
    rmse = [
        (names[role], str(found["n"]), *(f"{found[key]:.3f}" for key in ("col", "row", "total")))
        for role, found in document["rmse"].items()
        if role in names and found
    ]
    tables = [_table(f"{document['model']}: RMSE, pixels", ("", "points", "column", "row", "both"), rmse)]
    values = [(name, f"{one['value']:.6g}", f"{one['sigma']:.2g}") for name, one in document["parameters"].items()]
    if values:
        tables.append(_table("Parameters", ("", "value", "sigma"), values))
    said = [f"left out: point {one['id']} ({one['reason']})" for one in document["rejected"]] + document["warnings"]
    return render("display/notebook.html.j2", tables=tables, notes=said)


def scene_html(title: str, rows: Sequence[tuple[str, str]], notes: Sequence[str]) -> str:
    """Return what is known of a scene as HTML: names and texts, and its warnings."""
    return render("display/notebook.html.j2", tables=[_table(title, ("", ""), rows)], notes=notes)


def block_html(document: Mapping[str, Any]) -> str:
    """Return the document of a block (`BlockFit.to_json`) as HTML: RMSE on the ground and in the images, warnings."""
    ground = [
        (f"{role} points", str(found["n"]), *(f"{found[axis]:.3f}" for axis in "xyh"))
        for role, found in document["object_rms"].items()
        if found
    ]
    tables = [_table("Known minus adjusted ground: RMSE, metres", ("", "points", "east", "north", "height"), ground)]
    images = [
        (f"{name}, {role} points", str(found["n"]), *(f"{found[axis]:.3f}" for axis in ("col", "row", "total")))
        for name, image in list(document["images"].items())[:_LISTED]
        for role, found in image["rms"]["residuals" if not ground else "back_projected"].items()
        if found
    ]
    what = "Known ground in the images" if ground else "Rays at the adjusted ground"
    tables.append(_table(f"{what}: RMSE, pixels", ("", "points", "column", "row", "both"), images))
    rejected = document["rejected"]
    said = [document["gauge"], *document["warnings"]]
    said += [f"left out: point {one['point']} ({one['reason']})" for one in rejected[:_LISTED]]
    if len(rejected) > _LISTED:
        said.append(f"and {counted(len(rejected) - _LISTED, 'more gross error')}")
    return render("display/notebook.html.j2", tables=tables, notes=said)


def points_html(title: str, rows: Sequence[tuple[str, str, Sequence[float], Sequence[float]]]) -> str:
    """Return points as HTML; a row has id, role, column and row, and x, y and height (NaN where it is not given)."""
    head = ("", "role", "column", "row", "x", "y", "height")
    texts = [
        (name, role, *(f"{value:.2f}" for value in image), *("–" if math.isnan(v) else f"{v:.10g}" for v in ground))
        for name, role, image, ground in rows[:_LISTED]
    ]
    rest = len(rows) - len(texts)
    said = [f"and {counted(rest, 'more point')}"] if rest else []
    return render("display/notebook.html.j2", tables=[_table(title, head, texts)], notes=said)


def comparison_html(document: Mapping[str, Any]) -> str:
    """Return the document of a comparison (`Comparison.to_json`) as HTML: RMSE of each model, and which to take."""

    def total(rmse: Mapping[str, float] | None) -> str:
        return f"{rmse['total']:.3f}" if rmse else "–"

    rows = [
        (row["model"], str(row["parameters"]), *(total(row["rmse"].get(kind)) for kind in ("check", "loo", "control")))
        for row in document["rows"]
    ]
    advice = document["recommendation"]
    said = [f"recommended: {advice['model'] or 'none'} ({advice['reason']})"]
    said += [f"left out: point {one['id']} ({one['reason']})" for one in document["left_out"]] + document["warnings"]
    head = ("", "parameters", "check points", "each left out in turn", "control points")
    return render("display/notebook.html.j2", tables=[_table("RMSE, pixels", head, rows)], notes=said)


def page_html(page: str) -> str:
    """Return a page of its own (a report) as a frame in the notebook."""
    encoded = base64.b64encode(page.encode()).decode()
    return (
        f'<iframe src="data:text/html;base64,{encoded}" style="width:100%;height:{_PAGE_HEIGHT}px;border:0" '
        'sandbox="allow-scripts" title="Report"></iframe>'
    )


def text_html(text: str) -> str:
    """Return plain text as HTML that keeps its lines."""
    from markupsafe import Markup

    return str(Markup("<pre>{}</pre>").format(text))
