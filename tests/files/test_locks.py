"""Locks of files: who holds one keeps others out, links are not followed, and file systems without locks are known."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from pathlib import Path

import pytest
from ortho_measure.journal import Journal

from ortho_pipeline.batch.records import locked
from ortho_pipeline.errors import InputError
from ortho_pipeline.files import Lock, Outputs, append_line, together, write_text
from ortho_pipeline.stores import local_cache
from ortho_pipeline.stores.objects import Content

#: What a process asks that wants a file for itself.
_ALONE = fcntl.LOCK_EX | fcntl.LOCK_NB


def fetched(path: Path) -> Content:
    path.write_bytes(b"heights")
    return Content(7, "6d27e20df1d53b6e8f7fe3bd0b12b9c5b5ebd0a0a2a3a6c0e6a2a6c0e6a2a6c0", (), None)


@contextlib.contextmanager
def seen_by_others(path: Path, held: bool):
    """Look at a lock by the system's own call."""
    with path.open("rb") as file:
        if held:
            with pytest.raises(BlockingIOError):
                fcntl.flock(file, _ALONE)
        else:
            fcntl.flock(file, _ALONE)
        yield


def test_a_lock_keeps_others_out_until_it_is_closed(tmp_path):
    path = tmp_path / "lock"
    lock = Lock(path)
    with seen_by_others(path, held=True), pytest.raises(BlockingIOError):
        Lock(path, wait=False)
    lock.close()
    with seen_by_others(path, held=False):
        pass


def test_readers_share_a_lock_and_a_writer_does_not(tmp_path):
    path = tmp_path / "lock"
    with (
        contextlib.closing(Lock(path, shared=True)),
        contextlib.closing(Lock(path, shared=True, wait=False)),
        pytest.raises(BlockingIOError),
    ):
        Lock(path, wait=False)
    with contextlib.closing(Lock(path)), pytest.raises(BlockingIOError):
        Lock(path, shared=True, wait=False)


def test_what_a_file_holds_stays(tmp_path):
    path = tmp_path / "lock"
    path.write_text("who holds it")
    Lock(path).close()
    assert path.read_text() == "who holds it"


def test_what_cannot_be_appended_whole_leaves_nothing(tmp_path, monkeypatch):
    path, write = tmp_path / "log", os.write
    append_line(path, "first")

    def full(file: int, data: bytes) -> int:
        if len(data) < 10:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, data[:8])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(InputError, match="No space left"):
        append_line(path, "second, of which some bytes are written")
    monkeypatch.undo()
    append_line(path, "third")
    assert path.read_text() == "first\nthird\n"


def _output(folder: Path) -> None:
    with together(folder, "scene"):
        write_text(folder / "scene.txt", "new")


def _run(folder: Path) -> None:
    with locked(folder / "run.lock"):
        pass


def _kept(folder: Path) -> None:
    os.environ[local_cache.FOLDER] = str(folder)
    local_cache.kept("dem", "https://example.org/cell.tif", fetched)


#: Everything that takes a lock in a folder.
TAKERS = {
    "outputs": _output,
    "log": lambda folder: append_line(folder / "log.txt", "a line"),
    "run": _run,
    "journal": lambda folder: Journal(folder / "p.journal").close(),
    "cache": _kept,
}


@pytest.mark.parametrize("taker", TAKERS)
def test_a_link_in_place_of_a_lock_is_not_followed(tmp_path, monkeypatch, taker):
    monkeypatch.setenv(local_cache.FOLDER, "")
    # Which files it locks, as the system is asked.
    names, ask = [], fcntl.flock
    monkeypatch.setattr(
        fcntl, "flock", lambda file, how: (names.append(os.readlink(f"/proc/self/fd/{file}")), ask(file, how))
    )
    free = tmp_path / "free"
    free.mkdir()
    TAKERS[taker](free)
    place = tmp_path / "linked" / Path(names[0]).relative_to(free)
    place.parent.mkdir(parents=True)
    place.symlink_to(tmp_path / "victim")
    with pytest.raises((InputError, OSError)):
        TAKERS[taker](tmp_path / "linked")
    assert not (tmp_path / "victim").exists()


@pytest.mark.parametrize("taker", TAKERS)
def test_a_file_system_without_locks(tmp_path, monkeypatch, taker):
    def refuse(file: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setenv(local_cache.FOLDER, "")
    monkeypatch.setattr(fcntl, "flock", refuse)
    before = len(os.listdir("/proc/self/fd"))
    if taker in ("outputs", "cache"):
        TAKERS[taker](tmp_path)
        assert [path.name for path in tmp_path.rglob("*") if path.name.startswith(".")] == []
    else:
        with pytest.raises(InputError, match="No locks available"):
            TAKERS[taker](tmp_path)
    assert len(os.listdir("/proc/self/fd")) == before


def test_without_locks_nothing_of_another_command_is_removed(tmp_path, monkeypatch):
    """Two commands do not notice each other there, and neither takes the other for one that was killed."""

    def refuse(file: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with together(tmp_path, "scene") as outputs:
        write_text(tmp_path / "scene.txt", "mine")
        left = outputs.staged[tmp_path.resolve() / "scene.txt"]
        assert left.is_file()
        # As another process begins it: the block that is under way is not known there.
        other = Outputs(tmp_path.resolve(), "scene")
        other.begin()
        assert left.is_file()
        other.end(failed=False)
    assert (tmp_path / "scene.txt").read_text() == "mine"
