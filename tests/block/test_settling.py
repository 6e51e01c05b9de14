"""Heights of a DEM from round to round: which take part, which are wrong, where they are read, and what is stable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import CRS, EAST, NORTH, Block, Chain, dem, dense, fly, spots_of, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.problem import Selection
from ortho_pipeline.block.equations.solver import EXACT, NEAR, Solved, attempt
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights import settling
from ortho_pipeline.block.heights.common_heights import CommonHeights, correlated
from ortho_pipeline.block.heights.settling import Heights, _breaking, _same_errors, _stable
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import NotConverged
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.estimation.problem import CONDITION_LIMIT
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem

CELL = 10.0
Surfaces = Callable[[Array, Array], Array]


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=10.0, ties=40, errors=1.0), 2)


def raster(path: Path, heights: Surfaces, void: float = -1e9) -> Any:
    """Return a DEM of heights by metres east and north of the chain's origin; none west of `void`."""
    x, y = np.meshgrid(-400.0 + (np.arange(130) + 0.5) * CELL, 400.0 - (np.arange(80) + 0.5) * CELL)
    made = np.where(x < void, -32768.0, heights(x, y))
    write_dem(path, made, (EAST - 400.0, NORTH + 400.0), CELL, CRS)
    return open_dem(path, "ellipsoid", override=True)


def prepared(flown: Block, points: BlockPoints, source: DemHeights) -> tuple[Any, Any, Selection]:
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, (), source)
    return problem, state, selection


def some_control(flown: Block) -> BlockPoints:
    """Return eight control points, of which the first two have no height; the rays are in no order."""
    points = with_control(flown, "i1", 8, sigma=0.2)
    ground = points.ground.copy()
    ground[np.flatnonzero(points.control)[:2], 2] = np.nan
    return replace(points, ground=ground).of_rays(np.random.default_rng(4).permutation(points.rays))


# -- before the adjustment ---------------------------------------------------------------------------------------------


def test_ties_and_control_without_a_height_take_one_from_the_dem(flown: Block, tmp_path: Path) -> None:
    sigma = raster(tmp_path / "sigma.tif", lambda x, y: 3.0 + 0.01 * x, void=60.0)
    surface = raster(tmp_path / "dem.tif", lambda x, y: 200.0 + 0.1 * x - 0.2 * y).with_sigma(sigma)
    source, points = DemHeights(surface), some_control(flown)
    problem, state, _ = prepared(flown, points, source)
    made = Heights.under(source, problem, state.local)
    without = points.control & ~np.isfinite(points.ground[:, 2])
    assert without.sum() == 2
    np.testing.assert_array_equal(made.of, points.tie | without)
    first = [points.image[points.point == k].min() for k in range(len(points))]
    np.testing.assert_array_equal(made.images, first)
    assert len(set(first)) > 1
    # The sigma of each is that of the raster; the bias is as large as a typical height's.
    places = ground_transform("EPSG:4979", CRS)(problem.frame.geodetic(state.local))
    wanted = 3.0 + 0.01 * (places[:, 0] - EAST)
    assert made.stated is not None
    known = np.isfinite(made.stated)
    assert 4 < known.sum() < made.of.sum()
    np.testing.assert_array_equal(known & ~made.of, False)
    np.testing.assert_allclose(made.stated[known], wanted[known], rtol=1e-4)
    assert made.common.sigma == pytest.approx(np.sqrt(np.mean(made.stated[known] ** 2)))
    np.testing.assert_array_equal(made.common.loads, np.array([made.common.sigma, 0, 0]) * np.ones((len(points), 1)))
    assert made.common.points == made.of.sum()
    # Each counts by how many share its samples; the others have a weight of one.
    ground = problem.frame.geodetic(state.local)[made.of]
    np.testing.assert_allclose(made.own[made.of], source.sharing(ground))
    np.testing.assert_array_equal(made.own[~made.of], 1.0)


def test_the_bias_has_the_sigma_that_is_known_of_it(flown: Block, tmp_path: Path) -> None:
    """Stated, or that of a height, or 10 m if nobody states that; with spot heights it is free."""
    surface = raster(tmp_path / "dem.tif", lambda x, y: 200.0 + 0.1 * x)
    nowhere = surface.with_sigma(raster(tmp_path / "sigma.tif", lambda x, y: 3.0 + 0 * x, void=1e9))
    spots = spots_of(flown, 0.2, 0.3, np.random.default_rng(3))
    points = some_control(flown)
    for source, sigma in (
        (DemHeights(surface), 10.0),
        (DemHeights(surface.with_sigma(3.0)), 3.0),
        (DemHeights(nowhere), 10.0),
        (DemHeights(surface.with_sigma(3.0), bias=0.0), 0.0),
        (DemHeights(surface.with_sigma(3.0), spots=spots), 100.0),
        (DemHeights(surface.with_sigma(3.0), spots=spots, bias=7.0), 7.0),
    ):
        problem, state, _ = prepared(flown, points, source)
        made = Heights.under(source, problem, state.local)
        assert made.common.sigma == pytest.approx(sigma)
        np.testing.assert_allclose(made.common.loads[:, 0], sigma)
        assert (made.spots is None) == (source.spots is None)
        if made.spots is not None:
            np.testing.assert_allclose(made.spots.loads[:, 0], sigma)


@pytest.mark.parametrize("sigma", [None, 2.5])
def test_correlated_errors_are_those_of_ties_and_spots_together(
    flown: Block, tmp_path: Path, sigma: float | None
) -> None:
    spots = spots_of(flown, 0.2, 0.3, np.random.default_rng(3))
    surface = raster(tmp_path / "dem.tif", lambda x, y: 200.0 + 0.1 * x).with_sigma(sigma)
    source = DemHeights(surface, correlation=300.0, bias=4.0, spots=spots)
    problem, state, _ = prepared(flown, some_control(flown), source)
    made = Heights.under(source, problem, state.local)
    assert made.spots is not None
    places = np.vstack([state.local[made.of], problem.frame.of_geodetic(spots.ground)])
    alike = np.exp(-np.linalg.norm(places[:, None] - places, axis=2) / 300.0)
    loads = np.vstack([made.common.loads[made.of, 3:], made.spots.loads[:, 3:]]) / (10.0 if sigma is None else sigma)
    # All but a hundredth of the variance is in the loads; what is left is each height's own.
    np.testing.assert_allclose(loads @ loads.T, alike, atol=0.08)
    own = np.concatenate([made.own[made.of], made.spots.own])
    np.testing.assert_allclose(own, np.maximum(1.0 - (loads**2).sum(axis=1), 0.01), rtol=1e-9)
    np.testing.assert_array_equal(made.common.loads[~made.of, 3:], 0.0)
    # Without spots they are those of the ties.
    alone = Heights.under(replace(source, spots=None), problem, state.local)
    wanted, left = correlated(state.local[made.of], 300.0)
    np.testing.assert_allclose(alone.common.loads[made.of, 3:], wanted * (10.0 if sigma is None else sigma))
    np.testing.assert_allclose(alone.own[made.of], left)


# -- rounds ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def plane(flown: Block, tmp_path: Path) -> tuple[Solved, Heights]:
    """Heights of a surface whose slopes change from place to place, at a solution with them."""
    surface = raster(tmp_path / "dem.tif", lambda x, y: 200.0 + 0.05 * x + 2e-4 * x**2 - 0.1 * y + 1e-4 * x * y)
    source = DemHeights(surface.with_sigma(1.0), bias=4.0, shift=8.0, correlation=150.0)
    problem, state, selection = prepared(flown, some_control(flown), source)
    heights = Heights.under(source, problem, state.local)
    solved = attempt(heights.applied(problem), state, selection)
    return solved, heights._under(problem, solved.state.local)


def moved_by(heights: Heights, east: float, north: float) -> Heights:
    """Return them with an estimate of the DEM's shift, m."""
    value = np.linspace(-0.7, 0.9, len(heights.common.value))
    value[:3] = 0.5, east / heights.source.shift_sigma, north / heights.source.shift_sigma
    return replace(heights, common=replace(heights.common, value=value))


def under(solved: Solved, metres: tuple[float, float]) -> Array:
    """Return the points of a solution so many metres to the east and north."""
    frame, local = solved.problem.frame, solved.state.local
    turn = frame.enu_at(frame.geodetic(local))
    return np.asarray(local + np.einsum("nij,i->nj", turn, np.array([*metres, 0.0])))


def test_a_shifted_dem_is_read_as_far_off(plane: tuple[Solved, Heights]) -> None:
    solved, heights = plane
    found = moved_by(heights, 6.0, -11.0)._following(solved, solved.state.local)
    assert found.source.read_at == pytest.approx((6.0, -11.0))
    modes = found.common.value[3:]
    assert len(modes) > 3
    np.testing.assert_allclose(found.common.undone, [0.0, 6.0 / 8.0, -11.0 / 8.0, *np.zeros(len(modes))])
    # The shift is in where the DEM is read, so no more of it is taken off the heights.
    tie = solved.problem.points.tie
    np.testing.assert_allclose(
        found.common.with_slopes(np.ones((len(tie), 2)), 8.0).offset, 4.0 * 0.5 + found.common.loads[:, 3:] @ modes
    )
    places = ground_transform("EPSG:4979", CRS)(solved.problem.frame.geodetic(under(solved, (6.0, -11.0))))
    x, y = places[tie, 0] - EAST, places[tie, 1] - NORTH
    wanted = 200.0 + 0.05 * x + 2e-4 * x**2 - 0.1 * y + 1e-4 * x * y
    np.testing.assert_allclose(found.terrain.heights[tie], wanted, atol=0.02)
    np.testing.assert_allclose(found.terrain.measured[tie, 0], 0.05 + 4e-4 * x + 1e-4 * y, atol=1e-3)
    # A second shift is in place of the first.
    again = moved_by(found, -3.0, 2.0)._following(solved, solved.state.local)
    assert again.source.read_at == pytest.approx((-3.0, 2.0))


@pytest.mark.parametrize("shift", [(6.0, -11.0), (-9.0, 0.0)])
def test_slopes_stay_where_points_followed_the_shift(plane: tuple[Solved, Heights], shift: tuple[float, float]) -> None:
    """A point that moves against the shift is over the same place of the DEM; of another one slopes are read again."""
    solved, heights = plane
    tie = solved.problem.points.tie
    against = moved_by(heights, *shift)._following(solved, under(solved, (-shift[0], -shift[1])))
    np.testing.assert_array_equal(against.terrain.measured[tie], heights.terrain.measured[tie])
    np.testing.assert_allclose(against.terrain.heights[tie], heights.terrain.heights[tie], atol=1e-4)
    along = moved_by(heights, *shift)._following(solved, solved.state.local)
    assert (along.terrain.measured[tie] != heights.terrain.measured[tie]).all(axis=1).all()


@pytest.mark.parametrize(
    ("shift", "again"),
    [((2.4, 0.3), False), ((2.6, 0.3), True), ((0.3, 2.6), True), ((-2.6, 0.3), True), ((-2.4, -2.4), False)],
)
def test_breaks_are_looked_for_again_a_quarter_of_a_sample_off(
    plane: tuple[Solved, Heights], shift: tuple[float, float], again: bool
) -> None:
    solved, heights = plane
    heights = replace(heights, broken=heights.of)
    found = moved_by(heights, *shift)._following(solved, solved.state.local)
    # The surface is smooth: nothing is broken where it is looked at.
    assert found.broken.any() != again


def test_spots_are_read_where_the_shift_puts_them(flown: Block, tmp_path: Path) -> None:
    surface = raster(tmp_path / "dem.tif", lambda x, y: 200.0 + 0.3 * x - 0.1 * y).with_sigma(1.0)
    spots = spots_of(flown, 0.2, 0.3, np.random.default_rng(3))
    source = DemHeights(surface, shift=8.0, spots=spots)
    problem, state, selection = prepared(flown, some_control(flown), source)
    heights = Heights.under(source, problem, state.local)
    solved = attempt(heights.applied(problem), state, selection)
    found = moved_by(heights, 5.0, -4.0)._following(solved, state.local)
    assert heights.spots is not None
    assert found.spots is not None
    # Sigmas of a height and of a spot, and of no place in plan: each spot tells of the bias and of the shift.
    more = heights.seen(solved)[0].told - replace(heights, spots=None).seen(solved)[0].told
    rows = np.array([100.0, -0.3 * 8.0, 0.1 * 8.0])
    weight = (1.0 / (heights.spots.own * 1.0 + 0.09)).sum()
    np.testing.assert_allclose(more, weight * np.outer(rows, rows), rtol=1e-2)
    np.testing.assert_allclose(found.spots.apart - heights.spots.apart, 0.3 * 5.0 + 0.1 * 4.0, rtol=2e-3)
    np.testing.assert_allclose(
        found.spots.loads[:, 1:], np.array([[-0.3 * 8.0, 0.1 * 8.0]]) * np.ones((8, 1)), rtol=1e-2
    )


def judging(monkeypatch: pytest.MonkeyPatch, heights: Heights, residuals: Array, variances: Array) -> Heights:
    def made(*_: object) -> tuple[Array, Array, Mask]:
        return residuals, variances, heights.of

    monkeypatch.setattr(Heights, "_residuals", made)
    return heights


def few(**more: Any) -> Heights:
    """Return six heights with a sigma of 2 m; the last one is of no tie, and two were left out before."""
    none: Any = None
    of = np.arange(6) < 5
    wrong = np.array([False, False, True, True, False, False])
    numbers = {"sigma": 2.0, "own": np.ones(6), "common": none, "wrong": wrong, "broken": ~of, **more}
    source: Any = SimpleNamespace(correlation=None)
    return Heights(source, of, none, none, numbers.pop("stated", np.full(6, 2.0)), **numbers)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_height_is_wrong_beyond_four_sigmas_and_right_within_three(
    monkeypatch: pytest.MonkeyPatch, way: float
) -> None:
    monkeypatch.setattr(settling, "_breaking", lambda judged, solved: judged.of)
    none: Any = None
    spread = np.array([0.25, 0.25, 9.0, 9.0, 0.01, 1.0])
    # A residual varies by 0.4 m at least: a fifth of the height's sigma.
    sigmas = np.array([0.5, 0.5, 3.0, 3.0, 0.4, 1.0])
    off = np.array([3.9, 4.1, 3.1, 2.9, 3.9, 9.0])
    made = judging(monkeypatch, few(), way * off * sigmas, spread)
    for number in (1, 5):
        found = made._judged(none, none, number)
        assert found.wrong.tolist() == [False, True, True, False, False, False]
        np.testing.assert_array_equal(found.broken, ~made.of)
    made = judging(monkeypatch, few(), way * np.array([3.9, 4.1, 3.1, 2.9, 4.1, 9.0]) * sigmas, spread)
    assert made._judged(none, none, 2).wrong.tolist() == [False, True, True, False, True, False]
    # Breaks are looked for in the first round; after the sixth, what is left out stays.
    np.testing.assert_array_equal(made._judged(none, none, 0).broken, made.of)
    settled = made._judged(none, none, 6)
    assert settled.wrong is made.wrong
    assert settled.broken is made.broken


def test_stated_sigmas_are_tested_from_the_second_round_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(settling, "_breaking", lambda judged, solved: judged.broken)
    monkeypatch.setattr(settling, "_ENOUGH", 3)
    none: Any = None
    for stated, rounds in ((np.full(6, 2.0), [1.0, 2.0, 2.0]), (None, [1.0, 1.0, 1.0])):
        made = judging(monkeypatch, few(stated=stated), np.full(6, 20.0), np.full(6, 4.0))
        assert [made._judged(none, none, number).scale for number in (0, 1, 9)] == rounds
        assert made._judged(none, none, 0).estimated == (stated is None)


def test_the_sigma_of_spots_and_heights_together_is_estimated() -> None:
    """Forty residuals of ties, and ten of spots, which have no redundancy to divide by."""
    random = np.random.default_rng(7)
    residuals, redundancy = random.normal(0, 2, 40), random.uniform(0.3, 0.9, 40)
    of_spots = np.abs(random.normal(0, 0.4, 10))
    spots: Any = SimpleNamespace(standardised=lambda common, sigma: of_spots)
    nothing: Any = None
    source: Any = SimpleNamespace(correlation=None)
    made = Heights(
        source, np.ones(40, dtype=bool), nothing, nothing, None, 5.0, np.ones(40), nothing, nothing, nothing,
        spots=spots,
    )  # fmt: skip
    found = made._estimated(residuals, 25.0 * redundancy, np.ones(40, dtype=bool))
    sizes = np.concatenate([np.abs(residuals) / np.sqrt(redundancy), 5.0 * of_spots])
    assert found.sigma == pytest.approx(1.4826 * np.median(sizes))
    assert not replace(made, spots=None)._estimated(residuals, 25.0 * redundancy, np.ones(40, dtype=bool)).estimated


@pytest.mark.parametrize(("number", "part"), [(0, 1.0), (1, 0.5), (7, 0.5)])
def test_shared_errors_go_half_the_way_after_the_first_round(
    monkeypatch: pytest.MonkeyPatch, number: int, part: float
) -> None:
    common = replace(CommonHeights.of(np.ones((6, 3)), 4.0, 6, 0), value=np.array([0.3, -0.2, 0.1]))
    common = replace(common, told=np.diag([1.0, 3.0, 0.0]))
    for size, moves in ((-1.0, True), (1.0, True), (-0.019 / 0.35, False), (-0.021 / 0.35, True)):
        slope = common.value + size * np.array([0.7, 0.4, 0.1])
        monkeypatch.setattr(Heights, "seen", lambda heights, solved, slope=slope: (common, slope))
        none: Any = None
        found = few(common=common)._with_shared_errors(none, number).common
        wanted = size * np.array([0.35, 0.1, 0.1])
        np.testing.assert_allclose(found.value, common.value + (part * wanted if moves else 0.0))
        assert (found.value is common.value) != moves


def test_a_scale_that_changes_by_four_per_cent_stays() -> None:
    sigmas, used = np.linspace(1.0, 3.0, 60), np.ones(60, dtype=bool)
    residuals = 2.0 * sigmas * (-1.0) ** np.arange(60)
    none: Any = None
    made = Heights(none, used, none, none, sigmas, 10.0, np.ones(60), none, none, none, scale=2.0)
    for part, wanted in ((1.03, 2.0), (1.05, 2.1), (0.97, 2.0), (0.95, 1.9)):
        assert made._scaled(part * residuals, 4.0 * sigmas**2, used).scale == pytest.approx(wanted)


@pytest.mark.parametrize(("rounds", "tolerance"), [(20, EXACT), (1, NEAR), (3, NEAR)])
def test_a_round_begins_where_shared_errors_move_the_block(
    plane: tuple[Solved, Heights], monkeypatch: pytest.MonkeyPatch, rounds: int, tolerance: float
) -> None:
    """If that does not converge, the solution before it is the result of few rounds, and none of all rounds is."""
    solved, heights = plane
    asked: list[Any] = []
    for how in ({"converged": False}, {"undetermined": True}, {"condition": 1.01 * CONDITION_LIMIT}):
        answer = SimpleNamespace(**{"converged": True, "undetermined": False, "condition": 1.0, **how})

        def attempted(*given: Any, answer: Any = answer) -> Any:
            asked.append(given)
            return answer

        monkeypatch.setattr(settling, "attempt", attempted)
        if rounds == 20:
            with pytest.raises(NotConverged):
                heights.settled(solved, solved.linear.weights, rounds)
        else:
            assert heights.settled(solved, solved.linear.weights, rounds) == (solved, heights)
    assert len(asked) == 3
    problem, state, _, found = asked[0]
    assert found == tolerance
    after = heights._with_shared_errors(solved, 0).common
    assert np.abs(after.value).max() > 0.1
    np.testing.assert_allclose(state.local, after.followed(heights.common, solved).local, atol=1e-9)
    # The planes are those of the DEM where the points will be, without all that heights share.
    tie = np.flatnonzero(problem.heights.on & ~problem.placed)
    x, y = (ground_transform("EPSG:4979", CRS)(problem.frame.geodetic(state.local))[tie, :2] - [EAST, NORTH]).T
    x, y = x + 8.0 * after.value[1], y + 8.0 * after.value[2]
    shared = after.loads[tie][:, [0, *range(3, len(after.value))]] @ np.delete(after.value, [1, 2])
    wanted = 200.0 + 0.05 * x + 2e-4 * x**2 - 0.1 * y + 1e-4 * x * y - shared
    np.testing.assert_allclose(problem.frame.geodetic(problem.heights.places)[tie, 2], wanted, atol=0.03)


def test_settled_heights_are_at_rest(plane: tuple[Solved, Heights]) -> None:
    """Nothing that they share is left to be estimated, and the DEM is read where the points are."""
    solved, heights = plane
    solved, settled = heights.settled(solved, solved.linear.weights)
    common, slope = settled.seen(solved)
    assert np.abs(common.step(slope)).max() <= 0.02
    planes = solved.problem.heights
    assert planes is not None
    again = settled._under(solved.problem, solved.state.local).applied(solved.problem).heights
    assert again is not None
    off = np.abs(again.above(solved.state.local) - planes.above(solved.state.local)) / planes.sigmas
    assert (off[planes.on] > 0.02).sum() <= 0.02 * planes.on.sum()


# -- what a solution tells ---------------------------------------------------------------------------------------------


def planes_of(heights: Array, sigmas: Array) -> Planes:
    count = len(heights)
    return Planes(np.column_stack([np.zeros((count, 2)), heights]), np.tile(np.eye(3), (count, 1, 1)), sigmas)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(
    ("changed", "left", "stable"), [(40, 2, True), (41, 2, False), (40, 3, False), (0, 2, True), (0, 3, False)]
)
def test_heights_are_stable_if_few_changed_and_hardly_any_left(
    way: float, changed: int, left: int, stable: bool
) -> None:
    """Of 2000: forty (2 %) may change by more than 2 % of a sigma, and two (0.1 %) be left out or return."""
    local = np.full((2003, 3), 700.0)
    sigmas = np.full(2003, 5.0)
    sigmas[2000:] = np.inf
    old = planes_of(np.full(2003, 650.0), sigmas)
    now = np.full(2003, 650.0) + way * 5.0 * np.where(np.arange(2003) < changed, 0.021, 0.019)
    solved: Any = SimpleNamespace(problem=SimpleNamespace(heights=old), state=SimpleNamespace(local=local))
    # Some more leave before the first, so that 2000 are left; some that were out may return, too.
    were = sigmas.copy()
    were[100 : 100 + left] = np.inf
    before: Any = SimpleNamespace(
        problem=SimpleNamespace(heights=planes_of(np.full(2003, 650.0), were)), state=solved.state
    )
    problem: Any = SimpleNamespace(heights=planes_of(now, sigmas))
    assert _stable(before, problem) is stable


def test_a_height_that_is_left_out_counts_as_one_that_changed() -> None:
    sigmas = np.full(2003, 5.0)
    for left, stable in ((2, True), (3, False)):
        now = sigmas.copy()
        now[50 : 50 + left] = np.inf
        solved: Any = SimpleNamespace(
            problem=SimpleNamespace(heights=planes_of(np.full(2003, 650.0), sigmas)),
            state=SimpleNamespace(local=np.zeros((2003, 3))),
        )
        problem: Any = SimpleNamespace(heights=planes_of(np.full(2003, 650.0), now))
        assert _stable(solved, problem) is stable


def test_errors_are_the_same_if_sigma_scale_and_shared_ones_are() -> None:
    one = few(common=SimpleNamespace(value=np.array([0.1, 0.2, 0.3])))
    same = replace(one, common=SimpleNamespace(value=np.array([0.1, 0.2, 0.3])))  # type: ignore[arg-type]
    assert _same_errors(one, same)
    other: Any = SimpleNamespace(value=np.array([0.1, 0.2, 0.31]))
    for different in (replace(same, sigma=2.1), replace(same, scale=1.1), replace(same, common=other)):
        assert not _same_errors(one, different)


def test_breaks_are_looked_for_as_far_as_the_place_is_uncertain() -> None:
    """By the larger sigma in plan, a sample of 10 m at most: at 7 m steps of four sigmas of the height."""
    plan = np.array([(2.0, 5.0), (5.0, 2.0), (30.0, 1.0), (np.nan, np.nan), (4.0, 4.0), (4.0, 4.0)])
    covariance = np.zeros((6, 3, 3))
    covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 2, 2] = plan[:, 0] ** 2, plan[:, 1] ** 2, 400.0
    asked: list[Array] = []

    def breaks(ground: Array, slopes: Array, metres: Array) -> Array:
        asked.extend([ground, slopes, metres])
        return np.array([7.9, 8.1, -1.0, np.nan])

    source: Any = SimpleNamespace(breaks=breaks, surface=SimpleNamespace(sample_size=10.0))
    slopes = np.array([(0.1, 0.2), (np.nan, np.nan), (0.5, 0.6), (0.7, 0.8), (0.9, 1.0), (1.1, 1.2)])
    terrain: Any = SimpleNamespace(ground=np.arange(18.0).reshape(6, 3), slopes=slopes)
    heights = replace(few(), source=source, terrain=terrain, of=np.array([True] * 5 + [False]))
    solved: Any = SimpleNamespace(cofactors=None, ground_covariance=lambda cofactors, factor: factor * covariance)
    found = _breaking(replace(heights, broken=np.array([False, False, True, True, True, True])), solved)
    # Of points without a place, or without heights, nothing is looked for.
    assert found.tolist() == [False, True, False, True, False, True]
    np.testing.assert_array_equal(asked[0], terrain.ground[[0, 1, 2, 4]])
    np.testing.assert_array_equal(asked[1], [(0.1, 0.2), (0.0, 0.0), (0.5, 0.6), (0.9, 1.0)])
    np.testing.assert_allclose(asked[2], [5.0, 5.0, 10.0, 4.0])


def test_residuals_of_heights_that_share_samples_vary_by_their_own_errors(flown: Block, tmp_path: Path) -> None:
    """Such a height weighs less than alone, and errs as it does alone: by the dense residual with that error."""
    source = DemHeights(dem(flown, tmp_path / "dem.tif", 2, white=1.0).with_sigma(1.5), bias=4.0)
    problem, state, selection = prepared(flown, some_control(flown), source)
    heights = Heights.under(source, problem, state.local)
    own = np.random.default_rng(8).uniform(1.2, 4.0, len(heights.own))
    heights = replace(heights, own=own, wrong=heights.of & (np.arange(len(own)) % 7 == 3))
    # One tie takes no part.
    out_of_it = int(np.flatnonzero(heights.of & ~heights.wrong & ~problem.placed)[2])
    selection = replace(selection, rays=selection.rays & (problem.points.point != out_of_it))
    solved = attempt(heights.applied(problem), state, selection)
    planes, linear = solved.problem.heights, solved.linear
    assert planes is not None
    residuals, variances, taking = heights._residuals(solved, solved.state.local)
    assert (residuals[out_of_it], variances[out_of_it], taking[out_of_it]) == (0.0, np.inf, False)
    design, _ = dense(linear)
    hat = design @ np.linalg.inv(design.T @ design) @ design.T
    grounded = linear.ordering.grounded.tolist()
    plan = solved.problem.placed
    for point in np.flatnonzero(taking & ~plan).tolist():
        row = 2 * len(linear.ordering.rays) + 3 * grounded.index(point) + 2
        # In units of the weighed sigma, the height itself errs by 1 / own, everything else by 1.
        spread = np.ones(len(hat))
        spread[row] = 1.0 / own[point]
        left = (np.eye(len(hat))[row] - hat[row]) ** 2 @ spread
        assert variances[point] == pytest.approx(left * 1.5**2 * own[point], rel=1e-3)
        assert residuals[point] == pytest.approx(linear.misfits.ground[point, 2] * 1.5 * own[point] ** 0.5, rel=1e-3)
    assert (taking & ~plan).sum() > 15
    # One that takes no part errs by itself, and by the place of its point.
    of_points = solved.points.ground(solved.cofactors, 1.0)
    every = heights._planes(solved.problem, heights.of)
    out = np.flatnonzero(heights.wrong & every.on & ~plan).tolist()
    assert len(out) > 2
    frame = solved.problem.frame
    for point in out:
        normal = every.axes[point, 2]
        upright = normal @ frame.enu_at(frame.geodetic(solved.state.local[[point]]))[0, 2]
        wanted = 1.5**2 + normal @ of_points[point] @ normal / upright**2
        assert variances[point] == pytest.approx(wanted, rel=1e-4)
        above = every.above(solved.state.local)[point] / upright
        assert residuals[point] == pytest.approx(above, rel=1e-6)
