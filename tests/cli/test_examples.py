"""Every command has an example in its help, and every example is run in a copy of the sample data."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import click
import make_commands
import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli
from ortho_pipeline.cli.survey.examples import EXAMPLES

ROOT = Path(__file__).resolve().parent.parent.parent
#: What takes seconds.
SLOW = ("match", "stack", "ties", "--reference", "edge", "register", "sharpen")
#: What has to be there before.
BEFORE = {
    "verify": ["ortho rectify scene.tif --gcps gcps.geojson --dem dem.tif -o out"],
    "stack": [
        "ortho rectify scene.tif --dem dem.tif -tr 5 5 -o raw",
        "ortho rectify scene.tif --gcps gcps.geojson --dem dem.tif -tr 5 5 -o fitted",
        "ortho mosaic raw/scene_ortho.tif -o series/ortho_20240105.tif",
        "ortho mosaic fitted/scene_ortho.tif -o series/ortho_20240310.tif",
    ],
    "mosaic": [
        f"ortho rectify scene.tif --height 800 -t_srs EPSG:32636 -tr 10 10 -te {box} -o {name}"
        for name, box in (("west", "530000 4121500 532000 4123500"), ("east", "531000 4121500 533000 4123500"))
    ],
    "sharpen": [
        f"ortho rectify scene.tif --height 800 -t_srs EPSG:32636 {options} -te 530000 4121500 533000 4124500 -o {name}"
        for name, options in (("pan", "-tr 10 10"), ("ms", "-tr 40 40 -r average -b 1,1"))
    ],
}
LINES = [(words, line) for words, examples in EXAMPLES.items() for _, line in examples]


def is_slow(line: str) -> bool:
    return any(word in shlex.split(line) for word in SLOW)


def commands(group: click.Group, *words: str) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """Return all commands with their words."""
    context = click.Context(group, info_name="ortho")
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        if isinstance(command, click.Group):
            yield from commands(command, *words, name)
        else:
            yield (*words, name), command


def test_every_command_has_an_example_in_its_help():
    found = {" ".join(words): command for words, command in commands(cli)}
    assert set(EXAMPLES) <= set(found)
    for words, command in found.items():
        text = CliRunner().invoke(cli, [*words.split(), "--help"], prog_name="ortho").output
        assert "Examples:\n\n      # " in text, words
        typed = [line.strip() for line in text.splitlines() if line.strip().startswith(f"ortho {words} ")]
        assert typed or f"ortho {words}\n" in text, words
        for line in typed:
            command.make_context(words, shlex.split(line)[1 + len(words.split()) :], resilient_parsing=False)


def test_the_pages_of_commands_say_of_each_option_when_one_needs_it():
    told = [name for needs in make_commands.NEEDS.values() for name in needs]
    assert len(told) == len(set(told))
    found = {
        make_commands.long_name(option)
        for words, command in commands(cli)
        if words[0] not in make_commands.PLAIN
        for option in command.params
        if isinstance(option, click.Option)
    }
    assert found == set(told)
    by_command: dict[str, set[str]] = {}
    for words, command in commands(cli):
        names = {make_commands.long_name(option) for option in command.params if isinstance(option, click.Option)}
        by_command.setdefault(words[-1], set()).update(names)
    for command, needs in make_commands.OTHERWISE.items():
        assert needs.keys() <= by_command[command], command


def test_every_yes_of_ours_is_a_command_that_is_run():
    """Of the table of docs/comparison.md: each command, with its options, stands in a tutorial or an example."""
    from sessions import steps

    run = [shlex.split(line) for _, line in LINES]
    for page in (ROOT / "docs" / "tutorials").glob("*.md"):
        run += [shlex.split(step.command) for step in steps(page) if step.command.startswith("ortho ")]
    table = (ROOT / "docs" / "comparison.md").read_text(encoding="utf-8").partition("## Which")[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines() if line.startswith("| ")]
    assert len(rows) > 20
    assert all(len(row) == 6 for row in rows)
    ours = [row[1] for row in rows if row[1].startswith("yes")]
    assert len(ours) > 10
    for cell in ours:
        shown = re.findall(r"`(ortho [^`]+)`", cell)
        linked = re.findall(r"\]\(([^)]+)\)", cell)
        assert shown or linked, cell
        for command in shown:
            words = set(shlex.split(command))
            assert any(words <= set(line) for line in run), command


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """A copy of the sample data, in which one works."""
    for name in ("scene.tif", "scene_RPC.TXT", "dem.tif", "gcps.geojson", "gcps.csv", "reference.tif"):
        shutil.copy(ROOT / "sample_data" / name, tmp_path)
    for name, original in (("red.tif", "scene.tif"), ("nir.tif", "scene.tif"), ("red_RPC.TXT", "scene_RPC.TXT")):
        shutil.copy(ROOT / "sample_data" / original, tmp_path / name)
    for name in ("cartosat", "orbview3"):
        shutil.copytree(ROOT / "sample_data" / name, tmp_path / name)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ORTHO_CACHE", str(tmp_path / "cache"))
    return tmp_path


def play(lines: list[tuple[str, str]]) -> None:
    for words, line in lines:
        for one in (*BEFORE.get(words, ()), line):
            done = CliRunner().invoke(cli, shlex.split(one)[1:], prog_name="ortho")
            assert done.exit_code == 0, f"{one}\n{done.output}"


@pytest.mark.usefixtures("folder")
def test_examples_run():
    play([(words, line) for words, line in LINES if not is_slow(line)])


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_long_examples_run():
    play([(words, line) for words, line in LINES if is_slow(line)])
