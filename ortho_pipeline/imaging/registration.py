"""Band-to-band registration: aligns bands of several cameras with one of them.

Tie points are patches on a regular grid. Phase correlation (scikit-image) finds each to a pixel, and least squares
(`matching.least_squares`) to a fraction of it. Patches are measured twice: near the coarse shift of the frames, then
near the transformation of the first pass, so that they overlap to a pixel. A similarity, affine, projective or
second-order polynomial transformation is fitted by least squares without contradicting tie points. The band is
resampled once, by cubic splines.

Source: Ok and Turker, section 2.2; Yuksel et al. 2004 (the four cameras of BILSAT-1 onto the red one).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.models.base import Array, as_image

#: Number of parameters by the name of the transformation.
TRANSFORMS = {"similarity": 4, "affine": 6, "projective": 8, "poly2": 12}
#: Search radius (px) of least squares around a patch.
_REACH = 6
#: A tie point is rejected beyond this many robust standard deviations, and never below this many pixels.
_REJECT_SIGMAS, _REJECT_FLOOR = 3.5, 0.02
#: Least contrast of a patch, as part of the band's usual contrast.
_CONTRAST = 0.2
#: Least correlation of patches; below, it can be noise.
_LIKENESS = 0.4
#: Standard deviation (px) of the blur to subtract before patches are correlated.
_BROAD = 6.0


@dataclass(frozen=True, eq=False)
class Transform:
    """Map of image points of the reference band to another band.

    Parameters
    ----------
    kind : str
        One of `TRANSFORMS`.
    coefficients : (2, T) or (8,)
        Polynomial coefficients of column and row, or the projective parameters (a1 a2 a3 b1 b2 b3 c1 c2).
    centre, scale : (2,), float
        Points are normalised by (point - centre) / scale on both sides.
    """

    kind: str
    coefficients: Array
    centre: Array
    scale: float

    def __call__(self, image: ArrayLike) -> Array:
        """Map image points ``(N, 2)``."""
        points = (as_image(image) - self.centre) / self.scale
        if self.kind == "projective":
            return _project(self.coefficients, points) * self.scale + self.centre
        return np.asarray(_terms(self.kind, points) @ self.coefficients.T * self.scale + self.centre)

    @classmethod
    def fit(cls, kind: str, reference: ArrayLike, moving: ArrayLike) -> Transform:
        """Fit a transformation to tie points ``(N, 2)`` by least squares.

        Raises
        ------
        InputError, TooFewPoints
            If the transformation is unknown, or there are too few points.
        """
        if kind not in TRANSFORMS:
            raise InputError(
                f"{kind!r} is not a transformation", field="transform", remedy=f"use one of {', '.join(TRANSFORMS)}"
            )
        source, target = as_image(reference), as_image(moving)
        if 2 * len(source) < TRANSFORMS[kind]:
            raise TooFewPoints(
                f"{counted(len(source), 'tie point does', 'tie points do')} not determine a {kind} transformation"
            )
        centre = source.mean(axis=0)
        scale = max(float(np.abs(source - centre).max()), 1.0)
        x, y = (source - centre) / scale, (target - centre) / scale
        return cls(kind, _solve(kind, x, y), centre, scale)


@dataclass(frozen=True, eq=False)
class Registration:
    """Registration of one band: tie points, transformation, residuals (moving minus fitted, px)."""

    band: str
    transform: Transform
    reference: Array
    moving: Array
    residuals: Array
    used: NDArray[np.bool_]

    def row(self) -> dict[str, Any]:
        """Return the row of the residual table: root mean squares and largest residual of the used tie points, px."""
        used = self.residuals[self.used]
        col, row = np.sqrt((used**2).mean(axis=0)).tolist()
        return {
            "band": self.band,
            "transform": self.transform.kind,
            "tie_points": len(self.used),
            "used": int(self.used.sum()),
            "rmse_col": col,
            "rmse_row": row,
            "rmse": math.hypot(col, row),
            "largest": float(np.hypot(used[:, 0], used[:, 1]).max()),
        }


def register(
    bands: Sequence[Array],
    names: Sequence[str],
    *,
    reference: int = 0,
    transform: str = "projective",
    patch: int = 64,
    spacing: int | None = None,
) -> tuple[Array, tuple[Registration, ...]]:
    """Align bands of one size with one of them.

    Parameters
    ----------
    bands : sequence of (rows, columns) arrays
    reference : int
        Index of the band that does not change.
    patch, spacing : int
        Side of the correlated patches, and distance of their centres (px).

    Returns
    -------
    stack : ndarray (bands, rows, columns) float64
        NaN where a band has no pixel.
    registrations : tuple of Registration
        One for each band but the reference.

    Raises
    ------
    InputError
        If the sizes differ, or two bands have nothing in common.
    """
    arrays = [np.asarray(band, dtype=np.float64) for band in bands]
    if len(arrays) != len(names) or len({array.shape for array in arrays}) != 1 or arrays[0].ndim != 2:
        raise InputError("bands must be images of one size, each with a name", field="bands")
    fixed = arrays[reference]
    stack, registrations = np.empty((len(arrays), *fixed.shape)), []
    for index, (array, name) in enumerate(zip(arrays, names, strict=True)):
        if index == reference:
            stack[index] = array
            continue
        registration = _register_band(fixed, array, name, transform, patch, spacing or patch)
        stack[index] = resample(array, registration.transform)
        registrations.append(registration)
    return stack, tuple(registrations)


def resample(band: Array, transform: Transform, order: int = 3) -> Array:
    """Return a band on the pixels of the reference, by splines of an order; NaN outside the band."""
    from scipy.ndimage import map_coordinates

    rows, columns = np.indices(band.shape)
    there = transform(np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5) - 0.5
    return map_coordinates(band, there.T[::-1], order=order, cval=np.nan).reshape(band.shape)


def measure(fixed: Array, moving: Array, guess: Any, *, patch: int, spacing: int) -> tuple[Array, Array]:
    """Measure tie points: by phase correlation to a pixel, then by least squares.

    Parameters
    ----------
    guess : callable
        Approximate positions in `moving` of image points ``(N, 2)`` of `fixed`.

    Returns
    -------
    reference, moving : ndarray (N, 2)
        Centres of the patches in both bands, in pixels from the outer corner.
    """
    half = patch // 2
    steps = [np.arange(half + 1, size - half, spacing) for size in fixed.shape]
    centres = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 2)[:, ::-1]
    corners = np.rint(guess(centres.astype(float))).astype(int) - half
    window = np.outer(np.hanning(patch), np.hanning(patch))
    floors = [_CONTRAST * float(band.std()) for band in (fixed, moving)]
    matches = []
    for centre, (left, top) in zip(centres, corners, strict=True):
        if left < 0 or top < 0 or left + patch > moving.shape[1] or top + patch > moving.shape[0]:
            continue
        first = fixed[centre[1] - half : centre[1] + half, centre[0] - half : centre[0] + half]
        second = moving[top : top + patch, left : left + patch]
        if not (first.std() > floors[0] and second.std() > floors[1]):
            continue
        shift, likeness = _shift(first, second, window)
        if np.abs(shift).max() < patch / 4 and likeness > _LIKENESS:
            matches.append((*centre, *(np.array([left, top]) + half + np.rint(shift))))
    table = np.array(matches, dtype=np.float64).reshape(-1, 4)
    return _refined(fixed, moving, table[:, :2], table[:, 2:], half)


def _refined(fixed: Array, moving: Array, reference: Array, there: Array, half: int) -> tuple[Array, Array]:
    """Return tie points that are known to a pixel in `moving`, measured to a fraction of it; a few are dropped."""
    from ortho_pipeline.imaging.matching import least_squares

    # A patch may extend over the edge of the other band.
    rim = half + _REACH
    around = np.pad(moving, rim, constant_values=np.nan)
    chips = [fixed[y - half : y + half, x - half : x + half] for x, y in reference.astype(int)]
    # Moved by `rim`, the window of a place begins at the place itself.
    wide = [around[y : y + 2 * rim, x : x + 2 * rim] for x, y in there.astype(int)]
    if not chips:
        return reference, there
    measured = least_squares.measure(
        np.array(chips, dtype=np.float32), np.array(wide, dtype=np.float32), np.zeros((len(chips), 2))
    )
    good = np.isfinite(measured.shift).all(axis=1)
    return reference[good], (there + measured.shift)[good]


def _register_band(fixed: Array, moving: Array, name: str, transform: str, patch: int, spacing: int) -> Registration:
    coarse, _ = _shift(fixed, moving, np.outer(np.hanning(fixed.shape[0]), np.hanning(fixed.shape[1])))
    fixed, moving = details(fixed), details(moving)
    reference, there = measure(fixed, moving, lambda image: image + coarse, patch=2 * patch, spacing=2 * spacing)
    first, _ = _fit_robust("similarity", reference, there, name)
    for _ in range(2):
        reference, there = measure(fixed, moving, first, patch=patch, spacing=spacing)
        first, used = _fit_robust(transform, reference, there, name)
    return Registration(name, first, reference, there, there - first(reference), used)


def details(band: Array) -> Array:
    """Return the detail smaller than a dozen pixels: broad differences of brightness displace the peak."""
    from scipy.ndimage import gaussian_filter

    return np.asarray(band - gaussian_filter(band, _BROAD), dtype=np.float64)


def _shift(first: Array, second: Array, window: Array) -> tuple[Array, float]:
    """Return the shift (columns, rows) of the content of `first` in `second`, and their correlation."""
    from skimage.registration import phase_cross_correlation

    # Without normalisation, frequencies that have only noise do not count.
    rows_columns, error, _ = phase_cross_correlation(
        (first - first.mean()) * window,
        (second - second.mean()) * window,
        normalization=None,
    )
    likeness = math.sqrt(max(0.0, 1.0 - min(float(error), 1.0) ** 2))
    return -np.asarray(rows_columns, dtype=np.float64)[::-1], likeness


def _fit_robust(kind: str, reference: Array, moving: Array, name: str) -> tuple[Transform, NDArray[np.bool_]]:
    used = np.ones(len(reference), dtype=bool)
    for _ in range(10):
        if 2 * used.sum() < TRANSFORMS[kind] + 4 or used.sum() < 0.3 * len(used):
            raise TooFewPoints(
                f"of {counted(len(used), 'tie point')} of the band {name}, only {int(used.sum())} agree, too few for a "
                "transformation",
                field=name,
                remedy="check that the bands are of one scene, and at least 500 pixels wide and high",
            )
        transform = Transform.fit(kind, reference[used], moving[used])
        miss = np.hypot(*(moving - transform(reference)).T)
        # The median of the length of a two-dimensional error is 1.18 sigma.
        limit = max(_REJECT_FLOOR, _REJECT_SIGMAS * float(np.median(miss[used])) / 1.18)
        keep = miss <= limit
        if np.array_equal(keep, used):
            break
        used = keep
    return transform, used


def _terms(kind: str, points: Array) -> Array:
    x, y = points.T
    one = np.ones_like(x)
    return np.stack([one, x, y] if kind != "poly2" else [one, x, y, x * x, x * y, y * y], axis=1)


def _solve(kind: str, x: Array, y: Array) -> Array:
    if kind == "similarity":
        zero, one = np.zeros(len(x)), np.ones(len(x))
        design = np.vstack(
            [np.stack([one, zero, x[:, 0], -x[:, 1]], axis=1), np.stack([zero, one, x[:, 1], x[:, 0]], axis=1)]
        )
        shift_col, shift_row, cos, sin = np.linalg.lstsq(design, y.T.ravel())[0]
        return np.array([[shift_col, cos, -sin], [shift_row, sin, cos]])
    if kind == "projective":
        return _solve_projective(x, y)
    return np.asarray(np.linalg.lstsq(_terms(kind, x), y)[0].T, dtype=np.float64)


def _solve_projective(x: Array, y: Array) -> Array:
    from scipy.optimize import least_squares

    zero, terms = np.zeros((len(x), 3)), _terms("affine", x)
    design = np.vstack([np.hstack([terms, zero, -x * y[:, :1]]), np.hstack([zero, terms, -x * y[:, 1:]])])
    start = np.linalg.lstsq(design, y.T.ravel())[0]
    # The linear solution weights points by their denominator; minimise image residuals instead.
    return np.asarray(least_squares(lambda p: (_project(p, x) - y).ravel(), start, method="lm").x)


def _project(parameters: Array, points: Array) -> Array:
    terms = _terms("affine", points)
    below = 1.0 + points @ parameters[6:]
    return np.stack([terms @ parameters[:3], terms @ parameters[3:6]], axis=1) / below[:, None]
