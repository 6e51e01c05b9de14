"""Names of other files in rasters that refer to some: VRT, DIMAP, ERS, ISIS3, PCIDSK, TIL.

They are read without opening what they name.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.files.locations import VsiPath
from ortho_pipeline.files.shell import converted

#: Headers beyond this are not read.
_MAX_HEADER = 5_000_000
#: Allowed attributes and elements of a plain VRT, in lower case, as GDAL compares them.
_VRT_NAMES = frozenset(
    re.findall(
        r"\S+",
        """
        vrtdataset rasterxsize rasterysize subclass srs dataaxistosrsaxismapping coordinateepoch geotransform metadata
        gcplist vrtrasterband datatype band blockxsize blockysize description unittype offset scale nodatavalue
        hidenodatavalue colorinterp colortable categorynames histograms gdalrasterattributetable maskband overview
        overviewlist resampling simplesource complexsource averagedsource kernelfilteredsource name sourcefilename
        relativetovrt shared sourceband sourceproperties srcrect dstrect xoff yoff xsize ysize nodata usemaskband lut
        scaleoffset scaleratio exponent srcmin srcmax dstmin dstmax clamp colortablecomponent kernel normalized size
        coefs imageoffset pixeloffset lineoffset byteorder ?xml version encoding standalone
        """,
    )
)
#: Parts of a VRT that hold text only, whatever is in them.
_VRT_TEXTS = frozenset(
    {
        "srs",
        "metadata",
        "gcplist",
        "histograms",
        "gdalrasterattributetable",
        "colortable",
        "categorynames",
        "description",
    }
)
#: Elements with a coordinate system in VRTs, sidecars of GDAL and Esri, and DIMAP, in lower case.
_CRS_NAMES = frozenset({"srs", "projection", "wkt", "horizontal_cs_code", "horizontal_cs_name"})
_VRT_CLASSES = frozenset({"vrtdataset", "vrtrasterband", "vrtsourcedrasterband", "vrtrawrasterband"})


def to_one_file(path: str | os.PathLike[str]) -> str:
    """Return the remedy for a raster whose files cannot be told from its header."""
    return f"convert it to one file: `gdal_translate {converted(path, 'copy')}`"


@dataclass(frozen=True)
class Named:
    """A file that the header of another one names; `raw` if GDAL reads its bytes, not a raster."""

    name: str
    field: str
    relative: bool = True
    raw: bool = False


def _header(path: Any, limit: int = _MAX_HEADER) -> str:
    """Return a header as C reads it: up to the first NUL."""
    if not path.is_file():
        raise InputError("this is not a file", file=path, remedy="put a file there, or remove it")
    if path.stat().st_size > limit:
        raise InputError("the header is larger than 5 MB", file=path, remedy=to_one_file(path))
    data = path.read_bytes().partition(b"\0")[0]
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _xml(path: Any) -> Any:
    """Return XML as GDAL understands it: nodes ``[kind, name, *children]``, whether well-formed or not."""
    try:
        # Of an empty file it is None. An interrupted program leaves such side-cars, and GDAL ignores them.
        return gdal.ParseXMLString(_header(path)) or [_ELEMENT, ""]
    except (RuntimeError, UnicodeDecodeError) as error:
        raise InputError(
            f"this is not well-formed XML ({str(error).strip()})", file=path, remedy="copy the file again"
        ) from error


_ELEMENT, _TEXT, _ATTRIBUTE = 0, 1, 2


def _parts(node: Any) -> Iterator[tuple[str, Any]]:
    """Yield attributes and elements of a node, which GDAL does not tell apart, by their names in lower case."""
    for child in node[2:]:
        if child[0] in (_ELEMENT, _ATTRIBUTE):
            yield str(child[1]).lower(), child


def _value(node: Any) -> list[str]:
    return [str(child[1]) for child in node[2:] if child[0] == _TEXT]


def _names_of_vrt(path: Any) -> Iterator[Named]:
    """Yield the sources of a plain VRT; refuse any other one."""
    pending: list[tuple[Any, str]] = [([_ELEMENT, "", _xml(path)], "")]
    while pending:
        node, band = pending.pop()
        for name, child in _parts(node):
            if name == "" or name in _VRT_TEXTS:
                if name == "":
                    pending.append((child, band))
                continue
            values = [text.lower() for text in _value(child)]
            if name not in _VRT_NAMES or (name == "subclass" and not _VRT_CLASSES.issuperset(values)):
                raise InputError(
                    f"only plain VRTs are opened; {child[1]} {' '.join(values)[:40]} is not allowed",
                    file=path,
                    field=child[1][:80],
                    remedy=to_one_file(path),
                )
            if name == "sourcefilename":
                yield _source(child, path, band)
            kinds = [text.lower() for part, one in _parts(child) if part == "subclass" for text in _value(one)]
            raw = name == "vrtrasterband" and kinds == ["vrtrawrasterband"]
            pending.append((child, "raw" if raw else ""))


def _source(node: Any, path: Any, band: str) -> Named:
    texts = _value(node)
    relative = [text.strip() for name, one in _parts(node) if name == "relativetovrt" for text in _value(one)]
    if len(texts) != 1 or len(relative) > 1 or not set(relative) <= {"0", "1"}:
        raise InputError(
            "a source of this VRT has no plain file name", file=path, field="SourceFilename", remedy=to_one_file(path)
        )
    return Named(texts[0], "SourceFilename", relative=relative == ["1"], raw=band == "raw")


def crs_texts(path: Any, kind: str) -> Iterator[str]:
    """Yield the texts in a header or sidecar that GDAL converts to a coordinate system while it opens the raster.

    Parameters
    ----------
    kind : str
        A driver, or the ending of a sidecar: those of XML, ``.prj`` and ``.hdr``; others yield nothing.
    """
    if kind == ".prj":
        yield _header(path)
    elif kind == ".hdr":
        yield from re.findall(r"coordinate system string\s*=\s*\{([^}]*)", _header(path), re.IGNORECASE)
    elif kind in ("VRT", "DIMAP", ".aux.xml"):
        pending = [[_ELEMENT, "", _xml(path)]]
        while pending:
            for name, child in _parts(pending.pop()):
                pending.append(child)
                keys = [text.lower() for part, one in _parts(child) if part == "key" for text in _value(one)]
                if name in _CRS_NAMES or "srs" in keys:
                    yield from _value(child)


def _names_of_dimap(path: Any) -> Iterator[Named]:
    """Yield the images and the parts of a product that DIMAP metadata name: what is called ``..._PATH``."""
    pending = [[_ELEMENT, "", _xml(path)]]
    while pending:
        node = pending.pop()
        for name, child in _parts(node):
            pending.append(child)
            if name in ("data_file_path", "component_path"):
                hrefs = [text for part, one in _parts(child) if part == "href" for text in _value(one)]
                for text in hrefs or _value(child):
                    yield Named(text, name.upper())


def products_of_volume(path: Any) -> list[str]:
    """Return the names of the products that a DIMAP volume consists of; none where a file describes an image itself."""
    document = next((child for name, child in _parts([_ELEMENT, "", _xml(path)]) if name == "dimap_document"), None)
    if document is None or _inner(document, "raster_data"):
        return []
    components = [
        part
        for content in _inner(document, "dataset_content")
        for parts in _inner(content, "dataset_components")
        for part in _inner(parts, "component")
    ]
    return [
        text.strip()
        for part in components
        if any("DIMAP" in _value(kind) for kind in _inner(part, "component_type"))
        for place in _inner(part, "component_path")
        for href in _inner(place, "href")
        for text in _value(href)
    ]


def _inner(node: Any, name: str) -> list[Any]:
    return [child for key, child in _parts(node) if key == name]


def _names_of_ers(path: Any) -> Iterator[Named]:
    """Yield the data file of an ERS header: raw pixels, or any raster where it is "Translated"."""
    text = _header(path)
    raw = "translated" not in text.lower()
    for match in re.finditer(r"datafile", text, re.IGNORECASE):
        named = re.compile(r"""[ \t]*=[ \t]*("[^"'\r\n]*"|[^"'\s]+)[ \t]*(?=[\r\n]|$)""").match(text, match.end())
        if named is None:
            raise InputError(
                "DataFile has no plain value",
                file=path,
                field="DataFile",
                remedy=to_one_file(path),
            )
        yield Named(named[1].strip('"'), "DataFile", raw=raw)
    yield Named(Path(path.name).stem, "DataFile", raw=raw)


def _names_of_isis3(path: Any) -> Iterator[Named]:
    """Yield the file that holds the pixels of a detached ISIS3 label."""
    data = _beginning(path, _MAX_HEADER)
    end = re.search(rb"\r?\n(END|End)\r?\n", data + (b"\n" if len(data) < _MAX_HEADER else b""))
    if end is None and len(data) >= _MAX_HEADER:
        raise InputError("the label is larger than 5 MB", file=path, remedy=to_one_file(path))
    text = data.decode("latin-1")
    raw = "geotiff" not in text.lower()
    for match in re.finditer(r"\^core", text, re.IGNORECASE):
        named = re.compile(r"""\s*=\s*("[^"'\r\n]*"|(?!/\*)[^"'\s(#]+)\s""").match(text + "\n", match.end())
        if named is None:
            raise InputError("^Core has no plain value", file=path, field="^Core", remedy=to_one_file(path))
        yield Named(named[1].strip('"'), "^Core", raw=raw)


def _names_of_pcidsk(path: Any) -> Iterator[Named]:
    """Refuse a PCIDSK file with channels in other files, which GDAL does not list; yield nothing."""
    start = _beginning(path, 512)
    try:
        headers, count = (int(start[336:352]) - 1) * 512, int(start[376:384])
        images = (
            _beginning(path, headers + 1024 * count)[headers:] if 0 <= headers + 1024 * count < _MAX_HEADER else b""
        )
    except ValueError:
        images, count = b"", 1
    names = [images[k + 64 : k + 128].strip(b" \0") for k in range(0, len(images), 1024)]
    if len(images) < 1024 * count or any(name and not name.startswith(b"/SIS=") for name in names):
        raise InputError(
            "the channels of this PCIDSK file are in other files",
            file=path,
            field="IHi.2",
            remedy=to_one_file(path),
        )
    yield from ()


def _names_of_til(path: Any) -> Iterator[Named]:
    """Yield the tiles of a product of DigitalGlobe."""
    for match in re.finditer(r"""filename[ \t]*=[ \t]*("[^"\r\n]*"|[^"\s;]+)""", _header(path), re.IGNORECASE):
        yield Named(match[1].strip('"'), "filename")


def _beginning(path: Any, size: int) -> bytes:
    if isinstance(path, VsiPath):
        return path.read(size)
    with path.open("rb") as file:
        return bytes(file.read(size))


NAMES_OF: dict[str, Any] = {
    "VRT": _names_of_vrt,
    "DIMAP": _names_of_dimap,
    "ERS": _names_of_ers,
    "ISIS3": _names_of_isis3,
    "PCIDSK": _names_of_pcidsk,
    "TIL": _names_of_til,
}
