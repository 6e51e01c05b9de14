"""`ortho register`: single bands brought onto one of them, in one image that opens as the same product."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ortho_pipeline import host
from ortho_pipeline.commands import inputs
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.results import Result, to_store
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.exchange.model_file import SavedModel, write_model_file
from ortho_pipeline.files import allowed, states, together, whole_or_nothing, write_json
from ortho_pipeline.files.locations import Location, located, place
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.imaging.band_stack import stack_bands
from ortho_pipeline.imaging.registration import Registration
from ortho_pipeline.options import SceneOptions

SCHEMA_VERSION = 1


@to_store(folder="bands")
def register(
    images: Sequence[str | os.PathLike[str]],
    folder: str | os.PathLike[str],
    *,
    reference: str | os.PathLike[str] | None = None,
    transform: str = "projective",
    scene: SceneOptions = SceneOptions(),
) -> Result:
    """Bring single-band images onto one of them and write all bands as one image, in the order given.

    The stack has the geometry of the reference. Where that is a product of a sensor with its metadata in a file beside
    the image, this is copied next to the stack, which then opens as such a product; any other model is written as a
    model file.

    Parameters
    ----------
    images : sequence of path
        At least two, of one size and type.
    reference : path, optional
        One of them; the first one by default.
    transform : str
        One of `registration.TRANSFORMS`.

    Returns
    -------
    Result
        `files` has image, table (residuals and checksums), and metadata or model.

    Raises
    ------
    InputError
        If an image is given twice or cannot be read, the sizes or types differ, or nothing matches.
    """
    paths = [place(located(image, allow_network=scene.allow_network)) for image in images]
    chosen = paths[0] if reference is None else place(located(reference, allow_network=scene.allow_network))
    names = [path.stem for path in paths]
    if chosen not in paths or len(set(names)) != len(names):
        wrong = "the reference is not one of the images" if chosen not in paths else "two images have the same name"
        raise InputError(wrong, file=chosen, field="reference", remedy="list each band once, including the reference")
    opened = inputs.open_image(chosen, scene, needs_model=False)
    files = {"image": Path(folder) / f"{chosen.stem}_bands.tif", "table": Path(folder) / f"{chosen.stem}_bands.json"}
    beside = _metadata_beside(opened, files["image"])
    if beside is not None:
        files["metadata"] = beside
    elif opened.models:
        files["model"] = Path(folder) / f"{chosen.stem}_bands_model.json"
    for path in map(allowed, files.values()):
        if path.resolve() in {file.resolve() for file in (*paths, place(opened.model_source))}:
            raise InputError(
                "this file is both input and output", file=path, field="folder", remedy="choose another folder"
            )
    # The source of a band in an archive is the archive.
    read = {Location(path).archive or Path(path): "band" for path in paths}
    ledger = Ledger(read, states([*paths, opened.model_source]))
    with together(folder, files["image"].stem):
        if beside is not None:
            with whole_or_nothing(beside, side_cars=False) as temporary:
                Path(temporary).write_bytes(place(opened.model_source).read_bytes())
        done = stack_bands(
            dict(zip(names, paths, strict=True)), files["image"], reference=chosen.stem, transform=transform
        )
        if "model" in files:
            size = opened.width, opened.height
            write_model_file(SavedModel(opened.model, opened.sensor, opened.model_source, size), files["model"])
        document = _document(opened, chosen, names, done, ledger.hashed())
        write_json(files["table"], document)
        ledger.require_unchanged()
    return Result(files, document, _text(chosen, done))


def _metadata_beside(scene: Scene, image: Path) -> Path | None:
    sensor = host.Host.discover().sensors.get(scene.sensor)
    if sensor is None or sensor.metadata_beside is None or not place(scene.model_source).is_file():
        return None
    return sensor.metadata_beside(str(image))


def _document(
    scene: Scene, reference: Path, names: list[str], done: tuple[Registration, ...], read: list[dict[str, Any]]
) -> dict[str, Any]:
    return {
        "schema_version": SCHEMA_VERSION,
        "sensor": scene.sensor,
        "reference": reference.stem,
        "bands": names,
        "registrations": [registration.row() for registration in done],
        "inputs": read,
    }


def _text(reference: Path, done: tuple[Registration, ...]) -> str:
    rows = [registration.row() for registration in done]
    wide = max(len(row["band"]) for row in rows)
    lines = [
        f"{counted(len(rows) + 1, 'band')} in the geometry of {reference.name}; residuals of tie points in pixels:"
    ]
    lines += [
        f"{row['band']:<{wide}}  {row['transform']}, {row['used']} of {counted(row['tie_points'], 'tie point')}, RMSE "
        f"{row['rmse']:.3f}, largest {row['largest']:.3f}"
        for row in rows
    ]
    return "\n".join(lines)
