"""Hidden pixels from another ortho: taken over on the same grid, by GDAL's warper on another one."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import orthos
import pytest
from blocks import FLOOR, City, Parallel, towards
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import write_rpc_txt
from ortho_pipeline.options import OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.regridded import Regridded
from ortho_pipeline.raster.source import Grid, RasterSource
from ortho_pipeline.report.document import read_report
from ortho_pipeline.runtime.process_limits import Resources
from ortho_pipeline.surface.writing import write_dem
from ortho_pipeline.warp import lattice_engine as engine
from ortho_pipeline.warp.quality.hiding import Hiding

TOWN = City(((60, 40, 90, 80, 30.0), (120, 100, 128, 110, 60.0), (30, 150, 150, 162, 18.0)))
HEIGHTS = (FLOOR, FLOOR + 60)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    """Return model, source and surface of a town seen from the west, and the ortho that is made of it."""
    folder = tmp_path_factory.mktemp("town")
    made = gdal.GetDriverByName("GTiff").Create(str(folder / "image.tif"), 700, 700, 1, gdal.GDT_Byte)
    made.WriteArray(np.random.default_rng(1).integers(50, 90, (700, 700), dtype=np.uint8))
    made = None
    job = (
        Parallel(*towards(30, 270), 0.5, TOWN.side),
        RasterSource(folder / "image.tif"),
        TOWN.surface(folder / "d.tif"),
    )
    orthos.rectify(*job, TOWN.grid(), Hiding(folder / "own.tif", HEIGHTS), driver="GTiff")
    return job, folder / "own.tif"


def read(path):
    dataset = gdal.Open(str(path))
    return dataset.ReadAsArray(), dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0


def other_ortho(path, grid: Grid, *, dtype="uint8", count: int = 1, nodata: float | None = None) -> Regridded | None:
    """Write an ortho of values of its own, without any in a stripe."""
    values = np.random.default_rng(2).integers(120, 250, (count, grid.height, grid.width)).astype(dtype)
    valid = np.ones(values.shape[1:], dtype=bool)
    valid[:, grid.width // 3 : grid.width // 2] = False
    values[:, ~valid] = 0 if nodata is None else nodata
    kind = "mask" if nodata is None else "nodata"
    with RasterWriter(path, grid, Profile(count, np.dtype(dtype), kind, nodata), driver="GTiff") as writer:
        writer.write(0, 0, values, valid)
    return path


def filled(town, path, other, **more):
    job, _ = town
    return orthos.rectify(*job, TOWN.grid(), Hiding(path, HEIGHTS, other=other), driver="GTiff", **more)


@pytest.mark.parametrize("nodata", [None, 7.0])
def test_on_the_same_grid_pixels_are_taken_over(town, tmp_path, nodata):
    grid = TOWN.grid()
    # A part of the place only, on the same pixels.
    part = Grid(grid.crs, grid.left + 20.0, grid.top - 60.0, grid.dx, grid.dy, 440, 300)
    other = Regridded(other_ortho(tmp_path / "other.tif", part, nodata=nodata), grid)
    result = filled(town, tmp_path / "ortho.tif", other)
    (own, shown), (values, valid) = read(town[1]), read(tmp_path / "ortho.tif")
    wanted, there = own.copy(), shown.copy()
    theirs, good = read(tmp_path / "other.tif")
    window = (slice(120, 420), slice(40, 480))
    new = ~shown[window] & good
    wanted[window][new], there[window][new] = theirs[new], True
    np.testing.assert_array_equal(valid, there)
    np.testing.assert_array_equal(values[there], wanted[there])
    assert 0 < result.filled_share < result.hidden_share
    assert result.filled_share == pytest.approx(new.sum() / own.size)
    assert result.valid_pixels == there.sum()


@pytest.mark.parametrize(("wide", "high"), [(1, 2), (3, 1)])
def test_pixels_that_differ_in_one_direction_are_another_grid(tmp_path, wide, high):
    grid = Grid(TOWN.grid().crs, 500_000.0, 4_100_000.0, 1.0, 1.0, 36, 24)
    own = Grid(grid.crs, grid.left, grid.top, wide * grid.dx, high * grid.dy, 36 // wide, 24 // high)
    other = Regridded(other_ortho(tmp_path / "other.tif", own), grid, resampling="nearest")
    pixels, valid = other.read(0, 0, 36, 24)
    theirs, good = (np.kron(part, np.ones((high, wide), part.dtype)) for part in read(tmp_path / "other.tif"))
    np.testing.assert_array_equal(valid[0], good)
    np.testing.assert_array_equal(pixels[0][good], theirs[good])


@pytest.mark.parametrize("step", [0.5, 0.21])
def test_on_another_grid_pixels_are_gdals(town, tmp_path, step, monkeypatch):
    """An ortho in degrees, of the same size and of much smaller pixels: as GDAL's warper makes all of it at once."""
    grid = TOWN.grid()
    whole = gdal.Warp("", str(town[1]), format="MEM", dstSRS="EPSG:4326", multithread=False)
    left, dx, _, top, _, dy = whole.GetGeoTransform()
    scale = step / 0.5
    degrees = Grid(
        _crs(4326), left, top, dx * scale, -dy * scale, int(whole.RasterXSize / scale), int(whole.RasterYSize / scale)
    )
    path = other_ortho(tmp_path / "other.tif", degrees)
    other = Regridded(path, grid)
    found = []
    for tile, resources in ((1024, Resources(2**29, 1)), (256, Resources(2**29, 3)), (512, Resources(24_000_000, 2))):
        monkeypatch.setattr(engine, "TILE", tile)
        result = filled(town, tmp_path / "ortho.tif", other, resources=resources)
        found.append(read(tmp_path / "ortho.tif"))
    for values, valid in found[1:]:
        np.testing.assert_array_equal(values, found[0][0])
        np.testing.assert_array_equal(valid, found[0][1])
    theirs = gdal.Warp(
        "", str(path), format="MEM", dstSRS=grid.crs.to_wkt(), outputBounds=grid.extent, width=grid.width,
        height=grid.height, resampleAlg="bilinear", errorThreshold=0.0, dstAlpha=True,
        warpOptions=[f"{axis}SCALE={scale!r}" for axis, scale in zip("XY", other._scales(), strict=True)],
    ).ReadAsArray()  # fmt: skip
    own, shown = read(town[1])
    new = ~shown & (theirs[1] >= 128)
    values, valid = found[0]
    np.testing.assert_array_equal(valid, shown | new)
    np.testing.assert_array_equal(values[new], theirs[0][new])
    np.testing.assert_array_equal(values[shown], own[shown])
    assert result.filled_share == pytest.approx(new.sum() / own.size)
    # Where smaller pixels are averaged, their noise is: 130 values of this spread would keep 37.5.
    assert values[new].std() < (30.0 if step == 0.5 else 20.0)


def _crs(code: int):
    import pyproj

    return pyproj.CRS.from_epsg(code)


@pytest.fixture
def steep(tiny, tmp_path):
    """Return an oblique RPC of the tiny scene, a DEM of it with towers, and options of a true ortho."""
    lean = dataclasses.replace(tiny.model, col_num=tiny.model.col_num + 0.9 * np.eye(20)[3])
    write_rpc_txt(lean, tmp_path / "lean_RPC.TXT")
    path = tmp_path / "steep.tif"
    dataset = gdal.Open(str(tiny.dem))
    heights, (left, step, _, top, _, _) = dataset.ReadAsArray().astype(float), dataset.GetGeoTransform()
    heights[::6, ::6] += 90.0
    srs = dataset.GetSpatialRef()
    write_dem(path, heights, (left, top), step, srs.ExportToWkt())
    surface = SurfaceOptions(dem=path, vertical="ellipsoid")
    return (
        SceneOptions(rpc=str(tmp_path / "lean_RPC.TXT")),
        surface,
        OutputOptions(resolution=10.0, crs="EPSG:32634", visibility="nodata"),
    )


def test_rectify_says_which_share_came_from_where(tiny, steep, tmp_path):
    scene, surface, output = steep
    common = {"scene": scene, "surface": surface}
    plain = commands.rectify(tiny.image, tmp_path / "plain", **common, output=output)
    own, shown = read(plain.files["ortho"])
    other = commands.rectify(
        tiny.image, tmp_path / "other", **common, output=dataclasses.replace(output, visibility=None)
    )
    theirs, _ = read(other.files["ortho"])
    asked = dataclasses.replace(output, fill_from=other.files["ortho"], stac=True, acquired="2020-01-01T00:00:00Z")
    result = commands.rectify(tiny.image, tmp_path / "out", **common, output=asked)
    values, valid = read(result.files["ortho"])
    report = read_report(result.files["report"])
    assert report.warp.hidden_share > 0.001
    assert report.warp.filled_share == report.warp.hidden_share
    np.testing.assert_array_equal(values, np.where(shown, own, theirs))
    assert valid.sum() == report.warp.valid_pixels
    roles = {one["role"]: one for one in result.document["report"]["provenance"]["inputs"]}
    assert roles["other ortho"]["path"] == str(other.files["ortho"])
    assert f"filled from {other.files['ortho']}" in result.files["html"].read_text()
    assert "from another ortho" in result.summary
    item = json.loads(result.files["stac"].read_text())["properties"]
    assert item["ortho:filled_from"] == other.files["ortho"].name
    assert item["ortho:filled_share"] == pytest.approx(report.warp.filled_share, abs=1e-6)


def test_an_ortho_that_cannot_fill_is_refused_before_the_first_pixel(tiny, steep, tmp_path):
    scene, surface, output = steep
    common = {"scene": scene, "surface": surface}
    x, y, crs = 500_000.0, 4_000_000.0, _crs(32634)
    dtype = RasterSource(tiny.image).dtype
    elsewhere = other_ortho(tmp_path / "elsewhere.tif", Grid(crs, x, y, 10.0, 10.0, 60, 60), dtype=dtype)
    made = commands.rectify(tiny.image, tmp_path / "out", **common, output=output)
    place = RasterSource(made.files["ortho"])
    grid = Grid(crs, *_corner(place), 10.0, 10.0, 50, 50)
    bands = other_ortho(tmp_path / "bands.tif", grid, dtype=dtype, count=2)
    kind = other_ortho(tmp_path / "kind.tif", grid, dtype="float32")
    scaled = other_ortho(tmp_path / "scaled.tif", grid, dtype=dtype)
    dataset = gdal.Open(str(scaled), gdal.GA_Update)
    dataset.GetRasterBand(1).SetScale(0.5)
    dataset.FlushCache()
    bare = tmp_path / "bare.tif"
    gdal.GetDriverByName("GTiff").Create(str(bare), 20, 20, 1, gdal.GDT_Byte).FlushCache()
    for path, words in ((elsewhere, "does not overlap the scene"), (bands, "2 bands"), (kind, "float32"),
                        (scaled, "scale 0.5"), (bare, "CRS"), (tmp_path / "none.tif", "no such file")):  # fmt: skip
        with pytest.raises(InputError, match=words) as caught:
            commands.check(tiny.image, **common, output=dataclasses.replace(output, fill_from=path))
        assert caught.value.file == str(path)
        assert caught.value.field == ("CRS" if path == bare else "output.fill_from")
        assert caught.value.remedy
    for visibility in (None, "mask"):
        asked = dataclasses.replace(output, fill_from=bands, visibility=visibility)
        with pytest.raises(InputError, match="left empty"):
            commands.check(tiny.image, **common, output=asked)
    asked = dataclasses.replace(output, fill_from=made.files["ortho"])
    with pytest.raises(InputError, match="both input and output"):
        commands.rectify(tiny.image, tmp_path / "out", **common, output=asked)


def _corner(source: RasterSource) -> tuple[float, float]:
    left, _, _, top, _, _ = source.dataset.GetGeoTransform()
    return left, top
