"""Labels in PVL (``.pvl``), read into groups: ``key = value;`` in ``BEGIN_GROUP = name; … END_GROUP = name;``.

The library ``pvl`` does not serve here: of damaged copies of a real label it read ``1e400`` as infinity, left a file
that is cut off within a list with StopIteration, named neither group nor key in its errors, and did not come to an end
on some within minutes.

What vendors vary is tolerated: the case of keywords, missing semicolons, units in angle brackets, comments, lists in
either kind of bracket, END_GROUP without a name, anything after END.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import NamedTuple

from ortho_pipeline.plugin import InputError, counted, decoded, read_bounded, reads

#: Real labels have 6 kB and three levels of groups.
MAX_BYTES, MAX_DEPTH = 200_000, 12
_OPEN = ("BEGIN_GROUP", "GROUP", "BEGIN_OBJECT", "OBJECT")
_CLOSE = ("END_GROUP", "END_OBJECT")
# One alternative for each kind of token; every character begins one of them, and none looks far ahead in vain: a
# comment is bounded, so that no hostile file makes it slow.
_TOKEN = re.compile(
    r"(?P<blank>\s+|/\*.{0,2000}?\*/|\#[^\n]*|<[^<>;\n]*>)|(?P<quoted>\"[^\"]*\"|'[^'\n]*')|(?P<mark>[=;(){},])"
    r"|(?P<word>[^\s=;(){},\"'<>\#]+)|(?P<bad>.)",
    re.DOTALL,
)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class LabelGroup:
    """A group of a label: texts and lists of texts by key, and groups by name, with the file and its own place."""

    file: str
    path: str
    values: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    groups: Mapping[str, LabelGroup] = field(default_factory=dict)

    def place(self, key: str) -> str:
        """Return ``group.key``, for messages."""
        return f"{self.path}.{key}" if self.path else key

    def group(self, name: str) -> LabelGroup:
        """Return a group within this one.

        Raises
        ------
        InputError
            If there is none.
        """
        if name not in self.groups:
            raise InputError("this group is missing", file=self.file, field=self.place(name))
        return self.groups[name]

    def text(self, key: str) -> str:
        """Return a value as written, without quotes.

        Raises
        ------
        InputError
            If it is missing, or a list.
        """
        value = self._value(key)
        if isinstance(value, tuple):
            raise InputError("expected one value, not a list", file=self.file, field=self.place(key))
        return value

    def number(self, key: str) -> float:
        """Return a finite number.

        Raises
        ------
        InputError
            If it is missing or invalid.
        """
        return self._number(key, self.text(key))

    def whole(self, key: str) -> int:
        """Return a positive whole number below a billion.

        Raises
        ------
        InputError
            If it is missing or invalid.
        """
        value = self.number(key)
        if value != int(value) or not 0 < value < 1e9:
            raise InputError(f"{self.text(key)} is not a number of pixels", file=self.file, field=self.place(key))
        return int(value)

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Return a list of this many finite numbers.

        Raises
        ------
        InputError
            If it is missing or invalid.
        """
        value = self._value(key)
        if not isinstance(value, tuple) or len(value) != count:
            actual = f"a list of {len(value)}" if isinstance(value, tuple) else "one value"
            raise InputError(
                f"expected a list of {counted(count, 'number')}, not {actual}",
                file=self.file,
                field=self.place(key),
            )
        return tuple(self._number(key, part) for part in value)

    def has(self, key: str) -> bool:
        """Return whether this key has a value."""
        return key in self.values

    def _value(self, key: str) -> str | tuple[str, ...]:
        if key not in self.values:
            raise InputError("this key is missing", file=self.file, field=self.place(key))
        return self.values[key]

    def _number(self, key: str, text: str) -> float:
        if not _NUMBER.fullmatch(text):
            raise InputError(f"{text[:40]!r} is not a number", file=self.file, field=self.place(key))
        value = float(text.replace("D", "e").replace("d", "e"))
        if not math.isfinite(value):
            raise InputError(f"{text[:40]} is too large for a number", file=self.file, field=self.place(key))
        return value


@reads("copy the .pvl again from the delivery")
def read_label(path: str | PathLike[str]) -> LabelGroup:
    """Read a label.

    Raises
    ------
    InputError
        If the file cannot be read, is cut off, or is not PVL; the field is the group and key (or the line).
    """
    return _Reader(str(path), _text(path)).read()


def _text(path: str | PathLike[str]) -> str:
    data = read_bounded(path, MAX_BYTES)
    if len(data) > MAX_BYTES:
        raise InputError(f"this label is larger than the limit of {MAX_BYTES} bytes", file=path)
    if data[:2] in (b"\xff\xfe", b"\xfe\xff") or b"\0" in data:
        raise InputError("a label must be plain text; this is a binary file or UTF-16", file=path)
    return decoded(data)


class _Token(NamedTuple):
    kind: str
    text: str
    line: int


class _Reader:
    """Reads the tokens of one label in one pass, never backwards."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.tokens = self._scan(text)
        self.next: _Token | None = None
        self.line = 1
        self.advance()

    def _scan(self, text: str) -> Iterator[_Token]:
        line = 1
        for match in _TOKEN.finditer(text):
            kind, found = str(match.lastgroup), match[0]
            if kind != "blank":
                yield _Token(kind, found[1:-1] if kind == "quoted" else found, line)
            line += found.count("\n")

    def advance(self) -> _Token | None:
        """Return the token at hand and go on to the next."""
        token, self.next = self.next, next(self.tokens, None)
        if token is not None:
            self.line = token.line
        return token

    def wrong(self, message: str, field: str) -> InputError:
        return InputError(f"{message} (line {self.line})", file=self.file, field=field or f"line {self.line}")

    def read(self) -> LabelGroup:
        group = self.group("", 0)
        if not group.values and not group.groups:
            raise InputError("this label is empty", file=self.file)
        return group

    def group(self, path: str, depth: int) -> LabelGroup:
        """Read statements up to END_GROUP, or to END outside of all groups."""
        if depth > MAX_DEPTH:
            raise self.wrong("groups are nested too deeply", path)
        values: dict[str, str | tuple[str, ...]] = {}
        groups: dict[str, LabelGroup] = {}
        last = ""
        while True:
            token = self.advance()
            if token is None:
                after = f", after {last}" if last else ""
                raise self.wrong(f"the file is cut off: {'END_GROUP' if path else 'END'} is missing{after}", path)
            if token.text == ";" and token.kind == "mark":
                continue
            place = f"{path}.{token.text[:60]}" if path else token.text[:60]
            if token.kind != "word":
                raise self.wrong(f"{token.text[:40]!r} is not a key", f"{path}.{last}" if last else path)
            word = token.text.upper()
            if word == "END" and not (self.next is not None and self.next.text == "="):
                if path:
                    raise self.wrong("this group has no END_GROUP before END", path)
                return LabelGroup(self.file, path, values, groups)
            if word in _CLOSE:
                self.close(path)
                return LabelGroup(self.file, path, values, groups)
            value = self.value(place)
            if word in _OPEN:
                last = value if isinstance(value, str) else ""
                inner = f"{path}.{last[:60]}" if path else last[:60]
                if not last or last in groups:
                    raise self.wrong("this group appears twice" if last else "this group has no name", inner)
                groups[last] = self.group(inner, depth + 1)
            elif token.text in values:
                raise self.wrong("this key appears twice", place)
            else:
                last = token.text
                values[last] = value

    def close(self, path: str) -> None:
        """Read the rest of END_GROUP: nothing, or the name of the group."""
        if not path:
            raise self.wrong("END_GROUP without a group", f"line {self.line}")
        if self.next is None or self.next.text != "=":
            return
        name = self.value(path)
        if name != path.rpartition(".")[2]:
            raise self.wrong(f"this group ends with END_GROUP = {str(name)[:40]}, not with its own name", path)

    def value(self, place: str) -> str | tuple[str, ...]:
        sign = self.advance()
        if sign is not None and sign.text != "=":
            raise self.wrong("'=' is missing after this key", place)
        token = self.advance()
        if token is None:
            raise self.wrong("the file is cut off before the value of this key", place)
        if token.kind == "mark" and token.text in "({":
            return self.list(place)
        if token.kind not in ("word", "quoted"):
            raise self.wrong("the value of this key is missing", place)
        return token.text

    def list(self, place: str) -> tuple[str, ...]:
        parts: list[str] = []
        while True:
            token = self.advance()
            if token is None:
                raise self.wrong("the file is cut off in this list", place)
            if token.kind == "mark" and token.text in ")}":
                return tuple(parts)
            if token.kind not in ("word", "quoted"):
                raise self.wrong(f"{token.text[:40]!r} is not a list value", place)
            parts.append(token.text)
            if self.next is not None and self.next.text == ",":
                self.advance()
