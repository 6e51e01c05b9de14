"""An image as a scene, and the paths that a command may write."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ortho_pipeline import host
from ortho_pipeline.commands.orthos.opening import open_ortho
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange import crop
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.files import allowed
from ortho_pipeline.files.locations import located
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SceneOptions
from ortho_pipeline.options.texts import Setting, Text
from ortho_pipeline.raster import source as raster

#: Side-cars that GDAL would attach to an image of this stem, whatever the image itself says.
SIDE_CARS = ("_RPC.TXT", "_rpc.txt", ".RPB", ".rpb", "_metadata.txt", ".IMD")
#: The same, after the whole name of the image.
ATTACHED = (".aux.xml", ".ovr", ".msk")
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
            raise InputError("this scene is open already", file=image, field="scene", remedy="give its path")
        return image
    if options.ortho:
        return open_ortho(image, options, only=False)
    if options.model is None:
        given: dict[str, Any] = dict(options.sensor_options)
        if options.rpc is not None:
            if "rpc" in given:
                raise InputError("the RPC is chosen twice", field="scene.rpc",
                                 remedy=Text("leave out ", Setting("scene.sensor_options", "...", "rpc")))  # fmt: skip
            given["rpc"] = options.rpc
        given = {name: _perhaps_elsewhere(value, options.allow_network) for name, value in given.items()}
        return host.open_scene(image, options.sensor, given, crop_offset=options.crop_offset, **options.access)
    if options.rpc is not None or options.sensor is not None or options.sensor_options:
        raise InputError(
            "a model file takes the place of the image's model", field="scene.model",
            remedy=Text(
                "leave out ", Setting("scene.rpc"), ", ", Setting("scene.sensor"), " and ",
                Setting("scene.sensor_options")
            ),
        )  # fmt: skip
    dataset = raster.open_dataset(image, **options.access)
    host.Host.discover()  # model families of plugins, which the file may name
    saved = read_model_file(located(options.model, allow_network=options.allow_network))
    size = dataset.RasterXSize, dataset.RasterYSize
    offset = options.crop_offset
    if offset is None and saved.size != size:
        offset = crop.noted_offset(dataset)
    if saved.size is not None and not crop.fits(size, saved.size, offset):
        raise InputError(
            f"this model is of an image of {saved.size[0]} x {saved.size[1]} pixels, {Path(image).name} has "
            f"{size[0]} x {size[1]}",
            file=options.model,
            field="size",
            remedy=Text(
                "give the model file of this image, or ",
                Setting("scene.crop_offset", "COL,ROW"),
                " if it is a crop of that one",
            ),
        )
    scene = Scene(
        sensor=saved.sensor or "model file", path=image, width=size[0], height=size[1],
        models={saved.model.kind: saved.model}, model_source=str(options.model),
        facts={"delivered_model_source": saved.model_source} if saved.model_source else {},
        adjusted=saved.adjusted,
    )  # fmt: skip
    return scene if offset is None else crop.placed(scene, dataset, offset)


def open_image(image: str | os.PathLike[str], options: SceneOptions, *, needs_model: bool) -> Scene:
    """Open an image whose own model is only wanted if there is one.

    Parameters
    ----------
    needs_model : bool
        Whether an image without a model of its own is an error.

    Returns
    -------
    Scene
        Without models and of the sensor "points only" where no sensor recognises the image.
    """
    asked = isinstance(image, Scene) or bool(
        options.model or options.rpc or options.sensor or options.sensor_options or options.ortho
    )
    if needs_model or asked:
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
    """Return a file of an archive or of the network as one that can be read; any other value as it is."""
    text = str(value)
    return located(text, allow_network=allow_network) if text.startswith("/vsi") or "://" in text else value


# -- paths -----------------------------------------------------------------------------------------------------------


def check_paths(files: Mapping[str, Path], request: Request, overwrite: bool = False) -> None:
    """Refuse to write what is read or through a link, and what changes the model of the source or of the ortho.

    Parameters
    ----------
    overwrite : bool
        Accept old side-cars of the ortho, which the caller removes (`old_side_cars`).

    Raises
    ------
    InputError
        With the path that is in the way.
    """
    inputs = {Path(path).resolve() for _, path in request.files}
    removed = old_side_cars(files["ortho"]) if overwrite and "ortho" in files else []
    for path in (*map(allowed, files.values()), *removed):
        if path.resolve() in inputs:
            raise InputError(
                "this path would be read and written", file=path, field="folder", remedy="choose another output folder"
            )
    folder = next(iter(files.values())).parent
    attaching = any(str(path).endswith(SIDE_CARS) for path in files.values())
    if attaching and folder.resolve() == Path(request.image).resolve().parent:
        raise InputError(
            "the RPC files written here would attach to the source image and change its model", file=folder,
            field="folder", remedy="choose an output folder of its own",
        )  # fmt: skip
    if "ortho" in files and not overwrite:
        # Statistics, overviews and masks go with an ortho that is replaced; a model is nothing that an ortho has.
        for stale in old_side_cars(files["ortho"]):
            if stale.name.endswith(SIDE_CARS) or not files["ortho"].exists():
                raise InputError(
                    "an old side-car lies here that GDAL would attach to the ortho", file=stale,
                    remedy=Text("remove it (", Setting("overwrite"), " does), or choose another output folder"),
                )  # fmt: skip


def old_side_cars(ortho: Path) -> list[Path]:
    """Return the files beside an ortho that GDAL would attach to it: models, statistics, overviews, masks."""
    names = [ortho.stem + ending for ending in SIDE_CARS] + [ortho.name + ending for ending in ATTACHED]
    return [path for path in (ortho.with_name(name) for name in names) if path.is_file() or path.is_symlink()]
