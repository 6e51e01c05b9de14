"""Orthos in systems that have no EPSG code: the report, the STAC item and the mosaic know them too."""

from __future__ import annotations

import json

import numpy as np
import pyproj
import pytest
from osgeo import gdal, osr

from ortho_pipeline import commands
from ortho_pipeline.commands.mosaic.assembly import mosaic
from ortho_pipeline.options import OutputOptions, PointOptions, SurfaceOptions
from ortho_pipeline.report import document as report
from ortho_pipeline.report.page.locator import place_of

#: The tiny scene lies at 20° E, 30° S.
PLACE = (20.0, -30.0)
TMERC = "+proj=tmerc +lat_0=-30 +lon_0=20.1 +k=1 +x_0=500000 +y_0=0 +datum=WGS84 +units=m +no_defs"
NAMED = pyproj.CRS(TMERC).to_wkt().replace('"unknown"', '"Site grid of the mine"', 1)


def rectified(tiny, folder, crs, **options):
    return commands.rectify(
        tiny.image, folder, points=PointOptions(gcps=tiny.gcps, crs="EPSG:4979", vertical="ellipsoid"),
        surface=SurfaceOptions(dem=tiny.dem, vertical="ellipsoid"),
        output=OutputOptions(crs=crs, stac=True, acquired="2005-08-03T08:12:31Z", **options),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("crs", "label"),
    [
        (TMERC, "custom Transverse Mercator"),
        (NAMED, "Site grid of the mine"),
        (f"{TMERC} +units=us-ft".replace("+units=m ", ""), "custom Transverse Mercator"),
        ("+proj=tmerc +lon_0=20 +ellps=bessel +towgs84=598,73,418,0.2,0.04,-2.4,6.7", "custom Transverse Mercator"),
        ("+proj=longlat +ellps=clrk66 +towgs84=-136,-108,-292", "custom geographic CRS"),
        ("+proj=utm +zone=34 +south +datum=WGS84", "EPSG:32734"),
    ],
    ids=["transverse Mercator", "named", "feet", "Bessel", "geographic", "a code after all"],
)
def test_an_ortho_in_a_system_without_a_code_has_its_report(tiny, tmp_path, crs, label):
    step = 5e-5 if "longlat" in crs else (16.0 if "us-ft" in crs else 5.0)
    result = rectified(tiny, tmp_path / "out", crs, resolution=step)
    made = report.read_report(result.files["report"])
    assert made.ortho is not None
    assert (made.ortho.crs_label, label in result.summary, label in result.files["html"].read_text()) == (
        label, True, True)  # fmt: skip
    # The text in the report leads to the ground where GDAL, which reads the ortho, has it.
    dataset = gdal.Open(str(result.files["ortho"]))
    left, dx, _, top, _, dy = dataset.GetGeoTransform()
    x, y = left + dx * dataset.RasterXSize / 2, top + dy * dataset.RasterYSize / 2
    system, wgs84 = osr.SpatialReference(), osr.SpatialReference()
    system.ImportFromWkt(dataset.GetProjection())
    wgs84.ImportFromEPSG(4326)
    for one in (system, wgs84):
        one.SetAxisMappingStrategy(osr.OAMS_TRADITIONAL_GIS_ORDER)
    there = osr.CoordinateTransformation(system, wgs84).TransformPoint(x, y)[:2]
    np.testing.assert_allclose(there, PLACE, atol=0.02)
    ours = pyproj.Transformer.from_crs(made.ortho.crs, 4326, always_xy=True).transform(x, y)
    np.testing.assert_allclose(ours, there, atol=1e-7)
    np.testing.assert_allclose(place_of(made), there, atol=1e-7)
    item = json.loads(result.files["stac"].read_text())
    assert item["bbox"][0] < there[0] < item["bbox"][2]
    assert item["bbox"][1] < there[1] < item["bbox"][3]


def test_a_mosaic_and_the_layers_know_such_a_system_too(tiny, tmp_path):
    result = rectified(tiny, tmp_path / "out", NAMED, accuracy_raster=True, angles=True, visibility="mask")
    joined = mosaic([result.files["ortho"]], tmp_path / "m.tif")
    document = joined.document["mosaic"]
    assert document["crs_name"] == "Site grid of the mine"
    assert pyproj.CRS(document["crs"]) == pyproj.CRS(NAMED)
    assert "Site grid of the mine" in joined.files["page"].read_text()
