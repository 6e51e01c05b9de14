"""Values of a table of points: what tests a result, what a dataset's points are called, where a file is damaged."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points, gcps_of_dataset, read_points, write_points


def points() -> Points:
    """Return five points whose values are all different."""
    made = Points.of(
        [[1.0, 9.0], [2.0, 8.0], [3.0, 7.0], [4.0, 6.0], [5.0, 5.0]],
        [[24.0, -33.0, 10.0], [24.1, -33.2, 20.0], [24.2, -33.4, 30.0], [24.3, -33.6, 40.0], [24.4, -33.8, math.nan]],
        "EPSG:4326", roles=["control", "check", "check", "tie", "check"], sigma_image=[0.1, 0.2, 0.3, 0.4, 0.5],
        sigma_ground=[[1.0, 2.0, 3.0]] * 5,
    )  # fmt: skip
    return replace(
        made, groups=np.array([-1, 4, -1, -1, 0]), sigma_common=np.arange(5) / 10, sigma_alike=np.arange(5) / 100
    )


def test_measured_check_points_test_a_result_and_matches_if_there_are_no_others() -> None:
    some = points()
    assert some.tests.tolist() == [False, False, True, False, False]
    matches = replace(some, groups=np.array([-1, 4, 1, -1, 0]))
    assert matches.tests.tolist() == [False, True, True, False, True]
    assert not some.with_roles(["control"] * 5).tests.any()


def test_a_point_of_a_table_has_its_own_values() -> None:
    some = list(points())
    third = some[2]
    assert (third.id, third.image, third.ground, third.role) == ("3", (3.0, 7.0), (24.2, -33.4, 30.0), "check")
    assert (third.sigma_image, third.sigma_ground) == (0.3, (1.0, 2.0, 3.0))
    assert third.covariance_image == ((0.09, 0.0), (0.0, 0.09))
    assert (third.group, third.sigma_common, third.sigma_alike) == (-1, 0.2, 0.02)
    assert [one.group for one in some] == [-1, 4, -1, -1, 0]
    for chosen in (points().select([4, 1]), points().select(np.array([False, True, False, False, True]))):
        assert sorted(one.sigma_common for one in chosen) == [0.1, 0.4]
        assert sorted(one.sigma_alike for one in chosen) == [0.01, 0.04]


def test_a_point_of_which_nothing_more_is_stated_is_control_on_exact_ground(tmp_path: Path) -> None:
    (tmp_path / "p.csv").write_text("id,col,row,x,y,h\n1,3,7,24,-33,10\n")
    for found in (
        read_points(tmp_path / "p.csv", crs="EPSG:4979"), Points.of([[3.0, 7.0]], [[24.0, -33.0, 10.0]], "EPSG:4979")
    ):  # fmt: skip
        (one,) = found
        assert (one.id, one.role, one.sigma_image, one.sigma_ground) == ("1", "control", 0.5, (0.0, 0.0, 0.0))
        assert (one.group, one.sigma_common, one.sigma_alike) == (-1, 0.0, 0.0)


def test_a_point_without_a_height_has_no_geocentric_place() -> None:
    found = points().to_crs("EPSG:4978").ground
    assert np.isnan(found[4]).all()
    expected = pyproj.Transformer.from_crs(4979, 4978, always_xy=True).transform(24.1, -33.2, 20.0)
    np.testing.assert_allclose(found[1], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("sigmas", "expected"),
    [
        (0.2, np.full((4, 3), 0.2)),
        ([1.0, 2.0, 3.0, 4.0], np.repeat([[1.0], [2.0], [3.0], [4.0]], 3, axis=1)),
        ([[1.0], [2.0], [3.0], [4.0]], np.repeat([[1.0], [2.0], [3.0], [4.0]], 3, axis=1)),
        ([1.0, 2.0, 3.0], np.tile([1.0, 2.0, 3.0], (4, 1))),
        (np.arange(12.0).reshape(4, 3), np.arange(12.0).reshape(4, 3)),
    ],
)  # fmt: skip
def test_sigmas_of_the_ground_are_those_of_all_points_of_each_or_of_each_axis(sigmas: Any, expected: Any) -> None:
    ground = np.column_stack([24 + np.arange(4) / 10, np.full(4, -33.0), np.zeros(4)])
    found = Points.of(np.arange(8.0).reshape(4, 2), ground, "EPSG:4979", sigma_ground=sigmas)
    np.testing.assert_array_equal(found.sigma_ground, expected)
    for wrong in ([1.0, 2.0], [1.0] * 5):
        with pytest.raises(InputError, match="sigma_ground has the shape") as caught:
            Points.of(found.image, ground, "EPSG:4979", sigma_ground=wrong)
        assert "the shape (4,) or (4, 3)" in str(caught.value.remedy)


def test_three_sigmas_for_three_points_are_refused_unless_equal_or_of_a_clear_shape() -> None:
    image, ground = np.arange(6.0).reshape(3, 2), [[24.0, -33.0, 0.0], [24.1, -33.0, 0.0], [24.2, -33.0, 0.0]]
    with pytest.raises(InputError, match="three values for three points"):
        Points.of(image, ground, "EPSG:4979", sigma_ground=[1.0, 2.0, 3.0])
    for clear in ([1.0, 1.0, 1.0], [[1.0], [2.0], [3.0]], [[1.0, 2.0, 3.0]]):
        found = Points.of(image, ground, "EPSG:4979", sigma_ground=clear).sigma_ground
        np.testing.assert_array_equal(found, np.broadcast_to(clear, (3, 3)))


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (("b", "a"), ("b", "a")), (("b", "b"), ("1", "2")), (("", "a"), ("1", "2")), ((" b  c ", "a"), ("b c", "a")),
        ((" ", "a"), ("1", "2")),
    ],
)  # fmt: skip
def test_points_of_a_dataset_keep_their_names_if_all_have_one(names: tuple[str, str], ids: tuple[str, str]) -> None:
    gcps = [
        SimpleNamespace(GCPPixel=1.5 + k, GCPLine=5.0 - k, GCPX=24.0 + k, GCPY=-33.0, GCPZ=k * 7.0, Id=name)
        for k, name in enumerate(names)
    ]
    dataset: Any = SimpleNamespace(
        GetDescription=lambda: "a.tif", GetGCPs=lambda: gcps, GetGCPProjection=lambda: pyproj.CRS(4326).to_wkt()
    )
    found = gcps_of_dataset(dataset, vertical="ellipsoid")
    assert found.ids == ids
    np.testing.assert_array_equal(found.image, [[1.5, 5.0], [2.5, 4.0]])
    # A height of zero is one if another point has a height.
    np.testing.assert_array_equal(found.ground, [[24, -33, 0], [25, -33, 7]])
    assert found.sigma_image.tolist() == [0.5, 0.5]
    for field, value, said in (
        ("GCPX", math.inf, "not finite"), ("GCPLine", math.nan, "not finite"), ("GCPX", 25.0, None),
        ("GCPPixel", 1.5, None),
    ):  # fmt: skip
        before = getattr(gcps[1], field)
        setattr(gcps[1], field, value)
        if said is None:
            assert len(gcps_of_dataset(dataset, vertical="ellipsoid")) == 2
        else:
            with pytest.raises(InputError, match=said):
                gcps_of_dataset(dataset, vertical="ellipsoid")
        setattr(gcps[1], field, before)
    gcps[1].GCPPixel, gcps[1].GCPLine = 1.5, 5.0
    with pytest.raises(InputError, match="the same image coordinates as in GCP 1"):
        gcps_of_dataset(dataset, vertical="ellipsoid")


HEADER = "id,col,row,x,y,h,image\n"


def test_a_point_of_a_piece_is_moved_after_its_origin_is(tmp_path: Path) -> None:
    """The piece begins at column 10, row 20 and has pixels four times as wide."""
    path = tmp_path / "p.csv"
    path.write_text(f"{HEADER}a,3,5,24,-33,1,one.tif\nb,3,5,24.1,-33,1,two.tif\n")
    for origin, shift in (("corner", 0.0), ("center", 0.5), ("corner-1", -1.0), ("center-1", -0.5)):
        found = read_points(
            path, crs="EPSG:4979", pixel_origin=origin, image_name="one.tif", pieces={"two.tif": (10.0, 20.0, 4.0)}
        )
        expected = [[3 + shift, 5 + shift], [10 + 4 * (3 + shift), 20 + 4 * (5 + shift)]]
        np.testing.assert_allclose(found.image, expected)
        assert found.sigma_image.tolist() == [0.5, 2.0]


@pytest.mark.parametrize(
    ("data", "line"),
    [(b"a\nb\nc\0d\n", 3), (b"\0", 1), (b"a\n\xff\n", 2), (b"a\nb\n\nc\xe4 d\n", 4)],
)  # fmt: skip
def test_what_is_no_text_is_named_with_its_line(tmp_path: Path, data: bytes, line: int) -> None:
    path = tmp_path / "p.csv"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_points(path, crs="EPSG:4979")
    assert caught.value.field == f"line {line}"


def test_columns_of_errors_have_cells_only_for_points_with_such_errors(tmp_path: Path) -> None:
    covariance = points().covariance_image.copy()
    covariance[3] = [[0.5, -0.125], [-0.125, 0.25]]
    some = points().with_covariance_image(covariance)
    write_points(some, tmp_path / "p.csv")
    rows = [line.split(",") for line in (tmp_path / "p.csv").read_text().splitlines()[2:]]
    assert rows[0][-6:] == ["var_col", "var_row", "cov_col_row", "group", "sigma_common", "sigma_alike"]
    assert [row[-6:] for row in rows[1:]] == [
        ["", "", "", "", "", ""], ["", "", "", "4", "0.1", "0.01"], ["", "", "", "", "0.2", "0.02"],
        ["0.5", "0.25", "-0.125", "", "0.3", "0.03"], ["", "", "", "0", "0.4", "0.04"],
    ]  # fmt: skip
    # One column has both horizontal standard deviations: the larger one.
    assert [row[8:10] for row in rows[1:]] == [["2.0", "3.0"]] * 5
    assert [row[5] for row in rows[1:]] == ["10.0", "20.0", "30.0", "40.0", ""]


@pytest.mark.parametrize("name", ["sigma_image", "sigma_ground"])
@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_a_standard_deviation_is_a_finite_number(name: str, value: float) -> None:
    """A negative one passed as exact, and an infinite one was blamed on the place of the points."""
    with pytest.raises(InputError, match="negative or not finite") as caught:
        Points.of([[1.0, 2.0]], [[0.1, 0.2, 3.0]], "EPSG:4979", **{name: value})
    assert caught.value.field == name
