"""What neighbouring matches of an image err together adds to the covariance of a block's parameters: by definition."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import ORIGIN, Chain, fly, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.equations.solver import Solved, attempt
from ortho_pipeline.block.variances import shared_errors
from ortho_pipeline.block.variances.shared_errors import SharedByImage
from ortho_pipeline.estimation.spatial.shared_errors import MATCHED_ALIKE
from ortho_pipeline.models import ImageCorrection


@pytest.fixture(scope="module")
def solved() -> Solved:
    """A block whose middle image has four parameters; rays of ties and of most control points are in groups."""
    flown = fly(Chain(images=3, convergence_deg=20.0, ties=50, errors=1.0, pairwise=False), 3)
    points = with_control(flown, "i1", 16, sigma=0.3)
    random = np.random.default_rng(4)
    groups = random.integers(0, 5, points.rays)
    groups[np.isin(points.point, np.flatnonzero(points.control)[:3])] = -1
    points = replace(points, groups=groups, sigma_image=random.uniform(0.05, 0.2, points.rays))
    models = dict(flown.start)
    models["i1"] = ImageCorrection.identity(models["i1"].model, "shift-drift", ORIGIN)
    problem, state, selection = _prepared(tuple(models.values()), points, {}, ())
    return attempt(problem, state, selection)


def rays_of(solved: Solved, image: int) -> np.ndarray:
    """Return the rays of an image that have a group and are of known ground."""
    points = solved.problem.points
    assert points.groups is not None
    return np.flatnonzero((points.image == image) & (points.groups >= 0) & points.control[points.point])


def rows_of(solved: Solved, image: int) -> np.ndarray:
    """Return what is left of the rows of its parameters if the point of each ray may follow, held by its ground."""
    found, linear = [], solved.linear
    count = len(solved.problem.models[image].params)
    for ray in rays_of(solved, image).tolist():
        point = linear.problem.points.point[ray]
        left = np.vstack([linear.by_point[ray], linear.ground_by_point[point]])
        right = np.vstack([linear.by_params[ray][:, :count], np.zeros((3, count))])
        found.append((right - left @ np.linalg.lstsq(left, right, rcond=None)[0])[:2])
    return np.array(found)


def made(monkeypatch: pytest.MonkeyPatch, excess: object, asked: list[Any] | None = None) -> None:
    def shared_by(*given: Any) -> tuple[Any, Any]:
        if asked is not None:
            asked.append(given)
        return SimpleNamespace(points=30, groups=12), excess

    monkeypatch.setattr(shared_errors, "shared_by", shared_by)
    monkeypatch.setattr(shared_errors, "positive_part", lambda excess, flat: excess[0] * flat.T @ flat)


@pytest.mark.parametrize("excess", [None, (7.0,)])
def test_the_covariance_grows_by_what_matches_of_each_image_share(
    solved: Solved, monkeypatch: pytest.MonkeyPatch, excess: Any
) -> None:
    """Without an estimate, thirty matches count as their twelve groups; all of an image err alike by a known part."""
    asked: list[Any] = []
    made(monkeypatch, excess, asked)
    found = SharedByImage.of(solved)
    assert found is not None
    points, variance = solved.problem.points, float(solved.unit_weight()[0] or 0) ** 2
    wanted = solved.cofactors.matrix
    columns = [np.arange(2), np.arange(2, 6), np.arange(6, 8)]
    images = [image for image in range(3) if len(rays_of(solved, image))]
    assert list(found.images) == [points.images[image] for image in images]
    assert len(images) > 1
    for image, given in zip(images, asked, strict=True):
        rays, rows = rays_of(solved, image), rows_of(solved, image)
        flat = rows.reshape(-1, rows.shape[2])
        np.testing.assert_allclose(given[2], rows, atol=1e-9)
        np.testing.assert_array_equal(given[0], points.measured[rays])
        np.testing.assert_array_equal(given[1], solved.linear.misfits.rays[rays])
        assert given[6] == pytest.approx(variance)
        part = (30 / 12 - 1) * variance if excess is None else 7.0
        # An image point off by so much is a misfit of that over its sigma.
        alike = np.concatenate([MATCHED_ALIKE * np.eye(2) / sigma for sigma in points.sigma_image[rays]])
        inner = part * flat.T @ flat + flat.T @ alike @ alike.T @ flat
        root = solved.cofactors.matrix[:, columns[image]]
        wanted = wanted + root @ inner @ root.T
    np.testing.assert_allclose(found.added(solved.cofactors).matrix, wanted, rtol=1e-8, atol=1e-12)


def test_the_estimate_of_a_common_error_errs_with_the_matches(solved: Solved, monkeypatch: pytest.MonkeyPatch) -> None:
    made(monkeypatch, (7.0,))
    random = np.random.default_rng(5)
    root = random.normal(size=(2, 2))
    common: Any = SimpleNamespace(
        told=np.diag([3.0, 0.0]), seen=random.normal(size=(solved.problem.points.rays, 2, 2)),
        by_params=random.normal(size=(8, 2)), left=root @ root.T,
    )  # fmt: skip
    found = SharedByImage.of(solved, common)
    assert found is not None
    wanted, columns = solved.cofactors.matrix, [np.arange(2), np.arange(2, 6), np.arange(6, 8)]
    for image in range(3):
        rays = rays_of(solved, image)
        if not len(rays):
            continue
        flat = np.concatenate([rows_of(solved, image), common.seen[rays]], axis=2).reshape(2 * len(rays), -1)
        alike = np.concatenate([MATCHED_ALIKE * np.eye(2) / s for s in solved.problem.points.sigma_image[rays]])
        inner = 7.0 * flat.T @ flat + flat.T @ alike @ alike.T @ flat
        both = np.hstack([solved.cofactors.matrix[:, columns[image]], common.by_params @ common.left])
        wanted = wanted + both @ inner @ both.T
    np.testing.assert_allclose(found.added(solved.cofactors).matrix, wanted, rtol=1e-8, atol=1e-10)
    untold = SharedByImage.of(solved, SimpleNamespace(told=np.zeros((2, 2))))  # type: ignore[arg-type]
    assert untold is not None
    assert untold.root.shape[1] == sum(len(columns[image]) for image in range(3) if len(rays_of(solved, image)))


def test_without_groups_redundancy_or_few_enough_parameters_nothing_is_known(
    solved: Solved, monkeypatch: pytest.MonkeyPatch
) -> None:
    made(monkeypatch, (7.0,))
    assert SharedByImage.of(solved) is not None
    for most, known in ((8, True), (7, False)):
        monkeypatch.setattr(shared_errors, "MOST_PARAMETERS", most)
        assert (SharedByImage.of(solved) is not None) is known
    monkeypatch.setattr(shared_errors, "MOST_PARAMETERS", 1000)
    points = solved.problem.points
    for groups in (None, np.full(points.rays, -1)):
        problem = replace(solved.problem, points=replace(points, groups=groups))
        assert SharedByImage.of(replace(solved, linear=replace(solved.linear, problem=problem))) is None
    monkeypatch.setattr(Solved, "unit_weight", lambda one: (None, 0.0))
    assert SharedByImage.of(solved) is None
