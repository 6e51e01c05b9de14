"""Compiled elimination of points, against dense matrices of drawn rows: no zeros, no symmetry, all shapes of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from ortho_pipeline.block.equations import point_kernel
from ortho_pipeline.block.equations.point_kernel import Rows
from ortho_pipeline.geodesy.ellipsoid import geocentric, metres_per_degree

#: Images of the points, in the order of their elimination, and whether their ground is known.
SHOWN = [
    ((0, 3), False), ((0, 3), False), ((0, 3), True), ((0, 1, 3), False), ((0, 1, 3), True), ((0, 1, 2, 3, 4), False),
    ((1, 2), False), ((1, 4), False), ((2,), True), ((2,), True), ((2, 3, 4), True), ((2, 3, 4), False), ((4,), True),
]  # fmt: skip
IMAGES, WIDE, POINTS = 5, 3, 16


@dataclass(frozen=True)
class Drawn:
    """Rows of thirteen of sixteen points, and the dense design by parameters and by points with its misfits."""

    rows: Rows
    by_params: np.ndarray
    by_points: np.ndarray
    misfits: np.ndarray
    pairs: np.ndarray

    def block(self, matrix: np.ndarray) -> np.ndarray:
        """Return the parts ``(S, p, p)`` of a matrix of all parameters."""
        parts = matrix.reshape(IMAGES, WIDE, IMAGES, WIDE)
        return np.ascontiguousarray([parts[a, :, b] for a, b in self.pairs])


@pytest.fixture(scope="module")
def drawn() -> Drawn:
    random = np.random.default_rng(7)
    count = sum(len(images) for images, _ in SHOWN)
    order = random.permutation(count + 2)[:count]
    image = random.integers(0, IMAGES, count + 2)
    starts = np.cumsum([0, *(len(images) for images, _ in SHOWN)])
    image[order] = np.concatenate([images for images, _ in SHOWN])
    numbers = random.permutation(POINTS)[: len(SHOWN)]
    first, second = np.triu_indices(IMAGES)
    slot = np.full((IMAGES, IMAGES), -1)
    slot[first, second] = slot[second, first] = np.arange(len(first))
    rows = Rows(
        order, starts, numbers, np.array([known for _, known in SHOWN]), image, slot,
        random.normal(size=(count + 2, 2, WIDE)), random.normal(size=(count + 2, 2, 3)),
        random.normal(size=(POINTS, 3, 3)), random.normal(size=(count + 2, 2)), random.normal(size=(POINTS, 3)),
    )  # fmt: skip
    params, points, misfits = [], [], []
    for t, (images, known) in enumerate(SHOWN):
        for ray, of in zip(order[starts[t] : starts[t + 1]], images, strict=True):
            for side in range(2):
                a, b = np.zeros((IMAGES, WIDE)), np.zeros((len(SHOWN), 3))
                a[of], b[t] = rows.by_params[ray, side], rows.by_point[ray, side]
                params.append(a.ravel())
                points.append(b.ravel())
                misfits.append(rows.misfits[ray, side])
        for axis in range(3 * known):
            b = np.zeros((len(SHOWN), 3))
            b[t] = rows.by_ground[numbers[t], axis]
            params.append(np.zeros(IMAGES * WIDE))
            points.append(b.ravel())
            misfits.append(rows.of_ground[numbers[t], axis])
    return Drawn(rows, np.array(params), np.array(points), np.array(misfits), np.column_stack([first, second]))


def row_numbers() -> list[tuple[list[int], list[int]]]:
    """Return the rows of the rays and of the ground of each point."""
    found, begin = [], 0
    for images, known in SHOWN:
        middle = begin + 2 * len(images)
        end = middle + 3 * known
        found.append((list(range(begin, middle)), list(range(middle, end))))
        begin = end
    return found


def test_the_normal_equations_are_those_without_the_points(drawn: Drawn) -> None:
    blocks, right = np.zeros((len(drawn.pairs), WIDE, WIDE)), np.zeros((IMAGES, WIDE))
    # In two parts, which add up.
    point_kernel.reduce(drawn.rows, 0, 5, blocks, right)
    point_kernel.reduce(drawn.rows, 5, len(SHOWN), blocks, right)
    q = np.linalg.qr(drawn.by_points)[0]
    left = drawn.by_params - q @ (q.T @ drawn.by_params)
    np.testing.assert_allclose(blocks, drawn.block(left.T @ left), rtol=0, atol=1e-11)
    np.testing.assert_allclose(right.ravel(), left.T @ drawn.misfits, rtol=0, atol=1e-11)


def test_a_step_of_the_parameters_moves_the_points_to_their_best_places(drawn: Drawn) -> None:
    step = np.random.default_rng(1).normal(size=(IMAGES, WIDE))
    shift, of_rays = np.zeros((POINTS, 3)), np.zeros(drawn.rows.misfits.shape)
    of_ground = np.zeros((POINTS, 3))
    point_kernel.shifts(drawn.rows, 0, len(SHOWN), step, shift, of_rays, of_ground)
    left = drawn.misfits - drawn.by_params @ step.ravel()
    wanted = np.linalg.lstsq(drawn.by_points, left, rcond=None)[0]
    np.testing.assert_allclose(shift[drawn.rows.numbers].ravel(), wanted, rtol=1e-9)
    taken = drawn.by_params @ step.ravel() + drawn.by_points @ wanted
    for t, (rays, ground) in enumerate(row_numbers()):
        mine = drawn.rows.order[drawn.rows.starts[t] : drawn.rows.starts[t + 1]]
        np.testing.assert_allclose(of_rays[mine].ravel(), taken[rays], rtol=1e-9, atol=1e-11)
        if ground:
            np.testing.assert_allclose(of_ground[drawn.rows.numbers[t]], taken[ground], rtol=1e-9, atol=1e-11)
    others = np.setdiff1d(np.arange(POINTS), drawn.rows.numbers)
    assert not shift[others].any()
    assert not of_ground[others].any()


def test_hat_matrices_and_covariances_are_those_of_all_unknowns(drawn: Drawn) -> None:
    """With any cofactors of the parameters: here those of the rows themselves and of other knowledge."""
    root = np.random.default_rng(2).normal(size=(IMAGES * WIDE, IMAGES * WIDE))
    q, r = np.linalg.qr(drawn.by_points)
    left = drawn.by_params - q @ (q.T @ drawn.by_params)
    cofactors = np.linalg.inv(left.T @ left + root @ root.T)
    blocks = drawn.block(cofactors)
    of_rays, of_ground = np.zeros((len(drawn.rows.image), 2, 2)), np.zeros((POINTS, 3, 3))
    point_kernel.hats(drawn.rows, 0, len(SHOWN), blocks, of_rays, of_ground)
    hat = q @ q.T + left @ cofactors @ left.T
    places = np.zeros((POINTS, 3, 3))
    point_kernel.ground(drawn.rows, 0, len(SHOWN), blocks, 1.7, places)
    moved = np.linalg.inv(r) @ q.T
    own = moved @ (1.7 * np.eye(len(hat)) + drawn.by_params @ cofactors @ drawn.by_params.T) @ moved.T
    for t, (rays, ground) in enumerate(row_numbers()):
        for k, ray in enumerate(drawn.rows.order[drawn.rows.starts[t] : drawn.rows.starts[t + 1]]):
            rows = rays[2 * k : 2 * k + 2]
            np.testing.assert_allclose(of_rays[ray], hat[np.ix_(rows, rows)], rtol=0, atol=1e-11)
        number = drawn.rows.numbers[t]
        if ground:
            np.testing.assert_allclose(of_ground[number], hat[np.ix_(ground, ground)], rtol=0, atol=1e-11)
        part = slice(3 * t, 3 * t + 3)
        np.testing.assert_allclose(places[number], own[part, part], rtol=1e-9, atol=1e-11 * own.max())


def test_partials_in_another_system_are_chained() -> None:
    random = np.random.default_rng(3)
    by_ground, way, rows = random.normal(size=(4, 2, 3)), random.normal(size=(6, 3, 3)), np.array([5, 0, 2, 5])
    np.testing.assert_allclose(point_kernel.chained(by_ground, way, rows), by_ground @ way[rows], rtol=1e-12)


def test_slopes_of_longitude_latitude_and_height_are_inverse_to_those_of_geocentric_places() -> None:
    """The frame may be turned in any way."""
    ground = np.array([[-71.3, -33.2, 2500.0], [12.5, 64.1, -40.0], [151.0, 2.0, 300.0]])
    turn, found = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0], np.empty((3, 3, 3))
    point_kernel.slopes(ground, metres_per_degree(ground), turn, found)
    for k, place in enumerate(ground):
        away = np.empty((3, 3))
        for axis, step in enumerate((1e-4, 1e-4, 10.0)):
            ends = [geocentric((place + way * step * np.eye(3)[axis])[None])[0] for way in (1, -1)]
            away[:, axis] = turn @ (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(found[k] @ away, np.eye(3), atol=1e-4)


@pytest.mark.parametrize("testable", [0.01, 0.2])
def test_squares_of_rays_are_along_the_axes_of_their_redundancy(testable: float) -> None:
    """By the eigenvalues of the redundancy; axes with less than what is testable are left out."""
    random = np.random.default_rng(5)
    turns, shares = random.uniform(0, np.pi, 12), random.uniform(0.25, 1.0, (12, 2))
    shares[:6] = [(0.9, testable * 1.01), (0.9, testable * 0.99), (testable * 0.99, 0.9), (0.0, 0.4),
                  (testable * 0.99, testable * 0.5), (0.6, 0.6)]  # fmt: skip
    turns[6:9] = 0.0, np.pi / 2, np.pi / 4
    axes = np.stack([np.stack([np.cos(turns), np.sin(turns)], 1), np.stack([-np.sin(turns), np.cos(turns)], 1)], 1)
    hats = np.eye(2) - np.einsum("nki,nk,nkj->nij", axes, shares, axes)
    misfits = random.normal(0, 2, (12, 2))
    used, found, rank = np.array([11, *range(10)]), np.full(12, -7.0), np.full(12, 9)
    point_kernel.squares(used, hats, misfits, testable, found, rank)
    along = np.einsum("nki,ni->nk", axes, misfits)
    known = shares > testable
    wanted = np.where(known, along**2 / np.where(known, shares, 1.0), 0.0).sum(axis=1)
    np.testing.assert_allclose(found[used], wanted[used], rtol=1e-9)
    assert rank[used].tolist() == known.sum(axis=1)[used].tolist()
    # A ray that was not asked for stays as it is.
    assert (found[10], rank[10]) == (-7.0, 9)
