"""The first search where the model may be turned or of another scale too, as of a pose that only metadata give.

Where the model is turned, each chip has another shift, and the mean of their correlation surfaces has no peak. So the
surfaces are added with the shifts that a rotation and a scale mean, for many of both, without rendering anything again.
A chip itself is found while it is turned by a few degrees; beyond, the target is rendered anew under a turned model.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.models.base import Array

#: A chip that is turned by more than this (degrees) is rendered anew.
_TURNED = 2.0
#: Steps of rotation (degrees) and scale, fine enough for chips 200 chip px from the middle, and how far scales are
#: searched.
_STEP_DEG, _STEP, _SCALE = 0.3, 0.005, 0.05


@dataclass(frozen=True, eq=False)
class Turn:
    """How a model may be off: what it puts at q belongs at `matrix` (q - origin) + origin + `shift`.

    Parameters
    ----------
    value : float
        Mean correlation of the chips.
    """

    value: float
    matrix: Array
    shift: Array


def renderings(rotation_deg: float) -> list[Array]:
    """Return the rotations ``(2, 2)`` under which targets are rendered so that all within `rotation_deg` are found."""
    step = 2 * _TURNED
    count = max(0, math.ceil((rotation_deg - _TURNED) / step))
    # A whole turn has no rotation twice.
    angles = [number * step for number in range(-count, count + 1) if -180 < number * step <= 180]
    return [_rotation(angle) for angle in sorted(angles, key=abs)]


def orientations(rotation_deg: float) -> int:
    """Return how many pairs of rotation and scale are tried; 1 where none is searched."""
    if not rotation_deg:
        return 1
    return (2 * math.ceil(rotation_deg / _STEP_DEG) + 1) * (2 * round(_SCALE / _STEP) + 1)


def margin(places: Array) -> int:
    """Return how far (chip px) rotation and scale displace places ``(n, 2)`` from the middle, at most."""
    return math.ceil(float(np.hypot(*places.T).max()) * (math.radians(_TURNED + _STEP_DEG) + _SCALE))


def votes(surface: NDArray[np.float32], places: Array, radius: int, rendered: Array, factor: int) -> Iterator[Turn]:
    """Yield the best shift of each rotation and scale about one under which chips were rendered.

    Parameters
    ----------
    surface : (n, k, k)
        Of chips about `places` ``(n, 2)`` (chip px from the middle), `margin` wider than `radius` on each side.
    rendered : (2, 2)
        Rotation under which they were.
    factor : int
        Pixels of the scene in a chip pixel.
    """
    wide = (surface.shape[1] - 1) // 2
    angles = np.arange(-round(_TURNED / _STEP_DEG), round(_TURNED / _STEP_DEG) + 1) * _STEP_DEG
    scales = 1 + np.arange(-round(_SCALE / _STEP), round(_SCALE / _STEP) + 1) * _STEP
    for angle, scale in itertools.product(angles.tolist(), scales.tolist()):
        found = scale * _rotation(angle)
        moved = np.rint(places @ (found - np.eye(2)).T).astype(int) + wide - radius
        total = np.zeros((2 * radius + 1, 2 * radius + 1), dtype=np.float32)
        for chip, (column, row) in zip(surface, moved.tolist(), strict=True):
            total += chip[row : row + 2 * radius + 1, column : column + 2 * radius + 1]
        row, column = np.unravel_index(int(total.argmax()), total.shape)
        inverse = np.linalg.inv(found)
        shift = np.array([column - radius, row - radius], dtype=float) * factor
        yield Turn(float(total[row, column]) / len(surface), inverse @ rendered, -inverse @ shift)


def _rotation(angle_deg: float) -> Array:
    cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    return np.array([[cosine, -sine], [sine, cosine]])
