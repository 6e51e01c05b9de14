"""Correlation of chips by structure: the position of a scene's chip in a larger chip of a target.

Images of different seasons, bands or sensors have common edges, but different intensities. So chips are compared by the
*orientation* of their gradients. The doubled angle is independent of inverted contrast, and the length saturates, so a
bright roof does not outvote a field. A fast Fourier transform compares all shifts at once, normalised by the valid
parts of both chips at each shift.

Source: Fitch et al. 2002, Orientation correlation; Fookes and others on doubled angles; Padfield 2012, Masked object
registration in the Fourier domain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from ortho_pipeline.models.base import Array

Field = NDArray[np.complex64]
#: Standard deviation (chip px) of the blur before gradients.
_BLUR = 0.7
#: A gradient of this part of the usual one has half the largest weight.
_SOFT = 0.5
#: Least part of a chip's structure that must overlap.
_LEAST_OVERLAP = 0.4


def orientation(chips: NDArray[np.float32]) -> Field:
    """Return the doubled gradient orientation ``(n, h, w)`` of chips, with length 0 to 1; 0 where unknown."""
    valid = np.isfinite(chips)
    filled = np.where(valid, chips, 0.0).astype(np.float32)
    weight = valid.astype(np.float32)
    blurred = ndimage.gaussian_filter(filled, (0, _BLUR, _BLUR), mode="nearest", truncate=3.0)
    weight = ndimage.gaussian_filter(weight, (0, _BLUR, _BLUR), mode="nearest", truncate=3.0)
    known = weight > 0.999
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = np.where(known, blurred, 0.0)
    gradient = np.zeros(chips.shape, dtype=np.complex64)
    gradient[:, 1:-1, 1:-1] = (smooth[:, 1:-1, 2:] - smooth[:, 1:-1, :-2]) + 1j * (
        smooth[:, 2:, 1:-1] - smooth[:, :-2, 1:-1]
    )
    inner = np.zeros(chips.shape, dtype=bool)
    inner[:, 1:-1, 1:-1] = (
        known[:, 1:-1, 1:-1] & known[:, 1:-1, 2:] & known[:, 1:-1, :-2] & known[:, 2:, 1:-1] & known[:, :-2, 1:-1]
    )
    gradient[~inner] = 0.0
    squared = gradient.real**2 + gradient.imag**2
    # The usual gradient of each chip itself, because haze and shadows change contrast from place to place.
    usual = squared.sum(axis=(1, 2)) / np.maximum(inner.sum(axis=(1, 2)), 1)
    floor = (_SOFT**2 * usual + 1e-12)[:, None, None].astype(np.float32)
    return np.asarray(gradient**2 / (squared + floor), dtype=np.complex64)


def surfaces(scene: Field, target: Field) -> NDArray[np.float32]:
    """Return the correlation ``(n, 2r + 1, 2r + 1)`` of chips ``(n, s, s)`` with targets ``(n, s + 2r, s + 2r)``.

    The value at row i and column j belongs to the shift (j - r, i - r). It is -1 to 1, and 0 if too little is valid.
    """
    size, large = scene.shape[1], target.shape[1]
    shape = (fft.next_fast_len(large), fft.next_fast_len(large))
    shifts = large - size + 1

    def transformed(values: NDArray[Any]) -> NDArray[np.complex64]:
        return np.asarray(fft.fft2(values, shape, axes=(1, 2)))

    def correlated(first: NDArray[np.complex64], second: NDArray[np.complex64]) -> NDArray[np.float32]:
        return np.asarray(fft.ifft2(np.conj(first) * second, axes=(1, 2)).real[:, :shifts, :shifts], dtype=np.float32)

    cross = correlated(transformed(scene), transformed(target))
    energy = [(field.real**2 + field.imag**2).astype(np.float32) for field in (scene, target)]
    known = [(field != 0).astype(np.float32) for field in (scene, target)]
    of_scene = correlated(transformed(energy[0]), transformed(known[1]))
    of_target = correlated(transformed(known[0]), transformed(energy[1]))
    total = energy[0].sum(axis=(1, 2))[:, None, None]
    enough = (of_scene > _LEAST_OVERLAP * total) & (total > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        value = cross / np.sqrt(np.maximum(of_scene, 1e-6) * np.maximum(of_target, 1e-6))
    return np.where(enough, value, 0.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Peaks:
    """The peak of each correlation surface.

    Parameters
    ----------
    shift : (n, 2)
        Column and row (chip px), from a parabola through the neighbours.
    score : (n,)
        The correlation there.
    ratio : (n,)
        The second peak over the first; near 1 the peak is not unique.
    inside : (n,)
        Whether the peak is inside the surface and not on its edge.
    """

    shift: Array
    score: Array
    ratio: Array
    inside: NDArray[np.bool_]


def peaks(surface: NDArray[np.float32], apart: int = 3) -> Peaks:
    """Find the peaks of correlation surfaces ``(n, k, k)``.

    Parameters
    ----------
    apart : int
        A second peak is at least this far (chip px) from the first in column or row.
    """
    count, rows, columns = surface.shape
    flat = surface.reshape(count, -1)
    best = flat.argmax(axis=1)
    row, column = best // columns, best % columns
    every = np.arange(count)
    score = flat[every, best].astype(float)
    inside = (row > 0) & (row < rows - 1) & (column > 0) & (column < columns - 1)
    i, j = np.clip(row, 1, rows - 2), np.clip(column, 1, columns - 2)
    here = surface[every, i, j].astype(float)
    shift = np.stack(
        [
            j + _vertex(surface[every, i, j - 1], here, surface[every, i, j + 1]) - (columns - 1) / 2,
            i + _vertex(surface[every, i - 1, j], here, surface[every, i + 1, j]) - (rows - 1) / 2,
        ],
        axis=1,
    )
    near = (np.abs(np.arange(rows)[None, :, None] - row[:, None, None]) <= apart) & (
        np.abs(np.arange(columns)[None, None, :] - column[:, None, None]) <= apart
    )
    second = np.where(near, -1.0, surface).reshape(count, -1).max(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(score > 0, np.maximum(second, 0.0) / score, 1.0)
    return Peaks(shift, score, ratio, inside)


def _vertex(before: Array, here: Array, after: Array) -> Array:
    """Return the position, -1/2 to 1/2, of the maximum of a parabola through three values."""
    bend = before + after - 2 * here
    with np.errstate(invalid="ignore", divide="ignore"):
        place = 0.5 * (before - after) / bend
    return np.where(bend < 0, np.clip(place, -0.5, 0.5), 0.0)
