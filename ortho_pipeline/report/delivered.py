"""The accuracy of a model that no point was measured for: as delivered, or as its file says that it was adjusted."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline.display.numbers import px
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.records import Adjustment
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC
from ortho_pipeline.report.records import UNKNOWN, Headline
from ortho_pipeline.report.wording import headline


def accuracy_before(scene: Scene) -> Headline:
    """Return the headline of a scene that no point was measured in, as `wording.headline` returns it.

    That of an adjusted model is what its file says of the adjustment.
    """
    if scene.adjusted is not None:
        if "from" in scene.adjusted:
            return _untested(
                f"The model has the correction of {scene.adjusted['from']}, whose report has the accuracy."
            )
        try:
            return (_of_block if "gauge" in scene.adjusted else _of_scene)(scene, scene.adjusted)
        except (KeyError, TypeError, ValueError):
            text = "The model was adjusted before, but this version cannot read how well from its file."
            return _untested(text)
    notes = "The model is used as it was delivered."
    if isinstance(scene.model, RPC):
        notes += " Vendors' RPCs are commonly off by 5 to 25 m."
    return _untested(notes)


def _untested(*notes: str, what: str = "there are no points") -> Headline:
    return Headline(figure=UNKNOWN, metres=None, what=what, notes=notes)


def _of_scene(scene: Scene, adjusted: Mapping[str, Any]) -> Headline:
    adjustment = Adjustment.read(adjusted)
    found = headline(adjustment, None)
    name = f"{adjustment.model}, {counted(sum(point.used for point in adjustment.points), 'control point')}"
    return Headline(
        figure=found.figure,
        metres=found.metres,
        what=f"{found.what}, when the model was adjusted ({name})",
        notes=(*found.notes, _source(scene)),
    )


def _of_block(scene: Scene, adjusted: Mapping[str, Any]) -> Headline:
    from ortho_pipeline.block.fit import AdjustedImage  # few scenes come from a block

    image = AdjustedImage.read({name: one for name, one in adjusted.items() if name not in ("gauge", "sigma0")})
    sigma0 = f", sigma0 {float(adjusted['sigma0']):.3g}" if adjusted["sigma0"] else ""
    notes = (f"The block: {adjusted['gauge']}{sigma0}.", _source(scene))
    if check := image.rms.back_projected.check:
        points = f"{counted(check.n, 'measurement')} of check points, whose ground coordinates were not used,"
        what = f"RMSE of {points} in this image, when it was adjusted in a block"
        return Headline(figure=px(check.total), metres=None, what=what, notes=notes)
    what = "the model was adjusted in a block without check points in this image"
    if control := image.rms.back_projected.control:
        fit = f"{px(control.total)} RMSE of {counted(control.n, 'measurement')} of control points in this image"
        return _untested(f"The fit: {fit}. This does not test the accuracy.", *notes, what=what)
    if tie := image.rms.residuals.tie:
        agree = f"There the images agree to {px(tie.total)} (RMSE of {counted(tie.n, 'measurement')} of tie points)."
        return _untested(f"{agree} This tests neither positions nor heights.", *notes, what=what)
    return _untested(*notes, what=what)


def _source(scene: Scene) -> str:
    return f"This is from {Path(scene.model_source).name}; no point here tests it."
