"""Point files as the field writes them: headers of surveyors, decimal commas, lists of other programs."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pyproj
import pytest

from ortho_pipeline import commands
from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.options import PointOptions
from ortho_pipeline.points import Points, one_mark, read_points, write_points
from ortho_pipeline.points.formats import names_image, read_block_table
from ortho_pipeline.points.rows import MAX_FILE


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def read(tmp_path: Path, text: str, name: str = "p.csv", crs: str | None = "EPSG:32735", **more: str) -> Points:
    return read_points(write(tmp_path / name, text), crs=crs, vertical="ellipsoid", **more)


# -- headers of the field


@pytest.mark.parametrize(
    ("header", "line", "crs"),
    [
        ("Name,Pixel,Line,Easting,Northing,Elev", "A1,10.5,20.25,500100.5,6270000.25,123.5", "EPSG:32735"),
        ("Point ID;Pixel;Line;Easting;Northing;Elev", "A1;10,5;20,25;500100,5;6270000,25;123,5", "EPSG:32735"),
        ("Label\txPix\tyPix\tE\tN\tAlt", "A1\t10,5\t20,25\t500100,5\t6270000,25\t123,5", "EPSG:32735"),
        ("ID P L X Y Z S", "A1 10.5 20.25 500100.5 6270000.25 123.5 G", "EPSG:32735"),
        ("ID P L X Y E", "A1 10.5 20.25 500100.5 6270000.25 123.5", "EPSG:32735"),
        ("point,northing,easting,height,line,sample", "A1,6270000.25,500100.5,123.5,20.25,10.5", "EPSG:32735"),
        (",col,row,x,y,h", "A1,10.5,20.25,500100.5,6270000.25,123.5", "EPSG:32735"),
        ("Unnamed: 0,id,col,row,x,y,h", "7,A1,10.5,20.25,500100.5,6270000.25,123.5", "EPSG:32735"),
        ("gcp,x_pix,y_pix,East (m),North (m),Elevation [m],", "A1,10.5,20.25,500100.5,6270000.25,123.5,", "EPSG:32735"),
        ("id,col [px],row [px],X [m],Y (m),h [m]", "A1,10.5,20.25,500100.5,6270000.25,123.5", "EPSG:32735"),
        ("Name,Pixel,Line,Lat,Lon,alt", "A1,10.5,20.25,-33.65,24.4,123.5", "EPSG:4326"),
        ("Name|Pixel X|Pixel Y|Latitude|Longitude|Altitude (m)", "A1|10.5|20.25|-33.65|24.4|123.5", "EPSG:4326"),
        ('"Name" "Pixel" "Line" "Lat" "Lon" "Z"', '"A1"  10.5 20.25\t-33.65 24.4  123.5', "EPSG:4326"),
    ],
)
@pytest.mark.parametrize("name", ["p.csv", "p.txt"])
def test_headers_of_the_field(tmp_path: Path, header: str, line: str, crs: str, name: str) -> None:
    points = read(tmp_path, f"{header}\n{line}\n", name, crs)
    assert points.ids == ("A1",)
    assert points.image.tolist() == [[10.5, 20.25]]
    place = [24.4, -33.65, 123.5] if crs == "EPSG:4326" else [500100.5, 6270000.25, 123.5]
    assert points.ground.tolist() == [place]
    assert points.control.all()


def test_points_without_ids_are_numbered(tmp_path: Path) -> None:
    points = read(tmp_path, "Pixel;Line;Easting;Northing\n1,5;2;500100,5;6270000\n3;4;500200;6270000\n")
    assert points.ids == ("1", "2")
    assert points.image.tolist() == [[1.5, 2.0], [3.0, 4.0]]


def test_a_table_that_was_saved_with_its_index_and_semicolons(tmp_path: Path) -> None:
    points = read(tmp_path, ";id;col;row;x;y;h\n0;A;1,5;2;500100,5;6270000;9\n1;B;3;4;500200;6270000;9\n")
    assert points.ids == ("A", "B")
    assert read(tmp_path, ";col;row;x;y;h\n0;1,5;2;500100,5;6270000;9\n").ids == ("0",)


def test_comments_may_be_long(tmp_path: Path) -> None:
    comments = "".join(f"# survey of day {day}, by the book\n" for day in range(200))
    assert read(tmp_path, f"{comments}id,col,row,x,y,h\nA,1,2,500100,6270000,9\n", "points.txt").ids == ("A",)


def test_status_of_a_point(tmp_path: Path) -> None:
    text = "ID P L X Y Z S\n1 1 2 500100 6270000 5 G\n2 3 4 500200 6270000 5 C\n3 5 6 500300 6270000 5 I\n"
    points = read(tmp_path, text, "pci.txt")
    assert points.ids == ("1", "2")
    assert points.roles.tolist() == ["control", "check"]
    with pytest.raises(InputError, match="line 2, column S"):
        read(tmp_path, text.replace("5 G", "5 Q"), "pci.txt")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # Which of them is the image, which the ground?
        ("Name,X,Y,Easting,Northing,Elev\na,1,2,3,4,5\n", "'X' and 'Easting' both mean x"),
        ("Name,Pixel,Line,x,y,Elev,alt\na,1,2,3,4,5,6\n", "'Elev' and 'alt' both mean h"),
        ("Name,i,j,Easting,Northing\na,1,2,3,4\n", "unknown column 'i'"),
        ("Name,Pixel,Line,Easting,Northing,Elev (ft)\na,1,2,3,4,5\n", r"unknown column 'Elev \(ft\)'"),
        ("Name,Easting,Northing,Elev\na,1,2,3\n", "no column col, row"),
        ("Name,,Pixel,Line,Easting,Northing\na,b,1,2,3,4\n", "unknown column ''"),
        ("A1,10.5,20.25,500100.5,6270000.25,123.5\n", "unknown column"),
    ],
)
def test_unclear_columns_are_shown(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        read(tmp_path, text)
    shown = str(caught.value)
    for name in text.splitlines()[0].split(","):
        assert name in shown, "every column that was found is shown"
    assert "line 1" in shown
    assert "col,row" in str(caught.value.remedy)
    if text.startswith("A1"):
        assert "header" in str(caught.value.remedy)


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ("a;10,5;20.25;500100;6270000;1", "decimal commas and decimal points"),
        ("a;10,5;20;500.100,5;6270000;1", "decimal commas and decimal points"),
        ("a;10,5;20;500,100,5;6270000;1", "not a number"),
        ("a;1,2,3;20;500100;6270000;1", "not a number"),
        ("a;10,;20;500100;6270000;x", "line 2, column Elev"),
        ("a;10,5;20;500100;6270000", "5 cells, but there are 6"),
    ],
)
def test_numbers_that_are_unclear(tmp_path: Path, row: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read(tmp_path, f"Name;Pixel;Line;Easting;Northing;Elev\n{row}\n")


def test_marks_are_those_of_the_whole_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 3, column Line.*decimal commas and decimal points"):
        read(tmp_path, "Name;Pixel;Line;Easting;Northing\na;10,5;20;500100;6270000\nb;1;2.5;500200;6270000\n")
    assert read(tmp_path, "Name;Pixel;Line;x;y\na;1,5e1;2;500100;6270000\n").image[0, 0] == 15.0


def test_names_of_the_ground_and_its_crs_agree(tmp_path: Path) -> None:
    with pytest.raises(CrsError, match="longitude"):
        read(tmp_path, "Name,Pixel,Line,Lat,Lon\na,1,2,-33,24\n", crs="EPSG:32735")
    with pytest.raises(CrsError, match="easting"):
        read(tmp_path, "Name,Pixel,Line,Easting,Northing\na,1,2,24,-33\n", crs="EPSG:4326")
    assert np.isnan(read(tmp_path, "Name,Pixel,Line,X,Y\na,1,2,24,-33\n", crs="EPSG:4326").ground[0, 2])


# -- pixel origins


@pytest.mark.parametrize(
    ("origin", "centre_of_first_pixel"),
    [("corner", 0.5), ("center", 0.0), ("corner-1", 1.5), ("center-1", 1.0)],
)
def test_pixel_origins(tmp_path: Path, origin: str, centre_of_first_pixel: float) -> None:
    at = centre_of_first_pixel
    points = read(tmp_path, f"id,col,row,x,y\na,{at},{at},500100,6270000\n", pixel_origin=origin)
    assert points.image.tolist() == [[0.5, 0.5]]
    rays = f"id,image,col,row\na,one.tif,{at},{at}\na,two.tif,{at},{at}\n"
    assert read_block_points(write(tmp_path / "b.csv", rays), pixel_origin=origin).measured.tolist() == [[0.5, 0.5]] * 2
    odm = read(tmp_path, f"EPSG:32735\n500100 6270000 5 {at} {at} one.tif\n", "gcp_list.txt", None, pixel_origin=origin)
    assert odm.image.tolist() == [[0.5, 0.5]]


def test_an_origin_is_not_swallowed(tmp_path: Path) -> None:
    qgis = "#CRS: EPSG:32735\nmapX,mapY,sourceX,sourceY,enable\n500100,6270000,1,-2,1\n"
    with pytest.raises(InputError, match="QGIS points defines its own"):
        read(tmp_path, qgis, "a.points", None, pixel_origin="center")
    with pytest.raises(InputError, match="corner, center, corner-1, center-1"):
        read(tmp_path, "id,col,row,x,y\na,1,2,3,4\n", pixel_origin="middle")


# -- geocentric points


def geocentric(lon: float, lat: float, h: float) -> tuple[float, float, float]:
    """Return X, Y, Z on WGS84 by the textbook's formula."""
    a, f = 6378137.0, 1 / 298.257223563
    e2, lon, lat = f * (2 - f), math.radians(lon), math.radians(lat)
    n = a / math.sqrt(1 - e2 * math.sin(lat) ** 2)
    x, y = ((n + h) * math.cos(lat) * part for part in (math.cos(lon), math.sin(lon)))
    return x, y, ((1 - e2) * n + h) * math.sin(lat)


@pytest.mark.parametrize("crs", ["EPSG:4978", "EPSG:7789", "+proj=geocent +datum=WGS84 +units=m"])
def test_geocentric_points(tmp_path: Path, crs: str) -> None:
    truth = np.array([[24.4, -33.65, 123.5], [24.41, -33.66, 500.0]])
    lines = [
        f"{k},1{k},20,{','.join(map(repr, geocentric(*row.tolist())))},control,0.5,0.25\n"
        for k, row in enumerate(truth)
    ]
    path = write(tmp_path / "p.csv", "id,col,row,X,Y,Z,role,sigma_xy,sigma_h\n" + "".join(lines))
    points = read_points(path, crs=crs)
    # Realisations of the frame differ by centimetres, which PROJ may know of.
    tolerance = 1e-11 if crs == "EPSG:4978" else 1e-6
    assert points.ground[:, :2] == pytest.approx(truth[:, :2], abs=tolerance, rel=0)
    assert points.ground[:, 2] == pytest.approx(truth[:, 2], abs=1e-6 if crs == "EPSG:4978" else 0.05, rel=0)
    assert points.crs.to_epsg() == 4326
    assert points.sigma_ground.tolist() == [[0.5, 0.5, 0.25]] * 2
    # Ellipsoidal by what they are: a geoid is a contradiction.
    assert read_points(path, crs=crs, vertical="ellipsoid").ground.tolist() == points.ground.tolist()
    with pytest.raises(DatumError, match="centre of the Earth"):
        read_points(path, crs=crs, vertical="egm96")


def test_geocentric_points_come_back_from_a_file_and_in_a_block(tmp_path: Path) -> None:
    truth = [24.4, -33.65, 123.5]
    one = read(tmp_path, f"id,col,row,x,y,h\na,1,2,{','.join(map(repr, truth))}\n", crs="EPSG:4326")
    write_points(one.to_crs("EPSG:4978"), tmp_path / "ecef.csv")
    assert read_points(tmp_path / "ecef.csv").ground[0] == pytest.approx(truth, abs=1e-8)
    x, y, z = geocentric(*truth)
    rays = f"id,image,col,row,x,y,h\na,one.tif,1,2,{x!r},{y!r},{z!r}\na,two.tif,1,2,,,\nt,one.tif,5,6,,,\n"
    block = read_block_points(write(tmp_path / "b.csv", rays), crs="EPSG:4978")
    assert block.ground[0] == pytest.approx(truth, abs=1e-8)
    assert np.isnan(block.ground[1]).all()


@pytest.mark.parametrize(
    ("x", "y", "h", "said"),
    [
        ("24.4", "-33.65", "120", "not on Earth"),
        ("4841", "2196", "-3514", "not on Earth"),
        ("4840257", "2195640", "", "Z nan"),
    ],
)
def test_what_is_not_geocentric_is_refused(tmp_path: Path, x: str, y: str, h: str, said: str) -> None:
    path = write(tmp_path / "p.csv", f"id,col,row,x,y,h\na,1,2,{x},{y},{h}\n")
    with pytest.raises(InputError, match=f"line 2.*{said}") as caught:
        read_points(path, crs="EPSG:4978")
    assert caught.value.remedy
    named = write(tmp_path / "n.csv", "Name,Pixel,Line,Easting,Northing,Elev\na,1,2,3,4,5\n")
    with pytest.raises(CrsError, match="easting"):
        read_points(named, crs="EPSG:4978")


def test_a_height_datum_that_is_stated_twice_and_differs(tmp_path: Path) -> None:
    text = "#CRS: EPSG:32735+5773\n#vertical: {}\nid,col,row,x,y,h\na,1,2,500100,6270000,100\n"
    with pytest.raises(DatumError, match="state"):
        read_points(write(tmp_path / "p.csv", text.format("ellipsoid")))
    assert read_points(write(tmp_path / "p.csv", text.format("egm96"))).ground[0, 2] != 100.0
    # What is known by a name only gives way to what is stated.
    flat = pyproj.CRS("EPSG:32735").to_wkt().replace("\n", "")
    named = 'VERTCRS["EGM96 height",VDATUM["unknown"],CS[vertical,1],AXIS["up",up,LENGTHUNIT["metre",1]]]'
    by_name = text.format("ellipsoid").replace("EPSG:32735+5773", f'COMPOUNDCRS["both",{flat},{named}]')
    assert read_points(write(tmp_path / "p.csv", by_name)).ground[0, 2] == 100.0


# -- lists of other programs


ASP = (
    '# WKT: GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AXIS["Latitude",NORTH],AXIS["Longitude",EAST]]\n'
    "# id latitude longitude height\n"
    "5 23.7 160.1 427.1 1.0 2.0 3.0 image1.tif 124.5 19.7 1.0 0.5 sub/image2.tif 254.3 73.9 0.25 0.25\n"
    "6,23.8,160.2,-5,1,1,1,image1.tif,10,20,1,1\n"
)


@pytest.mark.parametrize("name", ["a.gcp", "points.txt"])
def test_ames_stereo_pipeline(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / name, ASP)
    points = read_points(path, image_name="image1.tif")
    assert points.ids == ("5", "6")
    assert points.image.tolist() == [[125.0, 20.2], [10.5, 20.5]]  # the centre of the first pixel is (0, 0) there
    assert points.ground.tolist() == [[160.1, 23.7, 427.1], [160.2, 23.8, -5.0]]
    assert points.sigma_image.tolist() == [1.0, 1.0]
    assert points.sigma_ground.tolist() == [[2.0, 2.0, 3.0], [1.0, 1.0, 1.0]]
    assert read_points(path, image_name="image2.tif").image.tolist() == [[254.8, 74.4]]
    block = read_block_points(path)
    assert (block.ids, len(block.measured)) == (("5", "6"), 3)
    bare = write(tmp_path / "bare.gcp", "".join(ASP.splitlines(keepends=True)[2:]))
    with pytest.raises(CrsError, match=r"points\.crs"):
        read_points(bare, image_name="image1.tif")
    assert read_points(bare, crs="EPSG:4326", image_name="image1.tif").ground[0].tolist() == [160.1, 23.7, 427.1]
    with pytest.raises(CrsError, match="projected"):
        read_points(bare, crs="EPSG:32735", image_name="image1.tif")


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("5 23.7 160.1 427.1 1 1 1 a.tif 124.5 19.7 1", "line 1: this line has 11 cells"),
        ("5 23.7 160.1 x 1 1 1 a.tif 124.5 19.7 1 1", "line 1, height"),
        ("5 23.7 160.1 4 1 -1 1 a.tif 124.5 19.7 1 1", "line 1, sigma 2"),
        ("5 23.7 160.1 4 1 1 1 a.tif 124.5 19.7 0 1", "line 1, pixel sigma"),
        ("5 93.7 160.1 4 1 1 1 a.tif 124.5 19.7 1 1", "line 1: longitude 160.1, latitude 93.7"),
    ],
)
def test_broken_lines_of_asp(tmp_path: Path, line: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read_points(write(tmp_path / "a.gcp", line + "\n"), crs="EPSG:4326")


def test_several_images_are_not_taken_for_one(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"image1\.tif, sub/image2\.tif") as caught:
        read_points(write(tmp_path / "a.gcp", ASP))
    assert "image_name" in str(caught.value.remedy)
    text = "id,col,row,x,y,image\na,1,2,500100,6270000,one.tif\nb,3,4,500200,6270000,two.tif\n"
    with pytest.raises(InputError, match=r"one\.tif, two\.tif"):
        read(tmp_path, text)


def test_images_of_the_same_name_in_different_folders_are_kept_apart(tmp_path: Path) -> None:
    """`ortho ties` and `measure` write the folder of such images, and cameras number their photos in each folder."""
    path = tmp_path / "points.csv"
    path.write_text(
        "id,image,col,row,x,y,h\nA,fore/BAND.tif,1,2,500000,4000000,9\n"
        "A,aft/BAND.tif,5,6,500000,4000000,9\nB,aft/BAND.tif,7,8,500100,4000000,9\n"
    )
    given = {"crs": "EPSG:32636", "vertical": "ellipsoid"}
    for name, image in (("fore", [[1, 2]]), ("aft", [[5, 6], [7, 8]])):
        assert read_points(path, image_name=str(tmp_path / name / "BAND.tif"), **given).image.tolist() == image
    with pytest.raises(InputError, match=r"no point was measured in 'BAND\.tif', only in aft/BAND\.tif, fore/BAND"):
        read_points(path, image_name="BAND.tif", **given)
    # Images of a folder that was renamed keep their points.
    path.write_text("id,image,col,row,x,y,h\nA,old/BAND.tif,1,2,500000,4000000,9\n")
    assert read_points(path, image_name=str(tmp_path / "new/BAND.tif"), **given).ids == ("A",)


@pytest.mark.parametrize(
    ("name", "image", "same"),
    [
        ("BAND.tif", "/day/fore/BAND.tif", True), ("band.TIF", "/day/fore/BAND.tif", True),
        ("fore\\BAND.tif", "/day/fore/BAND.tif", True), (" ./fore/BAND.tif ", "/day/fore/BAND.tif", True),
        ("/day/fore/BAND.tif", "/day/fore/BAND.tif", True), ("../fore/BAND", "/day/fore/BAND.tif", True),
        ("aft/BAND.tif", "/day/fore/BAND.tif", False), ("night/fore/BAND.tif", "/day/fore/BAND.tif", False),
        ("fore/OTHER.tif", "/day/fore/BAND.tif", False), ("/more/day/fore/BAND.tif", "/day/fore/BAND.tif", False),
        # A name without a suffix may have points of its own; another suffix is that of a converted image.
        ("scene.v2", "/day/scene.v2.tif", True), ("scene.v2.jp2", "/day/scene.v2.tif", True),
        ("scene", "/day/scene.v2.tif", False), ("scene.v2", "/day/scene.tif", True),
        ("", "/day/BAND.tif", False), (".", "/day/BAND.tif", False),
    ],
)  # fmt: skip
def test_a_name_means_an_image_if_all_of_its_folders_agree(name: str, image: str, same: bool) -> None:
    assert names_image(name, image) is same


def test_a_point_without_an_image_among_others_is_not_lost(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("id,image,col,row,x,y,h\nA,s.tif,1,2,500000,4000000,9\nB,,7,8,500100,4000000,9\n")
    with pytest.raises(InputError, match="this point does not name its image, but others do") as refused:
        read_points(path, crs="EPSG:32636", vertical="ellipsoid", image_name="s.tif")
    assert refused.value.field == "line 3"


def test_arcgis_link_table(tmp_path: Path) -> None:
    text = "link table\n10.5\t-20.25\t500100.5\t6270000.25\n30.5 -40.5 500200 6270100\n"
    points = read(tmp_path, text, "links.txt")
    assert points.image.tolist() == [[10.5, 20.25], [30.5, 40.5]]
    assert points.ground[:, :2].tolist() == [[500100.5, 6270000.25], [500200.0, 6270100.0]]
    assert np.isnan(points.ground[:, 2]).all()
    assert read(tmp_path, "Link table\na 1 -2 500100 6270000\n", "l.txt", pixel_origin="center").image.tolist() == [
        [1.5, 2.5]
    ]
    # The example of the vendor's own article counts upwards.
    with pytest.raises(InputError, match=r"line 2, from-y.*must be minus the row"):
        read(tmp_path, "link table\n00.00000 10.00000 247192.14926 4529042.15691\n", "l.txt")
    with pytest.raises(InputError, match="7 cells"):
        read(tmp_path, "link table\n1 -2 3 4 5 6 7\n", "l.txt")


@pytest.mark.parametrize("line", ["10.5 -20.25 500100 6270000", "1 10.5 20.25 500100 6270000 5", "1,2,3,4,5"])
def test_numbers_without_names_are_refused_with_the_line(tmp_path: Path, line: str) -> None:
    with pytest.raises(InputError, match="have no names") as caught:
        read(tmp_path, line + "\n", "points.txt")
    assert line in str(caught.value)
    assert "ID P L X Y Z" in str(caught.value.remedy)
    assert "link table" in str(caught.value.remedy)


ENVI = (
    "; ENVI Rigorous Orthorectification GCP File\n; FileName0=C:\\data\\one.TIF; FileName1=two.tif\n"
    "; projection info = {UTM, 35, South, WGS-84, units=Meters}\n; ImageFile#, Map (x,y,elev), Image (x,y)\n;\n"
    "0 500100.5 6270000.25 123.5 11.5 21.25\n1 500200 6270000 100 31 41\n"
)


def test_envi_with_heights_images_and_a_system(tmp_path: Path) -> None:
    path = write(tmp_path / "a.pts", ENVI)
    points = read_points(path, vertical="ellipsoid", image_name="one.tif")
    assert points.image.tolist() == [[10.5, 20.25]]
    assert points.ground.tolist() == [[500100.5, 6270000.25, 123.5]]
    assert points.crs.to_epsg() == 32735
    with pytest.raises(DatumError, match=r"points\.vertical"):
        read_points(path, image_name="one.tif")
    with pytest.raises(InputError, match="line 6: no comment FileName0"):
        read_points(write(tmp_path / "b.pts", ENVI.replace("FileName0", "File0")), vertical="ellipsoid")
    plain = "; projection info = {Geographic Lat/Lon, WGS-84, units=Degrees}\n; Map (x,y,elev), Image (x,y)\n"
    plain += "24.4 -33.6 5 2 3\n"
    points = read_points(write(tmp_path / "c.pts", plain), vertical="ellipsoid")
    assert (points.crs.to_epsg(), points.image.tolist()) == (4326, [[1.0, 2.0]])
    # Another datum than WGS84 is not guessed.
    with pytest.raises(CrsError, match=r"points\.crs"):
        read_points(write(tmp_path / "d.pts", plain.replace("WGS-84", "NAD27")), vertical="ellipsoid")


def test_erdas_files_are_refused_by_name(tmp_path: Path) -> None:
    for name, data in (("a.gcc", b"\0\1"), ("a.txt", b"EHFA_HEADER_TAG\0\0\0\0")):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match="IMAGINE") as caught:
            read_points(tmp_path / name)
        assert "export" in str(caught.value.remedy)


# -- one mark twice


def test_a_mark_that_was_measured_twice_is_told(tiny, tmp_path: Path) -> None:
    rows = tiny.points(8)
    id_, col, row, lon, lat, h = rows[3]
    # 2 mm to the north: another line, other coordinates, the same mark.
    twin = ("twin", col + 0.2, row - 0.1, lon, lat + 0.002 / 111_000, h)
    path = tiny.write(tmp_path / "p.csv", [*rows, twin])
    given = PointOptions(gcps=path, crs="EPSG:4979", vertical="ellipsoid")
    told = [text for text in commands.fit(tiny.image, given).warnings if "measured twice" in text]
    assert len(told) == 1
    assert f"{id_} and twin" in told[0]
    # A check point adds no redundancy, but its mark has been used.
    (text,) = [
        text
        for text in commands.fit(tiny.image, dataclasses.replace(given, check="ids:twin")).warnings
        if "measured twice" in text
    ]
    assert "tests nothing" in text
    # Metres apart they are two.
    far = tiny.write(tmp_path / "far.csv", [*rows, ("other", col + 0.5, row, lon, lat + 2.0 / 111_000, h)])
    found = commands.fit(tiny.image, dataclasses.replace(given, gcps=far)).warnings
    assert not [text for text in found if "measured twice" in text]


def test_one_mark_in_any_system_and_in_a_crowd(tmp_path: Path) -> None:
    lines = [f"p{k},{k},{k},{500000 + 100 * k},6270000,{'' if k % 2 else 5}" for k in range(6)]
    lines += ["near,9,8,500100.004,6270000.003,", "up,9,7,500200,6270000,5.2", "same,8,9,500400.001,6270000.001,5"]
    points = read(tmp_path, "id,col,row,x,y,h\n" + "\n".join(lines) + "\n")
    assert one_mark(points) == [("p1", "near"), ("p4", "same")]
    assert one_mark(points.to_crs("EPSG:4979")) == [("p1", "near"), ("p4", "same")]
    assert one_mark(points.select([0])) == []


def test_points_that_are_far_apart_are_no_mark_without_loading_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    """scipy.spatial and what it loads took a seventh of a second of every fit."""
    monkeypatch.setitem(sys.modules, "scipy.spatial", None)
    apart = Points.of(np.zeros((3, 2)), [[500_000, 0, 0], [500_000, 0.5, 0], [500_000, 700, 0]], "EPSG:32631")
    assert one_mark(apart) == []
    # Two that are near along one axis only, and two that are one.
    monkeypatch.undo()
    assert one_mark(Points.of(np.zeros((2, 2)), [[500_000, 0, 0], [500_000, 0, 0.009]], "EPSG:32631")) == [("1", "2")]


# -- hostile input


@pytest.mark.parametrize("stated", [5, [], {"properties": 5}, {"properties": {"name": {}}}, "x", {"properties": None}])
def test_any_crs_of_a_geojson_is_a_typed_error(tmp_path: Path, stated: object) -> None:
    document = {"type": "FeatureCollection", "crs": stated, "features": []}
    with pytest.raises(CrsError, match="not WGS84") as caught:
        read_points(write(tmp_path / "a.geojson", json.dumps(document)))
    assert caught.value.remedy


@pytest.mark.parametrize(
    "stated", ['{"a":' * 20_000, "[" * 20_000, "GEOGCS[" * 10_000, '{"type":"GeographicCRS","name":5}']
)
def test_a_nested_crs_is_a_typed_error(tmp_path: Path, stated: str) -> None:
    path = write(tmp_path / "a.csv", f"#CRS: {stated[:99_000]}\nid,col,row,x,y\na,1,2,24,-33\n")
    with pytest.raises(CrsError, match="not a coordinate system") as caught:
        read_points(path)
    assert len(str(caught.value)) < 600


def test_mutated_lists_are_read_or_refused_but_nothing_else(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    originals = {
        "a.gcp": ASP,
        "a.pts": ENVI,
        "a.txt": "link table\n1 -2 24.4 -33.6\nb 3 -4 24.5 -33.7\n",
        "a.csv": "Name;Pixel;Line;Lon;Lat;Elev;S\na;10,5;20;24,4;-33,6;100;G\n",
    }
    remedies: list[str | None] = []
    bits = [b",", b";", b"\t", b"\n", b"#CRS: EPSG:4978\n", b"nan", b"1e999", b"{", b'"', b"\xff"]
    for name, text in originals.items():
        for _ in range(60):
            data = bytearray(text.encode())
            for _ in range(rng.integers(1, 4)):
                at = int(rng.integers(len(data)))
                if rng.random() < 0.5:
                    data[at] = rng.integers(256)
                else:
                    data[at:at] = bits[rng.integers(len(bits))]
            (tmp_path / name).write_bytes(bytes(data))
            for reader in (read_points, read_block_points):
                try:
                    found = reader(tmp_path / name, crs="EPSG:4979", vertical="ellipsoid")
                except InputError as error:
                    remedies.append(error.remedy)
                    continue
                assert np.isfinite(found.image).all()
    assert len(remedies) > 100
    assert all(remedies)


def test_a_file_without_an_end_is_refused() -> None:
    with pytest.raises(InputError, match="a pipe or a device"):
        read_points("/dev/zero")


# -- many points


def test_memory_of_reading_many_points_is_bounded(tmp_path: Path) -> None:
    count = 5000
    lines = [f"{k},{k}.5,{k}.25,{500000 + k}.125,6270000,{k % 100}" for k in range(count)]
    path = write(tmp_path / "p.csv", "id,col,row,x,y,h\n" + "\n".join(lines) + "\n")
    read_points(path, crs="EPSG:32735", vertical="ellipsoid")
    tracemalloc.start()
    try:
        read_points(path, crs="EPSG:32735", vertical="ellipsoid")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # As much as a file may hold is set aside for its bytes.
    assert peak < MAX_FILE + 2000 * count


def test_a_tie_point_of_geojson_needs_no_place(tmp_path):
    """RFC 7946: the geometry of what is not located is null. 'ji' counts from the centre of the first pixel."""
    path = tmp_path / "block.geojson"
    located = {"type": "Point", "coordinates": [33.35, 37.25, 850.0]}
    marks = {"a.tif": [1, 2], "b.tif": [3, 4]}
    features = [
        {"type": "Feature", "geometry": place, "properties": {"id": name, "role": role, "ji": marks}}
        for name, role, place in (("c", "control", located), ("t", "tie", None))
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    rows = read_block_table(path).rows
    assert [(row.id, row.role, row.image_name, row.image) for row in rows] == [
        ("c", "control", "a.tif", (1.5, 2.5)), ("c", "control", "b.tif", (3.5, 4.5)),
        ("t", "tie", "a.tif", (1.5, 2.5)), ("t", "tie", "b.tif", (3.5, 4.5)),
    ]  # fmt: skip
    assert rows[0].ground == rows[1].ground == (33.35, 37.25, 850.0)
    assert np.isnan([rows[2].ground, rows[3].ground]).all()
