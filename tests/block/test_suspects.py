"""Suspects of gross errors: contradictions of their parts by dense generalised least squares, and all verdicts."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import Chain, fly, with_control
from scipy import stats

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import Selection
from ortho_pipeline.block.equations.solver import attempt
from ortho_pipeline.block.equations.unknowns import Chunk
from ortho_pipeline.block.intersection import PARALLEL
from ortho_pipeline.block.reliability.suspects import _GROUND, Trusted, _Limits, _Suspects, judge
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.estimation.observations.on_points import OnPoints

IMAGES, WIDE = 4, 3
#: Sigmas (m) of the ground of the points; of the last one no height is known.
SIGMAS = np.array([[0.4, 0.7, 1.5], [2.0, 0.3, 0.9], [1.1, 0.6, np.inf]])


@dataclass(frozen=True)
class Drawn:
    """Equations of three points with random numbers, and the covariance ``(P, P)`` of the parameters of all images."""

    linear: Any
    chunk: Chunk
    covariance: np.ndarray

    @property
    def suspects(self) -> _Suspects:
        return _Suspects(self.chunk, self.linear, self)  # type: ignore[arg-type]

    def between(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the parts of the covariance of pairs of images."""
        whole = self.covariance.reshape(IMAGES, WIDE, IMAGES, WIDE)
        return np.stack([whole[a, :, b] for a, b in zip(first, second, strict=True)])

    def rows(self, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return partials, misfits and their covariance of a point: its rays, then its ground."""
        rays, linear = self.chunk.rays[k], self.linear
        by_params = np.zeros((2 * len(rays), IMAGES, WIDE))
        for a, (ray, image) in enumerate(zip(rays, self.chunk.images[k], strict=True)):
            by_params[2 * a : 2 * a + 2, image] = linear.by_params[ray]
        design, misfit = linear.by_point[rays].reshape(-1, 3), linear.misfits.rays[rays].ravel()
        wide = by_params.reshape(len(design), -1)
        if self.chunk.ground:
            point = self.chunk.points[k]
            design = np.vstack([design, linear.ground_by_point[point]])
            misfit = np.concatenate([misfit, linear.misfits.ground[point]])
            wide = np.vstack([wide, np.zeros((3, wide.shape[1]))])
        return design, misfit, np.eye(len(design)) + wide @ self.covariance @ wide.T


def drawn(rays: int, ground: bool, seed: int = 0, sigmas: np.ndarray = SIGMAS) -> Drawn:
    random = np.random.default_rng(seed)
    count = 3 * rays
    axes = np.linalg.qr(random.normal(size=(3, 3, 3)))[0]
    observed = OnPoints(random.normal(0, 2, (3, 3)) * np.isfinite(sigmas), axes, sigmas)
    images = tuple("wxyz")[:IMAGES]
    of = np.argsort(random.random((3, IMAGES)), axis=1)[:, :rays]
    order = random.permutation(count).reshape(3, rays)
    image = np.zeros(count, dtype=np.int64)
    image[order] = of
    points = SimpleNamespace(
        ids=("a", "b", "c"), images=images, image=image, sigma=random.uniform(0.2, 3.0, count),
    )  # fmt: skip
    points.in_pixels = lambda values, of: values * points.sigma[of].reshape(-1, *[1] * (values.ndim - 1))
    problem = SimpleNamespace(points=points, on_points=lambda local, rows: OnPoints(
        observed.apart[rows], axes[rows], sigmas[rows]))  # fmt: skip
    linear = SimpleNamespace(
        problem=problem, state=SimpleNamespace(local=np.zeros((3, 3))),
        by_point=random.normal(0, 1, (count, 2, 3)), by_params=random.normal(0, 1, (count, 2, WIDE)),
        ground_by_point=observed.partials(np.ones(3)),
        misfits=SimpleNamespace(rays=random.normal(0, 3, (count, 2)), ground=observed.misfits(np.ones(3))),
    )  # fmt: skip
    root = random.normal(0, 0.7, (IMAGES * WIDE, IMAGES * WIDE))
    return Drawn(linear, Chunk(np.array([2, 0, 1]), order, of, ground), root @ root.T)


def kept_rows(made: Drawn, k: int, without: int | None) -> np.ndarray:
    """Return the rows of a point but those of one part."""
    rays = made.chunk.rays.shape[1]
    gone = [] if without is None else (2 * rays + np.arange(3) if without == _GROUND else 2 * without + np.arange(2))
    return np.setdiff1d(np.arange(2 * rays + 3 * made.chunk.ground), gone)


@pytest.mark.parametrize("unknown", [0.8, np.inf])
@pytest.mark.parametrize(("rays", "ground"), [(1, True), (2, False), (2, True), (3, False), (4, True)])
def test_contradictions_are_the_squares_that_generalised_least_squares_leave(
    rays: int, ground: bool, unknown: float
) -> None:
    """Rows of an unknown coordinate count as none."""
    made = drawn(rays, ground, sigmas=np.where(np.isfinite(SIGMAS), SIGMAS, unknown))
    suspects = made.suspects
    assert list(suspects.parts) == [*range(rays), *([_GROUND] if ground else [])]
    for without in (None, *suspects.parts):
        squares, freedom = suspects.contradictions(without)
        for k in range(3):
            design, misfit, spread = made.rows(k)
            keep = kept_rows(made, k, without)
            keep = keep[design[keep].any(axis=1)]
            if len(keep) <= 3:
                assert squares[k] == math.inf
                assert freedom[k] == 0
                continue
            assert freedom[k] == len(keep) - 3
            weights = np.linalg.inv(spread[np.ix_(keep, keep)])
            a, r = design[keep], misfit[keep]
            place = np.linalg.solve(a.T @ weights @ a, a.T @ weights @ r)
            left = r - a @ place
            assert squares[k] == pytest.approx(left @ weights @ left, rel=1e-8)


@pytest.mark.parametrize("rays", [2, 3])
def test_ground_is_compared_in_metres_with_where_its_rays_put_it(rays: int) -> None:
    made = drawn(rays, True, 1)
    for k, point in enumerate((2, 0, 1)):
        found = made.suspects.ground_apart(k)
        assert found is not None
        apart, covariance, axes = found
        design, misfit, spread = made.rows(k)
        weights = np.linalg.inv(spread[: 2 * rays, : 2 * rays])
        inverse = np.linalg.inv(design[: 2 * rays].T @ weights @ design[: 2 * rays])
        place = inverse @ design[: 2 * rays].T @ weights @ misfit[: 2 * rays]
        assert axes == ((0, 1) if point == 2 else (0, 1, 2))
        observed = made.linear.problem.on_points(None, np.array([point]))
        turn = observed.axes[0][list(axes)]
        np.testing.assert_allclose(apart, observed.apart[0][list(axes)] - turn @ place, rtol=1e-8)
        np.testing.assert_allclose(covariance, turn @ inverse @ turn.T, rtol=1e-8)


@pytest.mark.parametrize(("part", "placed"), [(0.99, True), (1.01, False)])
def test_rays_that_are_parallel_put_ground_nowhere(part: float, placed: bool) -> None:
    made = drawn(2, True)
    made.linear.by_params[:] = 0.0
    # Three thousand times less certain along one direction than along another.
    made.linear.by_point[made.chunk.rays[0]] = [[(1, 0, 0), (0, 2, 0)], [(0, 0, 2 / (part * PARALLEL)), (0, 0, 0)]]
    assert (made.suspects.ground_apart(0) is not None) is placed


@pytest.mark.parametrize("rays", [2, 3])
def test_sizes_are_pixels_of_rays_and_metres_of_ground(rays: int) -> None:
    """From the place that least squares of all other parts give; of all together the largest coordinate."""
    made = drawn(rays, True, 2)
    of, sigma = np.array([0, 2]), made.linear.problem.points.sigma
    for without in (None, *range(rays), _GROUND):
        found = made.suspects.sizes(of, without)
        for k, size in zip(of, found, strict=True):
            keep = kept_rows(made, k, without)
            design, misfit, _ = made.rows(k)
            left = misfit - design @ np.linalg.lstsq(design[keep], misfit[keep], rcond=None)[0]
            pixels = left[: 2 * rays].reshape(rays, 2) * sigma[made.chunk.rays[k]][:, None]
            known = np.nan_to_num(SIGMAS[made.chunk.points[k]], posinf=0.0)
            wanted = np.linalg.norm(left[2 * rays :] * known) if without == _GROUND else np.abs(pixels).max()
            if without not in (None, _GROUND):
                wanted = np.linalg.norm(pixels[without])
            assert size == pytest.approx(wanted, rel=1e-8)


def test_what_is_said_of_a_rejected_part() -> None:
    made, alone = drawn(2, True).suspects, drawn(2, False).suspects
    image = made.problem.points.images[made.chunk.images[1, 1]]
    ray, ground, whole = (made.rejected(1, part, 12.34) for part in (1, _GROUND, None))
    assert (ray.point, ray.what, ray.image) == ("a", "ray", image)
    assert (ground.what, ground.image, whole.what, whole.image) == ("ground", None, "point", None)
    assert "12.3 px from where the other rays" in ray.reason
    assert "12.3 m from where its rays meet" in ground.reason
    assert "its ground and its measurements contradict each other by 12.3 px" in whole.reason
    assert "its rays miss each other by 12.3 px" in alone.rejected(1, None, 12.34).reason


# -- verdicts ----------------------------------------------------------------------------------------------------------

#: The sigmas of ground that are possible, of which one is that of a single point.
FOUND = Variances(
    1.0, 0.5, 2.0, (30.0, 3.0, 2.0), (3, 3), freedom=5.0,
    nodes=np.array([[1.0, 0.25, 4.0], [1.3, 0.5, 9.0]]), chances=np.array([0.7, 0.3]),
)  # fmt: skip
LIMITS = _Limits(freedom=20.0, risk=1e-5, ground_risk=0.004, variances=FOUND)


def edge(size: int, risk: float, freedom: float) -> float:
    return float(size * stats.f.isf(risk, size, freedom))


def suspect(squares: dict[int | None, tuple[float, int]], placed: Any = None) -> Any:
    """Return one suspect point with known ground, whose parts contradict by these squares and freedoms."""
    parts = {part: None for part in squares if part is not None}
    return SimpleNamespace(
        parts=parts, contradictions=lambda part: tuple(np.array([value]) for value in squares[part]),
        ground_apart=lambda k: placed,
    )  # fmt: skip


def agrees(made: Any, estimated: bool) -> tuple[bool, dict[int, bool]]:
    whole, without = LIMITS.verdicts(made, np.array([estimated]))
    return bool(whole[0]), {part: bool(mask[0]) for part, mask in without.items()}


@pytest.mark.parametrize("part", [0.999, 1.001])
def test_estimated_ground_is_judged_with_the_sigmas_that_are_possible(part: float) -> None:
    """It agrees if its distance is likely and its rays agree; rays without it have the limits of measurements."""
    spread, direction, good = np.diag([0.3, 0.6]), np.array([0.6, -0.8]), part < 1
    low, high = 0.0, 100.0
    for _ in range(80):
        middle = (low + high) / 2
        low, high = (middle, high) if FOUND.chance_of(middle * direction, spread, (0, 1)) > 0.004 else (low, middle)
    placed = (part * low * direction, spread, (0, 1))
    rays, ground = edge(1, 1e-5, 20.0), edge(3, 0.004, 5.0)
    squares = {None: (1e9, 4), 0: (0.999 * ground, 3), 1: (1.001 * ground, 3), _GROUND: (0.999 * rays, 1)}
    assert agrees(suspect(squares, placed), True) == (good, {0: True, 1: False, _GROUND: True})
    # Where rays miss each other, the point does not agree, however near its ground is.
    squares[_GROUND] = (1.001 * rays, 1)
    assert agrees(suspect(squares, (0.1 * direction, spread, (0, 1))), True) == (
        False, {0: True, 1: False, _GROUND: False},
    )  # fmt: skip


@pytest.mark.parametrize("estimated", [False, True])
@pytest.mark.parametrize("part", [0.999, 1.001])
def test_ground_whose_rays_have_no_place_is_judged_by_all_of_its_rows(part: float, estimated: bool) -> None:
    """One ray, and two that are parallel; with a stated sigma the limits are those of measurements."""
    risk, freedom = (0.004, 5.0) if estimated else (1e-5, 20.0)
    for size, of_rays in ((2, (math.inf, 0)), (4, (0.1, 1))):
        squares = {None: (part * edge(size, risk, freedom), size), 0: (math.inf, 0), _GROUND: of_rays}
        assert agrees(suspect(squares), estimated) == (part < 1, {0: False, _GROUND: of_rays[1] > 0})


def test_stated_and_estimated_ground_side_by_side_have_limits_of_their_own() -> None:
    """Between the limits of both, only the stated one agrees."""
    for square, wanted in ((edge(2, 0.004, 5.0), [True, True]), (edge(2, 1e-5, 20.0), [False, True])):
        parts = SimpleNamespace(
            parts={0: None, _GROUND: None}, ground_apart=lambda k: None,
            contradictions=lambda part, s=square: (
                (np.full(2, 0.99 * s), np.full(2, 2)) if part is None else (np.ones(2), np.zeros(2))
            ),
        )  # fmt: skip
        whole, _ = LIMITS.verdicts(parts, np.array([True, False]))  # type: ignore[arg-type]
        assert whole.tolist() == wanted


def test_the_risk_is_shared_by_all_points_and_that_of_ground_by_the_control_points() -> None:
    active = np.array([True] * 6 + [False] * 2)
    for ground, shared in ((np.arange(8) % 3 == 0, 2), (np.zeros(8, dtype=bool), 1), (np.arange(8) == 7, 1)):
        for freedom, least in ((0.2, 1.0), (9.0, 9.0)):
            solved: Any = SimpleNamespace(
                unit_weight=lambda f=freedom: (1.0, f), problem=SimpleNamespace(active=lambda selection: active)
            )
            selection: Any = SimpleNamespace(ground=ground)
            found = _Limits.of(Trusted(solved, FOUND), selection)
            assert (found.freedom, found.risk, found.ground_risk) == pytest.approx((least, 0.001 / 6, 0.01 / shared))


def test_several_suspects_are_judged_at_once_each_by_its_own_parts() -> None:
    """Of points with three rays in a block: one ray, the ground, two rays of a point, and nothing."""
    flown = fly(Chain(images=3, convergence_deg=15.0, overlap=0.75, ties=40, errors=2.0, pairwise=False), 6)
    points = with_control(flown, "i1", count=8, sigma=0.05)
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    shown, known, measured = np.bincount(points.point) == 3, problem.known.copy(), points.measured.copy()
    control, tie = (np.flatnonzero(mask & shown) for mask in (points.control, points.tie))

    def ray(point: int, image: int) -> int:
        return int(np.flatnonzero((points.point == point) & (points.image == image))[0])

    off = {ray(control[0], 2): (5.0, -7.0), ray(tie[0], 0): (-4.0, 9.0), ray(tie[1], 0): (3.0, 9.0),
           ray(tie[1], 1): (2.0, -12.0)}  # fmt: skip
    for number, by in off.items():
        measured[number] += by
    known[control[1], :2] += (5e-5, -3e-5)
    moved = replace(problem, points=replace(points, measured=measured), known=known)
    suspects = np.zeros(len(points), dtype=bool)
    suspects[[*control[:3], *tie[:3]]] = True
    of_others = ~suspects[points.point]
    others = Selection.of(selection.rays & of_others, selection.ground & ~suspects)
    trusted = Trusted(attempt(moved, state, others), Variances(1.0, None, None, (50.0, 0.0, 0.0), (0, 0)))
    kept, rejected = judge(trusted, selection, suspects)
    assert {number: (one.what, one.image) for number, one in rejected.items()} == {
        control[0]: ("ray", "i2"), tie[0]: ("ray", "i0"), tie[1]: ("point", None), control[1]: ("ground", None),
    }  # fmt: skip
    gone = {ray(control[0], 2), ray(tie[0], 0), *(ray(tie[1], image) for image in range(3))}
    assert set(np.flatnonzero(selection.rays & ~kept.rays).tolist()) == gone
    assert np.flatnonzero(selection.ground & ~kept.ground).tolist() == [control[1]]
    alone = Selection.of(selection.rays & ~of_others, selection.ground & suspects)
    linear = Linear.at(moved, trusted.solved.state, alone)
    mine = np.array([ray(tie[0], 1), ray(tie[0], 2)])
    place = np.linalg.lstsq(linear.by_point[mine].reshape(4, 3), linear.misfits.rays[mine].ravel(), rcond=None)[0]
    left = linear.misfits.rays[ray(tie[0], 0)] - linear.by_point[ray(tie[0], 0)] @ place
    assert rejected[tie[0]].reason.startswith(f"gross error, {0.1 * np.linalg.norm(left):.1f} px")
