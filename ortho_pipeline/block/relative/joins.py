"""How well an adjusted block determines where two images lie to each other, in their overlap.

An image puts what it shows on the ground by its model. An error :math:`dp` of the parameters moves it by
:math:`-J^{-1} A\\, dp`, with the partials :math:`A` of the image point by them and :math:`J` by the place in plan. How
far two images put the same ground from each other is the difference, and its covariance is that of the parameters of
both. The mean over the points that both images show, in pixels of the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GEODETIC, plan_partials
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array

#: Points of a pair at which it is computed.
_PLACES = 30
#: Pairs that a notice names.
_NAMED = 5


@dataclass(frozen=True, eq=False)
class Join:
    """How well two images with points in common lie to each other.

    `covariance` ``(2, 2)`` is that of their distance east and north in pixels, `pixel` the side of one in metres.
    """

    first: str
    second: str
    covariance: Array
    pixel: float

    @property
    def sigma(self) -> float:
        """Standard deviation in pixels along the direction in which it is largest."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance)[-1], 0.0)))

    @property
    def azimuth_deg(self) -> float:
        """That direction, from the north clockwise, 0 to 180."""
        east, north = np.linalg.eigh(self.covariance)[1][:, -1]
        return math.degrees(math.atan2(east, north)) % 180.0

    def figures(self, limit: float) -> dict[str, Any]:
        """Return its members of a `block.network.ImagePairRecord`; beyond a limit (px) it is weak."""
        sigma = self.sigma
        return {
            "sigma_px": sigma,
            "sigma_m": sigma * self.pixel,
            "azimuth_deg": self.azimuth_deg,
            "weak": sigma > limit,
        }


def joins_of(fit: BlockFit) -> tuple[Join, ...]:
    """Return the joins of all pairs of images with points in common that took part, in the order of the images."""
    points, found = fit.points, []
    used = fit.used_rays & np.asarray(np.isfinite(fit.ground).all(axis=1))[points.point]
    by_image = [np.unique(points.point[rays[used[rays]]]) for rays in points.rays_of_images]
    for first, second in _pairs(fit, used):
        shared = np.intersect1d(by_image[first], by_image[second], assume_unique=True)
        chosen = shared[np.linspace(0, len(shared) - 1, min(len(shared), _PLACES)).astype(int)]
        (one, pixel), (other, _) = (_moves(fit, image, fit.ground[chosen]) for image in (first, second))
        if not (np.isfinite(one).all() and np.isfinite(other).all()):
            continue
        between = _between(fit, first, second, one.shape[1], other.shape[1])
        cross = one @ between @ other.T
        own = one @ fit.cofactors.of_image(first) @ one.T + other @ fit.cofactors.of_image(second) @ other.T
        covariance = (own - cross - cross.T) / pixel**2
        found.append(Join(points.images[first], points.images[second], covariance, pixel))
    return tuple(found)


def _pairs(fit: BlockFit, used: Mask) -> list[tuple[int, int]]:
    """Return the pairs of images that used points have rays in."""
    from scipy.sparse import coo_array

    points, rays = fit.points, np.flatnonzero(used)
    size = (len(points), len(points.images))
    seen = coo_array((np.ones(len(rays)), (points.point[rays], points.image[rays])), shape=size).tocsr()
    shared = (seen.T @ seen).tocoo()
    return sorted((a, b) for a, b in zip(shared.row.tolist(), shared.col.tolist(), strict=True) if a < b)


def _moves(fit: BlockFit, image: int, ground: Array) -> tuple[Array, float]:
    """Return how parameters of an image move the ground ``(2, p)`` east and north, m, on average; and a pixel, m."""
    model = fit.models[fit.points.images[image]]
    there = ground_transform(GEODETIC, model.crs)(ground)
    inverse = np.linalg.inv(plan_partials(model, ground))
    pixel = float(np.sqrt(np.abs(np.linalg.det(inverse)).mean()))
    if not len(model.params):
        return np.zeros((2, 0)), pixel
    return np.asarray(-(inverse @ model.param_partials(there)).mean(axis=0)), pixel


def _between(fit: BlockFit, first: int, second: int, rows: int, columns: int) -> Array:
    """Return the covariance ``(p, q)`` of the parameters of two images."""
    both = np.array([first]), np.array([second])
    return np.asarray(fit.cofactors.between(*(index.astype(np.int64) for index in both))[0, :rows, :columns])


def weak_joins(joins: tuple[Join, ...], limit: float, dem_unused: bool = False) -> tuple[Notice, ...]:
    """Return a notice of pairs whose relative position is less accurate than a limit (px)."""
    weak = sorted((join for join in joins if join.sigma > limit), key=lambda join: -join.sigma)
    if not weak:
        return ()
    named = "; ".join(
        f"{join.first} and {join.second}, {significant(join.sigma)} px ({significant(join.sigma * join.pixel)} m) "
        f"along azimuth {join.azimuth_deg:.0f}°"
        for join in weak[:_NAMED]
    )
    more = f"; and {len(weak) - _NAMED} more" if len(weak) > _NAMED else ""
    pairs = counted(len(weak), "pair of images", "pairs of images")
    text = f"the relative position of {pairs} has a sigma above {limit:g} px: {named}{more}"
    worst = weak[0]
    fields = {
        "worst": [worst.first, worst.second],
        "sigma_px": worst.sigma,
        "limit_px": limit,
        "dem_unused": dem_unused,
    }
    return (Notice("weak-join", text, pairs=len(weak), **fields),)
