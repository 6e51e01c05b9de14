r"""The errors that an adjusted DEM still has, together with those of the parameters of the images.

An ortho over the DEM has two errors, of the image and of the height. Both depend on the unknowns that heights share, so
they cancel in part: over a DEM that is too high, an adjusted image is where its orthos fit those of its neighbours.
With :math:`u`, the errors of these unknowns, the adjusted heights err by :math:`k - L u` and parameters by
:math:`B u` and a part that is independent of :math:`u`.
"""

from __future__ import annotations

from dataclasses import dataclass

from ortho_pipeline.models.base import Array


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
    own : ndarray (N,)
        Standard deviations of the errors that each sample of the DEM has of its own, m.
    sample : float
        Side of a sample, m.
    """

    known: Array
    loads: Array
    by_params: Array
    covariance: Array
    own: Array
    sample: float
