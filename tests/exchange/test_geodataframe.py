"""Points as GeoDataFrames of GeoPandas, and back."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyproj
import pytest

import ortho_pipeline as op
from ortho_pipeline.errors import CrsError, DatumError, InputError

SAMPLE = Path(__file__).resolve().parent.parent.parent / "sample_data"
ARRAYS = ("image", "ground", "sigma_image", "sigma_ground", "covariance_image", "groups", "sigma_common")

geopandas = pytest.importorskip("geopandas", reason="GeoPandas is not installed")


@pytest.fixture
def points() -> op.Points:
    """Points of all that a point can have: no height, no place, own covariance, group, common error, unequal sigmas."""
    random = np.random.default_rng(22)
    image, count = random.uniform(0, 1000, (8, 2)), 8
    ground = random.uniform((4e5, 4.4e6, 0), (5e5, 4.5e6, 900), (count, 3))
    ground[1, 2], ground[7] = np.nan, np.nan
    made = op.Points.of(
        image, ground, "EPSG:32636", roles=["control"] * 5 + ["check"] * 2 + ["tie"],
        sigma_image=random.uniform(0.1, 1, count), sigma_ground=random.uniform(0, 1, (count, 3)),
    )  # fmt: skip
    covariance = made.covariance_image.copy()
    covariance[3] = [[0.3, 0.07], [0.07, 0.11]]
    made = made.with_covariance_image(covariance, groups=[-1, -1, 0, 2, 2, -1, -1, -1])
    return replace(made, sigma_common=np.array([0, 0, 0, 1.5, 1.5, 0, 0, 0]))


def assert_equal(found: op.Points, wanted: op.Points) -> None:
    assert found.ids == wanted.ids
    assert found.roles.tolist() == wanted.roles.tolist()
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
    assert found.crs == wanted.crs


def test_they_come_back_to_the_last_bit(points):
    frame = op.to_geodataframe(points)
    assert frame.crs == pyproj.CRS("EPSG:32636")
    assert frame.geometry.is_empty.sum() + frame.geometry.isna().sum() == 1
    assert_equal(op.from_geodataframe(frame), points)
    sample = op.read_points(SAMPLE / "gcps.geojson")
    again = op.from_geodataframe(op.to_geodataframe(sample))
    assert_equal(again, sample)
    assert again.source == sample.source
    assert "group" not in op.to_geodataframe(sample)
    # The frame is one of GeoPandas: another CRS there is that of `to_crs` here.
    moved = op.from_geodataframe(op.to_geodataframe(sample).to_crs("EPSG:32636"))
    np.testing.assert_allclose(moved.ground, sample.to_crs("EPSG:32636").ground, atol=1e-6)


def test_frames_of_others_say_what_their_heights_are(points):
    import shapely

    frame = geopandas.GeoDataFrame(
        {"col": [10, 20.5], "row": [3, 4], "sigma_xy": [0.2, None]},
        geometry=[shapely.Point(33.3, 37.2, 800.0), shapely.Point(33.4, 37.3, 900.0)], crs="EPSG:4326",
    )  # fmt: skip
    with pytest.raises(DatumError, match="height datum of these points is unknown"):
        op.from_geodataframe(frame)
    found = op.from_geodataframe(frame, vertical="ellipsoid")
    assert found.ids == ("1", "2")
    assert found.ground[:, 2].tolist() == [800.0, 900.0]
    assert found.sigma_ground.tolist() == [[0.2, 0.2, 0.0], [0.0, 0.0, 0.0]]
    assert found.roles.tolist() == ["control"] * 2
    # The CRS of EPSG:4979 says it itself.
    assert op.from_geodataframe(frame.set_crs("EPSG:4979", allow_override=True)).ground[1, 2] == 900.0
    with pytest.raises(CrsError, match="CRS of these points is unknown"):
        op.from_geodataframe(frame.set_crs(None, allow_override=True), vertical="ellipsoid")


def test_a_row_without_a_height_has_none_where_there_is_a_column_of_heights():
    frame = geopandas.GeoDataFrame(
        {"col": [10, 20.5], "row": [3, 4], "h": [None, 5.5]},
        geometry=geopandas.points_from_xy([33.3, 33.4], [37.2, 37.3], [800.0, 900.0]), crs="EPSG:4326",
    )  # fmt: skip
    found = op.from_geodataframe(frame, vertical="ellipsoid")
    np.testing.assert_array_equal(found.ground[:, 2], [np.nan, 5.5])
    assert op.from_geodataframe(frame.drop(columns="h"), vertical="ellipsoid").ground[:, 2].tolist() == [800.0, 900.0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f: f.drop(columns="col"), "no column col"),
        (lambda f: f.assign(row="here"), "row 0, row: 'here' is not a number"),
        (lambda f: f.assign(role="gcp"), "row 0, role: 'gcp' is not a role"),
        (lambda f: f.assign(sigma_x=-1.0), "row 0, sigma_x: -1.0 is not a standard deviation"),
        (lambda f: f.assign(group=0.5), "row 0, group: 0.5 is not a group"),
        (lambda f: f.assign(id="A"), "two points have the id 'A'"),
        (lambda f: f.set_geometry(f.buffer(1.0)), "Polygon is not a point"),
        (lambda f: f.set_geometry(geopandas.GeoSeries.from_wkt(["POINT EMPTY"] * 8, crs=f.crs)), "is not a point"),
        (lambda f: f.drop(columns="geometry"), "DataFrame has no geometry"),
        (
            lambda f: geopandas.GeoDataFrame(f.rename(columns={"h": "col"}), geometry="geometry"),
            "two columns have the same name",
        ),
    ],
)
def test_what_is_wrong_is_named(points, change, said):
    with pytest.raises(InputError) as error:
        op.from_geodataframe(change(op.to_geodataframe(points)))
    assert said in str(error.value)


def test_without_geopandas_the_remedy_is_said(points, monkeypatch):
    monkeypatch.setitem(sys.modules, "geopandas", None)
    with pytest.raises(InputError, match=r"needs GeoPandas") as error:
        op.to_geodataframe(points)
    assert ".[geopandas]" in error.value.remedy
