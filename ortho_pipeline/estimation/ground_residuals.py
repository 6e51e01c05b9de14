"""Residuals in metres on the ground, and along or across the direction of view.

An ortho shows a point where its ray meets the DEM. A wrong height moves the point only along the direction of view. So
residuals along it show errors of heights, and residuals across it show errors of the sensor model and the measurement.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.records import RmseOnGround, RmsesOnGround
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.models.base import Array, SensorModel, solve_2x2

#: If a metre of height moves the image less than this (pixels), the direction of view is undefined.
_NADIR = 1e-4


def metre_partials(model: SensorModel, ground: Array) -> tuple[Array, Array]:
    """Return d(image)/d(true east, north in metres) ``(N, 2, 2)`` and d(image)/d(height) ``(N, 2)``."""
    ground = with_reference_height(model, ground)
    partials = model.ground_partials(ground) @ map_from_enu(parse_crs(model.crs), ground)
    return partials[:, :, :2], partials[:, :, 2]


def viewing(model: SensorModel, width: int, height: int) -> dict[str, Any]:
    """Return the viewing geometry at the middle of an image: pixel size on the ground, and direction of view.

    All values are None if the middle has no ground. `view` has incidence angle, azimuth of the sensor (clockwise
    from true north), and the size of a pixel on level ground along and across that direction. For a square pixel p,
    the formula of the paper gives p / cos^2 along and p / cos across; the model also covers other line spacings.

    Returns
    -------
    dict
        `ground_pixel_m` [along the row, along the column], `lean_m_per_m` and `lean_azimuth_deg` (distance and azimuth
        of the ortho's shift per metre of height), `view` {incidence_deg, sensor_azimuth_deg, pixel_m {along_view,
        across_view}}; `sensor_azimuth_deg` is None for a vertical view; then along is north and across is east.

    Source: Bueyueksalih et al. (OrbView-3), formula 1.
    """
    centre = model.image_to_ground(np.array([[width / 2, height / 2]]), model.reference_height)
    nothing = {"ground_pixel_m": None, "lean_m_per_m": None, "lean_azimuth_deg": None, "view": None}
    if not np.isfinite(centre).all():
        return nothing
    plan, up = metre_partials(model, centre)
    try:
        inverse = np.linalg.inv(plan[0])
    except np.linalg.LinAlgError:
        return nothing
    displacement = inverse @ up[0]
    tangent = float(np.hypot(*displacement))
    seen = np.hypot(*up[0]) > _NADIR
    along = displacement / tangent if seen else np.array([0.0, 1.0])
    across = np.array([along[1], -along[0]])
    return {
        "ground_pixel_m": np.linalg.norm(inverse, axis=0).tolist(),
        "lean_m_per_m": tangent,
        "lean_azimuth_deg": float(np.degrees(np.arctan2(displacement[0], displacement[1])) % 360),
        "view": {
            "incidence_deg": float(np.degrees(np.arctan(tangent))),
            "sensor_azimuth_deg": float(np.degrees(np.arctan2(-displacement[0], -displacement[1])) % 360)
            if seen
            else None,
            "pixel_m": {
                "along_view": float(1.0 / np.linalg.norm(plan[0] @ along)),
                "across_view": float(1.0 / np.linalg.norm(plan[0] @ across)),
            },
        },
    }


def with_reference_height(model: SensorModel, ground: Array) -> Array:
    """Return ground points with the model's reference height where they have none (as 2D models allow)."""
    missing = np.isnan(ground[:, 2])
    if missing.any():
        ground = ground.copy()
        ground[missing, 2] = model.reference_height
    return ground


def shifts_of(model: SensorModel, ground: Array, residuals: Array) -> Array:
    """Return residuals ``(N, 2)`` px at ground points as shifts on the ground, metres true east and north."""
    return solve_2x2(metre_partials(model, ground)[0], residuals)


def in_metres(fit: Fit, residuals: Array) -> Array:
    """Return residuals ``(N, 2)`` px as shifts of the ortho on the ground, metres true east and north."""
    return shifts_of(fit.model, fit.points.ground, residuals) if len(residuals) else np.zeros((0, 2))


def rmse_metres(fit: Fit) -> RmsesOnGround:
    """Return root mean squares (m; x is east, y north) of control (used), check and left-out residuals, or None."""
    shifts = in_metres(fit, fit.residuals)
    values = {
        "control": shifts[fit.used],
        "check": shifts[fit.points.tests],
        "loo": in_metres(fit, fit.loo_residuals),
    }
    held_out = fit.points.check & ~fit.points.tests
    if held_out.any():
        values["matched"] = shifts[held_out]
    return RmsesOnGround(
        **{name: RmseOnGround.of(rows[np.isfinite(rows).all(axis=1)]) for name, rows in values.items()}
    )


def along_view(fit: Fit) -> Array:
    """Return the residuals ``(N, 2)`` px along and across the direction of view; NaN for a vertical view.

    Along is positive in the direction in which a higher point moves in the image. Across is 90 degrees further, from
    column towards row.
    """
    if not len(fit.points):
        return np.zeros((0, 2))
    _, up = metre_partials(fit.model, fit.points.ground)
    length = np.hypot(up[:, 0], up[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where((length > _NADIR)[:, None], up / length[:, None], np.nan)
    residuals = fit.residuals
    along = (residuals * axis).sum(axis=1)
    return np.stack([along, axis[:, 0] * residuals[:, 1] - axis[:, 1] * residuals[:, 0]], axis=1)
