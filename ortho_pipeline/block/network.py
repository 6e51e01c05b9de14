"""How the images of a block hang together: which of them see the same points, and at what angles their rays meet."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.intersection import largest_angles, ray_angles
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.block.relative.joins import Join
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.models.base import Array

Index = NDArray[np.int64]


class ImagePairRecord(Record):
    """Two images, the number of points that both have rays of, and the median angle between these rays.

    `sigma_px` and `sigma_m` are the standard deviation of their relative position along `azimuth_deg`, where it is
    largest: of orthos over the adjusted DEM, or without heights of a DEM at the true height of the ground. The pair is
    `weak` if it exceeds the limit.
    """

    first: str
    second: str
    points: Count
    angle_deg: float
    sigma_px: float | None = None
    sigma_m: float | None = None
    azimuth_deg: float | None = None
    weak: bool = False


class Angles(Record):
    """The largest angle between two rays of each point, degrees, over the points that have two."""

    points: Count
    least: float
    median: float
    greatest: float


class NetworkRecord(Record):
    """What ties the images: pairs with points in common, the angles at which rays meet, parts that hang together.

    `largest_deg` has the largest angle of each point, in the order of the adjustment's points.
    """

    pairs: tuple[ImagePairRecord, ...]
    angles: Angles | None
    parts: tuple[tuple[str, ...], ...]
    largest_deg: tuple[float | None, ...]


def network_of(fit: BlockFit, joins: Sequence[Join] = (), limit: float = math.inf) -> NetworkRecord:
    """Return the network of an adjusted block, by the rays that were used; joins beyond a limit (px) are weak."""
    points = fit.points
    one, other, angles = ray_angles(points.point, _directions(fit))
    largest = largest_angles(points, one, angles)
    ends = np.sort(np.stack([points.image[one], points.image[other]], axis=1), axis=1)
    found, which = np.unique(ends, axis=0, return_inverse=True)
    relative = {(join.first, join.second): join.figures(limit) for join in joins}
    return NetworkRecord(
        pairs=tuple(
            ImagePairRecord(
                first=first,
                second=second,
                points=int((which.ravel() == k).sum()),
                angle_deg=np.median(angles[which.ravel() == k]),
                **relative.get((first, second), {}),
            )
            for k, (first, second) in enumerate((points.images[a], points.images[b]) for a, b in found.tolist())
        ),
        angles=_angles(largest[np.isfinite(largest)]),
        parts=_parts(points.images, found),
        largest_deg=json_value(largest),
    )


def _angles(known: Array) -> Angles | None:
    if not len(known):
        return None
    return Angles(points=len(known), least=known.min(), median=np.median(known), greatest=known.max())


def _directions(fit: BlockFit) -> Array:
    """Return the directions ``(M, 3)`` of the rays at the adjusted ground; NaN for those that were not used.

    In the local frame of the block. Along a ray the image does not change: it is across both rows of the partials.
    """
    points = fit.points
    found = np.full((points.rays, 3), np.nan)
    known: NDArray[np.bool_] = np.array(np.isfinite(fit.ground).all(axis=1), dtype=bool)
    if not known.any():
        return found
    frame = GroundFrame.about(fit.ground)
    places = frame.places(frame.of_geodetic(fit.ground))
    used: NDArray[np.bool_] = np.array(fit.used_rays & known[points.point], dtype=bool)
    for name, rays_of in zip(points.images, points.rays_of_images, strict=True):
        rays = rays_of[used[rays_of]]
        if len(rays):
            partials = places.ground_partials(fit.models[name], points.point[rays])
            found[rays] = np.cross(partials[:, 0], partials[:, 1])
    return found


def _parts(images: Sequence[str], pairs: Index) -> tuple[tuple[str, ...], ...]:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    size = len(images)
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
    number, label = connected_components(links, directed=False)
    parts = [tuple(images[k] for k in np.flatnonzero(label == part).tolist()) for part in range(number)]
    return tuple(sorted(parts, key=lambda part: -len(part)))
