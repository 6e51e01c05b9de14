"""Heights that find themselves: cells of a bucket that the test makes, against a mosaic that GDAL makes of them."""

from __future__ import annotations

import hashlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from dem_cells import ROWS, heights_of, small_cells, write_cell, write_geoid, write_list
from osgeo import gdal, osr
from servers import PublicFolder, serving

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands import rectify
from ortho_pipeline.commands.heights.automatic import extent_under
from ortho_pipeline.errors import CoverageError, DatumError, InputError, StorageError
from ortho_pipeline.host import open_scene
from ortho_pipeline.options import SceneOptions, SurfaceOptions
from ortho_pipeline.stores import local_cache, objects
from ortho_pipeline.surface.cells import sources
from ortho_pipeline.surface.cells.assembled import open_cells
from ortho_pipeline.surface.cells.copernicus import Cell, Extent, cells_of_list, columns_at, extent_of
from ortho_pipeline.surface.cells.sources import source_of
from ortho_pipeline.surface.dem import open_dem

gdal.UseExceptions()
EGM2008 = Path("/usr/share/proj/us_nga_egm08_25.tif")
HERE = [Cell(lon, lat) for lon in (19, 20) for lat in (-31, -30)]


@pytest.fixture(autouse=True)
def _small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    small_cells(monkeypatch)
    monkeypatch.setenv("ORTHO_CACHE", str(tmp_path / "kept"))
    monkeypatch.delenv("ORTHO_DEM_SOURCE", raising=False)
    monkeypatch.setitem(objects.RETRIES, "max_retries", 2)


@pytest.fixture
def geoid(tmp_path: Path) -> str:
    return str(write_geoid(tmp_path / "geoid.gtx"))


@pytest.fixture
def bucket(tmp_path: Path) -> Iterator[PublicFolder]:
    folder = tmp_path / "bucket"
    for cell in HERE:
        write_cell(folder, cell)
    write_list(folder, HERE)
    with serving(folder) as public:
        yield public


def found(source: str, extent: Extent, geoid: str, **options: Any) -> Any:
    return open_cells(source_of(source, allow_network=True), [extent], geoid, **options)


# -- names and places --------------------------------------------------------------------------------------------------


def test_names_and_widths_are_those_that_the_bucket_publishes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert Cell(31, 41).name == "Copernicus_DSM_COG_10_N41_00_E031_00_DEM"
    # A cell whose header was published: origin (-172.000138888888898, -12.999861111111111), 3600 x 3600.
    cell = Cell(-172, -14)
    assert cell.name == "Copernicus_DSM_COG_10_S14_00_W172_00_DEM"
    x, dx, _, y, _, dy = cell.grid.crs_from_pixel
    assert (x - dx / 2, y - dy / 2) == pytest.approx((-172.000138888888898, -12.999861111111111), abs=1e-14)
    assert cells_of_list(f"{cell.name}\nCopernicus_DSM_COG_30_N53_00_W115_00_DEM\n") == {cell, Cell(-115, 53)}
    widths = {0: 3600, 49: 3600, 50: 2400, 59: 2400, 60: 1800, 70: 1200, 80: 720, 84: 720, 85: 360, 89: 360}
    for lat, columns in widths.items():
        assert columns_at(lat) == columns_at(-lat - 1) == columns


def test_the_cells_of_an_extent_are_those_whose_samples_lie_in_it() -> None:
    assert Extent(30.2, 41.1, 30.4, 41.3).cells() == [Cell(30, 41)]
    # A parallel is the first row of the cell below it, a meridian the first column of the one in the east.
    assert Extent(30.0, 42.0, 30.0, 42.0).cells() == [Cell(30, 41)]
    assert Extent(29.9, 40.9, 30.1, 41.1).cells() == [Cell(29, 40), Cell(29, 41), Cell(30, 40), Cell(30, 41)]
    assert Extent(179.9, -0.1, 180.1, 0.1).cells() == [Cell(179, -1), Cell(179, 0), Cell(-180, -1), Cell(-180, 0)]
    assert len(Extent(-180.0, 89.5, 180.0, 90.0).cells()) == 360


def test_the_extent_of_a_ring_runs_over_the_antimeridian_and_around_a_pole() -> None:
    ring = np.array([[179.9, 10.0], [-179.9, 10.0], [-179.9, 10.2], [179.9, 10.2], [179.9, 10.0]])
    west, south, east, north = extent_of(ring)
    assert (west % 360, south, east - west, north) == pytest.approx((179.9, 10.0, 0.2, 10.2))
    angle = np.linspace(0, 360, 50)
    pole = extent_of(np.column_stack([(angle + 180) % 360 - 180, np.full(50, -89.8)]))
    assert pole == (-180.0, -90.0, 180.0, -89.8)


# -- heights -----------------------------------------------------------------------------------------------------------


def test_heights_from_a_bucket_are_those_of_a_local_mosaic(bucket: PublicFolder, geoid: str, tmp_path: Path) -> None:
    paths = sorted(str(path) for path in bucket.folder.glob("*/*.tif"))
    gdal.BuildVRT(str(bucket.folder / "all.vrt"), paths).FlushCache()
    local = open_dem(bucket.folder / "all.vrt", geoid, roots=[bucket.folder])
    dem = found(bucket.address, Extent(19.5, -30.5, 20.5, -29.5), geoid)
    assert dem.shape == local.shape
    np.testing.assert_allclose(dem.grid.crs_from_pixel, local.grid.crs_from_pixel, rtol=1e-14)
    window = 0, 0, *local.shape[::-1]
    np.testing.assert_array_equal(dem.file.read(*window, 1.0), local.file.read(*window, 1.0))
    np.testing.assert_allclose(dem.window(*window), local.window(*window), rtol=1e-15)
    assert dem.provenance["path"] == bucket.address
    assert dem.provenance["cells"] == [cell.name for cell in sorted(HERE)]
    assert all(Path(path).is_relative_to(tmp_path / "kept") for path in dem.files)


def test_sea_is_at_height_0_above_the_geoid_and_lost_land_is_refused(bucket: PublicFolder, geoid: str) -> None:
    """What the list does not name is sea; what it names and the bucket has not is an error with a choice."""
    lost = HERE[0]
    (bucket.folder / lost.name / f"{lost.name}.tif").unlink()
    extent = Extent(19.5, -30.5, 20.5, -29.5)
    with pytest.raises(CoverageError, match=lost.name) as caught:
        found(bucket.address, extent, geoid)
    assert "surface.fill=mask" in caught.value.remedy
    assert np.isnan(found(bucket.address, extent, geoid, fill="mask").heights([[19.5, -30.5]])[0])
    local_cache.clear()
    write_list(bucket.folder, HERE[1:])
    dem = found(bucket.address, extent, geoid)
    # The geoid of the test: 20 m and a metre for each 10 degrees.
    np.testing.assert_allclose(dem.heights([[19.5, -30.5]]), 20 + 1.95, atol=1e-3)
    assert dem.provenance["sea_cells"] == [lost.name]


@pytest.mark.parametrize(("crs", "unit"), [("EPSG:4326+3855", ""), ("EPSG:4326", "m")])
def test_the_sea_beside_cells_that_state_their_unit(tmp_path: Path, geoid: str, crs: str, unit: str) -> None:
    """GDAL gives the unit of a vertical CRS as that of the band."""
    land, sea = Cell(20, -31), Cell(19, -31)
    write_cell(tmp_path, land, crs=crs, unit=unit)
    write_list(tmp_path, [land])
    dem = found(str(tmp_path), Extent(19.5, -30.5, 20.5, -30.4), geoid)
    assert dem.provenance["sea_cells"] == [sea.name]
    assert dem.heights([[19.5, -30.5]])[0] == pytest.approx(20 + 1.95, abs=1e-3)
    assert dem.heights([[20.0, -30.0]])[0] == pytest.approx(heights_of(land)[0, 0] + 22, abs=1e-3)


def test_without_a_list_nobody_says_what_is_sea(bucket: PublicFolder, geoid: str) -> None:
    (bucket.folder / "tileList.txt").unlink()
    extent = Extent(19.5, -30.5, 20.5, -29.5)
    assert found(bucket.address, extent, geoid).shape == (2 * ROWS, 2 * ROWS)
    with pytest.raises(CoverageError, match=r"unknown whether this is sea") as caught:
        found(bucket.address, Extent(20.5, -29.5, 21.5, -29.4), geoid)
    assert "tileList.txt" in caught.value.remedy


def test_land_is_what_one_of_the_two_public_lists_names(
    bucket: PublicFolder, geoid: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The DEM of 90 m has land that is not in that of 30 m; without its list nobody knows what is sea."""
    coarse, missing = tmp_path / "coarse", Cell(21, -30)
    coarse.mkdir()
    write_list(coarse, [missing], spacing=30)
    land, sea = Extent(20.5, -29.5, 21.5, -29.4), Extent(19.5, -27.5, 19.6, -27.4)
    with serving(coarse) as other:
        monkeypatch.setattr(sources, "PUBLIC", bucket.address)
        monkeypatch.setattr(sources, "PUBLIC_LAND", other.address)
        with pytest.raises(CoverageError, match=f"no heights for this land: {missing.name}"):
            found(bucket.address, land, geoid)
        assert found(bucket.address, sea, geoid).provenance["sea_cells"] == [Cell(19, -28).name]
        assert found(bucket.address, Extent(19.5, -30.5, 20.5, -29.5), geoid).provenance["sea_cells"] == []
        (coarse / "tileList.txt").unlink()
        local_cache.clear()
        with pytest.raises(CoverageError, match="unknown whether this is sea"):
            found(bucket.address, sea, geoid)


def test_land_that_the_public_dem_withholds_is_not_sea(tmp_path: Path, geoid: str) -> None:
    """Of Armenia and Azerbaijan the list names no cell, and they lie high above the sea."""
    for cell in (Cell(42, 40), Cell(43, 42)):
        write_cell(tmp_path / "cells", cell)
    write_list(tmp_path / "cells", [Cell(42, 40), Cell(43, 42)])
    with pytest.raises(CoverageError, match="N40_00_E044"):
        found(str(tmp_path / "cells"), Extent(44.4, 40.2, 44.5, 40.3), geoid)


@pytest.mark.parametrize(("lat", "other"), [(49, 50), (-51, -50), (84, 85)])
def test_where_cells_become_wider_rows_are_linear_between_the_samples_of_each(
    lat: int, other: int, tmp_path: Path, geoid: str
) -> None:
    cells = [Cell(lon, row) for lon in (10, 11) for row in (lat, other)]
    for cell in cells:
        write_cell(tmp_path, cell)
    dem = found(str(tmp_path), Extent(10.3, max(lat, other) - 0.2, 11.3, max(lat, other) + 0.2), geoid, fill="mask")
    both = Cell(10, lat), Cell(10, other)
    # Columns on which the samples of both lie; the last is the last one of the narrower cells.
    columns = math.lcm(*(cell.columns for cell in both))
    between = columns // max(cell.columns for cell in both)
    assert dem.shape == (2 * ROWS, 2 * columns - between + 1)
    raw = dem.file.read(0, 0, *dem.shape[::-1], 1.0)
    for cell in both:
        top, step = (max(lat, other) - cell.lat) * ROWS, columns // cell.columns
        known = np.concatenate([heights_of(cell), heights_of(Cell(11, cell.lat))], axis=1)
        np.testing.assert_array_equal(raw[top : top + ROWS, ::step][:, : known.shape[1]], known)
        at = np.arange((known.shape[1] - 1) * step + 1)
        wanted = np.array([np.interp(at / step, np.arange(known.shape[1]), row) for row in known])
        np.testing.assert_allclose(raw[top : top + ROWS, : len(at)], wanted, rtol=1e-12)


def test_cells_on_both_sides_of_the_antimeridian_and_around_a_pole(tmp_path: Path, geoid: str) -> None:
    for cell in (Cell(179, 10), Cell(-180, 10)):
        write_cell(tmp_path, cell)
    dem = found(str(tmp_path), Extent(179.8, 10.4, 180.2, 10.6), geoid, fill="mask").around(180.0)
    places = np.array([[180 - 1e-6, 10.5], [180 + 1e-6, 10.5], [-180.0, 10.5]])
    heights = dem.heights(places)
    assert not np.isnan(heights).any()
    assert np.ptp(heights) < 1e-2
    # Such a mosaic goes once round the world, from 180 degrees west on.
    for cell in (Cell(179, 10), Cell(-180, 10)):
        own = dem.file.read((cell.lon + 180) * ROWS, 0, ROWS, ROWS, 1.0)
        np.testing.assert_array_equal(own, heights_of(cell))
    around = [Cell(lon, 89) for lon in range(-180, 180)]
    for cell in around:
        write_cell(tmp_path / "pole", cell)
    pole = found(str(tmp_path / "pole"), Extent(-180.0, 89.9, 180.0, 90.0), geoid, fill="mask")
    assert pole.shape == (ROWS, 360 * around[0].columns)
    row = np.concatenate([heights_of(cell) for cell in around], axis=1)
    np.testing.assert_array_equal(pole.file.read(0, 0, *pole.shape[::-1], 1.0), row)
    ring = np.column_stack([np.linspace(-180, 180, 1000), np.full(1000, 89.95)])
    assert not np.isnan(pole.around(0.0).heights(ring)).any()


# -- STAC --------------------------------------------------------------------------------------------------------------


def cell_item(cell: Cell, href: str) -> dict[str, Any]:
    data = {"href": href, "roles": ["data"], "type": "image/tiff"}
    return {"type": "Feature", "stac_version": "1.0.0", "id": cell.name.removesuffix("_DEM"), "assets": {"data": data}}


def collection(bucket: PublicFolder, kind: str) -> str:
    """Describe the cells of a bucket: in a static collection, a list of items, or by an API; return its address."""
    folder, links = bucket.folder, []
    for cell in HERE:
        name = f"items/{cell.name.removesuffix('_DEM')}.json"
        (folder / "items").mkdir(exist_ok=True)
        (folder / name).write_text(json.dumps(cell_item(cell, f"../{cell.name}/{cell.name}.tif")))
        links.append({"rel": "item", "href": f"./{name}"})
    if kind == "static":
        document: dict[str, Any] = {"type": "Collection", "links": links}
    elif kind == "list":
        features = [cell_item(cell, f"{bucket.address}/{cell.name}/{cell.name}.tif") for cell in HERE]
        document = {"type": "FeatureCollection", "features": features}
    else:
        document = {"type": "Collection", "links": [{"rel": "items", "href": f"{bucket.address}/page/1"}]}
        (folder / "page").mkdir()
        for number, cells in ((1, HERE[:2]), (2, HERE[2:])):
            features = [cell_item(cell, f"../{cell.name}/{cell.name}.tif") for cell in cells]
            follows = [{"rel": "next", "href": f"{bucket.address}/page/2?token=x"}] if number == 1 else []
            (folder / "page" / str(number)).write_text(json.dumps({"features": features, "links": follows}))
    (folder / "collection.json").write_text(json.dumps(document))
    return f"{bucket.address}/collection.json"


@pytest.mark.parametrize("kind", ["static", "list", "api"])
def test_cells_of_a_stac_collection_are_those_of_the_bucket(
    kind: str, bucket: PublicFolder, geoid: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    extent = Extent(19.5, -30.5, 20.5, -29.5)
    truth = found(bucket.address, extent, geoid)
    address = collection(bucket, kind)
    dem = found(address, extent, geoid)
    window = 0, 0, *truth.shape[::-1]
    np.testing.assert_array_equal(dem.window(*window), truth.window(*window))
    assert dem.provenance["path"] == address
    with pytest.raises(InputError, match="off by default"):
        source_of(address, allow_network=False)
    # What a collection does not hold is sea where the list of the public bucket has no land either.
    monkeypatch.setattr(sources, "PUBLIC", bucket.address)
    monkeypatch.setattr(sources, "PUBLIC_LAND", bucket.address)
    assert found(address, Extent(20.5, -29.5, 21.5, -29.4), geoid).provenance["sea_cells"] == [Cell(21, -30).name]


def test_a_collection_on_disk_says_nothing_of_the_sea(bucket: PublicFolder, geoid: str, tmp_path: Path) -> None:
    collection(bucket, "static")
    path = str(bucket.folder / "collection.json")
    for cell in HERE:
        # An item leads to files below its own folder.
        write_cell(bucket.folder / "items", cell)
        named = cell_item(cell, f"{cell.name}/{cell.name}.tif")
        (bucket.folder / "items" / f"{cell.name.removesuffix('_DEM')}.json").write_text(json.dumps(named))
    dem = found(path, Extent(19.5, -30.5, 20.5, -29.5), geoid)
    assert dem.shape == (2 * ROWS, 2 * ROWS)
    with pytest.raises(CoverageError, match=r"unknown whether this is sea"):
        found(path, Extent(20.5, -29.5, 21.5, -29.4), geoid)
    (tmp_path / "other.json").write_text('{"type": "Feature"}')
    with pytest.raises(InputError, match="not a STAC collection"):
        source_of(str(tmp_path / "other.json"), allow_network=False)


# -- what may go wrong -------------------------------------------------------------------------------------------------


def flipped(data: bytes, _: int) -> bytes:
    return data[:400] + bytes([data[400] ^ 1]) + data[401:]


def test_bytes_that_are_not_those_of_the_store_are_fetched_again_and_never_kept(
    bucket: PublicFolder, geoid: str, tmp_path: Path
) -> None:
    name = f"{HERE[0].name}/{HERE[0].name}.tif"
    extent = Extent(19.5, -30.5, 19.6, -30.4)
    bucket.faults[name] = flipped
    with pytest.raises(StorageError, match="checksum") as caught:
        found(bucket.address, extent, geoid)
    assert caught.value.file == f"{bucket.address}/{name}"
    left = [path.name for path in (tmp_path / "kept").rglob("*") if path.is_file() and path.suffix != ".lock"]
    assert not [name for name in left if HERE[0].name in name or "part" in name], left
    bucket.faults[name] = lambda data, number: flipped(data, number) if number < bucket.asked[name] else None
    dem = found(bucket.address, extent, geoid)
    assert not np.isnan(dem.heights([[19.55, -30.45]])).any()


@pytest.mark.parametrize("status", [500, 503, 429])
def test_a_server_that_fails_in_passing_is_asked_again(bucket: PublicFolder, geoid: str, status: int) -> None:
    name = f"{HERE[0].name}/{HERE[0].name}.tif"
    bucket.faults[name] = lambda _, number: status if number < 3 else None
    found(bucket.address, Extent(19.5, -30.5, 19.6, -30.4), geoid)
    assert bucket.asked[name] == 3


def test_a_cell_of_another_size_or_place_is_refused(bucket: PublicFolder, geoid: str) -> None:
    extent = Extent(19.5, -30.5, 19.6, -30.4)
    write_cell(bucket.folder, HERE[0], columns=30)
    with pytest.raises(InputError, match="30 x 36 samples instead of 36 x 36"):
        found(bucket.address, extent, geoid)
    other = write_cell(bucket.folder, HERE[3])
    other.replace(bucket.folder / HERE[0].name / f"{HERE[0].name}.tif")
    with pytest.raises(InputError, match="another place"):
        found(bucket.address, extent, geoid)
    with pytest.raises(InputError, match="another place"):
        found(str(bucket.folder), extent, geoid)


def test_a_cell_of_another_datum_is_refused(tmp_path: Path, geoid: str) -> None:
    write_cell(tmp_path, HERE[0], crs="EPSG:4326+5773")
    with pytest.raises(DatumError, match="EGM96"):
        found(str(tmp_path), Extent(19.5, -30.5, 19.6, -30.4), geoid, fill="mask")
    write_cell(tmp_path, HERE[0])
    with pytest.raises(DatumError, match=r"EGM2008.*WGS84 ellipsoid"):
        found(str(tmp_path), Extent(19.5, -30.5, 19.6, -30.4), "ellipsoid", fill="mask")


def test_what_is_kept_is_checked_and_heals(bucket: PublicFolder, geoid: str) -> None:
    extent = Extent(19.5, -30.5, 19.6, -30.4)
    wanted = found(bucket.address, extent, geoid).heights([[19.55, -30.45]])
    first = dict(bucket.asked)
    found(bucket.address, extent, geoid)
    assert dict(bucket.asked) == first, "kept: nothing is asked for again"
    path = next(record.path for record in local_cache.records() if HERE[0].name in record.path.name)
    sound = path.read_bytes()
    for damaged in (flipped(sound, 0), sound[:-50], b""):
        path.write_bytes(damaged)
        assert {record.state() for record in local_cache.records()} >= {
            "damaged" if len(damaged) == len(sound) else "of another size"
        }
        np.testing.assert_array_equal(found(bucket.address, extent, geoid).heights([[19.55, -30.45]]), wanted)
        assert path.read_bytes() == sound
    path.unlink()
    np.testing.assert_array_equal(found(bucket.address, extent, geoid).heights([[19.55, -30.45]]), wanted)
    path.with_name(path.name + ".json").write_text("{")
    np.testing.assert_array_equal(found(bucket.address, extent, geoid).heights([[19.55, -30.45]]), wanted)
    assert local_cache.clear()[0] == len(first)
    assert not list(local_cache.records())


_FETCHING = """
import sys
from ortho_pipeline.stores import local_cache, objects
store = objects.Objects(sys.argv[1], allow_network=True)
print(local_cache.kept("dem", store.of(sys.argv[2]), lambda path: store.fetch(sys.argv[2], path, 10**9)))
"""


def test_several_processes_fetch_a_cell_once(bucket: PublicFolder) -> None:
    name = f"{HERE[0].name}/{HERE[0].name}.tif"
    bucket.faults[name] = lambda *_: time.sleep(0.3)
    command = [sys.executable, "-c", _FETCHING, bucket.address, name]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    paths = {one.communicate(timeout=60)[0] for one in running}
    assert len(paths) == 1
    assert Path(paths.pop().strip()).is_file()
    assert bucket.asked[name] == 1


# -- the command -------------------------------------------------------------------------------------------------------


def test_an_ortho_on_heights_that_are_found(bucket: PublicFolder, geoid: str, tiny: Any, tmp_path: Path) -> None:
    """The scene lies where four cells meet; without leave to use the network nothing is asked of it."""
    surface = SurfaceOptions(dem="auto", source=bucket.address, vertical=geoid)
    with pytest.raises(InputError, match="off by default") as caught:
        rectify(tiny.image, tmp_path / "no", surface=surface)
    assert "scene.allow_network" in caught.value.remedy
    assert not bucket.asked
    made = rectify(tiny.image, tmp_path / "out", surface=surface, scene=SceneOptions(allow_network=True))
    given = SurfaceOptions(dem=str(bucket.folder / "*" / "*.tif"), vertical=geoid)
    same = rectify(tiny.image, tmp_path / "same", surface=given)
    pixels = [gdal.Open(str(one.files["ortho"])).ReadAsArray() for one in (made, same)]
    np.testing.assert_array_equal(*pixels)
    report = made.document["report"]
    assert report["surface"]["cells"] == [cell.name for cell in sorted(HERE)]
    dems = [one for one in report["provenance"]["inputs"] if one["role"] == "DEM"]
    assert {Path(one["path"]).name[13:] for one in dems} == {f"{cell.name}.tif" for cell in HERE}


def test_the_source_is_an_option_or_a_variable(
    bucket: PublicFolder, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ORTHO_DEM_SOURCE", bucket.address)
    assert source_of(None, allow_network=True).address == bucket.address
    assert source_of(str(bucket.folder), allow_network=False).address == str(bucket.folder)
    with pytest.raises(InputError, match="no such folder of DEM cells"):
        source_of(str(tmp_path / "none"), allow_network=False)


def test_without_the_geoid_there_is_no_ortho(
    bucket: PublicFolder, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ortho_pipeline.commands.heights.automatic.missing_grid", lambda _: "us_nga_egm08_25.tif")
    surface = SurfaceOptions(dem="auto", source=str(bucket.folder))
    with pytest.raises(DatumError, match="us_nga_egm08_25") as caught:
        rectify(tiny.image, tmp_path / "no", surface=surface)
    assert "ortho doctor --fetch-grids" in caught.value.remedy
    assert not list((tmp_path / "no").glob("*"))


def test_a_geoid_that_cannot_be_fetched_as_it_is_stored_makes_no_ortho(
    bucket: PublicFolder, tiny: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def damaged(name: str) -> Path:
        raise StorageError(f"the downloaded file is not the grid {name}", file="https://grids/here")

    monkeypatch.setattr("ortho_pipeline.commands.heights.automatic.missing_grid", lambda _: "us_nga_egm08_25.tif")
    monkeypatch.setattr("ortho_pipeline.commands.heights.automatic.fetch_grid", damaged)
    surface = SurfaceOptions(dem="auto", source=bucket.address)
    with pytest.raises(DatumError, match="cannot download the geoid grid") as caught:
        rectify(tiny.image, tmp_path / "no", surface=surface, scene=SceneOptions(allow_network=True))
    assert caught.value.file == "https://grids/here"
    assert not list((tmp_path / "no").glob("*"))


def test_an_extent_holds_the_scene_at_all_heights_of_its_model(tiny: Any) -> None:
    scene = open_scene(tiny.image)
    extent = extent_under(scene)
    low, high = scene.model.height_range
    for level in (low, (low + high) / 2, high):
        corners = np.array([[0, 0], [tiny.width, 0], [tiny.width, tiny.height], [0, tiny.height]], dtype=float)
        ground = scene.model.image_to_ground(corners, level)
        assert (ground[:, 0] >= extent.west - 1e-9).all()
        assert (ground[:, 0] <= extent.east + 1e-9).all()
        assert (ground[:, 1] >= extent.south - 1e-9).all()
        assert (ground[:, 1] <= extent.north + 1e-9).all()


# -- geoid grids and the cache, as commands ----------------------------------------------------------------------------


def write_proj_grid(path: Path) -> None:
    """Write a grid as PROJ has it: an undulation of 12 m everywhere."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 37, 19, 1, gdal.GDT_Float32)
    reference = osr.SpatialReference()
    reference.ImportFromEPSG(4979)
    dataset.SetSpatialRef(reference)
    dataset.SetGeoTransform((-185.0, 10.0, 0.0, 95.0, 0.0, -10.0))
    dataset.SetMetadata({"TYPE": "VERTICAL_OFFSET_GEOGRAPHIC_TO_VERTICAL", "AREA_OR_POINT": "Point"})
    band = dataset.GetRasterBand(1)
    band.SetDescription("geoid_undulation")
    band.SetUnitType("metre")
    band.Fill(12.0)
    dataset = band = None


def write_proj_store(folder: Path) -> str:
    """Write the EGM2008 grid and its listing as PROJ's store has them; return the grid's name."""
    name = "us_nga_egm08_25.tif"
    write_proj_grid(folder / name)
    digest = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    listed = {"features": [{"properties": {"name": name, "sha256sum": digest}}]}
    (folder / "files.geojson").write_text(json.dumps(listed))
    return name


@pytest.mark.skipif(EGM2008.is_file(), reason="the EGM2008 grid is installed here")
def test_geoid_grids_are_fetched_once_and_never_in_part(tmp_path: Path) -> None:
    """In a process of its own, for PROJ's folders: `doctor` fails, then fetches; the grid is found in that process."""
    store, mine = tmp_path / "proj", tmp_path / "mine"
    store.mkdir()
    mine.mkdir()
    name = write_proj_store(store)
    with serving(store) as proj:
        # The checksum is wrong each time that one attempt fetches the grid.
        proj.faults[name] = lambda data, number: flipped(data, number) if number <= 3 else None
        environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(mine), "PROJ_NETWORK_ENDPOINT": proj.address}
        done = subprocess.run(
            [sys.executable, "-c", _FETCHING_GRIDS, str(mine)], capture_output=True, text=True, env=environment,
            timeout=120, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, left, fetched, found, undulation = json.loads(done.stdout)
    assert first[0] == 1
    assert "checksum" in first[1]
    assert left == []
    assert fetched == [{"grid": name, "path": str(mine / name)}]
    assert found == str(mine / name)
    assert undulation == 12.0


@pytest.mark.slow
@pytest.mark.skipif(EGM2008.is_file(), reason="the EGM2008 grid is installed here")
def test_the_geoid_is_fetched_when_heights_are_first_found(bucket: PublicFolder, tiny: Any, tmp_path: Path) -> None:
    """By `ortho rectify --dem auto --allow-network`; of wrong bytes there is no grid and no ortho."""
    store, mine, out = tmp_path / "proj", tmp_path / "mine", tmp_path / "out"
    store.mkdir()
    mine.mkdir()
    name = write_proj_store(store)
    command = ["rectify", str(tiny.image), "--dem", "auto", "--dem-source", bucket.address, "--allow-network"]
    with serving(store) as proj:
        proj.faults[name] = lambda data, number: flipped(data, number) if number <= 3 else None
        environment = {**os.environ, "PROJ_USER_WRITABLE_DIRECTORY": str(mine), "PROJ_NETWORK_ENDPOINT": proj.address}
        environment["PYTHONPATH"] = os.pathsep.join(sys.path)
        done = subprocess.run(
            [sys.executable, "-c", _FIRST_USE, str(mine), *command, "-o", str(out)], capture_output=True, text=True,
            env=environment, timeout=120, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, left, made, second = json.loads(done.stdout)
    assert first[0] in (1, 2)
    assert "checksum" in first[1]
    assert (left, made) == ([], [])
    assert second[0] == 0, second[1]
    assert (mine / name).is_file()
    # The grid of the test is 12 m everywhere, and so the heights are those above it with 12 m added.
    same = rectify(tiny.image, tmp_path / "same", surface=SurfaceOptions(
        dem="auto", source=str(bucket.folder), vertical=str(mine / name)))  # fmt: skip
    pixels = [gdal.Open(str(one)).ReadAsArray() for one in (out / "tiny_ortho.tif", same.files["ortho"])]
    np.testing.assert_array_equal(*pixels)


_FIRST_USE = """
import json, os, sys
from pathlib import Path
from dem_cells import COLUMNS, ROWS
from click.testing import CliRunner
from ortho_pipeline.cli.program import cli
from ortho_pipeline.surface.cells import copernicus
copernicus.ROWS, copernicus._COLUMNS, copernicus._MARGIN = ROWS, COLUMNS, 1
mine, out = sys.argv[1], Path(sys.argv[-1])
first = CliRunner().invoke(cli, sys.argv[2:])
left, made = os.listdir(mine), [path.name for path in out.glob("tiny_*")]
second = CliRunner().invoke(cli, sys.argv[2:])
print(json.dumps([[first.exit_code, first.stderr], left, made, [second.exit_code, second.stderr]]))
"""

_FETCHING_GRIDS = """
import json, os, sys
from click.testing import CliRunner
from ortho_pipeline.cli.program import cli
from ortho_pipeline.geodesy.crs import Vertical
first = CliRunner().invoke(cli, ["doctor", "--fetch-grids"])
left = os.listdir(sys.argv[1])
second = json.loads(CliRunner().invoke(cli, ["doctor", "--fetch-grids", "--json"]).stdout)
found = {row["datum"]: row["path"] for row in second["grids"]}["egm2008"]
undulation = float(Vertical.parse("egm2008").undulation([20.0], [-30.0])[0])
print(json.dumps([[first.exit_code, first.stderr], left, second["fetched"], found, undulation]))
"""


def test_the_cache_is_listed_verified_and_cleared(bucket: PublicFolder, geoid: str) -> None:
    found(bucket.address, Extent(19.5, -30.5, 19.6, -30.4), geoid)
    runner = CliRunner()
    listed = json.loads(runner.invoke(cli, ["cache", "list", "--json"]).stdout)
    assert len(listed["files"]) == len(list(local_cache.records())) > 0
    assert runner.invoke(cli, ["cache", "verify"]).exit_code == 0
    Path(listed["files"][0]["path"]).write_bytes(b"damaged")
    verified = runner.invoke(cli, ["cache", "verify", "--json"])
    assert verified.exit_code == 1
    assert json.loads(verified.stdout)["files"][0]["state"] == "of another size"
    assert "Deleted" in runner.invoke(cli, ["cache", "clear"]).stdout
    assert json.loads(runner.invoke(cli, ["cache", "list", "--json"]).stdout)["files"] == []
