"""Gains and offsets of a mosaic against dense least squares: the datum, the prior, robust weights, the start."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import null_space

from ortho_pipeline.warp.mosaic.balance import _line, _solved, _start, _step


def dense(ends: np.ndarray, values: np.ndarray, weight: np.ndarray, groups: list[list[int]]) -> np.ndarray:
    """Return gains and offsets ``(layers, 2)`` by least squares over what keeps gains of mean 1, offsets of mean 0.

    Each gain is held to 1 with a standard deviation of 0.5, each offset to 0 with one of 1.
    """
    count = sum(len(group) for group in groups)
    design = np.zeros((len(values), 2 * count))
    for row, ((i, j), (first, second)) in enumerate(zip(ends, values, strict=True)):
        design[row, 2 * i : 2 * i + 2] += [first, 1.0]
        design[row, 2 * j : 2 * j + 2] -= [second, 1.0]
    datum = np.zeros((2 * len(groups), 2 * count))
    for k, group in enumerate(groups):
        datum[2 * k, [2 * layer for layer in group]] = 1.0
        datum[2 * k + 1, [2 * layer + 1 for layer in group]] = 1.0
    free, plain, held = null_space(datum), np.tile([1.0, 0.0], count), np.diag(np.tile([2.0, 1.0], count))
    root = np.sqrt(weight)[:, None]
    system = np.vstack([root * design, held]) @ free
    right = np.concatenate([-(root * design) @ plain, np.zeros(2 * count)])
    return np.asarray((plain + free @ np.linalg.lstsq(system, right, rcond=None)[0]).reshape(-1, 2))


def test_a_step_is_weighted_least_squares_under_the_datum_of_each_connected_part() -> None:
    """Layers 0, 2 and 4 overlap, 1 and 5 do, and 3 overlaps nothing. The weights are small: the prior counts."""
    random = np.random.default_rng(2)
    ends = np.array([[0, 2], [2, 4], [0, 4], [1, 5], [1, 5]]).repeat(3, axis=0)
    values, weight = random.normal(0.3, 1.2, (15, 2)), random.uniform(0.2, 2.5, 15)
    found = _step(ends, values, weight, 6).reshape(-1, 2)
    np.testing.assert_allclose(found, dense(ends, values, weight, [[0, 2, 4], [1, 5], [3]]), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found[3], [1.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("seed", [1, 4])
def test_the_solution_agrees_with_the_weights_of_its_own_residuals(seed: int) -> None:
    """Tukey's weights at 4.685 standard deviations, from the median of the residuals; a fifth of the cells changed."""
    random = np.random.default_rng(seed)
    true = np.array([[1.2, 30.0], [0.9, -14.0], [0.7, 8.0]])
    ends = np.array([[0, 1], [1, 2], [0, 2]]).repeat([90, 50, 130], axis=0)
    ground = random.gamma(3.0, 40.0, len(ends))
    cells = (ground[:, None] - true[ends, 1]) / true[ends, 0] + random.normal(0, 4.0, (len(ends), 2))
    cells[::5, 1] += random.uniform(10.0, 120.0, len(cells[::5]))
    gains, offsets, good = _solved(ends, cells, 3)
    middle, spread = np.median(cells), cells.std()
    values, shifts = (cells - middle) / spread, (offsets - middle * (1 - gains)) / spread
    one, other = (gains[ends[:, k]] * values[:, k] + shifts[ends[:, k]] for k in (0, 1))
    scale = 1.4826 * np.median(np.abs(one - other))
    ratio = (one - other) / (4.685 * scale)
    weight = np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)
    np.testing.assert_array_equal(good, weight > 0)
    assert 0.03 < 1 - good.mean() < 0.25
    wanted = dense(ends, values, weight / scale**2, [[0, 1, 2]])
    np.testing.assert_allclose(np.column_stack([gains, shifts]), wanted, atol=1e-5)


def test_the_start_is_the_weighted_mean_of_the_lines_of_all_overlaps() -> None:
    """Of three layers whose ratios of gains do not close: each line counts by its cells over its squared scatter."""
    random = np.random.default_rng(6)
    pairs, counts = [(0, 1), (0, 2), (1, 2)], [60, 35, 80]
    ends = np.array(pairs).repeat(counts, axis=0)
    second = random.normal(0, 1, len(ends))
    slope, apart, noise = (np.repeat(some, counts) for some in ([1.4, 0.8, 1.1], [0.3, -0.2, 0.7], [0.05, 0.1, 0.02]))
    values = np.column_stack([slope * second + apart + noise * random.normal(size=len(ends)), second])
    order = random.permutation(len(ends))
    found = _start(ends[order], values[order], 3).reshape(-1, 2)
    cells = [values[order][(ends[order] == pair).all(axis=1)].T for pair in pairs]
    lines = np.array([_line(*pair) for pair in cells])
    root = np.sqrt(np.array(counts)) / lines[:, 1]
    design = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0], [0.0, -1.0, 1.0]])

    def adjusted(differences: np.ndarray) -> np.ndarray:
        solution = np.linalg.lstsq(root[:, None] * design, root * differences, rcond=None)[0]
        return np.asarray(solution - solution.mean())

    gains = np.exp(adjusted(np.log(lines[:, 0])))
    np.testing.assert_allclose(found[:, 0], gains, rtol=1e-6)
    between = [np.median(gains[i] * pair[0] - gains[j] * pair[1]) for (i, j), pair in zip(pairs, cells, strict=True)]
    np.testing.assert_allclose(found[:, 1], adjusted(np.array(between)), atol=1e-6)


def test_a_line_of_many_cells_is_through_four_hundred_of_them() -> None:
    """All cells between the evenly spread ones are changed: none of them counts."""
    chosen = np.linspace(0, 1999, 400).astype(int)
    second = np.random.default_rng(3).normal(size=2000)
    first = 9.0 - 2.0 * second
    first[chosen] = 0.7 * second[chosen] - 0.4
    assert _line(first, second) == (pytest.approx(0.7), 0.01)
