"""The weight of a regularisation: by cross-validation and by the L-curve, with dense solutions for each weight."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.problem import Problem
from ortho_pipeline.estimation.regularisation import _corner, regularised
from ortho_pipeline.models import RPC, ImageCorrection, start_model
from ortho_pipeline.models.base import Array
from ortho_pipeline.points import Points


def problem_of(family: str, count: int = 45) -> Problem:
    """Return points of a camera whose image bends, with sigmas that differ, and the start of a rational function."""
    random = np.random.default_rng(12)
    ground = random.uniform([400e3, 5000e3, 200.0], [402e3, 5004e3, 800.0], (count, 3))
    x, y, z = ((ground - (401e3, 5002e3, 500.0)) / (1000.0, 2000.0, 300.0)).T
    image = np.column_stack([500 * (1 + x + 0.05 * z + 0.02 * x * y), 1000 * (1 - y + 0.03 * z + 0.01 * x**2)])
    image += random.normal(0, 0.5, image.shape)
    points = Points.of(image, ground, "EPSG:32633", sigma_image=random.uniform(0.3, 0.7, count))
    model: Any = start_model(family, points, size=(1000, 2000))
    return Problem.of(model, points, np.ones(count, dtype=bool), {})


def dense(problem: Problem, keep: np.ndarray) -> tuple[Array, Array, Array]:
    """Return design and observations in sigmas ``(2 n, P)``, and the grades of penalised parameters, 0 of others."""
    model: Any = problem.model
    sigma = np.repeat(problem.points.sigma_image[keep], 2)
    design = model.param_partials(problem.ground[keep]).reshape(len(sigma), -1) / sigma[:, None]
    left = (problem.image[keep] - model.ground_to_image(problem.ground[keep])).ravel() / sigma
    grades = np.zeros(len(model.param_names))
    for k, name in enumerate(model.param_names):
        order = sum(int(power or 1) for power in re.findall(r"[XYZ](\d?)", name))
        if "den_" in name or order > 1:
            # Pixels of half of the image, in the median sigma, and ten times more for each further order.
            grades[k] = 10.0 ** (order - (1 if "den_" in name else 2))
    grades *= model.image_scale.mean() / np.median(problem.points.sigma_image)
    return design, left + design @ model.params, grades


def curves(problem: Problem, keep: np.ndarray) -> tuple[Array, Array, Array, Array]:
    """Return weights, sums of squares, effective parameters and squares of the penalised part, of 81 weights."""
    design, observed, grades = dense(problem, keep)
    free, drawn = design[:, grades == 0], design[:, grades > 0] / grades[grades > 0]
    basis = np.linalg.qr(free)[0]
    largest = np.linalg.norm(drawn - basis @ (basis.T @ drawn), 2) ** 2
    weights = largest * 10.0 ** np.linspace(-10, 0, 81)
    squares, effective, sizes = np.zeros((3, 81))
    for k, weight in enumerate(weights):
        penalty = np.diag(weight * grades**2)
        rows = np.vstack([design, np.sqrt(penalty)])
        scale = np.linalg.norm(rows, axis=0)
        q, r = np.linalg.qr(rows / scale)
        values = np.linalg.solve(r, q.T @ np.concatenate([observed, np.zeros(len(grades))])) / scale
        squares[k] = ((observed - design @ values) ** 2).sum()
        effective[k] = (q[: len(design)] ** 2).sum()
        sizes[k] = ((grades * values) ** 2).sum()
    return weights, squares, effective, sizes


@pytest.mark.parametrize("family", ["rfm1", "rfm2"])
def test_cross_validation_chooses_the_weight_of_the_smallest_score(family: str) -> None:
    """Squares over the square of what is left of the observations, if each parameter counts 1.4 times."""
    problem = problem_of(family)
    keep = np.arange(45) != 7
    weights, squares, effective, _ = curves(problem, keep)
    freedom = 88 - 1.4 * effective
    score = np.where(freedom > 0, squares / freedom**2, np.inf)
    best = int(np.argmin(score))
    assert 3 < best < 78
    _, found = regularised(problem, keep, "gcv", linear=True)
    assert found == pytest.approx(weights[best], rel=1e-6)


def test_with_few_points_weights_that_leave_no_freedom_are_not_chosen() -> None:
    problem = problem_of("rfm2", 22)
    keep = np.ones(22, dtype=bool)
    weights, squares, effective, _ = curves(problem, keep)
    freedom = 44 - 1.4 * effective
    assert (freedom < 0).any()
    assert (freedom > 0).any()
    _, found = regularised(problem, keep, "gcv", linear=True)
    assert found == pytest.approx(
        weights[int(np.argmin(np.where(freedom > 0, squares / freedom**2, np.inf)))], rel=1e-6
    )


def test_the_l_curve_chooses_the_weight_at_its_corner() -> None:
    """Where the curve of logarithms turns most sharply from steep to level, by its curvature."""
    problem = problem_of("rfm2")
    keep = np.ones(45, dtype=bool)
    weights, squares, _, sizes = curves(problem, keep)
    x, y = np.log(squares), np.log(sizes)
    slopes = [np.gradient(part) for part in (x, y)]
    turns = [np.gradient(part) for part in slopes]
    bend = (slopes[0] * turns[1] - slopes[1] * turns[0]) / np.hypot(*slopes) ** 3
    corner = int(np.argmax(bend))
    assert 3 < corner < 78
    _, found = regularised(problem, keep, "lcurve", linear=True)
    assert found == pytest.approx(weights[corner], rel=1e-6)


def test_the_sharpest_turn_does_not_depend_on_how_densely_a_curve_is_sampled() -> None:
    """An ellipse turns most sharply at the ends of its long axis; its samples are closer to each other elsewhere."""
    share = np.linspace(-1.3, 1.7, 241)
    angle = share + 0.45 * np.sin(2 * share)
    assert abs(share[_corner(np.sin(angle), -3.0 * np.cos(angle))]) < 0.02


def test_a_stable_choice_is_that_of_its_own_solution() -> None:
    """A step of the grid is a quarter of a decade in two: less than a tenth in the logarithm means the same weight."""
    problem = problem_of("rfm1")
    keep = np.ones(45, dtype=bool)
    found, weight = regularised(problem, keep, "gcv")
    _, again = regularised(found, keep, "gcv", linear=True)
    assert again == pytest.approx(weight, rel=0.1)
    solved: Any = found.solve(keep).model
    np.testing.assert_allclose(found.model.params, solved.params, atol=1e-4)


def test_only_models_with_higher_terms_and_positive_weights_are_regularised() -> None:
    problem, keep = problem_of("rfm1"), np.ones(45, dtype=bool)
    for weight in (0.0, -1.0, np.inf, np.nan, "best"):
        with pytest.raises(InputError) as refused:
            regularised(problem, keep, weight)
        assert refused.value.field == "ridge"
    one = np.eye(20)
    rpc = RPC(1000.0, 1000.0, 20.0, -30.0, 500.0, 1000.0, 1000.0, 0.01, 0.01, 500.0, one[1], one[0], one[2], one[0])
    points = Points.of([[900.0, 1100.0]] * 3, [[20.001, -29.999, 480.0]] * 3, "EPSG:4979")
    shift = Problem.of(ImageCorrection.identity(rpc, "shift", (0.0, 0.0)), points, np.ones(3, dtype=bool), {})
    for other in (shift, problem_of("affine3d")):
        with pytest.raises(InputError, match="higher-order terms"):
            regularised(other, keep[: len(other.rows)], 1.0)
