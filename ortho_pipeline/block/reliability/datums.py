"""Points, cameras and a DEM of different datums, by errors that are alike.

Control points of another datum agree with each other, so none of them is a gross error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.block.reliability.poses import changes_of
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import metres
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.statistics import rms
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.orientation import EXTERIOR

#: Errors of so many points or more are alike if their mean is so many times their scatter and their accuracy.
_ENOUGH, _ALIKE = 3, 3.0


def doubtful_datums(fit: BlockFit, pseudo: Sequence[Pseudo]) -> list[Notice]:
    """Return a notice for each sign that points, cameras and DEM have different datums.

    Control without a stated accuracy differs alike from the block. Other control moves the cameras alike, or changes
    the focal length: over flat ground that is a height.

    Parameters
    ----------
    pseudo : sequence of Pseudo
        What was known of the parameters.
    """
    own, residuals = np.hypot(fit.points.sigma_ground, fit.ground_sigmas), fit.object_residuals
    of_points, of_cameras, signs = list[str](), list[str](), list[str]()
    for axis, (what, name) in enumerate(zip(("east", "north", "in height"), EXTERIOR[:3], strict=True)):
        rows = fit.used_ground & np.isfinite(residuals[:, axis] + own[:, axis])
        of_points += _alike(what, residuals[rows, axis], own[rows, axis])
        of_cameras += _alike(what, *changes_of(name, fit, pseudo))
    if of_points:
        who = counted(int(fit.used_ground.sum()), "control point")
        signs.append(f"{who} differ alike from the block, by {' and '.join(of_points)}")
    if of_cameras:
        signs.append(f"the adjustment moves the cameras alike, by {' and '.join(of_cameras)}")
    for one in () if fit.shared_priors is None else fit.shared_priors.records:
        change, known_within = one.value - one.prior.value, one.prior.sigma or math.inf
        if one.name == "focal_length" and abs(change) > _ALIKE * known_within:
            by = f"{change / one.prior.value:+.1%}, although its accuracy is {known_within / one.prior.value:.1%}"
            signs.append(f"the adjustment changes the focal length by {by}")
    text = "points, cameras or DEM can have a common error, such as that of another height datum or CRS"
    return [Notice("datum-doubtful", f"{sign}: {text}") for sign in signs]


def _alike(what: str, errors: Array, sigmas: Array) -> list[str]:
    """Return a text of the mean of errors ``(n,)`` m that are alike and beyond their sigmas; none for others."""
    if len(errors) < _ENOUGH or abs(errors.mean()) <= _ALIKE * max(errors.std(ddof=1), rms(sigmas)):
        return []
    return [f"{errors.mean():+.2f} m {what} (scatter {metres(float(errors.std(ddof=1)))})"]
