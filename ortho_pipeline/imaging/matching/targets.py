"""A scene, the images that it is matched with (reference orthoimages, or another scene), and what they show of it."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pyproj
from numpy.typing import NDArray

from ortho_pipeline.errors import CrsError, InputError, completed
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.options.texts import counted
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource
from ortho_pipeline.surface.base import Surface

#: Points per side of a scene at which it is asked what targets show of it.
SAMPLES = 32
#: Pixels of a chip are smaller by this than those of a coarser target.
_FINER = 1.5
#: Resolutions of scene and target differ by at most this factor: 10, and what a map projection changes.
_RATIO = 10.5


@dataclass(frozen=True, eq=False)
class SceneView:
    """A scene as a matcher sees it.

    Parameters
    ----------
    intensity : Intensity
    model : SensorModel
    surface : Surface
    """

    intensity: Intensity
    model: SensorModel
    surface: Surface

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
        """What errors call it."""
        ...

    @property
    def field(self) -> str:
        """The option that it was given by."""
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
            Numbers from 1 of the bands that are compared; those with the most content without.

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
                f"the reference has no {missing}: where it lies is not known",
                file=source.path,
                field="reference",
                remedy="give an orthoimage (GeoTIFF with its CRS), or set it with gdal_edit.py -a_srs and -a_ullr",
            )
        forward = np.array([[transform[1], transform[2]], [transform[4], transform[5]]])
        with np.errstate(all="ignore"):
            sound = abs(np.linalg.det(forward)) > 0
            inverse = np.linalg.inv(forward) if sound else np.full((2, 2), np.nan)
            offset = -inverse @ np.array([transform[0], transform[3]])
            # Beyond that many pixels from the origin a number does not tell one pixel from the next.
            sound = bool(np.isfinite(inverse).all() and np.abs(offset).max() < 2**52)
        if not sound:
            raise CrsError(
                "the reference has a georeference that cannot be inverted",
                file=source.path,
                field="reference",
                remedy="give an orthoimage",
            )
        with completed(source.path):
            crs = horizontal(parse_crs(text))
            # A system of no known datum is refused here, by the name of its file.
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
        """Put ground into the map, and the map into pixels."""
        plan = ground_transform(crs, self.crs)(ground)[:, :2]
        return plan @ self.pixel_from_map[:, :2].T + self.pixel_from_map[:, 2]


def open_references(
    paths: Sequence[str | os.PathLike[str]], bands: Sequence[int] = (), **access: Any
) -> tuple[Reference, ...]:
    """Open reference orthoimages; where several show the same ground, the first that does is taken.

    Parameters
    ----------
    bands : sequence of int
        Of each, as `Reference.open` takes them.

    Raises
    ------
    CrsError, InputError
        As `Reference.open`, or if there is none.
    """
    if not paths:
        raise InputError("there is no reference", field="reference", remedy="give an orthoimage")
    return tuple(Reference.open(path, bands, **access) for path in paths)


def spread_over(view: SceneView) -> Array:
    """Return points ``(SAMPLES**2, 2)`` spread over a scene."""
    steps = (np.arange(SAMPLES) + 0.5) / SAMPLES
    columns, rows = np.meshgrid(steps * view.size[0], steps * view.size[1])
    return np.column_stack([columns.ravel(), rows.ravel()])


def near(view: SceneView, targets: Sequence[Target], reach: float) -> Sequence[Target]:
    """Return the targets that may show something of a scene whose model is off by `reach` px; all, if none may.

    Of a country's many orthoimages a scene needs few, and each of the others would be asked for every chip.
    """
    image = spread_over(view)
    ground = view.model.image_to_ground(image, view.model.reference_height)
    # A quarter of the scene besides, for relief and the curves of the projection.
    share = 0.25 + reach / min(view.size)
    found = []
    for target in targets:
        places = target.project(ground, view.model.crs)
        places = places[np.isfinite(places).all(axis=1)]
        if len(places):
            low, high = places.min(axis=0), places.max(axis=0)
            margin, size = share * (high - low).max(), (target.intensity.width, target.intensity.height)
            if ((low - margin > size) | (high + margin < 0)).any():
                continue
        found.append(target)
    return found or targets


def shown_by(targets: Sequence[Target], ground: Array, crs: str) -> NDArray[np.bool_]:
    """Tell which ground ``(n, 3)`` lies in one of the targets at least."""
    found = np.zeros(len(ground), dtype=bool)
    for target in targets:
        places = target.project(ground, crs)
        with np.errstate(invalid="ignore"):
            found |= ((places >= 0) & (places <= (target.intensity.width, target.intensity.height))).all(axis=1)
    return found


def chip_factor(view: SceneView, targets: Sequence[Target], shown: Array) -> int:
    """Return how many pixels of a scene make one of a chip, where targets show points ``(n, 2)`` of it; at least 1.

    Raises
    ------
    InputError
        If the resolutions are too different to be compared.
    """
    ratio = float(np.nanmedian(np.concatenate([_resolution_ratio(view, target, shown) for target in targets])))
    if not 1 / _RATIO <= ratio <= _RATIO:
        first = targets[0]
        raise InputError(
            f"a pixel of {os.path.basename(view.intensity.source.path)} is {ratio:.3g} pixels of {first.called}",
            file=first.path,
            field=first.field,
            remedy=f"match images whose resolutions differ by at most {int(_RATIO)} times",
        )
    # Averaged to the pixels of a target half as fine, a real scene was found half a pixel off; in its own, a twentieth.
    # Of a scene that was enlarged, two by two are its own: single ones show its noise as if it were structure.
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
    placed = ground_transform(view.model.crs, "EPSG:4978")(ground)
    across, down = placed[1] - placed[0], placed[2] - placed[0]
    return math.sqrt(float(np.linalg.norm(np.cross(across, down)))) / 8
