"""What takes part in a block and with which weight, what is refused, and where limits are: cases by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import CRS, Block, Chain, fly, to_image, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.datum import _held, _missed, _pixels_per_metre, with_start_errors
from ortho_pipeline.block.determination import uncertain_images
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import PERFECT_GROUND, BlockProblem, Misfits, Pseudo, Selection, State
from ortho_pipeline.block.equations.solver import Solved, attempt
from ortho_pipeline.block.heights.settling import _stable
from ortho_pipeline.block.heights.terrain import LocalTerrain
from ortho_pipeline.block.local_frame import GEODETIC
from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.block.reliability.suspects import Trusted, _Limits, judge
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.block.variances.shared_errors import SharedByImage
from ortho_pipeline.errors import DegeneratePoints, InputError
from ortho_pipeline.estimation.observations.on_points import Planes
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Constraints


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=2, convergence_deg=20.0, ties=30, errors=2.0), 3)


@pytest.fixture(scope="module")
def prepared(flown: Block) -> tuple[BlockProblem, Any, Selection]:
    points = with_control(flown, count=4)
    return _prepared(tuple(flown.start.values()), points, {}, ())


def test_a_point_takes_part_with_two_rays_or_one_and_known_ground(prepared: Any) -> None:
    problem, _, _ = prepared
    points = problem.points
    control, tie = np.flatnonzero(points.control), np.flatnonzero(points.tie)
    rays = np.ones(points.rays, dtype=bool)
    for point, left in ((control[0], 1), (control[1], 0), (control[2], 1), (tie[0], 1), (tie[1], 0)):
        rays[np.flatnonzero(points.point == point)[left:]] = False
    ground = points.control.copy()
    ground[control[2]] = False
    active = problem.active(Selection.of(rays, ground))
    assert np.flatnonzero(~active).tolist() == sorted([control[1], control[2], tie[0], tie[1]])
    ordering = problem.ordering(Selection.of(rays, ground))
    assert set(ordering.grounded.tolist()) == {control[0], control[3]}
    # Without a place in plan, ground determines nothing.
    known = problem.known.copy()
    known[control[0], 0] = np.nan
    assert not replace(problem, known=known).active(Selection.of(rays, ground))[control[0]]


def test_sigmas_of_ground_are_stated_or_assumed_and_never_perfect(prepared: Any) -> None:
    problem, _, _ = prepared
    first, second, third, fourth = np.flatnonzero(problem.points.control)
    sigmas, known = problem.points.sigma_ground.copy(), problem.known.copy()
    sigmas[first], sigmas[second], sigmas[third] = (0.2, 0.0, 0.4), (0.0, 0.3, 0.0), 1e-7
    known[fourth, 2] = np.nan
    found = replace(problem, points=replace(problem.points, sigma_ground=sigmas), known=known, assumed=(2.0, 5.0))
    assert found.ground_sigmas[first].tolist() == [0.2, 2.0, 0.4]
    assert found.ground_sigmas[second].tolist() == [2.0, 0.3, 5.0]
    assert found.ground_sigmas[third].tolist() == [PERFECT_GROUND] * 3
    assert found.ground_sigmas[fourth].tolist() == [0.1, 0.1, math.inf]
    assert np.isinf(found.ground_sigmas[problem.points.tie]).all()
    wanted = np.zeros((len(sigmas), 3), dtype=bool)
    wanted[first, 1] = wanted[second, 0] = wanted[second, 2] = True
    np.testing.assert_array_equal(found.unstated, wanted)
    other = problem.with_sigmas(2.5 * problem.points.sigma_image, (1.0, 1.0))
    assert other.factor_of(problem.points) == pytest.approx(2.5)
    assert other.ground_sigmas is not problem.ground_sigmas


def test_what_ground_is_off_is_in_metres_east_north_up(prepared: Any) -> None:
    problem = prepared[0]
    rows = np.flatnonzero(problem.points.control)
    east, north, up = problem.enu[rows[0]]
    local = problem.target.copy()
    local[rows] -= 3.0 * east - 2.0 * north + 7.0 * up
    found = problem.on_points(local, rows)
    np.testing.assert_allclose(found.apart, [[3.0, -2.0, 7.0]] * 4, atol=1e-3)
    np.testing.assert_allclose(found.misfits(np.full(4, 0.25)), found.apart / 0.1 * 0.5)


def test_held_parameters_outweigh_an_error_that_all_rays_share(prepared: Any) -> None:
    problem, state, selection = prepared
    held = tuple(Pseudo(column, 0.0, 4.0, held=True, slow=0.03) for column in (1, 3))
    found = replace(problem, pseudo=(Pseudo(0, 1.0, 2.0), *held))
    rays = np.bincount(problem.points.image) / 0.1**2
    np.testing.assert_allclose(found.firmness, [1.0, 1 + 0.03**2 * rays[0], 1 + 0.03**2 * rays[1]])
    equations = found.pseudo_equations(state)
    roots = np.sqrt(found.firmness) / [2.0, 4.0, 4.0]
    np.testing.assert_allclose(equations.misfit, roots * ([1.0, 0.0, 0.0] - state.params[[0, 1, 3]]))
    assert equations.image.tolist() == [0, 0, 1]
    np.testing.assert_allclose(equations.rows, np.diag(roots)[:, [0, 1]] + np.diag(roots)[:, [2, 2]] * [0, 1])
    assert equations.true.tolist() == [True, False, False]
    # Errors of the start are larger than they count by the firmness: the solution takes C W of them over.
    linear = Linear.at(found, state, selection)
    solved = attempt(found, state, selection)
    covariance = solved.cofactors.matrix
    of_start = np.zeros((problem.size, 2))
    of_start[[1, 3], [0, 1]] = roots[1:] ** 2 * 4.0 * np.sqrt(1 - 1 / found.firmness[1:])
    wanted = covariance + covariance @ of_start @ of_start.T @ covariance
    np.testing.assert_allclose(with_start_errors(linear, solved.cofactors).matrix, wanted, rtol=1e-9, atol=1e-15)


def test_constraints_of_models_are_equations_of_their_images(prepared: Any) -> None:
    problem, state, _ = prepared
    jacobian = np.array([[1.0, 0.0], [2.0, -3.0]])
    known = Constraints(np.array([4.0, 6.0]), jacobian, np.array([0.5, 2.0]), np.array([True, False]))
    models = (state.models[0], SimpleNamespace(constraints=lambda: known, params=np.zeros(2)))
    held = replace(problem, pseudo=(Pseudo(1, 0.0, 4.0, held=True), Pseudo(2, 1.0, 5.0)))
    found = held.pseudo_equations(State(models, state.local))  # type: ignore[arg-type]
    assert found.image.tolist() == [0, 1, 1, 1]
    assert found.true.tolist() == [False, True, False, True]
    np.testing.assert_allclose(found.misfit[1:], [0.2, 8.0, 3.0])
    np.testing.assert_allclose(found.rows, [[0.0, 0.25], [0.2, 0.0], [2.0, 0.0], [1.0, -1.5]])


def test_the_datum_is_measured_by_how_far_rays_miss_each_other(prepared: Any) -> None:
    problem, state, selection = prepared
    linear = Linear.at(problem, state, selection)
    for image, found in enumerate(_pixels_per_metre(linear).tolist()):
        shown = problem.points.point[problem.points.image == image]
        ground = ground_transform(GEODETIC, CRS)(problem.frame.geodetic(state.local[shown]))
        steps = np.array([(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0)])
        ends = [to_image(state.models[image], ground + step) for step in steps]
        squares = ((ends[0] - ends[1]) ** 2 + (ends[2] - ends[3]) ** 2).sum(axis=1) / 2
        assert found == pytest.approx(math.sqrt(squares.mean()), rel=1e-3)
    # Two rays have four coordinates and a point three: one is left.
    rays = np.zeros((problem.points.rays, 2))
    of = problem.points.point
    sizes = np.linspace(1.0, 3.0, len(problem.points))
    for point in range(len(problem.points)):
        mine = np.flatnonzero(of == point)
        rays[mine] = sizes[point] / math.sqrt(len(mine)) * np.array([0.6, -0.8]) / 0.1
    made = replace(linear, misfits=Misfits(rays, linear.misfits.ground, linear.misfits.pseudo))
    assert (np.bincount(of) == 2).all()
    assert _missed(made) == pytest.approx(math.sqrt(float(np.median(sizes**2))))
    # A pixel of shift is a pixel in the image.
    held = _held(linear, np.array([4.0, 8.0]), 0.05)
    assert [(one.column, one.sigma, one.slow) for one in held] == [
        (0, pytest.approx(4.0), 0.05), (1, pytest.approx(4.0), 0.05),
        (2, pytest.approx(8.0), 0.05), (3, pytest.approx(8.0), 0.05),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("spread", "measured", "held", "said"),
    [
        (9.9, 1.0, False, "nothing"), (10.1, 1.0, False, "edge"), (99.0, 1.0, False, "edge"),
        (101.0, 1.0, False, "refused"), (101.0, 1.0, True, "nothing"), (19.8, 2.0, False, "nothing"),
        (20.2, 2.0, False, "edge"),
    ],
)  # fmt: skip
def test_an_uncertain_image_is_said_from_ten_and_refused_from_a_hundred_measurements(
    prepared: Any, spread: float, measured: float, held: bool, said: str
) -> None:
    """A shift has the same effect everywhere: here with a sigma of `spread` times what measurements have."""
    problem, state, selection = prepared
    linear = Linear.at(problem, state, selection)
    sigma = spread * 0.1
    pseudo = (Pseudo(0, 0.0, 1.0, held=True),) if held else ()
    cofactors = SimpleNamespace(of_image=lambda image: np.eye(2) * sigma**2)
    solved: Any = SimpleNamespace(problem=replace(problem, pseudo=pseudo), linear=linear, state=state,
                                  cofactors=cofactors)  # fmt: skip
    stated = problem.points.with_image_sigmas(measured * problem.points.sigma_image)
    if said == "refused":
        with pytest.raises(DegeneratePoints, match=r"'i0'.*101 times less"):
            uncertain_images(solved, stated)
        return
    found = uncertain_images(solved, stated)
    assert [one.fields["factor"] for one in found] == (
        [] if said == "nothing" else [pytest.approx(spread / measured)] * 2
    )


def test_an_image_that_is_placed_by_its_priors_is_as_uncertain_as_these(flown: Block) -> None:
    """A position of GNSS is hundreds of times less accurate than ties: that refuses no image and warns of none."""
    problem, state, selection = _prepared(tuple(flown.start.values()), flown.points, {}, ())
    linear = Linear.at(problem, state, selection)
    cofactors = SimpleNamespace(of_image=lambda image: np.eye(2) * 15.0**2)
    for count, refused in ((problem.size, False), (problem.size - 1, True)):
        pseudo = tuple(Pseudo(column, 0.0, 15.0) for column in range(count))
        solved: Any = SimpleNamespace(problem=replace(problem, pseudo=pseudo), linear=linear, state=state,
                                      cofactors=cofactors)  # fmt: skip
        if refused:
            with pytest.raises(DegeneratePoints, match="150 times less"):
                uncertain_images(solved, problem.points)
        else:
            assert uncertain_images(solved, problem.points) == []


def rays_of(folder: Path, *rows: str) -> Path:
    path = folder / "rays.csv"
    path.write_text("id,image,col,row,x,y,h\n" + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize(("column", "same"), [(5.0000004, True), (5.000002, False)])
def test_a_pixel_of_an_image_is_one_ray_to_a_millionth(tmp_path: Path, column: float, same: bool) -> None:
    path = rays_of(tmp_path, "a,one.tif,5,6,33.1,37,0", f"b,one.tif,{column!r},6,33.2,37,0", "b,two.tif,5,6,,,")
    if not same:
        assert len(read_block_points(path, crs="EPSG:4979").measured) == 3
        return
    with pytest.raises(InputError, match=r"line 3.*the same pixel.*line 2.*'a'"):
        read_block_points(path, crs="EPSG:4979")


def planes(above: np.ndarray, on: np.ndarray, sigma: float) -> Planes:
    """Return level planes so far above the middle of the frame."""
    places = np.column_stack([np.zeros((len(above), 2)), above])
    return Planes(places, np.tile(np.eye(3), (len(above), 1, 1)), np.where(on, sigma, np.inf))


@pytest.mark.parametrize("sigma", [0.25, 4.0])
def test_heights_are_stable_if_two_per_cent_moved_by_two_per_cent_of_their_sigma(sigma: float) -> None:
    on, count = np.arange(2000) < 1000, np.arange(2000)
    before = planes(np.zeros(2000), on, sigma)
    solved: Any = SimpleNamespace(
        problem=SimpleNamespace(heights=before), state=SimpleNamespace(local=np.ones((2000, 3)))
    )

    def stable(moved: np.ndarray, used: np.ndarray = on) -> bool:
        problem: Any = SimpleNamespace(heights=planes(moved, used, sigma))
        return _stable(solved, problem)

    assert stable(np.full(2000, 0.019 * sigma))
    assert not stable(np.full(2000, -0.021 * sigma))
    assert stable(9.0 * sigma * (count < 20))
    assert not stable(9.0 * sigma * (count < 21))
    # One of a thousand may be left out anew or take part again.
    assert stable(np.zeros(2000), on ^ (count == 1000))
    assert not stable(np.zeros(2000), on ^ ((count >= 999) & (count <= 1001)))


def test_a_group_of_few_points_counts_as_one_point(prepared: Any) -> None:
    """The covariance of the parameters grows by as many times as points are more than groups."""
    problem, state, selection = prepared
    points = problem.points
    groups, control = np.full(points.rays, -1), np.flatnonzero(points.control)
    mine = [np.flatnonzero((points.image == 0) & (points.point == point))[0] for point in control]
    groups[mine], tie = (0, 0, 0, 1), np.flatnonzero(points.tie)[0]
    # Neighbours on ground that is not known say nothing.
    groups[np.flatnonzero((points.image == 0) & (points.point == tie))] = 2
    grouped = replace(problem, points=replace(points, groups=groups))
    solved = attempt(grouped, state, selection)
    found = SharedByImage.of(solved)
    assert found is not None
    assert [(name, one.points, one.groups) for name, one in found.images.items()] == [("i0", 4, 2)]
    linear, flat = solved.linear, np.zeros((8, 2))
    for k, ray in enumerate(mine):
        rows = np.vstack([linear.by_point[ray], linear.ground_by_point[points.point[ray]]])
        own = np.vstack([linear.by_params[ray][:, :2], np.zeros((3, 2))])
        flat[2 * k : 2 * k + 2] = (own - rows @ np.linalg.lstsq(rows, own, rcond=None)[0])[:2]
    sigma0 = solved.unit_weight()[0]
    assert sigma0 is not None
    # All of them are off by 0.002 px together.
    alike = 0.002 * flat.T @ np.tile(np.eye(2), (4, 1)) / 0.1
    inner = (4 / 2 - 1) * sigma0**2 * flat.T @ flat + alike @ alike.T
    own = solved.cofactors.matrix[:, :2]
    wanted = solved.cofactors.matrix + own @ inner @ own.T
    np.testing.assert_allclose(found.added(solved.cofactors).matrix, wanted, rtol=1e-9, atol=1e-15)
    assert SharedByImage.of(attempt(problem, state, selection)) is None


# -- suspects ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def solved(prepared: Any) -> Solved:
    problem, state, selection = prepared
    return attempt(problem, state, selection)


def judged(solved: Solved, selection: Selection, name: str, **moved: Any) -> tuple[Selection, Any]:
    """Return the verdict on a point alone, whose rays or ground are moved, by the solution without it."""
    points, known = solved.problem.points, solved.problem.known.copy()
    number = points.ids.index(name)
    measured = points.measured.copy()
    for ray, by in moved.get("rays", {}).items():
        measured[np.flatnonzero(points.point == number)[ray]] += by
    known[number] += moved.get("ground", 0.0)
    problem = replace(solved.problem, points=replace(points, measured=measured), known=known)
    suspects = np.arange(len(points)) == number
    of_others = Selection.of(selection.rays & ~suspects[points.point], selection.ground & ~suspects)
    trusted = Trusted(attempt(problem, solved.state, of_others), Variances(1.0, None, None, (50.0, 0.0, 0.0), (0, 0)))
    kept, rejected = judge(trusted, selection, suspects)
    assert set(rejected) <= {number}
    return kept, rejected.get(number)


def test_suspects_are_judged_part_by_part(solved: Solved, prepared: Any) -> None:
    selection, points = prepared[2], solved.problem.points
    control, tie = (points.ids[int(np.flatnonzero(mask)[0])] for mask in (points.control, points.tie))
    for name in (control, tie):
        kept, one = judged(solved, selection, name)
        assert one is None
        assert kept.rays.all()
        np.testing.assert_array_equal(kept.ground, selection.ground)
    # Ground 9 m too high, seen by two rays that meet.
    number = points.ids.index(control)
    kept, one = judged(solved, selection, control, ground=np.array([0.0, 0.0, 9.0]))
    assert (one.what, one.image) == ("ground", None)
    assert float(one.reason.split()[2]) == pytest.approx(9.0, abs=1.0)
    assert kept.rays.all()
    assert np.flatnonzero(selection.ground & ~kept.ground).tolist() == [number]
    # One ray 20 px off along the other's epipolar line and across it: known ground tells which.
    ray = np.flatnonzero(points.point == number)
    for k in (0, 1):
        kept, one = judged(solved, selection, control, rays={k: np.array([12.0, 16.0])})
        assert (one.what, one.image) == ("ray", points.images[points.image[ray[k]]])
        assert float(one.reason.split()[2]) == pytest.approx(20.0, abs=1.5)
        assert np.flatnonzero(~kept.rays).tolist() == [ray[k]]
        assert kept.ground[number]
    # Of a tie's two rays nothing tells which is wrong: both go.
    number = points.ids.index(tie)
    kept, one = judged(solved, selection, tie, rays={0: np.array([0.0, 20.0])})
    assert (one.what, one.image) == ("point", None)
    # Each ray takes half of the gap.
    assert float(one.reason.split()[8]) == pytest.approx(10.0, abs=1.0)
    np.testing.assert_array_equal(np.flatnonzero(~kept.rays), np.flatnonzero(points.point == number))


def test_limits_are_those_of_fishers_distribution(solved: Solved, prepared: Any) -> None:
    from scipy.stats import f

    trusted = Trusted(solved, Variances(1.0, 0.3, 0.4, (50.0, 3.0, 2.0), (4, 4), freedom=6.0))
    limits = _Limits.of(trusted, prepared[2])
    freedom, points = solved.unit_weight()[1], len(solved.problem.points)
    for size in (1, 2, 3):
        edge = size * f.isf(0.001 / points, size, freedom)
        assert limits.passes(np.array([0.999, 1.001]) * edge, size).tolist() == [True, False]
        edge = size * f.isf(0.01 / 4, size, 6.0)
        assert limits.passes_ground(np.array([0.999, 1.001]) * edge, size).tolist() == [True, False]
    assert not limits.passes(np.zeros(1), 0).any()


# -- planes of a DEM ---------------------------------------------------------------------------------------------------


def test_planes_of_a_dem_are_along_its_slopes(prepared: Any) -> None:
    """A point that moves over its plane stays on it; one that is known in plan has the error of its plan in height."""
    problem, state, _ = prepared
    count, placed = len(problem.points), int(np.flatnonzero(problem.points.control)[0])
    known = problem.known.copy()
    known[placed, 2] = np.nan
    problem = replace(problem, known=known)
    ground = problem.frame.geodetic(state.local)
    slopes, heights = np.tile([0.3, -0.4], (count, 1)), ground[:, 2] + 5.0
    tie = np.flatnonzero(problem.points.tie)
    heights[tie[0]] = slopes[tie[1], 1] = np.nan
    sigmas = np.full(count, 2.0)
    sigmas[tie[2]] = np.inf
    none = np.zeros(count, dtype=bool)
    terrain = LocalTerrain(ground, heights, slopes, ground[:, :2], slopes, none, none, 10.0)
    of = problem.points.tie | (np.arange(count) == placed)
    of[tie[3]] = False
    found = terrain.planes(problem, of, sigmas, np.full(count, 1.0))
    assert np.flatnonzero(~found.on & of).tolist() == tie[:3].tolist()
    assert not found.on[tie[3]]
    length, enu = math.sqrt(1.25), problem.frame.enu_at(ground)
    axes = found.axes[tie[4:]]
    np.testing.assert_allclose(axes @ axes.swapaxes(1, 2), [np.eye(3)] * len(axes), atol=1e-12)
    for moved, above in (((0.0, 0.0, 0.0), 4.0), ((10.0, 0.0, 3.0), 4.0), ((0.0, 10.0, -4.0), 4.0), ((0, 0, 2.5), 1.5)):
        off = found.above(state.local + np.einsum("nij,i->nj", enu, np.array(moved, dtype=float)))
        np.testing.assert_allclose(off[tie[4:]], above / length, atol=1e-3)
    np.testing.assert_allclose(found.sigmas[tie[4:]], 2.0 / length)
    # With a sigma of 0.1 m in plan.
    assert found.sigmas[placed] == pytest.approx(math.sqrt(4.0 + 0.25 * 0.1**2))
    off = found.above(state.local + np.einsum("nij,i->nj", enu, np.array([10.0, 7.0, 1.0])))
    assert off[placed] == pytest.approx(3.0, abs=1e-3)
