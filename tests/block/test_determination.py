"""Blocks that are refused because their points leave images open: limits at both sides, and the names in messages."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import ORIGIN, Chain, fly

from ortho_pipeline.block import adjustment, determination
from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.determination import (
    missing_most,
    naming_wrong_points,
    refuse_too_few,
    refuse_undetermined,
    uncertain_images,
)
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Pseudo, Selection, State
from ortho_pipeline.block.equations.unknowns import Columns
from ortho_pipeline.block.intersection import predict
from ortho_pipeline.errors import DegeneratePoints, NotConverged, TooFewPoints
from ortho_pipeline.models import ImageCorrection

Prepared = tuple[BlockProblem, State, Selection]


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    """Return a block of an image with an affine correction, one without parameters, and one with a shift and drift."""
    flown = fly(Chain(images=3, convergence_deg=15.0, overlap=0.7, ties=40, errors=2.0, pairwise=False), 8)
    models = [ImageCorrection.identity(one.model, kind, ORIGIN) for one, kind in
              zip(flown.start.values(), ("affine", "none", "shift-drift"), strict=True)]  # fmt: skip
    return _prepared(tuple(models), flown.points, {}, ())


def with_rays(prepared: Prepared, image: int, count: int) -> Selection:
    """Return a selection of so many rays of an image."""
    problem, _, selection = prepared
    rays, mine = selection.rays.copy(), np.flatnonzero(problem.points.image == image)
    rays[mine[count:]] = False
    return Selection.of(rays, selection.ground)


@pytest.mark.parametrize(
    ("image", "rays", "priors", "least"),
    [
        (0, 2, (), 3), (0, 3, (), None), (0, 2, (4,), 3), (0, 2, (1, 4), None), (0, 1, (1, 4), 2), (0, 1, (1, 4, 5), 2),
        (0, 1, (0, 1, 4, 5), None), (2, 1, (), 2), (2, 2, (), None), (2, 1, (7,), 2), (2, 1, (6, 7), None),
        (2, 1, (0, 1), 2), (1, 0, (), None),
    ],
)  # fmt: skip
def test_an_image_needs_as_many_equations_as_parameters(
    prepared: Prepared, image: int, rays: int, priors: tuple[int, ...], least: int | None
) -> None:
    """A ray is two, a prior of this image is one."""
    problem = replace(prepared[0], pseudo=tuple(Pseudo(column, 0.0, 1.0) for column in priors))
    if least is None:
        refuse_too_few(problem, with_rays(prepared, image, rays))
        return
    count = {0: 6, 2: 4}[image]
    with pytest.raises(
        TooFewPoints, match=rf"{rays} points? in the image 'i{image}' cannot determine its {count}"
    ) as no:
        refuse_too_few(problem, with_rays(prepared, image, rays))
    assert f"measure at least {least} points in it" in str(no.value.remedy)


def test_constraints_of_a_model_are_equations_too(prepared: Prepared) -> None:
    problem, _, _ = prepared
    selection = with_rays(prepared, 0, 2)
    for known, enough in ((1, False), (2, True)):
        model = SimpleNamespace(params=np.zeros(6), constraints=lambda known=known: [None] * known)
        made: Any = replace(problem, models=(model, *problem.models[1:]))  # type: ignore[arg-type]
        if enough:
            refuse_too_few(made, selection)
            continue
        with pytest.raises(TooFewPoints, match="2 points in the image 'i0'") as no:
            refuse_too_few(made, selection)
        assert "measure at least 3 points" in str(no.value.remedy)


def test_rays_of_points_that_no_other_image_shows_do_not_count(prepared: Prepared) -> None:
    problem, _, selection = prepared
    points = problem.points
    alone = with_rays(prepared, 2, 0)
    only = Selection.of(alone.rays & (points.image == 0), selection.ground)
    with pytest.raises(TooFewPoints, match="no point is in two images"):
        refuse_too_few(problem, only)
    # Three rays of the first image are in the second, too; the others are alone there.
    shown = np.intersect1d(points.point[points.image == 0], points.point[points.image == 1])[:2]
    some = Selection.of(alone.rays & ((points.image == 0) | np.isin(points.point, shown)), selection.ground)
    with pytest.raises(TooFewPoints, match="2 points in the image 'i0'"):
        refuse_too_few(problem, some)


# -- undetermined parameters -------------------------------------------------------------------------------------------


def solved_of(condition: float, images: int = 6) -> Any:
    """Return a solution of images with a shift each."""
    models = [SimpleNamespace(param_names=("col_shift", "row_shift"))] * images
    points = SimpleNamespace(images=tuple(f"i{k}" for k in range(images)), source="")
    problem = SimpleNamespace(columns=Columns.of([2] * images), models=models, points=points, size=2 * images)
    return SimpleNamespace(problem=problem, condition=condition, linear=None)


@pytest.mark.parametrize(
    ("vector", "names"),
    [
        ((0, -0.9, 0, 0, 0.26, 0.28, 0, 0, 0, 0, 0, 0),
         "row_shift of the image 'i0'; row_shift of the image 'i2' (condition"),
        ((0.1, 0, 0.5, -0.6, 0, 0, 0, 0, 0, 0, 0.19, -0.17),
         "col_shift, row_shift of the image 'i1'; col_shift of the image 'i5' (condition"),
        ((0.4, 0, 0.4, 0, 0, 0.4, 0.4, 0, 0, 0, 0, 0), "row_shift of the image 'i2'; col_shift of the image 'i3' ("),
        ((0.4, 0, 0.4, 0, 0, 0.4, 0.4, 0, 0.4, 0, 0, 0),
         "col_shift of the image 'i3'; and those of 1 more image (condition"),
        ((0.4, 0, 0.4, 0, 0, 0.4, 0.4, 0, 0.4, 0.4, 0, 0.4), "'i3'; and those of 2 more images (condition"),
    ],
)  # fmt: skip
def test_the_parameters_of_the_weakest_combination_are_named(
    monkeypatch: pytest.MonkeyPatch, vector: tuple[float, ...], names: str
) -> None:
    """Those with more than three tenths of the largest part; at most four images."""
    monkeypatch.setattr(determination, "weakest", lambda linear: np.array(vector))
    refuse_undetermined(solved_of(1e6))
    with pytest.raises(DegeneratePoints) as no:
        refuse_undetermined(solved_of(1.01e6))
    assert names in str(no.value)
    assert "i4" not in str(no.value)
    none = solved_of(math.inf)
    none.problem.size = 0
    refuse_undetermined(none)


# -- uncertain images --------------------------------------------------------------------------------------------------


def corner_spread(model: Any, cofactors: np.ndarray) -> float:
    """Return the largest sigma (px) of a coordinate at a corner, by differences of the image points."""
    spreads = []
    for corner in model.corners:
        partials = []
        for k in range(len(model.params)):
            step = 1e-3 * np.eye(len(model.params))[k]
            ends = [model.with_params(model.params + way * step).ground_to_image(corner[None])[0] for way in (1, -1)]
            partials.append((ends[0] - ends[1]) / 2e-3)
        rows = np.array(partials).T
        spreads.append(np.sqrt(np.diag(rows @ cofactors @ rows.T)))
    return float(np.max(spreads))


@pytest.mark.parametrize("held", [False, True])
def test_the_uncertainty_is_that_of_the_worst_corner_and_of_the_middle_of_the_rays(
    prepared: Prepared, held: bool
) -> None:
    problem, state, selection = prepared
    sigmas = np.random.default_rng(1).uniform(0.1, 0.5, problem.points.rays)
    problem = replace(problem, points=problem.points.with_image_sigmas(sigmas))
    pseudo = (Pseudo(0, 0.0, 1.0, held=True), Pseudo(1, 0.0, 1.0)) if held else (Pseudo(1, 0.0, 1.0),)
    problem = replace(problem, pseudo=pseudo)
    linear = Linear.at(problem, state, selection)
    random = np.random.default_rng(2)
    scale = np.array([1.0, 4e-3, 4e-3, 1.0, 4e-3, 4e-3])
    roots = {0: scale[:, None] * random.normal(size=(6, 6)), 2: random.normal(size=(4, 4)) * scale[[0, 2, 3, 5], None]}
    medians = {image: float(np.median(sigmas[problem.points.image == image])) for image in roots}

    def found(times: float, shared: float = 1.0) -> Any:
        own, whole = (
            SimpleNamespace(of_image=lambda image, size=size: size**2 * roots[image] @ roots[image].T)
            for size in (times, shared * times)
        )
        solved: Any = SimpleNamespace(problem=problem, linear=linear, state=state, cofactors=own)
        whole_or_none: Any = None if shared == 1.0 else whole
        return uncertain_images(solved, problem.points.with_image_sigmas(0.1 * sigmas), whole_or_none)

    wanted = {
        image: corner_spread(state.models[image], root @ root.T) / medians[image] for image, root in roots.items()
    }
    first, other = sorted(wanted, key=lambda image: wanted[image])
    assert wanted[first] < 0.99 * wanted[other]
    for factor, named in ((9.99 / wanted[other], []), (10.01 / wanted[other], [other])):
        notices = found(factor)
        assert [one.fields["factor"] for one in notices] == ([] if held else [
            pytest.approx(factor * wanted[image], rel=1e-6) for image in named
        ])  # fmt: skip
        assert all(f"i{other}" in str(one) for one in notices)
    # Errors that all points share are in what is told, and do not decide.
    assert not found(9.99 / wanted[other], shared=3.0)
    for one in found(10.01 / wanted[other], shared=3.0):
        assert "10 times that of a measurement" in str(one)
    # At the rays themselves: the median over all coordinates, in their own sigmas.
    inside = {}
    for image, root in roots.items():
        used = linear.ordering.rays_of_image[image]
        rows = linear.by_params[used][:, :, : len(root)]
        inside[image] = math.sqrt(float(np.median(np.einsum("kip,pq,kiq->ki", rows, root @ root.T, rows))))
    worst = max(inside.values())
    found(99.0 / worst)
    if held:
        found(101.0 / worst)
        return
    with pytest.raises(DegeneratePoints, match="101 times less"):
        found(101.0 / worst)


def test_sigmas_are_those_of_the_worst_corner_and_of_the_worse_axis_of_the_middle_point() -> None:
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    corners = np.array([[[1.0, 0.0], [0.0, 1.0]], [[2.0, 0.0], [1.0, -1.0]]])
    points = np.array([[[0.1, 0.0], [0.0, 0.1]], [[0.3, 0.0], [0.0, 0.2]], [[0.5, 0.0], [0.0, 0.9]]])
    # Variances at the corners: 4 and 9, 16 and 11; of the middle point: 0.36 and 0.36.
    assert determination._sigmas(corners, points, covariance) == pytest.approx((4.0, 0.6))
    points[1, 1] = 0.0, 0.3
    assert determination._sigmas(corners, points, covariance) == pytest.approx((4.0, 0.9))


def test_a_corner_that_is_twice_as_uncertain_as_the_points_is_told_beside_them(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sigmas that are told contain errors that all points share."""
    problem, state, selection = prepared
    problem = replace(problem, pseudo=(Pseudo(1, 0.0, 1.0),))
    linear = Linear.at(problem, state, selection)
    scale = np.array([1.0, 4e-3, 4e-3, 1.0, 4e-3, 4e-3])
    roots = {0: np.diag(scale), 2: np.diag(scale[[0, 2, 3, 5]])}
    own, whole = (SimpleNamespace(of_image=lambda image, size=size: size * roots[image] ** 2) for size in (4.0, 8.0))
    solved: Any = SimpleNamespace(problem=problem, linear=linear, state=state, cofactors=own)
    beside, alone = (
        "its absolute position has a sigma of 5.8 px at a corner, but of 2.1 px at its points",
        "sigma of 4 px",
    )
    for at_points, text in ((1.9, beside), (2.1, alone)):

        def told(corners: Any, points: Any, covariance: Any, at: float = at_points) -> tuple[float, float]:
            return (4.0, at) if covariance[0, 0] == 4.0 else (5.8, 2.1)

        monkeypatch.setattr(determination, "_sigmas", told)
        found = uncertain_images(solved, problem.points.with_image_sigmas(np.full(problem.points.rays, 0.01)), whole)  # type: ignore[arg-type]
        assert len(found) == 2
        assert all(text in str(one) for one in found)


@pytest.mark.parametrize("wrong", [0, 2])
def test_errors_of_the_first_solution_name_points_that_miss_at_the_start(prepared: Prepared, wrong: int) -> None:
    problem, state, selection = prepared
    points, measured = problem.points, problem.points.measured.copy()
    for number in range(wrong):
        measured[np.flatnonzero(points.point == number)[0]] += 400.0 + 200.0 * number
    apart = replace(problem, points=replace(points, measured=measured))
    with pytest.raises(DegeneratePoints, match=r"^astray") as error, naming_wrong_points(apart, state, selection):
        raise DegeneratePoints("astray", remedy="give more points")
    named = [name for name in points.ids if f"{name} (" in str(error.value.message)]
    assert named == list(points.ids[:wrong])
    remedy = "check these points first, and delete wrong ones; or give more points" if wrong else "give more points"
    assert str(error.value.remedy) == remedy


@pytest.mark.parametrize(("usual", "part", "named"), [
    (0.0, 0.99, []), (0.0, 1.01, [3, 8]), (3.0, 0.99, []), (3.0, 1.01, [3, 8]),
])  # fmt: skip
def test_rays_that_miss_most_are_twenty_sigmas_off_and_twice_as_far_as_others(
    prepared: Prepared, usual: float, part: float, named: list[int]
) -> None:
    """A measurement has a sigma of 0.1 px. Where all rays are 3 px off, 6 px are far; the worst ray of a point counts.

    A ray that takes no part tells nothing.
    """
    problem, state, selection = prepared
    points = problem.points
    measured = predict(problem.frame, state.models, points, state.local)
    worst = np.full(len(points), usual)
    worst[[3, 8]] = part * max(2.0 * usual, 2.0)
    last = np.array([np.flatnonzero(points.point == k)[-1] for k in range(len(points))])
    measured[last] += worst[:, None] * [0.6, -0.8]
    first, rays = int(np.flatnonzero(points.point == 5)[0]), selection.rays.copy()
    measured[first] += 500.0
    rays[first] = False
    moved = replace(problem, points=replace(points, measured=measured))
    found, far = missing_most(moved, state, replace(selection, rays=rays))
    assert np.flatnonzero(far).tolist() == named
    np.testing.assert_allclose(found, np.where(worst > 2.0, worst, 0.0), atol=1e-6)


def test_an_error_of_the_start_that_known_ground_shares_is_no_wrong_point(prepared: Prepared) -> None:
    """A vendor's model is wrong by many pixels, and only control points show it: they were called wrong."""
    problem, state, selection = prepared
    points, known = problem.points, np.arange(len(problem.points)) < 5
    measured = points.measured + 300.0 * known[points.point, None]
    measured[np.flatnonzero(points.point == 0)[0]] += 400.0
    apart = replace(problem, points=replace(points, measured=measured))
    for ground, named in ((known, points.ids[:1]), (~known, points.ids[:5])):
        with pytest.raises(NotConverged) as error, naming_wrong_points(apart, state, replace(selection, ground=ground)):
            raise NotConverged("no inverse")
        assert [name for name in points.ids if f"{name} (" in str(error.value.message)] == list(named)
        # An error without a remedy gets no second one that is empty.
        assert error.value.remedy == "check these points first, and delete wrong ones"


@pytest.mark.parametrize(("robust", "solved"), [(True, True), (True, False), (False, True)])
def test_without_a_first_solution_points_that_miss_most_come_in_later(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch, robust: bool, solved: bool
) -> None:
    """A few wrong rays led the first solution astray. What has no place at the start takes part when others rest."""
    problem, state, selection = prepared
    points, measured = problem.points, problem.points.measured.copy()
    measured[np.flatnonzero(points.point == 3)[0]] += 400.0
    apart = replace(problem, points=replace(points, measured=measured))
    starts = []

    def first(problem: Any, state: Any, *others: Any) -> str:
        starts.append(np.flatnonzero(np.isnan(state.local).any(axis=1)).tolist())
        if len(starts) == 1 or not solved:
            raise NotConverged(f"attempt {len(starts)}", remedy="more points")
        return "solved"

    monkeypatch.setattr(adjustment, "_first_of_all", first)
    if robust and solved:
        assert adjustment._first(apart, state, selection, selection, "shared", robust) == "solved"  # type: ignore[arg-type]
    else:
        with pytest.raises(NotConverged, match=r"^attempt 1\. Wrong points .* miss most at"):
            adjustment._first(apart, state, selection, selection, "shared", robust)  # type: ignore[arg-type]
    assert starts == ([[], [3]] if robust else [[]])
