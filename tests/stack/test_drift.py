"""Ground that moves too little to be found: what it does to the corrections, and that their sigmas contain it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from networks import Made, Truth

from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.common_changes import CommonChanges, Drift
from ortho_pipeline.block.stack.edges import Cells
from ortho_pipeline.block.stack.moving import Motion
from ortho_pipeline.block.stack.network import Network

CELLS = Cells.over(np.zeros(2), np.full(2, 1000.0))


def with_rim(seed: int, share: float) -> Made:
    """Return edges of two and a half years in which the neighbours of moving ground have a share of its motion."""
    made = Truth(seed=seed, dates=24, interval=36.0, moving=0.2, noise=0.06, of_date=0.02, of_edge=0.02).made()
    rim = Motion(made.moving, *[np.zeros(144)] * 5).beside(CELLS)
    years = made.years[made.edges.first] - made.years[made.edges.second]
    motion = share * made.rate[made.moving].mean(axis=0) * rim[:, None]
    value = made.edges.value + years[:, None, None] * motion
    return dataclasses.replace(made, edges=dataclasses.replace(made.edges, value=value))


def solved(made: Made) -> tuple[AdjustedStack, np.ndarray]:
    """Return the adjustment and its errors ``(T, 2)``."""
    found = adjust(CELLS, made.edges, made.years.tolist())
    return found, found.network.value[:, 0] - (made.shift - made.shift.mean(axis=0))


def drift_of(made: Made, errors: np.ndarray) -> float:
    """Return the length of the rate of the errors, px a year."""
    return float(np.hypot(*np.polyfit(made.years, errors, 1)[0]))


NONE = Drift(np.zeros(2), np.zeros(2), np.zeros(1))


def test_the_rim_of_moving_ground_does_not_drag_the_dates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rim has 6 % of the motion, 0.06 px a year: its cells are not found, and drag all dates."""
    stacks = [with_rim(seed, 0.06) for seed in range(1, 4)]
    found = [solved(made) for made in stacks]
    drifts = [drift_of(made, errors) for made, (_, errors) in zip(stacks, found, strict=True)]
    assert all(one.motion.moving[made.moving].all() for made, (one, _) in zip(stacks, found, strict=True))
    monkeypatch.setattr(CommonChanges, "drift", lambda self, beside: NONE)
    dragged = [drift_of(made, solved(made)[1]) for made in stacks]
    assert np.mean(drifts) < 0.6 * np.mean(dragged)


def test_sigmas_contain_motion_that_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two fifths of the ground move for half a year, too little to be found, and drag all dates.

    Four stacks have 8 drifts, so a spread of 1 is seen within 0.35 of it (one sigma is 0.25).
    """
    stacks = [Truth(seed=seed, dates=14, moving=0.4, wrong=0.05, hidden=0.3).made() for seed in range(4)]
    found = [solved(made) for made in stacks]
    assert sum(int(one.motion.moving.sum()) for one, _ in found) < 20
    assert 0.65 < _spread(found) < 1.35
    monkeypatch.setattr(CommonChanges, "drift", lambda self, beside: NONE)
    assert _spread([solved(made) for made in stacks]) > 1.5


def _spread(found: list[tuple[AdjustedStack, np.ndarray]]) -> float:
    return float(np.sqrt(np.mean([((errors / one.sigma) ** 2).mean() for one, errors in found])))


@pytest.mark.parametrize(("cells", "rim"), [(4, 14), (3, 0)])
def test_only_areas_of_four_cells_have_a_rim(cells: int, rim: int) -> None:
    moving = np.zeros((12, 12), dtype=bool)
    moving[5, 3 : 3 + cells] = True
    found = Motion(moving.ravel(), *[np.zeros(144)] * 5).beside(CELLS).reshape(12, 12)
    assert found.sum() == found[4:7, 2:8].sum() == rim
    assert not (found & moving).any()


def test_a_drift_moves_the_dates_that_have_a_time() -> None:
    network = Network(np.zeros((3, 3, 2)), np.zeros((2, 9, 9)), np.zeros(3, dtype=int))
    found = network.with_drift(np.array([0.1, -0.2]), np.array([4.0, 1.0]), np.array([-1.0, 2.0, 0.0]))
    np.testing.assert_allclose(found.value[:, 0], [[-0.1, 0.2], [0.2, -0.4], [0.0, 0.0]], atol=1e-12)
    assert not found.value[:, 1:].any()
    np.testing.assert_allclose(found.covariance[0][::3, ::3], [[4, -8, 0], [-8, 16, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.covariance[1][::3, ::3], [[1, -2, 0], [-2, 4, 0], [0, 0, 0]], atol=1e-12)
    assert np.count_nonzero(found.covariance) == 8
