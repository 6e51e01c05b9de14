"""PROJ and its grids: which are there, and where."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pyproj

from ortho_pipeline.errors import DatumError
from ortho_pipeline.geodesy.crs import VERTICAL_NAMES, add_system_grids, vertical_transformer


def proj_info() -> dict[str, Any]:
    """Return PROJ's and pyproj's versions, the search path of grids, and that the network is off."""
    return {
        "proj": pyproj.proj_version_str,
        "pyproj": pyproj.__version__,
        "search_path": list(add_system_grids()),
        "network": bool(pyproj.network.is_network_enabled()),
    }


def grids() -> list[dict[str, Any]]:
    """Return the geoid grids of the common height datums: name, CRS, grid file, whether found and where."""
    folders = [*add_system_grids(), pyproj.datadir.get_user_data_dir()]
    rows: list[dict[str, Any]] = []
    for name, code in VERTICAL_NAMES.items():
        if name == "ellipsoid":
            continue
        row: dict[str, Any] = {"datum": name, "crs": code, "found": True, "grid": None, "path": None}
        try:
            definition = vertical_transformer(code).definition
            found = re.search(r"grids=(\S+)", definition)
            row["grid"] = found.group(1) if found else None
        except DatumError as error:
            grid = re.search(r"geoid grid (\S+),", error.message)
            row.update(found=False, grid=grid.group(1) if grid else None, remedy=error.remedy)
        row["path"] = _grid_path(row["grid"], folders) if row["found"] and row["grid"] else None
        rows.append(row)
    return rows


def _grid_path(name: str, folders: list[str]) -> str | None:
    # PROJ's database gives the same grid two names: the GeoTIFF of its network, and the older file of proj-data.
    older = {"us_nga_egm96_15.tif": "egm96_15.gtx"}
    for folder in folders:
        for candidate in (name, older.get(name, name)):
            if (Path(folder) / candidate).is_file():
                return str(Path(folder) / candidate)
    return None
