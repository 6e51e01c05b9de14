"""`ortho align`: an ortho comes to lie where its reference does; its pixels, type and mask stay what they are."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from osgeo import gdal
from pairs import BENT, SHIFTED, Pair

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.orthos import aligning
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import read_model_file
from ortho_pipeline.exchange.moved_grid import moved_geotransform, write_moved
from ortho_pipeline.geodesy.crs import parse_crs

gdal.UseExceptions()


def run(*words: Any) -> Result:
    return CliRunner().invoke(cli, list(map(str, words)))


def aligned(ortho: Path, reference: Path, folder: Path, *words: Any) -> dict[str, Any]:
    done = run("align", ortho, "--reference", reference, "-o", folder, "--json", *words)
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


def left_by(pair: Pair, folder: Path, name: str = "ortho") -> np.ndarray:
    """Return what the model that was found leaves of the true displacement, px, inside of the ortho."""
    model = read_model_file(folder / f"{name}_aligned_model.json").model
    image = np.random.default_rng(0).uniform(0.06, 0.94, (400, 2)) * pair.pixels
    ground = np.asarray(gdal_ground(pair, image)) - pair.displacement()(image)
    place = model.ground_to_image(np.column_stack([ground, np.zeros(400)]))
    return place - image


def gdal_ground(pair: Pair, image: np.ndarray) -> np.ndarray:
    return np.array([512_000.0, 7_123_000.0]) + image * [pair.ortho.gsd, -pair.ortho.gsd]


def test_a_bent_ortho_is_aligned_by_a_field(bent, tmp_path):
    document = aligned(*bent, tmp_path)
    assert document["correction"]["kind"] == "field"
    assert 0 < document["correction"]["bending_px_per_px"] <= 0.02
    assert np.sqrt((left_by(BENT, tmp_path) ** 2).sum(axis=1).mean()) < 0.1
    assert document["before"]["rmse_m"]["value"] > 5
    assert document["relative"]["rmse_m"]["value"] < 0.15
    page = (tmp_path / "ortho_align.html").read_text()
    assert "Before and after" in page
    made = document["provenance"]
    assert [one["path"] for one in made["inputs"]] == list(map(str, bent))
    assert [made["inputs"][0]["sha256"] in page, f" align {bent[0]} " in page] == [True, True]


def test_a_shifted_ortho_is_aligned_by_a_shift(shifted, tmp_path):
    document = aligned(*shifted, tmp_path, "--match-points", 150)
    assert document["correction"]["kind"] == "shift"
    np.testing.assert_allclose(document["correction"]["shift_px"], np.array(SHIFTED.shift) * (1, -1), atol=0.03)
    assert np.abs(left_by(SHIFTED, tmp_path)).max() < 0.05


@pytest.mark.parametrize("words", [("--shift-only",), ("--no-resample",)], ids=["resampled", "moved"])
def test_what_a_mask_hides_does_not_count_after_the_alignment(shifted, tmp_path, words):
    source = gdal.Open(str(shifted[0]))
    pixels = source.ReadAsArray()
    # A part of the ortho shows the ground elsewhere.
    pixels[:, :130] = np.roll(pixels, (-40, 50), (0, 1))[:, :130]
    ortho = gdal.GetDriverByName("GTiff").CreateCopy(str(tmp_path / "ortho.tif"), source)
    ortho.GetRasterBand(1).WriteArray(pixels)
    mask = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "mask.tif"), *pixels.shape[::-1], 1)
    mask.SetProjection(source.GetProjection())
    mask.SetGeoTransform(source.GetGeoTransform())
    mask.GetRasterBand(1).WriteArray((np.indices(pixels.shape)[1] < 130).astype(np.uint8))
    ortho = mask = None
    hidden = "--mask", tmp_path / "mask.tif"
    document = aligned(tmp_path / "ortho.tif", shifted[1], tmp_path / "out", *hidden, *words)
    np.testing.assert_allclose(document["correction"]["shift_px"], np.array(SHIFTED.shift) * (1, -1), atol=0.05)
    assert document["relative"]["ce90_m"]["value"] < 1.0
    reached = min(one["image"][0] for one in document["field"]["cells"])
    assert reached > 100


def test_type_nodata_bands_and_grid_are_kept(shifted, tmp_path):
    source = gdal.Open(str(shifted[0]))
    pixels = source.ReadAsArray()
    three = tmp_path / "three.tif"
    made = gdal.GetDriverByName("GTiff").Create(str(three), source.RasterXSize, source.RasterYSize, 3, gdal.GDT_Int16)
    made.SetProjection(source.GetProjection())
    made.SetGeoTransform(source.GetGeoTransform())
    made.SetMetadataItem("PRODUCT", "a mosaic")
    for number, name in enumerate(("red", "green", "nir"), start=1):
        band = made.GetRasterBand(number)
        band.WriteArray(np.where(np.arange(pixels.shape[1]) < 30, -9999, pixels.astype(int) // number).astype(np.int16))
        band.SetNoDataValue(-9999)
        band.SetDescription(name)
    made = None
    aligned(three, shifted[1], tmp_path / "out", "--match-points", 100)
    found = gdal.Open(str(tmp_path / "out" / "three_aligned.tif"))
    assert found.GetGeoTransform() == source.GetGeoTransform()
    assert (found.RasterXSize, found.RasterYSize, found.RasterCount) == (320, 320, 3)
    assert found.GetMetadataItem("PRODUCT") == "a mosaic"
    assert found.GetMetadataItem("LAYOUT", "IMAGE_STRUCTURE") == "COG"
    for number, name in enumerate(("red", "green", "nir"), start=1):
        band = found.GetRasterBand(number)
        assert band.DataType == gdal.GDT_Int16
        assert band.GetNoDataValue() == -9999
        assert band.GetDescription() == name
    values = found.ReadAsArray()
    # Displaced by 2.6 px to the west: the nodata in the first 30 columns reaches farther now.
    assert (values[:, 50, :31] == -9999).all()
    assert (values[:, 50, 40:300] != -9999).all()


@pytest.mark.parametrize("form", [pytest.param("COG", marks=pytest.mark.slow), "GTiff"])
def test_without_resampling_no_pixel_is_touched(shifted, tmp_path, form):
    earlier = tmp_path / f"ortho_aligned{'.tif' if form == 'COG' else '.vrt'}"
    for path in (earlier, tmp_path / "ortho_align.json"):
        path.write_text("of an earlier run")
    document = aligned(*shifted, tmp_path, "--shift-only", "--no-resample", "--format", form, "--match-points", 200)
    assert not earlier.exists()
    path = tmp_path / f"ortho_aligned{'.vrt' if form == 'COG' else '.tif'}"
    assert document["files"]["ortho"] == str(path)
    source, found = gdal.Open(str(shifted[0])), gdal.Open(str(path))
    np.testing.assert_array_equal(found.ReadAsArray(), source.ReadAsArray())
    moved = np.subtract(source.GetGeoTransform(), found.GetGeoTransform())[[0, 3]]
    np.testing.assert_allclose(moved, SHIFTED.shift, atol=0.03)
    assert document["relative"]["bias_px"]["value"] < 0.03
    assert not document["resampled"]


def test_a_moved_copy_keeps_what_is_in_side_cars(tmp_path, monkeypatch):
    """Its mask, its CRS and its place; the pixels are those of the original."""
    pixels = np.arange(2400, dtype=np.uint16).reshape(40, 60)
    made = gdal.GetDriverByName("GTiff").Create(
        str(tmp_path / "a.tif"), 60, 40, 1, gdal.GDT_UInt16, ["PROFILE=BASELINE"]
    )
    made.SetGeoTransform((5e5, 2.0, 0.0, 4e6, 0.0, -2.0))
    made.SetProjection(parse_crs("EPSG:32636").to_wkt())
    made.WriteArray(pixels)
    made.GetRasterBand(1).SetDescription("nir")
    monkeypatch.setenv("GDAL_TIFF_INTERNAL_MASK", "NO")
    made.CreateMaskBand(gdal.GMF_PER_DATASET)
    made.GetRasterBand(1).GetMaskBand().WriteArray(np.where(pixels % 60 < 30, 255, 0).astype(np.uint8))
    del made
    assert {path.name for path in tmp_path.iterdir()} == {"a.tif", "a.tif.aux.xml", "a.tif.msk"}
    write_moved(gdal.Open(str(tmp_path / "a.tif")), (5e5 + 7, 2.0, 0.0, 4e6, 0.0, -2.0), tmp_path / "b.tif")
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith("b.tif.")]
    copy = gdal.Open(str(tmp_path / "b.tif"))
    band = copy.GetRasterBand(1)
    np.testing.assert_array_equal(band.ReadAsArray(), pixels)
    np.testing.assert_array_equal(band.GetMaskBand().ReadAsArray() > 0, pixels % 60 < 30)
    assert copy.GetGeoTransform()[0] == 5e5 + 7
    assert parse_crs(copy.GetProjection()) == parse_crs("EPSG:32636")
    assert band.GetDescription() == "nir"


@pytest.mark.parametrize("overviews", [False, True])
def test_a_copy_has_the_mask_next_to_the_ortho_with_and_without_overviews(tmp_path, monkeypatch, overviews):
    pixels = np.random.default_rng(6).integers(1, 255, (60, 90), dtype=np.uint8)
    monkeypatch.setenv("GDAL_TIFF_INTERNAL_MASK", "NO")
    made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 90, 60, 1)
    made.SetGeoTransform((5e5, 2.0, 0.0, 4e6, 0.0, -2.0))
    made.WriteArray(pixels)
    made.CreateMaskBand(gdal.GMF_PER_DATASET)
    made.GetRasterBand(1).GetMaskBand().WriteArray(np.where(pixels % 60 < 30, 255, 0).astype(np.uint8))
    del made
    if overviews:
        gdal.Open(str(tmp_path / "a.tif")).BuildOverviews("NEAREST", [2])
    assert (tmp_path / "a.tif.ovr").exists() is overviews
    write_moved(gdal.Open(str(tmp_path / "a.tif")), (5e5 + 7, 2.0, 0.0, 4e6, 0.0, -2.0), tmp_path / "b.tif")
    copy = gdal.Open(str(tmp_path / "b.tif"))
    np.testing.assert_array_equal(copy.ReadAsArray(), pixels)
    np.testing.assert_array_equal(copy.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0, pixels % 60 < 30)


def test_a_geotransform_is_moved_along_its_own_axes():
    rotated = (1000.0, 3.0, 4.0, 2000.0, 4.0, -3.0)
    moved = moved_geotransform(rotated, np.array([2.0, -1.0]))
    # What was shown 2 columns and -1 row off is shown where it belongs.
    np.testing.assert_allclose(gdal.ApplyGeoTransform(moved, 12.0, 19.0), gdal.ApplyGeoTransform(rotated, 10.0, 20.0))


def test_a_local_change_does_not_move_the_whole(tmp_path):
    pair = Pair(side=400, seed=3, shift=(2.0, 1.0), patch=(6.0, 0.0))
    ortho, reference = pair.write(tmp_path)
    aligned(ortho, reference, tmp_path / "out")
    left = left_by(pair, tmp_path / "out")
    image = np.random.default_rng(0).uniform(0.06, 0.94, (400, 2))
    inside = ((image > 0.4) & (image < 0.85)).all(axis=1)
    assert np.abs(left[~inside]).max() < 0.08


def test_only_a_shift_is_corrected_where_that_is_asked_for(bent, tmp_path):
    document = aligned(*bent, tmp_path, "--shift-only", "--match-points", 100)
    assert document["correction"]["kind"] == "shift"
    # The mean displacement is gone; the bending is not.
    assert document["relative"]["bias_m"]["value"] < 0.1
    assert document["relative"]["rmse_m"]["value"] > 0.5


def test_the_ortho_is_no_reference_of_itself(shifted, tmp_path):
    folder = "-o", tmp_path / "out"
    assert run("align", shifted[0], "--reference", shifted[0], *folder).exit_code == 2
    assert not (tmp_path / "out").exists()


def test_the_ortho_appears_with_its_report_or_not_at_all(shifted, tmp_path, monkeypatch):
    """A full disk after the ortho left the new one beside the report of the old one."""
    first = aligned(*shifted, tmp_path, "--match-points", 60, "--no-resample", "--format", "GTiff")
    assert first["ortho"] == str(tmp_path / "ortho_aligned.tif")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def fail(*given: Any) -> None:
        raise InputError("cannot write here (No space left on device)")

    monkeypatch.setattr(aligning, "write_page", fail)
    done = run("align", shifted[0], "--reference", shifted[1], "-o", tmp_path, "--match-points", 60)
    assert done.exit_code == 2
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("which", [0, 1])
def test_an_input_that_changes_during_the_run_is_an_error(shifted, tmp_path, monkeypatch, which):
    """The correction of the old pixels was applied to the new ones."""
    paths = [shutil.copy(path, tmp_path) for path in shifted]
    choose = aligning._choose

    def changed(*given: Any) -> Any:
        os.utime(paths[which], ns=(1, 1))
        return choose(*given)

    monkeypatch.setattr(aligning, "_choose", changed)
    done = run(
        "align", paths[0], "--reference", paths[1], "-o", tmp_path / "out", "--match-points", 60, "--no-resample"
    )
    assert done.exit_code == 2
    assert f"{paths[which]}: this file changed during the run" in done.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("ortho", ["https://example.com/a.tif", "/vsizip/a.zip/a.tif"])
def test_a_moved_grid_needs_an_ortho_on_this_machine(ortho, tmp_path):
    """A VRT that names a file elsewhere is refused when it is read; the remedy named a temporary file."""
    done = run("align", ortho, "--reference", "b.tif", "-o", tmp_path / "out", "--no-resample", "--allow-network")
    assert done.exit_code == 2
    assert "needs an ortho that is a file on this machine" in done.output
    assert "copy the ortho to this machine, or resample it" in done.output
