"""Solutions of control equations of many parameters at given variances, by LAPACK; `node_kernel` has those of few."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ortho_pipeline.block.equations.level_factor import inverse
from ortho_pipeline.models.base import Array

if TYPE_CHECKING:
    from ortho_pipeline.block.variances.node_kernel import Equations


class Solution(NamedTuple):
    """A node as `node_kernel` has it: `weights` ``(n, 3)``, `inverse` ``(n, 3, 3)``, `met` and `taken` of the points.

    `lower` is the factor of the normal equations of z ``(m,)``, None where these are not positive definite.
    """

    weights: Array
    inverse: Array
    met: Array
    taken: Array
    lower: Array | None
    z: Array
    square: float
    likelihood: float


def solved(of: Equations, node: Array) -> Solution:
    """Return the solution with variances `node` ``(3,)`` of measurements, and of unstated ground in plan and height."""
    from scipy.linalg.lapack import dpotrf, dpotrs

    scale, size = 1.0 / node[0], of.k.shape[2]
    weights = np.where(of.unstated, 1.0 / node[[1, 1, 2]], of.stated)
    own = of.u * scale
    own[:, range(3), range(3)] += weights
    with np.errstate(divide="ignore"):
        spread = float(np.linalg.slogdet(own)[1].sum() - np.log(weights[of.unstated]).sum())
    inverse = np.linalg.inv(own)
    right = of.ue * scale + weights * of.d
    met = (inverse @ right[:, :, None])[:, :, 0]
    square = float((weights * of.d**2).sum() - (right * met).sum() + of.counts[2] * scale)
    taken = (inverse @ of.k).reshape(-1, size) * scale
    normal = (of.image - of.flat @ taken) * scale + of.pseudo
    side = (of.image_right - of.flat @ met.ravel()) * scale + of.pseudo_right
    lower, failed = dpotrf((normal + normal.T) / 2, lower=1)
    if failed or not np.isfinite(lower).all():
        return Solution(weights, inverse, met, taken, None, np.full(size, np.nan), math.nan, -math.inf)
    z = dpotrs(lower, side, lower=1)[0]
    square -= float(side @ z)
    spread += (of.counts[0] - of.counts[1]) * math.log(node[0]) + 2.0 * float(np.log(np.diag(lower)).sum())
    return Solution(weights, inverse, met, taken, lower, z, square, -0.5 * (spread + square))


def means(
    of: Equations, nodes: Array, chances: Array, *, moved: bool
) -> tuple[Array, Array, Array, Array, Array, float]:
    """Return what `control_equations.Node` consists of, over nodes ``(b, 3)`` of some chances ``(b,)``."""
    count, size = of.u.shape[0], of.k.shape[2]
    cofactors, ground = np.zeros((size, size)), np.zeros((count, 3, 3))
    for node, chance in zip(nodes, chances, strict=True):
        at = solved(of, node)
        own = np.full((size, size), np.nan) if at.lower is None else inverse(at.lower)
        shift = at.met - (at.taken @ at.z).reshape(count, 3)
        by_point = at.taken.reshape(count, 3, size)
        of_ground = at.inverse + (at.taken @ own).reshape(count, 3, size) @ by_point.swapaxes(1, 2)
        if moved:
            own += np.outer(at.z, at.z)
            of_ground += shift[:, :, None] * shift[:, None, :]
        cofactors += chance * own
        ground += chance * of_ground
    return at.z, cofactors, shift, ground, at.weights, at.square
