"""Orthority's files: cameras as YAML or JSON, and orientations as GeoJSON, in its own conventions.

Focal lengths are in the unit of ``sensor_size``, or parts of the longer side; principal points are parts of the longer
side from the middle, y down. Positions and angles refer to the axes of ``world_crs``; angles are radians.

Source: orthority's documentation, "Orthority interior parameters" and "Orthority exterior parameters".
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from ortho_frame.fields import DISTORTION_KEYS, interior_of, number
from ortho_frame.pose import Pose
from ortho_pipeline.plugin import InputError, Interior, counted, read_bounded, read_json

MAX_YAML = 200_000
_DEPTH, _EVENTS = 10, 20_000
#: Coefficients of the type ``opencv`` that Brown's model lacks.
_MORE = ("k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
_TYPES = ("pinhole", "brown", "opencv")


def is_camera(document: Any) -> bool:
    """Return whether a document has cameras in orthority's form."""
    return (
        isinstance(document, dict)
        and bool(document)
        and all(isinstance(one, dict) and "im_size" in one and "type" in one for one in document.values())
    )


def read_yaml(path: str | PathLike[str]) -> Any:
    """Return the document of a small YAML file; aliases and deep nesting are refused before values are made."""
    import yaml

    data = read_bounded(path, MAX_YAML, remedy="check the path")
    if len(data) > MAX_YAML:
        raise InputError("a camera file has no more than 200 kB", file=path)
    depth = 0
    try:
        text = data.decode("utf-8-sig")
        for count, event in enumerate(yaml.parse(text, yaml.SafeLoader)):
            opens, closes = (isinstance(event, kind) for kind in (yaml.CollectionStartEvent, yaml.CollectionEndEvent))
            depth += opens - closes
            if depth > _DEPTH or count > _EVENTS or isinstance(event, yaml.AliasEvent):
                raise InputError("a camera file has no aliases, and few levels and entries", file=path)
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        raise InputError(f"this is not YAML ({problem})", file=path) from error


def camera_of(path: str | PathLike[str], document: Mapping[str, Any], name: str | None) -> Interior:
    """Return the camera of a document; `name` chooses among several.

    Raises
    ------
    InputError
        For a lens that the model of frames cannot represent exactly, and for wrong values.
    """
    cameras = {name: document[name]} if name in document else dict(document)
    if len(cameras) != 1:
        raise InputError(
            f"this file has {counted(len(cameras), 'camera')}, and the orientations do not say which took this image",
            file=path,
            field="camera",
            remedy="give a file with one camera",
        )
    ((label, camera),) = cameras.items()
    kind = camera.get("type")
    more = [key for key in _MORE if kind == "opencv" and camera.get(key, 0) != 0]
    if kind not in _TYPES or more:
        lens = f"the coefficients {', '.join(more)}" if more else f"the lens type {str(kind)[:40]!r}"
        raise InputError(
            f"{lens} cannot be represented exactly",
            file=path,
            field=f"{label}.type",
            remedy="use pinhole, brown, or opencv with k1, k2, p1, p2, k3 only",
        )
    width, height = _two(path, f"{label}.im_size", camera["im_size"])
    focal = camera.get("focal_len")
    x, y = _two(path, f"{label}.focal_len", focal if isinstance(focal, list) else [focal, focal])
    longer = max(width, height)
    sensor = camera.get("sensor_size")
    across, down = (longer, longer) if sensor is None else _two(path, f"{label}.sensor_size", sensor)
    if sensor is not None:
        across, down = across / width if across > 0 else math.nan, down / height if down > 0 else math.nan
        x, y = x / across, y / down
    else:
        x, y = x * longer, y * longer
    if not (x > 0 and y > 0):
        raise InputError("focal length and size must be positive", file=path, field=f"{label}.focal_len")
    cx, cy = (number(path, f"{label}.{key}", camera.get(key, 0.0)) * longer for key in ("cx", "cy"))
    lens = {key: number(path, f"{label}.{key}", camera.get(key, 0.0)) for key in DISTORTION_KEYS}
    # Pixels of 1 um; different focal lengths of the axes are different pitches, and y points up here.
    pitch = 1e-6 * x / y
    return interior_of(path, width, height, x * 1e-6, 1e-6, pitch, x0=cx * 1e-6, y0=-cy * pitch, **lens)


def pose_in(path: str | PathLike[str], image: Path) -> Pose:
    """Return the pose of an image in a GeoJSON file of orientations."""
    document = read_json(path, 200_000_000, "write it again with orthority", unique=True)
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError("this is no GeoJSON of orthority's orientations", file=path, field="features")
    found = [
        (index, own)
        for index, one in enumerate(features)
        if isinstance(one, dict) and isinstance(own := one.get("properties"), dict)
        if own.get("filename") in (image.name, image.stem)
    ]
    if len(found) != 1:
        what = "appears twice" if found else "is not in this file"
        raise InputError(f"the image {image.name} {what}", file=path, field="filename", remedy="give one per image")
    index, own = found[0]
    where = f"features.{index}"
    crs = document.get("world_crs")
    if not isinstance(crs, str) or not crs.strip():
        raise InputError("the CRS of the positions is missing", file=path, field="world_crs")
    x, y, z = _numbers(path, f"{where}.xyz", own.get("xyz"), 3)
    omega, phi, kappa = map(math.degrees, _numbers(path, f"{where}.opk", own.get("opk"), 3))
    camera = own.get("camera")
    return Pose(
        str(path), where, False, (x, y, z), (omega, phi, kappa), crs, camera if isinstance(camera, str) else None
    )


def _two(path: str | PathLike[str], field: str, value: Any) -> tuple[float, float]:
    x, y = _numbers(path, field, value, 2)
    return x, y


def _numbers(path: str | PathLike[str], field: str, value: Any, count: int) -> list[float]:
    if not isinstance(value, list) or len(value) != count:
        raise InputError(f"this must be a list of {count} numbers", file=path, field=field)
    return [number(path, field, one) for one in value]
