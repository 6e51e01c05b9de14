"""Drawn pairs of known truth: what `ortho verify` states of them covers the truth, and no result is wrong."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from drawn_trials import STATISTICS, told, trial

pytestmark = pytest.mark.slow
#: The first of the seeds that test; others calibrated the method (`benchmarks/ortho_pairs.py` has many).
SEEDS = range(5000, 5012)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    found = [trial(seed, elsewhere=False) for seed in SEEDS]
    print("\n".join(json.dumps(row) for row in found))
    print(told(found))
    return [row for row in found if "refused" not in row]


def test_most_pairs_are_measured_and_no_result_is_wrong(rows):
    assert len(rows) >= 0.75 * len(SEEDS)
    assert not any(row["wrong"] for row in rows)


def test_the_displacement_is_known_to_a_twentieth_of_a_pixel(rows):
    assert np.median([row["field_error"] for row in rows]) <= 0.05


def test_intervals_cover_the_truth(rows):
    covered = [row[name]["covers"] for row in rows for name in STATISTICS]
    assert np.mean(covered) >= 0.85


def test_other_places_are_refused():
    assert all("refused" in trial(seed, elsewhere=True) for seed in range(7000, 7004))
