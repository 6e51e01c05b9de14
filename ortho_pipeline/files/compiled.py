"""Functions that are compiled: kernels, made with the two decorators of this module.

A kernel is compiled once per machine where a cache can be written, in the memory of each process elsewhere; see
`kernels.compiler`. Where it was compiled before, it is called without numba, which is not even loaded; see
`kernels.machine_code`.
"""

from __future__ import annotations

import functools
import sys
import threading
from collections.abc import Callable
from typing import Any

from ortho_pipeline.files.kernels import machine_code

_lock = threading.Lock()


def compiled(function: Callable[..., Any]) -> Any:
    """Compile a function that runs without the interpreter lock; indices are not checked, and x / 0 is infinite.

    Kernels are loops over numbers and arrays. Hashes (dictionaries, sets) and BLAS (``np.dot``, ``np.linalg``) are
    missing when compiled code is loaded from its cache.
    """
    return Kernel(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function into each compiled one that calls it, and is kept with it.

    LLVM does it: numba's own ``inline="always"`` copies the function before types are known, and infers them anew for
    each copy, which took most of the time of compiling.
    """
    return Kernel(function, inline=True)


class Kernel:
    """A function that is compiled for the types of its arguments when it is first called with such.

    It has all that numba's own object (`dispatcher`) has, which is made when it is first needed.
    """

    def __init__(self, function: Callable[..., Any], inline: bool = False) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self.inline = function, inline
        self._calls: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *given: Any, **named: Any) -> Any:
        if named:
            return self.dispatcher(*given, **named)
        kinds = machine_code.kind(given)
        call = self._calls.get(kinds)
        if call is None:
            call = self._found(kinds)
        return call(*given)

    @functools.cached_property
    def dispatcher(self) -> Any:
        """What numba makes of the function."""
        from ortho_pipeline.files.kernels import compiler

        return compiler.dispatcher(self)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # asked of any object, and no reason to load numba
            raise AttributeError(name)
        return getattr(self.dispatcher, name)

    def _found(self, kinds: tuple[Any, ...] | None) -> Callable[..., Any]:
        """Return what is called with arguments of such kinds: machine code that was kept, or numba."""
        with _lock:
            call = self._calls.get(kinds)
            # Where numba is loaded already, its own cache tells what it did.
            if call is None and kinds is not None and not self.inline and "numba" not in sys.modules:
                call = machine_code.find(self.py_func, kinds)
            if call is None:
                call = self.dispatcher if kinds is None or self.inline else functools.partial(self._first, kinds)
            self._calls[kinds] = call
        return call

    def _first(self, kinds: tuple[Any, ...], *given: Any) -> Any:
        from ortho_pipeline.files.kernels import compiler

        result = self.dispatcher(*given)
        self._calls[kinds] = self.dispatcher
        compiler.keep(self, kinds, given)
        return result
