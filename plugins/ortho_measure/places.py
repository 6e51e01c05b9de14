"""Places: where ground lies in an image or a map and these on the ground, by models as they are adjusted now."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from ortho_measure.marks import GROUND_CRS
from ortho_pipeline.errors import DatumError, InputError
from ortho_pipeline.geodesy.crs import Vertical, ground_transform, horizontal, parse_crs
from ortho_pipeline.geodesy.declared_vertical import declared_vertical
from ortho_pipeline.imaging.matching import Reference, SceneView, Target
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.rays import meet_surface

#: Accepted input for a CRS or a height datum: names and codes.
_NAMED = r"[a-z]{2,12}:[0-9]{1,9}(\+[0-9]{1,9})?|ellipsoid|egm96|egm2008"

#: Iterations for the height; each one reduces the error about ten times.
_ROUNDS = 2
#: Step (px) for the derivatives of one geometry in another.
_STEP = 8.0


class Geometry(Protocol):
    """A geometry that shows ground: pixels of an image by a model, or of a map."""

    def image_of(self, ground: ArrayLike) -> Array:
        """Return the pixels ``(N, 2)`` of ground ``(N, 3)`` in `GROUND_CRS`; NaN if there are none."""
        ...

    def ground_of(self, image: ArrayLike) -> Array:
        """Return the ground ``(N, 3)`` in `GROUND_CRS` of pixels ``(N, 2)``; NaN if there is none."""
        ...


@dataclass(frozen=True, eq=False)
class Sheet:
    """A reference in its own pixels, as a map.

    Parameters
    ----------
    reference : Reference
    surface : Surface
        Heights of the map.
    """

    reference: Reference
    surface: Surface

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.reference.intensity.width, self.reference.intensity.height

    def image_of(self, ground: ArrayLike) -> Array:
        """Return the pixels ``(N, 2)`` of ground ``(N, 3)``; NaN outside the map."""
        pixels = self.reference.project(np.asarray(ground, dtype=float).reshape(-1, 3), GROUND_CRS)
        with np.errstate(invalid="ignore"):
            pixels[~((pixels >= 0) & (pixels <= self.size)).all(axis=1)] = np.nan
        return pixels

    def ground_of(self, image: ArrayLike) -> Array:
        """Return the ground ``(N, 3)`` of pixels ``(N, 2)``, with the heights of the surface."""
        pixels = np.asarray(image, dtype=float).reshape(-1, 2)
        linear, offset = self.reference.pixel_from_map[:, :2], self.reference.pixel_from_map[:, 2]
        plan = (pixels - offset) @ np.linalg.inv(linear).T
        heights = self.surface.heights(plan, self.reference.crs)
        return ground_transform(self.reference.crs, GROUND_CRS)(np.column_stack([plan, heights]))


@dataclass(frozen=True, eq=False)
class SceneGeometry:
    """A scene and the references that show the same ground, as one geometry.

    Parameters
    ----------
    view : SceneView
        The scene, with the model used to render the reference.
    references : tuple of Target
        Orthoimages, or other scenes.
    """

    view: SceneView
    references: tuple[Target, ...]

    @property
    def model(self) -> SensorModel:
        """The model that projects ground into the image."""
        return self.view.model

    @property
    def surface(self) -> Surface:
        """The heights."""
        return self.view.surface

    def by(self, model: SensorModel) -> SceneGeometry:
        """Return this geometry with another model."""
        return replace(self, view=replace(self.view, model=model))

    def image_of(self, ground: ArrayLike) -> Array:
        """Return the image ``(N, 2)`` of ground ``(N, 3)`` in `GROUND_CRS`; NaN if there is none."""
        positions = np.asarray(ground, dtype=float).reshape(-1, 3)
        return self.model.ground_to_image(ground_transform(GROUND_CRS, self.model.crs)(positions))

    def ground_of(self, image: ArrayLike) -> Array:
        """Return the ground ``(N, 3)`` in `GROUND_CRS` of image points ``(N, 2)``; NaN if there is none."""
        met = meet_surface(self.model, np.asarray(image, dtype=float).reshape(-1, 2), self.surface)
        ground = np.full(met.shape, np.nan)
        good = np.isfinite(met).all(axis=1)
        ground[good] = ground_transform(self.model.crs, GROUND_CRS)(met[good])
        return ground

    def ground_about(self, image: ArrayLike, heights: ArrayLike) -> Array:
        """Return the ground of image points ``(N, 2)`` like `ground_of`, from approximate heights ``(N,)``.

        If a ray meets a steep slope more than once, this is one of these positions.
        """
        points, height = np.asarray(image, dtype=float), np.asarray(heights, dtype=float)
        to_ground = ground_transform(self.model.crs, GROUND_CRS)
        for _ in range(_ROUNDS):
            ground = to_ground(self.model.image_to_ground(points, height))
            there = self.surface.heights(ground[:, :2], horizontal(parse_crs(GROUND_CRS)))
            height = np.where(np.isfinite(there), there, height)
        return to_ground(self.model.image_to_ground(points, height))

    def moved(self, shift: ArrayLike) -> SceneGeometry:
        """Return this geometry with the model shifted by `shift` (column, row; px)."""
        step = np.zeros(6)
        step[[0, 3]] = np.asarray(shift, dtype=float)
        return self.by(ImageCorrection(self.model, "shift", (0.0, 0.0), step))


def linked(one: Geometry, other: Geometry, place: ArrayLike) -> dict[str, Any]:
    """Return the position of a place in another geometry (`place`) and the partial derivatives (`matrix`).

    Both are null if the place is not visible there.
    """
    steps = np.array([(0.0, 0.0), (-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)]) * _STEP
    there = other.image_of(one.ground_of(np.asarray(place, dtype=float) + steps))
    matrix = np.column_stack([there[2] - there[1], there[4] - there[3]]) / (2 * _STEP)
    if not (np.isfinite(there).all() and abs(np.linalg.det(matrix)) > 1e-9):
        return {"place": None, "matrix": None}
    return {"place": there[0].tolist(), "matrix": matrix.tolist()}


def ground_typed(values: Sequence[float | None], crs: str, vertical: str | None, surface: Surface) -> Array:
    """Return entered coordinates x, y and height as ground ``(3,)`` in `GROUND_CRS`; None means the surface height.

    Parameters
    ----------
    crs : str
        Of x and y.
    vertical : str, optional
        Height datum; default: the ellipsoid.

    Raises
    ------
    InputError, CrsError, DatumError
        If a value is missing, its CRS or datum is unknown, or both state different heights.
    """
    for field, text in (("crs", crs), ("vertical", vertical or "ellipsoid")):
        # Other definitions could refer to files, which the page must not open.
        if not re.fullmatch(_NAMED, text.strip(), re.ASCII | re.IGNORECASE):
            raise InputError(
                "unknown CRS" if field == "crs" else "unknown height datum",
                field=field,
                remedy="give EPSG:n; for heights also ellipsoid, egm96 or egm2008",
            )
    if len(values) != 3 or values[0] is None or values[1] is None:
        raise InputError("enter x and y; the height is optional", field="ground")
    full, datum = parse_crs(crs), Vertical.parse(vertical or "ellipsoid")
    declared = declared_vertical(full) if full.is_compound and values[2] is not None else None
    if declared is not None and declared.vertical is not None and declared.vertical != datum:
        raise DatumError(
            f"the CRS has heights in {declared.vertical.label}, but the height datum is {datum.label}",
            field="vertical",
            remedy=f"give the height datum {declared.vertical.name}",
        )
    plane = horizontal(full)
    plan = np.array([[values[0], values[1]]], dtype=float)
    lonlat = ground_transform(plane, "EPSG:4326")(np.column_stack([plan, [0.0]]))[0, :2]
    if values[2] is None:
        height = float(surface.heights(plan, plane)[0])
        if not np.isfinite(height):
            raise InputError("the DEM has no height here", field="ground", remedy="enter the height")
    else:
        height = float(datum.ellipsoidal(lonlat[:1], lonlat[1:], [values[2]])[0])
    return np.array([lonlat[0], lonlat[1], height])
