"""Residuals as people feel them: in metres on the ground, and along or across the direction of view.

An ortho shows a point where its ray meets the DEM. A wrong height moves it along the direction of view and nowhere
else, so that residuals along it tell of heights, and those across it of the sensor model and of measuring.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ortho_pipeline.crs import parse_crs
from ortho_pipeline.estimation import Fit, root_mean_square
from ortho_pipeline.geometry import units_per_metre
from ortho_pipeline.models.base import Array, SensorModel, solve_2x2

#: An image that moves less than this (pixels per metre of height) has no direction of view to speak of.
_NADIR = 1e-4


def metre_partials(model: SensorModel, ground: Array) -> tuple[Array, Array]:
    """Return d(image)/d(x, y in metres) ``(N, 2, 2)`` and d(image)/d(height) ``(N, 2)``."""
    ground = with_reference_height(model, ground)
    partials = model.ground_partials(ground)
    units = units_per_metre(parse_crs(model.crs), ground)
    return partials[:, :, :2] * units[:, None, :2], partials[:, :, 2]


def with_reference_height(model: SensorModel, ground: Array) -> Array:
    """Return ground points with the model's reference height where they have none (2D models take such points)."""
    missing = np.isnan(ground[:, 2])
    if missing.any():
        ground = ground.copy()
        ground[missing, 2] = model.reference_height
    return ground


def in_metres(fit: Fit, residuals: Array) -> Array:
    """Return residuals ``(N, 2)`` px as shifts of the ortho, metres along x and y of the model's ground CRS."""
    if not len(residuals):
        return np.zeros((0, 2))
    plan, _ = metre_partials(fit.model, fit.points.ground)
    return solve_2x2(plan, residuals)


def rmse_metres(fit: Fit) -> dict[str, Any]:
    """Return root mean squares in metres over control (used), check and left-out residuals; None for no points."""
    shifts = in_metres(fit, fit.residuals)
    values = {
        "control": shifts[fit.used],
        "check": shifts[fit.points.check],
        "loo": in_metres(fit, fit.loo_residuals),
    }
    found = {}
    for name, rows in values.items():
        rmse = root_mean_square(rows[np.isfinite(rows).all(axis=1)])
        found[name] = rmse and {"x": rmse["col"], "y": rmse["row"], "total": rmse["total"], "n": rmse["n"]}
    return found


def along_view(fit: Fit) -> Array:
    """Return the residuals ``(N, 2)`` px along and across the direction of view; NaN for a view straight down.

    Along is positive towards where a higher point appears in the image; across is 90 degrees further, from column
    towards row.
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
