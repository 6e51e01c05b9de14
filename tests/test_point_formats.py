"""Point files as the field writes them: headers of surveyors, decimal commas, lists of other programs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.points import Points, read_points


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
        ("Name,i,j,Easting,Northing\na,1,2,3,4\n", "'i' is not known"),
        ("Name,Pixel,Line,Easting,Northing,Elev (ft)\na,1,2,3,4,5\n", r"'Elev \(ft\)' is not known"),
        ("Name,Easting,Northing,Elev\na,1,2,3\n", "no column col, row"),
        ("Name,,Pixel,Line,Easting,Northing\na,b,1,2,3,4\n", "'' is not known"),
        ("A1,10.5,20.25,500100.5,6270000.25,123.5\n", "is not known"),
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
        ("a;10,5;20.25;500100;6270000;1", "commas and points"),
        ("a;10,5;20;500.100,5;6270000;1", "commas and points"),
        ("a;10,5;20;500,100,5;6270000;1", "not a number"),
        ("a;1,2,3;20;500100;6270000;1", "not a number"),
        ("a;10,;20;500100;6270000;x", "line 2, column Elev"),
        ("a;10,5;20;500100;6270000", "5 cells under 6"),
    ],
)
def test_numbers_that_are_unclear(tmp_path: Path, row: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        read(tmp_path, f"Name;Pixel;Line;Easting;Northing;Elev\n{row}\n")


def test_marks_are_those_of_the_whole_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"line 3, column Line.*commas and points"):
        read(tmp_path, "Name;Pixel;Line;Easting;Northing\na;10,5;20;500100;6270000\nb;1;2.5;500200;6270000\n")
    assert read(tmp_path, "Name;Pixel;Line;x;y\na;1,5e1;2;500100;6270000\n").image[0, 0] == 15.0


def test_names_of_the_ground_and_its_crs_agree(tmp_path: Path) -> None:
    with pytest.raises(CrsError, match="longitude"):
        read(tmp_path, "Name,Pixel,Line,Lat,Lon\na,1,2,-33,24\n", crs="EPSG:32735")
    with pytest.raises(CrsError, match="easting"):
        read(tmp_path, "Name,Pixel,Line,Easting,Northing\na,1,2,24,-33\n", crs="EPSG:4326")
    assert np.isnan(read(tmp_path, "Name,Pixel,Line,X,Y\na,1,2,24,-33\n", crs="EPSG:4326").ground[0, 2])
