"""Derivatives of a line scanner in closed form: of the image by ground and parameters, of the orbit by parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ortho_pipeline.geodesy.ellipsoid import enu_from_ecef, geocentric, metres_per_degree
from ortho_pipeline.models.base import Array, Constraints
from ortho_pipeline.models.pushbroom.constraints import joined
from ortho_pipeline.models.pushbroom.rotations import rotations, turning_axes

if TYPE_CHECKING:
    from ortho_pipeline.models.pushbroom.scanner import Pushbroom


def by_ground(model: Pushbroom, ground: Array) -> Array:
    """Return d(image)/d(ground) as ``(N, 2, 3)``."""
    state = State(model, ground)
    moved = np.swapaxes(enu_from_ecef(ground), 1, 2).copy()
    moved[:, :, :2] *= metres_per_degree(ground)[:, None, :]
    moved[:, :, 2] *= model.light.rise(ground[:, 2], state.cosine)[:, None]
    by_camera = model.mounting.T @ np.swapaxes(state.turn, 1, 2) @ model.orbital.T
    return state.image_by(by_camera @ moved)


def by_params(model: Pushbroom, ground: Array) -> Array:
    """Return d(image)/d(params) as ``(N, 2, P)``."""
    state, parameters = State(model, ground), model.parameters
    place = {column: at for at, column in enumerate(parameters.places(model.free))}
    by_vector = np.zeros((len(ground), 3, len(place)))
    groups = (
        ("path", model.path, -(model.mounting.T @ np.swapaxes(state.turn, 1, 2))),
        ("attitude", model.attitude, model.mounting.T @ state.by_angles),
    )
    for group, spline, slopes in groups:
        for first, weights in parameters.triples(group, model.flight.basis(spline, state.times)):
            for axis in range(3):
                if (at := place.get(first + axis)) is not None:
                    by_vector[:, :, at] = slopes[:, :, axis] * weights[:, None]
    inner = np.zeros((len(ground), 2, len(place)))
    start = parameters.first["camera"]
    camera = [(column - start, at) for column, at in place.items() if column >= start]
    if camera:
        theirs, ours = (list(side) for side in zip(*camera, strict=True))
        inner[:, :, ours] = model.camera.partials(state.column)[:, :, theirs]
    return state.image_by(by_vector, inner)


def pseudo_observations(model: Pushbroom) -> Constraints:
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
    found = joined(parts, count)
    # What no free parameter can change is not an observation of one.
    kept = found.jacobian[:, columns].any(axis=1)
    return Constraints(
        found.residuals[kept], found.jacobian[kept][:, columns], found.sigma[kept], found.fictitious[kept]
    )


class State:
    """Ground points as the camera sees them, and how their image follows from a change of what it sees."""

    def __init__(self, model: Pushbroom, ground: Array) -> None:
        image, flight = model.ground_to_image(ground), model.flight
        self.model, self.column, self.times = model, image[:, 0], image[:, 1] * model.line_period
        angles, rates = flight.attitude(self.times), flight.attitude(self.times, 1)
        self.turn = rotations(angles)
        rate, up = flight.path(self.times, 1), enu_from_ecef(ground)[:, 2] @ flight.orbital
        line = (geocentric(ground) - flight.origin) @ flight.orbital - flight.path(self.times)
        #: Of the zenith angle at the point.
        self.cosine = -(line * up).sum(axis=1) / np.linalg.norm(line, axis=1)
        line = model.light.apparent(line, rate, up, ground[:, 2])
        back = np.swapaxes(self.turn, 1, 2)
        place = np.einsum("nij,nj->ni", back, line)
        #: d(vector in platform axes)/d(roll, pitch, yaw)
        self.by_angles = -np.cross(np.swapaxes(turning_axes(angles), 1, 2), place[:, None, :]).swapaxes(1, 2)
        self.vector = (place - model.lever) @ model.mounting
        rate = np.einsum("nij,nj->ni", self.by_angles, rates) - np.einsum("nij,nj->ni", back, rate)
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
