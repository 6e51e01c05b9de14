"""Whose image the RPC of a crop is for, by the range of the RPC and by the size of the larger image."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.exchange.crop import UndecidedCrop, _ranges, placed
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import RPC

#: The crop has 200 x 150 pixels and begins at column 100, row 50 of the larger image.
SIZE, OFFSET = (200, 150), (100.0, 50.0)
Range = tuple[float, float]


def rpc(columns: Range, rows: Range) -> RPC:
    """Return an RPC that is meant for a range of columns and one of rows."""
    one, col, row = np.eye(20)[0], np.zeros(20), np.zeros(20)
    col[[1, 3]], row[[2, 3]] = (0.9, 0.05), (-0.9, 0.02)
    (left, right), (top, bottom) = columns, rows
    middle, half = ((left + right) / 2, (top + bottom) / 2), ((right - left) / 2, (bottom - top) / 2)
    return RPC(*middle, 20.0, -30.0, 500.0, *half, 0.01, 0.0065, 500.0, col, one, row, one)


def scene_of(model: RPC, source: str = "crop.tif") -> Scene:
    return Scene("rpc", "crop.tif", *SIZE, {"rpc": model}, source)


def image(offset: tuple[float, float] | None = OFFSET) -> Any:
    dataset = gdal.GetDriverByName("MEM").Create("", *SIZE)
    if offset is not None:
        dataset.SetGeoTransform((offset[0], 1.0, 0.0, offset[1], 0.0, 1.0))
    return dataset


def decision(scene: Scene, dataset: Any) -> str:
    """Return whether the model was moved to the crop, kept, or neither is certain."""
    try:
        found = placed(scene, dataset)
    except UndecidedCrop:
        return "unknown"
    if found.model is scene.model:
        assert "crop_offset" not in found.facts
        return "kept"
    assert found.facts["crop_offset"] == list(OFFSET)
    ground = scene.model.domain[0][None]
    expected = scene.model.ground_to_image(ground) - OFFSET
    np.testing.assert_allclose(found.model.ground_to_image(ground), expected, atol=1e-9)
    return "moved"


@pytest.fixture
def beside(tmp_path: Path) -> str:
    """Return the name of a file next to the image, which may be of the larger image."""
    path = tmp_path / "crop_RPC.TXT"
    path.touch()
    return str(path)


@pytest.mark.parametrize(
    ("columns", "rows", "expected"),
    [
        # The larger image up to the end of the crop, and five per cent of the range less at each end.
        ((0, 300), (0, 200), "moved"),
        ((0, 286), (0, 200), "moved"), ((0, 285), (0, 200), "unknown"),
        ((14, 300), (0, 200), "moved"), ((15, 300), (0, 200), "unknown"),
        ((0, 300), (0, 191), "moved"), ((0, 300), (0, 190), "unknown"),
        ((0, 300), (9, 200), "moved"), ((0, 300), (10, 200), "unknown"),
        # The larger image in the pixels of the crop, up to the end of the crop.
        ((-100, 200), (-50, 150), "kept"),
        ((-86, 200), (-50, 150), "kept"), ((-85, 200), (-50, 150), "unknown"),
        ((-100, 186), (-50, 150), "kept"), ((-100, 185), (-50, 150), "unknown"),
        ((-100, 200), (-41, 150), "kept"), ((-100, 200), (-40, 150), "unknown"),
        ((-100, 200), (-50, 141), "kept"), ((-100, 200), (-50, 140), "unknown"),
        # A range with the middle of the crop, within five per cent of the range.
        ((0, 200), (0, 150), "kept"), ((-20, 220), (-15, 165), "kept"), ((10, 190), (0, 150), "unknown"),
        ((-9, 231), (-15, 165), "kept"), ((-7, 233), (-15, 165), "unknown"),
        ((-31, 209), (-15, 165), "kept"), ((-33, 207), (-15, 165), "unknown"),
        ((-20, 220), (-7, 173), "kept"), ((-20, 220), (-5, 175), "unknown"),
        ((-20, 220), (-23, 157), "kept"), ((-20, 220), (-25, 155), "unknown"),
        # What one direction leaves open, the other decides.
        ((-100, 300), (0, 200), "moved"), ((-100, 300), (-50, 150), "kept"), ((0, 300), (-50, 200), "moved"),
        ((-100, 200), (-50, 200), "kept"), ((0, 300), (-50, 150), "unknown"),
        # A range for both.
        ((-100, 300), (-50, 200), "unknown"), ((-500, 900), (-500, 900), "unknown"),
    ],
)  # fmt: skip
def test_a_range_that_is_too_small_for_one_image_belongs_to_the_other(
    beside: str, columns: Range, rows: Range, expected: str
) -> None:
    assert decision(scene_of(rpc(columns, rows), beside), image()) == expected


@pytest.mark.parametrize(
    ("first", "expected"),
    [
        ((-100.0, -50.0), "kept"), ((-100.9, -50.9), "kept"), ((-99.1, -49.1), "kept"), ((-101.5, -50.0), "unknown"),
        ((-100.0, -51.5), "unknown"), ((-98.5, -50.0), "unknown"), ((-100.0, -48.5), "unknown"),
    ],
)  # fmt: skip
def test_an_rpc_in_the_crop_that_begins_at_the_larger_image_was_shifted(
    beside: str, first: tuple[float, float], expected: str
) -> None:
    """Within a pixel in both directions; the RPC of another file may begin there by chance."""
    model = rpc((first[0], 320.0), (first[1], 260.0))
    assert decision(scene_of(model), image()) == expected
    assert decision(scene_of(model, beside), image()) == "unknown"


@pytest.mark.parametrize(
    ("middle", "expected"),
    [
        # Of the larger image of 400 x 300 pixels, or shifted by the offset, whose length is 112 px.
        ((200, 150), "moved"), ((100, 100), "kept"), ((227, 150), "moved"), ((200, 177), "moved"),
        ((229, 150), "unknown"), ((200, 179), "unknown"), ((73, 100), "kept"), ((71, 100), "unknown"),
        ((150, 125), "unknown"),
    ],
)  # fmt: skip
def test_the_size_of_the_larger_image_tells_the_middle_of_its_range(
    beside: str, middle: tuple[float, float], expected: str
) -> None:
    """The range is wide enough for both images, so only its middle tells."""
    model = rpc((middle[0] - 900, middle[0] + 900), (middle[1] - 800, middle[1] + 800))
    dataset = image()
    dataset.SetMetadata({"numColumns": "400", "numRows": "300"}, "IMD")
    assert decision(scene_of(model, beside), dataset) == expected
    for tags in ({"numColumns": "400", "numRows": "3e2"}, {"numColumns": "400"}, {"numColumns": "299", "numRows": "9"}):
        dataset.SetMetadata(tags, "IMD")
        assert decision(scene_of(model, beside), dataset) == "unknown"


def renamed(model: RPC, offsets: tuple[float, float], scales: tuple[float, float]) -> RPC:
    """Return the same function of the ground with other pixel offsets and scales."""
    col = (model.col_scale * model.col_num + (model.col_off - offsets[0]) * model.col_den) / scales[0]
    row = (model.row_scale * model.row_num + (model.row_off - offsets[1]) * model.row_den) / scales[1]
    return replace(
        model,
        col_off=offsets[0], row_off=offsets[1], col_scale=scales[0], row_scale=scales[1], col_num=col, row_num=row,
    )  # fmt: skip


def test_the_range_of_an_rpc_is_stated_or_that_of_its_box() -> None:
    """Offsets and scales that have nothing to do with the ground box state no range; signs of scales do not count."""
    model = rpc((-30.0, 370.0), (20.0, 290.0))
    np.testing.assert_allclose(_ranges(model), [[-30, 370], [20, 290]])
    near = renamed(model, (350.0, 250.0), (-190.0, 100.0))
    np.testing.assert_allclose(_ranges(near), [[160, 540], [150, 350]])
    # 0.9 of the half range by longitude or latitude, and 0.05 or 0.02 of it by height.
    own = [[170 - 200 * 0.95, 170 + 200 * 0.95], [155 - 135 * 0.92, 155 + 135 * 0.92]]
    for offsets, scales in (
        ((170.0, 600.0), (200.0, 50.0)),
        ((900.0, 155.0), (50.0, 135.0)),
        ((-9.0, -9.0), (1.0, 1.0)),
    ):
        np.testing.assert_allclose(_ranges(renamed(model, offsets, scales)), own, atol=1e-6)


@pytest.mark.parametrize(
    ("columns", "rows", "codes"),
    [
        ((-400, 0), (0, 150), ()), ((-400, -1), (0, 150), ("rpc-elsewhere",)),
        ((200, 600), (0, 150), ()), ((201, 600), (0, 150), ("rpc-elsewhere",)),
        ((0, 200), (150, 300), ()), ((0, 200), (151, 300), ("rpc-elsewhere",)),
        ((0, 200), (-300, 0), ()), ((0, 200), (-300, -1), ("rpc-elsewhere",)),
        ((0, 266), (0, 200), ()), ((0, 268), (0, 200), ("maybe-a-crop",)), ((0, 266), (0, 202), ("maybe-a-crop",)),
        ((39, 430), (0, 300), ("maybe-a-crop",)), ((40, 430), (0, 300), ()), ((-47, 430), (0, 300), ("maybe-a-crop",)),
        ((-48, 430), (0, 300), ()), ((0, 430), (29, 325), ("maybe-a-crop",)), ((0, 430), (33, 325), ()),
    ],
)  # fmt: skip
def test_an_image_without_an_offset_is_compared_with_the_range(
    columns: Range, rows: Range, codes: tuple[str, ...]
) -> None:
    scene = placed(scene_of(rpc(columns, rows)), image(None))
    assert tuple(notice.code for notice in scene.notices) == codes
    for notice in scene.notices:
        named = {"columns": [*columns], "rows": [*rows]}
        sizes = {"rpc_size": [columns[1] - columns[0], rows[1] - rows[0]]}
        assert notice.fields == (named if notice.code == "rpc-elsewhere" else sizes)
