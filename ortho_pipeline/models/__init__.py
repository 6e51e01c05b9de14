"""Sensor models: everything that maps ground to image."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import KINDS, SensorModel, model_from_dict
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.models.families import Family, families, family_of
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.map_plane import MapPlane
from ortho_pipeline.models.mosaicked import Cropped, Pieces
from ortho_pipeline.models.orthos.map_grid import MapGrid
from ortho_pipeline.models.orthos.smooth_field import SmoothField
from ortho_pipeline.models.pushbroom.scanner import Pushbroom
from ortho_pipeline.models.rational import RPC, Rational
from ortho_pipeline.models.rational_start import model_crs, start_model

_OWN = (RPC, Rational, ImageCorrection, Cropped, FrameCamera, MapGrid, MapPlane, Pieces, Pushbroom, SmoothField)
KINDS.update({cls.kind: cls for cls in _OWN})


def require_view(model: SensorModel) -> None:
    """Refuse a model that maps no ground of its domain into an image, although each of its numbers is possible.

    Raises
    ------
    InputError
        If the domain is not finite, or none of 125 points in it has a finite image.

    Examples
    --------
    >>> require_view(op.read_rpc("sample_data/scene_RPC.TXT"))
    """
    centre, half = model.domain
    if not (np.isfinite(centre).all() and np.isfinite(half).all()):
        raise InputError("the domain of this model is not finite", field="model")
    parts = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 5)] * 3), axis=-1).reshape(-1, 3)
    with np.errstate(all="ignore"):
        image = model.ground_to_image(centre + parts * half)
    if np.isinf(image).any() or not np.isfinite(image).all(axis=1).any():
        raise InputError("this model maps no ground of its domain into an image", field="model")


__all__ = [
    "KINDS",
    "RPC",
    "Cropped",
    "Family",
    "FrameCamera",
    "ImageCorrection",
    "MapGrid",
    "MapPlane",
    "Pieces",
    "Pushbroom",
    "Rational",
    "SensorModel",
    "SmoothField",
    "families",
    "family_of",
    "model_crs",
    "model_from_dict",
    "require_view",
    "start_model",
]
