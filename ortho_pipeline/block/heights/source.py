"""Heights of a DEM under the points of a block, each as a plane near its point, with a sigma."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.intersection import predict
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.points import BlockPoints, Index
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.points.heights.spot_heights import SpotHeights
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface

#: Sigma (m) of a DEM without a stated accuracy; matching assumes the same.
DEFAULT_SIGMA = 10.0
#: Standard deviation (m) before the adjustment of a bias that spot heights fix.
FREE_BIAS = 100.0
#: Times that a ray is followed to the height of the DEM below it, and a change (m) that ends this. Terrain is less
#: steep than the ray.
_FOLLOWED, _NEAR_ENOUGH = 6, 1.0
#: The option of each number that describes a DEM.
_OPTIONS = {"bias": "dem_bias", "correlation": "dem_correlation", "shift": "dem_shift_sigma"}
#: The heights for a slope are so many of their sigmas apart, from one to so many samples.
_SLOPE, _WIDEST = 8.0, 3.0
#: Water that a DEM has flattened is this even (m), and has no larger slope; that of the geoid is smaller.
_EVEN, _LEVEL = 0.002, 1e-3
#: Mean correlation (`_interpolated`) along an axis of errors in one cell, in the next, and in the one after that.
_SHARED = (0.825, 0.325, 0.0125)
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
        Known heights, observations of the errors that heights share.
    correct_shift : bool
        Whether later products use the DEM with its shift corrected. The adjustment always corrects it.
    read_at : (float, float)
        Distance (m, east and north) from a place to where its height is read: the estimated shift of the DEM.

    Examples
    --------
    >>> dem = op.open_dem("sample_data/dem.tif").with_sigma(4.0)
    >>> heights = op.DemHeights(dem, shift=10.0)
    >>> heights.sigmas(np.array([[36.0, 39.0]]))
    array([4.])
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
                    f"the {name} of heights is {value}, not a length",
                    field=f"points.{_OPTIONS[name]}",
                    remedy="give metres",
                )
        if self.surface.fill != "mask":
            object.__setattr__(self, "surface", self.surface.with_fill("mask"))

    @property
    def shift_sigma(self) -> float:
        """Standard deviation (m) of the position of the DEM, east and north."""
        return self.surface.sample_size / 2.0 if self.shift is None else self.shift

    @classmethod
    def of(cls, heights: DemHeights | Surface) -> DemHeights:
        """Return heights of a DEM; the flat ground of one stated height is no observation."""
        if isinstance(heights, DemHeights):
            return heights
        if isinstance(heights, DemSurface):
            return cls(heights)
        raise InputError("flat ground has no heights to observe", field="heights", remedy="give a DEM")

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

    def slopes(self, ground: Array, spacing: float) -> tuple[Array, Mask]:
        """Return the slopes ``(n, 2)`` to the east and north of planes through nine heights; NaN next to a void.

        And where ``(n,)`` four of these heights, on one side, are equal, as on water that a DEM has flattened.
        """
        heights = self._around(ground, _NINE, np.full(len(ground), spacing))
        quarters = heights.reshape(3, 3, -1)
        south, north = quarters[:2], quarters[1:]
        southwest, southeast, northwest, northeast = south[:, :2], south[:, 1:], north[:, :2], north[:, 1:]
        with np.errstate(invalid="ignore"):
            level = np.abs(southwest - southeast - northwest + northeast) < _EVEN
            for one, other in ((southwest, southeast), (southwest, northwest)):
                level &= np.abs(one - other) < _LEVEL * spacing
        return np.asarray(heights.T @ _NINE) / (6.0 * spacing), np.asarray(level.any(axis=(0, 1)))

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

        The sum of the correlations with all others, by the mean of two places in cells of four samples.
        """
        places = np.column_stack([ground[:, :2], np.zeros(len(ground))])
        samples = np.floor(np.nan_to_num(self.surface.sampler(GEODETIC)(places))).astype(np.int64)
        cells, which, counts = np.unique(samples, axis=0, return_inverse=True, return_counts=True)
        row = int(np.ptp(cells[:, 1])) + 2 * len(_SHARED) if len(cells) else 1
        numbers, near = cells @ (row, 1), range(1 - len(_SHARED), len(_SHARED))
        found = np.full(len(cells), 1.0 - _SHARED[0] ** 2)
        for across, down in itertools.product(near, near):
            wanted = numbers + across * row + down
            place = np.minimum(np.searchsorted(numbers, wanted), len(numbers) - 1)
            there = np.where(numbers[place] == wanted, counts[place], 0)
            found += _SHARED[abs(across)] * _SHARED[abs(down)] * there
        return np.asarray(found[which.ravel()])


def starts(source: DemHeights, problem: BlockProblem, rays: Mask) -> Array:
    """Return where ties are ``(N, 3)``: where the first ray of each meets the DEM, as far as all its rays see it there.

    Nearly parallel rays of models that are a few pixels off meet anywhere; the DEM is right to a few metres. NaN for
    other points and where the DEM has no height.
    """
    points, frame, models = problem.points, problem.frame, problem.models
    first = np.flatnonzero(_first_rays(points.point, rays & (points.tie & ~problem.placed)[points.point]))
    high = _along(points, models, first, np.full(len(first), np.nan))
    ground = _along(points, models, first, source.heights(high))
    # From there on rays are straight.
    step = ground - high
    slopes = step / np.where(step[:, 2:] == 0, np.inf, step[:, 2:])
    heights, left = np.full(len(first), np.nan), np.arange(len(first))
    for _ in range(_FOLLOWED):
        heights[left] = source.heights(ground[left])
        off = heights[left] - ground[left, 2]
        far = np.abs(off) > _NEAR_ENOUGH
        left = left[far]
        if not len(left):
            break
        ground[left] += slopes[left] * off[far, None]
    good = np.isfinite(heights) & np.isfinite(ground).all(axis=1)
    found = np.full((len(points), 3), np.nan)
    ground[:, 2] = heights
    found[points.point[first[good]]] = frame.of_geodetic(ground[good])
    seen = np.isfinite(predict(frame, models, points, found)).all(axis=1)
    found[points.point[rays & ~seen]] = np.nan
    return found


def _along(points: BlockPoints, models: Sequence[SensorModel], rays: Index, heights: Array) -> Array:
    """Return lon, lat, h ``(n, 3)`` of `rays` ``(n,)`` at heights ``(n,)``; where they are NaN, at those of models."""
    found, images = np.empty((len(rays), 3)), points.image[rays]
    for image in np.unique(images):
        model, of = models[image], np.flatnonzero(images == image)
        at = np.where(np.isfinite(heights[of]), heights[of], model.reference_height)
        found[of] = ground_transform(model.crs, GEODETIC)(model.image_to_ground(points.measured[rays[of]], at))
    return found


def _first_rays(point: Index, used: Mask) -> Mask:
    """Return of all rays ``(M,)`` the first of each point that is used."""
    rays, first = np.flatnonzero(used), np.zeros(len(point), dtype=bool)
    first[rays[np.unique(point[rays], return_index=True)[1]]] = True
    return first


def _interpolated(distance: Array) -> Array:
    """Return the correlation of interpolated errors by their distance along an axis, in samples."""
    x = np.abs(distance)
    return np.where(x < 1.0, 1.0 - 1.5 * x**2 + 0.75 * x**3, np.maximum(2.0 - x, 0.0) ** 3 / 4.0)
