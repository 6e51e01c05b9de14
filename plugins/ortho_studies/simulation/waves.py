"""Sums of random waves: hills and textures as closed functions of the position, the same on every machine.

The terms are added in a fixed order, so that simulated scenes stay the same to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_studies.simulation.earth import EARTH_A

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LocalPlane:
    """A plane of metres about a place, by plate carree on a sphere: for terrain and noise, not for cameras.

    Parameters
    ----------
    lon, lat : float
        The place, degrees.
    """

    lon: float
    lat: float

    def metres(self, lon: ArrayLike, lat: ArrayLike) -> tuple[Array, Array]:
        """Return metres east and north ``(N,)`` of geographic coordinates in degrees."""
        metre = np.pi / 180 * EARTH_A
        east = (np.asarray(lon, dtype=np.float64) - self.lon) * metre * np.cos(np.radians(self.lat))
        return east, (np.asarray(lat, dtype=np.float64) - self.lat) * metre

    def moved(self, ground: Array, metres: Array) -> Array:
        """Return ground points lon, lat (degrees), height moved by metres east, north, up, all ``(N, 3)``."""
        metre = 180 / np.pi / EARTH_A
        return np.asarray(ground + metres * (metre / np.cos(np.radians(self.lat)), metre, 1.0))


@dataclass(frozen=True, eq=False)
class Waves:
    """Waves across the plane whose amplitude falls with their wavelength; their sum has the variance one.

    Parameters
    ----------
    terms : (M, 4)
        Wave numbers to the east and north (rad/m), phase and amplitude of each.
    """

    terms: Array

    @classmethod
    def drawn(cls, seed: int, longest: float, shortest: float, count: int, *, power: float = 1.1) -> Self:
        """Draw directions and phases of waves between two lengths (m), with amplitudes by a power of the length."""
        random = np.random.default_rng(seed)
        lengths = np.geomspace(longest, shortest, count)
        angles, phases = random.uniform(0, 2 * np.pi, (2, count))
        amplitudes = lengths**power
        amplitudes *= np.sqrt(2 / (amplitudes**2).sum())
        k = 2 * np.pi / lengths
        return cls(np.stack([k * np.cos(angles), k * np.sin(angles), phases, amplitudes], axis=1))

    def __call__(self, east: Array, north: Array) -> Array:
        """Return the sum ``(N,)`` at places in metres."""
        total = np.zeros_like(east)
        for kx, ky, phase, amplitude in self.terms:
            total += amplitude * np.sin(kx * east + ky * north + phase)
        return total


def texture(east: Array, north: Array, lengths: Array, angles: Array, phases: Array) -> Array:
    """Return the sum ``(N,)`` of waves of amplitude one with these lengths (m), directions and phases (rad)."""
    total = np.zeros_like(east)
    for length, angle, phase in zip(lengths, angles, phases, strict=True):
        total += np.sin(2 * np.pi / length * (np.cos(angle) * east + np.sin(angle) * north) + phase)
    return total
