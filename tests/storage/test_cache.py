"""The local cache of remote files: each is complete and has its record, even if a process is killed or others run."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from dying import SOURCE

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import confined, together, write_text
from ortho_pipeline.stores import local_cache
from ortho_pipeline.stores.objects import Content

ADDRESS = "https://example.org/cells/N37E033.tif"
DATA = b"heights"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(local_cache.FOLDER, str(tmp_path / "cache"))
    return tmp_path / "cache"


def fetched(path: Path) -> Content:
    path.write_bytes(DATA)
    return Content(len(DATA), hashlib.sha256(DATA).hexdigest(), (), None)


def not_fetched(path: Path) -> Content:
    raise AssertionError("this file is kept already")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


#: Fetches a file and dies at the k-th call of the system that changes the folder.
DYING = f"""{SOURCE}
import hashlib, sys
from ortho_pipeline.stores import local_cache
from ortho_pipeline.stores.objects import Content
def fetched(path):
    path.write_bytes(b"heights")
    return Content(7, hashlib.sha256(b"heights").hexdigest(), (), None)
die_at(int(sys.argv[1]))
local_cache.kept("dem", sys.argv[2], fetched)
"""


def test_killed_at_any_moment_the_next_command_finds_or_fetches_it(cache: Path) -> None:
    ended = []
    for deadline in range(1, 60):
        address = f"{ADDRESS}{deadline}"
        ended.append(subprocess.run([sys.executable, "-c", DYING, str(deadline), address], check=False).returncode)
        assert {one.state() for one in local_cache.records()} <= {"sound"}
        file = local_cache.kept("dem", address, fetched)
        assert file.read_bytes() == DATA
        # A list of renames that are all done may be left, until the next one who writes or removes the file.
        left = set(names(cache)) - {file.name, f"{file.name}.json"}
        assert all(name.endswith((".journal.part", ".lock.part")) for name in left)
        assert local_cache.kept("dem", address, not_fetched) == file
        assert local_cache.clear() == (1, len(DATA))
        assert names(cache) == []
        if ended[-1] == 0:
            break
    assert set(ended) == {0, 7}
    assert len(ended) > 10


def test_it_is_no_part_of_the_outputs_that_are_under_way(cache: Path, tmp_path: Path) -> None:
    """It is written outside of their folder, and stays where they fail."""

    def fail() -> None:
        with confined(tmp_path / "out"), together(tmp_path / "out", "scene"):
            write_text(tmp_path / "out" / "scene.txt", "new")
            assert local_cache.kept("dem", ADDRESS, fetched).read_bytes() == DATA
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert len(names(cache)) == 2
    assert not (tmp_path / "out").exists()
    local_cache.kept("dem", ADDRESS, not_fetched)


def test_who_needs_what_another_one_fetches_waits_for_it(cache: Path) -> None:
    begun, proceed, found = threading.Event(), threading.Event(), list[Path]()

    def slowly(path: Path) -> Content:
        begun.set()
        assert proceed.wait(20)
        return fetched(path)

    threads = [threading.Thread(target=lambda: found.append(local_cache.kept("dem", ADDRESS, slowly)))]
    threads[0].start()
    assert begun.wait(20)
    threads += [
        threading.Thread(target=lambda: found.append(local_cache.kept("dem", ADDRESS, not_fetched))) for _ in range(3)
    ]
    for thread in threads[1:]:
        thread.start()
    proceed.set()
    for thread in threads:
        thread.join(20)
    assert len(found) == 4
    assert {path.read_bytes() for path in found} == {DATA}
    assert len(names(cache)) == 2


def test_what_is_not_there_or_not_sound_is_not_kept(cache: Path) -> None:
    def missing(path: Path) -> Content:
        raise FileNotFoundError(2, "there is no such object", ADDRESS)

    with pytest.raises(FileNotFoundError):
        local_cache.kept("dem", ADDRESS, missing)
    with pytest.raises(InputError, match="not valid: no heights"):
        local_cache.kept("dem", ADDRESS, fetched, fault=lambda path: "no heights")
    assert names(cache) == []
    assert local_cache.kept("dem", ADDRESS, fetched).read_bytes() == DATA


def test_where_nothing_can_be_kept_the_remedy_names_the_variable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv(local_cache.FOLDER, str(tmp_path / "file" / "cache"))
    with pytest.raises(InputError, match="cannot write here") as refused:
        local_cache.kept("dem", ADDRESS, fetched)
    assert local_cache.FOLDER in str(refused.value.remedy)

    def full(path: Path) -> Content:
        raise OSError(28, os.strerror(28))

    monkeypatch.setenv(local_cache.FOLDER, str(tmp_path / "cache"))
    with pytest.raises(InputError, match="No space left") as refused:
        local_cache.kept("dem", ADDRESS, full)
    assert local_cache.FOLDER in str(refused.value.remedy)
