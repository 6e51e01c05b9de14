"""Arguments of a command, with files instead of STAC items; remote files are requested at once."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, ParamSpec, TypeVar, cast

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import read_bounded
from ortho_pipeline.files.locations import Location
from ortho_pipeline.options import GROUPS, MatchOptions, OutputOptions, PointOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.points import Points
from ortho_pipeline.stores.sidecars import ask_beside
from ortho_pipeline.stores.stac.item import Asset, Item, item_at, read_item

_P = ParamSpec("_P")
_R = TypeVar("_R")
_IMAGE, _IMAGES, _DEM = "image", "images", "dem"
#: A table of points is no larger.
_TABLE_BYTES = 50_000_000


def with_items(command: Callable[_P, _R]) -> Callable[_P, _R]:
    """Let a command accept STAC items as images, DEMs, references and points.

    The command has a parameter `image` or `images`, and options. An RPC that is an asset of its own becomes the option
    `scene.rpc`, unless another model is given. Files on other machines are asked for together.
    """
    signature = inspect.signature(command)

    @functools.wraps(command)
    def wrapper(*args: _P.args, **named: _P.kwargs) -> _R:
        bound = signature.bind(*args, **named)
        bound.apply_defaults()
        arguments = bound.arguments
        _refuse_plain(arguments, signature)
        place = next((name for name, value in arguments.items() if isinstance(value, SceneOptions)), None)
        scene = _of_first(arguments) if place is None else cast(SceneOptions, arguments[place])
        for name, value in arguments.items():
            if name == _IMAGE:
                arguments[name], scene = resolved(value, scene)
            elif name == _IMAGES:
                arguments[name] = [_one_of_several(image, scene) for image in value]
            elif name == _DEM and not isinstance(value, SurfaceOptions | None):
                arguments[name] = heights_given(value, scene)
            else:
                arguments[name] = _in_options(value, scene)
        if place is not None:
            arguments[place] = scene
        if scene.allow_network:
            ask_beside(*_far(arguments), allow_network=True)
        return command(*bound.args, **bound.kwargs)

    return wrapper


def _refuse_plain(arguments: Mapping[str, Any], signature: inspect.Signature) -> None:
    """Refuse anything else in place of options, such as a path or a mapping."""
    for group, kind in GROUPS.items():
        parameter = signature.parameters.get(group)
        # `output` of some commands is a file, and some take a list of options.
        if parameter is None or kind.__name__ not in str(parameter):
            continue
        value = arguments[group]
        if value is parameter.default or isinstance(value, kind | Points | list | tuple):
            continue
        text = f"**{value!r}" if isinstance(value, Mapping) else ""
        if isinstance(value, str | os.PathLike):
            file: Any = os.fspath(value)
            text = f"{fields(kind)[0].name}={[file] if group == 'match' else file!r}"
        remedy = f"give op.{kind.__name__}({text})"
        raise InputError(f"a {type(value).__name__} is not {kind.__name__}", field=group, remedy=remedy)


def _of_first(arguments: dict[str, Any]) -> SceneOptions:
    """Return how the first image is opened, where there are options for each: their permissions are the same."""
    lists = (value for value in arguments.values() if isinstance(value, list | tuple) and value)
    return next((value[0] for value in lists if isinstance(value[0], SceneOptions)), SceneOptions())


def resolved(image: Any, scene: SceneOptions) -> tuple[Any, SceneOptions]:
    """Return the image that a STAC item stands for, and the options with its RPC; anything else as it is.

    Raises
    ------
    InputError
        If it is no item, or its asset is not known.
    """
    place = _item_at(image)
    if place is None:
        return image, scene
    item, chosen = _chosen(place, scene)
    if scene.rpc is not None or scene.model is not None or "rpc" in scene.sensor_options:
        return chosen.href, scene
    rpc = item.rpc_of(chosen)
    return chosen.href, scene if rpc is None else replace(scene, rpc=rpc.href)


def heights_given(dem: str | os.PathLike[str], scene: SceneOptions) -> Location:
    """Return where heights are: of a STAC item its raster; a collection, and anything else, as it is.

    Raises
    ------
    InputError
        If its asset is not known.
    """
    place = Location(dem)
    if not place.is_item:
        return place
    item = item_at(place.document, allow_network=scene.allow_network, roots=tuple(scene.roots))
    return place if item is None else Location(item.heights(place.asset).href)


def _item_at(value: Any) -> Location | None:
    """Return the location that a value names, if it may be a STAC item."""
    place = Location(value) if isinstance(value, str | os.PathLike) else None
    return place if place is not None and place.is_item else None


def _chosen(place: Location, scene: SceneOptions) -> tuple[Item, Asset]:
    item = read_item(place.document, allow_network=scene.allow_network, roots=tuple(scene.roots))
    return item, item.image(place.asset)


def _one_of_several(image: Any, scene: SceneOptions) -> Any:
    place = _item_at(image)
    if place is None:
        return image
    item, chosen = _chosen(place, scene)
    rpc = item.rpc_of(chosen)
    if rpc is not None:
        raise InputError(
            f"the RPC of this image is not next to it ({rpc.name}), and no option gives an RPC for several images",
            file=image,
            remedy="put it next to the image, with the same stem",
        )
    return chosen.href


def _in_options(value: Any, scene: SceneOptions) -> Any:
    """Return options with the files in place of items; points that are read already become options."""

    def raster(path: Any) -> Any:
        place = _item_at(path)
        return path if place is None else _chosen(place, scene)[1].href

    if isinstance(value, SurfaceOptions):
        dem = None if value.dem is None else heights_given(value.dem, scene)
        return replace(value, dem=dem, sigma=raster(value.sigma))
    if isinstance(value, MatchOptions):
        return replace(value, reference=tuple(map(raster, value.reference)))
    if isinstance(value, OutputOptions):
        return replace(value, fill_from=raster(value.fill_from), like=raster(value.like))
    if isinstance(value, Points):
        return PointOptions(gcps=value)
    if isinstance(value, PointOptions) and (table := _item_at(value.gcps)) is not None:
        return replace(value, gcps=_points(table, scene))
    return value


def _points(place: Location, scene: SceneOptions) -> str:
    """Return the table of an item; a GeoJSON file that is no item is a table itself."""
    file, key = place.document, place.asset
    if not key and not file.is_far and b'"stac_version"' not in read_bounded(file, _TABLE_BYTES):
        return place
    try:
        item = read_item(file, allow_network=scene.allow_network, roots=tuple(scene.roots))
    except InputError:
        if key:
            raise
        return place
    return item.table(key).href


def _far(arguments: dict[str, Any]) -> list[Any]:
    """Return the files on other machines that a command is about to open."""
    images = [arguments.get(_IMAGE), *(arguments.get(_IMAGES) or ())]
    for value in arguments.values():
        if isinstance(value, SurfaceOptions):
            images.append(None if value.dem is None or Location(value.dem).is_collection else value.dem)
        elif isinstance(value, MatchOptions):
            images += value.reference
        elif isinstance(value, OutputOptions):
            images += value.files.values()
    return [path for path in images if isinstance(path, str | os.PathLike) and Location(path).is_far]
