"""Poses that an adjustment moves by more than their stated accuracy: RTK of 2 cm that is wrong by metres."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.reliability.poses import contradicted_poses
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.models.frame.orientation import EXTERIOR

ACCURACIES = np.array([0.02, 0.02, 0.04, 0.05, 0.05, 0.05])


def told(moved: np.ndarray, sigmas: np.ndarray = ACCURACIES, held: bool = False) -> list[Notice]:
    """Return the notices of images whose poses changed so much ``(n, 6)`` from known ones."""
    count = len(moved)
    known = np.random.default_rng(9).normal(0, 100, moved.shape)
    sigmas = np.broadcast_to(sigmas, moved.shape)
    fit = SimpleNamespace(
        models={f"p{k}": SimpleNamespace(params=known[k] + moved[k]) for k in range(count)},
        parameters=[(f"p{k}", name) for k in range(count) for name in EXTERIOR],
    )
    pseudo = [
        Pseudo(6 * k + j, float(known[k, j]), float(sigmas[k, j]), held=held) for k in range(count) for j in range(6)
    ]
    return contradicted_poses(fit, pseudo)  # type: ignore[arg-type]


def changes(seed: int, count: int = 6) -> np.ndarray:
    return np.random.default_rng(seed).normal(0, 1, (count, 6)) * ACCURACIES


def test_changes_within_their_accuracies_are_not_told():
    # One in 3,300 would be: three tests, each of one in 10,000.
    assert sum(len(told(changes(seed))) for seed in range(300)) == 0


def test_positions_or_angles_that_move_farther_are_told_with_both_sizes():
    factors = np.array([10.0, 10.0, 10.0, 1.0, 1.0, 1.0])
    for one, axes, what in zip(
        told(changes(1) * factors), ([0, 1], [2]), ("positions in plan", "heights"), strict=True
    ):
        assert (one.code, one.fields["what"], one.fields["count"]) == ("poses-contradicted", what, 6)
        apart = (changes(1) * factors)[:, axes]
        rms = np.sqrt(np.mean((apart - apart.mean(axis=0)) ** 2))
        assert np.isclose(one.fields["rms"], rms)
        assert np.isclose(one.fields["sigma"], np.sqrt(np.mean(ACCURACIES[axes] ** 2)))
        assert f"{what} of 6 images" in str(one)
    (one,) = told(changes(1) * factors[::-1])
    assert (one.fields["what"], one.fields["unit"]) == ("angles", "°")
    assert np.isclose(one.fields["sigma"], np.degrees(0.05))
    apart = (changes(1) * factors[::-1])[:, 3:]
    assert np.isclose(one.fields["rms"], np.degrees(np.sqrt(np.mean((apart - apart.mean(axis=0)) ** 2))))


def test_an_error_that_all_images_share_is_none_of_their_accuracy():
    assert told(changes(2) + 50 * ACCURACIES) == []


def test_accuracies_of_images_count_by_themselves():
    """One image without a fixed RTK solution states metres, and is off by metres."""
    sigmas = np.tile(ACCURACIES, (6, 1))
    sigmas[3, :3] = 2.0
    moved = changes(3)
    moved[3, :3] = [2.5, -1.5, 2.0]
    assert told(moved, sigmas) == []
    assert [one.fields["what"] for one in told(moved)] == ["positions in plan", "heights"]


def test_heights_of_an_unknown_datum_do_not_hide_the_accuracy_in_plan():
    """Their 50 m would be named as the accuracy that a change of a metre contradicts."""
    sigmas = np.array([0.02, 0.02, 50.0, 0.05, 0.05, 0.05])
    (one,) = told(changes(1) * [50, 50, 1, 1, 1, 1], sigmas)
    assert one.fields["what"] == "positions in plan"
    assert one.fields["rms"] > 0.5
    assert np.isclose(one.fields["sigma"], 0.02)


def test_what_defines_a_datum_and_a_pose_alone_contradict_nothing():
    assert told(100 * changes(4), held=True) == []
    assert told(100 * changes(4, count=1)) == []


@pytest.mark.parametrize(("part", "named"), [(0.985, []), (1.015, ["positions in plan"])])
@pytest.mark.parametrize("images", [2, 5])
def test_poses_contradict_at_a_chance_of_one_in_ten_thousand(images: int, part: float, named: list[str]) -> None:
    """Along each of two axes, changes without their mean have a degree of freedom less than images."""
    moved = np.random.default_rng(5).normal(0, 1, (images, 6)) * [1, 1, 0, 0, 0, 0]
    moved -= moved.mean(axis=0)
    square = stats.chi2.isf(1e-4, 2 * (images - 1))
    moved *= part * np.sqrt(square / (moved**2).sum())
    assert [one.fields["what"] for one in told(moved * ACCURACIES)] == named
