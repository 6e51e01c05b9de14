"""`ortho register`: what a band has no value for stays without a value; types that would lose digits are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from scipy.ndimage import gaussian_filter

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.imaging.band_stack import stack_bands
from ortho_pipeline.imaging.registration import register

gdal.UseExceptions()
#: How far (columns, rows) the second band shows the ground displaced.
SHIFT = (6, -4)


def bands(folder: Path, kind: int = gdal.GDT_UInt16, nodata: int | None = 65_535) -> dict[str, Path]:
    """Write two bands, the left 60 columns of which have no value."""
    texture = gaussian_filter(np.random.default_rng(5).normal(size=(660, 660)), 1.5)
    texture = 800 + 2000 * (texture - texture.min())
    paths = {}
    for name, (right, down) in {"red": (0, 0), "nir": SHIFT}.items():
        path = paths[name] = folder / f"{name}.tif"
        pixels = texture[10 - down : 650 - down, 10 - right : 650 - right].copy()
        made = gdal.GetDriverByName("GTiff").Create(str(path), 640, 640, 1, kind)
        if nodata is not None:
            pixels[:, :60] = nodata
            made.GetRasterBand(1).SetNoDataValue(nodata)
        made.GetRasterBand(1).WriteArray(np.rint(pixels))
        made = None
    return paths


def test_pixels_without_a_value_have_none_in_the_stack(tmp_path):
    stack_bands(bands(tmp_path), tmp_path / "stack.tif")
    red, nir = gdal.Open(str(tmp_path / "stack.tif")).ReadAsArray()
    assert not red[:, :60].any()
    assert red[:, 60:].all()
    inner = nir[10:-10]
    # The edge of the band is where the reference shows its place.
    assert not inner[:, : 59 - SHIFT[0]].any()
    assert inner[:, 61 - SHIFT[0] : -10].all()
    # No value is spread by the resampling.
    difference = inner[:, 62:-10].astype(float) - red[10:-10, 62:-10]
    assert np.abs(difference).max() < 60


@pytest.mark.parametrize("kind", [gdal.GDT_UInt32, gdal.GDT_Int16, gdal.GDT_Float32])
def test_types_that_the_stack_cannot_hold_are_refused(tmp_path, kind):
    with pytest.raises(InputError, match="unsigned integers of 8 or 16 bits"):
        stack_bands(bands(tmp_path, kind, None), tmp_path / "stack.tif")
    assert not (tmp_path / "stack.tif").exists()


def test_images_too_small_for_tie_points_are_told_so():
    pixels = gaussian_filter(np.random.default_rng(1).uniform(0, 100, (250, 250)), 2)
    with pytest.raises(TooFewPoints) as caught:
        register([pixels, pixels], ["red", "nir"])
    assert "at least 500 pixels" in caught.value.remedy
