"""Arguments of Python callers, checked before anything is computed from them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ortho_pipeline.errors import InputError
from ortho_pipeline.models.base import SensorModel
from ortho_pipeline.points import Points


def refuse_other_points(points: object, expected: type = Points, reader: str = "read_points") -> None:
    """Refuse what is no table of points, such as the path of a file."""
    if not isinstance(points, expected):
        raise InputError(
            f"a {type(points).__name__} is not a {expected.__name__}",
            field="points",
            remedy=f"read a file with op.{reader}(FILE)",
        )


def refuse_other_model(model: object) -> None:
    """Refuse what is no sensor model, such as a scene."""
    if not isinstance(model, SensorModel):
        raise InputError(
            f"a {type(model).__name__} is not a sensor model",
            field="model",
            remedy='pass a model; for a scene, use scene.fit(points, "shift")',
        )


def excluded_rows(points: Points, exclude: Mapping[str, str]) -> dict[int, str]:
    """Return the rows and reasons of control points to leave out, by their ids."""
    if not isinstance(exclude, Mapping):
        raise InputError("exclude must map ids to reasons", field="exclude", remedy="give {'ID': 'why'}")
    control = {points.ids[row]: int(row) for row in np.flatnonzero(points.control)}
    unknown = sorted(set(exclude) - set(control))
    if unknown:
        raise InputError(f"cannot exclude {unknown[0]!r}: no control point has this id", field="exclude")
    return {control[name]: reason for name, reason in exclude.items()}
