"""Points of a block: each measured in several images, with or without known ground.

A measurement of a point in an image is called a ray. The table keeps points and rays apart, so that a point has one
ground, one role and one identity however many images show it.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pyproj
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs, same_crs
from ortho_pipeline.models.base import Array
from ortho_pipeline.options import is_usable
from ortho_pipeline.points import Points
from ortho_pipeline.points.image_errors import (
    checked_common,
    checked_covariance,
    checked_groups,
    says_more,
    sigma_of_covariance,
)
from ortho_pipeline.points.rows import ROLES

#: Two statements of one point's ground are the same within this (degrees or metres): files round.
SAME_PLACE = 1e-9
#: The same for two tables, which may be in different systems: a millimetre on a map, and in degrees.
_MILLIMETRE = 1e-3, 1e-8
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class BlockPoints:
    """Points that were measured in images of a block.

    Parameters
    ----------
    ids : tuple of str
        Of the N points, all different.
    ground : ndarray (N, 3)
        x, y in `crs`, height in metres above the ellipsoid; NaN is not known.
    roles : ndarray (N,) of str
        ``control``, ``check`` or ``tie``.
    sigma_ground : ndarray (N, 3)
        Standard deviation of the ground in metres east, north, up; 0 is not stated: an adjustment estimates it.
    crs : pyproj.CRS
        Horizontal CRS, x first.
    images : tuple of str
        Names of the images.
    point, image : ndarray (M,) of int
        Which point a ray is of, and in which image.
    measured : ndarray (M, 2)
        Column, row in pixels.
    sigma_image : ndarray (M,)
        Standard deviation of the measurement, px.
    source : str
        Where they come from, for people.
    shape_image : ndarray (M, 2, 2), optional
        Covariance of the measurement over the square of `sigma_image`, which is its root mean square per axis. If not
        given, measurements are as certain in all directions; other values of `sigma_image` change the scale alone.
    sigma_common : ndarray (N,), optional
        As in `Points`: standard deviation (m, per axis in plan) of what the ground of points with one has in common.
    groups : ndarray (M,) of int, optional
        As in `Points`: from 0 on where a measurement shares errors with those of neighbours in its image, else -1. None
        where none does.

    Examples
    --------
    >>> points = op.read_block_points("sample_data/cartosat/points.csv")
    >>> len(points), points.rays, len(points.in_image("BANDF.tif"))
    (69, 138, 69)
    """

    ids: tuple[str, ...]
    ground: Array
    roles: NDArray[np.str_]
    sigma_ground: Array
    crs: pyproj.CRS
    images: tuple[str, ...]
    point: Index
    image: Index
    measured: Array
    sigma_image: Array
    source: str = ""
    shape_image: Array | None = None
    sigma_common: Array = None  # type: ignore[assignment]  # filled below
    groups: Index | None = None
    _errors: ImageErrors | None = field(init=False, repr=False, default=None)

    def __post_init__(self) -> None:
        count, rays = len(self.ids), len(self.point)
        for name, shape, kind in (
            ("ground", (count, 3), float),
            ("sigma_ground", (count, 3), float),
            ("point", (rays,), np.int64),
            ("image", (rays,), np.int64),
            ("measured", (rays, 2), float),
            ("sigma_image", (rays,), float),
            ("roles", (count,), "<U7"),
        ):
            array = np.asarray(getattr(self, name), dtype=kind)
            if array.shape != shape:
                raise InputError(f"{name} has the shape {array.shape}, not {shape}", field=name)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "ids", tuple(self.ids))
        object.__setattr__(self, "images", tuple(self.images))
        object.__setattr__(self, "sigma_common", checked_common(self.sigma_common, count))
        groups = checked_groups(self.groups, rays)
        object.__setattr__(self, "groups", groups if (groups >= 0).any() else None)
        _check_values(self)
        _check_identity(self)
        if self.shape_image is not None:
            directions = checked_covariance(self.shape_image, rays)
            object.__setattr__(self, "shape_image", directions)
            object.__setattr__(self, "_errors", ImageErrors(np.asarray(np.linalg.cholesky(directions))))

    def __repr__(self) -> str:
        roles = ", ".join(f"{(self.roles == role).sum()} {role}" for role in ROLES if (self.roles == role).any())
        return (
            f"<{counted(len(self), 'point')}: {roles or 'none'}; {counted(self.rays, 'ray')} in "
            f"{counted(len(self.images), 'image')}; {self.source}>"
        )

    def __len__(self) -> int:
        return len(self.ids)

    @classmethod
    def of(cls, tables: Mapping[str, Points]) -> BlockPoints:
        """Join the tables of single images, by name of the image; points of one id are one point.

        Raises
        ------
        InputError
            If the tables contradict each other in the ground or the role of a point.
        """
        return _joined(tables)

    @property
    def control(self) -> NDArray[np.bool_]:
        """Which points are control ``(N,)``."""
        return np.asarray(self.roles == "control")

    @property
    def check(self) -> NDArray[np.bool_]:
        """Which points are check points ``(N,)``."""
        return np.asarray(self.roles == "check")

    @property
    def tie(self) -> NDArray[np.bool_]:
        """Which points are tie points ``(N,)``."""
        return np.asarray(self.roles == "tie")

    @property
    def rays(self) -> int:
        """Number of measurements M."""
        return len(self.point)

    @cached_property
    def rays_of_images(self) -> tuple[Index, ...]:
        """Rays of each image, as they follow each other here."""
        order = np.argsort(self.image, kind="stable")
        ends = np.searchsorted(self.image[order], np.arange(len(self.images) + 1))
        return tuple(order[a:b] for a, b in itertools.pairwise(ends))

    @cached_property
    def by_point(self) -> Index:
        """Rays by point, those of a point by image."""
        return np.lexsort((self.image, self.point))

    def with_image_sigmas(self, sigmas: Array) -> BlockPoints:
        """Return these points with other standard deviations ``(M,)`` (px) of their measurements, positive ones."""
        # Nothing else depends on them, nor what was found of it, for which a large block would be gone through again.
        found = copy.copy(self)
        object.__setattr__(found, "sigma_image", sigmas)
        return found

    def with_roles(self, roles: ArrayLike) -> BlockPoints:
        """Return these points with other roles ``(N,)``."""
        return replace(self, roles=np.asarray(roles))

    def with_ground_sigma(self, plan: float, height: float | None = None) -> BlockPoints:
        """Return these points with standard deviations (m) for ground that states none; height as plan if not given."""
        height = plan if height is None else height
        if not (is_usable(plan) and plan > 0 and is_usable(height) and height > 0):
            raise InputError(
                "standard deviations of the ground must be positive",
                field="points.ground_sigma",
                remedy="give metres in plan, or in plan and height, such as 0.5,1",
            )
        return replace(self, sigma_ground=np.where(self.sigma_ground > 0, self.sigma_ground, (plan, plan, height)))

    def select(self, mask: ArrayLike) -> BlockPoints:
        """Return the points of a mask ``(N,)`` or of indices, with their rays."""
        chosen = np.arange(len(self))[np.asarray(mask)]
        place = np.full(len(self), -1)
        place[chosen] = np.arange(len(chosen))
        rays = place[self.point] >= 0
        return replace(
            self.of_rays(rays),
            ids=tuple(self.ids[i] for i in chosen),
            ground=self.ground[chosen],
            roles=self.roles[chosen],
            sigma_ground=self.sigma_ground[chosen],
            point=place[self.point[rays]],
            sigma_common=self.sigma_common[chosen],
        )

    def of_rays(self, rays: ArrayLike) -> BlockPoints:
        """Return these points with some of their rays, a mask ``(M,)`` or indices; points without any stay."""
        chosen = np.arange(self.rays)[np.asarray(rays)]
        return replace(
            self,
            point=self.point[chosen],
            image=self.image[chosen],
            measured=self.measured[chosen],
            sigma_image=self.sigma_image[chosen],
            shape_image=self._shape_of(chosen),
            groups=self.grouped[chosen],
        )

    def _shape_of(self, rays: NDArray[Any]) -> Array | None:
        return None if self.shape_image is None else self.shape_image[rays]

    @property
    def grouped(self) -> Index:
        """Groups of the measurements ``(M,)``, -1 for those that err on their own."""
        return np.full(self.rays, -1) if self.groups is None else self.groups

    @property
    def covariance_image(self) -> Array:
        """Covariances of the measurements ``(M, 2, 2)`` px²."""
        shape = np.eye(2) if self.shape_image is None else self.shape_image
        return np.asarray(self.sigma_image[:, None, None] ** 2 * shape)

    def whitened(self, values: Array, rays: Index | slice) -> Array:
        """Return values of rays ``(k, 2, ...)``, over their sigma already, as independent and of sigma 1."""
        return values if self._errors is None else self._errors[rays].whitened(values)

    def in_pixels(self, values: Array, rays: Index) -> Array:
        """Return in pixels what `whitened` returned, values of rays ``(k, 2, ...)``."""
        if self._errors is not None:
            values = self._errors[rays].restored(values)
        return np.asarray(values * self.sigma_image[rays].reshape(-1, *[1] * (values.ndim - 1)))

    def in_image(self, name: str) -> Points:
        """Return the points that were measured in one image, as the table of that image."""
        if name not in self.images:
            raise InputError(
                f"no point was measured in the image {name!r}",
                file=self.source or None,
                field="image",
                remedy=f"the images are {', '.join(self.images)}",
            )
        rays = np.flatnonzero(self.image == self.images.index(name))
        rows = self.point[rays]
        return Points(
            ids=tuple(self.ids[i] for i in rows),
            image=self.measured[rays],
            ground=self.ground[rows],
            roles=self.roles[rows],
            sigma_image=self.sigma_image[rays],
            sigma_ground=self.sigma_ground[rows],
            crs=self.crs,
            source=self.source,
            covariance_image=self.covariance_image[rays],
            sigma_common=self.sigma_common[rows],
            groups=self.grouped[rays],
        )

    def known_in(self, crs: str | pyproj.CRS) -> Array:
        """Return the known ground ``(N, 3)`` in another CRS; an unknown height makes the whole row NaN."""
        target = parse_crs(crs)
        return ground_transform(self.crs, target if target.is_geocentric else horizontal(target))(self.ground)


def _check_values(points: BlockPoints) -> None:
    if not np.isin(points.roles, ROLES).all():
        raise InputError(f"the role of a point must be one of {', '.join(ROLES)}", field="roles")
    if not np.isfinite(points.measured).all() or not (points.sigma_image > 0).all():
        raise InputError("measurements must be finite, and their sigmas positive", field="measured, sigma_image")
    if not (points.sigma_ground >= 0).all():
        raise InputError("a standard deviation must not be negative", field="sigma_ground")
    for role in ("control", "check"):
        nowhere = (points.roles == role) & ~np.isfinite(points.ground[:, :2]).all(axis=1)
        if nowhere.any():
            names = ", ".join(points.ids[i] for i in np.flatnonzero(nowhere)[:5])
            raise InputError(
                f"{role} points without ground coordinates: {names}",
                file=points.source or None,
                field="role",
                remedy="give their ground, or make them tie points",
            )


def _joined(tables: Mapping[str, Points]) -> BlockPoints:
    """Return the points of several tables, by name of the image."""
    if not tables:
        raise InputError("no images with points; a block needs some", field="points")
    crs = next(iter(tables.values())).crs
    index, first, rays = dict[str, int](), list[tuple[Points, int]](), list[tuple[int, int]]()
    sigmas = list[list[Array]]()
    for number, (name, table) in enumerate(tables.items()):
        moved = table if same_crs(table.crs, crs) else table.to_crs(crs)
        for k, one in enumerate(moved.ids):
            row = index.setdefault(one, len(index))
            own = [moved.sigma_ground[k], moved.sigma_common[k]]
            if row == len(first):
                first.append((moved, k))
                sigmas.append(own)
            else:
                _agree(one, name, *first[row], moved, k)
                sigmas[row] = [_stated(one, name, moved, *both) for both in zip(sigmas[row], own, strict=True)]
            rays.append((row, number))

    def stated(what: str) -> Any:
        return [getattr(of, what)[k] for of, k in first]

    places = np.array(rays, dtype=np.int64).reshape(-1, 2)
    return BlockPoints(
        ids=tuple(index),
        ground=np.reshape(stated("ground"), (-1, 3)),
        roles=np.array(stated("roles"), "<U7"),
        sigma_ground=np.reshape([ground for ground, _ in sigmas], (-1, 3)),
        crs=crs,
        images=tuple(tables),
        point=places[:, 0],
        image=places[:, 1],
        measured=np.concatenate([table.image for table in tables.values()]),
        sigma_image=np.concatenate([table.sigma_image for table in tables.values()]),
        source=", ".join(dict.fromkeys(table.source for table in tables.values() if table.source)),
        shape_image=shape_of(np.concatenate([table.covariance_image for table in tables.values()])),
        sigma_common=np.array([common for _, common in sigmas]),
        groups=np.concatenate([table.groups for table in tables.values()]),
    )


def _check_identity(points: BlockPoints) -> None:
    if len(set(points.ids)) != len(points.ids) or len(set(points.images)) != len(points.images):
        raise InputError("duplicate id or image name", file=points.source or None, field="id")
    if len(points.point) and not (
        (points.point >= 0).all()
        and (points.point < len(points.ids)).all()
        and (points.image >= 0).all()
        and (points.image < len(points.images)).all()
    ):
        raise InputError("a measurement names a point or an image that does not exist", field="point, image")
    rays, counts = np.unique(points.point * max(len(points.images), 1) + points.image, return_counts=True)
    if (counts > 1).any():
        point, image = divmod(int(rays[counts > 1][0]), len(points.images))
        raise InputError(
            f"the point {points.ids[point]!r} was measured twice in the image {points.images[image]!r}",
            file=points.source or None,
            field="id",
            remedy="remove one of the two measurements",
        )


def joined(images: Sequence[str], tables: Sequence[BlockPoints]) -> BlockPoints:
    """Return tables of some of these images as one, in the CRS of the first; their points are different ones.

    Ids that two tables have get ``'`` behind them in the later one.
    """
    crs = tables[0].crs
    ids: list[str] = []
    grounds, points, places = [], [], []
    for table in tables:
        moved = table.known_in(crs) if not same_crs(table.crs, crs) else table.ground
        grounds.append(moved)
        points.append(table.point + len(ids))
        places.append(np.array([list(images).index(name) for name in table.images], dtype=np.int64)[table.image])
        mark = ""
        while not set(ids).isdisjoint(name + mark for name in table.ids):
            mark += "'"
        ids += [name + mark for name in table.ids]

    def all_of(name: str) -> Any:
        return np.concatenate([getattr(table, name) for table in tables])

    return BlockPoints(
        ids=tuple(ids),
        ground=np.concatenate(grounds),
        roles=all_of("roles"),
        sigma_ground=all_of("sigma_ground"),
        crs=crs,
        images=tuple(images),
        point=np.concatenate(points),
        image=np.concatenate(places),
        measured=all_of("measured"),
        sigma_image=all_of("sigma_image"),
        source=", ".join(dict.fromkeys(table.source for table in tables if table.source)),
        shape_image=shape_of(all_of("covariance_image")),
        sigma_common=all_of("sigma_common"),
        groups=all_of("grouped"),
    )


def _agree(one: str, name: str, first: Points, row: int, table: Points, k: int) -> None:
    """Refuse two statements of one point, in rows of two tables, that differ."""
    height, degree = _MILLIMETRE
    plan = degree if first.crs.is_geographic else height
    limit = np.array([plan, plan, height])
    near = np.isclose(first.ground[row] / limit, table.ground[k] / limit, rtol=0, atol=1, equal_nan=True)
    for what, same in (("role", first.roles[row] == table.roles[k]), ("ground", near.all())):
        if not same:
            raise InputError(
                f"the {what} of the point {one!r} differs in the image {name!r}",
                file=table.source or None,
                field="role" if what == "role" else "x, y, h",
                remedy="points with the same id must have the same ground and role",
            )


def _stated(one: str, name: str, table: Points, before: Array, sigma: Array) -> Array:
    """Return a standard deviation of a point that a table states, and others may leave out (0)."""
    if np.any((before > 0) & (sigma > 0) & (before != sigma)):
        raise InputError(
            f"the accuracy of the point {one!r} differs in the image {name!r}",
            file=table.source or None,
            field="sigma_ground",
            remedy="points with the same id must have the same sigmas, or state them once",
        )
    return np.maximum(before, sigma)


def shape_of(covariance: Array) -> Array | None:
    """Return covariances ``(M, 2, 2)`` over their mean square per axis; None if none differs with the direction."""
    more = says_more(covariance)
    if not more.any():
        return None
    shape = np.tile(np.eye(2), (len(covariance), 1, 1))
    shape[more] = covariance[more] / sigma_of_covariance(covariance[more])[:, None, None] ** 2
    return shape
