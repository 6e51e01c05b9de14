"""The search for gross errors in a block: weights, suspects and limits by hand, at both sides of each limit."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import Block, Chain, fly, with_control
from scipy import stats

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.problem import BlockProblem, Selection, State
from ortho_pipeline.block.equations.solver import attempt
from ortho_pipeline.block.reliability import blunders
from ortho_pipeline.block.reliability.blunders import (
    _geman_mcclure,
    _huber,
    _refuse_many,
    _robust,
    _significant,
    _suspects,
    _trusted,
    _worst,
    find_blunders,
)
from ortho_pipeline.block.reliability.standardised_residuals import StandardisedResiduals
from ortho_pipeline.block.reliability.suspects import GrossError
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.block.variances.grid import estimate, reweighed
from ortho_pipeline.errors import DegeneratePoints

#: Rays of five points, point by point.
POINT = np.array([0, 0, 0, 1, 1, 2, 2, 3, 3, 4, 4])
#: Ground of the points 1 and 3 is known; that of 3 states no sigma.
RANKS = np.array([0, 3, 0, 2, 0])
STATED = Variances(1.0, None, None, (9.0, 0.0, 0.0), (0, 0))
ESTIMATED = Variances(1.0, 0.3, 0.4, (9.0, 2.0, 1.0), (1, 1), freedom=4.0)


class Five(SimpleNamespace):
    """What the tests ask of a table of five points."""

    point = POINT

    def __len__(self) -> int:
        return 5


def problem_of() -> Any:
    unstated = np.zeros((5, 3), dtype=bool)
    unstated[3, 2] = True
    return SimpleNamespace(points=Five(), unstated=unstated)


def residuals_of(rays: dict[int, float], ground: dict[int, float], ranks: np.ndarray = RANKS) -> StandardisedResiduals:
    """Return tests in which most rays have the median of chi squared of two degrees, so that their scale is one."""
    squares, of_ground = np.full(len(POINT), 1.3863), np.zeros(5)
    for ray, size in rays.items():
        squares[ray] = size**2
    for point, size in ground.items():
        of_ground[point] = size**2
    return StandardisedResiduals(squares, np.full(len(POINT), 2), of_ground, ranks)


def test_weights_fall_as_those_of_huber_and_of_geman_and_mcclure() -> None:
    sizes = np.array([0.0, 0.5, 1.99, 2.0, 2.5, 3.0, 8.0, 30.0])
    np.testing.assert_allclose(_huber(sizes), [1.0, 1.0, 1.0, 1.0, 0.8, 2 / 3, 0.25, 1 / 15], rtol=1e-12)
    wanted = [1.0, (36 / 37) ** 2, 1 / (1 + 1.99**2 / 9) ** 2, (9 / 13) ** 2, (36 / 61) ** 2, 0.25, (9 / 73) ** 2,
              1 / 101**2]  # fmt: skip
    np.testing.assert_allclose(_geman_mcclure(sizes), wanted, rtol=1e-12)
    # What is infinitely far keeps a weight with which equations can be solved.
    assert _geman_mcclure(np.array([1e9])).tolist() == [1e-8]


@pytest.mark.parametrize(("size", "far"), [(3.99, False), (4.01, True)])
def test_a_point_is_a_suspect_if_a_ray_or_its_stated_ground_is_four_scales_off(size: float, far: bool) -> None:
    for rays, ground, point in (({3: size}, {}, 1), ({9: size}, {}, 4), ({}, {1: size}, 1)):
        found = _suspects(problem_of(), residuals_of(rays, ground), STATED, 2.0)
        assert np.flatnonzero(found).tolist() == ([point] if far else [])
    # Ground that was not tested says nothing.
    assert not _suspects(problem_of(), residuals_of({}, {2: 50.0}), STATED, 2.0).any()


@pytest.mark.parametrize("limit", [2.0, 4.0])
@pytest.mark.parametrize(("part", "far"), [(0.99, False), (1.01, True)])
def test_ground_of_an_estimated_sigma_has_a_limit_of_its_own(limit: float, part: float, far: bool) -> None:
    """Two such points, of which one gives the scale: the median of chi squared of one degree of freedom."""
    problem, ranks = problem_of(), np.array([1, 3, 1, 1, 0])
    problem.unstated[0, 0] = problem.unstated[2, 1] = True
    scale = math.sqrt(0.4549)
    made = residuals_of({}, {0: scale, 2: 0.5 * scale, 3: part * limit, 1: 3.99}, ranks)
    assert np.flatnonzero(_suspects(problem, made, ESTIMATED, limit)).tolist() == ([3] if far else [])
    if limit == 2.0:
        # The stated one of the point b is farther off, and not meant.
        assert np.flatnonzero(_worst(problem, made, ESTIMATED)).tolist() == ([3] if far else [])
        assert not _worst(problem, made, STATED).any()


@pytest.mark.parametrize("sigma0", [None, 0.5, 1.7])
@pytest.mark.parametrize(("part", "bad"), [(0.999, False), (1.001, True)])
def test_what_is_significant_has_a_chance_of_a_thousandth_over_all_tests(
    sigma0: float | None, part: float, bad: bool
) -> None:
    """Eleven rays and two known points are thirteen tests."""
    scale, freedom = 1.0 if sigma0 is None else sigma0, 7.0
    solved: Any = SimpleNamespace(problem=problem_of(), unit_weight=lambda: (sigma0, freedom))
    risk = 0.001 / 13

    def far(rank: int, degrees: float) -> float:
        return part * scale * math.sqrt(rank * stats.f.isf(risk, rank, degrees))

    for rays, ground, point, variances in (
        ({5: far(2, 7.0)}, {}, 2, STATED),
        ({}, {1: far(3, 7.0)}, 1, ESTIMATED),
        ({}, {3: far(2, 7.0)}, 3, STATED),
        ({}, {3: far(2, 4.0)}, 3, ESTIMATED),
    ):
        found = _significant(solved, residuals_of(rays, ground), variances)
        assert np.flatnonzero(found).tolist() == ([point] if bad else [])
    # A direction less is one degree of freedom less, and without one nothing is tested.
    made = residuals_of({5: far(1, 7.0)}, {})
    made.ray_rank[5] = 1
    assert _significant(solved, made, STATED).any() is np.bool_(bad)
    made.ray_rank[5] = 0
    assert not _significant(solved, made, STATED).any()


def test_without_redundancy_limits_are_those_of_one_degree_of_freedom() -> None:
    solved: Any = SimpleNamespace(problem=problem_of(), unit_weight=lambda: (None, 0.3))
    edge = math.sqrt(2 * stats.f.isf(0.001 / 13, 2, 1.0))
    for part, bad in ((0.99, False), (1.01, True)):
        assert _significant(solved, residuals_of({4: part * edge}, {}), STATED).tolist() == [
            False,
            bad,
            False,
            False,
            False,
        ]
    # Measurements without any error have a scale of a thousandth.
    exact: Any = SimpleNamespace(problem=problem_of(), unit_weight=lambda: (1e-9, 7.0))
    edge = 1e-3 * math.sqrt(3 * stats.f.isf(0.001, 3, 7.0))
    for part, bad in ((0.99, False), (1.01, True)):
        made = StandardisedResiduals(np.zeros(11), np.zeros(11, dtype=np.int64), np.zeros(5), np.array([0, 3, 0, 0, 0]))
        made.ground[1] = (part * edge) ** 2
        assert _significant(exact, made, STATED).any() is np.bool_(bad)


@pytest.mark.parametrize(("rejected", "refused"), [
    ([0, 1, 2], None), ([0, 1, 2, 3], "4 of 10 control points"), ([10, 11, 12, 20, 21, 22], None),
    ([10, 11, 12, 20, 21, 22, 23], "7 of 20 tie and check points"), ([0, 1, 2, 10, 11, 12, 20, 21, 22], None),
])  # fmt: skip
def test_thirty_per_cent_may_contradict_of_control_and_of_the_others(rejected: list[int], refused: str | None) -> None:
    """Ten control points, ten ties, ten check points, and two of each that take no part."""
    roles = np.array(["control"] * 10 + ["tie"] * 10 + ["check"] * 10 + ["control", "tie", "check"] * 2)
    points = SimpleNamespace(control=roles == "control", ids=tuple(f"p{k}" for k in range(36)), source="")
    problem: Any = SimpleNamespace(points=points, active=lambda selection: np.arange(36) < 30)
    if refused is None:
        # What takes no part is not counted, wherever it is named.
        _refuse_many(problem, None, [*rejected, 30, 31, 33, 34])  # type: ignore[arg-type]
        return
    with pytest.raises(DegeneratePoints, match=refused) as caught:
        _refuse_many(problem, None, rejected)  # type: ignore[arg-type]
    # Control of another height datum contradicts the positions of cameras.
    assert ("height datum" in str(caught.value.remedy)) is ("control" in refused)


# -- a block -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=15.0, overlap=0.7, ties=50, errors=2.0, pairwise=False), 5)


@pytest.fixture(scope="module")
def prepared(flown: Block) -> tuple[BlockProblem, State, Selection]:
    points = with_control(flown, "i1", count=7)
    return _prepared(tuple(flown.start.values()), points, {}, ())


def test_trusted_is_the_solution_of_the_others_wherever_it_starts(prepared: Any) -> None:
    problem, state, selection = prepared
    points, control = problem.points, np.flatnonzero(problem.points.control)
    suspects = np.zeros(len(points), dtype=bool)
    suspects[[control[0], control[3], *np.flatnonzero(points.tie)[:3]]] = True
    away = state.moved(np.linspace(3.0, 5.0, problem.size), np.zeros((len(points), 3)))
    others = Selection.of(selection.rays & ~suspects[points.point], selection.ground & ~suspects)
    solved = attempt(problem, state, others)
    wanted = reweighed(solved, others, estimate(solved))
    for starts in ((away, state), (state, away)):
        found = _trusted(problem, starts, selection, suspects)
        assert found is not None
        np.testing.assert_allclose(found.solved.state.params, wanted.state.params, atol=1e-5)
        np.testing.assert_array_equal(problem.active(others), problem.active(found.solved.linear.weights))
        assert found.solved.linear.ordering.points == len(points) - 5
    # Without any control there is nothing to judge by.
    assert _trusted(problem, (state,), selection, suspects | points.control) is None
    suspects[control[1:]] = True
    suspects[control[0]] = False
    alone = _trusted(problem, (state,), selection, suspects)
    assert alone is not None
    assert int((problem.active(alone.solved.linear.weights) & alone.solved.linear.weights.ground).sum()) == 1


def test_the_errors_of_a_block_are_found_and_the_others_kept(prepared: Any) -> None:
    """Three wrong rays, and ground that is wrong in plan, of ties and control that three images show."""
    problem, state, selection = prepared
    points, known = problem.points, problem.known.copy()
    shown = np.bincount(points.point) == 3
    control, tie = (np.flatnonzero(mask & shown) for mask in (points.control, points.tie))
    measured = points.measured.copy()
    wrong = [np.flatnonzero((points.point == p) & (points.image == image))[0]
             for p, image in ((tie[0], 0), (tie[4], 2), (control[1], 1))]  # fmt: skip
    measured[wrong] += [(1.5, 7.0), (-2.0, 9.0), (6.0, -8.0)]
    known[control[3], :2] += (4e-5, -6e-5)
    moved = replace(problem, points=replace(points, measured=measured), known=known)
    found = find_blunders(attempt(moved, state, selection), selection)
    assert found.undecided == ()
    names = sorted((one.point, one.what, one.image) for one in found.rejected)
    wanted = [(points.ids[points.point[ray]], "ray", points.images[points.image[ray]]) for ray in wrong]
    assert names == sorted([*wanted, (points.ids[control[3]], "ground", None)], key=lambda one: one[0])
    # They are named in the order of the points.
    assert [one.point for one in found.rejected] == sorted((one[0] for one in names), key=points.ids.index)
    assert np.flatnonzero(selection.rays & ~found.kept.rays).tolist() == sorted(wrong)
    assert np.flatnonzero(selection.ground & ~found.kept.ground).tolist() == [control[3]]
    exact = attempt(moved, state, found.kept)
    np.testing.assert_allclose(found.state.params, exact.state.params, atol=5e-3)
    clean = find_blunders(attempt(problem, state, selection), selection)
    assert clean.rejected == ()
    assert clean.kept is selection


@pytest.mark.parametrize("wrong", [(2,), (2, 5)])
def test_wrong_ground_is_found_where_its_own_error_enlarges_the_sigma(flown: Block, wrong: tuple[int, ...]) -> None:
    """Ground that states no sigma: eight points of 0.1 m, of which some are 2 m off, in plan and in height."""
    points = with_control(flown, "i1", count=8, seed=4)
    points = replace(points, sigma_ground=np.zeros_like(points.sigma_ground))
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    problem = replace(problem, assumed=(0.5, 0.5))
    known, control = problem.known.copy(), np.flatnonzero(points.control)
    known[control[list(wrong)]] += np.array([(2e-5, -1e-5, 0.0), (0.0, 1e-5, 2.5)])[: len(wrong)]
    moved = replace(problem, known=known)
    found = find_blunders(attempt(moved, state, selection), selection)
    assert [(one.point, one.what) for one in found.rejected] == [(points.ids[control[k]], "ground") for k in wrong]
    assert np.flatnonzero(selection.ground & ~found.kept.ground).tolist() == control[list(wrong)].tolist()
    assert found.kept.rays.all()


# -- rounds ------------------------------------------------------------------------------------------------------------


def test_robust_rounds_end_when_weights_change_no_more(prepared: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rounds, once = [], blunders.once

    def shrinking(size: np.ndarray) -> np.ndarray:
        return np.full_like(size, (1.0, 0.9, 0.6, 0.601)[len(rounds)])

    monkeypatch.setattr(blunders, "_huber", shrinking)
    monkeypatch.setattr(blunders, "_geman_mcclure", np.ones_like)
    monkeypatch.setattr(blunders, "once", lambda linear: rounds.append(1) or once(linear))
    problem, state, selection = prepared
    solved = attempt(problem, state, selection)
    _robust(solved, selection, blunders.standardise(solved), STATED)
    # Four rounds of the first function, whose last factors are within two per cent, and two of the second.
    assert len(rounds) == 6


def mask(*points: int) -> np.ndarray:
    return np.isin(np.arange(50), points)


def test_what_nothing_can_be_decided_about_is_told(prepared: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the block is not determined without its suspects; it is refused if all of its control is suspect."""
    problem, state, selection = prepared
    control, tie = (np.flatnonzero(kind) for kind in (problem.points.control, problem.points.tie))
    monkeypatch.setattr(blunders, "_trusted", lambda *given: None)
    for suspects in ([tie[3]], [tie[3], *control[1:]]):
        monkeypatch.setattr(blunders, "_significant", lambda *given, s=suspects: mask(*s))
        found = find_blunders(attempt(problem, state, selection), selection)
        assert set(found.undecided) == {problem.points.ids[k] for k in suspects}
        assert found.rejected == ()
        assert found.kept is selection
    monkeypatch.setattr(blunders, "_significant", lambda *given: mask(tie[3], *control))
    with pytest.raises(DegeneratePoints, match="7 of 7 control points"):
        find_blunders(attempt(problem, state, selection), selection)


@pytest.mark.parametrize(
    ("variances", "rejected", "later", "judged"),
    [
        (STATED, [(1,), (1, 5)], [(5,), ()], [(1, 2), (1, 2, 5)]),
        (STATED, [()], [()], [(1, 2)]),
        (STATED, [(1,), (1,), (1,)], [(5,), (6,), (5,)], [(1, 2), (1, 2, 5), (1, 2, 5, 6)]),
        # Suspects of an estimated sigma return into it, but for those that were wrong.
        (ESTIMATED, [(1,), (1,)], [(), ()], [(1, 2), (1,)]),
        (ESTIMATED, [(1,), (1, 5)], [(5,), ()], [(1, 2), (1, 5)]),
        # Where none was wrong, the worst is asked, once.
        (ESTIMATED, [(), (9,)], [(), ()], [(1, 2), (9,)]),
        (ESTIMATED, [(), ()], [(), ()], [(1, 2), (9,)]),
    ],
)
def test_suspects_are_judged_until_nothing_changes(
    prepared: Any, monkeypatch: pytest.MonkeyPatch, variances: Variances, rejected: Any, later: Any, judged: Any
) -> None:
    problem, state, selection = prepared
    solved, asked = attempt(problem, state, selection), list[Any]()
    told, more, names = iter(rejected), iter(later), problem.points.ids

    def judge(trusted: Any, selection: Selection, suspects: np.ndarray) -> Any:
        asked.append(tuple(np.flatnonzero(suspects).tolist()))
        wrong = reversed(next(told))
        return selection, {k: GrossError(point=names[k], what="point", image=None, reason="") for k in wrong}

    trusted = SimpleNamespace(solved=solved, variances=variances)
    for name, value in {
        "estimate": lambda solved: variances, "standardise": lambda solved: None, "judge": judge,
        "_robust": lambda *given: (problem, state, None), "_suspects": lambda *given: mask(1, 2),
        "_worst": lambda *given: mask(9), "_significant": lambda *given: mask(1),
        "_trusted": lambda *given: trusted, "_kept": lambda *given: (state, selection, mask(*next(more))),
    }.items():  # fmt: skip
        monkeypatch.setattr(blunders, name, value)
    found = find_blunders(solved, selection)
    assert asked == judged
    assert [one.point for one in found.rejected] == [names[k] for k in rejected[len(judged) - 1]]
    assert found.undecided == ()
