"""Images that DIMAP metadata put together: the tiles of a scene, and the panchromatic and colour images of a bundle."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from ortho_pipeline.plugin import InputError, Listing, Piece, SensorModel, listing, place, read_rpc_text, relative_scale
from ortho_rpc.dimap import images_of, tile_of
from ortho_rpc.dimap_file import DimapFile

DIMAP = re.compile(r"(DIM|PHRDIMAP)[\w.-]*\.XML", re.IGNORECASE)
#: Limits on the folders of one delivery, and on metadata files in each.
_MOST = 20
#: Bands whose pixels differ by less are registered in one image.
_SAME_SCALE = 0.05
_SOURCES = "Dataset_Sources/Source_Identification"
_SPECTRAL = "Processing_Information/Product_Settings/SPECTRAL_PROCESSING"


def rpc_of_dimap(path: Path) -> Path | None:
    """Return the RPC file of DIMAP metadata that were named instead of an image; None without."""
    if not DIMAP.match(path.name):
        return None
    wanted = re.sub(r"(?i)^(PHR)?DIM(AP)?", "RPC", path.name).lower()
    return next((path.parent / name for name in _names(path.parent).named(wanted)), None)


def pieces_beside(image: Path, model: SensorModel) -> tuple[Piece, ...]:
    """Return the other tiles of an image's scene, in its pixels, and the images of other bands of the same strip.

    `image` may also be the metadata, which stand for all tiles together.
    """
    if not _names(image.parent).matching(DIMAP):
        return ()
    beside = _files(image.parent)
    for path in _metadata(beside):
        try:
            file = DimapFile(path)
            if path.name == image.name or image.name.lower() in images_of(file):
                return (*_tiles(file, image.name, beside), *_other_bands(file, model))
        except InputError:
            continue
    return ()


def _tiles(file: DimapFile, image: str, beside: dict[str, Path]) -> Iterator[Piece]:
    own = (0, 0) if image == file.path.name else tile_of(file, image)
    for name in images_of(file) if own is not None else ():
        if name not in beside or name == image.lower() or own is None:
            continue
        if (tile := tile_of(file, name)) is not None:
            yield Piece(beside[name], (tile[0] - own[0], tile[1] - own[1]), (tile[2], tile[3]))
        else:
            yield Piece(beside[name])  # the only image of the metadata


def _other_bands(file: DimapFile, model: SensorModel) -> Iterator[Piece]:
    """Yield the images of the same strip in other bands, each with its RPC.

    They are in the same folder or, as delivered, in folders ``IMG_...`` next to each other.
    """
    strip, bands = _strip(file), file.said(_SPECTRAL)
    folder = place(file.path).parent.absolute()  # a folder that is entered has no name of its own
    near = [folder]
    if folder.name.upper().startswith("IMG_"):
        others = (folder.parent / name for name in _names(folder.parent).beginning("IMG_") if name != folder.name)
        near += [other for other in islice(others, _MOST) if other.is_dir()]
    for beside in (_files(other) for other in near) if strip and bands else ():
        for path in _metadata(beside):
            try:
                other, rpc_file = DimapFile(path), rpc_of_dimap(path)
                if rpc_file is None or _strip(other) != strip or other.said(_SPECTRAL) in (None, bands):
                    continue
                yield from _of_bands(other, beside, rpc_file, model)
            except InputError:
                continue


def _of_bands(file: DimapFile, beside: dict[str, Path], rpc_file: Path, model: SensorModel) -> Iterator[Piece]:
    rpc = read_rpc_text(rpc_file)
    size = tuple(file.integer(f"Raster_Data/Raster_Dimensions/{name}") for name in ("NCOLS", "NROWS"))
    scale = relative_scale(model, rpc, (size[0], size[1]))
    if scale is None or abs(scale - 1) < _SAME_SCALE:
        return
    for name in images_of(file):
        left, top, width, height = tile_of(file, name) or (0, 0, *size)
        if name in beside:
            yield Piece(beside[name], size=(width, height), model=rpc.shifted(left, top), scale=scale)


def _strip(file: DimapFile) -> str | None:
    """Return the name of the strip of an image."""
    strips = (
        source for source in file.all(_SOURCES) if (source.findtext("SOURCE_TYPE") or "").strip() == "Strip_Source"
    )
    return next(((source.findtext("SOURCE_ID") or "").strip() or None for source in strips), None)


def _metadata(beside: dict[str, Path]) -> list[Path]:
    return [path for path in beside.values() if DIMAP.match(path.name)][:_MOST]


def _files(folder: Path) -> dict[str, Path]:
    """Return the files of a folder by their names in lower case; none if it cannot be read."""
    return {name.lower(): folder / name for name in _names(folder).names}


def _names(folder: Path) -> Listing:
    try:
        return listing(folder)
    except (OSError, ValueError):
        return Listing(())
