"""Motion that is too small to be found: it does not displace the dates, or their sigmas contain it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from networks import Made, Truth

from ortho_pipeline.block.stack.adjustment import AdjustedStack, adjust
from ortho_pipeline.block.stack.common_changes import CommonChanges, Drift
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.moving import Motion
from ortho_pipeline.block.stack.network import Network

CELLS = Cells.over(np.zeros(2), np.full(2, 1000.0))
DRIFT = CommonChanges.drift


def motion(moving: np.ndarray) -> Motion:
    count = len(moving)
    return Motion(
        moving, np.ones(count, dtype=bool), np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count),
        np.full(count, "steady"),
    )  # fmt: skip


def with_rim(seed: int, share: float, dates: int = 24) -> Made:
    """Return edges of two years in which the neighbours of moving ground have a share of its motion."""
    errors = {"noise": 0.06, "of_date": 0.02, "of_edge": 0.02}
    made = Truth(seed=seed, dates=dates, interval=864.0 / dates, moving=0.2, **errors).made()
    rim = motion(made.moving).touched(CELLS) & ~made.moving
    years = made.years[made.edges.first] - made.years[made.edges.second]
    value = made.edges.value + years[:, None, None] * share * made.rate[made.moving].mean(axis=0) * rim[:, None]
    return dataclasses.replace(made, edges=dataclasses.replace(made.edges, value=value))


def with_reference(made: Made, linked: list[int], before: float) -> tuple[Edges, list[float]]:
    """Return edges and times with a reference after the dates, so many years older than the first one."""
    random, count, dates = np.random.default_rng(made.truth.seed), len(CELLS.place), made.truth.dates
    years = made.years[linked] - (made.years[0] - before)
    noise = random.normal(0.0, made.truth.noise, (len(linked), count, 2))
    value = made.shift[linked][:, None] + made.rate * years[:, None, None] + noise
    old = made.edges
    edges = Edges(
        np.append(old.first, linked), np.append(old.second, np.full(len(linked), dates)),
        np.concatenate([old.value, value]), np.full((len(old) + len(linked), count), made.truth.noise**2),
        np.zeros(len(old) + len(linked)),
    )  # fmt: skip
    return edges, [*made.years.tolist(), np.nan]


def solved(made: Made) -> tuple[AdjustedStack, np.ndarray]:
    """Return the adjustment and its errors ``(T, 2)``."""
    found = adjust(CELLS, made.edges, made.years.tolist())
    return found, found.network.value[:, 0] - (made.shift - made.shift.mean(axis=0))


def rate_of(made: Made) -> np.ndarray:
    """Return the rate ``(2,)`` of the errors, px a year."""
    return np.asarray(np.polyfit(made.years, solved(made)[1], 1)[0])


def spread(found: list[tuple[AdjustedStack, np.ndarray]]) -> float:
    return float(np.sqrt(np.mean([((errors / one.sigma[: len(errors)]) ** 2).mean() for one, errors in found])))


def test_the_rim_of_moving_ground_does_not_displace_the_dates(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rim has 6 % of the motion, 0.06 px a year, and few of its cells are found."""
    still, rim = with_rim(5, 0.0), with_rim(5, 0.06)
    expected = rate_of(still)
    assert np.hypot(*(rate_of(rim) - expected)) < 0.002
    monkeypatch.setattr(CommonChanges, "drift", lambda self, touched, linked: DRIFT(self, touched & False, linked))
    assert np.hypot(*(rate_of(rim) - expected)) > 0.004


@pytest.mark.parametrize("dates", [6, 14])
def test_sigmas_contain_motion_that_is_not_found(dates: int) -> None:
    """Two fifths of the ground move for half a year, too little to be found.

    Four stacks have 8 drifts, so a spread of 1 is seen within 0.5 of it (two sigmas).
    """
    given = {"dates": dates, "interval": 224.0 / dates, "moving": 0.4, "hidden": 0.3}
    stacks = [Truth(seed=seed, **given).made() for seed in range(4)]
    found = [solved(made) for made in stacks]
    assert sum(int(one.motion.moving.sum()) for one, _ in found) < 20
    assert 0.5 < spread(found) < 1.5


def test_sigmas_contain_motion_since_the_reference() -> None:
    """The reference is half a year older than the first of 8 dates, and hardly any motion is found."""
    found = []
    for seed in range(4):
        made = Truth(seed=seed, dates=8, interval=28.0, moving=0.4).made()
        edges, years = with_reference(made, list(range(8)), 0.5)
        one = adjust(CELLS, edges, years, 8)
        found.append((one, one.network.value[:8, 0] - made.shift))
    assert 0.5 < spread(found) < 1.5


def test_dates_that_were_compared_with_the_reference_keep_their_place() -> None:
    """The drift turns about the dates that were compared with the reference, not about the middle of all."""
    made = with_rim(3, 0.06)
    edges, years = with_reference(dataclasses.replace(made, rate=np.zeros((144, 2))), list(range(18, 24)), 0.0)
    found = adjust(CELLS, edges, years, 24)
    errors = found.network.value[18:24, 0] - made.shift[18:24]
    assert (np.abs(errors.mean(axis=0)) < 0.006).all()


def test_an_old_pair_without_a_link_changes_nothing() -> None:
    made = with_rim(3, 0.06, 10)
    edges, years = with_reference(dataclasses.replace(made, rate=np.zeros((144, 2))), list(range(10)), 0.0)
    noise = np.random.default_rng(0).normal(0, 0.06, (1, 144, 2))
    pair = Edges(np.array([11]), np.array([12]), noise, np.full((1, 144), 0.0036), np.zeros(1))
    more = Edges(**{name: np.concatenate([getattr(edges, name), getattr(pair, name)]) for name in
                    ("first", "second", "value", "variance", "alike")})  # fmt: skip
    one = adjust(CELLS, edges, years, 10)
    other = adjust(CELLS, more, [*years, made.years[0] - 10.0, made.years[0] - 10.1], 10)
    np.testing.assert_allclose(one.network.value[:10, 0], other.network.value[:10, 0], atol=0.002)


def test_rates_of_ground_are_relative_to_stable_ground_whose_rate_is_uncertain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their variance has that of the drift, along each axis."""
    made, found = Truth(seed=4, dates=8).made(), list[np.ndarray]()
    for variance in (np.zeros(2), np.array([4e-4, 9e-4])):
        drift = Drift(np.zeros(2), variance, np.zeros(8))
        monkeypatch.setattr(CommonChanges, "drift", lambda *given, drift=drift: drift)
        found.append(adjust(CELLS, made.edges, made.years.tolist(), affine=False).motion.sigma)
    np.testing.assert_allclose(found[1] ** 2 - found[0] ** 2, np.tile([4e-4, 9e-4], (144, 1)), rtol=1e-6)


def test_an_area_of_four_cells_touches_its_neighbours() -> None:
    """A row of four cells at the rim of 12 x 8 cells, three cells that are too few, and a single one."""
    cells = Cells.over(np.zeros(2), np.array([1200.0, 800.0]))
    moving = np.zeros((8, 12), dtype=bool)
    moving[0, 3:7] = moving[4, 8:11] = moving[7, 0] = True
    expected = moving.copy()
    expected[0:2, 2:8] = True
    found = motion(moving.ravel()).touched(cells).reshape(8, 12)
    np.testing.assert_array_equal(found, expected)


def test_a_drift_moves_the_dates_that_have_a_time() -> None:
    network = Network(np.zeros((3, 3, 2)), np.zeros((2, 9, 9)), np.zeros(3, dtype=int))
    found = network.with_drift(np.array([0.1, -0.2]), np.array([4.0, 1.0]), np.array([-1.0, 2.0, 0.0]))
    np.testing.assert_allclose(found.value[:, 0], [[-0.1, 0.2], [0.2, -0.4], [0.0, 0.0]], atol=1e-12)
    assert not found.value[:, 1:].any()
    np.testing.assert_allclose(found.covariance[0][::3, ::3], [[4, -8, 0], [-8, 16, 0], [0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.covariance[1][::3, ::3], [[1, -2, 0], [-2, 4, 0], [0, 0, 0]], atol=1e-12)
    assert np.count_nonzero(found.covariance) == 8
