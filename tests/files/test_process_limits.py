"""Little memory and few threads are an error at once, and never a command that waits without end."""

from __future__ import annotations

import os
import platform
import resource
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.runtime.process_limits import (
    MOST_THREADS,
    parts_of,
    require_memory,
    side_by_side,
    startable_threads,
    thread_pool,
)

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
EXTENT = ("530600", "4122000", "530800", "4122200")


def limited(words: list[str], folder: Path, limits: str) -> subprocess.CompletedProcess[str]:
    """Run a command under limits of the shell: those on stacks are those of threads in what the shell starts."""
    line = f'{limits}; exec "$0" -m ortho_pipeline "$@"'
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        ["bash", "-c", line, sys.executable, *words], check=False, capture_output=True, text=True, timeout=60,
        cwd=folder, env=env,
    )  # fmt: skip


def rectify() -> list[str]:
    names = [str(SAMPLE / name) for name in ("scene.tif", "gcps.geojson", "dem.tif")]
    return ["rectify", names[0], "--gcps", names[1], "--dem", names[2], "-te", *EXTENT, "-o", "out"]


def test_without_threads_a_command_ends_with_what_to_do(tmp_path):
    # Every thread wants a stack of 64 GB, of 16 GB that there are; GDAL's pool waited for its threads without end.
    ended = limited(rectify(), tmp_path, "ulimit -s $((64 << 20)) && ulimit -v $((16 << 20))")
    assert ended.returncode == 1, ended.stderr
    assert "no thread can be started" in ended.stderr
    assert "Remedy: raise the limits" in ended.stderr
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix == ".tif"]


def test_less_memory_than_the_budget_is_said_before_the_work():
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + (400 << 20), hard))
    try:
        require_memory()
        with pytest.raises(OrthoError, match="not enough memory") as raised:
            require_memory(512_000_000, threads=2)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert "`output.memory=MB`" in str(raised.value.remedy)


def test_a_count_that_no_system_has_does_not_take_all_that_it_has():
    # Some 30,000 threads were tried for `--threads 2147483647`, for minutes.
    assert 1 <= startable_threads(2**31) <= MOST_THREADS


def test_threads_that_are_tried_are_gone_afterwards():
    before = threading.active_count(), len(os.listdir("/proc/self/task"))
    assert startable_threads(5) == 5
    assert threading.active_count() == before[0]


@pytest.mark.parametrize("megabytes", [90, *(pytest.param(one, marks=pytest.mark.slow) for one in (150, 170))])
def test_a_run_with_little_memory_ends_within_seconds(tmp_path, megabytes):
    # Beside what is loaded already: GDAL and Python's threads waited for each other with 151 and 170 MB.
    line = (
        "import sys; sys.path.insert(0, sys.argv[1]); import faults; faults.load(); from pathlib import Path; "
        "ended = faults.run(sys.argv[4:], Path(sys.argv[2]), faults.limit_memory(int(sys.argv[3]) << 20)); "
        "print(ended.code, ended.hung, ended.said)"
    )
    tools = str(Path(__file__).parents[1] / "attack")
    words = [sys.executable, "-c", line, tools, str(tmp_path), str(megabytes), *rectify()]
    ended = subprocess.run(words, check=False, capture_output=True, text=True, timeout=60)
    assert ended.stdout.startswith("1 False"), ended.stdout + ended.stderr
    assert "not enough memory: the limit of this process leaves" in ended.stdout


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="heaps of threads are glibc's")
def test_threads_share_a_heap() -> None:
    """A heap of a thread is a reservation of 64 MB that begins at a multiple of that."""
    code = (
        "import sys, threading, time, pathlib\n"
        "from ortho_pipeline.runtime.process_limits import share_freed_memory\n"
        "if len(sys.argv) > 1: assert share_freed_memory()\n"
        "kept, ready = [], threading.Barrier(5)\n"
        "def hold(): kept.append([bytearray(60_000) for _ in range(9)]); ready.wait(); ready.wait()\n"
        "for _ in range(4): threading.Thread(target=hold, daemon=True).start()\n"
        "ready.wait()\n"
        "maps = [line.split() for line in pathlib.Path('/proc/self/maps').read_text().splitlines()]\n"
        "print(sum(int(one[0].split('-')[0], 16) % (64 << 20) == 0 and len(one) == 5 for one in maps))\n"
        "ready.wait()"
    )
    heaps = [
        int(
            subprocess.run(
                [sys.executable, "-c", code, *more],
                capture_output=True,
                text=True,
                check=True,
                env={key: value for key, value in os.environ.items() if key != "MALLOC_ARENA_MAX"},
            ).stdout
        )
        for more in ((), ("shared",))
    ]
    assert heaps[0] >= 2
    assert heaps[1] == 0


def _start_no_more_than(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no more threads run at once, as a limit of the system does."""
    start = threading.Thread.start

    def limited(thread: threading.Thread) -> None:
        if threading.active_count() > most:
            raise RuntimeError("can't start new thread")
        start(thread)

    monkeypatch.setattr(threading.Thread, "start", limited)


def test_a_pool_has_no_more_threads_than_can_be_started(monkeypatch: pytest.MonkeyPatch) -> None:
    _start_no_more_than(threading.active_count() + 1, monkeypatch)
    names = set()

    def work(number: int) -> int:
        names.add(threading.current_thread().name.rpartition("_")[0])
        return number

    with thread_pool(6, "named") as pool:
        assert list(pool.map(work, range(50))) == list(range(50))
    assert names == {"named"}


@pytest.mark.parametrize("most", [0, 1, 4])
@pytest.mark.parametrize("threads", [None, 1, 3])
def test_each_part_of_a_work_is_done_once(monkeypatch: pytest.MonkeyPatch, most: int, threads: int | None) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 4)
    _start_no_more_than(threading.active_count() + most - 1, monkeypatch)
    parts, done = parts_of(1003, 10), list[tuple[int, int, int]]()
    side_by_side(lambda *job: done.append(job), parts, threads)
    side_by_side(lambda *job: done.append(job), [], threads)
    assert sorted(done) == [(number, *part) for number, part in enumerate(parts)]
    assert len(parts) == 8


def test_what_fails_in_a_part_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)

    def work(number: int, _begin: int, _end: int) -> None:
        if number == 5:
            raise ZeroDivisionError(number)

    with pytest.raises(ZeroDivisionError, match="5"):
        side_by_side(work, parts_of(80, 10))
