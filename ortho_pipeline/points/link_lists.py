"""Lists of points of other programs. The line that reads a number converts its origin, order and sign."""

from __future__ import annotations

import math
import os
import re

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.points.rows import Line, PointRow, Table, cells_of, lines_of, number, short, sigma_of

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


def _qgis_row(path: str | os.PathLike[str], line: Line, names: list[str], cells: list[str]) -> PointRow | None:
    where = f"line {line.number}"
    if len(cells) != len(names):
        raise InputError(
            f"this line has {counted(len(cells), 'cell')}, but there are {len(names)} columns", file=path, field=where
        )
    fields = dict(zip(names, cells, strict=True))
    if fields.get("enable", "1") not in ("0", "1"):
        raise InputError(f"{short(fields['enable'])} is neither 0 nor 1", file=path, field=f"{where}, column enable")
    x, y, column, minus_line = (
        number(fields[name], path, f"{where}, column {name}") for name in ("mapx", "mapy", "sourcex", "sourcey")
    )
    if fields.get("enable", "1") == "0":
        return None
    return PointRow(where=where, id=None, image=(column, -minus_line), ground=(x, y, math.nan))


# -- OpenDroneMap ----------------------------------------------------------------------------------------------------


def read_odm(path: str | os.PathLike[str], text: str) -> Table:
    """Read an ODM ``gcp_list.txt``: line 1 is the CRS, then ``x y z column row image [label]``; ``#`` comments.

    Columns and rows count from the corner of the first pixel. A `z` of NaN means no height.
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
                    remedy="begin the list with EPSG:n, a PROJ string, or a name such as WGS84 UTM 33N",
                )
            continue
        cells = line.text.strip().split("\t") if "\t" in line.text.strip() else line.text.split()
        cells = [cell.strip() for cell in cells if cell.strip()]
        if len(cells) < 6:
            raise InputError(
                f"this line has {counted(len(cells), 'cell')}; expected: x y z column row image", file=path, field=where
            )
        unknown_height = cells[2].lower() == "nan"
        x, y, column, row = (
            number(cells[k], path, f"{where}, column {name}")
            for k, name in ((0, "x"), (1, "y"), (3, "column"), (4, "row"))
        )
        z = math.nan if unknown_height else number(cells[2], path, f"{where}, column z")
        label = " ".join(cells[6:]) or None
        table.rows.append(PointRow(where, label, (column, row), (x, y, z), image_name=cells[5]))
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
    """Read ground control of ENVI (``.pts``): comments after ``;`` name the layout, the corner of the image is (1, 1).

    ``projection info`` on WGS84 (geographic or UTM) states the CRS. With ``ImageFile#`` each line begins with the
    number of its image; a comment ``FileName0=...`` has its name.
    """
    table = Table("ENVI points")
    layout: list[str] = []
    images: dict[str, str] = {}
    for line in lines_of(path, text):
        plain = line.text.strip()
        where = f"line {line.number}"
        if plain.startswith(";"):
            images.update({key: name.strip() for key, name in re.findall(r"(?i)FileName(\d+)\s*=\s*([^;]+)", plain)})
            table.crs = _envi_crs(plain) or table.crs
            layout = _envi_layout(plain) or layout
            continue
        if not layout:
            raise InputError(
                "unknown layout of ENVI points",
                file=path,
                field=where,
                remedy="add a comment line '; Map (x,y), Image (x,y)' or '; Map (x,y,elev), Image (x,y)'",
            )
        cells = plain.split()
        if len(cells) < len(layout):
            raise InputError(
                f"this line has {counted(len(cells), 'cell')}; expected: {', '.join(layout)}", file=path, field=where
            )
        fields = dict(zip(layout, cells, strict=False))
        image = fields.pop("image file", None)
        if image is not None and image not in images:
            raise InputError(
                f"no comment FileName{short(image)[1:-1]}= names the image of this point",
                file=path,
                field=where,
                remedy="add this comment, for example ; FileName0=scene.tif",
            )
        value = {name: number(cell, path, f"{where}, {name}") for name, cell in fields.items()}
        position = (value["image x"] - 1.0, value["image y"] - 1.0)
        ground = (value["x"], value["y"], value.get("elev", math.nan))
        name = None if image is None else re.split(r"[\\/]", images[image])[-1]
        table.rows.append(PointRow(where, None, position, ground, image_name=name))
    return table


def _envi_layout(comment: str) -> list[str]:
    match = re.search(r"(?i)(imagefile#\s*,\s*)?map\s*\(x\s*,\s*y(\s*,\s*\w+)?\)\s*,\s*image\s*\(x\s*,\s*y\)", comment)
    if match is None:
        return []
    first, elevation = ["image file"] if match.group(1) else [], ["elev"] if match.group(2) else []
    return [*first, "x", "y", *elevation, "image x", "image y"]


def _envi_crs(comment: str) -> str | None:
    match = re.search(r"(?i)projection info\s*=\s*\{([^}]*)\}", comment)
    words = [word.strip().lower() for word in match.group(1).split(",")] if match else []
    if "wgs-84" not in words:
        return None
    if words[0] == "geographic lat/lon" and "units=degrees" in words:
        return "EPSG:4326"
    if words[0] == "utm" and len(words) > 2 and "units=meters" in words and words[2] in ("north", "south"):
        return odm_crs(f"WGS84 UTM {words[1]}{words[2][0]}")
    return None


# -- Ames Stereo Pipeline --------------------------------------------------------------------------------------------


def read_asp(path: str | os.PathLike[str], text: str) -> Table:
    """Read a ``.gcp`` of the Ames Stereo Pipeline: a line per point, with every image in which it was measured.

    ``id latitude longitude height sigma sigma sigma`` and for each image ``name column row sigma sigma``, separated by
    blanks or commas. Columns and rows count from the centre of the first pixel; heights are ellipsoidal. A comment
    ``# WKT:`` states the CRS. The three sigmas (m) are those of latitude, longitude and height.
    """
    table = Table("ASP points", assumed_vertical="ellipsoid", of_ground="geographic")
    for line in lines_of(path, text):
        where = f"line {line.number}"
        stated = re.match(r"#\s*WKT\s*:\s*(.+)", line.text)
        if stated:
            table.crs = stated.group(1).strip()
        if line.text.lstrip().startswith("#"):
            continue
        cells = re.split(r"\s*,\s*|\s+", line.text.strip())
        if len(cells) < 12 or (len(cells) - 7) % 5:
            raise InputError(
                f"this line has {counted(len(cells), 'cell')}; expected: 7 of the point and 5 of each image",
                file=path,
                field=where,
                remedy="write id lat lon height sigma sigma sigma, then for each image: name column row sigma sigma",
            )
        lat, lon, height = (
            number(cells[k], path, f"{where}, {name}") for k, name in ((1, "latitude"), (2, "longitude"), (3, "height"))
        )
        sigmas = [sigma_of(cells[k], path, f"{where}, sigma {k - 3}", zero=True) for k in (4, 5, 6)]
        for k in range(7, len(cells), 5):
            column, at_row = (number(cells[k + i], path, f"{where}, {name}") for i, name in ((1, "column"), (2, "row")))
            spread = max(sigma_of(cells[k + i], path, f"{where}, pixel sigma", zero=False) for i in (3, 4))
            row = PointRow(where, cells[0], (column + 0.5, at_row + 0.5), (lon, lat, height), image_name=cells[k])
            row.sigma_image, row.sigma_xy, row.sigma_h = spread, max(sigmas[:2]), sigmas[2]
            table.rows.append(row)
    return table


# -- ArcGIS ----------------------------------------------------------------------------------------------------------

#: The first line of a link file. ArcGIS also reads files without it, but they look like any other columns of numbers.
LINK_TABLE = re.compile(r"(?i)link table\s*$")


def read_links(path: str | os.PathLike[str], text: str) -> Table:
    """Read a link table of ArcGIS: ``[id] from-x from-y to-x to-y`` under a line ``link table``; no heights.

    ArcGIS places a raster without georeference below the x axis, so from-y is minus the row. The user states the pixel
    origin.
    """
    table = Table("ArcGIS links", origin_allowed=True)
    lines = list(lines_of(path, text))[1:]
    for line in lines:
        cells, where = line.text.split(), f"line {line.number}"
        if len(cells) not in (4, 5):
            raise InputError(
                f"this line has {counted(len(cells), 'cell')}; expected: [id] from-x from-y to-x to-y",
                file=path,
                field=where,
            )
        x, minus_row, *to = (
            number(cell, path, f"{where}, {name}")
            for cell, name in zip(cells[-4:], ("from-x", "from-y", "to-x", "to-y"), strict=True)
        )
        if minus_row > 1.0:
            raise InputError(
                f"from-y is {minus_row:g}, but it must be minus the row",
                file=path,
                field=f"{where}, from-y",
                remedy="make the links on the raster without its georeference, or give the points as CSV with the "
                "columns Pixel and Line",
            )
        label = cells[0] if len(cells) == 5 else None
        table.rows.append(PointRow(where, label, (x, -minus_row), (to[0], to[1], math.nan)))
    return table
