"""Formats of point files: find the reader of a file, and the points that belong to an image.

A new format is a reader (in `link_lists` if it is a list of another program) and one entry of `_FORMATS`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path, PurePath
from typing import NamedTuple

from ortho_pipeline.errors import InputError, completed, reads
from ortho_pipeline.points.delimited import is_header, read_csv
from ortho_pipeline.points.geojson import read_geojson
from ortho_pipeline.points.link_lists import LINK_TABLE, odm_crs, read_asp, read_envi, read_links, read_odm, read_qgis
from ortho_pipeline.points.rows import (
    OF_BLOCK,
    OF_GROUND,
    OF_HEIGHTS,
    OWN_IMAGE,
    ColumnRules,
    Placement,
    PointRow,
    Table,
    load_text,
    short,
)


class _Format(NamedTuple):
    """A format: its name, its reader, and how to recognise its files.

    A file has this format if `known` says so of its first characters and its first line, or if it has one of the
    `suffixes`. `of_block` lists the tables of blocks that it can hold. `wanted` is the remedy of errors that have no
    better one.
    """

    name: str
    reader: Callable[..., Table]
    wanted: str
    known: Callable[[str, str], object]
    suffixes: tuple[str, ...] = ()
    of_block: tuple[ColumnRules, ...] = ()


#: In the order in which they are tried: content first, then the suffix.
_FORMATS = (
    _Format(
        "GeoJSON with 'ji'",
        read_geojson,
        "write a FeatureCollection of Points [lon, lat, height] with the property 'ji' = [column, row]",
        lambda start, first: start.startswith(("{", "[")),
        (".geojson", ".json"),
        (OF_BLOCK, OF_GROUND, OF_HEIGHTS),
    ),
    _Format(
        "QGIS .points",
        read_qgis,
        "write mapX,mapY,sourceX,sourceY,enable and so on, as the georeferencer of QGIS does",
        lambda start, first: re.match(r"(?i)mapX\s*,", first),
        (".points",),
    ),
    _Format(
        "ENVI .pts",
        read_envi,
        "write numbers in the order of the comment 'Map (x,y,elev), Image (x,y)'",
        # A table that was saved with its index and semicolons also begins with one.
        lambda start, first: start.startswith(";") and not is_header(first),
        (".pts",),
    ),
    _Format(
        "ASP .gcp",
        read_asp,
        "write id lat lon height and three sigmas, then name column row and two sigmas of each image",
        lambda start, first: re.match(r"#\s*WKT\s*:", start),
        (".gcp",),
        (OF_BLOCK,),
    ),
    _Format(
        "CSV/TSV (id,col,row,x,y,h,...)",
        read_csv,
        "write one point a line, its numbers under a header such as id,col,row,x,y,h",
        lambda start, first: is_header(first),
        (".csv", ".tsv"),
        (OF_BLOCK, OF_GROUND, OF_HEIGHTS),
    ),
    _Format(
        "ODM gcp_list.txt",
        read_odm,
        "write x y z column row image [label], under a line with the CRS",
        lambda start, first: odm_crs(first) is not None,
        of_block=(OF_BLOCK,),
    ),
    _Format(
        "ArcGIS link table",
        read_links,
        "write [id] from-x from-y to-x to-y",
        lambda start, first: LINK_TABLE.match(first),
    ),
)
_NAMES = ", ".join(kind.name for kind in _FORMATS)
#: Suffixes of files of points. Those of ODM and ArcGIS are `.txt` and known by their content.
SUFFIXES = (*(suffix for kind in _FORMATS for suffix in kind.suffixes), ".txt")


@reads("see docs/formats.md for the formats of point files")
def read_table(
    path: str | os.PathLike[str],
    image_name: str | None = None,
    pieces: Mapping[str, Placement] | None = None,
) -> Table:
    """Read a point file; its content shows its format, or else its suffix.

    Parameters
    ----------
    image_name : str, optional
        Keep only the points of this image: its file name, or its path if the file has images of the same name.
    pieces : mapping of str to (float, float, float), optional
        Further images to keep: column and row of their first corner in this image, and the width of their pixels.

    Raises
    ------
    InputError
        For anything that is not a table of finite numbers. The message names file, line and column.
    """
    text = load_text(path)
    return _of_image(path, _read(_format_of(path, text), path, text), image_name, pieces or {})


def read_block_table(path: str | os.PathLike[str], expected: ColumnRules = OF_BLOCK) -> Table:
    """Read the rays of a block (CSV, GeoJSON, ODM, ASP), or ground points (`OF_GROUND`, `OF_HEIGHTS`; CSV, GeoJSON).

    Raises
    ------
    InputError
        As `read_table`; also for a line that does not name its image.
    """
    text = load_text(path)
    kind = _format_of(path, text)
    if expected not in kind.of_block:
        raise InputError(
            "this format cannot hold points of several images",
            file=path,
            remedy="give CSV (id,image,col,row[,x,y,h,...]), GeoJSON with 'ji' by image, ODM gcp_list.txt or ASP .gcp",
        )
    # Only formats with named columns can hold ground points alone.
    return _read(kind, path, text, *([expected] if OF_GROUND in kind.of_block else []))


def _read(kind: _Format, path: str | os.PathLike[str], text: str, *expected: ColumnRules) -> Table:
    """Read a file; an error without a remedy gets that of the format."""
    with completed(path, remedy=kind.wanted):
        table = kind.reader(path, text, *expected)
        if not table.rows:
            raise InputError(f"this file has no points; it was read as {kind.name}", file=path)
    table.source = os.fspath(path)
    return table


def _format_of(path: str | os.PathLike[str], text: str) -> _Format:
    suffix, start = Path(path).suffix.lower(), text.lstrip()[:4096]
    # Comments may be long, such as the WKT of a CRS.
    lines = (line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#"))
    first = next(lines, "")[:4096]
    for kind in _FORMATS:
        if suffix in kind.suffixes or kind.known(start, first):
            return kind
    if re.search(r"\d", first) and re.fullmatch(r"[-+.,;\deE\s]+", first):
        raise InputError(
            f"these columns have no names; the first line is {short(first)}",
            file=path,
            field="line 1",
            remedy="add a first line with their names, such as ID P L X Y Z (PCI), or 'link table' (ArcGIS: "
            "from-x from-y to-x to-y)",
        )
    raise InputError(
        f"unknown format of points; the first line is {short(first)}",
        file=path,
        field="line 1",
        remedy=f"give one of: {_NAMES}",
    )


def names_image(name: str, image: str | os.PathLike[str]) -> bool:
    """Return whether a name in a points file means an image: its stem and the named folders agree."""
    named = [part.lower() for part in re.split(r"[\\/]+", name.strip()) if part not in ("", ".", "..")]
    path = [part.lower() for part in Path(os.path.abspath(image)).parts]
    if not named or len(named) > len(path) or named[:-1] != path[len(path) - len(named) : -1]:
        return False
    return named[-1] in (path[-1], PurePath(path[-1]).stem) or PurePath(named[-1]).stem == PurePath(path[-1]).stem


def _of_image(
    path: str | os.PathLike[str], table: Table, image_name: str | None, pieces: Mapping[str, Placement]
) -> Table:
    named = {row.image_name for row in table.rows if row.image_name}
    if image_name is None and len({Path(name).stem.lower() for name in named}) > 1:
        some = ", ".join(sorted(map(str, named))[:5])
        raise InputError(
            f"this file has points of several images ({some})",
            file=path,
            field="image",
            remedy="choose one with image_name, or read them as a block (read_block_points)",
        )
    if image_name is None or not named:
        return table
    nameless = next((row for row in table.rows if not row.image_name), None)
    if nameless is not None:
        raise InputError(
            "this point does not name its image, but others do",
            file=path,
            field=nameless.where,
            remedy="name the image of each point, or of none",
        )
    kept: list[PointRow] = []
    for name, piece in {image_name: OWN_IMAGE, **pieces}.items():
        stem, ids = Path(name).stem.lower(), {row.id for row in kept} - {None}
        # A point that was measured in several images counts once: in this image, else in the first piece.
        rows = [row for row in table.rows if Path(str(row.image_name)).stem.lower() == stem]
        if len({Path(str(row.image_name)).parent for row in rows}) > 1:
            # Images of the same name in different folders.
            rows = [row for row in rows if names_image(str(row.image_name), name)]
        kept += [replace(row, piece=piece) for row in rows if row.id not in ids]
    if not kept and table.format == "GeoJSON" and len(named) == 1:
        # The 'filename' of a GeoJSON is only a note; a renamed image still has these points.
        return table
    if not kept:
        some = ", ".join(sorted(map(str, named))[:5])
        raise InputError(
            f"no point was measured in {Path(image_name).name!r}, only in {some}",
            file=path,
            field="image",
            remedy="measure points in this image: `ortho measure IMAGE -o points.geojson`, for a finished ortho with "
            "--ortho --height 0. If only the image was renamed, correct its name in this file",
        )
    table.rows = kept
    return table
