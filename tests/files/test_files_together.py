"""The outputs of a command appear together: killed at any moment, the next command finds or makes one whole set."""

from __future__ import annotations

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from dying import SOURCE

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import staged, together, whole_or_nothing, write_text

NAMES = [f"scene{number}.txt" for number in range(4)]
OBSOLETE = "scene_old.txt"

#: Writes a set of files and dies at the k-th call of the system that changes the folder.
DYING = f"""{SOURCE}
import sys
from pathlib import Path
folder = Path(sys.argv[1])
from ortho_pipeline.files import whole as files
calls = die_at(int(sys.argv[2]))
with files.together(folder, "scene") as outputs:
    outputs.obsolete.append(folder.resolve() / "scene_old.txt")
    for number in range(4):
        files.write_text(folder / f"scene{{number}}.txt", "new")
print(calls())
"""


def run(code: str, *given: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *given], check=False, capture_output=True, text=True)


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_killed_at_any_moment_the_next_command_finds_one_whole_set(tmp_path):
    old = dict.fromkeys([*NAMES, OBSOLETE], "old")
    new = dict.fromkeys(NAMES, "new")
    seen = set()
    for deadline in range(1, 60):
        folder = tmp_path / str(deadline)
        folder.mkdir()
        for name, text in old.items():
            (folder / name).write_text(text)
        done = run(DYING, str(folder), str(deadline))
        assert done.returncode in (0, 7), done.stderr
        with together(folder, "scene"):
            pass
        found = contents(folder)
        assert found in (old, new), deadline
        seen.add(found == new)
        if done.returncode == 0:
            break
    assert done.returncode == 0
    assert int(done.stdout) < deadline
    assert seen == {True, False}


def test_a_failure_leaves_all_old_files(tmp_path):
    for name in NAMES:
        (tmp_path / name).write_text("old")

    def fail() -> None:
        with together(tmp_path, "scene"):
            for name in NAMES:
                write_text(tmp_path / name, "new")
            assert staged(tmp_path / NAMES[0]).read_text() == "new"
            assert (tmp_path / NAMES[0]).read_text() == "old"
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert contents(tmp_path) == dict.fromkeys(NAMES, "old")


def test_a_folder_made_for_nothing_goes(tmp_path):
    def fail() -> None:
        with together(tmp_path / "a" / "b", "scene"):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not list(tmp_path.iterdir())


def test_two_commands_for_the_same_outputs_notice_each_other(tmp_path):
    other = "import sys; from ortho_pipeline.files import together\nwith together(sys.argv[1], sys.argv[2]): pass"
    with together(tmp_path, "scene"):
        write_text(tmp_path / "scene.txt", "mine")
        same = run(other, str(tmp_path), "scene")
        assert "another command is writing 'scene' in this folder" in same.stderr
        apart = run(other, str(tmp_path), "scene2")
        assert apart.returncode == 0, apart.stderr
    assert contents(tmp_path) == {"scene.txt": "mine"}


def test_a_journal_of_somebody_else_leads_nowhere(tmp_path):
    folder, victim = tmp_path / "out", tmp_path / "victim"
    victim.write_text("precious")
    with together(folder, "scene") as outputs:
        journal, lock, prefix = outputs.journal, outputs.lock_path, outputs.prefix
        write_text(folder / "a.txt", "a")
    for listed in (
        {"renames": [[f"{prefix}x.part", "../victim"]], "obsolete": []},
        {"renames": [], "obsolete": ["../victim"]},
        {"renames": [["../victim", "b.txt"]], "obsolete": []},
        {"renames": [["a.txt", "b.txt"]], "obsolete": []},
        {"renames": [[1, 2]], "obsolete": {}},
        [],
        # Each of these ended every later command with "cannot write here" before, or with an error of no type.
        {"renames": [], "obsolete": [""]},
        {"renames": [], "obsolete": [".."]},
        {"renames": [], "obsolete": ["a" * 300]},
        {"renames": [], "obsolete": ["\0"]},
        {"renames": [], "obsolete": ["\ud800"]},
        {"renames": [[f"{prefix}x.part", ".."]], "obsolete": []},
    ):
        (folder / f"{prefix}x.part").write_text("evil")
        journal.write_text(json.dumps(listed))
        lock.touch()
        with together(folder, "scene"):
            pass
        assert victim.read_text() == "precious"
        assert contents(folder) == {"a.txt": "a"}
    lock.symlink_to(victim)
    with pytest.raises(InputError, match="this is a symbolic link"), together(folder, "scene"):
        pass
    assert victim.read_text() == "precious"


@pytest.mark.parametrize("make", ["folder", "long"])
def test_odd_output_paths_are_typed_errors(tmp_path, make):
    path = tmp_path / ("x" * 300 if make == "long" else "a.txt")
    if make == "folder":
        path.mkdir()
    before = sorted(tmp_path.iterdir())
    with pytest.raises(InputError, match=r"folder with this name|too long"):
        write_text(path, "x")
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_that_links_to_itself_is_a_typed_error(tmp_path):
    (tmp_path / "a").symlink_to(tmp_path / "b")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    with pytest.raises(InputError, match=r"cannot be resolved|cannot write here|this is a symbolic link"):
        write_text(tmp_path / "a" / "x.txt", "x")


def test_a_name_as_long_as_the_file_system_allows_is_written(tmp_path):
    write_text(tmp_path / ("x" * 251 + ".txt"), "x")
    assert len(list(tmp_path.iterdir())) == 1


def test_a_full_disk_is_a_typed_error(tmp_path):
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full")

    def write(folder: Path) -> None:
        with whole_or_nothing(folder / "a.txt") as temporary:
            temporary.unlink()
            temporary.symlink_to("/dev/full")
            temporary.write_text("x" * 100_000)

    with pytest.raises(InputError, match="No space left"):
        write(tmp_path)
    assert not list(tmp_path.iterdir())


def test_files_have_the_rights_that_the_user_gives(tmp_path):
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "a.txt", "a")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "a.txt").stat().st_mode) == 0o640
