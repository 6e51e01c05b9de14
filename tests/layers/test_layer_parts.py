"""Parts of layers by hand: hidden pixels, weights between nodes, tiles, and rounding."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.raster.source import Grid
from ortho_pipeline.warp.quality import accuracy, angles
from ortho_pipeline.warp.quality.hiding import BEHIND, OUTSIDE, VISIBLE, WITHOUT, Hiding, Looked
from ortho_pipeline.warp.quality.visibility_kernel import CLEAR, HIDDEN, VOID

SEEN = np.array([[CLEAR, HIDDEN, VOID], [CLEAR, HIDDEN, VOID]], dtype=np.uint8)
SHOWN = np.array([[True, True, True], [False, False, False]])


def looked(seen: np.ndarray, mask: str | None = None, other: object = None) -> Looked:
    hiding = Hiding("ortho.tif", (0.0, 1.0), mask, other)
    return Looked(hiding, None, SimpleNamespace(look=lambda left, top, width, height: seen))


def test_classes_of_hidden_pixels():
    pixels, valid = np.ones((1, 2, 3)), SHOWN[None].copy()
    work = looked(SEEN, mask="mask.tif")
    classes, hidden = work.look(0, 0, pixels, valid, -1.0)
    np.testing.assert_array_equal(classes, [[VISIBLE, BEHIND, VISIBLE], [OUTSIDE, OUTSIDE, WITHOUT]])
    np.testing.assert_array_equal(hidden, [[False, True, False], [False, False, False]])
    assert (pixels == 1.0).all()
    np.testing.assert_array_equal(valid[0], SHOWN)
    assert work.hidden_share == pytest.approx(1 / 3)
    assert work.filled_share is None


def test_hidden_pixels_have_no_value_without_a_mask():
    """A pixel is shown if any of its bands is."""
    pixels, valid = np.ones((2, 2, 3)), np.stack([SHOWN & False, SHOWN])
    work = looked(SEEN)
    assert work.hidden_share == 0
    classes, hidden = work.look(0, 0, pixels, valid, -1.0)
    assert classes is None
    np.testing.assert_array_equal(pixels, np.where(hidden, -1.0, 1.0) * np.ones((2, 1, 1)))
    np.testing.assert_array_equal(valid[1], [[True, False, True], [False, False, False]])
    work.look(0, 0, pixels, valid, -1.0)
    assert work.hidden_share == pytest.approx(1 / 5)


def test_all_that_is_shown_is_hidden():
    work = looked(np.array([[HIDDEN]], dtype=np.uint8))
    work.look(0, 0, np.ones((1, 1, 1)), np.ones((1, 1, 1), dtype=bool), 0)
    assert work.hidden_share == 1.0


def test_nothing_is_hidden():
    classes, hidden = looked(SEEN & 0, mask="m").look(0, 0, np.ones((1, 2, 3)), SHOWN[None].copy(), -1.0)
    assert hidden is None
    np.testing.assert_array_equal(classes, [[VISIBLE] * 3, [OUTSIDE] * 3])


def test_hidden_pixels_are_filled_from_the_other_ortho_where_it_has_values():
    asked = []

    def read(left, top, width, height):
        asked.append((left, top, width, height))
        values = 100.0 + np.arange(2 * height * width).reshape(2, height, width)
        good = np.ones(values.shape, dtype=bool)
        good[1, -1, -1] = False
        return values, good

    work = looked(SEEN, other=SimpleNamespace(read=read))
    hidden = np.zeros((5, 6), dtype=bool)
    hidden[1, 2] = hidden[3, 4] = hidden[2, 2] = True
    pixels, valid = np.zeros((2, 5, 6)), np.zeros((2, 5, 6), dtype=bool)
    valid[:, 0, 0] = valid[:, 2, 3] = True
    work.fill(40, 70, hidden, pixels, valid)
    assert asked == [(42, 71, 3, 3)]
    expected, known = np.zeros((2, 5, 6)), np.zeros((2, 5, 6), dtype=bool)
    expected[:, 1, 2], expected[:, 2, 2], expected[0, 3, 4] = [100, 109], [103, 112], 108
    known[:, 0, 0] = known[:, 2, 3] = known[:, 1, 2] = known[:, 2, 2] = known[0, 3, 4] = True
    np.testing.assert_array_equal(pixels, expected)
    np.testing.assert_array_equal(valid, known)
    work.look(0, 0, np.ones((1, 2, 3)), SHOWN[None].copy(), -1.0)
    assert work.filled_share == 1.0
    for nothing in (None, hidden & False):
        work.fill(0, 0, nothing, pixels, valid)
    assert len(asked) == 1


# -- angles ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 16, 17, 32, 40])
def test_weights_are_those_of_linear_interpolation(count):
    weights = angles._weights(count)
    nodes = 16.0 * np.arange(-(-count // 16) + 1)
    assert weights.shape == (count, len(nodes))
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    np.testing.assert_allclose(weights @ nodes, np.arange(count))
    assert ((weights > 0).sum(axis=1) <= 2).all()


def test_classes_of_shadows():
    np.testing.assert_array_equal(angles._classes(SEEN), [[angles.LIT, angles.SHADED, angles.WITHOUT]] * 2)


@pytest.mark.parametrize(
    ("column", "row", "inside"),
    [
        (0.0, 0.0, True),
        (9.0, 7.0, True),
        (-1e-9, 3.0, False),
        (3.0, -1e-9, False),
        (9.001, 3.0, False),
        (3.0, 7.001, False),
    ],
)
def test_angles_go_up_to_the_edge_of_the_image(column, row, inside, monkeypatch):
    """The view leans by (0.3, -0.4) per metre: the ray goes up the other way, to the west and the north."""
    fields = np.zeros((1, 1, 3, 4))
    fields[0, 0, 0] = column, row, 0.3, -0.4
    monkeypatch.setattr(angles, "_between", lambda *_: fields)
    sight = SimpleNamespace(
        grid=Grid(pyproj.CRS.from_epsg(32636), 0.0, 0.0, 1.0, 1.0, 1, 1), metres=lambda *_: np.eye(2)[None]
    )
    surface = SimpleNamespace(heights=lambda places, crs: np.full(len(places), 5.0))
    zenith, azimuth = angles._angles(sight, surface, (9, 7), (0.0, 20.0), (0, 0, 1, 1), None).ravel()
    expected = np.degrees([np.arctan(0.5), np.arctan2(-0.3, 0.4) % (2 * np.pi)])
    np.testing.assert_allclose([zenith, azimuth], expected if inside else np.nan)


# -- grids of layers -------------------------------------------------------------------------------------------------


def test_the_grid_of_a_layer_holds_the_whole_ortho():
    grid = Grid(None, 5.0, 9.0, 0.5, 0.25, 17, 24)
    assert dataclasses.astuple(accuracy.layer_grid(grid, 8)) == (None, 5.0, 9.0, 4.0, 2.0, 3, 3)
    assert dataclasses.astuple(accuracy.layer_grid(grid, 1)) == dataclasses.astuple(grid)


def test_tiles_go_row_by_row_and_end_with_the_grid():
    assert list(accuracy.tiles(Grid(None, 0, 0, 1, 1, 5, 4), 4)) == [(0, 0, 4, 4), (4, 0, 1, 4)]
    assert list(accuracy.tiles(Grid(None, 0, 0, 1, 1, 3, 5), 4)) == [(0, 0, 3, 4), (0, 4, 3, 1)]


def test_bands_are_rounded_to_one_part_in_two_thousand():
    values = np.random.default_rng(1).uniform(0.01, 50, 999).astype(np.float32)
    found = accuracy._rounded(np.append(values, np.float32(np.nan)))
    assert np.isnan(found[-1])
    assert (np.abs(found[:-1] / values - 1) <= 2.0**-11).all()
    assert len(np.unique(found.view(np.uint32) & 0x1FFF)) == 1
    assert (found[:-1] > values).mean() == pytest.approx(0.5, abs=0.1)


def test_three_of_a_covariance():
    np.testing.assert_array_equal(accuracy._three(np.array([[[1.0, 2.0], [2.0, 5.0]]])), [[1.0, 5.0, 2.0]])


@pytest.mark.parametrize(("size", "some"), [((1024, 1024), False), ((1025, 3), True), ((3, 1025), True)])
def test_a_layer_with_a_side_of_more_than_1024_pixels_has_overviews(size, some):
    """They do not mix pixels: a mean of directions or correlations is none."""
    options = accuracy.overviews(Grid(None, 0, 0, 1, 1, *size))
    assert (options.get("OVERVIEWS"), options.get("OVERVIEW_RESAMPLING")) == (
        (None, "NEAREST") if some else ("NONE", None)
    )
