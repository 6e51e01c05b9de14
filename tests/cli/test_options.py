"""An option is stated once, in `options`: the command line, its help and the docstrings come from there."""

from __future__ import annotations

import dataclasses
import json
import pickle
import re

import click
import pytest
from click.testing import CliRunner

from ortho_pipeline import commands
from ortho_pipeline.batch.records import RunRecord
from ortho_pipeline.cli.flags import FLAGS, flags_of, with_flags
from ortho_pipeline.cli.program import cli
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError, error_document
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.options import GROUPS, BlockOptions, SurfaceOptions, options_of


def command_of(name: str) -> click.Command:
    command = cli.get_command(click.Context(cli), name)
    assert command is not None
    return command


def params(command: str) -> dict[str, click.Option]:
    return {str(one.name): one for one in command_of(command).params if isinstance(one, click.Option)}


@pytest.mark.parametrize(
    ("command", "group", "options"),
    [*(("rectify", *one) for one in GROUPS.items()), ("adjust", "points", BlockOptions)],
)
def test_every_field_is_an_option_with_its_flags_and_default(command: str, group: str, options: type) -> None:
    known = params(command)
    for one in dataclasses.fields(options):
        stated = options_of(options)[one.name]
        param = known[f"{group}_{one.name}"]
        assert set(param.opts) == set(stated.flags.split())
        help_text = with_flags(stated.help, FLAGS)
        assert help_text.removesuffix(".") in (param.help or "")
        if isinstance(one.default, str | float) and one.default is not False and stated.kind != "bytes":
            assert param.default == one.default
        assert f"\n{one.name} : " in (options.__doc__ or "")


def test_a_flag_is_of_one_field_and_of_the_same_in_all_groups() -> None:
    taken: dict[str, str] = {}
    for group, options in GROUPS.items():
        for name, option in options_of(options).items():
            for flag in option.flags.split():
                assert taken.setdefault(flag, f"{group}.{name}") == f"{group}.{name}"
    for name, option in options_of(BlockOptions).items():
        other = options_of(GROUPS["points"]).get(name)
        assert other is None or other.flags == option.flags


def test_a_key_that_is_given_twice_is_refused(tmp_path) -> None:
    for words in (["-co", "LEVEL=1", "-co", "LEVEL=2"], ["--sensor-option", "a=1", "--sensor-option", "a=2"]):
        done = CliRunner().invoke(cli, ["rectify", "a.tif", "-o", str(tmp_path), *words])
        assert done.exit_code == 2
        assert "is given twice" in done.output


def test_names_of_options_are_shown_as_flags() -> None:
    flags = {"surface.height": "--height", "scene.sensor_options": "--sensor-option", "workers": "--workers"}
    named = Setting("surface.height", "500"), Setting("scene.sensor_options", "tag", key="rpc"), Setting("workers", "1")
    text = Text("give ", named[0], ", ", Text(named[1], ", ", named[2]), " or ", Setting("surface.dem", "FILE"))
    told = "give `surface.height=500`, `scene.sensor_options.rpc=tag`, `workers=1` or `surface.dem=FILE`"
    assert (text, json.dumps(text), Text.joined("; ", [text])) == (told, json.dumps(told), told)
    typed = "give --height 500, --sensor-option rpc=tag, --workers 1 or `surface.dem=FILE`"
    notice = Notice("a-code", text).in_image("left")
    error = InputError("wrong", remedy=text)
    for again in (text, *pickle.loads(pickle.dumps([text, error.remedy])), Text.read(told), Text.joined("", [text])):
        assert with_flags(again, flags) == typed
    for again in (notice, pickle.loads(pickle.dumps(notice)), json_value(notice.to_json())["text"]):
        assert with_flags(again, flags) == f"image left: {typed}"
    assert pickle.loads(pickle.dumps(error)).remedy.parts == error.remedy.parts
    # What a file says is no option of ours.
    assert with_flags(told, flags) == told


def test_errors_that_come_back_from_a_record_name_options_as_they_are_typed(tmp_path) -> None:
    refused = error_document(InputError("far away", remedy=Text("allow it with ", Setting("scene.allow_network"))))
    RunRecord(name="scene", key="", status="failed", error=refused).write(tmp_path / "record.json")
    found = RunRecord.at(tmp_path / "record.json")
    assert found is not None
    assert found.error == refused
    assert found.error is not None
    assert with_flags(found.error["remedy"], flags_of(command_of("run"))) == "allow it with --allow-network"


def test_an_error_names_options_as_the_caller_knows_them(tiny, tmp_path) -> None:
    with pytest.raises(InputError) as caught:
        commands.rectify(tiny.image, tmp_path / "out", surface=SurfaceOptions(dem=tiny.dem, height=3))
    assert caught.value.field == "surface.height"
    assert caught.value.message == "`surface.dem` and `surface.height` cannot be used together"
    words = ["rectify", str(tiny.image), "-o", str(tmp_path / "out"), "--dem", str(tiny.dem), "--height", "3", "--json"]
    done = CliRunner().invoke(cli, words)
    error = json.loads(done.stdout)["error"]
    assert (error["field"], error["message"]) == ("--height", "--dem and --height cannot be used together")
    assert "--height: --dem and --height cannot be used together" in done.stderr
    # The pipeline file has keys, the command that reads it some options of its own.
    (tmp_path / "block").mkdir()
    (tmp_path / "block" / "p.yaml").write_text(
        f"scenes: [{{image: '{tiny.image}', surface: {{dem: '{tiny.dem}', height: 3}}}}]\noutput: out\n"
    )
    words = ["run", str(tmp_path / "block" / "p.yaml"), "--executor", "sequential"]
    refused = CliRunner().invoke(cli, words)
    assert "--root" in refused.stderr
    assert "`root" not in refused.stderr
    done = CliRunner().invoke(cli, [*words, "--root", "/"])
    assert "`surface.dem` and `surface.height` cannot be used together" in done.output


def test_every_flag_of_a_command_has_a_name() -> None:
    for command in map(command_of, cli.list_commands(click.Context(cli))):
        names = flags_of(command)
        typed = {one.opts[0] for one in command.params if isinstance(one, click.Option)}
        assert typed == set(names.values())
    assert flags_of(command_of("edge"))["output.bands"] == "--band"
    assert flags_of(command_of("run"))["output.memory"] == "--memory"
    assert "surface.dem" not in flags_of(command_of("run"))
    assert flags_of(command_of("adjust"))["points.model"] == "--model"
    assert "scene.model" not in flags_of(command_of("adjust"))


def test_every_option_says_what_it_does() -> None:
    """`-r` of align and stack showed its choices only."""
    for name in cli.list_commands(click.Context(cli)):
        for one in command_of(name).params:
            if isinstance(one, click.Option):
                text = (one.help or "").partition("[default")[0]
                assert re.match(r"[A-Z'].{8,}\.", text, re.DOTALL), (name, one.opts)


@pytest.mark.parametrize("words", [("--dem", "a.tif", "--dem", "b.tif"), ("--dem=a.tif", "--dem", "a.tif")])
def test_a_second_dem_is_refused_and_not_used_alone(tiny, words) -> None:
    done = CliRunner().invoke(cli, ["rectify", str(tiny.image), *words])
    assert done.exit_code == 2
    assert "'--dem' is given twice, and takes one file. Name the files of one DEM by a pattern" in done.stderr
    done = CliRunner().invoke(cli, ["rectify", str(tiny.image), "--dem", "a.tif", "--", "--dem", "b.tif"])
    assert "twice" not in done.stderr
