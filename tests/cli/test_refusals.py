"""What the command line refuses: every option of every command, given what it cannot mean, is named with a remedy."""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from ortho_pipeline.cli.program import cli

BAD = "no such thing!"


def options(group: click.Group, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Option]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
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
    """Options whose values are checked when the command runs: one is bad, the others are sound."""
    given = {"--output": str(tmp_path / "out"), "--gcps": str(tiny.gcps), "--points-crs": "EPSG:4979",
             "--points-vertical": "ellipsoid", "--dem": str(tiny.dem), "--dem-vertical": "ellipsoid"}  # fmt: skip
    params = [one for one in cli.get_command(click.Context(cli), command).params if isinstance(one, click.Option)]
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


#: More or less than numbers hold, or than squares and products of numbers do.
BEYOND = ("nan", "inf", "-inf", "Infinity", "1e400", "-1e400", "9" * 400, "9" * 5000, "1e-320", "-1e-320", "1e308",
          "-1e300", "1e-300")  # fmt: skip
#: Numbers that stand in a text: the words around them.
IN_TEXTS = {
    "--check": "every:{}", "--select": "even:{}", "--ridge": "{}", "--dem-fill": "{}", "--ground-sigma": "{}",
    "--crop-offset": "{},0", "--shard": "1/{}", "--edge": "0,0,{},5", "--resolution": "{},{}", "--memory": "{}",
}  # fmt: skip
NUMERIC = (click.types.FloatParamType, click.types.IntParamType, click.IntRange, click.FloatRange)


def required(words: tuple[str, ...], but: click.Option) -> list[str]:
    """Return words for what a command has to be given, besides one option."""
    command: click.Command = cli
    for word in words:
        command = command.get_command(click.Context(command), word)
    found = []
    for one in command.params:
        if one.required and one is not but:
            found += [one.opts[0], BAD] if isinstance(one, click.Option) else [BAD]
    return found


def of_numbers() -> Iterator[tuple[tuple[str, ...], click.Option, str]]:
    for words, one in options(cli):
        form = "{}" if isinstance(one.type, NUMERIC) else IN_TEXTS.get(one.opts[0])
        # The others are read by the command itself.
        if form is not None and not (isinstance(one.type, click.types.StringParamType) and one.callback is None):
            yield words, one, form


def test_no_number_beyond_numbers_is_taken_by_any_option():
    tried = set()
    for words, one, form in of_numbers():
        # What reads a value is shared by the commands that have an option.
        for text in BEYOND[::6] if one.opts[0] in tried else BEYOND:
            given = [form.format(text, text)] * max(one.nargs, 1)
            error = document([*words, *required(words, one), one.opts[0], *given])
            assert named(error, one), (words, one.opts, text[:10], error)
            assert error["remedy"], (words, one.opts, text[:10], error)
        tried.add(one.opts[0])
    # Nodata alone may be NaN; it is no option of the kinds above.
    assert len(tried) >= 20, tried


@pytest.mark.parametrize("text", [text for text in BEYOND if text != "nan"])
def test_nodata_may_be_nan_and_nothing_else_of_that_kind(tmp_path, text):
    error = document(["rectify", "a.tif", "-o", str(tmp_path / "out"), "--nodata", text])
    assert error["field"] == "--nodata"


def test_more_memory_than_a_machine_has_is_a_misprint(tmp_path):
    for command in (["rectify", "a.tif", "-o", str(tmp_path / "out")], ["run", "a.yaml"]):
        assert document([*command, "--memory", f"{10**15 - 1}GB"])["field"] == "--memory"


@pytest.mark.parametrize(
    ("command", "words", "field"),
    [
        ("fit", ("--ridge", "{}", "--fit-model", "rfm1"), "--ridge"),
        ("fit", ("--check", "every:{}"), "--check"),
        ("fit", ("--select", "even:{}"), "--select"),
        ("fit", ("--select", "random:3:{}"), "--select"),
        ("fit", ("--dem", "DEM", "--dem-vertical", "ellipsoid", "--dem-fill", "{}"), "--dem-fill"),
        ("edge", ("--edge", "0,0,{},5"), "--edge"),
    ],
)
def test_no_number_beyond_numbers_is_taken_within_a_text(tiny, command, words, field):
    points = ["--gcps", str(tiny.gcps), "--points-crs", "EPSG:4979", "--points-vertical", "ellipsoid"]
    for text in BEYOND:
        given = [str(tiny.dem) if word == "DEM" else word.format(text) for word in words]
        error = document([command, str(tiny.image), *(points if command == "fit" else ()), *given])
        assert named({**error, "field": f"--{error['field'].lstrip('-')}"}, click.Option([field])), (words, text, error)
        assert error["remedy"]


def test_no_number_beyond_numbers_is_a_sigma_of_ground(sample, tmp_path):
    stereo = [str(sample / "cartosat" / name) for name in ("BANDF.tif", "BANDA.tif")]
    rays = ["--points", str(sample / "cartosat" / "points.csv"), "--model", "rpc", "-o", str(tmp_path / "out")]
    for text in BEYOND[::4]:
        assert document(["adjust", *stereo, *rays, "--ground-sigma", f"1,{text}"])["field"] == "--ground-sigma"


@pytest.mark.parametrize("text", ["1e99", "1e13"])
def test_a_pixel_larger_than_the_earth_is_none(tiny, tmp_path, text):
    box = ["-te", "530600", "4122000", "530700", "4122100"]
    words = ["rectify", str(tiny.image), "--height", "500", *box, "-o", str(tmp_path / "out"), "--resolution", text]
    assert "is not a pixel size" in document(words)["message"]


@pytest.mark.parametrize("box", [("-1e99", "0", "1e99", "1"), ("0", "0", "1e60", "1"), ("1e20", "0", "2e20", "1")])
def test_an_extent_beyond_what_numbers_tell_apart_is_none(tiny, tmp_path, box):
    words = ["rectify", str(tiny.image), "--height", "500", "-tr", "5", "5", "-o", str(tmp_path / "out"), "-te", *box]
    assert "is not an extent" in document(words)["message"]


@pytest.mark.parametrize("words", [["--reference", ""], ["--reference="], ["-t_srs", ""], ["-o", ""], ["--gcps="]])
def test_an_empty_value_is_refused_and_not_taken_for_no_option(tiny, tmp_path, words):
    command = ["rectify", str(tiny.image), "--dem", str(tiny.dem), "-o", str(tmp_path), "--dry-run", *words]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 2
    assert f"The value of '{words[0].rstrip('=')}' is empty" in done.stderr


@pytest.mark.parametrize("command", ["stack", "align"])
def test_paths_that_the_system_refuses_are_named_and_no_bug(command, monkeypatch, tmp_path):
    """Folders above it that may not be entered, links that lead in a circle, names that are too long."""
    place = tmp_path / ("x" * 300 + "*.tif" if command == "stack" else "moved.tif")
    if command == "align":

        def refuse(*given: object, **named: object) -> None:
            raise PermissionError(errno.EACCES, "Permission denied", str(place))

        monkeypatch.setattr("ortho_pipeline.commands.orthos.aligning.measure_ortho", refuse)
    error = document([command, str(place), "--reference", str(place), "-o", str(tmp_path / "out")])
    assert error["file"] == str(place)
    assert error["message"].startswith("cannot access this file or folder (")
    assert "permissions" in error["remedy"]
