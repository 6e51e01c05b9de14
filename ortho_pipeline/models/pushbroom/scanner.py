r"""Rigorous line scanner (pushbroom): every row has its own position and attitude.

The row coordinate r is exposed at :math:`t = r\,\Delta t`, so t counts seconds from the upper edge of the image. A
ground point P (ECEF) is seen in column x and row r where

.. math::

    \lambda\,(u(x), v(x), 1)^T = R_M^T \{ R_P^T(t)\, R_O^T\, [P - S(t)] - C_M \}, \qquad \lambda > 0 .

Axes, which the paper leaves to its references:

- **orbital** (:math:`R_O`: its axes in ECEF as columns, constant): X forward, along the path in the middle of the
  scene; Z up, away from the Earth's centre; Y to the left. The path is :math:`S(t) = S_O + R_O\, s(t)` with `s`
  (along, across, radial; metres) a spline, which keeps its parameters small and physical.
- **platform**: :math:`R_P = R_Z(yaw) R_Y(pitch) R_X(roll)` turns it into the orbital axes; at zero they are parallel.
  Right-handed: positive roll looks to the left, positive pitch backwards, positive yaw turns forward to the left.
- **camera** (:math:`R_M`): x along the line to the left of the flight, y forward, z to the ground; see
  `ortho_pipeline.models.pushbroom.line_camera` for u, v. :math:`C_M` is the camera's place in the platform (metres).

Path and attitude are the splines plus an offset and a drift per second about the middle of the scene: the systematic
part of a vendor's tables, which those observe without. Beyond its knots the path goes on with its curvature, the
attitude with its slope.

R_O is constant in ECEF, so the platform of a camera that points to the ground turns against it by the orbital rate:
pitch grows by a milliradian per second.

Source: Willneff et al., equations 3 and 4 and section 3.3; Weser et al. 2007.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
    meet_height,
    metres_per_degree,
)
from ortho_pipeline.models.base import Array, Constraints, SensorModel, as_ground, as_image
from ortho_pipeline.models.pushbroom import kernel as pushbroom_kernel
from ortho_pipeline.models.pushbroom.constraints import Observations, OrbitShape, joined
from ortho_pipeline.models.pushbroom.line_camera import LineCamera
from ortho_pipeline.models.pushbroom.rotations import are_rotations, rotations, turning_axes
from ortho_pipeline.models.pushbroom.splines import Spline

#: Components of the path (m) and of the attitude (rad).
PATH, ATTITUDE = ("along", "across", "radial"), ("roll", "pitch", "yaw")
#: Newton's last step (pixels): what it leaves is far smaller.
_LAST_STEP = 1e-5
#: Image points are found as far as this many half-sizes from the middle of the image.
_REACH = 3.0


@dataclass(frozen=True, eq=False)
class Pushbroom(SensorModel):
    """A line scanner; `ortho_pipeline.models.pushbroom.start` makes one of metadata or of the vendor's tables.

    Parameters
    ----------
    camera : LineCamera
    line_period : float
        Seconds from row to row.
    origin : (3,)
        S_O, the place (ECEF, m) about which the path is given.
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
        What is known beforehand: `constraints` brings it into an adjustment.
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

    def __post_init__(self) -> None:
        shapes = {"origin": (3,), "orbital": (3, 3), "mounting": (3, 3), "lever": (3,), "path_line": (2, 3)}
        for name, shape in {**shapes, "attitude_line": (2, 3)}.items():
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise InputError(f"{shape} finite numbers are needed, not {value.shape}", field=name)
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        for name in ("orbital", "mounting"):
            axes = getattr(self, name)
            if not are_rotations(axes[None]):
                raise InputError("this matrix is not a rotation", field=name)
            # A matrix with printed digits is none exactly, and its inverse would be another than its transpose.
            if np.abs(axes.T @ axes - np.eye(3)).max() > 1e-12:
                left, _, right = np.linalg.svd(axes)
                axes = left @ right
                axes.setflags(write=False)
                object.__setattr__(self, name, axes)
        object.__setattr__(self, "line_period", float(self.line_period))
        if not (math.isfinite(self.line_period) and self.line_period > 0):
            raise InputError("the line period is positive", field="line_period")
        low, high = (float(value) for value in self.heights)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"heights from {low} to {high} are not a range", field="heights")
        object.__setattr__(self, "heights", (low, high))
        object.__setattr__(self, "free", tuple(self.free))
        unknown = sorted(set(self.free) - set(self._names))
        if unknown or len(set(self.free)) != len(self.free):
            raise InputError("free parameters are different names of this model", field=", ".join(unknown) or "free")

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
        return self._seen(2)

    @cached_property
    def domain(self) -> tuple[Array, Array]:
        """Centre and half-size of the box that the image sees between `heights`."""
        seen = self._seen(5)
        if not np.isfinite(seen).any():
            raise InputError("this camera does not see the Earth", field="attitude")
        low, high = np.nanmin(seen, axis=0), np.nanmax(seen, axis=0)
        low[2], high[2] = self.heights
        return (low + high) / 2, (high - low) / 2

    @property
    def detail(self) -> float:
        """Shortest distance (px) of two knots of path or attitude."""
        return float(min(np.diff(spline.breaks).min() for spline in (self.path, self.attitude)) / self.line_period)

    def _seen(self, count: int) -> Array:
        fractions = np.stack(np.meshgrid(*[np.linspace(0, 1, count)] * 2), axis=-1).reshape(-1, 2)
        image = fractions * (self.camera.width, self.camera.height)
        return np.concatenate([self.image_to_ground(image, height) for height in self.heights])

    @property
    def minimum_points(self) -> int:
        """Least number of control points that, with the pseudo-observations, determine all parameters."""
        return max(1, -(-(len(self.free) - len(self.constraints())) // 2)) if self.free else 0

    # -- parameters --------------------------------------------------------------------------------------------------

    @cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of all parameters, by the group under which `freed` takes them.

        The groups: path, attitude (coefficients of the splines), path_offset, path_drift, attitude_offset,
        attitude_drift, camera.
        """

        def coefficients(names: Sequence[str], count: int) -> tuple[str, ...]:
            return tuple(f"{name}_{k}" for k in range(count) for name in names)

        lines = {
            f"{group}_{what}": tuple(f"{name}_{what}" for name in names)
            for group, names in (("path", PATH), ("attitude", ATTITUDE))
            for what in ("offset", "drift")
        }
        splines = {
            "path": coefficients(PATH, self.path.size),
            "attitude": coefficients(ATTITUDE, self.attitude.size),
        }
        return {**splines, **lines, "camera": self.camera.names}

    def freed(self, *names: str) -> Self:
        """Return this model with these parameters free, and no others; a name is of a group or of a parameter."""
        free = [single for name in names for single in self.groups.get(name, (name,))]
        return self._replace(free=tuple(dict.fromkeys(free)))

    @cached_property
    def _names(self) -> tuple[str, ...]:
        return tuple(name for names in self.groups.values() for name in names)

    @cached_property
    def _columns(self) -> list[int]:
        place = {name: k for k, name in enumerate(self._names)}
        return [place[name] for name in self.free]

    @cached_property
    def _starts(self) -> dict[str, int]:
        ends = np.cumsum([0, *(len(names) for names in self.groups.values())])
        return dict(zip(self.groups, ends[:-1].tolist(), strict=True))

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
        values[self._columns] = np.asarray(params, dtype=np.float64)
        if not np.isfinite(values).all():
            raise ValueError("a parameter is not finite")
        sizes = np.cumsum([3 * self.path.size, 3 * self.attitude.size, 6, 6])
        path, attitude, path_line, attitude_line, camera = np.split(values, sizes)
        return self._replace(
            path=self.path.with_coefficients(path.reshape(-1, 3)),
            attitude=self.attitude.with_coefficients(attitude.reshape(-1, 3)),
            path_line=path_line.reshape(2, 3),
            attitude_line=attitude_line.reshape(2, 3),
            camera=self.camera.with_values(camera),
        )

    def constraints(self) -> Constraints:
        """Return the soft constraints of the orbit and the observations of path and attitude."""
        count, columns = len(self._names), self._columns
        parts = [self.shape.of(self._position, self._span)]
        for spline, start, tables in (
            (self.path, 0, self.path_observations),
            (self.attitude, self._starts["attitude"], self.attitude_observations),
        ):
            parts += [table.of(spline, start, count) for table in tables]
        found = joined(parts, count)
        # What no free parameter can change is not an observation of one.
        kept = found.jacobian[:, columns].any(axis=1)
        return Constraints(
            found.residuals[kept], found.jacobian[kept][:, columns], found.sigma[kept], found.fictitious[kept]
        )

    def _position(self, times: Array, derivative: int) -> tuple[Array, Array]:
        """Return S or dS/dt in ECEF ``(N, 3)`` and its partials by all parameters ``(N, 3, P)``."""
        value = self._path(times, derivative) @ self.orbital.T + (0.0 if derivative else self.origin)
        basis = self._basis(self.path, times, derivative)
        slopes = np.zeros((len(times), 3, len(self._names)))
        for first, weights in self._members("path", basis):
            slopes[:, :, first : first + 3] = self.orbital * weights[:, None, None]
        return value, slopes

    def _basis(self, spline: Spline, times: Array, derivative: int = 0) -> Array:
        """Return the weights ``(N, size + 2)`` of the coefficients, the offset and the drift."""
        line = [np.ones_like(times), times - self._middle] if not derivative else [0 * times, np.ones_like(times)]
        return np.column_stack([spline.basis(times, derivative), *line])

    def _members(self, group: str, basis: Array) -> list[tuple[int, Array]]:
        """Return, for each three parameters that move along the three axes, the first one and weights ``(N,)``."""
        firsts = [self._starts[group] + 3 * k for k in range(basis.shape[1] - 2)]
        firsts += [self._starts[f"{group}_offset"], self._starts[f"{group}_drift"]]
        return [(first, basis[:, k]) for k, first in enumerate(firsts)]

    # -- the map -----------------------------------------------------------------------------------------------------

    @property
    def _span(self) -> tuple[float, float]:
        return 0.0, self.camera.height * self.line_period

    @property
    def _middle(self) -> float:
        return self.camera.height * self.line_period / 2

    @cached_property
    def _path(self) -> Spline:
        return self.path.plus_line(self.path_line[0], self.path_line[1], self._middle)

    @cached_property
    def _attitude(self) -> Spline:
        return self.attitude.plus_line(self.attitude_line[0], self.attitude_line[1], self._middle)

    @cached_property
    def _limits(self) -> Array:
        """Lowest and highest column and time ``(2, 2)`` that are answered."""
        size = np.array([self.camera.width, 2 * self._middle])
        return np.stack([size * (1 - _REACH) / 2, size * (1 + _REACH) / 2], axis=1)

    @cached_property
    def _compiled(self) -> tuple[Array, ...]:
        """What the kernel reads of path and attitude: ends, origins and coefficients of their pieces."""
        splines = (self._path, self._attitude)
        ends = np.unique(np.concatenate([spline.breaks for spline in splines]))
        # The first piece holds before the first knot.
        origins = np.concatenate([[ends[0] - 1.0], ends])
        degree = max(spline.degree for spline in splines)
        pieces = np.zeros((len(origins), degree + 1, 6))
        for k, spline in enumerate(splines):
            pieces[:, : spline.degree + 1, 3 * k : 3 * k + 3] = spline.pieces(origins)
        return ends, origins, pieces

    def ground_to_image(self, ground: ArrayLike) -> Array:
        """Project ground points ``(N, 3)``; NaN behind the Earth and beyond three half-sizes of the image."""
        ground = as_ground(ground)
        image = np.empty((len(ground), 2))
        camera = self.camera
        numbers = np.array(
            [camera.principal_column, camera.principal_line, camera.focal_length, camera.width, self.line_period,
             SEMI_MAJOR, ECCENTRICITY_SQUARED, _LAST_STEP]
        )  # fmt: skip
        ends, origins, pieces = self._compiled
        pushbroom_kernel.project(
            ground,
            pushbroom_kernel.Trajectory(self.orbital, self.origin, ends, origins, pieces),
            pushbroom_kernel.Camera(self.mounting, self.lever, numbers, camera.dx, camera.dy),
            self._limits,
            image,
        )
        return image

    def rays(self, image: ArrayLike) -> tuple[Array, Array]:
        """Return origin and unit direction ``(N, 3)`` in ECEF of the rays of image points ``(N, 2)``."""
        image = as_image(image)
        low, high = self._limits.T
        times = image[:, 1] * self.line_period
        with np.errstate(invalid="ignore"):
            good = (image[:, 0] >= low[0]) & (image[:, 0] <= high[0]) & (times >= low[1]) & (times <= high[1])
        column, times = np.where(good, image[:, 0], np.nan), np.where(good, times, np.nan)
        look = np.column_stack([self.camera.directions(column), np.ones(len(image))])
        look /= np.linalg.norm(look, axis=1)[:, None]
        turn = rotations(self._attitude(times))
        direction = np.einsum("nij,nj->ni", turn, look @ self.mounting.T) @ self.orbital.T
        local = self._path(times) + turn @ self.lever
        return self.origin + local @ self.orbital.T, direction

    def image_to_ground(self, image: ArrayLike, height: ArrayLike) -> Array:
        """Follow the rays of image points ``(N, 2)`` to an ellipsoidal height; NaN where they do not get there."""
        origin, direction = self.rays(image)
        wanted = np.broadcast_to(np.asarray(height, dtype=np.float64), (len(origin),))
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            ground = meet_height(origin, direction, wanted)
            # Beside the antimeridian, stay on the side of the satellite's foot point.
            foot = math.degrees(math.atan2(self.origin[1], self.origin[0]))
            ground[:, 0] = foot + np.remainder(ground[:, 0] - foot + 180.0, 360.0) - 180.0
            # Beyond the satellite's own height the ray is only met where it leaves the Earth again.
            good = (enu_from_ecef(ground)[:, 2] * direction).sum(axis=1) < 0
        ground[good, 2] = wanted[good]
        ground[~good] = np.nan
        return ground

    # -- partials ----------------------------------------------------------------------------------------------------

    def ground_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(ground) as ``(N, 2, 3)``, in closed form."""
        ground = as_ground(ground)
        state = _State(self, ground)
        moved = np.swapaxes(enu_from_ecef(ground), 1, 2).copy()
        moved[:, :, :2] *= metres_per_degree(ground)[:, None, :]
        by_camera = self.mounting.T @ np.swapaxes(state.turn, 1, 2) @ self.orbital.T
        return state.image_by(by_camera @ moved)

    def param_partials(self, ground: ArrayLike) -> Array:
        """Return d(image)/d(params) as ``(N, 2, P)``, in closed form."""
        ground = as_ground(ground)
        state = _State(self, ground)
        place = {column: at for at, column in enumerate(self._columns)}
        by_vector = np.zeros((len(ground), 3, len(place)))
        groups = (
            ("path", self.path, -(self.mounting.T @ np.swapaxes(state.turn, 1, 2))),
            ("attitude", self.attitude, self.mounting.T @ state.by_angles),
        )
        for group, spline, slopes in groups:
            for first, weights in self._members(group, self._basis(spline, state.times)):
                for axis in range(3):
                    if (at := place.get(first + axis)) is not None:
                        by_vector[:, :, at] = slopes[:, :, axis] * weights[:, None]
        inner = np.zeros((len(ground), 2, len(place)))
        start = self._starts["camera"]
        camera = [(column - start, at) for column, at in place.items() if column >= start]
        if camera:
            theirs, ours = (list(side) for side in zip(*camera, strict=True))
            inner[:, :, ours] = self.camera.partials(state.column)[:, :, theirs]
        return state.image_by(by_vector, inner)

    # -- files -------------------------------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the model as plain data."""
        data = super().to_dict()
        for name in ("camera", "path", "attitude", "shape"):
            data[name] = getattr(self, name).to_dict()
        for name in ("path_observations", "attitude_observations"):
            data[name] = [table.to_dict() for table in getattr(self, name)]
        return data

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Make the model from what `to_dict` returned."""
        parts: dict[str, Any] = {}
        for name, make in (("camera", LineCamera), ("path", Spline), ("attitude", Spline), ("shape", OrbitShape)):
            if not isinstance(data.get(name), dict):
                raise InputError(f"a pushbroom has its {name}", field=name)
            parts[name] = make(**data[name])
        for name in ("path_observations", "attitude_observations"):
            if not isinstance(data.get(name), list | tuple):
                raise InputError("a list of tables belongs here, which may be empty", field=name)
            parts[name] = tuple(Observations(**table) for table in data[name])
        return super().from_dict({**data, **parts})


class _State:
    """Ground points as the camera sees them, and how their image follows from a change of what it sees."""

    def __init__(self, model: Pushbroom, ground: Array) -> None:
        image = model.ground_to_image(ground)
        self.model, self.column, self.times = model, image[:, 0], image[:, 1] * model.line_period
        angles, rates = model._attitude(self.times), model._attitude(self.times, 1)
        self.turn = rotations(angles)
        line = (geocentric(ground) - model.origin) @ model.orbital - model._path(self.times)
        back = np.swapaxes(self.turn, 1, 2)
        place = np.einsum("nij,nj->ni", back, line)
        #: d(vector in platform axes)/d(roll, pitch, yaw)
        self.by_angles = -np.cross(np.swapaxes(turning_axes(angles), 1, 2), place[:, None, :]).swapaxes(1, 2)
        self.vector = (place - model.lever) @ model.mounting
        rate = np.einsum("nij,nj->ni", self.by_angles, rates)
        rate -= np.einsum("nij,nj->ni", back, model._path(self.times, 1))
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
        """Return d(image) ``(N, 2, P)`` of changes of the vector ``(N, 3, P)`` and of u, v themselves ``(N, 2, P)``."""
        return self.solved @ (self.by_vector @ vector - look)
