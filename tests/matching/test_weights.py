"""What residuals are made of: drawn by known parts, in any direction of view."""

from __future__ import annotations

import numpy as np
import pytest

from ortho_pipeline.imaging.matching.weights import Components, components, unexplained


def drawn(angle: float, truth: Components, count: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals, covariances of least-squares matching, and lines of sight at an angle to the columns."""
    random = np.random.default_rng(3)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    sizes = random.uniform(0.02, 0.08, (count, 2))
    matched = np.einsum("ni,ij->nij", sizes**2, np.eye(2))
    along = np.broadcast_to([0.7, 0.0], (count, 2))
    root = np.linalg.cholesky(truth.covariance(matched, along))
    residuals = np.einsum("nij,nj->ni", root, random.normal(0, 1, (count, 2)))
    return residuals @ turn.T, turn @ matched @ turn.T, along @ turn.T


@pytest.mark.parametrize("degrees", [0, 20, 45, 70, 90, 160])
@pytest.mark.parametrize("height", [0.5, 6.0, 40.0])
def test_parts_are_what_they_are_whatever_the_direction_of_view(degrees: int, height: float) -> None:
    """Heights spread matches of 0.13 px by up to 28 px along a line that need not be that of a column or a row.

    A variance of 400 draws is known to 7 %, and that across the line of sight is of the first order in nothing else.
    """
    truth = Components(4.0, height, 0.08)
    residuals, matched, along = drawn(np.radians(degrees), truth)
    found = components(residuals, matched, along)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / 0.7
    said, true = (np.einsum("ni,nij,nj->n", across, one.covariance(matched, along), across) for one in (found, truth))
    assert np.sqrt(said.mean() / true.mean()) == pytest.approx(1.0, abs=0.15)
    assert found.height == pytest.approx(height, rel=0.15)
    upright = components(*drawn(0.0, truth))
    assert (found.matching, found.height, found.other) == pytest.approx(
        (upright.matching, upright.height, upright.other), rel=0.1, abs=0.01
    )


def test_parallel_lines_of_sight_show_no_heights() -> None:
    """The panchromatic and the multispectral image of one acquisition: rounding is no parallax."""
    residuals, matched, along = drawn(0.3, Components(4.0, 0.0, 0.08))
    found = components(residuals, matched, 1e-9 * along)
    assert found.height == 0.0
    assert found.covariance(matched, along)[:, 0, 0].mean() == pytest.approx(residuals[:, 0].var(), rel=0.15)


@pytest.mark.parametrize("extent", [60, 200], ids=["overlapping", "apart"])
def test_what_a_fit_leaves_of_errors_that_overlapping_chips_share(extent: int) -> None:
    """Errors are means of white noise over squares about 20 places."""
    random, side = np.random.default_rng(1), 30
    corners = random.integers(0, extent, (20, 2))
    design = np.column_stack([np.ones(20), corners / extent])
    basis = np.linalg.qr(design)[0]
    left = []
    for _ in range(225):
        sums = np.pad(random.normal(0, 1, (extent + side,) * 2), ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
        (x, y), (right, down) = corners.T, corners.T + side
        errors = (sums[down, right] - sums[down, x] - sums[y, right] + sums[y, x]) / side
        left.append(np.mean((errors - basis @ (basis.T @ errors)) ** 2))
    found = unexplained(design, corners + side / 2, side)
    assert np.mean(left) == pytest.approx(found, abs=4 * np.std(left) / 15)
    assert found < 0.7 if extent == 60 else found > 0.75
