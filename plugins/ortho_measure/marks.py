"""Marks: measured points, and the actions that change them.

A mark can lack its image or ground position, can be off, and records how it was measured. Complete marks that are on
are the points of the adjustment. Tables never change: each action returns a new one, so undo goes back to the old one.
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

#: CRS of ground: longitude, latitude (degrees) and ellipsoidal height (m), as in GeoJSON.
GROUND_CRS = "EPSG:4979"
#: Limits on the number of marks, and on the lengths of names and notes.
MOST_MARKS, LONGEST_ID, LONGEST_NOTE = 20_000, 64, 500
#: Limits on standard deviations in the image (px), and on group numbers.
_SIGMAS, _GROUPS = (1e-6, 1e6), 1 << 31


class RayMark(Record):
    """A measurement in one of several images; for a single image, `Mark` has these fields itself."""

    image: tuple[float, float]
    sigma_image: float | None = None
    covariance: tuple[float, float, float] | None = None
    group: int | None = None
    how: Literal["manual", "matched", "file"] = "manual"
    score: float | None = None

    @property
    def matrix(self) -> np.ndarray:
        """Covariance ``(2, 2)`` of the measurement, px^2."""
        return _matrix(self.sigma_image, self.covariance)


class Mark(Record):
    """A measured point.

    `image` is column, row from the outer corner of the first pixel (px), `ground` in `GROUND_CRS`; None means not
    measured. `covariance` has the variances of column and row and their covariance (px^2); if it is None, `sigma_image`
    (px) counts. `how` is the method of the image position, `ground_from` the source of the ground, `score` the
    correlation of the match. With several images, `rays` has the measurements by image name, instead of the fields for
    one image.
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
        """Whether image and ground are known; with several images, whether there are enough measurements."""
        if not self.rays:
            return self.image is not None and self.ground is not None
        if self.role == "tie" or self.ground is None:
            return self.role == "tie" and len(self.rays) >= 2
        return self.role == "control" or len(self.rays) >= 2

    @property
    def counts(self) -> bool:
        """Whether the mark takes part in the adjustment."""
        return self.whole and not self.off

    @property
    def matrix(self) -> np.ndarray:
        """Covariance ``(2, 2)`` of the measurement, px^2."""
        return _matrix(self.sigma_image, self.covariance)

    @property
    def places(self) -> set[tuple[object, ...]]:
        """Its positions, which no other point may have: readers would refuse a file with both."""
        images = {name: ray.image for name, ray in self.rays.items()} if self.rays else {"": self.image}
        positions: set[tuple[object, ...]] = {
            ("image", name, *np.round(place, 6).tolist()) for name, place in images.items() if place is not None
        }
        if self.ground is not None and not (self.rays and self.role == "tie"):
            positions.add(("ground", *np.round(self.ground, 8).tolist()))
        return positions


def _matrix(sigma: float | None, covariance: tuple[float, float, float] | None) -> np.ndarray:
    if covariance is None:
        return np.eye(2) * (sigma or DEFAULT_SIGMA_IMAGE) ** 2
    column, row, both = covariance
    return np.array([[column, both], [both, row]])


def errors_of(measured: Sequence[Mark | RayMark]) -> tuple[np.ndarray, np.ndarray]:
    """Return standard deviations ``(N,)`` and covariances ``(N, 2, 2)`` of measurements, as written to files."""
    covariance = np.array([mark.matrix for mark in measured], dtype=float).reshape(-1, 2, 2)
    sigma = sigma_of_covariance(covariance)
    for k in np.flatnonzero(~says_more(covariance)).tolist():
        sigma[k] = measured[k].sigma_image or sigma[k] if measured[k].covariance is None else sigma[k]
    return sigma, covariance


def checked(mark: Mark) -> Mark:
    """Return a mark after checking its values.

    Raises
    ------
    InputError
        With the wrong field.
    """
    name = plain_id(mark.id)
    if not name or name != mark.id or len(name) > LONGEST_ID or not is_writable(name):
        raise InputError(
            "this is not a valid point name",
            field="id",
            remedy=f"use 1 to {LONGEST_ID} characters; no blank at the ends, no two blanks together",
        )
    if len(mark.note) > LONGEST_NOTE or not is_writable(mark.note):
        raise InputError(
            "this note is too long or has unusual characters",
            field="note",
            remedy=f"write at most {LONGEST_NOTE} characters",
        )
    _check_measurement(mark, "")
    for name, ray in mark.rays.items():
        _check_measurement(ray, f"rays.{name}.")
    if mark.ground is not None:
        lon, lat, height = mark.ground
        if not (abs(lon) <= 360 and abs(lat) <= 90 and abs(height) <= 20_000):
            raise InputError(
                "this position is not on Earth", field="ground", remedy="check the coordinates and their CRS"
            )
    for key in ("sigma_xy", "sigma_h", "sigma_common", "sigma_alike"):
        if not 0 <= getattr(mark, key) <= 1e6:
            raise InputError("a standard deviation must not be negative", field=key, remedy="give 0 or more")
    return mark


def _check_measurement(mark: Mark | RayMark, where: str) -> None:
    if mark.image is not None and max(map(abs, mark.image)) > 1e8:
        raise InputError("this is not an image position", field=f"{where}image")
    least, most = _SIGMAS
    if mark.sigma_image is not None and not least <= mark.sigma_image <= most:
        raise InputError(
            "a standard deviation must be positive", field=f"{where}sigma_image", remedy="give it in pixels"
        )
    if mark.covariance is not None:
        column, row, both = mark.covariance
        possible = least**2 <= min(column, row) and max(column, row) <= most**2
        # Use a root: a power of a float can overflow 1e308.
        if not (possible and abs(both) < math.sqrt(column * row * (1 - 1e-9))):
            raise InputError("this is not a covariance", field=f"{where}covariance")
    if mark.group is not None and not 0 <= mark.group < _GROUPS:
        raise InputError("this is not a group number", field=f"{where}group", remedy=f"give 0 to {_GROUPS - 1}")


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
        raise InputError(f"this is not a point: {error.fault}", field=error.place or "mark") from error


@dataclass(frozen=True)
class Marks:
    """All marks by id, in the order of measurement, and the chosen correction."""

    by_id: Mapping[str, Mark] = field(default_factory=dict)
    correction: str | None = None

    def points(self, source: str) -> Points:
        """Return the points of the adjustment: complete marks that are on.

        Ground from the reference has the error of the reference, so such a point gets its own group, like a match.
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
        """Return the GeoJSON of the points, each with its provenance; readers of points ignore unknown members.

        Marks that are off or incomplete are in ``left_out``, outside the collection.
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
    """Marks as JSON values, each converted once, because an action changes few of them."""

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
        Time of reading.
    """
    more = says_more(points.covariance_image)
    marks = []
    for k, point in enumerate(points.to_crs(GROUND_CRS)):
        (column, both), (_, row) = point.covariance_image
        marks.append(
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
    return marks


# -- actions ---------------------------------------------------------------------------------------------------------


class History:
    """The marks now, and the earlier and undone states."""

    def __init__(self) -> None:
        self._states: list[Marks] = [Marks()]
        self._now = 0

    @property
    def marks(self) -> Marks:
        """The marks now."""
        return self._states[self._now]

    @property
    def can_undo(self) -> bool:
        """Whether an action can be undone; the first action, which loads points, cannot."""
        return self._now > 1

    @property
    def can_redo(self) -> bool:
        """Whether an undone action can be repeated."""
        return self._now + 1 < len(self._states)

    def after(self, action: Mapping[str, Any]) -> Marks | int:
        """Return the result of an action: other marks, or a step back (-1) or forward (1); nothing changes yet.

        Raises
        ------
        InputError
            If the action is not possible.
        """
        if action.get("do") in ("undo", "redo"):
            _require_members(action, set())
            if not (self.can_undo if action["do"] == "undo" else self.can_redo):
                raise InputError(f"nothing to {action['do']}", field="do")
            return -1 if action["do"] == "undo" else 1
        return _changed(self.marks, action)

    def take(self, step: Marks | int) -> None:
        """Apply a result of `after`."""
        if isinstance(step, int):
            self._now += step
            return
        self._states = [*self._states[: self._now + 1], step]
        self._now += 1


def _changed(marks: Marks, action: Mapping[str, Any]) -> Marks:
    kind = action.get("do")
    members = {"begin": {"marks"}, "put": {"mark", "was"}, "remove": {"id"}, "correct": {"correction"}}
    if not isinstance(kind, str) or kind not in members:
        raise InputError("unknown action", field="do", remedy=f"use one of {', '.join(members)}, undo, redo")
    _require_members(action, members[kind])
    if kind == "begin":
        if marks.by_id or not isinstance(action.get("marks"), list):
            raise InputError("points can only be loaded into an empty table", field="marks")
        return _begun([mark_of(document) for document in action["marks"]])
    if kind == "put":
        return replace(marks, by_id=_with(marks.by_id, mark_of(action.get("mark")), action.get("was")))
    if kind == "remove":
        name = str(action.get("id"))
        if name not in marks.by_id:
            raise InputError(f"unknown point {name}", field="id")
        return replace(marks, by_id={key: mark for key, mark in marks.by_id.items() if key != name})
    chosen = action.get("correction")
    if chosen is not None and chosen not in CORRECTIONS:
        raise InputError("unknown correction", field="correction", remedy=f"use one of {', '.join(CORRECTIONS)}")
    return replace(marks, correction=chosen)


def _require_members(action: Mapping[str, Any], members: set[str]) -> None:
    if not set(action) <= members | {"do"}:
        raise InputError(
            "this action has unknown members",
            field="action",
            remedy=f"use only {', '.join(sorted(members | {'do'}))}",
        )


def _begun(marks: Sequence[Mark]) -> Marks:
    by_id = {mark.id: mark for mark in marks}
    if len(by_id) != len(marks) or len(by_id) > MOST_MARKS:
        raise InputError(f"{counted(len(marks), 'point')}: too many, or two with the same name", field="marks")
    return Marks(by_id)


def _with(marks: Mapping[str, Mark], mark: Mark, was: object) -> dict[str, Mark]:
    """Return the marks with a new one, in the place of the one that it replaces."""
    before = mark.id if was is None else str(was)
    if was is not None and before not in marks:
        raise InputError(f"unknown point {before}", field="was")
    if mark.id != before and mark.id in marks:
        raise InputError(f"a point {mark.id} already exists", field="id", remedy="choose another name")
    _refuse_twin([other for key, other in marks.items() if key != before], mark)
    if before not in marks:
        if len(marks) >= MOST_MARKS:
            raise InputError(f"there are already {MOST_MARKS} points, the limit", field="mark")
        return {**marks, mark.id: mark}
    return {mark.id if key == before else key: mark if key == before else one for key, one in marks.items()}


def _refuse_twin(others: Sequence[Mark], mark: Mark) -> None:
    """Raise an error for a point at the position of another: readers would refuse a file with both."""
    if not mark.counts:
        return
    for other in others:
        if other.counts and (same := mark.places & other.places):
            name = str(min(same, key=str)[0])
            raise InputError(
                f"{other.id} already has the same {name} position",
                field=name,
                remedy=f"measure {other.id} again, or switch it off",
            )
