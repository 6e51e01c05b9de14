"""Matching with reference orthoimages as records: what was found, and what its points say of the adjusted model."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import NDArray

from ortho_pipeline.display.numbers import metres, px, share, significant
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.estimation.fit import Fit
from ortho_pipeline.estimation.ground_residuals import in_metres
from ortho_pipeline.estimation.records import Adjustment, Count, Pair
from ortho_pipeline.files.json.records import Record

#: Code of the notice of an adjustment to matches: its figures are no absolute ones.
RELATIVE = "relative-to-reference"


class MatchLevel(Record):
    """A level of the search: chips of pixels that are `factor` image pixels wide."""

    factor: Count
    radius: Count
    chips: Count
    agreeing: Count
    shift_px: Pair


class Candidate(Record):
    """A place in the image that was looked for in the references; `reason` is null where it became a point."""

    id: str
    image: Pair
    score: float | None
    reason: str | None


class MatchComponents(Record):
    """What the covariances of the matches are made of (docs/engineering/matching.md)."""

    matching: float
    height_m: float
    other_px: float

    def text(self) -> str:
        """Say what there is of each part."""
        said = []
        if self.matching > 0:
            said.append(f"{significant(self.matching, 3)} times the variance that least-squares matching states for it")
        if self.height_m > 0:
            said.append(f"height errors of {metres(self.height_m)}")
        said.append(f"other errors of {px(self.other_px)} per axis")
        return " + ".join(said)


class MatchCoverage(Record):
    """Matches that were tried and kept in the fields of the image, rows of columns; share of fields with some."""

    share: float
    tried: tuple[tuple[Count, ...], ...]
    kept: tuple[tuple[Count, ...], ...]


class Tested(Record):
    """Root mean square at points that took no part, in pixels and in metres on the ground."""

    n: Count
    px: float
    m: float | None

    @classmethod
    def of(cls, fit: Fit, mask: NDArray[np.bool_]) -> Self | None:
        """Return that of the points of a fit that have a residual; None without any."""
        rows = mask & np.isfinite(fit.residuals).all(axis=1)
        if not rows.any():
            return None
        shifts = in_metres(fit, fit.residuals)[rows]
        ground = float(np.sqrt((shifts**2).sum(axis=1).mean())) if np.isfinite(shifts).all() else None
        image = float(np.sqrt((fit.residuals[rows] ** 2).sum(axis=1).mean()))
        return cls(n=int(rows.sum()), px=image, m=ground)


class MatchingRecord(Record):
    """Matching of the scene with reference orthoimages; `shift_px` is measured minus delivered model.

    `relative` is at matches that were held out, `absolute` at check points that somebody measured.
    """

    references: tuple[str, ...]
    reference_sigma_m: float | None
    dem_sigma_m: float | None
    search_m: float
    search_from: str
    pixel_m: float
    tried: Count
    kept: Count
    control: Count
    check: Count
    reasons: dict[str, int]
    levels: tuple[MatchLevel, ...]
    shift_px: Pair
    shift_m: float
    components: MatchComponents
    sigma_px: float
    correlation: float
    coverage: MatchCoverage
    candidates: tuple[Candidate, ...]
    relative: Tested | None
    absolute: Tested | None

    def floor(self) -> str:
        """Say what the figures of matches leave out."""
        if self.reference_sigma_m is None:
            return Text(
                "The stated accuracy does not include the error of the reference image (state that with ",
                Setting("match.reference_sigma"),
                ").",
            )
        return (
            "The stated accuracy does not include the error of the reference image "
            f"({metres(self.reference_sigma_m)} per axis). The sigmas of the parameters and the accuracy raster do."
        )

    def absolute_text(self) -> str | None:
        """Return the accuracy at measured points that took no part in the adjustment; None without any."""
        if self.absolute is None:
            return None
        ground = "" if self.absolute.m is None else f" ({metres(self.absolute.m)})"
        points = counted(self.absolute.n, "measured check point")
        return f"Absolute: {px(self.absolute.px)}{ground} RMSE at {points} that took no part in the adjustment."

    def text(self) -> str:
        """Say in a line what was matched."""
        names = ", ".join(one.rpartition("/")[2] for one in self.references)
        fields = f"in {share(self.coverage.share)} of the image"
        return f"{self.kept} of {self.tried} matches with {names} kept, {fields}"


def is_relative(adjustment: Adjustment) -> bool:
    """Tell whether an adjustment was to matches, now or when its model file was written."""
    return any(one["code"] == RELATIVE for one in adjustment.notices)
