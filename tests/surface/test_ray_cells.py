"""Steps of a ray in a cell of a DEM: Newton's, over free squares, and to the first meeting, against plain algebra."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from ortho_pipeline.surface import ray_kernel
from ortho_pipeline.surface.ray_kernel import BLOCK, BoundedHeights

ROWS = {name: getattr(ray_kernel, f"_{name}") for name in ("T", "MISS", "FX", "FY", "H00", "H10", "H01", "H11")}
MIDDLE, HALF, TOLERANCE = 5.0, 20.0, 0.5


def block(cases: list[dict[str, Any]]) -> np.ndarray:
    """Return a workspace with these rays first; the others are on level ground at a height of 0."""
    work = np.zeros((ray_kernel._ROWS, BLOCK))
    work[ROWS["MISS"]] = np.inf
    for name in ("H00", "H10", "H01", "H11"):
        work[ROWS[name]] = MIDDLE
    for k, case in enumerate(cases):
        for name, value in case.items():
            work[ROWS[name] if name in ROWS else int(name[1:]), k] = value
    return work


def level(height: float) -> dict[str, float]:
    return dict.fromkeys(("H00", "H10", "H01", "H11"), height)


def test_newtons_step_is_along_the_slope_of_the_cell() -> None:
    """Coefficients 1 and 3 of u and v are half of the way from -1 to 1."""
    corners = {"H00": 10.0, "H10": 13.0, "H01": 8.0, "H11": 16.0}
    cases = [
        {"T": 0.4, "FX": 0.25, "FY": 0.6, **corners, "c1": 1.5, "c2": 9, "c3": 0.25, "c6": -0.75, "c8": 0.125, "c9": 3},
        # No higher and no lower than the range.
        {"T": 0.9, **level(65.0)}, {"T": -0.5, **level(-60.0)},
        # Near enough: a last step of less than a hundredth of a sample is made, a longer one is not.
        {"T": 0.0, **level(4.75), "c1": 0.5, "c6": -0.2}, {"T": 0.0, **level(4.75), "c1": 0.6, "c6": -0.3},
        # Found before.
        {"T": 0.3, "MISS": 0.1, **level(0.0)},
        # At the tolerance, which is near enough.
        {"T": 0.025, "c1": 0.2, "c6": -0.1},
        # Beside a void.
        {"T": 0.3, **level(np.nan)},
    ]  # fmt: skip
    work = block(cases)
    assert ray_kernel._improve(work, MIDDLE, HALF, TOLERANCE) == 4

    def miss(by: float) -> float:
        x, y = 0.25 + 1.75 * by, 0.6 - 0.625 * by
        ground = (10 * (1 - x) + 13 * x) * (1 - y) + (8 * (1 - x) + 16 * x) * y
        return float(MIDDLE + HALF * (0.4 + by) - ground)

    slope = (miss(1e-4) - miss(-1e-4)) / 2e-4
    expected = [0.4 - miss(0.0) / slope, 1.0, -1.0, -0.0125, 0.0, 0.3, 0.0, 0.3]
    np.testing.assert_allclose(work[ROWS["T"], :8], expected, atol=1e-7)
    found = [abs(miss(0.0)), 42.0, 55.0, 0.25, 0.25, 0.1, 0.5, np.nan]
    np.testing.assert_allclose(work[ROWS["MISS"], :8], found, atol=1e-12)
    assert not work[ROWS["T"], 8:].any()


def test_the_largest_square_below_a_ray_is_free() -> None:
    """And how far down it is to its highest sample, and a tenth of a millimetre."""
    random = np.random.default_rng(3)
    heights = np.cumsum(np.cumsum(random.normal(0, 1, (36, 51)), axis=0), axis=1)
    middle, half = float(heights.mean()), float(np.ptp(heights))
    terrain = ray_kernel.terrain_of(heights, 4, -2, middle, half, np.zeros((1, 10)))
    kinds = set()
    for _ in range(300):
        j, i, coarse = int(random.integers(35)), int(random.integers(50)), int(random.integers(3, 7))
        height = heights[j, i] + random.choice([-1, 1]) * random.exponential(half / 6)
        bits, drop = ray_kernel._free(terrain, i, j, (height - middle) / half, coarse)
        expected, top = 0, np.inf
        for size in range(3, coarse + 1):
            row, column = j >> size << size, i >> size << size
            highest = heights[row : row + 2**size + 1, column : column + 2**size + 1].max()
            if highest + 1e-4 < height:
                expected, top = size, highest
        kinds.add(expected)
        assert bits == expected
        if expected:
            assert drop * half == pytest.approx(height - top - 1e-4, abs=1e-6)
    assert kinds == {0, 3, 4, 5, 6}


def terrain_with(corners: np.ndarray) -> BoundedHeights:
    """Return 4 x 4 samples from (4, -2) on with these in the middle, the others far below."""
    heights = np.full((4, 4), -1e3)
    heights[1:3, 1:3] = corners
    return BoundedHeights(heights, 4.0, -2.0, MIDDLE, HALF, None, None, 0.0)


def clearances(corners: np.ndarray, ends: np.ndarray, heights: tuple[float, float], share: Any) -> Any:
    """Return how far a ray is above a cell at shares of its way between two places ``(2, 2)`` and heights."""
    share = np.asarray(share)
    (x, y), height = ends[0, :, None] + share * (ends[1] - ends[0])[:, None], np.interp(share, [0, 1], heights)
    (h00, h10), (h01, h11) = corners
    return height - ((h00 * (1 - x) + h10 * x) * (1 - y) + (h01 * (1 - x) + h11 * x) * y)


def test_a_ray_first_meets_a_cell_at_the_first_root_of_a_quadratic() -> None:
    """From one place in the cell down to another; the clearance between is a polynomial of degree two.

    Every other cell is a saddle, high or almost level, which a flat ray meets and leaves again.
    """
    random, tolerance, kinds = np.random.default_rng(5), 1e-4, [0, 0, 0]
    for number in range(600):
        corners, ends = random.normal(12, 12, (2, 2)), random.uniform(0.02, 0.98, (2, 2))
        begin, after = 0.6, float(random.uniform(0.3, 0.57))
        if number % 2:
            size = 1.0 if number % 4 == 1 else 0.02
            corners = random.normal(17, size, (2, 2)) + random.exponential(8 * size) * np.array([[-1, 1], [1, -1]])
            ends, after = (
                random.uniform([[0.02], [0.8]], [[0.2], [0.98]], (2, 2)),
                0.6 - size * random.uniform(0.01, 0.1),
            )
        slope, curve = (ends[0] - ends[1]) / (begin - after), np.zeros(10)
        curve[[1, 6]], curve[[0, 5]] = slope, ends[0] + (5.0, -1.0) - slope * begin
        heights = MIDDLE + HALF * begin, MIDDLE + HALF * after
        above, half_way, below = clearances(corners, ends, heights, [0.0, 0.5, 1.0]).tolist()
        parabola = np.polyfit([0.0, 0.5, 1.0], [above, half_way, below], 2)
        least = np.polyval(parabola, -parabola[1] / (2 * parabola[0]))
        if above < 1e-3 or min(abs(below), abs(least)) < 1e-3:
            continue  # it begins on the terrain, or nearly touches it
        roots = sorted(root.real for root in np.roots(parabola) if root.imag == 0 and 0 < root.real < 1)
        found = ray_kernel._crossed(
            curve, terrain_with(corners), 1, 1, *(-slope).tolist(), begin, above, after, below, tolerance
        )
        kinds[len(roots)] += 1
        if not roots:
            assert found == np.inf
            continue
        share = (begin - found) / (begin - after)
        assert abs(clearances(corners, ends, heights, [share])[0]) <= 1.001 * tolerance
        assert abs(share - roots[0]) == min(abs(share - root) for root in roots)
    assert min(kinds) > 5


def test_next_to_a_void_the_ray_is_above_its_own_cell() -> None:
    """On the border of both, and elsewhere above the terrain where it is."""
    terrain = terrain_with(np.array([[1.0, 3.0], [2.0, 8.0]]))
    terrain.heights[:, 3] = np.nan
    curve = np.zeros(10)
    curve[[0, 5]] = 4.0 + 2.0, -2.0 + 1.25  # at its column 2, row 1.25: 3 + (8 - 3) / 4
    assert ray_kernel._clearance(curve, terrain, 1, 1, 0.3) == pytest.approx(5 + 6 - 4.25)
    curve[[0, 5]] = 4.0 + 1.5, -2.0 + 1.5
    assert ray_kernel._clearance(curve, terrain, 0, 0, -0.3) == pytest.approx(5 - 6 - 3.5)
    curve[0] = 4.0 + 2.5
    # In the void: 1 + 2 * 1.5 in the upper row of the cell before it, 2 + 6 * 1.5 in the lower one.
    assert ray_kernel._clearance(curve, terrain, 1, 1, 0.0) == pytest.approx(5 - 7.5)


@pytest.mark.parametrize("place", [(2.25, 2.75), (3.0, 3.0), (3.0, 0.5), (0.5, 3.0), (3.5, -0.25)])
def test_the_terrain_at_the_last_samples_and_beyond_is_that_of_the_nearest_cell(place: tuple[float, float]) -> None:
    heights = np.random.default_rng(4).uniform(0, 9, (4, 4))
    terrain = terrain_with(np.zeros((2, 2)))
    terrain.heights[:] = heights
    curve = np.zeros(10)
    curve[[0, 5]] = 4.0 + place[0], -2.0 + place[1]
    i, j = (min(max(int(at), 0), 2) for at in place)
    x, y = place[0] - i, place[1] - j
    cell = heights[j : j + 2, i : i + 2]
    expected = np.array([1 - y, y]) @ cell @ np.array([1 - x, x])
    assert ray_kernel._clearance(curve, terrain, 0, 0, 0.3) == pytest.approx(MIDDLE + HALF * 0.3 - expected)
