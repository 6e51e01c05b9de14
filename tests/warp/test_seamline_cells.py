"""Seam lines by hand: the cells of layers, what is near a seam, differences in steps, flooding, things in one piece."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from layers_in_memory import UTM, Pixels, grid, layer
from osgeo import gdal
from scipy.spatial import cKDTree

from ortho_pipeline.errors import InputError
from ortho_pipeline.warp.mosaic import seamlines
from ortho_pipeline.warp.mosaic.balance import Balance
from ortho_pipeline.warp.mosaic.layout import Mosaic, Ortho, lay_out
from ortho_pipeline.warp.mosaic.reading import Opened
from ortho_pipeline.warp.mosaic.seamlines import Owners, _Cells, _mend_cut_things, _without_holes, owners_of


def two_layers(folder: Path | None = None) -> list[Opened]:
    """Return layers of two bands on a mosaic of 20 x 11 pixels, with invalid pixels in one band or in both."""
    random, layers = np.random.default_rng(5), []
    for number, (left, top, width, height) in enumerate([(1, 0, 14, 10), (7, 2, 13, 9)]):
        pixels = Pixels(random.uniform(10, 90, (2, height, width)), np.ones((2, height, width), dtype=bool))
        pixels.valid[1, 4, 3 + number] = pixels.valid[0, 1, 5 - number] = False
        accuracy = None if folder is None else folder / f"{number}.tif"
        if accuracy is not None:
            _write_errors(accuracy, random.uniform(1, 9, (-(-height // 3), -(-width // 2))))
        layers.append(layer(left, top, pixels, accuracy))
    return layers


def _write_errors(path: Path, errors: np.ndarray) -> None:
    """Write a raster of accuracy with a pixel for 2 columns and 3 rows of the ortho."""
    dataset = gdal.GetDriverByName("GTiff").Create(str(path), *errors.shape[::-1], 1, gdal.GDT_Float32)
    dataset.SetProjection(UTM.to_wkt())
    dataset.SetGeoTransform((5e5, 2.0, 0.0, 5e6, 0.0, -3.0))
    dataset.WriteArray(errors)


def pixels_of(opened: Opened) -> tuple[np.ndarray, np.ndarray]:
    """Return values and validity of a layer on all of the mosaic, whose pixels outside of the layer are not valid."""
    box, source = opened.layer, opened.source
    values, valid = np.zeros((2, 11, 20)), np.zeros((11, 20), dtype=bool)
    place = (slice(box.top, box.top + box.grid.height), slice(box.left, box.left + box.grid.width))
    values[(slice(None), *place)], valid[place] = source.values, source.valid.all(axis=0)  # type: ignore[attr-defined]
    return values, valid


#: Rows and columns of the cells of 3 x 3 pixels; the last ones are smaller.
PARTS = [[(slice(j, min(j + 3, 11)), slice(i, min(i + 3, 20))) for i in range(0, 20, 3)] for j in range(0, 11, 3)]


def test_cells_hold_least_and_greatest_mean_of_the_layers_that_fill_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """220 pixels in at most 44 cells: cells of 3 x 3, read in windows of 6 x 6."""
    monkeypatch.setattr(seamlines, "_CELLS", 44)
    monkeypatch.setattr(seamlines, "_WINDOW", 7)
    opened = two_layers()
    placed = Mosaic(grid(20, 11), tuple(one.layer for one in opened))
    balance = Balance(
        np.array([[1.5, 0.8], [0.7, 1.1]]), np.array([[3.0, -4.0], [5.0, 6.0]]), np.zeros(2), np.zeros(2), 0, 0.0
    )
    cells = _Cells(placed, 2)
    for number, one in enumerate(opened):
        cells.add(number, one, balance)
    assert cells.cell == 3
    assert cells.top.shape == (4, 7)
    all_filled = [np.zeros((4, 7), dtype=bool) for _ in opened]
    for j, i in np.ndindex(4, 7):
        means = []
        for number, one in enumerate(opened):
            values, valid = pixels_of(one)
            if valid[PARTS[j][i]].all():
                mean = values[(slice(None), *PARTS[j][i])].mean(axis=(1, 2))
                means.append(mean * balance.gains[number] + balance.offsets[number])
                all_filled[number][j, i] = True
        assert cells.count[j, i] == len(means)
        assert cells.top[j, i] == next((k for k in (0, 1) if all_filled[k][j, i]), -1)
        if means:
            np.testing.assert_allclose(cells.low[:, j, i], np.min(means, axis=0), rtol=1e-6)
            np.testing.assert_allclose(cells.high[:, j, i], np.max(means, axis=0), rtol=1e-6)
    assert set(cells.count.ravel().tolist()) == {0, 1, 2}
    assert [place for place, _ in cells.filled] == [(slice(0, 4), slice(0, 5)), (slice(0, 4), slice(2, 7))]
    for (place, filled), wanted in zip(cells.filled, all_filled, strict=True):
        np.testing.assert_array_equal(filled, wanted[place])
        assert wanted.sum() == filled.sum() > 4


@pytest.mark.parametrize("window", [7, 1024])
def test_the_most_accurate_layer_of_a_cell_has_the_smallest_mean_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, window: int
) -> None:
    monkeypatch.setattr(seamlines, "_CELLS", 44)
    monkeypatch.setattr(seamlines, "_WINDOW", window)
    opened = two_layers(tmp_path)
    cells = _Cells(Mosaic(grid(20, 11), tuple(one.layer for one in opened), by_pixel=True), 2)
    for number, one in enumerate(opened):
        cells.add(number, one, None)
    seen = set()
    for j, i in np.ndindex(4, 7):
        errors = []
        for one in opened:
            raster = gdal.Open(str(one.layer.ortho.accuracy)).ReadAsArray()
            rows, columns = (np.arange(20)[part] for part in PARTS[j][i])
            if pixels_of(one)[1][PARTS[j][i]].all():
                own = np.ix_((rows - one.layer.top) // 3, (columns - one.layer.left) // 2)
                errors.append(float(raster[own].mean()))
            else:
                errors.append(math.inf)
        best = min(errors)
        assert cells.top[j, i] == (-1 if best == math.inf else errors.index(best))
        assert cells.best[j, i] == pytest.approx(best, rel=1e-6)
        seen.add((int(cells.top[j, i]), int(cells.count[j, i])))
    assert {(0, 2), (1, 2)} <= seen


def test_the_first_of_equally_accurate_layers_is_on_top(tmp_path: Path) -> None:
    opened = []
    for number in range(2):
        _write_errors(tmp_path / f"{number}.tif", np.full((2, 3), 2.5))
        pixels = Pixels(np.ones((1, 6, 6)), np.ones((1, 6, 6), dtype=bool))
        opened.append(layer(0, 0, pixels, tmp_path / f"{number}.tif"))
    cells = _Cells(Mosaic(grid(6, 6), tuple(one.layer for one in opened), by_pixel=True), 1)
    for number, one in enumerate(opened):
        cells.add(number, one, None)
    assert (cells.top == 0).all()
    assert (cells.count == 2).all()


def test_cells_of_one_pixel_have_its_value() -> None:
    pixels = Pixels(np.array([[[7.0, 12.0], [30.0, 5.0]]]), np.ones((1, 2, 2), dtype=bool))
    one = layer(0, 0, pixels)
    cells = _Cells(Mosaic(grid(2, 2), (one.layer,)), 1)
    cells.add(0, one, Balance(np.full((1, 1), 2.0), np.full((1, 1), 3.0), np.zeros(1), np.zeros(1), 0, 0.0))
    assert cells.cell == 1
    np.testing.assert_array_equal(cells.low, 2 * pixels.values + 3)


def test_indices_of_a_palette_have_owners_without_seam_lines(tmp_path: Path) -> None:
    dataset = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "a.tif"), 4, 3, 1, gdal.GDT_Byte)
    dataset.SetProjection(UTM.to_wkt())
    dataset.SetGeoTransform((5e5, 2.0, 0.0, 5e6, 0.0, -2.0))
    palette = gdal.ColorTable()
    palette.SetColorEntry(0, (10, 20, 30, 255))
    dataset.GetRasterBand(1).SetColorTable(palette)
    del dataset
    placed = lay_out([Ortho("a", tmp_path / "a.tif")])
    assert (owners_of(placed, None, seamlines=False).owners == 0).all()
    with pytest.raises(InputError, match="palette"):
        owners_of(placed, None, seamlines=True)


def test_pixels_have_the_owner_of_their_cell() -> None:
    owners = Owners(3, np.zeros((3, 4), np.int16), np.arange(12, dtype=np.int16).reshape(3, 4))
    np.testing.assert_array_equal(owners.window(4, 2, 5, 3), [[1, 1, 2, 2, 2], [5, 5, 6, 6, 6], [5, 5, 6, 6, 6]])


def test_holes_below_the_area_are_filled_unless_they_touch_the_rim() -> None:
    mask = np.ones((12, 14), dtype=bool)
    holes = {"small": (slice(2, 4), slice(2, 4)), "of the area": (slice(2, 3), slice(7, 12))}
    rims = [(0, 3), (11, 5), (6, 0), (9, 13)]
    for hole in holes.values():
        mask[hole] = False
    for place in rims:
        mask[place] = False
    expected = mask.copy()
    expected[holes["small"]] = True
    np.testing.assert_array_equal(_without_holes(mask, 5), expected)
    expected[holes["of the area"]] = True
    np.testing.assert_array_equal(_without_holes(mask, 6), expected)


def made(top: np.ndarray, places: list[tuple[slice, slice]], cell: int = 1) -> Any:
    """Return cells with what is on top of them, each filled by the layers of the places that it is in."""
    cells = _Cells(SimpleNamespace(grid=grid(top.shape[1], top.shape[0])), 1)  # type: ignore[arg-type]
    cells.cell, cells.top = cell, top.astype(np.int16)
    for place in places:
        cells.count[place] += 1
        cells.filled.append((place, np.ones_like(top[place], dtype=bool)))
    return cells


@pytest.mark.parametrize(("cell", "reach"), [(1, 5), (2, 3)])
def test_cells_are_near_a_seam_up_to_the_reach_but_not_around_small_holes(
    monkeypatch: pytest.MonkeyPatch, cell: int, reach: int
) -> None:
    """Layer 0 is left of layer 1 and around two holes, which show layer 1; layer 2 is a corner; no layer fills a gap.

    A hole of as many cells as the square of twice the reach is not small.
    """
    monkeypatch.setattr(seamlines, "_REACH", 5)
    monkeypatch.setattr(seamlines, "_REACH_CELLS", 3)
    top = np.zeros((70, 60), dtype=int)
    top[:, 45:], top[:3, :4] = 1, 2
    small, large = (slice(12, 18), slice(8, 12)), (slice(30, 30 + 2 * reach), slice(14, 14 + 2 * reach))
    top[small] = top[large] = 1
    top[55:70, 10:30] = -1
    cells = made(top, [(slice(0, 70), slice(0, 45)), (slice(0, 70), slice(5, 60)), (slice(0, 3), slice(0, 4))], cell)
    places = np.argwhere(np.ones(top.shape))
    expected = np.zeros(top.shape, dtype=bool)
    for number in range(3):
        seam = (top >= 0) & (top != number)
        if number == 0:
            seam[small] = False
        apart, _ = cKDTree(np.argwhere(seam)).query(places)
        expected |= (top == number) & (apart.reshape(top.shape) <= reach)
    np.testing.assert_array_equal(cells._near_seams(), expected)
    assert not expected[11, 8]
    assert expected[29, 15]


def test_levels_are_half_octaves_over_a_quarter_of_the_usual_difference() -> None:
    random = np.random.default_rng(9)
    cells = made(np.zeros((9, 30)), [(slice(0, 9), slice(0, 30)), (slice(0, 7), slice(2, 30)), (slice(0, 3),) * 2])
    cells.count[8, :3] = 0
    both = cells.count > 1
    cells.low = random.uniform(10, 20, (2, 9, 30)).astype(np.float32)
    rise = random.uniform(0.5, 1, (2, 9, 30)) * [0.05 * 2 ** (np.arange(30) / 3)] * [[[1.0]], [[40.0]]]
    cells.high = (cells.low + np.where(both, rise, 0)).astype(np.float32)
    cells.high[0, 0, 4] = cells.low[0, 0, 4]
    cells.low[:, cells.count == 0], cells.high[:, cells.count == 0] = np.inf, -np.inf
    found = cells._levels()
    difference = np.where(both, np.where(both, cells.high, 0) - np.where(both, cells.low, 0), 0.0)
    usual = [np.median(band[band > 0]) for band in difference]
    ratio = np.maximum(*(band / most for band, most in zip(difference, usual, strict=True)))
    for j, i in np.ndindex(9, 30):
        wide = ratio[max(0, j - 2) : j + 3, max(0, i - 2) : i + 3].max()
        assert found[j, i] == max(0, round(2 * math.log2(max(wide, 1e-9) / 0.25)))
    assert len(np.unique(found)) > 6
    cells.high = cells.low.copy()
    assert (cells._levels() == 0).all()


def moved(top: list[int], layers: list[tuple[int, int]], level: list[int]) -> list[int]:
    """Return the owners of one row of cells by what is on top, the ends of the layers, and how much orthos differ."""
    cells = made(np.array([top]), [(slice(0, 1), slice(*ends)) for ends in layers])
    cells._levels = lambda: np.array([level], dtype=np.int16)
    return list(cells.moved()[0])


def test_a_seam_moves_to_where_orthos_differ_least() -> None:
    ordered = [0] * 10 + [1] * 4
    found = moved(ordered, [(0, 10), (4, 14)], [9, 9, 9, 9, 7, 3, 6, 1, 6, 8, 9, 9, 9, 9])
    assert found[:7] + found[8:] == [0] * 7 + [1] * 6
    # Where all is alike, it is in the middle between what only one of them shows.
    assert moved(ordered, [(0, 10), (4, 14)], [4] * 14) == [0] * 7 + [1] * 7


def test_no_layer_has_a_cell_that_it_does_not_fill() -> None:
    """From the left layer 2 is flooded into cells of 0 and 1, and from the right layer 1."""
    assert moved([2, 2, 0, 0, 0, 0, 1, 1], [(2, 6), (2, 8), (0, 2)], [3] * 8) == [2, 2, 0, 0, 1, 1, 1, 1]


def test_layers_are_not_flooded_across_a_gap() -> None:
    cells = made(np.array([[1, 1, 0, 0, -1, 0, 0]]), [(slice(0, 1), slice(2, 7)), (slice(0, 1), slice(0, 7))])
    cells.count[0, 4] = 0
    for _, filled in cells.filled:
        filled[0, -3] = False
    cells._levels = lambda: np.array([[2, 2, 2, 2, 2, 2, 2]], dtype=np.int16)
    assert list(cells.moved()[0]) == [1, 1, 1, 1, -1, 0, 0]


def mended(labels: list[list[int]], markers: list[list[int]], level: list[list[int]]) -> list[list[int]]:
    found = np.array(labels, dtype=np.int32)
    _mend_cut_things(found, np.array(markers, dtype=np.int32), np.array(level, dtype=np.int16))
    return [[int(value) for value in row] for row in found]


def test_a_cut_thing_is_given_to_the_ortho_that_has_most_of_it() -> None:
    labels = [[1, 1, 1, 2, 2, 2], [1, 1, 2, 2, 2, 2], [1, 1, 1, 2, 2, 2]]
    nothing = [[0] * 6] * 3
    level = [[0, 0, 0, 0, 0, 0], [0, 3, 3, 3, 0, 0], [0, 0, 0, 0, 0, 0]]
    assert mended(labels, nothing, level) == [labels[0], [1, 2, 2, 2, 2, 2], labels[2]]
    # Of equal parts the ortho on top has all.
    level = [[0, 0, 0, 0, 0, 0], [3, 3, 3, 3, 0, 0], [0, 0, 0, 0, 0, 0]]
    assert mended(labels, nothing, level) == [labels[0], [1, 1, 1, 1, 2, 2], labels[2]]


def test_of_two_things_each_is_given_by_its_own_parts() -> None:
    labels = [[1, 2, 2, 0, 3, 3, 2, 0, 2, 1]]
    assert mended(labels, [[0] * 10], [[1, 1, 1, 0, 2, 2, 2, 0, 0, 0]]) == [[2, 2, 2, 0, 3, 3, 3, 0, 2, 1]]


@pytest.mark.parametrize("turned", range(4))
def test_a_thing_that_joins_two_orthos_stays_cut(turned: int) -> None:
    """It touches what only the first shows on one side, and what only the second shows on the other or at an angle."""
    labels, level = np.array([[0, 0, 0, 0], [1, 1, 2, 2], [0, 0, 2, 0]]), np.array([[0] * 4, [0, 1, 1, 0], [0] * 4])
    straight, angled = np.array([[0] * 4, [1, 0, 0, 2], [0] * 4]), np.array([[0] * 4, [1, 0, 0, 0], [0, 0, 2, 0]])
    for markers in (straight, angled):
        both = [np.rot90(part, turned) for part in (labels, markers, level)]
        assert mended(*(part.tolist() for part in both)) == both[0].tolist()
    for single in (straight % 2, np.where(straight == 2, 2, 0)):
        found = np.array(mended(*(np.rot90(part, turned).tolist() for part in (labels, single, level))))
        expected = labels.copy()
        expected[1, 1:3] = 1
        np.testing.assert_array_equal(found, np.rot90(expected, turned))


def test_what_is_at_the_other_end_of_the_mosaic_is_no_neighbour() -> None:
    labels = [[1, 2, 0, 0, 2]]
    assert mended(labels, [[0, 0, 0, 0, 2]], [[5, 5, 0, 0, 0]]) == [[1, 1, 0, 0, 2]]
    # Ortho 1 would touch the thing only around the ends of the row; ortho 2 is next to it.
    assert mended([[1, 2, 2, 2, 1]], [[0, 0, 0, 2, 1]], [[5, 5, 5, 0, 0]]) == [[2, 2, 2, 2, 1]]


def test_the_core_of_a_thing_that_has_to_be_cut_is_in_one_piece() -> None:
    """All of the row joins both orthos and stays cut; what differs more in the middle is an island."""
    labels, markers = [[1, 1, 1, 2, 2, 2, 2]], [[1, 0, 0, 0, 0, 0, 2]]
    assert mended(labels, markers, [[0, 1, 4, 4, 4, 1, 0]]) == [[1, 1, 2, 2, 2, 2, 2]]
    assert mended(labels, markers, [[0, 4, 4, 4, 4, 4, 0]]) == labels
