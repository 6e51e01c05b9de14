"""The command line: each command parses, calls a function of `commands`, prints.

A command is loaded when it is called, and loads what it works with when it begins: ``ortho --help`` needs click, this
module, and what installed packages declare of the commands that they add.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import importlib
import logging
import os
import shlex
import sys
from collections.abc import Container
from typing import TYPE_CHECKING, Any

import click

from ortho_pipeline.cli.machine.terminal import PrintableLog, open_closed_streams, say
from ortho_pipeline.errors import InputError, OrthoError, PluginError, error_document

if TYPE_CHECKING:
    from ortho_pipeline.cli.machine.added import AddedCommands

FAILED, CORRECTABLE, INTERRUPTED = 1, 2, 130
#: Errors of the system about a file that is there, and that a user may not or cannot use.
_NO_ACCESS = (errno.EACCES, errno.EPERM, errno.ELOOP, errno.EROFS, errno.EIO, errno.ENAMETOOLONG)
#: Every command of the host, by what people want to do: its module in this room, and the first sentence of its help.
GROUPS = {
    "Make orthos": {
        "rectify": ("scene.rectifying", "Make the ortho of IMAGE, with its accuracy report."),
        "align": ("orthos", "Align a finished ORTHO with an orthoimage."),
        "sharpen": ("sharpening", "Pan-sharpen MS_ORTHO with PAN_ORTHO."),
        "mosaic": ("batch", "Combine ORTHOs on one grid into one raster."),
        "export": ("scene.rectifying", "Write the model of IMAGE for other programs."),
        "register": ("scene.bands", "Align the bands of separate cameras in one image."),
    },
    "Control points": {
        "fit": ("scene.fitting", "Adjust the model of IMAGE to control points."),
        "compare": ("scene.fitting", "Compare models on the same points and recommend one."),
        "match": ("matching", "Find control points of IMAGE in an orthoimage."),
    },
    "Blocks": {
        "adjust": ("block", "Adjust several IMAGEs together (bundle adjustment)."),
        "ties": ("matching", "Find tie points between overlapping IMAGEs."),
        "intersect": ("block", "Compute ground points from rays in several IMAGEs."),
    },
    "Inspect": {
        "info": ("survey.first_use", "Describe an image, a DEM, an ortho or a folder."),
        "verify": ("orthos", "Measure how accurate a finished ORTHO is."),
        "dem-check": ("scene.heights", "Compare a DEM with check heights."),
        "edge": ("scene.bands", "Measure how sharp IMAGE is, from straight edges."),
        "report": ("scene.rectifying", "Write the plots of a report as pictures."),
    },
    "Many scenes": {
        "stack": ("scene.stacking", "Make finished orthos and raw scenes of many dates agree with each other."),
        "init": ("survey.first_use", "Write a pipeline file for the scenes of FOLDER."),
        "run": ("batch", "Make the orthos of all scenes in PIPELINE.yaml."),
    },
    "Set-up": {
        "doctor": ("machine.doctor", "Show versions, drivers, geoid grids and plugins."),
        "sensors": ("machine.installed", "List the installed sensors."),
        "models": ("machine.installed", "List the models that can be fitted to points."),
        "cache": ("machine.cache", "List, verify or clear the downloaded DEM cells."),
    },
}
COMMANDS = {name: known for group in GROUPS.values() for name, known in group.items()}


class _Commands(click.Group):
    """Loads the command that is called; turns errors into messages on stderr and exit codes.

    With ``--json`` an error is also a document on stdout.
    """

    @functools.cached_property
    def added(self) -> AddedCommands:
        """The commands of installed packages; they are looked for once, for the help and for names not of the host."""
        from ortho_pipeline.cli.machine.added import AddedCommands

        return AddedCommands(COMMANDS)

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted([*COMMANDS, *self.added.offers])

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name in self.commands:
            return self.commands[cmd_name]
        from ortho_pipeline.cli.survey.examples import EXAMPLES, with_examples

        if cmd_name in COMMANDS:
            module = importlib.import_module(f"ortho_pipeline.cli.{COMMANDS[cmd_name][0]}")
            command, examples = getattr(module, cmd_name.replace("-", "_")), EXAMPLES.get(cmd_name, ())
        elif cmd_name in self.added.offers:
            try:
                command, examples = self.added.load(cmd_name), self.added.offers[cmd_name].examples
            except PluginError:
                if ctx.resilient_parsing:  # a shell completes the other commands
                    return None
                raise
        else:
            return None
        command.help = with_examples(command.help, examples)
        self.add_command(command, cmd_name)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that is called; of an unknown one name the nearest."""
        if args and not args[0].startswith("-") and self.get_command(ctx, args[0]) is None:
            import difflib

            if close := difflib.get_close_matches(args[0], self.list_commands(ctx), 1):
                ctx.fail(f"No such command '{args[0]}'; did you mean '{close[0]}'?")
        name, command, rest = super().resolve_command(ctx, args)
        if name in COMMANDS and "--json" in rest and not {*ctx.help_option_names} & {*rest}:
            # What plugins and libraries print must not mix with the document.
            ctx.meta["stdout"] = sys.stdout
            ctx.with_resource(contextlib.redirect_stdout(sys.stderr))
        return name, command, rest

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands in their groups, without loading any."""
        groups = {title: {name: summary for name, (_, summary) in group.items()} for title, group in GROUPS.items()}
        for name, offer in self.added.offers.items():
            groups.setdefault(offer.group, {})[name] = offer.summary
        for title, group in groups.items():
            with formatter.section(title):
                formatter.write_dl(list(group.items()))

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **extra: Any) -> click.Context:
        command = shlex.join([info_name or "ortho", *args])
        # Without the values of options, as in --search=50; a set, because messages look up every option in it.
        words = frozenset(word.partition("=")[0] for word in args)
        try:
            ctx = super().make_context(info_name, args, *more, **extra)
        except click.UsageError as error:
            _print_usage_error(words, error)
            raise
        ctx.meta.update(command=command, words=words)
        return ctx

    def invoke(self, ctx: click.Context) -> Any:
        try:
            if ctx.obj is not None:
                ctx.obj()
            return super().invoke(ctx)
        except OrthoError as error:
            return self._fail(ctx, error, CORRECTABLE if isinstance(error, InputError) else FAILED)
        except KeyboardInterrupt:
            say("Interrupted.", err=True)
            return ctx.exit(INTERRUPTED)
        except ImportError as error:
            # Every command loads GDAL when it begins its work.
            missing = _without_gdal()
            return self._fail(ctx, missing or _fault(error), CORRECTABLE if missing else FAILED)
        except MemoryError as error:
            short = OrthoError("not enough memory", remedy="reduce --memory, and use --threads 1")
            short.__cause__ = error
            return self._fail(ctx, short, FAILED)
        except click.UsageError as error:
            _print_usage_error(ctx.meta["words"], error)
            raise
        except (click.ClickException, click.exceptions.Exit, click.Abort, BrokenPipeError):
            raise
        except (Exception, SystemExit) as error:
            # An exit by a library or a plugin would look like success.
            fault = _fault(error)
            return self._fail(ctx, fault, CORRECTABLE if isinstance(fault, InputError) else FAILED)

    def _fail(self, ctx: click.Context, error: OrthoError, code: int) -> None:
        """Print an error, with ``--debug`` after its traceback, and end with an exit code."""
        if ctx.meta.get("debug"):
            import traceback

            say("".join(traceback.format_exception(error)), err=True)
        say(f"Error: {error}", err=True)
        if ctx.meta.get("json"):
            _print_error(error_document(error))
        ctx.exit(code)


def _print_usage_error(words: Container[str], error: click.UsageError) -> None:
    """Print the document of an error in the command line itself."""
    if "--json" in words:
        parameter = getattr(error, "param", None)
        field = parameter.opts[0] if parameter is not None else getattr(error, "option_name", None)
        remedy = f"see '{error.ctx.command_path} --help'" if error.ctx is not None else "see 'ortho --help'"
        document = {
            "kind": "UsageError",
            "message": error.format_message(),
            "file": None,
            "field": field,
            "remedy": remedy,
        }
        _print_error(document)


def _print_error(document: dict[str, Any]) -> None:
    """Print the document of an error, which may be that stdout cannot be written."""
    from ortho_pipeline.cli.printing import print_json

    with contextlib.suppress(OSError):
        print_json({"schema_version": 1, "error": document})


def _fault(error: BaseException) -> OrthoError:
    """Return an unexpected error as one that users can report, or correct if it is one of a disk or of rights."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        full = OrthoError(
            f"cannot write ({error.strerror})",
            file=error.filename,
            remedy="free some space on the disk that receives the outputs or the printed text, and run it again",
        )
        full.__cause__ = error
        return full
    if isinstance(error, OSError) and error.errno in _NO_ACCESS and isinstance(error.filename, str | bytes):
        closed = InputError(
            f"cannot access this file or folder ({error.strerror})",
            file=os.fsdecode(error.filename),
            remedy="check its path, its permissions and those of the folders above it",
        )
        closed.__cause__ = error
        return closed
    from ortho_pipeline.host.registry import fault_of_plugin

    if of_plugin := fault_of_plugin(error):
        return of_plugin
    fault = OrthoError(
        f"{type(error).__name__}: {error}" if str(error) else type(error).__name__,
        remedy="this is a bug in ortho-pipeline; run the command again with --debug and report the traceback",
    )
    fault.__cause__ = error
    return fault


def _without_gdal() -> InputError | None:
    """Return what to do if GDAL cannot be loaded; None if it can."""
    try:
        importlib.import_module("osgeo.gdal_array")
    except ImportError as problem:
        missing = InputError(
            f"cannot load the Python bindings of GDAL ({problem})",
            remedy="run 'make setup' in the source folder of ortho-pipeline (docs/install.md)",
        )
        missing.__cause__ = problem
        return missing
    return None


def main() -> None:
    """Run the command line."""
    from ortho_pipeline.runtime.signals import Terminated, ended_by_signals

    open_closed_streams()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PrintableLog("%(levelname)s: %(message)s"))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    with ended_by_signals():
        try:
            cli(prog_name="ortho", obj=_begin)
        except KeyboardInterrupt:
            # Before a command has begun; later `_Commands` prints it.
            say("Interrupted.", err=True)
            raise SystemExit(INTERRUPTED) from None
        except Terminated as ended:
            raise SystemExit(ended.code) from None


def _begin() -> None:
    """Prepare the process for a command, before it is loaded."""
    from ortho_pipeline.files.folders import ignore_working_folder
    from ortho_pipeline.files.locations import close_network
    from ortho_pipeline.raster.opening.environment import ignore_reading_options
    from ortho_pipeline.runtime.process_limits import share_freed_memory

    share_freed_memory()
    # Before GDAL is loaded, which reads the environment; worker processes inherit it.
    ignore_working_folder()
    ignore_reading_options()
    close_network()


@click.group(
    cls=_Commands,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(package_name="ortho-pipeline", prog_name="ortho")
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Orthorectify satellite images and report how accurate the result is.

    Exit codes: 0 done, 1 failed, 2 you can correct it (the message says how), 3 partly done, 4 a
    requirement is not met ('ortho verify'), 130 interrupted.
    """
    if ctx.invoked_subcommand is None:
        from ortho_pipeline.cli.survey.first_use import print_steps

        print_steps()
