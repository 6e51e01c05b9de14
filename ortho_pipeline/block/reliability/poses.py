"""Poses whose stated accuracy is contradicted: ties and heights move the cameras farther than it allows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ortho_pipeline.block.equations.problem import Pseudo
from ortho_pipeline.block.fit import BlockFit
from ortho_pipeline.display.notices import Notice
from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.estimation.statistics import rms
from ortho_pipeline.models.base import Array
from ortho_pipeline.models.frame.orientation import EXTERIOR

#: Probability of changes of poses as large as these, if the stated accuracies are right.
_CHANCE = 1e-4
_DEGREES = math.degrees(1.0)


def contradicted_poses(fit: BlockFit, pseudo: Sequence[Pseudo]) -> list[Notice]:
    """Return a notice each for positions in plan, heights and angles that changed by more than their stated accuracies.

    Changes are counted without their mean of each axis. An error that all images share is one of the datum, or of the
    mount of the camera.

    Parameters
    ----------
    pseudo : sequence of Pseudo
        What was known of the parameters.
    """
    from scipy.special import chdtrc

    found = []
    for what, names, size, unit in (
        ("positions in plan", EXTERIOR[:2], 1.0, "m"),
        ("heights", EXTERIOR[2:3], 1.0, "m"),
        ("angles", EXTERIOR[3:], _DEGREES, "°"),
    ):
        changes, accuracies, freedom, images = np.zeros(0), np.zeros(0), 0, 0
        for name in names:
            moved, sigmas = changes_of(name, fit, pseudo)
            if len(moved) > 1:
                changes = np.append(changes, moved - np.average(moved, weights=sigmas**-2.0))
                accuracies = np.append(accuracies, sigmas)
                freedom, images = freedom + len(moved) - 1, max(images, len(moved))
        if not freedom or chdtrc(freedom, np.sum((changes / accuracies) ** 2)) >= _CHANCE:
            continue
        by, within = rms(changes) * size, rms(accuracies) * size
        text = (
            f"the adjustment moves the {what} of {counted(images, 'image')} by {significant(by)} {unit} (RMS, without "
            f"their mean), although their stated accuracy is {significant(within)} {unit}. If it is wrong, so are this "
            "result and its sigmas"
        )
        found.append(Notice("poses-contradicted", text, what=what, rms=by, sigma=within, unit=unit, count=images))
    return found


def changes_of(name: str, fit: BlockFit, pseudo: Sequence[Pseudo]) -> tuple[Array, Array]:
    """Return by how much an adjustment changed a parameter of images ``(n,)``, and the sigmas known before."""
    params = np.concatenate([np.zeros(0), *(model.params for model in fit.models.values())])
    known = [one for one in pseudo if fit.parameters[one.column][1] == name and not one.held]
    return np.array([params[one.column] - one.mean for one in known]), np.array([one.sigma for one in known])
