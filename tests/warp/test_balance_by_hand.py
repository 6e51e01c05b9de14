"""Gains and offsets of a mosaic's layers, and the cells that they come from, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ortho_pipeline.warp.mosaic.balance import Balance, _cell_means, _differences, _line, _solved, _windows
from ortho_pipeline.warp.mosaic.overlaps import _windows as seam_windows


def test_a_pixel_becomes_its_gain_times_it_and_the_offset():
    balance = Balance(
        np.array([[1.0, 1.0], [2.0, 0.5]]), np.array([[0.0, 0.0], [-3.0, 10.0]]), np.zeros(2), np.zeros(2), 0, 0.0
    )
    pixels = np.array([[[10.0, 20.0]], [[30.0, 40.0]]])
    np.testing.assert_array_equal(balance.apply(1, pixels), [[[17.0, 37.0]], [[25.0, 30.0]]])
    np.testing.assert_array_equal(balance.apply(0, pixels), pixels)


@pytest.mark.parametrize("count", [2, 3])
def test_layers_become_alike_with_gains_of_mean_one_and_offsets_of_mean_zero(count):
    """True gains 1, 2 (and 0.5) of orthos of one ground, with a tenth of the cells changed."""
    random, true = np.random.default_rng(0), np.array([[1.0, 0.0], [2.0, -30.0], [0.5, 25.0]])[:count]
    ends = np.array([(i, j) for i in range(count) for j in range(i + 1, count)]).repeat(200, axis=0)
    ground = random.uniform(50, 200, len(ends))
    cells = (ground[:, None] - true[ends, 1]) / true[ends, 0]
    changed = np.arange(len(ends)) % 10 == 0
    cells[changed, 1] += 80.0
    gains, offsets, good = _solved(ends, cells, count)
    np.testing.assert_array_equal(good, ~changed)
    assert gains.mean() == pytest.approx(1.0, abs=1e-9)
    np.testing.assert_allclose(gains / gains[0], true[:, 0] / true[0, 0], rtol=1e-3)
    made = gains[ends] * cells + offsets[ends]
    np.testing.assert_allclose(made[good, 0], made[good, 1], atol=0.1)
    # About the brightness of all of them: neither brighter nor darker on the whole.
    assert made[good].mean() == pytest.approx(np.median(cells), rel=0.2)


def test_layers_that_are_alike_stay_as_they_are():
    values = np.random.default_rng(1).uniform(0, 255, 100)
    gains, offsets, good = _solved(np.tile([0, 1], (100, 1)), np.column_stack([values, values]), 3)
    np.testing.assert_allclose(gains, 1.0, atol=1e-9)
    np.testing.assert_allclose(offsets, 0.0, atol=1e-6)
    assert good.all()


def test_a_line_is_that_of_most_cells():
    second = np.linspace(-1.0, 1.0, 60)
    first = 1.5 * second + 0.2
    first[::4] += 3.0
    slope, scatter = _line(first, second)
    assert slope == pytest.approx(1.5)
    assert scatter == 0.01
    # Where all is equally bright no line is known, and a slope has its limits.
    assert _line(first, np.zeros(60)) == (1.0, 1.0)
    assert _line(9.0 * second, second)[0] == 5.0
    assert _line(-second, second)[0] == 0.2


def test_the_scatter_about_a_line_is_its_standard_deviation():
    random = np.random.default_rng(2)
    second = random.normal(0, 1, 400)
    assert _line(second + random.normal(0, 0.3, 400), second)[1] == pytest.approx(0.3, rel=0.15)


def test_values_follow_from_their_weighted_differences():
    """Of three, where a loop does not close by 3: the heavy sides keep their differences."""
    pairs = np.array([[0, 1], [1, 2], [0, 2]])
    found = _differences(pairs, np.array([1.0, 2.0, 6.0]), np.array([1.0, 1.0, 1.0]), 3)
    np.testing.assert_allclose(found, np.array([0.0, 2.0, 5.0]) - 7 / 3, atol=1e-6)
    heavy = _differences(pairs, np.array([1.0, 2.0, 6.0]), np.array([1e6, 1e6, 1.0]), 3)
    np.testing.assert_allclose(np.diff(heavy), [1.0, 2.0], atol=1e-4)


def test_cells_are_means_of_sixteen_pixels_squared_that_are_all_valid():
    random = np.random.default_rng(3)
    one, other = random.uniform(1, 9, (2, 40, 50)), random.uniform(1, 9, (2, 40, 50))
    valid = np.ones((40, 50), dtype=bool)
    valid[20, 5] = False
    # 40 x 50 px have 2 x 3 whole cells. One in the first row is saturated in one band of one ortho, the next in both.
    other[1, :16, 16:32], other[:, :16, 32:48] = 255.0, 255.0
    found = _cell_means(one, other, valid)
    expected = [
        [part[:, top : top + 16, left : left + 16].mean(axis=(1, 2)) for part in (one, other)]
        for top, left in ((0, 0), (0, 16), (16, 16), (16, 32))
    ]
    expected[1] = [np.where([True, False], means, np.nan) for means in expected[1]]
    np.testing.assert_allclose(found, expected)


@pytest.mark.parametrize("box", [(10, 20, 60, 90), (0, 0, 300, 128), (5, 5, 134, 3000), (0, 0, 9000, 9000)])
def test_windows_are_spread_from_edge_to_edge(box):
    found = np.array(_windows(box))
    sides = found[:, 2:] - found[:, :2]
    across, down = box[2] - box[0], box[3] - box[1]
    np.testing.assert_array_equal(sides, np.tile([min(128, across), min(128, down)], (len(found), 1)))
    assert (*found.min(axis=0)[:2], *found.max(axis=0)[2:]) == box
    assert len(found) == min(8, math.ceil(across / 128)) * min(8, math.ceil(down / 128))
    assert len(np.unique(found, axis=0)) == len(found)


@pytest.mark.parametrize(
    ("box", "columns", "rows"),
    [((10, 20, 60, 90), 1, 1), ((0, 0, 384, 385), 1, 2), ((0, 0, 1000, 1000), 3, 3), ((0, 0, 9000, 9000), 3, 3),
     ((0, 0, 40_000, 100), 9, 1), ((0, 0, 700, 40_000), 1, 9),
     ((0, 0, 3840, 1536), 4, 2), ((0, 0, 1920, 768), 4, 2), ((0, 0, 2688, 1920), 3, 3)],
)  # fmt: skip
def test_windows_of_seams_are_nine_at_most_of_a_wide_overlap(box, columns, rows):
    found = np.array(list(seam_windows(box)))
    assert (len(np.unique(found[:, 0])), len(np.unique(found[:, 1]))) == (columns, rows)
    ends = found[:, :2] + found[:, 2:]
    assert (*found.min(axis=0)[:2], *ends.max(axis=0)) == box or columns == 1 or rows == 1
    np.testing.assert_array_equal(
        found[:, 2:], np.tile([min(384, box[2] - box[0]), min(384, box[3] - box[1])], (len(found), 1))
    )
