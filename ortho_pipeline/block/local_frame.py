"""The local ENU frame in which models of any CRS meet: east, north, up (m) about the middle of the points.

A bundle adjustment has one set of coordinates per point while each model wants its own CRS. The frame is the geocentric
system rotated and moved, so it is exact over any extent, metres on all axes, and well conditioned.
Derivatives follow by the chain rule: in closed form to longitude, latitude and height, by differences from there to
other systems.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.geodesy.distortion import map_from_enu
from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric, geodetic, metres_per_degree
from ortho_pipeline.models.base import Array, SensorModel

GEODETIC = "EPSG:4979"
#: Step (m) of the differences that lead to other systems: map projections bend too little for it to matter, and
#: rounding of a metre's tenth-billionth stays far below it.
_STEP = 10.0


@dataclass(frozen=True, eq=False)
class GroundFrame:
    """Local ENU frame (m) about `origin` ``(3,)`` lon, lat (degrees), h."""

    origin: Array

    @classmethod
    def about(cls, ground: Array) -> GroundFrame:
        """Return the frame in the middle of finite points ``(N, 3)`` lon, lat, h."""
        ecef = geocentric(ground[np.isfinite(ground).all(axis=1)])
        middle = geodetic((ecef.min(axis=0, keepdims=True) + ecef.max(axis=0, keepdims=True)) / 2)[0]
        middle[2] = 0.0
        return cls(middle)

    @property
    def turn(self) -> Array:
        """The rotation ``(3, 3)`` from ECEF."""
        rotation: Array = enu_from_ecef(self.origin[None])[0]
        return rotation

    def of_geodetic(self, ground: Array) -> Array:
        """Return points ``(N, 3)`` lon, lat, h in the frame."""
        return (geocentric(ground) - geocentric(self.origin[None])) @ self.turn.T

    def geodetic(self, local: Array) -> Array:
        """Return points ``(N, 3)`` of the frame as lon, lat (degrees), h."""
        return geodetic(local @ self.turn + geocentric(self.origin[None]))

    def enu_at(self, ground: Array) -> Array:
        """Return the rotations ``(N, 3, 3)`` from the frame to the local ENU frames of points lon, lat, h."""
        return enu_from_ecef(ground) @ self.turn.T

    def apart(self, ground: Array, local: Array) -> Array:
        """Return points lon, lat, h minus points of the frame ``(N, 3)`` in the local ENU frames of the former."""
        apart: Array = (self.enu_at(ground) @ (self.of_geodetic(ground) - local)[:, :, None])[:, :, 0]
        return apart

    def places(self, local: Array) -> Places:
        """Return points ``(N, 3)`` of the frame as they are in the systems of models."""
        return Places(self, local)


class Places:
    """Points of a frame in the CRS of any model, each computed once."""

    def __init__(self, frame: GroundFrame, local: Array) -> None:
        self.frame, self.local = frame, local
        self.geodetic = frame.geodetic(local)
        self._slopes: Array | None = None
        self._systems: dict[str, Array] = {}
        self._partials: dict[str, Array] = {}

    def in_crs(self, crs: str) -> Array:
        """Return the points ``(N, 3)`` in a CRS; NaN where they cannot be brought there."""
        if crs not in self._systems:
            self._systems[crs] = ground_transform(GEODETIC, crs)(self.geodetic)
        return self._systems[crs]

    def partials(self, crs: str) -> Array:
        """Return d(ground in the CRS)/d(frame) ``(N, 3, 3)``."""
        if crs not in self._partials:
            way = ground_transform(GEODETIC, crs)
            self._partials[crs] = self._geodetic_partials() if way.is_identity else self._differences(crs)
        return self._partials[crs]

    def project(self, model: SensorModel, rows: np.ndarray) -> Array:
        """Return the image points ``(n, 2)`` of some of the points."""
        return model.ground_to_image(self.in_crs(model.crs)[rows])

    def ground_partials(self, model: SensorModel, rows: np.ndarray) -> Array:
        """Return d(image)/d(frame) ``(n, 2, 3)`` of some of the points."""
        return self._chained(model, model.ground_partials(self.in_crs(model.crs)[rows]), rows)

    def linearised(self, model: SensorModel, rows: np.ndarray) -> tuple[Array, Array, Array]:
        """Return image points ``(n, 2)``, their partials by the frame ``(n, 2, 3)`` and by the parameters."""
        image, by_ground, by_params = model.linearised(self.in_crs(model.crs)[rows])
        return image, self._chained(model, by_ground, rows), by_params

    def projected(self, model: SensorModel, rows: np.ndarray) -> tuple[Array, Array]:
        """Return the image points ``(n, 2)`` of some of the points, and their partials by the frame ``(n, 2, 3)``."""
        image, by_ground = model.projected(self.in_crs(model.crs)[rows])
        return image, self._chained(model, by_ground, rows)

    def _chained(self, model: SensorModel, by_ground: Array, rows: np.ndarray) -> Array:
        """Return d(image)/d(frame) of d(image)/d(ground)."""
        from ortho_pipeline.block.equations import point_kernel

        return np.asarray(point_kernel.chained(by_ground, self.partials(model.crs), rows))

    def _geodetic_partials(self) -> Array:
        if self._slopes is None:
            from ortho_pipeline.block.equations import point_kernel

            self._slopes = np.empty((len(self.local), 3, 3))
            point_kernel.slopes(self.geodetic, metres_per_degree(self.geodetic), self.frame.turn, self._slopes)
        return self._slopes

    def _differences(self, crs: str) -> Array:
        way = ground_transform(GEODETIC, crs)
        partials = np.empty((len(self.local), 3, 3))
        for axis in range(3):
            step = np.zeros(3)
            step[axis] = _STEP
            ahead, behind = (way(self.frame.geodetic(self.local + sign * step)) for sign in (1.0, -1.0))
            partials[:, :, axis] = (ahead - behind) / (2 * _STEP)
        return partials


def enu_partials(model: SensorModel, ground: Array) -> Array:
    """Return the derivatives ``(n, 2, 3)``, px per metre, of image points by east, north and up at lon, lat, h."""
    there = ground_transform(GEODETIC, model.crs)(ground)
    return np.asarray(model.ground_partials(there) @ map_from_enu(parse_crs(model.crs), there))
