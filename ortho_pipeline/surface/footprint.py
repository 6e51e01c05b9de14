"""The footprint of a scene on the surface, its coverage by the DEM, and the output grid.

Heights come from the surface under the scene. The extent never comes from the DEM alone: where the ray of a border
pixel leaves the DEM, both ends of the range of heights replace it. So a DEM that covers half the scene cannot cut the
ortho in half.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import share, significant
from ortho_pipeline.errors import CoverageError, InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs, utm_crs
from ortho_pipeline.geodesy.ellipsoid import geocentric, longitudes_near
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.dem import DemSurface
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.rays import meet_surface, refuse_camera_below

#: Sample points per side of the image for the coverage by the DEM.
_COVERAGE_SIDE = 33
_BORDER_SIDE = 65
#: Samples of the DEM per side of the blocks in which voids are counted.
_BLOCK = 1024
#: Margin of the heights under a scene for its model: part of their range, and least margin (m).
_MARGIN, _LEAST_MARGIN = 0.1, 10.0
#: No map enlarges a scene so much: parts of it lie on both sides of the map.
_TORN = 50.0
_SOUND = Text(
    "give the metadata of this image (",
    Setting("scene.rpc", "FILE"),
    ", ",
    Setting("scene.model", "FILE"),
    ") and points measured in it; if they are right, the plugin reads them wrongly (docs/plugins.md)",
)


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
    if isinstance(surface, FlatSurface):
        return surface
    centre = ground_transform(model.crs, "EPSG:4979")(_centre(model, width, height))
    return surface.around(float(centre[0, 0]))


@dataclass(frozen=True, eq=False)
class Footprint:
    """The footprint of a scene on a surface, and its heights; from `lay`.

    Parameters
    ----------
    surface : Surface
        With the seam of a global DEM opposite to the scene.
    ring : (N, 3)
        The border of the image on the ground, in the model's CRS: on the surface, or where a ray leaves the DEM, at the
        height `middle`. Rays that do not meet the ground are omitted.
    reach : (M, 3)
        Ground that the image may show: `ring`, and the lost rays at both ends of `heights`.
    heights : (float, float)
        Lowest and highest ellipsoidal height (m) of the surface under the scene; the model's range if no ray meets the
        surface.
    middle : float
        Height (m) of the ground in the middle of the image.
    coverage : float
        Share (0 to 1) of the scene's area on the ground with heights of the surface, without filled ones. A ray that
        meets no height continues to `middle`.
    complete : bool
        Whether every ray met the surface at a height that is not filled; there may be small voids between the rays.
    voids : int
        Samples of the DEM within the scene that have no height.
    unmet : bool
        Whether a ray that meets the ground somewhere met no height of the surface, not even a filled one.
    beyond : str
        Heights of the surface at which the model does not project, as a sentence; empty if there are none.
    """

    surface: Surface
    ring: Array
    reach: Array
    heights: tuple[float, float]
    middle: float
    coverage: float = 1.0
    complete: bool = True
    voids: int = 0
    unmet: bool = False
    beyond: str = ""

    def require_coverage(self) -> None:
        """Raise an error if the surface does not cover the scene and has no fill rule.

        Raises
        ------
        CoverageError
            If a ray met no height and the surface has no fill rule.
        """
        surface = self.surface
        if not isinstance(surface, DemSurface):
            return  # flat ground is everywhere
        file = surface.provenance.get("path")
        choice = Text("choose how to fill the rest: ", Setting("surface.fill", "mask"), " (no pixels there)")
        if self.beyond and ((surface.fill == "error" and not self.complete) or not self.coverage):
            raise CoverageError(
                self.beyond,
                file=file,
                field="surface.dem",
                remedy=Text(
                    "check the height datum and unit of the DEM (",
                    Setting("surface.vertical"),
                    ") and the position of the scene, or ",
                    choice,
                ),
            )
        if not self.complete and surface.fill == "error":
            raise CoverageError(
                f"the DEM covers {share(self.coverage)} of the scene",
                file=file,
                remedy=Text(
                    "give a DEM that covers the whole scene, or ",
                    choice,
                    ", nearest, or an ellipsoidal height in metres",
                )
                if self.coverage
                else "check the CRS of the DEM, or give a DEM of this place",
            )
        if self.coverage == 0.0 and surface.fill == "mask":
            raise CoverageError(
                "the DEM does not cover the scene: the ortho would have no pixels",
                file=file,
                field="surface.dem",
                remedy="give a DEM of this place",
            )
        if self.unmet and surface.fill == "nearest":
            reach = significant(surface.nearest_reach * surface.sample_size / 1000, 3)
            raise CoverageError(
                f"parts of the scene are more than {reach} km from the nearest height of the DEM",
                file=file,
                field="surface.fill",
                remedy=Text("give a larger DEM, or ", choice),
            )

    def notes(self) -> list[Notice]:
        """Return a notice if the DEM does not cover the scene as a whole, or only with heights beyond the model."""
        texts = [f"{self.beyond}: these places have no pixels"] if self.beyond else []
        if self.coverage < 1.0:
            what = "has no pixels in the ortho" if self.surface.fill in ("error", "mask") else "was filled"
            inside = f" ({counted(self.voids, 'sample')} without a height inside it)" if self.voids else ""
            texts.append(f"the DEM covers {share(self.coverage)} of the scene{inside}: the rest {what}")
        return [Notice("dem-covers-part", "; ".join(texts), coverage=self.coverage)] if texts else []

    def fitted(self, model: SensorModel) -> SensorModel:
        """Return the model, meant for the heights here and a margin, where its own range is no more than a guess."""
        if self.heights == model.height_range:
            return model
        low, high = self.heights
        margin = max(_LEAST_MARGIN, _MARGIN * (high - low))
        return model.with_heights(low - margin, high + margin)


def lay(model: SensorModel, surface: Surface, width: int, height: int) -> Footprint:
    """Lay a scene on a surface.

    Raises
    ------
    InputError
        If no border pixel meets the ground.
    """
    surface = facing(model, surface, width, height)
    footprint, met, projects = _laid(model, surface, width, height)
    if not len(footprint.reach):
        raise _nowhere(model, surface)
    footprint = replace(footprint, beyond=_beyond(model, surface, footprint))
    if not isinstance(surface, DemSurface):
        return footprint
    unmet = bool((projects & ~met).any())
    ring = footprint.ring
    if surface.fill not in ("error", "mask"):  # the fill does not change the coverage
        surface = surface.with_fill("mask")
        bare, met, projects = _laid(model, surface, width, height)
        ring = bare.ring
    own = met.sum() / max(projects.sum(), 1)
    if not own:
        refuse_camera_below(model, surface, surface.provenance.get("path"))
    voids, area, sampled = _voids(model, surface, ring)
    # Use the finer of both samples; if a ray meets no height, the DEM does not cover all.
    fine = area > _COVERAGE_SIDE**2 and (sampled < 1.0 or own >= 1.0)
    covered = sampled if fine else min(own, sampled)
    return replace(footprint, coverage=float(covered), complete=bool(own >= 1.0), voids=voids, unmet=unmet)


def _laid(
    model: SensorModel, surface: Surface, width: int, height: int
) -> tuple[Footprint, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the footprint of a scene, and which rays of a grid over the image meet a height, and which can meet one.

    The last two are ``(n,)``; a ray can meet a height if it meets the ground at all.
    """
    ring = border(width, height)
    image = np.concatenate([image_grid(width, height, _COVERAGE_SIDE), ring])
    ground = meet_surface(model, image, surface)
    met = np.asarray(np.isfinite(ground).all(axis=1), dtype=bool)
    heights, middle = _heights_under(model, surface, ground, met)
    inner, outer = slice(len(image) - len(ring)), slice(len(image) - len(ring), None)
    lost = outer.start + np.flatnonzero(~met[outer])
    ground[lost] = model.image_to_ground(image[lost], middle)
    closed = ground[outer]
    ends = [model.image_to_ground(image[lost], level) for level in heights] if len(lost) else []
    reach = np.concatenate([closed, *ends])
    projects = met[inner] | np.isfinite(model.image_to_ground(image[inner], middle)).all(axis=1)
    return Footprint(surface, _finite(closed), _finite(reach), heights, middle), met[inner], projects


def _nowhere(model: SensorModel, surface: Surface) -> InputError:
    """Return the error for a scene without any pixel that meets the ground."""
    low, high = model.height_range
    if not isinstance(surface, FlatSurface) or low <= surface.height <= high:
        return InputError(
            "no pixel at the image border meets the ground: the model does not belong to this image",
            field="model",
            remedy=_SOUND,
        )
    return InputError(
        f"the scene does not meet the ground at a height of {surface.height:g} m",
        field="surface.height",
        remedy=f"give an ellipsoidal height of the terrain; the model is valid from {low:.0f} to {high:.0f} m",
    )


def _beyond(model: SensorModel, surface: Surface, footprint: Footprint) -> str:
    """Return a sentence if the surface has heights under a scene that its model does not project; empty if not."""
    low, high = model.height_limits
    if not (math.isfinite(low) or math.isfinite(high)):
        return ""
    lowest, highest = footprint.heights
    with contextlib.suppress(CoverageError):
        lowest, highest = surface.range_under(footprint.reach, model.crs)
    if low <= lowest and highest <= high:
        return ""
    return (
        f"heights under the scene are {lowest:.0f} to {highest:.0f} m above the ellipsoid, its model is good for "
        f"{low:.0f} to {high:.0f} m"
    )


def _finite(ground: Array) -> Array:
    return ground[np.isfinite(ground).all(axis=1)]


def _heights_under(
    model: SensorModel, surface: Surface, ground: Array, met: NDArray[np.bool_]
) -> tuple[tuple[float, float], float]:
    """Return the range of heights under a scene, and the height at which the middle of the image is seen."""
    if isinstance(surface, FlatSurface):
        return surface.height_range, surface.height
    if not met.any():
        return model.height_range, model.reference_height
    seen = ground[met]
    low, high = float(seen[:, 2].min()), float(seen[:, 2].max())
    # Peaks and hollows between the rays count too.
    with contextlib.suppress(CoverageError):  # all of it filled
        lowest, highest = surface.range_under(seen, model.crs)
        low, high = min(low, lowest), max(high, highest)
    centre = _COVERAGE_SIDE**2 // 2
    return (low, high), float(ground[centre, 2] if met[centre] else np.median(seen[:, 2]))


def _voids(model: SensorModel, surface: DemSurface, ring: Array) -> tuple[int, float, float]:
    """Count the samples of the DEM within a footprint that have no height; both are without a fill.

    Returns
    -------
    (int, float, float)
        Their number, the area of the footprint in samples, and its share that has heights: none beyond the DEM.
    """
    import shapely

    rows, columns = surface.shape
    samples = surface.sampler(model.crs)(ring)
    outline = shapely.Polygon(samples)
    # Without the rays that do not meet the ground the ring is open.
    if len(ring) <= 4 * _BORDER_SIDE or not outline.is_valid:
        outline = shapely.MultiPoint(samples).convex_hull
    inside = shapely.intersection(outline, shapely.box(0, 0, columns - 1, rows - 1))
    if inside.is_empty or outline.area == 0:
        return 0, 0.0, 1.0  # only the rays count
    beyond = 0.0 if shapely.equals(inside, outline) else 1.0 - inside.area / outline.area
    shapely.prepare(inside)
    left, top, right, bottom = (int(value) for value in (*np.floor(inside.bounds[:2]), *np.ceil(inside.bounds[2:])))
    void = total = 0
    for v in range(top, bottom + 1, _BLOCK):
        for u in range(left, right + 1, _BLOCK):
            nu, nv = min(_BLOCK, right + 1 - u), min(_BLOCK, bottom + 1 - v)
            heights = surface.window(u, v, nu, nv)
            empty, within = np.isnan(heights), np.ones((nv, nu), dtype=bool)
            if not shapely.contains(inside, shapely.box(u, v, u + nu - 1, v + nv - 1)):
                across, down = np.meshgrid(np.arange(u, u + nu), np.arange(v, v + nv))
                within = shapely.contains_xy(inside, across, down)
            void, total = void + int((empty & within).sum()), total + int(within.sum())
    return void, float(outline.area), (1.0 - beyond) * (1.0 - void / max(total, 1))


def output_crs(model: SensorModel, width: int, height: int) -> pyproj.CRS:
    """Return the WGS84 UTM zone of the scene's centre."""
    centre = _centre(model, width, height)
    geographic = ground_transform(model.crs, "EPSG:4979")(centre)[0]
    return utm_crs(float(geographic[0]), float(geographic[1]))


def ground_sample_distance(
    model: SensorModel, crs: pyproj.CRS, width: int, height: int, level: float | None = None
) -> float:
    """Return the side of a pixel on the ground, in units of `crs`: geometric mean of both axes, middle of the image.

    At the ellipsoidal height `level` (m), the model's reference height if there is none.
    """
    level = model.reference_height if level is None else level
    middle = np.array([width, height]) / 2
    image = middle + np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    ground = ground_transform(model.crs, crs)(model.image_to_ground(image, level))
    across, down = ground[1, :2] - ground[0, :2], ground[3, :2] - ground[2, :2]
    area = abs(across[0] * down[1] - across[1] * down[0])
    if not (np.isfinite(area) and area > 0):
        raise InputError(
            "the central pixel has no size on the ground: the model does not belong to this image",
            field="model",
            remedy=_SOUND,
        )
    return math.sqrt(area)


def two_digits(value: float) -> float:
    """Round to two significant digits."""
    return float(f"{value:.1e}")


def choose_grid(
    model: SensorModel,
    footprint: Footprint,
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
    footprint : Footprint
        The footprint of the scene.
    size : (int, int)
        Columns and rows of the image.
    crs : pyproj.CRS, optional
        Default: the UTM zone of the scene's centre.
    resolution : float or (float, float), optional
        In units of `crs`, one number or x and y. Default: the ground sample distance at the height of the middle of the
        image, to two significant digits.
    extent : xmin, ymin, xmax, ymax, optional
        Used unchanged, or with `align` widened to multiples of the resolution. Default: the footprint, widened.

    Raises
    ------
    InputError
        If extent or resolution give no grid.
    """
    width, height = size
    crs = crs or output_crs(model, width, height)
    if resolution is None:
        resolution = two_digits(ground_sample_distance(model, crs, width, height, footprint.middle))
    step = (resolution, resolution) if isinstance(resolution, int | float) else (resolution[0], resolution[1])
    if extent is not None:
        return Grid.of_extent(crs, extent, step, align=align)
    ground = _continuous(ground_transform(model.crs, crs)(footprint.reach), crs)
    if not np.isfinite(ground).any():
        raise InputError(
            f"the scene is outside the area of {crs.name!r}", field="output.crs", remedy="choose another CRS"
        )
    low, high = np.nanmin(ground, axis=0), np.nanmax(ground, axis=0)
    if not crs.is_geographic:
        place = geocentric(ground_transform(model.crs, parse_crs("EPSG:4326"))(footprint.reach) * (1.0, 1.0, 0.0))
        apart = (high - low)[:2] * [axis.unit_conversion_factor for axis in crs.axis_info[:2]]
        if np.hypot(*apart) > _TORN * np.linalg.norm(np.nanmax(place, axis=0) - np.nanmin(place, axis=0)):
            raise InputError(
                f"the edge of {crs.name!r} crosses the scene",
                field="output.crs",
                remedy="choose another CRS, such as UTM",
            )
    if (np.array(step) > (high - low)[:2]).all():
        raise InputError(
            f"a resolution of {step[0]:g} means {step[0]:g} {crs.axis_info[0].unit_name}s in {crs.name!r}; "
            "the whole scene is smaller than one pixel",
            field="output.resolution",
            remedy=_finer(model, crs, size, footprint.middle, step[0]),
        )
    return Grid.of_extent(crs, (low[0], low[1], high[0], high[1]), step, align=True)


def _finer(model: SensorModel, crs: pyproj.CRS, size: tuple[int, int], level: float, step: float) -> Text:
    """Return the remedy for a pixel larger than the scene; in degrees, `step` is probably metres."""
    own = ground_sample_distance(model, crs, *size, level)
    usual = f"the scene's own pixel is {_plain(own)}"
    if not crs.is_geographic:
        return Text("give a smaller ", Setting("output.resolution"), f": {usual}")
    in_metres = output_crs(model, *size)
    metres = ground_sample_distance(model, in_metres, *size, level)
    return Text(
        f"for {step:g} m give ",
        Setting("output.resolution", _plain(step * own / metres)),
        f" ({usual}, {two_digits(metres):g} m), or choose a CRS in metres with ",
        Setting("output.crs", f"EPSG:{in_metres.to_epsg()}"),
    )


def _plain(value: float) -> str:
    """Write two significant digits without an exponent."""
    return f"{two_digits(value):.12f}".rstrip("0").rstrip(".")


def scene_pixels(model: SensorModel, footprint: Footprint, grid: Grid) -> float:
    """Return how many pixels of a grid the scene covers, or a few more: those within the hull of what it may reach.

    Raises
    ------
    InputError
        If there are none: the extent does not overlap the scene.
    """
    import shapely

    ground = _continuous(ground_transform(model.crs, grid.crs)(footprint.reach), grid.crs)
    ground = ground[np.isfinite(ground).all(axis=1), :2]
    xmin, ymin, xmax, ymax = grid.extent
    if grid.crs.is_geographic and len(ground):
        ground[:, 0] += 360.0 * round(((xmin + xmax) / 2 - (ground[:, 0].min() + ground[:, 0].max()) / 2) / 360.0)
    hull = shapely.MultiPoint(ground).convex_hull
    if not len(ground) or not hull.intersects(shapely.box(xmin, ymin, xmax, ymax)):
        place = " ".join(f"{value:.10g}" for value in hull.bounds) if len(ground) else "no part of this CRS"
        raise InputError(
            f"the extent does not overlap the scene, which covers {place}",
            field="output.extent",
            remedy=Text(
                "give xmin ymin xmax ymax in units of the output CRS, or leave ", Setting("output.extent"), " out"
            ),
        )
    return float(hull.intersection(shapely.box(xmin, ymin, xmax, ymax)).area) / (grid.dx * grid.dy)


def _continuous(ground: Array, crs: pyproj.CRS) -> Array:
    """Unwrap longitudes across the antimeridian about the first point."""
    if crs.is_geographic and len(ground):
        ground = ground.copy()
        ground[:, 0] = longitudes_near(ground[:, 0], ground[0, 0])
    return ground


def _centre(model: SensorModel, width: int, height: int) -> Array:
    centre = model.image_to_ground(np.array([[width / 2, height / 2]]), model.reference_height)
    if not np.isfinite(centre).all():
        raise InputError(
            "the centre of the image does not meet the ground: the model does not belong to this image",
            field="model",
            remedy=_SOUND,
        )
    return centre
