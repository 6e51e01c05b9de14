"""Where a photo was taken and where its camera looked, by its tags.

Two conventions of angles occur. Both have yaw clockwise from true north and rotate in the order yaw, pitch, roll.

- DJI's gimbal: pitch 0 looks at the horizon, -90 straight down; roll turns about the optical axis (north, east, down;
  order ZYX, as in DJI's manuals).
- Pix4D's camera tags, which senseFly, Parrot, MicaSense and Autel write: pitch 0 looks straight down, 90 forward. The
  axes are those of `FrameCamera.from_roll_pitch_yaw`. senseFly's own tags have the roll of the other sign.

Source: DJI Mavic 3M and Matrice 4 user manuals, "Photo file"; Pix4D, "Yaw, Pitch, Roll and Omega, Phi, Kappa angles"
and "Specifications of XMP Camera tags"; OpenDroneMap, opendm/photo.py (sign of senseFly's roll).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from ortho_photo.position import Position, position_of
from ortho_photo.tags import Tags
from ortho_pipeline.plugin import Array, Setting, Text, camera_from_platform

#: Standard deviation (degrees) of each angle: a compass near motors.
ANGLE = 3.0
#: Values of the option ``pitch``.
HORIZON, NADIR = "horizon", "nadir"
#: A camera that looks flatter than this (degrees from straight down) sees the horizon.
FLATTEST_DEG = 85.0


@dataclass(frozen=True)
class PhotoPose:
    """A pose with its sources.

    Parameters
    ----------
    position : Position
        Where the photo was taken.
    rotation : ndarray (3, 3)
        From north, east, down to camera axes (x right, y up, z backwards).
    angles : (float, float, float)
        Yaw, pitch, roll (degrees) as written.
    convention : {'horizon', 'nadir'}
        Where pitch is zero.
    datum : str
        Height datum that the tags state, or empty.
    """

    position: Position
    rotation: Array
    angles: tuple[float, float, float]
    convention: str
    datum: str

    @property
    def tilt_deg(self) -> float:
        """Angle between the optical axis and straight down."""
        return math.degrees(math.acos(max(-1.0, min(1.0, -float(self.rotation[2, 2])))))


def pose_of(tags: Tags, pitch: str | None, takeoff: float | None = None) -> PhotoPose:
    """Return the pose in the tags; `pitch` says where pitch is zero, if the tags say it wrongly.

    Altitudes above take-off count from the height of the `takeoff` (m).

    Raises
    ------
    InputError
        If position, altitude or angles are missing or impossible.
    """
    position = position_of(tags, takeoff)
    angles, convention = _angles(tags, pitch)
    return PhotoPose(position, rotation_of(angles, convention), angles, convention, _datum(tags))


def rotation_of(angles: tuple[float, float, float], convention: str) -> Array:
    """Return the rotation ``(3, 3)`` from north, east, down to camera axes of yaw, pitch, roll (degrees).

    Examples
    --------
    >>> rotation_of((0.0, -90.0, 0.0), HORIZON).round(12) + 0.0
    array([[ 0.,  1.,  0.],
           [ 1.,  0.,  0.],
           [ 0.,  0., -1.]])
    """
    yaw, pitch, roll = np.radians(angles).tolist()
    if convention == NADIR:
        return camera_from_platform(roll, pitch, yaw)
    # The roll turns about the optical axis, which is the camera's third axis backwards.
    about_axis = np.array(
        [[math.cos(roll), -math.sin(roll), 0.0], [math.sin(roll), math.cos(roll), 0.0], [0.0, 0.0, 1.0]]
    )
    return np.asarray(about_axis @ camera_from_platform(0.0, pitch + math.pi / 2, yaw))


def _angles(tags: Tags, pitch: str | None) -> tuple[tuple[float, float, float], str]:
    for space, names, convention in (
        ("drone-dji", ("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"), HORIZON),
        ("Camera", ("Yaw", "Pitch", "Roll"), NADIR),
        ("senseFly", ("Yaw", "Pitch", "Roll"), NADIR),
    ):
        found = [tags.number(f"{space}:{name}") for name in names]
        if all(value is None for value in found):
            continue
        yaw, tilt, roll = found
        if yaw is None or tilt is None or roll is None:
            raise tags.error("one of yaw, pitch and roll is missing", f"{space}:{names[0]}")
        if not all(abs(value) <= 360 for value in (yaw, tilt, roll)):
            raise tags.error("an angle is beyond 360 degrees", f"{space}:{names[0]}")
        if (yaw, tilt, roll) == (0.0, 0.0, 0.0) and convention == HORIZON and pitch is None:
            raise tags.error(
                "all gimbal angles are exactly 0: this drone does not record them", f"{space}:GimbalPitchDegree"
            )
        if space == "Camera" and pitch is None:
            _refuse_two_readings(tags, tilt)
        if space == "senseFly" or (space == "Camera" and tags.text("Make").lower() == "sensefly"):
            roll = -roll
        return (yaw, tilt, roll), pitch or convention
    raise tags.error("this photo has no camera angles", "Yaw, Pitch, Roll")


def _refuse_two_readings(tags: Tags, tilt: float) -> None:
    """Raise if a camera of Autel looks at the ground by both conventions: some write zero at the horizon."""
    if tags.text("Make", "tiff:Make").lower().startswith("autel") and -FLATTEST_DEG < tilt < FLATTEST_DEG - 90:
        raise tags.error(
            f"a pitch of {tilt:g} is {-tilt:g} degrees backwards from straight down, or {90 + tilt:g} forwards if the "
            "pitch is zero at the horizon. Cameras of Autel write both",
            "Camera:Pitch",
            Text(
                "find out which one is right, and add ",
                Setting("scene.sensor_options", HORIZON, key="pitch"),
                " or ",
                Setting("scene.sensor_options", NADIR, key="pitch"),
            ),
        )


def _datum(tags: Tags) -> str:
    """Return the height datum that Pix4D's tag states, in the words of the option ``vertical``; else empty."""
    stated = tags.text("Camera:VertCS")
    return "ellipsoid" if stated.lower() == "ellipsoidal" else stated
