"""The real programs read what is exported: rpcm and shareloc to 1e-6 px, CARS its configuration; CARS makes a DSM."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pair import Pair
from programs import answer, executable
from test_block_export import ground_of

import ortho_pipeline as op
from ortho_pipeline import commands
from ortho_pipeline.commands.block import adjust
from ortho_pipeline.commands.orthos.verifying import verify
from ortho_pipeline.options import BlockOptions, MatchOptions, OutputOptions, SceneOptions, SurfaceOptions

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
CHECK = """
import argparse, os
from cars.pipelines.pipeline import Pipeline
os.chdir(request["folder"])
used = Pipeline("default", json.load(open("cars.json")), request["folder"])
answer = {key: list(value) for key, value in used.used_conf.items() if isinstance(value, dict)}
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
    checked = answer("cars", CHECK, {"folder": str(tmp_path / "out")})
    assert {"sensors", "pairing", "initial_elevation"} <= set(checked["input"])


@pytest.mark.slow
@pytest.mark.realdata
def test_cars_makes_a_dsm_of_an_adjusted_pair_over_which_the_orthos_agree(real: Path, tmp_path: Path) -> None:
    """Mont Ventoux: ties over SRTM, the DSM of CARS, and orthos over it without another option than --dem."""
    program = executable("cars", "cars")
    folder, names = real / "shareloc", ("left_image", "right_image")
    images = [folder / "image" / "phr_ventoux" / f"{name}.tif" for name in names]
    scenes = [SceneOptions(rpc=str(folder / "rpc" / "phr_ventoux" / f"{name}.geom")) for name in names]
    srtm = folder / "dtm" / "srtm_ventoux" / "srtm90_non_void_filled" / "N44E005.hgt"
    done = adjust(
        images, tmp_path / "out", BlockOptions(ties="auto"), scenes, export=["cars"],
        surface=SurfaceOptions(dem=srtm, vertical="EPSG:5773"),
    )  # fmt: skip
    ran = subprocess.run(
        [program, "--logtype", "plain", done.files["cars"]], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout[-3000:]
    dsm = tmp_path / "cars" / "dsm" / "dsm.tif"
    heights = op.open_dem(dsm, fill="mask")
    # SRTM is some metres off in mountains; the wrong datum would be 50 m off.
    rows, columns = heights.shape
    v, u = (axis.ravel() for axis in np.mgrid[0:rows:20, 0:columns:20])
    places = np.column_stack(heights.grid.lonlat(u.astype(float), v.astype(float)))
    apart = heights.heights(places, "EPSG:4326") - op.open_dem(srtm, "EPSG:5773").heights(places, "EPSG:4326")
    assert np.isfinite(apart).mean() > 0.5
    assert abs(np.nanmedian(apart)) < 10
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
