"""Run the console sessions of a page: what a reader types after ``$``, and what the page says comes back.

A page has them in blocks of the language ``console``. Commands of `ortho` run in this process, others in a shell, all
of them in one folder. In the answer ``...`` stands for anything, and blanks and line ends are alike, as in doctests. A
block with a title (``yaml title="coast/pipeline.yaml"``) is a file that the reader writes; one after the comment
``slow`` is left out of short runs.
"""

from __future__ import annotations

import contextlib
import doctest
import re
import shlex
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner

from ortho_pipeline.cli.program import cli

_BLOCK = re.compile(
    r'(?P<slow>^<!-- slow -->\n)?^```(?:console|\w+ title="(?P<file>[^"\n]+)")\n(?P<text>.*?)^```',
    re.DOTALL | re.MULTILINE,
)
_FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
_STATUS = "echo $?"


@dataclass(frozen=True)
class Step:
    """A command as it is typed, what the page says it answers, and where; or a file and its text."""

    command: str
    answer: str
    line: int
    file: str | None = None
    slow: bool = False


@dataclass(frozen=True)
class Done:
    """A step that ran: what it answered, and what is wrong with that (nothing, or a text)."""

    step: Step
    answer: str
    wrong: str | None


def steps(page: Path) -> list[Step]:
    """Return the commands of a page in order; a line that ends with a backslash goes on in the next one."""
    text, found = page.read_text(encoding="utf-8"), []
    for block in _BLOCK.finditer(text):
        first = text.count("\n", 0, block.start("text")) + 1
        if block["file"]:
            found.append(Step(f"(write {block['file']})", block["text"], first, block["file"], bool(block["slow"])))
            continue
        lines = block["text"].splitlines()
        starts = [k for k, line in enumerate(lines) if line.startswith("$ ")]
        for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
            last = start
            while lines[last].endswith("\\"):
                last += 1
            typed = " ".join(line.removesuffix("\\").strip() for line in lines[start : last + 1])
            answer = "\n".join(lines[last + 1 : end]) + "\n"
            found.append(Step(typed.removeprefix("$ "), answer, first + start, slow=bool(block["slow"])))
    return found


def run(page: Path, folder: Path, *, slow: bool = True) -> Iterator[Done]:
    """Run the commands of a page in `folder`, which has to hold what they read; all, or those that are not `slow`."""
    status, todo = 0, [step for step in steps(page) if slow or not step.slow]
    for step, following in zip(todo, [*todo[1:], None], strict=True):
        if step.file:
            (folder / step.file).write_text(step.answer, encoding="utf-8")
            answer = step.answer
        elif step.command == _STATUS:
            answer = f"{status}\n"
        else:
            status, answer = _answer(step.command, folder)
        wrong = None
        if not doctest.OutputChecker().check_output(step.answer, answer, _FLAGS):
            example = doctest.Example(step.command, step.answer)
            wrong = doctest.OutputChecker().output_difference(example, answer, _FLAGS | doctest.REPORT_NDIFF)
        elif status and step.command != _STATUS and (following is None or following.command != _STATUS):
            wrong = f"it ended with {status}, and the page does not ask"
        yield Done(step, answer, wrong)


def _answer(command: str, folder: Path) -> tuple[int, str]:
    """Return the exit code and what was printed on stdout and stderr."""
    first, _, rest = command.partition(" | ")
    if not first.startswith("ortho "):
        done = subprocess.run(["bash", "-c", command], cwd=folder, capture_output=True, text=True, check=False)
        return done.returncode, done.stdout + done.stderr
    with contextlib.chdir(folder):
        result = CliRunner().invoke(cli, shlex.split(first)[1:], prog_name="ortho")
    if not rest:
        return result.exit_code, result.output
    done = subprocess.run(
        ["bash", "-c", rest], input=result.output, cwd=folder, capture_output=True, text=True, check=False
    )
    return result.exit_code, done.stdout + done.stderr
