"""Joins of images over a DEM: the covariance of their distance, by drawing every error and by numbers on paper."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chains import Block, Chain, dem, fly

from ortho_pipeline.block.adjustment import adjust
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.heights.adjusted_dem import AdjustedDem
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.relative.joins import _area, _Moves, _of_heights, joins_of
from ortho_pipeline.geodesy.ellipsoid import metres_per_degree


@pytest.fixture(scope="module")
def flown() -> Block:
    return fly(Chain(images=3, convergence_deg=15.0, ties=170, relief=80.0, errors=2.0), 3)


@pytest.fixture(scope="module")
def fit(flown: Block, tmp_path_factory: pytest.TempPathFactory) -> BlockFit:
    surface = dem(flown, Path(tmp_path_factory.mktemp("dem")) / "dem.tif", 3, white=1.0, bias=3.0, void=60.0)
    return adjust(flown.start, flown.points, heights=DemHeights(surface.with_sigma(1.0), bias=4.0), hold=5.0)


def made(fit: BlockFit) -> AdjustedDem:
    """Return errors of a DEM that are large along all ways, so that no part of them hides another."""
    random, count = np.random.default_rng(4), len(fit.points)
    assert fit.adjusted_dem is not None
    root = random.normal(0, 1, (4, 4))
    loads = np.where(np.isfinite(fit.adjusted_dem.loads[:, :1]), random.normal(0, 2, (count, 4)), np.nan)
    return AdjustedDem(
        known=random.normal(1.5, 1, count), loads=loads, by_params=random.normal(0, 0.5, (len(fit.values), 4)),
        covariance=root @ root.T, slopes=fit.adjusted_dem.slopes, own=np.zeros(count), sample=10.0,
    )  # fmt: skip


def test_a_join_has_the_errors_of_parameters_and_heights_together(fit: BlockFit) -> None:
    """Parameters err by B u and by what is independent of u, heights by k - L u."""
    whole, points, names = made(fit), fit.points, [image for image, _ in fit.parameters]
    joins = joins_of(fit, whole)
    assert [(join.first, join.second) for join in joins] == [("i0", "i1"), ("i1", "i2")]
    for join in joins:
        one, other = (points.images.index(name) for name in (join.first, join.second))
        shared = np.intersect1d(points.point[points.image == one], points.point[points.image == other])
        shared = shared[np.isfinite(whole.loads[shared, 0])]
        # Of more than thirty points, thirty that are spread over all of them.
        assert len(shared) > 30
        chosen = shared[np.linspace(0, len(shared) - 1, 30).astype(int)]
        first, second = (_Moves.of(fit, image, chosen, whole) for image in (one, other))
        by_params = np.zeros((2, len(names)))
        by_params[:, np.array(names) == join.first] = first.by_params
        by_params[:, np.array(names) == join.second] = -second.by_params
        by_height = first.by_height - second.by_height
        # The covariance of all parameters, of u with them, and of u.
        gain = by_params @ whole.by_params - np.mean(by_height[:, :, None] * whole.loads[chosen, None, :], axis=0)
        alone = fit.covariance - whole.by_params @ whole.covariance @ whole.by_params.T
        known = np.mean(by_height * whole.known[chosen, None], axis=0)
        wanted = by_params @ alone @ by_params.T + gain @ whole.covariance @ gain.T + np.outer(known, known)
        found = join.covariance * join.pixel**2
        np.testing.assert_allclose(found, wanted, atol=1e-8 * np.abs(wanted).max())


def test_without_heights_in_the_overlap_the_join_is_at_the_true_ground(fit: BlockFit) -> None:
    whole = made(fit)
    nowhere = replace(whole, loads=np.full_like(whole.loads, np.nan))
    partly = replace(whole, loads=np.where(np.arange(4) == 2, np.nan, whole.loads))
    for found in (joins_of(fit, nowhere), joins_of(fit, partly)):
        for one, other in zip(found, joins_of(fit), strict=True):
            np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-12)
            assert one.pixel == other.pixel


def test_points_that_take_no_part_make_no_join(fit: BlockFit) -> None:
    rays = fit.used_rays & (fit.points.image != 0)
    assert [(one.first, one.second) for one in joins_of(replace(fit, used_rays=rays))] == [("i1", "i2")]
    ground = fit.ground.copy()
    ground[np.unique(fit.points.point[fit.points.image == 2]), 2] = np.nan
    assert [(one.first, one.second) for one in joins_of(replace(fit, ground=ground))] == [("i0", "i1")]


def of_own_errors(ground: np.ndarray, by_height: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Return what errors of 30 m samples of their own add, with differences of moves by height ``(n, 2)``."""
    part = np.array([0.3, -0.6])
    one: Any = SimpleNamespace(image=0, by_params=np.zeros((2, 1)), by_height=by_height + part)
    other: Any = SimpleNamespace(image=1, by_params=np.zeros((2, 1)), by_height=np.zeros_like(by_height) + part)
    columns = SimpleNamespace(of_image=lambda image: np.array([image]))
    fit: Any = SimpleNamespace(
        cofactors=SimpleNamespace(levels=SimpleNamespace(columns=columns)), ground=ground
    )  # fmt: skip
    count = len(ground)
    whole = AdjustedDem(
        known=np.zeros(count), loads=np.zeros((count, 1)), by_params=np.zeros((2, 1)), covariance=np.eye(1),
        slopes=np.zeros((count, 2)), own=own, sample=30.0,
    )  # fmt: skip
    return _of_heights(fit, whole, np.arange(count), one, other)


def test_errors_of_samples_of_their_own_average_over_the_samples_of_the_overlap() -> None:
    """Places fill 300 m by 80 m, which is 26.7 samples; one place, or places on a line, are one sample."""
    ground, random = filled(300.0, 80.0), np.random.default_rng(6)
    moves, own = random.normal(0, 0.5, (len(ground), 2)), random.uniform(1, 3, len(ground))
    each = moves * own[:, None]
    wanted = each.T @ each / len(ground)
    np.testing.assert_allclose(of_own_errors(ground, moves, own), wanted / (300.0 * 80.0 / 900.0), rtol=0.02)
    line = ground[:200]
    np.testing.assert_allclose(of_own_errors(line, moves[:200], own[:200]), each[:200].T @ each[:200] / 200, rtol=1e-9)
    np.testing.assert_allclose(of_own_errors(ground[:1], moves[:1], own[:1]), np.outer(each[0], each[0]), rtol=1e-9)


def filled(width: float, height: float) -> np.ndarray:
    """Return level places (lon, lat, h) that fill a rectangle turned by half a right angle, at 60 degrees north."""
    x, y = np.meshgrid(((np.arange(200) + 0.5) / 200 - 0.5) * width, ((np.arange(50) + 0.5) / 50 - 0.5) * height)
    turned = np.column_stack([x.ravel() - y.ravel(), x.ravel() + y.ravel()]) / np.sqrt(2)
    middle = np.array([[10.0, 60.0, 0.0]])
    return np.column_stack([middle[0, :2] + turned / metres_per_degree(middle), np.zeros(len(turned))])


def test_the_area_is_that_of_the_rectangle_that_places_fill() -> None:
    """To a hundredth."""
    ground = filled(300.0, 80.0)
    assert _area(ground) == pytest.approx(300.0 * 80.0, rel=1e-2)
    assert _area(ground[:1]) == 0.0


def test_heights_and_the_longitude_do_not_change_the_area() -> None:
    ground = filled(300.0, 80.0)
    ground[:, 2] = np.linspace(0.0, 400.0, len(ground))
    east = ground[:, 0] - ground[:, 0].mean()
    for longitude in (10.0, 170.0, 180.0):
        ground[:, 0] = (longitude + east + 180.0) % 360.0 - 180.0
        assert _area(ground) == pytest.approx(300.0 * 80.0, rel=1e-2)
