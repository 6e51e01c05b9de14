"""A scene before its pixels: adjusted, laid on its surface, with the grid of its ortho."""

from __future__ import annotations

from typing import Any, NamedTuple

from ortho_pipeline.commands.heights.opening import require_geoid
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.commands.resolved.resolved import Resolved
from ortho_pipeline.commands.scene_fit import Adjusted, adjust
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import completed, of_option
from ortho_pipeline.geodesy.crs import map_crs
from ortho_pipeline.geodesy.naming import crs_text
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.footprint import Footprint, choose_grid, lay, scene_pixels

#: A smaller share of valid pixels within the footprint gives a warning.
_SPARSE = 0.05


class Placement(NamedTuple):
    """The inputs of an ortho: adjusted model, surface, footprint on it, and grid."""

    adjusted: Adjusted
    model: SensorModel
    surface: Surface
    footprint: Footprint
    grid: Grid
    request: Request

    @property
    def scene(self) -> Scene:
        """The scene with the models that were adjusted."""
        return self.adjusted.scene

    def sparse(self, valid_pixels: int) -> list[Notice]:
        """Return a warning if hardly any of the pixels of the ortho that the scene covers has a value."""
        part = valid_pixels / max(scene_pixels(self.model, self.footprint, self.grid), 1.0)
        if part >= _SPARSE:
            return []
        text = (
            f"only {part:.2%} of the pixels inside the footprint have a value. Check the heights, and the nodata value "
            "and mask of the image"
        )
        return [Notice("sparse-ortho", text, share=part)]

    def to_json(self) -> dict[str, Any]:
        """Return the results before the first pixel, as JSON values."""
        fit, grid = self.adjusted.fit, self.grid
        return {
            "sensor": self.scene.sensor,
            "model": fit.model_name,
            "points": {"control": int(fit.points.control.sum()), "check": int(fit.points.check.sum())},
            "rmse_px": {which: rmse and rmse["total"] for which, rmse in fit.rmses.given().items()},
            "coverage": self.footprint.coverage,
            "grid": {
                "crs": crs_text(grid.crs),
                "size": [grid.width, grid.height],
                "resolution": [grid.dx, grid.dy],
                "extent": list(grid.extent),
            },
            **to_document([*self.adjusted.warnings(self.surface), *self.footprint.notes()]),
        }


def place_scene(resolved: Resolved) -> Placement:
    """Adjust a scene to its points, lay it on its surface and choose the grid of its ortho.

    It reads no pixels, except for matching with a reference.

    Raises
    ------
    InputError
        For wrong points, a DEM that does not cover the scene, or an impossible grid.
    """
    adjusted, output, surface = adjust(resolved), resolved.request.output, resolved.surface
    assert surface is not None, "who places a scene requires heights"
    model, size = adjusted.model, (adjusted.scene.width, adjusted.scene.height)
    with completed(adjusted.scene.model_source, of="model"):
        footprint = lay(model, surface, *size)
        require_geoid(footprint, model, size)
        footprint.require_coverage()
        model = footprint.fitted(model)
        grid = resolved.grid
        if grid is None:
            with of_option("output.crs"):
                crs = map_crs(output.crs) if output.crs else None
            grid = choose_grid(
                model, footprint, size, crs=crs, resolution=output.resolution, extent=output.extent, align=output.align
            )
        scene_pixels(model, footprint, grid)
    return Placement(adjusted, model, footprint.surface, footprint, grid, resolved.request)


def open_rasters(scene: Scene, request: Request) -> RasterSource:
    """Open the rasters of a scene with the bands and the type of a request."""
    image, output = request.image, request.output
    return RasterSource(
        *(scene.rasters or (image,)),
        **request.scene.access,
        bands=output.bands,
        dtype=output.dtype,
        memory=output.memory,
    )
