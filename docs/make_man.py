"""Write a manual page (man, section 1) of every command into out/man, from what its help says: ``make docs``."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import click

from ortho_pipeline.cli.program import cli

FOLDER = Path(__file__).resolve().parent.parent / "out" / "man"
_EXAMPLES = re.compile(r"\n*\x08?\nExamples:\n(?P<lines>.*)\Z", re.DOTALL)
_EXIT = (
    "0 done, 1 failed, 2 the caller can correct it (the message says how), 3 partly done (ortho run), 130 interrupted."
)


def main(folder: Path = FOLDER) -> None:
    """Write all pages, and remove those of commands that are no more."""
    folder.mkdir(parents=True, exist_ok=True)
    pages = {f"{context.command_path.replace(' ', '-')}.1": page(context) for context in contexts()}
    for old in folder.glob("*.1"):
        if old.name not in pages:
            old.unlink()
    for name, text in pages.items():
        (folder / name).write_text(text, encoding="utf-8")


def contexts(context: click.Context | None = None) -> Iterator[click.Context]:
    """Return the program and all of its commands, each with its words."""
    context = context or click.Context(cli, info_name="ortho", **cli.context_settings)
    yield context
    if isinstance(context.command, click.Group):
        for name in context.command.list_commands(context):
            command = context.command.get_command(context, name)
            assert command is not None
            yield from contexts(click.Context(command, info_name=name, parent=context))


def page(context: click.Context) -> str:
    """Return the page of a command."""
    command, words = context.command, context.command_path
    text = inspect.cleandoc(command.help or "")
    examples = _EXAMPLES.search(text)
    paragraphs = _EXAMPLES.sub("", text).replace("\b\n", "").split("\n\n")
    first = " ".join(paragraphs[0].split())
    lines = [
        f'.TH "{words.replace(" ", "-").upper()}" 1 "" "ortho-pipeline {metadata.version("ortho-pipeline")}"',
        ".SH NAME",
        f"{_plain(words.replace(' ', '-'))} \\- {_plain(first.rstrip('.'))}",
        ".SH SYNOPSIS",
        f".B {_plain(words)}",
        _plain(" ".join(command.collect_usage_pieces(context))),
        ".SH DESCRIPTION",
        "\n.PP\n".join(_plain(" ".join(one.split())) for one in paragraphs),
        *_options(context),
    ]
    if isinstance(command, click.Group):
        lines += [".SH COMMANDS"]
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found is not None
            lines += [".TP", f".B {_plain(name)}", _plain(found.get_short_help_str(limit=200))]
    if examples:
        # Lines as they are typed.
        typed = inspect.cleandoc(examples["lines"].replace("\b", "")).splitlines()
        lines += [".SH EXAMPLES", ".nf", *map(_plain, typed), ".fi"]
    lines += [".SH EXIT STATUS", _plain(_EXIT)]
    if context.parent is not None:
        lines += [".SH SEE ALSO", f".BR {_plain(context.parent.command_path.replace(' ', '-'))} (1)"]
    return "\n".join(lines) + "\n"


def _options(context: click.Context) -> Iterator[str]:
    yield ".SH OPTIONS"
    for option in context.command.get_params(context):
        record = option.get_help_record(context) if isinstance(option, click.Option) else None
        if record is not None:
            yield from (".TP", f".B {_plain(record[0])}", _plain(" ".join(record[1].split())))


def _plain(text: str) -> str:
    """Return text in which troff sees no command: no backslashes, typed hyphens, no dot or quote that begins a line."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("'", "\\(aq").replace("`", "\\(ga")
    return f"\\&{escaped}" if escaped.startswith((".", "\\(aq")) else escaped


if __name__ == "__main__":
    main()
