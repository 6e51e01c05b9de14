"""Ground of point files: places on Earth, the CRS that counts, heights above a geoid."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest

from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.errors import CrsError, DatumError, InputError
from ortho_pipeline.geodesy.crs import Vertical
from ortho_pipeline.points import Points, one_mark, read_points, write_points
from ortho_pipeline.points.rows import PointRow, is_writable


def read(tmp_path: Path, rows: str, crs: str | None = None, vertical: str | None = None, first: str = "") -> Points:
    path = tmp_path / "p.csv"
    path.write_text(f"{first}id,col,row,x,y,h\n{rows}\n")
    return read_points(path, crs=crs, vertical=vertical)


@pytest.mark.parametrize(
    ("crs", "x", "y", "on_earth"),
    [
        ("EPSG:4326", 0.0, 90.0, True), ("EPSG:4326", 0.0, -90.0, True), ("EPSG:4326", 0.0, 90.001, False),
        ("EPSG:4326", 0.0, -90.001, False), ("EPSG:4326", 360.0, 1.0, True), ("EPSG:4326", -360.001, 1.0, False),
        # In grads a quarter of the circle has 100.
        ("EPSG:4807", 2.0, 99.9, True), ("EPSG:4807", 2.0, 100.1, False), ("EPSG:4807", 399.0, 50.0, True),
        ("EPSG:4807", 401.0, 50.0, False),
    ],
)  # fmt: skip
def test_longitude_and_latitude_are_on_earth_in_the_unit_of_the_crs(
    tmp_path: Path, crs: str, x: float, y: float, on_earth: bool
) -> None:
    if on_earth:
        assert read(tmp_path, f"a,1,2,{x},{y},", crs).ground[0, :2].tolist() == [x, y]
    else:
        with pytest.raises(InputError, match="not on Earth"):
            read(tmp_path, f"a,1,2,{x},{y},", crs)


@pytest.mark.parametrize(("h", "on_earth"), [(19_900, True), (-19_900, True), (20_100, False), (-20_100, False)])
def test_geocentric_points_are_within_twenty_kilometres_of_the_ellipsoid(
    tmp_path: Path, h: float, on_earth: bool
) -> None:
    """On the equator at longitude 0 the height is X minus the semi-major axis."""
    row = f"a,1,2,{6378137.0 + h!r},0,0"
    if on_earth:
        np.testing.assert_allclose(read(tmp_path, row, "EPSG:4978").ground, [[0.0, 0.0, h]], atol=1e-6)
    else:
        with pytest.raises(InputError, match="not on Earth"):
            read(tmp_path, row, "EPSG:4978")


@pytest.mark.parametrize(("stated", "option"), [("EPSG:32735", "EPSG:32735+5773"), ("EPSG:32735+5773", "EPSG:32735")])
def test_the_crs_with_a_height_datum_counts(tmp_path: Path, stated: str, option: str) -> None:
    row = "a,1,2,444000,6275000,100"
    by_both = read(tmp_path, row, option, first=f"#CRS: {stated}\n").ground
    np.testing.assert_array_equal(by_both, read(tmp_path, row, "EPSG:32735+5773").ground)
    assert abs(by_both[0, 2] - 100) > 20
    with pytest.raises(CrsError, match="the file states"):
        read(tmp_path, row, "EPSG:32736", first=f"#CRS: {stated}\n")


def test_two_statements_of_one_datum_agree(tmp_path: Path) -> None:
    row, first = "a,1,2,444000,6275000,100", "#CRS: EPSG:32735\n#vertical: egm96\n"
    assert read(tmp_path, row, vertical="egm96", first=first).ground[0, 2] > 120
    with pytest.raises(DatumError, match="the file states"):
        read(tmp_path, row, vertical="ellipsoid", first=first)
    with pytest.raises(DatumError, match="the file states"):
        read(tmp_path, row, "EPSG:32735+3855", first=first)


def test_a_point_without_a_height_gets_none_and_the_others_their_undulation(tmp_path: Path) -> None:
    rows = "a,1,2,24.4,-33.65,100\nb,3,4,24.5,-33.65,\nc,5,6,151.2,-33.65,100"
    found = read(tmp_path, rows, "EPSG:4326", "egm96").ground[:, 2]
    undulation = Vertical.parse("egm96").undulation([24.4, 151.2], [-33.65, -33.65])
    np.testing.assert_allclose(found[[0, 2]], 100 + undulation)
    assert math.isnan(found[1])
    # Nothing has to be known of heights that are not there.
    assert np.isnan(read(tmp_path, "a,1,2,24.4,-33.65,", "EPSG:4326").ground[0, 2])


def test_a_point_with_a_height_beyond_the_geoid_is_named(tmp_path: Path) -> None:
    """The grid is from 33 to 34 degrees east and from 30 to 31 degrees north; its undulation is 20 m."""
    geoid = tmp_path / "geoid.gtx"
    geoid.write_bytes(struct.pack(">ddddii4f", 30.0, 33.0, 1.0, 1.0, 2, 2, *[20.0] * 4))
    rows = "a,1,2,33.5,30.5,100\nb,3,4,36.0,30.5,{}\nc,5,6,33.6,30.4,300"
    for height, found in (("200", None), ("", [120.0, np.nan, 320.0])):
        if found is None:
            with pytest.raises(DatumError, match="does not cover this point") as caught:
                read(tmp_path, rows.format(height), "EPSG:4326", str(geoid))
            assert (caught.value.file, caught.value.field) == (str(tmp_path / "p.csv"), "line 3")
        else:
            np.testing.assert_allclose(read(tmp_path, rows.format(height), "EPSG:4326", str(geoid)).ground[:, 2], found)


@pytest.mark.parametrize("stated", ["OGC:CRS84", "EPSG:4979", "EPSG:4326"])
def test_one_system_may_have_its_axes_in_another_order(tmp_path: Path, stated: str) -> None:
    found = read(tmp_path, "a,1,2,24.4,-33.65,", "EPSG:4326", first=f"#CRS: {stated}\n")
    assert found.ground[0, :2].tolist() == [24.4, -33.65]


def test_every_column_that_a_ray_needs_is_filled(tmp_path: Path) -> None:
    path = tmp_path / "b.csv"
    for line, field in ((",a.tif,1,2", "id"), ("a,,1,2", "image"), ("a,a.tif,,2", "col"), ("a,a.tif,1,", "row")):
        path.write_text(f"id,image,col,row\np,a.tif,5,6\np,b.tif,5,6\n{line}\n")
        with pytest.raises(InputError) as caught:
            read_block_points(path)
        assert caught.value.field == f"line 4, column {field}"


def test_a_last_column_without_a_name_is_empty(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("id,col,row,x,y,\na,1,2,24,-33,\n")
    assert len(read_points(path, crs="EPSG:4326")) == 1
    path.write_text("id,col,row,x,y,\na,1,2,24,-33,\nb,3,4,24.1,-33,7\n")
    with pytest.raises(InputError, match="line 3"):
        read_points(path, crs="EPSG:4326")


def test_words_of_spreadsheets_for_people_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("id,col,row,x,y,Remarks,CODE\na,1,2,24,-33,good,x\n")
    assert read_points(path, crs="EPSG:4326").ground[0, :2].tolist() == [24.0, -33.0]


@pytest.mark.parametrize("text", ["a\0b", "\ud800", "a\udfffb"])
def test_an_id_that_no_file_can_hold_is_refused(tmp_path: Path, text: str) -> None:
    assert not is_writable(text)
    with pytest.raises(InputError):
        PointRow("line 1", text, (1.0, 2.0), (3.0, 4.0, 5.0))
    with pytest.raises(InputError, match="would be different"):
        write_points(Points.of([[1, 2]], [[24, -33, 1]], "EPSG:4979", ids=[text]), tmp_path / "a.csv")
    assert is_writable("größe \U0001f600")


@pytest.mark.parametrize(("apart", "pairs"), [(0.0095, [("1", "2")]), (0.0105, [])])
def test_one_mark_ends_at_a_centimetre(apart: float, pairs: list[tuple[str, str]]) -> None:
    ground = [[500_000.0, 6_000_000.0, 5.0], [500_000.0, 6_000_000.0, 5.0 + apart], [500_900.0, 6_000_000.0, 5.0]]
    assert one_mark(Points.of(np.zeros((3, 2)), ground, "EPSG:32634")) == pairs


def test_a_written_sigma_in_plan_is_the_larger_one(tmp_path: Path) -> None:
    points = Points.of([[1, 2]], [[24, -33, 1]], "EPSG:4979", sigma_ground=[[0.1, 0.3, 0.2]])
    for name in ("a.csv", "a.geojson"):
        write_points(points, tmp_path / name)
        assert read_points(tmp_path / name).sigma_ground.tolist() == [[0.3, 0.3, 0.2]]
