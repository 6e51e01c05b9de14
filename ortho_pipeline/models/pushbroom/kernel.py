"""Compiled projection of ground points by a line scanner; `Pushbroom.rays` in NumPy is its tested inverse.

Path and attitude are pieces of polynomials in time, with all six components together.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ortho_pipeline.models.light.refraction import FLATTEST, SCALE_HEIGHT
from ortho_pipeline.runtime.compiled import compiled, inlined


class Trajectory(NamedTuple):
    """Path and attitude.

    Parameters
    ----------
    orbit : (3, 3)
        Columns: the orbital axes in ECEF, about `centre` ``(3,)``.
    ends, origins, pieces : (k - 1,), (k,), (k, degree + 1, 6)
        Polynomials in time after their origins; piece i holds until ``ends[i]``.
    """

    orbit: Any
    centre: Any
    ends: Any
    origins: Any
    pieces: Any


class Camera(NamedTuple):
    """The line camera on board.

    Parameters
    ----------
    mount, lever : (3, 3), (3,)
        Its axes and its position in platform axes.
    numbers : (10,)
        x0, y0, F, columns, line period, semi-major axis, squared eccentricity, largest final miss (px), and
        `LightPath.numbers`.
    dx, dy : (n,), (m,)
        Polynomials of the distortion.
    """

    mount: Any
    lever: Any
    numbers: Any
    dx: Any
    dy: Any


@inlined
def _horner(pieces, i, k, d):
    """Value and slope of component k of piece i at d after its origin."""
    value, slope = 0.0, 0.0
    for j in range(pieces.shape[1] - 1, -1, -1):
        slope = slope * d + value
        value = value * d + pieces[i, j, k]
    return value, slope


@inlined
def _in_orbit(orbit, x, y, z):
    """Turn a vector from ECEF into orbital axes."""
    return (
        orbit[0, 0] * x + orbit[1, 0] * y + orbit[2, 0] * z,
        orbit[0, 1] * x + orbit[1, 1] * y + orbit[2, 1] * z,
        orbit[0, 2] * x + orbit[1, 2] * y + orbit[2, 2] * z,
    )


@inlined
def _series(terms, xi):
    """Value and slope of a polynomial at xi."""
    value, slope = 0.0, 0.0
    for j in range(terms.shape[0] - 1, -1, -1):
        slope = slope * xi + value
        value = value * xi + terms[j]
    return value, slope


@inlined
def _in_camera(px, py, pz, t, ends, origins, pieces, mount, lever, up, bend, slowness):
    """Vector in camera axes along which a point is seen at time t, and its rate; (px, py, pz) is in orbital axes.

    The rate omits the change of the light path with time, which changes Newton's steps by a part of 1e-5.
    """
    i, above = 0, ends.shape[0]
    while i < above:
        between = (i + above) // 2
        if t >= ends[between]:
            i = between + 1
        else:
            above = between
    d = t - origins[i]
    s, s_rate = _horner(pieces, i, 0, d)
    x, dx = px - s, -s_rate
    s, s_rate = _horner(pieces, i, 1, d)
    y, dy = py - s, -s_rate
    s, s_rate = _horner(pieces, i, 2, d)
    z, dz = pz - s, -s_rate
    if bend > 0.0:
        level = x * up[0] + y * up[1] + z * up[2]
        lift = bend / max(level * level / (x * x + y * y + z * z), FLATTEST * FLATTEST)
        x, y, z = x + lift * up[0], y + lift * up[1], z + lift * up[2]
    if slowness > 0.0:
        late = slowness * math.sqrt(x * x + y * y + z * z)
        x, y, z = x - late * dx, y - late * dy, z - late * dz
    roll, roll_rate = _horner(pieces, i, 3, d)
    pitch, pitch_rate = _horner(pieces, i, 4, d)
    yaw, yaw_rate = _horner(pieces, i, 5, d)
    c, s = math.cos(yaw), math.sin(yaw)
    x, y = c * x + s * y, c * y - s * x
    dx, dy = c * dx + s * dy + yaw_rate * y, c * dy - s * dx - yaw_rate * x
    c, s = math.cos(pitch), math.sin(pitch)
    x, z = c * x - s * z, s * x + c * z
    dx, dz = c * dx - s * dz - pitch_rate * z, s * dx + c * dz + pitch_rate * x
    c, s = math.cos(roll), math.sin(roll)
    y, z = c * y + s * z, c * z - s * y
    dy, dz = c * dy + s * dz + roll_rate * z, c * dz - s * dy - roll_rate * y
    x, y, z = x - lever[0], y - lever[1], z - lever[2]
    return (
        mount[0, 0] * x + mount[1, 0] * y + mount[2, 0] * z,
        mount[0, 1] * x + mount[1, 1] * y + mount[2, 1] * z,
        mount[0, 2] * x + mount[1, 2] * y + mount[2, 2] * z,
        mount[0, 0] * dx + mount[1, 0] * dy + mount[2, 0] * dz,
        mount[0, 1] * dx + mount[1, 1] * dy + mount[2, 1] * dz,
        mount[0, 2] * dx + mount[1, 2] * dy + mount[2, 2] * dz,
    )


@compiled
def project(ground: Any, trajectory: Trajectory, camera: Camera, limits: Any, image: Any) -> None:
    """Fill `image` ``(N, 2)`` with the projections of `ground` ``(N, 3)`` (lon, lat in degrees, ellipsoidal height).

    Parameters
    ----------
    limits : (2, 2)
        Lowest and highest column and time; NaN beyond.
    """
    orbit, centre, ends, origins, pieces = trajectory
    mount, lever, numbers, dx, dy = camera
    x0, y0, focal, columns, period, major, e2, verified, bend, slowness = numbers
    half = columns / 2.0
    for k in range(ground.shape[0]):
        image[k, 0], image[k, 1] = np.nan, np.nan
        lon, lat = math.radians(ground[k, 0]), math.radians(ground[k, 1])
        sin_lat, cos_lat = math.sin(lat), math.cos(lat)
        normal = major / math.sqrt(1.0 - e2 * sin_lat * sin_lat)
        level = (normal + ground[k, 2]) * cos_lat
        gx, gy = level * math.cos(lon), level * math.sin(lon)
        gz = (normal * (1.0 - e2) + ground[k, 2]) * sin_lat
        x, y, z = gx - centre[0], gy - centre[1], gz - centre[2]
        # Below the horizon, the Earth hides the point.
        if not gx * x + gy * y + gz * z < 0.0:
            continue
        px, py, pz = _in_orbit(orbit, x, y, z)
        up = _in_orbit(orbit, cos_lat * math.cos(lon), cos_lat * math.sin(lon), sin_lat)
        lifting = bend * math.exp(-ground[k, 2] / SCALE_HEIGHT)
        # The scan is nearly linear in time: from the middle, Newton's method needs four steps.
        t = 0.5 * (limits[1, 0] + limits[1, 1])
        col, miss, w = half, np.inf, 0.0
        for _ in range(20):
            a, b, w, a_rate, b_rate, w_rate = _in_camera(
                px, py, pz, t, ends, origins, pieces, mount, lever, up, lifting, slowness
            )
            a, b = a / w, b / w
            a_rate, b_rate = (a_rate - a * w_rate) / w, (b_rate - b * w_rate) / w
            if miss == np.inf:
                col = x0 + focal * a
            xi = col / half - 1.0
            by_x, x_slope = _series(dx, xi)
            by_y, y_slope = _series(dy, xi)
            u_slope, v_slope = (1.0 + x_slope / half) / focal, y_slope / half / focal
            e_u = a - (col + by_x - x0) / focal
            e_v = b - (by_y - y0) / focal
            step = (e_u * v_slope - e_v * u_slope) / (b_rate * u_slope - a_rate * v_slope)
            shift = (e_u + a_rate * step) / u_slope
            t += step
            col += shift
            miss = max(abs(step / period), abs(shift))
            if not miss > verified:
                break
        # The last correction was `miss`, so the remaining error is its square.
        good = miss <= verified and w > 0.0
        if good and limits[0, 0] <= col <= limits[0, 1] and limits[1, 0] <= t <= limits[1, 1]:
            image[k, 0] = col
            image[k, 1] = t / period
