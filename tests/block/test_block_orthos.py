"""`ortho adjust --orthos`: all images on one grid, called and reported as by `ortho rectify`, ready for a mosaic."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from ortho_windows import SIDE, tapered, windows
from osgeo import gdal
from skimage.registration import phase_cross_correlation

from ortho_pipeline.block.start import Start
from ortho_pipeline.cli.program import cli
from ortho_pipeline.commands.block_results import orthos as orthos_of_blocks
from ortho_pipeline.commands.block_results.models import adjusted_models, exported_models
from ortho_pipeline.commands.inputs import open_scene
from ortho_pipeline.commands.results import Result
from ortho_pipeline.errors import CoverageError, InputError
from ortho_pipeline.hookspecs import Scene
from ortho_pipeline.models import FrameCamera
from ortho_pipeline.models.lens import Interior
from ortho_pipeline.options import MosaicOptions, OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.surface.dem import open_dem
from ortho_pipeline.surface.writing import write_dem


def run(*args: str | Path, code: int = 0) -> str:
    done = CliRunner().invoke(cli, [str(arg) for arg in args])
    assert done.exit_code == code, done.output + str(done.exception)
    return done.stdout


def shifts(first: Path, second: Path) -> np.ndarray:
    """Return by how much (px, columns and rows) windows of two orthos on one grid are shifted against each other."""
    found = []
    for pair in windows(first, second, step=32):
        shift, error, _ = phase_cross_correlation(*map(tapered, pair), upsample_factor=50, normalization=None)
        if error < 0.6 and np.abs(shift).max() < SIDE / 4:
            found.append(shift[::-1])
    assert len(found) >= 20
    return np.array(found)


def apart(first: Path, second: Path) -> float:
    """Return the length (px) of the median shift of windows."""
    return float(np.hypot(*np.median(shifts(first, second), axis=0)))


def adjusted(images: list[Path], out: Path, *more: str | Path) -> dict[str, Any]:
    words = ["adjust", *images, "-o", out, "--ties", "auto", "--orthos", *more, "--json"]
    return json.loads(run(*words))


def test_the_cartosat_pair_on_one_grid(sample: Path, tmp_path: Path) -> None:
    """Orthos fit each other with heights; names, reports and the mosaic are as after `ortho rectify`."""
    folder, out = sample / "cartosat", tmp_path / "block"
    images = [folder / "BANDA.tif", folder / "BANDF.tif"]
    document = adjusted(images, out, "--dem", folder / "dem.tif", "--dem-sigma", "2", "--mosaic")
    orthos = [out / "BANDA_ortho.tif", out / "BANDF_ortho.tif"]
    assert document["files"]["BANDA ortho"] == str(orthos[0])
    places = [gdal.Open(str(path)).GetGeoTransform() for path in orthos]
    assert places[0][1] == places[1][1]
    assert (places[0][0] - places[1][0]) / places[0][1] == pytest.approx(
        round((places[0][0] - places[1][0]) / places[0][1]), abs=1e-6
    )
    assert apart(*orthos) < 0.1
    report = json.loads((out / "BANDA_report.json").read_text())
    assert "adjusted in a block" in report["headline"]["what"]
    assert report["surface"]["raised_m"] == pytest.approx(-document["report"]["adjustment"]["heights"]["mean_error_m"])
    assert not (out / "BANDA.vrt").exists()
    run("mosaic", *orthos, "-o", tmp_path / "mosaic.tif")
    one, other = (gdal.Open(str(path / "mosaic.tif")).ReadAsArray() for path in (tmp_path, out))
    np.testing.assert_array_equal(one, other)
    assert document["mosaic"]["seams"]


def test_a_dem_that_ends_within_an_image_does_not_cost_the_block(sample: Path, tmp_path: Path) -> None:
    """The error comes after the adjustment. Models and report are written; orthos of an earlier adjustment go."""
    folder, out = sample / "cartosat", tmp_path / "block"
    images = folder / "BANDA.tif", folder / "BANDF.tif"
    words = "adjust", *images, "--points", folder / "points.csv", "--orthos", "--mosaic", "-o", out
    run(*words, "--dem", folder / "dem.tif")
    assert (out / "mosaic.tif").exists()
    (out / "BANDA_model.json").unlink()
    whole = gdal.Open(str(folder / "dem.tif"))
    dem = tmp_path / "part.tif"
    gdal.Translate(str(dem), whole, srcWin=[0, 0, whole.RasterXSize * 2 // 3, whole.RasterYSize])
    done = CliRunner().invoke(cli, [str(word) for word in (*words, "--dem", dem)])
    assert done.exit_code == 3
    assert "the adjusted models and the report are complete" in done.stderr
    assert "--dem-fill mask" in done.stderr
    assert {"BANDA_model.json", "BANDF_model.json", "block_report.html"} <= {path.name for path in out.iterdir()}
    assert not {"mosaic.tif", "BANDA_ortho.tif", "BANDA_report.json"} & {path.name for path in out.iterdir()}
    # The remedy.
    more = "--dem", dem, "--dem-fill", "mask", "-o", tmp_path / "again"
    run("rectify", folder / "BANDA.tif", "--model", out / "BANDA_model.json", *more)


def photos_and_dem(folder: Path, **east: float) -> dict[str, Scene]:
    """Write a DEM ``dem.tif`` of one height; return photos 100 m above it, some of which are not over it."""
    write_dem(folder / "dem.tif", np.full((201, 201), 80.0), (299_799.0, 2_700_201.0), 2.0, "EPSG:32651")
    scenes = {}
    for name, x in east.items():
        interior = Interior(600, 400, 0.006, 1e-5, 1e-5)
        model = FrameCamera.from_map(interior, "EPSG:32651", [x, 2.7e6, 180.0, 0, 0, 0], frame="map", heights=(0, 100))
        scenes[name] = Scene("frame", name, 600, 400, {"frame": model}, "table")
    return scenes


@pytest.mark.parametrize(("fill", "told"), [("error", "the DEM covers 0.0 % of the scene"), ("mask", "no pixels")])
def test_an_image_outside_the_dem_is_named(tmp_path: Path, fill: str, told: str) -> None:
    """One photo of many is 900 m west of the DEM."""
    scenes = photos_and_dem(tmp_path, near=300_000.0, far=299_100.0)
    with pytest.raises(CoverageError, match=f"image far: .*{told}") as error:
        orthos_of_blocks.on_one_grid(scenes, open_dem(tmp_path / "dem.tif", "ellipsoid", fill=fill), OutputOptions())
    assert str(error.value.remedy).endswith("; or leave this image out")


def test_all_images_outside_the_dem_are_named(tmp_path: Path) -> None:
    """Two photos of three are west of the DEM: both have to be left out, so both are named at once."""
    scenes = photos_and_dem(tmp_path, far=299_100.0, near=300_000.0, farther=299_000.0)
    with pytest.raises(CoverageError, match=r"image far: .*no pixels\. .* either: farther") as error:
        orthos_of_blocks.on_one_grid(scenes, open_dem(tmp_path / "dem.tif", "ellipsoid", fill="mask"), OutputOptions())
    assert str(error.value.remedy).endswith("; or leave these images out")


def test_with_masks_the_other_images_get_orthos(tmp_path: Path) -> None:
    """One photo of two is west of the DEM: it has no ortho, and a notice."""
    scenes = photos_and_dem(tmp_path, far=299_100.0, near=300_000.0)
    fit: Any = SimpleNamespace(heights=None)

    def plan(fill: str, of: dict[str, Scene] = scenes) -> orthos_of_blocks.OrthoPlan:
        surface = SurfaceOptions(dem=tmp_path / "dem.tif", vertical="ellipsoid", fill=fill)
        files = {name: {"ortho": tmp_path / name} for name in of}
        return orthos_of_blocks.OrthoPlan.of(of, files, fit, None, (SceneOptions(), surface, OutputOptions()))

    made = plan("mask")
    assert list(made.scenes) == list(made.files) == ["near"]
    assert made.obsolete == [tmp_path / "far"]
    assert [str(notice) for notice in made.notices] == [
        "image far: the DEM does not cover this image, so it has no ortho"
    ]
    for refused in (lambda: plan("error"), lambda: plan("mask", {"far": scenes["far"]})):
        with pytest.raises(CoverageError, match="image far: "):
            refused()


def test_heights_beyond_a_model_are_an_error_with_masks_too(sample: Path, tmp_path: Path) -> None:
    """The DEM covers both images; the notice said that it does not cover one."""
    near = open_scene(sample / "scene.tif")
    rpc: Any = near.model
    scenes = {"low": replace(near, models={"rpc": replace(rpc, h_off=rpc.h_off - 3000.0)}), "near": near}
    files = {name: {"ortho": tmp_path / name} for name in scenes}
    asked = SceneOptions(), SurfaceOptions(dem=sample / "dem.tif", fill="mask"), OutputOptions()
    fit: Any = SimpleNamespace(heights=None)
    with pytest.raises(CoverageError, match="image low: heights under the scene are"):
        orthos_of_blocks.OrthoPlan.of(scenes, files, fit, None, asked)


def test_rpcs_of_photos_are_for_the_ground(tmp_path: Path) -> None:
    """The tags of a photo leave the heights of the ground open; no RPC represents a camera so near to them."""
    write_dem(tmp_path / "dem.tif", np.full((201, 201), 80.0), (299_799.0, 2_700_201.0), 2.0, "EPSG:32651")
    interior = Interior(600, 400, 0.006, 1e-5, 1e-5, k1=-0.002, k2=0.0005)
    pose = [300_000.0, 2.7e6, 180.0, 0.03, -0.02, 0.5]
    model = FrameCamera.from_map(interior, "EPSG:32651", pose, heights=(-20.0, 160.0))
    scene = Scene("photo", "near", 600, 400, {"frame": model}, "EXIF and XMP")
    fit: Any = SimpleNamespace(heights=None, models={"near": model})
    made = adjusted_models(
        fit, {"near": Start(scene, model, "frame", "EXIF")}, open_dem(tmp_path / "dem.tif", "ellipsoid")
    )
    files = {"near rpc": tmp_path / "near_RPC.TXT"}
    exported, notices = exported_models(made, files)
    assert notices == []
    assert "near rpc" in files
    ground = model.image_to_ground([[10.0, 20.0], [300.0, 200.0], [590.0, 390.0]], 80.0)
    np.testing.assert_allclose(exported["near"].rpc.ground_to_image(ground), model.ground_to_image(ground), atol=0.02)


def test_options_of_orthos_need_orthos(sample: Path, tmp_path: Path) -> None:
    image = sample / "cartosat" / "BANDA.tif"
    done = CliRunner().invoke(
        cli, ["adjust", str(image), str(image), "-o", str(tmp_path / "out"), "--ties", "auto", "-tr", "5"]
    )
    assert done.exit_code == 2
    assert "--orthos" in done.output + done.stderr
    done = CliRunner().invoke(cli, ["adjust", str(image), "-o", str(tmp_path / "out"), "--points", "x.csv", "--orthos"])
    assert done.exit_code == 2
    assert "--dem" in done.output + done.stderr


def test_a_mosaic_that_fails_costs_no_ortho(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*given: Any) -> None:
        raise InputError("the orthos differ in their bands", remedy="give orthos with the same bands")

    monkeypatch.setattr(orthos_of_blocks, "mosaic_of", refuse)
    orthos = {"a": {"ortho": tmp_path / "a_ortho.tif"}}
    result = orthos_of_blocks.with_mosaic(
        Result(orthos, {}, "text"), orthos, {"mosaic": {"mosaic": tmp_path / "mosaic.tif"}}, MosaicOptions()
    )
    assert result.files == orthos
    assert "differ in their bands" in str(result.failure)


# -- real images -----------------------------------------------------------------------------------------------------


def _averaged_dsm(folder: Path, path: Path) -> None:
    """Write the surface of the other program, averaged to 30 m, 3 m too high."""
    source = gdal.Open(str(folder / "s2p" / "expected_output" / "triplet" / "dsm.tif"))
    heights, (left, step, _, top, *_) = source.ReadAsArray().astype(float), source.GetGeoTransform()
    cells = round(30.0 / step)
    rows, columns = (size // cells for size in heights.shape)
    parts = heights[: rows * cells, : columns * cells].reshape(rows, cells, columns, cells)
    known = np.isfinite(parts)
    counts = known.sum(axis=(1, 3))
    means = np.where(counts > 0, np.where(known, parts, 0.0).sum(axis=(1, 3)) / np.maximum(counts, 1) + 3.0, -32768.0)
    write_dem(path, means, (left, top), 30.0, "EPSG:32631")


@pytest.mark.slow
@pytest.mark.realdata
def test_pleiades_orthos_fit_by_a_coarse_dem(real: Path, tmp_path: Path) -> None:
    """Neighbours within 0.3 px; without the heights as observations they are 0.5 px apart."""
    _averaged_dsm(real, tmp_path / "dem.tif")
    images = [real / "s2p" / "input_triplet" / f"img_0{k}.tif" for k in (1, 2, 3)]
    dem = ["--dem", tmp_path / "dem.tif", "--dem-vertical", "ellipsoid", "--dem-fill", "mask"]
    found = {}
    for heights in ("on", "off"):
        out = tmp_path / heights
        adjusted(images, out, *dem, "--dem-heights", heights)
        orthos = [out / f"img_0{k}_ortho.tif" for k in (1, 2, 3)]
        found[heights] = [apart(*pair) for pair in itertools.pairwise(orthos)]
    assert max(found["on"]) < 0.3
    assert min(found["off"]) > 0.4


@pytest.mark.realdata
@pytest.mark.slow
def test_aerial_frames_fit_by_a_dem(real: Path, tmp_path: Path) -> None:
    folder = real / "orthority" / "ngi"
    camera, poses = tmp_path / "camera.json", tmp_path / "poses.csv"
    camera.write_text('{"width": 640, "height": 1152, "focal_length_mm": 120, "sensor_mm": [92.16, 165.888]}')
    rows = [line.split() for line in (folder / "camera_pos_ori.txt").read_text().splitlines() if line.strip()]
    poses.write_text(
        "\n".join(["filename,x,y,z,omega,phi,kappa", *(",".join([f"{row[0]}.tif", *row[1:]]) for row in rows)])
    )
    crs = (real / "orthority" / "io" / "ngi_xyz_opk.prj").read_text().strip()
    options = [f"camera={camera}", f"exterior={poses}", f"crs={crs}", "vertical=egm96"]
    sensor = [word for option in options for word in ("--sensor-option", option)]
    dem = ["--dem", folder / "dem.tif", "--dem-vertical", "egm96", "--override-dem-vertical", "--dem-fill", "mask"]
    images = sorted(folder.glob("*_RGB.tif"))
    adjusted(images, tmp_path / "out", "--sensor", "frame", *sensor, *dem, "--search", "50")
    orthos = [tmp_path / "out" / f"{image.stem}_ortho.tif" for image in images]
    for pair in itertools.combinations(orthos, 2):
        assert apart(*pair) < 0.3
