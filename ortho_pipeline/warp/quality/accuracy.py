r"""How accurate each pixel of an ortho is: the covariance of where it shows the ground.

A pixel takes its height h from the surface and its value from the image point that the model gives. With the
derivatives of `sight` in metres true east and north on the ground, :math:`A` (pixels per metre, at constant height) and
:math:`d` (metres that ground moves per metre of height), and the slope :math:`s` of the surface (rise per metre east
and north), the covariance of the place that it really shows is

.. math::
    C &= T (A^{-1} (J C_p J^T + \tfrac{1}{3} \beta^2 I) A^{-T} + (\sigma_h^2 + \sigma_0^2) d d^T + \sigma_r^2 I) T^T \\
    T &= (I + d s^T)^{-1} = I - d s^T / (1 + s \cdot d)

- :math:`J C_p J^T`: the parameters of the model as the points determine them, with what neighbouring points err
  together (`Fit.covariance`) and how little few points tell of their own errors (`predictive`); of a model that nobody
  adjusted :math:`\sigma^2 I` on the ground, as its vendor states;
- :math:`\beta`: the bound of the warp's interpolation (px), taken as the limits of an even distribution;
- :math:`\sigma_h, \sigma_0`: standard deviations of the heights and of their datum;
- :math:`\sigma_r`: of the place of a reference that points were matched with, where :math:`C_p` does not have it;
- :math:`T`: a ray that is off meets a slope higher or lower. Errors are smaller on slopes that face the sensor, and
  larger on those that turn away from it. Along the view the factor is :math:`1 / (1 + s \cdot d)`, within the limits
  1 / `MOST` and 1 / `LEAST`.

Three assumptions: the parts are independent; the model is right apart from its parameters; the slope is even over the
error. The parts are interpolated between nodes that are exact, to `_TOLERANCE`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.geodesy.distortion import inverse_2x2
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.rays import levels, polynomials
from ortho_pipeline.warp.quality import accuracy_kernel
from ortho_pipeline.warp.quality.accuracy_kernel import LEAST, MOST, Nodes, PixelHeights
from ortho_pipeline.warp.quality.error_ellipse import circular_error, circular_error_of_all, radii
from ortho_pipeline.warp.quality.sight import Sight
from ortho_pipeline.warp.tile_kernel import DemWindow

#: Bands of the layer.
BANDS = ("sigma_e", "sigma_n", "rho", "ce90")
#: Output pixels per pixel of the layer, per side.
STEP = 16
#: Side of a tile of the layer, and spacings of its nodes, tried one after the other (pixels of the layer).
_TILE, _SPACINGS = 512, (64, 16, 4)
#: Side of a tile whose every pixel is a node.
_EXACT_TILE = 128
#: A standard deviation is interpolated to this part of itself, at so many places that are tried.
_TOLERANCE, _PROBES = 0.005, 200
#: Heights at which a node is exact.
_LEVELS = 3
#: Places that the figures over the scene are taken of, about; cells per side of its map.
_SAMPLE, _CELLS = 20_000, 32
#: Side (px) up to which a layer has no overviews.
_SMALL = 1024
#: Of these so many are mixed for the error of all places together.
_MIXED = 1000


@dataclass(frozen=True)
class Budget:
    """The error sources of an ortho, independent of each other; None is unknown.

    Parameters
    ----------
    covariance : (P, P), optional
        Of the model's parameters.
    stated : float, optional
        Standard deviation (m, per axis) of a model that was not adjusted, as its vendor states it.
    heights : float or Surface, optional
        Standard deviation (m) of the heights; as a surface it has them for "heights".
    datum : float
        Standard deviation (m) of the datum of the heights.
    reference : float
        Standard deviation (m, per axis) of the error common to all points, in addition to the covariance's part.
    interpolation_px : float
        Bound on the warp's error (px).
    """

    covariance: Array | None = None
    stated: float | None = None
    heights: float | Surface | None = None
    datum: float = 0.0
    reference: float = 0.0
    interpolation_px: float = 0.0

    @property
    def knows_model(self) -> bool:
        """Whether anything is known of the model's errors."""
        return self.covariance is not None or self.stated is not None

    @property
    def even(self) -> float:
        """Variance (m², per axis) that is the same everywhere: the reference's, and what a vendor states."""
        stated = self.stated if self.covariance is None and self.stated else 0.0
        return self.reference**2 + stated**2


class Parts(NamedTuple):
    """Covariances ``(n, 3)`` in m² (ee, nn, en) of what makes up the error at some places."""

    model: Array
    heights: Array
    even: Array
    interpolation: Array

    @property
    def total(self) -> Array:
        """Their sum."""
        return self.model + self.heights + self.even + self.interpolation


@dataclass(frozen=True)
class AccuracyResult:
    """What a layer of accuracy comes to over the scene.

    Parameters
    ----------
    ce90 : float
        Radius (m) that holds 90 % of the errors of all pixels together; NaN where there are none.
    quantiles : (float, float, float)
        Of the pixels' own: 5, 50 and 95 %.
    sigma : (float, float)
        Root mean square of the standard deviations east and north.
    shares : mapping of str to float
        Of the mean variance: model, heights, even, interpolation.
    cells : (rows, columns)
        Mean ce90 in the cells of a map, NaN where there is none; `cell` pixels of the layer are its side.
    known : float
        Share of the pixels that show the image whose accuracy is known.
    """

    ce90: float
    quantiles: tuple[float, float, float]
    sigma: tuple[float, float]
    shares: Mapping[str, float]
    cells: Array = field(repr=False)
    cell: int = 1
    known: float = 1.0


def predictive(covariance: Array, freedom: float) -> Array:
    """Return the covariance ``(P, P)`` of a prediction by parameters whose scale was itself estimated.

    A prediction by a fit with f degrees of freedom follows Student's t, whose variance is f / (f - 2) times that of the
    normal distribution. It has none below 2; three stand for fewer. With infinitely many the scale is known.
    """
    return covariance / (1.0 - 2.0 / max(freedom, 3.0))


# -- at places -------------------------------------------------------------------------------------------------------


def parts_at(
    budget: Budget,
    sight: Sight,
    columns: Array,
    rows: Array,
    heights: Array,
    sigma_heights: Array | float | None = None,
    slopes: Array | None = None,
) -> Parts:
    """Return what makes up the error of output positions ``(n,)`` (corner convention) at heights, exactly.

    Parameters
    ----------
    sigma_heights : (n,) or float, optional
        Of the heights there; that of the budget without, if it is one number.
    slopes : (n, 2), optional
        Of the surface there: rise per metre true east and north. Without, it is level.
    """
    nodes = _exact(budget, sight, columns, rows, heights)
    if sigma_heights is None:
        sigma_heights = budget.heights if isinstance(budget.heights, float | int) else 0.0
    variance = np.asarray(sigma_heights, dtype=float) ** 2 + budget.datum**2
    even = np.broadcast_to([budget.even, budget.even, 0.0], (len(columns), 3))
    east, north = nodes[:, 3], nodes[:, 4]
    height = np.stack([east**2, north**2, east * north], axis=1) * np.reshape(variance, (-1, 1))
    parts = Parts(nodes[:, :3], height, even, nodes[:, 5:8])
    if slopes is None:
        return parts
    along = (slopes * nodes[:, 3:5]).sum(axis=1, keepdims=True)
    limited = np.clip(along, LEAST - 1.0, MOST - 1.0)
    slopes = slopes * np.divide(limited, along, out=np.ones_like(along), where=limited != along)
    matrix = np.linalg.inv(np.eye(2) + nodes[:, 3:5, None] * slopes[:, None, :])
    return Parts(*(_three(matrix @ _square(part) @ matrix.transpose(0, 2, 1)) for part in parts))


def _exact(budget: Budget, sight: Sight, columns: Array, rows: Array, heights: Array) -> Array:
    """Return the fields ``(n, 10)``: model (ee, nn, en), displacement (e, n), interpolation (ee, nn, en), image."""
    seen, metres = sight.seen(columns, rows, heights), sight.metres(columns, rows, heights)
    inverse = metres @ seen.place_per_pixel
    displacement = np.einsum("nij,nj->ni", metres, seen.displacement)
    model = np.zeros((len(columns), 3))
    if budget.covariance is not None and len(budget.covariance):
        partials = inverse @ sight.model.param_partials(seen.ground)
        model = _three(partials @ budget.covariance @ partials.transpose(0, 2, 1))
    interpolation = _three(inverse @ inverse.transpose(0, 2, 1)) * (budget.interpolation_px**2 / 3)
    return np.concatenate([model, displacement, interpolation, seen.image], axis=1)


def _three(covariance: Array) -> Array:
    return np.stack([covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]], axis=1)


def _square(three: Array) -> Array:
    return np.asarray(three[:, [0, 2, 2, 1]].reshape(-1, 2, 2))


# -- everywhere ------------------------------------------------------------------------------------------------------


def layer_grid(grid: Grid, step: int) -> Grid:
    """Return the grid of a layer: the corner of the ortho's, `step` of its pixels to one; the last may reach beyond."""
    return Grid(
        grid.crs, grid.left, grid.top, grid.dx * step, grid.dy * step, -(-grid.width // step), -(-grid.height // step)
    )


def write_accuracy(
    budget: Budget,
    sight: Sight,
    surface: Surface,
    size: tuple[int, int],
    path: str | os.PathLike[str],
    *,
    heights: tuple[float, float],
    step: int = STEP,
    resources: Resources | None = None,
    metadata: Mapping[str, str] | None = None,
) -> AccuracyResult:
    """Write the accuracy of the ortho on the grid of `sight` as a COG, at one pixel for `step` squared of its own.

    Bands: standard deviations true east and north on the ground (m), their correlation, and the radius that holds 90 %
    of the errors (m); NaN where the ortho shows nothing, or something of the error is not known there.

    Parameters
    ----------
    surface : Surface
        That of the ortho.
    size : (int, int)
        Columns and rows of the image.
    heights : (float, float)
        Lowest and highest ground of the scene, about.
    metadata : mapping, optional
        Of the file.
    """
    resources = resources or Resources()
    grid = layer_grid(sight.grid, step)
    layer = _Layer(budget, sight.on(grid), surface, size, heights, resources.memory // 8)
    profile = Profile(
        count=len(BANDS),
        dtype=np.dtype(np.float32),
        validity="nodata",
        nodata=math.nan,
        descriptions=BANDS,
        interpretations=(0,) * len(BANDS),
        metadata=dict(metadata or {}),
        scales=tuple((1.0, 0.0, unit) for unit in ("m", "m", "", "m")),
    )
    # Little is gained by more effort, and half of the time of the layer would be spent on it.
    options = {"LEVEL": "1", "PREDICTOR": "NO", **overviews(grid)}
    with RasterWriter(path, grid, profile, creation_options=options, threads=resources.threads or 1) as writer:
        for left, top, width, height in tiles(grid, _TILE):
            writer.write(left, top, layer.make(left, top, width, height), None)
    return layer.result()


def overviews(grid: Grid) -> dict[str, str]:
    """Return creation options of a layer: a small one needs no overviews, which take as long as the pixels.

    Nor has it large blocks, which reach beyond its sides.
    """
    small = max(grid.width, grid.height) <= _SMALL
    return {"OVERVIEWS": "NONE", "BLOCKSIZE": "128"} if small else {"OVERVIEW_RESAMPLING": "NEAREST"}


def tiles(grid: Grid, side: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield left, top, width and height of the tiles of a grid, row by row."""
    for top in range(0, grid.height, side):
        for left in range(0, grid.width, side):
            yield left, top, min(side, grid.width - left), min(side, grid.height - top)


class _Layer:
    """The work on one layer; `sight` is that of its own pixels."""

    def __init__(
        self,
        budget: Budget,
        sight: Sight,
        surface: Surface,
        size: tuple[int, int],
        heights: tuple[float, float],
        memory: int,
    ) -> None:
        self.budget, self.sight, self.surface, self.size, self.memory = budget, sight, surface, size, memory
        low, high = heights
        self.middle, self.half = (low + high) / 2, max((high - low) / 2, 1.0)
        sources = [surface] if not isinstance(budget.heights, Surface) else [surface, budget.heights]
        self.samplers = [source.sampler(sight.grid.crs) for source in sources]
        self.spacing = self._spacing()
        grid = sight.grid
        self.stride = max(1, int(math.sqrt(grid.width * grid.height / _SAMPLE)))
        self.taken: list[Array] = []
        # Per cell of the map: sum of ce90 and count; of all pixels: variances of the parts, of each axis, counts.
        self.cell = -(-max(grid.width, grid.height) // _CELLS)
        self.sums = np.zeros((-(-grid.height // self.cell), -(-grid.width // self.cell), 2))
        self.totals = np.zeros(8)

    # -- nodes -------------------------------------------------------------------------------------------------------

    def _nodes(self, left: int, top: int, width: int, height: int, spacing: int) -> tuple[Array, Array, Array]:
        """Return fields ``(rows, columns, levels, 10)`` of nodes, and their samples ``(rows, columns, 2, k)``.

        Also return ``(rows, columns, 2, 2)`` pixels of column and row per metre true east and north.
        """
        columns, rows = np.meshgrid(
            left + 0.5 + spacing * np.arange(-(-width // spacing) + 1),
            top + 0.5 + spacing * np.arange(-(-height // spacing) + 1),
        )
        shape, flat = columns.shape, (columns.ravel(), rows.ravel())
        x, y = self.sight.grid.xy(*flat)
        ground = np.stack([x, y, np.zeros(len(x))], axis=1)
        samples = np.stack([sampler(ground) for sampler in self.samplers], axis=2)
        pixels = inverse_2x2(self.sight.metres(*flat, np.full(len(x), self.middle)))
        fields = self._polynomials(*flat).reshape(*shape, _LEVELS, -1)
        return fields, samples.reshape(*shape, 2, -1), pixels.reshape(*shape, 2, 2)

    def _polynomials(self, columns: Array, rows: Array) -> Array:
        """Return the fields at places as polynomials in the normalised height ``(n, levels, 10)``."""
        heights = np.repeat(self.middle + self.half * levels(_LEVELS), len(rows))
        fields = self._fields(np.tile(columns, _LEVELS), np.tile(rows, _LEVELS), heights)
        return polynomials(fields.reshape(_LEVELS, len(rows), -1).swapaxes(0, 1))

    def _fields(self, columns: Array, rows: Array, heights: Array) -> Array:
        return _exact(self.budget, self.sight, columns, rows, heights)

    def _spacing(self) -> int:
        """Return the widest spacing of nodes that is good enough at places all over the layer; 1 if none is."""
        grid, random = self.sight.grid, np.random.default_rng(0)  # the same places in every run
        columns, rows = random.uniform(0, grid.width, _PROBES), random.uniform(0, grid.height, _PROBES)
        t = random.uniform(-1, 1, _PROBES)
        heights = self.middle + self.half * t
        image = self.sight.image(columns, rows, heights)
        with np.errstate(invalid="ignore"):
            inside = ((image >= 0) & (image <= self.size)).all(axis=1)
        if not inside.any():
            return _SPACINGS[0]
        columns, rows, heights, t = columns[inside], rows[inside], heights[inside], t[inside]
        exact = _sigmas(self._fields(columns, rows, heights))
        for spacing in _SPACINGS:
            fields = 0.0
            for corner in range(4):
                i, j = np.floor((columns - 0.5) / spacing), np.floor((rows - 0.5) / spacing)
                fx, fy = (columns - 0.5) / spacing - i, (rows - 0.5) / spacing - j
                weight = (fx if corner % 2 else 1 - fx) * (fy if corner // 2 else 1 - fy)
                at = (0.5 + spacing * (i + corner % 2), 0.5 + spacing * (j + corner // 2))
                powers = t[:, None] ** np.arange(_LEVELS)
                fields = fields + weight[:, None] * np.einsum("nlf,nl->nf", self._polynomials(*at), powers)
            with np.errstate(invalid="ignore"):
                error = np.abs(_sigmas(np.asarray(fields)) - exact) <= _TOLERANCE * exact.max(axis=0) + 1e-12
            if error[np.isfinite(exact).all(axis=1)].all():
                return spacing
        return 1

    # -- tiles -------------------------------------------------------------------------------------------------------

    def make(self, left: int, top: int, width: int, height: int) -> NDArray[np.float32]:
        """Return the bands ``(4, height, width)`` of a tile, and count it in."""
        bands = np.full((len(BANDS), height, width), np.nan, dtype=np.float32)
        self._fill(left, top, self.spacing, bands)
        self._count(left, top, bands)
        return _rounded(bands)

    def _fill(self, left: int, top: int, spacing: int, bands: NDArray[np.float32]) -> None:
        """Fill the bands ``(4, height, width)`` of a tile."""
        _, height, width = bands.shape
        if spacing == 1 and max(width, height) > _EXACT_TILE:
            for column in range(0, width, _EXACT_TILE):
                for row in range(0, height, _EXACT_TILE):
                    tile = bands[:, row : row + _EXACT_TILE, column : column + _EXACT_TILE]
                    self._fill(left + column, top + row, spacing, tile)
            return
        nodes, samples, pixels = self._nodes(left, top, width, height, spacing)
        if spacing > 1 and not np.isfinite(nodes).all():
            # Where the model ends between nodes, every pixel is one.
            self._fill(left, top, 1, bands)
            return
        for row, column, nj, ni in self._pieces(samples, height, width, spacing):
            j, i = row // spacing, column // spacing
            part = (slice(j, j + -(-nj // spacing) + 1), slice(i, i + -(-ni // spacing) + 1))
            here = (slice(row, row + nj), slice(column, column + ni))
            accuracy_kernel.fill(
                Nodes(nodes[part], samples[part], pixels[part], spacing, self.middle, self.half),
                self._heights(_with_rim(samples[part], spacing)),
                self.budget.even,
                (float(self.size[0]), float(self.size[1])),
                radii(),
                bands[(slice(None), *here)],
                self.totals,
            )

    def _pieces(self, samples: Array, height: int, width: int, spacing: int) -> Iterator[tuple[int, int, int, int]]:
        """Yield the pieces (row, column, rows, columns) of a tile whose windows of heights fit into the memory."""
        side = _TILE
        while side > spacing and self._bytes(samples, side, height, width) > self.memory:
            side //= 2
        for row in range(0, height, side):
            for column in range(0, width, side):
                yield row, column, min(side, height - row), min(side, width - column)

    def _bytes(self, samples: Array, side: int, height: int, width: int) -> float:
        """Return what the windows under a piece of a tile take, about."""
        finite = samples[np.isfinite(samples).all(axis=(2, 3))]
        if not len(finite):
            return 0.0
        share = min(1.0, side / height) * min(1.0, side / width)
        return float(8 * share * np.ptp(finite, axis=0).prod(axis=0).sum())

    def _heights(self, samples: Array) -> PixelHeights:
        """Return the heights under some nodes, and how good they are."""
        dem, sigma, datum = _window(self.surface, samples[..., 0]), self.budget.heights, self.budget.datum**2
        if isinstance(sigma, Surface):
            return PixelHeights(dem, _window(sigma, samples[..., 1]), -1.0, datum)
        return PixelHeights(dem, dem, float(sigma or 0.0), datum)

    def _count(self, left: int, top: int, bands: NDArray[np.float32]) -> None:
        _, height, width = bands.shape
        first = (-top) % self.stride, (-left) % self.stride
        east, north, rho = bands[:3, first[0] :: self.stride, first[1] :: self.stride].astype(float).reshape(3, -1)
        taken = np.stack([east**2, north**2, rho * east * north], axis=1)
        self.taken.append(taken[np.isfinite(taken).all(axis=1)])
        rows, columns = (top + np.arange(height)) // self.cell, (left + np.arange(width)) // self.cell
        accuracy_kernel.gather(bands[3], rows, columns, self.sums)

    def result(self) -> AccuracyResult:
        """Return what all tiles come to."""
        taken, totals = np.concatenate(self.taken), self.totals
        count = totals[6]
        with np.errstate(invalid="ignore", divide="ignore"):
            cells = self.sums[..., 0] / self.sums[..., 1]
            parts = totals[:4] / totals[:4].sum()
            sigma = np.sqrt(totals[4:6] / count)
        some = len(taken) > 0
        quantiles = np.quantile(circular_error(taken), (0.05, 0.5, 0.95)) if some else np.full(3, math.nan)
        return AccuracyResult(
            ce90=circular_error_of_all(taken[:: max(1, len(taken) // _MIXED)]) if some else math.nan,
            quantiles=(float(quantiles[0]), float(quantiles[1]), float(quantiles[2])),
            sigma=(float(sigma[0]), float(sigma[1])),
            shares={name: float(part) for name, part in zip(Parts._fields, parts, strict=True)},
            cells=cells,
            cell=self.cell,
            known=float(count / totals[7]) if totals[7] else 0.0,
        )


def _rounded(bands: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return bands to one part in 2000, which is more than anybody knows of an accuracy and packs in half the time."""
    bits = bands.view(np.uint32)
    # NumPy's NaN has none of the bits that go.
    bits += np.uint32(1 << 12)
    bits &= np.uint32(0xFFFFE000)
    return bands


def _with_rim(samples: Array, spacing: int) -> Array:
    """Return places about samples ``(rows, columns, 2, k)`` of nodes, half a pixel farther out, for slopes."""
    steps = np.stack([samples[-1, 0] - samples[0, 0], samples[0, -1] - samples[0, 0]])
    half = np.abs(steps) / (2 * spacing * np.reshape(np.subtract(samples.shape[:2], 1), (2, 1, 1)))
    rim = np.nan_to_num(half.sum(axis=0))
    return np.concatenate([samples - rim, samples + rim])


def _window(surface: Surface, samples: Array) -> DemWindow:
    """Return the heights under nodes ``(rows, columns, 2)``; void where there are none."""
    window = surface.window_under(samples.reshape(-1, 2))
    if window is None:
        return DemWindow(np.full((2, 2), np.nan), 0, 0, False)
    left, top, right, bottom = window
    return DemWindow(surface.window(left, top, right - left, bottom - top), left, top, False)


def _sigmas(fields: Array) -> Array:
    """Return what the interpolation of fields ``(n, 10)`` has to keep: deviations by the model and the displacement."""
    with np.errstate(invalid="ignore"):
        return np.concatenate([np.sqrt(np.maximum(fields[:, :2], 0.0)), np.abs(fields[:, 3:5])], axis=1)
