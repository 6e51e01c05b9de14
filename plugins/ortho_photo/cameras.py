"""The camera of a photo: focal length, size of the sensor, and the lens where the maker calibrated it.

The first that a photo has is used: the options, DJI's calibration (``DewarpData``), Pix4D's camera tags, the table of
sensors here, the resolution in the focal plane, DJI's nominal focal length in pixels, the focal length in 35 mm film.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from ortho_photo.tags import Tags
from ortho_pipeline.plugin import InputError, Interior, Setting, Text

#: Width (mm) of sensors, and columns and rows of their largest photo, by the model in EXIF, where it tells the camera;
#: from the makers' specifications.
SENSORS = {
    "FC220": (6.17, 4000, 3000),  # Mavic Pro
    "FC300S": (6.17, 4000, 3000),  # Phantom 3 Advanced
    "FC300X": (6.17, 4000, 3000),  # Phantom 3 Professional
    "FC330": (6.17, 4000, 3000),  # Phantom 4
    "FC3411": (13.2, 5472, 3648),  # Air 2S
    "FC6310": (13.2, 5472, 3648),  # Phantom 4 Pro
    "FC6310R": (13.2, 5472, 3648),  # Phantom 4 RTK
    "FC6310S": (13.2, 5472, 3648),  # Phantom 4 Pro 2.0
    "L1D-20c": (13.2, 5472, 3648),  # Mavic 2 Pro
    "L2D-20c": (17.3, 5280, 3956),  # Mavic 3
    "M3E": (17.3, 5280, 3956),  # Mavic 3 Enterprise
    "ZenmuseP1": (35.9, 8192, 5460),
    "S.O.D.A.": (12.75, 5472, 3648),
}
#: DJI's focal length in pixels counts more than that of EXIF if they differ by more than this part.
_ALIKE = 0.05
#: Focal lengths whose ratio is more than this cannot be of one photo.
_CONTRARY = 1.2
#: The optical centre is nearer to the middle of a photo than this part of half the width or height.
_NEAR = 0.03
#: A digital zoom of more than this makes a photo of a part of the sensor.
_ZOOMED = 1.01
#: Millimetres of a unit of FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre.
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}
#: Diagonal (mm) of a frame of 35 mm film, and the shape of this frame.
_FILM_MM, _FILM_SHAPE = math.hypot(36.0, 24.0), 1.5
#: Standard deviations of the focal length and principal point, in parts of the focal length, and of distortion: of a
#: maker's calibration, and of a nominal camera without distortion.
CALIBRATED = {
    "focal_length": 0.005,
    "x0": 0.003,
    "y0": 0.003,
    "k1": 0.01,
    "k2": 0.01,
    "k3": 0.01,
    "p1": 1e-3,
    "p2": 1e-3,
}
NOMINAL = {"focal_length": 0.02, "x0": 0.005, "y0": 0.005, "k1": 0.03, "k2": 0.02, "k3": 0.01, "p1": 1e-3, "p2": 1e-3}
#: Whole millimetres, which makers round further: cameras of known sensors differ by up to 3 %.
FILM = NOMINAL | {"focal_length": 0.03}
_PIXEL = 1e-6
_NO_CROPS = "give the whole photo; crops are not supported"
_TURNED = "a program has turned this photo, so its angles do not fit its pixels: give the photo as the camera wrote it"
_REMEDY = "give the sensor option sensor_width=MILLIMETRES, or camera=FILE (docs/formats/frame.md)"


@dataclass(frozen=True)
class PhotoCamera:
    """The camera of a photo, its source, and how exactly that knows it (in parts of the focal length; distortion)."""

    interior: Interior
    source: str
    known: Mapping[str, float] = field(default_factory=lambda: NOMINAL)

    @property
    def pixels(self) -> float:
        """Focal length in pixels of the file."""
        return self.interior.focal_length / self.interior.pitch_x

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations of parameters of the interior orientation, in their units."""
        metres, frame = self.interior.focal_length, self.interior
        found = {
            name: part * metres if name in ("focal_length", "x0", "y0") else part for name, part in self.known.items()
        }
        # Pixels are square. A calibration with two focal lengths says otherwise, and is not always right.
        return found if frame.pitch_x == frame.pitch_y else found | {"pitch_y": abs(frame.pitch_y - frame.pitch_x)}


def camera_of(tags: Tags, width: int, height: int, sensor_width: float | None) -> PhotoCamera:
    """Return the camera of a photo of `width` x `height` pixels.

    Parameters
    ----------
    sensor_width : float, optional
        mm; counts more than all tags.

    Raises
    ------
    InputError
        If nothing tells the focal length in pixels, tags contradict each other, the lens is a fisheye, or the photo is
        a crop or a panorama.
    """
    full, full_rows = _full_size(tags, width, height)
    if tags.text("Camera:ModelType").lower() == "fisheye":
        raise tags.error(
            "the lens is a fisheye, which the model of frames cannot represent",
            "Camera:ModelType",
            "make undistorted photos with OpenDroneMap or Pix4D, and use these",
        )
    if projection := tags.text("GPano:ProjectionType"):
        raise tags.error(
            f"this image is a panorama ({projection}) of several photos",
            "GPano:ProjectionType",
            "leave it out, and give the photos",
        )
    focal = tags.positive("FocalLength")
    if sensor_width is not None:
        if focal is None:
            raise tags.error("the tags have no focal length", "FocalLength", "give camera=FILE (docs/formats/frame.md)")
        # A sensor is wider than high, also in photos that are stored as portraits.
        pixels = focal / sensor_width * max(width, height)
        return PhotoCamera(_plain(width, height, pixels), "sensor width of the options")
    if (zoom := tags.positive("DigitalZoomRatio") or 1.0) > _ZOOMED:
        raise tags.error(
            f"this photo was zoomed digitally by {zoom:g}: it shows a part of the sensor",
            "DigitalZoomRatio",
            Text(
                f"give the width of that part, which is the width of the sensor divided by {zoom:g}, with ",
                Setting("scene.sensor_options", "MILLIMETRES", key="sensor_width"),
            ),
        )
    by_sensor = _of_sensor(tags, width, height, (full, full_rows))
    stated = by_sensor or _of_film(tags, width, height)
    try:
        dewarped = _dewarped(tags, width, height, full)
        by_pix4d = None if dewarped else _of_pix4d(tags, width, height, full)
    except InputError as error:
        raise tags.error(error.message, error.field or "", _REMEDY) from error
    if dewarped is not None:
        return _agreeing(tags, dewarped, stated, "drone-dji:DewarpData")
    if by_pix4d is not None:
        return _upright(tags, by_pix4d)
    if nominal := tags.positive("drone-dji:CalibratedFocalLength"):
        camera = PhotoCamera(_plain(width, height, nominal * width / full), "nominal focal length in pixels")
        if by_sensor is None or abs(camera.pixels / by_sensor.pixels - 1) > _ALIKE:
            return _agreeing(tags, camera, stated, "drone-dji:CalibratedFocalLength")
    if stated is not None:
        return stated
    model = tags.text("Model", "tiff:Model") or "unknown"
    raise tags.error(f"the size of the sensor of this camera ({model}) is not known", "sensor_width", _REMEDY)


def _full_size(tags: Tags, width: int, height: int) -> tuple[float, float]:
    """Return the size of the whole photo (px): the file may be a reduced copy of it, but no crop."""
    full, rows = tags.positive("PixelXDimension"), tags.positive("PixelYDimension")
    if not full or not rows:
        full, rows = float(width), float(height)
    # A reduced copy has whole pixels.
    if abs(full * height - rows * width) > max(full, rows):
        turned = abs(full * width - rows * height) <= max(full, rows)
        raise tags.error(
            f"the photo has {full:.0f} x {rows:.0f} pixels by its tags, but the file {width} x {height}",
            "PixelXDimension",
            _TURNED if turned else _NO_CROPS,
        )
    scale = _scale(tags, full, rows)
    return full * scale, rows * scale


def _scale(tags: Tags, full: float, rows: float) -> float:
    """Return how much larger the calibrated photo is: programs that reduce photos often write the new size into EXIF.

    The optical centre of DJI's calibration is near the middle.
    """
    x, y = (tags.positive(f"drone-dji:CalibratedOpticalCenter{axis}") for axis in "XY")
    if x is None:
        return 1.0
    y = y or x * rows / full
    # Some photos are stored as portraits.
    longer, shorter = 2 * max(x, y) / max(full, rows), 2 * min(x, y) / min(full, rows)
    if min(abs(longer - 1), abs(shorter - 1)) < _NEAR:
        return 1.0
    if abs(longer / shorter - 1) > 2 * _NEAR:
        raise tags.error(
            f"the calibration is of a photo of about {2 * x:.0f} x {2 * y:.0f} pixels, "
            f"but the photo has {full:.0f} x {rows:.0f} by its tags",
            "drone-dji:CalibratedOpticalCenterX",
            _NO_CROPS,
        )
    return longer


def _agreeing(tags: Tags, camera: PhotoCamera, stated: PhotoCamera | None, field: str) -> PhotoCamera:
    """Return DJI's camera, unless the focal length of EXIF contradicts it."""
    if stated is not None and not 1 / _CONTRARY < camera.pixels / stated.pixels < _CONTRARY:
        raise tags.error(
            f"this tag states a focal length of {camera.pixels:.0f} px, but EXIF one of {stated.pixels:.0f} px",
            field,
            Text(
                "give the photo as the camera wrote it, or state the width of the sensor with ",
                Setting("scene.sensor_options", "MILLIMETRES", key="sensor_width"),
            ),
        )
    return camera


def _plain(width: int, height: int, pixels: float) -> Interior:
    """Return a camera without distortion by its focal length in pixels of the file."""
    return Interior(width, height, pixels * _PIXEL, _PIXEL, _PIXEL)


def _of_sensor(tags: Tags, width: int, height: int, full: tuple[float, float]) -> PhotoCamera | None:
    """Return the camera by its focal length (mm), and its model or the resolution in the focal plane."""
    focal, pitch = tags.positive("FocalLength"), _pitch_mm(tags)
    if focal and (sensor := SENSORS.get(tags.text("Model", "tiff:Model"))):
        sensor_mm, columns, rows = sensor
        # A photo of another shape, as 4:3 of a sensor of 3:2, is the largest part of the sensor with this shape.
        # A reduced copy has whole pixels, so one row more is no other shape.
        by_rows = columns / rows
        whole = max(full) if max(full) > (min(full) - 1) * by_rows else min(full) * by_rows
        pixels = focal / sensor_mm * whole * width / full[0]
        return PhotoCamera(_plain(width, height, pixels), "focal length, and a known sensor")
    if focal and pitch:
        pixels = focal / pitch * width / full[0]
        return PhotoCamera(_plain(width, height, pixels), "focal length, and resolution in the focal plane")
    return None


def _of_film(tags: Tags, width: int, height: int) -> PhotoCamera | None:
    """Return the camera by the focal length in 35 mm film, which has the same angle along the diagonal.

    Source: CIPA DCG-001. A longer shape than that of film shows a part of the rows.
    """
    film = tags.positive("FocalLengthIn35mmFilm")
    if not film:
        return None
    longer = max(width, height)
    pixels = film / _FILM_MM * math.hypot(longer, max(min(width, height), longer / _FILM_SHAPE))
    return PhotoCamera(_plain(width, height, pixels), "focal length in 35 mm film, rounded", FILM)


def _dewarped(tags: Tags, width: int, height: int, full: float) -> PhotoCamera | None:
    """Return DJI's calibration: date; fx, fy, cx, cy (px, from the middle, y down), k1, k2, p1, p2, k3 of OpenCV."""
    text, done = tags.text("drone-dji:DewarpData"), tags.number("drone-dji:DewarpFlag")
    if not text or done:  # a photo that was dewarped has another camera
        return None
    values = tags.numbers_of(text.rpartition(";")[2], "drone-dji:DewarpData")
    if len(values) != 9:
        raise tags.error(f"{len(values)} numbers instead of 9", "drone-dji:DewarpData")
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    if not fx > 0 or not fy > 0:
        raise tags.error("the focal length must be positive", "drone-dji:DewarpData")
    pixel = _PIXEL * full / width
    # Different focal lengths of the axes are different pitches here.
    interior = Interior(
        width, height, fx * _PIXEL, pixel, pixel * fx / fy, cx * _PIXEL, -cy * _PIXEL * fx / fy, k1, k2, k3, p1, p2
    )
    return PhotoCamera(interior, "the maker's calibration (DewarpData)", CALIBRATED)


def _of_pix4d(tags: Tags, width: int, height: int, full: float) -> PhotoCamera | None:
    """Return the camera of Pix4D's tags: mm, from the upper left corner, R1, R2, R3, T1, T2.

    The focal length may be in pixels (MicaSense's imageprocessing, metadata.py).
    """
    focal, pitch = tags.positive("Camera:PerspectiveFocalLength"), _pitch_mm(tags)
    if not focal or not pitch:
        return None
    if tags.text("Camera:PerspectiveFocalLengthUnits").lower() in ("pixel", "pixels", "px"):
        focal *= pitch
    pixel = pitch * 1e-3 * full / width
    lens = tags.numbers("Camera:PerspectiveDistortion") or [0.0] * 5
    middle = [width * pixel * 500, height * pixel * 500]
    place = tags.numbers("Camera:PrincipalPoint") or middle
    if len(lens) != 5 or len(place) != 2:
        raise tags.error("a camera tag has the wrong count of numbers", "Camera:PerspectiveDistortion")
    r1, r2, r3, t1, t2 = lens
    x0, y0 = (place[0] - middle[0]) * 1e-3, (middle[1] - place[1]) * 1e-3
    interior = Interior(width, height, focal * 1e-3, pixel, pixel, x0, y0, r1, r2, r3, t1, t2)
    return PhotoCamera(interior, "the maker's calibration (Pix4D's camera tags)", CALIBRATED)


def _upright(tags: Tags, camera: PhotoCamera) -> PhotoCamera:
    """Return a camera, unless its principal point is that of the photo before it was turned from landscape."""
    frame = camera.interior
    middle = frame.width * frame.pitch_x / 2, frame.height * frame.pitch_y / 2
    place = middle[0] + frame.x0, middle[1] - frame.y0
    if math.dist(place, middle[::-1]) < math.dist(place, middle) / 2:
        raise tags.error(
            f"the principal point is that of a photo of another shape than {frame.width} x {frame.height} pixels",
            "Camera:PrincipalPoint",
            _TURNED,
        )
    return camera


def _pitch_mm(tags: Tags) -> float | None:
    """Return the size (mm) of a pixel of the whole photo by its resolution in the focal plane."""
    resolution, unit = tags.positive("FocalPlaneXResolution"), tags.number("FocalPlaneResolutionUnit")
    millimetres = _UNIT_MM.get(int(unit)) if unit is not None else None
    return millimetres / resolution if millimetres and resolution else None
