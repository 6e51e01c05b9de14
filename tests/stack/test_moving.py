"""Moving ground: what a place has of a change over time, its variance and what counts as motion, by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.stats import chi2

from ortho_pipeline.block.stack.components import ErrorComponents
from ortho_pipeline.block.stack.edges import Cells, Edges
from ortho_pipeline.block.stack.moving import Left, Motion, _forms, _majority, _noisier, left_of, motion_of

RANDOM = np.random.default_rng(12)
#: Twelve dates in three years, each compared with the three before.
YEARS = np.linspace(20.0, 23.0, 12) + RANDOM.uniform(-0.05, 0.05, 12)
FIRST, SECOND = np.array([(i, i - k) for i in range(12) for k in (1, 2, 3) if k <= i]).T
PLACES = 9


def quiet(noise: float = 0.0) -> Left:
    """Return what is left of edges at nine places: white noise, with weights and variances of different size."""
    random, count = np.random.default_rng(3), len(FIRST)
    weight = random.uniform(50.0, 200.0, (count, PLACES))
    value = random.normal(0.0, 1.0, (count, PLACES, 2)) * noise
    apart = np.cos(2 * np.pi * (YEARS[:, None] - YEARS))
    return Left(
        value, weight, random.uniform(0.002, 0.01, weight.shape), random.uniform(0.001, 0.004, PLACES),
        random.uniform(0.5, 2.0, 12), apart, FIRST, SECOND,
    )  # fmt: skip


def exact() -> Left:
    left = quiet()
    return dataclasses.replace(left, own=1e-4 * left.own, shared=1e-4 * left.shared)


def with_rate(left: Left, places: list[int], rate: tuple[float, float], form: np.ndarray = YEARS) -> Left:
    value = left.value.copy()
    value[:, places] += (form[left.first] - form[left.second])[:, None, None] * np.array(rate)
    return dataclasses.replace(left, value=value)


def test_how_much_of_a_change_a_place_has_is_a_fit_by_weighted_least_squares() -> None:
    left = quiet(0.02)
    size, _, rest = left.change(YEARS)
    apart = YEARS[FIRST] - YEARS[SECOND]
    for place in range(PLACES):
        root = np.sqrt(left.weight[:, place])
        fit = np.linalg.lstsq((root * apart)[:, None], root[:, None] * left.value[:, place], rcond=None)[0][0]
        # No value is clipped at 2.5 sigmas or few are, so both nearly agree.
        np.testing.assert_allclose(size[place], fit, atol=0.004)
        np.testing.assert_allclose(rest[:, place], left.value[:, place] - apart[:, None] * size[place], atol=1e-12)
    size, _, rest = with_rate(quiet(), [2], (0.3, -0.2)).change(YEARS)
    np.testing.assert_allclose(size, np.eye(PLACES)[2][:, None] * [0.3, -0.2], atol=1e-9)
    np.testing.assert_allclose(rest, 0.0, atol=1e-9)


@pytest.mark.parametrize("alike", [False, True])
def test_the_variance_of_a_change_follows_from_those_of_dates_and_edges(alike: bool) -> None:
    """Errors of dates are independent, or those of one season are alike: the larger variance counts."""
    left = quiet(0.02)
    left = left if alike else dataclasses.replace(left, alike=np.eye(12))
    variance = left.change(YEARS)[1]
    incidence = np.zeros((len(FIRST), 12))
    incidence[np.arange(len(FIRST)), FIRST], incidence[np.arange(len(FIRST)), SECOND] = 1.0, -1.0
    apart, root = YEARS[FIRST] - YEARS[SECOND], np.sqrt(left.scale)
    for place in range(PLACES):
        gain = left.weight[:, place] * apart / (left.weight[:, place] @ apart**2)
        of_dates = [np.diag(left.scale), root[:, None] * left.alike * root]
        shared = max(gain @ incidence @ one @ incidence.T @ gain for one in of_dates)
        expected = left.shared[place] * shared + gain @ np.diag(left.own[:, place]) @ gain
        assert variance[place] == pytest.approx(expected, rel=1e-9)


def test_a_cloud_in_a_few_edges_is_clipped() -> None:
    """Three edges are 5 px off at one place: without the clipping they would make a rate of 1 px a year."""
    left = quiet(0.02)
    value = left.value.copy()
    some = [3, 12, 21]
    value[some, 4] += 5.0 * np.sign(YEARS[FIRST[some]] - YEARS[SECOND[some]])[:, None]
    size = dataclasses.replace(left, value=value).change(YEARS)[0]
    np.testing.assert_allclose(size[4], left.change(YEARS)[0][4], atol=0.06)


def test_a_place_is_tested_with_four_edges() -> None:
    left = quiet()
    weight = left.weight.copy()
    weight[4:, 1], weight[3:, 2] = 0.0, 0.0
    tested = dataclasses.replace(left, weight=weight).tested
    np.testing.assert_array_equal(tested, np.arange(PLACES) != 2)


def test_a_noisier_place_has_a_larger_variance() -> None:
    """The median of squares in units of their variances, compared with that of a normal distribution."""
    rest = np.array([[[1.0, 2.0]], [[3.0, 4.0]], [[50.0, 60.0]]])
    weight = np.array([[2.0], [0.5], [0.0]])
    # 2, 8, 4.5, 8: the median is 6.25. The last edge does not count.
    np.testing.assert_allclose(_noisier(np.moveaxis(rest, 0, -1), weight.T), [6.25 / chi2.median(1)])
    np.testing.assert_array_equal(_noisier(0.1 * np.moveaxis(rest, 0, -1), weight.T), [1.0])


def test_the_majority_of_places_gives_the_rate_of_stable_ground() -> None:
    rate = np.array([[0.0, 0.1], [0.02, 0.1], [-0.02, 0.13], [0.01, 0.09], [1.0, 1.0], [1.01, 1.0], [5.0, -3.0]])
    variance = np.array([1.0, 1.0, 2.0, 4.0, 1.0, 1.0, 1.0]) * 1e-3
    weight = 1.0 / variance[:4]
    np.testing.assert_allclose(_majority(rate, variance), weight @ rate[:4] / weight.sum(), atol=1e-12)
    # Two groups: within 3.03 sigmas (a square of 9.2) the one with more places counts.
    near = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 3.0], [0.0, 9.0]])
    np.testing.assert_allclose(_majority(near, np.ones(4)), [0.0, 1.0])
    far = near + np.array([[0.0, 0.0]] * 2 + [[0.0, 0.1], [0.0, 0.0]])
    np.testing.assert_allclose(_majority(far, np.ones(4)), [0.0, 0.0])


def test_a_place_with_a_rate_moves_and_its_ratio_is_that_of_its_sigma() -> None:
    left = with_rate(with_rate(quiet(), list(range(PLACES)), (0.05, 0.02)), [2, 6], (0.3, -0.4))
    motion = motion_of(left, YEARS, steady=True)
    np.testing.assert_array_equal(np.flatnonzero(motion.moving), [2, 6])
    np.testing.assert_allclose(motion.rate[[2, 6]], [[0.3, -0.4]] * 2, atol=1e-6)
    np.testing.assert_allclose(motion.rate[[0, 1]], 0.0, atol=1e-6)
    variance = left.change(YEARS)[1]
    np.testing.assert_allclose(motion.sigma, np.sqrt(variance)[:, None] * [1, 1])
    np.testing.assert_allclose(motion.ratio[[2, 6]], 0.25 / variance[[2, 6]], rtol=1e-5)
    assert set(motion.form.tolist()) == {"steady"}
    assert motion.tested.all()


@pytest.mark.parametrize(("sigmas", "moves"), [(3.6, False), (3.8, True)])
def test_motion_begins_at_a_chance_of_one_in_a_thousand(sigmas: float, moves: bool) -> None:
    """The square of 3.72 sigmas along two axes is exceeded by chance once in 1000."""
    assert chi2.sf(3.717**2, 2) == pytest.approx(1e-3, rel=0.01)
    left = quiet()
    sigma = np.sqrt(left.change(YEARS)[1][5])
    motion = motion_of(with_rate(left, [5], (sigmas * sigma, 0.0)), YEARS, steady=True)
    assert sigmas * sigma * np.ptp(YEARS) > 0.1
    assert motion.moving[5] == moves


@pytest.mark.parametrize(("whole", "moves"), [(0.095, False), (0.105, True)])
def test_less_than_a_tenth_of_a_pixel_is_no_motion(whole: float, moves: bool) -> None:
    motion = motion_of(with_rate(exact(), [5], (0.0, whole / np.ptp(YEARS))), YEARS, steady=True)
    assert motion.moving[5] == moves


@pytest.mark.parametrize(
    ("form", "name"),
    [(1.0 * (np.arange(12) >= 6), "step"), (np.cos(2 * np.pi * YEARS), "yearly"), (YEARS, "steady")],
)
def test_motion_has_the_form_that_it_has(form: np.ndarray, name: str) -> None:
    """A step and a wave have some of a rate, too; without that, only they are seen."""
    left = exact()
    if name != "steady":
        apart, of_form = YEARS[FIRST] - YEARS[SECOND], form[FIRST] - form[SECOND]
        form = form - (left.weight[:, 1] * apart) @ of_form / (left.weight[:, 1] @ apart**2) * YEARS
    motion = motion_of(with_rate(left, [1], (0.5, 0.5), form), YEARS)
    np.testing.assert_array_equal(np.flatnonzero(motion.moving), [1])
    assert motion.form[1] == name
    assert motion.ratio[1] > 2 * chi2.isf(1e-4, 2)
    steady = motion_of(with_rate(left, [1], (0.5, 0.5), form), YEARS, steady=True)
    assert steady.moving[1] == (name == "steady")


def test_a_date_without_a_time_takes_no_part() -> None:
    """The reference would be displaced by 100 px at one place; nothing of it is motion."""
    edges = Edges(
        np.append(FIRST, 12), np.append(SECOND, 0), np.zeros((len(FIRST) + 1, PLACES, 2)),
        np.full((len(FIRST) + 1, PLACES), 0.01), np.full(len(FIRST) + 1, 0.1),
    )  # fmt: skip
    edges.value[-1, 3] = 100.0
    edges.value[5, 4] = np.nan
    shared, own = np.zeros((2, 7)), np.zeros((2, 7))
    shared[:, 0], own[:, 1] = (0.01, 0.03), (0.02, 0.06)
    errors = ErrorComponents(shared, own, np.arange(1.0, 14.0), np.full(len(edges), 2.0), np.zeros(2))
    accepted = np.ones(len(edges), dtype=bool)
    accepted[7] = False
    network = np.full(edges.value.shape, 0.25)
    left = left_of(edges, network, errors, accepted, np.append(YEARS, np.nan))
    seen = np.ones((len(edges), PLACES), dtype=bool)
    seen[-1], seen[7], seen[5, 4] = False, False, False
    np.testing.assert_array_equal(left.value, np.where(seen, -0.25, 0.0)[:, :, None] * [1, 1])
    assert left.value[-1, 3].tolist() == [0.0, 0.0]
    # Noise of 0.02 times the scales of both dates, 2 x 0.04 of the edge, and 0.1 px that all values share.
    whole = 0.02 * (errors.scale[edges.first] + errors.scale[edges.second])[:, None] + 0.08 + 0.01
    np.testing.assert_allclose(left.weight, np.where(seen, 1.0 / whole, 0.0))
    np.testing.assert_allclose(left.own, 0.09)
    np.testing.assert_allclose(left.shared, 0.02)
    motion = motion_of(left, np.append(YEARS, np.nan))
    assert motion.tested.all()
    assert not motion.moving.any()


def test_steps_have_four_dates_on_each_side_and_seasons_a_year_and_a_half() -> None:
    time, known = np.arange(9.0), np.ones(9, dtype=bool)
    (first, one), (second, other) = _forms(time, known, 1.49)
    assert (first, second) == ("step", "step")
    assert one.tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 1]
    assert other.tolist() == [0, 0, 0, 0, 0, 1, 1, 1, 1]
    assert _forms(np.arange(7.0), known[:7], 9.0) == []
    assert [name for name, _ in _forms(time, known, 1.5)] == ["step", "step", "yearly", "yearly"]
    waves = [form for name, form in _forms(time / 4, known, 1.5) if name == "yearly"]
    np.testing.assert_allclose(
        waves, 0.5 * np.array([[1, 0, -1, 0, 1, 0, -1, 0, 1], [0, 1, 0, -1, 0, 1, 0, -1, 0]]), atol=1e-12
    )
    many = [form for name, form in _forms(np.arange(60.0), np.ones(60, dtype=bool), 1.0) if name == "step"]
    assert [int(60 - form.sum()) for form in many] == [4, 10, 16, 21, 27, 33, 39, 44, 50, 56]


def test_areas_touch_at_corners_and_the_largest_is_first() -> None:
    cells = Cells(np.zeros(2), 10.0, (5, 3))
    moving = np.array([[1, 0, 0, 0, 1], [0, 0, 0, 1, 0], [1, 0, 0, 0, 1]], dtype=bool).ravel()
    rate = np.column_stack([np.arange(15.0), -(np.arange(15.0) ** 2)])
    motion = Motion(moving, moving, rate, rate + 1.0, np.zeros(15), np.full(15, "steady"))
    areas = motion.areas(cells)
    assert [one.tolist() for one in areas] == [[4, 8, 14], [0], [10]]
    middle, sigma, _ = motion.typical(areas[0], cells)
    assert middle.tolist() == [8.0, -64.0]
    assert sigma == np.median([5, 9, 15, -15, -63, -195])


def test_cells_next_to_still_ground_have_no_part_in_the_rate_of_an_area() -> None:
    """Their chips show still ground, too. Most cells of a small area are at its rim."""
    cells = Cells(np.zeros(2), 10.0, (7, 6))
    moving, inner, tested = np.zeros((6, 7), dtype=bool), np.zeros((6, 7), dtype=bool), np.ones((6, 7), dtype=bool)
    moving[1:, 1:6], inner[2:, 2:5] = True, True  # The area reaches the last row, where no ground is below.
    moving[3, 3] = tested[3, 3] = inner[3, 3] = False  # A cell that was not tested is not still.
    rate = np.where(inner, 1.0, 0.3).ravel()[:, None] * np.ones(2)
    sigma = np.where(inner, 0.02, 0.05).ravel()[:, None] * np.ones(2)
    motion = Motion(moving.ravel(), tested.ravel(), rate, sigma, np.zeros(42), np.full(42, "steady"))
    middle, spread, _ = motion.typical(motion.areas(cells)[0], cells)
    assert (middle.tolist(), spread) == ([1.0, 1.0], 0.02)
    narrow = np.flatnonzero(moving.ravel())[:5]
    assert motion.typical(narrow, cells)[0].tolist() == [0.3, 0.3]


def test_an_area_without_inner_cells_has_the_rate_of_its_fastest_cell() -> None:
    """All cells of a small area are at its rim, and show a part of its motion; one is faster only by its noise."""
    cells = Cells(np.zeros(2), 10.0, (5, 4))
    share, spread = np.zeros((4, 5)), np.full((4, 5), 0.01)
    share[1:3, 1:4] = [[0.15, 0.8, 0.2], [0.3, 0.6, 0.9]]
    spread[1, 2], spread[2, 2], spread[2, 3] = 0.06, 0.001, 0.2
    rate, sigma = share.ravel()[:, None] * [0.6, -0.8], spread.ravel()[:, None] * [1.0, 1.0]
    ratio = (share / spread).ravel() ** 2
    motion = Motion(share.ravel() > 0, np.ones(20, dtype=bool), rate, sigma, ratio, np.full(20, "steady"))
    found, of_found, square = motion.typical(motion.areas(cells)[0], cells)
    np.testing.assert_allclose(found, [0.48, -0.64])
    # What a row states belongs together: the rate is so many sigmas.
    assert np.hypot(*found) / of_found == pytest.approx(np.sqrt(square)) == pytest.approx(0.8 / 0.06)
