r"""Frame camera: the whole image at one instant through one perspective centre (collinearity).

With the perspective centre :math:`(X_L, Y_L, Z_L)` and the rotation :math:`M(\omega, \phi, \kappa)` from the axes
of the working frame to those of the camera (x right, y up in the image, z backwards: before the camera
:math:`w_3 < 0`), and :math:`w = M (X - X_L)`,

.. math:: x - x_0 = -f\, w_1 / w_3, \qquad y - y_0 = -f\, w_2 / w_3 .

Lens, principal point and the step to pixels are in `ortho_pipeline.models.lens`. The working frame is either

- **topocentric**: east, north, up in metres from an `origin` on or near the ground. The ground is EPSG:4979 and goes
  through ECEF in closed form, so that the curvature of the Earth is right by construction; or
- **map**: the coordinates of a map projection and ellipsoidal heights, as the paper worked; its error grows with the
  square of the footprint (d^2 / 2R: 53 m at the edge of a scene of 52 km) and is partly taken up by the orientation.

Refraction (optional) lifts a point by :math:`B / \cos^2 z` before it is projected, z being the zenith angle of the ray
there and, with refractivity :math:`\nu(h) = \nu_0 e^{-h/s}`, camera height H and point height h,

.. math:: B = \int_h^H \nu\, dh - \nu(H) (H - h),

which moves the image point outwards by the angle between chord and tangent of the bent ray. For 6 km over sea level
that is 59 µrad per tan z, as Saastamoinen has it; from space it is 2.5 m of height.

Source: Ok and Turker, equations 1-7; McGlone 1996. Symbols: X_L ... kappa, f (focal_length), x0, y0 and M as there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError, counted
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.geodesy.ellipsoid import (
    SEMI_MAJOR,
    angles_of_rotation,
    enu_from_ecef,
    geocentric,
    geodetic,
    horizon_from_geodetic,
    meet_height,
    metres_per_degree,
    rotation_of_angles,
)
from ortho_pipeline.models.base import Array, SensorModel, as_ground, as_image
from ortho_pipeline.models.frame.platform import camera_from_platform
from ortho_pipeline.models.lens import INTERIOR, Interior

#: Parameters of the exterior orientation: metres and radians in the working frame.
EXTERIOR = ("X_L", "Y_L", "Z_L", "omega", "phi", "kappa")
PARAMETERS = (*EXTERIOR, *INTERIOR)
TOPOCENTRIC, MAP = "topocentric", "map"
GEOGRAPHIC = "EPSG:4979"
#: Refractivity of air at the ellipsoid, and the height (m) over which it falls by e.
REFRACTIVITY, SCALE_HEIGHT = 2.77e-4, 9200.0
#: Rays flatter than this (cosine of the zenith angle) belong to no useful part of the scene.
_FLATTEST = 0.17
#: Warning for a camera whose `FrameCamera.sees_ground` is false.
LOOKS_PAST = Notice(
    "only-a-start",
    "by its exterior orientation the camera looks past the ground: the model only starts an adjustment to ground "
    "control points",
)
_LIFT_STEPS = 12


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
        Whether rays are bent by the standard atmosphere.
    free : tuple of str
        Names out of `PARAMETERS` that an adjustment may change; a `Prior` weights them.
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
            raise InputError("the exterior orientation has six finite numbers", field="exterior")
        exterior.setflags(write=False)
        object.__setattr__(self, "exterior", exterior)
        for name, count in (("origin", 3), ("heights", 2)):
            values = tuple(float(value) for value in getattr(self, name))
            if len(values) != count or not all(map(math.isfinite, values)):
                raise InputError(f"{values}: not {counted(count, 'finite number')}", field=name)
            object.__setattr__(self, name, values)
        if not self.heights[0] < self.heights[1]:
            raise InputError(f"heights from {self.heights[0]} to {self.heights[1]} are not a range", field="heights")
        if self.frame not in (TOPOCENTRIC, MAP):
            raise InputError(f"{self.frame!r} is not a working frame", field="frame", remedy=f"{TOPOCENTRIC} or {MAP}")
        if (self.frame == TOPOCENTRIC) != (self.ground_crs == GEOGRAPHIC):
            raise InputError(
                f"a {self.frame} frame does not go with ground in {self.ground_crs}",
                field="ground_crs",
                remedy=f"{GEOGRAPHIC} for {TOPOCENTRIC}, a projected CRS for {MAP}",
            )
        unknown = sorted(set(self.free) - set(PARAMETERS))
        if unknown or len(set(self.free)) != len(self.free):
            raise InputError(
                f"free parameters are different names out of {', '.join(PARAMETERS)}",
                field=", ".join(unknown) or "free",
            )
        object.__setattr__(self, "free", tuple(self.free))

    # -- other ways to state the orientation -------------------------------------------------------------------------

    @classmethod
    def from_geocentric(
        cls, interior: Interior, position: ArrayLike, camera_from_ecef: Array | None = None, **others: Any
    ) -> Self:
        """Make the camera of a position in ECEF metres, with its origin on the ellipsoid below.

        Parameters
        ----------
        camera_from_ecef : (3, 3), optional
            Rotation to camera axes. Without it omega, phi and kappa are zero, the paper's start (equation 5): the
            camera looks straight down with the top of the image to the north.
        """
        lon, lat, height = geodetic(np.asarray(position, dtype=np.float64)[None])[0].tolist()
        axes = enu_from_ecef(np.array([[lon, lat]]))[0]
        angles = (0.0, 0.0, 0.0) if camera_from_ecef is None else angles_of_rotation(camera_from_ecef @ axes.T)
        return cls(interior, np.array([0.0, 0.0, height, *angles]), origin=(lon, lat, 0.0), **others)

    @classmethod
    def from_map(
        cls, interior: Interior, crs: str, exterior: ArrayLike, *, frame: str = TOPOCENTRIC, **others: Any
    ) -> Self:
        """Make the camera of an exterior orientation ``(6,)`` in a map projection, heights above the ellipsoid.

        With ``frame='topocentric'`` the angles are turned by the meridian convergence at the perspective centre and
        the projection is used nowhere else; with ``'map'`` they are taken as they are.
        """
        given = np.asarray(exterior, dtype=np.float64)
        _require_metres(crs)
        if frame == MAP:
            return cls(interior, given, frame=MAP, ground_crs=crs, **others)
        to_geographic = ground_transform(crs, GEOGRAPHIC)
        steps = np.array([[0, 0], [100.0, 0], [-100.0, 0], [0, 100.0], [0, -100.0]])
        around = to_geographic(np.column_stack([given[:2] + steps, np.full(5, given[2])]))
        axes = enu_from_ecef(around[:1])[0]
        ecef = geocentric(around)
        east, north = axes @ (ecef[1] - ecef[2]), axes @ (ecef[3] - ecef[4])
        turn = math.atan2(east[1] - north[0], east[0] + north[1])
        grid_from_enu = np.array([[math.cos(turn), math.sin(turn), 0], [-math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
        rotation = rotation_of_angles(*given[3:].tolist()) @ grid_from_enu @ axes
        return cls.from_geocentric(interior, ecef[0], rotation, **others)

    @classmethod
    def from_roll_pitch_yaw(
        cls, interior: Interior, position: ArrayLike, roll: float, pitch: float, yaw: float, **others: Any
    ) -> Self:
        """Make the camera of a platform at lon, lat (degrees), ellipsoidal height with angles in radians.

        The platform's axes are forward, right, down; yaw is the heading from true north clockwise, pitch lifts the
        nose, roll lowers the right wing. At zero the camera looks straight down with the image's top forward.
        """
        place = np.asarray(position, dtype=np.float64)[None]
        axes = enu_from_ecef(place)[0]
        ned_from_ecef = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]) @ axes
        rotation = camera_from_platform(roll, pitch, yaw) @ ned_from_ecef
        return cls.from_geocentric(interior, geocentric(place)[0], rotation, **others)

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
        """Centre and half-size of the box that the frame sees between `heights`, as far as rays are not too flat."""
        seen, steep = self._seen()
        if not steep.any():
            # Start values may look anywhere; what they are meant for is then below the camera.
            seen, steep = self._below(), np.ones(4, dtype=bool)
        low, high = seen[steep].min(axis=0), seen[steep].max(axis=0)
        low[2], high[2] = self.heights
        return (low + high) / 2, (high - low) / 2

    @property
    def sees_ground(self) -> bool:
        """Whether any of its rays meets the ground between `heights`; start values may look past it."""
        return bool(self._seen()[1].any())

    @property
    def corners(self) -> Array:
        """Ground points ``(8, 3)`` of the corners of the image at both ends of `heights`; NaN where none is seen.

        The box of `domain` lies along the axes of the ground: its corners are far outside of an image that is not.
        """
        size = (self.interior.width, self.interior.height)
        image = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]) * size
        return np.concatenate([self.image_to_ground(image, height) for height in self.heights])

    @property
    def perspective_centre(self) -> Array:
        """Position ``(3,)`` of the camera in the CRS of the ground."""
        if self.frame == MAP:
            return self.exterior[:3].copy()
        axes, zero = self._local
        return geodetic((zero + self.exterior[:3] @ axes)[None])[0]

    @property
    def rotation(self) -> Array:
        """Rotation ``(3, 3)`` from the working frame to the camera, M of equation 3."""
        return rotation_of_angles(*self.exterior[3:].tolist())

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
        values = self._values | dict(zip(self.free, np.asarray(params, dtype=np.float64).tolist(), strict=True))
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
        """Project ground points ``(N, 3)``; NaN behind the camera, beyond the horizon or beyond the lens model."""
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            return self.interior.image_of(_directions(self._in_camera(as_ground(ground))))

    def ground_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(ground) as ``(N, 2, 3)``, in closed form."""
        ground = as_ground(ground)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            moved = np.broadcast_to(np.eye(3), (len(ground), 3, 3)) if self.frame == MAP else self._spread(ground)
            if self.refraction:
                up = self._verticals(ground)
                _, by_height, by_point, _ = self._lift(ground, self._working(ground), up)
                rise = np.einsum("ni,nij->nj", by_point, moved)
                rise[:, 2] += by_height
                moved = moved + up[:, :, None] * rise[:, None, :]
            return self._image_by_camera(self._in_camera(ground)) @ (self.rotation @ moved)

    def param_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(params) as ``(N, 2, P)``, in closed form."""
        ground = as_ground(ground)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            w, rotation = self._in_camera(ground), self.rotation
            by_camera = self._image_by_camera(w)
            moved = np.empty((len(ground), 3, 6))
            moved[:, :, :3] = -rotation
            if self.refraction:
                up = self._verticals(ground)
                *_, by_centre = self._lift(ground, self._working(ground), up)
                moved[:, :, :3] += (up @ rotation.T)[:, :, None] * by_centre[:, None]
            axes = (rotation[:, 0], np.array([*_second_axis(self.exterior[5])]), np.array([0.0, 0.0, 1.0]))
            for column, axis in enumerate(axes, start=3):
                moved[:, :, column] = np.cross(w, axis)
            partials = by_camera @ moved
            if not set(self.free) <= set(EXTERIOR):
                partials = np.concatenate([partials, self.interior.partials(_directions(w))], axis=2)
        return partials[:, :, [PARAMETERS.index(name) for name in self.free]]

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Follow the rays of image points ``(N, 2)`` to an ellipsoidal height; NaN where they do not get there."""
        image = as_image(image)
        wanted = np.broadcast_to(np.asarray(height, dtype=np.float64), (len(image),))
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            ground = self._meet(image, wanted)
            for _ in range(_LIFT_STEPS if self.refraction else 0):
                before = ground
                lift, *_ = self._lift(ground, self._working(ground), self._verticals(ground))
                ground = self._meet(image, wanted, lift)
                if not (np.abs(ground - before)[:, :2] > 1e-15 * np.abs(ground[:, :2])).any():
                    break
            hidden = ~np.isfinite(self._in_camera(ground)).all(axis=1)
        ground[hidden | ~np.isfinite(wanted)] = np.nan
        return ground

    def _meet(self, image: Array, wanted: Array, lift: Array | float = 0.0) -> Array:
        u, v = self.interior.directions_of(image).T
        way = np.stack([u, -v, -np.ones_like(u)], axis=1) @ self.rotation
        way /= np.linalg.norm(way, axis=1)[:, None]
        if self.frame == MAP:
            distance = (wanted + lift - self.exterior[2]) / way[:, 2]
            ground = self.exterior[:3] + distance[:, None] * way
            ground[~(distance > 0)] = np.nan
        else:
            axes, zero = self._local
            start = np.broadcast_to(zero + self.exterior[:3] @ axes, way.shape)
            ground = meet_height(start, way @ axes, wanted + lift)
            # Beside the antimeridian, stay on the side of the origin.
            ground[:, 0] = self.origin[0] + np.remainder(ground[:, 0] - self.origin[0] + 180.0, 360.0) - 180.0
        ground[np.isfinite(ground[:, 2]), 2] = wanted[np.isfinite(ground[:, 2])]
        return ground

    # -- files -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain data, numbers by their names."""
        data = super().to_dict()
        data["interior"] = self.interior.to_dict()
        data["exterior"] = dict(zip(EXTERIOR, self.exterior.tolist(), strict=True))
        return data

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make the model from what `to_dict` returned."""
        interior, exterior = data.get("interior"), data.get("exterior")
        if not isinstance(interior, dict) or not isinstance(exterior, dict) or set(exterior) != set(EXTERIOR):
            raise InputError("a frame camera has an interior and an exterior orientation", field="interior, exterior")
        values = np.array([exterior[name] for name in EXTERIOR], dtype=np.float64)
        return super().from_dict({**data, "interior": Interior(**interior), "exterior": values})

    # -- pieces ------------------------------------------------------------------------------------------------------

    @cached_property
    def _local(self) -> tuple[Array, Array]:
        """The rotation from ECEF to the topocentric axes and the origin in ECEF."""
        origin = np.array([self.origin])
        return enu_from_ecef(origin)[0], geocentric(origin)[0]

    def _working(self, ground: Array) -> Array:
        if self.frame == MAP:
            return ground
        axes, zero = self._local
        return (geocentric(ground) - zero) @ axes.T

    def _seen(self) -> tuple[Array, np.ndarray]:
        """Return ground points ``(98, 3)`` of 7 x 7 pixels at both ends of `heights`, and which rays are steep."""
        fractions = np.stack(np.meshgrid(*[np.linspace(0, 1, 7)] * 2), axis=-1).reshape(-1, 2)
        image = fractions * (self.interior.width, self.interior.height)
        seen = np.concatenate([self.image_to_ground(image, height) for height in self.heights])
        return seen, self._steepness(seen) > _FLATTEST

    def _verticals(self, ground: Array) -> Array:
        """Return the upward directions at ground points in the working frame ``(N, 3)``."""
        if self.frame == MAP:
            return np.broadcast_to([0.0, 0.0, 1.0], ground.shape)
        return enu_from_ecef(ground)[:, 2] @ self._local[0].T

    def _spread(self, ground: Array) -> Array:
        """Return d(topocentric)/d(lon, lat, height) as ``(N, 3, 3)``."""
        return horizon_from_geodetic(ground, np.array(self.origin))[1]

    def _in_camera(self, ground: Array) -> Array:
        """Return the vectors ``(N, 3)`` from camera to points in its axes; NaN where it cannot see them."""
        place = self._working(ground)
        line = place - self.exterior[:3]
        hidden = self._behind_the_earth(ground, place, line)
        if self.refraction:
            up = self._verticals(ground)
            line = line + self._lift(ground, place, up)[0][:, None] * up
        w = line @ self.rotation.T
        w[~(w[:, 2] < 0) | hidden] = np.nan
        return w

    def _behind_the_earth(self, ground: Array, place: Array, line: Array) -> np.ndarray:
        """Tell which lines of sight go through the Earth before they reach the point."""
        if self.frame == MAP:
            return np.zeros(len(ground), dtype=bool)
        axes, zero = self._local
        radial = place + axes @ zero
        length2 = (line**2).sum(axis=1)
        # Distance from the point back along the line to where it is nearest to the Earth's centre, times its length.
        back = (radial * line).sum(axis=1)
        nearest2 = (radial**2).sum(axis=1) - back**2 / length2
        sea_level = np.linalg.norm(radial, axis=1) - ground[:, 2]
        return (back > 0) & (back < length2) & (nearest2 < sea_level**2)

    def _lift(self, ground: Array, place: Array, up: Array) -> tuple[Array, Array, Array, Array]:
        """Return the refraction's lift ``(N,)`` (m) and its derivatives.

        By the point's height ``(N,)``, by the point through the zenith angle ``(N, 3)``, by the camera ``(N, 3)``.
        """
        line = self.exterior[:3] - place
        distance = np.linalg.norm(line, axis=1)[:, None]
        towards = line / distance
        cosine = np.maximum((towards * up).sum(axis=1), _FLATTEST)
        top = self.perspective_centre[2]
        below, above = (REFRACTIVITY * np.exp(-h / SCALE_HEIGHT) for h in (ground[:, 2], top))
        bend = SCALE_HEIGHT * (below - above) - above * (top - ground[:, 2])
        by_cosine = (-2 * bend / cosine**3)[:, None]
        by_towards = (up - cosine[:, None] * towards) / distance
        # The vertical at the point turns with it, by the curvature of the Earth.
        curvature = 0.0 if self.frame == MAP else 1.0 / SEMI_MAJOR
        by_point = by_cosine * (curvature * (towards - cosine[:, None] * up) - by_towards)
        by_centre = by_cosine * by_towards + (above / SCALE_HEIGHT * (top - ground[:, 2]) / cosine**2)[:, None] * up
        return bend / cosine**2, (above - below) / cosine**2, by_point, by_centre

    def _image_by_camera(self, w: Array) -> Array:
        """Return d(image)/d(vector in camera axes) ``(N, 2, 3)`` at such vectors ``(N, 3)``."""
        by_direction = np.zeros((len(w), 2, 3))
        by_direction[:, 0, 0] = -1 / w[:, 2]
        by_direction[:, 1, 1] = 1 / w[:, 2]
        by_direction[:, 0, 2] = w[:, 0] / w[:, 2] ** 2
        by_direction[:, 1, 2] = -w[:, 1] / w[:, 2] ** 2
        return self.interior.partials_of_direction(_directions(w)) @ by_direction

    def _steepness(self, ground: Array) -> Array:
        """Return the cosines of the zenith angles ``(N,)`` of the camera at ground points."""
        line = self.exterior[:3] - self._working(ground)
        with np.errstate(invalid="ignore"):
            return np.abs((line * self._verticals(ground)).sum(axis=1)) / np.linalg.norm(line, axis=1)

    def _below(self) -> Array:
        """Return the corners ``(4, 3)`` of a square under the camera as wide as the field of view."""
        centre = self.perspective_centre
        reach = max(abs(centre[2] - sum(self.heights) / 2), 1.0) * math.tan(min(self.interior.field_of_view, 1.4))
        degrees = np.ones(2) if self.frame == MAP else metres_per_degree(np.array([[*centre[:2], 0.0]]))[0]
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * reach / degrees
        return np.column_stack([centre[:2] + corners, np.full(4, self.heights[0])])


def exterior_sigmas(position: float | None, angle: float | None) -> dict[str, float]:
    """Return standard deviations by parameter: of the position (m) and the angles (rad), as far as they are known."""
    known = {EXTERIOR[:3]: position, EXTERIOR[3:]: angle}
    return {name: sigma for names, sigma in known.items() if sigma is not None for name in names}


def _directions(w: Array) -> Array:
    """Return the tangents to the right and downwards ``(N, 2)`` of vectors in camera axes."""
    return np.stack([-w[:, 0] / w[:, 2], w[:, 1] / w[:, 2]], axis=1)


def _second_axis(kappa: float) -> tuple[float, float, float]:
    # What phi turns about, seen in the camera: the second axis after kappa.
    return math.sin(kappa), math.cos(kappa), 0.0


def _require_metres(crs: str) -> None:
    parsed = parse_crs(crs)
    if not parsed.is_projected or abs(parsed.axis_info[0].unit_conversion_factor - 1.0) > 1e-12:
        raise InputError(
            f"{parsed.name!r} is not a map projection in metres", field="CRS", remedy="give a projected CRS such as UTM"
        )
