"""Outputs under way: parts of them, retired files, temporary names, journals and folders that confine them."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import Lock, Outputs, locks, part_of_outputs, retire, staged, together, whole_or_nothing
from ortho_pipeline.files.whole import allowed, append_line, clear_up, confined, write_text


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_part_that_fails_goes_and_what_was_complete_before_stays(tmp_path: Path) -> None:
    def part() -> None:
        with part_of_outputs():
            write_text(tmp_path / "b.txt", "b")
            write_text(tmp_path / "a.txt", "changed")
            raise ZeroDivisionError

    with together(tmp_path, "scene") as outputs:
        write_text(tmp_path / "first.txt", "first")
        with part_of_outputs():
            write_text(tmp_path / "a.txt", "a")
        with pytest.raises(ZeroDivisionError):
            part()
        assert staged(tmp_path / "b.txt") == tmp_path / "b.txt"
        assert set(outputs.staged) == {tmp_path.resolve() / name for name in ("first.txt", "a.txt")}
    assert set(contents(tmp_path)) == {"first.txt", "a.txt"}
    # Without outputs under way each file stands for itself.
    with pytest.raises(ZeroDivisionError):
        part()
    assert contents(tmp_path)["b.txt"] == "b"


def test_a_file_that_is_written_twice_is_the_later_one(tmp_path: Path) -> None:
    with together(tmp_path, "scene"):
        write_text(tmp_path / "a.txt", "one")
        write_text(tmp_path / "a.txt", "two")
        assert staged(tmp_path / "a.txt").read_text() == "two"
        assert len([path for path in tmp_path.iterdir() if path.suffix == ".txt"]) == 1
    assert contents(tmp_path) == {"a.txt": "two"}
    assert staged(tmp_path / "a.txt") == tmp_path / "a.txt"


def test_retired_files_go_with_the_outputs_unless_they_are_among_them(tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    for path in (tmp_path / "a.txt", tmp_path / "b.txt", other / "c.txt"):
        path.write_text("old")
    retire([tmp_path / "a.txt"])
    with together(tmp_path, "scene"):
        retire([tmp_path / "a.txt", tmp_path / "b.txt", tmp_path / "none.txt", other / "c.txt"])
        write_text(tmp_path / "a.txt", "new")
        assert (tmp_path / "b.txt").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "other"]
    assert (tmp_path / "a.txt").read_text() == "new"
    assert (other / "c.txt").read_text() == "old"


def test_several_changes_have_a_journal_and_one_has_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    renames, replace = list[str](), os.replace
    monkeypatch.setattr(os, "replace", lambda old, new: (renames.append(Path(new).name), replace(old, new)))
    with together(tmp_path, "one"):
        write_text(tmp_path / "a.txt", "a")
    assert renames == ["a.txt"]
    for retired in (False, True):
        renames.clear()
        with together(tmp_path, "two") as outputs:
            write_text(tmp_path / "b.txt", "b")
            if retired:
                retire([tmp_path / "a.txt"])
            else:
                write_text(tmp_path / "c.txt", "c")
        assert renames == [outputs.journal.name, "b.txt", *([] if retired else ["c.txt"])]
    assert set(contents(tmp_path)) == {"b.txt", "c.txt"}


def test_the_renames_of_a_killed_command_are_completed(tmp_path: Path) -> None:
    made = Outputs(tmp_path.resolve(), "scene")
    (tmp_path / f"{made.prefix}1.part.txt").write_text("new")
    (tmp_path / f"{made.prefix}2.part").write_text("half")
    for name in ("a.txt", "old.txt", "kept.txt"):
        (tmp_path / name).write_text("old")
    made.journal.write_text(json.dumps({"renames": [[f"{made.prefix}1.part.txt", "a.txt"]], "obsolete": ["old.txt"]}))
    clear_up(tmp_path / "scene")
    assert made.journal.exists(), "without its lock nobody was killed"
    made.lock_path.touch()
    clear_up(tmp_path / "scene")
    assert contents(tmp_path) == {"a.txt": "new", "kept.txt": "old"}


def test_outputs_that_cannot_be_cleared_up_are_not_locked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise a process would be told, at its next attempt, that another command is writing."""
    made = Outputs(tmp_path.resolve(), "scene")
    (tmp_path / f"{made.prefix}1.part").write_text("half")
    made.lock_path.touch()
    unlink = Path.unlink

    def refuse(path: Path, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "unlink", refuse)
    for _ in range(2):
        with pytest.raises(InputError, match="cannot write here"), together(tmp_path, "scene"):
            pass
    monkeypatch.setattr(Path, "unlink", unlink)
    with together(tmp_path, "scene"):
        write_text(tmp_path / "a.txt", "a")
    assert contents(tmp_path) == {"a.txt": "a"}


@pytest.mark.parametrize(("suffix", "kept"), [("." + "x" * 38, True), ("." + "x" * 39, False), ("", True)])
def test_drivers_go_by_the_suffix_of_a_temporary_name(tmp_path: Path, suffix: str, kept: bool) -> None:
    with whole_or_nothing(tmp_path / f"a{suffix}") as temporary:
        temporary.write_text("a")
        assert temporary.parent == tmp_path.resolve()
        assert temporary.name.endswith(".part" + (suffix if kept else ""))
    assert contents(tmp_path) == {f"a{suffix}": "a"}


def test_side_cars_of_drivers_go_and_files_of_others_stay(tmp_path: Path) -> None:
    with whole_or_nothing(tmp_path / "a.tif") as temporary:
        temporary.write_text("a")
        Path(f"{temporary}.aux.xml").write_text("side-car")
    (tmp_path / ".other.part").write_text("other")
    with whole_or_nothing(tmp_path / "b.tif") as temporary:
        temporary.write_text("b")
    assert contents(tmp_path) == {"a.tif": "a", "b.tif": "b", ".other.part": "other"}


def test_a_device_or_pipe_is_not_replaced(tmp_path: Path) -> None:
    """As root `-o /dev/null` or `-o /dev/full` left a plain file in the place of the device."""
    pipe = tmp_path / "ortho.tif"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="a device, a pipe or a socket"):
        write_text(pipe, "content")
    assert pipe.is_fifo()
    assert list(tmp_path.iterdir()) == [pipe]


def test_nothing_is_written_outside_of_the_folder_that_confines(tmp_path: Path) -> None:
    inside, link = tmp_path / "in", tmp_path / "link"
    inside.mkdir()
    link.symlink_to(inside)
    with confined(link):
        # By its name, and by where that leads.
        for path in (link / "a.txt", inside / "a.txt"):
            assert allowed(path) == inside.resolve() / "a.txt"
        for path in (tmp_path / "a.txt", link / ".." / "a.txt"):
            with pytest.raises(InputError, match="outside the output folder"):
                write_text(path, "a")
        (inside / "sub").symlink_to(tmp_path)
        with pytest.raises(InputError, match="symbolic link"):
            write_text(inside / "sub" / "a.txt", "a")
    write_text(tmp_path / "a.txt", "a")
    assert (tmp_path / "a.txt").exists()


def test_a_line_is_appended_with_its_end(tmp_path: Path) -> None:
    for line in ("one", "zwei ü", "half \ud800"):
        append_line(tmp_path / "log", line)
    assert (tmp_path / "log").read_bytes() == "one\nzwei ü\nhalf \\ud800\n".encode()
    with pytest.raises(InputError, match="cannot write"):
        append_line(tmp_path / "none" / "log", "x")


class Windows:
    """Locks of bytes as `msvcrt` has them: another lock of any of these bytes is refused."""

    LK_NBLCK = 2

    def __init__(self, fault: int = errno.EACCES) -> None:
        self.taken: set[int] = set()
        self.fault = fault

    def locking(self, descriptor: int, mode: int, count: int) -> None:
        assert mode == self.LK_NBLCK
        begin = os.lseek(descriptor, 0, os.SEEK_CUR)
        wanted = set(range(begin, begin + count))
        if wanted & self.taken:
            raise OSError(self.fault, "denied")
        self.taken |= wanted


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> Windows:
    made = Windows()
    monkeypatch.setattr(locks, "fcntl", None)
    monkeypatch.setattr(locks.importlib, "import_module", lambda name: {"msvcrt": made}[name])
    return made


def test_locks_of_bytes_are_beyond_the_file_and_can_be_shared(tmp_path: Path, windows: Windows) -> None:
    path = tmp_path / "lock"
    readers = [Lock(path, shared=True, wait=False) for _ in range(64)]
    assert windows.taken == set(range(1 << 40, (1 << 40) + 64))
    for shared in (True, False):
        with pytest.raises(BlockingIOError):
            Lock(path, shared=shared, wait=False)
    windows.taken.clear()
    one = Lock(path, shared=True, wait=False)
    assert len(windows.taken) == 1
    with pytest.raises(BlockingIOError):
        Lock(path, wait=False)
    windows.taken.clear()
    alone = Lock(path, wait=False)
    assert len(windows.taken) == 64
    with pytest.raises(BlockingIOError):
        Lock(path, shared=True, wait=False)
    # What is written is at the place where the file is, not at that of its lock.
    os.write(alone.descriptor, b"held")
    assert path.read_bytes() == b"held"
    for lock in (*readers, one, alone):
        lock.close()


def test_a_lock_of_bytes_waits_until_it_is_free(
    tmp_path: Path, windows: Windows, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, pauses = Lock(tmp_path / "lock"), list[float]()

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            windows.taken.clear()

    monkeypatch.setattr(locks.time, "sleep", pause)
    second = Lock(tmp_path / "lock")
    assert len(pauses) == 3
    assert sum(pauses) < 0.1
    windows.fault = errno.EIO
    with pytest.raises(OSError, match="denied"):
        Lock(tmp_path / "lock")
    assert len(pauses) == 3
    for lock in (first, second):
        lock.close()


def test_a_file_that_only_its_owner_may_replace_leaves_all_outputs_as_they_were(tmp_path, monkeypatch) -> None:
    """In a folder such as /tmp the first outputs were new and the others old."""
    (tmp_path / "a.txt").write_text("old")
    tmp_path.chmod(0o1777)
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    with pytest.raises(InputError, match="belongs to another user"), together(tmp_path, "set"):
        write_text(tmp_path / "a.txt", "new")
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text() == "old"
