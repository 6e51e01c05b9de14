r"""Interior orientation of a frame camera: from directions in the camera to pixels, and back.

A direction is :math:`(u, v)`, the tangents (right, down) of the angle between ray and optical axis. The lens distorts
it (Brown's model as in OpenCV and OpenSfM, dimensionless, :math:`r^2 = u^2 + v^2`)

.. math::
    u' &= u (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + 2 p_1 u v + p_2 (r^2 + 2 u^2) \\
    v' &= v (1 + k_1 r^2 + k_2 r^4 + k_3 r^6) + p_1 (r^2 + 2 v^2) + 2 p_2 u v

and the image plane has the paper's coordinates: metres from the middle of the frame, x right and **y up**,
:math:`x = x_0 + f u'`, :math:`y = y_0 - f v'`. Pixels count from the outer corner of the first one, rows **down**:
column = width/2 + x / pitch_x, row = height/2 - y / pitch_y.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array, solve_2x2

#: Parameters of the interior orientation, in the order of `Interior.partials`.
INTERIOR = ("focal_length", "x0", "y0", "pitch_x", "pitch_y", "k1", "k2", "k3", "p1", "p2")
_UNDISTORT_STEPS = 30


@dataclass(frozen=True)
class Interior:
    """Interior orientation of a frame camera.

    Parameters
    ----------
    width, height : int
        Size of the frame (px).
    focal_length : float
        Principal distance f (m).
    pitch_x, pitch_y : float
        Distance (m) between neighbouring pixels along a row and along a column.
    x0, y0 : float
        Principal point in the image plane (x right, y up), in metres from the middle of the frame.
    k1, k2, k3, p1, p2 : float
        Brown's distortion of tangents, v down (see the module).

    Raises
    ------
    InputError
        For a number that is not finite, or a size that is not positive.

    Examples
    --------
    >>> camera = Interior(4000, 3000, focal_length=0.05, pitch_x=5e-6, pitch_y=5e-6)
    >>> round(math.degrees(camera.field_of_view), 2)
    14.04
    """

    width: int
    height: int
    focal_length: float
    pitch_x: float
    pitch_y: float
    x0: float = 0.0
    y0: float = 0.0
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        for name in INTERIOR:
            value = float(getattr(self, name))
            if not math.isfinite(value):
                raise InputError(f"{value} is not a finite number", field=name)
            object.__setattr__(self, name, value)
        for name in ("width", "height", "focal_length", "pitch_x", "pitch_y"):
            if not getattr(self, name) > 0:
                raise InputError(f"{getattr(self, name)} is not positive", field=name)
        if self.width != int(self.width) or self.height != int(self.height):
            raise InputError("the numbers of columns and rows must be integers", field="width, height")

    @property
    def field_of_view(self) -> float:
        """Angle (rad) between the axis and the corner of the frame, without distortion."""
        return math.atan(math.hypot(self.width * self.pitch_x, self.height * self.pitch_y) / 2 / self.focal_length)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as JSON values."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @cached_property
    def _farthest(self) -> float:
        """Square of the radius r up to which the distortion is monotonic; beyond it a pixel has two directions."""
        if not (self.k1 or self.k2 or self.k3):
            return math.inf
        # 1 + 3 k1 u + 5 k2 u^2 + 7 k3 u^3 with u = 1 / (scale v): coefficients of at most 1, and a leading one of 1.
        terms = (3 * self.k1, 5 * self.k2, 7 * self.k3)
        scale = max(abs(term) ** (1 / power) for power, term in enumerate(terms, start=1))
        if not 1e-30 < scale < 1e100:
            return math.inf if scale < 1 else 0.0
        roots = np.roots([1.0, *(term / scale**power for power, term in enumerate(terms, start=1))])
        real = 1 / (scale * roots[(np.abs(roots.imag) < 1e-9) & (roots.real > 1e-30)].real)
        return float(real.min(initial=math.inf))

    @property
    def _distorts(self) -> bool:
        return bool(self.k1 or self.k2 or self.k3 or self.p1 or self.p2)

    def image_of(self, directions: Array) -> Array:
        """Return the image points ``(N, 2)`` of directions ``(N, 2)``; NaN where the lens model is not unique."""
        image = self._pixels(self._distort(directions))
        if math.isfinite(self._farthest):
            image[(directions**2).sum(axis=1) >= self._farthest] = np.nan
        return image

    def directions_of(self, image: Array) -> Array:
        """Return the directions ``(N, 2)`` of image points ``(N, 2)``; NaN where there is none.

        Newton's method inverts the distortion, and the result is verified.
        """
        x = (image[:, 0] - self.width / 2) * self.pitch_x - self.x0
        y = (self.height / 2 - image[:, 1]) * self.pitch_y - self.y0
        seen = np.stack([x, -y], axis=1) / self.focal_length
        if not self._distorts:
            return seen
        directions = seen.copy()
        reach = math.sqrt(self._farthest)
        for _ in range(_UNDISTORT_STEPS):
            miss = seen - self._distort(directions)
            directions = directions + solve_2x2(self._slopes(directions), miss)
            # A step beyond the limit would end on the wrong branch.
            radius = np.hypot(directions[:, 0], directions[:, 1])
            with np.errstate(invalid="ignore"):
                directions[radius > reach] *= (0.99 * reach / radius[radius > reach])[:, None]
                if not (np.abs(miss) > 1e-15).any():
                    break
        with np.errstate(invalid="ignore"):
            closed = np.abs(self._distort(directions) - seen).max(axis=1, initial=0.0) < 1e-12
        directions[~closed] = np.nan
        return directions

    def partials_of_direction(self, directions: Array) -> Array:
        """Return d(image)/d(direction) as ``(N, 2, 2)``."""
        scale = np.array([self.focal_length / self.pitch_x, self.focal_length / self.pitch_y])
        return np.asarray(self._slopes(directions) * scale[:, None])

    def partials(self, directions: Array) -> Array:
        """Return d(image)/d(parameters) as ``(N, 2, 10)``, in the order of `INTERIOR`."""
        u, v = directions.T
        moved = self._distort(directions)
        r2 = u**2 + v**2
        across, down = self.focal_length / self.pitch_x, self.focal_length / self.pitch_y
        out = np.zeros((len(u), 2, len(INTERIOR)))
        out[:, 0, 0], out[:, 1, 0] = moved[:, 0] / self.pitch_x, moved[:, 1] / self.pitch_y
        out[:, 0, 1], out[:, 1, 2] = 1 / self.pitch_x, -1 / self.pitch_y
        centred = self._pixels(moved) - (self.width / 2, self.height / 2)
        out[:, 0, 3], out[:, 1, 4] = -centred[:, 0] / self.pitch_x, -centred[:, 1] / self.pitch_y
        for power in (1, 2, 3):
            out[:, 0, 4 + power], out[:, 1, 4 + power] = across * u * r2**power, down * v * r2**power
        out[:, 0, 8], out[:, 1, 8] = across * 2 * u * v, down * (r2 + 2 * v**2)
        out[:, 0, 9], out[:, 1, 9] = across * (r2 + 2 * u**2), down * 2 * u * v
        return out

    def _pixels(self, moved: Array) -> Array:
        col = self.width / 2 + (self.x0 + self.focal_length * moved[:, 0]) / self.pitch_x
        row = self.height / 2 - (self.y0 - self.focal_length * moved[:, 1]) / self.pitch_y
        return np.stack([col, row], axis=1)

    def _distort(self, directions: Array) -> Array:
        if not self._distorts:
            return directions
        u, v = directions.T
        r2 = u**2 + v**2
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        return np.stack(
            [
                u * radial + 2 * self.p1 * u * v + self.p2 * (r2 + 2 * u**2),
                v * radial + self.p1 * (r2 + 2 * v**2) + 2 * self.p2 * u * v,
            ],
            axis=1,
        )

    def _slopes(self, directions: Array) -> Array:
        """Return d(moved)/d(direction) as ``(N, 2, 2)``."""
        u, v = directions.T
        r2 = u**2 + v**2
        radial = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        rate = 2 * (self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3))
        cross = u * v * rate + 2 * self.p1 * u + 2 * self.p2 * v
        out = np.empty((len(u), 2, 2))
        out[:, 0, 0] = radial + u**2 * rate + 2 * self.p1 * v + 6 * self.p2 * u
        out[:, 1, 1] = radial + v**2 * rate + 6 * self.p1 * v + 2 * self.p2 * u
        out[:, 0, 1] = out[:, 1, 0] = cross
        return out
