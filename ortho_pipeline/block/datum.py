"""Datum of a block: control points, what is known of the models, or the orientation held near its start values."""

from __future__ import annotations

import numpy as np

from ortho_pipeline.block.equations.elimination import step_of
from ortho_pipeline.block.equations.linear import Linear
from ortho_pipeline.block.equations.problem import BlockProblem, Pseudo, Selection, State
from ortho_pipeline.errors import InputError, counted
from ortho_pipeline.estimation.problem import CONDITION_LIMIT

#: Without any control, each parameter is held at its start value by its effect in the image, with this sigma (px): the
#: size of what vendors' orientations are off by.
HOLD = 10.0


def with_datum(
    problem: BlockProblem, state: State, selection: Selection, hold: float | None
) -> tuple[BlockProblem, str]:
    """Return the problem with a datum, and what defines it."""
    control = int((problem.active(selection) & selection.ground).sum())
    if hold is not None and not hold > 0:
        raise InputError("a standard deviation is positive", field="hold")
    if not problem.size:
        return problem, "nothing is adjusted but the points: the models stay as they are"
    if hold is None and control:
        return problem, by_control(problem, selection)
    # Fictitious constraints hold the shape of an orbit together, not where it is.
    known = bool(problem.pseudo) or any((~model.constraints().fictitious).any() for model in state.models)
    if hold is None and known and step_of(Linear.at(problem, state, selection)).condition <= CONDITION_LIMIT:
        return problem, "no control points: the datum is that of the priors and constraints of the models"
    sigma = HOLD if hold is None else hold
    held = _held(problem, state, selection, sigma)
    why = f"{counted(control, 'control point')} and" if control else "no control points:"
    right = "" if control else "; positions on the ground are as right as these values are"
    return problem.with_pseudo(held), (
        f"{why} the orientation is held at its start values with a sigma of {sigma:g} px of effect in the image for "
        f"each parameter ({len(held)} of {problem.size}){right}"
    )


def by_control(problem: BlockProblem, selection: Selection) -> str:
    """Say that the control points of a selection define the datum."""
    number = int((problem.active(selection) & selection.ground).sum())
    return f"the datum is that of {counted(number, 'control point')}"


def _held(problem: BlockProblem, state: State, selection: Selection, sigma: float) -> list[Pseudo]:
    """Return a pseudo-observation for each parameter without a prior, as strong as its effect (px) in its image."""
    linear = Linear.at(problem, state, selection)
    known = {one.column for one in problem.pseudo}
    found = []
    params = state.params
    for image, used in enumerate(linear.ordering.rays_of_image):
        partials = problem.points.in_pixels(linear.by_params[used], used)
        effect = np.sqrt((partials**2).sum(axis=1).mean(axis=0)) if len(used) else []
        for column, size in zip(problem.columns.of_image(image), effect, strict=False):
            if int(column) not in known and size > 0:
                found.append(Pseudo(int(column), float(params[column]), sigma / float(size), held=True))
    return found
