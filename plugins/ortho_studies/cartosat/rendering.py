"""Images of the simulated ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_studies.cartosat.truth import GSD_ALONG, PLANE, SIZE, Array, CartosatPass, HobartTerrain
from ortho_studies.simulation.waves import texture


def brightness(lon: ArrayLike, lat: ArrayLike, *, finest: float) -> Array:
    """Return the brightness ``(N,)`` in 0…1 of the ground; `finest` (m) is the shortest wavelength there is."""
    east, north = PLANE.metres(lon, lat)
    lengths = np.geomspace(finest, 60 * finest, 48)
    angles, phases = np.random.default_rng(17).uniform(0, 2 * np.pi, (2, len(lengths)))
    value = texture(east, north, lengths, angles, phases)
    return np.clip(0.45 + 0.12 * value / np.sqrt(len(lengths) / 2), 0.0, 1.0)


def render(camera: CartosatPass, hills: HobartTerrain, *, noise_dn: float = 3.0, seed: int = 0) -> NDArray[np.uint16]:
    """Make the 10-bit image that a camera takes: every pixel's own ray is followed to the hills."""
    pixels = np.empty((camera.size, camera.size), dtype=np.uint16)
    finest = 4.5 * GSD_ALONG * SIZE / camera.size
    columns = np.arange(camera.size) + 0.5
    random = np.random.default_rng(seed)
    block = max(1, 100_000 // camera.size)
    for first in range(0, camera.size, block):
        rows = np.arange(first, min(first + block, camera.size)) + 0.5
        image = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        ground = camera.meet(image, hills, tolerance=0.1)
        values = 40.0 + 900.0 * brightness(ground[:, 0], ground[:, 1], finest=finest)
        values += random.normal(0.0, noise_dn, values.shape)
        pixels[first : first + block] = np.clip(np.rint(values), 1, 1023).reshape(len(rows), -1)
    return pixels
