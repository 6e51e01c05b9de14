"""Voids are filled as one distance transform over everything would, in bounded memory."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from ortho_pipeline.surface.voids import nearest_heights


def source(heights):
    return lambda left, top, width, height: heights[top : top + height, left : left + width]


@pytest.mark.parametrize("reach", [3, 40])
def test_pieces_are_those_of_one_distance_transform(monkeypatch, reach):
    random = np.random.default_rng(5)
    heights = random.normal(size=(150, 170))
    heights[40:95, 30:120] = np.nan
    heights[random.random(heights.shape) < 0.3] = np.nan
    distance = distance_transform_edt(np.isnan(heights))
    monkeypatch.setattr("ortho_pipeline.surface.voids._PIECE", 32)
    filled = nearest_heights(source(heights), heights.shape, (0, 0, 170, 150), reach)
    assert np.array_equal(np.isnan(filled), distance > reach)
    valid = np.argwhere(~np.isnan(heights))
    for row, column in np.argwhere(~np.isnan(filled))[::97]:
        away = np.hypot(*(valid - (row, column)).T)
        nearest = valid[np.isclose(away, away.min())]
        assert filled[row, column] in heights[tuple(nearest.T)]


def test_the_edge_goes_on_as_far_as_the_reach():
    heights = np.arange(30.0).reshape(5, 6)
    filled = nearest_heights(source(heights), heights.shape, (-3, -3, 12, 11), 2)
    assert filled[3, 1] == heights[0, 0]
    assert np.isnan(filled[3, 0])
    assert np.isnan(filled[0, 0])
    assert np.array_equal(filled[3:8, 3:9], heights)


def test_memory_stays_bounded_in_a_large_window():
    # A window of half a budget: the surroundings of all of it at once took six times as much again.
    side = 2560
    heights = np.full((side, side), 7.0)
    heights[:, ::64] = np.nan
    out = side * side * 8
    tracemalloc.start()
    try:
        filled = nearest_heights(source(heights), heights.shape, (0, 0, side, side), 512)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert (filled == 7.0).all()
    assert peak < out + 150e6
