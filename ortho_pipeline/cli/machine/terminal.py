"""Output for the terminal: only printable characters, and lines of bounded length."""

from __future__ import annotations

import logging
import os
import re
import sys
import unicodedata

import click

#: Characters of a line, of which longer ones are cut.
LONGEST = 4000
_LINE = re.compile(r"[^\n]+")


def open_closed_streams() -> None:
    """Open standard streams that are closed on the null device.

    The next file that is opened would take the number of the stream, and receive what libraries print. Worker
    processes inherit them.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode)  # noqa: SIM115
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def printable(text: str) -> str:
    """Return a text with control characters as escapes, and no line longer than `LONGEST`.

    Escape sequences would change the title, the colours or the text of a terminal; so would marks that turn the
    direction of writing.
    """
    return _LINE.sub(lambda line: _cut(line[0]), text)


def _cut(line: str) -> str:
    shown = line if len(line) <= LONGEST else f"{line[:LONGEST]}... ({len(line)} characters)"
    return shown if shown.replace("\t", "").isprintable() else "".join(map(_escaped, shown))


def _escaped(character: str) -> str:
    if character.isprintable() or character == "\t" or unicodedata.category(character) == "Zs":
        return character
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def printable_json(text: str) -> str:
    """Return a JSON text, which escapes only a part of the control characters itself, with all of them as escapes."""
    if text.replace("\n", "").isprintable():
        return text
    return "".join(letter if letter == "\n" or letter.isprintable() else _escaped_in_json(letter) for letter in text)


def _escaped_in_json(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[k]:02x}{units[k + 1]:02x}" for k in range(0, len(units), 2))


def say(text: object = "", *, err: bool = False) -> None:
    """Print a text for people.

    Examples
    --------
    >>> say("83 % of the scene")
    83 % of the scene
    """
    click.echo(printable(str(text)), err=err)


class PrintableLog(logging.Formatter):
    """Formats records of the log for the terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as printable text."""
        return printable(super().format(record))
