"""Which items of a collection show the same ground, so that one hides the other."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from ortho_pipeline.surface.cells.collected import _same_ground
from ortho_pipeline.surface.dem_mosaic import Part, ResolutionLayer


def layer(*boxes: tuple[str, int, int, int, int], first: int = 0, step: int = 1) -> ResolutionLayer:
    """Return a layer with parts (name, column, row, columns, rows)."""
    parts: list[Any] = [
        Part(SimpleNamespace(path=f"{name}.tif"), column, row, (rows, columns))
        for name, column, row, columns, rows in boxes
    ]
    return ResolutionLayer(tuple(parts), first, step, 1000)


def hidden(*layers: ResolutionLayer) -> list[str]:
    """Return the ids of the items that are hidden, in capital letters."""
    ids = {part.samples.path: part.samples.path[0].upper() for one in layers for part in one.parts}
    notices = _same_ground(SimpleNamespace(layers=layers), ids)  # type: ignore[arg-type]
    if not notices:
        return []
    (notice,) = notices
    assert notice.code == "dem-items-overlap"
    return list(notice.fields["items"])


@pytest.mark.parametrize(
    ("column", "row", "columns", "rows", "same"),
    [
        # Of 10 columns and 8 rows from (20, 30): half of them and a little more.
        (25, 30, 10, 8, False), (24, 30, 10, 8, True), (15, 30, 10, 8, False), (16, 30, 10, 8, True),
        (20, 34, 10, 8, False), (20, 33, 10, 8, True), (20, 26, 10, 8, False), (20, 27, 10, 8, True),
        # More than half of a smaller item, 3 x 4 samples, at a corner and beside a side.
        (28, 35, 3, 4, False), (27, 35, 3, 4, True), (28, 34, 3, 4, True), (30, 30, 3, 4, False), (17, 30, 3, 4, False),
        (22, 38, 3, 4, False), (22, 26, 3, 4, False),
        # A long one that a wide one crosses: 30 of 60 samples, and 30 of 54.
        (23, 25, 3, 20, False), (23, 25, 3, 12, True), (26, 33, 3, 20, False),
    ],
)  # fmt: skip
def test_items_with_more_than_half_of_the_smaller_one_in_common_show_the_same_ground(
    column: int, row: int, columns: int, rows: int, same: bool
) -> None:
    boxes = ("a", 20, 30, 10, 8), ("b", column, row, columns, rows)
    assert hidden(layer(*boxes)) == (["A"] if same else [])
    # The one that is laid first is hidden.
    assert hidden(layer(*boxes[::-1])) == (["B"] if same else [])


def test_columns_of_coarse_items_are_counted_in_those_of_all() -> None:
    """Columns of three, from the second on; the finer item is laid over it."""
    coarse = layer(("c", 4, 10, 5, 6), first=2, step=3)  # columns 14 to 29
    assert hidden(coarse, layer(("f", 14, 10, 15, 6))) == ["C"]
    assert hidden(coarse, layer(("f", 21, 10, 20, 6))) == ["C"]
    assert hidden(coarse, layer(("f", 22, 10, 20, 6))) == []
    assert hidden(coarse, layer(("f", 29, 10, 15, 6))) == []
    assert hidden(coarse, layer(("f", 0, 10, 21, 6))) == []
    assert hidden(coarse, layer(("f", 0, 10, 22, 6))) == ["C"]


def test_every_hidden_item_is_named_once() -> None:
    boxes = [(name, 3 * k, 0, 10, 10) for k, name in enumerate("abcdefgh")]
    apart = [("x", 100, 0, 10, 10), ("y", 110, 0, 10, 10)]
    assert hidden(layer(*boxes, *apart)) == list("ABCDEFG")
    assert hidden(layer(*apart)) == []
