"""What points do not determine: the worst corner, condition and correlations, by hand."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import DegeneratePoints
from ortho_pipeline.estimation.determinacy import corner_ratio_of, nothing_adjusted, uncertain_edge, unstable
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.estimation.problem import Solution
from ortho_pipeline.models import ImageCorrection, MapPlane
from ortho_pipeline.points import Points

PLANE = MapPlane("EPSG:32633", (5e5, 4.64e6), (1.0, 1.0), (900, 800), 100.0, (0.0, 0.0), (0.0, 500.0))


class Model:
    """Two parameters, whose partials at four corners are given."""

    kind, param_names, params = "made", ("one", "two"), np.zeros(2)
    corners = np.zeros((4, 3))

    def __init__(self, partials: Any, count: int = 2) -> None:
        self.partials, self.params = np.array(partials, dtype=float), np.zeros(count)

    def param_partials(self, ground: np.ndarray) -> np.ndarray:
        return self.partials


def solution(
    model: Any, count: int = 6, sigma: float = 0.5, condition: float = 10.0, cofactors: Any = None
) -> Solution:
    roots = np.broadcast_to(sigma * np.eye(2), (count, 2, 2)).copy()
    cofactors = np.diag([0.04, 0.09]) if cofactors is None else np.array(cofactors)
    return Solution(
        model, np.zeros((count, 2, 2)), np.zeros((count, 2)), ImageErrors(roots), cofactors, 10.0, 1.5, 1.0, condition,
        np.full(count, -1),
    )  # fmt: skip


def partials(*scales: float) -> np.ndarray:
    """Return partials of corners: the column by the first parameter, the row by the second, as large as stated."""
    return np.array([scale * np.eye(2) for scale in scales])


def test_the_worst_corner_counts_relative_to_a_measured_point() -> None:
    """Sigmas of 0.2 and 0.3 at scale 5 make 1.5 px in rows; a point has 0.5 px."""
    assert corner_ratio_of(solution(Model(partials(1, 2, 5, 3))), "a.csv", None) == pytest.approx(3.0)
    unseen = partials(1, 2, 5, 3)
    unseen[2] = np.nan
    assert corner_ratio_of(solution(Model(unseen)), "a.csv", None) == pytest.approx(1.8)


def test_without_points_or_parameters_no_corner_is_uncertain() -> None:
    assert corner_ratio_of(solution(Model(partials(1, 2, 5, 3)), count=0), "a.csv", None) == 0.0
    assert corner_ratio_of(solution(Model(np.zeros((4, 2, 0)), 0), cofactors=np.zeros((0, 0))), "a.csv", None) == 0.0


@pytest.mark.parametrize(("scale", "refused"), [(166.0, False), (167.0, True)])
def test_a_corner_a_hundred_times_as_uncertain_is_refused_unless_the_user_regularised(scale, refused) -> None:
    made = solution(Model(partials(1, scale, 1, 1)))
    if refused:
        with pytest.raises(DegeneratePoints, match=r"100 times as uncertain"):
            corner_ratio_of(made, "a.csv", None)
    else:
        assert corner_ratio_of(made, "a.csv", None) == pytest.approx(99.6)
    assert corner_ratio_of(made, "a.csv", 0.1) == pytest.approx(0.6 * scale)


def test_a_model_that_projects_no_corner_is_of_unknown_uncertainty() -> None:
    made = solution(Model(np.full((4, 2, 2), np.nan)))
    with pytest.raises(DegeneratePoints, match="unknown"):
        corner_ratio_of(made, "a.csv", None)
    assert corner_ratio_of(made, "a.csv", 0.1) == math.inf
    one = partials(1, 2, 5, 3)
    one[:3] = np.nan
    assert corner_ratio_of(solution(Model(one)), "a.csv", None) == pytest.approx(1.8)


def test_a_corner_is_noted_from_ten_times_on() -> None:
    assert uncertain_edge(10.0) == []
    (note,) = uncertain_edge(10.1)
    assert (note.code, "10 times" in str(note)) == ("uncertain-at-edge", True)


def test_a_condition_of_ten_thousand_is_stable() -> None:
    made = [solution(Model(partials(1)), condition=value) for value in (1e4, 1.1e4)]
    assert unstable(made[0], None) == []
    assert unstable(made[0], 0.5) == []
    (note,) = unstable(made[1], None)
    assert "1e+04" in str(note)
    (held,) = unstable(made[1], 0.5)
    assert "only 1.5 of 2 parameters" in str(held)


@pytest.mark.parametrize(("correlation", "noted"), [(0.9994, False), (0.9996, True), (-0.9996, True)])
def test_parameters_that_cannot_be_separated_are_named(correlation: float, noted: bool) -> None:
    root = np.diag([0.2, 0.3])
    made = solution(Model(partials(1)), cofactors=root @ [[1.0, correlation], [correlation, 1.0]] @ root)
    found = unstable(made, None)
    assert [note.code for note in found] == ["inseparable-parameters"] * noted
    if noted:
        assert "1 pair of parameters" in str(found[0])
        assert "one and two" in str(found[0])


def test_a_model_without_parameters_is_noted_if_it_was_to_be_adjusted() -> None:
    points = Points.of([[1, 2]], [[500_000.0, 4.64e6, 10.0]], pyproj.CRS("EPSG:32633"))
    assert PLANE.param_names
    assert nothing_adjusted(PLANE, points) == []
    assert nothing_adjusted(ImageCorrection.identity(PLANE, "none", (0.0, 0.0)), points) == []

    class Fixed(Model):
        param_names = ()  # type: ignore[assignment]

    (note,) = nothing_adjusted(Fixed(partials(1)), points)  # type: ignore[arg-type]
    assert "'made' has no parameters" in str(note)
    both = Points.of([[1, 2]] * 2, [[500_000.0, 4.64e6, 10.0]] * 2, pyproj.CRS(32633), roles=["check", "control"])
    assert len(nothing_adjusted(Fixed(partials(1)), both)) == 1  # type: ignore[arg-type]
    tie = Points.of([[1, 2]], [[500_000.0, 4.64e6, 10.0]], pyproj.CRS("EPSG:32633"), roles=["check"])
    assert nothing_adjusted(Fixed(partials(1)), tie) == []  # type: ignore[arg-type]


def test_a_variant_that_contradicts_the_points_does_not_refuse_the_other_one() -> None:
    random = np.random.default_rng(8)
    u, v, w = random.uniform(-1.0, 1.0, (3, 26))
    image = np.column_stack([900 * u + 60 * w + 60 * u * v, -900 * v + 30 * w + 60 * u * u])
    ground = np.column_stack([500e3 + 900 * u, 4e6 + 900 * v, 500 + 200 * w])
    points = Points.of(image + random.normal(0.0, 0.3, (26, 2)), ground, "EPSG:32636", sigma_image=0.3)
    with pytest.raises(DegeneratePoints, match="8 of 26 control points contradict"):
        fit_family("affine14-col", points)
    assert fit_family("affine14", points).model_name == "affine14-row"
