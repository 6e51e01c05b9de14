"""The note that check points of a block have a common error."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from ortho_pipeline.report.network.facts import displaced_checks


def block(errors: Any, check: Any = True) -> Any:
    """Return what the note reads of a block whose points have these errors (adjusted minus given)."""
    marked = np.broadcast_to(check, len(errors))
    residuals = -np.asarray(errors, dtype=float)
    sigmas = np.broadcast_to([1.0, 1.0, 2.5], residuals.shape)
    return SimpleNamespace(points=SimpleNamespace(check=marked), object_residuals=residuals, ground_sigmas=sigmas)


def test_a_common_error_in_height_is_named_with_its_sign() -> None:
    errors = np.random.default_rng(3).normal(0.0, 1.0, (30, 3)) + np.array([0.0, 0.0, -2.0])
    (notice,) = displaced_checks(block(errors))
    mean = errors.mean(axis=0)
    assert notice.code == "systematic-errors"
    assert notice.endswith(
        f"the mean error of 30 check points is −{-mean[2]:.2f} m in z "
        "(sigma of one point: 2.5 m; points can share errors)"
    )
    assert notice.fields["mean_m"] == pytest.approx(mean)


def test_the_limit_is_a_chance_of_one_in_a_thousand_for_each_axis() -> None:
    errors = np.random.default_rng(4).normal(0.0, 1.0, (20, 3))
    errors -= errors.mean(axis=0)
    for shift in np.arange(0.5, 1.2, 0.05):
        moved = errors + np.array([shift, 0.0, 0.0])
        assert bool(displaced_checks(block(moved))) == (ttest_1samp(moved[:, 0], 0.0).pvalue < 0.001)


def test_control_points_voids_and_few_points_say_nothing() -> None:
    errors = np.random.default_rng(5).normal(0.0, 1.0, (40, 3)) + 3.0
    assert displaced_checks(block(errors, np.arange(40) < 9)) == ()
    errors[:31] = np.nan
    assert displaced_checks(block(errors)) == ()
    assert displaced_checks(block(errors[30:] * 0.0)) == ()
