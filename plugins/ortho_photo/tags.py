"""EXIF and XMP of a photo as GDAL reads them: numbers and texts by name, each checked where it is used.

XMP names are written with the prefix that documentation uses (``drone-dji:GimbalYawDegree``), whatever prefix the file
declares: the namespace decides. A value is an attribute, the text of an element, or the items of a list.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from xml.etree.ElementTree import Element

from ortho_pipeline.plugin import InputError, parse_xml

#: Bytes of XMP that a photo may have, and values in it that are kept.
MAX_XMP, MOST_VALUES = 1_000_000, 2_000
#: Prefix of documentation by namespace, without the slash and version at its end.
PREFIXES = {
    "http://www.dji.com/drone-dji": "drone-dji",
    "http://pix4d.com/camera": "Camera",
    "http://ns.sensefly.com/Camera": "senseFly",
    "http://ns.adobe.com/tiff": "tiff",
    "http://ns.google.com/photos/1.0/panorama": "GPano",
}
REMEDY = "copy the photo again from the camera, or give a camera file and a table of poses (docs/formats/frame.md)"
_VERSION = re.compile(r"/(\d+\.\d+)?/?$")
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d{1,3})?(/\d+\.?\d*)?", re.ASCII)
#: As cameras write a number that they do not know, also as a fraction.
_NOT_FINITE = re.compile(r"[-+]?(nan|inf|infinity)|[-+\d.]+/0+(\.0*)?", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class Tags:
    """The tags of one photo.

    Parameters
    ----------
    path : str
        The photo, for messages.
    exif, xmp : mapping of str to str
        EXIF by GDAL's names without ``EXIF_``; XMP as the module says.
    """

    path: str
    exif: Mapping[str, str]
    xmp: Mapping[str, str]

    def numbers(self, *names: str) -> list[float] | None:
        """Return the numbers of the first of these tags that the photo has; None if it has none of them.

        Raises
        ------
        InputError
            If the tag holds anything but finite numbers.
        """
        for name in names:
            text = self.exif.get(name, self.xmp.get(name))
            if text is not None and text.strip():
                return self.numbers_of(text, name)
        return None

    def numbers_of(self, text: str, name: str) -> list[float]:
        """Return the numbers in a text of a tag."""
        return [self._number(part, name) for part in re.split(r"[\s,;()]+", text[:2000]) if part]

    def number(self, *names: str) -> float | None:
        """Return the number of the first of these tags that the photo has; None if it has none of them."""
        found = self.numbers(*names)
        if found is not None and len(found) != 1:
            raise self.error(f"{len(found)} numbers instead of one", names[0])
        return None if found is None else found[0]

    def optional(self, name: str) -> float | None:
        """Return the number of a tag that nothing needs; None if it is absent or not finite."""
        text = self.text(name).strip("() ")
        return None if _NOT_FINITE.fullmatch(text) else self.number(name)

    def positive(self, *names: str) -> float | None:
        """Return the first positive number of these tags: cameras write 0 or nan for what they do not know."""
        values = (self.optional(name) for name in names)
        return next((value for value in values if value is not None and value > 0), None)

    def text(self, *names: str) -> str:
        """Return the text of the first of these tags that the photo has; empty if it has none of them."""
        texts = ((self.exif.get(name) or self.xmp.get(name) or "").strip() for name in names)
        return next((text[:500] for text in texts if text), "")

    def error(self, message: str, field: str, remedy: Any = REMEDY) -> InputError:
        """Return the error of a tag."""
        return InputError(message, file=self.path, field=field, remedy=remedy)

    def _number(self, text: str, name: str) -> float:
        if not _NUMBER.fullmatch(text[:60]):
            raise self.error(f"{text[:60]!r} is not a number", name)
        above, _, below = text[:60].partition("/")
        value = float(above) / float(below) if below and float(below) else math.nan if below else float(above)
        if not abs(value) < 1e12:
            raise self.error(f"{text[:60]!r} is not a finite number", name)
        return value


def tags_of(dataset: Any) -> Tags:
    """Return the tags of an open photo.

    Raises
    ------
    InputError
        If its XMP is damaged or larger than `MAX_XMP`.
    """
    path = dataset.GetDescription()
    exif = {**(dataset.GetMetadata() or {}), **(dataset.GetMetadata("EXIF") or {})}
    packets = dataset.GetMetadata_List("xml:XMP") or []
    return Tags(
        path,
        {name.removeprefix("EXIF_"): value for name, value in exif.items() if name.startswith("EXIF_")},
        _xmp_of("".join(packets), path) if packets else {},
    )


def has_position(dataset: Any) -> bool:
    """Return whether a photo has a position in EXIF, or an XMP packet of a drone; nothing is parsed."""
    exif = {**(dataset.GetMetadata() or {}), **(dataset.GetMetadata("EXIF") or {})}
    if "EXIF_GPSLatitude" in exif:
        return True
    packets = dataset.GetMetadata_List("xml:XMP") or []
    return any("http://www.dji.com/drone-dji/" in packet for packet in packets)


def _xmp_of(text: str, path: str) -> dict[str, str]:
    if len(text) > MAX_XMP:
        raise InputError("the XMP of this photo is larger than 1 MB", file=path, field="XMP", remedy=REMEDY)
    # The packet is padded for editing in place; GDAL gives it as it is, after the name of its domain.
    root = parse_xml(text.removeprefix("xml:XMP=").strip(" \0\r\n\t\ufeff"), path, REMEDY)
    found: dict[str, str] = {}
    for element in root.iter():
        if isinstance(element.tag, str) and (name := _name(element.tag)) is not None:
            found.setdefault(name, _value(element))
        for attribute, value in element.attrib.items():
            if (name := _name(attribute)) is not None:
                found.setdefault(name, value)
        if len(found) > MOST_VALUES:
            raise InputError("the XMP of this photo has too many values", file=path, field="XMP", remedy=REMEDY)
    return found


def _value(element: Element) -> str:
    """Return the text of an element, or the items of the list in it."""
    items = [(item.text or "").strip() for item in element.iter() if str(item.tag).endswith("}li")]
    return ",".join(items[:100]) if items else (element.text or "").strip()


def _name(tag: str) -> str | None:
    """Return the name with the prefix of documentation; None for other namespaces."""
    space, _, name = tag.removeprefix("{").rpartition("}")
    prefix = PREFIXES.get(_VERSION.sub("", space))
    return None if prefix is None else f"{prefix}:{name}"
