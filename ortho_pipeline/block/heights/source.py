"""Heights of a DEM under the points of a block, each as a plane near its point, with a sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem, State
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.intersection import predict
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points.heights.spot_heights import SpotHeights
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface

#: Sigma (m) of a DEM without a stated accuracy; matching assumes the same.
DEFAULT_SIGMA = 10.0
#: Times that a ray is followed to the height of the DEM below it: terrain is less steep than the ray.
_FOLLOWED = 6
#: The option of each number that describes a DEM.
_OPTIONS = {"bias": "dem_bias", "correlation": "dem_correlation", "shift": "dem_shift_sigma"}
#: Slopes are taken over so many sigmas of the heights to each side, from one to so many samples.
_SLOPE, _WIDEST = 8.0, 3.0
#: Interpolated errors are alike over so many samples (an integral of their correlation).
_SHARED = 2.25
_AROUND = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])


@dataclass(frozen=True, eq=False)
class DemHeights:
    """A DEM whose heights are observations; the DEM itself has their sigma (`Surface.with_sigma`).

    Parameters
    ----------
    surface : DemSurface
    bias : float, optional
        Standard deviation (m) of an error that all heights share; by default that of a single height.
    shift : float, optional
        Standard deviation (m) of the position of the DEM, east and north; by default half a sample.
    correlation : float, optional
        Distance (m) over which errors are correlated, by exp(-d / correlation). By default each sample of the DEM has
        its own error, besides the bias.
    spots : SpotHeights, optional
        Known heights, which tell of the errors that heights share.
    follow : bool
        Read the DEM where the estimate of its shift puts it. By default its slope at each tie stands for that.
    """

    surface: DemSurface
    bias: float | None = None
    correlation: float | None = None
    shift: float | None = None
    spots: SpotHeights | None = None
    follow: bool = False

    def __post_init__(self) -> None:
        for name in ("bias", "correlation", "shift"):
            value = getattr(self, name)
            if value is not None and not (0 <= value < np.inf and (name != "correlation" or value > 0)):
                raise InputError(
                    f"{value} is no {name} of heights", field=f"points.{_OPTIONS[name]}", remedy="give metres"
                )
        object.__setattr__(self, "surface", self.surface.with_fill("mask"))

    @classmethod
    def of(cls, heights: DemHeights | Surface) -> DemHeights:
        """Return heights of a DEM; the flat ground of one stated height is no observation."""
        if isinstance(heights, DemHeights):
            return heights
        if isinstance(heights, DemSurface):
            return cls(heights)
        raise InputError("flat ground is no observation of heights", field="heights", remedy="give a DEM")

    def at(self, ground: Array, sigmas: Array) -> tuple[Array, Array]:
        """Return heights ``(n,)`` at lon, lat ``(n, 2+)``, and the slope ``(n, 2)`` to the east and to the north.

        Over so much ground that errors of `sigmas` ``(n,)`` do not look like slopes; NaN beside a void.
        """
        side = self.surface.sample_size
        step = np.clip(_SLOPE * np.nan_to_num(sigmas), side, _WIDEST * side)
        found = self._around(ground, step)
        return found[0], np.stack([found[1] - found[2], found[3] - found[4]], axis=1) / (2.0 * step[:, None])

    def _around(self, ground: Array, metres: Array) -> Array:
        """Return heights ``(5, n)``: at places, and so many metres ``(n,)`` to the east, west, north and south."""
        lonlat = ground[:, :2]
        step = metres[:, None] / metres_per_degree(np.column_stack([lonlat, np.zeros(len(lonlat))]))
        places = lonlat + _AROUND[:, None] * step
        return self.surface.heights(places.reshape(-1, 2), GEODETIC).reshape(5, -1)

    def breaks(self, ground: Array, slopes: Array, metres: Array) -> Array:
        """Return how far ``(n,)`` heights so many `metres` around places are from their planes: at a cliff, far."""
        found = self._around(ground, metres)
        east, north = (slopes * metres[:, None]).T
        planes = found[0] + np.stack([east, -east, north, -north])
        return np.asarray(np.abs(found[1:] - planes).max(axis=0))

    def sigmas(self, ground: Array) -> Array | None:
        """Return the stated sigma ``(n,)`` of the heights at lon, lat; None if none is stated."""
        sigma = self.surface.sigma
        if isinstance(sigma, Surface):
            return sigma.heights(ground[:, :2], GEODETIC)
        return None if sigma is None else np.full(len(ground), float(sigma))

    def sharing(self, ground: Array) -> Array:
        """Return how many of the places, lon, lat ``(n, 2+)``, share the information of each ``(n,)``.

        Those between the same four samples, and those that share one or two of these.
        """
        places = np.column_stack([ground[:, :2], np.zeros(len(ground))])
        samples = np.floor(np.nan_to_num(self.surface.sampler(GEODETIC)(places))).astype(np.int64)
        _, which, counts = np.unique(samples, axis=0, return_inverse=True, return_counts=True)
        return np.asarray(1.0 + _SHARED * (counts[which.ravel()] - 1.0))


def starts(source: DemHeights, problem: BlockProblem, models: Sequence[SensorModel], rays: Mask, of: Mask) -> Array:
    """Return where points `of` a mask ``(N,)`` lie ``(N, 3)``: in the middle of where their rays meet the DEM.

    Nearly parallel rays of models that are a few pixels off meet anywhere; the DEM is right to a few metres.
    """
    points, frame = problem.points, problem.frame
    sums, counts = np.zeros((len(points), 3)), np.zeros(len(points))
    for model, rays_of in zip(models, points.rays_of_images, strict=True):
        used = rays_of[rays[rays_of] & of[points.point[rays_of]]]
        if not len(used):
            continue
        heights = np.full(len(used), model.reference_height)
        to_geodetic = ground_transform(model.crs, GEODETIC)
        for _ in range(_FOLLOWED):
            ground = to_geodetic(model.image_to_ground(points.measured[used], heights))
            below = source.surface.heights(ground[:, :2], GEODETIC)
            heights = np.where(np.isfinite(below), below, heights)
        good = np.isfinite(below) & np.isfinite(ground).all(axis=1)
        local = frame.of_geodetic(np.column_stack([ground[good, :2], heights[good]]))
        np.add.at(sums, points.point[used[good]], local)
        np.add.at(counts, points.point[used[good]], 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(sums / counts[:, None])


def started(source: DemHeights, problem: BlockProblem, state: State, rays: Mask) -> Array:
    """Return the places ``(N, 3)`` of a state with points on the DEM, as far as all their rays see them there."""
    found = starts(source, problem, state.models, rays, problem.points.tie & ~problem.placed)
    seen = np.isfinite(predict(problem.frame, state.models, problem.points, found)).all(axis=1)
    good: Mask = np.array(np.isfinite(found).all(axis=1), dtype=bool)
    good[problem.points.point[rays & ~seen]] = False
    return np.where(good[:, None], found, state.local)


def planes_at(
    source: DemHeights, problem: BlockProblem, local: Array, of: Mask, sigmas: Array, offset: Array
) -> tuple[Planes, Array]:
    """Return the planes under points `of` a mask ``(N,)`` that are at `local` ``(N, 3)``, and their slopes ``(N, 2)``.

    Parameters
    ----------
    sigmas : ndarray (N,)
        Standard deviations of the heights, metres upwards.
    offset : ndarray (N,)
        Estimates of their errors.
    """
    frame, count = problem.frame, len(local)
    ground = np.where(problem.placed[:, None], problem.known, frame.geodetic(local))
    rows = np.flatnonzero(of & np.isfinite(ground[:, :2]).all(axis=1))
    heights, slopes = source.at(ground[rows], sigmas[rows])
    good = np.isfinite(heights) & np.isfinite(slopes).all(axis=1) & np.isfinite(sigmas[rows])
    rows, heights, slopes = rows[good], heights[good], slopes[good]
    plan = problem.placed[rows]
    # Where a point is known in plan its height is read there, with the error that its sigma in plan makes.
    own = sigmas[rows] ** 2
    own = own + np.where(plan, (slopes**2).sum(axis=1) * np.where(plan, problem.ground_sigmas[rows, 0], 0.0) ** 2, 0.0)
    tilted = np.where(plan[:, None], 0.0, slopes)
    length = np.sqrt(1.0 + (tilted**2).sum(axis=1))
    normal = np.column_stack([-tilted, np.ones(len(rows))]) / length[:, None]
    east = np.column_stack([np.ones(len(rows)), np.zeros(len(rows)), tilted[:, 0]])
    east /= np.linalg.norm(east, axis=1)[:, None]
    axes = np.stack([east, np.cross(normal, east), normal], axis=1)
    on_dem = np.column_stack([ground[rows, :2], heights - offset[rows]])
    places, turns, found = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan), np.full(count, np.inf)
    places[rows], turns[rows] = frame.of_geodetic(on_dem), axes @ frame.enu_at(on_dem)
    found[rows] = np.sqrt(own) / length
    steep = np.zeros((count, 2))
    steep[rows] = slopes
    return Planes(places, turns, found), steep
