"""The options that several commands share, made from `options`; each group arrives as one object of that module."""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any

import click

from ortho_pipeline.cli.flags import FLAGS, with_flags
from ortho_pipeline.cli.parsing import Megabytes, OneOrTwo, Shard
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options import (
    EXECUTORS,
    GROUPS,
    BlockOptions,
    MatchOptions,
    MosaicOptions,
    Option,
    OutputOptions,
    PointOptions,
    SceneOptions,
    StackOptions,
    SurfaceOptions,
    options_of,
)

Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def json_option(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--json``, and remember it for errors."""

    def remember(ctx: click.Context, _: click.Parameter, value: bool) -> bool:
        ctx.meta["json"] = value
        return value

    return click.option(
        "--json", "as_json", is_flag=True, callback=remember, is_eager=True, help="Print one JSON document on stdout."
    )(command)


class _Nodata(click.ParamType):  # type: ignore[type-arg]
    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        """Return the number, or 'nan', which JSON has not."""
        try:
            number = float(value)
        except ValueError:
            self.fail(f"{value!r} is not a number (or nan).", param, ctx)
        if math.isinf(number):
            self.fail("nodata cannot be infinite.", param, ctx)
        return "nan" if math.isnan(number) else number


# -- options of click ------------------------------------------------------------------------------------------------


def click_options(group: str, options: type, *names: str) -> Decorator:
    """Return the decorator that adds click options for fields of a group.

    Parameters
    ----------
    group : str
        Name of the group; the values arrive as ``{group}_{field}``.
    options : type
        Its class, one of `ortho_pipeline.options`.
    names : str
        The fields, in the order of ``--help``; all without.
    """
    defaults = {field.name: field.default for field in fields(options)}
    known = options_of(options)

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        for name in reversed(names or tuple(known)):
            option = known[name]
            settings = {**_said(option, defaults[name]), "help": _help(option)}
            command = click.option(*option.flags.split(), f"{group}_{name}", **settings)(command)
        return command

    return decorate


def grouped_options(grouped: Mapping[str, Any], *groups: str) -> dict[str, Any]:
    """Return the values of `click_options` as objects of their groups."""
    options: dict[str, Any] = {}
    for group in groups:
        values = {key.removeprefix(f"{group}_"): value for key, value in grouped.items() if key.startswith(f"{group}_")}
        # click gives an empty tuple for an option that was not given.
        options[group] = GROUPS[group](**{key: value for key, value in values.items() if value != ()})
    return options


def _help(option: Option) -> str | None:
    text = with_flags(option.help, FLAGS)
    if option.kind in ("integers", "files", "folders", "keys"):
        text = f"{text} May be repeated."
    if option.unset:
        text = f"{text}  [default: {option.unset}]"
    return text or None


def _said(option: Option, default: Any) -> dict[str, Any]:
    """Return the arguments of `click.option` for an option, without names and help."""
    if default is False:
        return {"is_flag": True}
    settings: dict[str, Any] = {"metavar": option.metavar, **_typed(option)}
    if default is MISSING and not settings.get("multiple"):
        settings["required"] = True
    elif isinstance(default, int | float | str):
        shown = int(default) // 1_000_000 if option.kind == "bytes" else default
        settings |= {"default": shown, "show_default": True}
    return settings


def _typed(option: Option) -> dict[str, Any]:
    """Return the arguments of `click.option` that parse the value."""
    if option.choices:
        return {"type": click.Choice(option.choices, case_sensitive=option.metavar is None)}
    number: Any = float
    if option.above is not None:
        number = click.FloatRange(option.above, option.below, min_open=True, max_open=option.below is not None)
    low, high = (None if bound is None else int(bound) for bound in (option.above, option.below))
    integer = click.IntRange(min=low if low is None else low + 1, max=high if high is None else high - 1)
    return {
        "file": {"type": click.Path(dir_okay=False)},
        "number": {"type": number},
        "integer": {"type": integer},
        "integers": {"type": _Integers(integer), "callback": _joined, "multiple": True},
        "pair": {"callback": _pair},
        "box": {"type": float, "nargs": 4},
        "one or two": {"type": OneOrTwo()},
        "number or nan": {"type": _Nodata()},
        "bytes": {"type": Megabytes()},
        "files": {"callback": _files, "multiple": True},
        "folders": {"type": click.Path(exists=True, file_okay=False), "multiple": True},
        "keys": {"callback": _keys, "multiple": True},
    }.get(option.kind, {})


class _Integers(click.ParamType):  # type: ignore[type-arg]
    """Whole numbers with commas between, each within the range of a type."""

    name = "integers"

    def __init__(self, each: click.ParamType) -> None:  # type: ignore[type-arg]
        self._each = each

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        return tuple(self._each.convert(part.strip(), param, ctx) for part in str(value).split(","))


def _joined(_: click.Context, __: click.Parameter, groups: Sequence[Sequence[int]]) -> tuple[int, ...]:
    return tuple(number for group in groups for number in group)


def _pair(_: click.Context, option: click.Parameter, text: str | None) -> tuple[float, float] | None:
    return None if text is None else _numbers(text, str(option.metavar))


def _numbers(text: str, form: str) -> tuple[float, float]:
    try:
        column, row = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not {form}") from None
    return column, row


def _files(_: click.Context, __: click.Parameter, texts: Sequence[str]) -> tuple[str, ...]:
    """Return the files that are named, several with commas between; a file whose own name has commas is one."""
    return tuple(name for text in texts for name in ([text] if os.path.exists(text) else text.split(",")) if name)


def _keys(_: click.Context, __: click.Parameter, texts: Sequence[str]) -> dict[str, str]:
    values: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals or not key:
            raise click.BadParameter(f"{text!r} is not KEY=VALUE")
        if key in values:
            raise click.BadParameter(f"the key {key!r} is given twice")
        values[key] = value
    return values


def _grouped(group: str, options: type, *names: str) -> Decorator:
    """Add the options of a group to a command and hand them to it as one object, the argument of the group's name."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def wrapper(**arguments: Any) -> Any:
            values = {key.removeprefix(prefix): arguments.pop(key) for key in list(arguments) if key.startswith(prefix)}
            # Without values, click passes an empty tuple, which means the default.
            return command(
                **arguments, **{group: options(**{key: value for key, value in values.items() if value != ()})}
            )

        return click_options(group, options, *names)(wrapper)

    prefix = f"{group}_"
    return decorate


def _of_each(*names: str) -> Decorator:
    """Add the options of scenes to a command with `images`; it gets common options, or a list with one for each."""

    def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(command)
        def chosen(*, rpcs: Sequence[str], offsets: Sequence[str], scene: SceneOptions, **arguments: Any) -> Any:
            return command(scene=_scenes(arguments["images"], scene, rpcs, offsets), **arguments)

        @functools.wraps(command)
        def wrapper(*, scene_rpc: Sequence[str], scene_crop_offset: Sequence[str], **arguments: Any) -> Any:
            return grouped(rpcs=scene_rpc, offsets=scene_crop_offset, **arguments)

        grouped = _grouped("scene", SceneOptions, *names)(chosen)
        decorated: Callable[..., Any] = wrapper
        for field, metavar, text in (
            ("crop_offset", "IMAGE=COL,ROW", _OFFSET_OF_EACH),
            ("rpc", "tag|sidecar|IMAGE=FILE", _RPC_OF_EACH),
        ):
            flag = options_of(SceneOptions)[field].flags
            decorated = click.option(flag, f"scene_{field}", multiple=True, metavar=metavar, help=text)(decorated)
        return decorated

    return decorate


def _scenes(
    images: Sequence[str], scene: SceneOptions, rpcs: Sequence[str], offsets: Sequence[str]
) -> SceneOptions | list[SceneOptions]:
    """Return common options, or a list with one for each image."""
    if not rpcs and not offsets:
        return scene
    from ortho_pipeline.commands.block_images import image_named

    scenes = [scene] * len(images)
    for field, texts in (("rpc", rpcs), ("crop_offset", offsets)):
        for text in texts:
            name, equals, value = text.partition("=")
            if len(images) == 1 and (not equals or os.path.exists(text)):
                name, value = images[0], text
            elif field == "rpc" and text in ("tag", "sidecar"):
                scenes = [replace(options, rpc=text) for options in scenes]
                continue
            elif not equals:
                raise InputError(
                    f"{text} does not name its image",
                    field=f"scene.{field}",
                    remedy=Text("name the image: ", Setting(f"scene.{field}", f"{Path(images[0]).name}={text}")),
                )
            number = image_named(name, images, f"scene.{field}")
            changed: dict[str, Any] = {field: value if field == "rpc" else _numbers(value, "COL,ROW")}
            scenes[number] = replace(scenes[number], **changed)
    return scenes


_OF_IMAGES = ("sensor", "sensor_options", "ortho", "allow_network", "roots")
_RPC_OF_EACH = "Which RPC to use: 'tag' or 'sidecar' for all images, or a file for one. May be repeated."
_OFFSET_OF_EACH = "If an image is a crop: position of its first pixel in the full image. May be repeated."
#: All options of a scene, as `SceneOptions`.
scene_options = _grouped("scene", SceneOptions)
#: The same for the images of a block, without a saved model, which belongs to one image.
sensor_options = _of_each(*_OF_IMAGES)
#: The same for one image or several.
scenes_options = _of_each(*_OF_IMAGES, "model")
#: All options of points in one image, as `PointOptions`.
point_options = _grouped("points", PointOptions)
block_options = _grouped("points", BlockOptions, "points", "gcps", "crs", "vertical", "pixel_origin", "check", "model")
#: The rest of that group, which is taken by its decorator too.
adjustment_options = click_options(
    "points",
    BlockOptions,
    "ties",
    "correction",
    "ground_sigma",
    "model_crs",
    "hold",
    "dem_heights",
    "dem_bias",
    "dem_correlation",
    "dem_shift",
    "dem_shift_sigma",
    "spot_heights",
    "spot_crs",
    "spot_vertical",
    "join_limit",
)
#: All options of heights, as `SurfaceOptions`.
surface_options = _grouped("surface", SurfaceOptions)
#: All options of matching with a reference, as `MatchOptions`.
match_options = _grouped("match", MatchOptions)
matching_options = _grouped(
    "match", MatchOptions, "reference", "reference_bands", "search", "search_rotation", "points", "reference_sigma"
)
reference_options = _grouped("match", MatchOptions, "reference", "reference_bands", "search")
tie_options = _grouped("match", MatchOptions, "search", "points")
dem_datum_options = _grouped("surface", SurfaceOptions, "vertical", "override_vertical")
network_option = _grouped("scene", SceneOptions, "allow_network")
tested_options = _grouped("scene", SceneOptions, "sensor_options")
#: All options of the ortho, as `OutputOptions`.
output_options = _grouped("output", OutputOptions)
#: The options of the orthos of a block.
block_output_options = _grouped(
    "output",
    OutputOptions,
    "crs",
    "resolution",
    "extent",
    "like",
    "resampling",
    "bands",
    "nodata",
    "visibility",
    "format",
    "creation_options",
    "memory",
    "threads",
)
#: The suffix of the file sets the format, and seams are always measured.
mosaic_options = _grouped("mosaic", MosaicOptions, "order", "seamlines", "balance")
stack_options = _grouped("stack", StackOptions)

dry_run_option = click.option("--dry-run", is_flag=True, help="Check all inputs and show the plan; write nothing.")
#: The argument IMAGE.
image_argument = click.argument("image", type=click.Path())
#: One or several images.
images_argument = click.argument("images", metavar="IMAGE...", nargs=-1, required=True, type=click.Path())


def _folder(_: click.Context, __: click.Parameter, text: str) -> str:
    """Return the name of a folder; refuse the name of a raster, which is a mistake."""
    stem, ending = os.path.splitext(text)
    if ending.lower() in (".tif", ".tiff", ".vrt", ".jp2") and not os.path.isdir(text):
        raise click.BadParameter(
            f"Outputs need a folder, but {text!r} is the name of a file; did you mean '-o {stem}'?"
        )
    return text


def optional_folder(text: str) -> Decorator:
    """Return the option of a folder that a command writes only if it is given."""
    return click.option("--output", "-o", "folder", type=click.Path(file_okay=False), metavar="DIR", help=text)


#: The option ``-o DIR``, which is required.
folder_option = click.option(
    "--output",
    "-o",
    "folder",
    type=click.Path(file_okay=False),
    required=True,
    metavar="DIR",
    callback=_folder,
    help="Output folder.",
)


def executor_option(text: str) -> Decorator:
    """Return the option of who does the work."""
    return click.option("--executor", type=click.Choice(EXECUTORS), help=text)


def workers_option(unset: str) -> Decorator:
    """Return the option of how many processes work."""
    text = f"Number of processes.  [default: {unset}]"
    return click.option("--workers", type=click.IntRange(min=1), metavar="N", help=text)


scheduler_option = click.option(
    "--scheduler", metavar="URL", help="Address of the dask scheduler, such as tcp://host:8786."
)


def shard_option(text: str) -> Decorator:
    """Return the option of a worker that does only a part of the work."""
    where = "auto: read both from the environment of AWS Batch, Kubernetes or Slurm."
    return click.option("--shard", type=Shard(), metavar="K/N|auto", help=f"{text} {where}")
