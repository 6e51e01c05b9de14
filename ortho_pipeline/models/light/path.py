r"""The way of light to a camera in space, where a vendor's angles leave it out.

A camera at S that moves with v over the turning Earth sees the point P along

.. math:: P + \ell\, n - S + |P - S|\, v / c, \qquad \ell = s\, \nu_0 e^{-h/s} / \cos^2 z ,

with n upwards at P, z the zenith angle of the line there and h the height of P: refraction lifts the point
(`ortho_pipeline.models.light.refraction`, far above the air), and the velocity, which is that of the aberration less
the way of the ground while the light is under way, moves it forwards. From 600 km that is 20 m, and 2.5 m of height.

Left out is the turn of the Earth between ground and camera while the light is under way, 0.2 m at most (it is the same
for the whole image), and terms of v²/c², a millimetre.

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
    """Which of the two a model has of its own; a vendor's angles may have them already.

    Parameters
    ----------
    aberration, refraction : bool
    """

    aberration: bool = False
    refraction: bool = False

    def __post_init__(self) -> None:
        if not (isinstance(self.aberration, bool) and isinstance(self.refraction, bool)):
            raise InputError("aberration and refraction must be true or false", field="light")

    @property
    def numbers(self) -> tuple[float, float]:
        """What a compiled projection needs: bend (m) at the ellipsoid, seconds per metre of light; zero for none."""
        return SCALE_HEIGHT * REFRACTIVITY * self.refraction, self.aberration / LIGHT

    def lift(self, height: Array, cosine: Array) -> Array:
        """Return by how much (m) points ``(N,)`` at heights appear higher under zenith angles with this cosine."""
        bend = self.numbers[0] * np.exp(-np.asarray(height) / SCALE_HEIGHT)
        return np.asarray(bend / np.maximum(cosine, FLATTEST) ** 2)

    def rise(self, height: Array, cosine: Array) -> Array:
        """Return by how much ``(N,)`` the apparent height grows with the height."""
        return np.asarray(1.0 - self.lift(height, cosine) / SCALE_HEIGHT)

    def apparent(self, line: Array, velocity: Array, up: Array, height: Array) -> Array:
        """Return along what ``(N, 3)`` a camera sees points that lie at `line` ``(N, 3)`` from it.

        Parameters
        ----------
        line, velocity, up : (N, 3)
            From the camera to the points (m), of the camera over the Earth (m/s), upwards at the points; in any axes.
        height : (N,)
            Of the points (m).
        """
        if self.refraction:
            cosine = -(line * up).sum(axis=1) / np.linalg.norm(line, axis=1)
            line = line + up * self.lift(height, cosine)[:, None]
        if self.aberration:
            line = line + velocity * (np.linalg.norm(line, axis=1)[:, None] / LIGHT)
        return line

    def straight(self, direction: Array, velocity: Array) -> Array:
        """Return the unit vectors ``(N, 3)`` along which light came that is seen along unit vectors `direction`."""
        if not self.aberration:
            return direction
        slant = velocity / LIGHT
        along = (direction * slant).sum(axis=1)
        length = along + np.sqrt(along**2 + 1.0 - (slant**2).sum(axis=1))
        return np.asarray(direction * length[:, None] - slant)

    def to_dict(self) -> dict[str, bool]:
        """Return both as plain data."""
        return asdict(self)


#: Of angles that hold both, or of a vendor who locates without.
AS_GIVEN = LightPath()
