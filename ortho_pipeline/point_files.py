"""Point files as they are written: each format's origin, order and header, undone on the line that reads them.

Readers return a `Table`: image points as (column, row) from the outer corner of the first pixel, ground points as the
file has them, with what it says about their CRS. `ortho_pipeline.points` makes ellipsoidal heights of that.
"""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from ortho_pipeline.errors import CrsError, InputError

#: A point file beyond this is not read (bytes), nor a line beyond that (characters).
MAX_FILE = 32_000_000
MAX_LINE = 100_000
ROLES = ("control", "check", "tie")
CSV_COLUMNS = ("id", "col", "row", "x", "y", "h", "role", "sigma_image", "sigma_xy", "sigma_h")
#: Column of a CSV of several images: the file that a point was measured in.
CSV_IMAGE = "image"


class Layout(NamedTuple):
    """Columns that a CSV may have, those that every line fills, and the role of lines that give none."""

    columns: tuple[str, ...]
    needed: tuple[str, ...]
    role: str


#: Points of one image; rays of a block, whose ground may be known; ground alone.
OF_IMAGE = Layout((*CSV_COLUMNS, CSV_IMAGE), CSV_COLUMNS[:5], "control")
OF_BLOCK = Layout(("id", CSV_IMAGE, *CSV_COLUMNS[1:]), ("id", CSV_IMAGE, "col", "row"), "")
OF_GROUND = Layout(("id", *CSV_COLUMNS[3:7], *CSV_COLUMNS[8:]), ("id", "x", "y"), "")
#: Columns of a CSV that are for people.
CSV_IGNORED = ("info", "note", "comment", "description")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_FORMATS = "CSV/TSV (id,col,row,x,y,h,...), GeoJSON with 'ji', QGIS .points, ODM gcp_list.txt, ENVI .pts"


#: Where another image lies in this one: column and row of its first corner, and the width of one of its pixels.
Piece = tuple[float, float, float]
OWN_IMAGE: Piece = (0.0, 0.0, 1.0)


@dataclass
class Row:
    """One point as its file has it; None is what the file does not give. `piece` is where its image lies."""

    where: str
    id: str | None
    image: tuple[float, float]
    ground: tuple[float, float, float]
    role: str = "control"
    sigma_image: float | None = None
    sigma_xy: float | None = None
    sigma_h: float | None = None
    image_name: str | None = None
    piece: Piece = OWN_IMAGE


@dataclass
class Table:
    """All points of a file, and what it says about their coordinates.

    `vertical` is stated by the file; `assumed_vertical` is what the format means where nothing is stated.
    """

    format: str
    rows: list[Row] = field(default_factory=list)
    crs: str | None = None
    vertical: str | None = None
    assumed_vertical: str | None = None
    centre_origin_allowed: bool = False


class Line(NamedTuple):
    """A line that is not blank, and its number."""

    number: int
    text: str


def read_table(
    path: str | os.PathLike[str],
    image_name: str | None = None,
    pieces: Mapping[str, Piece] | None = None,
) -> Table:
    """Read a point file; its format is known by its content, then by its suffix.

    Parameters
    ----------
    image_name : str, optional
        Keep the points of this image, where a file holds points of several.
    pieces : mapping of str to (float, float, float), optional
        Further images whose points are kept: column and row of their first corner in this image, and the width of one
        of their pixels.

    Raises
    ------
    InputError
        For anything that is not a table of finite numbers; names file, line and column.
    """
    text = load_text(path)
    table = _reader(path, text)(path, text)
    if not table.rows:
        raise InputError("this file holds no points", file=path, remedy=f"give one of: {_FORMATS}")
    return _of_image(path, table, image_name, pieces or {})


def read_block_table(path: str | os.PathLike[str], layout: Layout = OF_BLOCK) -> Table:
    """Read the rays of a block, or with `OF_GROUND` ground alone: CSV, GeoJSON, and rays as ODM list.

    Raises
    ------
    InputError
        As `read_table`; also for a line that does not say which image it is of.
    """
    text = load_text(path)
    reader = _reader(path, text, layout)
    if reader is read_csv or reader is read_geojson:
        table = reader(path, text, layout)
    elif reader is read_odm and layout is OF_BLOCK:
        table = read_odm(path, text)
    else:
        raise InputError(
            "points of several images do not stand in this format", file=path,
            remedy="give CSV (id,image,col,row[,x,y,h,...]), GeoJSON with 'ji' by image, or an ODM gcp_list.txt",
        )  # fmt: skip
    if not table.rows:
        raise InputError("this file holds no points", file=path, remedy="add points to it")
    return table


def _reader(
    path: str | os.PathLike[str], text: str, layout: Layout = OF_IMAGE
) -> Callable[[str | os.PathLike[str], str], Table]:
    suffix = Path(path).suffix.lower()
    start = text.lstrip()[:4096]
    if start.startswith(("{", "[")) or suffix in (".geojson", ".json"):
        return read_geojson
    if suffix == ".points" or re.search(r"(?mi)^mapX\s*,", start):
        return read_qgis
    if suffix == ".pts" or re.match(r";.*", start):
        return read_envi
    lines = [line.lower() for line in start.splitlines() if line.strip() and not line.startswith("#")]
    names = set(re.split(r"[\s,;|]+", lines[0].replace('"', "").strip())) if lines else set()
    if suffix in (".csv", ".tsv") or set(layout.needed) <= names or {"col", "row"} <= names:
        return read_csv
    if lines and _odm_crs(lines[0]) is not None:
        return read_odm
    raise InputError("the format of this point file is not known", file=path, remedy=f"give one of: {_FORMATS}")


def _of_image(path: str | os.PathLike[str], table: Table, image_name: str | None, pieces: Mapping[str, Piece]) -> Table:
    named = {row.image_name for row in table.rows if row.image_name}
    if image_name is None or not named:
        return table
    kept: list[Row] = []
    for name, piece in {image_name: OWN_IMAGE, **pieces}.items():
        wanted, ids = Path(name).stem.lower(), {row.id for row in kept} - {None}
        # A point that was measured in several of the images counts once: where it was measured first, this image ahead.
        kept += [
            replace(row, piece=piece)
            for row in table.rows
            if row.image_name and Path(row.image_name).stem.lower() == wanted and row.id not in ids
        ]
    if not kept and table.format == "GeoJSON" and len(named) == 1:
        # The 'filename' of a GeoJSON is a remark; a renamed image still has these points.
        return table
    if not kept:
        some = ", ".join(sorted(map(str, named))[:5])
        raise InputError(
            f"no point belongs to the image {image_name!r}; there are points of {some}",
            file=path,
            field="image",
            remedy="use the name of the image that the points were measured in",
        )
    table.rows = kept
    return table


# -- text and numbers ------------------------------------------------------------------------------------------------


def load_text(path: str | os.PathLike[str]) -> str:
    """Return a file as text: UTF-8, a byte-order mark allowed, no NUL, no larger than `MAX_FILE`."""
    try:
        if Path(path).stat().st_size > MAX_FILE:
            raise InputError(f"a point file of more than {MAX_FILE // 1_000_000} MB is not read", file=path)
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path, remedy="check the path") from error
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise InputError("this file is UTF-16", file=path, remedy="save it as UTF-8")
    if b"\0" in data:
        line = data[: data.index(b"\0")].count(b"\n") + 1
        raise InputError("a NUL byte: this is no text file", file=path, field=f"line {line}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise InputError(
            "this file is not UTF-8", file=path, field=f"line {line}", remedy="save it as UTF-8"
        ) from error


def number(text: Any, path: str | os.PathLike[str], where: str) -> float:
    """Return a finite number; `where` (line and column) goes into the error."""
    if isinstance(text, bool) or not isinstance(text, str | int | float):
        raise InputError(f"{_short(text)} is not a number", file=path, field=where)
    try:
        plain = text.strip() if isinstance(text, str) else text
        if isinstance(plain, str) and (len(plain) > 64 or not _NUMBER.fullmatch(plain)):
            raise ValueError
        value = float(plain)
    except (ValueError, OverflowError):
        comma = isinstance(text, str) and re.fullmatch(r"\s*[+-]?\d*,\d+\s*", text)
        remedy = "write numbers with a decimal point" if comma else None
        raise InputError(f"{_short(text)} is not a number", file=path, field=where, remedy=remedy) from None
    if not math.isfinite(value):
        raise InputError(f"{_short(text)} is not a finite number", file=path, field=where)
    return value


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 48 else f"{text[:48]}..."


def _lines(path: str | os.PathLike[str], text: str) -> Iterator[Line]:
    for count, line in enumerate(text.splitlines(), start=1):
        if len(line) > MAX_LINE:
            raise InputError(f"a line of {len(line)} characters", file=path, field=f"line {count}")
        if line.strip():
            yield Line(count, line)


def _role(text: Any, path: str | os.PathLike[str], where: str) -> str:
    role = str(text).strip().lower()
    if role not in ROLES:
        raise InputError(
            f"{_short(text)} is not a role", file=path, field=where, remedy=f"use one of {', '.join(ROLES)}"
        )
    return role


def _sigma(text: Any, path: str | os.PathLike[str], where: str, *, zero: bool) -> float:
    value = number(text, path, where)
    if value < 0 or (value == 0 and not zero):
        raise InputError(f"{_short(text)} is not a standard deviation", file=path, field=where)
    return value


# -- CSV and TSV -----------------------------------------------------------------------------------------------------


def read_csv(path: str | os.PathLike[str], text: str, layout: Layout = OF_IMAGE) -> Table:
    """Read our own table: header ``id,col,row,x,y,h[,role][,sigma_image][,sigma_xy][,sigma_h][,image]``.

    The delimiter (comma, semicolon, tab, bar) is that of the header. Lines that start with ``#`` are comments; of these
    ``#CRS: ...`` and ``#vertical: ...`` state what the coordinates are. An empty `h` is a height that is not given.
    """
    table = Table("CSV", centre_origin_allowed=True)
    names: list[str] = []
    delimiter = ","
    for line in _lines(path, text):
        comment = re.match(r"#\s*(\w+)\s*:\s*(.+)", line.text)
        if comment and comment.group(1).lower() == "crs":
            table.crs = comment.group(2).strip()
        elif comment and comment.group(1).lower() == "vertical":
            table.vertical = comment.group(2).strip()
        if line.text.startswith("#"):
            continue
        if not names:
            delimiter = max("\t;,|", key=line.text.count)
            names = _csv_header(path, line, delimiter, layout)
            continue
        table.rows.append(_csv_row(path, line, delimiter, names, layout))
    return table


def _cells(path: str | os.PathLike[str], line: Line, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line.text], delimiter=delimiter, strict=True))]
    except csv.Error as error:
        raise InputError(f"the line cannot be split ({error})", file=path, field=f"line {line.number}") from error


def _csv_header(path: str | os.PathLike[str], line: Line, delimiter: str, layout: Layout) -> list[str]:
    names = [name.lower() for name in _cells(path, line, delimiter)]
    allowed = f"the columns are {', '.join(layout.columns)}"
    for name in names:
        if name not in (*layout.columns, *CSV_IGNORED) or names.count(name) > 1:
            problem = "twice" if names.count(name) > 1 else "not known"
            raise InputError(
                f"the column {_short(name)} is {problem}", file=path, field=f"line {line.number}", remedy=allowed
            )
    missing = [name for name in layout.needed if name not in names]
    if missing:
        raise InputError(
            f"no column {', '.join(missing)} in the header", file=path, field=f"line {line.number}", remedy=allowed
        )
    return names


def _csv_row(
    path: str | os.PathLike[str], line: Line, delimiter: str, names: list[str], layout: Layout
) -> Row:  # fmt: skip
    cells = _cells(path, line, delimiter)
    where = f"line {line.number}"
    if len(cells) != len(names):
        remedy = "a decimal comma splits numbers: write decimal points" if len(cells) > len(names) else None
        raise InputError(f"{len(cells)} cells under {len(names)} column names", file=path, field=where, remedy=remedy)
    given = {name: cell for name, cell in zip(names, cells, strict=True) if cell}

    def value(name: str) -> float:
        if name not in given and name not in layout.needed:
            return math.nan
        return number(given.get(name, ""), path, f"{where}, column {name}")

    def sigma(name: str, zero: bool) -> float | None:
        return _sigma(given[name], path, f"{where}, column {name}", zero=zero) if name in given else None

    for name, what in (("id", "an id"), (CSV_IMAGE, "an image")):
        if (name in layout.needed or name == "id") and name not in given:
            raise InputError(f"a point without {what}", file=path, field=f"{where}, column {name}")
    return Row(
        where=where,
        id=given["id"],
        image=(value("col"), value("row")),
        ground=(value("x"), value("y"), value("h")),
        role=_role(given["role"], path, f"{where}, column role") if "role" in given else layout.role,
        sigma_image=sigma("sigma_image", False),
        sigma_xy=sigma("sigma_xy", True),
        sigma_h=sigma("sigma_h", True),
        image_name=given.get(CSV_IMAGE),
    )


# -- GeoJSON ---------------------------------------------------------------------------------------------------------


def read_geojson(path: str | os.PathLike[str], text: str, layout: Layout = OF_IMAGE) -> Table:
    """Read points with a property ``ji`` = [column, row] from the *centre* of the first pixel; lon, lat, height.

    Further properties: ``id``, ``role``, ``sigma_image``, ``sigma_xy``, ``sigma_h``, ``filename`` (the image).
    Heights are ellipsoidal, as the format says. In a block ``ji`` may be a mapping of images to [column, row], and the
    geometry of a tie point is null; where only ground is wanted, ``ji`` is ignored.
    """

    def refuse(constant: str) -> float:
        raise InputError(f"{constant} is not a finite number", file=path)

    try:
        document = json.loads(text, parse_constant=refuse)
    except (ValueError, RecursionError) as error:
        raise InputError(f"this is not well-formed JSON ({str(error)[:80]})", file=path) from error
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError("this is not a GeoJSON FeatureCollection", file=path, field="features")
    table = Table("GeoJSON", crs=_geojson_crs(path, document), assumed_vertical="ellipsoid")
    for count, feature in enumerate(features):
        table.rows += _feature(path, f"features[{count}]", feature, layout)
    return table


def _geojson_crs(path: str | os.PathLike[str], document: dict[str, Any]) -> str:
    stated = document.get("crs")
    if stated is None:
        return "EPSG:4979"
    name = str(stated.get("properties", {}).get("name", "")) if isinstance(stated, dict) else ""
    if not re.search(r"(CRS84h?|:4326|:4979)$", name):
        raise CrsError(
            f"the CRS {_short(name)} of this GeoJSON is not WGS84", file=path, field="crs", remedy="write EPSG:4979"
        )
    return "EPSG:4979"


def _feature(path: str | os.PathLike[str], where: str, feature: Any, layout: Layout) -> list[Row]:
    """Return a row for each image that the point of a feature was measured in."""
    properties = feature.get("properties") if isinstance(feature, dict) else None
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    tie = geometry is None and layout is OF_BLOCK
    if not isinstance(properties, dict) or not (
        tie or (isinstance(geometry, dict) and geometry.get("type") == "Point")
    ):
        raise InputError("this feature is not a Point with properties", file=path, field=where)
    ground = (math.nan,) * 3 if geometry is None else _place(path, where, geometry)

    def sigma(name: str, zero: bool) -> float | None:
        value = properties.get(name)
        return None if value is None else _sigma(value, path, f"{where}.properties.{name}", zero=zero)

    name = properties.get("id", feature.get("id"))
    if name is not None and not isinstance(name, str | int):
        raise InputError(f"{_short(name)} is not an id", file=path, field=f"{where}.properties.id")
    role = properties.get("role") or layout.role
    row = Row(
        where=where,
        id=" ".join(str(name).split()) or None if name is not None else None,
        image=(math.nan, math.nan),
        ground=ground,
        role=_role(role, path, f"{where}.properties.role") if role else "",
        sigma_image=sigma("sigma_image", False),
        sigma_xy=sigma("sigma_xy", True),
        sigma_h=sigma("sigma_h", True),
    )
    if layout is OF_GROUND:
        return [row]
    return [replace(row, image=at, image_name=image) for image, at in _measured(path, where, properties, layout)]


def _place(path: str | os.PathLike[str], where: str, geometry: dict[str, Any]) -> tuple[float, float, float]:
    place = geometry.get("coordinates")
    if not isinstance(place, list) or len(place) not in (2, 3):
        raise InputError("not [lon, lat, height]", file=path, field=f"{where}.geometry.coordinates")
    ground = [number(value, path, f"{where}.geometry.coordinates[{k}]") for k, value in enumerate(place)]
    return ground[0], ground[1], ground[2] if len(ground) == 3 else math.nan


def _measured(
    path: str | os.PathLike[str], where: str, properties: dict[str, Any], layout: Layout
) -> Iterator[tuple[str | None, tuple[float, float]]]:
    """Yield image and column, row from the corner of the first pixel, for each image that a point was measured in."""
    ji, file_name = properties.get("ji"), properties.get("filename")
    field = f"{where}.properties.ji"
    pairs = [(file_name if isinstance(file_name, str) else None, ji)]
    if isinstance(ji, dict) and layout is OF_BLOCK:
        pairs = list(ji.items())
    elif layout is OF_BLOCK and not isinstance(file_name, str):
        raise InputError(
            "it is not said in which image this point was measured", file=path, field=field,
            remedy="give 'ji' as {image: [column, row]}, or 'filename' beside [column, row]",
        )  # fmt: skip
    for image, pair in pairs:
        if not isinstance(pair, list) or len(pair) != 2:
            raise InputError("no property 'ji' = [column, row]", file=path, field=field, remedy="measure the points")
        column, row = (number(pair[k], path, f"{field}[{k}]") for k in range(2))
        # From the centre of the first pixel to its corner.
        yield image, (column + 0.5, row + 0.5)


# -- QGIS ------------------------------------------------------------------------------------------------------------


def read_qgis(path: str | os.PathLike[str], text: str) -> Table:
    """Read a QGIS georeferencer file: ``mapX,mapY,sourceX,sourceY,enable,...`` (older: ``pixelX,pixelY``).

    `sourceY` is minus the line of a raster without geotransform. Rows with ``enable`` 0 are off. There are no heights.
    """
    table = Table("QGIS points")
    names: list[str] = []
    for line in _lines(path, text):
        crs = re.match(r"#\s*CRS\s*:\s*(.*)", line.text)
        if crs:
            table.crs = crs.group(1).strip() or None
        if line.text.startswith("#"):
            continue
        cells = _cells(path, line, ",")
        if not names:
            names = [_QGIS_NAMES.get(name.lower(), name.lower()) for name in cells]
            missing = [name for name in ("mapx", "mapy", "sourcex", "sourcey") if name not in names]
            if missing:
                raise InputError(
                    f"no column {', '.join(missing)} in the header", file=path, field=f"line {line.number}"
                )
            continue
        row = _qgis_row(path, line, names, cells)
        if row is not None:
            table.rows.append(row)
    return table


_QGIS_NAMES = {"pixelx": "sourcex", "pixely": "sourcey"}


def _qgis_row(path: str | os.PathLike[str], line: Line, names: list[str], cells: list[str]) -> Row | None:
    where = f"line {line.number}"
    if len(cells) != len(names):
        raise InputError(f"{len(cells)} cells under {len(names)} column names", file=path, field=where)
    given = dict(zip(names, cells, strict=True))
    if given.get("enable", "1") not in ("0", "1"):
        raise InputError(f"{_short(given['enable'])} is neither 0 nor 1", file=path, field=f"{where}, column enable")
    x, y, column, minus_line = (
        number(given[name], path, f"{where}, column {name}") for name in ("mapx", "mapy", "sourcex", "sourcey")
    )
    if given.get("enable", "1") == "0":
        return None
    return Row(where=where, id=None, image=(column, -minus_line), ground=(x, y, math.nan))


# -- OpenDroneMap ----------------------------------------------------------------------------------------------------


def read_odm(path: str | os.PathLike[str], text: str) -> Table:
    """Read an ODM ``gcp_list.txt``: line 1 is the CRS, then ``x y z column row image [label]``; ``#`` comments.

    Columns and rows are taken to count from the corner of the first pixel. A `z` of NaN is a height not given.
    """
    table = Table("ODM list", centre_origin_allowed=True)
    for line in _lines(path, text):
        if line.text.lstrip().startswith("#"):
            continue
        where = f"line {line.number}"
        if table.crs is None:
            table.crs = _odm_crs(line.text.strip())
            if table.crs is None:
                raise CrsError(
                    f"{_short(line.text.strip())} is not a CRS",
                    file=path,
                    field=where,
                    remedy="the first line of an ODM list is EPSG:n, a PROJ string, or like WGS84 UTM 33N",
                )
            continue
        cells = line.text.strip().split("\t") if "\t" in line.text.strip() else line.text.split()
        cells = [cell.strip() for cell in cells if cell.strip()]
        if len(cells) < 6:
            raise InputError(f"{len(cells)} cells, not x y z column row image", file=path, field=where)
        unknown_height = cells[2].lower() == "nan"
        x, y, column, row = (
            number(cells[k], path, f"{where}, column {name}")
            for k, name in ((0, "x"), (1, "y"), (3, "column"), (4, "row"))
        )
        z = math.nan if unknown_height else number(cells[2], path, f"{where}, column z")
        label = " ".join(cells[6:]) or None
        table.rows.append(Row(where, label, (column, row), (x, y, z), image_name=cells[5]))
    return table


def _odm_crs(text: str) -> str | None:
    utm = re.fullmatch(r"(?i)WGS\s?84\s+UTM\s+(\d{1,2})\s?([NS])", text.strip())
    if utm and 1 <= int(utm.group(1)) <= 60:
        return f"EPSG:{326 if utm.group(2).upper() == 'N' else 327}{int(utm.group(1)):02d}"
    if re.fullmatch(r"(?i)WGS\s?84", text.strip()):
        return "EPSG:4326"
    if re.match(r"(?i)(\+proj=|EPSG:\d+)", text.strip()):
        return text.strip()
    return None


# -- ENVI ------------------------------------------------------------------------------------------------------------


def read_envi(path: str | os.PathLike[str], text: str) -> Table:
    """Read an ENVI image-to-map ``.pts``: comments after ``;`` name the layout, the corner of the image is (1, 1)."""
    table = Table("ENVI points")
    layout: list[str] = []
    for line in _lines(path, text):
        plain = line.text.strip()
        where = f"line {line.number}"
        if plain.startswith(";"):
            found = re.search(r"(?i)map\s*\(x\s*,\s*y(\s*,\s*z)?\)\s*,\s*image\s*\(x\s*,\s*y\)", plain)
            if found:
                layout = ["x", "y", *(["z"] if found.group(1) else []), "image x", "image y"]
            continue
        if not layout:
            raise InputError(
                "this layout of ENVI points is not known",
                file=path,
                field=where,
                remedy="a comment line must say 'Map (x,y), Image (x,y)', with or without z",
            )
        cells = plain.split()
        if len(cells) < len(layout):
            raise InputError(f"{len(cells)} cells, not {', '.join(layout)}", file=path, field=where)
        values = [number(cell, path, f"{where}, {name}") for cell, name in zip(cells, layout, strict=False)]
        height = values[2] if "z" in layout else math.nan
        image = (values[-2] - 1.0, values[-1] - 1.0)
        table.rows.append(Row(where, None, image, (values[0], values[1], height)))
    return table
