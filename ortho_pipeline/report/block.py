"""The report of a block: one document of images, rays and points, as JSON, as a page, and in words."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.display.drawing import Drawing, round_down, style_sheet
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.display.numbers import fixed, flat, metres, px
from ortho_pipeline.display.pages import render
from ortho_pipeline.errors import counted
from ortho_pipeline.report.wording import ENOUGH_CHECK_POINTS

if TYPE_CHECKING:
    from ortho_pipeline.block.start import Start
    from ortho_pipeline.exchange.rpc_fit import RpcExport

DOCUMENT, SCHEMA_VERSION = "ortho-pipeline block report", 1
#: Images whose residuals are drawn, rays that are drawn of each, points that are listed on the page.
_DRAWN_IMAGES, _DRAWN_RAYS, _LISTED = 6, 400, 400
#: A frame's side, the longest arrow in it, and the margin in which arrows of points at its edge end.
_SIDE, _ARROW, _MARGIN = 420.0, 44.0, 48.0


def build_document(
    *,
    fit: BlockFit,
    starts: Mapping[str, Start],
    exported: Mapping[str, RpcExport],
    provenance: Mapping[str, Any],
    warnings: Sequence[Notice],
) -> dict[str, Any]:
    """Return everything that the report says, as JSON values (docs/formats/block-points.md)."""
    images = {}
    for label, start in starts.items():
        found = exported.get(label)
        images[label] = {
            "path": str(start.scene.path),
            "size": [start.scene.width, start.scene.height],
            "sensor": start.scene.sensor,
            "model": start.name,
            "model_source": start.source,
            "facts": {str(key): str(value) for key, value in start.scene.facts.items()},
            "rpc": None if found is None else {"exact": found.exact, "max_error_px": found.max_error_px},
        }
    document = {
        "document": DOCUMENT,
        "schema_version": SCHEMA_VERSION,
        "images": images,
        "adjustment": fit.to_json(),
        "provenance": dict(provenance),
        **to_document(warnings),
    }
    document["headline"] = headline(document)
    return document


# -- words -----------------------------------------------------------------------------------------------------------


def headline(document: Mapping[str, Any]) -> dict[str, Any]:
    """Say how accurate the block is from the best evidence that there is: check points, else the fit of control."""
    adjustment = document["adjustment"]
    check, control = adjustment["object_rms"]["check"], adjustment["object_rms"]["control"]
    notes = [f"{adjustment['gauge'][0].upper()}{adjustment['gauge'][1:]}."]
    if check:
        if check["n"] < ENOUGH_CHECK_POINTS:
            notes.append(
                f"Fewer than {ENOUGH_CHECK_POINTS} check points: an indication, not a claim of accuracy (ASPRS 2023)."
            )
        what = f"RMSE in plan and height at {counted(check['n'], 'check point')} whose ground took no part"
        return {"figure": metres(check["plan"]), "height": metres(check["h"]), "what": what, "notes": notes}
    # The ground of control is held by its sigma: how well it fits is to be seen in the images.
    seen = {
        role: merged([image["rms"]["back_projected"][role] for image in adjustment["images"].values()])
        for role in ("check", "control")
    }
    if check := seen["check"]:
        what = f"RMSE of {counted(check['n'], 'measurement')} of check points, whose ground took no part, in the images"
        return {"figure": px(check["total"]), "height": None, "what": what, "notes": notes}
    if control and seen["control"]:
        notes.append("No check points were kept apart.")
        if not adjustment["redundancy"]:
            what = "nothing is left over to test the fit with"
            return {"figure": "Not tested", "height": None, "what": what, "notes": notes}
        what = (
            f"RMSE of {counted(seen['control']['n'], 'measurement')} of control points in the images: the fit, "
            "not a test"
        )
        return {"figure": px(seen["control"]["total"]), "height": None, "what": what, "notes": notes}
    sizes = [math.hypot(*ray["residual"]) for ray in adjustment["rays"] if ray["used"] and None not in ray["residual"]]
    figure = px(float(np.median(sizes))) if sizes else "Not tested"
    what = f"median residual of {counted(len(sizes), 'ray')}: how well the images agree, not how right they are"
    return {"figure": figure, "height": None, "what": what, "notes": notes}


def summary_text(document: Mapping[str, Any]) -> str:
    """Return the report as a screenful of text."""
    adjustment, head = document["adjustment"], document["headline"]
    wide = max([5, *map(len, document["images"])])
    lines = [f"{'image':<{wide}}  {'rays':>6}  {'residuals col, row (px)':>24}  {'at check points (px)':>21}  model"]
    for label, image in document["images"].items():
        found = adjustment["images"][label]
        ties = merged([found["rms"]["residuals"][role] for role in ("control", "check", "tie")])
        pairs = f"  {_pair(ties):>24}  {_pair(found['rms']['back_projected']['check']):>21}"
        lines.append(f"{label:<{wide}}  {found['rays']:>6}{pairs}  {image['model']} of {image['model_source']}")
    for role in ("control", "check"):
        rms = adjustment["object_rms"][role]
        if rms:
            low, high = rms["min"], rms["max"]
            axes = zip("ENh", (rms["x"], rms["y"], rms["h"]), low, high, strict=True)
            text = ", ".join(f"{axis} {value:.3f} ({a:+.2f} to {b:+.2f})" for axis, value, a, b in axes)
            lines.append(f"{counted(rms['n'], f'{role} point')}: RMSE {text} m")
    sigma0 = "unknown" if adjustment["sigma0"] is None else f"{adjustment['sigma0']:.3g}"
    lines += variance_lines(adjustment["variances"])
    lines.append(
        f"Redundancy {adjustment['redundancy']}, sigma0 {sigma0}, {counted(len(adjustment['rejected']), 'gross error')}"
    )
    height = f", height {head['height']}" if head["height"] else ""
    lines += [f"{head['figure']}{height}: {head['what']}", *head["notes"]]
    return "\n".join([*lines, *(f"Warning: {text}" for text in document["warnings"])])


def variance_lines(variances: Mapping[str, Any]) -> list[str]:
    """Say what was found of ground that states no sigma."""
    ground = variances["unstated_ground"]
    number = max(part["points"] for part in ground.values())
    if not number:
        return []
    who = counted(number, "control point")
    if not variances["separable"]:
        return [f"Ground of {who} states no sigma; its errors count as errors of measurement"]
    found = [
        f"{part['sigma']:.2g} m in {what} (redundancy {part['redundancy']:.1f})"
        for what, part in (("plan", ground["xy"]), ("height", ground["h"]))
        if part["sigma"] is not None
    ]
    return [f"Ground of {who} states no sigma; estimated: {', '.join(found)}"]


def merged(parts: Sequence[Mapping[str, Any] | None]) -> dict[str, Any] | None:
    """Return the root mean squares of several groups together."""
    groups = [part for part in parts if part]
    number = sum(part["n"] for part in groups)
    if not number:
        return None
    col, row = (sum(part["n"] * part[axis] ** 2 for part in groups) / number for axis in ("col", "row"))
    return {"col": math.sqrt(col), "row": math.sqrt(row), "total": math.sqrt(col + row), "n": number}


def _pair(rms: Mapping[str, Any] | None) -> str:
    return "-" if rms is None else f"{rms['col']:.3f}  {rms['row']:.3f}"


# -- page ------------------------------------------------------------------------------------------------------------


def page(document: Mapping[str, Any]) -> str:
    """Return the report as one page that needs no other file and no network."""
    adjustment = document["adjustment"]
    drawn = list(document["images"])[:_DRAWN_IMAGES]
    figures = {label: drawing.svg() for label in drawn if (drawing := plot_rays(document, label)) is not None}
    plan = plot_ground(document)
    residuals = {
        label: merged([found["rms"]["residuals"][role] for role in ("control", "check", "tie")])
        for label, found in adjustment["images"].items()
    }
    return render(
        "report/block.html.j2",
        document=document,
        adjustment=adjustment,
        head=document["headline"],
        ground_sigmas=variance_lines(adjustment["variances"]),
        warnings=document["warnings"],
        residuals=residuals,
        roles={role: sum(p["role"] == role for p in adjustment["points"]) for role in ("control", "check", "tie")},
        points=sorted(adjustment["points"], key=lambda p: ("control", "check", "tie").index(p["role"]))[:_LISTED],
        figures=figures,
        plan=None if plan is None else plan.svg(),
        plot_style=style_sheet(),
        provenance=list(flat({k: v for k, v in document["provenance"].items() if k != "inputs"})),
        inputs=document["provenance"].get("inputs") or [],
        fixed=fixed,
    )


def plot_rays(document: Mapping[str, Any], label: str) -> Drawing | None:
    """Draw reprojection residuals of an image over its frame: those of known ground, of ties those of the adjusted."""
    roles = {point["id"]: point["role"] for point in document["adjustment"]["points"]}
    shown = []
    for ray in document["adjustment"]["rays"]:
        if ray["image"] == label:
            role = roles[ray["id"]]
            vector = ray["residual"] if role == "tie" else ray["back_projected"]
            if None not in vector:
                shown.append((ray["measured"], vector, role if ray["used"] else "out", f"{ray['id']} ({role})"))
    title = f"Residuals of {counted(len(shown), 'ray')} over the frame of {label}"
    return _vectors(title, shown[:: max(1, len(shown) // _DRAWN_RAYS)], document["images"][label]["size"], "px")


def plot_ground(document: Mapping[str, Any]) -> Drawing | None:
    """Draw known minus adjusted ground in plan, north up, at the points in degrees made even for their latitude."""
    known = [p for p in document["adjustment"]["points"] if None not in (*p["residual"], *p["ground"])]
    if len(known) < 2:
        return None
    places = np.array([p["ground"][:2] for p in known])
    places[:, 0] = np.unwrap(places[:, 0], period=360.0) * math.cos(math.radians(float(places[:, 1].mean())))
    places[:, 1] *= -1.0
    low = places.min(axis=0)
    size = float((places.max(axis=0) - low).max()) or 1.0
    at = (places - low + 0.04 * size) / (1.08 * size) * 1000.0
    extent = at.max(axis=0) + 40.0
    shown = [
        (at[k].tolist(), [p["residual"][0], -p["residual"][1]], p["role"] if _takes_part(p) else "out",
         f"{p['id']} ({p['role']}): E {p['residual'][0]:+.2f}, N {p['residual'][1]:+.2f}, h {p['residual'][2]:+.2f} m")
        for k, p in enumerate(known)
    ]  # fmt: skip
    return _vectors("Known minus adjusted ground in plan", shown, extent.tolist(), "m")


def _takes_part(point: Mapping[str, Any]) -> bool:
    return bool(point["role"] != "control" or point["used_ground"])


def _vectors(
    title: str, shown: Sequence[tuple[Sequence[float], Sequence[float], str, str]], size: Sequence[float], unit: str
) -> Drawing | None:
    """Draw vectors at their places in a frame; control and check with their marks, ties as plain arrows."""
    if not shown:
        return None
    scale = _SIDE / max(size)
    wide, tall = size[0] * scale, size[1] * scale
    drawing = Drawing(max(wide, 300.0) + 2 * _MARGIN, tall + 2 * _MARGIN + 30, title, "block")
    drawing.rect("frame", _MARGIN, _MARGIN, wide, tall)
    longest = max((math.hypot(*vector) for _, vector, kind, _ in shown if kind != "out"), default=0.0)
    arrow = _ARROW / longest if longest > 0 else 0.0
    for place, vector, kind, name in shown:
        x, y = (_MARGIN + value * scale for value in place)
        with drawing.titled(f"{name}\n{vector[0]:+.3f}, {vector[1]:+.3f} {unit}"):
            if kind != "out":
                drawing.arrow("bar" if kind == "tie" else kind, x, y, vector[0] * arrow, vector[1] * arrow)
            if kind != "tie":
                drawing.mark(kind, x, y)
    if longest > 0:
        bar = round_down(longest)
        drawing.arrow("bar", _MARGIN, tall + 2 * _MARGIN + 8, bar * arrow, 0.0)
        drawing.text(_MARGIN + bar * arrow + 10, tall + 2 * _MARGIN + 12, f"{bar:g} {unit}")
    return drawing
