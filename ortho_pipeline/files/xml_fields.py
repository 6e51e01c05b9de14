"""XML of strangers: fields by their path, each with an error that names file, field and remedy."""

from __future__ import annotations

import math
import os
import re
from datetime import datetime
from xml.etree.ElementTree import Element

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files.reading import read_bounded

MAX_SIZE = 5_000_000
#: Numbers in one field, and elements of one name, that a scene may have.
MOST_TERMS, MOST_POINTS = 40, 100_000
#: Columns or rows of an image.
MOST_PIXELS = 10_000_000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?", re.ASCII)
_TIME = re.compile(r"(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d)(\.\d{1,12})?Z?", re.ASCII)


def parse_xml(data: bytes | str, path: os.PathLike[str] | str, remedy: str) -> Element:
    """Return the root of XML that a stranger wrote; its names keep their namespaces.

    Parameters
    ----------
    path : path
        The file that has it, for messages.

    Raises
    ------
    InputError
        If it is no well-formed XML, or has entities or a DTD.

    Examples
    --------
    >>> parse_xml("<scene gain='0.5'/>", "scene.xml", "copy it again").attrib
    {'gain': '0.5'}
    """
    from defusedxml import ElementTree
    from defusedxml.common import DefusedXmlException

    try:
        root: Element = ElementTree.fromstring(data, forbid_dtd=True)
    except (ElementTree.ParseError, DefusedXmlException, ValueError, LookupError) as error:
        raise InputError(f"this is not well-formed XML ({error})", file=path, remedy=remedy) from error
    return root


class XmlFields:
    """The fields of an XML file; names are without their namespaces.

    Parameters
    ----------
    path : path
    remedy : str
        What to do where a field is missing or no value.
    limit : int
        Bytes that the file may have.

    Raises
    ------
    InputError
        If the file cannot be read, is too large or no well-formed XML; later for each field that is missing or no
        value.

    Examples
    --------
    >>> write_text(out / "scene.xml", "<scene><gain>0.5 0.7</gain></scene>")
    >>> XmlFields(out / "scene.xml").numbers("gain", 2)
    [0.5, 0.7]
    """

    def __init__(
        self, path: os.PathLike[str], *, remedy: str = "copy the file again from the delivery", limit: int = MAX_SIZE
    ) -> None:
        self.path, self.remedy = path, remedy
        self._midnight: datetime | None = None
        data = read_bounded(path, limit, remedy=remedy)
        if len(data) > limit:
            size = f"{limit // 1_000_000} MB"
            raise InputError(
                f"this file has more than {size}, too much for the metadata of a scene", file=path, remedy=remedy
            )
        self.root: Element = parse_xml(data, path, remedy)
        for element in self.root.iter():
            if isinstance(element.tag, str) and element.tag.startswith("{"):
                element.tag = element.tag.rpartition("}")[2]

    def error(self, message: str, field: str, remedy: str | None = None) -> InputError:
        """Return the error that a field of this file is."""
        return InputError(message, file=self.path, field=field, remedy=remedy or self.remedy)

    def has(self, field: str) -> bool:
        """Tell whether the file has this element."""
        return self.root.find(field) is not None

    def text(self, field: str, parent: Element | None = None) -> str:
        """Return the text of a field."""
        text = (self.root if parent is None else parent).findtext(field)
        if text is None or not text.strip():
            raise self.error("this field is missing", field)
        return text.strip()

    def said(self, field: str) -> str | None:
        """Return the text of a field that may be missing, and no more of it than people want to read."""
        text = (self.root.findtext(field) or "").strip()
        return text[:200] if text else None

    def all(self, field: str, most: int = MOST_POINTS) -> list[Element]:
        """Return all elements of a path."""
        found = self.root.findall(field)
        if len(found) > most:
            raise self.error(f"there are {len(found)} of these, too many for one scene", field)
        return found

    def numbers(self, field: str, count: int | None, parent: Element | None = None) -> list[float]:
        """Return the finite numbers of a field, `count` of them."""
        return self.numbers_of(self.text(field, parent), field, count)

    def numbers_of(self, text: str, field: str, count: int | None) -> list[float]:
        """Return the finite numbers in a text of a field."""
        tokens = text.split(maxsplit=MOST_TERMS)
        if len(tokens) > MOST_TERMS or (count is not None and len(tokens) != count):
            wanted = counted(count, "number belongs", "numbers belong") if count else "a few numbers belong"
            raise self.error(f"{wanted} here", field)
        values = []
        for token in tokens:
            if len(token) > 60 or not _NUMBER.fullmatch(token):
                raise self.error(f"{token[:60]!r} is not a number", field)
            values.append(float(token))
        if not all(map(math.isfinite, values)):
            raise self.error("a number is too large", field)
        return values

    def number(self, field: str, parent: Element | None = None) -> float:
        """Return the finite number of a field."""
        return self.numbers(field, 1, parent)[0]

    def integer(self, field: str, parent: Element | None = None) -> int:
        """Return the number of rows or columns in a field."""
        value = self.number(field, parent)
        if value != int(value) or not 0 < value <= MOST_PIXELS:
            raise self.error(f"{value} is not an image size", field)
        return int(value)

    def time(self, field: str, parent: Element | None = None) -> float:
        """Return a UTC time as seconds after midnight of the day of the first time that was asked for.

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
