"""Results in a notebook: plain HTML that takes the notebook's own colours.

IPython is told of `html` when the package is imported (`show_in`), so that what computes a result need not know HTML.
"""

from __future__ import annotations

import base64
import functools
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.choice.comparison import ComparisonRecord
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.records import Rmse, Rmses
from ortho_pipeline.hookspecs import Scene
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
    names = {"control": "control points", "check": "check points", "loo": "control points, each left out in turn"}
    rmse = [_rms_row(names[role], found) for role, found in fit.rmses if role in names and found]
    tables = [_table(f"{fit.model_name}: RMSE, pixels", ("", "points", "column", "row", "both"), rmse)]
    values = [
        (name, f"{value:.6g}", f"{sigma:.2g}")
        for name, value, sigma in zip(fit.param_names, fit.values, fit.sigmas, strict=True)
    ]
    if values:
        tables.append(_table("Parameters", ("", "value", "sigma"), values))
    said = [f"left out: point {name} ({reason})" for name, reason in fit.rejected] + list(fit.warnings)
    return render("report/notebook.html.j2", tables=tables, notes=said)


def _rms_row(name: str, rms: Rmse) -> tuple[str, ...]:
    return name, str(rms.n), f"{rms.col:.3f}", f"{rms.row:.3f}", f"{rms.total:.3f}"


@html.register
def _(scene: Scene) -> str:
    rows = [
        ("size", f"{scene.width} x {scene.height} pixels"),
        ("sensor", scene.sensor),
        ("models", ", ".join(scene.models)),
        ("read from", str(scene.model_source)),
        *((name, str(value)) for name, value in scene.facts.items()),
    ]
    table = _table(f"Scene {Path(scene.path).name}", ("", ""), rows)
    return render("report/notebook.html.j2", tables=[table], notes=scene.warnings)


@html.register
def _(block: BlockFit) -> str:
    record = block.record
    names = {"control": "control points (the fit)", "check": "check points"}
    ground = [
        (names[role], str(found.n), f"{found.x:.3f}", f"{found.y:.3f}", f"{found.h:.3f}")
        for role, found in record.object_rms
        if found
    ]
    tables = [_table("Known minus adjusted ground: RMSE, metres", ("", "points", "east", "north", "height"), ground)]
    images = [
        _rms_row(f"{name}, {role} points", found)
        for name, image in list(record.images.items())[:_LISTED]
        for role, found in (image.rms.back_projected if ground else image.rms.residuals)
        if found
    ]
    what = "Known ground in the images" if ground else "Rays at the adjusted ground"
    tables.append(_table(f"{what}: RMSE, pixels", ("", "points", "column", "row", "both"), images))
    said = [record.gauge, *record.warnings]
    said += [f"left out: point {one.point} ({one.reason})" for one in record.rejected[:_LISTED]]
    if len(record.rejected) > _LISTED:
        said.append(f"and {counted(len(record.rejected) - _LISTED, 'more gross error')}")
    return render("report/notebook.html.j2", tables=tables, notes=said)


@html.register
def _(points: Points) -> str:
    head = ("", "role", "column", "row", "x", "y", "height")
    texts = [
        (
            one.id,
            one.role,
            *(f"{value:.2f}" for value in one.image),
            *("–" if math.isnan(value) else f"{value:.10g}" for value in one.ground),
        )
        for one in itertools.islice(points, _LISTED)
    ]
    rest = len(points) - len(texts)
    said = [f"and {counted(rest, 'more point')}"] if rest else []
    return render("report/notebook.html.j2", tables=[_table(repr(points)[1:-1], head, texts)], notes=said)


@html.register
def _(comparison: ComparisonRecord) -> str:
    def totals(rmse: Rmses) -> list[str]:
        return [f"{one.total:.3f}" if one else "–" for one in (rmse.check, rmse.loo, rmse.control)]

    rows = [(row.model, str(row.parameters), *totals(row.rmse)) for row in comparison.rows]
    said = [f"recommended: {comparison.recommended or 'none'} ({comparison.recommendation.reason})"]
    said += [f"left out: point {one.id} ({one.reason})" for one in comparison.left_out] + list(comparison.warnings)
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
