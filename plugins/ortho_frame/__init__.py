"""Sensor plugin for frame images: a camera file and exterior orientations, or a project of another program.

The sensor ``frame`` recognises nothing automatically: it is used when its options are given (``camera``, ``exterior``).
The sensors ``odm`` and ``orthority`` find these files in their projects.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from osgeo import gdal

from ortho_frame.pose import Pose, Shot
from ortho_frame.projects import MAP, ProjectAxes, on_map, orthority_of, reconstruction_of, shot_in
from ortho_frame.tables import is_orthority, is_reconstruction, read_camera, read_exterior
from ortho_pipeline.plugin import (
    LOOKS_PAST,
    TOPOCENTRIC,
    Array,
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
    declared_vertical,
    exterior_sigmas,
    ground_transform,
    height_range,
    hookimpl,
    parse_crs,
    place,
    pose_sigmas,
    priors_at,
)

OPTIONS = {
    "camera": "camera file: JSON (docs/formats/frame.md), OpenSfM's cameras.json or reconstruction.json, or "
    "orthority's YAML",
    "exterior": "CSV: filename, and x y z omega phi kappa or lon lat alt roll pitch yaw (degrees); OpenSfM's "
    "reconstruction.json, which also has the camera; or orthority's GeoJSON",
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
    yield Sensor(
        "odm",
        "photos of an OpenDroneMap or OpenSfM project (images next to opensfm/reconstruction.json)",
        lambda dataset: not on_map(dataset) and reconstruction_of(dataset.GetDescription()) is not None,
        open_odm,
        options=OPTIONS,
    )
    yield Sensor(
        "orthority",
        "frames with orthority's files next to them: *int_param*.yaml and *ext_param*.geojson",
        lambda dataset: not on_map(dataset) and orthority_of(dataset.GetDescription()) is not None,
        open_orthority,
        options=OPTIONS,
    )


def open_scene(
    dataset: gdal.Dataset,
    *,
    camera: str | None = None,
    exterior: str | None = None,
    crs: str | None = None,
    vertical: str | None = None,
    frame: str | None = None,
    heights: str | None = None,
    sigmas: str | None = None,
    refraction: str = "no",
) -> Scene:
    """Open a frame image with its camera and its row of the table of exterior orientations."""
    name = dataset.GetDescription()
    if camera is None and exterior is not None and is_reconstruction(exterior):
        camera = exterior
    own = exterior is not None and is_orthority(exterior)
    if camera is None or exterior is None or (vertical is None and not own):
        required = {"camera": camera, "exterior": exterior, "vertical": vertical or own}
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
    interior = read_camera(camera, dataset.RasterXSize, dataset.RasterYSize, pose.camera, name)
    others = {"heights": heights, "refraction": refraction == "yes"}
    if isinstance(pose, Shot):
        axes = _axes_of(pose, frame or TOPOCENTRIC, crs)
        model = _shot_model(interior, pose, axes, _datum(vertical), **others)
    else:
        vertical = vertical or _declared(pose.crs)
        # Orthority's angles belong to the axes of its map.
        model = _model(
            interior, pose, crs or pose.crs, _datum(vertical), frame or (MAP if own else TOPOCENTRIC), **others
        )
    return _scene("frame", dataset, model, pose, exterior, vertical, heights, sigmas)


def open_odm(
    dataset: gdal.Dataset,
    *,
    vertical: str | None = None,
    heights: str | None = None,
    sigmas: str | None = None,
    **given: str,
) -> Scene:
    """Open a photo with its shot in the project of OpenDroneMap or OpenSfM that it belongs to.

    Files that the options give count more.
    """
    if given:
        return replace(open_scene(dataset, vertical=vertical, heights=heights, sigmas=sigmas, **given), sensor="odm")
    path = reconstruction_of(dataset.GetDescription())
    if path is None:
        raise InputError(
            "this image does not belong to a project of OpenDroneMap",
            file=dataset.GetDescription(),
            remedy="put it into the folder images next to the project's folder opensfm",
        )
    shot, axes = shot_in(path, place(dataset.GetDescription()))
    interior = read_camera(path, dataset.RasterXSize, dataset.RasterYSize, shot.camera, dataset.GetDescription())
    model = _shot_model(interior, shot, axes, _datum(vertical), heights=heights)
    return _scene("odm", dataset, model, shot, str(path), vertical, heights, sigmas)


def open_orthority(
    dataset: gdal.Dataset,
    *,
    vertical: str | None = None,
    heights: str | None = None,
    sigmas: str | None = None,
    **given: str,
) -> Scene:
    """Open a frame with orthority's files next to it.

    Files that the options give count more.
    """
    if given:
        return replace(
            open_scene(dataset, vertical=vertical, heights=heights, sigmas=sigmas, **given), sensor="orthority"
        )
    files = orthority_of(dataset.GetDescription())
    if files is None:
        raise InputError(
            "there are no files of orthority next to this image",
            file=dataset.GetDescription(),
            remedy="put one *int_param*.yaml and one *ext_param*.geojson into its folder",
        )
    pose = read_exterior(files[1], dataset.GetDescription())
    assert isinstance(pose, Pose)
    vertical = vertical or _declared(pose.crs)
    interior = read_camera(files[0], dataset.RasterXSize, dataset.RasterYSize, pose.camera)
    model = _model(interior, pose, pose.crs, _datum(vertical), MAP, heights=heights)
    return _scene("orthority", dataset, model, pose, str(files[1]), vertical, heights, sigmas, (files[0],))


def _scene(
    sensor: str,
    dataset: gdal.Dataset,
    model: FrameCamera,
    pose: Pose | Shot,
    source: str,
    vertical: str | None,
    heights: str | None,
    sigmas: str | None,
    sources: tuple[Path, ...] = (),
) -> Scene:
    warnings = [*(() if model.sees_ground else (LOOKS_PAST,)), *((_unknown_datum(),) if vertical is None else ())]
    return Scene(
        sensor=sensor,
        path=dataset.GetDescription(),
        width=dataset.RasterXSize,
        height=dataset.RasterYSize,
        models={"frame": model},
        model_source=source,
        facts=_facts(model, pose, heights),
        warnings=tuple(warnings),
        priors=_priors(model, sigmas),
        sources=sources,
    )


def _datum(vertical: str | None) -> Vertical:
    """Return the height datum; an unknown one counts as ellipsoidal, with a warning."""
    return Vertical.parse("ellipsoid" if vertical is None else vertical)


def _declared(crs: str | None) -> str | None:
    """Return the height datum that the compound CRS of a file declares; None without."""
    declared = None if crs is None else declared_vertical(parse_crs(crs))
    return declared.vertical.name if declared is not None and declared.certain and declared.vertical else None


def _unknown_datum() -> Notice:
    text = Text(
        "these files do not state the height datum of the camera. Its height counts as ellipsoidal, which is wrong by "
        "the height of the geoid if it is above sea level. Add ",
        Setting("scene.sensor_options", "DATUM", key="vertical"),
        ", the same datum as for a DEM of the same project",
    )
    return Notice("datum-unknown", text)


def _model(
    interior: Interior,
    pose: Pose,
    crs: str | None,
    vertical: Vertical,
    frame: str,
    *,
    heights: str | None = None,
    refraction: bool = False,
) -> FrameCamera:
    position, angles = np.array(pose.position), np.radians(pose.angles)
    if not pose.geographic and crs is None:
        raise InputError(
            "the CRS of x and y is missing",
            file=pose.source,
            field="crs",
            remedy="give the sensor option crs, such as crs=EPSG:32636",
        )
    on_earth = position if pose.geographic else ground_transform(str(crs), "EPSG:4979")([[*position[:2], 0.0]])[0]
    position[2] = vertical.ellipsoidal(on_earth[:1], on_earth[1:2], position[2:])[0]
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


def _axes_of(shot: Shot, frame: str, crs: str | None) -> ProjectAxes:
    """Return the axes that the options state for a reconstruction."""
    if frame == TOPOCENTRIC:
        return ProjectAxes(TOPOCENTRIC)
    if crs is None:
        raise InputError(
            "frame=map needs a map projection", file=shot.source, field="crs", remedy="give one, such as crs=EPSG:32636"
        )
    # OpenDroneMap takes east and north for axes of the map.
    x, y, _ = ground_transform("EPSG:4979", crs)([shot.origin])[0].tolist()
    return ProjectAxes(frame, crs, (x, y))


def _shot_model(
    interior: Interior,
    shot: Shot,
    axes: ProjectAxes,
    vertical: Vertical,
    *,
    heights: str | None = None,
    refraction: bool = False,
) -> FrameCamera:
    lon, lat, altitude = shot.origin
    altitude += float(vertical.undulation(np.array([lon]), np.array([lat]))[0])
    if not math.isfinite(altitude):
        raise InputError("the height datum does not cover this position", file=shot.source, field="reference_lla")
    exterior = shot.exterior()
    others = {"heights": _heights(heights, altitude + exterior[2]), "refraction": refraction}
    if axes.crs is None or axes.corner is None:
        return FrameCamera(interior, exterior, origin=(lon, lat, altitude), **others)
    in_map = exterior + np.array([*axes.corner, altitude, 0.0, 0.0, 0.0])
    return FrameCamera.from_map(interior, axes.crs, in_map, frame=axes.frame, **others)


def _heights(text: str | None, camera: float) -> tuple[float, float]:
    if text is None:
        # Only one thing is known: the ground is below the camera.
        low = min(-100.0, camera - 1000.0)
        return low, min(9000.0, camera - 0.1 * (camera - low))
    return height_range(text)


def _priors(model: FrameCamera, sigmas: str | None) -> dict[str, Prior]:
    if sigmas is None:
        return {}
    metres, degrees = pose_sigmas(sigmas)
    return priors_at(model, exterior_sigmas(metres, math.radians(degrees)))


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
