"""Selection of control points as in the tables of papers: the others become check points.

`assign_roles` makes check points of some control points, of one image or of a block.
"""

from __future__ import annotations

import re
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ortho_pipeline.errors import InputError, TooFewPoints
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.points.table import Array, Points

_FORMS = "even:N, cluster:N[:K] (K 1-4: corners clockwise from the upper left, 5: middle), ids:a,b,c or random:N:seed"
#: Centres of the groups of `cluster` in the box of the points, (column, row) from 0 to 1.
_REGIONS = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.5, 0.5)])


def select_control(points: Points, spec: str) -> Points:
    """Keep some control points and make check points of the others; all other points keep their roles.

    Parameters
    ----------
    spec : str
        ``even:N``: N points as far apart in the image as possible. ``cluster:N``: the N points nearest to the upper
        left; ``cluster:N:K``: group K of 1 to 5 (corners clockwise, middle). ``ids:a,b,c``: these points.
        ``random:N:seed``: a random choice, the same for the same seed.

    Raises
    ------
    InputError, TooFewPoints
        If the text is none of these, an id does not exist, or there are too few control points.
    """
    kind, _, rest = spec.strip().partition(":")
    # By id, so that the order of the file does not matter.
    rows = np.array(sorted(np.flatnonzero(points.control), key=lambda i: points.ids[i]), dtype=int)
    if kind == "ids":
        chosen = np.array(_named(points, rest))
    elif kind in ("even", "cluster", "random"):
        count, other = _numbers(rest, spec)
        if count > len(rows):
            raise TooFewPoints(
                f"{spec!r} selects {counted(count, 'point')}, but the file has {counted(len(rows), 'control point')}",
                file=points.source or None,
                field="points.select",
            )
        places = points.image[rows]
        if kind == "even":
            if other is not None:
                raise _unknown(spec)
            chosen = rows[_spread(places, count)]
        elif kind == "cluster":
            chosen = rows[_nearest(places, count, 1 if other is None else other, spec)]
        else:
            chosen = rows[np.random.default_rng(other or 0).permutation(len(rows))[:count]]
    else:
        raise _unknown(spec)
    roles = points.roles.copy()
    roles[rows] = "check"
    roles[chosen] = "control"
    return points.with_roles(roles)


def _unknown(spec: str) -> InputError:
    return InputError(f"{spec!r} is not a selection of points", field="points.select", remedy=f"give {_FORMS}")


def _numbers(text: str, spec: str) -> tuple[int, int | None]:
    parts = text.split(":")
    if len(parts) > 2 or not all(re.fullmatch(r"[0-9]{1,10}", part.strip()) for part in parts):
        raise _unknown(spec)
    values = [int(part) for part in parts]
    if values[0] < 1:
        raise _unknown(spec)
    return values[0], values[1] if len(values) > 1 else None


def _named(points: Points, text: str) -> list[int]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    unknown = [name for name in names if name not in points.ids]
    if unknown or not names:
        raise InputError(
            f"there is no point {', '.join(unknown)}" if unknown else "the selection names no point",
            file=points.source or None,
            field="points.select",
            remedy=f"the ids are {', '.join(points.ids[:12])}{' ...' if len(points) > 12 else ''}",
        )
    wrong = [name for name in names if points.roles[points.ids.index(name)] != "control"]
    if wrong:
        raise InputError(f"not a control point: {', '.join(wrong)}", file=points.source or None, field="points.select")
    return [points.ids.index(name) for name in names]


def _spread(places: Array, count: int) -> list[int]:
    """Return the point farthest from the middle, then each time the point farthest from all chosen ones."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    chosen = [int(np.argmax(((places - middle) ** 2).sum(axis=1)))]
    nearest = ((places - places[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < count:
        nearest[chosen] = -1.0
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, ((places - places[chosen[-1]]) ** 2).sum(axis=1))
    return chosen


def _nearest(places: Array, count: int, group: int, spec: str) -> list[int]:
    if not 1 <= group <= len(_REGIONS):
        raise _unknown(spec)
    low, high = places.min(axis=0), places.max(axis=0)
    seed = low + _REGIONS[group - 1] * (high - low)
    return np.argsort(((places - seed) ** 2).sum(axis=1), kind="stable")[:count].tolist()


# -- check points ----------------------------------------------------------------------------------------------------


class HasRoles(Protocol):
    """A table of points with roles: of one image, or of a block."""

    @property
    def ids(self) -> tuple[str, ...]: ...
    @property
    def roles(self) -> NDArray[np.str_]: ...
    @property
    def control(self) -> NDArray[np.bool_]: ...
    @property
    def source(self) -> str: ...
    def with_roles(self, roles: ArrayLike) -> Self: ...


AnyPoints = TypeVar("AnyPoints", bound=HasRoles)


def assign_roles(points: AnyPoints, spec: str) -> AnyPoints:
    """Make check points of some control points.

    Parameters
    ----------
    spec : str
        ``every:N`` for each N-th control point (the N-th first), or ``ids:a,b,c`` for these points.

    Raises
    ------
    InputError
        If the text is neither, or an id does not exist.
    """
    kind, _, rest = spec.partition(":")
    roles = points.roles.copy()
    if kind == "every" and re.fullmatch(r"[0-9]{1,7}", rest.strip()) and int(rest) > 0:
        roles[np.flatnonzero(points.control)[int(rest) - 1 :: int(rest)]] = "check"
        return points.with_roles(roles)
    names = [name.strip() for name in rest.split(",") if name.strip()]
    if kind == "ids" and names:
        unknown = [name for name in names if name not in points.ids]
        if unknown:
            raise InputError(
                f"there is no point {', '.join(unknown)}",
                file=points.source or None,
                field="points.check",
                remedy=f"the ids are {', '.join(points.ids[:12])}{' ...' if len(points.ids) > 12 else ''}",
            )
        roles[np.isin(np.array(points.ids), names)] = "check"
        return points.with_roles(roles)
    raise InputError(
        f"{spec!r} is not a selection of check points", field="points.check", remedy="give every:N or ids:a,b,c"
    )
