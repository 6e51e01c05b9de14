r"""How places of an ortho are seen: their image points, and how these move with the place and with its height.

With :math:`A = \partial(\mathrm{image}) / \partial(e, n)` in pixels per metre on the map and :math:`b =
\partial(\mathrm{image}) / \partial h`, an image point that is off by :math:`\delta` shows ground that is off by
:math:`A^{-1} \delta` at the same height, and ground that is a metre higher than it was taken for by :math:`A^{-1} b`:
the relief displacement. Its negative is where the ray goes per metre upwards, so its length is the tangent of the angle
between ray and vertical.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.ellipsoid import units_per_metre
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster.source import Grid

#: Half of the distance over which differences are taken: image pixels' worth of places, metres of height.
_HALF_PIXEL, _HALF_METRE = 0.5, 0.5


@dataclass(frozen=True)
class Seen:
    """Places as they are seen; NaN where the model does not project.

    Parameters
    ----------
    ground : (n, 3)
        In the CRS of the model.
    image : (n, 2)
        Column, row.
    ground_per_pixel : (n, 2, 2)
        Metres east and north on the map (rows) per pixel of column and row, at constant height.
    displacement : (n, 2)
        Metres east and north by which ground appears displaced per metre that it lies higher than it is taken for.
    """

    ground: Array
    image: Array
    ground_per_pixel: Array
    displacement: Array


class Sight:
    """The exact geometry between an output grid and an image; safe to use from several threads."""

    def __init__(self, model: SensorModel, grid: Grid) -> None:
        self.model, self.grid = model, grid
        self._to_model = ground_transform(grid.crs, model.crs)

    def on(self, grid: Grid) -> Sight:
        """Return the same for another grid in the same CRS."""
        other = copy.copy(self)
        other.grid = grid
        return other

    def ground(self, columns: Array, rows: Array, heights: Array) -> Array:
        """Return ground ``(n, 3)`` in the model's CRS at output positions (corner convention) and heights (m)."""
        x, y = self.grid.xy(columns, rows)
        return self._to_model(np.stack([x, y, heights], axis=1))

    def image(self, columns: Array, rows: Array, heights: Array) -> Array:
        """Return the image points ``(n, 2)`` of output positions at heights."""
        return self.model.ground_to_image(self.ground(columns, rows, heights))

    def metres(self, columns: Array, rows: Array) -> Array:
        """Return width and height ``(n, 2)`` of an output pixel in metres."""
        x, y = self.grid.xy(columns, rows)
        units = units_per_metre(self.grid.crs, np.stack([x, y, np.zeros(len(x))], axis=1))[:, :2]
        return np.array([self.grid.dx, self.grid.dy]) / units

    def seen(self, columns: Array, rows: Array, heights: Array) -> Seen:
        """Return how output positions ``(n,)`` are seen at their heights."""
        metres, half = self.metres(columns, rows), _HALF_PIXEL
        # All places in one call: for a few nodes calls cost more than what they compute.
        steps = np.array([(0, 0, 0), (half, 0, 0), (-half, 0, 0), (0, half, 0), (0, -half, 0), (0, 0, _HALF_METRE),
                          (0, 0, -_HALF_METRE)])  # fmt: skip
        at = [(part + step[:, None]).ravel() for part, step in zip((columns, rows, heights), steps.T, strict=True)]
        ground = self.ground(*at).reshape(len(steps), -1, 3)
        image = self.model.ground_to_image(ground.reshape(-1, 3)).reshape(len(steps), -1, 2)
        east, south, up = image[1] - image[2], image[3] - image[4], image[5] - image[6]
        along = np.stack([east / (2 * half * metres[:, :1]), -south / (2 * half * metres[:, 1:])], axis=2)
        inverse = _inverse(along)
        displacement = np.einsum("nij,nj->ni", inverse, up / (2 * _HALF_METRE))
        return Seen(ground[0], image[0], inverse, displacement)


def _inverse(matrix: Array) -> Array:
    """Return the inverses of matrices ``(n, 2, 2)``; not finite where there is none."""
    adjugate = np.stack(
        [np.stack([matrix[:, 1, 1], -matrix[:, 0, 1]], axis=1), np.stack([-matrix[:, 1, 0], matrix[:, 0, 0]], axis=1)],
        axis=1,
    )
    determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(adjugate / determinant[:, None, None])
