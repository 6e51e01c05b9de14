"""Known points that are far from where a block puts them: named, and left as they are.

Check points take no part with their ground, so nothing of theirs is ever left out; what is wrong with one of them
spoils the accuracy that is stated. Control points with little influence can be far off without being rejected. Both are
tested here against the covariance of the adjusted ground and the accuracy of their own, and said.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np

from ortho_pipeline.block.equations.problem import BlockProblem
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.points import BlockPoints
from ortho_pipeline.block.reliability.standardised_residuals import standardise_ground
from ortho_pipeline.block.variances.components import Variances
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.estimation.blunders import FAR_ABOVE, NAMED, OUTLYING_RISK, are_alike, contradicting
from ortho_pipeline.estimation.statistics import chance_of, rms
from ortho_pipeline.files.json.records import Record
from ortho_pipeline.models.base import Array

#: The least distance (m) that a text shows. The ground of control with a sigma of a millimetre cannot move so far.
_SHOWN = 0.005


class ContradictedPoint(Record):
    """A known point that the block contradicts, and that was left as it is."""

    # How far it is off, and the same over its standard deviation (root of the mean square of the axes).
    point: str
    role: Literal["control", "check"]
    what: Literal["plan", "height", "ground"]
    metres: float
    sigmas: float

    def notice(self) -> Notice:
        """Say it to people."""
        kept = "the accuracy still counts it" if self.role == "check" else "the adjustment still uses it"
        text = f"{self.role} point {self.point}: {self.place}; {kept}: check its coordinates and measurements"
        return Notice("contradicting-point", text, point=self.point, role=self.role)

    @property
    def place(self) -> str:
        """How far which part of it is off."""
        what = {"plan": "position in plan", "height": "height", "ground": "position"}[self.what]
        if self.metres < _SHOWN:
            return f"its image measurements contradict its given {what} ({self.sigmas:.1f} sigma)"
        return f"its given {what} differs by {self.metres:.2f} m ({self.sigmas:.1f} sigma) from that of the block"


def outlying(
    solved: Solved, variances: Variances, residuals: Array, covariance: Array, used: Mask
) -> tuple[ContradictedPoint, ...]:
    """Return the check points, and the control points that were used, which the block contradicts.

    Parameters
    ----------
    residuals : ndarray (N, 3)
        Known minus adjusted ground, metres east, north, up.
    covariance : ndarray (N, 3, 3)
        Of the adjusted ground, m².
    used : ndarray (N,) of bool
        Whose ground was used.
    """
    problem, points = solved.problem, solved.problem.points
    own = _sigmas(problem, variances)
    freedom = max(variances.redundancy[0], 1.0)
    found: list[tuple[int, str, float, float, float]] = []
    for k in np.flatnonzero(points.check):
        for what, axes in (("plan", (0, 1)), ("height", (2,))):
            apart, part = residuals[k, axes], covariance[k][np.ix_(axes, axes)]
            if not (np.isfinite(apart).all() and np.isfinite(part).all()):
                continue
            spread = part + np.diag(own[k, axes] ** 2)
            square = float(apart @ np.linalg.solve(spread, apart)) / len(axes)
            if variances.estimated and (points.sigma_ground[k, axes] == 0).any():
                chance = variances.chance_of(apart, part, axes)
            else:
                chance = float(chance_of(len(axes) * square, len(axes), freedom))
            found.append((int(k), what, math.hypot(*apart), math.sqrt(square), chance))
    squares, ranks = standardise_ground(solved)
    for k in np.flatnonzero(used & (ranks > 0)):
        of = min(freedom, variances.freedom) if problem.unstated[k].any() else freedom
        apart, square = residuals[k, np.isfinite(residuals[k])], float(squares[k] / ranks[k])
        chance = float(chance_of(squares[k], ranks[k], of))
        found.append((int(k), "ground", float(np.linalg.norm(apart)), math.sqrt(square), chance))
    return tuple(
        ContradictedPoint.model_validate(
            {
                "point": points.ids[k],
                "role": str(points.roles[k]),
                "what": what,
                "metres": metres,
                "sigmas": sigmas,
            }
        )
        for k, what, metres, sigmas, chance in found
        if chance < OUTLYING_RISK / len(found)
    )


def notices(doubts: Sequence[ContradictedPoint], points: BlockPoints, residuals: Array) -> list[Notice]:
    """Return a notice for each contradicting point; one for all check points where their RMSE tells no accuracy.

    That is where it is more than twice that of the others in plan or in height, or no more of them agree than
    contradict.

    Parameters
    ----------
    residuals : ndarray (N, 3)
        Known minus adjusted ground, metres east, north, up.
    """
    names = list(dict.fromkeys(one.point for one in sorted(doubts, key=lambda one: -one.sigmas) if one.role == "check"))
    tested = points.check & np.isfinite(residuals).any(axis=1)
    off = tested & np.isin(points.ids, names)
    sizes = {"plan": np.hypot(residuals[:, 0], residuals[:, 1]), "height": np.abs(residuals[:, 2])}
    every = {what: rms(size[tested]) for what, size in sizes.items()}
    rest = {what: rms(size[tested & ~off]) for what, size in sizes.items()}
    spoilt = 2 * off.sum() >= tested.sum() or any(every[what] > FAR_ABOVE * rest[what] for what in sizes)
    if not (names and spoilt):
        return [one.notice() for one in doubts]
    who = contradicting(int(off.sum()), int(tested.sum()), names, "the block")
    without = "" if not (tested & ~off).any() else f", {_both(rest)} without {'it' if off.sum() == 1 else 'them'}"
    places = "; ".join(f"{one.point}: {one.place}" for one in doubts if one.point in names[:3])
    text = f"{who}: RMSE {_both(every)} over all {tested.sum()}{without}; {places}"
    fields = {
        "count": int(tested.sum()),
        "off": int(off.sum()),
        "rmse_m": every,
        "points": names[:NAMED],
        "rest_m": rest if without else None,
        "alike": are_alike(np.nan_to_num(residuals[off])),
    }
    others = [one.notice() for one in doubts if one.role == "control" or one.point not in names[:NAMED]]
    return [Notice("checks-apart", text, **fields), *others]


def _both(rmse: Mapping[str, float]) -> str:
    return f"{rmse['plan']:.2f} m in plan and {rmse['height']:.2f} m in height"


def _sigmas(problem: BlockProblem, variances: Variances) -> Array:
    """Return the sigmas ``(N, 3)`` of known ground; for check points that state none, those of control."""
    stated = problem.points.sigma_ground
    control = stated[problem.points.control]
    found = np.zeros(3)
    for axis, estimated in enumerate((variances.sigma_xy, variances.sigma_xy, variances.sigma_h)):
        known = control[control[:, axis] > 0, axis]
        found[axis] = estimated if estimated is not None else (np.median(known) if len(known) else 0.0)
    return np.where(stated > 0, stated, found)
