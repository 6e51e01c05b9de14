"""The lazy cube of orthos: one value has one meaning at all times."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.commands.arrays.cube import cube_of
from ortho_pipeline.errors import InputError

pytest.importorskip("xarray")
pytest.importorskip("dask.array")
gdal.UseExceptions()


def ortho(path: Path, offset: float) -> Path:
    """Write an ortho of reflectances, as integers with an offset."""
    made = gdal.GetDriverByName("GTiff").Create(str(path), 8, 8, 1, gdal.GDT_UInt16)
    made.SetGeoTransform((500_000.0, 10.0, 0.0, 7_000_000.0, 0.0, -10.0))
    made.SetProjection("EPSG:32735")
    made.GetRasterBand(1).SetScale(0.0001)
    made.GetRasterBand(1).SetOffset(offset)
    made.GetRasterBand(1).WriteArray(np.full((8, 8), 1200, dtype=np.uint16))
    return path


def test_a_cube_refuses_orthos_whose_equal_values_mean_different_things(tmp_path: Path) -> None:
    paths = [ortho(tmp_path / "2021.tif", 0.0), ortho(tmp_path / "2022.tif", -0.1)]
    times = [datetime(year, 6, 1, tzinfo=UTC) for year in (2021, 2022)]
    assert cube_of(paths[:1], times[:1], {}, None, {}).compute().shape == (1, 1, 8, 8)
    with pytest.raises(InputError, match=r"band 1 of 2022\.tif has scale 0\.0001 and offset -0\.1, but") as error:
        cube_of(paths, times, {}, None, {})
    assert Path(str(error.value.file)) == paths[1]
