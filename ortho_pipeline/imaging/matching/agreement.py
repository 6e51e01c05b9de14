"""Affine corrections of a search: how to combine them, and which one the chips agree on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array


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
