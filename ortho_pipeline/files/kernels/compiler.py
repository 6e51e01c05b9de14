"""How numba compiles kernels: once per machine where a cache can be written, in the memory of each process elsewhere.

What was compiled before, in a folder that cannot be written any more (an image of a container, a package that somebody
else installed), is taken from there.
"""

from __future__ import annotations

import functools
import hashlib
import inspect
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    InTreeCacheLocator,
    NullCache,
    UserProvidedCacheLocator,
)
from numba.core.runtime import rtsys

from ortho_pipeline.files.compiled import Kernel
from ortho_pipeline.files.kernels import machine_code

log = logging.getLogger(__name__)

_njit = functools.partial(numba.njit, nogil=True, error_model="numpy", boundscheck=False)


def dispatcher(kernel: Kernel) -> Any:
    """Return numba's object for a kernel, with a cache of ours unless it is inlined."""
    function = kernel.py_func
    if kernel.inline:
        return _njit(forceinline=True)(function)
    made: Any = _njit()(function)
    own, shared = _cache_of(_Cache, function), _cache_of(_Shared, function)
    if own is not None and shared is not None and own.cache_path != shared.cache_path:
        own.shared = shared
    made._cache = own or shared or _Nowhere()  # as enable_caching() does with numba's own
    return made


def keep(kernel: Kernel, kinds: tuple[Any, ...], given: tuple[Any, ...]) -> None:
    """Keep the machine code of a kernel that was called with some arguments, to be called without numba."""
    types = tuple(numba.typeof(value) for value in given)
    caches = (kernel.dispatcher._cache, getattr(kernel.dispatcher._cache, "shared", None))
    found = [one._impl.told[types] for one in caches if isinstance(one, _Cache) and types in one._impl.told]
    if not found or not numba.__version__.startswith(machine_code.TESTED):
        return
    (_, form, library), function, environment, _, in_python, lifted, _, prepared, others = found[0]
    environments = {one.env_name: list(one.consts) for one in (environment, *others)}
    # Other constants of Python's need numba to make them.
    plain = all(isinstance(value, np.dtype) for values in environments.values() for value in values)
    if form == "object" and plain and not (in_python or lifted or prepared):
        wrapper = function.llvm_cpython_wrapper_name
        machine_code.keep(kernel.py_func, kinds, library[0], wrapper, environments, _modules(kernel.__module__))


def _cache_of(kind: type[_Cache], function: Callable[..., Any]) -> _Cache | None:
    try:
        return kind(function)
    except RuntimeError:
        return None


class _Told(CompileResultCacheImpl):
    """Remembers what of compiled functions goes into the cache, or comes from there, by the types of arguments."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self.told: dict[Any, Any] = {}

    def reduce(self, made: Any) -> Any:
        """Return what is written of a function."""
        payload = super().reduce(made)
        self.told[made.signature.args] = payload
        return payload

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Return the function of which that was written."""
        made = super().rebuild(target_context, payload)
        self.told[made.signature.args] = payload
        return made


class _Cache(FunctionCache):
    """Machine code that is made again if anything that it was made from has changed.

    numba looks at the module of the function alone, not at those of functions that are compiled into it.
    """

    _impl_class: Any = _Told
    shared: _Cache | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what is compiled with the runtime that it calls, and nothing else.

        numba would first load all that it can compile, SciPy's linear algebra too: a fifth of a small scene's time. It
        does so by itself where something is to be compiled. What kernels may use is thereby narrow: see `compiled`.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            found = self._load_overload(sig, target_context)
        return self.shared.load_overload(sig, target_context) if found is None and self.shared is not None else found

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        return (*super()._index_key(sig, codegen), _others(self._py_func.__module__))


def _must_hold_code(place: Any) -> None:
    """Refuse a folder that holds nothing of a module; numba's own places have to be writable instead."""
    stem = Path(place._py_file).stem
    if not any(name.startswith(f"{stem}.") and name.endswith(".nbi") for name in os.listdir(place.get_cache_path())):
        raise FileNotFoundError


class _Named(UserProvidedCacheLocator):
    """The folder of NUMBA_CACHE_DIR, where it is only read."""

    ensure_cache_path = _must_hold_code


class _BesideSources(InTreeCacheLocator):
    """The folder of the package, where it is only read."""

    ensure_cache_path = _must_hold_code


class _SharedPlace(_Told):
    _locator_classes: Any = (_Named, _BesideSources)


class _Shared(_Cache):
    """Machine code that somebody else has kept; what is compiled is not."""

    _impl_class: Any = _SharedPlace

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep nothing, and say so."""
        _say_once()


class _Nowhere(NullCache):
    """Where nothing can be written and nobody has compiled, as in many containers."""

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep nothing, and say so."""
        _say_once()


@functools.cache
def _modules(module: str) -> frozenset[str]:
    """Return a module, and the others whose compiled functions and records it uses."""
    found, todo = {module}, [module]
    while todo:
        for value in vars(sys.modules[todo.pop()]).values():
            record = isinstance(value, type) and issubclass(value, tuple)
            if (record or isinstance(value, Kernel)) and value.__module__ not in found:
                found.add(value.__module__)
                todo.append(value.__module__)
    return frozenset(found - {"typing"})


@functools.cache
def _others(module: str) -> str:
    """Return a digest of the other modules whose compiled functions and records a module uses."""
    sources = (inspect.getsource(sys.modules[name]) for name in sorted(_modules(module) - {module}))
    return hashlib.sha256("".join(sources).encode()).hexdigest()


@functools.cache
def _say_once() -> None:
    log.warning(
        "what was compiled cannot be kept, because neither this package's folder nor the home can be written: every "
        "run compiles it again, for some seconds. Remedy: set NUMBA_CACHE_DIR to a folder that can be written"
    )
