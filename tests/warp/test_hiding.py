"""Hidden pixels of an ortho: what is counted, emptied, classed, and filled from another ortho."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.warp.quality.hiding import BEHIND, OUTSIDE, VISIBLE, WITHOUT, Hiding, Looked, of_classes
from ortho_pipeline.warp.quality.visibility_kernel import HIDDEN, VOID

#: What terrain does at 3 x 4 pixels of a tile; where two bands have values.
SEEN = np.array([[0, HIDDEN, 0, VOID], [HIDDEN, 0, 0, VOID], [HIDDEN, 0, HIDDEN, 0]], dtype=np.uint8)
VALID = np.ones((2, 3, 4), dtype=bool)
VALID[:, 0, 0] = False
VALID[:, 1, 0] = False  # hidden, and outside of the image
VALID[0, 2, 0] = False  # one band alone
VALID[:, :2, 3] = False


class Other:
    """An ortho whose pixels are 100 times the band plus 10 times the row plus the column; the last column is empty."""

    def __init__(self) -> None:
        self.asked: list[tuple[int, ...]] = []

    def read(self, left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        self.asked.append((left, top, width, height))
        row, column = np.mgrid[top : top + height, left : left + width]
        values = np.stack([100 + 10 * row + column, 200 + 10 * row + column])
        good = np.broadcast_to(column < 22, values.shape).copy()
        good[1] &= row != 30
        return values, good


def looked(seen: np.ndarray = SEEN, mask: Any = None, other: Any = None) -> Looked:
    visibility = SimpleNamespace(look=lambda left, top, width, height: seen)
    return Looked(Hiding("ortho.tif", (0.0, 1.0), mask, other), None, visibility)  # type: ignore[arg-type]


def test_hidden_pixels_that_the_image_shows_lose_their_values() -> None:
    work, pixels, valid = looked(), np.full((2, 3, 4), 7), VALID.copy()
    classes, hidden = work.look(20, 30, pixels, valid, -1)
    assert classes is None
    expected = np.array([[0, 1, 0, 0], [0, 0, 0, 0], [1, 0, 1, 0]], dtype=bool)
    np.testing.assert_array_equal(hidden, expected)
    np.testing.assert_array_equal(pixels, np.where(expected, -1, 7)[None].repeat(2, axis=0))
    np.testing.assert_array_equal(valid, VALID & ~expected)
    # 12 pixels, of which 4 have no value in any band.
    assert work.hidden_share == pytest.approx(3 / 8)
    assert work.filled_share is None
    work.look(20, 30, pixels.copy(), np.ones((1, 3, 4), dtype=bool), -1)
    assert work.hidden_share == pytest.approx((3 + 4) / (8 + 12))


def test_with_a_mask_pixels_stay_and_each_has_a_class() -> None:
    work, pixels, valid = looked(mask=Path("mask.tif")), np.full((2, 3, 4), 7), VALID.copy()
    classes, hidden = work.look(20, 30, pixels, valid, -1)
    assert hidden is not None
    assert (pixels == 7).all()
    np.testing.assert_array_equal(valid, VALID)
    np.testing.assert_array_equal(
        classes,
        [[OUTSIDE, BEHIND, VISIBLE, WITHOUT], [OUTSIDE, VISIBLE, VISIBLE, WITHOUT], [BEHIND, VISIBLE, BEHIND, VISIBLE]],
    )
    classes, hidden = looked(np.zeros_like(SEEN), mask=Path("mask.tif")).look(20, 30, pixels, valid, -1)
    assert hidden is None
    np.testing.assert_array_equal(classes, np.where(VALID.any(axis=0), VISIBLE, OUTSIDE))


def test_where_nothing_is_hidden_nothing_changes() -> None:
    work, pixels, valid = looked(np.zeros_like(SEEN)), np.full((2, 3, 4), 7), VALID.copy()
    assert work.look(20, 30, pixels, valid, -1) == (None, None)
    np.testing.assert_array_equal(valid, VALID)
    assert work.hidden_share == 0.0
    assert looked().hidden_share == 0.0


def test_the_other_ortho_fills_what_it_shows_band_by_band() -> None:
    other = Other()
    work, pixels, valid = looked(other=other), np.full((2, 3, 4), 7), VALID.copy()
    _, hidden = work.look(20, 30, pixels, valid, -1)
    work.fill(20, 30, hidden, pixels, valid)
    assert other.asked == [(20, 30, 3, 3)], "the box of what is hidden, and no more"
    assert pixels[:, 0, 1].tolist() == [100 + 300 + 21, -1]
    assert valid[:, 0, 1].tolist() == [True, False]
    assert pixels[:, 2, 0].tolist() == [100 + 320 + 20, 200 + 320 + 20]
    assert valid[:, 2, 0].all()
    assert pixels[:, 2, 2].tolist() == [-1, -1], "the other shows nothing there either"
    assert not valid[:, 2, 2].any()
    assert (pixels[:, 1, 1:3] == 7).all()
    assert work.filled_share == pytest.approx(2 / 8)


def test_without_another_ortho_or_anything_hidden_nothing_is_read() -> None:
    other, pixels = Other(), np.full((2, 3, 4), 7)
    for work, hidden in ((looked(), SEEN == HIDDEN), (looked(other=other), None), (looked(other=other), SEEN > 99)):
        work.fill(20, 30, hidden, pixels, VALID.copy())
    assert other.asked == []
    assert (pixels == 7).all()
    assert looked(other=other).filled_share == 0.0


def test_classes_are_packed_as_runs_where_there_are_such() -> None:
    assert of_classes("GTiff") == {"COMPRESS": "PACKBITS"}
    assert of_classes("COG")["OVERVIEW_RESAMPLING"] == "NEAREST"
