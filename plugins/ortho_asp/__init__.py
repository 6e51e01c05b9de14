"""Plugin for Ames Stereo Pipeline: its cameras and those of ISIS next to an image, and the format ``asp``.

The sensor reads CSM states, .tsai, ASTER and .adjust. The format gives ASP an adjusted block.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from ortho_csm.files import has_csm, read_csm
from osgeo import gdal

from ortho_asp.cameras import adjusted, read_adjust, read_aster, read_tsai
from ortho_asp.stereo import asp_text
from ortho_pipeline.plugin import (
    BlockFormat,
    FrameCamera,
    InputError,
    Notice,
    Pushbroom,
    Scene,
    Sensor,
    SensorModel,
    hookimpl,
    listing,
    place,
    read_bounded,
    read_rpc_text,
)

#: What a camera's name ends with after the stem of its image; the first that is there, so adjusted states come first.
ENDINGS = (".adjusted_state.json", "_csm.json", ".json", ".isd", ".tsai", ".xml")


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``asp``."""
    yield Sensor(
        "asp",
        "images with a camera of Ames Stereo Pipeline or ISIS: CSM state (.json, .isd), .tsai, ASTER's .xml",
        recognises,
        open_scene,
        options={
            "camera": "the camera file, if it is not named like the image",
            "adjust": "an adjustment (.adjust) for the CSM state of a line scanner",
        },
    )


@hookimpl
def ortho_formats() -> Iterable[BlockFormat]:
    """Offer the format ``asp``."""
    yield BlockFormat("asp", "Ames Stereo Pipeline 3", "asp.sh", ("csm", "rpc-xml"), asp_text, "sh")


def camera_of(name: str) -> Path | None:
    """Return the camera file of an image: named as it, whatever the case of its letters; None without."""
    if not name:
        return None
    try:
        image = place(name)
        beside = listing(image.parent)
    except (OSError, ValueError, InputError):
        return None
    candidates = (image.parent / name for ending in ENDINGS for name in beside.named(f"{image.stem}{ending}"))
    return next((path for path in candidates if path.is_file() and _kind(path)), None)


def _kind(path: Path) -> str | None:
    """Return which kind of camera a file is, from its first bytes."""
    if has_csm(path):
        return "csm"
    try:
        start = read_bounded(path, 400)[:400]
    except InputError:
        return None
    if path.suffix.lower() == ".tsai" and b"PINHOLE" in start:
        return "tsai"
    return "aster" if b"<LATTICE_POINT>" in start else None


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether there is a camera next to an image."""
    return camera_of(dataset.GetDescription()) is not None


def open_scene(dataset: gdal.Dataset, *, camera: str | None = None, adjust: str | None = None) -> Scene:
    """Open an image with its camera."""
    name, size = dataset.GetDescription(), (dataset.RasterXSize, dataset.RasterYSize)
    path = place(camera) if camera else camera_of(name)
    kind = None if path is None else _kind(path)
    if path is None or kind is None:
        raise InputError(
            "no camera file found for this image" if path is None else "this file has no supported camera",
            file=path or name,
            field="camera",
            remedy="give a CSM state, .tsai or ASTER camera as sensor option camera=FILE",
        )
    model: SensorModel = (
        read_csm(path) if kind == "csm" else read_tsai(path, size) if kind == "tsai" else read_aster(path)
    )
    its = model.camera.size if isinstance(model, Pushbroom) else size
    if isinstance(model, FrameCamera):
        its = model.interior.width, model.interior.height
    sources, warnings = [], []
    if its != size:
        text = "the camera is for {} x {} pixels, but this image has {} x {}. Is it a crop?".format(*its, *size)
        warnings.append(Notice("maybe-a-crop", text, metadata_size=list(its)))
    if adjust is not None:
        model, sources = adjusted(model, *read_adjust(place(adjust))), [place(adjust)]
    models = {model.kind: model}
    if kind == "aster":
        models["rpc"] = read_rpc_text(path)
    facts = {"camera": path.name}
    return Scene("asp", name, *size, models, str(path), facts, tuple(warnings), sources=tuple(sources))
