"""Names of options in messages: rooms below say `surface.dem`, the command line shows what is typed there, --dem."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping

import click

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.options import GROUPS, MosaicOptions, options_of

_NAMED = re.compile(r"`([a-z_]+(?:\.[a-z_]+)?)(?:\.(\w+))?(?:=([^`]*))?`")
#: Those of a scene, and of a mosaic.
_GROUPS = {**GROUPS, "mosaic": MosaicOptions}
#: Name of an option in messages -> its flag, where a command has it under that flag.
FLAGS = {
    f"{group}.{name}": option.flags.split()[0]
    for group, options in _GROUPS.items()
    for name, option in options_of(options).items()
}


def flags_of(command: click.Command) -> dict[str, str]:
    """Return the names that messages give the options of a command, and the flag of each.

    An option of a group is ``group.field``, any other has the name of its argument. `ortho run` has few of the groups'
    options: the names of the others are the keys of its file.
    """
    found, plain = {}, set()
    for one in command.params:
        group, _, field = str(one.name).partition("_")
        if not isinstance(one, click.Option):
            continue
        if group in _GROUPS and field:
            found[f"{group}.{field}"] = one.opts[0]
        else:
            found[str(one.name)] = one.opts[0]
            plain |= set(one.opts)
    return {**{name: flag for name, flag in FLAGS.items() if flag in plain}, **found}


def with_flags(text: str, flags: Mapping[str, str]) -> str:
    """Return a text with the options that it names as they are typed; names without a flag stay as they are."""

    def typed(match: re.Match[str]) -> str:
        name, key, value = match.groups()
        if name not in flags:
            return match[0]
        given = "=".join(part for part in (key, value) if part is not None)
        return f"{flags[name]} {given}".strip()

    return _NAMED.sub(typed, text)


def as_typed(text: str) -> str:
    """Return a text with the options that it names as they are typed in the command that runs."""
    ctx = click.get_current_context(silent=True)
    return text if ctx is None else with_flags(text, flags_of(ctx.command))


def name_as_typed(error: OrthoError, command: click.Command) -> None:
    """Let an error name the options of a command as they are typed there."""
    flags = flags_of(command)
    if error.choices:
        _offer(error, command, flags)
    error.message = with_flags(error.message, flags)
    error.remedy = None if error.remedy is None else with_flags(error.remedy, flags)
    if error.field is not None:
        error.field = ", ".join(flags.get(part, part) for part in error.field.split(", "))


def _offer(error: OrthoError, command: click.Command, flags: Mapping[str, str]) -> None:
    """Add the command that was typed with each of the options that an error offers, ready to be pasted."""
    of_each = {f"scene.{one.name[6:]}" for one in command.params if one.multiple and str(one.name).startswith("scene_")}

    def of_image(text: str) -> str:
        # Of several images, an option names the one that it is of.
        for name in of_each:
            text = text.replace(f"`{name}=", f"`{name}={error.file}=")
        return text

    error.remedy = of_image(error.remedy or "")
    typed = click.get_current_context().meta.get("command")
    if typed is None or not all(name in flags for name in (error.field or "").split(", ")):
        return
    for option, meaning in error.choices:
        flag, value = with_flags(of_image(option), flags).split(" ", 1)
        error.remedy += f"\n    {typed} {flag} {shlex.quote(value)}  # {meaning}"
