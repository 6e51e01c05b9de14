"""Camera files and tables of exterior orientations, checked field by field (docs/formats/frame.md)."""

from __future__ import annotations

import contextlib
import csv
import math
from os import PathLike
from pathlib import Path
from typing import Any

from ortho_frame import orthority
from ortho_frame.fields import DISTORTION_KEYS, interior_of, number
from ortho_frame.pose import Pose, Shot
from ortho_pipeline.plugin import InputError, Interior, counted, place, read_bounded, read_json, reads

MAX_BYTES = 5_000_000
#: A reconstruction also has the points of the whole block.
MAX_JSON_BYTES = 200_000_000
#: Columns of a table, by the ways to write them; the first of each is the name in messages.
MAP_COLUMNS = (("x",), ("y",), ("z",), ("omega",), ("phi",), ("kappa",))
GEOGRAPHIC_COLUMNS = (
    ("lon", "longitude"),
    ("lat", "latitude"),
    ("alt", "altitude", "height", "h"),
    ("roll",),
    ("pitch",),
    ("yaw",),
)
#: OpenSfM's cameras that Brown's model represents exactly.
EXACT = ("brown", "perspective", "simple_radial", "radial")
CAMERA_KEYS = {
    "name",
    "width",
    "height",
    "focal_length_mm",
    "sensor_mm",
    "pixel_pitch_um",
    "principal_point_mm",
    "distortion",
}


# -- the camera ------------------------------------------------------------------------------------------------------


@reads("write the camera file as in docs/formats/frame.md")
def read_camera(
    path: str | PathLike[str], width: int, height: int, name: str | None = None, image: str | None = None
) -> Interior:
    """Read the interior orientation for an image of `width` x `height` pixels.

    `name` chooses among the cameras of a file of OpenSfM or orthority. In a reconstruction of several parts, the camera
    is that of the part with the shot of `image`, because each part has adjusted its cameras.

    A camera of another size with the same proportions is scaled: the image is then a reduced copy.

    Raises
    ------
    InputError
        If the file is not a camera, a field is missing, unknown or wrong, or the proportions differ.
    """
    document = orthority.read_yaml(path) if Path(path).suffix.lower() in (".yaml", ".yml") else _json(path)
    if orthority.is_camera(document):
        interior = orthority.camera_of(path, document, name)
    else:
        interior = _opensfm(path, document, name, image) if _is_opensfm(document) else _own(path, document)
    if interior.width * height != interior.height * width:
        raise InputError(
            f"the camera has {interior.width} x {interior.height} pixels, but the image {width} x {height}",
            file=path,
            field="width, height",
            remedy="give the camera of this image; crops of a frame are not supported",
        )
    ratio = interior.width / width
    fields = {**interior.to_dict(), "width": width, "height": height}
    return Interior(**{**fields, "pitch_x": interior.pitch_x * ratio, "pitch_y": interior.pitch_y * ratio})


def _own(path: str | PathLike[str], document: Any) -> Interior:
    if not isinstance(document, dict):
        raise InputError("a camera file must be a JSON object", file=path, remedy="see docs/formats/frame.md")
    unknown = sorted(set(document) - CAMERA_KEYS)
    if unknown:
        raise InputError(
            "unknown field",
            file=path,
            field=unknown[0] or repr(unknown[0]),
            remedy=f"use one of {', '.join(sorted(CAMERA_KEYS))}",
        )
    width, height = (number(path, key, document.get(key)) for key in ("width", "height"))
    focal = number(path, "focal_length_mm", document.get("focal_length_mm")) * 1e-3
    if ("sensor_mm" in document) == ("pixel_pitch_um" in document):
        raise InputError("give either sensor_mm or pixel_pitch_um", file=path, field="sensor_mm")
    if "sensor_mm" in document:
        across, down = _pair(path, "sensor_mm", document["sensor_mm"])
        if not (width > 0 and height > 0):
            raise InputError("the size of the frame must be positive", file=path, field="width, height")
        pitch = across * 1e-3 / width, down * 1e-3 / height
    else:
        across, down = _pair(path, "pixel_pitch_um", document["pixel_pitch_um"])
        pitch = across * 1e-6, down * 1e-6
    x0, y0 = _pair(path, "principal_point_mm", document.get("principal_point_mm", [0.0, 0.0]))
    lens = document.get("distortion", {})
    if not isinstance(lens, dict) or set(lens) - set(DISTORTION_KEYS):
        raise InputError(
            f"distortion can only have the fields {', '.join(DISTORTION_KEYS)}", file=path, field="distortion"
        )
    brown = {key: number(path, f"distortion.{key}", value) for key, value in lens.items()}
    return interior_of(path, width, height, focal, *pitch, x0=x0 * 1e-3, y0=y0 * 1e-3, **brown)


def _is_opensfm(document: Any) -> bool:
    parts = document if isinstance(document, list) and document else [document]
    first = parts[0]
    return (
        all(isinstance(part, dict) for part in parts)
        and "width" not in first
        and ("cameras" in first or any(isinstance(v, dict) and "projection_type" in v for v in first.values()))
    )


def _opensfm(path: str | PathLike[str], document: Any, name: str | None, image: str | None) -> Interior:
    cameras: dict[str, Any] = {}
    parts = document if isinstance(document, list) else [document]
    names = {Path(image).name, Path(image).stem} if image else set()
    for part in [part for part in parts if names & _object(part, "shots").keys()] or parts:
        cameras |= _object(part, "cameras") if "cameras" in part else part
    if name in cameras:
        cameras = {name: cameras[name]}
    camera = next(iter(cameras.values()), None)
    if len(cameras) != 1 or not isinstance(camera, dict):
        raise InputError(
            f"this file has {counted(len(cameras), 'camera')}",
            file=path,
            field="cameras",
            remedy="give a file with one camera",
        )
    kind = camera.get("projection_type")
    if kind not in EXACT:
        raise InputError(
            f"cameras of the type {kind!r} are not supported: the model of frames cannot represent them exactly",
            file=path,
            field="projection_type",
            remedy=f"use {', '.join(EXACT)}; or the undistorted photos of the project with their cameras",
        )
    width, height = (number(path, key, camera.get(key)) for key in ("width", "height"))
    size = max(width, height) * 1e-6  # with pixels of 1 µm
    focal = camera.get("focal_x", camera.get("focal"))
    focal_x = number(path, "focal_x", focal)
    focal_y = number(path, "focal_y", camera.get("focal_y", focal))
    if not focal_x > 0 or not focal_y > 0:
        raise InputError("the focal length must be positive", file=path, field="focal_x")
    brown = {key: number(path, key, camera.get(key, 0.0)) for key in DISTORTION_KEYS}
    c_x, c_y = (number(path, key, camera.get(key, 0.0)) for key in ("c_x", "c_y"))
    # Its y points down; different focal lengths of the axes are different pitches here.
    return interior_of(
        path,
        width,
        height,
        focal_x * size,
        1e-6,
        1e-6 * focal_x / focal_y,
        x0=c_x * size,
        y0=-c_y * size * focal_x / focal_y,
        **brown,
    )


def _pair(path: str | PathLike[str], field: str, value: Any) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError("this must be a list of two numbers, x first", file=path, field=field)
    return number(path, field, value[0]), number(path, field, value[1])


# -- exterior orientations -------------------------------------------------------------------------------------------


@reads("write one row per image, as in docs/formats/frame.md")
def read_exterior(path: str | PathLike[str], image: str | PathLike[str]) -> Pose | Shot:
    """Return the row of a table of exterior orientations, or the shot of a reconstruction, of an image by its name.

    Raises
    ------
    InputError
        If the columns are unknown, the image is missing or appears twice, or a number is wrong.
    """
    wanted = Path(image)
    if is_reconstruction(path):
        return shot_of(path, _json(path), wanted)
    if is_orthority(path):
        return orthority.pose_in(path, wanted)
    header, rows = _table(path)
    geographic, columns = _columns(path, header)
    matches = [(line, row) for line, row in rows if row and row[0] in (wanted.name, wanted.stem)]
    if len(matches) != 1:
        what = "appears twice" if matches else "is not in this table"
        raise InputError(f"the image {wanted.name} {what}", file=path, field=header[0], remedy="give one row per image")
    line, row = matches[0]
    values = []
    for name, column in columns:
        try:
            value = float(row[column])
        except (IndexError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise InputError("this is not a number", file=path, field=f"line {line}, {name}")
        values.append(value)
    if geographic and not (abs(values[0]) <= 360 and abs(values[1]) <= 90):
        raise InputError("this position is not on Earth", file=path, field=f"line {line}, lon, lat")
    x, y, z, first, second, third = values
    if max(abs(angle) for angle in values[3:]) > 360:
        raise InputError(
            "an angle is beyond 360 degrees",
            file=path,
            field=f"line {line}, {', '.join(name for name, _ in columns[3:])}",
            remedy="give all angles in degrees: those in gon times 0.9",
        )
    camera = row[header.index("camera")] if "camera" in header and header.index("camera") < len(row) else None
    crs = None if geographic else _crs_beside(path)
    return Pose(str(path), f"line {line}", geographic, (x, y, z), (first, second, third), crs, camera)


def _crs_beside(path: str | PathLike[str]) -> str | None:
    """Return the CRS in the file of a table's name with the ending .prj; None without."""
    beside = place(str(path)).with_suffix(".prj")
    if not beside.is_file():
        return None
    return _text(beside).strip() or None


def is_orthority(path: str | PathLike[str]) -> bool:
    """Return whether a file of exterior orientations is orthority's GeoJSON."""
    return Path(path).suffix.lower() == ".geojson"


def is_reconstruction(path: str | PathLike[str]) -> bool:
    """Tell whether a file of exterior orientations is OpenSfM's ``reconstruction.json``, not a table."""
    return Path(path).suffix.lower() == ".json"


def shot_of(path: str | PathLike[str], document: Any, image: Path) -> Shot:
    """Return the shot of an image in the document of a reconstruction."""
    parts = [part for part in (document if isinstance(document, list) else [document]) if isinstance(part, dict)]
    shots = [(part, name) for part in parts for name in (image.name, image.stem) if name in _object(part, "shots")]
    if len(shots) != 1:
        what = "appears twice" if shots else "is not in this reconstruction"
        raise InputError(f"the image {image.name} {what}", file=path, field="shots", remedy="give one shot per image")
    part, name = shots[0]
    shot, place = _object(_object(part, "shots"), name), part.get("reference_lla")
    if not isinstance(place, dict):
        raise InputError(
            "the reconstruction is not georeferenced",
            file=path,
            field="reference_lla",
            remedy="give the georeferenced reconstruction.json, or a table (docs/formats/frame.md)",
        )
    keys = ("longitude", "latitude", "altitude")
    lon, lat, altitude = (number(path, f"reference_lla.{key}", place.get(key)) for key in keys)
    if not (abs(lon) <= 360 and abs(lat) <= 90):
        raise InputError("this position is not on Earth", file=path, field="reference_lla")
    where = f"shots.{name}"
    rotation, translation = (_triple(path, f"{where}.{key}", shot.get(key)) for key in ("rotation", "translation"))
    return Shot(str(path), where, (lon, lat, altitude), rotation, translation, str(shot.get("camera")))


def _object(parent: Any, key: str) -> dict[str, Any]:
    value = parent.get(key) if isinstance(parent, dict) else None
    return value if isinstance(value, dict) else {}


def _triple(path: str | PathLike[str], field: str, value: Any) -> tuple[float, float, float]:
    if not isinstance(value, list) or len(value) != 3:
        raise InputError("this must be a list of three numbers", file=path, field=field)
    x, y, z = (number(path, field, part) for part in value)
    return x, y, z


def _table(path: str | PathLike[str]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    text = [(n, line) for n, line in enumerate(_text(path).splitlines(), start=1) if line.strip()]
    lines = [(n, line) for n, line in text if line[0] != "#"]
    if not lines:
        raise InputError("the table is empty", file=path)
    first = lines[0][1]
    delimiter = next((sign for sign in (",", ";", "\t") if sign in first), " ")
    quote = "'" if first.lstrip().startswith("'") else '"'
    rows = []
    for at, line in lines:
        try:
            cells = next(csv.reader([line.strip()], delimiter=delimiter, quotechar=quote, skipinitialspace=True))
        except (csv.Error, StopIteration) as error:
            raise InputError(f"this row cannot be read ({error})", file=path, field=f"line {at}") from error
        rows.append((at, [cell.strip() for cell in cells]))
    if len(rows[0][1]) >= 7 and all(map(_is_number, rows[0][1][1:7])):
        for _, comment in reversed(text[: text.index(lines[0])]):
            named = [cell.strip().lower() for cell in comment.lstrip("# ").split(delimiter)]
            if len(named) == len(rows[0][1]) and not any(map(_is_number, named)):
                # The header is a comment, as Metashape writes it.
                return named, rows
        # Without a header, as in the tables of many programs.
        return ["filename", *(names[0] for names in MAP_COLUMNS)], rows
    return [cell.lower() for cell in rows[0][1]], rows[1:]


def _is_number(text: str) -> bool:
    with contextlib.suppress(ValueError):
        return math.isfinite(float(text))
    return False


def _columns(path: str | PathLike[str], header: list[str]) -> tuple[bool, list[tuple[str, int]]]:
    for geographic, wanted in ((False, MAP_COLUMNS), (True, GEOGRAPHIC_COLUMNS)):
        columns = [(names[0], header.index(name)) for names in wanted for name in names if name in header]
        if len(columns) == len(wanted):
            return geographic, columns
    raise InputError(
        f"unexpected columns: {', '.join(header)[:120]}",
        file=path,
        field="header",
        remedy="use filename, then x y z omega phi kappa or lon lat alt roll pitch yaw",
    )


# -- text ------------------------------------------------------------------------------------------------------------


def _json(path: str | PathLike[str]) -> Any:
    return read_json(path, MAX_JSON_BYTES, "see docs/formats/frame.md", unique=True)


def _text(path: str | PathLike[str]) -> str:
    data = read_bounded(path, MAX_BYTES, remedy="check the path")
    if len(data) > MAX_BYTES:
        raise InputError(f"this file is larger than the limit of {MAX_BYTES // 1_000_000} MB", file=path)
    try:
        text = data.decode("utf-8-sig")
    except ValueError as error:
        raise InputError("this file is not UTF-8 text", file=path) from error
    if "\0" in text:
        raise InputError("this file is not text", file=path)
    return text
