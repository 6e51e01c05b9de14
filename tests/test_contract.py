"""What the host says of a scene that breaks the contract: at once, in one line, and never a traceback."""

from __future__ import annotations

import datetime
import itertools
import json
import math
import types
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline import commands
from ortho_pipeline.errors import InputError, PluginError
from ortho_pipeline.estimation.fit import Prior
from ortho_pipeline.hookspecs import Scene, Sensor, hookimpl
from ortho_pipeline.host import Host
from ortho_pipeline.host.contract import model_faults, sensor_faults
from ortho_pipeline.models import KINDS
from ortho_pipeline.models.base import SensorModel

gdal.UseExceptions()
SIZE = (120, 90)


@dataclass(frozen=True, eq=False)
class Plane(SensorModel):
    """A model that is right, of 10 m pixels; the tests break it."""

    kind: ClassVar[str] = "test-contract"
    shift: float = 0.0
    delay: float = 0.0

    @property
    def crs(self):
        return "EPSG:4979"

    @property
    def domain(self):
        return np.array([12.5, 41.9, 150.0]), np.array([0.01, 0.01, 150.0])

    @property
    def param_names(self):
        return ("shift", "delay")

    @property
    def params(self):
        return np.array([self.shift, self.delay])

    def with_params(self, params):
        return replace(self, shift=float(params[0]), delay=float(params[1]))

    def ground_to_image(self, ground):
        x, y, h = np.asarray(ground, dtype=float).T
        return np.stack([60 + 8000 * (x - 12.5) + 1e-3 * h + self.shift, 45 - 11000 * (y - 41.9) + self.delay], axis=1)


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(KINDS, Plane.kind, Plane)


@pytest.fixture
def image(tmp_path):
    gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), *SIZE)
    return tmp_path / "a.tif"


def host_of(sensor: Sensor) -> Host:
    plugin = types.ModuleType("plugin")
    plugin.ortho_sensors = hookimpl(lambda: [sensor])
    return Host([plugin])


def open_with(image: Path, **fields) -> Scene:
    given = {
        "sensor": "alpha", "path": image, "width": SIZE[0], "height": SIZE[1], "models": {"plane": Plane()},
        "model_source": "flight.json",
    }  # fmt: skip
    sensor = Sensor("alpha", "a test", lambda dataset: True, lambda dataset: Scene(**(given | fields)))
    return host_of(sensor).open_scene(image)


def test_what_keeps_the_contract_opens_with_a_handful_of_projections(image, monkeypatch):
    scene = open_with(image, priors={"shift": Prior(0.0, 1.0)}, model_source=Path("flight.json"))
    # Reports are JSON.
    assert scene.model_source == "flight.json"
    assert list(model_faults(Plane())) == []
    projected = []
    project = Plane.ground_to_image

    def counted(self, ground):
        projected.append(len(ground))
        return project(self, ground)

    monkeypatch.setattr(Plane, "ground_to_image", counted)
    assert list(model_faults(Plane())) == []
    # A plugin's model may take long for a point: three calls, and no more than a few points.
    assert len(projected) <= 3
    assert sum(projected) <= 8


def test_facts_of_a_plugin_become_json(image):
    facts = {"cloud": np.float32(0.5), "file": Path("a.txt"), "time": datetime.date(2026, 3, 1), "sun": math.nan}
    document = commands.info(open_with(image, facts=facts, accuracy=np.float32(5)))
    assert document["facts"] == {"cloud": 0.5, "file": "a.txt", "time": "2026-03-01", "sun": None}
    json.dumps(document, allow_nan=False)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"models": [Plane()]}, "models must map names to at least one model"),
        ({"models": Plane()}, "models must map names to at least one model"),
        ({"models": {"plane": Plane}}, "must be a SensorModel"),
        ({"width": 90, "height": 120}, r"has the size 90 x 120, the file 120 x 90"),
        ({"width": np.int64(120)}, "has the size"),
        ({"model_source": None}, "model_source must name the file or tag .* not None"),
        ({"warnings": "beware"}, "warnings must be a tuple of str, not 'beware'"),
        ({"pieces": ("b.tif",)}, "pieces must be a tuple of Piece"),
        ({"facts": ["a"]}, "facts must be a mapping"),
        ({"models": {1: Plane()}}, "the name of a model must be a text, not 1"),
        ({"accuracy": "5 m"}, "accuracy must be None or a number of metres, not '5 m'"),
        (
            {"priors": {"shiftt": Prior(0, 1)}},
            "the adjusted model has no parameter 'shiftt' for this prior; it has shift, delay",
        ),
        ({"priors": {"shift": 0.1}}, r"the prior of 'shift' must be Prior\(mean, sigma\), not 0.1"),
        ({"priors": [Prior(0, 1)]}, "priors must map parameter names"),
    ],
)
def test_a_wrong_scene_is_named(image, fields, message):
    with pytest.raises(
        PluginError, match=rf"a\.tif: scene: sensor 'alpha' of plugin plugin: .*{message}(.|\n)*check_sensor"
    ):
        open_with(image, **fields)


def fails(self, ground):
    return np.array([self.lens[0] for _ in ground])


def per_point(self, ground):
    x, y, _ = ground
    return np.array([x, y])


def box(low, high):
    return property(lambda self: (np.array(low, dtype=float), np.array(high, dtype=float)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ground_to_image": lambda self, ground: Plane.ground_to_image(self, ground).T},
         r"ground_to_image of 6 points returned shape \(2, 6\); it must be \(6, 2\)"),
        ({"ground_to_image": lambda self, ground: Plane.ground_to_image(self, ground)[:1]},
         r"ground_to_image of 6 points returned shape \(1, 2\); it must be \(6, 2\)"),
        ({"ground_to_image": lambda self, ground: Plane.ground_to_image(self, ground).tolist()}, "return an array"),
        ({"ground_to_image": lambda self, ground: Plane.ground_to_image(self, ground).astype(int)}, "must be float64"),
        ({"ground_to_image": per_point}, r"of 6 points failed .* at test_contract\.py:\d+.* accept arrays \(N, 3\)"),
        ({"ground_to_image": fails}, r"of 6 points failed \(AttributeError: .*'lens' at test_contract\.py:\d+\)"),
        ({"ground_to_image": lambda self, ground: np.nan_to_num(Plane.ground_to_image(self, ground))},
         r"returned \(0, 0\) for a row of NaN"),
        ({"ground_to_image": lambda self, ground: Plane.ground_to_image(self, ground) / 0.0}, "returned inf"),
        ({"domain": Plane.domain.fget}, "domain must be a property with two arrays of 3"),
        ({"domain": ([12.5, 41.9, 0], [1, 1, 1])}, "domain must be a property with two arrays of 3"),
        ({"domain": property(lambda self: 1 / 0)}, "ZeroDivisionError"),
        ({"domain": box([12.5, 41.9, 0], [0.01, 0.01, 0])}, "the half-size .* must be finite"),
        ({"domain": box([12.5, 41.9, np.nan], [0.01, 0.01, 9])}, "must be finite, and the half-size positive"),
        ({"domain": box([12.5, 41.9, 150], [1000, 1000, 150])}, "not in degrees"),
        ({"domain": box([500000, 4600000, 150], [1000, 1000, 150])}, "not in degrees"),
        ({"crs": "EPSG:32633"}, "less than a metre wide"),
        ({"crs": "EPSG:32633", "domain": box([12.5, 41.9, 150.0], [1.0, 1.0, 150.0])}, "a pixel is .* on the ground"),
        ({"crs": 4979}, "crs must be a string"),
        ({"height_range": (5.0, 5.0)}, "height_range"),
        ({"with_params": SensorModel.with_params}, r"with_params\(params\) is missing"),
        ({"params": property(lambda self: np.array([None, 0.0]))}, "params must be an array of 2 finite numbers"),
        ({"params": property(lambda self: np.zeros(3))}, "params must be an array of 2 finite numbers"),
        ({"param_names": "shift"}, "param_names must be a tuple"),
        ({"kind": "test-unregistered"}, r"it must return \{'test-unregistered': Broken\}"),
        ({"to_dict": lambda self: {"kind": "test-contract", "lens": object()}}, "its fields must be JSON values"),
    ],
)  # fmt: skip
def test_a_wrong_model_is_named(image, changes, message):
    broken = type("Broken", (Plane,), {"__module__": __name__, **changes})
    with np.errstate(all="ignore"), pytest.raises(PluginError, match=message):
        open_with(image, models={"plane": broken()})


@dataclass(frozen=True, eq=False)
class WithFile(Plane):
    lens: Path = Path("lens.txt")


def test_a_field_that_json_does_not_hold_is_named(image):
    with pytest.raises(PluginError, match=r"its fields must be JSON values.*Path"):
        open_with(image, models={"plane": WithFile()})


def test_what_a_model_says_itself_passes_with_the_name_of_the_file(image):
    def blind(self):
        raise InputError("this camera does not see the Earth", field="attitude")

    with pytest.raises(InputError, match=r"a\.tif: attitude: this camera does not see"):
        open_with(image, models={"plane": type("Blind", (Plane,), {"domain": property(blind)})()})


def opens(dataset, *, band="1", **others):
    return None


def opens_one(dataset, *, band):
    return None


@pytest.mark.parametrize(
    ("open_scene", "options", "message"),
    [
        (lambda dataset: None, {"band": "which"}, "declares the option 'band', but open_scene does not take it"),
        (lambda dataset, *, band="1": None, {}, "open_scene takes 'band', but the sensor does not declare this option"),
        (opens_one, {"band": "which"}, "needs a default for the option 'band'"),
        (opens, {"band": "which", "other": "what"}, None),
        (opens, {}, "open_scene takes 'band'"),
    ],
)
def test_options_and_arguments_belong_together(open_scene, options, message):
    sensor = Sensor("alpha", "a test", lambda dataset: True, open_scene, options)
    found = list(sensor_faults(sensor))
    assert found == [] if message is None else message in found[0]
    if message:
        with pytest.raises(PluginError, match=message):
            host_of(sensor)


def test_faults_are_short():
    """People read them in a terminal."""
    changes = itertools.chain([{"domain": box([0, 0, 0], [0, 0, 0])}, {"crs": "EPSG:32633"}, {"kind": "test-other"}])
    for change in changes:
        (fault, *_) = model_faults(type("Broken", (Plane,), change)(), {Plane.kind})
        assert len(fault) < 160
