"""Automatic heights: the extent of the scenes of a command, and the DEM cells under them."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ortho_pipeline.errors import DatumError, InputError, OrthoError, of_option
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs import Vertical, ground_transform
from ortho_pipeline.geodesy.proj_grids import fetch_grid, missing_grid
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.options import SceneOptions, SurfaceOptions
from ortho_pipeline.surface.cells.assembled import open_cells
from ortho_pipeline.surface.cells.copernicus import Extent, extent_of
from ortho_pipeline.surface.cells.sources import source_of
from ortho_pipeline.surface.dem import DemSurface
from ortho_pipeline.surface.dem_file import SANE_HEIGHTS
from ortho_pipeline.surface.footprint import border

#: The DEM that is no file.
AUTO = "auto"


def open_automatic(options: SurfaceOptions, access: SceneOptions, memory: int, scenes: Iterable[Scene]) -> DemSurface:
    """Return the heights under scenes, of the cells of the Copernicus DEM.

    Raises
    ------
    InputError
        If the network is needed and not allowed, a scene has no model of its own, or land has no cell.
    """
    extents = extents_under(scenes)
    source = source_of(options.source, allow_network=access.allow_network)
    with of_option("surface.vertical"):
        vertical = None if options.vertical is None else Vertical.parse(options.vertical)
    if vertical is None:
        _require_geoid(access.allow_network)
    return open_cells(source, extents, vertical, options.override_vertical, options.fill, memory)


def extents_under(scenes: Iterable[Scene]) -> list[Extent]:
    """Return the extents of scenes: see `extent_under`.

    Raises
    ------
    InputError
        If there is none.
    """
    extents = [extent_under(scene) for scene in scenes]
    if not extents:
        raise InputError(
            "automatic heights need a scene",
            field="surface.dem",
            remedy=Text("give ", Setting("surface.dem", "FILE")),
        )
    return extents


def extent_under(scene: Scene) -> Extent:
    """Return the extent of a scene for all heights in the range of its model.

    Raises
    ------
    InputError
        If it has no model, or one that does not project.
    """
    if not scene.models:
        raise InputError(
            "this image has no sensor model, so its position is unknown",
            file=scene.path,
            field="surface.dem",
            remedy=Text("give ", Setting("surface.dem", "FILE")),
        )
    model = scene.model
    ring = border(scene.width, scene.height)
    levels = np.clip(model.height_range, *SANE_HEIGHTS)
    to_degrees = ground_transform(model.crs, "EPSG:4979")
    ground = np.concatenate([to_degrees(model.image_to_ground(ring, float(level))) for level in levels])
    extent = extent_of(ground[:, :2])
    if extent is None:
        raise InputError(
            "no pixel of the image border meets the ground: the model belongs to another image",
            file=scene.path,
            field="model",
            remedy="give the metadata of this image",
        )
    return extent


def _require_geoid(allow_network: bool) -> None:
    """Fetch the geoid grid of EGM2008 if it is not installed and the network is allowed."""
    grid = missing_grid("EPSG:3855")
    if grid is None:
        return
    if not allow_network:
        raise DatumError(
            f"the heights of the DEM cells need the geoid grid of EGM2008, {grid}, which is not installed",
            field="surface.dem",
            remedy=Text(
                "download it once with `ortho doctor --fetch-grids`, or use ",
                Setting("scene.allow_network"),
                ", or give the file with ",
                Setting("surface.vertical", f"FOLDER/{grid}"),
            ),
        )
    try:
        fetch_grid(grid)
    except OrthoError as error:
        raise DatumError(
            Text("cannot download the geoid grid of EGM2008, which the heights of the DEM cells need: ", error.message),
            file=error.file,
            field="surface.dem",
            remedy=Text(
                error.remedy or "try again later",
                "; or give the file with ",
                Setting("surface.vertical", f"FOLDER/{grid}"),
            ),
        ) from error
