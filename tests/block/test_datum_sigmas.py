"""With which sigma parameters are held where no control defines the datum: by hand, at both sides of limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chains import ORIGIN, Block, Chain, fly, with_control

from ortho_pipeline.block import datum
from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.datum import _held, _missed, _pixels_per_metre, by_control, stated_accuracies, with_datum
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Misfits, Pseudo, Selection, State
from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.models import ImageCorrection

Prepared = tuple[BlockProblem, State, Selection]


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=15.0, overlap=0.7, ties=40, errors=2.0, pairwise=False), 8)


@pytest.fixture(scope="module")
def ties(flown: Block) -> Prepared:
    return _prepared(tuple(flown.start.values()), flown.points, {}, ())


@pytest.fixture(scope="module")
def control(flown: Block) -> Prepared:
    return _prepared(tuple(flown.start.values()), with_control(flown, "i1", count=5), {}, ())


def given(monkeypatch: pytest.MonkeyPatch, missed: float, per_metre: tuple[float, ...] = (0.5, 2.0, 1.25)) -> None:
    monkeypatch.setattr(datum, "_missed", lambda linear: missed)
    monkeypatch.setattr(datum, "_pixels_per_metre", lambda linear: np.array(per_metre))


def held(
    block: Prepared, hold: float | None = None, accuracies: dict[str, float] | None = None
) -> tuple[list[float], str]:
    """Return the sigma of each image (px), the same for both of its shifts, and the datum."""
    problem, gauge = with_datum(*block, hold, accuracies)
    assert [one.column for one in problem.pseudo] == list(range(6))
    assert all(one.held for one in problem.pseudo)
    assert [one.mean for one in problem.pseudo] == block[1].params.tolist()
    sigmas = [one.sigma for one in problem.pseudo]
    assert sigmas[::2] == pytest.approx(sigmas[1::2])
    return sigmas[::2], gauge


@pytest.mark.parametrize(("missed", "sigma"), [(0.0, 10.0), (9.0, 10.0), (12.5, 12.5)])
def test_images_are_held_within_ten_pixels_or_as_far_as_rays_miss(
    ties: Prepared, monkeypatch: pytest.MonkeyPatch, missed: float, sigma: float
) -> None:
    given(monkeypatch, missed)
    sigmas, gauge = held(ties)
    assert sigmas == pytest.approx([sigma] * 3)
    assert f"Assumed accuracy of the delivered models: sigma {10 if sigma == 10 else 12} px in the image" in gauge
    assert f"({sigma / 2:.2g} to {sigma / 0.5:.2g} m on the ground), for 6 of 6 parameters" in gauge.replace(".0", "")
    assert "the absolute accuracy depends on it" in gauge


def test_slow_errors_weigh_as_the_rays_miss_each_other(ties: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of a pixel, over how far rays miss each other, times the root mean square of the sigmas."""
    for missed, accuracies, typical in (
        (0.4, {}, 10.0), (4.0, {}, 10.0), (25.0, {}, 25.0),
        (2.0, {"i0": 6.0, "i2": 8.0}, math.sqrt((3.0**2 + 10.0**2 + 10.0**2) / 3)),
        (2.0, {"i0": 6.0, "i1": 2.0, "i2": 8.0}, math.sqrt((3.0**2 + 4.0**2 + 10.0**2) / 3)),
    ):  # fmt: skip
        given(monkeypatch, missed)
        problem, _ = with_datum(*ties, None, accuracies)
        assert [one.slow for one in problem.pseudo] == pytest.approx([0.1 * typical / max(missed, 1.0)] * 6)


@pytest.mark.parametrize(("missed", "sigmas", "said"), [
    (8.9, (3.0, 12.0, 10.0), "sigma 3 to 12 px"), (9.1, (10.0, 12.0, 10.0), "sigma 10 to 12 px"),
    (35.9, (35.9, 12.0, 35.9), "sigma 12 to 36 px"), (36.1, (36.1, 36.1, 36.1), "sigma 36 px"),
])  # fmt: skip
def test_a_stated_accuracy_counts_unless_rays_miss_by_more_than_three_of_it(
    ties: Prepared, monkeypatch: pytest.MonkeyPatch, missed: float, sigmas: tuple[float, ...], said: str
) -> None:
    """6 m at half a pixel per metre are 3 px, 6 m at two pixels per metre are 12 px; the third states nothing."""
    given(monkeypatch, missed)
    found, gauge = held(ties, None, {"i0": 6.0, "i1": 6.0})
    assert found == pytest.approx(sigmas)
    assert said in gauge
    trusted = sum(missed / 3 <= stated for stated in (3.0, 12.0))
    stated = {2: "the metadata of 2 images state 6 m", 1: "the metadata of 1 image state 6 m",
              0: f"not the accuracy of the metadata, because rays miss each other by {missed} px"}  # fmt: skip
    assert stated[trusted] in gauge
    assert ("Assumed" in gauge) is (trusted == 0)


def test_an_accuracy_of_all_images_is_that_of_the_metadata(ties: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    given(monkeypatch, 1.0)
    gauge = held(ties, None, {"i0": 6.0, "i1": 3.0, "i2": 4.0})[1]
    assert "the metadata state 3 to 6 m" in gauge
    assert "sigma 3 to 6 px in the image (3 to 6 m on the ground)" in gauge
    # How many metres a pixel has is not known of an image without points.
    given(monkeypatch, 1.0, (math.nan, 2.0, 4.0))
    assert "sigma 10 px in the image (2.5 to 5 m on the ground)" in held(ties)[1]


def test_a_given_sigma_comes_before_all_others(
    ties: Prepared, control: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    given(monkeypatch, 30.0)
    for block in (ties, control):
        sigmas, gauge = held(block, 0.5, {"i0": 6.0, "i1": 400.0})
        assert sigmas == pytest.approx([0.5] * 3)
        assert "Accuracy of the delivered models: sigma 0.5 px" in gauge
        assert "Assumed" not in gauge
    assert held(control, 0.5)[1].startswith("5 control points, and the orientation is held at its start values")
    assert [one.slow for one in with_datum(*control, 0.5)[0].pseudo] == [0.0] * 6
    for wrong in (0.0, -1.0, math.nan):
        with pytest.raises(InputError, match="must be positive"):
            with_datum(*ties, wrong)


def test_control_or_what_is_known_of_the_models_is_a_datum(flown: Block, ties: Prepared, control: Prepared) -> None:
    problem, gauge = with_datum(*control, None)
    assert problem is control[0]
    assert gauge == by_control(control[0], control[2]) == "position and height come from 5 control points"
    priors = tuple(Pseudo(column, 0.0, 3.0) for column in range(6))
    known = replace(ties[0], pseudo=priors)
    problem, gauge = with_datum(known, *ties[1:], None)
    assert problem is known
    assert gauge == "no control points: position and height come from the models as delivered"
    # Priors of one image leave the others open, which are held.
    some = replace(ties[0], pseudo=priors[:1])
    problem, gauge = with_datum(some, *ties[1:], None)
    assert [one.column for one in problem.pseudo] == list(range(6))
    assert [one.held for one in problem.pseudo] == [False] + [True] * 5
    assert "for 5 of 6 parameters" in gauge
    fixed = tuple(model.model for model in flown.start.values())
    none = replace(ties[0], models=fixed)
    assert with_datum(none, replace(ties[1], models=fixed), ties[2], None) == (
        none, "nothing is adjusted but the points: the models stay as they are",
    )  # fmt: skip


def test_heights_of_a_dem_leave_nothing_to_slow_errors(ties: Prepared) -> None:
    count = len(ties[0].points)
    planes = Planes(ties[1].local, np.tile(np.eye(3), (count, 1, 1)), np.full(count, 2.0))
    problem, gauge = with_datum(ties[0].with_heights(planes), *ties[1:], None)
    assert [one.slow for one in problem.pseudo] == [0.0] * 6
    assert "Positions come from the delivered models and from the terrain in the DEM" in gauge
    known = replace(ties[0], pseudo=tuple(Pseudo(column, 0.0, 3.0) for column in range(6))).with_heights(planes)
    assert with_datum(known, *ties[1:], None)[1].endswith("as delivered, the height also from the DEM")


# -- how it is measured ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def affine(flown: Block) -> Linear:
    """Equations of two images with an affine correction and one with a shift; sigmas differ from ray to ray."""
    kinds = ("affine", "shift", "affine")
    models = [ImageCorrection.identity(one.model, kind, ORIGIN) for one, kind in
              zip(flown.start.values(), kinds, strict=True)]  # fmt: skip
    points = flown.points.with_image_sigmas(np.linspace(0.1, 0.7, flown.points.rays))
    problem, state, selection = _prepared(tuple(models), points, {}, ())
    weights = replace(selection, ray_weights=np.ones(points.rays))
    return Linear.at(problem, state, weights)


def test_a_parameter_is_held_by_the_root_mean_square_of_its_effect_in_its_image(affine: Linear) -> None:
    problem, state = affine.problem, affine.state
    problem = replace(problem, pseudo=(Pseudo(1, 0.0, 2.0), Pseudo(7, 0.0, 2.0)))
    found = _held(replace(affine, problem=problem), np.array([3.0, 5.0, 7.0]), 0.02)
    assert [one.column for one in found] == [0, *range(2, 7), *range(8, 14)]
    for one in found:
        image = 0 if one.column < 6 else 1 if one.column < 8 else 2
        model = state.models[image]
        shown = problem.points.point[problem.points.image == image]
        places = problem.frame.places(state.local).in_crs(model.crs)[shown]
        step = np.zeros(problem.size)
        step[one.column] = 1e-3
        ends = [state.moved(way * step, np.zeros(3)).models[image].ground_to_image(places) for way in (1, -1)]
        effect = math.sqrt((((ends[0] - ends[1]) / 2e-3) ** 2).sum(axis=1).mean())
        assert one.sigma == pytest.approx((3.0, 5.0, 7.0)[image] / effect, rel=1e-6)
        assert (one.mean, one.slow, one.held) == (state.params[one.column], 0.02, True)


def test_rays_miss_by_the_median_over_points_of_what_is_left_per_freedom(affine: Linear) -> None:
    """Two rays leave one of four coordinates, three rays three of six; one ray leaves none."""
    points = affine.problem.points
    rays = np.ones(points.rays, dtype=bool)
    rays[np.flatnonzero(points.point == 0)[1:]] = False
    counts = np.bincount(points.point[rays], minlength=len(points))
    assert {1, 2, 3} == set(counts.tolist())
    ordering = replace(affine.ordering, rays=affine.ordering.rays[rays[affine.ordering.rays]])
    squares = np.random.default_rng(3).uniform(0.5, 9.0, (points.rays, 2)) ** 2
    wanted = [
        squares[rays & (points.point == k)].sum() / (2 * counts[k] - 3) for k in range(len(points)) if counts[k] > 1
    ]

    def missed(pixels: np.ndarray) -> float:
        misfits = Misfits(pixels / points.sigma_image[:, None], affine.misfits.ground, affine.misfits.pseudo)
        return _missed(replace(affine, ordering=ordering, misfits=misfits))

    assert missed(np.sqrt(squares)) == pytest.approx(math.sqrt(np.median(wanted)))
    # What cannot be computed is left out; where nothing can, rays do not miss.
    broken = np.where((points.point == 5)[:, None], np.nan, np.sqrt(squares))
    assert counts[:6].min() == counts[0]
    assert missed(broken) == pytest.approx(math.sqrt(np.median(np.delete(wanted, 4))))
    assert missed(np.full_like(squares, np.nan)) == 0.0


def test_an_image_without_rays_has_no_pixels_per_metre(ties: Prepared) -> None:
    problem, state, selection = ties
    without = Selection.of(selection.rays & (problem.points.image != 2), selection.ground)
    found, whole = (_pixels_per_metre(Linear.at(problem, state, one)) for one in (without, selection))
    assert np.isnan(found).tolist() == [False, False, True]
    assert found[:2] == pytest.approx(whole[:2], rel=0.02)


def test_models_that_state_no_accuracy_are_left_out(ties: Prepared) -> None:
    assert stated_accuracies(dict(zip("abc", ties[0].models, strict=True))) == {}
