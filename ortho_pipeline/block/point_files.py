"""Points of a block from files: a line for each ray, or a feature for each point."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline.block.points import SAME_PLACE, BlockPoints, Index, shape_of
from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, same_crs
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import DEFAULT_SIGMA_IMAGE
from ortho_pipeline.points.formats import read_block_table
from ortho_pipeline.points.ground import ground_of
from ortho_pipeline.points.image_errors import (
    covariance_of,
    groups_of,
    sigmas_of,
)
from ortho_pipeline.points.rows import OF_GROUND, PointRow, Table, origin_shift


@reads("see docs/formats.md for the columns of a file of points")
def read_block_points(
    path: str | os.PathLike[str],
    *,
    gcps: str | os.PathLike[str] | None = None,
    crs: str | pyproj.CRS | None = None,
    vertical: str | Vertical | None = None,
    pixel_origin: str = "corner",
) -> BlockPoints:
    """Read the points of a block: one line per ray as CSV, one feature per point as GeoJSON, or an ODM list.

    Parameters
    ----------
    gcps : path, optional
        Ground of the points in a file of its own (CSV ``id,x,y,h,...`` or GeoJSON).
    crs, vertical : optional
        What ground and heights are in, where the files do not say it.
    pixel_origin : 'corner', 'center', 'corner-1' or 'center-1'
        As in `read_points`.

    Raises
    ------
    InputError, CrsError, DatumError
        Names file and line, and what to do: for statements of one point that contradict each other, too.

    Examples
    --------
    >>> op.read_block_points("sample_data/cartosat/points.csv")
    <69 points: 9 control, 60 check; 138 rays in 2 images; sample_data/cartosat/points.csv>
    """
    rays = read_block_table(path)
    shift = origin_shift(path, rays, pixel_origin)
    _name_by_place(path, rays)
    joined = _Joined()
    where = _placed(path, rays, crs, vertical)
    joined.add(path, rays.rows, where[0])
    plane = where[1]
    if gcps is not None:
        known = read_block_table(gcps, OF_GROUND)
        _refuse_twice(gcps, known.rows)
        ground, other = _placed(gcps, known, crs, vertical)
        plane = other if plane is None else plane
        if plane is not None and other is not None and not same_crs(plane, other):
            ground = ground_transform(other, plane)(ground)
        joined.add(gcps, [row for row in known.rows if row.id in joined.index], ground, known.rows)
        if not any(row.id in joined.index for row in known.rows):
            raise InputError(
                "no image shows any of these points",
                file=gcps,
                field="id",
                remedy=f"use the ids of {os.fspath(path)}",
            )
    return joined.points(path, rays.rows, shift, pyproj.CRS.from_epsg(4326) if plane is None else plane)


def _name_by_place(path: str | os.PathLike[str], table: Table) -> None:
    """Give rays without an id that of their ground: in an ODM list the label is optional, the ground is not."""
    names: dict[tuple[float, ...], str] = {}
    for row in table.rows:
        if row.id is None:
            if not math.isfinite(row.ground[0]):
                raise InputError("a point without an id", file=path, field=row.where, remedy="give each point an id")
            row.id = names.setdefault(row.ground, f"point {len(names) + 1}")


def _placed(
    path: str | os.PathLike[str], table: Table, crs: str | pyproj.CRS | None, vertical: str | Vertical | None
) -> tuple[Array, pyproj.CRS | None]:
    """Return the ground of the rows and its CRS; without any ground no CRS has to be known."""
    for row in table.rows:
        if math.isfinite(row.ground[0]) != math.isfinite(row.ground[1]) or (
            math.isfinite(row.ground[2]) and not math.isfinite(row.ground[0])
        ):
            raise InputError(
                "x, y or both are missing", file=path, field=row.where, remedy="give x and y, or no ground"
            )
    if not any(math.isfinite(row.ground[0]) for row in table.rows):
        return np.full((len(table.rows), 3), np.nan), None
    return ground_of(path, table, crs, vertical)


def _refuse_twice(path: str | os.PathLike[str], rows: Sequence[PointRow]) -> None:
    first: dict[str | None, str] = {}
    for row in rows:
        if first.setdefault(row.id, row.where) != row.where:
            raise InputError(
                f"the id {row.id!r} stands twice, first in {first[row.id]}",
                file=path,
                field=row.where,
                remedy="give each point once",
            )


class _Joined:
    """Statements of one or two files on each point, refused where they contradict each other."""

    def __init__(self) -> None:
        self.index: dict[str, int] = {}
        self.said: list[dict[str, tuple[Any, str]]] = []

    def add(
        self,
        path: str | os.PathLike[str],
        rows: Sequence[PointRow],
        ground: Array,
        of: Sequence[PointRow] | None = None,
    ) -> None:
        """Take in rows; `ground` belongs to all rows of a file, `of`, where these are only some."""
        place = {id(row): k for k, row in enumerate(of or rows)}
        for row in rows:
            number = self.index.setdefault(str(row.id), len(self.index))
            if number == len(self.said):
                self.said.append({})
            x, y, h = ground[place[id(row)]].tolist()
            where = f"{os.fspath(path)}, {row.where}"
            said = {
                "x": x,
                "y": y,
                "h": h,
                "role": row.role or None,
                "sigma_xy": row.sigma_xy,
                "sigma_h": row.sigma_h,
                "sigma_common": row.sigma_common,
            }
            for name, value in said.items():
                if value is None or (isinstance(value, float) and math.isnan(value)):
                    continue
                before, there = self.said[number].setdefault(name, (value, where))
                same = abs(before - value) <= SAME_PLACE if isinstance(value, float) else before == value
                if not same:
                    raise InputError(
                        f"the {name} of the point {row.id!r} is {value} here and {before} in {there}",
                        file=path,
                        field=row.where,
                        remedy="one point has one ground, one role and one accuracy",
                    )

    def points(
        self, path: str | os.PathLike[str], rows: Sequence[PointRow], shift: float, crs: pyproj.CRS
    ) -> BlockPoints:
        """Return the table of the points, with the rays of `rows`."""
        said = [{name: value for name, (value, _) in one.items()} for one in self.said]
        images = tuple(dict.fromkeys(str(row.image_name) for row in rows))
        ground = np.array([[one.get(name, math.nan) for name in ("x", "y", "h")] for one in said])
        known = np.isfinite(ground[:, 0])
        roles = [one.get("role", "control" if there else "tie") for one, there in zip(said, known, strict=True)]
        measured = np.array([row.image for row in rows]) + shift
        image = np.array([images.index(str(row.image_name)) for row in rows])
        point = np.array([self.index[str(row.id)] for row in rows])
        _refuse_same(path, tuple(self.index), [row.where for row in rows], ground, measured, image, point)
        return BlockPoints(
            ids=tuple(self.index),
            ground=ground,
            roles=np.array(roles, dtype="<U7"),
            sigma_ground=np.array([[one.get("sigma_xy", 0.0)] * 2 + [one.get("sigma_h", 0.0)] for one in said]),
            crs=crs,
            images=images,
            point=point,
            image=image,
            measured=measured,
            sigma_image=(sigma := sigmas_of(rows, DEFAULT_SIGMA_IMAGE)),
            source=os.fspath(path),
            shape_image=shape_of(covariance_of(rows, sigma)),
            sigma_common=np.array([one.get("sigma_common", 0.0) for one in said]),
            groups=groups_of(rows),
        )


def _refuse_same(
    path: str | os.PathLike[str],
    ids: tuple[str, ...],
    wheres: Sequence[str],
    ground: Array,
    measured: Array,
    image: Index,
    point: Index,
) -> None:
    """Refuse one place under two ids, on the ground or in an image: a point that counts twice, or a wrong copy."""
    places: dict[tuple[float, ...], int] = {}
    for number, key in enumerate(map(tuple, ground.tolist())):
        other = places.setdefault(key, number) if math.isfinite(key[0]) else number
        if other != number:
            raise InputError(
                f"the points {ids[other]!r} and {ids[number]!r} have the same ground",
                file=path,
                field="x, y, h",
                remedy="remove one of the two",
            )
    pixels: dict[tuple[float, ...], int] = {}
    for ray, key in enumerate(zip(image.tolist(), *np.round(measured, 6).T.tolist(), strict=True)):
        other = pixels.setdefault(key, ray)
        if other != ray:
            raise InputError(
                f"the same pixel of the same image as in {wheres[other]}"
                + ("" if point[other] == point[ray] else f", but of {ids[point[other]]!r} there"),
                file=path,
                field=wheres[ray],
                remedy="remove one of the two",
            )
