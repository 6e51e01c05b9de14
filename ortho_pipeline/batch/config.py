"""The file of `ortho run`: what it may hold, and how it is read.

The groups ``scene``, ``points``, ``surface``, ``match`` and ``output`` are made from `options`, field by field; the
budget of the machine (memory, threads, workers) is not a part of the file, because no result depends on it.
"""

from __future__ import annotations

import dataclasses
import difflib
import os
import re
from collections.abc import Hashable, Mapping
from typing import Annotated, Any, Literal

import pydantic
import yaml
from pydantic import BaseModel, ConfigDict, Field

from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.files import read_bounded
from ortho_pipeline.files.shell import typed
from ortho_pipeline.options import (
    MatchOptions,
    MosaicOptions,
    Option,
    OutputOptions,
    PointOptions,
    SceneOptions,
    SurfaceOptions,
    is_usable,
    options_of,
)

_MAX_BYTES = 5_000_000
_MAX_DEPTH, _MAX_EVENTS = 20, 300_000
_SHOWN = 5
_SEE = "see docs/run.md for the form of the file"
#: A path of YAML keys and indices.
Place = tuple[Hashable, ...]
Scalar = str | int | float | bool

# -- what the file may hold ------------------------------------------------------------------------------------------


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _usable(number: float) -> float:
    if not is_usable(number):
        raise ValueError(f"{number:g} is not a usable number: too large, too small, or not finite")
    return number


def _type(option: Option) -> Any:
    """Return the type of an option in the file."""
    if option.choices:
        return Literal[tuple(option.choices)]
    bounds: dict[str, Any] = {"gt": option.above, "lt": option.below}
    bounded: Any = float if option.above is option.below is None else Annotated[float, Field(**bounds)]
    number: Any = Annotated[bounded, pydantic.AfterValidator(_usable)]
    low, high = (None if bound is None else int(bound) for bound in (option.above, option.below))
    within: dict[str, Any] = {"ge": low if low is None else low + 1, "le": high if high is None else high - 1}
    integer: Any = int if low is high is None else Annotated[int, Field(**within)]
    return {
        "text": str,
        "file": str,
        "number": number,
        "integers": Annotated[list[integer], Field(min_length=1)],
        "integer": integer,
        "files": str | list[str],
        "pair": Annotated[list[number], Field(min_length=2, max_length=2)],
        "box": Annotated[list[number], Field(min_length=4, max_length=4)],
        "one or two": number | Annotated[list[number], Field(min_length=2, max_length=2)],
        "number or word": str | number,
        "number or nan": number | Literal["nan"],
        "keys": dict[str, Scalar],
    }[option.kind]


def _settings(name: str, group: type) -> Any:
    """Return the schema of a group of options; what they mean and may be is stated in `options`."""
    types: dict[str, Any] = {}
    known = options_of(group)
    for field in dataclasses.fields(group):
        option = known[field.name]
        if not option.in_file:
            continue
        default: Any = {"keys": {}, "files": []}.get(option.kind, field.default)
        kind: Any = bool if isinstance(default, bool) else _type(option)
        described = Field(default=default, description=_described(option) or None)
        types[field.name] = (kind | None if default is None else kind, described)
    return pydantic.create_model(name, __base__=_Strict, __doc__=str(group.__doc__).partition("\n")[0], **types)


def _described(option: Option) -> str:
    """Return the description of an option in the schema: help, forms of its value, default."""
    forms = option.metavar if option.metavar and not option.choices and re.search(r"[| ]", option.metavar) else None
    unset = option.unset and f"Default: {option.unset}."
    return " ".join(part for part in (option.help, forms and f"Form: {forms}.", unset) if part)


SceneSettings = _settings("SceneSettings", SceneOptions)
PointSettings = _settings("PointSettings", PointOptions)
SurfaceSettings = _settings("SurfaceSettings", SurfaceOptions)
MatchSettings = _settings("MatchSettings", MatchOptions)
OutputSettings = _settings("OutputSettings", OutputOptions)


class Settings(_Strict):
    """All settings of a scene."""

    scene: SceneSettings = SceneSettings()  # type: ignore[valid-type]
    points: PointSettings = PointSettings()  # type: ignore[valid-type]
    surface: SurfaceSettings = SurfaceSettings()  # type: ignore[valid-type]
    match: MatchSettings = MatchSettings()  # type: ignore[valid-type]
    output: OutputSettings = OutputSettings()  # type: ignore[valid-type]


class Entry(Settings):
    """One image, or all that match; a later entry for the same image overrides fields of earlier ones."""

    image: str | None = Field(default=None, description="One image file, without patterns.")
    images: str | list[str] | None = Field(default=None, description="Patterns of image files, with * ? [] and **.")
    exclude: str | list[str] = Field(default=[], description="Patterns of images to leave out.")
    name: str | None = Field(
        default=None, description="Name of the scene; may contain {stem} and {folder}. Default: {stem}."
    )

    @pydantic.model_validator(mode="after")
    def _one_way(self) -> Entry:
        if (self.image is None) == (self.images is None):
            raise ValueError("an entry needs either 'image' (one file) or 'images' (patterns)")
        return self


MosaicSettings = _settings("MosaicSettings", MosaicOptions)


class Config(_Strict):
    """The whole file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, title="Pipeline file of 'ortho run'")

    scenes: Annotated[list[Entry], Field(min_length=1)]
    output: str = Field(default="out", description="Output folder, relative to this file.")
    root: str | None = Field(
        default=None,
        description="Allow only paths inside this folder, relative to this file. It can only narrow the root of the "
        "command. Default: that root.",
    )
    defaults: Settings = Field(default=Settings(), description="Settings of all scenes.")
    mosaic: MosaicSettings | None = None  # type: ignore[valid-type]


def schema() -> dict[str, Any]:
    """Return the JSON Schema of the file."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}


def merged(*layers: Settings) -> Settings:
    """Return the settings of several layers; later layers override fields, and keys of options."""
    groups: dict[str, Any] = {}
    for layer in layers:
        for name in Settings.model_fields.keys() & layer.model_fields_set:
            value, before = getattr(layer, name), groups.get(name)
            if isinstance(value, BaseModel) and isinstance(before, BaseModel):
                stated = {field: getattr(value, field) for field in value.model_fields_set}
                for field, item in stated.items():
                    if isinstance(item, Mapping):
                        stated[field] = {**getattr(before, field), **item}
                value = before.model_copy(update=stated)
            groups[name] = value
    return Settings.model_construct(**groups)


# -- reading ---------------------------------------------------------------------------------------------------------


@reads("see docs/run.md for the form of the file")
def read_config(path: str | os.PathLike[str], content: bytes | None = None) -> Config:
    """Read a pipeline file.

    Parameters
    ----------
    content : bytes, optional
        Its bytes, if they were read already (`read_content`).

    Raises
    ------
    InputError
        For anything that is not as the schema has it: the message names line, field and remedy.
    """
    document, lines = _parse(read_content(path) if content is None else content, path)
    try:
        return Config.model_validate(document)
    except pydantic.ValidationError as error:
        raise _explained(error, lines, path) from error


def read_content(path: str | os.PathLike[str]) -> bytes:
    """Return the bytes of a pipeline file.

    Raises
    ------
    InputError
        If it is a folder, cannot be read, or is too large.
    """
    if os.path.isdir(path):
        raise InputError(
            "this is a folder, not a pipeline file",
            file=path,
            remedy=f"give its pipeline file, or write one with `ortho init {typed(path)}`",
        )
    content = read_bounded(path, _MAX_BYTES, remedy="check the path")
    if len(content) > _MAX_BYTES:
        raise InputError("the pipeline file is larger than 5 MB", file=path, remedy="name images by patterns")
    return content


_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):
    """Scalars as in YAML 1.2: 'no' is not false, 1:30 is not 90, and there are no dates."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


for _kind, _pattern, _first in (
    ("null", r"|~|null|Null|NULL", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_kind}", re.compile(f"^(?:{_pattern})$"), _first)


def _parse(content: bytes, path: str | os.PathLike[str]) -> tuple[Any, dict[Place, int]]:
    """Return the document and the line of each of its places."""
    try:
        _check_events(content, path)
        node = yaml.compose(content, _Loader)
    except (yaml.YAMLError, ValueError) as error:
        mark = getattr(error, "problem_mark", None)
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        # A pattern such as */a.tif without quotes is an alias to YAML.
        remedy = "quote text that begins with *" if "alphabetic" in problem else _SEE
        field = None if mark is None else f"line {mark.line + 1}"
        raise InputError(f"this is not YAML ({problem})", file=path, field=field, remedy=remedy) from error
    if node is None:
        raise InputError("the file is empty", file=path, remedy=_SEE)
    reader = _Reader(path)
    return reader.value(node, ()), reader.lines


def _check_events(content: bytes, path: str | os.PathLike[str]) -> None:
    """Refuse aliases and deep nesting before nodes are made: the C parser's recursion would end the process."""
    depth = 0
    for count, event in enumerate(yaml.parse(content, _Loader)):
        if count > _MAX_EVENTS:
            raise InputError("too many entries", file=path, remedy="name images by patterns")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        line = f"line {event.start_mark.line + 1}" if event.start_mark else None
        if depth > _MAX_DEPTH:
            raise InputError(f"more than {_MAX_DEPTH} nested levels", file=path, field=line)
        if isinstance(event, yaml.AliasEvent):
            remedy = "put common settings under 'defaults'"
            raise InputError("YAML aliases are not supported", file=path, field=line, remedy=remedy)


class _Reader:
    """Turns YAML nodes into plain values; duplicate keys and tags are errors."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path
        self.lines: dict[Place, int] = {}

    def value(self, node: Any, place: Place) -> Any:
        """Return the value of a node at `place`."""
        self.lines.setdefault(place, node.start_mark.line + 1)
        kind = node.tag.removeprefix("tag:yaml.org,2002:")
        if isinstance(node, yaml.MappingNode) and kind == "map":
            return self._mapping(node, place)
        if isinstance(node, yaml.SequenceNode) and kind == "seq":
            return [self.value(item, (*place, i)) for i, item in enumerate(node.value)]
        if kind not in ("str", "int", "float", "bool", "null"):
            raise self._error(node, place, f"unknown YAML tag {node.tag!r}", "leave it out")
        return self._scalar(node, place, kind)

    def _mapping(self, node: Any, place: Place) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for key, item in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else None
            if name is None:
                raise self._error(key, place, "this key is not a word", _SEE)
            here = (*place, name)
            if name in values:
                before = self.lines[here]
                raise self._error(key, here, f"duplicate key, already in line {before}", "leave one out")
            self.lines[here] = key.start_mark.line + 1
            values[name] = self.value(item, here)
        return values

    def _scalar(self, node: Any, place: Place, kind: str) -> Any:
        text = node.value
        if kind == "null":
            return None
        if kind == "bool":
            return text.lower() == "true"
        try:
            if kind == "int":
                return int(text)
            return float(text.replace(".inf", "inf").replace(".nan", "nan")) if kind == "float" else text
        except ValueError as error:
            raise self._error(node, place, f"{text[:20]!r} is not a number ({kind})", "correct it") from error

    def _error(self, node: Any, place: Place, message: str, remedy: str) -> InputError:
        field = f"line {node.start_mark.line + 1}" + (f", {dotted(place)}" if place else "")
        return InputError(message, file=self.path, field=field, remedy=remedy)


def dotted(place: Place) -> str:
    """Return a place as people write it: ``scenes[0].points.gcps``."""
    text = ""
    for part in place:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _explained(error: pydantic.ValidationError, lines: Mapping[Place, int], path: Any) -> InputError:
    """Return an error of the schema in terms of the file."""
    faults: list[tuple[str, str, str]] = []
    for fault in error.errors():
        # In a union pydantic adds the member that it tried, which is not in the file.
        place: Place = tuple(fault["loc"])
        known = place
        while known and known not in lines:
            known = known[:-1]
        if fault["type"] == "missing":
            known, message = place, "missing field"
        else:
            message = fault["msg"].removeprefix("Value error, ")
        remedy = _SEE
        if fault["type"] == "extra_forbidden":
            message, remedy = "unknown field", _allowed(place)
        elif place == ("output",):
            message, remedy = (
                "this is no folder",
                "at the top, 'output' is a folder; the properties of orthos belong in 'output' of 'defaults'",
            )
        line = lines.get(known, lines.get(known[:-1], 1))
        faults.append((f"line {line}" + (f", {dotted(known)}" if known else ""), message, remedy))
    faults = list(dict.fromkeys(faults))
    field, message, _ = faults[0]
    rest = [f"{where}: {what}" for where, what, _ in faults[1:_SHOWN]]
    remedy = "; ".join(dict.fromkeys(remedy for _, _, remedy in faults[:_SHOWN]))
    if len(faults) > _SHOWN:
        rest.append(f"and {len(faults) - _SHOWN} more")
    return InputError("; ".join([message, *rest]), file=path, field=field, remedy=remedy)


def _allowed(place: Place) -> str:
    """Return where an unknown key belongs, or the most similar key, or all that are allowed in its place."""
    groups: dict[str, Any] = {
        "scene": SceneSettings,
        "points": PointSettings,
        "surface": SurfaceSettings,
        "match": MatchSettings,
        "output": OutputSettings,
    }
    model: Any = Config
    for part in place[:-1]:
        if isinstance(part, str):
            model = {"scenes": Entry, "defaults": Settings, "mosaic": MosaicSettings, **groups}.get(part, model)
    name, names = str(place[-1]), list(model.model_fields)
    inside = "" if len(place) > 1 else " of 'defaults' or of a scene"
    if inside and name in groups:
        return f"{name!r} belongs in 'defaults' or in a scene"
    if homes := [repr(group) for group, fields in groups.items() if name in fields.model_fields]:
        return f"{name!r} belongs in {' or '.join(homes)}{inside}"
    close = difflib.get_close_matches(name, names, 1)
    return f"did you mean {close[0]!r} instead of {name!r}?" if close else f"use one of {', '.join(names)}"
