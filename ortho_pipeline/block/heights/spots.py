r"""Spot heights as observations of the errors that heights of a DEM share.

At the place of a spot the DEM is :math:`d = L c + e - s` higher than it, with loads :math:`L` of the shared errors, the
own error :math:`e` of the DEM and :math:`s` of the spot. The information on :math:`c` is :math:`L^T W L`, and the slope
of half the sum of squares is :math:`L^T W (d - L c)`. A spot is no tie, and moves nothing in plan.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ortho_pipeline.block.equations.unknowns import Mask
from ortho_pipeline.block.heights.common_heights import CommonHeights
from ortho_pipeline.block.heights.source import DEFAULT_SIGMA, DemHeights
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.json.records import Count, Record
from ortho_pipeline.models.base import Array
from ortho_pipeline.points.heights.spot_heights import SpotHeights

#: A spot with a larger difference, in sigmas, is left out.
_WRONG = 4.0
#: Spots that are farther (m) from the DEM have no other height datum: geoids are at most 107 m off the ellipsoid.
_FARTHEST = 200.0
#: The sigma of a normal distribution over its median absolute value.
NORMAL = 1.4826


@dataclass(frozen=True, eq=False)
class SpotDifferences:
    """A DEM at the places of spot heights.

    Parameters
    ----------
    spots : SpotHeights
    apart : ndarray (n,)
        DEM minus spot, m; NaN where the DEM has no height or no slope.
    slopes : ndarray (n, 2)
        Of the DEM, to the east and to the north.
    stated : ndarray (n,) or None
        Sigmas of the DEM there, m.
    own : ndarray (n,)
        Variances of the errors that heights of the DEM do not share, over their squared sigmas.
    loads : ndarray (n, k)
        Of the shared errors, as those of `CommonHeights`.
    wrong : ndarray (n,) of bool
        Left out: they contradict the others.
    scale : float
        How many times larger than stated the errors of the DEM are (`Heights.scale`).
    """

    spots: SpotHeights
    apart: Array
    slopes: Array
    stated: Array | None
    own: Array
    loads: Array
    wrong: Mask
    scale: float = 1.0

    @classmethod
    def of(cls, source: DemHeights, sigma: float) -> SpotDifferences | None:
        """Return them with the loads of bias and shift; None without spot heights.

        Parameters
        ----------
        sigma : float
            Of the DEM where none is stated, m.

        Raises
        ------
        InputError
            If none of them has a height of the DEM, or that is much farther off than a height datum can be.
        """
        if source.spots is None:
            return None
        ground, stated = source.spots.ground, source.sigmas(source.spots.ground)
        spacing = source.spacing(np.full(len(ground), sigma) if stated is None else stated)
        heights, (slopes, _) = source.heights(ground), source.slopes(ground, spacing)
        apart = np.where(np.isfinite(slopes).all(axis=1), heights - ground[:, 2], np.nan)
        known = np.isfinite(apart)
        if not known.any():
            raise InputError(
                "the DEM has no height at any spot height",
                file=source.spots.source or None,
                field="points.spot_heights",
                remedy="check the CRS of the spot heights, and that the DEM covers them",
            )
        found = cls(
            source.spots,
            apart,
            np.nan_to_num(slopes),
            stated,
            source.sharing(ground),
            np.zeros((len(ground), 3)),
            np.zeros(len(ground), dtype=bool),
        )
        spread = np.sqrt(found.variances(sigma, shared=False))
        middle = float(np.median(apart[known]))
        if abs(middle) > _FARTHEST:
            raise InputError(
                f"the spot heights are {metres(abs(middle))} {'below' if middle > 0 else 'above'} the DEM (median)",
                file=source.spots.source or None,
                field="points.spot_heights",
                remedy=Text("check their unit (metres), CRS and height datum (", Setting("points.spot_vertical"), ")"),
            )
        typical = np.maximum(spread, NORMAL * np.median(np.abs(apart[known] - middle)))
        with np.errstate(invalid="ignore"):
            return replace(found, wrong=np.abs(apart - middle) > _WRONG * typical)

    def with_loads(self, bias: float, shift: float, shared: Array, left: Array | None) -> SpotDifferences:
        """Return them with loads of a bias, a shift, and errors correlated by distance.

        Parameters
        ----------
        bias, shift : float
            Standard deviations, m.
        shared, left : ndarray (n, k - 3), (n,)
            Loads of correlated errors of sigma 1, and the variances left, which replace `own`.
        """
        dem = np.full(len(self.apart), DEFAULT_SIGMA) if self.stated is None else np.nan_to_num(self.stated)
        loads = np.column_stack([np.full(len(self.apart), bias), -shift * self.slopes, shared * dem[:, None]])
        return replace(self, loads=loads, own=self.own if left is None else left)

    def read_again(self, source: DemHeights, sigma: float) -> SpotDifferences:
        """Return them with a DEM that was moved."""
        found = SpotDifferences.of(source, sigma)
        assert found is not None
        loads = self.loads.copy()
        loads[:, 1:3] = -source.shift_sigma * found.slopes
        return replace(self, apart=found.apart, slopes=found.slopes, loads=loads)

    @property
    def used(self) -> Mask:
        """Which take part ``(n,)``."""
        return np.asarray(np.isfinite(self.apart) & ~self.wrong)

    def variances(self, sigma: float, *, shared: bool = True) -> Array:
        """Return the variances ``(n,)`` of the differences without the shared errors, m²; infinite where unknown.

        Parameters
        ----------
        shared : bool
            Larger where neighbours share information, so that together they count as one.
        """
        own = self.own if shared else np.minimum(self.own, 1.0)
        dem = np.full(len(self.apart), sigma) if self.stated is None else self.scale * self.stated
        found = own * dem**2 + self.spots.sigmas**2 + (self.slopes**2).sum(axis=1) * self.spots.plan**2
        return np.where(np.isfinite(found), found, np.inf)

    def residuals(self, common: CommonHeights) -> Array:
        """Return the differences without the shared errors ``(n,)``."""
        return np.asarray(self.apart - self.loads @ (common.value - common.undone))

    def standardised(self, common: CommonHeights, sigma: float) -> Array:
        """Return the sizes of the residuals of those that take part, over their sigmas."""
        sizes = np.abs(self.residuals(common)) / np.sqrt(self.variances(sigma, shared=False))
        return np.asarray(sizes[self.used])

    def judged(self, common: CommonHeights, sigma: float) -> SpotDifferences:
        """Return them without those that contradict an estimate of the shared errors."""
        spread = self.variances(sigma, shared=False) + np.einsum("nk,kl,nl->n", self.loads, common.left, self.loads)
        with np.errstate(invalid="ignore"):
            return replace(self, wrong=np.abs(self.residuals(common)) > _WRONG * np.sqrt(spread))

    def told(self, common: CommonHeights, sigma: float, slope: Array) -> tuple[CommonHeights, Array]:
        """Return the shared errors with the information of the spots, and the slope with their part ``(k,)``."""
        used = self.used
        weighted = self.loads[used] / self.variances(sigma)[used, None]
        told = common.told + weighted.T @ self.loads[used]
        return replace(common, told=told), slope + weighted.T @ self.residuals(common)[used]

    def record(self, common: CommonHeights) -> SpotsRecord:
        """Return the published record."""
        used = self.used
        left, known = self.residuals(common)[used], used if used.any() else np.isfinite(self.apart)
        wrong = np.flatnonzero(self.wrong)
        return SpotsRecord(
            used=int(used.sum()),
            left_out=tuple(self.spots.ids[k] for k in wrong),
            without=int((~np.isfinite(self.apart)).sum()),
            mean_m=float(self.apart[known].mean()) if known.any() else None,
            rms_m=float(np.sqrt((left**2).mean())) if used.any() else None,
        )


class SpotsRecord(Record):
    """Spot heights that fixed the bias of a DEM: their number, the mean of DEM minus spot, and the RMS that is left, m.

    The mean is that of all if none is used. Those in `left_out` contradict the others; `without` counts those where the
    DEM has no height.
    """

    used: Count
    left_out: tuple[str, ...]
    without: Count
    mean_m: float | None
    rms_m: float | None
