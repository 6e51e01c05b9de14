"""Intensities of rasters: means of blocks by plain loops, bands that show something, and copies for display."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal
from scipy.ndimage import gaussian_filter
from scipy.stats import entropy

from ortho_pipeline.raster.intensity import Intensity, contents, enlarged
from ortho_pipeline.raster.pyramid import Pyramid, stretch
from ortho_pipeline.raster.source import RasterSource


def raster(path: Path, bands: np.ndarray, nodata: float | None = None, alpha: bool = False) -> RasterSource:
    count, height, width = bands.shape
    kind = gdal.GDT_UInt16 if bands.dtype == np.uint16 else gdal.GDT_Float32
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), width, height, count, kind, options=["ALPHA=NO"])
    # GDAL 3.13 changes no tag after pixels were written.
    if alpha:
        dataset.GetRasterBand(count).SetColorInterpretation(gdal.GCI_AlphaBand)
    if nodata is not None:
        dataset.GetRasterBand(1).SetNoDataValue(nodata)
    dataset.WriteArray(bands)
    del dataset
    return RasterSource(path)


def texture(seed: int, height: int, width: int) -> np.ndarray:
    """Return smooth noise from 100 to 1000."""
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=(height, width)))
    distance = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width))
    smooth = np.fft.irfft2(noise * np.exp(-((distance / 0.15) ** 2)), (height, width))
    return 100 + 900 * (smooth - smooth.min()) / np.ptp(smooth)


@pytest.mark.parametrize("factor", [1, 3, 8, 9])
def test_windows_are_means_of_whole_blocks_with_values(tmp_path: Path, factor: int) -> None:
    """By loops over pixels: a block that is partly outside, or has a pixel without a value, has none."""
    bands = np.random.default_rng(1).uniform(1, 100, (2, 50, 60)).astype(np.float32)
    bands[:, 20, 31] = -9.0
    view = Intensity(raster(tmp_path / "a.tif", bands, -9.0), (1, 2))
    mean = np.where(bands[0] == -9.0, np.nan, bands.mean(axis=0))
    left, top, width, height = -factor - 1, -1, 60 // factor + 4, 50 // factor + 3
    wanted = np.full((height, width), np.nan)
    for row in range(height):
        for column in range(width):
            first, above = left + column * factor, top + row * factor
            if first >= 0 and above >= 0 and first + factor <= 60 and above + factor <= 50:
                wanted[row, column] = mean[above : above + factor, first : first + factor].mean()
    found = view.read(left, top, width, height, factor)
    if factor <= 8:
        np.testing.assert_array_equal(np.isnan(found), np.isnan(wanted))
    both = np.isfinite(wanted)
    assert np.isfinite(found[both]).all()
    np.testing.assert_allclose(found[both], wanted[both], rtol=1e-5)
    assert both.sum() > 10
    assert np.isnan(view.read(61, 0, 3, 3, factor)).all()


def test_largest_integers_are_saturated(tmp_path: Path) -> None:
    assert Intensity(raster(tmp_path / "a.tif", np.ones((1, 8, 8), np.uint16))).saturated == 65535
    assert Intensity(raster(tmp_path / "b.tif", np.ones((1, 8, 8), np.float32))).saturated == np.inf


def test_bands_without_content_are_not_averaged(tmp_path: Path) -> None:
    """Of texture, one value, noise, texture again, and an alpha band with texture."""
    shown = [texture(seed, 128, 128) for seed in (1, 2, 3)]
    noise = np.random.default_rng(4).uniform(100, 1000, (128, 128))
    bands = np.stack([shown[0], np.full((128, 128), 7.0), noise, shown[1], shown[2]]).astype(np.uint16)
    view = Intensity(raster(tmp_path / "a.tif", bands, alpha=True))
    assert view.averaged == (1, 4)
    assert view.best(1) in ((1,), (4,))
    flat = np.full((6, 40, 40), 9, np.uint16)
    assert Intensity(raster(tmp_path / "b.tif", flat)).averaged == (1, 3, 4, 6), "from the whole spectrum"
    assert Intensity(raster(tmp_path / "c.tif", flat[:2], alpha=True)).averaged == (1,)


def test_the_content_of_a_band_is_its_entropy_times_its_correlation() -> None:
    """Neighbours along rows differ by -1 or 1 with the same frequency, one bit; along columns by nothing."""
    steps = np.tile([1.0, 1.0, -1.0, 1.0, -1.0, -1.0, -1.0, 1.0], 32)
    course = np.concatenate([[0.0], np.cumsum(steps)])
    band = np.tile(course, (64, 1))
    alike = 1 - 1.0 / (2 * course.var())
    low, high = np.percentile(course, (1, 99))
    assert (low, high) == (course.min(), course.max())
    found = contents(np.stack([band, 0 * band])[:, None].astype(np.float32))
    np.testing.assert_allclose(found, [alike * 1.0 / 2, 0.0], rtol=1e-4)
    empty = band.copy()
    empty[: 64 // 4] = np.nan
    assert contents(np.stack([band, empty])[:, None].astype(np.float32))[1] == 0.0, "it would cost a quarter of values"


def test_what_was_enlarged_by_two_is_recognised_along_both_axes() -> None:
    small = np.random.default_rng(2).normal(0, 1, (32, 32))

    def twice(values: np.ndarray, axis: int) -> np.ndarray:
        spectrum, size = np.fft.rfft(values, axis=axis), 2 * values.shape[axis]
        return np.fft.irfft(spectrum, size, axis=axis)

    assert enlarged(twice(twice(small, 0), 1)[None])
    for values in (small, twice(small, 0), twice(small, 1)):
        assert not enlarged(values[None])


def test_a_coarse_copy_shows_pixels_where_they_are(tmp_path: Path) -> None:
    """Bands of columns and rows: any reduction shows at its middle what is there."""
    rows, columns = np.indices((480, 640)).astype(np.float32)
    source = raster(tmp_path / "a.tif", np.stack([columns, rows]))
    for band, axis in ((1, 1), (2, 0)):
        pyramid = Pyramid(source, (band,))
        assert pyramid.coarse.shape == (30, 40)
        for factor, left, top in ((12, 0, 0), (16, 64, 32), (32, 64, 32), (64, 128, 64)):
            found = pyramid.read(left, top, 5, 4, factor)
            middle = (left if axis else top) + (np.arange(5 if axis else 4) + 0.5) * factor
            wanted = np.broadcast_to(middle if axis else middle[:, None], (4, 5))
            assert np.abs(found - wanted).max() <= (8.5 if factor < 16 else 1.0)


def test_a_raster_lower_than_a_step_has_a_coarse_copy(tmp_path: Path) -> None:
    columns = np.tile(np.arange(40, dtype=np.float32), (1, 10, 1))
    coarse = Pyramid(raster(tmp_path / "a.tif", columns)).coarse
    assert coarse.shape == (1, 2)
    assert np.abs(coarse - [[10, 30]]).max() <= 1


def test_reduced_pixels_need_a_value_in_all_bands(tmp_path: Path) -> None:
    bands = np.ones((2, 64, 64), dtype=np.float32)
    bands[0, :32, :32] = -9.0
    found = Intensity(raster(tmp_path / "a.tif", bands, -9.0), (1, 2)).read(0, 0, 4, 4, 16)
    np.testing.assert_array_equal(np.isnan(found), (np.indices((4, 4)) < 2).all(axis=0))
    assert np.nanmax(found) == 1.0


def test_the_stretch_is_from_percentile_1_to_99() -> None:
    values = np.random.default_rng(0).permutation(np.arange(1001, dtype=np.float32))
    assert stretch(np.append(values, np.nan)) == pytest.approx((10.0, 990.0))
    assert stretch(np.full(3, np.nan, np.float32)) is None
    low, high = stretch(np.full(3, 5.0, np.float32)) or (0.0, 0.0)
    assert low == 5.0 < high < 5.001


@pytest.mark.parametrize(
    ("content", "bands"),
    [
        # At least half of the content of the best, at most four, in the order of the file.
        ((4.0, 2.0, 1.99, 0.0, 3.0), (1, 2, 5)), ((5.0, 9.0, 4.6, 4.7, 4.8, 4.9), (1, 2, 5, 6)),
        ((0.0, 0.0, 0.1), (3,)), ((2.0, 2.0, 2.0, 2.0, 2.0), (1, 2, 3, 4)), ((3.0, 2.0), (1, 2)), ((0.5, 3.0), (2,)),
    ],
)  # fmt: skip
def test_bands_with_half_of_the_best_content_are_averaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: tuple[float, ...], bands: tuple[int, ...]
) -> None:
    monkeypatch.setattr("ortho_pipeline.raster.intensity.contents", lambda samples: np.array(content[: len(samples)]))
    pixels = np.ones((len(content), 70, 80), np.float32)
    assert Intensity(raster(tmp_path / "a.tif", pixels)).averaged == bands
    assert Intensity(raster(tmp_path / "a.tif", pixels)).best(1) == (int(np.argmax(content)) + 1,)


def test_content_is_that_of_differences_along_both_axes() -> None:
    """Entropy in 255 steps of the range from percentile 1 to 99, times the correlation of neighbours, by SciPy."""
    random = np.random.default_rng(8)
    bands = gaussian_filter(random.normal(size=(3, 2, 50, 40)), (0, 0, 1.5, 0.8)).astype(np.float32)
    bands[2] *= [[[3.0]], [[-40.0]]]
    bands[1, 0, :3, :7] = np.nan
    wanted = []
    for band in bands:
        low, high = np.nanquantile(band, (0.01, 0.99))
        steps = 255 * (np.clip(band, low, high) - low) / (high - low)
        bits = 0.0
        for one, next_ in ((steps[:, :-1], steps[:, 1:]), (steps[..., :-1], steps[..., 1:])):
            change = (next_ - one)[np.isfinite(next_ - one)]
            alike = 1 - np.mean(change**2) / (2 * np.nanvar(steps))
            bits += alike * entropy(np.bincount(np.rint(change).astype(int) + 255), base=2) / 2
        wanted.append(bits)
    np.testing.assert_allclose(contents(bands), wanted, rtol=1e-3)
    assert min(wanted) > 1.0


@pytest.mark.parametrize(("empty", "counts"), [(9, True), (11, False)])
def test_a_band_with_nine_tenths_of_the_values_of_the_fullest_counts(empty: int, counts: bool) -> None:
    full = np.cumsum(np.random.default_rng(3).normal(size=(1, 100, 60)), axis=1).astype(np.float32)
    less = full.copy()
    less[:, :empty] = np.nan
    found = contents(np.stack([less, full]))
    assert found[1] > 0
    assert bool(found[0] > 0) is counts


@pytest.mark.parametrize(("down", "across"), [(0.0395, 0.0395), (0.0405, 0.0395), (0.0395, 0.0405)])
def test_the_finest_detail_of_an_enlarged_raster_is_less_than_a_part_of_the_middle(down: float, across: float) -> None:
    """Waves of 3/32 and of more than 3/8 cycles per pixel: the power of the fine ones is 0.0016 of the others.

    Those of 1/32 and of 5/16 are neither.
    """

    def waves(count: int, fine: float) -> np.ndarray:
        turns = 2 * np.pi * np.arange(count) / count
        parts = ((count // 32, 9.0), (3 * count // 32, 1.0), (5 * count // 16, 10.0), (3 * count // 8 + 1, fine))
        return sum((size * np.cos(number * turns + number) for number, size in parts), start=np.zeros(count))

    windows = (waves(64, down)[:, None] + waves(96, across) + np.array([5.0, -3.0])[:, None, None]).astype(np.float32)
    assert windows.shape == (2, 64, 96)
    assert enlarged(windows) is (max(down, across) < 0.04)


def test_a_coarse_copy_is_of_overviews_where_there_are_some(tmp_path: Path) -> None:
    """These are means here; without them it has single pixels."""
    pixels = np.random.default_rng(6).uniform(1, 100, (2, 128, 192)).astype(np.float32)
    means = pixels.mean(axis=0).reshape(8, 16, 12, 16).mean(axis=(1, 3))
    source = raster(tmp_path / "a.tif", pixels)
    assert np.abs(Pyramid(source, (1, 2)).coarse - means).max() > 5
    del source
    dataset = gdal.Open(str(tmp_path / "a.tif"))
    dataset.BuildOverviews("AVERAGE", [2, 4, 8, 16])
    del dataset
    np.testing.assert_allclose(Pyramid(RasterSource(tmp_path / "a.tif"), (1, 2)).coarse, means, rtol=1e-4)


def test_a_band_without_any_value_is_not_averaged(tmp_path: Path) -> None:
    """It would leave no value in the mean."""
    bands = np.stack([texture(1, 128, 128), np.full((128, 128), -9.0), texture(2, 128, 128)]).astype(np.float32)
    view = Intensity(raster(tmp_path / "a.tif", bands, -9.0))
    assert view.averaged == (1, 3)
    assert np.isfinite(view.read(0, 0, 128, 128)).all()


@pytest.mark.parametrize(
    ("rows", "columns", "told"), [((100, 110, 1), (20, 30, 1), True), ((0, 192, 1), (0, 192, 25), False)]
)
def test_windows_with_gaps_do_not_tell_whether_a_raster_was_enlarged(tmp_path: Path, rows, columns, told) -> None:
    """Enlarged by two in the spectrum. Gaps at one place leave whole windows; gaps in every 25th column leave none."""
    pixels = np.random.default_rng(3).normal(size=(96, 96))
    for axis in (0, 1):
        pixels = np.fft.irfft(np.fft.rfft(pixels, axis=axis), 192, axis=axis)
    assert Intensity(raster(tmp_path / "a.tif", pixels[None].astype(np.float32), -9.0)).enlarged
    pixels[slice(*rows), slice(*columns)] = -9.0
    assert Intensity(raster(tmp_path / "b.tif", pixels[None].astype(np.float32), -9.0)).enlarged is told
