"""Errors of the ground of control points: what they move in the image has a direction, and so have their weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyproj
import pytest

from ortho_pipeline.errors import InputError
from ortho_pipeline.estimation.family_fit import fit_family
from ortho_pipeline.estimation.fit import fit
from ortho_pipeline.estimation.observations.image_errors import ImageErrors
from ortho_pipeline.models import RPC, ImageCorrection
from ortho_pipeline.points import Points

ORIGIN = (500.0, 400.0)
SIGMA_IMAGE, SIGMA_GROUND = 0.3, (0.2, 0.2, 5.0)
#: Metres of a degree of longitude and of latitude at 30 degrees south (WGS84).
DEGREE = np.array([96_486.28, 110_852.46, 1.0])


@pytest.fixture(scope="module")
def oblique() -> RPC:
    """Return an RPC of about 2 m pixels that sees a metre of height as 0.45 px along columns and 0.4 px along rows."""
    one, zero = np.eye(20)[0], np.zeros(20)
    col, row = zero.copy(), zero.copy()
    col[[1, 2, 3, 7]], row[[1, 2, 3, 8]] = (1.0, 0.04, 0.27, 2e-3), (0.05, -1.0, 0.30, 1e-3)
    return RPC(500.0, 400.0, 20.0, -30.0, 500.0, 500.0, 400.0, 0.01, 0.0072, 300.0, col, one, row, one)


def measured(rpc: RPC, count: int, seed: int) -> Points:
    """Return points whose image and ground err by what they state; nothing of the truth is in them."""
    random = np.random.default_rng([seed, count])
    centre, half = rpc.domain
    truth = centre + 0.9 * half * random.uniform(-1, 1, (count, 3))
    return Points(
        ids=tuple(f"p{k}" for k in range(count)),
        image=rpc.ground_to_image(truth) + random.normal(0, SIGMA_IMAGE, (count, 2)),
        ground=truth + random.normal(0, SIGMA_GROUND, (count, 3)) / DEGREE, roles=np.full(count, "control"),
        sigma_image=np.full(count, SIGMA_IMAGE), sigma_ground=np.tile(SIGMA_GROUND, (count, 1)),
        crs=pyproj.CRS(4979), source="",
    )  # fmt: skip


def axes_of_view(rpc: RPC, ground: np.ndarray) -> np.ndarray:
    """Return directions ``(2, 2)`` in the image along and across which a height moves, by differences."""
    above = ground + np.array([0.0, 0.0, 1.0])
    along = (rpc.ground_to_image(above) - rpc.ground_to_image(ground)).mean(axis=0)
    along /= np.hypot(*along)
    return np.array([along, [-along[1], along[0]]])


def test_sigmas_hold_along_and_across_the_direction_of_view(oblique: RPC) -> None:
    """A height of 5 m moves a point by 3 px along the view and by nothing across: each direction has its own sigma.

    Over repeats (estimate - truth) / sigma is Student's t of 2 n - 2 degrees of freedom, whose spread over N is known
    to 1 / sqrt(2 N); three times that is allowed. So are residuals of points over their expected spread, of which
    2 n - 2 in each repeat are independent.
    """
    repeats, count = 150, 12
    start = ImageCorrection.identity(oblique, "shift", ORIGIN)
    estimates, residuals = [], []
    for seed in range(repeats):
        found = fit(start, measured(oblique, count, seed), robust=False)
        axes = axes_of_view(oblique, found.points.ground)
        estimates.append((axes @ found.values) / np.sqrt(np.diag(axes @ found.covariance @ axes.T)))
        # Of a shift the mean takes 1 / n of what points of equal weight err by.
        moved = SIGMA_GROUND * (axes @ partials_in_metres(oblique, found.points.ground))
        expected = np.sqrt((SIGMA_IMAGE**2 + (moved**2).sum(axis=2)) * (1 - 1 / count))
        residuals.append(found.residuals @ axes.T / expected)
    freedom = 2 * count - 2
    spread = np.std(estimates, axis=0) / np.sqrt(freedom / (freedom - 2))
    np.testing.assert_allclose(spread, 1.0, atol=3 / np.sqrt(2 * repeats))
    left = np.sqrt(np.mean(np.square(residuals), axis=(0, 1)))
    np.testing.assert_allclose(left, 1.0, atol=3 / np.sqrt(repeats * freedom))


def partials_in_metres(rpc: RPC, ground: np.ndarray) -> np.ndarray:
    """Return d(image)/d(east, north, up) ``(n, 2, 3)`` px per metre, by differences of one metre."""
    steps = np.diag(1 / DEGREE)
    return np.stack([rpc.ground_to_image(ground + step) - rpc.ground_to_image(ground - step) for step in steps],
                    axis=-1) / 2  # fmt: skip


def test_errors_are_the_whole_covariance_of_what_the_ground_moves(oblique: RPC) -> None:
    points = measured(oblique, 8, 1)
    errors = ImageErrors.of(ImageCorrection.identity(oblique, "shift", ORIGIN), points)
    moved = partials_in_metres(oblique, points.ground) * SIGMA_GROUND
    wanted = SIGMA_IMAGE**2 * np.eye(2) + moved @ moved.transpose(0, 2, 1)
    np.testing.assert_allclose(errors.covariance, wanted, rtol=1e-4)


def test_errors_of_height_beyond_all_measure_leave_the_sigma_across_the_view(oblique: RPC) -> None:
    """1e8 times as uncertain along the view as across: whitening keeps the direction across to one in a million."""
    points = replace(measured(oblique, 8, 2), sigma_ground=np.tile([0.0, 0.0, 6e7], (8, 1)))
    start = ImageCorrection.identity(oblique, "shift", ORIGIN)
    errors = ImageErrors.of(start, points)
    up = start.ground_partials(points.ground)[:, :, 2]
    across = np.stack([-up[:, 1], up[:, 0]], axis=1) / np.hypot(*up.T)[:, None]
    np.testing.assert_allclose(np.linalg.norm(errors.whitened(across), axis=1) * SIGMA_IMAGE, 1.0, rtol=1e-6)


def test_a_gross_error_across_the_view_is_found_where_one_of_height_is_none(oblique: RPC) -> None:
    points = measured(oblique, 20, 5)
    start = ImageCorrection.identity(oblique, "shift", ORIGIN)
    axes = axes_of_view(oblique, points.ground)
    for direction, rejected in ((1, ["p7"]), (0, [])):
        image = points.image.copy()
        image[7] += 5.0 * axes[direction]
        found = fit(start, replace(points, image=image))
        assert [name for name, _ in found.rejected] == rejected


def test_a_measurement_without_any_error_is_refused_by_its_name(oblique: RPC) -> None:
    """A height alone errs along the view: across it such a point would have all the weight."""
    exact = replace(measured(oblique, 8, 3), sigma_image=np.array([0.5] * 7 + [0.0]), covariance_image=None)
    start = ImageCorrection.identity(oblique, "shift", ORIGIN)
    for ground in ((0.0, 0.0, 0.0), (0.0, 0.0, 5.0)):
        with pytest.raises(InputError, match="p7 has a standard deviation of zero"):
            fit(start, replace(exact, sigma_ground=np.tile(ground, (8, 1))))
    assert fit(start, replace(exact, sigma_ground=np.ones((8, 3)))).sigma0 is not None


@pytest.mark.parametrize("size", [0.0, 1000.0])
def test_errors_of_heights_take_no_good_point_out_of_a_family(oblique: RPC, size: float) -> None:
    """A gross error leans the start, and with it the direction in which heights seem to move; it goes alone."""
    rejected = []
    for seed in range(12):
        points = measured(oblique, 14, seed)
        image = points.image.copy()
        image[5] += size * np.array([0.7, -0.7])
        rejected += [name for name, _ in fit_family("affine3d", replace(points, image=image)).rejected]
    assert rejected == ["p5"] * (12 if size else 0)
