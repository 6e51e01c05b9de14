r"""Camera files of Ames Stereo Pipeline: pinholes (.tsai), lattices of ASTER (.xml), and adjustments (.adjust).

- ``.tsai``: fu, fv, cu, cv and pitch in one unit; a point (x, y, z) of the camera is at (f x / z + c) / pitch, counted
  from 0 at the first centre; R turns the camera to ECEF, C is its place.
- ASTER: the place of the satellite (ECEF) for rows of a lattice, and for each of its points, pixels counted from 0 at
  the first centre, the direction in camera and in ECEF. Written from Level 1A by `aster2asp`; six digits are 0.05 px.
- ``.adjust``: a translation t (ECEF, m) and a quaternion, scalar first, of R: places become R (S - S_0) + S_0 + t with
  S_0 that of the first pixel, directions R d. It takes the CSM state of a WorldView-3 image to the adjusted state
  that was written with it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.plugin import (
    FrameCamera,
    InputError,
    Interior,
    LineCamera,
    Pushbroom,
    SensorModel,
    XmlFields,
    are_rotations,
    decoded,
    enu_from_ecef,
    geocentric,
    heights_below,
    pushbroom_of_tables,
    read_bounded,
    reads,
    require_view,
    rotations_of_quaternions,
)

Array = NDArray[np.float64]

#: A camera or an adjustment is a few lines.
MAX_SIZE = 100_000
HEIGHTS = (-500.0, 9000.0)
#: Points of a lattice.
_MOST = 1_000_000
#: Six digits of a direction, in pixels of 2.1e-5 rad.
_ROUNDING = 0.05
#: Seconds per row of ASTER's three near-infrared bands; the lattice has no times, and only differences of them count.
ASTER_PERIOD = 2.199e-3
_VENDOR_FROM_CAMERA = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_REMEDY = "write the camera again with Ames Stereo Pipeline"
_FIELD = re.compile(r"^\s*([A-Za-z]\w*)\s*=\s*(.*?)\s*$", re.MULTILINE)


@reads(_REMEDY)
def read_tsai(path: PathLike[str], size: tuple[int, int]) -> FrameCamera:
    """Read a pinhole camera without distortion, for an image of this size."""
    text = _text(path)
    if "PINHOLE" not in text[:200]:
        raise InputError("this is not a pinhole camera", file=path, field="PINHOLE")
    fields = dict(_FIELD.findall(text))
    lens = next((line.strip() for line in text.splitlines()[2:] if re.fullmatch(r"\s*[A-Za-z]+\s*", line)), "NULL")
    if lens.upper() != "NULL":
        raise InputError(f"the distortion {lens[:20]} is not supported", file=path, field="distortion")

    def numbers(name: str, count: int, default: str | None = None) -> Array:
        return _numbers(fields.get(name, default or ""), path, name, count)

    axes = [numbers(f"{name}_direction", 3, text) for name, text in (("u", "1 0 0"), ("v", "0 1 0"), ("w", "0 0 1"))]
    if not np.array_equal(axes, np.eye(3)):
        raise InputError("rotated image axes are not supported", file=path, field="u_direction, v_direction")
    fu, fv, cu, cv, pitch = (float(numbers(name, 1)[0]) for name in ("fu", "fv", "cu", "cv", "pitch"))
    turn = numbers("R", 9).reshape(3, 3)
    if not are_rotations(turn[None]) or not (fu > 0 and fv > 0 and pitch > 0):
        raise InputError("R must be a rotation, and fu, fv and pitch positive", file=path, field="R, fu, fv, pitch")
    centre = numbers("C", 3)
    if not 6e6 < np.linalg.norm(centre) < 1e9:
        raise InputError("this position is not above the Earth", file=path, field="C")
    # Different focal lengths of the axes are different pitches here; from the first centre to its outer corner.
    pitch_y, (width, height) = pitch * fu / fv, size
    interior = Interior(
        width,
        height,
        fu,
        pitch,
        pitch_y,
        x0=(cu / pitch + 0.5 - width / 2) * pitch,
        y0=(height / 2 - cv / pitch - 0.5) * pitch_y,
    )
    model = FrameCamera.from_geocentric(
        interior, centre, np.diag([1.0, -1.0, -1.0]) @ turn.T, heights=heights_below(centre, HEIGHTS)
    )
    require_view(model)
    return model


@reads(_REMEDY)
def read_aster(path: PathLike[str]) -> Pushbroom:
    """Read the lattice of an ASTER camera as a line scanner."""
    file = XmlFields(path, remedy=_REMEDY)
    size = file.integer("IMAGE_COLS"), file.integer("IMAGE_ROWS")
    names = ("LATTICE_POINT", "SIGHT_VECTOR", "WORLD_SIGHT_VECTOR", "SAT_POS")
    points, own, world, places = (
        _numbers(file.text(name), path, name, None, width) for name, width in zip(names, (2, 3, 3, 3), strict=True)
    )
    columns = len(points) // max(1, len(places))
    if columns < 3 or len(places) < 4 or not len(points) == len(own) == len(world) == columns * len(places):
        raise file.error("the numbers of lattice points, directions and positions do not match", ", ".join(names))
    lattice = points.reshape(-1, columns, 2)
    even = (lattice[:, :, 0] == lattice[0, :, 0]).all() and (lattice[:, 0, 1] == lattice[:, :, 1].T).all()
    own, world = (part.reshape(-1, columns, 3) for part in (own, world))
    if not even or not (np.abs(own - own[0]) < 1e-9).all() or not (own[:, :, 2] > 0.1).all():
        raise file.error("this is not the lattice of one line of detectors", "LATTICE_POINT, SIGHT_VECTOR")
    turns = _turns(own[0], world)
    if turns is None:
        raise file.error("no rotation maps the camera directions to the world directions", "WORLD_SIGHT_VECTOR")
    look = own[0] @ _VENDOR_FROM_CAMERA
    times = (lattice[:, 0, 1] + 0.5) * ASTER_PERIOD
    try:
        model = pushbroom_of_tables(
            LineCamera.of_table(
                *size, lattice[0, :, 0] + 0.5, look[:, 0] / look[:, 2], look[:, 1] / look[:, 2], rounding=_ROUNDING
            ),
            line_period=ASTER_PERIOD,
            first_time=0.0,
            orbit=(times, places),
            attitude=(times, turns @ _VENDOR_FROM_CAMERA),
            heights=HEIGHTS,
        )
        require_view(model)
    except InputError as error:
        raise InputError(error.message, file=path, field=error.field, remedy=error.remedy or _REMEDY) from error
    return model


@reads(_REMEDY)
def read_adjust(path: PathLike[str]) -> tuple[Array, Array]:
    """Return translation ``(3,)`` and rotation ``(3, 3)`` of an adjustment."""
    values = _numbers(_text(path), path, "numbers", 7)
    if not 0.99 < np.linalg.norm(values[3:]) < 1.01 or not np.abs(values[:3]).max() < 1e6:
        raise InputError("this must be a translation and a rotation", file=path, field="numbers")
    return values[:3], rotations_of_quaternions(values[None, 3:])[0]


def adjusted(model: SensorModel, translation: Array, rotation: Array) -> SensorModel:
    """Return a camera after the translation and rotation of an adjustment.

    Raises
    ------
    InputError
        If it is neither a line scanner nor a frame over geographic ground.
    """
    if isinstance(model, FrameCamera):
        # Of a camera file all are topocentric.
        place = geocentric(model.perspective_centre[None])[0]
        turn = model.rotation @ enu_from_ecef(np.array([model.origin]))[0] @ rotation.T
        return FrameCamera.from_geocentric(
            model.interior, place + translation, turn, heights=model.heights, refraction=model.refraction
        )
    if isinstance(model, Pushbroom):
        first = model.flight.positions(np.array([0.5 * model.line_period]), 0)[0]
        origin = rotation @ (model.origin - first) + first + translation
        return replace(model, origin=origin, orbital=rotation @ model.orbital)
    raise InputError(
        f"adjustments of a model of kind {model.kind!r} are not supported",
        field="adjust",
        remedy="give the adjusted camera that bundle_adjust also writes",
    )


def _turns(own: Array, world: Array) -> Array | None:
    """Return the rotations ``(rows, 3, 3)`` from camera to ECEF that fit the directions best; None if none fits."""
    with np.errstate(all="ignore"):
        left, _, right = np.linalg.svd(np.einsum("rci,cj->rij", world, own))
        signs = np.ones((len(world), 3))
        signs[:, 2] = np.linalg.det(left @ right)
        turns = (left * signs[:, None, :]) @ right
        miss = np.abs(np.einsum("rij,cj->rci", turns, own) - world).max()
    return np.asarray(turns) if miss < 1e-5 else None


def _text(path: PathLike[str]) -> str:
    data = read_bounded(path, MAX_SIZE)
    if len(data) > MAX_SIZE:
        raise InputError("this file is larger than 100 kB, too large for a camera", file=path, field="size")
    return decoded(data)


def _numbers(text: str, path: PathLike[str], field: str, count: int | None, width: int = 1) -> Array:
    """Return the finite numbers of a text, `count` of them, or any number of rows of `width`."""
    tokens = text.split(maxsplit=_MOST)
    wrong = len(tokens) != count if count is not None else len(tokens) % width or not 0 < len(tokens) < _MOST
    try:
        values = np.array([float(token[:60]) for token in tokens])
    except ValueError:
        values = np.array([np.nan])
    if wrong or not np.isfinite(values).all() or not np.abs(values).max(initial=0.0) < 1e15:
        raise InputError(f"this must be {count or 'rows of'} numbers", file=path, field=field)
    return values if width == 1 else values.reshape(-1, width)
