r"""Line scanners from a few lines of metadata, with soft constraints.

The input is corners, flying height H, and look angles :math:`\alpha` (along) and :math:`\beta` (across). The camera
looks along :math:`Z_M` in the platform,

.. math::

    Z_M = Z_0 / |Z_0|, \quad Z_0 = (\tan\alpha, -\tan\beta, -1)^T, \quad X_M = (0, \cos\beta, -\sin\beta)^T, \quad
    Y_M = Z_M \times X_M ,

The paper prints :math:`\cos\alpha` in X_M, which then has neither length one nor a right angle to Z_M. From the middles
:math:`M_F, M_L` of first and last row, the positions :math:`S_j = M_j + \lambda_j g_j` on the sphere of the orbit and
R_O are iterated. Two things go beyond the paper. The platform follows the Earth, so g turns with the angle travelled
and pitch starts as a straight line; the paper has zeros, and a path that is ten percent short. The four corners show
the skew of the rows (the Earth rotates below: four degrees at the equator, or 400 pixels): yaw is iterated to meet it,
:math:`g_j = R_O R_Z(yaw) R_Y(\theta_j) Z_M`. Roll and pitch absorb the rest.

Source: Willneff et al., equation 4 and section 3.3.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import geocentric
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.pushbroom.constraints import Observations, OrbitShape
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.rotations import orbital_axes, rotations
from ortho_pipeline.models.pushbroom.scanner import Pushbroom
from ortho_pipeline.models.pushbroom.splines import Spline, SplineForm

#: Gravity of the Earth, m^3 / s^2.
EARTH_GM = 3.986004418e14
_ITERATIONS, _SETTLED = 100, 1e-4
_TURNS = 10
_PARABOLAS = SplineForm(2)


@dataclass(frozen=True)
class SoftSigmas:
    """Sigmas of the pseudo-observations of a start from metadata; None skips one.

    Willneff et al. have the first two. The others are ours: without them nine control points do not determine the
    eighteen coefficients of a scene (docs/engineering/accuracy.md).

    Parameters
    ----------
    plane, circular : float, optional
        Shape of the orbit (m, rad); see `OrbitShape`.
    radius : float, optional
        Distance from the Earth's centre (m).
    attitude : float, optional
        Roll, pitch and yaw in the middle of the scene (rad).
    rate : float, optional
        Their rates at first and last row (rad/s).

    Raises
    ------
    InputError
        If one is not positive and finite.

    Examples
    --------
    >>> SoftSigmas(attitude=1e-3).attitude
    0.001
    """

    plane: float | None = 10.0
    circular: float | None = 1e-3
    radius: float | None = 10_000.0
    attitude: float | None = math.radians(0.5)
    rate: float | None = 1e-4

    def __post_init__(self) -> None:
        for name, sigma in vars(self).items():
            if sigma is not None and not (math.isfinite(sigma) and sigma > 0):
                raise InputError(
                    f"{sigma} is not a sigma", field=name, remedy="give a positive number, or None for no constraint"
                )


def pushbroom_of_metadata(
    corners: ArrayLike,
    width: int,
    height: int,
    *,
    altitude: float,
    along_deg: float,
    across_deg: float = 0.0,
    focal_length: float | None = None,
    pixel_size: float | None = None,
    heights: tuple[float, float] = (0.0, 1000.0),
    splines: SplineForm = _PARABOLAS,
    corrections: tuple[int, int] = (0, 0),
    sigmas: SoftSigmas | None = None,
) -> Pushbroom:
    """Make the start model of a line scanner, with soft constraints, from metadata alone.

    Parameters
    ----------
    corners : (4, 2) or (4, 3)
        Lon, lat (degrees) and optional height (m) of: first row left, right; last row right, left. Default height: the
        middle of `heights`.
    altitude : float
        Height of the satellite above the ellipsoid (m).
    along_deg, across_deg : float
        Look angles: positive is forward (increasing rows), and right.
    focal_length, pixel_size : float, optional
        In the same unit. Default: the focal length follows from the length of the rows.
    splines : SplineForm
        Default: one polynomial each. All coefficients are free.
    corrections : (int, int)
        Numbers of coefficients of the camera's corrections along x and y; they are zero and not free.

    Raises
    ------
    InputError
        If the metadata contradict each other.

    Examples
    --------
    >>> corners = [[12.0, 42.0], [12.3, 42.0], [12.3, 41.8], [12.0, 41.8]]
    >>> model = pushbroom_of_metadata(corners, 10_000, 9_000, altitude=618e3, along_deg=26.0)
    >>> model.ground_to_image([[12.15, 41.9, 500.0]]).round(-2).tolist()
    [[5000.0, 4500.0]]
    """
    sigmas = sigmas or SoftSigmas()
    points = _corner_points(corners, heights)
    mounting = mounting_of_angles(math.radians(along_deg), math.radians(across_deg))
    radius = float(np.linalg.norm(geocentric(points.mean(axis=0)[None] * (1.0, 1.0, 0.0)))) + altitude
    yaw = 0.0
    for _ in range(_TURNS):
        ends, orbital, travelled = _orbit_over(geocentric(points), radius, mounting[:, 2], yaw)
        focal = _focal_length(points, ends, orbital, width, focal_length, pixel_size)
        camera = LineCamera(width, height, width / 2, 0.0, focal, *map(np.zeros, corrections))
        level = _level_flight(camera, radius, orbital, mounting, travelled, yaw, heights, splines)
        start = _met(level, points)
        turn = float(start.attitude.coefficients[0, 2]) - yaw
        yaw += turn
        if abs(turn) < 1e-5:
            break
    shape = OrbitShape(sigmas.plane, sigmas.circular, None if sigmas.radius is None else radius, sigmas.radius)
    return _softened(start._replace(shape=shape), sigmas)


def mounting_of_angles(along: float, across: float) -> Array:
    """Return R_M ``(3, 3)`` from look angles (rad) along and across the track.

    Source: Willneff et al., equation 4, with the cosine of beta in X_M.
    """
    z = np.array([math.tan(along), -math.tan(across), -1.0])
    z /= np.linalg.norm(z)
    x = np.array([0.0, math.cos(across), -math.sin(across)])
    return np.column_stack([x, np.cross(z, x), z])


def _corner_points(corners: ArrayLike, heights: tuple[float, float]) -> Array:
    points = np.asarray(corners, dtype=np.float64)
    if points.shape == (4, 2):
        points = np.column_stack([points, np.full(4, sum(heights) / 2)])
    if points.shape != (4, 3) or not np.isfinite(points).all():
        raise InputError(f"the corners must be four of lon, lat (and height), not {points.shape}", field="corners")
    if (np.abs(points[:, 1]) > 90).any():
        raise InputError("a latitude is larger than 90 degrees", field="corners", remedy="give lon, lat")
    return points


def _orbit_over(ground: Array, radius: float, view: Array, yaw: float) -> tuple[Array, Array, float]:
    """Return where first and last row of an image with these corners are seen from along `view` in a yawed platform.

    Returns
    -------
    (2, 3), (3, 3), float
        Positions on the sphere of the orbit, R_O, and the angle travelled between them.
    """
    middles = np.stack([ground[:2].mean(axis=0), ground[2:].mean(axis=0)])
    ends = middles * (radius / np.linalg.norm(middles, axis=1))[:, None]
    for _ in range(_ITERATIONS):
        orbital = orbital_axes(ends.sum(axis=0), ends[1] - ends[0])
        half = math.asin(min(1.0, float(np.linalg.norm(ends[1] - ends[0])) / 2 / radius))
        looks = rotations(np.array([[0.0, -half, yaw], [0.0, half, yaw]])) @ view @ orbital.T
        down = (middles * looks).sum(axis=1)
        inside = down**2 - (middles**2).sum(axis=1) + radius**2
        if not (inside > 0).all() or not (down < 0).all():
            break
        before, ends = ends, middles - (down + np.sqrt(inside))[:, None] * looks
        if np.abs(ends - before).max() < _SETTLED:
            return ends, orbital, 2 * half
    raise InputError(
        "no orbit at this height sees these corners with these look angles",
        field="corners, altitude, along_deg, across_deg",
        remedy="check the order of the corners and the units: degrees, metres",
    )


def _focal_length(
    points: Array, ends: Array, orbital: Array, width: int, length: float | None, pixel: float | None
) -> float:
    """Return the focal length in pixels, negative if columns increase to the right of the flight."""
    ground = geocentric(points)
    rows = np.stack([ground[1] - ground[0], ground[2] - ground[3]])
    sign = np.sign(rows @ orbital[:, 1])
    if sign[0] * sign[1] <= 0:
        raise InputError(
            "first and last row have opposite directions",
            field="corners",
            remedy="give them in the order UL, UR, LR, LL",
        )
    if length is not None and pixel:
        focal = length / pixel
    elif length is not None or pixel is not None:
        raise InputError("focal length and pixel size must both be given, or neither", field="focal_length, pixel_size")
    else:
        lines = np.stack([ground[:2].mean(axis=0), ground[2:].mean(axis=0)]) - ends
        distance = np.linalg.norm(lines, axis=1)
        looks = lines / distance[:, None]
        across = rows - (rows * looks).sum(axis=1)[:, None] * looks
        focal = float(np.mean(distance / np.linalg.norm(across, axis=1)) * width)
    if not (math.isfinite(focal) and focal > 0):
        raise InputError(f"{focal} is not a focal length", field="focal_length, pixel_size")
    return float(sign[0]) * focal


def _level_flight(
    camera: LineCamera,
    radius: float,
    orbital: Array,
    mounting: Array,
    travelled: float,
    yaw: float,
    heights: tuple[float, float],
    form: SplineForm,
) -> Pushbroom:
    """Return a line scanner on a circle about the Earth's centre, with a platform that follows the circle."""
    degree, pieces = form.degree, [form.path or 1, form.attitude or 1]
    duration = travelled / math.sqrt(EARTH_GM / radius**3)
    times = np.linspace(0.0, duration, 6 * (degree + max(pieces)))
    angle = travelled * (times / duration - 0.5)
    zeros, breaks = np.zeros_like(angle), [np.linspace(0.0, duration, 1 + count) for count in pieces]
    circle = radius * np.stack([np.sin(angle), zeros, np.cos(angle) - 1], axis=1)
    turned = np.stack([zeros, angle, zeros + yaw], axis=1)
    return Pushbroom(
        camera=camera,
        line_period=duration / camera.height,
        origin=radius * orbital[:, 2],
        orbital=orbital,
        mounting=mounting,
        path=Spline.fitted(times, circle, degree, breaks[0], min(degree, 2)),
        attitude=Spline.fitted(times, turned, degree, breaks[1], 1),
        lever=np.zeros(3),
        path_line=np.zeros((2, 3)),
        attitude_line=np.zeros((2, 3)),
        heights=heights,
        free=(),
        shape=OrbitShape(),
    )


def _met(model: Pushbroom, corners: Array) -> Pushbroom:
    """Return the model with the roll, pitch and yaw that fit the corners best."""
    image = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) * (model.camera.width, model.camera.height)
    turned = model.freed("attitude_offset")
    for _ in range(10):
        miss = image - turned.ground_to_image(corners)
        slopes = turned.param_partials(corners).reshape(8, 3)
        if not np.isfinite(miss).all():
            raise InputError(
                "the start model does not see the corners", field="corners, altitude, along_deg, across_deg"
            )
        step = np.linalg.lstsq(slopes, miss.ravel(), rcond=None)[0]
        turned = turned.with_params(turned.params + step)
        if np.abs(step).max() < 1e-9:
            break
    line = turned.attitude_line
    attitude = turned.attitude.plus_line(line[0], line[1], 0.0)
    return turned._replace(attitude=attitude, attitude_line=np.zeros((2, 3)))


def _softened(model: Pushbroom, sigmas: SoftSigmas) -> Pushbroom:
    """Return the model with all spline coefficients free and its attitude as observations."""
    attitude = model.attitude
    ends = attitude.breaks[[0, -1]]
    middle = ends.mean(keepdims=True)
    tables = [
        Observations(times, attitude(times, derivative), np.full((len(times), 3), sigma), derivative, True)
        for times, derivative, sigma in ((middle, 0, sigmas.attitude), (ends, 1, sigmas.rate))
        if sigma is not None
    ]
    return model._replace(attitude_observations=tuple(tables)).freed("path", "attitude")
