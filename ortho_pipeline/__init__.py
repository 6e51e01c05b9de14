"""Orthorectification of satellite imagery on GDAL: sensor plugins, honest adjustment, fast exact warping.

The names below are the public interface; each is loaded when it is first used, so importing the package is light.
`docs/architecture.md` shows the rooms.
"""

from __future__ import annotations

import importlib
import sys
from typing import TYPE_CHECKING, Any

from ortho_pipeline.runtime.lazy_names import lazily

if TYPE_CHECKING:
    from ortho_pipeline.batch.stack.command import stack as stack
    from ortho_pipeline.block.adjustment import adjust as adjust
    from ortho_pipeline.block.heights.source import DemHeights as DemHeights
    from ortho_pipeline.block.intersection import intersect as intersect
    from ortho_pipeline.block.point_files import read_block_points as read_block_points
    from ortho_pipeline.block.points import BlockPoints as BlockPoints
    from ortho_pipeline.commands import rectify as rectify
    from ortho_pipeline.commands.arrays.lazy import ortho_array as ortho_array
    from ortho_pipeline.commands.control.matching import match_scene as match_scene
    from ortho_pipeline.commands.mosaic.assembly import mosaic as mosaic
    from ortho_pipeline.commands.orthos.aligning import align as align
    from ortho_pipeline.commands.orthos.verifying import verify as verify
    from ortho_pipeline.commands.sharpening.sharpen import sharpen as sharpen
    from ortho_pipeline.display.notices import Notice as Notice
    from ortho_pipeline.errors import OrthoError as OrthoError
    from ortho_pipeline.estimation.choice.comparison import compare as compare
    from ortho_pipeline.estimation.fit import Fit as Fit
    from ortho_pipeline.estimation.fit import fit as fit
    from ortho_pipeline.estimation.observations.prior import Prior as Prior
    from ortho_pipeline.exchange.geodataframe import from_geodataframe as from_geodataframe
    from ortho_pipeline.exchange.geodataframe import to_geodataframe as to_geodataframe
    from ortho_pipeline.exchange.model_file import load_model as load_model
    from ortho_pipeline.exchange.model_file import save_model as save_model
    from ortho_pipeline.exchange.rpc import export_rpc as export_rpc
    from ortho_pipeline.exchange.rpc import read_rpc as read_rpc
    from ortho_pipeline.exchange.rpc import write_rpc_txt as write_rpc_txt
    from ortho_pipeline.geodesy.crs import Vertical as Vertical
    from ortho_pipeline.hookspecs import Scene as Scene
    from ortho_pipeline.hookspecs import Sensor as Sensor
    from ortho_pipeline.hookspecs import hookimpl as hookimpl
    from ortho_pipeline.host import open_scene as open_scene
    from ortho_pipeline.models import RPC as RPC
    from ortho_pipeline.models import ImageCorrection as ImageCorrection
    from ortho_pipeline.models import SensorModel as SensorModel
    from ortho_pipeline.options import MatchOptions as MatchOptions
    from ortho_pipeline.options import OutputOptions as OutputOptions
    from ortho_pipeline.options import PointOptions as PointOptions
    from ortho_pipeline.options import SceneOptions as SceneOptions
    from ortho_pipeline.options import StackOptions as StackOptions
    from ortho_pipeline.options import SurfaceOptions as SurfaceOptions
    from ortho_pipeline.points import Points as Points
    from ortho_pipeline.points import read_points as read_points
    from ortho_pipeline.points import write_points as write_points
    from ortho_pipeline.points.heights.spot_heights import read_spot_heights as read_spot_heights
    from ortho_pipeline.raster.source import Grid as Grid
    from ortho_pipeline.raster.source import RasterSource as RasterSource
    from ortho_pipeline.report.notebook.charts import plot as plot
    from ortho_pipeline.report.notebook.tables import html as html
    from ortho_pipeline.surface.base import Surface as Surface
    from ortho_pipeline.surface.dem import open_dem as open_dem
    from ortho_pipeline.surface.rays import meet_surface as meet_surface

__version__: str

#: Public name -> module that holds it.
_HOMES = {
    "BlockPoints": "block.points",
    "DemHeights": "block.heights.source",
    "Fit": "estimation.fit",
    "Grid": "raster.source",
    "ImageCorrection": "models",
    "MatchOptions": "options",
    "Notice": "display.notices",
    "OrthoError": "errors",
    "OutputOptions": "options",
    "PointOptions": "options",
    "Points": "points",
    "Prior": "estimation.observations.prior",
    "RPC": "models",
    "RasterSource": "raster.source",
    "Scene": "hookspecs",
    "SceneOptions": "options",
    "Sensor": "hookspecs",
    "SensorModel": "models",
    "StackOptions": "options",
    "Surface": "surface.base",
    "SurfaceOptions": "options",
    "Vertical": "geodesy.crs",
    "adjust": "block.adjustment",
    "align": "commands.orthos.aligning",
    "compare": "estimation.choice.comparison",
    "export_rpc": "exchange.rpc",
    "fit": "estimation.fit",
    "from_geodataframe": "exchange.geodataframe",
    "hookimpl": "hookspecs",
    "html": "report.notebook.tables",
    "intersect": "block.intersection",
    "load_model": "exchange.model_file",
    "match_scene": "commands.control.matching",
    "meet_surface": "surface.rays",
    "mosaic": "commands.mosaic.assembly",
    "open_dem": "surface.dem",
    "open_scene": "host",
    "ortho_array": "commands.arrays.lazy",
    "plot": "report.notebook.charts",
    "read_block_points": "block.point_files",
    "read_points": "points",
    "read_rpc": "exchange.rpc",
    "read_spot_heights": "points.heights.spot_heights",
    "rectify": "commands",
    "save_model": "exchange.model_file",
    "sharpen": "commands.sharpening.sharpen",
    "stack": "batch.stack.command",
    "to_geodataframe": "exchange.geodataframe",
    "verify": "commands.orthos.verifying",
    "write_points": "points",
    "write_rpc_txt": "exchange.rpc",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605


if not TYPE_CHECKING:  # a checker knows the names from above, and no others
    _load = lazily(__name__, _HOMES)

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            from importlib.metadata import version

            return version("ortho-pipeline")
        return _load(name)


#: What a notebook shows as a table: module and name of each type.
_SHOWN = (
    ("hookspecs", "Scene"),
    ("points.table", "Points"),
    ("estimation.fit", "Fit"),
    ("block.fit", "BlockFit"),
    ("estimation.choice.comparison", "ComparisonRecord"),
)


def _html(result: Any) -> str:
    """Return a result as HTML; what makes it is loaded when it is shown."""
    return str(importlib.import_module(f"{__name__}.report.notebook.tables").html(result))


def load_ipython_extension(shell: Any) -> None:
    """Let a notebook show scenes, points, fits, comparisons and blocks as tables."""
    formatter = shell.display_formatter.formatters["text/html"]
    for module, name in _SHOWN:
        formatter.for_type_by_name(f"{__name__}.{module}", name, _html)


if "IPython" in sys.modules and (_shell := sys.modules["IPython"].get_ipython()) is not None:
    load_ipython_extension(_shell)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
