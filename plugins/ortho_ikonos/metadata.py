"""The metadata file of an IKONOS order (``po_<order>_metadata.txt``) and the header of one image (``_hdr.txt``).

Lines of ``=`` separate sections. Blanks nest entries. Records begin at ``Source Image ID`` or ``Component ID`` (older
orders: ``Tile ID``). A component names its product image, which names a source image (docs/formats/ikonos.md). Unknown
keys are ignored; a required key that is missing is an error.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike

from ortho_pipeline.plugin import InputError, Notice, decoded, read_bounded, reads

MAX_BYTES = 2_000_000
MAX_LINE = 10_000
_RULE = re.compile(r"={10,}|-{10,}")
_NUMBER = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([A-Za-z/]*)\.?\s*", re.ASCII)
_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d(?::\d\d(?:\.\d+)?)?)\s*(?:GMT|UTC|Z)?", re.ASCII)
#: Keys at which a record begins.
RECORDS = ("Source Image ID", "Component ID", "Tile ID")
ORDER, SOURCES = "Product Order Metadata", "Source Image Metadata"
SPACE, COMPONENTS = "Product Space Metadata", "Product Component Metadata"
METRES = ("", "m", "meter", "meters", "metre", "metres")
DEGREES = ("", "deg", "degs", "degree", "degrees")
PIXELS = ("", "pixel", "pixels")


@dataclass(frozen=True)
class MetadataLine:
    """One line ``key: value`` and the headings above it."""

    line: int
    groups: tuple[str, ...]
    key: str
    value: str


@dataclass(frozen=True)
class SectionRecord:
    """The entries of one record of a section, by key at any level."""

    file: str
    name: str
    entries: tuple[MetadataLine, ...]

    def text(self, *keys: str) -> str | None:
        """Return the value of the first of these keys that exists and is not empty; None without one.

        Raises
        ------
        InputError
            If the key appears twice with different values.
        """
        for key in keys:
            entries = [entry for entry in self.entries if entry.key.lower() == key.lower() and entry.value]
            if len({entry.value for entry in entries}) > 1:
                lines = ", ".join(str(entry.line) for entry in entries)
                raise InputError(
                    f"this key has different values in lines {lines}",
                    file=self.file,
                    field=f"{self.name}: {key}",
                    remedy="remove the wrong one",
                )
            if entries:
                return entries[0].value
        return None

    def number(self, *keys: str, units: tuple[str, ...] = ("",), low: float = -1e9, high: float = 1e9) -> float | None:
        """Return the number of the first of these keys that is there; None without.

        Raises
        ------
        InputError
            If it is not a number, has another unit, or is out of range.
        """
        value = self.text(*keys)
        if value is None:
            return None
        shown = value if len(value) < 60 else f"{value[:60]}..."
        match = _NUMBER.fullmatch(value[:200])
        number = float(match[1]) if match else math.nan
        problem = None
        if not math.isfinite(number):
            problem = f"{shown!r} is not a number"
        elif match is not None and match[2].lower() not in units:
            problem = f"{shown!r} is in {match[2]}, not in {units[-1] or 'plain numbers'}"
        elif not low <= number <= high:
            problem = f"{shown} is not between {low:g} and {high:g}"
        if problem:
            raise InputError(problem, file=self.file, field=f"{self.name}: {keys[0]}", remedy="correct the file")
        return number

    def count(self, *keys: str, units: tuple[str, ...] = PIXELS) -> int | None:
        """Return a whole number that is not negative; None without one."""
        value = self.number(*keys, units=units, low=0, high=1e7)
        if value is not None and value != int(value):
            raise InputError(
                f"{value} is not a whole number",
                file=self.file,
                field=f"{self.name}: {keys[0]}",
                remedy="correct the file",
            )
        return None if value is None else int(value)


@dataclass(frozen=True)
class SourceImage:
    """One acquisition; angles in degrees, None if not stated.

    `azimuth` and `elevation` are of the satellite as seen from the scene, `azimuth` from true north clockwise.
    """

    source_image: str
    product_image: str
    sensor: str | None
    azimuth: float | None
    elevation: float | None
    sun_azimuth: float | None
    sun_elevation: float | None
    scan_azimuth: float | None
    acquired: str | None
    cloud_percent: float | None


@dataclass(frozen=True)
class MapPlacement:
    """Position of an image on the map; None if not stated.

    `upper_left` is the map position of the *centre* of the first pixel, `size` columns and rows.
    """

    upper_left: tuple[float, float] | None
    pixel: tuple[float, float] | None
    size: tuple[int, int] | None
    reference_height: float | None

    def completed_by(self, other: MapPlacement) -> MapPlacement:
        """Return this placement with missing values taken from another."""
        return MapPlacement(
            self.upper_left or other.upper_left,
            self.pixel or other.pixel,
            self.size or other.size,
            self.reference_height if self.reference_height is not None else other.reference_height,
        )


@dataclass(frozen=True)
class Component:
    """A rectangular piece of a product image, in files of its own."""

    component: str
    product_image: str
    placement: MapPlacement


@dataclass(frozen=True)
class Delivery:
    """The statements of the metadata file of an order.

    `crs` is None if the projection is not UTM on WGS84; `projection` is its name in the file. `product` has what
    belongs to the whole product, not to one component.
    """

    file: str
    order: str | None
    product_line: str | None
    level: str | None
    image_type: str | None
    bits: int | None
    projection: str | None
    crs: str | None
    product: MapPlacement
    sources: tuple[SourceImage, ...]
    components: tuple[Component, ...]
    notes: tuple[Notice, ...] = ()

    def component(self, name: str | None) -> Component:
        """Return the component of this ID; without one the only one that there is.

        Raises
        ------
        InputError
            If there is none, or several.
        """
        components = [one for one in self.components if name is None or one.component == name]
        if len(components) != 1:
            known = ", ".join(one.component for one in self.components[:10])
            problem = "no component" if not components else "more than one component"
            raise InputError(
                f"{problem} is called {name} (there are {known or 'none'})"
                if name is not None
                else f"the file name does not state the component (there are {known or 'none'})",
                file=self.file,
                field=f"{COMPONENTS}: Component ID",
                remedy="give the metadata file that belongs to this image"
                if name is not None
                else "name the image po_<order>_<band>_<component of 7 digits>.tif",
            )
        return components[0]

    def source_of(self, component: Component) -> SourceImage:
        """Return the acquisition that a component shows, by its product image.

        Raises
        ------
        InputError
            If the link is broken.
        """
        sources = [one for one in self.sources if one.product_image == component.product_image]
        if len(sources) != 1:
            raise InputError(
                f"component {component.component} is of product image {component.product_image}, which "
                f"{'no source image has' if not sources else 'several source images have'}",
                file=self.file,
                field=f"{SOURCES}: Product Image ID",
                remedy="get the complete metadata file",
            )
        return sources[0]


@reads("copy the _metadata.txt again from the delivery")
def read_metadata(path: str | PathLike[str]) -> Delivery:
    """Read the metadata file of an order.

    Raises
    ------
    InputError
        Names file, section, key and remedy: a file that is cut off or no such file at all, a missing section, a value
        of a wrong kind or unit, a key with two values.
    """
    text = _text(path)
    sections = _sections(str(path), text)
    order = _head(path, sections, ORDER)
    space = _head(path, sections, SPACE, needed=False)
    sources = [_source(record) for record in _records(path, sections, SOURCES)[1:]]
    title = COMPONENTS if COMPONENTS in sections else SPACE
    parts = _records(path, sections, title)
    components = [_component(record) for record in parts[1:]]
    _check_counts(path, sections, len(sources), len(components))
    notes = []
    if not text.rstrip().endswith("====="):
        if not text.endswith("\n"):
            raise InputError(
                "the file is cut off: its last line does not end", file=path, field=COMPONENTS, remedy="copy it again"
            )
        end = "the metadata file does not end with a line of '='. Was it cut off?"
        notes.append(Notice("maybe-cut-off", end, file=str(path)))
    projection, crs = _projection(order)
    return Delivery(
        file=str(path),
        order=order.text("Product Order Number"),
        product_line=order.text("Product Line"),
        level=order.text("Processing Level"),
        image_type=order.text("Image Type"),
        bits=_bits(order),
        projection=projection,
        crs=crs,
        product=_placement(space),
        sources=tuple(sources),
        components=tuple(components),
        notes=tuple(notes),
    )


@reads("copy the _hdr.txt again from the delivery")
def read_header(path: str | PathLike[str]) -> MapPlacement:
    """Read the position of an image on the map from its ``_hdr.txt``, with the keys of a component.

    Raises
    ------
    InputError
        As `read_metadata`.
    """
    entries = tuple(_entries(_lines(str(path), _text(path))))
    return _placement(SectionRecord(str(path), "header", entries))


# -- text ------------------------------------------------------------------------------------------------------------


def _text(path: str | PathLike[str]) -> str:
    data = read_bounded(path, MAX_BYTES, field="metadata", remedy="give the sensor option metadata=FILE")
    problem = None
    if len(data) > MAX_BYTES:
        problem = f"this file is larger than {MAX_BYTES // 1_000_000} MB, too large for metadata"
    elif data.startswith((b"\xff\xfe", b"\xfe\xff")):
        problem = "this file is UTF-16 text"
    elif b"\0" in data:
        problem = "this is a binary file, not metadata text"
    if problem:
        raise InputError(problem, file=path, field="metadata", remedy="give the _metadata.txt of the delivery")
    return decoded(data)


def _lines(path: str, text: str) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if len(line) > MAX_LINE:
            raise InputError(
                f"this line is too long ({len(line)} characters)",
                file=path,
                field=f"line {number}",
                remedy="copy the file again",
            )
        if line.strip():
            yield number, line.expandtabs(3)


def _sections(path: str, text: str) -> dict[str, list[SectionRecord]]:
    """Return the records of each section by title; the first one has the entries before all records."""
    blocks: list[list[tuple[int, str]]] = [[]]
    for number, line in _lines(path, text):
        if _RULE.fullmatch(line.strip()):
            if line.lstrip()[0] == "=":
                blocks.append([])
        else:
            blocks[-1].append((number, line))
    sections: dict[str, list[SectionRecord]] = {}
    for block in blocks:
        if not block or ":" in block[0][1]:
            continue
        number, title = block[0][0], " ".join(block[0][1].split())
        if title in sections:
            raise InputError(
                f"this section appears again in line {number}",
                file=path,
                field=title[:60],
                remedy="remove one of them",
            )
        sections[title] = _split(path, title, list(_entries(iter(block[1:]))))
    return sections


def _entries(lines: Iterator[tuple[int, str]]) -> Iterator[MetadataLine]:
    above: list[tuple[int, str]] = []
    for number, line in lines:
        depth = len(line) - len(line.lstrip())
        while above and above[-1][0] >= depth:
            above.pop()
        key, colon, value = (" ".join(part.split()) for part in line.partition(":"))
        if colon:
            yield MetadataLine(number, tuple(name for _, name in above), key, value)
        above.append((depth, " ".join(line.split())))


def _split(path: str, title: str, entries: list[MetadataLine]) -> list[SectionRecord]:
    starts = [0, *(k for k, entry in enumerate(entries) if entry.key in RECORDS and not entry.groups), len(entries)]
    records = []
    for k, (start, end) in enumerate(itertools.pairwise(starts)):
        name = title if k == 0 else f"{title}, {entries[start].key} {entries[start].value[:40]}"
        records.append(SectionRecord(path, name, tuple(entries[start:end])))
    return records


def _records(path: str | PathLike[str], sections: dict[str, list[SectionRecord]], title: str) -> list[SectionRecord]:
    if title not in sections:
        raise InputError(
            "this section is missing",
            file=path,
            field=title,
            remedy="give the complete _metadata.txt of the delivery",
        )
    return sections[title]


def _head(
    path: str | PathLike[str], sections: dict[str, list[SectionRecord]], title: str, *, needed: bool = True
) -> SectionRecord:
    if not needed and title not in sections:
        return SectionRecord(str(path), title, ())
    return _records(path, sections, title)[0]


def _check_counts(
    path: str | PathLike[str], sections: dict[str, list[SectionRecord]], sources: int, components: int
) -> None:
    for title, key, count in (
        (SOURCES, "Number of Source Images", sources),
        (COMPONENTS, "Number of Components", components),
    ):
        stated = _head(path, sections, title, needed=False).count(key, units=("",))
        if count == 0 or (stated is not None and stated != count):
            raise InputError(
                f"the file describes {count} of these, but {'at least one' if stated is None else stated} "
                f"should be there",
                file=path,
                field=f"{title}: {key}",
                remedy="the file was cut off or edited; copy it again",
            )


# -- meaning ---------------------------------------------------------------------------------------------------------


def _source(record: SectionRecord) -> SourceImage:
    time = record.text("Acquisition Date/Time")
    match = _TIME.fullmatch(time) if time else None
    return SourceImage(
        source_image=_identity(record, "Source Image ID"),
        product_image=_identity(record, "Product Image ID"),
        sensor=record.text("Sensor"),
        azimuth=record.number("Nominal Collection Azimuth", units=DEGREES, low=-360, high=360),
        elevation=record.number("Nominal Collection Elevation", units=DEGREES, low=0, high=90),
        sun_azimuth=record.number("Sun Angle Azimuth", units=DEGREES, low=-360, high=360),
        sun_elevation=record.number("Sun Angle Elevation", units=DEGREES, low=-90, high=90),
        scan_azimuth=record.number("Scan Azimuth", units=DEGREES, low=-360, high=360),
        acquired=f"{match[1]}T{match[2]}Z" if match else time,
        cloud_percent=record.number("Percent Cloud Cover", units=("", "percent"), low=-1, high=999),
    )


def _component(record: SectionRecord) -> Component:
    return Component(
        component=_identity(record, "Component ID", "Tile ID"),
        product_image=_identity(record, "Product Image ID"),
        placement=_placement(record),
    )


def _identity(record: SectionRecord, *keys: str) -> str:
    value = record.text(*keys)
    if value is None:
        raise InputError(
            "this key is missing",
            file=record.file,
            field=f"{record.name}: {keys[0]}",
            remedy="this key links components with acquisitions; give the complete metadata file",
        )
    return value


def _placement(record: SectionRecord) -> MapPlacement:
    x = record.number("UL Map X (Easting)", "UL Map X", units=METRES)
    y = record.number("UL Map Y (Northing)", "UL Map Y", units=METRES)
    dx = record.number("Pixel Size X", units=METRES, low=0.01, high=1000)
    dy = record.number("Pixel Size Y", units=METRES, low=0.01, high=1000)
    columns, rows = record.count("Columns"), record.count("Rows")
    for first, second, key in (
        (x, y, "UL Map X, UL Map Y"),
        (dx, dy, "Pixel Size X, Pixel Size Y"),
        (columns, rows, "Columns, Rows"),
    ):
        if (first is None) != (second is None):
            raise InputError(
                "give both values; one is missing",
                file=record.file,
                field=f"{record.name}: {key}",
                remedy="the file was cut off or edited; copy it again",
            )
    return MapPlacement(
        upper_left=None if x is None or y is None else (x, y),
        pixel=None if dx is None or dy is None else (dx, dy),
        size=None if columns is None or rows is None else (columns, rows),
        reference_height=record.number("Reference Height", units=METRES, low=-1000, high=10_000),
    )


def _bits(order: SectionRecord) -> int | None:
    text = order.text("Bits per Pixel per Band")
    match = re.match(r"\d{1,3}\b", text, re.ASCII) if text else None
    return int(match[0]) if match else None


def _projection(order: SectionRecord) -> tuple[str | None, str | None]:
    """Return what the file calls its map projection, and its CRS where that is UTM on WGS84."""
    name, datum = order.text("Map Projection"), order.text("Datum")
    if name is None:
        return None, None
    shown = f"{name}, datum {datum or 'not stated'}"
    utm = name.lower() in ("universal transverse mercator", "utm")
    if not utm or datum is None or re.sub(r"[\s_-]", "", datum).upper() not in ("WGS84", "WGS1984"):
        return shown, None
    zone, hemisphere = order.count("Zone Number", "Zone", units=("",)), (order.text("Hemisphere") or "").upper()[:1]
    if zone is None or not 1 <= zone <= 60 or hemisphere not in ("N", "S"):
        raise InputError(
            f"zone {zone} {hemisphere or '(no hemisphere)'} is not a UTM zone",
            file=order.file,
            field=f"{order.name}: UTM Specific Parameters",
            remedy="Zone Number 1 to 60, Hemisphere N or S",
        )
    return shown, f"EPSG:{(32600 if hemisphere == 'N' else 32700) + zone}"
