"""Spot heights as they are delivered: plain tables, tables of laser altimetry, GeoJSON and GeoParquet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.points.heights.spot_heights import read_spot_heights
from ortho_pipeline.surface.accuracy import read_check_heights


def test_a_plain_table(tmp_path: Path) -> None:
    path = tmp_path / "spots.csv"
    path.write_text("name,x,y,h,sigma,sigma_xy,quality\nlake,33.5,36.5,1042.5,0.1,5,good\nhill,33.6,36.4,1300,0.5,,\n")
    spots = read_spot_heights(path, "EPSG:4326", "ellipsoid")
    np.testing.assert_allclose(spots.ground, [(33.5, 36.5, 1042.5), (33.6, 36.4, 1300.0)])
    assert spots.sigmas.tolist() == [0.1, 0.5]
    assert spots.plan.tolist() == [5.0, 0.0]
    assert spots.ids == ("lake", "hill")


def test_no_height_is_better_than_a_millimetre(tmp_path: Path) -> None:
    path = tmp_path / "spots.csv"
    path.write_text("x,y,h,sigma\n33.5,36.5,1042.5,0.0001\n33.6,36.5,1042.5,0.0012\n")
    assert read_spot_heights(path, "EPSG:4326", "ellipsoid").sigmas.tolist() == [0.001, 0.0012]


def test_heights_above_a_geoid_become_ellipsoidal(tmp_path: Path) -> None:
    path = tmp_path / "spots.csv"
    path.write_text("x,y,h,sigma\n24.4,-33.65,100,0.3\n")
    # Field notes, trap 1.
    assert read_spot_heights(path, "EPSG:4326", "egm96").ground[0, 2] == pytest.approx(128.208, abs=0.01)


@pytest.mark.parametrize(
    ("height", "sigma"), [("h_mean", "h_sigma"), ("h_li", "h_li_sigma"), ("h_te_best_fit", "h_te_uncertainty")]
)
def test_tables_of_altimetry_say_what_they_are(tmp_path: Path, height: str, sigma: str) -> None:
    """ATL06 and ATL08, and what SlideRule makes of them: ellipsoidal heights at longitude and latitude."""
    path = tmp_path / "atl.csv"
    path.write_text(f"rgt,cycle,longitude,latitude,{height},{sigma},n_fit_photons\n1,2,33.5,36.5,1042.5,0.2,77\n")
    spots = read_spot_heights(path)
    np.testing.assert_allclose(spots.ground, [(33.5, 36.5, 1042.5)])
    assert spots.sigmas.tolist() == [0.2]
    # They check a DEM, too.
    ground, crs, _ = read_check_heights(path)
    assert ground[0, 2] == 1042.5
    assert crs.to_epsg() == 4326


def test_altimetry_in_a_system_of_its_own(tmp_path: Path) -> None:
    """Only columns that are named longitude and latitude have a system without a statement of one."""
    path = tmp_path / "atl.csv"
    path.write_text("x,y,h_mean,h_sigma\n500000,4000000,1042.5,0.2\n")
    with pytest.raises(CrsError, match="CRS of these points is unknown"):
        read_spot_heights(path)
    ground, crs, _ = read_check_heights(path, "EPSG:32636")
    assert (ground.tolist(), crs.to_epsg()) == ([[500000.0, 4000000.0, 1042.5]], 32636)
    path.write_text("#CRS: EPSG:4258\nlongitude,latitude,h_mean,h_sigma\n33.5,36.5,1042.5,0.2\n")
    ground, crs, _ = read_check_heights(path)
    assert (ground.tolist(), crs.to_epsg()) == ([[33.5, 36.5, 1042.5]], 4258)


def test_geojson(tmp_path: Path) -> None:
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": properties}
        for place, properties in (
            ([33.5, 36.5, 1042.5], {"id": "a", "sigma": 0.3}),
            ([33.6, 36.5], {"id": "b", "h_mean": 1043.0, "h_sigma": 0.2}),
        )
    ]
    path = tmp_path / "spots.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    spots = read_spot_heights(path)
    assert spots.ground[:, 2].tolist() == [1042.5, 1043.0]
    assert spots.sigmas.tolist() == [0.3, 0.2]


@pytest.mark.parametrize("name", ["h", "h_mean", "H_LI"])
@pytest.mark.parametrize("place", [[33.5, 36.5], [33.5, 36.5, 0.0]])
def test_a_height_among_the_properties_counts_more_than_that_of_the_geometry(
    tmp_path: Path, name: str, place: list[float]
) -> None:
    properties = {name: 812.5, "sigma": 0.3, "sigma_xy": 5.0}
    feature = {"type": "Feature", "geometry": {"type": "Point", "coordinates": place}, "properties": properties}
    path = tmp_path / "spots.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    spots = read_spot_heights(path)
    assert (spots.ground[0, 2], spots.sigmas[0], spots.plan[0]) == (812.5, 0.3, 5.0)


@pytest.mark.parametrize(
    ("rows", "crs", "vertical", "kind", "field"),
    [
        ("x,y,h\n33.5,36.5,1000\n", "EPSG:4326", "ellipsoid", InputError, "line 2"),
        ("x,y,h,sigma\n33.5,36.5,1000,0\n", "EPSG:4326", "ellipsoid", InputError, "line 2"),
        ("x,y,h,sigma\n33.5,36.5,1000,0.3\n", None, "ellipsoid", CrsError, "points.spot_crs"),
        ("x,y,h,sigma\n33.5,36.5,1000,0.3\n", "EPSG:4326", None, DatumError, "points.spot_vertical"),
        ("x,y,h,sigma\n33.5,36.5,1000,0.3\n", "nowhere", "ellipsoid", CrsError, "points.spot_crs"),
    ],
)
def test_what_is_missing_is_named(
    tmp_path: Path, rows: str, crs: str | None, vertical: str | None, kind: type[InputError], field: str
) -> None:
    path = tmp_path / "spots.csv"
    path.write_text(rows)
    with pytest.raises(kind) as caught:
        read_spot_heights(path, crs, vertical)
    assert caught.value.field == field
    assert "points.crs" not in f"{caught.value.message} {caught.value.remedy}"
    assert "points.vertical" not in f"{caught.value.message} {caught.value.remedy}"


def test_geoparquet(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    geopandas = pytest.importorskip("geopandas")
    places = geopandas.points_from_xy([33.5, 33.6], [36.5, 36.4])
    table = {"h_mean": [1042.5, 1300.0], "h_sigma": [0.2, 0.4], "spot": [1, 2]}
    path = tmp_path / "atl06.parquet"
    geopandas.GeoDataFrame(table, geometry=places, crs="EPSG:7912").to_parquet(path)
    spots = read_spot_heights(path)
    np.testing.assert_allclose(spots.ground, [(33.5, 36.5, 1042.5), (33.6, 36.4, 1300.0)], atol=1e-5)
    assert spots.sigmas.tolist() == [0.2, 0.4]
    assert spots.plan.tolist() == [0.0, 0.0]
    stated = {"h": [1042.5, 1300.0], "sigma": [0.2, 0.4], "sigma_xy": [5.0, np.nan]}
    geopandas.GeoDataFrame(stated, geometry=places, crs="EPSG:4979").to_parquet(path)
    assert read_spot_heights(path).plan.tolist() == [5.0, 0.0]
    geopandas.GeoDataFrame({"h": [1.0]}, geometry=places[:1].buffer(1), crs="EPSG:4326").to_parquet(path)
    with pytest.raises(InputError, match="not all points"):
        read_spot_heights(path)


def test_heights_of_geoparquet_are_those_of_a_column_or_of_all_geometries(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    geopandas = pytest.importorskip("geopandas")
    path, sigmas = tmp_path / "spots.parquet", {"sigma": [0.2, 0.4]}
    places = geopandas.points_from_xy([33.5, 33.6], [36.5, 36.4], [1042.5, 1300.0])
    flat = geopandas.points_from_xy([33.5, 33.6], [36.5, 36.4])
    for columns, geometry, heights in (
        (sigmas, places, [1042.5, 1300.0]), (sigmas | {"h": [7.0, 8.0]}, places, [7.0, 8.0]),
        (sigmas, flat, None), (sigmas, [places[0], flat[1]], None),
    ):  # fmt: skip
        geopandas.GeoDataFrame(columns, geometry=geometry, crs="EPSG:4979").to_parquet(path)
        if heights is None:
            with pytest.raises(InputError, match="no column h"):
                read_spot_heights(path)
        else:
            assert read_spot_heights(path).ground[:, 2].tolist() == heights


def test_what_is_no_geoparquet_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "spots.parquet"
    path.write_bytes(b"PAR1 and nothing else")
    with pytest.raises(InputError, match=r"GeoParquet"):
        read_spot_heights(path)
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InputError, match="needs GeoPandas and PyArrow"):
        read_spot_heights(path)
