"""A scene before its pixels: adjusted, laid on its surface, with the grid of its ortho."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from ortho_pipeline.commands.scene_fit import Adjusted, adjust
from ortho_pipeline.display.notices import Notice, to_document
from ortho_pipeline.errors import completed, of_option
from ortho_pipeline.geodesy.crs import map_crs
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import OutputOptions, PointOptions, SceneOptions
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.surface import footprint
from ortho_pipeline.surface.base import Surface

#: An ortho with a smaller part of what its scene covers is worth a warning.
_SPARSE = 0.05


class Layout(NamedTuple):
    """What an ortho is made from; `lay` has how the scene lies on the surface."""

    adjusted: Adjusted
    model: SensorModel
    surface: Surface
    lay: footprint.Footprint
    grid: Grid

    @property
    def scene(self) -> Scene:
        """The scene with the models that were adjusted."""
        return self.adjusted.scene

    def notes(self) -> list[Notice]:
        """Return what there is to say of how the scene lies on its surface."""
        return [Notice("dem-covers-part", text, coverage=self.lay.coverage) for text in self.lay.notes()]

    def sparse(self, valid_pixels: int) -> list[Notice]:
        """Return a warning if hardly any of the pixels of the ortho that the scene covers has a value."""
        part = valid_pixels / max(footprint.scene_pixels(self.model, self.lay, self.grid), 1.0)
        if part >= _SPARSE:
            return []
        text = (
            f"only {part:.2%} of the pixels that the scene covers have a value: check the heights, and the nodata "
            "value and the mask of the image"
        )
        return [Notice("sparse-ortho", text, share=part)]

    def to_json(self) -> dict[str, Any]:
        """Return what is known before the first pixel as JSON values."""
        fit, grid = self.adjusted.fit, self.grid
        authority = grid.crs.to_authority()
        return {
            "sensor": self.scene.sensor,
            "model": fit.model_name,
            "points": {"control": int(fit.points.control.sum()), "check": int(fit.points.check.sum())},
            "rmse_px": {which: one and one["total"] for which, one in fit.to_json()["rmse"].items()},
            "coverage": self.lay.coverage,
            "grid": {
                "crs": ":".join(authority) if authority else grid.crs.name, "size": [grid.width, grid.height],
                "resolution": [grid.dx, grid.dy], "extent": list(grid.extent),
            },
            **to_document([*self.adjusted.warnings(self.surface), *self.notes()]),
        }  # fmt: skip


def lay_out(
    opened: Scene, points: PointOptions, scene: SceneOptions, surface: Surface, output: OutputOptions
) -> Layout:
    """Adjust a scene to its points, lay it on the surface and choose the grid of its ortho; no pixel is read.

    Raises
    ------
    InputError
        For wrong points, a DEM that does not cover the scene, a grid that is none.
    """
    adjusted = adjust(opened, points, scene, surface)
    model, size = adjusted.model, (opened.width, opened.height)
    with completed(adjusted.scene.model_source, of="model"):
        lay = footprint.lay(model, surface, *size)
        lay.require_coverage()
        model = lay.fitted(model)
        with of_option("output.crs"):
            crs = map_crs(output.crs) if output.crs else None
        grid = footprint.choose_grid(
            model, lay, size, crs=crs, resolution=output.resolution, extent=output.extent, align=output.align
        )
        footprint.scene_pixels(model, lay, grid)
    return Layout(adjusted, model, lay.surface, lay, grid)


def source_of(
    scene: Scene, image: str | os.PathLike[str], options: SceneOptions, output: OutputOptions
) -> RasterSource:
    """Open the rasters of a scene with the bands and in the type that its ortho shall have."""
    return RasterSource(
        *(scene.rasters or (image,)), **options.access, bands=output.bands, dtype=output.dtype, memory=output.memory
    )
