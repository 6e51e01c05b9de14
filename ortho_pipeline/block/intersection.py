r"""Forward intersection: the ground point that the rays of several images meet in best.

For each point alone the sum of squares of :math:`(l_i - f_i(X)) / \sigma_i` over its rays is minimised, all points side
by side. The covariance of a point is :math:`\sigma_0^2 (B^T B)^{-1}` with the weighted partials :math:`B` of its rays,
times :math:`r / (r - 2)` with the redundancy :math:`r` of all points (Student's distribution: few residuals leave
:math:`\sigma_0` uncertain). Errors of the models themselves are not in it (they are in that of an adjustment). With a
redundancy below 4, rays can meet by chance: stated sigmas hold. Points whose rays miss each other by far more than
those of all others do not count for :math:`\sigma_0`: one gross error would scale the sigmas of all points.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.local_frame import GEODETIC, GroundFrame
from ortho_pipeline.block.points import BlockPoints, Index
from ortho_pipeline.block.projection.rays import linearised
from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.blunders import BLUNDER_RISK
from ortho_pipeline.estimation.observations.arguments import refuse_other_model, refuse_other_points
from ortho_pipeline.estimation.problem import LEAST_REDUNDANCY
from ortho_pipeline.estimation.statistics import chance_of
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel

#: Rays whose point is so many times less certain along its worst direction than along its best are parallel.
PARALLEL = 3e3
_STEPS = 30
#: Smaller squares of a misfit over its sigma are those of rounded numbers.
_ROUNDING = 1e-6
#: Points beyond so many robust sigmas are tested against the others.
_SUSPECT = 5.0
#: A step beyond this (m) comes from a linearisation too far from the point.
_LONGEST = 50_000.0


@dataclass(frozen=True, eq=False)
class Intersection:
    """Ground points of rays.

    Parameters
    ----------
    points : BlockPoints
    ground : ndarray (N, 3)
        Lon, lat (degrees), ellipsoidal height; NaN where fewer than two rays, or parallel ones, leave it open.
    covariance : ndarray (N, 3, 3)
        m², east, north, up.
    residuals : ndarray (M, 2)
        Measured minus predicted, px.
    angles_deg : ndarray (N,)
        Largest angle between two rays of the point.
    sigma0 : float or None
        Standard error of unit weight of all points together that do not contradict the others; None without redundancy.
    contradicting : ndarray (N,)
        Points whose rays miss each other by much more than those of all others. Their covariance has their own scale.
    """

    points: BlockPoints
    ground: Array
    covariance: Array
    residuals: Array
    angles_deg: Array
    sigma0: float | None
    contradicting: np.ndarray

    def __repr__(self) -> str:
        met = int(np.isfinite(self.ground).all(axis=1).sum())
        sigma0 = "unknown" if self.sigma0 is None else f"{self.sigma0:.3g}"
        return (
            f"<{met} of {counted(len(self.points), 'point')} intersected from "
            f"{counted(self.points.rays, 'ray')}: sigma0 {sigma0}>"
        )

    @property
    def sigmas(self) -> Array:
        """Standard deviations east, north, up in metres ``(N, 3)``."""
        return sigmas_of(self.covariance)

    @property
    def rays(self) -> Index:
        """Number of rays of each point ``(N,)``."""
        return np.bincount(self.points.point, minlength=len(self.points)).astype(np.int64)


def sigmas_of(covariance: Array) -> Array:
    """Return the standard deviations ``(N, 3)`` of covariances ``(N, 3, 3)``."""
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def intersect(models: Mapping[str, SensorModel], points: BlockPoints, *, scaled: bool = True) -> Intersection:
    """Intersect the rays of each point, whatever its role; known ground plays no part.

    Parameters
    ----------
    models : mapping of image name to SensorModel
        One for each image of the points.
    scaled : bool
        Scale covariances by the estimated sigma0² of all points together and by its uncertainty, if their redundancy is
        at least 4.

    Raises
    ------
    InputError
        If an image has no model.
    TooFewPoints
        If no point was measured in two images.

    Examples
    --------
    >>> points = op.read_block_points("sample_data/cartosat/points.csv")
    >>> models = {name: op.open_scene(f"sample_data/cartosat/{name}").model for name in points.images}
    >>> op.intersect(models, points).sigmas.shape  # metres east, north and up of each point
    (69, 3)
    """
    chosen = models_of(models, points)
    counts = np.bincount(points.point, minlength=len(points))
    if not (counts >= 2).any():
        raise TooFewPoints(
            "no point was measured in two images",
            file=points.source or None,
            remedy="a point needs rays of two images to be intersected; points of one id are one point",
        )
    frame = frame_of(chosen, points)
    local = meet(frame, chosen, points, np.ones(points.rays, dtype=bool))
    places = frame.places(local)
    found = np.asarray(np.isfinite(local).all(axis=1))
    residuals = points.measured - predict(frame, chosen, points, local)
    used = np.asarray(np.isfinite(residuals).all(axis=1))
    rays, of, misfit, partials = _equations(frame, chosen, points, used, local, np.arange(len(points)))
    squares = _per_point(len(points), of, (misfit**2).sum(axis=1))
    freedoms = np.where(found, 2 * np.bincount(of, minlength=len(points)) - 3, 0)
    contradicting = _contradicting(squares, freedoms)
    freedom = int(freedoms[~contradicting].sum())
    sigma0 = math.sqrt(float(squares[~contradicting].sum()) / freedom) if freedom > 0 else None
    axes = frame.enu_at(places.geodetic)
    covariance = np.full((len(points), 3, 3), np.nan)
    normal = _per_point(len(points), of, partials.swapaxes(1, 2) @ partials)
    covariance[found] = np.linalg.inv(normal[found])
    covariance = axes @ covariance @ axes.swapaxes(1, 2)
    rows = np.zeros((points.rays, 2, 3))
    rows[rays] = partials
    if scaled and sigma0 is not None and freedom >= LEAST_REDUNDANCY:
        unit = sigma0**2 * freedom / (freedom - 2)
        covariance *= np.where(contradicting, squares / np.maximum(freedoms, 1), unit)[:, None, None]
    # Along a ray the image does not change: it is across both rows of the partials.
    directions = np.where(found[points.point, None], np.cross(rows[:, 0], rows[:, 1]), np.nan)
    one, _, angles = ray_angles(points.point, directions)
    angles_deg = largest_angles(points, one, angles)
    return Intersection(points, places.geodetic, covariance, residuals, angles_deg, sigma0, contradicting)


def _contradicting(squares: Array, freedoms: Index) -> np.ndarray:
    """Return which points have sums of squares ``(N,)`` that are too large, by those of all others.

    Suspects are beyond five robust sigmas. The smallest is tested first, and counts from then on if it passes.
    """
    tested = freedoms > 0
    out = np.zeros(len(squares), dtype=bool)
    if freedoms.sum() <= LEAST_REDUNDANCY:
        return out
    size = np.maximum(freedoms, 1)
    medians = size * (1 - 2 / (9 * size)) ** 3  # of chi-squared, by Wilson and Hilferty
    typical = max(float(np.median((squares / medians)[tested])), _ROUNDING)
    out[tested] = (squares / size)[tested] > _SUSPECT**2 * typical
    for number in sorted(np.flatnonzero(out).tolist(), key=lambda k: squares[k] / size[k]):
        others = float(freedoms[~out].sum())
        unit = max(float(squares[~out & tested].sum()) / others, _ROUNDING)
        if chance_of(squares[number] / unit, freedoms[number], others) < BLUNDER_RISK / tested.sum():
            break
        out[number] = False
    return out


def models_of(models: Mapping[str, SensorModel], points: BlockPoints) -> tuple[SensorModel, ...]:
    """Return the models in the order of the images of the points.

    Raises
    ------
    InputError
        If an image has no model, or a model no image.
    """
    refuse_other_points(points, BlockPoints, "read_block_points")
    for model in models.values():
        refuse_other_model(model)
    for here, there, what in (
        (points.images, models, "there is no model of the image"),
        (models, points.images, "there are no points of the image"),
    ):
        missing = sorted(set(here) - set(there))
        if missing:
            raise InputError(
                f"{what} {missing[0]!r}",
                file=points.source or None,
                field="image",
                remedy=f"images of the points: {', '.join(points.images)}; models: {', '.join(models)}",
            )
    return tuple(models[name] for name in points.images)


def frame_of(models: Sequence[SensorModel], points: BlockPoints) -> GroundFrame:
    """Return the frame in the middle of the control points, or of the images' domains if there are none."""
    known = points.known_in(GEODETIC)[points.control]
    if np.isfinite(known).all(axis=1).any():
        return GroundFrame.about(known)
    centres = [ground_transform(model.crs, GEODETIC)(model.domain[0][None]) for model in models]
    return GroundFrame.about(np.concatenate(centres))


def predict(frame: GroundFrame, models: Sequence[SensorModel], points: BlockPoints, local: Array) -> Array:
    """Return the image points ``(M, 2)`` at which points ``(N, 3)`` of the frame are seen by their rays' images."""
    places = frame.places(local)
    predicted = np.full((points.rays, 2), np.nan)
    for model, rays in zip(models, points.rays_of_images, strict=True):
        if len(rays):
            predicted[rays] = places.project(model, points.point[rays])
    return predicted


def meet(frame: GroundFrame, models: Sequence[SensorModel], points: BlockPoints, used: np.ndarray) -> Array:
    """Return the points ``(N, 3)`` of the frame that the rays in the mask `used` ``(M,)`` meet in; NaN where none.

    Gauss-Newton for each point by itself, with steps halved where they do not descend, from where the rays pass the
    reference heights of their models.
    """
    local = _first(frame, models, points, used)
    used = used & np.asarray(np.isfinite(local).all(axis=1))[points.point]
    counts = np.bincount(points.point[used], minlength=len(points))
    found = np.full_like(local, np.nan)
    moving = np.flatnonzero(counts >= 2)
    # Of the points that move: where they were last better, how long a part of the last step they go, and that step.
    before, factor, shift = local[moving], np.ones(len(moving)), np.zeros((len(moving), 3))
    squares = np.full(len(moving), np.inf)
    for _ in range(_STEPS):
        if not len(moving):
            break
        _, of, misfit, rows = _equations(frame, models, points, used, local, moving)
        now = _per_point(len(moving), of, (misfit**2).sum(axis=1))
        with np.errstate(invalid="ignore"):
            better = now <= squares * (1 + 1e-9) + 1e-14
        factor[~better] /= 2
        squares[better], before[better], factor[better] = now[better], local[moving[better]], 1.0
        normal = _per_point(len(moving), of, np.einsum("kic,kid->kcd", rows, rows))[better]
        right = _per_point(len(moving), of, np.einsum("kic,ki->kc", rows, misfit))[better]
        step, parallel = _solved(normal, right)
        shift[better] = step
        lost = np.zeros(len(moving), dtype=bool)
        lost[better] = parallel
        local[moving] = before + factor[:, None] * shift
        ended = lost | ~((np.linalg.norm(shift, axis=1) * factor > 1e-7) & (factor > 1e-4))
        # Steps that end because a model does not project there end at its border, where the rays do not meet.
        met = ended & ~lost & np.isfinite(squares) & np.isfinite(now)
        found[moving[met]] = local[moving[met]]
        moving, before, factor, shift, squares = (part[~ended] for part in (moving, before, factor, shift, squares))
    found[moving] = np.where(np.isfinite(squares)[:, None], local[moving], np.nan)
    unseen = used & ~np.isfinite(predict(frame, models, points, found)).all(axis=1)
    found[points.point[unseen]] = np.nan
    return found


def _solved(normal: Array, right: Array) -> tuple[Array, np.ndarray]:
    """Return steps ``(n, 3)``, none longer than is sensible, and which of the points their rays leave open."""
    if not len(normal):
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    finite = np.asarray(np.isfinite(normal).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], normal, np.eye(3)))
    left_open = ~finite | ~(values[:, 0] * PARALLEL**2 > values[:, 2])
    turned = (vectors.swapaxes(1, 2) @ right[:, :, None])[:, :, 0]
    turned = np.where(left_open[:, None], 0.0, turned)
    step = (vectors @ (turned / np.where(left_open[:, None], 1.0, values))[:, :, None])[:, :, 0]
    length = np.maximum(np.linalg.norm(step, axis=1), _LONGEST)
    return step * (_LONGEST / length)[:, None], left_open


def _first(frame: GroundFrame, models: Sequence[SensorModel], points: BlockPoints, used: np.ndarray) -> Array:
    """Return the mean of where the rays of each point pass the reference heights of their models."""
    total, count = np.zeros((len(points), 3)), np.zeros(len(points))
    for model, rays_of in zip(models, points.rays_of_images, strict=True):
        rays = rays_of[used[rays_of]]
        if not len(rays):
            continue
        ground = model.image_to_ground(points.measured[rays], model.reference_height)
        local = frame.of_geodetic(ground_transform(model.crs, GEODETIC)(ground))
        good = np.isfinite(local).all(axis=1)
        total[points.point[rays[good]]] += local[good]  # an image has at most one ray of a point
        count[points.point[rays[good]]] += 1
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / count[:, None]


def _equations(
    frame: GroundFrame,
    models: Sequence[SensorModel],
    points: BlockPoints,
    used: np.ndarray,
    local: Array,
    numbers: Index,
) -> tuple[Index, Index, Array, Array]:
    """Return the equations of points `numbers` ``(n,)``, of the rays in the mask `used` alone.

    These are the rays ``(k,)``, places of their points among the n, misfits ``(k, 2)`` over sigma, and partials by the
    points ``(k, 2, 3)``.
    """
    place = np.full(len(points), -1)
    place[numbers] = np.arange(len(numbers))
    wanted = used & (place[points.point] >= 0)
    parts = [rays_of[wanted[rays_of]] for rays_of in points.rays_of_images]
    rays, ends = np.concatenate([np.zeros(0, dtype=np.int64), *parts]), np.cumsum([0, *map(len, parts)])
    of_images = [np.arange(begin, end) for begin, end in itertools.pairwise(ends.tolist())]
    of, scale = place[points.point[rays]], 1.0 / points.sigma_image[rays]
    seen = linearised(frame.places(local[numbers]), models, of_images, of, scale, 0)
    misfits = points.whitened((points.measured[rays] - seen.image) * scale[:, None], rays)
    return rays, of, misfits, points.whitened(seen.by_point, rays)


def _per_point(count: int, of: Index, values: Array) -> Array:
    """Return the sums ``(count, ...)`` of values ``(k, ...)`` over the rays `of` each point."""
    total = np.zeros((count, *values.shape[1:]))
    for place in np.ndindex(values.shape[1:]):
        total[:, *place] = np.bincount(of, weights=values[:, *place], minlength=count)
    return total


def ray_angles(point: Index, directions: Array) -> tuple[Index, Index, Array]:
    """Return the pairs of rays that belong to one of points ``(M,)``, and the angles (degrees) between them.

    Directions ``(M, 3)`` are of any length; rays without one (NaN) are left out. Up or down is the same ray.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        units = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rays = np.flatnonzero(np.isfinite(units).all(axis=1))
    order = rays[np.argsort(point[rays], kind="stable")]
    pairs = [np.zeros((0, 2), np.int64)]
    for apart in range(1, len(order)):
        same = point[order[apart:]] == point[order[:-apart]]
        if not same.any():
            break
        pairs.append(np.column_stack([order[:-apart][same], order[apart:][same]]))
    one, other = np.concatenate(pairs).T
    cosines = np.abs((units[one] * units[other]).sum(axis=1))
    return one, other, np.degrees(np.arccos(np.clip(cosines, 0.0, 1.0)))


def largest_angles(points: BlockPoints, one: Index, angles: Array) -> Array:
    """Return the largest of the angles of pairs of rays, whose first is `one`, of each point ``(N,)``; else NaN."""
    largest = np.full(len(points), np.nan)
    np.fmax.at(largest, points.point[one], angles)
    return largest
