"""Commands that installed packages add to `ortho`: found, listed, called, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import make_man
import pytest
from click.shell_completion import ShellComplete
from click.testing import CliRunner, Result

from ortho_pipeline.cli.program import COMMANDS, cli
from ortho_pipeline.hookspecs import GROUPS

(GROUP,) = (group for group, hooks in GROUPS.items() if hooks == ("ortho_commands",))

DECLARED = """
from ortho_pipeline.hookspecs import Subcommand, hookimpl

@hookimpl
def ortho_commands():
    examples = (("How high is this DEM?", "ortho dem-height scene.tif --dem dem.tif"),)
    yield Subcommand({name!r}, "Show the height of the ground under IMAGE.", {target!r}, examples)
"""

COMMAND = """
import click
from ortho_pipeline.cli.machine.terminal import say
from ortho_pipeline.cli.options import image_argument, json_option, surface_options
from ortho_pipeline.cli.parsing import Command
from ortho_pipeline.cli.printing import print_json
from ortho_pipeline.errors import InputError

@click.command("dem-height", cls=Command)
@image_argument
@surface_options
@json_option
def command(image, surface, as_json):
    \"\"\"Show the height of the ground under IMAGE.

    In metres.
    \"\"\"
    if surface.height is None:
        raise InputError("there are no heights", field="surface.height", remedy="give `surface.height=M`")
    print_json({"height": surface.height}) if as_json else say(f"{image}: {surface.height} m")
"""


def run(*words: object) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words], prog_name="ortho")


@pytest.fixture
def program(install):
    """Return a function that installs a package with a command; the program looks for commands anew."""

    def added(source=None, distribution="third-party", module="third_party", command=COMMAND, name="dem-height"):
        code = f"{module}_command"
        install(f"{distribution}-code", code, command, group="nobody_asks")
        install(distribution, module, source or DECLARED.format(name=name, target=f"{code}:command"), group=GROUP)
        vars(cli).pop("added", None)

    yield added
    vars(cli).pop("added", None)
    cli.commands.pop("dem-height", None)


def test_a_command_of_a_package_is_like_any_other(program):
    program()
    listed = run("--help").stdout
    assert "\n  dem-height  Show the height of the ground under IMAGE.\n" in listed
    assert listed.index("More commands:") < listed.index("dem-height")
    shown = run("dem-height", "--help").stdout
    assert "ortho dem-height [OPTIONS] IMAGE" in shown
    assert "# How high is this DEM?\n      ortho dem-height scene.tif --dem dem.tif" in shown
    assert run("dem-height", "a.tif", "--height", 5).stdout == "a.tif: 5.0 m\n"
    assert run("dem-height", "a.tif", "--height", 5, "-q").stdout == ""
    assert json.loads(run("dem-height", "a.tif", "--height", 5, "--json").stdout) == {"height": 5.0}
    assert "did you mean 'dem-height'?" in run("dem-heigt").stderr
    # What is said of options names them as they are typed.
    refused = run("dem-height", "a.tif", "--json")
    assert (refused.exit_code, json.loads(refused.stdout)["error"]["field"]) == (2, "--height")
    assert "did you mean '--height'?" in run("dem-height", "a.tif", "-height", "5").stderr


def test_shells_complete_it_and_it_has_a_manual_page(program):
    program()
    completion = ShellComplete(cli, {}, "ortho", "_ORTHO_COMPLETE")
    assert [one.value for one in completion.get_completions([], "dem-h")] == ["dem-height"]
    assert "--dem-vertical" in [one.value for one in completion.get_completions(["dem-height"], "--dem-v")]
    assert "ortho dem-height" in [context.command_path for context in make_man.contexts()]


def test_help_imports_no_command_and_nothing_heavy(program, tmp_path):
    program(command="raise RuntimeError('no luck')")
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path / 'site')!r}); sys.argv = ['ortho', '--help']\n"
        "from ortho_pipeline.cli.program import main\n"
        "try: main()\nfinally: print([name for name in ('third_party', 'third_party_command', 'numpy', 'osgeo', "
        "'pydantic', 'ortho_pipeline.options') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "dem-height" in done.stdout
    assert done.stdout.splitlines()[-1] == "['third_party']"
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("raise RuntimeError('no luck')", r"(RuntimeError: no luck at third_party_command.py:1)"),
        ("import sys; sys.exit(0)", "(SystemExit: 0 at third_party_command.py:1)"),
        ("", "has no attribute 'command'"),
        ("command = 3", "third_party_command:command is a int, not a click command"),
    ],
)
def test_a_command_that_cannot_be_loaded_names_its_package(program, code, message):
    program(command=code)
    done = run("dem-height", "a.tif")
    assert done.exit_code == 1
    assert "'dem-height' of plugin third_party (third-party 1.2) cannot be loaded" in done.stderr
    assert message in done.stderr
    assert run("--help").exit_code == 0
    completion = ShellComplete(cli, {}, "ortho", "_ORTHO_COMPLETE")
    assert [one.value for one in completion.get_completions([], "d")] == ["dem-check", "doctor"]


def broken() -> list[str]:
    """Return what the doctor says of packages that were left out, of which there is one."""
    (one,) = json.loads(run("doctor", "--json").stdout)["broken"]
    assert (one["plugin"], one["distribution"], one["version"]) == ("third_party", "third-party", "1.2")
    return one["error"]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("import no_such_module_here", "no_such_module_here"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        (DECLARED.format(name="rectify", target="a:b"), "'rectify', but this name belongs to ortho-pipeline"),
        (DECLARED.format(name="Dem height", target="a:b"), "'Dem height' is not a valid command name"),
        (DECLARED.format(name="dem-height", target="a.b"), "the target must be 'package.module:name', not 'a.b'"),
        (DECLARED.replace("Show the height of the ground under IMAGE.", " ").format(name="dem-height", target="a:b"),
         "the summary is empty"),
        (DECLARED.replace("yield", "return").format(name="dem-height", target="a:b"), "ortho_commands returned Sub"),
        (DECLARED.replace("yield Sub", "yield 3; Sub").format(name="dem-height", target="a:b"), "yields int, not Sub"),
        (DECLARED.replace("ortho_commands", "ortho_command").format(name="a", target="a:b"), "hook 'ortho_command'"),
        (DECLARED.replace("ortho_commands", "ortho_sensors").format(name="a", target="a:b"), "has no effect in"),
    ],
)  # fmt: skip
def test_a_package_that_breaks_the_contract_is_left_out_with_a_warning(program, caplog, source, message):
    program(source)
    done = run("--help")
    assert done.exit_code == 0
    assert "rectify" in done.stdout
    assert "dem-height" not in done.stdout
    assert "'third_party' of third-party 1.2 is skipped" in caplog.text
    assert message in caplog.text
    assert message in broken()
    assert run("dem-height").exit_code == 2


def test_a_name_belongs_to_the_first_of_two_packages_and_the_other_is_named(program, caplog):
    program(distribution="another", module="another")
    program()
    assert run("dem-height", "a.tif", "--height", 5).stdout == "a.tif: 5.0 m\n"
    (said,) = {record.getMessage() for record in caplog.records}
    assert "two plugins offer the command 'dem-height': another (another 1.2) and third_party (third-party 1.2)" in said
    assert "two plugins" in broken()


def test_a_warning_is_on_stderr_and_the_help_complete(install, tmp_path):
    install("third-party", "third_party", "1 / 0", group=GROUP)
    environment = {"PYTHONPATH": str(tmp_path / "site"), "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [Path(sys.executable).with_name("ortho"), "--help"], capture_output=True, text=True, check=True, env=environment
    )
    assert all(f"\n  {name} " in done.stdout for name in COMMANDS)
    (line,) = done.stderr.splitlines()
    assert line.startswith("WARNING: plugin 'third_party' of third-party 1.2 is skipped: ZeroDivisionError")
