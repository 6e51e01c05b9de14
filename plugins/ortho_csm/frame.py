r"""The CSM state of a frame.

The parameters are the place X, Y, Z (ECEF) and the quaternion x, y, z, w of the rotation R to ECEF. A point P has
:math:`p = R^T (P - X)`, in the focal plane (x, y) = f (p_x, p_y) / p_z plus ``m_samplePp``, ``m_linePp``, and

.. math:: sample = (S_0 + S_1 x + S_2 y + o_s - s_0) / sum_s, \qquad line = (L_0 + L_1 x + L_2 y + o_l - l_0) / sum_l

with o of ``m_ccdCenter`` (line first).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ortho_csm.state import StateFields
from ortho_pipeline.plugin import (
    ECCENTRICITY_SQUARED,
    GEOGRAPHIC,
    SEMI_MAJOR,
    TOPOCENTRIC,
    Array,
    FrameCamera,
    Interior,
    enu_from_ecef,
    geocentric,
    geocentric_of_map,
    ground_transform,
    heights_below,
    rotations_of_quaternions,
)

HEIGHTS = (-500.0, 9000.0)
#: Axes of the state's camera (x right, y down, z to the scene) in those of ours (x right, y up, z backwards).
_OURS_FROM_THEIRS = np.diag([1.0, -1.0, -1.0])
#: Fields that a state has to have, and that a camera does not know.
_IDENTIFIERS = (
    *(f"m_{name}Identifier" for name in ("image", "collection", "platform", "sensor", "trajectory")),
    "m_dateTime",
)


def read_frame(state: StateFields) -> FrameCamera:
    """Make a frame camera of a state."""
    width, height = state.size()
    if any(state.radial()):
        raise state.error("frames with lens distortion are not supported", "m_opticalDistCoeffs")
    values = state.numbers("m_currentParameterValue", 7)
    if not 0.99 < np.linalg.norm(values[3:]) < 1.01:
        raise state.error("the quaternion does not have length one", "m_currentParameterValue")
    if not 6e6 < np.linalg.norm(values[:3]) < 1e9:
        raise state.error("this position is not above the Earth", "m_currentParameterValue")
    focal = state.number("m_focalLength")
    sample, line = state.numbers("m_iTransS", 3), state.numbers("m_iTransL", 3)
    if sample[2] or line[1] or not (sample[1] > 0 and line[2] > 0 and focal > 0):
        raise state.error("mirrored, rotated or skewed pixels are not supported", "m_iTransS, m_iTransL")
    centre = state.numbers("m_ccdCenter", 2)
    sums = [state.number(f"m_detector{name}Summing", 1.0) for name in ("Sample", "Line")]
    if not all(value > 0 for value in sums):
        raise state.error("the summing must be positive", "m_detectorSampleSumming")
    column = (
        sample[0]
        + sample[1] * state.number("m_samplePp", 0.0)
        + centre[1]
        - state.number("m_startingDetectorSample", 0.0)
    ) / sums[0]
    row = (
        line[0] + line[2] * state.number("m_linePp", 0.0) + centre[0] - state.number("m_startingDetectorLine", 0.0)
    ) / sums[1]
    pitch_x, pitch_y = sums[0] / sample[1], sums[1] / line[2]
    interior = Interior(
        width, height, focal, pitch_x, pitch_y, x0=(column - width / 2) * pitch_x, y0=(height / 2 - row) * pitch_y
    )
    turn = rotations_of_quaternions(values[None, 3:], scalar="last")[0]
    return FrameCamera.from_geocentric(
        interior, values[:3], _OURS_FROM_THEIRS @ turn.T, heights=heights_below(values[:3], state.heights(HEIGHTS))
    )


def frame_fields(model: FrameCamera) -> dict[str, Any]:
    """Return the state of a frame; lens distortion, refraction and map projection are not part of it."""
    from scipy.spatial.transform import Rotation

    interior = model.interior
    place, turn = _orientation(model)
    column = interior.width / 2 + interior.x0 / interior.pitch_x
    row = interior.height / 2 - interior.y0 / interior.pitch_y
    quaternion = Rotation.from_matrix((_OURS_FROM_THEIRS @ turn).T).as_quat()
    return {
        "m_nSamples": interior.width,
        "m_nLines": interior.height,
        "m_focalLength": interior.focal_length,
        "m_currentParameterValue": [*place.tolist(), *quaternion.tolist()],
        "m_currentParameterCovariance": np.zeros(49).tolist(),
        "m_noAdjustments": [0.0] * 7,
        "m_ccdCenter": [row, column],
        "m_samplePp": 0.0,
        "m_linePp": 0.0,
        "m_iTransS": [0.0, 1 / interior.pitch_x, 0.0],
        "m_iTransL": [0.0, 0.0, 1 / interior.pitch_y],
        "m_transX": [0.0, interior.pitch_x, 0.0],
        "m_transY": [0.0, 0.0, interior.pitch_y],
        "m_detectorSampleSumming": 1.0,
        "m_detectorLineSumming": 1.0,
        "m_startingDetectorSample": 0.0,
        "m_startingDetectorLine": 0.0,
        "m_distortionType": 0,
        "m_opticalDistCoeffs": [0.0, 0.0, 0.0],
        "m_majorAxis": SEMI_MAJOR,
        "m_minorAxis": SEMI_MAJOR * float(np.sqrt(1 - ECCENTRICITY_SQUARED)),
        "m_minElevation": model.heights[0],
        "m_maxElevation": model.heights[1],
        "m_referencePointXyz": geocentric(_below(model))[0].tolist(),
        "m_spacecraftVelocity": [0.0] * 3,
        "m_sunPosition": [0.0] * 3,
        "m_pixelPitch": interior.pitch_x,
        **dict.fromkeys(_IDENTIFIERS, ""),
        "m_epsilon": 1e-9,
        "m_boresight": [0.0, 0.0, 1.0],
        "m_originalHalfLines": interior.height / 2,
        "m_originalHalfSamples": interior.width / 2,
        "m_zDirection": 1.0,
        "m_ifov": interior.pitch_x / interior.focal_length,
        "m_instrumentID": "",
        "m_spacecraftName": "",
        "m_targetName": "EARTH",
        "m_lineTimes": [],
        "m_lineJitter": [],
        "m_sampleJitter": [],
    }


def _orientation(model: FrameCamera) -> tuple[Array, Array]:
    """Return the place in ECEF ``(3,)`` and the rotation ``(3, 3)`` from there to the camera."""
    if model.frame != TOPOCENTRIC:
        return geocentric_of_map(model.ground_crs, model.exterior)
    origin = np.array([model.origin])
    return geocentric(model.perspective_centre[None])[0], model.rotation @ enu_from_ecef(origin)[0]


def _below(model: FrameCamera) -> Array:
    """Return lon, lat, height ``(1, 3)`` of the ground at the middle of the frame, or below the camera."""
    middle = np.array([[model.interior.width, model.interior.height]]) / 2
    seen = model.image_to_ground(middle, model.reference_height)
    if not np.isfinite(seen).all():
        seen = model.perspective_centre[None]
    return ground_transform(model.crs, GEOGRAPHIC)(seen)
