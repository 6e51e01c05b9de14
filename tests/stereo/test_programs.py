"""The real programs read what is exported: rpcm and shareloc to 1e-6 px, CARS its configuration; CARS makes a DSM."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from osgeo import gdal
from pair import Pair
from programs import answer, executable
from test_block_export import ground_of

import ortho_pipeline as op
from ortho_pipeline import commands
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.commands.heights.opening import open_surface
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.options import BlockOptions, MatchOptions, OutputOptions, SceneOptions, SurfaceOptions
from ortho_pipeline.surface.writing import write_dem

#: rpcm: the centre of the first pixel is (0, 0), as its files have it.
RPCM = """
import rpcm
answer = {}
for name, kind, path, ground in request:
    read = rpcm.rpc_from_geotiff if kind == "tag" else rpcm.rpc_from_rpc_file
    lon, lat, height = zip(*ground)
    answer[f"{name} {kind}"] = [values.tolist() for values in read(path).projection(lon, lat, height)]
"""
#: shareloc, as CARS calls it: the corner of the first pixel is (0, 0).
SHARELOC = """
import numpy as np
from shareloc.geomodels.geomodel import GeoModel
from shareloc.image import Image
answer = {}
for name, kind, path, ground in request:
    if kind == "image":
        image = Image(path, vertical_direction="north")
        answer[name] = [image.origin_col, image.origin_row, image.pixel_size_col, image.pixel_size_row]
        continue
    lon, lat, height = (np.array(values) for values in zip(*ground))
    row, col, _ = GeoModel(path, "RPC").inverse_loc(lon, lat, height)
    answer[f"{name} {kind}"] = [np.asarray(col).tolist(), np.asarray(row).tolist()]
"""
#: CARS checks a configuration by making its pipeline: it reads all images, models and the DEM, and changes defaults.
CHECK = """
import os
from cars.pipelines.pipeline import Pipeline
os.chdir(request["folder"])
used = Pipeline("default", json.load(open("cars.json")), request["folder"]).used_conf
def inputs_of(conf):
    found = [conf] if "sensors" in conf and "pairing" in conf else []
    return found + [one for value in conf.values() if isinstance(value, dict) for one in inputs_of(value)]
first = inputs_of(used)[0]
answer = {
    "pairing": first["pairing"],
    "elevation": first["initial_elevation"],
    "models": {name: sensor["geomodel"] for name, sensor in first["sensors"].items()},
    "images": {name: sensor["image"]["bands"]["b0"]["path"] for name, sensor in first["sensors"].items()},
}
"""


@pytest.fixture
def exported(tmp_path: Path) -> tuple[Pair, Any]:
    pair = Pair(tmp_path / "pair")
    surface = SurfaceOptions(dem=pair.dem())
    points = BlockOptions(points=pair.points())
    return pair, adjust(pair.images, tmp_path / "out", points, surface=surface, export=["cars", "asp", "s2p"])


def requests(pair: Pair, done: Any, kinds: tuple[str, ...]) -> tuple[list[Any], dict[str, np.ndarray]]:
    """Return what to ask a program, and the answers of the adjusted models."""
    asked, wanted = [], {}
    for name in pair.rpcs:
        model = op.load_model(done.files[f"{name} model"])
        ground = ground_of(model)
        for kind in kinds:
            asked.append((name, kind, str(done.files[f"{name} {kind}"]), ground.tolist()))
            wanted[f"{name} {kind}"] = model.ground_to_image(ground)
    return asked, wanted


def test_rpcm_reads_the_models_that_s2p_gets(exported: tuple[Pair, Any]) -> None:
    executable("readers")
    pair, done = exported
    asked, wanted = requests(pair, done, ("rpc-txt",))
    found = answer("readers", RPCM, asked)
    for name, image in wanted.items():
        np.testing.assert_allclose(np.transpose(found[name]) + 0.5, image, rtol=0, atol=1e-6)


def test_shareloc_reads_the_models_that_cars_gets(exported: tuple[Pair, Any]) -> None:
    executable("readers")
    pair, done = exported
    asked, wanted = requests(pair, done, ("geom",))
    found = answer("readers", SHARELOC, asked)
    for name, image in wanted.items():
        np.testing.assert_allclose(np.transpose(found[name]), image, rtol=0, atol=1e-6)


def test_both_read_what_ortho_export_writes_of_one_image(tmp_path: Path) -> None:
    executable("readers")
    pair = Pair(tmp_path / "pair")
    done = commands.export(pair.image("aft"), tmp_path / "out", formats=["rpc-txt", "tag", "geom", "vrt"])
    ground = ground_of(pair.rpcs["aft"])
    wanted = pair.rpcs["aft"].ground_to_image(ground)
    asked = [("aft", kind, str(done.files[kind]), ground.tolist()) for kind in ("rpc-txt", "tag", "geom", "vrt")]
    rpcm = answer("readers", RPCM, asked[:2])
    shareloc = answer("readers", SHARELOC, asked[1:])
    for image in [np.transpose(image) + 0.5 for image in rpcm.values()] + [np.transpose(i) for i in shareloc.values()]:
        np.testing.assert_allclose(image, wanted, rtol=0, atol=1e-6)


def test_shareloc_counts_pixels_of_a_map_or_crop_as_the_model_does(tmp_path: Path) -> None:
    """shareloc adds the geotransform of an image to its pixels, so images with one are given without."""
    executable("readers")
    pair = Pair(tmp_path / "pair")
    pair.georeference()
    done = adjust(pair.images, tmp_path / "out", BlockOptions(points=pair.points()), export=["cars"])
    sensors = json.loads(done.files["cars"].read_text())["input"]["sensors"]
    paths = [str(tmp_path / "out" / sensor["image"]["path"]) for sensor in sensors.values()]
    asked = [("given", "image", paths[0], []), ("as it was", "image", str(pair.image("aft")), [])]
    found = answer("readers", SHARELOC, asked)
    assert found["given"] == [0.0, 0.0, 1.0, 1.0]
    assert found["as it was"] != found["given"]


def test_cars_checks_its_configuration(exported: tuple[Pair, Any], tmp_path: Path) -> None:
    executable("cars")
    pair, _ = exported
    checked = answer("cars", CHECK, {"folder": str(tmp_path / "out")})
    assert checked["pairing"] == [["aft", "fore"]]
    assert checked["elevation"] == {"dem": str(tmp_path / "out" / "elevation.tif"), "geoid": None}
    for name in pair.rpcs:
        model = {"path": str(tmp_path / "out" / f"{name}.geom"), "model_type": "RPC"}
        assert checked["models"][name] in (model, model["path"])
        assert Path(checked["images"][name]).resolve() == pair.image(name).resolve()


@pytest.mark.slow
@pytest.mark.realdata
def test_cars_makes_a_dsm_of_an_adjusted_pair_over_which_the_orthos_agree(real: Path, tmp_path: Path) -> None:
    """Pleiades: ties over a DEM of 30 m, the DSM of CARS, and true orthos over it without another option than --dem."""
    program = executable("cars", "cars")
    names = ("img_01", "img_03")
    images = [real / "s2p" / "input_triplet" / f"{name}.tif" for name in names]
    authority = real / "s2p" / "expected_output" / "triplet" / "dsm.tif"
    surface = SurfaceOptions(dem=coarse_of(authority, tmp_path / "coarse.tif"), vertical="ellipsoid", fill="nearest")
    done = adjust(images, tmp_path / "out", BlockOptions(ties="auto"), surface=surface, export=["cars"])
    ran = subprocess.run(
        [program, "--logtype", "plain", done.files["cars"]], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout[-3000:]
    dsm = tmp_path / "cars" / "dsm" / "dsm.tif"
    assert open_surface(SurfaceOptions(dem=dsm, sigma=dsm.with_name("performance_map.tif"))).sigma is not None
    # Another program made a DSM of these images with a third one; with the wrong datum it would be 49 m away.
    lon, lat = np.meshgrid(np.linspace(5.441, 5.445, 60), np.linspace(43.2605, 43.2635, 60))
    places = np.column_stack([lon.ravel(), lat.ravel()])
    found = op.open_dem(dsm, fill="mask").heights(places, "EPSG:4326")
    wanted = op.open_dem(authority, "ellipsoid", fill="mask").heights(places, "EPSG:4326")
    assert np.isfinite(found - wanted).mean() > 0.3
    assert abs(np.nanmedian(found - wanted)) < 5.0
    # The true orthos show the same ground: matching one with the other leaves less than a pixel.
    orthos = [
        commands.rectify(
            image, tmp_path / name, scene=SceneOptions(model=done.files[f"{name} model"]),
            surface=SurfaceOptions(dem=dsm), output=OutputOptions(visibility="nodata"),
        ).files["ortho"]
        for name, image in zip(names, images, strict=True)
    ]  # fmt: skip
    agreement = verify(orthos[0], match=MatchOptions(reference=[str(orthos[1])])).document
    assert agreement["relative"]["rmse_m"]["value"] < 0.5


def coarse_of(dsm: Path, path: Path) -> Path:
    """Write the mean of 30 m of a DSM, whose holes have the median height."""
    dataset = gdal.Open(str(dsm))
    heights, transform = dataset.ReadAsArray(), dataset.GetGeoTransform()
    heights = np.where(np.isnan(heights), np.nanmedian(heights), heights)[:840, :840]
    coarse = heights.reshape(14, 60, 14, 60).mean(axis=(1, 3))
    write_dem(path, coarse, (transform[0], transform[3]), 30.0, "EPSG:32631")
    return path
