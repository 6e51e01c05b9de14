"""Images in pieces: next to the antimeridian, and at the seams."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.models import RPC, FrameCamera, Pieces
from ortho_pipeline.models.frame.camera import MAP
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.models.mosaicked import relative_scale
from ortho_pipeline.testing import check_sensor_model


def piece(lon: float, shift: float = 0.0) -> RPC:
    """Return an RPC of 1000 x 1000 pixels of 1e-5 degrees about a longitude."""
    column, row, one = np.zeros(20), np.zeros(20), np.eye(20)[0]
    column[1], row[2] = 1.0, -1.0
    return RPC(500.0 + shift, 500.0, lon, 10.0, 500.0, 500.0, 500.0, 0.005, 0.005, 500.0, column, one, row, one)


def side_by_side(first: RPC, second: RPC) -> Pieces:
    return Pieces((first, second), ((0.0, 0.0), (1000.0, 0.0)), ((1000, 1000),) * 2)


def test_pieces_on_both_sides_of_the_antimeridian_are_one_image() -> None:
    pieces = side_by_side(piece(179.995), piece(-179.995))
    np.testing.assert_allclose(pieces.domain, [[180.0, 10.0, 500.0], [0.01, 0.005, 500.0]], rtol=0, atol=1e-9)
    image = np.random.default_rng(0).uniform(0, 1, (40, 2)) * (2000, 1000)
    ground = pieces.image_to_ground(image, 500.0)
    assert np.abs(pieces.ground_to_image(ground) - image).max() < 1e-6
    check_sensor_model(pieces, ground)


def test_slopes_at_a_seam_are_those_of_the_piece() -> None:
    """The pieces disagree by three pixels, over which a difference would make a slope sixteen times too steep."""
    first, second = piece(0.0), piece(0.01, shift=3.0)
    pieces = side_by_side(first, second)
    ground = np.column_stack([0.005 + np.linspace(-2e-6, 2e-6, 5), np.full(5, 10.001), np.full(5, 500.0)])
    partials = pieces.ground_partials(ground)
    assert np.allclose(partials[:, 0, 0], 1e5)
    assert np.allclose(partials[:, 1, 1], -1e5)
    assert np.isnan(pieces.ground_partials([[0.0, 80.0, 500.0]])).all()


@pytest.mark.parametrize("side", [0.3, 5.0])
def test_the_scale_of_a_model_is_that_of_its_pixels_in_metres(side: float) -> None:
    """Frame cameras over one place, in a CRS of metres: an image with twice the focal length has half the pixels."""
    fine, coarse = (
        FrameCamera.from_map(
            Interior(1000, 1000, focal, 1e-5, 1e-5), "EPSG:32633", [500e3, 4e6, side / 1e-5, 0.0, 0.0, 0.0],
            frame=MAP, heights=(-5.0, 5.0),
        )
        for focal in (2.0, 1.0)
    )  # fmt: skip
    assert relative_scale(fine, coarse, (1000, 1000)) == pytest.approx(2.0, rel=1e-6)
    assert relative_scale(coarse, fine, (1000, 1000)) == pytest.approx(0.5, rel=1e-6)


def test_the_scale_of_a_model_is_that_in_the_middle_of_its_image() -> None:
    """Columns grow as x + 0.2 x^2, and rows as y + 0.2 y^2: the slope at a value c of these is sqrt(1 + 0.8 c)."""
    column, row = np.zeros(20), np.zeros(20)
    column[[1, 7]], row[[2, 8]] = (1.0, 0.2), (-1.0, -0.2)
    bent = dataclasses.replace(piece(0.0), col_num=column, row_num=row)
    # Column 300 and row 450 are 0.4 and 0.1 of the half-size to the left and above.
    stretched = math.sqrt(1 + 0.8 * -0.4) * math.sqrt(1 + 0.8 * 0.1)
    assert relative_scale(piece(0.0), bent, (600, 900)) == pytest.approx(1 / math.sqrt(stretched), rel=1e-9)


def test_a_point_belongs_to_the_piece_that_it_is_in_or_nearest_to() -> None:
    """Two rows of pieces, which disagree by some pixels, so that the owner shows."""
    upper, lower = piece(0.0), dataclasses.replace(piece(0.0), lat_off=9.99, row_off=503.0)
    pieces = Pieces((upper, lower), ((0.0, 0.0), (0.0, 1000.0)), ((1000, 1000),) * 2)
    # Rows about the first row of the lower piece, in columns inside and left of both.
    lat = 10.005 - 1e-5 * np.array([10.0, 990.0, 998.0, 1010.0, 1500.0])
    for lon in (0.0, -0.00505):
        ground = np.column_stack([np.full(5, lon), lat, np.full(5, 500.0)])
        column = 500.0 + lon * 1e5
        expected = np.array([10.0, 990.0, 998.0, 1013.0, 1503.0])
        np.testing.assert_allclose(pieces.ground_to_image(ground), np.column_stack([np.full(5, column), expected]))


def test_within_a_pixel_of_a_piece_the_point_is_still_of_the_piece_that_it_is_in() -> None:
    """Row 1000.5 of the upper piece is half a pixel beyond it, and the middle of the first row of the lower one."""
    upper, lower = piece(0.0), dataclasses.replace(piece(0.0), lat_off=9.99, row_off=503.0)
    pieces = Pieces((upper, lower), ((0.0, 0.0), (0.0, 1000.0)), ((1000, 1000),) * 2)
    ground = np.array([[0.0, 10.005 - 1e-5 * 1000.5, 500.0]])
    np.testing.assert_allclose(upper.ground_to_image(ground), [[500.0, 1000.5]])
    np.testing.assert_allclose(pieces.ground_to_image(ground), [[500.0, 1003.5]])


def test_pieces_are_checked_and_copies_hold_them() -> None:
    first, second = piece(0.0), piece(0.01)
    made = Pieces([first, second], [(0.0, 0.0), (1000.0, 0.0)], [(1000, 1000)] * 2)
    assert made.models == (first, second)
    assert made.first is first
    assert len(made.corners) == len(first.corners) + len(second.corners)
    for wrong in (
        ((), (), ()),
        ((first, second), ((0.0, 0.0),), ((1000, 1000),) * 2),
        ((first, second), ((0.0, 0.0),) * 2, ((1000, 1000),)),
    ):
        with pytest.raises(InputError, match="each piece needs"):
            Pieces(*wrong)


def test_another_model_that_sees_other_ground_has_no_scale() -> None:
    seen, half, other = piece(0.0), dataclasses.replace(piece(0.0), col_scale=250.0, row_scale=250.0), piece(90.0)
    assert relative_scale(seen, half, (500, 500)) == pytest.approx(2.0)
    assert relative_scale(seen, other, (1000, 1000)) is None
