"""How kernels are compiled: once per machine where a cache can be written, in the memory of each process elsewhere."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from typing import Any

import numba

log = logging.getLogger(__name__)


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function that runs without the interpreter lock; indices are not checked, and x / 0 is infinite."""
    return _made(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into each compiled one that calls it."""
    return _made(function, inline="always")


def _made(function: Callable[..., Any], **options: Any) -> Any:
    make = functools.partial(numba.njit, nogil=True, error_model="numpy", boundscheck=False, **options)
    try:
        return make(cache=True)(function)
    except RuntimeError:
        # Neither the package's folder nor the user's cache can be written, as in many containers.
        _say_once()
        return make()(function)


@functools.cache
def _say_once() -> None:
    log.warning(
        "compiled code cannot be kept, because neither this package's folder nor the home can be written: every run "
        "compiles again, for some seconds. Remedy: set NUMBA_CACHE_DIR to a folder that can be written"
    )
