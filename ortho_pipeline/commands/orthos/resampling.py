"""The pixels of a finished ortho under a corrected model: resampled once, or kept with a moved map grid."""

from __future__ import annotations

import dataclasses
import os

from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import SensorModel
from ortho_pipeline.options import OutputOptions, SceneOptions
from ortho_pipeline.raster.ortho import Profile
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.runtime.process_limits import Progress, Resources
from ortho_pipeline.surface.flat import FlatSurface


def write_resampled(
    scene: Scene,
    model: SensorModel,
    grid: Grid,
    path: str | os.PathLike[str],
    output: OutputOptions,
    opened: SceneOptions,
    progress: Progress | None = None,
) -> None:
    """Write an ortho on a grid, with its pixels where a model puts them. Bands, type, nodata and metadata stay.

    Raises
    ------
    InputError
        If it cannot be read or written.
    """
    from ortho_pipeline.warp.engines import engine_of
    from ortho_pipeline.warp.job import WarpJob

    source = RasterSource(scene.path, **opened.access)
    profile = Profile.of(source, output.dtype, output.nodata)
    own = source.dataset.GetMetadata() or {}
    kept = {key: value for key, value in own.items() if not key.startswith(("AREA_OR_POINT", "STATISTICS_"))}
    resampling = "nearest" if source.palette else output.resampling
    job = WarpJob(
        model, source, FlatSurface(0.0), grid, resampling, "bilinear", output.tolerance,
        Resources(output.memory, output.threads, progress), output.format, dict(output.creation_options),
        dataclasses.replace(profile, metadata={**profile.metadata, **kept}),
    )  # fmt: skip
    engine_of("ortho").rectify(job, path)
