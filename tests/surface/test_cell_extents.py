"""Cells of the Copernicus DEM: columns and names as its handbook states them, extents by hand."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest
from dem_cells import ROWS, small_cells, write_cell
from osgeo import gdal

from ortho_pipeline.surface.cells import sources
from ortho_pipeline.surface.cells.copernicus import Cell, Extent, cells_of_list, columns_at, extent_of
from ortho_pipeline.surface.cells.sources import fault_of, misplaced, source_of
from ortho_pipeline.surface.dem_file import Affine


@pytest.mark.parametrize(
    ("lat", "columns"),
    [
        (0, 3600), (49, 3600), (50, 2400), (59, 2400), (60, 1800), (69, 1800), (70, 1200), (79, 1200), (80, 720),
        (84, 720), (85, 360), (89, 360), (-1, 3600), (-50, 3600), (-51, 2400), (-60, 2400), (-61, 1800), (-90, 360),
    ],
)  # fmt: skip
def test_cells_have_fewer_columns_towards_the_poles(lat, columns):
    """The handbook: spacings 1, 1.5, 2, 3, 5 and 10 times that of rows from 0, 50, 60, 70, 80 and 85 degrees on."""
    assert columns_at(lat) == Cell(7, lat).columns == columns


def test_cells_are_named_by_their_south_western_corner():
    for cell, name in (
        (Cell(33, 37), "Copernicus_DSM_COG_10_N37_00_E033_00_DEM"),
        (Cell(-71, -34), "Copernicus_DSM_COG_10_S34_00_W071_00_DEM"),
        (Cell(0, 0), "Copernicus_DSM_COG_10_N00_00_E000_00_DEM"),
        (Cell(-1, -1), "Copernicus_DSM_COG_10_S01_00_W001_00_DEM"),
    ):
        assert cell.name == name
        assert cells_of_list(f"some/{name}/\n{name.replace('COG_10', 'COG_30')}.tif\nother.txt") == {cell}


def test_samples_of_a_cell_begin_at_its_north_western_corner():
    grid = Cell(-71, 62).grid
    lon, lat = grid.lonlat(np.array([0.0, 900.0, 1799.0]), np.array([0.0, 1800.0, 3599.0]))
    # 1800 columns and 3600 rows in a degree; the last sample is one spacing before the next cell.
    np.testing.assert_allclose(lon, [-71.0, -70.5, -70.0 - 1 / 1800], atol=1e-12)
    np.testing.assert_allclose(lat, [63.0, 62.5, 62.0 + 1 / 3600], atol=1e-12)


@pytest.mark.parametrize(
    ("lon", "lat", "withheld"),
    [
        (43, 38, True), (50, 41, True), (45, 40, True), (42, 40, False), (51, 40, False), (45, 37, False),
        (45, 42, False), (45, -40, False), (-45, 40, False),
    ],
)  # fmt: skip
def test_land_that_the_public_dem_omits(lon, lat, withheld):
    assert Cell(lon, lat).withheld == withheld


@pytest.mark.parametrize(
    ("extent", "cells"),
    [
        (Extent(33.2, 37.2, 33.8, 37.8), [(33, 37)]),
        (Extent(33.2, 37.2, 34.0, 37.8), [(33, 37), (34, 37)]),
        # On a parallel lies the first row of the cell south of it.
        (Extent(33.2, 37.2, 33.8, 38.0), [(33, 37)]),
        (Extent(33.2, 37.0, 33.8, 37.8), [(33, 36), (33, 37)]),
        (Extent(179.5, -0.5, 180.5, 0.5), [(179, -1), (179, 0), (-180, -1), (-180, 0)]),
        (Extent(-180.2, 10.1, -179.8, 10.2), [(179, 10), (-180, 10)]),
        (Extent(5.1, 89.5, 5.2, 90.0), [(5, 89)]),
        (Extent(5.1, -90.0, 5.2, -89.5), [(5, -90)]),
    ],
)
def test_an_extent_reaches_into_cells(extent, cells):
    assert extent.cells() == [Cell(*cell) for cell in cells]


def test_round_the_world_no_cell_comes_twice():
    found = Extent(-180.0, 10.1, 180.0, 10.2).cells()
    assert len(found) == len(set(found)) == 360
    assert len(Extent(-200.3, 10.1, 300.0, 10.2).cells()) == 360


@pytest.mark.parametrize("lat", [0.0, 45.0, -61.0, 72.0])
def test_a_wider_extent_has_twelve_samples_and_the_metres_more(lat):
    """By PROJ's geodesics: 2000 m and 12 samples, or a few per cent more, to each side at every latitude."""
    start, geod = Extent(10.0, lat, 10.2, lat + 0.1), pyproj.Geod(ellps="WGS84")
    wide = start.widened(2000.0)
    assert wide.west + wide.east == pytest.approx(start.west + start.east)
    for side in (start.south, start.north):
        aside = geod.inv(start.east, side, wide.east, side)[2]
        samples = 12 / columns_at(int(np.floor(side)))
        wanted = 2000.0 + geod.inv(10.0, side, 10.0 + samples, side)[2]
        assert wanted * 0.99 < aside < wanted * 1.03 + 20
    for near, far in ((start.south, wide.south), (start.north, wide.north)):
        wanted = 2000.0 + geod.inv(10.0, near, 10.0, near + 12 / 3600)[2]
        assert geod.inv(10.0, near, 10.0, far)[2] == pytest.approx(wanted, rel=0.01)


def test_near_a_pole_an_extent_has_all_longitudes():
    assert Extent(10.0, 89.0, 10.1, 89.95).widened()[::2] == (-180.0, 180.0)
    assert Extent(10.0, 89.0, 10.1, 89.99).widened().north == 90.0
    assert Extent(10.0, 89.0, 10.1, 89.99).widened(0.0).south == pytest.approx(89.0 - 12 / 3600)
    assert Extent(10.0, -89.99, 10.1, -89.0).widened().south == -90.0
    assert Extent(-179.99, 0.0, 179.99, 1.0).widened()[::2] == (-180.0, 180.0)


def test_the_extent_of_a_ring_is_not_torn_at_the_antimeridian():
    ring = np.array([[179.5, 1.0], [-179.5, 1.5], [-179.4, 3.0], [179.6, 2.0], [np.nan, 9.0], [179.5, 1.0]])
    assert extent_of(ring) == pytest.approx((179.5, 1.0, 180.6, 3.0))
    assert extent_of(ring[4:5]) is None
    lon = np.linspace(0, 360, 37)
    for lat, expected in ((80.0, (-180.0, 80.0, 180.0, 90.0)), (-75.0, (-180.0, -90.0, 180.0, -75.0))):
        assert extent_of(np.column_stack([lon, np.full(37, lat)])) == expected


# -- files of cells --------------------------------------------------------------------------------------------------


def of_edges(cell: Cell, parts: tuple[float, float, float, float]) -> Affine:
    """Return the place of samples whose edges (west, north, east, south) are off by parts of a sample."""
    x, dx, _, y, _, dy = cell.grid.crs_from_pixel
    rows, columns = cell.grid.shape
    west, north, east, south = np.array(parts) * dx
    return x + west, dx + (east - west) / columns, 0.0, y + north, 0.0, dy + (south - north) / rows


@pytest.mark.parametrize("cell", [Cell(20, -31), Cell(20, 62)])
def test_a_file_of_a_cell_is_at_its_place_if_no_edge_is_off_by_a_hundredth_of_a_sample(
    monkeypatch: pytest.MonkeyPatch, cell: Cell
) -> None:
    """Of a column, which far from the equator is as wide on the ground as a row is high."""
    small_cells(monkeypatch)
    shape = cell.grid.shape
    for signs in itertools.product((-1.0, 1.0), repeat=4):
        west, north, east, south = 0.0099 * np.array(signs)
        assert misplaced(cell, shape, of_edges(cell, (west, north, east, south))) == ""
    for edge, sign in itertools.product(range(4), (-1.0, 1.0)):
        west, north, east, south = (0.0101 * sign * (k == edge) for k in range(4))
        assert "another place" in misplaced(cell, shape, of_edges(cell, (west, north, east, south)))
    wider = misplaced(cell, (shape[0], shape[1] + 1), cell.grid.crs_from_pixel)
    assert f"it has {shape[1] + 1} x {ROWS} samples instead of {shape[1]} x {ROWS}" in wider


def test_a_block_of_a_cell_that_cannot_be_unpacked_is_a_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    small_cells(monkeypatch)
    path = write_cell(tmp_path, Cell(20, -31))
    assert fault_of(Cell(20, -31), path) == ""
    dataset = gdal.Open(str(path))
    place = int(dataset.GetRasterBand(1).GetMetadataItem("BLOCK_OFFSET_0_0", "TIFF"))
    dataset = None
    data = path.read_bytes()
    path.write_bytes(data[:place] + bytes(40) + data[place + 40 :])
    assert "cannot be read" in fault_of(Cell(20, -31), path)


def test_a_collection_is_asked_for_ground_within_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """A box that reached beyond its sides would be that of neighbours, and at 180 degrees no box of an API."""
    there = [Cell(20, -31), Cell(179, 62), Cell(-180, 0), Cell(-1, -1)]

    class Collection:
        def __init__(self, address: str, *, allow_network: bool) -> None:
            assert not allow_network

        def items(self, box: tuple[float, float, float, float], name: str) -> Iterator[Any]:
            west, south, east, north = box
            for lon, lat in there:
                if lon < west < east < lon + 1 and lat < south < north < lat + 1:
                    own = Cell(lon, lat).name
                    names = f"{own}.xml", f"{own}.tif"
                    yield SimpleNamespace(assets=[SimpleNamespace(name=one, href=f"/cells/{one}") for one in names])

    monkeypatch.setattr(sources, "Collection", Collection)
    found = source_of("cells.json", allow_network=False).files([*there, Cell(21, -31)])
    assert found == {cell: f"/cells/{cell.name}.tif" for cell in there}
