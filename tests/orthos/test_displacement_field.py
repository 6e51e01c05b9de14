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
