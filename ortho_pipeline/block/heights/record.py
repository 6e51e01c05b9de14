"""The record of the heights of a DEM in a block, and its notices."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.heights.adjusted_dem import known_errors
from ortho_pipeline.block.heights.source import FREE_BIAS
from ortho_pipeline.block.heights.spots import SpotsRecord
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors.texts import Setting, Text, counted
from ortho_pipeline.files.json.records import Count, Pair, Record

if TYPE_CHECKING:
    from ortho_pipeline.block.heights.settling import Heights

#: A shift and correlated errors of the DEM are significant if such large ones are less probable than this by chance.
_SIGNIFICANT = 0.001
#: Heights have different datums if they differ by more than this (m), and by more than so many sigmas; so many spot
#: heights that contradict all others show it, too.
_DATUMS, _ALLOWED, _ENOUGH = 20.0, 4.0, 3
#: A notice names so many points.
_NAMED = 10


class HeightsRecord(Record):
    """What a block took from a DEM: how many heights, their sigma, and the DEM's bias and shift, metres.

    The heights of `left_out` contradict their ties. At breaks the DEM is no plane, `on_water` it is flattened; ties
    `without` a height are in voids or outside the DEM. Shifts are east and north; `shift_chance` is the probability of
    one as large without a shift. A prior is the standard deviation before the adjustment. A stated sigma is enlarged if
    the residuals are significantly larger; that of correlated errors is contradicted, and stays. `mean_error_m` is the
    mean of the shared errors at the ties, without a shift that was applied.
    """

    used: Count
    left_out: tuple[str, ...]
    at_breaks: Count
    without: Count
    sigma_m: float
    sigma_is: Literal["stated", "enlarged", "estimated", "assumed", "contradicted"]
    rms_m: float | None
    mean_error_m: float
    bias_m: float
    bias_sigma_m: float
    bias_prior_m: float
    shift_m: Pair
    shift_sigma_m: Pair
    shift_prior_m: float
    shift_chance: float | None
    shift_applied: bool
    correlation_m: float | None
    spots: SpotsRecord | None = None
    on_water: Count = 0

    @property
    def shift_significant(self) -> bool:
        """Whether the DEM is shifted by more than chance explains."""
        return self.shift_chance is not None and self.shift_chance < _SIGNIFICANT

    def notices(self) -> list[Notice]:
        """Return notices of an unstated sigma, of a shift, and of heights that were left out."""
        found = []
        if self.sigma_is == "assumed":
            text = f"DEM accuracy not given; assuming {metres(self.sigma_m)}"
            found.append(Notice("dem-sigma-by-default", text, dem_sigma_m=self.sigma_m))
        elif self.sigma_is == "estimated":
            size, used = metres(self.sigma_m), counted(self.used, "height")
            text = (
                f"DEM accuracy not given; its scatter is estimated as {size} from {used}. An error that all heights "
                f"share has a sigma of {metres(self.bias_prior_m)} before the adjustment"
            )
            found.append(Notice("dem-sigma-estimated", text, dem_sigma_m=self.sigma_m, count=self.used))
        elif self.sigma_is == "enlarged":
            text = Text(
                f"DEM and ties differ more than the stated DEM accuracy allows; using {metres(self.sigma_m)}, "
                f"estimated from {counted(self.used, 'height')}. Roofs and trees cause this"
            )
            found.append(Notice("dem-sigma-enlarged", text, dem_sigma_m=self.sigma_m, count=self.used))
        elif self.sigma_is == "contradicted":
            text = Text(
                f"DEM and ties differ more than a DEM accuracy of {metres(self.sigma_m)} allows. It was used as it is, "
                "because its errors count as correlated (",
                Setting("points.dem_correlation"),
                "), so all sigmas are too small. Roofs and trees cause this, too",
            )
            found.append(Notice("dem-sigma-contradicted", text, dem_sigma_m=self.sigma_m, count=self.used))
        if self.left_out:
            number, named = len(self.left_out), self.left_out[:_NAMED]
            left_out = (
                f"the DEM contradicts {counted(number, 'tie')}, for example on roofs and trees. The heights were not "
                f"used, the ties were ({', '.join(named)})"
            )
            found.append(Notice("heights-left-out", left_out, count=number, points=list(named)))
        if self.shift_significant:
            east, north = self.shift_m
            size, sigma = metres(math.hypot(east, north)), metres(max(self.shift_sigma_m))
            part = f"{size} ({east:+.1f} m east, {north:+.1f} m north, sigma {sigma})"
            remedy: tuple[str | Setting, ...] = ("The DEM was moved by this",)
            if not self.shift_applied:
                remedy = ("If the images are right, move the DEM with ", Setting("points.dem_shift", "estimate"))
            apart = "the DEM and the images are displaced from each other"
            chance = "chance alone would do this in less than 1 of 1000 cases"
            doubt = "It is not certain which of both is off, so the adjustment divides the displacement between both"
            text = Text(f"{apart} ({chance}). {doubt}. Estimated shift of the DEM: {part}. ", *remedy)
            fields = {"east_m": east, "north_m": north, "chance": self.shift_chance}
            found.append(Notice("dem-shifted", text, applied=self.shift_applied, **fields))
        return [*found, *self._of_known_heights()]

    def _of_known_heights(self) -> list[Notice]:
        """Return notices of a DEM of another height datum, and of spot heights that were left out."""
        datums, spots = self._between_datums(), self.spots
        found = [] if datums is None else [datums]
        if spots is not None and spots.left_out and (spots.used or datums is None):
            number, named = len(spots.left_out), spots.left_out[:_NAMED]
            who = counted(number, "spot height contradicts", "spot heights contradict")
            left_out = f"{who} the DEM and the other spot heights; not used: {', '.join(named)}"
            found.append(Notice("spot-heights-left-out", left_out, count=number, points=list(named)))
        return found

    def _between_datums(self) -> Notice | None:
        """Return a notice if spot heights, or the block, are farther from the DEM than its accuracy allows."""
        difference, spots = self.bias_m, self.spots
        if spots is not None and not spots.used and len(spots.left_out) >= _ENOUGH and spots.mean_m is not None:
            difference = spots.mean_m - self.bias_m
        elif spots is not None and not spots.used:
            spots = None
        free = self.spots is not None and self.bias_prior_m == FREE_BIAS
        allowed = self.sigma_m if free else max(self.sigma_m, self.bias_prior_m)
        if abs(difference) < max(_DATUMS, _ALLOWED * math.hypot(allowed, self.bias_sigma_m)):
            return None
        side, what = "above" if difference > 0 else "below", "block" if spots is None else "spot heights"
        text = (
            f"the DEM is {metres(abs(difference))} {side} the {what}, although its accuracy is {metres(allowed)}: "
            "their heights probably have different datums"
        )
        remedy = () if spots is None else (" (", Setting("points.spot_vertical"), ")")
        fields = {"median_m": -difference, "spread_m": self.bias_sigma_m, "moved_m": None}
        return Notice("heights-disagree", Text(text, *remedy), **fields)


def record_of(heights: Heights, solved: Solved) -> HeightsRecord:
    """Return the record of the heights of a solution."""
    rows = solved.linear.ordering.grounded
    planes = solved.problem.heights
    assert planes is not None
    used = rows[planes.on[rows]]
    apart = planes.above(solved.state.local)[used]
    sigmas = heights.sigmas[used if len(used) else heights.of]
    known = sigmas[np.isfinite(sigmas)]
    bias, bias_sigma = heights.common.bias
    active = np.zeros(len(heights.of), dtype=bool)
    active[solved.linear.ordering.numbers] = True
    wrong, broken = active & heights.wrong, active & heights.broken & ~heights.wrong
    water = active & heights.terrain.water & ~wrong & ~broken
    shift, shift_covariance = heights.common.shift(heights.source.shift_sigma)
    return HeightsRecord(
        used=len(used),
        left_out=tuple(solved.problem.points.ids[k] for k in np.flatnonzero(wrong)),
        at_breaks=int(broken.sum()),
        on_water=int(water.sum()),
        without=int((active & heights.of & ~wrong & ~broken & ~water).sum()) - len(used),
        sigma_m=float(np.sqrt(np.mean(known**2))) if len(known) else heights.sigma,
        # Those of correlated errors are not enlarged: roofs would count as errors of the DEM over long distances.
        sigma_is="contradicted" if heights.common.chance_of_correlated < _SIGNIFICANT else heights.sigma_is,
        rms_m=float(np.sqrt(np.mean(apart**2))) if len(used) else None,
        mean_error_m=float(known_errors(heights)[used].mean()) if len(used) else 0.0,
        bias_m=bias,
        bias_sigma_m=bias_sigma,
        bias_prior_m=heights.common.sigma,
        shift_m=tuple(shift.tolist()),
        shift_sigma_m=tuple(np.sqrt(np.diag(shift_covariance)).tolist()),
        shift_prior_m=heights.source.shift_sigma,
        shift_chance=heights.common.chance,
        shift_applied=heights.source.correct_shift,
        correlation_m=heights.source.correlation,
        spots=None if heights.spots is None else heights.spots.record(heights.common),
    )
