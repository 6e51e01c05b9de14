"""Points as CSV or TSV with a header."""

from __future__ import annotations

import math
import os
import re

from ortho_pipeline.errors import InputError
from ortho_pipeline.point_table import (
    CSV_IMAGE,
    OF_IMAGE,
    Layout,
    Line,
    Row,
    Table,
    cells_of,
    lines_of,
    number,
    role_of,
    short,
    sigma_of,
)

#: Columns of a CSV that are for people.
CSV_IGNORED = ("info", "note", "comment", "description")


def read_csv(path: str | os.PathLike[str], text: str, layout: Layout = OF_IMAGE) -> Table:
    """Read our own table: header ``id,col,row,x,y,h[,role][,sigma_image][,sigma_xy][,sigma_h][,image]``.

    The delimiter (comma, semicolon, tab, bar) is that of the header. Lines that start with ``#`` are comments; of these
    ``#CRS: ...`` and ``#vertical: ...`` state what the coordinates are. An empty `h` is a height that is not given.
    """
    table = Table("CSV", centre_origin_allowed=True)
    names: list[str] = []
    delimiter = ","
    for line in lines_of(path, text):
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


def _csv_header(path: str | os.PathLike[str], line: Line, delimiter: str, layout: Layout) -> list[str]:
    names = [name.lower() for name in cells_of(path, line, delimiter)]
    allowed = f"the columns are {', '.join(layout.columns)}"
    for name in names:
        if name not in (*layout.columns, *CSV_IGNORED) or names.count(name) > 1:
            problem = "twice" if names.count(name) > 1 else "not known"
            raise InputError(
                f"the column {short(name)} is {problem}", file=path, field=f"line {line.number}", remedy=allowed
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
    cells = cells_of(path, line, delimiter)
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
        return sigma_of(given[name], path, f"{where}, column {name}", zero=zero) if name in given else None

    for name, what in (("id", "an id"), (CSV_IMAGE, "an image")):
        if (name in layout.needed or name == "id") and name not in given:
            raise InputError(f"a point without {what}", file=path, field=f"{where}, column {name}")
    return Row(
        where=where,
        id=given["id"],
        image=(value("col"), value("row")),
        ground=(value("x"), value("y"), value("h")),
        role=role_of(given["role"], path, f"{where}, column role") if "role" in given else layout.role,
        sigma_image=sigma("sigma_image", False),
        sigma_xy=sigma("sigma_xy", True),
        sigma_h=sigma("sigma_h", True),
        image_name=given.get(CSV_IMAGE),
    )
