"""Orthorectification of satellite imagery on GDAL: sensor plugins, honest adjustment, fast exact warping.

The names below are the public interface; each is loaded when it is first used, so importing the package is light.
"""

from __future__ import annotations

import importlib
from typing import Any

#: Public name -> module that holds it.
_HOMES = {
    "BlockPoints": "block_points",
    "Ellipse": "ellipse",
    "Fit": "estimation",
    "Grid": "raster",
    "ImageCorrection": "models",
    "OrthoError": "errors",
    "OutputOptions": "options",
    "PointOptions": "options",
    "Points": "points",
    "Prior": "problem",
    "RPC": "models",
    "RasterSource": "raster",
    "Scene": "hookspecs",
    "SceneOptions": "options",
    "Sensor": "hookspecs",
    "SensorModel": "models",
    "Surface": "dem",
    "SurfaceOptions": "options",
    "Vertical": "crs",
    "adjust": "adjustment",
    "compare": "comparison",
    "export_rpc": "rpc",
    "fit": "estimation",
    "fit_ellipse": "ellipse",
    "hookimpl": "hookspecs",
    "load_model": "model_file",
    "intersect": "intersection",
    "open_scene": "plugins",
    "read_block_points": "block_points",
    "read_points": "points",
    "read_rpc": "rpc",
    "rectify": "pipeline",
    "save_model": "model_file",
    "write_points": "points",
    "write_rpc_txt": "rpc",
}

__all__ = sorted(_HOMES)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("ortho-pipeline")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
