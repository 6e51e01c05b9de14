"""All images of a block for another program: files, pairs, and what its configuration states."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ortho_pipeline.errors import CoverageError
from ortho_pipeline.geodesy.crs import ground_transform
from ortho_pipeline.models.base import Array, SensorModel

#: Images are a pair if they share at least this part of one of them.
LEAST_OVERLAP = 0.05
#: Degrees between the views of a pair. With less, a matching error of 0.3 px is more than 17 px of height.
LEAST_ANGLE_DEG = 1.0
#: Cells along each side of an image in which overlap is measured.
_CELLS = 32


@dataclass(frozen=True)
class ExportedImage:
    """An image of a block, as a configuration names it.

    Parameters
    ----------
    path : str
        The image without a georeference, relative to the folder of the files.
    model : str
        Name of the file with its model, in that folder.
    size : (int, int)
        Columns and rows.
    bands : int
        Number of bands.
    nodata : float or None
        Value of empty pixels.

    Examples
    --------
    >>> ExportedImage("../aft.tif", "aft.geom", (1000, 800)).bands
    1
    """

    path: str
    model: str
    size: tuple[int, int]
    bands: int = 1
    nodata: float | None = None


@dataclass(frozen=True)
class ImagePair:
    """Two images of the same ground from different directions.

    Parameters
    ----------
    first, second : str
        Names of the images.
    overlap : float
        Common part (0 to 1) of the image that shares more.
    angle_deg : float
        Degrees between the rays of one ground point.
    """

    first: str
    second: str
    overlap: float
    angle_deg: float


@dataclass(frozen=True)
class BlockExport:
    """What the text of a `BlockFormat` is made of.

    Parameters
    ----------
    images : mapping of str to ExportedImage
        In the order of the user.
    models : str
        Name of the format of the model files.
    pairs : sequence of ImagePair
        Images that overlap, which the program can match.
    resolution : float
        Ground sample distance (m) of the finest image, to two digits.
    crs : str
        The UTM zone, such as EPSG:32631.
    elevation : str, optional
        Name of a DEM of the ground in EPSG:4326, with heights above the WGS 84 ellipsoid.

    Examples
    --------
    >>> images = {name: ExportedImage(f"{name}.tif", f"{name}.geom", (1000, 800)) for name in ("aft", "fore")}
    >>> block = BlockExport(images, "geom", [ImagePair("aft", "fore", 0.9, 20.0)], 2.5, "EPSG:32636")
    >>> [pair.second for pair in block.pairs]
    ['fore']
    """

    images: Mapping[str, ExportedImage]
    models: str
    pairs: Sequence[ImagePair]
    resolution: float
    crs: str
    elevation: str | None = None


def pairs_of(images: Mapping[str, tuple[SensorModel, tuple[int, int]]], height: float) -> list[ImagePair]:
    """Return the pairs from which a stereo program computes heights.

    Parameters
    ----------
    images : mapping of str to (SensorModel, (int, int))
        Model and size of each image.
    height : float
        Ellipsoidal height (m) of the ground.

    Raises
    ------
    CoverageError
        If there is none.
    """
    pairs, near = [], False
    for (first, a), (second, b) in itertools.combinations(images.items(), 2):
        common, back = _seen(*a, *b, height), _seen(*b, *a, height)
        overlap = max(len(common), len(back)) / _CELLS**2
        if overlap < LEAST_OVERLAP:
            continue
        near = True
        middle = np.median(common if len(common) else back, axis=0)
        angle = _angle_deg(_ray(a[0], middle), _ray(b[0], middle))
        if angle >= LEAST_ANGLE_DEG:
            pairs.append(ImagePair(first, second, overlap, angle))
    if not pairs:
        why = (
            f"views of the same ground differ by less than {LEAST_ANGLE_DEG:g} degree" if near else "no images overlap"
        )
        raise CoverageError(
            f"stereo is impossible: {why}",
            field="export",
            remedy="give images of the same ground from different directions",
        )
    return pairs


def _seen(
    model: SensorModel, size: tuple[int, int], other: SensorModel, within: tuple[int, int], height: float
) -> Array:
    """Return the ground (lon, lat, h) of those cells of an image that the other one sees ``(N, 3)``."""
    steps = (np.arange(_CELLS) + 0.5) / _CELLS
    columns, rows = np.meshgrid(size[0] * steps, size[1] * steps)
    ground = model.image_to_ground(np.stack([columns.ravel(), rows.ravel()], axis=1), height)
    ground = ground_transform(model.crs, "EPSG:4979")(ground)
    with np.errstate(all="ignore"):
        seen = other.ground_to_image(ground_transform("EPSG:4979", other.crs)(ground))
        inside = ((seen >= 0) & (seen <= within)).all(axis=1)
    return ground[inside & np.isfinite(ground).all(axis=1)]


def _ray(model: SensorModel, place: Array) -> Array:
    """Return the direction (ECEF) of the ray of an image that meets a place (lon, lat, h) ``(3,)``."""
    own = ground_transform("EPSG:4979", model.crs)(place[None])
    image = np.repeat(model.ground_to_image(own), 2, axis=0)
    ends = model.image_to_ground(image, place[2] + np.array([0.0, 100.0]))
    low, high = ground_transform(model.crs, "EPSG:4978")(ends)
    direction: Array = (high - low) / np.linalg.norm(high - low)
    return direction


def _angle_deg(a: Array, b: Array) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))
