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
#: The heights for a slope are so many of their sigmas apart, from one to so many samples.
_SLOPE, _WIDEST = 8.0, 3.0
#: Interpolated errors are alike over so many samples (an integral of their correlation).
_SHARED = 2.25
_CROSS = np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
_NINE = np.array([(east, north) for north in (-1.0, 0.0, 1.0) for east in (-1.0, 0.0, 1.0)])


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
    correct_shift : bool
        Whether what is made with the DEM afterwards has it where the estimate puts it. The adjustment always does.
    read_at : (float, float)
        How far (m, east and north) from a place its height is read: the estimated shift of the DEM.
    """

    surface: DemSurface
    bias: float | None = None
    correlation: float | None = None
    shift: float | None = None
    spots: SpotHeights | None = None
    correct_shift: bool = False
    read_at: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("bias", "correlation", "shift"):
            value = getattr(self, name)
            if value is not None and not (0 <= value < np.inf and (name != "correlation" or value > 0)):
                raise InputError(
                    f"{value} is no {name} of heights", field=f"points.{_OPTIONS[name]}", remedy="give metres"
                )
        if self.surface.fill != "mask":
            object.__setattr__(self, "surface", self.surface.with_fill("mask"))

    @classmethod
    def of(cls, heights: DemHeights | Surface) -> DemHeights:
        """Return heights of a DEM; the flat ground of one stated height is no observation."""
        if isinstance(heights, DemHeights):
            return heights
        if isinstance(heights, DemSurface):
            return cls(heights)
        raise InputError("flat ground is no observation of heights", field="heights", remedy="give a DEM")

    def heights(self, ground: Array) -> Array:
        """Return the heights ``(n,)`` at lon, lat ``(n, 2+)``; NaN in voids."""
        return self.surface.heights(self._read(ground), GEODETIC)

    def _read(self, ground: Array) -> Array:
        """Return lon, lat ``(n, 2)`` at which the DEM has the heights of places."""
        return ground[:, :2] + self.read_at / metres_per_degree(np.column_stack([ground[:, :2], np.zeros(len(ground))]))

    def spacing(self, sigmas: Array) -> float:
        """Return how far (m) heights for a slope are apart, so that errors of `sigmas` ``(n,)`` are small in it."""
        side, known = self.surface.sample_size, sigmas[np.isfinite(sigmas)]
        return float(np.clip(_SLOPE * np.median(known), side, _WIDEST * side)) if len(known) else side

    def slopes(self, ground: Array, spacing: float) -> Array:
        """Return the slopes ``(n, 2)`` to the east and north of planes through nine heights; NaN next to a void."""
        heights = self._around(ground, _NINE, np.full(len(ground), spacing))
        return np.asarray(heights.T @ _NINE) / (6.0 * spacing)

    def slope_variance(self, spacing: float) -> float:
        """Return the variance of such a slope by errors of the heights, over their variance."""
        apart = (_NINE[:, None] - _NINE) * spacing
        if self.correlation is not None:
            alike = np.exp(-np.linalg.norm(apart, axis=2) / self.correlation)
        else:
            alike = _interpolated(apart / self.surface.sample_size).prod(axis=2)
        return float(_NINE[:, 0] @ alike @ _NINE[:, 0]) / (6.0 * spacing) ** 2

    def _around(self, ground: Array, steps: Array, metres: Array) -> Array:
        """Return heights ``(k, n)`` at steps ``(k, 2)`` of so many metres ``(n,)`` from places."""
        lonlat = self._read(ground)
        step = metres[:, None] / metres_per_degree(np.column_stack([lonlat, np.zeros(len(lonlat))]))
        places = lonlat + steps[:, None] * step
        return self.surface.heights(places.reshape(-1, 2), GEODETIC).reshape(len(steps), -1)

    def breaks(self, ground: Array, slopes: Array, metres: Array) -> Array:
        """Return how far ``(n,)`` heights so many `metres` around places are from their planes: at a cliff, far."""
        found = self._around(ground, _CROSS, metres)
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


def _interpolated(distance: Array) -> Array:
    """Return the correlation of interpolated errors by their distance along an axis, in samples."""
    x = np.abs(distance)
    return np.where(x < 1.0, 1.0 - 1.5 * x**2 + 0.75 * x**3, np.maximum(2.0 - x, 0.0) ** 3 / 4.0)
