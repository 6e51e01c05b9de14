"""A scene, its targets (reference orthoimages, or another scene), and the part of the scene that they show."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.display.numbers import significant
from ortho_pipeline.errors import CrsError, InputError, completed
from ortho_pipeline.errors.texts import counted
from ortho_pipeline.files.shell import typed
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.base import Surface

#: Sample points per side of a scene, to find what targets show of it.
SAMPLES = 32
#: Pixels of a chip are smaller by this factor than those of a coarser target.
_FINER = 1.5
#: Resolutions of scene and target differ by at most this factor: 10, and what a map projection changes.
_RATIO = 10.5


@dataclass(frozen=True, eq=False)
class SceneView:
    """A scene for matching.

    Parameters
    ----------
    intensity : Intensity
    model : SensorModel
    surface : Surface
    spots : int
        Largest number of coarse chips per side.
    """

    intensity: Intensity
    model: SensorModel
    surface: Surface
    spots: int = 6

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.intensity.width, self.intensity.height


class Target(Protocol):
    """An image that shows the same ground as a scene."""

    @property
    def intensity(self) -> Intensity: ...

    @property
    def path(self) -> str: ...

    @property
    def called(self) -> str:
        """Its name in errors."""
        ...

    @property
    def field(self) -> str:
        """The option that named it."""
        ...

    def project(self, ground: Array, crs: str) -> Array:
        """Return the pixel positions ``(N, 2)`` of ground ``(N, 3)``; NaN where there are none."""
        ...


@dataclass(frozen=True, eq=False)
class OtherScene:
    """Another scene, with its model."""

    intensity: Intensity
    model: SensorModel

    @property
    def path(self) -> str:
        """The file."""
        return self.intensity.source.path

    @property
    def called(self) -> str:
        """The name of its file."""
        return os.path.basename(self.path)

    @property
    def field(self) -> str:
        """The images of a block."""
        return "images"

    def project(self, ground: Array, crs: str) -> Array:
        """Project ground by the model."""
        return self.model.ground_to_image(ground_transform(crs, self.model.crs)(ground))


@dataclass(frozen=True, eq=False)
class Reference:
    """An orthoimage.

    Parameters
    ----------
    intensity : Intensity
    crs : pyproj.CRS
        Horizontal.
    pixel_from_map : (2, 3)
        Affine transformation of map coordinates to pixels.
    """

    intensity: Intensity
    crs: pyproj.CRS
    pixel_from_map: Array

    @classmethod
    def open(cls, path: str | os.PathLike[str], bands: Sequence[int] = (), **access: Any) -> Reference:
        """Open an orthoimage of any format, CRS, resolution and number of bands.

        Parameters
        ----------
        bands : sequence of int
            Numbers, from 1, of the bands to compare. Default: those with the most content.

        Raises
        ------
        CrsError
            If it has no CRS or no georeference.
        InputError
            If it cannot be read, or has no such band.
        """
        source = RasterSource(path, **access)
        missing_band = next((number for number in bands if not 1 <= number <= source.count), None)
        if missing_band is not None:
            raise InputError(
                f"the reference has {counted(source.count, 'band')}; there is no band {missing_band}",
                file=source.path,
                field="match.reference_bands",
                remedy=f"give numbers from 1 to {source.count}",
            )
        dataset = source.dataset
        text, transform = dataset.GetProjection(), dataset.GetGeoTransform(can_return_null=True)
        if not text or transform is None:
            missing = "coordinate system" if transform is not None else "georeference"
            raise CrsError(
                f"the reference has no {missing}, so its position is unknown",
                file=source.path,
                field="reference",
                remedy="give an orthoimage (GeoTIFF with its CRS), or set its place: "
                f"`gdal_edit.py -a_srs EPSG:CODE -a_ullr WEST NORTH EAST SOUTH {typed(source.path)}`",
            )
        forward = np.array([[transform[1], transform[2]], [transform[4], transform[5]]])
        with np.errstate(all="ignore"):
            sound = abs(np.linalg.det(forward)) > 0
            inverse = np.linalg.inv(forward) if sound else np.full((2, 2), np.nan)
            offset = -inverse @ np.array([transform[0], transform[3]])
            # Farther from the origin, floating-point numbers cannot distinguish neighbouring pixels.
            sound = bool(np.isfinite(inverse).all() and np.abs(offset).max() < 2**52)
        if not sound:
            raise CrsError(
                "the geotransform of the reference cannot be inverted",
                file=source.path,
                field="reference",
                remedy="give an orthoimage",
            )
        with completed(source.path):
            crs = horizontal(parse_crs(text))
            # Refuse a CRS without a known datum here, so that the error names the file.
            ground_transform("EPSG:4979", crs)
        return cls(Intensity(source, bands), crs, np.column_stack([inverse, offset]))

    @property
    def path(self) -> str:
        """The file."""
        return self.intensity.source.path

    @property
    def called(self) -> str:
        """One for all references."""
        return "the reference"

    @property
    def field(self) -> str:
        """The references of a match."""
        return "match.reference"

    @property
    def corners(self) -> Array:
        """Map coordinates ``(4, 2)`` of the corners."""
        pixels = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (self.intensity.width, self.intensity.height)
        return (pixels - self.pixel_from_map[:, 2]) @ np.linalg.inv(self.pixel_from_map[:, :2]).T

    def project(self, ground: Array, crs: str) -> Array:
        """Convert ground to the map, and the map to pixels."""
        plan = ground_transform(crs, self.crs)(ground)[:, :2]
        if self.crs.is_geographic:
            # Longitudes are taken modulo a circle, so that the map may be on either side of the antimeridian.
            circle = math.tau / self.crs.axis_info[0].unit_conversion_factor
            plan[:, 0] -= circle * np.round((plan[:, 0] - self.corners[:, 0].mean()) / circle)
        return plan @ self.pixel_from_map[:, :2].T + self.pixel_from_map[:, 2]


def open_references(
    paths: Sequence[str | os.PathLike[str]], bands: Sequence[int] = (), **access: Any
) -> tuple[Reference, ...]:
    """Open reference orthoimages; where several show the same ground, the first one is used.

    Parameters
    ----------
    bands : sequence of int
        Bands of each; see `Reference.open`.

    Raises
    ------
    CrsError, InputError
        As `Reference.open`, or if there is none.
    """
    if not paths:
        raise InputError("no reference is given", field="reference", remedy="give an orthoimage")
    return tuple(Reference.open(path, bands, **access) for path in paths)


def spread_over(view: SceneView) -> Array:
    """Return points ``(SAMPLES**2, 2)`` spread over a scene."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    columns, rows = np.meshgrid(steps * view.size[0], steps * view.size[1])
    return np.column_stack([columns.ravel(), rows.ravel()])


def near(view: SceneView, targets: Sequence[Target], reach: float) -> Sequence[Target]:
    """Return the targets that may overlap a scene whose model is off by up to `reach` px; all, if none may.

    A scene needs few of the many orthoimages of a country, and each other one would be tried for every chip.
    """
    image = spread_over(view)
    ground = view.model.image_to_ground(image, view.model.reference_height)
    # Plus a quarter of the scene, for relief and the curvature of the projection.
    share = 0.25 + reach / min(view.size)
    overlapping = []
    for target in targets:
        places = target.project(ground, view.model.crs)
        places = places[np.isfinite(places).all(axis=1)]
        if len(places):
            low, high = places.min(axis=0), places.max(axis=0)
            margin, size = share * (high - low).max(), (target.intensity.width, target.intensity.height)
            if ((low - margin > size) | (high + margin < 0)).any():
                continue
        overlapping.append(target)
    return overlapping or targets


def shown_by(targets: Sequence[Target], ground: Array, crs: str) -> NDArray[np.bool_]:
    """Return which ground points ``(n, 3)`` are in at least one of the targets."""
    shown = np.zeros(len(ground), dtype=bool)
    for target in targets:
        places = target.project(ground, crs)
        with np.errstate(invalid="ignore"):
            shown |= ((places >= 0) & (places <= (target.intensity.width, target.intensity.height))).all(axis=1)
    return shown


def chip_factor(view: SceneView, targets: Sequence[Target], shown: Array) -> int:
    """Return the number (at least 1) of pixels of a scene in a chip pixel, if targets show points ``(n, 2)`` of it.

    Raises
    ------
    InputError
        If the resolutions are too different.
    """
    ratio = float(np.nanmedian(np.concatenate([_resolution_ratio(view, target, shown) for target in targets])))
    if not 1 / _RATIO <= ratio <= _RATIO:
        first = targets[0]
        raise InputError(
            f"a pixel of {os.path.basename(view.intensity.source.path)} is {significant(ratio, 3)} pixels of "
            f"{first.called}",
            file=first.path,
            field=first.field,
            remedy=f"match images whose resolutions differ by at most {int(_RATIO)} times",
        )
    # Averaged to the pixels of a target half as fine, a real scene was off by half a pixel; in its own pixels by a
    # twentieth. An enlarged scene needs two by two: its single pixels would show noise as structure.
    return max(2 if view.intensity.enlarged else 1, round(1 / ratio / _FINER))


def _resolution_ratio(view: SceneView, target: Target, image: Array) -> Array:
    """Return pixels of the target per pixel of the scene ``(n,)`` at image points; NaN where it shows nothing."""
    heights = np.full(len(image), view.model.reference_height)
    around = [
        target.project(view.model.image_to_ground(image + step, heights), view.model.crs)
        for step in ((0.0, 0.0), (8.0, 0.0), (0.0, 8.0))
    ]
    across, down = (around[1] - around[0]) / 8, (around[2] - around[0]) / 8
    return np.sqrt(np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]))


def metres_per_pixel(view: SceneView) -> float:
    """Return the size (m) of a pixel on the ground in the middle of a scene."""
    middle = np.array(view.size) / 2
    image = middle + np.array([(0.0, 0.0), (8.0, 0.0), (0.0, 8.0)])
    ground = view.model.image_to_ground(image, view.model.reference_height)
    ecef = ground_transform(view.model.crs, "EPSG:4978")(ground)
    across, down = ecef[1] - ecef[0], ecef[2] - ecef[0]
    return math.sqrt(float(np.linalg.norm(np.cross(across, down)))) / 8
