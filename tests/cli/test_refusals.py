"""What the command line refuses: every option of every command, given what it cannot mean, is named with a remedy."""

from __future__ import annotations

import json
from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli

BAD = "no such thing!"


def options(group: click.Group, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Option]]:
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from options(command, (*words, name))
            continue
        for one in command.params:
            if isinstance(one, click.Option) and not one.is_flag and not one.count:
                yield (*words, name), one


def typed() -> list[tuple[tuple[str, ...], click.Option]]:
    plain = (click.types.StringParamType, click.Path)
    return [(words, one) for words, one in options(cli) if not isinstance(one.type, plain)]


def document(words: list[str]) -> dict[str, str]:
    done = CliRunner().invoke(cli, [*words, "--json"])
    assert done.exit_code == 2, (words, done.output, done.exception)
    return json.loads(done.stdout)["error"]


def named(error: dict[str, str], one: click.Option) -> bool:
    known = (*one.opts, *one.secondary_opts)
    return error["field"] in known or BAD in str(error["file"]) or any(name in error["message"] for name in known)


def test_every_typed_option_names_itself_and_a_remedy():
    tried = 0
    for words, one in typed():
        error = document([*words, one.opts[0], *[BAD] * max(one.nargs, 1)])
        assert named(error, one), (words, one.opts, error)
        assert error["remedy"], (words, one.opts, error)
        tried += 1
    assert tried > 40


@pytest.mark.parametrize("command", ["fit", "rectify", "export"])
def test_texts_and_files_that_are_none(tiny, tmp_path, command):
    """Options whose values are looked at when the command works, each one bad beside the others that are sound."""
    given = {"--output": str(tmp_path / "out"), "--gcps": str(tiny.gcps), "--points-crs": "EPSG:4979",
             "--points-vertical": "ellipsoid", "--dem": str(tiny.dem), "--dem-vertical": "ellipsoid"}  # fmt: skip
    params = [one for one in cli.commands[command].params if isinstance(one, click.Option)]
    known = {opt for one in params for opt in one.opts}
    tried = 0
    for one in params:
        plain = isinstance(one.type, click.types.StringParamType | click.Path) and not one.is_flag
        # Of these nothing is wrong: a folder's name, and what is only looked at with points alone.
        if not plain or set(one.opts) & {"--output", "--model-crs"}:
            continue
        more = [word for name, value in given.items() if name in known and name not in one.opts
                for word in (name, value)]  # fmt: skip
        error = document([command, str(tiny.image), *more, one.opts[0], BAD])
        assert named(error, one), (one.opts, error)
        assert error["remedy"], (one.opts, error)
        tried += 1
    assert tried >= 8
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    ("command", "words", "flag"),
    [
        ("rectify", ("--height", "0", "--dem-vertical", "ellipsoid"), "--dem-vertical"),
        ("rectify", ("--height", "0", "--dem-fill", "nearest"), "--dem-fill"),
        ("fit", ("--dem-vertical", "ellipsoid"), "--dem-vertical"),
        ("compare", ("--override-dem-vertical",), "--override-dem-vertical"),
        ("export", ("--dem-fill", "100"), "--dem-fill"),
        ("rectify", ("--height", "0", "--acquired", "2005-08-03T08:12:31Z"), "--acquired"),
        ("compare", ("--fit-model", "dlt"), "--fit-model"),
        ("compare", ("--correction", "shift"), "--correction"),
    ],
)
def test_what_would_have_no_effect_is_refused(tiny, tmp_path, command, words, flag):
    given = ["--gcps", str(tiny.gcps), "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]
    out = ["-o", str(tmp_path / "out")] if command in ("rectify", "export") else []
    error = document([command, str(tiny.image), *given, *out, *words])
    assert error["field"] == flag
    assert error["remedy"]
    assert not (tmp_path / "out").exists()
