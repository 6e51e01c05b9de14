"""Which correction of a block the page recommends: by known points, or by ties alone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from ortho_measure.block.comparison import _recommended, _Tried


def tried(name: str, parameters: int, sigma0: float, redundancy: int, rays: float, ground: float | None = None) -> Any:
    """Return a correction with equal errors of ten rays, and of four check points."""
    roles = np.array(["check" if ground else "tie"] * 4)
    of_ground = np.full((4, 2), np.nan if ground is None else ground / np.sqrt(2))
    fit: Any = SimpleNamespace(points=SimpleNamespace(roles=roles), sigma0=sigma0, redundancy=redundancy)
    without: Any = SimpleNamespace(ground=of_ground, rays=np.full((10, 2), rays / np.sqrt(2)))
    return _Tried(name, parameters, SimpleNamespace(fit=fit, left_out=without, error=""))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("corrections", "expected"),
    [
        # Five ties in three images of the sample: left-out rays are better and better, the ground is not.
        ([("none", 0, 110.8, 15, 5.67), ("shift", 6, 0.647, 12, 0.072), ("affine", 18, 0.106, 4, 0.035)], "shift"),
        # Many ties prove that the simple correction is wrong.
        ([("shift", 6, 2.0, 400, 0.8), ("affine", 18, 1.0, 390, 0.4)], "affine"),
        # They also prove differences that do not matter, and left-out rays can show that there is no gain.
        ([("shift", 6, 1.03, 4000, 0.41), ("affine", 18, 1.0, 3990, 0.4)], "shift"),
        ([("shift", 6, 1.1, 200, 0.5), ("affine", 18, 1.0, 190, 0.6)], "shift"),
        # Points with known ground decide, whatever the ties say.
        ([("shift", 6, 1.0, 200, 0.5, 1.0), ("affine", 18, 0.6, 190, 0.3, 2.0)], "shift"),
        ([("shift", 6, 1.0, 200, 0.5, 1.04), ("affine", 18, 0.6, 190, 0.3, 1.0)], "shift"),
        ([("shift", 6, 1.0, 200, 0.5, 1.06), ("affine", 18, 1.0, 190, 0.5, 1.0)], "affine"),
    ],
)
def test_known_points_decide_and_ties_alone_do_not_ask_for_many_parameters(corrections: Any, expected: str) -> None:
    name, reason = _recommended([tried(*one) for one in corrections])
    assert name == expected
    unit, at = ("m", 5) if len(corrections[0]) > 5 else ("px", 4)
    chosen = next(one for one in corrections if one[0] == expected)
    assert reason.startswith(f"RMSE {chosen[at]:.3g} {unit} at ")


def test_without_tests_nothing_is_recommended() -> None:
    name, reason = _recommended([])
    assert name is None
    assert "fewer than three points" in reason
