"""Line scanners from a vendor's tables of orbit and attitude.

The input is positions and rotations with times, and a `LineCamera`. Rotations are ``(N, 3, 3)`` to ECEF;
`rotations_of_quaternions` and `rotations_of_angles` convert other conventions. Splines fit the tables. If the sigma of
a table is known, its values are also observations.
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

#: Number of neighbours for Lagrange's polynomial between positions of a table.
_NEIGHBOURS = 8
#: Time (s) over which a cubic polynomial follows an orbit to a micrometre.
_PATH_PIECE = 2.5
_CUBIC = SplineForm(3)
#: Part of an image's duration by which a table may be too short: orbits are smooth, and those of Pleiades Neo begin
#: some rows after the image.
_BEYOND = {"orbit": 0.01, "attitude": 0.001}
#: Limits of undamaged tables: distance (m) from the Earth's centre, speed (m/s, twice the escape velocity), rounding of
#: positions (m).
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
    """Make a line scanner from a vendor's orbit and attitude.

    Parameters
    ----------
    line_period, first_time : float
        Seconds per row (negative if the last row was exposed first), and the time of the upper edge of the first row,
        half a period before its centre.
    orbit : (N,), (N, 3)
        Times and positions (ECEF, m) that cover the image; N is larger than the degree of the splines.
    attitude : (N,), (N, 3, 3)
        Times and rotations from the platform to ECEF.
    mounting, lever : (3, 3), (3,)
        R_M and C_M. Without `mounting`, the rotations are those of the camera (x along increasing columns, y forward,
        z to the ground).
    splines : SplineForm
        By default the path has enough polynomials for any orbit, and the attitude passes through every row.
    position_sigma, angle_sigma : float, optional
        Sigmas (m, rad) of the random errors of the tables, whose values then are observations of the coefficients.
    free : tuple of str
        Free parameters, or groups of them; see `Pushbroom.freed`.

    Raises
    ------
    InputError
        If a table is not in order of time, too short, or does not cover the image.

    Examples
    --------
    >>> times = np.linspace(-1.0, 3.0, 17)
    >>> cos, sin, zero = np.cos(times * 1e-3), np.sin(times * 1e-3), np.zeros(17)
    >>> positions, velocities = np.stack([cos, zero, sin], axis=1) * 7e6, np.stack([-sin, zero, cos], axis=1) * 7e3
    >>> axes = [orbital_from_ecef(*pair)[[1, 0, 2]].T * (-1, 1, 1) for pair in zip(positions, velocities, strict=True)]
    >>> model = pushbroom_of_tables(
    ...     LineCamera(1000, 2000, 500.0, 0.0, 1e5),
    ...     line_period=1e-3,
    ...     first_time=0.0,
    ...     orbit=(times, positions),
    ...     attitude=(times, axes),
    ... )
    >>> model.image_to_ground([[500.0, 1000.0]], 0.0).round(3).tolist()
    [[0.0, 0.058, 0.0]]
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
    camera_axes = None if mounting is None else np.asarray(mounting, dtype=np.float64)
    if camera_axes is None:
        camera_axes = body[int(np.argmin(np.abs(turn_times - last / 2)))]
        body = body @ camera_axes.T
    angles = np.unwrap(angles_of(body), axis=0)
    turned = _attitude_spline(turn_times, angles, (low, high), splines)
    near = (turn_times >= turned.breaks[0]) & (turn_times <= turned.breaks[-1])
    observed = (lagrange(times, positions, path.sites)[0] - origin) @ orbital
    model = Pushbroom(
        camera=camera,
        line_period=line_period,
        origin=origin[0],
        orbital=orbital,
        mounting=camera_axes,
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
    """Return rotations ``(N, 3, 3)`` from quaternions ``(N, 4)``, which need not be normalised.

    Parameters
    ----------
    scalar : {'first', 'last'}
        Position of the scalar part (Pleiades: first; WorldView and QuickBird: last).

    Raises
    ------
    InputError
        If the shape is wrong, or a quaternion is zero or not finite.

    Examples
    --------
    >>> rotations_of_quaternions([[2.0, 0.0, 0.0, 0.0]])[0].tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
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
    """Return rotations ``(N, 3, 3)`` to ECEF from roll, pitch, yaw (rad) relative to the orbital axes of each time.

    Signs and sequence are those of `ortho_pipeline.models.pushbroom.scanner`. X is along the inertial velocity, Z away
    from the Earth's centre. Negate pitch and yaw of a vendor whose axes are forward, right, down.

    Parameters
    ----------
    angles : (N, 3)
    positions, velocities : (N, 3)
        In ECEF (m, m/s) at the times of the angles; velocities relative to the rotating Earth.

    Examples
    --------
    >>> rotations_of_angles([[0.0, 0.0, 0.0]], [[7e6, 0.0, 0.0]], [[0.0, 0.0, 7500.0]])[0, :, 2].round(6).tolist()
    [1.0, 0.0, 0.0]
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
    """Return checked times (after the first row) and values of a table.

    `needed` are the first time, the time of the last row after it, and the time of a row (s).
    """
    first, last, row = needed
    slack = max(row, _BEYOND[name] * abs(last))
    times, values = (np.asarray(part, dtype=np.float64) for part in table)
    if times.ndim != 1 or values.shape != (len(times), *shape) or len(times) <= degree:
        raise InputError(f"more than {degree} times with {shape} values each are needed", field=name)
    if not (np.isfinite(times).all() and np.isfinite(values).all() and (np.diff(times) > 0).all()):
        raise InputError("a table needs finite values at increasing times", field=name)
    times = times - first
    earliest, latest = sorted((0.0, last))
    # Tolerate a missing row: vendors' tables end at centres of rows.
    if times[0] > earliest + slack or times[-1] < latest - slack:
        raise InputError(
            f"this table covers {times[0]:.6g} to {times[-1]:.6g} s after the first row, but the image needs"
            f" {earliest:.6g} to {latest:.6g} s",
            field=name,
            remedy="give a table that covers the image, in the time system of first_time",
        )
    return times, values


def _followed(last: float, *tables: Array) -> tuple[float, float]:
    """Return the time range of path and attitude: half an image beyond both ends, within the tables.

    Points outside the image are allowed.
    """
    before, after = sorted((-0.5 * last, 1.5 * last))
    return max(before, *(times[0] for times in tables)), min(after, *(times[-1] for times in tables))


def lagrange(times: Array, values: Array, wanted: Array) -> tuple[Array, Array]:
    """Interpolate a table with Lagrange's polynomial through eight neighbours.

    Parameters
    ----------
    times, values : (N,), (N, 3)
    wanted : (n,)
        Times of the results.

    Returns
    -------
    (n, 3), (n, 3)
        Values and rates.

    Examples
    --------
    >>> times = np.arange(9.0)
    >>> lagrange(times, np.outer(times**2, np.ones(3)), np.array([2.5]))[0].round(6)
    array([[6.25, 6.25, 6.25]])
    """
    count = min(_NEIGHBOURS, len(times))
    interpolated, rates = np.empty((len(wanted), 3)), np.empty((len(wanted), 3))
    for k, time in enumerate(wanted):
        first = int(np.clip(np.searchsorted(times, time) - count // 2, 0, len(times) - count))
        near = times[first : first + count]
        # Scaled by their span, so that powers stay near one.
        span = near[-1] - near[0]
        nodes, middle = (near - time) / span, values[first + count // 2]
        terms = np.linalg.solve(np.vander(nodes, increasing=True), values[first : first + count] - middle)
        interpolated[k], rates[k] = middle + terms[0], terms[1] / span
    return interpolated, rates


def _attitude_spline(times: Array, angles: Array, span: tuple[float, float], form: SplineForm) -> Spline:
    """Return a spline through the rows of a table around the image, or one that fits them with fewer polynomials."""
    (low, high), degree = span, form.degree
    first = int(np.clip(np.searchsorted(times, low, side="right") - 1, 0, len(times) - degree - 1))
    last = max(int(np.searchsorted(times, high)), first + degree)
    near, values = times[first : last + 1], angles[first : last + 1]
    if form.attitude:
        return Spline.fitted(near, values, degree, np.linspace(near[0], near[-1], form.attitude + 1), 1)
    from scipy.interpolate import make_interp_spline  # takes half of the start-up time of a command

    through = make_interp_spline(near, values, degree)
    return Spline(degree, np.unique(through.t), through.c, 1)


def _observed(times: Array, values: Array, sigma: float | None) -> tuple[Observations, ...]:
    return () if sigma is None else (Observations(times, values, np.full((len(times), 3), sigma)),)
