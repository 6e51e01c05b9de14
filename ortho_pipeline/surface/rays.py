"""Where the rays of image points meet a surface.

The ray of each of a few points is a parabola in height through three exact positions; where what it finds is not on the
terrain by the exact model, that is followed step by step. Many points share a lattice over the image that gives DEM
coordinates as polynomials in height, verified against the exact model; compiled code finds where these curves first
meet the terrain (`ray_kernel`). The exact model has the last word: it gives the ground point at the height found.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.models.base import SensorModel, as_image
from ortho_pipeline.models.correction import ImageCorrection
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface

Array = NDArray[np.float64]

#: From this many points on the lattice is worth its making.
MANY = 20_000
#: Spacings (px) of the lattice, tried one after the other.
_SPACINGS = (128, 64, 32, 16)
#: Coefficients of a polynomial along a ray, as `ray_kernel` has them.
LEVELS = 5
#: More DEM samples under the points than this are not held in memory at once.
_MOST_SAMPLES = 64_000_000
_PROBES = 500
#: Rays whose curves are in memory at once: they stay in the second cache.
_TOGETHER = 4096
#: Halvings that find up to where a model follows a ray: to a thousandth of the range of heights.
_HALVINGS = 10


def meet_surface(model: SensorModel, image: ArrayLike, surface: Surface, *, tolerance: float = 1e-3) -> Array:
    """Intersect the rays of image points with a surface.

    It is the first, visible, intersection, also where a ridge hides the slope behind it. Many rays are followed from
    cell to cell of the DEM, so that not even the top of a needle is passed by (see `ray_kernel`). Few rays come down
    from above the highest terrain in steps of at most one DEM sample in plan, and the bracket is then narrowed. They
    can pass the corner of a cell; so can many rays where the terrain rises by hundreds of metres between samples.

    Parameters
    ----------
    image : array_like, shape (N, 2)
        Column, row.
    tolerance : float
        Greatest difference (m) in height between ray and surface.

    Returns
    -------
    ndarray, shape (N, 3)
        Ground in the model's CRS; NaN where the ray meets no terrain of the surface, or a void first.

    Examples
    --------
    >>> dem = op.open_dem("sample_data/dem.tif", "egm96")
    >>> print(np.round(op.meet_surface(op.open_scene("sample_data/scene.tif").model, [[500.0, 500.0]], dem), 4))
    [[ 33.3497  37.2502 731.0427]]
    """
    image = as_image(image)
    if not isinstance(surface, DemSurface):
        return model.image_to_ground(image, surface.height_range[0])
    ray = _Ray(model, image, surface)
    reach = ray.reach()
    if reach is None:
        return np.full((len(image), 3), np.nan)
    window, (lowest, highest) = reach
    limits = model.height_limits
    low, high = max(lowest - 1.0, limits[0]), min(highest + 1.0, limits[1])
    if not low < high:
        return np.full((len(image), 3), np.nan)
    # The window ends at the edge of the DEM; a fill rule continues beyond.
    many = len(image) >= MANY and surface.fill in ("error", "mask")
    height = _march_many(ray, window, low, high, tolerance) if many else None
    if height is not None:
        return _ground_at(model, image, height)
    curve = _Parabolas(ray, low, high)
    ground = _ground_at(model, image, _narrow(curve, *_bracket(curve, low, high), tolerance / 2))
    with np.errstate(invalid="ignore"):
        left = np.flatnonzero(~(np.abs(ray.above(ground)) <= tolerance))
    if len(left):
        exact = _Ray(model, image[left], surface)
        ground[left] = _ground_at(model, image[left], _narrow(exact, *_bracket(exact, low, high), tolerance))
    return ground


def refuse_camera_below(model: SensorModel, surface: Surface, file: str | None) -> None:
    """Raise a `CoverageError` about a file if the camera of a frame is below the surface: its rays meet nothing."""
    camera = model.model if isinstance(model, ImageCorrection) else model
    if not isinstance(camera, FrameCamera):
        return
    above = float(surface.above(camera.perspective_centre[None], camera.crs)[0])
    if above < 0:
        raise CoverageError(
            f"the camera is {-above:.0f} m below the ground by its altitude and these heights",
            file=file,
            field="vertical",
            remedy=Text(
                "state what the altitude is measured above (",
                Setting("scene.sensor_options", "DATUM", key="vertical"),
                "; for photos, above take-off: ",
                Setting("scene.sensor_options", "METRES", key="takeoff"),
                "), or check height datum (",
                Setting("surface.vertical"),
                ") and unit of the DEM",
            ),
        )


def _ground_at(model: SensorModel, image: Array, height: Array) -> Array:
    ground = model.image_to_ground(image, height)
    ground[np.isnan(height)] = np.nan
    return ground


def levels(count: int) -> Array:
    """Return normalised heights to evaluate a model at: the Chebyshev-Lobatto nodes of [-1, 1], upwards."""
    return -np.cos(np.pi * np.arange(count) / (count - 1))


def polynomials(values: Array) -> Array:
    """Return the coefficients ``(..., n, k)`` of polynomials in normalised height through values ``(..., n, k)``.

    Parameters
    ----------
    values : (..., n, k)
        At the n `levels`.
    """
    return np.asarray(np.einsum("kl,...la->...ka", _from_values(values.shape[-2]), values))


@functools.cache
def _from_values(count: int) -> Array:
    """Return the matrix ``(count, count)`` from values at the `levels` to coefficients."""
    return np.asarray(np.linalg.inv(np.vander(levels(count), increasing=True)), dtype=np.float64)


class _Ray:
    """Image points as functions of height."""

    def __init__(self, model: SensorModel, image: Array, surface: DemSurface) -> None:
        self.model, self.image, self.surface = model, image, surface
        self._transform = ground_transform(parse_crs(model.crs), surface.crs)
        # The box of the finite points; per column, which is much faster than along the first axis.
        columns = [column[np.isfinite(column)] for column in image.T]
        self.any = all(len(column) for column in columns)
        self.low = np.array([column.min(initial=np.inf) for column in columns])
        self.high = np.array([column.max(initial=-np.inf) for column in columns])

    def places(self, index: NDArray[np.intp], height: Array) -> Array:
        """Sample coordinates ``(n, 2)`` in the DEM of some of the points at heights."""
        return self.samples(self.image[index], height)

    def samples(self, image: Array, height: Array) -> Array:
        """Sample coordinates ``(n, 2)`` in the DEM of image points at heights."""
        return self._samples_of(self.model.image_to_ground(image, height))

    def _samples_of(self, ground: Array) -> Array:
        return self.surface.samples_at(self._transform(ground)[:, :2])

    def above(self, ground: Array) -> Array:
        """Height ``(n,)`` of ground points in the model's CRS above the terrain; NaN off the DEM."""
        return ground[:, 2] - self.surface.heights_at(*self._samples_of(ground).T)

    def clearance(self, index: NDArray[np.intp], height: Array) -> Array:
        """Height of the ray above the terrain; NaN off the DEM."""
        return height - self.surface.heights_at(*self.places(index, height).T)

    def reach(self) -> tuple[tuple[int, int, int, int], tuple[float, float]] | None:
        """Samples (column, row, columns, rows) of the DEM that the rays can meet, and the range of heights there.

        The window depends on a range of heights, and the range on the window. They are iterated from the model's range
        until the terrain is within it. None if the rays miss the DEM.
        """
        low, high = self.model.height_range
        window_and_heights = None
        for _ in range(4):
            window = self._window(low, high)
            if window is None:
                return None
            try:
                lowest, highest = self.surface.range_within(*window)
            except CoverageError:
                return None
            window_and_heights = window, (lowest, highest)
            if low <= lowest and highest <= high:
                break
            low, high = min(low, lowest - 1.0), max(high, highest + 1.0)
        return window_and_heights

    def _window(self, low: float, high: float) -> tuple[int, int, int, int] | None:
        """Samples under the rays between two heights; a frame around the points represents all of them."""
        if not self.any:
            return None
        steps = self.low + (self.high - self.low) * np.linspace(0, 1, 9)[:, None]
        columns, rows = np.meshgrid(steps[:, 0], steps[:, 1])
        frame = np.column_stack([columns.ravel(), rows.ravel()])
        uv = np.concatenate([self.samples(frame, np.full(len(frame), height)) for height in (low, high)])
        uv = uv[np.isfinite(uv).all(axis=1)]
        size = np.array(self.surface.shape[::-1])
        filled = self.surface.fill not in ("error", "mask")
        # A fill rule continues beyond the DEM, and needs samples from there.
        beyond = self.surface.nearest_reach if self.surface.fill == "nearest" else 0
        first = np.clip(np.floor(uv.min(axis=0, initial=np.inf)) - 2 - beyond, 0, size - 2 if filled else size)
        last = np.clip(np.ceil(uv.max(axis=0, initial=-np.inf)) + 3 + beyond, first + 2 if filled else 0, size)
        if (last - first < 2).any():
            return None
        return int(first[0]), int(first[1]), int(last[0] - first[0]), int(last[1] - first[1])


class _Parabolas(_Ray):
    """The same, but for parabolas in height through three exact positions of each point."""

    def __init__(self, ray: _Ray, low: float, high: float) -> None:
        super().__init__(ray.model, ray.image, ray.surface)
        self._middle, self._half = (low + high) / 2, (high - low) / 2
        heights = np.repeat([low, self._middle, high], len(ray.image))
        below, self._at, above = ray.samples(np.tile(ray.image, (3, 1)), heights).reshape(3, -1, 2)
        self._slope, self._bend = (above - below) / 2, (above + below) / 2 - self._at

    def places(self, index: NDArray[np.intp], height: Array) -> Array:
        t = ((height - self._middle) / self._half)[:, None]
        return self._at[index] + t * (self._slope[index] + t * self._bend[index])


def _march_many(
    ray: _Ray, window: tuple[int, int, int, int], low: float, high: float, tolerance: float
) -> Array | None:
    """Return the heights of the first intersections ``(N,)`` with a lattice; None if no lattice is accurate enough."""
    from ortho_pipeline.surface import ray_kernel

    if window[2] * window[3] > _MOST_SAMPLES:
        return None
    heights = ray.surface.window(*window)
    image = np.ascontiguousarray(ray.image)
    origin = np.floor(ray.low)
    extent = ray.high - origin
    middle, half = (low + high) / 2, (high - low) / 2
    for spacing in _SPACINGS:
        size = (extent // spacing).astype(int) + 2
        if size.prod() * LEVELS > len(image):
            return None  # the lattice would cost more than it saves
        nodes = _ray_lattice(ray, origin, size, spacing, middle, half)
        flat = curve_nodes(nodes)
        terrain = ray_kernel.terrain_of(heights, window[0], window[1], middle, half, flat)
        if _lattice_error(ray, nodes, origin, extent, spacing, middle, half) * 2 * terrain.steepest <= tolerance:
            normalised = np.empty(len(image))
            curves = np.empty((flat.shape[2], _TOGETHER))
            for first in range(0, len(image), _TOGETHER):
                places = (image[first : first + _TOGETHER] - origin) / spacing
                some = curves[:, : len(places)]
                ray_kernel.curves_at(flat, places, some)
                normalised[first : first + _TOGETHER] = ray_kernel.meet(some, terrain, tolerance)
            return middle + half * normalised
    return None


def curve_nodes(nodes: Array) -> Array:
    """Return polynomials ``(..., levels, k)`` as `ray_kernel.curves_at` takes them: ``(..., k levels)``."""
    return np.ascontiguousarray(nodes.swapaxes(-1, -2)).reshape(*nodes.shape[:-2], -1)


def _ray_lattice(ray: _Ray, origin: Array, size: NDArray[np.int_], spacing: int, middle: float, half: float) -> Array:
    """Return the coefficients ``(rows, columns, levels, 2)`` of DEM coordinates as polynomials in height."""
    columns, rows = np.meshgrid(origin[0] + spacing * np.arange(size[0]), origin[1] + spacing * np.arange(size[1]))
    image = np.repeat(np.column_stack([columns.ravel(), rows.ravel()]), LEVELS, axis=0)
    uv = ray.samples(image, np.tile(middle + half * levels(LEVELS), columns.size))
    return polynomials(uv.reshape(size[1], size[0], LEVELS, 2))


def _lattice_error(
    ray: _Ray, nodes: Array, origin: Array, extent: Array, spacing: int, middle: float, half: float
) -> float:
    """Return the largest error of the lattice in DEM samples, at points spread over image and heights."""
    random = np.random.default_rng(0)  # the same points in every run
    image, t = origin + extent * random.uniform(size=(_PROBES, 2)), random.uniform(-1, 1, _PROBES)
    place = (image - origin) / spacing
    i, j = place.astype(int).T
    fx, fy = (place - np.floor(place)).T[:, :, None, None]
    upper = nodes[j, i] * (1 - fx) + nodes[j, i + 1] * fx
    lower = nodes[j + 1, i] * (1 - fx) + nodes[j + 1, i + 1] * fx
    places = np.einsum("nk,nka->na", t[:, None] ** np.arange(LEVELS), upper * (1 - fy) + lower * fy)
    error = np.abs(places - ray.samples(image, middle + half * t)).max(axis=1)
    return float(np.where(np.isnan(error), np.inf, error).max())


def _bracket(ray: _Ray, low: float, high: float) -> tuple[Array, Array]:
    """Return heights above and below the first intersection; NaN where there is none."""
    count = len(ray.image)
    every = np.arange(count)
    top, length = _tops(ray, low, high)
    # Try also a ray without any known part (beyond the model), with the step of the others.
    typical = float(np.nanmax(length)) if np.isfinite(length).any() else 1.0
    steps = np.clip(np.ceil(np.where(np.isfinite(length), length, typical)), 1, 2000).astype(int)
    above, below = np.full(count, np.nan), np.full(count, np.nan)
    last = top.copy()
    last_clear = ray.clearance(every, last)
    active = every
    for step in range(1, int(steps.max(initial=0)) + 1):
        height = top[active] + (low - top[active]) * np.minimum(step / steps[active], 1.0)
        clear = ray.clearance(active, height)
        with np.errstate(invalid="ignore"):
            under = clear <= 0
            met = under & (last_clear[active] > 0)
        above[active[met]], below[active[met]] = last[active[met]], height[met]
        last[active], last_clear[active] = height, clear
        active = active[~under & (step < steps[active])]
        if not len(active):
            break
    return above, below


def _tops(ray: _Ray, low: float, high: float) -> tuple[Array, Array]:
    """Return the height at which each ray begins, and how many DEM samples it passes from there to the lower height.

    The upper height, or for a ray that the model does not follow so far up the highest at which it does: a ray must not
    depend on those that come with it. Its length is NaN where the model does not reach the lower height.
    """
    every = np.arange(len(ray.image))
    foot, top = ray.places(every, np.full(len(every), low)), np.full(len(every), high)
    length = np.hypot(*(ray.places(every, top) - foot).T)
    short = np.flatnonzero(np.isnan(length) & np.isfinite(foot).all(axis=1))
    known, unknown = np.full(len(short), low), np.full(len(short), high)
    for _ in range(_HALVINGS if len(short) else 0):
        middle = (known + unknown) / 2
        lengths = np.hypot(*(ray.places(short, middle) - foot[short]).T)
        good = np.isfinite(lengths)
        length[short[good]], top[short[good]] = lengths[good], middle[good]
        known, unknown = np.where(good, middle, known), np.where(good, unknown, middle)
    return top, length


def _narrow(ray: _Ray, above: Array, below: Array, tolerance: float) -> Array:
    """Return the heights where the rays meet the terrain, between `above` and `below` (NaN rows stay)."""
    out = np.full(len(above), np.nan)
    active = np.flatnonzero(np.isfinite(above))
    a, b = above.copy(), below.copy()
    fa, fb = np.full(len(a), np.nan), np.full(len(a), np.nan)
    fa[active], fb[active] = ray.clearance(active, a[active]), ray.clearance(active, b[active])
    for step in range(60):
        if not len(active):
            break
        with np.errstate(invalid="ignore", divide="ignore"):
            secant = a[active] - fa[active] * (b[active] - a[active]) / (fb[active] - fa[active])
        # Every third step halves: false position alone creeps where the terrain is steep and bent.
        height = 0.5 * (a[active] + b[active]) if step % 3 == 2 else secant
        clear = ray.clearance(active, height)
        done = np.abs(clear) <= tolerance
        out[active[done]] = height[done]
        with np.errstate(invalid="ignore"):
            over, under = active[clear > 0], active[clear <= 0]
            a[over], fa[over] = height[clear > 0], clear[clear > 0]
            b[under], fb[under] = height[clear <= 0], clear[clear <= 0]
        active = active[~done & np.isfinite(clear)]
    return out
