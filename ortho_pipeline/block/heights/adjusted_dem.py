r"""The errors that an adjusted DEM still has, together with those of the parameters of the images.

An ortho over the DEM has two errors, of the image and of the height. Both depend on the unknowns that heights share, so
they cancel in part: over a DEM that is too high, an adjusted image is where its orthos fit those of its neighbours.
With :math:`u`, the errors of these unknowns, the adjusted heights err by :math:`k - L u` and parameters by
:math:`B u` and a part that is independent of :math:`u`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ortho_pipeline.models.base import Array

if TYPE_CHECKING:
    from ortho_pipeline.block.heights.settling import Heights
    from ortho_pipeline.block.shared.priors import SharedPriors


@dataclass(frozen=True, eq=False)
class AdjustedDem:
    """What the heights of N points, in the DEM as orthos use it, have of the errors that all heights share.

    Parameters
    ----------
    known : ndarray (N,)
        The part :math:`k` that is estimated but not corrected, m; the correction is one for all heights.
    loads : ndarray (N, k)
        :math:`L`, m; NaN for points without a height.
    by_params : ndarray (P, k)
        :math:`B`.
    covariance : ndarray (k, k)
        Of :math:`u`.
    slopes : ndarray (N, 2)
        Of the DEM to the east and north, 0 where they are unknown.
    own : ndarray (N,)
        Standard deviations of the errors that each sample of the DEM has of its own, m.
    sample : float
        Side of a sample, m.
    """

    known: Array
    loads: Array
    by_params: Array
    covariance: Array
    slopes: Array
    own: Array
    sample: float

    @classmethod
    def of(cls, heights: Heights, priors: SharedPriors | None, mean: float) -> AdjustedDem:
        """Return it of heights that were adjusted with parameters that images share, less a mean (m)."""
        common = heights.common
        loads, by_params, covariance = common.loads, common.by_params, common.left
        if priors is not None:
            none = np.zeros((len(common.left), len(priors.value)))
            loads = np.hstack([loads, loads @ priors.by_heights])
            by_params = np.hstack([by_params, priors.by_params])
            covariance = np.block([[covariance, none], [none.T, priors.left]])
        with_height = heights.of & np.isfinite(heights.terrain.heights) & np.isfinite(heights.sigmas)
        return cls(
            known=known_errors(heights) - mean,
            loads=np.where(with_height[:, None], loads, np.nan),
            by_params=by_params,
            covariance=covariance,
            slopes=np.nan_to_num(heights.terrain.slopes),
            own=heights.sigmas * np.sqrt(heights.own),
            sample=heights.source.surface.sample_size,
        )


def known_errors(heights: Heights) -> Array:
    """Return estimates ``(N,)`` of the errors that heights share, m; a shift that later products correct is none."""
    common = heights.common
    value = common.value - common.undone if heights.source.correct_shift else common.value
    return np.asarray(common.loads @ value)
