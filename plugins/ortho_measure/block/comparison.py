"""Corrections of a block compared: each adjusted to the same points, judged by what took no part, and one recommended.

As `ortho compare` does it of one scene (`estimation.choice.comparison`): gross errors are left out for all alike, and
of corrections within 5 % of the smallest error the one with the fewest parameters is taken.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ortho_measure.block.solution import BlockSolution, solve
from ortho_pipeline.block.heights.source import DemHeights
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.start import Start
from ortho_pipeline.errors import OrthoError
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.models.base import Array
from ortho_pipeline.options.texts import counted

#: Smaller differences of the error, as a factor, are not worth a parameter (as in `estimation.choice.comparison`).
_WORTH = 1.05
#: Fewer points than this are too few to choose by.
_FEWEST = 3


@dataclass(frozen=True, eq=False)
class _Tried:
    """A correction and the adjustment with it."""

    name: str
    parameters: int
    solution: BlockSolution

    def errors(self, role: str) -> Array:
        """Return how far points ``(n,)`` of a role (m) are from where the block without their ground puts them."""
        fit, without = self.solution.fit, self.solution.left_out
        if fit is None or without is None:
            return np.zeros(0)
        return np.asarray(np.linalg.norm(without.ground[fit.points.roles == role], axis=1))

    @property
    def rays(self) -> Array:
        """How far rays ``(M,)`` (px) are from where the others put them."""
        without = self.solution.left_out
        return np.zeros(0) if without is None else np.asarray(np.linalg.norm(without.rays, axis=1))

    def row(self) -> dict[str, Any]:
        """Return the row of the table."""
        figures = {
            "check_m": _rms(self.errors("check")),
            "loo_m": _rms(self.errors("control")),
            "rays": _rms(self.rays),
        }
        told = {"model": self.name, "parameters": self.parameters, "error": self.solution.error or None, **figures}
        return dict(json_value(told))


def compare_corrections(
    starts_of: Callable[[str], Mapping[str, Start]],
    names: Sequence[str],
    points: BlockPoints,
    hold: float | None,
    heights: DemHeights | None = None,
) -> dict[str, Any]:
    """Return rows and recommendation, as JSON values.

    Parameters
    ----------
    starts_of : callable
        Of the name of a correction; raises an OrthoError where a model cannot be corrected so.
    """
    known: dict[str, Mapping[str, Start]] = {}
    for name in names:
        try:
            known[name] = starts_of(name)
        except OrthoError:
            continue
    first = [solve(starts, points, hold, heights=heights) for starts in known.values()]
    votes = Counter(
        one.point for found in first if found.fit for one in {r.point: r for r in found.fit.rejected}.values()
    )
    wrong = {name for name, count in votes.items() if 2 * count > sum(found.fit is not None for found in first)}
    kept = points.select(~np.isin(np.array(points.ids), list(wrong))) if wrong else points
    tried = [
        _Tried(
            name,
            sum(len(start.model.params) for start in starts.values()),
            solve(starts, kept, hold, heights=heights, robust=False),
        )
        for name, starts in known.items()
    ]
    model, reason = _recommended([one for one in tried if one.solution.fit is not None])
    return {
        "rows": [one.row() for one in tried],
        "left_out": sorted(wrong),
        "recommendation": {"model": model, "reason": reason},
    }


def _recommended(tried: Sequence[_Tried]) -> tuple[str | None, str]:
    """Return the correction to take, and why."""
    of_ground = {one.name: np.concatenate([one.errors("check"), one.errors("control")]) for one in tried}
    of_rays = {one.name: one.rays for one in tried}
    for errors, what, unit in (
        (of_ground, "points whose ground coordinates took no part", "m"),
        (of_rays, "rays left out", "px"),
    ):
        tested = {name: values for name, values in errors.items() if np.isfinite(values).any()}
        if not tested:
            continue
        common = np.all([np.isfinite(values) for values in tested.values()], axis=0)
        if common.sum() < _FEWEST:
            continue
        sizes = {name: _rms(values[common]) or 0.0 for name, values in tested.items()}
        smallest = min(sizes.values())
        able = [one for one in tried if one.name in sizes and sizes[one.name] <= _WORTH * smallest]
        chosen = min(able, key=lambda one: (one.parameters, sizes[one.name]))
        text = (
            f"{sizes[chosen.name]:.3g} {unit} at {common.sum()} {what}, with {counted(chosen.parameters, 'parameter')}"
        )
        least = min(sizes, key=lambda name: sizes[name])
        if least != chosen.name:
            text += (
                f"; {least} has {smallest:.3g} {unit}, less by 5 % at most, so that with fewer parameters is preferred"
            )
        return chosen.name, text
    return None, "fewer than three points test every correction: too few to choose by"


def _rms(values: Array) -> float | None:
    good = values[np.isfinite(values)]
    return float(np.sqrt((good**2).mean())) if len(good) else None
