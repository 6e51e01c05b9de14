"""Images of the simulated ground: staggered lines without TDI."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_studies.orbview3.truth import ALTITUDE, PIXEL, PLANE, Array, Coast, TurningScanner

#: Width of a pixel in distances of neighbouring ones, for the two CCD lines are staggered by half a pixel.
STAGGERED = 2
#: Strength of the edge enhancement of a delivered image.
ENHANCEMENT = 1.5
_PARCEL = 24.0


def brightness(lon: ArrayLike, lat: ArrayLike, coast: Coast, pixel: float = PIXEL) -> Array:
    """Return the brightness ``(N,)`` in 0…1 of the ground: dark sea, and parcels of different tones with sharp edges.

    `pixel` (m) says how large the parcels are, some 24 pixels.
    """
    east, north = PLANE.metres(lon, lat)
    value = np.full(east.shape, 0.35)
    for turn, size, share in ((0.31, 1.0, 0.28), (1.02, 2.7, 0.2), (0.77, 9.0, 0.12)):
        along, across = np.cos(turn) * east + np.sin(turn) * north, np.cos(turn) * north - np.sin(turn) * east
        side = _PARCEL * pixel * size
        value += share * (_tone(np.floor(along / side), np.floor(across / (0.7 * side))) - 0.5)
    return np.where(coast.inland(east, north) < 0.0, 0.06, np.clip(value, 0.02, 1.0))


def _tone(i: Array, j: Array) -> Array:
    """Return a fixed number in 0…1 for each pair of whole numbers, the same on every machine."""
    mixed = (i.astype(np.int64) * 73_856_093) ^ (j.astype(np.int64) * 19_349_663)
    mixed = (mixed ^ (mixed >> 13)) * 1_274_126_177
    return np.asarray(((mixed ^ (mixed >> 16)) & 1023) / 1023.0)


def expose(fine: Array, oversampling: int, *, enhancement: float = ENHANCEMENT) -> Array:
    """Return what the staggered lines without TDI see of a brightness that is given at `oversampling` times the pixels.

    A pixel is as wide as two of the image; along the scan the ground moves on by as much again while it is exposed.
    What is delivered has its edges enhanced: it is sharpened by the difference to the mean of 3 x 3 pixels.

    Parameters
    ----------
    fine : (H * oversampling, W * oversampling)
    """
    width = STAGGERED * oversampling
    aperture = np.full(width, 1.0 / width)
    motion = np.full(width + 1, 1.0 / width)
    motion[[0, -1]] /= 2
    seen = _filtered(_filtered(fine, aperture, 1, oversampling), np.convolve(aperture, motion), 0, oversampling)
    if not enhancement:
        return seen
    third = np.full(3, 1 / 3)
    return np.asarray(seen + enhancement * (seen - _filtered(_filtered(seen, third, 0, 1), third, 1, 1)))


def _filtered(values: Array, kernel: Array, axis: int, step: int) -> Array:
    """Convolve along an axis, mirrored at the rim, and keep the values in the middle of each `step`."""
    moved = np.moveaxis(values, axis, -1)
    before = (len(kernel) - step) // 2
    padded = np.pad(moved, [(0, 0), (before, len(kernel) - before)], mode="symmetric")
    count = moved.shape[-1] // step
    total = sum(weight * padded[:, k : k + count * step : step] for k, weight in enumerate(kernel))
    return np.moveaxis(np.asarray(total), -1, axis)


def render(
    camera: TurningScanner, coast: Coast, *, noise_dn: float = 6.0, enhancement: float = ENHANCEMENT, seed: int = 0
) -> NDArray[np.uint16]:
    """Make the 11-bit image that a camera takes: the rays of the pixels' corners are followed to the ground."""
    oversampling, pixel = 2, float(camera.pixel_tan * ALTITUDE)
    fine = np.empty((camera.height * oversampling, camera.width * oversampling))
    inner = (np.arange(oversampling) + 0.5) / oversampling
    block = max(1, 200_000 // camera.width)
    for first in range(0, camera.height, block):
        last = min(first + block, camera.height)
        corners = np.stack(np.meshgrid(np.arange(camera.width + 1.0), np.arange(first, last + 1.0)), axis=-1)
        seen = camera.meet(corners.reshape(-1, 2), coast, tolerance=0.1).reshape(*corners.shape[:2], 3)
        rows = (seen[:-1, None] * (1 - inner)[:, None, None] + seen[1:, None] * inner[:, None, None]).reshape(
            -1, camera.width + 1, 3
        )
        both = rows[:, :-1, None] * (1 - inner)[:, None] + rows[:, 1:, None] * inner[:, None]
        lon, lat = both[..., 0].ravel(), both[..., 1].ravel()
        fine[first * oversampling : last * oversampling] = brightness(lon, lat, coast, pixel).reshape(len(rows), -1)
    seen = expose(fine, oversampling, enhancement=enhancement)
    noise = np.random.default_rng([seed, 5]).normal(0.0, noise_dn, seen.shape)
    return np.clip(np.rint(60.0 + 1700.0 * seen + noise), 1, 2047).astype(np.uint16)
