"""The gate before GDAL: a raster is opened only after every file that it refers to has been checked.

GDAL follows references of headers and sidecars to other files, with any registered driver, and partly while it opens.
So each file is checked before GDAL opens it: its driver (by GDAL's own test, among all drivers), the files that its
header names (read by GDAL's own XML parser), and the sidecars that GDAL uses as rasters. These are checked in the same
way, recursively. A name outside the allowed folders, or a driver that is not on the list, is an error. References that
only GDAL knows (`GetFileList`, overviews in metadata) are checked on the open dataset, before a pixel is read.

`locations.close_network` has the further limits of a command-line process.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from osgeo import gdal

from ortho_pipeline.errors import InputError, completed
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.files.folders import listed_paths, listing
from ortho_pipeline.files.locations import AnyPath, Location, VsiPath, place, within
from ortho_pipeline.files.shell import converted, typed
from ortho_pipeline.geodesy.crs_gate import refuse_files
from ortho_pipeline.raster.opening.drivers import (
    DRIVERS,
    PLAIN,
    REFERRING,
    driver_for,
    identified,
    remove_network_drivers,
    require_driver,
    require_proj_database,
    require_usable_gdal,
    see_to_reading_options,
)
from ortho_pipeline.raster.opening.references import NAMES_OF, Named, crs_texts, products_of_volume, to_one_file
from ortho_pipeline.stores.sidecars import ask_beside

gdal.UseExceptions()

#: Side-cars that GDAL opens as rasters, by their ending after the whole name of an image or after its stem.
_RASTER_SIDE_CAR = re.compile(r"\.(ovr|msk|aux|rrd|r[0-9])$")
#: Sidecars that state the CRS of a raster.
_CRS_SIDE_CARS = (".aux.xml", ".prj", ".hdr")
#: Side-cars with text that GDAL reads while it opens an image.
_TEXT_SIDE_CAR = re.compile(r"\.(rpb|imd|eph|att|geo|tab|wld|\w{1,3}w)|[_.]?rpc\.(txt|xml)|_metadata\.txt")
_MANY = 10_000
_OVERVIEWS = "OVERVIEWS"


def _together(path: Any) -> str:
    """Return the rest of the remedy for a file that refers to files elsewhere."""
    return f", put the files into one folder, or {to_one_file(path)}"


def open_seen(
    path: AnyPath, roots: Sequence[AnyPath], drivers: Sequence[str], siblings: bool
) -> tuple[gdal.Dataset, DecodedUnit]:
    """Open a raster for reading if all files that it refers to are in its own folder or in `roots`.

    Parameters
    ----------
    path : path or VsiPath
        A file, or a folder with a product, as the user named it.
    drivers : sequence of str
        Those of `DRIVERS` that may read it.
    siblings : bool
        Whether GDAL may read sidecar files.

    Returns
    -------
    gdal.Dataset, DecodedUnit
        The raster, and the largest block of it and of all files that it refers to.

    Raises
    ------
    InputError
        If it refers to a file elsewhere, or of another driver. The error names this file and the reference.
    RuntimeError
        If GDAL cannot open the file.
    """
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError as error:
        raise InputError(
            "GDAL cannot open this name, which is not UTF-8", file=path, remedy="rename the file or its folder"
        ) from error
    gdal.UseExceptions()  # other code of the process may have turned them off since the import
    see_to_reading_options()
    remove_network_drivers()
    require_usable_gdal()
    require_proj_database()
    if siblings:
        ask_beside(path, allow_network=True)
    gate = _Gate(path, roots)
    dataset = gate.open(path, drivers, siblings)
    return dataset, gate.block


@dataclass(frozen=True)
class DecodedUnit:
    """The unit that GDAL decodes at once to give one pixel: its `size` in bytes, and the `path` of its file."""

    size: int
    path: str


class _Gate:
    """The checked files of one raster, and the folders in which its files may be."""

    def __init__(self, path: AnyPath, roots: Sequence[AnyPath]) -> None:
        if isinstance(path, VsiPath):
            self._roots: list[AnyPath] = [path.parent]
        else:
            # The sidecars of a link may be next to the link or next to its target.
            here = Path(path)
            folders = [here, here.resolve()] if here.is_dir() else [here.parent, here.resolve().parent]
            self._roots = [folder.resolve() for folder in (*folders, *map(Path, listed_paths(roots)))]
        self._seen: set[str] = set()
        self.block = DecodedUnit(0, os.fspath(path))

    def open(self, path: AnyPath, drivers: Sequence[str], siblings: bool = True) -> gdal.Dataset:
        """Open a file that the user named, with the files that it leads to seen."""
        name = os.fspath(path)
        there = place(name)
        if there.is_dir():
            self._see_folder(there)
            allowed = ["DIMAP"]
            product = self._product_in(there)
            require_driver("DIMAP", there)
            if product is not None:
                name = os.fspath(product)
                self._see_named(product, "DIMAP", frozenset())
        else:
            self._see_texts_beside(there)
            kind = identified(name, drivers)
            if kind is None and not isinstance(there, VsiPath) and (format := driver_for(there)) is not None:
                require_driver(format, there)
            if kind in REFERRING:
                self._see_named(there, kind, frozenset())
            if kind == "DIMAP" and (product := self._product_of(there)) is not None:
                there, name = product, os.fspath(product)
            if siblings:
                self._see_side_cars(there)
            allowed = [kind] if kind in REFERRING else [one for one in drivers if one in PLAIN]
        options: dict[str, Any] = {} if siblings else {"sibling_files": [name.rpartition("/")[2]]}
        dataset = gdal.OpenEx(name, gdal.OF_RASTER | gdal.OF_READONLY, allowed_drivers=allowed, **options)
        self._see_open(dataset, there)
        return dataset

    # -- files that are named or found -------------------------------------------------------------------------------

    def _see(self, path: Any, by: Any, field: str, chain: frozenset[str]) -> None:
        """See to a raster that another file leads to: GDAL opens it with any driver, lazily or at once."""
        key = str(path.resolve())
        if key in chain:
            raise InputError("this VRT refers to itself", file=path, remedy="remove the circular reference")
        if key in self._seen:
            return
        self._seen.add(key)
        if len(self._seen) > _MANY:
            raise InputError(f"this raster refers to more than {_MANY} files", file=by, remedy=to_one_file(by))
        name = str(path)
        self._see_texts_beside(path)
        kind = identified(name, DRIVERS)
        first = None if kind is None else identified(name, None)
        if kind is None or first not in DRIVERS or (kind == "VRT" and isinstance(path, VsiPath)):
            raise InputError(
                f"{path.name!r} is not a raster of an allowed format, but GDAL would open it "
                f"({first or kind or 'with another driver'})",
                file=by,
                field=field,
                remedy=f"remove it, or convert it to GeoTIFF: `gdal_translate {converted(path, 'copy')}`",
            )
        if kind in REFERRING:
            self._see_named(path, kind, chain | {key})
        self._see_side_cars(path)
        allowed = [kind] if kind in REFERRING else list(PLAIN)
        try:
            dataset = gdal.OpenEx(name, gdal.OF_RASTER | gdal.OF_READONLY, allowed_drivers=allowed)
        except (RuntimeError, UnicodeDecodeError) as error:
            # GDAL would go on with its other drivers.
            raise InputError(
                f"{path.name!r} cannot be opened ({str(error).strip().partition(chr(10))[0]})",
                file=by,
                field=field,
                remedy="the file is damaged: copy it again, or remove it",
            ) from error
        self._see_open(dataset, path)

    def _see_folder(self, folder: Any) -> None:
        """See to the product in a folder that the user named."""
        for name in listing(folder).names:
            if re.fullmatch(r"metadata\.dim|vol_.*\.xml", name.lower()):
                self._must_be_inside(folder / name, folder, name)
                self._see_named(folder / name, "DIMAP", frozenset())

    def _product_in(self, folder: Any) -> Any:
        """Return the DIMAP 2 metadata in a folder, which GDAL does not look for; None where it finds its own."""
        names = _product_files(folder)
        volumes = [name for name in names if re.fullmatch(r"vol_.*\.xml", name.lower())]
        if len(volumes) == 1:
            return self._product_of(folder / volumes[0])
        products = [name for name in names if re.fullmatch(r"dim_.*\.xml", name.lower())]
        if len(products) > 1:
            raise InputError(
                f"this folder has several products: {', '.join(sorted(products)[:6])}",
                file=folder,
                remedy="give the DIM_*.XML of one of them, or an image",
            )
        return folder / products[0] if products == names and products else None

    def _product_of(self, volume: Any) -> Any:
        """Return the metadata of the one product of a DIMAP volume; None where the file is no volume."""
        places = [
            next((target for target in self._targets(Named(name, "COMPONENT_PATH"), volume) if target.is_file()), name)
            for name in dict.fromkeys(products_of_volume(volume))
        ]
        if len(places) > 1:
            raise InputError(
                f"this volume has several products: {', '.join(str(place) for place in places[:6])}",
                file=volume,
                field="Dataset_Components",
                remedy="give one of them",
            )
        if places and isinstance(places[0], str):
            raise InputError(
                f"its product {places[0]!r} is missing",
                file=volume,
                field="COMPONENT_PATH",
                remedy="copy the delivery with its folders, or give an image",
            )
        return places[0] if places else None

    def _see_texts_beside(self, path: Any) -> None:
        """Check the texts in sidecars: some drivers read them and pass their CRS to PROJ to identify a file."""
        for other in _beside(path):
            rest = other.lower()
            for start in (path.name.lower(), path.stem.lower()):
                rest = rest.removeprefix(start)
            side_car = path.parent / other
            if _TEXT_SIDE_CAR.fullmatch(rest):
                self._must_be_inside(side_car, path, other)
            elif rest in _CRS_SIDE_CARS:
                self._must_be_inside(side_car, path, other)
                if side_car.is_file():
                    _see_crs(crs_texts(side_car, rest), side_car)

    def _see_side_cars(self, path: Any) -> None:
        """See to what GDAL takes up as overviews and masks because of its name."""
        name, stem = path.name.lower(), path.stem.lower()
        for other in _beside(path):
            lower = other.lower()
            if lower == name:
                continue
            rest = lower.removeprefix(name) if lower.startswith(name) else lower.removeprefix(stem)
            if _RASTER_SIDE_CAR.fullmatch(rest):
                side_car = path.parent / other
                self._must_be_inside(side_car, path, other)
                if identified(str(side_car), None) not in PLAIN:
                    raise InputError(
                        f"the sidecar file {other!r} is not a plain raster",
                        file=path,
                        field=other,
                        remedy=f"remove it, and make new overviews: `gdaladdo -ro {typed(path)}`",
                    )
                # Overviews of an HFA file in .rrd are read by that driver alone, and are not rasters of their own.
                if rest != ".rrd":
                    self._see(side_car, path, other, frozenset())

    def _see_named(self, path: Any, kind: str, chain: frozenset[str]) -> None:
        """See to the files that a header names."""
        chain = chain | {str(path.resolve())}
        _see_crs(crs_texts(path, kind), path)
        for named in NAMES_OF[kind](path):
            for target in self._targets(named, path):
                if kind == "DIMAP" and target.is_file() and named.field == "COMPONENT_PATH":
                    if str(target.resolve()) not in chain:
                        self._see_named(target, "DIMAP", chain)
                elif target.exists() and not named.raw:
                    self._see(target, path, named.field, chain)

    def _targets(self, named: Named, by: Any) -> Iterator[Any]:
        """Yield the paths that a name may mean, all of them inside the allowed folders."""
        # With and without what some drivers strip or turn.
        for name in {named.name, named.name.strip(), named.name.strip().replace("\\", "/")}:
            if not name or name.startswith("/vsi") or re.search(r"[<>{}:\x00-\x1f]", name.strip()):
                self._outside(name, by, named.field, None)
            if isinstance(by, VsiPath):
                # Names in archives and behind URLs are text.
                inside = VsiPath(f"{by.parent}/{name.removeprefix('./')}")
                if not _is_below(inside, self._roots[0]):
                    self._outside(name, by, named.field, None)
                yield inside
                continue
            folders = {by.parent, by.resolve().parent} if named.relative else {Path()}
            # GDAL shortens "..", the system follows links.
            short = {Path(os.path.normpath(folder.absolute() / name)) for folder in folders}
            for target in {folder / name for folder in folders} | short:
                self._must_be_inside(target, by, named.field, name)
                yield target

    def _must_be_inside(self, path: Any, by: Any, field: str, name: str | None = None) -> None:
        if isinstance(path, VsiPath):
            if not _is_below(path, self._roots[0]):
                self._outside(name or str(path), by, field, None)
        elif not within(path, self._roots):
            self._outside(name or str(path), by, field, path.resolve())
        try:
            plain = path.is_file() or not path.exists()
        except OSError as error:
            # Longer than a file system takes, or in a folder that may not be read.
            raise InputError(
                f"{(name or path.name)[:80]!r} is not a usable file name ({error.strerror})",
                file=by,
                field=field,
                remedy="correct the name, or remove it",
            ) from error
        if not plain:
            raise InputError(
                f"{name or path.name!r} is not a file", file=by, field=field, remedy="put a file there, or remove it"
            )

    def _outside(self, name: str, by: Any, field: str, path: Path | None) -> None:
        root = "DIR" if path is None else os.path.commonpath([path.parent, Path(by).resolve().parent])
        raise InputError(
            f"this file refers to {name[:200]!r}, which is outside its own folder",
            file=by,
            field=field,
            remedy=Text("allow a folder that contains both with ", Setting("scene.roots", root), _together(by)),
        )

    # -- what GDAL tells ---------------------------------------------------------------------------------------------

    def _see_open(self, dataset: gdal.Dataset, path: Any) -> None:
        """Check the files that an open dataset will read, before it does."""
        for key, value in (dataset.GetMetadata(_OVERVIEWS) or {}).items():
            if key.upper() == "OVERVIEW_FILE":
                named = Named(str(value).removeprefix(":::BASE:::"), "OVERVIEW_FILE")
                for target in self._targets(named, path):
                    if target.exists():
                        self._see(target, path, named.field, frozenset())
        _see_crs((dataset.GetProjection(), dataset.GetGCPProjection()), path)
        _require_finite(dataset, path)
        kind = dataset.GetDriver().ShortName
        _require_size(dataset, path, kind)
        for name in _listed(dataset):
            file = place(name)
            if str(file) != str(path):
                self._must_be_inside(file, path, kind, name)
        self.block = max(self.block, DecodedUnit(_decoded_at_once(dataset), str(path)), key=lambda block: block.size)


def _require_finite(dataset: gdal.Dataset, path: Any) -> None:
    """Refuse a geotransform that is not finite."""
    transform = dataset.GetGeoTransform(can_return_null=True)
    if transform is not None and not all(map(math.isfinite, transform)):
        raise InputError(
            "the geotransform of this raster is not finite",
            file=path,
            field="geotransform",
            remedy=f"set the right one: `gdal_edit.py -a_ullr WEST NORTH EAST SOUTH {typed(path)}`",
        )


def _require_size(dataset: gdal.Dataset, path: Any, kind: str) -> None:
    """Refuse a truncated file of a format whose missing pixels GDAL reads as zeros, without an error."""
    if isinstance(path, VsiPath) or not path.is_file():
        return
    size, least = path.stat().st_size, _least_size(dataset, path, kind)
    if size < least:
        raise InputError(
            f"the file is truncated: it has {size:,} bytes, but by its header at least {least:,}",
            file=path,
            remedy="copy or download it again",
        )


def _least_size(dataset: gdal.Dataset, path: Any, kind: str) -> int:
    """Return the bytes that a file has at least by its header; 0 if GDAL itself reports that some are missing."""
    if kind == "PCIDSK":
        with open(path, "rb") as file:
            blocks = file.read(32)[16:].strip()
        return 512 * int(blocks) if blocks.isdigit() else 0
    compressed = (dataset.GetMetadata("ENVI") or {}).get("file_compression", "0").strip("0")
    if kind not in ("ENVI", "PCRaster") or compressed:
        return 0
    types = (dataset.GetRasterBand(number + 1).DataType for number in range(dataset.RasterCount))
    pixel = sum(gdal.GetDataTypeSize(one) // 8 for one in types)
    header = 256 if kind == "PCRaster" else 0
    return header + dataset.RasterXSize * dataset.RasterYSize * pixel


def _beside(path: Any) -> list[str]:
    """Return the names next to a file that begin with its own name; behind a URL, those of its existing sidecars."""
    folder = path.parent
    if isinstance(folder, VsiPath) and not (Location(str(folder)).in_archive and folder.is_dir()):
        names = (path.name + ending for ending in (".ovr", ".msk", ".aux", ".aux.xml"))
        return [name for name in names if (folder / name).exists()]
    return listing(folder).beginning(path.stem)


def _see_crs(texts: Iterable[str], path: Any) -> None:
    """Refuse coordinate systems that make PROJ open files, before PROJ reads them."""
    with completed(path):
        for text in texts:
            refuse_files(text)


def _decoded_at_once(dataset: gdal.Dataset) -> int:
    """Return the bytes of the largest block of a raster: all bands if they are interleaved, or its mask."""
    if dataset.RasterCount == 0:
        return 0
    band = dataset.GetRasterBand(1)
    together = dataset.RasterCount if dataset.GetMetadataItem("INTERLEAVE", "IMAGE_STRUCTURE") == "PIXEL" else 1
    pixels = band.XSize * band.YSize if _is_sequential(dataset, band) else math.prod(band.GetBlockSize())
    size = pixels * max(1, gdal.GetDataTypeSize(band.DataType) // 8) * together
    try:
        masked = band.GetMaskFlags() & gdal.GMF_PER_DATASET
        return max(size, math.prod(band.GetMaskBand().GetBlockSize()) if masked else 0)
    except RuntimeError:
        # The reader of the mask reports it to those who need it.
        return size


def _is_sequential(dataset: gdal.Dataset, band: gdal.Band) -> bool:
    """Return whether a row needs all rows before it to be decoded, whatever GDAL states about blocks.

    This applies to PNG, JPEG, and a compressed TIFF with one strip, which GDAL returns row by row.
    """
    kind = dataset.GetDriver().ShortName
    if kind != "GTiff":
        return kind in ("PNG", "JPEG")
    if band.GetBlockSize() != [band.XSize, 1] or dataset.GetMetadataItem("COMPRESSION", "IMAGE_STRUCTURE") is None:
        return False
    first, *others = (band.GetMetadataItem(f"BLOCK_OFFSET_0_{row}", "TIFF") for row in (0, 1, band.YSize - 1))
    return first is not None and others == [None, None]


def _listed(dataset: gdal.Dataset) -> list[str]:
    """Return the files that GDAL knows of a dataset."""
    try:
        return list(dataset.GetFileList() or [])
    except RuntimeError:
        # GDAL reports a sidecar that it cannot read once; the reader of its content reports it again.
        return list(dataset.GetFileList() or [])


def _is_below(path: VsiPath, folder: AnyPath) -> bool:
    """Return whether a path is in a folder, by its text without dots."""
    rest = str(path).removeprefix(f"{os.fspath(folder)}/")
    return rest != str(path) and not {"", ".", ".."} & set(rest.split("/"))


def _product_files(folder: Any) -> list[str]:
    """Return the files in a folder that describe a DIMAP product."""
    names = [name for name in listing(folder).names if re.match(r"(dim_|vol_|metadata\.dim)", name.lower())]
    if not names:
        remedy = f"give the images in it by name ({folder}/*.tif); only the folder of a DIMAP product is an image"
        raise InputError("this is a folder, not an image", file=folder, remedy=remedy)
    return names
