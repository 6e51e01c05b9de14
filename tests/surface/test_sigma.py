"""The standard deviation of heights: a number or a raster, held by the surface, known to all that use it."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from osgeo import gdal

from ortho_pipeline.commands.heights.opening import has_surface, open_surface
from ortho_pipeline.commands.resolved.ledger import Ledger
from ortho_pipeline.commands.resolved.request import Request
from ortho_pipeline.errors import InputError
from ortho_pipeline.options import SurfaceOptions
from ortho_pipeline.surface.accuracy import typical_sigma
from ortho_pipeline.surface.base import Surface
from ortho_pipeline.surface.flat import FlatSurface


@pytest.fixture
def quality(tiny):
    """Write a raster of standard deviations: 3 m in the east, 1 m in the west, a void."""
    dem = gdal.Open(str(tiny.dem))
    path = tiny.folder / "hem.tif"
    copy = gdal.GetDriverByName("GTiff").CreateCopy(str(path), dem)
    values = np.full((dem.RasterYSize, dem.RasterXSize), 3.0, dtype=np.float32)
    values[:, :65], values[60:70, 40:50] = 1.0, -32767.0
    copy.GetRasterBand(1).SetNoDataValue(-32767.0)
    copy.WriteArray(values)
    return path


def test_a_number_goes_with_the_surface_wherever_it_goes(tiny):
    for options in (
        SurfaceOptions(dem=tiny.dem, vertical="ellipsoid", sigma="2.5"),
        SurfaceOptions(height=500, sigma=2.5),
    ):
        surface = open_surface(options)
        assert surface.sigma == 2.5
        assert typical_sigma(surface) == 2.5
        for same in (surface.with_fill("mask"), surface.around(20.0), pickle.loads(pickle.dumps(surface))):
            assert same.sigma == 2.5
    assert typical_sigma(FlatSurface(500.0)) is None


def test_a_raster_is_read_where_it_lies_and_its_voids_are_unknown(tiny, quality):
    options = SurfaceOptions(dem=tiny.dem, vertical="ellipsoid", sigma=quality)
    surface = open_surface(options)
    assert isinstance(surface.sigma, Surface)
    assert typical_sigma(surface) == pytest.approx(np.sqrt(5.0), rel=0.02)
    places = np.array([[20.015, -30.0], [19.985, -30.0]])
    np.testing.assert_allclose(surface.sigma.heights(places, "EPSG:4979"), [3.0, 1.0])
    ledger = Ledger.of(Request(tiny.image, surface=options))
    assert ledger.roles[quality] == "DEM accuracy"


@pytest.mark.parametrize("sigma", [0.0, -3, "0", "nan", "inf", "1e308", "1e12", 1e12, 1e-200, "no_such_file.tif"])
def test_what_is_no_standard_deviation_is_refused(tiny, sigma):
    with pytest.raises(InputError) as caught:
        open_surface(SurfaceOptions(dem=tiny.dem, vertical="ellipsoid", sigma=sigma))
    assert (caught.value.field, bool(caught.value.remedy)) == ("surface.sigma", True)
    with pytest.raises(InputError, match="none is given"):
        has_surface(SurfaceOptions(sigma=sigma))


def test_negative_values_of_a_raster_are_voids_that_it_does_not_declare(tiny, quality):
    layer = gdal.Open(str(quality), gdal.GA_Update)
    values = layer.ReadAsArray()
    values[values < 0], values[:20] = -99.0, -5.0
    layer.GetRasterBand(1).DeleteNoDataValue()
    layer.WriteArray(values)
    layer = None
    surface = open_surface(SurfaceOptions(dem=tiny.dem, vertical="ellipsoid", sigma=quality))
    assert typical_sigma(surface) == pytest.approx(np.sqrt(5.0), rel=0.02)
    rows, columns = surface.sigma.shape
    heights = surface.sigma.window(0, 0, columns, rows)
    assert np.isnan(heights[:20]).all()
    assert np.isnan(heights[60:70, 40:50]).all()
    assert np.nanmin(heights) == 1.0


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf, "wide"])
def test_a_number_that_is_no_sigma_is_refused(sigma: float) -> None:
    with pytest.raises(InputError, match="is not a standard deviation of heights"):
        FlatSurface(100.0).with_sigma(sigma)


def test_a_sigma_is_a_positive_number_a_surface_or_none() -> None:
    flat = FlatSurface(100.0)
    assert flat.with_sigma(2).sigma == 2.0
    assert flat.with_sigma(flat).sigma is flat
    assert flat.with_sigma(2).with_sigma(None).sigma is None
