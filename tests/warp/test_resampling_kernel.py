"""The resampling kernels, run as plain Python on small images, against the definitions of the kernels."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.ndimage import minimum_filter

from ortho_pipeline.warp import resampling_kernel, tile_kernel
from ortho_pipeline.warp.resampling_kernel import AVERAGE, BILINEAR, CUBIC, LANCZOS, NEAREST, Resampling, SourceWindow

#: Kernels and how many pixels around a point they read.
KERNELS = {"bilinear": (BILINEAR, 1), "nearest": (NEAREST, 0), "cubic": (CUBIC, 2), "lanczos": (LANCZOS, 3)}
KERNELS["average"] = (AVERAGE, 3)
BOX = 2.5, 3.25
WIDTH, HEIGHT = 11, 10
IMAGE = np.random.default_rng(4).uniform(0, 255, (HEIGHT, WIDTH))


@pytest.fixture(autouse=True)
def plain(interpreted):
    interpreted(resampling_kernel)
    with np.errstate(over="ignore"):  # unsigned places go round below zero
        yield


def weights_of(name: str, place: float, count: int) -> np.ndarray:
    """Weights of all samples of a line for a place on it, by the definition of the kernel."""
    centres = np.arange(count) + 0.5
    if name == "nearest":
        return (np.floor(np.minimum(place, count - 0.5)) == np.arange(count)).astype(float)
    if name == "average":
        half = BOX[count == HEIGHT] / 2
        low, high = np.maximum(place - half, centres - 0.5), np.minimum(place + half, centres + 0.5)
        return np.maximum(high - low, 0.0)
    s = np.abs(place - centres)
    if name == "bilinear":
        return np.maximum(1 - s, 0.0)
    if name == "lanczos":
        return np.where(s < 3, np.sinc(s) * np.sinc(s / 3), 0.0)
    near, far = 1.5 * s**3 - 2.5 * s**2 + 1, -0.5 * s**3 + 2.5 * s**2 - 4 * s + 2
    return np.where(s <= 1, near, np.where(s < 2, far, 0.0))


def value(name, image, valid, column, row):
    """Value at a point of an image: of the valid pixels, with weights that sum to one; cubic needs all of its own."""
    by_column, by_row = weights_of(name, column, WIDTH), weights_of(name, row, HEIGHT)
    if name == "cubic":
        i, j = int(np.floor(column - 0.5)), int(np.floor(row - 0.5))
        inside = i >= 1 and j >= 1 and i + 2 < WIDTH and j + 2 < HEIGHT
        if not inside or not valid[j - 1 : j + 3, i - 1 : i + 3].all():
            return value("bilinear", image, valid, column, row)
    weights = np.outer(by_row, by_column) * valid
    return (weights * image).sum() / weights.sum()


def resampling(name, integer=False, high=np.inf, fill=-9.0, real=np.float64):
    kernel, reach = KERNELS[name]
    return Resampling(kernel, reach, BOX, 0.0 if integer else -np.inf, high, integer, fill, np.empty(0, dtype=real))


def row(name, image, valid, columns, rows, window=(0, 0, WIDTH, HEIGHT), **options):
    """Values, which are valid, and how many lack neighbours, of a row with edges in a window."""
    left, top, right, bottom = window
    part = (slice(None), slice(top, bottom), slice(left, right))
    masked = valid is not None
    here = valid[part] if masked else np.ones((1, 1, 1), dtype=bool)
    source = SourceWindow(image[part], here, None, masked, left, top, WIDTH, HEIGHT)
    out, good = np.full((len(image), len(columns)), 77.0), np.full((len(image), len(columns)), 7, dtype=np.uint8)
    how = resampling(name, **options)
    short = resampling_kernel.row_with_edges(how.kernel, how, source, np.array(columns), np.array(rows), out, good)
    return out, good, short


# -- weights ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("f", [0.0, 0.2, 0.5, 0.93])
def test_weights_are_those_of_the_definitions(f):
    np.testing.assert_allclose(resampling_kernel.cubic_weights(f, float), weights_of("cubic", 1.5 + f, 4), atol=1e-14)
    lanczos = weights_of("lanczos", 2.5 + f, 6)
    np.testing.assert_allclose(resampling_kernel._lanczos_weights(f), lanczos / lanczos.sum(), atol=1e-12)


def test_lanczos_at_a_sample_is_that_sample():
    assert np.argmax(resampling_kernel._lanczos_weights(1e-10)) == 2
    assert np.argmax(resampling_kernel._lanczos_weights(1 - 1e-10)) == 3


@pytest.mark.parametrize(
    ("dtype", "mixed"), [("u1", "f4"), ("i2", "f4"), ("u2", "f4"), ("i4", "f8"), ("f4", "f8"), ("f2", "f8")]
)
def test_only_integers_of_up_to_16_bits_are_mixed_in_single_precision(dtype, mixed):
    assert resampling_kernel.mixing(np.dtype(dtype)).dtype == mixed


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_whole_pixels_have_no_invalid_one_within_the_reach_in_any_band(reach):
    valid = np.random.default_rng(3).random((3, 12, 17)) > 0.02
    valid[1, 0, 0] = valid[2, 11, 16] = valid[0, 5, 7] = valid[0, 5, 8] = valid[0, 5, 12] = False
    found = np.full((12, 17), 7)
    resampling_kernel.find_whole(valid, reach, found)
    expected = minimum_filter(valid.all(axis=0), 2 * reach + 1, mode="constant", cval=1)
    np.testing.assert_array_equal(found, expected)
    assert 0 < expected.sum() < expected.size


# -- inside ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KERNELS)
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_rows_with_all_neighbours(name, real):
    left, top = 2, 1
    part = IMAGE[top:, left:]
    columns = np.array([5.5, 5.500001, 6.2, 6.499, 7.5, 7.9, 8.0])
    rows = np.array([4.5, 5.499, 4.501, 5.5, 5.2, 6.49, 4.9])
    everywhere = np.ones(IMAGE.shape, dtype=bool)
    expected = [value(name, IMAGE, everywhere, *place) for place in zip(columns, rows, strict=True)]
    how = resampling(name, real=real)
    scratch = tile_kernel._scratch(7, part, how.real)
    out = np.empty(7)
    resampling_kernel.row_inside(how.kernel, how, part, columns, rows, left, top, scratch, out)
    np.testing.assert_allclose(out, expected, rtol=0, atol=1e-9 if real is np.float64 else 1e-3)
    how = resampling(name, integer=True, high=100.0, real=real)
    resampling_kernel.row_inside(how.kernel, how, part, columns, rows, left, top, scratch, out)
    if name in ("cubic", "lanczos"):
        np.testing.assert_array_equal(out, np.clip(np.floor(np.array(expected) + 0.5), 0, 100))
    elif name != "nearest":
        np.testing.assert_array_equal(out, np.floor(np.array(expected) + 0.5))


# -- edges -----------------------------------------------------------------------------------------------------------

COLUMNS, ROWS = (
    place.ravel()
    for place in np.meshgrid(
        [0.0, 0.2, 0.5, 1.3, 1.5, 2.2, 3.7, 6.1, 7.9, 8.4, 8.6, 9.4, 9.6, 10.5, 10.9, 11.0],
        [0.0, 0.3, 0.5, 1.45, 1.6, 2.7, 5.3, 7.4, 7.6, 8.4, 8.6, 9.5, 9.9, 10.0],
    )
)


@pytest.mark.parametrize("name", KERNELS)
def test_rows_at_the_edge_of_the_image(name):
    """Bilinear goes on with the edge; so the sum of its weights is one, as if the outside were left out."""
    everywhere = np.ones(IMAGE.shape, dtype=bool)
    out, good, short = row(name, IMAGE[None], None, COLUMNS, ROWS)
    if name in ("bilinear", "cubic"):
        inner = np.clip(COLUMNS, 0.5, WIDTH - 0.5), np.clip(ROWS, 0.5, HEIGHT - 0.5)
    else:
        inner = COLUMNS, ROWS
    expected = [value(name, IMAGE, everywhere, *place) for place in zip(*inner, strict=True)]
    assert short == 0
    assert (good == 1).all()
    np.testing.assert_allclose(out[0], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", KERNELS)
def test_rows_with_invalid_neighbours(name):
    """A point has a value where its own pixel is valid; an average where any of its area is."""
    valid = np.random.default_rng(6).random((2, HEIGHT, WIDTH)) > 0.2
    valid[1, :5, :4] = False
    valid[0, :, 5:] = True  # room for the largest kernel
    images = np.stack([IMAGE, IMAGE[::-1] + 3])
    out, good, short = row(name, images, valid, COLUMNS, ROWS)
    assert short == 0
    own_column, own_row = np.minimum(COLUMNS.astype(int), WIDTH - 1), np.minimum(ROWS.astype(int), HEIGHT - 1)
    for band in range(2):
        own = valid[band, own_row, own_column]
        if name == "average":
            weights = [
                np.outer(weights_of(name, y, HEIGHT), weights_of(name, x, WIDTH))
                for x, y in zip(COLUMNS, ROWS, strict=True)
            ]
            own = np.array([(weight * valid[band]).sum() > 0 for weight in weights])
        np.testing.assert_array_equal(good[band], own)
        assert (out[band][~own] == -9.0).all()
        places = zip(COLUMNS[own], ROWS[own], strict=True)
        expected = [value(name, images[band], valid[band], *place) for place in places]
        np.testing.assert_allclose(out[band][own], expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", KERNELS)
def test_points_outside_of_the_image_have_no_value(name, masked):
    columns, rows = [-1e-9, 11 + 1e-9, 5.0, 5.0, np.nan, 5.0], [5.0, 5.0, -1e-9, 10 + 1e-9, 5.0, np.nan]
    valid = np.ones((1, HEIGHT, WIDTH), dtype=bool) if masked else None
    out, good, short = row(name, IMAGE[None], valid, columns, rows)
    assert short == 0
    assert (out == -9.0).all()
    assert not good.any()


@pytest.mark.parametrize("name", KERNELS)
def test_what_lies_beyond_the_window_is_counted(name):
    reach = KERNELS[name][1]
    whole, _, _ = row(name, IMAGE[None], None, COLUMNS, ROWS)
    for window in ((1, 0, 11, 10), (0, 1, 11, 10), (0, 0, 10, 10), (0, 0, 11, 9), (2, 1, 9, 9)):
        left, top, right, bottom = window
        i, j = np.minimum(COLUMNS.astype(int), WIDTH - 1), np.minimum(ROWS.astype(int), HEIGHT - 1)
        lacks = (np.maximum(i - reach, 0) < left) | (np.minimum(i + reach, WIDTH - 1) > right - 1)
        lacks |= (np.maximum(j - reach, 0) < top) | (np.minimum(j + reach, HEIGHT - 1) > bottom - 1)
        for valid in (None, np.ones((1, HEIGHT, WIDTH), dtype=bool)):
            out, good, short = row(name, IMAGE[None], valid, COLUMNS, ROWS, window=window)
            assert short == lacks.sum()
            np.testing.assert_array_equal(good[0] == 1, ~lacks)
            np.testing.assert_allclose(out[:, ~lacks], whole[:, ~lacks], rtol=0, atol=1e-9)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", ["bilinear", "cubic", "lanczos", "average"])
def test_integers_are_rounded_once_and_stay_in_their_range(name, masked):
    valid = np.ones((1, HEIGHT, WIDTH), dtype=bool) if masked else None
    step = np.where(np.arange(WIDTH) < 5, 0.0, 200.0) * np.ones((HEIGHT, 1))
    expected = row(name, step[None], valid, COLUMNS, ROWS)[0]
    found = row(name, step[None], valid, COLUMNS, ROWS, integer=True, high=200.0)[0]
    assert name not in ("cubic", "lanczos") or (expected.min() < -1 and expected.max() > 201)
    np.testing.assert_array_equal(found, np.clip(np.floor(expected + 0.5), 0, 200))


def test_a_point_whose_valid_neighbours_have_hardly_any_weight_takes_none():
    valid = np.zeros(IMAGE.shape, dtype=bool)
    valid[4, 4] = True
    for apart, known in ((1e-6, False), (1e-4, True)):
        found = resampling_kernel._bilinear_valid(
            IMAGE, valid, 5.0 - apart, 4.0, 0, 0, WIDTH, HEIGHT, np.float64, False
        )
        np.testing.assert_allclose(found, IMAGE[4, 4] if known else np.nan)


def test_lanczos_without_valid_neighbours_has_no_value():
    valid = np.zeros(IMAGE.shape, dtype=bool)
    assert np.isnan(resampling_kernel._lanczos_valid(IMAGE, valid, True, 4.2, 4.3, 0, 0, WIDTH, HEIGHT))


def test_no_area_of_a_box_is_valid():
    nothing = np.zeros(IMAGE.shape, dtype=bool)
    assert np.isnan(resampling_kernel._average_valid(IMAGE, nothing, True, 4.2, 4.3, BOX))
    nothing[:, 6] = True
    for apart, known in ((1e-9, False), (1e-4, True)):
        found = resampling_kernel._average_valid(IMAGE, nothing, True, 5.0 + apart, 4.5, (2.0, 1.0))
        np.testing.assert_allclose(found, IMAGE[4, 6] if known else np.nan)


def test_all_valid_looks_at_its_square_alone():
    for j, i in itertools.product(range(6), repeat=2):
        valid = np.ones((6, 6), dtype=bool)
        valid[j, i] = False
        assert resampling_kernel._all_valid(valid, 2, 1, 3) != (1 <= j < 4 and 2 <= i < 5)
