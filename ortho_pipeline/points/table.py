"""Control, check and tie points: one table, read from and written to every common format.

Image coordinates are (column, row) from the outer corner of the first pixel, whatever the convention of the file.
Ground coordinates are x, y in a stated CRS. Heights are metres above the WGS84 ellipsoid; NaN means not given.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import CrsError, InputError, completed, reads
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files import json_text, write_text
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, horizontal, parse_crs
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.geodesy.naming import crs_definition
from ortho_pipeline.points.formats import read_table
from ortho_pipeline.points.geojson import feature_of
from ortho_pipeline.points.ground import ground_of, ground_sigmas
from ortho_pipeline.points.image_errors import (
    LAST_GROUP,
    checked_common,
    checked_covariance,
    checked_groups,
    common_of,
    covariance_of,
    groups_of,
    reconciled,
    says_more,
    sigma_of_covariance,
    sigmas_of,
)
from ortho_pipeline.points.rows import (
    CSV_COLUMNS,
    CSV_ERRORS,
    MAX_SIGMA,
    ROLES,
    Placement,
    PointRow,
    Table,
    TablePoint,
    numbered_ids,
    origin_shift,
    plain_id,
    refuse_duplicates,
    refuse_odd_ids,
    refuse_unreadable,
)

Array = NDArray[np.float64]

#: Standard deviation (px) of an image measurement whose file gives none.
DEFAULT_SIGMA_IMAGE = 0.5
_FORMATS = "see docs/formats.md for the formats of point files"


@dataclass(frozen=True, eq=False, repr=False)
class Points:
    """Points measured in an image and on the ground. `Points.of` makes them from arrays.

    Parameters
    ----------
    ids : tuple of str
    image : ndarray (N, 2)
        Column, row (px) from the outer corner of the first pixel.
    ground : ndarray (N, 3)
        x, y in `crs`, height in metres above the ellipsoid; NaN if not given.
    roles : ndarray (N,) of {'control', 'check', 'tie'}
    sigma_image : ndarray (N,)
        Standard deviation of the image measurement (px): the root mean square of both axes.
    sigma_ground : ndarray (N, 3)
        Standard deviation (m) true east, north and up, whatever `crs`. 0 is perfect.
    crs : pyproj.CRS
        Horizontal CRS, x first.
    source : str
        Name of their file, for people.
    covariance_image, groups, sigma_common, sigma_alike : ndarray, optional
        See `TablePoint`; by default a measurement has no correlation, and shares no error.
    """

    ids: tuple[str, ...]
    image: Array
    ground: Array
    roles: NDArray[np.str_]
    sigma_image: Array
    sigma_ground: Array
    crs: pyproj.CRS
    source: str
    covariance_image: Array = None  # type: ignore[assignment]  # filled below, as `groups` is
    groups: NDArray[np.int64] = None  # type: ignore[assignment]
    sigma_common: Array = None  # type: ignore[assignment]
    sigma_alike: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        count = len(self.ids)
        for name, shape in (
            ("image", (count, 2)),
            ("ground", (count, 3)),
            ("sigma_image", (count,)),
            ("sigma_ground", (count, 3)),
        ):
            array = np.asarray(getattr(self, name), dtype=float)
            if array.shape != shape:
                raise InputError(f"{name} has the shape {array.shape}, not {shape}", field=name)
            object.__setattr__(self, name, array)
        for name in ("sigma_image", "sigma_ground"):
            sigma = getattr(self, name)
            if not ((sigma >= 0) & (sigma < np.inf)).all():
                raise InputError(
                    "a standard deviation is negative or not finite",
                    file=self.source or None,
                    field=name,
                    remedy="give a number; 0 if the ground is exact",
                )
        sigma, covariance = reconciled(self.sigma_image, self.covariance_image)
        object.__setattr__(self, "sigma_image", sigma)
        object.__setattr__(self, "covariance_image", covariance)
        object.__setattr__(self, "groups", checked_groups(self.groups, count))
        for name in CSV_ERRORS[4:]:
            object.__setattr__(self, name, checked_common(getattr(self, name), count, name))
        roles = np.asarray(self.roles, dtype=str)
        if roles.shape != (count,) or not set(roles.tolist()) <= set(ROLES):
            raise InputError(f"each role must be one of {', '.join(ROLES)}", field="roles")
        object.__setattr__(self, "roles", roles.astype("<U7"))
        if len(set(self.ids)) != count:
            twice = sorted({name for name in self.ids if self.ids.count(name) > 1})
            raise InputError(f"two points have the id {twice[0]!r}", file=self.source or None, field="id")

    @classmethod
    def of(
        cls,
        image: ArrayLike,
        ground: ArrayLike,
        crs: str | pyproj.CRS,
        *,
        ids: Sequence[str] | None = None,
        roles: str | ArrayLike = "control",
        sigma_image: ArrayLike = DEFAULT_SIGMA_IMAGE,
        sigma_ground: ArrayLike = 0.0,
    ) -> Points:
        """Make points from arrays: `image` ``(N, 2)`` from the outer corner of the first pixel, `ground` ``(N, 3)``.

        All other arguments are one value, or one for each point; `sigma_ground` also three for all, or three for each
        point (east, north, up). Without `ids`, points are numbered from 1.

        Raises
        ------
        InputError
            If the shapes do not agree, or `crs` is not a CRS or has heights above a geoid.

        Examples
        --------
        >>> Points.of([[10.0, 20.0]], [[33.35, 37.25, 800.0]], "EPSG:4979")
        <1 point: 1 control; WGS 84; arrays>
        """
        crs = parse_crs(crs)
        if (heights := declared_vertical(crs)) and not (heights.vertical and heights.vertical.is_ellipsoid):
            raise CrsError(
                f"{crs.name!r} has heights above a geoid; points have them above the ellipsoid",
                field="crs",
                remedy="give the horizontal CRS, and `op.Vertical.parse(DATUM).ellipsoidal(lon, lat, heights)`",
            )
        image = _numbers("image", image)
        count = len(image) if image.ndim else 0
        return cls(
            ids=tuple(map(str, ids)) if ids is not None else tuple(str(k + 1) for k in range(count)),
            image=image,
            ground=_numbers("ground", ground),
            roles=np.full(count, roles) if np.size(roles) == 1 else np.array(roles),
            sigma_image=_numbers("sigma_image", sigma_image, (count,)),
            sigma_ground=ground_sigmas(_numbers("sigma_ground", sigma_ground), count),
            crs=crs,
            source="arrays",
        )

    def __repr__(self) -> str:
        roles = ", ".join(f"{(self.roles == role).sum()} {role}" for role in ROLES if (self.roles == role).any())
        return f"<{counted(len(self.ids), 'point')}: {roles or 'none'}; {self.crs.name}; {self.source}>"

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[TablePoint]:
        columns = self.image.tolist(), self.ground.tolist(), self.roles.tolist()
        sigmas = self.sigma_image.tolist(), self.sigma_ground.tolist()
        shared = self.groups.tolist(), self.sigma_common.tolist(), self.sigma_alike.tolist()
        for name, image, ground, role, sigma, sigma_ground, both, *others in zip(
            self.ids, *columns, *sigmas, self.covariance_image.tolist(), *shared, strict=True
        ):
            covariance = tuple(both[0]), tuple(both[1])
            yield TablePoint(name, tuple(image), tuple(ground), role, sigma, tuple(sigma_ground), covariance, *others)

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The points as GeoJSON values: longitude, latitude (WGS84) and ellipsoidal height.

        `ji` is column and row from the centre of the first pixel. A point without ground coordinates has no geometry.
        shapely and GeoPandas (``GeoDataFrame.from_features(points, crs=4326)``) read it.
        """
        return {"type": "FeatureCollection", "features": [feature_of(point) for point in self.to_crs("EPSG:4979")]}

    @property
    def control(self) -> NDArray[np.bool_]:
        """Which points are control ``(N,)``."""
        return np.asarray(self.roles == "control")

    @property
    def check(self) -> NDArray[np.bool_]:
        """Which points are check points ``(N,)``."""
        return np.asarray(self.roles == "check")

    @property
    def tests(self) -> NDArray[np.bool_]:
        """Check points ``(N,)`` that test the result: the measured ones, or matches if there are no others.

        Matches (points with a group) test relative to their reference, so they have a separate figure.
        """
        measured = self.check & (self.groups < 0)
        return measured if measured.any() else self.check

    def select(self, mask: ArrayLike) -> Points:
        """Return the points that a mask ``(N,)`` or indices select, in their order."""
        mask = np.asarray(mask)
        index = np.arange(len(self))[mask if mask.size else mask.astype(int)]
        return replace(
            self,
            ids=tuple(self.ids[i] for i in index),
            image=self.image[index],
            ground=self.ground[index],
            roles=self.roles[index],
            sigma_image=self.sigma_image[index],
            sigma_ground=self.sigma_ground[index],
            covariance_image=self.covariance_image[index],
            groups=self.groups[index],
            sigma_common=self.sigma_common[index],
            sigma_alike=self.sigma_alike[index],
        )

    def with_covariance_image(self, covariance: ArrayLike, groups: ArrayLike | None = None) -> Points:
        """Return these points with other covariances ``(N, 2, 2)`` px^2 of the measurement, and groups if given."""
        covariance = checked_covariance(covariance, len(self))
        changed = replace(self, sigma_image=sigma_of_covariance(covariance), covariance_image=covariance)
        return changed if groups is None else replace(changed, groups=np.asarray(groups))

    def with_roles(self, roles: ArrayLike) -> Points:
        """Return these points with other roles ``(N,)``."""
        return replace(self, roles=np.asarray(roles))

    def with_ground(self, ground: ArrayLike) -> Points:
        """Return these points with other ground coordinates ``(N, 3)`` in the same CRS."""
        return replace(self, ground=_numbers("ground", ground))

    def to_crs(self, target: str | pyproj.CRS) -> Points:
        """Return these points in another CRS; missing heights stay NaN.

        Raises
        ------
        CrsError
            If there is no transformation.
        """
        target = parse_crs(target)
        missing = ~np.isfinite(self.ground[:, 2])
        ground = self.ground.copy()
        ground[missing, 2] = 0.0
        ground = ground_transform(self.crs, target)(ground)
        if not target.is_geocentric:
            ground[missing, 2] = np.nan
            target = horizontal(target)
        elif missing.any():
            ground[missing] = np.nan
        return replace(self, ground=ground, crs=target)


def _numbers(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Array:
    """Return a copy of the values as numbers, repeated to a shape; NaN where a masked array has none."""
    values = np.ma.filled(values.astype(float), np.nan) if isinstance(values, np.ma.MaskedArray) else values
    try:
        numbers = np.array(values, dtype=float)
        return numbers if shape is None else np.broadcast_to(numbers, shape)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} is no array of numbers of the right shape ({error})", field=name) from error


# -- reading ---------------------------------------------------------------------------------------------------------


@reads(_FORMATS)
def read_points(
    path: str | os.PathLike[str],
    *,
    crs: str | pyproj.CRS | None = None,
    vertical: str | Vertical | None = None,
    pixel_origin: str = "corner",
    image_name: str | None = None,
    pieces: Mapping[str, Placement] | None = None,
) -> Points:
    """Read points from any known format (docs/formats.md).

    Parameters
    ----------
    crs, vertical : optional
        CRS and height datum, if the file does not state them.
    pixel_origin : 'corner', 'center', 'corner-1' or 'center-1'
        Part of the first pixel that CSV, ODM and link files count as (0, 0), or with ``-1`` as (1, 1).
    image_name : str, optional
        Keep only the points of this image.
    pieces : mapping of str to (float, float, float), optional
        Further images to keep: column and row of their first corner in this image, and the width of their pixels.

    Raises
    ------
    InputError, CrsError, DatumError
        The message names file, line and column.

    Examples
    --------
    >>> read_points("sample_data/gcps.geojson")
    <18 points: 12 control, 6 check; WGS 84; sample_data/gcps.geojson>
    """
    return points_of(read_table(path, image_name, pieces), crs, vertical, pixel_origin)


def points_of(table: Table, crs: str | pyproj.CRS | None, vertical: str | Vertical | None, pixel_origin: str) -> Points:
    """Return the points of a table; parameters and errors are those of `read_points`."""
    path = table.source
    with completed(path, remedy=_FORMATS):
        shift, rows = origin_shift(path, table, pixel_origin), table.rows
        ids = numbered_ids(path, rows)
        pieces = np.array([row.piece for row in rows]).reshape(-1, 3)
        image = (np.array([row.image for row in rows]).reshape(-1, 2) + shift) * pieces[:, 2:] + pieces[:, :2]
        ground, plane = ground_of(path, table, crs, vertical)
        refuse_duplicates(path, [row.where for row in rows], image, ground, [row.role for row in rows])
        sigma_image = sigmas_of(rows, DEFAULT_SIGMA_IMAGE)
        return Points(
            ids=ids,
            image=image,
            ground=ground,
            roles=np.array([row.role for row in rows], dtype="<U7"),
            sigma_image=sigma_image,
            sigma_ground=np.array([[row.sigma_xy or 0.0] * 2 + [row.sigma_h or 0.0] for row in rows]).reshape(-1, 3),
            crs=plane,
            source=path,
            covariance_image=covariance_of(rows, sigma_image),
            groups=groups_of(rows),
            **common_of(rows),
        )


def gcps_of_dataset(
    dataset: Any, *, crs: str | pyproj.CRS | None = None, vertical: str | Vertical | None = None
) -> Points:
    """Return the ground control points of an open GDAL dataset.

    If all heights are zero, there are none (a convention of GDAL): they become NaN.

    Raises
    ------
    InputError, CrsError, DatumError
        If there are no points, or the CRS or the height datum is unknown.
    """
    path = dataset.GetDescription()
    gcps = dataset.GetGCPs()
    if not gcps:
        raise InputError("this raster has no ground control points", file=path, remedy="give a point file")
    names = [plain_id(gcp.Id) for gcp in gcps]
    named = all(names) and len(set(names)) == len(gcps)
    flat = all(gcp.GCPZ == 0 for gcp in gcps)
    rows = [
        PointRow(
            where=f"GCP {count}",
            id=gcp.Id if named else str(count),
            image=(float(gcp.GCPPixel), float(gcp.GCPLine)),
            ground=(float(gcp.GCPX), float(gcp.GCPY), math.nan if flat else float(gcp.GCPZ)),
        )
        for count, gcp in enumerate(gcps, start=1)
    ]
    image, ground = np.array([row.image for row in rows]), np.array([row.ground for row in rows])
    if not (np.isfinite(image).all() and np.isfinite(ground[:, :2]).all()):
        raise InputError("a coordinate of a ground control point is not finite", file=path, field="GCP")
    table = Table("GCPs", rows, crs=dataset.GetGCPProjection() or None)
    ground, plane = ground_of(path, table, crs, vertical)
    refuse_duplicates(path, [row.where for row in rows], image, ground, [row.role for row in rows])
    return Points(
        ids=tuple(str(row.id) for row in rows),
        image=image,
        ground=ground,
        roles=np.full(len(rows), "control", dtype="<U7"),
        sigma_image=np.full(len(rows), DEFAULT_SIGMA_IMAGE),
        sigma_ground=np.zeros((len(rows), 3)),
        crs=plane,
        source=path,
    )


# -- writing ---------------------------------------------------------------------------------------------------------


def write_points(points: Points, path: str | os.PathLike[str], *, images: Sequence[str] | None = None) -> None:
    """Write points as ``.csv``/``.tsv``, ``.geojson`` (lon, lat, EPSG:4979) or QGIS ``.points``; whole or not at all.

    CSV and GeoJSON keep everything. A QGIS file has no ids, heights, roles or sigmas.

    Parameters
    ----------
    images : sequence of str, optional
        Name of the image of each point; only for CSV and TSV.

    Raises
    ------
    InputError
        For another suffix, a folder that cannot be written, and what could not be read again: an id with blanks around
        it or several in a row, a `sigma_image` of 0, or NaN in `image`.

    Examples
    --------
    >>> import tempfile
    >>> path = f"{tempfile.mkdtemp()}/points.csv"
    >>> write_points(read_points("sample_data/gcps.geojson"), path)
    >>> len(read_points(path))
    18
    """
    writers = {".csv": _csv_text, ".tsv": _csv_text, ".geojson": _geojson_text, ".points": _qgis_text}
    suffix = Path(path).suffix.lower()
    if suffix not in writers:
        remedy = f"use one of {', '.join(writers)}"
        raise InputError("points cannot be written in this format", file=path, remedy=remedy)
    if images is not None and writers[suffix] is not _csv_text:
        raise InputError(f"{suffix} files cannot name the image of a point", file=path, remedy="write .csv")
    ids, ground, sigma = points.ids, points.ground, points.sigma_image
    if writers[suffix] is not _qgis_text:
        refuse_odd_ids(ids, path)
        refuse_unreadable(ids, path, "sigma_image", (sigma > 0) & (sigma <= MAX_SIGMA))
        refuse_unreadable(ids, path, "groups", points.groups < LAST_GROUP)
    refuse_unreadable(ids, path, "image", np.asarray(np.isfinite(points.image).all(axis=1)))
    refuse_unreadable(ids, path, "ground", np.isfinite(ground[:, :2]).all(axis=1) & ~np.isinf(ground[:, 2]))
    write_text(path, _csv_text(points, suffix, images) if images is not None else writers[suffix](points, suffix))


def _csv_text(points: Points, suffix: str, images: Sequence[str] | None = None) -> str:
    out = io.StringIO()
    out.write(f"#CRS: {crs_definition(points.crs)}\n#vertical: ellipsoid\n")
    # Without quotation marks, an id that starts with '#' would become a comment.
    hidden = any(name.startswith("#") for name in points.ids)
    writer = csv.writer(
        out,
        delimiter="\t" if suffix == ".tsv" else ",",
        lineterminator="\n",
        quoting=csv.QUOTE_ALL if hidden else csv.QUOTE_MINIMAL,
    )
    extra = _error_columns(points)
    writer.writerow([*CSV_COLUMNS, *extra, *([] if images is None else ["image"])])
    # One column has both horizontal components: the larger one is safe.
    sigma_xy = points.sigma_ground[:, :2].max(axis=1)
    numbers = np.column_stack([points.image, points.ground])
    sigmas = np.column_stack([points.sigma_image, sigma_xy, points.sigma_ground[:, 2]])
    for k, name in enumerate(points.ids):
        cells = ["" if math.isnan(value) else repr(value) for value in numbers[k].tolist()]
        further = [column[k] for column in extra.values()] + ([] if images is None else [images[k]])
        writer.writerow([name, *cells, str(points.roles[k]), *map(repr, sigmas[k].tolist()), *further])
    return out.getvalue()


def _error_columns(points: Points) -> dict[str, list[str]]:
    """Return the cells of those columns of `CSV_ERRORS` that add information to `sigma_image`, by name."""
    columns: dict[str, list[str]] = {}
    more = says_more(points.covariance_image)
    if more.any():
        for name, i, j in zip(CSV_ERRORS[:3], (0, 1, 0), (0, 1, 1), strict=True):
            values = points.covariance_image[:, i, j].tolist()
            columns[name] = [repr(value) if written else "" for value, written in zip(values, more, strict=True)]
    if (points.groups >= 0).any():
        columns[CSV_ERRORS[3]] = [str(group) if group >= 0 else "" for group in points.groups.tolist()]
    for name in CSV_ERRORS[4:]:
        if getattr(points, name).any():
            columns[name] = [repr(sigma) if sigma else "" for sigma in getattr(points, name).tolist()]
    return columns


def _geojson_text(points: Points, suffix: str) -> str:
    return json_text(points.__geo_interface__)


def _qgis_text(points: Points, suffix: str) -> str:
    if points.crs.is_geocentric:
        points = points.to_crs("EPSG:4979")  # without heights, X and Y alone are no position
    lines = [f"#CRS: {crs_definition(points.crs)}", "mapX,mapY,sourceX,sourceY,enable,dX,dY,residual"]
    for (column, row), (x, y, _) in zip(points.image.tolist(), points.ground.tolist(), strict=True):
        lines.append(f"{x!r},{y!r},{column!r},{-row!r},1,0,0,0")
    return "\n".join(lines) + "\n"
