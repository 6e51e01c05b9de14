"""Images that a scene is matched with: reference orthoimages, or another scene. Each says where ground lies in it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pyproj

from ortho_pipeline.errors import CrsError, InputError
from ortho_pipeline.geodesy.crs import ground_transform, horizontal, parse_crs
from ortho_pipeline.models.base import Array, SensorModel
from ortho_pipeline.raster.intensity import Intensity
from ortho_pipeline.raster.source import RasterSource


class Target(Protocol):
    """An image that shows the same ground as a scene."""

    @property
    def intensity(self) -> Intensity: ...

    @property
    def path(self) -> str: ...

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
    def open(cls, path: str | os.PathLike[str], **access: Any) -> Reference:
        """Open an orthoimage of any format, CRS, resolution and number of bands.

        Raises
        ------
        CrsError
            If it has no CRS or no georeference.
        InputError
            If it cannot be read.
        """
        source = RasterSource(path, **access)
        dataset = source.dataset
        text, transform = dataset.GetProjection(), dataset.GetGeoTransform(can_return_null=True)
        if not text or transform is None:
            missing = "coordinate system" if transform is not None else "georeference"
            raise CrsError(
                f"the reference has no {missing}: where it lies is not known", file=source.path, field="reference",
                remedy="give an orthoimage (GeoTIFF with its CRS), or set it with gdal_edit.py -a_srs and -a_ullr",
            )  # fmt: skip
        forward = np.array([[transform[1], transform[2]], [transform[4], transform[5]]])
        if not (np.isfinite(transform).all() and abs(np.linalg.det(forward)) > 0):
            raise CrsError(
                "the reference has a georeference that cannot be inverted", file=source.path, field="reference",
                remedy="give an orthoimage",
            )  # fmt: skip
        inverse = np.linalg.inv(forward)
        offset = -inverse @ np.array([transform[0], transform[3]])
        return cls(Intensity(source), horizontal(parse_crs(text)), np.column_stack([inverse, offset]))

    @property
    def path(self) -> str:
        """The file."""
        return self.intensity.source.path

    @property
    def corners(self) -> Array:
        """Map coordinates ``(4, 2)`` of the corners."""
        pixels = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * (self.intensity.width, self.intensity.height)
        return (pixels - self.pixel_from_map[:, 2]) @ np.linalg.inv(self.pixel_from_map[:, :2]).T

    def project(self, ground: Array, crs: str) -> Array:
        """Put ground into the map, and the map into pixels."""
        plan = ground_transform(crs, self.crs)(ground)[:, :2]
        return plan @ self.pixel_from_map[:, :2].T + self.pixel_from_map[:, 2]


def open_references(paths: Sequence[str | os.PathLike[str]], **access: Any) -> tuple[Reference, ...]:
    """Open reference orthoimages; where several show the same ground, the first that does is taken.

    Raises
    ------
    CrsError, InputError
        As `Reference.open`, or if there is none.
    """
    if not paths:
        raise InputError("there is no reference", field="reference", remedy="give an orthoimage")
    return tuple(Reference.open(path, **access) for path in paths)
