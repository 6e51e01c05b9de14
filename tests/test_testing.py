"""The contract checks find what they are for, and pass what keeps the contract."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import ortho_rpc
import pytest
from osgeo import gdal

from ortho_pipeline.hookspecs import Scene, Sensor
from ortho_pipeline.models import KINDS, RPC, ImageCorrection
from ortho_pipeline.models.base import SensorModel, as_ground
from ortho_pipeline.rpc import rpc_metadata
from ortho_pipeline.testing import check_sensor, check_sensor_model

GROUND = np.array([(x, y, h) for x in (-0.5, 0.0, 0.7) for y in (-0.6, 0.4) for h in (-0.5, 0.9)])


@dataclass(frozen=True, eq=False)
class Plane(SensorModel):
    """A small model that is right; the tests break it."""

    kind: ClassVar[str] = "test-plane"
    scale: float = 100.0

    @property
    def crs(self):
        return "EPSG:4979"

    @property
    def domain(self):
        return np.zeros(3), np.ones(3)

    @property
    def param_names(self):
        return ("scale",)

    @property
    def params(self):
        return np.array([self.scale])

    def with_params(self, params):
        return self._replace(scale=float(params[0]))

    def ground_to_image(self, ground):
        ground = as_ground(ground)
        x, y, h = ground.T
        image = np.stack([self.scale * (x + 0.1 * h + 0.05 * x * y), -self.scale * (y + 0.02 * h)], axis=1)
        image[np.isnan(ground).any(axis=1)] = np.nan
        return image


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(KINDS, Plane.kind, Plane)


def make_rpc() -> RPC:
    rng = np.random.default_rng(5)
    num, den = rng.normal(0, 1e-4, (2, 20)), rng.normal(0, 1e-5, (2, 20))
    num[0, 1], num[1, 2], num[0, 3] = 1.0, -1.0, 0.1
    den[:, 0] = 1.0
    return RPC(
        col_off=1000.5, row_off=800.5, lon_off=24.4, lat_off=-33.6, h_off=700.0, col_scale=1000.0, row_scale=800.0,
        lon_scale=0.1, lat_scale=0.08, h_scale=500.0, col_num=num[0], col_den=den[0], row_num=num[1], row_den=den[1],
    )  # fmt: skip


def test_good_models_pass():
    check_sensor_model(Plane(), GROUND)
    rpc = make_rpc()
    centre, half = rpc.domain
    ground = centre + GROUND * half
    check_sensor_model(rpc, ground)
    corrected = ImageCorrection(rpc, "affine", (1000.0, 800.0), np.array([3.0, 1e-4, -2e-4, -2.0, 1e-4, 3e-4]))
    check_sensor_model(corrected, ground)


def wrong_shape(model, ground):
    return Plane.ground_to_image(model, ground)[:, 0]


def wrong_mean(model, ground):
    image = Plane.ground_to_image(model, ground)
    return image - np.nanmean(image, axis=0) if len(image) else image


def wrong_nan(model, ground):
    return np.nan_to_num(Plane.ground_to_image(model, ground))


def wrong_partials(model, ground):
    return 1.01 * SensorModel.ground_partials(model, ground)


def wrong_param_partials(model, ground):
    return -SensorModel.param_partials(model, ground)


def wrong_inverse(model, image, height):
    return SensorModel.image_to_ground(model, image, height) + np.array([0.01, 0, 0])


def wrong_with_params(model, params):
    return model._replace(scale=model.scale + 1)


def wrong_to_dict(model):
    return SensorModel.to_dict(model) | {"scale": 99.0}


@pytest.mark.parametrize(
    ("method", "wrong", "message"),
    [
        ("ground_to_image", wrong_shape, "returns"),
        ("ground_to_image", wrong_mean, "one at a time"),
        ("ground_to_image", wrong_nan, "row of NaN"),
        ("ground_partials", wrong_partials, "misses a nudge"),
        ("param_partials", wrong_param_partials, "misses a nudge"),
        ("image_to_ground", wrong_inverse, "closes only"),
        ("with_params", wrong_with_params, "with_params"),
        ("to_dict", wrong_to_dict, "to_dict gives another model"),
    ],
)
def test_broken_models_are_found(monkeypatch, method, wrong, message):
    broken = type("Broken", (Plane,), {method: wrong, "kind": "test-broken"})
    monkeypatch.setitem(KINDS, "test-broken", broken)
    with pytest.raises(AssertionError, match=message):
        check_sensor_model(broken(), GROUND)


@pytest.fixture
def image(tmp_path):
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 2000, 1600)
    dataset.SetMetadata(rpc_metadata(make_rpc()), "RPC")
    return tmp_path / "a.tif"


def test_model_that_cannot_be_pickled_is_found(monkeypatch):
    local = type("Local", (Plane,), {"kind": "test-local"})
    monkeypatch.setitem(KINDS, "test-local", local)
    with pytest.raises(AssertionError, match="pickled"):
        check_sensor_model(local(), GROUND)


def test_check_sensor_passes_the_bundled_one(image):
    (sensor,) = ortho_rpc.ortho_sensors()
    assert check_sensor(sensor, image).sensor == "rpc"
    assert check_sensor(sensor, image, rpc="tag").sensor == "rpc"
    with pytest.raises(AssertionError, match="does not declare"):
        check_sensor(sensor, image, band=1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": "other"}, "says it is of sensor"),
        ({"width": 10}, "the size is"),
        ({"models": {}}, "at least one model"),
        ({"model_source": ""}, "file or tag"),
        ({"facts": {"gsd": np.float32(1)}}, "plain JSON"),
        ({"facts": {"gsd": float("nan")}}, "plain JSON"),
    ],
)
def test_check_sensor_finds_wrong_scenes(image, changes, message):
    fields = {
        "sensor": "test", "path": image, "width": 2000, "height": 1600, "models": {"rpc": make_rpc()},
        "model_source": "tag",
    }  # fmt: skip
    sensor = Sensor("test", "a test", lambda dataset: True, lambda dataset: Scene(**(fields | changes)))
    with pytest.raises(AssertionError, match=message):
        check_sensor(sensor, image)
    unrecognised = Sensor("test", "a test", lambda dataset: False, lambda dataset: Scene(**fields))
    with pytest.raises(AssertionError, match="does not recognise"):
        check_sensor(unrecognised, image)
