"""A simulated IKONOS delivery from end to end: what is written, and the ortho held against the true ground."""

from __future__ import annotations

import json

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_ikonos.metadata import read_metadata
from ortho_studies.ikonos.rendering import brightness, render
from ortho_studies.ikonos.simulation import ORDER, write_product
from ortho_studies.ikonos.truth import DARK, FINEST, MAP_CRS, REFERENCE_HEIGHT, GeoScene, to_map

from ortho_pipeline import commands
from ortho_pipeline.cli.program import cli
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.model_file import load_model
from ortho_pipeline.host import open_scene
from ortho_pipeline.options import PointOptions
from ortho_pipeline.points import read_points
from ortho_pipeline.raster.source import open_dataset

#: Of the sample, as sample_data/make.py has them.
SEED, SIZE, PIXEL = 1, 800, 12.5


def run(*arguments: object) -> str:
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.fixture
def product(sample):
    return sample / "ikonos"


@pytest.fixture(scope="module")
def scene():
    """The truth of the sample, without its pixels."""
    return GeoScene.make(SEED, pixel=PIXEL, columns=SIZE, rows=SIZE)


def file_of(product, band="pan", component=0):
    return product / f"po_{ORDER}_{band}_{component:07d}.tif"


# -- the sample ------------------------------------------------------------------------------------------------------


def test_the_sample_is_what_the_simulation_writes(product, scene):
    truth = json.loads((product / "truth.json").read_text())
    np.testing.assert_allclose([point["image"] for point in truth["points"]], scene.image, atol=1e-6)
    np.testing.assert_allclose([point["lon_lat_h"] for point in truth["points"]], scene.ground, atol=1e-6)
    pixels = open_dataset(file_of(product)).ReadAsArray()
    assert pixels.shape == (SIZE, SIZE)
    assert pixels.max() < 2048
    strip = np.arange(40) * 20
    seen = scene.meet(np.stack([strip + 0.5, np.full(40, 300.5)], axis=1))
    tones = brightness(seen[:, 0], seen[:, 1], finest=FINEST * PIXEL)
    assert np.corrcoef(tones, pixels[300, strip])[0, 1] > 0.999
    assert sum(path.stat().st_size for path in product.iterdir()) < 1.5e6


def test_the_metadata_say_what_is_true_but_for_the_attitude(product, scene):
    delivery = read_metadata(product / f"po_{ORDER}_metadata.txt")
    component = delivery.component("0000000")
    source = delivery.source_of(component)
    assert (source.azimuth, source.elevation) == pytest.approx(scene.view, abs=1e-4)
    opened = open_scene(file_of(product))
    assert list(opened.models) == ["rpc", "geo"]
    assert not opened.warnings
    for model in opened.models.values():
        # Every model of the product puts its pixels where the georeference does, on the plane.
        corners = np.array([[0.0, 0.0], [SIZE, 0.0], [SIZE, SIZE]])
        place = model.image_to_ground(corners, REFERENCE_HEIGHT)
        if model.kind == "rpc":
            place[:, :2] = np.stack(to_map().transform(place[:, 0], place[:, 1]), axis=1)
        expected = np.array([scene.west, scene.north]) + corners * (PIXEL, -PIXEL)
        np.testing.assert_allclose(place[:, :2], expected, atol=0.01 * PIXEL)


def test_the_vendors_models_are_off_by_the_bias_and_no_more(product, scene):
    bias = np.array(json.loads((product / "truth.json").read_text())["bias_px"])
    assert 10 <= np.hypot(*bias) * PIXEL <= 28
    left = scene.image - open_scene(file_of(product)).models["rpc"].ground_to_image(scene.ground) - bias
    assert np.abs(left).max() * PIXEL < 0.3


def test_bands_and_components_share_one_grid(tmp_path):
    files = write_product(tmp_path, seed=2, size=64, pixel=20.0, rpc=False, multispectral=True, components=2)
    assert not list(tmp_path.glob("*_rpc.txt"))
    west, east = (open_dataset(files[name]) for name in ("image", "image_0000001"))
    blue = open_dataset(files["image_0000001_blu"])
    assert (west.RasterXSize, blue.RasterXSize) == (32, 8)
    assert east.GetGeoTransform()[0] == west.GetGeoTransform()[0] + 32 * 20.0 == blue.GetGeoTransform()[0]
    assert blue.GetGeoTransform()[1] == 80.0
    opened = open_scene(files["image_0000001"])
    assert list(opened.models) == ["geo"]
    # Points are in pixels of the first component; the second one begins 32 columns further.
    scene = GeoScene.make(2, pixel=20.0, columns=64, rows=64)
    miss = opened.model.ground_to_image(_on_map(scene.ground)) + np.array([32, 0]) - scene.image
    assert np.hypot(*miss.T).max() * 20.0 < 35


def test_bands_differ_but_show_the_same_ground():
    scene = GeoScene.make(0, pixel=12.0, columns=120, rows=120)
    pan, red, nir = (render(scene, band, noise_dn=0.0).astype(float).ravel() for band in ("pan", "red", "nir"))
    assert 1 > np.corrcoef(pan, red)[0, 1] > np.corrcoef(pan, nir)[0, 1] > 0.3
    assert pan.min() >= DARK


@pytest.mark.parametrize(
    "given", [{"size": 10}, {"size": 1000, "pixel": 50.0}, {"pixel": 0.1}, {"size": 101, "components": 2}, {"seed": -1}]
)
def test_scenes_that_are_not_possible(tmp_path, given):
    with pytest.raises(InputError) as error:
        write_product(tmp_path, **given)
    assert error.value.remedy
    assert not list(tmp_path.iterdir())


def test_the_command_writes_the_delivery(tmp_path):
    said = run("simulate", "ikonos", "-o", tmp_path, "--size", 64, "--no-rpc", "--components", 2)
    assert f"po_{ORDER}_pan_0000001.tif" in said
    assert (tmp_path / "gcps.csv").exists()


# -- the closed loop -------------------------------------------------------------------------------------------------


def _on_map(ground):
    return np.column_stack([*to_map().transform(ground[:, 0], ground[:, 1]), ground[:, 2]])


def displacement(ortho, x, y, half=14):
    """Find how far (m east, north) the ground around a place is displaced in an ortho, by least-squares matching."""
    west, step, _, north, _, _ = ortho.GetGeoTransform()
    first, top = (round((x - west) / step) - half, round((north - y) / step) - half)
    side = 2 * half
    seen = ortho.GetRasterBand(1).ReadAsArray(first, top, side, side).astype(float).ravel()
    columns, rows = np.meshgrid(np.arange(side) + 0.5, np.arange(side) + 0.5)
    place = np.stack([west + step * (first + columns.ravel()), north - step * (top + rows.ravel())], axis=1)

    def pattern(shift):
        lon, lat = to_map().transform(*(place - shift).T, direction="INVERSE")
        return brightness(lon, lat, finest=FINEST * PIXEL)

    shift = np.zeros(2)
    for _ in range(6):
        slopes = [(pattern(shift + nudge) - pattern(shift - nudge)) / 2 for nudge in np.eye(2)]
        design = np.column_stack([np.ones(side * side), pattern(shift), *slopes])
        _, gain, *move = np.linalg.lstsq(design, seen, rcond=None)[0]
        shift = shift + np.array(move) / gain
    return shift


def test_the_ortho_is_as_good_as_the_adjustment_says(product, scene, tmp_path):
    image, points = file_of(product), product / "gcps.csv"
    run("rectify", image, "--gcps", points, "--dem", product / "dem.tif", "--fit-model", "affine3d", "-o", tmp_path)
    report = json.loads((tmp_path / f"{image.stem}_report.json").read_text())["rmse_m"]
    ortho = open_dataset(tmp_path / f"{image.stem}_ortho.tif")
    check = read_points(points).to_crs(MAP_CRS).select(read_points(points).check)
    true = _on_map(scene.ground[-len(check) :])
    found = np.array([displacement(ortho, *place[:2]) for place in true])
    # The pixel that the adjusted model takes for a check point shows another place: so far is the ortho off, truly.
    model = load_model(tmp_path / f"{image.stem}_model.json")
    shown = _on_map(scene.meet(model.ground_to_image(true)))
    np.testing.assert_allclose(found, (true - shown)[:, :2], atol=0.02 * PIXEL)
    # Held against the map, as somebody would who measures the check points in the ortho. 1.3: twenty points have a
    # root mean square that is uncertain by 1 / sqrt(80), which is 11 %, on both sides.
    off = np.sqrt(((true[:, :2] + found - check.ground[:, :2]) ** 2).sum(axis=1).mean())
    for kind in ("check", "loo"):
        assert report[kind]["total"] / 1.5 < off < 1.3 * report[kind]["total"]


def test_one_point_adjusts_the_metadata_model_beside_an_rpc(product, tmp_path):
    points = tmp_path / "one.csv"
    lines = (product / "gcps.csv").read_text().splitlines()
    header = next(k for k, line in enumerate(lines) if line.startswith("id,"))
    role = lines[header].split(",").index("role")
    rows = [line.split(",") for line in lines[header + 1 :]]
    for k, row in enumerate(rows):
        row[role] = "control" if k == 0 else "check"
    points.write_text("\n".join([*lines[: header + 1], *map(",".join, rows)]) + "\n")
    image = product / "po_39001_pan_0000000.tif"
    said = json.loads(run("fit", image, "--gcps", points, "--correction", "model", "--json"))
    # The RPC has no parameters; those of geo are held by what the metadata are worth. One point leaves a few metres
    # (the simulated pixel has some of them), without it there are 10 to 25.
    assert said["model"] == "geo+model"
    assert said["rmse"]["check"]["total"] * PIXEL < 5


def test_points_of_components_are_measured_in_the_component_that_they_lie_in(tmp_path):
    whole = write_product(tmp_path / "whole", seed=2, size=128, pixel=20.0, rpc=False)
    cut = write_product(tmp_path / "cut", seed=2, size=128, pixel=20.0, rpc=False, components=2)
    images = [path for key, path in cut.items() if key.startswith("image")]
    read = {path.name: read_points(cut["gcps"], image_name=path.name) for path in images}
    # Points of the other component are not taken for those of the image at hand ...
    assert all(0 < len(points) < 40 and points.image[:, 0].max() < 64.5 for points in read.values())
    assert sum(map(len, read.values())) == 40
    # ... and all of them adjust either component as they adjust the whole.
    expected = commands.fit(whole["image"], PointOptions(gcps=whole["gcps"])).fit
    for path in images:
        found = commands.fit(path, PointOptions(gcps=cut["gcps"])).fit
        assert len(found.points) == 40
        np.testing.assert_allclose(found.rmse("check").total, expected.rmse("check").total, atol=1e-3)
