r"""What neighbouring matches of each image err together, and what it does to the parameters of a block.

As for one image (`estimation.spatial.shared_errors`), for each by itself: of the whitened residuals of its measurements
with a group, what no value of its parameters explains says how alike neighbours err. With the rows :math:`F` of these
measurements, the ground of their points eliminated, and cofactors :math:`C` of all parameters, it adds
:math:`C F^T (\Sigma - \sigma_0^2 I) F C` to their covariance, summed over images. What two images share of one
reference counts as if each had its own: nothing tells it apart from the rest. What all matches of an image err alike,
which residuals do not show, is added as it is known (`MATCHED_ALIKE`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ortho_pipeline.block.equations.cofactors import Cofactors
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.solver import Solved
from ortho_pipeline.block.points import Index
from ortho_pipeline.block.shared.common_error import BlockCommonError
from ortho_pipeline.estimation.spatial.shared_errors import (
    MATCHED_ALIKE,
    SharedErrors,
    positive_part,
    shared_by,
)
from ortho_pipeline.models.base import Array

#: Of blocks with more parameters it is not estimated: each measurement has an influence on all of them.
MOST_PARAMETERS = 1000


@dataclass(frozen=True, eq=False)
class SharedByImage:
    """What neighbours share by name of the image, and what it adds, R X R', to the covariance of the parameters.

    `root` is ``(P, m)``, `inner` ``(m, m)``.
    """

    images: dict[str, SharedErrors]
    root: Array
    inner: Array

    @classmethod
    def of(cls, solved: Solved, common: BlockCommonError | None = None) -> SharedByImage | None:
        """Return it of the measurements of a solution that have groups, and stand on known ground.

        None without any, and of a block with more than `MOST_PARAMETERS`.

        Parameters
        ----------
        common : BlockCommonError, optional
            What known ground has in common, as it was settled: its estimate errs with these measurements, too.
        """
        from scipy.linalg import block_diag

        problem, sigma0 = solved.problem, solved.unit_weight()[0]
        points = problem.points
        if sigma0 is None or points.groups is None or problem.size > MOST_PARAMETERS:
            return None
        known = np.zeros(len(points), dtype=bool)
        known[solved.linear.ordering.grounded] = True
        images, roots, inners = dict[str, SharedErrors](), list[Array](), list[Array]()
        for image, used in enumerate(solved.linear.ordering.rays_of_image):
            rays = used[(points.groups[used] >= 0) & known[points.point[used]]]
            own = problem.columns.of_image(image)
            if not len(rays) or not len(own):
                continue
            design, unit = _rows(solved.linear, rays)[:, :, : len(own)], np.zeros((problem.size, len(own)))
            unit[own] = np.eye(len(own))
            root = solved.cofactors.times(unit)
            if common is not None and common.told.any():
                design = np.concatenate([design, common.seen[rays]], axis=2)
                root = np.hstack([root, common.by_params @ common.left])
            images[points.images[image]], inner = _estimated(solved, rays, design, sigma0**2)
            roots.append(root)
            inners.append(inner)
        if not images:
            return None
        return cls(images, np.hstack(roots), block_diag(*inners))

    def added(self, covariance: Cofactors) -> Cofactors:
        """Return a covariance of the parameters with it."""
        return covariance.mixed(1.0, self.root, self.inner)


def _rows(linear: Linear, rays: Index) -> Array:
    """Return the partials ``(n, 2, p)`` of rays of known ground by their own images' parameters, the ground eliminated.

    Further rays of the same points are left out of account: known ground is what holds them.
    """
    points = linear.problem.points
    by_point, ground = linear.by_point[rays], linear.ground_by_point[points.point[rays]]
    turned = by_point.swapaxes(1, 2)
    inverse = np.linalg.inv(turned @ by_point + ground.swapaxes(1, 2) @ ground)
    partials = linear.by_params[rays]
    return np.asarray(partials - by_point @ inverse @ (turned @ partials))


def _estimated(solved: Solved, rays: Index, design: Array, variance: float) -> tuple[SharedErrors, Array]:
    """Return what neighbours share, and F' (Sigma - variance I) F ``(m, m)`` of a design F ``(n, 2, m)``.

    Sigma contains what all of them err alike.
    """
    points, size = solved.problem.points, design.shape[2]
    sigmas = points.sigma_image[rays, None, None]
    shift = points.whitened(np.broadcast_to(np.eye(2), (len(rays), 2, 2)) / sigmas, rays)
    residuals = solved.linear.misfits.rays[rays]
    found, excess = shared_by(points.measured[rays], residuals, design, points.grouped[rays], shift, shift, variance)
    flat = design.reshape(-1, size)
    moved = MATCHED_ALIKE * flat.T @ shift.reshape(-1, 2)
    if excess is None:
        own = (found.points / found.groups - 1.0) * variance * flat.T @ flat
    else:
        own = positive_part(excess, flat)
    return found, own + moved @ moved.T
