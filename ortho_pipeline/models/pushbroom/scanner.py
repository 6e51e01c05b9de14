r"""Rigorous line scanner (pushbroom): every row has its own position and attitude.

The row coordinate r is exposed at :math:`t = r\,\Delta t`, so t is in seconds from the upper edge of the image. If the
last row was exposed first (agile satellites also scan against their flight), :math:`\Delta t` is negative. A ground
point P (ECEF) is seen at column x and row r where

.. math::

    \lambda\,(u(x), v(x), 1)^T = R_M^T \{ R_P^T(t)\, R_O^T\, [P - S(t)] - C_M \}, \qquad \lambda > 0 .

The paper refers to others for the axes:

- **orbital** (:math:`R_O`: its axes in ECEF as columns, constant): X forward, along the path in the middle of the
  scene; Z up, away from the Earth's centre; Y left. The path is :math:`S(t) = S_O + R_O\, s(t)`. `s` is a spline
  (along, across, radial; metres), so its parameters are small and physical.
- **platform**: :math:`R_P = R_Z(yaw) R_Y(pitch) R_X(roll)` rotates it to the orbital axes; at zero both are parallel.
  Right-handed: positive roll looks left, positive pitch backwards, positive yaw turns forward to the left.
- **camera** (:math:`R_M`): x along the line to the left of the flight, y forward, z to the ground; see
  `ortho_pipeline.models.pushbroom.line_camera` for u, v. :math:`C_M` is the camera's position in the platform (metres).

If the attitude does not include aberration and refraction, `light` adds those of `ortho_pipeline.models.light.path`.

Path and attitude are the splines, plus an offset and a drift per second about the middle of the scene. These are the
systematic errors of a vendor's tables; the observations are without them. Beyond its knots the path continues with its
curvature, the attitude with its slope.

R_O is constant in ECEF. The platform of a camera that points to the ground turns relative to it at the orbital rate, so
pitch grows by a milliradian per second.

Source: Willneff et al., equations 3 and 4 and section 3.3; Weser et al. 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike

from ortho_pipeline.errors import InputError
from ortho_pipeline.geodesy.ellipsoid import (
    ECCENTRICITY_SQUARED,
    SEMI_MAJOR,
    enu_from_ecef,
    geocentric,
    longitudes_near,
    meet_height,
    metres_per_degree,
)
from ortho_pipeline.models.base import (
    Array,
    Constraints,
    SensorModel,
    as_ground,
    as_heights,
    as_image,
    as_params,
    box_around,
    checked_names,
    ground_of_grid,
)
from ortho_pipeline.models.light import AS_GIVEN, LightPath
from ortho_pipeline.models.pushbroom import kernel as pushbroom_kernel
from ortho_pipeline.models.pushbroom.constraints import Observations, OrbitShape, joined
from ortho_pipeline.models.pushbroom.flight import Flight
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.parameters import Parameters
from ortho_pipeline.models.pushbroom.rotations import exact_rotation, rotations, turning_axes
from ortho_pipeline.models.pushbroom.splines import Spline

#: Newton's last step (px); the remaining error is far smaller.
_LAST_STEP = 1e-5
#: Distance from the middle of the image, in half-sizes, up to which image points are computed.
_REACH = 3.0


@dataclass(frozen=True, eq=False)
class Pushbroom(SensorModel):
    """A line scanner. `pushbroom_of_tables` and `pushbroom_of_metadata` make one from a vendor's data.

    Parameters
    ----------
    camera : LineCamera
    line_period : float
        Seconds from row to row; negative if the last row was exposed first.
    origin : (3,)
        S_O, the origin (ECEF, m) of the path.
    orbital, mounting : (3, 3)
        R_O and R_M.
    path, attitude : Spline
        s (m) and roll, pitch, yaw (rad).
    lever : (3,)
        C_M.
    path_line, attitude_line : (2, 3)
        Offset and drift per second of path and attitude.
    heights : (float, float)
        Lowest and highest ellipsoidal height (m) of the ground.
    free : tuple of str
        Names of the parameters that an adjustment may change; see `freed`.
    shape : OrbitShape
    path_observations, attitude_observations : tuple of Observations
        Prior knowledge, which `constraints` adds to an adjustment.
    light : LightPath
        Aberration and refraction that the attitude does not include.
    """

    kind: ClassVar[str] = "pushbroom"

    camera: LineCamera
    line_period: float
    origin: Array
    orbital: Array
    mounting: Array
    path: Spline
    attitude: Spline
    lever: Array
    path_line: Array
    attitude_line: Array
    heights: tuple[float, float]
    free: tuple[str, ...]
    shape: OrbitShape
    path_observations: tuple[Observations, ...] = ()
    attitude_observations: tuple[Observations, ...] = ()
    light: LightPath = AS_GIVEN

    def __post_init__(self) -> None:
        shapes = {"origin": (3,), "orbital": (3, 3), "mounting": (3, 3), "lever": (3,), "path_line": (2, 3)}
        for name, shape in {**shapes, "attitude_line": (2, 3)}.items():
            object.__setattr__(self, name, _finite(getattr(self, name), shape, name))
        for name in ("orbital", "mounting"):
            object.__setattr__(self, name, exact_rotation(getattr(self, name), name))
        object.__setattr__(self, "line_period", float(self.line_period))
        if not (math.isfinite(self.line_period) and self.line_period):
            raise InputError(f"{self.line_period} s is not a line period", field="line_period")
        low, high = (float(value) for value in self.heights)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"heights from {low} to {high} are not a range", field="heights")
        object.__setattr__(self, "heights", (low, high))
        object.__setattr__(self, "free", checked_names(self.free, self.parameters.names, "of this model"))

    # -- what the host asks ------------------------------------------------------------------------------------------

    @property
    def crs(self) -> str:
        """CRS of the ground."""
        return "EPSG:4979"

    @property
    def height_range(self) -> tuple[float, float]:
        """Lowest and highest ellipsoidal height of the ground."""
        return self.heights

    def with_heights(self, low: float, high: float) -> Self:
        """Return the camera for ground between two ellipsoidal heights (m)."""
        return self._replace(heights=(low, high))

    @property
    def corners(self) -> Array:
        """Ground points ``(8, 3)`` of the corners of the image at both ends of `heights`; NaN where none is seen."""
        return ground_of_grid(self, self.camera.size, 2, self.heights)

    @cached_property
    def domain(self) -> tuple[Array, Array]:
        """Centre and half-size of the box that the image sees between `heights`."""
        seen = ground_of_grid(self, self.camera.size, 5, self.heights)
        if not np.isfinite(seen).any():
            raise InputError("this camera does not see the Earth", field="attitude", remedy="copy its file again")
        return box_around(seen, self.heights)

    @property
    def detail(self) -> float:
        """Shortest distance (px) between two knots of path or attitude."""
        shortest = min(np.diff(spline.breaks).min() for spline in (self.path, self.attitude))
        return float(shortest / abs(self.line_period))

    @property
    def minimum_points(self) -> int:
        """Least number of control points that, with the pseudo-observations, determine all parameters."""
        return max(1, -(-(len(self.free) - len(self.constraints())) // 2)) if self.free else 0

    # -- parameters --------------------------------------------------------------------------------------------------

    @cached_property
    def parameters(self) -> Parameters:
        """Names and order of all parameters, free or not."""
        return Parameters(self.path.size, self.attitude.size, self.camera.names)

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of all parameters, by group.

        The groups are path, attitude (coefficients of the splines), path_offset, path_drift, attitude_offset,
        attitude_drift, camera.
        """
        return self.parameters.groups

    def freed(self, *names: str) -> Self:
        """Return this model with only these parameters free; a name is that of a group or of a parameter."""
        free = [single for name in names for single in self.groups.get(name, (name,))]
        return self._replace(free=tuple(dict.fromkeys(free)))

    @cached_property
    def _columns(self) -> list[int]:
        return self.parameters.places(self.free)

    @cached_property
    def _values(self) -> Array:
        splines = [self.path.coefficients, self.attitude.coefficients, self.path_line, self.attitude_line]
        return np.concatenate([*(part.ravel() for part in splines), self.camera.values])

    @property
    def param_names(self) -> tuple[str, ...]:
        """The free parameters: metres, radians (and per second for drifts), pixels."""
        return self.free

    @property
    def params(self) -> Array:
        """Values of the free parameters."""
        return self._values[self._columns]

    def with_params(self, params: ArrayLike) -> Self:
        """Return the model with other values of the free parameters.

        Raises
        ------
        ValueError
            If one of them is not finite.
        """
        values = self._values.copy()
        values[self._columns] = as_params(params, self.param_names)
        if not np.isfinite(values).all():
            raise ValueError("a parameter is not finite")
        path, attitude, path_line, attitude_line, camera = self.parameters.split(values)
        return self._replace(
            path=self.path.with_coefficients(path),
            attitude=self.attitude.with_coefficients(attitude),
            path_line=path_line,
            attitude_line=attitude_line,
            camera=self.camera.with_values(camera),
        )

    def constraints(self) -> Constraints:
        """Return the soft constraints of the orbit and the observations of path and attitude."""
        return _pseudo_observations(self)

    # -- the map -----------------------------------------------------------------------------------------------------

    @cached_property
    def flight(self) -> Flight:
        """Path and attitude with their offsets and drifts."""
        duration = self.camera.height * self.line_period
        path, attitude = (
            spline.plus_line(line[0], line[1], duration / 2)
            for spline, line in ((self.path, self.path_line), (self.attitude, self.attitude_line))
        )
        return Flight(self.origin, self.orbital, path, attitude, duration)

    @cached_property
    def _limits(self) -> Array:
        """Lowest and highest column and time ``(2, 2)`` of computed points."""
        size = np.array([self.camera.width, self.flight.duration])
        return np.sort(np.stack([size * (1 - _REACH) / 2, size * (1 + _REACH) / 2], axis=1), axis=1)

    def ground_to_image(self, ground: ArrayLike) -> Array:
        """Project ground points ``(N, 3)``; NaN behind the Earth, and beyond three half-sizes of the image."""
        ground = as_ground(ground)
        image = np.empty((len(ground), 2))
        pushbroom_kernel.project(ground, self.flight.trajectory, _compiled_camera(self), self._limits, image)
        return image

    def rays(self, image: ArrayLike) -> tuple[Array, Array]:
        """Return origins and unit directions ``(N, 3)`` in ECEF of the rays of image points ``(N, 2)``, in space."""
        image = as_image(image)
        low, high = self._limits.T
        times = image[:, 1] * self.line_period
        with np.errstate(invalid="ignore"):
            good = (image[:, 0] >= low[0]) & (image[:, 0] <= high[0]) & (times >= low[1]) & (times <= high[1])
        column, times = np.where(good, image[:, 0], np.nan), np.where(good, times, np.nan)
        look = np.column_stack([self.camera.directions(column), np.ones(len(image))])
        look /= np.linalg.norm(look, axis=1)[:, None]
        origin, direction = self.flight.lines(times, look @ self.mounting.T, self.lever)
        return origin, self.light.straight(direction, self.flight.positions(times, 1))

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Intersect the rays of image points ``(N, 2)`` with an ellipsoidal height; NaN where they miss."""
        origin, direction = self.rays(image)
        heights = as_heights(height, len(origin))
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            ground = meet_height(origin, direction, heights)
            if self.light.refraction:
                cosine = -(enu_from_ecef(ground)[:, 2] * direction).sum(axis=1)
                ground = meet_height(origin, direction, heights + self.light.lift(heights, cosine))
            # Near the antimeridian, stay on the side of the sub-satellite point.
            foot = math.degrees(math.atan2(self.origin[1], self.origin[0]))
            ground[:, 0] = longitudes_near(ground[:, 0], foot)
            # Above the satellite a ray meets the height only where it leaves the Earth again.
            good = (enu_from_ecef(ground)[:, 2] * direction).sum(axis=1) < 0
        ground[good, 2] = heights[good]
        ground[~good] = np.nan
        return ground

    def ground_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(ground) as ``(N, 2, 3)``, in closed form."""
        return _by_ground(self, as_ground(ground))

    def param_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(params) as ``(N, 2, P)``, in closed form."""
        return _by_params(self, as_ground(ground))

    # -- files -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain data."""
        data = super().to_dict()
        for name in ("camera", "path", "attitude", "shape"):
            data[name] = getattr(self, name).to_dict()
        for name in ("path_observations", "attitude_observations"):
            data[name] = [table.to_dict() for table in getattr(self, name)]
        # Without `light`, files are the same as those of older versions.
        data.pop("light", None)
        return data | ({} if self.light == AS_GIVEN else {"light": self.light.to_dict()})

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make the model from the result of `to_dict`."""
        return super().from_dict({**data, **_parts(data)})


def _parts(data: dict[str, Any]) -> dict[str, Any]:
    """Return the parts of a model from its plain data."""
    parts: dict[str, Any] = {}
    for name, make in (("camera", LineCamera), ("path", Spline), ("attitude", Spline), ("shape", OrbitShape)):
        if not isinstance(data.get(name), dict):
            raise InputError(f"a pushbroom model needs its {name}", field=name)
        parts[name] = make(**data[name])
    for name in ("path_observations", "attitude_observations"):
        if not isinstance(data.get(name), list | tuple):
            raise InputError("this must be a list of tables; it may be empty", field=name)
        parts[name] = tuple(Observations(**table) for table in data[name])
    if not isinstance(light := data.get("light", {}), dict):
        raise InputError("this must be aberration and refraction", field="light")
    parts["light"] = LightPath(**light)
    return parts


def _finite(value: Array, shape: tuple[int, ...], field: str) -> Array:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(f"{shape} finite numbers are needed, not {array.shape}", field=field)
    array.setflags(write=False)
    return array


def _compiled_camera(model: Pushbroom) -> pushbroom_kernel.Camera:
    """Return the camera for the compiled projection."""
    camera = model.camera
    numbers = np.array(
        [
            camera.principal_column,
            camera.principal_line,
            camera.focal_length,
            camera.width,
            model.line_period,
            SEMI_MAJOR,
            ECCENTRICITY_SQUARED,
            _LAST_STEP,
            *model.light.numbers,
        ]
    )
    return pushbroom_kernel.Camera(model.mounting, model.lever, numbers, camera.dx, camera.dy)


def _by_ground(model: Pushbroom, ground: Array) -> Array:
    """Return d(image)/d(ground) as ``(N, 2, 3)``."""
    state = _State(model, ground)
    moved = np.swapaxes(enu_from_ecef(ground), 1, 2).copy()
    moved[:, :, :2] *= metres_per_degree(ground)[:, None, :]
    moved[:, :, 2] *= model.light.rise(ground[:, 2], state.cosine)[:, None]
    by_camera = model.mounting.T @ state.by_line @ model.orbital.T
    return state.image_by(by_camera @ moved)


def _by_params(model: Pushbroom, ground: Array) -> Array:
    """Return d(image)/d(params) as ``(N, 2, P)``."""
    state, parameters = _State(model, ground), model.parameters
    place = {column: at for at, column in enumerate(parameters.places(model.free))}
    by_vector = np.zeros((len(ground), 3, len(place)))
    groups = (
        ("path", model.path, 0, -(model.mounting.T @ state.by_line)),
        ("path", model.path, 1, model.mounting.T @ state.by_velocity),
        ("attitude", model.attitude, 0, model.mounting.T @ state.by_angles),
    )
    for group, spline, derivative, slopes in groups:
        for first, weights in parameters.triples(group, model.flight.basis(spline, state.times, derivative)):
            for axis in range(3):
                if (at := place.get(first + axis)) is not None:
                    by_vector[:, :, at] += slopes[:, :, axis] * weights[:, None]
    inner = np.zeros((len(ground), 2, len(place)))
    start = parameters.first["camera"]
    camera = [(column - start, at) for column, at in place.items() if column >= start]
    if camera:
        theirs, ours = (list(side) for side in zip(*camera, strict=True))
        inner[:, :, ours] = model.camera.partials(state.column)[:, :, theirs]
    return state.image_by(by_vector, inner)


def _pseudo_observations(model: Pushbroom) -> Constraints:
    """Return the soft constraints of the orbit and the observations of path and attitude, by the free parameters."""
    parameters, columns = model.parameters, model.parameters.places(model.free)
    count = len(parameters.names)

    def position(times: Array, derivative: int) -> tuple[Array, Array]:
        """Return S or dS/dt in ECEF ``(N, 3)`` and its partials by all parameters ``(N, 3, P)``."""
        slopes = np.zeros((len(times), 3, count))
        for first, weights in parameters.triples("path", model.flight.basis(model.path, times, derivative)):
            slopes[:, :, first : first + 3] = model.orbital * weights[:, None, None]
        return model.flight.positions(times, derivative), slopes

    parts = [model.shape.of(position, (0.0, model.flight.duration))]
    for spline, group, tables in (
        (model.path, "path", model.path_observations),
        (model.attitude, "attitude", model.attitude_observations),
    ):
        parts += [table.of(spline, parameters.first[group], count) for table in tables]
    soft = joined(parts, count)
    # Drop observations that no free parameter can change.
    kept = soft.jacobian[:, columns].any(axis=1)
    return Constraints(soft.residuals[kept], soft.jacobian[kept][:, columns], soft.sigma[kept], soft.fictitious[kept])


class _State:
    """Vectors of ground points in camera axes, and the derivatives of the image by them."""

    def __init__(self, model: Pushbroom, ground: Array) -> None:
        image, flight = model.ground_to_image(ground), model.flight
        self.model, self.column, self.times = model, image[:, 0], image[:, 1] * model.line_period
        angles, rates = flight.attitude(self.times), flight.attitude(self.times, 1)
        self.turn = rotations(angles)
        rate, up = flight.path(self.times, 1), enu_from_ecef(ground)[:, 2] @ flight.orbital
        line = (geocentric(ground) - flight.origin) @ flight.orbital - flight.path(self.times)
        #: Cosine of the zenith angle at the point.
        self.cosine = -(line * up).sum(axis=1) / np.linalg.norm(line, axis=1)
        back = np.swapaxes(self.turn, 1, 2)
        #: d(vector in platform axes)/d(line from the camera to the point)
        self.by_line = model.light.turned(back, line, rate)
        #: d(vector in platform axes)/d(velocity of the camera)
        self.by_velocity = model.light.by_velocity(back, line)
        line = model.light.apparent(line, rate, up, ground[:, 2])
        place = np.einsum("nij,nj->ni", back, line)
        #: d(vector in platform axes)/d(roll, pitch, yaw)
        self.by_angles = -np.cross(np.swapaxes(turning_axes(angles), 1, 2), place[:, None, :]).swapaxes(1, 2)
        self.vector = (place - model.lever) @ model.mounting
        rate = np.einsum("nij,nj->ni", self.by_angles, rates) - np.einsum("nij,nj->ni", self.by_line, rate)
        x, y, z = self.vector.T
        zero, one = np.zeros_like(z), np.ones_like(z)
        #: d(u, v)/d(vector in camera axes)
        with np.errstate(divide="ignore", invalid="ignore"):
            self.by_vector = (
                np.stack([one, zero, -x / z, zero, one, -y / z], axis=1).reshape(-1, 2, 3) / z[:, None, None]
            )
        flow = np.einsum("nij,nj->ni", self.by_vector, rate @ model.mounting)
        slopes = model.camera.slopes(self.column)
        with np.errstate(divide="ignore", invalid="ignore"):
            # The columns of [d(u, v)/dx, -d(u, v)/dt], inverted.
            scale = 1 / (slopes[:, 1] * flow[:, 0] - slopes[:, 0] * flow[:, 1])
            self.solved = np.stack([-flow[:, 1], flow[:, 0], -slopes[:, 1], slopes[:, 0]], axis=1).reshape(-1, 2, 2)
            self.solved *= scale[:, None, None]
        self.solved[:, 1] /= model.line_period

    def image_by(self, vector: Array, look: Array | float = 0.0) -> Array:
        """Return d(image) ``(N, 2, P)`` for changes of the vector ``(N, 3, P)`` and of u, v ``(N, 2, P)``."""
        changed: Array = self.solved @ (self.by_vector @ vector - look)
        return changed
