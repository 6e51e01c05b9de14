r"""Frame camera: the whole image at one instant, through one perspective centre (collinearity).

With the perspective centre :math:`(X_L, Y_L, Z_L)` and the rotation :math:`M(\omega, \phi, \kappa)` from the axes
of the working frame to those of the camera (x right, y up in the image, z backwards; in front of the camera
:math:`w_3 < 0`), and :math:`w = M (X - X_L)`,

.. math:: x - x_0 = -f\, w_1 / w_3, \qquad y - y_0 = -f\, w_2 / w_3 .

Lens, principal point and pixels are in `ortho_pipeline.models.lens`, the two working frames in
`ortho_pipeline.models.frame.working_frame`, the optional refraction in `ortho_pipeline.models.light.refraction`.

Source: Ok and Turker, equations 1-7; McGlone 1996. Symbols: X_L ... kappa, f (focal_length), x0, y0 and M as there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.models.base import (
    RING,
    Array,
    SensorModel,
    as_ground,
    as_heights,
    as_image,
    as_params,
    box_around,
    checked_names,
    ground_of_corners,
    ground_of_grid,
)
from ortho_pipeline.models.frame.collinearity import Exterior, directions, image_by_vector, rays
from ortho_pipeline.models.frame.orientation import (
    EXTERIOR,
    exterior_of_geocentric,
    geocentric_of_map,
    geocentric_of_platform,
    require_metres,
)
from ortho_pipeline.models.frame.working_frame import (
    GEOGRAPHIC,
    MAP,
    TOPOCENTRIC,
    ProjectionFrame,
    Topocentric,
    WorkingFrame,
    require_frame,
)
from ortho_pipeline.models.lens import INTERIOR, Interior
from ortho_pipeline.models.light.refraction import FLATTEST

PARAMETERS = (*EXTERIOR, *INTERIOR)
#: Warning for a camera whose `FrameCamera.sees_ground` is false.
LOOKS_PAST = Notice(
    "only-a-start",
    "with this exterior orientation the camera looks past the ground. The model is only a start for an adjustment: "
    "add control points",
)
#: A point that the camera does not see is NaN, not a warning.
_quiet = partial(np.errstate, invalid="ignore", divide="ignore", over="ignore")


@dataclass(frozen=True, eq=False)
class FrameCamera(SensorModel):
    """A frame camera with its interior and exterior orientation.

    Parameters
    ----------
    interior : Interior
    exterior : (6,)
        `EXTERIOR` in the working frame, metres and radians.
    frame : {'topocentric', 'map'}
        The working frame (see the module).
    ground_crs : str
        CRS of the ground: EPSG:4979 if topocentric, else the projected CRS (metres).
    origin : (float, float, float)
        Lon, lat (degrees), ellipsoidal height of the topocentric origin; zeros for 'map'.
    heights : (float, float)
        Lowest and highest ellipsoidal height (m) of the ground.
    refraction : bool
        Whether the standard atmosphere bends the rays.
    free : tuple of str
        Names of `PARAMETERS` that an adjustment may change; a `Prior` weights them.
    """

    kind: ClassVar[str] = "frame"

    interior: Interior
    exterior: Array
    frame: str = TOPOCENTRIC
    ground_crs: str = GEOGRAPHIC
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    heights: tuple[float, float] = (0.0, 1000.0)
    refraction: bool = False
    free: tuple[str, ...] = EXTERIOR

    def __post_init__(self) -> None:
        exterior = np.array(self.exterior, dtype=np.float64)
        if exterior.shape != (6,) or not np.isfinite(exterior).all():
            raise InputError("the exterior orientation needs six finite numbers", field="exterior")
        exterior.setflags(write=False)
        object.__setattr__(self, "exterior", exterior)
        for name, count in (("origin", 3), ("heights", 2)):
            object.__setattr__(self, name, _finite(getattr(self, name), count, name))
        if not self.heights[0] < self.heights[1]:
            raise InputError(f"heights from {self.heights[0]} to {self.heights[1]} are not a range", field="heights")
        require_frame(self.frame, self.ground_crs)
        object.__setattr__(self, "free", checked_names(self.free, PARAMETERS, f"from {', '.join(PARAMETERS)}"))

    # -- other ways to state the orientation -------------------------------------------------------------------------

    @classmethod
    def from_geocentric(
        cls, interior: Interior, position: ArrayLike, camera_from_ecef: Array | None = None, **others: Any
    ) -> Self:
        """Make the camera at a position in ECEF (m), with its origin on the ellipsoid below.

        Parameters
        ----------
        camera_from_ecef : (3, 3), optional
            Rotation to camera axes. Default: omega, phi and kappa are zero as in the paper (equation 5), so the camera
            looks straight down and the top of the image is north.
        """
        exterior, origin = exterior_of_geocentric(position, camera_from_ecef)
        return cls(interior, exterior, origin=origin, **others)

    @classmethod
    def from_map(
        cls, interior: Interior, crs: str, exterior: ArrayLike, *, frame: str = TOPOCENTRIC, **others: Any
    ) -> Self:
        """Make the camera from an exterior orientation ``(6,)`` in a map projection, with ellipsoidal height.

        With ``frame='topocentric'`` the angles are rotated by the meridian convergence at the perspective centre, and
        the projection is not used further. With ``'map'`` they are used as they are.
        """
        orientation = np.asarray(exterior, dtype=np.float64)
        require_metres(crs)
        if frame == MAP:
            return cls(interior, orientation, frame=MAP, ground_crs=crs, **others)
        return cls.from_geocentric(interior, *geocentric_of_map(crs, orientation), **others)

    @classmethod
    def from_roll_pitch_yaw(
        cls, interior: Interior, position: ArrayLike, roll: float, pitch: float, yaw: float, **others: Any
    ) -> Self:
        """Make the camera of a platform at lon, lat (degrees), ellipsoidal height, with angles in radians.

        The platform's axes are forward, right, down. Yaw is the heading clockwise from true north, positive pitch lifts
        the nose, positive roll lowers the right wing. At zero the camera looks straight down, image top forward.

        Examples
        --------
        >>> interior = Interior(4000, 3000, focal_length=0.05, pitch_x=5e-6, pitch_y=5e-6)
        >>> camera = FrameCamera.from_roll_pitch_yaw(interior, [33.0, 37.0, 2000.0], 0.0, 0.0, 0.0)
        >>> camera.image_to_ground([[2000.0, 1500.0]], 500.0).round(6).tolist()
        [[33.0, 37.0, 500.0]]
        """
        return cls.from_geocentric(interior, *geocentric_of_platform(position, roll, pitch, yaw), **others)

    # -- what the host asks ------------------------------------------------------------------------------------------

    @property
    def crs(self) -> str:
        """CRS of the ground."""
        return self.ground_crs

    @property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest ellipsoidal height of the ground."""
        return self.heights

    def with_heights(self, low: float, high: float) -> Self:
        """Return the camera for ground between two ellipsoidal heights (m)."""
        return self._replace(heights=(low, high))

    @cached_property
    def domain(self) -> tuple[Array, Array]:
        """Centre and half-size of the box that the camera sees between `heights`, without too flat rays."""
        seen = self._seen
        # Start values may look anywhere; then the box is below the camera.
        return box_around(seen if len(seen) else self._below(), self.heights)

    @property
    def sees_ground(self) -> bool:
        """Whether any ray meets the ground between `heights`; start values may look past it."""
        return len(self._seen) > 0

    @property
    def corners(self) -> Array:
        """Ground points ``(8, 3)`` of the corners of the image at both ends of `heights`; NaN if a ray misses.

        The box of `domain` is parallel to the ground axes, so its corners are far outside a rotated image.
        """
        return ground_of_corners(self, (self.interior.width, self.interior.height), self.heights)

    @property
    def perspective_centre(self) -> Array:
        """Position ``(3,)`` of the camera in the CRS of the ground."""
        return self.working_frame.to_ground(self.exterior[:3])

    @cached_property
    def working_frame(self) -> WorkingFrame:
        """The frame of the exterior orientation."""
        return ProjectionFrame() if self.frame == MAP else Topocentric(self.origin)

    @property
    def rotation(self) -> Array:
        """Rotation ``(3, 3)`` from the working frame to the camera, M of equation 3."""
        return self._outside.rotation

    @property
    def param_names(self) -> tuple[str, ...]:
        """The free parameters."""
        return self.free

    @property
    def params(self) -> Array:
        """Values of the free parameters."""
        return np.array([self._values[name] for name in self.free])

    def with_params(self, params: ArrayLike) -> Self:
        """Return the camera with other values of the free parameters.

        Raises
        ------
        ValueError
            If one of them is not finite.
        """
        values = self._values | dict(zip(self.free, as_params(params, self.free).tolist(), strict=True))
        exterior = np.array([values[name] for name in EXTERIOR])
        if not np.isfinite(exterior).all():
            raise ValueError("a parameter is not finite")
        interior = self.interior
        if not set(self.free) <= set(EXTERIOR):
            interior = replace(interior, **{name: values[name] for name in INTERIOR})
        return self._replace(interior=interior, exterior=exterior)

    @property
    def _values(self) -> dict[str, float]:
        known = dict(zip(EXTERIOR, self.exterior.tolist(), strict=True))
        return known | {name: getattr(self.interior, name) for name in INTERIOR}

    # -- the map -----------------------------------------------------------------------------------------------------

    def ground_to_image(self, ground: ArrayLike) -> Array:
        """Project ground points ``(N, 3)``; NaN behind the camera, behind the Earth or beyond the lens model."""
        with _quiet():
            return self.interior.image_of(directions(self._outside.vectors(as_ground(ground))))

    def ground_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(ground) as ``(N, 2, 3)``, in closed form."""
        ground = as_ground(ground)
        with _quiet():
            return image_by_vector(self.interior, self._outside.vectors(ground)) @ self._outside.by_ground(ground)

    def param_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(params) as ``(N, 2, P)``, in closed form."""
        ground = as_ground(ground)
        with _quiet():
            w = self._outside.vectors(ground)
            partials = image_by_vector(self.interior, w) @ self._outside.by_orientation(ground, w)
            if not set(self.free) <= set(EXTERIOR):
                partials = np.concatenate([partials, self.interior.partials(directions(w))], axis=2)
        return partials[:, :, [PARAMETERS.index(name) for name in self.free]]

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Intersect the rays of image points ``(N, 2)`` with an ellipsoidal height; NaN where they miss."""
        image = as_image(image)
        heights = as_heights(height, len(image))
        with _quiet():
            return self._outside.follow(rays(self.interior, image), heights)

    @cached_property
    def _outside(self) -> Exterior:
        return Exterior(self.exterior, self.working_frame, self.refraction)

    @property
    def _seen(self) -> Array:
        """Ground points ``(N, 3)`` of a grid of pixels at both ends of `heights`, where rays are not too flat."""
        seen = ground_of_grid(self, (self.interior.width, self.interior.height), 7, self.heights)
        with np.errstate(invalid="ignore"):
            return seen[self._outside.steepness(seen) > FLATTEST]

    def _below(self) -> Array:
        """Return the corners ``(4, 3)`` of a square below the camera, as wide as the field of view."""
        centre = self.perspective_centre
        reach = max(abs(centre[2] - sum(self.heights) / 2), 1.0) * math.tan(min(self.interior.field_of_view, 1.4))
        corners = (2 * RING - 1) * reach / self.working_frame.metres_per_unit(centre)
        return np.column_stack([centre[:2] + corners, np.full(4, self.heights[0])])

    # -- files -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain data, numbers by their names."""
        data = super().to_dict()
        data["interior"] = self.interior.to_dict()
        data["exterior"] = dict(zip(EXTERIOR, self.exterior.tolist(), strict=True))
        return data

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make the model from the result of `to_dict`."""
        interior, exterior = data.get("interior"), data.get("exterior")
        if not isinstance(interior, dict) or not isinstance(exterior, dict) or set(exterior) != set(EXTERIOR):
            raise InputError("a frame camera needs an interior and an exterior orientation", field="interior, exterior")
        values = np.array([exterior[name] for name in EXTERIOR], dtype=np.float64)
        return super().from_dict({**data, "interior": Interior(**interior), "exterior": values})


def _finite(values: tuple[float, ...], count: int, field: str) -> tuple[float, ...]:
    values = tuple(float(value) for value in values)
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(f"{values} is not {counted(count, 'finite number')}", field=field)
    return values
