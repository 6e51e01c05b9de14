"""Pictures of rasters."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.raster.quicklook import percentile, preview_png, reduced_grid, shaded_png
from ortho_pipeline.raster.source import Grid


def picture(png: bytes) -> np.ndarray:
    """Return a PNG as bands ``(n, h, w)``, read by GDAL."""
    gdal.FileFromMemBuffer("/vsimem/quicklook.png", png)
    try:
        pixels = gdal.Open("/vsimem/quicklook.png").ReadAsArray()
    finally:
        gdal.Unlink("/vsimem/quicklook.png")
    return pixels if pixels.ndim == 3 else pixels[None]


def test_percentiles_are_those_of_numpy_to_the_last_bit() -> None:
    random = np.random.default_rng(0)
    for count in [*range(1, 60), 1000, 100_001]:
        for values in (random.normal(300, 10 ** random.uniform(-3, 5), count), random.integers(0, 5, count) * 1.0):
            for percent in (0.0, 1.0, 50.0, 99.0, 100.0):
                assert percentile(values, percent) == np.percentile(values, percent)


def test_grey_runs_from_the_first_to_the_last_percentile() -> None:
    pixels = np.arange(10_000, dtype=np.uint16).reshape(1, 100, 100)
    grey = picture(shaded_png(pixels, np.ones((100, 100), bool)))
    assert grey.shape == (1, 100, 100), "a picture without gaps needs no alpha"
    wanted = np.clip((pixels[0] - 99.99) / (9899.01 - 99.99), 0, 1) * 255
    assert np.abs(grey[0] - wanted).max() <= 1
    assert (grey[0].ravel()[:100] == 0).all()
    assert (grey[0].ravel()[-100:] == 255).all()


def test_what_has_no_value_is_transparent_and_does_not_count() -> None:
    pixels = np.stack([np.tile(np.linspace(10, 20, 50), (50, 1)), np.full((50, 50), 7.0), np.full((50, 50), np.nan)])
    pixels[:, :, :10] = 9999.0
    valid = np.tile(np.arange(50) >= 10, (50, 1))
    red, green, blue, alpha = picture(shaded_png(pixels, valid))
    np.testing.assert_array_equal(alpha, np.where(valid, 255, 0))
    assert (red[:, 10].max(), red[:, -1].min()) == (0, 255)
    assert not green[valid].any(), "a band of one value is black"
    assert not blue[valid].any(), "and one of none, too"


@pytest.mark.parametrize(
    ("size", "side", "reduced"), [((1000, 400), 100, (100, 40)), ((3, 2000), 100, (1, 100)), ((50, 30), 100, (50, 30))]
)
def test_a_picture_covers_its_raster(
    tmp_path: Path, size: tuple[int, int], side: int, reduced: tuple[int, int]
) -> None:
    grid = Grid(parse_crs("EPSG:32633"), 500_000.0, 4_000_000.0, 2.0, 5.0, *size)
    small = reduced_grid(grid, side)
    assert (small.width, small.height) == reduced
    assert small.extent == pytest.approx(grid.extent)
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), *size, 2)
    dataset.GetRasterBand(1).WriteArray(np.indices(size[::-1]).sum(axis=0) % 200)
    del dataset
    seen = picture(preview_png(tmp_path / "a.tif", side=side))
    assert seen.shape == (1, *reduced[::-1]), "two bands are shown as grey"


def test_three_bands_are_colours_in_their_order(tmp_path: Path) -> None:
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 40, 30, 4, options=["ALPHA=NO"])
    ramps = np.indices((30, 40))
    for band, values in enumerate((ramps[0], ramps[1], 60 - ramps[0], ramps[1] * 0), start=1):
        dataset.GetRasterBand(band).WriteArray(values)
    del dataset
    red, green, blue = (band.astype(int) for band in picture(preview_png(tmp_path / "a.tif")))
    assert red.shape == (30, 40)
    assert (np.diff(red, axis=0)[2:-2] > 0).all()
    assert (np.diff(green, axis=1)[:, 2:-2] > 0).all()
    assert (np.diff(blue, axis=0)[2:-2] < 0).all()


@pytest.mark.parametrize("kind", [gdal.GDT_Float32, gdal.GDT_Int16, gdal.GDT_CFloat32])
def test_larger_values_are_brighter_and_complex_ones_by_their_magnitude(tmp_path: Path, kind: int) -> None:
    """Backscatter in dB is negative."""
    values = np.tile(np.linspace(-200, 94, 50), (20, 1))
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 50, 20, 1, kind)
    dataset.GetRasterBand(1).WriteArray(values * 1j if kind == gdal.GDT_CFloat32 else values)
    del dataset
    seen = np.abs(values) if kind == gdal.GDT_CFloat32 else values
    low, high = np.percentile(seen, (1, 99))
    grey = picture(preview_png(tmp_path / "a.tif"))[0]
    assert np.abs(grey - np.clip((seen - low) / (high - low), 0, 1) * 255).max() <= 1


def test_a_picture_of_a_raster_with_overviews_shows_means(tmp_path: Path) -> None:
    values = np.random.default_rng(5).uniform(0, 200, (64, 96)).astype(np.float32)
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 96, 64, 1, gdal.GDT_Float32)
    dataset.GetRasterBand(1).WriteArray(values)
    dataset.BuildOverviews("AVERAGE", [2])
    del dataset
    means = values.reshape(16, 4, 24, 4).mean(axis=(1, 3))
    low, high = np.percentile(means, (1, 99))
    grey = picture(preview_png(tmp_path / "a.tif", side=24))[0]
    assert np.abs(grey - np.clip((means - low) / (high - low), 0, 1) * 255).max() <= 1
