"""Names of options in messages: rooms below say `surface.dem`, the command line shows what is typed there, --dem."""

from __future__ import annotations

import re
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
    error.message = with_flags(error.message, flags)
    error.remedy = None if error.remedy is None else with_flags(error.remedy, flags)
    if error.field is not None:
        error.field = ", ".join(flags.get(part, part) for part in error.field.split(", "))
