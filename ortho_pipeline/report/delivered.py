"""What is known of how accurate a model is before any point is seen: delivered, or adjusted before."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.display.numbers import px
from ortho_pipeline.errors import counted
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC
from ortho_pipeline.report.wording import headline

_UNTESTED = {"figure": "Not tested", "metres": None, "what": "there were no ground control points"}


def accuracy_before(scene: Scene) -> dict[str, Any]:
    """Return the headline of a scene that no point was measured in, as `report_text.headline` returns it.

    That of an adjusted model is what its file says of the adjustment.
    """
    if scene.adjusted is not None:
        try:
            return _of_block(scene) if "gauge" in scene.adjusted else _of_scene(scene)
        except (KeyError, TypeError, ValueError, AttributeError):
            text = "The model was adjusted before; its file does not say how well in a way that is understood here."
            return {**_UNTESTED, "notes": [text]}
    notes = "The model is used as it was delivered."
    if isinstance(scene.model, RPC):
        notes += " Vendors' RPCs are commonly off by 5 to 25 m."
    return {**_UNTESTED, "notes": [notes]}


def _of_scene(scene: Scene) -> dict[str, Any]:
    adjustment: Mapping[str, Any] = {"outlying": (), "rmse_of_agreeing_checks": None, **(scene.adjusted or {})}
    found = headline({"adjustment": adjustment, "rmse_m": dict.fromkeys(("control", "check", "loo"))})
    control = sum(1 for point in adjustment["points"] if point["used"])
    name = f"{adjustment['model']}, {counted(control, 'control point')}"
    return {
        **found,
        "what": f"{found['what']}, when the model was adjusted ({name})",
        "notes": _notes(scene, found["notes"]),
    }


def _of_block(scene: Scene) -> dict[str, Any]:
    adjusted: Mapping[str, Any] = scene.adjusted or {}
    gauge = str(adjusted["gauge"])
    notes = _notes(
        scene,
        [
            f"The block: {gauge}, sigma0 {float(adjusted['sigma0']):.3g}."
            if adjusted["sigma0"]
            else f"The block: {gauge}."
        ],
    )
    seen, residuals = adjusted["rms"]["back_projected"], adjusted["rms"]["residuals"]
    kinds = (
        (seen["check"], "of check points, whose ground took no part,"),
        (seen["control"], "of control points (the fit, not a test)"),
        (residuals["tie"], "of tie points (how well the images agree, not how right they are)"),
    )
    for found, what in kinds:
        if found:
            said = f"RMSE of {counted(found['n'], 'measurement')} {what} in this image, when it was adjusted in a block"
            return {"figure": px(found["total"]), "metres": None, "what": said, "notes": notes}
    return {**_UNTESTED, "what": "the model was adjusted in a block without points in this image", "notes": notes}


def _notes(scene: Scene, notes: list[str]) -> list[str]:
    return [*notes, f"That is what {Path(scene.model_source).name} says; no point was measured here to test it."]
