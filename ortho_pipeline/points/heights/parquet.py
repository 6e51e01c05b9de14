"""Known heights in GeoParquet, a format of laser altimetry."""

from __future__ import annotations

import importlib
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ortho_pipeline.errors import InputError
from ortho_pipeline.points.delimited import altimetry
from ortho_pipeline.points.rows import ALTIMETRY, MAX_FILE, OF_HEIGHTS, PointRow, Table, number, sigma_of

if TYPE_CHECKING:
    from geopandas import GeoDataFrame

#: The first bytes of a file, and its suffixes.
_MAGIC, _SUFFIXES = b"PAR1", (".parquet", ".geoparquet")


def is_parquet(path: str | os.PathLike[str]) -> bool:
    """Return whether a file is Parquet, by its name or its first bytes."""
    if Path(path).suffix.lower() in _SUFFIXES:
        return True
    try:
        with open(path, "rb") as file:
            return file.read(len(_MAGIC)) == _MAGIC
    except OSError:
        return False


def read_parquet(path: str | os.PathLike[str]) -> Table:
    """Read points with a height: that of a column in `OF_HEIGHTS`, else that of the geometry.

    Raises
    ------
    InputError
        If GeoPandas with PyArrow is not installed, or the file is no GeoParquet of points.
    """
    frame = _frame(path)
    geometry, table = frame.geometry, Table("GeoParquet", source=os.fspath(path))
    if not len(frame):
        raise InputError("this file has no points", file=path, remedy="add points")
    if not (geometry.geom_type == "Point").all():
        raise InputError("the geometries are not all points", file=path, field="geometry", remedy="give points")
    if frame.crs is not None:
        table.crs = frame.crs.to_wkt()
        table.of_ground = "geographic" if frame.crs.is_geographic else "projected"
    columns: dict[str, Any] = {}
    for name in frame.columns:
        plain = str(name).lower().replace("_", "")
        ours = {"sigmaxy": "sigma_xy", **OF_HEIGHTS.aliases}.get(plain, plain)
        columns.setdefault(ours, frame[name])
        if plain in ALTIMETRY:
            altimetry(table)
    if "h" not in columns and not geometry.has_z.all():
        raise InputError("no column h", file=path, field="h", remedy="name the heights h")
    if "h" not in columns:
        columns["h"] = geometry.z
    unknown = [math.nan] * len(frame)
    sigmas = [columns.get(name, unknown) for name in ("sigma_xy", "sigma_h")]
    for count, values in enumerate(zip(geometry.x, geometry.y, columns["h"], *sigmas, strict=True)):
        where = f"row {count}"
        x, y, h, *stated = (_float(value, path, where) for value in values)
        place = number(x, path, where), number(y, path, where), number(h, path, where)
        plan, height = (None if math.isnan(one) else sigma_of(one, path, where, zero=True) for one in stated)
        table.rows.append(PointRow(where, None, (math.nan, math.nan), place, "check", sigma_xy=plan, sigma_h=height))
    return table


def _frame(path: str | os.PathLike[str]) -> GeoDataFrame:
    """Return the table of a file."""
    try:
        import geopandas

        importlib.import_module("pyarrow")  # GeoPandas reads with it
    except ImportError as error:
        raise InputError(
            "reading GeoParquet needs GeoPandas and PyArrow",
            file=path,
            remedy="pip install 'ortho-pipeline[parquet]', or give the table as CSV",
        ) from error
    if Path(path).is_file() and Path(path).stat().st_size > MAX_FILE:
        raise InputError(
            f"the point file is larger than {MAX_FILE // 1_000_000} MB", file=path, remedy="use fewer points"
        )
    try:
        frame = geopandas.read_parquet(path)
        len(frame.geometry)
    # What is raised depends on the part of the file that is damaged.
    except Exception as error:
        reason = "".join(str(error).splitlines()[:1])
        raise InputError(
            f"this file cannot be read as GeoParquet ({reason[:200]})",
            file=path,
            remedy="write it with GeoPandas or SlideRule, or give a CSV",
        ) from error
    return frame


def _float(value: Any, path: str | os.PathLike[str], where: str) -> float:
    try:
        return math.nan if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{str(value)[:40]!r} is not a number", file=path, field=where) from error
