"""An image as a scene, and the paths that a command may write."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline import host
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange import crop
from ortho_pipeline.exchange.model_file import SavedModel, read_model_file
from ortho_pipeline.files import allowed, sha256
from ortho_pipeline.files.locations import Location, located
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import families
from ortho_pipeline.options import PathLike, SceneOptions
from ortho_pipeline.raster import source as raster
from ortho_pipeline.raster.verified_writing import ATTACHED

#: Sidecar files that GDAL attaches to an image of this stem, whatever the image itself contains.
SIDE_CARS = ("_RPC.TXT", "_rpc.txt", ".RPB", ".rpb", "_metadata.txt", ".IMD")
#: The own model of an image contradicts a saved one if it is off by this part of the shorter side, and so many px.
_ANOTHER, _LEAST_ANOTHER = 0.1, 100.0
#: Name of the "sensor" of an image that has no model of its own.
POINTS_ONLY = "points only"


# -- opening ---------------------------------------------------------------------------------------------------------


def open_scene(image: str | os.PathLike[str], options: SceneOptions = SceneOptions()) -> Scene:
    """Open an image with its sensor, or with the model of a model file; a scene that is open already stays as it is.

    Raises
    ------
    InputError
        If no sensor recognises the image, the model file belongs to an image of another size, or options say how to
        open what is open.
    """
    if isinstance(image, Scene):
        if dataclasses.replace(options, allow_network=False, roots=()) != SceneOptions():
            raise InputError(
                "options cannot change a scene that is already open",
                file=image,
                field="scene",
                remedy="give its path, or open it with these options",
            )
        return image
    if options.ortho:
        return open_ortho(image, options, only=False)
    if options.model is None:
        sensor_options: dict[str, Any] = dict(options.sensor_options)
        if options.rpc is not None:
            if "rpc" in sensor_options:
                raise InputError(
                    "two options choose the RPC",
                    field="scene.rpc",
                    remedy=Text("leave out ", Setting("scene.sensor_options", "...", "rpc")),
                )
            sensor_options["rpc"] = options.rpc
        sensor_options = {
            name: _perhaps_elsewhere(value, options.allow_network) for name, value in sensor_options.items()
        }
        return host.open_scene(image, options.sensor, sensor_options, crop_offset=options.crop_offset, **options.access)
    return _with_model_file(image, options, options.model)


def _refuse_family(model: PathLike) -> None:
    """Refuse the name of a model family (or a misspelt one) in place of a model file."""
    name = os.fspath(model)
    if Path(name).suffix or name.startswith("/vsi") or Location(name).is_address or os.path.exists(name):
        return
    raise InputError(
        f"there is no model file {name!r}",
        field="scene.model",
        remedy=Text(
            "give a <stem>_model.json. To fit a model to points, use ",
            Setting("points.fit_model", "NAME"),
            f" ({', '.join(family.name for family in families())})",
        ),
    )


def _with_model_file(image: str | os.PathLike[str], options: SceneOptions, model: PathLike) -> Scene:
    """Open an image with the model of a model file, which takes the place of its own."""
    if options.rpc is not None or options.sensor is not None or options.sensor_options:
        raise InputError(
            "a model file replaces the image's model, so options of that model have no effect",
            field="scene.model",
            remedy=Text(
                "leave out ",
                Setting("scene.rpc"),
                ", ",
                Setting("scene.sensor"),
                " and ",
                Setting("scene.sensor_options"),
            ),
        )
    dataset = raster.open_dataset(image, **options.access)
    host.Host.discover()  # model families of plugins, which the file may name
    _refuse_family(model)
    saved = read_model_file(located(model, allow_network=options.allow_network))
    size = dataset.RasterXSize, dataset.RasterYSize
    offset = options.crop_offset
    if offset is None and saved.size != size:
        offset = crop.noted_offset(dataset)
    if saved.size is not None and not crop.fits(size, saved.size, offset):
        raise InputError(
            f"this model belongs to an image of {saved.size[0]} x {saved.size[1]} pixels; {Path(image).name} has "
            f"{size[0]} x {size[1]}",
            file=model,
            field="size",
            remedy=Text(
                "give the model file of this image; if it is a crop, give its position with ",
                Setting("scene.crop_offset", "COL,ROW"),
            ),
        )
    if offset is None:
        _refuse_another(image, options, saved, model, size)
    scene = Scene(
        sensor=saved.sensor or "model file",
        path=image,
        width=size[0],
        height=size[1],
        models={saved.model.kind: saved.model},
        model_source=str(model),
        facts={"delivered_model_source": saved.model_source} if saved.model_source else {},
        adjusted=saved.adjusted,
    )
    return scene if offset is None else crop.placed(scene, dataset, offset)


def _refuse_another(
    image: str | os.PathLike[str], options: SceneOptions, saved: SavedModel, model: PathLike, size: tuple[int, int]
) -> None:
    """Refuse the model of another image of the same size, such as another photo of the camera.

    The image's own model contradicts it by far, and it was not saved for a file with this content.
    """
    middle = np.array([[size[0] / 2, size[1] / 2]])
    try:
        own = host.open_scene(image, None, {}, **options.access).model
        ground = saved.model.image_to_ground(middle, saved.model.reference_height)
        seen = own.ground_to_image(ground_transform(saved.model.crs, own.crs)(ground))
    except OrthoError:
        return
    if np.hypot(*(seen - middle)[0]) < max(_ANOTHER * min(size), _LEAST_ANOTHER) or not Path(image).is_file():
        return
    inputs = saved.provenance.get("inputs")
    files = [one for one in inputs if isinstance(one, dict)] if isinstance(inputs, list) else []
    known = {one.get("sha256") for one in files if one.get("role") == "image"}
    if known and sha256(image) not in known:
        raise InputError(
            "this model was saved for another image; the model of this one places it elsewhere",
            file=model,
            field="scene.model",
            remedy=Text(
                "give the model file of this image; if it is a copy of the other, add ",
                Setting("scene.crop_offset", "0,0"),
            ),
        )


def open_image(image: str | os.PathLike[str], options: SceneOptions, *, needs_model: bool) -> Scene:
    """Open an image that may have no model of its own.

    Parameters
    ----------
    needs_model : bool
        Whether an image without a model of its own is an error.

    Returns
    -------
    Scene
        Without models and of the sensor "points only" where no sensor recognises the image.
    """
    has_options = isinstance(image, Scene) or bool(
        options.model or options.rpc or options.sensor or options.sensor_options or options.ortho
    )
    if needs_model or has_options:
        return open_scene(image, options)
    plugins = host.Host.discover()
    dataset = plugins.open_image(image, **options.access)
    try:
        plugins.recognise(dataset)
    except InputError:
        if any(sensor.recognises(dataset) for sensor in plugins.sensors.values()):
            raise
        return Scene(POINTS_ONLY, Path(image), dataset.RasterXSize, dataset.RasterYSize, {}, "control points")
    return open_scene(image, options)


def _perhaps_elsewhere(value: Any, allow_network: bool) -> Any:
    """Return a file in an archive or on the network in the form that GDAL reads; any other value unchanged."""
    text = str(value)
    return located(text, allow_network=allow_network) if text.startswith("/vsi") or "://" in text else value


# -- paths -----------------------------------------------------------------------------------------------------------


def check_paths(files: Mapping[str, Path], request: Request, overwrite: bool = False) -> None:
    """Refuse outputs that overwrite an input, follow a link, or change the model of the source or of the ortho.

    Parameters
    ----------
    overwrite : bool
        Accept old sidecars of the ortho, which the caller removes (`old_side_cars`).

    Raises
    ------
    InputError
        With the path in conflict.
    """
    removed = old_side_cars(files["ortho"]) if overwrite and "ortho" in files else []
    refuse_read((*map(allowed, files.values()), *removed), [path for _, path in request.files])
    folder = next(iter(files.values())).parent
    attaching = any(str(path).endswith(SIDE_CARS) for path in files.values())
    if attaching and folder.resolve() == Path(request.image).resolve().parent:
        raise InputError(
            "RPC files in this folder would attach to the source image and change its model",
            file=folder,
            field="folder",
            remedy="choose a different output folder",
        )
    if "tag" in files:
        # GDAL prefers DigitalGlobe's XML next to an image to the tag in it.
        stale = files["tag"].with_suffix(".xml")
        if stale.exists() and stale not in files.values():
            raise InputError(
                "this RPC file would override the tag of the copy",
                file=stale,
                field="folder",
                remedy="remove it, export rpc-xml too, or choose another output folder",
            )
    if "ortho" in files and not overwrite:
        # Statistics, overviews and masks go with an ortho that is replaced; a model is nothing that an ortho has.
        for stale in old_side_cars(files["ortho"]):
            if stale.name.endswith(SIDE_CARS) or not files["ortho"].exists():
                raise InputError(
                    "GDAL would attach this old sidecar file to the ortho",
                    file=stale,
                    remedy=Text("delete it, use ", Setting("overwrite"), ", or choose another output folder"),
                )


def refuse_read(outputs: Iterable[Path], read: Iterable[str | os.PathLike[str]]) -> None:
    """Refuse outputs that overwrite a file that the work began with, such as a camera next to its image.

    Raises
    ------
    InputError
        With the path in conflict.
    """
    inputs = {Path(path).resolve() for path in read}
    for path in outputs:
        if path.resolve() in inputs:
            raise InputError(
                "this file is both input and output", file=path, field="folder", remedy="choose another output folder"
            )


def old_side_cars(ortho: Path) -> list[Path]:
    """Return the files next to an ortho that GDAL would attach to it: models, statistics, overviews, masks."""
    names = [ortho.stem + ending for ending in SIDE_CARS] + [ortho.name + ending for ending in ATTACHED]
    return [path for path in (ortho.with_name(name) for name in names) if path.is_file() or path.is_symlink()]
