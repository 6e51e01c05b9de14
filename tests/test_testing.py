"""The contract checks find what they are for, and pass what keeps the contract."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import ortho_rpc
import pytest
from osgeo import gdal

from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.hookspecs import Scene, Sensor
from ortho_pipeline.models import KINDS, RPC, ImageCorrection
from ortho_pipeline.models.base import SensorModel, as_ground
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


@pytest.mark.parametrize(("names", "points"), [(0, 0), (1, 1), (2, 1), (3, 2), (9, 5)])
def test_a_point_gives_two_equations(monkeypatch, names, points):
    monkeypatch.setattr(Plane, "param_names", tuple("abcdefghi"[:names]))
    assert Plane().minimum_points == points


def wrong_shape(model, ground):
    return Plane.ground_to_image(model, ground)[:, 0]


def wrong_mean(model, ground):
    image = Plane.ground_to_image(model, ground)
    return image - np.nanmean(image, axis=0) if len(image) else image


def wrong_nan(model, ground):
    return np.nan_to_num(Plane.ground_to_image(model, ground))


def wrong_far_away(model, ground):
    return np.where(
        np.abs(ground).max(axis=1, initial=0.0, keepdims=True) > 9, np.inf, Plane.ground_to_image(model, ground)
    )


def fails_far_away(model, ground):
    return Plane.ground_to_image(model, ground) if not (np.abs(ground) > 9).any() else 1 / 0


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
        ("ground_to_image", wrong_shape, "returned shape"),
        ("ground_to_image", wrong_mean, "together and each alone"),
        ("ground_to_image", wrong_nan, "row of NaN"),
        ("ground_partials", wrong_partials, "differs from finite differences"),
        ("param_partials", wrong_param_partials, "differs from finite differences"),
        ("image_to_ground", wrong_inverse, "to ground and back differs"),
        ("ground_to_image", wrong_far_away, "distant points returned inf"),
        ("ground_to_image", fails_far_away, r"distant points failed \(ZeroDivisionError.*must return NaN"),
        ("with_params", wrong_with_params, "with_params"),
        ("to_dict", wrong_to_dict, "to_dict returns another model"),
    ],
)
def test_broken_models_are_found(monkeypatch, method, wrong, message):
    broken = type("Broken", (Plane,), {method: wrong, "kind": "test-broken"})
    monkeypatch.setitem(KINDS, "test-broken", broken)
    with pytest.raises(AssertionError, match=message):
        check_sensor_model(broken(), GROUND)


def other_box(model, *args):
    return Boxed(half=0.5)


@dataclass(frozen=True, eq=False)
class Boxed(Plane):
    """A plane whose domain is a field."""

    kind: ClassVar[str] = "test-boxed"
    half: float = 1.0

    @property
    def domain(self):
        return np.zeros(3), np.full(3, self.half)


def height_of_one(model, image, height):
    return SensorModel.image_to_ground(model, image, height if np.ndim(height) else height + 0.01)


def changes_its_argument(model, image, height):
    back = SensorModel.image_to_ground(model, image, height)
    image[:] = 0.0
    return back


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"with_params": other_box}, "with_params returns a model with another domain"),
        ({"from_dict": classmethod(other_box)}, "to_dict returns a model with another domain"),
        ({"with_heights": other_box}, "with_heights returns a model with another domain"),
        ({"with_heights": lambda model, low, high: None}, "with_heights returns a NoneType"),
        ({"crs": "EPSG:4326+5773"}, "has heights above a geoid"),
        ({"image_to_ground": height_of_one}, "the same as with that height for each point"),
        ({"image_to_ground": changes_its_argument}, "image_to_ground changes its argument"),
        ({"corners": np.array([[0.0, 0.0], [100.0, 100.0]])}, r"corners must be ground points \(N, 3\)"),
        ({"corners": np.array([[100.0, 100.0, 0.0]])}, "corners are 100 half-sizes"),
        ({"height_limits": (0.0, 1.0)}, "height_limits .* must contain height_range"),
        ({"detail": 0.0}, "detail must be a positive number"),
        ({"stated_accuracy": "3 m"}, "stated_accuracy must be None or a number"),
    ],
)
def test_what_a_model_states_besides_its_map_is_checked(monkeypatch, changes, message):
    monkeypatch.setitem(KINDS, Boxed.kind, Boxed)
    check_sensor_model(Boxed(), GROUND)
    for name, value in changes.items():
        monkeypatch.setattr(Boxed, name, value)
    with pytest.raises(AssertionError, match=message):
        check_sensor_model(Boxed(), GROUND)


@dataclass(frozen=True, eq=False)
class Stretched(Plane):
    """A plane with another scale in y, whose parameters come in the wrong order."""

    kind: ClassVar[str] = "test-stretched"
    other: float = 100.0

    @property
    def param_names(self):
        return ("scale", "other")

    @property
    def params(self):
        return np.array([self.scale, self.other])

    def with_params(self, params):
        return self._replace(scale=float(params[1]), other=float(params[0]))

    def ground_to_image(self, ground):
        return Plane.ground_to_image(self, ground) * [1.0, self.other]


def test_parameters_in_another_order_are_found_where_their_values_are_equal(monkeypatch):
    monkeypatch.setitem(KINDS, "test-stretched", Stretched)
    with pytest.raises(AssertionError, match="order of param_names"):
        check_sensor_model(Stretched(), GROUND)


@pytest.fixture
def image(tmp_path):
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 2000, 1600)
    dataset.SetMetadata(rpc_metadata(make_rpc()), "RPC")
    return tmp_path / "a.tif"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_an_rpc_whose_slope_is_wrong_by_a_ten_thousandth_is_found(monkeypatch, axis):
    def projected(model, ground):
        image, partials = RPC.projected(model, ground)
        return image, partials * (1 + 1e-4 * np.eye(3)[axis])

    wrong = {"projected": projected, "ground_partials": lambda model, ground: projected(model, ground)[1]}
    broken = type("Broken", (RPC,), {**wrong, "kind": "test-broken"})
    monkeypatch.setitem(KINDS, "test-broken", broken)
    rpc = make_rpc()
    centre, half = rpc.domain
    with pytest.raises(AssertionError, match=f"along axis {axis} differs from finite differences"):
        check_sensor_model(broken.from_dict(rpc.to_dict()), centre + GROUND * half)


def test_model_that_cannot_be_pickled_is_found(monkeypatch):
    local = type("Local", (Plane,), {"kind": "test-local"})
    monkeypatch.setitem(KINDS, "test-local", local)
    with pytest.raises(AssertionError, match="pickled"):
        check_sensor_model(local(), GROUND)


def test_check_sensor_passes_the_bundled_one(image):
    sensor = next(sensor for sensor in ortho_rpc.ortho_sensors() if sensor.name == "rpc")
    assert check_sensor(sensor, image).sensor == "rpc"
    assert check_sensor(sensor, image, rpc="tag").sensor == "rpc"
    with pytest.raises(AssertionError, match="does not declare"):
        check_sensor(sensor, image, band=1)


def is_large(dataset):
    return dataset.RasterXSize == 2000


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": "other"}, "names the sensor"),
        ({"width": 10}, "has the size"),
        ({"models": {}}, "at least one"),
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
    sensor = Sensor("test", "a test", is_large, lambda dataset: Scene(**(fields | changes)))
    with pytest.raises(AssertionError, match=message):
        check_sensor(sensor, image)
    eager = Sensor("test", "a test", lambda dataset: True, lambda dataset: Scene(**fields))
    with pytest.raises(AssertionError, match="True for a raster in memory"):
        check_sensor(eager, image)
    named = Sensor("test", "a test", lambda dataset: bool(dataset.GetDescription()), lambda dataset: Scene(**fields))
    with pytest.raises(AssertionError, match="True for a TIFF without other files"):
        check_sensor(named, image)
    failing = Sensor("test", "a test", lambda dataset: is_large(dataset) or 1 / 0 > 0, lambda dataset: Scene(**fields))
    with pytest.raises(
        AssertionError, match=r"failed .*ZeroDivisionError.*at test_testing.py:\d+\); it must return False"
    ):
        check_sensor(failing, image)
    unrecognised = Sensor("test", "a test", lambda dataset: False, lambda dataset: Scene(**fields))
    with pytest.raises(AssertionError, match="does not recognise"):
        check_sensor(unrecognised, image)


@dataclass(frozen=True, eq=False)
class Place(Plane):
    """A plane of 10,000 px per degree, whose middle (1000, 800) is at 12.5, 41.9."""

    kind: ClassVar[str] = "test-place"
    centre: tuple[float, ...] = (12.5, 41.9, 150.0)
    half: tuple[float, ...] = (0.1, 0.08, 150.0)
    scale: float = 1e4

    @property
    def domain(self):
        return np.array(self.centre), np.array(self.half)

    def ground_to_image(self, ground):
        image = Plane.ground_to_image(self, as_ground(ground) * [1, 1, 1e-5] - [12.5, 41.9, 0])
        return image + np.array([1000.0, 800.0])


@pytest.mark.parametrize(
    ("centre", "half", "message"),
    [
        # Low and high, in place of centre and half-size.
        ((12.4, 41.82, 0.0), (12.6, 41.98, 300.0), "the domain is .* image sizes away"),
        ((12.5, 41.9, 150.0), (10.0, 8.0, 150.0), "the domain extends .* image sizes beyond"),
        ((41.9, 12.5, 150.0), (0.08, 0.1, 150.0), "the domain is .* image sizes away"),
        ((12.9, 41.9, 150.0), (0.1, 0.08, 150.0), "the middle of the image has no ground"),
    ],
)
def test_a_domain_elsewhere_is_named(image, monkeypatch, centre, half, message):
    monkeypatch.setitem(KINDS, Place.kind, Place)

    def sensor(model):
        return Sensor("test", "a test", is_large, lambda dataset: Scene("test", image, 2000, 1600, {"a": model}, "tag"))

    check_sensor(sensor(Place()), image)
    with pytest.raises(AssertionError, match=rf"{message}.*\(centre, half-size\), not \(low, high\)"):
        check_sensor(sensor(Place(centre=centre, half=half)), image)
