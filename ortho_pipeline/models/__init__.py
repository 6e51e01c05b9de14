"""Sensor models: everything that maps ground to image."""

from __future__ import annotations

from typing import Any

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.models.families import Family, families, family_of
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.map_plane import MapPlane
from ortho_pipeline.models.mosaicked import Cropped, Pieces
from ortho_pipeline.models.pushbroom.scanner import Pushbroom
from ortho_pipeline.models.rational import RPC, Rational
from ortho_pipeline.models.rational_start import model_crs, start_model

#: Model classes by the `kind` under which files name them; the hook `ortho_models` adds to it.
KINDS: dict[str, type[SensorModel]] = {
    cls.kind: cls for cls in (RPC, Rational, ImageCorrection, Cropped, FrameCamera, MapPlane, Pieces, Pushbroom)
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
    except (TypeError, ValueError, AttributeError, ArithmeticError, LookupError, RecursionError) as error:
        # Constructors check what numbers mean; that a value is a number or a list at all is found out by using it.
        raise InputError(
            f"this is not a model of kind {kind!r} ({str(error)[:200]})", field=kind,
            remedy="leave what was written as it is, or write the model again",
        ) from error  # fmt: skip


def require_view(model: SensorModel) -> None:
    """Refuse a model whose numbers are each possible, but which maps nothing of the ground that it is meant for.

    Raises
    ------
    InputError
        If its domain is not finite, or of 125 points of it none has a finite place in the image.
    """
    centre, half = model.domain
    if not (np.isfinite(centre).all() and np.isfinite(half).all()):
        raise InputError("the ground that this model is meant for has no finite bounds", field="model")
    parts = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 3), axis=-1).reshape(-1, 3)
    with np.errstate(all="ignore"):
        image = model.ground_to_image(centre + parts * half)
    if np.isinf(image).any() or not np.isfinite(image).all(axis=1).any():
        raise InputError("this model maps none of the ground that it is meant for into an image", field="model")


__all__ = [
    "KINDS",
    "RPC",
    "Cropped",
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
    "require_view",
    "start_model",
]
