r"""Viewing geometry of positions of an ortho: image points, and their derivatives by position and height.

With :math:`A = \partial(\mathrm{image}) / \partial(\mathrm{place})` in image pixels per pixel of the output and
:math:`b = \partial(\mathrm{image}) / \partial h`, an image point that is off by :math:`\delta` shows a place that is
off by :math:`A^{-1} \delta` at the same height, and ground that is a metre higher than it was taken for by
:math:`A^{-1} b`: the relief displacement. Its negative is where the ray goes per metre upwards.

Both are in output pixels, which the scale of a map and its convergence do not touch. `metres` turns them into metres
true east and north on the ground: there the length of the displacement is the tangent of the angle between ray and
vertical.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.geodesy.distortion import east_north_from_map, inverse_2x2
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
    place_per_pixel : (n, 2, 2)
        Output pixels, columns and rows (rows of the matrix), per image pixel of column and row, at constant height.
    displacement : (n, 2)
        Output pixels by which ground appears displaced per metre that it lies higher than it is taken for.
    """

    ground: Array
    image: Array
    place_per_pixel: Array
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

    def metres(self, columns: Array, rows: Array, heights: Array) -> Array:
        """Return metres true east and north (rows) per output pixel of column and row ``(n, 2, 2)``, on the ground."""
        x, y = self.grid.xy(columns, rows)
        return east_north_from_map(self.grid.crs, np.stack([x, y, heights], axis=1)) * [self.grid.dx, -self.grid.dy]

    def seen(self, columns: Array, rows: Array, heights: Array) -> Seen:
        """Return how output positions ``(n,)`` are seen at their heights."""
        half = _HALF_PIXEL
        # All places in one call: for a few nodes calls cost more than what they compute.
        steps = np.array(
            [
                (0, 0, 0),
                (half, 0, 0),
                (-half, 0, 0),
                (0, half, 0),
                (0, -half, 0),
                (0, 0, _HALF_METRE),
                (0, 0, -_HALF_METRE),
            ]
        )
        at = [(part + step[:, None]).ravel() for part, step in zip((columns, rows, heights), steps.T, strict=True)]
        ground = self.ground(*at).reshape(len(steps), -1, 3)
        image = self.model.ground_to_image(ground.reshape(-1, 3)).reshape(len(steps), -1, 2)
        across, down, up = image[1] - image[2], image[3] - image[4], image[5] - image[6]
        inverse = inverse_2x2(np.stack([across, down], axis=2) / (2 * half))
        displacement = np.einsum("nij,nj->ni", inverse, up / (2 * _HALF_METRE))
        return Seen(ground[0], image[0], inverse, displacement)
