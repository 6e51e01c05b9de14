"""Requirements on a scene and its models: the fast part of the contract, checked for every opened scene.

A fault is a text that states what was returned and what is required. The host turns the first one into a `PluginError`,
in milliseconds and before hours of warping. `ortho_pipeline.testing` turns it into an `AssertionError`, and tests more.
"""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Collection, Iterator, Mapping
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from ortho_pipeline.errors import OrthoError, described
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.observations.prior import Prior
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import metres_of_steps
from ortho_pipeline.hookspecs import Piece, Scene, Sensor
from ortho_pipeline.models.base import Array, SensorModel

#: Smaller pixels (m) or a narrower scene mean that its ground is not in the units of its CRS.
SMALLEST_PIXEL, NARROWEST = 1e-3, 1.0
#: Parts of the half-size of the domain at which a model is tried, and a row of NaN.
_TRIED = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0, 0, 0.5], [-0.5, -0.5, -0.5], [math.nan] * 3])


def sensor_faults(sensor: object) -> Iterator[str]:
    """Yield the faults of an offered sensor: types of its fields, and arguments of its functions."""
    if not isinstance(sensor, Sensor):
        yield f"ortho_sensors returned {type(sensor).__name__} instead of Sensor"
        return
    if not isinstance(sensor.name, str) or not sensor.name or sensor.name != sensor.name.strip():
        yield f"{sensor.name!r} is not a valid sensor name"
    label = f"sensor {sensor.name!r}"
    if not callable(sensor.recognises) or not callable(sensor.open_scene):
        yield f"{label}: recognises and open_scene must be callable"
    if sensor.metadata_beside is not None and not callable(sensor.metadata_beside):
        yield f"{label}: metadata_beside must be callable"
    if not isinstance(sensor.options, Mapping) or not all(
        isinstance(text, str) for pair in sensor.options.items() for text in pair
    ):
        yield f"{label}: options must map names to help texts"
        return
    yield from (f"{label}: {fault}" for fault in _option_faults(sensor))


def _option_faults(sensor: Sensor) -> Iterator[str]:
    try:
        _, *parameters = inspect.signature(sensor.open_scene).parameters.values()
    except (TypeError, ValueError):
        # A callable without a signature or without arguments; the error comes when it opens a scene.
        return
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        for name in set(sensor.options) - {parameter.name for parameter in parameters}:
            yield f"the sensor declares the option {name!r}, but open_scene does not take it"
    for parameter in parameters:
        if parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL):
            continue
        if parameter.name not in sensor.options:
            yield f"open_scene takes {parameter.name!r}, but the sensor does not declare this option"
        elif parameter.default is parameter.empty:
            yield f"open_scene needs a default for the option {parameter.name!r}"


def scene_faults(
    sensor: Sensor, scene: object, size: tuple[int, int], kinds: Collection[str] | None = None
) -> Iterator[str]:
    """Yield the faults of a scene that `sensor` returned for a dataset of `size` (columns, rows).

    `kinds` are the model families that can be read from files; without them this is not checked. Errors of this package
    that a model raises are passed on.
    """
    if not isinstance(scene, Scene):
        yield f"open_scene returned {type(scene).__name__} instead of a Scene"
        return
    if scene.sensor != sensor.name:
        yield f"the scene names the sensor {scene.sensor!r}, not {sensor.name!r}"
    if (scene.width, scene.height) != size or not isinstance(scene.width, int) or not isinstance(scene.height, int):
        yield (
            f"the scene has the size {scene.width} x {scene.height}, the file {size[0]} x {size[1]} "
            "(width and height must be int)"
        )
    if not isinstance(scene.models, Mapping) or not scene.models:
        yield f"models must map names to at least one model, not {_shown(scene.models)}"
        return
    if not isinstance(scene.model_source, str | Path) or not str(scene.model_source):
        yield f"model_source must name the file or tag with the model, not {scene.model_source!r}"
    for name, kind in (("warnings", str), ("pieces", Piece)):
        items = getattr(scene, name)
        if not isinstance(items, tuple) or not all(isinstance(item, kind) for item in items):
            yield f"{name} must be a tuple of {kind.__name__}, not {_shown(items)}"
    for name in ("facts", "unsuited"):
        if not isinstance(getattr(scene, name), Mapping):
            yield f"{name} must be a mapping, not {_shown(getattr(scene, name))}"
    yield from _accuracy_faults(scene.accuracy)
    for name, model in scene.models.items():
        if not isinstance(name, str) or not name:
            yield f"the name of a model must be a text, not {name!r}"
            return
        if not isinstance(model, SensorModel):
            yield f"model {name!r} must be a SensorModel, not {_shown(model)}"
            return
        yield from (f"model {name!r}: {fault}" for fault in model_faults(model, kinds))
    adjusted = scene.models[scene.adjustable].param_names if scene.adjustable else ()
    yield from _prior_faults(scene.priors, adjusted)


def model_faults(model: SensorModel, kinds: Collection[str] | None = None) -> Iterator[str]:
    """Yield the faults of a model, from a few points of its domain."""
    try:
        yield from _frame_faults(model)
        yield from _parameter_faults(model)
        yield from _file_faults(model, kinds)
    except OrthoError:
        raise
    except Exception as error:
        # The model is foreign code.
        yield f"the model failed ({described(error, type(model))})"
    yield from _mapping_faults(model)


def _frame_faults(model: SensorModel) -> Iterator[str]:
    if not isinstance(model.crs, str):
        yield f"crs must be a string such as 'EPSG:4979', not {_shown(model.crs)}"
    domain = model.domain
    if not _is_pair_of_vectors(domain):
        yield f"domain must be a property with two arrays of 3, (centre, half-size), not {_shown(domain)}"
    centre, half = domain
    if not np.isfinite(domain).all() or not (half > 0).all():
        yield (
            f"the domain has the centre {_row(centre)} and the half-size {_row(half)}; "
            "both must be finite, and the half-size positive"
        )
    crs = parse_crs(model.crs)
    if crs.is_geographic and (abs(centre[1]) > 90 or abs(centre[0]) > 540 or half[0] > 360 or half[1] > 180):
        yield f"the domain {_row(centre)} ± {_row(half)} is not in degrees (lon, lat), the units of {model.crs}"
    if metres_of_steps(crs, centre[None], half[:2]).min() < NARROWEST / 2:
        yield f"the domain {_row(centre)} ± {_row(half)} is less than a metre wide in {model.crs}; check its units"
    low, high = model.height_range
    if not (low < high and low <= model.reference_height <= high):
        yield f"height_range ({low:g}, {high:g}) must increase and contain reference_height {model.reference_height:g}"


def _parameter_faults(model: SensorModel) -> Iterator[str]:
    names, values = model.param_names, model.params
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        yield f"param_names must be a tuple of strings, not {names!r}"
    fits = isinstance(values, np.ndarray) and values.shape == (len(names),) and values.dtype.kind in "fiu"
    if not fits or not np.isfinite(values).all():
        yield (
            f"params must be an array of {counted(len(names), 'finite number')}, one for each name of param_names, "
            f"not {values!r}"
        )
    if len(names) and type(model).with_params is SensorModel.with_params:
        yield "with_params(params) is missing: it must return the model with these parameter values"


def _file_faults(model: SensorModel, kinds: Collection[str] | None) -> Iterator[str]:
    kind, name = getattr(model, "kind", None), type(model).__name__
    if not isinstance(kind, str) or not kind:
        yield f"the class {name} needs a name, such as kind: ClassVar[str] = '...'"
    if kinds is not None and kind not in kinds:
        yield (
            "its model files cannot be read again: add the hook ortho_models to the plugin; it must return "
            f"{{{kind!r}: {name}}}"
        )
    try:
        json.dumps(model.to_dict(), allow_nan=False)
    except (TypeError, ValueError) as error:
        yield f"its fields must be JSON values, arrays or tuples ({error}); for others, write to_dict and from_dict"


def _mapping_faults(model: SensorModel) -> Iterator[str]:
    centre, half = model.domain
    tried = centre + _TRIED * half
    images = []
    for ground in (tried, tried[:1], tried[:0]):
        what = f"ground_to_image of {counted(len(ground), 'point')}"
        try:
            with np.errstate(all="ignore"):
                images.append(model.ground_to_image(ground.copy()))
        except OrthoError:
            raise
        except Exception as error:
            yield f"{what} failed ({described(error, type(model))}); it must accept arrays (N, 3), also with N = 0"
            return
        fault = _array_fault(what, images[-1], len(ground))
        if fault:
            yield fault
            return
    if not np.isnan(images[0][-1]).all():
        yield f"ground_to_image returned {_row(images[0][-1])} for a row of NaN; it must return NaN"
    if np.isinf(images[0]).any():
        yield "ground_to_image returned inf; it must return NaN where there is no image"
    yield from _scale_fault(model, images[0], half / 2)


def _array_fault(what: str, image: object, count: int) -> str | None:
    if not isinstance(image, np.ndarray):
        return f"{what} returned {_shown(image)}; it must return an array of shape ({count}, 2)"
    if image.shape != (count, 2):
        return f"{what} returned shape {image.shape}; it must be ({count}, 2)"
    return None if image.dtype == np.float64 else f"{what} returned {image.dtype}; it must be float64"


def _scale_fault(model: SensorModel, image: Array, step: Array) -> Iterator[str]:
    metres = metres_of_steps(parse_crs(model.crs), model.domain[0][None], step[:2])[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixel = metres / np.linalg.norm(image[1:3] - image[0], axis=1)
    if (pixel < SMALLEST_PIXEL).all():
        yield (
            f"a pixel is only {min(pixel):.1g} m on the ground. Either ground_to_image does not take its ground in "
            f"{model.crs}, or domain is not (centre, half-size)"
        )


def _accuracy_faults(accuracy: object) -> Iterator[str]:
    if accuracy is not None and not (isinstance(accuracy, Real) and 0 <= float(accuracy) < math.inf):
        yield f"accuracy must be None or a number of metres, not {_shown(accuracy)}"


def _prior_faults(priors: object, names: tuple[str, ...]) -> Iterator[str]:
    if not isinstance(priors, Mapping):
        yield f"priors must map parameter names to Prior(mean, sigma), not {_shown(priors)}"
        return
    for name, prior in priors.items():
        if name not in names:
            yield f"the adjusted model has no parameter {name!r} for this prior; it has {', '.join(names) or 'none'}"
        if not isinstance(prior, Prior):
            yield f"the prior of {name!r} must be Prior(mean, sigma), not {_shown(prior)}"


def _is_pair_of_vectors(domain: Any) -> bool:
    return (
        isinstance(domain, tuple)
        and len(domain) == 2
        and all(
            isinstance(vector, np.ndarray) and vector.shape == (3,) and vector.dtype.kind in "fiu" for vector in domain
        )
    )


def _shown(value: object) -> str:
    """Return a short description of a value."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    text = repr(value)
    return text if len(text) < 60 and not callable(value) else f"a {type(value).__name__}"


def _row(values: Array) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
