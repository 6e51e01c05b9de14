"""The adjusted models of a block, meant for its ground, and their RPCs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.start import Start
from ortho_pipeline.commands.block_results.orthos import corrected
from ortho_pipeline.commands.rectification import no_rpc
from ortho_pipeline.commands.resolved.opening import on_surface
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange import rpc
from ortho_pipeline.models import ImageCorrection, SensorModel
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface


def adjusted_models(fit: BlockFit, starts: Mapping[str, Start], heights: Surface | None) -> dict[str, SensorModel]:
    """Return the adjusted models by label, without corrections that correct nothing.

    Where the range of heights of a model is but a guess, it becomes that of the DEM under the image.
    """
    models = {label: _plain(fit.models[label]) for label in starts}
    if not isinstance(heights, DemSurface):
        return models
    ground = corrected(heights, fit)
    return {
        label: on_surface(replace(start.scene, models={start.name: models[label]}), ground).models[start.name]
        for label, start in starts.items()
    }


def _plain(model: SensorModel) -> SensorModel:
    """Return the model without a correction that corrects nothing."""
    return model.model if isinstance(model, ImageCorrection) and model.correction == "none" else model


def exported_models(
    models: Mapping[str, SensorModel], files: dict[str, Path]
) -> tuple[dict[str, rpc.RpcExport], list[Notice]]:
    """Return the RPCs of the models, and notices; where no RPC represents a model, remove its file from `files`."""
    exported, notes = dict[str, rpc.RpcExport](), list[Notice]()
    for label, model in models.items():
        try:
            exported[label] = rpc.export_rpc(model)
            notes += [notice.in_image(label) for notice in exported[label].warnings]
        except InputError as error:
            notes.append(no_rpc(error).in_image(label))
            del files[f"{label} rpc"]
    return exported, notes
