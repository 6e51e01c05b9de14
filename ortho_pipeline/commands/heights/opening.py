"""The DEM or flat ground of the options of a command, and its accuracy."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from ortho_pipeline.commands.heights.automatic import AUTO, extents_under, open_automatic
from ortho_pipeline.commands.stac.given import heights_given
from ortho_pipeline.display.numbers import share
from ortho_pipeline.errors import CoverageError, InputError, completed, of_option
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.locations import Location
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions, number_of
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.cells.collected import open_collected
from ortho_pipeline.surface.cells.copernicus import Extent
from ortho_pipeline.surface.dem import DemSurface, open_dem
from ortho_pipeline.surface.dem_mosaic import matching_files
from ortho_pipeline.surface.flat import FlatSurface
from ortho_pipeline.surface.footprint import Footprint, image_grid

#: Remedy where heights are missing.
GIVE_HEIGHTS = Text(
    "give ",
    Setting("surface.dem", "FILE"),
    ", ",
    Setting("surface.dem", "auto"),
    " with ",
    Setting("scene.allow_network"),
    " to download one, or ",
    Setting("surface.height", "METRES"),
    " above the ellipsoid for flat ground",
)
#: Places per side of the image at which the geoid is looked for.
_GEOID_SIDE = 33
#: No height is less certain (m) than that: the Earth has none of that size.
_LARGEST_SIGMA = 10_000.0


def gaps_masked(options: SurfaceOptions) -> SurfaceOptions:
    """Return options with which pixels without heights are empty, unless the user chose how to fill them."""
    return replace(options, fill="mask") if options.dem is not None and options.fill == SurfaceOptions.fill else options


def open_surface(
    options: SurfaceOptions,
    scene: SceneOptions = SceneOptions(),
    memory: int = OutputOptions.memory,
    under: Iterable[Scene] = (),
) -> Surface:
    """Open the DEM, or find one, or take the ground to be flat.

    Parameters
    ----------
    under : iterable of Scene
        Scenes on it, for automatic heights.
    memory : int
        Bytes of the whole job.

    Raises
    ------
    InputError
        If both or neither are given, or a rule is unknown.
    """
    if options.dem is not None and options.height is not None:
        raise InputError(
            Text(Setting("surface.dem"), " and ", Setting("surface.height"), " cannot be used together"),
            field="surface.height",
            remedy="use one of them",
        )
    require_heights(options)
    sigma = open_sigma(options, scene, memory)
    if options.height is not None:
        return FlatSurface(options.height).with_sigma(sigma)
    assert options.dem is not None
    if options.dem == AUTO:
        return open_automatic(options, scene, memory, under).with_sigma(sigma)
    path = heights_given(options.dem, scene)
    extents = extents_under(under) if path.is_collection else []
    surface = dem_as_stated(path, options, scene, memory, extents)
    _require_same_place(surface, sigma)
    return surface.with_sigma(sigma)


def _require_same_place(surface: DemSurface, sigma: float | Surface | None) -> None:
    """Raise a `CoverageError` if a layer of standard deviations does not cover the file of the DEM.

    DEMs of many files are not tested: a layer for the cells of one scene is enough.
    """
    if not isinstance(sigma, DemSurface) or len(surface.files) != 1:
        return
    rows, columns = surface.shape
    v, u = (axis.ravel() for axis in np.meshgrid(np.linspace(0, rows - 1, 5), np.linspace(0, columns - 1, 5)))
    places = np.column_stack([*surface.grid.lonlat(u, v), np.zeros(len(u))])
    at, size = sigma.sampler("EPSG:4979")(places), np.array(sigma.shape[::-1])
    # A sample more at each side: the grids of one program may be half a sample apart.
    if not ((at >= -1.5) & (at <= size + 0.5)).all():
        raise CoverageError(
            f"the layer of height errors does not cover the DEM: it has {size[0]} x {size[1]} samples, "
            f"the DEM {columns} x {rows}",
            file=sigma.files[0],
            field="surface.sigma",
            remedy="give the layer that belongs to this DEM, or one number of metres",
        )


def require_geoid(footprint: Footprint, model: SensorModel, size: tuple[int, int]) -> None:
    """Raise a `CoverageError` if the DEM has heights under a scene where its geoid grid ends, and no pixels there.

    With ``fill='mask'`` the ortho is empty there. Any other fill would replace heights that the DEM has.
    """
    surface = footprint.surface
    if footprint.complete or not isinstance(surface, DemSurface) or surface.fill == "mask":
        return
    ground = model.image_to_ground(image_grid(*size, _GEOID_SIDE), footprint.middle)
    known = surface.with_fill("mask")
    stored = replace(known, vertical=Vertical.parse("ellipsoid")).heights(ground[:, :2], model.crs)
    lost = np.isfinite(stored) & np.isnan(known.heights(ground[:, :2], model.crs))
    if lost.any():
        raise CoverageError(
            f"{surface.vertical.label} does not cover {share(float(lost.mean()))} of the scene, but the DEM does",
            file=surface.file.path,
            field="surface.vertical",
            remedy=Text(
                "give the geoid grid of the whole scene, or leave these places empty with ",
                Setting("surface.fill", "mask"),
            ),
        )


def open_sigma(options: SurfaceOptions, scene: SceneOptions, memory: int) -> float | Surface | None:
    """Return the standard deviation of heights: a number (m), a raster, or None if not stated.

    Raises
    ------
    InputError
        For a number that is not positive or larger than mountains, and a raster that cannot be read.
    """
    if options.sigma is None:
        return None
    try:
        # What reads as a number is one: nan and 1e999 are no files.
        number = number_of(float(options.sigma))  # type: ignore[arg-type]
    except (TypeError, ValueError):
        with completed(field="surface.sigma"):
            path = os.fspath(options.sigma)  # type: ignore[arg-type]
            raster = open_dem(path, "ellipsoid", override=True, fill="mask", memory=memory, **scene.access)
        # Negative values are voids, declared or not.
        return replace(raster, least=0.0)
    if 0 < number <= _LARGEST_SIGMA:
        return number
    raise InputError(
        f"{options.sigma} is not a standard deviation",
        field="surface.sigma",
        remedy="give a number of metres, or a raster such as Copernicus' height error mask",
    )


def dem_as_stated(
    path: Location,
    options: SurfaceOptions,
    scene: SceneOptions,
    memory: int = OutputOptions.memory,
    extents: Sequence[Extent] = (),
) -> DemSurface:
    """Open a DEM with the options that interpret its heights.

    Parameters
    ----------
    extents : sequence of Extent
        Needed areas of a STAC collection.
    """
    if options.source is not None:
        raise InputError(
            "this option is only for automatic heights, and a DEM is given",
            field="surface.source",
            remedy=Text("leave it out, or give ", Setting("surface.dem", "auto")),
        )
    with of_option("surface.vertical"):
        vertical = None if options.vertical is None else Vertical.parse(options.vertical)
    with completed(field="surface.dem"):
        if path.is_collection:
            return open_collected(
                path, extents, vertical, options.override_vertical, options.fill, memory, scene.access
            )
        return open_dem(
            path, vertical, override=options.override_vertical, fill=options.fill, memory=memory, **scene.access
        )


def dem_files(options: SurfaceOptions) -> list[str]:
    """Return the files of the given DEM: one file, the files of a pattern, a collection's document, or none."""
    if options.dem is None or options.dem == AUTO:
        return []
    dem = Location(options.dem)
    return [dem.document] if dem.is_collection else [*(matching_files(dem) or [dem])]


def require_heights(options: SurfaceOptions, purpose: str = "") -> None:
    """Raise an `InputError` if there are no heights, which names what needs them."""
    if not has_surface(options):
        raise InputError(
            "no heights given" + (f", and {purpose} them" if purpose else ""),
            field="surface.dem",
            remedy=GIVE_HEIGHTS,
        )


def has_surface(options: SurfaceOptions) -> bool:
    """Return whether heights are given.

    Raises
    ------
    InputError
        If an option of a DEM is set without a DEM.
    """
    idle = {
        "surface.vertical": options.vertical is not None,
        "surface.override_vertical": options.override_vertical,
        "surface.fill": options.fill != SurfaceOptions.fill,
        "surface.sigma": options.sigma is not None and options.height is None,
        "surface.source": options.source is not None,
    }
    for field in (field for field, is_set in idle.items() if is_set and options.dem is None):
        raise InputError(
            "this option is for a DEM, and none is given",
            field=field,
            remedy=Text("leave it out, or give ", Setting("surface.dem")),
        )
    return options.dem is not None or options.height is not None


def sigma_file(options: SurfaceOptions) -> str | os.PathLike[str] | None:
    """Return the raster of standard deviations of heights, None where there is none."""
    sigma = options.sigma
    if sigma is None or isinstance(sigma, float | int):
        return None
    return sigma if isinstance(sigma, os.PathLike) or math.isnan(number_of(sigma)) else None
