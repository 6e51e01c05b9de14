"""RPCs fitted to functions whose best answer is known: offsets, scales, coefficients, and the stated error."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.models.base import SensorModel

BOX, HEIGHTS = (24.0, -33.9, 24.3, -33.5), (150.0, 950.0)
CENTRE, HALF = np.array([24.15, -33.7, 550.0]), np.array([0.15, 0.2, 400.0])


@dataclass(frozen=True, eq=False)
class Formula(SensorModel):
    """Columns and rows as functions of the normalised ground (lon, lat, h): each is from -1 to 1 in the box."""

    kind: ClassVar[str] = "formula"
    wave: float = 0.0
    #: Beyond this normalised longitude the model does not project.
    last: float = 9.0

    @property
    def crs(self) -> str:
        return "EPSG:4979"

    @property
    def domain(self) -> tuple[np.ndarray, np.ndarray]:
        return CENTRE, HALF

    def ground_to_image(self, ground: Any) -> np.ndarray:
        x, y, h = ((np.asarray(ground, dtype=float) - CENTRE) / HALF).T
        x = np.where(x > self.last, np.nan, (x + 7.0) % 360.0 - 7.0)
        column = 700.0 + (500.0 * x + 60.0 * y + 40.0 * h + 30.0 * x * h) / (1.0 + 0.1 * y)
        row = 300.0 + (20.0 * x - 200.0 * y + 8.0 * y * h) / (1.0 - 0.05 * x)
        return np.stack([column + self.wave * np.sin(40.0 * x), row], axis=1)

    def image_to_ground(self, image: Any, height: Any) -> np.ndarray:
        raise NotImplementedError


def grid(nx: int, ny: int, nh: int) -> np.ndarray:
    """Return points at equal steps from one end of the box to the other."""
    axes = (np.linspace(a, b, n) for a, b, n in zip((*BOX[:2], 150.0), (*BOX[2:], 950.0), (nx, ny, nh), strict=True))
    return np.array(list(itertools.product(*axes)))


def test_offsets_and_scales_are_the_middle_and_half_of_what_was_sampled() -> None:
    made = fit_rpc(Formula(), BOX, HEIGHTS, grid=(6, 5, 4))
    image = Formula().ground_to_image(grid(6, 5, 4))
    low, high = image.min(axis=0), image.max(axis=0)
    rpc = made.rpc
    np.testing.assert_allclose((rpc.col_off, rpc.row_off), (low + high) / 2, rtol=1e-12)
    np.testing.assert_allclose((rpc.col_scale, rpc.row_scale), (high - low) / 2, rtol=1e-12)
    np.testing.assert_allclose((rpc.lon_off, rpc.lat_off, rpc.h_off), CENTRE, rtol=1e-12)
    np.testing.assert_allclose((rpc.lon_scale, rpc.lat_scale, rpc.h_scale), HALF, rtol=1e-12)
    assert (rpc.col_den[0], rpc.row_den[0]) == (1.0, 1.0)
    assert (made.exact, made.warnings) == (False, ())


def test_a_ratio_is_found_again() -> None:
    """Both of its denominators, too; between the points of the fit it is as good as at them."""
    made = fit_rpc(Formula(), BOX, HEIGHTS, grid=(9, 8, 5))
    ground = CENTRE + HALF * np.random.default_rng(0).uniform(-1, 1, (200, 3))
    np.testing.assert_allclose(made.rpc.ground_to_image(ground), Formula().ground_to_image(ground), atol=2e-5)
    assert made.max_error_px < 2e-5


@pytest.mark.parametrize("wave", [0.01, 0.05, 3.0])
def test_the_stated_error_is_the_largest_at_points_between_those_of_the_fit(wave: float) -> None:
    """On a grid of one point more in each direction."""
    model = Formula(wave=wave)
    made = fit_rpc(model, BOX, HEIGHTS, grid=(7, 6, 5), force=True)
    ground = grid(8, 7, 6)
    errors = np.abs(made.rpc.ground_to_image(ground) - model.ground_to_image(ground))
    assert made.max_error_px == pytest.approx(errors.max(), rel=1e-6)
    stated = [notice.fields["max_error_px"] for notice in made.warnings]
    assert stated == ([made.max_error_px] if errors.max() > 0.02 else [])


@pytest.mark.parametrize(("heights", "scale"), [((550.0, 550.0), 1.0), ((549.5, 550.5), 1.0), ((546.0, 554.0), 4.0)])
def test_a_flat_box_is_a_metre_high_in_both_directions(heights: tuple[float, float], scale: float) -> None:
    rpc = fit_rpc(Formula(), BOX, heights, grid=(6, 5, 4)).rpc
    assert (rpc.h_off, rpc.h_scale) == (550.0, scale)


def test_a_model_that_folds_the_ground_is_no_damaged_rpc() -> None:
    class Folded(Formula):
        def ground_to_image(self, ground: Any) -> np.ndarray:
            x, y, _ = ((np.asarray(ground, dtype=float) - CENTRE) / HALF).T
            return np.stack([500.0 * (x - 0.3) ** 2, -200.0 * y], axis=1)

    with pytest.raises(InputError, match=r"cannot represent this model .*several places on the ground") as caught:
        fit_rpc(Folded(), BOX, HEIGHTS)
    assert "geolocation" in str(caught.value.remedy)
    assert caught.value.field is None


def test_a_scene_of_less_than_two_pixels_has_a_scale_of_one_pixel() -> None:
    small = tuple(CENTRE[[0, 1, 0, 1]] + 1e-3 * HALF[[0, 1, 0, 1]] * (-1, -1, 1, 1))
    rpc = fit_rpc(Formula(), small, (550.0, 550.0), grid=(6, 5, 4)).rpc
    assert (rpc.col_scale, rpc.row_scale) == (1.0, 1.0)
    image = Formula().ground_to_image(CENTRE[None])[0]
    np.testing.assert_allclose(rpc.ground_to_image(CENTRE[None])[0], image, atol=1e-4)


@pytest.mark.parametrize(("columns", "east", "share"), [(4, 0.0, 1 / 2), (5, 0.25, 2 / 5), (3, 0.25, 1 / 3)])
def test_half_of_a_box_must_be_in_the_image(columns: int, east: float, share: float) -> None:
    """The model ends at the middle of the first box; samples are at 4, 5 or 3 longitudes from one side to the other."""
    model = Formula(last=0.01)
    box = (BOX[0] + east * HALF[0], BOX[1], BOX[2] + east * HALF[0], BOX[3])
    if share == 0.5:
        assert np.isfinite(fit_rpc(model, box, HEIGHTS, grid=(columns, 9, 5), force=True).rpc.col_off)
    else:
        with pytest.raises(InputError, match=f"only {share:.0%} of the box"):
            fit_rpc(model, box, HEIGHTS, grid=(columns, 9, 5), force=True)


@pytest.mark.parametrize(
    ("box", "heights"),
    [
        ((24.0, -33.5, 24.3, -33.5), HEIGHTS), ((24.3, -33.9, 24.3, -33.5), HEIGHTS),
        ((24.0, -33.4, 24.3, -33.5), HEIGHTS), ((24.4, -33.9, 24.3, -33.5), HEIGHTS), (BOX, (551.0, 550.0)),
        ((24.0, -33.9, np.inf, -33.5), HEIGHTS), ((-np.inf, -33.9, 24.3, -33.5), HEIGHTS),
    ],
)  # fmt: skip
def test_a_box_has_a_width_and_a_length(box: tuple[float, float, float, float], heights: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="is empty"):
        fit_rpc(Formula(), box, heights)


@pytest.mark.parametrize("turns", [1, -1])
def test_a_box_beyond_the_antimeridian_has_its_offset_within(turns: int) -> None:
    """Readers of RPCs know longitudes from -180 to 180 degrees."""
    box = (BOX[0] + 360 * turns, BOX[1], BOX[2] + 360 * turns, BOX[3])

    class Turned(Formula):
        def ground_to_image(self, ground: Any) -> np.ndarray:
            ground = np.array(ground, dtype=float)
            ground[:, 0] = np.remainder(ground[:, 0], 360.0)
            return super().ground_to_image(ground)

    rpc = fit_rpc(Turned(), box, HEIGHTS, grid=(9, 8, 5)).rpc
    assert rpc.lon_off == pytest.approx(CENTRE[0], abs=1e-9)
