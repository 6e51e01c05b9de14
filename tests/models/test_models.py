"""Sensor models: RPC and image correction against closed forms, numeric derivatives and the traps of the field."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import KINDS, RPC, ImageCorrection, SensorModel, model_from_dict, rational, rpc_kernel
from ortho_pipeline.models.rational import COMPILED_FROM
from ortho_pipeline.models.rpc_box import RPC_TERMS
from ortho_pipeline.testing import check_sensor_model


def make_rpc(**changes) -> RPC:
    """An RPC like that of a half-metre satellite 20 degrees off nadir, with all 78 coefficients at work."""
    random = np.random.default_rng(7)
    cubic = random.normal(0, 2e-5, (4, 10))
    fields = {
        "col_off": 6000.0, "row_off": 6100.0, "lon_off": 24.4, "lat_off": -33.65, "h_off": 700.0,
        "col_scale": 6300.0, "row_scale": 6350.0, "lon_scale": 0.034, "lat_scale": 0.029, "h_scale": 500.0,
        "col_num": [2e-3, 1.0, 0.05, 0.04, 1e-3, 4e-4, -3e-4, -6e-4, -5e-4, 8e-6, *cubic[0]],
        "col_den": [1.0, -1.7e-3, -2e-3, 3e-4, 1e-5, 2e-6, -3e-6, 4e-6, -5e-6, 6e-7, *cubic[1] / 10],
        "row_num": [-3e-3, 0.04, -1.0, 0.03, -1.5e-3, 2e-5, 3e-4, 4e-4, 3e-4, -3e-6, *cubic[2]],
        "row_den": [1.0, -1.4e-3, -1.1e-3, -5e-4, 2e-5, -2e-6, 1e-6, -3e-6, 1e-6, -5e-7, *cubic[3] / 10],
    }  # fmt: skip
    return RPC(**{**fields, **changes})


def box_of(model: SensorModel, count: int = 500, seed: int = 1) -> np.ndarray:
    centre, half = model.domain
    return centre + half * np.random.default_rng(seed).uniform(-1, 1, (count, 3))


def test_the_polynomial_and_its_slopes_are_those_of_the_exponents():
    place = np.random.default_rng(0).uniform(-1, 1, (3, 50))
    numbers = np.random.default_rng(1).normal(size=20)

    def value(powers: np.ndarray, factors: np.ndarray) -> np.ndarray:
        return np.sum((numbers * factors)[:, None] * np.prod(place[None] ** powers[:, :, None], axis=1), axis=0)

    np.testing.assert_allclose(rpc_kernel.polynomial(numbers, *place), value(RPC_TERMS, np.ones(20)), atol=1e-13)
    for axis, slope in enumerate(rpc_kernel.slopes(numbers, *place)):
        lowered = np.maximum(RPC_TERMS - (np.arange(3) == axis), 0)
        np.testing.assert_allclose(slope, value(lowered, RPC_TERMS[:, axis]), atol=1e-13)


@pytest.mark.parametrize(
    "model",
    [
        make_rpc(),
        ImageCorrection(make_rpc(), "shift", (5000, 5000), [3.0, 0, 0, -2.0, 0, 0]),
        ImageCorrection(make_rpc(), "shift-drift", (5000, 5000), [3.0, 0, 1e-3, -2.0, 0, 2e-4]),
        ImageCorrection(make_rpc(), "affine", (5000, 5000), [3.0, 1e-3, -2e-4, -2.0, 3e-4, -1e-3]),
    ],
    ids=lambda model: getattr(model, "correction", "rpc"),
)
def test_contract(model):
    check_sensor_model(model, box_of(model))


def test_offsets_are_in_the_corner_convention():
    # With numerators without a constant the centre of the box projects to the offsets: SAMP_OFF + 0.5, LINE_OFF + 0.5.
    model = make_rpc(col_num=[0, 1, *[0] * 18], row_num=[0, 0, -1, *[0] * 17])
    np.testing.assert_array_equal(model.ground_to_image([[24.4, -33.65, 700.0]]), [[6000.0, 6100.0]])


def test_crop_shifts_and_scale_scales_exactly():
    model, ground = make_rpc(), box_of(make_rpc())
    image = model.ground_to_image(ground)
    np.testing.assert_allclose(model.shifted(123, 45).ground_to_image(ground), image - (123, 45), atol=1e-9)
    np.testing.assert_allclose(model.scaled(4).ground_to_image(ground), image / 4, atol=1e-9)
    # In vendors' terms: off' = (off + 0.5) / k - 0.5.
    assert model.scaled(4).col_off - 0.5 == pytest.approx((model.col_off - 0.5 + 0.5) / 4 - 0.5, abs=1e-12)


def test_inverse_closes_over_the_whole_box():
    model = make_rpc()
    ground = box_of(model, 10_000)
    image = model.ground_to_image(ground)
    found = model.image_to_ground(image, ground[:, 2])
    assert np.abs(model.ground_to_image(found) - image).max() < 1e-5
    np.testing.assert_allclose(found, ground, atol=1e-11)


def test_compiled_kernels_agree_with_numpy(monkeypatch):
    """Many points go through compiled code, few through NumPy: the same in every bit, and the inverse to rounding.

    Across the antimeridian, and with a NaN among the points, which must not spoil the unwrapping of the others.
    """
    model = make_rpc(lon_off=179.99)
    ground = box_of(model, COMPILED_FROM) * [1.8, 1, 1] + [-0.8 * 179.99, 0, 0]
    ground[::7, 0] -= 360.0
    ground[::1000] = np.nan
    ground[1::1000, 1] = np.inf
    image, (_, partials) = model.ground_to_image(ground), model.projected(ground)
    found = model.image_to_ground(image, ground[:, 2])
    monkeypatch.setattr(rational, "LOADED_FROM", COMPILED_FROM)
    for calls in (10, 9):
        parts = [model.projected(part) for part in np.array_split(ground, calls)]
        np.testing.assert_array_equal(np.concatenate([part[0] for part in parts]), image)
        np.testing.assert_array_equal(np.concatenate([part[1] for part in parts]), partials)
    np.testing.assert_array_equal([model.ground_to_image(point[None])[0] for point in ground[:100]], image[:100])
    np.testing.assert_array_equal(np.isnan(partials).all(axis=(1, 2)), np.isnan(image[:, 0]))
    assert 0 < np.isnan(image[:, 0]).mean() < 0.3
    parts = np.concatenate(
        [
            model.image_to_ground(*part)
            for part in zip(np.array_split(image, 10), np.array_split(ground[:, 2], 10), strict=True)
        ]
    )
    # On the very limit of the domain rounding decides.
    within = np.abs(np.abs(np.remainder(ground[:, 0], 360) - 179.99) - 1.5 * 0.034) > 1e-9
    np.testing.assert_array_equal(np.isnan(found)[within], np.isnan(parts)[within])
    good = np.isfinite(found[:, 0]) & within
    # 1e-9 px of half a metre is 5e-15 degrees; the sum of both solvers' tolerances stays below 1e-13.
    np.testing.assert_allclose(found[good], parts[good], rtol=0, atol=1e-12)


def bent_rpc(seed: int = 5) -> RPC:
    """An RPC whose terms of second and third order are 0.06 of the first: steps change on the way."""
    random, first = np.random.default_rng(seed), make_rpc()
    names = "col_num", "col_den", "row_num", "row_den"
    return make_rpc(**{n: getattr(first, n) + random.normal(0, 0.06, 20) * (np.arange(20) > 3) for n in names})


@pytest.mark.parametrize("model", [make_rpc(), bent_rpc()], ids=["rpc", "bent"])
def test_the_compiled_result_of_a_point_does_not_depend_on_the_others(model):
    """Blocks are computed together: the order of points, and what stands next to them, must not show in a bit."""
    count = COMPILED_FROM + 77
    random = np.random.default_rng(3)
    ground = box_of(model, count) + np.where(random.uniform(size=(count, 1)) < 0.1, [0.05, 0.03, 400.0], 0.0)
    ground[::97] = np.nan
    image = model.ground_to_image(ground)
    image[::89], image[::83] = random.uniform(-1e5, 1e5, (len(image[::89]), 2)), np.nan
    found = model.image_to_ground(image, ground[:, 2])
    order = random.permutation(count)
    np.testing.assert_array_equal(model.ground_to_image(ground[order]), model.ground_to_image(ground)[order])
    np.testing.assert_array_equal(model.image_to_ground(image[order], ground[order, 2]), found[order])
    shorter = slice(31, count - 11)
    np.testing.assert_array_equal(model.image_to_ground(image[shorter], ground[shorter, 2]), found[shorter])
    assert 0.03 < np.isnan(found[:, 0]).mean() < 0.3


def test_the_compiled_inverse_follows_a_bent_rpc():
    model = bent_rpc()
    ground = box_of(model, COMPILED_FROM)
    image = model.ground_to_image(ground)
    found = model.image_to_ground(image, ground[:, 2])
    parts = [model.image_to_ground(image[k::10], ground[k::10, 2]) for k in range(10)]
    for k, part in enumerate(parts):
        np.testing.assert_allclose(found[k::10], part, rtol=0, atol=1e-12)
    assert np.abs(model.ground_to_image(found) - image).max() < 1e-8


def test_inverse_gives_nan_instead_of_a_false_root():
    model = make_rpc()
    far = np.array([[1e6, 1e6], [np.nan, 0.0], [6000.0, 1e9]])
    assert np.isnan(model.image_to_ground(far, 700.0)).all()
    assert np.isnan(model.image_to_ground([[6000.0, 6000.0]], np.nan)).all()


@pytest.mark.parametrize("count", [3, COMPILED_FROM])
def test_all_points_have_one_height_or_each_its_own(count):
    model = make_rpc()
    image = np.random.default_rng(2).uniform(1000, 9000, (count, 2))
    for one in (800.0, [800.0], np.full(count, 800.0)):
        np.testing.assert_allclose(model.ground_to_image(model.image_to_ground(image, one)), image, atol=1e-6)
        np.testing.assert_array_equal(model.image_to_ground(image, one)[:, 2], 800.0)
    for wrong in ([800.0, 900.0], np.full((count, 1), 800.0)):
        with pytest.raises(InputError, match="height must be one number or have the shape"):
            model.image_to_ground(image, wrong)


def test_ground_far_outside_has_no_image():
    model = make_rpc()
    assert np.isnan(model.ground_to_image([[24.4 + 1.6 * 0.034, -33.65, 700.0]])).all()
    assert np.isfinite(model.ground_to_image([[24.4 + 1.4 * 0.034, -33.65, 700.0]])).all()


@pytest.mark.parametrize("turn", [-360.0, 360.0])
def test_antimeridian(turn):
    model = make_rpc(lon_off=179.99)
    ground = box_of(model)
    np.testing.assert_allclose(
        model.ground_to_image(ground + np.array([turn, 0, 0])), model.ground_to_image(ground), rtol=0, atol=1e-6
    )


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"lon_scale": 0.0}, "lon_scale"),
        ({"h_off": np.nan}, "h_off"),
        ({"col_num": [1.0] * 19}, "col_num"),
        ({"row_num": [np.inf] * 20}, "row_num"),
        ({"row_den": [0.0] * 20}, "row_den"),
        ({"col_den": [0.0, 1.0, *[0.0] * 18]}, "col_den"),
    ],
)
def test_degenerate_rpc_is_refused(changes, field):
    with pytest.raises(InputError) as caught:
        make_rpc(**changes)
    assert field in caught.value.field


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [3, COMPILED_FROM])
def test_a_pole_beyond_the_box_and_what_is_behind_it_are_nan_without_a_warning(count):
    model = make_rpc(lon_off=24.5, lon_scale=0.5, col_den=[1.0, -0.8, *[0.0] * 18])
    pole = np.array([[24.5 + scales * 0.5, -33.65, 700.0] for scales in (1.2, 1.25, 1.3)])
    ground = np.repeat(pole, -(-count // 3), axis=0)
    image = model.ground_to_image(ground)
    np.testing.assert_array_equal(np.isfinite(image[:, 0]), ground[:, 0] < 25.125)


@pytest.mark.parametrize("count", [2, COMPILED_FROM])
def test_no_ground_is_found_behind_a_pole_of_one_axis(count):
    """The columns have a pole at y = 1/0.7; behind it the ratios are finite, too."""
    rest = [0.0] * 17
    model = make_rpc(
        col_num=[0.0, 1.0, -0.5, *rest], col_den=[1.0, 0.0, -0.7, *rest],
        row_num=[0.0, 0.2, -1.0, *rest], row_den=[1.0, 0.0, 0.0, *rest],
    )  # fmt: skip
    y, x = np.array([1.40, 1.455]), 0.707
    ratios = np.column_stack([(x - 0.5 * y) / (1.0 - 0.7 * y), 0.2 * x - y])
    image = np.resize(ratios * [model.col_scale, model.row_scale] + [model.col_off, model.row_off], (count, 2))
    ground = model.image_to_ground(image, 700.0)
    np.testing.assert_array_equal(np.isfinite(ground[:, 0]), np.resize([True, False], count))
    np.testing.assert_allclose(ground[::2, 1], model.lat_off + 1.40 * model.lat_scale, atol=1e-9)


def test_heights_are_gated_like_longitude_and_latitude():
    model = make_rpc()
    heights = model.h_off + model.h_scale * np.array([-4.0, -1.51, -1.49, 0.0, 1.49, 1.51, 4.0])
    inside = np.abs(heights - model.h_off) < 1.5 * model.h_scale
    for count in (1, -(-COMPILED_FROM // 7)):
        height = np.repeat(heights, count)
        ground = np.column_stack([np.full((height.size, 2), (model.lon_off, model.lat_off)), height])
        image = np.full((height.size, 2), (model.col_off, model.row_off))
        np.testing.assert_array_equal(np.isfinite(model.ground_to_image(ground)[:, 0]), np.repeat(inside, count))
        np.testing.assert_array_equal(np.isfinite(model.image_to_ground(image, height)[:, 0]), np.repeat(inside, count))
    assert model.height_limits == (model.h_off - 1.5 * model.h_scale, model.h_off + 1.5 * model.h_scale)


def test_correction_is_the_stated_affine_transformation():
    rpc = make_rpc()
    ground = box_of(rpc)
    model = ImageCorrection(rpc, "affine", (5000, 6000), [3.0, 1e-3, -2e-4, -2.0, 3e-4, -1e-3])
    col, row = rpc.ground_to_image(ground).T
    expected = np.stack(
        [col + 3 + 1e-3 * (col - 5000) - 2e-4 * (row - 6000), row - 2 + 3e-4 * (col - 5000) - 1e-3 * (row - 6000)], 1
    )
    np.testing.assert_allclose(model.ground_to_image(ground), expected, atol=1e-9)
    np.testing.assert_allclose(rpc.ground_to_image(ground) @ model.matrix.T + model.offset, expected, atol=1e-8)


def test_a_correction_may_mirror_an_image_but_not_map_it_to_a_line():
    rpc = make_rpc()
    # Columns by 2 and 1, rows by 4 and 2.
    with pytest.raises(InputError, match="cannot be inverted"):
        ImageCorrection(rpc, "affine", (5000, 6000), [0.0, 1.0, 1.0, 0.0, 4.0, 1.0])
    mirror = ImageCorrection(rpc, "affine", (5000, 6000), [0.0, -2.0, 0.0, 0.0, 0.0, 0.0])
    ground = box_of(rpc, 20)
    image = rpc.ground_to_image(ground) * (-1.0, 1.0) + (10_000.0, 0.0)
    np.testing.assert_allclose(mirror.ground_to_image(ground), image, atol=1e-8)
    np.testing.assert_allclose(mirror.image_to_ground(image, ground[:, 2]), ground, atol=1e-9)


def test_unknown_correction_is_refused():
    with pytest.raises(InputError, match="shfit"):
        ImageCorrection.identity(make_rpc(), "shfit", (0, 0))


def test_models_survive_json_without_loss():
    model = ImageCorrection(make_rpc(err_bias=12.5), "affine", (5000.1, 5000), [3.1, 1e-3, -2e-4, -2.0, 3e-4, -1e-3])
    again = model_from_dict(json.loads(json.dumps(model.to_dict())))
    ground = box_of(model)
    np.testing.assert_array_equal(again.ground_to_image(ground), model.ground_to_image(ground))
    assert again.model.err_bias == 12.5


@pytest.mark.parametrize(
    "data", [{}, {"kind": "warp drive"}, {"kind": "rpc"}, {"kind": "rpc", "colour": 3}, {"kind": "image_correction"}]
)
def test_bad_model_data_is_an_input_error(data):
    with pytest.raises(InputError):
        model_from_dict(data)


@dataclass(frozen=True, eq=False)
class Shifted(SensorModel):
    """A map of 10 m pixels that adds its shift (m) to geocentric coordinates, which have rounding errors of 1e-9 m."""

    kind: ClassVar[str] = "test-shifted"
    crs: ClassVar[str] = "EPSG:32636"
    domain: ClassVar = np.array([350e3, 4120e3, 500.0]), np.array([5e3, 5e3, 500.0])
    param_names: ClassVar[tuple[str, ...]] = ("east", "north")
    shift: tuple[float, ...] = (0.0, 0.0)

    @property
    def params(self):
        return np.array(self.shift)

    def with_params(self, params):
        return self._replace(shift=tuple(params))

    def ground_to_image(self, ground):
        far = np.array([6378137.0, -6378137.0])
        ground = np.asarray(ground, dtype=float)
        return (ground[:, :2] + far + self.shift - far - self.domain[0][:2]) / 10 + 0 * ground.sum(axis=1)[:, None]


@pytest.mark.parametrize("value", [0.0, 1e-6, 30.0, 1e7])
def test_slopes_of_parameters_are_right_in_any_unit_and_at_zero(value, monkeypatch):
    model = Shifted((value, value))
    ground = box_of(model, 20)
    np.testing.assert_allclose(model.param_partials(ground), np.broadcast_to(np.eye(2) / 10, (20, 2, 2)), atol=1e-8)
    assert model.param_partials(ground[:0]).shape == (0, 2, 2)
    monkeypatch.setitem(KINDS, Shifted.kind, Shifted)
    check_sensor_model(Shifted(), ground)


def test_slopes_are_right_of_parameters_that_start_as_whole_numbers():
    model = Shifted((0, 0))
    assert model.params.dtype.kind == "i"
    ground = box_of(model, 20)
    np.testing.assert_allclose(model.param_partials(ground), np.broadcast_to(np.eye(2) / 10, (20, 2, 2)), atol=1e-8)


def test_a_point_at_a_seam_of_the_image_does_not_spoil_the_slopes_of_others(monkeypatch):
    """It moves far with any step."""
    plain, model, ground = Shifted.ground_to_image, Shifted((30.0, 30.0)), box_of(Shifted(), 20)
    seam = plain(model, ground[:1])[0, 0]

    def wrapped(self, ground):
        image = plain(self, ground)
        image[image[:, 0] > seam, 0] += 1000.0
        return image

    monkeypatch.setattr(Shifted, "ground_to_image", wrapped)
    partials = model.param_partials(ground)
    np.testing.assert_allclose(partials[1:], np.broadcast_to(np.eye(2) / 10, (19, 2, 2)), atol=1e-3)
