"""Dependence of the displacement on heights, columns, rows and bands, and the likely cause."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ortho_pipeline.commands.orthos.datums import datum_of
from ortho_pipeline.commands.orthos.measuring import MeasuredOrtho
from ortho_pipeline.commands.orthos.statistics import Verified, slopes_of
from ortho_pipeline.display.numbers import size_m
from ortho_pipeline.estimation.spatial.displacement_field import FEWEST_POINTS, DisplacementField
from ortho_pipeline.geodesy.crs import parse_crs
from ortho_pipeline.models.base import Array
from ortho_pipeline.surface.base import Surface

#: A dependence counts from so many sigmas on, and if it displaces something by so many pixels.
_SIGMAS, _PIXELS = 4.0, 0.1
#: A step is looked for at so many places, in windows of this part of the extent; it counts from so many sigmas on.
_PLACES, _WINDOW, _STEP_SIGMAS, _STEP_PIXELS = 41, 0.12, 6.0, 0.15
#: The cause of a displacement explains this part of its mean square at least.
_EXPLAINS = 0.5
#: Half and whole pixels count as found within so many pixels.
_EXACTLY = 0.06


@dataclass(frozen=True)
class HeightDependence:
    """How the displacement grows with the height of the ground.

    Parameters
    ----------
    east, north : float
        Metres of displacement per metre of height.
    sigma : float
        Of that, in its direction.
    spread : float
        Standard deviation (m) of the heights at the matches.
    zero : float, optional
        Ellipsoidal height (m) at which the displacement along that direction vanishes.
    """

    east: float
    north: float
    sigma: float
    spread: float
    zero: float | None

    @property
    def rate(self) -> float:
        """Metres per metre of height."""
        return math.hypot(self.east, self.north)

    @property
    def azimuth_deg(self) -> float:
        """Where higher ground is displaced to, from north clockwise."""
        return math.degrees(math.atan2(self.east, self.north)) % 360

    def counts(self, pixel: float) -> bool:
        """Tell whether it is significant, and large enough to matter."""
        return self.rate > _SIGMAS * self.sigma and self.rate * self.spread > _PIXELS * pixel

    def to_json(self, pixel: float) -> dict[str, Any]:
        """Return it as JSON values."""
        return {
            "east_m_per_m": self.east,
            "north_m_per_m": self.north,
            "rate_m_per_m": self.rate,
            "sigma_m_per_m": self.sigma,
            "azimuth_deg": self.azimuth_deg,
            "heights_spread_m": self.spread,
            "zero_height_m": self.zero,
            "significant": self.counts(pixel),
        }


@dataclass(frozen=True)
class FieldStep:
    """A step of the displacement at a column or row: a detector join, a seam of a mosaic, or a jump of the attitude."""

    axis: str
    at: float
    east: float
    north: float
    sigma: float

    def to_json(self) -> dict[str, Any]:
        """Return it as JSON values."""
        return {"axis": self.axis, "at": self.at, "east_m": self.east, "north_m": self.north, "sigma_m": self.sigma}


def height_dependence(measured: MeasuredOrtho, surface: Surface) -> HeightDependence | None:
    """Return how the displacement depends on heights; None where the DEM has too few, or all are alike."""
    heights = surface.heights(measured.ground[:, :2], measured.scene.model.crs)
    good = np.isfinite(heights)
    if good.sum() < 30 or not np.std(heights[good]) > 1.0:
        return None
    place, value = measured.image[good], measured.displacement[good]
    about = heights[good] - heights[good].mean()
    rates = np.zeros(2)
    sigmas = np.zeros(2)
    for _ in range(2):
        # The field without what heights explain says how the rest is correlated.
        field = DisplacementField.of(place, value - about[:, None] * rates, measured.sigma[good], measured.chip)
        rates, sigmas, level = field.regressed(place, value, about)
    rate = float(np.hypot(*rates))
    unit = rates / max(rate, 1e-12)
    zero = float(heights[good].mean() - level @ unit / rate) if rate > _SIGMAS * sigmas.max() else None
    return HeightDependence(
        float(rates[0]), float(rates[1]), float(np.hypot(*(sigmas * unit))), float(about.std()), zero
    )


def without_heights(verified: Verified, heights: HeightDependence, surface: Surface) -> Verified:
    """Return the field without what the heights explain; cells without a height are left out."""
    model = verified.measured.scene.model
    ground = model.image_to_ground(verified.cells, 0.0)
    above = surface.heights(ground[:, :2], model.crs) - (heights.zero or 0.0)
    good = np.isfinite(above)
    if good.sum() < FEWEST_POINTS:
        return verified
    noise = np.random.default_rng(1).normal(0.0, heights.sigma, (len(verified.draws), 2))
    rates = np.array([heights.east, heights.north]) + noise
    draws = verified.draws[:, good] - above[good, None] * rates[:, None]
    return replace(verified, cells=verified.cells[good], draws=draws)


def steps_of(measured: MeasuredOrtho) -> list[FieldStep]:
    """Return the largest steps along columns and rows, if there are any."""
    found = []
    for axis, name in ((0, "column"), (1, "row")):
        best = max(_steps(measured, axis, name), key=_strength, default=None)
        if best is None or math.hypot(best.east, best.north) < _STEP_PIXELS * measured.pixel:
            continue
        if _strength(best) > _STEP_SIGMAS:
            found.append(best)
    return found


def _strength(step: FieldStep) -> float:
    return math.hypot(step.east, step.north) / max(step.sigma, 1e-12)


def _steps(measured: MeasuredOrtho, axis: int, name: str) -> list[FieldStep]:
    along, values = measured.image[:, axis], measured.displacement
    low, high = along.min(), along.max()
    window, found = _WINDOW * (high - low), []
    across = measured.image[:, 1 - axis]
    for at in np.linspace(low + window, high - window, _PLACES):
        near = np.abs(along - at) <= window
        beyond = along[near] > at
        if min(beyond.sum(), (~beyond).sum()) < 8:
            continue
        off = (along[near] - at) / window
        other = (across[near] - across[near].mean()) / max(np.ptp(across[near]), 1.0)
        design = np.column_stack([beyond, np.ones(len(off)), off, other, other**2, off * beyond])
        # With a single line of matches on a side, a slope may be taken for a step.
        if np.linalg.matrix_rank(design) < design.shape[1]:
            continue
        inverse = np.linalg.pinv(design)
        size = inverse[0] @ values[near]
        left = values[near] - design @ (inverse @ values[near])
        variance = (left**2).sum() / max(len(off) - design.shape[1], 1) / 2
        sigma = float(np.sqrt(variance * (inverse[0] ** 2).sum()))
        found.append(FieldStep(name, float(at), float(size[0]), float(size[1]), sigma))
    return found


@dataclass(frozen=True)
class Cause:
    """A cause that the displacement shows.

    Parameters
    ----------
    code : str
        heights, datum, half-pixel, rotation, scale, model, shift, step, bands, smooth.
    square : float
        Mean square (m²) of the displacement that it explains.
    """

    code: str
    text: str
    square: float


def causes_of(
    verified: Verified, heights: HeightDependence | None, surface: Surface | None, steps: Sequence[FieldStep]
) -> list[dict[str, Any]]:
    """Return the likely causes of the displacement as JSON values; that which explains most of it first."""
    measured, whole = verified.measured, _square(verified.mean)
    # The model of the ortho does not displace a part alone. If heights do, all matches have shown it.
    rest = Verified.of(measured.rest) if measured.apart.any() else verified
    found = []
    if surface is not None and heights is not None and heights.counts(measured.pixel):
        left = without_heights(verified, heights, surface)
        found.append(_of_heights(heights, max(whole - _square(left.mean), 0.0)))
        rest = without_heights(rest, heights, surface)
    found += _of_rest(rest, heights, steps)
    return [
        {"code": one.code, "text": one.text, "share": min(one.square / whole, 1.0) if whole > 0 else 0.0}
        for one in sorted(found, key=lambda one: -one.square)
    ]


def _square(shifts: Array) -> float:
    return float((shifts**2).sum(axis=1).mean())


def _of_rest(verified: Verified, heights: HeightDependence | None, steps: Sequence[FieldStep]) -> list[Cause]:
    """Return the causes of that which heights do not explain."""
    measured = verified.measured
    found = [*_of_slopes(verified), *_of_shift(verified), *(_of_step(step, measured) for step in steps)]
    rest = _bending(verified)
    if rest > max(3.0 * float(verified.field.noise.max()) / 5, 0.2 * measured.pixel) and not (
        heights is not None and heights.counts(measured.pixel)
    ):
        text = f"the displacement bends by {size_m(rest)} (RMS) over the ortho. "
        text += (
            "Wrong heights or a sensor model that was not adjusted cause this. Give a DEM to test the heights"
            if heights is None
            else "A sensor model that was not adjusted causes this"
        )
        found.append(Cause("smooth", text, rest**2))
    return found


def _of_heights(heights: HeightDependence, square: float) -> Cause:
    angle = math.degrees(math.atan(heights.rate))
    text = (
        f"the displacement grows with height, by {heights.rate:.3f} m per metre towards azimuth "
        f"{heights.azimuth_deg:.0f}°. The ortho was made with wrong or missing heights, from a view {angle:.0f}° off "
        "vertical"
    )
    if heights.zero is not None:
        text += f". It fits flat ground at {heights.zero:.0f} m above the ellipsoid"
    return Cause("heights", text, square)


def _of_slopes(verified: Verified) -> list[Cause]:
    measured = verified.measured
    slopes, sigmas = slopes_of(verified)
    # In the directions of columns (east, in a north-up map) and rows (south).
    turn = measured.metres / np.linalg.norm(measured.metres, axis=0)
    matrix = slopes @ np.linalg.inv(turn)
    cells = (verified.cells - verified.cells.mean(axis=0)) * np.linalg.norm(measured.metres, axis=0)
    square = _square(cells @ slopes.T)
    sigma = float(sigmas.max())
    reach = 0.35 * max(measured.size) * measured.pixel
    rotation = (matrix[0, 1] - matrix[1, 0]) / 2
    scale = (matrix[0, 0] + matrix[1, 1]) / 2
    shear = math.hypot((matrix[0, 0] - matrix[1, 1]) / 2, (matrix[0, 1] + matrix[1, 0]) / 2)
    least = max(_SIGMAS * sigma, _PIXELS * measured.pixel / reach)
    if max(abs(rotation), abs(scale), shear) < least:
        return []
    if shear > 0.5 * max(abs(rotation), abs(scale)) or min(abs(rotation), abs(scale)) > least:
        text = (
            f"the displacement changes linearly over the ortho, by up to {size_m(2 * reach * np.abs(matrix).max())}. "
            "An old or unadjusted sensor model (RPC) causes this"
        )
        return [Cause("model", text, square)]
    if abs(rotation) > abs(scale):
        text = f"the ortho is rotated by {math.degrees(rotation):+.4f}° (clockwise is positive)"
        return [Cause("rotation", text, square)]
    return [Cause("scale", f"the ortho is {1e6 * scale:+.0f} parts per million too large", square)]


def _of_shift(verified: Verified) -> list[Cause]:
    measured, relative = verified.measured, verified.relative()
    bias = np.array([relative.bias_east.value, relative.bias_north.value])
    interval = max(one.high - one.low for one in (relative.bias_east, relative.bias_north))
    length = float(np.hypot(*bias))
    if length < max(interval, 0.05 * measured.pixel) or length**2 < _EXPLAINS * relative.rmse.value**2:
        return []
    pixels = np.linalg.solve(measured.metres, bias)
    halves = np.abs(pixels - 0.5 * np.sign(pixels))
    if (halves < max(_EXACTLY, interval / measured.pixel)).all():
        text = "the ortho is displaced by half a pixel along both axes. Pixel centres were used as pixel corners"
        return [Cause("half-pixel", text, length**2)]
    middle = measured.scene.model.image_to_ground(np.array(measured.size)[None] / 2, 0.0)[0]
    datum = datum_of(parse_crs(measured.scene.model.crs), middle, bias, max(interval, 0.0))
    if datum is not None:
        text = (
            f"the shift of {size_m(length)} equals the difference between {datum} and the datum of the ortho. A wrong "
            "datum is the likely cause"
        )
        return [Cause("datum", text, length**2)]
    azimuth = math.degrees(math.atan2(bias[0], bias[1])) % 360
    text = (
        f"ortho or reference is shifted: the ortho lies {size_m(length)} towards azimuth {azimuth:.0f}°. Surveyed "
        "points, measured in the ortho, show which. If the ortho is wrong, make it again with control points, or "
        "correct it with ortho align"
    )
    return [Cause("shift", text, length**2)]


def _of_step(step: FieldStep, measured: MeasuredOrtho) -> Cause:
    size = math.hypot(step.east, step.north)
    text = (
        f"the displacement jumps by {size_m(size)} at {step.axis} {step.at:.0f}. A seam line of a mosaic, a join of "
        "detectors or a jump of the attitude causes this"
    )
    part = step.at / measured.size[0 if step.axis == "column" else 1]
    return Cause("step", text, part * (1 - part) * size**2)


def _bending(verified: Verified) -> float:
    """Return the RMS (m) of the likeliest field about its affine trend."""
    mean: Array = verified.mean
    design = np.column_stack([np.ones(len(mean)), verified.cells])
    left = mean - design @ np.linalg.lstsq(design, mean, rcond=None)[0]
    return float(np.sqrt((left**2).sum(axis=1).mean()))
