"""PROJ and its grids: which are there, and where, and how they are fetched."""

from __future__ import annotations

import contextvars
import re
from pathlib import Path
from typing import Any

import pyproj

from ortho_pipeline.errors import DatumError, InputError, StorageError
from ortho_pipeline.files import parse_json, together, whole_or_nothing
from ortho_pipeline.geodesy.crs import VERTICAL_NAMES, add_system_grids, vertical_transformer
from ortho_pipeline.geodesy.geoid_grid import header_fault
from ortho_pipeline.stores.objects import Objects

#: What PROJ's store has: a list with names, sizes and checksums.
_LIST, _LIST_BYTES = "files.geojson", 50_000_000
#: No grid is larger.
_GRID_BYTES = 2_000_000_000
_REMEDY = "set PROJ_USER_WRITABLE_DIRECTORY to a folder that you may write to"


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
            match = re.search(r"grids=(\S+)", definition)
            row["grid"] = match.group(1) if match else None
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


def missing_grid(vertical: str) -> str | None:
    """Return the name of the geoid grid that a height datum (``EPSG:n``) needs and that is not installed."""
    try:
        vertical_transformer(vertical)
    except DatumError as error:
        grid = re.search(r"geoid grid (\S+),", error.message)
        return grid.group(1) if grid else None
    return None


def fetch_grid(name: str) -> Path:
    """Download a grid from PROJ's server to the user's PROJ folder, where PROJ finds it.

    The download is complete or fails: size, SHA-256 and header are checked against PROJ's list of grids. The caller
    must be allowed to use the network.

    Raises
    ------
    InputError
        If PROJ has no grid of this name, or the folder cannot be written.
    StorageError
        If the download fails, or is not the grid.
    """
    from pyproj.sync import get_proj_endpoint

    store = Objects(get_proj_endpoint(), allow_network=True)
    try:
        listed = parse_json(store.read(_LIST, _LIST_BYTES)[0], store.of(_LIST), "try again later")
        facts = next(feature["properties"] for feature in listed["features"] if feature["properties"]["name"] == name)
        digest = str(facts["sha256sum"])
    except FileNotFoundError as error:
        raise StorageError(
            "PROJ's server has no list of grids", file=store.of(_LIST), remedy="try again later"
        ) from error
    except (StopIteration, KeyError, TypeError) as error:
        raise InputError(f"PROJ has no grid {name}", file=store.of(_LIST), remedy="check the name") from error
    path = Path(pyproj.datadir.get_user_data_dir(True)) / name
    try:
        # In a context of its own: the grid is no part of the outputs that are under way, nor confined to their folder.
        contextvars.Context().run(_fetch, store, path, digest)
    except FileNotFoundError as error:
        raise StorageError(
            "PROJ's server does not have this grid", file=store.of(name), remedy="try again later"
        ) from error
    # PROJ remembers missing grids until its folders are set again.
    pyproj.datadir.set_data_dir(pyproj.datadir.get_data_dir())
    vertical_transformer.cache_clear()
    return path


def _fetch(store: Objects, path: Path, digest: str) -> None:
    with together(path.parent, path.name, wait=True, remedy=_REMEDY), whole_or_nothing(path, side_cars=False) as part:
        content = store.fetch(path.name, part, _GRID_BYTES)
        wrong = header_fault(part) or ("" if content.sha256 == digest else "its SHA-256 differs from PROJ's list")
        if wrong:
            raise StorageError(
                f"the downloaded file is not the grid: {wrong}", file=store.of(path.name), remedy="try again later"
            )


def fetch_missing() -> list[dict[str, Any]]:
    """Fetch the grids of the common height datums that are not there; return the name and the path of each."""
    missing = [row["grid"] for row in grids() if not row["found"] and row["grid"]]
    return [{"grid": name, "path": str(fetch_grid(name))} for name in missing]
