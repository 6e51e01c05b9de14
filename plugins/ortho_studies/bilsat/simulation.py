"""A simulated BILSAT-1 product: image, imaging survey, DEM, control points, and the truth behind them."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from ortho_bilsat.survey import Survey, write_survey

from ortho_pipeline.errors import InputError
from ortho_pipeline.files import write_text
from ortho_pipeline.geodesy.ellipsoid import orbital_from_ecef
from ortho_pipeline.imaging.band_stack import write_bands
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import write_points
from ortho_pipeline.surface.writing import write_terrain
from ortho_studies.bilsat import truth as simulated

#: Standard deviation (rad) of the attitude that a survey gives, per axis: a star camera of a small satellite.
ATTITUDE_SIGMA = math.radians(0.02)
MAP, GEOID = simulated.MAP_CRS, "EPSG:5773"
SMALLEST, LARGEST = 32, simulated.SIZE


def write_product(
    folder: str | PathLike[str],
    *,
    seed: int = 0,
    off_nadir_deg: float = simulated.OFF_NADIR_DEG,
    size: int = simulated.SIZE,
    cameras: tuple[str, ...] = ("red",),
    dem_step: float = 90.0,
) -> dict[str, Path]:
    """Simulate an acquisition and write it as it would be delivered, with a DEM and points to adjust it to.

    Parameters
    ----------
    seed : int
        Of all noise: in the image, of the points, and of the survey.
    size : int
        Columns and rows; fewer pixels are larger and cover the same ground.
    cameras : tuple of str
        XS cameras to take the image with, the red one first: it is what survey and points belong to.
    dem_step : float
        Distance (m) of the posts of the DEM, whose heights are above EGM96 and without error.

    Returns
    -------
    dict of str to Path
        The files: image (and image_<camera> of the other cameras), survey, dem, gcps, truth.

    Raises
    ------
    InputError
        If the size or the seed is not possible, or the ground cannot be seen so obliquely.
    """
    if not SMALLEST <= size <= LARGEST or seed < 0:
        raise InputError(
            f"size {size} and seed {seed} are not possible",
            field="size, seed",
            remedy=f"use a size from {SMALLEST} to {LARGEST}, and a seed of 0 or more",
        )
    out = Path(folder)
    scene = simulated.BilsatScene.make(off_nadir_deg, size=size)
    names = {camera: "image" if camera == "red" else f"image_{camera}" for camera in cameras}
    files = {name: out / f"bilsat{name.removeprefix('image')}.tif" for name in names.values()}
    files |= {"survey": out / "bilsat_survey.txt", "dem": out / "dem.tif", "gcps": out / "gcps.csv"}
    files["truth"] = out / "truth.json"
    for number, (camera, name) in enumerate(names.items()):
        taken = scene.camera.misaligned(*simulated.XS_CAMERAS[camera])
        pixels = simulated.render(taken, scene.hills, camera, seed=seed + number)
        write_bands(pixels[None], [camera], files[name], nodata=None)
    survey = survey_of(scene, seed)
    write_survey(survey, files["survey"])
    _write_heights(scene, dem_step, files["dem"])
    measured = scene.measure(seed).to_crs(MAP)
    delivered = replace(measured, image=np.round(measured.image, 2), ground=np.round(measured.ground, 3))
    write_points(delivered, files["gcps"])
    write_text(files["truth"], json.dumps(_truth(scene, survey, seed, off_nadir_deg), indent=1) + "\n")
    return files


def survey_of(scene: simulated.BilsatScene, seed: int) -> Survey:
    """Return the imaging survey of a simulated scene, with the errors of orbit and attitude from `seed`."""
    camera, orbit = scene.camera, scene.survey(seed)
    error = np.random.default_rng([seed, 2]).normal(0.0, ATTITUDE_SIGMA, 3)
    pitch = simulated.PITCH * simulated.SIZE / camera.width
    return Survey(
        scene="ANKARA-SIMULATED",
        camera="XS-RED",
        acquired="2005-08-03T08:12:31.250Z",
        position=_rounded(orbit.position, 2),
        velocity=_rounded(orbit.velocity, 4),
        attitude=_rounded(np.array(attitude_of(camera)) + error, 8),
        interior=Interior(camera.width, camera.height, simulated.FOCAL_LENGTH, pitch, pitch),
        position_sigma=orbit.position_sigma,
        heights=(simulated.LOW - 100.0, simulated.HIGH + 100.0),
        attitude_sigma=ATTITUDE_SIGMA,
    )


def attitude_of(camera: simulated.Snapshot) -> tuple[float, float, float]:
    """Return roll, pitch and yaw (rad) of a camera from the orbital frame, as docs/formats/bilsat.md defines them."""
    # The rows of the axes are: columns to the right, rows backwards, line of sight down.
    platform = np.stack([-camera.axes[1], camera.axes[0], camera.axes[2]])
    turn = platform @ orbital_from_ecef(camera.position, camera.velocity).T
    roll, yaw = math.atan2(turn[1, 2], turn[2, 2]), math.atan2(turn[0, 1], turn[0, 0])
    return roll, -math.asin(turn[0, 2]), yaw


def _write_heights(scene: simulated.BilsatScene, step: float, path: Path) -> None:
    size = scene.camera.width
    ring = np.array([(u, v) for u in (0.0, 0.5, 1.0) for v in (0.0, 0.5, 1.0)]) * size
    seen = scene.camera.meet(ring, scene.hills)
    to_map = pyproj.Transformer.from_crs("EPSG:4326", MAP, always_xy=True)
    xy = np.stack(to_map.transform(seen[:, 0], seen[:, 1]), axis=1)
    # What the camera sees at the heights of its survey lies a little beyond what it sees on the hills.
    margin = 2000.0 + step
    write_terrain(path, scene.hills, (xy.min(axis=0) - margin, xy.max(axis=0) + margin), step, MAP, GEOID)


def _truth(scene: simulated.BilsatScene, survey: Survey, seed: int, off_nadir_deg: float) -> dict[str, Any]:
    camera = scene.camera
    return {
        "about": "truth of a simulated BILSAT-1 scene",
        "seed": seed,
        "off_nadir_deg": off_nadir_deg,
        "position_m": camera.position.tolist(),
        "velocity_m_s": camera.velocity.tolist(),
        "attitude_deg": [math.degrees(angle) for angle in attitude_of(camera)],
        "survey_is_off_by_m": (np.array(survey.position) - camera.position).tolist(),
        "noise": {"points_image_px": simulated.SIGMA_IMAGE, "points_ground_m": simulated.SIGMA_GROUND},
        "points": [
            {"id": f"P{k + 1:02d}", "image": image.tolist(), "lon_lat_h": ground.tolist()}
            for k, (image, ground) in enumerate(zip(scene.image, scene.ground, strict=True))
        ],
    }


def _rounded(values: tuple[float, ...] | Array, digits: int) -> tuple[float, float, float]:
    x, y, z = (round(float(value), digits) for value in values)
    return x, y, z
