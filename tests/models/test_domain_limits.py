"""Where classical models and RPCs project: up to 1.5 half-sizes on all four sides, and not beyond a pole."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import ArrayLike

from ortho_pipeline.models import RPC, SensorModel
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.families import family_of
from ortho_pipeline.models.rational import Rational

MIDDLE, HALF = np.array([20.0, -30.0, 500.0]), np.array([0.4, 0.25, 300.0])


def beside(place: ArrayLike, *offset: float) -> Array:
    """Return a place, or places ``(N, 3)``, moved by degrees and metres."""
    return np.asarray(place) + np.array(offset)


def rational(**changes: object) -> Rational:
    """Return a projective model of a box about `MIDDLE`, whose denominator is 1 + 0.2 X."""
    names = family_of("dlt").param_names
    values = dict.fromkeys(names, 0.0)
    values |= {"col_X": 1.0, "row_Y": -1.0, "row_Z": 0.1, "den_X": 0.2}
    given: dict[str, object] = {
        "family": "dlt", "ground_crs": "EPSG:4979", "coefficients": list(values.values()), "ground_offset": MIDDLE,
        "ground_scale": HALF, "image_offset": (600.0, 400.0), "image_scale": (600.0, 400.0),
        "box": [MIDDLE - HALF, MIDDLE + HALF], "wraps": True,
    }  # fmt: skip
    return Rational(**{**given, **changes})  # type: ignore[arg-type]


def rpc() -> RPC:
    one = np.eye(20)
    return RPC(600.0, 400.0, 20.0, -30.0, 500.0, 600.0, 400.0, 0.4, 0.25, 300.0, one[1], one[0], -one[2], one[0])


@pytest.mark.parametrize("model", [rational(), rpc()], ids=["rational", "rpc"])
@pytest.mark.parametrize("side", [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
@pytest.mark.parametrize("turns", [0.0, 360.0, -720.0])
def test_ground_has_an_image_up_to_one_and_a_half_half_sizes(
    model: SensorModel, side: tuple[float, float], turns: float
) -> None:
    """On each side, however often longitudes go around."""
    for part, seen in ((1.499, True), (1.501, False)):
        ground = beside([[*(MIDDLE[:2] + part * HALF[:2] * side), 650.0]], turns, 0.0, 0.0)
        for found in (model.ground_to_image(ground), model.ground_partials(ground), model.param_partials(ground)):
            assert np.isfinite(found).all() == (seen or not found.size), (part, found)


def test_a_classical_model_extrapolates_heights_and_an_rpc_up_to_one_and_a_half_half_sizes() -> None:
    for part, of_rpc in ((1.499, True), (-1.499, True), (1.501, False), (-1.501, False), (9.0, False)):
        ground = beside(MIDDLE, 0.1, 0.1, part * HALF[2])[None]
        assert np.isfinite(rational().ground_to_image(ground)).all()
        assert np.isfinite(rpc().ground_to_image(ground)).all() == of_rpc


def test_a_projective_model_is_that_of_its_formula() -> None:
    """Only longitudes in degrees go around."""
    x, y, z = np.array([[-1.4, 0.3, 1.1], [0.6, -1.2, -3.0], [0.0, 0.0, 0.0]]).T
    ground = MIDDLE + HALF * np.column_stack([x, y, z])
    wanted = np.column_stack([600 + 600 * x / (1 + 0.2 * x), 400 + 400 * (-y + 0.1 * z) / (1 + 0.2 * x)])
    np.testing.assert_allclose(rational().ground_to_image(ground), wanted, atol=1e-8)
    np.testing.assert_allclose(rational().ground_to_image(beside(ground, 360.0, 0, 0)), wanted, atol=1e-6)
    assert np.isnan(rational(wraps=False).ground_to_image(beside(ground, 360.0, 0, 0))).all()


def test_at_a_thousandth_of_its_constant_a_denominator_is_at_its_pole() -> None:
    names = family_of("dlt").param_names
    values = dict.fromkeys(names, 0.0) | {"col_X": 1.0, "row_Y": 1.0, "den_Y": 0.8}
    model = rational(coefficients=list(values.values()))
    for denominator, seen in ((0.0011, True), (0.0009, False), (-0.1, False)):
        y = (denominator - 1) / 0.8
        ground = (MIDDLE + HALF * (0.0, y, 0.0))[None]
        for found in (model.ground_to_image(ground), model.ground_partials(ground), model.param_partials(ground)):
            assert np.isfinite(found).all() == seen


def test_a_box_may_be_about_another_middle_than_the_coordinates() -> None:
    """A box to the west, and farther than its middle is from theirs."""
    model = rational(box=[beside(MIDDLE, -0.6, -0.1, -10.0), beside(MIDDLE, -0.1, 0.3, 50.0)])
    centre, half = model.domain
    np.testing.assert_allclose(centre, beside(MIDDLE, -0.35, 0.1, 20.0))
    np.testing.assert_allclose(half, [0.25, 0.2, 30.0])
    ends = {"west": (-0.35 - 0.375, 0.1), "east": (-0.35 + 0.375, 0.1), "south": (-0.35, -0.2), "north": (-0.35, 0.4)}
    for name, (lon, lat) in ends.items():
        inner = beside(MIDDLE, -0.35 + 0.999 * (lon + 0.35), 0.1 + 0.999 * (lat - 0.1), 0.0)
        outer = beside(MIDDLE, -0.35 + 1.001 * (lon + 0.35), 0.1 + 1.001 * (lat - 0.1), 0.0)
        found = model.ground_to_image([inner, outer])
        assert np.isfinite(found).all(axis=1).tolist() == [True, False], name
