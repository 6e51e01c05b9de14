"""The files of a delivery of Maxar (Vantor): which metadata an image has, and the tiles and parts that belong to it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from ortho_maxar.isd import Isd, Tile, read_isd_pushbroom
from ortho_pipeline.plugin import (
    RPC,
    InputError,
    Notice,
    Piece,
    SensorModel,
    listing,
    place,
    read_bounded,
    relative_scale,
)

_ISD = re.compile(rb"<(\w{1,20}:)?isd[\s>].*?<(\w{1,20}:)?IMD>", re.DOTALL)
#: ``21FEB01005130-P1BS_R1C1-016263048010_01_P001``: time, kind of product, tile, order, part of a strip or of an order.
_PART = re.compile(
    r".*-(?P<kind>[A-Z][0-9A-Z]{3})(_R\d+C\d+)?-(?P<order>\w+)_P(?P<part>\d{3})", re.IGNORECASE | re.ASCII
)
#: Parts whose rates or columns differ by more are two acquisitions.
_SAME_RATE = 1e-4
#: Bands whose pixels differ by less are registered in one image.
_SAME_SCALE = 0.05
_XML = re.compile(r".+\.xml$", re.IGNORECASE | re.DOTALL)


def is_isd(path: Path) -> bool:
    """Return whether a file is ISD XML, from its first bytes."""
    try:
        return bool(_ISD.search(read_bounded(path, 2000)[:2000]))
    except InputError:
        return False


def metadata_of(name: str) -> Path | None:
    """Return the ISD XML of an image: of its own name, or the one that lists it among its tiles; None without."""
    if not name:
        return None
    try:
        image = place(name)
        beside = [image.parent / name for name in listing(image.parent).matching(_XML)]
    except (OSError, ValueError, InputError):
        return None
    own = [path for path in beside if path.stem.lower() == image.stem.lower() and is_isd(path)]
    if own:
        return own[0]
    named = _PART.fullmatch(image.stem)
    for path in beside:
        other = _PART.fullmatch(path.stem)
        # Tiles are named R1C1-, R1C2- ... after their time.
        if named and other and named["part"] == other["part"] and is_isd(path):
            try:
                if any(tile.name.lower() == image.name.lower() for tile in Isd(path).tiles):
                    return path
            except InputError:
                continue
    return None


def tile_of(isd: Isd, image: str) -> Tile | None:
    """Return the tile of a product that an image is, if the product has several."""
    if len(isd.tiles) < 2:
        return None
    return next((tile for tile in isd.tiles if tile.name.lower() == image.lower()), None)


def tiles_beside(isd: Isd, image: Path, own: Tile | None) -> Iterator[Piece]:
    """Yield the other tiles of a product, in the pixels of this one; for the .TIL all tiles, in those of the whole."""
    if own is None and image.suffix.lower() != ".til":
        return
    left, top = (0, 0) if own is None else (own.left, own.top)
    for tile in isd.tiles:
        if tile != own and (there := _file(image, tile.name)) is not None:
            yield Piece(there, (tile.left - left, tile.top - top), (tile.width, tile.height))


def parts_beside(isd: Isd, image: Path, rigorous: bool) -> tuple[list[Piece], list[Notice]]:
    """Return the other parts of the strip in pixels of this one, and warnings about parts that are not used.

    Rows of parts follow each other in time; where they overlap, both have the same ground.
    """
    pieces, notices = [], []
    for path in _other_parts(isd.path):
        try:
            other = Isd(path)
            if any(isd.file.said(tag) != other.file.said(tag) for tag in ("IMD/IMAGE/CATID", "IMD/BANDID")):
                continue
            (start, period), (its, rate) = isd.rows, other.rows
            names = [tile.name for tile in other.tiles] or [f"{path.stem}{image.suffix}"]
            there = _file(image, names[0]) if len(names) == 1 else None
            if there is None or abs(rate / period - 1) > _SAME_RATE or other.size[0] != isd.size[0]:
                continue
            model = read_isd_pushbroom(other) if rigorous else other.rpc
            if model is not None:
                pieces.append(Piece(there, (0.0, round((its - start) / period, 3)), other.size, model))
        except InputError as error:
            text = f"the part {path.name} is not used: {error.message}"
            notices.append(Notice("part-left-out", text, file=path.name))
    return pieces, notices


def colours_beside(isd: Isd, image: Path, model: SensorModel) -> Iterator[Piece]:
    """Yield the images of other bands that were taken with this one, panchromatic for colours or colours for it.

    They are in the same folder or, as delivered, in folders ``..._PAN`` and ``..._MUL`` next to each other.
    """
    for path in _of_other_bands(isd.path):
        try:
            other = Isd(path)
            same = isd.file.said("IMD/IMAGE/CATID") == other.file.said("IMD/IMAGE/CATID") is not None
            if not same or other.band == isd.band or other.rpc is None:
                continue
            scale = relative_scale(model, other.rpc, other.size)
        except InputError:
            continue
        if scale is None or abs(scale - 1) < _SAME_SCALE:
            continue
        several = len(other.tiles) > 1
        for tile in other.tiles if several else (Tile(f"{path.stem}{image.suffix}", 0, 0, *other.size),):
            if (there := _file(path, tile.name)) is not None:
                yield Piece(there, size=(tile.width, tile.height), model=cut(other.rpc, tile), scale=scale)


def cut(rpc: RPC, tile: Tile | None) -> RPC:
    """Return the RPC of a tile, in its own pixels."""
    return rpc if tile is None else rpc.shifted(tile.left, tile.top)


def _of_other_bands(path: Path) -> Iterator[Path]:
    """Yield the ISD XML of an order's part in other bands, by their names."""
    folders = [path.parent.absolute()]  # a folder that is entered has no name of its own
    if match := re.fullmatch(r"(?i)(.*_)(PAN|MUL)", folders[0].name):
        twin = folders[0].with_name(match[1] + ("MUL" if match[2].upper() == "PAN" else "PAN"))
        folders += [twin] if twin.is_dir() else []
    own = _PART.fullmatch(path.stem)
    for one in (folder / name for folder in folders for name in listing(folder).matching(_XML) if own):
        other = _PART.fullmatch(one.stem)
        if own is None or other is None or other["kind"].lower() == own["kind"].lower():
            continue
        if all(other[name].lower() == own[name].lower() for name in ("order", "part")) and is_isd(one):
            yield one


def _other_parts(path: Path) -> Iterator[Path]:
    """Yield the ISD XML of the other parts of one order, by their names."""
    own = _PART.fullmatch(path.stem)
    for one in (path.parent / name for name in listing(path.parent).matching(_XML)) if own else ():
        other = _PART.fullmatch(one.stem)
        if own is None or other is None or other["part"] == own["part"]:
            continue
        if all(other[name].lower() == own[name].lower() for name in ("kind", "order")) and is_isd(one):
            yield one


def _file(image: Path, name: str) -> Path | None:
    """Return the file of this name next to an image, whatever the case of its letters."""
    return next((image.parent / file for file in listing(image.parent).named(name)), None)
