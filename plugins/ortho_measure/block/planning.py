r"""Planning a block: the best place for the next point of all images together, and its gain.

The method is that for one image (`ortho_measure.planning`), with the rows of all images that show a place. The ground
of a control point is known with a covariance :math:`\Sigma`: predictions have the covariance :math:`A C A^T`, and are
measured with :math:`R = s^2 I + B \Sigma B^T`. The ground of a tie is unknown and is eliminated from the rows; the rest
is the predicted distance of the rays from each other.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ortho_measure.marks import GROUND_CRS
from ortho_measure.places import SceneGeometry
from ortho_measure.planning import ALIKE, OFFERED, Next, PlanningGrid, apart
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.local_frame import GroundFrame
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.imaging.matching import OtherScene, Target
from ortho_pipeline.imaging.matching.chip_search import SIDE
from ortho_pipeline.imaging.matching.targets import metres_per_pixel, shown_by
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points import DEFAULT_SIGMA_IMAGE

#: Approximate number of places in all images together.
_PLACES = 288


@dataclass(frozen=True, eq=False)
class BlockGrid:
    """Candidate places that at least two images show, and a regular grid over the block.

    Parameters
    ----------
    number : (n,) of int
        The image in which the place was chosen.
    image : (n, 2)
        Position of the place in it, px.
    ground, everywhere : (n, 3), (m, 3)
        Their ground, and that of a regular grid in all images, as `GROUND_CRS`.
    seen, seen_everywhere : (n, K), (m, K) of bool
        Which of the K images show it.
    reach : float
        Positions closer than this (m) are the same place.
    """

    number: NDArray[np.int_]
    image: Array
    ground: Array
    everywhere: Array
    seen: NDArray[np.bool_]
    seen_everywhere: NDArray[np.bool_]
    reach: float

    @classmethod
    def over(cls, images: Sequence[SceneGeometry], references: Sequence[Target]) -> BlockGrid:
        """Return the places of a block; with references, only places that they show."""
        side = int(np.clip(np.sqrt(_PLACES / len(images)), 3, 12))
        scenes = [OtherScene(one.view.intensity, one.model) for one in images]
        parts: list[tuple[Array, Array, Array]] = []
        for number, one in enumerate(images):
            others = (*scenes[:number], *scenes[number + 1 :])
            image, ground, everywhere = np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3))
            # Images with very different resolutions have no candidates; they can be measured by hand.
            with contextlib.suppress(InputError):
                grid = PlanningGrid.over(replace(one, references=others), side)
                to_ground = ground_transform(one.model.crs, GROUND_CRS)
                image, ground, everywhere = grid.image, to_ground(grid.ground), to_ground(grid.everywhere)
            fresh, fresh_there = (~shown_by(scenes[:number], part, GROUND_CRS) for part in (ground, everywhere))
            if references:
                fresh &= shown_by(references, ground, GROUND_CRS)
            parts.append(
                (np.column_stack([np.full(fresh.sum(), number), image[fresh]]), ground[fresh], everywhere[fresh_there])
            )
        chosen, ground, everywhere = (np.concatenate(part) for part in zip(*parts, strict=True))
        seen, there = (_seen(scenes, part) for part in (ground, everywhere))
        reach = SIDE / 2 * metres_per_pixel(images[0].view)
        return cls(chosen[:, 0].astype(int), chosen[:, 1:], ground, everywhere, seen, there, reach)

    def without(self, taken: Array) -> BlockGrid:
        """Return the places without a point; `taken` ``(k, 3)`` is the ground of the points."""
        here, points = self.plan(self.ground), self.plan(taken)
        points = points[np.isfinite(points).all(axis=1)]
        kept = ~(np.abs(here[:, None] - points).max(axis=2) < self.reach).any(axis=1)
        return replace(
            self, number=self.number[kept], image=self.image[kept], ground=self.ground[kept], seen=self.seen[kept]
        )

    def plan(self, ground: Array) -> Array:
        """Return ground ``(k, 3)`` as metres east and north of the middle of the block."""
        if not len(self.everywhere):
            return np.zeros((len(ground), 2))
        return GroundFrame.about(self.everywhere).of_geodetic(ground)[:, :2]


def _seen(scenes: Sequence[OtherScene], ground: Array) -> NDArray[np.bool_]:
    return np.column_stack([shown_by([one], ground, GROUND_CRS) for one in scenes])


def next_of_block(grid: BlockGrid, fit: BlockFit | None, taken: Array, *, tie: bool) -> list[Next]:
    """Return the best places for the next point, the best first; without a fit, those farthest from all points.

    Parameters
    ----------
    taken : (k, 3)
        Ground of the existing points, as `GROUND_CRS`.
    tie : bool
        Whether the next point is a tie or has known ground.
    """
    left = grid.without(taken)
    places, points = left.plan(left.ground), left.plan(taken)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(left.number):
        return []
    if fit is None or not fit.parameters:
        return [_next(left, k) for k in apart(places, points)]
    rows = _Rows(fit, left.ground, left.seen, tie)
    everywhere = _Rows(fit, grid.everywhere, grid.seen_everywhere, tie)
    sigmas, largest = rows.sigmas(fit.covariance), everywhere.largest(fit.covariance)
    free = np.flatnonzero(np.isfinite(sigmas))
    offers: list[Next] = []
    while len(free) and len(offers) < OFFERED:
        alike = free[sigmas[free] ** 2 >= (1 - ALIKE) * sigmas[free].max() ** 2]
        best = int(alike[apart(places[alike], points, 1)[0]])
        then = everywhere.largest(rows.after(fit.covariance, best))
        offer = replace(_next(left, best), sigma=float(sigmas[best]), largest=largest, then=then)
        offers.append(replace(offer, role="tie" if tie else "control"))
        points, free = np.concatenate([points, places[[best]]]), free[free != best]
    return offers


def _next(grid: BlockGrid, k: int) -> Next:
    column, row = grid.image[k].tolist()
    return Next((column, row), number=int(grid.number[k]), height=float(grid.ground[k, 2]))


@dataclass(frozen=True, eq=False)
class _Batch:
    """Rows of the places `of` ``(n,)`` that the same images show, by the parameters in some `columns` ``(p,)``.

    `missing` ``(n, m, p)`` are the partials of predictions in px, `weighed` the same rows in units of a measurement;
    `rays` is the number of images.
    """

    of: NDArray[np.int_]
    columns: NDArray[np.int_]
    missing: Array
    weighed: Array
    rays: int

    def sigmas(self, covariance: Array) -> Array:
        """Return the standard deviation of predictions ``(n,)``, px, as root mean square over the images."""
        own = covariance[np.ix_(self.columns, self.columns)]
        square = ((self.missing @ own) * self.missing).sum(axis=(1, 2))
        return np.asarray(np.sqrt(np.maximum(square, 0.0) / self.rays))


class _Rows:
    """Rows of all places, in batches."""

    def __init__(self, fit: BlockFit, ground: Array, seen: NDArray[np.bool_], tie: bool) -> None:
        self.count = len(ground)
        used = fit.points.sigma_image[fit.used_rays]
        self._pixel = (float(np.median(used)) if len(used) else DEFAULT_SIGMA_IMAGE) * fit.variances.image
        self._spread = _ground_sigmas(fit) ** 2
        models = [fit.models[label] for label in fit.points.images]
        ends = np.cumsum([len(model.params) for model in models])
        self.batches = []
        for pattern in np.unique(seen, axis=0):
            images = np.flatnonzero(pattern)
            # A single ray to unknown ground has no information.
            if len(images) < (2 if tie else 1):
                continue
            of = np.flatnonzero((seen == pattern).all(axis=1))
            columns = np.concatenate([np.arange(ends[k] - len(models[k].params), ends[k]) for k in images])
            self.batches.append(self._batch([models[k] for k in images], ground, of, columns, tie))

    def _batch(
        self, models: Sequence[SensorModel], ground: Array, of: NDArray[np.int_], columns: NDArray[np.int_], tie: bool
    ) -> _Batch:
        frame = GroundFrame.about(ground)
        places, everything = frame.places(frame.of_geodetic(ground[of])), np.arange(len(of))
        by_params, by_ground = np.zeros((len(of), 2 * len(models), len(columns))), []
        begin = 0
        for k, model in enumerate(models):
            _, of_ground, of_params = places.linearised(model, everything)
            by_params[:, 2 * k : 2 * k + 2, begin : begin + of_params.shape[2]] = of_params
            by_ground.append(of_ground)
            begin += of_params.shape[2]
        by_place = np.concatenate(by_ground, axis=1)
        if tie:
            across = np.linalg.qr(by_place, mode="complete")[0][:, :, 3:]
            missing = across.swapaxes(1, 2) @ by_params
            return _Batch(of, columns, missing, missing / self._pixel, len(models))
        errors = np.eye(2 * len(models)) * self._pixel**2 + (by_place * self._spread) @ by_place.swapaxes(1, 2)
        return _Batch(of, columns, by_params, np.linalg.solve(np.linalg.cholesky(errors), by_params), len(models))

    def sigmas(self, covariance: Array) -> Array:
        """Return the standard deviation of predictions at each place ``(n,)``, px; NaN without a possible point."""
        found = np.full(self.count, np.nan)
        for one in self.batches:
            found[one.of] = one.sigmas(covariance)
        return found

    def largest(self, covariance: Array) -> float:
        """Return the standard deviation at the worst place."""
        return max((float(batch.sigmas(covariance).max()) for batch in self.batches), default=0.0)

    def after(self, covariance: Array, place: int) -> Array:
        """Return the covariance of the parameters after a measurement at a place."""
        for batch in self.batches:
            for row in np.flatnonzero(batch.of == place):
                design = batch.weighed[row]
                there = design @ covariance[batch.columns]
                own = there[:, batch.columns] @ design.T
                return np.asarray(covariance - there.T @ np.linalg.solve(own + np.eye(len(own)), there))
        return covariance


def _ground_sigmas(fit: BlockFit) -> Array:
    """Return the expected standard deviations ``(3,)`` (m) of the ground of the next control point."""
    control = fit.points.sigma_ground[fit.used_ground]
    sigmas = np.array([fit.variances.sigma_xy or 0.0, fit.variances.sigma_xy or 0.0, fit.variances.sigma_h or 0.0])
    for axis in range(3):
        stated = control[control[:, axis] > 0, axis]
        sigmas[axis] = np.median(stated) if len(stated) else sigmas[axis]
    return sigmas
