"""Names of a module that are loaded when they are first used, so that importing the module stays cheap."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazily(door: str, homes: Mapping[str, str]) -> Callable[[str], Any]:
    """Return `__getattr__` for the module `door`: it loads each name from its home when the name is first used."""

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {door!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(f"ortho_pipeline.{homes[name]}"), name)
        setattr(sys.modules[door], name, value)
        return value

    return load
