"""Commands as people type them: words that are unknown are errors with a suggestion, not values of other options.

click would read ``-overwrite`` as ``-o verwrite`` and write to a folder of that name. Here a word with one dash is
an existing option or an error; `HINTS` has replacements for options of other tools.
"""

from __future__ import annotations

import contextlib
import difflib
import io
import logging
import os
import re
from collections.abc import Mapping, Sequence
from typing import Any, NoReturn, cast

import click

from ortho_pipeline.cli.flags import name_as_typed
from ortho_pipeline.cli.survey.examples import EXAMPLES, with_examples
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.options import is_usable

_WORD = re.compile(r"-[A-Za-z_]\S")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")

#: The largest whole number that an option takes: libraries count in 32 bits.
_WHOLE = 2**31 - 1
#: What to use instead of gdalwarp's options that do not exist here.
HINTS: Mapping[str, str] = {
    "-s_srs": "leave it out; the sensor model gives the position of the image",
    "-rpc": "leave it out; the RPC of the image is used by default, and '--rpc FILE' chooses another",
    "-tps": "use '--fit-model NAME' to fit a model to points ('ortho models' lists them)",
    "-order": "use '--fit-model poly2' for a polynomial of second order ('ortho models' lists all)",
    "-geoloc": "use '--sensor geolocation' for an image with geolocation arrays ('ortho sensors' lists all)",
    "-to": "use '--dem FILE' and '--dem-vertical DATUM' for RPC_DEM, '--height M' for RPC_HEIGHT",
    "-et": "use '--tolerance PX' to limit the geometric error",
    "-ts": "use '-tr X Y' for the pixel size and '-te' for the extent",
    "-multi": "leave it out; all processors are used by default, and '--threads N' limits them",
    "-wo": "use '--threads N' and '--memory MB'",
    "-srcnodata": "set it in the image: `gdal_translate -a_nodata VALUE IN OUT`",
    "-dstalpha": "leave it out; nodata, a mask or the image's own alpha band marks the valid pixels",
    "-cutline": "cut the finished ortho: `gdalwarp -cutline AREA ORTHO OUT`",
    "-crop_to_cutline": "cut the finished ortho: `gdalwarp -cutline AREA -crop_to_cutline ORTHO OUT`",
    "-ovr": "leave it out; pixels are always read at full resolution; for a coarser ortho use '-r average'",
}


class Command(click.Command):
    """A command that takes options as gdalwarp's users write them, and ``-v``, ``-q`` and ``--debug``.

    Parameters
    ----------
    one : str, optional
        Hint of the error for several files, if the command takes one.

    Examples
    --------
    >>> import click
    >>> @click.command(cls=Command)
    ... def coverage() -> None:
    ...     click.echo("83 %")
    >>> sorted(option.name for option in coverage.params)
    ['debug', 'quiet', 'verbose']
    """

    def __init__(self, *given: Any, one: str | None = None, **named: Any) -> None:
        super().__init__(*given, **named)
        self.one = one
        self.params += [
            click.Option(
                ["-v", "--verbose"],
                count=True,
                expose_value=False,
                callback=_verbose,
                is_eager=True,
                help="Verbose: log progress to stderr; -vv also shows GDAL's messages.",
            ),
            click.Option(
                ["-q", "--quiet"],
                is_flag=True,
                expose_value=False,
                callback=_quiet,
                is_eager=True,
                help="Quiet: print only warnings and errors (and the document of --json).",
            ),
            click.Option(
                ["--debug"],
                is_flag=True,
                expose_value=False,
                callback=_debug,
                is_eager=True,
                help="Show the traceback of an error.",
            ),
        ]

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the words of the command line; unexpected words are an error with a hint."""
        words = _checked(ctx, args, self.get_params(ctx))
        # The error of click has no hint.
        ctx.allow_extra_args = True
        super().parse_args(ctx, words)
        if not ctx.resilient_parsing:
            _refuse_numbers(ctx, self.get_params(ctx))
        if ctx.args and not ctx.resilient_parsing:
            shown = " ".join(ctx.args[:3]) + (" ..." if len(ctx.args) > 3 else "")
            ctx.fail(f"Unexpected argument {shown!r} for '{ctx.info_name}'." + (f" {self.one}" if self.one else ""))
        return ctx.args

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; its errors name options by their flags."""
        try:
            if ctx.meta.get("quiet") and not ctx.meta.get("json"):
                with contextlib.redirect_stdout(io.StringIO()):
                    return super().invoke(ctx)
            return super().invoke(ctx)
        except OrthoError as error:
            name_as_typed(error, self)
            raise


class Group(click.Group):
    """A group whose commands are of that kind, with their examples in their help.

    Examples
    --------
    >>> Group("dem", commands={"check": Command("check")}).list_commands(None)
    ['check']
    """

    command_class = Command

    def add_command(self, cmd: click.Command, name: str | None = None) -> None:
        """Add a command, whose examples are found by its words."""
        super().add_command(cmd, name)
        words = f"{self.name} {name or cmd.name}".removeprefix("cli ")
        cmd.help = with_examples(cmd.help, EXAMPLES.get(words, ()))


class OneOrTwo(click.ParamType):  # type: ignore[type-arg]
    """One positive number, or two that are separated by a blank (as words) or a comma."""

    name = "number"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return one number, or a pair."""
        if not isinstance(value, str):
            return value
        parts = value.split(",")
        if len(parts) > 2 or not all(_NUMBER.fullmatch(part) and float(part) > 0 for part in parts):
            self.fail(f"{value!r} is neither one positive number nor two.", param, ctx)
        numbers = tuple(float(part) for part in parts)
        return numbers[0] if len(numbers) == 1 else numbers


class Megabytes(click.ParamType):  # type: ignore[type-arg]
    """An amount of memory: MB, or with a unit (``2GB``); a million and more are bytes, as for gdalwarp."""

    name = "MB"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the count of bytes."""
        match = re.fullmatch(r"(\d{1,15})\s*(MB|GB)?", str(value), re.IGNORECASE)
        if match is None:
            self.fail(f"{value!r} is not an amount of memory such as 512 (MB) or 2GB.", param, ctx)
        number = int(match[1])
        unit = {"MB": 1_000_000, "GB": 1_000_000_000, "": 1 if number >= 1_000_000 else 1_000_000}
        size = number * unit[(match[2] or "").upper()]
        if size < 16_000_000:
            self.fail(f"{value!r} is too little; at least 16 MB are needed.", param, ctx)
        if size >= 2**60:
            self.fail(f"{value!r} is more memory than any machine has.", param, ctx)
        return size


def _refuse_numbers(ctx: click.Context, params: Sequence[click.Parameter]) -> None:
    """Refuse unusable numbers in all options of all commands."""
    for param in params:
        value = ctx.params.get(str(param.name))
        for number in value if isinstance(value, tuple | list) else (value,):
            if isinstance(number, int) and not isinstance(param.type, Megabytes) and abs(number) > _WHOLE:
                raise click.BadParameter(f"{number} is too large; the limit is {_WHOLE}.", ctx, param)
            if isinstance(number, float) and not is_usable(number):
                raise click.BadParameter(
                    f"{number:g} is not a usable number: too large, too small, or not finite.", ctx, param
                )


def _checked(ctx: click.Context, args: Sequence[str], params: Sequence[click.Parameter]) -> list[str]:
    """Return the words with pairs of numbers joined; a word with one dash that is not an option is an error."""
    known = {
        name: param
        for param in params
        if isinstance(param, click.Option)
        for name in (*param.opts, *param.secondary_opts)
    }
    words: list[str] = []
    files: set[str | None] = set()
    rest = list(args)
    while rest:
        word = rest.pop(0)
        words.append(word)
        if word == "--":
            return words + rest
        _refuse_second_file(ctx, word.partition("=")[0], known, files)
        option = known.get(word)
        if option is None:
            if word.startswith("--") and word.endswith("=") and word[:-1] in known:
                _empty(ctx, word[:-1])
            if _WORD.match(word) and not _repeated(word, known):
                _unknown(ctx, word, known)
            continue
        taken = [] if option.is_flag or option.count else [rest.pop(0) for _ in range(min(option.nargs, len(rest)))]
        if isinstance(option.type, OneOrTwo) and all(map(_NUMBER.fullmatch, (*taken, *(rest[:1] or ["-"])))):
            taken = [f"{taken[0]},{rest.pop(0)}"]
        if "" in taken:
            _empty(ctx, word)
        words += taken
    return words


def _refuse_second_file(
    ctx: click.Context, name: str, known: Mapping[str, click.Option], files: set[str | None]
) -> None:
    """Fail if an option of one file is in `files` already, because click would use the last one; else add it there."""
    option = known.get(name)
    if option is None or option.multiple or not str(option.metavar).startswith("FILE"):
        return
    if option.name in files:
        pattern = ". Name the files of one DEM by a pattern, such as 'cells/*.tif'" if name == "--dem" else ""
        ctx.fail(f"'{name}' is given twice, and takes one file{pattern}.")
    files.add(option.name)


def _empty(ctx: click.Context, name: str) -> NoReturn:
    ctx.fail(f"The value of '{name}' is empty. Is a variable of your shell not set?")


def _repeated(word: str, known: Mapping[str, click.Option]) -> bool:
    option = known.get(word[:2])
    return option is not None and option.count and len(set(word[1:])) == 1


def _unknown(ctx: click.Context, word: str, known: Mapping[str, click.Option]) -> NoReturn:
    """Fail for an unknown option, and suggest a similar one."""
    name, equals, value = word.partition("=")
    if name in HINTS and "-t_srs" in known:
        ctx.fail(f"No such option: {name}; {HINTS[name]}.")
    if equals and name in known:
        ctx.fail(f"No such option: {word}; did you mean '{name} {value}'?")
    bare = {option.lstrip("-").replace("_", "-"): option for option in known}
    attached = word[:2] in known and not known[word[:2]].is_flag and not known[word[:2]].count
    close = difflib.get_close_matches(name.lstrip("-").replace("_", "-"), bare, 1, 0.8 if attached else 0.6)
    meant = bare[close[0]] if close else f"{word[:2]} {word[2:]}" if attached else None
    hint = f"; did you mean '{meant}'?" if meant else "."
    ctx.fail(f"No such option: {word}{hint}")


def _verbose(ctx: click.Context, _: click.Parameter, count: int) -> None:
    if count:
        logging.getLogger("ortho_pipeline").setLevel(logging.INFO if count == 1 else logging.DEBUG)
    if count > 1:
        # GDAL is not loaded yet, and reads this when it is.
        os.environ.setdefault("CPL_DEBUG", "ON")


def _quiet(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    ctx.meta["quiet"] = value


def _debug(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    ctx.meta["debug"] = value


class Shard(click.ParamType):  # type: ignore[type-arg]
    """The K-th of N parts."""

    name = "K/N|auto"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int] | str:
        """Return (k, n) of 'k/n', or 'auto'."""
        if isinstance(value, tuple) or value == "auto":
            return cast(tuple[int, int] | str, value)
        match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", value)
        if not match or not 1 <= int(match[1]) <= int(match[2]):
            self.fail(f"{value!r} is not K/N, such as 1/4", param, ctx)
        return int(match[1]), int(match[2])
