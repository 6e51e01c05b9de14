"""Angles of view and of the sun at each pixel of an ortho, and shadows.

Azimuths are clockwise from true north, towards sensor and sun, whatever the map; zenith angles are from the ellipsoid's
normal, and the sun's incidence is from the normal of the terrain over a pixel of the layer. The sun has one direction
for the whole scene. Refraction is ignored.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.distortion import inverse_2x2
from ortho_pipeline.models.base import Array
from ortho_pipeline.raster.ortho import Profile, RasterWriter, classes_profile
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.rays import levels, polynomials
from ortho_pipeline.warp.quality.accuracy import layer_grid, overviews, tiles
from ortho_pipeline.warp.quality.hiding import of_classes
from ortho_pipeline.warp.quality.sight import Sight
from ortho_pipeline.warp.quality.visibility import Visibility
from ortho_pipeline.warp.quality.visibility_kernel import HIDDEN, VOID

#: Classes of the mask of shadows by value; 0 means no value.
LIT, SHADED, WITHOUT = 1, 2, 4
#: Side of a tile of the layer and of the mask, and spacing of nodes in pixels of the layer.
_TILE, _MASK_TILE, _SPACING = 256, 1024, 16
_LEVELS = 3


@dataclass(frozen=True)
class Sun:
    """Position of the sun in degrees: azimuth from true north, elevation above the horizon.

    Raises
    ------
    InputError
        If it is not above the horizon.
    """

    azimuth_deg: float
    elevation_deg: float

    def __post_init__(self) -> None:
        if not (0.0 < self.elevation_deg <= 90.0 and abs(self.azimuth_deg) <= 360.0):
            raise InputError(
                f"azimuth {self.azimuth_deg:g} and elevation {self.elevation_deg:g} degrees are not a valid "
                f"position of the sun",
                field="output.sun",
                remedy="give the azimuth from north and an elevation above 0, in degrees",
            )

    @property
    def way(self) -> Array:
        """Metres true east and north ``(2,)`` of a line to the sun per metre of height."""
        bearing, tangent = math.radians(self.azimuth_deg), 1.0 / math.tan(math.radians(self.elevation_deg))
        return tangent * np.array([math.sin(bearing), math.cos(bearing)])

    def way_over(self, sight: Sight) -> Callable[[Array, Array, Array], Array]:
        """Return a function from output positions and heights to output pixels ``(n, 2)`` per metre of height."""
        return lambda columns, rows, heights: inverse_2x2(sight.metres(columns, rows, heights)) @ self.way


@dataclass(frozen=True)
class AnglesResult:
    """Smallest and largest zenith angle of view (degrees) within the image; NaN if there is none."""

    view_zenith_deg: tuple[float, float]


# -- angles ----------------------------------------------------------------------------------------------------------


def write_angles(
    sight: Sight,
    surface: Surface,
    size: tuple[int, int],
    path: str | os.PathLike[str],
    *,
    heights: tuple[float, float],
    step: int,
    sun: Sun | None = None,
    resources: Resources | None = None,
) -> AnglesResult:
    """Write zenith and azimuth of view, and the sun's incidence, for the ortho on the grid of `sight` as a COG.

    Bands: view_zenith, view_azimuth and (with a sun) sun_incidence, degrees; NaN outside the image.

    Parameters
    ----------
    size : (int, int)
        Columns and rows of the image.
    heights : (float, float)
        Approximate lowest and highest ground of the scene.
    step : int
        Pixels of the ortho per pixel of the layer, per side.
    """
    grid = layer_grid(sight.grid, step)
    own, names = sight.on(grid), ["view_zenith", "view_azimuth", *(["sun_incidence"] if sun else [])]
    profile = Profile(
        count=len(names),
        dtype=np.dtype(np.float32),
        validity="nodata",
        nodata=math.nan,
        descriptions=tuple(names),
        interpretations=(0,) * len(names),
        scales=((1.0, 0.0, "degree"),) * len(names),
        metadata=_metadata(sun),
    )
    low, high = math.inf, -math.inf
    options = {"LEVEL": "1", **overviews(grid)}
    threads = (resources or Resources()).threads or 1
    with RasterWriter(path, grid, profile, creation_options=options, threads=threads) as writer:
        for left, top, width, height in tiles(grid, _TILE):
            bands = _angles(own, surface, size, heights, (left, top, width, height), sun)
            if np.isfinite(bands[0]).any():
                low, high = min(low, float(np.nanmin(bands[0]))), max(high, float(np.nanmax(bands[0])))
            writer.write(left, top, bands.astype(np.float32), None)
    return AnglesResult((low, high) if low <= high else (math.nan, math.nan))


def _metadata(sun: Sun | None) -> Mapping[str, str]:
    if sun is None:
        return {}
    return {"SUN_AZIMUTH": f"{sun.azimuth_deg:.10g}", "SUN_ELEVATION": f"{sun.elevation_deg:.10g}"}


def _angles(
    sight: Sight,
    surface: Surface,
    size: tuple[int, int],
    heights: tuple[float, float],
    window: tuple[int, int, int, int],
    sun: Sun | None,
) -> Array:
    """Return the bands ``(n, height, width)`` of a window (left, top, width, height) of a layer."""
    left, top, width, height = window
    columns, rows = np.meshgrid(left + 0.5 + np.arange(width), top + 0.5 + np.arange(height))
    flat = columns.ravel(), rows.ravel()
    middle, half = sum(heights) / 2, max((heights[1] - heights[0]) / 2, 1.0)
    ground = surface.heights(np.stack(sight.grid.xy(*flat), axis=1), sight.grid.crs)
    fields = _between(sight, window, middle, half)
    t = ((ground - middle) / half).reshape(height, width, 1)
    image = (fields[..., 0, :2] + t * (fields[..., 1, :2] + t * fields[..., 2, :2])).reshape(-1, 2)
    lean = (fields[..., 0, 2:] + t * (fields[..., 1, 2:] + t * fields[..., 2, 2:])).reshape(-1, 2)
    metres = sight.metres(*flat, ground)
    east, north = np.einsum("nij,nj->in", metres, lean)
    # A ray goes against the displacement; a vertical ray has no azimuth.
    found = [np.degrees(np.arctan(np.hypot(east, north))), np.degrees(np.arctan2(-east, -north)) % 360.0]
    if sun is not None:
        found.append(_incidence(sight, surface, flat, metres, sun.way))
    bands = np.stack(found)
    with np.errstate(invalid="ignore"):
        bands[:, ~((image >= 0) & (image <= size)).all(axis=1)] = math.nan
    return bands.reshape(len(found), height, width)


def _between(sight: Sight, window: tuple[int, int, int, int], middle: float, half: float) -> Array:
    """Return image points and displacements ``(height, width, levels, 4)`` as polynomials in the normalised height."""
    left, top, width, height = window
    across, down = (np.arange(-(-side // _SPACING) + 1) * _SPACING for side in (width, height))
    nodes = _nodes(sight, left + 0.5 + across, top + 0.5 + down, middle, half)
    if not np.isfinite(nodes).all():
        # If the model ends between nodes, evaluate every pixel.
        return _nodes(sight, left + 0.5 + np.arange(width), top + 0.5 + np.arange(height), middle, half)
    by_row, by_column = (_weights(side) for side in (height, width))
    return np.asarray(np.einsum("rj,jikf,ci->rckf", by_row, nodes, by_column, optimize=True))


def _nodes(sight: Sight, across: NDArray[Any], down: NDArray[Any], middle: float, half: float) -> Array:
    """Return image points and displacements at nodes ``(rows, columns, levels, 4)``."""
    columns, rows = np.meshgrid(across, down)
    count = columns.size
    at = np.repeat(middle + half * levels(_LEVELS), count)
    seen = sight.seen(np.tile(columns.ravel(), _LEVELS), np.tile(rows.ravel(), _LEVELS), at)
    values = np.concatenate([seen.image, seen.displacement], axis=1).reshape(_LEVELS, count, 4).swapaxes(0, 1)
    return polynomials(values).reshape(len(down), len(across), _LEVELS, 4)


def _weights(count: int) -> Array:
    """Return the weights ``(count, nodes)`` of nodes in linear interpolation."""
    place = np.arange(count) / _SPACING
    nodes = np.arange(-(-count // _SPACING) + 1)
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - nodes))


def _incidence(sight: Sight, surface: Surface, flat: tuple[Array, Array], metres: Array, way: Array) -> Array:
    """Return the angle (degrees) between the sun and the normal of the terrain over a pixel."""
    columns, rows = flat

    def at(column: float, row: float) -> Array:
        return surface.heights(np.stack(sight.grid.xy(columns + column, rows + row), axis=1), sight.grid.crs)

    rise = np.stack([at(0.5, 0.0) - at(-0.5, 0.0), at(0.0, 0.5) - at(0.0, -0.5)], axis=1)
    slope = np.einsum("ni,nij->nj", rise, inverse_2x2(metres))
    cosine = (1.0 - slope @ way) / np.sqrt((1.0 + (slope**2).sum(axis=1)) * (1.0 + way @ way))
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


# -- shadows ---------------------------------------------------------------------------------------------------------


def write_shadows(
    sight: Sight,
    surface: Surface,
    sun: Sun,
    path: str | os.PathLike[str],
    *,
    heights: tuple[float, float],
    resources: Resources | None = None,
    driver: str = "COG",
) -> float:
    """Write the pixels of the ortho that are in shadow (their own, or of other terrain); return the share of shadow.

    Byte: 1 in the sun, 2 in shadow, 4 without a height. The line from the pixel to the sun is traced over the surface,
    like lines of sight (`visibility`).
    """
    resources = resources or Resources()
    grid = sight.grid
    looking = Visibility(sight, surface, heights, resources.memory // 4, way=sun.way_over(sight))
    names = {LIT: ("in the sun", "#f7ecc9"), SHADED: ("in shadow", "#34506e"), WITHOUT: ("without a height", "#6b6b6b")}
    profile = classes_profile("shadow", names, _metadata(sun))
    counts = np.zeros(5, dtype=np.int64)
    options, threads = of_classes(driver), resources.threads or 1
    with RasterWriter(path, grid, profile, driver=driver, creation_options=options, threads=threads) as writer:
        for left, top, width, height in tiles(grid, _MASK_TILE):
            classes = _classes(looking.look(left, top, width, height))
            counts += np.bincount(classes.ravel(), minlength=5)
            writer.write(left, top, classes[None], None)
    return float(counts[SHADED] / max(counts[LIT] + counts[SHADED], 1))


def _classes(found: NDArray[np.uint8]) -> NDArray[np.uint8]:
    classes = np.full(found.shape, LIT, dtype=np.uint8)
    classes[found == HIDDEN], classes[found == VOID] = SHADED, WITHOUT
    return classes
