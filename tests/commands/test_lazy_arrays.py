"""The lazy array is the file, and makes only the blocks that are asked for."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal

import ortho_pipeline as op
from ortho_pipeline.commands.arrays import lazy
from ortho_pipeline.errors import InputError
from ortho_pipeline.warp.lattice import BLOCK

pytest.importorskip("xarray")
pytest.importorskip("dask.array")
gdal.UseExceptions()


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """Count the tiles that are made."""
    tiles: list[tuple[int, int]] = []
    make = lazy.Tiles.__call__

    def counted(self: lazy.Tiles, top: int, left: int, height: int, width: int) -> Any:
        tiles.append((top, left))
        return make(self, top, left, height, width)

    monkeypatch.setattr(lazy.Tiles, "__call__", counted)
    return tiles


@pytest.mark.parametrize("options", [{}, {"nodata": 7}])
def test_the_array_is_the_file_bit_by_bit(
    tiny: Any, tmp_path: Path, made: list[tuple[int, int]], options: dict[str, Any]
) -> None:
    output = op.OutputOptions(resolution=2.5, **options)
    surface = op.SurfaceOptions(dem=str(tiny.dem), vertical="ellipsoid")
    points = op.PointOptions(gcps=str(tiny.gcps), crs="EPSG:4326", vertical="ellipsoid")
    array = op.ortho_array(tiny.image, surface, points=points, output=output, chunks=2 * BLOCK)
    assert made == []
    file = gdal.Open(
        str(op.rectify(tiny.image, tmp_path, surface=surface, points=points, output=output).files["ortho"])
    )
    part = array[:, BLOCK : BLOCK + 40, :30].compute()
    assert made == [(0, 0)]
    np.testing.assert_array_equal(part.values[0], file.ReadAsArray(0, BLOCK, 30, 40))
    whole = array.compute()
    assert whole.dtype == file.ReadAsArray().dtype
    np.testing.assert_array_equal(whole.values[0], file.ReadAsArray())
    if options:
        assert array.attrs["_FillValue"] == 7
    else:
        mask = file.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
        np.testing.assert_array_equal(whole.valid.values, mask)
    west, dx, _, north, _, dy = file.GetGeoTransform()
    assert (array.x.values[0], array.y.values[0]) == pytest.approx((west + dx / 2, north + dy / 2), abs=1e-9)


def test_others_read_its_place(tiny: Any) -> None:
    pytest.importorskip("rioxarray")
    pytest.importorskip("odc.geo.xr")
    array = op.ortho_array(tiny.image, op.SurfaceOptions(height=500.0), output=op.OutputOptions(resolution=4.8))
    assert array.rio.crs.to_epsg() == 32734
    assert array.rio.resolution() == pytest.approx((4.8, -4.8))
    west, south, east, north = array.rio.bounds()
    assert (east - west, north - south) == pytest.approx((4.8 * array.sizes["x"], 4.8 * array.sizes["y"]))
    assert array.odc.geobox.crs.epsg == 32734
    assert tuple(array.odc.geobox.boundingbox) == pytest.approx((west, south, east, north))


def test_what_makes_it_can_be_sent_elsewhere(tiny: Any) -> None:
    array = op.ortho_array(tiny.image, op.SurfaceOptions(dem=str(tiny.dem), vertical="ellipsoid"), chunks=BLOCK)
    again = pickle.loads(pickle.dumps(array))
    np.testing.assert_array_equal(again[:, :50, :50].values, array[:, :50, :50].values)


def test_what_makes_no_array_is_refused(tiny: Any) -> None:
    for chunks in (0, 100, BLOCK + 1, -BLOCK):
        with pytest.raises(InputError, match=f"multiple of {BLOCK}|not made"):
            op.ortho_array(tiny.image, op.SurfaceOptions(height=500.0), chunks=chunks)
    with pytest.raises(InputError, match="ortho alone"):
        op.ortho_array(tiny.image, op.SurfaceOptions(height=500.0), output=op.OutputOptions(angles=True))
    with pytest.raises(InputError, match="warper"):
        op.ortho_array(tiny.image, op.SurfaceOptions(height=500.0), output=op.OutputOptions(engine="gdal"))
