"""Images cut out of larger ones: where a crop lies in the image that its model belongs to.

A model belongs to the pixels of the image that it came with. GDAL moves an RPC along when it crops; other programs
leave the RPC as it was and note the place of the crop as a geotransform in pixels (column, 1, 0, row, 0, 1).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from ortho_pipeline.display.notices import Notice
from ortho_pipeline.errors import InputError
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC, Cropped, ImageCorrection, SensorModel

#: Below this part of the size for which an RPC is meant, an image is remarkably small.
_SMALL = 0.5
#: An RPC whose range of pixels begins this near to the image's first pixel (in parts of the range) is of the whole.
_AT_THE_START = 0.05


def checked(offset: Sequence[float]) -> tuple[float, float]:
    """Return an offset of two finite numbers.

    Raises
    ------
    InputError
        If it is anything else.
    """
    if len(offset) != 2 or not all(math.isfinite(value) for value in offset):
        raise InputError(
            f"{', '.join(f'{value:g}' for value in offset)} is not the place of a crop", field="scene.crop_offset",
            remedy="give the column and row of its first pixel in the whole image: COL,ROW",
        )  # fmt: skip
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
    """
    if offset is not None:
        place = checked(offset)
        text = f"the image is taken for a crop whose first pixel is {_text(place)} of the whole"
        return _moved(scene, place, Notice("crop-stated", text, offset=place))
    noted = noted_offset(dataset)
    if noted is not None and _is_of_the_whole(scene, noted):
        text = (
            f"the image notes that it is a crop whose first pixel is {_text(noted)} of the whole, and so the model was "
            "moved; if it is not, give `scene.crop_offset=0,0`"
        )
        return _moved(scene, noted, Notice("crop-noted", text, offset=noted))
    remark = _elsewhere(scene) or (None if noted is not None else _small(scene))
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


def _moved(scene: Scene, offset: tuple[float, float], said: Notice) -> Scene:
    column, row = offset
    if offset == (0.0, 0.0):
        return scene
    found = replace(
        scene,
        models={name: moved(model, offset) for name, model in scene.models.items()},
        pieces=tuple(
            replace(piece, offset=(piece.offset[0] - column, piece.offset[1] - row)) for piece in scene.pieces
        ),
        facts={**scene.facts, "crop_offset": [column, row]},
    )
    remark = _elsewhere(found)
    return replace(found, warnings=(*scene.warnings, said, *([] if remark is None else [remark])))


def _ranges(model: SensorModel) -> list[tuple[float, float]] | None:
    """Return the first and last column and row for which an RPC is meant."""
    if not isinstance(model, RPC):
        return None
    sides = ((model.col_off, model.col_scale), (model.row_off, model.row_scale))
    return [(off - abs(scale), off + abs(scale)) for off, scale in sides]


def _is_of_the_whole(scene: Scene, offset: tuple[float, float]) -> bool:
    """Tell whether a noted offset is still to be applied: GDAL keeps the note, but moves the RPC along."""
    ranges = _ranges(scene.model)
    if ranges is None:
        return True
    # An RPC begins at the first pixel of its image: of the whole, or as far before that of the crop as that lies in it.
    whole = math.hypot(*(first for first, _ in ranges))
    along = math.hypot(*(first + place for (first, _), place in zip(ranges, offset, strict=True)))
    return whole <= along


def _elsewhere(scene: Scene) -> Notice | None:
    """Return a warning where the RPC is meant for pixels none of which are in the image."""
    ranges = _ranges(scene.model)
    size = scene.width, scene.height
    if ranges is None or all(first <= side and last >= 0 for (first, last), side in zip(ranges, size, strict=True)):
        return None
    (left, right), (top, bottom) = ranges
    text = (
        f"the RPC is for columns {left:.0f} to {right:.0f} and rows {top:.0f} to {bottom:.0f}, which does not meet "
        f"this image of {scene.width} x {scene.height} pixels: is it a crop with the RPC of the whole? Say where "
        "it lies with `scene.crop_offset=COL,ROW`"
    )
    return Notice("rpc-elsewhere", text, columns=[left, right], rows=[top, bottom])


def _small(scene: Scene) -> Notice | None:
    """Return a notice where the image is much smaller than what its RPC is meant for, and may be a crop of that."""
    ranges = _ranges(scene.model)
    if ranges is None:
        return None
    sizes = [last - first for first, last in ranges]
    begins = all(abs(first) <= _AT_THE_START * size for (first, _), size in zip(ranges, sizes, strict=True))
    small = scene.width < _SMALL * sizes[0] or scene.height < _SMALL * sizes[1]
    if not (begins and small):
        return None
    text = (
        f"the image has {scene.width} x {scene.height} pixels, its RPC is for about {sizes[0]:.0f} x {sizes[1]:.0f}: "
        "if it was cut out of that image, the RPC is right for it only if both begin at the same corner; say where it "
        "lies with `scene.crop_offset=COL,ROW`"
    )
    return Notice("maybe-a-crop", text, rpc_size=sizes)


def _text(offset: tuple[float, float]) -> str:
    return f"column {offset[0]:g}, row {offset[1]:g}"
