"""JSON documents: what becomes of numbers, arrays, paths and records in them, and records made of documents again.

A record is a frozen dataclass (`record`) whose fields are the members of a JSON object. `json_value` writes it,
`record_of` reads it, `schema_of` publishes what it holds, and `made_of` takes what this program itself has just made.
No number in a document is NaN or infinite.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import types
import typing
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import Annotated, Any, TypeVar, dataclass_transform

import numpy as np

_T = TypeVar("_T")
_PLAIN = frozenset({str, int, bool, type(None)})


def json_value(value: Any) -> Any:
    """Return a value as what JSON holds, however nested.

    A number that is not finite is null, by itself or within an array; NumPy's numbers are Python's; arrays, tuples and
    sets are lists; mappings and dataclasses are objects; paths and whatever else is not known are text.
    """
    kind = type(value)
    if kind in _PLAIN:  # most of a document, which is asked nothing more
        return value
    if kind is dict:
        return {key if type(key) is str else str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, os.PathLike):
        value = os.fspath(value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [json_value(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def json_position(values: Any) -> list[float] | None:
    """Return a place, or a vector ``(N,)``, as numbers; null as a whole where any of them is not finite."""
    found: list[float] = np.asarray(values, dtype=np.float64).tolist()
    return found if all(map(math.isfinite, found)) else None


@functools.cache
def software_version() -> str:
    """Return the version of this package, for documents that say what made them; its metadata are parsed once."""
    return metadata.version("ortho-pipeline")


# -- records ---------------------------------------------------------------------------------------------------------


@dataclass_transform(frozen_default=True, kw_only_default=True)
def record(kind: type[_T]) -> type[_T]:
    """Make a class a record: a frozen dataclass with named fields, which refuses members that it does not know.

    A field with a default may be missing in documents of earlier versions, and is in all that are written.
    """
    kind.__pydantic_config__ = {  # type: ignore[attr-defined]
        "extra": "forbid", "allow_inf_nan": False, "json_schema_serialization_defaults_required": True,
    }  # fmt: skip
    # Made once for all of them: dataclass() would compile each anew, for most of the time that a report takes to load.
    kind.__eq__, kind.__hash__, kind.__repr__ = _same, _hashed, _shown  # type: ignore[assignment, method-assign]
    kind.__init__, kind.__setattr__, kind.__delattr__ = _filled, _frozen, _frozen  # type: ignore[method-assign]
    return dataclasses.dataclass(kw_only=True, init=False, eq=False, repr=False)(kind)


def _filled(self: Any, **members: Any) -> None:
    """Set the members of a record; those that are missing have their defaults."""
    for field in dataclasses.fields(self):
        if field.name not in members:
            if field.default is not dataclasses.MISSING:
                members[field.name] = field.default
            elif field.default_factory is not dataclasses.MISSING:
                members[field.name] = field.default_factory()
    if wrong := members.keys() ^ {field.name for field in dataclasses.fields(self)}:
        raise TypeError(f"{type(self).__name__}: missing or not known: {', '.join(sorted(wrong))}")
    vars(self).update((field.name, members[field.name]) for field in dataclasses.fields(self))


def _frozen(self: Any, name: str, *_: Any) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot change {name!r}")


def _same(one: Any, other: object) -> Any:
    return vars(one) == vars(other) if type(one) is type(other) else NotImplemented


def _hashed(one: Any) -> int:
    return hash(tuple(vars(one).values()))


def _shown(one: Any) -> str:
    return f"{type(one).__name__}({', '.join(f'{name}={value!r}' for name, value in vars(one).items())})"


class DocumentError(ValueError):
    """A document that is not the one of a record: `place` is the first member that is wrong, `fault` how."""

    def __init__(self, place: str, fault: str) -> None:
        super().__init__(f"{place}: {fault}")
        self.place, self.fault = place, fault


class Shape:
    """Say more of a field's values in the schema than their type does: ``Annotated[int, Shape(minimum=0)]``."""

    def __init__(self, **members: Any) -> None:
        self.members = members

    def __get_pydantic_json_schema__(self, core: Any, handler: Any) -> dict[str, Any]:
        return {**handler(core), **self.members}


def record_of(kind: type[_T], document: Any) -> _T:
    """Return a document as the record that it was written from.

    Raises
    ------
    DocumentError
        If a member is missing, too much, or of a wrong type.
    """
    import pydantic

    try:
        found: _T = _adapter(kind).validate_python(document)  # type: ignore[arg-type]
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(str(part) or "''" for part in first["loc"])  # a member's name may be empty
        raise DocumentError(place[:200], first["msg"][:200]) from error
    return found


def made_of(kind: type[_T], document: Any) -> _T:
    """Return a document that this program has just made as its record: `record_of` without its checks and their cost.

    Nothing that comes from a file goes this way. Members that a record does not know are a TypeError.
    """
    found: _T = _maker(kind)(document)  # type: ignore[arg-type]
    return found


@functools.cache
def _maker(kind: Any) -> Callable[[Any], Any]:
    """Return what makes a value of the members of its document: numbers and tuples are of the types that are named."""
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _record_maker(kind)
    if origin is Annotated:
        return _maker(inner[0])
    if origin in (typing.Union, types.UnionType):
        return _one_of([one for one in inner if one is not type(None)])
    if origin in (tuple, list, dict):
        return _collection_maker(origin, inner)
    return float if kind is float else _as_it_is


def _record_maker(kind: Any) -> Callable[[Any], Any]:
    makers = {name: _maker(hint) for name, hint in typing.get_type_hints(kind, include_extras=True).items()}
    return lambda found: kind(**{name: makers.get(name, _as_it_is)(value) for name, value in found.items()})


def _collection_maker(kind: Any, inner: tuple[Any, ...]) -> Callable[[Any], Any]:
    if kind is tuple and inner[-1] is not Ellipsis:
        makers = [_maker(one) for one in inner]
        return lambda found: tuple(make(value) for make, value in zip(makers, found, strict=True))
    make = _maker(inner[1] if kind is dict else inner[0])
    if kind is dict:
        return lambda found: {key: make(value) for key, value in found.items()}
    return lambda found: kind(map(make, found))


def _one_of(kinds: list[Any]) -> Callable[[Any], Any]:
    """Return the maker of what may be missing; among records the one that has all members of the document."""
    if len(kinds) == 1:
        make = _maker(kinds[0])
        return lambda found: None if found is None else make(found)
    if not all(map(dataclasses.is_dataclass, kinds)):
        return _as_it_is
    names = [({field.name for field in dataclasses.fields(kind)}, kind) for kind in kinds]
    return lambda found: None if found is None else _maker(next(one for has, one in names if has >= set(found)))(found)


def _as_it_is(found: Any) -> Any:
    return found


def schema_of(kind: type, title: str) -> dict[str, Any]:
    """Return the JSON Schema of the documents that are written from a record."""
    from pydantic.json_schema import GenerateJsonSchema

    class WithoutTitles(GenerateJsonSchema):
        """Leave out the titles of members, which only repeat their names."""

        def field_title_should_be_set(self, schema: Any) -> bool:
            return False

    found = _adapter(kind).json_schema(mode="serialization", schema_generator=WithoutTitles)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **found, "title": title}


@functools.cache
def _adapter(kind: Any) -> Any:
    """Return pydantic's reader of a record, which takes a while to make."""
    import pydantic

    return pydantic.TypeAdapter(kind)
