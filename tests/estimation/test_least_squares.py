"""The linear algebra of the adjustment at its limits: condition, rank, valleys and steps, by hand and against NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ortho_pipeline.errors import NotConverged
from ortho_pipeline.estimation import least_squares
from ortho_pipeline.estimation.least_squares import condition_of, minimise, solve_linear

RANDOM = np.random.default_rng(2)


def test_the_solution_has_the_cofactors_residuals_and_condition_of_numpy() -> None:
    design, observed = RANDOM.normal(size=(9, 3)) * [1.0, 1e3, 1e-3], RANDOM.normal(size=9)
    for refine in (True, False):
        found = solve_linear(design, observed, refine=refine)
        values = np.linalg.lstsq(design, observed, rcond=None)[0]
        np.testing.assert_allclose(found.values, values, rtol=1e-9)
        np.testing.assert_allclose(found.residuals, observed - design @ values, atol=1e-12)
        np.testing.assert_allclose(found.cofactors, np.linalg.inv(design.T @ design), rtol=1e-9)
        unit = design / np.linalg.norm(design, axis=0)
        assert found.condition == pytest.approx(np.linalg.cond(unit), rel=1e-9)
        assert condition_of(design) == pytest.approx(np.linalg.cond(unit), rel=1e-9)
        variance = ((observed - design @ values) ** 2).sum() / 6
        assert found.sigma0 == pytest.approx(math.sqrt(variance))
        np.testing.assert_allclose(found.sigmas, np.sqrt(variance * np.diag(np.linalg.inv(design.T @ design))))


def test_without_redundancy_there_is_no_sigma_and_without_parameters_nothing_to_solve() -> None:
    square = solve_linear(np.eye(3) + 0.1, np.arange(3.0))
    np.testing.assert_allclose((np.eye(3) + 0.1) @ square.values, np.arange(3.0), atol=1e-14)
    assert math.isnan(square.sigma0)
    assert solve_linear(np.ones((2, 1)), np.array([1.0, 3.0])).sigma0 == pytest.approx(math.sqrt(2.0))
    empty = solve_linear(np.zeros((4, 0)), np.arange(4.0))
    assert (empty.values.shape, empty.cofactors.shape, empty.condition) == ((0,), (0, 0), 1.0)
    np.testing.assert_array_equal(empty.residuals, np.arange(4.0))
    assert empty.sigma0 == pytest.approx(math.sqrt(14.0 / 4))


@pytest.mark.parametrize(
    "design",
    [
        np.ones((2, 3)), np.column_stack([np.arange(5.0), 2 * np.arange(5.0)]),
        np.column_stack([np.ones(5), np.zeros(5)]),
        np.array([[1.0, 0.0], [1.0, np.nan], [0.0, 1.0]]), np.array([[1.0, 0.0], [np.inf, 0.0], [0.0, 1.0]]),
    ],
    ids=["few rows", "parallel", "a zero column", "nan", "inf"],
)  # fmt: skip
def test_what_is_not_determined_is_nan(design: np.ndarray) -> None:
    found = solve_linear(design, np.ones(len(design)))
    assert np.isnan(found.values).all()
    assert np.isnan(found.residuals).all()
    assert np.isnan(found.cofactors).all()
    assert found.values.shape == (design.shape[1],)
    assert found.condition == math.inf
    assert condition_of(design) > 1e15


def test_the_solution_of_a_nearly_singular_system_has_nearly_all_digits() -> None:
    """Hilbert's columns, whose right side is their exact sum: refined in extended precision it is found."""
    design = 1.0 / (np.arange(10)[:, None] + np.arange(7) + 1.0)
    design = np.round(design * 2**20) / 2**20
    found = solve_linear(design, design.sum(axis=1))
    np.testing.assert_allclose(found.values, 1.0, rtol=1e-10)
    assert found.condition == pytest.approx(np.linalg.cond(design / np.linalg.norm(design, axis=0)), rel=1e-3)


def valley(x: np.ndarray) -> np.ndarray:
    """Return residuals of which only the first parameter is seen, by a curve whose bottom is never reached."""
    return np.array([np.exp(-x[0]), np.exp(-x[0]) / 2, 0.0])


def slopes(x: np.ndarray) -> np.ndarray:
    return np.array([[np.exp(-x[0]), 0.0], [np.exp(-x[0]) / 2, 0.0], [0.0, 0.0]])


def test_a_flat_valley_is_left_to_the_caller_and_anything_else_did_not_converge(monkeypatch) -> None:
    """Steps that get nowhere: with a parameter that nothing determines they are returned, else it is an error."""
    monkeypatch.setattr(least_squares, "_levenberg_marquardt", lambda residuals, slopes, params: (params + 1.0, False))
    found = minimise(valley, slopes, np.array([0.5, 7.0]))
    np.testing.assert_array_equal(found, [1.5, 8.0])
    one = (lambda x: np.array([1.0 + x[0] ** 2, 2.0]), lambda x: np.array([[-1.0], [1e-3]]))
    with pytest.raises(NotConverged, match="did not converge"):
        minimise(*one, np.array([3.0]))
    # A condition of 1 is worse than the limit that the caller gives.
    np.testing.assert_array_equal(minimise(*one, np.array([3.0]), singular=0.5), [4.0])


def test_steps_are_halved_until_they_help() -> None:
    """The plain step for arctan x = 0 from 3 goes to -9.5 and beyond; the halved ones end at the root."""
    calls: list[float] = []

    def residuals(x: np.ndarray) -> np.ndarray:
        calls.append(float(x[0]))
        return -np.arctan(x)

    found = minimise(residuals, lambda x: np.array([[1 / (1 + x[0] ** 2)]]), np.array([3.0]))
    assert abs(found[0]) < 1e-9
    first = 3.0 - np.arctan(3.0) * 10.0
    np.testing.assert_allclose(calls[:3], [3.0, first, (3.0 + first) / 2])


def test_a_start_outside_of_the_domain_does_not_converge() -> None:
    with pytest.raises(NotConverged):
        minimise(lambda x: np.array([np.nan, 1.0]), lambda x: np.ones((2, 1)), np.array([1.0]))


def test_a_step_into_nothing_is_halved() -> None:
    """Beyond 2 the model projects nothing; the root of x squared minus 3 is found from below."""

    def residuals(x: np.ndarray) -> np.ndarray:
        return 3.0 - x**2 if x[0] < 2.0 else np.array([np.nan])

    found = minimise(residuals, lambda x: np.array([2.0 * x]), np.array([0.2]))
    assert found[0] == pytest.approx(math.sqrt(3.0), rel=1e-12)
