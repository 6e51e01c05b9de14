"""Compare corrections of a block: adjust each to the same points, test it at left-out points, and recommend one.

Gross errors are left out for all corrections. Among corrections within 5 % of the smallest error at points with known
ground, the one with the fewest parameters is recommended. Ties alone hardly show errors of many parameters: a left-out
ray is predicted by its neighbours. Then Akaike's criterion decides (`estimation.choice.expected_error`), unless a
correction with fewer parameters has a sigma0 or left-out rays within 5 % of the criterion's choice.
"""

from __future__ import annotations

import math
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
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.choice.expected_error import criterion
from ortho_pipeline.files.json.values import json_value
from ortho_pipeline.models.base import Array

#: A smaller improvement of the error (a factor) does not justify more parameters.
_WORTH = 1.05
#: Least number of points for a recommendation.
_FEWEST = 3


@dataclass(frozen=True, eq=False)
class _Tried:
    """A correction and the adjustment with it."""

    name: str
    parameters: int
    solution: BlockSolution

    def errors(self, role: str) -> Array:
        """Return the leave-one-out errors ``(n,)`` (m) of the ground of points of a role."""
        fit, without = self.solution.fit, self.solution.left_out
        if fit is None or without is None:
            return np.zeros(0)
        return np.asarray(np.linalg.norm(without.ground[fit.points.roles == role], axis=1))

    @property
    def redundancy(self) -> int:
        """Redundancy of the adjustment; 0 without one."""
        return 0 if self.solution.fit is None else self.solution.fit.redundancy

    @property
    def sigma0(self) -> float:
        """Factor of the stated sigmas; infinite without redundancy."""
        fit = self.solution.fit
        return math.inf if fit is None or fit.sigma0 is None else fit.sigma0

    def criterion(self, observations: int) -> float:
        """Return Akaike's criterion for the number of observations that are left without any correction."""
        if not math.isfinite(self.sigma0):
            return math.inf
        return criterion(self.sigma0**2 * self.redundancy, observations, observations - self.redundancy)

    @property
    def rays(self) -> Array:
        """Leave-one-out errors of rays ``(M,)`` (px)."""
        without = self.solution.left_out
        return np.zeros(0) if without is None else np.asarray(np.linalg.norm(without.rays, axis=1))

    def row(self) -> dict[str, Any]:
        """Return the row of the table."""
        figures = {
            "check_m": _rms(self.errors("check")),
            "loo_m": _rms(self.errors("control")),
            "rays": _rms(self.rays),
        }
        row = {"model": self.name, "parameters": self.parameters, "error": self.solution.error or None, **figures}
        return dict(json_value(row))


def compare_corrections(
    starts_of: Callable[[str], Mapping[str, Start]],
    names: Sequence[str],
    points: BlockPoints,
    hold: float | None,
    heights: DemHeights | None,
) -> dict[str, Any]:
    """Return rows and recommendation, as JSON values.

    Parameters
    ----------
    starts_of : callable
        Called with the name of a correction; raises an OrthoError if a model cannot have it.
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
    """Return the recommended correction, and the reason."""
    observations = max((one.redundancy for one in tried), default=0)
    for errors, what, unit in (
        (lambda one: np.concatenate([one.errors("check"), one.errors("control")]),
         "points (their ground coordinates left out)", "m"),
        (lambda one: one.rays, "rays (leave-one-out)", "px"),
    ):  # fmt: skip
        tested = {one: errors(one) for one in tried}
        tested = {one: values for one, values in tested.items() if np.isfinite(values).any()}
        common = np.all([np.isfinite(values) for values in tested.values()], axis=0) if tested else np.zeros(0)
        if common.sum() < _FEWEST:
            continue
        sizes = {one: _rms(values[common]) or 0.0 for one, values in tested.items()}
        least = min(sizes, key=lambda one: sizes[one])
        close = [one for one in sizes if sizes[one] <= _WORTH * sizes[least]]
        if unit == "px":
            best = min(sizes, key=lambda one: (one.criterion(observations), one.parameters))
            near = _WORTH * sizes[best], _WORTH * best.sigma0
            close = [one for one in sizes if sizes[one] <= near[0] or one.sigma0 <= near[1]]
        chosen = min(close, key=lambda one: (one.parameters, sizes[one]))
        text = f"RMSE {sizes[chosen]:.3g} {unit} at {common.sum()} {what}; {counted(chosen.parameters, 'parameter')}"
        if least is not chosen:
            more = f"{least.name} has RMSE {sizes[least]:.3g} {unit}"
            text += f". {more}, but these points do not justify its {counted(least.parameters, 'parameter')}"
        return chosen.name, text
    return None, "fewer than three points test all corrections, too few for a recommendation"


def _rms(values: Array) -> float | None:
    good = values[np.isfinite(values)]
    return float(np.sqrt((good**2).mean())) if len(good) else None
