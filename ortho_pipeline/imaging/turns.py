"""The first search for a model that may also be rotated or scaled, such as a pose from metadata alone.

With a rotated model each chip has a different shift, and the mean of the correlation surfaces has no peak. So the
surfaces are added with the shifts of many rotations and scales, without new rendering. A chip itself can be found up to
a few degrees of rotation. For larger rotations the target is rendered with a rotated model.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import Array

#: Largest rotation (degrees) of a chip without new rendering.
_TURNED = 2.0
#: Steps of rotation (degrees) and scale, fine enough for chips 200 chip px from the middle, and the largest change of
#: scale.
_STEP_DEG, _STEP, _SCALE = 0.3, 0.005, 0.05


@dataclass(frozen=True, eq=False)
class Turn:
    """A possible error of a model: a point that it projects to q belongs at `matrix` (q - origin) + origin + `shift`.

    Parameters
    ----------
    value : float
        Mean correlation of the chips.
    """

    value: float
    matrix: Array
    shift: Array


def renderings(rotation_deg: float) -> list[Array]:
    """Return the rotations ``(2, 2)`` to render targets with, to find all rotations within `rotation_deg`."""
    step = 2 * _TURNED
    count = max(0, math.ceil((rotation_deg - _TURNED) / step))
    # A full turn has no rotation twice.
    angles = [number * step for number in range(-count, count + 1) if -180 < number * step <= 180]
    return [_rotation(angle) for angle in sorted(angles, key=abs)]


def orientations(rotation_deg: float) -> int:
    """Return the number of searched pairs of rotation and scale; 1 without a search."""
    if not rotation_deg:
        return 1
    return (2 * math.ceil(rotation_deg / _STEP_DEG) + 1) * (2 * round(_SCALE / _STEP) + 1)


def margin(places: Array) -> int:
    """Return the largest displacement (chip px) of places ``(n, 2)`` by rotation and scale about the middle."""
    return math.ceil(float(np.hypot(*places.T).max()) * (math.radians(_TURNED + _STEP_DEG) + _SCALE))


def votes(surface: NDArray[np.float32], places: Array, radius: int, rendered: Array, factor: int) -> Iterator[Turn]:
    """Yield the best shift of each rotation and scale near the rotation with which chips were rendered.

    Parameters
    ----------
    surface : (n, k, k)
        Surfaces of chips at `places` ``(n, 2)`` (chip px from the middle), `margin` wider than `radius` on each side.
    rendered : (2, 2)
        Rotation of the rendering.
    factor : int
        Pixels of the scene in a chip pixel.
    """
    wide = (surface.shape[1] - 1) // 2
    angles = np.arange(-round(_TURNED / _STEP_DEG), round(_TURNED / _STEP_DEG) + 1) * _STEP_DEG
    scales = 1 + np.arange(-round(_SCALE / _STEP), round(_SCALE / _STEP) + 1) * _STEP
    for angle, scale in itertools.product(angles.tolist(), scales.tolist()):
        matrix = scale * _rotation(angle)
        moved = np.rint(places @ (matrix - np.eye(2)).T).astype(int) + wide - radius
        total = np.zeros((2 * radius + 1, 2 * radius + 1), dtype=np.float32)
        for chip, (column, row) in zip(surface, moved.tolist(), strict=True):
            total += chip[row : row + 2 * radius + 1, column : column + 2 * radius + 1]
        row, column = np.unravel_index(int(total.argmax()), total.shape)
        inverse = np.linalg.inv(matrix)
        shift = np.array([column - radius, row - radius], dtype=float) * factor
        yield Turn(float(total[row, column]) / len(surface), inverse @ rendered, -inverse @ shift)


def _rotation(angle_deg: float) -> Array:
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[cosine, -sine], [sine, cosine]])
