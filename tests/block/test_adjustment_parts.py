"""Parts of an adjustment by hand: what it starts from, what it refuses and names, and what its figures are made of."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import CRS, ORIGIN, Block, Chain, fly, to_image, with_control

from ortho_pipeline.block import adjustment
from ortho_pipeline.block.adjustment import (
    _held,
    _prepared,
    _started,
    _weighed,
    _without,
    adjust,
    pseudo_of,
)
from ortho_pipeline.block.determination import refuse_many_outside
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.local_frame import GEODETIC, GroundFrame, enu_partials
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import DegeneratePoints, InputError
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models import ImageCorrection


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=15.0, overlap=0.7, ties=50, errors=2.0, pairwise=False), 11)


@pytest.fixture(scope="module")
def points(flown: Block) -> BlockPoints:
    """Return ties with six control points, of other sigmas for each ray."""
    found = with_control(flown, "i1", count=6)
    return found.with_image_sigmas(np.linspace(0.1, 0.3, found.rays))


# -- the start ---------------------------------------------------------------------------------------------------------


def test_control_starts_where_it_is_known_to_be(flown: Block, points: BlockPoints) -> None:
    """Its height is that of its rays, or of the reference of its image, if it is not known."""
    first, second, third, fourth, *_ = np.flatnonzero(points.control)
    ground, rays = points.ground.copy(), np.ones(points.rays, dtype=bool)
    ground[[first, second, fourth], 2] = np.nan
    for point, left in ((second, 1), (third, 1)):
        rays[np.flatnonzero(points.point == point)[left:]] = False
    tie = int(np.flatnonzero(points.tie)[0])
    rays[np.flatnonzero(points.point == tie)[1:]] = False
    some = replace(points, ground=ground).of_rays(rays)
    models = tuple(flown.start.values())
    problem, state, selection = _prepared(models, some, {}, [points.ids[fourth]])
    expected = ground_transform(CRS, GEODETIC)(points.ground[points.control])
    known = problem.known[points.control]
    np.testing.assert_allclose(known[:, :2], expected[:, :2], rtol=0, atol=1e-12)
    assert np.isnan(known[:, 2]).tolist() == [True, True, False, True, False, False]
    np.testing.assert_allclose(known[2::2, 2][:1], expected[2, 2], atol=1e-6)
    assert np.isnan(problem.known[~points.control]).all()
    places = ground_transform(GEODETIC, CRS)(problem.frame.geodetic(state.local))
    np.testing.assert_allclose(places[[first, second, third], :2], points.ground[[first, second, third], :2], atol=1e-5)
    assert places[third, 2] == pytest.approx(points.ground[third, 2], abs=1e-6)
    # Rays that are some pixels off meet within some metres of the truth.
    assert 1e-3 < abs(places[first, 2] - flown.ground[first, 2]) < 30.0
    assert places[second, 2] == pytest.approx(models[some.image[some.point == second][0]].reference_height, abs=1e-6)
    assert np.flatnonzero(np.isnan(state.local).any(axis=1)).tolist() == sorted([int(fourth), tie])
    assert set(some.point[~selection.rays].tolist()) == {fourth}
    assert np.flatnonzero(selection.ground).tolist() == np.setdiff1d(np.flatnonzero(points.control), [fourth]).tolist()


def test_priors_are_observations_of_the_columns_of_their_images(flown: Block, points: BlockPoints) -> None:
    kinds = ("affine", "none", "shift-drift")
    models = [ImageCorrection.identity(one.model, kind, ORIGIN) for one, kind in
              zip(flown.start.values(), kinds, strict=True)]  # fmt: skip
    names = models[0].param_names, models[2].param_names
    priors = {"i0": {names[0][4]: Prior(3.0, 0.5), names[0][1]: Prior(-1.0, 0.2, shared="camera")},
              "i2": {names[1][3]: Prior(7.0, 2.0)}}  # fmt: skip
    found = pseudo_of(models, points, priors)
    assert [(one.column, one.mean, one.held, one.slow) for one in found] == [
        (4, 3.0, False, 0.0), (1, -1.0, False, 0.0), (9, 7.0, False, 0.0),
    ]  # fmt: skip
    # What images share is one unknown, from which each differs by a thousandth.
    assert [one.sigma for one in found] == pytest.approx([0.5, 0.2e-3, 2.0])
    with pytest.raises(InputError, match="the image 'i7', which is not in the block"):
        pseudo_of(models, points, {"i7": {}})
    with pytest.raises(InputError, match="'col_shift', which the model of 'i1' does not have"):
        pseudo_of(models, points, {"i1": {"col_shift": Prior(0.0, 1.0)}})


def test_the_first_guess_of_a_sigma_of_the_ground_is_a_pixel(flown: Block, points: BlockPoints) -> None:
    """In the middle of all rays: of the two rows of a ray the one that changes more per metre."""
    problem, state, selection = _prepared(tuple(flown.start.values()), points, {}, ())
    rays = selection.rays & (points.image != 2)
    selection = replace(selection, rays=rays)
    found = _started(problem, state, selection)
    lengths = []
    for ray in Linear.at(problem, state, selection).ordering.rays:
        model = flown.start[points.images[points.image[ray]]]
        place = problem.frame.places(state.local).in_crs(model.crs)[[points.point[ray]]]
        ends = [model.ground_to_image(place + way * np.eye(3)) for way in (0.1, -0.1)]
        lengths.append(np.linalg.norm((ends[0] - ends[1]) / 0.2, axis=0).max())
    assert found.assumed == pytest.approx(
        (np.median(1 / np.array(lengths)),) * 2, rel=1e-3
    )  # a metre of the map is 0.9996 of one
    none = replace(selection, rays=np.zeros(points.rays, dtype=bool))
    assert _started(problem, state, none).assumed == (1.0, 1.0)


# -- what is refused and named -----------------------------------------------------------------------------------------


def test_points_that_take_no_part_are_told_by_their_roles(points: BlockPoints) -> None:
    roles = np.array(["control"] * 12 + ["check"] * 12 + ["tie"] * 26)
    groups = np.full(points.rays, -1)
    groups[points.point == 13] = 0
    ground = np.tile(points.ground[points.control][0], (50, 1))
    table = replace(points, roles=roles, ground=ground, groups=groups)
    found = _without(table, np.isin(np.arange(50), [*range(11), 12, 13, 14, *range(30, 40)]))
    assert [(one.fields["role"], one.fields["count"]) for one in found] == [("control", 11), ("check", 2), ("tie", 10)]
    control, check, tie = found
    assert control.fields["points"] == [f"t{k}" for k in range(10)]
    assert check.fields["points"] == ["t12", "t14"], "a match that checks takes part in one image alone"
    assert "t9 ..." in str(control)
    assert "..." not in str(tie)
    assert ["not tested" in str(one) for one in found] == [False, True, False]
    assert _without(table, np.zeros(50, dtype=bool)) == []
    # A control point that is a match is told.
    groups[points.point == 0] = 0
    assert len(_without(replace(table, groups=groups), np.arange(50) == 0)) == 1


@pytest.mark.parametrize(("outside", "refused"), [(20, False), (21, True)])
def test_more_than_half_of_the_points_outside_leave_no_heights(outside: int, refused: bool) -> None:
    """Of forty that take part; two more that do not are outside, too."""
    of = np.arange(50) < 40
    ground, some = np.zeros(50, dtype=bool), np.zeros(50, dtype=bool)
    models = [SimpleNamespace(height_limits=limits) for limits in ((-100.0, 900.0), (50.0, 1200.0))]
    whole: Any = SimpleNamespace(ground=ground, active=of)
    inside: Any = SimpleNamespace(active=some)
    problem: Any = SimpleNamespace(
        active=lambda selection: selection.active, models=models, points=SimpleNamespace(source=""), heights=None
    )
    lost = (np.arange(50) < outside) | (np.arange(50) >= 48)
    if not refused:
        refuse_many_outside(problem, lost, inside, whole)
        return
    with pytest.raises(DegeneratePoints, match=r"rays of 21 of 40 points .* \(heights 50 to 900 m\)"):
        refuse_many_outside(problem, lost, inside, whole)
    # Known ground that takes part says where the heights are.
    ground[30] = True
    with pytest.raises(DegeneratePoints):
        refuse_many_outside(problem, lost, inside, whole)
    some[30] = True
    refuse_many_outside(problem, lost, inside, whole)


@pytest.mark.parametrize(("astray", "left", "converged", "held"), [
    (2, 0, True, False), (3, 0, True, True), (3, 2, True, True), (3, 3, True, False), (3, 0, False, False),
    (0, 0, True, False),
])  # fmt: skip
def test_a_tilted_block_is_held_if_that_leads_fewer_points_astray(
    monkeypatch: pytest.MonkeyPatch, astray: int, left: int, converged: bool, held: bool
) -> None:
    """From more than a twentieth of forty points on; what is held already is not held again."""
    count = np.arange(50)
    again = SimpleNamespace(converged=converged, astray=(count < left) if left else None)
    asked: list[float] = []

    def with_datum(problem: Any, start: Any, selection: Any, hold: float) -> tuple[Any, str]:
        asked.append(hold)
        return problem, ""

    monkeypatch.setattr(adjustment, "with_datum", with_datum)
    monkeypatch.setattr(adjustment, "attempt", lambda *given: again)
    problem = SimpleNamespace(pseudo=(Pseudo(0, 0.0, 1.0),), active=lambda selection: count < 40)
    solved: Any = SimpleNamespace(problem=problem, astray=(count < astray) if astray else None)
    found = _held(solved, None, None, None)  # type: ignore[arg-type]
    assert (found is again) is held
    assert asked == ([10.0] if astray > 2 else [])
    problem.pseudo = (Pseudo(0, 0.0, 1.0), Pseudo(1, 0.0, 1.0, held=True))
    assert _held(solved, None, None, None) is None  # type: ignore[arg-type]


def test_a_block_is_solved_again_while_its_sigmas_move_it_by_two_per_cent(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most three times; then what is shared is settled with what was found."""
    for moved, solutions in (([0.019], 0), ([0.021, 0.019], 1), ([9.0, 9.0, 9.0, 9.0, 9.0], 3)):
        left, made = list(moved), [0]
        monkeypatch.setattr(adjustment, "posterior", lambda solved, left=left: SimpleNamespace(
            moved=left.pop(0), variances=None, of=solved))  # fmt: skip

        def reweighed(solved: Any, selection: Any, variances: Any, made: list[int] = made) -> Any:
            made[0] += 1
            return SimpleNamespace(number=made[0])

        monkeypatch.setattr(adjustment, "reweighed", reweighed)
        shared: Any = SimpleNamespace(error=None)
        shared.settled = lambda solved, selection, shared=shared: (solved, shared)
        start: Any = SimpleNamespace(number=0)
        solved, found, _ = _weighed(start, None, shared)  # type: ignore[arg-type]
        assert (made[0], solved.number) == (solutions, solutions)  # type: ignore[attr-defined]
        assert found.of is solved  # type: ignore[attr-defined]


@pytest.mark.parametrize(("ties", "searched"), [(3, 0), (4, 1)])
def test_gross_errors_are_looked_for_from_four_degrees_of_freedom_on(
    flown: Block, monkeypatch: pytest.MonkeyPatch, ties: int, searched: int
) -> None:
    """A control point determines two shifts; each tie of two rays leaves one equation."""
    pair = np.flatnonzero(np.bincount(flown.points.point[flown.points.image < 2], minlength=50) == 2)
    mine = np.isin(np.arange(50), pair[: ties + 1])
    points = flown.points.of_rays(flown.points.image < 2).select(mine)
    roles, ground = points.roles.copy(), points.ground.copy()
    roles[0], ground[0] = "control", flown.ground[pair[0]]
    points = replace(points, roles=roles, ground=ground, images=("i0", "i1")).with_ground_sigma(0.1)
    found, calls = adjustment.find_blunders, [0]

    def counted(*given: Any) -> Any:
        calls[0] += 1
        return found(*given)

    monkeypatch.setattr(adjustment, "find_blunders", counted)
    fit = adjust({name: flown.start[name] for name in ("i0", "i1")}, points)
    assert fit.degrees_of_freedom == pytest.approx(ties)
    assert fit.redundancy == ties
    assert calls == [searched]


# -- figures -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robust", [False, True])
def test_figures_of_points_and_rays_are_in_the_order_of_the_table(
    flown: Block, points: BlockPoints, robust: bool
) -> None:
    """Also of check points, of points that are excluded, and of ties with ground that is of no use."""
    roles, ground = points.roles.copy(), points.ground.copy()
    tie = np.flatnonzero(points.tie)
    roles[tie[:8]] = "check"
    ground[tie[:9]] = flown.ground[tie[:9]] + np.random.default_rng(3).normal(0, 1.0, (9, 3))
    table = replace(points, roles=roles, ground=ground).of_rays(np.random.default_rng(4).permutation(points.rays))
    control, out = np.flatnonzero(points.control), [points.ids[tie[1]], points.ids[tie[20]]]
    fit = adjust(flown.start, table, exclude=[*out, points.ids[control[2]]], robust=robust)
    gone = np.isin(points.ids, [*out, points.ids[control[2]]])
    np.testing.assert_array_equal(fit.used_rays, ~gone[table.point])
    np.testing.assert_array_equal(fit.used_ground, points.control & ~gone)
    np.testing.assert_array_equal(np.isnan(fit.ground).any(axis=1), gone)
    known = np.where((roles == "tie")[:, None], np.nan, ground)
    adjusted = ground_transform(GEODETIC, CRS)(fit.ground)
    for ray in range(table.rays):
        model, first = (of[table.images[table.image[ray]]] for of in (fit.models, flown.start))
        point = table.point[ray]
        for found, camera, place in ((fit.residuals, model, adjusted), (fit.back_projected, model, known),
                                     (fit.raw_residuals, first, known)):  # fmt: skip
            seen = to_image(camera, place[[point]])[0]
            np.testing.assert_allclose(found[ray], table.measured[ray] - seen, rtol=0, atol=1e-5)
    frame = GroundFrame.about(ground_transform(CRS, GEODETIC)(flown.ground))
    lonlat = ground_transform(CRS, GEODETIC)(known)
    np.testing.assert_allclose(fit.object_residuals, frame.apart(lonlat, frame.of_geodetic(fit.ground)), atol=1e-6)
    assert "5 control points" in fit.gauge
    assert fit.redundancy == math.floor(fit.degrees_of_freedom + 1e-6)
    assert fit.degrees_of_freedom == pytest.approx(2 * fit.used_rays.sum() + 3 * 5 - 6 - 3 * 47)
    # The factor is that of the stated sigmas: noise of 0.1 px, stated as 0.1 to 0.3 px.
    weighted = ((fit.residuals[fit.used_rays] / table.sigma_image[fit.used_rays, None]) ** 2).sum()
    assert fit.sigma0 == pytest.approx(math.sqrt(weighted / fit.degrees_of_freedom), rel=0.15)
    with pytest.raises(InputError, match="cannot exclude 'b'"):
        adjust(flown.start, table, exclude=["c", "b", out[0]])


def test_a_point_that_was_rejected_is_not_named_as_one_with_too_few_rays(flown: Block, points: BlockPoints) -> None:
    """A tie of two rays that miss each other is a gross error, and a tie of one ray takes no part."""
    two = np.flatnonzero(points.tie & (np.bincount(points.point) == 2))
    wrong, alone = two[[0, 3]]
    measured = points.measured.copy()
    rays = np.flatnonzero(points.point == wrong)
    measured[rays] += [[0.0, 40.0], [0.0, -40.0]]
    table = replace(points, measured=measured)
    table = table.of_rays(np.arange(points.rays) != np.flatnonzero(points.point == alone)[0])
    fit = adjust(flown.start, table)
    assert [(one.point, one.what) for one in fit.rejected] == [(points.ids[wrong], "point")]
    (notice,) = [one for one in fit.warnings if one.code == "takes-no-part"]
    assert notice.fields["points"] == [points.ids[alone]]


def test_the_covariance_of_a_tie_is_that_of_its_rays_and_of_the_parameters_of_its_images(flown: Block) -> None:
    """Parameters err as their start values, which are held firmly. What rays add has one factor for all ties.

    It is that of measurements, with the uncertainty of Student's distribution.
    """
    fit = adjust(flown.start, flown.points, robust=False, hold=0.3)
    points, images, factors = fit.points, np.array([image for image, _ in fit.parameters]), []
    for k in range(len(points)):
        by_point, by_params = [], []
        for ray in np.flatnonzero(points.point == k):
            name, ground = points.images[points.image[ray]], fit.ground[[k]]
            model, row = fit.models[name], np.zeros((2, len(images)))
            row[:, images == name] = model.param_partials(ground_transform(GEODETIC, model.crs)(ground))[0]
            by_point.append(enu_partials(model, ground)[0] / points.sigma_image[ray])
            by_params.append(row / points.sigma_image[ray])
        rows = np.concatenate(by_point)
        inverse = np.linalg.inv(rows.T @ rows)
        gain = inverse @ rows.T @ np.concatenate(by_params)
        of_rays = fit.ground_covariance[k] - gain @ fit.covariance @ gain.T
        factors.append(np.trace(of_rays) / np.trace(inverse))
        np.testing.assert_allclose(of_rays, factors[-1] * inverse, atol=1e-3 * np.trace(fit.ground_covariance[k]))
    np.testing.assert_allclose(factors, factors[0], rtol=0.01)
    assert fit.sigma0 is not None
    freedom = fit.degrees_of_freedom
    assert np.mean(factors) == pytest.approx(fit.sigma0**2 * freedom / (freedom - 2), rel=0.05)
