r"""The CSM state of a line scanner.

Line l (0.5 at the first centre) is exposed at start + period (l - line + 0.5) of the last entry of ``m_intTimeLines``
that is not after it; the period is negative where the last line was exposed first. Positions and quaternions are at t0
+ k dt, between them Lagrange's polynomial of order 8. Sample s has :math:`t_2 = s \cdot sum_s + s_0 - o_s - S_0`,
:math:`t_1 = l_0 - o_l - L_0`, and the place (x, y) in the focal plane that
:math:`\binom{L_1\ L_2}{S_1\ S_2} (x, y)^T = (t_1, t_2)^T`, with L and S of ``m_iTransL``, ``m_iTransS``.
A radial distortion (type 0) takes the part :math:`k_0 + k_1 r^2 + k_2 r^4` of x and y away, of the distorted place.
The ray lies on the line through the camera along :math:`R(q)\,(x z, y z, f)`, z being ``m_zDirection``: of both
directions the library takes the one that meets the ground.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from ortho_csm.state import StateFields
from ortho_pipeline.plugin import (
    ECCENTRICITY_SQUARED,
    SEMI_MAJOR,
    Array,
    LineCamera,
    Pushbroom,
    geocentric,
    pushbroom_of_tables,
    require_view,
    rotations,
    rotations_of_quaternions,
)

#: Heights (m) of the ground where the state's are beyond all mountains.
HEIGHTS = (-500.0, 9000.0)
#: Lines whose times are further (lines) from one rate have no constant period.
_EVEN = 0.01
#: Time step (s) of written positions, and number of written angles per knot of their spline.
_EVERY, _OFTEN, _FEWEST = 0.25, 2, 16
#: Columns at which a line of detectors is sampled to make its pixels equal, and tolerance (px) for exactness.
_COLUMNS, _EXACT = 33, 1e-7
_QUATERNIONS, _POSITIONS = "m_quaternions", "m_positions"


def read_line_scanner(state: StateFields) -> Pushbroom:
    """Make a line scanner of a state. Its parameters are offsets and drifts of the attitude."""
    columns, rows = state.size()
    if state.numbers("m_currentParameterValue").any():
        raise state.error("corrections of the tables are not supported", "m_currentParameterValue")
    start, period = _times(state)
    turn, camera = _camera(state, columns, rows)
    orbit = _table(state, _POSITIONS, 3, "Ephem")
    times, quaternions = _table(state, _QUATERNIONS, 4, "Quat")
    if not (np.abs(np.linalg.norm(quaternions, axis=1) - 1) <= 0.01).all():
        raise state.error("the quaternions do not have length one", _QUATERNIONS)
    model = pushbroom_of_tables(
        camera,
        line_period=period,
        first_time=0.0,
        orbit=(orbit[0] - start, orbit[1]),
        attitude=(times - start, rotations_of_quaternions(quaternions, scalar="last") @ turn),
        heights=state.heights(HEIGHTS),
    )
    require_view(model)
    return model


def _times(state: StateFields) -> tuple[float, float]:
    """Return the time of the upper edge of the first row and seconds per row."""
    lines, starts, periods = (state.numbers(name) for name in ("m_intTimeLines", "m_intTimeStartTimes", "m_intTimes"))
    if not 1 <= len(lines) == len(starts) == len(periods) <= 100_000 or not (np.diff(lines) > 0).all():
        raise state.error(
            "lines, times and periods must have the same length, and lines must increase", "m_intTimeLines"
        )
    period = float(periods[0])
    if not 0 < abs(period) < 10:
        raise state.error(f"{period} s is not a possible line period", "m_intTimes")
    steady = starts[0] + (lines - lines[0]) * period
    # The period behind the last entry holds for the rest of the image only.
    if np.abs(periods / period - 1).max() * state.size()[1] > 1 or np.abs(starts - steady).max() > _EVEN * abs(period):
        raise state.error("the line period is not constant", "m_intTimes")
    return float(starts[0] + period * (0.5 - lines[0])), period


def _camera(state: StateFields, columns: int, rows: int) -> tuple[Array, LineCamera]:
    """Return the rotation from our axes (x along growing columns) to the camera of the state, and the line camera."""
    sample, line = state.numbers("m_iTransS", 3), state.numbers("m_iTransL", 3)
    plane = np.array([line[1:], sample[1:]])
    focal, sign = state.number("m_focalLength"), state.number("m_zDirection", 1.0)
    if abs(np.linalg.det(plane)) < 1e-12 or not focal > 0 or sign not in (1.0, -1.0):
        raise state.error("these values do not map pixels to the focal plane", "m_iTransS, m_iTransL, m_focalLength")
    back = np.linalg.inv(plane) * sign / focal
    step, first = state.number("m_detectorSampleSumming", 1.0), state.number("m_startingDetectorSample", 0.0)
    origin = first - state.number("m_detectorSampleOrigin") - sample[0]
    t1 = state.number("m_startingDetectorLine", 0.0) - state.number("m_detectorLineOrigin") - line[0]
    slope, start = back[:, 1] * step, back @ np.array([t1, origin])
    length = float(np.linalg.norm(slope))
    if not (np.isfinite([*slope, *start]).all() and 1e-10 < length < 0.1):
        raise state.error("all columns look in the same direction", "m_detectorSampleSumming")
    across = slope / length
    turn = np.array([[across[0], -across[1], 0.0], [across[1], across[0], 0.0], [0.0, 0.0, 1.0]])
    radial = state.radial()
    if not any(radial):
        u, v = [start @ turn[:2, 0], length], [start @ turn[:2, 1]]
        return turn, LineCamera.of_polynomials(columns, rows, u, v)
    at = np.linspace(0.0, columns, _COLUMNS)
    plane = (start + at[:, None] * slope) * sign * focal
    look = undistorted(plane, radial) @ turn[:2, :2] * sign / focal
    if not (np.isfinite(look).all() and np.abs(look).max() < 10):
        raise state.error("this is not a possible lens distortion", "m_opticalDistCoeffs")
    return turn, LineCamera.of_table(columns, rows, at, look[:, 0], look[:, 1])


def _table(state: StateFields, field: str, width: int, what: str) -> tuple[Array, Array]:
    values = state.numbers(field)
    step = state.number(f"m_dt{what}")
    if len(values) % width or len(values) < 4 * width or not 0 < step < 1e4:
        raise state.error(f"this must be a list of at least 4 x {width} numbers, at equal time steps", field)
    values = values.reshape(-1, width)
    return np.asarray(state.number(f"m_t0{what}") + step * np.arange(len(values), dtype=np.float64)), values


# -- writing ---------------------------------------------------------------------------------------------------------


def line_scanner_fields(model: Pushbroom) -> dict[str, Any]:
    """Return the state of a line scanner, with aberration and refraction folded into its angles."""
    flight, camera = model.flight, model.camera
    low, high = (float(edge) for edge in model.path.breaks[[0, -1]])
    places_at = _around(model, low, high, max(_FEWEST, math.ceil((high - low) / _EVERY)))
    turned_at = _sites(model)
    line = _line(model)
    turns = _turns(model, turned_at, line)
    centre = model.image_to_ground(np.array([camera.size]) / 2, float(np.clip(0.0, *model.heights)))
    duration = camera.height * model.line_period
    minor = SEMI_MAJOR * math.sqrt(1 - ECCENTRICITY_SQUARED)
    place = geocentric(centre)[0]
    distance = float(np.linalg.norm(flight.positions(np.array([duration / 2]), 0)[0] - place))
    gsd = distance / line.focal
    return {
        **_FIXED,
        "m_nLines": camera.height,
        "m_nSamples": camera.width,
        "m_intTimeLines": [1.0],
        "m_intTimeStartTimes": [0.5 * model.line_period],
        "m_intTimes": [model.line_period],
        "m_t0Ephem": float(places_at[0]),
        "m_dtEphem": float(places_at[1] - places_at[0]),
        "m_numPositions": 3 * len(places_at),
        "m_positions": flight.positions(places_at, 0).ravel().tolist(),
        "m_velocities": flight.positions(places_at, 1).ravel().tolist(),
        "m_t0Quat": float(turned_at[0]),
        "m_dtQuat": float(turned_at[1] - turned_at[0]),
        "m_numQuaternions": 4 * len(turned_at),
        "m_quaternions": _quaternions(turns).ravel().tolist(),
        "m_focalLength": line.focal,
        "m_detectorSampleOrigin": line.middle,
        "m_detectorLineOrigin": -line.along,
        "m_opticalDistCoeffs": list(line.radial),
        "m_minElevation": model.heights[0],
        "m_maxElevation": model.heights[1],
        "m_majorAxis": SEMI_MAJOR,
        "m_minorAxis": minor,
        "m_referencePointXyz": place.tolist(),
        "m_gsd": gsd,
        "m_halfSwath": gsd * camera.width / 2,
        "m_halfTime": abs(duration) / 2,
        "m_flyingHeight": distance,
    }


#: Fields that have the same value in each state that is written.
_FIXED: dict[str, Any] = {
    "m_imageIdentifier": "",
    "m_sensorName": "ortho-pipeline",
    "m_sensorIdentifier": "",
    "m_platformIdentifier": "",
    "m_focalLengthEpsilon": 0.0,
    "m_zDirection": 1.0,
    "m_platformFlag": 1,
    "m_ikCode": 0,
    "m_detectorSampleSumming": 1.0,
    "m_detectorLineSumming": 1.0,
    "m_startingDetectorSample": 0.0,
    "m_startingDetectorLine": 0.0,
    "m_iTransS": [0.0, 1.0, 0.0],
    "m_iTransL": [0.0, 0.0, 1.0],
    "m_distortionType": 0,
    "m_startingEphemerisTime": 0.0,
    "m_centerEphemerisTime": 0.0,
    "m_currentParameterValue": [0.0] * 16,
    "m_parameterType": [2] * 16,
    "m_covariance": np.eye(16).ravel().tolist(),
    "m_sunPosition": [0.0] * 3,
    "m_sunVelocity": [0.0] * 3,
}


def _sites(model: Pushbroom) -> Array:
    """Return evenly spaced times that hold every knot of the attitude, so that reading finds the same spline."""
    breaks = model.attitude.breaks
    step = float(np.diff(breaks).min()) / _OFTEN
    step = min(step, float(breaks[-1] - breaks[0]) / _FEWEST)
    low, high = (float(edge) for edge in breaks[[0, -1]])
    return _around(model, low, high, max(1, round((high - low) / step)))


def _around(model: Pushbroom, low: float, high: float, count: int) -> Array:
    """Return times in `count` equal steps from `low` to `high`, and beyond for the library's polynomials.

    They want four rows beyond the image, and are straight lines in the first and last step.
    """
    step = (high - low) / count
    earliest, latest = sorted((0.0, model.camera.height * model.line_period))
    before = max(0, math.ceil((low + 4 * step - earliest) / step))
    after = max(0, math.ceil((latest + 4 * step - high) / step))
    return np.asarray(low + step * np.arange(-before, count + after + 1))


def _seen(model: Pushbroom, times: Array) -> Array:
    """Return where columns look at times, in the axes of the camera at that moment ``(times, columns, 3)``, z = 1."""
    columns = np.linspace(0.0, model.camera.width, _COLUMNS)
    image = np.stack(np.meshgrid(columns, times / model.line_period), axis=-1).reshape(-1, 2)
    if not (model.light.aberration or model.light.refraction):
        look = np.column_stack([model.camera.directions(columns), np.ones(_COLUMNS)])
        return np.broadcast_to(look, (len(times), _COLUMNS, 3))
    ground = geocentric(model.image_to_ground(image, model.reference_height))
    line = ground.reshape(len(times), _COLUMNS, 3) - model.flight.positions(times, 0)[:, None, :]
    look = np.einsum("tji,tcj->tci", _camera_axes(model, times), line)
    return np.asarray(look / look[:, :, 2:])


def _camera_axes(model: Pushbroom, times: Array) -> Array:
    """Return the rotations from the camera to ECEF ``(N, 3, 3)``."""
    return np.asarray(model.orbital @ rotations(model.flight.attitude(times)) @ model.mounting)


class _Line(NamedTuple):
    """A line of equal pixels, with a radial distortion, that looks where the columns of a model do.

    `axes` (3, 3) are those of the state in those of the camera; `focal`, `middle` (column), `along` (line) and `radial`
    are in pixels.
    """

    axes: Array
    focal: float
    middle: float
    along: float
    radial: tuple[float, float, float]

    def looks(self, columns: Array) -> Array:
        """Return where columns ``(N,)`` look, in the state's axes ``(N, 3)``."""
        plane = np.column_stack([columns - self.middle, np.full(len(columns), self.along)])
        return np.column_stack([undistorted(plane, self.radial), np.full(len(columns), self.focal)])


def undistorted(plane: Array, radial: Sequence[float]) -> Array:
    """Return places ``(N, 2)`` of the focal plane without the radial distortion ``k0 + k1 r^2 + k2 r^4``."""
    square = (plane**2).sum(axis=1)
    part = radial[0] + square * (radial[1] + square * radial[2])
    return np.asarray(plane * (1.0 - part)[:, None])


def _line(model: Pushbroom) -> _Line:
    """Return the line of a state that is nearest to the camera: in its own axes, or about the look of its middle."""
    duration, width = model.camera.height * model.line_period, model.camera.width
    look, columns = _seen(model, np.linspace(0.0, duration, 9)).mean(axis=0), np.linspace(0.0, width, _COLUMNS)
    own = np.diag([-1.0, -1.0, 1.0]) if model.camera.focal_length < 0 else np.eye(3)
    u, v = (look @ own)[:, :2].T
    start, slope = np.polynomial.polynomial.polyfit(columns, u, 1)
    if np.abs(start + slope * columns - u).max() < _EXACT * slope and np.ptp(v) < _EXACT * slope:
        return _Line(own, 1 / float(slope), -float(start / slope), float(v.mean() / slope), (0.0, 0.0, 0.0))
    z = look[_COLUMNS // 2] / np.linalg.norm(look[_COLUMNS // 2])
    x = look[-1] - look[0]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    axes, tilt = np.column_stack([x, np.cross(z, x), z]), 0.0
    off = (columns - width / 2) / width
    for _ in range(3):
        c, s = math.cos(tilt), math.sin(tilt)
        tilted = axes @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
        centred = look @ tilted
        centred /= centred[:, 2:]
        first, third, fifth = np.linalg.lstsq(off[:, None] ** (1, 3, 5), centred[:, 0], rcond=None)[0]
        # A bent line is represented by distortion: offset from the axis by the size of the bend.
        bent = float(np.polynomial.polynomial.polyfit(off, centred[:, 1], 2)[2])
        wanted = float(bent * first / third) if abs(third) > 1e-9 * abs(first) else 0.0
        tilt += float(np.clip(centred[:, 1].mean() - wanted, -0.1, 0.1))
    first, third, fifth = (part / width for part in (first, third, fifth))
    radial = (0.0, -float(third / first) / width**2, -float(fifth / first) / width**4)
    return _Line(tilted, 1 / float(first), width / 2, float(centred[:, 1].mean() / first), radial)


def _turns(model: Pushbroom, times: Array, line: _Line) -> Array:
    """Return the rotations to ECEF of the line of a state that looks best where the model does."""
    columns = np.linspace(0.0, model.camera.width, _COLUMNS)
    looks = _seen(model, times) @ line.axes, line.looks(columns)
    wanted, have = (part / np.linalg.norm(part, axis=-1, keepdims=True) for part in looks)
    # The small rotation that brings one bundle of rays onto the other: a linear problem, twice for large ones.
    small = np.broadcast_to(np.eye(3), (len(times), 3, 3))
    for _ in range(2):
        turned = np.einsum("tij,cj->tci", small, have)
        normal = np.eye(3) * _COLUMNS - np.einsum("tci,tcj->tij", turned, turned)
        angle = np.linalg.solve(normal, np.cross(turned, wanted).sum(axis=1)[:, :, None])[:, :, 0]
        from scipy.spatial.transform import Rotation

        kept = np.where(np.linalg.norm(angle, axis=1, keepdims=True) > 1e-13, angle, 0.0)
        small = Rotation.from_rotvec(kept).as_matrix() @ small
    return np.asarray(_camera_axes(model, times) @ line.axes @ small)


def _quaternions(turns: Array) -> Array:
    """Return quaternions ``(N, 4)``, scalar last, each on the side of the one before."""
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(turns).as_quat()
    flips = np.cumprod(np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0))
    return np.asarray(np.vstack([quaternions[:1], quaternions[1:] * flips[:, None]]))
