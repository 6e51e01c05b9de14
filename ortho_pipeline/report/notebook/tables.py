"""Results in a notebook: plain HTML that takes the notebook's own colours.

IPython is told of `html` when the package is imported (`show_in`), so that what computes a result need not know HTML.
"""

from __future__ import annotations

import base64
import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.display.pages import render
from ortho_pipeline.estimation.comparison import Comparison
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options.texts import counted
from ortho_pipeline.points import Points

#: In a notebook, pages of reports are this high (CSS pixels).
_PAGE_HEIGHT = 640
#: Images and gross errors of a block, and points of a table, that are listed.
_LISTED = 20


@functools.singledispatch
def html(result: object) -> str:
    """Return a scene, points, a fit, a comparison or a block as an HTML table, as a notebook shows it.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> "12 control" in op.html(op.read_points("sample_data/gcps.geojson"))
    True
    """
    return text_html(repr(result))


def _table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> dict[str, Any]:
    return {"title": title, "head": head, "rows": rows}


@html.register
def _(fit: Fit) -> str:
    return fit_html(fit.to_json())


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
    return render("report/notebook.html.j2", tables=tables, notes=said)


@html.register
def _(scene: Scene) -> str:
    rows = [
        ("size", f"{scene.width} x {scene.height} pixels"), ("sensor", scene.sensor),
        ("models", ", ".join(scene.models)), ("read from", str(scene.model_source)),
        *((name, str(value)) for name, value in scene.facts.items()),
    ]  # fmt: skip
    table = _table(f"Scene {Path(scene.path).name}", ("", ""), rows)
    return render("report/notebook.html.j2", tables=[table], notes=scene.warnings)


@html.register
def _(block: BlockFit) -> str:
    document = block.to_json()
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
    return render("report/notebook.html.j2", tables=tables, notes=said)


@html.register
def _(points: Points) -> str:
    head = ("", "role", "column", "row", "x", "y", "height")
    texts = [
        (
            one.id, one.role, *(f"{value:.2f}" for value in one.image),
            *("–" if math.isnan(value) else f"{value:.10g}" for value in one.ground),
        )
        for one in itertools.islice(points, _LISTED)
    ]  # fmt: skip
    rest = len(points) - len(texts)
    said = [f"and {counted(rest, 'more point')}"] if rest else []
    return render("report/notebook.html.j2", tables=[_table(repr(points)[1:-1], head, texts)], notes=said)


@html.register
def _(comparison: Comparison) -> str:
    document = comparison.to_json()

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
    return render("report/notebook.html.j2", tables=[_table("RMSE, pixels", head, rows)], notes=said)


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
