"""Points whose errors differ with the direction, or are shared with those of neighbours: table and files."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ortho_pipeline.block.point_files import read_block_points
from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points, read_points, write_points


def made(count: int = 6, seed: int = 0) -> Points:
    """Return points of which some have a covariance with a direction, and some a group."""
    random = np.random.default_rng(seed)
    plain = Points(
        ids=tuple(f"p{k}" for k in range(count)),
        image=random.uniform(0, 1000, (count, 2)),
        ground=np.column_stack([random.uniform(20, 30, (count, 2)), random.uniform(0, 900, count)]),
        roles=np.full(count, "control"),
        sigma_image=random.uniform(0.1, 2, count),
        sigma_ground=np.zeros((count, 3)),
        crs=pyproj.CRS(4326),
        source="made",
    )
    covariance = plain.covariance_image.copy()
    some = random.random(count) < 0.6
    half = random.normal(0, 1, (count, 2, 2))
    covariance[some] = (half @ half.transpose(0, 2, 1) + 1e-3 * np.eye(2))[some]
    groups = np.where(random.random(count) < 0.5, -1, random.integers(0, 9, count))
    matched = groups >= 0
    common = {"sigma_common": np.where(matched, 1.7, 0.0), "sigma_alike": np.where(matched, 0.3, 0.0)}
    return replace(plain.with_covariance_image(covariance, groups), **common)


def assert_same(one: Points, other: Points) -> None:
    np.testing.assert_array_equal(one.covariance_image, other.covariance_image)
    np.testing.assert_array_equal(one.sigma_image, other.sigma_image)
    np.testing.assert_array_equal(one.groups, other.groups)
    np.testing.assert_array_equal(one.sigma_common, other.sigma_common)
    np.testing.assert_array_equal(one.sigma_alike, other.sigma_alike)


def test_a_point_without_a_covariance_errs_alike_in_all_directions_and_on_its_own() -> None:
    points = replace(made(), covariance_image=None, groups=None)
    np.testing.assert_array_equal(points.covariance_image, points.sigma_image[:, None, None] ** 2 * np.eye(2))
    assert points.groups.tolist() == [-1] * len(points)
    # A scale of such points is one of sigma alone, as it was before there were covariances.
    twice = replace(points, sigma_image=2 * points.sigma_image)
    np.testing.assert_array_equal(twice.covariance_image, (2 * points.sigma_image[:, None, None]) ** 2 * np.eye(2))
    perfect = replace(points, sigma_image=np.zeros(len(points)), covariance_image=None)
    assert not replace(perfect, source="again").covariance_image.any()


def test_the_scalar_is_the_root_mean_square_of_both_axes() -> None:
    points = made().with_covariance_image(np.tile([[4.0, 1.0], [1.0, 2.0]], (6, 1, 1)))
    np.testing.assert_allclose(points.sigma_image, np.sqrt(3.0), rtol=1e-15)
    for kept in (points.select([4, 1]), points.with_roles(["check"] * 6), points.to_crs("EPSG:32635")):
        np.testing.assert_array_equal(kept.covariance_image, np.tile([[4.0, 1.0], [1.0, 2.0]], (len(kept), 1, 1)))
    mixed = made()
    assert_same(mixed.select([5, 0]), mixed.select([0, 5]).select([1, 0]))
    assert mixed.select([5, 0]).groups.tolist() == [mixed.groups[5], mixed.groups[0]]
    point = list(mixed)[3]
    assert point.covariance_image == tuple(map(tuple, mixed.covariance_image[3].tolist()))
    assert point.group == mixed.groups[3]


@pytest.mark.parametrize(
    ("covariance", "said"),
    [
        ([[1, 2], [2, 1]], "positive definite"),
        ([[1, 1], [1, 1]], "positive definite"),
        ([[-1, 0], [0, -1]], "positive definite"),
        ([[0, 0], [0, 0]], "positive definite"),
        ([[1, 0.1], [0.2, 1]], "symmetric"),
        ([[np.nan, 0], [0, 1]], "finite"),
        ([[np.inf, 0], [0, 1]], "finite"),
        ([1, 1], "shape"),
    ],
)
def test_what_is_not_a_covariance_is_refused(covariance: list[list[float]], said: str) -> None:
    points = made(1).with_covariance_image([[[1, 0], [0, 1]]])
    for make in (points.with_covariance_image, lambda given: replace(points, covariance_image=given)):
        with pytest.raises(InputError, match=said) as caught:
            make(np.array([covariance], dtype=float))
        assert caught.value.field == "covariance_image"


def test_a_scalar_that_contradicts_a_covariance_is_refused_and_rounding_is_not() -> None:
    points = made(1).with_covariance_image([[[4, 1], [1, 2]]])
    with pytest.raises(InputError, match="but its covariance_image gives") as caught:
        replace(points, sigma_image=2 * points.sigma_image)
    assert caught.value.field == "sigma_image"
    assert replace(points, sigma_image=[1.73]).sigma_image == pytest.approx([np.sqrt(3)], rel=1e-15)
    skew = points.covariance_image + np.array([[0, 1e-16], [0, 0]])
    assert points.with_covariance_image(skew).covariance_image[0, 0, 1] == 1.0


@pytest.mark.parametrize("groups", [[0], [0.5] * 6, [-2] * 6, [-1, 0, 1, -2, 3, 4], ["a"] * 6, [[0] * 6]])
def test_what_is_not_a_group_is_refused(groups: list[object]) -> None:
    with pytest.raises(InputError) as caught:
        replace(made(), groups=groups)
    assert caught.value.field == "groups"


# -- files -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".csv", ".tsv", ".geojson"])
@given(seed=st.integers(0, 1000), count=st.integers(1, 8))
def test_covariances_and_groups_are_read_as_they_were_written(
    tmp_path: Path, suffix: str, seed: int, count: int
) -> None:
    points, path = made(count, seed), tmp_path / f"points{suffix}"
    write_points(points, path)
    assert_same(read_points(path), points)


def test_files_say_no_more_than_there_is_to_say(tmp_path: Path) -> None:
    points = made()
    plain = replace(points, covariance_image=points.sigma_image[:, None, None] ** 2 * np.eye(2), groups=None)
    plain = replace(plain, sigma_common=None, sigma_alike=None)
    write_points(plain, tmp_path / "plain.csv")
    write_points(plain, tmp_path / "plain.geojson")
    assert "sigma_h\n" in (tmp_path / "plain.csv").read_text()
    for feature in json.loads((tmp_path / "plain.geojson").read_text())["features"]:
        assert set(feature["properties"]) == {"id", "ji", "role", "sigma_image", "sigma_xy", "sigma_h"}
    write_points(replace(plain, groups=[3, -1, -1, -1, -1, -1]), tmp_path / "groups.csv", images=["a.tif"] * 6)
    assert "sigma_h,group,image\n" in (tmp_path / "groups.csv").read_text()
    assert read_points(tmp_path / "groups.csv").groups.tolist() == [3, -1, -1, -1, -1, -1]
    write_points(points, tmp_path / "all.csv")
    assert "sigma_h,var_col,var_row,cov_col_row,group,sigma_common,sigma_alike\n" in (tmp_path / "all.csv").read_text()
    kept = {field.name for field in dataclasses.fields(points)}
    assert {"covariance_image", "groups"} <= kept


HEADER = "id,col,row,x,y,h,sigma_image,var_col,var_row,cov_col_row,group,sigma_common\n"


def read(path: Path, cells: str) -> Points:
    path.write_text(HEADER + f"a,1,2,24,-33,100,{cells}{'' if cells.count(',') == 5 else ','}\n")
    return read_points(path, crs="EPSG:4326", vertical="ellipsoid")


def test_a_covariance_needs_no_scalar_beside_it(tmp_path: Path) -> None:
    points = read(tmp_path / "p.csv", ",0.5,0.25,-0.1,7")
    assert points.covariance_image.tolist() == [[[0.5, -0.1], [-0.1, 0.25]]]
    assert points.sigma_image == pytest.approx([np.sqrt(0.375)])
    assert points.groups.tolist() == [7]
    alike = read(tmp_path / "p.csv", ",0.25,0.25,0,")
    assert alike.sigma_image.tolist() == [0.5]
    assert alike.groups.tolist() == [-1]


@pytest.mark.parametrize(
    ("cells", "field"),
    [
        (",1,1,,", "column var_col"),
        (",,,0.5,", "column cov_col_row"),
        (",1,1,1,", "column cov_col_row"),
        (",1,0,0,", "column var_row"),
        (",-1,1,0,", "column var_col"),
        (",1,1,nan,", "column cov_col_row"),
        ("0.5,1,1,0.5,", "column var_col"),
        (",,,,1.5", "column group"),
        (",,,,-1", "column group"),
        (",,,,1e30", "column group"),
        (",,,,cell", "column group"),
        (",,,,,-1", "column sigma_common"),
        (",,,,,metres", "column sigma_common"),
    ],
)
def test_bad_covariances_and_groups_in_files_are_named(tmp_path: Path, cells: str, field: str) -> None:
    with pytest.raises(InputError) as caught:
        read(tmp_path / "p.csv", cells)
    assert caught.value.field == f"line 2, {field}"
    assert caught.value.file is not None
    assert caught.value.remedy


def test_bad_covariances_in_geojson_are_named(tmp_path: Path) -> None:
    document = made(1).__geo_interface__
    for properties, field in (
        ({"var_col": 1.0, "var_row": 1.0}, "var_col"),
        ({"var_col": 1.0, "var_row": 1.0, "cov_col_row": True}, "cov_col_row"),
        ({"group": [1]}, "group"),
        ({"group": -1}, "group"),
        ({"sigma_common": -2.0}, "sigma_common"),
    ):
        one = document["features"][0]
        bare = {key: value for key, value in one["properties"].items() if key in ("id", "ji")}
        (tmp_path / "p.geojson").write_text(
            json.dumps({**document, "features": [{**one, "properties": {**bare, **properties}}]})
        )
        with pytest.raises(InputError) as caught:
            read_points(tmp_path / "p.geojson")
        assert caught.value.field == f"features[0].properties.{field}"


def test_a_piece_with_larger_pixels_has_larger_errors(tmp_path: Path) -> None:
    points = made(6, 3)
    write_points(points, tmp_path / "p.csv", images=["one.tif", *["two.tif"] * 5])
    found = read_points(tmp_path / "p.csv", image_name="one.tif", pieces={"two.tif": (10.0, 20.0, 4.0)})
    np.testing.assert_allclose(found.covariance_image[1:], 16 * points.covariance_image[1:], rtol=1e-14)
    np.testing.assert_allclose(found.sigma_image[1:], 4 * points.sigma_image[1:], rtol=1e-14)
    assert found.groups.tolist() == points.groups.tolist()


def test_a_block_takes_the_scalar_of_a_covariance(tmp_path: Path) -> None:
    path = tmp_path / "rays.csv"
    path.write_text(
        "id,image,col,row,x,y,h,sigma_image,var_col,var_row,cov_col_row,group\n"
        "a,one.tif,1,2,24,-33,100,,0.5,0.25,-0.1,7\nb,one.tif,3,2,24,-33.1,100,0.3,,,,\n"
    )
    points = read_block_points(path, crs="EPSG:4326", vertical="ellipsoid")
    assert points.sigma_image == pytest.approx([np.sqrt(0.375), 0.3])


def test_a_block_takes_what_points_have_in_common(tmp_path: Path) -> None:
    path = tmp_path / "rays.csv"
    path.write_text(
        "id,image,col,row,x,y,h,sigma_xy,sigma_common\na,one.tif,1,2,24,-33,100,0.3,0.4\nb,one.tif,3,2,24,-33.1,100,,2\n"
        "a,two.tif,1,2,24,-33,100,0.3,0.4\nc,two.tif,4,4,24,-33.2,100,0.5,\n"
    )
    points = read_block_points(path, crs="EPSG:4326", vertical="ellipsoid")
    np.testing.assert_array_equal(points.sigma_ground[:, 0], [0.3, 0.0, 0.5])
    np.testing.assert_array_equal(points.sigma_common, [0.4, 2.0, 0.0])


@pytest.mark.parametrize(("factor", "agrees"), [(1.009, True), (0.991, True), (1.015, False), (0.985, False)])
def test_a_scalar_agrees_with_a_covariance_within_one_per_cent(tmp_path: Path, factor: float, agrees: bool) -> None:
    points = made(1).with_covariance_image([[[4, 1], [1, 2]]])
    for make in (
        lambda sigma: replace(points, sigma_image=[sigma]),
        lambda sigma: read(tmp_path / "p.csv", f"{sigma!r},4,2,1,"),
    ):
        if agrees:
            assert make(factor * 3**0.5).sigma_image == pytest.approx([3**0.5])
        else:
            with pytest.raises(InputError, match="gives"):
                make(factor * 3**0.5)


# -- limits ----------------------------------------------------------------------------------------------------------


def changed(points: Points, **fields: Any) -> Points:
    return replace(points, **fields)


@pytest.mark.parametrize(("rest", "possible"), [(2e-12, True), (0.4e-12, False)])
def test_a_covariance_is_singular_if_its_correlation_is_one(tmp_path: Path, rest: float, possible: bool) -> None:
    """Its square is one less a millionth of a millionth; variances of 4 and 9 px2."""
    both = 6 * (1 - rest) ** 0.5
    for sign in (1, -1):
        matrix = [[4, sign * both], [sign * both, 9]]
        for make in (
            lambda matrix=matrix: made(1).with_covariance_image([matrix]).covariance_image[0],
            lambda matrix=matrix: read(tmp_path / "p.csv", f",4,9,{matrix[0][1]!r},").covariance_image[0],
        ):
            if possible:
                np.testing.assert_array_equal(make(), matrix)
            else:
                with pytest.raises(InputError, match="positive definite"):
                    make()


@pytest.mark.parametrize("order", [1, -1])
def test_covariances_that_differ_by_rounding_are_their_mean(order: int) -> None:
    """By less than a millionth of a millionth of the trace, here 13 px2."""
    near, far = ([[4, 1.0], [1.0 + skew, 9]] for skew in (1.2e-11, 1.4e-11))
    if order < 0:
        near, far = (np.transpose(matrix).tolist() for matrix in (near, far))
    found = made(1).with_covariance_image([near]).covariance_image[0]
    assert found[0, 1] == found[1, 0] == pytest.approx(1.0 + 0.6e-11, abs=1e-13)
    assert (found[0, 0], found[1, 1]) == (4, 9)
    with pytest.raises(InputError, match="symmetric"):
        made(1).with_covariance_image([far])


def test_the_message_names_the_point_with_the_error() -> None:
    """Points before it err alike in all directions or not."""
    plain = changed(made(5), covariance_image=None, groups=None)
    good = plain.covariance_image.copy()
    good[1] = [[4, 1], [1, 2]]
    points = plain.with_covariance_image(good)
    np.testing.assert_array_equal(points.covariance_image, good)
    for k, wrong, said in (
        (3, [[1, 2], [2, 1]], "positive definite"), (4, [[1, 0.1], [0.2, 1]], "symmetric"),
        (2, [[np.nan, 0], [0, 1]], "finite"),
    ):  # fmt: skip
        bad = good.copy()
        bad[k] = np.array(wrong)
        with pytest.raises(InputError, match=rf"of point {k + 1} is not {said}"):
            points.with_covariance_image(bad)
        with pytest.raises(InputError, match=rf"of point {k + 1} is not {said}"):
            replace(points, covariance_image=bad)
    sigma = points.sigma_image.copy()
    sigma[1] *= 1.02
    with pytest.raises(InputError, match=rf"of point 2 is {sigma[1]:g}, but its covariance_image gives {3**0.5:g}"):
        replace(points, sigma_image=sigma)


def test_a_direction_may_differ_in_one_element() -> None:
    """Variances that differ, or a covariance, each alone."""
    matrices = np.array([[[4.0, 0], [0, 9]], [[4, 1], [1, 4]], [[4, -1], [-1, 4]], [[4, 0], [0, 4]]])
    points = made(4).with_covariance_image(matrices)
    np.testing.assert_array_equal(points.covariance_image, matrices)
    np.testing.assert_array_equal(points.sigma_image, np.sqrt([6.5, 4, 4, 4]))
    # The last one has the same error in all directions: it is scaled by its sigma alone.
    twice = replace(points, sigma_image=points.sigma_image * [1, 1, 1, 2])
    np.testing.assert_array_equal(twice.covariance_image[3], [[16, 0], [0, 16]])


@pytest.mark.parametrize(("group", "known"), [("0", 0), (str(2**53 - 1), 2**53 - 1), (str(2**53), None), ("", -1)])
def test_groups_are_numbered_from_zero(tmp_path: Path, group: str, known: int | None) -> None:
    if known is None:
        with pytest.raises(InputError, match="not a group"):
            read(tmp_path / "p.csv", f"0.5,,,,{group}")
    else:
        assert read(tmp_path / "p.csv", f"0.5,,,,{group}").groups.tolist() == [known]


def test_errors_in_common_may_be_zero_and_are_finite(tmp_path: Path) -> None:
    points = made(3)
    for name in ("sigma_common", "sigma_alike"):
        assert getattr(changed(points, **{name: [0, 0.25, 2]}), name).tolist() == [0, 0.25, 2]
        for wrong in ([0, -1e-9, 1], [0, np.inf, 1], [np.nan, 0, 1], [1, 1]):
            with pytest.raises(InputError) as caught:
                changed(points, **{name: wrong})
            assert caught.value.field == name
    assert read(tmp_path / "p.csv", "0.5,,,,,0").sigma_common.tolist() == [0.0]
    assert read(tmp_path / "p.csv", "0.5,,,,,0.75").sigma_common.tolist() == [0.75]
