"""Crops: the position of an image within the larger image to which its model belongs.

A model belongs to the pixels of the image with which it was delivered. GDAL shifts an RPC when it crops. Other programs
leave the RPC unchanged and note the offset of the crop as a geotransform in pixels (column, 1, 0, row, 0, 1).

The numbers of an RPC do not show whether it was shifted, because its range may begin before the first pixel of its
image. So the decision needs evidence: the size of the larger image in the metadata, or a range that excludes one case.
Commands have more evidence (`commands.control.crops`): heights, points, matches. Without evidence, opening fails.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.errors.texts import Setting, Text
from ortho_pipeline.exchange.rpc_files import read_rpc_text, size_of_image
from ortho_pipeline.files.locations import place
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC, Cropped, ImageCorrection, SensorModel
from ortho_pipeline.models.base import Array

#: An image below this part of the size of its RPC's range is suspiciously small, if the range begins so near to it, in
#: parts of the range: ranges of vendors begin and end up to a tenth beyond the image.
_SMALL, _BEGINS = 0.75, 0.1
#: Tolerance at both ends within which an RPC's range covers an image, in parts of the range.
_COVERED = 0.05
#: A hypothesis is right if its distance from the evidence is at most this part of the distance between the two.
_CLOSE = 0.25
#: Offsets that differ by less (px) are the same: GDAL writes them with 15 digits.
_SAME = 1e-6
#: Row and column of a tile, in file names of Airbus and Maxar; their RPC files are for all tiles together.
_TILE, _OF_ALL_TILES = re.compile(r"_R(\d{1,4})C(\d{1,4})(?![A-Z0-9])", re.IGNORECASE | re.ASCII), (".xml", ".rpb")
#: Last row and column of the larger image, in tags of Airbus' products.
_GML_SIZE = re.compile(r"<gml:high>\s*(\d{1,7})\s+(\d{1,7})\s*</gml:high>")


class UndecidedCrop(InputError):
    """A crop notes its offset, but it is unknown whether its RPC was shifted to the crop.

    Parameters
    ----------
    scene : Scene
        With the models as they were read.
    offset : (float, float)
        First pixel of the crop in the larger image, as noted.
    """

    def __init__(self, scene: Scene, offset: tuple[float, float]) -> None:
        self.scene, self.offset = scene, offset
        moved, kept = (Setting("scene.crop_offset", f"{column:g},{row:g}") for column, row in (offset, (0, 0)))
        super().__init__(
            f"this image is a crop that begins at {_text(offset)} of a larger image; its RPC can belong to either",
            file=scene.path,
            field="scene.crop_offset",
            remedy=Text(
                "give ",
                moved,
                " if the RPC belongs to the larger image, or ",
                kept,
                " if it belongs to this crop; control points, a reference, or a DEM of the crop alone also decide this",
            ),
        )
        self.choices = ((moved, "the RPC belongs to the larger image"), (kept, "the RPC belongs to this crop"))

    def __reduce__(self) -> Any:
        # The text crosses the border of a process; the scene need not.
        function, (_, *texts) = super().__reduce__()
        return function, (InputError, *texts)

    @property
    def both(self) -> tuple[Scene, Scene]:
        """The scene as it is, and with its models shifted to the crop."""
        return self.scene, _with_models_moved(self.scene, self.offset)

    def settled(self, moved: bool, why: str) -> Scene:
        """Return the scene as the evidence decides, with a notice."""
        return _settled(self.scene, self.offset, moved, why)


def checked(offset: Sequence[float]) -> tuple[float, float]:
    """Return an offset of two finite numbers.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if len(offset) != 2 or not all(math.isfinite(value) for value in offset):
        raise InputError(
            f"{', '.join(f'{value:g}' for value in offset)} is not the offset of a crop",
            field="scene.crop_offset",
            remedy="give the column and row of its first pixel in the larger image: COL,ROW",
        )
    return float(offset[0]), float(offset[1])


def fits(size: tuple[int, int], larger: tuple[int, int], offset: Sequence[float] | None) -> bool:
    """Return whether an image of `size` is the `larger` one, or with an offset a crop within it."""
    if offset is None:
        return size == larger
    return all(0 <= first <= total - side for first, side, total in zip(checked(offset), size, larger, strict=True))


def noted_offset(dataset: Any) -> tuple[float, float] | None:
    """Return column and row of the first pixel that the geotransform of a `gdal.Dataset` notes; None if it notes none.

    Such a geotransform has steps of one to the right and down, and there is no CRS.
    """
    transform = dataset.GetGeoTransform(can_return_null=True)
    if transform is None or dataset.GetSpatialRef() is not None:
        return None
    column, *steps_x, row, down_x, down_y = transform
    if (*steps_x, down_x, down_y) != (1.0, 0.0, 0.0, 1.0) or (column, row) == (0.0, 0.0):
        return None
    return (column, row) if math.isfinite(column) and math.isfinite(row) else None


def placed(scene: Scene, dataset: Any, offset: Sequence[float] | None = None) -> Scene:
    """Return the scene with models shifted to the image, if that is a crop and the models belong to the larger image.

    Parameters
    ----------
    dataset : gdal.Dataset
        The image; its geotransform may note its offset.
    offset : (float, float), optional
        Column and row of its first pixel in the larger image. Overrides a noted offset.

    Raises
    ------
    InputError
        If the offset is not two finite numbers.
        Also if the image is a tile with the RPC of all tiles together, and its offset is not known.
    UndecidedCrop
        If the image notes an offset, and there is no evidence to which image the RPC belongs.
    """
    if offset is not None:
        stated = checked(offset)
        text = f"the image is a crop that begins at {_text(stated)} of a larger image, as stated"
        return _moved(scene, stated, Notice("crop-stated", text, offset=stated))
    noted = noted_offset(dataset)
    if noted is None:
        _refuse_tile(scene)
        remark = _elsewhere(scene) or _small(scene)
        return scene if remark is None else replace(scene, warnings=(*scene.warnings, remark))
    if not isinstance(scene.model, RPC):
        return _settled(scene, noted, True, "models other than RPCs always belong to the larger image")
    ranges = _ranges(scene.model)
    decided = _by_size(scene, dataset, ranges, noted) or _by_range(scene, ranges, noted)
    if decided is None:
        raise UndecidedCrop(scene, noted)
    if decided[0]:
        return _settled(scene, noted, *decided)
    remark = _elsewhere(scene)
    return scene if remark is None else replace(scene, warnings=(*scene.warnings, remark))


def moved(model: SensorModel, offset: tuple[float, float]) -> SensorModel:
    """Return the model of a crop whose first pixel is `offset` of the image of `model`."""
    if offset == (0.0, 0.0):
        return model
    if isinstance(model, RPC):
        return model.shifted(*offset)
    if isinstance(model, ImageCorrection):
        origin = model.origin[0] - offset[0], model.origin[1] - offset[1]
        return replace(model, model=moved(model.model, offset), origin=origin)
    return Cropped(model, offset)


def nearer(kept: float, moved: float, offset: tuple[float, float]) -> bool | None:
    """Return whether to shift a model, given its distance (px) from the evidence without (`kept`) and with the shift.

    None if the smaller distance is more than a quarter of the offset.
    """
    if not min(kept, moved) <= _CLOSE * math.hypot(*offset):
        return None
    return moved < kept


def _moved(scene: Scene, offset: tuple[float, float], notice: Notice) -> Scene:
    if offset == (0.0, 0.0):
        return scene
    shifted = _with_models_moved(scene, offset)
    remark = _elsewhere(shifted)
    return replace(shifted, warnings=(*scene.warnings, notice, *([] if remark is None else [remark])))


def _with_models_moved(scene: Scene, offset: tuple[float, float]) -> Scene:
    column, row = offset
    return replace(
        scene,
        models={name: moved(model, offset) for name, model in scene.models.items()},
        pieces=tuple(
            replace(piece, offset=(piece.offset[0] - column, piece.offset[1] - row)) for piece in scene.pieces
        ),
        facts={**scene.facts, "crop_offset": [column, row]},
    )


def _settled(scene: Scene, offset: tuple[float, float], is_moved: bool, why: str) -> Scene:
    where = f"this image is a crop that begins at {_text(offset)} of a larger image"
    if is_moved:
        text = Text(
            f"{where}. The model was shifted to the crop ({why}). If it already belongs to the crop, give ",
            Setting("scene.crop_offset", "0,0"),
        )
        return _moved(scene, offset, Notice("crop-noted", text, offset=offset))
    text = Text(
        f"{where}. The model already belongs to the crop ({why}). If it belongs to the larger image, give ",
        Setting("scene.crop_offset", f"{offset[0]:g},{offset[1]:g}"),
    )
    return replace(scene, warnings=(*scene.warnings, Notice("crop-kept", text, offset=offset)))


# -- evidence in the image and its RPC -------------------------------------------------------------------------------


def _by_size(scene: Scene, dataset: Any, ranges: Array, offset: tuple[float, float]) -> tuple[bool, str] | None:
    """Return whether the RPC belongs to the larger image, by the size in the metadata; None if they have no size."""
    size = scene.width, scene.height
    own = size_of_image(place(scene.model_source))
    if own is not None and (own == size or fits(size, own, offset)):
        return own != size, f"the RPC file is for an image of {own[0]} x {own[1]} pixels"
    larger = _size_of_whole(dataset)
    if larger is None or not fits(size, larger, offset):
        return None
    # The middle of the range is the middle of the image, however far the range extends on both sides.
    middle = ranges.mean(axis=1) - np.array(larger) / 2
    decided = nearer(float(np.hypot(*(middle + offset))), float(np.hypot(*middle)), offset)
    return None if decided is None else (decided, f"the larger image has {larger[0]} x {larger[1]} pixels")


def _size_of_whole(dataset: Any) -> tuple[int, int] | None:
    """Return columns and rows of the vendor's image, if the metadata of a crop still have them."""
    described, delivered = dataset.GetMetadata() or {}, dataset.GetMetadata("IMD") or {}
    if match := _GML_SIZE.search(str(described.get("gml.root-instance", ""))[:20_000]):
        return int(match[2]), int(match[1])
    columns, rows = (str(delivered.get(key, "")).strip() for key in ("numColumns", "numRows"))
    return (int(columns), int(rows)) if columns.isdecimal() and rows.isdecimal() else None


def _by_range(scene: Scene, ranges: Array, offset: tuple[float, float]) -> tuple[bool, str] | None:
    """Return whether the RPC belongs to the larger image; None if its range is possible for both.

    The range of an RPC covers its image, and may extend far beyond it. The range of a shifted RPC also covers the part
    of the larger image before the crop. The range of an RPC made for the crop is centred on the crop.
    """
    size, first_of_crop = np.array((scene.width, scene.height)), np.array(offset)
    slack = _COVERED * np.ptp(ranges, axis=1)

    def covers(first: Array, last: Array) -> bool:
        return bool((ranges[:, 0] <= first + slack).all() and (ranges[:, 1] >= last - slack).all())

    evenly = bool((np.abs(ranges.mean(axis=1) - size / 2) <= slack).all())
    of_whole = covers(np.minimum(0.0, first_of_crop), first_of_crop + size)
    of_crop = covers(np.minimum(0.0, -first_of_crop), size) or (covers(np.zeros(2), size) and evenly)
    # A program that shifted the RPC wrote it into the crop; a range that begins elsewhere is no evidence.
    in_the_crop = not place(scene.model_source).is_file()
    if of_crop and of_whole and in_the_crop and (np.abs(ranges[:, 0] + first_of_crop) <= 1.0).all():
        return False, "the range of the RPC begins at the first pixel of the larger image"
    if of_crop == of_whole:
        return None
    return of_whole, f"its range is too small for the {'crop' if of_whole else 'larger image'}"


def _ranges(model: RPC) -> Array:
    """Return the first and last column, and the first and last row, for which an RPC is meant ``(2, 2)``.

    Some programs write new pixel offsets and scales, with coefficients that cancel them. Then the range is the image of
    the ground box of the RPC.
    """
    middle, half = np.array([model.col_off, model.row_off]), np.abs([model.col_scale, model.row_scale])
    stated = np.stack([middle - half, middle + half], axis=1)
    centre, reach = model.domain
    if (np.abs(model.ground_to_image([centre])[0] - middle) <= half).all():
        return stated
    corners = model.ground_to_image([centre + reach * signs for signs in itertools.product((-1, 0, 1), repeat=3)])
    corners = corners[np.isfinite(corners).all(axis=1)]
    return np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1) if len(corners) else stated


def _refuse_tile(scene: Scene) -> None:
    """Refuse a tile whose model is the RPC of all tiles together as it is in the file: its place is not known."""
    source, tile = place(scene.model_source), _TILE.search(place(scene.path).stem)
    if tile is None or int(tile[1]) == int(tile[2]) == 1 or not isinstance(scene.model, RPC):
        return
    if source.suffix.lower() not in _OF_ALL_TILES or tile[0].lower() in source.stem.lower() or not source.is_file():
        return
    whole = read_rpc_text(source)
    if math.hypot(whole.col_off - scene.model.col_off, whole.row_off - scene.model.row_off) < _SAME:
        raise InputError(
            f"by its name this image is the tile {tile[0][1:]}, but {source.name} has the RPC of all tiles together",
            file=scene.path,
            field="scene.crop_offset",
            remedy=Text(
                "copy the metadata that list the tiles (DIM_*.XML, Maxar's .XML) from the delivery next to it, or give"
                " the tile's first pixel in the whole image: ",
                Setting("scene.crop_offset", "COL,ROW"),
            ),
        )


def _elsewhere(scene: Scene) -> Notice | None:
    """Return a warning if the RPC is meant for other ground than that of the image."""
    model, size = scene.model, (scene.width, scene.height)
    if not isinstance(model, RPC):
        return None
    ranges = _ranges(model)
    if all(first <= side and last >= 0 for (first, last), side in zip(ranges, size, strict=True)):
        return None
    (left, right), (top, bottom) = ranges
    text = Text(
        f"the RPC is for columns {left:.0f} to {right:.0f} and rows {top:.0f} to {bottom:.0f}, but this image has "
        f"{scene.width} x {scene.height} pixels. If it is a crop with the RPC of a larger image, give ",
        Setting("scene.crop_offset", "COL,ROW"),
    )
    return Notice("rpc-elsewhere", text, **dict(zip(("columns", "rows"), ranges.tolist(), strict=True)))


def _small(scene: Scene) -> Notice | None:
    """Return a notice if the image is much smaller than the range of its RPC, so it may be a crop."""
    if not isinstance(scene.model, RPC):
        return None
    ranges = _ranges(scene.model)
    sizes = np.ptp(ranges, axis=1).tolist()
    begins = all(abs(first) <= _BEGINS * size for first, size in zip(ranges[:, 0], sizes, strict=True))
    small = scene.width < _SMALL * sizes[0] or scene.height < _SMALL * sizes[1]
    if not (begins and small):
        return None
    text = Text(
        f"the image has {scene.width} x {scene.height} pixels, but its RPC is for about {sizes[0]:.0f} x "
        f"{sizes[1]:.0f}. If it is a crop whose first pixel is not that of the larger image, give ",
        Setting("scene.crop_offset", "COL,ROW"),
    )
    return Notice("maybe-a-crop", text, rpc_size=sizes)


def _text(offset: tuple[float, float]) -> str:
    return f"column {offset[0]:g}, row {offset[1]:g}"
