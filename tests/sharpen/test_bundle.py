"""`ortho rectify --sharpen`: one adjustment for both images of a bundle, and both orthos on one grid."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bundles import Bundle, write
from click.testing import CliRunner
from osgeo import gdal
from seeds import SIZE, rpc

from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.sharpening.bundle import _ratio_in, taken_over
from ortho_pipeline.commands.sharpening.registration import Agreement
from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc import rpc_metadata
from ortho_pipeline.exchange.rpc_files import write_rpc_txt
from ortho_pipeline.geodesy.crs import ground_transform, parse_crs
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import ImageCorrection
from ortho_pipeline.raster.source import Grid


def coarse_scene() -> Scene:
    """Return a scene four times as coarse as `rpc()`."""
    return Scene("rpc", "ms.tif", SIZE[0] // 4, SIZE[1] // 4, {"rpc": rpc().scaled(4.0)}, "made")


@pytest.mark.parametrize("kind", ["none", "shift", "affine"])
def test_a_correction_is_taken_over_in_pixels_of_the_other_image(kind: str) -> None:
    coefficients = {"none": np.zeros(6), "shift": np.array([3.0, 0, 0, -2.0, 0, 0])}
    affine = np.array([3.0, 1e-3, -2e-3, -2.0, 5e-4, 1.5e-3])
    adjusted = ImageCorrection(rpc(), kind, (40.0, 10.0), coefficients.get(kind, affine))
    model = taken_over(adjusted, coarse_scene())
    image = np.random.default_rng(0).uniform(0, SIZE, (50, 2))
    ground = rpc().image_to_ground(image, rpc().h_off)
    # Outer corners agree, so a place in one image is a quarter of that in the other.
    np.testing.assert_allclose(4 * model.ground_to_image(ground), adjusted.ground_to_image(ground), atol=1e-3)


def test_images_that_are_no_bundle_are_refused() -> None:
    scene = coarse_scene()
    with pytest.raises(InputError, match="not coarser"):
        taken_over(rpc(), replace(scene, models={"rpc": rpc()}))
    far = replace(scene.model, lon_off=scene.model.lon_off + 90.0)
    with pytest.raises(InputError, match="does not show the place"):
        taken_over(rpc(), replace(scene, models={"rpc": far}))


def bundle_of(folder: Path) -> tuple[Path, Path]:
    """Write both images of a bundle with RPCs: places of both are those of one RPC."""
    pixels = Bundle(side=256).pixels()
    paths = []
    for name, raster, scale in (("pan", pixels[0][None], 1.0), ("ms", pixels[1], 4.0)):
        path = write(folder / f"{name}.tif", raster, 1.0)
        model = rpc() if scale == 1.0 else rpc().scaled(scale)
        dataset = gdal.Open(str(path), gdal.GA_Update)
        dataset.SetGeoTransform((0, 1, 0, 0, 0, 1))
        dataset.SetProjection("")
        dataset.SetMetadata(rpc_metadata(model), "RPC")
        dataset = None
        paths.append(path)
    return paths[0], paths[1]


def run(*words: Any) -> Any:
    return CliRunner().invoke(cli, list(map(str, words)))


def test_both_orthos_and_the_sharpened_one_share_a_grid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pan, colours = bundle_of(tmp_path)
    height = rpc().h_off
    places = np.array([[20.0, 30.0], [200.0, 40.0], [60.0, 210.0], [190.0, 180.0]])
    ground = rpc().image_to_ground(places, height)
    rows = ["id,col,row,x,y,h"]
    rows += [
        f"{k},{c + 2},{r - 1},{x},{y},{h}" for k, ((c, r), (x, y, h)) in enumerate(zip(places, ground, strict=True))
    ]
    (tmp_path / "gcps.csv").write_text("\n".join(rows))
    agreement = Agreement((0.0, 0.0), (0.02, 0.02), 0.05, 100, 120)
    monkeypatch.setattr("ortho_pipeline.commands.sharpening.sharpen.measure_agreement", lambda *_: agreement)
    result = run(
        "rectify", pan, "--sharpen", colours, "--height", height, "--gcps", tmp_path / "gcps.csv", "--points-crs",
        "EPSG:4326", "--points-vertical", "ellipsoid", "-of", "GTiff", "-co", "COMPRESS=LZW", "-o", tmp_path / "out",
        "--json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    orthos = [gdal.Open(document["files"][name]) for name in ("ortho", "multispectral", "sharpened")]
    assert len({ortho.GetGeoTransform() for ortho in orthos}) == 1
    assert [ortho.RasterCount for ortho in orthos] == [1, 4, 4]
    assert {ortho.GetMetadataItem("COMPRESSION", "IMAGE_STRUCTURE") for ortho in orthos} == {"LZW"}
    saved = json.loads((tmp_path / "out" / "ms_model.json").read_text())
    coefficients = saved.get("model", saved)["coefficients"]
    np.testing.assert_allclose([coefficients[0], coefficients[3]], [0.5, -0.25], atol=1e-3)
    # The colours are where the detail is: the sharpened ortho averages to the multispectral one.
    valid = orthos[2].GetRasterBand(1).GetMaskBand().ReadAsArray() > 0
    assert document["sharpening"]["ratio"] == 4
    sharp, wide = (ortho.ReadAsArray().astype(float)[:, valid] for ortho in (orthos[2], orthos[1]))
    np.testing.assert_allclose(sharp.mean(axis=1), wide.mean(axis=1), rtol=0.02)


def test_heights_need_cover_the_panchromatic_image_only(tmp_path: Path) -> None:
    """Tiles and crops of a panchromatic image come with the whole multispectral one."""
    pan, colours = bundle_of(tmp_path)
    whole = gdal.Open(str(pan))
    gdal.Translate(str(tmp_path / "part.tif"), whole, srcWin=[0, 0, 160, 160])
    ground = rpc().image_to_ground(np.array([[-8.0, -8], [168, -8], [168, 168], [-8, 168]]), rpc().h_off)
    (west, south), (east, north) = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    dem = gdal.GetDriverByName("GTiff").Create(str(tmp_path / "dem.tif"), 40, 40, 1, gdal.GDT_Float32)
    dem.SetGeoTransform((west, (east - west) / 40, 0, north, 0, (south - north) / 40))
    dem.SetProjection(parse_crs("EPSG:4326").to_wkt())
    dem.GetRasterBand(1).Fill(rpc().h_off)
    dem = None
    result = run(
        "rectify", tmp_path / "part.tif", "--sharpen", colours, "--dem", tmp_path / "dem.tif", "--dem-vertical",
        "ellipsoid", "-o", tmp_path / "out",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    orthos = [gdal.Open(str(tmp_path / "out" / f"part_ortho{end}.tif")) for end in ("", "_sharpened")]
    sharp, made = (ortho.GetRasterBand(1).GetMaskBand().ReadAsArray() > 0 for ortho in orthos)
    assert made.mean() == pytest.approx(sharp.mean(), abs=0.03)
    notes = json.loads((tmp_path / "out" / "ms_report.json").read_text())["headline"]["notes"]
    assert notes[0].startswith("The model is used as it was delivered.")


def test_remedies_name_options_as_they_are_typed(tmp_path: Path) -> None:
    pan, colours = bundle_of(tmp_path)
    random = np.random.default_rng(4)
    places = random.uniform(20, 236, (8, 2))
    ground = rpc().image_to_ground(places, rpc().h_off)
    rows = ["id,col,row,x,y,h"]
    for k, ((c, r), (x, y, h)) in enumerate(zip(places + random.normal(0, 0.1, (8, 2)), ground, strict=True)):
        rows.append(f"{k},{c},{r},{x},{y},{h}")
    (tmp_path / "gcps.csv").write_text("\n".join(rows))
    result = run(
        "rectify", pan, "--sharpen", colours, "--height", rpc().h_off, "--gcps", tmp_path / "gcps.csv", "--points-crs",
        "EPSG:4326", "--points-vertical", "ellipsoid", "--correction", "affine", "-o", tmp_path / "out",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "Remove them with --prune." in result.output
    (note,) = json.loads((tmp_path / "out" / "ms_report.json").read_text())["headline"]["notes"]
    assert note == "The model has the correction of pan.tif, whose report has the accuracy."


def test_the_ratio_is_that_of_the_pixels_of_the_ortho() -> None:
    """With another resolution an original multispectral pixel is another number of pixels wide."""
    scene, grids = coarse_scene(), {}
    image = np.array([[SIZE[0] / 8, SIZE[1] / 8], [SIZE[0] / 8 + 1, SIZE[1] / 8]])
    ground = scene.model.image_to_ground(image, scene.model.reference_height)
    crs = parse_crs("EPSG:32636")
    (west, north, *_), (east, south, *_) = ground_transform(scene.model.crs, crs)(ground)
    width = float(np.hypot(east - west, north - south))
    for part in (1, 2, 4, 8):
        grids[part] = Grid(crs, west, north, width / part, width / part, 10, 10)
    assert [_ratio_in(grids[part], scene.model, scene) for part in (2, 4, 8)] == [2, 4, 8]
    with pytest.raises(InputError, match="no detail to add"):
        _ratio_in(grids[1], scene.model, scene)


def test_wrong_options_are_refused_before_any_work(tmp_path: Path) -> None:
    pan, colours = bundle_of(tmp_path)
    out = "--height", 800, "-o", tmp_path / "out"
    for words, message in (
        (("--sharpen", pan), "the same name"),
        (("--sharpen", colours, "--rpc", tmp_path / "pan_RPC.TXT"), "opens one image"),
        (("--sharpen", colours, "--fit-model", "affine3d", "--gcps", tmp_path / "p.csv"), "in the image only"),
        (("--weights", "1,2"), "also give --sharpen"),
        (("--sharpen", colours, "--weights", "a,b"), "not a list of numbers"),
    ):
        result = run("rectify", pan, *words, *out)
        assert result.exit_code == 2, result.output
        assert message in result.output
    result = run("rectify", colours, "--sharpen", pan, *out)
    assert "panchromatic image has one" in result.output
    coarse = write(tmp_path / "coarse.tif", np.zeros((1, 8, 8)), 40.0)
    for option, words in (("-tr", ("-tr", 40, 40)), ("--like", ("--like", coarse))):
        result = run("rectify", pan, "--sharpen", colours, *words, *out)
        assert f"{option}: the pixels of this image are" in result.output
        assert "so there is no detail to add" in result.output
    assert not (tmp_path / "out").exists()


def test_the_remedy_for_two_rpcs_of_an_image_works_for_a_bundle(tmp_path: Path) -> None:
    pan, colours = bundle_of(tmp_path)
    for name, scale in (("pan", 1.0), ("ms", 4.0)):
        write_rpc_txt(rpc().scaled(scale).shifted(50.0, 0.0), tmp_path / f"{name}_RPC.TXT")
    words = "rectify", pan, "--sharpen", colours, "--height", rpc().h_off, "-o", tmp_path / "out"
    refused = run(*words)
    assert refused.exit_code == 2
    assert "choose one: --rpc tag" in refused.output
    done = run(*words, "--rpc", "tag")
    assert done.exit_code == 0, done.output


def test_a_folder_with_a_bundle_suggests_to_sharpen(tmp_path: Path) -> None:
    pan, colours = bundle_of(tmp_path)
    steps = json.loads(run("info", tmp_path, "--json").stdout)["next"]
    assert steps[-1].split()[:5] == ["ortho", "rectify", str(pan), "--sharpen", str(colours)]
    # Two images of neighbouring places are no bundle, nor are two of several bands.
    dataset = gdal.Open(str(colours), gdal.GA_Update)
    far = replace(rpc(), lon_off=rpc().lon_off + 2 * rpc().lon_scale).scaled(4.0)
    dataset.SetMetadata(rpc_metadata(far), "RPC")
    dataset = None
    assert "--sharpen" not in " ".join(json.loads(run("info", tmp_path, "--json").stdout)["next"])
