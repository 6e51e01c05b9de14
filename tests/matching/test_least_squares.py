"""Least-squares matching of chips whose shift is known exactly: neither pushed from whole pixels nor drawn to them."""

from __future__ import annotations

import numpy as np
import pytest
from landscape import SIZE, land, sample

from ortho_pipeline.imaging.matching.least_squares import measure

SIDE, REACH, FINE = 40, 4, 2.0


def chips(ground: str, noise: float, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return chips, the larger ones of a target with other noise, and the shifts ``(n, 2)`` of up to half a pixel."""
    random = np.random.default_rng(0)
    images = [land(ground).seen("a", 0, FINE, blur * FINE) for blur in (0.4, 0.3)]
    shift, place = random.uniform(-0.5, 0.5, (count, 2)), random.uniform(0, SIZE, (count, 1, 2))
    made = []
    for image, side, moved in zip(images, (SIDE, SIDE + 2 * REACH), (0.0, shift[:, None]), strict=True):
        steps = FINE * (np.arange(side) + 0.5 - side / 2)
        u, v = np.meshgrid(steps, steps)
        at = place - FINE * moved
        tone = sample(image, at[:, :, :1] + u, at[:, :, 1:] + v)
        made.append(tone + random.normal(0, noise, tone.shape).astype(np.float32))
    return made[0], made[1], shift


@pytest.mark.parametrize("noise", [pytest.param(0.005, marks=pytest.mark.slow), 0.05])
def test_shifts_are_as_long_as_they_are_however_noisy_the_images(noise: float) -> None:
    """Weighted by the target's gradients they are a tenth to a quarter too long, near whole pixels twice as long."""
    scene, target, shift = chips("country", noise, 120)
    found = measure(scene, target, np.zeros_like(shift)).shift
    assert np.isfinite(found).mean() > 0.95
    missed, right = (found - shift)[np.isfinite(found).all(axis=1)], shift[np.isfinite(found).all(axis=1)]
    too_long = (missed * right).sum() / (right**2).sum()
    assert abs(too_long) < 0.05
    near = np.abs(right) < 0.2
    # Errors of 0.05 px alone make the slope through so few and so short shifts uncertain by 0.07.
    assert abs((missed[near] * right[near]).sum() / (right[near] ** 2).sum()) < 0.25
    # Half as much as with the target's gradients; what interpolation misses, and a chip's slopes of 0.03 in 1,000 px.
    assert np.sqrt((missed**2).mean()) < 0.025 + noise
