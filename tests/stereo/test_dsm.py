"""DSMs as stereo programs write them: their datum, holes and error layers, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from osgeo import gdal, osr
from pair import LAT, LON, PIXEL, Pair

import ortho_pipeline as op
from ortho_pipeline import commands
from ortho_pipeline.commands.heights.opening import open_surface
from ortho_pipeline.errors import CoverageError, DatumError, InputError
from ortho_pipeline.options import OutputOptions, SurfaceOptions
from ortho_pipeline.surface.accuracy import typical_sigma

#: Heights as CARS 1.3 declares them where it is not to use a geoid (`cars.core.projection.get_output_crs`).
CARS = (
    'VERTCRS["WGS 84 ellipsoidal height",VDATUM["WGS 84"],CS[vertical,1],AXIS["ellipsoidal height (h)",up],'
    'LENGTHUNIT["metre",1,ID["EPSG",9001]]]'
)
STEP, SIDE = 20.0, 400


def dsm(path: Path, vertical: str | None, *, void: float = -32768.0, size: int = SIDE, east: float = 0.0) -> Path:
    """Write a surface of 500 m with a hole, in UTM 34S, with the heights of a VERTCRS, an EPSG code, or undeclared."""
    plane = osr.SpatialReference()
    plane.ImportFromEPSG(32734)
    crs = osr.SpatialReference()
    if vertical is None:
        crs = plane
    elif vertical.isdigit():
        crs.SetFromUserInput(f"EPSG:32734+{vertical}")
    else:
        crs.SetFromUserInput(
            f'COMPOUNDCRS["EPSG:32734 + heights",{plane.ExportToWkt(["FORMAT=WKT2_2018"])},{vertical}]'
        )
    centre = osr.CoordinateTransformation(*_lonlat_to(plane)).TransformPoint(LON, LAT)
    heights = np.full((size, size), 500.0, dtype=np.float32)
    heights[190:200, 190:200] = void
    made = gdal.GetDriverByName("GTiff").Create(str(path), size, size, 1, gdal.GDT_Float32)
    made.SetGeoTransform((centre[0] - SIDE * STEP / 2 + east, STEP, 0, centre[1] + SIDE * STEP / 2, 0, -STEP))
    made.SetProjection(crs.ExportToWkt(["FORMAT=WKT2_2018"]))
    if np.isfinite(void):
        made.GetRasterBand(1).SetNoDataValue(void)
    made.GetRasterBand(1).WriteArray(heights)
    made = None
    return path


def _lonlat_to(plane: osr.SpatialReference) -> tuple[osr.SpatialReference, osr.SpatialReference]:
    lonlat = osr.SpatialReference()
    lonlat.ImportFromEPSG(4326)
    for system in (lonlat, plane):
        system.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    return lonlat, plane


@pytest.fixture
def pair(tmp_path: Path) -> Pair:
    return Pair(tmp_path / "pair")


def true_ortho(pair: Pair, folder: Path, surface: SurfaceOptions) -> np.ndarray:
    output = OutputOptions(visibility="nodata", format="GTiff", resolution=(PIXEL, PIXEL))
    done = commands.rectify(pair.image("aft"), folder, surface=surface, output=output)
    pixels: np.ndarray = gdal.Open(str(done.files["ortho"])).ReadAsArray()
    return pixels


@pytest.mark.parametrize(("vertical", "datum"), [(CARS, "ellipsoid"), ("5773", "EPSG:5773")])
def test_the_datum_that_cars_declares_is_used_without_an_option(tmp_path: Path, vertical: str, datum: str) -> None:
    surface = op.open_dem(dsm(tmp_path / "dsm.tif", vertical))
    assert surface.provenance["vertical"] == datum


def test_a_surface_without_a_datum_needs_it_stated(tmp_path: Path) -> None:
    path = dsm(tmp_path / "s2p.tif", None, void=np.nan)
    with pytest.raises(DatumError, match="height datum") as caught:
        open_surface(SurfaceOptions(dem=path))
    assert "--dem-vertical" in str(caught.value.remedy) or "vertical" in str(caught.value.remedy)
    assert open_surface(SurfaceOptions(dem=path, vertical="ellipsoid")).height_range == (500.0, 500.0)


@pytest.mark.parametrize("void", [-32768.0, np.nan])
def test_holes_of_a_surface_are_holes_of_the_true_ortho(pair: Pair, tmp_path: Path, void: float) -> None:
    path = dsm(tmp_path / "dsm.tif", CARS, void=void)
    masked = true_ortho(pair, tmp_path / "masked", SurfaceOptions(dem=path))
    filled = true_ortho(pair, tmp_path / "filled", SurfaceOptions(dem=path, fill="nearest"))
    holes = ((filled > 0) & (masked == 0)).sum() * PIXEL**2
    # Bilinear heights need both neighbours, so ten missing samples are a hole of eleven.
    assert holes == pytest.approx((11 * STEP) ** 2, rel=0.1)


def test_an_error_layer_is_the_accuracy_of_the_surface(tmp_path: Path) -> None:
    path, layer = dsm(tmp_path / "dsm.tif", CARS), tmp_path / "performance_map.tif"
    made = gdal.GetDriverByName("GTiff").CreateCopy(str(layer), gdal.Open(str(path)))
    errors = np.full((SIDE, SIDE), 0.5, dtype=np.float32)
    errors[:, SIDE // 2 :] = 2.0
    made.WriteArray(errors)
    made = None
    surface = open_surface(SurfaceOptions(dem=path, sigma=layer))
    assert typical_sigma(surface) == pytest.approx(np.sqrt((0.25 + 4.0) / 2), rel=0.02)


def test_an_error_layer_of_another_size_is_refused(tmp_path: Path) -> None:
    path, layer = dsm(tmp_path / "dsm.tif", CARS), dsm(tmp_path / "layer.tif", None, size=SIDE // 2)
    with pytest.raises(CoverageError, match="200 x 200 samples, the DEM 400 x 400") as caught:
        open_surface(SurfaceOptions(dem=path, sigma=layer))
    assert (caught.value.field, Path(str(caught.value.file)).name) == ("surface.sigma", "layer.tif")


def test_a_surface_of_another_place_is_refused(pair: Pair, tmp_path: Path) -> None:
    path = dsm(tmp_path / "dsm.tif", CARS, east=50_000.0)
    with pytest.raises(InputError) as caught:
        true_ortho(pair, tmp_path / "out", SurfaceOptions(dem=path))
    assert "surface.dem" in str(caught.value.field) or "DEM" in caught.value.message
    assert caught.value.remedy
