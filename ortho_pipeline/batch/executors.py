"""Who does the work of a run: this process, processes of its own, dask's workers, or an executor of the caller.

Nothing heavy is imported at the top: a worker process sets its budget of threads before NumPy is loaded.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from multiprocessing import connection
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.synchronize import Event
from queue import SimpleQueue
from typing import Any, TypeVar, cast

from ortho_pipeline.errors import InputError, OrthoError
from ortho_pipeline.errors.texts import Setting, Text, installing
from ortho_pipeline.options import EXECUTORS
from ortho_pipeline.runtime.process_limits import print_no_error_twice, require_memory, startable_threads
from ortho_pipeline.runtime.signals import Terminated, ended_by_signals

_log = logging.getLogger(__name__)
#: Jobs that are handed over before their turn, so that no worker waits for the next one.
_AHEAD = 256
#: Seconds of work that travel together to a scheduler, and at most so many jobs.
_TOGETHER, _MOST_TOGETHER = 3.0, 64
#: So long a scheduler may take to answer.
_PATIENCE = "5s"
#: Seconds in which processes that are ended remove their temporary files; then they are killed.
_LEAVE = 10.0
#: Environment variables that bound the threads of numerical libraries.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

Job = TypeVar("Job")
Outcome = TypeVar("Outcome")
Item = TypeVar("Item")


class WorkerDied(OrthoError):
    """The process that worked on a job ended without a word."""


class Sequential(Executor):
    """Works in the calling thread, at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call the function and return its finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Processes:
    """A pool of spawned processes that outlives the death of some of them.

    Parameters
    ----------
    workers : int
    threads : int
        Budget of each worker for numerical libraries.
    """

    def __init__(self, workers: int, threads: int) -> None:
        self.workers, self.threads = workers, threads
        self._spawned: list[SpawnProcess] = []
        self._pool: ProcessPoolExecutor | None = None

    def completed(
        self, work: Callable[[Job], Outcome], jobs: Iterable[Job], ended: Future[Any]
    ) -> Generator[tuple[Job, Future[Outcome]]]:
        """Yield jobs and their finished futures, in the order in which they end, until `ended` is set.

        A process that dies takes the pool with it. Whatever it was given is done again, one job at a time, so that only
        a job that kills its process every time ends with `WorkerDied`.
        """
        suspects: list[Job] = []
        work = functools.partial(_until_terminated, work)
        try:
            for job, future in self._on_new_pools(2 * self.workers, work, iter(jobs), ended):
                if isinstance(future.exception(), BrokenExecutor):
                    suspects.append(job)
                else:
                    yield job, future
            for job, future in self._on_new_pools(1, work, iter(suspects), ended):
                yield job, _died(future)
        finally:
            self.stop()

    def _on_new_pools(
        self, ahead: int, work: Callable[[Job], Outcome], jobs: Iterator[Job], ended: Future[Any]
    ) -> Iterator[tuple[Job, Future[Outcome]]]:
        """Yield as `completed`, with a new pool for the rest after one has broken."""
        broken = True
        while broken and not ended.done():
            broken = False
            # A pool whose own threads fail to begin is waited for without end.
            require_memory()
            startable_threads(2)
            spawning = _Spawning(self._spawned)
            began = spawning.Event()
            self._pool = ProcessPoolExecutor(
                min(self.workers, ahead),
                mp_context=spawning,
                initializer=_begin_worker,
                initargs=(began, self.threads),
            )
            for job, future in _completed(self._pool, ahead, work, jobs, ended):
                broken = broken or isinstance(future.exception(), BrokenExecutor)
                yield job, future
            # Nothing is under way any more; an interpreter takes its time to end by itself.
            codes = self.stop()
            # Python ends with this code if its script raises, and a signal with another.
            if broken and 1 in codes and not began.is_set():
                raise InputError(
                    "no worker process can begin: each one runs the script that called this function again",
                    field="executor",
                    remedy="call the function only under `if __name__ == '__main__':`, in a script that is a file; "
                    "or set executor='sequential'",
                )

    def stop(self) -> list[int | None]:
        """End all processes, and return their exit codes; unfinished scenes have no outputs or temporary files."""
        if self._pool is not None:
            self._pool.shutdown(wait=False, cancel_futures=True)
        started = [process for process in self._spawned if _is_started(process)]
        for process in started:
            with contextlib.suppress(ValueError):
                process.terminate()
        until, codes = time.monotonic() + _LEAVE, []
        for process in started:
            with contextlib.suppress(ValueError):
                process.join(max(0.0, until - time.monotonic()))
                # A signal reaches a job only between two calls of compiled code.
                process.kill()
                codes.append(process.exitcode)
        self._spawned.clear()
        return codes


def _is_started(process: SpawnProcess) -> bool:
    """Return whether a process was started and is not closed."""
    try:
        return process.pid is not None
    except ValueError:
        return False


class InGroups:
    """An executor to which short jobs travel together, as many as take a few seconds; fewer towards the end.

    A task of a scheduler costs some milliseconds: messages, bookkeeping, a future.

    Parameters
    ----------
    executor : Executor
        Not shut down here.
    slots : int
        Tasks that it works on at once when it begins.
    """

    def __init__(self, executor: Executor, slots: int = 1) -> None:
        self._executor, self._slots = executor, max(1, slots)

    def completed(
        self, work: Callable[[Job], Outcome], jobs: Iterable[Job], ended: Future[Any]
    ) -> Generator[tuple[Job, Future[Outcome]]]:
        """Yield jobs and their finished futures, group by group in the order in which they end, until `ended` is set.

        Nobody knows how long a job takes before the second one of a worker has ended, for the first one loads what it
        needs; so few are handed over before. What a group did not begin within its time is handed over anew. The
        jobs of a group that was lost are done again one by one: only a job that kills its worker ends with
        `WorkerDied`.
        """
        rest, alone, size, answers = deque(jobs), deque[Job](), 1, 0
        waiting: dict[Future[Any], tuple[Job, ...]] = {}
        try:
            while True:
                while len(waiting) < (_AHEAD if answers > self._slots else 2 * self._slots):
                    if not (alone or rest):
                        break
                    # The last jobs are shared out among all, not held by one.
                    fair = -(-len(rest) // (2 * self._slots))
                    source, count = (alone, 1) if alone else (rest, min(size, fair))
                    group = tuple(source.popleft() for _ in range(count))
                    waiting[_submitted(self._executor, _work_through, (work, group))] = group
                if not waiting:
                    return
                seconds = []
                wait([*waiting, ended], return_when=FIRST_COMPLETED)
                if ended.done():
                    return
                for future in [future for future in waiting if future.done()]:
                    group, answers = waiting.pop(future), answers + 1
                    if _error_of(future) is None:
                        took, futures = future.result()
                        seconds.append(took)
                        rest.extend(group[len(futures) :])
                        yield from zip(group, map(_finished, futures), strict=False)
                    elif len(group) > 1:
                        alone.extend(group)
                    else:
                        yield group[0], _died(future)
                if seconds:
                    size = max(1, min(_MOST_TOGETHER, int(_TOGETHER / max(min(seconds), 1e-6))))
        finally:
            for future in waiting:
                future.cancel()


def _work_through(batch: tuple[Callable[[Job], Outcome], Sequence[Job]]) -> tuple[float, list[tuple[Any, Any]]]:
    """Do some jobs one after the other, until twice their time is over.

    Returns
    -------
    seconds : float
        Of one job, in the mean.
    list
        Of each job that was done its result or its exception.
    """
    work, jobs = batch
    begin, done = time.monotonic(), list[tuple[Any, Any]]()
    for job in jobs:
        future = Sequential().submit(work, job)
        error = future.exception()
        done.append((future.result() if error is None else None, error))
        if time.monotonic() - begin > 2 * _TOGETHER:
            break
    return (time.monotonic() - begin) / len(done), done


def _finished(done: tuple[Any, BaseException | None]) -> Future[Any]:
    future: Future[Any] = Future()
    result, error = done
    if error is None:
        future.set_result(result)
    else:
        future.set_exception(error)
    return future


class _Spawning(SpawnContext):
    """Spawns processes and remembers them, to be able to end them."""

    def __init__(self, spawned: list[SpawnProcess]) -> None:
        super().__init__()
        self._spawned = spawned

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]  # noqa: N802
        """Return a new process, as `multiprocessing` names this method."""
        process = SpawnProcess(*args, **kwargs)
        self._spawned.append(process)
        return process


def _begin_worker(began: Event, threads: int) -> None:
    began.set()
    start_worker(threads)


def start_worker(threads: int) -> None:
    """Prepare a worker process: threads, signals, imports; it ends when its parent does."""
    for name in _THREADS:
        os.environ[name] = str(threads)
    # Ctrl-C goes to all processes of the terminal; what happens then is for the parent to decide.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    print_no_error_twice()
    require_memory()
    startable_threads(1)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    import ortho_pipeline.commands.rectification
    import ortho_pipeline.warp.lattice_engine  # noqa: F401


def _until_terminated(work: Callable[[Job], Outcome], job: Job) -> Outcome:
    """Do a job; a signal that ends the process lets the job remove its temporary files first."""
    try:
        with ended_by_signals():
            return work(job)
    except Terminated as ended:
        os._exit(ended.code)


def _end_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


#: Who does the work of a run.
Crew = Executor | Processes | InGroups


def completed(
    executor: Crew, work: Callable[[Job], Outcome], jobs: Iterable[Job]
) -> Iterator[tuple[Job, Future[Outcome]]]:
    """Yield jobs and their finished futures, in the order in which they end; a job's exception is its future's.

    An executor of the caller that breaks takes the rest of the jobs with it.
    """
    ended: Future[Any] = Future()
    if isinstance(executor, Sequential):
        for job in jobs:
            yield job, executor.submit(work, job)
    elif isinstance(executor, Processes | InGroups):
        yield from _apart(executor.completed(work, jobs, ended), ended)
    else:
        yield from _apart(_of_the_caller(executor, work, iter(jobs), ended), ended)


def _apart(source: Generator[Item], ended: Future[Any]) -> Iterator[Item]:
    """Yield what a generator yields that runs in a thread of its own until `ended` is set.

    Signals interrupt the main thread alone. In the middle of a call to a pool, they would leave one of its locks taken.
    The threads of the pool would wait for that lock without end.
    """
    asked, given = SimpleQueue[bool](), SimpleQueue[tuple[Item, None] | tuple[None, BaseException]]()

    def advance() -> None:
        with contextlib.closing(source):
            while asked.get():
                try:
                    given.put((next(source), None))
                except BaseException as error:
                    given.put((None, error))

    thread = threading.Thread(target=advance, name="pool", daemon=True)
    thread.start()
    try:
        while True:
            asked.put(True)
            item, error = given.get()
            if isinstance(error, StopIteration):
                return
            if error is not None:
                raise error
            yield cast(Item, item)
    finally:
        ended.set_result(None)
        asked.put(False)
        thread.join()


def _of_the_caller(
    executor: Executor, work: Callable[[Job], Outcome], jobs: Iterator[Job], ended: Future[Any]
) -> Generator[tuple[Job, Future[Outcome]]]:
    for job, future in _completed(executor, _AHEAD, work, jobs, ended):
        yield job, _died(future)
    for job in () if ended.done() else jobs:
        yield job, _died(_submitted(executor, work, job))


def _completed(
    executor: Executor, ahead: int, work: Callable[[Job], Outcome], jobs: Iterator[Job], ended: Future[Any]
) -> Iterator[tuple[Job, Future[Outcome]]]:
    waiting: dict[Future[Outcome], Job] = {}
    try:
        broken = False
        while True:
            for job in () if broken else jobs:
                waiting[_submitted(executor, work, job)] = job
                if len(waiting) >= ahead:
                    break
            if not waiting:
                return
            wait([*waiting, ended], return_when=FIRST_COMPLETED)
            if ended.done():
                return
            for future in [future for future in waiting if future.done()]:
                broken = broken or isinstance(_error_of(future), BrokenExecutor)
                yield waiting.pop(future), future
    finally:
        for future in waiting:
            future.cancel()


def _submitted(executor: Executor, work: Callable[[Job], Outcome], job: Job) -> Future[Outcome]:
    try:
        return executor.submit(work, job)
    except BrokenExecutor as error:
        failed: Future[Outcome] = Future()
        failed.set_exception(error)
        return failed


def _error_of(future: Future[Any]) -> BaseException | None:
    """Return the exception of a finished future.

    Raises
    ------
    OrthoError
        If the executor has cancelled it.
    """
    if future.cancelled():
        raise OrthoError(
            "the executor cancelled the work, as dask does when its scheduler ends",
            field="scheduler",
            remedy="start the scheduler, then run again: what is finished is kept",
        )
    return future.exception()


def _died(future: Future[Outcome]) -> Future[Outcome]:
    """Return the future; the death of a worker becomes an error with a remedy."""
    error = future.exception()
    if not isinstance(error, BrokenExecutor) and type(error).__name__ != "KilledWorker":
        return future
    failed: Future[Outcome] = Future()
    failed.set_exception(
        WorkerDied(
            "the process of this scene was killed",
            remedy=Text("give it more memory, or ", Setting("workers", "1")),
        )
    )
    return failed


def dask_executor(scheduler: str) -> Any:
    """Return the client and an executor over the workers of a dask scheduler.

    Raises
    ------
    InputError
        If dask is not installed, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(
            "dask is not installed",
            field="scheduler",
            remedy=installing("dask"),
        ) from error
    try:
        client = Client(scheduler, timeout=_PATIENCE, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"cannot connect to the dask scheduler at {scheduler!r} ({error or type(error).__name__})",
            field="scheduler",
            remedy="give its address, for example tcp://host:8786",
        ) from error
    return client, client.get_executor(pure=False)


@contextlib.contextmanager
def crew_of(
    executor: str | Executor | None, workers: int | None, threads: int | None, scheduler: str | None, jobs: int
) -> Iterator[tuple[Crew, int | None]]:
    """Yield the executor, and the threads of each scene."""
    if scheduler is not None and executor not in ("dask", None):
        raise InputError(
            "only dask has a scheduler",
            field="scheduler",
            remedy=Text("leave out ", Setting("executor"), ", or set it to dask"),
        )
    if isinstance(executor, Executor):
        yield executor, threads or 1
    elif executor == "dask" or scheduler is not None:  # a scheduler alone means dask
        if scheduler is None:
            raise InputError(
                "dask needs the address of its scheduler",
                field="scheduler",
                remedy="give it, for example tcp://host:8786",
            )
        client, pool = dask_executor(scheduler)
        with client:
            slots = sum(client.nthreads().values())
            if not slots:
                _log.warning("The dask scheduler at %s has no workers. Waiting for a worker.", scheduler)
            yield InGroups(pool, slots), threads or 1
    elif executor == "sequential":
        yield Sequential(), threads
    elif executor in ("processes", None):
        processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        count = max(1, min(workers or processors, jobs))
        budget = threads or max(1, processors // count)
        yield Processes(count, budget), budget
    else:
        raise InputError(f"there is no executor {executor!r}", field="executor", remedy=", ".join(EXECUTORS))
