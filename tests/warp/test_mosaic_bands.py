"""Mosaics of several bands: a value that one band lacks, bands that tell nothing, what bands have to share."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pyproj
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile, RasterWriter
from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.mosaic import Ortho, balanced, lay_out, overlaps, owners_of, write_cog, write_vrt

UTM = pyproj.CRS("EPSG:32636")
#: Three bands of a ground on which two orthos lie, the second 40 px right of the first.
GROUND = np.random.default_rng(4).integers(50, 200, (3, 60, 120)).astype(np.float64)
LEFT = {"a": 0, "b": 40}


def write(path: Path, pixels: np.ndarray, left: int, profile: Profile) -> Path:
    grid = Grid(UTM, 5e5 + 2.0 * left, 4e6, 2.0, 2.0, pixels.shape[2], pixels.shape[1])
    with RasterWriter(path, grid, profile, driver="GTiff") as writer:
        writer.write(0, 0, pixels.astype(profile.dtype), np.ones(pixels.shape[1:], dtype=bool))
    return path


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    dataset = gdal.Open(str(path))
    return dataset.ReadAsArray(), dataset.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0


# -- a value that one band lacks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", ["first-on-top", "seamlines", "most-accurate"])
@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_a_band_without_a_value_costs_the_other_bands_nothing(tmp_path, way, kind):
    """The first ortho lacks band 3 in a square, half of which the second fills; its west has no value in any band."""
    profile = Profile(3, np.dtype(kind), *(("nodata", 0.0) if kind is np.uint8 else ("mask", None)))
    empty, orthos, seen = (0 if kind is np.uint8 else math.nan), [], np.full((2, 3, 60, 120), np.nan)
    for number, (name, left) in enumerate(LEFT.items()):
        pixels = GROUND[:, :, left : left + 80] + number
        if name == "a":
            pixels[2, 20:40, 30:50] = pixels[:, :, :5] = np.nan
        seen[number, :, :, left : left + 80] = pixels
        path = write(tmp_path / f"{name}.tif", np.where(np.isnan(pixels), empty, pixels), left, profile)
        errors = np.full((1, 60, 80), 2.0 - number)
        accuracy = write(
            tmp_path / f"{name}_accuracy.tif", errors, left, Profile(1, np.dtype("float32"), "nodata", math.nan)
        )
        orthos.append(Ortho(name, path, accuracy=accuracy))
    placed = lay_out(orthos, "most-accurate" if way == "most-accurate" else "first-on-top")
    owners = owners_of(placed, None, seamlines=True) if way == "seamlines" else None
    write_cog(placed, tmp_path / "m.tif", owners=owners)
    values, valid = read(tmp_path / "m.tif")
    first, second = seen[::-1] if way == "most-accurate" else seen
    truth = np.where(np.isnan(first), second, first)
    known = ~np.isnan(truth)
    np.testing.assert_array_equal(known, ~np.isnan(values) if kind is np.float32 else values > 0)
    # In a GeoTIFF with nodata the mask of band 1 is that of band 1.
    np.testing.assert_array_equal(valid, known[0])
    assert known[0, 20:40, 30:40].all()
    assert not known[2, 20:40, 30:40].any()
    if owners is None:
        np.testing.assert_array_equal(values[known], truth[known])
    else:
        assert ((values == seen[0]) | (values == seen[1]))[known].all()


@pytest.mark.parametrize("write_mosaic", [write_cog, write_vrt])
def test_the_mosaic_keeps_names_and_units_and_fills_nan(tmp_path, write_mosaic):
    """Of orthos of floating point without nodata: the first has NaN in columns that the second has, too."""
    orthos = []
    for name, left in LEFT.items():
        pixels = GROUND[:, :, left : left + 80].astype(np.float32)
        if name == "a":
            pixels[:, :, 50:60] = np.nan
        made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"{name}.tif"), 80, 60, 3, gdal.GDT_Float32)
        made.SetProjection(UTM.to_wkt())
        made.SetGeoTransform((5e5 + 2.0 * left, 2.0, 0.0, 4e6, 0.0, -2.0))
        made.WriteArray(pixels)
        made.GetRasterBand(2).SetDescription("nir")
        made.GetRasterBand(2).SetUnitType("dB")
        del made
        orthos.append(Ortho(name, tmp_path / f"{name}.tif"))
    path = tmp_path / f"m{'.vrt' if write_mosaic is write_vrt else '.tif'}"
    write_mosaic(lay_out(orthos, "first-on-top"), path)
    np.testing.assert_array_equal(read(path)[0], GROUND)
    mosaic = gdal.Open(str(path))
    bands = [mosaic.GetRasterBand(number) for number in (1, 2)]
    assert [(band.GetDescription(), band.GetUnitType()) for band in bands] == [("", ""), ("nir", "dB")]


def test_a_vrt_of_orthos_whose_pixels_are_all_valid_has_no_empty_pixel(tmp_path):
    """Of integers, of which 0 is one."""
    orthos = []
    for name, left in LEFT.items():
        made = gdal.GetDriverByName("GTiff").Create(str(tmp_path / f"{name}.tif"), 80, 60, 1, gdal.GDT_Byte)
        made.SetProjection(UTM.to_wkt())
        made.SetGeoTransform((5e5 + 2.0 * left, 2.0, 0.0, 4e6, 0.0, -2.0))
        made.GetRasterBand(1).WriteArray(GROUND[0, :, left : left + 80] % 5)
        del made
        orthos.append(Ortho(name, tmp_path / f"{name}.tif"))
    write_vrt(lay_out(orthos, "first-on-top"), tmp_path / "m.vrt")
    mosaic = gdal.Open(str(tmp_path / "m.vrt"))
    assert mosaic.GetRasterBand(1).GetNoDataValue() is None
    values, valid = read(tmp_path / "m.vrt")
    assert valid.all()
    np.testing.assert_array_equal(values, GROUND[0] % 5)


# -- bands that tell nothing -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("last", ["alpha", "constant", "saturated"])
def test_bands_are_balanced_beside_one_that_has_no_brightness(tmp_path, last):
    """The second ortho is brighter by known gains and offsets. The last band of both orthos does not show them."""
    gains, offsets, orthos = np.array([2.0, 1.0, 3.0]), np.array([-10.0, 30.0, 5.0]), []
    colours = gdal.GCI_RedBand, gdal.GCI_GreenBand, gdal.GCI_BlueBand
    profile = Profile(
        4, np.dtype("uint16"), "alpha" if last == "alpha" else "mask",
        interpretations=(*colours, gdal.GCI_AlphaBand if last == "alpha" else gdal.GCI_Undefined),
    )  # fmt: skip
    for number, (name, left) in enumerate(LEFT.items()):
        pixels = GROUND[:, :, left : left + 80]
        pixels = pixels * gains[:, None, None] + offsets[:, None, None] if number else pixels
        extra = {
            "alpha": np.where(GROUND[0, :, left : left + 80] > 60, 65535, 20000 * (1 + number)),
            "constant": np.full((60, 80), 7.0),
            "saturated": np.full((60, 80), 65535.0),
        }[last]
        orthos.append(
            Ortho(name, write(tmp_path / f"{name}.tif", np.concatenate([pixels, extra[None]]), left, profile))
        )
    placed = lay_out(orthos, "first-on-top")
    balance = balanced(placed, overlaps(placed))
    assert balance.cells == 6
    np.testing.assert_allclose(balance.gains[:, :3], [2 * gains / (1 + gains), 2 / (1 + gains)], rtol=1e-3)
    np.testing.assert_allclose(balance.after, 0.0, atol=0.01)
    assert (balance.gains[:, 3], balance.offsets[:, 3]) == (pytest.approx(1.0, abs=0), pytest.approx(0.0, abs=0))
    write_cog(placed, tmp_path / "m.tif", balance=balance)
    values = gdal.Open(str(tmp_path / "m.tif")).ReadAsArray()
    exact = balance.gains[0, :3, None, None] * GROUND + balance.offsets[0, :3, None, None]
    np.testing.assert_allclose(values[:3], exact, rtol=0, atol=0.6)
    seen = [gdal.Open(str(ortho.path)).ReadAsArray()[3] for ortho in orthos]
    np.testing.assert_array_equal(values[3], np.concatenate([seen[0], seen[1][:, 40:]], axis=1))


# -- what bands have to share ----------------------------------------------------------------------------------------


def table(*colours: tuple[int, int, int, int]) -> gdal.ColorTable:
    made = gdal.ColorTable()
    for value, colour in enumerate(colours):
        made.SetColorEntry(value, colour)
    return made


BLUE, RED = (0, 0, 255, 255), (255, 0, 0, 255)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"scales": ((0.02, 0.0, ""),)},
            "band 1 of b.tif has scale 0.02 and offset 0, but that of a.tif has 0.01 and 0",
        ),
        ({"scales": ((0.01, -1.0, ""),)}, "has scale 0.01 and offset -1, but"),
        ({"color_table": table(RED, BLUE)}, "b.tif and a.tif have different colour tables"),
        ({"color_table": None}, "different colour tables"),
        ({}, ""),
    ],
)
def test_equal_pixels_must_mean_the_same(tmp_path, changes, message):
    one = Profile(1, np.dtype("uint8"), "mask", scales=((0.01, 0.0, ""),), color_table=table(BLUE, RED))
    orthos = [
        Ortho(name, write(tmp_path / f"{name}.tif", np.ones((1, 20, 80)), LEFT[name], profile))
        for name, profile in (("a", one), ("b", dataclasses.replace(one, **changes)))
    ]
    if not changes:
        assert len(lay_out(orthos).layers) == 2
        return
    with pytest.raises(InputError, match=message) as refused:
        lay_out(orthos, "first-on-top")
    assert refused.value.file == str(tmp_path / "b.tif")
