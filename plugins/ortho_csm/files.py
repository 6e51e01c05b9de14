"""Files of CSM states: recognised, read, written.

A state is a line with the name of the model and a JSON object. What the numbers mean is that of the library usgscsm:
line and sample 0.5 are the centre of the first pixel, as here; angles are quaternions to ECEF, scalar last; heights are
ellipsoidal. A state has neither aberration nor refraction: they are in its angles, or left out.

Source: usgscsm (`UsgsAstroLsSensorModel`, `UsgsAstroFrameSensorModel`, `Utilities`), CSM 3.0.3.
"""

from __future__ import annotations

import json
import math
from os import PathLike
from pathlib import Path

import numpy as np

from ortho_csm.frame import frame_fields, read_frame
from ortho_csm.line_scanner import line_scanner_fields, read_line_scanner
from ortho_csm.state import REMEDY, StateFields
from ortho_pipeline.plugin import (
    FrameCamera,
    InputError,
    Pushbroom,
    SensorModel,
    Setting,
    Text,
    ground_of_grid,
    ground_transform,
    parse_json,
    read_bounded,
    reads,
)

LINE_SCANNER, FRAME = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL", "USGS_ASTRO_FRAME_SENSOR_MODEL"
_NAMES = (LINE_SCANNER, FRAME)
#: A state with the attitude of a long strip has some MB.
MAX_SIZE = 50_000_000
#: A state may be this far (px) from the model that it is of, before it is refused.
CLOSE = 0.1


def has_csm(path: str | PathLike[str]) -> bool:
    """Return whether a file is a CSM state, from its first line."""
    try:
        return read_bounded(path, 200)[:200].lstrip().startswith(tuple(name.encode() for name in _NAMES))
    except InputError:
        return False


@reads(REMEDY)
def read_csm(path: str | PathLike[str]) -> SensorModel:
    """Read the model of a state: a `Pushbroom` or a `FrameCamera`.

    Raises
    ------
    InputError
        If it is no state of the two kinds that are known, of another planet, or something in it is missing or wrong.
    """
    data = read_bounded(path, MAX_SIZE)
    if len(data) > MAX_SIZE:
        raise InputError(
            f"this CSM state is larger than the limit of {MAX_SIZE // 1_000_000} MB",
            file=path,
            field="size",
            remedy=REMEDY,
        )
    name, _, body = data.partition(b"\n")
    if name.strip() not in [one.encode() for one in _NAMES]:
        raise InputError(
            f"this is not the CSM state of a line scanner or a frame; it begins with {name[:40]!r}",
            file=path,
            remedy=REMEDY,
        )
    fields = parse_json(body, path, REMEDY)
    if not isinstance(fields, dict):
        raise InputError("a CSM state must be a JSON object", file=path, remedy=REMEDY)
    state = StateFields(fields, path)
    state.require_earth()
    try:
        return read_line_scanner(state) if name.strip().decode() == LINE_SCANNER else read_frame(state)
    except InputError as error:
        raise InputError(error.message, file=path, field=error.field, remedy=error.remedy or REMEDY) from error


def csm_text(model: SensorModel, *, force: bool = False) -> tuple[str, float]:
    """Return the state of a line scanner or a frame, and by how many pixels it differs from the model at most.

    The most is over all heights of the model; at its reference height it has to be `CLOSE`.

    Raises
    ------
    InputError
        If the model is of another kind, or the state is more than `CLOSE` pixels off it and `force` is not set.
    """
    if isinstance(model, Pushbroom):
        name, fields = LINE_SCANNER, line_scanner_fields(model)
        again: SensorModel = read_line_scanner(StateFields(fields, "state"))
        size = model.camera.size
    elif isinstance(model, FrameCamera):
        name, fields = FRAME, frame_fields(model)
        again, size = read_frame(StateFields(fields, "state")), (model.interior.width, model.interior.height)
    else:
        raise InputError(
            f"a CSM state can only be written for line scanners and frames, not for a model of kind {model.kind!r}",
            field="formats",
            remedy=Text(
                "use a rigorous model, adjusted by its own parameters (",
                Setting("points.correction", "model"),
                "), or another format",
            ),
        )
    # What refraction does at other heights a state cannot have: stated, but no reason to refuse it.
    middle = _apart(model, again, size, (model.reference_height - 1.0, model.reference_height + 1.0))
    worst = max(middle, _apart(model, again, size, model.height_range))
    if not middle <= CLOSE and not force:
        raise InputError(
            f"a CSM state cannot represent the lens of this model; the error would be {middle:.2g} px",
            field="formats",
            remedy=Text("accept this error with ", Setting("force"), ", or choose another format"),
        )
    return f"{name}\n{json.dumps({'m_modelName': name, **fields}, indent=2, sort_keys=True)}\n", worst


def write_csm(model: SensorModel, path: str | PathLike[str], *, force: bool = False) -> float:
    """Write the state of a model to a new file and return its distance from the model, see `csm_text`."""
    text, worst = csm_text(model, force=force)
    Path(path).write_text(text, encoding="utf-8")
    return worst


def _apart(model: SensorModel, again: SensorModel, size: tuple[int, int], heights: tuple[float, float]) -> float:
    """Return the largest difference of two models of one image in pixels; infinite if one has no ground."""
    ground = ground_of_grid(model, size, 7, heights)
    ground = ground[np.isfinite(ground).all(axis=1)]
    theirs = ground_transform(model.crs, again.crs)(ground) if model.crs != again.crs else ground
    apart = np.abs(again.ground_to_image(theirs) - model.ground_to_image(ground))
    return float(apart.max(initial=0.0)) if len(ground) and np.isfinite(apart).all() else math.inf
