"""The files of an IKONOS order: bands and components next to an image, and the map position of each."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyproj
from osgeo import gdal

from ortho_ikonos.metadata import Component, Delivery, MapPlacement, read_header
from ortho_pipeline.plugin import CrsError, InputError, Notice, listing, parse_crs, place, same_crs

_NAME = re.compile(
    r"(?P<order>po_[^/\\]+)_(?P<band>[a-z]{2,4})_(?P<component>\d{7})\.(?:tiff?|ntf|nitf)", re.IGNORECASE | re.ASCII
)
#: Bands that have a file of their own, in the vendor's order of a file of several.
SEPARATE = ("blu", "grn", "red", "nir")
#: How many panchromatic pixels one of colours is wide.
COARSER = 4
#: Georeferencing and metadata that differ by more than this (pixels) are not the same.
_SAME = 0.05


@dataclass(frozen=True)
class OrderImage:
    """One image of an order by its name ``po_<order>_<band>_<component>.tif``."""

    path: Path
    order: str
    band: str
    component: str

    @classmethod
    def of(cls, path: Path) -> OrderImage | None:
        """Return the parts of the file name; None if it is not a name of the vendor."""
        match = _NAME.fullmatch(path.name)
        return match and cls(path, match["order"], match["band"].lower(), match["component"])

    @property
    def metadata(self) -> Path:
        """Where the metadata file of the order is."""
        return beside(self.path, f"{self.order}_metadata.txt")

    @property
    def grid(self) -> str:
        """Kind of pixels that images of an order share: separate colours; files of several may be sharpened."""
        return "colour" if self.band in SEPARATE else self.band

    def others(self) -> Iterator[OrderImage]:
        """Yield the other images of the order, by name."""
        for name in listing(self.path.parent).names:
            other = OrderImage.of(self.path.parent / name)
            if other is not None and name != self.path.name and other.order.lower() == self.order.lower():
                yield other


def beside(path: Path, name: str) -> Path:
    """Return the file of this name in the folder of `path`, whatever the case of its letters."""
    exact = path.with_name(name)
    if exact.exists() or not path.parent.is_dir():
        return exact
    return next((path.parent / one for one in listing(path.parent).named(name)), exact)


def rpc_file(path: Path) -> Path | None:
    """Return the ``_rpc.txt`` of an image; None without one."""
    rpc = beside(path, f"{path.stem}_rpc.txt")
    return rpc if rpc.is_file() else None


def bands_of(image: OrderImage, wanted: str) -> tuple[Path, ...]:
    """Return the files whose bands are stacked: none for ``one``, ``all`` separate bands, or names with commas.

    Raises
    ------
    InputError
        If a band is not there, or the image itself is none of them.
    """
    if wanted == "one":
        return ()
    there = {image.band: image.path}
    same = [other for other in image.others() if other.component == image.component]
    there |= {other.band: other.path for other in same if other.grid == image.grid}
    names = [name.strip().lower() for name in wanted.split(",")]
    if wanted == "all":
        names = [name for name in SEPARATE if name in there]
    missing = [name for name in names if name not in there]
    if missing or image.band not in names:
        raise InputError(
            f"no file found for band {missing[0]!r}"
            if missing
            else f"the choice lacks this image's own band {image.band!r}",
            file=image.path,
            field="bands",
            remedy=f"use all, one, or some of {', '.join(sorted(there))}, including the band of this image",
        )
    return tuple(there[name] for name in names)


# -- map position ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Position:
    """Position of an image on the map; None if not stated.

    `corner` is the outer corner of the first pixel, `pixel` the size of a pixel of this image, both in metres;
    `sources` are the files with this information.
    """

    crs: str | None
    corner: tuple[float, float] | None
    pixel: tuple[float, float] | None
    reference_height: float | None
    warnings: tuple[Notice, ...]
    sources: tuple[Path, ...]

    def place_of(self, other: Position) -> tuple[float, float, float] | None:
        """Return column and row of the first corner of another image in this, and its pixels' width; None: unknown."""
        if self.corner is None or self.pixel is None or other.corner is None or other.pixel is None:
            return None
        wide, tall = (theirs / own for theirs, own in zip(other.pixel, self.pixel, strict=True))
        if not math.isclose(wide, tall, rel_tol=1e-9):
            return None
        column = (other.corner[0] - self.corner[0]) / self.pixel[0]
        row = (self.corner[1] - other.corner[1]) / self.pixel[1]
        return round(column, 6), round(row, 6), round(wide, 9)


def position_of(dataset: gdal.Dataset, delivery: Delivery, component: Component) -> Position:
    """Return the position of an image: from its header, its component, the product, or last from its georeferencing.

    Raises
    ------
    InputError
        If the image has another size than stated.
    """
    path, size = place(dataset.GetDescription()), (dataset.RasterXSize, dataset.RasterYSize)
    header = beside(path, f"{path.stem}_hdr.txt")
    stated, sources = component.placement, (place(delivery.file),)
    if header.is_file():
        stated, sources = read_header(header).completed_by(stated), (*sources, header)
    if len(delivery.components) == 1:
        stated = stated.completed_by(delivery.product)
    crs, own = delivery.crs, _georeferencing(dataset)
    factor = _factor(stated, size, path, own and own[2])
    stated = stated.completed_by(delivery.product)
    corner, pixel = _corner(stated), stated.pixel and (factor * stated.pixel[0], factor * stated.pixel[1])
    warnings = []
    if own is not None:
        own_crs, own_corner, own_pixel = own
        crs = crs or own_crs.to_string()
        if not same_crs(parse_crs(crs), own_crs):
            text = f"the CRS is {own_crs.name} in the image, but {delivery.projection} in the metadata"
            warnings.append(Notice("metadata-contradict", text))
        elif corner is not None and pixel is not None:
            off = _difference(corner, pixel, own_corner, own_pixel, size)
            if off > _SAME:
                text = (
                    f"the georeferencing of the image is {off:.2f} px off the metadata; the metadata are used "
                    "(UL Map X and Y are the centre of the first pixel)"
                )
                warnings.append(Notice("metadata-contradict", text, difference_px=off))
        corner, pixel = corner or own_corner, pixel or own_pixel
    return Position(crs, corner, pixel, stated.reference_height, tuple(warnings), sources)


def _factor(stated: MapPlacement, size: tuple[int, int], path: Path, own_pixel: tuple[float, float] | None) -> int:
    """Return the number of stated pixels per pixel of the image: 4 for colours with panchromatic metadata.

    Colour and panchromatic images of one acquisition share their outer corner. A crop to a half or a quarter can have
    such a size too. Then its pixel size decides; without one, only colours can be coarser.
    """
    if stated.size is None or stated.size == size:
        return 1
    factor = round(stated.size[0] / size[0])
    fits = factor > 1 and all(
        abs(total - factor * part) < factor for total, part in zip(stated.size, size, strict=True)
    )
    if own_pixel is not None and stated.pixel is not None:
        fits &= all(
            math.isclose(own, factor * step, rel_tol=1e-3) for own, step in zip(own_pixel, stated.pixel, strict=True)
        )
    else:
        image = OrderImage.of(path)
        fits &= factor == COARSER and not (image is not None and image.grid == "pan")
    if not fits:
        raise InputError(
            f"the image has {size[0]} x {size[1]} pixels, but the metadata are for {stated.size[0]} x {stated.size[1]}",
            file=path,
            field="Columns, Rows",
            remedy="use the complete image as delivered, with its own metadata",
        )
    return factor


def _corner(stated: MapPlacement) -> tuple[float, float] | None:
    """Return the outer corner of the first pixel, whose centre is stated."""
    if stated.upper_left is None or stated.pixel is None:
        return None
    return stated.upper_left[0] - stated.pixel[0] / 2, stated.upper_left[1] + stated.pixel[1] / 2


def _georeferencing(dataset: gdal.Dataset) -> tuple[pyproj.CRS, tuple[float, float], tuple[float, float]] | None:
    """Return CRS, outer corner and pixel size of a north-up image in a map projection; None for any other."""
    transform, reference = dataset.GetGeoTransform(can_return_null=True), dataset.GetSpatialRef()
    if transform is None or reference is None or not reference.IsProjected():
        return None
    left, dx, skew_x, top, skew_y, dy = transform
    if skew_x or skew_y or dx <= 0 or dy >= 0:
        return None
    try:
        crs = parse_crs(reference.ExportToWkt())
    except CrsError:
        return None
    code = crs.to_epsg()
    return pyproj.CRS.from_epsg(code) if code else crs, (left, top), (dx, -dy)


def _difference(
    corner: tuple[float, float],
    pixel: tuple[float, float],
    own_corner: tuple[float, float],
    own_pixel: tuple[float, float],
    size: tuple[int, int],
) -> float:
    """Return by how many pixels two placements of an image differ at its first and its last corner at most."""
    signs, worst = (1, -1), 0.0
    for axis in (0, 1):
        first = own_corner[axis] - corner[axis]
        last = first + signs[axis] * size[axis] * (own_pixel[axis] - pixel[axis])
        worst = max(worst, abs(first / pixel[axis]), abs(last / pixel[axis]))
    return worst
