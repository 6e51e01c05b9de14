"""The displacement field of matches: what it states of its mean contains the truth, also where chips share noise."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.estimation.spatial.displacement_field import DisplacementField
from ortho_pipeline.runtime.process_limits import one_blas_thread

CHIP, SIZE = 10, 60


@one_blas_thread()
def test_chips_that_overlap_do_not_count_as_independent():
    """Errors are means of white noise over chips, as those of least-squares matching are."""
    spread = []
    for seed in range(10):
        random = np.random.default_rng(seed)
        sums = np.zeros((SIZE + 1, SIZE + 1, 2))
        sums[1:, 1:] = random.normal(0, 1, (SIZE, SIZE, 2)).cumsum(axis=0).cumsum(axis=1)
        left, top = random.integers(0, SIZE - CHIP + 1, (2, 80))
        right, bottom = left + CHIP, top + CHIP
        value = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
        place = np.column_stack([left, top]) + CHIP / 2
        cells = np.stack(np.meshgrid(np.arange(5, 60, 10.0), np.arange(5, 60, 10.0)), axis=-1).reshape(-1, 2)
        means = DisplacementField.of(place, value / CHIP, side=float(CHIP)).draws(cells, seed).mean(axis=1)
        spread.append(means.mean(axis=0) / means.std(axis=0))
    assert 0.75 < np.sqrt(np.mean(np.square(spread))) < 1.25


def test_a_field_does_not_depend_on_where_coordinates_begin():
    """Places in a projected CRS are millions; their differences are what counts."""
    random = np.random.default_rng(2)
    place = random.uniform(0, 4000, (60, 2))
    value = np.column_stack([np.sin(place[:, 0] / 900), np.cos(place[:, 1] / 700)]) + random.normal(0, 0.1, (60, 2))
    sigma, cells = random.uniform(0.5, 2.0, 60), random.uniform(0, 4000, (20, 2))
    here, there = (
        DisplacementField.of(place + begin, value, sigma, 50.0).draws(cells + begin, 1)
        for begin in (np.zeros(2), np.array([500_000.0, 4_000_000.0]))
    )
    np.testing.assert_allclose(there.mean(axis=0), here.mean(axis=0), atol=1e-3)
    np.testing.assert_allclose(there.std(axis=0), here.std(axis=0), rtol=1e-2)
