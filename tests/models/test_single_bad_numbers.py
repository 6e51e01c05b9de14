"""One bad number among good ones is refused, wherever it is; and one bad point does not spoil the others."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import RPC, ImageCorrection, MapPlane, require_view
from ortho_pipeline.models.base import SensorModel, solve_2x2
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.mosaicked import Cropped
from ortho_pipeline.models.orthos.map_grid import MapGrid
from ortho_pipeline.models.orthos.smooth_field import SmoothField
from ortho_pipeline.models.pushbroom.constraints import Observations
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.metadata import _corner_points
from ortho_pipeline.models.pushbroom.splines import Spline
from ortho_pipeline.models.pushbroom.tables import rotations_of_quaternions
from ortho_pipeline.models.rational import Rational


def rpc() -> RPC:
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 3]], row[[2, 3]] = (1.0, 0.05), (-1.0, 0.02)
    return RPC(200.0, 150.0, 20.0, -30.0, 500.0, 200.0, 150.0, 0.01, 0.0065, 500.0, col, one, row, one)


def map_plane() -> MapPlane:
    return MapPlane("EPSG:32633", (5e5, 4.64e6), (1.0, 2.0), (900, 800), 100.0, (0.2, -0.1), (0.0, 500.0), (3.0, 4.0))


def map_grid() -> MapGrid:
    return MapGrid("EPSG:32633", (5e5, 2.0, 0.5, 4.64e6, 0.25, -3.0), (900, 800))


def camera() -> FrameCamera:
    return FrameCamera.from_roll_pitch_yaw(
        Interior(1000, 1500, 0.120, 1e-4, 1e-4), (33.0, 40.0, 6000.0), 0.05, -0.08, 2.0, heights=(700.0, 1900.0)
    )


def rational() -> Rational:
    """Return column 500 + 400 x and row 300 - 200 y in a box of 2 x 2 degrees, 1 km high."""
    coefficients = np.zeros(8)
    coefficients[1], coefficients[6] = 1.0, -1.0
    low, high = np.array([20.0, 39.0, 0.0]), np.array([22.0, 41.0, 1000.0])
    return Rational(
        "affine3d", "EPSG:4326", coefficients, (low + high) / 2, (high - low) / 2, np.array([500.0, 300.0]),
        np.array([400.0, 200.0]), np.array([low, high]),
    )  # fmt: skip


#: What is made, and the fields of numbers that it has.
MADE: dict[str, tuple[Any, tuple[str, ...]]] = {
    "correction": (lambda: ImageCorrection.identity(rpc(), "affine", (200.0, 150.0)), ("coefficients",)),
    "crop": (lambda: Cropped(rpc(), (10.0, 20.0)), ("offset",)),
    "map plane": (map_plane, ("corner", "pixel", "relief", "heights", "shift")),
    "map grid": (map_grid, ("geotransform",)),
    "smooth field": (lambda: SmoothField(rpc(), (400, 300), np.zeros((3, 4, 2))), ("coefficients",)),
    "frame camera": (camera, ("exterior", "origin", "heights")),
    "observations": (
        lambda: Observations(np.array([0.0, 1.0]), np.zeros((2, 3)), np.ones((2, 3))), ("times", "values", "sigma")
    ),
    "spline": (lambda: Spline(1, np.array([0.0, 1.0, 2.0]), np.zeros((3, 3))), ("breaks", "coefficients")),
    "line camera": (lambda: LineCamera(100, 50, 50.0, 0.0, 1e4, [0.1, 0.2], [0.3, 0.4]), ("dx", "dy")),
    "rpc": (rpc, ("col_num", "col_den", "row_num", "row_den")),
    "rational": (
        rational, ("coefficients", "ground_offset", "ground_scale", "image_offset", "image_scale", "box")
    ),
}  # fmt: skip


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("name", MADE)
def test_one_number_that_is_not_finite_is_refused(name: str, bad: float) -> None:
    make, fields = MADE[name]
    for field in fields:
        good = np.asarray(getattr(make(), field), dtype=float)
        for place in range(good.size):
            values = good.copy()
            values.flat[place] = bad
            with pytest.raises(InputError):
                dataclasses.replace(make(), **{field: values if good.ndim > 1 else tuple(values.tolist())})


@pytest.mark.parametrize("name", MADE)
def test_nobody_changes_the_numbers_of_a_model(name: str) -> None:
    """Neither through its arrays, nor through those that it was made from."""
    make, fields = MADE[name]
    for field in fields:
        given = np.array(getattr(make(), field), dtype=float)
        made = dataclasses.replace(make(), **{field: given})
        kept = np.array(getattr(made, field))
        given += 1.0
        np.testing.assert_array_equal(getattr(made, field), kept)
        if isinstance(values := getattr(made, field), np.ndarray):
            assert not values.flags.writeable, field


def test_nobody_turns_a_camera_through_its_rotation() -> None:
    assert not camera().rotation.flags.writeable


def test_one_sigma_of_zero_or_one_time_that_goes_back_is_refused() -> None:
    sigma = np.ones((2, 3))
    sigma[1, 2] = 0.0
    with pytest.raises(InputError, match="positive"):
        Observations(np.array([0.0, 1.0]), np.zeros((2, 3)), sigma)
    with pytest.raises(InputError, match="increasing"):
        Spline(1, np.array([0.0, 1.0, 1.0, 2.0]), np.zeros((4, 3)))
    with pytest.raises(InputError, match="increasing"):
        LineCamera.of_table(100, 50, [0.0, 50.0, 50.0, 100.0], [0.1, 0.0, 0.0, -0.1], np.zeros(4))
    with pytest.raises(InputError, match="finite"):
        LineCamera.of_table(100, 50, [0.0, 50.0, 100.0], [0.1, 0.0, -0.1], [0.0, np.nan, 0.0])
    with pytest.raises(InputError, match="zero or not finite"):
        rotations_of_quaternions([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])


def test_one_scale_or_side_of_a_box_that_is_not_positive_is_refused() -> None:
    for field in ("ground_scale", "image_scale"):
        for place in range(len(getattr(rational(), field))):
            values = getattr(rational(), field).copy()
            values[place] = 0.0
            with pytest.raises(InputError, match="positive"):
                dataclasses.replace(rational(), **{field: values})
    for place in range(3):
        box = rational().box.copy()
        box[1, place] = box[0, place]
        with pytest.raises(InputError, match="below its maximum"):
            dataclasses.replace(rational(), box=box)
    names = rational().param_names
    assert dataclasses.replace(rational(), removed=(names[0], names[2])).removed == (names[0], names[2])
    with pytest.raises(InputError, match="zero can be removed"):
        dataclasses.replace(rational(), removed=(names[0], names[1]))


def test_a_classical_model_is_gated_at_one_and_a_half_half_sizes_along_each_axis() -> None:
    ground = np.array(
        [[21.0, 40.0, 500.0], [22.49, 40.0, 0.0], [22.51, 40.0, 0.0], [21.0, 38.51, 0.0], [21.0, 38.49, 0.0]]
    )
    expected = [[500.0, 300.0], [1096.0, 300.0], [np.nan] * 2, [500.0, 598.0], [np.nan] * 2]
    np.testing.assert_allclose(rational().ground_to_image(ground), expected)
    assert np.isnan(rational().param_partials(ground)[[2, 4]]).all()
    assert np.isnan(rational().ground_partials(ground)[[2, 4]]).all()


def test_one_corner_beyond_a_pole_or_unknown_is_refused() -> None:
    corners = np.array([[20.0, 40.0], [21.0, 40.0], [21.0, 39.0], [20.0, 39.0]])
    np.testing.assert_array_equal(_corner_points(corners, (100.0, 300.0))[:, 2], 200.0)
    for place in range(8):
        wrong = corners.copy()
        wrong.flat[place] = np.nan
        with pytest.raises(InputError, match="four of lon, lat"):
            _corner_points(wrong, (100.0, 300.0))
    corners[2, 1] = -90.1
    with pytest.raises(InputError, match="larger than 90"):
        _corner_points(corners, (100.0, 300.0))
    corners[2, 1] = -90.0
    assert _corner_points(corners, (0.0, 0.0)).shape == (4, 3)


def test_a_map_grid_of_more_or_fewer_than_six_numbers_is_refused() -> None:
    for numbers in (map_grid().geotransform[:5], (*map_grid().geotransform, 0.0)):
        with pytest.raises(InputError, match="six"):
            MapGrid("EPSG:32633", numbers, (900, 800))
    with pytest.raises(InputError, match="inverted"):
        MapGrid("EPSG:32633", (5e5, 2.0, 4.0, 4.64e6, 1.0, 2.0), (900, 800))
    for size in ((0, 800), (900, 0), (900,)):
        with pytest.raises(InputError, match="positive size"):
            MapGrid("EPSG:32633", map_grid().geotransform, size)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "changes", [{"pixel": (0.0, 1.0)}, {"pixel": (1.0, 0.0)}, {"size": (0, 5)}, {"size": (5, 0)}, {"size": (1, 2, 3)},
                {"heights": (500.0, 500.0)}, {"plane": -0.1}, {"plane": 500.1}],
)  # fmt: skip
def test_a_map_plane_that_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        dataclasses.replace(map_plane(), **changes)


def test_a_map_plane_of_one_pixel_and_at_the_end_of_its_heights_is_possible() -> None:
    assert dataclasses.replace(map_plane(), size=(1, 1), plane=0.0).size == (1, 1)
    assert dataclasses.replace(map_plane(), plane=500.0).plane == 500.0


MODELS: dict[str, Any] = {
    "rpc": rpc, "map plane": map_plane, "map grid": map_grid, "frame camera": camera, "crop": MADE["crop"][0],
    "rational": rational,
    "smooth field": lambda: SmoothField(rpc(), (400, 300), np.full((3, 4, 2), 0.5)),
    "correction": lambda: ImageCorrection.identity(rpc(), "affine", (200.0, 150.0)),
}  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_a_point_with_one_unknown_coordinate_is_a_row_of_nan_and_the_others_stay(name: str) -> None:
    model: SensorModel = MODELS[name]()
    centre, half = model.domain
    ground = centre + half * np.array([[0.1, 0.2, 0.3], [-0.2, 0.1, -0.1], [0.05, -0.2, 0.2]])
    image = model.ground_to_image(ground)
    assert np.isfinite(image).all()
    needed = range(3) if model.uses_height else range(2)
    for column in needed:
        some = ground.copy()
        some[1, column] = np.nan
        found = model.ground_to_image(some)
        assert np.isnan(found[1]).all()
        np.testing.assert_allclose(found[[0, 2]], image[[0, 2]], rtol=1e-12)
    for column in range(2):
        some = image.copy()
        some[1, column] = np.nan
        back = model.image_to_ground(some, ground[:, 2])
        assert np.isnan(back[1]).all()
        np.testing.assert_allclose(back[[0, 2]], ground[[0, 2]], rtol=1e-6)
    back = model.image_to_ground(image, np.array([ground[0, 2], np.nan, ground[2, 2]]))
    assert np.isnan(back[1]).any()
    np.testing.assert_allclose(back[[0, 2]], ground[[0, 2]], rtol=1e-6)


def test_two_equations_of_which_one_has_no_solution_have_none() -> None:
    matrices = np.array([[[2.0, 1.0], [1.0, 3.0]], [[1.0, 2.0], [2.0, 4.0]], [[1.0, 0.0], [0.0, 1.0]]])
    right = np.array([[5.0, 10.0], [1.0, 2.0], [np.nan, 1.0]])
    np.testing.assert_allclose(solve_2x2(matrices, right), [[1.0, 3.0], [np.nan] * 2, [np.nan] * 2])
    # Infinite in one unknown alone: the other one is worth nothing either.
    half = np.array([[[1.0, 0.0], [0.0, 1.0]]])
    assert np.isnan(solve_2x2(half, np.array([[2.0, np.inf]]))).all()


class Half(SensorModel):
    """A model whose image has columns in the western part of its domain alone, or of which one is infinite."""

    def __init__(self, bad: float, half: float = 1.0, seen: bool = True) -> None:
        self.bad, self.half, self.seen = bad, half, seen

    kind = "half"  # type: ignore[misc]
    param_names = ()  # type: ignore[assignment]
    params = np.zeros(0)  # type: ignore[assignment]
    crs = "EPSG:4979"  # type: ignore[assignment]

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array([20.0, 40.0, 0.0]), np.array([1.0, 1.0, self.half])

    def with_params(self, params: Any) -> Half:
        return self

    def ground_to_image(self, ground: Any) -> np.ndarray:
        image = np.array(ground)[:, :2]
        image[image[:, 0] > 20.0 if self.seen else slice(None), 1] = self.bad
        return image

    def ground_partials(self, ground: Any) -> np.ndarray:
        raise NotImplementedError

    def param_partials(self, ground: Any) -> np.ndarray:
        raise NotImplementedError


def test_only_ground_within_the_domain_counts() -> None:
    class Beyond(Half):
        def ground_to_image(self, ground: Any) -> np.ndarray:
            return np.where(np.abs(np.array(ground)[:, 2:]) > 500.0, 7.0, np.full((1, 2), np.nan))

    require_view(Beyond(0.0, half=501.0))
    with pytest.raises(InputError):
        require_view(Beyond(0.0, half=499.0))
    with pytest.raises(InputError):
        require_view(Beyond(0.0, half=0.001))


def test_a_model_needs_a_finite_domain_and_some_ground_in_its_image() -> None:
    require_view(Half(np.nan))
    for model in (Half(np.nan, seen=False), Half(np.inf), Half(0.0, half=np.inf), Half(0.0, half=np.nan)):
        with pytest.raises(InputError):
            require_view(model)


def test_a_field_at_a_half_known_place_is_unknown() -> None:
    made = SmoothField(rpc(), (400, 300), np.full((3, 4, 2), 0.5))
    found = made.displacement(np.array([[10.0, 20.0], [np.nan, 20.0], [10.0, np.nan]]))
    np.testing.assert_allclose(found, [[0.5, 0.5], [np.nan] * 2, [np.nan] * 2])
