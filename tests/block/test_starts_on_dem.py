"""Where ties start on a DEM: on the ray of the first image that shows them, as far as all images see them there."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chains import CRS, Block, Chain, dem, fly, to_image, with_control

from ortho_pipeline.block.adjustment import _prepared
from ortho_pipeline.block.heights.source import DemHeights, _first_rays, starts
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array


@pytest.fixture(scope="module")
def flown() -> Block:
    """Steep ground of hills of 80 m, seen from both sides."""
    return fly(Chain(images=3, convergence_deg=40.0, ties=60, relief=80.0, errors=1.0, noise=1e-6), 3)


@pytest.fixture(scope="module")
def source(flown: Block, tmp_path_factory: pytest.TempPathFactory) -> DemHeights:
    surface = dem(flown, Path(tmp_path_factory.mktemp("dem")) / "dem.tif", 3, cell=4.0, void=30.0)
    return DemHeights(surface)


def started(flown: Block, points: BlockPoints, source: DemHeights) -> Array:
    """Return starts in metres of the map, by the true models."""
    problem, _, selection = _prepared(tuple(flown.truth.values()), points, {}, ())
    found = starts(source, problem, selection.rays)
    return ground_transform("EPSG:4979", CRS)(problem.frame.geodetic(found))


def test_they_are_where_the_ray_meets_the_ground(flown: Block, source: DemHeights) -> None:
    """Along the ray to a metre of height. In a void of the DEM and at control there is no start."""
    points = with_control(flown, "i1", 6)
    found = started(flown, points, source)
    east = flown.ground[:, 0] - flown.ground[:, 0].min()
    inside = points.tie & (east > 45.0)
    assert inside.sum() > 40
    assert (points.tie & (east < 20.0)).sum() > 1
    assert np.isfinite(found[inside]).all()
    assert np.isnan(found[(east < 20.0) | points.control]).all()
    assert np.ptp(flown.ground[inside, 2]) > 60.0
    np.testing.assert_allclose(found[inside], flown.ground[inside], atol=1.5)
    # The start is as high as the DEM, and on the first ray.
    heights = source.heights(ground_transform(CRS, "EPSG:4979")(found[inside]))
    np.testing.assert_allclose(found[inside, 2], heights, atol=1.0)
    first = np.array([points.image[points.point == k].min() for k in range(len(points))])
    for image, model in enumerate(flown.truth.values()):
        rows = np.flatnonzero(inside & (first == image))
        seen = to_image(model, found[rows])
        rays = [int(np.flatnonzero((points.point == k) & (points.image == image))[0]) for k in rows.tolist()]
        # A metre of height moves the image point of a ray that is 40 degrees off the vertical by 0.9 px.
        np.testing.assert_allclose(seen, points.measured[rays].reshape(-1, 2), atol=0.9)


def test_the_first_ray_that_is_used_counts(flown: Block, source: DemHeights) -> None:
    """A ray that was left out may be anywhere."""
    points = flown.points
    first = np.array([np.flatnonzero(points.point == k)[0] for k in range(len(points))])
    measured = points.measured.copy()
    measured[first] += 40.0
    problem, _, selection = _prepared(tuple(flown.truth.values()), replace(points, measured=measured), {}, ())
    rays = selection.rays & ~np.isin(np.arange(points.rays), first)
    found = ground_transform("EPSG:4979", CRS)(problem.frame.geodetic(starts(source, problem, rays)))
    east = flown.ground[:, 0] - flown.ground[:, 0].min()
    np.testing.assert_allclose(found[east > 45.0], flown.ground[east > 45.0], atol=1.5)


def test_the_first_ray_of_each_point_in_the_order_of_rays() -> None:
    point, used = np.array([2, 0, 2, 1, 0, 1, 3]), np.array([False, True, True, True, True, True, False])
    assert np.flatnonzero(_first_rays(point, used)).tolist() == [1, 2, 3]
