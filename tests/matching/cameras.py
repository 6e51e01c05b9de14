"""Cameras of the truth, in plain NumPy: a pushbroom and a frame, straight lines in map coordinates and heights.

They share nothing with the sensor models: the ray of a pixel is written out, and the inverse is Newton's method on it.
Rows run along the flight, columns to the left of it seen from below, so that north up is a flight to the south.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """Straight rays from an altitude (m) through pixels of `gsd` metres about a place (x, y, height) on the map.

    Parameters
    ----------
    heading_deg : float
        Of the rows, from north to the east; 180 is north up.
    off_nadir_deg, pitch_deg : float
        Across and along the flight.
    wobble : (roll, pitch, yaw)
        How much the attitude (radians) changes with the square of the row, at the first and last one; pushbroom only.
    pushbroom : bool
        Each row has a place of its own along the flight; otherwise all have the same perspective centre.
    """

    place: tuple[float, float, float]
    gsd: float
    width: int
    height: int
    altitude: float = 600_000.0
    heading_deg: float = 180.0
    off_nadir_deg: float = 0.0
    pitch_deg: float = 0.0
    wobble: tuple[float, float, float] = (0.0, 0.0, 0.0)
    pushbroom: bool = True

    def ground_at(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Return where the rays of image points ``(..., 2)`` are at heights ``(...)``: map x, y ``(..., 2)``."""
        image = np.asarray(image, dtype=float)
        x, y = self._meet(image[..., 0], image[..., 1], np.asarray(height, dtype=float))
        return np.stack([x, y], axis=-1)

    def meshed(self, columns: Array, rows: Array, height: ArrayLike) -> tuple[Array, Array]:
        """Return the map x and y ``(R, C)`` of a mesh of pixels, at one height or at heights ``(R, C)``."""
        return self._meet(columns[None, :], rows[:, None], np.asarray(height, dtype=float))

    def image_of(self, ground: ArrayLike) -> Array:
        """Return the image points ``(N, 2)`` whose rays go through ground points ``(N, 3)``, to 1e-7 px."""
        ground = np.asarray(ground, dtype=float)
        image = np.tile([self.width / 2, self.height / 2], (len(ground), 1))
        step = np.array([[0.5, 0.0], [0.0, 0.5]])
        for _ in range(12):
            miss = ground[:, :2] - self.ground_at(image, ground[:, 2])
            slopes = np.stack(
                [self.ground_at(image + one, ground[:, 2]) - self.ground_at(image - one, ground[:, 2]) for one in step],
                axis=-1,
            )
            moved = np.linalg.solve(slopes, miss[..., None])[..., 0]
            image = image + moved
            # Map coordinates of thousands of kilometres have a nanometre or two of rounding.
            if np.abs(moved).max(initial=0.0) < 1e-7:
                return image
        raise ArithmeticError("Newton's method does not converge: rays that cross?")

    def _meet(self, column: Array, row: Array, height: Array) -> tuple[Array, Array]:
        heading = np.radians(self.heading_deg)
        forward = np.array([np.sin(heading), np.cos(heading)])
        sideward = np.array([-forward[1], forward[0]])
        part = 2 * (row - self.height / 2) / self.height
        roll, pitch, yaw = (rate * part**2 if self.pushbroom else 0.0 for rate in self.wobble)
        roll, pitch = roll + np.radians(self.off_nadir_deg), pitch + np.radians(self.pitch_deg)
        pixel = self.gsd / self.altitude
        right, ahead = (column - self.width / 2) * pixel, 0.0
        start = self.gsd * (row - self.height / 2)
        if not self.pushbroom:
            start, ahead = 0.0, (row - self.height / 2) * pixel
        # The ray in the camera (right, ahead, -1), turned about the flight (roll), across it (pitch), and the
        # upright (yaw).
        across, down = right * np.cos(roll) + np.sin(roll), np.cos(roll) - right * np.sin(roll)
        along, down = ahead * np.cos(pitch) + down * np.sin(pitch), down * np.cos(pitch) - ahead * np.sin(pitch)
        across, along = across * np.cos(yaw) - along * np.sin(yaw), across * np.sin(yaw) + along * np.cos(yaw)
        # The ray of the middle goes through the place.
        middle = np.radians([self.off_nadir_deg, self.pitch_deg])
        aim = np.array([np.tan(middle[0]) / np.cos(middle[1]), np.tan(middle[1])]) * self.altitude
        far = (self.altitude + self.place[2] - height) / down
        u, v = far * across - aim[0], far * along - aim[1] + start
        x = self.place[0] + u * sideward[0] + v * forward[0]
        y = self.place[1] + u * sideward[1] + v * forward[1]
        return x, y
