r"""Effective resolution from edges: edge spread, line spread, and the width of the point spread in pixels.

A straight edge that crosses the pixel grid at an angle is sampled at every sub-pixel distance from it. Sorted by that
distance, its pixels are the edge spread function (ESF); its derivative is the line spread function (LSF), whose full
width at half maximum (FWHM) is the effective resolution. A perfect sensor has the aperture of its pixel alone: an LSF
of FWHM 1.0 and standard deviation :math:`\sqrt{1/12} = 0.29` pixels, whatever the angle. FWHM and `sigma` here include
that aperture. `psf_sigma` is the part of optics, motion and processing: the standard deviation of the Gaussian that,
convolved with the square pixel at its angle to the edge, fits the pixels.

Source: ISO 12233 (slanted edge, bins of a quarter pixel along the normal); section 1 of Bueyueksalih et al.
(OrbView-3), who conclude from such an analysis that the effective resolution is not below the ground sample distance,
and warn that edge enhancement sharpens it: hence `overshoot`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted

Array = NDArray[np.float64]
Segment = tuple[tuple[float, float], tuple[float, float]]

#: Largest distance (px) from an edge to analyse, and least number of lines of pixels that an edge must cross.
HALF_WIDTH, SHORTEST = 10.0, 10
#: Bins of the edge spread function, pixels (ISO 12233).
BIN = 0.25
#: Standard deviation of the aperture of a pixel.
APERTURE = math.sqrt(1 / 12)
#: Least step of an edge, in standard deviations of the noise.
_CONTRAST = 5.0
#: Largest share of saturated pixels.
_SATURATED = 0.05
_NO_EDGE_REMEDY = Text("give an edge between two even areas with ", Setting("edge", "x1,y1,x2,y2"))


@dataclass(frozen=True, eq=False)
class Edge:
    """One edge and its spread; lengths in pixels.

    `segment` is the fitted edge, `angle_deg` its angle to the nearer pixel axis, `profile` the axis nearer to its
    normal. `noise` is the scatter of pixels away from the edge, `sigma_error` the standard deviation of `psf_sigma`.
    `misfit` is the deviation of pixels near the edge from the model, beyond noise, as a share of the step. `distance`,
    `esf` (0 to 1) and `lsf` (per pixel) are the binned functions.
    """

    segment: Segment
    angle_deg: float
    profile: str
    lines: int
    contrast: float
    noise: float
    fwhm: float
    psf_sigma: float
    sigma_error: float
    overshoot: float
    misfit: float
    distance: Array
    esf: Array
    lsf: Array

    @property
    def sigma(self) -> float:
        """Standard deviation of the line spread, including the aperture of the pixel."""
        return math.hypot(self.psf_sigma, APERTURE)

    def to_json(self) -> dict[str, Any]:
        """Return the edge as JSON values, without its functions."""
        return {
            "edge": [list(end) for end in self.segment],
            "angle_deg": self.angle_deg,
            "profile": self.profile,
            "lines": self.lines,
            "contrast": self.contrast,
            "noise": self.noise,
            "fwhm_px": self.fwhm,
            "sigma_px": self.sigma,
            "psf_sigma_px": self.psf_sigma,
            "psf_sigma_error_px": self.sigma_error,
            "overshoot": self.overshoot,
        }


# -- one edge --------------------------------------------------------------------------------------------------------


def analyse_edge(
    pixels: Array, segment: Segment, *, half_width: float = HALF_WIDTH, limits: tuple[float, ...] = ()
) -> Edge:
    """Measure the spread of one straight edge.

    Parameters
    ----------
    pixels : (H, W)
        NaN where there is no value.
    segment : two points
        (column, row) of its ends, to a few pixels; the outer corner of the first pixel is (0, 0).
    half_width : float
        Width (px) of the even area on each side.
    limits : tuple of float
        Values of saturated pixels, which make an edge look sharper than it is.

    Raises
    ------
    InputError
        If it is outside the pixels, too short, too faint, saturated, or no edge; or if the pixel grid samples it at too
        few distances (along a pixel axis, or at 45 degrees).
    """
    (x1, y1), (x2, y2) = segment
    if not all(map(math.isfinite, (x1, y1, x2, y2))):
        raise InputError("an edge needs four finite numbers", field="edge", remedy=_NO_EDGE_REMEDY)
    height, width = pixels.shape
    if min(x1, x2) < 0 or min(y1, y2) < 0 or max(x1, x2) > width or max(y1, y2) > height:
        raise InputError(
            f"the edge {said(segment)} is outside the image of {width} x {height} pixels",
            field="edge",
            remedy="give columns and rows within the image",
        )
    steep = abs(y2 - y1) >= abs(x2 - x1)
    # From here on the edge crosses rows: x = a + b y with |b| <= 1.
    view, ends = (pixels, segment) if steep else (pixels.T, ((y1, x1), (y2, x2)))
    area = _Area.around(view, ends, half_width)
    line = area.first_line()
    fitted = _Fitted.to(area, line)
    # Only as far as the spread: pixels farther away may be something else.
    reach = max(5.0, 5 * math.hypot(fitted.sigma, APERTURE))
    if reach < half_width:
        area = _Area.around(view, fitted.ends(area), reach)
        fitted = _Fitted.to(area, (fitted.a, fitted.b))
    _require_step(fitted)
    _require_unsaturated(area, limits)
    distance, left, error = _binned(fitted)
    esf = fitted.model(distance) + left
    lsf, fwhm = _line_spread(fitted, distance, left)
    first, second = fitted.ends(area)
    return Edge(
        segment=(first, second) if steep else (first[::-1], second[::-1]),
        angle_deg=abs(math.degrees(math.atan(fitted.b))),
        profile="along the row" if steep else "along the column",
        lines=len(area.rows),
        contrast=abs(fitted.high - fitted.low),
        noise=fitted.noise,
        fwhm=fwhm,
        psf_sigma=fitted.sigma,
        sigma_error=fitted.sigma_error,
        overshoot=_overshoot(distance, esf, error, fitted.sigma),
        misfit=fitted.misfit,
        distance=distance,
        esf=esf,
        lsf=lsf,
    )


@dataclass(frozen=True, eq=False)
class _Area:
    """Pixels ``(rows, columns)`` around an edge that crosses rows: centres `x`, `rows`, and values (NaN if none)."""

    rows: Array
    x: Array
    values: Array
    middle: Array

    @classmethod
    def around(cls, pixels: Array, ends: Segment, half_width: float) -> _Area:
        (x1, y1), (x2, y2) = sorted(ends, key=lambda end: end[1])
        height, width = pixels.shape
        rows = np.arange(max(0, math.ceil(y1 - 0.5)), min(height, math.floor(y2 - 0.5) + 1))
        if len(rows) < SHORTEST:
            raise InputError(
                f"the edge crosses only {counted(len(rows), 'line')} of pixels; {SHORTEST} are needed",
                field="edge",
                remedy="give a longer edge",
            )
        middle = x1 + (x2 - x1) * (rows + 0.5 - y1) / (y2 - y1)
        reach = math.ceil(half_width * math.hypot(1.0, (x2 - x1) / (y2 - y1)))
        columns = np.floor(middle).astype(int)[:, None] + np.arange(-reach, reach + 1)
        inside = (columns >= 0) & (columns < width)
        values = np.where(inside, pixels[rows[:, None], np.clip(columns, 0, width - 1)], np.nan)
        if np.isfinite(values).mean() < 0.5:
            raise InputError(
                "most pixels next to the edge have no value (nodata, or outside the image)",
                field="edge",
                remedy="give an edge with valid pixels on both sides",
            )
        return cls(np.asarray(rows + 0.5), np.asarray(columns + 0.5), values.astype(np.float64), np.asarray(middle))

    def first_line(self) -> tuple[float, float]:
        """Return a, b of ``x = a + b y`` through the centroids of the steps in each row, without outliers."""
        slope = self.values[:, 2:] - self.values[:, :-2]
        x = self.x[:, 1:-1]
        window = np.cos(np.clip((x - self.middle[:, None]) / (x[:, -1:] - x[:, :1] + 1), -0.5, 0.5) * np.pi)
        weight = np.nan_to_num(slope) * window
        weight = np.maximum(weight * (1.0 if weight.sum() >= 0 else -1.0), 0.0)
        total = weight.sum(axis=1)
        known = total > 0
        if known.sum() < 3:
            raise InputError("there is no step in brightness", field="edge", remedy=_NO_EDGE_REMEDY)
        # The square favours the steepest place over noise.
        at = (x * weight**2).sum(axis=1)[known] / (weight**2).sum(axis=1)[known]
        rows = self.rows[known]
        keep = np.ones(len(rows), dtype=bool)
        b, a = 0.0, float(np.median(at))
        for _ in range(4):
            b, a = np.polyfit(rows[keep], at[keep], 1)
            off = np.abs(at - a - b * rows)
            keep = off <= max(3 * 1.4826 * float(np.median(off)), 0.1)
        if abs(b) > 1.5 or np.abs(a + b * self.rows - self.middle).max() > HALF_WIDTH:
            raise InputError("the step in brightness is not straight", field="edge", remedy=_NO_EDGE_REMEDY)
        return float(a), float(b)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A Gaussian edge with the aperture of the pixel, fitted to an area: ``x = a + b y``, and levels on both sides."""

    a: float
    b: float
    low: float
    high: float
    sigma: float
    sigma_error: float
    noise: float
    misfit: float
    distance: Array
    values: Array

    @classmethod
    def to(cls, area: _Area, line: tuple[float, float]) -> _Fitted:
        from scipy.optimize import least_squares

        known = np.isfinite(area.values)
        y = np.broadcast_to(area.rows[:, None], area.values.shape)[known]
        x, values = area.x[known], area.values[known]
        # About the middle of the edge, to separate position and direction.
        centre = float(area.rows.mean())
        place = line[0] + line[1] * centre
        side = x - place - line[1] * (y - centre)
        levels = _levels(side, values)
        scale = max(abs(levels[1] - levels[0]), 1e-9 * (1.0 + abs(levels[0])))

        def model(p: Array) -> Array:
            normal = 1.0 / math.hypot(1.0, p[1])
            d = (x - p[0] - p[1] * (y - centre)) * normal
            return p[2] + (p[3] - p[2]) * edge_response(d, abs(p[4]), normal, abs(p[1]) * normal)

        start = np.array([place, line[1], *levels, 0.8])
        # A soft loss, because areas are never quite even; it starts at the noise.
        beside = np.abs(side) > 3
        noise = 1.4826 * float(np.median(np.abs(values - np.where(side < 0, *levels))[beside]))
        if not scale > _CONTRAST * noise:
            raise _faint(scale, noise)
        # Bounded, because without an edge the fit diverges.
        turn = 8.0 / len(area.rows)
        wide = np.array([4.0, turn, 2 * scale, 2 * scale])
        solution = least_squares(
            lambda p: (model(p) - values) / scale,
            start,
            loss="soft_l1",
            f_scale=max(3 * noise / scale, 1e-3),
            x_scale=[0.1, turn / 10, scale, scale, 0.3],
            max_nfev=60,
            bounds=(np.append(start[:4] - wide, 0.0), np.append(start[:4] + wide, HALF_WIDTH)),
        )
        place, b, low, high, sigma = solution.x.tolist()
        normal = 1.0 / math.hypot(1.0, b)
        distance = (x - place - b * (y - centre)) * normal
        left = values - model(solution.x)
        far = np.abs(distance) > 2 + 2 * abs(sigma)
        noise = float(np.sqrt((left[far] ** 2).mean())) if far.sum() > 20 else float(left.std())
        near = np.abs(distance) <= 2 + abs(sigma)
        excess = float((left[near] ** 2).mean()) - noise**2 if near.any() else math.inf
        misfit = math.sqrt(max(excess, 0.0)) / scale
        weak = np.linalg.pinv(solution.jac.T @ solution.jac)[4, 4]
        error = math.sqrt(max(weak, 0.0)) * float(left.std()) / scale
        return cls(
            place - b * centre, b, low, high, abs(sigma), error, noise, misfit, distance, (values - low) / (high - low)
        )

    def model(self, distance: Array) -> Array:
        """Return the fitted edge, 0 to 1, at distances."""
        normal = 1.0 / math.hypot(1.0, self.b)
        return edge_response(distance, self.sigma, normal, abs(self.b) * normal)

    def ends(self, area: _Area) -> Segment:
        """Return where the edge enters the first row and leaves the last one."""
        top, bottom = float(area.rows[0] - 0.5), float(area.rows[-1] + 0.5)
        return (self.a + self.b * top, top), (self.a + self.b * bottom, bottom)


def _levels(side: Array, values: Array) -> tuple[float, float]:
    """Return the median values to the left and to the right of an edge, from signed distances (px).

    Raises
    ------
    InputError
        If one side has too few pixels.
    """
    if min((side < -3).sum(), (side > 3).sum()) < SHORTEST:
        raise InputError("too few pixels on one side of the edge", field="edge", remedy=_NO_EDGE_REMEDY)
    return float(np.median(values[side < -2])), float(np.median(values[side > 2]))


def edge_response(distance: Array, sigma: float, wide: Array | float, tall: Array | float) -> Array:
    """Return the values of pixels at signed distances from an edge (0 to 1), through a Gaussian and a square pixel.

    Along the normal of the edge, the pixel is the convolution of two boxes, `wide` and `tall` (cosine and sine of the
    angle, one for all or one for each pixel). So the value is the second difference of the second integral of the
    cumulative normal distribution.
    """
    from scipy.special import ndtr

    sigma = max(sigma, 0.02)

    def twice(at: Array) -> Array:
        z = at / sigma
        return np.asarray(sigma**2 / 2 * ((z**2 + 1) * ndtr(z) + z * np.exp(-0.5 * z**2) / math.sqrt(2 * math.pi)))

    # A box of a thousandth of a pixel has no effect, and differences over it still have ten digits.
    long, short = np.maximum(wide, tall), np.maximum(np.minimum(wide, tall), 1e-3)
    out, inner = (long + short) / 2, (long - short) / 2
    ends = twice(distance + out) + twice(distance - out) - twice(distance + inner) - twice(distance - inner)
    return np.asarray(ends / (long * short))


def _require_step(fitted: _Fitted) -> None:
    step = abs(fitted.high - fitted.low)
    if not step > _CONTRAST * fitted.noise or not math.isfinite(fitted.sigma):
        raise _faint(step, fitted.noise)
    if fitted.sigma > HALF_WIDTH / 2.5 or fitted.sigma_error > 0.25 * math.hypot(fitted.sigma, APERTURE):
        raise InputError(
            f"the width of the edge is too uncertain: {fitted.sigma:.2g} ± {fitted.sigma_error:.2g} px",
            field="edge",
            remedy="give a longer or a sharper edge, between even areas",
        )


def _require_unsaturated(area: _Area, limits: tuple[float, ...]) -> None:
    share = float(np.isin(area.values, limits).mean())
    if share > _SATURATED:
        raise InputError(
            f"{share:.0%} of the pixels next to the edge are saturated: they have the lowest or highest possible value",
            field="edge",
            remedy="give an edge between areas that are neither black nor white",
        )


def _faint(step: float, noise: float) -> InputError:
    return InputError(
        f"the edge has too little contrast: its step is {step:.3g}, the noise next to it {noise:.3g}",
        field="edge",
        remedy=_NO_EDGE_REMEDY,
    )


def _binned(fitted: _Fitted) -> tuple[Array, Array, Array]:
    """Return the centres of bins, the deviation of their pixels from the fitted edge (0 to 1), and its error.

    Raises
    ------
    InputError
        If a bin near the edge is empty, because the angle of the edge repeats the same distances.
    """
    # A diverged fit would have unlimited distances.
    reach = math.floor(min(np.abs(fitted.distance).max(), 2 * HALF_WIDTH) / BIN - 0.5) * BIN
    edges = np.arange(-reach - BIN / 2, reach + BIN, BIN)
    which = np.digitize(fitted.distance, edges) - 1
    inside = (which >= 0) & (which < len(edges) - 1)
    which = which[inside]
    counts = np.bincount(which, minlength=len(edges) - 1)
    centres = (edges[:-1] + edges[1:]) / 2
    core = np.abs(centres) <= 2 + fitted.sigma
    if not counts[core].all():
        angle = abs(math.degrees(math.atan(fitted.b)))
        raise InputError(
            f"an edge at {angle:.1f} degrees to a pixel axis has pixels at too few distances from it",
            field="edge",
            remedy="give an edge at 3 to 15 degrees to a pixel axis, or a longer one",
        )
    # Residuals of the model, so positions within a bin do not matter.
    left = fitted.values[inside] - fitted.model(fitted.distance[inside])
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.bincount(which, left, minlength=len(counts)) / counts
        error = np.where(counts > 0, fitted.noise / abs(fitted.high - fitted.low) / np.sqrt(counts), np.nan)
    filled = counts > 0
    # The continuous run of filled bins around the edge.
    low = len(centres) // 2 - int(np.argmin(np.append(filled[: len(centres) // 2 + 1][::-1], False))) + 1
    high = len(centres) // 2 + int(np.argmin(np.append(filled[len(centres) // 2 :], False)))
    return centres[low:high], mean[low:high], error[low:high]


def _line_spread(fitted: _Fitted, distance: Array, left: Array) -> tuple[Array, float]:
    """Return the LSF at the bins and its FWHM: derivatives of the fitted edge and of its smoothed residuals."""
    from scipy.ndimage import gaussian_filter1d

    smooth = 0.4 * math.hypot(fitted.sigma, APERTURE)
    slope = gaussian_filter1d(np.gradient(left, BIN), smooth / BIN, mode="nearest")
    at = np.linspace(distance[0], distance[-1], 8 * (len(distance) - 1) + 1)
    lsf = (fitted.model(at + 0.01) - fitted.model(at - 0.01)) / 0.02 + np.interp(at, distance, slope)
    near = np.flatnonzero(np.abs(at) <= max(2.0, 2 * fitted.sigma))
    peak = int(near[np.argmax(lsf[near])])
    half = lsf[peak] / 2
    return lsf[::8], _crossing(at, lsf, peak, 1, half) - _crossing(at, lsf, peak, -1, half)


def _crossing(at: Array, lsf: Array, peak: int, step: int, half: float) -> float:
    k = peak
    while 0 < k < len(at) - 1 and lsf[k] > half:
        k += step
    before = k - step
    if lsf[k] >= lsf[before]:
        return float(at[k])
    return float(at[before] + (at[k] - at[before]) * (lsf[before] - half) / (lsf[before] - lsf[k]))


def _overshoot(distance: Array, esf: Array, error: Array, sigma: float) -> float:
    """Return the overshoot of the ESF next to the edge, as a share of the step; 0 if it may be noise."""
    beside = (np.abs(distance) > 0.5) & (np.abs(distance) <= 2 + 3 * sigma)
    above = np.where(distance > 0, esf - 1.0, -esf)
    clear = beside & (above > 3 * error)
    return float(above[clear].max()) if clear.any() else 0.0


def said(segment: Segment) -> str:
    """Return a segment in the form of the command line."""
    return ",".join(f"{value:.6g}" for end in segment for value in end)
