"""Orthos by either engine, with the parts of a job as arguments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ortho_pipeline.exchange.rpc_fit import RpcExport
from ortho_pipeline.models import SensorModel
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.warp.engines import engine_of
from ortho_pipeline.warp.job import WarpJob, WarpRecord
from ortho_pipeline.warp.quality.hiding import Hiding


def rectify(
    model: SensorModel, source: RasterSource, surface: Surface, grid: Grid, path: Path | str | Hiding, **options: Any
) -> WarpRecord:
    return engine_of("ortho").rectify(WarpJob(model, source, surface, grid, **options), path)


def rectify_gdal(
    model: SensorModel, exported: RpcExport | None, source: RasterSource, surface: Surface, grid: Grid, path: Path,
    **options: Any,
) -> WarpRecord:  # fmt: skip
    return engine_of("gdal").rectify(WarpJob(model, source, surface, grid, exported=exported, **options), path)
