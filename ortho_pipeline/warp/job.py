"""The input and the result of an engine: a job of the warp, and its record."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

import pydantic

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange.rpc_fit import RpcExport
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.files.shell import converted
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Resources, require_memory, startable_threads
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.warp import resampling_kernel

#: The stage of a job that makes pixels, for its progress.
WARPING = "Warping"
#: Kernels by the name on the command line, with the source pixels that each reads around the one that holds the point
#: ('average': plus half of its box).
KERNELS = {
    "nearest": (resampling_kernel.NEAREST, 0),
    "bilinear": (resampling_kernel.BILINEAR, 1),
    "cubic": (resampling_kernel.CUBIC, 2),
    "lanczos": (resampling_kernel.LANCZOS, 3),
    "average": (resampling_kernel.AVERAGE, 1),
}
#: What GDAL's warper takes for each pixel of an ortho whose image points are geolocation arrays: 1.4 GB for 13.7 Mpx.
_ARRAYS_BYTES = 100


@dataclass(frozen=True)
class WarpJob:
    """An ortho to be made: what an engine needs to know but where it is written.

    Parameters
    ----------
    surface : Surface
        The seam of a global DEM, moved off the grid (`Surface.around`).
    resampling, dem_interpolation : str
        How pixels and heights are interpolated.
    tolerance : float
        Bound on the geometric error in source pixels, for an engine that interpolates geometry.
    profile : Profile, optional
        What the ortho looks like; like its source without.
    exported : RpcExport, optional
        The RPC that represents the model (`rpc.export_rpc`), if there is one, for an engine that needs it.
    """

    model: SensorModel
    source: RasterSource
    surface: Surface
    grid: Grid
    resampling: str = "bilinear"
    dem_interpolation: str = "bilinear"
    tolerance: float = 0.01
    resources: Resources = field(default_factory=Resources)
    driver: str = "COG"
    creation_options: Mapping[str, str] = field(default_factory=dict)
    profile: Profile | None = None
    exported: RpcExport | None = None

    def look(self) -> Profile:
        """Return what the ortho looks like."""
        return self.profile or Profile.of(self.source)

    def threads(self) -> int:
        """Return how many threads there are for tiles, with as many again for GDAL, which waits for missing ones."""
        wanted = self.resources.threads or os.cpu_count() or 1
        require_memory(self.resources.memory, 2 * wanted)
        return max(1, startable_threads(2 * wanted) // 2)

    def layout(self) -> dict[str, str]:
        """Return the creation options; where pixels are not mixed, overviews do not mix them either."""
        chosen = {key.upper(): value for key, value in self.creation_options.items()}
        if self.driver == "COG" and self.resampling == "nearest" and "RESAMPLING" not in chosen:
            return {"OVERVIEW_RESAMPLING": "NEAREST"} | chosen
        return chosen

    def check(self) -> None:
        """Refuse an unknown kernel, and pixels that cannot be interpolated."""
        if self.resampling not in KERNELS:
            raise InputError(
                f"unknown resampling kernel {self.resampling!r}",
                field="resampling",
                remedy=f"use one of {', '.join(KERNELS)}",
            )
        if self.dem_interpolation not in ("bilinear", "cubic"):
            raise InputError(
                f"unknown DEM interpolation {self.dem_interpolation!r}",
                field="dem-interpolation",
                remedy="use bilinear or cubic",
            )
        if self.source.dtype.kind in "iu" and self.source.dtype.itemsize == 8 and self.resampling != "nearest":
            raise InputError(
                "64-bit integers cannot be interpolated without loss",
                file=self.source.path,
                field="resampling",
                remedy=Text(
                    "use ",
                    Setting("output.resampling", "nearest"),
                    f", or convert the pixels: `gdal_translate -ot Float64 {converted(self.source.path, 'float')}`",
                ),
            )
        if self.source.palette and self.resampling != "nearest":
            raise InputError(
                "the pixels are palette indices, which cannot be averaged",
                file=self.source.path,
                field="resampling",
                remedy=Text(
                    "use ",
                    Setting("output.resampling", "nearest"),
                    f", or expand the palette: `gdal_translate -expand rgb {converted(self.source.path, 'rgb')}`",
                ),
            )


class WarpRecord(Record):
    """The exactness of the warp, in pixels of the image; the transformer is GDAL's where its warper made the ortho.

    `hidden_share` is that of the pixels that the image reaches which terrain hides, null where nobody looked;
    `filled_share` that of those which another ortho filled (`output.fill_from`), null where none was given.
    """

    # max_error_px bounds the difference between the geometry used and the exact model at every output pixel, or is what
    # was measured through GDAL's transformer; finest_spacing is the smallest spacing of the lattice that a block
    # needed, 1 where every pixel was projected. seconds are no part of documents: the same inputs make the same report.
    max_error_px: float
    tolerance_px: float
    finest_spacing: int | None = None
    refined_blocks: int | None = None
    blocks: int | None = None
    pixels: Count
    valid_pixels: Count
    transformer: str | None = None
    hidden_share: float | None = None
    filled_share: float | None = None
    seconds: Annotated[float, pydantic.Field(exclude=True)] = 0.0

    def notes(self, memory: int) -> list[Notice]:
        """Return a notice if GDAL's geolocation arrays took more memory (bytes) than was allowed, which they may."""
        took = self.pixels * _ARRAYS_BYTES
        if self.transformer != "GEOLOC_ARRAY" or took <= memory:
            return []
        text = Text(
            f"GDAL's warper needs about {took / 1e6:.0f} MB for its geolocation arrays, more than ",
            Setting("output.memory"),
            f" {memory / 1e6:.0f}: choose a smaller extent, or leave out ",
            Setting("output.engine", "gdal"),
        )
        return [Notice("memory-exceeded", text, bytes=took)]
