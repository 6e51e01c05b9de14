"""How numba compiles kernels: once per machine where they may be kept, in the memory of each process elsewhere.

What root has compiled, as for an image of a container, is taken from there.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import os
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import FunctionCache, NullCache

from ortho_pipeline.files.compiled import Kernel
from ortho_pipeline.files.kernels import places

log = logging.getLogger(__name__)

_njit = functools.partial(numba.njit, nogil=True, error_model="numpy", boundscheck=False)
_lock = threading.Lock()


def dispatcher(kernel: Kernel) -> Any:
    """Return numba's object for a kernel, with a cache of ours unless it is inlined."""
    function = kernel.py_func
    if kernel.inline:
        return _njit(forceinline=True)(function)
    made: Any = _njit()(function)
    own = _placed(_Cache, _Own, function) if places.own()[0] else None
    root = _placed(_OfRoot, _Roots, function) if places.of_root() else None
    if own is not None:
        own.shared = root
    made._cache = own or root or _Nowhere()  # as enable_caching() does with numba's own
    return made


def _placed(kind: Callable[..., Any], place: type[_Own], function: Callable[..., Any]) -> Any:
    """Return a cache in a place of ours, whatever places numba's settings name."""
    settings: Any = numba.config
    with _lock:
        before = settings.CACHE_LOCATOR_CLASSES
        settings.CACHE_LOCATOR_CLASSES = f"{place.__module__}.{place.__name__}"
        try:
            return kind(function)
        finally:
            settings.CACHE_LOCATOR_CLASSES = before


class _Own:
    """The files of one kernel in this user's folder: what numba asks of the places of its caches."""

    def __init__(self, function: Callable[..., Any], path: str, folder: Path | None) -> None:
        self._function, self._path, self._folder = function, path, folder

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> _Own:
        """Return the place of a kernel."""
        return cls(function, path, places.own()[0])

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder has been made and looked at."""

    def get_source_stamp(self) -> str:
        """Return a digest of all that the machine code is made from: numba looks at the kernel's own module alone."""
        return _sources(self._function.__module__)

    def get_disambiguator(self) -> str:
        """Return what tells the kernel from those of the same name in other modules."""
        return hashlib.sha256(os.fsencode(os.path.abspath(self._path))).hexdigest()[:16]


class _Roots(_Own):
    """The same in the folder of root, where it is only read."""

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> _Own:
        """Return the place of a kernel."""
        return cls(function, path, places.of_root())


class _Cache(FunctionCache):
    """Machine code of this user, and of root where this user has none."""

    shared: _Cache | None = None

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what is compiled, from where this user keeps it, else from where root does."""
        found = super().load_overload(sig, target_context)
        return self.shared.load_overload(sig, target_context) if found is None and self.shared is not None else found


class _OfRoot(_Cache):
    """Machine code that root has kept; what is compiled is not."""

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep nothing, and say so."""
        _say_once()


class _Nowhere(NullCache):
    """Where nothing may be kept and root has compiled nothing."""

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep nothing, and say so."""
        _say_once()


@functools.cache
def _sources(module: str) -> str:
    """Return a digest of a module and of the others whose compiled functions and records it uses."""
    found, todo = {module}, [module]
    while todo:
        for value in vars(sys.modules[todo.pop()]).values():
            record = isinstance(value, type) and issubclass(value, tuple)
            if (record or isinstance(value, Kernel)) and value.__module__ not in found:
                found.add(value.__module__)
                todo.append(value.__module__)
    files = (getattr(sys.modules[name], "__file__", None) for name in sorted(found - {"typing"}))
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files if file)).hexdigest()


@functools.cache
def _say_once() -> None:
    log.warning(
        "Compiled kernels are not kept, because %s. Every run compiles them again, for some seconds. "
        "Remedy: set %s to a folder of your own to which nobody else can write",
        places.own()[1], places.FOLDER,
    )  # fmt: skip
