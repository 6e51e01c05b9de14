"""How the images of a block hang together: which of them see the same points, and at what angles their rays meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.intersection import largest_angles, ray_angles
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.models.base import Array

Index = NDArray[np.int64]


@dataclass(frozen=True)
class ImagePair:
    """Two images, how many points both of them have rays of, and the median angle (degrees) between these rays."""

    first: str
    second: str
    points: int
    angle_deg: float


@dataclass(frozen=True, eq=False)
class Network:
    """The images of a block as nodes, and what ties them.

    Parameters
    ----------
    pairs : tuple of ImagePair
        Those with points in common, in the order of the images.
    angles_deg : ndarray (N,)
        Largest angle between two rays of each point; NaN for points of one ray.
    parts : tuple of tuple of str
        Images that hang together by points in common, the largest part first; one part is what a block ought to be.
    """

    pairs: tuple[ImagePair, ...]
    angles_deg: Array
    parts: tuple[tuple[str, ...], ...]


def network_of(fit: BlockFit) -> Network:
    """Return the network of an adjusted block, by the rays that were used."""
    points = fit.points
    one, other, angles = ray_angles(points.point, _directions(fit))
    largest = largest_angles(points, one, angles)
    ends = np.sort(np.stack([points.image[one], points.image[other]], axis=1), axis=1)
    found, which = np.unique(ends, axis=0, return_inverse=True)
    pairs = tuple(
        ImagePair(
            points.images[first], points.images[second], int((which.ravel() == k).sum()),
            float(np.median(angles[which.ravel() == k])),
        )
        for k, (first, second) in enumerate(found.tolist())
    )  # fmt: skip
    return Network(pairs, largest, _parts(points.images, found))


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
