"""Points as a GeoDataFrame of GeoPandas, and back."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyproj

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import installing
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.points import Points, points_of
from ortho_pipeline.points.image_errors import read_image_errors, says_more
from ortho_pipeline.points.rows import CSV_ERRORS, PointRow, Table, number, role_of, sigma_of

if TYPE_CHECKING:
    from geopandas import GeoDataFrame

#: Name of a frame in errors, if it does not state the source of its points.
_FRAME = "GeoDataFrame"
_SIGMAS = ("sigma_image", "sigma_x", "sigma_y", "sigma_h")
_COLUMNS = ("id", "role", "col", "row", "h", *_SIGMAS, "sigma_xy", *CSV_ERRORS)


def to_geodataframe(points: Points) -> GeoDataFrame:
    """Return points as a GeoDataFrame; `from_geodataframe` restores them to the last bit.

    Columns are those of CSV files: `col` and `row` (px, from the outer corner of the first pixel), `h` (metres above
    the ellipsoid, NaN if not given), `role`, and standard deviations. The geometry is x, y in the CRS of the points.
    It needs GeoPandas (the extra ``geopandas``).

    Raises
    ------
    InputError
        If GeoPandas is not installed.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> to_geodataframe(op.read_points("sample_data/gcps.geojson")).shape
    (18, 10)
    """
    try:
        import geopandas
    except ImportError as error:
        raise InputError(
            "a GeoDataFrame needs GeoPandas, which is not installed",
            field="points",
            remedy=installing("geopandas"),
        ) from error
    columns: dict[str, Any] = {
        "id": list(points.ids),
        "role": points.roles.astype(object),
        "col": points.image[:, 0],
        "row": points.image[:, 1],
        "h": points.ground[:, 2],
        **dict(zip(_SIGMAS, (points.sigma_image, *points.sigma_ground.T), strict=True)),
        **_error_columns(points),
    }
    frame = geopandas.GeoDataFrame(columns, geometry=_places(points), crs=points.crs)
    frame.attrs.update(vertical="ellipsoid", source=points.source)
    return frame


def _places(points: Points) -> list[Any]:
    import shapely

    return [shapely.Point(x, y) if np.isfinite((x, y)).all() else None for x, y, _ in points.ground.tolist()]


def _error_columns(points: Points) -> dict[str, Any]:
    """Return those columns of `CSV_ERRORS` that add information to `sigma_image`."""
    columns: dict[str, Any] = {}
    more = says_more(points.covariance_image)
    if more.any():
        for name, i, j in zip(CSV_ERRORS[:3], (0, 1, 0), (0, 1, 1), strict=True):
            columns[name] = np.where(more, points.covariance_image[:, i, j], np.nan)
    if (points.groups >= 0).any():
        columns[CSV_ERRORS[3]] = np.where(points.groups >= 0, points.groups, np.nan)
    for name in CSV_ERRORS[4:]:
        if getattr(points, name).any():
            columns[name] = getattr(points, name)
    return columns


def from_geodataframe(
    frame: GeoDataFrame, *, crs: str | pyproj.CRS | None = None, vertical: str | Vertical | None = None
) -> Points:
    """Make points from a GeoDataFrame with the columns `col` and `row`; the others of `to_geodataframe` are optional.

    Heights are the column `h`, or else those of the geometry.

    Parameters
    ----------
    crs, vertical : optional
        CRS and height datum, if the frame does not state them with its CRS and ``frame.attrs["vertical"]``.

    Raises
    ------
    InputError, CrsError, DatumError
        The message names the row and the column.

    Examples
    --------
    >>> import ortho_pipeline as op
    >>> from_geodataframe(to_geodataframe(op.read_points("sample_data/gcps.geojson")))
    <18 points: 12 control, 6 check; WGS 84; sample_data/gcps.geojson>
    """
    table, sigmas = _table_of(frame)
    return replace(points_of(table, crs, vertical, "corner"), sigma_ground=sigmas)


def _table_of(frame: GeoDataFrame) -> tuple[Table, np.ndarray]:
    """Return the rows of a GeoDataFrame, and standard deviations ``(N, 3)`` m of their ground (0 if not given)."""
    if not hasattr(frame, "geometry") or not hasattr(frame, "columns"):
        raise InputError(
            f"{type(frame).__name__} has no geometry", file=_FRAME, field="frame", remedy="give a GeoDataFrame"
        )
    source = str(frame.attrs.get("source", _FRAME))
    missing = [name for name in ("col", "row") if name not in frame.columns]
    if missing:
        raise InputError(
            f"no column {' and '.join(missing)}",
            file=source,
            field="columns",
            remedy="add the image position as columns col and row (px from the outer corner of the first pixel)",
        )
    if not frame.columns.is_unique:
        raise InputError("two columns have the same name", file=source, field="columns", remedy="rename one of them")
    table = Table(
        _FRAME,
        crs=None if frame.crs is None else frame.crs.to_wkt(),
        vertical=frame.attrs.get("vertical"),
        source=source,
    )
    # As objects, because the missing values of pandas are neither numbers nor None.
    cells = {name: frame[name].astype(object).where(frame[name].notna(), None) for name in _COLUMNS if name in frame}
    records = [dict(zip(cells, values, strict=True)) for values in zip(*cells.values(), strict=True)]
    sigmas = np.zeros((len(records), 3))
    for k, (record, place) in enumerate(zip(records, frame.geometry, strict=True)):
        where = f"row {frame.index[k]}"
        table.rows.append(_row(source, where, record, place))
        sigmas[k] = [_sigma(source, where, record, name, zero=True) or 0.0 for name in _SIGMAS[1:]]
    return table, sigmas


def _row(source: str, where: str, record: dict[str, Any], place: Any) -> PointRow:
    def cell(name: str) -> float:
        return number(_plain(record[name]), source, f"{where}, {name}")

    if place is not None and (place.geom_type != "Point" or place.is_empty):
        raise InputError(f"{place.geom_type} is not a point", file=source, field=f"{where}, geometry")
    x, y = (math.nan, math.nan) if place is None else (place.x, place.y)
    if record.get("h") is not None:
        height = cell("h")
    else:
        height = place.z if place is not None and place.has_z and "h" not in record else math.nan
    sigma_image = _sigma(source, where, record, "sigma_image", zero=False)
    covariance, group, common, alike = read_image_errors(
        [_plain(record.get(name)) for name in CSV_ERRORS],
        source,
        [f"{where}, {name}" for name in CSV_ERRORS],
        sigma_image,
    )
    name = _plain(record.get("id"))
    return PointRow(
        where=where,
        id=None if name is None else str(name),
        image=(cell("col"), cell("row")),
        ground=(x, y, height),
        role=role_of(record["role"], source, f"{where}, role") if record.get("role") is not None else "control",
        sigma_image=sigma_image,
        covariance=covariance,
        group=group,
        sigma_common=common,
        sigma_alike=alike,
    )


def _sigma(source: str, where: str, record: dict[str, Any], name: str, *, zero: bool) -> float | None:
    """Return a standard deviation; ``sigma_xy`` of CSV files is that of both horizontal components."""
    value = record.get(name)
    if value is None and name in ("sigma_x", "sigma_y"):
        name = "sigma_xy"
        value = record.get(name)
    return None if value is None else sigma_of(_plain(value), source, f"{where}, {name}", zero=zero)


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
