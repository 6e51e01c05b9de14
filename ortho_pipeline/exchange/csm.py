"""CSM model states of the USGS: line scanners and frames as Ames Stereo Pipeline and ISIS hand them on.

A state is a line with the name of the model and a JSON object. What the numbers mean is that of the library usgscsm:
line and sample 0.5 are the centre of the first pixel, as here; angles are quaternions to ECEF, scalar last; heights are
ellipsoidal. A state has neither aberration nor refraction: they are in its angles, or left out.

Source: usgscsm (`UsgsAstroLsSensorModel`, `UsgsAstroFrameSensorModel`, `Utilities`), CSM 3.0.3.
"""

from __future__ import annotations

import json
import math
from os import PathLike
from typing import Any

import numpy as np

from ortho_pipeline import files
from ortho_pipeline.errors import InputError, reads
from ortho_pipeline.files import parse_json, read_bounded
from ortho_pipeline.geodesy.ellipsoid import SEMI_MAJOR
from ortho_pipeline.models.base import Array, SensorModel, ground_of_grid
from ortho_pipeline.options.texts import Setting, Text

LINE_SCANNER, FRAME = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL", "USGS_ASTRO_FRAME_SENSOR_MODEL"
_NAMES = (LINE_SCANNER, FRAME)
#: A state with the attitude of a long strip has some MB.
MAX_SIZE = 50_000_000
MOST_VALUES = 2_000_000
#: A state may be this far (px) from the model that it is of, before it is refused.
CLOSE = 0.1
_REMEDY = "write the state again with the program that it is of"


class State:
    """The fields of a state, each with an error that names file and field."""

    def __init__(self, fields: dict[str, Any], path: str | PathLike[str]) -> None:
        self.fields, self.path = fields, path

    def error(self, message: str, field: str) -> InputError:
        """Return the error that a field is."""
        return InputError(message, file=self.path, field=field, remedy=_REMEDY)

    def numbers(self, field: str, count: int | None = None) -> Array:
        """Return the numbers of a list."""
        value = self.fields.get(field)
        if not isinstance(value, list) or len(value) > MOST_VALUES or (count is not None and len(value) != count):
            raise self.error(f"{count or 'a list of'} numbers belong here", field)
        if not all(isinstance(one, int | float) and not isinstance(one, bool) for one in value):
            raise self.error("this is not a list of numbers", field)
        found = np.array(value, dtype=np.float64)
        if not (np.abs(found) < 1e15).all():
            raise self.error("a number is too large", field)
        return found

    def number(self, field: str, default: float | None = None) -> float:
        """Return a number."""
        value = self.fields.get(field, default)
        if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e15:
            raise self.error("a number belongs here", field)
        return float(value)

    def size(self) -> tuple[int, int]:
        """Return columns and rows."""
        found = []
        for field in ("m_nSamples", "m_nLines"):
            value = self.number(field)
            if value != int(value) or not 1 <= value <= 10_000_000:
                raise self.error("this is not a size of an image", field)
            found.append(int(value))
        return found[0], found[1]

    def heights(self, default: tuple[float, float]) -> tuple[float, float]:
        """Return lowest and highest ellipsoidal height of the ground, within those of mountains."""
        low = max(self.number("m_minElevation", default[0]), default[0])
        high = min(self.number("m_maxElevation", default[1]), default[1])
        return (low, high) if low < high else default

    def radial(self) -> tuple[float, float, float]:
        """Return the terms of a radial distortion; refuse a lens of another kind."""
        terms = self.numbers("m_opticalDistCoeffs")
        if not terms.any():
            return 0.0, 0.0, 0.0
        if self.number("m_distortionType", 0.0) != 0 or len(terms) != 3:
            raise self.error("a distortion that is not radial is not read", "m_distortionType")
        return float(terms[0]), float(terms[1]), float(terms[2])

    def require_earth(self) -> None:
        """Refuse other planets."""
        if abs(self.number("m_majorAxis") - SEMI_MAJOR) > 1.0:
            raise self.error("this is another ellipsoid than that of the Earth", "m_majorAxis")


def has_csm(path: str | PathLike[str]) -> bool:
    """Tell whether a file is a CSM state, from its first line."""
    try:
        return read_bounded(path, 200)[:200].lstrip().startswith(tuple(name.encode() for name in _NAMES))
    except InputError:
        return False


@reads(_REMEDY)
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
            f"a state of more than {MAX_SIZE // 1_000_000} MB is not read", file=path, field="size", remedy=_REMEDY
        )
    name, _, body = data.partition(b"\n")
    if name.strip() not in [one.encode() for one in _NAMES]:
        raise InputError(
            f"this is not a CSM state of a line scanner or a frame: it begins with {name[:40]!r}", file=path,
            remedy=_REMEDY,
        )  # fmt: skip
    fields = parse_json(body, path, _REMEDY)
    if not isinstance(fields, dict):
        raise InputError("a state is a JSON object", file=path, remedy=_REMEDY)
    state = State(fields, path)
    state.require_earth()
    try:
        if name.strip().decode() == LINE_SCANNER:
            from ortho_pipeline.exchange.csm_line_scanner import read_line_scanner

            return read_line_scanner(state)
        from ortho_pipeline.exchange.csm_frame import read_frame

        return read_frame(state)
    except InputError as error:
        raise InputError(error.message, file=path, field=error.field, remedy=error.remedy or _REMEDY) from error


def csm_text(model: SensorModel, *, force: bool = False) -> tuple[str, float]:
    """Return the state of a line scanner or a frame, and by how many pixels it differs from the model at most.

    The most is over all heights of the model; at its reference height it has to be `CLOSE`.

    Raises
    ------
    InputError
        If the model is of another kind, or the state is more than `CLOSE` pixels off it and `force` is not set.
    """
    from ortho_pipeline.exchange import csm_frame, csm_line_scanner
    from ortho_pipeline.models.frame.camera import FrameCamera
    from ortho_pipeline.models.pushbroom.scanner import Pushbroom

    if isinstance(model, Pushbroom):
        name, fields = LINE_SCANNER, csm_line_scanner.line_scanner_fields(model)
        again: SensorModel = csm_line_scanner.read_line_scanner(State(fields, "state"))
        size = model.camera.size
    elif isinstance(model, FrameCamera):
        name, fields = FRAME, csm_frame.frame_fields(model)
        again, size = csm_frame.read_frame(State(fields, "state")), (model.interior.width, model.interior.height)
    else:
        raise InputError(
            f"a model of kind {model.kind!r} has no CSM state: line scanners and frames have one", field="formats",
            remedy=Text(
                "take a rigorous model, adjusted by its own parameters (", Setting("points.correction", "model"),
                "), or another format"
            ),
        )  # fmt: skip
    # What refraction does at other heights a state cannot have: stated, but no reason to refuse it.
    middle = _apart(model, again, size, (model.reference_height - 1.0, model.reference_height + 1.0))
    worst = max(middle, _apart(model, again, size, model.height_range))
    if not middle <= CLOSE and not force:
        raise InputError(
            f"the state would be {middle:.2g} px off the model, whose lens it cannot have", field="formats",
            remedy=Text("accept it with ", Setting("force"), ", or write an RPC"),
        )  # fmt: skip
    return f"{name}\n{json.dumps({'m_modelName': name, **fields}, indent=2, sort_keys=True)}\n", worst


def write_csm(model: SensorModel, path: str | PathLike[str], *, force: bool = False) -> float:
    """Write the state of a model, see `csm_text`."""
    text, worst = csm_text(model, force=force)
    files.write_text(path, text)
    return worst


def _apart(model: SensorModel, again: SensorModel, size: tuple[int, int], heights: tuple[float, float]) -> float:
    """Return by how many pixels two models of one image differ at most; infinite where one sees nothing."""
    from ortho_pipeline.geodesy.crs import ground_transform

    ground = ground_of_grid(model, size, 7, heights)
    ground = ground[np.isfinite(ground).all(axis=1)]
    theirs = ground_transform(model.crs, again.crs)(ground) if model.crs != again.crs else ground
    apart = np.abs(again.ground_to_image(theirs) - model.ground_to_image(ground))
    return float(apart.max(initial=0.0)) if len(ground) and np.isfinite(apart).all() else math.inf
