"""Limits that the system sets to this process, address space and threads, and what it prints of destructors.

Libraries do badly without: a thread of Python's that fails before its first line, and a pool of GDAL's that gets fewer
threads than it asked for, are waited for without end; PROJ and GDAL end the process. So what a job needs is asked for
before it begins.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.errors.texts import Setting, Text

#: Bytes of address space that any command needs in addition to its windows: libraries, compiled kernels, grids of PROJ.
LEAST = 256 << 20
#: Bytes of address space that a thread takes: its stack and its part of the heap.
_PER_THREAD = 72 << 20
#: Threads beyond which no work is shared out: a system that lets a process have more is kept from its other work.
MOST_THREADS = 512
#: What glibc calls the number of heaps that threads share (malloc.h).
_M_ARENA_MAX = -8
#: Parts that a work is shared out in, on any machine, so that sums over them are rounded alike.
_PARTS = 8

#: Told what is being done (or was done) and the finished share of it, 0 to 1.
Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class Resources:
    """Budget of a long job, and whom it tells how far it is.

    Parameters
    ----------
    memory : int
        Bytes for windows and GDAL's cache together (the interpreter and its libraries come on top).
    threads : int, optional
        As many as there are processors without.
    progress : callable, optional
        Called with the name of a stage and its finished share, 0 to 1.
    """

    memory: int = 512_000_000
    threads: int | None = None
    progress: Progress | None = None


def require_memory(size: int = LEAST, threads: int = 0) -> None:
    """Refuse to begin work for which the limit of this process's address space leaves no room.

    Parameters
    ----------
    size : int
        Bytes of the work.
    threads : int
        That are started for it.

    Raises
    ------
    OrthoError
        If the limit (``ulimit -v``) leaves less.
    """
    left, needed = _address_space(), size + threads * _PER_THREAD
    if left is not None and left < needed:
        raise OrthoError(
            f"not enough memory: the limit of this process leaves {max(0, left) >> 20} MB of address space, but "
            f"the work needs {needed >> 20} MB",
            field="ulimit -v",
            remedy=Text(
                "raise the limit, or reduce the work at a time (",
                Setting("output.memory", "MB"),
                ", ",
                Setting("output.threads", "1"),
                ")",
            ),
        )


def _address_space() -> int | None:
    """Return how many bytes the limit of this process leaves; None without a limit, or where the system tells none."""
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit == resource.RLIM_INFINITY:
            return None
        return limit - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):  # Windows has none, macOS does not tell
        return None


def startable_threads(wanted: int) -> int:
    """Return how many more threads can run at once, found by starting them.

    At most `wanted`, and `MOST_THREADS`.

    Raises
    ------
    OrthoError
        If there can be none.
    """
    leave, started = threading.Event(), list[threading.Thread]()
    try:
        while len(started) < min(wanted, MOST_THREADS):
            thread = threading.Thread(target=leave.wait, daemon=True)
            thread.start()
            started.append(thread)
    except (RuntimeError, MemoryError):
        pass
    finally:
        leave.set()
    for thread in started:
        thread.join()
    if not started:
        raise OrthoError(
            "no thread can be started",
            remedy="raise the limits on processes and memory (ulimit -u, ulimit -v, pids and memory of the container)",
        )
    return len(started)


def thread_pool(threads: int, name: str) -> ThreadPoolExecutor:
    """Return a pool of so many threads of a name, or of as many as can be started.

    Raises
    ------
    OrthoError
        If there can be none.
    """
    return ThreadPoolExecutor(startable_threads(threads), thread_name_prefix=name)


class _Pool:
    """The process in which GDAL's pool of threads was begun."""

    process: int | None = None


def claim_gdal_threads() -> None:
    """Refuse GDAL's pool of threads where the process that this one was forked from has begun it.

    Its threads do not exist here, and GDAL would wait for them without end.

    Raises
    ------
    OrthoError
    """
    _Pool.process = _Pool.process or os.getpid()
    if _Pool.process != os.getpid():
        raise OrthoError(
            "this process was forked while GDAL's threads were running; they do not exist here",
            remedy=Text(
                "start processes with multiprocessing.get_context('spawn'), or give ", Setting("output.threads", "1")
            ),
        )


def share_freed_memory() -> bool:
    """Let the threads of this process and of its children share one heap; tell whether the C library does (glibc).

    glibc gives each thread a heap of its own, which keeps what it cannot hand to the others: a quarter of the memory of
    an ortho. For a process of the command line: a library leaves the allocator of its host alone.
    """
    os.environ.setdefault("MALLOC_ARENA_MAX", "1")
    try:
        return bool(ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 1))
    except (AttributeError, OSError):
        return False


def parts_of(count: int, least: int) -> list[tuple[int, int]]:
    """Return where the parts of a work of so many pieces begin and end, the same on any machine, `least` in each."""
    parts = max(min(_PARTS, count // least), 1)
    return list(itertools.pairwise(count * number // parts for number in range(parts + 1)))


def side_by_side(
    work: Callable[[int, int, int], None], parts: list[tuple[int, int]], threads: int | None = None
) -> None:
    """Do a work on parts, each given by its number, begin and end, with some threads, or one for each processor.

    The work has to release the GIL, as compiled code does, and each part to write to a place of its own. This thread
    works too; threads that cannot be started leave their parts to the others.
    """
    jobs, others = iter([(number, *part) for number, part in enumerate(parts)]), list[Future[None]]()

    def take_part() -> None:
        for job in jobs:
            work(*job)

    with ThreadPoolExecutor(len(parts) or 1, thread_name_prefix="parts") as pool:
        with suppress(RuntimeError, MemoryError):
            for _ in range(min(threads or os.cpu_count() or 1, len(parts)) - 1):
                others.append(pool.submit(take_part))
        take_part()
    for other in others:
        other.result()


class _Blas:
    """How many are computing with one thread, and what they took from the others."""

    lock, users = threading.Lock(), 0
    limits: ClassVar[dict[bool, Any]] = {}


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS and LAPACK compute with one thread, in the whole process, until the last who asked for it has ended.

    With several they share out sums by the number of processors, and so round otherwise on every machine; on matrices
    of a few hundred rows their threads wait for each other more than they save.
    """
    with _Blas.lock:
        # SciPy's own library may have been loaded since the first asked; to load it here would cost each job its time.
        loaded = "scipy.linalg" in sys.modules
        if not _Blas.users or loaded not in _Blas.limits:
            _Blas.limits[loaded] = _blas_libraries(loaded).limit(limits=1, user_api="blas")
        _Blas.users += 1
    try:
        yield
    finally:
        with _Blas.lock:
            _Blas.users -= 1
            if not _Blas.users:
                for loaded in reversed(list(_Blas.limits)):
                    _Blas.limits.pop(loaded).restore_original_limits()


@functools.cache
def _blas_libraries(scipy: bool) -> Any:
    """Return the libraries of BLAS that are loaded: NumPy's, and with `scipy` that of SciPy too."""
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def is_told_already(lost: Any) -> bool:
    """Tell whether what a destructor cannot raise is of a dataset that GDAL's binding dropped because a copy failed.

    The binding raises what stops a copy and drops what there is of it, whose destructor complains once more. All other
    datasets that are written are closed by `raster.verified_writing`, which raises.
    """
    return getattr(lost.object, "__name__", "") == "delete_Dataset"


def print_no_error_twice() -> None:
    """Let this process print, of what destructors cannot raise, only what is not told already."""
    before = sys.unraisablehook

    def said(lost: Any) -> None:
        if not is_told_already(lost):
            before(lost)

    sys.unraisablehook = said
