"""What a recommendation says of the model with the smallest error, and which models vote on gross errors."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from ortho_pipeline.estimation.blunders import OutlyingPoint
from ortho_pipeline.estimation.choice.compared_model import ComparedModel
from ortho_pipeline.estimation.choice.comparison import _blunders
from ortho_pipeline.estimation.choice.recommendation import recommend
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points

LOW, HIGH = np.array([400e3, 5000e3, 200.0]), np.array([402e3, 5002e3, 800.0])
CHECKS = np.array([4.0, 9.0, 6.25, 5.0, 7.5])


@pytest.fixture(scope="module")
def base() -> Fit:
    """Twelve control points and five check points of an affine camera, with errors of 0.4 px."""
    random = np.random.default_rng(8)
    ground = random.uniform(LOW, HIGH, (17, 3))
    ground[12:, 0] = 401e3 + 0.4 * (ground[12:, 0] - 401e3)
    x, y, h = (ground - LOW).T
    image = np.column_stack([x / 2 + h / 2, 1000 - y / 2]) + random.normal(0, 0.4, (17, 2))
    points = Points.of(image, ground, "EPSG:32633", roles=["control"] * 12 + ["check"] * 5, sigma_image=0.4)
    found = fit_family("affine3d", points, size=(1000, 1000), heights=(200.0, 800.0), robust=False)
    return dataclasses.replace(found, sigma0=1.0, outlying=(), corner_ratio=1.0)


def row(base: Fit, name: str, parameters: int, squares: np.ndarray, **changes: object) -> ComparedModel:
    """Return a model whose check points have these squared errors (px²), in rows."""
    residuals = np.zeros((17, 2))
    residuals[12:, 1] = np.sqrt(squares)
    lost = np.full((17, 2), np.nan)
    found = dataclasses.replace(base, residuals=residuals, loo_residuals=lost, **changes)  # type: ignore[arg-type]
    return ComparedModel.of(name, (parameters, 4, 3), found)


def test_a_better_model_that_is_not_recommended_has_its_reason(base: Fit) -> None:
    few = row(base, "few", 8, CHECKS)
    many = row(base, "many", 20, CHECKS / 1.02)
    name, reason, criterion = recommend([few, many])
    rmse, less = (f"{math.sqrt(mean):.3g} px" for mean in (CHECKS.mean(), CHECKS.mean() / 1.02))
    assert (name, criterion) == ("few", "check")
    assert f"RMSE {rmse} at 5 check points; 8 parameters. many has RMSE {less} with 20 parameters, but its" in reason
    assert reason.endswith("less than 2 % smaller, so the model with fewer parameters is recommended")
    # The scene's own model has more parameters here.
    name, reason, _ = recommend([row(base, "own", 24, CHECKS), many], preferred=("own",))
    assert name == "own"
    assert reason.endswith("less than 2 % smaller, so the scene's own model is recommended")
    spread = CHECKS[[1, 0, 3, 2, 4]] * 1.2
    name, reason, _ = recommend([row(base, "own", 24, spread), many], preferred=("own",))
    assert name == "own"
    assert reason.endswith("is not significantly smaller")
    assert recommend([few, many], unsuited=("many",))[1].endswith("parameters, but is unsuited to the scene")
    unstable = row(base, "many", 20, CHECKS / 1.5, condition=1e6)
    assert recommend([few, unstable])[1].endswith("parameters, but is unstable")
    name, reason, _ = recommend([unstable], unsuited=("many",))
    assert name is None
    assert reason.endswith("many is unstable and unsuited to the scene")
    # Its noise is six times the stated one.
    noisy = row(base, "many", 20, CHECKS / 1.5, sigma0=6.0)
    assert recommend([few, noisy])[1].endswith("but these points do not support it")
    # Check points are near the middle of x, so an uncertain scale there matters only over the scene.
    covariance = base.covariance.copy()
    covariance[1, 1] += 400.0
    uncertain = row(base, "many", 20, CHECKS / 1.1, covariance=covariance)
    name, reason, _ = recommend([few, uncertain])
    assert name == "few"
    assert reason.endswith("px) is larger")


def test_points_that_test_models_are_counted_by_their_kind(base: Fit) -> None:
    """Check points that contradict the clearest model do not count, and a model without parameters needs no loo."""
    plain = ComparedModel.of("plain", (8, 4, 3), base)
    assert "at 5 check points and 12 control points (leave-one-out); 8 parameters" in recommend([plain])[1]
    wrong = OutlyingPoint.of("14", "check", 9.0, 1.0, 1e-6)
    suspect = OutlyingPoint.of("3", "control", 9.0, 1.0, 1e-6)
    less = ComparedModel.of("plain", (8, 4, 3), dataclasses.replace(base, outlying=(wrong, suspect)))
    assert "at 4 check points and 12 control points" in recommend([less])[1]
    alone = dataclasses.replace(base, points=base.points.with_roles(np.where(base.used, "control", "tie")))
    name, reason, criterion = recommend([ComparedModel.of("plain", (8, 4, 3), alone)])
    assert (name, criterion) == ("plain", "leave-one-out")
    for redundancy, tested in ((1, "plain"), (0, None)):
        spare = dataclasses.replace(alone, redundancy=redundancy)
        assert recommend([ComparedModel.of("plain", (8, 4, 3), spare)])[0] == tested
    squares = (base.loo_residuals[:12] ** 2).sum(axis=1)
    assert f"RMSE {math.sqrt(squares.mean()):.3g} px at 12 control points (leave-one-out)" in reason


def test_models_are_compared_at_the_points_that_test_all_of_them(base: Fit) -> None:
    """One model does not project the second check point, where its error would be unknown."""
    every, lost = CHECKS.copy(), CHECKS / 1.5
    lost[1] = np.nan
    name, reason, _ = recommend([row(base, "every", 8, every), row(base, "lost", 8, lost)])
    assert name == "lost"
    assert f"RMSE {math.sqrt(np.nanmean(lost)):.3g} px at 4 check points" in reason


def test_a_model_without_parameters_is_tested_by_all_its_points(base: Fit) -> None:
    model = ImageCorrection.identity(base.model, "none", (0.0, 0.0))
    residuals = np.random.default_rng(3).normal(0, 2, (17, 2))
    fixed = dataclasses.replace(
        base, model=model, residuals=residuals, loo_residuals=np.full((17, 2), np.nan), covariance=np.zeros((0, 0))
    )
    reason = recommend([ComparedModel.of("fixed", (0, 1, 3), fixed)])[1]
    rmse = math.sqrt((residuals**2).sum(axis=1).mean())
    assert f"RMSE {rmse:.3g} px at 5 check points and 12 control points (leave-one-out); 0 parameters" in reason


def voter(base: Fit, error: float, rejected: dict[str, str], **changes: object) -> Fit:
    """Return a fit of which each control point is `error` px off."""
    off = np.zeros((17, 2))
    off[:, 0] = error
    named = tuple(rejected.items())
    return dataclasses.replace(base, residuals=off, loo_residuals=off, rejected=named, **changes)  # type: ignore[arg-type]


def test_more_than_half_of_the_models_with_small_errors_decide_on_gross_errors(base: Fit) -> None:
    one, both = {"3": "first"}, {"3": "second", "5": "other"}
    assert _blunders([voter(base, 1.0, one), voter(base, 1.0, both), voter(base, 1.0, {})]) == {"3": "first"}
    assert _blunders([voter(base, 1.0, one), voter(base, 1.0, {})]) == {}
    # Up to twice the smallest error.
    assert _blunders([voter(base, 1.0, one), voter(base, 1.99, both)]) == {"3": "first"}
    assert _blunders([voter(base, 1.0, one), voter(base, 2.01, {})]) == one
    # A fit without redundancy cannot show which point is wrong.
    assert _blunders([voter(base, 1.0, one), voter(base, 1.0, {}, redundancy=4)]) == {}
    assert _blunders([voter(base, 1.0, one), voter(base, 1.0, {}, redundancy=3)]) == one
    assert _blunders([]) == {}


def test_the_error_of_a_voter_is_the_median_of_its_control_points(base: Fit) -> None:
    """Left out one at a time; rejected ones as they are, and those without an error as far as can be."""
    sizes = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, np.nan])
    loo, residuals = np.zeros((17, 2)), np.zeros((17, 2))
    loo[:12], residuals[:12] = sizes[:, None] * (0.6, -0.8), 0.1
    found = dataclasses.replace(base, residuals=residuals, loo_residuals=loo, rejected=(("1", "off"),))
    # The median of twelve is 6.5; another model votes if it has up to 13.
    for error, votes in ((12.9, {}), (13.1, {"1": "off"})):
        assert _blunders([found, voter(base, error, {})]) == votes
    used = base.used.copy()
    used[:2] = False
    residuals[:2] = 60.0, 80.0
    rejecting = dataclasses.replace(found, residuals=residuals, loo_residuals=loo, used=used)
    # Now two errors of 100 px instead of 1 and 2: the median is 8.5.
    for error, votes in ((16.9, {}), (17.1, {"1": "off"})):
        assert _blunders([rejecting, voter(base, error, {})]) == votes
