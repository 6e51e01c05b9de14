"""What data hold reaches the terminal as printable text of a bounded length."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.machine.terminal import LONGEST, printable
from ortho_pipeline.cli.program import cli

ESCAPES = "\x1b]0;title\x07\x1b[2J\x9b31m\u202e\r"


@pytest.mark.parametrize(
    "text", ["\x1b[31m", "a\rb", "\x07", "\x9b2J", "\x7f", "\u202eabc", "\ud800", "\u2028", "\x00"]
)
def test_control_characters_are_shown_as_escapes(text: str) -> None:
    shown = printable(text)
    assert all(one.isprintable() for one in shown)
    shown.encode()


def test_text_of_people_is_shown_as_it_is() -> None:
    for text in (
        "a\nb\tc",
        "größe 28.2 m ± 3 °",
        "場所",
        "Remedy: x\n  y",
        "'quoted' \\ `surface.dem`",
        "scene \U0001f6f0",
    ):
        assert printable(text) == text


def test_long_text_is_cut_and_says_so() -> None:
    shown = printable("x" * 40_000)
    assert len(shown) < LONGEST + 100
    assert "40000" in shown


@pytest.mark.parametrize("json", [False, True])
def test_a_message_about_data_has_no_control_characters_and_an_end(json: bool, tmp_path: Path) -> None:
    table = tmp_path / f"p{ESCAPES[1:8]}\x1b[2J.csv"
    table.write_text(f"id,col,row,{ESCAPES.strip()},{'y' * 40_000},h\n" + "a,1,2,10,50,0\n", encoding="utf-8")
    image = Path(__file__).resolve().parents[2] / "sample_data" / "scene.tif"
    typed = ["fit", str(image), "--gcps", str(table), *(["--json"] if json else [])]
    done = CliRunner().invoke(cli, typed)
    assert done.exit_code == 2
    for shown in (done.stderr, done.stdout):
        assert not set(shown) & set("\x1b\x07\x9b\u202e\r\x00")
    assert len(done.stderr) < 10_000


#: What runs with closed streams; it has no quotation marks of the shell.
CLOSED = """
import os, subprocess, sys
from ortho_pipeline.cli.program import main
sys.argv = ["ortho", "--version"]
try:
    main()
finally:
    number = os.open(os.environ["HERE"], os.O_CREAT | os.O_WRONLY)
    inner = "import sys; sys.exit(None in (sys.stdin, sys.stdout, sys.stderr))"
    code = subprocess.call([sys.executable, "-c", inner])
    os.write(number, f"{number} {sys.stderr.isatty()} {code}".encode())
"""


def test_no_file_takes_the_number_of_a_stream_that_is_closed(tmp_path: Path) -> None:
    """Else what libraries print would be in an output. Worker processes have all streams, too."""
    closed = f"exec {sys.executable} -c '{CLOSED}' 0<&- 1>&- 2>&-"
    done = subprocess.run(["sh", "-c", closed], check=False, env={**os.environ, "HERE": str(tmp_path / "file")})
    assert done.returncode == 0
    assert (tmp_path / "file").read_text() == "3 False 0"


def test_an_error_of_a_stdout_that_takes_nothing_is_a_message() -> None:
    for words, message, code in (("cache list", "Error: cannot write", 1), ("cache", "Usage: ", 2)):
        line = f"exec {sys.executable} -m ortho_pipeline {words} --json > /dev/full"
        done = subprocess.run(["sh", "-c", line], check=False, capture_output=True, text=True)
        assert (done.returncode, done.stderr[: len(message)]) == (code, message)
        assert "Traceback" not in done.stderr


def test_a_reader_who_has_left_is_no_fault_of_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # As in `ortho run pipeline.yaml | head -1`.
    (tmp_path / "a.tif").write_text("no image")
    (tmp_path / "p.yaml").write_text("scenes:\n  - {image: a.tif, surface: {height: 10.0}}\n")
    typed = ["run", str(tmp_path / "p.yaml"), "--executor", "sequential"]
    reader, writer = os.pipe()
    os.close(reader)
    left = os.fdopen(writer, "w")
    with contextlib.redirect_stdout(left), pytest.raises(SystemExit, match="1"):
        cli.main(typed, standalone_mode=False)
    assert "bug" not in capsys.readouterr().err
    with contextlib.suppress(BrokenPipeError):
        left.close()
