"""How well an adjusted block determines where two images lie to each other, in their overlap.

An image puts what it shows on the ground by its model. An error :math:`dp` of the parameters moves it by
:math:`-J^{-1} A\\, dp`, with the partials :math:`A` of the image point by them and :math:`J` by the place in plan. Over
a DEM, an error :math:`dh` of the height moves it by :math:`-J^{-1} f\\, dh`, with the partial :math:`f` by the height.
There :math:`J` also has :math:`f` times the slope, because the height is read where the image puts it. How far two
images put the same ground from each other is the difference, and its covariance is that of the parameters of both, and
of the heights with them. The mean over the points that both images show, in pixels of the first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.local_frame import GEODETIC, enu_partials
from ortho_pipeline.block.points import Index
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
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


def joins_of(fit: BlockFit, dem: AdjustedDem | None = None) -> tuple[Join, ...]:
    """Return the joins of all adjusted pairs of images with used points in common, in the order of the images.

    At the true heights of the ground; for orthos over the DEM of the block, give `fit.adjusted_dem`.
    """
    points, found = fit.points, []
    used = fit.used_rays & np.asarray(np.isfinite(fit.ground).all(axis=1))[points.point]
    by_image = [np.unique(points.point[rays[used[rays]]]) for rays in points.rays_of_images]
    for first, second in _pairs(fit, used):
        shared = np.intersect1d(by_image[first], by_image[second], assume_unique=True)
        with_height = shared[:0] if dem is None else shared[np.isfinite(dem.loads[shared]).all(axis=1)]
        over, shared = (dem, with_height) if len(with_height) else (None, shared)
        chosen = shared[np.linspace(0, len(shared) - 1, min(len(shared), _PLACES)).astype(int)]
        one, other = (_Moves.of(fit, image, chosen, over) for image in (first, second))
        # Errors of models without parameters are not known.
        if not (one.by_params.size or other.by_params.size):
            continue
        if not (np.isfinite(one.by_params).all() and np.isfinite(other.by_params).all()):
            continue
        between = _between(fit, first, second, one.by_params.shape[1], other.by_params.shape[1])
        cross = one.by_params @ between @ other.by_params.T
        own = sum(part.by_params @ fit.cofactors.of_image(part.image) @ part.by_params.T for part in (one, other))
        covariance = own - cross - cross.T
        if over is not None:
            covariance = covariance + _of_heights(fit, over, chosen, one, other)
        found.append(Join(points.images[first], points.images[second], covariance / one.pixel**2, one.pixel))
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Moves:
    """How an image moves the ground east and north at n places, m.

    `by_params` ``(2, p)`` on average, by its parameters; `by_height` ``(n, 2)`` by a metre of height. `pixel`, m.
    """

    image: int
    by_params: Array
    by_height: Array
    pixel: float

    @classmethod
    def of(cls, fit: BlockFit, image: int, points: Index, dem: AdjustedDem | None) -> _Moves:
        """Return it of an image at some of the points."""
        model, ground = fit.models[fit.points.images[image]], fit.ground[points]
        partials = enu_partials(model, ground)
        plan = partials[:, :, :2]
        pixel = float(np.sqrt((1.0 / np.abs(np.linalg.det(plan))).mean()))
        if dem is not None:
            plan = plan + partials[:, :, 2:] * dem.slopes[points, None, :]
        inverse = np.linalg.inv(plan)
        by_height = -np.einsum("nij,nj->ni", inverse, partials[:, :, 2])
        by_params = np.zeros((2, 0))
        if len(model.params):
            there = ground_transform(GEODETIC, model.crs)(ground)
            by_params = -(inverse @ model.param_partials(there)).mean(axis=0)
        return cls(image, by_params, by_height, pixel)


def _of_heights(fit: BlockFit, dem: AdjustedDem, points: Index, one: _Moves, other: _Moves) -> Array:
    """Return what the errors of an adjusted DEM add to the covariance ``(2, 2)`` of a join at points with heights, m².

    A displacement that the block knows but leaves counts with its square. Errors that samples of the DEM have of their
    own move orthos from place to place; little of that is left on average.
    """
    by_height = one.by_height - other.by_height
    by_unknown = by_height.T @ dem.loads[points] / len(points)
    known = by_height.T @ dem.known[points] / len(points)
    columns = fit.cofactors.levels.columns
    through = one.by_params @ dem.by_params[columns.of_image(one.image)]
    through = through - other.by_params @ dem.by_params[columns.of_image(other.image)]
    left = through - by_unknown
    added = left @ dem.covariance @ left.T - through @ dem.covariance @ through.T
    own = by_height * dem.own[points, None]
    samples = max(_area(fit.ground[points]) / dem.sample**2, 1.0)
    return np.asarray(added + np.outer(known, known) + own.T @ own / len(points) / samples)


def _area(ground: Array) -> float:
    """Return the area, m², of a rectangle over which places, lon, lat, h ``(n, 3)``, are spread."""
    degrees = (ground[:, :2] - ground[:1, :2] + 180.0) % 360.0 - 180.0
    metres = degrees * metres_per_degree(ground[:1])
    return float(12.0 * np.sqrt(max(np.linalg.det(np.cov(metres.T)), 0.0))) if len(ground) > 1 else 0.0


def _pairs(fit: BlockFit, used: Mask) -> list[tuple[int, int]]:
    """Return the pairs of images that used points have rays in."""
    from scipy.sparse import coo_array

    points, rays = fit.points, np.flatnonzero(used)
    size = (len(points), len(points.images))
    seen = coo_array((np.ones(len(rays)), (points.point[rays], points.image[rays])), shape=size).tocsr()
    shared = (seen.T @ seen).tocoo()
    return sorted((a, b) for a, b in zip(shared.row.tolist(), shared.col.tolist(), strict=True) if a < b)


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
