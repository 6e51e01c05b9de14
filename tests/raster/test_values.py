"""Values of output pixels, one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ortho_pipeline.raster.ortho import Profile, as_written, keep_off_nodata, value_range


def profile(dtype: str, nodata: float | None = None) -> Profile:
    return Profile(1, np.dtype(dtype), "nodata" if nodata is not None else "mask", nodata)


@pytest.mark.parametrize(
    ("dtype", "nodata", "expected"),
    [
        ("u1", None, (0.0, 255.0, True, 0)),
        ("i2", -9999, (-32768.0, 32767.0, True, -9999)),
        ("f4", -1.5, (-math.inf, math.inf, False, -1.5)),
        ("f8", None, (-math.inf, math.inf, False, math.nan)),
    ],
)
def test_ranges_of_types(dtype, nodata, expected):
    found = value_range(np.dtype(dtype), profile(dtype, nodata))
    np.testing.assert_equal(found, expected)
    assert found[3].dtype == dtype


def test_values_are_rounded_half_up_and_kept_in_the_range_of_their_type():
    pixels = np.array([[-0.6, -0.5, 0.49, 0.5, 254.5, 255.4, 300.0, np.nan]])
    valid = np.array([[True] * 7 + [False]])
    np.testing.assert_array_equal(as_written(pixels, valid, np.dtype("u1"), 7), [[0, 0, 0, 1, 255, 255, 255, 7]])
    np.testing.assert_array_equal(as_written(pixels, valid, np.dtype("i2"), -9), [[-1, 0, 0, 1, 255, 255, 300, -9]])
    found = as_written(pixels, valid, np.dtype("f4"), -9.0)
    assert found.dtype == np.float32
    np.testing.assert_array_equal(found, np.where(valid, pixels, -9.0).astype("f4"))


def test_values_of_the_type_are_written_as_they_are():
    pixels = np.array([[1.5, np.nan]])
    assert as_written(pixels, np.array([[True, False]]), np.dtype("f8"), -9.0) is pixels


@pytest.mark.parametrize(
    ("dtype", "fill", "kept"),
    [
        ("u1", 0, 1),
        ("u1", 255, 254),
        ("u1", 7, 6),
        ("i2", -32768, -32767),
        ("i2", -32767, -32768),
        ("f4", -9999.0, np.nextafter(np.float32(-9999), np.float32(0))),
        ("f4", np.finfo("f4").max, np.nextafter(np.finfo("f4").max, np.float32(0))),
        ("f8", 0.0, 5e-324),
    ],
)
def test_valid_pixels_keep_off_nodata(dtype, fill, kept):
    fill = np.dtype(dtype).type(fill)
    out = np.array([[[fill, fill, 100]], [[3, fill, 5]]], dtype=dtype)
    valid = np.array([[[True, False, True]], [[True, True, False]]])
    low = value_range(np.dtype(dtype), profile(dtype, float(fill)))[0]
    keep_off_nodata(out, valid, fill, low)
    np.testing.assert_array_equal(out, np.array([[[kept, fill, 100]], [[3, kept, 5]]], dtype=dtype))


def test_nothing_is_nan_but_nodata():
    out = np.array([[[1.0, np.nan]]])
    keep_off_nodata(out, np.array([[[True, True]]]), np.nan, -math.inf)
    np.testing.assert_array_equal(out, [[[1.0, np.nan]]])
