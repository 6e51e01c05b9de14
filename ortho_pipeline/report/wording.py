"""The report in words: the headline, the summary for the terminal, and numbers as people read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ortho_pipeline.display.notices import Notice, texts_but
from ortho_pipeline.display.numbers import metres, px, short, signed, size_text
from ortho_pipeline.errors import counted
from ortho_pipeline.surface.base import provenance_text

#: ASPRS Positional Accuracy Standards (2023): no claim of accuracy below this number of check points.
ENOUGH_CHECK_POINTS = 30


def few_check_points(count: int) -> Notice:
    """Return the notice that there are too few check points for a claim of accuracy."""
    return Notice(
        "few-check-points",
        f"{counted(count, 'check point')}: fewer than the {ENOUGH_CHECK_POINTS} that ASPRS 2023 asks for before "
        "accuracy is claimed",
        count=count,
        enough=ENOUGH_CHECK_POINTS,
    )


def headline(
    report: Mapping[str, Any], before: Mapping[str, Any] | None = None, *, adjusted: bool = False
) -> dict[str, Any]:
    """Say how accurate the result is, in words, from the best evidence that there is.

    Parameters
    ----------
    before : mapping, optional
        The headline where there are no points (`delivered.accuracy_before`).
    adjusted : bool
        Whether the model was adjusted before.

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
        untested: dict[str, Any] = {
            "figure": "Not tested",
            "metres": None,
            "what": "there were no ground control points",
            "notes": [],
        }
        return dict(before or untested)
    notes = []
    if lost := len(adjustment["rejected"]):
        notes.append(
            f"{counted(lost, 'control point')} left out and not counted: good points that are left out are a sign of a "
            "model that does not suit the scene."
        )
    if control and parameters:
        fitted = f"{px(control['total'])} RMSE at {counted(control['n'], 'control point')}"
        notes.append(
            f"The fit: {fitted}, redundancy {redundancy}."
            if redundancy
            else f"No redundancy: {counted(control['n'], 'control point')} for "
            f"{counted(parameters, 'parameter')} fit exactly, "
            "which says nothing about accuracy."
        )
    notes += _outlying_notes(adjustment)
    if check:
        what = f"RMSE at {counted(check['n'], 'check point')} that took no part in the adjustment"
        if check["n"] < ENOUGH_CHECK_POINTS:
            notes.append(
                f"Fewer than {ENOUGH_CHECK_POINTS} check points: an indication, not a claim of accuracy (ASPRS 2023)."
            )
        return {**_figure(check, report["rmse_m"]["check"]), "what": what, "notes": notes}
    if control and not parameters:
        what = (
            f"RMSE at {counted(control['n'], 'point')} of the model as it was adjusted before: a test only if to others"
            if adjusted
            else f"RMSE at {counted(control['n'], 'point')} of the model as delivered, none of which it was adjusted to"
        )
        return {**_figure(control, report["rmse_m"]["control"]), "what": what, "notes": notes}
    notes.append("No check points were kept apart.")
    if loo and redundancy:
        what = f"RMSE when each of {counted(loo['n'], 'control point')} is left out in turn"
        return {**_figure(loo, report["rmse_m"]["loo"]), "what": what, "notes": notes}
    return {"figure": "Not tested", "metres": None, "what": "nothing is left over to test the fit with", "notes": notes}


def _outlying_notes(adjustment: Mapping[str, Any]) -> list[str]:
    """Say which check points contradict the others, and what the figure would be without them."""
    names = [one["id"] for one in adjustment["outlying"] if one["role"] == "check"]
    if not names:
        return []
    said = f"Probably wrong, but counted: check point{'s' if len(names) > 1 else ''} {', '.join(names)}"
    rest = adjustment["rmse_of_agreeing_checks"]
    return [f"{said}; without {px(rest['total'])} at {counted(rest['n'], 'check point')}." if rest else f"{said}."]


def _figure(rmse: Mapping[str, Any], rmse_m: Mapping[str, Any] | None) -> dict[str, Any]:
    return {"figure": px(rmse["total"]), "metres": metres(rmse_m["total"]) if rmse_m else None}


def summary_text(report: Mapping[str, Any]) -> str:
    """Return the report as a screenful of text, without colours."""
    adjustment, scene, head = report["adjustment"], report["scene"], report["headline"]
    rows = [("scene", f"{scene['name']}, {size_text(scene['size'])} px, {scene['sensor']} ({scene['model_source']})")]
    if raw := adjustment["raw_bias"]:
        rows.append(("raw bias", f"{_bias(raw)} (measured minus delivered model, {counted(raw['n'], 'point')})"))
    if adjustment["parameters"]:
        values = [f"{name} {_parameter(entry)}" for name, entry in adjustment["parameters"].items()]
        rows.append(("model", f"{adjustment['model']}: {', '.join(values)}"))
    else:
        rows.append(("model", adjustment["model"]))
    ground = f" ({head['metres']})" if head["metres"] else ""
    rows.append(("accuracy", f"{head['figure']}{ground}: {head['what']}"))
    rows += [("", note) for note in head["notes"]]
    if scale := report.get("map_scale"):
        rows.append(("map scale", scale["statement"]))
    for role, found in (report.get("covariance") or {}).items():
        if found and found["verdict"] == "systematic":
            rows.append(("pattern", f"{role} points: {found['statement']}"))
    rows += [("left out", f"{entry['id']}: {entry['reason']}") for entry in adjustment["rejected"]]
    if surface := report["surface"]:
        rows.append(("heights", provenance_text(surface)))
    if ortho := report["ortho"]:
        steps = " x ".join(short(step) for step in ortho["resolution"])
        rows.append(("ortho", f"{size_text(ortho['size'])} px of {steps} {ortho['unit']}, {ortho['crs']}"))
    if warp := report["warp"]:
        by = f" (GDAL's {name} transformer)" if (name := warp.get("transformer")) else ""
        rows.append(("warp", f"{px(warp['max_error_px'])} at worst from the exact model{by}"))
    # The headline and the rows above have said these already.
    rows += [("warning", text) for text in texts_but(report, "left-out", "no-redundancy", "few-check-points")]
    return "\n".join(f"{key:<10}{value}" for key, value in rows)


def _bias(raw: Mapping[str, Any]) -> str:
    return f"column {signed(raw['col'])} px, row {signed(raw['row'])} px"


def _parameter(entry: Mapping[str, Any]) -> str:
    return f"{short(entry['value'], '+')} ±{short(entry['sigma'])}"


# -- numbers as people read them -------------------------------------------------------------------------------------
