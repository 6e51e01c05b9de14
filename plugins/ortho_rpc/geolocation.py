"""Images with geolocation arrays: longitude and latitude of every pixel, or of every few, in GDAL's domain or in files.

Such arrays are for one unknown height per pixel. So they give the position of an image without relief displacement: a
start for matching. The model is the simplest polynomial that fits them; a warning states its error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
from numpy.typing import NDArray
from osgeo import gdal

from ortho_pipeline.plugin import (
    CrsError,
    InputError,
    Notice,
    OrthoError,
    Points,
    Scene,
    SensorModel,
    Setting,
    Text,
    fit_family,
    ground_transform,
    open_dataset,
    parse_crs,
    place,
)

Array = NDArray[np.float64]

OPTIONS = {
    "lon": "file with the longitudes of the pixels (or of every n-th), if the image does not name it",
    "lat": "file with the latitudes, in the same way",
}
#: Largest arrays (pixels), and number of sampled rows and columns.
_MOST, _NODES = 100_000_000, 60
#: Polynomials are tried until one follows the arrays to this (px).
_FOLLOWS = 0.1
_HEIGHTS = (-500.0, 9000.0)
_REMEDY = (
    "write longitudes and latitudes as GeoTIFF (`gdal_translate IN OUT`), and give both as sensor options lon=FILE and "
    "lat=FILE"
)


@dataclass(frozen=True)
class Layout:
    """The arrays of an image: files, bands, and which of its pixels belongs to which of theirs."""

    files: tuple[str, str]
    bands: tuple[int, int]
    origin: tuple[float, float]
    step: tuple[float, float]
    crs: pyproj.CRS
    centred: bool


def has_arrays(dataset: gdal.Dataset) -> bool:
    """Return whether an image has geolocation arrays."""
    return bool((dataset.GetMetadata("GEOLOCATION") or {}).get("X_DATASET"))


def open_scene(dataset: gdal.Dataset, *, lon: str | None = None, lat: str | None = None) -> Scene:
    """Open an image by its geolocation arrays."""
    name, size = dataset.GetDescription(), (dataset.RasterXSize, dataset.RasterYSize)
    if (lon is None) != (lat is None):
        raise InputError("give both longitudes and latitudes", file=name, field="lon, lat", remedy=_REMEDY)
    layout = _layout_of(dataset) if lon is None else None
    files = layout.files if layout else (str(lon), str(lat))
    sources = tuple(open_dataset(file) for file in files)
    if layout is None:
        shape = sources[0].RasterXSize, sources[0].RasterYSize
        step = size[0] / shape[0], size[1] / shape[1]
        layout = Layout((files[0], files[1]), (1, 1), (0.0, 0.0), step, pyproj.CRS.from_epsg(4326), True)
    image, ground = _nodes(name, layout, sources, size)
    try:
        model, family, worst = _fitted(image, ground, size)
    except OrthoError as error:
        raise InputError(error.message, file=name, field="GEOLOCATION", remedy=_REMEDY) from error
    text = Text(
        "geolocation arrays have no heights; use them only as a start for ",
        Setting("match.reference"),
        f". Relief displacement remains. The model {family} represents them within {worst:.2g} px",
    )
    facts: dict[str, Any] = {"arrays": [Path(file).name for file in files], "max_error_px": round(worst, 3)}
    return Scene(
        "geolocation",
        name,
        *size,
        {family: model},
        files[0],
        facts,
        (Notice("only-a-start", text, max_error_px=worst),),
        sources=(files[1],),
    )


def _layout_of(dataset: gdal.Dataset) -> Layout:
    """Return the contents of the domain ``GEOLOCATION``; its files must be next to the image."""
    name = dataset.GetDescription()
    # GDAL returns bytes for invalid text.
    fields = {
        key: text if isinstance(text, str) else "?" for key, text in (dataset.GetMetadata("GEOLOCATION") or {}).items()
    }
    if not has_arrays(dataset) or not fields.get("Y_DATASET"):
        raise InputError("this image has no geolocation arrays", file=name, field="GEOLOCATION", remedy=_REMEDY)
    folder = place(name).parent
    files = []
    for axis in "XY":
        text = fields[f"{axis}_DATASET"]
        beside = folder / text.replace("\\", "/").rpartition("/")[2]
        # Only the folder of the image is searched, whatever folder the metadata name.
        if ":" in text or not _is_file(beside):
            raise InputError(
                f"the array {text[:200]!r} is not a file next to the image",
                file=name,
                field=f"{axis}_DATASET",
                remedy=_REMEDY,
            )
        files.append(str(beside))

    def number(key: str, default: str) -> float:
        try:
            value = float(fields.get(key, default))
        except ValueError:
            value = np.nan
        if not abs(value) < 1e7 or (key.endswith("STEP") and value <= 0):
            raise InputError(f"{fields[key][:20]!r} is not a number", file=name, field=key, remedy=_REMEDY)
        return value

    try:
        crs = parse_crs(fields.get("SRS") or "EPSG:4326")
    except CrsError as error:
        raise InputError("the CRS of the arrays is unknown", file=name, field="SRS", remedy=_REMEDY) from error
    return Layout(
        files=(files[0], files[1]),
        bands=(int(number("X_BAND", "1")), int(number("Y_BAND", "1"))),
        origin=(number("PIXEL_OFFSET", "0"), number("LINE_OFFSET", "0")),
        step=(number("PIXEL_STEP", "1"), number("LINE_STEP", "1")),
        crs=crs,
        centred=fields.get("GEOREFERENCING_CONVENTION") == "PIXEL_CENTER",
    )


def _is_file(path: Any) -> bool:
    try:
        return bool(path.is_file())
    except (OSError, ValueError):
        return False  # a name longer than a file system takes


def _nodes(name: str, layout: Layout, sources: tuple[gdal.Dataset, ...], size: tuple[int, int]) -> tuple[Array, Array]:
    """Return image points ``(N, 2)`` and longitudes, latitudes ``(N, 2)`` of some nodes of the arrays."""
    first, last = sources
    shape = first.RasterXSize, first.RasterYSize
    if (last.RasterXSize, last.RasterYSize) != shape or shape[0] * shape[1] > _MOST:
        raise InputError(
            "the arrays have different sizes, or are too large", file=name, field="Y_DATASET", remedy=_REMEDY
        )
    columns, rows = (np.unique(np.linspace(0, count - 1, _NODES).round().astype(int)) for count in shape)
    values = []
    for source, band, file in zip(sources, layout.bands, layout.files, strict=True):
        if not 1 <= band <= source.RasterCount:
            raise InputError(f"{file} has no band {band}", file=name, field="X_BAND, Y_BAND", remedy=_REMEDY)
        kept, nodata = source.GetRasterBand(band), source.GetRasterBand(band).GetNoDataValue()
        part = np.array([kept.ReadAsArray(0, int(row), shape[0], 1)[0, columns] for row in rows], dtype=np.float64)
        values.append(np.where(part == nodata, np.nan, part) if nodata is not None else part)
    plane = np.stack(values, axis=-1).reshape(-1, 2)
    at = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2) + 0.5 * layout.centred
    image = at * layout.step + layout.origin
    good = np.isfinite(plane).all(axis=1) & (image >= 0).all(axis=1) & (image <= size).all(axis=1)
    ground = np.full((len(plane), 3), np.nan)
    ground[good] = ground_transform(layout.crs, "EPSG:4979")(np.column_stack([plane[good], np.zeros(good.sum())]))
    good &= np.isfinite(ground).all(axis=1) & (np.abs(ground[:, 1]) <= 90) & (np.abs(ground[:, 0]) <= 360)
    if good.sum() < max(16, 0.5 * len(good)):
        raise InputError(
            f"{good.sum()} of {len(good)} nodes have both a longitude and a latitude",
            file=name,
            field="GEOLOCATION",
            remedy=_REMEDY,
        )
    lon = ground[good, 0]
    around = lon[len(lon) // 2]
    return image[good], np.column_stack([around + np.remainder(lon - around + 180, 360) - 180, ground[good, 1]])


def _fitted(image: Array, ground: Array, size: tuple[int, int]) -> tuple[SensorModel, str, float]:
    """Return the lowest polynomial through every other node, its name, and how far it is off the others (px)."""
    count, best = len(image), None
    ground = np.column_stack([ground, np.zeros(count)])
    half = np.arange(count) % 2 == 0
    points = Points(
        ids=tuple(map(str, range(int(half.sum())))),
        image=image[half],
        ground=ground[half],
        roles=np.full(int(half.sum()), "control"),
        sigma_image=np.ones(int(half.sum())),
        sigma_ground=np.zeros((int(half.sum()), 3)),
        crs=pyproj.CRS.from_epsg(4326),
        source="geolocation arrays",
    )
    for family in ("affine2d", "poly2", "poly3", "poly4", "poly5"):
        model = fit_family(family, points, size=size, heights=_HEIGHTS, ridge=None, robust=False).model
        worst = float(np.abs(model.ground_to_image(ground[~half]) - image[~half]).max())
        if best is None or worst < best[2]:
            best = model, family, worst
        if worst < _FOLLOWS:
            break
    if best is None or not best[2] < max(size):
        raise InputError(
            "no polynomial fits the arrays; they are probably damaged", field="GEOLOCATION", remedy=_REMEDY
        )
    return best
