"""The accuracy report: one dict, shown as JSON, as a page, as a plot, as GeoJSON and as text for the terminal.

`build_report` collects everything; the other functions only show what is in its dict. A residual is measured minus
predicted, in pixels. In metres it is where the ortho shows a point minus where the point belongs, east and north, on
the assumption that the DEM is right there.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.crs import Vertical, ground_transform, parse_crs
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.estimation import Fit, root_mean_square
from ortho_pipeline.files import write_text
from ortho_pipeline.geometry import units_per_metre
from ortho_pipeline.models.base import solve_2x2
from ortho_pipeline.report_figures import plot_residuals, preview_png

if TYPE_CHECKING:
    import pyproj

    from ortho_pipeline.dem import Surface
    from ortho_pipeline.hookspecs import Scene
    from ortho_pipeline.models.base import SensorModel
    from ortho_pipeline.raster import Grid
    from ortho_pipeline.rpc import RpcExport
    from ortho_pipeline.warp import WarpResult

Array = NDArray[np.float64]

SCHEMA_VERSION = 1
#: ASPRS Positional Accuracy Standards (2023): no claim of accuracy below this number of check points.
ENOUGH_CHECK_POINTS = 30
#: Median of control height minus DEM height from which a difference of datums is suspected, metres.
_SUSPICIOUS_HEIGHT = 5.0

__all__ = [
    "build_report",
    "headline",
    "plot_residuals",
    "preview_png",
    "residuals_geojson",
    "summary_text",
    "write_report_html",
    "write_report_json",
]

# -- collecting ------------------------------------------------------------------------------------------------------


def build_report(
    *,
    scene: Scene,
    fit: Fit,
    exported: RpcExport | None = None,
    surface: Surface | None = None,
    coverage: float | None = None,
    grid: Grid | None = None,
    warp: WarpResult | None = None,
    provenance: Mapping[str, Any] | None = None,
    warnings: Iterable[str] = (),
) -> dict[str, Any]:
    """Collect scene, adjustment, heights, ortho and provenance as plain data that JSON holds (no NaN).

    Parameters
    ----------
    exported : RpcExport, optional
        The adjusted model as RPC.
    coverage : float, optional
        Share (0 to 1) of the scene for which the DEM has a height.
    warnings : iterable of str
        What the reader ought to know; a suspicious difference between control and DEM heights is added to them.
    """
    viewing = _viewing(fit.model, scene.width, scene.height)
    heights = None if surface is None else _heights_of_points(fit, surface, viewing)
    noted = [*warnings, *([heights["warning"]] if heights and heights["warning"] else [])]
    adjustment = {**fit.to_json(), "warnings": noted}
    metres = _in_metres(fit, fit.residuals)
    for i, point in enumerate(adjustment["points"]):
        point["raw_residual"] = _numbers(fit.raw_residuals[i])
        point["residual_m"] = _numbers(metres[i])
    report = {
        "document": "ortho-pipeline report",
        "schema_version": SCHEMA_VERSION,
        "created": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "scene": {
            "name": Path(scene.path).name,
            "size": [scene.width, scene.height],
            "sensor": scene.sensor,
            "model_source": scene.model_source,
            "facts": {str(key): _plain(value) for key, value in scene.facts.items()},
            **viewing,
        },
        "adjustment": adjustment,
        "rmse_m": _rmse_metres(fit),
        "heights": heights,
        "surface": None if surface is None else {"coverage": coverage, **_plain(surface.provenance)},
        "rpc": None if exported is None else {"exact": exported.exact, "max_error_px": exported.max_error_px},
        "ortho": None if grid is None else _ortho(grid, warp),
        "warp": None if warp is None else asdict(warp),
        "provenance": _plain(provenance or {}),
        "warnings": noted,
    }
    report["headline"] = headline(report)
    return report


def headline(report: Mapping[str, Any]) -> dict[str, Any]:
    """Say how accurate the result is, in words, from the best evidence that there is.

    Returns
    -------
    dict
        `figure` (``"0.21 px"`` or a word), `metres` (text or None), `what` (a phrase that follows the figure),
        `notes` (sentences that qualify it).
    """
    adjustment = report["adjustment"]
    rmse, redundancy, parameters = adjustment["rmse"], adjustment["redundancy"], len(adjustment["parameters"])
    control, check, loo = rmse["control"], rmse["check"], rmse["loo"]
    if not adjustment["points"]:
        notes = ["The model is used as it was delivered. Vendors' models are commonly off by 5 to 25 m."]
        return {"figure": "Not tested", "metres": None, "what": "there were no ground control points", "notes": notes}
    notes = []
    if control and parameters:
        fitted = f"{_px(control['total'])} RMSE at {_count(control['n'], 'control point')}"
        notes.append(
            f"The fit: {fitted}, redundancy {redundancy}."
            if redundancy
            else f"No redundancy: {_count(control['n'], 'control point')} for {parameters} parameters fit exactly, "
            "which says nothing about accuracy."
        )
    if check:
        what = f"RMSE at {_count(check['n'], 'check point')} that took no part in the adjustment"
        if check["n"] < ENOUGH_CHECK_POINTS:
            notes.append(
                f"Fewer than {ENOUGH_CHECK_POINTS} check points: an indication, not a claim of accuracy (ASPRS 2023)."
            )
        return {**_figure(check, report["rmse_m"]["check"]), "what": what, "notes": notes}
    if control and not parameters:
        what = f"RMSE at {_count(control['n'], 'point')} of the model as delivered, none of which it was adjusted to"
        return {**_figure(control, report["rmse_m"]["control"]), "what": what, "notes": notes}
    notes.append("No check points were kept apart.")
    if loo and redundancy:
        what = f"RMSE when each of {_count(loo['n'], 'control point')} is left out in turn"
        return {**_figure(loo, report["rmse_m"]["loo"]), "what": what, "notes": notes}
    return {"figure": "Not tested", "metres": None, "what": "nothing is left over to test the fit with", "notes": notes}


def _figure(rmse: Mapping[str, Any], metres: Mapping[str, Any] | None) -> dict[str, Any]:
    return {"figure": _px(rmse["total"]), "metres": _m(metres["total"]) if metres else None}


def _viewing(model: SensorModel, width: int, height: int) -> dict[str, Any]:
    """Return pixel size on the ground (m) and how far and whereto (azimuth) the ortho moves per metre of height."""
    centre = model.image_to_ground(np.array([[width / 2, height / 2]]), model.reference_height)
    nothing = {"ground_pixel_m": None, "lean_m_per_m": None, "lean_azimuth_deg": None}
    if not np.isfinite(centre).all():
        return nothing
    plan, up = _metre_partials(model, centre)
    try:
        inverse = np.linalg.inv(plan[0])
    except np.linalg.LinAlgError:
        return nothing
    lean = inverse @ up[0]
    return {
        "ground_pixel_m": np.linalg.norm(inverse, axis=0).tolist(),
        "lean_m_per_m": float(np.hypot(*lean)),
        "lean_azimuth_deg": float(np.degrees(np.arctan2(lean[0], lean[1])) % 360),
    }


def _metre_partials(model: SensorModel, ground: Array) -> tuple[Array, Array]:
    """Return d(image)/d(x, y in metres) ``(N, 2, 2)`` and d(image)/d(height) ``(N, 2)``."""
    partials = model.ground_partials(ground)
    units = units_per_metre(parse_crs(model.crs), ground)
    return partials[:, :, :2] * units[:, None, :2], partials[:, :, 2]


def _in_metres(fit: Fit, residuals: Array) -> Array:
    """Return residuals ``(N, 2)`` px as shifts of the ortho, metres along x and y of the model's ground CRS."""
    if not len(residuals):
        return np.zeros((0, 2))
    plan, _ = _metre_partials(fit.model, fit.points.ground)
    return solve_2x2(plan, residuals)


def _rmse_metres(fit: Fit) -> dict[str, Any]:
    kept = {"control": fit.used, "check": fit.points.check}
    shifts = {name: _in_metres(fit, fit.residuals)[mask] for name, mask in kept.items()}
    shifts["loo"] = _in_metres(fit, fit.loo_residuals)
    found = {}
    for name, values in shifts.items():
        rmse = root_mean_square(values[np.isfinite(values).all(axis=1)])
        found[name] = rmse and {"x": rmse["col"], "y": rmse["row"], "total": rmse["total"], "n": rmse["n"]}
    return found


def _heights_of_points(fit: Fit, surface: Surface, viewing: Mapping[str, Any]) -> dict[str, Any] | None:
    """Compare the heights of the points with the DEM's: a difference of datums shows here and nowhere else."""
    points = fit.points
    if surface.constant_height is not None or not len(points):
        return None
    difference = points.ground[:, 2] - surface.heights(points.ground[:, :2], points.crs)
    difference = difference[np.isfinite(difference)]
    if not len(difference):
        return None
    median = float(np.median(difference))
    spread = float(1.4826 * np.median(np.abs(difference - median)))
    warning = None
    if len(difference) >= 3 and abs(median) > max(_SUSPICIOUS_HEIGHT, 3 * spread):
        lean = viewing["lean_m_per_m"]
        moved = "" if lean is None else f"; that moves the ortho by {_m(abs(median) * lean)}"
        side = "above" if median > 0 else "below"
        warning = (
            f"the points lie {_m(abs(median))} {side} the DEM (median; spread {_m(spread)}): their heights probably "
            f"have another datum than the DEM's{_undulation_there(points.ground, points.crs)}{moved}"
        )
    return {"median_m": median, "spread_m": spread, "n": len(difference), "warning": warning}


def _undulation_there(ground: Array, crs: pyproj.CRS) -> str:
    try:
        there = ground_transform(crs, "EPSG:4979")(ground)
        undulation = float(np.nanmean(Vertical.parse("egm96").undulation(there[:, 0], there[:, 1])))
    except OrthoError:
        return ""
    return f" (the geoid is {undulation:+.1f} m from the ellipsoid there)"


def _ortho(grid: Grid, warp: WarpResult | None) -> dict[str, Any]:
    authority, unit = grid.crs.to_authority(), grid.crs.axis_info[0].unit_name
    return {
        "crs": ":".join(authority) if authority else grid.crs.name,
        "crs_name": grid.crs.name,
        "unit": {"metre": "m", "degree": "°"}.get(unit, unit),
        "extent": [float(value) for value in grid.extent],
        "resolution": [float(grid.dx), float(grid.dy)],
        "size": [grid.width, grid.height],
        "valid_share": None if warp is None else warp.valid_pixels / max(warp.pixels, 1),
    }


def residuals_geojson(fit: Fit) -> dict[str, Any]:
    """Return the points as GeoJSON in lon, lat (WGS 84), one flat property per number, as GIS want them.

    ``res_*`` are residuals in pixels, ``raw_*`` those of the model as delivered, ``loo_*`` leave-one-out; ``east_m``
    and ``north_m`` the shift of the ortho in metres along the axes of the ground, for a vector field symbol.
    """
    points = fit.points
    where = ground_transform(points.crs, "EPSG:4979")(points.ground) if len(points) else np.zeros((0, 3))
    metres = _in_metres(fit, fit.residuals)
    reasons = dict(fit.rejected)
    features = []
    for i, name in enumerate(points.ids):
        pairs = {
            "": points.image[i], "res_": fit.residuals[i], "raw_": fit.raw_residuals[i], "loo_": fit.loo_residuals[i],
        }  # fmt: skip
        numbers = {f"{key}{axis}": pair[k] for key, pair in pairs.items() for k, axis in enumerate(("col", "row"))}
        numbers |= {"res_px": float(np.hypot(*fit.residuals[i])), "east_m": metres[i, 0], "north_m": metres[i, 1]}
        numbers["length_m"] = float(np.hypot(*metres[i]))
        properties = {
            "id": name,
            "role": str(points.roles[i]),
            "used": bool(fit.used[i]),
            **{key: _number(value) for key, value in numbers.items()},
            "rejected": reasons.get(name),
        }
        # A position without a height is legal GeoJSON, NaN is not.
        position = [float(value) for value in where[i] if np.isfinite(value)]
        geometry = {"type": "Point", "coordinates": position} if len(position) >= 2 else None
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


# -- showing ---------------------------------------------------------------------------------------------------------


def write_report_json(report: Mapping[str, Any], path: str | PathLike[str]) -> None:
    """Write the report as JSON, whole or not at all."""
    write_text(path, json.dumps(report, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def write_report_html(
    report: Mapping[str, Any], path: str | PathLike[str], *, ortho: str | PathLike[str] | bytes | None = None
) -> None:
    """Write the report as one page that needs no other file and no network.

    Parameters
    ----------
    ortho : path or bytes, optional
        The orthoimage, of which a preview is made, or the PNG of a preview.
    """
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("ortho_pipeline"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"px": _px, "m": _m, "signed": _signed, "share": _share, "fixed": _fixed, "number": _short}
    png = ortho if isinstance(ortho, bytes) or ortho is None else preview_png(ortho)
    page = environment.get_template("report.html.j2").render(
        report=report,
        adjustment=report["adjustment"],
        head=report["headline"],
        rejected={entry["id"]: entry["reason"] for entry in report["adjustment"]["rejected"]},
        has_loo=any(point["loo_residual"] for point in report["adjustment"]["points"]),
        provenance=list(_flat({**report["scene"]["facts"], **report["provenance"]})),
        plot=plot_residuals(report),
        preview=base64.b64encode(png).decode() if png else None,
    )
    write_text(path, page)


def summary_text(report: Mapping[str, Any]) -> str:
    """Return the report as a screenful of text, without colours."""
    adjustment, scene, head = report["adjustment"], report["scene"], report["headline"]
    rows = [("scene", f"{scene['name']}, {_size(scene['size'])} px, {scene['sensor']} ({scene['model_source']})")]
    if raw := adjustment["raw_bias"]:
        rows.append(("raw bias", f"{_bias(raw)} (measured minus delivered model, {_count(raw['n'], 'point')})"))
    if adjustment["parameters"]:
        values = [f"{name} {_parameter(entry)}" for name, entry in adjustment["parameters"].items()]
        rows.append(("model", f"{adjustment['model']}: {', '.join(values)}"))
    else:
        rows.append(("model", adjustment["model"]))
    metres = f" ({head['metres']})" if head["metres"] else ""
    rows.append(("accuracy", f"{head['figure']}{metres}: {head['what']}"))
    rows += [("", note) for note in head["notes"]]
    rows += [("left out", f"{entry['id']}: {entry['reason']}") for entry in adjustment["rejected"]]
    if surface := report["surface"]:
        rows.append(("heights", _surface_text(surface)))
    if ortho := report["ortho"]:
        steps = " x ".join(_short(step) for step in ortho["resolution"])
        rows.append(("ortho", f"{_size(ortho['size'])} px of {steps} {ortho['unit']}, {ortho['crs']}"))
    if warp := report["warp"]:
        rows.append(("warp", f"{_px(warp['max_error_px'])} at worst from the exact model, {warp['seconds']:.1f} s"))
    # The headline and the rows above have said these already.
    said = " ".join(value for _, value in rows).lower()
    known = ("left out", "no redundancy", "check points: fewer")
    rows += [
        ("warning", text)
        for text in report["warnings"]
        if text.lower() not in said and not any(word in text for word in known)
    ]
    return "\n".join(f"{key:<10}{value}" for key, value in rows)


def _surface_text(surface: Mapping[str, Any]) -> str:
    if surface.get("constant_height") is not None:
        return f"flat ground at {_m(surface['constant_height'])} above the ellipsoid"
    covered = "" if surface["coverage"] is None else f", covers {_share(surface['coverage'])} of the scene"
    return f"{Path(str(surface.get('path', ''))).name}, heights above {surface.get('vertical_label')}{covered}"


def _bias(raw: Mapping[str, Any]) -> str:
    return f"column {_signed(raw['col'])} px, row {_signed(raw['row'])} px"


def _parameter(entry: Mapping[str, Any]) -> str:
    return f"{_short(entry['value'], '+')} ±{_short(entry['sigma'])}"


# -- numbers as people read them -------------------------------------------------------------------------------------


def _numbers(values: Array) -> list[float] | None:
    return [float(value) for value in values] if np.isfinite(values).all() else None


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _plain(value: Any) -> Any:
    """Return nested values as what JSON holds; the rest as text."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return _number(value)
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def _flat(value: Any, name: str = "") -> Iterable[tuple[str, str]]:
    """Yield the leaves of nested values as (path of keys, text); what is None or empty is left out."""
    if isinstance(value, Mapping):
        for key, item in value.items():
            yield from _flat(item, f"{name} · {key}" if name else str(key))
    elif isinstance(value, list):
        if value:
            yield name, ", ".join(str(item) for item in value)
    elif value is not None:
        yield name, str(value)


def _decimals(value: float) -> int:
    """Return how many decimals show three digits of a value, at least two and at most five."""
    return 2 if abs(value) >= 1 or value == 0 else min(5, 2 - math.floor(math.log10(abs(value))))


def _px(value: float) -> str:
    return f"{_fixed(value)} px"


def _m(value: float) -> str:
    return f"{value:.2f} m" if abs(value) < 10 else f"{value:.1f} m"


def _fixed(value: float | None) -> str:
    if value is None:
        return "–"
    # Below 1e-9 it is rounding, and "0.00" is not "0.00000".
    return f"{value:.2f}" if abs(value) >= 0.1 or abs(value) < 1e-9 else f"{value:.{min(_decimals(value), 4)}f}"


def _signed(value: float | None) -> str:
    if value is None:
        return "–"
    text = f"{value:+.2f}"
    return "0.00" if text[1:] == "0.00" else text.replace("-", "−")


def _short(value: float, sign: str = "") -> str:
    return f"{value:{sign}.3g}".replace("-", "−") if value else "0"


def _share(value: float | None) -> str:
    if value is None:
        return "–"
    # "100 %" is only said where it is so.
    return "100 %" if value >= 1 else f"{min(math.floor(value * 1000) / 10, 99.9):.1f} %"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _size(size: Iterable[int]) -> str:
    return " x ".join(str(side) for side in size)
