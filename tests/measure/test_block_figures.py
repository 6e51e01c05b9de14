"""What a block tells of each point, and where the next one tells most, against adjustments that are made anew."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from ortho_measure.block.left_out import LeftOutResiduals
from ortho_measure.block.planning import BlockGrid, next_of_block
from ortho_measure.block.solution import figures, solve
from ortho_measure.block.table import block_points, document, marks_of_block
from ortho_measure.marks import Marks
from ortho_studies.simulation.scanner import LineScanner

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.points import BlockPoints, shape_of
from ortho_pipeline.block.start import Start
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.rational import RPC

LABELS = ("fore", "nadir", "aft")
_BIAS = {"fore": (4.0, -3.0), "nadir": (-6.0, 2.0), "aft": (1.0, 5.0)}


@pytest.fixture(scope="module")
def cameras() -> dict[str, RPC]:
    """RPCs of three line scanners: quick to compute."""
    found = {}
    for name, angle in zip(LABELS, (18.0, 2.0, -14.0), strict=True):
        camera = LineScanner.over(33.35, 37.25, 850.0, off_nadir_deg=angle, heights=(600.0, 1200.0))
        centre, half = camera.domain
        box = *(centre - 1.02 * half)[:2].tolist(), *(centre + 1.02 * half)[:2].tolist()
        found[name] = fit_rpc(camera, box, (600.0, 1200.0)).rpc
    return found


def starts_of(cameras: dict[str, RPC], correction: str = "shift-drift", **priors: Prior) -> dict[str, Start]:
    """Return cameras whose image points are to be corrected; only their models count here."""
    scene = Scene("test", "test.tif", 1000, 1000, dict(cameras), "test")
    return {
        name: Start(scene, ImageCorrection.identity(camera, correction, (500.0, 500.0)), name, "test", priors)
        for name, camera in cameras.items()
    }  # fmt: skip


def ground_of(count: int, seed: int = 1) -> np.ndarray:
    """Return ground (lon, lat, h) all over the scenes, with 300 m of relief."""
    rng = np.random.default_rng(seed)
    return np.column_stack([33.35 + rng.uniform(-0.011, 0.011, count), 37.25 + rng.uniform(-0.009, 0.009, count),
                            850 + rng.uniform(-150, 150, count)])  # fmt: skip


def table_of(cameras: dict[str, RPC], ground: np.ndarray, roles: list[str], rng: Any, sigma: Any = (0.3, 0.5),
             images: tuple[str, ...] = LABELS) -> BlockPoints:  # fmt: skip
    """Return points that all images show, with errors of the sizes that they state."""
    count, measured = len(ground), []
    for name in images:
        there = cameras[name].ground_to_image(ground_transform("EPSG:4979", cameras[name].crs)(ground))
        measured.append(there + _BIAS[name] + rng.normal(0, 1, there.shape) * (0.3, 0.15))
    plan, height = sigma or (0.3, 0.5)
    metres = rng.normal(0, 1, (count, 3)) * (plan, plan, height)
    known = ground + metres / (88_700.0, 111_000.0, 1.0)
    role = np.array([roles[k % len(roles)] for k in range(count)])
    shape = np.tile(np.diag([0.3**2, 0.15**2]), (count * len(images), 1, 1))
    return BlockPoints(
        ids=tuple(f"P{k}" for k in range(count)), ground=np.where((role == "tie")[:, None], np.nan, known), roles=role,
        sigma_ground=np.tile([plan, plan, height] if sigma else [0.0] * 3, (count, 1)),
        crs=horizontal(parse_crs("EPSG:4979")), images=images,
        point=np.tile(np.arange(count), len(images)), image=np.repeat(np.arange(len(images)), count),
        measured=np.concatenate(measured), sigma_image=np.full(count * len(images), np.sqrt(0.3 * 0.15)), source="",
        shape_image=shape_of(shape),
    )  # fmt: skip


def adjusted(starts: dict[str, Start], table: BlockPoints) -> BlockFit:
    return adjust({name: starts[name].model for name in table.images}, table,
                  priors={name: starts[name].priors for name in table.images}, robust=False)  # fmt: skip


@pytest.mark.parametrize("sigma", [(0.3, 0.5), None])
@pytest.mark.parametrize("priors", [{}, {"column_0": Prior(0.0, 2.0)}])
def test_a_control_point_left_out_is_as_if_it_had_checked(cameras: Any, sigma: Any, priors: Any) -> None:
    """With three images, drifts, measurements of unequal axes, and sigmas of the ground stated or found."""
    starts = starts_of(cameras)
    if priors:
        first = starts["fore"].model.param_names[0]
        starts["fore"] = replace(starts["fore"], priors={first: Prior(0.0, 2.0)})
    table = table_of(cameras, ground_of(30), ["control", "tie", "check"], np.random.default_rng(4), sigma)
    fit = adjusted(starts, table)
    without = LeftOutResiduals.of(fit, starts, None)
    # Which sigmas are found depends on all points; with those of all of them one is left out.
    table = table if sigma else table.with_ground_sigma(fit.variances.sigma_xy, fit.variances.sigma_h)
    for k in (0, 3, 6):
        roles = table.roles.copy()
        roles[k] = "check"
        as_check = adjusted(starts, table.with_roles(roles)).object_residuals[k]
        # The factor of the measurements is found anew without it, which shifts weights: millimetres, where the others
        # know the height to 2 m.
        assert without.ground[k] == pytest.approx(as_check, abs=0.01)
        assert np.linalg.norm(without.ground[k]) > 1.05 * np.linalg.norm(fit.object_residuals[k])
    checks = table.roles == "check"
    np.testing.assert_allclose(without.ground[checks], fit.object_residuals[checks])
    assert np.isnan(without.ground[table.roles == "tie"]).all()


def test_points_of_a_file_keep_what_they_have_in_common() -> None:
    """Common errors of ground, and of neighbouring matches: `ortho adjust` reads them from the saved file again."""
    rng = np.random.default_rng(2)
    count, rays = 4, 12
    points = BlockPoints(
        tuple("abcd"), ground_of(count), np.full(count, "control"), np.full((count, 3), 0.2),
        horizontal(parse_crs("EPSG:4979")), LABELS, np.repeat(np.arange(count), 3), np.tile(np.arange(3), count),
        rng.uniform(0, 1000, (rays, 2)), np.full(rays, 0.3), sigma_common=np.array([2.0, 2.0, 0.0, 3.0]),
        groups=np.array([-1, 0, 0, 1, 1, 1, 2, 2, 2, -1, -1, 5]),
    )  # fmt: skip
    marks = Marks({mark.id: mark for mark in marks_of_block(points, "now")})
    again = block_points(marks, LABELS, "p")
    np.testing.assert_array_equal(again.sigma_common, points.sigma_common)
    np.testing.assert_array_equal(again.grouped, points.grouped)
    written = document(marks, dict.fromkeys(LABELS, "x.tif"), "p")["features"]
    assert [one["properties"].get("group", -1) for one in written] == points.grouped.tolist()
    assert [one["properties"].get("sigma_common", 0.0) for one in written[::3]] == points.sigma_common.tolist()


def test_a_ray_left_out_is_where_the_others_put_it_and_of_two_only_across_the_other(cameras: Any) -> None:
    starts = starts_of(cameras)
    table = table_of(cameras, ground_of(30), ["control", "tie", "tie"], np.random.default_rng(5))
    fit = adjusted(starts, table)
    without = LeftOutResiduals.of(fit, starts, None)
    for ray in (1, 31, 62):
        kept = table.of_rays(np.arange(table.rays) != ray)
        again = adjusted(starts, kept)
        name = table.images[table.image[ray]]
        model = again.models[name]
        place = model.ground_to_image(
            ground_transform("EPSG:4979", model.crs)(again.ground[[table.point[ray]]]))[0]  # fmt: skip
        assert without.rays[ray] == pytest.approx(table.measured[ray] - place, abs=0.01)
    # Of two images one leads along the other's ray: the part across it is all that is told, and the same of both.
    two = table.of_rays(table.image != 1)
    two = replace(two, images=("fore", "aft"), image=two.image // 2)
    pair = {name: starts[name] for name in two.images}
    fit = adjusted(pair, two)
    of_ties = LeftOutResiduals.of(fit, pair, None).rays[fit.points.roles[fit.points.point] == "tie"].reshape(2, -1, 2)
    assert np.isfinite(of_ties).all()
    np.testing.assert_allclose(np.linalg.norm(of_ties[0], axis=1), np.linalg.norm(of_ties[1], axis=1), rtol=0.02)


def test_w_is_as_large_as_chance_has_it_and_names_what_is_wrong(cameras: Any) -> None:
    starts, rng = starts_of(cameras, "shift"), np.random.default_rng(6)
    chances = []
    for turn in range(3):
        table = table_of(cameras, ground_of(60, turn), ["control", "tie", "check"], rng)
        chances.append(LeftOutResiduals.of(adjusted(starts, table), starts, None).chance)
    # The least of a tie's three and a known point's four, which depend on each other: between one and four chances.
    share = np.mean(np.concatenate(chances) < 0.05)
    assert 0.04 < share < 0.22
    measured = table.measured.copy()
    measured[table.point == 7] += np.array([[0.0, 0.0], [2.5, 1.5], [0.0, 0.0]])
    wrong = replace(table, measured=measured)
    solution = solve(starts, wrong, None)
    assert solution.left_out is not None
    told = figures(solution, relative=False)
    assert [name for name, one in told["points"].items() if one["suspicious"]] == ["P7"]


def test_without_check_points_control_left_out_in_turn_is_the_headline(cameras: Any) -> None:
    starts = starts_of(cameras, "shift")
    table = table_of(cameras, ground_of(24), ["control", "tie"], np.random.default_rng(7))
    told = figures(solve(starts, table, None), relative=True)["headline"]
    apart = []
    for k in range(0, 24, 2):
        roles = table.roles.copy()
        roles[k] = "check"
        apart.append(adjusted(starts, table.with_roles(roles)).object_residuals[k])
    assert told["px"] is None
    assert told["m"] == pytest.approx(np.hypot(*np.sqrt((np.array(apart)[:, :2] ** 2).mean(axis=0))), rel=0.01)
    assert "12 control points (leave-one-out), relative to the reference" in told["what"]
    ties = figures(solve(starts, table.with_roles(np.full(24, "tie")), None), relative=False)["headline"]
    assert ties["m"] is None
    assert "no check points" in ties["what"]


@pytest.mark.parametrize("tie", [False, True])
def test_the_gain_of_the_next_place_is_that_of_a_point_which_is_measured_there(cameras: Any, tie: bool) -> None:
    """A strip whose points lie in its west: the next place is in the east, and gains what it is said to."""
    starts, rng = starts_of(cameras), np.random.default_rng(8)
    ground = ground_of(45)
    ground[:, 0] = 33.341 + (ground[:, 0] - 33.339) / 6
    table = table_of(cameras, ground, ["control", "tie", "tie"], rng)
    fit = adjusted(starts, table)
    axes = 33.35 + np.linspace(-0.01, 0.01, 5), 37.25 + np.linspace(-0.008, 0.008, 5)
    lon, lat = (part.ravel() for part in np.meshgrid(*axes))
    places = np.column_stack([lon, lat, np.full(25, 850.0)])
    seen = np.ones((25, 3), dtype=bool)
    seen[:5, 2] = False
    grid = BlockGrid(np.zeros(25, dtype=int), np.arange(50.0).reshape(25, 2), places, places, seen, seen, 20.0)
    offered = next_of_block(grid, fit, ground, tie=tie)
    best = offered[0]
    assert best.role == ("tie" if tie else "control")
    place = places[int(best.image[0] // 2)]
    assert place[0] > 33.355
    assert best.then < best.largest
    # The same by an adjustment with that point, which leaves the sigma of unit weight nearly as it was.
    more = table_of(cameras, np.vstack([ground, place]), ["control", "tie", "tie"], np.random.default_rng(8))
    roles = more.roles.copy()
    roles[-1] = "tie" if tie else "control"
    known = more.ground.copy()
    known[:-1][table.roles != "tie"] = table.ground[table.roles != "tie"]
    known[-1] = np.nan if tie else place
    of_new = more.point == 45
    measured = more.measured.copy()
    measured[~of_new] = table.measured
    measured[of_new] = [fit.models[name].ground_to_image(
        ground_transform("EPSG:4979", fit.models[name].crs)(place[None]))[0] for name in LABELS]  # fmt: skip
    again = adjusted(starts, replace(more, roles=roles, ground=known, measured=measured))
    after = next_of_block(grid, again, ground, tie=tie)[0]
    assert after.largest == pytest.approx(best.then, rel=0.02)
    # Without a fit it is the middle, as far as places go.
    assert next_of_block(grid, None, ground[:0], tie=tie)[0].sigma is None
    assert next_of_block(grid, None, places, tie=tie) == []
