"""Points as CSV or TSV with a header: our own columns, and those of surveyors and other programs."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.points.image_errors import read_image_errors
from ortho_pipeline.points.rows import (
    ALTIMETRY,
    CSV_ERRORS,
    CSV_IMAGE,
    OF_IMAGE,
    ColumnRules,
    Line,
    PointRow,
    Table,
    cells_of,
    lines_of,
    number,
    role_of,
    short,
    sigma_of,
)

#: Columns of a CSV that are for people.
CSV_IGNORED = frozenset(
    ["info", "note", "notes", "comment", "comments", "remark", "remarks", "description", "desc", "code", "date", "time"]
)
#: Our name of a column by its names elsewhere (without blanks, punctuation and a unit in brackets).
_ALIASES = {
    alias: name
    for name, aliases in {
        "id": "name point pointid pointname label gcp gcpid marker no nr number ptid",
        "col": "column pixel sample samp xpix xpixel pixelx px p imagex ximage imgx",
        "row": "line ypix ypixel pixely py l imagey yimage imgy",
        "x": "easting east e longitude long lon lng mapx xmap",
        "y": "northing north n latitude lat mapy ymap",
        "h": "z height elevation elev alt altitude",
        "image": "filename file photo imagename imagefile",
        "status": "s",
        "sigma_image": "sigmaimage",
        "sigma_xy": "sigmaxy",
        "sigma_h": "sigmah",
        "var_col": "varcol",
        "var_row": "varrow",
        "cov_col_row": "covcolrow",
        "sigma_common": "sigmacommon",
        "sigma_alike": "sigmaalike",
    }.items()
    for alias in aliases.split()
}
#: Names of ground columns that show the kind of their CRS.
_GEOGRAPHIC = frozenset(["longitude", "long", "lon", "lng", "latitude", "lat"])
_PROJECTED = frozenset(["easting", "east", "northing", "north"])
#: Units in brackets that are our own; any other unit is unknown.
_OWN_UNIT = re.compile(r"[\[(](m|metres?|meters?|px|pixels?|deg|degrees?|°)[\])]$")
#: Status of a point as PCI's programs write it; inactive points are left out.
_STATUS = {"g": "control", "c": "check"}
_UNDERSTOOD = "common names such as Name, Pixel, Line, Easting, Northing, Lat, Lon, Elev, xPix, yPix also work"


@dataclass(frozen=True)
class Header:
    """The columns of a file: their names as written, and the index of each of ours.

    Parameters
    ----------
    names : sequence of str
    place : mapping of str to int
        Index among `names` by our name; without the columns for people.
    delimiter : str
        A blank means any white space.
    """

    names: Sequence[str]
    place: Mapping[str, int]
    delimiter: str

    @property
    def of_ground(self) -> str | None:
        """Return ``geographic`` or ``projected`` if the names of x and y show it."""
        names = {_plain(self.names[self.place[axis]]) for axis in ("x", "y") if axis in self.place}
        if names & _GEOGRAPHIC:
            return "geographic"
        return "projected" if names & _PROJECTED else None

    @property
    def of_altimetry(self) -> bool:
        """Whether the heights are those of a laser altimeter."""
        return "h" in self.place and _plain(self.names[self.place["h"]]) in ALTIMETRY


def altimetry(table: Table) -> None:
    """Set the height datum of laser altimeters, and the CRS of longitudes and latitudes, in a table."""
    table.assumed_vertical = "ellipsoid"
    if table.of_ground == "geographic" and table.crs is None:
        table.crs = "EPSG:4326"


def is_header(text: str) -> bool:
    """Return whether a line is a header, not numbers: at least three of its words name an id or coordinates."""
    names = {_ours(name) for name in text.replace('"', "").split(None if _delimiter(text) == " " else _delimiter(text))}
    return len(names & {"id", "image", "col", "row", "x", "y", "h"}) >= 3


def read_csv(path: str | os.PathLike[str], text: str, expected: ColumnRules = OF_IMAGE) -> Table:
    """Read a table with a header: ``id,col,row,x,y,h[,role][,sigma_image][,sigma_xy][,sigma_h][,image]`` or similar.

    Further columns are those of `CSV_ERRORS`. The delimiter (comma, semicolon, tab, bar, else blanks) is that of the
    header. If it is not a comma, all numbers of the file may have a decimal comma. Lines that start with ``#`` are
    comments; ``#CRS: ...`` and ``#vertical: ...`` state CRS and height datum. An empty `h` means no height.
    """
    table = Table("CSV", origin_allowed=True)
    header: Header | None = None
    marks: set[str] = set()
    for line in lines_of(path, text):
        comment = re.match(r"#\s*(\w+)\s*:\s*(.+)", line.text)
        if comment and comment.group(1).lower() == "crs":
            table.crs = comment.group(2).strip()
        elif comment and comment.group(1).lower() == "vertical":
            table.vertical = comment.group(2).strip()
        if line.text.startswith("#"):
            continue
        if header is None:
            header = _header(path, line, expected)
            table.of_ground = header.of_ground
            if header.of_altimetry:
                altimetry(table)
            continue
        row = _row(path, line, header, expected, marks)
        if row is not None:
            table.rows.append(row)
    return table


# -- the header ------------------------------------------------------------------------------------------------------


def _delimiter(header: str) -> str:
    delimiter = max("\t;,|", key=header.count)
    return delimiter if delimiter in header else " "


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", _OWN_UNIT.sub("", name.strip().lower()))


def _ours(name: str, aliases: Mapping[str, str] = _ALIASES) -> str:
    """Return our name of a column; of an unknown one its own name."""
    lowered = name.strip().lower()
    own = _OWN_UNIT.sub("", lowered).strip()
    return own if own in ("id", "col", "row", "x", "y", "h", "role") else aliases.get(_plain(name), lowered)


def _header(path: str | os.PathLike[str], line: Line, expected: ColumnRules) -> Header:
    delimiter = _delimiter(line.text)
    names = cells_of(path, line, delimiter)
    ours = _our_names(names, expected)
    place: dict[str, int] = {}

    def refuse(message: str) -> InputError:
        remedy = f"name the columns {','.join(expected.names)}; {_UNDERSTOOD}"
        if all(re.fullmatch(r"[+-]?[\d.,]+", name) for name in names[1:]):
            remedy = f"add a header line above the numbers, and {remedy}"
        listed = ", ".join(name or "(no name)" for name in names)
        shown = listed if len(listed) <= 300 else f"{listed[:300]}..."
        return InputError(f"{message}; the columns are: {shown}", file=path, field=f"line {line.number}", remedy=remedy)

    for index, name in enumerate(ours):
        if name in CSV_IGNORED or (not name and index in (0, len(names) - 1)):
            continue
        if name not in (*expected.names, "status"):
            if expected.aliases:
                continue
            raise refuse(f"unknown column {short(names[index])}")
        if name in place:
            raise refuse(f"the columns {short(names[place[name]])} and {short(names[index])} both mean {name}")
        place[name] = index
    missing = [name for name in expected.needed if name not in place]
    if missing:
        raise refuse(f"no column {', '.join(missing)}")
    return Header(names, place, delimiter)


def _our_names(names: Sequence[str], expected: ColumnRules) -> list[str]:
    """Return our name of each column; the meaning of some names depends on the other columns."""
    aliases = {**_ALIASES, **expected.aliases}
    ours, plain = [_ours(name, aliases) for name in names], [_plain(name) for name in names]
    # A table that was saved with its index has a first column without a name.
    if re.fullmatch(r"(unnamed:\s*0)?", names[0].strip().lower()):
        ours[0] = "" if "id" in ours else "id"
    # In PCI's layouts (IDPLXYE) E is the elevation; with N it is the easting.
    return ["h" if key == "e" and {"x", "y"} <= set(plain) else name for key, name in zip(plain, ours, strict=True)]


# -- a line ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cells:
    """The cells of a line by our names of the columns; `marks` are the decimal marks of the file so far."""

    path: str | os.PathLike[str]
    where: str
    cells: Sequence[str]
    header: Header
    expected: ColumnRules
    marks: set[str]

    def text(self, name: str) -> str:
        return self.cells[self.header.place[name]] if name in self.header.place else ""

    def column(self, name: str) -> str:
        if name not in self.header.place:
            return self.where
        return f"{self.where}, column {self.header.names[self.header.place[name]] or name}"

    def plain(self, name: str) -> Any:
        """Return a cell with a decimal point; an empty one as it is."""
        cell = self.text(name)
        return _decimal(cell, self.header, self.marks, self.path, self.column(name)) if cell else cell

    def value(self, name: str) -> float:
        if not self.text(name) and name not in self.expected.needed:
            return math.nan
        return number(self.plain(name), self.path, self.column(name))

    def sigma(self, name: str, zero: bool) -> float | None:
        if not self.text(name):
            return None
        return sigma_of(self.plain(name), self.path, self.column(name), zero=zero)


def _row(
    path: str | os.PathLike[str], line: Line, header: Header, expected: ColumnRules, marks: set[str]
) -> PointRow | None:
    """Return the point of a line, None if it is inactive; `marks` are the decimal marks of the file so far."""
    cells, where = cells_of(path, line, header.delimiter), f"line {line.number}"
    if len(cells) != len(header.names):
        comma = header.delimiter == "," and len(cells) > len(header.names)
        remedy = "write decimal points instead of commas, or separate the columns with ;" if comma else None
        raise InputError(
            f"this line has {counted(len(cells), 'cell')}, but there are {len(header.names)} columns "
            f"({', '.join(header.names)[:120]})",
            file=path,
            field=where,
            remedy=remedy,
        )
    if not header.names[-1] and cells[-1]:
        raise InputError(f"the column of {short(cells[-1])} has no name", file=path, field=where)
    row = _Cells(path, where, cells, header, expected, marks)
    for name, what in (("id", "id"), (CSV_IMAGE, "image")):
        if (name in expected.needed or (name == "id" and "id" in header.place)) and not row.text(name):
            raise InputError(f"this point has no {what}", file=path, field=row.column(name))
    role = role_of(row.text("role"), path, row.column("role")) if row.text("role") else expected.role
    if row.text("status"):
        status = _STATUS.get(row.text("status").lower(), row.text("status").lower())
        if status == "i":
            return None
        role = role_of(status, path, row.column("status"))
    sigma = row.sigma("sigma_image", False)
    covariance, group, common, alike = read_image_errors(
        [row.plain(name) for name in CSV_ERRORS], path, [row.column(name) for name in CSV_ERRORS], sigma
    )
    return PointRow(
        where=where,
        id=row.text("id") or None,
        image=(row.value("col"), row.value("row")),
        ground=(row.value("x"), row.value("y"), row.value("h")),
        role=role,
        sigma_image=sigma,
        sigma_xy=row.sigma("sigma_xy", True),
        sigma_h=row.sigma("sigma_h", True),
        image_name=row.text(CSV_IMAGE) or None,
        covariance=covariance,
        group=group,
        sigma_common=common,
        sigma_alike=alike,
    )


def _decimal(cell: str, header: Header, marks: set[str], path: str | os.PathLike[str], where: str) -> Any:
    """Return a number with a decimal point instead of a decimal comma, if commas do not separate columns."""
    comma, point = "," in cell, "." in cell
    if not (comma or point) or (header.delimiter == "," and comma):
        return cell
    marks.update(mark for mark, used in ((",", comma), (".", point)) if used)
    if len(marks) > 1:
        raise InputError(
            f"this file mixes decimal commas and decimal points, as in {short(cell)}",
            file=path,
            field=where,
            remedy="use one of the two in the whole file, and no thousands separators",
        )
    return re.sub(r",(?=\d*(?:[eE][+-]?\d+)?$)", ".", cell, count=1) if comma else cell
