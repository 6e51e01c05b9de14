"""Mosaics: pixels taken over unchanged, the right one on top, seams measured against shifts that are known."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import os
import weakref
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from click.testing import CliRunner
from osgeo import gdal
from scipy.ndimage import gaussian_filter, shift

from ortho_pipeline.batch import runner as batch
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid, RasterSource, open_dataset
from ortho_pipeline.report.mosaic.document import mosaic_document
from ortho_pipeline.warp.mosaic import Ortho, lay_out, measure_seam, overlaps, reading, write_cog, write_vrt, writing
from ortho_pipeline.warp.mosaic.layout import intersection

UTM = pyproj.CRS("EPSG:32635")
SIDE = 700


@pytest.fixture(scope="module")
def landscape() -> np.ndarray:
    """Return a textured image that orthos are cut from."""
    random = np.random.default_rng(1)
    texture = sum(gaussian_filter(random.normal(size=(SIDE, SIDE)), s) * s for s in (1.5, 3, 8))
    return 6000 + 600 * texture / texture.std()


def cut(
    folder: Path, name: str, pixels: np.ndarray, column: int, row: int, width: int, height: int, **options: Any
) -> Ortho:
    """Write a window of an image as an ortho; a slanted corner of it has no values."""
    values = pixels[row : row + height, column : column + width]
    valid = np.add.outer(np.arange(height), np.arange(width)) > options.get("corner", 60)
    kind, nodata = options.get("validity", "mask"), options.get("nodata")
    dtype = np.dtype(options.get("dtype", "uint16"))
    profile = Profile(1, dtype, kind, nodata)
    step = options.get("step", 2.0)
    grid = Grid(options.get("crs", UTM), 500000 + column * 2.0 + options.get("off", 0.0), 4e6 - row * 2.0, step, step,
                width, height)  # fmt: skip
    path = folder / name / f"{name}_ortho.tif"
    with RasterWriter(path, grid, profile, driver=options.get("driver", "COG")) as writer:
        filled = np.where(valid, values, 0 if nodata is None else nodata).astype(dtype)
        writer.write(0, 0, filled[None], valid)
    return Ortho(name, path, options.get("relief_displacement"))


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    dataset = open_dataset(path)
    band = dataset.GetRasterBand(1)
    return band.ReadAsArray(), band.GetMaskBand().ReadAsArray() > 0


@pytest.mark.parametrize(
    "options",
    [{}, {"validity": "nodata", "nodata": 7.0}, {"dtype": "float32", "validity": "nodata", "nodata": math.nan}],
)
def test_vrt_and_cog_are_the_same_pixels(tmp_path, landscape, options):
    a = cut(tmp_path, "a", landscape, 40, 30, 300, 260, relief_displacement=0.4, **options)
    b = cut(tmp_path, "b [x]", landscape + 3000, 200, 130, 300, 260, relief_displacement=0.1, **options)
    c = cut(tmp_path, "c", landscape + 6000, 250, 20, 200, 200, relief_displacement=None, **options)
    expected = np.zeros((360, 460))
    for order, on_top in (("best-view", "ba?"), ("first-on-top", "abc")):
        placed = lay_out([a, b, c], order)
        assert "".join(layer.ortho.name[0] for layer in placed.layers).startswith(on_top[:2])
        assert (placed.grid.width, placed.grid.height) == (460, 370)
        assert placed.grid.extent == (500080, 4e6 - 780, 501000, 4e6 - 40)
        write_vrt(placed, tmp_path / "m.vrt")
        write_cog(placed, tmp_path / "m.tif")
        expected, known = np.zeros((370, 460)), np.zeros((370, 460), dtype=bool)
        for layer in reversed(placed.layers):
            values, valid = read(layer.ortho.path)
            place = slice(layer.top, layer.top + values.shape[0]), slice(layer.left, layer.left + values.shape[1])
            expected[place] = np.where(valid, values, expected[place])
            known[place] |= valid
        for path in (tmp_path / "m.vrt", tmp_path / "m.tif"):
            values, valid = read(path)
            np.testing.assert_array_equal(valid, known)
            np.testing.assert_array_equal(values[known], expected[known])
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    names = [element.text for element in ET.parse(tmp_path / "m.vrt").getroot().iter("SourceFilename")]
    assert set(names) == {"a/a_ortho.tif", "b [x]/b [x]_ortho.tif", "c/c_ortho.tif"}


def test_a_mosaic_larger_than_its_windows(tmp_path, landscape, monkeypatch):
    orthos = [cut(tmp_path, f"s{i}", landscape + 100 * i, 90 * i, 70 * i, 250, 230) for i in range(4)]
    placed = lay_out(orthos, "first-on-top")
    write_cog(placed, tmp_path / "one.tif")
    monkeypatch.setattr(writing, "_WINDOW", 97)
    write_cog(placed, tmp_path / "many.tif")
    for one, many in zip(read(tmp_path / "one.tif"), read(tmp_path / "many.tif"), strict=True):
        np.testing.assert_array_equal(one, many)


def test_few_of_many_orthos_are_open_at_a_time(tmp_path, landscape, monkeypatch):
    orthos = [cut(tmp_path, f"s{i}", landscape, 50 * i, 30 * i, 200, 180) for i in range(7)]
    placed, alive = lay_out(orthos, "first-on-top"), weakref.WeakSet()
    write_cog(placed, tmp_path / "one.tif")

    class Counted(RasterSource):
        def __init__(self, *words, **more):
            super().__init__(*words, **more)
            alive.add(self)
            assert len(alive) <= 3

    monkeypatch.setattr(reading, "_OPEN", 2)
    monkeypatch.setattr(reading, "RasterSource", Counted)
    write_cog(placed, tmp_path / "few.tif")
    for one, few in zip(read(tmp_path / "one.tif"), read(tmp_path / "few.tif"), strict=True):
        np.testing.assert_array_equal(one, few)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"off": 0.5}, "off the grid of 'a_ortho.tif' by 0.250 px"),
        ({"step": 2.5}, "2.5 x 2.5"),
        ({"crs": pyproj.CRS("EPSG:32636")}, "zone 36N"),
        ({"dtype": "uint8"}, "1 band of uint8"),
        (
            {"validity": "nodata", "nodata": 0.0},
            "b_ortho.tif marks empty pixels by the nodata value 0, but a_ortho.tif by its mask",
        ),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, landscape, options, message):
    a = cut(tmp_path, "a", landscape / 50, 0, 0, 100, 100)
    b = cut(tmp_path, "b", landscape / 50, 50, 50, 100, 100, **options)
    with pytest.raises(InputError, match=message) as caught:
        lay_out([a, b])
    assert caught.value.file == str(b.path)
    with pytest.raises(InputError, match="needs at least one ortho"):
        lay_out([])


def oblong(folder: Path, name: str, column: int, row: int, size: tuple[int, int], pixel: tuple[float, float]) -> Ortho:
    """Write an ortho of one value whose corner is a pixel of 2 x 3 m."""
    grid = Grid(UTM, 500000 + 2.0 * column, 4e6 - 3.0 * row, *pixel, *size)
    path = folder / f"{name}.tif"
    with RasterWriter(path, grid, Profile(1, np.dtype("uint8"), "mask", None), driver="GTiff") as writer:
        writer.write(0, 0, np.full((1, *size[::-1]), ord(name), dtype=np.uint8), np.ones(size[::-1], dtype=bool))
    return Ortho(name, path)


def test_the_command_for_another_grid_does_not_mix_palette_indices(tmp_path):
    colours, orthos = gdal.ColorTable(), []
    colours.SetColorEntry(1, (200, 100, 50))
    for name, left in (("a", 500000.0), ("b", 500000.7)):
        for table, kernel in ((None, "cubic"), (colours, "nearest")):
            path = tmp_path / f"{name}_{kernel}.tif"
            profile = Profile(1, np.dtype("uint8"), "nodata", 0.0, color_table=table)
            with RasterWriter(path, Grid(UTM, left, 4e6, 2.0, 2.0, 20, 20), profile, driver="GTiff") as writer:
                writer.write(0, 0, np.ones((1, 20, 20), dtype=np.uint8), None)
            orthos.append(Ortho(f"{name} {kernel}", path))
    for kernel in ("cubic", "nearest"):
        with pytest.raises(InputError) as caught:
            lay_out([ortho for ortho in orthos if ortho.name.endswith(kernel)])
        assert f" -r {kernel} " in str(caught.value.remedy)


@pytest.mark.parametrize(
    ("kernels", "apart"), [(("nearest", "nearest"), True), (("nearest", "bilinear"), False), (("nearest", None), False)]
)
def test_overviews_of_classes_have_classes(tmp_path, kernels, apart):
    """With the default of GDAL (cubic), classes 1 and 8 had values from 1 to 9."""
    grid = Grid(UTM, 500000.0, 4e6, 2.0, 2.0, 600, 520)
    classes = (np.random.default_rng(0).integers(0, 2, (1, 520, 600)) * 7 + 1).astype(np.uint8)
    with RasterWriter(tmp_path / "a.tif", grid, Profile(1, np.dtype("uint8"), "nodata", 0.0), driver="GTiff") as writer:
        writer.write(0, 0, classes, None)
    orthos = [Ortho(name, tmp_path / "a.tif", resampling=kernel) for name, kernel in zip("ab", kernels, strict=True)]
    write_cog(lay_out(orthos), tmp_path / "m.tif")
    mosaic = open_dataset(tmp_path / "m.tif")
    overview = mosaic.GetRasterBand(1).GetOverview(0).ReadAsArray()
    assert (set(np.unique(overview)) == {1, 8}) is apart


def test_orthos_of_oblong_pixels_lie_where_their_corners_are(tmp_path):
    a = oblong(tmp_path, "a", 25, 20, (50, 45), (2.0, 3.0))
    b = oblong(tmp_path, "b", 0, 0, (40, 30), (2.0, 3.0))
    placed = lay_out([a, b], "first-on-top")
    assert placed.grid.extent == (500000, 4e6 - 3 * 65, 500000 + 2 * 75, 4e6)
    assert [(layer.left, layer.top) for layer in placed.layers] == [(25, 20), (0, 0)]
    wanted = np.zeros((65, 75))
    wanted[:30, :40] = ord("b")
    wanted[20:, 25:] = ord("a")
    write_cog(placed, tmp_path / "m.tif")
    values, valid = read(tmp_path / "m.tif")
    np.testing.assert_array_equal(np.where(valid, values, 0), wanted)
    (pair,) = overlaps(placed)
    assert pair.pixels == pytest.approx(15 * 10)


@pytest.mark.parametrize("pixel", [(2.0, 3.5), (2.5, 3.0)])
def test_pixels_that_differ_on_one_axis_are_refused(tmp_path, pixel):
    a, b = (oblong(tmp_path, name, 0, 0, (40, 30), size) for name, size in (("a", (2.0, 3.0)), ("b", pixel)))
    with pytest.raises(InputError, match=f"{pixel[0]:g} x {pixel[1]:g}"):
        lay_out([a, b])


@pytest.mark.parametrize(
    ("other", "common"),
    [((10, 5, 20, 15), (10, 5, 12, 8)), ((12, 0, 20, 8), None), ((2, 8, 12, 9), None), ((0, 0, 3, 4), (2, 1, 3, 4))],
)
def test_boxes_that_only_touch_have_nothing_in_common(other, common):
    assert intersection((2, 1, 12, 8), other) == common
    assert intersection(other, (2, 1, 12, 8)) == common


def test_the_figures_of_a_seam_are_by_their_definitions(tmp_path, landscape, monkeypatch):
    a, b = (cut(tmp_path, name, landscape, 60 * k, 0, 120, 120) for k, name in enumerate("ab"))
    module, shifts = inspect.getmodule(measure_seam), np.array([[3.0, 4.0], [0.0, 1.0], [0.0, 0.0]])
    monkeypatch.setattr(module, "_shifts", lambda *_: shifts)
    (pair,) = overlaps(lay_out([a, b], "first-on-top"))
    seam = measure_seam(pair)
    assert (seam["patches"], seam["median_px"], seam["largest_px"]) == (3, [0.0, 1.0], 5.0)
    assert seam["rmse_px"] == pytest.approx(math.sqrt(26 / 3))
    monkeypatch.setattr(module, "_shifts", lambda *_: shifts[:1])
    one = measure_seam(pair)
    assert (one["patches"], one["median_px"], one["rmse_px"], one["largest_px"]) == (1, [3.0, 4.0], 5.0, 5.0)


@pytest.mark.parametrize(("columns", "rows"), [(0.0, 0.0), (0.4, -0.25), (3.3, 1.6), (-9.0, 14.5)])
def test_a_seam_is_the_shift_of_the_content(tmp_path, landscape, columns, rows):
    moved = shift(landscape, (rows, columns), order=3, mode="reflect")
    a = cut(tmp_path, "a", landscape, 0, 0, 450, 450)
    b = cut(tmp_path, "b", moved, 100, 150, 450, 450)
    (pair,) = overlaps(lay_out([a, b], "first-on-top"))
    # The slanted corners are missing from an overlap of 350 x 300.
    assert pair.pixels == pytest.approx(350 * 300 - 60 * 60 / 2, rel=0.02)
    seam = measure_seam(pair)
    # Of 128 px every 64 px, as many as fit.
    assert 5 <= seam["patches"] <= (350 // 64) * (300 // 64)
    # The correlation finds hundredths of a pixel; shifts of half a pixel are pulled back by a few of them.
    assert seam["median_px"] == pytest.approx([columns, rows], abs=0.05)
    assert seam["rmse_px"] == pytest.approx(math.hypot(columns, rows), abs=0.08)


def test_seams_without_detail_or_room(tmp_path, landscape):
    flat = np.full_like(landscape, 500.0)
    a = cut(tmp_path, "a", landscape, 0, 0, 300, 300)
    b = cut(tmp_path, "b", flat, 150, 0, 300, 300)
    c = cut(tmp_path, "c", landscape, 290, 0, 300, 300, corner=-1)
    d = cut(tmp_path, "d", landscape, 0, 400, 100, 100)
    placed = lay_out([a, b, c, d], "first-on-top")
    found = [measure_seam(pair) for pair in overlaps(placed)]
    assert [(seam["first"], seam["second"]) for seam in found] == [("a", "b"), ("a", "c"), ("b", "c")]
    assert all(seam["patches"] == 0 and seam["median_px"] is None for seam in found)
    summary = mosaic_document(placed, found)
    assert (summary["seams_measured"], summary["worst_seam"], summary["median_seam_px"]) == (0, None, None)
    json.dumps(summary, allow_nan=False)


# -- within a run ----------------------------------------------------------------------------------------------------

FILE = """
defaults:
  surface: {dem: dem.tif, vertical: ellipsoid}
  output: {crs: "EPSG:32734", resolution: 5}
scenes:
  - images: raw/*.tif
mosaic: {format: FORMAT, order: first-on-top}
"""


@pytest.fixture
def block(tiny: Any, tmp_path: Path, landscape: np.ndarray) -> Path:
    """Make three overlapping scenes of one picture, the third with an RPC that is 2 columns and -1 row wrong."""
    folder = tmp_path / "block"
    (folder / "raw").mkdir(parents=True)
    (folder / "dem.tif").write_bytes(tiny.dem.read_bytes())
    for number, (column, row, wrong) in enumerate([(0, 0, (0, 0)), (150, 60, (0, 0)), (100, 20, (2, -1))]):
        model = dataclasses.replace(
            tiny.model, col_off=tiny.model.col_off - column + wrong[0], row_off=tiny.model.row_off - row + wrong[1]
        )
        path = folder / "raw" / f"s{number}.tif"
        dataset = gdal.GetDriverByName("GTiff").Create(str(path), 240, 220, 1, gdal.GDT_UInt16)
        dataset.SetMetadata(rpc_metadata(model), "RPC")
        dataset.WriteArray(landscape[row : row + 220, column : column + 240].astype(np.uint16))
        dataset = None
    return folder


def test_a_run_ends_in_a_mosaic(block):
    (block / "p.yaml").write_text(FILE.replace("FORMAT", "VRT"))
    done = CliRunner().invoke(cli, ["run", str(block / "p.yaml"), "--executor", "sequential"])
    assert done.exit_code == 0, done.output
    assert "seams: 3 of 3 measured" in done.stdout
    document = json.loads((block / "out" / "mosaic.json").read_text())
    seams = {(seam["first"], seam["second"]): seam for seam in document["seams"]}
    grid = open_dataset(block / "out" / "s0" / "s0_ortho.tif").GetGeoTransform()
    assert document["resolution"] == [grid[1], -grid[5]]
    # 4.8 m pixels in 5 m ones: an RPC that says too large a column shows the ground too far west.
    assert np.hypot(*seams["s0", "s1"]["median_px"]) < 0.1
    for pair in (("s0", "s2"), ("s1", "s2")):
        assert seams[pair]["median_px"] == pytest.approx([-2 * 4.8 / 5, 1 * 4.8 / 5], abs=0.15)
    assert document["worst_seam"]["px"] > 2
    values, valid = read(block / "out" / "mosaic.vrt")
    assert valid.mean() > 0.5
    before = (block / "out" / "mosaic.vrt").stat().st_mtime_ns
    again = batch.run(block / "p.yaml", executor="sequential")
    assert again.mosaic["status"] == "unchanged"
    assert (block / "out" / "mosaic.vrt").stat().st_mtime_ns == before
    # A report that is none, of the size and the date that the record knows.
    report = block / "out" / "mosaic.json"
    state = report.stat()
    report.write_bytes(b"{" * state.st_size)
    os.utime(report, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert batch.run(block / "p.yaml", executor="sequential").mosaic["status"] == "done"
    assert json.loads(report.read_text())["worst_seam"]["px"] > 2
    (block / "out" / "mosaic.vrt").unlink()
    assert batch.run(block / "p.yaml", executor="sequential").mosaic["status"] == "done"
    (block / "p.yaml").write_text(FILE.replace("FORMAT", "COG, seamlines: true, balance: true"))
    chosen = batch.run(block / "p.yaml", executor="sequential")
    assert chosen.mosaic["balance"]["cells"] > 10
    assert all(seam["after"] for seam in chosen.mosaic["seams"] if seam["before"])
    assert "along the seams" in (block / "out" / "mosaic.html").read_text().lower()
    (block / "p.yaml").write_text(FILE.replace("FORMAT", "COG"))
    other = batch.run(block / "p.yaml", executor="sequential")
    assert other.mosaic["status"] == "done"
    assert not (block / "out" / "mosaic.vrt").exists()
    for one, two in zip((values, valid), read(block / "out" / "mosaic.tif"), strict=True):
        np.testing.assert_array_equal(np.where(valid, one, 0), np.where(valid, two, 0))


def test_a_mosaic_says_what_is_missing_and_parts_make_none(block):
    (block / "p.yaml").write_text(FILE.replace("FORMAT", "VRT"))
    assert batch.run(block / "p.yaml", executor="sequential", only=["s0"]).mosaic is None
    (block / "raw" / "s1.tif").write_bytes(b"no image")
    done = CliRunner().invoke(cli, ["run", str(block / "p.yaml"), "--executor", "sequential"])
    assert done.exit_code == 3
    assert "not in the mosaic: s1" in done.stdout
    (block / "p.yaml").write_text(
        FILE.replace("FORMAT", "VRT").replace("scenes:", "scenes:\n  - image: raw/s2.tif\n    output: {resolution: 4}")
    )
    wrong = CliRunner().invoke(cli, ["run", str(block / "p.yaml"), "--executor", "sequential"])
    assert wrong.exit_code == 3
    assert "'s2_ortho.tif' has 4 x 4" in wrong.stdout
    for field in ("crs", "resolution"):
        text = FILE.replace('crs: "EPSG:32734", ', "") if field == "crs" else FILE.replace(", resolution: 5", "")
        (block / "p.yaml").write_text(text.replace("FORMAT", "VRT"))
        with pytest.raises(InputError, match="need a common grid") as caught:
            batch.run(block / "p.yaml", executor="sequential")
        assert caught.value.field == f"defaults.output.{field}"


def test_the_most_accurate_ortho_has_each_pixel(tmp_path, landscape):
    """Two orthos over each other, each twice as accurate as the other in one half; unknown is worst."""
    made = []
    for name, ramp in (("a", (1.0, 4.0)), ("b", (2.0, 2.0))):
        ortho = cut(tmp_path, name, landscape + 3000 * (name == "b"), 40, 30, 300, 260, relief_displacement=0.1)
        path = ortho.path.with_name(f"{name}_accuracy.tif")
        grid = Grid(UTM, 500080, 4e6 - 60, 2.0 * 16, 2.0 * 16, 19, 17)
        with RasterWriter(path, grid, Profile(4, np.dtype("float32"), "nodata", math.nan)) as writer:
            ce90 = np.where(np.arange(19) < 10, *ramp) * np.ones((17, 1))
            ce90[0] = np.nan if name == "b" else ce90[0]
            writer.write(0, 0, np.stack([ce90] * 4).astype(np.float32), None)
        made.append(dataclasses.replace(ortho, accuracy=path))
    write_cog(lay_out(made, "most-accurate"), tmp_path / "m.tif")
    values, valid = read(tmp_path / "m.tif")
    one, both = (read(ortho.path) for ortho in made)
    np.testing.assert_array_equal(valid, one[1] | both[1])
    west = np.arange(300) < 160
    np.testing.assert_array_equal(values[16:, west][valid[16:, west]], one[0][16:, west][valid[16:, west]])
    np.testing.assert_array_equal(values[16:, ~west][valid[16:, ~west]], both[0][16:, ~west][valid[16:, ~west]])
    np.testing.assert_array_equal(values[:16][valid[:16]], one[0][:16][valid[:16]])
    with pytest.raises(InputError, match="pixel by pixel"):
        write_vrt(lay_out(made, "most-accurate"), tmp_path / "m.vrt")
    with pytest.raises(InputError, match="no accuracy raster"):
        lay_out([made[0], dataclasses.replace(made[1], accuracy=None)], "most-accurate")


def test_an_image_without_a_map_grid_is_no_part_of_a_mosaic(tmp_path):
    path = tmp_path / "raw.tif"
    gdal.GetDriverByName("GTiff").Create(str(path), 8, 8).FlushCache()
    done = CliRunner().invoke(cli, ["mosaic", str(path), "-o", str(tmp_path / "mosaic.tif")])
    assert "raw.tif: CRS: this raster has no coordinate system" in done.output
    assert "rectify the image" in done.output


@pytest.mark.parametrize(
    ("crs", "remedy"), [("EPSG:32636+5773", "if this is a DEM"), ("EPSG:32637", "rectify its scene again")]
)
def test_a_raster_in_another_crs_is_refused_with_what_it_probably_is(tmp_path, crs, remedy):
    for name, its in (("a", "EPSG:32636"), ("b", crs)):
        raster = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"{name}.tif"), 8, 8)
        raster.SetProjection(pyproj.CRS(its).to_wkt())
        raster.SetGeoTransform((500000.0, 10.0, 0.0, 4100000.0, 0.0, -10.0))
        raster.FlushCache()
    paths = [str(tmp_path / f"{name}.tif") for name in "ab"]
    done = CliRunner().invoke(cli, ["mosaic", *paths, "-o", str(tmp_path / "m.tif"), "--order", "first-on-top"])
    assert done.exit_code == 2
    assert remedy in " ".join(done.output.split())


@pytest.mark.parametrize("lost", ["b", "pixels"])
def test_a_vrt_that_lacks_an_ortho_or_pixels_is_refused(tmp_path, landscape, monkeypatch, lost):
    """GDAL leaves out what it cannot use, with a warning."""
    a, b = (cut(tmp_path, name, landscape, 60 * k, 0, 120, 120) for k, name in enumerate("ab"))
    build = gdal.BuildVRT

    def built(path, names, **more):
        if lost == "b":
            return build(path, [name for name in names if name != str(b.path)], **more)
        left, bottom, right, top = more.pop("outputBounds")
        return build(path, names, outputBounds=(left, bottom + 2.0, right, top), **more)

    monkeypatch.setattr(writing.gdal, "BuildVRT", built)
    with pytest.raises(InputError, match=f"would lose {lost}"):
        write_vrt(lay_out([a, b], "first-on-top"), tmp_path / "m.vrt")
    assert not (tmp_path / "m.vrt").exists()


def test_the_edge_of_the_values_is_not_taken_for_content(tmp_path, landscape):
    """Both orthos are empty in the same half of the overlap; the content of the second is displaced."""
    moved = shift(landscape, (-3.0, 4.0), order=3, mode="reflect")
    orthos = []
    for name, picture in (("a", landscape), ("b", moved)):
        values = np.where(np.arange(400) < 200, 0, picture[100:500, 100:500])
        grid = Grid(UTM, 500000.0, 4e6, 2.0, 2.0, 400, 400)
        with RasterWriter(tmp_path / f"{name}.tif", grid, Profile(1, np.dtype("uint16"), "nodata", 0.0)) as writer:
            writer.write(0, 0, values.astype(np.uint16)[None], None)
        orthos.append(Ortho(name, tmp_path / f"{name}.tif"))
    (pair,) = overlaps(lay_out(orthos, "first-on-top"))
    seam = measure_seam(pair)
    assert seam["patches"] >= 4
    assert seam["median_px"] == pytest.approx([4.0, -3.0], abs=0.05)
    assert (seam["rmse_px"], seam["largest_px"]) == (pytest.approx(5.0, abs=0.1), pytest.approx(5.0, abs=0.3))
