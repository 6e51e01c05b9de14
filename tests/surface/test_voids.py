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


@pytest.mark.parametrize("reach", [0, 1, 2, 5])
def test_windows_hold_the_nearest_height_within_the_reach(reach):
    """Each is at the distance of the nearest one from the place in the raster, and the edge goes on from there."""
    heights = np.full((4, 5), np.nan)
    heights[1, 3], heights[3, 0] = 7.0, 9.0
    for u0, v0, nu, nv in (
        (0, 0, 5, 4),
        (1, 1, 1, 1),
        (3, 3, 1, 1),
        (0, 1, 1, 1),
        (2, 3, 1, 1),
        (-2, -3, 4, 5),
        (4, 3, 3, 2),
        (-6, 1, 13, 1),
    ):
        found = nearest_heights(source(heights), heights.shape, (u0, v0, nu, nv), reach)
        assert found.shape == (nv, nu)
        for j, i in np.ndindex(nv, nu):
            row, column = np.clip(v0 + j, 0, 3), np.clip(u0 + i, 0, 4)
            away = {np.hypot(row - 1, column - 3): 7.0, np.hypot(row - 3, column): 9.0}
            beyond = np.hypot(v0 + j - row, u0 + i - column)
            known = min(away) <= reach and beyond <= reach
            assert len(away) == 1 or not known or found[j, i] == away[min(away)]
            assert np.isfinite(found[j, i]) == known


def test_no_height_is_within_the_reach():
    heights = np.full((4, 5), np.nan)
    assert np.isnan(nearest_heights(source(heights), heights.shape, (-1, -1, 7, 6), 9)).all()


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
