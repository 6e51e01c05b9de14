"""Images of the simulated ground."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_studies.ikonos.truth import BRIGHT, DARK, FINEST, OWN, PLANE, Array, GeoScene
from ortho_studies.simulation.waves import texture


def brightness(lon: ArrayLike, lat: ArrayLike, band: str = "pan", *, finest: float = 4.5) -> Array:
    """Return the brightness ``(N,)`` in 0…1 of the ground in a band: city blocks and a texture of waves.

    `finest` is the shortest wavelength (m) there is: some pixels, so that an image is not aliased. What is longer is
    the same at all sizes of pixel, so that pan and multispectral bands, and crops, fit upon each other.
    """
    east, north = PLANE.metres(lon, lat)
    own = OWN[band]
    blocks = (1 - own) * _blocks(east, north, 21, finest) + own * _blocks(
        east, north, 22 + list(OWN).index(band), finest
    )
    lengths = np.geomspace(4.5, 3000.0, 96)
    angles, phases = np.random.default_rng(20).uniform(0, 2 * np.pi, (len(lengths), 2)).T
    kept = lengths >= finest
    waves = texture(east, north, lengths[kept], angles[kept], phases[kept])
    return np.clip(0.22 + 0.36 * blocks + 0.022 * waves, 0.0, 1.0)


def _blocks(east: Array, north: Array, salt: int, finest: float, side: float = 110.0) -> Array:
    """Return tones in 0…1 of square blocks, whose edges are as soft as the finest wavelength."""
    tones = np.random.default_rng(salt).random((256, 256))
    i, j = np.floor(east / side).astype(int), np.floor(north / side).astype(int)
    soft = min(1.0, finest / side)
    # Flat up to the last part of a block, then smoothly to the next.
    u, v = (np.clip(1 + (part - 1) / soft, 0.0, 1.0) for part in (east / side - i, north / side - j))
    u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)

    def tone(di: int, dj: int) -> Array:
        return np.asarray(tones[(i + di) % 256, (j + dj) % 256], dtype=np.float64)

    return (1 - v) * ((1 - u) * tone(0, 0) + u * tone(1, 0)) + v * ((1 - u) * tone(0, 1) + u * tone(1, 1))


def render(scene: GeoScene, band: str = "pan", *, noise_dn: float = 3.0, seed: int = 0) -> NDArray[np.uint16]:
    """Make the 11-bit image ``(rows, columns)`` of a band: every pixel's own ray is followed to the ground."""
    values = np.empty((scene.rows, scene.columns))
    columns = np.arange(scene.columns) + 0.5
    block = max(1, 100_000 // scene.columns)
    for first in range(0, scene.rows, block):
        rows = np.arange(first, min(first + block, scene.rows)) + 0.5
        image = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        ground = scene.meet(image, tolerance=0.02 * scene.pixel)
        tones = brightness(ground[:, 0], ground[:, 1], band, finest=FINEST * scene.pixel)
        values[first : first + block] = tones.reshape(len(rows), -1)
    noise = np.random.default_rng(seed).normal(0.0, noise_dn, values.shape)
    return np.clip(np.rint(DARK + BRIGHT * values + noise), 1, 2047).astype(np.uint16)
