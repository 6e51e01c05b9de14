"""Planet's basic products by their RPC, with the metadata of their item."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from ortho_planet import metadata_of
from products import PLANET
from seeds import SIZE, rpc
from used import pixels, ran, used

from ortho_pipeline.errors import InputError
from ortho_pipeline.exchange.rpc_files import read_rpc_text, write_rpc_txt
from ortho_pipeline.exchange.rpc_fit import fit_rpc
from ortho_pipeline.host import open_scene
from ortho_pipeline.models.frame.camera import FrameCamera
from ortho_pipeline.models.lens import Interior

ITEM = "20200101_081500_12_2401"


@pytest.fixture
def image(tmp_path: Path) -> Path:
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / f"{ITEM}_metadata.json").write_text(PLANET)
    path = pixels(folder / f"{ITEM}_1B_AnalyticMS.tif", SIZE)
    write_rpc_txt(rpc(), folder / f"{ITEM}_1B_AnalyticMS_RPC.TXT")
    return path


def test_every_command(image: Path) -> None:
    info = used(image, rpc(), SIZE, sensor="planet", height=rpc().h_off, correction="shift")
    assert info["facts"]["satellite"] == "2401"
    assert info["facts"]["cloud_cover"] == 0.01


def test_an_orthorectified_asset_is_refused(image: Path) -> None:
    (image.parent / f"{image.stem}_RPC.TXT").unlink()
    with pytest.raises(InputError, match="Orthorectified assets have none"):
        open_scene(image)


def test_the_metadata_are_those_of_the_item(image: Path) -> None:
    shutil.copy(image.parent / f"{ITEM}_metadata.json", image.parent / "20200101_081500_12_metadata.json")
    assert metadata_of(str(image)) == image.parent / f"{ITEM}_metadata.json"
    (image.parent / f"{ITEM}_metadata.json").write_text('{"item_type": 1}')
    with pytest.raises(InputError, match="not the metadata of an item"):
        open_scene(image)


def test_an_item_whose_number_only_begins_alike_is_another(image: Path) -> None:
    other = image.with_name(f"{ITEM}0_1B_AnalyticMS.tif")
    shutil.copy(image, other)
    assert metadata_of(str(other)) is None
    assert metadata_of(str(image.with_name(f"{ITEM}.tif"))) == image.parent / f"{ITEM}_metadata.json"


def test_frames_of_a_strip_are_adjusted_together(tmp_path: Path) -> None:
    """Three SkySat frames behind each other, seen twice; each is off by pixels of its own.

    Control lies in the first pair of frames and in the last: the frames between hang on their ties.
    """
    random, strip, size = np.random.default_rng(7), tmp_path / "strip", (250, 200)
    strip.mkdir()
    cameras, images = {}, []
    for k in range(6):
        wanted = np.array([12.5 + 0.0012 * (k % 3), 41.9, 150.0])
        turn = np.radians([1.0, 12.0 if k < 3 else -12.0, 90.0])
        place = wanted[:2]
        for _ in range(3):  # to where it sees the middle of the frame
            camera = FrameCamera.from_roll_pitch_yaw(
                Interior(*size, 3.6, 6.5e-6, 6.5e-6), (*place, 500e3), *turn, heights=(0.0, 300.0)
            )
            place = place + wanted[:2] - camera.image_to_ground([[125.0, 100.0]], 150.0)[0, :2]
        centre, half = camera.domain
        model = fit_rpc(camera, (*(centre - half)[:2], *(centre + half)[:2]), (0.0, 300.0), grid=(7, 7, 4)).rpc
        item = f"20200101_08150{k}_ssc6d2_000{k}"
        (strip / f"{item}_metadata.json").write_text(
            PLANET.replace("20200101_081500_12_2401", item).replace("PSScene", "SkySatScene")
        )
        image = pixels(strip / f"{item}_1A_panchromatic.tif", size)
        off = random.uniform(-6.0, 6.0, 2)
        write_rpc_txt(model.shifted(*off), image.with_name(f"{image.stem}_RPC.TXT"))
        cameras[image.name] = camera
        images.append(image)
    plan = np.column_stack([random.uniform(12.4985, 12.5039, 70), random.uniform(41.8992, 41.9008, 70)])
    ground = np.column_stack([plan, random.uniform(50.0, 250.0, 70)])
    lines, known = ["#CRS: EPSG:4979", "#vertical: ellipsoid", "id,image,col,row,x,y,h,role"], set()
    for name, camera in cameras.items():
        for k, (x, y) in enumerate((camera.ground_to_image(ground) + random.normal(0, 0.1, (70, 2))).tolist()):
            if not (0 < x < size[0] and 0 < y < size[1]):
                continue
            ends = abs(ground[k, 0] - 12.5012) > 0.0022
            said = ",".join(map(repr, ground[k].tolist())) + ",control" if ends and k not in known else ",,,"
            known.add(k)
            lines.append(f"{k},{name},{x!r},{y!r},{said}")
    (strip / "rays.csv").write_text("\n".join(lines))
    found = ran("adjust", *images, "--points", strip / "rays.csv", "--model", "rpc", "--correction", "shift", "-o",
                tmp_path / "block")  # fmt: skip
    for image in images:
        inner = random.uniform(0.1, 0.9, (20, 2)) * size
        there = cameras[image.name].image_to_ground(inner, random.uniform(50.0, 250.0, 20))
        before, after = (read_rpc_text(path).ground_to_image(there) - inner for path in (
            image.with_name(f"{image.stem}_RPC.TXT"), Path(found["files"][f"{image.stem} rpc"])))  # fmt: skip
        assert np.linalg.norm(before.mean(axis=0)) > 1.0
        assert np.abs(after).max() < 0.3
