"""Sensor models: everything that maps ground to image."""

from __future__ import annotations

from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.models.families import Family, families, family_of
from ortho_pipeline.models.frame import FrameCamera
from ortho_pipeline.models.geo import MapPlane
from ortho_pipeline.models.pieces import Pieces
from ortho_pipeline.models.pushbroom import Pushbroom
from ortho_pipeline.models.rational import RPC, Rational
from ortho_pipeline.models.start import model_crs, start_model

#: Model classes by the `kind` under which files name them; the hook `ortho_models` adds to it.
KINDS: dict[str, type[SensorModel]] = {
    cls.kind: cls for cls in (RPC, Rational, ImageCorrection, FrameCamera, MapPlane, Pieces, Pushbroom)
}


def model_from_dict(data: dict[str, Any]) -> SensorModel:
    """Make a model from what its `to_dict` returned.

    Raises
    ------
    InputError
        If its kind is unknown (the plugin that has it is not installed) or its fields do not fit.
    """
    kind = data.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise InputError(
            f"no installed sensor model is of kind {kind!r}",
            field="kind",
            remedy=f"known kinds are {', '.join(sorted(KINDS))}; install the plugin that offers it in ortho_models",
        )
    try:
        return KINDS[kind].from_dict(data)
    except (TypeError, ValueError) as error:
        raise InputError(f"this is no model of kind {kind!r} ({error})") from error


__all__ = [
    "KINDS",
    "RPC",
    "Family",
    "FrameCamera",
    "ImageCorrection",
    "MapPlane",
    "Pieces",
    "Pushbroom",
    "Rational",
    "SensorModel",
    "families",
    "family_of",
    "model_crs",
    "model_from_dict",
    "start_model",
]
