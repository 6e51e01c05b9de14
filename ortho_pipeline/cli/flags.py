"""Names of options in messages: other rooms write `surface.dem`, the command line shows the flag, --dem."""

from __future__ import annotations

import shlex
from collections.abc import Container, Mapping
from dataclasses import replace

import click

from ortho_pipeline.errors import OrthoError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.options.flags import FLAGGED, FLAGS, flag_of, value_of


def flags_of(command: click.Command, words: Container[str] = ()) -> dict[str, str]:
    """Return the names that messages give the options of a command, and the flag of each: if possible one of `words`.

    An option of a group is ``group.field``, any other has the name of its argument. `ortho run` has few of the groups'
    options: the names of the others are the keys of its file.
    """
    flags, plain = {}, set()
    for param in command.params:
        group, _, field = str(param.name).partition("_")
        if not isinstance(param, click.Option):
            continue
        flag = next((option for option in param.opts if option in words), param.opts[0])
        if group in FLAGGED and field:
            flags[f"{group}.{field}"] = flag
        else:
            flags[str(param.name)] = flag
            plain |= set(param.opts)
    return {**{name: flag for name, flag in FLAGS.items() if flag in plain}, **flags}


def with_flags(text: str, flags: Mapping[str, str]) -> str:
    """Return a text with the options that it names as they are typed; names without a flag stay as they are."""
    if not isinstance(text, Text):
        return text
    return "".join(part if isinstance(part, str) else flag_of(part, flags) for part in text.parts)


def as_typed(text: str) -> str:
    """Return a text with the options that it names as they are typed in the command that runs."""
    if not isinstance(text, Text):
        return text
    ctx = click.get_current_context(silent=True)
    return text if ctx is None else with_flags(text, flags_of(ctx.command, _words(ctx)))


def name_as_typed(error: OrthoError, command: click.Command) -> None:
    """Let an error name the options of a command as they are typed there."""
    flags = flags_of(command, _words(click.get_current_context()))
    if error.choices:
        _offer(error, command, flags)
    error.message = with_flags(error.message, flags)
    error.remedy = None if error.remedy is None else with_flags(error.remedy, flags)
    if error.field is not None:
        error.field = ", ".join(flags.get(part, part) for part in error.field.split(", "))


def _words(ctx: click.Context) -> frozenset[str]:
    """Return the words that were typed: whoever wrote -tr looks for -tr in a message, not for --resolution."""
    words: frozenset[str] = ctx.meta.get("words", frozenset())
    return words


def _offer(error: OrthoError, command: click.Command, flags: Mapping[str, str]) -> None:
    """Add the command that was typed with each of the options that an error offers, ready to be pasted."""
    of_each = {
        f"scene.{param.name[6:]}" for param in command.params if param.multiple and str(param.name).startswith("scene_")
    }

    def of_image(setting: Setting) -> Setting:
        # Of several images, an option names the one that it is of.
        return replace(setting, value=f"{error.file}={setting.value}") if setting.name in of_each else setting

    parts = Text(error.remedy or "").parts
    remedy = Text(*(part if isinstance(part, str) else of_image(part) for part in parts))
    typed = click.get_current_context().meta.get("command")
    if typed is not None and all(name in flags for name in (error.field or "").split(", ")):
        for setting, meaning in error.choices:
            value = shlex.quote(value_of(of_image(setting)))
            remedy = Text(remedy, f"\n    {typed} {flags[setting.name]} {value}  # {meaning}")
    error.remedy = remedy
