"""Tables of blocks: what is selected, joined, filled in and refused."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pyproj
import pytest

from ortho_pipeline.block.points import BlockPoints, joined, shape_of
from ortho_pipeline.errors import InputError
from ortho_pipeline.points import Points


def block(**changed: Any) -> BlockPoints:
    """Return three points: a in images 0 and 1, b in 1, c in 0 and 1."""
    given: dict[str, Any] = {
        "ids": ("a", "b", "c"),
        "ground": [[500_000.0, 5e6, 10.0], [500_100.0, 5e6, math.nan], [math.nan] * 3],
        "roles": ["control", "check", "tie"],
        "sigma_ground": [[0.0, 0.2, 0.0], [0.1, 0.0, 0.5], [0.0, 0.0, 0.0]],
        "crs": pyproj.CRS("EPSG:32633"),
        "images": ("one.tif", "two.tif"),
        "point": [0, 2, 0, 1, 2],
        "image": [0, 0, 1, 1, 1],
        "measured": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0], [7.0, 8.0], [9.0, 10.0]],
        "sigma_image": [0.1, 0.2, 0.3, 0.4, 0.5],
        "sigma_common": [1.5, 0.0, 0.0],
        "groups": [0, -1, 1, 1, -1],
    }
    return BlockPoints(**{**given, **changed})


def test_selected_points_keep_their_rays() -> None:
    found = block().select([2, 0])
    assert found.ids == ("c", "a")
    seen = {(found.ids[p], found.images[i]): place for p, i, place in
            zip(found.point, found.image, found.measured.tolist(), strict=True)}  # fmt: skip
    assert seen == {
        ("a", "one.tif"): [1.0, 2.0], ("c", "one.tif"): [3.0, 4.0], ("a", "two.tif"): [5.0, 6.0],
        ("c", "two.tif"): [9.0, 10.0],
    }  # fmt: skip
    assert found.sigma_image.tolist() == [0.1, 0.2, 0.3, 0.5]
    assert found.sigma_common.tolist() == [0.0, 1.5]
    assert found.grouped.tolist() == [0, -1, 1, -1]
    assert found.roles.tolist() == ["tie", "control"]
    fewer = block().of_rays(block().image == 0)
    assert (fewer.ids, fewer.rays) == (("a", "b", "c"), 2)


def test_the_table_of_an_image_has_its_points() -> None:
    two = block().in_image("two.tif")
    assert two.ids == ("a", "b", "c")
    assert two.image.tolist() == [[5.0, 6.0], [7.0, 8.0], [9.0, 10.0]]
    assert two.sigma_image.tolist() == [0.3, 0.4, 0.5]
    assert two.groups.tolist() == [1, 1, -1]
    assert two.sigma_common.tolist() == [1.5, 0.0, 0.0]
    np.testing.assert_array_equal(block().rays_of_images[1], [2, 3, 4])
    again = BlockPoints.of({name: block().in_image(name) for name in block().images})
    assert again.ids == ("a", "c", "b")
    assert again.point.tolist() == [0, 1, 0, 2, 1]


def test_other_sigmas_and_roles_are_those_of_a_new_table() -> None:
    points = block()
    other = points.with_image_sigmas(np.full(5, 9.0))
    assert other.sigma_image.tolist() == [9.0] * 5
    assert points.sigma_image.tolist() == [0.1, 0.2, 0.3, 0.4, 0.5]
    assert [mask.tolist() for mask in (points.control, points.check, points.tie)] == np.eye(3, dtype=bool).tolist()
    assert points.with_roles(["tie", "check", "tie"]).tie.tolist() == [True, False, True]


def test_only_ground_without_a_sigma_gets_one() -> None:
    found = block().with_ground_sigma(0.7, 0.9).sigma_ground
    assert found.tolist() == [[0.7, 0.2, 0.9], [0.1, 0.7, 0.5], [0.7, 0.7, 0.9]]
    assert block().with_ground_sigma(0.7).sigma_ground[2].tolist() == [0.7] * 3
    for plan, height in ((0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (1.0, -1.0), (math.nan, 1.0), (1.0, math.inf)):
        with pytest.raises(InputError, match="must be positive"):
            block().with_ground_sigma(plan, height)


@pytest.mark.parametrize(
    "changed",
    [
        {"roles": ["control", "check", "control"]}, {"roles": ["control", "check", "gcp"]},
        {"sigma_image": [0.1, 0.2, 0.3, 0.4, 0.0]}, {"sigma_ground": [[0, 0, 0], [0, 0, 0], [0, -1, 0]]},
        {"measured": [[1, 2], [3, 4], [5, math.inf], [7, 8], [9, 10]]}, {"ids": ("a", "b", "a")},
        {"images": ("one.tif", "one.tif")}, {"point": [0, 2, 0, 1, 3]}, {"point": [0, 2, 0, 1, -1]},
        {"point": [-1, -1, -1, -1, -1]}, {"image": [0, 0, 1, 1, 2]}, {"ground": [[5e5, 5e6, 10.0], [5e5, math.nan, 1.0],
        [math.nan] * 3]}, {"ground": [[math.nan, 5e6, 10.0], [5e5, 5e6, 1.0], [math.nan] * 3]},
        {"measured": np.zeros((5, 3))}, {"sigma_image": [0.1] * 4},
        {"image": [0, 0, 1, 1, -1]}, {"point": [0, 2, 0, 1, 1]},
    ],
)  # fmt: skip
def test_what_is_no_block_is_refused(changed: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        block(**changed)


def test_a_sentence_tells_the_points_of_each_role_and_the_rays() -> None:
    assert repr(block(source="a.csv")) == "<3 points: 1 control, 1 check, 1 tie; 5 rays in 2 images; a.csv>"
    assert repr(block(roles=["tie"] * 3)).startswith("<3 points: 3 tie; 5 rays")
    empty = BlockPoints((), np.zeros((0, 3)), [], np.zeros((0, 3)), pyproj.CRS(32633), ("a",), [], [],  # type: ignore[arg-type]
                        np.zeros((0, 2)), [])  # type: ignore[arg-type]  # fmt: skip
    assert repr(empty).startswith("<0 points: none; 0 rays in 1 image;")
    assert empty.groups is None
    assert block(groups=[-1] * 5).groups is None


def test_joined_tables_are_moved_to_one_crs_and_their_points_stay_apart() -> None:
    geographic = block(ground=[[500_000.0, 5e6, 10.0], [500_100.0, 5e6, 20.0], [math.nan] * 3])
    geographic = replace(geographic, ground=geographic.known_in("EPSG:4979"), crs=pyproj.CRS("EPSG:4326"))
    other = replace(geographic, images=("three.tif", "one.tif"))
    found = joined(("one.tif", "two.tif", "three.tif"), (block(), other, other.select([0])))
    assert found.ids == ("a", "b", "c", "a'", "b'", "c'", "a''")
    assert found.point.tolist() == [0, 2, 0, 1, 2, 3, 5, 3, 4, 5, 6, 6]
    assert found.image.tolist() == [0, 0, 1, 1, 1, 2, 2, 0, 0, 0, 2, 0]
    np.testing.assert_allclose(found.ground[[3, 6]], [block().ground[0]] * 2, atol=1e-6)


def test_one_point_has_one_ground_and_one_role() -> None:
    first = Points.of([[1, 2]], [[500_000.0, 5e6, 10.0]], "EPSG:32633")
    moved = Points.of([[3, 4]], [[500_000.0, 5e6, 10.1]], "EPSG:32633")
    with pytest.raises(InputError, match="the ground of the point '1' differs"):
        BlockPoints.of({"a": first, "b": moved})
    with pytest.raises(InputError, match="the role of the point '1' differs"):
        BlockPoints.of({"a": first, "b": first.with_roles(["check"])})
    # The same place in another CRS is the same ground.
    both = BlockPoints.of({"a": first, "b": first.to_crs("EPSG:4979")})
    assert (both.ids, both.point.tolist(), both.image.tolist()) == (("1",), [0, 0], [0, 1])


def test_measurements_with_a_covariance_are_made_independent() -> None:
    """The covariance of what is whitened is the identity, and restoring undoes it."""
    covariance = np.array([[[0.5, 0.3], [0.3, 0.4]], [[0.09, 0.0], [0.0, 0.09]]])
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    shape = shape_of(covariance)
    assert shape is not None
    np.testing.assert_allclose(np.trace(shape, axis1=1, axis2=2), 2.0)
    np.testing.assert_array_equal(shape[1], np.eye(2))
    assert shape_of(covariance[1:]) is None
    points = block().of_rays([0, 1])
    points = replace(points, sigma_image=sigma, shape_image=shape)
    np.testing.assert_allclose(points.covariance_image, covariance)
    rays = np.arange(2)
    unit = points.whitened(np.linalg.cholesky(covariance) / sigma[:, None, None], rays)
    np.testing.assert_allclose(unit @ unit.swapaxes(1, 2), [np.eye(2)] * 2, atol=1e-12)
    values = np.array([[1.0, -2.0], [3.0, 4.0]])
    np.testing.assert_allclose(points.in_pixels(points.whitened(values / sigma[:, None], rays), rays), values)
