"""Images cut out of larger ones: where a crop lies in the image that its model belongs to.

A model belongs to the pixels of the image that it came with. GDAL moves an RPC along when it crops; other programs
leave the RPC as it was and note the place of the crop as a geotransform in pixels (column, 1, 0, row, 0, 1).

Which of both was done, the numbers of an RPC do not tell: its range may begin before the first pixel of its image. So
the decision needs evidence: the size of the whole image in the metadata, or a range that excludes one of the two.
Commands have more (`commands.control.crops`): heights, points, matches. Without evidence opening stops.
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
from ortho_pipeline.exchange.rpc_files import size_of_image
from ortho_pipeline.files.locations import place
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC, Cropped, ImageCorrection, SensorModel
from ortho_pipeline.models.base import Array

#: Below this part of the size for which an RPC is meant, an image is remarkably small.
_SMALL = 0.5
#: An RPC's range covers an image if it begins and ends not later and not earlier than so (in parts of the range).
_COVERED = 0.05
#: A hypothesis is right if it leaves at most this part of the distance between the two.
_CLOSE = 0.25
#: The last row and column of the whole image, as Airbus' products name them in the tags of their images.
_GML_SIZE = re.compile(r"<gml:high>\s*(\d{1,7})\s+(\d{1,7})\s*</gml:high>")


class UndecidedCrop(InputError):
    """A crop notes its place, and nothing says whether its RPC has been moved there already.

    Parameters
    ----------
    scene : Scene
        With the models as they were read.
    offset : (float, float)
        The first pixel of the crop in the whole image, as the image notes it.
    """

    def __init__(self, scene: Scene, offset: tuple[float, float]) -> None:
        self.scene, self.offset = scene, offset
        moved, kept = (Setting("scene.crop_offset", f"{column:g},{row:g}") for column, row in (offset, (0, 0)))
        super().__init__(
            f"this image is a crop that begins at {_text(offset)} of a larger image, and nothing shows whether its RPC "
            "belongs to the crop or to the larger image",
            file=scene.path,
            field="scene.crop_offset",
            remedy=Text(
                "give ",
                moved,
                " if the RPC belongs to the larger image, or ",
                kept,
                " if it belongs to this crop; control points, a DEM of the crop alone, or a reference decide it too",
            ),
        )
        self.choices = ((moved, "the RPC belongs to the larger image"), (kept, "the RPC belongs to this crop"))

    def __reduce__(self) -> Any:
        # A scene need not cross the border of a process: what there is to read does.
        function, (_, *told) = super().__reduce__()
        return function, (InputError, *told)

    @property
    def both(self) -> tuple[Scene, Scene]:
        """The scene as it is, and with its models moved to the crop."""
        return self.scene, _with_models_moved(self.scene, self.offset)

    def settled(self, moved: bool, why: str) -> Scene:
        """Return the scene as it is by evidence, with a notice."""
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
            f"{', '.join(f'{value:g}' for value in offset)} is not the place of a crop",
            field="scene.crop_offset",
            remedy="give the column and row of its first pixel in the whole image: COL,ROW",
        )
    return float(offset[0]), float(offset[1])


def fits(size: tuple[int, int], whole: tuple[int, int], offset: Sequence[float] | None) -> bool:
    """Tell whether an image of `size` is the `whole`, or with an offset a crop that lies within it."""
    if offset is None:
        return size == whole
    return all(0 <= first <= total - side for first, side, total in zip(checked(offset), size, whole, strict=True))


def noted_offset(dataset: Any) -> tuple[float, float] | None:
    """Return column and row of the first pixel of a `gdal.Dataset` whose geotransform counts pixels; None if none is.

    Such a geotransform has steps of one to the right and down, and no CRS.
    """
    transform = dataset.GetGeoTransform(can_return_null=True)
    if transform is None or dataset.GetSpatialRef() is not None:
        return None
    column, *steps_x, row, down_x, down_y = transform
    if (*steps_x, down_x, down_y) != (1.0, 0.0, 0.0, 1.0) or (column, row) == (0.0, 0.0):
        return None
    return (column, row) if math.isfinite(column) and math.isfinite(row) else None


def placed(scene: Scene, dataset: Any, offset: Sequence[float] | None = None) -> Scene:
    """Return the scene with models in the pixels of the image, where that is a crop and its models are of the whole.

    Parameters
    ----------
    dataset : gdal.Dataset
        The image, whose geotransform may note its place.
    offset : (float, float), optional
        Column and row of its first pixel in the whole; it counts more than what the image notes.

    Raises
    ------
    InputError
        If the offset is none.
    UndecidedCrop
        If the image notes an offset, and nothing shows whether its RPC is of the whole.
    """
    if offset is not None:
        stated = checked(offset)
        text = f"the image is taken for a crop whose first pixel is {_text(stated)} of the whole"
        return _moved(scene, stated, Notice("crop-stated", text, offset=stated))
    noted = noted_offset(dataset)
    if noted is None:
        remark = _elsewhere(scene) or _small(scene)
        return scene if remark is None else replace(scene, warnings=(*scene.warnings, remark))
    if not isinstance(scene.model, RPC):
        return _settled(scene, noted, True, "other models than RPCs are of the whole image")
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
    """Tell whether a model is to be moved, of its distance (px) from the evidence as it is and if it is moved.

    None where the better of both leaves more than a quarter of the distance between them.
    """
    if not min(kept, moved) <= _CLOSE * math.hypot(*offset):
        return None
    return moved < kept


def _moved(scene: Scene, offset: tuple[float, float], said: Notice) -> Scene:
    if offset == (0.0, 0.0):
        return scene
    found = _with_models_moved(scene, offset)
    remark = _elsewhere(found)
    return replace(found, warnings=(*scene.warnings, said, *([] if remark is None else [remark])))


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
            f"{where}, and its model was moved there ({why}); if it belongs to the crop: ",
            Setting("scene.crop_offset", "0,0"),
        )
        return _moved(scene, offset, Notice("crop-noted", text, offset=offset))
    text = Text(
        f"{where}, and its model belongs to the crop ({why}); if it belongs to the larger image: ",
        Setting("scene.crop_offset", f"{offset[0]:g},{offset[1]:g}"),
    )
    return replace(scene, warnings=(*scene.warnings, Notice("crop-kept", text, offset=offset)))


# -- evidence in the image and its RPC -------------------------------------------------------------------------------


def _by_size(scene: Scene, dataset: Any, ranges: Array, offset: tuple[float, float]) -> tuple[bool, str] | None:
    """Return whether the RPC is of the whole image, of whose size metadata tell; None where they do not."""
    size = scene.width, scene.height
    own = size_of_image(place(scene.model_source))
    if own is not None and (own == size or fits(size, own, offset)):
        return own != size, f"the file of the RPC is of an image of {own[0]} x {own[1]} pixels"
    whole = _size_of_whole(dataset)
    if whole is None or not fits(size, whole, offset):
        return None
    # The middle of the range is that of the image, however far the range reaches beyond it on both sides.
    middle = ranges.mean(axis=1) - np.array(whole) / 2
    decided = nearer(float(np.hypot(*(middle + offset))), float(np.hypot(*middle)), offset)
    return None if decided is None else (decided, f"by the size of the whole, {whole[0]} x {whole[1]} pixels")


def _size_of_whole(dataset: Any) -> tuple[int, int] | None:
    """Return columns and rows of the vendor's image, where the metadata of a crop still tell them."""
    described, delivered = dataset.GetMetadata() or {}, dataset.GetMetadata("IMD") or {}
    if match := _GML_SIZE.search(str(described.get("gml.root-instance", ""))[:20_000]):
        return int(match[2]), int(match[1])
    columns, rows = (str(delivered.get(key, "")).strip() for key in ("numColumns", "numRows"))
    return (int(columns), int(rows)) if columns.isdecimal() and rows.isdecimal() else None


def _by_range(scene: Scene, ranges: Array, offset: tuple[float, float]) -> tuple[bool, str] | None:
    """Return whether the RPC is of the whole image, where its range is possible for one of the two alone.

    The range of an RPC covers its image, and may reach far beyond it. Of one that was moved along it covers what of the
    whole image lies before the crop; of one that was made for the crop it lies evenly about that.
    """
    size, first_of_crop = np.array((scene.width, scene.height)), np.array(offset)
    slack = _COVERED * np.ptp(ranges, axis=1)

    def covers(first: Array, last: Array) -> bool:
        return bool((ranges[:, 0] <= first + slack).all() and (ranges[:, 1] >= last - slack).all())

    evenly = bool((np.abs(ranges.mean(axis=1) - size / 2) <= slack).all())
    of_whole = covers(np.minimum(0.0, first_of_crop), first_of_crop + size)
    of_crop = covers(np.minimum(0.0, -first_of_crop), size) or (covers(np.zeros(2), size) and evenly)
    # A program that moved the RPC wrote it into the crop; a range that begins elsewhere tells nothing of either.
    in_the_crop = not place(scene.model_source).is_file()
    if of_crop and of_whole and in_the_crop and (np.abs(ranges[:, 0] + first_of_crop) <= 1.0).all():
        return False, "the range of the RPC in the crop begins at the first pixel of the larger image"
    if of_crop == of_whole:
        return None
    return of_whole, f"for the {'crop' if of_whole else 'larger image'} its range would be too small"


def _ranges(model: RPC) -> Array:
    """Return the first and last column, and the first and last row, for which an RPC is meant ``(2, 2)``.

    Some programs write new offsets and scales of pixels with coefficients that undo them: then it is the image of the
    ground for which the RPC is meant.
    """
    middle, half = np.array([model.col_off, model.row_off]), np.abs([model.col_scale, model.row_scale])
    stated = np.stack([middle - half, middle + half], axis=1)
    centre, reach = model.domain
    if (np.abs(model.ground_to_image([centre])[0] - middle) <= half).all():
        return stated
    corners = model.ground_to_image([centre + reach * signs for signs in itertools.product((-1, 0, 1), repeat=3)])
    corners = corners[np.isfinite(corners).all(axis=1)]
    return np.stack([corners.min(axis=0), corners.max(axis=0)], axis=1) if len(corners) else stated


def _elsewhere(scene: Scene) -> Notice | None:
    """Return a warning where the RPC is meant for other ground than that of the image."""
    model, size = scene.model, (scene.width, scene.height)
    if not isinstance(model, RPC):
        return None
    ranges = _ranges(model)
    if all(first <= side and last >= 0 for (first, last), side in zip(ranges, size, strict=True)):
        return None
    (left, right), (top, bottom) = ranges
    text = Text(
        f"the RPC is for columns {left:.0f} to {right:.0f} and rows {top:.0f} to {bottom:.0f}, which does not meet "
        f"this image of {scene.width} x {scene.height} pixels: is it a crop with the RPC of the whole? Say where "
        "it lies with ",
        Setting("scene.crop_offset", "COL,ROW"),
    )
    return Notice("rpc-elsewhere", text, **dict(zip(("columns", "rows"), ranges.tolist(), strict=True)))


def _small(scene: Scene) -> Notice | None:
    """Return a notice where the image is much smaller than what its RPC is meant for, and may be a crop of that."""
    if not isinstance(scene.model, RPC):
        return None
    ranges = _ranges(scene.model)
    sizes = np.ptp(ranges, axis=1).tolist()
    begins = all(abs(first) <= _COVERED * size for first, size in zip(ranges[:, 0], sizes, strict=True))
    small = scene.width < _SMALL * sizes[0] or scene.height < _SMALL * sizes[1]
    if not (begins and small):
        return None
    text = Text(
        f"the image has {scene.width} x {scene.height} pixels, its RPC is for about {sizes[0]:.0f} x {sizes[1]:.0f}: "
        "if it was cut out of that image, the RPC is right for it only if both begin at the same corner; say where it "
        "lies with ",
        Setting("scene.crop_offset", "COL,ROW"),
    )
    return Notice("maybe-a-crop", text, rpc_size=sizes)


def _text(offset: tuple[float, float]) -> str:
    return f"column {offset[0]:g}, row {offset[1]:g}"
