"""A finished ortho and a raw scene in one block, and their orthos in one mosaic."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from osgeo import gdal

from ortho_pipeline.cli.program import cli
from ortho_pipeline.exchange.model_file import read_model_file
from tests.conftest import SAMPLE

gdal.UseExceptions()
#: Metres to the east and north by which the ortho is displaced, and by which the sample's reference is (its README).
DISPLACED, REFERENCE = np.array([15.0, -10.0]), np.array([3.0, -2.0])


def run(*words: Any) -> Any:
    done = CliRunner().invoke(cli, [*map(str, words), "--json"])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Adjust the sample scene with its control points, and a displaced ortho of the same ground with ties alone."""
    folder = tmp_path_factory.mktemp("mixed")
    source = gdal.Open(str(SAMPLE / "reference.tif"))
    left, dx, _, top, _, dy = source.GetGeoTransform()
    east, north = DISPLACED
    bounds = [left + east, top + north, left + east + source.RasterXSize * dx, top + north + source.RasterYSize * dy]
    gdal.Translate(str(folder / "displaced.tif"), source, outputBounds=bounds, outputType=gdal.GDT_UInt16)
    points = json.loads((SAMPLE / "gcps.geojson").read_text())
    for feature in points["features"]:
        feature["properties"]["ji"] = {"scene": feature["properties"]["ji"]}
    (folder / "points.geojson").write_text(json.dumps(points))
    run(
        "adjust", SAMPLE / "scene.tif", folder / "displaced.tif", "--ortho", "--ties", "auto", "--correction", "shift",
        "--dem", SAMPLE / "dem.tif", "--dem-sigma", 2, "--points", folder / "points.geojson", "--orthos",
        "-t_srs", "EPSG:32636", "-tr", 5, 5, "-o", folder / "block",
    )  # fmt: skip
    return folder / "block"


def test_the_control_of_a_raw_scene_corrects_the_ortho(block):
    model = read_model_file(block / "displaced_model.json").model
    expected = (DISPLACED + REFERENCE) / 5.0 * (1, -1)
    np.testing.assert_allclose(model.coefficients[[0, 3]], expected, atol=0.1)


def test_their_orthos_are_one_mosaic(block, tmp_path):
    orthos = [block / f"{name}_ortho.tif" for name in ("scene", "displaced")]
    document = run("mosaic", *orthos, "--order", "first-on-top", "-o", tmp_path / "mosaic.tif")
    (seam,) = document["mosaic"]["seams"]
    assert seam["rmse_px"] < 0.5
    assert np.hypot(*seam["median_px"]) < 0.1
