"""Rotations that are written out have the signs and sequences of scipy's Rotation."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ortho_pipeline.geodesy.ellipsoid import angles_of_rotation, rotation_between, rotation_of_angles
from ortho_pipeline.models.frame.orientation import camera_from_platform
from ortho_pipeline.models.pushbroom.rotations import angles_of, rotations
from ortho_pipeline.models.pushbroom.tables import rotations_of_quaternions

TURNS = st.floats(-math.pi, math.pi)
#: The middle angle is only determined up to here from the pole of the sequence.
TILTS = st.floats(-1.55, 1.55)


@given(omega=TURNS, phi=TILTS, kappa=TURNS)
def test_omega_phi_kappa_turn_about_axes_that_turn_along(omega: float, phi: float, kappa: float) -> None:
    matrix = rotation_of_angles(omega, phi, kappa)
    turn = Rotation.from_euler("XYZ", [omega, phi, kappa])
    np.testing.assert_allclose(matrix, turn.inv().as_matrix(), rtol=0, atol=1e-15)
    again = rotation_of_angles(*angles_of_rotation(matrix))
    np.testing.assert_allclose(again, matrix, rtol=0, atol=1e-14)


@given(roll=TURNS, pitch=TILTS, yaw=TURNS)
def test_roll_pitch_yaw_are_yaw_pitch_roll_about_axes_that_turn_along(roll: float, pitch: float, yaw: float) -> None:
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    matrices = rotations(np.array([[roll, pitch, yaw]]))
    np.testing.assert_allclose(matrices[0], turn, rtol=0, atol=1e-15)
    np.testing.assert_allclose(rotations(angles_of(matrices)), matrices, rtol=0, atol=1e-14)
    # The camera's axes are right, forward and up; the platform's are forward, right and down.
    axes = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(camera_from_platform(roll, pitch, yaw), axes @ turn.T, rtol=0, atol=1e-15)


@given(seed=st.integers(0, 1000))
def test_quaternions_turn_vectors_as_their_product_does(seed: int) -> None:
    """v' = q v q*, written out in Hamilton's products."""
    w, *xyz = np.random.default_rng(seed).normal(size=4)
    vector = np.random.default_rng(seed + 1).normal(size=3)
    q = np.array(xyz)
    length = math.sqrt(w * w + q @ q)
    w, q = w / length, q / length
    across = 2 * np.cross(q, vector)
    turned = vector + w * across + np.cross(q, across)
    for scalar, values in (("first", [w, *q]), ("last", [*q, w])):
        found = rotations_of_quaternions(3.0 * np.array([values]), scalar=scalar)[0] @ vector
        np.testing.assert_allclose(found, turned, rtol=0, atol=1e-14)


@given(seed=st.integers(0, 1000), count=st.integers(2, 8))
def test_the_rotation_between_vectors_is_that_of_least_squares(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    truth, vectors = Rotation.random(random_state=seed).as_matrix(), random.normal(size=(count, 3))
    turned = vectors @ truth.T + 0.1 * random.normal(size=vectors.shape)
    expected = Rotation.align_vectors(turned, vectors)[0].as_matrix()
    np.testing.assert_allclose(rotation_between(vectors, turned), expected, rtol=0, atol=1e-9)
