"""Where a scene lies: its footprint on the surface, how much of it the DEM covers, and the output grid that follows.

The extent never comes from the DEM alone: where the ray of a border pixel leaves the DEM, both ends of the model's
height range stand in, so a DEM that covers half the scene cannot cut the ortho in half or change its pixel size.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyproj

from ortho_pipeline.crs import GroundTransform, ground_transform, utm_crs
from ortho_pipeline.dem import Surface
from ortho_pipeline.errors import CoverageError, InputError, ModelError
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster import Grid
from ortho_pipeline.rays import intersect

#: Points per side of the image at which the DEM is asked for.
_COVERAGE_SIDE = 33
_BORDER_SIDE = 65
#: Samples of the DEM per side of the blocks in which voids are counted.
_BLOCK = 1024


def image_grid(width: int, height: int, side: int) -> Array:
    """Return ``(side * side, 2)`` image points spread over the image, its border included."""
    columns, rows = np.meshgrid(np.linspace(0, width, side), np.linspace(0, height, side))
    return np.column_stack([columns.ravel(), rows.ravel()])


def border(width: int, height: int, side: int = _BORDER_SIDE) -> Array:
    """Return the border of the image as a closed ring of image points ``(4 * side + 1, 2)``."""
    step = np.arange(side) / side
    zero, one = np.zeros(side), np.ones(side)
    ring = np.concatenate(
        [
            np.column_stack([step, zero]),
            np.column_stack([one, step]),
            np.column_stack([1 - step, one]),
            np.column_stack([zero, 1 - step]),
            np.zeros((1, 2)),
        ]
    )
    return ring * (float(width), float(height))


def facing(model: SensorModel, surface: Surface, width: int, height: int) -> Surface:
    """Return the surface with the seam of a global DEM opposite to the scene; any other surface unchanged."""
    if surface.constant_height is not None:
        return surface
    centre = ground_transform(model.crs, "EPSG:4979")(_centre(model, width, height))
    return surface.around(float(centre[0, 0]))


def coverage(model: SensorModel, surface: Surface, width: int, height: int) -> float:
    """Return the share (0 to 1) of the scene's footprint for which the DEM has a height, by a grid of rays.

    Fill rules of the surface do not count: it is what the DEM itself covers. A void between the rays is not seen
    here but by `voids`.
    """
    if surface.constant_height is not None:
        return 1.0
    surface = facing(model, surface, width, height)
    image = image_grid(width, height, _COVERAGE_SIDE)
    ground = intersect(model, image, surface)
    met = np.isfinite(ground).all(axis=1)
    projects = met | np.isfinite(model.image_to_ground(image, model.reference_height)).all(axis=1)
    if not projects.any():
        raise ModelError("no image point meets the ground: the model does not belong to this image")
    own = surface.coverage(ground[met, :2], model.crs)
    return own * float(met.sum() / projects.sum())


@dataclass(frozen=True)
class Voids:
    """Samples of the DEM without a height within the footprint: how many, and their share (0 to 1) of it."""

    count: int
    share: float


def voids(model: SensorModel, surface: Surface, width: int, height: int) -> Voids:
    """Count every sample of the DEM within the footprint that has no height of its own, whatever the fill rule.

    Where rays leave the DEM, the convex hull of both ends of the height range stands for the footprint.
    """
    if surface.constant_height is not None:
        return Voids(0, 0.0)
    import shapely

    surface = facing(model, surface, width, height).with_fill("mask")
    ground = ground_transform(model.crs, surface.crs)(footprint(model, surface, width, height))
    samples = surface.samples_at(ground[:, :2])
    outline = shapely.Polygon(samples)
    if len(samples) != len(border(width, height)) or not outline.is_valid:
        outline = shapely.MultiPoint(samples).convex_hull
    shapely.prepare(outline)
    left, top, right, bottom = (int(value) for value in (*np.floor(outline.bounds[:2]), *np.ceil(outline.bounds[2:])))
    count = 0
    for v in range(top, bottom + 1, _BLOCK):
        for u in range(left, right + 1, _BLOCK):
            heights = surface.window(u, v, min(_BLOCK, right + 1 - u), min(_BLOCK, bottom + 1 - v))
            rows, columns = np.nonzero(np.isnan(heights))
            if len(rows):
                count += int(shapely.contains_xy(outline, columns + u, rows + v).sum())
    return Voids(count, min(1.0, count / max(outline.area, 1.0)))


def require_coverage(share: float, surface: Surface) -> None:
    """Raise a `CoverageError` if the DEM does not cover the scene and nothing was said about the rest.

    Raises
    ------
    CoverageError
        If `share` is below 1 and the surface has no fill rule.
    """
    if share < 1.0 and surface.fill == "error":
        raise CoverageError(
            f"the DEM covers {math.floor(share * 1000) / 10:.1f} % of the scene",
            file=surface.provenance.get("path"),
            remedy="give a DEM that covers it all, or say what the rest shall be: --dem-fill mask (no pixels there), "
            "nearest, or an ellipsoidal height in metres",
        )


def output_crs(model: SensorModel, width: int, height: int) -> pyproj.CRS:
    """Return the WGS84 UTM zone of the scene's centre."""
    centre = _centre(model, width, height)
    geographic = ground_transform(model.crs, "EPSG:4979")(centre)[0]
    return utm_crs(float(geographic[0]), float(geographic[1]))


def ground_sample_distance(model: SensorModel, crs: pyproj.CRS, width: int, height: int) -> float:
    """Return the side of a pixel on the ground at the model's reference height, in units of `crs`.

    The geometric mean of both axes in the middle of the image: it knows nothing of the DEM, so the resolution of an
    ortho does not either.
    """
    middle = np.array([width, height]) / 2
    image = middle + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    ground = ground_transform(model.crs, crs)(model.image_to_ground(image, model.reference_height))
    across, down = ground[1, :2] - ground[0, :2], ground[3, :2] - ground[2, :2]
    area = abs(across[0] * down[1] - across[1] * down[0])
    if not (np.isfinite(area) and area > 0):
        raise ModelError("the model has no ground sample distance in the middle of the image")
    return math.sqrt(area)


def two_digits(value: float) -> float:
    """Round to two significant digits."""
    return float(f"{value:.1e}")


def footprint(model: SensorModel, surface: Surface, width: int, height: int) -> Array:
    """Return the border of the image on the ground ``(N, 3)``, in the model's CRS; all rows finite.

    Points on the surface, and where a ray leaves the DEM, points at both ends of the model's height range.
    """
    ring = border(width, height)
    ground = intersect(model, ring, facing(model, surface, width, height))
    lost = ~np.isfinite(ground).all(axis=1)
    parts = [ground]
    if lost.any():
        parts += [model.image_to_ground(ring[lost], level) for level in model.height_range]
    everything = np.concatenate(parts)
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything):
        raise ModelError("no border pixel meets the ground: the model does not belong to this image")
    return everything


def choose_grid(
    model: SensorModel,
    surface: Surface,
    size: tuple[int, int],
    *,
    crs: pyproj.CRS | None = None,
    resolution: float | Sequence[float] | None = None,
    extent: Sequence[float] | None = None,
    align: bool = False,
) -> Grid:
    """Return the output grid of a scene.

    Parameters
    ----------
    size : (int, int)
        Columns and rows of the image.
    crs : pyproj.CRS, optional
        Default: the UTM zone of the scene's centre.
    resolution : float or (float, float), optional
        In units of `crs`, one number or x and y. Default: the ground sample distance, to two significant digits.
    extent : xmin, ymin, xmax, ymax, optional
        Taken as it is, or widened to whole multiples of the resolution with `align`. Default: the footprint, widened.

    Raises
    ------
    InputError
        If extent or resolution make no grid.
    """
    width, height = size
    crs = crs or output_crs(model, width, height)
    if resolution is None:
        resolution = two_digits(ground_sample_distance(model, crs, width, height))
    step = (resolution, resolution) if isinstance(resolution, int | float) else (resolution[0], resolution[1])
    if extent is not None:
        return Grid.of_extent(crs, extent, step, align=align)
    ground = _continuous(GroundTransform(model.crs, crs)(footprint(model, surface, width, height)), crs)
    if not np.isfinite(ground).any():
        raise InputError(
            f"the scene does not lie in the domain of {crs.name!r}", field="--output-crs", remedy="choose another CRS"
        )
    low, high = np.nanmin(ground, axis=0), np.nanmax(ground, axis=0)
    return Grid.of_extent(crs, (low[0], low[1], high[0], high[1]), step, align=True)


def _continuous(ground: Array, crs: pyproj.CRS) -> Array:
    """Unwrap longitudes across the antimeridian about the first point."""
    if crs.is_geographic and len(ground):
        ground = ground.copy()
        ground[:, 0] = ground[0, 0] + np.remainder(ground[:, 0] - ground[0, 0] + 180.0, 360.0) - 180.0
    return ground


def _centre(model: SensorModel, width: int, height: int) -> Array:
    centre = model.image_to_ground(np.array([[width / 2, height / 2]]), model.reference_height)
    if not np.isfinite(centre).all():
        raise ModelError(
            "the middle of the image does not meet the ground: the model does not belong to this image",
            remedy="give the metadata of this very image, and points that were measured in it; "
            "if they are, its plugin reads them wrongly (docs/plugins.md)",
        )
    return centre
