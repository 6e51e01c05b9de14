"""Start values of the classical models: normalised to the points, solved where linear in the coefficients."""

from __future__ import annotations

import numpy as np
import pyproj

from ortho_pipeline.errors import TooFewPoints
from ortho_pipeline.geodesy.crs import parse_crs, utm_crs
from ortho_pipeline.geodesy.ellipsoid import enu_from_geodetic
from ortho_pipeline.geodesy.naming import crs_definition
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.families import Family, exponents, family_of
from ortho_pipeline.models.rational import GEOCENTRIC, Rational
from ortho_pipeline.options.texts import counted
from ortho_pipeline.points import Points

#: The domain extends beyond the points by this part of its size.
_MARGIN = 0.02
#: Least range of heights of a domain, as part of its horizontal extent: terrain is never exactly flat.
_LEAST_RELIEF = 1e-3


def model_crs(text: str, points: Points) -> str:
    """Return the ground CRS of a model for ``geocentric``, ``geographic``, ``utm`` or any text of a CRS.

    Raises
    ------
    CrsError
        If the text is not a CRS.
    """
    name = text.strip().lower()
    if name in (GEOCENTRIC, "epsg:4978"):
        return GEOCENTRIC
    if name == "geographic":
        return "EPSG:4979"
    if name == "utm":
        plan = points.to_crs("EPSG:4979").ground[:, :2]
        radians = np.radians(plan[np.isfinite(plan).all(axis=1), 0])
        lon = np.degrees(np.arctan2(np.sin(radians).sum(), np.cos(radians).sum()))
        return crs_definition(utm_crs(float(lon), float(np.nanmean(plan[:, 1]))))
    return crs_definition(parse_crs(text))


def start_model(
    family: str,
    points: Points,
    *,
    crs: str | None = None,
    size: tuple[int, int] | None = None,
    heights: tuple[float, float] | None = None,
) -> Rational:
    """Return a classical model with start values from the control points.

    Parameters
    ----------
    family : str
        A name of `ortho_pipeline.models.families`; ``affine14`` starts with the column as the paper's x.
    points : Points
        Control points give normalisation and start values. The domain includes all points except distant check points.
    crs : str, optional
        As for `model_crs`. Default: the CRS of the points.
    size : (int, int), optional
        Columns and rows of the image, whose corners the domain includes.
    heights : (float, float), optional
        Lowest and highest ellipsoidal height (m) that the domain includes.

    Raises
    ------
    TooFewPoints
        If there are too few control points for the parameters.
    """
    chosen = family_of(family)
    chosen = family_of(chosen.variants[0]) if chosen.variants else chosen
    ground_crs = crs_definition(points.crs) if crs is None else model_crs(crs, points)
    moved = points.to_crs("EPSG:4979" if ground_crs == GEOCENTRIC else ground_crs)
    wraps = bool(moved.crs.is_geographic and np.isclose(moved.crs.axis_info[0].unit_conversion_factor, np.pi / 180))
    ground = _with_heights(moved.ground, chosen, wraps)
    usable = points.control & np.isfinite(ground).all(axis=1)
    if int(usable.sum()) < chosen.minimum_points:
        raise TooFewPoints(
            f"{counted(int(usable.sum()), 'control point does', 'control points do')} not determine the "
            f"{counted(chosen.parameters, 'parameter')} of {family}",
            file=points.source or None,
            remedy=f"give at least {counted(chosen.minimum_points, 'control point')}, or use a simpler model",
        )
    box = _box(ground, points.image, usable, size, heights, moved.crs)
    coordinates = ground[usable]
    if ground_crs == GEOCENTRIC:
        coordinates, _ = enu_from_geodetic(coordinates, box.mean(axis=0))
    ground_offset, ground_scale = _normalisation(coordinates)
    image_offset, image_scale = _normalisation(points.image[usable])
    coefficients = _coefficients(
        chosen, (coordinates - ground_offset) / ground_scale, (points.image[usable] - image_offset) / image_scale
    )
    return Rational(
        chosen.name, ground_crs, coefficients, ground_offset, ground_scale, image_offset, image_scale, box, wraps
    )


def _with_heights(ground: Array, family: Family, wraps: bool) -> Array:
    """Return ground with continuous longitudes and, for models of the plane, without missing heights."""
    ground = ground.copy()
    if wraps and np.isfinite(ground[:, 0]).any() and np.nanmax(ground[:, 0]) - np.nanmin(ground[:, 0]) > 180:
        ground[ground[:, 0] < 0, 0] += 360.0
    if family.dimensions == 2:
        known = np.isfinite(ground[:, 2])
        ground[~known, 2] = ground[known, 2].mean() if known.any() else 0.0
    return ground


def _normalisation(values: Array) -> tuple[Array, Array]:
    low, high = values.min(axis=0), values.max(axis=0)
    scale = (high - low) / 2
    # A coordinate that is the same for all points (up to rounding) must become zero, not noise.
    scale[scale <= 1e-12 * np.abs(values).max(axis=0)] = 1.0
    return (low + high) / 2, scale


def _box(
    ground: Array,
    image: Array,
    usable: np.ndarray,
    size: tuple[int, int] | None,
    heights: tuple[float, float] | None,
    crs: pyproj.CRS,
) -> Array:
    """Return minimum and maximum ``(2, 3)`` of the points, the image's corners and the heights.

    A check point far outside control points and corners is a mistake, and not included.
    """
    reached = [ground[usable]]
    if size is not None:
        corners = np.array([(0, 0), (size[0], 0), (size[0], size[1]), (0, size[1])], dtype=float)
        middle = image[usable].mean(axis=0)
        design = np.column_stack([np.ones(int(usable.sum())), image[usable] - middle])
        plane = np.linalg.lstsq(design, ground[usable], rcond=1e-6)[0]
        seen = np.column_stack([np.ones(4), corners - middle]) @ plane
        seen[:, 2] = ground[usable, 2].mean()
        reached.append(seen)
    everything = np.concatenate(reached)
    near = np.isfinite(ground).all(axis=1)
    if size is not None:
        low, high = everything[:, :2].min(axis=0), everything[:, :2].max(axis=0)
        near &= (np.abs(ground[:, :2] - (low + high) / 2) <= 1.5 * (high - low)).all(axis=1)
    everything = np.concatenate([everything, ground[near]])
    if heights is not None:
        extremes = np.tile(everything[:1], (2, 1))
        extremes[:, 2] = heights
        everything = np.concatenate([everything, extremes])
    low, high = everything.min(axis=0), everything.max(axis=0)
    half = (1 + _MARGIN) * (high - low) / 2
    metres = np.abs(half[:2]).max() * (111_000.0 if crs.is_geographic else crs.axis_info[0].unit_conversion_factor)
    half[:2] = np.maximum(half[:2], 1e-3 * half[:2].max() or 1e-9)
    half[2] = max(half[2], _LEAST_RELIEF * metres, 1.0)
    middle = (low + high) / 2
    return np.stack([middle - half, middle + half])


def _coefficients(family: Family, ground: Array, image: Array) -> Array:
    """Return start coefficients for normalised points: the algebraic solution, or the numerators alone.

    Multiplied by its denominator, a model is linear in all coefficients. With many of them this is nearly singular, so
    such families start with denominators of one. Numerators must not be zero then, because the design would lose the
    columns of the denominators.
    """
    col, row, den = (_values(terms, ground) for terms in (family.col, family.row, family.den))
    numerators = col.shape[1] + row.shape[1]
    design = np.zeros((len(ground), 2, numerators + den.shape[1]))
    design[:, 0, : col.shape[1]], design[:, 1, col.shape[1] : numerators] = col, row
    design[:, :, numerators:] = -image[:, :, None] * den[:, None, :]
    if family.den and not family.regularised:
        solved = np.linalg.lstsq(design.reshape(2 * len(ground), -1), image.ravel(), rcond=1e-8)[0]
        denominators = 1.0 + den @ solved[numerators:]
        if ((denominators > 0.2) & (denominators < 5)).all():
            return np.asarray(solved, dtype=np.float64)
    coefficients = np.zeros(family.parameters)
    coefficients[: col.shape[1]] = np.linalg.lstsq(col, image[:, 0], rcond=1e-10)[0]
    coefficients[col.shape[1] : numerators] = np.linalg.lstsq(row, image[:, 1], rcond=1e-10)[0]
    return coefficients


def _values(terms: tuple[str, ...], ground: Array) -> Array:
    """Return the values of terms ``(N, T)`` at normalised points."""
    if not terms:
        return np.zeros((len(ground), 0))
    return np.stack([(ground ** exponents(term)).prod(axis=1) for term in terms], axis=1)
