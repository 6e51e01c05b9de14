"""What an ortho takes over from its source: nodata, masks, types and names."""

from __future__ import annotations

import gc
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.errors import InputError
from ortho_pipeline.raster.ortho import Profile, classes_profile
from ortho_pipeline.raster.source import RasterSource


def source(path: Path, nodata: tuple[float | None, ...] = (None, None), kind: int = gdal.GDT_Int16) -> RasterSource:
    """Write bands of 4 x 3 pixels in a format that keeps a nodata value for each band."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path.with_suffix(".tif")), 4, 3, len(nodata), kind)
    dataset.FlushCache()
    view = gdal.GetDriverByName("VRT").CreateCopy(str(path), dataset)
    for number, value in enumerate(nodata, start=1):
        if value is not None:
            view.GetRasterBand(number).SetNoDataValue(value)
    view.GetRasterBand(1).SetDescription("red")
    view.GetRasterBand(1).SetColorInterpretation(gdal.GCI_RedBand)
    view.GetRasterBand(2).SetScale(0.25)
    view.GetRasterBand(2).SetOffset(-3.0)
    view.GetRasterBand(2).SetUnitType("m")
    view.FlushCache()
    del view, dataset
    return RasterSource(path)


@pytest.mark.parametrize(
    ("nodata", "kind", "validity", "value"),
    [
        ((None, None), gdal.GDT_Int16, "mask", None), ((-7, -7), gdal.GDT_Int16, "nodata", -7.0),
        ((-7, -8), gdal.GDT_Int16, "mask", None), ((-7, None), gdal.GDT_Int16, "mask", None),
        ((math.nan, math.nan), gdal.GDT_Float32, "nodata", math.nan), ((math.nan, 0), gdal.GDT_Float32, "mask", None),
    ],
)  # fmt: skip
def test_one_nodata_value_of_all_bands_is_kept(
    tmp_path: Path, nodata: Any, kind: int, validity: str, value: float | None
) -> None:
    found = Profile.of(source(tmp_path / "a.vrt", nodata, kind))
    assert (found.count, found.validity) == (2, validity)
    np.testing.assert_equal(found.nodata, value)


def test_scales_names_and_colours_are_those_of_the_bands(tmp_path: Path) -> None:
    found = Profile.of(source(tmp_path / "a.vrt"))
    assert found.descriptions == ("red", "")
    assert found.interpretations[0] == gdal.GCI_RedBand
    assert found.scales == ((1.0, 0.0, ""), (0.25, -3.0, "m"))
    assert found.dtype == np.int16


@pytest.mark.parametrize(
    ("dtype", "nodata", "fits"),
    [
        ("Byte", 255, True), ("Byte", 256, False), ("Byte", -1, False), ("Byte", 0.5, False), ("Int16", -32768, True),
        ("Int16", -32769, False), ("Float32", "nan", True), ("Int16", "nan", False), ("Float32", -1e30, True),
    ],
)  # fmt: skip
def test_a_nodata_value_is_one_of_the_type(tmp_path: Path, dtype: str, nodata: Any, fits: bool) -> None:
    raster = source(tmp_path / "a.vrt", (-7, -7))
    if fits:
        found = Profile.of(raster, dtype, nodata)
        np.testing.assert_equal((found.validity, found.nodata), ("nodata", float(nodata)))
    else:
        with pytest.raises(InputError, match="cannot have the value") as caught:
            Profile.of(raster, dtype, nodata)
        assert caught.value.field == "output.nodata"


def test_the_nodata_value_of_a_source_must_fit_into_another_type(tmp_path: Path) -> None:
    raster = source(tmp_path / "a.vrt", (-7, -7))
    with pytest.raises(InputError, match="-7 of the image does not fit into uint8") as caught:
        Profile.of(raster, "Byte")
    assert caught.value.field == "output.dtype"
    assert Profile.of(raster, "Int32").nodata == -7
    assert Profile.of(raster, "Byte", 9).nodata == 9


@pytest.mark.parametrize(
    ("kind", "dtype", "kept"),
    [
        (gdal.GDT_Byte, None, True), (gdal.GDT_UInt16, None, True), (gdal.GDT_Byte, "UInt16", True),
        (gdal.GDT_Byte, "Int16", False), (gdal.GDT_Byte, "Float32", False),
    ],
)  # fmt: skip
def test_a_palette_is_for_small_numbers_from_zero(tmp_path: Path, kind: int, dtype: str | None, kept: bool) -> None:
    path = tmp_path / "a.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), 4, 3, 1, kind)
    table = gdal.ColorTable()
    table.SetColorEntry(5, (10, 20, 30, 255))
    dataset.GetRasterBand(1).SetColorTable(table)
    del dataset
    # The palette stays when the raster is gone.
    colours = Profile.of(RasterSource(path), dtype).color_table
    gc.collect()
    assert (colours is not None and colours.GetColorEntry(5) == (10, 20, 30, 255)) is kept


def test_classes_have_names_and_opaque_colours() -> None:
    made = classes_profile("age", {1: ("new", "#0a141e"), 7: ("old", "#ff8001")}, {"UNIT": "years"})
    assert (made.count, made.dtype, made.validity, made.nodata) == (1, np.uint8, "nodata", 0.0)
    assert made.descriptions == ("age",)
    assert made.interpretations == (gdal.GCI_PaletteIndex,)
    assert [made.color_table.GetColorEntry(value) for value in (1, 7)] == [(10, 20, 30, 255), (255, 128, 1, 255)]
    assert made.metadata == {"CLASS_1": "new", "CLASS_7": "old", "UNIT": "years"}


def test_all_bands_but_alpha_have_colour() -> None:
    kinds = (gdal.GCI_RedBand, gdal.GCI_AlphaBand, gdal.GCI_Undefined)
    assert Profile(3, np.dtype("u1"), "mask", interpretations=kinds).colours == [0, 2]
    assert Profile(3, np.dtype("u1"), "mask").colours == [0, 1, 2]


def test_colour_tables_are_the_same_if_they_agree_in_the_colours_of_both() -> None:
    """Some formats have 256 colours whatever is in use, others as many as there are."""

    def shown(*colours: tuple[int, int, int, int]) -> Profile:
        table = gdal.ColorTable()
        for value, colour in enumerate(colours):
            table.SetColorEntry(value, colour)
        return Profile(1, np.dtype("u1"), "mask", color_table=table)

    red, blue = (255, 0, 0, 255), (0, 0, 255, 255)
    two, three = shown(red, blue), shown(red, blue, red)
    assert two.unlike(three, "a", "b") == three.unlike(two, "a", "b") == ""
    for other in (shown(red, red), shown(blue, blue), shown(red, red, red)):
        assert two.unlike(other, "a", "b") == "b and a have different colour tables"
