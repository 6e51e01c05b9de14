"""The candidates of a matching joined with the points that the adjustment has of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ortho_pipeline.estimation.records import Pair, Point, is_known
from ortho_pipeline.report.matching import Candidate
from ortho_pipeline.report.records import SceneReport


@dataclass(frozen=True)
class MatchPoint:
    """A candidate and the point it became: None where the matcher rejected it, or the report has no such point."""

    candidate: Candidate
    point: Point | None

    @property
    def kind(self) -> str:
        """What it is drawn as: control, check, out, or the key of the reason why it is no point."""
        if self.candidate.reason is not None:
            return self.candidate.reason
        return "out" if self.point is None else self.point.kind

    @property
    def residual(self) -> Pair | None:
        """Measured minus predicted, px; None where it is no point."""
        return self.point.residual if self.point is not None and is_known(self.point.residual) else None

    @property
    def length(self) -> float:
        """Length of the residual, px; -1 without one."""
        return -1.0 if self.residual is None else math.hypot(*self.residual)


def shown(report: SceneReport) -> list[MatchPoint]:
    """Return all candidates of a report, in their order; none where nothing was matched."""
    if report.matching is None:
        return []
    # Beside points of a file of the same name a match is renamed; it stays where it is.
    points = {point.image: point for point in report.adjustment.points}
    return [MatchPoint(one, points.get(one.image)) for one in report.matching.candidates]


def in_words(reason: str) -> str:
    """Return why a match was not kept."""
    from ortho_pipeline.imaging.matching import REASONS

    return REASONS.get(reason, reason)
