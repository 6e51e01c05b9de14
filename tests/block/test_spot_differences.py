"""Spot heights and a DEM before the adjustment: differences, which of them are wrong, and a DEM that was moved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chains import CRS, EAST, NORTH

from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.heights.spots import SpotDifferences
from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.points.heights.spot_heights import SpotHeights
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem

#: On the central meridian a metre of the map is 1 / 0.9996 m on the ground.
SLOPES = 0.9996 * np.array([0.3, -0.2])


def source(folder: Path, apart: np.ndarray, sigma: float | None, plan: float = 0.0, spot: float = 0.5) -> DemHeights:
    """Return a plane of 10 m samples, and spots 100 m from each other below it by so much; the last is off the DEM."""
    x, y = np.meshgrid(-600.0 + (np.arange(120) + 0.5) * 10, 600.0 - (np.arange(120) + 0.5) * 10)
    write_dem(folder / "dem.tif", 500.0 + 0.3 * x - 0.2 * y, (EAST - 600.0, NORTH + 600.0), 10.0, CRS)
    surface = open_dem(folder / "dem.tif", "ellipsoid", override=True).with_sigma(sigma)
    at = np.column_stack([100.0 * (np.arange(len(apart)) % 5) - 203.0, 100.0 * (np.arange(len(apart)) // 5) - 204.0])
    at[-1] = 9000.0, 0.0
    xyz = np.column_stack([at + np.array([EAST, NORTH]), 500.0 + at @ [0.3, -0.2] - apart])
    ground = ground_transform(CRS, "EPSG:4979")(xyz)
    count = len(apart)
    spots = SpotHeights(ground, np.full(count, spot), np.full(count, plan), tuple(f"s{k}" for k in range(count)))
    return DemHeights(surface, spots=spots, shift=8.0)


@pytest.mark.parametrize(("stated", "assumed", "sharing"), [(2.0, 77.0, 1.0), (None, 2.0, 1.0), (2.0, 77.0, 5.0)])
def test_a_spot_is_wrong_at_four_sigmas_of_the_difference_from_the_median(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stated: float | None, assumed: float, sharing: float
) -> None:
    """2 m of the DEM, 0.5 m of the spot, and 3 m of its place on a slope of 0.36, however many share a sample."""
    if sharing > 1.0:
        monkeypatch.setattr(DemHeights, "sharing", lambda source, ground: np.full(len(ground), sharing))
    sigma = np.sqrt(4.0 + 0.25 + 9.0 * (SLOPES**2).sum())
    off = np.array(
        [0.0, 0.1, -0.1, 0.2, -0.2, 0.3, -0.3, 3.9 * sigma, -3.9 * sigma, 4.1 * sigma, -4.1 * sigma, 0.0, 9.0]
    )
    found = SpotDifferences.of(source(tmp_path, 7.0 + off, stated, plan=3.0), assumed)
    assert found is not None
    np.testing.assert_allclose(found.apart[:-1], 7.0 + off[:-1], atol=0.01)
    assert np.isnan(found.apart[-1])
    np.testing.assert_allclose(found.slopes[:-1], np.tile(SLOPES, (12, 1)), rtol=1e-3)
    np.testing.assert_array_equal(found.slopes[-1], 0.0)
    assert np.flatnonzero(found.wrong).tolist() == [9, 10]
    assert np.flatnonzero(found.used).tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8, 11]
    assert (found.stated is None) == (stated is None)
    np.testing.assert_allclose(found.own, sharing)
    np.testing.assert_array_equal(found.loads, np.zeros((13, 3)))


def test_differences_that_scatter_more_than_stated_are_measured_by_their_scatter(tmp_path: Path) -> None:
    """Of a median absolute difference of 10 m, sigma is 14.8 m, and 59.3 m are four of it."""
    off = np.array([0.0, 10.0, -10.0, 10.0, -10.0, 10.0, -10.0, 58.0, -58.0, 60.5, -60.5, 0.0])
    found = SpotDifferences.of(source(tmp_path, off - 3.0, 1.0), 10.0)
    assert found is not None
    assert np.flatnonzero(found.wrong).tolist() == [9, 10]


def test_a_dem_that_was_moved_is_read_again(tmp_path: Path) -> None:
    """The bias and correlated errors stay; what a shift does follows the slopes."""
    here = source(tmp_path, np.linspace(0.0, 3.0, 12), 1.5)
    made = SpotDifferences.of(here, 10.0)
    assert made is not None
    made = made.with_loads(4.0, 8.0, np.linspace(0.1, 0.6, 12)[:, None], np.full(12, 0.4))
    made = replace(made, wrong=np.arange(12) == 3, scale=1.7)
    found = made.read_again(replace(here, read_at=(5.0, -10.0)), 10.0)
    np.testing.assert_allclose((found.apart - made.apart)[:-1], SLOPES @ [5.0, -10.0], atol=0.01)
    np.testing.assert_allclose(found.loads[:-1, 1:3], np.tile(-8.0 * SLOPES, (11, 1)), rtol=1e-3)
    np.testing.assert_array_equal(found.loads[:, [0, 3]], made.loads[:, [0, 3]])
    np.testing.assert_array_equal(found.wrong, made.wrong)
    assert (found.scale, found.own.tolist()) == (1.7, [0.4] * 12)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_spots_farther_than_any_geoid_is_from_the_ellipsoid_are_refused(tmp_path: Path, way: float) -> None:
    """A geoid is at most 107 m off, and two of them are 200 m apart at most."""
    assert SpotDifferences.of(source(tmp_path, np.full(12, 195.0 * way), 1.5), 10.0) is not None
    with pytest.raises(InputError, match=f"are 205.0 m {'below' if way > 0 else 'above'} the DEM"):
        SpotDifferences.of(source(tmp_path, np.full(12, 205.0 * way), 1.5), 10.0)


def test_a_dem_without_spots_has_no_differences(tmp_path: Path) -> None:
    assert SpotDifferences.of(replace(source(tmp_path, np.zeros(12), 1.5), spots=None), 10.0) is None
