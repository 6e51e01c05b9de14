"""The file of `ortho run`: what it may hold, and how it is read.

The groups ``scene``, ``points``, ``surface`` and ``output`` are those of `options`, field by field; the budget of the
machine (memory, threads, workers) is no part of the file, because no result depends on it.
"""

from __future__ import annotations

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

_MAX_BYTES = 5_000_000
_MAX_DEPTH, _MAX_EVENTS = 20, 300_000
_SHOWN = 5
_SEE = "see docs/run.md for the form of the file"
#: A path of YAML keys and indices.
Place = tuple[Hashable, ...]
Scalar = str | int | float | bool
_Positive = Annotated[float, Field(gt=0)]

# -- what the file may hold ------------------------------------------------------------------------------------------


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


class SceneSettings(_Strict):
    """How an image is opened."""

    sensor: str | None = Field(
        default=None, description="Name of the sensor, where several or none recognise the image."
    )
    rpc: str | None = Field(default=None, description="'tag', 'sidecar' or an RPC file.")
    model: str | None = Field(default=None, description="A *_model.json in place of the image's own model.")
    sensor_options: dict[str, Scalar] = Field(
        default={}, description="Options that the sensor declares ('ortho sensors')."
    )
    crop_offset: Annotated[list[float], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="Column and row of the first pixel in the image of the model, for a crop of it."
    )


class PointSettings(_Strict):
    """Which points there are, and what is adjusted to them."""

    gcps: str | None = Field(default=None, description="A file of points, or 'own' for those in the image.")
    crs: str | None = Field(default=None, description="CRS of files that do not say.")
    vertical: str | None = Field(default=None, description="Height datum of files that do not say.")
    pixel_origin: Literal["corner", "center", "corner-1", "center-1"] = Field(
        default="corner", description="What CSV files call the first pixel: its corner or centre (0, 0), or (1, 1)."
    )
    check: str | None = Field(default=None, description="'every:N' or 'ids:A,B': points that check and do not control.")
    select: str | None = Field(default=None, description="'even:N', 'cluster:N', 'ids:A,B' or 'random:N:SEED'.")
    correction: Literal["none", "shift", "shift-drift", "affine", "model"] | None = Field(
        default=None, description="What is adjusted; shift if there are control points."
    )
    fit_model: str | None = Field(default=None, description="A model fitted to the points alone ('ortho models').")
    model_crs: str | None = Field(
        default=None, description="Ground of that model: geocentric, geographic, utm or EPSG:n."
    )
    prune: bool = Field(default=False, description="Remove parameters that the points do not justify.")
    params: str | None = Field(default=None, description="'A,B,C': the only parameters that are adjusted.")
    significance: float = Field(default=0.05, gt=0, lt=1, description="Chance of justifying a parameter that is zero.")
    ridge: str = Field(default="auto", description="Of a fitted model: auto, none, gcv, lcurve or a weight.")
    near: _Positive | None = Field(default=None, description="Distance (m) below which points are neighbours.")


class SurfaceSettings(_Strict):
    """Where heights come from."""

    dem: str | None = Field(default=None, description="Digital elevation model.")
    vertical: str | None = Field(
        default=None, description="Height datum of the DEM: ellipsoid, egm96, EPSG:n or a grid file."
    )
    override_vertical: bool = Field(
        default=False, description="Believe 'vertical' even where the DEM declares another datum."
    )
    fill: str | float = Field(default="error", description="Without a height: 'error', 'mask', 'nearest' or a height.")
    height: float | None = Field(default=None, description="One ellipsoidal height (m) in place of a DEM.")


class OutputSettings(_Strict):
    """What an ortho looks like."""

    crs: str | None = Field(default=None, description="Default: the UTM zone of the scene.")
    resolution: _Positive | Annotated[list[_Positive], Field(min_length=2, max_length=2)] | None = Field(
        default=None, description="One number or [x, y], in units of the CRS; default: that of the scene."
    )
    extent: Annotated[list[float], Field(min_length=4, max_length=4)] | None = Field(
        default=None, description="xmin, ymin, xmax, ymax; default: the footprint on whole multiples of the resolution."
    )
    align: bool = Field(default=False, description="Widen 'extent' to whole multiples of the resolution.")
    resampling: Literal["nearest", "bilinear", "cubic", "lanczos", "average"] = "bilinear"
    bands: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=1)] | None = Field(
        default=None, description="Which bands, from 1; default: all."
    )
    dtype: Literal["Byte", "UInt16", "Int16", "UInt32", "Int32", "Float32", "Float64"] | None = Field(
        default=None, description="Type of the pixels; default: that of the image."
    )
    nodata: float | Literal["nan"] | None = Field(
        default=None, description="Of pixels without an image; default: that of the image, or a mask."
    )
    dem_interpolation: Literal["bilinear", "cubic"] = "bilinear"
    format: Literal["COG", "GTiff"] = "COG"
    creation_options: dict[str, Scalar] = Field(default={}, description="Options of GDAL's driver.")
    engine: Literal["ortho", "gdal"] = "ortho"
    tolerance: _Positive = Field(default=0.01, description="Bound on the geometric error of the warp, source pixels.")
    stac: bool = Field(default=False, description="Write a STAC item of each ortho.")
    acquired: str | None = Field(
        default=None, description="Time of acquisition (RFC 3339) for it, where the metadata have none."
    )


class Settings(_Strict):
    """All that can be said of a scene."""

    scene: SceneSettings = SceneSettings()
    points: PointSettings = PointSettings()
    surface: SurfaceSettings = SurfaceSettings()
    output: OutputSettings = OutputSettings()


class Entry(Settings):
    """One image, or all that match; a later entry for the same image overrides fields of earlier ones."""

    image: str | None = Field(default=None, description="One image file, by its name as it is.")
    images: str | list[str] | None = Field(default=None, description="Patterns with * ? [] and **.")
    exclude: str | list[str] = Field(default=[], description="Patterns of images that are left out.")
    name: str | None = Field(
        default=None, description="Name of the scene; may hold {stem} and {folder}. Default: {stem}."
    )

    @pydantic.model_validator(mode="after")
    def _one_way(self) -> Entry:
        if (self.image is None) == (self.images is None):
            raise ValueError("an entry has either 'image' (one file) or 'images' (patterns)")
        return self


class MosaicSettings(_Strict):
    """One raster of all scenes."""

    format: Literal["VRT", "COG"] = "VRT"
    order: Literal["best-view", "first-on-top"] = Field(
        default="best-view", description="What lies on top: the scene that looks down most steeply, or the first."
    )
    seams: bool = Field(default=True, description="Measure how well the scenes agree where they overlap.")


class Config(_Strict):
    """The whole file."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, title="Pipeline file of 'ortho run'")

    scenes: Annotated[list[Entry], Field(min_length=1)]
    output: str = Field(default="out", description="Output folder, relative to this file.")
    root: str | None = Field(
        default=None,
        description="Folder that every path has to lie in, relative to this file; within the file's own, or that of "
        "--root. Default: that one.",
    )
    defaults: Settings = Field(default=Settings(), description="What holds for all scenes.")
    mosaic: MosaicSettings | None = None


def schema() -> dict[str, Any]:
    """Return the JSON Schema of the file."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **Config.model_json_schema()}


def merged(*layers: Settings) -> Settings:
    """Return the settings of several layers: what a later one says wins field by field, options key by key."""
    groups: dict[str, Any] = {}
    for layer in layers:
        for name in Settings.model_fields.keys() & layer.model_fields_set:
            value, before = getattr(layer, name), groups.get(name)
            if isinstance(value, BaseModel) and isinstance(before, BaseModel):
                said = {field: getattr(value, field) for field in value.model_fields_set}
                for field, item in said.items():
                    if isinstance(item, Mapping):
                        said[field] = {**getattr(before, field), **item}
                value = before.model_copy(update=said)
            groups[name] = value
    return Settings.model_construct(**groups)


# -- reading ---------------------------------------------------------------------------------------------------------


@reads("see docs/run.md for the form of the file")
def read_config(path: str | os.PathLike[str]) -> Config:
    """Read a pipeline file.

    Raises
    ------
    InputError
        For anything that is not as the schema has it: the message names line, field and remedy.
    """
    content = read_bounded(path, _MAX_BYTES, remedy="check the path")
    if len(content) > _MAX_BYTES:
        raise InputError("a pipeline file of more than 5 MB is not read", file=path, remedy="use patterns")
    document, lines = _parse(content, path)
    try:
        return Config.model_validate(document)
    except pydantic.ValidationError as error:
        raise _explained(error, lines, path) from error


_Base: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Base):
    """Scalars as YAML 1.2 has them: no 'no' that is false, no date, no 1:30 that is 90."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012


for _kind, _pattern, _first in (
    ("null", r"|~|null|Null|NULL", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
     list("-+.0123456789")),
):  # fmt: skip
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
        remedy = "put quotes around text that begins with *" if "alphabetic" in problem else _SEE
        field = None if mark is None else f"line {mark.line + 1}"
        raise InputError(f"this is no YAML ({problem})", file=path, field=field, remedy=remedy) from error
    if node is None:
        raise InputError("the file is empty", file=path, remedy=_SEE)
    reader = _Reader(path)
    return reader.value(node, ()), reader.lines


def _check_events(content: bytes, path: str | os.PathLike[str]) -> None:
    """Refuse aliases and deep nesting before nodes are made: the C parser's recursion would end the process."""
    depth = 0
    for count, event in enumerate(yaml.parse(content, _Loader)):
        if count > _MAX_EVENTS:
            raise InputError("there are too many entries", file=path, remedy="name images by patterns")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        line = f"line {event.start_mark.line + 1}" if event.start_mark else None
        if depth > _MAX_DEPTH:
            raise InputError(f"more than {_MAX_DEPTH} levels are not read", file=path, field=line)
        if isinstance(event, yaml.AliasEvent):
            remedy = "put what scenes share under 'defaults'"
            raise InputError("aliases are not followed", file=path, field=line, remedy=remedy)


class _Reader:
    """Turns YAML nodes into plain values; duplicate keys and tags are errors."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path
        self.lines: dict[Place, int] = {}

    def value(self, node: Any, place: Place) -> Any:
        """Return the value of a node that stands at `place`."""
        self.lines.setdefault(place, node.start_mark.line + 1)
        kind = node.tag.removeprefix("tag:yaml.org,2002:")
        if isinstance(node, yaml.MappingNode) and kind == "map":
            return self._mapping(node, place)
        if isinstance(node, yaml.SequenceNode) and kind == "seq":
            return [self.value(item, (*place, i)) for i, item in enumerate(node.value)]
        if kind not in ("str", "int", "float", "bool", "null"):
            raise self._error(node, place, f"the tag {node.tag!r} is not known", "leave it out")
        return self._scalar(node, place, kind)

    def _mapping(self, node: Any, place: Place) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, item in node.value:
            name = key.value if isinstance(key, yaml.ScalarNode) else None
            if name is None:
                raise self._error(key, place, "a key is a word", _SEE)
            here = (*place, name)
            if name in found:
                before = self.lines[here]
                raise self._error(key, here, f"this key is given twice (before in line {before})", "leave one out")
            self.lines[here] = key.start_mark.line + 1
            found[name] = self.value(item, here)
        return found

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
            raise self._error(node, place, f"{text[:20]!r} is no number ({kind})", "correct it") from error

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
    found: list[tuple[str, str, str]] = []
    for one in error.errors():
        # In a union pydantic adds the member that it tried, which stands nowhere in the file.
        place: Place = tuple(one["loc"])
        known = place
        while known and known not in lines:
            known = known[:-1]
        if one["type"] == "missing":
            known, message = place, "this field is missing"
        else:
            message = one["msg"].removeprefix("Value error, ")
        remedy = _SEE
        if one["type"] == "extra_forbidden":
            message, remedy = "there is no such field", _allowed(place)
        line = lines.get(known, lines.get(known[:-1], 1))
        found.append((f"line {line}" + (f", {dotted(known)}" if known else ""), message, remedy))
    found = list(dict.fromkeys(found))
    field, message, remedy = found[0]
    rest = [f"{where}: {what}" for where, what, _ in found[1:_SHOWN]]
    if len(found) > _SHOWN:
        rest.append(f"and {len(found) - _SHOWN} more")
    return InputError("; ".join([message, *rest]), file=path, field=field, remedy=remedy)


def _allowed(place: Place) -> str:
    """Return what may stand where an unknown key does, and the one that was probably meant."""
    model: Any = Config
    for part in place[:-1]:
        if isinstance(part, int):
            continue
        model = {
            "scenes": Entry, "defaults": Settings, "mosaic": MosaicSettings, "scene": SceneSettings,
            "points": PointSettings, "surface": SurfaceSettings, "output": OutputSettings,
        }.get(str(part), model)  # fmt: skip
    names = list(model.model_fields)
    close = difflib.get_close_matches(str(place[-1]), names, 1)
    return f"did you mean {close[0]!r}?" if close else f"one of {', '.join(names)}"
