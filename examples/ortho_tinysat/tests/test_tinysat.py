"""The contract of sensors and models, and one place whose image is known by hand."""

import json

import numpy as np
import ortho_tinysat
import pytest
from osgeo import gdal

from ortho_pipeline.plugin import InputError, geocentric
from ortho_pipeline.testing import check_sensor

gdal.UseExceptions()
LON, LAT, SIZE = 12.5, 41.9, (120, 90)
CAMERA = {
    "position": geocentric(np.array([[LON, LAT, 500e3]]))[0].tolist(),
    # Southwards along the meridian, without rising: 7.5 km/s.
    "velocity": [7500 * np.sin(np.radians(LAT)) * np.cos(np.radians(LON)),
                 7500 * np.sin(np.radians(LAT)) * np.sin(np.radians(LON)), -7500 * np.cos(np.radians(LAT))],
    "pixel_angle": 10 / 500e3,
    "line_period": 10 / 7500,
    "box": [[LON - 0.01, LON + 0.01], [LAT - 0.01, LAT + 0.01], [0.0, 300.0]],
}  # fmt: skip


@pytest.fixture
def scene(tmp_path):
    image = tmp_path / "scene.tif"
    dataset = gdal.GetDriverByName("GTiff").Create(str(image), *SIZE)
    dataset.WriteArray(np.random.default_rng(1).integers(1, 255, SIZE[::-1], dtype=np.uint8))
    dataset = None
    (tmp_path / "scene.tinysat.json").write_text(json.dumps({"acquired": "2026-03-01T10:00:00Z", "camera": CAMERA}))
    return image


@pytest.fixture
def sensor():
    return next(iter(ortho_tinysat.ortho_sensors()))


def test_the_contract(sensor, scene):
    opened = check_sensor(sensor, scene)
    assert opened.facts["acquired"] == "2026-03-01T10:00:00Z"
    # The place below the camera is in the middle.
    middle = opened.model.ground_to_image([[LON, LAT, 0.0]])[0]
    assert middle == pytest.approx([60, 45], abs=1e-6)


def test_the_mounting_is_an_option(sensor, scene):
    rolled = check_sensor(sensor, scene, mounting="0.01").model
    assert rolled.params[0] == pytest.approx(np.radians(0.01))
    with pytest.raises(InputError, match=r"^mounting: 'x' is no angle"):
        sensor.open_scene(gdal.Open(str(scene)), mounting="x")


@pytest.mark.parametrize(
    "damage", [{"position": [1.0, 2.0]}, {"velocity": [1.0, 2.0, float("nan")]}, {"position": None}]
)
def test_a_damaged_flight(sensor, scene, damage):
    flight = scene.with_suffix(".tinysat.json")
    flight.write_text(json.dumps({"camera": CAMERA | damage}))
    with pytest.raises(InputError, match=r"scene\.tinysat\.json"):
        sensor.open_scene(gdal.Open(str(scene)))
    flight.write_text("{}")
    with pytest.raises(InputError, match=r"scene\.tinysat\.json"):
        sensor.open_scene(gdal.Open(str(scene)))
