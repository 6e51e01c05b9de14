"""JSON documents: what becomes of numbers, arrays and paths in them, and the version that they name.

No number in a document is NaN or infinite.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np

_PLAIN = frozenset({str, int, bool, type(None)})


def json_value(value: Any) -> Any:
    """Return a value as what JSON holds, however nested.

    A number that is not finite is null, by itself or within an array; NumPy's numbers are Python's; arrays, tuples and
    sets are lists; mappings, dataclasses and records are objects; paths and whatever else is not known are text.
    """
    kind = type(value)
    if kind in _PLAIN:  # most of a document, which is asked nothing more
        return value
    if kind is dict:
        return {key if type(key) is str else str(key): json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if hasattr(value, "model_dump"):  # a record; what records are made of need not be loaded to know it
        value = value.model_dump(mode="json")
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
