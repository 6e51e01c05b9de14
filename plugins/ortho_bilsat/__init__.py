"""Sensor plugin for BILSAT-1 scenes: an image and its imaging survey (docs/formats/bilsat.md) next to it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from osgeo import gdal

from ortho_bilsat.survey import MARK, Survey, read_survey
from ortho_pipeline.plugin import (
    LOOKS_PAST,
    FrameCamera,
    InputError,
    Notice,
    Scene,
    Sensor,
    camera_from_platform,
    decoded,
    exterior_sigmas,
    geodetic,
    hookimpl,
    orbital_from_ecef,
    place,
    priors_at,
    read_bounded,
)


@hookimpl
def ortho_sensors() -> Iterable[Sensor]:
    """Offer the sensor ``bilsat``."""
    yield Sensor(
        "bilsat",
        "BILSAT-1 PAN and XS frames with an imaging survey file",
        recognises,
        open_scene,
        options={
            "survey": "the imaging survey file, if it is not <image>_survey.txt",
            "attitude": "start of the attitude: survey (default if there is one) or zero (equation 5 of the paper)",
        },
        metadata_beside=survey_of,
    )


def recognises(dataset: gdal.Dataset) -> bool:
    """Return whether there is an imaging survey next to the image."""
    try:
        # A dataset in memory has no name: ValueError.
        survey = survey_of(dataset.GetDescription())
        # Check first: the error for a missing file searches the whole folder for similar names.
        return survey.is_file() and decoded(read_bounded(survey, 2 * len(MARK))).startswith(MARK)
    except (InputError, ValueError):
        return False


def survey_of(image: str) -> Path:
    """Return the expected path of the survey of an image."""
    path = place(image)
    return path.with_name(f"{path.stem}_survey.txt")


def open_scene(dataset: gdal.Dataset, *, survey: str | None = None, attitude: str = "survey") -> Scene:
    """Open a BILSAT-1 image with its imaging survey."""
    name = dataset.GetDescription()
    path = place(survey) if survey else survey_of(name)
    read = read_survey(path)
    if (dataset.RasterXSize, dataset.RasterYSize) != (read.interior.width, read.interior.height):
        raise InputError(
            f"the survey is for {read.interior.width} x {read.interior.height} pixels, but the image has "
            f"{dataset.RasterXSize} x {dataset.RasterYSize}",
            file=path,
            field="columns, rows",
            remedy="use the whole frame with its own survey",
        )
    if attitude not in ("survey", "zero"):
        raise InputError(f"{attitude!r} is not a known attitude source", field="attitude", remedy="survey or zero")
    model = rigorous_model(read, use_attitude=attitude == "survey")
    warnings = []
    known = read.attitude is not None and attitude == "survey"
    if not known:
        text = "the attitude is unknown. The model is only a start: adjust it to ground control points"
        warnings.append(Notice("only-a-start", text))
    elif not model.sees_ground:
        warnings.append(LOOKS_PAST)
    return Scene(
        sensor="bilsat",
        path=name,
        width=read.interior.width,
        height=read.interior.height,
        models={"rigorous": model},
        model_source=str(path),
        facts=_facts(read, model),
        warnings=tuple(warnings),
        priors=priors_at(model, exterior_sigmas(read.position_sigma, read.attitude_sigma if known else None)),
    )


def rigorous_model(survey: Survey, *, use_attitude: bool) -> FrameCamera:
    """Return the collinearity model of a survey: its attitude, or zero angles (equation 5)."""
    position, velocity = np.array(survey.position), np.array(survey.velocity)
    rotation = None
    if use_attitude and survey.attitude is not None:
        rotation = camera_from_platform(*survey.attitude) @ orbital_from_ecef(position, velocity)
    return FrameCamera.from_geocentric(survey.interior, position, rotation, heights=survey.heights)


def _facts(survey: Survey, model: FrameCamera) -> dict[str, object]:
    lon, lat, height = geodetic(np.array([survey.position]))[0].tolist()
    interior = survey.interior
    return {
        "scene": survey.scene,
        "camera": survey.camera,
        "acquired": survey.acquired,
        "satellite_lon_lat_height": [round(lon, 7), round(lat, 7), round(height, 2)],
        "off_nadir_deg": round(math.degrees(math.acos(max(-1.0, min(1.0, float(model.rotation[2, 2]))))), 3),
        "pixel_at_nadir_m": round(interior.pitch_x * height / interior.focal_length, 3),
        "position_sigma_m": survey.position_sigma,
    }
