"""Cells of a DEM as the public bucket has them, but small, and a geoid that everybody can compute."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal, osr

from ortho_pipeline.surface.cells import copernicus
from ortho_pipeline.surface.cells.copernicus import Cell

gdal.UseExceptions()
#: Rows of the small cells, and their columns by latitude: a hundredth of the true ones.
ROWS = 36
COLUMNS = ((85, 4), (80, 7), (70, 12), (60, 18), (50, 24), (0, 36))


def small_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the cells of the public bucket have few samples."""
    monkeypatch.setattr(copernicus, "ROWS", ROWS)
    monkeypatch.setattr(copernicus, "_COLUMNS", COLUMNS)
    monkeypatch.setattr(copernicus, "_MARGIN", 1)


def heights_of(cell: Cell) -> np.ndarray:
    """Return heights (m) of a cell that differ from those of all others, and do not jump where it ends."""
    columns = cell.columns
    lon, lat = cell.lon + np.arange(columns) / columns, cell.lat + 1 - np.arange(ROWS) / ROWS
    return (500 + 30 * np.sin(np.deg2rad(40 * lon)) + 20 * np.cos(np.deg2rad(60 * lat))[:, None]).astype(np.float32)


def write_cell(folder: Path, cell: Cell, *, crs: str = "EPSG:4326", columns: int | None = None, unit: str = "") -> Path:
    """Write a cell where the bucket has it: in a folder of its own name, compressed."""
    heights, step = heights_of(cell), 1.0 / cell.columns
    heights = heights[:, : columns or cell.columns]
    path = folder / cell.name / f"{cell.name}.tif"
    path.parent.mkdir(parents=True, exist_ok=True)
    dataset = gdal.GetDriverByName("GTiff").Create(
        str(path), heights.shape[1], ROWS, 1, gdal.GDT_Float32, ["COMPRESS=DEFLATE", "PREDICTOR=3"]
    )
    reference = osr.SpatialReference()
    reference.SetFromUserInput(crs)
    reference.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    dataset.SetSpatialRef(reference)
    dataset.SetGeoTransform((cell.lon - step / 2, step, 0, cell.lat + 1 + 0.5 / ROWS, 0, -1.0 / ROWS))
    dataset.GetRasterBand(1).SetUnitType(unit)
    dataset.WriteArray(heights)
    dataset = None
    return path


def write_list(folder: Path, cells: list[Cell], spacing: int = 10) -> None:
    """Write the list of the cells that a bucket has."""
    names = (cell.name.replace("COG_10", f"COG_{spacing}") for cell in cells)
    (folder / "tileList.txt").write_text("\n".join(names) + "\n")


def write_geoid(path: Path) -> Path:
    """Write a geoid grid: an undulation of 20 m and a metre for each 10 degrees of longitude, everywhere."""
    lat, lon = np.arange(-90.0, 91.0, 10.0), np.arange(-180.0, 181.0, 10.0)
    undulation = np.broadcast_to(20 + lon / 10, (len(lat), len(lon))).astype(">f4")
    path.write_bytes(struct.pack(">4d2i", -90.0, -180.0, 10.0, 10.0, len(lat), len(lon)) + undulation.tobytes())
    return path
