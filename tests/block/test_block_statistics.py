"""Statistics of a block, number by number: joins of images, contradicted points, variances, shared errors."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import Chain, fly
from scipy import stats

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.equations.problem import PERFECT_GROUND
from ortho_pipeline.block.fit import BlockFit, merged
from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem, known_errors
from ortho_pipeline.block.heights.settling import Heights
from ortho_pipeline.block.intersection import ray_angles
from ortho_pipeline.block.relative.joins import Join, joins_of, weak_joins
from ortho_pipeline.block.reliability import known_points
from ortho_pipeline.block.reliability.known_points import ContradictedPoint, notices, outlying
from ortho_pipeline.block.reliability.standardised_residuals import StandardisedResiduals
from ortho_pipeline.block.shared.priors import SharedParameter, SharedPriors
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.estimation.records import Rmse
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.report import block as block_report

GEODETIC = "EPSG:4979"


# -- joins -------------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def chain() -> BlockFit:
    block = fly(Chain(images=4, convergence_deg=10.0, ties=60, errors=2.0), 1)
    return adjust(block.start, block.points, hold=5.0, robust=False)


def plan(fit: BlockFit, image: str, params: np.ndarray, shared: np.ndarray) -> np.ndarray:
    """Return the mean place (m east, north) at which an image puts what it shows of the shared points."""
    ground, model = fit.ground[shared], fit.models[image]
    seen = model.ground_to_image(ground_transform(GEODETIC, model.crs)(ground))
    found = model.with_params(params).image_to_ground(seen, ground[:, 2])
    return np.asarray(ground_transform(model.crs, "EPSG:32636")(found)[:, :2].mean(axis=0))


def pixel(fit: BlockFit, image: str, shared: np.ndarray) -> float:
    """Return the side (m) of the square that a pixel covers on level ground, by the mean area at shared points."""
    ground, model = fit.ground[shared], fit.models[image]
    seen = model.ground_to_image(ground_transform(GEODETIC, model.crs)(ground))
    right, left, below, above = (
        ground_transform(model.crs, "EPSG:32636")(model.image_to_ground(seen + way, ground[:, 2]))[:, :2]
        for way in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))
    )
    columns, rows = (right - left).T, (below - above).T
    return math.sqrt(np.abs(columns[0] * rows[1] - columns[1] * rows[0]).mean())


def test_the_covariance_of_a_join_is_that_of_the_distance_of_both_images(chain: BlockFit) -> None:
    points, names = chain.points, [image for image, _ in chain.parameters]
    joins = joins_of(chain)
    assert [(join.first, join.second) for join in joins] == [("i0", "i1"), ("i1", "i2"), ("i2", "i3")]
    for join in joins:
        of = [
            set(points.point[points.image == points.images.index(name)].tolist()) for name in (join.first, join.second)
        ]
        shared = np.array(sorted(of[0] & of[1]))
        moves = np.zeros((2, len(names)))
        for image, sign in ((join.first, 1.0), (join.second, -1.0)):
            params = chain.models[image].params
            for k, column in enumerate(np.flatnonzero(np.array(names) == image).tolist()):
                step = 0.01 * np.eye(len(params))[k]
                ends = [plan(chain, image, params + way * step, shared) for way in (1.0, -1.0)]
                moves[:, column] = sign * (ends[0] - ends[1]) / 0.02
        assert join.pixel == pytest.approx(pixel(chain, join.first, shared), rel=2e-3)
        wanted = moves @ chain.covariance @ moves.T / join.pixel**2
        np.testing.assert_allclose(join.covariance, wanted, atol=2e-3 * np.abs(wanted).max())


def test_a_join_is_weakest_along_its_azimuth() -> None:
    for azimuth in (0.0, 30.0, 90.0, 150.0):
        along = np.array([math.sin(math.radians(azimuth)), math.cos(math.radians(azimuth))])
        across = np.array([along[1], -along[0]])
        join = Join("a", "b", 4.0 * np.outer(along, along) + 0.25 * np.outer(across, across), 0.5)
        assert join.sigma == pytest.approx(2.0)
        assert min(abs(join.azimuth_deg - azimuth), 180.0 - abs(join.azimuth_deg - azimuth)) < 1e-9
        figures = join.figures(1.9)
        assert (figures["sigma_px"], figures["sigma_m"]) == pytest.approx((2.0, 1.0))
        assert figures["weak"]
        assert not join.figures(2.1)["weak"]


def test_weak_joins_are_those_beyond_the_limit_the_worst_first() -> None:
    joins = tuple(
        Join("a", name, np.diag([square, 0.01]), 0.5)
        for name, square in zip("bcde", (1.0, 9.0, 4.0, 0.16), strict=True)
    )
    (notice,) = weak_joins(joins, 1.0)
    assert notice.fields["pairs"] == 2
    assert notice.fields["worst"] == ["a", "c"]
    assert notice.fields["sigma_px"] == pytest.approx(3.0)
    assert "more" not in str(notice)
    (notice,) = weak_joins(joins * 2, 0.5)
    assert notice.fields["pairs"] == 6
    assert "1 more" in str(notice)
    assert weak_joins(joins, 3.0) == ()


# -- known points ------------------------------------------------------------------------------------------------------


def solved_of(roles: list[str], sigma_ground: Any, unstated: np.ndarray | None = None) -> Any:
    count = len(roles)
    points = SimpleNamespace(
        ids=tuple(f"p{k}" for k in range(count)), roles=np.array(roles), check=np.array(roles) == "check",
        control=np.array(roles) == "control", sigma_ground=np.broadcast_to(np.asarray(sigma_ground), (count, 3)),
    )  # fmt: skip
    unstated = np.zeros((count, 3), dtype=bool) if unstated is None else unstated
    return SimpleNamespace(problem=SimpleNamespace(points=points, unstated=unstated))


def stated(redundancy: float = 12.0, **more: Any) -> Variances:
    return Variances(1.0, None, None, (redundancy, 0.0, 0.0), (0, 0), **more)


@pytest.fixture
def no_control(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        known_points, "standardise_ground", lambda solved: (np.zeros(n := len(solved.problem.points.ids)), np.zeros(n))
    )


@pytest.mark.usefixtures("no_control")
@pytest.mark.parametrize(("part", "beyond"), [(0.97, False), (1.03, True)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_check_point_contradicts_beyond_one_per_cent_of_all_tests(axis: int, part: float, beyond: bool) -> None:
    """Its misfit varies as its own ground and that of the block; three points, one without plan, are five tests."""
    solved = solved_of(["check"] * 3 + ["control"], (0.3, 0.4, 1.2))
    covariance = np.tile(np.diag([0.4**2, 0.3**2, 0.5**2]), (4, 1, 1))
    covariance[2, 0, 0] = np.nan
    residuals = np.zeros((4, 3))
    sigma, size = (0.5, 0.5, 1.3)[axis], 1 if axis == 2 else 2
    far = sigma * math.sqrt(size * stats.f.isf(0.01 / 5, size, 12.0))
    residuals[1, axis] = -part * far
    found = outlying(solved, stated(), residuals, covariance, np.zeros(4, dtype=bool))
    assert bool(found) is beyond
    if beyond:
        (one,) = found
        assert (one.point, one.role, one.what) == ("p1", "check", "height" if axis == 2 else "plan")
        assert one.metres == pytest.approx(part * far)
        assert one.sigmas == pytest.approx(part * far / sigma / math.sqrt(size))


@pytest.mark.usefixtures("no_control")
def test_check_points_without_sigmas_have_those_of_control() -> None:
    """The median of what control states; else what the block found."""
    residuals, covariance = np.zeros((5, 3)), np.zeros((5, 3, 3))
    residuals[0] = 3.0, 0.0, -30.0
    sigmas = np.array([[0.0] * 3, [1.0, 1.0, 5.0], [0.5, 0.5, 4.0], [0.2, 0.2, 7.0], [0.0, 0.0, 0.0]])
    solved = solved_of(["check", "control", "control", "control", "control"], sigmas)
    found = {one.what: one for one in outlying(solved, stated(), residuals, covariance, np.zeros(5, dtype=bool))}
    assert found["plan"].sigmas == pytest.approx(3.0 / 0.5 / math.sqrt(2))
    assert found["height"].sigmas == pytest.approx(30.0 / 5.0)
    one = Variances(1.0, 0.25, 2.5, (12.0, 3.0, 3.0), (4, 4), nodes=np.array([[1.0, 0.0625, 6.25]]))
    found = {one.what: one for one in outlying(solved, one, residuals, covariance, np.zeros(5, dtype=bool))}
    assert found["plan"].sigmas == pytest.approx(3.0 / 0.25 / math.sqrt(2))
    assert found["height"].sigmas == pytest.approx(30.0 / 2.5)


def test_used_control_contradicts_by_its_standardised_residual(monkeypatch: pytest.MonkeyPatch) -> None:
    solved = solved_of(["control"] * 4, 0.3)
    ranks = np.array([3, 2, 0, 3])
    for part, named in ((0.97, ()), (1.03, ("p0", "p1"))):
        squares = part * np.array(
            [3 * stats.f.isf(0.01 / 2, 3, 12.0), 2 * stats.f.isf(0.01 / 2, 2, 12.0), 900.0, 900.0]
        )
        monkeypatch.setattr(known_points, "standardise_ground", lambda solved, s=squares: (s, ranks))
        residuals = np.array([[3.0, 4.0, 12.0], [3.0, 4.0, np.nan], [9.0, 0.0, 0.0], [9.0, 0.0, 0.0]])
        used = np.array([True, True, True, False])
        found = outlying(solved, stated(), residuals, np.zeros((4, 3, 3)), used)
        assert tuple(one.point for one in found) == named
    assert [one.metres for one in found] == pytest.approx([13.0, 5.0])
    assert [one.sigmas for one in found] == pytest.approx([math.sqrt(squares[0] / 3), math.sqrt(squares[1] / 2)])
    assert {one.what for one in found} == {"ground"}
    # Of ground without a sigma of its own, fewer degrees of freedom are known.
    unstated = solved_of(["control"] * 4, 0.3, np.ones((4, 3), dtype=bool))
    assert outlying(unstated, stated(freedom=3.0), residuals, np.zeros((4, 3, 3)), used) == ()


def contradicted(point: str, role: str = "check", sigmas: float = 9.0) -> ContradictedPoint:
    return ContradictedPoint(point=point, role=role, what="plan", metres=8.0, sigmas=sigmas)  # type: ignore[arg-type]


def test_check_points_that_more_than_double_the_rmse_are_one_notice() -> None:
    points = solved_of(["check"] * 5 + ["control"], 0.3).problem.points
    residuals = np.tile([0.6, 0.8, 1.0], (6, 1))
    doubts = (contradicted("p1"), contradicted("p5", "control"))
    for size, code in ((3.9, ["contradicting-point"] * 2), (4.1, ["checks-apart", "contradicting-point"])):
        # Of five points one has the size: the RMSE doubles at the root of 16.
        residuals[1, :2] = size, 0.0
        found = notices(doubts, points, residuals)
        assert [one.code for one in found] == code
    fields = found[0].fields
    assert (fields["count"], fields["off"], fields["points"], fields["alike"]) == (5, 1, ["p1"], False)
    assert fields["rmse_m"] == pytest.approx({"plan": math.sqrt((4 + 4.1**2) / 5), "height": 1.0})
    assert fields["rest_m"] == pytest.approx({"plan": 1.0, "height": 1.0})
    assert found[1].fields["point"] == "p5"
    # The height alone is enough.
    residuals[1] = 0.6, 0.8, -4.1
    found = notices(doubts, points, residuals)
    assert found[0].fields["rmse_m"] == pytest.approx({"plan": 1.0, "height": math.sqrt((4 + 4.1**2) / 5)})
    assert notices((contradicted("p5", "control"),), points, residuals)[0].code == "contradicting-point"


def test_check_points_of_which_half_contradict_are_one_notice() -> None:
    points = solved_of(["check"] * 5, 0.3).problem.points
    residuals = np.tile([0.6, 0.8, 1.0], (5, 1))
    residuals[4] = np.nan
    for names, spoilt in (("p1", False), ("p1 p3", True)):
        doubts = [contradicted(name, sigmas=k) for k, name in enumerate(names.split())]
        assert ("checks-apart" in {one.code for one in notices(doubts, points, residuals)}) is spoilt
    fields = notices(doubts, points, residuals)[0].fields
    assert (fields["count"], fields["off"], fields["points"]) == (4, 2, ["p3", "p1"])
    assert fields["alike"] is True
    all_of_them = [contradicted(f"p{k}") for k in range(4)]
    assert notices(all_of_them, points, residuals)[0].fields["rest_m"] is None


def test_standardised_residuals_are_over_the_median_of_chi_squared() -> None:
    ranks = np.array([1, 2, 2, 0])
    rays = np.array([4.0, 9.0, 16.0, 1e9])
    ground, of_ground = np.array([25.0, 36.0, 4.0]), np.array([3, 3, 0])
    made = StandardisedResiduals(rays, ranks, ground, of_ground)
    medians = stats.chi2.median([1, 2, 2, 3])
    of_rays = math.sqrt(float(np.median(rays[:3] / medians[:3])))
    assert made.scale_of_rays() == pytest.approx(of_rays, rel=1e-4)
    estimated = np.array([True, False, True])
    assert made.scale_of_ground(estimated) == pytest.approx(math.sqrt(25.0 / medians[3]), rel=1e-4)
    sizes = made.sizes(estimated)
    np.testing.assert_allclose(sizes[0], np.sqrt(rays) / of_rays, rtol=1e-4)
    np.testing.assert_allclose(sizes[1], [math.sqrt(medians[3]), 6.0, 2.0 / made.scale_of_ground(estimated)], rtol=1e-4)
    nothing = StandardisedResiduals(rays, 0 * ranks, ground, 0 * of_ground)
    assert (nothing.scale_of_rays(), nothing.scale_of_ground(estimated)) == (1.0, 1.0)


# -- variances ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axes", [(0, 1), (2,), (0,), (0, 2), (0, 1, 2)])
def test_the_chance_of_ground_is_the_mean_over_the_sigmas_that_are_possible(axes: tuple[int, ...]) -> None:
    nodes, chances = np.array([[1.0, 0.5, 4.0], [1.5, 2.0, 1.0], [0.7, 0.1, 9.0]]), np.array([0.5, 0.2, 0.3])
    made = Variances(1.0, 1.0, 2.0, (9.0, 2.0, 2.0), (3, 3), nodes=nodes, chances=chances)
    root = np.random.default_rng(1).normal(0, 1, (3, 3))
    spread, apart = (root @ root.T)[np.ix_(axes, axes)], np.array([1.0, -2.0, 3.0])[list(axes)]
    wanted = 0.0
    for (image, in_plan, height), chance in zip(nodes, chances, strict=True):
        own = np.diag(np.array([in_plan, in_plan, height])[list(axes)])
        square = apart @ np.linalg.inv(image * spread + own) @ apart
        wanted += chance * stats.chi2.sf(square, len(axes))
    assert made.chance_of(apart, spread, axes) == pytest.approx(wanted, rel=1e-10)


@pytest.mark.parametrize(
    ("sigmas", "separable", "assumed"),
    [
        ((0.4, 0.7), True, (0.4, 0.7)),
        ((None, 0.7), True, (PERFECT_GROUND, 0.7)),
        ((0.4, None), True, (0.4, PERFECT_GROUND)),
        ((None, None), False, (PERFECT_GROUND, PERFECT_GROUND)),
    ],
)
def test_variances_are_applied_as_sigmas(sigmas: Any, separable: bool, assumed: tuple[float, float]) -> None:
    made = Variances(1.5, *sigmas, (9.0, 1.0, 3.0), (3, 5), separable)
    problem: Any = SimpleNamespace(
        points=SimpleNamespace(sigma_image=np.array([0.2, 0.4])), with_sigmas=lambda *given: given,
        unstated=np.array([[True, True, False], [False, False, True], [False] * 3]),
    )  # fmt: skip
    image, ground = made.applied(problem)
    np.testing.assert_allclose(image, [0.3, 0.6])
    assert ground == assumed
    assert made.estimated == separable
    assert made.of_ground(problem).tolist() == [separable, separable, False]
    (note,) = made.notes()
    assert note.fields["count"] == 5
    assert (note.fields.get("sigma_xy"), note.fields.get("sigma_h")) == sigmas
    record = made.record.unstated_ground
    assert ((record.xy.points, record.xy.redundancy), (record.h.points, record.h.redundancy)) == ((3, 1.0), (5, 3.0))
    assert Variances(1.0, None, None, (9.0, 0.0, 0.0), (0, 0)).notes() == []


@pytest.mark.parametrize(("plan", "height"), [(1.9, 2.1), (2.1, 1.9)])
def test_a_sigma_of_less_than_two_degrees_of_freedom_is_hardly_determined(plan: float, height: float) -> None:
    (note,) = Variances(1.0, 0.4, 0.7, (9.0, plan, height), (5, 3)).notes()
    of_plan, of_height = (", hardly determined" if part < 2 else "" for part in (plan, height))
    text = f"0.4 m in plan (redundancy {plan}{of_plan}) and 0.7 m in height (redundancy {height}{of_height})"
    assert f"5 control points without a stated sigma: estimated as {text};" in str(note)
    (alone,) = Variances(1.0, None, 0.7, (9.0, 0.0, height), (0, 1)).notes()
    assert f"1 control point without a stated sigma: estimated as {text.partition(' and ')[2]};" in str(alone)


def test_a_shared_parameter_is_published_in_its_unit() -> None:
    """One with the information 3, one that the block hardly tells of: at 5 % it does."""
    for weak, known in ((0.04, False), (0.06, True)):
        told = np.diag([3.0, weak / (1 - weak)])
        parameters = tuple(
            SharedParameter(name, ("i0", "i1"), Prior(mean, sigma, shared="camera"), (0, 3))
            for name, mean, sigma in (("f", 100.0, 2.0), ("k1", 0.0, 0.5))
        )
        made = SharedPriors(
            value=np.array([1.2, -0.1]), told=told, parameters=parameters, by_params=np.zeros((6, 2)),
            by_points=np.ones((1, 3, 2)), by_heights=np.zeros((0, 2)),
        )  # fmt: skip
        focal, k1 = made.records
        assert (focal.value, focal.sigma, focal.determined) == pytest.approx((102.4, 1.0, 0.75))
        # Drawn with exact priors, the estimate has the variance C T C = 3 / 16.
        assert focal.chance == pytest.approx(stats.chi2.sf(1.2**2 / (3 / 16), 1))
        assert (focal.images, focal.prior.value, focal.prior.sigma) == (2, 100.0, 2.0)
        assert (k1.value, k1.sigma) == pytest.approx((-0.05, 0.5 * math.sqrt(1 - weak)))
        assert (k1.chance is not None) is known
    np.testing.assert_allclose(made.of_points[0], np.full((3, 3), 0.25 + 0.94))
    assert replace_chance(focal, 0.0009).significant
    assert not replace_chance(focal, 0.0011).significant
    assert not replace_chance(focal, None).significant


def replace_chance(record: Any, chance: float | None) -> Any:
    return record.replaced(chance=chance)


# -- heights -----------------------------------------------------------------------------------------------------------


def heights_of(stated: np.ndarray | None = None, **more: Any) -> Heights:
    none: Any = None
    numbers = {"sigma": 10.0, "own": np.ones(60), "common": none, "wrong": none, "broken": none, **more}
    return Heights(SimpleNamespace(correlation=None), np.ones(60, dtype=bool), none, none, stated, **numbers)


def test_a_sigma_is_estimated_from_fifty_heights_that_show_their_errors() -> None:
    random = np.random.default_rng(3)
    residuals, redundancy = random.normal(0, 2, 60), random.uniform(0.3, 0.9, 60)
    used = np.ones(60, dtype=bool)
    wanted = 1.4826 * float(np.median(np.abs(residuals) / np.sqrt(redundancy)))
    found = heights_of()._estimated(residuals, 100.0 * redundancy, used)
    assert found.estimated
    assert found.sigma == pytest.approx(wanted)
    assert found.sigma_is == "estimated"
    # Later half of the way, by its log; and what hardly differs stays.
    later = heights_of(estimated=True)._estimated(residuals, 100.0 * redundancy, used)
    assert later.sigma == pytest.approx(math.sqrt(10.0 * wanted))
    for part, same in ((0.97, True), (1.03, True), (0.95, False), (1.05, False)):
        near = heights_of(sigma=wanted / part)
        assert (near._estimated(residuals, near.sigma**2 * redundancy, used).sigma == near.sigma) is same
    # Ten heights without redundancy leave fifty; one more is too many.
    for without, enough in ((10, True), (11, False)):
        weak = np.where(np.arange(60) < without, 0.19, redundancy)
        found = heights_of()._estimated(residuals, 100.0 * weak, used)
        assert found.estimated is enough
        assert heights_of()._estimated(residuals, 100.0 * redundancy, np.arange(60) >= without).estimated is enough
    assert heights_of()._estimated(0 * residuals, 100.0 * redundancy, used).sigma == 0.01


def test_stated_sigmas_grow_where_residuals_are_significantly_larger() -> None:
    sigmas, used = np.linspace(1.0, 3.0, 60), np.ones(60, dtype=bool)
    residuals = sigmas * (-1.0) ** np.arange(60)
    for square, grows in ((1.0 + 2.4 * math.sqrt(2 / 60), False), (1.0 + 2.6 * math.sqrt(2 / 60), True)):
        found = heights_of(sigmas)._scaled(residuals * math.sqrt(square), sigmas**2, used)
        assert found.scale == pytest.approx(math.sqrt(square) if grows else 1.0)
        assert found.sigma_is == ("enlarged" if grows else "stated")
        np.testing.assert_allclose(found.sigmas, found.scale * sigmas)
    # Residuals of a quarter of the variance show a quarter of what the errors have more.
    found = heights_of(sigmas)._scaled(residuals * math.sqrt(0.25 * 1.5), 0.25 * sigmas**2, used)
    assert found.scale == pytest.approx(math.sqrt(1 + 0.5 / 0.25))
    assert heights_of(sigmas)._scaled(30 * residuals, sigmas**2, used).scale == 2.0, "at most twice in a round"
    back = heights_of(sigmas, scale=3.0)._scaled(0.01 * residuals, 9 * sigmas**2, used)
    assert back.scale == 1.5
    assert heights_of(sigmas, scale=1.2)._scaled(residuals, 1.44 * sigmas**2, used).scale == pytest.approx(1.0)
    # Too few heights, and such without redundancy, tell nothing.
    for part, enough in ((0.03, False), (0.05, True)):
        found = heights_of(sigmas)._scaled(residuals, part * sigmas**2, used)
        assert (found.scale > 1.0) is enough
    for count, enough in ((49, False), (50, True)):
        assert (heights_of(sigmas)._scaled(2 * residuals, sigmas**2, np.arange(60) < count).scale > 1.0) is enough


def test_errors_of_heights_are_without_a_shift_that_is_applied() -> None:
    loads = np.array([[5.0, -1.0, 0.0], [5.0, 0.0, 2.0], [5.0, 9.0, 9.0]])
    common = SimpleNamespace(value=np.array([1.0, 2.0, 3.0]), undone=np.array([0.0, 2.0, 3.0]), loads=loads)
    for applied, wanted in ((False, [3.0, 11.0, 50.0]), (True, [5.0, 5.0, 5.0])):
        heights: Any = SimpleNamespace(common=common, source=SimpleNamespace(correct_shift=applied))
        np.testing.assert_allclose(known_errors(heights), wanted)


def test_heights_of_unknown_accuracy_say_nothing_of_orthos() -> None:
    """A raster of sigmas may have voids where the DEM has heights."""
    common = SimpleNamespace(
        loads=np.ones((4, 3)), by_params=np.zeros((2, 3)), left=np.eye(3), value=np.zeros(3), undone=np.zeros(3)
    )
    terrain = SimpleNamespace(heights=np.array([1.0, np.nan, 1.0, 1.0]), slopes=np.zeros((4, 2)))
    source = SimpleNamespace(correct_shift=False, surface=SimpleNamespace(sample_size=10.0))
    heights: Any = SimpleNamespace(
        common=common, terrain=terrain, source=source, of=np.ones(4, dtype=bool), own=np.ones(4),
        sigmas=np.array([2.0, 2.0, np.nan, np.inf]),
    )  # fmt: skip
    assert np.isfinite(AdjustedDem.of(heights, None, 0.0).loads).all(axis=1).tolist() == [True, False, False, False]


# -- figures of a fit --------------------------------------------------------------------------------------------------


def test_root_mean_squares_of_groups_are_those_of_all() -> None:
    values = np.random.default_rng(1).normal(0, 2, (30, 2)) * (1.0, 3.0)
    found = merged(Rmse.of(values[:7]), None, Rmse.of(values[7:]))
    assert found is not None
    col, row = np.sqrt((values**2).mean(axis=0))
    assert (found.col, found.row, found.total, found.n) == pytest.approx((col, row, math.hypot(col, row), 30))
    assert merged(None, None) is None


def test_object_residuals_are_summed_up_by_role(chain: BlockFit) -> None:
    points = replace(chain.points, ground=np.where(np.arange(60)[:, None] < 5, np.ones(3), np.nan))
    points = points.with_roles(["check"] * 3 + ["control"] * 2 + ["tie"] * 55)
    residuals = np.full((60, 3), np.nan)
    residuals[:5] = [(3.0, 1.0, -2.0), (-3.0, 7.0, 2.0), (0.0, 0.0, np.nan), (1.0, 2.0, 3.0), (1.0, -2.0, 3.0)]
    fit = replace(chain, points=points, object_residuals=residuals)
    found = fit.object_rms()
    assert found is not None
    assert (found.x, found.y, found.h, found.plan, found.n) == pytest.approx((3.0, 5.0, 2.0, math.sqrt(34), 2))
    assert (list(found.min), list(found.max)) == ([-3.0, 1.0, -2.0], [3.0, 7.0, 2.0])
    assert fit.object_rms("tie") is None


def test_angles_of_rays_are_between_all_pairs_of_a_point() -> None:
    point = np.array([1, 0, 1, 1, 0, 2])
    turns = np.radians([10.0, 0.0, 40.0, 190.0, 180.0, 7.0])
    directions = np.column_stack([np.cos(turns), np.sin(turns), 0 * turns]) * np.arange(1.0, 7.0)[:, None]
    one, other, angles = ray_angles(point, directions)
    found = {
        tuple(sorted(pair)): angle for *pair, angle in zip(one.tolist(), other.tolist(), angles.tolist(), strict=True)
    }
    assert found == pytest.approx({(0, 2): 30.0, (0, 3): 0.0, (2, 3): 30.0, (1, 4): 0.0}, abs=1e-5)
    directions[2] = np.nan
    assert len(ray_angles(point, directions)[0]) == 2


@pytest.mark.parametrize(("ties", "sigma"), [(2, 3.0), (0, 0.001)])
def test_the_expected_accuracy_is_that_of_points_other_than_control(ties: int, sigma: float) -> None:
    """Control that was matched with a reference counts as exact to a millimetre, and there is much of it."""
    sigmas = np.concatenate([np.full((9, 3), 0.001), np.full((ties, 3), 3.0), np.full((1, 3), np.nan)])
    fit: Any = SimpleNamespace(parameters=(("a", "b0"),), ground_sigmas=sigmas, used_ground=np.arange(len(sigmas)) < 9)
    found = block_report._absolute(fit)
    assert found is not None
    assert (found.east_m, found.north_m, found.height_m, found.points) == (sigma, sigma, sigma, ties or 9)
