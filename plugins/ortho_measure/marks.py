"""Marks: what a person measured, point by point, and the actions that change it.

A mark may lack its image or its ground, may be off, and knows how it was made; those that are whole and on are the
points of the adjustment. Tables never change: each action gives another one, so that undoing is to go back.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pydantic

from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files.json.records import DocumentError, Record
from ortho_pipeline.geodesy.crs import horizontal, parse_crs
from ortho_pipeline.options import CORRECTIONS
from ortho_pipeline.points import DEFAULT_SIGMA_IMAGE, Points
from ortho_pipeline.points.geojson import feature_of
from ortho_pipeline.points.image_errors import says_more, sigma_of_covariance
from ortho_pipeline.points.rows import is_writable, plain_id

#: What ground is in: longitude, latitude (degrees) and height above the ellipsoid (m), as GeoJSON has it.
GROUND_CRS = "EPSG:4979"
#: More marks than this are no work of hands, and longer words no names.
MOST_MARKS, LONGEST_ID, LONGEST_NOTE = 20_000, 64, 500
#: Standard deviations of an image (px) are within these, and groups have numbers below this.
_SIGMAS, _GROUPS = (1e-6, 1e6), 1 << 31


class RayMark(Record):
    """A point as it was measured in one of several images: as `Mark` has it of a single one."""

    image: tuple[float, float]
    sigma_image: float | None = None
    covariance: tuple[float, float, float] | None = None
    how: Literal["manual", "matched", "file"] = "manual"
    score: float | None = None

    @property
    def matrix(self) -> np.ndarray:
        """Covariance ``(2, 2)`` of the measurement, px^2."""
        return _matrix(self.sigma_image, self.covariance)


class Mark(Record):
    """One point as it was measured.

    `image` is column, row from the outer corner of the first pixel (px), `ground` as `GROUND_CRS`; None is not
    measured. `covariance` has the variances of column and row and their covariance (px^2), `sigma_image` (px) counts
    where it is None. `how` says who gave the image, `ground_from` who gave the ground, `score` how alike chips were.
    Of several images `rays` has what was measured, by the names of the images, in place of all that is of one image.
    """

    id: str
    image: tuple[float, float] | None = None
    ground: tuple[float, float, float] | None = None
    role: Literal["control", "check", "tie"] = "control"
    off: bool = False
    sigma_image: float | None = None
    covariance: tuple[float, float, float] | None = None
    sigma_xy: float = 0.0
    sigma_h: float = 0.0
    sigma_common: float = 0.0
    sigma_alike: float = 0.0
    group: int | None = None
    how: Literal["manual", "matched", "file"] = "manual"
    ground_from: Literal["reference", "typed", "file"] | None = None
    score: float | None = None
    rays: dict[str, RayMark] = pydantic.Field(default_factory=dict)
    note: str = ""
    at: str = ""

    @property
    def whole(self) -> bool:
        """Whether both places are known; of several images: whether it says something of them."""
        if not self.rays:
            return self.image is not None and self.ground is not None
        if self.role == "tie" or self.ground is None:
            return self.role == "tie" and len(self.rays) >= 2
        return self.role == "control" or len(self.rays) >= 2

    @property
    def counts(self) -> bool:
        """Whether it is a point of the adjustment."""
        return self.whole and not self.off

    @property
    def matrix(self) -> np.ndarray:
        """Covariance ``(2, 2)`` of the measurement, px^2."""
        return _matrix(self.sigma_image, self.covariance)

    @property
    def places(self) -> set[tuple[object, ...]]:
        """Where it is, as no other point may be: a file with both would be refused by whoever reads it."""
        images = {name: ray.image for name, ray in self.rays.items()} if self.rays else {"": self.image}
        found: set[tuple[object, ...]] = {
            ("image", name, *np.round(place, 6).tolist()) for name, place in images.items() if place is not None
        }
        if self.ground is not None and not (self.rays and self.role == "tie"):
            found.add(("ground", *np.round(self.ground, 8).tolist()))
        return found


def _matrix(sigma: float | None, covariance: tuple[float, float, float] | None) -> np.ndarray:
    if covariance is None:
        return np.eye(2) * (sigma or DEFAULT_SIGMA_IMAGE) ** 2
    column, row, both = covariance
    return np.array([[column, both], [both, row]])


def errors_of(measured: Sequence[Mark | RayMark]) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations ``(N,)`` and covariances ``(N, 2, 2)`` of measurements, as a file of them says."""
    covariance = np.array([one.matrix for one in measured], dtype=float).reshape(-1, 2, 2)
    sigma = sigma_of_covariance(covariance)
    for k in np.flatnonzero(~says_more(covariance)).tolist():
        sigma[k] = measured[k].sigma_image or sigma[k] if measured[k].covariance is None else sigma[k]
    return sigma, covariance


def checked(mark: Mark) -> Mark:
    """Return a mark whose values are possible.

    Raises
    ------
    InputError
        With the field that is not.
    """
    name = plain_id(mark.id)
    if not name or name != mark.id or len(name) > LONGEST_ID or not is_writable(name):
        raise InputError(
            "this is no name of a point", field="id", remedy=f"1 to {LONGEST_ID} characters, single blanks only within"
        )
    if len(mark.note) > LONGEST_NOTE or not is_writable(mark.note):
        raise InputError("this note cannot be kept", field="note", remedy=f"write at most {LONGEST_NOTE} characters")
    _check_measurement(mark, "")
    for name, ray in mark.rays.items():
        _check_measurement(ray, f"rays.{name}.")
    if mark.ground is not None:
        lon, lat, height = mark.ground
        if not (abs(lon) <= 360 and abs(lat) <= 90 and abs(height) <= 20_000):
            raise InputError("this is no place on Earth", field="ground", remedy="check the coordinates and their CRS")
    for key in ("sigma_xy", "sigma_h", "sigma_common", "sigma_alike"):
        if not 0 <= getattr(mark, key) <= 1e6:
            raise InputError("a standard deviation is not negative", field=key, remedy="give 0 or more")
    if mark.group is not None and not 0 <= mark.group < _GROUPS:
        raise InputError("this is no number of a group", field="group", remedy=f"give 0 to {_GROUPS - 1}")
    return mark


def _check_measurement(one: Mark | RayMark, where: str) -> None:
    if one.image is not None and max(map(abs, one.image)) > 1e8:
        raise InputError("this is no place in an image", field=f"{where}image")
    least, most = _SIGMAS
    if one.sigma_image is not None and not least <= one.sigma_image <= most:
        raise InputError("a standard deviation is positive", field=f"{where}sigma_image", remedy="give pixels")
    if one.covariance is not None:
        column, row, both = one.covariance
        possible = least**2 <= min(column, row) and max(column, row) <= most**2
        # A power of a float, unlike a root, has no result beyond 1e308.
        if not (possible and abs(both) < math.sqrt(column * row * (1 - 1e-9))):
            raise InputError("this is no covariance", field=f"{where}covariance")


def mark_of(document: Any) -> Mark:
    """Return a mark from its JSON object.

    Raises
    ------
    InputError
        With the member that is wrong.
    """
    try:
        return checked(Mark.read(document))
    except DocumentError as error:
        raise InputError(f"not a mark: {error.fault}", field=error.place or "mark") from error


@dataclass(frozen=True)
class Marks:
    """All marks by their ids, in the order of their making, and the correction that the person chose."""

    by_id: Mapping[str, Mark] = field(default_factory=dict)
    correction: str | None = None

    def points(self, source: str) -> Points:
        """Return the points of the adjustment: marks that are whole and on.

        Ground that was read off the reference errs with it: such a point has a group, its own, as a match has.
        """
        used = [mark for mark in self.by_id.values() if mark.counts]
        groups = np.array([-1 if mark.group is None else mark.group for mark in used], dtype=np.int64)
        of_reference = np.array([mark.ground_from == "reference" for mark in used], dtype=bool) & (groups < 0)
        groups[of_reference] = groups.max(initial=-1) + 1 + np.arange(int(of_reference.sum()))
        sigma, covariance = errors_of(used)
        return Points(
            ids=tuple(mark.id for mark in used),
            image=np.array([mark.image for mark in used], dtype=float).reshape(-1, 2),
            ground=np.array([mark.ground for mark in used], dtype=float).reshape(-1, 3),
            roles=np.array([mark.role for mark in used], dtype="<U7"),
            sigma_image=sigma,
            sigma_ground=np.array([[mark.sigma_xy] * 2 + [mark.sigma_h] for mark in used], dtype=float).reshape(-1, 3),
            crs=horizontal(parse_crs(GROUND_CRS)),
            source=source,
            covariance_image=covariance,
            groups=groups,
            sigma_common=np.array([mark.sigma_common for mark in used], dtype=float),
            sigma_alike=np.array([mark.sigma_alike for mark in used], dtype=float),
        )

    def document(self, source: str) -> dict[str, Any]:
        """Return the GeoJSON of the points, each with its provenance; readers of points ignore what is not theirs.

        What is off or not whole stands in ``left_out``, which is no part of the collection.
        """
        points = self.points(source)
        features = [feature_of(point) for point in points]
        for feature, mark in zip(features, (self.by_id[name] for name in points.ids), strict=True):
            feature["properties"] |= {
                "measured": mark.how,
                "ground_from": mark.ground_from,
                "score": mark.score,
                "at": mark.at,
                **({"note": mark.note} if mark.note else {}),
            }
        left = [mark.to_json() for mark in self.by_id.values() if not mark.counts]
        return {"type": "FeatureCollection", "features": features, **({"left_out": left} if left else {})}


class Written:
    """Marks as JSON values, each made once: after an action nearly all of them are as they were."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[Mark, dict[str, Any]]] = {}

    def of(self, mark: Mark) -> dict[str, Any]:
        """Return a mark as JSON values."""
        if mark.id not in self._known or self._known[mark.id][0] is not mark:
            self._known[mark.id] = mark, mark.to_json()
        return self._known[mark.id][1]


def marks_of(points: Points, at: str) -> list[Mark]:
    """Return points of a file as marks.

    Parameters
    ----------
    at : str
        When they were read.
    """
    more = says_more(points.covariance_image)
    found = []
    for k, point in enumerate(points.to_crs(GROUND_CRS)):
        (column, both), (_, row) = point.covariance_image
        found.append(
            checked(
                Mark(
                    id=point.id,
                    image=point.image,
                    ground=point.ground if all(map(math.isfinite, point.ground)) else None,
                    role=point.role,  # type: ignore[arg-type]
                    sigma_image=None if more[k] else point.sigma_image,
                    covariance=(column, row, both) if more[k] else None,
                    sigma_xy=max(point.sigma_ground[:2]),
                    sigma_h=point.sigma_ground[2],
                    sigma_common=point.sigma_common,
                    sigma_alike=point.sigma_alike,
                    group=point.group if point.group >= 0 else None,
                    how="file",
                    ground_from="file",
                    at=at,
                )
            )
        )
    return found


# -- actions ---------------------------------------------------------------------------------------------------------


class History:
    """Marks as they are now, were before, and were before something was undone."""

    def __init__(self) -> None:
        self._states: list[Marks] = [Marks()]
        self._now = 0

    @property
    def marks(self) -> Marks:
        """As they are now."""
        return self._states[self._now]

    @property
    def can_undo(self) -> bool:
        """Whether there is something to go back to; what was begun with, the first action, stays."""
        return self._now > 1

    @property
    def can_redo(self) -> bool:
        """Whether something was undone."""
        return self._now + 1 < len(self._states)

    def after(self, action: Mapping[str, Any]) -> Marks | int:
        """Return what an action would lead to: other marks, or a step back (-1) or forward (1); nothing changes.

        Raises
        ------
        InputError
            If it cannot be done.
        """
        if action.get("do") in ("undo", "redo"):
            _require_members(action, set())
            if not (self.can_undo if action["do"] == "undo" else self.can_redo):
                raise InputError(f"there is nothing to {action['do']}", field="do")
            return -1 if action["do"] == "undo" else 1
        return _changed(self.marks, action)

    def take(self, step: Marks | int) -> None:
        """Go where `after` said."""
        if isinstance(step, int):
            self._now += step
            return
        self._states = [*self._states[: self._now + 1], step]
        self._now += 1


def _changed(marks: Marks, action: Mapping[str, Any]) -> Marks:
    kind = action.get("do")
    members = {"begin": {"marks"}, "put": {"mark", "was"}, "remove": {"id"}, "correct": {"correction"}}
    if not isinstance(kind, str) or kind not in members:
        raise InputError("this is no action", field="do", remedy=f"one of {', '.join(members)}, undo, redo")
    _require_members(action, members[kind])
    if kind == "begin":
        if marks.by_id or not isinstance(action.get("marks"), list):
            raise InputError("only an empty table is begun with marks", field="marks")
        return _begun([mark_of(one) for one in action["marks"]])
    if kind == "put":
        return replace(marks, by_id=_with(marks.by_id, mark_of(action.get("mark")), action.get("was")))
    if kind == "remove":
        name = str(action.get("id"))
        if name not in marks.by_id:
            raise InputError(f"there is no point {name}", field="id")
        return replace(marks, by_id={key: mark for key, mark in marks.by_id.items() if key != name})
    chosen = action.get("correction")
    if chosen is not None and chosen not in CORRECTIONS:
        raise InputError("there is no such correction", field="correction", remedy=f"one of {', '.join(CORRECTIONS)}")
    return replace(marks, correction=chosen)


def _require_members(action: Mapping[str, Any], members: set[str]) -> None:
    if not set(action) <= members | {"do"}:
        raise InputError(
            "this action has members that it cannot have",
            field="action",
            remedy=f"leave out all but {', '.join(sorted(members | {'do'}))}",
        )


def _begun(marks: Sequence[Mark]) -> Marks:
    found = {mark.id: mark for mark in marks}
    if len(found) != len(marks) or len(found) > MOST_MARKS:
        raise InputError(f"{counted(len(marks), 'point')}: too many, or two of one name", field="marks")
    return Marks(found)


def _with(marks: Mapping[str, Mark], mark: Mark, was: object) -> dict[str, Mark]:
    """Return marks with another one, in the place of the one that it replaces."""
    before = mark.id if was is None else str(was)
    if was is not None and before not in marks:
        raise InputError(f"there is no point {before}", field="was")
    if mark.id != before and mark.id in marks:
        raise InputError(f"there is a point {mark.id} already", field="id", remedy="choose another name")
    _refuse_twin([other for key, other in marks.items() if key != before], mark)
    if before not in marks:
        if len(marks) >= MOST_MARKS:
            raise InputError(f"there are {MOST_MARKS} points already", field="mark")
        return {**marks, mark.id: mark}
    return {mark.id if key == before else key: mark if key == before else one for key, one in marks.items()}


def _refuse_twin(others: Sequence[Mark], mark: Mark) -> None:
    """Refuse a point at the place of another one: a file with both would be refused by whoever reads it."""
    if not mark.counts:
        return
    for other in others:
        if other.counts and (same := mark.places & other.places):
            name = str(min(same, key=str)[0])
            raise InputError(
                f"{other.id} has the same {name}", field=name, remedy=f"measure {other.id} anew, or switch it off"
            )
