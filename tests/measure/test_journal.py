"""The journal: what was acknowledged is there after any end of the process, and the file is never damaged."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ortho_measure.journal import Journal
from ortho_measure.marks import History

from ortho_pipeline.errors import InputError


def put(name: str, column: float = 10.25) -> dict:
    mark = {"id": name, "image": [column, 20.5], "ground": [33.0, 37.0, 900.125], "note": "é\n\u2028"}
    return {"do": "put", "mark": mark}


@pytest.fixture
def written(tmp_path: Path) -> Path:
    path = tmp_path / "p.geojson.journal"
    journal = Journal(path)
    for number in range(20):
        journal.append(put(f"P{number}", number + 1 / 3))
    journal.close()
    return path


def test_a_journal_gives_back_what_was_appended(written: Path) -> None:
    journal = Journal(written)
    assert journal.actions == [put(f"P{number}", number + 1 / 3) for number in range(20)]
    assert (journal.healed, journal.read_only) == (0, False)
    journal.close()


def test_cut_off_at_any_byte_it_loses_the_last_action_at_most(written: Path) -> None:
    data = written.read_bytes()
    chosen = random.Random(1)
    for cut in [*(chosen.randrange(len(data) + 1) for _ in range(120)), 0, 1, len(data) - 1, len(data)]:
        # A power cut may leave the length without the bytes.
        for rest in (b"", b"\0" * 7):
            written.write_bytes(data[:cut] + rest)
            journal = Journal(written)
            whole = data[:cut].count(b"\n")
            assert journal.actions == [put(f"P{number}", number + 1 / 3) for number in range(whole)]
            journal.append(put("after"))
            journal.close()
            again = Journal(written)
            assert again.actions[-1] == put("after")
            assert len(again.actions) == whole + 1
            again.close()


@pytest.mark.parametrize("replaced", [False, True])
def test_a_journal_that_was_moved_takes_no_action_until_it_is_back(written: Path, replaced: bool) -> None:
    """What was written to it went with it, or was lost with a deleted one."""
    journal, aside = Journal(written), written.with_name("aside")
    written.rename(aside)
    if replaced:
        written.write_bytes(aside.read_bytes())
    with pytest.raises(InputError, match="moved, deleted or replaced") as caught:
        journal.append(put("lost"))
    assert caught.value.file == str(written)
    assert "`" not in caught.value.remedy, "the page shows it, and knows no flags"
    aside.replace(written)
    journal.append(put("kept"))
    journal.close()
    assert [action["mark"]["id"] for action in Journal(written).actions][-2:] == ["P19", "kept"]


def test_a_line_that_is_wrong_before_the_end_is_an_error_and_nothing_is_changed(written: Path) -> None:
    data = bytearray(written.read_bytes())
    data[len(data) // 2] ^= 1
    written.write_bytes(data)
    with pytest.raises(InputError, match="damaged") as refused:
        Journal(written)
    assert "line 1" in str(refused.value.field)
    assert written.read_bytes() == bytes(data)


def test_a_second_process_reads_and_does_not_write(written: Path) -> None:
    first = Journal(written)
    second = Journal(written)
    assert (first.read_only, second.read_only) == (False, True)
    assert len(second.actions) == 20
    with pytest.raises(InputError, match="another ortho measure process"):
        second.append(put("X"))
    first.close()
    third = Journal(written)
    assert not third.read_only
    second.close()
    third.close()


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "other").write_text("precious")
    (tmp_path / "p.journal").symlink_to(tmp_path / "other")
    with pytest.raises(InputError):
        Journal(tmp_path / "p.journal")
    assert (tmp_path / "other").read_text() == "precious"


WRITES = """
import sys
from pathlib import Path
from ortho_pipeline.files import write_json
from ortho_measure.journal import Journal
from ortho_measure.marks import History
folder = Path(sys.argv[1])
journal, history = Journal(folder / "p.geojson.journal"), History()
for action in journal.actions:
    history.take(history.after(action))
print("begun", flush=True)
for number in range(len(journal.actions), 100000):
    action = {"do": "put", "mark": {"id": f"P{number}", "image": [number / 7, 2.0], "ground": [33.0, 37.0, 9.0]}}
    step = history.after(action)
    journal.append(action)
    history.take(step)
    print(number, flush=True)
    write_json(folder / "p.geojson", history.marks.document("p"))
"""


def killed(folder: Path, seconds: float) -> int:
    """Write until killed after some time; return the number of the last action that was acknowledged."""
    process = subprocess.Popen([sys.executable, "-c", WRITES, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    shown = process.stdout.read().splitlines()
    process.wait()
    return int(shown[-1]) if shown else -1


def check_kills(folder: Path, count: int) -> None:
    chosen, last = random.Random(2), -1
    for _ in range(count):
        last = max(last, killed(folder, chosen.uniform(0.0, 0.15)))
        journal = Journal(folder / "p.geojson.journal")
        assert len(journal.actions) in (last + 1, last + 2), "an action that was shown is lost"
        history = History()
        for action in journal.actions:
            history.take(history.after(action))
        assert len(history.marks.by_id) == len(journal.actions)
        journal.close()
        last = len(journal.actions) - 1
        if (folder / "p.geojson").exists():
            found = json.loads((folder / "p.geojson").read_text())
            assert len(found["features"]) <= last + 1


def test_killed_at_random_moments(tmp_path: Path) -> None:
    check_kills(tmp_path, 2)


@pytest.mark.slow
def test_killed_at_fifty_random_moments(tmp_path: Path) -> None:
    check_kills(tmp_path, 50)
