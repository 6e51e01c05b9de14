"""Map scales against the figures of the standards themselves."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.estimation.fit import Fit, fit
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.points import Points
from ortho_pipeline.report.map_scale import judge, map_scale, nmas_limit
from ortho_pipeline.simulation.scanner import LineScanner, simulate_points
from ortho_pipeline.simulation.terrain import Terrain

CAMERA = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=20.0, heights=(650.0, 1350.0))
TERRAIN = Terrain("EPSG:32636", 531100.0, 4122700.0)


def points(control: int, check: int) -> Points:
    return simulate_points(CAMERA, TERRAIN, control=control, check=check, seed=5).measured


def adjusted(measured: Points, correction: str = "shift") -> Fit:
    return fit(ImageCorrection(CAMERA, correction, (500.0, 500.0), np.zeros(6)), measured)


def errors(count: int, rmse: float, seed: int = 0) -> np.ndarray:
    """Return errors (m) whose RMSE of both axes together is exactly this."""
    drawn = np.random.default_rng(seed).normal(0, 1, (count, 2))
    return drawn * rmse / np.sqrt((drawn**2).sum(axis=1).mean())


def test_the_papers_example():
    # OrbView-3: pixels of 1 m are good for 1 : 10,000, where 2.5 m are sufficient.
    found = judge(errors(34, 2.5), "check", 1.0)
    assert (found.paper_scale, found.limited_by) == (10_000, "accuracy")
    assert (judge(errors(34, 0.5), "check", 1.0).paper_scale, judge(errors(34, 0.5), "check", 1.0).limited_by) == (
        10_000, "pixel",
    )  # fmt: skip
    assert judge(errors(34, 2.51), "check", 1.0).paper_scale == 20_000
    assert judge(errors(34, 0.5), "check", 0.2).paper_scale == 2000


@pytest.mark.parametrize(
    ("scale", "metres"),
    # Fact Sheet 171-99 of the US Geological Survey, in feet.
    [(12_000, 33.3 * 0.3048), (24_000, 40 * 0.3048), (100_000, 166.7 * 0.3048)],
)
def test_limits_of_nmas_are_those_that_the_survey_publishes(scale, metres):
    assert nmas_limit(scale) == pytest.approx(metres, rel=2e-3)


def test_nmas_counts_points():
    # Of 20 points two may be off by more than 8.47 m at 1 : 10,000, not three.
    off = np.zeros((20, 2))
    off[:2] = (30.0, 0.0)
    assert judge(off, "check", None).nmas_scale == 100
    off[2] = (0.0, 8.4)
    assert judge(off, "check", None).nmas_scale == 10_000
    # The step of the rule: 9 m are too much for 1 : 10,000 and pass 1 : 20,000 (10.2 m), 12 m wait for 1 : 25,000.
    for metres, scale in ((9.0, 20_000), (12.0, 25_000), (15.0, 50_000)):
        off[2] = (0.0, metres)
        assert judge(off, "check", None).nmas_scale == scale
    assert judge(np.full((9, 2), 1e6), "check", None).nmas_scale is None


def test_asprs_class_has_the_survey_in_it_and_is_claimed_from_thirty_on():
    assert judge(errors(30, 0.30), "check", 0.5).class_cm == 30
    found = judge(errors(30, 0.30), "check", 0.5, survey=0.40)
    assert (found.class_cm, found.claim) == (50, True)
    few = judge(errors(29, 0.30), "check", 0.5)
    assert not few.claim
    assert "no claim" in few.statement
    assert "would be" in few.statement
    assert not judge(errors(200, 0.30), "loo", 0.5).claim


def test_the_evidence_is_named():
    check = map_scale(adjusted(points(12, 6)), 2.5)
    assert check is not None
    assert (check.evidence, check.n) == ("check", 6)
    # Their ground is stated to 0.1 m per axis.
    assert check.survey == pytest.approx(0.1 * np.sqrt(2))
    control = map_scale(adjusted(points(12, 0)), 2.5)
    assert control is not None
    assert (control.evidence, control.n, control.claim) == ("loo", 12, False)
    assert "No check points" in control.statement
    raw = map_scale(adjusted(points(40, 0), "none"), 2.5)
    assert raw is not None
    assert (raw.evidence, raw.n, raw.claim) == ("delivered", 40, True)
    assert map_scale(adjusted(points(1, 0)), 2.5) is None
    assert map_scale(adjusted(points(1, 0).select([False]), "none"), 2.5) is None
