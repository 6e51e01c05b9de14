"""Affine corrections of a search: how to combine them, which one the chips agree on, and whether by accident."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtrc

from ortho_pipeline.display.numbers import significant, size_m
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.imaging.matching.targets import Target
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array

#: Radius (chip px) of the searches after the first.
NEXT = 4
#: Significance level of agreement over chance.
ACCIDENT = 1e-6

#: A chip fits only one of two positions if its correlation there is at least the first number, and less than half of it
#: at the other. If the second part of all chips do, and each position has the third part of them, at least the fourth
#: number, the target is inconsistent: parts of it are displaced.
_FITS, _DIVIDED, _PART, FEWEST_PART = 0.15, 0.75, 0.1, 4
#: Displacements are told as one length if nine of ten are less than so many times those of one of ten.
_ALIKE = 1.5


def agreed(
    correction: ImageCorrection, centres: Array, offsets: Array, score: Array, tolerance: float
) -> tuple[ImageCorrection, NDArray[np.bool_]]:
    """Return a better correction, fitted to most of the offsets ``(n, 2)`` (px), and which of them agree with it.

    A chip at p shows the ground that the model projects to p + offset, so the correction subtracts the offset.
    """
    middle = np.median(offsets, axis=0)
    agreeing = np.hypot(*(offsets - middle).T) <= 3 * tolerance
    origin = np.array(correction.origin)
    design = np.column_stack([np.ones(len(centres)), centres - origin])
    # Three numbers per axis need many chips all over the scene; with few, only the mean is used.
    slopes = agreeing.sum() >= 12 and np.ptp(centres[agreeing], axis=0).min() > 0
    design = design if slopes else design[:, :1]
    fitted = np.broadcast_to(middle, offsets.shape)
    coefficients = np.zeros((design.shape[1], 2))
    coefficients[0] = middle
    for _ in range(10):
        if agreeing.sum() < design.shape[1] + 1:
            break
        weight = np.sqrt(np.maximum(score[agreeing], 0.0))[:, None]
        coefficients = np.linalg.lstsq(weight * design[agreeing], weight * offsets[agreeing], rcond=None)[0]
        fitted = design @ coefficients
        again = np.hypot(*(offsets - fitted).T) <= tolerance
        if (again == agreeing).all():
            break
        agreeing = again
    agreeing = np.hypot(*(offsets - fitted).T) <= tolerance
    # corrected(p) = p - offset(p), after the existing correction.
    step = np.zeros(6)
    step[[0, 3]] = -coefficients[0]
    if slopes:
        step[1:3], step[4:6] = -coefficients[1:, 0], -coefficients[1:, 1]
    return followed_by(correction, step), agreeing


def affine_step(matrix: Array, shift: Array) -> Array:
    """Return the coefficients of an affine correction about an origin."""
    slopes = matrix - np.eye(2)
    return np.array([shift[0], *slopes[0], shift[1], *slopes[1]])


def shifted(correction: ImageCorrection, shift: Array) -> ImageCorrection:
    """Return a correction followed by a shift (px)."""
    return followed_by(correction, affine_step(np.eye(2), shift))


def followed_by(correction: ImageCorrection, step: Array) -> ImageCorrection:
    """Return a correction followed by a second one, with the coefficients `step` about the same origin."""
    second = np.eye(2) + step[[1, 2, 4, 5]].reshape(2, 2)
    matrix = second @ correction.matrix
    shift = second @ correction.coefficients[[0, 3]] + step[[0, 3]]
    slopes = (matrix - np.eye(2)).ravel()
    coefficients = np.array([shift[0], slopes[0], slopes[1], shift[1], slopes[2], slopes[3]])
    return ImageCorrection(correction.model, "affine", correction.origin, coefficients)


def divided_between(
    best: Mapping[tuple[float, ...], float], other: Mapping[tuple[float, ...], float], far: float
) -> str:
    """Return how two positions, `far` (m) apart, divide the chips, by the correlations of each chip at both.

    Returns
    -------
    str
        Empty if they do not, as on repetitive ground, where chips fit both.
    """
    centres = np.array([centre for centre in best if centre in other]).reshape(-1, 2)
    both = np.array([(best[tuple(c)], other[tuple(c)]) for c in centres.tolist()]).reshape(-1, 2)
    fits = (both.max(axis=1) > _FITS) & (both.min(axis=1) < both.max(axis=1) / 2)
    second = fits & (both[:, 1] > both[:, 0])
    first = fits & ~second
    if fits.sum() < _DIVIDED * len(both) or min(first.sum(), second.sum()) < least_part(len(both)):
        return ""
    return said_of_parts(centres[first], centres[second], np.array([far]))


def least_part(chips: int) -> float:
    """Return how many of some chips are a part of the scene."""
    return max(FEWEST_PART, _PART * chips)


def said_of_parts(first: Array, second: Array, far: Array) -> str:
    """Return in words that chips with the centres `second` match `far` ``(n,)`` m from the position of the first."""
    apart = second.mean(axis=0) - first.mean(axis=0)
    axis = int(np.abs(apart).argmax())
    side = (("left", "right"), ("upper", "lower"))[axis][int(apart[axis] > 0)]
    least, most = np.quantile(far, [0.1, 0.9])
    length = size_m(float(np.median(far))) if most < _ALIKE * least else f"{significant(least)} to {size_m(most)}"
    return (
        f"{counted(len(first), 'chip matches', 'chips match')} at one position; "
        f"{counted(len(second), 'chip matches', 'chips match')} {length} from there, "
        f"mostly in the {side} part of the image"
    )


def by_chance(agreeing: int | NDArray[np.int_], chips: int, tolerance: float | Array, radius: float | Array) -> Array:
    """Return the probability that so many chips, searched within a radius, agree by chance at one position."""
    chance = np.minimum(1.0, math.pi * tolerance**2 / (2 * radius + 1) ** 2)
    return np.asarray(bdtrc(np.maximum(np.asarray(agreeing) - 1, 0), chips, chance))


def refuse_accident(
    agreeing: int, chips: int, tolerance: float, places: float, targets: Sequence[Target], reach: float
) -> None:
    """Raise an error if as many chips could agree by chance.

    Parameters
    ----------
    tolerance : float
        Distance (chip px) within which chips agree, in searches with the radius `NEXT`.
    places : float
        Number of other corrections that could have been the result.

    Raises
    ------
    InputError
        If the probability is more than one in a million.
    """
    if by_chance(agreeing, chips, tolerance, NEXT) * places > ACCIDENT:
        raise InputError(
            f"cannot match the scene with {targets[0].called}: only {agreeing} of {counted(chips, 'chip')} agree "
            f"within {reach:.0f} px, which can be chance",
            file=targets[0].path,
            field=targets[0].field,
            remedy=Text(
                f"check that {targets[0].called} shows this place. If the model may be farther off, search farther (",
                Setting("match.search"),
                "); if it may be rotated, add ",
                Setting("match.search_rotation", "5"),
                ". Else measure points by hand",
            ),
        )
