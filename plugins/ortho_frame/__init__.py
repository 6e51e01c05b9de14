"""Sensor plugin for frame images in general: a camera file, and a table of exterior orientations.

It recognises nothing automatically: it is used when its options are given (``camera``, ``exterior``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from osgeo import gdal

from ortho_frame.tables import Pose, Shot, is_reconstruction, read_camera, read_exterior
from ortho_pipeline.plugin import (
    LOOKS_PAST,
    TOPOCENTRIC,
    Array,
    FrameCamera,
    InputError,
    Interior,
    Prior,
    Scene,
    Sensor,
    Setting,
    Text,
    Vertical,
    exterior_sigmas,
    ground_transform,
    hookimpl,
    numbers_of,
    priors_at,
)

OPTIONS = {
    "camera": "camera file: JSON (docs/formats/frame.md) or OpenSfM's cameras.json or reconstruction.json",
    "exterior": "CSV: filename, and x y z omega phi kappa or lon lat alt roll pitch yaw (degrees); or OpenSfM's "
    "reconstruction.json, which also has the camera",
    "crs": "projected CRS of x and y",
    "vertical": "height datum of the camera positions: ellipsoid, egm96, egm2008, EPSG:n or a grid file",
    "frame": "work in a topocentric frame (default) or directly in the map projection: topocentric, map",
    "heights": "lowest and highest ground, ellipsoidal metres: low,high",
    "sigmas": "standard deviations of position and angles for the correction 'model': metres,degrees",
    "refraction": "correct refraction in a standard atmosphere: yes or no (default)",
}


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``frame``."""
    yield Sensor(
        "frame",
        "aerial, drone and other frame images with a camera file and exterior orientations",
        lambda dataset: False,
        open_scene,
        options=OPTIONS,
        fallback=True,
    )


def open_scene(
    dataset: gdal.Dataset,
    *,
    camera: str | None = None,
    exterior: str | None = None,
    crs: str | None = None,
    vertical: str | None = None,
    frame: str = TOPOCENTRIC,
    heights: str | None = None,
    sigmas: str | None = None,
    refraction: str = "no",
) -> Scene:
    """Open a frame image with its camera and its row of the table of exterior orientations."""
    name = dataset.GetDescription()
    if camera is None and exterior is not None and is_reconstruction(exterior):
        camera = exterior
    if camera is None or exterior is None or vertical is None:
        required = {"camera": camera, "exterior": exterior, "vertical": vertical}
        missing = [key for key, value in required.items() if not value]
        raise InputError(
            f"a frame image needs {', '.join(missing)}",
            file=name,
            field=missing[0],
            remedy=Text.joined(
                "; ", (Text(Setting("scene.sensor_options", "...", key=key), f" ({OPTIONS[key]})") for key in missing)
            ),
        )
    if refraction not in ("yes", "no"):
        raise InputError(f"{refraction!r} must be yes or no", field="refraction")
    pose = read_exterior(exterior, name)
    kind = pose.camera if isinstance(pose, Shot) else None
    interior = read_camera(camera, dataset.RasterXSize, dataset.RasterYSize, kind)
    make = _shot_model if isinstance(pose, Shot) else _model
    model = make(interior, pose, crs, Vertical.parse(vertical), frame, heights, refraction == "yes")
    return Scene(
        sensor="frame",
        path=name,
        width=dataset.RasterXSize,
        height=dataset.RasterYSize,
        models={"frame": model},
        model_source=exterior,
        facts=_facts(model, pose, heights),
        warnings=() if model.sees_ground else (LOOKS_PAST,),
        priors=_priors(model, sigmas),
    )


def _model(
    interior: Interior,
    pose: Pose,
    crs: str | None,
    vertical: Vertical,
    frame: str,
    heights: str | None,
    refraction: bool,
) -> FrameCamera:
    position, angles = np.array(pose.position), np.radians(pose.angles)
    if not pose.geographic and crs is None:
        raise InputError(
            "the CRS of x and y is missing",
            file=pose.source,
            field="crs",
            remedy="give the sensor option crs, such as crs=EPSG:32636",
        )
    place = position if pose.geographic else ground_transform(str(crs), "EPSG:4979")([[*position[:2], 0.0]])[0]
    position[2] += float(vertical.undulation(place[:1], place[1:2])[0])
    if not np.isfinite(position).all():
        raise InputError("this position is outside the map projection", file=pose.source, field=pose.where)
    others = {"heights": _heights(heights, float(position[2])), "refraction": refraction}
    if pose.geographic:
        if frame != TOPOCENTRIC:
            raise InputError(
                "roll, pitch and yaw do not depend on a map projection", field="frame", remedy="leave the option out"
            )
        return FrameCamera.from_roll_pitch_yaw(interior, position, *angles.tolist(), **others)
    return FrameCamera.from_map(interior, str(crs), np.concatenate([position, angles]), frame=frame, **others)


def _shot_model(
    interior: Interior,
    shot: Shot,
    crs: str | None,
    vertical: Vertical,
    frame: str,
    heights: str | None,
    refraction: bool,
) -> FrameCamera:
    lon, lat, altitude = shot.origin
    altitude += float(vertical.undulation(np.array([lon]), np.array([lat]))[0])
    if not math.isfinite(altitude):
        raise InputError("the height datum does not cover this position", file=shot.source, field="reference_lla")
    exterior = shot.exterior()
    others = {"heights": _heights(heights, altitude + exterior[2]), "refraction": refraction}
    if frame == TOPOCENTRIC:
        return FrameCamera(interior, exterior, origin=(lon, lat, altitude), **others)
    if crs is None:
        raise InputError(
            "frame=map needs a map projection", file=shot.source, field="crs", remedy="give one, such as crs=EPSG:32636"
        )
    # OpenDroneMap takes east and north for axes of the map.
    corner = ground_transform("EPSG:4979", crs)([[lon, lat, altitude]])[0]
    return FrameCamera.from_map(interior, crs, exterior + np.array([*corner, 0.0, 0.0, 0.0]), frame=frame, **others)


def _heights(text: str | None, camera: float) -> tuple[float, float]:
    if text is None:
        # Only one thing is known: the ground is below the camera.
        low = min(-100.0, camera - 1000.0)
        return low, min(9000.0, camera - 0.1 * (camera - low))
    low, high = _pair(text)
    if not low < high:
        raise InputError(
            f"{text!r} is not a height range", field="heights", remedy="give low,high in metres, such as heights=0,800"
        )
    return low, high


def _priors(model: FrameCamera, sigmas: str | None) -> dict[str, Prior]:
    if sigmas is None:
        return {}
    metres, degrees = _pair(sigmas)
    if not (metres > 0 and degrees > 0):
        raise InputError(f"{sigmas!r} are not two standard deviations", field="sigmas", remedy="give metres,degrees")
    return priors_at(model, exterior_sigmas(metres, math.radians(degrees)))


def _pair(text: str) -> tuple[float, float]:
    """Return two numbers; NaN if there are not two."""
    numbers = numbers_of(text)
    return (numbers[0], numbers[1]) if len(numbers) == 2 else (math.nan, math.nan)


def _facts(model: FrameCamera, pose: Pose | Shot, heights: str | None) -> dict[str, object]:
    centre: Array = model.perspective_centre
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(model.rotation[2, 2])))))
    unknown = {"ground_heights": "assumed, because not stated; give a DEM or the sensor option heights=low,high"}
    return {
        **({} if heights else unknown),
        "exterior_orientation": pose.where,
        "perspective_centre": [round(float(value), 9) for value in centre],
        "perspective_centre_crs": model.crs,
        "tilt_deg": round(tilt, 3),
        "focal_length_px": round(model.interior.focal_length / model.interior.pitch_x, 3),
    }
