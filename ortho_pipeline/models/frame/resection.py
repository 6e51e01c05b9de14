"""Resection in space: the exterior orientation of a frame camera from ground points, without start values.

Three points and their directions give up to four positions (P3P, Grunert's quartic). Many well-spread triples are
solved. The median miss over *all* points ranks the solutions, which excludes gross errors and false solutions: with few
points the fourth smallest, because each solution fits its own three. Damped least squares refines the best few. The
result is a start for `estimation.fit`.

With a known position (an ephemeris), three or more directions give the rotation in closed form.

Source: Haralick, Lee, Ottenberg and Noelle 1994 (P3P); Kabsch 1976 (rotation). Symbols as in Haralick: sides a, b, c,
angles alpha, beta, gamma, s2 = u s1, s3 = v s1.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import DegeneratePoints, NotConverged, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.geodesy.ellipsoid import angles_of_rotation, rotation_between
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.frame.collinearity import rays
from ortho_pipeline.models.frame.working_frame import GEOGRAPHIC, MAP, TOPOCENTRIC
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.points import Points

#: Numbers of triples to solve, and of solutions to refine.
_TRIPLES, _REFINED = 60, 8
#: Triangles flatter than this (height over longest side, on the ground or in the image) are not solved.
_FLAT = 0.05


def resect(
    points: Points,
    interior: Interior,
    *,
    map_crs: str | None = None,
    position: ArrayLike | None = None,
    heights: tuple[float, float] | None = None,
    refraction: bool = False,
) -> FrameCamera:
    """Return the camera that sees the control points where they were measured, without start values.

    Parameters
    ----------
    points : Points
        At least 4 control points with heights (3 if the position is given).
    map_crs : str, optional
        Work in this map projection. Default: a topocentric frame about the points.
    position : (3,), optional
        Approximate perspective centre: lon, lat, ellipsoidal height, or map coordinates and height with `map_crs`.
    heights : (float, float), optional
        Range of ground heights (m). Default: that of the points, extended.

    Raises
    ------
    TooFewPoints, DegeneratePoints, NotConverged
        If the points do not determine the camera.
    """
    control = points.select(points.control & np.isfinite(points.ground[:, 2])).to_crs(map_crs or GEOGRAPHIC)
    needed = 4 if position is None else 3
    if len(control) < needed:
        raise TooFewPoints(
            f"{counted(len(control), 'control point')} with heights cannot orient a camera without start values",
            file=points.source or None,
            remedy=f"give at least {needed}",
        )
    blank = _blank(control, interior, map_crs, refraction)
    place, bearings = blank.working_frame.from_ground(control.ground), _bearings(interior, control.image)
    if position is not None:
        fixed = blank.working_frame.from_ground(np.asarray(position, dtype=np.float64)[None])[0]
        starts = [_looking(fixed, place, bearings)]
    else:
        starts = _best(list(_solutions(place, bearings)), place, bearings)
    if not starts:
        raise DegeneratePoints(
            "the control points are on one line, on the ground or in the image",
            file=points.source or None,
            remedy="spread the points over the image",
        )
    refined = [_refine(blank._replace(exterior=start), control) for start in starts]
    misses = [_miss(camera, control) for camera in refined]
    best = int(np.argmin(misses))
    if not math.isfinite(misses[best]) or misses[best] > 0.05 * math.hypot(interior.width, interior.height):
        raise NotConverged(
            "no orientation of this camera fits the control points",
            remedy="check focal length, pixel pitch, and the points (column, row; x, y, height)",
        )
    return refined[best]._replace(heights=heights or _heights(refined[best], control))


def _blank(control: Points, interior: Interior, map_crs: str | None, refraction: bool) -> FrameCamera:
    """Return a camera in the working frame, with a meaningless orientation."""
    low, high = control.ground[:, 2].min(), control.ground[:, 2].max()
    middle = control.ground.mean(axis=0)
    lon = control.ground[:, 0]
    if map_crs is None and np.ptp(lon) > 180:
        middle[0] = np.where(lon < 0, lon + 360, lon).mean()
    return FrameCamera(
        interior,
        np.array([0.0, 0.0, high + 1.0, 0.0, 0.0, 0.0]),
        frame=TOPOCENTRIC if map_crs is None else MAP,
        ground_crs=map_crs or GEOGRAPHIC,
        origin=(middle[0], middle[1], middle[2]) if map_crs is None else (0.0, 0.0, 0.0),
        heights=(low - 1.0, high + 1.0),
        refraction=refraction,
    )


def _bearings(interior: Interior, image: Array) -> Array:
    """Return unit vectors ``(N, 3)`` in camera axes of the rays of image points."""
    seen = rays(interior, image)
    return seen / np.linalg.norm(seen, axis=1)[:, None]


def _looking(position: Array, place: Array, bearings: Array) -> Array:
    lines = place - position
    seen = np.isfinite(bearings).all(axis=1)
    rotation = rotation_between((lines / np.linalg.norm(lines, axis=1)[:, None])[seen], bearings[seen])
    return np.array([*position, *angles_of_rotation(rotation)])


# -- three points ----------------------------------------------------------------------------------------------------


def _solutions(place: Array, bearings: Array) -> Iterator[tuple[Array, Array]]:
    """Yield rotation and position of every solution of the chosen triples."""
    for triple in _triples(place, bearings):
        ground, rays = place[triple], bearings[triple]
        for distances in _grunert(ground, rays):
            seen = distances[:, None] * rays
            rotation = rotation_between(ground - ground.mean(axis=0), seen - seen.mean(axis=0))
            yield rotation, ground.mean(axis=0) - seen.mean(axis=0) @ rotation


def _triples(place: Array, bearings: Array) -> list[Array]:
    """Return the largest well-shaped triangles in the image out of many, each as indices ``(3,)``."""
    usable = np.flatnonzero(np.isfinite(bearings).all(axis=1))
    generator = np.random.default_rng(0)  # the same points give the same answer every time
    if math.comb(len(usable), 3) <= 4 * _TRIPLES:
        grid = np.array([[i, j, k] for i in usable for j in usable if i < j for k in usable if j < k], dtype=int)
    else:
        grid = np.stack([generator.choice(usable, 3, replace=False) for _ in range(4 * _TRIPLES)])
    if not len(grid):
        return []
    size, shape = _triangles(bearings[grid])
    good = (shape > _FLAT) & (_triangles(place[grid])[1] > _FLAT)
    order = np.argsort(np.where(good, -size, np.inf), kind="stable")[: min(_TRIPLES, int(good.sum()))]
    return list(grid[order])


def _triangles(corners: Array) -> tuple[Array, Array]:
    """Return area and height over longest side of triangles ``(M, 3, 3)``."""
    sides = corners - np.roll(corners, 1, axis=1)
    area = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return area, np.nan_to_num(2 * area / longest**2)


def _grunert(ground: Array, rays: Array) -> Iterator[Array]:
    """Yield the distances ``(3,)`` from the camera to three points."""
    a2, b2, c2 = (float(((ground[i] - ground[j]) ** 2).sum()) for i, j in ((1, 2), (0, 2), (0, 1)))
    cos_a, cos_b, cos_c = (float(rays[i] @ rays[j]) for i, j in ((1, 2), (0, 2), (0, 1)))
    q, plus, c_b, a_b = (a2 - c2) / b2, (a2 + c2) / b2, c2 / b2, a2 / b2
    quartic = [
        (q - 1) ** 2 - 4 * c_b * cos_a**2,
        4 * (q * (1 - q) * cos_b - (1 - plus) * cos_a * cos_c + 2 * c_b * cos_a**2 * cos_b),
        2
        * (
            q**2
            - 1
            + 2 * q**2 * cos_b**2
            + 2 * (1 - c_b) * cos_a**2
            - 4 * plus * cos_a * cos_b * cos_c
            + 2 * (1 - a_b) * cos_c**2
        ),
        4 * (-q * (1 + q) * cos_b + 2 * a_b * cos_c**2 * cos_b - (1 - plus) * cos_a * cos_c),
        (1 + q) ** 2 - 4 * a_b * cos_c**2,
    ]
    for root in np.roots(quartic):
        # Noise makes a double root complex; its real part is still a start.
        v = float(root.real)
        if v <= 0 or abs(root.imag) > 0.1 * v:
            continue
        below = cos_c - v * cos_a
        u = ((q - 1) * v**2 - 2 * q * cos_b * v + 1 + q) / (2 * below) if below else 0.0
        s1 = math.sqrt(b2 / (1 + v**2 - 2 * v * cos_b))
        if u > 0:
            yield s1 * np.array([1.0, u, v])


# -- all points ------------------------------------------------------------------------------------------------------


def _best(solutions: list[tuple[Array, Array]], place: Array, bearings: Array) -> list[Array]:
    """Return the exterior orientations ``(6,)`` of the solutions with the smallest median angle to all points."""
    if not solutions:
        return []
    rotations = np.stack([rotation for rotation, _ in solutions])
    lines = place[None] - np.stack([position for _, position in solutions])[:, None]
    lines /= np.linalg.norm(lines, axis=2)[:, :, None]
    misses = np.linalg.norm(np.einsum("sij,snj->sni", rotations, lines) - bearings, axis=2)
    misses = misses[:, np.isfinite(bearings).all(axis=1)]
    order = np.argsort(_typical(misses), kind="stable")[:_REFINED]
    return [np.array([*solutions[i][1], *angles_of_rotation(rotations[i])]) for i in order]


def _refine(camera: FrameCamera, control: Points) -> FrameCamera:
    """Adjust the exterior orientation to the points with a robust loss; return the start if that fails."""
    from scipy.optimize import least_squares

    seen = np.isfinite(camera.ground_to_image(control.ground)).all(axis=1)
    if 2 * seen.sum() < 6:
        return camera
    ground, image = control.ground[seen], control.image[seen]

    def misfit(params: Array) -> Array:
        return (camera.with_params(params).ground_to_image(ground) - image).ravel()

    def slope(params: Array) -> Array:
        return camera.with_params(params).param_partials(ground).reshape(-1, 6)

    try:
        solution = least_squares(misfit, camera.params, slope, x_scale="jac", loss="soft_l1", f_scale=3.0, max_nfev=50)
    except (ValueError, np.linalg.LinAlgError):
        return camera  # a step behind the points: a useless start
    return camera.with_params(solution.x)


def _miss(camera: FrameCamera, control: Points) -> float:
    return float(_typical(np.hypot(*(camera.ground_to_image(control.ground) - control.image).T)))


def _typical(misses: Array) -> Array:
    """Return the upper median of misses ``(..., N)``, at least the fourth smallest; a point that is not seen is far."""
    far = np.sort(np.where(np.isfinite(misses), misses, np.inf), axis=-1)
    count = far.shape[-1]
    return np.asarray(far[..., max(count // 2, min(3, count - 1))])


def _heights(camera: FrameCamera, control: Points) -> tuple[float, float]:
    low, high = float(control.ground[:, 2].min()), float(control.ground[:, 2].max())
    clearance = max(float(camera.perspective_centre[2]) - high, 0.0)
    margin = max(1.0, min((high - low) / 2 + 100.0, 0.2 * clearance))
    return low - margin, high + margin
