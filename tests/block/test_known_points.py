"""Known points that a block contradicts: from which distance on, and the notices of few and of many."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.reliability import known_points
from ortho_pipeline.block.reliability.datums import doubtful_datums
from ortho_pipeline.block.reliability.known_points import ContradictedPoint, notices, outlying
from ortho_pipeline.block.variances.components import Variances

#: Two possible pairs of sigmas of ground that states none, of which three of four are 0.6 m and 1.5 m.
FOUND = Variances(
    1.0, 0.7, 1.7, (12.0, 3.0, 2.0), (3, 3), freedom=6.0,
    nodes=np.array([[1.0, 0.36, 2.25], [1.2, 1.0, 4.0]]), chances=np.array([0.75, 0.25]),
)  # fmt: skip


def solved_of(roles: list[str], sigmas: np.ndarray, unstated: np.ndarray | None = None) -> Any:
    of, count = np.array(roles), len(roles)
    points = SimpleNamespace(
        ids=tuple(f"p{k}" for k in range(count)), roles=of, check=of == "check", control=of == "control",
        sigma_ground=sigmas,
    )  # fmt: skip
    unstated = np.zeros((count, 3), dtype=bool) if unstated is None else unstated
    return SimpleNamespace(problem=SimpleNamespace(points=points, unstated=unstated))


@pytest.fixture
def without_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        known_points, "standardise_ground", lambda solved: (np.zeros(n := len(solved.problem.points.ids)), np.zeros(n))
    )


def limit_of(chance: Any, risk: float) -> float:
    """Return where a falling chance comes to the risk."""
    low, high = 0.0, 100.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if chance(middle) > risk else (low, middle)
    return low


@pytest.mark.usefixtures("without_control")
@pytest.mark.parametrize("unstated", [True, False])
@pytest.mark.parametrize(("part", "beyond"), [(0.99, False), (1.01, True)])
@pytest.mark.parametrize("what", ["plan", "height"])
def test_a_check_point_without_a_sigma_has_those_that_are_possible(
    what: str, part: float, beyond: bool, unstated: bool
) -> None:
    """One that states its sigma is tested with that, and Fisher's distribution."""
    sigmas = np.full((2, 3), 0.0 if unstated else 0.8)
    spread = np.array([[0.5, 0.2, 0.1], [0.2, 0.9, -0.3], [0.1, -0.3, 1.4]])
    direction, axes = (np.array([0.6, -0.8]), [0, 1]) if what == "plan" else (np.array([-1.0]), [2])

    def chance(far: float) -> float:
        apart, own = far * direction, spread[np.ix_(axes, axes)]
        if not unstated:
            square = apart @ np.linalg.solve(own + 0.64 * np.eye(len(axes)), apart)
            return float(stats.f.sf(square / len(axes), len(axes), 12.0))
        found = 0.0
        for node, weight in zip(FOUND.nodes, FOUND.chances, strict=True):
            whole = node[0] * own + np.diag(node[[1, 1, 2]][axes])
            found += weight * stats.chi2.sf(apart @ np.linalg.solve(whole, apart), len(axes))
        return found

    # The other point is known in plan alone: three tests.
    far = part * limit_of(chance, 0.01 / 3)
    residuals = np.array([[0.0, 0.0, 0.0], [0.1, 0.1, math.nan]])
    residuals[0, axes] = far * direction
    solved = solved_of(["check"] * 2, sigmas)
    found = outlying(solved, FOUND, residuals, np.tile(spread, (2, 1, 1)), np.zeros(2, dtype=bool))
    assert [(one.point, one.what) for one in found] == ([("p0", what)] if beyond else [])
    for one in found:
        assert one.metres == pytest.approx(far)
        own = (0.64 if not unstated else (0.49 if what == "plan" else 2.89)) * np.eye(len(axes))
        apart = far * direction
        square = apart @ np.linalg.solve(spread[np.ix_(axes, axes)] + own, apart) / len(axes)
        assert one.sigmas == pytest.approx(math.sqrt(square))


@pytest.mark.usefixtures("without_control")
@pytest.mark.parametrize(("redundancy", "freedom"), [(0.2, 1.0), (1.0, 1.0), (1.5, 1.5)])
def test_without_redundancy_a_limit_is_that_of_one_degree_of_freedom(redundancy: float, freedom: float) -> None:
    edge = math.sqrt(stats.f.isf(0.01 / 2, 1, freedom))
    variances = Variances(1.0, None, None, (redundancy, 0.0, 0.0), (0, 0))
    for part, beyond in ((0.99, False), (1.01, True)):
        residuals = np.array([[0.0, 0.0, part * edge * 0.5]])
        found = outlying(
            solved_of(["check"], np.full((1, 3), 0.4)), variances, residuals, np.diag([1.0, 1.0, 0.09])[None],
            np.zeros(1, dtype=bool),
        )  # fmt: skip
        assert bool(found) is beyond


def test_ground_that_partly_states_no_sigma_is_compared_with_what_is_known_of_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unstated = np.zeros((2, 3), dtype=bool)
    unstated[0, 2] = True
    solved = solved_of(["control"] * 2, np.full((2, 3), 0.4), unstated)
    for part, named in ((0.99, []), (1.01, ["p0", "p1"])):
        squares = part * np.array([3 * stats.f.isf(0.005, 3, 6.0), 3 * stats.f.isf(0.005, 3, 12.0)])
        monkeypatch.setattr(known_points, "standardise_ground", lambda solved, s=squares: (s, np.array([3, 3])))
        residuals = np.array([[1.0, 2.0, 2.0], [2.0, 3.0, 6.0]])
        found = outlying(solved, FOUND, residuals, np.zeros((2, 3, 3)), np.ones(2, dtype=bool))
        assert [one.point for one in found] == named
    assert [one.metres for one in found] == pytest.approx([3.0, 7.0])


# -- notices -----------------------------------------------------------------------------------------------------------


def doubt(number: int, sigmas: float, role: str = "check", what: str = "plan") -> ContradictedPoint:
    return ContradictedPoint.model_validate(
        {"point": f"p{number}", "role": role, "what": what, "metres": 2.0 * sigmas, "sigmas": sigmas}
    )


def test_of_many_contradicting_check_points_the_worst_are_named() -> None:
    """Twelve of twenty: ten are in one notice, the worst three with their numbers, and two have their own."""
    count = 22
    points = SimpleNamespace(
        ids=tuple(f"p{k}" for k in range(count)), check=np.arange(count) < 21, control=np.arange(count) == 21
    )
    residuals = np.random.default_rng(1).normal(0, 1.0, (count, 3))
    residuals[20] = np.nan
    residuals[12, 2] = np.nan
    sizes = [5.0, 9.0, 4.0, 8.0, 3.0, 7.0, 6.0, 9.5, 8.5, 7.5, 6.5, 5.5]
    doubts = [doubt(k, size) for k, size in enumerate(sizes)]
    doubts += [doubt(7, 4.5, what="height"), doubt(21, 6.0, "control", "ground")]
    first, *others = notices(doubts, points, residuals)  # type: ignore[arg-type]
    order = sorted(range(12), key=lambda k: -sizes[k])
    assert first.fields["points"] == [f"p{k}" for k in order[:10]]
    assert (first.fields["count"], first.fields["off"], first.fields["alike"]) == (20, 12, False)
    plan, height = np.hypot(residuals[:20, 0], residuals[:20, 1]), np.abs(residuals[:20, 2])
    wanted = {"plan": math.sqrt((plan**2).mean()), "height": math.sqrt(np.nanmean(height**2))}
    assert first.fields["rmse_m"] == pytest.approx(wanted)
    rest = {"plan": math.sqrt((plan[12:] ** 2).mean()), "height": math.sqrt(np.nanmean(height[12:] ** 2))}
    assert first.fields["rest_m"] == pytest.approx(rest)
    text = str(first)
    for k in order[:3]:
        assert f"p{k}: its given position in plan differs by {2 * sizes[k]:.2f} m ({sizes[k]:.1f} sigma)" in text
    assert "p7: its given height differs by 9.00 m (4.5 sigma)" in text
    assert f"p{order[3]}: " not in text
    assert f"RMSE {wanted['plan']:.2f} m in plan and {wanted['height']:.2f} m in height over all 20" in text
    assert f"{rest['plan']:.2f} m in plan and {rest['height']:.2f} m in height without them" in text
    assert sorted(one.fields["point"] for one in others) == sorted(["p21", *(f"p{k}" for k in order[10:])])
    control = next(one for one in others if one.fields["point"] == "p21")
    assert "the adjustment still uses it" in str(control)
    assert "the accuracy still counts it" in str(next(one for one in others if one is not control))


def test_control_that_is_exact_is_contradicted_by_its_measurements() -> None:
    """Matched control has a sigma of a millimetre: the text said that its position differs by 0.00 m."""
    exact = ContradictedPoint(point="m3", role="control", what="ground", metres=0.0004, sigmas=4.6)
    assert exact.notice().startswith(
        "control point m3: its image measurements contradict its given position (4.6 sigma); the adjustment still uses"
    )


# -- errors of a datum -------------------------------------------------------------------------------------------------


def signs(
    residuals: list[float], moved: list[float], focal: float = 100.0, stated: float = 0.1, used: int = 9
) -> list[str]:
    """Return the signs of a datum for heights of control (m) and of cameras (m) that state 1 m, and a focal length."""
    count = len(residuals)
    names = [(f"p{k}", name) for k in range(len(moved)) for name in ("X_L", "Z_L")]
    pseudo = [Pseudo(2 * k + 1, -height, 1.0) for k, height in enumerate(moved)]
    camera = SimpleNamespace(name="focal_length", value=focal, prior=SimpleNamespace(value=100.0, sigma=2.0))
    fit = SimpleNamespace(
        models={f"p{k}": SimpleNamespace(params=np.zeros(2)) for k in range(len(moved))},
        points=SimpleNamespace(sigma_ground=np.full((count, 3), stated)),
        ground_sigmas=np.ones((count, 3)),
        object_residuals=np.column_stack([np.zeros((count, 2)), residuals]),
        used_ground=np.arange(count) < used,
        parameters=names,
        shared_priors=SimpleNamespace(records=[camera]),
    )
    found = doubtful_datums(fit, [*pseudo, Pseudo(0, 50.0, 1e-3, held=True)])  # type: ignore[arg-type]
    assert {one.code for one in found} <= {"datum-doubtful"}
    # A base station of the cameras can be wrong, too, and a few centimetres are no datum.
    assert all("can have a common error, such as that of another height datum" in str(one) for one in found)
    return [str(one).partition(":")[0] for one in found]


def test_control_of_another_datum_is_told() -> None:
    """Its heights differ alike: by more than three times their scatter, and than the accuracy of both."""
    told = ["3 control points differ alike from the block, by +29.90 m in height (scatter 0.10 m)"]
    assert signs([29.8, 29.9, 30.0, math.nan], [0.5, -1.0, 1.5], used=3) == told
    assert signs([29.8, 29.9, 30.0], [0.0], stated=10.0) == []
    assert signs([2.9, 2.9, 2.9], [0.0], stated=0.0) == []
    assert signs([29.8, 10.0, 2.0], [0.0]) == []
    assert signs([29.8, 29.9, 30.0], [0.0], used=2) == []


def test_cameras_that_move_alike_are_told() -> None:
    told = ["the adjustment moves the cameras alike, by -20.00 m in height (scatter 1.00 m)"]
    assert signs([0.0], [-19.0, -20.0, -21.0]) == told
    assert signs([0.0], [-2.9, -2.9, -2.9]) == []
    assert signs([0.0], [-19.0, -1.0, -2.0]) == []
    assert signs([0.0], [-19.0, -20.0]) == []


def test_a_focal_length_that_stands_for_a_height_is_told() -> None:
    told = ["the adjustment changes the focal length by -29.0%, although its accuracy is 2.0%"]
    assert signs([0.0], [0.0], 71.0) == told
    assert signs([0.0], [0.0], 105.9) == []
