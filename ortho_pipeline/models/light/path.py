r"""The path of light to a camera in space, for vendors' angles that do not include it.

A camera at S that moves with v over the turning Earth sees the point P along

.. math:: P + \ell\, n - S + |P - S|\, v / c, \qquad \ell = s\, \nu_0 e^{-h/s} / \cos^2 z ,

with n up at P, z the zenith angle of the line there, and h the height of P. Refraction lifts the point
(`ortho_pipeline.models.light.refraction`, far above the air). Aberration, less the motion of the ground during the
travel of the light, moves it forwards. From 600 km that is 20 m, and 2.5 m of height.

Not included: the rotation of the Earth during the travel of the light, at most 0.2 m and the same for the whole image;
and terms of v²/c², a millimetre.

Source: Greslou, de Lussy and Montel 2008, "Light aberration effect in HR geometric model"; the signs were found with
WorldView-1 (`ortho_maxar.isd`).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.light.refraction import FLATTEST, REFRACTIVITY, SCALE_HEIGHT

#: Metres per second.
LIGHT = 299_792_458.0


@dataclass(frozen=True)
class LightPath:
    """Whether a model adds aberration and refraction; a vendor's angles may already include them.

    Parameters
    ----------
    aberration, refraction : bool
        Default: both are in the angles.

    Examples
    --------
    >>> LightPath(refraction=True)
    LightPath(aberration=False, refraction=True)
    """

    aberration: bool = False
    refraction: bool = False

    def __post_init__(self) -> None:
        if not (isinstance(self.aberration, bool) and isinstance(self.refraction, bool)):
            raise InputError("aberration and refraction must be true or false", field="light")

    @property
    def numbers(self) -> tuple[float, float]:
        """Bend (m) at the ellipsoid and seconds per metre of light, for the compiled projection; zero for none."""
        return SCALE_HEIGHT * REFRACTIVITY * self.refraction, self.aberration / LIGHT

    def lift(self, height: Array, cosine: Array) -> Array:
        """Return how much (m) higher points ``(N,)`` at a height appear, by the cosine of the zenith angle."""
        bend = self.numbers[0] * np.exp(-np.asarray(height) / SCALE_HEIGHT)
        return np.asarray(bend / np.maximum(cosine, FLATTEST) ** 2)

    def rise(self, height: Array, cosine: Array) -> Array:
        """Return the derivative ``(N,)`` of the apparent height by the height."""
        return np.asarray(1.0 - self.lift(height, cosine) / SCALE_HEIGHT)

    def apparent(self, line: Array, velocity: Array, up: Array, height: Array) -> Array:
        """Return the vectors ``(N, 3)`` along which a camera sees points.

        Parameters
        ----------
        line, velocity, up : (N, 3)
            Vectors from the camera to the points (m), velocity of the camera over the Earth (m/s), up at the points; in
            any axes.
        height : (N,)
            Heights of the points (m).
        """
        if self.refraction:
            cosine = -(line * up).sum(axis=1) / np.linalg.norm(line, axis=1)
            line = line + up * self.lift(height, cosine)[:, None]
        if self.aberration:
            line = line + velocity * (np.linalg.norm(line, axis=1)[:, None] / LIGHT)
        return line

    def turned(self, matrix: Array, line: Array, velocity: Array) -> Array:
        """Return matrices ``(N, 3, 3)`` by which apparent vectors are turned, as they apply to changes of `line`."""
        if not self.aberration:
            return matrix
        unit = line / np.linalg.norm(line, axis=1)[:, None]
        return np.asarray(matrix + (matrix @ velocity[:, :, None] / LIGHT) * unit[:, None, :])

    def by_velocity(self, matrix: Array, line: Array) -> Array:
        """Return the derivatives ``(N, 3, 3)`` of apparent vectors, turned by matrices, by the velocity."""
        return np.asarray(matrix * (np.linalg.norm(line, axis=1)[:, None, None] * self.numbers[1]))

    def straight(self, direction: Array, velocity: Array) -> Array:
        """Return the unit vectors ``(N, 3)`` along which light arrived that is seen along unit vectors `direction`."""
        if not self.aberration:
            return direction
        slant = velocity / LIGHT
        along = (direction * slant).sum(axis=1)
        length = along + np.sqrt(along**2 + 1.0 - (slant**2).sum(axis=1))
        return np.asarray(direction * length[:, None] - slant)

    def to_dict(self) -> dict[str, bool]:
        """Return both as plain data."""
        return asdict(self)


#: For angles that include both, or a vendor that uses neither.
AS_GIVEN = LightPath()
