"""DIMAP metadata as a file of strangers: fields by their path, each with an error that names file, field and remedy."""

from __future__ import annotations

import math
import re
from datetime import datetime
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError, counted
from ortho_pipeline.files import read_bounded
from ortho_pipeline.models.pushbroom.line_camera import MOST_PIXELS

Array = NDArray[np.float64]

MAX_SIZE = 5_000_000
MOST_TERMS, MOST_POINTS = 10, 100_000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?", re.ASCII)
_TIME = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(\.\d{1,12})?Z?", re.ASCII)


class DimapFile:
    """DIMAP metadata of version 1 or 2.

    Raises
    ------
    InputError
        If the file cannot be read, is too large or no well-formed XML; later for each field that is missing or no
        value.
    """

    def __init__(self, path: Path) -> None:
        from defusedxml import ElementTree
        from defusedxml.common import DefusedXmlException

        self.path = path
        self._midnight: datetime | None = None
        data = read_bounded(path, MAX_SIZE)
        if len(data) > MAX_SIZE:
            raise InputError("this file has more than 5 MB, which no metadata of a scene has", file=path)
        try:
            self.root: Element = ElementTree.fromstring(data, forbid_dtd=True)
        except (ElementTree.ParseError, DefusedXmlException, ValueError, LookupError) as error:
            raise InputError(f"this is not well-formed XML ({error})", file=path) from error

    def error(self, message: str, field: str, remedy: str | None = "use the RPC") -> InputError:
        """Return the error that a field of this file is."""
        return InputError(message, file=self.path, field=field, remedy=remedy)

    def has(self, field: str) -> bool:
        """Tell whether the file has this element."""
        return self.root.find(field) is not None

    def text(self, field: str, parent: Element | None = None) -> str:
        """Return the text of a field."""
        text = (self.root if parent is None else parent).findtext(field)
        if text is None or not text.strip():
            raise self.error("this field is missing", field)
        return text.strip()

    def all(self, field: str, most: int = MOST_POINTS) -> list[Element]:
        """Return all elements of a path."""
        found = self.root.findall(field)
        if len(found) > most:
            raise self.error(f"there are {len(found)} of these, more than one scene has", field)
        return found

    def numbers(self, field: str, count: int | None, parent: Element | None = None) -> list[float]:
        """Return the finite numbers of a field, `count` of them."""
        tokens = self.text(field, parent).split(maxsplit=MOST_TERMS)
        if len(tokens) > MOST_TERMS or (count is not None and len(tokens) != count):
            wanted = counted(count, "number belongs", "numbers belong") if count else "a few numbers belong"
            raise self.error(f"{wanted} here", field)
        values = []
        for token in tokens:
            if not _NUMBER.fullmatch(token[:60]):
                raise self.error(f"{token[:60]!r} is not a number", field)
            values.append(float(token[:60]))
        if not all(map(math.isfinite, values)):
            raise self.error("a number is too large", field)
        return values

    def number(self, field: str, parent: Element | None = None) -> float:
        """Return the finite number of a field."""
        return self.numbers(field, 1, parent)[0]

    def integer(self, field: str) -> int:
        """Return the number of rows or columns in a field."""
        value = self.number(field)
        if value != int(value) or not 0 < value <= MOST_PIXELS:
            raise self.error(f"{value} is not a size of an image", field)
        return int(value)

    def polynomial(self, field: str) -> Array:
        """Return the coefficients, lowest power first, of a polynomial with its degree."""
        terms = self.numbers(f"{field}/COEFFICIENTS", None)
        if len(terms) != self.number(f"{field}/DEGREE") + 1:
            raise self.error("degree and coefficients do not match", field)
        return np.array(terms)

    def time(self, field: str, parent: Element | None = None) -> float:
        """Return a UTC time as seconds after midnight of the day on which the image begins.

        Counted from an epoch far away the seconds would be rounded to a millimetre of orbit.
        """
        text = self.text(field, parent)
        found = _TIME.fullmatch(text[:60])
        try:
            whole = datetime.fromisoformat(found[1]) if found else None
        except ValueError:
            whole = None
        if found is None or whole is None:
            raise self.error(f"{text[:60]!r} is not a time", field)
        self._midnight = self._midnight or whole.replace(hour=0, minute=0, second=0)
        return (whole - self._midnight).total_seconds() + float(found[2] or 0.0)
