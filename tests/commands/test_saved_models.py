"""Models that were saved and are used again: for their own image, and with points that tell something new."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result
from osgeo import gdal

from ortho_pipeline.cli.program import cli


def ortho(*words: str | Path) -> Result:
    return CliRunner().invoke(cli, [str(word) for word in words], prog_name="ortho")


def said(*words: str | Path) -> dict[str, Any]:
    """Return what a command says as JSON."""
    done = ortho(*words, "--json")
    assert done.exit_code == 0, done.output
    return dict(json.loads(done.stdout))


@pytest.fixture(scope="module")
def fitted(sample: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sample scene, its model as delivered and as adjusted, and the control points alone."""
    folder = tmp_path_factory.mktemp("saved")
    for name in ("scene.tif", "scene_RPC.TXT", "dem.tif", "gcps.geojson"):
        shutil.copy(sample / name, folder / name)
    points = json.loads((folder / "gcps.geojson").read_text())
    points["features"] = [one for one in points["features"] if one["properties"].get("role", "control") == "control"]
    (folder / "control.geojson").write_text(json.dumps(points))
    for name, more in (("delivered", ()), ("adjusted", ("--gcps", folder / "gcps.geojson"))):
        made = ortho(
            "rectify", folder / "scene.tif", "--dem", folder / "dem.tif", "-tr", "20", "20", *more, "-o", folder / name
        )
        assert made.exit_code == 0, made.output
    return folder


def test_points_that_a_model_was_adjusted_to_do_not_test_it(fitted: Path) -> None:
    """Named as check points, they were the accuracy: of points "that took no part in the adjustment"."""
    again = (
        fitted / "scene.tif",
        "--dem",
        fitted / "dem.tif",
        "--model",
        fitted / "adjusted/scene_model.json",
        "--gcps",
    )
    for points in (("control.geojson", "--check", "every:1"), ("control.geojson",)):
        done = ortho("fit", *again, fitted / points[0], *points[1:])
        assert "unknown: this model was adjusted to 12 of these points" in done.output
        assert "map scale" not in done.output
    # The check points of the adjustment still test it.
    assert "RMSE at 6 check points that took no part" in ortho("fit", *again, fitted / "gcps.geojson").output


def test_a_model_that_was_saved_as_delivered_is_adjusted_like_the_delivered_one(fitted: Path) -> None:
    """Its points adjusted nothing, and a correction was refused: the points "would count twice"."""
    points = fitted / "scene.tif", "--dem", fitted / "dem.tif", "--gcps", fitted / "gcps.geojson"
    wanted = said("fit", *points)["parameters"]
    assert set(wanted) == {"col_shift", "row_shift"}
    for more in ((), ("--correction", "shift")):
        found = said("fit", *points, "--model", fitted / "delivered/scene_model.json", *more)["parameters"]
        assert {name: one["value"] for name, one in found.items()} == pytest.approx(
            {name: one["value"] for name, one in wanted.items()}
        )
    again = ortho("fit", *points, "--model", fitted / "adjusted/scene_model.json", "--correction", "shift")
    assert again.exit_code == 2
    assert "already adjusted" in again.output


def test_a_model_of_another_image_of_the_same_size_is_refused(fitted: Path, tmp_path: Path) -> None:
    """It put an image hundreds of metres off, with the accuracy of the image that it was adjusted for."""
    model = fitted / "adjusted/scene_model.json"
    other = tmp_path / "other.tif"
    gdal.Translate(str(other), str(fitted / "scene.tif"))
    rpc = gdal.Open(str(fitted / "scene.tif")).GetMetadata("RPC")

    def place(shift: float) -> None:
        for beside in tmp_path.glob("other*.xml"):
            beside.unlink()
        gdal.Open(str(other), gdal.GA_Update).SetMetadata(
            rpc | {"LONG_OFF": str(float(rpc["LONG_OFF"].split()[0]) + shift)}, "RPC"
        )

    words = "info", other, "--model", model
    place(0.0)
    assert ortho(*words).exit_code == 0
    place(0.004)
    refused = ortho(*words)
    assert refused.exit_code == 2
    assert "saved for another image" in refused.output
    # It is a copy: the person says so. And an image without a model of its own contradicts nothing.
    assert ortho(*words, "--crop-offset", "0,0").exit_code == 0
    bare = tmp_path / "bare.tif"
    gdal.GetDriverByName("GTiff").Create(str(bare), 1000, 1000, 1).WriteArray(gdal.Open(str(other)).ReadAsArray())
    assert ortho("info", bare, "--model", model).exit_code == 0


def test_rays_need_models_of_their_own_images(sample: Path, tmp_path: Path) -> None:
    """A crop with the model of the whole image gave points ten kilometres off, without an error."""
    names = "BANDF", "BANDA"
    images, points = [sample / "cartosat" / f"{name}.tif" for name in names], sample / "cartosat" / "points.csv"
    made = ortho("adjust", *images, "--points", points, "--export", "cars", "-o", tmp_path / "block")
    assert made.exit_code == 0, made.output
    models = [word for name in names for word in ("--models", tmp_path / "block" / f"{name}_model.json")]
    assert ortho("intersect", *images, "--points", points, *models).exit_code == 0
    crops = [tmp_path / path.name for path in images]
    for crop, image in zip(crops, images, strict=True):
        pixels = gdal.Open(str(image)).ReadAsArray(100, 100, 250, 250)
        gdal.GetDriverByName("GTiff").Create(str(crop), 250, 250, 1).WriteArray(pixels)
    refused = ortho("intersect", *crops, "--points", points, *models)
    assert refused.exit_code == 2
    assert "this model belongs to an image of 400 x 400 pixels" in refused.output
