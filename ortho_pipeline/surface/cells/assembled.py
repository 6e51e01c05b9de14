"""The DEM that cells make: those that a source has, sea at height 0 where none ought to be, no land without heights."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyproj

from ortho_pipeline.errors import CoverageError, DatumError, InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.surface.base import Array, parse_fill
from ortho_pipeline.surface.cells.copernicus import LIST, Cell, Extent, crs_of_cells
from ortho_pipeline.surface.cells.sources import Source, misplaced
from ortho_pipeline.surface.dem import DemSurface, dem_of
from ortho_pipeline.surface.dem_file import DemFile, SampleGrid
from ortho_pipeline.surface.dem_mosaic import Samples, laid_out

_SHOWN = 4


@dataclass(frozen=True)
class SeaCell:
    """A cell without land: 0 m above the geoid everywhere."""

    cell: Cell

    @property
    def path(self) -> str:
        """Its name."""
        return self.cell.name

    @property
    def block(self) -> int:
        """Nothing is decoded."""
        return 0

    @property
    def unit(self) -> str:
        """None is stated: a height of 0 is the same in each."""
        return ""

    @property
    def files(self) -> tuple[str, ...]:
        """There is none."""
        return ()

    def place(self) -> tuple[pyproj.CRS, SampleGrid]:
        """Return the CRS and the grid of the samples."""
        return crs_of_cells()[0], self.cell.grid

    def read(self, left: int, top: int, width: int, height: int, metres_per_unit: float) -> Array:
        """Return zeros ``(height, width)``."""
        return np.zeros((height, width))

    def close(self) -> None:
        """Nothing is open."""


def open_cells(
    source: Source,
    extents: Iterable[Extent],
    vertical: Vertical | str | None = None,
    override: bool = False,
    fill: str | float = "error",
    memory: int = 512_000_000,
) -> DemSurface:
    """Return the cells under some extents as a DEM.

    Parameters
    ----------
    vertical : Vertical or str, optional
        A geoid grid file of EGM2008, if PROJ's is not installed; another datum only with `override`.
    fill : 'error', 'mask', 'nearest' or float
        As for `open_dem`. Except with 'error', land without a cell is a void.

    Raises
    ------
    CoverageError
        If land under the extents has no cell, or it is unknown whether there is land.
    DatumError
        If a cell states another datum than EGM2008, or the geoid grid is not installed.
    InputError
        If the content of a cell does not match its name.
    """
    extents = list(extents)
    wanted = _ordered(cell for extent in extents for cell in extent.cells())
    around = _ordered(cell for extent in extents for cell in extent.widened().cells())
    there = source.files(around)
    absent = [cell for cell in around if cell not in there]
    land = source.land() if absent else frozenset[Cell]()
    sea = [cell for cell in absent if land is not None and cell not in land and not cell.withheld]
    lost = [cell for cell in absent if cell in wanted and cell not in sea]
    if lost and parse_fill(fill) == "error":
        raise _lost(source, lost, known=land is not None)
    placed = [_file_of(cell, path) for cell, path in there.items()]
    # The sea has the unit of the files: its height, 0, is the same in each unit.
    unit = placed[0][3] if placed else ""
    placed += [(cell_of_sea, *cell_of_sea.place(), unit) for cell_of_sea in map(SeaCell, sea)]
    if not placed:
        raise CoverageError(
            "this source has no DEM cells for the scene",
            file=source.address,
            field="surface.dem",
            remedy="give a DEM of this place",
        )
    mosaic = laid_out(source.address, sorted(placed, key=lambda part: part[0].path))
    surface = dem_of(mosaic, vertical, override, parse_fill(fill), memory)
    named = {"cells": there, "sea_cells": sea, "missing_cells": set(absent) - set(sea)}
    cells = {key: [cell.name for cell in sorted(some)] for key, some in named.items()}
    return replace(surface, record={**surface.record, **cells})


def _ordered(cells: Iterable[Cell]) -> list[Cell]:
    return list(dict.fromkeys(cells))


def _file_of(cell: Cell, path: str) -> tuple[Samples, pyproj.CRS, SampleGrid, str]:
    """Return the file of a cell, its grid and its unit; its heights are above EGM2008, which it need not state."""
    access: dict[str, Any] = {}
    file = DemFile(path, access)
    crs, grid = file.place()
    declared = declared_vertical(crs) if len(crs.axis_info) > 2 else None
    if declared is not None and declared.vertical != Vertical("EPSG:3855"):
        raise DatumError(
            f"this cell states the height datum {declared.name!r}, but the heights of this DEM are above EGM2008",
            file=path,
            field="surface.dem",
            remedy=Text("give the cells as an ordinary DEM: ", Setting("surface.dem", "FOLDER/*.tif")),
        )
    wrong = misplaced(cell, grid.shape, grid.crs_from_pixel)
    if wrong:
        raise InputError(
            f"the name of this cell does not match its content: {wrong}",
            file=path,
            field="surface.dem",
            remedy="copy it again from the public bucket",
        )
    unit = file.unit
    file.close()
    return file, crs_of_cells()[0], grid, unit


def _lost(source: Source, lost: list[Cell], *, known: bool) -> CoverageError:
    names = ", ".join(cell.name for cell in lost[:_SHOWN]) + (" and others" if len(lost) > _SHOWN else "")
    what = (
        f"the public DEM has no heights for this land: {names}"
        if known
        else f"{names} are missing, and without {LIST} it is unknown whether this is sea"
    )
    otherwise = "" if known else f"; or put the list {LIST} next to the cells"
    return CoverageError(
        what,
        file=source.address,
        field="surface.dem",
        remedy=Text(
            "give a DEM of this place, or choose how to fill the gap: ",
            Setting("surface.fill", "mask"),
            f" (no pixels), nearest, or an ellipsoidal height in metres{otherwise}",
        ),
    )
