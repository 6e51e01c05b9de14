"""Lists of points that other programs write: each one's origin, order and header, undone on the line that reads it."""

from __future__ import annotations

import math
import os
import re

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.point_table import Line, Row, Table, cells_of, lines_of, number, short

# -- QGIS ------------------------------------------------------------------------------------------------------------


def read_qgis(path: str | os.PathLike[str], text: str) -> Table:
    """Read a QGIS georeferencer file: ``mapX,mapY,sourceX,sourceY,enable,...`` (older: ``pixelX,pixelY``).

    `sourceY` is minus the line of a raster without geotransform. Rows with ``enable`` 0 are off. There are no heights.
    """
    table = Table("QGIS points")
    names: list[str] = []
    for line in lines_of(path, text):
        crs = re.match(r"#\s*CRS\s*:\s*(.*)", line.text)
        if crs:
            table.crs = crs.group(1).strip() or None
        if line.text.startswith("#"):
            continue
        cells = cells_of(path, line, ",")
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
        raise InputError(f"{short(given['enable'])} is neither 0 nor 1", file=path, field=f"{where}, column enable")
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
    table = Table("ODM list", origin_allowed=True)
    for line in lines_of(path, text):
        if line.text.lstrip().startswith("#"):
            continue
        where = f"line {line.number}"
        if table.crs is None:
            table.crs = odm_crs(line.text.strip())
            if table.crs is None:
                raise CrsError(
                    f"{short(line.text.strip())} is not a CRS",
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


def odm_crs(text: str) -> str | None:
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
    for line in lines_of(path, text):
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
