"""Line scanners from a vendor's tables of orbit and attitude.

Positions and rotations with times, in any convention that a `(N, 3, 3)` array of rotations to ECEF can express
(`rotations_of_quaternions`, `rotations_of_angles`), and a `LineCamera`. The splines fit the tables, which are also kept
as observations if their sigma is known.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import orbital_from_ecef
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.pushbroom.constraints import Observations, OrbitShape
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.rotations import angles_of, are_rotations, orbital_axes, rotations
from ortho_pipeline.models.pushbroom.scanner import Pushbroom
from ortho_pipeline.models.pushbroom.splines import Spline, SplineForm

#: Positions between those of a table: Lagrange's polynomial through so many neighbours.
_NEIGHBOURS = 8
#: A cubic polynomial follows an orbit for so long (seconds) to a micrometre.
_PATH_PIECE = 2.5
_CUBIC = SplineForm(3)
#: By which part of an image's duration tables may be too short: orbits are smooth, and Pleiades Neo's begin some rows
#: after the image.
_BEYOND = {"orbit": 0.01, "attitude": 0.001}
#: Positions (m) beyond this are damaged, and those between which nothing in an orbit gets so fast (m/s: twice what
#: escapes from the Earth; metres by which tables are rounded).
_FARTHEST, _FASTEST, _ROUNDED = 1e9, 22e3, 10.0


def pushbroom_of_tables(
    camera: LineCamera,
    *,
    line_period: float,
    first_time: float,
    orbit: tuple[ArrayLike, ArrayLike],
    attitude: tuple[ArrayLike, ArrayLike],
    heights: tuple[float, float] = (0.0, 1000.0),
    mounting: ArrayLike | None = None,
    lever: ArrayLike = (0.0, 0.0, 0.0),
    splines: SplineForm = _CUBIC,
    position_sigma: float | None = None,
    angle_sigma: float | None = None,
    free: tuple[str, ...] = ("attitude_offset", "attitude_drift"),
) -> Pushbroom:
    """Make a line scanner of a vendor's orbit and attitude.

    Parameters
    ----------
    line_period, first_time : float
        Seconds per row (negative where the last row was exposed first), and the time of the upper edge of the first
        row, half a period before its centre.
    orbit : (N,), (N, 3)
        Times and positions (ECEF, m); at least one row more than the degree of the splines, around the image.
    attitude : (N,), (N, 3, 3)
        Times and rotations from the platform to ECEF, as dense as the attitude changes.
    mounting, lever : (3, 3), (3,)
        R_M and C_M. Without `mounting` the rotations are of the camera itself (x along growing columns, y forward,
        z to the ground) and R_M is its attitude in the middle of the image.
    splines : SplineForm
        If it does not say how many polynomials, path has enough for any orbit, and attitude goes through every row of
        its table.
    position_sigma, angle_sigma : float, optional
        Sigmas (m, rad) of the tables' random errors: their values then are observations, which hold the coefficients
        when those are freed. Systematic errors are the offsets and drifts.
    free : tuple of str
        Free parameters or groups of them, see `Pushbroom.freed`.

    Raises
    ------
    InputError
        If a table is not ordered in time, too short, or does not cover the image.
    """
    degree, last = splines.degree, camera.height * line_period
    needed = (first_time, last, abs(line_period))
    times, positions = _table(orbit, (3,), needed, degree, "orbit")
    if not (np.abs(positions) < _FARTHEST).all():
        raise InputError("this table has a position where no satellite can be (ECEF metres)", field="orbit")
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    if not (steps <= _FASTEST * np.diff(times) + _ROUNDED).all():
        raise InputError(
            f"two successive positions are {steps.max():.4g} m apart: no satellite is that fast",
            field="orbit",
            remedy="give ECEF metres and seconds; if they are, the file is damaged: copy it again",
        )
    turn_times, turns = _table(attitude, (3, 3), needed, degree, "attitude")
    if not are_rotations(turns):
        raise InputError("a matrix of this table is not a rotation", field="attitude")
    low, high = _followed(last, times, turn_times)
    origin, velocity = lagrange(times, positions, np.array([last / 2]))
    orbital = orbital_axes(origin[0], velocity[0])
    path_breaks = np.linspace(low, high, 1 + (splines.path or max(2, math.ceil((high - low) / _PATH_PIECE))))
    sites = np.linspace(low, high, 4 * (len(path_breaks) + degree))
    path = Spline.fitted(
        sites, (lagrange(times, positions, sites)[0] - origin) @ orbital, degree, path_breaks, min(degree, 2)
    )
    body = orbital.T @ turns
    mounted = None if mounting is None else np.asarray(mounting, dtype=np.float64)
    if mounted is None:
        mounted = body[int(np.argmin(np.abs(turn_times - last / 2)))]
        body = body @ mounted.T
    angles = np.unwrap(angles_of(body), axis=0)
    turned = _attitude_spline(turn_times, angles, (low, high), splines)
    near = (turn_times >= turned.breaks[0]) & (turn_times <= turned.breaks[-1])
    observed = (lagrange(times, positions, path.sites)[0] - origin) @ orbital
    model = Pushbroom(
        camera=camera,
        line_period=line_period,
        origin=origin[0],
        orbital=orbital,
        mounting=mounted,
        path=path,
        attitude=turned,
        lever=np.asarray(lever, dtype=np.float64),
        path_line=np.zeros((2, 3)),
        attitude_line=np.zeros((2, 3)),
        heights=heights,
        free=(),
        shape=OrbitShape(),
        path_observations=_observed(path.sites, observed, position_sigma),
        attitude_observations=_observed(turn_times[near], angles[near], angle_sigma),
    )
    return model.freed(*free)


def rotations_of_quaternions(quaternions: ArrayLike, *, scalar: str = "first") -> Array:
    """Return rotations ``(N, 3, 3)`` of quaternions ``(N, 4)``, which need not be normalised.

    Parameters
    ----------
    scalar : {'first', 'last'}
        Where the scalar part stands (Pleiades: first; WorldView and QuickBird: last).
    """
    q = np.asarray(quaternions, dtype=np.float64)
    if q.ndim != 2 or q.shape[1] != 4 or scalar not in ("first", "last"):
        raise InputError("quaternions must be N x 4 numbers, with the scalar first or last", field="quaternions")
    if not (np.linalg.norm(q, axis=1) > 0).all():
        raise InputError("a quaternion is zero or not finite", field="quaternions")
    from scipy.spatial.transform import Rotation

    last = np.roll(q, -1, axis=1) if scalar == "first" else q
    return np.asarray(Rotation.from_quat(last).as_matrix(), dtype=np.float64)


def rotations_of_angles(angles: ArrayLike, positions: ArrayLike, velocities: ArrayLike) -> Array:
    """Return rotations ``(N, 3, 3)`` to ECEF of roll, pitch, yaw (rad) against the orbital axes of every moment.

    Signs and sequence are those of `ortho_pipeline.models.pushbroom.scanner`; X is along the inertial velocity, Z away
    from the Earth's centre. A vendor who counts from forward, right, down has pitch and yaw of the other sign.

    Parameters
    ----------
    positions, velocities : (N, 3)
        In ECEF (m, m/s), at the times of the angles; velocities relative to the turning Earth.
    """
    pairs = zip(np.asarray(positions, dtype=float), np.asarray(velocities, dtype=float), strict=True)
    down = np.array([orbital_from_ecef(position, velocity) for position, velocity in pairs])
    level = np.swapaxes(down, 1, 2) * (1.0, -1.0, -1.0)
    return level @ rotations(np.asarray(angles, dtype=float))


def _table(
    table: tuple[ArrayLike, ArrayLike],
    shape: tuple[int, ...],
    needed: tuple[float, float, float],
    degree: int,
    name: str,
) -> tuple[Array, Array]:
    """Return times after the first row and values of a table, checked; `needed`: first time, last after it, row (s)."""
    first, last, row = needed
    slack = max(row, _BEYOND[name] * abs(last))
    times, values = (np.asarray(part, dtype=np.float64) for part in table)
    if times.ndim != 1 or values.shape != (len(times), *shape) or len(times) <= degree:
        raise InputError(f"more than {degree} times with {shape} values each are needed", field=name)
    if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
        raise InputError("a table needs finite values at increasing times", field=name)
    times = times - first
    earliest, latest = sorted((0.0, last))
    # The rim of a row more or less is not a reason to refuse a table: vendors' tables end at centres of rows.
    if times[0] > earliest + slack or times[-1] < latest - slack:
        raise InputError(
            f"this table covers {times[0]:.6g} to {times[-1]:.6g} s after the first row, but the image needs"
            f" {earliest:.6g} to {latest:.6g} s",
            field=name,
            remedy="give a table that covers the image, in the time system of first_time",
        )
    return times, values


def _followed(last: float, *tables: Array) -> tuple[float, float]:
    """Return the times for which path and attitude are made: half an image beyond both ends, as far as the tables go.

    Points outside of the image are legal.
    """
    before, after = sorted((-0.5 * last, 1.5 * last))
    return max(before, *(times[0] for times in tables)), min(after, *(times[-1] for times in tables))


def lagrange(times: Array, values: Array, wanted: Array) -> tuple[Array, Array]:
    """Return values and rates ``(n, 3)`` at `wanted` ``(n,)`` by Lagrange's polynomial through eight neighbours."""
    count = min(_NEIGHBOURS, len(times))
    found, rates = np.empty((len(wanted), 3)), np.empty((len(wanted), 3))
    for k, time in enumerate(wanted):
        first = int(np.clip(np.searchsorted(times, time) - count // 2, 0, len(times) - count))
        near = times[first : first + count]
        # Divided by their span, so that the powers stay near one.
        span = near[-1] - near[0]
        nodes, middle = (near - time) / span, values[first + count // 2]
        terms = np.linalg.solve(np.vander(nodes, increasing=True), values[first : first + count] - middle)
        found[k], rates[k] = middle + terms[0], terms[1] / span
    return found, rates


def _attitude_spline(times: Array, angles: Array, span: tuple[float, float], form: SplineForm) -> Spline:
    """Return a spline through the rows of a table around the image, or that fits them with fewer polynomials."""
    (low, high), degree = span, form.degree
    first = int(np.clip(np.searchsorted(times, low, side="right") - 1, 0, len(times) - degree - 1))
    last = max(int(np.searchsorted(times, high)), first + degree)
    near, values = times[first : last + 1], angles[first : last + 1]
    if form.attitude:
        return Spline.fitted(near, values, degree, np.linspace(near[0], near[-1], form.attitude + 1), 1)
    from scipy.interpolate import make_interp_spline  # takes half of the start-up of a command

    through = make_interp_spline(near, values, degree)
    return Spline(degree, np.unique(through.t), through.c, 1)


def _observed(times: Array, values: Array, sigma: float | None) -> tuple[Observations, ...]:
    return () if sigma is None else (Observations(times, values, np.full((len(times), 3), sigma)),)
