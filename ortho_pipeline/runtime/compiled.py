"""Functions that are compiled: kernels, made with the two decorators of this module.

A kernel is compiled once per machine where a cache may be kept, in the memory of each process elsewhere; see
`runtime.compilation.compiler`. numba is loaded when a kernel is first called.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.runtime.compilation.marked import Marked

#: The package that compiles kernels.
COMPILER = "numba"
#: numba takes settings from a file of this name in the working folder, which may be somebody else's delivery.
_SETTINGS = ".numba_config.yaml"
_lock = threading.Lock()


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function that releases the GIL; indices are not checked, and x / 0 is infinite."""
    return Kernel(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into each compiled one that calls it, and is kept with it. Python calls it as it is.

    LLVM does it: numba's own ``inline="always"`` copies the function before types are known, and infers them anew for
    each copy, which took most of the time of compiling.
    """
    return Kernel(function, inline=True)


def is_loaded() -> bool:
    """Tell whether this process has loaded numba, which takes a second."""
    return COMPILER in sys.modules


class Kernel(Marked):
    """A function that is compiled for the types of its arguments when it is first called with such.

    It has all that numba's own object (`dispatcher`) has, which is made when it is first needed.
    """

    def __init__(self, function: Callable[..., Any], inline: bool = False) -> None:
        functools.update_wrapper(self, function)
        super().__init__(function, inline=inline)
        self._made: Any = None

    def __call__(self, *given: Any, **named: Any) -> Any:
        return (self.py_func if self.inline else self._made or self.dispatcher)(*given, **named)

    @property
    def dispatcher(self) -> Any:
        """What numba makes of the function.

        Raises
        ------
        InputError
            If a file in the working folder would change numba's settings.
        """
        if self._made is None:
            with _lock:
                _refuse_settings()
                from ortho_pipeline.runtime.compilation import compiler

                self._made = self._made or compiler.dispatcher(self)
        return self._made

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # asked of any object, and no reason to load numba
            raise AttributeError(name)
        return getattr(self.dispatcher, name)


def _refuse_settings() -> None:
    if Path(_SETTINGS).exists():
        raise InputError(
            "numba would read its settings from this file in the working folder, which could run foreign code",
            file=Path(_SETTINGS).absolute(),
            remedy="remove the file, or run the command in another folder",
        )
