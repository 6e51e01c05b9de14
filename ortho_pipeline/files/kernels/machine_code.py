"""Kernels that were compiled before, called without the compiler: numba takes a fifth of a second to load.

What numba has compiled calls functions of its runtime, which are in libraries beside numba's modules and need none of
these. So a kernel is kept as machine code, and LLVM alone puts it together with them. That relies on what those
libraries are called and offer, which is not for others to know: it is done for versions of numba and systems on which
the tests have run, and everywhere else numba loads its own cache. A kernel is kept for the types of its arguments, for
this processor, and for the files that it was made from; where any of these is another one, it is not found.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib.machinery
import importlib.util
import json
import os
import platform
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

#: Versions of numba on which `tests/files/test_machine_code.py` has run.
TESTED = ("0.63.", "0.65.", "0.67.", "0.68.")
#: Types of arguments that numba takes by their type alone.
_PLAIN = frozenset((float, bool, type(None), np.float64, np.float32, np.int64, np.uint16, np.uint8, np.bool_))
#: Flags of an array that its type is made of: contiguous in C's order, or else in Fortran's; aligned and writable.
_C, _F, _OTHERS = 0x0001, 0x0002, 0x0100 | 0x0400


def kind(values: tuple[Any, ...]) -> tuple[Any, ...] | None:
    """Return what the types of arguments are, in a form that can be compared; None for some that are not known here."""
    found: list[Any] = []
    for value in values:
        of = type(value)
        if of is np.ndarray:
            flags = value.flags.num
            found.append((value.dtype, value.ndim, flags & _C or flags & _F, flags & _OTHERS))
        elif of in _PLAIN or (of is int and -(1 << 63) <= value < 1 << 63):
            found.append(of)
        elif issubclass(of, tuple) and (inner := kind(value)) is not None:
            found.append((of, inner))
        else:
            return None
    return tuple(found)


def find(function: Callable[..., Any], kinds: tuple[Any, ...]) -> Callable[..., Any] | None:
    """Return a function as it was compiled for arguments of some kinds; None where it was not kept, or not here."""
    if not _possible():
        return None
    for place in _places(function, kinds):
        try:
            head, _, code = place.read_bytes().partition(b"\n")
            told = json.loads(head)
            sound = told["code"] == hashlib.sha256(code).hexdigest() and told["sources"] == _states(told["sources"])
            sound = sound and told["machine"] == _machine()
        except (OSError, ValueError, KeyError, TypeError, RuntimeError):
            continue
        if sound:
            return _linker().function(function, code, told["wrapper"], told["environments"])
    return None


def keep(
    function: Callable[..., Any], kinds: tuple[Any, ...], code: bytes, wrapper: str,
    environments: Mapping[str, Iterable[np.dtype[Any]]], modules: Iterable[str],
) -> None:  # fmt: skip
    """Keep the machine code of a function, in the first folder that can be written.

    Parameters
    ----------
    wrapper : str
        Name of the symbol that takes Python's arguments.
    environments : mapping
        Names of the variables that point to the constants of functions, and these.
    modules : iterable of str
        Those that it was made from.
    """
    if not _possible():
        return
    constants = {name: [value.str for value in values] for name, values in environments.items()}
    told = {
        "code": hashlib.sha256(code).hexdigest(), "machine": _machine(), "sources": _states(modules),
        "wrapper": wrapper, "environments": constants,
    }  # fmt: skip
    whole = json.dumps(told).encode() + b"\n" + code
    for place in _places(function, kinds):
        # Another process may read it, and others, or another thread of this one, write it as well.
        temporary = place.with_name(f"{place.name}.{os.getpid()}.{threading.get_ident()}.part")
        try:
            if place.is_file() and place.read_bytes() == whole:
                return
            place.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(whole)
            temporary.replace(place)
        except OSError:
            with contextlib.suppress(OSError):
                temporary.unlink()
            continue
        return


@functools.cache
def _possible() -> bool:
    """Whether kernels can be called without numba here: a system that is tested, and no file of settings."""
    tested = sys.platform == "linux" and platform.machine() == "x86_64" and sys.implementation.name == "cpython"
    return tested and not Path(".numba_config.yaml").exists()


def _places(function: Callable[..., Any], kinds: tuple[Any, ...]) -> Iterator[Path]:
    """Yield the files that may hold a function, in the order in which numba looks for a folder."""
    source = Path(function.__code__.co_filename)
    marks = hashlib.sha256(repr(kinds).encode()).hexdigest()[:16]
    python = f"{sys.implementation.cache_tag}{sys.abiflags}"
    name = f"{source.stem}.{function.__qualname__}-{function.__code__.co_firstlineno}.{python}.{marks}.kernel"
    folder = f"{source.parent.name}_{hashlib.sha256(os.fsencode(source.parent)).hexdigest()[:16]}"
    if told := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(told) / folder / name
    yield source.parent / "__pycache__" / name
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    yield Path(home) / "ortho-pipeline" / "kernels" / folder / name


def _states(modules: Iterable[str]) -> dict[str, str | None]:
    """Return digests of the files of modules; none of a module that is not loaded."""
    paths = {name: getattr(sys.modules.get(name), "__file__", None) for name in sorted(modules)}
    return {name: _digest(path) if path else None for name, path in paths.items()}


@functools.cache
def _digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@functools.cache
def _machine() -> dict[str, Any]:
    """Return what machine code is made for and by: the processor, LLVM, numba and this module.

    Not by the times of files, which differ between an image of a container and its copies.
    """
    import llvmlite.binding as llvm

    folder = _numba()
    versions = [Path(__file__), folder / "_version.py", Path(llvm.ffi.__file__).parents[1] / "_version.py"]
    settings = {name: value for name, value in os.environ.items() if name.startswith("NUMBA_")}
    settings.pop("NUMBA_CACHE_DIR", None)
    # As numba has it: who names a processor names its features too, or wants those that all of its kind have.
    named = settings.get("NUMBA_CPU_NAME")
    return {
        "processor": named or llvm.get_host_cpu_name(),
        "features": "" if named else llvm.get_host_cpu_features().flatten(),
        "settings": settings,
        "versions": [_digest(os.fspath(path)) for path in versions],
        "libraries": [os.stat(_library(folder, name)).st_size for name in _LIBRARIES],
    }


def _numba() -> Path:
    """Return the folder of numba, which is not loaded for that."""
    found = importlib.util.find_spec("numba")
    if found is None or not found.submodule_search_locations:
        raise OSError("numba is not installed as a folder")
    return Path(found.submodule_search_locations[0])


#: Numba's own: conversions of Python's objects and errors, functions, memory.
_LIBRARIES = ("_helperlib", "_dynfunc", "core/runtime/_nrt_python")


def _library(folder: Path, name: str) -> Path:
    for ending in importlib.machinery.EXTENSION_SUFFIXES:
        if (path := folder / f"{name}{ending}").is_file():
            return path
    raise OSError(f"numba has no library {name}")


def _loaded(folder: Path, name: str) -> ModuleType:
    """Load a library of numba without numba, under its name; when numba is loaded, it finds the library there."""
    full = f"numba.{name.replace('/', '.')}"
    if full in sys.modules:
        return sys.modules[full]
    loader = importlib.machinery.ExtensionFileLoader(full, os.fspath(_library(folder, name)))
    spec = importlib.util.spec_from_loader(full, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    sys.modules.pop(full, None)
    return module


class _Linker:
    """LLVM's linker in this process, and what kernels call."""

    def __init__(self) -> None:
        import llvmlite.binding as llvm

        self._llvm = llvm
        helpers, self._functions, memory = (_loaded(_numba(), name) for name in _LIBRARIES)
        for symbol, address in _symbols(helpers.c_helpers | self._functions.c_helpers, memory.c_helpers).items():
            llvm.add_symbol(symbol, address)
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        target = llvm.Target.from_triple(llvm.get_process_triple())
        machine = target.create_target_machine(reloc="static", codemodel="jitdefault", jit=True)
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
        self._kept: list[Any] = []

    def function(
        self, function: Callable[..., Any], code: bytes, wrapper: str, environments: Mapping[str, Iterable[str]]
    ) -> Callable[..., Any]:
        """Return a function of Python's that calls machine code."""
        self._engine.add_object_file(self._llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        module, name = sys.modules[function.__module__], function.__name__
        for variable, values in environments.items():
            environment = self._functions.Environment(vars(module))
            environment.consts[:] = [np.dtype(value) for value in values]
            self._kept.append(environment)
            if place := self._engine.get_global_value_address(variable):
                ctypes.c_void_p.from_address(place).value = id(environment)
        # The first are those of the function itself.
        own, address = self._kept[-len(environments)], self._engine.get_function_address(wrapper)
        made: Callable[..., Any] = self._functions.make_function(module, name, name, address, own, (self,))
        return made


def _symbols(helpers: Mapping[str, int], memory: Mapping[str, int]) -> dict[str, int]:
    """Return what numba calls the functions and objects that kernels use, and where they are."""
    import builtins

    errors = {
        f"PyExc_{one.__name__}": id(one)
        for one in vars(builtins).values()
        if isinstance(one, type) and issubclass(one, BaseException)
    }
    own = {f"numba_{name}": address for name, address in helpers.items()}
    runtime = {name if name.startswith("_") else f"NRT_{name}": address for name, address in memory.items()}
    return {"_Py_NoneStruct": id(None), **errors, **own, **runtime}


@functools.cache
def _linker() -> _Linker:
    return _Linker()
