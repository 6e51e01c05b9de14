"""Tables of blocks from files and from tables of images: each value is that of its point, and statements agree."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pyproj
import pytest

from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points

HEADER = "id,image,col,row,x,y,h,role,sigma_image,sigma_xy,sigma_h"
RAYS = [
    "a,two.tif,11.5,12.25,31.1,37.2,105,control,0.3,0.7,1.5",
    "b,two.tif,21.5,22.25,31.3,37.4,205,check,0.4,,2.5",
    "c,two.tif,31.5,32.25,,,,,0.6,,",
    "a,one.tif,41.5,42.25,,,,,0.8,,",
    "d,one.tif,51.5,52.25,31.5,37.6,,,,0.9,",
    "c,one.tif,61.5,62.25,,,,tie,0.2,,",
]


def write(path: Path, rows: list[str], header: str = HEADER, crs: str = "EPSG:4326") -> Path:
    path.write_text("\n".join([f"#CRS: {crs}", "#vertical: ellipsoid", header, *rows]) + "\n")
    return path


def test_every_value_of_a_file_is_that_of_its_point_or_ray(tmp_path: Path) -> None:
    found = read_block_points(write(tmp_path / "p.csv", RAYS), pixel_origin="center")
    assert (found.ids, found.images) == (("a", "b", "c", "d"), ("two.tif", "one.tif"))
    assert found.point.tolist() == [0, 1, 2, 0, 3, 2]
    assert found.image.tolist() == [0, 0, 0, 1, 1, 1]
    assert found.measured.tolist() == [[k + 2.0, k + 2.75] for k in (10, 20, 30, 40, 50, 60)]
    assert found.sigma_image.tolist() == [0.3, 0.4, 0.6, 0.8, 0.5, 0.2]
    assert found.roles.tolist() == ["control", "check", "tie", "control"]
    np.testing.assert_array_equal(
        found.ground, [[31.1, 37.2, 105.0], [31.3, 37.4, 205.0], [math.nan] * 3, [31.5, 37.6, math.nan]]
    )
    assert found.sigma_ground.tolist() == [[0.7, 0.7, 1.5], [0.0, 0.0, 2.5], [0.0, 0.0, 0.0], [0.9, 0.9, 0.0]]
    assert found.sigma_common.tolist() == [0.0] * 4


def test_ground_of_a_file_of_its_own_is_brought_to_the_system_of_the_rays(tmp_path: Path) -> None:
    to_map = pyproj.Transformer.from_crs(4326, 32636, always_xy=True)
    east, north = to_map.transform(31.7, 37.8)
    known = write(tmp_path / "g.csv", [f"z,1,{north - 5e3},7,,", f"c,{east},{north},305,0.25,0.5"],
                  "id,x,y,h,sigma_xy,sigma_h", "EPSG:32636")  # fmt: skip
    found = read_block_points(write(tmp_path / "p.csv", RAYS[:5]), gcps=known)
    assert found.ids == ("a", "b", "c", "d"), "what no image shows is left out"
    np.testing.assert_allclose(found.ground[2], [31.7, 37.8, 305.0], rtol=0, atol=1e-9)
    assert (found.roles[2], found.sigma_ground[2].tolist()) == ("control", [0.25, 0.25, 0.5])
    assert found.crs.to_epsg() == 4326
    # Where rays have no ground, the system is that of the other file.
    without = write(tmp_path / "r.csv", [RAYS[2], "c,one.tif,1,2,,,,,,,", "e,one.tif,3,4,,,,,,,"])
    found = read_block_points(without, gcps=known)
    assert (found.crs.to_epsg(), found.roles.tolist()) == (32636, ["control", "tie"])
    np.testing.assert_allclose(found.ground[0], [east, north, 305.0])
    assert read_block_points(without).crs.to_epsg() == 4326
    alone = write(tmp_path / "n.csv", ["y,1,2,3,,"], "id,x,y,h,sigma_xy,sigma_h")
    with pytest.raises(InputError, match="no image shows any of these points"):
        read_block_points(without, gcps=alone)
    twice = write(tmp_path / "t.csv", ["c,1,2,3,,", "c,1,2,3,,"], "id,x,y,h,sigma_xy,sigma_h")
    with pytest.raises(InputError, match=r"the id 'c' stands twice, first in line 4"):
        read_block_points(without, gcps=twice)


@pytest.mark.parametrize(
    ("row", "what"),
    [
        ("a,one.tif,1,2,31.1,37.2,105,,,,", None),
        ("a,one.tif,1,2,31.1000000009,37.2,105,,,,", None),
        ("a,one.tif,1,2,31.0999999991,37.2,105,,,,", None),
        ("a,one.tif,1,2,31.1000000012,37.2,105,,,,", "x of the point 'a' is 31.1000000012 here and 31.1 in"),
        ("a,one.tif,1,2,31.0999999988,37.2,105,,,,", "x of the point 'a'"),
        ("a,one.tif,1,2,31.1,37.2,104,,,,", "h of the point 'a' is 104.0 here and 105.0 in"),
        ("a,one.tif,1,2,31.1,37.2,105,check,,,", "role of the point 'a' is check here and control in"),
        ("a,one.tif,1,2,31.1,37.2,105,control,,0.8,", "sigma_xy of the point 'a'"),
        ("a,one.tif,1,2,,,,,,,1.4", "sigma_h of the point 'a'"),
        ("f,one.tif,1,2,31.1,37.2,105,,,,", "the points 'a' and 'f' have the same ground"),
        ("f,one.tif,1,2,31.1,37.2,106,,,,", None),
        ("b,two.tif,11.5,12.25,,,,,,,", "the same pixel of the same image as in line 4, but of 'a' there"),
        ("b,one.tif,11.5,12.25,,,,,,,", None),
        ("b,one.tif,1,2,31.3,,,,,,", "x, y or both are missing"),
        ("b,one.tif,1,2,,37.4,,,,,", "x, y or both are missing"),
        ("b,one.tif,1,2,,,205,,,,", "x, y or both are missing"),
    ],
)
def test_one_point_has_one_ground_one_role_and_one_accuracy(tmp_path: Path, row: str, what: str | None) -> None:
    """To a billionth of a degree or a metre; what is not stated contradicts nothing."""
    path = write(tmp_path / "p.csv", [*RAYS[:3], row])
    if what is None:
        assert read_block_points(path).rays == 4
        return
    with pytest.raises(InputError) as no:
        read_block_points(path)
    assert what in str(no.value)
    assert "line 7" in str(no.value) or "same ground" in what


def test_marks_without_a_label_are_one_by_their_ground(tmp_path: Path) -> None:
    path = tmp_path / "gcp_list.txt"
    path.write_text(
        "EPSG:4979\n31.1 37.2 105 1.5 2.5 one.tif\n31.3 37.4 205 3.5 4.5 one.tif\n31.1 37.2 105 5.5 6.5 two.tif\n"
        "31.3 37.4 205 7.5 8.5 two.tif north\n31.1 37.2 106 9.5 10.5 two.tif\n"
    )
    with pytest.raises(InputError, match="'point 2' and 'north' have the same ground"):
        read_block_points(path)
    path.write_text(path.read_text().replace(" north", ""))
    found = read_block_points(path)
    assert found.ids == ("point 1", "point 2", "point 3")
    assert found.point.tolist() == [0, 1, 0, 1, 2]
    assert found.ground.tolist() == [[31.1, 37.2, 105.0], [31.3, 37.4, 205.0], [31.1, 37.2, 106.0]]
    assert found.roles.tolist() == ["control"] * 3


# -- tables of images --------------------------------------------------------------------------------------------------


def test_tables_of_images_are_joined_value_by_value() -> None:
    ground = np.array([[500_000.0, 5e6, 10.0], [500_100.0, 5e6, 20.0], [500_200.0, 5e6, 30.0]])
    spread = np.array([[[0.5, 0.3], [0.3, 0.4]], [[0.04, 0.0], [0.0, 0.04]]])
    first = Points(
        ids=("p", "q"), image=np.array([[1.0, 2.0], [3.0, 4.0]]), ground=ground[:2],
        roles=np.array(["control", "check"]),
        sigma_image=np.sqrt(np.trace(spread, axis1=1, axis2=2) / 2), sigma_ground=np.array([[1.0, 2, 3], [4, 5, 6]]),
        crs=pyproj.CRS(32633), source="a.csv", covariance_image=spread, sigma_common=np.array([0.0, 7.0]),
        groups=np.array([0, -1]),
    )  # fmt: skip
    second = Points(
        ids=("r", "q"), image=np.array([[5.0, 6.0], [7.0, 8.0]]), ground=ground[[2, 1]],
        roles=np.array(["control", "check"]), sigma_image=np.array([0.8, 0.9]),
        sigma_ground=np.array([[7.0, 8, 9], [4, 5, 6]]), crs=pyproj.CRS(32633), source="b.csv",
        sigma_common=np.array([0.5, 7.0]),
    )  # fmt: skip
    found = BlockPoints.of({"one.tif": first, "two.tif": second})
    assert (found.ids, found.images, found.source) == (("p", "q", "r"), ("one.tif", "two.tif"), "a.csv, b.csv")
    assert (found.point.tolist(), found.image.tolist()) == ([0, 1, 2, 1], [0, 0, 1, 1])
    np.testing.assert_array_equal(found.ground, ground)
    assert found.roles.tolist() == ["control", "check", "control"]
    assert found.sigma_ground.tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    assert found.sigma_common.tolist() == [0.0, 7.0, 0.5]
    assert found.measured.tolist() == [[1, 2], [3, 4], [5, 6], [7, 8]]
    assert found.grouped.tolist() == [0, -1, -1, -1]
    wanted = [*spread, 0.64 * np.eye(2), 0.81 * np.eye(2)]
    np.testing.assert_allclose(found.covariance_image, wanted)
    np.testing.assert_allclose(found.in_image("one.tif").covariance_image, spread)
    # Partials of several parameters are made independent and brought back like misfits.
    partials = np.random.default_rng(2).normal(size=(4, 2, 5))
    rays = np.array([3, 0, 2, 1])
    white = found.whitened(partials / found.sigma_image[rays][:, None, None], rays)
    np.testing.assert_allclose(found.in_pixels(white, rays), partials)
    for k, ray in enumerate(rays):
        np.testing.assert_allclose(
            white[k].T @ white[k], partials[k].T @ np.linalg.solve(found.covariance_image[ray], partials[k]), rtol=1e-9
        )
    with pytest.raises(InputError, match="no images with points"):
        BlockPoints.of({})


@pytest.mark.parametrize(("apart", "same"), [(0.9e-8, True), (-0.9e-8, True), (1.1e-8, False), (-1.1e-8, False)])
def test_two_tables_agree_in_a_place_to_a_millimetre(apart: float, same: bool) -> None:
    tables = {name: Points.of([[1.0, 2.0]], [[0.25 + by, 0.5, math.nan]], "EPSG:4979") for name, by in
              (("a", 0.0), ("b", apart))}  # fmt: skip
    if same:
        assert BlockPoints.of(tables).point.tolist() == [0, 0]
        return
    with pytest.raises(InputError, match="the ground of the point '1' differs in the image 'b'"):
        BlockPoints.of(tables)


def test_tables_of_two_zones_state_one_place() -> None:
    """Coordinates of a map have seven digits before the point, so their transformation cannot agree to a billionth."""
    east = np.array([[500_000.0, 4_100_000.0, 10.0], [500_333.3, 4_100_777.7, 20.0]])
    west = np.column_stack([*pyproj.Transformer.from_crs(32636, 32635).transform(*east[:, :2].T), east[:, 2]])
    image = [[1.0, 2.0], [3.0, 4.0]]
    found = BlockPoints.of({"a": Points.of(image, east, "EPSG:32636"), "b": Points.of(image, west, "EPSG:32635")})
    np.testing.assert_array_equal(found.ground, east)
    west[1, 2] += 1.1e-3
    with pytest.raises(InputError, match="the ground of the point '2' differs in the image 'b'"):
        BlockPoints.of({"a": Points.of(image, east, "EPSG:32636"), "b": Points.of(image, west, "EPSG:32635")})


def test_one_table_may_leave_out_the_accuracy_that_another_states() -> None:
    """The order of the tables decided before whether it counted."""
    image, ground = [[1.0, 2.0], [3.0, 4.0]], [[0.2, 0.5, 1.0], [0.3, 0.6, 2.0]]
    stated = Points.of(image, ground, "EPSG:4979", sigma_ground=[[0.1, 0.1, 0.3]] * 2)
    stated = dataclasses.replace(stated, sigma_common=np.array([0.0, 0.7]))
    tables = {"a": Points.of(image, ground, "EPSG:4979"), "b": stated}
    for names in ("ab", "ba"):
        found = BlockPoints.of({name: tables[name] for name in names})
        assert found.sigma_ground.tolist() == [[0.1, 0.1, 0.3]] * 2
        assert found.sigma_common.tolist() == [0.0, 0.7]
    other = Points.of(image, ground, "EPSG:4979", sigma_ground=[[0.1, 0.1, 0.3], [0.1, 0.1, 0.2]])
    with pytest.raises(InputError, match="the accuracy of the point '2' differs in the image 'b'"):
        BlockPoints.of({"a": other, "b": stated})


def test_the_point_that_was_measured_twice_and_its_image_are_named() -> None:
    ties = np.full((3, 3), math.nan)
    for point, image in ((0, 2), (1, 0), (2, 1)):
        rays = np.array([[k, i] for k in range(3) for i in range(3)] + [[point, image]])
        with pytest.raises(InputError, match=f"'{'abc'[point]}' was measured twice in the image 'i{image}'"):
            BlockPoints(
                ids=("a", "b", "c"), ground=ties, roles=np.array(["tie"] * 3), sigma_ground=np.zeros((3, 3)),
                crs=pyproj.CRS(4326), images=("i0", "i1", "i2"), point=rays[:, 0], image=rays[:, 1],
                measured=np.arange(20.0).reshape(10, 2), sigma_image=np.ones(10),
            )  # fmt: skip
