"""Sensor plugin for photos of drones: pose, camera and accuracy from their EXIF and XMP tags alone."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from osgeo import gdal

from ortho_photo.cameras import PhotoCamera, camera_of
from ortho_photo.pose import ANGLE, FLATTEST_DEG, HORIZON, NADIR, PhotoPose, pose_of
from ortho_photo.tags import Tags, has_position, tags_of
from ortho_pipeline.plugin import (
    DatumError,
    FrameCamera,
    InputError,
    Interior,
    Notice,
    Prior,
    Scene,
    Sensor,
    Setting,
    Text,
    Vertical,
    enu_from_ecef,
    exterior_sigmas,
    geocentric,
    height_range,
    hookimpl,
    number_of,
    pose_sigmas,
    priors_at,
)

OPTIONS = {
    "vertical": "height datum of the camera positions: ellipsoid, egm96, egm2008, EPSG:n, a grid file, or unknown "
    "(default, where the tags do not state it)",
    "takeoff": "height (m) of the take-off in the datum 'vertical' (default: ellipsoid): altitudes count from it",
    "sensor_width": "width of the camera's sensor in millimetres, if the tags and the table of cameras do not tell it",
    "pitch": "where the pitch of the camera is zero: horizon or nadir (default: as the maker's tags define it)",
    "sigmas": "standard deviations of position and angles: metres,degrees (default: as the tags state)",
    "heights": "lowest and highest ground, ellipsoidal metres: low,high",
    "calibrate": "whether an adjustment estimates the camera: yes (default) or no",
}
UNKNOWN = "unknown"
#: Standard deviation (m) of heights of an unknown datum: geoid and ellipsoid are within twice of it nearly everywhere.
DATUM_SIGMA = 50.0
#: Lowest and highest ground below a camera where nothing states its heights: m, and parts of the height above take-off.
_BELOW, _OF_RELATIVE = (500.0, 20.0), (2.0, 0.2)
#: At less than this above take-off (m) the ground in view can be far below, and near: m below the camera.
_LEAST_RELATIVE, _BELOW_LOW = 5.0, (500.0, 1.0)


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``photo``."""
    yield Sensor(
        "photo",
        "drone photos with position and camera angles in EXIF and XMP (DJI, senseFly, Parrot, MicaSense, Autel)",
        has_position,
        open_scene,
        options=OPTIONS,
        fallback=True,
    )


def open_scene(
    dataset: gdal.Dataset,
    *,
    vertical: str | None = None,
    takeoff: str | None = None,
    sensor_width: str | None = None,
    pitch: str | None = None,
    sigmas: str | None = None,
    heights: str | None = None,
    calibrate: str = "yes",
) -> Scene:
    """Open a photo by its tags."""
    tags = tags_of(dataset)
    size = dataset.RasterXSize, dataset.RasterYSize
    if pitch not in (None, HORIZON, NADIR):
        raise InputError(f"{pitch!r} must be {HORIZON} or {NADIR}", field="pitch")
    pose = pose_of(tags, pitch, _takeoff(takeoff))
    if calibrate not in ("yes", "no"):
        raise InputError(f"{calibrate!r} must be yes or no", field="calibrate")
    camera = camera_of(tags, *size, _width(sensor_width))
    stated = vertical or (_known(pose.datum) if takeoff is None else "ellipsoid")
    model = _model(camera.interior, pose, stated, heights, tags)
    priors = _priors(model, pose, stated, sigmas)
    if calibrate == "yes":
        shared = _camera_name(tags, model.interior)
        priors |= {
            name: Prior(float(getattr(model.interior, name)), sigma, shared) for name, sigma in camera.sigmas.items()
        }
    model = replace(model, free=tuple(priors))
    if not (model.sees_ground and pose.tilt_deg < FLATTEST_DEG):
        other = HORIZON if pose.convention == NADIR else NADIR
        again = Setting("scene.sensor_options", other, key="pitch")
        raise tags.error(
            f"by its angles (yaw, pitch, roll {pose.angles}) this camera does not look at the ground",
            "Pitch",
            Text(f"if its pitch is zero at the {other}, add ", again, "; else leave this photo out"),
        )
    warnings = [
        *pose.position.notices,
        *([_unknown_datum(pose, tags.optional("drone-dji:RelativeAltitude"))] if stated == UNKNOWN else []),
    ]
    return Scene(
        sensor="photo",
        path=tags.path,
        width=size[0],
        height=size[1],
        models={"frame": model},
        model_source="EXIF and XMP",
        facts=_facts(tags, pose, model, camera, stated),
        warnings=tuple(warnings),
        priors=priors,
    )


def _model(interior: Interior, pose: PhotoPose, stated: str, heights: str | None, tags: Tags) -> FrameCamera:
    lon, lat, altitude = pose.position.lon, pose.position.lat, pose.position.altitude
    if stated != UNKNOWN:
        altitude += float(Vertical.parse(stated).undulation(np.array([lon]), np.array([lat]))[0])
    if not math.isfinite(altitude):
        raise tags.error("the height datum does not cover this position", "vertical", "give another datum")
    place = np.array([[lon, lat, altitude]])
    position, axes = geocentric(place)[0], enu_from_ecef(place)[0]
    ned_from_ecef = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]) @ axes
    ground = _heights(heights, altitude, tags.positive("drone-dji:RelativeAltitude"))
    return FrameCamera.from_geocentric(interior, position, pose.rotation @ ned_from_ecef, heights=ground)


def _heights(text: str | None, altitude: float, above_takeoff: float | None) -> tuple[float, float]:
    if text is None:
        if above_takeoff is None:
            low, high = _BELOW
        elif above_takeoff < _LEAST_RELATIVE:
            low, high = _BELOW_LOW
        else:
            low, high = (part * above_takeoff for part in _OF_RELATIVE)
        return altitude - low, altitude - high
    return height_range(text)


def _priors(model: FrameCamera, pose: PhotoPose, stated: str, sigmas: str | None) -> dict[str, Prior]:
    """Return what is known of the pose."""
    (plan, height), angle = pose.position.sigmas, ANGLE
    if sigmas is not None:
        plan, angle = pose_sigmas(sigmas)
        height = plan
    height = math.hypot(height, DATUM_SIGMA) if stated == UNKNOWN else height
    return priors_at(model, {**exterior_sigmas(plan, math.radians(angle)), "Z_L": height})


def _camera_name(tags: Tags, interior: Interior) -> str:
    """Return what tells a camera from others whose lenses are as well known: a block estimates each of them."""
    named = (tags.text("Make", "tiff:Make"), tags.text("Model", "tiff:Model"))
    numbers = [tags.text(name) for name in ("BodySerialNumber", "drone-dji:CameraSerialNumber")]
    focal = interior.focal_length / interior.pitch_x
    return " ".join([*named, *numbers, f"{interior.width} x {interior.height}, {focal:.6g} px"])


def _known(datum: str) -> str:
    """Return the datum that the tags state, or `UNKNOWN`: programs also write free text."""
    try:
        Vertical.stated(datum)
    except DatumError:
        return UNKNOWN
    return datum


def _unknown_datum(pose: PhotoPose, above_takeoff: float | None) -> Notice:
    stated = f"state an unknown height datum of the camera, {pose.datum[:60]!r}"
    text = Text(
        f"the tags {stated if pose.datum else 'do not state the height datum of the camera'}. ",
        "Its altitude counts as ellipsoidal, within "
        f"{DATUM_SIGMA:.0f} m. An adjustment with a DEM or control points estimates it. If you know the datum, add ",
        Setting("scene.sensor_options", "DATUM", key="vertical"),
    )
    if above_takeoff is not None and abs(pose.position.altitude - above_takeoff) < DATUM_SIGMA:
        again = Setting("scene.sensor_options", "METRES", key="takeoff")
        text = Text(text, ". It may be the altitude above take-off. Then add the height of the take-off with ", again)
    return Notice("datum-unknown", text, altitude_m=pose.position.altitude, sigma_m=DATUM_SIGMA)


def _facts(tags: Tags, pose: PhotoPose, model: FrameCamera, camera: PhotoCamera, stated: str) -> dict[str, object]:
    taken = tags.text("DateTimeOriginal", "DateTime")
    relative = tags.optional("drone-dji:RelativeAltitude")
    known = {
        "acquired_local": taken.replace(":", "-", 2) if taken else None,
        "camera": " ".join(filter(None, (tags.text("Make", "tiff:Make"), tags.text("Model", "tiff:Model")))) or None,
        "altitude_above_takeoff_m": relative,
    }
    plan, height = pose.position.sigmas
    return {
        **{name: value for name, value in known.items() if value is not None},
        "altitude_m": pose.position.altitude,
        "altitude_datum": stated,
        "positioning": f"{pose.position.positioning}: {plan:.3g} m in plan, {height:.3g} m in height",
        "perspective_centre": [round(float(value), 9) for value in model.perspective_centre],
        "perspective_centre_crs": model.crs,
        "yaw_pitch_roll_deg": list(pose.angles),
        "tilt_deg": round(pose.tilt_deg, 3),
        "focal_length_px": round(model.interior.focal_length / model.interior.pitch_x, 3),
        "interior_orientation": camera.source,
    }


def _takeoff(text: str | None) -> float | None:
    if text is None:
        return None
    height = number_of(text)
    if not math.isfinite(height):
        raise InputError(f"{text!r} is not a height", field="takeoff", remedy="give metres, such as 612.5")
    return height


def _width(text: str | None) -> float | None:
    if text is None:
        return None
    width = number_of(text)
    if not 0.1 < width < 1000:
        raise InputError(
            f"{text!r} is not the width of a sensor", field="sensor_width", remedy="give millimetres, such as 13.2"
        )
    return width
