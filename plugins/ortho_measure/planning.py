"""Planning: the best place for the next point, and the gain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_measure.places import SceneGeometry
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.imaging.matching.candidates import candidates
from ortho_pipeline.imaging.matching.chip_search import SIDE
from ortho_pipeline.imaging.matching.targets import chip_factor, shown_by
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import DEFAULT_SIGMA_IMAGE
from ortho_pipeline.surface.rays import meet_surface

#: Grid positions per side at which the uncertainty is computed.
_SIDE = 12
#: Uncertainties within this part of the largest count as equal; then the place farthest from all points is best.
ALIKE = 0.1
#: Number of offered places, the best first.
OFFERED = 6


@dataclass(frozen=True, eq=False)
class PlanningGrid:
    """Candidate places of a scene with a reference, and a regular grid over the scene.

    Parameters
    ----------
    image, ground : (n, 2), (n, 3)
        The place with the most structure in each cell of the scene, px, and its ground in the CRS of the model.
    everywhere : (m, 3)
        Ground of a regular grid for the uncertainty.
    """

    image: Array
    ground: Array
    everywhere: Array

    @classmethod
    def over(cls, places: SceneGeometry, side: int = _SIDE) -> PlanningGrid:
        """Return one place in each of `side` x `side` cells of a scene."""
        width, height = places.view.size
        steps = (np.arange(side) + 0.5) / side
        columns, rows = np.meshgrid(steps * width, steps * height)
        regular, ground = _shown(places, np.column_stack([columns.ravel(), rows.ravel()]))
        if not len(regular):
            return cls(regular, ground, ground)
        cells = np.zeros((side, side), dtype=bool)
        cells[tuple((regular / (width, height) * side).astype(int).T[::-1])] = True
        factor = chip_factor(places.view, places.references, regular)
        origins, _ = candidates(places.view, (0, 0, width, height), (side, side), SIDE, factor, cells)
        image, on_ground = _shown(places, np.asarray(origins + SIDE * factor / 2, dtype=np.float64))
        return cls(image, on_ground, ground) if len(image) else cls(regular, ground, ground)

    def without(self, taken: Array) -> PlanningGrid:
        """Return the places at which there is no point: a second one of the same pixels tells nothing new."""
        near = (np.abs(self.image[:, None] - taken).max(axis=2) < SIDE / 2).any(axis=1)
        return PlanningGrid(self.image[~near], self.ground[~near], self.everywhere)


def _shown(places: SceneGeometry, image: Array) -> tuple[Array, Array]:
    """Return the image points whose ground a reference shows, and this ground."""
    ground = meet_surface(places.model, image, places.surface)
    good = np.flatnonzero(np.isfinite(ground).all(axis=1))
    good = good[shown_by(places.references, ground[good], places.model.crs)]
    return np.asarray(image[good], dtype=np.float64), ground[good]


@dataclass(frozen=True)
class Next:
    """A place to measure: column and row (px) of image `number`, and the uncertainty before and after a measurement.

    `height` (m) is that of the surface there, by the delivered model. `sigma` (px) is the standard deviation (both axes
    together) of the prediction at this place, `largest` that at the worst place of the scene, and `then` the same after
    a measurement of this `role` here; None without a fit.
    """

    image: tuple[float, float]
    sigma: float | None = None
    largest: float | None = None
    then: float | None = None
    number: int = 0
    height: float = math.nan
    role: str = "control"


def measure_next(grid: PlanningGrid, fit: Fit | None, taken: Array) -> list[Next]:
    """Return the places with the most uncertain prediction, the best first; none without data of references.

    Parameters
    ----------
    taken : (k, 2)
        Existing image points.

    Notes
    -----
    A measurement of variance s^2 makes C into ``C - C J^T (J C J^T + s^2 I)^-1 J C``.
    Source: sequential least squares (Koch 1999, section 3.2.8).
    """
    grid = grid.without(taken)
    if fit is None or not len(fit.param_names):
        return [Next(_pair(grid.image[k]), height=float(grid.ground[k, 2])) for k in apart(grid.image, taken)]
    partials, everywhere = fit.model.param_partials(grid.ground), fit.model.param_partials(grid.everywhere)
    variance = _variances(partials, fit.covariance)
    sigma = float(np.median(fit.points.sigma_image[fit.used])) if fit.used.any() else DEFAULT_SIGMA_IMAGE
    noise = np.eye(2) * (sigma * (1.0 if fit.sigma0 is None else fit.sigma0)) ** 2
    largest = _root(_variances(everywhere, fit.covariance).max(initial=0.0))
    left = np.arange(len(grid.image))
    places: list[Next] = []
    while len(left) and len(places) < OFFERED:
        alike = left[variance[left] >= (1 - ALIKE) * variance[left].max()]
        best = int(alike[apart(grid.image[alike], taken, 1)[0]])
        there = partials[best] @ fit.covariance
        gain = there.T @ np.linalg.solve(there @ partials[best].T + noise, there)
        then = _root(_variances(everywhere, fit.covariance - gain).max(initial=0.0))
        height = float(grid.ground[best, 2])
        places.append(Next(_pair(grid.image[best]), _root(variance[best]), largest, then, height=height))
        taken, left = np.concatenate([taken, grid.image[[best]]]), left[left != best]
    return places


def _variances(partials: Array, covariance: Array) -> Array:
    """Return the variance ``(n,)`` px^2 (both axes together) of predictions with partials ``(n, 2, P)``."""
    return np.einsum("nip,pq,niq->n", partials, covariance, partials)


def _root(variance: float) -> float:
    return float(np.sqrt(max(float(variance), 0.0)))


def apart(image: Array, taken: Array, count: int = OFFERED) -> NDArray[np.int_]:
    """Return some image points, each farthest from all taken and chosen ones; the middle first if none is taken."""
    chosen: list[int] = []
    distance = np.full(len(image), np.inf)
    if len(taken):
        distance = ((image[:, None] - taken) ** 2).sum(axis=2).min(axis=1)
    while len(chosen) < min(count, len(image)):
        if not len(taken) and not chosen:
            middle = (image.min(axis=0) + image.max(axis=0)) / 2
            chosen.append(int(np.argmin(((image - middle) ** 2).sum(axis=1))))
        else:
            chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((image - image[chosen[-1]]) ** 2).sum(axis=1))
    return np.array(chosen, dtype=int)


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
