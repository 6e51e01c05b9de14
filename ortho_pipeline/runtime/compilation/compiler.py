"""How numba compiles kernels: once per machine where they may be kept, in the memory of each process elsewhere.

What root has compiled, as for an image of a container, is taken from there.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numba
from numba.core.caching import FunctionCache, NullCache

from ortho_pipeline.runtime.compilation import cache_folders
from ortho_pipeline.runtime.compilation.marked import Marked

log = logging.getLogger(__name__)

#: C calls no kernel, and Python calls no inlined one. Wrappers for such calls took a fifth of the time of compiling.
_njit = functools.partial(numba.njit, nogil=True, error_model="numpy", boundscheck=False, no_cfunc_wrapper=True)


def dispatcher(kernel: Marked) -> Any:
    """Return numba's object for a kernel, with a cache of ours unless it is inlined; one kernel at a time."""
    function = kernel.py_func
    if kernel.inline:
        return _njit(forceinline=True, no_cpython_wrapper=True)(function)
    made: Any = _njit()(function)
    # As enable_caching() does with numba's own.
    made._cache = _Kept(_cache_in(cache_folders.own()[0], function), _cache_in(cache_folders.of_root(), function))
    return made


def _cache_in(folder: Path | None, function: Callable[..., Any]) -> FunctionCache | None:
    """Return numba's cache of a function in a folder of ours, whatever places numba's settings name."""
    if folder is None:
        return None
    settings: Any = numba.config
    before = settings.CACHE_LOCATOR_CLASSES
    settings.CACHE_LOCATOR_CLASSES, _Place.folder = f"{__name__}.{_Place.__name__}", folder
    try:
        return FunctionCache(function)
    finally:
        settings.CACHE_LOCATOR_CLASSES = before


class _Place:
    """The files of one kernel in a folder: what numba asks of the places of its caches."""

    #: Of the caches that are made next.
    folder: ClassVar[Path]

    def __init__(self, function: Callable[..., Any], path: str) -> None:
        self._function, self._path, self._folder = function, path, self.folder

    @classmethod
    def from_function(cls, function: Callable[..., Any], path: str) -> _Place:
        """Return the place of a kernel."""
        return cls(function, path)

    def get_cache_path(self) -> str:
        """Return the folder."""
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        """Do nothing: the folder has been made and looked at."""

    def get_source_stamp(self) -> str:
        """Return a digest of all that the machine code is made from: numba looks at the kernel's own module alone."""
        return _sources(self._function.__module__)

    def get_disambiguator(self) -> str:
        """Return what tells the kernel from those of the same name in other modules, and in other versions.

        An index names the types of arguments: that of a version with other types could not be read.
        """
        place = os.fsencode(os.path.abspath(self._path))
        return hashlib.sha256(place + self.get_source_stamp().encode()).hexdigest()[:16]


class _Kept(NullCache):
    """Machine code of this user, and of root where this user has none; either may have no folder."""

    def __init__(self, own: FunctionCache | None, of_root: FunctionCache | None) -> None:
        self.own, self.of_root = own, of_root

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load what is compiled, from where this user keeps it, else from where root does."""
        loaded = (_loaded(cache, sig, target_context) for cache in (self.own, self.of_root) if cache)
        return next((found for found in loaded if found is not None), None)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what is compiled in this user's folder, or say why that is impossible."""
        if self.own is None:
            _say_once(cache_folders.own()[1])
            return
        try:
            self.own.save_overload(sig, data)
        except Exception as error:
            _say_once(f"{self.own.cache_path} cannot be written ({getattr(error, 'strerror', None) or error})")


def _loaded(cache: FunctionCache, sig: Any, target_context: Any) -> Any:
    """Return what is compiled for types of arguments, or None.

    Two processes that compile a kernel for different types at once may give both the same file. A disk that was full,
    or lost its power, leaves files that cannot be read: pickles, which raise whatever their bytes lead to.
    """
    try:
        found = cache.load_overload(sig, target_context)
    except Exception:
        with contextlib.suppress(OSError):
            cache.flush()
        return None
    return found if found is not None and tuple(found.signature.args) == tuple(sig) else None


@functools.cache
def _sources(module: str) -> str:
    """Return a digest of a module and of the others whose compiled functions and records it uses."""
    found, todo = {module}, [module]
    while todo:
        for value in vars(sys.modules[todo.pop()]).values():
            record = isinstance(value, type) and issubclass(value, tuple)
            if (record or isinstance(value, Marked)) and value.__module__ not in found:
                found.add(value.__module__)
                todo.append(value.__module__)
    files = (getattr(sys.modules[name], "__file__", None) for name in sorted(found - {"typing"}))
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files if file)).hexdigest()


@functools.cache
def _say_once(reason: str) -> None:
    log.warning(
        "Compiled kernels are not cached, because %s. Every run compiles them again, for some seconds. "
        "Remedy: set %s to a folder of your own with free space, to which nobody else can write",
        reason,
        cache_folders.FOLDER,
    )
