"""Intersection of rays: of linear models against NumPy's least squares, and its parts by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from pair import Pair
from scipy import stats

from ortho_pipeline.block.intersection import (
    _LONGEST,
    PARALLEL,
    _contradicting,
    _solved,
    frame_of,
    intersect,
    models_of,
)
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.models import MapPlane

#: Images of a map, displaced by heights: pixels (m) and displacement per metre of height, x and y.
VIEWS = {"a": (1.0, (0.3, 0.0)), "b": (2.0, (-0.3, 0.1)), "c": (1.5, (0.0, 0.25))}
MODELS = {
    name: MapPlane("EPSG:32633", (500_000.0, 4_640_000.0), (pixel, pixel), (9000, 9000), 100.0, relief, (0.0, 500.0))
    for name, (pixel, relief) in VIEWS.items()
}
TRUTH = np.array([[500_100.0, 4_639_900.0, 120.0], [500_300.0, 4_639_500.0, 300.0], [500_200.0, 4_639_700.0, 50.0]])
TO_MAP = pyproj.Transformer.from_crs(4979, 32633, always_xy=True)


def seen(name: str) -> np.ndarray:
    ground = pyproj.Transformer.from_crs(32633, pyproj.CRS(MODELS[name].crs), always_xy=True)
    return MODELS[name].ground_to_image(np.column_stack(ground.transform(*TRUTH.T)))


def block(noise: float = 0.0, drop: Any = (), sigma: float = 0.5) -> BlockPoints:
    """Return three points in three images, in order of the images."""
    random = np.random.default_rng(5)
    measured = np.concatenate([seen(name) for name in VIEWS]) + noise * random.normal(size=(9, 2))
    keep = np.setdiff1d(np.arange(9), drop)
    return BlockPoints(
        ids=("p", "q", "r"), ground=np.full((3, 3), np.nan), roles=np.array(["tie"] * 3), sigma_ground=np.zeros((3, 3)),
        crs=pyproj.CRS(32633), images=tuple(VIEWS), point=np.tile(np.arange(3), 3)[keep],
        image=np.repeat(np.arange(3), 3)[keep], measured=measured[keep],
        sigma_image=(sigma * np.array([1.0] * 5 + [2.0] * 4))[keep],
    )  # fmt: skip


def in_map(ground: np.ndarray) -> np.ndarray:
    return np.column_stack(TO_MAP.transform(*ground.T))


def test_points_without_errors_are_where_they_are() -> None:
    found = intersect(MODELS, block(drop=[2, 8]))
    np.testing.assert_allclose(in_map(found.ground[:2]), TRUTH[:2], atol=1e-5)
    assert np.isnan(found.ground[2]).all(), "one ray leaves it open"
    assert np.isnan(found.covariance[2]).all()
    assert np.isnan(found.residuals[[-2]]).any() or np.isnan(found.residuals).any()
    assert found.rays.tolist() == [3, 3, 1]
    assert found.sigma0 == pytest.approx(0.0, abs=1e-4)
    assert repr(found).startswith("<2 of 3 points intersected from 7 rays")


def test_rays_that_meet_outside_of_their_models_do_not_meet(tmp_path: Path) -> None:
    """A column that is wrong by 90 pixels puts the point above the heights of the RPCs, where they do not project."""
    pair = Pair(tmp_path)
    ground = pair.rpcs["aft"].image_to_ground([[150.0, 150.0], [90.0, 200.0], [180.0, 90.0]], 500.0)
    measured = np.concatenate([rpc.ground_to_image(ground) for rpc in pair.rpcs.values()])
    measured[0, 0] += 90.0
    points = replace(block(drop=[6, 7, 8]), images=tuple(pair.rpcs), measured=measured, sigma_image=np.full(6, 0.5))
    found = intersect(pair.rpcs, points)
    assert np.isfinite(found.covariance).all(axis=(1, 2)).tolist() == [False, True, True]
    np.testing.assert_allclose(found.ground[1:], ground[1:], atol=1e-3)
    assert np.isnan(found.ground[0]).all()


def design(points: BlockPoints, point: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the equations of a point in the map over sigma: partials, measurements, and which rays."""
    rows, right, rays = [], [], []
    for ray in np.flatnonzero(points.point == point):
        pixel, relief = VIEWS[points.images[points.image[ray]]]
        for axis, sign in ((0, 1.0), (1, -1.0)):
            partial = np.zeros(3)
            partial[axis], partial[2] = sign / pixel, sign * relief[axis] / pixel
            offset = sign * (-(500_000.0, 4_640_000.0)[axis] - relief[axis] * 100.0) / pixel
            rows.append(partial / points.sigma_image[ray])
            right.append((points.measured[ray, axis] - offset) / points.sigma_image[ray])
        rays.append(ray)
    return np.array(rows), np.array(right), np.array(rays)


@pytest.mark.parametrize("scaled", [True, False])
def test_points_are_those_of_least_squares(scaled: bool) -> None:
    points = block(noise=0.5)
    found = intersect(MODELS, points, scaled=scaled)
    squares, covariances = 0.0, []
    for point in range(3):
        rows, right, rays = design(points, point)
        # About the truth: the coordinates of the map have too many digits for it.
        step = np.linalg.lstsq(rows, right - rows @ TRUTH[point], rcond=None)[0]
        np.testing.assert_allclose(in_map(found.ground[point : point + 1])[0], TRUTH[point] + step, atol=1e-4)
        left = right - rows @ (TRUTH[point] + step)
        squares += left @ left
        np.testing.assert_allclose(
            found.residuals[rays] / points.sigma_image[rays, None], left.reshape(-1, 2), atol=1e-4
        )
        covariances.append(np.linalg.inv(rows.T @ rows))
    # Nine rays are 18 equations for 9 unknowns.
    assert found.sigma0 == pytest.approx(np.sqrt(squares / 9), rel=1e-4)
    # Sigma0 is estimated itself: the variance of Student's distribution is 9 / 7.
    scale = squares / 7 if scaled else 1.0
    # On the central meridian, east is x; a metre of the map is 1 / 0.9996 of the ground.
    np.testing.assert_allclose(found.covariance, scale * np.array(covariances), rtol=2e-3, atol=1e-4)
    np.testing.assert_allclose(found.sigmas, np.sqrt(np.diagonal(found.covariance, axis1=1, axis2=2)))


def test_the_angle_between_rays_is_that_of_their_displacements() -> None:
    """A ray leans by the displacement per metre; the widest pair of the three images counts."""
    lean = {name: np.array([-relief[0], -relief[1], 1.0]) for name, (_, relief) in VIEWS.items()}
    pairs = [("a", "b"), ("a", "c"), ("b", "c")]
    angles = [
        np.degrees(np.arccos(lean[i] @ lean[j] / np.linalg.norm(lean[i]) / np.linalg.norm(lean[j]))) for i, j in pairs
    ]
    found = intersect(MODELS, block())
    np.testing.assert_allclose(found.angles_deg, max(angles), rtol=1e-3)
    np.testing.assert_allclose(intersect(MODELS, block(drop=[3, 4, 5])).angles_deg, angles[1], rtol=1e-3)


def test_few_rays_that_meet_by_chance_keep_their_stated_sigmas() -> None:
    """Three points in two images have a redundancy of 3: their sigma0 says little."""
    points = block(noise=0.05, drop=[0, 1, 2])
    found, stated = intersect(MODELS, points), intersect(MODELS, points, scaled=False)
    assert found.sigma0 is not None
    assert found.sigma0 < 0.2
    np.testing.assert_array_equal(found.covariance, stated.covariance)


def test_two_rays_have_no_redundancy_left_for_a_sigma() -> None:
    found = intersect(MODELS, block(drop=[0, 1, 2]))
    assert found.sigma0 is not None, "four equations for three unknowns"
    with pytest.raises(TooFewPoints, match="no point was measured in two images"):
        intersect(MODELS, block(drop=range(3, 9)))


def test_each_image_needs_a_model_and_each_model_an_image() -> None:
    assert models_of(MODELS, block()) == tuple(MODELS.values())
    with pytest.raises(InputError, match="no model of the image 'b'"):
        models_of({name: MODELS[name] for name in ("a", "c")}, block())
    with pytest.raises(InputError, match="no points of the image 'd'"):
        models_of({**MODELS, "d": MODELS["a"]}, block())


def test_the_frame_is_about_control_with_heights_or_about_the_images() -> None:
    tie = block()
    without = frame_of(tuple(MODELS.values()), tie).origin
    centre = in_map(np.array([without]))[0]
    assert 500_000 < centre[0] < 520_000
    given = dict(vars(tie))
    given = {name: value for name, value in given.items() if not name.startswith("_")}
    ground = np.array([[600_000.0, 4_700_000.0, 10.0], [600_200.0, 4_700_000.0, np.nan], [np.nan] * 3])
    some = BlockPoints(**{**given, "ground": ground, "roles": np.array(["control", "control", "tie"])})
    np.testing.assert_allclose(in_map(np.array([frame_of(tuple(MODELS.values()), some).origin]))[0, :2], ground[0, :2])
    none = BlockPoints(**{**given, "ground": ground[[1, 1, 2]], "roles": np.array(["control", "control", "tie"])})
    np.testing.assert_allclose(frame_of(tuple(MODELS.values()), none).origin, without)


def test_steps_solve_the_normal_equations_are_not_too_long_and_parallel_rays_have_none() -> None:
    random = np.random.default_rng(1)
    rows = random.normal(size=(5, 8, 3))
    normal, right = rows.swapaxes(1, 2) @ rows, random.normal(size=(5, 3))
    right[1] *= 10 * _LONGEST
    thin = np.diag([1.0, 1.0, 1.0])
    normal[2] = np.diag([2.0 / PARALLEL**2, 1.0, 1.0])
    normal[3] = np.diag([0.5 / PARALLEL**2, 1.0, 1.0])
    normal[4] = thin
    normal[4, 0, 1] = np.nan
    step, open_ = _solved(normal, right)
    assert open_.tolist() == [False, False, False, True, True]
    np.testing.assert_allclose(step[0], np.linalg.solve(normal[0], right[0]))
    long = np.linalg.solve(normal[1], right[1])
    np.testing.assert_allclose(step[1], long * _LONGEST / np.linalg.norm(long))
    np.testing.assert_array_equal(step[3:], 0.0)
    assert _solved(np.zeros((0, 3, 3)), np.zeros((0, 3)))[0].shape == (0, 3)


def test_points_of_one_two_and_three_rays_weigh_by_covariances() -> None:
    """One point has a single ray: it has no place, and no part in the standard error of unit weight."""
    points = block(noise=0.5, drop=[1, 2, 5])
    random = np.random.default_rng(6)
    root = random.normal(size=(points.rays, 2, 2)) + 2 * np.eye(2)
    shape = root @ root.swapaxes(1, 2)
    shape *= 2 / np.trace(shape, axis1=1, axis2=2)[:, None, None]
    points = replace(points, shape_image=shape)
    found, squares = intersect(MODELS, points), 0.0
    assert found.rays.tolist() == [3, 2, 1]
    covariances = []
    for point in range(2):
        rows, right, rays = design(points, point)
        inverse = np.zeros((len(rows), len(rows)))
        for k, ray in enumerate(rays):
            # The rows are over sigma already.
            inverse[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = np.linalg.inv(shape[ray])
        cofactors = np.linalg.inv(rows.T @ inverse @ rows)
        step = cofactors @ rows.T @ inverse @ (right - rows @ TRUTH[point])
        np.testing.assert_allclose(in_map(found.ground[[point]])[0], TRUTH[point] + step, atol=1e-4)
        left = right - rows @ (TRUTH[point] + step)
        squares += left @ inverse @ left
        np.testing.assert_allclose(
            found.residuals[rays] / points.sigma_image[rays, None], left.reshape(-1, 2), atol=1e-4
        )
        covariances.append(cofactors)
    # Five rays are ten equations for six unknowns.
    assert found.sigma0 == pytest.approx(np.sqrt(squares / 4), rel=1e-4)
    np.testing.assert_allclose(found.covariance[:2], squares / 2 * np.array(covariances), rtol=2e-3, atol=2e-3)
    assert np.isnan(found.covariance[2]).all()
    assert np.isnan(found.residuals[points.point == 2]).all()
    assert np.isnan(found.angles_deg).tolist() == [False, False, True]
    assert repr(found) == f"<2 of 3 points intersected from 6 rays: sigma0 {found.sigma0:.3g}>"


def test_gross_errors_are_named_and_do_not_scale_the_sigmas_of_other_points() -> None:
    """Forty points with errors of half a pixel, as stated; one measurement is wrong by 30 pixels."""
    random = np.random.default_rng(3)
    truth = random.uniform([500_100, 4_638_000, 100], [501_000, 4_639_900, 300], (40, 3))
    ground = np.column_stack(TO_MAP.transform(*truth.T, direction="INVERSE"))
    measured = np.concatenate([MODELS[name].ground_to_image(ground) for name in ("a", "b")])
    points = BlockPoints(
        ids=tuple(map(str, range(40))), ground=np.full((40, 3), np.nan), roles=np.array(["tie"] * 40),
        sigma_ground=np.zeros((40, 3)), crs=pyproj.CRS(32633), images=("a", "b"), point=np.tile(np.arange(40), 2),
        image=np.repeat([0, 1], 40), measured=measured + random.normal(0, 0.5, (80, 2)), sigma_image=np.full(80, 0.5),
    )  # fmt: skip
    models = {name: MODELS[name] for name in ("a", "b")}
    clean = intersect(models, points)
    assert not clean.contradicting.any()
    # Measurements err by half a pixel, of 1 m and of 2 m: along the rows, rays miss each other by 1.1 m.
    for metres, named in ((3.0, []), (8.0, [7])):
        less = points.measured.copy()
        less[7, 1] += metres
        assert np.flatnonzero(intersect(models, replace(points, measured=less)).contradicting).tolist() == named
    points.measured[7, 1] += 30.0
    found = intersect(models, points)
    assert np.flatnonzero(found.contradicting).tolist() == [7]
    assert found.sigma0 == pytest.approx(clean.sigma0, rel=0.05)
    np.testing.assert_allclose(np.delete(found.sigmas, 7, 0), np.delete(clean.sigmas, 7, 0), rtol=0.05)
    assert (found.sigmas[7] > 10 * clean.sigmas[7]).all()
    points.measured[[3, 12, 20, 31], 1] += 30.0
    several = intersect(models, points)
    assert np.flatnonzero(several.contradicting).tolist() == [3, 7, 12, 20, 31]
    assert several.sigma0 == pytest.approx(clean.sigma0, rel=0.1)
    assert not intersect(models, replace(points, measured=measured)).contradicting.any()


def test_a_point_that_only_looks_far_off_counts_with_the_others() -> None:
    """Among very exact points a usual one looks wrong. It is tested first, before one that is, and stays."""
    squares = np.array([900.0, *[0.01] * 12, *[0.5] * 6, 3.0])
    others = squares[1:-1]
    assert stats.f.sf(3.0 / others.mean(), 1, 18) > 1e-3 / 20
    assert stats.f.sf(900.0 / squares[1:].mean(), 1, 19) < 1e-3 / 20
    for order in (np.arange(20), np.arange(20)[::-1]):
        found = _contradicting(squares[order], np.ones(20, dtype=np.int64))
        assert order[found].tolist() == [0]
