"""The coarse copy of a raster for display: its step, its samples, and windows of it, by slices."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.raster import pyramid
from ortho_pipeline.raster.pyramid import Pyramid, stretch
from ortho_pipeline.raster.source import RasterSource

PIXELS = np.random.default_rng(4).uniform(10.0, 90.0, (130, 210)).astype(np.float32)
PIXELS[40:60, 100:140] = -9.0


def of(path: Path, pixels: np.ndarray = PIXELS) -> RasterSource:
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *pixels.shape[::-1], 1, gdal.GDT_Float32)
    dataset.GetRasterBand(1).SetNoDataValue(-9.0)
    dataset.WriteArray(pixels)
    del dataset
    return RasterSource(path)


@pytest.mark.parametrize(("most", "step"), [(107, 16), (106, 32), (27, 32), (26, 64), (7, 64), (6, 128)])
def test_the_step_doubles_until_the_copy_has_few_enough_pixels(
    tmp_path: Path, monkeypatch, most: int, step: int
) -> None:
    """130 x 210 pixels are 106.6 with a step of 16, 26.7 with 32, 6.7 with 64."""
    monkeypatch.setattr(pyramid, "_MOST_PIXELS", most)
    assert Pyramid(of(tmp_path / "a.tif"), (1,))._step == step


def nearest(step: int) -> np.ndarray:
    """Return the single pixels that GDAL takes: those in the middle of the steps."""
    rows, columns = 130 // step, 210 // step
    middle = [np.floor((np.arange(count) + 0.5) * step).astype(int) for count in (rows, columns)]
    copy = PIXELS[np.ix_(*middle)].astype(float)
    copy[copy == -9.0] = np.nan
    return copy


def test_the_copy_has_single_pixels_of_whole_steps(tmp_path: Path) -> None:
    made = Pyramid(of(tmp_path / "a.tif"), (1,))
    assert made.coarse.shape == (130 // 16, 210 // 16)
    np.testing.assert_allclose(made.coarse, nearest(16))
    assert made.coarse is made.coarse
    small = Pyramid(of(tmp_path / "b.tif", PIXELS[:10, :12]), (1,))
    assert small.coarse.shape == (1, 1)


@pytest.mark.parametrize("factor", [9, 12, 16])
def test_up_to_the_step_a_pixel_is_that_of_the_copy_under_its_middle(tmp_path: Path, factor: int) -> None:
    made, copy = Pyramid(of(tmp_path / "a.tif"), (1,)), nearest(16)
    found = made.read(20, 10, 8, 5, factor)
    for row in range(5):
        for column in range(8):
            y, x = 10 + (row + 0.5) * factor, 20 + (column + 0.5) * factor
            expected = copy[min(int(y / 16), 7), min(int(x / 16), 12)]
            np.testing.assert_equal(found[row, column], np.float32(expected))


@pytest.mark.parametrize("factor", [32, 48, 64])
def test_beyond_the_step_a_pixel_is_the_mean_of_what_is_valid_under_it(tmp_path: Path, factor: int) -> None:
    made, copy, many = Pyramid(of(tmp_path / "a.tif"), (1,)), nearest(16), factor // 16
    found = made.read(0, 0, 210 // factor, 130 // factor, factor)
    for row in range(130 // factor):
        for column in range(210 // factor):
            part = copy[row * many : (row + 1) * many, column * many : (column + 1) * many]
            mean = part[np.isfinite(part)].mean() if np.isfinite(part).any() else np.nan
            np.testing.assert_allclose(found[row, column], mean, rtol=1e-6)
    moved = made.read(32, 16, 2, 1, factor)
    np.testing.assert_allclose(moved[0, 0], np.nanmean(copy[1 : 1 + many, 2 : 2 + many]), rtol=1e-6)


def test_where_nothing_is_valid_there_is_no_mean(tmp_path: Path) -> None:
    pixels = PIXELS.copy()
    pixels[:64, :64] = -9.0
    found = Pyramid(of(tmp_path / "a.tif", pixels), (1,)).read(0, 0, 3, 2, 64)
    assert np.isnan(found[0, 0])
    assert np.isfinite(found[1, :2]).all()


def test_black_and_white_are_the_percentiles_one_and_ninety_nine(tmp_path: Path) -> None:
    values = np.append(np.arange(101.0), np.nan).astype(np.float32)
    assert stretch(values) == pytest.approx((1.0, 99.0))
    assert stretch(np.full(4, np.nan, dtype=np.float32)) is None
    low, high = stretch(np.full(4, 500.0, dtype=np.float32)) or (0.0, 0.0)
    assert (low, high) == (500.0, pytest.approx(500.0 + 5e-4))
    low, high = stretch(np.full(4, 0.1, dtype=np.float32)) or (0.0, 0.0)
    assert high - low == pytest.approx(1e-6, rel=1e-3)
    made = Pyramid(of(tmp_path / "a.tif"), (1,))
    copy = nearest(16)
    np.testing.assert_allclose(made.stretch(), np.percentile(copy[np.isfinite(copy)], (1, 99)), rtol=1e-6)
    assert Pyramid(of(tmp_path / "b.tif", np.full((40, 40), -9.0)), (1,)).stretch() == (0.0, 1.0)


def test_a_window_beside_the_origin_ends_with_the_last_column_and_row_of_the_copy(tmp_path: Path) -> None:
    """From column and row 16 on, 6 x 3 pixels of 32: the last are the means of columns 11 and 12, rows 5 and 6."""
    made, copy = Pyramid(of(tmp_path / "a.tif"), (1,)), nearest(16)
    found = made.read(16, 16, 6, 3, 32)
    np.testing.assert_allclose(found[-1, -1], copy[5:7, 11:13].mean(), rtol=1e-6)
    rows = made.read(0, 0, 6, 4, 32)
    np.testing.assert_allclose(rows[-1, -1], copy[6:8, 10:12].mean(), rtol=1e-6)
