"""Scale and convergence of maps at places: against PROJ's factors, the geodesics of the ellipsoid, and space."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from ortho_pipeline.geodesy.distortion import east_north_from_map, inverse_2x2, map_from_enu

WGS84 = pyproj.Geod(ellps="WGS84")


def jacobian(crs: str, lon: float, lat: float, height: float = 0.0) -> np.ndarray:
    plane = pyproj.CRS.from_user_input(crs)
    x, y = pyproj.Transformer.from_crs(4326, plane, always_xy=True).transform(lon, lat)
    return east_north_from_map(plane, np.array([[x, y, height]]))[0]


@pytest.mark.parametrize(
    ("crs", "lon", "lat"),
    [
        ("EPSG:32636", 35.9, 37.2), ("EPSG:3035", 33.0, 37.0), ("EPSG:3413", -20.0, 75.0), ("EPSG:3031", 10.0, -88.0),
        ("EPSG:2154", 3.7, 46.5), ("EPSG:8035", -63.5, 40.7), ("EPSG:3067", 30.0, 70.0),
        ("+proj=tmerc +lat_0=5 +lon_0=40 +k=0.9 +datum=WGS84", 41.0, 3.0),
    ],
)  # fmt: skip
def test_scale_and_convergence_are_those_of_proj(crs, lon, lat):
    """PROJ has scales along meridian and parallel, how far the angle between them is off, and the convergence."""
    plane = pyproj.CRS.from_user_input(crs)
    factors, unit = pyproj.Proj(plane).get_factors(lon, lat), plane.axis_info[0].unit_conversion_factor
    back = inverse_2x2(jacobian(crs, lon, lat)[None])[0] * unit
    east, north = back.T
    assert np.hypot(*north) == pytest.approx(factors.meridional_scale, abs=1e-6)
    assert np.hypot(*east) == pytest.approx(factors.parallel_scale, abs=1e-6)
    assert np.degrees(np.arctan2(*north)) == pytest.approx(-factors.meridian_convergence, abs=1e-5)
    assert abs(np.linalg.det(back)) == pytest.approx(factors.areal_scale, abs=1e-6)


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:4326", "EPSG:4258", "EPSG:2053", "EPSG:4807", "EPSG:32735"])
def test_metres_and_bearings_are_those_of_geodesics(crs):
    """Also in degrees and grads, on the sphere of Web Mercator, and where axes point west and south."""
    lon, lat = (2.4, 48.9) if crs in ("EPSG:4258", "EPSG:4807") else (29.4, -26.1)
    plane = pyproj.CRS.from_user_input(crs)
    there = pyproj.Transformer.from_crs(4326, plane, always_xy=True)
    back = inverse_2x2(jacobian(crs, lon, lat)[None])[0]
    for azimuth in (0.0, 71.0, 200.0):
        ends = [there.transform(*WGS84.fwd(lon, lat, azimuth, sign * 50.0)[:2]) for sign in (1, -1)]
        way = np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
        # The datum of EPSG:2053 and 4807 has another ellipsoid, by 1e-5 of a length.
        np.testing.assert_allclose(np.subtract(*ends) / 100.0, back @ way, rtol=0, atol=2e-5 * np.abs(back).max())


def test_a_place_above_the_ellipsoid_has_longer_metres():
    crs = pyproj.CRS.from_epsg(32633)
    low, high = (east_north_from_map(crs, np.array([[5e5, 5e6, h]]))[0] for h in (0.0, 6.4e4))
    np.testing.assert_allclose(high / 1.01, low, rtol=1e-4, atol=1e-6)
    unknown = east_north_from_map(crs, np.array([[5e5, 5e6, np.nan]]))[0]
    np.testing.assert_array_equal(unknown, low)
    assert np.isnan(east_north_from_map(crs, np.array([[np.nan, 5e6, 0.0]]))).all()


def test_across_the_antimeridian_and_at_a_pole_nothing_is_torn():
    mercator = jacobian("EPSG:3857", 180.0 - 1e-9, 10.0)
    np.testing.assert_allclose(mercator, jacobian("EPSG:3857", 20.0, 10.0), atol=1e-6)
    pole = east_north_from_map(pyproj.CRS.from_epsg(3413), np.zeros((1, 3)))[0]
    np.testing.assert_allclose(pole.T @ pole, (pole[:, 0] @ pole[:, 0]) * np.eye(2), atol=1e-6)
    assert np.sqrt(np.linalg.det(pole)) == pytest.approx(1 / pyproj.Proj(3413).get_factors(0, 90).parallel_scale, 1e-5)


def test_heights_keep_their_metre():
    found = map_from_enu(pyproj.CRS.from_epsg(8035), np.array([[1.64e6, 1.478e7, 10.0]]))[0]
    np.testing.assert_array_equal(found[2], [0, 0, 1])
    np.testing.assert_array_equal(found[:, 2], [0, 0, 1])
    assert np.linalg.norm(found[:, 0]) == pytest.approx(0.9996 * 3937 / 1200, rel=1e-4)  # the scale of the zone
