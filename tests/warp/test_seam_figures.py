"""What is measured along a seam, by its definition at each place, and which matches count."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from layers_in_memory import Pixels, layer

from ortho_pipeline.warp.mosaic import seams
from ortho_pipeline.warp.mosaic.balance import Balance
from ortho_pipeline.warp.mosaic.reading import Opened
from ortho_pipeline.warp.mosaic.seams import _best_part, _measured, _shifts


def scenes() -> list[Opened]:
    """Return three layers of two bands; the second and the third overlap in columns 60 to 180 and rows 30 to 200."""
    random, made = np.random.default_rng(8), []
    for left, top, width, height in ((0, 0, 10, 10), (20, 10, 160, 190), (60, 30, 170, 210)):
        pixels = Pixels(random.gamma(2.0, 50.0, (2, height, width)), random.random((2, height, width)) > 0.02)
        made.append(layer(left, top, pixels))
    return made


def around(opened: Opened, column: int, row: int, reach: int) -> tuple[np.ndarray, np.ndarray]:
    """Return values and validity of a layer within so many pixels of a corner of pixels."""
    placed, pixels = opened.layer, opened.source
    rows = np.arange(row - reach, row + reach) - placed.top
    columns = np.arange(column - reach, column + reach) - placed.left
    assert rows[0] >= 0
    assert columns[0] >= 0
    part = (slice(None), *np.ix_(rows, columns))
    return pixels.values[part], pixels.valid[part].all(axis=0)  # type: ignore[attr-defined]


@pytest.mark.parametrize("cell", [1, 3])
def test_figures_are_of_four_by_four_pixels_about_each_place(monkeypatch: pytest.MonkeyPatch, cell: int) -> None:
    """A slanted seam of 70 edges, of which 48 are looked at; brightness is compared as it is in the mosaic."""
    given: list[Any] = []

    def none(chips: np.ndarray) -> np.ndarray:
        given.append(chips)
        return np.zeros((0, 2))

    monkeypatch.setattr(seams, "_shifts", none)
    opened = scenes()
    edges = np.column_stack([110 + 0.25 * np.arange(70), 85 + 0.5 * np.arange(70)]) / cell
    balance = Balance(
        np.array([[9.0, 9.0], [1.2, 0.7], [0.8, 1.1]]), np.array([[9.0, 9.0], [3.0, -8.0], [5.0, 2.0]]),
        np.zeros(2), np.zeros(2), 0, 0.0,
    )  # fmt: skip
    found = _measured(opened, (1, 2), edges, cell, balance)
    chosen = np.rint(edges[np.linspace(0, 69, 48).astype(int)] * cell).astype(int)
    differences, worst = [], np.zeros(2)
    for place, (column, row) in enumerate(chosen.tolist()):
        (one, valid), (other, also) = (around(opened[k], column, row, 2) for k in (1, 2))
        one, other = (
            part * balance.gains[k][:, None, None] + balance.offsets[k][:, None, None]
            for k, part in ((1, one), (2, other))
        )
        some = (one - other)[:, valid & also]
        differences.append(some)
        worst = np.maximum(worst, np.sqrt((some**2).mean(axis=1)))
        (one, valid), (other, also) = (around(opened[k], column, row, 48) for k in (1, 2))
        means = [
            (part * balance.gains[k][:, None, None] + balance.offsets[k][:, None, None]).mean(axis=0)
            for k, part in ((1, one), (2, other))
        ]
        chips = np.where(valid & also, means, np.nan)[(slice(None), *_best_part(valid & also))]
        np.testing.assert_allclose(given[0][place], chips, rtol=1e-6)
    everything = np.concatenate(differences, axis=1)
    assert (found["length_px"], found["places"]) == (70 * cell, 48)
    np.testing.assert_allclose(found["difference"], everything.mean(axis=1))
    np.testing.assert_allclose(found["rms"], np.sqrt((everything**2).mean(axis=1)))
    np.testing.assert_allclose(found["largest_rms"], worst)
    assert (found["matched"], found["median_px"], found["rmse_px"], found["largest_px"]) == (0, None, None, None)


def test_a_seam_without_a_common_pixel_has_no_figures() -> None:
    opened = scenes()
    opened[2].source.valid[:] = False  # type: ignore[attr-defined]
    found = _measured(opened, (1, 2), np.array([[110.0, 90.0], [110.0, 91.0]]), 1, None)
    assert (found["difference"], found["rms"], found["largest_rms"]) == (None, None, None)
    assert (found["length_px"], found["places"], found["matched"]) == (2, 2, 0)


def test_matches_count_from_the_limits_of_likeness_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Likeness of 0.25 in the search, 0.4 after it of either sign, a second place of at most 0.8 of the first."""
    cases = [
        # inside, score, ratio, correlation, column of the shift, counts
        (True, 0.25, 0.8, 0.4, 1.0, True), (True, 0.9, 0.1, -0.4, 2.0, True), (False, 0.9, 0.1, 0.9, 3.0, False),
        (True, 0.2499, 0.1, 0.9, 4.0, False), (True, 0.9, 0.8001, 0.9, 5.0, False),
        (True, 0.9, 0.1, 0.3999, 6.0, False), (True, 0.9, 0.1, -0.3999, 7.0, False),
        (True, 0.9, 0.1, np.nan, 8.0, False), (True, 0.9, 0.1, 0.9, np.nan, False),
    ]  # fmt: skip
    inside, score, ratio, correlation, shift, counts = (np.array(part) for part in zip(*cases, strict=True))
    moved = np.column_stack([shift, 10 * np.arange(len(cases))])
    asked: list[Any] = []
    monkeypatch.setattr(
        seams, "peaks", lambda _: SimpleNamespace(inside=inside, score=score, ratio=ratio, shift=moved + 100)
    )

    def measure(*given: np.ndarray) -> SimpleNamespace:
        asked.append(given)
        return SimpleNamespace(correlation=correlation, shift=moved)

    monkeypatch.setattr(seams.least_squares, "measure", measure)
    chips = np.random.default_rng(1).normal(size=(len(cases), 2, 48, 48)).astype(np.float32)
    np.testing.assert_array_equal(_shifts(chips), moved[counts])
    ((scene, target, begin),) = asked
    np.testing.assert_array_equal(scene, chips[:, 0, 8:40, 8:40])
    np.testing.assert_array_equal(target, chips[:, 1])
    np.testing.assert_array_equal(begin, moved + 100)
