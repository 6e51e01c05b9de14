"""Point files: field notes 16, 21, 34, 39 to 41 and the table of conventions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.geodesy.crs import GroundTransform, Vertical
from ortho_pipeline.points import Points, assign_roles, gcps_of_dataset, read_points, write_points
from ortho_pipeline.points.formats import read_table

HEADER = "id,col,row,x,y,h\n"
ROW = "a,10.5,20.25,24.4,-33.65,100\n"


def write(path: Path, text: str | bytes) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def some_points(crs: str = "EPSG:4326") -> Points:
    rng = np.random.default_rng(5)
    count = 9
    ground = np.array([24.4, -33.65, 200.0]) + rng.normal(0, 1, (count, 3)) * [0.01, 0.01, 50]
    roles = np.array(["control", "check", "tie"] * 3)
    return Points(
        ids=tuple(f"p {k}" for k in range(count)),
        image=rng.uniform(-100, 1000, (count, 2)),
        ground=GroundTransform("EPSG:4979", crs)(ground),
        roles=roles,
        sigma_image=rng.uniform(0.1, 1, count),
        sigma_ground=np.repeat(rng.uniform(0, 1, (count, 2)), [2, 1], axis=1),
        crs=pyproj.CRS(crs),
        source="made",
    )


# -- formats


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|"])
def test_csv_with_any_delimiter(tmp_path: Path, delimiter: str) -> None:
    text = (
        HEADER.strip() + ",role,sigma_image,sigma_xy,sigma_h\na,10.5,20.25,24.4,-33.65,100,check,0.2,0.1,0\n"
    ).replace(",", delimiter)
    points = read_points(write(tmp_path / "p.csv", text), crs="EPSG:4326", vertical="ellipsoid")
    assert points.ids == ("a",)
    assert points.image.tolist() == [[10.5, 20.25]]
    assert points.ground.tolist() == [[24.4, -33.65, 100.0]]
    assert points.roles.tolist() == ["check"]
    assert points.sigma_image.tolist() == [0.2]
    assert points.sigma_ground.tolist() == [[0.1, 0.1, 0.0]]


def test_csv_byte_order_mark_line_ends_comments_and_columns_in_any_order(tmp_path: Path) -> None:
    text = "\ufeff# measured by hand\r\n\r\nY,X,Row,Col,ID\r\n-33.65,24.4,2,1,'x'\r\n"
    points = read_points(write(tmp_path / "größe mit leerzeichen.csv", text), crs="EPSG:4326")
    assert points.image.tolist() == [[1.0, 2.0]]
    assert np.isnan(points.ground[0, 2])


def test_csv_pixel_origin(tmp_path: Path) -> None:
    path = write(tmp_path / "p.csv", HEADER + ROW)
    centre = read_points(path, crs="EPSG:4979", pixel_origin="center")
    assert centre.image.tolist() == [[11.0, 20.75]]
    with pytest.raises(InputError, match="pixel origin"):
        read_points(path, crs="EPSG:4979", pixel_origin="middle")


GEOJSON = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"ji": [10.0, 20.0], "id": "a", "role": "check", "filename": "one.tif"},
            "geometry": {"type": "Point", "coordinates": [24.4, -33.65, 100.0]},
        },
        {
            "type": "Feature",
            "properties": {"ji": [11.0, 21.0]},
            "geometry": {"type": "Point", "coordinates": [24.5, -33.66]},
        },
    ],
}


def test_geojson_counts_from_the_centre_of_the_first_pixel(tmp_path: Path) -> None:
    points = read_points(write(tmp_path / "p.geojson", json.dumps(GEOJSON)))
    assert points.image.tolist() == [[10.5, 20.5], [11.5, 21.5]]
    assert points.ids == ("a", "2")
    assert points.roles.tolist() == ["check", "control"]
    assert points.ground[0].tolist() == [24.4, -33.65, 100.0]
    assert np.isnan(points.ground[1, 2])
    assert points.crs.to_epsg() == 4326


def test_geojson_takes_an_option_for_heights_that_are_not_ellipsoidal(tmp_path: Path) -> None:
    path = write(tmp_path / "p.geojson", json.dumps(GEOJSON))
    assert read_points(path, vertical="egm96").ground[0, 2] == pytest.approx(128.208, abs=0.01)
    with pytest.raises(CrsError, match=r"points\.crs"):
        read_points(path, crs="EPSG:32735")


@pytest.mark.parametrize("names", ["mapX,mapY,sourceX,sourceY,enable,dX,dY,residual", "mapX,mapY,pixelX,pixelY,enable"])
def test_qgis(tmp_path: Path, names: str) -> None:
    rest = ",0,0,0" if "residual" in names else ""
    text = f"#CRS: EPSG:32735\n{names}\n300000,6270000,10.5,-20.25,1{rest}\n300100,6270000,30,-40,0{rest}\n"
    points = read_points(write(tmp_path / "img.points", text))
    assert points.image.tolist() == [[10.5, 20.25]]
    assert points.crs.to_epsg() == 32735
    assert np.isnan(points.ground[0, 2])
    with pytest.raises(CrsError, match=r"points\.crs"):
        read_points(write(tmp_path / "no.points", text.split("\n", 1)[1]))


@pytest.mark.parametrize(
    ("first", "code"),
    [("EPSG:32633", 32633), ("WGS84 UTM 33N", 32633), ("+proj=utm +zone=33 +south +datum=WGS84 +units=m", 32733)],
)
def test_odm_list(tmp_path: Path, first: str, code: int) -> None:
    text = (
        f"\ufeff# survey\n{first}\n500000.5 5300000.25 123.5 100.5 200.5 one.tif tree\n"
        "500001 5300000 NaN 101 201 one.tif\n#500009 5300000 1 1 1 one.tif\n"
        "500000.5 5300000.25 123.5 1 2 two.tif tree\n"
    )
    path = write(tmp_path / "gcp_list.txt", text)
    points = read_points(path, vertical="ellipsoid", image_name="one.TIF")
    assert points.crs.equals(pyproj.CRS.from_epsg(code), ignore_axis_order=True) or first.startswith("+")
    assert points.ids == ("tree", "2")
    assert points.image.tolist() == [[100.5, 200.5], [101.0, 201.0]]
    assert points.ground[0].tolist() == [500000.5, 5300000.25, 123.5]
    assert np.isnan(points.ground[1, 2])
    with pytest.raises(DatumError, match=r"points\.vertical"):
        read_points(path, image_name="one.tif")
    with pytest.raises(InputError, match=r"three\.tif"):
        read_points(path, vertical="ellipsoid", image_name="three.tif")


def test_points_that_all_name_another_image_count_only_in_geojson(tmp_path: Path) -> None:
    """There the name is a note, and a renamed image keeps its points; other formats are of the image that they name."""
    listed = write(tmp_path / "gcp_list.txt", "EPSG:32633\n500000.5 5300000.25 123.5 100.5 200.5 one.tif\n")
    assert len(read_points(listed, vertical="ellipsoid", image_name="one.tif")) == 1
    with pytest.raises(InputError, match=r"no point was measured in 'three\.tif', only in one\.tif"):
        read_points(listed, vertical="ellipsoid", image_name="three.tif")
    feature = {
        "type": "Feature", "properties": {"id": "P", "ji": [1.0, 2.0], "filename": "one.tif"},
        "geometry": {"type": "Point", "coordinates": [15.0, 48.0, 100.0]},
    }  # fmt: skip
    collection = write(tmp_path / "p.geojson", json.dumps({"type": "FeatureCollection", "features": [feature]}))
    assert read_points(collection, image_name="three.tif").ids == ("P",)


def test_envi(tmp_path: Path) -> None:
    text = "; ENVI Image to Map GCP File\n; Map (x,y), Image (x,y)\n;\n 300000.5 6270000.0 11.5 21.25\n"
    points = read_points(write(tmp_path / "a.pts", text), crs="EPSG:32735")
    assert points.image.tolist() == [[10.5, 20.25]]
    assert points.ground[0, :2].tolist() == [300000.5, 6270000.0]
    with pytest.raises(InputError, match="layout"):
        read_points(write(tmp_path / "b.pts", "; ENVI Image to Image\n1 2 3 4\n"), crs="EPSG:32735")


def gdal_like(gcps: list[SimpleNamespace], projection: str = "EPSG:4326") -> SimpleNamespace:
    return SimpleNamespace(GetDescription=lambda: "x.tif", GetGCPs=lambda: gcps, GetGCPProjection=lambda: projection)


def gcp(column: float, x: float, z: float, name: str = "") -> SimpleNamespace:
    return SimpleNamespace(GCPPixel=column, GCPLine=5.0, GCPX=x, GCPY=-33.0, GCPZ=z, Id=name)


def test_gcps_of_a_dataset() -> None:
    points = gcps_of_dataset(gdal_like([gcp(1, 24, 0), gcp(2, 25, 0)]))
    assert points.ids == ("1", "2")
    assert np.isnan(points.ground[:, 2]).all(), "GDAL writes 0 where there is no height"
    with pytest.raises(DatumError, match=r"points\.vertical"):
        gcps_of_dataset(gdal_like([gcp(1, 24, 10, "a")]))
    assert gcps_of_dataset(gdal_like([gcp(1, 24, 10, "a")]), vertical="ellipsoid").ground[0, 2] == 10
    with pytest.raises(CrsError):
        gcps_of_dataset(gdal_like([gcp(1, 24, 0)], ""))
    with pytest.raises(InputError, match="no ground control"):
        gcps_of_dataset(gdal_like([]))


# -- CRS and heights


def test_csv_needs_a_crs_and_a_height_datum(tmp_path: Path) -> None:
    path = write(tmp_path / "p.csv", HEADER + ROW)
    with pytest.raises(CrsError, match=r"points\.crs"):
        read_points(path)
    with pytest.raises(DatumError, match=r"points\.vertical") as caught:
        read_points(path, crs="EPSG:4326")
    assert "egm96" in str(caught.value)
    assert read_points(path, crs="EPSG:4979").ground[0, 2] == 100.0


def test_heights_become_ellipsoidal_when_read(tmp_path: Path) -> None:
    path = write(tmp_path / "p.csv", HEADER + ROW)
    by_option = read_points(path, crs="EPSG:4326", vertical="egm96").ground[0, 2]
    by_crs = read_points(path, crs="EPSG:4326+5773").ground[0, 2]
    assert by_option == by_crs == pytest.approx(128.208, abs=0.01)
    with pytest.raises(DatumError, match=r"points\.vertical"):
        read_points(path, crs="EPSG:4979", vertical="egm96")


def test_heights_in_feet(tmp_path: Path) -> None:
    path = write(tmp_path / "p.csv", HEADER + "a,1,2,500000,5300000,1000\n")
    crs = "+proj=utm +zone=33 +datum=WGS84 +geoidgrids=egm96_15.gtx +vunits=us-ft"
    lon, lat, _ = GroundTransform("EPSG:32633", "EPSG:4979")([[500000, 5300000, 0]])[0]
    expected = 1000 * 1200 / 3937 + Vertical.parse("egm96").undulation([lon], [lat])[0]
    assert read_points(path, crs=crs).ground[0, 2] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("code", "metres"), [("EPSG:6360", 1200 / 3937), ("EPSG:8228", 0.3048), ("EPSG:5703", 1.0)])
@pytest.mark.parametrize("stated", [True, False])
def test_heights_have_the_unit_of_the_datum(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, metres: float, stated: bool
) -> None:
    # The geoid is not installed everywhere; its undulation is in metres for each of these codes.
    monkeypatch.setattr(Vertical, "undulation", lambda self, lon, lat: np.full(np.shape(lon), -26.5))
    path = write(
        tmp_path / "p.csv", (f"#vertical: {code}\n" if stated else "") + HEADER + "a,1,2,1640000,10827000,500\n"
    )
    # On WGS84: newer databases need a grid for NAD83.
    crs = "+proj=utm +zone=14 +datum=WGS84 +units=us-ft +type=crs"
    points = read_points(path, crs=crs, vertical=None if stated else code)
    assert points.ground[0, 2] == pytest.approx(500 * metres - 26.5, abs=1e-9)


def test_latitude_first_is_found_where_it_can_be(tmp_path: Path) -> None:
    path = write(tmp_path / "p.csv", HEADER + "a,1,2,-33.65,151.2,100\n")
    with pytest.raises(InputError, match=r"line 2.*not on Earth"):
        read_points(path, crs="EPSG:4979")


# -- duplicates


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ("a,1,2,24.5,-33,1,check", "two points have the id"),
        ("b,1,2,24.4,-33.65,100,check", "same ground .* as check and control"),
        ("b,10.5,20.25,24.5,-33,100,control", "same image"),
    ],
)
def test_duplicates(tmp_path: Path, second: str, message: str) -> None:
    text = HEADER.strip() + ",role\n" + ROW.strip() + ",control\n" + second + "\n"
    with pytest.raises(InputError, match=message) as caught:
        read_points(write(tmp_path / "p.csv", text), crs="EPSG:4979")
    assert "line 3" in str(caught.value)
    assert "line 2" in str(caught.value)


# -- hostile input


@pytest.mark.parametrize(
    ("cell", "shown"),
    [
        ("nan", "nan"),
        ("inf", "inf"),
        ("1e400", "1e400"),
        ("1_0", "1_0"),
        ("0x10", "0x10"),
        ("ten", "ten"),
        ("", "''"),
        ('"10,5"', "decimal point"),
        ("1" * 5000, "not a number"),
        ("\u0661\u0662", "not a number"),
    ],
)
def test_what_is_no_number_is_named_with_line_and_column(tmp_path: Path, cell: str, shown: str) -> None:
    path = write(tmp_path / "p.csv", HEADER + ROW + f"b,1,{cell},24.4,-33.5,100\n")
    with pytest.raises(InputError) as caught:
        read_points(path, crs="EPSG:4979")
    text = str(caught.value)
    assert shown in text
    assert "line 3, column row" in text
    assert str(path) in text
    assert ("decimal point" in text) == ("," in cell)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\n\n",
        HEADER.encode(),
        HEADER.encode().replace(b"row", b"rwo"),
        HEADER.encode().replace(b"\n", b",sigma_imge\n") + b"a,1,2,3,4,5,6\n",
        HEADER.encode() + b"a,1,2\n",
        HEADER.encode() + b"a,10,5,20,25,24,4,-33,65,100\n",
        HEADER.encode() + b'a,"1,2,3,4,5\n',
        HEADER.encode() + b",1,2,3,4,5\n",
        (HEADER + ROW).encode() + b"\0",
        (HEADER + ROW).encode("utf-16"),
        (HEADER + ROW).encode() + b"\xff\xfe\xfa",
        b"id,col,row,x,y,h,role\na,1,2,3,4,5,boss\n",
        b"id,col,row,x,y,h,sigma_image\na,1,2,3,4,5,-1\n",
        b"id,col,row,x,y,h,sigma_image\na,1,2,3,4,5,0\n",
        b"\x89PNG\r\n\x1a\n",
        HEADER.encode() + b"a," + b"1" * 10_000_000 + b",2,3,4,5\n",
        b"x" * 10_000_000,
        b"9" * 33_000_000,
    ],
    ids=lambda data: f"{data[:24]!r}{len(data)}",
)
@pytest.mark.parametrize("suffix", [".csv", ".txt", ".points", ".geojson", ".pts"])
def test_hostile_files_end_in_a_typed_error_soon(tmp_path: Path, data: bytes, suffix: str, calls: Any) -> None:
    path = write(tmp_path / f"p{suffix}", data)
    with pytest.raises(InputError), calls:
        read_points(path, crs="EPSG:4979")
    # Some are of 33 MB: nothing is done for every line, or every letter, of them.
    assert calls.count < 5000


@pytest.mark.parametrize(
    "change",
    [
        lambda d: d["features"][0]["properties"].update(ji=[1]),
        lambda d: d["features"][0]["properties"].update(ji="1,2"),
        lambda d: d["features"][0]["properties"].update(ji=[float("nan"), 1]),
        lambda d: d["features"][0]["properties"].update(ji=[True, 1]),
        lambda d: d["features"][0]["properties"].update(ji=[10**5000 // 10**4000, 10**400]),
        lambda d: d["features"][0]["properties"].update(role="boss"),
        lambda d: d["features"][0]["properties"].update(id=["a"]),
        lambda d: d["features"][0]["geometry"].update(type="LineString"),
        lambda d: d["features"][0]["geometry"].update(coordinates=[1]),
        lambda d: d["features"][0]["geometry"].update(coordinates=[1, None, 3]),
        lambda d: d["features"][0]["geometry"].update(coordinates=[24, 95, 3]),
        lambda d: d["features"].append(7),
        lambda d: d.update(features={}),
        lambda d: d.update(features=[]),
        lambda d: d.update(crs={"properties": {"name": "EPSG:32735"}}),
    ],
)
def test_hostile_geojson(tmp_path: Path, change) -> None:
    document = json.loads(json.dumps(GEOJSON))
    change(document)
    with pytest.raises(InputError):
        read_points(write(tmp_path / "p.geojson", json.dumps(document)))


@pytest.mark.parametrize("text", ["[" * 100_000, '{"features": 1e400}', "{", '{"features": [1e999]}', "[]"])
def test_broken_json(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError):
        read_points(write(tmp_path / "p.geojson", text))


def test_a_mutated_file_is_read_or_refused_but_nothing_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    originals = {
        "a.csv": HEADER + ROW,
        "a.geojson": json.dumps(GEOJSON),
        "a.points": "#CRS: EPSG:4326\nmapX,mapY,sourceX,sourceY,enable\n24.4,-33.6,1,-2,1\n",
        "a.txt": "EPSG:4979\n24.4 -33.6 100 5 6 a.tif\n",
    }
    for name, text in originals.items():
        for _ in range(150):
            data = bytearray(text.encode())
            for _ in range(rng.integers(1, 4)):
                data[rng.integers(len(data))] = rng.integers(256)
            try:
                points = read_points(write(tmp_path / name, bytes(data)), crs="EPSG:4979")
            except InputError:
                continue
            assert np.isfinite(points.image).all()
            assert np.isfinite(points.ground[:, :2]).all()


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.csv", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_points(path)


# -- the table


def test_table_rules() -> None:
    points = some_points()
    assert len(points) == 9
    assert points.control.sum() == points.check.sum() == 3
    part = points.select(points.check)
    assert part.ids == ("p 1", "p 4", "p 7")
    assert (part.image == points.image[points.check]).all()
    with pytest.raises(InputError):
        points.with_ground(np.zeros((2, 3)))
    with pytest.raises(InputError):
        points.with_roles(["boss"] * 9)
    with pytest.raises(InputError, match="two points have the id"):
        Points(
            ("a", "a"),
            *[
                getattr(points.select([0, 1]), n)
                for n in ("image", "ground", "roles", "sigma_image", "sigma_ground", "crs", "source")
            ],
        )


def test_to_crs_keeps_heights_that_are_not_given() -> None:
    points = some_points()
    ground = points.ground.copy()
    ground[0, 2] = np.nan
    utm = points.with_ground(ground).to_crs("EPSG:32735")
    assert np.isfinite(utm.ground[0, :2]).all()
    assert np.isnan(utm.ground[0, 2])
    assert utm.to_crs("EPSG:4979").ground == pytest.approx(ground, abs=1e-9, nan_ok=True)


def test_every_nth_control_point_becomes_check() -> None:
    points = some_points().with_roles(["control"] * 9)
    assert np.flatnonzero(assign_roles(points, "every:3").check).tolist() == [2, 5, 8]
    assert assign_roles(points, "ids:p 1, p 4").check.nonzero()[0].tolist() == [1, 4]
    with pytest.raises(InputError, match="no point q"):
        assign_roles(points, "ids:p 1,q")
    for spec in ("every:0", "every:x", "every:-1", "evry:3", "ids:", "", "every:²"):
        with pytest.raises(InputError, match="every:N"):
            assign_roles(points, spec)


# -- writing


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:32735", "+proj=tmerc +lon_0=25 +datum=WGS84 +units=m"])
@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".geojson", ".points"])
def test_round_trips(tmp_path: Path, crs: str, suffix: str) -> None:
    points = some_points(crs)
    path = tmp_path / f"out{suffix}"
    write_points(points, path)
    again = read_points(path).to_crs(points.crs)
    tolerance = 1e-9 if suffix != ".geojson" or crs == "EPSG:4326" else 1e-6
    assert again.image == pytest.approx(points.image, abs=1e-9)
    assert again.ground[:, :2] == pytest.approx(points.ground[:, :2], abs=tolerance, rel=0)
    if suffix == ".points":
        return
    assert again.ground == pytest.approx(points.ground, abs=tolerance, rel=0)
    assert again.ids == points.ids
    assert again.roles.tolist() == points.roles.tolist()
    assert again.sigma_image == pytest.approx(points.sigma_image)
    assert again.sigma_ground == pytest.approx(points.sigma_ground)


def test_a_qgis_file_of_geocentric_points_has_longitudes_and_latitudes(tmp_path: Path) -> None:
    points = Points.of([[1.0, 2.0]], [[24.4, -33.65, 100.0]], "EPSG:4979")
    write_points(points.to_crs("EPSG:4978"), tmp_path / "out.points")
    assert read_points(tmp_path / "out.points").ground[0, :2] == pytest.approx([24.4, -33.65], abs=1e-9)


def test_odd_ids_and_missing_heights_survive(tmp_path: Path) -> None:
    points = some_points().select([0, 1, 2])
    ground = points.ground.copy()
    ground[1, 2] = np.nan
    ids = ("#1", 'with "quotes", and comma', "größe")
    points = Points(ids, points.image, ground, points.roles, points.sigma_image, points.sigma_ground, points.crs, "")
    for name in ("a.csv", "a.geojson"):
        write_points(points, tmp_path / name)
        again = read_points(tmp_path / name)
        assert again.ids == ids
        assert again.ground == pytest.approx(ground, nan_ok=True)


def test_geojson_is_written_with_centres(tmp_path: Path) -> None:
    points = some_points()
    write_points(points, tmp_path / "a.geojson")
    feature = json.loads((tmp_path / "a.geojson").read_text())["features"][0]
    assert feature["properties"]["ji"] == pytest.approx((points.image[0] - 0.5).tolist())
    assert feature["geometry"]["coordinates"] == pytest.approx(points.ground[0].tolist())


def test_unknown_format_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.csv"):
        write_points(some_points(), tmp_path / "a.xlsx")


@pytest.mark.realdata
def test_real_quickbird_points(real: Path) -> None:
    points = read_points(real / "orthority/rpc/gcps.geojson", image_name="qb2_basic1b.tif")
    assert len(points) == 5
    assert points.control.all()
    assert points.image[0] == pytest.approx([821.8001696660183, 62.803697728645055])
    assert points.ground[0] == pytest.approx([24.41948061951812, -33.65426900104435, 214.75143153141929])
    # Points outside of the image are legal.
    assert (points.image < 0).any()
    assert read_table(real / "orthority/rpc/gcps.geojson").format == "GeoJSON"


def test_points_of_arrays_are_those_of_a_file(tmp_path):
    image, ground = [[10.5, 20.25], [30.0, 40.0]], [[33.0, 39.0, 850.0], [33.1, 39.1, np.nan]]
    points = Points.of(image, ground, "EPSG:4979", roles=["control", "check"], sigma_image=0.3, sigma_ground=0.2)
    assert points.ids == ("1", "2")
    write_points(points, tmp_path / "points.csv")
    again = read_points(tmp_path / "points.csv")
    for name in ("image", "ground", "roles", "sigma_image", "sigma_ground"):
        np.testing.assert_array_equal(getattr(again, name), getattr(points, name))
    with pytest.raises(InputError, match="shape"):
        Points.of(image, ground[:1], "EPSG:4979")
    with pytest.raises(InputError, match="two points have the id"):
        Points.of(image, ground, "EPSG:4979", ids=["a", "a"])


@pytest.mark.parametrize(
    ("crs", "at", "apart", "same"),
    [
        # Half a millimetre is one point, two millimetres are two; 1e-8 degrees are 1.1 mm.
        ("EPSG:32634", (500_000.0, 6_000_000.0), 1e-4, True), ("EPSG:32634", (500_000.0, 6_000_000.0), 2e-3, False),
        ("EPSG:3031", (-1_500_000.0, -1_000_000.0), 1e-4, True), ("EPSG:4979", (24.0, -33.0), 1e-9, True),
        ("EPSG:4979", (24.0, -33.0), 2e-8, False),
    ],
)  # fmt: skip
def test_the_same_place_twice_is_refused_and_a_near_one_is_not(tmp_path, crs, at, apart, same):
    text = HEADER + f"a,1,2,{at[0]},{at[1]},100\nb,3,4,{at[0] + apart!r},{at[1]},100\n"
    path = write(tmp_path / "p.csv", text)
    if same:
        with pytest.raises(InputError, match="the same ground coordinates as in line 2"):
            read_points(path, crs=crs, vertical="ellipsoid")
    else:
        assert len(read_points(path, crs=crs, vertical="ellipsoid")) == 2


def test_a_pixel_is_the_same_to_a_millionth(tmp_path):
    for apart, same in ((1e-7, True), (1e-5, False)):
        path = write(tmp_path / "p.csv", HEADER + f"a,1,2,24,-33,100\nb,{1 + apart!r},2,24.1,-33,100\n")
        if same:
            with pytest.raises(InputError, match="the same image coordinates"):
                read_points(path, crs="EPSG:4979", vertical="ellipsoid")
        else:
            assert len(read_points(path, crs="EPSG:4979", vertical="ellipsoid")) == 2


def test_heights_above_a_geoid_are_no_points_of_arrays() -> None:
    with pytest.raises(CrsError, match="above a geoid") as caught:
        Points.of([[10.0, 20.0]], [[33.0, 37.0, 800.0]], "EPSG:4326+5773")
    remedy = str(caught.value.remedy).split("`")[1].removeprefix("op.")
    scope = {"Vertical": Vertical, "DATUM": "egm96", "lon": [33.0], "lat": [37.0], "heights": [800.0]}
    assert eval(remedy, scope)[0] == pytest.approx(832.9, abs=0.05)  # the undulation of EGM96 there
    for crs in ("EPSG:4979", "EPSG:4326", "EPSG:32636"):
        assert len(Points.of([[10.0, 20.0]], [[33.0, 37.0, 800.0]], crs)) == 1


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("roles", "controls"),
        ("roles", ["control", "control-check", "check"]),
        ("roles", ["control"] * 2),
        ("sigma_image", [1.0, 2.0]),
        ("sigma_image", "unknown"),
        ("sigma_ground", [1.0, 2.0, 3.0, 4.0]),
        ("image", 5.0),
        ("ground", [["a", "b", "c"]] * 3),
    ],
)
def test_arrays_that_are_no_points_are_refused_by_name(field: str, values: object) -> None:
    arrays = {"image": np.zeros((3, 2)), "ground": np.zeros((3, 3)), "crs": "EPSG:4979"}
    with pytest.raises(InputError) as caught:
        Points.of(**{**arrays, field: values})
    assert caught.value.field == field


def test_points_do_not_change_with_the_arrays_they_were_made_of() -> None:
    image = np.array([[1.0, 2.0], [3.0, 4.0]])
    points = Points.of(image, [[33.0, 37.0, 0.0], [33.1, 37.0, 0.0]], "EPSG:4979", ids=[7, 8])
    image[:] = 0.0
    assert points.image.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert points.ids == ("7", "8")
    assert len(points.select([])) == 0


@pytest.mark.parametrize("suffix", [".csv", ".geojson"])
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sigma_image", 0.0), ("sigma_image", 1e200), ("groups", 2**53), ("image", np.nan), ("image", np.inf),
        ("ground", np.nan), ("ground", np.inf),
    ],
)  # fmt: skip
def test_what_could_not_be_read_again_is_not_written(tmp_path: Path, suffix: str, field: str, value: float) -> None:
    points = some_points()
    values = getattr(points, field).copy()
    values[3] = value
    with pytest.raises(InputError, match=f"{field} of point 'p 3'"):
        write_points(replace(points, **{field: values, "covariance_image": None}), tmp_path / f"p{suffix}")
    assert not list(tmp_path.iterdir())
