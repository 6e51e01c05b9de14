"""Texts that name options: in Python and in the pipeline file by field, on the command line by flag.

Write a text that names an option as ``Text("give ", Setting("surface.dem", "FILE"), " too")``. Such a text is the
string "give `surface.dem=FILE` too", and still knows its parts; a formatted string that contains it does not.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self


@dataclass(frozen=True)
class Setting:
    """An option in a text, with the value that it is given there, if any.

    Parameters
    ----------
    name : str
        ``group.field``, or the name of an argument.
    value : str, optional
        The value, or a word in its place (FILE).
    key : str, optional
        Of an option that holds several: which of them.

    Examples
    --------
    >>> str(Setting("surface.dem", "FILE"))
    '`surface.dem=FILE`'
    """

    name: str
    value: str | None = None
    key: str | None = None

    def __str__(self) -> str:
        name = self.name if self.key is None else f"{self.name}.{self.key}"
        return f"`{name}`" if self.value is None else f"`{name}={self.value}`"

    @classmethod
    def read(cls, text: str) -> Setting:
        """Return what stands between two backticks of a text; anything but an option is one that no command has."""
        name, equals, value = text.partition("=")
        words = name.split(".", 2)
        return cls(".".join(words[:2]), value if equals else None, words[2] if len(words) == 3 else None)


class Text(str):
    """A text for people that knows the options in it, made of strings, other texts and settings.

    A string for all that need no more, also in JSON.

    Examples
    --------
    >>> Text("give ", Setting("surface.dem", "FILE"), " too")
    'give `surface.dem=FILE` too'
    """

    __slots__ = ("parts",)

    parts: tuple[str | Setting, ...]

    def __new__(cls, *parts: str | Setting) -> Self:
        """Join parts; the options that texts among them name stay known."""
        text = super().__new__(cls, "".join(map(str, parts)))
        inner = (part.parts if isinstance(part, Text) else (part,) for part in parts)
        object.__setattr__(text, "parts", tuple(part for some in inner for part in some))
        return text

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self.parts

    @classmethod
    def joined(cls, between: str, texts: Iterable[str]) -> Text:
        """Return texts with a string between each two."""
        parts = [part for text in texts for part in (between, text)]
        return cls(*parts[1:])

    @classmethod
    def read(cls, text: str) -> Text:
        """Return a text that another process has written into a JSON document, where it is a string alone."""
        parts = text.split("`")
        if len(parts) % 2 == 0:  # one of them quotes nothing
            return Text(text)
        return Text(*(Setting.read(part) if number % 2 else part for number, part in enumerate(parts)))


def counted(number: int, what: str, plural: str | None = None) -> str:
    """Return a number and what it counts, as ``1 point`` and ``2 points``.

    Parameters
    ----------
    plural : str, optional
        Where it is not formed with an s, or a verb follows: ``counted(n, "point does", "points do")``.

    Examples
    --------
    >>> counted(1, "point"), counted(2, "point")
    ('1 point', '2 points')
    """
    return f"{number} {what if number == 1 else plural or f'{what}s'}"


def installing(extra: str) -> str:
    """Return how to install the packages of an extra of pyproject.toml.

    Examples
    --------
    >>> installing("plots")
    "run pip install '.[plots]' in the source folder of ortho-pipeline"
    """
    return f"run pip install '.[{extra}]' in the source folder of ortho-pipeline"
