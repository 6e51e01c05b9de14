"""The contract of sensor models and sensors, as checks for tests: ours and those of plugin authors.

::

    def test_tinysat(tmp_path):
        scene = check_sensor(next(iter(tinysat_plugin.ortho_sensors())), "tests/data/tinysat.tif")
        assert scene.facts["band"] == 1

Every check raises `AssertionError` with the requirement of the contract.
"""

from __future__ import annotations

import json
import pickle
import tempfile
from collections.abc import Iterator
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import described
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.hookspecs import Scene, Sensor
from ortho_pipeline.host.contract import model_faults, scene_faults, sensor_faults
from ortho_pipeline.models import KINDS, SensorModel, model_from_dict
from ortho_pipeline.models.base import as_ground

#: Image to ground and back must close within this (pixels).
CLOSURE = 1e-5
#: Partial derivatives must agree with finite differences, relative to the largest one.
PARTIALS = 2e-5
#: Largest distance of a domain from its image, in image sizes: a crop may have the domain of the whole scene.
WIDEST = 20.0
#: Images smaller than this (pixels) are tests, with larger domains.
_SMALL = 1000


def check_sensor_model(model: SensorModel, ground: ArrayLike) -> None:
    """Check that a sensor model keeps the contract.

    It checks: shapes; N points give the same as N single points; rows of NaN stay NaN and do not change others; distant
    points raise nothing; image to ground and back closes; `ground_partials` and `param_partials` agree with finite
    differences; `with_params` and `to_dict` restore the same model and its domain; pickling works; heights
    of `crs` are ellipsoidal; `corners` are near `domain`.

    Parameters
    ----------
    model : SensorModel
    ground : (N, 3)
        At least 3 points in `model.crs` (EPSG:4979: lon, lat, ellipsoidal height), within its domain and at different
        heights.

    Raises
    ------
    AssertionError
    """
    points = as_ground(ground)
    assert len(points) >= 3, "give at least 3 ground points"
    _assert_none(model_faults(model))
    image = _check_mapping(model, points)
    _check_far(model)
    _check_closure(model, points, image)
    _check_ground_partials(model, points)
    _check_params(model, points, image)
    _check_statements(model, points, image)
    _check_copies(model, points, image)


def check_sensor(sensor: Sensor, path: str | PathLike[str], **options: Any) -> Scene:
    """Check that a sensor recognises and opens `path`, and that every model of the scene keeps the contract.

    The sensor must recognise neither a raster in memory nor a TIFF without other files. The domain of its models must
    be near the image, and the middle of the image must have ground.

    Parameters
    ----------
    sensor : Sensor
    path : path
        A file of this sensor.
    **options
        Options of the sensor. With options, the sensor need not recognise the file.

    Returns
    -------
    Scene
        For further checks, such as of its facts.

    Raises
    ------
    AssertionError
    """
    # Imported here, because models and estimation are tested without GDAL.
    from ortho_pipeline.raster.source import open_dataset

    _assert_none(sensor_faults(sensor))
    assert sensor.name == sensor.name.lower().strip(), f"{sensor.name!r}: names must be lower case, without blanks"
    assert sensor.description.strip(), "a sensor needs a description"
    assert all(text.strip() for text in sensor.options.values()), "every option needs a line of help"
    undeclared = set(options) - set(sensor.options)
    assert not undeclared, f"the sensor does not declare the options {sorted(undeclared)}"
    dataset = open_dataset(path)
    recognised = sensor.recognises(dataset)
    assert isinstance(recognised, bool), f"recognises must return True or False, not {recognised!r}"
    assert recognised or options, f"the sensor does not recognise {path}"
    _check_foreign(sensor)
    scene = sensor.open_scene(dataset, **options)
    _check_scene(sensor, scene, dataset)
    return scene


def _check_scene(sensor: Sensor, scene: Scene, dataset: Any) -> None:
    size = dataset.RasterXSize, dataset.RasterYSize
    _assert_none(scene_faults(sensor, scene, size))
    try:
        json.dumps(dict(scene.facts), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AssertionError(f"facts must be plain JSON values: {error}") from error
    for model in scene.models.values():
        _check_near(model, size)
        check_sensor_model(model, _points_in(model))


def _assert_none(faults: Iterator[str]) -> None:
    fault = next(faults, None)
    assert fault is None, fault


def _check_foreign(sensor: Sensor) -> None:
    """Check that a sensor does not recognise datasets that are clearly not its own."""
    from osgeo import gdal

    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "foreign.tif"))
        foreign = {"MEM": "a raster in memory (without a file name)", "GTiff": "a TIFF without other files"}
        for driver, what in foreign.items():
            dataset = gdal.GetDriverByName(driver).Create("" if driver == "MEM" else path, 4, 4)
            try:
                recognised = sensor.recognises(dataset)
            except Exception as error:
                text = described(error, sensor.recognises)
                raise AssertionError(
                    f"recognises failed for {what} ({text}); it must return False, not raise an exception"
                ) from error
            assert not recognised, f"recognises returns {recognised!r} for {what}, which is not from this sensor"
            dataset = None


def _check_near(model: SensorModel, size: tuple[int, int]) -> None:
    """Check that domain and image are at the same place: a domain in other units is the most common mistake."""
    rule = "domain must be (centre, half-size), not (low, high), in the units of crs and x (longitude) first"
    image = model.ground_to_image(_points_in(model))
    middle = np.array(size) / 2
    apart = np.abs((image - middle) / np.maximum(size, _SMALL)).max(axis=1)
    assert np.isfinite(apart).any(), f"the model projects no point of its domain into the image; {rule}"
    assert np.nanmin(apart) <= WIDEST, f"the domain is {np.nanmin(apart):.0f} image sizes away from the image; {rule}"
    assert np.nanmax(apart) <= WIDEST, f"the domain extends {np.nanmax(apart):.0f} image sizes beyond the image; {rule}"
    ground = model.image_to_ground(middle[None], model.reference_height)
    assert np.isfinite(ground).all(), (
        f"the middle of the image has no ground within the domain at the height {model.reference_height:g} m; {rule}"
    )


def _points_in(model: SensorModel) -> NDArray[np.float64]:
    """Return 27 points in the inner part of a model's domain."""
    centre, half = model.domain
    signs = np.stack(np.meshgrid(*[(-0.7, 0.1, 0.8)] * 3), axis=-1).reshape(-1, 3)
    return centre + signs * half


def _check_statements(model: SensorModel, ground: NDArray[np.float64], image: NDArray[np.float64]) -> None:
    """Check what a model states about itself, and that it stays the same model for its own range of heights."""
    crs = parse_crs(model.crs)
    declared = declared_vertical(crs)
    assert declared is None or (declared.vertical is not None and declared.vertical.is_ellipsoid), (
        f"crs {model.crs!r} has heights above a geoid, but ground_to_image always gets ellipsoidal heights; return the "
        "horizontal CRS, and convert heights in the model"
    )
    centre, half = model.domain
    corners = np.asarray(model.corners)
    assert corners.shape[1:] == (3,), f"corners must be ground points (N, 3), not {corners.shape}"
    beside = corners - centre
    if crs.is_geographic:
        beside[:, 0] -= 360 * np.round(beside[:, 0] / 360)
    apart = np.abs(beside / half)
    assert not (apart > 2).any(), f"corners are {np.nanmax(apart):.0f} half-sizes of the domain away from its centre"
    low, high = model.height_range
    least, most = model.height_limits
    assert least <= low < high <= most, f"height_limits ({least:g}, {most:g}) must contain height_range"
    assert model.detail > 0, f"detail must be a positive number of pixels, not {model.detail!r}"
    accuracy = model.stated_accuracy
    assert accuracy is None or (isinstance(accuracy, Real) and 0 <= float(accuracy) < np.inf), (
        f"stated_accuracy must be None or a number of metres, not {accuracy!r}"
    )
    _check_copy(model.with_heights(low, high), model, ground, image, "with_heights")


def _check_mapping(model: SensorModel, ground: NDArray[np.float64]) -> NDArray[np.float64]:
    image = model.ground_to_image(ground)
    n = len(ground)
    assert isinstance(image, np.ndarray), f"ground_to_image must return an array, not {type(image).__name__}"
    assert image.shape == (n, 2), f"ground_to_image of {counted(n, 'point')} must return ({n}, 2), not {image.shape}"
    assert image.dtype == np.float64, f"image points must be float64, not {image.dtype}"
    assert np.isfinite(image).all(), f"the model does not project {np.isnan(image).any(axis=1).sum()} of the points"
    singles = np.concatenate([model.ground_to_image(point[None]) for point in ground])
    worst = np.abs(singles - image).max()
    assert worst < 1e-7, f"{n} points together and each alone differ by {worst:g} px"
    assert model.ground_to_image(np.empty((0, 3))).shape == (0, 2), "for no points, the result must be empty (0, 2)"
    holed = ground.copy()
    for axis in range(3):
        holed[axis, axis] = np.nan
    result = model.ground_to_image(holed)
    assert np.isnan(result[:3]).all(), "a point with a NaN coordinate must project to a row of NaN"
    assert np.allclose(result[3:], image[3:], rtol=0, atol=1e-7), "a NaN in one point changes other points"
    before = ground.copy()
    model.ground_to_image(ground)
    assert np.array_equal(before, ground), "ground_to_image changes its argument"
    lo, hi = model.height_range
    assert lo < hi, f"height_range must increase, not go from {lo} to {hi}"
    assert lo <= model.reference_height <= hi, "reference_height must be within height_range"
    return image


def _check_far(model: SensorModel) -> None:
    """Check that ground far from the scene and image points far from the image give results or NaN."""
    centre, half = model.domain
    far = centre + 1000 * half * np.concatenate([np.eye(3), -np.eye(3)])
    for name, method, points in (
        ("ground_to_image", model.ground_to_image, far),
        (
            "image_to_ground",
            lambda image: model.image_to_ground(image, model.reference_height),
            1e7 * np.array([[1.0, 1.0], [-1.0, -1.0]]),
        ),
    ):
        try:
            with np.errstate(all="ignore"):
                result = method(points)
        except Exception as error:
            raise AssertionError(
                f"{name} of distant points failed ({described(error, type(model))}); it must return NaN there"
            ) from error
        assert not np.isinf(result).any(), f"{name} of distant points returned inf; it must return NaN there"


def _check_closure(model: SensorModel, ground: NDArray[np.float64], image: NDArray[np.float64]) -> None:
    given = image.copy()
    back = model.image_to_ground(given, ground[:, 2])
    assert np.array_equal(given, image), "image_to_ground changes its argument"
    assert back.shape == ground.shape, f"image_to_ground must return {ground.shape}, not {back.shape}"
    assert np.isfinite(back).all(), (
        f"{counted(np.isnan(back).any(axis=1).sum(), 'point has', 'points have')} no inverse"
    )
    assert np.array_equal(back[:, 2], ground[:, 2]), "image_to_ground must return the given heights"
    worst = np.abs(model.ground_to_image(back) - image).max()
    assert worst < CLOSURE, f"image to ground and back differs by {worst:g} px; at most {CLOSURE:g} px are allowed"
    level = model.image_to_ground(image, float(ground[0, 2]))
    assert np.array_equal(level, model.image_to_ground(image, np.full(len(image), ground[0, 2])), equal_nan=True), (
        "image_to_ground with one height must be the same as with that height for each point"
    )
    # A second solution for the same image point would also close.
    apart = np.abs((back - ground) / model.domain[1]).max()
    assert apart < 1e-6, f"image_to_ground returned another point, {apart:g} half-sizes of the domain away"
    broken = image.copy()
    broken[0, 0] = np.nan
    result = model.image_to_ground(broken, ground[:, 2])
    assert np.isnan(result[0]).all(), "the ground of an image point with NaN must be a row of NaN"
    assert np.isfinite(result[1:]).all(), "a NaN in one image point changes other points"


def _check_ground_partials(model: SensorModel, ground: NDArray[np.float64]) -> None:
    partials = model.ground_partials(ground)
    assert partials.shape == (len(ground), 2, 3), f"ground_partials must return (N, 2, 3), not {partials.shape}"
    image, also = model.projected(ground)
    _assert_close(image, model.ground_to_image(ground), 1e-12, 0.0, "projected must return ground_to_image")
    _assert_close(also, partials, 1e-9, 1e-12, "projected must return ground_partials")
    _, half = model.domain
    for axis, step in enumerate(1e-4 * half):
        nudge = np.zeros(3)
        nudge[axis] = step
        moved = (model.ground_to_image(ground + nudge) - model.ground_to_image(ground - nudge)) / 2
        what = f"ground_partials (over 1e-4 of the domain) along axis {axis}"
        _assert_predicts(partials[:, :, axis] * step, moved, what, model.ground_to_image(ground))


def _check_params(model: SensorModel, ground: NDArray[np.float64], image: NDArray[np.float64]) -> None:
    params = np.asarray(model.params, dtype=np.float64)
    n = len(model.param_names)
    assert params.shape == (n,), f"params has the shape {params.shape}, but there are {n} param_names"
    assert len(set(model.param_names)) == n, "a name appears twice in param_names"
    same = model.with_params(params)
    assert np.array_equal(same.params, params), "with_params(params) does not give the parameters back"
    assert np.allclose(same.ground_to_image(ground), image, rtol=0, atol=1e-9), "with_params(params) is another model"
    _check_box(same, model, "with_params")
    partials = model.param_partials(ground)
    assert partials.shape == (len(ground), 2, n), f"param_partials must return (N, 2, {n}), not {partials.shape}"
    shared = model.linearised(ground)
    _assert_close(shared[0], model.ground_to_image(ground), 1e-12, 0.0, "linearised must return ground_to_image")
    _assert_close(shared[2], partials, 1e-9, 1e-12, "linearised must return param_partials")
    for k, name in enumerate(model.param_names):
        reach = np.abs(partials[:, :, k]).max()
        assert reach > 0, f"the parameter {name!r} moves no point"
        # A hundredth of a pixel: small enough to be linear, large enough to exceed rounding.
        step = np.zeros(n)
        step[k] = 0.01 / reach
        ahead, behind = model.with_params(params + step), model.with_params(params - step)
        moved = (ahead.ground_to_image(ground) - behind.ground_to_image(ground)) / 2
        _assert_predicts(partials[:, :, k] * step[k], moved, f"param_partials of {name!r}", image)
    _check_order(model, params, partials)
    assert np.array_equal(model.params, params), "with_params changes the model itself"


def _check_order(model: SensorModel, params: NDArray[np.float64], partials: NDArray[np.float64]) -> None:
    """Check that `with_params` takes values in the order of `params`, with values that all differ."""
    steps = 0.01 * np.arange(1, len(params) + 1) / np.abs(partials).max(axis=(0, 1), initial=0.0)
    values = model.with_params(params + steps).params
    assert (np.abs(values - params - steps) <= 1e-6 * steps + 1e-15 * np.abs(params)).all(), (
        "with_params(values).params differ from values; values are in the order of param_names"
    )


def _assert_close(
    values: NDArray[np.float64], wanted: NDArray[np.float64], relative: float, absolute: float, rule: str
) -> None:
    assert np.shape(values) == wanted.shape, f"{rule}: shape {wanted.shape}, not {np.shape(values)}"
    assert np.allclose(values, wanted, rtol=relative, atol=absolute, equal_nan=True), (
        f"{rule}: it differs by {np.nanmax(np.abs(values - wanted)):g}"
    )


def _assert_predicts(
    predicted: NDArray[np.float64], moved: NDArray[np.float64], what: str, image: NDArray[np.float64]
) -> None:
    miss = np.abs(predicted - moved).max()
    # Image coordinates of about 1e5 px have rounding errors of 1e-9 px.
    allowed = PARTIALS * np.abs(moved).max() + 1e-8 * max(1.0, np.abs(image).max() / 1e5)
    assert miss <= allowed, f"{what} differs from finite differences by {miss:g} px (allowed {allowed:g})"


def _check_copies(model: SensorModel, ground: NDArray[np.float64], image: NDArray[np.float64]) -> None:
    data = model.to_dict()
    assert data.get("kind") == model.kind, f"kind is {data.get('kind')!r} in to_dict, but {model.kind!r} in the class"
    try:
        text = json.dumps(data, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise AssertionError(f"to_dict must be plain JSON values: {error}") from error
    if data["kind"] not in KINDS:
        # A kind of a plugin is known after the plugin is found.
        from ortho_pipeline.host import Host

        Host.discover()
    _check_copy(model_from_dict(json.loads(text)), model, ground, image, "to_dict")
    try:
        pickled = pickle.loads(pickle.dumps(model))
    except (pickle.PickleError, AttributeError, TypeError) as error:
        raise AssertionError(f"the model cannot be pickled, which other processes need: {error}") from error
    _check_copy(pickled, model, ground, image, "pickle")


def _check_copy(
    copy: SensorModel, model: SensorModel, ground: NDArray[np.float64], image: NDArray[np.float64], how: str
) -> None:
    assert type(copy) is type(model), f"{how} returns a {type(copy).__name__}"
    assert np.array_equal(copy.ground_to_image(ground), image), f"{how} returns another model"
    _check_box(copy, model, how)
    assert np.array_equal(copy.params, model.params), f"{how} returns a model with other parameters"


def _check_box(copy: SensorModel, model: SensorModel, how: str) -> None:
    assert copy.crs == model.crs, f"{how} returns a model with the crs {copy.crs!r}, not {model.crs!r}"
    assert np.allclose(copy.domain, model.domain, rtol=1e-9, atol=0), f"{how} returns a model with another domain"
