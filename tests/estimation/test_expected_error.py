"""The expected error over a scene, against plain least squares and numbers by hand."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import ttest_rel

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.choice.comparison import choose_models, compare
from ortho_pipeline.estimation.choice.expected_error import Expectation, criterion, expectation, supported
from ortho_pipeline.estimation.choice.recommendation import expected_errors, recommend
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.points import Points

#: Pixels of 2 m, and a parallax of half a pixel per metre of height.
SIGMA, PIXEL = 0.4, 2.0
SIZE = (1000, 1000)
LOW, HIGH = np.array([400e3, 5000e3, 200.0]), np.array([402e3, 5002e3, 800.0])


def points_of(ground: np.ndarray, parallax: float = 0.5, noise: float = SIGMA) -> Points:
    x, y, h = (ground - LOW).T
    image = np.column_stack([x / PIXEL + parallax * h, 1000 - y / PIXEL])
    image += noise * np.random.default_rng(3).normal(size=image.shape)
    roles = np.where(np.arange(len(ground)) < 12, "control", "check")
    return Points.of(image, ground, "EPSG:32633", roles=roles, sigma_image=SIGMA)


def design_of(ground: np.ndarray) -> np.ndarray:
    return np.column_stack([np.ones(len(ground)), (ground - (LOW + HIGH) / 2) / (HIGH - LOW)])


@pytest.fixture(scope="module")
def affine() -> Fit:
    """Twelve control points and five check points of an affine camera."""
    random = np.random.default_rng(8)
    points = points_of(random.uniform(LOW, HIGH, (17, 3)))
    return fit_family("affine3d", points, size=SIZE, heights=(200.0, 800.0), robust=False)


def test_variances_are_those_of_plain_least_squares(affine: Fit) -> None:
    """Of both axes: of measuring a point, of the parameters at the tests, and over the part of the box in the image."""
    points = affine.points
    inverse = np.linalg.inv(design_of(points.ground[affine.used]).T @ design_of(points.ground[affine.used]))

    def mean(ground: np.ndarray) -> float:
        rows = design_of(ground)
        return 2 * SIGMA**2 * float(((rows @ inverse) * rows).sum(axis=1).mean())

    found = expectation(affine, points.check, SIZE)
    assert found.stated == pytest.approx(2 * SIGMA**2)
    assert found.tested == pytest.approx(mean(points.ground[points.check]), rel=1e-6)
    centre, half = affine.model.domain
    ground = centre + half * np.random.default_rng(0).uniform(-1, 1, (100_000, 3))
    image = affine.model.ground_to_image(ground)
    for size in (SIZE, (400, 1000), (1000, 300)):
        inside = ((image >= 0) & (image <= size)).all(axis=1)
        assert expectation(affine, points.check, size).scene == pytest.approx(mean(ground[inside]), rel=0.08)
    assert expectation(affine, points.check, None).scene == pytest.approx(mean(ground), rel=0.08)


def test_without_redundancy_variances_are_those_of_the_stated_noise() -> None:
    """Four control points, which an affine camera fits exactly."""
    control = [[0.1, 0.1, 0.2], [0.9, 0.2, 0.7], [0.2, 0.9, 0.9], [0.8, 0.8, 0.1]]
    ground = LOW + np.array([*control, [0.5, 0.5, 0.5], [0.6, 0.3, 0.4]]) * (HIGH - LOW)
    points = points_of(ground).with_roles(["control"] * 4 + ["check"] * 2)
    fit = fit_family("affine3d", points, size=SIZE, heights=(200.0, 800.0), robust=False)
    assert fit.sigma0 is None
    inverse, rows = np.linalg.inv(design_of(ground[:4])), design_of(ground[4:])
    expected = 2 * SIGMA**2 * ((rows @ inverse) ** 2).sum(axis=1).mean()
    assert expectation(fit, points.check, SIZE).tested == pytest.approx(expected, rel=1e-6)


def test_heights_without_control_displace_a_flat_model(affine: Fit) -> None:
    """By a mean square of a tenth of their variance, in pixels of 2 m; control in all heights leaves none of it."""
    random = np.random.default_rng(5)
    flat, hilly = random.uniform(LOW, HIGH, (2, 12, 3))
    flat[:, 2] = 500.0
    hilly[:, 2] = 500.0 + 120.0 * np.tile([-1.0, 1.0], 6)
    for ground in (flat, hilly):
        fit = fit_family("affine2d", points_of(ground, 0.0), size=SIZE, heights=(200.0, 800.0), robust=False)
        # The heights of a box have a third of the square of their half range; three levels show eight ninths of that.
        missing = fit.model.domain[1][2] ** 2 / 3 * 8 / 9 - ground[:, 2].var()
        assert missing > 10_000
        assert expectation(fit, fit.used, None).unseen == pytest.approx(0.1 * missing / PIXEL**2, rel=0.01)
    hilly[:, 2] = 500.0 + 300.0 * np.tile([-1.0, 1.0], 6)
    fit = fit_family("affine2d", points_of(hilly, 0.0), size=SIZE, heights=(200.0, 800.0), robust=False)
    assert expectation(fit, fit.used, None).unseen == 0.0


def expected(**more: float) -> Expectation:
    plain = {"criterion": 0.0, "noise": 1.0, "stated": 2.0, "tested": 1.0, "scene": 4.0, "unseen": 5.0}
    return Expectation(**{**plain, **more})


def test_the_expected_square_is_that_of_the_formula() -> None:
    assert expected().square(9.0, 1.0) == 3 * (2 + 4) + 5
    assert expected().square(9.0, 5.0) == 5 * (2 + 4) + 5, "no less than the noise"
    assert expected(unseen=0.0, tested=2.0).square(8.0, 0.5) == 2 * 6
    found = expected_errors({"a": np.array([6.0, 12.0])}, {"a": expected(unseen=7.0)})
    assert found == {"a": math.sqrt(3 * 6 + 7)}, "a root mean square"


def test_support_ends_ten_above_the_best_criterion_unless_the_noise_is_alike() -> None:
    models = {
        "best": expected(criterion=-7.0, noise=4.0),
        "near": expected(criterion=2.9, noise=9.0),
        "far": expected(criterion=3.1, noise=9.0),
        "far, and 1 % worse": expected(criterion=90.0, noise=4.0 * 1.01**2),
        "far, and 3 % worse": expected(criterion=90.0, noise=4.0 * 1.03**2),
    }
    assert supported(models, 1.02) == (["best", "near", "far, and 1 % worse"], 1.0)
    assert supported({"best": expected(noise=0.25)}, 1.02) == (["best"], 0.25)
    unknown = {name: expected(criterion=math.inf, noise=math.inf) for name in ("a", "b")}
    assert supported(unknown, 1.02) == (["a", "b"], 1.0)


def as_if(base: Fit, name: str, parameters: int, squares: np.ndarray) -> ComparedModel:
    """Return a row whose check points have these squared errors, to the left and to the right."""
    residuals = np.zeros((len(base.points), 2))
    residuals[base.points.check, 0] = np.sqrt(squares) * (-1.0) ** np.arange(len(squares))
    lost = np.full_like(residuals, np.nan)
    found = dataclasses.replace(base, residuals=residuals, loo_residuals=lost, outlying=(), corner_ratio=1.0)
    return ComparedModel.of(name, (parameters, 4, 3), found)


@pytest.mark.parametrize(("goal", "chosen"), [(0.048, "free"), (0.052, "own")])
def test_the_scenes_own_model_gives_way_at_five_per_cent(affine: Fit, goal: float, chosen: str) -> None:
    """One-sided, by the paired test of SciPy on five differences."""
    best, noise = np.array([2.0, 3.0, 2.5, 3.5, 2.2]), np.array([1.0, -1.0, 0.3, -0.6, 0.8])
    shifts = np.linspace(0.5, 1.5, 2001)[:, None]
    chances = ttest_rel(best + noise + shifts, np.tile(best, (2001, 1)), axis=1, alternative="greater").pvalue
    own = best + noise + shifts[np.argmin(np.abs(chances - goal))]
    rows = [as_if(affine, "own", 8, own), as_if(affine, "free", 20, best)]
    assert recommend(rows, preferred=("own",))[0] == chosen


def test_three_points_are_enough_to_recommend_and_two_are_not(affine: Fit) -> None:
    for count, model in ((3, "one"), (2, None)):
        squares = np.where(np.arange(5) < count, 1.0, np.nan)
        assert recommend([as_if(affine, "one", 8, squares)])[0] == model


def test_an_unsuited_model_is_not_recommended_and_fewer_parameters_are_within_two_per_cent(affine: Fit) -> None:
    squares = np.array([4.0, 5.0, 6.0, 5.0, 4.5])
    rows = [as_if(affine, "few", 8, 1.03 * squares), as_if(affine, "many", 20, squares)]
    assert recommend(rows)[0] == "few", "1.5 % in errors are 3 % in squares"
    assert recommend(rows, unsuited=("few",))[0] == "many"
    assert recommend(rows, unsuited=("few", "many"))[0] is None
    rows[0] = as_if(affine, "few", 8, 1.05 * squares)
    assert recommend(rows)[0] == "many"


def test_a_named_model_is_compared_once() -> None:
    assert choose_models(" dlt, affine3d,,dlt ") == ("dlt", "affine3d")
    for text in ("", " , "):
        with pytest.raises(InputError, match="no model"):
            choose_models(text)


def test_counts_are_those_of_the_points_that_were_used() -> None:
    random = np.random.default_rng(4)
    points = points_of(random.uniform(LOW, HIGH, (17, 3)))
    image = points.image.copy()
    image[2] += 60.0
    done = compare(dataclasses.replace(points, image=image), ("affine3d", "affine2d"), size=SIZE)
    assert done.best is not None
    assert done.best.model == done.recommended == "affine3d", "heights displace by 300 px"
    assert (done.points.control, done.points.check) == (11, 5)
    assert (done.rows[0].parameters, done.rows[0].redundancy) == (8, 2 * 11 - 8)


def test_the_criterion_is_that_of_hurvich_and_tsai_with_eight_further_observations_and_the_noise() -> None:
    """With S + 8 squares, 20 + 8 observations and 3 + 1 parameters."""
    expected = 28 * math.log(12 / 28) + 2 * 4 + 2 * 4 * 5 / (28 - 4 - 1)
    assert criterion(4.0, 20, 3) == pytest.approx(expected, rel=1e-12)
    # 10 + 8 observations, 15 + 1 parameters: one is left; with another parameter none.
    assert criterion(4.0, 10, 15) == pytest.approx(18 * math.log(12 / 18) + 32 + 2 * 16 * 17 / 1, rel=1e-12)
    assert criterion(4.0, 10, 16) == math.inf
    assert criterion(4.0, 10, 17) == math.inf
