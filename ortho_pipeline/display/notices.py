"""Notices to read before a result is trusted, each with a code that programs compare.

A module that treats some notices in a way of its own compares their codes, never their sentences. docs/notices.md
lists all codes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NoReturn

from ortho_pipeline.errors.texts import Text
from ortho_pipeline.files.json.values import json_value

_CODE = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
#: Code of a warning of a sensor that came as text alone.
FROM_SENSOR = "from-sensor"


class Notice(Text):
    """A warning: a text that also has a code and fields.

    A notice is a string, so that code which only shows it needs nothing else. Notices with the same text are equal.

    Parameters
    ----------
    code : str
        Kind of notice, in lower case with hyphens. Texts may change between versions, codes do not.
    text : str
        Sentence for people.
    **fields
        Its numbers and names, and lists of them.

    Examples
    --------
    >>> notice = Notice("dem-covers-part", "the DEM covers 83 % of the scene", coverage=0.83)
    >>> notice.code, notice.fields["coverage"]
    ('dem-covers-part', 0.83)
    """

    __slots__ = ("code", "fields")

    code: str
    fields: Mapping[str, Any]

    def __new__(cls, code: str, text: str, **fields: Any) -> Notice:
        """Make a notice of a code, a text and fields."""
        if not _CODE.fullmatch(code):
            raise ValueError(f"{code!r} is not a notice code; use lower case and hyphens")
        notice = super().__new__(cls, text)
        object.__setattr__(notice, "code", code)
        object.__setattr__(notice, "fields", MappingProxyType(fields))
        return notice

    def __setattr__(self, name: str, value: object) -> NoReturn:
        """Refuse: a notice stays as it is."""
        raise AttributeError(f"a notice cannot be changed: {name}")

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (self.code, Text(self), dict(self.fields))

    def in_image(self, label: str) -> Notice:
        """Return the notice as one of an image among several."""
        return Notice(self.code, Text(f"image {label}: ", self), **{**self.fields, "image": label})

    def to_json(self) -> dict[str, Any]:
        """Return code, text and fields as JSON values."""
        return {"code": self.code, "text": Text(self), **json_value(self.fields)}


def _rebuilt(code: str, text: str, fields: Mapping[str, Any]) -> Notice:
    return Notice(code, text, **fields)


def with_code(texts: Iterable[str], code: str) -> tuple[Notice, ...]:
    """Return texts as notices: what is none yet gets this code."""
    return tuple(text if isinstance(text, Notice) else Notice(code, text) for text in texts)


def to_document(notices: Iterable[Notice]) -> dict[str, Any]:
    """Return the members `warnings` (texts) and `notices` (with codes) of a JSON document, in one order."""
    found = list(notices)
    return {"warnings": [Text(one) for one in found], "notices": [one.to_json() for one in found]}


def doubted(notices: Sequence[Mapping[str, Any]]) -> frozenset[str]:
    """Return the points of which notices of a document say that they contradict the others, and that count."""
    one = {notice["point"] for notice in notices if notice["code"] == "contradicting-point"}
    return frozenset(one.union(*(notice["points"] for notice in notices if notice["code"] == "checks-apart")))
