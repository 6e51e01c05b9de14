r"""The DEM under the points of a block: its heights and slopes there, and planes of them as observations.

A slope of the DEM has errors, too. They are independent of the error of the height in the middle, but they look like
information: on flat ground with rough errors, slopes alone would locate the block. The expected true slope, given the
slope of the DEM, is

.. math:: E[s] = \bar s + (S - N) S^{-1} (\hat s - \bar s)

with the covariance :math:`S` of the slopes of the DEM about their mean :math:`\bar s`, and :math:`N` that of their
errors. Estimates with expected slopes have the accuracy that they claim. Means are those of the points of one image,
because a model can follow a tilt of the ground below it.

Source: Fuller 1987, section 1.2 (reliability ratio); Carroll et al. 2006, chapter 4 (regression calibration).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.points import Index
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array

#: Slopes are read again where a point has moved by more than this part of the spacing of their heights.
_MOVED = 0.25
#: Part of the points beyond which level ground is no water.
_MOST = 0.5


@dataclass(frozen=True, eq=False)
class LocalTerrain:
    """The DEM under N points.

    Parameters
    ----------
    ground : ndarray (N, 3)
        Lon, lat, h of the points.
    heights : ndarray (N,)
        Of the DEM there, m; NaN in voids and of points without heights.
    measured, read : ndarray (N, 2)
        Slopes of the DEM to the east and north, NaN next to voids, too; and lon, lat where they were read.
    slopes : ndarray (N, 2)
        Expected true slopes.
    level, water : ndarray (N,) of bool
        Points with equal heights of the DEM on one side, and those of them that are on water or next to it. These have
        no expected slope, and so take no height.
    spacing : float
        How far the heights for a slope are apart, m.
    """

    ground: Array
    heights: Array
    measured: Array
    read: Array
    slopes: Array
    level: Mask
    water: Mask
    spacing: float

    @classmethod
    def under(
        cls,
        source: DemHeights,
        ground: Array,
        of: Mask,
        sigmas: Array,
        images: Index,
        before: LocalTerrain | None = None,
    ) -> LocalTerrain:
        """Return it under points.

        Parameters
        ----------
        ground : ndarray (N, 3)
            Lon, lat, h.
        of : ndarray (N,) of bool
            Points that take a height.
        sigmas : ndarray (N,)
            Standard deviations of the heights, m.
        images : ndarray (N,)
            An image that shows each point.
        before : LocalTerrain, optional
            Its slopes stay where points have hardly moved.
        """
        count, spacing = len(ground), source.spacing(sigmas[of])
        rows = np.flatnonzero(of & np.isfinite(ground[:, :2]).all(axis=1))
        heights, slopes, read = np.full(count, np.nan), np.full((count, 2), np.nan), np.full((count, 2), np.nan)
        level = np.zeros(count, dtype=bool)
        heights[rows] = source.heights(ground[rows])
        anew = rows
        if before is not None and before.spacing == spacing:
            far = _MOVED * spacing / metres_per_degree(np.nan_to_num(ground[rows]))
            with np.errstate(invalid="ignore"):
                same = rows[(np.abs(ground[rows, :2] - before.read[rows]) <= far).all(axis=1)]
            slopes[same], read[same], level[same] = before.measured[same], before.read[same], before.level[same]
            anew = rows[np.isnan(read[rows, 0])]
        slopes[anew], level[anew] = source.slopes(ground[anew], spacing)
        read[anew] = ground[anew, :2]
        # If most are level, it is the ground that is.
        water: Mask = level & (level.sum() < _MOST * len(rows))
        ashore = np.where(water[:, None], np.nan, slopes)
        expected = expected_slopes(ashore, sigmas, source.slope_variance(spacing), images)
        return cls(ground, heights, slopes, read, expected, level, water, spacing)

    def planes(self, problem: BlockProblem, of: Mask, sigmas: Array, offset: Array) -> Planes:
        """Return the planes under points `of` a mask ``(N,)``.

        Parameters
        ----------
        sigmas : ndarray (N,)
            Standard deviations of the heights, metres upwards.
        offset : ndarray (N,)
            Estimates of their errors.
        """
        frame, count = problem.frame, len(self.ground)
        rows = np.flatnonzero(of & np.isfinite(self.heights) & np.isfinite(self.slopes).all(axis=1) & (sigmas < np.inf))
        slopes, plan = self.slopes[rows], problem.placed[rows]
        # The height of a point that is known in plan is read there, with the error that its sigma in plan makes.
        own = sigmas[rows] ** 2
        in_plan = np.where(plan, problem.ground_sigmas[rows, 0], 0.0)
        own = own + (slopes**2).sum(axis=1) * in_plan**2
        tilted = np.where(plan[:, None], 0.0, slopes)
        length = np.sqrt(1.0 + (tilted**2).sum(axis=1))
        normal = np.column_stack([-tilted, np.ones(len(rows))]) / length[:, None]
        east = np.column_stack([np.ones(len(rows)), np.zeros(len(rows)), tilted[:, 0]])
        east /= np.linalg.norm(east, axis=1)[:, None]
        axes = np.stack([east, np.cross(normal, east), normal], axis=1)
        on_dem = np.column_stack([self.ground[rows, :2], self.heights[rows] - offset[rows]])
        places, turns, found = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan), np.full(count, np.inf)
        places[rows], turns[rows] = frame.of_geodetic(on_dem), axes @ frame.enu_at(on_dem)
        found[rows] = np.sqrt(own) / length
        return Planes(places, turns, found)


def expected_slopes(slopes: Array, sigmas: Array, variance: float, images: Index) -> Array:
    """Return the expected true slopes ``(N, 2)`` of slopes of a DEM ``(N, 2)``, NaN where these are.

    Parameters
    ----------
    sigmas : ndarray (N,)
        Standard deviations of the heights, m.
    variance : float
        Variance of the slope's error over that of a height (`DemHeights.slope_variance`).
    images : ndarray (N,)
        An image that shows each point.
    """
    rows = np.flatnonzero(np.isfinite(slopes).all(axis=1) & (sigmas > 0))
    if not len(rows):
        return slopes
    weights, of = sigmas[rows] ** -2.0, images[rows]
    sums = np.bincount(of, weights)
    seen = sums > 0
    totals = np.stack([np.bincount(of, weights * slope) for slope in slopes[rows].T], axis=1)
    means = totals / np.where(seen, sums, 1.0)[:, None]
    apart = slopes[rows] - means[of]
    covariance = (apart * weights[:, None]).T @ apart
    values, axes = np.linalg.eigh(covariance)
    errors = variance * (len(rows) - int(seen.sum()))
    reliable = np.maximum(1.0 - errors / np.maximum(values, np.finfo(float).tiny), 0.0)
    found = slopes.copy()
    found[rows] = means[of] + apart @ ((axes * reliable) @ axes.T)
    return found
