"""Where orthos of a mosaic are, which is on top, and the accuracy that decides, on small files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
from osgeo import gdal, osr

from ortho_pipeline.errors import InputError
from ortho_pipeline.warp.mosaic.layout import Ortho, box_of, circular_errors, intersection, lay_out, windows


def ortho(
    path: Path,
    left: float,
    top: float,
    size: tuple[int, int] = (6, 4),
    step: tuple[float, float] = (2.0, 3.0),
    **more: Any,
) -> Ortho:
    """Write an ortho of zeros in UTM 33 with its first corner at 500 000 + left, 5 000 000 + top."""
    dataset = gdal.GetDriverByName("GTiff").Create(
        str(path), *size, more.get("bands", 1), more.get("kind", gdal.GDT_Byte)
    )
    system = osr.SpatialReference()
    system.ImportFromEPSG(more.get("crs", 32633))
    dataset.SetSpatialRef(system)
    dataset.SetGeoTransform((5e5 + left, step[0], 0.0, 5e6 + top, 0.0, -step[1]))
    if "nodata" in more:
        dataset.GetRasterBand(1).SetNoDataValue(more["nodata"])
    for band, pixels in enumerate(more.get("pixels", []), 1):
        dataset.GetRasterBand(band).WriteArray(pixels)
    del dataset
    return Ortho(path.stem, path, more.get("relief"), more.get("accuracy"))


def test_the_grid_holds_all_orthos_and_each_has_its_place(tmp_path: Path) -> None:
    made = lay_out([ortho(tmp_path / "a.tif", 0.0, 0.0), ortho(tmp_path / "b.tif", -4.0, 9.0, (3, 5)),
                    ortho(tmp_path / "c.tif", 8.0, -6.0, (5, 3))], "first-on-top")  # fmt: skip
    assert [layer.ortho.name for layer in made.layers] == ["a", "b", "c"]
    assert [(layer.left, layer.top) for layer in made.layers] == [(2, 3), (0, 0), (6, 5)]
    assert (made.grid.width, made.grid.height) == (11, 8)
    assert (made.grid.left, made.grid.top, made.grid.dx, made.grid.dy) == (5e5 - 4, 5e6 + 9, 2.0, 3.0)
    assert [box_of(layer) for layer in made.layers] == [(2, 3, 8, 7), (0, 0, 3, 5), (6, 5, 11, 8)]
    assert not made.by_pixel


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_orthos_on_both_sides_of_longitude_180_lie_next_to_each_other(tmp_path: Path, order: tuple[int, ...]) -> None:
    """Their mosaic was as wide as the world."""
    degrees = [(179.98, 60.0), (-180.0, 60.0), (-179.98, 60.01)]
    some = [
        ortho(tmp_path / f"{k}.tif", lon - 5e5, lat - 5e6, (20, 10), (0.001, 0.001), crs=4326)
        for k, (lon, lat) in enumerate(degrees)
    ]
    made = lay_out([some[k] for k in order], "first-on-top")
    places = {layer.ortho.name: (layer.left, layer.top) for layer in made.layers}
    assert places == {"0": (0, 10), "1": (20, 10), "2": (40, 0)}
    assert (made.grid.width, made.grid.height, round(made.grid.left, 9)) == (60, 20, 179.98)
    # Orthos all around the world stay between -180 and 180.
    world = [ortho(tmp_path / f"w{k}.tif", lon - 5e5, -5e6, (90, 10), (1.0, 1.0), crs=4326) for k, lon in
             enumerate((-180.0, -90.0, 0.0, 90.0))]  # fmt: skip
    assert (lay_out(world).grid.left, lay_out(world).grid.width) == (-180.0, 360)


def test_the_steepest_view_is_on_top_and_an_unknown_one_is_last(tmp_path: Path) -> None:
    some = [ortho(tmp_path / f"{name}.tif", 0.0, 0.0, relief=relief, accuracy=Path("x.tif"))
            for name, relief in (("a", None), ("b", 0.4), ("c", 0.1), ("d", 0.4))]  # fmt: skip
    assert [layer.ortho.name for layer in lay_out(some).layers] == ["c", "b", "d", "a"]
    assert [layer.ortho.name for layer in lay_out(some, "first-on-top").layers] == ["a", "b", "c", "d"]
    made = lay_out(some, "most-accurate")
    assert made.by_pixel
    assert [layer.ortho.name for layer in made.layers] == ["c", "b", "d", "a"]


def test_the_most_accurate_needs_the_accuracy_of_all(tmp_path: Path) -> None:
    some = [ortho(tmp_path / "a.tif", 0.0, 0.0, accuracy=Path("x.tif")), ortho(tmp_path / "b.tif", 0.0, 0.0)]
    with pytest.raises(InputError, match="b has no accuracy raster"):
        lay_out(some, "most-accurate")
    assert len(lay_out(some).layers) == 2
    with pytest.raises(InputError, match="at least one"):
        lay_out([])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"left": 0.03}, "off the grid"), ({"top": 0.05}, "off the grid"), ({"step": (2.001, 3.0)}, "2.001 x 3"),
        ({"left": -0.03}, "off the grid"), ({"top": -0.05}, "off the grid"),
        ({"step": (2.0, 3.001)}, "2 x 3.001"), ({"crs": 32634}, "zone 34N"), ({"bands": 2}, "2 bands"),
        ({"kind": gdal.GDT_UInt16}, "uint16"), ({"nodata": 0.0}, "by the nodata value 0, but a.tif by"),
    ],
)  # fmt: skip
def test_orthos_that_do_not_fit_are_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    first = ortho(tmp_path / "a.tif", 0.0, 0.0)
    with pytest.raises(InputError, match=message) as refused:
        lay_out([first, ortho(tmp_path / "b.tif", **{"left": 0.0, "top": 0.0, **changes})], "first-on-top")
    assert "b" in str(refused.value)
    assert len(lay_out([first, ortho(tmp_path / "c.tif", 2e-6, 0.0)]).layers) == 2


def test_boxes_have_a_common_part_of_at_least_a_pixel() -> None:
    one = (2, 3, 8, 7)
    assert intersection(one, (0, 0, 3, 5)) == (2, 3, 3, 5)
    assert intersection(one, (6, 5, 11, 8)) == (6, 5, 8, 7)
    assert intersection(one, (3, 4, 4, 5)) == (3, 4, 4, 5)
    for other in ((8, 3, 9, 7), (2, 7, 8, 9), (0, 3, 2, 7), (2, 0, 8, 3)):
        assert intersection(one, other) is None


def test_windows_go_row_by_row_and_end_with_the_grid(tmp_path: Path) -> None:
    made = lay_out([ortho(tmp_path / "a.tif", 0.0, 0.0, (7, 5))])
    assert list(windows(made.grid, 4)) == [(0, 0, 4, 4), (4, 0, 3, 4), (0, 4, 4, 1), (4, 4, 3, 1)]


def test_the_accuracy_of_a_pixel_is_that_of_the_pixel_above_it(tmp_path: Path) -> None:
    """The raster of accuracy has one pixel for 3 x 2 of the ortho; its last band counts; unknown is the worst."""
    errors = np.arange(12, dtype=np.float32).reshape(3, 4) / 10
    errors[1, 2] = np.nan
    ortho(tmp_path / "acc.tif", 0.0, 0.0, (4, 3), (6.0, 6.0), bands=2, kind=gdal.GDT_Float32, nodata=float("nan"),
          pixels=[np.full((3, 4), 99.0), errors])  # fmt: skip
    made = lay_out([ortho(tmp_path / "a.tif", 0.0, 0.0, (11, 6), accuracy=tmp_path / "acc.tif")])
    for left, top, width, height in ((0, 0, 11, 6), (2, 1, 5, 4), (7, 3, 1, 1)):
        found = circular_errors(made.layers[0], left, top, width, height)
        for row in range(height):
            for column in range(width):
                expected = errors[(top + row) // 2, (left + column) // 3]
                worst = np.finfo(np.float32).max
                assert found[row, column] == (worst if np.isnan(expected) else expected)


def test_the_remedy_has_no_command_where_the_first_crs_has_no_code(tmp_path: Path) -> None:
    made = ortho(tmp_path / "a.tif", 0.0, 0.0)
    dataset = gdal.Open(str(made.path), gdal.GA_Update)
    dataset.SetProjection(pyproj.CRS("+proj=tmerc +lon_0=15.5 +x_0=5e5 +ellps=GRS80 +units=m").to_wkt())
    del dataset
    with pytest.raises(InputError, match="zone 33N") as refused:
        lay_out([made, ortho(tmp_path / "b.tif", 0.0, 0.0)], "first-on-top")
    assert str(refused.value.remedy) == "rectify its scene again with the CRS, pixel size and grid of 'a.tif'"
