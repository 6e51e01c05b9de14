"""The model file ``<stem>_model.json``: a sensor model and its origin."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ortho_pipeline.errors import InputError, PluginError, reads
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files import read_json, write_json
from ortho_pipeline.files.json.values import software_version
from ortho_pipeline.models import model_from_dict, require_view
from ortho_pipeline.models.base import SensorModel

SCHEMA_VERSION = 1
DOCUMENT = "ortho-pipeline model"
_MAX_BYTES = 50_000_000


#: Remedy for a damaged file.
_REMEDY = "give an unchanged <stem>_model.json, or write it again"


@dataclass(frozen=True)
class SavedModel:
    """The contents of a model file.

    Parameters
    ----------
    model : SensorModel
    sensor : str
        Name of the sensor that opened the scene; empty without a scene.
    model_source : str
        File or tag of the delivered model.
    size : (int, int) or None
        Columns and rows of the image that the model belongs to.
    provenance : mapping
        JSON values: inputs, their checksums, software, adjustment.
    """

    model: SensorModel
    sensor: str = ""
    model_source: str = ""
    size: tuple[int, int] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def adjusted(self) -> Mapping[str, Any] | None:
        """The adjustment of the model, of a scene or in a block; None for a delivered model."""
        adjustment = self.provenance.get("adjustment")
        if not isinstance(adjustment, dict) or not (adjustment.get("gauge") or adjustment.get("points")):
            return None
        # Check points alone adjust nothing.
        return adjustment if adjustment.get("parameters") else None


def write_model_file(saved: SavedModel, path: str | os.PathLike[str]) -> None:
    """Write a model file, whole or not at all, with numbers to the last bit.

    Raises
    ------
    PluginError
        If the file could not be read again, because the kind of its model is not registered.
    """
    model = saved.model.to_dict()
    try:
        model_from_dict(model)
    except InputError as error:
        raise PluginError(
            f"the written model cannot be read again: {error.message}",
            file=path,
            remedy="return its class from the hook ortho_models of the plugin; in a script, add it to models.KINDS",
        ) from error
    document = {
        "document": DOCUMENT,
        "schema_version": SCHEMA_VERSION,
        "software": f"ortho-pipeline {software_version()}",
        "sensor": saved.sensor,
        "model_source": saved.model_source,
        "size": None if saved.size is None else list(saved.size),
        "model": model,
        "provenance": dict(saved.provenance),
    }
    write_json(path, document, ascii_only=False)


@reads(_REMEDY)
def read_model_file(path: str | os.PathLike[str]) -> SavedModel:
    """Read a model file.

    Raises
    ------
    InputError
        If it is not a model file, has a later schema, or its model does not fit its kind or maps no ground.
    """
    content = read_json(path, _MAX_BYTES, _REMEDY)
    document: dict[str, Any] = content if isinstance(content, dict) else {}
    version = document.get("schema_version")
    if document.get("document") != DOCUMENT or not isinstance(document.get("model"), dict):
        raise InputError(
            "this is not a model file of ortho-pipeline",
            file=path,
            remedy=Text("give a <stem>_model.json; RPC files go to ", Setting("scene.rpc")),
        )
    if version != SCHEMA_VERSION:
        raise InputError(
            f"unknown schema version {version!r}; this version reads {SCHEMA_VERSION}",
            file=path,
            field="schema_version",
            remedy="update ortho-pipeline",
        )
    size = document.get("size")
    if size is not None and not (
        isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) and n > 0 for n in size)
    ):
        raise InputError(
            f"{size!r} is not an image size", file=path, field="size", remedy="give two positive integers, or null"
        )
    try:
        model = model_from_dict(document["model"])
        require_view(model)
    except InputError as error:
        error.field = "model" if error.field in (None, "model") else f"model.{error.field}"
        raise
    provenance = document.get("provenance")
    return SavedModel(
        model=model,
        sensor=str(document.get("sensor") or ""),
        model_source=str(document.get("model_source") or ""),
        size=None if size is None else (size[0], size[1]),
        provenance=provenance if isinstance(provenance, dict) else {},
    )


def save_model(
    model: SensorModel, path: str | os.PathLike[str], *, adjustment: Mapping[str, Any] | None = None
) -> None:
    """Write `model` as a model file; `load_model` reads it.

    Parameters
    ----------
    adjustment : mapping, optional
        Its adjustment as JSON values: ``Fit.to_json()``, or the image's part of ``BlockFit.to_json()`` with `gauge` and
        `sigma0`. Reports then show the accuracy of this model.

    Raises
    ------
    PluginError
        If the kind of the model is not registered, so that the file could not be read again.

    Examples
    --------
    >>> op.save_model(op.read_rpc("sample_data/scene_RPC.TXT"), out / "scene_model.json")
    >>> op.load_model(out / "scene_model.json").kind
    'rpc'
    """
    write_model_file(SavedModel(model, provenance={} if adjustment is None else {"adjustment": dict(adjustment)}), path)


def load_model(path: str | os.PathLike[str]) -> SensorModel:
    """Return the sensor model of a model file.

    Raises
    ------
    InputError
        As `read_model_file`.

    Examples
    --------
    >>> import tempfile
    >>> import ortho_pipeline as op
    >>> path = f"{tempfile.mkdtemp()}/scene_model.json"
    >>> op.save_model(op.open_scene("sample_data/scene.tif").model, path)
    >>> op.load_model(path).kind
    'rpc'
    """
    return read_model_file(path).model
